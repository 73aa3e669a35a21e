"""From transmission error curves to the drive's errors, what the data cannot tell, and the error surface.

The structured errors that the data tell apart are fitted through lmfit with the exact contact model and its analytic
Jacobian. What every single pin and tooth does beyond them is a random scatter of unknown size: it is estimated together
with the noise (restricted maximum likelihood), and where there is any it is part of the fit, so that it neither bends
the structured errors nor lets their intervals look smaller than they are.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from cycloid_fmu import edge
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.pair import Pair
from cycloid_fmu.surface import ErrorSurface, structured_value, surface_of_pair, unit_of, with_structured
from cycloid_fmu.transmission import solve
from fitting.curve import Curve
from fitting.identifiability import (
    chosen_errors,
    errors_of,
    posterior_covariance,
    tolerances_of,
    weakness,
)
from fitting.observation import (
    Linear,
    Observations,
    State,
    linearise,
    nuisance_columns,
    observations,
    scatter_names,
    scatter_parts,
    spread_of,
    with_scatter,
)

Array = NDArray[np.float64]
FORMAT = "cycloid-identification/1"

NO_SCATTER = 1e-8  # m: a scatter below this changes nothing that a bench can see
_CONFIDENCE = 0.95
_OUTLYING = 6.0  # robust standard deviations from the fit
_UNEXPLAINED = 3.0  # times its noise: a residual above this is another drive's
_START_POINTS = 500  # of all curves together, for the way from the prior
_STARTS = 3
_PASSES = 6  # of fit and estimate of noise and scatter in turn, which end where the residual stays within 1 %
_EVALUATIONS = 40  # of one fit, which a drive that is the one of the pair file needs ten to twenty of
# A fit ends where a step gains less than this of the sum of squares; the last one at a fraction of what noise moves it.
_START_GAIN, _STRUCTURED_GAIN, _GAIN = 1e-3, 1e-4, 2e-5


@dataclass(frozen=True)
class Parameter:
    """One structured error after the fit: SI value, standard error and 95 % interval, or why it is held.

    `data_share` says how much of what is known of it comes from the data: 1 less the ratio of its variance after and
    before measuring.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]
    data_share: float
    held: str | None = None


@dataclass(frozen=True)
class HeldOut:
    """Curves kept from the fit and predicted by it: their load in words, rms of what is left, and their noise, rad."""

    said: str
    residual: float
    noise: float


@dataclass(frozen=True)
class Identification:
    """The result of a fit.

    Attributes
    ----------
    parameters
        All structured errors, fitted and held.
    bench
        {name: value} of the bench's nuisances: zeros and encoder eccentricity (rad), compliance of the chain beside
        the gear pair (rad/(N·m)), friction torque (N·m).
    surface
        The identified error surface, the pins' and teeth's own scatter included.
    correlation
        Of the fitted parameters, in the order of `fitted`.
    singular_values, weak_combinations
        Of the Jacobian scaled by tolerance and noise (below 1 a combination is less known than before measuring), and
        the weak ones in words.
    noise, scatter
        Noise of a point (rad) and standard deviation of each scattered pattern (m).
    inflation
        By how much the standard errors are larger than white noise would make them, because the residual is not white.
    residual
        rms of measured less fitted transmission error, rad.
    outliers
        Points of each curve that were left out.
    held_out
        What a fit without some of the curves predicts of them, or None where too few were measured.
    fitted_curves
        Fitted transmission error of each curve, the bench's nuisances included, rad.
    checksums
        {source: SHA-256} of the data.
    notes
        What a reader should know of the data.
    """

    parameters: tuple[Parameter, ...]
    bench: dict[str, float]
    surface: ErrorSurface
    correlation: Array
    singular_values: Array
    weak_combinations: tuple[str, ...]
    noise: float
    scatter: dict[str, float]
    inflation: float
    residual: float
    outliers: tuple[int, ...]
    held_out: HeldOut | None
    fitted_curves: tuple[Array, ...]
    checksums: dict[str, str]
    notes: tuple[str, ...]

    @property
    def fitted(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(p.name for p in self.parameters if p.held is None)


@dataclass(frozen=True)
class _Fit:
    """A fit before it is reported; `excess` is its noise over that which the curves themselves show."""

    observed: Observations
    chosen: list[str]
    state: State
    excess: float
    scatter: dict[str, float]
    linear: Linear


def _components(
    residual: Array, fixed: Array, scatter: Array, parts: dict[str, slice], start: dict[str, float]
) -> tuple[float, dict[str, float]]:
    """Noise factor and scatter deviations by restricted maximum likelihood (MacKay's fixed point), all whitened."""
    q, _ = np.linalg.qr(fixed / np.maximum(np.linalg.norm(fixed, axis=0), 1e-300))
    left = residual - q @ (q.T @ residual)
    design = scatter - q @ (q.T @ scatter)
    gram, moment, total = design.T @ design, design.T @ left, left @ left
    freedom = np.count_nonzero(residual) - fixed.shape[1]
    variance = {name: max(start.get(name, 1e-7), 1e-8) ** 2 for name in parts}
    noise = max(total / freedom, 1e-12)
    for _ in range(200):
        prior = np.empty(gram.shape[0])
        for name, part in parts.items():
            prior[part] = 1.0 / variance[name]
        covariance = linalg.inv(gram / noise + np.diag(prior))
        mean = covariance @ moment / noise
        before = [noise, *variance.values()]
        told = 0.0
        for name, part in parts.items():
            known = mean[part].size - prior[part][0] * np.trace(covariance[part, part])
            told += known
            variance[name] = max((mean[part] @ mean[part]) / max(known, 1e-9), 1e-20)
        noise = max((total - 2.0 * mean @ moment + mean @ gram @ mean) / max(freedom - told, 1.0), 1e-12)
        if np.allclose(before, [noise, *variance.values()], rtol=1e-3, atol=0.0):
            break
    return float(np.sqrt(noise)), {name: float(np.sqrt(v)) for name, v in variance.items()}


def identify(
    curves: Sequence[Curve], pair: Pair, progress: Callable[[str], None] = lambda step: None, *, held_out: bool = True
) -> Identification:
    """Identify a drive's errors from its transmission error curves.

    Parameters
    ----------
    curves
        Curves at one or more loads, one or both directions.
    pair
        The nominal pair; the errors that its file states are the prior and start.
    progress
        Told what is being done.
    held_out
        Whether a load or direction is first kept from the fit and predicted.

    Raises
    ------
    edge.InputError
        If a curve has no load, or the data tell nothing.
    """
    for curve in curves:
        if abs(curve.torque) < 1e-3 * max(abs(c.torque) for c in curves) or curve.torque == 0.0:
            raise edge.InputError(
                f"{curve.source}: the mean torque is {curve.torque:g} N·m; the fit needs loaded curves."
            )
    kept, start = kept_back(curves) if held_out else (), None
    predicted = None
    if kept:
        rest = [c for i, c in enumerate(curves) if i not in kept]
        progress("fitting without the curves kept back")
        fit = _fitted(rest, pair, None, progress)
        predicted = _predicted(pair, fit, [curves[i] for i in kept])
        start = fit.state
    fit = _fitted(curves, pair, start, progress)
    return _result(pair, fit, predicted)


def kept_back(curves: Sequence[Curve]) -> tuple[int, ...]:
    """Choose the curves that are kept back to be predicted: a load between others, or a direction of the smallest.

    Empty where fewer than three curves were measured.
    """
    if len(curves) < 3:
        return ()
    sizes = np.array([abs(c.torque) for c in curves])
    order = np.argsort(sizes)
    # Torques within a twentieth of one another are one load.
    groups = np.split(order, np.flatnonzero(np.diff(sizes[order]) > 0.05 * sizes.max()) + 1)
    if len(groups) >= 3:
        return tuple(int(i) for i in groups[len(groups) // 2])
    return (int(order[0]),)


def _predicted(pair: Pair, fit: _Fit, curves: Sequence[Curve]) -> HeldOut:
    observed = observations(curves, pair)
    left = []
    names = dict(zip(fit.observed.bench_names, fit.state.bench, strict=True))
    known = np.array([0.0 if "offset" in n and not curves[0].common_zero else names.get(n, 0.0)
                      for n in observed.bench_names])  # fmt: skip
    bench = np.split(observed.bench @ known, observed.ends)
    for curve, zero in zip(curves, bench, strict=True):
        against = -float(curve.direction) * np.sign(curve.ratio)
        angles = curve.input_angle + fit.state.crank_offset
        torque = curve.torque + against * fit.state.friction
        error = solve(pair, fit.state.surface, torque, angles, with_play=False).transmission_error[0] + zero
        rest = curve.transmission_error - error
        left.append(rest if curve.common_zero else rest - rest.mean())
    residual = np.concatenate(left)
    noise = float(np.sqrt(1.0 / np.mean(observed.weight**2)))
    said = ", ".join(f"{c.torque:+.4g} N·m" for c in curves)
    # What single samples far off do to the rms is not the model's.
    scale = 1.4826 * float(np.median(np.abs(residual)))
    residual = residual[np.abs(residual) < _OUTLYING * max(scale, noise)]
    return HeldOut(said, float(np.sqrt(np.mean(residual**2))), noise)


def _fitted(curves: Sequence[Curve], pair: Pair, start: State | None, progress: Callable[[str], None]) -> _Fit:
    observed = observations(curves, pair)
    names = errors_of(pair)
    parts = scatter_parts(pair)
    state = _started(pair, observed, names, start, progress)
    chosen: list[str] = []
    linear = linearise(pair, observed, state, names)
    for _ in range(3):
        again = _chosen(observed, linear, names, np.zeros_like(state.scatter))
        if again == chosen:
            break
        chosen = again
        progress(f"fitting {len(chosen)} errors")
        state = _fit(pair, observed, chosen, state, {}, _STRUCTURED_GAIN)
        linear = linearise(pair, observed, state, names)
    progress("estimating the scatter of pins and teeth")
    scatter: dict[str, float] = {}
    shown, last = observed.weight, np.inf
    for _ in range(_PASSES):
        observed = _without_outliers(observed, linear, state)
        weight = observed.weight[:, None]
        nuisances, _ = nuisance_columns(observed, linear)
        columns = np.column_stack([nuisances, linear.structured[:, [names.index(n) for n in chosen]]])
        left = observed.measured - linear.model - observed.bench @ state.bench
        residual = observed.weight * (left + linear.scatter @ state.scatter)
        factor, scatter = _components(residual, weight * columns, weight * linear.scatter, parts, scatter)
        observed = dataclasses.replace(observed, weight=observed.weight / factor)
        rms = float(np.sqrt(np.mean((left[observed.weight > 0.0]) ** 2)))
        # Where pins come into contact the curves have corners, at which a fit can stop short; a new one goes on.
        if max(scatter.values()) < NO_SCATTER or rms > 0.99 * last:
            break
        last = rms
        chosen = _chosen(observed, linear, names, spread_of(pair, scatter))
        progress("fitting with the scatter of pins and teeth")
        state = _fit(pair, observed, chosen, state, scatter)
        linear = linearise(pair, observed, state, names)
        observed = _reweighted(observed, linear, state)
    used = observed.weight > 0.0
    excess = float(np.median(shown[used] / observed.weight[used]))
    return _Fit(observed, chosen, state, excess, scatter, linear)


def _reweighted(observed: Observations, linear: Linear, state: State) -> Observations:
    """Let every curve's noise be what the fit leaves of it."""
    left = observed.weight * (observed.measured - linear.model - observed.bench @ state.bench)
    weight = observed.weight.copy()
    for part in np.split(np.arange(left.size), observed.ends):
        used = part[weight[part] > 0.0]
        weight[part] /= max(float(np.sqrt(np.mean(left[used] ** 2))), 1e-3)
    return dataclasses.replace(observed, weight=weight)


def _chosen(observed: Observations, linear: Linear, names: list[str], spread: Array) -> list[str]:
    chosen = chosen_errors(observed, linear, names, spread)
    if not chosen:
        raise edge.InputError("the data tell none of the structured errors apart; record more loads or more turns.")
    return chosen


def _started(
    pair: Pair, observed: Observations, names: list[str], start: State | None, progress: Callable[[str], None]
) -> State:
    """A state near the best one: from where another fit ended, or the best of several starts on some of the points."""
    size = max(p.stop for p in scatter_parts(pair).values())
    stride = max(1, observed.measured.size // _START_POINTS)
    # A stride that shares no factor with the samples of a crank turn sees all of the turn.
    few = observed.thinned(stride + 1 - stride % 2)
    known = np.isfinite(observed.bench_prior)
    prior = surface_of_pair(pair)

    def zeroed(surface: ErrorSurface) -> State:
        state = State(surface, np.zeros(size), np.zeros(observed.bench.shape[1]))
        linear = linearise(pair, few, state, [names[0]])
        bench = state.bench.copy()
        bench[~known] = np.linalg.lstsq(few.bench[:, ~known], few.measured - linear.model, rcond=None)[0]
        return dataclasses.replace(state, bench=bench)

    if start is not None:
        if start.bench.size != observed.bench.shape[1]:
            start = dataclasses.replace(zeroed(start.surface), crank_offset=start.crank_offset, scatter=start.scatter)
        return start
    progress("finding a start")
    state = zeroed(prior)
    chosen = _chosen(observed, linearise(pair, observed, state, names), names, np.zeros(size))
    generator = np.random.default_rng(0)
    best, found = np.inf, state
    for number in range(_STARTS):
        surface = prior
        if number > 0:
            drawn = generator.normal(0.0, tolerances_of(chosen))
            values = {n: structured_value(pair, prior, n) + d for n, d in zip(chosen, drawn, strict=True)}
            surface = with_structured(pair, prior, values)
        ended = _fit(pair, few, chosen, zeroed(surface), {}, _START_GAIN)
        left = few.measured - linearise(pair, few, ended, [names[0]]).model - few.bench @ ended.bench
        misfit = float(np.sum((few.weight * left) ** 2))
        if misfit < 0.98 * best:
            best, found = misfit, ended
    return found


def _without_outliers(observed: Observations, linear: Linear, state: State) -> Observations:
    """Leave points out that lie farther off the fit than noise and scatter put them."""
    left = observed.measured - linear.model - observed.bench @ state.bench
    weight = observed.weight.copy()
    for part in np.split(np.arange(left.size), observed.ends):
        scale = 1.4826 * np.median(np.abs(left[part] - np.median(left[part])))
        noise = 1.0 / np.median(weight[part][weight[part] > 0.0])
        weight[part[np.abs(left[part]) > _OUTLYING * max(scale, noise)]] = 0.0
    return dataclasses.replace(observed, weight=weight)


def _fit(
    pair: Pair,
    observed: Observations,
    chosen: Sequence[str],
    state: State,
    deviations: dict[str, float],
    gain: float = _GAIN,
) -> State:
    """Fit the chosen errors, the bench and, where deviations are given, every pin's and tooth's scatter."""
    import lmfit

    problem = _Problem(pair, observed, chosen, state, deviations)
    parameters = lmfit.Parameters()
    labels = [f"p{i}" for i in range(problem.start.size)]
    parameters.add_many(*((label, value) for label, value in zip(labels, problem.start, strict=True)))

    def values(given: Any) -> Array:
        return np.array([given[label].value for label in labels])

    fit = lmfit.minimize(
        lambda given: problem.residual(values(given)), parameters, method="leastsq",
        Dfun=lambda given: problem.jacobian(values(given)), col_deriv=False, xtol=1e-6, ftol=gain,
        max_nfev=_EVALUATIONS, calc_covar=False,
    )  # fmt: skip
    return problem.state_at(values(fit.params))


class _Problem:
    """Least squares of a fit in scaled unknowns: chosen errors, bench, friction, crank, then the scatter that is free.

    Unknowns with a prior are one more residual each.
    """

    def __init__(
        self, pair: Pair, observed: Observations, chosen: Sequence[str], state: State, deviations: dict[str, float]
    ) -> None:
        self.pair, self.observed, self.chosen = pair, observed, list(chosen)
        self.prior = surface_of_pair(pair)
        self.spread = spread_of(pair, deviations)
        self.free = self.spread > NO_SCATTER
        self.scale = tolerances_of(chosen)
        bench_known = np.isfinite(observed.bench_prior)
        self.bench_scale = np.where(bench_known, observed.bench_prior, 1e-4)
        crank = [state.crank_offset / 1e-2] if observed.fit_crank else []
        plain = with_scatter(pair, state.surface, -state.scatter)
        self.start = np.concatenate([
            np.array([structured_value(pair, plain, n) for n in chosen]) / self.scale,
            state.bench / self.bench_scale, [state.friction / observed.friction_prior], crank,
            state.scatter[self.free] / self.spread[self.free],
        ])  # fmt: skip
        self.has_prior = np.concatenate(
            [np.zeros(len(chosen), bool), bench_known, [True], np.zeros(len(crank), bool), self.free[self.free]]
        )
        self._last: tuple[bytes, State, Linear] | None = None

    def state_at(self, values: Array) -> State:
        errors, bench, rest = np.split(values, [len(self.chosen), len(self.chosen) + self.bench_scale.size])
        surface = with_structured(self.pair, self.prior, dict(zip(self.chosen, errors * self.scale, strict=True)))
        scatter = np.zeros(self.spread.size)
        crank = int(self.observed.fit_crank)
        scatter[self.free] = rest[1 + crank :] * self.spread[self.free]
        return State(
            surface=with_scatter(self.pair, surface, scatter),
            scatter=scatter,
            bench=bench * self.bench_scale,
            crank_offset=float(rest[1]) * 1e-2 if crank else 0.0,
            friction=float(rest[0]) * self.observed.friction_prior,
        )

    def _at(self, values: Array) -> tuple[State, Linear]:
        key = values.tobytes()
        if self._last is None or self._last[0] != key:
            state = self.state_at(values)
            self._last = key, state, linearise(self.pair, self.observed, state, self.chosen)
        return self._last[1], self._last[2]

    def residual(self, values: Array) -> Array:
        state, linear = self._at(values)
        left = self.observed.measured - linear.model - self.observed.bench @ state.bench
        return np.concatenate([self.observed.weight * left, values[self.has_prior]])

    def jacobian(self, values: Array) -> Array:
        _, linear = self._at(values)
        blocks = [linear.structured * self.scale, self.observed.bench * self.bench_scale,
                  linear.by_friction[:, None] * self.observed.friction_prior]  # fmt: skip
        if self.observed.fit_crank:
            blocks.append(linear.by_crank[:, None] * 1e-2)
        blocks.append(linear.scatter[:, self.free] * self.spread[self.free])
        columns = -self.observed.weight[:, None] * np.column_stack(blocks)
        return np.vstack([columns, np.eye(values.size)[self.has_prior]])


def _inflation(residuals: Sequence[Array]) -> float:
    """By how much the standard error of a mean of these residuals exceeds that of white noise of the same size.

    The square root of the integrated autocorrelation time, summed to the first lag that noise could make.
    """
    time, lag = 1.0, 1
    total = sum(float(r @ r) for r in residuals)
    count = sum(r.size for r in residuals)
    while lag < min(r.size for r in residuals) // 4:
        correlation = sum(float(r[lag:] @ r[:-lag]) for r in residuals) / total
        if correlation < 2.0 / np.sqrt(count):
            break
        time += 2.0 * correlation
        lag += 1
    return float(np.sqrt(time))


def _result(pair: Pair, fit: _Fit, predicted: HeldOut | None) -> Identification:
    observed, chosen, state, linear = fit.observed, fit.chosen, fit.state, fit.linear
    names = errors_of(pair)
    fitted = linear.model + observed.bench @ state.bench
    whitened = observed.weight * (observed.measured - fitted)
    inflation = _inflation(np.split(whitened, observed.ends))
    observed = dataclasses.replace(observed, weight=observed.weight / inflation)
    spread = spread_of(pair, fit.scatter)
    every = posterior_covariance(observed, linear, names, chosen, spread)
    covariance = every[: len(chosen), : len(chosen)]
    error = np.sqrt(np.diag(covariance))
    prior = surface_of_pair(pair)
    plain = with_scatter(pair, state.surface, -state.scatter)
    quantile = float(stats.norm.ppf(0.5 + 0.5 * _CONFIDENCE))
    singular, combinations, reasons = weakness(observed, linear, names, chosen)
    parameters = []
    for name, tolerance in zip(names, tolerances_of(names), strict=True):
        known = name in chosen
        value = structured_value(pair, plain if known else prior, name)
        sigma = float(error[chosen.index(name)]) if known else float(tolerance)
        parameters.append(
            Parameter(
                name, unit_of(name), value, sigma, (value - quantile * sigma, value + quantile * sigma),
                1.0 - (sigma / float(tolerance)) ** 2 if known else 0.0, None if known else reasons[name],
            )
        )  # fmt: skip
    surface = dataclasses.replace(
        state.surface,
        origin="identified",
        covariance_of=(*chosen, *scatter_names(pair)),
        covariance=every,
        attributes={"data": " ".join(f"{c.checksum}" for c in observed.curves)},
    )
    bench = {n: float(v) for n, v in zip(observed.bench_names, state.bench, strict=True)}
    bench["friction_torque"] = state.friction
    if observed.fit_crank:
        bench["crank_angle_offset"] = state.crank_offset
    used = observed.weight > 0.0
    return Identification(
        parameters=tuple(parameters),
        bench=bench,
        surface=surface,
        correlation=covariance / np.outer(error, error),
        singular_values=singular,
        weak_combinations=combinations,
        noise=float(np.sqrt(1.0 / np.mean((inflation * observed.weight[used]) ** 2))),
        scatter=fit.scatter,
        inflation=inflation,
        residual=float(np.sqrt(np.mean((observed.measured - fitted)[used] ** 2))),
        outliers=tuple(int(np.count_nonzero(part == 0.0)) for part in np.split(observed.weight, observed.ends)),
        held_out=predicted,
        fitted_curves=tuple(np.split(fitted, observed.ends)),
        checksums={c.source: c.checksum for c in observed.curves},
        notes=_notes(pair, fit, state),
    )


def _notes(pair: Pair, fit: _Fit, state: State) -> tuple[str, ...]:
    """Say what the curves lack, and whether the errors explain them."""
    notes = []
    curves = fit.observed.curves
    sizes = np.array([abs(c.torque) for c in curves])
    if np.ptp(sizes) < 0.05 * sizes.max():
        notes.append(
            f"There is one load only, {sizes.mean():.4g} N·m: what gives way elsewhere and what stands off can't be "
            "told apart; record a second one, ten times smaller."
        )
    if len({np.sign(c.torque) for c in curves}) == 1:
        notes.append(
            "All torques have one sign, so one side of the teeth was never loaded; record the other direction too."
        )
    for curve in curves:
        turns = float(np.ptp(curve.input_angle)) / (2.0 * np.pi * abs(curve.ratio))
        if turns < 0.95:
            notes.append(
                f"{curve.source}: it covers {turns:.2f} of an output turn; teeth not in contact are not known."
            )
    if fit.excess > _UNEXPLAINED:
        notes.append(
            f"No error of this pair explains the curves: what is left is {fit.excess:.1f} times their noise; is this "
            "the drive of the pair file, and are counts per turn and directions right?"
        )
    gear = np.abs(fit.linear.model - fit.linear.model.mean()).max()
    names = fit.observed.bench_names
    once = np.hypot(*(state.bench[names.index(f"output_encoder_eccentricity_{p}")] for p in ("cos", "sin")))
    if once > gear:
        notes.append(
            f"Once an output turn the angle errs by {once * ARCSEC:.3g}″, more than the gear does in all: "
            "an encoder sits eccentrically, or the shafts are not aligned."
        )
    for curve, left in zip(curves, np.split(fit.observed.weight == 0.0, fit.observed.ends), strict=True):
        if left.any():
            notes.append(
                f"{curve.source}: {np.count_nonzero(left)} of {left.size} points lie far off and were left out."
            )
    return tuple(notes)


def as_json(result: Identification) -> dict[str, Any]:
    """Return an identification as the content of a `cycloid-identification/1` file (SI)."""
    return {
        "format": FORMAT,
        "parameters": {
            p.name: {
                "value": p.value,
                "standard_error": p.standard_error,
                "interval": list(p.interval),
                "unit": p.unit,
                "data_share": p.data_share,
                "held": p.held or False,
            }
            for p in result.parameters
        },
        "bench": result.bench,
        "correlation": {"of": list(result.fitted), "matrix": result.correlation},
        "singular_values": result.singular_values,
        "weak_combinations": list(result.weak_combinations),
        "noise": result.noise,
        "scatter": result.scatter,
        "inflation": result.inflation,
        "residual": result.residual,
        "outliers": dict(zip(result.checksums, result.outliers, strict=True)),
        "held_out": None if result.held_out is None else dataclasses.asdict(result.held_out),
        "data": result.checksums,
        "notes": list(result.notes),
    }


def write_identification(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write an identification file, whole or not at all."""
    with edge.written_whole(path) as temporary:
        temporary.write_text(edge.json_text(as_json(result)), encoding="utf-8")
