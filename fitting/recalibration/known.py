"""What is known of a drive between two dates: a normal distribution of its errors, which wear widens."""

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
from fitting.model.observations import PIN_RADIUS, PROFILE_ORDERS, scatter_names

Array = NDArray[np.float64]

WEAR = "pin_radius"
"""The error that wear of flanks and pins is told by: on a disc pins that are thinner do what worn flanks do."""
REFERENCE_TURNS = 1e7
"""Crank turns for which a drift is stated: 280 h at 600 rpm."""
DRIFT = 1e-6
"""Standard deviation of the uniform wear in so many crank turns, m."""
_OTHERS = 0.3  # of the uniform wear: how far every other structured error and order of the flanks' form may drift
_SINGLE = 0.2  # of it: by how much single pins and teeth wear otherwise than all do
_WORN = ("pin_radial", "pin_tangential", "tooth_cumulative_pitch", PIN_RADIUS)
_ARM = 0.1  # m: of errors that are angles, by how much an error in m at this arm turns


@dataclass(frozen=True)
class Known:
    """A normal distribution of everything that lasts from one date to the next.

    Attributes
    ----------
    errors
        Structured errors, as a surface's `covariance_of` has them before the scatter.
    bench
        What of the bench lasts: the reference's own errors, the chain's compliance.
    bench_mean
        Its mean, SI, shape (bench,). The mean of errors and scatter is the drive's surface.
    covariance
        Of errors, bench and scatter in this order, SI.
    """

    errors: tuple[str, ...]
    bench: tuple[str, ...]
    bench_mean: Array
    covariance: Array

    def of_surface(self) -> Array:
        """Return the covariance of errors and scatter alone."""
        count = len(self.errors)
        own = np.r_[:count, count + len(self.bench) : len(self.covariance)]
        found: Array = self.covariance[np.ix_(own, own)]
        return found


def known_of(drive: Drive) -> Known:
    """Return what is known of a drive whose surface has the covariance of a fit; nothing is known of the bench.

    Raises
    ------
    edge.ArgumentError
        If the surface has no covariance, or the drive stands on bearings or behind a first stage.
    """
    pair, surface = drive.pair, drive.surface
    if pair.supports is not None or drive.first_stage is not None:
        raise edge.ArgumentError(
            "drive", "stands on bearings or behind a first stage; gear pairs without them can be recalibrated so far"
        )
    if surface.covariance is None:
        raise edge.ArgumentError("drive", "has no covariance of a fit; give what identify or recalibrate found")
    single = scatter_names(pair)
    names = surface.covariance_of
    errors = [n for n in names if n not in set(single)]
    # Flanks do not wear evenly.
    errors += [n for n in (WEAR, *profile_names(PROFILE_ORDERS)) if n not in errors]
    every = [*errors, *single]
    covariance = np.zeros((len(every), len(every)))
    at = [every.index(n) for n in names]
    covariance[np.ix_(at, at)] = surface.covariance
    return Known(tuple(every[: len(every) - len(single)]), (), np.zeros(0), covariance)


def drift_of(pair: Pair, errors: Sequence[str], crank_turns: float, drift: float) -> Array:
    """Return how far errors and the scatter drift in so many crank turns, standard deviations, m or rad.

    A random walk: the variance grows with the turns, so that one long interval and many short ones say the same.
    The uniform wear drifts by `drift` (m) in `REFERENCE_TURNS`; other errors by a share of it, single pins and
    teeth by a smaller one.
    """
    walked = drift * np.sqrt(crank_turns / REFERENCE_TURNS)
    size = [walked if n == WEAR else _OTHERS * walked / (_ARM if n.startswith("misalignment") else 1.0) for n in errors]
    single = [_SINGLE * walked * (n.rpartition("_at_")[0] in _WORN) for n in scatter_names(pair)]
    return np.array([*size, *single])


def drifted(known: Known, pair: Pair, crank_turns: float, drift: float) -> Known:
    """Return what is known of the same after so many crank turns; what of the bench lasts does not drift."""
    walked = drift_of(pair, known.errors, crank_turns, drift) ** 2
    count = len(known.errors)
    added = np.concatenate([walked[:count], np.zeros(len(known.bench)), walked[count:]])
    return dataclasses.replace(known, covariance=known.covariance + np.diag(added))
