"""The spring torque and the friction of loops over the windup: the mean of both directions, and half their difference.

Dry friction adds to the spring's torque while the loop moves outwards and subtracts on the way back. At one windup the
torque is M + F on the way up and M - F on the way down, so the spring's torque is M = (T_up + T_down)/2 and the
friction F = (T_up - T_down)/2, whatever the friction depends on.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import NDArray

from fitting.transmission_error.loops import LoopData, fit_line, sample_noise

Array = NDArray[np.float64]

STRETCHES = 400  # most stretches of time that a pass is averaged over
GRID = 1601  # windups: a stiff drive with much play has few of them under load
MARGIN = 0.02  # of the common range of the passes that is left out at both ends, where they turn
LINE = (0.20, 0.70)  # of the largest spring torque: lines for play and stiffness
SEGMENTS = (0.10, 0.30, 0.50, 0.70, 0.90)  # of the largest spring torque: limits of the stiffness by segments
FRICTION = 0.70  # of the largest spring torque, up to which the friction is a line over it
VIRGIN = 0.3  # of its peak: from there on the first branch is that of a steady loop (docs/theory/measurement.md)
FEWEST = 20  # samples of a pass
_ABOVE_NOISE = 4.0  # times its noise that the windup moves from one stretch to the next
_MOVES = 0.05  # of a stretch's mean motion: less is sticking
_LEVELS = np.linspace(0.3, 0.8, 26)  # of the smaller peak: torques at which passes tell a drift


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
    peaks: list[int] = []
    for lobe in data.lobes:
        peak = lobe.loading.stop
        if peaks and np.sign(torque[peaks[-1]]) == lobe.sign:
            peaks[-1] = max(peaks[-1], peak, key=lambda at: abs(torque[at]))
        else:
            peaks.append(peak)
    return peaks


def pass_of(time: Array, torque: Array, windup: Array, direction: int) -> Pass:
    """Return a pass from its samples, shape (n,), s, N·m and rad."""
    # Stretches in which the windup moves by several times its noise: hardly any goes back.
    motion = abs(float(windup[-1] - windup[0])) / windup.size
    quiet = math.ceil((_ABOVE_NOISE * sample_noise(windup) / motion) ** (2.0 / 3.0)) if motion > 0.0 else 1
    size = min(max(1, torque.size // STRETCHES, quiet), torque.size // FEWEST)
    whole = torque.size // size * size
    t, load, angle = (v[:whole].reshape(-1, size).mean(axis=1) for v in (time, torque, windup))
    along = scipy.optimize.isotonic_regression(direction * angle).x
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
        pass_of(data.time[a:b], torque[a:b], data.windup[a:b], direction)
        for a, b, direction in zip(ends[:-1], ends[1:], ways, strict=True)
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
        for k, loop_pass in enumerate(same):
            rising = np.maximum.accumulate(loop_pass.torque)
            windup[k] = np.interp(levels, rising, loop_pass.windup, left=np.nan, right=np.nan)
            time[k] = np.interp(levels, rising, loop_pass.time)
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
    for loop_pass in passes:
        windup = np.maximum.accumulate(loop_pass.windup - drift * (loop_pass.time - middle))
        placed[loop_pass.direction].append((windup, loop_pass.torque))
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


Values = dict[str, float]


def side_of(curve: MidCurve, sign: int, share: tuple[float, float], largest: float) -> tuple[Array, Array]:
    """Return windup and spring torque of one side between two shares of the largest spring torque."""
    inside = (sign * curve.spring > share[0] * largest) & (sign * curve.spring < share[1] * largest)
    return curve.windup[inside], curve.spring[inside]


def values_of(curve: MidCurve, largest: float, at_torque: float) -> Values | None:
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
    values = Values()
    for sign in (1, -1):
        line = fit_line(*side_of(curve, sign, LINE, largest))
        if line is None or line.slope <= 0.0:
            return None
        values[f"end{sign:+d}"], values[f"slope{sign:+d}"] = line.centre - line.value / line.slope, line.slope
        for number, part in enumerate(itertools.pairwise(SEGMENTS), 1):
            piece = fit_line(*side_of(curve, sign, part, largest))
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


class Evaluation(NamedTuple):
    """A recording's loops evaluated without friction.

    Attributes
    ----------
    passes
        The passes, with the rate of their drift, rad/s, and the time at which it is zero, s.
    curve
        The mid curve, and the largest spring torque that both its sides reach, N·m.
    at_torque, values
        Torque of the efficiencies, N·m, and `values_of` the curve.
    """

    passes: list[Pass]
    drift: float
    middle: float
    curve: MidCurve
    largest: float
    at_torque: float
    values: Values


def evaluated(data: LoopData) -> Evaluation | None:
    """Return a recording's loops evaluated without friction; None without passes in both directions.

    None too where the friction without load exceeds the spring's largest torque: such loops are too small.
    """
    passes = passes_of(data)
    if len({loop_pass.direction for loop_pass in passes}) < 2:
        return None
    middle, drift = float(np.mean([loop_pass.time.mean() for loop_pass in passes])), drift_rate(passes)
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
    return Evaluation(passes, drift, middle, curve, largest, at_torque, values)
