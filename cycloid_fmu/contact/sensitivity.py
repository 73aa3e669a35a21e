"""Derivatives of the deviation by everything that an error can displace."""

from __future__ import annotations

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled, inlined, part
from cycloid_fmu.contact.equilibrium import rotational_stiffness
from cycloid_fmu.contact.lanes import sine_cosine
from cycloid_fmu.contact.local_frame import LocalFrame, displaced, local_frame
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows, touching_count

# The displacements of one number, in the order of `errors.kinds.BODIES`; then those of pins and teeth.
CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING, BODY_COUNT = range(8)


@inlined
def larger_circle(problem: Problem, contact: np.record, pin: int, local: LocalFrame) -> tuple[float, float]:
    """Change of the contact's force and turn of its normal with R.

    The flank moves along the foot's radius, its foot and curvature change. N/m and rad/m, the turn > 0 as slides are.
    """
    R, teeth, speed = problem.circle_radius, problem.teeth, local.speed
    ez = problem.generating_eccentricity * (teeth + 1)
    along = R - speed * local.facing  # e z_p cos(z_c α)
    distance = contact.gap + problem.pin_radius[pin] - problem.generating_radius
    foot = local.leaning * (1.0 + distance / speed) * local.foot
    bend = R * R + ez * ez * (teeth + 1) - (teeth + 2) * R * along
    path = (2.0 * R - (teeth + 2) * along) / speed**3 - 3.0 * bend * (R - along) / speed**5
    flank = 1.0 / (1.0 - problem.generating_radius * bend / speed**3)
    curvature = path * flank * flank + contact.curvature_rate * foot
    force = contact.stiffness * local.facing + contact.force_by_curvature * curvature
    return float(force), float(local.leaning * local.turning)


@compiled
def sensitivities(problem: Problem, theta: float, x: float, contacts: Rows, out: Array) -> float:
    """Derivatives of the deviation at constant torque by every displacement (implicit function theorem).

    As `derivatives`, without that by the crank; returns ∂M/∂x, N·m/rad.
    """
    stiffness, _ = derivatives(problem, theta, x, contacts, out)
    return stiffness


@part
def derivatives(problem: Problem, theta: float, x: float, contacts: Rows, out: Array) -> tuple[float, float]:
    """Derivatives of the deviation at constant torque by every displacement, and of the output by the crank.

    dx/dp = -(∂M/∂p)/(∂M/∂x) (docs/theory/errors.md), with the arms' own change included.

    Parameters
    ----------
    problem, theta, x, contacts
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
    pins = problem.teeth + 1
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    pitch = BODY_COUNT + 3 * pins
    for column in range(out.size):
        out[column] = 0.0
    stiffness = coupling = 0.0
    for i in range(touching_count(contacts)):
        row = int(contacts[i].touching)
        contact = contacts[row]
        if contact.force <= 0.0:
            continue
        local = local_frame(problem, theta, x, contacts, row)
        pin = local.pin
        stiffness += rotational_stiffness(contact)
        z = problem.slice_z[local.slice]
        # The gear's centre moves, so the pin's axis by the opposite; in the housing's frame unless the gear turns.
        turn = 0.0 if problem.ring else 1.0
        along_x = displaced(contact, local, -1.0, 0.0, 0.0, turn)
        along_y = displaced(contact, local, 0.0, -1.0, -turn, 0.0)
        out[CENTRE_X] += along_x
        out[CENTRE_Y] += along_y
        out[TILT_X] += along_x * z
        out[TILT_Y] += along_y * z
        out[CRANK_THROW] += along_x * local.crank_x + along_y * local.crank_y
        # The crank moves the gear's centre across its throw.
        coupling += problem.eccentricity * (along_y * local.crank_x - along_x * local.crank_y)
        # The pin moves with the ring.
        s, c = sine_cosine(local.direction)
        sign = 1.0 if problem.ring else -1.0
        out[radial + pin] += displaced(contact, local, c, s, -sign * s, sign * c)
        out[tangential + pin] += displaced(contact, local, -s, c, -sign * c, -sign * s)
        thicker = contact.stiffness * contact.arm
        out[radius + pin] += thicker
        out[PIN_GENERATING] -= thicker
        pressed, turned = larger_circle(problem, contact, pin, local)
        out[CIRCLE_GENERATING] += pressed * contact.arm - contact.force * turned * local.slide
        wx, wy = (local.lever_x, local.lever_y) if problem.ring else (-local.gear_x, -local.gear_y)
        tooth = pitch + local.disc * problem.teeth + local.tooth
        out[tooth] += displaced(contact, local, local.gear_y, -local.gear_x, wx, wy)
    scale = -1.0 / stiffness
    for column in range(out.size):
        out[column] *= scale
    return stiffness, scale * coupling
