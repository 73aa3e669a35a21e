"""A robot joint against a stiff solver
====================================

An RV reducer with friction and temperature between a motor and an arm, moved back and forth by a servo controller: the
FMU with both inertias and steps of 1 ms is compared with the same joint integrated by SciPy's stiff solver at 1e-10.

A third run moves the joint with a compensator: the servo follows the motor angle at which the drive's output has the
desired angle.

The reference uses an FMU only for the torque of teeth and first stage at given angles of both flanges; the motion of
motor and arm, mesh damping and friction are implemented here independently.
"""

import math
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import cycloid_fmu as cy

HERE, OUT = Path(__file__).parent, Path("robot_joint_out")
Array = NDArray[np.float64]
MOTOR, ARM = 1e-3, 2.0  # kg·m²
WEIGHT = -60.0  # N·m, of the arm on the output
WAY, MOVE, REST = 0.1, 0.12, 0.07  # rad, s, s: move, rest, move back, rest
STEP = 1e-3  # s, of controller and FMU
END = 2.0 * (MOVE + REST)
WARM, COLD = 313.15, 283.15  # K
STIFFNESS = 49.0 * 10800.0 / math.pi  # N·m/rad, of the catalogue
# As in friction.toml, with the defaults written out, because the reference needs them too.
INPUT = cy.Friction(
    coulomb=0.02, stribeck=0.01, stribeck_speed=2.0, viscous=1e-4, presliding_angle=2e-3, temperature_coefficient=0.015
)
OUTPUT = cy.Friction(coulomb=2.0, load_share=0.02, stribeck_speed=0.05, presliding_angle=2e-5)


@dataclass(frozen=True)
class Run:
    """A joint's motion at the controller's steps: time, angles and speeds of motor and arm, the motor's torque."""

    time: Array
    motor: Array
    motor_speed: Array
    arm: Array
    arm_speed: Array
    torque: Array

    @property
    def on_arm(self) -> Array:
        """Torque of the drive on the arm, mean over each step, N·m."""
        return ARM * np.diff(self.arm_speed) / STEP - WEIGHT

    @property
    def off(self) -> Array:
        """Error of the arm's angle, rad."""
        return self.arm - np.array([path(float(at))[0] for at in self.time])

    @property
    def resonance(self) -> float:
        """Frequency of the arm's oscillation with the motor at rest, Hz, from the reversals of its speed."""
        at = (self.time > MOVE + 0.005) & (self.time < MOVE + REST)
        t, w = self.time[at], self.arm_speed[at]
        i = np.flatnonzero(w[:-1] * w[1:] < 0.0)
        turns = t[i] - w[i] * STEP / (w[i + 1] - w[i])
        return float((turns.size - 1) / (2.0 * (turns[-1] - turns[0])))


def path(at: float) -> tuple[float, float, float]:
    """Desired angle, speed and acceleration of the arm at a time: a quintic path back and forth."""
    back = at > MOVE + REST
    s = min(max((at - (MOVE + REST) * back) / MOVE, 0.0), 1.0)
    way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    speed, acceleration = 30.0 * (s * (1.0 - s)) ** 2 / MOVE, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / MOVE**2
    sign = -1.0 if back else 1.0
    return WAY * (back + sign * way), sign * WAY * speed, sign * WAY * acceleration


Target = Callable[[float], tuple[float, float]]
"""Angle and speed of the motor that a servo controller follows."""


def at_ratio(ratio: float) -> Target:
    """Motor angle for an ideal drive."""

    def target(at: float) -> tuple[float, float]:
        wanted, speed, _ = path(at)
        return ratio * wanted, ratio * speed

    return target


def compensated(drive: cy.Drive, temperature: float) -> Target:
    """Motor angle from a compensator of the drive, for the torque of the motion."""
    compensator = drive.compensator(friction=OUTPUT, stiffness=STIFFNESS, largest_torque=400.0, residual="2 arcsec")
    memory = compensator.start()

    def target(at: float) -> tuple[float, float]:
        wanted, speed, acceleration = path(at)
        command = compensator.step(memory, wanted, speed, WEIGHT - ARM * acceleration, temperature)
        return command.motor_angle, command.motor_speed

    return target


def controller(at: float, angle: float, speed: float, ratio: float, target: Target) -> float:
    """Torque of the motor for the next step, N·m: feedforward of the motion, and a PD controller."""
    wanted, wanted_speed = target(at)
    _, _, acceleration = path(at + 0.5 * STEP)
    forward = MOTOR * ratio * acceleration + (ARM * acceleration - WEIGHT) / ratio
    return forward + 5.0 * (wanted - angle) + 0.15 * (wanted_speed - speed)


class Instance:
    """An FMU in fmpy, with its variables by name."""

    def __init__(self, fmu: Path, folder: str, **start: float) -> None:
        described = fmpy.read_model_description(str(fmu))
        self.variables = {v.name: v for v in described.modelVariables}
        self.slave = FMU2Slave(
            guid=described.guid,
            unzipDirectory=fmpy.extract(str(fmu), unzipdir=folder),
            instanceName=fmu.stem,
            modelIdentifier=described.coSimulation.modelIdentifier,
        )
        self.slave.instantiate()
        self.slave.setupExperiment(startTime=0.0)
        self.slave.enterInitializationMode()
        self.writer(tuple(start))(tuple(start.values()))
        self.slave.exitInitializationMode()

    def writer(self, names: tuple[str, ...]) -> Callable[[tuple[float, ...]], None]:
        references = [self.variables[name].valueReference for name in names]
        return lambda values: self.slave.setReal(references, values)

    def reader(self, *names: str) -> Callable[[], list[float]]:
        references = [self.variables[name].valueReference for name in names]
        return lambda: self.slave.getReal(references)

    def close(self) -> None:
        self.slave.terminate()
        self.slave.freeInstance()


def moved(fmu: Path, ratio: float, temperature: float, target: Target | None = None) -> tuple[Run, Array]:
    """Move the joint's FMU; return the run, and work done, kinetic, stored, lost and passed energy over time, J."""
    with tempfile.TemporaryDirectory() as folder:
        joint = Instance(fmu, folder, **{"flange_b.tau": WEIGHT, "temperature": temperature})
        put = joint.writer(("flange_a.tau",))
        get = joint.reader("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w")
        energies = joint.reader("elastic_energy", "dissipated_energy")
        times = STEP * np.arange(round(END / STEP) + 1)
        rows, torques, held, work = [get()], [], [energies()], [(0.0, 0.0)]
        target = target or at_ratio(ratio)
        for at in times[:-1]:
            torques.append(controller(float(at), rows[-1][0], rows[-1][1], ratio, target))
            put((torques[-1],))
            joint.slave.doStep(float(at), STEP)
            rows.append(get())
            held.append(energies())
            work.append((torques[-1] * (rows[-1][0] - rows[-2][0]), WEIGHT * (rows[-1][2] - rows[-2][2])))
        joint.close()
    motor, motor_speed, arm, arm_speed = np.array(rows).T
    elastic, lost = np.array(held).T
    kinetic = 0.5 * (MOTOR * motor_speed**2 + ARM * arm_speed**2)
    done, passed = np.cumsum(np.sum(work, axis=1)), np.cumsum(np.abs(work).sum(axis=1))
    run = Run(times, motor, motor_speed, arm, arm_speed, np.array(torques))
    return run, np.array([done, kinetic, elastic - elastic[0], lost, passed])


def rubbing(
    law: cy.Friction, strain: Array, speed: float, load: float, rated: float, temperature: float
) -> tuple[float, Array]:
    """Friction torque, and strain rates of the five springs that hold before sliding (Iwan 1966)."""
    extra = law.stribeck * math.exp(-((speed / law.stribeck_speed) ** 2))

    warmth = math.exp(-law.temperature_coefficient * (temperature - law.reference_temperature))
    stiffness = (law.coulomb + law.load_share * rated + law.stribeck) / (3.0 * law.presliding_angle)
    limit = warmth * (law.coulomb + law.load_share * abs(load) + extra) * np.arange(1, 6) / 15.0 / stiffness
    felt = strain + 2e-3 * speed  # including their damping
    beyond = strain - np.clip(strain, -limit, limit)
    return stiffness * np.clip(felt, -limit, limit).sum() + warmth * law.viscous * speed, speed - beyond / 1e-5


def reference(law: Instance, ratio: float, rated: float, damping: float, begin: list[float], temperature: float) -> Run:
    """Integrate the joint by SciPy's stiff solver, with the controller sampled as for the FMU."""
    put = law.writer(("flange_a.phi", "flange_b.phi"))
    get = law.reader("flange_a.tau", "flange_b.tau")

    def change(_: float, state: Array, torque: float) -> Array:
        motor, motor_speed, arm, arm_speed = state[:4]
        put((motor, arm))
        at_motor, at_arm = get()
        slip = arm_speed - motor_speed / ratio
        damped = math.copysign(min(damping * abs(slip), abs(at_arm)), slip)
        at_motor, at_arm = at_motor - damped / ratio, at_arm + damped
        rub_a, rate_a = rubbing(INPUT, state[4:9], motor_speed, at_motor, rated / ratio, temperature)
        rub_b, rate_b = rubbing(OUTPUT, state[9:], arm_speed, at_arm, rated, temperature)
        accelerations = (torque - at_motor - rub_a) / MOTOR, (WEIGHT - at_arm - rub_b) / ARM
        return np.array([motor_speed, accelerations[0], arm_speed, accelerations[1], *rate_a, *rate_b])

    times = STEP * np.arange(round(END / STEP) + 1)
    states, torques = [np.array([*begin, *np.zeros(10)])], []
    for at in times[:-1]:
        torques.append(controller(float(at), states[-1][0], states[-1][1], ratio, at_ratio(ratio)))
        solved = solve_ivp(
            change,
            (0.0, STEP),
            states[-1],
            method="LSODA",
            rtol=1e-10,
            atol=1e-10,
            args=(torques[-1],),
        )
        states.append(solved.y[:, -1])
    return Run(times, *np.array(states).T[:4], np.array(torques))


def compared(fmus: Path) -> tuple[Run, Run, Array, Array]:
    """The warm run of the joint, that of the reference, and the energies of the warm and cold runs (`moved`)."""
    drive = cy.read_drive(HERE / "rv-20e.toml")
    rated, friction = drive.pair.rated_torque or 0.0, {"input_friction": INPUT, "output_friction": OUTPUT}
    inside = cy.Interface("compliant", ARM, crank_inertia=MOTOR, stiffness=STIFFNESS, **friction)
    drive.build_fmu(fmus / "joint.fmu", inside)
    drive.build_fmu(fmus / "law.fmu", cy.Interface("compliant", stiffness=STIFFNESS, mesh_damping=0.0))
    began = time.perf_counter()
    warm, energy = moved(fmus / "joint.fmu", drive.ratio, WARM)
    _, cold_energy = moved(fmus / "joint.fmu", drive.ratio, COLD)
    print(f"the FMU moves twice: {time.perf_counter() - began:.1f} s")
    began = time.perf_counter()
    begin = [float(values[0]) for values in (warm.motor, warm.motor_speed, warm.arm, warm.arm_speed)]
    with tempfile.TemporaryDirectory() as folder:
        law = Instance(fmus / "law.fmu", folder, **{"flange_a.phi": begin[0], "flange_b.phi": begin[2]})
        described = {v.name: v for v in fmpy.read_model_description(str(fmus / "joint.fmu")).modelVariables}
        damping = float(described["mesh_damping"].start)
        exact = reference(law, drive.ratio, rated, damping, begin, WARM)
        law.close()
    print(f"SciPy at 1e-10: {time.perf_counter() - began:.1f} s")
    return warm, exact, energy, cold_energy


def main() -> None:
    OUT.mkdir(exist_ok=True)
    warnings.simplefilter("ignore", UserWarning)  # about contradictions in the reducer's file
    warm, exact, energy, cold = compared(OUT)
    for name, unit, ours, theirs in (
        ("resonance", "Hz", warm.resonance, exact.resonance),
        ("peak torque on the arm", "N·m", np.abs(warm.on_arm).max(), np.abs(exact.on_arm).max()),
    ):
        print(f"{name}: FMU {ours:.2f} {unit}, SciPy {theirs:.2f} {unit}: {100.0 * (ours / theirs - 1.0):+.2f} %")
    done, kinetic, elastic, lost, passed = energy
    missed = np.abs(done - kinetic - elastic - lost).max()
    print(f"energy: {passed[-1]:.1f} J passed, {lost[-1]:.2f} J lost; balance within {missed:.0e} J")
    print(f"at {COLD - 273.15:.0f} °C {cold[3, -1]:.2f} J are lost")
    drive = cy.read_drive(HERE / "rv-20e.toml")
    exactly, _ = moved(OUT / "joint.fmu", drive.ratio, WARM, compensated(drive, WARM))
    off = {"motor at ratio times the desired angle": warm.off, "compensated": exactly.off}
    for name, one in off.items():
        rms, end = np.sqrt(np.mean(one**2)) * cy.ARCMIN, one[-1] * cy.ARCMIN
        print(f"{name}: error of the arm {rms:.2f}′ rms, {end:+.2f}′ at rest at the end")

    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    axes = figure.subplots(4, sharex=True)
    middle = (warm.time[:-1] + 0.5 * STEP) * 1e3
    axes[0].plot(middle, exact.on_arm, color="0.6", lw=3.0, label="SciPy, LSODA at 1e-10")
    axes[0].plot(middle, warm.on_arm, lw=1.0, label="FMU, steps of 1 ms")
    axes[0].set(ylabel="torque on the arm [N·m]")
    axes[1].plot(warm.time * 1e3, (warm.arm - exact.arm) * cy.ARCSEC, lw=1.0, label="FMU minus SciPy, arm's angle")
    axes[1].set(ylabel="difference [arcsec]")
    for color, (name, one) in zip(("0.6", "C0"), off.items(), strict=True):
        axes[2].plot(warm.time * 1e3, one * cy.ARCMIN, color=color, lw=1.0, label=name)
    axes[2].set(ylabel="arm − desired [arcmin]")
    for temperature, one in ((WARM, lost), (COLD, cold[3])):
        axes[3].plot(warm.time * 1e3, one, lw=1.0, label=f"{temperature - 273.15:.0f} °C")
    axes[3].set(xlabel="time [ms]", ylabel="energy lost [J]")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    figure.savefig(OUT / "robot_joint.png", dpi=150)
    print(f"See {OUT / 'robot_joint.png'}.")


if __name__ == "__main__":
    main()
