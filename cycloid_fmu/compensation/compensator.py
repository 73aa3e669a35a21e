"""A compensator: the data of a drive for a controller, and the step that uses them.

Every step takes a fixed number of operations: sums, products, quotients and square roots only, so that all forms give
the same numbers. Divisions by constants of the drive are made beforehand. Theory: docs/theory/compensation.md.
"""

from __future__ import annotations

import bisect
import functools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation.inverse import Inverse
from cycloid_fmu.fmu.constants import FRICTION_ELEMENTS, LARGEST_TRANSMISSION_ERROR

Array = NDArray[np.float64]

LARGEST = 1e12  # an input of at least this size counts as missing, as NaN does; it is the band then
CORRELATION = 1.0  # rad of the crank over which the model's errors are correlated: counts as one measurement
MEMORY = 40.0 * math.pi  # rad of the crank after which what was learned counts 1/e
FIRST = 2.0  # weight of the stated band in the variance of the residuals, in measurements
EXPECTED = (0.0, 0.0, 1.0, 1.0)  # offset (rad), further play (rad), gains of wind-up and ripple before measurements
KNOWN = (5e-4, 1e-4, 0.3, 1.0)  # their standard deviations then
PRIOR = tuple(value / known for value, known in zip(EXPECTED, KNOWN, strict=True))
LARGEST_GAIN = 2.0
GAIN_RATE = 0.25  # most that a gain changes over 1 rad of the crank
ANGLE_RATE = 1e-4  # rad of the output, likewise of offset and play
OUTLIER = 5.0  # standard deviations; a measurement beyond them counts as one at this distance
SURE_FLANK = 0.99  # mean sign of the torque: below it the output may be moving through the play
SETTLED = 0.05  # rad of the output after that before measurements count again: it reaches the flank late
ALARM = 3.0  # times the stated band: with a larger residual the model does not hold
LEAST_GAIN = 0.7  # of the index's probability: if the ripple's gain is surely smaller, the model does not hold
ENOUGH = 3.0  # measurements before that is judged
COLUMNS = 4  # of `Tables.node` before the functions of the crank angle
SUPPORT = 4  # coefficients of a cubic spline that contribute at a point


@dataclass(frozen=True)
class Compensator:
    """The data of a drive for a controller.

    Attributes
    ----------
    ratio, crank_ratio
        Rotation of the motor, and of the crank, over that of the output; signed.
    inverse
        Transmission error over ideal crank angle, torque of the teeth and temperature.
    compliance
        Series compliance of the output, rad/(N·m).
    coulomb, load_share, stribeck, viscous, presliding_angle
        Friction at the output, as in `cycloid_fmu.Friction` (N·m, 1, N·m, N·m·s/rad, rad).
    stribeck_speed, stribeck_share
        Speeds (rad/s), from 0, and the remaining share of `stribeck`; linear between them.
    warmth_temperature, warmth
        Temperatures (K) and their factors on all friction except the viscous part.
    variance
        Of the transmission error, from the fit, the torque's accuracy and the table, shape (temperatures, torques) of
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
        t = self.tables
        friction = (self.stribeck_speed, self.stribeck_share, self.warmth_temperature, self.warmth)
        return sum(
            table.nbytes for table in (*t.steps, t.node, self.inverse.torque, self.inverse.temperature, *friction)
        )

    @functools.cached_property
    def tables(self) -> Tables:
        """The numbers that `step` uses, with all divisions made."""
        t = self.inverse
        flank = np.broadcast_to(t.flank, t.mean.shape)
        node = np.stack([t.mean, flank, self.variance, self.ripple_variance], axis=-1)
        # Six times a spline's value is a sum of whole numbers.
        node = np.concatenate([node, t.share * t.scale / 6.0], axis=-1)
        extended = tuple(np.take(steps, np.arange(-1, len(steps) + SUPPORT - 1), mode="wrap") for steps in t.steps)
        # Without friction there is no element.
        strain = self.presliding_angle / FRICTION_ELEMENTS
        stiffness = 2.0 / (self.presliding_angle * (FRICTION_ELEMENTS + 1))
        noise = self.sensor * self.sensor
        return Tables(
            1.0 / self.ratio,
            1.0 / t.period,
            strain,
            stiffness,
            noise,
            self.least_variance + noise,
            node,
            extended,
            _rates(t.torque),
            _rates(t.temperature),
            _rates(self.stribeck_speed),
            _rates(self.warmth_temperature),
        )

    def start(self, index: float = math.nan, probability: float = 1.0) -> Memory:
        """Return an empty memory.

        Parameters
        ----------
        index
            Crank angle of this drive's model where the output angle is 0, rad.
        probability
            That the index is right and the drive is this one, as `find_index` returns it; 0 where no index is stated.
        """
        return Memory(index, probability)

    def step(
        self,
        memory: Memory,
        desired_angle: float,
        desired_speed: float,
        load_torque: float,
        temperature: float,
        motor_angle: float = math.nan,
        output_angle: float = math.nan,
    ) -> Command:
        """Make a step of the controller: `step`."""
        return step(self, memory, desired_angle, desired_speed, load_torque, temperature, motor_angle, output_angle)


class Tables(NamedTuple):
    """Numbers of a compensator as `step` takes them, in Python and in all other forms.

    Attributes
    ----------
    per_ratio, per_period
        One over the ratio, and over the period.
    strain, stiffness
        Of friction: what each element may strain for each part of its torque (rad), and stiffness over torque (1/rad).
    noise, least
        Variance of the output encoder, and with it the least variance of the transmission error, rad².
    node
        Shape (temperatures, torques, `COLUMNS` + functions): mean transmission error (rad), direction of the torque,
        variance (rad²), that of the ripple (rad²), and what each function of the crank angle counts, a sixth of rad.
    steps
        Coefficients of each spline from the one before the first, `SUPPORT` more than it has knots.
    torque_rate, temperature_rate, stribeck_rate, warmth_rate
        One over the distance of the nodes, 0 behind the last.
    """

    per_ratio: float
    per_period: float
    strain: float
    stiffness: float
    noise: float
    least: float
    node: Array
    steps: tuple[NDArray[np.int8 | np.int16], ...]
    torque_rate: Array
    temperature_rate: Array
    stribeck_rate: Array
    warmth_rate: Array


def _rates(nodes: Array) -> Array:
    return np.append(1.0 / np.diff(nodes), 0.0)


@dataclass
class Memory:
    """Memory of a compensator from step to step; a new one is empty.

    Attributes
    ----------
    index
        Crank angle of the model where the desired output angle is 0, rad; 0 in place of NaN.
    probability
        Of the index, 0 to 1; 0 where the index is NaN. The part that depends on the crank angle is compensated in
        this proportion until there are measurements.
    angle
        Desired output angle of the last step, rad; NaN before the first.
    strains
        Of the elements of friction, rad.
    output
        Last output angle that was measured, rad; NaN before the first.
    settled
        Rotation of the output since the flank was uncertain, rad.
    applied
        Learned values in the command: difference of the encoders' zeros (rad), half of the added play (rad), gain of
        mean transmission error and wind-up, gain of the part that depends on the crank angle.
    learned
        The same as measurements have it, over `KNOWN`.
    gain_variance
        Variance of the ripple's gain.
    moments, products
        Sums over measurements, which fade: of the four regressors' products, each times `KNOWN`, row by row up to the
        diagonal, and of theirs with what was measured.
    count, residual_squares
        Effective number of measurements, and their residual sum of squares, rad².
    """

    index: float = 0.0
    probability: float = 1.0
    angle: float = math.nan
    strains: list[float] = field(default_factory=lambda: [0.0] * FRICTION_ELEMENTS)
    output: float = math.nan
    settled: float = SETTLED
    applied: list[float] = field(init=False)
    learned: list[float] = field(default_factory=lambda: list(PRIOR))
    gain_variance: float = KNOWN[3] * KNOWN[3]
    moments: list[float] = field(default_factory=lambda: [0.0] * 10)
    products: list[float] = field(default_factory=lambda: [0.0] * 4)
    count: float = 0.0
    residual_squares: float = 0.0

    def __post_init__(self) -> None:
        known = _given(self.index) and self.probability > 0.0
        self.index = self.index if _given(self.index) else 0.0
        self.probability = min(self.probability, 1.0) if known else 0.0
        self.applied = [*EXPECTED[:3], self.probability]

    @property
    def doubt(self) -> float:
        """Share of the ripple's variance that remains with an index of this probability."""
        return 1.0 - self.probability * self.probability


class Command(NamedTuple):
    """Output of a step.

    Attributes
    ----------
    motor_angle, motor_speed
        rad and rad/s.
    band
        Standard deviation of the output angle from the desired one, rad; `LARGEST` where an input is missing.
    gain
        Of the part that depends on the crank angle, 0 to 2; it begins at the probability of the index.
    holds
        Whether the model holds: the inputs are within the table, the residuals of the measurements are no larger than
        expected, and the measurements have the model's ripple.
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
    variance: float
    ripple: float
    shares: list[float]


def step(
    compensator: Compensator,
    memory: Memory,
    desired_angle: float,
    desired_speed: float,
    load_torque: float,
    temperature: float,
    motor_angle: float = math.nan,
    output_angle: float = math.nan,
) -> Command:
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
    offset, play, wound, gain = m.applied
    angle = desired_angle - offset - wound * state.wound
    ripple, slope = _ripple(c, state, angle * c.crank_ratio + m.index)
    expected = state.variance + m.doubt * state.ripple
    variance = (FIRST * expected + m.residual_squares) / (FIRST + m.count)
    small = LEAST_GAIN * m.probability - KNOWN[3] * m.learned[3]
    more = variance > ALARM * ALARM * (expected + c.tables.noise)
    another = small > 0.0 and small * small > ALARM * ALARM * m.gain_variance
    holds = plausible and inside and not (m.count > ENOUGH and (more or another))
    return Command(
        c.ratio * (angle - play * state.flank - wound * state.mean - gain * ripple),
        c.ratio * desired_speed * (1.0 - gain * c.crank_ratio * slope),
        math.sqrt(variance),
        gain,
        holds,
    )


def _given(value: float) -> bool:
    return abs(value) < LARGEST  # false for NaN


def _between(nodes: Array, rates: Array, at: float) -> tuple[int, float]:
    """Return the cell of a value between nodes and its position in it, 0 to 1; values beyond the ends are clipped."""
    if len(nodes) == 1:
        return 0, 0.0
    cell = min(max(bisect.bisect_right(nodes, at) - 1, 0), len(nodes) - 2)
    share = (at - float(nodes[cell])) * float(rates[cell])
    return cell, min(max(share, 0.0), 1.0)


def _on_line(nodes: Array, rates: Array, values: Array, at: float) -> float:
    cell, share = _between(nodes, rates, at)
    return float((1.0 - share) * values[cell] + share * values[cell + 1] if share > 0.0 else values[cell])


def torque_of_teeth(c: Compensator, m: Memory, angle: float, speed: float, load: float, temperature: float) -> float:
    """Return the torque through the teeth, the load minus friction, and move the friction elements."""
    t = c.tables
    rotation = angle - m.angle if _given(m.angle) else 0.0
    m.angle = angle
    dry = c.coulomb + c.load_share * abs(load)
    rest = dry + c.stribeck
    if rest <= 0.0:
        return load - c.viscous * speed
    sliding = dry + c.stribeck * _on_line(c.stribeck_speed, t.stribeck_rate, c.stribeck_share, abs(speed))
    warmth = _on_line(c.warmth_temperature, t.warmth_rate, c.warmth, temperature)
    bound = t.strain * warmth * sliding / rest
    total = 0.0
    for i in range(FRICTION_ELEMENTS):
        most = bound * (i + 1)
        m.strains[i] = min(max(m.strains[i] + rotation, -most), most)
        total += m.strains[i]
    return load - t.stiffness * rest * total - c.viscous * speed


def _state(c: Compensator, torque: float, temperature: float) -> _State:
    t = c.tables
    i, u = _between(c.inverse.temperature, t.temperature_rate, temperature)
    j, v = _between(c.inverse.torque, t.torque_rate, torque)
    low, high = t.node[i], t.node[min(i + 1, len(t.node) - 1)]
    p, q, r, s = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
    columns = p * low[j] + q * low[j + 1] + r * high[j] + s * high[j + 1]
    mean, flank, variance, ripple, *shares = columns.tolist()
    return _State(torque, c.compliance * torque, mean, flank, variance, ripple, shares)


def _ripple(c: Compensator, state: _State, crank: float) -> tuple[float, float]:
    """Return the ripple at an ideal crank angle (rad), and its derivative."""
    turn = crank * c.tables.per_period
    turn -= math.floor(turn)
    value = slope = 0.0
    for share, steps in zip(state.shares, c.tables.steps, strict=True):
        knots = len(steps) - SUPPORT
        position = turn * knots
        knot = int(position)
        s = position - knot
        a, b, d, e = steps[knot : knot + SUPPORT].tolist()
        third, second, first = e - a + 3 * (b - d), 3 * (a + d - 2 * b), 3 * (d - a)
        value += share * (((third * s + second) * s + first) * s + (a + 4 * b + d))
        slope += share * knots * ((3 * third * s + 2 * second) * s + first)
    return value, slope * c.tables.per_period


def _learn(c: Compensator, m: Memory, state: _State, motor_angle: float, output_angle: float) -> bool:
    """Add a measurement to the regression; return whether it is plausible for this drive."""
    t = c.tables
    measured = output_angle - motor_angle * t.per_ratio
    if abs(measured) > LARGEST_TRANSMISSION_ERROR:
        return False
    crank = (output_angle - m.applied[0] - m.applied[2] * state.wound) * c.crank_ratio
    ripple = _ripple(c, state, crank + m.index)[0]
    rows = (KNOWN[0], KNOWN[1] * state.flank, KNOWN[2] * (state.wound + state.mean), KNOWN[3] * ripple)
    first = not _given(m.output)
    rotation = 0.0 if first else abs(output_angle - m.output)
    crank_rotation = abs(c.crank_ratio * rotation)
    m.output = output_angle
    forgetting = max(0.0, 1.0 - crank_rotation * (1.0 / MEMORY))
    expected = state.variance + t.noise + m.doubt * state.ripple
    variance = (FIRST * expected + forgetting * m.residual_squares) / (FIRST + forgetting * m.count)
    a, b, d, e = m.learned
    residual = measured - (a * rows[0] + b * rows[1] + d * rows[2] + e * rows[3])
    m.settled = m.settled + rotation if abs(state.flank) >= SURE_FLANK else 0.0
    weight = 0.0 if m.settled < SETTLED else 1.0 if first else min(1.0, crank_rotation * (1.0 / CORRELATION))
    weight *= min(1.0, t.least / (state.variance + t.noise))
    most = OUTLIER * OUTLIER * variance
    if residual * residual > most:
        weight *= math.sqrt(most / (residual * residual))
    m.count = forgetting * m.count + weight
    m.residual_squares = forgetting * m.residual_squares + weight * residual * residual
    n = 0
    for i in range(4):
        weighted = weight * rows[i]
        for j in range(i + 1):
            m.moments[n] = forgetting * m.moments[n] + weighted * rows[j]
            n += 1
        m.products[i] = forgetting * m.products[i] + weighted * measured
    m.gain_variance = _solve(m, variance)
    # An uncertain gain is reduced: this minimises the mean square error.
    g = KNOWN[3] * m.learned[3]
    ripple = g * g * g / (g * g + m.gain_variance) if g > 0.0 else 0.0
    targets = (
        KNOWN[0] * m.learned[0],
        KNOWN[1] * m.learned[1],
        min(max(KNOWN[2] * m.learned[2], 0.0), LARGEST_GAIN),
        min(ripple, LARGEST_GAIN),
    )
    for i in range(4):
        most = crank_rotation * (ANGLE_RATE if i < 2 else GAIN_RATE)
        m.applied[i] += min(max(targets[i] - m.applied[i], -most), most)
    return True


def _solve(m: Memory, v: float) -> float:
    """Solve for the posterior mean given measurements with a variance; return the variance of the ripple's gain.

    Normal equations, scaled by the prior's standard deviations, with the variance on their diagonal, by L D Lᵀ: no
    pivot is below the variance. The inverse of D is kept.
    """
    a00, a10, a11, a20, a21, a22, a30, a31, a32, a33 = m.moments
    d0 = 1.0 / max(a00 + v, v)
    l10, l20, l30 = a10 * d0, a20 * d0, a30 * d0
    d1 = 1.0 / max(a11 + v - a10 * l10, v)
    c21, c31 = a21 - a20 * l10, a31 - a30 * l10
    l21, l31 = c21 * d1, c31 * d1
    d2 = 1.0 / max(a22 + v - a20 * l20 - c21 * l21, v)
    c32 = a32 - a30 * l20 - c31 * l21
    l32 = c32 * d2
    d3 = 1.0 / max(a33 + v - a30 * l30 - c31 * l31 - c32 * l32, v)
    y0 = m.products[0] + v * PRIOR[0]
    y1 = m.products[1] + v * PRIOR[1] - l10 * y0
    y2 = m.products[2] + v * PRIOR[2] - l20 * y0 - l21 * y1
    z3 = (m.products[3] + v * PRIOR[3] - l30 * y0 - l31 * y1 - l32 * y2) * d3
    z2 = y2 * d2 - l32 * z3
    z1 = y1 * d1 - l21 * z2 - l31 * z3
    m.learned[:] = y0 * d0 - l10 * z1 - l20 * z2 - l30 * z3, z1, z2, z3
    return KNOWN[3] * KNOWN[3] * v * d3
