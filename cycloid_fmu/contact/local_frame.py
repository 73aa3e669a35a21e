"""A contact seen from the housing, and how its force changes with the position of the gear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.foot import path_curvature
from cycloid_fmu.contact.lanes import sine_cosine
from cycloid_fmu.contact.problem import Problem, poses
from cycloid_fmu.contact.rows import Rows, disc_slice_pin


class LocalFrame(NamedTuple):
    """One contact seen from the housing: directions, levers and curvatures at its foot."""

    disc: int
    slice: int
    pin: int
    tooth: int
    around: float  # foot's parameter around the gear, rad
    direction: float  # from the ring's centre to the pin's place on the pin circle, rad
    crank_x: float  # direction of the crank's throw
    crank_y: float
    normal_x: float  # from the flank to the pin's axis
    normal_y: float
    lever_x: float  # the pin's axis seen from the centre that the output turns about
    lever_y: float
    gear_x: float  # the pin's axis seen from the gear's centre
    gear_y: float
    slide: float  # tangential speed of the axis over the flank for each radian of the output
    bend: float  # curvature of the gap along the tangent
    speed: float  # |T'| at the foot
    foot: float  # rotation of the foot for each metre of slide
    facing: float  # cosine and sine of the normal's angle from the foot's radius
    leaning: float
    turning: float  # rotation of the normal against the foot's radius for each metre of slide


@compiled
def local_frame(problem: Problem, crank_angle: float, x: float, contacts: Rows, row: int) -> LocalFrame:
    """Local frame of a row that was solved at crank angle θ and transmission error x."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    crank, ring, gear = poses(problem, crank_angle, x, disc)
    pin_angle = pin * 2.0 * math.pi / (problem.teeth + 1)
    alpha = pin_angle + (crank - ring) / problem.teeth + contacts[row].foot
    whole = np.floor(alpha * problem.teeth / (2.0 * math.pi))
    tooth = int(whole - problem.teeth * np.floor(whole / problem.teeth))
    # The pin's axis from the ring's centre and from the gear's.
    sr, cr = 0.0, 1.0
    if problem.ring:
        sr, cr = sine_cosine(ring)
    sc, cc = sine_cosine(crank)
    axis_x = problem.pin_x[pin] * cr - problem.pin_y[pin] * sr
    axis_y = problem.pin_x[pin] * sr + problem.pin_y[pin] * cr
    gear_x = axis_x - problem.eccentricity * cc - problem.centre_x[slice_] - problem.shift_x[disc]
    gear_y = axis_y - problem.eccentricity * sc - problem.centre_y[slice_] - problem.shift_y[disc]
    lever_x, lever_y = (axis_x, axis_y) if problem.ring else (gear_x, gear_y)
    # The path at the foot, and the normal in the housing's frame.
    s, c = sine_cosine(problem.teeth * alpha)
    ez = problem.generating_eccentricity * (problem.teeth + 1)
    bx, by = problem.circle_radius - ez * c, -ez * s
    speed = math.sqrt(bx * bx + by * by)
    per_speed = 1.0 / speed
    facing, leaning = bx * per_speed, by * per_speed
    sa, ca = sine_cosine(alpha + gear + problem.tooth_turn[disc, tooth])
    nx, ny = ca * facing - sa * leaning, sa * facing + ca * leaning
    kappa = path_curvature(problem.circle_radius, problem.generating_eccentricity, problem.teeth, bx, speed)
    per_stretch = 1.0 / (1.0 + kappa * (contacts[row].gap + problem.pin_radius[pin] - problem.generating_radius))
    return LocalFrame(
        disc,
        slice_,
        pin,
        tooth,
        alpha,
        pin_angle + ring,
        cc,
        sc,
        nx,
        ny,
        lever_x,
        lever_y,
        gear_x,
        gear_y,
        slide=(1.0 if problem.ring else -1.0) * (lever_x * nx + lever_y * ny),
        bend=kappa * per_stretch,
        speed=speed,
        foot=per_speed * per_stretch,
        facing=facing,
        leaning=leaning,
        turning=(kappa - per_speed) * per_stretch,
    )


@compiled
def crank_motion(problem: Problem, local: LocalFrame) -> tuple[float, float]:
    """Motion of the gear's centre for each radian of the crank, m."""
    return -problem.eccentricity * local.crank_y, problem.eccentricity * local.crank_x


Vector = tuple[float, float, float]
"""Along the shift (u, v) of the gear's centre, m, and the gear's rotation y, rad."""


class GapGradient(NamedTuple):
    """Derivatives of a contact's gap, and of the sliding of the pin's axis along the flank, by the gear's position.

    Sliding is positive along ẑ × n, counter-clockwise; both are 1 for the shift and m for the rotation.
    """

    gap: Vector
    slide: Vector


@compiled
def gap_gradient(local: LocalFrame) -> GapGradient:
    """Derivatives of a contact's gap and sliding by the position of the gear."""
    nx, ny, px, py = local.normal_x, local.normal_y, local.gear_x, local.gear_y
    return GapGradient((-nx, -ny, nx * py - ny * px), (ny, -nx, -(nx * px + ny * py)))


@compiled
def force_fall(contact: np.record, local: LocalFrame, along: GapGradient) -> Vector:
    """Fall of a contact's force with the gear's position, by the approach and by the flank's curvature at the foot."""
    curved = contact.force_by_curvature * contact.curvature_rate * local.foot
    gap, slide, k = along.gap, along.slide, contact.stiffness
    return k * gap[0] - curved * slide[0], k * gap[1] - curved * slide[1], k * gap[2] - curved * slide[2]


Stiffness = tuple[Vector, Vector, Vector]
"""Derivatives of the forces and the moment that hold the gear against a contact, one row for each, by (u, v, y)."""


@compiled
def turning_stiffness(force: float, local: LocalFrame, along: GapGradient) -> Stiffness:
    """Stiffness of a force (N) that turns with the contact's normal, and whose lever turns with the gear."""
    bent, (su, sv, sy) = force * local.bend, along.slide
    tu, tv, ty = -bent * su, -bent * sv, -bent * sy - force
    return (
        (tu * su, tv * su, ty * su),
        (tu * sv, tv * sv, ty * sv),
        (tu * sy - force * su, tv * sy - force * sv, ty * sy),
    )


@compiled
def contact_stiffness(contact: np.record, local: LocalFrame, along: GapGradient) -> Stiffness:
    """Stiffness of one contact against shift and rotation of the gear: of -F ∂g/∂(u, v, y); N/m, N and N·m."""
    fu, fv, fy = force_fall(contact, local, along)
    gu, gv, gy = along.gap
    tu, tv, ty = turning_stiffness(contact.force, local, along)
    return (
        (fu * gu + tu[0], fv * gu + tu[1], fy * gu + tu[2]),
        (fu * gv + tv[0], fv * gv + tv[1], fy * gv + tv[2]),
        (fu * gy + ty[0], fv * gy + ty[1], fy * gy + ty[2]),
    )


@compiled
def projection(weights: Vector, along: Vector) -> float:
    """Sum of the products of two vectors."""
    return weights[0] * along[0] + weights[1] * along[1] + weights[2] * along[2]


@compiled
def projected_stiffness(contact: np.record, local: LocalFrame, along: GapGradient, weights: Vector) -> Vector:
    """Weighted sum of the rows of `contact_stiffness`: how a combination of the forces changes with the position."""
    return stiffness_along(contact, local, along, weights, projection(weights, along.gap))


@compiled
def stiffness_along(
    contact: np.record, local: LocalFrame, along: GapGradient, weights: Vector, closing: float
) -> Vector:
    """Do as `projected_stiffness`, with the change of the force's combination for each N that the contact presses."""
    fu, fv, fy = force_fall(contact, local, along)
    sliding = projection(weights, along.slide)
    (su, sv, sy), turned = along.slide, local.bend * sliding + weights[2]
    force = contact.force
    return (
        fu * closing - force * su * turned,
        fv * closing - force * sv * turned,
        fy * closing - force * (sy * local.bend + 1.0) * sliding,
    )


@compiled
def output_motion(problem: Problem, local: LocalFrame) -> Vector:
    """Motion of the gear against the pins for each radian of the output: its rotation, or the ring's backwards."""
    if problem.ring:
        return local.lever_y - local.gear_y, local.gear_x - local.lever_x, -1.0
    return 0.0, 0.0, 1.0


@compiled
def torque_by_shift(problem: Problem, contact: np.record, local: LocalFrame, along: Vector) -> tuple[float, float]:
    """Change of the contact's torque on the output where the gear's centre is shifted.

    `along` is its stiffness projected on `output_motion`. A ring turns about its own centre, from which the gear's
    shift moves what the torque is about.
    """
    lever = contact.force if problem.ring else 0.0
    return along[0] - lever * local.normal_y, along[1] + lever * local.normal_x
