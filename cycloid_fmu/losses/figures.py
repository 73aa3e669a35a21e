"""Figures of a drive with friction: efficiency and losses, starting, running and back-driving torque, hysteresis."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.losses.back_driving import back_driving
from cycloid_fmu.losses.solver import Rubbed, losses_of, solve

Array = NDArray[np.float64]
JAMMED = 0.01
"""Efficiency of a driven drive below which it jams: the friction's moment on the discs reaches the normal forces'."""


@dataclass(frozen=True)
class LoadCase:
    """Losses at one torque in one direction, means over the crank angles.

    Attributes
    ----------
    torque, direction
        Of the environment on the output, N·m; of the crank, 1 counter-clockwise or -1.
    efficiency
        Power that leaves over power that enters; below 0 where the drive locks itself and the input must help it; NaN
        without a load or where the drive jams.
    jams
        Whether there is no balance at some angle, or a driving efficiency below `JAMMED`.
    loss
        Of each of `PARTS`, J for each radian of the crank.
    heat
        At the crank's speed, W.
    """

    torque: float
    direction: int
    efficiency: float
    jams: bool
    loss: Mapping[str, float]
    heat: float

    @property
    def mode(self) -> str:
        """Whether power leaves at the output ("driving"), enters there ("back-driving"), or neither ("no load")."""
        work = self.direction * self.torque
        return "driving" if work > 0.0 else "back-driving" if work < 0.0 else "no load"

    @property
    def self_locking(self) -> bool:
        """Whether the output can't turn the input: a back-driving efficiency not above 0."""
        return self.efficiency <= 0.0

    def numbers(self) -> dict[str, Any]:
        """Return it for scripts, SI."""
        return {**vars(self), "mode": self.mode, "self_locking": self.self_locking}


@dataclass(frozen=True)
class LossFigures:
    """Losses of a drive at one speed of the crank, SI.

    Attributes
    ----------
    crank_speed
        rad/s.
    sweeps
        By direction, 1 and -1.
    cases
        By torque and direction.
    no_load_running_torque
        Torque of the input without a load at this speed, mean over the angles, N·m.
    starting
        Torque of the input that starts the drive from rest, at every angle, N·m, by load (N·m): 0 and each |torque|.
    back_driving
        Torque on the output that starts to turn the drive backwards, at every angle, N·m, shape (angles,): 0 where any
        does, NaN where none up to `searched_to` does.
    searched_to
        The rated torque; without one the largest |torque|, N·m.
    crank_angle
        rad.
    ends
        The same with all friction from `friction_values.VALUES` at the low and at the high end of its range; empty
        where numbers are stated.
    """

    crank_speed: float
    sweeps: Mapping[int, Rubbed]
    cases: tuple[LoadCase, ...]
    no_load_running_torque: float
    starting: Mapping[float, Array]
    back_driving: Array
    searched_to: float
    crank_angle: Array = field(repr=False)
    ends: tuple[LossFigures, ...] = ()

    @property
    def starting_torque(self) -> float:
        """Largest starting torque of the input without a load, N·m."""
        return _largest(self.starting[0.0])

    @property
    def back_driving_torque(self) -> float:
        """Smallest torque on the output that turns the drive at every angle, N·m; NaN where none does."""
        return _largest(self.back_driving)

    @property
    def friction_hysteresis(self) -> list[dict[str, float]]:
        """Mean difference of the output's angle between the two directions, rad, at each torque."""
        forward, backward = (self.sweeps[s].motion.transmission_error.mean(axis=1) for s in (1, -1))
        torques = self.sweeps[1].motion.torque
        return [{"torque": float(t), "value": float(v)} for t, v in zip(torques, forward - backward, strict=True)]

    def numbers(self) -> dict[str, Any]:
        """Return everything for scripts, SI."""
        ranges = [[end.efficiency for end in case] for case in zip(*(end.cases for end in self.ends), strict=True)]
        results = [case.numbers() for case in self.cases]
        for result, ends in zip(results, ranges, strict=False):
            result["efficiency_range"] = ends
        names = ("no_load_running_torque", "starting_torque", "back_driving_torque")
        loaded = [{"torque": load, "value": _largest(each)} for load, each in self.starting.items() if load > 0.0]
        return {
            "crank_speed": self.crank_speed,
            "results": results,
            "no_load_running_torque": self.no_load_running_torque,
            "starting_torque": self.starting_torque,
            "starting_torque_loaded": loaded,
            "back_driving_torque": self.back_driving_torque,
            "back_driving_searched_to": self.searched_to,
            "friction_hysteresis": self.friction_hysteresis,
            **({"range": {name: [getattr(end, name) for end in self.ends] for name in names}} if self.ends else {}),
        }


def _largest(values: Array) -> float:
    """Return the largest value; NaN if one is."""
    return float(values.max())


def load_cases(drive: DriveValue, rubbed: Rubbed) -> list[LoadCase]:
    """Return efficiency and losses at every torque of a sweep."""
    cases = []
    for k, torque in enumerate(rubbed.motion.torque):
        work_in, work_out = float(rubbed.input_work[k]), -rubbed.direction * float(torque) / drive.pair.gear_teeth
        loss = {name: float(value) for name, value in zip(PARTS, rubbed.loss[k].mean(axis=0), strict=True)}
        efficiency, jams = math.nan, math.isnan(work_in)
        if work_out < 0.0:
            # An input that helps the driven output has no efficiency either.
            efficiency = -work_out / work_in if work_in > 0.0 else math.nan
            jams = jams or 0.0 <= efficiency < JAMMED
        elif work_out > 0.0:
            efficiency = -work_in / work_out
        heat = rubbed.crank_speed * sum(loss.values())
        cases.append(LoadCase(float(torque), rubbed.direction, math.nan if jams else efficiency, jams, loss, heat))
    return cases


def starting(drive: DriveValue, loads: Sequence[float], crank_angle: Array, **options: Any) -> dict[float, Array]:
    """Return the torque of the input (N·m) that starts a drive from rest at every angle, by load (N·m, not below 0)."""
    at_rest = solve(drive, np.array(loads), crank_angle, 1, 0.0, **options)
    return dict(zip(loads, np.abs(at_rest.input_torque), strict=True))


class Breakaway(NamedTuple):
    """Friction at the output from rest, as a loop with a locked shaft shows it."""

    without_load: float  # N·m
    per_load: float  # of the spring's torque, 1; infinite where the drive jams


def breakaway(drive: DriveValue, load: float, crank_angle: Array, **options: Any) -> Breakaway:
    """Return the friction of a loop between no load and one (N·m), mean over the crank angles (rad).

    One way the input drives against the output's torque, the other way it holds it, both from rest: friction is half of
    the difference of the two torques, the spring's torque half of their sum. Which shaft is locked makes no difference.
    """
    up, down = (
        abs(drive.ratio) * solve(drive, np.array([0.0, load]), crank_angle, s, 0.0, **options).input_torque.mean(axis=1)
        for s in (1, -1)
    )
    friction, spring = 0.5 * np.abs(up - down), 0.5 * np.abs(up + down)
    growth = float((friction[1] - friction[0]) / (spring[1] - spring[0]))
    return Breakaway(float(friction[0]), math.inf if math.isnan(growth) else growth)


def figures(
    drive: DriveValue,
    torque: Sequence[float],
    crank_angle: Array,
    crank_speed: float,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> LossFigures:
    """Return losses, efficiency and the torques that a drive needs to start, to run and to be turned backwards.

    Parameters
    ----------
    drive
        A drive with [supports] and [losses].
    torque
        Torques of the environment on the output, N·m.
    crank_angle
        rad; at least one mesh pitch of them for means.
    crank_speed
        rad/s, not below 0.
    workers, progress
        Threads; function called with the number of crank angles (times loads and directions) that were just finished.

    Raises
    ------
    edge.InputError
        As `solver.solve`.
    """
    loads, angles = np.array(torque, dtype=float), np.asarray(crank_angle, dtype=float)
    sweeps = {s: solve(drive, loads, angles, s, crank_speed, workers=workers, progress=progress) for s in (1, -1)}
    idle = solve(drive, np.zeros(1), angles, 1, crank_speed, workers=workers)
    rated, largest = drive.pair.rated_torque, float(np.abs(loads).max(initial=0.0))
    searched = largest if rated is None else rated
    ends = tuple(figures(end, torque, crank_angle, crank_speed, workers=workers) for end in at_ends(drive))
    at_rest = starting(drive, sorted({0.0, *np.abs(loads).tolist()}), angles, workers=workers)
    by_direction = [load_cases(drive, sweep) for sweep in sweeps.values()]
    return LossFigures(
        crank_speed,
        sweeps,
        tuple(case for cases in zip(*by_direction, strict=True) for case in cases),
        float(np.abs(idle.input_torque.mean())),
        at_rest,
        back_driving(drive, searched, angles, workers=workers),
        searched,
        angles,
        ends,
    )


def at_ends(drive: DriveValue) -> list[DriveValue]:
    """Return the drive with all friction from the table at its low and at its high end; none without such friction."""
    losses = losses_of(drive)
    pairs = [drive.pair.replace(losses=losses.at_end(high)) for high in (False, True)] if losses.from_table else []
    return [DriveValue(pair, drive.surface, drive.first_stage) for pair in pairs]


@dataclass(frozen=True)
class EfficiencyMap:
    """Efficiency over torque and speed, SI.

    Attributes
    ----------
    torque, crank_speed
        Shapes (torques,) and (speeds,): N·m on the output, rad/s.
    driving, back_driving
        Shape (speeds, torques); NaN where the drive jams.
    """

    torque: Array
    crank_speed: Array
    driving: Array
    back_driving: Array


def efficiency_map(
    drive: DriveValue, torque: float, crank_speed: float, crank_angle: Array, workers: int = 1
) -> EfficiencyMap:
    """Return the efficiency at 12 torques up to one, N·m, and at 10 speeds up to one, rad/s."""
    torques: Array = torque * np.linspace(1.0 / 12.0, 1.0, 12)
    speeds: Array = crank_speed * np.linspace(0.1, 1.0, 10)
    by_direction = [
        [
            [case.efficiency for case in load_cases(drive, solve(drive, torques, crank_angle, s, w, workers=workers))]
            for w in speeds
        ]
        for s in (1, -1)
    ]
    return EfficiencyMap(torques, speeds, *np.array(by_direction))
