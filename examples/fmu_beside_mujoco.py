"""An FMU beside MuJoCo
=====================

MuJoCo has the arm, the FMU the drive with its rotor. `Hinge.step` is all that connects them: set, step, read. A motor
moves the arm at steps of 1 and 2 ms. It is compared with the arm inside the FMU, at 10 µs.

It needs MuJoCo: `pip install mujoco`.
"""

from pathlib import Path
from typing import Any

import fmpy
import mujoco
import numpy as np
from fmpy.simulation import instantiate_fmu
from numpy.typing import NDArray

import cycloid_fmu as cy

HERE, OUT = Path(__file__).parent, Path("fmu_beside_mujoco_out")
END, EACH = 0.5, 2e-3  # s
ROTOR, ARM, MASS, LENGTH = 1e-4, 2.0, 20.0, 0.3  # kg·m², kg·m², kg, m
KP, KD = 2.0, 0.1  # of the motor's controller, N·m/rad and N·m·s/rad
MODEL = f"""<mujoco><option integrator="implicitfast"/><worldbody><body><joint name="arm" axis="0 1 0"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{3 * f" {ARM - MASS * LENGTH**2:.6f}"}"/>
</body></worldbody></mujoco>"""
MOTION = ("flange_a.phi", "flange_a.w")


class Fmu:
    """An FMU of either version, with its variables by name."""

    def __init__(self, path: Path, **start: float) -> None:
        described = fmpy.read_model_description(str(path))
        self.fmi = instantiate_fmu(fmpy.extract(str(path)), described, "CoSimulation")
        self.references = {v.name: v.valueReference for v in described.modelVariables}
        old = described.fmiVersion == "2.0"
        self.set_, self.get_ = (
            (self.fmi.setReal, self.fmi.getReal) if old else (self.fmi.setFloat64, self.fmi.getFloat64)
        )
        if old:
            self.fmi.setupExperiment()
        self.set({name.replace("__", "."): value for name, value in start.items()})
        self.fmi.enterInitializationMode()
        self.fmi.exitInitializationMode()
        self.time = 0.0

    def set(self, values: dict[str, float]) -> None:
        """Set variables."""
        self.set_([self.references[name] for name in values], list(values.values()))

    def step(self, h: float) -> None:
        """Make a step."""
        self.fmi.doStep(self.time, h)
        self.time += h

    def get(self, *names: str) -> list[float]:
        """Return variables."""
        found: list[float] = self.get_([self.references[name] for name in names])
        return found


class Hinge:
    """A hinge of a MuJoCo model, with neither armature nor friction nor actuator, and the FMU of its drive."""

    def __init__(self, model: Any, data: Any, name: str, fmu: Fmu) -> None:
        self.model, self.data, self.fmu = model, data, fmu
        self.dof, self.place = model.joint(name).dofadr[0], model.joint(name).qposadr[0]
        self.forces, self.solved, self.smooth = *np.zeros((2, 3, model.nv)), None
        self.forces[2, self.dof] = 1.0

    def step(self, motor: dict[str, float]) -> None:
        """Move the model by one step in place of `mj_step`, with the motor's inputs of the FMU."""
        data, dof, h = self.data, self.dof, self.model.opt.timestep
        mujoco.mj_step1(self.model, data)
        # What acts on the arm besides the drive, and how it goes on changing over the step.
        smooth = (data.qfrc_passive - data.qfrc_bias)[dof]
        self.forces[0] = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_constraint
        self.forces[0] += data.qfrc_applied
        self.forces[1, dof] = 0.0 if self.smooth is None else (smooth - self.smooth) / h
        self.smooth = smooth
        mujoco.mj_solveM(self.model, data, self.solved, self.forces)
        inertia = 1.0 / self.solved[2, dof]
        self.fmu.set(
            {
                "flange_b.phi": data.qpos[self.place],
                "flange_b.w": data.qvel[dof],
                "arm_inertia": inertia,
                "arm_torque": inertia * self.solved[0, dof] - data.qfrc_applied[dof],
                "arm_torque_rate": inertia * self.solved[1, dof],
                **motor,
            }
        )
        self.fmu.step(h)
        torque, angle = self.fmu.get("flange_b.tau", "arm_angle")
        data.qfrc_applied[dof] = -torque + 0.5 * h * self.forces[1, dof]
        mujoco.mj_step2(self.model, data)
        data.qpos[self.place], data.qfrc_applied[dof] = angle, -torque


def command(time: float, ratio: float, motor: list[float]) -> dict[str, float]:
    """The motor's torque at its angle and speed, and how its controller changes it within the step."""
    wanted = ratio * 0.4 * (1.0 - np.cos(2.0 * np.pi * EACH * (time // EACH) / END))
    return {"flange_a.tau": KP * (wanted - motor[0]) - KD * motor[1], "motor_stiffness": KP, "motor_damping": KD}


def beside(path: Path, h: float, ratio: float) -> NDArray[np.float64]:
    """Return the arm's angle every `EACH`, rad, with the arm in MuJoCo."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.timestep = h
    data = mujoco.MjData(model)
    hinge, angles = Hinge(model, data, "arm", Fmu(path)), [0.0]
    for _ in range(round(END / EACH)):
        for _ in range(round(EACH / h)):
            hinge.step(command(data.time + 1e-9, ratio, hinge.fmu.get(*MOTION)))
        angles.append(float(data.qpos[0]))
    return np.array(angles)


def inside(path: Path, h: float, ratio: float) -> NDArray[np.float64]:
    """Return the same with the arm in the FMU too, at steps short enough for torques that are constant in them."""
    fmu, angles = Fmu(path), [0.0]
    for _ in range(round(END / EACH)):
        for _ in range(round(EACH / h)):
            at, speed = fmu.get("flange_b.phi", "flange_b.w")
            turned, turning = fmu.get(*MOTION)
            motor = command(fmu.time + 1e-9, ratio, [turned + 0.5 * h * turning, turning])
            load = -MASS * 9.81 * LENGTH * np.sin(at + 0.5 * h * speed)
            fmu.set({"flange_a.tau": motor["flange_a.tau"], "flange_b.tau": float(load)})
            fmu.step(h)
        angles.append(fmu.get("flange_b.phi")[0])
    return np.array(angles)


def main() -> None:
    """Compare the arm in MuJoCo with the arm in the FMU."""
    OUT.mkdir(exist_ok=True)
    drive = cy.read_drive(HERE / "drive-39-40.toml")
    for name, output_inertia in (("rotor", 0.0), ("both", ARM)):
        interface = cy.Interface(
            "compliant",
            output_inertia,
            crank_inertia=ROTOR,
            stiffness=1.684e5,
            mesh_damping=17.0,
            output_friction=cy.Friction(coulomb="2 N*m", load_share=0.02),
        )
        drive.build_fmu(OUT / f"{name}.fmu", interface, native=True)
    exact = inside(OUT / "both.fmu", 1e-5, drive.ratio)
    for h in (1e-3, 2e-3):
        off = beside(OUT / "rotor.fmu", h, drive.ratio) - exact
        print(f"{1e3 * h:g} ms: {1e3 * np.sqrt(np.mean(off**2)):.3f} mrad rms, of {np.ptp(exact):.2f} rad")


if __name__ == "__main__":
    main()
