"""Friction at a flange: sliding friction, and elements that stick before sliding begins.

The sliding friction torque is F = (Coulomb + share |load| + Stribeck extra · exp(-(w/w_s)²)) · exp(-β(T - T_ref)), at
`flange_a` plus Modelica's loss table; a viscous torque with the same temperature factor is added. Before
sliding, Maxwell-slip elements in parallel stick (W. D. Iwan, J. Appl. Mech. 33 (1966) 893; F. Al-Bender, V. Lampaert
and J. Swevers, IEEE Trans. Autom. Control 50 (2005) 1883): each is a spring that slides when its torque reaches its
share of F. A reversal is remembered until the motion passes it again, a load below F is held without creep, and the
springs slip back when F falls, so no energy is gained. The elements are in `fmu/clockwork/friction.c`; here are the
parameters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu.fmu.constants import (
    INPUT_PRESLIDING_ANGLE,
    INPUT_STRIBECK_SPEED,
    OUTPUT_PRESLIDING_ANGLE,
    OUTPUT_STRIBECK_SPEED,
    REFERENCE_TEMPERATURE,
)


class Law(NamedTuple):
    """Friction at one flange as numbers: `friction_file.Friction` with its defaults."""

    coulomb: float
    load_share: float
    stribeck: float
    stribeck_speed: float
    viscous: float
    temperature_coefficient: float
    reference_temperature: float
    presliding_angle: float


FLANGES = ("input", "output")
"""Prefixes of the variables that both `flange_a`, 0, and `flange_b`, 1, have."""
NO_FRICTION = (
    Law(0.0, 0.0, 0.0, INPUT_STRIBECK_SPEED, 0.0, 0.0, REFERENCE_TEMPERATURE, INPUT_PRESLIDING_ANGLE),
    Law(0.0, 0.0, 0.0, OUTPUT_STRIBECK_SPEED, 0.0, 0.0, REFERENCE_TEMPERATURE, OUTPUT_PRESLIDING_ANGLE),
)


def factor(law: Law, temperature: float) -> float:
    """Return the factor, dimensionless, by which a temperature (K) multiplies a law's torques."""
    coefficient = law.temperature_coefficient
    return 1.0 if coefficient == 0.0 else math.exp(-coefficient * (temperature - law.reference_temperature))
