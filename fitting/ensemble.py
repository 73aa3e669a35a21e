"""Error surfaces drawn from what a fit leaves open: drives that measurements cannot tell from the identified one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.observation import scatter_names, with_scatter

Array = NDArray[np.float64]


def drawn_surfaces(pair: Pair, surface: ErrorSurface, count: int, seed: int) -> list[ErrorSurface]:
    """Draw error surfaces from the normal distribution that a fit states.

    Parameters
    ----------
    pair
        The pair that the surface belongs to.
    surface
        An identified surface, with the covariance of its fit.
    count
        How many.
    seed
        The same seed gives the same surfaces.

    Returns
    -------
    surfaces
        Of origin "identified", without a covariance; seed and number are in their attributes.

    Raises
    ------
    ValueError
        If the surface has no covariance.
    """
    if surface.covariance is None:
        raise ValueError("the surface has no covariance")
    places = scatter_names(pair)
    names = [n for n in surface.covariance_of if n not in places]
    at = [surface.covariance_of.index(n) for n in (*names, *places) if n in surface.covariance_of]
    covariance = surface.covariance[np.ix_(at, at)]
    # Eigenvectors also serve where a displacement has no variance at all.
    values, vectors = np.linalg.eigh(covariance)
    normal = np.random.default_rng(seed).standard_normal((count, values.size))
    shifts = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    surfaces = []
    for number, shift in enumerate(shifts):
        moved = {n: structured_value(pair, surface, n) + s for n, s in zip(names, shift, strict=False)}
        one = with_structured(pair, surface, moved)
        if shift.size > len(names):
            one = with_scatter(pair, one, shift[len(names) :])
        attributes = {**surface.attributes, "ensemble_seed": seed, "ensemble_number": number}
        surfaces.append(one.replace(covariance=None, covariance_of=(), attributes=attributes))
    return surfaces
