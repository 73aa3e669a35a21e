"""Hertz's line contact: force, stiffness and half width."""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.lanes import Lanes, lanes_of, logarithm, vectors

_FORCE_STEP = 1e-5  # of the force: Halley's last step; the next one would be a fiftieth of its cube, or less
APPROACHED = lanes_of(
    "approach",
    "curvature",
    "pin_radius",
    "force",
    "stiffness",
    "force_by_curvature",
    "guess",
    "target",
    "h",
    "bending",
    "start",
    "q",
)


@compiled
def half_width(
    force: float, curvature: float, pin_radius: float, width: float, compliance_gear: float, compliance_pin: float
) -> float:
    """Half width of Hertz's line contact, a = sqrt(4 F ρ* (V_c + V_p)/(πb)), m; units as in `hertz`."""
    equivalent = 1.0 / max(abs(1.0 / pin_radius + curvature), 1e-9)
    return math.sqrt(4.0 * force * equivalent * (compliance_gear + compliance_pin) / (math.pi * width))


@compiled
def hertz(
    approach: float,
    curvature: float,
    pin_radius: float,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
    guess: float = 0.0,
    seat_compliance: float = 0.0,
) -> tuple[float, float, float]:
    """Force and stiffness of Hertz's line contact at a given approach.

    δ = (2F/πb)[V_c(ln(4|ρ_c|/a) - ½) + V_p(ln(4 R_rp/a) - ½)], a = sqrt(4 F ρ* (V_c + V_p)/(πb)) and
    ρ* = 1/|1/R_rp + 1/ρ_c|, solved for F (loaded-contact-wear and error-surface papers; docs/theory/contact.md).

    Parameters
    ----------
    approach
        δ > 0, m.
    curvature
        1/ρ_c of the flank, > 0 convex, 1/m.
    pin_radius, width
        m.
    compliance_gear, compliance_pin
        (1 - ν²)/E, 1/Pa.
    largest_log_radius
        |ρ_c| in the logarithm is at most this, m.
    guess
        A force to start from, N; 0 where there is none.
    seat_compliance
        Of a linear spring in series, m/N, whose way is part of the approach.

    Returns
    -------
    force, stiffness, by_curvature
        N, N/m, and the force's derivative by the flank's curvature, N·m.
    """
    law = _law(curvature, pin_radius, width, compliance_gear, compliance_pin, largest_log_radius)
    kappa, h = law.kappa, law.h
    # A spring in series adds to H.
    series = seat_compliance / kappa
    target = approach / kappa
    force = _first_guess(target, h, series) if guess <= 0.0 else guess
    q = change = start = 0.0
    for _ in range(30):
        start = force
        force, q = _following(force, target, h, series)
        change = abs(force - start)
        if change <= _FORCE_STEP * force:
            break
    q -= _logarithm_of_step(force, start)
    # Beyond H - ln F = 2 (half width near the radii) the law bends over; it is continued along its tangent there.
    limit = math.exp(h - 2.0) if q < 3.0 + series or change > _FORCE_STEP * force else math.inf
    if target >= (2.0 + series) * limit:
        force = (target - limit) / (1.0 + series)
        return force, 1.0 / (kappa * (1.0 + series)), 0.0
    return force, 1.0 / (kappa * (q - 1.0)), -force * law.bending / (q - 1.0)


class _Law(NamedTuple):
    """Hertz's law of one contact, δ = κ F (H - ln F)."""

    kappa: float
    h: float
    bending: float  # -∂H/∂(1/ρ_c), m


@compiled(inline=True)
def _law(
    curvature: float,
    pin_radius: float,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
) -> _Law:
    both = compliance_gear + compliance_pin
    kappa, share = both / (math.pi * width), compliance_gear / both
    pin_curvature = 1.0 / pin_radius
    relative = pin_curvature + curvature
    radius = 1.0 / (curvature if abs(curvature) > 1e-12 else 1e-12)
    log_radius = min(abs(radius), largest_log_radius)
    # 2 σ ln 4|ρ_c| + 2 (1 - σ) ln 4 R_rp - ln(4 ρ* κ) with two logarithms instead of three.
    h = (
        logarithm((4.0 / kappa) * log_radius * pin_radius * max(abs(relative), 1e-9))
        + (2.0 * share - 1.0) * logarithm(log_radius * pin_curvature)
        - 1.0
    )
    bending = 1.0 / relative
    bending -= 2.0 * share * radius if log_radius < largest_log_radius else 0.0
    return _Law(kappa, h, bending)


@compiled(inline=True)
def _first_guess(target: float, h: float, series: float) -> float:
    # Of 1 N: a better one takes a logarithm, and mostly there is the force of a neighbouring crank angle.
    return target / (max(h, 2.0) + series)


@compiled(inline=True)
def _following(force: float, target: float, h: float, series: float) -> tuple[float, float]:
    """Halley's next force, and H - ln F with what a spring adds, before it."""
    q = max(h - logarithm(force), 1.5) + series
    beyond, slope = force * q - target, q - 1.0
    # Far below the solution at most twice Newton's step.
    bend = max(2.0 * force * slope * slope + beyond, force * slope * slope)
    following = force - 2.0 * force * beyond * slope / bend
    return following if following > 0.0 else 0.5 * force, q


@compiled(inline=True)
def _logarithm_of_step(force: float, start: float) -> float:
    """ln(F/F₀) after the last step, whose cube is nothing."""
    share = (force - start) / start
    return share * (1.0 - 0.5 * share)


@compiled
def hertz_in_lanes(
    group: Lanes,
    filled: int,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
    seat_compliance: float,
) -> None:
    """Write force, stiffness and the force's derivative by curvature of contacts side by side, as `hertz`.

    What a lane gives does not depend on the others.

    Parameters
    ----------
    group
        `APPROACHED`, with each contact's approach, curvature, pin radius and first guess of the force; without an
        approach all three become 0.
    """
    lanes = vectors(filled)
    for lane in range(lanes):
        law = _law(
            group.curvature[lane], group.pin_radius[lane], width, compliance_gear, compliance_pin, largest_log_radius
        )
        group.h[lane], group.bending[lane] = law.h, law.bending
        target = max(group.approach[lane], 1e-15) / law.kappa
        guess = _first_guess(target, law.h, seat_compliance / law.kappa)
        group.target[lane], group.guess[lane], group.start[lane] = target, group.force[lane], 0.0
        group.force[lane] = group.force[lane] if (group.force[lane] > 0.0) & (group.approach[lane] > 0.0) else guess
    kappa = (compliance_gear + compliance_pin) / (math.pi * width)
    series = seat_compliance / kappa
    for _ in range(30):
        moving = 0
        for lane in range(lanes):
            start = group.force[lane]
            force, q = _following(start, group.target[lane], group.h[lane], series)
            ended = abs(start - group.start[lane]) <= _FORCE_STEP * start
            group.force[lane], group.q[lane] = start if ended else force, group.q[lane] if ended else q
            group.start[lane] = group.start[lane] if ended else start
            moving += 1 if abs(group.force[lane] - group.start[lane]) > _FORCE_STEP * group.force[lane] else 0
        if moving == 0:
            break
    bent = 0
    for lane in range(lanes):
        force, pressed = group.force[lane], group.approach[lane] > 0.0
        q = group.q[lane] - _logarithm_of_step(force, group.start[lane])
        group.q[lane] = q
        bent += 1 if q < 3.0 + series else 0
        group.force[lane] = force if pressed else 0.0
        softness = 1.0 / (q - 1.0)
        group.stiffness[lane] = softness / kappa if pressed else 0.0
        group.force_by_curvature[lane] = -group.force[lane] * group.bending[lane] * softness
    if bent > 0:
        for lane in range(lanes):
            if (group.approach[lane] > 0.0) & (group.q[lane] < 3.0 + series):
                group.force[lane], group.stiffness[lane], group.force_by_curvature[lane] = hertz(
                    group.approach[lane],
                    group.curvature[lane],
                    group.pin_radius[lane],
                    width,
                    compliance_gear,
                    compliance_pin,
                    largest_log_radius,
                    group.guess[lane],
                    seat_compliance,
                )


@compiled(inline=True)
def hertz_approach(
    force: float,
    curvature: float,
    pin_radius: float,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    log_radius: float,
    largest_force: float,
) -> tuple[float, float, float]:
    """Approach of Hertz's line contact under a force: `hertz` the other way round.

    Parameters
    ----------
    force
        F > 0, N.
    curvature, pin_radius, width, compliance_gear, compliance_pin
        As in `hertz`.
    log_radius
        |ρ_c| in the logarithm, m.
    largest_force
        The law is continued along its tangent beyond this force, or where it bends over before; N.

    Returns
    -------
    approach, softness, by_curvature
        m, dδ/dF (m/N), and the approach's derivative by the flank's curvature with the logarithm's radius held, m².
    """
    law = _law(curvature, pin_radius, width, compliance_gear, compliance_pin, math.inf)
    share = compliance_gear / (compliance_gear + compliance_pin)
    radius = 1.0 / (curvature if abs(curvature) > 1e-12 else 1e-12)
    # The law's own logarithm has 2 σ ln|ρ_c|.
    h = law.h + 2.0 * share * logarithm(log_radius / abs(radius))
    limit = min(largest_force, math.exp(h - 2.0))
    within = min(force, limit)
    q = h - logarithm(within)
    approach = law.kappa * (within * q + (q - 1.0) * (force - within))
    return approach, law.kappa * (q - 1.0), law.kappa * within * (law.bending + 2.0 * share * radius)
