"""The rotor inside an FMU and the arm in its host: against the arm inside, and beside MuJoCo."""

import math
import re
import runpy

import joint_cases
import numpy as np
import pytest
from c_host import Slave, native_of
from clockworks import Drive
from common import EXAMPLES
from fmpy.fmi1 import FMICallException

from cycloid_fmu.fmu import library
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.native import build_native
from cycloid_fmu.fmu.variables import Interface

ROTOR, ARM = 1e-4, 2.0  # kg·m²
CHAIN = {
    "mesh_damping": 17.0,
    "losses": ((0.0, 0.9, 0.88, 0.0, 0.0),),
    "input_friction": Friction(coulomb=0.02, stribeck=0.01, viscous=1e-4),
    "output_friction": Friction(coulomb=2.0, load_share=0.02),
}
STIFFNESS = 1.684e5  # N·m/rad, of a whole drive of this size
INSIDE = Interface("compliant", ARM, crank_inertia=ROTOR, series_compliance=5e-6, **CHAIN)
ALONE = Interface("compliant", crank_inertia=ROTOR, series_compliance=5e-6, **CHAIN)


@pytest.fixture(scope="module")
def beside():
    """What the example steps an FMU beside MuJoCo with."""
    pytest.importorskip("mujoco")
    return runpy.run_path(str(EXAMPLES / "fmu_beside_mujoco.py"))


@pytest.fixture(scope="module")
def rotor(drive):
    """A drive with the rotor alone, which has begun."""
    found = Drive(drive, ALONE)
    found.forget_history()
    return found


def moved_inside(drive, motor, h, count):
    """Rows of the rotor's and the arm's angle with both inside, and what both begin with."""
    both = Drive(drive, INSIDE)
    both.torque, both.crank_angle_start = 30.0, 0.2
    both.forget_history()
    start, rows = [both.output_angle, both.output_speed], []
    for k in range(count):
        both.clockwork.set("flange_a.tau", motor(k * h))
        both.advance(h)
        rows.append([both.crank_angle, both.output_angle, both.dissipated_energy])
    return start, np.array(rows)


def test_an_arm_on_nothing_but_the_drive_moves_as_one_inside(drive):
    """The mean torque over a step is the arm's impulse exactly: a host that adds it up has the motion of one model."""

    def motor(time):
        return 2.0 * math.sin(75.0 * time)

    (angle, speed), exact = moved_inside(drive, motor, 1e-3, 150)
    alone, rows = Drive(drive, ALONE), []
    alone.output_angle, alone.output_speed, alone.crank_angle_start = angle, speed, 0.2
    alone.arm_inertia, alone.arm_torque = ARM, 30.0
    alone.forget_history()
    for k in range(150):
        alone.clockwork.set("flange_b.phi", angle)
        alone.clockwork.set("flange_b.w", speed)
        alone.clockwork.set("flange_a.tau", motor(k * 1e-3))
        alone.advance(1e-3)
        speed += 1e-3 * (30.0 - alone.torque) / ARM
        angle = alone.arm_angle
        rows.append([alone.crank_angle, angle, alone.dissipated_energy])
    assert np.ptp(np.array(rows)[:, 1]) > 1e-3
    assert np.abs(np.array(rows) / exact - 1.0).max() < 1e-9


def test_torque_rate_and_controller_act_within_the_step(drive):
    """One step of 2 ms with them is a thousand with the torques of their times."""
    stiffness, damping, rate, count = 0.5, 0.02, 4000.0, 1000
    h = 2e-3 / count
    both, alone = Drive(drive, INSIDE), Drive(drive, ALONE)
    for one in (both, alone):
        one.crank_angle_start, one.largest_step = 0.2, h
    both.forget_history()
    alone.output_angle, alone.arm_inertia, alone.arm_torque_rate = both.output_angle, ARM, rate
    alone.motor_stiffness, alone.motor_damping = stiffness, damping
    alone.clockwork.set("flange_a.tau", 1.0)
    alone.advance(2e-3)
    for k in range(count):
        turned, turning = both.crank_angle + 0.5 * h * both.crank_speed, both.crank_speed
        both.torque = rate * (k + 0.5) * h
        both.clockwork.set("flange_a.tau", 1.0 - stiffness * (turned - 0.2) - damping * turning)
        both.advance(h)
    moved = [one.crank_angle - 0.2 for one in (both, alone)]
    assert moved[1] == pytest.approx(moved[0], rel=3e-4)
    assert alone.crank_speed == pytest.approx(both.crank_speed, rel=3e-4)
    assert alone.arm_angle - both.output_angle == pytest.approx(0.0, abs=1e-3 * rate * 2e-3**3 / 6.0 / ARM)
    assert both.crank_speed < 0.7 * 2e-3 / ROTOR  # as it would be without the controller and the teeth


class Scene:
    """A scenario of the joints: its arm beside MuJoCo or inside an FMU, under its motor commands."""

    def __init__(self, beside, name, build, length):
        self.case, self.beside, self.build = joint_cases.read(name), beside, build
        self.commands, self.period = self.case["commands"][:length], self.case["control_period"]
        self.drive, self.motor = self.case["drive"], self.case["initial"]["motor_angle"]

    def load(self, angle):
        return -self.drive["mgl"] * math.sin(angle)

    def inside(self, h=1e-5):
        """The arm's angles inside, rad, at steps in which torques may be constant."""
        load = self.load(self.case["initial"]["arm_angle"])
        path = self.build(self.drive["J"], self.drive["Jb"])
        fmu = self.beside["Fmu"](path, crank_angle_start=self.motor, flange_b__tau=load)
        angles = fmu.get("flange_b.phi")
        for torque, kp, kd, wanted, rate in self.commands:
            for _ in range(round(self.period / h)):
                turned, turning, at, speed = fmu.get("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w")
                drives = torque + kp * (wanted - turned - 0.5 * h * turning) + kd * (rate - turning)
                fmu.set({"flange_a.tau": drives, "flange_b.tau": self.load(at + 0.5 * h * speed)})
                fmu.step(h)
            angles += fmu.get("flange_b.phi")
        return np.array(angles)

    def outside(self, h, start):
        """The arm's angles in MuJoCo, rad, from one."""
        import mujoco

        model = mujoco.MjModel.from_xml_string(joint_cases.pendulum(self.drive))
        model.opt.timestep = h
        data = mujoco.MjData(model)
        data.qpos[0] = start
        mujoco.mj_forward(model, data)
        path = self.build(self.drive["J"], 0.0)
        fmu = self.beside["Fmu"](path, crank_angle_start=self.motor, flange_b__phi=start)
        hinge, angles = self.beside["Hinge"](model, data, "arm", fmu), [start]
        for torque, kp, kd, wanted, rate in self.commands:
            for _ in range(round(self.period / h)):
                turned, turning = fmu.get("flange_a.phi", "flange_a.w")
                drives = torque + kp * (wanted - turned) + kd * (rate - turning)
                hinge.step({"flange_a.tau": drives, "motor_stiffness": kp, "motor_damping": kd})
            angles.append(float(data.qpos[0]))
        return np.array(angles)


def native_builder(drive, folder, version):
    """A builder of native FMUs by the inertias of rotor and arm, kg·m²; 0 for an arm in the host."""

    def build(rotor, arm):
        interface = Interface("compliant", arm, crank_inertia=rotor, stiffness=STIFFNESS, **CHAIN)
        path, here = folder / f"{arm:g}.fmu", [library.this_platform()]
        build_native(drive, path, interface=interface, fmi_version=version, drive_tables=drive.tables, platforms=here)
        return path

    return build


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("steel-move", "3.0"),
        pytest.param("steel-move", "2.0", marks=pytest.mark.slow(15)),
        pytest.param("light-move", "2.0", marks=pytest.mark.slow(1)),
        pytest.param("steel-free", "3.0", marks=pytest.mark.slow(15)),
    ],
)
def test_beside_mujoco_at_its_steps_the_arm_moves_as_one_inside(beside, drive, tmp_path, name, version):
    """Both masses in MuJoCo, or short steps of the FMU with a held arm, are 0.4 to 2.4 mrad off there, or fail."""
    scene = Scene(beside, name, native_builder(drive, tmp_path, version), 150)
    exact = scene.inside()
    assert np.ptp(exact) > 0.01
    for h in (1e-3, 2e-3):
        off = scene.outside(h, exact[0]) - exact
        assert math.sqrt(np.mean(off**2)) < 0.04e-3, h


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_the_exact_fmu_moves_the_arm_as_the_native_one(beside, drive, tmp_path, version):
    """To the accuracy of the tables."""

    def build(rotor, arm):
        interface = Interface("compliant", arm, crank_inertia=rotor, stiffness=STIFFNESS, **CHAIN)
        build_fmu(drive, tmp_path / "exact.fmu", interface=interface, fmi_version=version)
        return tmp_path / "exact.fmu"

    makers = native_builder(drive, tmp_path, version), build
    native, exact = (Scene(beside, "steel-move", maker, 8).outside(1e-3, -0.6) for maker in makers)
    assert np.abs(native - exact).max() < 2e-7
    assert np.ptp(exact) > 1e-6


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("arm_inertia", -1.0, "arm_inertia = -1: it must be finite and lie between 0 and inf"),
        ("arm_inertia", math.nan, "arm_inertia = nan: it must be finite"),
        ("arm_torque", math.inf, "arm_torque = inf: it must be finite"),
        ("arm_torque_rate", math.nan, "arm_torque_rate = nan: it must be finite"),
        ("motor_stiffness", -1.0, "motor_stiffness = -1: it must be finite and lie between 0 and inf"),
        ("motor_damping", math.nan, "motor_damping = nan: it must be finite"),
    ],
)
def test_an_input_that_no_arm_or_motor_has_is_refused(rotor, name, value, said):
    before = rotor.state()
    with pytest.raises(ValueError, match=re.escape(said)):
        rotor.clockwork.set(name, value)
    assert rotor.state() == before


def test_a_step_without_an_arm_is_refused_and_changes_nothing(drive):
    alone = Drive(drive, ALONE)
    alone.forget_history()
    before = alone.state()
    assert alone.clockwork.advance(0.0, 1e-3) == (
        "arm_inertia = 0: before a step set it to the arm's inertia at flange_b, above 0 kg.m2"
    )
    assert alone.state() == before


def test_an_arm_that_the_host_moves_away_is_refused_by_name(drive, tmp_path):
    interface = Interface("compliant", crank_inertia=ROTOR)
    slave = Slave(native_of(tmp_path, drive, drive.tables, interface), tmp_path / "unpacked")
    slave.start(arm_inertia=ARM)
    slave.put(flange_b_phi=0.02)
    with pytest.raises(FMICallException):
        slave.fmi.doStep(0.0, 1e-3)
    assert "flange_b.phi is 0.02 rad from flange_a.phi/ratio: it must stay within 0.01 rad" in slave.said[-1]
