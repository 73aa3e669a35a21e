"""Sweeps of a drive on bearings over crank angles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.load_sharing import write_contact_lines
from cycloid_fmu.supports.balance import NEIGHBOUR, Load, settle, torsional_stiffness
from cycloid_fmu.supports.bearing import CENTRING
from cycloid_fmu.supports.elastic import joint_force, share_compliance, torque_of_bodies
from cycloid_fmu.supports.joints import FIRST_DISC, Assembly, Work, displacement, eccentric


class Solutions(NamedTuple):
    """Results of a sweep, SI; the first axis is the crank angle. `force` is of each joint, shape (angles, joints).

    `compliance` has the shares of parts, shape (angles, parts), with no parts if all bodies are rigid.
    """

    steps: NDArray[np.int64]
    coordinates: Array
    stiffness: Array
    crank_torque: Array
    contact_count: NDArray[np.int64]
    max_contact_pressure: Array
    pin_force: Array
    pin_pressure: Array
    force: Array
    compliance: Array


@compiled
def _forces(problem: Problem, assembly: Assembly, work: Work, force: Array) -> float:
    """Write the force of every joint (N) at the solved place; return the crank torque (N·m)."""
    crank_torque = torque_of_bodies(problem, assembly, assembly.elastic, work, work.ports)
    for number in range(assembly.joints.size):
        joint = assembly.joints[number]
        d = displacement(assembly, joint, work)
        fx, fy = joint_force(assembly, number, d, work, work.ports)
        force[number] = math.hypot(fx, fy)
        ex, ey = eccentric(joint, work)
        crank_torque -= ex * fy - ey * fx
    return crank_torque


@compiled
def follow_neighbours(crank_angles: Array, coordinates: Array, i: int, q: Array) -> bool:
    """Move the last unknowns in line with those of two crank angles before; return whether they are near enough."""
    step = abs(crank_angles[i] - crank_angles[i - 1]) if i > 0 else math.inf
    if i > 1 and step < 1.5 * abs(crank_angles[i - 1] - crank_angles[i - 2]) < NEIGHBOUR:
        share = (crank_angles[i] - crank_angles[i - 1]) / (crank_angles[i - 1] - crank_angles[i - 2])
        for k in range(q.size):
            q[k] += share * (q[k] - coordinates[i - 2, k])
    return step < NEIGHBOUR


@compiled
def write_solution(
    problem: Problem, assembly: Assembly, contacts: Rows, work: Work, results: Solutions, i: int
) -> None:
    """Write the balance at a crank angle: unknowns, stiffness, forces of the joints and the load sharing."""
    for k in range(work.coordinates.size):
        results.coordinates[i, k] = work.coordinates[k]
    results.stiffness[i] = torsional_stiffness(problem, assembly, work)
    share_compliance(assembly, assembly.elastic, work.ports, work, work.step, results.compliance[i])
    results.crank_torque[i] = _forces(problem, assembly, work, results.force[i])
    count, pressure = contact.load_sharing(problem, contacts, results.pin_force[i], results.pin_pressure[i])
    results.contact_count[i], results.max_contact_pressure[i] = count, pressure


@compiled
def sweep_supported(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torques: Array,
    results: Solutions,
    work: Work,
    lines: contact.ContactLines,
    near: bool,
) -> None:
    """Solve crank angles, each at its torque and starting from its neighbour, and write contact lines on request.

    With `near` they start from `results.coordinates`, which holds solutions of nearly the same drive.
    """
    contacts = contact.contact_rows(problem)
    q = work.coordinates
    for i in range(crank_angles.size):
        crank_angle = crank_angles[i]
        if near:
            for k in range(q.size):
                q[k] = results.coordinates[i, k]
            work.moved[0], follows = math.inf, True
        else:
            follows = follow_neighbours(crank_angles, results.coordinates, i, q)
        pull = Load(torques[i], 0.0, 0.0, CENTRING)
        results.steps[i] = settle(problem, assembly, crank_angle, pull, contacts, work, None, not follows)
        write_solution(problem, assembly, contacts, work, results, i)
        if lines.slice_force.size > 0:
            write_contact_lines(problem, lines, 0, i, crank_angle, q[0], contacts)


@compiled
def sweep_supported_contacts(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torque: float,
    steps: NDArray[np.int64],
    coordinates: Array,
    work: Work,
    table: Rows,
) -> None:
    """Solve crank angles at one torque and keep every contact row.

    Parameters
    ----------
    crank_angles, torque
        Crank angles (rad), shape (angles,); torque (N·m).
    steps, coordinates, table
        Overwritten: steps taken, 0 without a balance, shape (angles,); the unknowns, shape (angles, unknowns);
        `contact_rows` of each angle, shape (angles, rows).
    """
    contacts = contact.contact_rows(problem)
    for i in range(crank_angles.size):
        follows = follow_neighbours(crank_angles, coordinates, i, work.coordinates)
        pull = Load(torque, 0.0, 0.0, CENTRING)
        steps[i] = settle(problem, assembly, crank_angles[i], pull, contacts, work, None, not follows)
        coordinates[i] = work.coordinates
        table[i] = contacts


@compiled
def sweep_interference(
    problem: Problem, crank_angles: Array, coordinates: Array, pressed: Array, interference: Array
) -> None:
    """Write how far flanks and pins overlap that no rotation of the output frees, at solved positions of the bodies.

    Parameters
    ----------
    crank_angles, place
        Crank angles, shape (angles,), rad; the unknowns without a torque, shape (angles, unknowns).
    pressed
        Largest pin force there, shape (angles,), N: where it is 0, nothing overlaps.
    interference
        Zeros, overwritten, shape (angles,), m.
    """
    contacts = contact.contact_rows(problem)
    for i in range(crank_angles.size):
        if pressed[i] > 0.0:
            x = coordinates[i, 0]
            for disc in range(problem.shift_x.size):
                first = FIRST_DISC + 3 * disc
                problem.shift_x[disc], problem.shift_y[disc] = coordinates[i, first], coordinates[i, first + 1]
                problem.turn[disc] = coordinates[i, first + 2] - x
            _, _, overlap = contact.play(problem, crank_angles[i], x, contacts, True)
            # A pin first takes up the clearance of its seat.
            interference[i] = max(overlap - problem.seat_gap, 0.0)
