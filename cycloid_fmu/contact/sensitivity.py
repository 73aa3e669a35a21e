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
def sensitivities(problem: Problem, theta: float, x: float, contacts: Rows, out: Array) -> float:
    """Derivatives of the deviation at constant torque by every displacement (implicit function theorem).

    As `derivatives`, without that by the crank; returns ∂M/∂x, N·m/rad.
    """
    stiffness, _ = derivatives(problem, theta, x, contacts, out)
    return stiffness


@compiled
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
    seen, touching, following = on_stack(_SEEN), touching_count(contacts), 0
    while following < touching:
        filled = 0
        while following < touching and filled < LANES:
            row = int(contacts[following].touching)
            if contacts[row].force > 0.0:
                _see(problem, theta, x, contacts[row], row, seen, filled)
                filled += 1
            following += 1
        _torques(problem, theta, x, seen, filled)
        for lane in range(filled):
            pin, z = int(seen.pin[lane]), problem.slice_z[int(seen.slice[lane])]
            stiffness += rotational_stiffness(contacts[int(seen.row[lane])])
            out[CENTRE_X] += seen.along_x[lane]
            out[CENTRE_Y] += seen.along_y[lane]
            out[TILT_X] += seen.along_x[lane] * z
            out[TILT_Y] += seen.along_y[lane] * z
            out[CRANK_THROW] += seen.throw[lane]
            # The crank moves the gear's centre across its throw.
            coupling += problem.eccentricity * seen.across[lane]
            out[radial + pin] += seen.outwards[lane]
            out[tangential + pin] += seen.sideways[lane]
            thicker = seen.stiffness[lane] * seen.arm[lane]
            out[radius + pin] += thicker
            out[PIN_GENERATING] -= thicker
            out[CIRCLE_GENERATING] += seen.circle[lane]
            out[pitch + int(seen.disc[lane]) * problem.teeth + int(seen.tooth[lane])] += seen.turned[lane]
    scale = -1.0 / stiffness
    for column in range(out.size):
        out[column] *= scale
    return stiffness, scale * coupling


_SEEN = lanes_of(
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
def _see(problem: Problem, theta: float, x: float, contact: np.record, row: int, seen: Lanes, lane: int) -> None:
    """Put a contact into a lane."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    seen.row[lane], seen.disc[lane], seen.slice[lane], seen.pin[lane] = row, disc, slice_, pin
    seen.foot[lane] = contact.foot
    seen.crank[lane], _, seen.gear[lane] = poses(problem, theta, x, disc)
    seen.pin_x[lane], seen.pin_y[lane] = problem.pin_x[pin], problem.pin_y[pin]
    seen.centre_x[lane] = problem.centre_x[slice_] + problem.shift_x[disc]
    seen.centre_y[lane] = problem.centre_y[slice_] + problem.shift_y[disc]
    seen.distance[lane] = contact.gap + problem.pin_radius[pin] - problem.generating_radius
    seen.force[lane], seen.stiffness[lane], seen.arm[lane] = contact.force, contact.stiffness, contact.arm
    seen.force_by_curvature[lane], seen.curvature_rate[lane] = contact.force_by_curvature, contact.curvature_rate


@compiled
def _torques(problem: Problem, theta: float, x: float, seen: Lanes, filled: int) -> None:
    """Write how the torques of contacts in lanes change."""
    _, rotation, _ = poses(problem, theta, x, 0)
    sr, cr = sine_cosine(rotation)
    ring, teeth = problem.ring, float(problem.teeth)
    for lane in range(vectors(filled)):
        alpha = seen.pin[lane] * 2.0 * math.pi / (teeth + 1.0) + (seen.crank[lane] - rotation) / teeth + seen.foot[lane]
        tooth = np.floor(alpha * teeth / (2.0 * math.pi))
        seen.tooth[lane] = tooth - teeth * np.floor(tooth / teeth)
        seen.alpha[lane], seen.angle[lane] = alpha, alpha + seen.gear[lane]
    for lane in range(filled):
        seen.angle[lane] += problem.tooth_turn[int(seen.disc[lane]), int(seen.tooth[lane])]
    # The gear's centre moves, so the pin's axis by the opposite; in the housing's frame unless the gear turns.
    turn, sign = (0.0, 1.0) if ring else (1.0, -1.0)
    for lane in range(vectors(filled)):
        sc, cc = sine_cosine(seen.crank[lane])
        lever_x, lever_y, gear_x, gear_y = levers(
            problem, seen.pin_x[lane], seen.pin_y[lane], sr, cr, sc, cc, seen.centre_x[lane], seen.centre_y[lane]
        )
        local = flank_frame(problem, seen.alpha[lane], seen.angle[lane], lever_x, lever_y, seen.distance[lane])
        contact = Carrying(
            seen.force[lane],
            seen.stiffness[lane],
            seen.force_by_curvature[lane],
            seen.curvature_rate[lane],
            seen.arm[lane],
        )
        along_x = displaced(contact, local, -1.0, 0.0, 0.0, turn)
        along_y = displaced(contact, local, 0.0, -1.0, -turn, 0.0)
        seen.along_x[lane], seen.along_y[lane] = along_x, along_y
        seen.throw[lane], seen.across[lane] = along_x * cc + along_y * sc, along_y * cc - along_x * sc
        # The pin moves with the ring.
        s, c = sine_cosine(seen.pin[lane] * 2.0 * math.pi / (teeth + 1.0) + rotation)
        seen.outwards[lane] = displaced(contact, local, c, s, -sign * s, sign * c)
        seen.sideways[lane] = displaced(contact, local, -s, c, -sign * c, -sign * s)
        pressed, turned = larger_circle(problem, contact, seen.distance[lane], local)
        seen.circle[lane] = pressed * contact.arm - contact.force * turned * local.slide
        wx, wy = (lever_x, lever_y) if ring else (-gear_x, -gear_y)
        seen.turned[lane] = displaced(contact, local, gear_y, -gear_x, wx, wy)
