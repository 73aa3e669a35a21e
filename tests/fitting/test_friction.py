"""Friction from ramps of speed and constant speeds, against simulated drives of known friction."""

import dataclasses
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

import cycloid_fmu as cy
import fitting
from cycloid_fmu import edge
from cycloid_fmu.fmu.friction_file import read_friction

MEASURED = Path(os.environ.get("CYCLOID_MEASURED_DRIVES", Path(__file__).parents[3] / "shared" / "measured-drives"))
COULOMB, VISCOUS = 3.5, 0.15  # N·m, N·m·s/rad
TURN = 2.0 * np.pi


def ramps(fastest, seconds, passes=4):
    """Speed (rad/s) over time (s) at 1 kHz: to the fastest and back in each direction in turn."""
    each = round(seconds * 1000)
    rise = np.linspace(0.0, fastest, each, endpoint=False)
    there = np.concatenate([rise, fastest - rise])
    speed = np.concatenate([there * (-1) ** k for k in range(passes // 2)])
    return np.arange(speed.size) / 1000.0, speed


@dataclasses.dataclass(frozen=True)
class Rig:
    """A drive that its motor turns; torque at the output.

    Friction (N·m, N·m·s/rad, rad/s, 1), inertia (kg·m²), load and zero of the sensor (N·m); ripple (N·m) at orders of the
    output, noise of a sample (N·m) and the rate (Hz) below which it is correlated, growth of the friction while it runs
    (1), step of the clock (s), counts of an output turn.
    """

    coulomb: float = COULOMB
    viscous: float = VISCOUS
    stribeck: float = 0.0
    stribeck_speed: float = 0.3
    growth: float = 0.0
    inertia: float = 0.2
    load: float = 0.0
    zero: float = -0.1
    ripple: float = 0.0
    noise: float = 0.0
    slow_noise: float = 0.0
    warming: float = 0.0
    tick: float = 0.001
    counts: float = 13 * 4096
    fastest: float = TURN
    seconds: float = 12.5
    name: str = "ramp"

    def run(self, seed=0, motion=None):
        """A recording at 1 kHz, in ticks of the clock."""
        draw = np.random.default_rng(seed)
        time, speed = ramps(self.fastest, self.seconds) if motion is None else motion
        angle = np.cumsum(speed) / 1000.0 + draw.uniform(0.0, TURN)
        sliding = self.coulomb + self.growth * abs(self.load) + self.stribeck * np.exp(-((speed / self.stribeck_speed) ** 2))
        sliding = sliding * (1.0 + self.warming * np.exp(-time / (0.3 * time[-1])))
        torque = self.load + self.zero + np.sign(speed) * sliding + self.viscous * speed
        torque = torque + self.inertia * np.gradient(speed, time)
        for order, share in ((1.0, 0.5), (13.0, 1.0), (14.0, 1.0), (26.0, 0.7)):
            rubbing, pushing = np.sin(order * angle[:, None] + draw.uniform(0.0, TURN, 2)).T * share * self.ripple
            torque = torque + 0.7 * (np.sign(speed) * rubbing + pushing)
        torque = torque + draw.normal(0.0, self.noise, time.size)
        if self.slow_noise:
            steps, white = math.exp(-0.001 / 0.3), draw.normal(0.0, 1.0, time.size)
            from scipy.signal import lfilter

            torque = torque + self.slow_noise * math.sqrt(1.0 - steps**2) * lfilter([1.0], [1.0, -steps], white)
        seen = np.round(angle * self.counts / TURN) * TURN / self.counts
        return fitting.Run(
            input_angle=0.0, output_angle=seen, torque=torque, time=np.floor(time / self.tick + 1e-9) * self.tick,
            name=self.name,
        )  # fmt: skip

    @property
    def truth(self):
        return {"coulomb": self.coulomb, "viscous": self.viscous, "inertia": self.inertia, "offset": self.zero}
