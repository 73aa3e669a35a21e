"""Derivatives of the transmission error of a drive on its bearings by all displacements.

Where r(q, p) = 0 is the balance, dx/dp = -λ·∂r/∂p with λ the row of (∂r/∂q)⁻¹ for the carrier's rotation: one linear
solution per crank angle, for any number of errors (docs/theory/supports.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import crank_motion, gap_gradient, projection, stiffness_along
from cycloid_fmu.contact.sensitivity import add_by_pins_and_flanks
from cycloid_fmu.supports.balance import Load, assemble, solve_transposed
from cycloid_fmu.supports.bearing import CENTRING, by_clearance
from cycloid_fmu.supports.elastic import Pull, closing_of, pull_of, pull_ports, write_by_bodies
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Displacement,
    Reaction,
    Work,
    add_turning,
    change,
    derivatives,
    displacement,
    eccentric,
    reaction,
    turn_levers,
    turning_motion,
)
from cycloid_fmu.supports.ports import has_ports

PARAMETERS = (
    "outer_x",
    "outer_y",
    "inner_x",
    "inner_y",
    "throw",
    "phase",
    "play",
    "stiffness",
    "clearance",
)
"""What a joint's derivatives are by: fields of `joints.JOINT`, m or rad, then its law's logarithm of stiffness and
diametral clearance, m."""
OUTER, INNER = PARAMETERS.index("outer_x"), PARAMETERS.index("inner_x")
THROW, PHASE, PLAY, STIFFNESS, CLEARANCE = range(4, 9)


class Derivatives(NamedTuple):
    """Derivatives of the transmission error x; the first axis is the crank angle.

    Attributes
    ----------
    by_displacement
        By the displacements of pins and flanks, in the order of `surfaces.structured.displacement_layout`; those of
        joints are left zero. Shape (angles, displacements), rad/m or rad/rad.
    by_joint
        By the `PARAMETERS` of each joint, shape (angles, joints, parameters), rad/m, rad/rad and, for stiffness, rad.
    by_angle, by_torque
        By crank angle (dimensionless) and torque (rad/(N·m)), shape (angles,).
    by_body
        By the logarithm of the stiffness of each of `transmission.BODIES`, shape (angles, bodies), rad.
    """

    by_displacement: Array
    by_joint: Array
    by_angle: Array
    by_torque: Array
    by_body: Array


@compiled
def add_mesh(problem: Problem, assembly: Assembly, crank_angle: float, contacts: Rows, work: Work, out: Array) -> float:
    """Subtract λ·∂r/∂p for the displacements of pins and flanks, λ in `work.step`; return λ·∂r/∂θ."""
    row, turning = work.step, 0.0
    for number in range(contacts.shape[0]):
        contact_ = contacts[number]
        if contact_.force <= 0.0:
            continue
        local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, number)
        along, first = gap_gradient(local), FIRST_DISC + 3 * local.disc
        weights = (row[first], row[first + 1], row[first + 2])
        closing = projection(weights, along.gap)
        by_force = closing_of(assembly.elastic, work.ports, number, contact_.stiffness, closing)
        by_position = stiffness_along(contact_, local, along, weights, by_force)
        by_normal = contact_.force * projection(weights, along.slide)
        add_by_pins_and_flanks(problem, contact_, local, by_position, by_force, by_normal, out)
        turning += projection((*crank_motion(problem, local), -1.0 / problem.teeth), by_position)
    return turning


@compiled
def _by_position(
    d: Displacement, acting: Reaction, pull: Pull, ux: float, uy: float, lx: float, ly: float, turn: float
) -> float:
    """λ·∂r for a motion of the outer body's place along u; `turn` is λ for its rotation."""
    if pull.through_bodies:
        return pull.x * ux + pull.y * uy + (pull.force_y * ux - pull.force_x * uy) * turn
    gx, gy = change(d, acting, ux, uy)
    return gx * lx + gy * ly + acting.force * (d.normal_y * ux - d.normal_x * uy) * turn


@compiled
def _turn_pulled(assembly: Assembly, joint: np.record, d: Displacement, pull: Pull, work: Work) -> float:
    """λ·∂r/∂θ of a joint through elastic bodies but for its levers, and add these to `work.residual`."""
    vx, vy = turning_motion(assembly, joint, d, work)
    turn_levers(assembly, joint, d, pull.force_x, pull.force_y, work.residual)
    return float(pull.x * vx + pull.y * vy)


@compiled
def add_joints(assembly: Assembly, crank_angle: float, work: Work, by_joint: Array) -> float:
    """Subtract λ·∂r/∂p for the parameters of each joint, λ in `work.step`.

    Return λ·∂r/∂θ, without what is added to `work.residual`.
    """
    row, index, by, turning = work.step, work.indices, work.by, 0.0
    for number in range(assembly.joints.size):
        joint, out = assembly.joints[number], by_joint[number]
        d = displacement(assembly, joint, work)
        acting = reaction(assembly, joint, d, 0.0)
        if acting.stiffness == 0.0 and not has_ports(assembly.elastic, number):
            continue
        unknowns = derivatives(assembly, joint, d, work)
        lx = ly = 0.0  # λ·∂d/∂q
        for i in range(unknowns):
            lx += by[0, i] * row[index[i]]
            ly += by[1, i] * row[index[i]]
        pull = pull_of(assembly, assembly.elastic, work.ports, crank_angle, number, d, lx, ly)
        if pull.through_bodies:
            turning += _turn_pulled(assembly, joint, d, pull, work)
            if joint.reach == 0.0:
                # The axes turn in which bearings press.
                rate = assembly.bodies[int(joint.outer)].rate
                turning += rate * (pull.force_x * ly - pull.force_y * lx)
                turning += rate * d.length * (pull.x * d.normal_y - pull.y * d.normal_x)
        else:
            add_turning(assembly, joint, d, acting, work, unknowns, work.residual)
        outer, seat = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.seat)].rotation
        turned, carried = row[outer] if outer >= 0 else 0.0, row[seat] if seat >= 0 else 0.0
        c, s = work.axes[int(joint.outer), 0], work.axes[int(joint.outer), 1]
        out[OUTER] -= _by_position(d, acting, pull, c, s, lx, ly, turned)
        out[OUTER + 1] -= _by_position(d, acting, pull, -s, c, lx, ly, turned)
        c, s = work.axes[int(joint.seat), 0], work.axes[int(joint.seat), 1]
        out[INNER] += _by_position(d, acting, pull, c, s, lx, ly, carried)
        out[INNER + 1] += _by_position(d, acting, pull, -s, c, lx, ly, carried)
        if joint.eccentricity > 0.0:
            ex, ey = eccentric(joint, work)
            out[THROW] += _by_position(d, acting, pull, ex, ey, lx, ly, 0.0) / math.hypot(ex, ey)
            out[PHASE] += _by_position(d, acting, pull, -ey, ex, lx, ly, 0.0)
        if pull.through_bodies:
            out[PLAY] += pull.play
            out[STIFFNESS] -= pull.stiffness
            out[CLEARANCE] += pull.clearance
        elif d.length > 0.0:
            along = d.normal_x * lx + d.normal_y * ly
            out[PLAY] += acting.stiffness * along
            out[STIFFNESS] -= acting.force * along
            out[CLEARANCE] -= by_clearance(assembly.laws[joint.law], d.excess - joint.play) * along
    return turning


@compiled
def sweep_supported_sensitivities(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torques: Array,
    coordinates: Array,
    results: Derivatives,
    work: Work,
) -> bool:
    """Write the derivatives of the transmission error at given solutions; return False if one is singular.

    Parameters
    ----------
    crank_angles, torques, places
        Crank angles (rad) and the torque at each (N·m), shape (angles,); the solutions, shape (angles, unknowns).
    results
        Zeros; overwritten.
    """
    contacts = contact.contact_rows(problem)
    for i in range(crank_angles.size):
        for k in range(work.coordinates.size):
            work.coordinates[k] = coordinates[i, k]
        work.moved[0] = math.inf
        assemble(problem, assembly, crank_angles[i], Load(torques[i], 0.0, 0.0, CENTRING), contacts, work, None)
        for k in range(work.step.size):
            work.step[k] = 1.0 if k == 0 else 0.0
        if not solve_transposed(problem, assembly, work, work.step, 0.0):
            return False
        results.by_torque[i] = work.step[0]  # of λ, which is now in `step`
        turning = -pull_ports(assembly.elastic, work.ports, work.step)
        write_by_bodies(assembly.elastic, work.ports, results.by_body[i])
        turning += add_mesh(problem, assembly, crank_angles[i], contacts, work, results.by_displacement[i])
        for k in range(work.residual.size):
            work.residual[k] = 0.0
        turning += add_joints(assembly, crank_angles[i], work, results.by_joint[i])
        for k in range(work.residual.size):
            turning += work.step[k] * work.residual[k]
        results.by_angle[i] = -turning
    return True
