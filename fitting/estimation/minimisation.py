"""The last search for the best values by lmfit, and profiles of single unknowns.

lmfit sees the unknowns that a person sees: errors, bench and bearings. The scatter of pins and teeth is marginalised:
wherever the others are, it has its most likely values, found in the linear model of that place. With rows for the
priors the sum of squares has its minimum, and the same curvature there, as that of all unknowns.
"""

from __future__ import annotations

import copy
import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value
from fitting.estimation.fit import Estimate
from fitting.model.gaussian import Gaussian
from fitting.model.identifiability import chosen_errors
from fitting.model.observations import Observations, State, linearise, spread_of
from fitting.model.unknowns import Unknowns, possible

if TYPE_CHECKING:
    import lmfit

Array = NDArray[np.float64]

_CLOSE = 1e-10  # relative change of sum of squares or of the unknowns at which a search ends
_PROFILE_GAIN = 0.01  # of the rise: where a search for the end of a profile interval ends
_EVALUATIONS = 60  # of a search, which needs two to five
_REACHES = (1.3, 4.0, 16.0)  # half intervals within which the end of a profile interval is searched
_FAR = 1e3  # times the residual where no contacts carry the load


class Search:
    """Search for the best values from the end of a fit, its noise and scatter's size held.

    Parameters
    ----------
    estimate
        The end of the fit.
    """

    def __init__(self, estimate: Estimate) -> None:
        self.start = estimate
        unknowns = estimate.unknowns
        self._seen = slice(0, unknowns.scatter.start)
        self._names = unknowns.names[self._seen]
        information = estimate.posterior.information
        own = Gaussian(information[unknowns.scatter, unknowns.scatter])
        self._follows = -own.solve(information[unknowns.scatter, self._seen])
        self._last: tuple[Array, Estimate, Array, Array] | None = None

    @cached_property
    def parameters(self) -> lmfit.Parameters:
        """All errors, the bench and the bearings, SI: where the search starts."""
        return parameters_of(self.start)

    def minimizer(self, close: float = _CLOSE) -> lmfit.Minimizer:
        """Return the search as lmfit has it, to end at a relative change of the sum of squares."""
        tolerances = {"ftol": close, "xtol": _CLOSE, "gtol": _CLOSE}
        return _minimizer()(self._residual, self.parameters, Dfun=self._jacobian, scale_covar=False, **tolerances)

    @cached_property
    def result(self) -> lmfit.minimizer.MinimizerResult:
        """Where the search ended; its covariance is that of the data and the priors."""
        return self.minimizer().least_squares(max_nfev=_EVALUATIONS, x_scale="jac")

    @cached_property
    def end(self) -> Estimate:
        """The fit there, its scatter at its most likely values; where it started if nothing is better."""
        vector = self._vector(self.result.params)
        there = self._evaluated(vector)[1]
        scatter = self.start.unknowns.scatter
        free = np.ones(vector.size, bool)
        free[scatter] = False
        whole = there.vector + there.posterior.holding(free).mean
        found = self._estimate(whole)
        first = dataclasses.replace(self.start, misfit=self.start.misfit_with_priors)
        best = min(first, there, found, key=lambda one: one.misfit)
        return dataclasses.replace(
            best,
            evaluations=self.start.evaluations + int(self.result.nfev),
            unlikelihood=self.start.unlikelihood + best.misfit - first.misfit,
        )

    def interval(self, name: str, half: float, rise: float) -> tuple[float, float]:
        """Profile interval of one unknown: its range until the best fit with it is worse by `rise`.

        Unlike the interval by standard error it need not be symmetrical, and it does not assume a linear model
        (Venzon and Moolgavkar, Applied Statistics 37 (1988) 87).

        Parameters
        ----------
        name, half
            The unknown, and half its interval by the standard error, SI.
        rise
            Of the sum of squares in units of the noise: the square of the quantile of Student's t.

        Returns
        -------
        low, high
            SI; infinite if the rise is not reached within sixteen times `half`.
        """
        from lmfit import conf_interval

        def share(best: Any, other: Any) -> float:
            return float(1.0 - 1.0 / (1.0 + max(other.chisqr - best.chisqr, 0.0) / rise))

        minimizer = self.minimizer(_PROFILE_GAIN * rise / self.result.chisqr)
        low = high = np.nan
        for reach in _REACHES:
            result = copy.deepcopy(self.result)
            one = result.params[name]
            one.min, one.max = max(one.min, one.value - reach * half), min(one.max, one.value + reach * half)
            one.stderr = half
            minimizer.best = self.result
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a bound that is reached is the next reach
                found = conf_interval(minimizer, result, [name], [0.5], prob_func=share)[name]
            low, high = found[0][1], found[-1][1]
            if np.isfinite([low, high]).all():
                break
        return float(low), float(high)

    def _vector(self, parameters: Mapping[str, lmfit.Parameter]) -> Array:
        """All unknowns, the scatter as it follows the others in the linear model of the start."""
        unknowns, vector = self.start.unknowns, self.start.vector.copy()
        values = np.array([parameters[name].value for name in self._names])
        vector[self._seen] = values / unknowns.scale[self._seen]
        best = self.start.posterior.mean
        moved = vector[self._seen] - self.start.vector[self._seen] - best[self._seen]
        vector[unknowns.scatter] += best[unknowns.scatter] + self._follows @ moved
        return vector

    def _estimate(self, vector: Array) -> Estimate:
        state = self.start.unknowns.state(vector)
        linear = linearise(self.start.pair, self.start.observed, state)
        there = dataclasses.replace(self.start, state=state, linear=linear)
        return dataclasses.replace(there, misfit=there.misfit_with_priors)

    def _evaluated(self, vector: Array) -> tuple[Array, Estimate, Array, Array]:
        """The fit at a vector, its residual with a row for each prior, and derivatives by the seen unknowns in SI."""
        if self._last is None or not np.array_equal(self._last[0], vector):
            there, unknowns = self._estimate(vector), self.start.unknowns
            weight = np.sqrt(there.precision)
            earlier, told = unknowns.earlier_rows(vector)
            columns = np.vstack([there.columns, np.diag(weight), earlier])
            residual = np.concatenate([there.residual, -weight * vector, told])
            scatter = columns[:, unknowns.scatter]
            own = Gaussian(scatter.T @ scatter)
            residual = residual - scatter @ own.solve(scatter.T @ residual)
            seen = columns[:, self._seen] / unknowns.scale[self._seen]
            seen -= scatter @ own.solve(scatter.T @ seen)
            self._last = vector, there, residual, -seen
        return self._last

    def _residual(self, parameters: lmfit.Parameters) -> Array:
        try:
            return self._evaluated(self._vector(parameters))[2]
        except edge.InputError:
            # So far away no contacts balance the load.
            return _FAR * self._evaluated(self._vector(self.parameters))[2]

    def _jacobian(self, parameters: lmfit.Parameters) -> Array:
        vector, _, _, slopes = self._evaluated(self._vector(parameters))
        unknowns = self.start.unknowns
        varying = [
            self._names.index(name) for name, parameter in parameters.items() if parameter.vary and name in self._names
        ]
        along = unknowns.along(vector)
        if along is not None:
            scale = unknowns.scale[self._seen]
            slopes = slopes @ (scale[:, None] * along[self._seen, self._seen] / scale)
        return slopes[:, varying]


def _minimizer() -> Any:
    """Lmfit's `Minimizer`, which in a profile begins with the other unknowns where the linear model has them."""
    from lmfit import Minimizer, Parameters
    from lmfit.minimizer import MinimizerResult

    class Profiling(Minimizer):  # type: ignore[misc]
        best: MinimizerResult | None = None

        def prepare_fit(self, params: Parameters | None = None) -> MinimizerResult:
            if params is not None and self.best is not None:
                names = self.best.var_names
                held = [i for i, name in enumerate(names) if not params[name].vary]
                if held:
                    moved = np.array([params[names[i]].value - self.best.params[names[i]].value for i in held])
                    shift = self.best.covar[:, held] @ np.linalg.solve(self.best.covar[np.ix_(held, held)], moved)
                    for i, name in enumerate(names):
                        if i not in held:
                            params[name].value = self.best.params[name].value + shift[i]
            return super().prepare_fit(params)

    return Profiling


def parameters_of(estimate: Estimate) -> lmfit.Parameters:
    """Return the unknowns of a fit that a person sees as lmfit parameters, SI: errors, bench and bearings."""
    unknowns = estimate.unknowns
    return _as_parameters(unknowns, estimate.observed, estimate.vector * unknowns.scale, estimate.chosen)


def default_parameters(pair: Pair, observed: Observations) -> lmfit.Parameters:
    """Return the same before a fit, at the stated errors of a pair: errors vary that the observations resolve there."""
    unknowns = Unknowns(pair, observed, observed.errors)
    zero = State(unknowns.prior, np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]))
    chosen = chosen_errors(pair, observed, linearise(pair, observed, zero), {})
    return _as_parameters(unknowns, observed, unknowns.vector(zero) * unknowns.scale, chosen)


def names_of(pair: Pair, observed: Observations) -> list[str]:
    """Return the names of all unknowns that a person sees: errors, bench and bearings."""
    unknowns = Unknowns(pair, observed, observed.errors)
    return unknowns.names[: unknowns.scatter.start]


def _as_parameters(
    unknowns: Unknowns, observed: Observations, values: Array, chosen: Sequence[str]
) -> lmfit.Parameters:
    from lmfit import Parameters

    parameters, decided = Parameters(), unknowns.constraints
    for at, name in enumerate(unknowns.names[: unknowns.scatter.start]):
        varies = (name in chosen or name not in observed.errors) and (decided is None or name not in decided.held)
        low, high = (unknowns.low[at], unknowns.high[at]) if unknowns.low[at] < unknowns.high[at] else (-np.inf, np.inf)
        parameters.add(name, float(values[at]), vary=varies, min=float(low), max=float(high))
    for name in observed.errors:
        if name not in parameters:
            low, high = possible(unknowns.pair, name)
            parameters.add(name, structured_value(unknowns.prior, name), vary=False, min=low, max=high)
    for name, expression in decided.ties.items() if decided is not None else ():
        if name in parameters:
            parameters[name].expr = expression
    return parameters
