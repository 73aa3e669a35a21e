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
from cycloid_fmu.contact import SCALAR_ERRORS
from cycloid_fmu.pair import Pair
from cycloid_fmu.surface import (
    ErrorSurface,
    structured_names,
    structured_value,
    surface_of_pair,
    unit_of,
    with_structured,
)
from cycloid_fmu.transmission import error_sensitivity
from fitting.curve import Curve, noise_of

Array = NDArray[np.float64]
FORMAT = "cycloid-identification/1"
ORDERS = (1, 2, 3)

# Of each set of errors that move the transmission error alike the first is fitted (design.md section 3).
PREFERENCE = (
    "centre_distance_x", "centre_distance_y", "pin_radius", "pin_circle_radius", "eccentricity",
    *(f"{p}_{k}_{w}" for k in (2, 3) for p in ("pin_radial", "pin_tangential") for w in ("cos", "sin")),
    *(f"tooth_cumulative_pitch_{k}_{w}" for k in ORDERS for w in ("cos", "sin")),
    *(f"{p}_1_{w}" for p in ("pin_tangential", "pin_radial") for w in ("cos", "sin")),
    "isometric", "offset", "misalignment_xz", "misalignment_yz",
)  # fmt: skip
TOLERANCE = {"m": 5e-6, "rad": 1e-4}  # standard deviation that an error has before anything is measured
KNOWN = 0.2  # an error counts as known where the data leave less than this share of its tolerance
NO_SCATTER = 1e-8  # m: a scatter below this changes nothing that a bench can see
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Parameter:
    """One structured error after the fit: SI value, standard error and 95 % interval, or why it is held."""

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]
    held: str | None = None


@dataclass(frozen=True)
class Identification:
    """The result of a fit.

    Attributes
    ----------
    parameters
        All structured errors, fitted and held.
    offsets
        {name: rad} of the bench's zeros: output angle offset of each recording or of all, crank angle offset.
    surface
        The identified error surface, the pins' and teeth's own scatter included.
    correlation
        Of the fitted parameters, in the order of `fitted`.
    singular_values, weak_combinations
        Of the Jacobian scaled by tolerance and noise (below 1 a combination is less known than before measuring), and
        the weak ones in words.
    noise, scatter
        Noise of a point (rad) and standard deviation of each scattered pattern (m).
    residual
        rms of measured less fitted transmission error, rad.
    fitted_curves
        Fitted transmission error of each curve, offset included, rad.
    checksums
        {source: SHA-256} of the data.
    """

    parameters: tuple[Parameter, ...]
    offsets: dict[str, float]
    surface: ErrorSurface
    correlation: Array
    singular_values: Array
    weak_combinations: tuple[str, ...]
    noise: float
    scatter: dict[str, float]
    residual: float
    fitted_curves: tuple[Array, ...]
    checksums: dict[str, str]

    @property
    def fitted(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(p.name for p in self.parameters if p.held is None)


@dataclass(frozen=True)
class _Data:
    """The curves as one long vector, and the columns of the bench's zeros."""

    curves: tuple[Curve, ...]
    measured: Array
    weight: Array
    offsets: Array
    offset_names: tuple[str, ...]
    fit_crank: bool


def _data(curves: Sequence[Curve]) -> _Data:
    noise = np.array([noise_of(c) for c in curves])
    floor = max(float(np.median(noise)), 1e-9)
    weight = [np.sqrt(c.sample_count / np.median(c.sample_count)) / max(n, 0.1 * floor, 1e-9)
              for c, n in zip(curves, noise, strict=True)]  # fmt: skip
    names, columns = [], []
    absolute = [i for i, c in enumerate(curves) if c.common_zero]
    groups = ([absolute] if absolute else []) + [[i] for i, c in enumerate(curves) if not c.common_zero]
    for number, group in enumerate(groups):
        names.append("output_angle_offset" if len(groups) == 1 else f"output_angle_offset_{number}")
        columns.append(np.concatenate([np.full(c.input_angle.size, float(i in group)) for i, c in enumerate(curves)]))
    return _Data(
        curves=tuple(curves),
        measured=np.concatenate([c.transmission_error for c in curves]),
        weight=np.concatenate(weight),
        offsets=np.array(columns).T,
        offset_names=tuple(names),
        fit_crank=not all(c.known_index for c in curves),
    )


@dataclass(frozen=True)
class _Linear:
    """Model at one point: transmission error and its derivatives by structured errors, scatter and crank angle."""

    model: Array
    structured: Array
    scatter: Array
    by_angle: Array


def _scatter_columns(pair: Pair) -> tuple[Array, dict[str, slice]]:
    """Map from one displacement a pin or tooth (m) to the columns of the sensitivities."""
    g = pair.pair
    scalars, teeth = len(SCALAR_ERRORS), g.discs * g.gear_teeth
    width = scalars + 3 * g.pins + teeth
    starts = {"pin_radial": (scalars, g.pins), "pin_tangential": (scalars + g.pins, g.pins),
              "tooth_cumulative_pitch": (scalars + 3 * g.pins, teeth)}  # fmt: skip
    columns = np.zeros((width, 2 * g.pins + teeth))
    parts, begin = {}, 0
    for name, (start, count) in starts.items():
        scale = 1.0 / g.pin_circle_radius if name == "tooth_cumulative_pitch" else 1.0
        columns[start : start + count, begin : begin + count] = scale * np.eye(count)
        parts[name] = slice(begin, begin + count)
        begin += count
    return columns, parts


def _linearise(pair: Pair, surface: ErrorSurface, data: _Data, names: Sequence[str], crank: float) -> _Linear:
    """Evaluate the exact model and its analytic derivatives at every point of every curve."""
    columns, _ = _scatter_columns(pair)
    models, structured, scatter, by_angle = [], [], [], []
    for curve in data.curves:
        model, jacobian, each, further = error_sensitivity(
            pair, surface, curve.torque, curve.input_angle + crank, list(names)
        )
        models.append(model)
        structured.append(jacobian)
        scatter.append(each @ columns)
        by_angle.append(further[:, 0])
    return _Linear(*(np.concatenate(v) for v in (models, structured, scatter, by_angle)))


def _scale(names: Sequence[str]) -> Array:
    return np.array([TOLERANCE[unit_of(n)] for n in names])


def choose(information: Array, names: Sequence[str], nuisances: int) -> list[str]:
    """Choose the errors that the data tell apart.

    Parameters
    ----------
    information
        Information matrix of the nuisances (first) and all structured errors, scaled by their tolerances.
    names
        The structured errors in the matrix' order.
    nuisances
        How many nuisances precede them; they are always fitted.

    Returns
    -------
    names
        In the order of `PREFERENCE`: each was added where all errors chosen stay known to `KNOWN` of their tolerance.
    """
    chosen: list[int] = []
    always = list(range(nuisances))
    for name in PREFERENCE:
        if name not in names:
            continue
        trial = [*chosen, nuisances + list(names).index(name)]
        index = always + trial
        block = information[np.ix_(index, index)]
        size = np.sqrt(np.diag(block))
        if (size[nuisances:] <= 0.0).any():
            continue
        scaled = block / np.outer(size, size)
        values, vectors = np.linalg.eigh(scaled)
        if values[0] < 1e-12:
            continue
        spread = np.sqrt((vectors**2 / values).sum(axis=1)) / size
        if (spread[nuisances:] < KNOWN).all():
            chosen = trial
    return [list(names)[i - nuisances] for i in chosen]


def _nuisance_columns(data: _Data, linear: _Linear) -> Array:
    columns = data.offsets
    return np.column_stack([columns, linear.by_angle]) if data.fit_crank else columns


def _components(
    residual: Array, fixed: Array, scatter: Array, parts: dict[str, slice], start: dict[str, float]
) -> tuple[float, dict[str, float]]:
    """Noise factor and scatter deviations by restricted maximum likelihood (MacKay's fixed point), all whitened."""
    q, _ = np.linalg.qr(fixed)
    left = residual - q @ (q.T @ residual)
    design = scatter - q @ (q.T @ scatter)
    gram, moment, total = design.T @ design, design.T @ left, left @ left
    freedom = residual.size - fixed.shape[1]
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
    curves: Sequence[Curve], pair: Pair, progress: Callable[[str], None] = lambda step: None
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
    data = _data(curves)
    prior = surface_of_pair(pair)
    names = structured_names([k for k in ORDERS if 2 * k < pair.pair.gear_teeth])
    _, parts = _scatter_columns(pair)
    linear = _linearise(pair, prior, data, names, 0.0)
    zeros: Array = np.linalg.lstsq(data.offsets, data.measured - linear.model, rcond=None)[0].astype(float)
    state = _State(prior, zeros, 0.0, np.zeros(linear.scatter.shape[1]))

    chosen: list[str] = []
    for _ in range(3):
        progress("choosing what the data can tell")
        again = choose(_information(data, linear, names), names, _nuisance_columns(data, linear).shape[1])
        if not again:
            raise edge.InputError("the data tell none of the structured errors apart; record more loads or more turns.")
        if set(again) == set(chosen):
            break
        chosen = [n for n in names if n in again]
        progress(f"fitting {len(chosen)} errors")
        state = _fit(pair, data, chosen, state, {}, parts)
        linear = _linearise(pair, state.surface, data, names, state.crank)

    progress("estimating the scatter of pins and teeth")
    scatter: dict[str, float] = {}
    factor = 1.0
    for _ in range(2):
        weight = data.weight[:, None]
        keep = [names.index(n) for n in chosen]
        fixed = weight * np.column_stack([_nuisance_columns(data, linear), linear.structured[:, keep]])
        residual = data.weight * (
            data.measured - linear.model - data.offsets @ state.offsets + linear.scatter @ state.scatter
        )
        factor, scatter = _components(residual, fixed, weight * linear.scatter, parts, scatter)
        if max(scatter.values()) < NO_SCATTER:
            break
        progress("fitting with the scatter of pins and teeth")
        state = _fit(pair, data, chosen, state, {n: s / factor for n, s in scatter.items()}, parts)
        linear = _linearise(pair, state.surface, data, names, state.crank)
    return _result(pair, data, names, chosen, state, linear, factor, scatter, parts)


@dataclass(frozen=True)
class _State:
    """Where the fit stands: the surface with the scatter in it, the bench's zeros, and the scatter by itself."""

    surface: ErrorSurface
    offsets: Array
    crank: float
    scatter: Array


def _information(data: _Data, linear: _Linear, names: Sequence[str]) -> Array:
    columns = np.column_stack([_nuisance_columns(data, linear), linear.structured * _scale(names)])
    columns = data.weight[:, None] * columns
    return columns.T @ columns


def _with_scatter(surface: ErrorSurface, scatter: Array, parts: dict[str, slice]) -> ErrorSurface:
    changes = {n: getattr(surface, n) + scatter[p].reshape(getattr(surface, n).shape) for n, p in parts.items()}
    return dataclasses.replace(surface, **changes)


def _fit(
    pair: Pair, data: _Data, chosen: Sequence[str], state: _State, deviations: dict[str, float], parts: dict[str, slice]
) -> _State:
    """Fit the chosen errors, the bench's zeros and, where deviations are given, every pin's and tooth's scatter."""
    import lmfit

    prior = surface_of_pair(pair)
    plain = _with_scatter(state.surface, -state.scatter, parts)
    scale = _scale(chosen)
    spread = np.concatenate([np.full(p.stop - p.start, deviations.get(n, 0.0)) for n, p in parts.items()])
    free = spread > NO_SCATTER
    start = np.concatenate([
        np.array([structured_value(pair, plain, n) for n in chosen]) / scale,
        state.offsets / 1e-4,
        [state.crank / 1e-2] if data.fit_crank else [],
        state.scatter[free] / spread[free],
    ])  # fmt: skip
    parameters = lmfit.Parameters()
    labels = [f"p{i}" for i in range(start.size)]
    parameters.add_many(*((label, value) for label, value in zip(labels, start, strict=True)))
    count, zeros = len(chosen), state.offsets.size

    def unpack(values: Array) -> _State:
        surface = with_structured(pair, prior, dict(zip(chosen, values[:count] * scale, strict=True)))
        scatter = np.zeros(spread.size)
        rest = values[count + zeros :]
        crank = float(rest[0]) * 1e-2 if data.fit_crank else 0.0
        scatter[free] = rest[int(data.fit_crank) :] * spread[free]
        return _State(_with_scatter(surface, scatter, parts), values[count : count + zeros] * 1e-4, crank, scatter)

    cache: dict[bytes, _Linear] = {}

    def linear_at(values: Array, at: _State) -> _Linear:
        key = values.tobytes()
        if key not in cache:
            cache.clear()
            cache[key] = _linearise(pair, at.surface, data, chosen, at.crank)
        return cache[key]

    def residual(given: Any) -> Array:
        values = np.array([given[label].value for label in labels])
        at = unpack(values)
        linear = linear_at(values, at)
        differences = data.weight * (data.measured - linear.model - data.offsets @ at.offsets)
        return np.concatenate([differences, values[values.size - np.count_nonzero(free) :]])

    def jacobian(given: Any) -> Array:
        values = np.array([given[label].value for label in labels])
        at = unpack(values)
        linear = linear_at(values, at)
        blocks = [linear.structured * scale, data.offsets * 1e-4]
        if data.fit_crank:
            blocks.append(linear.by_angle[:, None] * 1e-2)
        blocks.append(linear.scatter[:, free] * spread[free])
        columns = -data.weight[:, None] * np.column_stack(blocks)
        scattered = int(np.count_nonzero(free))
        return np.vstack([columns, np.eye(scattered, start.size, start.size - scattered)])

    fit = lmfit.minimize(
        residual, parameters, method="leastsq", Dfun=jacobian, col_deriv=False, xtol=1e-6, ftol=1e-8, calc_covar=False
    )
    return unpack(np.array([fit.params[label].value for label in labels]))


def _result(
    pair: Pair,
    data: _Data,
    names: Sequence[str],
    chosen: Sequence[str],
    state: _State,
    linear: _Linear,
    factor: float,
    scatter: dict[str, float],
    parts: dict[str, slice],
) -> Identification:
    nuisance = _nuisance_columns(data, linear)
    keep = [names.index(n) for n in chosen]
    scale = _scale(chosen)
    spread = np.concatenate([np.full(p.stop - p.start, scatter[n]) for n, p in parts.items()])
    columns = np.column_stack([linear.structured[:, keep] * scale, nuisance * 1e-4, linear.scatter * spread])
    columns = data.weight[:, None] / factor * columns
    information = columns.T @ columns
    first = len(chosen) + nuisance.shape[1]
    information[first:, first:] += np.eye(information.shape[0] - first)
    covariance = linalg.inv(information)[: len(chosen), : len(chosen)] * np.outer(scale, scale)
    error = np.sqrt(np.diag(covariance))
    prior = surface_of_pair(pair)
    plain = _with_scatter(state.surface, -state.scatter, parts)
    quantile = float(stats.norm.ppf(0.5 + 0.5 * _CONFIDENCE))
    singular, combinations, reasons = _weakness(data, linear, names, chosen, factor)
    parameters = []
    for name in names:
        if name in chosen:
            value, sigma = structured_value(pair, plain, name), float(error[list(chosen).index(name)])
            parameters.append(
                Parameter(name, unit_of(name), value, sigma, (value - quantile * sigma, value + quantile * sigma))
            )
        else:
            value, sigma = structured_value(pair, prior, name), TOLERANCE[unit_of(name)]
            interval = (value - quantile * sigma, value + quantile * sigma)
            parameters.append(Parameter(name, unit_of(name), value, sigma, interval, reasons[name]))
    fitted = linear.model + data.offsets @ state.offsets
    ends = np.cumsum([c.input_angle.size for c in data.curves])[:-1]
    surface = dataclasses.replace(
        state.surface,
        origin="identified",
        covariance_of=tuple(chosen),
        covariance=covariance,
        attributes={"data": " ".join(f"{c.checksum}" for c in data.curves)},
    )
    offsets = {n: float(v) for n, v in zip(data.offset_names, state.offsets, strict=True)}
    if data.fit_crank:
        offsets["crank_angle_offset"] = state.crank
    typical = float(np.sqrt(1.0 / np.mean(data.weight**2)))
    return Identification(
        parameters=tuple(parameters),
        offsets=offsets,
        surface=surface,
        correlation=covariance / np.outer(error, error),
        singular_values=singular,
        weak_combinations=combinations,
        noise=typical * factor,
        scatter=scatter,
        residual=float(np.sqrt(np.mean((data.measured - fitted) ** 2))),
        fitted_curves=tuple(np.split(fitted, ends)),
        checksums={c.source: c.checksum for c in data.curves},
    )


def _weakness(
    data: _Data, linear: _Linear, names: Sequence[str], chosen: Sequence[str], factor: float
) -> tuple[Array, tuple[str, ...], dict[str, str]]:
    """Singular values of the scaled Jacobian, its weak combinations in words, and why each other error is held."""
    weight = data.weight[:, None] / factor
    q, _ = np.linalg.qr(weight * _nuisance_columns(data, linear))
    columns = weight * linear.structured * _scale(names)
    columns = columns - q @ (q.T @ columns)
    _, singular, right = np.linalg.svd(columns, full_matrices=False)
    weak = []
    for value, vector in zip(singular, right, strict=True):
        if value > 1.0 / KNOWN:
            continue
        leading = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) > 0.25 * np.abs(vector).max()]
        terms = [f"{vector[i]:+.2f} {names[i]}" for i in leading[:6]]
        weak.append(f"{' '.join(terms)} is not known from these data")
    keep = [list(names).index(n) for n in chosen]
    reasons = {}
    for i, name in enumerate(names):
        if i in keep:
            continue
        length = float(np.linalg.norm(columns[:, i]))
        if length < 1.0:
            reasons[name] = "it does not move these transmission errors"
            continue
        share, *_ = np.linalg.lstsq(columns[:, keep], columns[:, i], rcond=None)
        left = float(np.linalg.norm(columns[:, i] - columns[:, keep] @ share)) / length
        leading = [j for j in np.argsort(-np.abs(share)) if abs(share[j]) > 0.2 * np.abs(share).max()][:4]
        alike = " ".join(f"{share[j]:+.2f} {chosen[j]}" for j in leading)
        if left < 0.05:
            reasons[name] = f"it moves the transmission errors as {alike}"
        else:
            reasons[name] = f"the data leave it too uncertain beside {alike}"
    return singular, tuple(weak), reasons


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
                "held": p.held or False,
            }
            for p in result.parameters
        },
        "offsets": result.offsets,
        "correlation": {"of": list(result.fitted), "matrix": result.correlation},
        "singular_values": result.singular_values,
        "weak_combinations": list(result.weak_combinations),
        "noise": result.noise,
        "scatter": result.scatter,
        "residual": result.residual,
        "data": result.checksums,
    }


def write_identification(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write an identification file, whole or not at all."""
    with edge.written_whole(path) as temporary:
        temporary.write_text(edge.json_text(as_json(result)), encoding="utf-8")
