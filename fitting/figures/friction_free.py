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
from scipy.special import fdtri, stdtrit

from fitting.figures.figure import Definition, Figure
from fitting.transmission_error.loops import LoopData, fit_line
from fitting.transmission_error.mid_curve import (
    FRICTION,
    LINE,
    SEGMENTS,
    MidCurve,
    Pass,
    Values,
    drift_rate,
    evaluated,
    mid_curve,
    side_of,
    values_of,
)

Array = NDArray[np.float64]
RESIDUAL_DEGREES = 10.0  # with which a variance from residuals counts: their correlation is known roughly
ENOUGH = 3.0  # degrees of freedom from which the scatter of the passes counts alone

DEFINITIONS = {
    "play": Definition(
        "rad",
        "distance at zero torque of the lines through the spring's torque over windup, from 20 to 70 % of its "
        "largest value on each side",
    ),
    "torsional_stiffness": Definition("N*m/rad", "slope of these lines, mean of both sides: without friction"),
    "friction_torque": Definition(
        "N*m",
        "friction without load, F_0 of the line F = F_0 + mu |M| over the spring's torque, up to 70 % "
        "of its largest value; breakaway where the windup sticks",
    ),
    "friction_per_load": Definition("1", "growth of the friction with load, mu of this line"),
    "efficiency_driving": Definition(
        "1", "spring's torque over the torque that drives, M/(M + F), at the stated torque"
    ),
    "efficiency_back_driving": Definition(
        "1", "torque that comes back over the spring's torque, 1 - F/M, at the stated torque; 0 if self-locking"
    ),
}


def residual_variances(
    passes: Sequence[Pass],
    drift: float,
    middle: float,
    curve: MidCurve,
    largest: float,
    values: Values,
    at_torque: float,
) -> Values:
    """Return the variances of `values_of` that the residuals of lines through the passes' own points cause.

    A line through the points of each side and direction, T = a + b θ, has the slope (1 ± mu) K: spring torque and
    friction are half the sum and half the difference of two lines.
    """
    variances: dict[str, list[float]] = {}
    for sign in (1, -1):
        windup, _ = side_of(curve, sign, LINE, largest)
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
        of_side = {
            "play": at_zero / slope**2,
            "torsional_stiffness": 0.25 * sum(slopes),
            "friction_torque": at_zero,
            "friction_per_load": ((1.0 - growth) ** 2 * slopes[0] + (1.0 + growth) ** 2 * slopes[1]) / (2 * slope) ** 2,
            "efficiency_driving": loaded * (values["efficiency_driving"] ** 2 / at_torque) ** 2,
            "efficiency_back_driving": loaded / at_torque**2,
        }
        for name, variance in of_side.items():
            variances.setdefault(name, []).append(variance)
    return {name: sum(v) if name == "play" else 0.25 * sum(v) for name, v in variances.items()}


def _once(passes: Sequence[Pass], middle: float, largest: float, at_torque: float) -> Values | None:
    """Return `values_of` the mid curve of some passes; None if they have none."""
    curve = mid_curve(passes, drift_rate(passes), middle)
    return None if curve is None else values_of(curve, largest, at_torque)


def _scatter(passes: Sequence[Pass], of: Callable[[Sequence[Pass]], Values | None]) -> dict[str, tuple[float, float]]:
    """Return the variance of each value by leaving out one pass at a time, and its degrees of freedom.

    Passes of either direction are draws of their own (jackknife). A direction with a single pass counts with the
    scatter of the other; without a second pass in any, nothing is known.
    """
    each: list[dict[str, tuple[float, int]]] = []
    for direction in (1, -1):
        count = sum(loop_pass.direction == direction for loop_pass in passes)
        if count < 2:
            each.append({})
            continue
        without = [
            of([p for p in passes if p is not loop_pass]) for loop_pass in passes if loop_pass.direction == direction
        ]
        if any(values is None for values in without):
            return {}
        names = set.intersection(*(set(values or ()) for values in without))
        each.append(
            {
                name: ((count - 1) ** 2 / count * float(np.var([v[name] for v in without if v], ddof=1)), count)
                for name in names
            }
        )
    total_variances = {}
    for name in set(each[0]) | set(each[1]):
        known = [of_direction[name] for of_direction in each if name in of_direction]
        parts = [(variance, count - 1.0) for variance, count in known]
        if len(known) == 1:
            variance, count = known[0]
            parts.append((variance * count, count - 1.0))
        total = sum(variance for variance, _ in parts)
        spread = sum(variance**2 / degrees for variance, degrees in parts)
        total_variances[name] = total, (total**2 / spread if spread > 0.0 else math.inf)
    return total_variances


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
    evaluation = evaluated(data)
    if evaluation is None:
        return None
    passes, drift, middle, curve, largest, at_torque, values = evaluation
    scatter = _scatter(passes, lambda some: _once(some, middle, largest, at_torque))
    residual = residual_variances(passes, drift, middle, curve, largest, values, at_torque)
    # A windup is left at some torque between two stretches of time.
    stiff, friction = (
        values["torsional_stiffness"],
        float(np.mean([loop_pass.step for loop_pass in passes])) ** 2 / 12.0,
    )
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
        return Figure(value, uncertainty, *DEFINITIONS[of], interval, "N*m", len(passes), "passes", degrees=degrees)

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
