"""Derivatives of the deviation by everything that an error can displace."""

from __future__ import annotations

import math

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.equilibrium import rotational_stiffness
from cycloid_fmu.contact.lanes import LANES, Lanes, lanes_of, on_stack, sine_cosine, vectors
from cycloid_fmu.contact.local_frame import Carrying, FlankFrame, LocalFrame, displaced, flank_frame, levers
from cycloid_fmu.contact.problem import Problem, poses
from cycloid_fmu.contact.rows import Rows, disc_slice_pin, touching_count

# The displacements of one number, in the order of `errors.kinds.BODIES`; then those of pins and teeth.
CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING, BODY_COUNT = range(8)


@compiled(inline=True)
def larger_circle(
    problem: Problem, contact: np.record | Carrying, distance: float, local: LocalFrame | FlankFrame
) -> tuple[float, float]:
    """Change of the contact's force and turn of its normal with R, where the axis is at a `distance` from the path.

    The flank moves along the foot's radius, its foot and curvature change. N/m and rad/m, the turn > 0 as slides are.
    """
    R, teeth, speed = problem.circle_radius, problem.teeth, local.speed
    ez = problem.generating_eccentricity * (teeth + 1)
    along = R - speed * local.facing  # e z_p cos(z_c α)
    foot = local.leaning * (1.0 + distance / speed) * local.foot
    bend = R * R + ez * ez * (teeth + 1) - (teeth + 2) * R * along
    path = (2.0 * R - (teeth + 2) * along) / speed**3 - 3.0 * bend * (R - along) / speed**5
    flank = 1.0 / (1.0 - problem.generating_radius * bend / speed**3)
    curvature = path * flank * flank + contact.curvature_rate * foot
    force = contact.stiffness * local.facing + contact.force_by_curvature * curvature
    return float(force), float(local.leaning * local.turning)


@compiled
def sensitivities(problem: Problem, crank_angle: float, x: float, contacts: Rows, out: Array) -> float:
    """Derivatives of the deviation at constant torque by every displacement (implicit function theorem).

    As `derivatives`, without that by the crank; returns ∂M/∂x, N·m/rad.
    """
    stiffness, _ = derivatives(problem, crank_angle, x, contacts, out)
    return stiffness


@compiled
def derivatives(problem: Problem, crank_angle: float, x: float, contacts: Rows, out: Array) -> tuple[float, float]:
    """Derivatives of the deviation at constant torque by every displacement, and of the output by the crank.

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
    pins = problem.teeth + 1
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    pitch = BODY_COUNT + 3 * pins
    for column in range(out.size):
        out[column] = 0.0
    stiffness = coupling = 0.0
    group, touching, following = on_stack(LOADED), touching_count(contacts), 0
    while following < touching:
        filled = 0
        while following < touching and filled < LANES:
            row = int(contacts[following].touching)
            if contacts[row].force > 0.0:
                _enter(problem, crank_angle, x, contacts[row], row, group, filled)
                filled += 1
            following += 1
        _torques(problem, crank_angle, x, group, filled)
        for lane in range(filled):
            pin, z = int(group.pin[lane]), problem.slice_z[int(group.slice[lane])]
            stiffness += rotational_stiffness(contacts[int(group.row[lane])])
            out[CENTRE_X] += group.along_x[lane]
            out[CENTRE_Y] += group.along_y[lane]
            out[TILT_X] += group.along_x[lane] * z
            out[TILT_Y] += group.along_y[lane] * z
            out[CRANK_THROW] += group.throw[lane]
            # The crank moves the gear's centre across its throw.
            coupling += problem.eccentricity * group.across[lane]
            out[radial + pin] += group.outwards[lane]
            out[tangential + pin] += group.sideways[lane]
            thicker = group.stiffness[lane] * group.arm[lane]
            out[radius + pin] += thicker
            out[PIN_GENERATING] -= thicker
            out[CIRCLE_GENERATING] += group.circle[lane]
            out[pitch + int(group.disc[lane]) * problem.teeth + int(group.tooth[lane])] += group.turned[lane]
    scale = -1.0 / stiffness
    for column in range(out.size):
        out[column] *= scale
    return stiffness, scale * coupling


LOADED = lanes_of(
    # what is known of contacts that carry, as in `LocalFrame` and contact rows
    "row",
    "disc",
    "slice",
    "pin",
    "tooth",
    "foot",
    "alpha",
    "gear",
    "angle",
    "crank",
    "pin_x",
    "pin_y",
    "centre_x",
    "centre_y",
    "distance",
    "force",
    "stiffness",
    "force_by_curvature",
    "curvature_rate",
    "arm",
    # changes of their torques: by the gear's centre, by the crank's throw along and across it, by the pin outwards and
    # sideways, by the generating circle, by the tooth's turn
    "along_x",
    "along_y",
    "throw",
    "across",
    "outwards",
    "sideways",
    "circle",
    "turned",
)


@compiled
def _enter(
    problem: Problem, crank_angle: float, x: float, contact: np.record, row: int, group: Lanes, lane: int
) -> None:
    """Put a contact into a lane."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    group.row[lane], group.disc[lane], group.slice[lane], group.pin[lane] = row, disc, slice_, pin
    group.foot[lane] = contact.foot
    group.crank[lane], _, group.gear[lane] = poses(problem, crank_angle, x, disc)
    group.pin_x[lane], group.pin_y[lane] = problem.pin_x[pin], problem.pin_y[pin]
    group.centre_x[lane] = problem.centre_x[slice_] + problem.shift_x[disc]
    group.centre_y[lane] = problem.centre_y[slice_] + problem.shift_y[disc]
    group.distance[lane] = contact.gap + problem.pin_radius[pin] - problem.generating_radius
    group.force[lane], group.stiffness[lane], group.arm[lane] = contact.force, contact.stiffness, contact.arm
    group.force_by_curvature[lane], group.curvature_rate[lane] = contact.force_by_curvature, contact.curvature_rate


@compiled
def _torques(problem: Problem, crank_angle: float, x: float, group: Lanes, filled: int) -> None:
    """Write how the torques of contacts in lanes change."""
    _, rotation, _ = poses(problem, crank_angle, x, 0)
    sr, cr = sine_cosine(rotation)
    ring, teeth = problem.ring, float(problem.teeth)
    for lane in range(vectors(filled)):
        alpha = (
            group.pin[lane] * 2.0 * math.pi / (teeth + 1.0) + (group.crank[lane] - rotation) / teeth + group.foot[lane]
        )
        tooth = np.floor(alpha * teeth / (2.0 * math.pi))
        group.tooth[lane] = tooth - teeth * np.floor(tooth / teeth)
        group.alpha[lane], group.angle[lane] = alpha, alpha + group.gear[lane]
    for lane in range(filled):
        group.angle[lane] += problem.tooth_turn[int(group.disc[lane]), int(group.tooth[lane])]
    # The gear's centre moves, so the pin's axis by the opposite; in the housing's frame unless the gear turns.
    turn, sign = (0.0, 1.0) if ring else (1.0, -1.0)
    for lane in range(vectors(filled)):
        sc, cc = sine_cosine(group.crank[lane])
        lever_x, lever_y, gear_x, gear_y = levers(
            problem, group.pin_x[lane], group.pin_y[lane], sr, cr, sc, cc, group.centre_x[lane], group.centre_y[lane]
        )
        local = flank_frame(problem, group.alpha[lane], group.angle[lane], lever_x, lever_y, group.distance[lane])
        contact = Carrying(
            group.force[lane],
            group.stiffness[lane],
            group.force_by_curvature[lane],
            group.curvature_rate[lane],
            group.arm[lane],
        )
        along_x = displaced(contact, local, -1.0, 0.0, 0.0, turn)
        along_y = displaced(contact, local, 0.0, -1.0, -turn, 0.0)
        group.along_x[lane], group.along_y[lane] = along_x, along_y
        group.throw[lane], group.across[lane] = along_x * cc + along_y * sc, along_y * cc - along_x * sc
        # The pin moves with the ring.
        s, c = sine_cosine(group.pin[lane] * 2.0 * math.pi / (teeth + 1.0) + rotation)
        group.outwards[lane] = displaced(contact, local, c, s, -sign * s, sign * c)
        group.sideways[lane] = displaced(contact, local, -s, c, -sign * c, -sign * s)
        pressed, turned = larger_circle(problem, contact, group.distance[lane], local)
        group.circle[lane] = pressed * contact.arm - contact.force * turned * local.slide
        wx, wy = (lever_x, lever_y) if ring else (-gear_x, -gear_y)
        group.turned[lane] = displaced(contact, local, gear_y, -gear_x, wx, wy)
