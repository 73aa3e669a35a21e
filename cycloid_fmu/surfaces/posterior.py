"""Drives drawn from the result of a fit: error surfaces from the normal distribution of the identified errors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
DISC_PHASE = "disc_phase"
"""Name in a covariance of the position of another disc's teeth relative to the first disc's, m at the pin circle."""
_PLACE = re.compile(r"(\w+)_at_(\d+)")  # name of a single pin or tooth in a surface's covariance


def drawn_surfaces(pair: Pair, surface: ErrorSurface, count: int, seed: int) -> list[ErrorSurface]:
    """Draw error surfaces from the normal distribution given by an identified surface's covariance.

    Parameters
    ----------
    pair, surface
        The nominal pair, and the identified surface, which is the distribution's mean.
    count, seed
        Number of surfaces, and the seed; the same seed draws the same surfaces, and a smaller count the first of these.

    Returns
    -------
    surfaces
        The surfaces, without covariance; seed and number are in their attributes.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance.
    """
    if surface.covariance is None:
        raise edge.ArgumentError("drive", "has no covariance of a fit; give a surface written by identify")
    # Eigenvectors also work if a displacement has no variance.
    values, vectors = np.linalg.eigh(surface.covariance)
    normal = np.random.default_rng(seed).standard_normal((count, values.size))
    shifts = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    drawn = []
    for number, shift in enumerate(shifts):
        attributes = {**surface.attributes, "ensemble_seed": seed, "ensemble_number": number}
        one = surface.replace(covariance=None, covariance_of=(), attributes=attributes)
        drawn.append(_shifted(pair, one, dict(zip(surface.covariance_of, shift, strict=True))))
    return drawn


def _shifted(pair: Pair, surface: ErrorSurface, shifts: Mapping[str, float]) -> ErrorSurface:
    places = {name: found for name in shifts if (found := _PLACE.fullmatch(name))}
    moved = {n: structured_value(surface, n) + s for n, s in shifts.items() if n not in places}
    made = with_structured(surface, moved)
    scatter: dict[str, Any] = {}
    for name, place in places.items():
        # All teeth of another disc together.
        kind = "tooth_cumulative_pitch" if place[1] == DISC_PHASE else place[1]
        values = scatter.setdefault(kind, np.array(made.errors[kind]))
        if place[1] == DISC_PHASE:
            values[int(place[2]) + 1] += shifts[name]
        else:
            values.flat[int(place[2])] += shifts[name]
    return made.replace(**scatter)
