"""Sliding speed of every pin on the flank at a speed of the crank, and the friction power."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.wear.sliding import ideal_velocities

Array = NDArray[np.float64]


class Sliding(NamedTuple):
    """Sliding of every pin that carries load, 0 elsewhere; shape (angles, discs, pins), SI.

    Attributes
    ----------
    sliding_speed
        Speed between flank and pin, m/s.
    friction_power
        μ F v of each pin, W; empty without a friction coefficient.
    friction_power_density
        Friction power per contact area 2ab, which is μ v times the mean Hertzian pressure π/4 p, W/m²; empty likewise.
    """

    sliding_speed: Array
    friction_power: Array
    friction_power_density: Array


def flank_friction(pair: Pair) -> float | None:
    """Return the friction coefficient at speed of flanks on pins, of `[losses.flank]`; None if there is none."""
    return None if pair.losses is None else pair.losses.flank.friction_coefficient or None


def sliding_of(
    pair: Pair,
    crank_angle: ArrayLike,
    pin_force: Array,
    pin_pressure: Array,
    crank_speed: float,
    friction_coefficient: float | None = None,
) -> Sliding:
    """Return the sliding of every pin at one load.

    Parameters
    ----------
    pair
        The pair.
    crank_angle
        Shape (angles,), rad.
    pin_force, pin_pressure
        Force (N) and largest pressure (Pa) of each pin, shape (angles, discs, pins).
    crank_speed
        rad/s, in either direction.
    friction_coefficient
        μ of flanks on pins.

    Notes
    -----
    Velocities are those of the unmodified pair in closed form (`sliding.ideal_velocities`); modifications of some 50 µm
    change them by 0.7 %. Pins are assumed fixed in the ring; one that turns in its seat slides there instead. Flash
    temperatures are left out: at 600 rpm of the crank the Péclet numbers of the wear paper's pair are below 1, and
    Blok's formula is for those above 5.
    """
    angle = np.asarray(crank_angle, dtype=float)[:, None, None]
    discs, pins = pin_force.shape[-2:]
    ring = angle / pair.pins if pair.output == "ring" else 0.0
    crank = angle + 2.0 * np.pi * np.arange(discs)[:, None] / discs
    phase = 2.0 * np.pi * np.arange(pins) / pins + ring - crank
    # The velocities are per radian of the ring's rotation relative to the crank.
    against = crank_speed * (pair.gear_teeth / pair.pins if pair.output == "ring" else 1.0)
    speed = np.where(pin_force > 0.0, np.abs(ideal_velocities(pair, phase).sliding * against), 0.0)
    if friction_coefficient is None:
        return Sliding(speed, np.empty(0), np.empty(0))
    return Sliding(
        speed, friction_coefficient * pin_force * speed, friction_coefficient * 0.25 * np.pi * pin_pressure * speed
    )
