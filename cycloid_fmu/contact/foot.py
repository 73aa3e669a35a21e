"""The flank is parallel to the generating pin's path T(α): the foot of a pin's axis on that path, and how T bends.

T(α) = R e^{iα} - e e^{i z_p α}, a point as a complex number (docs/theory/contact.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.lanes import sine_cosine

_FOOT_STEP = 1e-11  # m: Newton's last step along the flank; near a root the moment arm errs by a thousand times that


class Tangency(NamedTuple):
    """Where a pin's axis P stands to T(α), vectors turned by -α."""

    value: float  # (P - T)·T', 0 at a foot, m²
    slope: float  # its derivative by α
    axis_x: float  # P, m
    axis_y: float
    path_x: float  # B = T'/(i e^{iα}), m
    path_y: float
    apart_x: float  # P - T, m
    apart_y: float
    cosine: float  # of α
    sine: float


@compiled(inline=True)
def tangency(px: float, py: float, alpha: float, R: float, e: float, teeth: int) -> Tangency:
    """Tangency of the axis (px, py) and T at α."""
    pins = teeth + 1
    sa, ca = sine_cosine(alpha)
    s, c = sine_cosine(teeth * alpha)
    qx, qy = px * ca + py * sa, py * ca - px * sa
    bx, by = R - e * pins * c, -e * pins * s
    dx, dy = qx - (R - e * c), qy + e * s
    cx, cy = R - e * pins * pins * c, -e * pins * pins * s
    value, slope = dy * bx - dx * by, -(dx * cx + dy * cy) - (bx * bx + by * by)
    return Tangency(value, slope, qx, qy, bx, by, dx, dy, ca, sa)


@compiled
def foot(
    px: float, py: float, start: float, lower: float, upper: float, R: float, e: float, teeth: int
) -> tuple[bool, float, Tangency]:
    """Tangent point to P on the tooth between two roots, downhill from `start`: is there one, α and the tangency."""
    low, high = lower, upper
    low_known = high_known = False
    alpha = min(max(start, lower), upper)
    state = tangency(px, py, alpha, R, e, teeth)
    for _ in range(80):
        if state.slope < 0.0:
            step = -state.value / state.slope
            if abs(step) * math.sqrt(state.path_x * state.path_x + state.path_y * state.path_y) < _FOOT_STEP:
                return True, alpha, state
        else:
            step = math.copysign(0.15 * (upper - lower), state.value)
        if state.value > 0.0:
            low, low_known = alpha, True
        else:
            high, high_known = alpha, True
        if low >= high:
            return False, alpha, state
        alpha += step
        if alpha <= low:
            alpha = 0.5 * (low + high) if low_known else lower
        elif alpha >= high:
            alpha = 0.5 * (low + high) if high_known else upper
        state = tangency(px, py, alpha, R, e, teeth)
    return True, alpha, state


@compiled(inline=True)
def on_tooth(px: float, py: float, turn: float) -> tuple[float, float]:
    """P in the frame of a tooth turned by a small angle."""
    c = 1.0 - 0.5 * turn * turn
    s = turn * (1.0 - turn * turn / 6.0)
    return px * c + py * s, py * c - px * s


@compiled(inline=True)
def path_curvature(R: float, e: float, teeth: int, bx: float, speed: float) -> float:
    """Curvature of T, > 0 convex: R²(1 + z_p K² - K (z_p + 1) cos z_c α)/|T'|³, with cos from B, 1/m."""
    pins = teeth + 1
    ez = e * pins
    return (R * R + ez * ez * pins - (pins + 1) * R * (R - bx)) / (speed * speed * speed)
