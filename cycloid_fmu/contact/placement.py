"""Every pin's contact at a crank angle θ and a deviation x of the output."""

from __future__ import annotations

import math

from cycloid_fmu.contact.compiling import compiled, inlined, part
from cycloid_fmu.contact.deviations import move_to_deviations
from cycloid_fmu.contact.foot import Tangency, foot, on_tooth, tangency
from cycloid_fmu.contact.gap import Flank, Offset, write_contact
from cycloid_fmu.contact.problem import Problem, poses
from cycloid_fmu.contact.rows import Rows, is_solved_at

BOUNDED = 2e-6  # m: in an equilibrium a gap above this need not be known exactly
CLEAR = 1e-7  # m: a pin predicted to be this clear is not solved again within one equilibrium
_INTERPOLATED = 1e-9  # m: what interpolation across slices may err on a clear pin's gap
_END = 1e-9  # rad: how far inside a tooth its end is taken, so that it belongs to that tooth
_PREDICTED = 2e-4  # rad: so far a gap's derivatives by the rotation may predict it, where the second adds little


@compiled
def place(problem: Problem, theta: float, x: float, contacts: Rows, cold: bool, clear: float, bounded: float) -> None:
    """Solve the contact of every pin at crank angle θ and deviation x, into `contacts`.

    Parameters
    ----------
    cold
        Whether to start from the conjugate points instead of from what `contacts` holds of a neighbouring state.
    clear
        Rows whose gap, predicted from the last solution, is above this are left as they are (m; infinite: none is).
        From another crank angle what is predicted is a bound below the gap (docs/theory/contact.md).
    bounded
        With deviations, rows whose gap is certainly above this get a bound below it instead of the gap itself (m;
        infinite: none does).

    Notes
    -----
    Across many slices of nominal flanks the gap of a pin is smooth: five slices are solved, and where they show that
    the pin is clear everywhere the others are interpolated.
    """
    teeth = problem.teeth
    pins, slices = teeth + 1, problem.centre_x.size
    stride = 2 * pins
    # Arrays are taken out of the tuple once: each use of it inside a loop would count their references.
    pin_x, pin_y, pin_radius, tooth_turn = problem.pin_x, problem.pin_y, problem.pin_radius, problem.tooth_turn
    centre_x, centre_y, root_phase, stray = problem.centre_x, problem.centre_y, problem.root_phase, problem.stray
    R, e = problem.circle_radius, problem.generating_eccentricity
    flank = Flank(R, e, problem.generating_radius, teeth, problem.ring)
    pitch = 2.0 * math.pi / teeth
    k = e * pins / R
    root_radius = R * (1.0 - k) ** 2 / max(pins * k - 1.0, 1e-9) - problem.root_margin
    root_margin = problem.root_margin / (R * (1.0 - k))
    rough = problem.deviations is not None
    keeps = not cold and clear < math.inf
    for disc in range(problem.crank_phase.size):
        crank, ring, gear = poses(problem, theta, x, disc)
        ct, st = math.cos(ring - gear), math.sin(ring - gear)
        cg, sg = math.cos(gear), math.sin(gear)
        ox, oy = problem.eccentricity * math.cos(crank), problem.eccentricity * math.sin(crank)
        crank_x, crank_y = ox * cg + oy * sg, oy * cg - ox * sg
        ox, oy = ox + problem.shift_x[disc], oy + problem.shift_y[disc]
        shift = (crank - ring) / teeth
        for pin in range(pins):
            first = disc * slices * stride + 2 * pin
            end = first + slices * stride
            conjugate = pin * 2.0 * math.pi / pins + shift
            if keeps:
                row = first
                while row < end and _stays_clear(contacts, row, flank, stray, root_phase, theta, x, conjugate, clear):
                    row += stride
                if row >= end:
                    continue
            tooth = math.floor(conjugate / pitch)
            along = conjugate / pitch - tooth
            near = 2.0 * math.pi * min(along, 1.0 - along) < root_phase
            few = slices < 8 or rough or (keeps and contacts[first].crank_angle == theta)
            px = pin_x[pin] * ct - pin_y[pin] * st
            py = pin_x[pin] * st + pin_y[pin] * ct
            turn = tooth_turn[disc, int(tooth) % teeth]
            lower, upper = tooth * pitch, (tooth + 1.0) * pitch
            root, inwards = (lower, 1.0) if along < 0.5 else (upper, -1.0)
            beyond = tooth - inwards
            turn_beyond = tooth_turn[disc, int(beyond) % teeth]
            # Two teeth end where they meet, midway between where pitch errors leave the root of each.
            extent = 0.5 * (turn_beyond - turn) if near else 0.0
            lower, upper = (lower + extent, upper) if inwards > 0.0 else (lower, upper + extent)
            for step in range(slices if few else slices + 5):
                slice_ = step if few else step * (slices - 1) // 4
                if not few and step >= 5:
                    if step == 5 and _interpolated(contacts, first, stride, slices, theta, x):
                        break
                    slice_ = step - 5
                row = first + slice_ * stride
                if (
                    (keeps and slices > 1 and (few or step >= 5))
                    and _stays_clear(contacts, row, flank, stray, root_phase, theta, x, conjugate, clear)
                ):  # fmt: skip
                    continue
                ux, uy = ox + centre_x[slice_], oy + centre_y[slice_]
                cx, cy = ux * cg + uy * sg, uy * cg - ux * sg
                wx, wy = px - cx, py - cy
                offset = Offset(cx, cy, crank_x, crank_y)
                contact, across = contacts[row], contacts[row + 1]
                qx, qy = on_tooth(wx, wy, turn)
                start = conjugate + contact.foot + contact.foot_rate * (x - contact.deviation)
                start += contact.foot_by_crank * (theta - contact.crank_angle)
                if cold or not lower <= start <= upper:
                    # Near a root the way downhill from the conjugate point may miss the contact farther in.
                    start = root + inwards * root_phase / teeth if near else conjugate
                found, alpha, state = foot(qx, qy, start, lower, upper, R, e, teeth)
                distance = math.inf
                contact.deviation = across.deviation = x
                contact.crank_angle = across.crank_angle = theta
                contact.gap = across.gap = math.inf
                if found:
                    bx, by = state.path_x, state.path_y
                    distance = (state.apart_x * bx + state.apart_y * by) / math.sqrt(bx * bx + by * by)
                    alpha = min(max(alpha, tooth * pitch + _END), (tooth + 1.0) * pitch - _END)
                    write_contact(contact, flank, offset, pin_radius[pin], alpha - conjugate, alpha, state, theta, x)
                else:
                    contact.foot = math.nan
                # Within the root's curvature radius a point has one foot only, so none on the other tooth, unless the
                # foot is so close to the root that the step between the two teeth decides.
                if not near or (distance < root_radius and abs(alpha - root) > root_margin):
                    across.foot = math.nan
                    continue
                left, right = beyond * pitch, (beyond + 1.0) * pitch
                left, right = (left, right - extent) if inwards > 0.0 else (left - extent, right)
                start = conjugate + across.foot
                if cold or not left < start < right:
                    start = root - inwards * root_phase / teeth
                qx, qy = on_tooth(wx, wy, turn_beyond)
                found, alpha, state = foot(qx, qy, start, left, right, R, e, teeth)
                if found and left < alpha < right:
                    alpha = min(max(alpha, beyond * pitch + _END), (beyond + 1.0) * pitch - _END)
                    write_contact(across, flank, offset, pin_radius[pin], alpha - conjugate, alpha, state, theta, x)
                    continue
                across.foot = math.nan
                if contact.foot != contact.foot:
                    # The edge where the two teeth meet stands out.
                    qx, qy = on_tooth(wx, wy, turn)
                    state = tangency(qx, qy, root + extent, R, e, teeth)
                    # It stays where it is, so only what is left of the arm's rate bends: about the edge itself.
                    state = Tangency(state.value, -math.inf, *state[2:])
                    alpha = root + inwards * _END
                    write_contact(contact, flank, offset, pin_radius[pin], alpha - conjugate, alpha, state, theta, x)
                    contact.arm_rate -= contact.arm_rate * contact.arm_rate / (contact.gap + pin_radius[pin])
    move_to_deviations(problem, problem.deviations, theta, x, contacts, bounded)
    _keep_one_of_two(contacts, 2.0 * root_margin, theta, x)


@part
def _keep_one_of_two(contacts: Rows, apart: float, theta: float, x: float) -> None:
    """Where a pin is on the ends of two teeth that meet in a notch, the nearer alone holds it."""
    for row in range(0, contacts.shape[0], 2):
        contact, across = contacts[row], contacts[row + 1]
        if not (across.gap < math.inf and contact.gap < math.inf and is_solved_at(across, theta, x)):
            continue
        if abs(contact.foot - across.foot) < apart:
            farther = across if contact.gap <= across.gap else contact
            farther.gap, farther.foot = math.inf, math.nan


@inlined
def _stays_clear(
    contacts: Rows,
    row: int,
    flank: Flank,
    stray: float,
    root_phase: float,
    theta: float,
    x: float,
    conjugate: float,
    clear: float,
) -> bool:
    """Whether a pin that was solved elsewhere is certainly farther than `clear` from both teeth.

    At the same crank angle its gap is predicted by its rates. From another one what errors and rotation can bend it by
    is taken off; near a root how far the axis moves, which leaves half of the contacts of drives with errors unsolved
    and is 1.3 times as fast.
    """
    contact, across = contacts[row], contacts[row + 1]
    dx, since = x - contact.deviation, theta - contact.crank_angle
    bow = 0.5 * dx * dx * contact.arm_rate
    ahead = contact.gap - dx * contact.arm - bow
    if not clear < ahead < math.inf or abs(dx) > _PREDICTED or abs(bow) > 0.5 * clear:
        return False
    if since == 0.0:
        bow = 0.5 * dx * dx * across.arm_rate
        ahead = across.gap - dx * across.arm - bow
        return across.gap == math.inf or (ahead > clear and abs(bow) <= 0.5 * clear)
    nearest = min(contact.gap, across.gap)
    if not (nearest > 0.0 and contact.gap_by_crank < math.inf):
        return False
    circle_radius, teeth = flank.circle_radius, flank.teeth
    turns = teeth * conjugate / (2.0 * math.pi)
    phase = 2.0 * math.pi * abs(turns - math.floor(turns + 0.5))
    passed = abs(since) + abs(dx)
    k = flank.eccentricity * (teeth + 1) / circle_radius
    reach = stray + abs(x) * circle_radius
    if phase + passed < root_phase:
        # The distance from both teeth falls by no more than the axis moves.
        speed = circle_radius * math.sqrt((1.0 - k) ** 2 + k * (phase + passed) ** 2) / teeth + 2.0 * reach
        return nearest - abs(since) * speed - abs(dx) * circle_radius * (1.0 + k) > clear
    if across.gap < math.inf or phase < root_phase or phase < passed:
        return False
    phase -= passed
    # 1 + k² - 2k cos φ from below, and with it how fast the normal turns at most, seen from what displaces the pin.
    least = (1.0 - k) ** 2 + 4.0 * k * (phase / math.pi) ** 2
    turning = 0.5 + 1.0 / teeth + 0.5 * (1.0 - k * k) / least
    bend = reach * (turning * turning + k * (1.0 - k * k) / (least * least))
    ahead += since * contact.gap_by_crank - since * since * bend
    return ahead - abs(since * dx) * circle_radius * turning > clear


@part
def _interpolated(contacts: Rows, first: int, stride: int, slices: int, theta: float, x: float) -> bool:
    """Fill a pin's rows from five solved ones, by the parabola through three; False where the pin needs all solved."""
    last = slices - 1
    middle = 2 * last // 4
    for fifth in range(5):
        row = first + (fifth * last // 4) * stride
        if not CLEAR < contacts[row].gap < math.inf or contacts[row + 1].gap < math.inf:
            return False
    a, b, c = contacts[first], contacts[first + middle * stride], contacts[first + last * stride]
    for fifth in (1, 3):
        slice_ = fifth * last // 4
        wa, wb, wc = _parabola(slice_, middle, last)
        if abs(wa * a.gap + wb * b.gap + wc * c.gap - contacts[first + slice_ * stride].gap) > _INTERPOLATED:
            return False
    smallest = math.inf
    for slice_ in range(slices):
        if slice_ * 4 % last == 0:
            continue
        wa, wb, wc = _parabola(slice_, middle, last)
        contact, across = contacts[first + slice_ * stride], contacts[first + slice_ * stride + 1]
        contact.foot = wa * a.foot + wb * b.foot + wc * c.foot
        contact.foot_rate = wa * a.foot_rate + wb * b.foot_rate + wc * c.foot_rate
        contact.gap = wa * a.gap + wb * b.gap + wc * c.gap
        contact.arm = wa * a.arm + wb * b.arm + wc * c.arm
        contact.arm_rate = wa * a.arm_rate + wb * b.arm_rate + wc * c.arm_rate
        contact.curvature = wa * a.curvature + wb * b.curvature + wc * c.curvature
        contact.curvature_rate = wa * a.curvature_rate + wb * b.curvature_rate + wc * c.curvature_rate
        contact.gap_by_crank = wa * a.gap_by_crank + wb * b.gap_by_crank + wc * c.gap_by_crank
        contact.foot_by_crank = wa * a.foot_by_crank + wb * b.foot_by_crank + wc * c.foot_by_crank
        contact.deviation = across.deviation = x
        contact.crank_angle = across.crank_angle = theta
        across.gap, across.foot = math.inf, math.nan
        smallest = min(smallest, contact.gap)
    return smallest > CLEAR


@inlined
def _parabola(slice_: int, middle: int, last: int) -> tuple[float, float, float]:
    """Weights of the first, middle and last slice in the parabola through them."""
    return (
        (slice_ - middle) * (slice_ - last) / (middle * last),
        slice_ * (slice_ - last) / (middle * (middle - last)),
        slice_ * (slice_ - middle) / (last * (last - middle)),
    )
