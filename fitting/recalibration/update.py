"""The update of a drive: a fit whose prior is what is known of it at the date, and how far the two agree."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.estimation.continuation import state_before
from fitting.estimation.fit import Estimate, fit
from fitting.estimation.result import inflation_of
from fitting.model.bearings import pair_with, unknown_bearings
from fitting.model.first_stage import with_play
from fitting.model.observations import Linear, Observations, State
from fitting.model.posterior import Posterior, fitted_to, lasting
from fitting.model.prior import posterior_about
from fitting.model.unknowns import Unknowns
from fitting.recalibration.measured import SIZES, linear_near

Array = NDArray[np.float64]

_COARSE = 2500  # number of points in the first steps of an update
# A step that reduces the sum of squares (in units of the noise) by less than this per unknown, or per row if there are
# fewer rows, is the last one. It is taken in the linear model: the mean step is then below 0.22 standard deviations.
_SETTLED = 0.05
_COARSELY = 0.5  # the same for the first steps, with few points
_WHITE = 1.05  # times: a residual whose mean scatters by less more than white noise is white
_TESTED = 0.1  # information relative to the prior's: combinations with less are not tested
_ROUNDING = 1e-12  # variance relative to those of the unknowns in a combination


@dataclass(frozen=True)
class Updated:
    """Result of an update.

    Attributes
    ----------
    posterior
        The drive and its distribution.
    moved
        {name: (change in m, rad or as a share; the same in expected standard deviations)} of every error, bearing,
        single pin and tooth.
    told
        Information about each combination relative to the prior's, largest first: 1 halves a variance.
    drift_square, drift_chance
        χ² of the change of the determined combinations, and its probability by wear alone.
    observed
        The observations, with their noise and without outliers.
    residual, variance
        Residual of each row in units of its noise, and the expected value of its square.
    evaluations
        Number of evaluations of the model.
    """

    posterior: Posterior
    moved: dict[str, tuple[float, float]]
    told: Array
    drift_square: float
    drift_chance: float
    observed: Observations
    residual: Array
    variance: Array
    evaluations: int

    @property
    def outliers(self) -> int:
        """Number of points that were left out."""
        return int(np.count_nonzero(self.observed.weight == 0.0))


def with_joint(earlier: Posterior, observed: Observations) -> Posterior:
    """Return what is known of a drive with the unknowns of its joint that a first visit adds, and that last."""
    unknowns = Unknowns(earlier.drive.pair, observed, earlier.errors)
    deviations = dict(zip(unknowns.names, unknowns.scale / np.sqrt(unknowns.known), strict=True))
    return earlier.with_unknowns(
        {n: deviations[n] for n in lasting(unknowns.names, mounted=True) if n not in set(earlier.names)}
    )


def updated(observed: Observations) -> Updated:
    """Update a drive with measurements.

    Parameters
    ----------
    observed
        Measurements, with what is known of the drive at their date (`earlier`).

    Raises
    ------
    edge.InputError
        If the drive cannot carry the measured loads with errors near the known ones.
    """
    assert observed.earlier is not None
    earlier = with_joint(observed.earlier, observed)
    observed = dataclasses.replace(observed, earlier=earlier)
    state, done = state_before(earlier, observed), 0
    if observed.measured.size > _COARSE:
        start = _fitted(observed.thinned(_COARSE), state, _COARSELY)
        state, done = start.state, start.evaluations
    estimate = _fitted(observed, state, _SETTLED)
    residuals = observed.rows_of_curves(_last_step(estimate)[1])
    times = inflation_of([residuals[i] for i in observed.running]) if observed.running else 1.0
    if times > _WHITE:
        share = np.where(observed.of_lost_motions, 1.0, 1.0 / times)
        noisier = dataclasses.replace(estimate.observed, weight=share * estimate.observed.weight)
        done += estimate.evaluations
        estimate = _stepped(noisier, estimate.state, _SETTLED, estimate.linear)
    return _result(earlier, estimate, done + estimate.evaluations)


def _fitted(observed: Observations, state: State, settled: float) -> Estimate:
    """Return the fit of observations from a state, near which the slow parts of the model are linear."""
    assert observed.earlier is not None
    try:
        observed, linear = linear_near(observed, observed.earlier.drive, state)
    except edge.InputError:
        raise edge.InputError(
            "the drive cannot carry these loads with errors near the known ones; check torques and signs."
        ) from None
    bench = np.zeros(len(observed.bench_names))
    bench[: state.bench.size] = state.bench
    return _stepped(observed, dataclasses.replace(state, bench=bench), settled, linear)


def _stepped(observed: Observations, state: State, settled: float, linear: Linear) -> Estimate:
    assert observed.earlier is not None
    pair, errors = observed.earlier.drive.pair, observed.earlier.errors
    unknowns = len(errors) + len(observed.bench_names) + linear.scatter.shape[1]
    gain = settled * min(unknowns, observed.rows(observed.measured).size)
    # Noise and the sizes of the scatter are known.
    return fit(pair, observed, errors, state, SIZES, gain=gain, linear=linear, estimated=False)


def _last_step(estimate: Estimate) -> tuple[Array, Array]:
    """Return the unknowns of the linear model's optimum, in their scale, and the residual of each row there.

    No clearance or play is below zero.
    """
    unknowns, vector = estimate.unknowns, estimate.vector
    low, high = unknowns.low / unknowns.scale - vector, unknowns.high / unknowns.scale - vector
    step = estimate.posterior.bounded(low, high)
    return vector + step, estimate.residual - estimate.columns @ step


def _result(before: Posterior, estimate: Estimate, evaluations: int) -> Updated:
    """Return the drive at the optimum of the linear model, and what the measurements have changed."""
    unknowns, observed = estimate.unknowns, estimate.observed
    vector, residual = _last_step(estimate)
    at = [i for i, n in enumerate(unknowns.names) if n in set(before.names)]
    inverse, scale = estimate.posterior.covariance, unknowns.scale[at]
    mean, covariance = before.updated(
        [unknowns.names[i] for i in at], vector[at] * scale, inverse[np.ix_(at, at)] * np.outer(scale, scale)
    )
    shift = mean - before.mean
    expected = np.sqrt(np.maximum(np.diag(before.covariance - covariance), 0.0))
    told, square, count = _change(before.covariance, covariance, shift)
    return Updated(
        posterior=_with_state(before, unknowns.state(vector), mean, covariance, [c.checksum for c in observed.curves]),
        moved={
            name: (by, by / size if size > 0.0 else 0.0)
            for name, by, size in zip(before.names, shift.tolist(), expected.tolist(), strict=True)
            if name not in before.bench or name in observed.bearing_names
        },
        told=told,
        drift_square=square,
        drift_chance=float(special.chdtrc(max(count, 1), square)),
        observed=observed,
        residual=residual,
        variance=1.0 - np.einsum("ij,jk,ik->i", estimate.columns, inverse, estimate.columns),
        evaluations=evaluations,
    )


def _change(before: Array, after: Array, shift: Array) -> tuple[Array, float, int]:
    """Compare a change with what measurements have told.

    Parameters
    ----------
    before, after, shift
        Covariance before and after the measurements, and the change of the mean.

    Returns
    -------
    told
        Information about each combination of unknowns relative to that before, largest first.
    square, count
        χ² of the change of the combinations that are tested, and their number.
    """
    size = np.sqrt(np.diag(before))
    varies = size > 0.0
    unit = size[varies]
    variances, axes = np.linalg.eigh(before[np.ix_(varies, varies)] / np.outer(unit, unit))
    inside = variances > _ROUNDING
    # In these combinations the covariance before is the unit matrix.
    combined = (axes[:, inside] / np.sqrt(variances[inside])).T / unit
    lost = np.eye(len(combined)) - combined @ after[np.ix_(varies, varies)] @ combined.T
    values, vectors = np.linalg.eigh(0.5 * (lost + lost.T))
    values, vectors = np.clip(values[::-1], 0.0, 1.0), vectors[:, ::-1]
    told = values / np.maximum(1.0 - values, 1e-15)
    tested = told > _TESTED
    ways = vectors.T[tested] @ (combined @ shift[varies])
    constants = np.zeros(size.size - told.size)
    return np.append(told, constants), float(ways**2 @ (1.0 / values[tested])), int(np.count_nonzero(tested))


def _with_state(before: Posterior, state: State, mean: Array, covariance: Array, checksums: Sequence[str]) -> Posterior:
    """Return the distribution about the drive of a state; its bearings and first stage are in the drive.

    `checksums`: of the recordings that have led from `before` to it, "" for other measurements.
    """
    pair, stage = pair_with(before.drive.pair, state.bearings, rounded=True), before.drive.first_stage
    if stage is not None:
        stage = with_play(stage, float(state.bearings[-1]))
    changed = dataclasses.replace(before, mean=mean, covariance=covariance)
    surface = state.surface.replace(
        pair=pair.nominal,
        origin="identified",
        covariance_of=(*before.errors, *before.scatter),
        covariance=changed.of_surface,
        attributes={"data": " ".join(dict.fromkeys([*fitted_to(before.drive.surface), *filter(None, checksums)]))},
    )
    bench = changed.bench_mean.copy()
    bench[[before.bench.index(n) for n in unknown_bearings(pair, stage)]] = 0.0
    return posterior_about(Drive(pair, surface, stage), before.errors, before.bench, bench, covariance)
