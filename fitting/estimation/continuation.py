"""A fit that goes on from the posterior of another: the same unknowns, with what is known of them as prior.

The errors, single pins and teeth, bearings and the compliance of the chain between the encoders are the same in the
next recordings. Zeros of the angles and their drift, friction of the day, and the run-out of encoders that may have
been mounted again are not: they are unknown again. There is one start, the most likely drive before, and no search for
other minima.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.pair import Pair, parse_pair
from cycloid_fmu.geometry.supports import Supports
from cycloid_fmu.surfaces.structured import profile_wave, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.explanation import GAIN
from fitting.estimation.fit import Estimate, fit
from fitting.estimation.result import FORMAT, Identification, read_lmfit_parameters, result_of
from fitting.estimation.starts import first_sizes
from fitting.estimation.validation import Likely, Residual, Verdict, likely_causes, verdict_of
from fitting.model.bearings import BEARINGS, PLAY, stiffness_shares
from fitting.model.discrepancy import causes
from fitting.model.first_stage import with_play
from fitting.model.gaussian import equations
from fitting.model.observations import (
    Observations,
    State,
    left_of,
    linearise,
    observations,
    scatter_names,
    scatter_parts,
    spread_of,
    with_scatter,
)
from fitting.model.posterior import Posterior, factor_rows, fitted_to, lasting
from fitting.model.prior import posterior_about, posterior_of, tolerances_of
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]


def check_comparable(curve: Curve, drive: Drive) -> None:
    """Refuse a curve of another drive, one to which it was fitted, or one with another crank angle than its errors."""
    if abs(curve.ratio / drive.pair.ratio - 1.0) > 1e-9:
        raise edge.InputError(
            f"{curve.source}: its ratio is {curve.ratio:g}, the pair's {drive.pair.ratio:g}; it is of another drive."
        )
    if not curve.known_index:
        raise edge.InputError(
            f"{curve.source}: the crank position at an input angle of zero is unknown, so its errors cannot be "
            "compared with the known ones; for a motor encoder that keeps its zero, state zero_reference = "
            '"absolute" of [input_angle] in the mapping, or known_index of a Run.'
        )
    if curve.checksum in fitted_to(drive.surface):
        raise edge.InputError(
            f"{curve.source}: the earlier fit already used this recording (SHA-256 {curve.checksum[:8]}…); it would "
            "count twice; give new ones."
        )


def state_before(earlier: Posterior, observed: Observations) -> State:
    """Return the most likely state before measurements."""
    known = dict(zip(earlier.bench, earlier.bench_mean.tolist(), strict=True))
    bench = np.array([known.get(n, 0.0) for n in observed.bench_names])
    return State(earlier.drive.surface, earlier.scatter_mean, bench)


def continued(
    curves: Sequence[Curve], earlier: Posterior, progress: Callable[[str], None]
) -> tuple[Estimate, Verdict, dict[str, float]]:
    """Fit curves with a posterior as prior.

    The errors are those of the posterior: which are resolved was decided when it was made.

    Returns
    -------
    estimate, verdict
        The fit, and whether it explains the curves.
    scatter
        Root mean square of each scattered pattern in the posterior, m or rad.

    Raises
    ------
    edge.InputError
        If a curve is of another drive or its index is unknown, or no contacts balance the loads.
    """
    pair = earlier.drive.pair
    for curve in curves:
        check_comparable(curve, earlier.drive)
    orders = [n for n in earlier.errors if profile_wave(n, 1) is not None]
    profile = dict(zip(orders, tolerances_of(orders).tolist(), strict=True))
    observed = observations(curves, pair, profile=profile, first_stage=earlier.drive.first_stage, earlier=earlier)
    state, sizes = state_before(earlier, observed), _sizes(earlier)
    progress("fitting from the prior fit")
    linear = linearise(pair, observed, state)
    is_free = ~np.isfinite(observed.bench_prior)
    state.bench[is_free] = np.linalg.lstsq(observed.bench[:, is_free], left_of(observed, linear, state), rcond=None)[0]
    groups = {**first_sizes(observed), **sizes}
    estimate = fit(
        pair, observed.with_sizes(groups), earlier.errors, state, groups, gain=GAIN, linear=linear, known=sizes
    )
    progress("testing the residual")
    columns = causes(pair, estimate.observed, estimate.linear)
    likely = likely_causes(Residual(estimate), columns, Likely({}, {}, ()))
    return estimate, verdict_of(estimate, likely), sizes


def refuse_with_prior(**given: object) -> None:
    """Refuse arguments that are not None: the fit that is the prior has decided on the unknowns."""
    for name, value in given.items():
        if value is not None:
            raise edge.ArgumentError(name, "can't be given with prior, whose fit has decided on the unknowns")


def identified(
    curves: Sequence[Curve],
    earlier: Posterior,
    stated: Pair,
    profiled: Sequence[str],
    bootstrap: int,
    form: float,
    progress: Callable[[str], None],
) -> Identification:
    """Return the result of `continued`, its bearings as fractions of the stated pair's.

    The other arguments are those of `fitting.identify`, the form in m.
    """
    with equations():
        estimate, verdict, sizes = continued(curves, earlier, progress)
        form = 0.0 if estimate.observed.profile else form
        result = result_of(estimate, verdict, None, sizes, profiled, bootstrap, (), form, progress)
    shares = stiffness_shares(earlier.drive.pair, stated)
    return dataclasses.replace(
        result, bearings=tuple(unknown.times(shares.get(unknown.name, 1.0)) for unknown in result.bearings)
    )


def _sizes(earlier: Posterior) -> dict[str, float]:
    """Return the root mean square of each pattern's elements in a posterior."""
    square = earlier.scatter_mean**2 + np.diag(earlier.of_surface)[len(earlier.errors) :]
    return {name: float(np.sqrt(square[part].mean())) for name, part in scatter_parts(earlier.drive.pair).items()}


def earlier_of(prior: Posterior | Identification | Drive | str | os.PathLike[str], drive: Drive) -> Posterior:
    """Return the posterior that a prior is, or has.

    Parameters
    ----------
    prior
        A posterior, a fit or its file, or a drive whose surface has the covariance of a fit.
    drive
        The nominal drive, to which it must belong.

    Raises
    ------
    edge.InputError
        If it is of another drive or has no posterior, or the file can't be read.
    """
    if isinstance(prior, str | os.PathLike):
        return read_posterior(prior, drive)
    if isinstance(prior, Drive):
        posterior = posterior_of(prior)
    elif isinstance(prior, Identification):
        if prior.posterior is None:
            raise edge.ArgumentError("prior", _NO_POSTERIOR)
        posterior = prior.posterior
    else:
        posterior = prior
    if not _is_of(posterior.drive.pair, drive.pair):
        raise edge.ArgumentError("prior", "it is a fit of another drive")
    return posterior


_NO_POSTERIOR = (
    "is no prior: its errors do not explain its curves, or the crank's zero of its recordings is unknown, so pins "
    "and teeth have other numbers in others"
)


def _is_of(fitted: Pair, nominal: Pair) -> bool:
    """Whether a fitted pair is a nominal one, except for what a fit changes: its bearings, bodies and friction."""
    return _unfitted(fitted) == _unfitted(nominal)


def _unfitted(pair: Pair) -> tuple[str, Supports | None, Bodies | None, bool]:
    """Return what no fit changes: gears, bearings and bodies without their sizes, and whether there is friction."""
    bodies = pair.bodies and pair.bodies.with_factors({name: None for name, _ in pair.bodies.stated()})
    gears = pair.nominal.replace(supports=None, bodies=None, losses=None).text
    return gears, _without_sizes(pair.supports), bodies, pair.losses is not None


def _without_sizes(supports: Supports | None) -> Supports | None:
    """Return supports whose bearings have no clearance, and unit stiffness or length where they state one."""
    if supports is None:
        return None
    bearings = {name: bearing for name in BEARINGS if (bearing := getattr(supports, name, None)) is not None}
    return supports.model_copy(
        update={
            name: bearing.model_copy(
                update={"clearance": 0.0}
                | {size: 1.0 for size in ("stiffness", "roller_length") if getattr(bearing, size, None) is not None}
            )
            for name, bearing in bearings.items()
        }
    )


def read_posterior(path: str | os.PathLike[str], drive: Drive) -> Posterior:
    """Read the posterior of an identification file.

    A file written by versions without one states no single pins and teeth: these are then unknown again, with their
    estimated sizes, and the errors have their stated covariance.

    Parameters
    ----------
    path
        The file, `cycloid-identification/1`.
    drive
        The nominal drive.

    Raises
    ------
    edge.InputError
        If it can't be read, is of another drive, or is no prior.
    """
    data = edge.json_table(path, FORMAT, "identification")
    with edge.parsed_by_others(path, "it is not as identify writes it"):
        pair = parse_pair(data["pair"], str(path))
        if not _is_of(pair, drive.pair):
            raise edge.InputError(f"{path}: it is a fit of another drive.")
        given = data.get("posterior", _without_scatter(path, data, pair))
        if given is None:
            raise edge.InputError(f"{path}: it {_NO_POSTERIOR}.")
        values = {name: float(p["value"]) for name, p in data["parameters"].items()}
        scatter, names = scatter_names(pair), (*given["errors"], *given["bench"])
        mean = np.array(given["mean"], dtype=float).reshape(len(names) + len(scatter))
        factor = np.zeros((mean.size, mean.size))
        factor[np.tril_indices(mean.size)] = np.concatenate([np.array(row, dtype=float) for row in given["factor"]])
        if not (np.isfinite(mean).all() and np.isfinite(factor).all()):
            raise ValueError("not finite")
        values |= dict(zip(given["errors"], mean.tolist(), strict=False))
        plain = with_structured(surface_of_pair(pair), values)
        surface = with_scatter(plain, mean[len(names) :])
        used = given.get("data", list(data["data"].values()))
        surface = surface.replace(attributes={"data": " ".join(map(str, used))})
        stage = drive.first_stage
        if stage is not None and PLAY in data.get("bearings", {}):
            stage = with_play(stage, float(data["bearings"][PLAY]["value"]) - stage.crank_play)
        at = len(given["errors"])
        about = posterior_about(
            Drive(pair, surface, stage), given["errors"], given["bench"], mean[at : len(names)], factor @ factor.T
        )
        return dataclasses.replace(about, plain=plain, mean=mean)


def _without_scatter(path: str | os.PathLike[str], data: Mapping[str, Any], pair: Pair) -> dict[str, Any] | None:
    """Return the posterior of a file that states none, from its errors and bench."""
    if data["validation"]["state"] == "not explained" or "crank_angle_offset" in data["bench"]:
        return None
    known, errors = read_lmfit_parameters(path), list(data["correlation"]["of"])
    every = {*data["bench"], *data.get("bearings", {})}
    bench = [n for n in lasting([*known], mounted=False) if n in every and known[n].stderr]
    names = [*errors, *bench]
    # The standard errors of errors allow for a form of the flanks, those of lmfit do not.
    size = np.array([data["parameters"][n]["standard_error"] if n in errors else known[n].stderr for n in names])
    rows = [[1.0 if m == n else (known[n].correl or {}).get(m, 0.0) for m in names] for n in names]
    covariance = np.array(rows) * np.outer(size, size)
    spread = spread_of(pair, data["scatter"])
    bearings = {*data.get("bearings", {})}
    mean = [0.0 if n in bearings else known[n].value for n in names]
    whole = np.zeros((len(names) + spread.size,) * 2)
    whole[: len(names), : len(names)] = covariance
    whole[range(len(names), len(whole)), range(len(names), len(whole))] = spread**2
    return {"errors": errors, "bench": bench, "mean": [*mean, *[0.0] * spread.size], "factor": factor_rows(whole)}
