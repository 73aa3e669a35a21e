"""Compensators of fictitious drives, and paths for them: shared by the tests of their forms."""

import math

import numpy as np

from cycloid_fmu.compensation.compensator import Compensator, Memory, step
from cycloid_fmu.compensation.inverse import Inverse

REACH = 90.0  # N·m
NONE = 1e300


def compensator(seed=1, functions=3, temperatures=3, friction=True):
    """Numbers of the size that drives have, so that every branch of a step is taken."""
    random = np.random.default_rng(seed)
    torque = np.sort(np.append(random.uniform(-REACH, REACH, 7), [-REACH, REACH]))
    shape = (temperatures, torque.size)
    small = [random.integers(-100, 100, random.integers(4, 30)).astype(np.int8) for _ in range(functions)]
    steps = tuple(one if k % 2 else one * np.int16(300) for k, one in enumerate(small))
    table = Inverse(
        period=2.0 * math.pi * random.integers(1, 40) / 40.0,
        steps=steps,
        scale=random.uniform(1e-8, 1e-7, functions)
        / np.array([1.0 if one.dtype == np.int8 else 300.0 for one in steps]),
        torque=torque,
        temperature=np.linspace(280.0, 330.0, temperatures) if temperatures > 1 else np.zeros(1),
        mean=np.sort(random.normal(0.0, 1e-4, shape), axis=1),
        share=random.normal(0.0, 1.0, (*shape, functions)),
        flank=np.tanh(torque / 5.0),
        spread=np.zeros(shape),
        residual=1e-6,
    )
    speeds = np.linspace(0.0, 0.2, 6)
    return Compensator(
        ratio=-117.0,
        crank_ratio=-39.0,
        inverse=table,
        compliance=2e-6,
        coulomb=1.5 * friction,
        load_share=0.03 * friction,
        stribeck=0.7 * friction,
        viscous=0.2,
        presliding_angle=2e-5,
        stribeck_speed=speeds,
        stribeck_share=np.exp(-((speeds / 0.05) ** 2)),
        warmth_temperature=np.array([280.0, 300.0, 330.0]),
        warmth=np.array([1.3, 0.95, 0.6]),
        variance=random.uniform(2e-12, 1e-10, shape),
        ripple_variance=random.uniform(1e-12, 1e-10, shape),
        sensor=3e-6,
    )


def way(c, seed, count=300, *, index=0.4, measured=0.8, odd=0.02):
    """Rows (desired angle and speed, load, temperature, motor and output angle) with reversals.

    An encoder shows the output of another drive, or nothing; some rows have values that no controller should pass.
    """
    random = np.random.default_rng(seed)
    speeds = random.choice([-1.0, 1.0], count // 20 + 1) * random.uniform(0.01, 2.0, count // 20 + 1)
    speed = np.repeat(speeds, 20)[:count]
    angle = random.uniform(-3.0, 3.0) + 1e-2 * np.cumsum(speed)
    load = REACH * (0.5 * np.sin(3.0 * angle) - 0.4 * np.sign(speed))
    rows, motor, memory = [], math.nan, Memory(index)
    for a, w, t, warm in zip(angle, speed, load, random.uniform(270.0, 340.0, count), strict=True):
        shown = motor / c.ratio + 5e-6 * math.cos(39.0 * a) + 3e-5 * math.tanh(t) + 1e-6 * random.normal()
        if random.random() > measured:
            motor, shown = random.choice([(math.nan, shown), (motor, math.nan), (NONE, shown), (motor, math.inf)])
        row = [a, w, t, warm, motor, shown]
        if random.random() < odd:
            row[random.integers(6)] = random.choice([math.nan, NONE, -math.inf, 1e13, 5e11, 2.0, -300.0, 0.0])
        rows.append(row)
        motor = step(c, memory, *row).motor_angle
    return np.array(rows, dtype=float)


def commands(c, rows, index, probability=1.0):
    """Python's result, holds as a number."""
    memory = Memory(index, probability)
    return np.array([[*step(c, memory, *row)] for row in rows.tolist()], dtype=float)


EVERY = ((0, 1, False), (1, 3, True), (5, 1, True), (5, 3, False))  # functions, temperatures, friction
