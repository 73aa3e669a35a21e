"""The update: the most likely drive from prior and measurements, and how well the two agree.

Gauss-Newton steps on the exact contact model with the derivatives of the fit; this is the iterated extended Kalman
filter (Bell and Cathey, IEEE Trans. Autom. Control 38 (1993) 294). Unknowns are scaled by a factor of their prior
covariance, so unknowns with zero variance stay exactly constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.estimation.fit import OUTLYING
from fitting.model.bearings import pair_with
from fitting.model.first_stage import with_play
from fitting.model.gaussian import Evidence, Gaussian, factor_of
from fitting.model.losses import is_coefficient
from fitting.model.observations import State, left_of, scatter_names
from fitting.model.unknowns import Unknowns
from fitting.recalibration.known import Known
from fitting.recalibration.measured import Field, linearised

Array = NDArray[np.float64]

_STEPS, _HALVED = 8, 4  # most evaluations of an update, and most halvings of a step
# A step that reduces the sum of squares (in units of the noise) by less than this per unknown, or per row if there are
# fewer rows, is the last one. It is taken in the linear model: the mean step is then below 0.22 standard deviations.
_SETTLED = 0.05
# The same for the first steps, with few points, and for the first steps with all points.
_BEGUN, _TO_ALL = 0.5, 0.1
_FLAT = 1e-9  # relative to the largest singular value: combinations of zeros that others already explain
_OUTLYING_SHARE = 0.01  # of the points: if more are far off, they are not outliers
_TOLD = 0.1  # information relative to the prior's: combinations with less are not tested
_LOCAL = (
    "output_angle_offset",
    "loop_angle_offset",
    "output_angle_drift",
    "output_angle_creep",
    "output_angle_hysteresis",
    "friction",
    "loop_fr",
)


@dataclass(frozen=True)
class Updated:
    """Result of an update.

    Attributes
    ----------
    drive
        The drive, its surface with its covariance.
    known
        Its distribution.
    moved
        {name: (change in m, rad or as a share; the same in expected standard deviations)} of every error, bearing,
        single pin and tooth.
    told
        Information about each combination relative to the prior's, largest first: 1 halves a variance.
    drift_square, drift_chance
        χ² of the change of the determined combinations, and its probability by wear alone.
    left, row_variance
        Residual of each row in units of its noise, and the expected value of its square.
    left_out
        Number of outliers, which were left out.
    evaluations
        Number of evaluations of the model.
    end
        The last linear model.
    """

    drive: Drive
    known: Known
    moved: dict[str, tuple[float, float]]
    told: Array
    drift_square: float
    drift_chance: float
    left: Array
    row_variance: Array
    left_out: int
    evaluations: int
    end: Linearised


@dataclass(frozen=True)
class Linearised:
    """Rows of measurements near a state.

    Attributes
    ----------
    at
        The unknowns at the state, in units of the prior, shape (unknowns,).
    weight
        Weights of the points, as in `Observations`, shape (points,).
    left, columns
        Residual of each row in units of its noise, shape (rows,), and its derivatives with respect to the unknowns in
        SI, shape (rows, unknowns).
    """

    at: Array
    weight: Array
    left: Array
    columns: Array


class Rows:
    """Rows of measurements, their derivatives with respect to all unknowns, and a factor of the prior covariance.

    Parameters
    ----------
    drive, known, field
        The drive at the last date, its distribution before the measurements, and the measurements.
    """

    def __init__(self, drive: Drive, known: Known, field: Field) -> None:
        self.drive, self.field = drive, field
        observed = field.observed
        self.unknowns = Unknowns(drive.pair, observed, known.errors, prior=_plain(drive.surface))
        single = scatter_names(drive.pair)
        names = self.unknowns.names
        own = [n for n in names[len(known.errors) : len(names) - len(single)] if not n.startswith(_LOCAL)]
        self.bench = [*known.bench, *(n for n in own if n not in known.bench)]
        lasting = [*known.errors, *self.bench, *single]
        # Lasting unknowns of the bench are included even if these measurements do not depend on them.
        self.lasting = lasting
        own = [f"torque_of_{i}" for i in observed.running]
        flat = [n for n, one in zip(observed.bench_names, observed.bench_prior, strict=True) if np.isinf(one)]
        taken = {*lasting, *flat}
        self.names = [*lasting, *(n for n in names if n not in taken), *own]
        covariance = np.zeros((len(lasting), len(lasting)))
        was = [*known.errors, *known.bench, *single]
        at = [lasting.index(n) for n in was]
        covariance[np.ix_(at, at)] = known.covariance
        scale = dict(zip(names, self.unknowns.scale, strict=True))
        deviation = {n: scale[n] / np.sqrt(k) for n, k in zip(names, self.unknowns.known, strict=True)}
        deviation |= dict.fromkeys(own, field.own_friction)
        for name in self.bench:
            if name not in known.bench:
                covariance[lasting.index(name), lasting.index(name)] = deviation[name] ** 2
        local = np.array([deviation[n] for n in self.names[len(lasting) :]])
        self.factor = linalg.block_diag(factor_of(covariance), np.diag(local))
        self.estimated = [i for i, n in enumerate(names) if n not in flat]
        self.place = [self.names.index(names[i]) for i in self.estimated]
        mean = dict(zip(known.bench, known.bench_mean, strict=True))
        bench = np.array([mean.get(n, 0.0) for n in observed.bench_names])
        # Friction opposes the motion: the start value is its standard deviation, not zero.
        self.start = State(drive.surface, np.zeros(len(single)), bench, friction=observed.friction_prior)
        self.mean = self.unknowns.vector(self.start) * self.unknowns.scale
        self.before = np.array([mean.get(n, 0.0) for n in self.bench])
        self.lowest = dict(zip(observed.bearing_names, observed.bearing_lowest.tolist(), strict=True))
        self.form: Array | None = None

    def state(self, z: Array) -> State:
        """Return the state of unknowns in units of the prior."""
        values = self.mean.copy()
        values[self.estimated] += (self.factor @ z)[self.place]
        return self.unknowns.state(np.maximum(values, self.unknowns.low) / self.unknowns.scale)

    def evaluated(self, z: Array, field: Field | None = None) -> Linearised:
        """Linearise the rows, or those of a field with fewer points, at unknowns in units of the prior."""
        field = field or self.field
        unknowns, observed, running, state = self.unknowns, field.observed, field.running, self.state(z)
        if self.form is not None and len(self.form) != observed.measured.size:
            self.form = None  # it belongs to other points
        linear, self.form = linearised(self.drive.pair, observed, state, self.form)
        columns = unknowns.columns(observed, linear) / unknowns.scale
        # The torques of a lost motion are those at the flanks: they already include friction.
        first = unknowns.bench.stop
        columns[running:, first : first + len(observed.friction_names)] = 0.0
        by_all = np.zeros((columns.shape[0], len(self.names)))
        by_all[:, self.place] = columns[:, self.estimated]
        begins = [0, *observed.ends, observed.measured.size]
        first_own = len(self.names) - len(observed.running)
        for column, number in enumerate(observed.running, first_own):
            part = slice(begins[number], begins[number + 1])
            by_all[part, column] = observed.weight[part] * linear.by_friction[part]
        friction = (self.factor @ z)[first_own:]
        left = field.reduced(observed.weight * left_of(observed, linear, state) - by_all[:, first_own:] @ friction)
        left[running:] += [one.value / one.standard_error for one in field.lost_motions]
        base = _base(_zeros_of(field))
        return Linearised(z, observed.weight, _without(base, left), _without(base, field.reduced(by_all)))

    def solved(self, linear: Linearised) -> tuple[Array, Gaussian]:
        """Return the most likely unknowns of linear rows in units of the prior, and their distribution.

        No clearance or play is below zero in the former.
        """
        told = Evidence.of(linear.columns @ self.factor, linear.left)
        posterior = told.posterior(np.ones(linear.at.size), linear.at)
        rows = self.factor[[self.names.index(n) for n in self.lowest]]
        low = np.array([*self.lowest.values()]) - rows @ linear.at
        z = linear.at + posterior.bounded(low, np.full_like(low, np.inf), rows)
        return z, posterior


def _zeros_of(field: Field) -> Array:
    """Return the columns of the unknown zeros of the angles: they are removed from all rows instead of estimated."""
    observed = field.observed
    return field.reduced(observed.weight[:, None] * observed.bench[:, np.isinf(observed.bench_prior)])


def _without(base: Array, rows: Array) -> Array:
    """Return rows without their projection onto the base."""
    return np.asarray(rows - base @ (base.T @ rows))


def _base(zeros: Array) -> Array:
    """Return an orthonormal base of the columns of the zeros."""
    base, size, _ = np.linalg.svd(zeros, full_matrices=False)
    return np.asarray(base[:, size > _FLAT * size.max(initial=0.0)])


def _plain(surface: ErrorSurface) -> ErrorSurface:
    return surface.replace(covariance=None, covariance_of=())


def updated(drive: Drive, known: Known, field: Field, before: Updated | None = None) -> Updated:
    """Update a drive with measurements.

    Parameters
    ----------
    drive, known
        The drive and its distribution at the date of the measurements, with the drift since the last one.
    field
        The measurements.
    before
        An update with the same measurements and another noise; its last linear model is the first one here.

    Raises
    ------
    edge.InputError
        If the drive cannot carry the measured loads with errors near the known ones.
    """
    rows, coarse = Rows(drive, known, field), field.thinned()
    if before is not None:
        now, done = _nearer(rows, _reweighted(before.end, rows), field, 0)
    else:
        try:
            now = rows.evaluated(np.zeros(len(rows.names)), coarse)
        except edge.InputError:
            raise edge.InputError(
                "the drive cannot carry these loads with errors near the known ones; check torques and signs."
            ) from None
        now, done = _nearer(rows, now, coarse, 1, _SETTLED if coarse is field else _BEGUN)
        if coarse is not field:
            # Near enough that one set of derivatives with respect to the form serves all later evaluations.
            now, done = _nearer(rows, rows.evaluated(now.at), field, done + 1, _TO_ALL)
    # The last step is so small that the linear model is sufficient.
    keep = _near(now.left, field.running)
    end = now
    if not keep.all():
        base = _base(_zeros_of(field) * keep[:, None])
        left, columns = _without(base, now.left * keep), _without(base, now.columns * keep[:, None])
        now = Linearised(now.at, now.weight, left, columns)
    return _result(rows, known, now, end, keep, done)


def _nearer(rows: Rows, now: Linearised, field: Field, done: int, settled: float = _SETTLED) -> tuple[Linearised, int]:
    """Step until one more linear step reaches the most likely drive; return the rows, and the evaluations so far."""
    settled *= min(len(rows.names), now.left.size)
    while done < _STEPS:
        step = rows.solved(now)[0] - now.at
        square = _square(now)
        expected = now.left - now.columns @ (rows.factor @ step)
        if square - float(expected @ expected + (now.at + step) @ (now.at + step)) < settled:
            break
        for _ in range(_HALVED):
            try:
                then = rows.evaluated(now.at + step, field)
                done += 1
            except edge.InputError:
                # No contacts balance the load this far away.
                step = 0.5 * step
                continue
            if _square(then) <= square:
                now = then
                break
            step = 0.5 * step
        else:
            break
    return now, done


def _square(linear: Linearised) -> float:
    """Return the sum of squares with the prior, in units of the noise."""
    return float(linear.left @ linear.left + linear.at @ linear.at)


def _reweighted(linear: Linearised, rows: Rows) -> Linearised:
    """Return linear rows with the noise of other rows; the zeros of the angles are removed again."""
    running, weight = rows.field.running, rows.field.observed.weight
    share = np.ones(linear.left.size)
    share[:running] = weight[:running] / linear.weight[:running]
    base = _base(_zeros_of(rows.field))
    left, columns = _without(base, share * linear.left), _without(base, share[:, None] * linear.columns)
    return Linearised(linear.at, weight, left, columns)


def _near(left: Array, running: int) -> NDArray[np.bool_]:
    """Return a mask of the rows that are used: all except outliers, or all if there are too many outliers."""
    far = np.abs(left) > OUTLYING * max(1.0, 1.4826 * float(np.median(np.abs(left))))
    far[running:] = False
    return ~far if np.count_nonzero(far) <= _OUTLYING_SHARE * left.size else np.ones(left.size, bool)


def _result(
    rows: Rows, known: Known, linear: Linearised, end: Linearised, keep: NDArray[np.bool_], done: int
) -> Updated:
    """Return the solution of the equations `linear`, which are those at the `end` without outliers."""
    z, posterior = rows.solved(linear)
    inverse = posterior.covariance
    left = linear.left - linear.columns @ (rows.factor @ (z - linear.at))
    lasting, drive, state = len(rows.lasting), rows.drive, rows.state(z)
    whole = rows.factor[:lasting, :lasting]
    after = inverse[:lasting, :lasting]
    covariance = whole @ after @ whole.T
    covariance = 0.5 * (covariance + covariance.T)
    count, single = len(known.errors), len(scatter_names(drive.pair))
    shift = (rows.factor @ z)[:lasting]
    bench_mean = rows.before + shift[count : lasting - single]
    # The means of bearings and first stage are in the returned drive.
    bench_mean[[rows.bench.index(n) for n in rows.lowest]] = 0.0
    # From now on the pair states its friction as numbers, and what friction does otherwise is each run's own.
    lasts = np.array([not is_coefficient(n) for n in rows.lasting])
    of_bench = lasts[count : lasting - single]
    bench = tuple(n for n in rows.bench if not is_coefficient(n))
    found = Known(known.errors, bench, bench_mean[of_bench], covariance[np.ix_(lasts, lasts)])
    pair, stage = pair_with(drive.pair, state.bearings, rounded=True), drive.first_stage
    if stage is not None:
        stage = with_play(stage, float(state.bearings[-1]))
    surface = state.surface.replace(
        pair=pair.nominal,
        origin="identified",
        covariance_of=(*known.errors, *scatter_names(drive.pair)),
        covariance=found.of_surface(),
    )
    # Before the measurement the covariance of z is the unit matrix minus the posterior covariance.
    went = np.eye(lasting) - after
    values, vectors = np.linalg.eigh(0.5 * (went + went.T))
    order = np.argsort(-values)
    values, vectors = np.clip(values[order], 0.0, 1.0), vectors[:, order]
    told = values / np.maximum(1.0 - values, 1e-15)
    tested = told > _TOLD
    ways = vectors.T[tested] @ z[:lasting]
    drift = float(ways**2 @ (1.0 / values[tested]))
    expected = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", whole, went, whole), 0.0))
    moved = {
        name: (float(by), float(by / one) if one > 0.0 else 0.0)
        for name, by, one in zip(rows.lasting, shift, expected, strict=True)
        if name not in rows.bench or (name in rows.lowest and name in bench)
    }
    of_lost_motions = linear.columns[rows.field.running :] @ rows.factor
    variance = 1.0 - np.einsum("ij,jk,ik->i", of_lost_motions, inverse, of_lost_motions)
    return Updated(
        Drive(pair, surface, stage),
        found,
        moved,
        told,
        drift,
        float(special.chdtrc(max(np.count_nonzero(tested), 1), drift)),
        left,
        np.concatenate([np.ones(rows.field.running), np.maximum(variance, 1e-9)]),
        int(np.count_nonzero(~keep)),
        done,
        end,
    )
