"""Kernels of many drives near one that is solved: their contacts and forces go through vector registers together.

The drive that is solved tells at each crank angle how far the pins of a drive near it are from their flanks: to first
order in the errors' displacements, and how much second order can be. Pins that are clear for certain are left out, so
that few contacts are solved: five of 40. What is solved is exact; the solved drive only says what need not be
solved, and where to begin. What a drive gives does not depend on the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.equilibrium import (
    LINEAR_STEP,
    by_rates,
    follow,
    rotational_stiffness,
    touched_after,
    write_pressed,
)
from cycloid_fmu.contact.gap import Flank, write_contact
from cycloid_fmu.contact.hertz import APPROACHED, hertz_in_lanes
from cycloid_fmu.contact.lanes import LANES, lanes_of, on_stack, record_of, vectors
from cycloid_fmu.contact.local_frame import gap_gradient, local_frame
from cycloid_fmu.contact.placement import PLACED, enter, enter_flank, feet_in_lanes, place_contacts, solved_in
from cycloid_fmu.contact.play import ROTATION_STEP
from cycloid_fmu.contact.pose import conjugate_point, disc_pose, pin_axis
from cycloid_fmu.contact.problem import Drives, Problem
from cycloid_fmu.contact.rows import ROW, Rows, contact_rows
from cycloid_fmu.contact.sensitivity import (
    BODY_COUNT,
    CENTRE_X,
    CENTRE_Y,
    CIRCLE_GENERATING,
    CRANK_THROW,
    PIN_GENERATING,
    TILT_X,
    TILT_Y,
)

Indices = NDArray[np.int64]
_BENT = 0.2  # of a contact's curvature radius: what displaces a pin farther along its flank is beyond second order
_SURE = 2e-7  # m: what is left to a gap for another foot, and for the rotation while contacts are not placed again
_REACHED = 1e-7  # rad: a play's last step, to second order
_PLACED = 12  # times that contacts are placed before the drive is solved alone
_ITERATIONS = 30
_SOUGHT, _MOVED, _SETTLED, _ALONE = range(4)  # states of a drive
_BEND_MORE = 3.0  # over the pin's radius: added to a contact's curvature, for what changes it

_LINEAR = lanes_of("gap", "beyond", "along", "spread", "thicker")
"""Of each contact, for drives side by side, m: gap and how far errors displace the pin along the flank, both at the
rotation of the solved drive, by how much less the next tooth's gap may be and how much farther another foot may be
displaced, and what is thicker."""


GUIDE = record_of(
    # fields of a contact row
    *("gap", "arm", "arm_rate", "foot", "foot_rate", "curvature"),
    # without the bend along the flank, which counts together with what errors displace along it
    "rigid_arm_rate",
    # the gap's second derivative along the flank at most, 1/m; infinite where the gap is not smooth
    "bend",
    # the gap's derivatives, with those along the flank: by the pin outwards (`radial`; `tangential` along the flank),
    # by the gear's centre (the normal), by the crank's throw, the generating circle's radius and the tooth's turn
    *(
        "radial",
        "tangential",
        "normal_x",
        "normal_y",
        "crank",
        "crank_along",
        "facing",
        "leaning",
        "turn",
        "turn_along",
    ),
    # of the output's rotation along the flank, m; distance of the slice from mid-width, m
    *("slide", "height"),
    # numbers of the tooth, and of the one across the root that the pin may reach
    *("tooth", "beyond"),
)
"""Every contact of the drive that is solved, with what errors change of it to first order."""


class Guide(NamedTuple):
    """Every pin's contact in a solved drive, at some crank angles of a sweep.

    Attributes
    ----------
    first
        Number of the first crank angle.
    rows
        `GUIDE` records, shape (angles, contacts), of each disc, slice and pin.
    transmission_error
        Rotation at which they were solved, shape (angles,), rad.
    """

    first: int
    rows: NDArray[np.void]
    transmission_error: Array


@compiled
def guide_rows(problem: Problem, crank_angles: Array, transmission_error: Array, rows: NDArray[np.void]) -> None:
    """Overwrite the rows of a `Guide`, shape (angles, contacts), with the contacts of a solved drive."""
    contacts = contact_rows(problem)
    teeth = problem.teeth
    for i in range(crank_angles.size):
        place_contacts(problem, crank_angles[i], transmission_error[i], contacts, i == 0, math.inf, math.inf)
        for k in range(rows.shape[1]):
            guide, row = rows[i, k], 2 * k
            if contacts[row + 1].gap < contacts[row].gap:
                row += 1
            contact = contacts[row]
            local = local_frame(problem, crank_angles[i], transmission_error[i], contacts, row)
            c, s = math.cos(local.direction), math.sin(local.direction)
            nx, ny = local.normal_x, local.normal_y
            guide.gap, guide.arm, guide.arm_rate = contact.gap, contact.arm, contact.arm_rate
            guide.curvature = contact.curvature
            # Without the bend along the flank, which counts together with what errors displace along it.
            guide.rigid_arm_rate = contact.arm_rate + local.slide * local.slide * local.bend
            # Where a pin has a foot on both teeth, or on the other one, its gap is not smooth.
            smooth = row == 2 * k and contacts[row + 1].gap == math.inf
            guide.bend = abs(local.bend) + _BEND_MORE / problem.pin_radius[local.pin] if smooth else math.inf
            guide.radial, guide.tangential = nx * c + ny * s, ny * c - nx * s
            guide.normal_x, guide.normal_y, guide.height = nx, ny, problem.slice_z[local.slice]
            guide.crank = nx * local.crank_x + ny * local.crank_y
            guide.crank_along = nx * local.crank_y - ny * local.crank_x
            guide.facing, guide.leaning = local.facing, local.leaning
            by_position = gap_gradient(local)
            guide.turn, guide.turn_along, guide.slide = by_position.gap[2], by_position.slide[2], local.slide
            along = local.around * teeth / (2.0 * math.pi)
            along -= math.floor(along)
            other = (local.tooth + (1 if along > 0.5 else -1)) % teeth if not 0.2 < along < 0.8 else local.tooth
            guide.tooth, guide.beyond = local.disc * teeth + local.tooth, local.disc * teeth + other
            guide.foot, guide.foot_rate = contacts[2 * k].foot, contacts[2 * k].foot_rate


_GAPS = lanes_of("gap")

_DRIVE = record_of(
    # state; where contacts were placed, and ends of the bracket, rad; what the forces give
    *("state", "placed", "low", "high", "torque", "stiffness", "count"),
    # of the last crank angles: by how much they differ from the solved drive, how far beyond the first touch the last
    # one was, by how much two first guesses missed it, and how many were solved in a row
    *("changed", "changed_before", "changed_first", "beyond", "touch_missed", "line_missed", "solved"),
)


class Memory(NamedTuple):
    """Memory of drives side by side."""

    errors: Array  # their displacements from the solved drive, shape (displacements, lanes)
    linear: NDArray[np.void]  # `_LINEAR` of each contact
    gaps: NDArray[np.void]  # of one contact, m, shape (1,)
    x: Array  # transmission error, shape (lanes,), rad
    touch: Array  # rotation from the solved drive to the first touch, shape (lanes,), rad
    drives: NDArray[np.void]  # `_DRIVE` of each
    near: Rows  # contacts that may touch, shape (drives, contacts)
    number: Indices  # of each of them among all of its drive
    listed_drive: Indices  # drives and near contacts that go through lanes
    listed: Indices


def memory(contacts: int, errors: Array) -> Memory:
    """Return the memory of drives with so many contacts, and errors (drives, displacements)."""
    # Not in the kernels, which would compile for 4 s longer.
    drives, lanes = len(errors), np.zeros((errors.shape[1], LANES))
    lanes[:, :drives] = errors.T
    listed_drive, listed = np.zeros((2, drives * contacts), np.int64)
    return Memory(
        lanes,
        np.zeros(contacts, _LINEAR),
        np.zeros(1, _GAPS),
        np.zeros(LANES),
        np.zeros(LANES),
        np.zeros(drives, _DRIVE),
        np.zeros((drives, contacts), ROW),
        np.zeros((drives, contacts), np.int64),
        listed_drive,
        listed,
    )


@compiled
def _displace(rows: NDArray[np.void], pins: int, work: Memory) -> None:
    """Gaps of drives, and how far errors displace pins along their flanks, at the rotation of the solved drive."""
    errors = work.errors
    # A larger circle displaces another foot, at most a pitch away, in another direction.
    step = 2.0 * math.pi / (pins - 1)
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    teeth = BODY_COUNT + 3 * pins
    for k in range(rows.shape[0]):
        guide, pin, linear = rows[k], k % pins, work.linear[k]
        tooth, beyond = teeth + int(guide.tooth), teeth + int(guide.beyond)
        a, b, nx, ny, height = guide.radial, guide.tangential, guide.normal_x, guide.normal_y, guide.height
        gap, turn, crank, facing = guide.gap, guide.turn, guide.crank, guide.facing
        # In two loops, because the compiler gives up where it must compare too many arrays.
        for j in range(vectors(work.drives.size)):
            linear.gap[j] = (
                gap
                + a * errors[radial + pin, j]
                + b * errors[tangential + pin, j]
                - errors[radius + pin, j]
                + turn * errors[tooth, j]
            )
        for j in range(vectors(work.drives.size)):
            linear.gap[j] += (
                errors[PIN_GENERATING, j]
                - facing * errors[CIRCLE_GENERATING, j]
                - crank * errors[CRANK_THROW, j]
                - nx * (errors[CENTRE_X, j] + height * errors[TILT_X, j])
                - ny * (errors[CENTRE_Y, j] + height * errors[TILT_Y, j])
            )
        turn_along, crank_along, leaning = guide.turn_along, guide.crank_along, guide.leaning
        for j in range(vectors(work.drives.size)):
            turned, further = errors[tooth, j], errors[beyond, j] - errors[tooth, j]
            linear.thicker[j] = errors[radius + pin, j] - errors[PIN_GENERATING, j]
            linear.beyond[j] = min(turn * further, 0.0)
            linear.along[j] = a * errors[tangential + pin, j] - b * errors[radial + pin, j] + turn_along * turned
            linear.spread[j] = abs(turn_along * further) + step * abs(errors[CIRCLE_GENERATING, j])
        for j in range(vectors(work.drives.size)):
            linear.along[j] += (
                ny * (errors[CENTRE_X, j] + height * errors[TILT_X, j])
                - nx * (errors[CENTRE_Y, j] + height * errors[TILT_Y, j])
                + leaning * errors[CIRCLE_GENERATING, j]
                - crank_along * errors[CRANK_THROW, j]
            )


@compiled
def _least_gaps(guide: np.record, linear: np.record, reference: float, work: Memory) -> int:
    """Gaps that a contact has at least where the drives are; returns how many of them are not above `_SURE`."""
    gaps, near = work.gaps[0], 0
    bend, gap_of_guide = guide.bend, guide.gap
    arm, rate, slide = guide.arm, guide.rigid_arm_rate, guide.slide
    for j in range(vectors(work.drives.size)):
        x = work.x[j] - reference
        gap, thicker = linear.gap[j] + linear.beyond[j] - x * (arm + 0.5 * x * rate), linear.thicker[j]
        moved = abs(linear.along[j] + slide * x) + linear.spread[j]
        away = gap + thicker - gap_of_guide
        certain = gap_of_guide - thicker - math.sqrt(moved * moved + away * away)
        # Errors turn with the output, so that x times them comes in their way's direction.
        second = gap - (bend * moved + abs(x)) * moved if bend * moved < _BENT else -1.0
        least = max(certain, second)
        gaps.gap[j] = least
        near += 1 if least <= _SURE else 0
    return near


@compiled
def _list(rows: NDArray[np.void], reference: float, work: Memory) -> None:
    """List contacts that may touch, near a drive that is solved at `reference`, of drives sought or moved."""
    gaps, drives, sought = work.gaps[0], work.drives, work.listed_drive
    size = 0
    for j in range(drives.size):
        if drives[j].state <= _MOVED:
            drives[j].count, drives[j].placed = 0.0, work.x[j]
            sought[size] = j
            size += 1
    for k in range(rows.shape[0]):
        if _least_gaps(rows[k], work.linear[k], reference, work) == 0:
            continue
        for j in sought[:size]:
            if gaps.gap[j] > _SURE:
                continue
            count = int(drives[j].count)
            # A force of the last crank angle begins the next one's.
            if work.number[j, count] != k:
                work.near[j, count].force = 0.0
            work.number[j, count], work.near[j, count].gap = k, gaps.gap[j]
            drives[j].count += 1.0


@compiled
def _first_touch(rows: NDArray[np.void], direction: float, work: Memory) -> None:
    """Rotation of each drive from the solved one at which its first flank touches, to first order."""
    touch = work.touch
    for j in range(touch.size):
        touch[j] = math.inf
    for k in range(rows.shape[0]):
        arm, rate, linear = rows[k].arm * direction, rows[k].arm_rate, work.linear[k]
        if arm <= 0.0:
            continue
        for j in range(vectors(work.drives.size)):
            gap = linear.gap[j]
            inside = arm * arm + 2.0 * rate * gap
            root = 2.0 * gap / (arm + math.sqrt(max(inside, 0.0)))
            touch[j] = min(touch[j], root if inside > 0.0 else math.inf)


@compiled
def _place_contacts(
    problem: Problem, drives: Drives, rows: NDArray[np.void], reference: float, crank_angle: float, work: Memory
) -> None:
    """Place the contacts that may touch, of the drives that were sought or moved."""
    pins, slices, teeth = problem.teeth + 1, problem.slice_z.size, problem.teeth
    e = problem.generating_eccentricity
    listed_drive, listed = work.listed_drive, work.listed
    _list(rows, reference, work)
    size = 0
    for j in range(work.drives.size):
        if work.drives[j].state > _MOVED:
            continue
        for n in range(int(work.drives[j].count)):
            listed_drive[size], listed[size] = j, n
            size += 1
    group = on_stack(PLACED)
    drive, disc = -1, -1
    pose, flank = disc_pose(problem, 0.0, crank_angle, 0.0, 0), Flank(0.0, 0.0, 0.0, 0, False)
    for first in range(0, size, LANES):
        filled = min(LANES, size - first)
        for lane in range(filled):
            j = listed_drive[first + lane]
            k = work.number[j, listed[first + lane]]
            pin, slice_ = k % pins, k // pins % slices
            if j != drive or k // (pins * slices) != disc:
                drive, disc = j, k // (pins * slices)
                pose = disc_pose(problem, drives.eccentricity[j], crank_angle, work.x[j], disc)
                flank = Flank(drives.circle_radius[j], e, drives.generating_radius[j], teeth, problem.ring)
            axis = pin_axis(
                pose,
                drives.pin_x[j, pin],
                drives.pin_y[j, pin],
                drives.centre_x[j, slice_],
                drives.centre_y[j, slice_],
            )
            group.start[lane] = (
                conjugate_point(pose, teeth, pin) + rows[k].foot + rows[k].foot_rate * (work.x[j] - reference)
            )
            enter(group, pose, axis, drives.tooth_turn[j, disc], teeth, pin)
            group.pin_radius[lane] = drives.pin_radius[j, pin]
            enter_flank(group, lane, flank, drives.root_phase[j], drives.root_margin[j])
        feet_in_lanes(group, e, teeth, problem.ring)
        group.filled = 0
        for lane in range(filled):
            j, n = listed_drive[first + lane], listed[first + lane]
            if group.alone[lane] > 0.0:
                work.drives[j].state = _ALONE
            write_contact(work.near[j, n], solved_in(group, lane), crank_angle, work.x[j])


@compiled
def _press(
    pin_radius: Array,
    work: Memory,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
) -> None:
    """Forces of the drives that are sought, their torque and stiffness."""
    listed_drive, listed, pins = work.listed_drive, work.listed, pin_radius.shape[1]
    size = 0
    for j in range(work.drives.size):
        if work.drives[j].state != _SOUGHT:
            continue
        work.drives[j].torque = work.drives[j].stiffness = 0.0
        for n in range(int(work.drives[j].count)):
            if work.near[j, n].gap < 0.0:
                listed_drive[size], listed[size] = j, n
                size += 1
            else:
                work.near[j, n].force = 0.0
    group = on_stack(APPROACHED)
    for first in range(0, size, LANES):
        filled = min(LANES, size - first)
        for lane in range(vectors(filled)):
            last = min(first + lane, size - 1)
            j, n = listed_drive[last], listed[last]
            near = work.near[j, n]
            group.approach[lane], group.curvature[lane] = -near.gap, near.curvature
            group.pin_radius[lane], group.force[lane] = pin_radius[j, work.number[j, n] % pins], near.force
        hertz_in_lanes(group, filled, width, compliance_gear, compliance_pin, largest_log_radius, 0.0)
        for lane in range(filled):
            j, n = listed_drive[first + lane], listed[first + lane]
            near = work.near[j, n]
            write_pressed(near, group, lane)
            work.drives[j].torque += near.force * near.arm
            work.drives[j].stiffness += rotational_stiffness(near)


@compiled
def _touch(work: Memory, j: int, direction: float) -> float:
    """Rotation in `direction` at which the first near contact touches, to second order; infinite without one."""
    best = math.inf
    for n in range(int(work.drives[j].count)):
        near = work.near[j, n]
        best = min(best, touched_after(near.gap, direction * near.arm, near.arm_rate))
    return best


@compiled
def _move(work: Memory, j: int, step: float) -> None:
    """Move a drive and its near contacts, as an equilibrium does."""
    for n in range(int(work.drives[j].count)):
        follow(work.near[j, n], step)
    work.x[j] += step


@compiled
def _balance(work: Memory, torque: float, near: float) -> int:
    """One of Newton's steps of the drives that are sought; returns how many are still sought.

    Contacts that have moved by more than `near` (rad) are to be placed again.
    """
    sought = 0
    for j in range(work.drives.size):
        drive = work.drives[j]
        if drive.state != _SOUGHT:
            continue
        x, stiffness = work.x[j], drive.stiffness
        short = torque - drive.torque
        if short > 0.0:
            drive.low = x
        else:
            drive.high = x
        step = short / stiffness if stiffness > 0.0 else math.inf
        if stiffness <= 0.0 or (drive.torque * torque < 0.0 and abs(step) < LINEAR_STEP):
            direction = math.copysign(1.0, short)
            step = direction * (max(_touch(work, j, direction), 0.0) + 1e-6)
        step = min(max(step, -1e-3), 1e-3)
        if abs(step) < LINEAR_STEP:
            _move(work, j, step)
            drive.state = _SETTLED
            continue
        if not drive.low < x + step < drive.high:
            step = 0.5 * (drive.low + drive.high) - x
        if abs(x + step - drive.placed) > near:
            work.x[j] = x + step
            drive.state = _MOVED
        else:
            _move(work, j, step)
            sought += 1
    return sought


@compiled
def _begin(rows: NDArray[np.void], reference: float, direction: float, work: Memory) -> None:
    """Transmission errors to begin from: the first touch, moved by as much as at the last crank angle, or the parabola.

    The parabola goes through what errors changed at the last three crank angles. A drive takes what was nearer at the
    last drive.
    """
    _first_touch(rows, direction, work)
    for j in range(work.drives.size):
        drive = work.drives[j]
        touch = reference + direction * work.touch[j]
        by_touch = touch + drive.beyond
        by_line = by_touch
        if drive.solved > 2:
            by_line = reference + 3.0 * (drive.changed - drive.changed_before) + drive.changed_first
        work.x[j] = by_line if drive.line_missed < drive.touch_missed else by_touch
        # Until the crank angle is solved.
        drive.beyond, drive.touch_missed, drive.line_missed = touch, by_touch, by_line
        drive.state = _SOUGHT
        drive.low, drive.high = -math.inf, math.inf


@compiled
def _end(drive: np.record, x: float, reference: float) -> None:
    drive.solved += 1.0
    drive.beyond = x - drive.beyond
    drive.touch_missed, drive.line_missed = abs(x - drive.touch_missed), abs(x - drive.line_missed)
    drive.changed_first, drive.changed_before, drive.changed = drive.changed_before, drive.changed, x - reference


@compiled
def _settle(
    problem: Problem,
    drives: Drives,
    rows: NDArray[np.void],
    reference: float,
    crank_angle: float,
    torque: float,
    work: Memory,
) -> None:
    """Balance the torque."""
    for _ in range(_PLACED):
        _place_contacts(problem, drives, rows, reference, crank_angle, work)
        for j in range(work.drives.size):
            if work.drives[j].state == _MOVED:
                work.drives[j].state = _SOUGHT
        for _ in range(_ITERATIONS):
            _press(
                drives.pin_radius,
                work,
                problem.slice_width,
                problem.compliance_gear,
                problem.compliance_pin,
                problem.largest_log_radius,
            )
            if _balance(work, torque, by_rates(problem.circle_radius)) == 0:
                break
        moved = 0
        for j in range(work.drives.size):
            # Whatever the other drives need.
            if work.drives[j].state == _SOUGHT:
                work.drives[j].state = _ALONE
            moved += 1 if work.drives[j].state == _MOVED else 0
        if moved == 0:
            break


@compiled
def sweep_drives(
    problem: Problem,
    drives: Drives,
    work: Memory,
    guide: Guide,
    crank_angles: Array,
    torque: float,
    transmission_error: Array,
    stiffness: Array,
    pressure: Array,
) -> None:
    """Solve the loaded contact of many drives at the crank angles of a guide, in a row.

    Parameters
    ----------
    problem, guide
        The solved drive, and its contacts.
    drives, work
        The drives, and their memory, which holds the crank angles before.
    crank_angles, torque
        Crank angles, shape (angles,), rad; N·m, not 0.
    transmission_error, stiffness, pressure
        Overwritten, shape (drives, angles): rad, N·m/rad, and the largest contact pressure (Pa); NaN where a drive has
        to be solved alone.
    """
    pins, count = problem.teeth + 1, work.drives.size
    stress = 1.0 / (math.pi * problem.slice_width * (problem.compliance_gear + problem.compliance_pin))
    for number in range(guide.transmission_error.size):
        i, rows, reference = guide.first + number, guide.rows[number], guide.transmission_error[number]
        _displace(rows, pins, work)
        _begin(rows, reference, math.copysign(1.0, torque), work)
        _settle(problem, drives, rows, reference, crank_angles[i], torque, work)
        for j in range(count):
            drive = work.drives[j]
            if drive.state != _SETTLED:
                transmission_error[j, i] = stiffness[j, i] = pressure[j, i] = math.nan
                # The next crank angle begins from its first touch, and so do those whose parabola this one is part of.
                drive.beyond, drive.solved = 0.0, 0
                continue
            transmission_error[j, i], stiffness[j, i] = work.x[j], drive.stiffness
            largest = 0.0
            for n in range(int(drive.count)):
                near, radius = work.near[j, n], drives.pin_radius[j, work.number[j, n] % pins]
                largest = max(largest, near.force * max(abs(1.0 / radius + near.curvature), 1e-9))
            # p = 2F/(πab), as in `load_sharing`
            pressure[j, i] = math.sqrt(largest * stress)
            _end(drive, work.x[j], reference)


@compiled
def _reach(
    problem: Problem,
    drives: Drives,
    rows: NDArray[np.void],
    reference: float,
    crank_angle: float,
    direction: float,
    work: Memory,
) -> None:
    """Find the end of the play in a direction (±1)."""
    _first_touch(rows, direction, work)
    for j in range(work.drives.size):
        work.x[j], work.drives[j].state = reference + direction * work.touch[j], _SOUGHT
    for _ in range(_PLACED):
        _place_contacts(problem, drives, rows, reference, crank_angle, work)
        moved = 0
        for j in range(work.drives.size):
            drive = work.drives[j]
            if drive.state > _MOVED:
                continue
            step = min(_touch(work, j, direction), 1e-3)
            work.x[j] += direction * step
            drive.state = _SETTLED if abs(step) < _REACHED else _MOVED
            moved += 1 if drive.state == _MOVED else 0
        if moved == 0:
            break


@compiled
def sweep_play_of_drives(
    problem: Problem,
    drives: Drives,
    work: Memory,
    guide: Guide,
    crank_angles: Array,
    low: Array,
    high: Array,
) -> None:
    """Solve the play of many drives at the crank angles of a guide.

    Parameters are those of `sweep_drives`; `low` and `high` (rad), shape (drives, angles), are overwritten as by
    `sweep_play`, NaN where a drive has to be solved alone.
    """
    pins, count = problem.teeth + 1, work.drives.size
    for number in range(guide.transmission_error.size):
        i, rows, reference = guide.first + number, guide.rows[number], guide.transmission_error[number]
        _displace(rows, pins, work)
        _reach(problem, drives, rows, reference, crank_angles[i], -1.0, work)
        for j in range(count):
            low[j, i] = work.x[j] if work.drives[j].state == _SETTLED else math.nan
        _reach(problem, drives, rows, reference, crank_angles[i], 1.0, work)
        for j in range(count):
            high[j, i] = work.x[j] if work.drives[j].state == _SETTLED else math.nan
            # Without errors and modification the ends are the same but for rounding.
            if not low[j, i] < high[j, i] + 2.0 * ROTATION_STEP:
                low[j, i] = high[j, i] = math.nan
            elif low[j, i] > high[j, i]:
                low[j, i] = high[j, i] = 0.5 * (low[j, i] + high[j, i])
