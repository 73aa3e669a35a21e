"""The unknowns of a fit: one table of them, in one order, and their derivatives.

Errors come first, then the bench, friction, the crank's zero, the bearings, and last the scatter of single pins and
teeth. Bench to bearings are the nuisances: they are no part of the error surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.errors.kinds import LARGEST_DEVIATION, LARGEST_MISALIGNMENT
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import profile_names, structured_value, unit_of, with_structured
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT, ErrorSurface, surface_of_pair
from fitting.model.bearings import unit_of_bearing
from fitting.model.gaussian import Evidence
from fitting.model.observations import (
    CHAIN,
    KNOWN_SIZES,
    PROFILE_ORDERS,
    Linear,
    Observations,
    State,
    scatter_names,
    scatter_parts,
    with_scatter,
)
from fitting.model.prior import tolerances_of

Array = NDArray[np.float64]

UNKNOWN = 1e-6  # precision of unknowns without a prior, so that those without effect on these curves stay unchanged
NO_SCATTER = 1e-8  # m: a scatter below this changes nothing that a bench can see
_BENCH_SCALE, _CRANK_SCALE, _CREEP_SCALE = 1e-4, 1e-2, 1e-6  # rad
_SCATTER_SCALE = {"m": 1e-6, "rad": 1e-4}
_DIFFERENCE = 1e-3  # step of the derivatives of expressions, in units of an unknown's scale
_FRICTION_UNITS = {"loop_friction_per_load": "1"}


def possible(pair: Pair, name: str) -> tuple[float, float]:
    """Return the possible range of an error, m or rad: the limits of a pair file, and of a valid gear pair."""
    g = pair
    high = {"m": LARGEST_DEVIATION, "rad": LARGEST_MISALIGNMENT}[unit_of(name)]
    high = LARGEST_ELEMENT if name in profile_names(PROFILE_ORDERS) else high
    low = -high
    if name == "eccentricity":
        low, high = max(low, -g.eccentricity), min(high, g.pin_circle_radius / g.pins - g.eccentricity)
    if name == "pin_circle_radius":
        low = max(low, g.eccentricity * g.pins - g.pin_circle_radius)
    if name == "pin_radius":
        touching = g.pin_circle_radius * np.sin(np.pi / g.pins)
        low, high = max(low, -g.pin_radius), min(high, float(touching) - g.pin_radius)
    return low, high


class Unknowns:
    """All unknowns of a fit as one vector, each in units of a usual size.

    Parameters
    ----------
    pair, observed
        The nominal pair and the observations.
    errors
        The structured errors that are fitted.
    prior
        The surface that has the other errors; by default that of the pair file.

    Attributes
    ----------
    names, units, scale
        Of each unknown: name, SI unit, and the size in whose units the vector is.
    low, high
        Bounds of each unknown, SI; infinite where there are none.
    parts
        {group: its unknowns}, of which all have the same prior size: patterns of the scatter, and groups of the bench
        whose size is estimated.
    errors, bench, nuisances, bearings, scatter
        Slices of the vector.
    """

    def __init__(
        self, pair: Pair, observed: Observations, errors: Sequence[str], prior: ErrorSurface | None = None
    ) -> None:
        self.pair, self.chosen = pair, list(errors)
        before = observed.earlier
        usual_prior = surface_of_pair(pair) if before is None else before.plain
        self.prior = usual_prior if prior is None else prior
        self.fit_crank, self.with_loops = observed.fit_crank, observed.with_loops
        crank, of_scatter = ["crank_angle_offset"] * observed.fit_crank, scatter_parts(pair)
        friction, scatter = observed.friction_names, scatter_names(pair)
        self.names = [*errors, *observed.bench_names, *friction, *crank, *observed.bearing_names, *scatter]
        ends = np.cumsum([len(self.chosen), len(observed.bench_names), len(friction), len(crank)]).tolist()
        ends += [ends[-1] + len(observed.bearing_names), len(self.names)]
        self.errors, self.bench = slice(0, ends[0]), slice(ends[0], ends[1])
        self.bearings, self.scatter = slice(ends[3], ends[4]), slice(ends[4], ends[5])
        self.nuisances = slice(ends[0], ends[4])
        of_scatter = {n: slice(p.start + ends[4], p.stop + ends[4]) for n, p in of_scatter.items()}
        of_bench = {n: slice(p.start + ends[0], p.stop + ends[0]) for n, p in observed.estimated.items()}
        own = set() if before is None else set(before.names)
        groups = {**of_scatter, **of_bench}
        self.parts = {n: p for n, p in groups.items() if not own & set(self.names[p])}
        self._least = {**dict.fromkeys(of_scatter, 1e-2 * NO_SCATTER), **{n: observed.least(n) for n in of_bench}}
        usual = np.array([observed.profile.get(n, np.inf) for n in errors])
        usual = np.concatenate([usual, observed.bench_prior, observed.friction_priors, np.full(len(crank), np.inf)])
        usual = np.concatenate([usual, observed.bearing_prior, np.full(len(scatter), np.inf)])
        self.scale = np.where(np.isfinite(usual), usual, _BENCH_SCALE)
        self.scale[self.errors] = tolerances_of(errors, observed.profile)
        rubs = ~np.isfinite(observed.friction_priors)
        self.scale[ends[1] : ends[2]][rubs] = observed.friction_prior
        self.scale[ends[2] : ends[3]] = _CRANK_SCALE
        for name, part in of_scatter.items():
            self.scale[part] = _SCATTER_SCALE[unit_of(name)]
        for name, part in of_bench.items():
            self.scale[part] = self.scale[part] if name == CHAIN else _CREEP_SCALE
        is_told = np.array([name in own for name in self.names], bool)
        self.known = np.where(np.isfinite(usual) & ~is_told, 1.0, UNKNOWN)
        self._before = None if before is None else before.rows(self.names, self.scale)
        self._sizes = {**KNOWN_SIZES, **{n: float(usual[part.start]) for n, part in of_bench.items()}}
        self.low, self.high = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        self.low[self.errors], self.high[self.errors] = np.reshape([possible(pair, n) for n in errors], (-1, 2)).T
        self.low[self.bearings] = observed.bearing_lowest
        self.constraints = observed.constraints
        self._fixed, self._tied = np.zeros(len(self.names), bool), dict[int, str]()
        if (decided := self.constraints) is not None:
            for at, name in enumerate(self.names[: self.scatter.start]):
                low, high = decided.bounds.get(name, (-np.inf, np.inf))
                self.low[at], self.high[at] = max(low, self.low[at]), min(high, self.high[at])
                if name in decided.held:
                    self._fixed[at], self.low[at], self.high[at] = True, decided.held[name], decided.held[name]
                if name in decided.ties:
                    self._tied[at], self.low[at], self.high[at] = name, -np.inf, np.inf
        self._columns_of_errors = [observed.errors.index(n) for n in errors]
        self.units = [
            *map(unit_of, errors),
            *("rad/(N*m)" if n == CHAIN else "rad" for n in observed.bench_names),
            *(_FRICTION_UNITS.get(n, "N*m") for n in friction),
            *["rad"] * len(crank),
            *map(unit_of_bearing, observed.bearing_names),
            *(unit_of(n.rpartition("_at_")[0]) for n in scatter),
        ]

    def vector(self, state: State) -> Array:
        """Return the vector of a state."""
        plain = with_scatter(state.surface, -state.scatter)
        errors = [structured_value(plain, n) for n in self.chosen]
        crank = [state.crank_offset] if self.fit_crank else []
        friction = [state.friction]
        friction += [state.loop_friction, state.loop_friction_per_load] if self.with_loops else []
        bearings = state.bearings if state.bearings.size else np.zeros(self.bearings.stop - self.bearings.start)
        values = np.concatenate([errors, state.bench, friction, crank, bearings, state.scatter])
        scaled: Array = values / self.scale
        return scaled

    def state(self, vector: Array) -> State:
        """Return the state of a vector."""
        values = vector * self.scale
        errors = dict(zip(self.chosen, values[self.errors], strict=True))
        friction, scatter = values[self.bench.stop :], values[self.scatter]
        return State(
            surface=with_scatter(with_structured(self.prior, errors), scatter),
            scatter=scatter,
            bench=values[self.bench],
            friction=float(friction[0]),
            loop_friction=float(friction[1]) if self.with_loops else 0.0,
            loop_friction_per_load=float(friction[2]) if self.with_loops else 0.0,
            crank_offset=float(values[self.bearings.start - 1]) if self.fit_crank else 0.0,
            bearings=values[self.bearings],
        )

    def columns(self, observed: Observations, linear: Linear) -> Array:
        """Return the model's derivatives by the unknowns in units of the noise, shape (points, unknowns)."""
        locked = observed.of_loops
        parts = [linear.structured[:, self._columns_of_errors], observed.bench]
        parts.append((linear.by_friction * ~locked)[:, None])
        if self.with_loops:
            parts += [(linear.by_friction * locked)[:, None], linear.by_friction_per_load[:, None]]
        if self.fit_crank:
            parts.append(linear.by_crank[:, None])
        columns = np.hstack([*parts, linear.bearings, linear.scatter])
        columns *= observed.weight[:, None]
        columns *= self.scale
        return columns

    def earlier_rows(self, vector: Array) -> tuple[Array, Array]:
        """Return what earlier measurements tell as rows of the linear model at a vector.

        Their model is linear about their end, from which bearings count. Windup is the sum of compliances, so it is
        linear in these, not in the logarithms of stiffnesses.

        Returns
        -------
        columns, residual
            In units of their noise, shape (rows, unknowns) and (rows,); no rows without earlier measurements.
        """
        if self._before is None:
            return np.zeros((0, vector.size)), np.zeros(0)
        columns, values = self._before
        distance, slope = vector.copy(), np.ones(vector.size)
        stiffness = [at for at in range(*self.bearings.indices(vector.size)) if self.names[at].endswith("_stiffness")]
        slope[stiffness] = np.exp(-vector[stiffness] * self.scale[stiffness])
        distance[stiffness] = (1.0 - slope[stiffness]) / self.scale[stiffness]
        return columns * slope, values - columns @ distance

    def earlier(self, vector: Array) -> Evidence:
        """Return what earlier measurements tell at a vector."""
        return Evidence.of(*self.earlier_rows(vector))

    def within(self, vector: Array) -> Array:
        """Return the nearest vector within the bounds whose tied unknowns are what their expressions say."""
        inside = np.clip(vector, self.low / self.scale, self.high / self.scale)
        for at, value in self._values_of_ties(inside).items():
            inside[at] = value / self.scale[at]
        return inside

    def is_stuck(self, vector: Array, slope: Array) -> NDArray[np.bool_]:
        """Which unknowns are at a bound beyond which a step along the slope would go."""
        low, high = self.low / self.scale, self.high / self.scale
        stuck: NDArray[np.bool_] = ((vector <= low) & (slope < 0.0)) | ((vector >= high) & (slope > 0.0))
        return stuck

    def _values_of_ties(self, vector: Array) -> dict[int, float]:
        if not self._tied or self.constraints is None:
            return {}
        seen = slice(0, self.scatter.start)
        values = dict(zip(self.names[seen], (vector * self.scale)[seen].tolist(), strict=True))
        tied = self.constraints.tied(values)
        return {at: tied[name] for at, name in self._tied.items()}

    def along(self, vector: Array) -> Array | None:
        """Return how all unknowns move with those that are free (`Gaussian`); None if all are free.

        Derivatives of expressions are central differences over a thousandth of each unknown's scale.
        """
        if not self._tied and not self._fixed.any():
            return None
        along = np.diag((~self._fixed).astype(float))
        along[:, [*self._tied]] = 0.0
        free = np.flatnonzero(np.diag(along)[: self.scatter.start]).tolist()
        for at in free if self._tied else ():
            step = np.zeros(vector.size)
            step[at] = _DIFFERENCE
            ends = self._values_of_ties(vector + step), self._values_of_ties(vector - step)
            for tied in self._tied:
                along[tied, at] = (ends[0][tied] - ends[1][tied]) / (2.0 * _DIFFERENCE * self.scale[tied])
        return along

    def precision(self, sizes: Mapping[str, float]) -> Array:
        """Return the prior precision of each unknown, 1/variance in its scale, from the sizes of `parts`.

        Of other groups it is the usual one, or that of no scatter.
        """
        precision: Array = self.known.copy()
        for name, part in self.parts.items():
            size = max(sizes.get(name, self._sizes.get(name, 0.0)), self._least[name])
            precision[part] = (self.scale[part.start] / size) ** 2
        return precision

    def least(self, group: str) -> float:
        """Return the smallest size of a group of `parts`, SI."""
        return self._least[group]
