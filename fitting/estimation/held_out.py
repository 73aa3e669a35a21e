"""Curves that are held out of the fit and predicted by it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from fitting.estimation.explanation import Explained, Explanation, Hypothesis, observed_with
from fitting.estimation.fit import OUTLYING, Estimate
from fitting.estimation.starts import Multistart, is_uneven
from fitting.estimation.validation import HeldOut, by_load, yardsticks
from fitting.model.observations import CREEP, errors_of, left_of, linearise, observations
from fitting.model.prior import Prior
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

_MISPREDICTED = 1.5  # times the noise: a fit that predicts no better is no start for another, and not explained


@dataclass(frozen=True)
class Prediction:
    """A fit without some curves, which it predicts.

    Attributes
    ----------
    pair, running, loops
        The nominal pair, all curves of a turning crank, and branches of loops.
    numbers
        Those of the running curves that are held out.
    progress
        Called with what is done.
    """

    pair: Pair
    running: Sequence[Curve]
    loops: Sequence[Curve]
    numbers: Sequence[int]
    progress: Callable[[str], None]

    @property
    def _others(self) -> list[Curve]:
        return [*(c for i, c in enumerate(self.running) if i not in self.numbers), *self.loops]

    def _prior(self, prior: Prior) -> Prior:
        """What a user has decided of errors alone: recordings are numbered anew, so nothing of the bench is decided."""
        decided, errors = prior.constraints, [*errors_of(self.pair), *prior.profile]
        return prior if decided is None else dataclasses.replace(prior, constraints=decided.only(errors))

    def start(self, prior: Prior) -> tuple[Estimate | None, HeldOut]:
        """Fit some points of the others, and predict; the fit is a start for that of all curves, if it is good enough.

        To first order in the errors is enough, a third of the work: where it predicts badly `again` decides.
        """
        self.progress("fitting without the held-out curves")
        observed = observed_with(self._others, self.pair, self._prior(prior))
        start = Multistart(self.pair, observed, None, self.progress).estimate()
        predicted = self._of(start)
        is_good = predicted.residual <= _MISPREDICTED * start.noise and not is_uneven(start)
        return start if is_good else None, predicted

    def again(self, explained: Explained) -> HeldOut:
        """Fit the others from the end of the fit of all curves, and predict."""
        self.progress("fitting without the held-out curves, from there")
        prior = self._prior(explained.hypothesis.prior)
        search = Explanation(self._others, self.pair, prior, self.progress)
        return self._of(search.fitted(Hypothesis(prior, start=explained.estimate)))

    def _of(self, fit: Estimate) -> HeldOut:
        """Residuals of the curves that were not fitted; their own zeros and drifts cannot be predicted."""
        curves = [self.running[i] for i in self.numbers]
        observed = observations(curves, self.pair, first_stage=fit.observed.first_stage)
        known = dict(zip(fit.observed.bench_names, fit.state.bench, strict=True))
        names = observed.bench_names
        own = np.array(
            [
                n.startswith("output_angle_drift") or not (n in known or n.startswith(CREEP))
                for n in observed.bench_names
            ]
        )
        if not all(c.common_zero for c in (*curves, *fit.observed.curves)):
            own |= np.array([n.startswith("output_angle_offset") for n in names])
        predictable = ~own & ~np.array([n.startswith(CREEP) for n in names])
        bench = np.array([known[n] if shared else 0.0 for n, shared in zip(names, predictable, strict=True)])
        state = dataclasses.replace(fit.state, bench=bench)
        left = left_of(observed, linearise(self.pair, observed, state), state)
        # What single samples far off do to the rms is not the model's.
        scale = 1.4826 * float(np.median(np.abs(left - np.median(left))))
        inside = np.abs(left - np.median(left)) < OUTLYING * scale
        columns = observed.bench[inside][:, own]
        left = left[inside] - columns @ np.linalg.lstsq(columns, left[inside], rcond=None)[0]
        loads = ", ".join(f"{c.torque:+.4g} N·m" for c in curves)
        counted = np.zeros(inside.size)
        counted[inside] = left
        yardstick = yardsticks(dataclasses.replace(observed, weight=inside.astype(float)), counted, np.nan)
        return HeldOut(loads, float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(yardstick**2))))


def is_mispredicted(predicted: HeldOut) -> bool:
    """Whether curves were not predicted to their noise."""
    return predicted.residual > _MISPREDICTED * predicted.noise


def kept_back(curves: Sequence[Curve]) -> tuple[int, ...]:
    """Choose the held-out curves to be predicted: a load between others, or a direction of the smallest.

    Empty where fewer than three curves were measured.
    """
    if len(curves) < 3:
        return ()
    groups = by_load(np.array([c.torque for c in curves]))
    if len(groups) >= 3:
        return tuple(int(i) for i in groups[len(groups) // 2])
    return (int(groups[0][0]),)
