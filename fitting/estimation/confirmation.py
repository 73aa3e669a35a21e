"""The last step of a fit, within possible values: it confirms the optimum and gives its covariance."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.surfaces.structured import structured_value
from fitting.estimation.fit import Estimate, fit
from fitting.model.unknowns import possible

if TYPE_CHECKING:
    import lmfit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Confirmed:
    """One unknown at the end of the fit, SI; its attributes have the names of lmfit.

    Attributes
    ----------
    value, min, max
        Value, and its bounds.
    vary
        Whether it was fitted.
    stderr, correl
        Standard error, and {name: correlation} with the others that were fitted.
    expr
        Expression of others to which it is tied.
    """

    value: float
    min: float
    max: float
    vary: bool
    stderr: float | None = None
    correl: Mapping[str, float] | None = None
    expr: str | None = None


def with_covariance(parameters: Mapping[str, Confirmed], covariance: Array) -> dict[str, Confirmed]:
    """Return the first parameters, as many as have a covariance, with their errors from it."""
    names, deviation = list(parameters)[: len(covariance)], np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.where(deviation > 0.0, deviation, 1.0)
    correlation = (covariance / np.outer(size, size)).tolist()

    def of_others(name: str, row: Sequence[float]) -> dict[str, float] | None:
        if not parameters[name].vary:
            return None
        return {n: c for n, c in zip(names, row, strict=True) if n != name and parameters[n].vary}

    return {
        name: dataclasses.replace(parameters[name], stderr=float(one), correl=of_others(name, row))
        for name, one, row in zip(names, deviation, correlation, strict=True)
    }


def lmfit_states(parameters: Mapping[str, Confirmed]) -> dict[str, Any]:
    """Return parameters in the form of `lmfit.Parameters.dumps`, without the pickles of its functions.

    lmfit itself is not needed: loading it took 0.8 s of processor time, half as much as a fit of six recordings.
    """
    return {
        "unique_symbols": {name: p.value for name, p in parameters.items()},
        "params": [
            [name, p.value, p.vary, p.expr, p.min, p.max, None, p.stderr, p.correl, p.value, None]
            for name, p in parameters.items()
        ],
    }


def as_lmfit(parameters: Mapping[str, Confirmed]) -> lmfit.Parameters:
    """Return lmfit parameters."""
    from lmfit import Parameters

    found = Parameters()
    for name, p in parameters.items():
        found.add(name, p.value, vary=p.vary, min=p.min, max=p.max)
        found[name].stderr, found[name].correl = p.stderr, None if p.correl is None else dict(p.correl)
    for name, p in parameters.items():
        if p.expr is not None:
            found[name].expr = p.expr
            found[name].stderr = p.stderr
    return found


def confirmed(estimate: Estimate, gain: float) -> Estimate:
    """Take the last step of a fit, with its noise and scatter; return the fit there, or as it was if that is better.

    Parameters
    ----------
    estimate
        The end of the fit.
    gain
        A step with a smaller predicted gain of the sum of squares in units of the noise is not taken.
    """
    end = fit(
        estimate.pair,
        estimate.observed,
        estimate.chosen,
        estimate.state,
        estimate.scatter,
        gain=gain,
        linear=estimate.linear,
        evaluations=1,
        estimated=False,
        damping=0.0,
    )
    evaluations = estimate.evaluations + end.evaluations
    return dataclasses.replace(end, evaluations=evaluations, disagreeing=estimate.disagreeing)


def stated(estimate: Estimate) -> tuple[dict[str, Confirmed], Array]:
    """Return every error, the bench and the scatter of every pin and tooth, SI, and the covariance of what was fitted.

    Errors that are not fitted come last, and do not vary.
    """
    unknowns, decided = estimate.unknowns, estimate.unknowns.constraints
    covariance: Array = estimate.posterior.covariance * np.outer(unknowns.scale, unknowns.scale)
    every = zip(unknowns.names, estimate.vector * unknowns.scale, unknowns.low, unknowns.high, strict=True)
    parameters = {name: Confirmed(float(value), float(low), float(high), vary=True) for name, value, low, high in every}
    for name in estimate.observed.errors:
        if name not in estimate.chosen:
            low, high = possible(estimate.pair, name)
            parameters[name] = Confirmed(structured_value(unknowns.prior, name), low, high, vary=False)
    for name in parameters.keys() & (set() if decided is None else {*decided.held, *decided.ties}):
        expression = None if decided is None else decided.ties.get(name)
        parameters[name] = dataclasses.replace(parameters[name], vary=False, expr=expression, min=-np.inf, max=np.inf)
    return parameters, covariance
