"""The search for what explains curves: errors by themselves, or with groups of further causes beside them.

A hypothesis states what a fit of all points has besides errors, bench and scatter, and where it starts. The sizes of
its groups are estimated from nearly zero, so a group that the curves do not show vanishes by itself.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import profile_names, structured_value
from fitting.estimation.fit import Estimate, fit
from fitting.estimation.search import NO_FIT, Proposals, Search
from fitting.estimation.starts import (
    Multistart,
    at_zeros,
    descriptions,
    first_sizes,
    no_scatter,
    unscattered,
)
from fitting.estimation.validation import (
    Likely,
    Residual,
    Verdict,
    causes_of,
    likely_causes,
    verdict_of,
)
from fitting.model.discrepancy import GIVE, PLAY, RIPPLE, SHIFTS, beside_the_gear, causes, given_way, ripple_of
from fitting.model.gaussian import Evidence
from fitting.model.identifiability import chosen_of
from fitting.model.observations import (
    LARGE_FRICTION_SHARE,
    MISFIT,
    PROFILE_ORDERS,
    Discrepancy,
    Linear,
    Observations,
    State,
    linearise,
    observations,
)
from fitting.model.prior import Prior
from fitting.model.unknowns import Unknowns
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

GAIN = 1.0  # of the sum of squares in units of the noise: a step that promises less moves one error by a standard error
_BESIDE = 1.5  # times the noise: more than a minimum beside the best one leaves
_CHOICES = 3  # of errors to fit, which change where the state at which they are chosen does; two are usual
_LINEARISATIONS = 5  # of supports that give way and of a torque's ripple at most; two or three are usual
_SETTLED = 1e-7, 1e-7, 1e-7, 1e-4  # m and rad: supports that give way by no more have been found
_SETTLED_RIPPLE = 0.02  # share of the torque: smaller changes act linearly
_DOUBTED = 0.05  # a cause that noise resembles more rarely is tried
_LIKELIER = 12.0  # how far -2 log likelihood must fall for each such cause: noise does so in 3 of 10,000 fits
_MUCH_FRICTION = 3.0  # prior sizes of the friction, above which a larger one is tried
_ROUNDS = 4  # of all proposals; one or two are usual


@dataclass(frozen=True)
class Hypothesis:
    """What a fit has besides errors, bench and scatter, and where it starts.

    Attributes
    ----------
    prior, misfit, causes
        The prior; causes of misfit as the fit has them, and what is known of them.
    start
        The end of another fit, of the same curves or of others; None: from the prior.
    is_searched
        Whether minima near the start are tried as well.
    doubted
        Those causes that noise may resemble.
    """

    prior: Prior
    misfit: Discrepancy = field(default_factory=lambda: Discrepancy({}))
    causes: Likely = field(default_factory=lambda: Likely({}, {}, ()))
    start: Estimate | None = None
    is_searched: bool = False
    doubted: tuple[str, ...] = ()


@dataclass(frozen=True)
class Explained:
    """The fit of a hypothesis, and whether it explains the curves.

    `is_settled` states whether its misfit is at the displacements of the supports and the torque that were found.
    """

    estimate: Estimate
    hypothesis: Hypothesis
    verdict: Verdict
    is_settled: bool = True

    @property
    def is_failed(self) -> bool:
        """Whether the curves are not explained."""
        return self.verdict.state == "not explained"


class Explanation(Search[Hypothesis, Explained]):
    """The search for the hypothesis that explains curves.

    Parameters
    ----------
    curves, pair, prior
        The curves, the nominal pair, and the prior of the first hypothesis.
    progress
        Called with what is done.
    form
        Size of each order of a form that all flanks share, m, if it is one of the causes, otherwise 0.
    origin
        The end of another fit at which it starts; None: at the best of several starts.
    """

    def __init__(
        self,
        curves: Sequence[Curve],
        pair: Pair,
        prior: Prior,
        progress: Callable[[str], None],
        form: float = 0.0,
        origin: Estimate | None = None,
    ) -> None:
        super().__init__()
        self.curves, self.pair, self.prior = curves, pair, prior
        self.progress, self.form, self.origin = progress, form, origin
        self._suspects: tuple[Explained, Likely, tuple[str, ...]] | None = None

    def explain(self) -> Explained:
        """Return the best explanation.

        Raises
        ------
        edge.InputError
            If no contacts balance the loads, or the curves resolve none of the errors.
        numpy.linalg.LinAlgError
            If the equations are singular.
        """
        self.run([_beside_the_gear])
        for _ in range(_ROUNDS):
            before = self.best
            self.run(PROPOSALS)
            if self.best is before:
                break
        best, own = self.best, self.best.hypothesis.causes.columns.keys()
        alike = [end.estimate.disagreeing for end in self.ends if end.hypothesis.causes.columns.keys() == own]
        return dataclasses.replace(best, estimate=dataclasses.replace(best.estimate, disagreeing=min(alike)))

    def is_better(self, end: Explained, best: Explained) -> bool:
        """Whether an explanation is better: one that passes all tests, and the likelier of two."""
        if end.is_failed != best.is_failed:
            return best.is_failed
        if end.hypothesis.doubted and not end.is_settled:
            return False
        margin = GAIN * (end.hypothesis.causes.columns.keys() == best.hypothesis.causes.columns.keys())
        return _unlikelihood(end) < _unlikelihood(best) - margin

    def fit(self, start: Hypothesis) -> Explained:
        """Fit all points, until supports and torque stay where the fit has moved them, and test the residual."""
        ends: list[tuple[Estimate, Hypothesis]] = []
        hypothesis: Hypothesis | None = start
        while hypothesis is not None and len(ends) < _LINEARISATIONS:
            try:
                ends.append((self.fitted(hypothesis), hypothesis))
            except NO_FIT:
                if not ends:
                    raise
                break
            hypothesis = self._moved(*ends[-1])
        # Where the model does not hold, each linearisation at supports that gave way may fit worse than the one before.
        estimate, own = ends[-1] if hypothesis is None else min(ends, key=lambda one: one[0].unlikelihood)
        self.progress("testing the residual")
        is_formed = bool(self.form and own.prior.profile)
        return Explained(estimate, own, verdict_of(estimate, own.causes, is_formed), hypothesis is None)

    def _moved(self, end: Estimate, hypothesis: Hypothesis) -> Hypothesis | None:
        """The hypothesis at a fit's displacements of the supports and torque; None if they are those of its model."""
        of_cause = {n: end.observed.estimated.get(f"{MISFIT}_{n}") for n in (GIVE, PLAY, RIPPLE)}
        coefficients = {n: end.state.bench[part] for n, part in of_cause.items() if part is not None}
        shifting = coefficients.get(GIVE), coefficients.get(PLAY)
        give = given_way(self.pair, end.observed, *shifting) if {*SHIFTS} & coefficients.keys() else None
        ripple = ripple_of(end.observed, coefficients[RIPPLE]) if RIPPLE in coefficients else None
        before = hypothesis.misfit
        if _is_near(before.give, give, _SETTLED) and _is_near(before.ripple, ripple, _SETTLED_RIPPLE):
            return None
        moved = dataclasses.replace(end.observed, give=give, ripple=ripple)
        every = causes(self.pair, moved, linearise(self.pair, moved, end.state))
        columns = {n: every.get(n, column) for n, column in hypothesis.causes.columns.items()}
        taken = sum((columns[n] @ values for n, values in coefficients.items()), np.zeros(1))
        own = dataclasses.replace(hypothesis.causes, columns=columns)
        return dataclasses.replace(
            hypothesis, misfit=Discrepancy(columns, give, ripple, taken), causes=own, start=end, is_searched=False
        )

    def suspects(self) -> tuple[Likely, tuple[str, ...]]:
        """Return the causes that the residual of the best resembles, its own among them, and those that noise may too.

        The scatter of pins and teeth may have absorbed most of a cause, so where none is clear doubted ones are named.
        """
        if self._suspects is None or self._suspects[0] is not self.best:
            self._suspects = self.best, *self._suspects_of(self.best)
        return self._suspects[1:]

    def _suspects_of(self, best: Explained) -> tuple[Likely, tuple[str, ...]]:
        estimate, known = best.estimate, best.hypothesis.causes
        if not best.is_failed and known.columns.keys() > self.ends[0].hypothesis.causes.columns.keys():
            return known, ()
        state = estimate.state if self.form and not best.hypothesis.prior.profile else None
        columns = causes(self.pair, estimate.observed, estimate.linear, state)
        residual = Residual(estimate)
        likely = likely_causes(residual, columns, known)
        if likely.columns or best.is_failed or any(tried.doubted for tried in self.starts):
            return likely, ()
        doubted = likely_causes(residual, columns, known, _DOUBTED)
        return dataclasses.replace(doubted, formed=likely.formed), tuple(doubted.columns)

    def observed(self, hypothesis: Hypothesis) -> Observations:
        """Return the curves as observations with the unknowns of a hypothesis."""
        return observed_with(self.curves, self.pair, hypothesis.prior).with_misfit(hypothesis.misfit)

    def fitted(self, hypothesis: Hypothesis) -> Estimate:
        """Fit all points under a hypothesis.

        Raises
        ------
        edge.InputError
            If no contacts balance the loads, or the curves resolve none of the errors.
        numpy.linalg.LinAlgError
            If the equations are singular.
        """
        observed, start, linear = self.observed(hypothesis), hypothesis.start, None
        if start is None or hypothesis.is_searched:
            start = Multistart(self.pair, observed, start, self.progress).estimate()
            state = start.state
        elif len(start.observed.curves) != len(observed.curves):
            state, linear = at_zeros(self.pair, observed, start.state)
        else:
            known = dict(zip(start.observed.bench_names, start.state.bench, strict=True))
            bench = np.array([known.get(n, 0.0) for n in observed.bench_names])
            state = dataclasses.replace(start.state, bench=bench)
        sizes = {**first_sizes(observed), **start.scatter}
        weight = observed.weight * np.median(start.observed.weight) / np.median(observed.weight)
        observed = dataclasses.replace(observed, weight=weight).with_sizes(sizes)
        end = dataclasses.replace(start, state=state, scatter=sizes)
        linear = linearise(self.pair, observed, state) if linear is None else linear
        chosen = chosen_of(self.pair, observed, linear)
        for _ in range(_CHOICES):
            self.progress(f"fitting {len(chosen)} errors and the scatter of pins and teeth")
            state = _without_dropped(observed, linear, end, chosen)
            end = fit(
                self.pair,
                observed,
                chosen,
                state,
                end.scatter,
                gain=GAIN,
                linear=linear if state is end.state else None,
                known=hypothesis.prior.scatter,
            )
            before, linear = chosen, end.linear
            chosen = chosen_of(self.pair, end.observed, linear)
            if chosen == before:
                break
        return dataclasses.replace(end, disagreeing=start.disagreeing)


def _unlikelihood(explained: Explained) -> float:
    return explained.estimate.unlikelihood_of_all + _LIKELIER * len(explained.hypothesis.doubted)


_Hypotheses = Proposals[Hypothesis, Explained]


def _beside_the_gear(search: Explanation) -> _Hypotheses:
    """Errors alone, at the first prior."""
    yield from _errors_alone(search, search.prior, search.origin)


def _errors_alone(search: Explanation, prior: Prior, origin: Estimate | None) -> _Hypotheses:
    """Errors with the causes outside the contacts that the best start shows: run-out, drift and compliance.

    The scatter of pins and teeth of a fit without them would absorb what it can of them.
    """
    observed = observed_with(search.curves, search.pair, prior)
    start = origin or Multistart(search.pair, observed, None, search.progress).estimate()
    suspected = causes_of(Residual(start), beside_the_gear(start.observed)).columns
    columns = {name: column for name, column in beside_the_gear(observed).items() if name in suspected}
    end = None
    if columns:
        end = yield Hypothesis(prior, Discrepancy(columns), Likely(columns, {}, ()), start)
    if end is None or end.is_failed:
        yield Hypothesis(prior, start=start)


def _with_large_friction(search: Explanation) -> _Hypotheses:
    """A bench or drive that rubs, from its own best start: a small prior would press the friction into other causes."""
    estimate, prior = search.best.estimate, search.best.hypothesis.prior
    is_tried = any(tried.prior.friction_share == LARGE_FRICTION_SHARE for tried in search.starts)
    if not is_tried and estimate.state.friction > _MUCH_FRICTION * estimate.observed.friction_prior:
        with contextlib.suppress(*NO_FIT):  # the best so far stays
            yield from _errors_alone(search, dataclasses.replace(prior, friction_share=LARGE_FRICTION_SHARE), None)


def _with_form(search: Explanation) -> _Hypotheses:
    """A form of the flanks among the errors: it is no column, because contacts move along a flank with it."""
    best = search.best
    if search.form and not best.hypothesis.prior.profile and search.suspects()[0].formed:
        profile = dict.fromkeys(profile_names(PROFILE_ORDERS), search.form)
        prior = dataclasses.replace(best.hypothesis.prior, profile=profile)
        yield dataclasses.replace(best.hypothesis, prior=prior, start=_unscattered(search.pair, best.estimate))


def _from_another_disc(search: Explanation) -> _Hypotheses:
    """On bearings, the description from each other disc: a minimum beside the best, from which no single pin leads."""
    best = search.best
    if best.is_failed and search.pair.supports is not None:
        for state in descriptions(search.pair, best.estimate):
            yield dataclasses.replace(best.hypothesis, start=dataclasses.replace(best.estimate, state=state))


def _from_nearby(search: Explanation) -> _Hypotheses:
    """Minima near the best: it may be that a better one leaves nothing."""
    best, (likely, doubted) = search.best, search.suspects()
    is_suspect = best.is_failed or (not doubted and _are_more(likely, best.hypothesis.causes))
    if is_suspect and best.verdict.residual < _BESIDE * best.verdict.noise:
        yield dataclasses.replace(best.hypothesis, start=best.estimate, is_searched=True)


def _with_causes(search: Explanation) -> _Hypotheses:
    """The causes that the residual resembles, and without those of them that noise may have made."""
    best, (likely, doubted) = search.best, search.suspects()
    if not _are_more(likely, best.hypothesis.causes):
        return
    # The scatter has absorbed as much of the causes as it could.
    start, own = _unscattered(search.pair, best.estimate), best.hypothesis.misfit
    misfit = Discrepancy(likely.columns, own.give, own.ripple, own.taken)
    prior = best.hypothesis.prior
    end = yield Hypothesis(prior, misfit, likely, start, doubted=doubted)
    if doubted and end is not None and end is search.best:
        yield dataclasses.replace(best.hypothesis, start=end.estimate)


def _from_the_prior(search: Explanation) -> _Hypotheses:
    """The drive of the pair file with the causes, if the starts that disagree were made without them."""
    best, is_tried = search.best, any(tried.start is None for tried in search.starts)
    if best.estimate.disagreeing and best.hypothesis.misfit.columns and not best.is_failed and not is_tried:
        yield dataclasses.replace(best.hypothesis, start=None)


PROPOSALS = _with_large_friction, _with_form, _from_another_disc, _from_nearby, _with_causes, _from_the_prior


def observed_with(curves: Sequence[Curve], pair: Pair, prior: Prior) -> Observations:
    """Return the observations of curves, with the unknowns that a prior asks for."""
    return observations(
        curves,
        pair,
        profile=prior.profile,
        first_stage=prior.first_stage,
        constraints=prior.constraints,
        friction_share=prior.friction_share,
    )


def _unscattered(pair: Pair, estimate: Estimate) -> Estimate:
    """The same fit, starting again without the scatter of pins and teeth."""
    sizes = {n: v for n, v in estimate.scatter.items() if n.startswith(MISFIT)}
    return dataclasses.replace(estimate, state=unscattered(estimate.state), scatter={**no_scatter(pair), **sizes})


def _without_dropped(observed: Observations, linear: Linear, end: Estimate, chosen: Sequence[str]) -> State:
    """The state of a fit with the errors that are no longer fitted as stated, the others most likely with that."""
    dropped = [n for n in end.chosen if n not in chosen]
    if not dropped:
        return end.state
    unknowns = Unknowns(end.pair, observed, [*chosen, *dropped])
    vector = unknowns.vector(end.state)
    at = np.arange(len(chosen), unknowns.errors.stop)
    stated = np.array([structured_value(unknowns.prior, n) for n in dropped]) / unknowns.scale[at]
    evidence = Evidence.of(unknowns.columns(observed, linear))
    change, _ = evidence.posterior(unknowns.precision(end.scatter)).given(np.eye(vector.size)[at], stated - vector[at])
    return Unknowns(end.pair, observed, chosen).state(np.delete(vector + change, at))


def _are_more(likely: Likely, known: Likely) -> bool:
    return likely.columns.keys() > known.columns.keys()


def _is_near(before: Array | None, after: Array | None, within: Array | Sequence[float] | float) -> bool:
    """Whether displacements, or a ripple of the torque, are those that were found before."""
    if after is None:
        return True
    return bool((np.abs(after - (0.0 if before is None else before)) < within).all())
