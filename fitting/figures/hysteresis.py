"""Hysteresis loops: finding them in a recording, and the figures read off them.

Lost motion, backlash, hysteresis loss and torsional stiffness, each with its definition by name, its 95 % uncertainty
and the loops behind it. Loops are recorded with the input locked or turning slowly; what counts is the windup, the
output angle minus its share of the input angle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD
from fitting.figures.figure import DEFINITIONS, UNITS, Figure
from fitting.recordings.recording import Recording
from fitting.transmission_error.folding import LOCKED

Array = NDArray[np.float64]

# Intervals, as shares of the rated torque.
UNLOADING = (0.03, 0.10)  # of the straight lines that hysteresis loss extrapolates to zero torque
FRICTION = 0.50
STIFFNESS = (0.50, 1.00)
NEAR = 0.01  # a value "at" a torque is that of the line through the samples this close to it
FRICTION_NEAR = 0.05
_LOBE = 0.20  # a half loop goes beyond this
_REST = 0.025  # and begins and ends below this


@dataclass(frozen=True)
class Lobe:
    """Half a loop: the samples from zero torque up to the peak (loading) and from it back (unloading)."""

    sign: int
    loading: slice
    unloading: slice


@dataclass(frozen=True)
class Loop:
    """One loop: its positive and its negative half, in whichever order they came."""

    positive: Lobe
    negative: Lobe


def find_lobes(torque: Array, rated_torque: float) -> list[Lobe]:
    """Find the half loops in a torque that swings from zero to one side and back.

    Parameters
    ----------
    torque
        N·m, in the order of time; noise up to a few per cent of the rated torque does not matter.
    rated_torque
        T_N, N·m.

    Returns
    -------
    lobes
        Those that go beyond a fifth of the rated torque; begin and end are where the torque is next to zero.
    """
    beyond = np.flatnonzero(np.abs(torque) > _LOBE * rated_torque)
    if not beyond.size:
        return []
    side = np.sign(torque[beyond])
    # Between two samples beyond the threshold lies the end of a half loop where the torque went to zero between.
    breaks = []
    for at in np.flatnonzero((np.diff(beyond) > 1) | (np.diff(side) != 0.0)):
        first, last = beyond[at], beyond[at + 1]
        low = first + int(np.argmin(np.abs(torque[first : last + 1])))
        if side[at] != side[at + 1] or abs(torque[low]) < 2.0 * _REST * rated_torque:
            breaks.append((at, low))
    cores = np.split(np.arange(beyond.size), [at + 1 for at, _ in breaks])
    start = int(np.argmin(np.abs(torque[: beyond[0] + 1])))
    stop = beyond[-1] + int(np.argmin(np.abs(torque[beyond[-1] :])))
    borders = [start, *(low for _, low in breaks), stop]
    lobes = []
    for core, begin, end in zip(cores, borders[:-1], borders[1:], strict=True):
        inner = slice(int(beyond[core[0]]), int(beyond[core[-1]]) + 1)
        peak = inner.start + int(np.argmax(np.abs(torque[inner])))
        sign = int(side[core[0]])
        # The sample at the border belongs to the side on which its torque is.
        first = begin if torque[begin] * sign >= 0.0 else begin + 1
        last = end if torque[end] * sign < 0.0 else end + 1
        lobes.append(Lobe(sign, slice(first, peak), slice(peak, last)))
    return lobes


def find_loops(lobes: Sequence[Lobe]) -> list[Loop]:
    """Pair half loops that follow each other on opposite sides."""
    loops, at = [], 0
    while at + 1 < len(lobes):
        one, other = lobes[at : at + 2]
        if one.sign == other.sign:
            at += 1
            continue
        loops.append(Loop(one, other) if one.sign > 0 else Loop(other, one))
        at += 2
    return loops


@dataclass(frozen=True)
class Line:
    """A straight line fitted to windup over torque: value and slope at the centre, with their variances."""

    centre: float
    value: float
    slope: float
    value_variance: float
    slope_variance: float
    points: int

    def at(self, torque: float) -> tuple[float, float]:
        """Return value and variance at a torque."""
        away = torque - self.centre
        return self.value + self.slope * away, self.value_variance + self.slope_variance * away * away


def fit_line(torque: Array, windup: Array) -> Line | None:
    """Fit windup over torque; None where fewer than three samples or one torque are there.

    The variances are those of the residuals, made larger where neighbours' residuals are alike (a transmission error
    under a loop recorded in motion).
    """
    n = torque.size
    if n < 3 or np.ptp(torque) == 0.0:
        return None
    centre = float(torque.mean())
    x, y = torque - centre, windup - windup.mean()
    spread = float(x @ x)
    slope = float(x @ y) / spread
    left = y - slope * x
    variance = float(left @ left) / (n - 2)
    alike = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300) if n > 3 else 0.0
    alike = min(max(alike, 0.0), 1.0 - 2.0 / n)
    variance *= (1.0 + alike) / (1.0 - alike)
    return Line(centre, float(windup.mean()), slope, variance / n, variance / spread, n)


def branch_line(torque: Array, windup: Array, part: slice, low: float, high: float) -> Line | None:
    """Fit a line to the part of a branch whose torque, of either sign, is from `low` to `high`; None as `fit_line`."""
    t = torque[part]
    inside = (np.abs(t) >= low) & (np.abs(t) <= high)
    return fit_line(t[inside], windup[part][inside])


_Value = tuple[float, float]  # and its variance


@dataclass(frozen=True)
class _LoopValues:
    """What one loop gives, each with its variance; None where its branches don't hold it."""

    hysteresis_loss: _Value | None
    backlash: _Value | None
    lost_motion: _Value | None
    stiffness_positive: _Value | None
    stiffness_negative: _Value | None
    middle: _Value | None


def _stiffness(torque: Array, windup: Array, lobe: Lobe, rated: float) -> _Value | None:
    line = branch_line(torque, windup, lobe.loading, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
    if line is None or line.slope <= 0.0:
        return None
    return 1.0 / line.slope, line.slope_variance / line.slope**4


def _loop_values(torque: Array, windup: Array, loop: Loop, rated: float) -> _LoopValues:
    sides = (loop.positive, loop.negative)
    unloading = [branch_line(torque, windup, s.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated) for s in sides]
    hysteresis = middle = backlash = lost = None
    if unloading[0] is not None and unloading[1] is not None:
        (up, up_variance), (down, down_variance) = (line.at(0.0) for line in unloading if line is not None)
        hysteresis = up - down, up_variance + down_variance
        middle = 0.5 * (up + down), 0.25 * (up_variance + down_variance)

    def both(share: float, near: float) -> list[tuple[_Value, _Value]] | None:
        found = []
        for side in sides:
            pair = [
                branch_line(torque, windup, b, (share - near) * rated, (share + near) * rated)
                for b in (side.loading, side.unloading)
            ]
            if pair[0] is None or pair[1] is None:
                return None
            found.append((pair[0].at(side.sign * share * rated), pair[1].at(side.sign * share * rated)))
        return found

    at = both(LOST_MOTION_LOAD, NEAR)
    if at is not None:
        (a, b), (c, d) = at
        lost = 0.5 * (a[0] + b[0] - c[0] - d[0]), 0.25 * (a[1] + b[1] + c[1] + d[1])
    widths = both(FRICTION, FRICTION_NEAR)
    if widths is not None and hysteresis is not None:
        (a, b), (c, d) = widths
        # On the positive side unloading lies above loading, on the negative below: both widths are 2 T_f / k.
        width = 0.5 * ((b[0] - a[0]) + (c[0] - d[0])), 0.25 * (a[1] + b[1] + c[1] + d[1])
        backlash = hysteresis[0] - width[0], hysteresis[1] + width[1]
    stiffness = [_stiffness(torque, windup, side, rated) for side in sides]
    return _LoopValues(hysteresis, backlash, lost, stiffness[0], stiffness[1], middle)


def _mean(values: Sequence[_Value], drift: float = 0.0) -> _Value:
    """Return mean and half the 95 % interval: from the fits, or from three or more loops' scatter where that is larger.

    A drift of a loop moves its two sides, half a loop apart, against each other by half of it.
    """
    value = float(np.mean([v for v, _ in values]))
    count = len(values)
    uncertainty = math.sqrt(sum(variance for _, variance in values)) / count * 1.96
    if count > 2:
        scatter = float(np.std([v for v, _ in values], ddof=1)) / math.sqrt(count)
        uncertainty = max(uncertainty, float(stdtrit(count - 1, 0.975)) * scatter)
    return value, math.hypot(uncertainty, 0.5 * drift)


@dataclass(frozen=True)
class LoopData:
    """A recording with loops: torque and windup (rad), its loops, rated torque, source.

    `windup` is zero where the two unloading branches of all loops, extrapolated to zero torque, have their middle.
    `late` is the torque as it was later, by half the 95 % interval of what is not known of its clock against the
    windup's; None where one clock stamped both. `runaway` is how far the windup may run away, rad, for what is not
    known of the two angles' clocks.
    """

    torque: Array
    windup: Array
    loops: tuple[Loop, ...]
    lobes: tuple[Lobe, ...]
    rated_torque: float
    source: str
    late: Array | None = None
    runaway: float = 0.0


def _moved(values: Sequence[_Value], later: Sequence[_Value | None]) -> float:
    """Return by how much the mean of values moves where the torque comes late."""
    kept = [v for v, _ in filter(None, later)]
    return abs(float(np.mean(kept) - np.mean([v for v, _ in values]))) if kept else 0.0


def loop_figures(data: LoopData) -> tuple[dict[str, Figure], list[str]]:
    """Return the figures that loops give, and why others could not be given.

    Parameters
    ----------
    data
        Torque and windup with the loops found in them.

    Returns
    -------
    figures
        By name; `torsional_stiffness` also of each side.
    notes
        One sentence for each figure that is missing and for a loop that does not close.
    """
    torque, windup, rated = data.torque, data.windup, data.rated_torque
    figures: dict[str, Figure] = {}
    notes: list[str] = []
    found = [_loop_values(torque, windup, loop, rated) for loop in data.loops]
    later = found if data.late is None else [_loop_values(data.late, windup, loop, rated) for loop in data.loops]
    drift, added = _closure(data, found)
    notes.extend(added)
    for name, interval in (
        ("hysteresis_loss", UNLOADING), ("backlash", UNLOADING), ("lost_motion", (-LOST_MOTION_LOAD, LOST_MOTION_LOAD)),
    ):  # fmt: skip
        values = [v for one in found if (v := getattr(one, name)) is not None]
        if values:
            value, uncertainty = _mean(values, drift)
            uncertainty = math.hypot(uncertainty, data.runaway, _moved(values, [getattr(one, name) for one in later]))
            figures[name] = Figure(
                value, uncertainty, UNITS[name], DEFINITIONS[name], (interval[0] * rated, interval[1] * rated), "N*m",
                len(values), "loops",
            )  # fmt: skip
        elif data.loops:
            notes.append(
                f"{data.source}: {name} could not be given: a branch has fewer than three samples where it is taken."
            )
    if not data.loops:
        sides = {lobe.sign for lobe in data.lobes}
        only = "positive" if sides == {1} else "negative"
        notes.append(
            f"{data.source}: the torque never crosses zero, it is always {only}; hysteresis loss, backlash and lost "
            "motion need both sides."
        )
    stiffness = {
        side: [v for lobe in data.lobes if lobe.sign == sign and (v := _stiffness(torque, windup, lobe, rated))]
        for side, sign in (("positive", 1), ("negative", -1))
    }
    reached = float(np.abs(torque).max())
    low, high = STIFFNESS[0] * rated, min(STIFFNESS[1] * rated, reached)
    if high < 0.75 * rated:
        notes.append(
            f"{data.source}: torsional_stiffness could not be given: the torque reaches {reached:.4g} N·m, less than "
            f"three quarters of the rated {rated:.4g} N·m."
        )
    elif any(stiffness.values()):
        if high < 0.95 * rated:
            notes.append(
                f"{data.source}: the torque reaches {reached:.4g} N·m of the rated {rated:.4g} N·m; the stiffness is "
                "that up to there."
            )
        name = "torsional_stiffness"
        parts = {
            side: Figure(*_mean(v), UNITS[name], DEFINITIONS[name], (low, high), "N*m", len(v), "loops")
            for side, v in stiffness.items()
            if v
        }
        value = float(np.mean([p.value for p in parts.values()]))
        uncertainty = math.hypot(*(p.uncertainty for p in parts.values())) / len(parts)
        count = min(p.count for p in parts.values())
        figures[name] = Figure(
            value, uncertainty, UNITS[name], DEFINITIONS[name], (low, high), "N*m", count, "loops", parts
        )
    return figures, notes


def _closure(data: LoopData, found: Sequence[_LoopValues]) -> tuple[float, list[str]]:
    """Return by how much a loop drifts (rad), and a sentence where loops do not close."""
    middles = [v for one in found if (v := one.middle) is not None]
    losses = [v for one in found if (v := one.hysteresis_loss) is not None]
    if not losses:
        return 0.0, []
    loss = abs(float(np.mean([v for v, _ in losses])))
    if len(middles) > 1:
        drift = float(np.polyfit(np.arange(len(middles)), [v for v, _ in middles], 1)[0])
        noise = 3.0 * math.sqrt(max(v for _, v in middles))
        if abs(drift) > max(0.1 * loss, noise):
            return drift, [
                f"{data.source}: the loops do not close: each lies {drift * edge.ARCSEC:.3g}″ from the one before; the "
                "uncertainties say what that can do."
            ]
        return 0.0, []
    # A single loop must begin between its two unloading branches at zero torque, wherever in the play it stood.
    loop, (middle, variance) = data.loops[0], middles[0]
    first = min((loop.positive, loop.negative), key=lambda lobe: lobe.loading.start)
    line = branch_line(data.torque, data.windup, first.loading, 0.0, 0.1 * data.rated_torque)
    start = line.at(0.0)[0] if line is not None else float(data.windup[first.loading.start])
    outside = abs(start - middle) - 0.5 * loss
    if outside > 0.1 * loss + 3.0 * math.sqrt(variance):
        return outside, [
            f"{data.source}: the loop does not close: it begins {outside * edge.ARCSEC:.3g}″ outside its unloading "
            "branches; the uncertainties say what that can do."
        ]
    return 0.0, []


def loop_marks(data: LoopData) -> dict[str, list[Array]]:
    """Return where the first loop's figures are read off: {figure: lines of (torque, windup), shape (points, 2)}.

    Hysteresis loss: both unloading branches' straight lines down to zero torque and the distance there. Backlash: what
    remains of it without friction, about the same middle. Lost motion: from the mean at its
    negative load to that at its positive one. Torsional stiffness: the fitted lines.
    """
    torque, windup, rated = data.torque, data.windup, data.rated_torque
    marks: dict[str, list[Array]] = {}
    for lobe in data.lobes[:2]:
        line = branch_line(torque, windup, lobe.loading, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
        if line is not None:
            ends = [lobe.sign * share * rated for share in STIFFNESS]
            marks.setdefault("torsional_stiffness", []).append(np.array([(t, line.at(t)[0]) for t in ends]))
    if not data.loops:
        return marks
    loop = data.loops[0]
    values = _loop_values(torque, windup, loop, rated)
    if values.hysteresis_loss is None or values.middle is None:
        return marks
    middle, half = values.middle[0], 0.5 * values.hysteresis_loss[0]
    lines = [np.array([(0.0, middle - half), (0.0, middle + half)])]
    for side in (loop.positive, loop.negative):
        line = branch_line(torque, windup, side.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated)
        assert line is not None
        lines.append(np.array([(t, line.at(t)[0]) for t in (0.0, side.sign * UNLOADING[1] * rated)]))
    marks["hysteresis_loss"] = lines
    if values.backlash is not None:
        half = 0.5 * values.backlash[0]
        marks["backlash"] = [np.array([(0.0, middle - half), (0.0, middle + half)])]
    if values.lost_motion is not None:
        at = []
        for side in (loop.negative, loop.positive):
            t = side.sign * LOST_MOTION_LOAD * rated
            near = ((LOST_MOTION_LOAD - NEAR) * rated, (LOST_MOTION_LOAD + NEAR) * rated)
            pair = [branch_line(torque, windup, b, *near) for b in (side.loading, side.unloading)]
            at.append((t, float(np.mean([one.at(t)[0] for one in pair if one is not None]))))
        marks["lost_motion"] = [np.array(at)]
    return marks


def loops_of(
    recording: Recording, ratio: float | None, rated_torque: float | None
) -> tuple[LoopData | None, list[str]]:
    """Return the loops of a recording, or None where it is a run at a load, and notes on them.

    Parameters
    ----------
    recording
        The recording.
    ratio
        Signed ratio; None needs the input locked.
    rated_torque
        T_N, N·m; None takes the largest torque of the recording, with a note.
    """
    torque, notes = recording.torque, []
    largest = float(np.abs(torque).max())
    if largest == 0.0:
        return None, []
    rated = rated_torque or largest
    lobes = find_lobes(torque, rated)
    inside = [
        min(np.count_nonzero(np.abs(torque[part]) < 0.5 * rated) for part in (lobe.loading, lobe.unloading))
        for lobe in lobes
    ]
    # A load that is switched on, or that shakes around zero, is no loop: each branch is a way of many samples.
    lobes = [lobe for lobe, count in zip(lobes, inside, strict=True) if count >= 8]
    locked = float(np.ptp(recording.input_angle)) < LOCKED
    if not lobes or (not locked and len({lobe.sign for lobe in lobes}) < 2):
        if locked and not lobes:
            notes.append(
                f"{recording.source}: the input is locked, but the torque does not go beyond a fifth of the rated "
                f"{rated:.4g} N·m and back; there is no loop."
            )
        return None, notes
    if ratio is None and not locked:
        return None, notes
    if rated_torque is None:
        notes.append(
            f"{recording.source}: no rated torque is known; the figures are taken at shares of the largest torque, "
            f"{largest:.4g} N·m."
        )
    windup = recording.output_angle.copy()
    if ratio is not None:
        windup -= recording.input_angle / ratio
    time, late, runaway = recording.time, None, 0.0
    if recording.torque_alignment > 0.0:
        late = np.interp(time + recording.torque_alignment, time, torque)
    if not locked:
        runaway = 2.0 * recording.alignment * float(np.abs(np.diff(recording.output_angle)).sum() / np.ptp(time))
    loops = tuple(find_loops(lobes))
    return LoopData(torque, windup - windup.mean(), loops, tuple(lobes), rated, recording.source, late, runaway), notes
