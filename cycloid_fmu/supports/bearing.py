"""Force law of a joint beyond its clearance: a power of the displacement, or a continuum of rollers."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from cycloid_fmu.contact import compiled

Array = NDArray[np.float64]
RIGID = 1e15  # N/m: in place of a rigid bearing; it turns a drive by some 1e-4″
CENTRING = 10.0  # N/m: centring spring for parts that are free in their clearance
_EXPONENT = 10.0 / 9.0  # of a roller's load over its approach (Palmgren)
_ORDER = 24


class Law(NamedTuple):
    """A law: a force F(r) along the displacement r, such as that of a bearing's inner ring.

    Attributes
    ----------
    half_clearance
        Half of the diametral clearance, m.
    stiffness
        Stiffness, N/m^exponent; for rollers Z K_l/(2π), N/m^(10/9).
    exponent
        Exponent of the force over the displacement beyond the clearance.
    rollers
        Whether it is a roller bearing, otherwise the force is stiffness · (r - half_clearance)^exponent.
    factor
        For rollers: coefficients of g(s) in `_roller_factor`.
    energy_factor
        For rollers: the same for their energy.
    """

    half_clearance: float
    stiffness: float
    exponent: float
    rollers: bool
    factor: Array
    energy_factor: Array


_SERIES = (_ORDER + 1,)
LAW = np.dtype(
    (
        np.record,
        [(name, np.float64) for name in ("half_clearance", "stiffness", "exponent")]
        + [("rollers", np.bool_), ("factor", np.float64, _SERIES), ("energy_factor", np.float64, _SERIES)],
    )
)
"""A `Law` as a record."""


def linear(stiffness: float, clearance: float = 0.0, exponent: float = 1.0) -> Law:
    """Return a bearing that is a spring beyond its diametral clearance (m): linear (N/m), or with another exponent."""
    return Law(0.5 * clearance, float(stiffness), exponent, False, *_roller_factors())


def rollers(number: int, length: float, clearance: float = 0.0) -> Law:
    """Return a steel roller bearing from the number of rollers, their effective length and the diametral clearance, m.

    A line contact carries 8.06e4 N/mm^(10/9) (l/mm)^(8/9) δ^(10/9) (Palmgren, Grundlagen der Wälzlagertechnik, for
    steel); a roller has two contacts.
    """
    each = 8.06e4 / 2.0**_EXPONENT * (1e3 * length) ** (8.0 / 9.0) * 1e3**_EXPONENT
    return Law(0.5 * clearance, number * each / (2.0 * math.pi), _EXPONENT, True, *_roller_factors())


@functools.cache
def _roller_factors() -> tuple[Array, Array]:
    """Return `_roller_factor` of a bearing's force and of its energy."""
    return _roller_factor(_EXPONENT, 1.0), _roller_factor(_EXPONENT + 1.0, 0.0)


def _roller_factor(exponent: float, along: float) -> Array:
    """Coefficients of g(s) in ∫ max(cos ψ - s, 0)^p cos^a ψ dψ = (1 - s)^(p + 1/2) g(s) for s from 0 to 1, by powers.

    The ends of the integral have Gauss-Jacobi weights, so g is smooth and its Chebyshev series accurate to 1e-14.
    """
    from scipy.special import roots_jacobi

    nodes, weights = roots_jacobi(60, exponent, exponent)

    def smooth(s: Array) -> Array:
        share = np.asarray(s)[:, None]
        end = np.arccos(share)
        psi = end * nodes
        # cos ψ - s as a product, over 1 - t².
        inside = 2.0 * np.sin(0.5 * end * (1.0 + nodes)) * np.sin(0.5 * end * (1.0 - nodes)) / (1.0 - nodes**2)
        integral = end[:, 0] * (weights * inside**exponent * np.cos(psi) ** along).sum(axis=1)
        return np.asarray(integral / (1.0 - share[:, 0]) ** (exponent + 0.5), dtype=np.float64)

    series = Chebyshev.interpolate(smooth, _ORDER, domain=[0.0, 1.0])
    return np.array(series.coef, dtype=np.float64)


@compiled
def _chebyshev(coefficients: Array, s: float) -> tuple[float, float]:
    """Value and derivative of a Chebyshev series on 0 to 1 (Clenshaw)."""
    y = 2.0 * s - 1.0
    b1 = b2 = d1 = d2 = 0.0
    for k in range(coefficients.size - 1, 0, -1):
        b1, b2, d1, d2 = coefficients[k] + 2.0 * y * b1 - b2, b1, 2.0 * b1 + 2.0 * y * d1 - d2, d1
    return coefficients[0] + y * b1 - b2, 2.0 * (b1 + y * d1 - d2)


@compiled
def push(law: Law | np.record, r: float) -> tuple[float, float]:
    """Force (N) and stiffness dF/dr (N/m) of a bearing displaced by r ≥ 0 (m)."""
    beyond = r - law.half_clearance
    if beyond <= 0.0:
        return 0.0, 0.0
    if not law.rollers:
        secant = law.stiffness
        if law.exponent != 1.0:
            secant *= beyond ** (law.exponent - 1.0)
        return secant * beyond, law.exponent * secant
    s = law.half_clearance / r
    value, rise = _chebyshev(law.factor, s)
    root = law.stiffness * r ** (1.0 / 9.0)
    narrow = (1.0 - s) ** (11.0 / 18.0)
    whole = (1.0 - s) * narrow * value
    by_share = narrow * ((1.0 - s) * rise - 29.0 / 18.0 * value)
    return root * r * whole, root * (10.0 / 9.0 * whole - s * by_share)


@compiled
def stored(law: Law | np.record, r: float) -> float:
    """Energy of a bearing displaced by r, ∫ F dr, J."""
    beyond = r - law.half_clearance
    if beyond <= 0.0:
        return 0.0
    if not law.rollers:
        return float(push(law, r)[0] * beyond / (law.exponent + 1.0))
    s = law.half_clearance / r
    value, _ = _chebyshev(law.energy_factor, s)
    return float(law.stiffness / (_EXPONENT + 1.0) * r ** (19.0 / 9.0) * (1.0 - s) ** (47.0 / 18.0) * value)


@compiled
def by_clearance(law: Law | np.record, r: float) -> float:
    """Derivative of a bearing's force by its diametral clearance, N/m."""
    if r <= law.half_clearance:
        return 0.0
    if not law.rollers:
        return -0.5 * push(law, r)[1]
    s = law.half_clearance / r
    value, rise = _chebyshev(law.factor, s)
    by_share = (1.0 - s) ** (11.0 / 18.0) * ((1.0 - s) * rise - 29.0 / 18.0 * value)
    return float(0.5 * law.stiffness * r ** (1.0 / 9.0) * by_share)
