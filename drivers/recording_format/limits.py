"""Limits of the encoders of a bench, and findings where they are exceeded."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from drivers.recording_format.schema import ANGLES, Channel, Header

LARGEST_DEVIATION = math.radians(1.0)  # far above TE, lost motion and windup of a drive, far below half a turn
LARGEST_DEVIATION_KEY = "largest_deviation"
Mask = npt.NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of two encoders on one drive.

    Attributes
    ----------
    deviation
        Largest change of output angle - input angle / ratio, rad: TE, lost motion and windup together.
    input_speed, output_speed
        Largest speeds, rad/s. None: unknown; a step that differs by a quarter turn from the motion before and after it
        is then a jump.
    input_resolution, output_resolution
        Angle of one count, rad; 0: unknown or negligible.
    """

    deviation: float = LARGEST_DEVIATION
    input_speed: float | None = None
    output_speed: float | None = None
    input_resolution: float = 0.0
    output_resolution: float = 0.0


def limits_of(header: Header) -> Limits:
    """Return the limits of the encoders that the header of a recording states.

    Largest speeds and counts per turn come from its channels, the deviation from its condition `largest_deviation`,
    rad, if there is one.
    """
    of = {c.role: c for c in header.channels if c.unit == "rad"}
    turning, driven = (of.get(role) for role in ANGLES)

    def resolution(channel: Channel | None) -> float:
        return 2.0 * math.pi / channel.counts_per_turn if channel is not None and channel.counts_per_turn else 0.0

    return Limits(
        float(header.conditions.get(LARGEST_DEVIATION_KEY, LARGEST_DEVIATION)),
        None if turning is None else turning.largest_speed,
        None if driven is None else driven.largest_speed,
        resolution(turning),
        resolution(driven),
    )


@dataclasses.dataclass(frozen=True)
class Finding:
    """An implausibility: start, s, possibly before the block in which it is found, roles concerned, and a text."""

    time: float
    roles: tuple[str, ...]
    text: str
