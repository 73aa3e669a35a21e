"""Friction at a flange: sliding friction, and elements that stick before sliding begins.

The sliding friction torque is F = (Coulomb + share |load| + Stribeck extra · exp(-(w/w_s)²)) · exp(-β(T - T_ref)), at
`flange_a` plus Modelica's loss table (`losses`); a viscous torque with the same temperature factor is added. Before
sliding, Maxwell-slip elements in parallel stick (W. D. Iwan, J. Appl. Mech. 33 (1966) 893; F. Al-Bender, V. Lampaert
and J. Swevers, IEEE Trans. Autom. Control 50 (2005) 1883): each is a spring that slides when its torque reaches its
share of F. A reversal is remembered until the motion passes it again, a load below F is held without creep, and the
springs slip back when F falls, so no energy is gained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cycloid_fmu.fmu.constants import (
    FRICTION_ELEMENTS,
    FRICTION_ITERATIONS,
    FRICTION_ROUNDING,
    INPUT_PRESLIDING_ANGLE,
    INPUT_STRIBECK_SPEED,
    OUTPUT_PRESLIDING_ANGLE,
    OUTPUT_STRIBECK_SPEED,
    PRESLIDING_TIME,
    REFERENCE_TEMPERATURE,
)
from cycloid_fmu.fmu.losses import Row, lost_torque

# Equal springs whose yield strains are evenly spaced up to the presliding angle (Iwan's uniform distribution): torque
# over strain is a piecewise linear parabola, F (1 - (1 - z/z_s)²).
SHARE = 2.0 / (FRICTION_ELEMENTS * (FRICTION_ELEMENTS + 1.0))
"""Share of the first element in the sliding friction torque; the others have twice, three times, … as much."""
LOSSLESS = (1.0, 1.0, 0.0, 0.0)  # a row of the loss table, without its speed
UNSTRAINED = (0.0,) * FRICTION_ELEMENTS


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


def yields(
    law: Law, load: float, speed: float, temperature: float, table: Sequence[Row] | None = None
) -> tuple[float, float]:
    """Sliding friction torques towards negative and towards positive angles, N·m.

    Parameters
    ----------
    law
        Friction of the flange.
    load, speed
        Torque of the teeth at that flange, N·m, and its speed, rad/s.
    temperature
        Temperature, K.
    table
        Loss table, at `flange_a`.
    """
    torque = law.coulomb + law.load_share * abs(load)
    if law.stribeck > 0.0:
        share = speed / law.stribeck_speed
        torque += law.stribeck * math.exp(-min(share * share, 700.0))
    warmth = factor(law, temperature)
    if table is None:
        return warmth * torque, warmth * torque
    low, high = lost_torque(table, speed, -load), lost_torque(table, speed, load)
    return warmth * (torque + low), warmth * (torque + high)


def element_stiffness(law: Law, load: float, table: Sequence[Row] | None = None) -> float:
    """Stiffness of each element, N·m/rad: from rest under a load (N·m), all slide after the presliding angle."""
    cold = law._replace(temperature_coefficient=0.0)
    torque = max(yields(cold, load, 0.0, law.reference_temperature, table))
    return 2.0 * torque / (law.presliding_angle * (FRICTION_ELEMENTS + 1))


class Slid(NamedTuple):
    """Result of a displacement of the elements.

    Attributes
    ----------
    strains
        Strains at its end, rad.
    torque, slope
        Mean torque against the displacement, N·m, and its derivative by the displacement's end, N·m/rad.
    stored, lost
        Increase of the stored energy, and lost energy, J: their sum is torque times displacement.
    """

    strains: list[float]
    torque: float
    slope: float
    stored: float
    lost: float


def slide(strains: Sequence[float], way: float, time: float, stiffness: float, low: float, high: float) -> Slid:
    """Return the result of a displacement of a flange's elements.

    Parameters
    ----------
    strains
        Strains of the elements, rad.
    way, time
        Rotation of the flange (rad), and its duration (s), for the damping; 0 without damping.
    stiffness
        Stiffness of each element, N·m/rad.
    low, high
        Torques at which all of them slide, from `yields`, N·m.
    """
    found, torque, slope, stored, lost = [], 0.0, 0.0, 0.0, 0.0
    damping = stiffness * PRESLIDING_TIME / time if time > 0.0 else 0.0
    low, high = SHARE * low / stiffness, SHARE * high / stiffness
    bound = stiffness * (high if way > 0.0 else -low)
    for i, strain in enumerate(strains, start=1):
        least, most = -i * low, i * high
        start = least if strain < least else most if strain > most else strain
        end = start + way
        if least <= end <= most:
            stuck, mean, change = way, stiffness * (start + 0.5 * way), 0.5 * stiffness
        else:
            end = most if way > 0.0 else least
            stuck = end - start
            change = 0.5 * stiffness * (stuck / way) ** 2
            mean = stiffness * end - change * way
        damped = damping * stuck
        room = i * bound - mean
        if abs(damped) >= abs(room):
            damped, change = room, 0.0
        elif stuck == way:
            change += damping
        found.append(end)
        torque += mean + damped
        slope += change
        stored += 0.5 * stiffness * (end * end - strain * strain)
        lost += 0.5 * stiffness * (strain * strain - start * start)
        lost += stiffness * end * (way - stuck) + damped * way
    return Slid(found, torque, slope, stored, lost)


def held_strains(
    strains: Sequence[float], way: float, stiffness: float, low: float, high: float
) -> tuple[list[float], float]:
    """Return the strains after a slow displacement (rad), and the stiffness of the sticking elements, N·m/rad."""
    found, held = [], 0
    low, high = SHARE * low / stiffness, SHARE * high / stiffness
    for i, strain in enumerate(strains, start=1):
        least, most = -i * low, i * high
        end = (least if strain < least else most if strain > most else strain) + way
        if end <= least:
            end = least
        elif end >= most:
            end = most
        else:
            held += 1
        found.append(end)
    return found, stiffness * held


def balanced(
    missing: Callable[[float], tuple[float, float]], low: float, high: float, start: float, accuracy: float
) -> float:
    """Return the zero of an increasing function, by Newton's method within bounds; the last argument evaluated.

    Parameters
    ----------
    missing
        The function, which returns its value and derivative.
    low, high, start
        Bounds, and the start.
    accuracy
        Length of a step after which the iteration ends.
    """
    at, before, step = min(max(start, low), high), high - low, high - low
    for _ in range(FRICTION_ITERATIONS):
        value, slope = missing(at)
        low, high = (low, at) if value > 0.0 else (at, high)
        # Newton's steps must halve, or they could alternate for ever between two sliding states.
        if slope > 0.0 and low <= at - value / slope <= high and abs(2.0 * value) <= before * slope:
            following = at - value / slope
        else:
            following = 0.5 * (low + high)
        before, step = step, abs(following - at)
        if step <= accuracy:
            break
        at = following
    return at


class Pressed(NamedTuple):
    """Elements at a position and speed: torque against the flange (N·m), lost power (W), stored energy (J)."""

    torque: float
    power: float
    stored: float


def press(
    strains: Sequence[float],
    way: float,
    speed: float,
    stiffness: float,
    low: float,
    high: float,
    time: float = PRESLIDING_TIME,
) -> Pressed:
    """Return the state of the elements after a displacement (rad), at a speed (rad/s).

    `time` is their damping over their stiffness, s; the others are as for `slide`.
    """
    torque = power = stored = 0.0
    damped, low, high = stiffness * time * speed, SHARE * low, SHARE * high
    for i, strain in enumerate(strains, start=1):
        least, most = -i * low, i * high
        elastic = stiffness * (strain + way)
        elastic = least if elastic < least else most if elastic > most else elastic
        reached = elastic + damped
        found = least if reached < least else most if reached > most else reached
        torque += found
        # An element that slides only by its damping counts as sliding, as it soon does.
        near = FRICTION_ROUNDING * (most - least)
        power += speed * (found if (reached >= most - near if speed > 0.0 else reached <= least + near) else damped)
        held = strain if way == 0.0 else elastic / stiffness  # at rest, energy above a reduced yield is not lost yet
        stored += 0.5 * stiffness * held * held
    return Pressed(torque, power, stored)


class FrictionState:
    """Friction of both flanges as part of a model's state: `_rub` moves it, `_press` evaluates it.

    A model has `friction`, `loss_table`, `temperature` and `_strains` (`stepped_model.State`).
    """

    friction: list[list[float]]
    loss_table: list[list[float]]
    temperature: float
    _strains: list[list[float]]
    _laws: tuple[Law, Law]
    _elements: tuple[float, float]
    _rubs: tuple[bool, bool]
    _table: Sequence[Row] | None

    def _settle_friction(self, loads: tuple[float, float]) -> None:
        """Compute the values that depend on the laws; `loads` is the rated torque at both flanges, N·m."""
        self._laws = Law(*self.friction[0]), Law(*self.friction[1])
        self._table = self.loss_table if any(row[1:] != list(LOSSLESS) for row in self.loss_table) else None
        self._elements = (
            element_stiffness(self._laws[0], loads[0], self._table),
            element_stiffness(self._laws[1], loads[1]),
        )
        self._rubs = tuple(  # type: ignore[assignment]
            k > 0.0 or law.viscous > 0.0 for k, law in zip(self._elements, self._laws, strict=True)
        )

    def _yields(self, flange: int, load: float, speed: float) -> tuple[float, float]:
        return yields(self._laws[flange], load, speed, self.temperature, None if flange else self._table)

    def _viscous(self, flange: int) -> float:
        law = self._laws[flange]
        return law.viscous * factor(law, self.temperature) if law.viscous > 0.0 else 0.0

    def _rub(self, flange: int, way: float, time: float, load: float) -> Slid:
        """Friction of a flange over a displacement (rad) in a time (s) under a load (N·m); the state is unchanged."""
        speed, stiffness, viscous = way / time if time > 0.0 else 0.0, self._elements[flange], self._viscous(flange)
        if stiffness > 0.0:
            found = slide(self._strains[flange], way, time, stiffness, *self._yields(flange, load, speed))
        else:
            found = Slid(self._strains[flange], 0.0, 0.0, 0.0, 0.0)
        if viscous > 0.0 and time > 0.0:
            torque = viscous * speed
            found = Slid(
                found.strains,
                found.torque + torque,
                found.slope + viscous / time,
                found.stored,
                found.lost + torque * way,
            )
        return found

    def _press(self, flange: int, way: float, speed: float, load: float, time: float = PRESLIDING_TIME) -> Pressed:
        """Friction of a flange displaced from its last position (rad), at a speed (rad/s), under a load (N·m)."""
        stiffness, viscous = self._elements[flange], self._viscous(flange) * speed
        if stiffness == 0.0:
            return Pressed(viscous, viscous * speed, 0.0)
        found = press(self._strains[flange], way, speed, stiffness, *self._yields(flange, load, speed), time)
        return Pressed(found.torque + viscous, found.power + viscous * speed, found.stored)

    def _put_strains(self, flange: int, strains: Sequence[float]) -> None:
        self._strains = [list(strains), self._strains[1]] if flange == 0 else [self._strains[0], list(strains)]
