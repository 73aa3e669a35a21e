"""Forces between elastic bodies: the balance e + C f = a of all ports under load (docs/theory/bodies.md).

A port is a force between two bodies that stand where the unknowns q have them: a is their rigid approach at the port,
e the deflection of what its law holds, Hertz's contact or a bearing, and C f the bodies' displacement. Pins go by their
force, as their law gives the approach, everything else by its deflection. Newton's method on the ports under load is
within that on q: `press` solves the forces at a place, `add_ports` has them in the balance with their derivatives.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.hertz import hertz_approach
from cycloid_fmu.contact.local_frame import Vector, gap_gradient, turning_stiffness
from cycloid_fmu.contact.rows import disc_slice_pin
from cycloid_fmu.supports.bearing import by_clearance, push
from cycloid_fmu.supports.influence import (
    Influence,
    add_rates,
    dot,
    entry,
    get_known,
    rate_of_energy,
    turn_to,
    write_shares,
)
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Displacement,
    Reaction,
    Work,
    change,
    derivatives,
    displacement,
    eccentric,
    reaction,
)
from cycloid_fmu.supports.ports import (
    AGE,
    ALONG_X,
    ALONG_Y,
    EXACT,
    FRESH,
    GATHERED_AT,
    PIN,
    ROLLER,
    Elastic,
    Ports,
    has_ports,
)

_BALANCED = 2e-14  # m: residual of a port
_ITERATIONS = 60
_DAMPED = 10  # iterations after which a step may not take away more than nine tenths of a port's deflection
_DROPPED = 1e-12  # m: a damped deflection below this is none
_INEXACT = 1e-3  # share of the residual that is left while the unknowns are not balanced yet
_OLDEST = 4  # times that a factor serves at most
_PANEL = 4  # rows that are eliminated at once
_KEPT = 0.05  # a factor is kept as long as it takes away all but this share of the residual
_PATCH_LIMIT = 0.75  # half width of a contact over that of its patch, up to which the law holds


class PinLaw(NamedTuple):
    """Approach of a pin, flank and seat, under a force."""

    approach: float  # m
    softness: float  # its derivative by the force, m/N
    bent: float  # its derivative by the flank's curvature, m²
    energy: float  # stored by flank, pin and seat, J
    bent_energy: float  # the energy's derivative by the flank's curvature at this approach, N·m²


@compiled(inline=True)
def pin_law(problem: Problem, elastic: Elastic, contact_: np.record, pin: int, force: float) -> PinLaw:
    """Law of a pin under a force, N, > 0.

    The energy is Fδ - ∫δ dF. Hertz's δ = κF(H - ln F) has the integral ½Fδ + ¼κF²; beyond the limit F_l of the law it
    is that up to there and a trapezium, as δ = F dδ/dF + κF_l along the tangent.
    """
    width, gear, of_pin = problem.slice_width, problem.compliance_gear, problem.compliance_pin
    radius, largest = problem.pin_radius[pin], math.inf
    log_radius = min(1.0 / max(abs(contact_.curvature), 1e-12), problem.largest_log_radius)
    if elastic.patch_half_width > 0.0:
        log_radius = 0.25 * elastic.patch_half_width * math.exp(0.75)
        relative = abs(1.0 / radius + contact_.curvature)
        narrow = _PATCH_LIMIT * elastic.patch_half_width
        largest = 0.25 * narrow * narrow * relative * math.pi * width / (gear + of_pin)
    approach, softness, bent = hertz_approach(
        force, contact_.curvature, radius, width, gear, of_pin, log_radius, largest
    )
    kappa = (gear + of_pin) / (math.pi * width)
    limit = min((approach - force * softness) / kappa, force)
    at_limit = approach - (force - limit) * softness
    below = 0.5 * limit * at_limit + 0.25 * kappa * limit * limit + 0.5 * (force - limit) * (at_limit + approach)
    if elastic.patch_half_width == 0.0 and log_radius < problem.largest_log_radius:
        bent -= 2.0 * gear / (math.pi * width) * limit / contact_.curvature
    bent_energy = -bent * (force - 0.5 * limit)
    if math.isnan(elastic.half_shell):
        seat = force * problem.seat_compliance
        approach, softness, below = approach + seat, softness + problem.seat_compliance, below + 0.5 * force * seat
        return PinLaw(approach, softness, bent, force * approach - below, bent_energy)
    each, play = 2.0 * of_pin / width, elastic.half_shell * width / (2.0 * of_pin)
    s = play / force
    seat = 0.08 + math.log(s + 1.42) / math.pi
    approach += each * force * seat
    softness += each * (seat - s / (math.pi * (s + 1.42)))
    bow = play / 1.42 * (force - play / 1.42 * math.log(1.0 + 1.42 / s)) if play > 0.0 else 0.0
    below += 0.5 * each * (force * force * seat + bow / math.pi)
    return PinLaw(approach, softness, bent, force * approach - below, bent_energy)


@compiled
def _deflect(assembly: Assembly, ports: Ports, number: int) -> None:
    """Write force and softness of a port that goes by its deflection; of both components from the first."""
    port = ports.ports[number]
    if port.kind < ALONG_X:
        port.force = port.softness = 0.0
        if port.deflection > 0.0:
            port.force = port.scale * port.deflection**port.exponent
            port.softness = port.deflection / (port.exponent * port.force)
        return
    second = ports.ports[number + 1]
    length = math.hypot(port.deflection, second.deflection)
    force, stiffness = push(assembly.laws[port.law], length)
    port.force = second.force = 0.0
    if force > 0.0:
        nx, ny = port.deflection / length, second.deflection / length
        along, across = 1.0 / stiffness, length / force
        port.force, second.force = force * nx, force * ny
        port.softness = along * nx * nx + across * ny * ny
        second.softness = along * ny * ny + across * nx * nx
        port.across = (along - across) * nx * ny


@compiled
def _is_active(ports: Ports, number: int) -> bool:
    port = ports.ports[number]
    if port.kind == ALONG_X:
        return bool(port.force != 0.0 or ports.ports[number + 1].force != 0.0)
    if port.kind == ALONG_Y:
        return bool(port.force != 0.0 or ports.ports[number - 1].force != 0.0)
    return bool(port.force > 0.0)


@compiled
def _gather(elastic: Elastic, ports: Ports, listed: int) -> None:
    """List the ports under load, and write the influence between them where it changed."""
    n, same = 0, True
    for i in range(listed):
        number = ports.listed[i]
        if _is_active(ports, number):
            same = same and ports.gathered[n] == number
            ports.active[n] = number
            n += 1
    same = same and ports.counts[1] == n
    ports.counts[0] = n
    moved, matrix = ports.numbers[GATHERED_AT] != ports.moving.angle[0], ports.moving.matrix
    if same and not moved:
        return
    ports.counts[1], ports.numbers[GATHERED_AT] = n, ports.moving.angle[0]
    begin = 0
    for k in range(n):
        ports.gathered[k] = ports.active[k]
        port = ports.ports[ports.active[k]]
        if k > 0 and port.block != ports.ports[ports.active[k - 1]].block:
            begin = k
        ports.begin[k], row, slot = begin, ports.between[k], port.slot
        moves, line = port.kind <= ROLLER, matrix[port.slot]
        for m in range(begin, k + 1):
            other = ports.ports[ports.active[m]]
            if moves:
                row[m] = ports.between[m, k] = line[other.slot]
            elif other.kind <= ROLLER:
                row[m] = ports.between[m, k] = matrix[other.slot, slot]
            elif not same:
                row[m] = ports.between[m, k] = line[other.slot]
    end = n
    for k in range(n - 1, -1, -1):
        ports.end[k] = end
        if ports.begin[k] == k:
            end = k


@compiled
def _displace(ports: Ports) -> tuple[float, float]:
    """Write what each port under load lacks in its balance, m; return twice the bodies' energy (J) and the largest."""
    n, right, forces = ports.counts[0], ports.right, ports.forces
    for k in range(n):
        forces[k] = ports.ports[ports.active[k]].force
    stored = worst = 0.0
    for k in range(n):
        port, begin, end = ports.ports[ports.active[k]], ports.begin[k], ports.end[k]
        displaced = dot(ports.between[k, begin:end], forces[begin:end])
        stored += port.force * displaced
        right[k] = port.approach - port.deflection - displaced
        worst = max(worst, abs(right[k]))
    return stored, worst


@compiled
def _factor(ports: Ports) -> bool:
    """Factor C + D⁻¹ of the ports under load; return False if it is not positive."""
    n, factor = ports.counts[0], ports.factor
    for k in range(n):
        row, between, end = factor[k], ports.between[k], ports.end[k]
        for m in range(k, end):
            row[m] = between[m]
        port = ports.ports[ports.active[k]]
        row[k] += port.softness
        if port.kind == ALONG_X:
            row[k + 1] += port.across
        ports.factored[k] = ports.active[k]
    ports.counts[2], ports.numbers[FRESH], ports.numbers[AGE] = n, 1.0, 0.0
    first = 0
    while first < n:
        end = ports.end[first]
        last = min(first + _PANEL, end)
        for k in range(first, last):
            row = factor[k, k:end]
            if not row[0] > 0.0:
                ports.counts[2] = -1
                return False
            share = 1.0 / math.sqrt(row[0])
            for m in range(row.size):
                row[m] *= share
            for i in range(k + 1, last):
                weight, below = row[i - k], factor[i, i:end]
                above = factor[k, i:end]
                for m in range(below.size):
                    below[m] -= weight * above[m]
        if last - first == _PANEL:
            for i in range(last, end):
                below = factor[i, i:end]
                a0, a1, a2, a3 = (
                    factor[first, i:end],
                    factor[first + 1, i:end],
                    factor[first + 2, i:end],
                    factor[first + 3, i:end],
                )
                w0, w1, w2, w3 = a0[0], a1[0], a2[0], a3[0]
                for m in range(below.size):
                    below[m] -= (w0 * a0[m] + w1 * a1[m]) + (w2 * a2[m] + w3 * a3[m])
        first = last
    return True


@compiled
def _is_factored(ports: Ports) -> bool:
    n = ports.counts[0]
    same = ports.counts[2] == n
    for k in range(n):
        same = same and ports.factored[k] == ports.active[k]
    return bool(same)


@compiled
def solve_ports(ports: Ports, right: Array) -> None:
    """Solve (C + D⁻¹) x = right in place, of the ports under load."""
    n, factor = ports.counts[0], ports.factor
    for k in range(n):
        end = ports.end[k]
        row, below = factor[k, k + 1 : end], right[k + 1 : end]
        right[k] /= factor[k, k]
        value = right[k]
        for m in range(row.size):
            below[m] -= row[m] * value
    for k in range(n - 1, -1, -1):
        end = ports.end[k]
        right[k] = (right[k] - dot(factor[k, k + 1 : end], right[k + 1 : end])) / factor[k, k]


@compiled
def _write_stiffness(ports: Ports) -> None:
    """Write AᵀSA, with S = (C + D⁻¹)⁻¹, as the sum of products of the rows of R⁻ᵀA."""
    n, factor, forward, stiffness = ports.counts[0], ports.factor, ports.forward, ports.stiffness
    width, unknowns = forward.shape[1], ports.by_coordinate.shape[1]
    for k in range(n):
        for i in range(unknowns):
            forward[k, i] = ports.by_coordinate[k, i]
    for i in range(width):
        for j in range(width):
            stiffness[i, j] = 0.0
    first = 0
    while first < n:
        end = ports.end[first]
        last = min(first + _PANEL, end)
        for k in range(first, last):
            mine, share = forward[k], 1.0 / factor[k, k]
            for c in range(width):
                mine[c] *= share
            for i in range(k + 1, last):
                weight, other = factor[k, i], forward[i]
                for c in range(width):
                    other[c] -= weight * mine[c]
            for i in range(unknowns):
                weight, line = mine[i], stiffness[i]
                if weight != 0.0:
                    for c in range(width):
                        line[c] += weight * mine[c]
        if last - first == _PANEL:
            m0, m1, m2, m3 = forward[first], forward[first + 1], forward[first + 2], forward[first + 3]
            for i in range(last, end):
                w0, w1, w2, w3 = factor[first, i], factor[first + 1, i], factor[first + 2, i], factor[first + 3, i]
                other = forward[i]
                for c in range(width):
                    other[c] -= (w0 * m0[c] + w1 * m1[c]) + (w2 * m2[c] + w3 * m3[c])
        first = last
    ports.numbers[FRESH] = 0.0


@compiled
def _bend_pins(problem: Problem, elastic: Elastic, ports: Ports, contacts: Rows) -> None:
    """Write deflection and softness of the pins under load."""
    for k in range(ports.counts[0]):
        port = ports.ports[ports.active[k]]
        if port.kind == PIN and port.force > 0.0:
            contact_ = contacts[port.joint]
            pin = disc_slice_pin(problem, port.joint)[2]
            law = pin_law(problem, elastic, contact_, pin, port.force)
            port.deflection, port.softness = law.approach, law.softness


@compiled
def _step(problem: Problem, assembly: Assembly, elastic: Elastic, ports: Ports, contacts: Rows, damped: bool) -> None:
    """Take Newton's step of the forces of all ports under load, which is in `ports.right`."""
    for k in range(ports.counts[0]):
        number = ports.active[k]
        port = ports.ports[number]
        least = 0.1 if damped and port.deflection > _DROPPED else 0.0
        if port.kind == PIN:
            force = port.force + ports.right[k]
            port.force = force if force > 0.1 * port.force or (force > 0.0 and not damped) else least * port.force
        elif port.kind < ALONG_X:
            deflection = port.deflection + port.softness * ports.right[k]
            port.deflection = max(deflection, least * port.deflection)
            _deflect(assembly, ports, number)
        elif port.kind == ALONG_X:
            second, fx, fy = ports.ports[number + 1], ports.right[k], ports.right[k + 1]
            softness, across = port.softness, port.across
            port.deflection += softness * fx + across * fy
            second.deflection += across * fx + second.softness * fy
            _deflect(assembly, ports, number)
    _bend_pins(problem, elastic, ports, contacts)


@compiled
def _displace_arms(influence: Influence, ports: Ports) -> None:
    """Write the displacements of the turning arms' slots by the ports under load."""
    first, last, out = influence.arms_slot, influence.rollers_slot, ports.of_slots
    fixed = influence.arms * influence.sectors
    for slot in range(first, last):
        out[slot] = 0.0
    for k in range(ports.counts[0]):
        port = ports.ports[ports.active[k]]
        begin, end = first, last
        if not influence.coupled:
            begin = first + port.block * fixed
            end = begin + fixed
        force, row, part = port.force, ports.moving.matrix[port.slot, begin:end], out[begin:end]
        for m in range(part.size):
            part[m] += force * row[m]


@compiled
def _load_others(
    problem: Problem, assembly: Assembly, elastic: Elastic, ports: Ports, contacts: Rows, listed: int, stored: float
) -> bool:
    """Load the ports that carry nothing and are pressed; return whether there are any.

    As C is positive, (C f)_i² ≤ C_ii fᵀC f: so most pins are certainly clear.
    """
    influence, moving, n, others = elastic.influence, ports.moving, ports.counts[0], False
    bound = math.sqrt(max(influence.largest * stored, 0.0)) + _BALANCED
    _displace_arms(influence, ports)
    for i in range(listed):
        number = ports.listed[i]
        port = ports.ports[number]
        if port.kind == ALONG_Y or _is_active(ports, number):
            continue
        if port.kind <= ROLLER and port.approach < -bound:
            continue
        displaced = across = 0.0
        if influence.arms_slot <= port.slot < influence.rollers_slot:
            displaced = ports.of_slots[port.slot]
            across = ports.of_slots[port.slot + 1] if port.kind == ALONG_X else 0.0
        else:
            if port.kind == PIN:
                get_known(influence, moving, port.slot)
            for k in range(n):
                pressed = ports.ports[ports.active[k]]
                displaced += entry(influence, moving, port.slot, pressed.slot) * pressed.force
                if port.kind == ALONG_X:
                    across += entry(influence, moving, port.slot + 1, pressed.slot) * pressed.force
        port.deflection = port.approach - displaced
        if port.kind == ALONG_X:
            second = ports.ports[number + 1]
            second.deflection = second.approach - across
            _deflect(assembly, ports, number)
            others = others or _is_active(ports, number)
        elif port.deflection > _BALANCED:
            others = True
            if port.kind == PIN:
                pin = disc_slice_pin(problem, port.joint)[2]
                # Newton's method starts from about Hertz's law.
                port.force = port.deflection / (10.0 * (problem.compliance_gear + problem.compliance_pin))
                port.force *= problem.slice_width
                law = pin_law(problem, elastic, contacts[port.joint], pin, port.force)
                port.deflection, port.softness = law.approach, law.softness
            else:
                _deflect(assembly, ports, number)
    return others


@compiled
def _list(elastic: Elastic, ports: Ports) -> int:
    """List the ports that may be pressed, with their influence if they were before; return their number."""
    listed = 0
    for number in range(ports.ports.size):
        port = ports.ports[number]
        if port.kind == PIN and not port.approach > -ports.reach[0]:
            port.force = 0.0
            continue
        if port.kind == ROLLER or (port.kind == PIN and port.force > 0.0):
            get_known(elastic.influence, ports.moving, port.slot)
        ports.listed[listed] = number
        listed += 1
    return listed


@compiled
def press(problem: Problem, assembly: Assembly, elastic: Elastic, ports: Ports, contacts: Rows) -> tuple[int, float]:
    """Solve the forces of all ports from their approaches and their last forces.

    Returns
    -------
    iterations, reach
        Number of iterations, 0 without a solution; the gap within which pins may be pressed, m.
    """
    listed, last, stored, goal = _list(elastic, ports), math.inf, 0.0, 0.0
    exact = ports.numbers[EXACT] != 0.0
    if ports.numbers[AGE] > _OLDEST:
        ports.counts[2] = -1
    ports.numbers[AGE] += 1.0
    _gather(elastic, ports, listed)
    _bend_pins(problem, elastic, ports, contacts)
    for iteration in range(_ITERATIONS):
        stored, worst = _displace(ports)
        if iteration == 0:
            goal = _BALANCED if exact else max(_BALANCED, _INEXACT * worst)
        if worst <= goal:
            if not _load_others(problem, assembly, elastic, ports, contacts, listed, stored):
                solved = (_is_factored(ports) and not exact) or _factor(ports)
                return (iteration + 1 if solved else 0), math.sqrt(max(elastic.influence.largest * stored, 0.0))
            _gather(elastic, ports, listed)
            stored, worst = _displace(ports)
        if not (_is_factored(ports) and worst < _KEPT * last) and not _factor(ports):
            return 0, 0.0
        last = worst
        solve_ports(ports, ports.right)
        _step(problem, assembly, elastic, ports, contacts, iteration >= _DAMPED)
        _gather(elastic, ports, listed)
    return 0, 0.0


@compiled
def write_approaches(
    problem: Problem, assembly: Assembly, elastic: Elastic, crank_angle: float, contacts: Rows, work: Work, ports: Ports
) -> None:
    """Write the rigid approach of all ports where the unknowns have the bodies, after `orient` and placing the pins."""
    turn_to(ports.moving, crank_angle)
    c, s = math.cos(crank_angle / problem.teeth), -math.sin(crank_angle / problem.teeth)
    for number in range(elastic.first.size):
        if elastic.ports_of_joint[number] == 0:
            continue
        joint, first = assembly.joints[number], elastic.first[number]
        d = displacement(assembly, joint, work)
        if joint.reach > 0.0:
            port = ports.ports[first]
            port.approach = d.excess - joint.play - port.clearance
            continue
        dx, dy = d.length * d.normal_x, d.length * d.normal_y
        dx, dy = c * dx + s * dy, c * dy - s * dx
        for i in range(first, first + elastic.ports_of_joint[number]):
            port = ports.ports[i]
            port.approach = -(port.along_x * dx + port.along_y * dy) - port.clearance
    for row in range(contacts.shape[0]):
        contact_, gap = contacts[row], math.inf
        if contact_.gap < math.inf and contact.is_solved_at(contact_, crank_angle, work.coordinates[0]):
            gap = contact_.gap + problem.seat_gap
        ports.ports[elastic.of_row[row]].approach = -gap


@compiled
def _write_pins(problem: Problem, elastic: Elastic, contacts: Rows, ports: Ports) -> None:
    """Write the pins' forces into their rows, and list what carries any."""
    touching = 0
    for row in range(contacts.shape[0]):
        port, contact_ = ports.ports[elastic.of_row[row]], contacts[row]
        contact_.force = port.force
        contact_.stiffness = contact_.force_by_curvature = 0.0
        if port.force > 0.0:
            pin = disc_slice_pin(problem, row)[2]
            law = pin_law(problem, elastic, contact_, pin, port.force)
            contact_.stiffness, contact_.force_by_curvature = 1.0 / law.softness, -law.bent / law.softness
            contacts[touching].touching = row
            touching += 1
    if touching < contacts.shape[0]:
        contacts[touching].touching = -1.0


@compiled
def _add_pin(problem: Problem, crank_angle: float, contacts: Rows, row: int, work: Work, ports: Ports, k: int) -> None:
    """Write the derivatives of a pin's approach, and add what turns its force."""
    contact_, by = contacts[row], ports.by_coordinate[k]
    local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, row)
    along = gap_gradient(local)
    first, turning = FIRST_DISC + 3 * local.disc, turning_stiffness(contact_.force, local, along)
    for i in range(3):
        by[first + i] = -along.gap[i]
        for j in range(3):
            work.jacobian[first + i, first + j] += turning[i][j]


@compiled(inline=True)
def port_direction(joint: np.record, port: np.record, d: Displacement, c: float, s: float) -> tuple[float, float]:
    """Direction of a port's force on its joint's displacement; `c`, `s` of the outer body's ideal rotation."""
    if joint.reach > 0.0:
        return d.normal_x, d.normal_y
    return s * port.along_y - c * port.along_x, -s * port.along_x - c * port.along_y


@compiled
def _add_joint(
    assembly: Assembly, elastic: Elastic, number: int, axes: tuple[float, float], work: Work, ports: Ports, k: int
) -> int:
    """Write the derivatives of a joint's approaches from the kth port under load on, and its force; return the next k.

    `axes` is the cosine and sine of the ideal rotation of the output. Also adds what turns the force.
    """
    joint, c, s = assembly.joints[number], axes[0], axes[1]
    d = displacement(assembly, joint, work)
    unknowns, index, by = derivatives(assembly, joint, d, work), work.indices, work.by
    last = elastic.first[number] + elastic.ports_of_joint[number]
    fx = fy = 0.0
    while k < ports.counts[0] and ports.active[k] < last:
        port, row = ports.ports[ports.active[k]], ports.by_coordinate[k]
        ax, ay = port_direction(joint, port, d, c, s)
        for i in range(unknowns):
            row[index[i]] += ax * by[0, i] + ay * by[1, i]
        fx, fy = fx + port.force * ax, fy + port.force * ay
        k += 1
    ports.of_joints[number, 0], ports.of_joints[number, 1] = fx, fy
    return k


@compiled
def _turn_joint(assembly: Assembly, number: int, centring: float, work: Work, ports: Ports) -> None:
    """Add what turns a joint's force as the unknowns change, and its centring spring."""
    joint, jacobian = assembly.joints[number], work.jacobian
    d = displacement(assembly, joint, work)
    unknowns, index, by = derivatives(assembly, joint, d, work), work.indices, work.by
    fx, fy, nx, ny = ports.of_joints[number, 0], ports.of_joints[number, 1], d.normal_x, d.normal_y
    spring = across = 0.0
    if joint.reach > 0.0:
        across = (fx * nx + fy * ny) / d.length
    else:
        spring, across = centring, centring
        px, py = spring * d.length * nx, spring * d.length * ny
        for i in range(unknowns):
            work.residual[index[i]] += px * by[0, i] + py * by[1, i]
        fx, fy = fx + px, fy + py
    kxx, kyy, kxy = (
        spring * nx * nx + across * ny * ny,
        spring * ny * ny + across * nx * nx,
        (spring - across) * nx * ny,
    )
    for i in range(unknowns):
        kx, ky = kxx * by[0, i] + kxy * by[1, i], kxy * by[0, i] + kyy * by[1, i]
        for j in range(unknowns):
            jacobian[index[i], index[j]] += kx * by[0, j] + ky * by[1, j]
    turn = assembly.bodies[joint.outer].rotation
    if turn >= 0:
        jacobian[turn, turn] -= fx * d.outer_x + fy * d.outer_y
    turn = assembly.bodies[joint.seat].rotation
    if turn >= 0:
        jacobian[turn, turn] += fx * d.inner_x + fy * d.inner_y


@compiled
def add_ports(
    problem: Problem,
    assembly: Assembly,
    elastic: Elastic,
    crank_angle: float,
    centring: float,
    contacts: Rows,
    work: Work,
    ports: Ports,
) -> None:
    """Add the solved forces of all ports and their derivatives to the balance, after `press`."""
    n, by, residual = ports.counts[0], ports.by_coordinate, work.residual
    _write_pins(problem, elastic, contacts, ports)
    for k in range(n):
        for i in range(residual.size):
            by[k, i] = 0.0
    for number in range(elastic.first.size):
        ports.of_joints[number, 0] = ports.of_joints[number, 1] = 0.0
    axes = math.cos(crank_angle / problem.teeth), -math.sin(crank_angle / problem.teeth)
    k = 0
    # Ports are in the order of discs, so those of a joint follow each other.
    while k < n:
        port = ports.ports[ports.active[k]]
        if port.kind == PIN:
            _add_pin(problem, crank_angle, contacts, port.joint, work, ports, k)
            k += 1
        else:
            k = _add_joint(assembly, elastic, port.joint, axes, work, ports, k)
    for number in range(elastic.first.size):
        if elastic.ports_of_joint[number] > 0:
            _turn_joint(assembly, number, centring, work, ports)
    if ports.numbers[FRESH] != 0.0:
        _write_stiffness(ports)
    for k in range(n):
        force = ports.forces[k]
        for i in range(residual.size):
            residual[i] += force * by[k, i]
    for i in range(residual.size):
        for j in range(residual.size):
            work.jacobian[i, j] += ports.stiffness[i, j]


@compiled
def joint_force(assembly: Assembly, number: int, d: Displacement, work: Work, ports: Any) -> tuple[float, float]:
    """Force of a joint on its displacement, N, at a solved place and without the centring springs."""
    if ports is not None and has_ports(assembly.elastic, number):
        return ports.of_joints[number, 0], ports.of_joints[number, 1]
    force = reaction(assembly, assembly.joints[number], d, 0.0).force
    return force * d.normal_x, force * d.normal_y


@compiled
def pressing(assembly: Assembly, number: int, d: Displacement, work: Work, ports: Any) -> tuple[Displacement, Reaction]:
    """Displacement of a joint with the direction of its force, and the force, without the centring springs.

    Through elastic bodies stiffnesses are 0: how such a force changes is in its ports.
    """
    if not has_ports(assembly.elastic, number):
        return d, reaction(assembly, assembly.joints[number], d, 0.0)
    fx, fy = joint_force(assembly, number, d, work, ports)
    force = math.hypot(fx, fy)
    nx, ny = (fx / force, fy / force) if force > 0.0 else (d.normal_x, d.normal_y)
    return (
        Displacement(nx, ny, d.length, d.excess, d.outer_x, d.outer_y, d.inner_x, d.inner_y),
        Reaction(force, 0.0, 0.0),
    )


@compiled
def torque_of_bodies(problem: Problem, assembly: Assembly, elastic: Elastic | None, work: Work, ports: Any) -> float:
    """What elastic bodies add to the crank's torque at a solved place, N·m.

    The influence changes with the crank angle, and the axes in which bearings press turn.
    """
    if elastic is None:
        return 0.0
    write_forces(ports)
    torque = -rate_of_energy(elastic.influence, ports.moving, ports.of_slots)
    for number in range(elastic.first.size):
        if elastic.ports_of_joint[number] > 0 and assembly.joints[number].reach == 0.0:
            d = displacement(assembly, assembly.joints[number], work)
            fx, fy = ports.of_joints[number, 0], ports.of_joints[number, 1]
            torque += d.length * (d.normal_x * fy - d.normal_y * fx) / problem.teeth
    return torque


@compiled
def write_forces(ports: Ports) -> None:
    """Write the force of each slot."""
    for slot in range(ports.of_slots.size):
        ports.of_slots[slot] = 0.0
    for k in range(ports.counts[0]):
        port = ports.ports[ports.active[k]]
        ports.of_slots[port.slot] += port.force


class Pull(NamedTuple):
    """A joint whose ports `pull_ports` has pulled, by what may change it."""

    through_bodies: bool  # False, and nothing else, of a joint between rigid bodies
    x: float  # by a motion of its displacement, 1/m times what the unknowns are given in
    y: float
    force_x: float  # its force on its displacement, N
    force_y: float
    stiffness: float  # by the logarithm of its law's stiffness
    clearance: float  # by its diametral clearance
    play: float  # by a further play


@compiled
def write_rates(elastic: Elastic, ports: Any) -> None:
    """Write dC/dθ f of the slots under load."""
    rates = ports.rates
    write_forces(ports)
    for slot in range(rates.size):
        rates[slot] = 0.0
    add_rates(elastic.influence, ports.moving, ports.of_slots, rates)


@compiled
def pull_ports(elastic: Elastic | None, ports: Any, by: Array) -> float:
    """Write the change of all ports' forces by a change of the unknowns; return its work on dC/dθ f at these ports.

    With friction it is what the balance changes by with each port's approach, along `by`.
    """
    if elastic is None:
        return 0.0
    for number in range(ports.ports.size):
        ports.ports[number].pull = 0.0
    for slot in range(ports.pull_of_slots.size):
        ports.pull_of_slots[slot] = 0.0
    n, right = ports.counts[0], ports.right
    for k in range(n):
        right[k] = dot(ports.by_coordinate[k], by) + dot(ports.rubbing[ports.active[k]], by)
    solve_ports(ports, right)
    write_rates(elastic, ports)
    work = 0.0
    for k in range(n):
        port = ports.ports[ports.active[k]]
        port.pull = right[k]
        ports.pull_of_slots[port.slot] += right[k]
        work += right[k] * ports.rates[port.slot]
    return work


@compiled
def write_by_bodies(elastic: Elastic | None, ports: Any, out: Array) -> None:
    """Write the derivatives by the logarithm of each body's stiffness, -λ·∂r/∂p, after `pull_ports` along λ.

    A stiffer body has less of its influence C_B, so its share in the work of the pull on C f falls.
    """
    if elastic is None:
        return
    write_shares(elastic.influence, ports.moving, ports.pull_of_slots, ports.of_slots, out)
    for body in range(out.size):
        out[body] = -out[body]


@compiled
def clear_rubbing(elastic: Elastic | None, ports: Any) -> None:
    """Set what friction takes of the ports under load to zero, and what the crank takes to that by their influence."""
    if elastic is None:
        return
    write_rates(elastic, ports)
    for k in range(ports.counts[0]):
        number = ports.active[k]
        ports.by_crank[number] = -ports.rates[ports.ports[number].slot]
        for i in range(ports.rubbing.shape[1]):
            ports.rubbing[number, i] = 0.0


@compiled
def rub_pin(elastic: Elastic | None, ports: Any, row: int, first: int, by_force: Vector) -> bool:
    """Set by how much friction changes the balance of a disc with each N on a pin; return False if all are rigid."""
    if elastic is None:
        return False
    for i in range(3):
        ports.rubbing[elastic.of_row[row], first + i] = by_force[i]
    return True


@compiled
def rub_joint(
    assembly: Assembly, elastic: Elastic | None, number: int, d: Displacement, work: Work, slope: Any, by_crank: float
) -> None:
    """Set by how much friction changes the balance, and the crank's torque, with the force of a joint's ports.

    Parameters
    ----------
    d
        Of the joint, of `pressing`.
    slope
        `losses.rubbing.Slope` with `by_force` of the joint. To `crank_torque` is added that a bearing's axes turn.
    by_crank
        Change of the crank's torque with each N of the joint's force, by its friction.
    """
    if elastic is None:
        return
    joint = assembly.joints[number]
    ports: Any = work.ports
    rate = assembly.bodies[int(joint.outer)].rate
    c, s = math.cos(ports.moving.angle[0] * rate), math.sin(ports.moving.angle[0] * rate)
    own = displacement(assembly, joint, work)
    ex, ey = eccentric(joint, work)
    if joint.reach == 0.0:
        ex, ey = ex + rate * own.length * own.normal_x, ey + rate * own.length * own.normal_y
        fx, fy = ports.of_joints[number, 0], ports.of_joints[number, 1]
        for i in range(derivatives(assembly, joint, own, work)):
            slope.crank_torque[work.indices[i]] -= rate * (work.by[0, i] * fy - work.by[1, i] * fx)
    for i in range(elastic.first[number], elastic.first[number] + elastic.ports_of_joint[number]):
        ax, ay = port_direction(joint, ports.ports[i], d, c, s)
        along = ax * d.normal_x + ay * d.normal_y
        ports.by_crank[i] += along * by_crank - (ex * ay - ey * ax)
        for k in range(slope.by_force.size):
            ports.rubbing[i, k] = along * slope.by_force[k]


@compiled
def add_rubbing(elastic: Elastic | None, ports: Any, jacobian: Array, by_coordinate: Array) -> None:
    """Add what friction changes with the ports' forces to the derivatives of the balance and of the crank's torque."""
    if elastic is None:
        return
    n, right = ports.counts[0], ports.right
    for j in range(by_coordinate.size):
        for k in range(n):
            right[k] = ports.by_coordinate[k, j]
        solve_ports(ports, right)
        for k in range(n):
            number, change_ = ports.active[k], right[k]
            by_coordinate[j] += ports.by_crank[number] * change_
            for i in range(by_coordinate.size):
                jacobian[i, j] += ports.rubbing[number, i] * change_


@compiled
def closing_of(elastic: Elastic | None, ports: Any, row: int, stiffness: float, rigid: float) -> float:
    """By how much a pin's gap closes for the change of its force: between rigid bodies, or in the last `pull_ports`."""
    if elastic is None:
        return rigid
    return float(-ports.ports[elastic.of_row[row]].pull / stiffness)


@compiled
def pull_of(
    assembly: Assembly,
    elastic: Elastic | None,
    ports: Any,
    crank_angle: float,
    number: int,
    d: Displacement,
    along_x: float,
    along_y: float,
) -> Pull:
    """What changes a joint after `pull_ports`; `along` is the change of its displacement by that of the unknowns."""
    if elastic is None:
        return Pull(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    joint = assembly.joints[number]
    c, s = (
        math.cos(crank_angle * assembly.bodies[int(joint.outer)].rate),
        math.sin(crank_angle * assembly.bodies[int(joint.outer)].rate),
    )
    fx, fy = ports.of_joints[number, 0], ports.of_joints[number, 1]
    x = y = stiffness = clearance = play = 0.0
    for i in range(elastic.first[number], elastic.first[number] + elastic.ports_of_joint[number]):
        port = ports.ports[i]
        pull, softness = port.pull, port.softness
        if pull == 0.0:
            continue
        ax, ay = port_direction(joint, port, d, c, s)
        x, y = x + pull * ax, y + pull * ay
        stiffness += pull * softness * port.force
        clearance += 0.5 * pull
        play += pull
    if elastic.ports_of_joint[number] == 2 and joint.reach == 0.0:
        first, second = ports.ports[elastic.first[number]], ports.ports[elastic.first[number] + 1]
        stiffness += first.across * (first.pull * second.force + second.pull * first.force)
        length = math.hypot(first.deflection, second.deflection)
        law, clearance = assembly.laws[joint.law], 0.0
        if length > 0.0 and (first.pull != 0.0 or second.pull != 0.0):
            along = (first.pull * first.deflection + second.pull * second.deflection) / length
            clearance = -along * by_clearance(law, length) / push(law, length)[1]
    if joint.reach > 0.0:
        across = math.hypot(fx, fy) / d.length
        normal = d.normal_x * along_x + d.normal_y * along_y
        x, y = x + across * (along_x - normal * d.normal_x), y + across * (along_y - normal * d.normal_y)
    return Pull(elastic.ports_of_joint[number] > 0, x, y, fx, fy, stiffness, clearance, play)


@compiled
def share_compliance(
    assembly: Assembly, elastic: Elastic | None, ports: Any, work: Work, by_torque: Array, out: Array
) -> None:
    """Write the shares of `PARTS` in the compliance dx/dT at a solved place, rad/(N·m).

    The shares are f'ᵀC_B f' of bodies and f'ᵀD⁻¹f' of laws, f' the change of all forces with the torque.

    Parameters
    ----------
    by_torque
        Change of the unknowns with the torque, shape (unknowns,).
    out
        Overwritten, shape (parts,); of a drive whose bodies are rigid shape (0,), and left.
    """
    if elastic is None:
        return
    for part in range(out.size):
        out[part] = 0.0
    for k in range(ports.counts[0]):
        ports.right[k] = dot(ports.by_coordinate[k], by_torque)
    solve_ports(ports, ports.right)
    for slot in range(ports.of_slots.size):
        ports.of_slots[slot] = 0.0
    for k in range(ports.counts[0]):
        port = ports.ports[ports.active[k]]
        pull = ports.right[k]
        ports.of_slots[port.slot] += pull
        share = pull * pull * port.softness
        if port.kind == ALONG_X:
            share += 2.0 * pull * ports.right[k + 1] * port.across
        out[0 if port.kind == PIN else 1 + port.law] += share
    laws = assembly.laws.size
    write_shares(elastic.influence, ports.moving, ports.of_slots, ports.of_slots, out[1 + laws :])
    for number in range(assembly.joints.size):
        if elastic.ports_of_joint[number] > 0:
            continue
        joint = assembly.joints[number]
        d = displacement(assembly, joint, work)
        acting = reaction(assembly, joint, d, 0.0)
        unknowns, index, by = derivatives(assembly, joint, d, work), work.indices, work.by
        lx = ly = 0.0
        for i in range(unknowns):
            lx += by[0, i] * by_torque[index[i]]
            ly += by[1, i] * by_torque[index[i]]
        gx, gy = change(d, acting, lx, ly)
        out[1 + joint.law] += gx * lx + gy * ly
