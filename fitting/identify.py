"""From transmission error curves to the drive's errors: the way to the best fit; `fitting.identification` states it.

The structured errors that the data tell apart are fitted with the exact contact model and its analytic Jacobian; lmfit
takes the last step, confirms the optimum and states its covariance. What every single pin and tooth does beyond them is
a random scatter of unknown size: it is estimated together with the noise (restricted maximum likelihood), and where
there is any it is part of the fit, so that it neither bends the structured errors nor lets their intervals look smaller
than they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.curve import Curve
from fitting.estimation import NO_SCATTER, OUTLYING, TURNS, Estimate, fit
from fitting.identifiability import chosen_errors
from fitting.identification import HeldOut, Identification, is_uneven, result_of
from fitting.loop_branches import on_the_curves_zero
from fitting.observation import (
    CREEP,
    NO_CREEP,
    Linear,
    Near,
    Observations,
    State,
    errors_of,
    left_of,
    linearise,
    near,
    observations,
    scatter_parts,
    spread_of,
    with_scatter,
)
from fitting.prior import tolerances_of

Array = NDArray[np.float64]

_MISPREDICTED = 1.5  # times the noise: a fit that predicts no better is no start for another
_START_POINTS = 4000  # of all curves together, for the way from the prior
_STARTS, _START_EVALUATIONS = 5, 30
_AGREE = 0.01  # of the points: two starts ended alike where -2 log likelihood differs by less, the noise by 0.5 %
_CRANK_STARTS = (0.0, -0.25, 0.25, 0.5)  # pin pitches, where the crank's zero is not known
_CHOICES = 3  # of errors to fit, which change where the state at which they are chosen does
# A fit ends where a step gains less than this of the sum of squares in units of the noise: what moves one estimate by a
# standard error at most, and by a tenth where it is shared among all. lmfit's steps follow.
_START_GAIN, _GAIN = 8.0, 1.0


def identify(
    curves: Sequence[Curve],
    pair: Pair,
    progress: Callable[[str], None] = lambda step: None,
    *,
    loops: Sequence[Curve] = (),
    held_out: bool = True,
    scatter: Mapping[str, float] | None = None,
    profile: Mapping[str, float] | None = None,
    profiled: Sequence[str] = (),
    bootstrap: int = 0,
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
    loops
        Branches of hysteresis loops with the input locked (`fitting.loop_branches.branches_of`).
    held_out
        Whether a load or direction is first kept from the fit and predicted.
    scatter
        {pattern: standard deviation of a single pin or tooth, m}, from tolerances: with it every pin and tooth is
        reported with its own error; a pattern that is not named is estimated from the data.
    profile
        {order of the profile deviation: what it may be, m}, from tolerances: with it the form that all teeth share is
        fitted, as far as the data tell it.
    profiled
        Errors whose intervals are found by their profile rather than by their standard error.
    bootstrap
        How often turns are drawn again to see what their scatter makes of the errors, which widens the standard
        errors where it is more than white noise; 0 for not at all. The curves must keep their turns.

    Raises
    ------
    edge.InputError
        If a curve has no load, the data tell nothing, or there are too few turns to draw from.
    """
    if bootstrap:
        for curve in curves:
            turns = 0 if curve.each_turn is None else len(curve.each_turn)
            if turns < TURNS:
                raise edge.InputError(
                    f"{curve.source}: it has {turns} output turns; at least {TURNS} are needed to draw turns again."
                )
    for name in profiled:
        if name not in (errors := [*errors_of(pair), *(profile or {})]):
            raise edge.InputError(f'"{name}" is no error of this pair; one of {", ".join(errors)}.')
    if not curves:
        raise edge.InputError(
            "there is no transmission error curve: a loop sees the drive at one crank angle only; give recordings of a "
            "turning crank too."
        )
    loops = on_the_curves_zero(loops, curves)
    for curve in (*curves, *loops):
        if abs(curve.ratio / pair.ratio - 1.0) > 1e-9:
            raise edge.InputError(
                f"{curve.source}: its ratio is {curve.ratio:g}, the pair's {pair.ratio:g}; it is of another drive."
            )
    for curve in curves:
        if abs(curve.torque) < 1e-3 * max(abs(c.torque) for c in curves) or curve.torque == 0.0:
            raise edge.InputError(
                f"{curve.source}: the mean torque is {curve.torque:g} N·m; the fit needs loaded curves."
            )
    # The kernel's threads keep the processor busy; those of linear algebra wait beside them, turning in circles.
    with threadpool_limits(limits=1, user_api="blas"):
        kept, start = kept_back(curves) if held_out else (), None
        predicted = None
        if kept:
            progress("fitting without the curves kept back")
            rest = [*(c for i, c in enumerate(curves) if i not in kept), *loops]
            start = _fitted(rest, pair, None, scatter, profile, progress)
            predicted = _predicted(pair, start, [curves[i] for i in kept])
            if predicted.residual > _MISPREDICTED * predicted.noise or is_uneven(start):
                start = None
        found = _fitted([*curves, *loops], pair, start, scatter, profile, progress)
        return result_of(pair, found, predicted, scatter or {}, profiled, bootstrap, _GAIN, progress)


def kept_back(curves: Sequence[Curve]) -> tuple[int, ...]:
    """Choose the curves that are kept back to be predicted: a load between others, or a direction of the smallest.

    Empty where fewer than three curves were measured.
    """
    if len(curves) < 3:
        return ()
    sizes = np.array([abs(c.torque) for c in curves])
    order = np.argsort(sizes)
    # Torques within a twentieth of one another are one load.
    groups = np.split(order, np.flatnonzero(np.diff(sizes[order]) > 0.05 * sizes.max()) + 1)
    if len(groups) >= 3:
        return tuple(int(i) for i in groups[len(groups) // 2])
    return (int(order[0]),)


def _predicted(pair: Pair, fit: Estimate, curves: Sequence[Curve]) -> HeldOut:
    """What is left of curves that the fit has not seen; their own zeros and drifts are nobody's to foretell."""
    observed = observations(curves, pair)
    known = dict(zip(fit.observed.bench_names, fit.state.bench, strict=True))
    own = np.array(
        [n.startswith("output_angle_drift") or not (n in known or n.startswith(CREEP)) for n in observed.bench_names]
    )
    if not all(c.common_zero for c in (*curves, *fit.observed.curves)):
        own |= np.array([n.startswith("output_angle_offset") for n in observed.bench_names])
    foretold = ~own & ~np.array([n.startswith(CREEP) for n in observed.bench_names])
    bench = np.array([known[n] if told else 0.0 for n, told in zip(observed.bench_names, foretold, strict=True)])
    state = dataclasses.replace(fit.state, bench=bench)
    left = left_of(observed, linearise(pair, observed, state), state)
    # What single samples far off do to the rms is not the model's.
    scale = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    inside = np.abs(left - np.median(left)) < OUTLYING * scale
    columns = observed.bench[inside][:, own]
    left = left[inside] - columns @ np.linalg.lstsq(columns, left[inside], rcond=None)[0]
    said = ", ".join(f"{c.torque:+.4g} N·m" for c in curves)
    return HeldOut(said, float(np.sqrt(np.mean(left**2))), fit.noise)


def _fitted(
    curves: Sequence[Curve],
    pair: Pair,
    start: Estimate | None,
    known: Mapping[str, float] | None,
    profile: Mapping[str, float] | None,
    progress: Callable[[str], None],
) -> Estimate:
    observed = observations(curves, pair, profile=profile)
    rough = _started(pair, observed, start, progress)
    state, scatter = rough.state, rough.scatter
    prior = observed.bench_prior.copy()
    prior[observed.creeping] = max(scatter.get(CREEP, 0.0), NO_CREEP)
    weight = observed.weight * np.median(rough.observed.weight) / np.median(observed.weight)
    observed = dataclasses.replace(observed, weight=weight, bench_prior=prior)
    linear, before = linearise(pair, observed, state), list(rough.chosen)
    chosen = _chosen(observed, linear, pair, scatter)
    for _ in range(_CHOICES):
        state = _told_by(pair, observed, linear, state, before, chosen)
        progress(f"fitting {len(chosen)} errors and the scatter of pins and teeth")
        estimate = fit(pair, observed, chosen, state, scatter, gain=_GAIN, known=known)
        state, scatter, linear, before = estimate.state, estimate.scatter, estimate.linear, chosen
        chosen = _chosen(estimate.observed, linear, pair, scatter)
        if chosen == before:
            break
    return dataclasses.replace(estimate, apart=rough.apart)


def _told_by(
    pair: Pair, observed: Observations, linear: Linear, state: State, before: Sequence[str], chosen: Sequence[str]
) -> State:
    """A state in which other errors than before do what those did that are no longer fitted."""
    dropped = [n for n in before if n not in chosen]
    if not dropped:
        return state
    at, prior = observed.errors.index, surface_of_pair(pair)
    plain = with_scatter(pair, state.surface, -state.scatter)
    excess = {n: structured_value(pair, plain, n) - structured_value(pair, prior, n) for n in dropped}
    size = tolerances_of(chosen, observed.profile)
    columns = np.hstack([linear.structured[:, [at(n) for n in chosen]] * size, observed.bench])
    lost = sum(linear.structured[:, at(n)] * value for n, value in excess.items())
    weight = observed.weight[:, None]
    share = np.linalg.lstsq(weight * columns, observed.weight * lost, rcond=1e-6)[0]
    values = {n: structured_value(pair, plain, n) + d for n, d in zip(chosen, size * share[: size.size], strict=True)}
    values |= {n: structured_value(pair, prior, n) for n in dropped}
    plain = with_structured(pair, plain, values)
    return dataclasses.replace(state, surface=with_scatter(pair, plain, state.scatter),
                               bench=state.bench + share[size.size :])  # fmt: skip


def _chosen(observed: Observations, linear: Linear, pair: Pair, scatter: Mapping[str, float]) -> list[str]:
    chosen = chosen_errors(observed, linear, observed.errors, spread_of(pair, scatter))
    if not chosen:
        raise edge.InputError("the data tell none of the structured errors apart; record more loads or more turns.")
    return chosen


def _started(pair: Pair, observed: Observations, start: Estimate | None, progress: Callable[[str], None]) -> Estimate:
    """A fit near the best one: where another fit ended, or the best of several starts on some of the points.

    The curves' corners make minima beside the best one. From the prior and by way of the largest load alone a fit
    rarely ends in the same wrong one, so two that agree are enough, all curves explained alike; otherwise random starts
    follow.
    """
    size = spread_of(pair, {}).size
    prior = surface_of_pair(pair)

    def zeroed(part: Observations, state: State, around: Near | None) -> tuple[State, Linear]:
        """The state with the unknown zeros of these observations, and the model there."""
        state = dataclasses.replace(state, bench=np.zeros(part.bench.shape[1]))
        free = ~np.isfinite(part.bench_prior)
        linear = linearise(pair, part, state, around)
        state.bench[free] = np.linalg.lstsq(part.bench[:, free], left_of(part, linear, state), rcond=None)[0]
        return state, linear

    if start is not None:
        state = start.state
        if start.observed.bench_names != observed.bench_names:
            state, _ = zeroed(observed, state, None)
        return dataclasses.replace(start, state=state)
    few, fewer = observed.thinned(_START_POINTS), observed.thinned(_START_POINTS // 2)
    loads = np.array([0.0 if c.branch else abs(c.torque) for c in few.curves])
    high, all_of_them = np.flatnonzero(loads > 0.7 * loads.max()), np.arange(loads.size)
    generator = np.random.default_rng(0)
    # A scatter that grows from nothing as the data ask for it leads past most of the wrong minima.
    unknown = {**dict.fromkeys(scatter_parts(pair), NO_SCATTER), CREEP: NO_CREEP}
    pitch = 2.0 * np.pi / pair.pins if observed.fit_crank else 0.0

    def ended(part: Observations, state: State, scatter: Mapping[str, float], around: Near | None) -> Estimate:
        state, linear = zeroed(part, state, around)
        chosen = _chosen(part, linear, pair, {})
        return fit(pair, part, chosen, state, scatter, gain=_START_GAIN, around=around, evaluations=_START_EVALUATIONS)

    # To first order from the prior, and from there once more; a crank whose zero is unknown needs the exact model.
    nominal = None if observed.fit_crank else near(pair, prior, fewer)
    found: list[Estimate] = []
    for number in range(_STARTS):
        progress(f"finding a start ({number + 1})")
        crank = _CRANK_STARTS[number % len(_CRANK_STARTS)] * pitch
        state = State(prior, np.zeros(size), np.empty(0), crank)
        if number > 1:
            names = found[0].chosen
            drawn = generator.normal(0.0, 0.3 * tolerances_of(names, few.profile))
            values = {n: structured_value(pair, prior, n) + d for n, d in zip(names, drawn, strict=True)}
            state = dataclasses.replace(state, surface=with_structured(pair, prior, values))
        part = high if number == 1 else all_of_them
        one = ended(fewer.some(part), state, unknown, None if nominal is None else nominal.some(part))
        around = None if nominal is None else near(pair, one.state.surface, few)
        one = ended(few, one.state, one.scatter, around)
        found = sorted([*found, one], key=lambda e: e.unlikelihood)
        alike = len(found) > 1 and found[1].unlikelihood < found[0].unlikelihood + _AGREE * few.measured.size
        if alike and not is_uneven(found[0]):
            break
    return dataclasses.replace(found[0], apart=0 if alike else len(found))
