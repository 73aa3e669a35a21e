"""A drive of several discs has as many equivalent descriptions as discs: any disc can be the first."""

from __future__ import annotations

import cmath

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface

_OF_PINS = ("pin_radial", "pin_tangential", "pin_radius_deviation")
_VECTORS = (("centre_distance_x", "centre_distance_y"), ("misalignment_xz", "misalignment_yz"))


def other_descriptions(pair: Pair, surface: ErrorSurface) -> tuple[ErrorSurface, ...]:
    """Return the surfaces with the same curves at the same crank angles and another disc as the first.

    In a frame turned by k pitches of the cranks, β = 2πk/discs, disc k has the position of the first one, at the same
    crank angle and output. The pins' numbers move by z_p k/discs, which must be whole; the teeth's of
    disc d by as many, and by one less where d + k passes the last disc. Form of single elements stays: no fit has it.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors. With supports, whose errors do not change, the curves are only nearly the same.
    """
    count = pair.discs
    found = []
    for k in range(1, count):
        if pair.pins * k % count:
            continue
        passed = pair.pins * k // count
        errors: dict[str, float | NDArray[np.float64]] = {n: np.roll(surface.errors[n], -passed) for n in _OF_PINS}
        for x, y in _VECTORS:
            turned = complex(surface.errors[x], surface.errors[y]) * cmath.exp(-2j * cmath.pi * k / count)
            errors[x], errors[y] = turned.real, turned.imag
        pitch = surface.errors["tooth_cumulative_pitch"]
        errors["tooth_cumulative_pitch"] = np.stack(
            [np.roll(pitch[(d + k) % count], -passed + (d + k >= count)) for d in range(count)]
        )
        found.append(surface.replace(**errors))
    return tuple(found)
