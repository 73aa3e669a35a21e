"""Priors of errors: usual sizes, those from tolerances, and what earlier measurements have told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.sampling import Tolerances, sample_surface
from cycloid_fmu.surfaces.structured import profile_names, profile_wave, structured_value, unit_of, with_structured
from cycloid_fmu.surfaces.surface import Elements, surface_of_pair
from fitting.model.bearings import sizes_of, unknown_bearings
from fitting.model.constraints import Constraints
from fitting.model.observations import (
    FRICTION_SHARE,
    ORDERS,
    PROFILE_ORDERS,
    errors_of,
    estimated_parts,
    scatter_between,
    scatter_names,
)
from fitting.model.posterior import Posterior, factor_rows, fitted_to

Array = NDArray[np.float64]
TOLERANCE = {"m": 5e-6, "rad": 1e-4}  # prior standard deviation of an error
_DRAWN = 100  # sampled drives for the scatter of tolerances
_PROFILE_DRAWN = 50  # elements along the profile of each drive


def tolerances_of(names: Sequence[str], stated: Mapping[str, float] | None = None) -> Array:
    """Return the default prior standard deviation of each error, m or rad."""
    return np.array([(stated or {}).get(n, TOLERANCE[unit_of(n)]) for n in names])


@dataclass(frozen=True)
class Prior:
    """Priors of single pins and teeth: {name: standard deviation, m}.

    Attributes
    ----------
    scatter
        Standard deviation of a pattern such as `pin_radial`; others are estimated from the data.
    profile
        Standard deviations of the orders of the profile deviation common to all teeth; only the named ones are fitted.
    first_stage
        First stage before the pair, as drawn.
    constraints
        What a user has decided of the unknowns.
    friction_share
        Prior size of the friction at the output over the largest torque.
    """

    scatter: Mapping[str, float] = field(default_factory=dict)
    profile: Mapping[str, float] = field(default_factory=dict)
    first_stage: FirstStage | None = None
    constraints: Constraints | None = None
    friction_share: float = FRICTION_SHARE


def posterior_of(drive: Drive, also: Sequence[str] = ()) -> Posterior:
    """Return what the fit has told whose covariance a drive's surface has.

    Its bench is unknown; bearings and first stage have the prior uncertainty of a fit.

    Parameters
    ----------
    drive
        The drive.
    also
        Further errors, which were constants in the fit.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance.
    """
    pair, surface, scatter = drive.pair, drive.surface, scatter_names(drive.pair)
    if surface.covariance is None:
        raise edge.ArgumentError("drive", "has no covariance of a fit; give what identify or recalibrate found")
    names = surface.covariance_of
    errors = [n for n in names if n not in set(scatter)]
    errors += [n for n in also if n not in errors]
    bearings = unknown_bearings(pair, drive.first_stage)
    every = [*errors, *bearings, *scatter]
    sizes = [*np.zeros(len(errors)), *sizes_of(pair, drive.first_stage), *np.zeros(len(scatter))]
    covariance = np.diag(np.square(sizes))
    at = [every.index(n) for n in names]
    covariance[np.ix_(at, at)] = surface.covariance
    return posterior_about(drive, errors, bearings, np.zeros(len(bearings)), covariance)


def posterior_about(
    drive: Drive, errors: Sequence[str], bench: Sequence[str], bench_mean: Array, covariance: Array
) -> Posterior:
    """Return a distribution about a drive: its errors are those of its surface, from which the scatter counts.

    The arguments are the attributes of a `Posterior`; the bearings' means are zero.
    """
    plain, scatter = drive.surface.replace(covariance=None, covariance_of=()), scatter_names(drive.pair)
    values = [structured_value(plain, n) for n in errors]
    mean = np.concatenate([values, bench_mean, np.zeros(len(scatter))])
    return Posterior(drive, plain, tuple(errors), tuple(bench), tuple(scatter), mean, covariance)


def posterior_as_json(posterior: Posterior) -> dict[str, Any]:
    """Return a posterior as in a `cycloid-identification/1` file, SI: `factor` times its transpose is the covariance.

    All that the surface has beside structured errors counts as scatter.
    """
    surface, orders = posterior.plain, [n for n in posterior.errors if profile_wave(n, 1) is not None]
    values = {n: structured_value(surface, n) for n in (*errors_of(posterior.drive.pair), *orders)}
    structured = with_structured(surface_of_pair(posterior.drive.pair.nominal), values)
    mean = posterior.mean.copy()
    mean[len(mean) - len(posterior.scatter) :] = scatter_between(posterior.drive.surface, structured)
    return {
        "errors": list(posterior.errors),
        "bench": list(posterior.bench),
        "mean": [float(f"{v:.12g}") for v in mean],
        "factor": factor_rows(posterior.covariance),
        "data": list(fitted_to(posterior.drive.surface)),
    }


def prior_of(pair: Pair, tolerances: Tolerances) -> Prior:
    """Return the prior from tolerances."""
    return Prior(scatter_of(pair, tolerances), profile_of(pair, tolerances))


def scatter_of(pair: Pair, tolerances: Tolerances) -> dict[str, float]:
    """Return the scatter of single pins and teeth within tolerances beyond structured orders: standard deviations, m.

    Computed from drives within the tolerances (`cycloid_fmu.surfaces.sampling.sample_surface`). A pattern without
    tolerance is left out.
    """
    drawn = [sample_surface(pair, tolerances, seed, Elements(2, 2, 1)) for seed in range(_DRAWN)]
    found = {}
    for name in estimated_parts(pair):
        spectra = np.fft.rfft(np.array([np.atleast_2d(getattr(s, name))[0] for s in drawn]), axis=-1)
        spectra[:, : max(ORDERS) + 1] = 0.0
        count = np.asarray(getattr(drawn[0], name)).shape[-1]
        deviation = float(np.sqrt(np.mean(np.fft.irfft(spectra, count, axis=-1) ** 2)))
        if deviation > 0.0:
            found[name] = deviation
    return found


def profile_of(pair: Pair, tolerances: Tolerances) -> dict[str, float]:
    """Return the sizes within tolerances of the low orders of the profile deviation that all teeth share, m.

    Cutter and grinding wheel make the same form on every tooth, so it may be as large as that of one tooth: standard
    deviation over the teeth of drives within the tolerances. Empty without a tolerance of the flanks' form.
    """
    if tolerances.gear_profile is None:
        return {}
    elements = Elements(_PROFILE_DRAWN, 2, 1)
    drawn = [sample_surface(pair, tolerances, seed, elements).gear_deviation for seed in range(_DRAWN // 10)]
    teeth = np.concatenate([d.reshape(-1, *d.shape[2:]) for d in drawn if d is not None]).mean(axis=-1)
    found = {}
    for name in profile_names(PROFILE_ORDERS):
        wave = profile_wave(name, _PROFILE_DRAWN)
        assert wave is not None
        found[name] = float(np.std(2.0 * (teeth * wave).mean(axis=1)))
    return found
