"""Every pin's contact at a crank angle θ and a transmission error x."""

from __future__ import annotations

import math

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.deviations import move_to_deviations
from cycloid_fmu.contact.foot import Tangency, foot, on_tooth, tangency
from cycloid_fmu.contact.gap import Contact, Flank, contact_at, offset_on_tooth, write_contact
from cycloid_fmu.contact.lanes import LANES, Lanes, lanes_of, on_stack, vectors
from cycloid_fmu.contact.pose import (
    DiscPose,
    PinAxis,
    around_root,
    conjugate_point,
    disc_pose,
    faced_tooth,
    pin_axis,
    tooth_ends,
)
from cycloid_fmu.contact.problem import Deviations, Problem
from cycloid_fmu.contact.rows import Rows, disc_slice_pin, is_solved_at

BOUNDED = 2e-6  # m: in an equilibrium a gap above this need not be known exactly
CLEAR = 1e-7  # m: a pin predicted to be this clear is not solved again within one equilibrium
_INTERPOLATED = 1e-9  # m: what interpolation across slices may err on a clear pin's gap
_END = 1e-9  # rad: how far inside a tooth its end is taken, so that it belongs to that tooth
_TURNED = 2e-4  # rad: a rotation beyond this is followed by solving
_NEAR_ROOT = 0.25  # rad of the crank: as far as the bound near a root reaches
_NEIGHBOUR = 0.01  # of a pitch: a foot that lies farther from its first guess is searched inside the tooth's bracket
_FEET_STEP = 1e-11  # m: Newton's last step along the flanks

PLACED = lanes_of(
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
    # What they give:
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
    numbers=("filled", "listed"),
)


@compiled
def place_contacts(
    problem: Problem, crank_angle: float, x: float, contacts: Rows, cold: bool, clear: float, bounded: float
) -> None:
    """Solve the contact of every pin at a crank angle and a transmission error x, into `contacts`.

    The steps have the headings of docs/theory/contact.md: pins that stay clear are left; the others are placed by the
    foot of their axis and what it gives, side by side (`feet_in_lanes`) or alone, where there may be two teeth at a
    root; then elements and their deviations move contacts along the flank.

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
    Across many slices of nominal flanks the gap of a pin is smooth: five slices are solved, and where they show that
    the pin is clear everywhere the others are interpolated.
    """
    slices, pins = problem.centre_x.size, problem.teeth + 1
    stride = 2 * pins
    flank = flank_of(problem)
    rough = problem.deviations is not None
    follows = not cold and clear < math.inf
    lever = _largest_lever(flank)
    group = on_stack(PLACED)
    for disc in range(problem.crank_phase.size):
        pose = disc_pose(problem, problem.eccentricity, crank_angle, x, disc)
        for pin in range(pins):
            first = disc * slices * stride + 2 * pin
            if follows:
                # All slices at once: 1.2 times as fast with 100 of them.
                if _stays_clear(contacts, first, contacts[first].nearest, crank_angle, x, clear, lever):
                    continue
                row, end = first, first + slices * stride
                while row < end and _stays_clear(contacts, row, contacts[row].gap, crank_angle, x, clear, lever):
                    row += stride
                if row >= end:
                    continue
            contacts[first].nearest = 0.0
            interpolates = slices >= 8 and not rough and not (follows and contacts[first].crank_angle == crank_angle)
            if interpolates:
                _solve_group(problem, flank, crank_angle, x, contacts, group)
                listed = group.listed
                for fifth in range(5):
                    slice_ = fifth * (slices - 1) // 4
                    _place_pin(problem, flank, pose, disc, slice_, pin, crank_angle, x, contacts, cold, group)
                _solve_group(problem, flank, crank_angle, x, contacts, group)
                if _interpolated(contacts, first, stride, slices, crank_angle, x):
                    continue
                group.listed = listed  # what touches among the five is solved again with all others
            for slice_ in range(slices):
                row = first + slice_ * stride
                if (
                    follows
                    and slices > 1
                    and _stays_clear(contacts, row, contacts[row].gap, crank_angle, x, clear, lever)
                ):
                    continue
                _place_pin(problem, flank, pose, disc, slice_, pin, crank_angle, x, contacts, cold, group)
    _solve_group(problem, flank, crank_angle, x, contacts, group)
    if group.listed < contacts.shape[0]:
        contacts[group.listed].touching = -1.0
    if rough:
        move_to_deviations(problem, problem.deviations, crank_angle, x, contacts, bounded)
        for row in range(0, contacts.shape[0], 2):
            if is_solved_at(contacts[row], crank_angle, x):
                _hold_by_nearer(contacts[row], contacts[row + 1], around_root(flank, problem.root_margin)[1])


@compiled(inline=True)
def flank_of(problem: Problem) -> Flank:
    """Return what all flanks of a problem are made by."""
    return Flank(
        problem.circle_radius,
        problem.generating_eccentricity,
        problem.generating_radius,
        problem.teeth,
        problem.ring,
    )


@compiled(inline=True)
def _place_pin(
    problem: Problem,
    flank: Flank,
    pose: DiscPose,
    disc: int,
    slice_: int,
    pin: int,
    crank_angle: float,
    x: float,
    contacts: Rows,
    cold: bool,
    group: Lanes,
) -> None:
    """Put a pin in one slice into the group, which is solved when it is full; solve it alone if `cold`."""
    row = ((disc * problem.centre_x.size + slice_) * problem.pin_x.size + pin) * 2
    if cold:
        _solve_alone(problem, crank_angle, x, contacts, row, cold, group)
        return
    contact, lane = contacts[row], group.filled
    start = (
        conjugate_point(pose, problem.teeth, pin) + contact.foot + contact.foot_rate * (x - contact.transmission_error)
    )
    group.row[lane] = row
    group.start[lane] = start + contact.foot_by_crank * (crank_angle - contact.crank_angle)
    axis = pin_axis(pose, problem.pin_x[pin], problem.pin_y[pin], problem.centre_x[slice_], problem.centre_y[slice_])
    enter(group, pose, axis, problem.tooth_turn[disc], problem.teeth, pin)
    group.pin_radius[lane] = problem.pin_radius[pin]
    enter_flank(group, lane, flank, problem.root_phase, problem.root_margin)
    if group.filled == LANES:
        _solve_group(problem, flank, crank_angle, x, contacts, group)


@compiled(inline=True)
def enter(group: Lanes, pose: DiscPose, axis: PinAxis, turns: Array, teeth: int, pin: int) -> None:
    """Put a pin's axis and the tooth that it faces, of a disc with tooth turns (rad), into the next lane."""
    lane, facing = group.filled, faced_tooth(pose, teeth, pin)
    group.axis_x[lane], group.axis_y[lane] = axis.x, axis.y
    group.offset_x[lane], group.offset_y[lane] = axis.centre_x, axis.centre_y
    group.crank_x[lane], group.crank_y[lane] = pose.crank_x, pose.crank_y
    group.conjugate_point[lane] = conjugate_point(pose, teeth, pin)
    group.number[lane], group.along[lane] = facing.number, facing.along
    group.turn[lane], group.turn_beyond[lane] = turns[facing.tooth], turns[facing.beyond]
    group.filled = lane + 1


@compiled(inline=True)
def enter_flank(group: Lanes, lane: int, flank: Flank, root_phase: float, margin: float) -> None:
    """Put the radii of a flank, and those of its roots, into a lane."""
    group.circle_radius[lane], group.generating_radius[lane] = flank.circle_radius, flank.radius
    group.root_phase[lane] = root_phase
    group.root_radius[lane], group.root_margin[lane] = around_root(flank, margin)


@compiled(inline=True)
def _largest_lever(flank: Flank) -> float:
    """How far a pin's axis moves against the gear at most for each radian of the output, m."""
    return flank.circle_radius + flank.eccentricity * (flank.teeth + 1)


@compiled(inline=True)
def _solve_group(problem: Problem, flank: Flank, crank_angle: float, x: float, contacts: Rows, group: Lanes) -> None:
    """Solve the contacts in the lanes, write and list them, and empty the group."""
    if group.filled > 0:
        raised = _largest(problem.deviations)
        _solve_in_lanes(flank, problem.stray, problem.root_phase, raised, crank_angle, x, contacts, group)
        for lane in range(group.filled):
            if group.alone[lane] > 0.0:
                _solve_alone(problem, crank_angle, x, contacts, int(group.row[lane]), False, group)
        group.filled = 0


@compiled
def feet_in_lanes(group: Lanes, eccentricity: float, teeth: int, ring: bool) -> None:
    """Find the feet of the pins in the lanes, and what they give, as far as lanes can: `alone` where they could not.

    What a lane gives does not depend on the others.

    Parameters
    ----------
    group
        `PLACED`, filled by `enter` and `enter_flank`, with the pins' radii and where each foot is expected.
    eccentricity, teeth, ring
        Of all flanks, as in `Flank`.
    """
    e, filled = eccentricity, group.filled
    pitch = 2.0 * math.pi / teeth
    lanes = vectors(filled)
    for lane in range(filled, lanes):
        group.axis_x[lane], group.axis_y[lane], group.start[lane] = group.axis_x[0], group.axis_y[0], group.start[0]
        group.turn[lane], group.circle_radius[lane] = group.turn[0], group.circle_radius[0]
    for lane in range(lanes):
        group.axis_x[lane], group.axis_y[lane] = on_tooth(group.axis_x[lane], group.axis_y[lane], group.turn[lane])
        group.alpha[lane], group.alone[lane], group.last[lane] = group.start[lane], 0.0, math.inf
    for _ in range(6):
        moving = 0
        for lane in range(lanes):
            state = tangency(
                group.axis_x[lane], group.axis_y[lane], group.alpha[lane], group.circle_radius[lane], e, teeth
            )
            speed2 = state.path_x * state.path_x + state.path_y * state.path_y
            step = -state.value / state.slope if group.last[lane] > _FEET_STEP * _FEET_STEP else 0.0
            group.alpha[lane] += step
            group.last[lane] = step * step * speed2
            # Where the distance is not smallest but largest, Newton's step may lead to another foot.
            group.alone[lane] = group.alone[lane] if state.slope < 0.0 else 1.0
            moving += 1 if group.last[lane] > _FEET_STEP * _FEET_STEP else 0
        if moving == 0:
            break
    for lane in range(lanes):
        R, r = group.circle_radius[lane], group.generating_radius[lane]
        flank = Flank(R, e, r, teeth, ring)
        tooth = tooth_ends(
            group.number[lane],
            group.along[lane],
            group.turn[lane],
            group.turn_beyond[lane],
            teeth,
            group.root_phase[lane],
        )
        alpha, start = group.alpha[lane], group.start[lane]
        state = tangency(group.axis_x[lane], group.axis_y[lane], alpha, R, e, teeth)
        speed = math.sqrt(state.path_x * state.path_x + state.path_y * state.path_y)
        distance = (state.apart_x * state.path_x + state.apart_y * state.path_y) / speed
        converged = (state.slope < 0.0) & (abs(state.value) * speed < -_FEET_STEP * state.slope)
        inside = (tooth.lower <= start) & (start <= tooth.upper)
        near_start = (abs(alpha - start) < _NEIGHBOUR * pitch) & (tooth.lower <= alpha) & (alpha <= tooth.upper)
        # Within the root's curvature radius a point has one foot only, so none on the other tooth, unless the foot is
        # so close to the root that the step between the two teeth decides.
        beyond_step = abs(alpha - tooth.root) > group.root_margin[lane]
        single = (not tooth.near) | ((distance < group.root_radius[lane]) & beyond_step)
        group.alone[lane] = group.alone[lane] if converged & inside & near_start & single else 1.0
        alpha = min(max(alpha, group.number[lane] * pitch + _END), (group.number[lane] + 1.0) * pitch - _END)
        offset = offset_on_tooth(
            group.offset_x[lane], group.offset_y[lane], group.crank_x[lane], group.crank_y[lane], group.turn[lane]
        )
        solved = contact_at(flank, offset, group.pin_radius[lane], alpha - group.conjugate_point[lane], alpha, state)
        group.foot[lane], group.profile_parameter[lane], group.foot_rate[lane] = (
            solved.foot,
            solved.profile_parameter,
            solved.foot_rate,
        )
        group.gap[lane], group.arm[lane], group.arm_rate[lane] = solved.gap, solved.arm, solved.arm_rate
        group.curvature[lane], group.curvature_rate[lane] = solved.curvature, solved.curvature_rate
        group.gap_by_crank[lane], group.foot_by_crank[lane] = solved.gap_by_crank, solved.foot_by_crank


@compiled(inline=True)
def solved_in(group: Lanes, lane: int) -> Contact:
    """Return what the foot in a lane gives."""
    return Contact(
        group.foot[lane],
        group.profile_parameter[lane],
        group.foot_rate[lane],
        group.gap[lane],
        group.arm[lane],
        group.arm_rate[lane],
        group.curvature[lane],
        group.curvature_rate[lane],
        group.gap_by_crank[lane],
        group.foot_by_crank[lane],
    )


@compiled
def _solve_in_lanes(
    flank: Flank,
    stray: float,
    root_phase: float,
    raised: float,
    crank_angle: float,
    x: float,
    contacts: Rows,
    group: Lanes,
) -> None:
    """Solve the contacts in the lanes as far as these can, write and list them."""
    teeth, filled = flank.teeth, group.filled
    feet_in_lanes(group, flank.eccentricity, teeth, flank.ring)
    clear = 0
    for lane in range(filled):
        if group.alone[lane] > 0.0:
            continue
        row = int(group.row[lane])
        contact, across = contacts[row], contacts[row + 1]
        solved = solved_in(group, lane)
        write_contact(contact, solved, crank_angle, x)
        across.crank_angle, across.transmission_error, across.gap, across.foot = crank_angle, x, math.inf, math.nan
        _list_touching(contacts, row, raised, group)
        contact.bounded_for = 0.0
        if solved.gap - raised > CLEAR:
            tooth = tooth_ends(group.number[lane], group.along[lane], 0.0, 0.0, teeth, root_phase)
            group.clear_row[clear], group.clear_gap[clear] = row, solved.gap - raised
            group.clear_by_crank[clear], group.clear_phase[clear] = solved.gap_by_crank, tooth.phase
            group.clear_near[clear] = 1.0 if tooth.near else 0.0
            clear += 1
    if clear == 0:
        return
    for lane in range(clear, vectors(clear)):
        group.clear_gap[lane] = group.clear_by_crank[lane] = group.clear_phase[lane] = group.clear_near[lane] = 0.0
    for lane in range(vectors(clear)):
        group.fall[lane], group.bounded_for[lane] = _bound(
            group.clear_gap[lane],
            group.clear_by_crank[lane],
            group.clear_phase[lane],
            group.clear_near[lane] > 0.0,
            x,
            flank,
            stray,
        )
    for lane in range(clear):
        contact = contacts[int(group.clear_row[lane])]
        contact.fall, contact.bounded_for = group.fall[lane], group.bounded_for[lane]


@compiled
def _largest(deviations: Deviations | None) -> float:
    if deviations is None:
        return 0.0
    return deviations.largest


@compiled(inline=True)
def _list_touching(contacts: Rows, row: int, raised: float, group: Lanes) -> None:
    """List what may touch of a pin's two rows; the others carry nothing."""
    for either in range(row, row + 2):
        if contacts[either].gap - raised <= CLEAR:
            contacts[group.listed].touching = either
            group.listed += 1
        else:
            contacts[either].force = contacts[either].stiffness = 0.0


@compiled
def _solve_alone(
    problem: Problem, crank_angle: float, x: float, contacts: Rows, row: int, cold: bool, group: Lanes
) -> None:
    """Solve one pin in one slice on both teeth that it may touch, write and list it."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    R, e, teeth, pin_radius = problem.circle_radius, problem.generating_eccentricity, problem.teeth, problem.pin_radius
    pitch = 2.0 * math.pi / teeth
    flank = flank_of(problem)
    root_radius, root_margin = around_root(flank, problem.root_margin)
    pose = disc_pose(problem, problem.eccentricity, crank_angle, x, disc)
    conjugate, facing = conjugate_point(pose, teeth, pin), faced_tooth(pose, teeth, pin)
    turns = problem.tooth_turn[disc]
    tooth = tooth_ends(
        facing.number, facing.along, turns[facing.tooth], turns[facing.beyond], teeth, problem.root_phase
    )
    near, root, inwards, extent = tooth.near, tooth.root, tooth.inwards, tooth.extent
    axis = pin_axis(pose, problem.pin_x[pin], problem.pin_y[pin], problem.centre_x[slice_], problem.centre_y[slice_])
    offset = offset_on_tooth(axis.centre_x, axis.centre_y, pose.crank_x, pose.crank_y, tooth.turn)
    contact, across = contacts[row], contacts[row + 1]
    qx, qy = on_tooth(axis.x, axis.y, tooth.turn)
    start = conjugate + contact.foot + contact.foot_rate * (x - contact.transmission_error)
    start += contact.foot_by_crank * (crank_angle - contact.crank_angle)
    if cold or not tooth.lower <= start <= tooth.upper:
        # Near a root the way downhill from the conjugate point may miss the contact farther in.
        start = root + inwards * problem.root_phase / teeth if near else conjugate
    has_foot, alpha, state = foot(qx, qy, start, tooth.lower, tooth.upper, R, e, teeth)
    distance = math.inf
    start_beyond = conjugate + across.foot
    contact.transmission_error = across.transmission_error = x
    contact.crank_angle = across.crank_angle = crank_angle
    contact.gap = across.gap = math.inf
    contact.foot = across.foot = math.nan
    contact.gap_by_crank = 0.0
    if has_foot:
        bx, by = state.path_x, state.path_y
        distance = (state.apart_x * bx + state.apart_y * by) / math.sqrt(bx * bx + by * by)
        alpha = min(max(alpha, tooth.number * pitch + _END), (tooth.number + 1.0) * pitch - _END)
        write_contact(
            contact, contact_at(flank, offset, pin_radius[pin], alpha - conjugate, alpha, state), crank_angle, x
        )
    # As in `feet_in_lanes`.
    if near and not (distance < root_radius and abs(alpha - root) > root_margin):
        lower, upper = tooth.beyond * pitch, (tooth.beyond + 1.0) * pitch
        lower, upper = (lower, upper - extent) if inwards > 0.0 else (lower - extent, upper)
        if cold or not lower < start_beyond < upper:
            start_beyond = root - inwards * problem.root_phase / teeth
        qx, qy = on_tooth(axis.x, axis.y, tooth.turn_beyond)
        has_foot, alpha, state = foot(qx, qy, start_beyond, lower, upper, R, e, teeth)
        if has_foot and lower < alpha < upper:
            alpha = min(max(alpha, tooth.beyond * pitch + _END), (tooth.beyond + 1.0) * pitch - _END)
            beyond = offset_on_tooth(axis.centre_x, axis.centre_y, pose.crank_x, pose.crank_y, tooth.turn_beyond)
            contact_beyond = contact_at(flank, beyond, pin_radius[pin], alpha - conjugate, alpha, state)
            write_contact(across, contact_beyond, crank_angle, x)
        elif contact.gap == math.inf:
            # The edge where the two teeth meet stands out.
            qx, qy = on_tooth(axis.x, axis.y, tooth.turn)
            state = tangency(qx, qy, root + extent, R, e, teeth)
            # It stays where it is, so only the rest of the arm's rate bends: about the edge itself.
            state = Tangency(state.value, -math.inf, *state[2:])
            alpha = root + inwards * _END
            edge = contact_at(flank, offset, pin_radius[pin], alpha - conjugate, alpha, state)
            write_contact(contact, edge, crank_angle, x)
            contact.arm_rate -= contact.arm_rate * contact.arm_rate / (contact.gap + pin_radius[pin])
    raised = _largest(problem.deviations)
    if problem.deviations is None:
        _hold_by_nearer(contact, across, root_margin)
    nearest = min(contact.gap, across.gap)
    contact.fall, contact.bounded_for = _bound(
        nearest - raised, contact.gap_by_crank, tooth.phase, near or across.gap < math.inf, x, flank, problem.stray
    )
    _list_touching(contacts, row, raised, group)


@compiled
def _hold_by_nearer(contact: np.record, across: np.record, root_margin: float) -> None:
    """Where a pin is on the ends of two teeth that meet in a notch, the nearer alone holds it."""
    if across.gap < math.inf and contact.gap < math.inf and abs(contact.foot - across.foot) < 2.0 * root_margin:
        if contact.gap <= across.gap:
            across.gap, across.foot = math.inf, math.nan
        else:
            contact.gap, contact.foot = math.inf, math.nan


@compiled(inline=True)
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


@compiled(inline=True)
def _stays_clear(
    contacts: Rows, row: int, gap: float, crank_angle: float, x: float, clear: float, lever: float
) -> bool:
    """Whether a pin whose gap was solved elsewhere is certainly farther than `clear` from both teeth."""
    contact, across = contacts[row], contacts[row + 1]
    since, turned = abs(crank_angle - contact.crank_angle), abs(x - contact.transmission_error)
    if since > contact.bounded_for or turned > _TURNED:
        return False
    # From where a row is, `to_touch` predicts it to second order: beside an edge that may err far more than the bound.
    bend = abs(contact.arm_rate)
    if across.gap < math.inf:
        bend = max(bend, abs(across.arm_rate))
    if turned * turned * bend > clear:
        return False
    return clear < min(gap, across.gap) - since * contact.fall - turned * lever < math.inf


@compiled
def _interpolated(contacts: Rows, first: int, stride: int, slices: int, crank_angle: float, x: float) -> bool:
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
        contact.transmission_error = across.transmission_error = x
        contact.crank_angle = across.crank_angle = crank_angle
        across.gap, across.foot = math.inf, math.nan
        contact.force = contact.stiffness = across.force = across.stiffness = 0.0
        contact.fall, contact.bounded_for = fall, bounded_for
        smallest = min(smallest, contact.gap)
    if smallest > CLEAR and 2.0 * rate * _TURNED * _TURNED < CLEAR:
        a.fall, a.bounded_for, a.nearest = fall, bounded_for, smallest
    return smallest > CLEAR


@compiled
def _parabola(slice_: int, middle: int, last: int) -> tuple[float, float, float]:
    """Weights of the first, middle and last slice in the parabola through them."""
    return (
        (slice_ - middle) * (slice_ - last) / (middle * last),
        slice_ * (slice_ - last) / (middle * (middle - last)),
        slice_ * (slice_ - middle) / (last * (last - middle)),
    )
