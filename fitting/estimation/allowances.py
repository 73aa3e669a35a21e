"""Allowances of a fit for held errors, and for a form that all flanks share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from fitting.estimation.fit import Estimate
from fitting.estimation.parameter import NORMAL, Parameter, parameter
from fitting.model.bearings import as_stated, is_logarithmic, unit_of_bearing
from fitting.model.discrepancy import LAG, by_lag
from fitting.model.gaussian import Evidence
from fitting.model.losses import SCATTER_OF_COEFFICIENTS, is_coefficient
from fitting.model.observations import MISFIT, Linear, Observations, form_columns
from fitting.model.prior import tolerances_of
from fitting.model.unknowns import Unknowns

Array = NDArray[np.float64]

_SINGULAR = 1e16  # condition number of equations without information, as from curves without noise: 1/epsilon
_WIDE, _WIDEST = 2.0, 4  # times as wide for a form of the flanks: from where a note names it, and how many
LAG_NAME = f"{MISFIT}_{LAG}_0"
_RESOLVED = 0.1  # share of a bearing's variance that the data must take away: less does not separate it from the errors


def moved_by_held(fit: Estimate, names: Sequence[str]) -> Array:
    """Change of the fitted unknowns by held errors of usual size.

    A held error moves the curves nearly as fitted ones do; the difference moves other errors. Considered in the sense
    of Schmidt (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 8).

    Parameters
    ----------
    fit
        The end of the fit.
    names
        The held errors.

    Returns
    -------
    moved
        Shape (unknowns, names), SI: each for one standard deviation of an error.
    """
    held = fit.linear.structured[:, [fit.observed.errors.index(n) for n in names]]
    held = held * tolerances_of(names, fit.observed.profile) * fit.observed.weight[:, None]
    # Estimates of earlier measurements have moved with the same errors: with them as a prior that does not move, each
    # error that the fitted ones represent would seem to contradict it.
    alone = Unknowns(fit.pair, dataclasses.replace(fit.observed, earlier=None), fit.chosen)
    posterior = Evidence.of(fit.columns).posterior(alone.precision(fit.scatter), along=alone.along(fit.vector))
    moved: Array = posterior.solve(fit.columns.T @ held) * fit.unknowns.scale[:, None]
    return moved


def moved_by_form(fit: Estimate, form: float) -> Array:
    """Possible effect of a form that all flanks share on the fitted unknowns: covariance of all of them, SI.

    The orders of the form are added to the unknowns of the linear model, with their sizes as prior. The stated errors
    are those without form, so the effect of form on the best estimate is included.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations are singular.
    """
    observed, own = fit.observed, fit.columns
    by_form = form * observed.weight[:, None] * form_columns(fit.pair, observed, fit.state, fit.linear, form)
    # The fit ends where a step gains little. At the optimum, where its own unknowns have no slope, the form's slope can
    # be another: the deviation of an eccentricity was 0.24 or 0.46 µm from starts that differed little.
    alone = fit.posterior
    residual = fit.residual - own @ alone.mean
    count = own.shape[1]
    formed = alone.extended(own.T @ by_form, by_form.T @ by_form + np.eye(by_form.shape[1]))
    if max(formed.condition, alone.condition) > _SINGULAR:
        raise np.linalg.LinAlgError("singular")
    cross, of_form = formed.covariance[:count, count:], formed.covariance[count:, count:]
    moved = cross @ (by_form.T @ residual)
    grown = cross @ np.linalg.solve(of_form, cross.T) + np.outer(moved, moved)
    covariance: Array = grown * np.outer(fit.unknowns.scale, fit.unknowns.scale)
    return covariance


def allowing(one: Parameter, form: float, before: float) -> Parameter:
    """Return a parameter whose interval allows for the effect of a form of the flanks."""
    reach = NORMAL * form
    low, high = (
        one.value + way * math.hypot(end - one.value, reach) for way, end in zip((-1.0, 1.0), one.interval, strict=True)
    )
    sigma = math.hypot(one.standard_error, form)
    share = max(1.0 - (sigma / before) ** 2, 0.0)
    return dataclasses.replace(one, standard_error=sigma, interval=(low, high), data_share=share, form=form)


def form_note(parameters: Sequence[Parameter], form: float) -> list[str]:
    """Return a note on the widened intervals by allowing for a form (m); none if no interval widens much."""
    times = {p.name: p.standard_error / math.sqrt(p.standard_error**2 - p.form**2) for p in parameters if p.form}
    wide = sorted((n for n, v in times.items() if v > _WIDE), key=lambda n: -times[n])
    if not wide:
        return []
    named = ", ".join(f"{n} {times[n]:.2g}" for n in wide[:_WIDEST]) + " and others" * (len(wide) > _WIDEST)
    return [
        f"The curves cannot separate a form of the flanks of {form * 1e6:g} µm from these errors, whose intervals are "
        f"therefore wider (times): {named}. Where the flanks' form is known, state it: form, or gear_profile of "
        "the tolerances."
    ]


def bearings_found(
    pair: Pair, observed: Observations, changes: Array, deviations: Sequence[float] | Array
) -> list[Parameter]:
    """Return the results for bearings and friction: those of stiffnesses and coefficients are of their logarithms."""
    parameters, names = [], observed.bearing_names
    values = as_stated(pair, changes, observed.first_stage)
    for name, value, sigma, before in zip(names, values, deviations, observed.bearing_prior, strict=True):
        is_share = is_logarithmic(name)
        scale = value if is_share else 1.0
        sigma *= SCATTER_OF_COEFFICIENTS if is_coefficient(name) else 1.0
        reach = NORMAL * sigma
        interval = (
            (value * math.exp(-reach), value * math.exp(reach))
            if is_share
            else (max(value - reach, 0.0), value + reach)
        )
        share = max(1.0 - (sigma / before) ** 2, 0.0)
        why = None if share > _RESOLVED else "these curves do not separate it from the errors"
        parameters.append(Parameter(name, unit_of_bearing(name), float(value), scale * sigma, interval, share, why))
    return parameters


def clock_lag_found(observed: Observations, linear: Linear, coefficient: float, deviation: float) -> Parameter:
    """Return the delay of the output angle, from the coefficient (rad) of that cause of misfit.

    The fit uses the cause's column at its start; the time is from the derivative at its end.
    """
    column = observed.bench[:, observed.bench_names.index(LAG_NAME)]
    late = by_lag(observed, linear)
    seconds = float(column @ late / (late @ late))
    return parameter("clock_lag", "s", coefficient * seconds, deviation * abs(seconds), math.inf)


def lag_note(lag: Parameter) -> str:
    """Return a note on a clock's lag."""
    angle, size = ("output", lag.value) if lag.value > 0.0 else ("input", -lag.value)
    reach = "" if math.isnan(lag.interval[0]) else f" ± {0.5 * (lag.interval[1] - lag.interval[0]) * 1e6:.2g}"
    return f"The {angle} angle's clock is {size * 1e6:.4g}{reach} µs late (95 %); the fit corrects it."
