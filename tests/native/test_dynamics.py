"""Inertias inside: torque, energy and motion of a joint, exact and native, against balances and SciPy's solvers."""

import dataclasses
import itertools
import math

import fmpy
import numpy as np
import pytest
from c_host import Slave, native_of
from clockworks import Drive, compliant_drive
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from cycloid_fmu import edge
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.fmu.build import with_damping
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import Interface

CHAIN = {"series_compliance": 5e-6, "mesh_damping": 50.0}
LOSSY = ((0.0, 0.9, 0.85, 0.02, 0.03), (400.0, 0.92, 0.87, 0.05, 0.06))
ARM, MOTOR = 2.0, 1e-3  # kg·m²
OUTPUTS = ("flange_a.tau", "flange_b.phi", "flange_b.w", "elastic_energy", "dissipated_energy")
NAMES = {
    "flange_a.phi": "crank_angle",
    "flange_a.w": "crank_speed",
    "flange_a.tau": "crank_torque",
    "flange_b.tau": "torque",
    "flange_b.phi": "output_angle",
    "flange_b.w": "output_speed",
}


class Exact:
    """The model in Python with the native FMU's manners."""

    def __init__(self, drive, interface):
        self.model = Drive(drive, interface)

    def put(self, values):
        for name, value in values.items():
            setattr(self.model, NAMES.get(name, name), value)

    def start(self, values):
        self.put(values)
        self.model.forget_history()
        self.model.advance()

    def step(self, time, size):
        self.model.advance(size)

    def get(self, *names):
        return [getattr(self.model, NAMES.get(name, name)) for name in names]


class Native:
    def __init__(self, slave):
        self.slave, self.get = slave, slave.get

    def put(self, values):
        self.slave.put(**values)

    def start(self, values):
        self.slave.start(**values)

    def step(self, time, size):
        self.slave.fmi.doStep(time, size)


@pytest.fixture
def joint(drive, tmp_path):
    """A drive with inertias inside, "exact" or "native", started."""
    made = []

    def one(kind, interface=None, **values):
        interface = dataclasses.replace(interface or Interface("compliant", ARM), mesh_damping=0.0)
        if kind == "exact":
            found = Exact(drive, interface)
        else:
            folder = tmp_path / str(len(made))
            folder.mkdir()
            path = native_of(folder, drive, drive.tables, interface)
            made.append(Slave(path, folder / "unpacked"))
            found = Native(made[-1])
        found.start({name.replace("__", "."): value for name, value in values.items()})
        return found

    yield one
    for each in made:
        each.fmi.freeInstance()


# --- balances ---


@pytest.mark.parametrize(
    ("kind", "speed", "step"),
    [("native", speed, step) for speed in (0.0, 5.0, 60.0, 314.0) for step in (1e-5, 1e-4, 1e-3)]
    + [("exact", 314.0, 1e-3), ("exact", 60.0, 1e-4)],
)
def test_at_constant_speed_the_crank_bears_the_load_over_the_ratio_and_the_losses(joint, drive, kind, speed, step):
    load, pitch = 47.0, 2.0 * math.pi / drive.pair.pins
    found = joint(
        kind,
        Interface("compliant", ARM, LOSSY),
        flange_a__w=-speed,
        flange_b__tau=-load,
        **{**CHAIN, "mesh_damping": 1000.0},
    )
    time, torque = 0.0, []
    for _ in range(15):
        found.step(time, 2e-3)
        time += 2e-3
    # Over whole mesh pitches, as the last digits of a step allow.
    steps = 40 if speed == 0.0 else max(round(2.0 * pitch / speed / step), 1)
    size = step if speed == 0.0 else pitch / speed * max(round(steps * step * speed / pitch), 1) / steps
    for _ in range(steps):
        found.step(time, size)
        time += size
        torque += found.get("flange_a.tau")
    meshed = load / drive.pair.ratio
    forward, friction = (np.interp(speed, *zip(*((row[0], row[i]) for row in LOSSY), strict=True)) for i in (1, 3))
    wanted = -meshed if speed == 0.0 else (-meshed + friction) / forward
    assert -np.mean(torque) == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize(("kind", "step"), [("exact", 1e-3), ("native", 5e-5), ("native", 1e-3), ("native", 7e-3)])
@pytest.mark.parametrize("parameters", [{}, {"friction_torque": 3.0, "mesh_damping": 20.0}])
def test_work_done_is_stored_lost_or_given_back_through_reversals_and_impacts(joint, kind, step, parameters):
    interface = Interface("compliant", ARM)
    if parameters:
        interface = Interface(
            "compliant",
            ARM,
            LOSSY,
            input_friction=Friction(coulomb=0.01, load_share=0.02, stribeck=0.01, viscous=1e-4),
            output_friction=Friction(load_share=0.02, stribeck=1.0, viscous=0.5),
        )
    found = joint(kind, interface, **parameters)
    lowest = highest = passed = 0.0
    begun, done = found.get("elastic_energy")[0], 0.0
    crank, (output,), balance, sides = 0.0, found.get("flange_b.phi"), [], set()
    for i in range(round(0.3 / step)):
        time = step * i
        goal = 0.5 * (1.0 - math.cos(40.0 * (time + step)))
        # The angle is the final one, at no speed: the crank moves there in one step.
        found.put({"flange_a.phi": goal, "flange_a.w": 0.0, "flange_b.tau": 5.0 * math.sin(90.0 * time)})
        found.step(time, step)
        torque, reached, speed, elastic, lost = found.get(*OUTPUTS)
        work = torque * (goal - crank), 5.0 * math.sin(90.0 * time) * (reached - output)
        crank, output = goal, reached
        done, passed = done + sum(work), passed + sum(map(abs, work))
        balance.append(done - (0.5 * ARM * speed**2 + elastic - begun + lost))
        sides.add(found.get("torsional_stiffness")[0] > 0.0)
        lowest, highest = min(lowest, torque), max(highest, torque)
    assert sides == {True, False} or step > 1e-3
    assert lowest < -0.1 * highest < 0.0
    assert passed > 0.01
    assert np.abs(balance).max() < 1e-7 * passed


# --- against SciPy ---


def reference(drive, last, begin, motor=None, load=0.0, damping=0.0, compliance=0.0):
    """Motion by SciPy's stiff solver at 1e-10: the contacts' law is the product's, the rest is not.

    The crank turns at its speed, or has the inertia `MOTOR` and a torque over time. Returned are angle and speed of
    crank and output over time, and the contacts' torques.
    """
    contacts, ratio = compliant_drive(drive.stage), drive.pair.ratio
    contacts.forget_history()
    contacts.series_compliance = compliance

    def torques(angle, speed, output, output_speed):
        by_angle, by_rotation = contacts.pressed(angle, output)
        slip = output_speed - speed / ratio
        damped = math.copysign(min(damping * abs(slip), abs(by_rotation)), slip)
        return by_angle - damped / ratio, by_rotation + damped

    def change(time, state):
        by_angle, by_rotation = torques(*state)
        driven = 0.0 if motor is None else (motor(time) - by_angle) / MOTOR
        return [state[1], driven, state[3], (load - by_rotation) / ARM]

    solved = solve_ivp(change, (0.0, last), begin, method="LSODA", rtol=1e-10, atol=1e-13, dense_output=True)
    return solved.sol, lambda time: np.array([torques(*state) for state in solved.sol(time).T])


@pytest.mark.parametrize("kind", ["exact", "native"])
def test_an_arm_that_meets_the_locked_drive_peaks_as_scipy_has_it(joint, drive, kind):
    """It plays into the drive at 0.5 rad/s, as far as 4 times beyond the tables; and once more when it comes back."""
    ratio, step, last = drive.pair.ratio, 1e-5, 4e-3
    found = joint(kind)
    output = found.get("flange_b.phi")[0]
    speed = 0.5 * ratio
    exact, torques = reference(drive, last, (0.0, speed, output, 0.0))
    time, torque, swing = step * np.arange(round(last / step)), [], []
    for t in time:
        found.put({"flange_a.phi": speed * t, "flange_a.w": speed})
        found.step(t, step)
        torque += found.get("flange_a.tau")
        swing += found.get("flange_b.w")
    wanted = torques(time + 0.5 * step)[:, 0]
    assert np.abs(wanted).max() > 40.0
    assert np.abs(torque).max() == pytest.approx(np.abs(wanted).max(), rel=0.02)
    # The time of its departure gives the frequency of arm on contacts.
    left, met = (np.interp(-0.5, -np.array(v[::-1]), time[::-1]) for v in (swing, exact(time + step)[3]))
    assert left == pytest.approx(met, rel=0.01)


@pytest.mark.parametrize(("kind", "step"), [("exact", 1e-3), ("native", 1e-3), ("native", 1e-4)])
def test_motor_and_arm_move_as_scipy_has_them(joint, drive, kind, step):
    """With both inertias inside a host gives only torques: through reversals and the play at its own steps."""
    load, last = 20.0, 0.15

    def motor(time):
        return 2.0 * math.sin(75.0 * time)

    interface = Interface("compliant", ARM, crank_inertia=MOTOR)
    found = joint(kind, interface, flange_b__tau=load, crank_angle_start=0.2, **CHAIN)
    begun = [*found.get("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w"), *found.get("elastic_energy")]
    exact, _ = reference(drive, last, begun[:4], motor, load, CHAIN["mesh_damping"], CHAIN["series_compliance"])
    assert begun[0] == 0.2
    done, passed, rows = 0.0, 0.0, [begun[:4]]
    time = step * np.arange(round(last / step) + 1)
    for a, b in itertools.pairwise(time):
        torque = np.mean([motor(a + share * (b - a)) for share in (0.125, 0.375, 0.625, 0.875)])
        found.put({"flange_a.tau": torque})
        found.step(a, b - a)
        rows.append(found.get("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w"))
        work = torque * (rows[-1][0] - rows[-2][0]), load * (rows[-1][2] - rows[-2][2])
        done, passed = done + sum(work), passed + sum(map(abs, work))
    off, wanted = np.array(rows) - exact(time).T, exact(time).T
    assert (np.abs(off).max(axis=0) < 3e-3 * np.ptp(wanted, axis=0)).all()
    (_, w, _, w_b), (elastic, lost) = rows[-1], found.get("elastic_energy", "dissipated_energy")
    stored = 0.5 * MOTOR * w**2 + 0.5 * ARM * w_b**2 + elastic - begun[4]
    assert lost > 1e-3 * passed
    assert done == pytest.approx(stored + lost, abs=1e-7 * passed)


@pytest.mark.parametrize("kind", ["exact", "native"])
def test_a_motor_inside_stops_in_its_friction_without_chattering(joint, kind):
    interface = Interface("compliant", ARM, ((0.0, 1.0, 1.0, 0.02, 0.02),), crank_inertia=1e-4)
    found = joint(kind, interface, crank_speed_start=2.0, **CHAIN)
    speeds = []
    for i in range(600):
        found.step(1e-3 * i, 1e-3)
        speeds += found.get("flange_a.w")
    assert np.abs(speeds[-20:]).max() < 1e-3


@pytest.mark.parametrize("version", [pytest.param("2.0", marks=pytest.mark.slow(1)), "3.0"])
def test_a_joint_with_both_inertias_is_described_and_a_kinematic_one_has_none(drive, tmp_path, version):
    path = tmp_path / "joint.fmu"
    interface = Interface("compliant", ARM, crank_inertia=MOTOR)
    native_build.build_native(drive, path, interface=interface, fmi_version=version, drive_tables=drive.tables)
    assert validate_fmu(str(path)) == []
    with pytest.raises(edge.InputError, match="crank_inertia is only for the compliant interface"):
        native_build.build_native(drive, path, interface=Interface(crank_inertia=MOTOR))


@pytest.mark.parametrize("kind", ["exact", "native"])
def test_a_compliant_fmu_as_it_is_built_runs_between_motor_and_arm_at_its_own_step(drive, tmp_path, kind):
    """A position-controlled motor and an arm that hangs, outside: torques are read, then held over the step."""
    interface = with_damping(Interface("compliant"), drive)
    step, ratio = interface.step, drive.pair.ratio
    path = native_of(tmp_path, drive, drive.tables, interface)
    assert float(fmpy.read_model_description(str(path)).defaultExperiment.stepSize) == step
    found = Exact(drive, interface) if kind == "exact" else Native(Slave(path, tmp_path / "unpacked"))
    found.start({"mesh_damping": interface.mesh_damping} if kind == "exact" else {})
    assert found.get("mesh_damping") == [pytest.approx(interface.mesh_damping)]
    crank = speed = output = output_speed = done = passed = largest = 0.0
    for i in range(1500 if kind == "exact" else 10000):
        time = step * i
        found.put({"flange_a.phi": crank, "flange_a.w": speed, "flange_b.phi": output, "flange_b.w": output_speed})
        at_crank, at_output = found.get("flange_a.tau", "flange_b.tau")
        found.step(time, step)
        aim, aimed = 10.0 * (1.0 - math.cos(12.0 * time)), 120.0 * math.sin(12.0 * time)
        motor, arm = 60.0 * (aim - crank) + 0.5 * (aimed - speed), -47.0 * math.sin(output)
        faster, swung = step * (motor - at_crank) / MOTOR, step * (arm - at_output) / ARM
        ways = step * (speed + 0.5 * faster), step * (output_speed + 0.5 * swung)
        work = motor * ways[0], arm * ways[1]
        done, passed, largest = done + sum(work), passed + sum(map(abs, work)), max(largest, abs(at_output))
        crank, output, speed, output_speed = crank + ways[0], output + ways[1], speed + faster, output_speed + swung
    elastic, lost = found.get("elastic_energy", "dissipated_energy")
    balance = done - 0.5 * MOTOR * speed**2 - 0.5 * ARM * output_speed**2 - elastic - lost
    assert abs(output - crank / ratio) < 1e-3
    assert largest < 2.5 * drive.pair.rated_torque
    assert abs(balance) < 1e-3 * passed
