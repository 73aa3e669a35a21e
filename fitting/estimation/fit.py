"""The fit of a drive's errors, its bench, and the scatter of every single pin and tooth, all together.

Gauss-Newton steps on the exact contact model with its analytic derivatives, damped where they do not decrease the
misfit (where pins come into contact the curves have corners). Single pins and teeth are random displacements whose
variance is not known: with every step it is estimated together with each curve's noise by restricted maximum
likelihood, from the same normal equations (MacKay, Neural Computation 4 (1992) 415, section 4; Harville, J. Am. Stat.
Assoc. 72 (1977) 320).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value
from fitting.model.gaussian import Evidence, Gaussian
from fitting.model.near_drive import NearDrive
from fitting.model.observations import (
    KNOWN_SIZES,
    PIN_RADIUS,
    RADIUS_SPREAD,
    Linear,
    Observations,
    State,
    joined,
    left_of,
    linearised_curve,
    scatter_parts,
    split,
)
from fitting.model.unknowns import NO_SCATTER, Unknowns

Array = NDArray[np.float64]

OUTLYING = 6.0  # robust standard deviations from the fit; noise alone has one such sample in 5e8
EVALUATIONS = 60  # of one fit, which needs ten to thirty
_FIRST_DAMPING, _UNDAMPED = 1e-3, 1e-9  # shares of the information; the smaller one changes no step
_DAMPED, _DAMPING_STEP = 1e-2, 10.0  # at least after a step without gain, and the factor from one step to the next
_AS_PROMISED = 0.5  # of the promised gain: after a step that brings more the damping falls
_LITTLE = 4.0  # times the gain at which a fit ends: a smaller promise that a step did not keep is not pursued
_PATIENCE = 3  # steps in a row that may bring less than they should, at the curves' corners
TURNS = 3  # fewer do not say how they scatter
_ROUNDS, _LINEAR = 40, 0.02  # of the variances' fixed point on one model, where a step promises so little a point
_SETTLED = 3e-3  # relative change of a deviation with one round, which comes near by ever smaller ones; in a start more
_SIZES = np.geomspace(0.05, 20.0, 32)  # times the usual one: over which a size is averaged
_SHRINKS, _GROWS = 0.1, 10.0  # by how much a variance may change with one step


@dataclass(frozen=True)
class Estimate:
    """The end of a fit.

    Attributes
    ----------
    pair
        The nominal pair.
    observed
        The observations, weighted by the noise of the fit, without outliers.
    chosen
        The fitted errors.
    state, scatter
        The errors and the bench; standard deviation of each scattered pattern, m; of the bench's groups, rad,
        of the chain rad/(N·m).
    linear
        The model at that state.
    misfit
        Weighted sum of squares with the priors, in units of the noise.
    unlikelihood
        -2 log of the restricted likelihood except for a constant; ranks fits of the same points. Unnecessary scatter
        makes it larger.
    evaluations
        Number of evaluations of the model at all points, with its derivatives.
    disagreeing
        Number of starts from which a fit of some of the points ended in different optima; 0 if two of them agreed.
    """

    pair: Pair
    observed: Observations
    chosen: tuple[str, ...]
    state: State
    scatter: dict[str, float]
    linear: Linear
    misfit: float
    unlikelihood: float
    evaluations: int
    disagreeing: int = 0

    @cached_property
    def unknowns(self) -> Unknowns:
        """The unknowns."""
        return Unknowns(self.pair, self.observed, self.chosen)

    @cached_property
    def vector(self) -> Array:
        """The unknowns' values, in their scale."""
        return self.unknowns.vector(self.state)

    @cached_property
    def precision(self) -> Array:
        """Prior precision of the unknowns, in their scale."""
        return self.unknowns.precision(self.scatter)

    @cached_property
    def residual(self) -> Array:
        """Residual in units of the noise, shape (rows,): those of the points, or of a lost motion one."""
        return self.observed.rows(self.observed.weight * left_of(self.observed, self.linear, self.state))

    @cached_property
    def columns(self) -> Array:
        """Derivatives of the model by the unknowns in their scale, in units of the noise, shape (rows, unknowns)."""
        return self.observed.rows(self.unknowns.columns(self.observed, self.linear))

    @cached_property
    def evidence(self) -> Evidence:
        """What the points and earlier measurements tell of the unknowns."""
        return Evidence.of(self.columns, self.residual) + self.unknowns.earlier(self.vector)

    @cached_property
    def posterior(self) -> Gaussian:
        """Distribution of the unknowns in their scale, as distances from where the fit ended."""
        along = self.unknowns.along(self.vector)
        return self.evidence.posterior(self.precision, self.vector, self.unknowns.names, along)

    @cached_property
    def unlikelihood_of_all(self) -> float:
        """-2 log of the restricted likelihood if all errors, fitted or held, have their tolerance as prior.

        Unlike `unlikelihood` it ranks fits with different errors.
        """
        unknowns = Unknowns(self.pair, self.observed, self.observed.errors)
        precision, seen = unknowns.precision(self.scatter), self.observed.weight[self.observed.weight > 0.0]
        precision[unknowns.errors] = 1.0
        stated = [structured_value(unknowns.prior, n) for n in self.observed.errors]
        away = unknowns.vector(self.state)
        away[unknowns.errors] -= stated / unknowns.scale[unknowns.errors]
        posterior = Evidence.of(unknowns.columns(self.observed, self.linear)).posterior(precision)
        weight = float(np.log(precision).sum() + 2.0 * np.log(seen).sum())
        own = self.misfit - float(self.precision @ self.vector**2) + float(precision @ away**2)
        return own + posterior.log_determinant - weight

    @property
    def misfit_with_priors(self) -> float:
        """Sum of squares of the residual and of the unknowns' distances from their priors."""
        return self.evidence.square + float(self.precision @ self.vector**2)

    @property
    def noises(self) -> Array:
        """Noise of a point of each curve, rad."""
        return np.array([1.0 / np.median(w[w > 0.0]) for w in np.split(self.observed.weight, self.observed.ends)])

    @property
    def noise(self) -> float:
        """Noise of a point, the geometric mean over the curves without loops, rad."""
        return float(np.exp(np.mean(np.log(self.noises[self.observed.running]))))


@dataclass(frozen=True)
class _Normal:
    """The model of each curve at some unknowns, and its normal equations in units of the noise.

    `gram` (curves, unknowns, unknowns), `moment` (curves, unknowns), and for each curve the sum of squares and number
    of the used points, the robust scale of all points, and the number of outliers. `earlier` is what earlier
    measurements tell there.
    """

    linears: tuple[Linear, ...]
    gram: Array
    moment: Array
    square: Array
    count: Array
    scale: Array
    outlying: Array
    earlier: Evidence

    @property
    def total(self) -> Evidence:
        """What all curves and earlier measurements tell together."""
        return Evidence(self.gram.sum(axis=0), self.moment.sum(axis=0), float(self.square.sum())) + self.earlier


def _evaluated(
    unknowns: Unknowns,
    vector: Array,
    observed: Observations,
    limit: Array,
    around: Sequence[NearDrive] | None = None,
    known: Linear | None = None,
    near: Sequence[Linear] | None = None,
) -> _Normal:
    """Evaluate the model, unless it is known, and its normal equations.

    Points beyond `limit` (curves,) are not used. `near` is the model of each curve at a vector nearby.
    """
    state = unknowns.state(vector)
    parts = None if known is None else split(known, observed.ends)

    def of(number: int) -> tuple[Linear, tuple[Any, ...]]:
        curve = observed.some([number])
        if parts:
            linear = parts[number]
        else:
            solved = None if near is None else near[number].coordinates
            linear = linearised_curve(unknowns.pair, observed, number, state, around, solved)
        residual = curve.rows(curve.weight * left_of(curve, linear, state))
        is_used = curve.weight[: residual.size] > 0.0
        inside = (np.abs(residual) <= limit[number]) & is_used
        scale, count = 1.4826 * np.median(np.abs(residual[is_used])), np.count_nonzero(inside)
        columns = curve.rows(unknowns.columns(curve, linear))
        columns[~inside], residual[~inside] = 0.0, 0.0
        evidence = Evidence.of(columns, residual)
        return linear, (
            evidence.gram,
            evidence.moment,
            evidence.square,
            count,
            scale,
            np.count_nonzero(is_used) - count,
        )

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        linears, sums = zip(*pool.map(of, range(len(observed.curves))), strict=True)
    gram, moment, square, count, scale, outlying = (np.array(v) for v in zip(*sums, strict=True))
    return _Normal(linears, gram, moment, square, count, scale, outlying, unknowns.earlier(vector))


def _limits(normal: _Normal) -> Array:
    return OUTLYING * np.maximum(normal.scale, 1.0)


def fit(
    pair: Pair,
    observed: Observations,
    chosen: Sequence[str],
    state: State,
    scatter: Mapping[str, float],
    *,
    gain: float,
    around: Sequence[NearDrive] | None = None,
    linear: Linear | None = None,
    evaluations: int = EVALUATIONS,
    estimated: bool = True,
    known: Mapping[str, float] | None = None,
    damping: float = _FIRST_DAMPING,
) -> Estimate:
    """Fit errors, bench and scatter to observations.

    Parameters
    ----------
    pair, observed
        The nominal pair and the observations; their weights are the initial noise.
    chosen
        The errors to fit; the others keep the values of the pair file.
    state, scatter
        Initial state, and the standard deviation of each scattered pattern, m; of the bench's groups, rad,
        of the chain rad/(N·m).
    gain
        The fit ends when the predicted gain of a step in the sum of squares, in units of the noise, is smaller, or
        after several steps without gain.
    around
        A drive about which the model is linearised, a tenth of the work; None for the exact one.
    linear
        The model at the start, if already evaluated.
    evaluations
        Largest number of evaluations.
    estimated
        Whether the noise and the scatter's deviations are estimated as well.
    known
        Standard deviations of patterns that are not estimated, m.
    damping
        Share of the information by which the first step is damped.
    """
    known = {**{n: v for n, v in KNOWN_SIZES.items() if n in scatter_parts(pair)}, **(known or {})}
    unknowns = Unknowns(pair, observed, chosen)
    descent = _Descent(unknowns, observed, state, {**scatter, **known}, known, gain, around, linear)
    descent.run(evaluations, estimated, damping)
    return descent.end()


class _Descent:
    """Steps of a fit, with their damping, and the noise and sizes estimated between them."""

    def __init__(
        self,
        unknowns: Unknowns,
        observed: Observations,
        state: State,
        sizes: dict[str, float],
        known: Mapping[str, float],
        gain: float,
        around: Sequence[NearDrive] | None,
        linear: Linear | None,
    ) -> None:
        self.unknowns, self.observed = unknowns, observed
        self.sizes, self.known, self.gain, self.around = sizes, known, gain, around
        start = unknowns.vector(state)
        self.vector = unknowns.within(start)
        linear = linear if np.array_equal(self.vector, start) else None
        self.limit = np.full(len(observed.curves), np.inf)
        self.normal = _evaluated(unknowns, self.vector, observed, self.limit, around, linear)
        self.limit = _limits(self.normal)
        self.evaluations = 1 if linear is None else 0

    def run(self, evaluations: int, is_estimated: bool, damping: float) -> None:
        """Take steps until one promises less than the gain, or several in a row bring less than they should."""
        if is_estimated:
            self.observed, self.normal = _at_noise(self.observed, self.normal, self.normal.scale**2)
            self.limit = np.full_like(self.limit, OUTLYING)
        idle, is_settled, is_tried = 0, not is_estimated, False
        while self.evaluations < evaluations:
            precision, posterior = self._posterior()
            misfit = self._misfit(self.normal, precision, self.vector)
            # An unknown at its bound that would go beyond it stays there for this step.
            posterior = posterior.holding(self.unknowns.is_stuck(self.vector, posterior.slope))
            scale = self.unknowns.scale
            low, high = self.unknowns.low / scale - self.vector, self.unknowns.high / scale - self.vector
            step = posterior.damped(damping).bounded(low, high)
            promised = posterior.gain(step)
            if promised < self.gain and is_settled:
                return
            if promised < self.gain and not is_tried:
                # At the optimum noise and scatter settle without another evaluation of the model.
                is_settled, is_tried = self._settle(promised), True
                self.limit = _limits(self.normal)
                continue
            vector = self.unknowns.within(self.vector + step)
            self.evaluations += 1
            try:
                then = _evaluated(
                    self.unknowns, vector, self.observed, self.limit, self.around, near=self.normal.linears
                )
            except edge.InputError:
                then = None
            if then is None or (then.outlying > then.count).any():
                # So far away no contacts balance the load, or a curve is left: its noise would follow from the few
                # points that are no outliers.
                damping = max(_DAMPING_STEP * damping, _DAMPED)
                continue
            gained = misfit - self._misfit(then, precision, vector)
            idle = idle + 1 if gained < self.gain else 0
            if gained > 0.0:
                self.vector, self.normal, is_tried = vector, then, False
                damping = max(damping / _DAMPING_STEP, _UNDAMPED) if gained > _AS_PROMISED * promised else damping
                if is_estimated:
                    is_settled = self._settle(promised)
                self.limit = _limits(self.normal)
            else:
                damping = max(_DAMPING_STEP * damping, _DAMPED)
            # Near the optimum the curves' corners absorb small promised gains, here and in the next steps. Ending here
            # saves 3 of 6 evaluations of the exact fit; six curves of 720 points are identified 1.35 times as fast.
            is_near = is_settled and promised < _LITTLE * min(self.gain, 1.0)
            if idle > (0 if is_near else _PATIENCE):
                return

    def _posterior(self) -> tuple[Array, Gaussian]:
        precision, along = self.unknowns.precision(self.sizes), self.unknowns.along(self.vector)
        return precision, self.normal.total.posterior(precision, self.vector, along=along)

    def _misfit(self, normal: _Normal, precision: Array, vector: Array) -> float:
        outlying = float(normal.square.sum() + normal.outlying @ self.limit**2)
        return outlying + float(precision @ vector**2) + normal.earlier.square

    def _settle(self, promised: float) -> bool:
        """Let noise and scatter settle on the model at hand, in one round or, near the optimum, in many."""
        ahead, is_settled = np.zeros_like(self.vector), False
        little = _SETTLED * max(self.gain, 1.0)
        for _ in range(_ROUNDS if promised < _LINEAR * self.observed.measured.size else 1):
            self.observed, self.normal, self.sizes, is_settled = _variances(
                self.unknowns, self.observed, self.normal, self.sizes, self.vector, ahead, self.known, little
            )
            if is_settled:
                break
            ahead = self._posterior()[1].mean
        return is_settled

    def end(self) -> Estimate:
        """Return where the steps ended."""
        unknowns, observed, sizes = self.unknowns, self.observed, self.sizes
        precision, posterior = self._posterior()
        misfit = self._misfit(self.normal, precision, self.vector)
        seen = observed.weight[observed.weight > 0.0]
        unlikelihood = misfit + posterior.log_determinant - float(np.log(precision).sum() + 2.0 * np.log(seen).sum())
        state, linear = unknowns.state(self.vector), joined(self.normal.linears)
        off = np.abs(observed.weight * left_of(observed, linear, state)) > _each_point(observed, self.limit)
        off &= ~observed.of_lost_motions
        observed = dataclasses.replace(observed, weight=np.where(off, 0.0, observed.weight)).with_sizes(sizes)
        chosen = tuple(unknowns.chosen)
        return Estimate(unknowns.pair, observed, chosen, state, sizes, linear, misfit, unlikelihood, self.evaluations)


def _each_point(observed: Observations, values: Array) -> Array:
    return np.repeat(values, [c.input_angle.size for c in observed.curves])


def _at_noise(observed: Observations, normal: _Normal, variance: Array) -> tuple[Observations, _Normal]:
    """Express observations and normal equations in units of another noise, given in units of the previous one."""
    factor = np.sqrt(np.maximum(variance, 1e-12))
    weight = observed.weight / _each_point(observed, factor)
    return dataclasses.replace(observed, weight=weight), dataclasses.replace(
        normal,
        gram=normal.gram / factor[:, None, None] ** 2,
        moment=normal.moment / factor[:, None] ** 2,
        square=normal.square / factor**2,
        scale=normal.scale / factor,
    )


def _variances(
    unknowns: Unknowns,
    observed: Observations,
    normal: _Normal,
    scatter: Mapping[str, float],
    vector: Array,
    ahead: Array,
    known: Mapping[str, float],
    little: float,
) -> tuple[Observations, _Normal, dict[str, float], bool]:
    """Take one step of the restricted likelihood's fixed point; also return whether it changed by less than `little`.

    `ahead` is a step of the unknowns, at whose end the fixed point is evaluated with the linear model.
    """
    precision = unknowns.precision(scatter)
    covariance = normal.total.posterior(precision, along=unknowns.along(vector)).covariance
    resolved = normal.gram.reshape(len(normal.gram), -1) @ covariance.ravel()
    square = normal.square - 2.0 * normal.moment @ ahead + normal.gram @ ahead @ ahead
    # A step ahead that the linear model does not hold may promise to leave nothing.
    variance = np.maximum(square, _SHRINKS * normal.square) / np.maximum(normal.count - resolved, 1.0)
    vector = vector + ahead
    found, of_scatter = dict(known), scatter_parts(unknowns.pair)
    for name, part in unknowns.parts.items():
        if name in known:
            continue
        resolved_of = part.stop - part.start - precision[part.start] * np.trace(covariance[part, part])
        before = max(scatter.get(name, 0.0), unknowns.least(name)) ** 2
        after = float(vector[part] @ vector[part]) * unknowns.scale[part.start] ** 2 / max(resolved_of, 1e-9)
        found[name] = float(np.sqrt(np.clip(after / before, _SHRINKS, _GROWS) * before))
    hardly = all(
        abs(v - scatter.get(n, 0.0)) < little * v or v < (NO_SCATTER if n in of_scatter else unknowns.least(n))
        for n, v in found.items()
    )
    settled = hardly and bool((np.abs(variance - 1.0) < little).all())
    observed, normal = _at_noise(observed, normal, variance)
    return observed, normal, found, settled


def allowed_radius(estimate: Estimate) -> float:
    """Return the posterior root mean square of the scatter of single pins' radii, m.

    Curves hardly separate it from that of the radial places, so its most likely value is often wrongly zero. This is
    the mean over its distribution: the restricted likelihood in the linear model, all other variances unchanged, with a
    uniform prior (Gelman, Bayesian Analysis 1 (2006) 515).
    """
    unknowns, told = estimate.unknowns, estimate.evidence
    sizes = np.concatenate([[NO_SCATTER], RADIUS_SPREAD * _SIZES])
    unlikely = []
    for size in sizes:
        precision = unknowns.precision({**estimate.scatter, PIN_RADIUS: float(size)})
        posterior = told.posterior(precision, estimate.vector)
        misfit = float(precision @ estimate.vector**2) - posterior.gain(posterior.mean)
        unlikely.append(posterior.log_determinant - np.log(precision).sum() + misfit)
    log = -0.5 * np.array(unlikely)
    weight = np.exp(log - log.max())
    return float(np.sqrt(np.trapezoid(weight * sizes**2, sizes) / np.trapezoid(weight, sizes)))


def freedom(estimate: Estimate, covariance: Array, known: Collection[str]) -> Array:
    """Degrees of freedom of the fitted errors' standard errors, which depend on estimated variances of the scatter.

    The standard error of an error affected by scatter depends on the scatter's variance, estimated from the patterns
    that the data resolve: its interval is that of Student's t. With the shares s of its variance that come from each
    scatter, and γ patterns resolved of each, it has 1/Σ(s²/γ) degrees of freedom (Satterthwaite, Biometrics Bulletin 2
    (1946) 110; Giesbrecht and Burns, Biometrics 41 (1985) 477).

    Parameters
    ----------
    estimate
        The end of the fit.
    covariance
        Of all that was fitted, SI, in the order of `Unknowns.names`.
    known
        Patterns with a stated, not estimated, deviation.

    Returns
    -------
    degrees
        Shape (errors,), > 0, infinite for errors not affected by scatter.
    """
    count, parts = len(estimate.chosen), estimate.unknowns.parts
    variance = np.diag(covariance)[:count]
    blur = np.zeros(count)
    for name, part in parts.items():
        deviation = estimate.scatter.get(name, 0.0)
        if name in known or name in KNOWN_SIZES or deviation <= NO_SCATTER:
            continue
        share = (covariance[:count, part] ** 2).sum(axis=1) / deviation**2 / variance
        resolved = part.stop - part.start - np.trace(covariance[part, part]) / deviation**2
        blur += share**2 / max(resolved, 1.0)
    found: Array = np.divide(1.0, blur, out=np.full(count, np.inf), where=blur > 0.0)
    return found


def turn_bootstrap(estimate: Estimate, draws: int, seed: int) -> Array:
    """Standard errors of the fitted errors from the scatter of turns: bootstrap of the turns.

    Every draw is one Gauss-Newton step from the optimum (Shao and Tu, The Jackknife and Bootstrap, 1995, section
    4.3.4), so the contacts are not solved again. It includes disturbances that are not white noise: those that last, or
    that occur in some turns only.

    Parameters
    ----------
    estimate
        The end of the fit, of curves that keep their turns. Loops are not resampled.
    draws, seed
        Number of draws, and the seed; the same seed draws the same turns.

    Returns
    -------
    standard_error, white
        Shape (2, errors), m or rad: from the turns, and from the fit's white noise at the same points.

    Raises
    ------
    ValueError
        If a curve has fewer than `TURNS` turns.
    """
    observed = estimate.observed
    turning = [observed.curves[i] for i in observed.running]
    if any(c.each_turn is None or len(c.each_turn) < TURNS for c in turning):
        raise ValueError(f"every curve needs at least {TURNS} turns")
    errors = slice(0, len(estimate.chosen))
    step = estimate.posterior.solve(estimate.columns.T)[errors]
    step *= observed.weight * estimate.unknowns.scale[errors, None]
    generator = np.random.default_rng(seed)
    moved = np.zeros((draws, len(estimate.chosen)))
    residual = left_of(observed, estimate.linear, estimate.state)
    for curve, part in zip(observed.curves, np.split(np.arange(observed.measured.size), observed.ends), strict=True):
        if curve.each_turn is None:
            continue
        there = np.isfinite(curve.each_turn)
        # A turn's share in the step: few points have a sample of every turn.
        own = np.where(there, curve.each_turn - curve.transmission_error + residual[part], 0.0) / there.sum(axis=0)
        turns = len(own)
        taken = generator.multinomial(turns, np.full(turns, 1.0 / turns), size=draws).astype(float)
        # Drawn turns scatter less than the turns themselves: n - 1 in place of n.
        moved += np.sqrt(turns / (turns - 1.0)) * taken @ (own @ step[:, part].T)
    inside = observed.weight > 0.0
    white = np.sqrt(((step[:, inside] / observed.weight[inside]) ** 2).sum(axis=1))
    return np.array([moved.std(axis=0), white])
