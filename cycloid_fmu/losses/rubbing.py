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
from cycloid_fmu.contact import Array, Problem, Rows, part, spliced
from cycloid_fmu.geometry.losses import PARTS
from cycloid_fmu.supports.balance import Load, assemble, settling
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Displacement,
    Work,
    derivatives,
    displacement,
    eccentric,
    reaction,
)

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
    """

    crank_torque: Array
    sliding: Array


class Acting(NamedTuple):
    """Friction of one contact or bearing."""

    amplitude: float  # G, N or N·m
    slope: float  # its derivative by the normal force
    speed: float  # v, m or rad for each radian of the crank
    turns: bool  # whether the pin turns in its seat, instead of sliding on the flank


@part
def _coefficient(kinetic: float, static: float, decay: float, speed: float) -> float:
    return kinetic + (static - kinetic) * math.exp(-decay * speed * speed)


@part
def sliding_friction(law: np.record, direction: float, radius: float, speed: float, force: float) -> Acting:
    """Friction of a contact with a pin or roller of a radius, m, which turns where that takes less."""
    ratio, turns = _coefficient(law.kinetic, law.static, law.decay, speed), False
    if law.joint_radius > 0.0:
        lever = law.joint_radius / radius
        turned = lever * _coefficient(law.joint_kinetic, law.joint_static, law.joint_decay, speed * lever)
        if turned < ratio:
            ratio, turns = turned, True
    sign = 0.0 if speed == 0.0 else math.copysign(1.0, direction * speed)
    return Acting(sign * ratio * force, sign * ratio, speed, turns)


@part
def bearing_friction(law: np.record, direction: float, speed: float, force: float) -> Acting:
    """Friction moment of a bearing."""
    sign = math.copysign(1.0, direction * speed)
    return Acting(sign * (law.constant + law.arm * force), sign * law.arm, speed, False)


@part
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


@spliced
def _add_flanks(problem: Problem, theta: float, contacts: Rows, work: Work, rubbing: Rubbing, loss: Array) -> None:
    """Add the friction of flanks on pins to the balance, and their losses."""
    residual, jacobian, law = work.residual, work.jacobian, rubbing.laws[FLANK_LAW]
    for row in range(contacts.shape[0]):
        contact_ = contacts[row]
        force = contact_.force
        if force <= 0.0:
            continue
        local = contact.local_frame(problem, theta, work.place[0], contacts, row)
        radius = problem.pin_radius[local.pin]
        distance = contact_.gap + radius
        speed = flank_speed(problem, local, distance)
        f = sliding_friction(law, rubbing.direction, radius, speed, force)
        loss[FLANK + (TURNING if f.turns else SLIDING)] += abs(f.amplitude * f.speed)
        nx, ny, px, py = local.normal_x, local.normal_y, local.gear_x, local.gear_y
        # Derivatives of the gap by u, v, y; of the sliding of the pin's axis along the flank; and of that of the point.
        du, dv, dy = -nx, -ny, nx * py - ny * px
        au, av, ay = ny, -nx, -(nx * px + ny * py)
        sy = ay + distance
        curved = contact_.force_by_curvature * contact_.curvature_rate * local.foot
        at = FIRST_DISC + 3 * local.disc
        residual[at] -= f.amplitude * au
        residual[at + 1] -= f.amplitude * av
        residual[at + 2] -= f.amplitude * sy
        for j in range(3):
            dj = du if j == 0 else (dv if j == 1 else dy)
            aj = au if j == 0 else (av if j == 1 else ay)
            pressed = f.slope * (contact_.stiffness * dj - curved * aj)
            turned = f.amplitude * local.bend * aj
            rigid = f.amplitude if j == 2 else 0.0
            jacobian[at, at + j] += pressed * au + (turned + rigid) * du
            jacobian[at + 1, at + j] += pressed * av + (turned + rigid) * dv
            jacobian[at + 2, at + j] += pressed * sy + turned * dy


@part
def joint_speed(problem: Problem, assembly: Assembly, joint: np.record, d: Displacement, work: Work) -> float:
    """Speed of a joint's friction for each radian of the crank: sliding of a roller in its hole, m; rotation, rad."""
    if joint.reach > 0.0:
        axes = work.axes[int(joint.outer)]
        along = axes[2] * d.normal_x + axes[3] * d.normal_y
        return float(joint.reach * (1.0 + 1.0 / problem.teeth) * along)
    return float(assembly.bodies[int(joint.outer)].rate - assembly.bodies[int(joint.inner)].rate)


@spliced
def _add_joints(
    problem: Problem,
    assembly: Assembly,
    work: Work,
    rubbing: Rubbing,
    slope: Slope,
    loss: Array,
) -> float:
    """Add the friction of joints to the balance, and their losses; return the crank's torque, and write its slope."""
    residual, jacobian, at, by, sliding = work.residual, work.jacobian, work.at, work.by, slope.sliding
    torque = 0.0
    for number in range(assembly.joints.size):
        joint = assembly.joints[number]
        outer, inner = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.inner)]
        seat = assembly.bodies[int(joint.seat)].rotation
        d = displacement(assembly, joint, work)
        # Springs that only centre what is loose rub on nothing.
        acting = reaction(assembly, joint, d, 0.0)
        nx, ny = d.normal_x, d.normal_y
        law, speed = rubbing.laws[int(joint.law)], joint_speed(problem, assembly, joint, d, work)
        roller = joint.reach > 0.0
        if roller:
            if acting.stiffness == 0.0:
                continue
            f = sliding_friction(law, rubbing.direction, law.outer_radius, speed, acting.force)
            loss[OUTPUT + (TURNING if f.turns else SLIDING)] += abs(f.amplitude * f.speed)
        else:
            f = bearing_friction(law, rubbing.direction, speed, acting.force)
            loss[FIRST_BEARING + int(joint.law)] += abs(f.amplitude * f.speed)
        # Derivatives of the bodies' sliding at the point of contact; a bearing's are those of two rotations.
        unknowns = derivatives(assembly, joint, d, work)
        for i in range(unknowns):
            sliding[i] = 0.0
            if roller:
                sliding[i] = nx * by[1, i] - ny * by[0, i]
                if at[i] == outer.rotation:
                    sliding[i] -= d.length + law.outer_radius
                elif at[i] == seat:
                    sliding[i] += law.outer_radius
            residual[at[i]] += f.amplitude * sliding[i]
        if not roller and outer.rotation >= 0:
            residual[outer.rotation] += f.amplitude
        if not roller and inner.rotation >= 0:
            residual[inner.rotation] -= f.amplitude
        ex, ey = eccentric(joint, work)
        arm, along = ex * ny - ey * nx, ex * nx + ey * ny
        torque -= acting.force * arm
        by_force = -arm
        if not roller and inner.rotation < 0:
            torque -= f.amplitude
            by_force -= f.slope
        for j in range(unknowns):
            closing = nx * by[0, j] + ny * by[1, j]
            across = (nx * by[1, j] - ny * by[0, j]) / d.length if d.length > 0.0 else 0.0
            slope.crank_torque[at[j]] += by_force * acting.stiffness * closing - acting.force * along * across
            pressed = f.slope * acting.stiffness * closing
            if not roller:
                if outer.rotation >= 0:
                    jacobian[outer.rotation, at[j]] += pressed
                if inner.rotation >= 0:
                    jacobian[inner.rotation, at[j]] -= pressed
                continue
            for i in range(unknowns):
                along_i = nx * by[0, i] + ny * by[1, i]
                change = pressed * sliding[i] - f.amplitude * across * along_i
                if i == j and (at[i] == outer.rotation or at[i] == seat):
                    change += f.amplitude * along_i
                if at[i] == outer.rotation:
                    change -= f.amplitude * closing
                jacobian[at[i], at[j]] += change
    return torque


@part
def through_first_stage(rubbing: Rubbing, crank_torque: float) -> float:
    """Factor of the sun's torque by the first stage's loss: 1/(1 - ζ) where the sun drives the cranks, else 1 - ζ."""
    return 1.0 / (1.0 - rubbing.loss) if rubbing.direction * crank_torque > 0.0 else 1.0 - rubbing.loss


@part
def assemble_rubbing(
    problem: Problem,
    assembly: Assembly,
    theta: float,
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
    assemble(problem, assembly, theta, pull, contacts, work, None)
    for part_ in range(loss.size):
        loss[part_] = 0.0
    for i in range(work.residual.size):
        slope.crank_torque[i] = 0.0
    _add_flanks(problem, theta, contacts, work, rubbing, loss)
    torque = _add_joints(problem, assembly, work, rubbing, slope, loss)
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


settle_rubbing = settling(assemble_rubbing)
"""Kernel that solves the balance with friction; it returns the number of steps, 0 where the drive jams."""
