"""A robot joint with a drive of `second_drive`: output angle, friction with presliding, arm and servo.

The teeth are a table of the second solver's results over the crank's angle and the torque through them. The output's
friction is the LuGre model (Canudas de Wit et al., IEEE Trans. Autom. Control 40(3), 1995), its bristles integrated in
closed form over a step; the product uses another friction law. Arm and motor are integrated, or the output is in
equilibrium at every sample. Signs are those of the product: a torque is that of the environment on the output.
"""

import dataclasses
import itertools

import numpy as np
import second_drive
from numba import njit

ARCSEC = np.pi / 648000
PLAY = 0.05  # N·m: below this torque the output is free, except for the lubricant's drag, which has this size
NODES = 32  # nodes of the torque on a flank
EACH = 360  # crank angles per turn


@dataclasses.dataclass(frozen=True)
class Friction:
    """LuGre friction at the output, which decreases with temperature.

    Attributes
    ----------
    sliding, sticking
        Levels at speed and at rest, N·m.
    load_share
        Increase of both levels per N·m through the teeth.
    stribeck
        Speed scale of the transition between both levels, rad/s.
    viscous
        N·m·s/rad.
    presliding
        Bending angle of the bristles, rad.
    fade
        Relative decrease per kelvin.
    """

    sliding: float = 2.0
    sticking: float = 2.8
    load_share: float = 0.01
    stribeck: float = 0.02
    viscous: float = 0.4
    presliding: float = 15.0 * ARCSEC
    fade: float = 0.008

    def at(self, rise):
        """Its numbers as the plant takes them, warmer by `rise` kelvin than 20 °C."""
        share = np.exp(-self.fade * rise)
        return np.array(
            [
                share * self.sliding,
                share * self.sticking,
                share * self.load_share,
                self.stribeck,
                share * self.viscous,
                share * self.sliding / self.presliding,
            ]
        )

    def steady(self, speed, torque, rise=0.0):
        """Friction at constant speed, opposite to it, N·m."""
        numbers = self.at(rise)
        return np.sign(speed) * level(numbers, np.abs(speed), np.abs(torque)) + numbers[4] * speed


@dataclasses.dataclass(frozen=True)
class Teeth:
    """Deviation of the output from the ideal rotation, over crank angle and torque.

    Attributes
    ----------
    first, step
        Of the crank angles, rad.
    root
        Shape (nodes,): signed square roots of the torques.
    beyond
        Shape (angles, nodes): rotation, rad.
    """

    first: float
    step: float
    root: np.ndarray
    beyond: np.ndarray

    def at(self, theta, torque):
        """Rotation beyond the ideal one, rad, of any shape."""
        theta, torque = np.broadcast_arrays(np.asarray(theta, float), np.asarray(torque, float))
        pairs = zip(theta.flat, torque.flat, strict=True)
        found = [_beyond(*one, self.first, self.step, self.root, self.beyond) for one in pairs]
        return np.reshape(found, theta.shape)


def torques(largest, nodes=NODES):
    """Torques of a table, with evenly spaced square roots on either flank, N·m."""
    one = np.linspace(np.sqrt(PLAY), np.sqrt(largest), nodes) ** 2
    return np.concatenate([-one[::-1], one])


def tabulated(made, low, high, largest, each=EACH, nodes=NODES):
    """The teeth of a `second_drive.Body` from one crank angle to another, up to a torque."""
    step = 2.0 * np.pi / each
    first = low - 3.0 * step
    theta = first + step * np.arange(int(np.ceil((high - first) / step)) + 4)
    loads = torques(largest, nodes)
    beyond = np.array([second_drive.transmission_error(made, theta, load) for load in loads])
    for row in beyond:  # A floating disc may have an angle without a balance.
        there = np.isfinite(row)
        row[~there] = np.interp(theta[~there], theta[there], row[there])
    root = np.sign(loads) * np.sqrt(np.abs(loads))
    return Teeth(first, step, root, np.ascontiguousarray(np.maximum.accumulate(beyond, axis=0).T))


@njit(cache=True)
def level(friction, speed, torque):
    dry = friction[0] + (friction[1] - friction[0]) * np.exp(-((speed / friction[3]) ** 2))
    return dry + friction[2] * torque


@njit(cache=True)
def _column(theta, first, step, beyond):
    """Rotation at every torque at one crank angle: cubic between four angles (Lagrange)."""
    at = (theta - first) / step
    k = min(max(int(np.floor(at)), 1), beyond.shape[0] - 3)
    u = at - k
    a, b = -u * (u - 1.0) * (u - 2.0) / 6.0, (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0
    c, d = -(u + 1.0) * u * (u - 2.0) / 2.0, (u + 1.0) * u * (u - 1.0) / 6.0
    return a * beyond[k - 1] + b * beyond[k] + c * beyond[k + 1] + d * beyond[k + 2]


@njit(cache=True)
def _slope(k, root, column, low, high):
    """Slope over the root at a node between neighbours low … high (Fritsch and Butland's, which keeps the order)."""
    if k == low:
        return (column[k + 1] - column[k]) / (root[k + 1] - root[k])
    if k == high:
        return (column[k] - column[k - 1]) / (root[k] - root[k - 1])
    h, g = root[k] - root[k - 1], root[k + 1] - root[k]
    before, after = (column[k] - column[k - 1]) / h, (column[k + 1] - column[k]) / g
    if before * after <= 0.0:
        return 0.0
    return 3.0 * (h + g) / ((2.0 * g + h) / before + (g + 2.0 * h) / after)


@njit(cache=True)
def _between(k, torque, root, column):
    """Rotation at a torque between the nodes k and k + 1, or beyond them."""
    half = root.size // 2
    if k == half - 1:  # in the play
        share = (torque / (root[half] * root[half]) + 1.0) / 2.0
        return column[k] + share * (column[k + 1] - column[k])
    low, high = (0, half - 1) if k < half else (half, root.size - 1)
    x = np.sign(torque) * np.sqrt(abs(torque))
    h = root[k + 1] - root[k]
    u = (x - root[k]) / h
    p, q = _slope(k, root, column, low, high) * h, _slope(k + 1, root, column, low, high) * h
    if u > 1.0:
        return column[k + 1] + (u - 1.0) * q
    if u < 0.0:
        return column[k] + u * p
    return (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2 * column[k]
        + u * (1.0 - u) ** 2 * p
        + u * u * (3.0 - 2.0 * u) * column[k + 1]
        + u * u * (u - 1.0) * q
    )


@njit(cache=True)
def _beyond(theta, torque, first, step, root, beyond):
    x = np.sign(torque) * np.sqrt(abs(torque))
    k = min(max(np.searchsorted(root, x) - 1, 0), root.size - 2)
    return _between(k, torque, root, _column(theta, first, step, beyond))


@njit(cache=True)
def bent(bristle, way, high, stiffness):
    """The bristles' torque after a displacement at one level."""
    if way == 0.0:
        return bristle
    end = high if way > 0.0 else -high
    return end + (bristle - end) * np.exp(-stiffness * abs(way) / high)


@njit(cache=True)
def _torques(low, root, beyond):
    """Torques (N·m) at both ends of a cell of the table; the outer cells extend beyond the table."""
    a, b = np.sign(root[low]) * root[low] ** 2, np.sign(root[low + 1]) * root[low + 1] ** 2
    return a - beyond * (low == 0), b + beyond * (low == root.size - 2)


@njit(cache=True)
def _settled(ideal, column, root, load, bristle, before, drag, high, stiffness):
    """Torque through the teeth and output angle in the equilibrium of load, friction and teeth.

    The displacement from `before` bends the bristles, with a drag of `drag` per radian; the residual is monotone.
    """
    low, top = 0, root.size - 1
    while top - low > 1:
        k = (low + top) // 2
        angle = ideal + column[k]
        at = np.sign(root[k]) * root[k] ** 2
        if at - load + bent(bristle, angle - before, high, stiffness) + drag * (angle - before) > 0.0:
            top = k
        else:
            low = k
    a, b = _torques(low, root, 100.0)
    for _ in range(60):
        torque = 0.5 * (a + b)
        angle = ideal + _between(low, torque, root, column)
        if torque - load + bent(bristle, angle - before, high, stiffness) + drag * (angle - before) > 0.0:
            b = torque
        else:
            a = torque
        if b - a < 1e-9:
            break
    return torque, angle


@njit(cache=True)
def pressed(ideal, column, root, angle):
    """Torque through the teeth at an angle of the output."""
    low, high = 0, root.size - 1
    while high - low > 1:
        k = (low + high) // 2
        if ideal + column[k] > angle:
            high = k
        else:
            low = k
    a, b = _torques(low, root, 300.0)
    for _ in range(60):
        torque = 0.5 * (a + b)
        if ideal + _between(low, torque, root, column) > angle:
            b = torque
        else:
            a = torque
        if b - a < 1e-6:
            break
    return torque


@njit(cache=True)
def _swung(state, told, teeth, root, beyond, ratio, index, friction, arm, servo, count, duration):
    """Integrate arm and motor over one sample, in `count` steps of half a kick, a drift, and half a kick.

    state: output's angle and speed, bristles' torque, motor's angle and speed, the servo's integral. told: the command
    before and after, the profile's motor speed and acceleration, load without the arm's inertia before and after.
    """
    step = duration / count
    angle, speed, bristle, motor, turning, summed = state
    inertia, damping = arm
    rotor, band = servo
    ideal_speed = (told[1] - told[0]) / duration
    whole = rotor + inertia / ratio**2
    for n in range(count):
        for half in range(2):
            share = (n + half) / count
            wanted, load = told[0] + share * (told[1] - told[0]), told[4] + share * (told[5] - told[4])
            column = _column(motor, teeth[0], teeth[1], beyond)
            torque = pressed((motor - index) / ratio, column, root, angle)
            torque += damping * (speed - turning / ratio) * (abs(torque) > PLAY)
            rubbing = bristle + friction[4] * speed
            speed += 0.5 * step * (load - torque - rubbing) / inertia
            off, slow = wanted - motor, ideal_speed - turning
            summed += 0.5 * step * off
            pull = whole * (told[3] + 3.0 * band * slow + 3.0 * band**2 * off + band**3 * summed) - load / ratio
            turning += 0.5 * step * (pull + torque / ratio) / rotor
            if half == 0:
                high = level(friction, abs(speed), abs(torque))
                bristle = bent(bristle, speed * step, high, friction[5])
                angle += step * speed
                motor += step * turning
    return np.array([angle, speed, bristle, motor, turning, summed])


@dataclasses.dataclass(frozen=True)
class Servo:
    """A position servo on the motor's side.

    The profile is fed forward. A correction to it follows through the loop, which knows its speed (as a drive in cyclic
    synchronous position mode takes it from the commands): y'' = 2ζω(c' - y') + ω²(c - y). If arm and motor are
    integrated, the servo controls position, speed and integral for the inertia of motor and arm with one bandwidth;
    load and acceleration of the profile are fed forward. The motor's inertia at the crank is the share `rotor` of the
    arm's.
    """

    frequency: float = 60.0  # Hz
    damping: float = 0.8
    band: float = 20.0  # Hz, of all three poles
    rotor: float = 0.2

    def over(self, step):
        """Matrices of a step: of the state and its rate, and of a command's change and its last change."""
        from scipy.linalg import expm

        w, z = 2.0 * np.pi * self.frequency, self.damping
        # y, y', command, and rate of the command over the step
        system = np.array([[0, 1, 0, 0], [-w * w, -2 * z * w, w * w, 2 * z * w], [0, 0, 0, 1], [0, 0, 0, 0]], float)
        return expm(system * step)


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint at one temperature and state of wear.

    Attributes
    ----------
    teeth
        Teeth of the drive, with its windup.
    ratio
        Signed.
    friction
        Result of `Friction.at`.
    index
        Crank angle minus the crank angle of the motor encoder, rad.
    inertia, loss
        Inertia of the arm, kg·m², and damping of its oscillation on the teeth, N·m·s/rad.
    """

    teeth: Teeth
    ratio: float
    friction: np.ndarray
    index: float = 0.0
    inertia: float = 6.0
    loss: float = 60.0
    servo: Servo = Servo()

    def column(self, motor):
        """Rotation beyond the ideal one at every torque of the table, rad."""
        return _column(motor + self.index, self.teeth.first, self.teeth.step, self.teeth.beyond)

    def settled(self, motor, load, bristle, before, speed, torque, duration):
        """Torque through the teeth, the output's angle and the bristles' torque where all balance after a sample.

        `speed` (rad/s) and `torque` (N·m) set the level of friction; the output was at the angle `before`.
        """
        high = level(self.friction, abs(speed), abs(torque))
        drag = self.friction[4] / duration
        torque, angle = _settled(
            motor / self.ratio,
            self.column(motor),
            self.teeth.root,
            load,
            bristle,
            before,
            drag,
            high,
            self.friction[5],
        )
        return torque, angle, bent(bristle, angle - before, high, self.friction[5])

    def locked(self, motor, loads):
        """The output's angle at a locked motor while the load goes through `loads` slowly, from rest, rad."""
        found, bristle, torque = [], 0.0, loads[0]
        angle = motor / self.ratio + float(self.teeth.at(motor + self.index, loads[0]))
        for load in loads:
            torque, angle, bristle = self.settled(motor, load, bristle, angle, 0.0, torque, 1.0)
            found.append(angle)
        return np.array(found)


@dataclasses.dataclass(frozen=True)
class Profile:
    """A motion of the output and its load, sampled evenly.

    Attributes
    ----------
    step
        s.
    angle, speed, acceleration
        Desired motion of the output: rad, rad/s, rad/s².
    load
        On the output, without the arm's inertia, N·m.
    """

    step: float
    angle: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    load: np.ndarray

    def whole_load(self, inertia):
        """The load with the arm's inertia, N·m."""
        return self.load - inertia * self.acceleration


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Signals to the controller, and their errors.

    Attributes
    ----------
    gain, offset, noise
        Errors of the load signal: relative, and in N·m.
    late
        Delay of the load signal in samples.
    warm
        Error of the temperature, K.
    encoder
        Whether there is one at the output; its steps are 2π/2^`bits`, its noise `jitter` (rad).
    """

    gain: float = 0.03
    offset: float = 2.0
    noise: float = 0.2
    late: int = 1
    warm: float = 1.0
    encoder: bool = False
    bits: int = 23
    jitter: float = 0.2 * ARCSEC

    def load(self, whole, generator):
        """The load signal."""
        told = np.concatenate([np.full(self.late, whole[0]), whole[: whole.size - self.late]])
        return told * (1.0 + self.gain) + self.offset + generator.normal(0.0, self.noise, whole.size)

    def output(self, angle, generator):
        """The signal of the output's angle, rad."""
        if not self.encoder:
            return np.nan
        step = 2.0 * np.pi / 2**self.bits
        return step * round((angle + generator.normal(0.0, self.jitter)) / step)


PERFECT = Sensors(0.0, 0.0, 0.0, 0, 0.0)


@dataclasses.dataclass(frozen=True)
class Motion:
    """Result of a profile: all over its samples, rad and N·m.

    Attributes
    ----------
    error
        Actual minus desired angle of the output.
    motor, torque
        The motor's angle, and the torque through the teeth.
    """

    error: np.ndarray
    motor: np.ndarray
    torque: np.ndarray


def moved(joint, profile, controller, sensors=PERFECT, kelvin=293.15, *, swings=True, seed=0, substep=50e-6):
    """Move a joint along a profile with a controller.

    At each sample the controller gets the desired angle and speed of the next sample, the load, the temperature and
    both present angles. It returns the motor angle for the next sample, which is approached linearly.

    Parameters
    ----------
    controller
        (desired angle, desired speed, load, temperature, motor angle, output angle or NaN) -> motor angle.
    kelvin
        Temperature without the sensor's error, K.
    swings
        Whether arm and motor are integrated with `substep` (s). Otherwise the output is in equilibrium at every sample
        and the arm's inertia is part of the load; the output then crosses the play at once, unlike a real arm.
    """
    generator, ratio, size = np.random.default_rng(seed), joint.ratio, profile.angle.size
    whole = profile.whole_load(joint.inertia)
    told = sensors.load(whole, generator)
    motor = ratio * profile.angle[0]
    torque, bristle = whole[0], 0.0
    angle = motor / ratio + float(joint.teeth.at(motor + joint.index, torque))
    every = np.zeros((3, size))
    every[:, 0] = angle, motor, torque
    over = joint.servo.over(profile.step)
    behind, rate, before, count = 0.0, 0.0, 0.0, max(1, round(profile.step / substep))
    state = np.array([angle, 0.0, bristle, motor + joint.index, 0.0, 0.0])
    teeth, arm = joint.teeth, np.array([joint.inertia, joint.loss])
    servo = np.array([joint.servo.rotor * joint.inertia / ratio**2, 2.0 * np.pi * joint.servo.band])
    for k in range(size - 1):
        command = controller(
            profile.angle[k + 1],
            profile.speed[k + 1],
            told[k],
            kelvin + sensors.warm,
            motor,
            sensors.output(angle, generator),
        )
        added = command - ratio * profile.angle[k + 1]
        if swings:
            asked = np.array(
                [
                    ratio * profile.angle[k] + before + joint.index,
                    command + joint.index,
                    0.0,
                    ratio * 0.5 * (profile.acceleration[k] + profile.acceleration[k + 1]),
                    profile.load[k],
                    profile.load[k + 1],
                ]
            )
            state = _swung(
                state,
                asked,
                np.array([teeth.first, teeth.step]),
                teeth.root,
                teeth.beyond,
                ratio,
                joint.index,
                joint.friction,
                arm,
                servo,
                count,
                profile.step,
            )
            angle, motor = state[0], state[3] - joint.index
            torque = pressed(motor / ratio, joint.column(motor), teeth.root, angle)
        else:
            behind, rate, _, _ = over @ np.array([behind, rate, before, (added - before) / profile.step])
            motor = ratio * profile.angle[k + 1] + behind
            torque, angle, bristle = joint.settled(
                motor, whole[k + 1], bristle, angle, profile.speed[k + 1], torque, profile.step
            )
        before = added
        every[:, k + 1] = angle, motor, torque
    return Motion(every[0] - profile.angle, every[1], every[2])


def quintic(points, speed, acceleration, dwell, step):
    """Moves between points as polynomials of the fifth degree with rests between them: angle and two derivatives.

    Each move is as fast as the limits of speed and acceleration allow.
    """
    angle, first, second = [np.full(round(dwell / step), points[0])], [np.zeros(round(dwell / step))], []
    second.append(first[0])
    for a, b in itertools.pairwise(points):
        way = b - a
        time = max(1.875 * abs(way) / speed, np.sqrt(5.7735 * abs(way) / acceleration))
        count = int(np.ceil(time / step))
        time = count * step
        u = np.arange(1, count + 1) / count
        rest = round(dwell / step)
        angle += [a + way * u**3 * (10.0 - 15.0 * u + 6.0 * u * u), np.full(rest, b)]
        first += [way / time * 30.0 * u * u * (1.0 - u) ** 2, np.zeros(rest)]
        second += [way / time**2 * (60.0 * u - 180.0 * u * u + 120.0 * u**3), np.zeros(rest)]
    return tuple(map(np.concatenate, (angle, first, second)))
