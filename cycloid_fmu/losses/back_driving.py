"""Torque on the output that starts to turn a drive backwards from rest, at every crank angle.

At the first angle the torque is searched from the largest one downwards. It changes little from one angle to the next,
so that Newton's method follows it there: the balance and the torque at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.parts import solve_in_parts
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.losses.rubbing import Rubbing, Slope, assemble_rubbing, settle_rubbing
from cycloid_fmu.losses.solver import PART, input_held, rubbing_of, solve
from cycloid_fmu.losses.sweeps import slope_of
from cycloid_fmu.supports.balance import HELD, Load, hold, solve_linear
from cycloid_fmu.supports.bearing import CENTRING
from cycloid_fmu.supports.joints import Assembly, Work, work_of
from cycloid_fmu.supports.sweeps import follow_neighbours
from cycloid_fmu.supports.transmission import assembly_of, problem_of, with_own_discs

_FINER = 1.8  # ratio of the loads between which the torque is bracketed
_LOADS = 16
_STEPS = 60
_CORRECTIONS = 8
_CLOSE = 1e-7  # of the largest torque: a last step of Newton's method, which leaves far less
_JAMMED = -1.0  # N·m: a drive that jams gives off no torque


class Resting(NamedTuple):
    """A drive at rest that a torque on the output would turn backwards, with work arrays.

    Attributes
    ----------
    rubbing
        Its friction, backwards and at rest.
    held
        Torque that holds the cranks, N·m.
    largest
        Largest torque on the output, N·m.
    """

    problem: Problem
    assembly: Assembly
    rubbing: Rubbing
    held: float
    largest: float
    work: Work
    slope: Slope
    loss: Array


@compiled
def _given(drive: Resting, crank_angle: float, torque: float, contacts: Rows) -> float:
    """Torque that the cranks give off beyond what holds them, N·m, from `work.coordinates` on; `_JAMMED` if none."""
    more, pull = (drive.rubbing, drive.slope, drive.loss), Load(torque, 0.0, 0.0, CENTRING)
    problem, assembly, work = drive.problem, drive.assembly, drive.work
    if settle_rubbing(problem, assembly, crank_angle, pull, contacts, work, more, False) == 0:
        work.moved[0] = math.inf
        return _JAMMED
    crank_torque = assemble_rubbing(problem, assembly, crank_angle, pull, contacts, work, more)
    return float(-drive.rubbing.direction * crank_torque - drive.held)


@compiled
def _follow(drive: Resting, crank_angle: float, torque: float, contacts: Rows) -> float:
    """Torque near another at which nothing more is given off, N·m, by Newton's method; NaN where it fails."""
    work = drive.work
    step = work.step
    for _ in range(_CORRECTIONS):
        given = _given(drive, crank_angle, torque, contacts)
        hold(drive.problem, drive.assembly, work, HELD)
        for k in range(step.size):
            step[k] = 1.0 if k == 0 else 0.0
        if given == _JAMMED or not solve_linear(work.matrix, step):
            return math.nan
        growth = 0.0
        for k in range(step.size):
            growth -= drive.rubbing.direction * drive.slope.crank_torque[k] * step[k]
        if not growth > 0.0:
            return math.nan
        torque -= given / growth
        for k in range(step.size):
            work.coordinates[k] -= step[k] * given / growth
        if not 0.0 < torque <= drive.largest:
            return math.nan
        if abs(given) < _CLOSE * drive.largest * growth:
            return torque
    return math.nan


@compiled
def _search(drive: Resting, crank_angle: float, contacts: Rows) -> float:
    """Outermost torque at which what is given off passes zero, N·m; 0 if it is above zero at all loads, NaN below."""
    outer, inner, at_inner = drive.largest, 0.0, math.nan
    at_outer = _given(drive, crank_angle, outer, contacts)
    for number in range(1, _LOADS + 1):
        torque = drive.largest * _FINER**-number
        given = _given(drive, crank_angle, torque, contacts)
        if (given > 0.0) != (at_outer > 0.0):
            inner, at_inner = torque, given
            break
        outer, at_outer = torque, given
    if inner == 0.0:
        return 0.0 if at_outer > 0.0 else math.nan
    torque = outer
    for _ in range(_STEPS):
        # Illinois: a bisection where the straight line would not halve the bracket from both sides.
        before, torque = torque, inner - at_inner * (outer - inner) / (at_outer - at_inner)
        given = _given(drive, crank_angle, torque, contacts)
        if (given > 0.0) == (at_outer > 0.0):
            at_inner *= 0.5
            outer, at_outer = torque, given
        else:
            at_outer *= 0.5
            inner, at_inner = torque, given
        if given == 0.0 or abs(torque - before) < _CLOSE * torque:
            break
    return torque


@compiled
def sweep_back_driving(
    drive: Resting,
    crank_angles: Array,
    turns: NDArray[np.bool_],
    coordinates: Array,
    torques: Array,
    solved: Array,
    start: Array,
) -> None:
    """Write the torque at every crank angle as `back_driving` returns it.

    Parameters
    ----------
    crank_angles
        rad, shape (angles,).
    turns, coordinates
        Whether the largest torque turns the drive, shape (angles,), and the unknowns there, shape (angles, unknowns).
    torques
        Overwritten, shape (angles,), N·m.
    solved
        Overwritten: the unknowns and, last, the torque, shape (angles, unknowns + 1).
    start
        Work array, shape (unknowns + 1,).
    """
    contacts, q = contact.contact_rows(drive.problem), drive.work.coordinates
    n = q.size
    for i in range(crank_angles.size):
        torques[i] = math.nan
        if turns[i] and i > 0 and torques[i - 1] > 0.0 and follow_neighbours(crank_angles, solved, i, start):
            for k in range(n):
                q[k] = start[k]
            torques[i] = _follow(drive, crank_angles[i], start[n], contacts)
        if math.isnan(torques[i]):
            for k in range(n):
                q[k] = coordinates[i, k]
            drive.work.moved[0] = math.inf
            torques[i] = _search(drive, crank_angles[i], contacts)
        for k in range(n):
            solved[i, k] = start[k] = q[k]
        solved[i, n] = start[n] = torques[i]


def back_driving(drive: DriveValue, largest: float, crank_angle: Array, *, workers: int = 1) -> Array:
    """Return the torque on the output that starts to turn the drive backwards at every angle, shape (angles,), N·m.

    It is the outermost one up to `largest` (N·m) at which the torque of the input passes zero, with friction at rest;
    0 where the drive turns at any torque, NaN where it turns at none. Where `largest` turns the drive, the torque is
    followed from one angle to the next.

    Parameters
    ----------
    drive
        A drive with [supports] and [losses].
    largest
        N·m, above 0.
    crank_angle
        rad, shape (angles,).
    workers
        Threads.

    Raises
    ------
    edge.InputError
        As `solver.solve`.
    """
    angles, largest = np.array(crank_angle, dtype=float), float(largest)
    at_largest = solve(drive, np.array([largest]), angles, -1, 0.0, workers=workers)
    rubbing, held = rubbing_of(drive, -1, 0.0), input_held(drive)
    turns = -at_largest.direction * at_largest.crank_torque[0] > held
    coordinates, torques = np.nan_to_num(at_largest.coordinates[0]), np.empty(angles.size)
    assembly, mesh = assembly_of(drive), problem_of(drive, drive.slices)

    def part(start: int, last: int) -> None:
        unknowns, these = coordinates.shape[1], slice(start, last)
        slope, loss = slope_of(unknowns), np.zeros(len(PARTS))
        resting = Resting(with_own_discs(mesh), assembly, rubbing, held, largest, work_of(assembly), slope, loss)
        solved = np.empty((last - start + 1, unknowns + 1))
        of_these = (turns[these], coordinates[these], torques[these])
        sweep_back_driving(resting, angles[these], *of_these, solved[:-1], solved[-1])

    solve_in_parts(part, angles.size, PART, workers, lambda _: None)
    return torques
