"""Derivatives of the transmission error of a drive with friction by displacements, bearings and coefficients.

To those of the normal forces (`supports.sensitivity`) friction adds its own: its amplitude G grows with the force, and
its direction turns with the contact. λ is the row of (∂r/∂q)⁻¹ for the carrier's rotation, as there. Which of two
contacts slides, and the speed of its sliding, are held.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import crank_motion, force_fall, gap_gradient, projection
from cycloid_fmu.contact.sensitivity import PIN_GENERATING, add_by_pins_and_flanks
from cycloid_fmu.losses.rubbing import (
    Acting,
    Rubbing,
    Slope,
    assemble_at,
    flank_friction,
    joint_friction,
    joint_speed,
    rubbing_stiffness,
    write_sliding,
)
from cycloid_fmu.losses.sweeps import add_flank_coefficients, add_joint_coefficients
from cycloid_fmu.supports.balance import Load, solve_transposed
from cycloid_fmu.supports.bearing import CENTRING, by_clearance
from cycloid_fmu.supports.elastic import pressing, pull_ports, write_by_bodies
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Displacement,
    Work,
    derivatives,
    displacement,
    eccentric,
    turning_motion,
)
from cycloid_fmu.supports.ports import has_ports
from cycloid_fmu.supports.sensitivity import (
    CLEARANCE,
    INNER,
    OUTER,
    PHASE,
    PLAY,
    STIFFNESS,
    THROW,
    Derivatives,
    add_joints,
    add_mesh,
)


@compiled(inline=True)
def of_ports(f: Acting) -> Acting:
    """Friction of a force through elastic bodies: `pull_ports` has what changes with this force."""
    return Acting(f.amplitude, 0.0, f.speed, f.sign, f.turns)


@compiled
def _add_flanks(
    problem: Problem, assembly: Assembly, crank_angle: float, contacts: Rows, work: Work, rubbing: Rubbing, out: Array
) -> float:
    """Subtract λ·∂r/∂p of the flanks' friction for the displacements of pins and flanks; return λ·∂r/∂θ."""
    row, turning = work.step, 0.0
    for number in range(contacts.shape[0]):
        contact_ = contacts[number]
        if contact_.force <= 0.0:
            continue
        local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, number)
        distance = contact_.gap + problem.pin_radius[local.pin]
        f = flank_friction(problem, rubbing, local, contact_)
        if assembly.elastic is not None:
            f = of_ports(f)
        along, first = gap_gradient(local), FIRST_DISC + 3 * local.disc
        fall, (slide_u, slide_v, slide_y) = force_fall(contact_, local, along), along.slide
        acting, weights = (slide_u, slide_v, slide_y + distance), (row[first], row[first + 1], row[first + 2])
        by_u = by_v = by_y = 0.0
        for i in range(3):
            by_u += weights[i] * rubbing_stiffness(local, along, f, fall, acting, i, 0)
            by_v += weights[i] * rubbing_stiffness(local, along, f, fall, acting, i, 1)
            by_y += weights[i] * rubbing_stiffness(local, along, f, fall, acting, i, 2)
        by_position, by_force = (by_u, by_v, by_y), f.slope * projection(weights, acting)
        by_normal = -f.amplitude * projection(weights, along.gap)
        add_by_pins_and_flanks(problem, contact_, local, by_position, by_force, by_normal, out)
        turning += projection((*crank_motion(problem, local), -1.0 / problem.teeth), by_position)
        # A smaller flank has its point of contact farther from the pin's axis.
        out[PIN_GENERATING] += f.amplitude * row[first + 2]
    return turning


class _Along(NamedTuple):
    """Products of λ with derivatives by the unknowns, for one joint."""

    sliding: float  # sliding of a roller in its hole, or rotation of a bearing
    closing: float  # n·∂d/∂q of a roller; 0 for a bearing, whose moment has no direction
    outer: float  # rotation of the outer body and of the seat of a roller; 0 for a bearing
    seat: float


@compiled
def _moved(d: Displacement, f: Acting, stiffness: float, along: _Along, vx: float, vy: float, levers: float) -> float:
    """λ·∂r of a joint's friction where its displacement changes by v.

    `levers` is what λ changes the sliding by as the lever arms of a roller's outer body and seat change with it.
    """
    closing = d.normal_x * vx + d.normal_y * vy
    across = (d.normal_x * vy - d.normal_y * vx) / d.length if d.length > 0.0 else 0.0
    turned = levers - along.outer * closing - across * along.closing
    return float(f.slope * stiffness * closing * along.sliding + f.amplitude * turned)


@compiled
def _add_joints(
    problem: Problem, assembly: Assembly, work: Work, rubbing: Rubbing, sliding: Array, by_joint: Array
) -> float:
    """Subtract λ·∂r/∂p of the joints' friction for the parameters of each joint; return λ·∂r/∂θ."""
    row, index, by, turning = work.step, work.indices, work.by, 0.0
    for number in range(assembly.joints.size):
        joint, out = assembly.joints[number], by_joint[number]
        d, acting = pressing(assembly, number, displacement(assembly, joint, work), work, work.ports)
        elastic = has_ports(assembly.elastic, number)
        if acting.stiffness == 0.0 and not (elastic and acting.force > 0.0):
            continue
        f = joint_friction(rubbing, joint, joint_speed(problem, assembly, joint, d, work), acting.force)
        if elastic:
            f = of_ports(f)
        outer, seat = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.seat)]
        turned = row[outer.rotation] if outer.rotation >= 0 else 0.0
        if joint.reach > 0.0:
            unknowns, slid, closing = derivatives(assembly, joint, d, work), 0.0, 0.0
            write_sliding(assembly, joint, rubbing.laws[int(joint.law)].outer_radius, d, work, unknowns, sliding)
            for i in range(unknowns):
                slid += row[index[i]] * sliding[i]
                closing += row[index[i]] * (d.normal_x * by[0, i] + d.normal_y * by[1, i])
            along = _Along(slid, closing, turned, row[seat.rotation] if seat.rotation >= 0 else 0.0)
        else:
            inner = assembly.bodies[int(joint.inner)].rotation
            along = _Along(turned - (row[inner] if inner >= 0 else 0.0), 0.0, 0.0, 0.0)
        k, nx, ny = acting.stiffness, d.normal_x, d.normal_y
        c, s = work.axes[int(joint.outer), 0], work.axes[int(joint.outer), 1]
        out[OUTER] -= _moved(d, f, k, along, c, s, along.outer * (nx * c + ny * s))
        out[OUTER + 1] -= _moved(d, f, k, along, -s, c, along.outer * (ny * c - nx * s))
        c, s = work.axes[int(joint.seat), 0], work.axes[int(joint.seat), 1]
        out[INNER] -= _moved(d, f, k, along, -c, -s, -along.seat * (nx * c + ny * s))
        out[INNER + 1] -= _moved(d, f, k, along, s, -c, -along.seat * (ny * c - nx * s))
        if joint.eccentricity > 0.0:
            ex, ey = eccentric(joint, work)
            throw = math.hypot(ex, ey)
            out[THROW] -= _moved(d, f, k, along, -ex / throw, -ey / throw, 0.0)
            out[PHASE] -= _moved(d, f, k, along, ey, -ex, 0.0)
        pressed = f.slope * along.sliding
        out[PLAY] += k * pressed
        out[STIFFNESS] -= acting.force * pressed
        out[CLEARANCE] -= by_clearance(assembly.laws[joint.law], d.excess - joint.play) * pressed
        vx, vy = turning_motion(assembly, joint, d, work)
        levers = along.outer * outer.rate * (ny * d.outer_x - nx * d.outer_y)
        levers -= along.seat * seat.rate * (ny * d.inner_x - nx * d.inner_y)
        turning += _moved(d, f, k, along, vx, vy, levers)
    return turning


@compiled
def sweep_motion_sensitivities(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torques: Array,
    coordinates: Array,
    rubbing: Rubbing,
    results: Derivatives,
    by_coefficient: Array,
    by_drag: Array,
    work: Work,
    slope: Slope,
    loss: Array,
) -> bool:
    """Write the derivatives of the transmission error at given solutions; return False if one is singular.

    Without a first stage.

    Parameters
    ----------
    crank_angles, torques, places
        Crank angles (rad) and the torque at each (N·m), shape (angles,); the solutions, shape (angles, unknowns).
    results, by_coefficient
        Zeros; overwritten, the second with the derivatives by the `COEFFICIENTS` of each law, shape (angles, laws,
        coefficients), rad.
    by_drag
        Overwritten with those by the carrier's drag, shape (angles,), rad/(N·m).
    """
    contacts = contact.contact_rows(problem)
    for i in range(crank_angles.size):
        pull, more = Load(torques[i], 0.0, 0.0, CENTRING), (rubbing, slope, loss)
        assemble_at(problem, assembly, crank_angles[i], pull, contacts, work, more, coordinates[i])
        for k in range(work.step.size):
            work.step[k] = 1.0 if k == 0 else 0.0
        if not solve_transposed(problem, assembly, work, work.step, 0.0):
            return False
        results.by_torque[i] = work.step[0]  # of λ, which is now in `step`
        by_drag[i] = rubbing.direction * work.step[0]
        turning = -pull_ports(assembly.elastic, work.ports, work.step)
        write_by_bodies(assembly.elastic, work.ports, results.by_body[i])
        turning += add_mesh(problem, assembly, crank_angles[i], contacts, work, results.by_displacement[i])
        turning += _add_flanks(problem, assembly, crank_angles[i], contacts, work, rubbing, results.by_displacement[i])
        for k in range(work.residual.size):
            work.residual[k] = 0.0
        turning += add_joints(assembly, crank_angles[i], work, results.by_joint[i])
        for k in range(work.residual.size):
            turning += work.step[k] * work.residual[k]
        turning += _add_joints(problem, assembly, work, rubbing, slope.sliding, results.by_joint[i])
        results.by_angle[i] = -turning
        add_flank_coefficients(problem, crank_angles[i], contacts, work, rubbing, by_coefficient[i])
        add_joint_coefficients(problem, assembly, work, rubbing, 0.0, slope.sliding, by_coefficient[i])
    return True
