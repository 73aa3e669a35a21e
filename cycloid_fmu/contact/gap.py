"""What a foot gives: gap, moment arm, the flank's curvature and their rates, written into a contact row."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.foot import Tangency, on_tooth, path_curvature


class Flank(NamedTuple):
    """What a flank is made by, and whether the pin ring is the output."""

    circle_radius: float
    eccentricity: float
    radius: float
    teeth: int
    ring: bool


class Offset(NamedTuple):
    """The gear's centre from the pin circle's, and the crank's eccentricity alone, in the tooth's frame, m."""

    x: float
    y: float
    crank_x: float
    crank_y: float


@compiled(inline=True)
def offset_on_tooth(x: float, y: float, crank_x: float, crank_y: float, turn: float) -> Offset:
    """Offset, of its components in the gear's frame, from a tooth turned by a small angle (rad)."""
    x, y = on_tooth(x, y, turn)
    crank_x, crank_y = on_tooth(crank_x, crank_y, turn)
    return Offset(x, y, crank_x, crank_y)


class Contact(NamedTuple):
    """What a foot gives: fields of a contact row."""

    foot: float
    profile_parameter: float
    foot_rate: float
    gap: float
    arm: float
    arm_rate: float
    curvature: float
    curvature_rate: float
    gap_by_crank: float
    foot_by_crank: float


@compiled(inline=True)
def contact_at(flank: Flank, offset: Offset, pin_radius: float, foot: float, alpha: float, state: Tangency) -> Contact:
    """Gap, moment arm and their rates where the pin is nearest the flank's point α.

    The foot is that of the pin on the nominal flank, as an offset from the conjugate point; α is the same place unless
    deviations move the contact along the flank.
    """
    circle_radius, eccentricity, radius, teeth, ring = flank
    _, slope, qx, qy, bx, by, dx, dy, ca, sa = state
    ox, oy, crank_x, crank_y = offset
    speed2 = bx * bx + by * by
    speed = math.sqrt(speed2)
    # The common normal runs from the flank's point, r inside T, to the pin's axis.
    wx, wy = dx + radius * bx / speed, dy + radius * by / speed
    distance = math.sqrt(wx * wx + wy * wy)
    nx, ny = wx / distance, wy / distance
    sign, turning = -1.0, 1.0 / teeth
    if ring:
        qx, qy = qx + ox * ca + oy * sa, qy + oy * ca - ox * sa
        sign, turning = 1.0, -1.0 / (teeth + 1)
    # With Q the lever of the rotation in the foot's frame, the gap falls by the arm for each radian.
    lever = qx * nx + qy * ny
    # 1 + κ s, because (P - T)·T'' = -κ s |T'|²
    stretch = -slope / speed2
    kappa = path_curvature(circle_radius, eccentricity, teeth, bx, speed)
    foot_rate = sign * lever / (speed * stretch)
    arm = sign * (qy * nx - qx * ny)
    # The gear's centre moves by i times the eccentricity, so the pin's axis by the opposite of it.
    vx, vy = crank_y * ca - crank_x * sa, -crank_x * ca - crank_y * sa
    along = (vy * bx - vx * by) / (speed2 * stretch)
    inside = 1.0 / (1.0 - radius * kappa)
    return Contact(
        foot,
        alpha,
        foot_rate,
        gap=distance - pin_radius,
        arm=arm,
        arm_rate=lever - lever * lever * kappa / stretch,
        curvature=kappa * inside,
        curvature_rate=(-circle_radius * teeth * by * ((teeth + 2) / speed - 3.0 * kappa) / speed2 * inside * inside),
        gap_by_crank=vx * nx + vy * ny + turning * arm,
        foot_by_crank=along - turning * foot_rate - abs(turning),
    )


@compiled(inline=True)
def write_contact(row: np.record, solved: Contact, crank_angle: float, x: float) -> None:
    """Write a contact that was solved at crank angle θ and transmission error x."""
    row.foot, row.profile_parameter, row.foot_rate = solved.foot, solved.profile_parameter, solved.foot_rate
    row.gap, row.arm, row.arm_rate = solved.gap, solved.arm, solved.arm_rate
    row.curvature, row.curvature_rate = solved.curvature, solved.curvature_rate
    row.gap_by_crank, row.foot_by_crank = solved.gap_by_crank, solved.foot_by_crank
    row.crank_angle, row.transmission_error = crank_angle, x
