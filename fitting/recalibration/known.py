"""The state between two dates: a normal distribution of the errors of a drive, widened by wear."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import profile_names
from fitting.model.bearings import PLAY, sizes_of, unknown_bearings
from fitting.model.observations import PIN_RADIUS, PROFILE_ORDERS, scatter_names

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


@dataclass(frozen=True)
class Known:
    """A normal distribution of all unknowns that are the same at the next date, except for drift.

    Attributes
    ----------
    errors
        Structured errors: the names of a surface's `covariance_of` before those of the scatter.
    bench
        The other lasting unknowns: stiffness, clearance and play of bearings and first stage, with the names of
        `fitting.model.bearings`; errors of the output reference; compliance of the chain.
    bench_mean
        Mean of `bench`, SI, shape (bench,); 0 for bearings, because their mean is in the drive's pair and first stage.
        The mean of errors and scatter is the drive's surface.
    covariance
        Covariance of errors, bench and scatter in this order, SI.
    """

    errors: tuple[str, ...]
    bench: tuple[str, ...]
    bench_mean: Array
    covariance: Array

    def names(self, pair: Pair) -> list[str]:
        """Return the names of the covariance's rows."""
        return [*self.errors, *self.bench, *scatter_names(pair)]

    def of_surface(self) -> Array:
        """Return the covariance of errors and scatter, without the bench."""
        count = len(self.errors)
        own = np.r_[:count, count + len(self.bench) : len(self.covariance)]
        found: Array = self.covariance[np.ix_(own, own)]
        return found


def known_of(drive: Drive) -> Known:
    """Return the state of a drive whose surface has the covariance of a fit.

    Bearings and first stage have the prior uncertainty of a fit; the bench is unknown.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance.
    """
    pair, surface = drive.pair, drive.surface
    if surface.covariance is None:
        raise edge.ArgumentError("drive", "has no covariance of a fit; give what identify or recalibrate found")
    single = scatter_names(pair)
    names = surface.covariance_of
    errors = [n for n in names if n not in set(single)]
    # Flanks do not wear evenly, so their form is unknown too.
    errors += [n for n in (WEAR, *profile_names(PROFILE_ORDERS)) if n not in errors]
    bearings = unknown_bearings(pair, drive.first_stage)
    found = Known(tuple(errors), bearings, np.zeros(len(bearings)), np.zeros((0, 0)))
    every = found.names(pair)
    variance = np.zeros(len(every))
    variance[len(errors) : len(errors) + len(bearings)] = sizes_of(pair, drive.first_stage) ** 2
    covariance = np.diag(variance)
    at = [every.index(n) for n in names]
    covariance[np.ix_(at, at)] = surface.covariance
    return dataclasses.replace(found, covariance=covariance)


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
    """
    walked = drift * np.sqrt(crank_turns / REFERENCE_TURNS)
    sizes = {"clearance": 1.0, "stiffness": _STIFFNESS, PLAY.rpartition("_")[2]: 1.0 / _FLANK}
    found: Array = walked * np.array([sizes.get(name.rpartition("_")[2], 0.0) for name in names])
    return found


def drifted(known: Known, pair: Pair, crank_turns: float, drift: float) -> Known:
    """Return the state after a number of crank turns without measurements; the bench does not drift."""
    walked = drift_of(pair, known.errors, crank_turns, drift)
    count = len(known.errors)
    added = np.concatenate([walked[:count], bearing_drift(known.bench, crank_turns, drift), walked[count:]]) ** 2
    return dataclasses.replace(known, covariance=known.covariance + np.diag(added))
