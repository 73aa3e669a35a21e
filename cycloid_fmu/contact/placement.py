"""Every pin's contact at a crank angle θ and a deviation x of the output."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu.contact.compiling import compiled, inlined, part
from cycloid_fmu.contact.deviations import move_to_deviations
from cycloid_fmu.contact.foot import Tangency, foot, on_tooth, tangency
from cycloid_fmu.contact.gap import Contact, Flank, Offset, contact_at, write_contact
from cycloid_fmu.contact.lanes import LANES, Lanes, lanes_of, on_stack, sine_cosine, vectors
from cycloid_fmu.contact.problem import Deviations, Problem, poses
from cycloid_fmu.contact.rows import Rows, disc_slice_pin, is_solved_at

BOUNDED = 2e-6  # m: in an equilibrium a gap above this need not be known exactly
CLEAR = 1e-7  # m: a pin predicted to be this clear is not solved again within one equilibrium
_INTERPOLATED = 1e-9  # m: what interpolation across slices may err on a clear pin's gap
_END = 1e-9  # rad: how far inside a tooth its end is taken, so that it belongs to that tooth
_TURNED = 2e-4  # rad: a rotation beyond this is followed by solving
_NEAR_ROOT = 0.25  # rad of the crank: as far as the bound near a root reaches
_NEIGHBOUR = 0.01  # of a pitch: a foot that lies farther from its first guess is searched inside the tooth's bracket
_FEET_STEP = 1e-11  # m: Newton's last step along the flanks

SOLVED = lanes_of(
    # A pin's axis and the gear's centre in its tooth's frame, where its foot is expected and where it must be:
    "row",
    "axis_x",
    "axis_y",
    "offset_x",
    "offset_y",
    "crank_x",
    "crank_y",
    "pin_radius",
    "conjugate_point",
    "start",
    "number",
    "along",
    "turn",
    "turn_beyond",
    "circle_radius",
    "generating_radius",
    "root_phase",
    "root_radius",
    "root_margin",
    # What is found:
    *Contact._fields,
    "alpha",
    "last",
    "alone",
    # Of the pins that are clear:
    "clear_row",
    "clear_gap",
    "clear_by_crank",
    "clear_phase",
    "clear_near",
    "fall",
    "bounded_for",
)


class Disc(NamedTuple):
    """Where a disc and the pin ring are: rotations, and centres in the gear's frame."""

    shift: float  # of the conjugate points, rad
    number: int  # of the tooth that pin 0 faces
    tooth: int  # the same within one turn
    along: float  # pin 0's conjugate point on it, in pitches from its beginning
    turned_cosine: float  # of the ring in the gear's frame
    turned_sine: float
    cosine: float  # of the gear
    sine: float
    x: float  # the gear's centre, m, in the housing's frame
    y: float
    crank_x: float  # the crank's part of it, in the gear's frame
    crank_y: float


class _Tooth(NamedTuple):
    """The tooth that a pin faces, and the one across the nearest root."""

    number: float
    beyond: float
    turn: float  # rad, by pitch errors
    turn_beyond: float
    phase: float  # from the root, rad
    near: bool  # whether the pin may touch the tooth beyond as well
    root: float  # profile parameters, rad
    inwards: float  # direction from the root into the tooth
    extent: float  # where the two teeth meet, from the root
    lower: float  # ends of the tooth
    upper: float


@compiled
def place(problem: Problem, theta: float, x: float, contacts: Rows, cold: bool, clear: float, bounded: float) -> None:
    """Solve the contact of every pin at crank angle θ and deviation x, into `contacts`.

    Parameters
    ----------
    cold
        Whether to start from the conjugate points instead of from what `contacts` holds of a neighbouring state.
    clear
        Rows whose gap is certainly above this are left as they are (m; infinite: none is). A bound below the gap
        follows from the last solution (docs/theory/contact.md).
    bounded
        With deviations, rows whose gap is certainly above this get a bound below it instead of the gap itself (m;
        infinite: none does).

    Notes
    -----
    Pins that are followed from a neighbouring state are solved side by side (`lanes`), the others one by one.

    Across many slices of nominal flanks the gap of a pin is smooth: five slices are solved, and where they show that
    the pin is clear everywhere the others are interpolated.
    """
    teeth, slices = problem.teeth, problem.centre_x.size
    pins = teeth + 1
    stride = 2 * pins
    # Arrays are taken out of the tuple once: each use of it inside a loop would count their references.
    pin_x, pin_y, pin_radius, tooth_turn = problem.pin_x, problem.pin_y, problem.pin_radius, problem.tooth_turn
    centre_x, centre_y = problem.centre_x, problem.centre_y
    flank = Flank(
        problem.circle_radius, problem.generating_eccentricity, problem.generating_radius, teeth, problem.ring
    )
    rough = problem.deviations is not None
    keeps = not cold and clear < math.inf
    lever = _largest_lever(flank)
    root_radius, root_margin = around_root(flank, problem.root_margin)
    one = on_stack(SOLVED)
    filled = listed = 0
    for disc in range(problem.crank_phase.size):
        at = disc_at(problem, problem.eccentricity, theta, x, disc)
        for pin in range(pins):
            first = disc * slices * stride + 2 * pin
            end = first + slices * stride
            if keeps:
                # All slices at once: 1.2 times as fast with 100 of them.
                if _stays_clear(contacts, first, contacts[first].nearest, theta, x, clear, lever):
                    continue
                row = first
                while row < end and _stays_clear(contacts, row, contacts[row].gap, theta, x, clear, lever):
                    row += stride
                if row >= end:
                    continue
            contacts[first].nearest = 0.0
            conjugate = pin * 2.0 * math.pi / pins + at.shift
            number, along, tooth, beyond = faced(at, teeth, pin)
            px = pin_x[pin] * at.turned_cosine - pin_y[pin] * at.turned_sine
            py = pin_x[pin] * at.turned_sine + pin_y[pin] * at.turned_cosine
            five = 0 if slices < 8 or rough or (keeps and contacts[first].crank_angle == theta) else 5
            if five > 0:
                listed = _solve(problem, flank, theta, x, contacts, one, filled, listed)
                filled = 0
            before = listed
            for step in range(slices + five):
                slice_ = step - five if step >= five else step * (slices - 1) // 4
                if five > 0 and step == five:
                    listed = _solve(problem, flank, theta, x, contacts, one, filled, listed)
                    filled = 0
                    if _interpolated(contacts, first, stride, slices, theta, x):
                        break
                    listed = before  # what touches among the five is solved again with all others
                row = first + slice_ * stride
                contact = contacts[row]
                if (
                    keeps
                    and slices > 1
                    and step >= five
                    and _stays_clear(contacts, row, contact.gap, theta, x, clear, lever)
                ):
                    continue
                start = conjugate + contact.foot + contact.foot_rate * (x - contact.deviation)
                start += contact.foot_by_crank * (theta - contact.crank_angle)
                if cold:
                    listed = _solve_alone(problem, theta, x, contacts, row, cold, listed)
                    continue
                one.row[filled], one.start[filled] = row, start
                enter(one, filled, at, px, py, centre_x[slice_], centre_y[slice_], conjugate, number, along)
                one.pin_radius[filled] = pin_radius[pin]
                one.turn[filled], one.turn_beyond[filled] = tooth_turn[disc, tooth], tooth_turn[disc, beyond]
                one.circle_radius[filled], one.generating_radius[filled] = flank.circle_radius, flank.radius
                one.root_phase[filled] = problem.root_phase
                one.root_radius[filled], one.root_margin[filled] = root_radius, root_margin
                filled += 1
                if filled == LANES:
                    listed = _solve(problem, flank, theta, x, contacts, one, filled, listed)
                    filled = 0
    listed = _solve(problem, flank, theta, x, contacts, one, filled, listed)
    if listed < contacts.shape[0]:
        contacts[listed].touching = -1.0
    if rough:
        move_to_deviations(problem, problem.deviations, theta, x, contacts, bounded)
        for row in range(0, contacts.shape[0], 2):
            if is_solved_at(contacts[row], theta, x):
                _keep_one_of_two(contacts[row], contacts[row + 1], root_margin)


@inlined
def enter(
    one: Lanes,
    lane: int,
    at: Disc,
    px: float,
    py: float,
    centre_x: float,
    centre_y: float,
    conjugate: float,
    number: float,
    along: float,
) -> None:
    """Enter a pin whose axis is (px, py) in the gear's frame, of a gear whose centre is displaced, m."""
    ux, uy = at.x + centre_x, at.y + centre_y
    cx, cy = ux * at.cosine + uy * at.sine, uy * at.cosine - ux * at.sine
    one.axis_x[lane], one.axis_y[lane] = px - cx, py - cy
    one.offset_x[lane], one.offset_y[lane] = cx, cy
    one.crank_x[lane], one.crank_y[lane] = at.crank_x, at.crank_y
    one.conjugate_point[lane], one.number[lane], one.along[lane] = conjugate, number, along


@inlined
def disc_at(problem: Problem, eccentricity: float, theta: float, x: float, disc: int) -> Disc:
    """Where a disc and the pin ring are at crank angle θ and deviation x, on a crank of an eccentricity (m)."""
    crank, ring, gear = poses(problem, theta, x, disc)
    s, c = sine_cosine(gear)
    turned_sine, turned_cosine = sine_cosine(ring - gear)
    oy, ox = sine_cosine(crank)
    oy, ox = eccentricity * oy, eccentricity * ox
    teeth = problem.teeth
    shift = (crank - ring) / teeth
    pitches = shift * teeth / (2.0 * math.pi)
    number = math.floor(pitches)
    return Disc(
        shift,
        number,
        number % teeth,
        pitches - number,
        turned_cosine,
        turned_sine,
        c,
        s,
        ox + problem.shift_x[disc],
        oy + problem.shift_y[disc],
        ox * c + oy * s,
        oy * c - ox * s,
    )


@inlined
def faced(at: Disc, teeth: int, pin: int) -> tuple[int, float, int, int]:
    """Number of the tooth that a pin faces, the conjugate point along it, that tooth and the one across the root."""
    # The conjugate points of neighbouring pins are a pin's pitch apart, which is less than a tooth's.
    passed = pin / (teeth + 1.0)
    steps = pin if passed <= at.along else pin - 1
    along = at.along - passed + (0.0 if passed <= at.along else 1.0)
    tooth = _within_turn(at.tooth + steps, teeth)
    return at.number + steps, along, tooth, _within_turn(tooth - 1 if along < 0.5 else tooth + 1, teeth)


@inlined
def _within_turn(tooth: int, teeth: int) -> int:
    tooth = tooth - teeth if tooth >= teeth else tooth
    return tooth + teeth if tooth < 0 else tooth


@inlined
def _tooth_at(number: float, along: float, turn: float, turn_beyond: float, teeth: int, root_phase: float) -> _Tooth:
    """Tooth and neighbour of a pin, from its conjugate point and the turns of both."""
    pitch = 2.0 * math.pi / teeth
    before = along < 0.5
    phase = 2.0 * math.pi * (along if before else 1.0 - along)
    near = phase < root_phase
    lower, upper = number * pitch, (number + 1.0) * pitch
    # Two teeth end where they meet, midway between where pitch errors leave the root of each.
    extent = 0.5 * (turn_beyond - turn) if near else 0.0
    return _Tooth(
        number,
        number - 1.0 if before else number + 1.0,
        turn,
        turn_beyond,
        phase,
        near,
        root=lower if before else upper,
        inwards=1.0 if before else -1.0,
        extent=extent,
        lower=lower + extent if before else lower,
        upper=upper if before else upper + extent,
    )


@inlined
def around_root(flank: Flank, margin: float) -> tuple[float, float]:
    """Distance from the path within which a point near a root has one foot only (m), and the margin as a parameter."""
    R, pins = flank.circle_radius, flank.teeth + 1
    k = flank.eccentricity * pins / R
    return R * (1.0 - k) ** 2 / max(pins * k - 1.0, 1e-9) - margin, margin / (R * (1.0 - k))


@inlined
def _largest_lever(flank: Flank) -> float:
    """How far a pin's axis moves against the gear at most for each radian of the output, m."""
    return flank.circle_radius + flank.eccentricity * (flank.teeth + 1)


@inlined
def _solve(
    problem: Problem, flank: Flank, theta: float, x: float, contacts: Rows, one: Lanes, filled: int, listed: int
) -> int:
    """Solve the contacts in the lanes, write and list them; returns how many rows are listed."""
    if filled > 0:
        raised = _largest(problem.deviations)
        listed = _solve_in_lanes(
            flank,
            problem.stray,
            problem.root_phase,
            raised,
            theta,
            x,
            contacts,
            one,
            filled,
            listed,
        )
        for lane in range(filled):
            if one.alone[lane] > 0.0:
                listed = _solve_alone(problem, theta, x, contacts, int(one.row[lane]), False, listed)
    return listed


@part
def feet_in_lanes(one: Lanes, filled: int, eccentricity: float, teeth: int, ring: bool) -> None:
    """Find the feet of the pins in the lanes, and what they give, as far as lanes can: `alone` where they could not.

    What a lane gives does not depend on the others.

    Parameters
    ----------
    one
        `SOLVED`, entered by `enter`, with the flanks' radii and the root's: `around_root` and its phase.
    eccentricity, teeth, ring
        Of all flanks, as in `Flank`.
    """
    e = eccentricity
    pitch = 2.0 * math.pi / teeth
    lanes = vectors(filled)
    for lane in range(filled, lanes):
        one.axis_x[lane], one.axis_y[lane], one.start[lane] = one.axis_x[0], one.axis_y[0], one.start[0]
        one.turn[lane], one.circle_radius[lane] = one.turn[0], one.circle_radius[0]
    for lane in range(lanes):
        one.axis_x[lane], one.axis_y[lane] = on_tooth(one.axis_x[lane], one.axis_y[lane], one.turn[lane])
        one.alpha[lane], one.alone[lane], one.last[lane] = one.start[lane], 0.0, math.inf
    for _ in range(6):
        moving = 0
        for lane in range(lanes):
            state = tangency(one.axis_x[lane], one.axis_y[lane], one.alpha[lane], one.circle_radius[lane], e, teeth)
            speed2 = state.path_x * state.path_x + state.path_y * state.path_y
            step = -state.value / state.slope if one.last[lane] > _FEET_STEP * _FEET_STEP else 0.0
            one.alpha[lane] += step
            one.last[lane] = step * step * speed2
            # Where the distance is not smallest but largest, Newton's step may lead to another foot.
            one.alone[lane] = one.alone[lane] if state.slope < 0.0 else 1.0
            moving += 1 if one.last[lane] > _FEET_STEP * _FEET_STEP else 0
        if moving == 0:
            break
    for lane in range(lanes):
        R, r = one.circle_radius[lane], one.generating_radius[lane]
        flank = Flank(R, e, r, teeth, ring)
        tooth = _tooth_at(
            one.number[lane], one.along[lane], one.turn[lane], one.turn_beyond[lane], teeth, one.root_phase[lane]
        )
        alpha, start = one.alpha[lane], one.start[lane]
        state = tangency(one.axis_x[lane], one.axis_y[lane], alpha, R, e, teeth)
        speed = math.sqrt(state.path_x * state.path_x + state.path_y * state.path_y)
        distance = (state.apart_x * state.path_x + state.apart_y * state.path_y) / speed
        converged = (state.slope < 0.0) & (abs(state.value) * speed < -_FEET_STEP * state.slope)
        begun = (tooth.lower <= start) & (start <= tooth.upper)
        beside = (abs(alpha - start) < _NEIGHBOUR * pitch) & (tooth.lower <= alpha) & (alpha <= tooth.upper)
        # Within the root's curvature radius a point has one foot only, so none on the other tooth, unless the foot is
        # so close to the root that the step between the two teeth decides.
        beyond_step = abs(alpha - tooth.root) > one.root_margin[lane]
        single = (not tooth.near) | ((distance < one.root_radius[lane]) & beyond_step)
        one.alone[lane] = one.alone[lane] if converged & begun & beside & single else 1.0
        alpha = min(max(alpha, one.number[lane] * pitch + _END), (one.number[lane] + 1.0) * pitch - _END)
        offset = Offset(one.offset_x[lane], one.offset_y[lane], one.crank_x[lane], one.crank_y[lane])
        found = contact_at(flank, offset, one.pin_radius[lane], alpha - one.conjugate_point[lane], alpha, state)
        one.foot[lane], one.place[lane], one.foot_rate[lane] = found.foot, found.place, found.foot_rate
        one.gap[lane], one.arm[lane], one.arm_rate[lane] = found.gap, found.arm, found.arm_rate
        one.curvature[lane], one.curvature_rate[lane] = found.curvature, found.curvature_rate
        one.gap_by_crank[lane], one.foot_by_crank[lane] = found.gap_by_crank, found.foot_by_crank


@part
def _solve_in_lanes(
    flank: Flank,
    stray: float,
    root_phase: float,
    raised: float,
    theta: float,
    x: float,
    contacts: Rows,
    one: Lanes,
    filled: int,
    listed: int,
) -> int:
    """Solve the contacts in the lanes as far as these can, write and list them."""
    teeth = flank.teeth
    feet_in_lanes(one, filled, flank.eccentricity, teeth, flank.ring)
    clear = 0
    for lane in range(filled):
        if one.alone[lane] > 0.0:
            continue
        row = int(one.row[lane])
        contact, across = contacts[row], contacts[row + 1]
        found = Contact(
            one.foot[lane],
            one.place[lane],
            one.foot_rate[lane],
            one.gap[lane],
            one.arm[lane],
            one.arm_rate[lane],
            one.curvature[lane],
            one.curvature_rate[lane],
            one.gap_by_crank[lane],
            one.foot_by_crank[lane],
        )
        write_contact(contact, found, theta, x)
        across.crank_angle, across.deviation, across.gap, across.foot = theta, x, math.inf, math.nan
        listed = _list(contacts, row, raised, listed)
        contact.bounded_for = 0.0
        if found.gap - raised > CLEAR:
            tooth = _tooth_at(one.number[lane], one.along[lane], 0.0, 0.0, teeth, root_phase)
            one.clear_row[clear], one.clear_gap[clear] = row, found.gap - raised
            one.clear_by_crank[clear], one.clear_phase[clear] = found.gap_by_crank, tooth.phase
            one.clear_near[clear] = 1.0 if tooth.near else 0.0
            clear += 1
    if clear == 0:
        return listed
    for lane in range(clear, vectors(clear)):
        one.clear_gap[lane] = one.clear_by_crank[lane] = one.clear_phase[lane] = one.clear_near[lane] = 0.0
    for lane in range(vectors(clear)):
        one.fall[lane], one.bounded_for[lane] = _bound(
            one.clear_gap[lane],
            one.clear_by_crank[lane],
            one.clear_phase[lane],
            one.clear_near[lane] > 0.0,
            x,
            flank,
            stray,
        )
    for lane in range(clear):
        contact = contacts[int(one.clear_row[lane])]
        contact.fall, contact.bounded_for = one.fall[lane], one.bounded_for[lane]
    return listed


@inlined
def _largest(deviations: Deviations | None) -> float:
    if deviations is None:
        return 0.0
    return deviations.largest


@inlined
def _list(contacts: Rows, row: int, raised: float, listed: int) -> int:
    """List what may touch of a pin's two rows; the others carry nothing."""
    for either in range(row, row + 2):
        if contacts[either].gap - raised <= CLEAR:
            contacts[listed].touching = either
            listed += 1
        else:
            contacts[either].force = contacts[either].stiffness = 0.0
    return listed


@part
def _solve_alone(problem: Problem, theta: float, x: float, contacts: Rows, row: int, cold: bool, listed: int) -> int:
    """Solve one pin in one slice on both teeth that it may touch, write and list it."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    R, e, teeth, pin_radius = problem.circle_radius, problem.generating_eccentricity, problem.teeth, problem.pin_radius
    pitch = 2.0 * math.pi / teeth
    flank = Flank(R, e, problem.generating_radius, teeth, problem.ring)
    root_radius, root_margin = around_root(flank, problem.root_margin)
    at = disc_at(problem, problem.eccentricity, theta, x, disc)
    conjugate = pin * 2.0 * math.pi / (teeth + 1) + at.shift
    number, along, facing, beyond = faced(at, teeth, pin)
    turns = problem.tooth_turn[disc]
    tooth = _tooth_at(number, along, turns[facing], turns[beyond], teeth, problem.root_phase)
    near, root, inwards, extent = tooth.near, tooth.root, tooth.inwards, tooth.extent
    px = problem.pin_x[pin] * at.turned_cosine - problem.pin_y[pin] * at.turned_sine
    py = problem.pin_x[pin] * at.turned_sine + problem.pin_y[pin] * at.turned_cosine
    ux, uy = at.x + problem.centre_x[slice_], at.y + problem.centre_y[slice_]
    cx, cy = ux * at.cosine + uy * at.sine, uy * at.cosine - ux * at.sine
    wx, wy = px - cx, py - cy
    offset = Offset(cx, cy, at.crank_x, at.crank_y)
    contact, across = contacts[row], contacts[row + 1]
    qx, qy = on_tooth(wx, wy, tooth.turn)
    start = conjugate + contact.foot + contact.foot_rate * (x - contact.deviation)
    start += contact.foot_by_crank * (theta - contact.crank_angle)
    if cold or not tooth.lower <= start <= tooth.upper:
        # Near a root the way downhill from the conjugate point may miss the contact farther in.
        start = root + inwards * problem.root_phase / teeth if near else conjugate
    found, alpha, state = foot(qx, qy, start, tooth.lower, tooth.upper, R, e, teeth)
    distance = math.inf
    start_beyond = conjugate + across.foot
    contact.deviation = across.deviation = x
    contact.crank_angle = across.crank_angle = theta
    contact.gap = across.gap = math.inf
    contact.foot = across.foot = math.nan
    contact.gap_by_crank = 0.0
    if found:
        bx, by = state.path_x, state.path_y
        distance = (state.apart_x * bx + state.apart_y * by) / math.sqrt(bx * bx + by * by)
        alpha = min(max(alpha, tooth.number * pitch + _END), (tooth.number + 1.0) * pitch - _END)
        write_contact(contact, contact_at(flank, offset, pin_radius[pin], alpha - conjugate, alpha, state), theta, x)
    # As in `_solve`.
    if near and not (distance < root_radius and abs(alpha - root) > root_margin):
        left, right = tooth.beyond * pitch, (tooth.beyond + 1.0) * pitch
        left, right = (left, right - extent) if inwards > 0.0 else (left - extent, right)
        if cold or not left < start_beyond < right:
            start_beyond = root - inwards * problem.root_phase / teeth
        qx, qy = on_tooth(wx, wy, tooth.turn_beyond)
        found, alpha, state = foot(qx, qy, start_beyond, left, right, R, e, teeth)
        if found and left < alpha < right:
            alpha = min(max(alpha, tooth.beyond * pitch + _END), (tooth.beyond + 1.0) * pitch - _END)
            found_beyond = contact_at(flank, offset, pin_radius[pin], alpha - conjugate, alpha, state)
            write_contact(across, found_beyond, theta, x)
        elif contact.gap == math.inf:
            # The edge where the two teeth meet stands out.
            qx, qy = on_tooth(wx, wy, tooth.turn)
            state = tangency(qx, qy, root + extent, R, e, teeth)
            # It stays where it is, so only what is left of the arm's rate bends: about the edge itself.
            state = Tangency(state.value, -math.inf, *state[2:])
            alpha = root + inwards * _END
            edge = contact_at(flank, offset, pin_radius[pin], alpha - conjugate, alpha, state)
            write_contact(contact, edge, theta, x)
            contact.arm_rate -= contact.arm_rate * contact.arm_rate / (contact.gap + pin_radius[pin])
    raised = _largest(problem.deviations)
    if problem.deviations is None:
        _keep_one_of_two(contact, across, root_margin)
    nearest = min(contact.gap, across.gap)
    contact.fall, contact.bounded_for = _bound(
        nearest - raised, contact.gap_by_crank, tooth.phase, near or across.gap < math.inf, x, flank, problem.stray
    )
    return _list(contacts, row, raised, listed)


@inlined
def _keep_one_of_two(contact: np.record, across: np.record, root_margin: float) -> None:
    """Where a pin is on the ends of two teeth that meet in a notch, the nearer alone holds it."""
    if across.gap < math.inf and contact.gap < math.inf and abs(contact.foot - across.foot) < 2.0 * root_margin:
        if contact.gap <= across.gap:
            across.gap, across.foot = math.inf, math.nan
        else:
            contact.gap, contact.foot = math.inf, math.nan


@inlined
def _bound(
    gap: float, gap_by_crank: float, phase: float, near: bool, x: float, flank: Flank, stray: float
) -> tuple[float, float]:
    """How fast a pin's gap falls at most with the crank (m/rad), and up to which crank angle either way (rad).

    The crank may take half of the gap, the rotation of the output the other half (docs/theory/contact.md).
    """
    R, teeth, lever = flank.circle_radius, flank.teeth, _largest_lever(flank)
    k = lever / R - 1.0
    gap = max(gap, 0.0)
    spare = 0.5 * max(gap - CLEAR, 0.0)
    turned = min(gap / lever, _TURNED)
    reach = stray + (abs(x) + turned) * R
    # Near a root the gap falls by no more than the axis moves.
    ahead = phase + _NEAR_ROOT
    speed = R * math.sqrt((1.0 - k) * (1.0 - k) + k * ahead * ahead) / teeth + 2.0 * reach
    by_speed = min(spare / speed, _NEAR_ROOT)
    # Elsewhere it falls at its rate, which what displaces the pin can bend: 1 + k² - 2k cos φ from below, and with it
    # how fast the normal turns at most.
    passed = 0.5 * phase
    ahead = max(phase - passed - turned, 0.0) / math.pi
    least = (1.0 - k) * (1.0 - k) + 4.0 * k * ahead * ahead
    turning = 0.5 + 1.0 / teeth + 0.5 * (1.0 - k * k) / least
    bend = reach * (turning * turning + k * (1.0 - k * k) / (least * least))
    rate = abs(gap_by_crank) + turned * R * turning + 1e-12
    by_rate = min(2.0 * spare / (rate + math.sqrt(rate * rate + 4.0 * bend * spare)), passed)
    fall, bounded_for = (speed, by_speed) if near else (rate + by_rate * bend, by_rate)
    return fall, bounded_for


@inlined
def _stays_clear(contacts: Rows, row: int, gap: float, theta: float, x: float, clear: float, lever: float) -> bool:
    """Whether a pin whose gap was solved elsewhere is certainly farther than `clear` from both teeth."""
    contact, across = contacts[row], contacts[row + 1]
    since, turned = abs(theta - contact.crank_angle), abs(x - contact.deviation)
    if since > contact.bounded_for or turned > _TURNED:
        return False
    # From where a row is, `to_touch` predicts it to second order: beside an edge that may err far more than the bound.
    bend = abs(contact.arm_rate)
    if across.gap < math.inf:
        bend = max(bend, abs(across.arm_rate))
    if turned * turned * bend > clear:
        return False
    return clear < min(gap, across.gap) - since * contact.fall - turned * lever < math.inf


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
    fall, bounded_for = 0.0, math.inf
    smallest, rate = math.inf, 0.0
    for fifth in range(5):
        solved = contacts[first + (fifth * last // 4) * stride]
        fall, bounded_for = max(fall, solved.fall), min(bounded_for, solved.bounded_for)
        smallest, rate = min(smallest, solved.gap), max(rate, abs(solved.arm_rate))
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
        contact.force = contact.stiffness = across.force = across.stiffness = 0.0
        contact.fall, contact.bounded_for = fall, bounded_for
        smallest = min(smallest, contact.gap)
    if smallest > CLEAR and 2.0 * rate * _TURNED * _TURNED < CLEAR:
        a.fall, a.bounded_for, a.nearest = fall, bounded_for, smallest
    return smallest > CLEAR


@inlined
def _parabola(slice_: int, middle: int, last: int) -> tuple[float, float, float]:
    """Weights of the first, middle and last slice in the parabola through them."""
    return (
        (slice_ - middle) * (slice_ - last) / (middle * last),
        slice_ * (slice_ - last) / (middle * (middle - last)),
        slice_ * (slice_ - middle) / (last * (last - middle)),
    )
