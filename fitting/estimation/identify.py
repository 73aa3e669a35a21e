"""From recordings to the drive's errors: the search for the best fit; `fitting.estimation.result` reports it.

The structured errors that the data resolve are fitted with the exact contact model and its analytic Jacobian;
`confirmation` takes the last step and gives the covariance. The deviations of single pins and teeth beyond them are a
random scatter of unknown size: it is estimated together with the noise (restricted maximum likelihood) and is part of
the fit, so it neither biases the structured errors nor makes their intervals too small.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.errors.kinds import wave_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.sampling import Tolerances, read_tolerances
from cycloid_fmu.surfaces.structured import profile_names, structured_value, with_structured
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, surface_of_pair
from fitting.arguments import positive
from fitting.estimation.fit import NO_SCATTER, OUTLYING, TURNS, Estimate, fit
from fitting.estimation.result import Identification, is_uneven, result_of
from fitting.estimation.validation import (
    FALSE,
    HeldOut,
    Likely,
    Residual,
    Verdict,
    causes_of,
    likely_causes,
    mispredicted,
    verdict_of,
    yardsticks,
)
from fitting.model.discrepancy import GIVE, RIPPLE, beside_the_gear, causes, given_way, swung
from fitting.model.discs import other_descriptions
from fitting.model.identifiability import chosen_errors
from fitting.model.loops import observed_curves, on_the_curves_zero
from fitting.model.observations import (
    CHAIN,
    CREEP,
    MISFIT,
    NO_CREEP,
    PIN_RADIUS,
    PROFILE_ORDERS,
    Discrepancy,
    Linear,
    LinearisationPoint,
    Observations,
    State,
    errors_of,
    estimated_parts,
    left_of,
    linearisation_point,
    linearise,
    observations,
    scatter_between,
    spread_of,
    with_scatter,
)
from fitting.model.prior import Prior, prior_of, tolerances_of
from fitting.recordings.sources import Source
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

_MISPREDICTED = 1.5  # times the noise: a fit that predicts no better is no start for another, and not explained
_START_POINTS = 4000  # of all curves together, for the way from the prior
_MOST_STARTS, _START_EVALUATIONS = 24, 30
_BESIDE = 1.5  # times the noise: more than a minimum beside the best one leaves
_SUSPECTS, _REACHES = 3, (1, 2, 4)  # pins that are put back, and with how many neighbours on either side
_AGREE = 0.01  # of the points: two starts agree where -2 log likelihood differs by less, the noise by 0.5 %
_CRANK_STARTS = (0.0, -0.25, 0.25, 0.5)  # pin pitches, where the crank's zero is not known
_STILL, _AS_WELL = 0.1, 1.05  # times the creep and the noise without a soft chain
_MISFIT = 2e-6  # rad: from where the size of a cause of misfit is estimated
_MISFITS = 5  # fits with causes of misfit at most
_SETTLED = 1e-7, 1e-7, 1e-7, 1e-4  # m and rad: supports that give way by no more have been found
_SETTLED_SWING = 0.02  # of the torque: its effect is linear within
_DOUBTED, _LIKELIER = 0.05, 12.0  # a cause that noise resembles so rarely is tried; -2 log likelihood it must gain
_TOLD_APART = 10.0  # of -2 log likelihood: a description that is less likely by more is excluded, 150 to 1
_CHOICES = 3  # of errors to fit, which change where the state at which they are chosen does
_NO_FIT = edge.InputError, np.linalg.LinAlgError  # no contacts balance a load; singular equations
# A fit ends where a step reduces the sum of squares in units of the noise by less than this: such a step moves one
# estimate by a standard error at most, or all of them by a tenth. The last step follows.
_START_GAIN, _GAIN = 8.0, 1.0


def identify(
    recordings: Source | Curve | Iterable[Source | Curve],
    drive: Drive,
    *,
    tolerances: Tolerances | Prior | str | os.PathLike[str] | None = None,
    profiled: Sequence[str] = (),
    bootstrap: int = 0,
    held_out: bool = True,
    form: float | str = "1 um",
    progress: Callable[[str], None] = lambda step: None,
) -> Identification:
    """Identify a drive's errors from recordings at one or more loads, one or both directions.

    Recordings with the input at rest are taken as hysteresis loops: they separate play from friction.

    Parameters
    ----------
    recordings
        Result of `fitting.read_recordings`, `fitting.Run`, or curves made from them. A recording that states the
        fingerprint of a drive as its `pair` must be of this drive, or of its nominal pair.
    drive
        The nominal drive; its stated errors are the prior and start.
    tolerances
        The drive's tolerances, their file or a prior: they give the scatter of pins and teeth, and the form that all
        teeth share is fitted as far as the data resolve it.
    profiled
        Errors whose intervals are found by their profile rather than by their standard error.
    bootstrap
        Number of bootstrap resamples of output turns, whose scatter widens the standard errors if it is more than white
        noise; 0 for none.
    held_out
        Whether a load or direction is first kept from the fit and predicted.
    form
        Expected size of a form that all flanks share, standard deviation of each of its first four half waves, m. It is
        fitted if the curves show one; otherwise errors that the curves can't separate from it have intervals that allow
        for it. 0 if the flanks' form is known; a form in the tolerances is always fitted.
    progress
        Called with the name of each stage.

    Raises
    ------
    edge.InputError
        If a recording can't be read, is of another drive or has no load, an argument is invalid, the data resolve no
        error, or there are too few turns to draw from.

    Examples
    --------
    A drive of 9 teeth whose eccentricity is 3 µm too large, measured at two loads in both directions:

    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> drive = cy.Drive(pair)
    >>> made, angle = drive.replace(errors={"eccentricity": "3 um"}), np.linspace(0.0, 2.0 * np.pi * 9, 120)
    >>> noise = np.random.default_rng(0)
    >>> def run(load):
    ...     error = made.analyze(load, crank_angle=angle).transmission_error.values[0]
    ...     output = angle / -9 + error + noise.normal(0.0, 1e-6, angle.size)
    ...     return fitting.Run(input_angle=angle, output_angle=output, torque=load, common_zero=True, known_index=True)
    >>> result = fitting.identify([run(load) for load in (20.0, -20.0, 100.0, -100.0)], drive, held_out=False)
    >>> round(next(p for p in result.parameters if p.name == "eccentricity").value * 1e6, 1)
    3.0
    >>> result.drive.surface.eccentricity == result.surface.eccentricity
    True
    """
    pair, shape = drive.pair, positive(form, "m", "form", zero=True)
    progress("reading")
    curves = observed_curves(recordings, drive, keep_turns=bootstrap > 0)
    if isinstance(tolerances, str | os.PathLike):
        tolerances = read_tolerances(tolerances)
    prior = prior_of(pair, tolerances) if isinstance(tolerances, Tolerances) else tolerances or Prior()
    prior, beside = dataclasses.replace(prior, first_stage=drive.first_stage), []
    if pair.supports is not None and prior.profile:
        shape = max(prior.profile.values())
        prior = dataclasses.replace(prior, profile={})
        beside.append(
            f"On bearings the form of the flanks is not fitted: the intervals allow for {shape * 1e6:.2g} µm."
        )
    if bootstrap < 0:
        raise edge.ArgumentError("bootstrap", "it must not be below zero", bootstrap)
    for curve in curves if bootstrap else ():
        turns = 0 if curve.each_turn is None else len(curve.each_turn)
        if turns < TURNS and not curve.branch:
            raise edge.InputError(
                f"{curve.source}: it has {turns} output turns; at least {TURNS} are needed to draw turns again."
            )
    for name in profiled:
        if name not in (errors := [*errors_of(pair), *prior.profile]):
            near = edge.did_you_mean(name, errors).rstrip("?") or f"one of {', '.join(errors)}"
            raise edge.ArgumentError("profiled", f"it is not an error of this drive; {near}", name)
    running = [c for c in curves if not c.branch]
    if not running:
        raise edge.InputError(
            "there is no transmission error curve: a loop sees the drive at one crank angle only; give recordings of a "
            "turning crank too."
        )
    loops = on_the_curves_zero([c for c in curves if c.branch], running)
    for curve in (*running, *loops):
        if abs(curve.ratio / pair.ratio - 1.0) > 1e-9:
            raise edge.InputError(
                f"{curve.source}: its ratio is {curve.ratio:g}, the pair's {pair.ratio:g}; it is of another drive."
            )
    for curve in running:
        if abs(curve.torque) < 1e-3 * max(abs(c.torque) for c in running) or curve.torque == 0.0:
            raise edge.InputError(
                f"{curve.source}: the mean torque is {curve.torque:g} N·m; the fit needs loaded curves."
            )
    try:
        # The kernel's threads keep the processor busy; those of linear algebra would spin beside them.
        with threadpool_limits(limits=1, user_api="blas"):
            kept, start = kept_back(running) if held_out else (), None
            predicted = None
            rest = [*(c for i, c in enumerate(running) if i not in kept), *loops]
            if kept:
                progress("fitting without the held-out curves")
                # One to first order is enough, a third of the work: where it predicts badly the whole fit has the say.
                start, prior, _ = _started(rest, pair, prior, progress)
                predicted = _predicted(pair, start, [running[i] for i in kept])
                if predicted.residual > _MISPREDICTED * start.noise or is_uneven(start):
                    start = None
            shape = 0.0 if prior.profile else shape
            # The model on bearings fits no form: intervals allow for it, and the verdict does not name it.
            cause = 0.0 if pair.supports is not None else shape
            found, verdict = _validated([*running, *loops], pair, start, prior, cause, progress)
            shape = 0.0 if found.observed.profile else shape
            if predicted is not None and verdict.state == "explained" and _is_mispredicted(predicted):
                # The first fit may have ended beside its best optimum, which the whole one has found.
                progress("fitting without the held-out curves, from there")
                predicted = _predicted(pair, _fitted(rest, pair, found, prior, progress), [running[i] for i in kept])
                verdict = mispredicted(verdict, predicted) if _is_mispredicted(predicted) else verdict
            found, others = _described_otherwise(pair, found, prior, progress)
            verdict = dataclasses.replace(verdict, descriptions=1 + len(others), disagreeing=found.disagreeing)
            result = result_of(
                pair, found, verdict, predicted, prior.scatter, profiled, bootstrap, _GAIN, others, shape, progress,
            )  # fmt: skip
    except np.linalg.LinAlgError:
        raise edge.InputError(
            "the equations of the fit are singular, as for curves without noise; add some to simulated ones."
        ) from None
    single = [name for name in DEVIATIONS if getattr(drive.surface, name) is not None]
    if single:
        beside.append(
            f"The drive's surface holds form of single elements ({', '.join(single)}); it is not part of the fit."
        )
    return dataclasses.replace(result, notes=(*result.notes, *beside)) if beside else result


def kept_back(curves: Sequence[Curve]) -> tuple[int, ...]:
    """Choose the held-out curves to be predicted: a load between others, or a direction of the smallest.

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


def _suspects(pair: Pair, fit: Estimate) -> list[int]:
    """Places in a scatter vector of the pins with the largest residuals, the worst first."""
    left = fit.observed.weight * left_of(fit.observed, fit.linear, fit.state)
    share = fit.linear.scatter[:, : pair.pins] ** 2 + fit.linear.scatter[:, pair.pins : 2 * pair.pins] ** 2
    worst = (left**2 @ share) / np.maximum(share.sum(axis=0), 1e-300)
    return [int(i) for i in np.argsort(-worst)[:_SUSPECTS]]


def _described_otherwise(
    pair: Pair, found: Estimate, known: Prior, progress: Callable[[str], None]
) -> tuple[Estimate, tuple[Estimate, ...]]:
    """The same drive with each disc as the first: the description to report, and others that the curves do not exclude.

    Descriptions give the same curves; only the prior separates them. The one nearest to the errors of the pair file is
    reported.
    """
    prior, every = surface_of_pair(pair), [found]
    # On bearings the positions of the cranks distinguish the discs.
    for surface in () if pair.supports is not None else other_descriptions(pair, found.state.surface):
        progress("describing the drive from another disc")
        state = _described_by(pair, found, surface)
        every.append(fit(pair, found.observed, found.chosen, state, found.scatter, gain=_GAIN, known=known.scatter))
    least = min(one.unlikelihood for one in every)
    every = [one for one in every if one.unlikelihood - least < _TOLD_APART]
    sizes = tolerances_of(found.chosen, found.observed.profile)

    def distance(one: Estimate) -> float:
        off = [structured_value(pair, one.state.surface, n) - structured_value(pair, prior, n) for n in found.chosen]
        return round(float(np.sum((np.array(off) / sizes) ** 2)), 1)

    first, *others = sorted(every, key=distance)
    return dataclasses.replace(first, disagreeing=found.disagreeing), tuple(others)


def _described_by(pair: Pair, found: Estimate, surface: ErrorSurface) -> State:
    """The state of a fit with the errors of a surface."""
    values = {n: structured_value(pair, surface, n) for n in found.chosen}
    plain = with_structured(pair, surface_of_pair(pair), values)
    scatter = scatter_between(pair, surface, plain)
    return dataclasses.replace(found.state, surface=with_scatter(pair, plain, scatter), scatter=scatter)


def _negated(pair: Pair, state: State, order: int, chosen: Sequence[str]) -> State:
    """A state with the opposite sign of the errors of one order around the ring, without scatter."""
    plain = with_scatter(pair, state.surface, -state.scatter)
    waves = {n: wave_of(n) for n in chosen}
    of_order = [
        name
        for name, wave in waves.items()
        if (wave and wave[0].of == "pin" and wave[1] == order) or (order == 1 and name.startswith("centre_distance"))
    ]
    values = {n: structured_value(pair, plain, n) for n in chosen}
    values |= {n: -values[n] for n in of_order}
    surface = with_structured(pair, surface_of_pair(pair), values)
    return dataclasses.replace(state, surface=surface, scatter=np.zeros_like(state.scatter))


def _put_back(pair: Pair, state: State, pin: int, reach: int) -> State:
    """A state in which a pin and its neighbours have no scatter."""
    window = np.mod(np.arange(pin - reach, pin + reach + 1), pair.pins)
    scatter = state.scatter.copy()
    scatter[np.concatenate([window, window + pair.pins])] = 0.0
    surface = with_scatter(pair, state.surface, scatter - state.scatter)
    return dataclasses.replace(state, surface=surface, scatter=scatter)


def _predicted(pair: Pair, fit: Estimate, curves: Sequence[Curve]) -> HeldOut:
    """Residuals of curves that were not fitted; their own zeros and drifts cannot be predicted."""
    observed = observations(curves, pair, first_stage=fit.observed.first_stage)
    known = dict(zip(fit.observed.bench_names, fit.state.bench, strict=True))
    own = np.array(
        [n.startswith("output_angle_drift") or not (n in known or n.startswith(CREEP)) for n in observed.bench_names]
    )
    if not all(c.common_zero for c in (*curves, *fit.observed.curves)):
        own |= np.array([n.startswith("output_angle_offset") for n in observed.bench_names])
    predictable = ~own & ~np.array([n.startswith(CREEP) for n in observed.bench_names])
    bench = np.array([known[n] if shared else 0.0 for n, shared in zip(observed.bench_names, predictable, strict=True)])
    state = dataclasses.replace(fit.state, bench=bench)
    left = left_of(observed, linearise(pair, observed, state), state)
    # What single samples far off do to the rms is not the model's.
    scale = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    inside = np.abs(left - np.median(left)) < OUTLYING * scale
    columns = observed.bench[inside][:, own]
    left = left[inside] - columns @ np.linalg.lstsq(columns, left[inside], rcond=None)[0]
    loads = ", ".join(f"{c.torque:+.4g} N·m" for c in curves)
    counted = np.zeros(inside.size)
    counted[inside] = left
    yardstick = yardsticks(dataclasses.replace(observed, weight=inside.astype(float)), counted)
    return HeldOut(loads, float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(yardstick**2))))


def _first_sizes(observed: Observations) -> dict[str, float]:
    """Sizes from which those of the bench's groups are estimated: rad, of the chain rad/(N·m)."""
    return {group: observed.chain_prior if group == CHAIN else _MISFIT for group in observed.estimated}


def _no_scatter(pair: Pair) -> dict[str, float]:
    return {**dict.fromkeys(estimated_parts(pair), NO_SCATTER), CREEP: NO_CREEP}


def _is_mispredicted(predicted: HeldOut) -> bool:
    return predicted.residual > _MISPREDICTED * predicted.noise


def _validated(
    curves: Sequence[Curve],
    pair: Pair,
    start: Estimate | None,
    known: Prior,
    form: float,
    progress: Callable[[str], None],
) -> tuple[Estimate, Verdict]:
    """Fit curves, and if the errors do not explain them, also the most likely further causes.

    A common form of the flanks, each of its orders of size `form` (m), is one such cause.
    """
    formed = False

    def looks_like(found: Estimate, likely: Likely | None = None, false: float = FALSE) -> Likely:
        state = found.state if form and not formed else None
        columns = causes(pair, found.observed, found.linear, state)
        return likely_causes(Residual(pair, found), columns, likely, false)

    def fitted(start: Estimate | None, misfit: Discrepancy, searched: bool = False) -> Estimate | None:
        """With causes that are not those of the drive, as on bearings that no file states, there may be no fit."""
        try:
            return _fitted(curves, pair, start, known, progress, misfit, searched)
        except _NO_FIT:
            return None

    rough, known, rigid = _started(curves, pair, known, progress) if start is None else (start, known, None)
    # Where the chain is soft, the scatter of the whole fit would absorb run-out, drift and wind-up as far as it can.
    beside = Likely({}, {}, ())
    if known.soft_chain:
        suspected = causes_of(Residual(pair, rough), beside_the_gear(rough.observed)).columns
        every = beside_the_gear(_observed(curves, pair, known))
        beside = Likely({n: one for n, one in every.items() if n in suspected}, {}, ())
    misfit = Discrepancy(beside.columns)
    try:
        found = _fitted(curves, pair, rough, known, progress, misfit)
        is_worse = found.noise > _BESIDE * rough.noise
    except _NO_FIT:
        if not known.soft_chain:
            raise
        is_worse = True
    if is_worse and known.soft_chain:
        # A start to first order with a soft chain may be none for the exact model, as on bearings that no file states.
        known = dataclasses.replace(known, soft_chain=False)
        if rigid is None:
            rigid, _ = _starting_estimate(pair, _observed(curves, pair, known), None, False, progress)
        return _validated(curves, pair, rigid, known, form, progress)

    def tested() -> tuple[Likely, Verdict, bool, bool]:
        """Causes that the residual resembles, the verdict, whether there are some, and whether only perhaps."""
        progress("testing the residual")
        likely = looks_like(found, beside)
        verdict = verdict_of(pair, found, likely, formed)
        is_more, is_doubted = likely.columns.keys() > beside.columns.keys(), False
        if not is_more and verdict.state != "not explained":
            # The scatter of pins and teeth may have absorbed most of a cause.
            doubted = dataclasses.replace(looks_like(found, beside, _DOUBTED), formed=likely.formed)
            is_more = is_doubted = doubted.columns.keys() > beside.columns.keys()
            likely = doubted if is_doubted else likely
        return likely, verdict, is_more, is_doubted

    likely, first, is_more, is_doubted = tested()
    if likely.formed:
        plain_prior, known = known, _with_form(known, form)
        progress("fitting the form of the flanks")
        other = fitted(_without_scatter(pair, found), misfit)
        if other is None:
            known = plain_prior
        else:
            found, formed = other, True
            likely, first, is_more, is_doubted = tested()
    if (is_more or first.state == "not explained") and first.residual < _BESIDE * first.noise:
        # It may be that a better minimum leaves nothing.
        other = fitted(found, misfit, searched=True)
        if other is not None and other.unlikelihood < found.unlikelihood - _GAIN:
            found = other
            likely, first, is_more, is_doubted = tested()
    plain = found
    if is_more:
        # The scatter has absorbed as much of the causes as it could.
        found = _without_scatter(pair, found)
    give = swing = None
    coefficients: dict[str, Array] = {}
    verdict: Verdict | None = None
    ends: list[tuple[Estimate, Verdict]] = []

    def best() -> tuple[Estimate, Verdict | None]:
        # Where the model does not hold, each linearisation at supports that gave way may fit worse than the one before.
        return min(ends, key=lambda e: (e[1].state == "not explained", e[0].unlikelihood), default=(plain, None))

    for _ in range(_MISFITS if is_more else 0):
        taken = sum((likely.columns[n] @ values for n, values in coefficients.items()), np.zeros(1))
        misfit = Discrepancy(likely.columns, give, swing, taken)
        other = fitted(found, misfit)
        if other is None:
            found, verdict = best()
            break
        found, verdict = other, verdict_of(pair, other, likely, formed)
        ends.append((found, verdict))
        of_cause = {n: found.observed.estimated.get(f"{MISFIT}_{n}") for n in (GIVE, RIPPLE)}
        coefficients = {n: found.state.bench[part] for n, part in of_cause.items() if part is not None}
        gave = given_way(pair, found.observed, coefficients[GIVE]) if GIVE in coefficients else None
        swings = swung(found.observed, coefficients[RIPPLE]) if RIPPLE in coefficients else None
        settled = _is_settled(give, gave, _SETTLED) and _is_settled(swing, swings, _SETTLED_SWING)
        give, swing = gave, swings
        if settled:
            if verdict.state != "not explained":
                break
            likely = looks_like(found, likely)
            if likely.formed:
                known, formed = _with_form(known, form), True
        else:
            # Supports that gave way and torques that swung have moved the contacts: further ones act at the new ones.
            moved = dataclasses.replace(found.observed, give=give, swing=swing)
            there = causes(pair, moved, linearise(pair, moved, found.state))
            likely = dataclasses.replace(likely, columns={n: there.get(n, one) for n, one in likely.columns.items()})
    else:
        found, verdict = best()
    if is_doubted and not found.unlikelihood < plain.unlikelihood - _LIKELIER:
        found, verdict = plain, None
    if found.disagreeing and (beside.columns or verdict) and (verdict or first).state != "not explained":
        # The starts were made without the cause; two of them must agree with it.
        again = fitted(None, misfit)
        if again is not None:
            better = again.unlikelihood < found.unlikelihood + _GAIN
            found = again if better else dataclasses.replace(found, disagreeing=again.disagreeing)
            verdict = verdict_of(pair, found, likely, formed)
    return found, verdict or first


def _is_settled(before: Array | None, after: Array | None, within: Array | Sequence[float] | float) -> bool:
    """Whether displacements or swings of the torque have been found."""
    if after is None:
        return True
    return bool((np.abs(after - (0.0 if before is None else before)) < within).all())


def _observed(curves: Sequence[Curve], pair: Pair, known: Prior) -> Observations:
    return observations(curves, pair, profile=known.profile, first_stage=known.first_stage, soft_chain=known.soft_chain)


def _started(
    curves: Sequence[Curve], pair: Pair, known: Prior, progress: Callable[[str], None]
) -> tuple[Estimate, Prior, Estimate | None]:
    """A fit near the best one from the prior, and the prior with a soft chain if zeros creep that do not creep with it.

    Then the fit without one is returned as well. Not at once: a chain that may be soft can take the part of errors and
    of friction that are not found yet.
    """
    rough, _ = _starting_estimate(pair, _observed(curves, pair, known), None, False, progress)
    if known.soft_chain or not rough.scatter.get(CREEP, 0.0) > _MISFIT:
        return rough, known, None
    soft = dataclasses.replace(known, soft_chain=True)
    other, _ = _starting_estimate(pair, _observed(curves, pair, soft), None, False, progress)
    # Two unknowns in place of one for each recording are likelier even where this start fits a little worse.
    is_still = other.scatter[CREEP] < _STILL * rough.scatter[CREEP] and other.noise < _AS_WELL * rough.noise
    return (other, soft, rough) if is_still or other.unlikelihood < rough.unlikelihood else (rough, known, None)


def _with_form(known: Prior, form: float) -> Prior:
    """The prior, with a form of the flanks among the errors: contacts move along a flank according to its form."""
    return dataclasses.replace(known, profile=dict.fromkeys(profile_names(PROFILE_ORDERS), form))


def _fitted(
    curves: Sequence[Curve],
    pair: Pair,
    start: Estimate | None,
    known: Prior,
    progress: Callable[[str], None],
    misfit: Discrepancy | None = None,
    searched: bool = False,
) -> Estimate:
    """Fit from the end of another fit, or `searched` around it for a better minimum, or from the prior."""
    observed = _observed(curves, pair, known)
    if misfit is not None:
        observed = observed.with_misfit(misfit)
    rough, linear = _starting_estimate(pair, observed, start, searched, progress)
    state, scatter = rough.state, {**_first_sizes(observed), **rough.scatter}
    weight = observed.weight * np.median(rough.observed.weight) / np.median(observed.weight)
    observed = dataclasses.replace(observed, weight=weight).with_sizes(scatter)
    rough = dataclasses.replace(rough, state=state, scatter=scatter)
    estimate = _settled(pair, observed, rough, linear, known, progress)
    return dataclasses.replace(estimate, disagreeing=rough.disagreeing)


def _without_scatter(pair: Pair, found: Estimate) -> Estimate:
    """The same, starting again with zero scatter of pins and teeth."""
    surface = with_scatter(pair, found.state.surface, -found.state.scatter)
    state = dataclasses.replace(found.state, surface=surface, scatter=np.zeros_like(found.state.scatter))
    sizes = {n: v for n, v in found.scatter.items() if n.startswith(MISFIT)}
    return dataclasses.replace(found, state=state, scatter={**_no_scatter(pair), **sizes})


def _settled(
    pair: Pair,
    observed: Observations,
    start: Estimate,
    linear: Linear | None,
    known: Prior,
    progress: Callable[[str], None],
) -> Estimate:
    """Fit from a start, until the errors chosen at its end are those that were fitted.

    `linear` is the model at the start, if known.
    """
    state, scatter, before = start.state, start.scatter, list(start.chosen)
    linear = linearise(pair, observed, state) if linear is None else linear
    chosen = _chosen(observed, linear, pair)
    for _ in range(_CHOICES):
        carried = _carried_over(pair, observed, linear, state, before, chosen)
        progress(f"fitting {len(chosen)} errors and the scatter of pins and teeth")
        there = linear if carried is state else None
        estimate = fit(pair, observed, chosen, carried, scatter, gain=_GAIN, linear=there, known=known.scatter)
        state, scatter, linear, before = estimate.state, estimate.scatter, estimate.linear, chosen
        chosen = _chosen(estimate.observed, linear, pair)
        if chosen == before:
            break
    return estimate


def _carried_over(
    pair: Pair, observed: Observations, linear: Linear, state: State, before: Sequence[str], chosen: Sequence[str]
) -> State:
    """A state in which the effect of errors that are no longer fitted is replaced by others."""
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


def _chosen(observed: Observations, linear: Linear, pair: Pair) -> list[str]:
    # Without the scatter of single pins and teeth, which widens the intervals: a scatter that has absorbed held errors
    # would keep them held, and fitted errors of nearly the same effect would absorb the rest.
    chosen = chosen_errors(observed, linear, observed.errors, spread_of(pair, {}))
    if not chosen:
        raise edge.InputError("the data resolve none of the structured errors; record more loads or more turns.")
    return chosen


def _starting_estimate(
    pair: Pair, observed: Observations, start: Estimate | None, searched: bool, progress: Callable[[str], None]
) -> tuple[Estimate, Linear | None]:
    """A fit near the best one, and the exact model there if it was evaluated.

    It is the end of another fit, or the best of several starts on some of the points.

    The curves' corners cause further minima besides the best one. Fits from the prior and via the largest load alone
    rarely end in the same wrong one, so two that agree are enough if all curves are explained equally. Otherwise the
    pins with the largest residuals are reset to their prior, with their neighbours, as long as this improves the fit.
    """
    size = spread_of(pair, {}).size
    prior = surface_of_pair(pair)

    def zeroed(part: Observations, state: State, around: LinearisationPoint | None) -> tuple[State, Linear]:
        """The state with the unknown zeros of these observations, and the model there."""
        state = dataclasses.replace(state, bench=np.zeros(part.bench.shape[1]))
        free = ~np.isfinite(part.bench_prior)
        linear = linearise(pair, part, state, around)
        state.bench[free] = np.linalg.lstsq(part.bench[:, free], left_of(part, linear, state), rcond=None)[0]
        return state, linear

    if start is not None and not searched:
        if len(start.observed.curves) != len(observed.curves):
            state, linear = zeroed(observed, start.state, None)
            return dataclasses.replace(start, state=state), linear
        known = dict(zip(start.observed.bench_names, start.state.bench, strict=True))
        state = dataclasses.replace(start.state, bench=np.array([known.get(n, 0.0) for n in observed.bench_names]))
        return dataclasses.replace(start, state=state), None
    few, fewer = observed.thinned(_START_POINTS), observed.thinned(_START_POINTS // 2)
    loads = np.array([0.0 if c.branch else abs(c.torque) for c in few.curves])
    high, all_of_them = np.flatnonzero(loads > 0.7 * loads.max()), np.arange(loads.size)
    # A scatter that grows from nothing as the data ask for it leads past most of the wrong minima.
    unknown = {**_first_sizes(observed), **_no_scatter(pair)}
    # Radii of single pins could absorb errors that are not found yet: in starts from the prior they scatter later.
    same_radius = {PIN_RADIUS: 1e-2 * NO_SCATTER} if start is None else {}
    pitch = 2.0 * np.pi / pair.pins if observed.fit_crank else 0.0

    def ended(
        part: Observations, state: State, scatter: Mapping[str, float], around: LinearisationPoint | None
    ) -> Estimate | None:
        try:
            state, linear = zeroed(part, state, around)
            chosen = _chosen(part, linear, pair)
            one = fit(pair, part, chosen, state, scatter, gain=_START_GAIN, around=around, linear=linear,
                      evaluations=_START_EVALUATIONS, known=same_radius)  # fmt: skip
            return dataclasses.replace(one, scatter={**one.scatter, **dict.fromkeys(same_radius, NO_SCATTER)})
        except edge.InputError:
            # To first order a fit may end where no contacts balance the load.
            return None
        except np.linalg.LinAlgError as problem:
            # Creep may grow into what wind-up does.
            singular.append(problem)
            return None

    def take(one: Estimate | None) -> None:
        found.extend([] if one is None else [one])

    # To first order from the prior, and from there once more; a crank whose zero is unknown and discs that float need
    # the exact model.
    exact = observed.fit_crank or pair.supports is not None or observed.first_stage is not None
    nominal = None if exact else linearisation_point(pair, prior, fewer)
    found: list[Estimate] = []
    singular: list[np.linalg.LinAlgError] = []

    def around(surface: ErrorSurface) -> LinearisationPoint | None:
        try:
            return None if nominal is None else linearisation_point(pair, surface, few)
        except edge.InputError:
            return None

    def agree() -> bool:
        """Put the best first; return whether the next one ended there too."""
        found.sort(key=lambda e: e.unlikelihood)
        return len(found) > 1 and found[1].unlikelihood < found[0].unlikelihood + _AGREE * few.measured.size

    cranks = _CRANK_STARTS if observed.fit_crank else (0.0, 0.0)
    alike = False
    for number, crank in enumerate(() if start else cranks):
        state = State(prior, np.zeros(size), np.empty(0), crank * pitch)
        part = high if number == 1 else all_of_them
        progress(f"finding a start ({len(found) + 1})")
        one = ended(fewer.some(part), state, unknown, None if nominal is None else nominal.some(part))
        # At one load creep, wind-up and play are the same: their sizes there say nothing.
        bench = {n: unknown[n] for n in few.estimated}
        on = None if one is None else ended(few, one.state, {**one.scatter, **bench}, around(one.state.surface))
        take(on or ended(few, state, unknown, None))
        alike = agree() and not is_uneven(found[0])
        if alike:
            break
    if start is not None:
        take(ended(few, start.state, start.scatter, around(start.state.surface)))
    if not found and singular:
        raise singular[0]
    if not found:
        raise edge.InputError(
            "no errors were found with which the pair's contacts carry the loads of these curves; check counts per "
            "turn, directions and the pair file."
        )
    for order in (1, 3) if pair.discs == 2 else ():
        # The curves of two discs depend on products of odd orders around the ring only: each pair may be found negated.
        progress(f"finding a start ({len(found) + 1})")
        state = _negated(pair, found[0].state, order, found[0].chosen)
        take(ended(few, state, unknown, around(found[0].state.surface)))
        agree()
    # On bearings another disc as the first makes nearly the same curves: a minimum beside the best one.
    for surface in other_descriptions(pair, found[0].state.surface) if pair.supports is not None else ():
        progress(f"finding a start ({len(found) + 1})")
        take(ended(few, _described_by(pair, found[0], surface), found[0].scatter, None))
        agree()
    # In a minimum beside the best one neighbouring pins are wrong in opposite ways; the residual is largest there.
    searching = not alike
    while searching and len(found) < _MOST_STARTS:
        best, searching = found[0], False
        near = around(best.state.surface)
        for pin, reach in itertools.product(_suspects(pair, best), _REACHES):
            progress(f"finding a start ({len(found) + 1})")
            one = ended(few, _put_back(pair, best.state, pin, reach), best.scatter, near)
            take(one)
            if one is not None and one.unlikelihood < best.unlikelihood - _AGREE * few.measured.size:
                searching = True
                break
        alike = agree()
    return dataclasses.replace(found[0], disagreeing=0 if alike else len(found)), None
