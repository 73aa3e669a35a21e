"""Derivatives of the transmission error by everything that an error can displace."""

from __future__ import annotations

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.equilibrium import rotational_stiffness
from cycloid_fmu.contact.lanes import sine_cosine
from cycloid_fmu.contact.local_frame import (
    LocalFrame,
    Vector,
    gap_gradient,
    local_frame,
    output_motion,
    projected_stiffness,
    projection,
    torque_by_shift,
)
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows, touching_count

# The displacements of one number, in the order of `errors.kinds.BODIES`; then those of pins and teeth.
CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING, BODY_COUNT = range(8)


@compiled
def _larger_circle(problem: Problem, contact: np.record, local: LocalFrame) -> tuple[float, float]:
    """Change of the contact's force and turn of its normal with R.

    The flank moves along the foot's radius, its foot and curvature change. N/m and rad/m, the turn > 0 as slides are.
    """
    R, teeth, per_speed = problem.circle_radius, problem.teeth, 1.0 / local.speed
    cube = per_speed * per_speed * per_speed
    ez = problem.generating_eccentricity * (teeth + 1)
    distance = contact.gap + problem.pin_radius[local.pin] - problem.generating_radius
    along = R - local.speed * local.facing  # e z_p cos(z_c α)
    foot = local.leaning * (1.0 + distance * per_speed) * local.foot
    bend = R * R + ez * ez * (teeth + 1) - (teeth + 2) * R * along
    path = cube * (2.0 * R - (teeth + 2) * along - 3.0 * bend * (R - along) * per_speed * per_speed)
    flank = 1.0 / (1.0 - problem.generating_radius * bend * cube)
    curvature = path * flank * flank + contact.curvature_rate * foot
    force = contact.stiffness * local.facing + contact.force_by_curvature * curvature
    return float(force), float(local.leaning * local.turning)


@compiled
def add_by_pins_and_flanks(
    problem: Problem,
    contact: np.record,
    local: LocalFrame,
    by_position: Vector,
    by_force: float,
    by_normal: float,
    out: Array,
) -> None:
    """Subtract what displaced pins and flanks change of a weighted sum of a contact's forces on the gear.

    Parameters
    ----------
    by_position, by_force, by_normal
        Change of the sum by the gear's position (u, v, y), as `projected_stiffness`; change of minus the sum for each N
        that the contact presses more, and for each rad that its normal turns.
    out
        As that of `derivatives`.
    """
    teeth, pin = problem.teeth, local.pin
    pins, (by_u, by_v, by_y) = teeth + 1, by_position
    # Turning or shifting a flank is turning or shifting the gear, shifting a pin is shifting the gear back.
    s, c = sine_cosine(local.direction)
    out[BODY_COUNT + pin] += c * by_u + s * by_v
    out[BODY_COUNT + pins + pin] += c * by_v - s * by_u
    out[BODY_COUNT + 2 * pins + pin] += contact.stiffness * by_force
    out[PIN_GENERATING] -= contact.stiffness * by_force
    pressed, turned = _larger_circle(problem, contact, local)
    out[CIRCLE_GENERATING] += pressed * by_force + turned * by_normal
    out[BODY_COUNT + 3 * pins + local.disc * teeth + local.tooth] -= by_y


@compiled
def sensitivities(problem: Problem, crank_angle: float, x: float, contacts: Rows, out: Array) -> float:
    """Derivatives of the transmission error at constant torque by every displacement (implicit function theorem).

    As `derivatives`, without that by the crank; returns ∂M/∂x, N·m/rad.
    """
    stiffness, _ = derivatives(problem, crank_angle, x, contacts, out)
    return stiffness


@compiled
def derivatives(problem: Problem, crank_angle: float, x: float, contacts: Rows, out: Array) -> tuple[float, float]:
    """Derivatives of the transmission error at constant torque by every displacement, and of the output by the crank.

    dx/dp = -(∂M/∂p)/(∂M/∂x) (docs/theory/errors.md), with the arms' own change included.

    Parameters
    ----------
    problem, crank_angle, x, contacts
        A solved equilibrium.
    out
        Overwritten, shape (7 + 3 pins + discs x teeth,), by what is displaced: the bodies (`errors.kinds.BODIES`);
        place outwards, along the circle and radius of each pin; turn of each tooth, disc by disc. rad/m, and rad/rad
        for tilts and turns.

    Returns
    -------
    stiffness, output_rate
        ∂M/∂x (N·m/rad) and dφ_b/dθ at constant torque (1), as `crank_side`.
    """
    for column in range(out.size):
        out[column] = 0.0
    stiffness = coupling = 0.0
    for i in range(touching_count(contacts)):
        row = int(contacts[i].touching)
        contact = contacts[row]
        if contact.force <= 0.0:
            continue
        local = local_frame(problem, crank_angle, x, contacts, row)
        stiffness += rotational_stiffness(contact)
        along, weights = gap_gradient(local), output_motion(problem, local)
        by_position = projected_stiffness(contact, local, along, weights)
        by_force, by_normal = projection(weights, along.gap), contact.force * projection(weights, along.slide)
        add_by_pins_and_flanks(problem, contact, local, by_position, by_force, by_normal, out)
        by_u, by_v = torque_by_shift(problem, contact, local, by_position)
        z, c, s = problem.slice_z[local.slice], local.crank_x, local.crank_y
        out[CENTRE_X] -= by_u
        out[CENTRE_Y] -= by_v
        out[TILT_X] -= by_u * z
        out[TILT_Y] -= by_v * z
        out[CRANK_THROW] -= by_u * c + by_v * s
        # The crank moves the gear's centre across its throw.
        coupling += problem.eccentricity * (by_v * c - by_u * s)
    for column in range(out.size):
        out[column] /= stiffness
    return stiffness, -coupling / stiffness
