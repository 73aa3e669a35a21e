"""Play, stiffness, friction and efficiency from loops whose friction grows with load.

Dry friction adds to the spring's torque while the loop moves outwards and subtracts on the way back. At one windup the
torque is M + F on the way up and M - F on the way down, so the spring's torque is M = (T_up + T_down)/2 and the
friction F = (T_up - T_down)/2, whatever the friction depends on. Standard figures of a loop (`hysteresis`) take
branches at the same torque, which holds only for a constant friction.

T_up(θ) is the torque at which a pass leaves a windup: of a windup that sticks, the breakaway torque. Torque and windup
are averaged over short stretches of time first, so the noise may be in either of them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from scipy.special import fdtri, stdtrit

from fitting.figures.figure import Figure
from fitting.figures.hysteresis import LoopData, fit_line, sample_noise

Array = NDArray[np.float64]

STRETCHES = 400  # most stretches of time that a pass is averaged over
GRID = 1601  # windups: a stiff drive with much play has few of them under load
MARGIN = 0.02  # of the common range of the passes that is left out at both ends, where they turn
LINE = (0.20, 0.70)  # of the largest spring torque: lines for play and stiffness
SEGMENTS = (0.10, 0.30, 0.50, 0.70, 0.90)  # of the largest spring torque: limits of the stiffness by segments
FRICTION = 0.70  # of the largest spring torque, up to which the friction is a line over it
VIRGIN = 0.3  # of its peak: from there on the first branch is that of a steady loop (docs/theory/measurement.md)
FEWEST = 20  # samples of a pass
RESIDUAL_DEGREES = 10.0  # with which a variance from residuals counts: their correlation is known roughly
ENOUGH = 3.0  # degrees of freedom from which the scatter of the passes counts alone
_ABOVE_NOISE = 4.0  # times its noise that the windup moves from one stretch to the next
_MOVES = 0.05  # of a stretch's mean motion: less is sticking
_LEVELS = np.linspace(0.3, 0.8, 26)  # of the smaller peak: torques at which passes tell a drift

DEFINITIONS = {
    "play": "distance at zero torque of the lines through the spring's torque over windup, from 20 to 70 % of its "
    "largest value on each side",
    "torsional_stiffness": "slope of these lines, mean of both sides: without friction",
    "friction_torque": "friction without load, F_0 of the line F = F_0 + mu |M| over the spring's torque, up to 70 % "
    "of its largest value; breakaway where the windup sticks",
    "friction_per_load": "growth of the friction with load, mu of this line",
    "efficiency_driving": "spring's torque over the torque that drives, M/(M + F), at the stated torque",
    "efficiency_back_driving": "torque that comes back over the spring's torque, 1 - F/M, at the stated torque; 0 if "
    "self-locking",
}
UNITS = {
    "play": "rad",
    "torsional_stiffness": "N*m/rad",
    "friction_torque": "N*m",
    "friction_per_load": "1",
    "efficiency_driving": "1",
    "efficiency_back_driving": "1",
}


@dataclass(frozen=True)
class Pass:
    """A pass from one peak of the torque to the next: where it leaves each windup.

    Attributes
    ----------
    direction
        +1 towards positive torque, -1 back.
    windup, torque, time
        Windups at which it moves on (rad), ascending, the torque there (N·m) and the time (s), shape (stretches,).
    step
        Change of the torque from one stretch of time to the next, N·m.
    """

    direction: int
    windup: Array
    torque: Array
    time: Array
    step: float


@dataclass(frozen=True)
class MidCurve:
    """Spring torque and friction over the windup.

    Attributes
    ----------
    windup, spring, friction
        Shape (windups,): rad, without drift; M and F, N·m.
    """

    windup: Array
    spring: Array
    friction: Array


def turning_points(torque: Array, data: LoopData) -> list[int]:
    """Return the indices of the peaks of alternate sign, in the order of time."""
    found: list[int] = []
    for lobe in data.lobes:
        peak = lobe.loading.stop
        if found and np.sign(torque[found[-1]]) == lobe.sign:
            found[-1] = max(found[-1], peak, key=lambda at: abs(torque[at]))
        else:
            found.append(peak)
    return found


def pass_of(time: Array, torque: Array, windup: Array, direction: int) -> Pass:
    """Return a pass from its samples, shape (n,), s, N·m and rad."""
    # Stretches in which the windup moves by several times its noise: hardly any goes back.
    motion = abs(float(windup[-1] - windup[0])) / windup.size
    quiet = math.ceil((_ABOVE_NOISE * sample_noise(windup) / motion) ** (2.0 / 3.0)) if motion > 0.0 else 1
    size = min(max(1, torque.size // STRETCHES, quiet), torque.size // FEWEST)
    whole = torque.size // size * size
    t, load, angle = (v[:whole].reshape(-1, size).mean(axis=1) for v in (time, torque, windup))
    along = isotonic_regression(direction * angle).x
    moves = np.diff(along, append=math.inf) > _MOVES * (along[-1] - along[0]) / along.size
    # A windup that stuck is left between its last stretch and the next.
    stuck = moves & ~np.concatenate([[True], moves[:-1]])
    load[:-1] = np.where(stuck[:-1], 0.5 * (load[:-1] + load[1:]), load[:-1])
    order = np.s_[::direction]
    step = abs(float(load[-1] - load[0])) / load.size
    return Pass(direction, direction * along[moves][order], load[moves][order], t[moves][order], step)


def passes_of(data: LoopData) -> list[Pass]:
    """Return the passes from peak to peak, the first branch where friction slips, and the last one's return."""
    torque, peaks = data.torque, turning_points(data.torque, data)
    if not peaks:
        return []
    slips = np.abs(torque[: peaks[0]]) < VIRGIN * abs(torque[peaks[0]])
    begin = int(np.flatnonzero(slips)[-1]) + 1 if slips.any() else 0
    ends = [begin, *peaks, data.lobes[-1].unloading.stop]
    signs = [np.sign(torque[at]) for at in peaks]
    ways = [int(sign) for sign in [*signs, -signs[-1]]]
    return [
        pass_of(data.time[a:b], torque[a:b], data.windup[a:b], way)
        for a, b, way in zip(ends[:-1], ends[1:], ways, strict=True)
        if b - a >= FEWEST
    ]


def drift_rate(passes: Sequence[Pass]) -> float:
    """Return the rate at which passes of the same direction drift apart, rad/s; 0 without two of them."""
    top = min(max(abs(float(p.torque[0])), abs(float(p.torque[-1]))) for p in passes)
    moved = spread = 0.0
    for direction in (1, -1):
        same = [p for p in passes if p.direction == direction]
        if len(same) < 2:
            continue
        levels = np.concatenate([-top * _LEVELS[::-1], top * _LEVELS])
        windup, time = np.empty((2, len(same), levels.size))
        for k, one in enumerate(same):
            rising = np.maximum.accumulate(one.torque)
            windup[k] = np.interp(levels, rising, one.windup, left=np.nan, right=np.nan)
            time[k] = np.interp(levels, rising, one.time)
        seen = np.isfinite(windup).all(axis=0)
        away = time[:, seen] - time[:, seen].mean(axis=0)
        moved += float((away * (windup[:, seen] - windup[:, seen].mean(axis=0))).sum())
        spread += float((away * away).sum())
    return moved / spread if spread > 0.0 else 0.0


def mid_curve(passes: Sequence[Pass], drift: float, middle: float) -> MidCurve | None:
    """Return the mid curve of passes; None without windups that passes of both directions cross.

    Parameters
    ----------
    passes
        The passes.
    drift, middle
        Rate of the drift, rad/s, and the time at which it is zero, s.
    """
    placed = {1: list[tuple[Array, Array]](), -1: list[tuple[Array, Array]]()}
    for one in passes:
        windup = np.maximum.accumulate(one.windup - drift * (one.time - middle))
        placed[one.direction].append((windup, one.torque))
    if not all(placed.values()):
        return None
    low = max(min(w[0] for w, _ in curves) for curves in placed.values())
    high = min(max(w[-1] for w, _ in curves) for curves in placed.values())
    windup = np.linspace(low + MARGIN * (high - low), high - MARGIN * (high - low), GRID)
    means = []
    for curves in placed.values():
        each = np.array([np.interp(windup, w, torque, left=np.nan, right=np.nan) for w, torque in curves])
        count = np.isfinite(each).sum(axis=0)
        means.append(np.nansum(each, axis=0) / np.where(count > 0, count, np.nan))
    seen = np.isfinite(means[0] + means[1])
    if not low < high or not seen.any():
        return None
    up, down = means[0][seen], means[1][seen]
    return MidCurve(windup[seen], 0.5 * (up + down), 0.5 * (up - down))


_Values = dict[str, float]


def _side(curve: MidCurve, sign: int, share: tuple[float, float], largest: float) -> tuple[Array, Array]:
    """Return windup and spring torque of one side between two shares of the largest spring torque."""
    inside = (sign * curve.spring > share[0] * largest) & (sign * curve.spring < share[1] * largest)
    return curve.windup[inside], curve.spring[inside]


def values_of(curve: MidCurve, largest: float, at_torque: float) -> _Values | None:
    """Return the figures of a mid curve by name, SI, and the windup where each side's line ends; None without lines.

    Parameters
    ----------
    curve
        The mid curve.
    largest
        Largest spring torque, N·m, to whose shares the intervals refer.
    at_torque
        Torque of the efficiencies, N·m.
    """
    values = _Values()
    for sign in (1, -1):
        line = fit_line(*_side(curve, sign, LINE, largest))
        if line is None or line.slope <= 0.0:
            return None
        values[f"end{sign:+d}"], values[f"slope{sign:+d}"] = line.centre - line.value / line.slope, line.slope
        for number, part in enumerate(itertools.pairwise(SEGMENTS), 1):
            piece = fit_line(*_side(curve, sign, part, largest))
            if piece is not None and piece.slope > 0.0:
                values[f"K{number}{sign:+d}"] = piece.slope
    low = np.abs(curve.spring) <= FRICTION * largest
    line = fit_line(np.abs(curve.spring[low]), curve.friction[low])
    if line is None:
        return None
    friction, _ = line.at(at_torque)
    return values | {
        "play": values["end+1"] - values["end-1"],
        "torsional_stiffness": 0.5 * (values["slope+1"] + values["slope-1"]),
        "friction_torque": line.at(0.0)[0],
        "friction_per_load": line.slope,
        "efficiency_driving": at_torque / (at_torque + friction),
        "efficiency_back_driving": 1.0 - friction / at_torque,
    }


def residual_variances(
    passes: Sequence[Pass],
    drift: float,
    middle: float,
    curve: MidCurve,
    largest: float,
    values: _Values,
    at_torque: float,
) -> _Values:
    """Return the variances of `values_of` that the residuals of lines through the passes' own points cause.

    A line through the points of each side and direction, T = a + b θ, has the slope (1 ± mu) K: spring torque and
    friction are half the sum and half the difference of two lines.
    """
    variances: dict[str, list[float]] = {}
    for sign in (1, -1):
        windup, _ = _side(curve, sign, LINE, largest)
        lines = []
        for direction in (1, -1):
            some = [p for p in passes if p.direction == direction]
            x = np.concatenate([p.windup - drift * (p.time - middle) for p in some])
            y = np.concatenate([p.torque for p in some])
            inside = (x >= windup.min()) & (x <= windup.max())
            line = fit_line(x[inside], y[inside])
            if line is None:
                return {}
            lines.append(line)
        end, slope = values[f"end{sign:+d}"], values[f"slope{sign:+d}"]
        growth = values["friction_per_load"]
        at_zero = 0.25 * sum(line.at(end)[1] for line in lines)
        loaded = 0.25 * sum(line.at(end + sign * at_torque / slope)[1] for line in lines)
        slopes = [line.slope_variance for line in lines]
        found = {
            "play": at_zero / slope**2,
            "torsional_stiffness": 0.25 * sum(slopes),
            "friction_torque": at_zero,
            "friction_per_load": ((1.0 - growth) ** 2 * slopes[0] + (1.0 + growth) ** 2 * slopes[1]) / (2 * slope) ** 2,
            "efficiency_driving": loaded * (values["efficiency_driving"] ** 2 / at_torque) ** 2,
            "efficiency_back_driving": loaded / at_torque**2,
        }
        for name, variance in found.items():
            variances.setdefault(name, []).append(variance)
    return {name: sum(v) if name == "play" else 0.25 * sum(v) for name, v in variances.items()}


def _once(passes: Sequence[Pass], middle: float, largest: float, at_torque: float) -> _Values | None:
    """Return `values_of` the mid curve of some passes; None if they have none."""
    curve = mid_curve(passes, drift_rate(passes), middle)
    return None if curve is None else values_of(curve, largest, at_torque)


def _scatter(passes: Sequence[Pass], of: Callable[[Sequence[Pass]], _Values | None]) -> dict[str, tuple[float, float]]:
    """Return the variance of each value by leaving out one pass at a time, and its degrees of freedom.

    Passes of either direction are draws of their own (jackknife). A direction with a single pass counts with the
    scatter of the other; without a second pass in any, nothing is known.
    """
    each: list[dict[str, tuple[float, int]]] = []
    for direction in (1, -1):
        count = sum(one.direction == direction for one in passes)
        if count < 2:
            each.append({})
            continue
        left = [of([p for p in passes if p is not one]) for one in passes if one.direction == direction]
        if any(values is None for values in left):
            return {}
        names = set.intersection(*(set(values or ()) for values in left))
        each.append(
            {
                name: ((count - 1) ** 2 / count * float(np.var([v[name] for v in left if v], ddof=1)), count)
                for name in names
            }
        )
    found = {}
    for name in set(each[0]) | set(each[1]):
        parts = [(variance, count - 1.0) for variance, count in (one[name] for one in each if name in one)]
        if len(parts) == 1:
            variance, count = next(one[name] for one in each if name in one)
            parts.append((variance * count, count - 1.0))
        total = sum(variance for variance, _ in parts)
        spread = sum(variance**2 / degrees for variance, degrees in parts)
        found[name] = total, (total**2 / spread if spread > 0.0 else math.inf)
    return found


@dataclass(frozen=True)
class FrictionFree:
    """Figures without friction, and the mid curve that they are from.

    Attributes
    ----------
    figures
        By the names of `DEFINITIONS`, SI; an efficiency's interval is the spring torque that it holds for.
    curve
        The mid curve.
    largest
        Largest spring torque that both sides reach, N·m.
    lines
        The lines of play and stiffness, negative side first: windup at zero torque, rad, and slope, N·m/rad.
    """

    figures: dict[str, Figure]
    curve: MidCurve
    largest: float
    lines: tuple[tuple[float, float], tuple[float, float]]


def friction_free(data: LoopData) -> FrictionFree | None:
    """Return the figures without friction of a recording's loops; None without passes in both directions.

    None too where the friction without load exceeds the spring's largest torque: such loops are too small.

    Several loops together. The uncertainty is from the scatter of the passes, with Student's t, or from the residuals
    of the lines if that is larger. A drift of the windup, linear in time, is removed.

    Parameters
    ----------
    data
        The loops, as measured.
    """
    passes = passes_of(data)
    if len({one.direction for one in passes}) < 2:
        return None
    middle, drift = float(np.mean([one.time.mean() for one in passes])), drift_rate(passes)
    curve = mid_curve(passes, drift, middle)
    if curve is None:
        return None
    largest = float(min(curve.spring.max(), -curve.spring.min()))
    if not largest > 0.0:
        return None
    at_torque = min(data.rated_torque, largest)
    values = values_of(curve, largest, at_torque)
    if values is None or values["friction_torque"] > largest:  # the loop hardly leaves the play
        return None
    scatter = _scatter(passes, lambda some: _once(some, middle, largest, at_torque))
    residual = residual_variances(passes, drift, middle, curve, largest, values, at_torque)
    # A windup is left at some torque between two stretches of time.
    stiff, friction = values["torsional_stiffness"], float(np.mean([one.step for one in passes])) ** 2 / 12.0
    resolved = {
        "play": 2.0 * friction / stiff**2,
        "friction_torque": friction,
        "friction_per_load": friction / (FRICTION * largest) ** 2,
        "efficiency_back_driving": friction / at_torque**2,
        "efficiency_driving": friction * (values["efficiency_driving"] ** 2 / at_torque) ** 2,
    }

    def figure(of: str, value: float, interval: tuple[float, float], keys: Sequence[str]) -> Figure:
        known = [combined(scatter.get(key), residual.get(of if key != of else key)) for key in keys]
        variance = sum(v for v, _ in known) / len(known) ** 2
        degrees = min(free for _, free in known)
        uncertainty = math.hypot(
            math.sqrt(variance) * float(stdtrit(degrees, 0.975)) if degrees > 0.0 else math.nan,
            1.96 * math.sqrt(resolved.get(of, 0.0)),
        )
        return Figure(
            value, uncertainty, UNITS[of], DEFINITIONS[of], interval, "N*m", len(passes), "passes", degrees=degrees
        )

    lines = (LINE[0] * largest, LINE[1] * largest)
    intervals = {
        "play": lines,
        "torsional_stiffness": lines,
        "friction_torque": (0.0, FRICTION * largest),
        "friction_per_load": (0.0, FRICTION * largest),
        "efficiency_driving": (at_torque, at_torque),
        "efficiency_back_driving": (at_torque, at_torque),
    }
    figures = {name: figure(name, max(values[name], 0.0), intervals[name], [name]) for name in DEFINITIONS}
    segments = {}
    for number, share in enumerate(itertools.pairwise(SEGMENTS), 1):
        keys = [key for key in (f"K{number}+1", f"K{number}-1") if key in values]
        if keys:
            mean = float(np.mean([values[key] for key in keys]))
            limits = (share[0] * largest, share[1] * largest)
            segments[f"K{number}"] = figure("torsional_stiffness", mean, limits, keys)
    name = "torsional_stiffness"
    figures[name] = dataclasses.replace(figures[name], segments=segments)
    sides = [(values[f"end{sign:+d}"], values[f"slope{sign:+d}"]) for sign in (-1, 1)]
    return FrictionFree(figures, curve, largest, (sides[0], sides[1]))


def combined(scatter: tuple[float, float] | None, residual: float | None) -> tuple[float, float]:
    """Return a variance and its degrees of freedom from the scatter of passes and from the residuals of lines.

    The scatter of enough passes counts alone: a real curve is no line, and its shape repeats. With fewer, the
    residuals' variance is a second estimate, with `RESIDUAL_DEGREES`, unless the scatter exceeds it significantly.
    """
    if scatter is None or residual is None:
        known = scatter or (residual, RESIDUAL_DEGREES)
        return (math.nan, 0.0) if known[0] is None else (known[0], known[1])
    variance, degrees = scatter
    if degrees >= ENOUGH or variance > residual * float(fdtri(degrees, RESIDUAL_DEGREES, 0.95)):
        return scatter
    total = degrees + RESIDUAL_DEGREES
    return (degrees * variance + RESIDUAL_DEGREES * residual) / total, total
