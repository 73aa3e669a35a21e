"""The parts of the joint around the drive
=======================================

The other parts of a robot joint as separate FMUs: a servo motor and the weight of an arm.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

STEP, END = 2e-4, 1.0  # s
CHAIN = {"series_compliance": 5e-6, "mesh_damping": 200.0}  # bearings, housing and flange around the gear


class JointPart(Fmi2Slave):
    """An FMU whose variables are attributes, with two underscores for a dot in a name."""

    def variable(self, name: str, causality: Fmi2Causality, value: float = 0.0) -> None:
        setattr(self, name.replace(".", "__"), value)
        fixed = causality == Fmi2Causality.parameter
        self.register_variable(
            Real(
                name,
                causality=causality,
                variability=Fmi2Variability.fixed if fixed else Fmi2Variability.continuous,
                getter=lambda: getattr(self, name.replace(".", "__")),
                setter=lambda v: setattr(self, name.replace(".", "__"), v),
            ),
            nested=False,
        )


class Motor(JointPart):
    """A servo motor: its controller moves the joint along a smooth path and can compensate the drive's error."""

    ORDERS = 8

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.felt = 0.0
        self.variable("flange.tau", Fmi2Causality.input)
        for name in ("flange.phi", "flange.w", "path"):
            self.variable(name, Fmi2Causality.output)
        values = {
            "ratio": -39.0,
            "inertia": 1e-3,
            "stiffness": 60.0,
            "damping": 0.5,
            "target": math.radians(90.0),
            "duration": 0.8,
            "filter": 2e-3,
        }
        for name, value in values.items():
            self.variable(name, Fmi2Causality.parameter, value)
        # The transmission error to compensate: Σ cosine_i cos(order_i φ) + sine_i sin(order_i φ), φ the crank angle.
        for i in range(1, self.ORDERS + 1):
            for name in ("order", "cosine", "sine"):
                self.variable(f"{name}_{i}", Fmi2Causality.parameter)

    def reference(self, time: float) -> float:
        """Desired joint angle: a path with continuous acceleration (quintic)."""
        s = min(max(time / self.duration, 0.0), 1.0)
        return self.target * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)

    def crank(self, time: float) -> float:
        """Motor angle for the desired joint angle."""
        crank = self.ratio * self.reference(time)
        error = 0.0
        for i in range(1, self.ORDERS + 1):
            order, cosine, sine = (getattr(self, f"{name}_{i}") for name in ("order", "cosine", "sine"))
            error += cosine * (math.cos(order * crank) - 1.0) + sine * math.sin(order * crank)
        return crank - self.ratio * error

    def do_step(self, current_time, step_size):
        parts = 4
        h = step_size / parts
        for k in range(parts):
            t = current_time + (k + 1) * h
            wanted = self.crank(t)
            speed = (self.crank(t + 1e-4) - self.crank(t - 1e-4)) / 2e-4
            acceleration = (self.crank(t + 1e-4) - 2.0 * wanted + self.crank(t - 1e-4)) / 1e-8
            # The drive's torque, filtered, is fed forward, as is the acceleration.
            self.felt += (self.flange__tau - self.felt) * h / self.filter
            torque = self.stiffness * (wanted - self.flange__phi) + self.damping * (speed - self.flange__w)
            torque += self.inertia * acceleration + self.felt
            self.flange__w += h * (torque - self.flange__tau) / self.inertia
            self.flange__phi += h * self.flange__w
        self.path = self.reference(current_time + step_size)
        return True


class Arm(JointPart):
    """The weight of an arm that hangs at angle 0; its inertia is in the drive's FMU with the stiff contacts."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.variable("flange.phi", Fmi2Causality.input)
        self.variable("flange.tau", Fmi2Causality.output)
        for name, value in (("mass", 12.0), ("length", 0.4)):
            self.variable(name, Fmi2Causality.parameter, value)

    def do_step(self, current_time, step_size):
        self.flange__tau = -9.81 * self.mass * self.length * math.sin(self.flange__phi)
        return True


def moved(ssp: Path, parameters: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Time and path error of the joint, s and rad."""
    from fmpy.ssp.simulation import simulate_ssp
    from fmpy.ssp.ssd import Parameter, ParameterSet

    every = {**{f"drive.{n}": v for n, v in CHAIN.items()}, **{f"motor.{n}": v for n, v in parameters.items()}}
    chosen = ParameterSet()
    chosen.parameters = [Parameter(name=n, type="Real", value=v) for n, v in every.items()]
    rows = simulate_ssp(str(ssp), stop_time=END, step_size=STEP, parameter_set=chosen)
    return rows["time"] + STEP, rows["drive.flange_b.phi"] - rows["motor.path"]
