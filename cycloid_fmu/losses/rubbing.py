"""Friction on top of the balance of `supports`: one more force at every contact, one more moment at every bearing.

A normal force F acts along the derivatives n·∂d/∂q of its displacement. Its friction acts along those of the sliding of
the two bodies at the point of contact, with the amplitude G = s sign(v) f F; for a bearing these are the rotations of
its two bodies, and G = s sign(v) (M_0 + l F). v is the sliding or rotation for each radian of the crank in the ideal
motion, s the crank's direction. What a part loses for each radian of the crank is |G v| (docs/theory/losses.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import GapGradient, LocalFrame, Vector, force_fall, gap_gradient
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.supports.balance import Load, assemble, settling
from cycloid_fmu.supports.elastic import add_rubbing, clear_rubbing, pressing, rub_joint, rub_pin, torque_of_bodies
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Displacement,
    Work,
    derivatives,
    displacement,
    eccentric,
)
from cycloid_fmu.supports.ports import has_ports

COEFFICIENTS = ("kinetic", "static", "joint_kinetic", "joint_static", "constant", "arm")
"""What friction is linear in: coefficients at speed and at rest of a contact and of what its pin turns in; M_0 (N·m)
and l (m) of a bearing."""
KINETIC, STATIC, JOINT_KINETIC, JOINT_STATIC, CONSTANT, ARM = range(6)
LAW = np.dtype(
    (
        np.record,
        [(name, np.float64) for name in (*COEFFICIENTS, "decay", "joint_decay", "joint_radius", "outer_radius")],
    )
)
"""Friction of one kind of joint, or of the flanks, at one speed of the crank, SI.

`decay` and `joint_decay` are (W ν/(ν_40 v_s))²: the coefficient at a speed v for each radian is kinetic + (static -
kinetic) exp(-decay v²). `joint_radius` is κ r_J, 0 where nothing turns, and `joint_decay` is over κ² for it;
`outer_radius` is r_w of output rollers."""
SLIDING, TURNING = range(2)  # losses of a contact that slides, and of one whose pin turns
_OF_JOINTS = ("turning_arm", "crank_shaft", "main")
FLANK, OUTPUT, FIRST_STAGE = (PARTS.index(name) for name in ("flank", "output_contact", "first_stage"))
FIRST_BEARING = PARTS.index(_OF_JOINTS[0])
DRAG_INPUT, DRAG_OUTPUT = PARTS.index("drag_input"), PARTS.index("drag_output")
OUTPUT_LAW, FLANK_LAW = 3, 4  # laws: those of the kinds of joints in the order of `supports.assembly`, then the flanks'


class Rubbing(NamedTuple):
    """Friction of a drive in one direction and at one speed of the crank, SI.

    Attributes
    ----------
    laws
        `LAW` records of the joints' kinds and, last, of the flanks, shape (kinds + 1,).
    direction
        s, 1 or -1.
    drag
        Drag of the carrier, N·m, not below 0.
    sun_share
        z_1/z_2 of the first stage; 0 without one.
    loss
        ζ of the first stage.
    """

    laws: NDArray[np.void]
    direction: float
    drag: float
    sun_share: float
    loss: float


class Slope(NamedTuple):
    """Arrays that solving with friction overwrites, shape (unknowns,).

    Attributes
    ----------
    crank_torque, sliding
        Derivatives by the unknowns: of the crank's torque, and of one joint's sliding.
    by_force
        Change of the balance with each N of one joint's force, by its friction.
    """

    crank_torque: Array
    sliding: Array
    by_force: Array


class Acting(NamedTuple):
    """Friction of one contact or bearing."""

    amplitude: float  # G, N or N·m
    slope: float  # its derivative by the normal force
    speed: float  # v, m or rad for each radian of the crank
    sign: float  # s sgn v
    turns: bool  # whether the pin turns in its seat, instead of sliding on the flank


@compiled
def _coefficient(kinetic: float, static: float, decay: float, speed: float) -> float:
    return kinetic + (static - kinetic) * math.exp(-decay * speed * speed)


@compiled
def sliding_friction(law: np.record, direction: float, radius: float, speed: float, force: float) -> Acting:
    """Friction of a contact with a pin or roller of a radius, m, which turns where that takes less."""
    ratio, turns = _coefficient(law.kinetic, law.static, law.decay, speed), False
    if law.joint_radius > 0.0:
        lever = law.joint_radius / radius
        turned = lever * _coefficient(law.joint_kinetic, law.joint_static, law.joint_decay, speed * lever)
        if turned < ratio:
            ratio, turns = turned, True
    sign = 0.0 if speed == 0.0 else math.copysign(1.0, direction * speed)
    return Acting(sign * ratio * force, sign * ratio, speed, sign, turns)


@compiled
def bearing_friction(law: np.record, direction: float, speed: float, force: float) -> Acting:
    """Friction moment of a bearing."""
    sign = math.copysign(1.0, direction * speed)
    return Acting(sign * (law.constant + law.arm * force), sign * law.arm, speed, sign, False)


@compiled
def flank_speed(problem: Problem, local: contact.LocalFrame, distance: float) -> float:
    """Sliding of a flank on its pin along ẑ × n for each radian of the crank, m.

    Parameters
    ----------
    local
        The contact.
    distance
        Of the flank's point of contact from the pin's axis, m.
    """
    pitch = problem.eccentricity * (problem.teeth + 1)
    lever_x = problem.pin_x[local.pin] - pitch * local.crank_x
    lever_y = problem.pin_y[local.pin] - pitch * local.crank_y
    return float(-(lever_x * local.normal_x + lever_y * local.normal_y - distance) / problem.teeth)


@compiled
def flank_friction(problem: Problem, rubbing: Rubbing, local: contact.LocalFrame, flank: np.record) -> Acting:
    """Friction of a flank on its pin, of a row of contacts."""
    radius = problem.pin_radius[local.pin]
    speed = flank_speed(problem, local, flank.gap + radius)
    return sliding_friction(rubbing.laws[FLANK_LAW], rubbing.direction, radius, speed, flank.force)


@compiled
def rubbing_stiffness(
    local: LocalFrame, along: GapGradient, f: Acting, fall: Vector, acting: Vector, i: int, j: int
) -> float:
    """Derivative of one force or moment (i) of a flank's friction on its disc by one coordinate (j) of its position.

    Parameters
    ----------
    fall
        As of `force_fall`.
    acting
        What friction acts along: the sliding of the point of contact by the disc's position.
    """
    turned = local.bend * along.slide[j] + (1.0 if i < 2 and j == 2 else 0.0)
    return float(f.slope * fall[j] * acting[i] + f.amplitude * turned * along.gap[i])


@compiled
def _add_flanks(
    problem: Problem,
    assembly: Assembly,
    crank_angle: float,
    contacts: Rows,
    work: Work,
    rubbing: Rubbing,
    loss: Array,
) -> None:
    """Add the friction of flanks on pins to the balance, and their losses."""
    residual, jacobian = work.residual, work.jacobian
    for row in range(contacts.shape[0]):
        contact_ = contacts[row]
        if contact_.force <= 0.0:
            continue
        local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, row)
        distance = contact_.gap + problem.pin_radius[local.pin]
        f = flank_friction(problem, rubbing, local, contact_)
        loss[FLANK + (TURNING if f.turns else SLIDING)] += abs(f.amplitude * f.speed)
        along = gap_gradient(local)
        fall, (slide_u, slide_v, slide_y) = force_fall(contact_, local, along), along.slide
        # Friction acts at the point of contact, which slides with the gear's rotation as well.
        acting, first = (slide_u, slide_v, slide_y + distance), FIRST_DISC + 3 * local.disc
        by_force = (-f.slope * acting[0], -f.slope * acting[1], -f.slope * acting[2])
        if rub_pin(assembly.elastic, work.ports, row, first, by_force):
            fall = (0.0, 0.0, 0.0)
        for i in range(3):
            residual[first + i] -= f.amplitude * acting[i]
            for j in range(3):
                jacobian[first + i, first + j] += rubbing_stiffness(local, along, f, fall, acting, i, j)


@compiled
def joint_speed(problem: Problem, assembly: Assembly, joint: np.record, d: Displacement, work: Work) -> float:
    """Speed of a joint's friction for each radian of the crank: sliding of a roller in its hole, m; rotation, rad."""
    if joint.reach > 0.0:
        axes = work.axes[int(joint.outer)]
        along = axes[2] * d.normal_x + axes[3] * d.normal_y
        return float(joint.reach * (1.0 + 1.0 / problem.teeth) * along)
    return float(assembly.bodies[int(joint.outer)].rate - assembly.bodies[int(joint.inner)].rate)


@compiled
def joint_friction(rubbing: Rubbing, joint: np.record, speed: float, force: float) -> Acting:
    """Friction of an output roller, or the moment of a bearing, at its speed and normal force."""
    law = rubbing.laws[int(joint.law)]
    if joint.reach > 0.0:
        return sliding_friction(law, rubbing.direction, law.outer_radius, speed, force)
    return bearing_friction(law, rubbing.direction, speed, force)


@compiled
def write_sliding(
    assembly: Assembly, joint: np.record, radius: float, d: Displacement, work: Work, unknowns: int, out: Array
) -> None:
    """Write the derivatives of a roller's sliding in its hole by the unknowns of `derivatives`; `radius` is its own."""
    outer, seat = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.seat)].rotation
    index, by = work.indices, work.by
    for i in range(unknowns):
        out[i] = d.normal_x * by[1, i] - d.normal_y * by[0, i]
        if index[i] == outer:
            out[i] -= d.length + radius
        elif index[i] == seat:
            out[i] += radius


@compiled
def _add_roller(
    assembly: Assembly, joint: np.record, d: Displacement, stiffness: float, f: Acting, work: Work, sliding: Array
) -> None:
    """Add the friction of an output roller to the balance."""
    outer, seat = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.seat)].rotation
    index, by, nx, ny = work.indices, work.by, d.normal_x, d.normal_y
    for i in range(sliding.size):
        work.residual[index[i]] += f.amplitude * sliding[i]
        along = nx * by[0, i] + ny * by[1, i]
        for j in range(sliding.size):
            closing = nx * by[0, j] + ny * by[1, j]
            across = (nx * by[1, j] - ny * by[0, j]) / d.length
            change = f.slope * stiffness * closing * sliding[i] - f.amplitude * across * along
            if i == j and (index[i] == outer or index[i] == seat):
                change += f.amplitude * along
            if index[i] == outer:
                change -= f.amplitude * closing
            work.jacobian[index[i], index[j]] += change


@compiled
def _add_moment(
    assembly: Assembly, joint: np.record, d: Displacement, stiffness: float, f: Acting, work: Work, unknowns: int
) -> None:
    """Add the friction moment of a bearing to the balance of its two bodies; a crank's rotation is no unknown."""
    outer, inner = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.inner)].rotation
    for body, sign in ((outer, 1.0), (inner, -1.0)):
        if body >= 0:
            work.residual[body] += sign * f.amplitude
            for j in range(unknowns):
                closing = d.normal_x * work.by[0, j] + d.normal_y * work.by[1, j]
                work.jacobian[body, work.indices[j]] += sign * f.slope * stiffness * closing


@compiled
def _write_by_force(assembly: Assembly, joint: np.record, f: Acting, work: Work, slope: Slope, unknowns: int) -> None:
    """Write the change of the balance with each N of a joint's force, by its friction."""
    for i in range(slope.by_force.size):
        slope.by_force[i] = 0.0
    if joint.reach > 0.0:
        for i in range(unknowns):
            slope.by_force[work.indices[i]] += f.slope * slope.sliding[i]
        return
    outer, inner = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.inner)].rotation
    if outer >= 0:
        slope.by_force[outer] += f.slope
    if inner >= 0:
        slope.by_force[inner] -= f.slope


@compiled
def _add_joints(problem: Problem, assembly: Assembly, work: Work, rubbing: Rubbing, slope: Slope, loss: Array) -> float:
    """Add the friction of joints to the balance, and their losses; return the crank's torque, and write its slope."""
    torque = torque_of_bodies(problem, assembly, assembly.elastic, work, work.ports)
    for number in range(assembly.joints.size):
        joint = assembly.joints[number]
        # Springs that only centre what is loose rub on nothing.
        d, acting = pressing(assembly, number, displacement(assembly, joint, work), work, work.ports)
        f = joint_friction(rubbing, joint, joint_speed(problem, assembly, joint, d, work), acting.force)
        if joint.reach > 0.0 and acting.force == 0.0:
            continue
        lost, by_crank, unknowns = abs(f.amplitude * f.speed), 0.0, derivatives(assembly, joint, d, work)
        if joint.reach > 0.0:
            loss[OUTPUT + (TURNING if f.turns else SLIDING)] += lost
            radius = rubbing.laws[int(joint.law)].outer_radius
            write_sliding(assembly, joint, radius, d, work, unknowns, slope.sliding)
            _add_roller(assembly, joint, d, acting.stiffness, f, work, slope.sliding[:unknowns])
        else:
            loss[FIRST_BEARING + int(joint.law)] += lost
            _add_moment(assembly, joint, d, acting.stiffness, f, work, unknowns)
            by_crank = 1.0 if assembly.bodies[int(joint.inner)].rotation < 0 else 0.0
        ex, ey = eccentric(joint, work)
        arm, along = ex * d.normal_y - ey * d.normal_x, ex * d.normal_x + ey * d.normal_y
        torque -= acting.force * arm + by_crank * f.amplitude
        elastic = has_ports(assembly.elastic, number)
        if elastic:
            _write_by_force(assembly, joint, f, work, slope, unknowns)
            rub_joint(assembly, assembly.elastic, number, d, work, slope, -by_crank * f.slope)
        if elastic and joint.reach == 0.0:
            continue
        for j in range(unknowns):
            closing = d.normal_x * work.by[0, j] + d.normal_y * work.by[1, j]
            across = d.normal_x * work.by[1, j] - d.normal_y * work.by[0, j]
            slope.crank_torque[work.indices[j]] -= (arm + by_crank * f.slope) * acting.stiffness * closing
            if d.length > 0.0:
                slope.crank_torque[work.indices[j]] -= acting.force * along * across / d.length
    return torque


@compiled
def through_first_stage(rubbing: Rubbing, crank_torque: float) -> float:
    """Factor of the sun's torque by the first stage's loss: 1/(1 - ζ) where the sun drives the cranks, else 1 - ζ."""
    return 1.0 / (1.0 - rubbing.loss) if rubbing.direction * crank_torque > 0.0 else 1.0 - rubbing.loss


@compiled
def assemble_rubbing(
    problem: Problem,
    assembly: Assembly,
    crank_angle: float,
    pull: Load,
    contacts: Rows,
    work: Work,
    more: tuple[Rubbing, Slope, Array],
) -> float:
    """Write the residual of the balance with friction and its derivatives; return the crank's torque, N·m.

    Parameters
    ----------
    more
        The friction, work arrays, and an array that is overwritten with what each of `PARTS` loses apart from the
        input's drag, J for each radian of the crank.
    """
    rubbing, slope, loss = more
    assemble(problem, assembly, crank_angle, pull, contacts, work, None)
    for part_ in range(loss.size):
        loss[part_] = 0.0
    for i in range(work.residual.size):
        slope.crank_torque[i] = 0.0
    clear_rubbing(assembly.elastic, work.ports)
    _add_flanks(problem, assembly, crank_angle, contacts, work, rubbing, loss)
    torque = _add_joints(problem, assembly, work, rubbing, slope, loss)
    add_rubbing(assembly.elastic, work.ports, work.jacobian, slope.crank_torque)
    work.residual[0] -= rubbing.direction * rubbing.drag
    loss[DRAG_OUTPUT] = rubbing.drag / problem.teeth
    if rubbing.sun_share > 0.0:
        # The carrier takes the sun's and the cranks' torques too.
        factor = through_first_stage(rubbing, torque)
        taken = 1.0 + rubbing.sun_share * factor
        loss[FIRST_STAGE] = abs(torque) * (1.0 + 1.0 / problem.teeth) * abs(factor - 1.0)
        work.residual[0] += taken * torque
        for i in range(work.residual.size):
            work.jacobian[0, i] += taken * slope.crank_torque[i]
    return torque


@compiled
def assemble_at(
    problem: Problem,
    assembly: Assembly,
    crank_angle: float,
    pull: Load,
    contacts: Rows,
    work: Work,
    more: tuple[Rubbing, Slope, Array],
    coordinates: Array,
) -> float:
    """Write the balance with friction at a given solution, as `assemble_rubbing` does; return the crank's torque."""
    for k in range(work.coordinates.size):
        work.coordinates[k] = coordinates[k]
    work.moved[0] = math.inf
    return float(assemble_rubbing(problem, assembly, crank_angle, pull, contacts, work, more))


settle_rubbing = settling(assemble_rubbing)
"""Kernel that solves the balance with friction; it returns the number of steps, 0 where the drive jams."""
