"""The standard figures: transmission error, lost motion, backlash, stiffness, hysteresis, starting torques.

Each figure has its definition by name, its 95 % uncertainty and the loops or turns behind it. Loops are recorded with
the input locked or turning slowly; what counts is the windup, the output angle less its share of the input angle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from cycloid_fmu.pair import LOST_MOTION, LOST_MOTION_LOAD
from fitting.curve import Curve, Folding, Spectrum, lag_of, significant, spectrum, synthesised
from fitting.recording import OPTIONAL, BenchRecording, BenchStream, Block

Array = NDArray[np.float64]
FORMAT = "cycloid-figures/1"

# Intervals, as shares of the rated torque.
UNLOADING = (0.03, 0.10)  # of the straight lines that hysteresis loss extrapolates to zero torque
FRICTION = 0.50
STIFFNESS = (0.50, 1.00)
NEAR = 0.01  # a value "at" a torque is that of the line through the samples this close to it
FRICTION_NEAR = 0.05
_LOBE = 0.20  # a half loop goes beyond this
_REST = 0.025  # and begins and ends below this
_START = math.radians(1.0)  # of the crank: it has started
_UNLOADED = 0.1  # of the torque on the input is what the output's may take of it in a start without load
_REDRAWN = 200  # spectra drawn with the noise found, for the uncertainty of a largest and a smallest value

DEFINITIONS = {
    "hysteresis_loss": "distance of the two unloading branches, each extrapolated to zero torque by a straight line "
    "over the interval on its own side (Nabtesco)",
    "backlash": "hysteresis loss less twice the dry friction torque over the stiffness: less the mean distance of "
    "loading and unloading branch at ±50 % of the rated torque",
    "lost_motion": f"{LOST_MOTION}, mean of loading and unloading branch (Nabtesco)",
    "torsional_stiffness": "torque over windup along the loading branches in the interval, mean of both sides",
    "starting_torque": "largest torque on the input, the output without load, from a standstill until the crank has "
    "turned 1 degree, mean of the starts (no-load starting torque)",
    "back_driving_torque": "largest torque on the output, while it drives, from a standstill until the crank has "
    "turned 1 degree, mean of the starts (overhauling starting torque)",
    "angular_transmission_error": "largest less smallest value over one output turn, in one direction, of the curve "
    "averaged over turns and made of the orders that stand out of the noise (GB/T 35089); the largest of the runs",
}
UNITS = {
    "hysteresis_loss": "rad", "backlash": "rad", "lost_motion": "rad", "torsional_stiffness": "N*m/rad",
    "starting_torque": "N*m", "back_driving_torque": "N*m", "angular_transmission_error": "rad",
}  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """One figure, SI.

    Attributes
    ----------
    value, uncertainty
        The value and half its 95 % interval; NaN where one repetition leaves it unknown.
    unit
        Of both.
    definition
        How it is defined.
    interval
        Where on the curve it was taken, in `interval_unit`.
    interval_unit
        "N*m" of torque or "rad" of the output.
    count, counted
        How many loops, turns or starts are behind it, and which of these.
    parts
        The same figure of parts of the data: `forward` and `backward`, `positive` and `negative`.
    runs
        {what was run: the figure} where several runs were made.
    """

    value: float
    uncertainty: float
    unit: str
    definition: str
    interval: tuple[float, float] | None
    interval_unit: str
    count: float
    counted: str
    parts: dict[str, Figure] = field(default_factory=dict)
    runs: dict[str, Figure] = field(default_factory=dict)


# ------------------------------------------------------------------------------------------------------------- the loop


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


def _branch(torque: Array, windup: Array, part: slice, low: float, high: float) -> Line | None:
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
    line = _branch(torque, windup, lobe.loading, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
    if line is None or line.slope <= 0.0:
        return None
    return 1.0 / line.slope, line.slope_variance / line.slope**4


def _loop_values(torque: Array, windup: Array, loop: Loop, rated: float) -> _LoopValues:
    sides = (loop.positive, loop.negative)
    unloading = [_branch(torque, windup, s.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated) for s in sides]
    hysteresis = middle = backlash = lost = None
    if unloading[0] is not None and unloading[1] is not None:
        (up, up_variance), (down, down_variance) = (line.at(0.0) for line in unloading if line is not None)
        hysteresis = up - down, up_variance + down_variance
        middle = 0.5 * (up + down), 0.25 * (up_variance + down_variance)

    def both(share: float, near: float) -> list[tuple[_Value, _Value]] | None:
        found = []
        for side in sides:
            pair = [
                _branch(torque, windup, b, (share - near) * rated, (share + near) * rated)
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
    """A recording with loops: torque and windup (rad), its loops, rated torque, whence.

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
    drift, said = _closure(data, found)
    notes.extend(said)
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
    line = _branch(data.torque, data.windup, first.loading, 0.0, 0.1 * data.rated_torque)
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
        line = _branch(torque, windup, lobe.loading, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
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
        line = _branch(torque, windup, side.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated)
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
            pair = [_branch(torque, windup, b, *near) for b in (side.loading, side.unloading)]
            at.append((t, float(np.mean([one.at(t)[0] for one in pair if one is not None]))))
        marks["lost_motion"] = [np.array(at)]
    return marks


# ------------------------------------------------------------------------------------------------ transmission errors


def angular_transmission_error(curve: Curve, orders: Spectrum, *, seed: int = 0) -> Figure:
    """Return the largest less the smallest transmission error over one output turn of a curve.

    The curve is that of the orders which stand out of the noise: the largest of noisy values is too large. What the
    noise left in these orders still adds is found by drawing spectra with it, taken off, and is the uncertainty.

    Parameters
    ----------
    curve, orders
        A curve over a whole turn and its orders.
    seed
        Of the noise that is drawn.
    """
    rng = np.random.default_rng(seed)
    kept = np.where(orders.significant, orders.coefficient, 0.0)
    highest = int(np.flatnonzero(orders.significant).max(initial=1))
    points = 1 << max(10, math.ceil(math.log2(64 * highest)))
    found = float(_range_of(kept[: highest + 1], points)[0])
    drawn = np.empty(_REDRAWN)
    step = max(1, (1 << 22) // points)
    for begin in range(0, _REDRAWN, step):
        rows = min(step, _REDRAWN - begin)
        noise = rng.normal(size=(rows, 2, highest + 1)) * (orders.floor[: highest + 1] / math.sqrt(2.0))
        noisy = kept[: highest + 1] + noise[:, 0] + 1j * noise[:, 1]
        out = significant(noisy, orders.floor[: highest + 1], orders.floor.size)
        drawn[begin : begin + rows] = _range_of(np.where(out, noisy, 0.0), points)
    bias = float(drawn.mean()) - found
    uncertainty = 1.96 * float(drawn.std(ddof=1))
    name = "angular_transmission_error"
    return Figure(
        max(found - bias, 0.0), uncertainty, UNITS[name], DEFINITIONS[name], (0.0, 2.0 * math.pi), "rad",
        curve.turns, "turns",
    )  # fmt: skip


def _range_of(coefficient: NDArray[np.complex128], points: int) -> Array:
    """Return largest less smallest value, each at the top of a parabola through it and its neighbours."""
    curve = np.atleast_2d(synthesised(coefficient, points))
    rows = np.arange(curve.shape[0])

    def top(values: Array) -> Array:
        at = np.argmax(values, axis=-1)
        before, peak, after = (values[rows, (at + step) % points] for step in (-1, 0, 1))
        bend = np.minimum(before - 2.0 * peak + after, -1e-300)
        found: Array = peak - (before - after) ** 2 / (8.0 * bend)
        return found

    return top(curve) + top(-curve)


# --------------------------------------------------------------------------------------------------- starting torques


@dataclass(frozen=True)
class Start:
    """One start: the samples from the standstill until the crank has turned a degree, and the largest torque in it."""

    part: slice
    peak: int
    torque: float


def starts_of(crank: Array, torque: Array, driven: Array) -> list[Start]:
    """Return the starts of a recording: from a standstill with next to no torque until the crank has turned a degree.

    Counted are starts in which the torque drives: it and the motion that follows have one direction, and it has risen
    at least tenfold since the standstill began.

    Parameters
    ----------
    crank, torque, driven
        Crank angle (rad), torque (N·m) and angle (rad) of the shaft on which it is, arrays of shape (samples,).
    """
    found = []
    begin = 0
    while begin < crank.size:
        away = np.abs(crank[begin:] - crank[begin]) > _START
        moved = int(np.argmax(away)) if away.any() else 0
        if not moved:
            break
        start = begin + moved
        still = slice(begin, start)
        largest = float(np.abs(torque[still]).max()) if moved > 10 else 0.0
        if largest > 0.0:
            at_rest = abs(float(np.median(torque[begin : begin + max(3, moved // 20)])))
            peak = begin + int(np.argmax(np.abs(torque[still])))
            later = min(start + 10 * moved, crank.size - 1)
            onward, way = crank[later] - crank[begin], driven[later] - driven[begin]
            if at_rest < 0.1 * largest and abs(onward) > 5.0 * _START and torque[peak] * way > 0.0:
                found.append(Start(still, peak, largest))
        begin = start
        # Motion goes on until the crank stands within the degree again for longer than a few samples.
        while begin < crank.size:
            ahead = crank[begin : begin + 200]
            if np.ptp(ahead) <= 0.2 * _START and ahead.size > 10:
                break
            begin += max(1, ahead.size // 2)
    return found


def starting_torques(recording: BenchRecording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts by a torque on the input with the output unloaded, and why others are none.

    A start is without load where the torque on the output, through the ratio, is less than a tenth of that on the
    input.

    Parameters
    ----------
    recording
        The recording; without a torque on the input there are no such starts.
    ratio
        Signed ratio.
    """
    if recording.input_torque is None:
        return [], []
    starts = starts_of(recording.input_angle, recording.input_torque, recording.input_angle)
    if not starts:
        return [], [f"{recording.source}: the torque on the input starts the crank nowhere from a standstill."]
    if ratio is None:
        return [], [
            f"{recording.source}: starting_torque could not be given: no ratio says whether the output is loaded."
        ]
    free = [s for s in starts if float(np.abs(recording.torque[s.part]).max()) < _UNLOADED * abs(ratio) * s.torque]
    if len(free) == len(starts):
        return free, []
    return free, [f"{recording.source}: {len(starts) - len(free)} of {len(starts)} starts are under load; left out."]


def back_driving_torques(recording: BenchRecording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts by a torque on the output; where the input's is measured, those that it does not make.

    Parameters
    ----------
    recording, ratio
        As in `starting_torques`, whose rule holds the other way round.
    """
    starts = starts_of(recording.input_angle, recording.torque, recording.output_angle)
    given = recording.input_torque
    if given is None or ratio is None:
        return starts, []
    free = [s for s in starts if float(np.abs(given[s.part]).max()) * abs(ratio) < _UNLOADED * s.torque]
    return free, []


# ------------------------------------------------------------------------------------------- from recordings to figures


@dataclass(frozen=True)
class Surveyed:
    """What one recording gave, taken block by block: bounded in size however long the recording.

    Attributes
    ----------
    source, checksum
        Of the recording.
    samples, duration
        How many it had, and over which time, s.
    overview
        The recording; where it is long each sample is the mean of `averaged` consecutive ones.
    averaged
        How many samples one of the overview holds.
    curves
        Transmission error curves, one a direction; empty for loops and where no ratio is known.
    loops
        The loops, or None.
    notes
        What was left out and why.
    apart
        Half the 95 % interval, rad of the output, of what the two angles' clocks may make the transmission error run
        away over the whole recording.
    """

    source: str
    checksum: str
    samples: int
    duration: float
    overview: BenchRecording
    averaged: int
    curves: tuple[Curve, ...]
    loops: LoopData | None
    notes: tuple[str, ...]
    apart: float = 0.0


_OVERVIEW = 1 << 20


class _Overview:
    """Keeps the whole recording at a resolution that halves whenever it grows beyond twice `_OVERVIEW` samples."""

    names = ("time", "input_angle", "output_angle", "torque", *OPTIONAL)

    def __init__(self) -> None:
        self.averaged = 1
        self.samples = 0
        self._parts: list[list[Array]] = []
        self._rest: list[Array] | None = None
        self._held = 0

    def add(self, block: Block) -> None:
        self.names = tuple(n for n in self.names if getattr(block, n) is not None)
        columns = [getattr(block, n) for n in self.names]
        self.samples += block.time.size
        if self._rest is not None:
            columns = [np.concatenate([r, c]) for r, c in zip(self._rest, columns, strict=True)]
        whole = columns[0].size - columns[0].size % self.averaged
        self._rest = [c[whole:].copy() for c in columns]
        self._keep([self._mean(c[:whole], self.averaged) for c in columns])

    @staticmethod
    def _mean(column: Array, size: int) -> Array:
        found: Array = column.copy() if size == 1 else column.reshape(-1, size).mean(axis=1)
        return found

    def _keep(self, columns: list[Array]) -> None:
        if columns[0].size:
            self._parts.append(columns)
            self._held += columns[0].size
        if self._held > 2 * _OVERVIEW:
            joined = [np.concatenate(c) for c in zip(*self._parts, strict=True)]
            whole = joined[0].size - joined[0].size % 2
            assert self._rest is not None
            odd = [c[whole:] for c in joined]
            self._rest = [
                np.concatenate([np.repeat(one, self.averaged), rest]) for one, rest in zip(odd, self._rest, strict=True)
            ]
            self._parts = [[self._mean(c[:whole], 2) for c in joined]]
            self.averaged *= 2
            self._held = whole // 2

    def table(self) -> dict[str, Array]:
        """Return the columns; what is left of the last average is an average too."""
        if self._rest is not None and self._rest[0].size:
            self._parts.append([np.atleast_1d(c.mean()) for c in self._rest])
            self._rest = None
        columns = [np.concatenate(c) for c in zip(*self._parts, strict=True)]
        return dict(zip(self.names, columns, strict=True))


def survey(
    stream: BenchRecording | BenchStream,
    ratio: float | None,
    rated_torque: float | None,
    progress: Callable[[int], None] = lambda samples: None,
) -> Surveyed:
    """Take a recording once, block by block, and return what figures, report and comparison need of it.

    Parameters
    ----------
    stream
        The recording, in memory or in its file.
    ratio
        Signed ratio; None takes the recording's own. Without any the input must be locked.
    rated_torque
        T_N, N·m; None takes the largest torque of the recording, with a note.
    progress
        Told how many samples were taken so far.

    Raises
    ------
    edge.InputError
        If the file can't be read. Whatever of its content can't be used is a note.
    """
    ratio = stream.ratio if ratio is None else ratio
    overview = _Overview()
    folding = None if ratio is None else Folding(ratio, stream.source)
    for block in stream.blocks():
        overview.add(block)
        if folding is not None:
            folding.add(block)
        progress(overview.samples)
    table = overview.table()
    notes = list(stream.notes)
    shortened = BenchRecording(
        time=table["time"],
        input_angle=table["input_angle"],
        output_angle=table["output_angle"],
        torque=table["torque"],
        status=np.zeros(table["time"].size, np.uint8),
        common_zero=stream.common_zero,
        known_index=stream.known_index,
        ratio=ratio,
        source=stream.source,
        checksum=stream.checksum,
        notes=tuple(notes),
        temperature=table.get("temperature"),
        input_torque=table.get("input_torque"),
        alignment=stream.alignment,
        torque_alignment=stream.torque_alignment,
    )
    loops, said = _loops_of(shortened, ratio, rated_torque)
    notes += said
    curves: list[Curve] = []
    if loops is None and folding is not None:
        try:
            curves = folding.curves(stream)
            notes = list(curves[0].notes) + said + _lag_note(shortened, folding.ratio)
        except edge.InputError as problem:
            notes.append(str(problem))
    elif loops is None and np.ptp(shortened.input_angle) > 0.0:
        notes.append(f"{stream.source}: the input turns and no ratio is known; --pair or --ratio is needed.")
    duration = float(table["time"][-1] - table["time"][0])
    speed = float(np.abs(np.diff(table["output_angle"])).sum()) / duration if duration > 0.0 else 0.0
    return Surveyed(
        stream.source, shortened.checksum, overview.samples, duration, shortened, overview.averaged, tuple(curves),
        loops, tuple(notes), 2.0 * stream.alignment * speed,
    )  # fmt: skip


def _lag_note(recording: BenchRecording, ratio: float) -> list[str]:
    """Say where the output angle is late beyond its uncertainty, and by a tenth of an arcsecond at full speed."""
    found = lag_of(recording, ratio)
    if found is None:
        return []
    lag, uncertainty = found
    fastest = float(np.abs(np.gradient(recording.output_angle, recording.time)).max())
    arcsec = abs(lag) * fastest * edge.ARCSEC
    if abs(lag) < 2.0 * uncertainty or arcsec < 0.1:
        return []
    return [
        f"{recording.source}: where the speed changes the output angle is {'late' if lag > 0.0 else 'early'} by "
        f"{abs(lag) * 1e3:.3g} ± {uncertainty * 1e3:.1g} ms, {arcsec:.3g}″ at full speed; where that is not windup, "
        "give it as delay in the mapping."
    ]


LOCKED = math.radians(1.0)  # of the crank: what windup of a locked input's own fixture it may show


def _loops_of(
    recording: BenchRecording, ratio: float | None, rated_torque: float | None
) -> tuple[LoopData | None, list[str]]:
    """Return the loops of a recording, or None where it is a run at a load."""
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
        notes.append(f"{recording.source}: the input turns and no ratio is known; --pair or --ratio is needed.")
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


@dataclass(frozen=True)
class Figures:
    """The figures of one drive from all its recordings.

    Attributes
    ----------
    figures
        By name; those that the recordings don't tell are not there, and `notes` say why.
    surveyed
        What each recording gave.
    spectra
        Orders of each curve, in the order of the recordings and their curves; None where less than a turn is there.
    rated_torque, ratio
        T_N (N·m) and signed ratio, where known.
    notes
        What was left out and why, one sentence each.
    """

    figures: dict[str, Figure]
    surveyed: tuple[Surveyed, ...]
    spectra: tuple[Spectrum | None, ...]
    rated_torque: float | None
    ratio: float | None
    notes: tuple[str, ...]

    @property
    def curves(self) -> list[Curve]:
        """All curves."""
        return [c for s in self.surveyed for c in s.curves]


def figures_of(surveyed: Sequence[Surveyed], ratio: float | None, rated_torque: float | None) -> Figures:
    """Return the figures that recordings of one drive give together.

    Several recordings' loops count together; of transmission errors the largest is the figure, the others are its
    runs.

    Parameters
    ----------
    surveyed
        What each recording gave.
    ratio, rated_torque
        As given to `survey`.
    """
    notes = [n for s in surveyed for n in s.notes]
    figures: dict[str, Figure] = {}
    of_loops = []
    for one in surveyed:
        if one.loops is not None:
            found, said = loop_figures(one.loops)
            notes += said
            of_loops.append(found)
    for name in ("hysteresis_loss", "backlash", "lost_motion", "torsional_stiffness"):
        same = [f[name] for f in of_loops if name in f]
        if same:
            figures[name] = _pooled(same)
    spectra: list[Spectrum | None] = []
    ways: dict[str, dict[str, Figure]] = {"forward": {}, "backward": {}}
    for one in surveyed:
        for curve in one.curves:
            way = "forward" if curve.direction > 0 else "backward"
            try:
                orders = spectrum(curve)
            except edge.InputError as problem:
                notes.append(f"{problem} No angular transmission error is given for it.")
                spectra.append(None)
                continue
            spectra.append(orders)
            around, varies = abs(curve.torque), curve.torque_deviation
            if 0.1 * around < varies < around or varies > 0.1 * (rated_torque or math.inf):
                notes.append(
                    f"{curve.source}: the torque varies by {varies:.3g} N·m around {curve.torque:.4g} "
                    "N·m; the transmission error holds the windup that this makes."
                )
            figure = angular_transmission_error(curve, orders)
            # Clocks that run apart add their way over one turn, for every turn begins anew.
            uncertainty = math.hypot(figure.uncertainty, one.apart / max(curve.turns, 1.0))
            figure = dataclasses.replace(figure, uncertainty=uncertainty)
            ways[way][f"{one.source}, {curve.torque:.4g} N*m, {way}"] = figure
    parts = {way: max(runs.values(), key=lambda f: f.value) for way, runs in ways.items() if runs}
    if parts:
        largest = max(parts.values(), key=lambda f: f.value)
        runs = {name: f for way in ways.values() for name, f in way.items()}
        figures["angular_transmission_error"] = Figure(
            largest.value, largest.uncertainty, largest.unit, largest.definition, largest.interval,
            largest.interval_unit, largest.count, largest.counted, parts, runs,
        )  # fmt: skip
    started: dict[str, list[Start]] = {"starting_torque": [], "back_driving_torque": []}
    for one in surveyed:
        if one.loops is not None:
            continue
        for name, starts_by in (("starting_torque", starting_torques), ("back_driving_torque", back_driving_torques)):
            starts, said = starts_by(one.overview, ratio if ratio is not None else one.overview.ratio)
            started[name] += starts
            notes += said
            if one.averaged > 1 and starts:
                notes.append(
                    f"{one.source}: {name}: its torques are means of {one.averaged} samples of a long recording."
                )
    for name, starts in started.items():
        if starts:
            figures[name] = _mean_start(name, [s.torque for s in starts])
    return Figures(figures, tuple(surveyed), tuple(spectra), rated_torque, ratio, tuple(dict.fromkeys(notes)))


def _mean_start(name: str, torques: Sequence[float]) -> Figure:
    half = math.nan
    if len(torques) > 1:
        quantile = float(stdtrit(len(torques) - 1, 0.975))
        half = quantile * float(np.std(torques, ddof=1)) / math.sqrt(len(torques))
    return Figure(float(np.mean(torques)), half, UNITS[name], DEFINITIONS[name], None, "", len(torques), "starts")


def _pooled(figures: Sequence[Figure]) -> Figure:
    """Return the mean of one figure from several recordings, weighted by their loops."""
    if len(figures) == 1:
        return figures[0]
    weight = np.array([f.count for f in figures]) / sum(f.count for f in figures)
    values = np.array([f.value for f in figures])
    value = float(weight @ values)
    uncertainty = float(np.sqrt(np.sum((weight * [f.uncertainty for f in figures]) ** 2)))
    if len(figures) > 2:
        scatter = float(np.std(values, ddof=1)) / math.sqrt(len(figures))
        uncertainty = max(uncertainty, float(stdtrit(len(figures) - 1, 0.975)) * scatter)
    first = figures[0]
    parts = {
        side: _pooled([f.parts[side] for f in figures if side in f.parts])
        for side in {s: None for f in figures for s in f.parts}
    }
    return Figure(
        value, uncertainty, first.unit, first.definition, first.interval, first.interval_unit,
        sum(f.count for f in figures), first.counted, parts,
    )  # fmt: skip


_FIELD_UNITS = {
    "rad": (10800.0 / math.pi, "arcmin"), "N*m/rad": (math.pi / 10800.0, "N·m/arcmin"), "N*m": (1.0, "N·m"),
}  # fmt: skip


def in_field_units(figure: Figure, like: Figure | None = None) -> tuple[str, str, str]:
    """Return value, uncertainty and unit as people read them: arcmin, or arcsec where it is less than one.

    The value has as many digits as its uncertainty tells, one more than that is significant. `like` is a figure whose
    unit is taken, so that several can stand beside each other.
    """
    factor, unit = _FIELD_UNITS[figure.unit]
    if unit == "arcmin" and abs((like or figure).value) * factor < 1.0:
        factor, unit = factor * 60.0, "arcsec"
    value, uncertainty = figure.value * factor, figure.uncertainty * factor
    if not math.isfinite(uncertainty):
        return f"{value:.4g}", "not known", unit
    digits = 6 if uncertainty <= 0.0 else min(max(1 - math.floor(math.log10(uncertainty)), 0), 6)
    return f"{value:.{digits}f}", f"{uncertainty:.{digits}f}", unit


def figure_json(figure: Figure) -> dict[str, Any]:
    """Return one figure as the content of a `cycloid-figures/1` file (SI)."""
    found: dict[str, Any] = {
        "value": figure.value,
        "uncertainty": figure.uncertainty,
        "unit": figure.unit,
        "definition": figure.definition,
        "interval": figure.interval,
        "interval_unit": figure.interval_unit,
        figure.counted: figure.count,
    }
    found.update({side: figure_json(part) for side, part in figure.parts.items()})
    if figure.runs:
        found["runs"] = {name: figure_json(run) for name, run in figure.runs.items()}
    return found


def figures_json(found: Figures) -> dict[str, Any]:
    """Return all figures as the content of a `cycloid-figures/1` file: each under its name, and whence they are."""
    return {
        "format": FORMAT,
        **{name: figure_json(f) for name, f in found.figures.items()},
        "rated_torque": found.rated_torque,
        "ratio": found.ratio,
        "data": {s.source: s.checksum for s in found.surveyed},
        "notes": list(found.notes),
    }
