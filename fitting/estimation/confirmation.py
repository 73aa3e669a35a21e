"""The last step of a fit, within possible values: it confirms the optimum and gives its covariance."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.surfaces.structured import structured_value
from fitting.estimation.fit import Estimate
from fitting.model.observations import linearise
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
    """

    value: float
    min: float
    max: float
    vary: bool
    stderr: float | None = None
    correl: Mapping[str, float] | None = None


def with_covariance(parameters: Mapping[str, Confirmed], covariance: Array) -> dict[str, Confirmed]:
    """Return the first varying parameters, as many as have a covariance, with their errors from it."""
    names = [n for n, p in parameters.items() if p.vary][: len(covariance)]
    deviation = np.sqrt(np.diag(covariance))
    correlation = (covariance / np.outer(deviation, deviation)).tolist()
    return {
        name: dataclasses.replace(
            parameters[name],
            stderr=float(deviation[at]),
            correl={n: c for n, c in zip(names, correlation[at], strict=True) if n != name},
        )
        for at, name in enumerate(names)
    }


def lmfit_states(parameters: Mapping[str, Confirmed]) -> dict[str, Any]:
    """Return parameters in the form of `lmfit.Parameters.dumps`, without the pickles of its functions.

    lmfit itself is not needed: loading it took 0.8 s of processor time, half as much as a fit of six recordings.
    """
    return {
        "unique_symbols": {name: p.value for name, p in parameters.items()},
        "params": [
            [name, p.value, p.vary, None, p.min, p.max, None, p.stderr, p.correl, p.value, None]
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
    return found


def confirmed(estimate: Estimate, gain: float) -> tuple[Estimate, dict[str, Confirmed], Array]:
    """Take the last step of a fit, with its noise and scatter.

    It is an undamped Gauss-Newton step within the bounds: an unknown at a bound that would go beyond stays
    there.

    Parameters
    ----------
    estimate
        The end of the fit.
    gain
        A step with a smaller predicted gain of the sum of squares in units of the noise is not taken.

    Returns
    -------
    estimate
        At the optimum, or unchanged if that is no better.
    parameters
        Every error, the bench and every pin's and tooth's scatter, SI, with the bounds of `possible`; errors that are
        not fitted do not vary.
    covariance
        Of those that vary, in their order, SI.
    """
    pair, unknowns, observed = estimate.pair, estimate.unknowns, estimate.observed
    low, high, scale = unknowns.low, unknowns.high, unknowns.scale

    def evaluated(values: Array) -> Estimate:
        state = unknowns.state(values / scale)
        there = dataclasses.replace(estimate, state=state, linear=linearise(pair, observed, state))
        return dataclasses.replace(there, misfit=there.misfit_with_priors)

    ended = estimate.vector * scale
    start = np.clip(ended, low, high)
    inside = bool(np.allclose(start, ended, rtol=1e-9, atol=0.0))
    first = dataclasses.replace(estimate, misfit=estimate.misfit_with_priors) if inside else evaluated(start)
    best, slope = first, first.posterior.slope
    step = first.posterior.holding(((start <= low) & (slope < 0.0)) | ((start >= high) & (slope > 0.0))).mean
    taken = not inside or slope @ step >= gain
    if taken:
        then = evaluated(np.clip(start + step * scale, low, high))
        best = min(first, then, key=lambda one: one.misfit)
    covariance = best.posterior.covariance * np.outer(scale, scale)
    values = best.vector * scale
    stated = zip(unknowns.names, values.tolist(), low.tolist(), high.tolist(), strict=True)
    parameters = {name: Confirmed(value, least, most, vary=True) for name, value, least, most in stated}
    for name in observed.errors:
        if name not in estimate.chosen:
            parameters[name] = Confirmed(structured_value(unknowns.prior, name), *possible(pair, name), vary=False)
    found = dataclasses.replace(
        best,
        evaluations=estimate.evaluations + int(taken) + (not inside),
        unlikelihood=estimate.unlikelihood + best.misfit - first.misfit,
    )
    return found, parameters, covariance
