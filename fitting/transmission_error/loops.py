"""Hysteresis loops of a recording as data: half loops, loops, and lines through them.

Loops are recorded with the input locked or turning slowly; they are windup, output angle minus input angle over ratio,
against torque.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.readers.recording import Recording
from fitting.transmission_error.folding import LOCKED

Array = NDArray[np.float64]
SIDES = (("positive", 1), ("negative", -1))
_LOBE = 0.20  # a half loop exceeds this
_REST = 0.025  # and begins and ends below this
_FEWEST = 8  # samples of a branch below half the rated torque
_AGAINST = -0.2  # correlation of windup and torque of a wrong direction; that of a loop is positive


@dataclass(frozen=True)
class Lobe:
    """Half a loop: sign of its torque, and samples from zero torque to the peak (loading) and back (unloading)."""

    sign: int
    loading: slice
    unloading: slice


@dataclass(frozen=True)
class Loop:
    """One loop: its positive and its negative half, in either order."""

    positive: Lobe
    negative: Lobe


def find_lobes(torque: Array, rated_torque: float) -> list[Lobe]:
    """Find the half loops, in which the torque goes from zero to one side and back.

    Parameters
    ----------
    torque
        Torques, N·m, in the order of time, shape (n,); noise up to a few percent of the rated torque has no effect.
    rated_torque
        Rated torque T_N, N·m.

    Returns
    -------
    lobes
        Half loops that exceed a fifth of the rated torque; they begin and end where the torque is closest to zero.
    """
    beyond = np.flatnonzero(np.abs(torque) > _LOBE * rated_torque)
    if not beyond.size:
        return []
    side = np.sign(torque[beyond])
    # A half loop ends between two samples beyond the threshold if the torque went to zero between them.
    breaks = []
    for at in np.flatnonzero((np.diff(beyond) > 1) | (np.diff(side) != 0.0)):
        first, last = beyond[at], beyond[at + 1]
        low = first + int(np.argmin(np.abs(torque[first : last + 1])))
        if side[at] != side[at + 1] or abs(torque[low]) < 2.0 * _REST * rated_torque:
            breaks.append((at, low))
    cores = np.split(np.arange(beyond.size), [at + 1 for at, _ in breaks])
    start = int(beyond[0]) - _rest_of(torque[beyond[0] :: -1], rated_torque)
    stop = int(beyond[-1]) + _rest_of(torque[beyond[-1] :], rated_torque)
    borders = [start, *(low for _, low in breaks), stop]
    lobes = []
    for core, begin, end in zip(cores, borders[:-1], borders[1:], strict=True):
        inner = slice(int(beyond[core[0]]), int(beyond[core[-1]]) + 1)
        peak = inner.start + int(np.argmax(np.abs(torque[inner])))
        sign = int(side[core[0]])
        # The sample at the border belongs to the side of its torque's sign.
        first = begin if torque[begin] * sign >= 0.0 else begin + 1
        last = end if torque[end] * sign < 0.0 else end + 1
        lobes.append(Lobe(sign, slice(first, peak), slice(peak, last)))
    return lobes


def _rest_of(torque: Array, rated_torque: float) -> int:
    """Return the place closest to zero in the first stretch near zero; closest of all without such a stretch."""
    near = np.abs(torque) < _REST * rated_torque
    if not near.any():
        return int(np.argmin(np.abs(torque)))
    first = int(np.argmax(near))
    rest = near[first:]
    last = first + (int(np.argmin(rest)) if not rest.all() else rest.size)
    return first + int(np.argmin(np.abs(torque[first:last])))


def find_loops(lobes: Sequence[Lobe]) -> list[Loop]:
    """Pair consecutive half loops on opposite sides."""
    loops, at = [], 0
    while at + 1 < len(lobes):
        first, second = lobes[at : at + 2]
        if first.sign == second.sign:
            at += 1
            continue
        loops.append(Loop(first, second) if first.sign > 0 else Loop(second, first))
        at += 2
    return loops


@dataclass(frozen=True)
class Line:
    """A line fitted to windup, rad, over torque, N·m: centre, value there and slope with their variances, points."""

    centre: float
    value: float
    slope: float
    value_variance: float
    slope_variance: float
    points: int

    def at(self, torque: float) -> tuple[float, float]:
        """Return value, rad, and variance, rad², at a torque, N·m."""
        away = torque - self.centre
        return self.value + self.slope * away, self.value_variance + self.slope_variance * away * away


def fit_line(torque: Array, windup: Array) -> Line | None:
    """Fit a line to windup, rad, over torque, N·m, shape (n,); None with fewer than three samples or a single torque.

    The variances are from the residuals, increased for the correlation of neighbours (such as a transmission error in a
    loop recorded in motion).
    """
    n = torque.size
    if n < 3 or np.ptp(torque) == 0.0:
        return None
    centre = float(torque.mean())
    x, y = torque - centre, windup - windup.mean()
    spread = float(x @ x)
    slope = float(x @ y) / spread
    variance = residual_variance(y - slope * x, n - 2)
    return Line(centre, float(windup.mean()), slope, variance / n, variance / spread, n)


def sample_noise(values: Array) -> float:
    """Return the standard deviation of white noise in the samples of a slow signal, from their second differences."""
    return float(np.median(np.abs(np.diff(values, 2)))) / (0.6745 * math.sqrt(6.0))


def residual_variance(residual: Array, degrees: int) -> float:
    """Return the variance of a fit's residuals, increased for the correlation of neighbours; 0 without a residual."""
    n, square = residual.size, float(residual @ residual)
    alike = float(residual[1:] @ residual[:-1]) / max(square, 1e-300) if n > 3 else 0.0
    alike = min(max(alike, 0.0), 1.0 - 2.0 / n)
    return square / degrees * (1.0 + alike) / (1.0 - alike)


@dataclass(frozen=True)
class LoopData:
    """A recording with loops: time, s, torque, N·m, windup, rad, loops and half loops, rated torque, N·m, source.

    `windup` is as measured, minus its mean. `late` is the torque shifted in time by half the 95 % interval of its clock
    against the windup's; None for one clock. `runaway` is the possible drift of the windup, rad, from the uncertainty
    of the two angles' clocks. `group` is the number that the recording states for these loops, if any.
    """

    time: Array
    torque: Array
    windup: Array
    loops: tuple[Loop, ...]
    lobes: tuple[Lobe, ...]
    rated_torque: float
    source: str
    late: Array | None = None
    runaway: float = 0.0
    group: float | None = None

    @property
    def steady(self) -> tuple[Loop, ...]:
        """The loops after the virgin branch, which is the first of a recording; none for a single loop."""
        return tuple(find_loops(self.lobes[1:]))


def windup_of(recording: Recording, ratio: float | None) -> Array:
    """Return the output angle minus the input angle over the ratio, rad; without a ratio the output angle."""
    return recording.output_angle - (0.0 if ratio is None else recording.input_angle / ratio)


def _fault_of(windup: Array, torque: Array) -> str:
    """Return why a windup is not that of a torque on a drive with a locked shaft, "" if it may be."""
    if not np.ptp(windup) > 0.0:
        return f"is constant while the torque changes by {float(np.ptp(torque)):.4g} N·m, so its encoder is stuck"
    if float(np.corrcoef(windup, torque)[0, 1]) < _AGAINST:
        return (
            "falls while the torque grows, so the direction of one of them is wrong; state direction = -1 for it in "
            "the mapping"
        )
    return ""


def loops_of(
    recording: Recording, ratio: float | None, rated_torque: float | None
) -> tuple[LoopData | None, list[str]]:
    """Return the loops of a recording, or None for a run at a load, and notes on them.

    Parameters
    ----------
    recording
        The recording.
    ratio
        Signed ratio input/output; None: only a locked input is evaluated.
    rated_torque
        Rated torque T_N, N·m; None: the largest torque of the recording, with a note.
    """
    torque, notes = recording.torque, []
    locked = float(np.ptp(recording.input_angle)) < LOCKED
    at_rest = "the input is at rest" if recording.has_input_angle else "no input angle is mapped"
    at_rest = f"the {recording.locked} is locked" if recording.locked else at_rest
    # A drive with a locked input does not move its output as far as a turn of the input would. Where a lock is stated,
    # the limit is a turn of the output itself, which no windup comes near, however soft the drive.
    turned = float(np.ptp(recording.output_angle)) / (2.0 * np.pi)
    if locked and turned * (1.0 if recording.locked else abs(ratio or 1.0)) > 1.0:
        if recording.locked:
            text = (
                f"the {recording.locked} is stated to be locked, but the angle spans {turned:.3g} turns of the output"
            )
            most = "more than any windup"
        else:
            text = f"{at_rest}, but the output turns by {turned:.3g} turns"
            most = "more than that of a drive with a locked input"
        return None, [f"{recording.source}: {text}, {most}: there is neither a loop nor a transmission error."]
    largest = float(np.abs(torque).max())
    if not largest > 0.0:  # none, or unknown
        return None, []
    rated = rated_torque or largest
    every = find_lobes(torque, rated)
    inside = [
        min(np.count_nonzero(np.abs(torque[part]) < 0.5 * rated) for part in (lobe.loading, lobe.unloading))
        for lobe in every
    ]
    # A load that is switched on or fluctuates around zero is no loop: each branch must have many samples.
    lobes = [lobe for lobe, count in zip(every, inside, strict=True) if count >= _FEWEST]
    if not lobes or (not locked and len({lobe.sign for lobe in lobes}) < 2):
        if locked and not lobes:
            why = f"the torque does not exceed a fifth of the rated {rated:.4g} N·m and return"
            if every:
                why = (
                    f"a branch has {max(inside)} samples below half of the rated {rated:.4g} N·m, at least {_FEWEST} "
                    f"are needed (the torque reaches {largest:.4g} N·m)"
                )
            notes.append(f"{recording.source}: {at_rest}, and {why}; there is no loop.")
        return None, notes
    if ratio is None and not locked:
        return None, notes
    windup = windup_of(recording, ratio)
    if locked and (fault := _fault_of(windup, torque)):
        return None, [*notes, f"{recording.source}: {at_rest}, and the angle {fault}; there is no loop."]
    if not recording.has_input_angle:
        notes.append(f"{recording.source}: {at_rest}; the output angle is taken as the windup.")
    if rated_torque is None:
        notes.append(
            f"{recording.source}: the rated torque is unknown; figures are evaluated at fractions of the largest "
            f"torque, {largest:.4g} N·m."
        )
    time, late, runaway = recording.time, None, 0.0
    if recording.torque_alignment > 0.0:
        late = np.interp(time + recording.torque_alignment, time, torque)
    if not locked:
        runaway = 2.0 * recording.alignment * float(np.abs(np.diff(recording.output_angle)).sum() / np.ptp(time))
    loops = tuple(find_loops(lobes))
    data = LoopData(time, torque, windup - windup.mean(), loops, tuple(lobes), rated, recording.source, late, runaway)
    return data, notes
