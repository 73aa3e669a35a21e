"""Derivatives of the deviation by every error."""

from __future__ import annotations

import math

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled, inlined
from cycloid_fmu.contact.equilibrium import rotational_stiffness
from cycloid_fmu.contact.local_frame import LocalFrame, displaced, local_frame
from cycloid_fmu.contact.problem import Problem, poses
from cycloid_fmu.contact.rows import Rows, disc_slice_pin

# The scalar errors, in the order of the sensitivities' first columns.
SCALAR_ERRORS = (
    "centre_distance_x", "centre_distance_y", "misalignment_xz", "misalignment_yz", "eccentricity",
    "pin_circle_radius", "pin_radius", "isometric", "offset",
)  # fmt: skip


@inlined
def _larger_circle(problem: Problem, contact: np.record, pin: int, local: LocalFrame) -> float:
    """Change of the contact's torque with R: the flank moves along the foot's radius, its foot and curvature change."""
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
    return float(force * contact.arm - contact.force * local.leaning * local.turning * local.slide)


@compiled
def sensitivities(problem: Problem, theta: float, x: float, contacts: Rows, out: Array) -> float:
    """Derivatives of the deviation at constant torque by every error, by the implicit function of the equilibrium.

    dx/dp = -(∂M/∂p)/(∂M/∂x) (docs/theory/errors.md), with the arms' own change included.

    Parameters
    ----------
    problem, theta, x, contacts
        A solved equilibrium.
    out
        Overwritten, shape (9 + 3 pins + discs x teeth,): `SCALAR_ERRORS`; radial, tangential and radius error of each
        pin; turn of each tooth, disc by disc. rad/m, and rad/rad for the misalignments and turns.

    Returns
    -------
    stiffness
        ∂M/∂x, N·m/rad.
    """
    pins = problem.teeth + 1
    scalars = len(SCALAR_ERRORS)
    radial, tangential, radius = scalars, scalars + pins, scalars + 2 * pins
    pitch = scalars + 3 * pins
    out[:] = 0.0
    stiffness = 0.0
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        if contact.force <= 0.0:
            continue
        disc, slice_, pin = disc_slice_pin(problem, row)
        local = local_frame(problem, theta, x, contacts, row)
        stiffness += rotational_stiffness(contact)
        z = problem.slice_z[slice_]
        crank, ring, _ = poses(problem, theta, x, disc)
        # The gear's centre moves, so the pin's axis by the opposite; in the housing's frame unless the gear turns.
        turn = 0.0 if problem.ring else 1.0
        along_x = displaced(contact, local, -1.0, 0.0, 0.0, turn)
        along_y = displaced(contact, local, 0.0, -1.0, -turn, 0.0)
        out[0] += along_x
        out[1] += along_y
        out[2] += along_x * z
        out[3] += along_y * z
        out[4] += along_x * math.cos(crank) + along_y * math.sin(crank)
        # The pin moves with the ring.
        direction = pin * 2.0 * math.pi / pins + ring
        c, s = math.cos(direction), math.sin(direction)
        sign = 1.0 if problem.ring else -1.0
        outwards = displaced(contact, local, c, s, -sign * s, sign * c)
        out[5] += outwards
        out[radial + pin] += outwards
        out[tangential + pin] += displaced(contact, local, -s, c, -sign * c, -sign * s)
        thicker = contact.stiffness * contact.arm
        out[6] += thicker
        out[radius + pin] += thicker
        out[7] -= thicker
        out[8] += _larger_circle(problem, contact, pin, local)
        foot = pin * 2.0 * math.pi / pins + (crank - ring) / problem.teeth + contact.foot
        tooth = math.floor(foot * problem.teeth / (2.0 * math.pi)) % problem.teeth
        wx, wy = (local.lever_x, local.lever_y) if problem.ring else (-local.gear_x, -local.gear_y)
        out[pitch + disc * problem.teeth + tooth] += displaced(contact, local, local.gear_y, -local.gear_x, wx, wy)
    for column in range(out.size):
        out[column] = -out[column] / stiffness
    return stiffness
