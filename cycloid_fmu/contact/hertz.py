"""Hertz's line contact: force, stiffness and half width."""

from __future__ import annotations

import math

from cycloid_fmu.contact.compiling import compiled


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
    both = compliance_gear + compliance_pin
    equivalent = 1.0 / max(abs(1.0 / pin_radius + curvature), 1e-9)
    log_radius = min(1.0 / max(abs(curvature), 1e-12), largest_log_radius)
    # With κ = (V_c + V_p)/(πb) the law reads δ = κ F (H - ln F).
    kappa = both / (math.pi * width)
    share = compliance_gear / both
    h = (
        2.0 * (share * math.log(4.0 * log_radius) + (1.0 - share) * math.log(4.0 * pin_radius))
        - 1.0
        - math.log(4.0 * equivalent * kappa)
    )
    # A spring in series adds to H.
    series = seat_compliance / kappa
    target = approach / kappa
    force = target / (max(h - math.log(target) + 2.0, 2.0) + series) if guess <= 0.0 else guess
    q = change = start = 0.0
    for _ in range(30):
        q = max(h - math.log(force), 1.5) + series
        following = (target - force) / (q - 1.0)
        if following <= 0.0:
            following = 0.5 * force
        start, force = force, following
        change = abs(force - start)
        # The next step would be a thirtieth of the square of this one, or less.
        if change <= 1e-6 * force:
            break
    # ln F of the last step, whose square is nothing.
    q -= (force - start) / force
    # Beyond H - ln F = 2 (half width near the radii) the law bends over; it is continued along its tangent there.
    limit = math.exp(h - 2.0) if q < 3.0 + series or change > 1e-5 * force else math.inf
    if target >= (2.0 + series) * limit:
        force = (target - limit) / (1.0 + series)
        return force, 1.0 / (kappa * (1.0 + series)), 0.0
    bending = 1.0 / (1.0 / pin_radius + curvature)
    if log_radius < largest_log_radius:
        bending -= 2.0 * share / curvature
    return force, 1.0 / (kappa * (q - 1.0)), -force * bending / (q - 1.0)
