"""The cycloid flank: points, normals and curvature of the gear's profile, modified or not.

Gear frame: tooth 0 begins at the root on +x and extends counter-clockwise. It is the papers' frame (crank at +y) turned
by -90°.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.geometry.pair import Pair

Array = NDArray[np.float64]


def flank_points(pair: Pair, alpha: ArrayLike) -> tuple[Array, Array]:
    """Points of the nominal flank.

    Parameters
    ----------
    pair
        The pair; its modification is part of the flank.
    alpha
        Profile parameter, rad; tooth j spans 2πj/z_c to 2π(j + 1)/z_c.

    Returns
    -------
    x, y
        Coordinates, m, in the shape of `alpha`.

    Notes
    -----
    Error-surface paper, equation 1, turned by -90°: x = R cos α - r cos(ϑ - α) - e cos z_p α and
    y = R sin α + r sin(ϑ - α) - e sin z_p α, with ϑ = atan2(k sin z_c α, 1 - k cos z_c α).
    """
    a = np.asarray(alpha, dtype=float)
    g = pair
    big, small, e = pair.generating_circle_radius, pair.generating_pin_radius, g.eccentricity
    k = pair.shortening
    normal = np.arctan2(k * np.sin(g.gear_teeth * a), 1.0 - k * np.cos(g.gear_teeth * a))
    x = big * np.cos(a) - small * np.cos(normal - a) - e * np.cos(g.pins * a)
    y = big * np.sin(a) + small * np.sin(normal - a) - e * np.sin(g.pins * a)
    return x, y


def flank_normals(pair: Pair, alpha: ArrayLike) -> tuple[Array, Array]:
    """Unit normals of the nominal flank, out of the gear's material, each component in the shape of `alpha`."""
    a = np.asarray(alpha, dtype=float)
    k, teeth = pair.shortening, pair.gear_teeth
    normal = np.arctan2(k * np.sin(teeth * a), 1.0 - k * np.cos(teeth * a))
    return np.cos(a - normal), np.sin(a - normal)


def flank_curvature(pair: Pair, alpha: ArrayLike) -> Array:
    """Curvature 1/ρ_c of the nominal flank, > 0 convex, 1/m, in the shape of `alpha`.

    The generating pin's centre moves on a path of curvature (1 + z_p K² - K (z_p + 1) cos z_c α)/(R S³); the flank is r
    inside it, so 1/ρ_c = κ/(1 - r κ).
    """
    a = np.asarray(alpha, dtype=float)
    k, g = pair.shortening, pair
    c = np.cos(g.gear_teeth * a)
    path = (1.0 + g.pins * k * k - k * (g.pins + 1) * c) / (
        pair.generating_circle_radius * (1.0 + k * k - 2.0 * k * c) ** 1.5
    )
    return np.asarray(path / (1.0 - pair.generating_pin_radius * path))


def flank_speed(pair: Pair, alpha: ArrayLike) -> Array:
    """Arc length of the nominal flank per radian of the profile parameter, m, in the shape of `alpha`.

    The generating pin's centre moves R S per radian; the flank, r inside its path, is shorter by the factor 1 - r κ =
    1/(1 + r/ρ_c).
    """
    a = np.asarray(alpha, dtype=float)
    k = pair.shortening
    path = pair.generating_circle_radius * np.sqrt(1.0 + k * k - 2.0 * k * np.cos(pair.gear_teeth * a))
    return np.asarray(path / (1.0 + pair.generating_pin_radius * flank_curvature(pair, a)))


def arc_parts(pair: Pair, alpha: ArrayLike) -> Array:
    """Fraction of tooth 0's arc length at each profile parameter: 0 at its first root, 1 at its second."""
    edges, arc = _arc_length(pair, 4000)
    return np.asarray(np.interp(np.asarray(alpha, dtype=float), edges, arc / arc[-1]))


def _arc_length(pair: Pair, steps: int) -> tuple[Array, Array]:
    edges = np.linspace(0.0, 2.0 * np.pi / pair.gear_teeth, steps + 1)
    return edges, np.concatenate([[0.0], np.cumsum(np.hypot(*(np.diff(v) for v in flank_points(pair, edges))))])


@functools.lru_cache(maxsize=16)  # each step of a wear run needs the same ones
def equal_arc_parameters(pair: Pair, count: int) -> Array:
    """Profile parameters of the middles of `count` elements of equal arc length on tooth 0, shape (count,), rad.

    The error-surface paper fits a polynomial to the arc length; here it is integrated finely and interpolated.
    """
    edges, arc = _arc_length(pair, 200 * max(count, 20))
    middles = (np.arange(count) + 0.5) / count * arc[-1]
    parameters: Array = np.asarray(np.interp(middles, arc, edges))
    parameters.flags.writeable = False
    return parameters
