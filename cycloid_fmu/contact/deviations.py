"""Flanks and pins that deviate from their nominal form: where they come closest, and the curvature that they add."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.foot import Tangency, on_tooth, path_curvature, tangency
from cycloid_fmu.contact.gap import Flank, contact_at, offset_on_tooth, write_contact
from cycloid_fmu.contact.pose import conjugate_point, disc_pose, pin_axis
from cycloid_fmu.contact.problem import Deviations, Problem, poses
from cycloid_fmu.contact.rows import Rows, disc_slice_pin, is_solved_at

# Deviations can't make a contact more conformal than this share of its nominal 1/ρ*: where wear leaves no curvature
# between flank and pin Hertz's half width has no end, while the scar's own width is one. From 0.03 to 0.3 the wear
# paper's pair wears equally within 1 % (docs/wear.md).
_CONFORMAL = 0.1


class Facing(NamedTuple):
    """A pin and the tooth that it faces, turned to tooth 0."""

    disc: int
    slice_: int
    tooth: int
    pin: int
    x: float  # the pin's axis, m
    y: float
    inwards_x: float  # direction from it to the pin circle's centre
    inwards_y: float


@compiled
def move_to_deviations(
    problem: Problem, deviations: Deviations | None, crank_angle: float, x: float, contacts: Rows, bounded: float
) -> None:
    """Move the contacts just solved on nominal surfaces to where the surfaces with deviations come closest.

    The pieces between neighbouring elements, on which deviations are linear, are searched outwards from the nominal
    foot until the nominal surfaces stand farther apart than any deviation can make up for.
    """
    if deviations is None:
        return
    teeth = problem.teeth
    pitch = 2.0 * math.pi / teeth
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        if not is_solved_at(contact, crank_angle, x) or not contact.gap < math.inf:
            continue
        if contact.gap - deviations.largest > bounded:
            contact.gap -= deviations.largest
            continue
        disc, slice_, pin = disc_slice_pin(problem, row)
        pose = disc_pose(problem, problem.eccentricity, crank_angle, x, disc)
        alpha = conjugate_point(pose, teeth, pin) + contact.foot
        tooth = math.floor(alpha / pitch)
        number = int(tooth) % teeth
        base = tooth * pitch
        # The pin's axis, and the direction from it to the pin circle's centre, on tooth 0.
        axis = pin_axis(
            pose, problem.pin_x[pin], problem.pin_y[pin], problem.centre_x[slice_], problem.centre_y[slice_]
        )
        px, py = on_tooth(axis.x, axis.y, problem.tooth_turn[disc, number])
        cb, sb = math.cos(base), math.sin(base)
        gx, gy = px * cb + py * sb, py * cb - px * sb
        _, ring, gear = poses(problem, crank_angle, x, disc)
        towards = pin * 2.0 * math.pi / (teeth + 1) + ring - gear - problem.tooth_turn[disc, number] - base
        facing = Facing(disc, slice_, number, pin, gx, gy, -math.cos(towards), -math.sin(towards))
        pin_radius = problem.pin_radius[pin]
        points = deviations.flank_alpha.size
        middle = min(max(int(np.searchsorted(deviations.flank_alpha, alpha - base)), 1), points - 2)
        flank_x, flank_y = deviations.flank_x, deviations.flank_y
        arc = math.hypot(flank_x[middle + 1] - flank_x[middle], flank_y[middle + 1] - flank_y[middle])
        # Twice what a piece's middle may come closer than its ends.
        sag = 0.25 * arc * arc * abs(1.0 / pin_radius + contact.curvature)
        best = (math.inf, 0.0, 0.0, 0.0)
        for direction in (-1, 1):
            point = middle
            nominal, raised, seen = _raised(problem, deviations, facing, point)
            while 0 <= point + direction < points:
                if point != middle and nominal - deviations.largest > best[0]:
                    break
                last_raised, last_seen = raised, seen
                point += direction
                nominal, raised, seen = _raised(problem, deviations, facing, point)
                if min(raised, last_raised) - sag < best[0]:
                    seen_ends = (last_seen, seen) if direction > 0 else (seen, last_seen)
                    piece = min(point, point - direction)
                    closest = _closest_on_piece(problem, deviations, facing, piece, seen_ends)
                    if closest[0] < best[0]:
                        best = closest
        _, along, gear_height, pin_height = best
        alpha = base + along
        state = tangency(px, py, alpha, problem.circle_radius, problem.generating_eccentricity, teeth)
        flank = Flank(
            problem.circle_radius,
            problem.generating_eccentricity,
            problem.generating_radius - gear_height,
            teeth,
            problem.ring,
        )
        offset = offset_on_tooth(axis.centre_x, axis.centre_y, 0.0, 0.0, problem.tooth_turn[disc, number])
        raised_contact = contact_at(flank, offset, pin_radius + pin_height, contact.foot, alpha, state)
        write_contact(contact, raised_contact, crank_angle, x)
        # What a raised flank predicts reaches no farther than its next element.
        contact.gap_by_crank = math.nan
        contact.bounded_for = 0.0
        if deviations.gear_curvature.size > 0:
            seen = _facing_position(problem, deviations, facing, along, state, gear_height)
            added = added_curvature(deviations, facing, along, seen)
            hertz_curvature = 1.0 / pin_radius + contact.curvature
            contact.curvature += max(added, (_CONFORMAL - 1.0) * hertz_curvature)


@compiled
def _facing_position(
    problem: Problem, deviations: Deviations, facing: Facing, alpha: float, state: Tangency, height: float
) -> float:
    """Place on the pin that faces a raised point of the flank, at tooth 0's α."""
    bx, by, dx, dy = state.path_x, state.path_y, state.apart_x, state.apart_y
    speed = math.sqrt(bx * bx + by * by)
    radius = problem.generating_radius - height
    # From the pin's axis to the flank, in the foot's frame and on tooth 0.
    wx, wy = -dx - radius * bx / speed, -dy - radius * by / speed
    ca, sa = math.cos(alpha), math.sin(alpha)
    vx, vy = wx * ca - wy * sa, wx * sa + wy * ca
    return _pin_position(deviations, facing, vx, vy)


@compiled
def added_curvature(deviations: Deviations, facing: Facing, alpha: float, seen: float) -> float:
    """Curvature that the deviations of flank and pin add where they touch, at tooth 0's α and a place on the pin."""
    points = deviations.flank_alpha
    after = min(max(int(np.searchsorted(points, alpha)), 1), points.size - 1)
    share = (alpha - points[after - 1]) / (points[after] - points[after - 1])
    curvature = deviations.gear_curvature[facing.disc, facing.slice_, facing.tooth]
    flank = (1.0 - share) * curvature[after - 1]
    flank += share * curvature[after]
    return flank + _on_pin(deviations.pin_curvature, facing, seen)


@compiled
def _raised(problem: Problem, deviations: Deviations, facing: Facing, point: int) -> tuple[float, float, float]:
    """Gap at one of the flank's points, nominal and with the deviations, and the place on the pin that faces it."""
    pin_radius = problem.pin_radius[facing.pin]
    vx, vy = deviations.flank_x[point] - facing.x, deviations.flank_y[point] - facing.y
    nominal = math.sqrt(vx * vx + vy * vy) - pin_radius
    height = deviations.gear[facing.disc, facing.slice_, facing.tooth, point]
    vx, vy = vx + height * deviations.flank_normal_x[point], vy + height * deviations.flank_normal_y[point]
    seen = _pin_position(deviations, facing, vx, vy)
    raised = math.sqrt(vx * vx + vy * vy) - pin_radius - _on_pin(deviations.pin, facing, seen)
    return nominal, raised, seen


@compiled
def _closest_on_piece(
    problem: Problem, deviations: Deviations, facing: Facing, piece: int, seen: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Smallest gap between two neighbouring points of the flank, its α, and the deviations of gear and pin there.

    `seen` are the places on the pin that face the two points; between them the pin's deviation bends at the middle of
    each of its elements, so the piece is divided there; the place is nearly, not quite, linear in α.
    """
    R, e, teeth = problem.circle_radius, problem.generating_eccentricity, problem.teeth
    heights = deviations.gear[facing.disc, facing.slice_, facing.tooth]
    a, b = deviations.flank_alpha[piece], deviations.flank_alpha[piece + 1]
    start, end = heights[piece], heights[piece + 1]
    rise = (end - start) / (b - a)
    best = (math.inf, a, start, 0.0)
    high, pin_last = a, seen[0]
    while high < b:
        low, pin_first = high, pin_last
        pin_last = math.floor(pin_first) + 1.0 if seen[1] > pin_first else math.ceil(pin_first) - 1.0
        if (pin_last - seen[1]) * (seen[1] - seen[0]) >= 0.0:
            high, pin_last = b, seen[1]
        else:
            each = (b - a) / (seen[1] - seen[0])
            high = a + (pin_last - seen[0]) * each
            state = tangency(facing.x, facing.y, high, R, e, teeth)
            high += (
                pin_last - _facing_position(problem, deviations, facing, high, state, start + rise * (high - a))
            ) * each
            high = min(max(high, low), b)
        pin_start, pin_end = _on_pin(deviations.pin, facing, pin_first), _on_pin(deviations.pin, facing, pin_last)
        pin_rise = (pin_end - pin_start) / max(high - low, 1e-3 * (b - a))
        along = 0.5 * (low + high)
        for _ in range(8):
            state, height = tangency(facing.x, facing.y, along, R, e, teeth), start + rise * (along - a)
            pin_height = _on_pin(
                deviations.pin, facing, _facing_position(problem, deviations, facing, along, state, height)
            )
            distance, fall, bend = _flank_distance(problem, state, height, rise)
            gap = distance - problem.pin_radius[facing.pin] - pin_height
            if gap < best[0]:
                best = (gap, along, height, pin_height)
            step = -(fall - pin_rise) / bend if bend > 0.0 else math.copysign(b - a, pin_rise - fall)
            following = min(max(along + step, low), high)
            if abs(following - along) < 1e-9 * (b - a):
                break
            along = following
    return best


@compiled
def _flank_distance(problem: Problem, state: Tangency, height: float, rise: float) -> tuple[float, float, float]:
    """Distance of a pin's axis from a raised point of the flank, and its first and second derivative by α.

    The point lies `height` out along the nominal normal; `rise` is the height's derivative by α. The second derivative
    is that near the foot.
    """
    f, slope, bx, by, dx, dy = state.value, state.slope, state.path_x, state.path_y, state.apart_x, state.apart_y
    speed = math.sqrt(bx * bx + by * by)
    radius = problem.generating_radius - height
    wx, wy = dx + radius * bx / speed, dy + radius * by / speed
    distance = math.sqrt(wx * wx + wy * wy)
    kappa = path_curvature(problem.circle_radius, problem.generating_eccentricity, problem.teeth, bx, speed)
    shrink = (1.0 - radius * kappa) / distance
    return distance, -f * shrink - rise * (wx * bx + wy * by) / (speed * distance), -slope * shrink


@compiled
def _pin_position(deviations: Deviations, facing: Facing, vx: float, vy: float) -> float:
    """Place on the pin's surface in the direction v from its axis, in elements from the first one's middle."""
    across, ahead = facing.inwards_x * vy - facing.inwards_y * vx, facing.inwards_x * vx + facing.inwards_y * vy
    return (math.atan2(across, ahead) / math.pi + 0.5) * deviations.pin.shape[2] - 0.5


@compiled
def _on_pin(values: Array, facing: Facing, position: float) -> float:
    """Value between the middles of a pin's elements, at a place of `_pin_place`."""
    low = min(max(math.floor(position), 0), values.shape[2] - 2)
    share = min(max(position - low, 0.0), 1.0)
    return (1.0 - share) * values[facing.slice_, facing.pin, low] + share * values[facing.slice_, facing.pin, low + 1]
