"""Equilibrium of the contacts with a torque, alone or behind a compliance in series."""

from __future__ import annotations

import math

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.hertz import APPROACHED, hertz_in_lanes
from cycloid_fmu.contact.lanes import LANES, Lanes, on_stack, vectors
from cycloid_fmu.contact.placement import BOUNDED, CLEAR, place_contacts
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows, touching_count

LINEAR_STEP = 1e-9  # rad: below this Newton's last step of an equilibrium is made with the stiffnesses at hand
_BY_RATES = 1e-6  # rad: so near the rotation at which contacts were solved, their rates say how they are


@compiled(inline=True)
def rotational_stiffness(contact: np.record) -> float:
    """Change of one contact's torque F L for each radian: of its approach, its arm and its flank's curvature."""
    arm = contact.arm
    curved = contact.force_by_curvature * contact.curvature_rate * contact.foot_rate
    return float(contact.stiffness * arm * arm + contact.force * contact.arm_rate + curved * arm)


@compiled
def by_rates(circle_radius: float) -> float:
    """How far from where they were placed contacts follow by their rates, rad, on a flank's circle radius (m).

    No gap falls by more than `CLEAR` meanwhile: pins that are so clear are not looked at.
    """
    return min(_BY_RATES, CLEAR / circle_radius)


@compiled(inline=True)
def load(problem: Problem, contacts: Rows) -> tuple[float, float]:
    """Forces of all rows where they were placed; returns the torque that balances them (N·m), its derivative by x."""
    # The whole problem as an argument would have the references to each of its arrays counted at every call.
    return _press(
        contacts,
        problem.pin_radius,
        problem.slice_width,
        problem.compliance_gear,
        problem.compliance_pin,
        problem.largest_log_radius,
        problem.seat_gap,
        problem.seat_compliance,
    )


@compiled
def _press(
    contacts: Rows,
    pin_radius: Array,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
    seat_gap: float,
    seat_compliance: float,
) -> tuple[float, float]:
    torque = stiffness = 0.0
    touching = touching_count(contacts)
    group = on_stack(APPROACHED)
    pins = pin_radius.size
    for first in range(0, touching, LANES):
        filled = min(LANES, touching - first)
        for lane in range(vectors(filled)):
            row = int(contacts[min(first + lane, touching - 1)].touching)
            contact = contacts[row]
            group.approach[lane], group.curvature[lane] = -contact.gap - seat_gap, contact.curvature
            group.pin_radius[lane], group.force[lane] = pin_radius[row // 2 % pins], contact.force
        hertz_in_lanes(group, filled, width, compliance_gear, compliance_pin, largest_log_radius, seat_compliance)
        for lane in range(filled):
            contact = contacts[int(contacts[first + lane].touching)]
            write_pressed(contact, group, lane)
            if contact.force > 0.0:
                torque += contact.force * contact.arm
                stiffness += rotational_stiffness(contact)
    return torque, stiffness


@compiled(inline=True)
def write_pressed(contact: np.record, group: Lanes, lane: int) -> None:
    """Write what Hertz's law gives of a contact in a lane."""
    contact.force, contact.stiffness = group.force[lane], group.stiffness[lane]
    contact.force_by_curvature = group.force_by_curvature[lane]


@compiled
def carried(contacts: Rows) -> float:
    """Torque that solved contacts carry, N·m: force times arm, summed over the rows."""
    torque = 0.0
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        if contact.force > 0.0:
            torque += contact.force * contact.arm
    return torque


@compiled
def to_touch(contacts: Rows, crank_angle: float, x: float, direction: float) -> float:
    """Rotation from x, in `direction` (±1), at which the first flank touches, to second order.

    Rows solved elsewhere than at x count with what they predict of it.
    """
    best = math.inf
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        gap, arm, rate = contact.gap, contact.arm, contact.arm_rate
        if not gap < math.inf:
            continue
        since = x - contact.transmission_error
        gap -= since * (arm + 0.5 * since * rate)
        if contact.crank_angle != crank_angle:
            gap += (crank_angle - contact.crank_angle) * contact.gap_by_crank
        best = min(best, touched_after(gap, direction * (arm + since * rate), rate))
    return best


@compiled(inline=True)
def touched_after(gap: float, arm: float, rate: float) -> float:
    """Rotation in the arm's direction after which one flank touches, to second order; infinite where it does not."""
    inside = arm * arm + 2.0 * rate * gap
    never = (arm <= 0.0 and not (gap > 1e-9 and rate > 0.0)) or (inside < 0.0 and gap > 0.0)
    return math.inf if never else 2.0 * gap / (arm + math.sqrt(max(inside, 0.0)))


@compiled
def equilibrium(
    problem: Problem, crank_angle: float, torque: float, x: float, contacts: Rows, cold: bool
) -> tuple[float, float]:
    """Transmission error at which the contacts balance a torque (other than zero, where there is play).

    Parameters
    ----------
    problem
        The contact problem.
    crank_angle
        Crank angle, rad.
    torque
        Torque of the environment on the output, N·m.
    x
        Starting transmission error, rad.
    contacts
        Contact rows, overwritten with the solution.
    cold
        Whether `contacts` holds nothing of a neighbouring state.

    Returns
    -------
    x, stiffness
        Transmission error (rad) and its torsional stiffness (N·m/rad).
    """
    return _balance(problem, crank_angle, torque, 1.0, 0.0, 0.0, x, contacts, cold)


@compiled
def behind_compliance(
    problem: Problem, crank_angle: float, flange: float, compliance: float, x: float, contacts: Rows, cold: bool
) -> tuple[float, float]:
    """Transmission error ξ of the contacts with the flange at ξ + c M(ξ); returns ξ and the contacts' stiffness."""
    return _balance(problem, crank_angle, 0.0, compliance, flange, 1.0, x, contacts, cold)


@compiled
def _balance(
    problem: Problem,
    crank_angle: float,
    torque: float,
    share: float,
    flange: float,
    hold: float,
    x: float,
    contacts: Rows,
    cold: bool,
) -> tuple[float, float]:
    """Solve share (torque - M(x)) + hold (flange - x) = 0 by Newton's method inside a bracket."""
    low, high, placed, last = -math.inf, math.inf, math.inf, x
    stiffness, near = 0.0, by_rates(problem.circle_radius)
    beyond = 1e-6  # rad past a first touch; twice as far each time, as a contact at a pin's crest only loses torque
    for _ in range(100):
        if abs(x - placed) > near or problem.deviations is not None:
            place_contacts(problem, crank_angle, x, contacts, cold, CLEAR, BOUNDED)
            cold, placed = False, x
        else:
            _move(problem.teeth, problem.ring, x - last, x, contacts)
        balance, stiffness = load(problem, contacts)
        short = share * (torque - balance) + hold * (flange - x)
        slope = share * stiffness + hold
        if short > 0.0:
            low = x
        else:
            high = x
        step = short / slope if slope > 0.0 else math.inf
        # A load against the torque is on the wrong flanks, however little is short of a tiny torque.
        if slope <= 0.0 or (hold == 0.0 and balance * torque < 0.0 and abs(step) < LINEAR_STEP):
            direction = math.copysign(1.0, short)
            step = direction * (max(to_touch(contacts, crank_angle, x, direction), 0.0) + beyond)
            beyond *= 2.0
        step = min(max(step, -1e-3), 1e-3)
        if abs(step) < LINEAR_STEP:
            _move(problem.teeth, problem.ring, step, x + step, contacts)
            x += step
            break
        if not low < x + step < high:
            step = 0.5 * (low + high) - x
        last, x = x, x + step
    return x, stiffness


@compiled
def _move(teeth: int, ring: bool, step: float, x: float, contacts: Rows) -> None:
    """Move the rows that may touch by a small rotation to x: the gap to second order, the others to first.

    Half of a sweep's contacts were solved again after such small steps, which took 1.3 times as long.
    """
    conjugate = -step / teeth if ring else 0.0
    for i in range(touching_count(contacts)):
        contact = contacts[int(contacts[i].touching)]
        follow(contact, step)
        contact.foot += step * contact.foot_rate - conjugate
        contact.profile_parameter += step * contact.foot_rate
        contact.transmission_error = x


@compiled(inline=True)
def follow(contact: np.record, step: float) -> None:
    """Force, gap, arm and curvature of a contact after a small rotation, by their rates."""
    if contact.force > 0.0:
        curved = contact.force_by_curvature * contact.curvature_rate * contact.foot_rate
        contact.force += step * (contact.stiffness * contact.arm + curved)
    contact.gap -= step * (contact.arm + 0.5 * step * contact.arm_rate)
    contact.arm += step * contact.arm_rate
    contact.curvature += step * contact.foot_rate * contact.curvature_rate
