"""A contact seen from the housing: how its torque changes where the pin's axis is displaced."""

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
    """One contact seen from the housing: what turns a displacement of the pin's axis into changes of gap and arm."""

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


class FlankFrame(NamedTuple):
    """The part of a `LocalFrame` that follows from foot and axis, its fields named as there; for contacts in lanes."""

    normal_x: float
    normal_y: float
    slide: float
    bend: float
    speed: float
    foot: float
    facing: float
    leaning: float
    turning: float


@compiled(inline=True)
def flank_frame(
    problem: Problem, alpha: float, angle: float, lever_x: float, lever_y: float, distance: float
) -> FlankFrame:
    """Frame of a contact.

    Parameters
    ----------
    alpha, angle
        The foot's parameter around the gear and its radius' direction in the housing, rad.
    lever_x, lever_y
        As in `LocalFrame`, m.
    distance
        Of the pin's axis from the generating path, > 0 outside, m.
    """
    s, c = sine_cosine(problem.teeth * alpha)
    ez = problem.generating_eccentricity * (problem.teeth + 1)
    bx, by = problem.circle_radius - ez * c, -ez * s
    speed = math.sqrt(bx * bx + by * by)
    facing, leaning = bx / speed, by / speed
    sa, ca = sine_cosine(angle)
    nx, ny = ca * facing - sa * leaning, sa * facing + ca * leaning
    kappa = path_curvature(problem.circle_radius, problem.generating_eccentricity, problem.teeth, bx, speed)
    stretch = 1.0 + kappa * distance
    slide = (1.0 if problem.ring else -1.0) * (lever_x * nx + lever_y * ny)
    return FlankFrame(
        nx, ny, slide, kappa / stretch, speed, 1.0 / (speed * stretch), facing, leaning, (kappa - 1.0 / speed) / stretch
    )


@compiled(inline=True)
def levers(
    problem: Problem,
    pin_x: float,
    pin_y: float,
    sr: float,
    cr: float,
    sc: float,
    cc: float,
    centre_x: float,
    centre_y: float,
) -> tuple[float, float, float, float]:
    """Lever and place from the gear's centre of a pin's axis, as in `LocalFrame`.

    Parameters
    ----------
    pin_x, pin_y
        The axis in the ring's frame, m.
    sr, cr, sc, cc
        Sine and cosine of the ring's rotation and of the crank's angle.
    centre_x, centre_y
        Displacement of the gear's centre, m.
    """
    axis_x, axis_y = pin_x * cr - pin_y * sr, pin_x * sr + pin_y * cr
    gear_x = axis_x - problem.eccentricity * cc - centre_x
    gear_y = axis_y - problem.eccentricity * sc - centre_y
    lever_x, lever_y = (axis_x, axis_y) if problem.ring else (gear_x, gear_y)
    return lever_x, lever_y, gear_x, gear_y


@compiled
def local_frame(problem: Problem, crank_angle: float, x: float, contacts: Rows, row: int) -> LocalFrame:
    """Local frame of a row that was solved at crank angle θ and deviation x."""
    disc, slice_, pin = disc_slice_pin(problem, row)
    crank, ring, gear = poses(problem, crank_angle, x, disc)
    place = pin * 2.0 * math.pi / (problem.teeth + 1)
    alpha = place + (crank - ring) / problem.teeth + contacts[row].foot
    tooth = math.floor(alpha * problem.teeth / (2.0 * math.pi)) % problem.teeth
    sr, cr = 0.0, 1.0
    if problem.ring:
        sr, cr = sine_cosine(ring)
    sc, cc = sine_cosine(crank)
    lx, ly, gx, gy = levers(
        problem,
        problem.pin_x[pin],
        problem.pin_y[pin],
        sr,
        cr,
        sc,
        cc,
        problem.centre_x[slice_] + problem.shift_x[disc],
        problem.centre_y[slice_] + problem.shift_y[disc],
    )
    distance = contacts[row].gap + problem.pin_radius[pin] - problem.generating_radius
    seen = flank_frame(problem, alpha, alpha + gear + problem.tooth_turn[disc, tooth], lx, ly, distance)
    return LocalFrame(
        disc,
        slice_,
        pin,
        tooth,
        alpha,
        place + ring,
        cc,
        sc,
        seen.normal_x,
        seen.normal_y,
        lx,
        ly,
        gx,
        gy,
        seen.slide,
        seen.bend,
        seen.speed,
        seen.foot,
        seen.facing,
        seen.leaning,
        seen.turning,
    )


class Carrying(NamedTuple):
    """Fields of a contact row that say how its torque changes; for contacts in lanes."""

    force: float
    stiffness: float
    force_by_curvature: float
    curvature_rate: float
    arm: float


@compiled(inline=True)
def displaced(
    contact: np.record | Carrying, local: LocalFrame | FlankFrame, vx: float, vy: float, wx: float, wy: float
) -> float:
    """Change of the contact's torque when its pin's axis moves by v relative to the gear.

    w is v's own change with the output's rotation. The torque is F L, so its change is dF L + F dL, with
    dL = -(n·w + (t·P_x)(t·v) κ/(1 + κ s)).
    """
    normal = vx * local.normal_x + vy * local.normal_y
    tangent = vy * local.normal_x - vx * local.normal_y
    turned = wx * local.normal_x + wy * local.normal_y
    mixed = turned + local.slide * tangent * local.bend
    curved = contact.force_by_curvature * contact.curvature_rate * tangent * local.foot
    return float((curved - contact.stiffness * normal) * contact.arm - contact.force * mixed)


@compiled
def crank_motion(problem: Problem, local: LocalFrame) -> tuple[float, float]:
    """Motion of the pin's axis relative to the gear for each radian of the crank, m.

    The gear's centre moves by e i e^{iθ}, so the pin's axis by the opposite of it.
    """
    return problem.eccentricity * local.crank_y, -problem.eccentricity * local.crank_x


class GapGradient(NamedTuple):
    """Derivatives of a contact's gap, and of the sliding of the pin's axis along the flank, by the gear's position.

    The position is the shift (u, v) of the gear's centre, m, and the gear's rotation y, rad; sliding is positive along
    ẑ × n, counter-clockwise.
    """

    gap_u: float  # 1
    gap_v: float
    gap_y: float  # m
    slide_u: float
    slide_v: float
    slide_y: float


@compiled
def gap_gradient(local: LocalFrame) -> GapGradient:
    """Derivatives of a contact's gap and sliding by the position of the gear."""
    nx, ny, px, py = local.normal_x, local.normal_y, local.gear_x, local.gear_y
    return GapGradient(-nx, -ny, nx * py - ny * px, ny, -nx, -(nx * px + ny * py))


class ContactStiffness(NamedTuple):
    """Derivatives of -F ∂g/∂(u, v, y), the forces and moment that hold the gear against one contact, by (u, v, y).

    The first letter is that of the force, the second that of the position; N/m, N and N·m.
    """

    uu: float
    uv: float
    uy: float
    vu: float
    vv: float
    vy: float
    yu: float
    yv: float
    yy: float


@compiled
def contact_stiffness(contact: np.record, local: LocalFrame, at: GapGradient) -> ContactStiffness:
    """Stiffness of one contact against shift and rotation of the gear.

    The force grows by the approach, turns with the normal as the axis slides over the bent flank, and changes with the
    flank's curvature at the foot; the rotation turns the lever of the pin's axis as well.
    """
    force, k = contact.force, contact.stiffness
    bent = force * local.bend
    curved = contact.force_by_curvature * contact.curvature_rate * local.foot
    # What the gap's derivatives by u, v and y change the force by, N/m and N.
    fu = k * at.gap_u - curved * at.slide_u
    fv = k * at.gap_v - curved * at.slide_v
    fy = k * at.gap_y - curved * at.slide_y
    return ContactStiffness(
        fu * at.gap_u - bent * at.slide_u * at.slide_u,
        fv * at.gap_u - bent * at.slide_u * at.slide_v,
        fy * at.gap_u - bent * at.slide_u * at.slide_y - force * at.slide_u,
        fu * at.gap_v - bent * at.slide_v * at.slide_u,
        fv * at.gap_v - bent * at.slide_v * at.slide_v,
        fy * at.gap_v - bent * at.slide_v * at.slide_y - force * at.slide_v,
        fu * at.gap_y - bent * at.slide_y * at.slide_u - force * at.slide_u,
        fv * at.gap_y - bent * at.slide_y * at.slide_v - force * at.slide_v,
        fy * at.gap_y - bent * at.slide_y * at.slide_y - force * at.slide_y,
    )
