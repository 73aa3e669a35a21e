"""What each pin carries, and the contact lines with the pressure that each element has seen."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.hertz import half_width
from cycloid_fmu.contact.local_frame import local_frame
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows, disc_slice_pin, touching_count

_COUNTED = 0.01  # a pin counts as in contact above this share of the most loaded pin's force


class ContactLines(NamedTuple):
    """Contact lines of a sweep and the largest pressure that each element has seen.

    Attributes
    ----------
    slice_force, slice_direction
        Shape (torques, angles, discs, pins, slices): force in each slice (N) and direction of the contact about the
        pin's axis from that to the pin circle's centre (rad).
    gear_pressure, pin_pressure
        Shapes (torques, discs, teeth, profile, slices) and (torques, pins, angle, slices), Pa.
    flank_alpha, flank_x, flank_y
        The flank's points as in `Deviations`: the ends of tooth 0 and the middles of its elements.
    """

    slice_force: NDArray[np.float32]
    slice_direction: NDArray[np.float32]
    gear_pressure: Array
    pin_pressure: Array
    flank_alpha: Array
    flank_x: Array
    flank_y: Array


@compiled
def load_sharing(problem: Problem, contacts: Rows, pin_force: Array, pin_pressure: Array) -> tuple[int, float]:
    """Force and largest pressure of each pin, from solved contact rows.

    Parameters
    ----------
    problem, contacts
        The contact problem and its solution.
    pin_force, pin_pressure
        Overwritten, shape (discs, pins): force summed over slices (N), largest p = 2F/(πab) (Pa).

    Returns
    -------
    contact_count, max_contact_pressure
        Pins that carry more than 1 % of the most loaded pin's force; Pa.
    """
    discs, pins = pin_force.shape
    pin_radius = problem.pin_radius
    stress = 1.0 / (math.pi * problem.slice_width * (problem.compliance_gear + problem.compliance_pin))
    for disc in range(discs):
        for pin in range(pins):
            pin_force[disc, pin] = pin_pressure[disc, pin] = 0.0
    largest_force = largest_pressure = 0.0
    for i in range(touching_count(contacts)):
        row = int(contacts[i].touching)
        force = contacts[row].force
        if force <= 0.0:
            continue
        disc, _, pin = disc_slice_pin(problem, row)
        # 2F/(πab) with a of `half_width`
        pressure = math.sqrt(force * stress * max(abs(1.0 / pin_radius[pin] + contacts[row].curvature), 1e-9))
        pin_force[disc, pin] += force
        pin_pressure[disc, pin] = max(pin_pressure[disc, pin], pressure)
        # A pin's force only grows, so the last of its sums is the largest.
        largest_force = max(largest_force, pin_force[disc, pin])
        largest_pressure = max(largest_pressure, pressure)
    count = 0
    for disc in range(discs):
        for pin in range(pins):
            count += 1 if pin_force[disc, pin] > _COUNTED * largest_force else 0
    return count, largest_pressure


@compiled
def _half_width(problem: Problem, contact: np.record, pin: int) -> float:
    return half_width(
        contact.force,
        contact.curvature,
        problem.pin_radius[pin],
        problem.slice_width,
        problem.compliance_gear,
        problem.compliance_pin,
    )


@compiled
def write_contact_lines(
    problem: Problem, lines: ContactLines | None, load: int, angle: int, crank_angle: float, x: float, contacts: Rows
) -> None:
    """Write the contact lines of one solved position and raise the elements' largest pressures."""
    if lines is None:
        return
    pitch = 2.0 * math.pi / problem.teeth
    points, gear_map, pin_map = lines.flank_alpha, lines.gear_pressure[load], lines.pin_pressure[load]
    slice_force, slice_direction = lines.slice_force[load, angle], lines.slice_direction[load, angle]
    elements, angles = gear_map.shape[2], pin_map.shape[1]
    for disc in range(slice_force.shape[0]):
        for pin in range(slice_force.shape[1]):
            for slice_ in range(slice_force.shape[2]):
                slice_force[disc, pin, slice_] = slice_direction[disc, pin, slice_] = 0.0
    arc = math.hypot(lines.flank_x[2] - lines.flank_x[1], lines.flank_y[2] - lines.flank_y[1])
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        if contact.force <= 0.0:
            continue
        local = local_frame(problem, crank_angle, x, contacts, row)
        disc, slice_, pin = local.disc, local.slice, local.pin
        c, s = math.cos(local.direction), math.sin(local.direction)
        # The contact lies from the pin's axis against the flank's normal.
        direction = math.atan2(c * local.normal_y - s * local.normal_x, c * local.normal_x + s * local.normal_y)
        slice_force[disc, pin, slice_] += contact.force
        slice_direction[disc, pin, slice_] = direction
        half = _half_width(problem, contact, pin)
        pressure = 2.0 * contact.force / (math.pi * half * problem.slice_width)
        along = local.around - math.floor(local.around / pitch) * pitch
        point = min(max(int(np.searchsorted(points, along)), 1), points.size - 1)
        share = (along - points[point - 1]) / (points[point] - points[point - 1])
        middle = point - 2.0 + share
        reach = half / arc
        for element in range(max(0, math.ceil(middle - reach)), min(elements, math.floor(middle + reach) + 1)):
            seen = pressure * math.sqrt(max(1.0 - ((element - middle) / reach) ** 2, 0.0))
            gear_map[disc, local.tooth, element, slice_] = max(gear_map[disc, local.tooth, element, slice_], seen)
        middle = (direction / math.pi + 0.5) * angles - 0.5
        reach = half / problem.pin_radius[pin] / math.pi * angles
        for element in range(max(0, math.ceil(middle - reach)), min(angles, math.floor(middle + reach) + 1)):
            seen = pressure * math.sqrt(max(1.0 - ((element - middle) / reach) ** 2, 0.0))
            pin_map[pin, element, slice_] = max(pin_map[pin, element, slice_], seen)
