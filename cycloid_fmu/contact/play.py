"""Play: free rotation of the output with the crank locked, and interference where there is none."""

from __future__ import annotations

import math

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.equilibrium import to_touch
from cycloid_fmu.contact.local_frame import crank_motion, local_frame
from cycloid_fmu.contact.placement import CLEAR, place_contacts
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows

TOUCHING = 2e-10  # m: an interference below this counts as touching
ROTATION_STEP = 1e-12  # rad: last step of the play's ends


@compiled
def _smallest_gap(contacts: Rows, step: float) -> tuple[float, int]:
    """Smallest gap after a small rotation, to first order, and its row."""
    best, active = math.inf, 0
    for row in range(contacts.shape[0]):
        gap = contacts[row].gap - contacts[row].arm * step
        if gap < best:
            best, active = gap, row
    return best, active


@compiled
def play(problem: Problem, crank_angle: float, x: float, contacts: Rows, cold: bool) -> tuple[float, float, float]:
    """Ends of the free rotation with the crank locked, and by how much there is none.

    From any free rotation each end is where the first flank touches. Where x is not free, the search begins from the
    rotation with the largest smallest gap (gaps are linearised and solved again until that changes no more).

    Parameters
    ----------
    problem, crank_angle, contacts, cold
        As in `equilibrium`.
    x
        Starting transmission error, rad.

    Returns
    -------
    low, high, interference
        Transmission errors (rad) between which the output is free, and the interference (m, ≥ 0). Below `TOUCHING` of
        interference both ends are the same; where there is no free position they are NaN.
    """
    lowest, highest = -math.inf, math.inf
    gap = 0.0
    for _ in range(100):
        place_contacts(problem, crank_angle, x, contacts, cold, math.inf, math.inf)
        cold = False
        gap, active = _smallest_gap(contacts, 0.0)
        if gap > TOUCHING:
            break
        if contacts[active].arm > 0.0:
            highest = x
        else:
            lowest = x
        # The linearised gaps' largest minimum lies where a falling and a rising gap cross.
        step, falling, rising = 0.0, -1, -1
        for _ in range(200):
            _, active = _smallest_gap(contacts, step)
            if active in (falling, rising):
                break
            if contacts[active].arm > 0.0:
                falling = active
            else:
                rising = active
            if falling < 0:
                step += 1e-4
            elif rising < 0:
                step -= 1e-4
            else:
                fall, rise = contacts[falling], contacts[rising]
                step = (fall.gap - rise.gap) / (fall.arm - rise.arm)
        better, _ = _smallest_gap(contacts, step)
        if better - gap < 1e-15:
            break
        if abs(step) > 1e-3:
            step = math.copysign(1e-3, step)
        if not lowest < x + step < highest:
            step = 0.5 * (lowest + highest) - x
        x += step
    if gap < -TOUCHING:
        return math.nan, math.nan, -gap
    if gap <= 0.0:
        return x, x, 0.0
    low = _first_touch(problem, crank_angle, x, contacts, cold, -1.0)
    return low, _first_touch(problem, crank_angle, x, contacts, cold, 1.0), 0.0


@compiled
def end_from_neighbour(
    problem: Problem, crank_angle: float, x: float, contacts: Rows, cold: bool, direction: float
) -> float:
    """End of the free rotation in `direction` (±1) of nominal flanks, from that of a neighbouring crank angle, x.

    Pins that were clear there stay clear for certain (docs/theory/contact.md), so that few are solved. Where there is
    no free position both ends are found all the same, the lower above the upper.
    """
    place_contacts(problem, crank_angle, x, contacts, cold, CLEAR, math.inf)
    return _first_touch(problem, crank_angle, x, contacts, cold, direction)


@compiled
def _first_touch(problem: Problem, crank_angle: float, x: float, contacts: Rows, cold: bool, direction: float) -> float:
    # What a flank with deviations predicts reaches no farther than its next element.
    clear = CLEAR if problem.deviations is None else math.inf
    for _ in range(50):
        step = min(to_touch(contacts, crank_angle, x, direction), 1e-3)
        x += direction * step
        if abs(step) < ROTATION_STEP:
            break
        place_contacts(problem, crank_angle, x, contacts, cold, clear, math.inf)
    return x


@compiled
def touch_rate(problem: Problem, crank_angle: float, x: float, contacts: Rows, direction: float) -> float:
    """How fast the crank moves an unloaded output that it pushes, dφ_b/dθ (1), NaN without a flank in `direction`.

    The flank with the smallest gap among those that stop a rotation in `direction` (±1) stays in contact.
    """
    best, touching = math.inf, -1
    for row in range(contacts.shape[0]):
        if contacts[row].arm * direction > 0.0 and contacts[row].gap < best:
            best, touching = contacts[row].gap, row
    if touching < 0:
        return math.nan
    local = local_frame(problem, crank_angle, x, contacts, touching)
    u, v = crank_motion(problem, local)
    return -(u * local.normal_x + v * local.normal_y) / contacts[touching].arm
