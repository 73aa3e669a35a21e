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
from fitting.estimation.starting import GAIN, fitted, observed_with, started, starting_estimate, without_scatter
from fitting.estimation.validation import (
    FALSE,
    Likely,
    Residual,
    Verdict,
    causes_of,
    likely_causes,
    verdict_of,
)
from fitting.model.discrepancy import GIVE, RIPPLE, beside_the_gear, causes, given_way, swung
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
_SETTLED_SWING = 0.02  # of the torque: its effect is linear within
_DOUBTED, _LIKELIER = 0.05, 12.0  # a cause that noise resembles so rarely is tried; -2 log likelihood it must gain
_NO_FIT = edge.InputError, np.linalg.LinAlgError  # no contacts balance a load; singular equations


@dataclass(frozen=True)
class Explained:
    """A fit, the prior and the causes of misfit that it was made with, and what it leaves."""

    found: Estimate
    known: Prior
    misfit: Discrepancy
    likely: Likely
    verdict: Verdict


@dataclass(frozen=True)
class Explaining:
    """Fits of curves with causes of misfit beside the errors.

    A common form of the flanks, each of its orders of size `form` (m), is one such cause.
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
            suspected = causes_of(Residual(pair, start), beside_the_gear(start.observed)).columns
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
        residual, is_failed = plain.verdict.residual, plain.verdict.state == "not explained"
        if (_are_more(suspects, beside) or is_failed) and residual < _BESIDE * plain.verdict.noise:
            # It may be that a better minimum leaves nothing.
            other = self._tried(plain.found, plain.known, misfit, searched=True)
            if other is not None and other.unlikelihood < plain.found.unlikelihood - GAIN:
                plain, suspects = self._tested(other, plain.known, misfit, beside)
        end = self._with_causes(plain, suspects) if _are_more(suspects, beside) else plain
        gain = plain.found.unlikelihood - end.found.unlikelihood
        if not _are_more(plain.likely, beside) and not gain > _LIKELIER:
            end = plain
        if end.found.disagreeing and end.misfit.columns and end.verdict.state != "not explained":
            # The starts were made without the cause; two of them must agree with it.
            again = self._tried(None, end.known, end.misfit)
            if again is not None:
                better = again.unlikelihood < end.found.unlikelihood + GAIN
                found = again if better else dataclasses.replace(end.found, disagreeing=again.disagreeing)
                end = self._judged(found, end.known, end.misfit, end.likely)
        return end

    def _with_causes(self, plain: Explained, suspects: Likely) -> Explained:
        """Fit suspected causes beside the errors; without them, as before, where they leave no fit."""
        pair, known = self.pair, plain.known
        # The scatter has absorbed as much of the causes as it could.
        found: Estimate | None = without_scatter(pair, plain.found)
        give = swing = None
        coefficients: dict[str, Array] = {}
        ends: list[Explained] = []
        for _ in range(_MISFITS):
            taken = sum((suspects.columns[n] @ values for n, values in coefficients.items()), np.zeros(1))
            misfit = Discrepancy(suspects.columns, give, swing, taken)
            found = self._tried(found, known, misfit)
            if found is None:
                break
            ends.append(self._judged(found, known, misfit, suspects))
            of_cause = {n: found.observed.estimated.get(f"{MISFIT}_{n}") for n in (GIVE, RIPPLE)}
            coefficients = {n: found.state.bench[part] for n, part in of_cause.items() if part is not None}
            gave = given_way(pair, found.observed, coefficients[GIVE]) if GIVE in coefficients else None
            swings = swung(found.observed, coefficients[RIPPLE]) if RIPPLE in coefficients else None
            settled = _is_settled(give, gave, _SETTLED) and _is_settled(swing, swings, _SETTLED_SWING)
            give, swing = gave, swings
            if not settled:
                # Supports that gave way and torques that swung have moved the contacts: further ones act at the new.
                moved = dataclasses.replace(found.observed, give=give, swing=swing)
                there = causes(pair, moved, linearise(pair, moved, found.state))
                columns = {n: there.get(n, one) for n, one in suspects.columns.items()}
                suspects = dataclasses.replace(suspects, columns=columns)
            elif ends[-1].verdict.state != "not explained":
                return ends[-1]
            else:
                suspects = self._resembled(found, known, suspects)
                known = _with_form(known, self.form) if suspects.formed else known
        # Where the model does not hold, each linearisation at supports that gave way may fit worse than the one before.
        return min(ends, key=lambda e: (e.verdict.state == "not explained", e.found.unlikelihood), default=plain)

    def _tested(self, found: Estimate, known: Prior, misfit: Discrepancy, beside: Likely) -> tuple[Explained, Likely]:
        """The verdict on a fit, with the causes that its residual resembles, and those that it perhaps resembles."""
        self.progress("testing the residual")
        likely = self._resembled(found, known, beside)
        one = self._judged(found, known, misfit, likely)
        if _are_more(likely, beside) or one.verdict.state == "not explained":
            return one, likely
        # The scatter of pins and teeth may have absorbed most of a cause.
        doubted = self._resembled(found, known, beside, _DOUBTED)
        return one, dataclasses.replace(doubted, formed=likely.formed)

    def _resembled(self, found: Estimate, known: Prior, likely: Likely, false: float = FALSE) -> Likely:
        state = found.state if self.form and not known.profile else None
        columns = causes(self.pair, found.observed, found.linear, state)
        return likely_causes(Residual(self.pair, found), columns, likely, false)

    def _judged(self, found: Estimate, known: Prior, misfit: Discrepancy, likely: Likely) -> Explained:
        formed = bool(self.form and known.profile)
        return Explained(found, known, misfit, likely, verdict_of(self.pair, found, likely, formed))

    def _tried(
        self, start: Estimate | None, known: Prior, misfit: Discrepancy, searched: bool = False
    ) -> Estimate | None:
        """With causes that are not those of the drive, as on bearings that no file states, there may be no fit."""
        try:
            return fitted(self.curves, self.pair, start, known, self.progress, misfit, searched)
        except _NO_FIT:
            return None


def _are_more(likely: Likely, beside: Likely) -> bool:
    return likely.columns.keys() > beside.columns.keys()


def _is_settled(before: Array | None, after: Array | None, within: Array | Sequence[float] | float) -> bool:
    """Whether displacements or swings of the torque have been found."""
    if after is None:
        return True
    return bool((np.abs(after - (0.0 if before is None else before)) < within).all())


def _with_form(known: Prior, form: float) -> Prior:
    """The prior, with a form of the flanks among the errors: contacts move along a flank according to its form."""
    return dataclasses.replace(known, profile=dict.fromkeys(profile_names(PROFILE_ORDERS), form))
