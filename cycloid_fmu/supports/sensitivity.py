"""Derivatives of the transmission error of a drive on its bearings by all displacements.

Where r(q, p) = 0 is the balance, dx/dp = -λ·∂r/∂p with λ the row of (∂r/∂q)⁻¹ for the carrier's rotation: one linear
solution per crank angle, for any number of errors (docs/theory/supports.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled, part, spliced
from cycloid_fmu.contact.sensitivity import (
    BODY_COUNT,
    CENTRE_X,
    CENTRE_Y,
    CIRCLE_GENERATING,
    CRANK_THROW,
    PIN_GENERATING,
    larger_circle,
)
from cycloid_fmu.supports.assembly import Assembly
from cycloid_fmu.supports.balance import (
    FIRST_DISC,
    Load,
    Work,
    assemble,
    crank_displacement,
    eccentric,
    hold,
    roller_displacement,
    solve_linear,
)
from cycloid_fmu.supports.bearing import CENTRING, Bearing, by_clearance, push

# Columns in addition to those of errors, two per bearing: logarithm of its stiffness, and its clearance.
TURNING_ARM, CRANK_SHAFT, MAIN, OUTPUT_ROLLER = range(4)


@spliced
def _row_of_rotation(problem: Problem, assembly: Assembly, work: Work) -> bool:
    """Write λ into `work.step`."""
    hold(problem, assembly, work, 0.0)
    matrix, n = work.matrix, work.step.size
    for i in range(n):
        for j in range(i):
            matrix[i, j], matrix[j, i] = matrix[j, i], matrix[i, j]
    for i in range(n):
        work.step[i] = 1.0 if i == 0 else 0.0
    return solve_linear(matrix, work.step)


@spliced
def _add_mesh(
    problem: Problem, theta: float, x: float, contacts: Rows, row: Array, out: Array, by_angle: Array
) -> None:
    """Subtract λ·∂r/∂p for the displacements of pins and flanks, and for the crank angle."""
    teeth = problem.teeth
    pins = teeth + 1
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    pitch = BODY_COUNT + 3 * pins
    e = problem.eccentricity
    for number in range(contacts.shape[0]):
        contact_ = contacts[number]
        force = contact_.force
        if force <= 0.0:
            continue
        local = contact.local_frame(problem, theta, x, contacts, number)
        disc, pin = local.disc, local.pin
        nx, ny, px, py = local.normal_x, local.normal_y, local.gear_x, local.gear_y
        at = FIRST_DISC + 3 * disc
        lu, lv, ly = row[at], row[at + 1], row[at + 2]
        turn, slide = nx * py - ny * px, -(nx * px + ny * py)
        # Projection of λ on the gap and on the pin's sliding along the flank.
        along, across = -nx * lu - ny * lv + turn * ly, ny * lu - nx * lv + slide * ly
        k, bend = contact_.stiffness, local.bend
        curved = contact_.force_by_curvature * contact_.curvature_rate * local.foot
        c, s = math.cos(local.direction), math.sin(local.direction)
        out[radial + pin] += _displaced(force, k, curved, bend, along, across, ly, nx, ny, c, s)
        out[tangential + pin] += _displaced(force, k, curved, bend, along, across, ly, nx, ny, -s, c)
        out[radius + pin] += k * along
        out[PIN_GENERATING] -= k * along
        distance = contact_.gap + problem.pin_radius[pin] - problem.generating_radius
        pressed, turned = larger_circle(problem, contact_, distance, local)
        out[CIRCLE_GENERATING] += pressed * along + force * turned * across
        # Rotating or shifting a flank is rotating or shifting the disc: λ·∂r/∂(u, v, y) of this contact.
        by_u = -k * nx * along - force * bend * ny * across - curved * ny * along - force * ny * ly
        by_v = -k * ny * along + force * bend * nx * across + curved * nx * along + force * nx * ly
        by_y = k * turn * along - force * bend * slide * across - curved * slide * along
        by_y += -force * ny * lu + force * nx * lv - force * slide * ly
        out[pitch + disc * teeth + local.tooth] -= by_y
        by_angle[0] -= -e * local.crank_y * by_u + e * local.crank_x * by_v - by_y / teeth


@part
def _displaced(
    force: float,
    k: float,
    curved: float,
    bend: float,
    along: float,
    across: float,
    turn: float,
    nx: float,
    ny: float,
    vx: float,
    vy: float,
) -> float:
    """-λ·∂r for a motion v of a pin's axis."""
    normal, tangent = vx * nx + vy * ny, vy * nx - vx * ny
    pressed = curved * tangent - k * normal
    return pressed * along + force * (bend * tangent * across + turn * (nx * vy - ny * vx))


@part
def _stiff(force: float, stiffness: float, dx: float, dy: float, r: float, vx: float, vy: float) -> tuple[float, float]:
    """Change of a bearing's force if its displacement d changes by v."""
    if r == 0.0:
        return stiffness * vx, stiffness * vy
    nx, ny, across = dx / r, dy / r, force / r
    normal = (stiffness - across) * (nx * vx + ny * vy)
    return normal * nx + across * vx, normal * ny + across * vy


@part
def _law_columns(bearing: Bearing, r: float, along: float, law: int, out: Array) -> None:
    """Subtract λ·∂r/∂p for a bearing's stiffness (logarithm) and clearance; `along` is λ·∂r by its force."""
    force, _ = push(bearing, r)
    out[2 * law] -= force * along
    out[2 * law + 1] -= by_clearance(bearing, r) * along


class _Joint(NamedTuple):
    """A crank's bearing or an output roller in a disc's hole."""

    disc: int
    number: int
    x: float  # displacement d, m
    y: float
    r: float  # |d|, m
    force: float
    stiffness: float
    hole_x: float  # lever arms of disc and carrier, m
    hole_y: float
    carrier_x: float
    carrier_y: float
    along_x: float  # λ·∂d/∂q
    along_y: float


@part
def _add_places(
    problem: Problem,
    theta: float,
    q: Array,
    row: Array,
    out: Array,
    first: int,
    count: int,
    joint: _Joint,
    by_angle: Array,
    vx: float,
    vy: float,
) -> None:
    """Subtract λ·∂r/∂p for the positions of a joint's hole in its disc and of the joint in the carrier.

    Also for the crank angle; v is the derivative of d by it beyond the carrier's rotation.
    """
    carrier, holes = -theta / problem.teeth, problem.shift_x.size * count
    x, y, r, force, stiffness, lx, ly = (
        joint.x,
        joint.y,
        joint.r,
        joint.force,
        joint.stiffness,
        joint.along_x,
        joint.along_y,
    )
    fx, fy = (force * x / r, force * y / r) if r > 0.0 else (0.0, 0.0)
    turned, carried = row[FIRST_DISC + 3 * joint.disc + 2], row[0]
    gx, gy = _stiff(
        force,
        stiffness,
        x,
        y,
        r,
        vx + (joint.hole_y - joint.carrier_y) / problem.teeth,
        vy - (joint.hole_x - joint.carrier_x) / problem.teeth,
    )
    by_angle[0] -= gx * lx + gy * ly
    by_angle[0] -= (
        (fx * joint.hole_x + fy * joint.hole_y) * turned - (fx * joint.carrier_x + fy * joint.carrier_y) * carried
    ) / problem.teeth
    disc_angle, carrier_angle = carrier + q[FIRST_DISC + 3 * joint.disc + 2], carrier + q[0]
    for axis in range(2):
        angle = disc_angle + 0.5 * math.pi * axis
        ux, uy = math.cos(angle), math.sin(angle)
        gx, gy = _stiff(force, stiffness, x, y, r, ux, uy)
        column = first + axis * holes + joint.disc * count + joint.number
        out[column] -= gx * lx + gy * ly + (fy * ux - fx * uy) * turned
        angle = carrier_angle + 0.5 * math.pi * axis
        ux, uy = math.cos(angle), math.sin(angle)
        gx, gy = _stiff(force, stiffness, x, y, r, -ux, -uy)
        column = first + 2 * holes + axis * count + joint.number
        out[column] -= gx * lx + gy * ly - (fy * ux - fx * uy) * carried


@spliced
def _add_cranks(
    problem: Problem,
    assembly: Assembly,
    theta: float,
    q: Array,
    row: Array,
    out: Array,
    first: int,
    laws: Array,
    by_angle: Array,
) -> None:
    discs, count, teeth = problem.shift_x.size, assembly.place_x.size, problem.teeth
    throw = first + 2 * (discs + 1) * count
    phase = throw + discs * count
    carrier, e = -theta / teeth, assembly.eccentricity
    for k in range(count):
        shaft = FIRST_DISC + 3 * discs + 2 * k
        for disc in range(discs):
            at, one = FIRST_DISC + 3 * disc, disc * count + k
            crank = theta + problem.crank_phase[disc]
            dx, dy, hx, hy, ax, ay = crank_displacement(assembly, carrier, theta, problem.crank_phase[disc], q, disc, k)
            r = math.hypot(dx, dy)
            force, stiffness = push(assembly.turning_arm, r)
            # Projection of λ on the displacement.
            lx = row[at] - row[1] - row[shaft] - hy * row[at + 2] + ay * row[0]
            ly = row[at + 1] - row[2] - row[shaft + 1] + hx * row[at + 2] - ax * row[0]
            angle, length = crank + assembly.phase[disc, k], e + assembly.throw[disc, k]
            ux, uy = math.cos(angle), math.sin(angle)
            gx, gy = _stiff(force, stiffness, dx, dy, r, -ux, -uy)
            out[throw + one] -= gx * lx + gy * ly
            out[CRANK_THROW] -= gx * lx + gy * ly
            gx, gy = _stiff(force, stiffness, dx, dy, r, length * uy, -length * ux)
            out[phase + one] -= gx * lx + gy * ly
            vx, vy = length * uy - e * math.sin(crank), e * math.cos(crank) - length * ux
            joint = _Joint(disc, k, dx, dy, r, force, stiffness, hx, hy, ax, ay, lx, ly)
            _add_places(problem, theta, q, row, out, first, count, joint, by_angle, vx, vy)
            if r > 0.0:
                _law_columns(assembly.turning_arm, r, (dx * lx + dy * ly) / r, TURNING_ARM, laws)
        r = math.hypot(q[shaft], q[shaft + 1])
        if r > 0.0:
            along = (q[shaft] * row[shaft] + q[shaft + 1] * row[shaft + 1]) / r
            _law_columns(assembly.crank_shaft, r, along, CRANK_SHAFT, laws)


@spliced
def _add_rollers(
    problem: Problem,
    assembly: Assembly,
    theta: float,
    q: Array,
    row: Array,
    out: Array,
    first: int,
    laws: Array,
    by_angle: Array,
) -> None:
    discs, count, teeth = problem.shift_x.size, assembly.place_x.size, problem.teeth
    throw = first + 2 * (discs + 1) * count
    phase = throw + discs
    play = phase + discs
    carrier = -theta / teeth
    shaft = FIRST_DISC + 3 * discs
    e, kw = assembly.eccentricity, assembly.output_roller
    for disc in range(discs):
        at = FIRST_DISC + 3 * disc
        crank = theta + problem.crank_phase[disc]
        ex, ey = eccentric(assembly, crank, disc, 0)
        dx, dy = q[at] - q[shaft] + ex, q[at + 1] - q[shaft + 1] + ey
        r = math.hypot(dx, dy)
        force, stiffness = push(assembly.turning_arm, r)
        lx, ly = row[at] - row[shaft], row[at + 1] - row[shaft + 1]
        angle, length = crank + assembly.phase[disc, 0], e + assembly.throw[disc, 0]
        ux, uy = math.cos(angle), math.sin(angle)
        gx, gy = _stiff(force, stiffness, dx, dy, r, -ux, -uy)
        out[throw + disc] -= gx * lx + gy * ly
        out[CRANK_THROW] -= gx * lx + gy * ly
        gx, gy = _stiff(force, stiffness, dx, dy, r, length * uy, -length * ux)
        out[phase + disc] -= gx * lx + gy * ly
        vx, vy = length * uy - e * math.sin(crank), e * math.cos(crank) - length * ux
        gx, gy = _stiff(force, stiffness, dx, dy, r, vx, vy)
        by_angle[0] -= gx * lx + gy * ly
        if r > 0.0:
            _law_columns(assembly.turning_arm, r, (dx * lx + dy * ly) / r, TURNING_ARM, laws)
        for i in range(count):
            wx, wy, hx, hy, ax, ay, beyond = roller_displacement(assembly, carrier, crank, q, disc, i)
            beyond -= assembly.hole_play[disc, i]
            if beyond <= 0.0:
                continue
            r = math.hypot(wx, wy)
            force = kw * beyond
            lx = row[at] - row[1] - hy * row[at + 2] + ay * row[0]
            ly = row[at + 1] - row[2] + hx * row[at + 2] - ax * row[0]
            along = (wx * lx + wy * ly) / r
            out[play + disc * count + i] += kw * along
            joint = _Joint(disc, i, wx, wy, r, force, kw, hx, hy, ax, ay, lx, ly)
            _add_places(
                problem, theta, q, row, out, first, count, joint, by_angle, -e * math.sin(crank), e * math.cos(crank)
            )
            laws[2 * OUTPUT_ROLLER] -= force * along
            laws[2 * OUTPUT_ROLLER + 1] += 0.5 * kw * along
    _add_seat(assembly, assembly.crank_shaft, q, row, shaft, CRANK_SHAFT, out, laws)


@part
def _add_seat(
    assembly: Assembly, bearing: Bearing, q: Array, row: Array, at: int, law: int, out: Array, laws: Array
) -> None:
    """Subtract λ·∂r/∂p for a bearing in the housing's seat."""
    dx, dy = q[at] - assembly.seat_x, q[at + 1] - assembly.seat_y
    r = math.hypot(dx, dy)
    force, stiffness = push(bearing, r)
    for axis in range(2):
        gx, gy = _stiff(force, stiffness, dx, dy, r, -1.0 if axis == 0 else 0.0, 0.0 if axis == 0 else -1.0)
        out[CENTRE_X if axis == 0 else CENTRE_Y] -= gx * row[at] + gy * row[at + 1]
    if r > 0.0:
        _law_columns(bearing, r, (dx * row[at] + dy * row[at + 1]) / r, law, laws)


@compiled
def sweep_supported_sensitivities(
    problem: Problem,
    assembly: Assembly,
    thetas: Array,
    torques: Array,
    places: Array,
    errors: Array,
    laws: Array,
    by_angle: Array,
    by_torque: Array,
    work: Work,
) -> bool:
    """Write the derivatives of the deviation at given solutions; return False if one is singular.

    Parameters
    ----------
    thetas, torques, places
        Crank angles (rad) and the torque at each (N·m), shape (angles,); the solutions, shape (angles, unknowns).
    errors, laws, by_angle, by_torque
        Zeros on entry; overwritten with the derivatives of x by every displacement, in the order of
        `surfaces.structured.displacement_layout`, shape (angles, displacements), and by each bearing's logarithm of
        stiffness (rad) and clearance (rad/m), shape (angles, 8); by crank angle (dimensionless) and torque (rad/(N·m)),
        shape (angles,).
    """
    contacts = contact.contact_rows(problem)
    first = BODY_COUNT + 3 * problem.pin_x.size + problem.tooth_turn.size
    for i in range(thetas.size):
        theta = thetas[i]
        q = places[i]
        work.moved[0] = math.inf
        assemble(problem, assembly, theta, Load(torques[i], 0.0, 0.0), CENTRING, q, contacts, work)
        if not _row_of_rotation(problem, assembly, work):
            return False
        row = work.step
        by_torque[i] = row[0]
        _add_mesh(problem, theta, q[0], contacts, row, errors[i], by_angle[i : i + 1])
        if assembly.cranks:
            _add_cranks(problem, assembly, theta, q, row, errors[i], first, laws[i], by_angle[i : i + 1])
        else:
            _add_rollers(problem, assembly, theta, q, row, errors[i], first, laws[i], by_angle[i : i + 1])
        _add_seat(assembly, assembly.main, q, row, 1, MAIN, errors[i], laws[i])
    return True
