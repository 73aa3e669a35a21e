"""Sweeps of a drive on bearings over crank angles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, compiled, spliced
from cycloid_fmu.contact.load_sharing import write_contact_lines
from cycloid_fmu.supports.assembly import Assembly
from cycloid_fmu.supports.balance import (
    FIRST_DISC,
    NEIGHBOUR,
    Load,
    Work,
    crank_displacement,
    eccentric,
    roller_displacement,
    settle,
    torsional_stiffness,
)
from cycloid_fmu.supports.bearing import CENTRING, push


class Found(NamedTuple):
    """Results of a sweep, SI; the first axis is the crank angle."""

    steps: NDArray[np.int64]
    place: Array
    stiffness: Array
    crank_torque: Array
    contact_count: NDArray[np.int64]
    max_contact_pressure: Array
    pin_force: Array
    pin_pressure: Array
    turning_arm: Array
    crank_bearing: Array
    main_bearing: Array
    output_roller: Array


@spliced
def _forces(problem: Problem, assembly: Assembly, theta: float, q: Array, found: Found, i: int) -> float:
    """Write the force of every bearing (N); return the crank torque (N·m)."""
    discs = problem.shift_x.size
    carrier = -theta / problem.teeth
    crank_torque = 0.0
    first = FIRST_DISC + 3 * discs
    for disc in range(discs):
        crank = theta + problem.crank_phase[disc]
        for k in range(assembly.throw.shape[1]):
            if assembly.cranks:
                dx, dy, _, _, _, _ = crank_displacement(assembly, carrier, theta, problem.crank_phase[disc], q, disc, k)
            else:
                at = FIRST_DISC + 3 * disc
                ex, ey = eccentric(assembly, crank, disc, 0)
                dx, dy = q[at] - q[first] + ex, q[at + 1] - q[first + 1] + ey
            r = math.hypot(dx, dy)
            force, _ = push(assembly.turning_arm, r)
            found.turning_arm[i, disc, k] = force
            if force > 0.0:
                throw, angle = assembly.eccentricity + assembly.throw[disc, k], crank + assembly.phase[disc, k]
                crank_torque -= throw * force * (math.cos(angle) * dy - math.sin(angle) * dx) / r
        if not assembly.cranks:
            for k in range(assembly.place_x.size):
                _, _, _, _, _, _, beyond = roller_displacement(assembly, carrier, crank, q, disc, k)
                beyond -= assembly.hole_play[disc, k]
                found.output_roller[i, disc, k] = assembly.output_roller * max(beyond, 0.0)
    for k in range(found.crank_bearing.shape[1]):
        sx, sy = q[first + 2 * k], q[first + 2 * k + 1]
        if not assembly.cranks:
            sx, sy = sx - assembly.seat_x, sy - assembly.seat_y
        found.crank_bearing[i, k], _ = push(assembly.crank_shaft, math.hypot(sx, sy))
    found.main_bearing[i], _ = push(assembly.main, math.hypot(q[1] - assembly.seat_x, q[2] - assembly.seat_y))
    return crank_torque


@compiled
def sweep_supported(
    problem: Problem,
    assembly: Assembly,
    thetas: Array,
    torques: Array,
    found: Found,
    work: Work,
    lines: contact.ContactLines,
) -> None:
    """Solve crank angles, each at its torque and starting from its neighbour, and write contact lines on request."""
    contacts = contact.contact_rows(problem)
    q = work.place
    for i in range(thetas.size):
        theta = thetas[i]
        step = abs(theta - thetas[i - 1]) if i > 0 else math.inf
        if i > 1 and step < 1.5 * abs(thetas[i - 1] - thetas[i - 2]) < NEIGHBOUR:
            share = (theta - thetas[i - 1]) / (thetas[i - 1] - thetas[i - 2])
            for k in range(q.size):
                q[k] += share * (q[k] - found.place[i - 2, k])
        found.steps[i] = settle(
            problem, assembly, theta, Load(torques[i], 0.0, 0.0), CENTRING, q, contacts, work, not step < NEIGHBOUR
        )
        for k in range(q.size):
            found.place[i, k] = q[k]
        found.stiffness[i] = torsional_stiffness(problem, assembly, work)
        found.crank_torque[i] = _forces(problem, assembly, theta, q, found, i)
        count, pressure = contact.load_sharing(problem, contacts, found.pin_force[i], found.pin_pressure[i])
        found.contact_count[i], found.max_contact_pressure[i] = count, pressure
        if lines.slice_force.size > 0:
            write_contact_lines(problem, lines, 0, i, theta, q[0], contacts)


@compiled
def sweep_interference(problem: Problem, thetas: Array, place: Array, pressed: Array, interference: Array) -> None:
    """Write how far flanks and pins overlap that no rotation of the output frees, at solved positions of the bodies.

    Parameters
    ----------
    thetas, place
        Crank angles, shape (angles,), rad; the unknowns without a torque, shape (angles, unknowns).
    pressed
        Largest pin force there, shape (angles,), N: where it is 0, nothing overlaps.
    interference
        Zeros, overwritten, shape (angles,), m.
    """
    contacts = contact.contact_rows(problem)
    for i in range(thetas.size):
        if pressed[i] > 0.0:
            x = place[i, 0]
            for disc in range(problem.shift_x.size):
                at = FIRST_DISC + 3 * disc
                problem.shift_x[disc], problem.shift_y[disc] = place[i, at], place[i, at + 1]
                problem.turn[disc] = place[i, at + 2] - x
            _, _, overlap = contact.play(problem, thetas[i], x, contacts, True)
            # A pin first takes up the clearance of its seat.
            interference[i] = max(overlap - problem.seat_gap, 0.0)
