"""Which parts of a drive are alike, so that the mesh repeats sooner than after a whole turn of the output."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.pair import Pair
from cycloid_fmu.surface import ErrorSurface


@dataclass(frozen=True)
class Alike:
    """Which parts of a drive meet the others with the same errors.

    Attributes
    ----------
    teeth
        Whether the teeth of each disc are alike.
    pins
        Whether the pins are alike.
    discs
        Whether the discs are alike, tooth by tooth.
    """

    teeth: bool
    pins: bool
    discs: bool


def alike_parts(pair: Pair, surface: ErrorSurface) -> Alike:
    """Return which parts of a drive are alike.

    An offset or tilt of the gear's centre is fixed to the frame: with one, the parts of the body that does not turn,
    pins or teeth, meet the others unlike each other.
    """

    def same(names: tuple[str, ...], axis: int) -> bool:
        values: list[NDArray[np.float64] | None] = [getattr(surface, name) for name in names]
        return all(v is None or bool(np.all(np.ptp(v, axis=axis) == 0.0)) for v in values)

    flanks = ("tooth_cumulative_pitch", "gear_deviation", "gear_curvature")
    pins = ("pin_radial", "pin_tangential", "pin_radius_deviation", "pin_deviation", "pin_curvature")
    centred = not np.any([
        surface.centre_distance_x, surface.centre_distance_y, surface.misalignment_xz, surface.misalignment_yz
    ])  # fmt: skip
    pins_fixed = pair.pair.output == "gear"
    return Alike(
        teeth=same(flanks, 1) and (centred or pins_fixed),
        pins=same(pins, 0) and (centred or not pins_fixed),
        discs=same(flanks, 0),
    )


def mesh_pitches(pair: Pair, surface: ErrorSurface) -> int:
    """Return after how many mesh pitches all repeats: 1 where all are alike, up to z_c z_p of unequal parts."""
    alike = alike_parts(pair, surface)
    return (1 if alike.pins else pair.pair.pins) * (1 if alike.teeth else pair.pair.gear_teeth)
