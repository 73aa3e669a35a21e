"""Priors of errors: usual sizes, and those from tolerances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.sampling import Tolerances, sample_surface
from cycloid_fmu.surfaces.structured import profile_names, profile_wave, unit_of
from cycloid_fmu.surfaces.surface import Elements
from fitting.model.constraints import Constraints
from fitting.model.observations import ORDERS, PROFILE_ORDERS, estimated_parts

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
    """

    scatter: Mapping[str, float] = field(default_factory=dict)
    profile: Mapping[str, float] = field(default_factory=dict)
    first_stage: FirstStage | None = None
    constraints: Constraints | None = None


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
