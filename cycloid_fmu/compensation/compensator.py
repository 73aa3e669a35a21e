"""A compensator: the data of a drive for a controller, and the step that uses them.

Every step takes a fixed number of operations, sums, products, quotients and square roots alone, so that all forms give
the same numbers. Theory: docs/theory/compensation.md.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation.inverse import Inverse
from cycloid_fmu.fmu.constants import FRICTION_ELEMENTS, LARGEST_TRANSMISSION_ERROR

Array = NDArray[np.float64]

LARGEST = 1e12  # a number of at least this size, as one that is none, counts as missing; also the band then
CORRELATION = 1.0  # rad of the crank over which what the model does not hold stays alike: counts as one measurement
MEMORY = 40.0 * math.pi  # rad of the crank after which what was learned counts 1/e
FIRST = 2.0  # measurements that the stated band counts against what is left
EXPECTED = (0.0, 0.0, 1.0, 1.0)  # offset (rad), further play (rad), gains of wind-up and ripple before measurements
KNOWN = (5e-4, 1e-4, 0.3, 1.0)  # their standard deviations then
LARGEST_GAIN = 2.0
GAIN_RATE = 0.25  # most that a gain changes over 1 rad of the crank
ANGLE_RATE = 1e-4  # rad of the output, likewise of offset and play
OUTLIER = 5.0  # standard deviations from which on a measurement counts as one so far off
SURE_FLANK = 0.99  # mean direction of the torque: with less of it the output may be on its way through the play
SETTLED = 0.5  # rad of the crank after that before measurements count again: the output comes late to the other flank
ALARM = 3.0  # times the stated band: of more than that left the model does not hold
ENOUGH = 3.0  # measurements before that is judged


@dataclass(frozen=True)
class Compensator:
    """The data of a drive for a controller.

    Attributes
    ----------
    ratio, crank_ratio
        Rotation of the motor, and of the crank, over that of the output; signed.
    inverse
        Deviation of the output over ideal crank angle, torque of the teeth and temperature.
    compliance
        Series compliance of the output, rad/(N·m).
    coulomb, load_share, stribeck, viscous, presliding_angle
        Friction at the output, as in `cycloid_fmu.Friction` (N·m, 1, N·m, N·m·s/rad, rad).
    stribeck_speed, stribeck_share
        Speeds (rad/s), from 0, and the remaining share of `stribeck`; linear between them.
    warmth_temperature, warmth
        Temperatures (K) and their factors on all friction except the viscous part.
    variance
        Of the deviation, from the fit, the torque's accuracy and the table, shape (temperatures, torques) of
        `inverse`, rad².
    ripple_variance
        Variance of the part that depends on the crank angle, likewise.
    sensor
        Standard deviation of the output encoder, rad.
    """

    ratio: float
    crank_ratio: float
    inverse: Inverse
    compliance: float
    coulomb: float
    load_share: float
    stribeck: float
    viscous: float
    presliding_angle: float
    stribeck_speed: Array
    stribeck_share: Array
    warmth_temperature: Array
    warmth: Array
    variance: Array
    ripple_variance: Array
    sensor: float

    @property
    def least_variance(self) -> float:
        """Smallest `variance`, rad²: measurements with a larger one have a lower weight."""
        return float(self.variance.min())

    @property
    def size(self) -> int:
        """Bytes of all tables."""
        t = self.inverse
        numbers = (t.scale, t.torque, t.temperature, t.mean, t.share, self.variance, self.ripple_variance)
        friction = (self.stribeck_speed, self.stribeck_share, self.warmth_temperature, self.warmth)
        return sum(one.nbytes for one in (*t.steps, *numbers, *friction))

    def start(self, index: float = 0.0) -> Memory:
        """Return an empty memory with the crank angle (rad) at which the output angle is 0, or NaN."""
        return Memory(index)

    def step(
        self, memory: Memory, desired_angle: float, desired_speed: float, load_torque: float, temperature: float,
        motor_angle: float = math.nan, output_angle: float = math.nan,
    ) -> Command:  # fmt: skip
        """Make a step of the controller: `step`."""
        return step(self, memory, desired_angle, desired_speed, load_torque, temperature, motor_angle, output_angle)


@dataclass
class Memory:
    """Memory of a compensator from step to step; a new one is empty.

    Attributes
    ----------
    index
        Crank angle of the model where the desired output angle is 0, rad; NaN if unknown: then the part that depends on
        the crank angle is not compensated.
    angle
        Desired output angle of the last step, rad; NaN before the first.
    strains
        Of the elements of friction, rad.
    output
        Last output angle that was measured, rad; NaN before the first.
    settled
        Rotation of the crank since the flank was uncertain, rad.
    applied
        Learned values in the command: difference of the encoders' zeros (rad), half of the added play (rad), gain of
        mean deviation and wind-up, gain of the part that depends on the crank angle.
    learned
        The same, as estimated from measurements.
    moments, products
        Fading sums over measurements: of the four regressors' products, row by row up to the diagonal, and of their
        products with the measured deviation.
    count, left
        Effective number of measurements, and their residual sum of squares, rad².
    """

    index: float = 0.0
    angle: float = math.nan
    strains: list[float] = field(default_factory=lambda: [0.0] * FRICTION_ELEMENTS)
    output: float = math.nan
    settled: float = SETTLED
    applied: list[float] = field(default_factory=lambda: list(EXPECTED))
    learned: list[float] = field(default_factory=lambda: list(EXPECTED))
    moments: list[float] = field(default_factory=lambda: [0.0] * 10)
    products: list[float] = field(default_factory=lambda: [0.0] * 4)
    count: float = 0.0
    left: float = 0.0


class Command(NamedTuple):
    """Output of a step.

    Attributes
    ----------
    motor_angle, motor_speed
        rad and rad/s.
    band
        Standard deviation of the output angle from the desired one, rad; `LARGEST` where an input is missing.
    gain
        Gain of the part that depends on the crank angle, 0 to 2; 0 if the index is unknown.
    holds
        Whether the model holds: the inputs are finite and within the table, and the residual is as expected.
    """

    motor_angle: float
    motor_speed: float
    band: float
    gain: float
    holds: bool


class _State(NamedTuple):
    """The tables at a torque and a temperature."""

    torque: float
    wound: float
    mean: float
    flank: float
    shares: Sequence[float]
    variance: float
    ripple: float


def step(
    compensator: Compensator, memory: Memory, desired_angle: float, desired_speed: float, load_torque: float,
    temperature: float, motor_angle: float = math.nan, output_angle: float = math.nan,
) -> Command:  # fmt: skip
    """Return the motor angle for a desired output angle, and learn from measurements.

    Parameters
    ----------
    compensator, memory
        The compensator, and its memory, which changes.
    desired_angle, desired_speed
        Of the output, rad and rad/s; the angle is near `motor_angle`/ratio.
    load_torque
        Of the environment on the output, including inertia, counter-clockwise positive, N·m.
    temperature
        Of the drive, K.
    motor_angle, output_angle
        Measured angles, rad; NaN without a measurement.
    """
    c, m = compensator, memory
    if not (_given(desired_angle) and _given(desired_speed) and _given(load_torque) and _given(temperature)):
        angle = desired_angle if _given(desired_angle) else m.angle if _given(m.angle) else 0.0
        return Command(c.ratio * angle, 0.0, LARGEST, 0.0, False)
    state = _state(c, torque_of_teeth(c, m, desired_angle, desired_speed, load_torque, temperature), temperature)
    inside = abs(state.torque) <= float(c.inverse.torque[-1])
    plausible = True
    if inside and _given(motor_angle) and _given(output_angle):
        plausible = _learn(c, m, state, motor_angle, output_angle)
    known = _given(m.index)
    offset, play, wound, gain = m.applied
    gain = gain if known else 0.0
    angle = desired_angle - offset - wound * state.wound
    ripple, slope = _ripple(c, state, angle * c.crank_ratio + m.index) if known else (0.0, 0.0)
    expected = state.variance + (0.0 if known else state.ripple)
    variance = (FIRST * expected + m.left) / (FIRST + m.count)
    holds = plausible and inside and not (
        m.count > ENOUGH and variance > ALARM * ALARM * (expected + c.sensor * c.sensor)
    )  # fmt: skip
    return Command(
        c.ratio * (angle - play * state.flank - wound * state.mean - gain * ripple),
        c.ratio * desired_speed * (1.0 - gain * c.crank_ratio * slope), math.sqrt(variance), gain, holds,
    )  # fmt: skip


def _given(value: float) -> bool:
    return abs(value) < LARGEST  # not so for NaN


def _between(nodes: Array, at: float) -> tuple[int, float]:
    """Return the cell between nodes in which a value is and its share of the cell; constant beyond the ends."""
    if len(nodes) == 1:
        return 0, 0.0
    cell = min(max(bisect.bisect_right(nodes, at) - 1, 0), len(nodes) - 2)
    share = (at - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    return cell, float(min(max(share, 0.0), 1.0))


def _on_line(nodes: Array, values: Array, at: float) -> float:
    cell, share = _between(nodes, at)
    return float((1.0 - share) * values[cell] + share * values[cell + 1] if share > 0.0 else values[cell])


def torque_of_teeth(c: Compensator, m: Memory, angle: float, speed: float, load: float, temperature: float) -> float:
    """Return the torque of the teeth, the load minus friction; the friction elements move."""
    way = angle - m.angle if _given(m.angle) else 0.0
    m.angle = angle
    dry = c.coulomb + c.load_share * abs(load)
    rest = dry + c.stribeck
    if rest <= 0.0:
        return load - c.viscous * speed
    sliding = dry + c.stribeck * _on_line(c.stribeck_speed, c.stribeck_share, abs(speed))
    warmth = _on_line(c.warmth_temperature, c.warmth, temperature)
    bound = c.presliding_angle * warmth * sliding / (rest * FRICTION_ELEMENTS)
    total = 0.0
    for i in range(FRICTION_ELEMENTS):
        most = bound * (i + 1)
        m.strains[i] = min(max(m.strains[i] + way, -most), most)
        total += m.strains[i]
    stiffness = 2.0 * rest / (c.presliding_angle * (FRICTION_ELEMENTS + 1))
    return load - stiffness * total - c.viscous * speed


def _state(c: Compensator, torque: float, temperature: float) -> _State:
    t = c.inverse
    i, u = _between(t.temperature, temperature)
    j, v = _between(t.torque, torque)
    k = min(i + 1, len(t.temperature) - 1)
    p, q, r, s = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v

    def at(values: Array) -> float:
        return float(p * values[i, j] + q * values[i, j + 1] + r * values[k, j] + s * values[k, j + 1])

    flank = float((1.0 - v) * t.flank[j] + v * t.flank[j + 1])
    shares = [at(t.share[..., n]) * float(t.scale[n]) for n in range(len(t.scale))]
    return _State(torque, c.compliance * torque, at(t.mean), flank, shares, at(c.variance), at(c.ripple_variance))


def _ripple(c: Compensator, state: _State, crank: float) -> tuple[float, float]:
    """Return the part of the deviation that depends on the ideal crank angle (rad), and its derivative."""
    turn = crank / c.inverse.period
    turn -= math.floor(turn)
    value = slope = 0.0
    for share, steps in zip(state.shares, c.inverse.steps, strict=True):
        knots = len(steps)
        place = turn * knots
        knot = min(int(place), knots - 1)
        s = place - knot
        a, b, d, e = (int(steps[(knot + n) % knots]) for n in (-1, 0, 1, 2))
        third, second, first = e - a + 3 * (b - d), 3 * (a + d - 2 * b), 3 * (d - a)
        value += share * (((third * s + second) * s + first) * s + (a + 4 * b + d))
        slope += share * knots * ((3 * third * s + 2 * second) * s + first)
    return value / 6.0, slope / (6.0 * c.inverse.period)


def _learn(c: Compensator, m: Memory, state: _State, motor_angle: float, output_angle: float) -> bool:
    """Learn from a measurement; return whether it is possible for this drive."""
    measured = output_angle - motor_angle / c.ratio
    if abs(measured) > LARGEST_TRANSMISSION_ERROR:
        return False
    known = _given(m.index)
    crank = (output_angle - m.applied[0] - m.applied[2] * state.wound) * c.crank_ratio
    ripple = _ripple(c, state, crank + m.index)[0] if known else 0.0
    rows = (1.0, state.flank, state.wound + state.mean, ripple)
    first = not _given(m.output)
    way = 0.0 if first else abs(c.crank_ratio * (output_angle - m.output))
    m.output = output_angle
    kept = max(0.0, 1.0 - way / MEMORY)
    expected = state.variance + c.sensor * c.sensor + (0.0 if known else state.ripple)
    variance = (FIRST * expected + kept * m.left) / (FIRST + kept * m.count)
    a, b, d, e = m.learned
    off = measured - (a * rows[0] + b * rows[1] + d * rows[2] + e * rows[3])
    m.settled = m.settled + way if abs(state.flank) >= SURE_FLANK else 0.0
    weight = 0.0 if m.settled < SETTLED else 1.0 if first else min(1.0, way / CORRELATION)
    weight *= min(1.0, (c.least_variance + c.sensor * c.sensor) / (state.variance + c.sensor * c.sensor))
    far = abs(off) / (OUTLIER * math.sqrt(variance))
    if far > 1.0:
        weight /= far
    m.count = kept * m.count + weight
    m.left = kept * m.left + weight * off * off
    n = 0
    for i in range(4):
        for j in range(i + 1):
            m.moments[n] = kept * m.moments[n] + weight * rows[i] * rows[j]
            n += 1
        m.products[i] = kept * m.products[i] + weight * rows[i] * measured
    sure = _solve(m, variance)
    # The mean square that is left is least where a gain that is not sure is taken for less.
    g = m.learned[3]
    ripple = g * g * g / (g * g + sure) if g > 0.0 else 0.0
    targets = (m.learned[0], m.learned[1], min(max(m.learned[2], 0.0), LARGEST_GAIN), min(ripple, LARGEST_GAIN))
    for i in range(4):
        most = way * (ANGLE_RATE if i < 2 else GAIN_RATE)
        m.applied[i] += min(max(targets[i] - m.applied[i], -most), most)
    return True


def _solve(m: Memory, variance: float) -> float:
    """Estimate the learned values from measurements and prior; return the last gain's variance.

    Normal equations, scaled by the prior, by Cholesky's decomposition: no pivot is below 1.
    """
    lower = [0.0] * 10  # on the diagonal its inverse
    right = [0.0] * 4
    weight = 1.0 / variance
    for i in range(4):
        row = i * (i + 1) // 2
        right[i] = KNOWN[i] * m.products[i] * weight + EXPECTED[i] / KNOWN[i]
        for j in range(i + 1):
            column = j * (j + 1) // 2
            total = KNOWN[i] * KNOWN[j] * m.moments[row + j] * weight + (1.0 if i == j else 0.0)
            for k in range(j):
                total -= lower[row + k] * lower[column + k]
            lower[row + j] = 1.0 / math.sqrt(max(total, 1.0)) if i == j else total * lower[column + j]
        for k in range(i):
            right[i] -= lower[row + k] * right[k]
        right[i] *= lower[row + i]
    for i in (3, 2, 1, 0):
        for k in range(i + 1, 4):
            right[i] -= lower[k * (k + 1) // 2 + i] * right[k]
        right[i] *= lower[i * (i + 1) // 2 + i]
    for i in range(4):
        m.learned[i] = KNOWN[i] * right[i]
    return KNOWN[3] * KNOWN[3] * lower[9] * lower[9]
