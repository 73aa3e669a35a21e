"""Drift between two dates: wear widens the distribution of a drive's errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import LAWS
from cycloid_fmu.surfaces.structured import profile_names
from fitting.model.bearings import PLAY
from fitting.model.observations import PIN_RADIUS, PROFILE_ORDERS, scatter_names
from fitting.model.posterior import Posterior
from fitting.model.prior import posterior_of

Array = NDArray[np.float64]

WEAR = "pin_radius"
"""The error that represents wear of flanks and pins: on one disc, thinner pins have the effect of worn flanks."""
REFERENCE_TURNS = 1e7
"""Crank turns for which a drift is stated: 280 h at 600 rpm."""
DRIFT = 1e-6
"""Standard deviation of the uniform wear over `REFERENCE_TURNS`, m."""
_OTHERS = 0.3  # drift of every other structured error and order of the flank form, relative to the uniform wear
_SINGLE = 0.2  # additional drift of each single pin and tooth, relative to the uniform wear
_WORN = ("pin_radial", "pin_tangential", "tooth_cumulative_pitch", PIN_RADIUS)
_ARM = 0.1  # m: lever arm that converts an error in m into an angle
_FLANK = 0.02  # m: radius of the pinion of an involute stage, whose wear causes play
_STIFFNESS = 1e4  # 1/m: relative change of a bearing's stiffness for each m of uniform wear, 1 % for 1 µm


def fitted_drive(drive: Drive) -> Posterior:
    """Return what is known of a fitted drive that will wear: flanks do not wear evenly, so their form changes too.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance.
    """
    return posterior_of(drive, (WEAR, *profile_names(PROFILE_ORDERS)))


def drift_of(pair: Pair, errors: Sequence[str], crank_turns: float, drift: float) -> Array:
    """Return the drift of errors and scatter over a number of crank turns, standard deviations, m or rad.

    A random walk: the variance grows with the turns, so one long interval is equivalent to many short ones.
    The uniform wear drifts by `drift` (m) in `REFERENCE_TURNS`, other errors by a fraction of it, and single pins and
    teeth by a smaller fraction.
    """
    walked = drift * np.sqrt(crank_turns / REFERENCE_TURNS)
    size = [walked if n == WEAR else _OTHERS * walked / (_ARM if n.startswith("misalignment") else 1.0) for n in errors]
    single = [_SINGLE * walked * (n.rpartition("_at_")[0] in _WORN) for n in scatter_names(pair)]
    return np.array([*size, *single])


def bearing_drift(names: Sequence[str], crank_turns: float, drift: float) -> Array:
    """Return the drift of bearings over a number of crank turns, standard deviations, SI; 0 for all other names.

    A clearance drifts like the uniform wear, the play of a first stage by this wear over a pinion's radius, rad.
    Elastic bodies do not drift.
    """
    walked = drift * np.sqrt(crank_turns / REFERENCE_TURNS)
    sizes = {PLAY: 1.0 / _FLANK, **{law: _STIFFNESS if law.endswith("_stiffness") else 1.0 for law in LAWS}}
    sized: Array = walked * np.array([sizes.get(name, 0.0) for name in names])
    return sized


def drifted(posterior: Posterior, crank_turns: float, drift: float) -> Posterior:
    """Return what is known after a number of crank turns without measurements; the bench does not drift."""
    walked = drift_of(posterior.drive.pair, posterior.errors, crank_turns, drift)
    count = len(posterior.errors)
    of_bench = bearing_drift(posterior.bench, crank_turns, drift)
    added = np.concatenate([walked[:count], of_bench, walked[count:]]) ** 2
    return dataclasses.replace(posterior, covariance=posterior.covariance + np.diag(added))
