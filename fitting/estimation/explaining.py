"""Whether errors explain curves, and fits with the likely causes of what they leave."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import profile_names
from fitting.estimation.fit import Estimate
from fitting.estimation.starting import (
    GAIN,
    described_by,
    fitted,
    observed_with,
    started,
    starting_estimate,
    without_scatter,
)
from fitting.estimation.validation import (
    Likely,
    Residual,
    Verdict,
    causes_of,
    likely_causes,
    verdict_of,
)
from fitting.model.discrepancy import GIVE, RIPPLE, beside_the_gear, causes, given_way, ripple_of
from fitting.model.discs import other_descriptions
from fitting.model.observations import (
    MISFIT,
    PROFILE_ORDERS,
    Discrepancy,
    linearise,
)
from fitting.model.prior import Prior
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

_BESIDE = 1.5  # times the noise: more than a minimum beside the best one leaves
_MISFITS = 5  # fits with causes of misfit at most
_SETTLED = 1e-7, 1e-7, 1e-7, 1e-4  # m and rad: supports that give way by no more have been found
_SETTLED_RIPPLE = 0.02  # share of the torque: smaller changes act linearly
_DOUBTED = 0.05  # a cause that noise resembles more rarely is tried
_LIKELIER = 12.0  # how far -2 log likelihood must fall for each such cause
_NO_FIT = edge.InputError, np.linalg.LinAlgError  # no contacts balance a load; singular equations


@dataclass(frozen=True)
class Explained:
    """A fit, the prior and the causes of misfit that it was made with, and what it leaves."""

    found: Estimate
    known: Prior
    misfit: Discrepancy
    likely: Likely
    verdict: Verdict
    is_settled: bool = True  # whether the misfit is at the supports' displacements and the torque that were found


@dataclass(frozen=True)
class MisfitSearch:
    """Fits of curves, with causes of misfit beside the errors where these alone do not explain the curves.

    Attributes
    ----------
    curves, pair
        The curves, and the nominal pair.
    form
        Size of each order of a form that all flanks share, m, if it is one of the causes, otherwise 0.
    progress
        Is told what is done.
    """

    curves: Sequence[Curve]
    pair: Pair
    form: float
    progress: Callable[[str], None]

    def validated(self, start: Estimate | None, known: Prior) -> Explained:
        """Fit the curves, and if the errors do not explain them, also the most likely further causes."""
        pair, rigid = self.pair, None
        if start is None:
            start, known, rigid = started(self.curves, pair, known, self.progress)
        # Where the chain is soft, the scatter of the whole fit would absorb what it can of run-out, drift and wind-up.
        beside = Likely({}, {}, ())
        if known.soft_chain:
            suspected = causes_of(Residual(start), beside_the_gear(start.observed)).columns
            every = beside_the_gear(observed_with(self.curves, pair, known))
            beside = Likely({n: one for n, one in every.items() if n in suspected}, {}, ())
        misfit = Discrepancy(beside.columns)
        try:
            found = fitted(self.curves, pair, start, known, self.progress, misfit)
            is_worse = found.noise > _BESIDE * start.noise
        except _NO_FIT:
            if not known.soft_chain:
                raise
            is_worse = True
        if is_worse and known.soft_chain:
            # A start to first order with a soft chain may be none for the exact model, as on bearings no file states.
            known = dataclasses.replace(known, soft_chain=False)
            if rigid is None:
                rigid, _ = starting_estimate(pair, observed_with(self.curves, pair, known), None, False, self.progress)
            return self.validated(rigid, known)
        plain, suspects = self._tested(found, known, misfit, beside)
        if suspects.formed:
            formed = _with_form(known, self.form)
            self.progress("fitting the form of the flanks")
            other = self._tried(without_scatter(pair, found), formed, misfit)
            if other is not None:
                plain, suspects = self._tested(other, formed, misfit, beside)
        if plain.verdict.state == "not explained" and pair.supports is not None:
            plain, suspects = self._described_otherwise(plain, suspects, beside)
        residual, is_failed = plain.verdict.residual, plain.verdict.state == "not explained"
        if (_are_more(suspects, beside) or is_failed) and residual < _BESIDE * plain.verdict.noise:
            # It may be that a better minimum leaves nothing.
            other = self._tried(plain.found, plain.known, misfit, searched=True)
            if other is not None and other.unlikelihood < plain.found.unlikelihood - GAIN:
                plain, suspects = self._tested(other, plain.known, misfit, beside)
        end = self._with_causes(plain, suspects) if _are_more(suspects, beside) else plain
        if end is not plain and not _are_more(plain.likely, beside) and not self._is_likelier(plain, end):
            end = plain
        if end.found.disagreeing and end.misfit.columns and end.verdict.state != "not explained":
            # The starts were made without the cause; two of them must agree with it.
            again = self._tried(None, end.known, end.misfit)
            if again is not None:
                better = again.unlikelihood < end.found.unlikelihood + GAIN
                found = again if better else dataclasses.replace(end.found, disagreeing=again.disagreeing)
                end = self._judged(found, end.known, end.misfit, end.likely)
        return end

    def _described_otherwise(self, plain: Explained, suspects: Likely, beside: Likely) -> tuple[Explained, Likely]:
        """The fit from each other disc as the first, if that is likelier.

        On bearings such a description makes nearly the same curves, so that a search may end in it: a minimum beside
        the best one, from which no single pin leads away.
        """
        for surface in other_descriptions(self.pair, plain.found.state.surface):
            self.progress("describing the drive from another disc")
            state = described_by(self.pair, plain.found, surface)
            other = self._tried(dataclasses.replace(plain.found, state=state), plain.known, plain.misfit)
            if other is not None and other.unlikelihood < plain.found.unlikelihood - GAIN:
                plain, suspects = self._tested(other, plain.known, plain.misfit, beside)
        return plain, suspects

    def _is_likelier(self, plain: Explained, end: Explained) -> bool:
        """Whether curves are much likelier with doubted causes: with the same errors in the fit, and from there."""
        if end.verdict.state == "not explained" or not end.is_settled:
            return False
        without = self._tried(end.found, end.known, plain.misfit, chosen=end.found.chosen)
        if without is None:  # nothing to hold them against
            return False
        least = without.unlikelihood
        if list(plain.found.chosen) == list(end.found.chosen):
            least = min(least, plain.found.unlikelihood)
        doubted = len(end.misfit.columns) - len(plain.misfit.columns)
        return end.found.unlikelihood < least - _LIKELIER * doubted

    def _with_causes(self, plain: Explained, suspects: Likely) -> Explained:
        """Fit suspected causes beside the errors; without them, as before, where they leave no fit."""
        pair, known = self.pair, plain.known
        # The scatter has absorbed as much of the causes as it could.
        found: Estimate | None = without_scatter(pair, plain.found)
        give = ripple = None
        coefficients: dict[str, Array] = {}
        ends: list[Explained] = []
        for _ in range(_MISFITS):
            taken = sum((suspects.columns[n] @ values for n, values in coefficients.items()), np.zeros(1))
            misfit = Discrepancy(suspects.columns, give, ripple, taken)
            found = self._tried(found, known, misfit)
            if found is None:
                break
            ends.append(self._judged(found, known, misfit, suspects))
            of_cause = {n: found.observed.estimated.get(f"{MISFIT}_{n}") for n in (GIVE, RIPPLE)}
            coefficients = {n: found.state.bench[part] for n, part in of_cause.items() if part is not None}
            gave = given_way(pair, found.observed, coefficients[GIVE]) if GIVE in coefficients else None
            there = ripple_of(found.observed, coefficients[RIPPLE]) if RIPPLE in coefficients else None
            settled = _is_settled(give, gave, _SETTLED) and _is_settled(ripple, there, _SETTLED_RIPPLE)
            give, ripple = gave, there
            if not settled:
                # Supports and torque are others than those that the contacts were solved with.
                ends[-1] = dataclasses.replace(ends[-1], is_settled=False)
                moved = dataclasses.replace(found.observed, give=give, ripple=ripple)
                every = causes(pair, moved, linearise(pair, moved, found.state))
                columns = {n: every.get(n, one) for n, one in suspects.columns.items()}
                suspects = dataclasses.replace(suspects, columns=columns)
            elif ends[-1].verdict.state != "not explained":
                return ends[-1]
            else:
                suspects = likely_causes(Residual(found), self._causes(found, known), suspects)
                known = _with_form(known, self.form) if suspects.formed else known
        # Where the model does not hold, each linearisation at supports that gave way may fit worse than the one before.
        return min(ends, key=lambda e: (e.verdict.state == "not explained", e.found.unlikelihood), default=plain)

    def _tested(self, found: Estimate, known: Prior, misfit: Discrepancy, beside: Likely) -> tuple[Explained, Likely]:
        """The verdict on a fit, with the causes that its residual resembles, and those that it perhaps resembles."""
        self.progress("testing the residual")
        residual, columns = Residual(found), self._causes(found, known)
        likely = likely_causes(residual, columns, beside)
        one = self._judged(found, known, misfit, likely)
        if _are_more(likely, beside) or one.verdict.state == "not explained":
            return one, likely
        # The scatter of pins and teeth may have absorbed most of a cause.
        doubted = likely_causes(residual, columns, beside, _DOUBTED)
        return one, dataclasses.replace(doubted, formed=likely.formed)

    def _causes(self, found: Estimate, known: Prior) -> dict[str, Array]:
        state = found.state if self.form and not known.profile else None
        return causes(self.pair, found.observed, found.linear, state)

    def _judged(self, found: Estimate, known: Prior, misfit: Discrepancy, likely: Likely) -> Explained:
        formed = bool(self.form and known.profile)
        return Explained(found, known, misfit, likely, verdict_of(found, likely, formed))

    def _tried(
        self,
        start: Estimate | None,
        known: Prior,
        misfit: Discrepancy,
        searched: bool = False,
        chosen: Sequence[str] | None = None,
    ) -> Estimate | None:
        """With causes that are not those of the drive, as on bearings that no file states, there may be no fit."""
        try:
            return fitted(self.curves, self.pair, start, known, self.progress, misfit, searched, chosen)
        except _NO_FIT:
            return None


def _are_more(likely: Likely, beside: Likely) -> bool:
    return likely.columns.keys() > beside.columns.keys()


def _is_settled(before: Array | None, after: Array | None, within: Array | Sequence[float] | float) -> bool:
    """Whether displacements, or a ripple of the torque, have been found."""
    if after is None:
        return True
    return bool((np.abs(after - (0.0 if before is None else before)) < within).all())


def _with_form(known: Prior, form: float) -> Prior:
    """The prior, with a form of the flanks among the errors: contacts move along a flank according to its form."""
    return dataclasses.replace(known, profile=dict.fromkeys(profile_names(PROFILE_ORDERS), form))
