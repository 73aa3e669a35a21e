"""Curves that are held out of the fit and predicted by it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from fitting.estimation.explanation import GAIN, Explained, observed_with
from fitting.estimation.fit import OUTLYING, Estimate, fit
from fitting.estimation.starts import Multistart, is_uneven
from fitting.estimation.validation import HeldOut, by_load, yardsticks
from fitting.model.identifiability import chosen_of
from fitting.model.observations import CREEP, NO_CREEP, Observations, errors_of, left_of, linearise, observations
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
        curves = [self.running[i] for i in self.numbers]
        predicted = self._of(start, observations(curves, self.pair, first_stage=prior.first_stage))
        is_good = predicted.residual <= _MISPREDICTED * start.noise and not is_uneven(start)
        return start if is_good else None, predicted

    def again(self, explained: Explained) -> HeldOut:
        """Fit the others from the end of the fit of all curves, with its causes, and predict."""
        self.progress("fitting without the held-out curves, from there")
        end, known = explained.estimate, explained.hypothesis.prior.scatter
        others = [i for i in range(len(end.observed.curves)) if i not in self.numbers]
        observed = end.observed.some(others)
        resolved = chosen_of(self.pair, observed, linearise(self.pair, observed, end.state))
        chosen = [name for name in end.chosen if name in resolved]
        fitted = fit(self.pair, observed, chosen, end.state, end.scatter, gain=GAIN, known=known)
        return self._of(fitted, end.observed.some(self.numbers))

    def _of(self, estimate: Estimate, observed: Observations) -> HeldOut:
        """Residuals of observations that were not fitted.

        Their own zeros and drifts cannot be predicted, the change of a common zero only to its size.
        """
        curves, names = observed.curves, observed.bench_names
        fitted = zip(estimate.observed.bench_names, estimate.state.bench, estimate.observed.bench.T, strict=True)
        known = {name: value for name, value, column in fitted if column.any()}
        creeps = np.array([n.startswith(CREEP) for n in names])
        own = creeps | np.array([n.startswith("output_angle_drift") or n not in known for n in names])
        if not all(c.common_zero for c in (*curves, *estimate.observed.curves)):
            own |= np.array([n.startswith("output_angle_offset") for n in names])
        bench = np.array([0.0 if apart else known[n] for n, apart in zip(names, own, strict=True)])
        state = dataclasses.replace(estimate.state, bench=bench)
        left = left_of(observed, linearise(self.pair, observed, state), state)
        # What single samples far off do to the rms is not the model's.
        scale = 1.4826 * float(np.median(np.abs(left - np.median(left))))
        inside = np.abs(left - np.median(left)) < OUTLYING * scale
        columns = observed.bench[inside][:, own]
        # A row for the size of each creep, in units of the noise.
        rows = estimate.noise / max(estimate.scatter.get(CREEP, 0.0), NO_CREEP) * np.eye(own.sum())[creeps[own]]
        targets = np.append(left[inside], np.zeros(len(rows)))
        left = left[inside] - columns @ np.linalg.lstsq(np.vstack([columns, rows]), targets, rcond=None)[0]
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
