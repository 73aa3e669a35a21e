"""A rotating housing: exact and native; a common rotation changes nothing, and no torque is lost."""

import dataclasses
import math

import fmpy
import numpy as np
import pytest
from c_host import Slave, native_of
from clockworks import Drive

from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import described
from cycloid_fmu.fmu.variables import ABSOLUTE, ATTRIBUTES, Interface

KINDS = {
    "kinematic": Interface(losses=((0.0, 0.9, 0.85, 0.02, 0.03),)),
    "compliant": Interface("compliant", losses=((0.0, 0.9, 0.85, 0.02, 0.03),), mesh_damping=20.0),
    "inertia": Interface("compliant", 0.5, mesh_damping=20.0),
    "joint": Interface("compliant", 0.5, crank_inertia=1e-3, mesh_damping=20.0),
    "rotor": Interface("compliant", crank_inertia=1e-3, mesh_damping=20.0),
}
STARTS = {"series_compliance": 5e-6, "friction_torque": 2.0}


class Exact:
    def __init__(self, drive, interface):
        self.names = {**ATTRIBUTES, **(ABSOLUTE if interface.support_flange else {})}
        self.model = Drive(drive, interface)

    def put(self, values):
        for name, value in values.items():
            setattr(self.model, self.names.get(name, name), value)

    def start(self, values):
        self.put(values)
        self.model.forget_history()
        self.model.advance()

    def step(self, time, size):
        self.model.advance(size)

    def get(self, *names):
        return [getattr(self.model, self.names.get(name, name)) for name in names]


class Native:
    def __init__(self, slave):
        self.slave, self.get = slave, slave.get

    def put(self, values):
        self.slave.put(**values)

    def start(self, values):
        self.slave.start(**values)

    def step(self, time, size):
        self.slave.fmi.doStep(time, size)


@pytest.fixture(params=["exact", "native"])
def instance(request, drive, tmp_path):
    made = []

    def one(kind, support=True, **values):
        interface = dataclasses.replace(KINDS[kind], support_flange=support)
        if request.param == "exact":
            found = Exact(drive, interface)
        else:
            folder = tmp_path / str(len(made))
            folder.mkdir()
            made.append(Slave(native_of(folder, drive, drive.tables, interface), folder / "unpacked"))
            found = Native(made[-1])
        found.start({**STARTS, **values})
        return found

    yield one
    for slave in made:
        slave.fmi.freeInstance()


def motion(kind, i, ratio):
    """Inputs of a drive with a fixed housing: angles, speeds, torques."""
    t = 1e-3 * i
    crank, speed = 2.0 * math.sin(9.0 * t), 18.0 * math.cos(9.0 * t)
    off, rate = 4e-4 * math.sin(50.0 * t), 50.0 * 4e-4 * math.cos(50.0 * t)
    at_a, at_b = {"flange_a.phi": crank, "flange_a.w": speed}, {"flange_b.tau": 30.0 * math.sin(70.0 * t)}
    if kind == "compliant":
        at_b = {"flange_b.phi": crank / ratio + off, "flange_b.w": speed / ratio + rate}
    if kind == "rotor":
        at_b = {"flange_b.phi": 1e-4 * math.sin(50.0 * t), "flange_b.w": 5e-3 * math.cos(50.0 * t)}
        at_b |= {"arm_inertia": 0.5, "arm_torque": 30.0 * math.sin(70.0 * t)}
    return {**({"flange_a.tau": 0.5 * math.cos(40.0 * t)} if kind in ("joint", "rotor") else at_a), **at_b}


OUTPUTS = ("flange_a.tau", "flange_b.tau", "transmission_error", "torsional_stiffness", "power_loss")


@pytest.mark.parametrize("kind", KINDS)
def test_what_turns_along_with_the_housing_changes_nothing(instance, drive, kind):
    """Seen from a housing that turns evenly all is as in a fixed one; the three torques are in balance."""
    turning, ratio = 3.0, drive.pair.ratio
    start = {name: value for name, value in motion(kind, 0, ratio).items() if not name.endswith("tau")}
    begun = {"crank_speed_start": turning} if kind in ("joint", "rotor") else {}
    if kind != "joint":
        begun |= {n: v + turning * n.endswith(".w") for n, v in start.items()}
    still = instance(kind, support=False, **start)
    moved = instance(kind, **{"support.w": turning}, **begun)
    if kind == "inertia":
        assert moved.get("flange_b.w")[0] == pytest.approx(still.get("flange_b.w")[0] + turning)
    for i in range(40):
        given = motion(kind, i, ratio)
        still.put(given)
        angle = turning * 1e-3 * i
        shift = {".phi": angle, ".w": turning, ".tau": 0.0}
        moved.put({"support.phi": angle, "support.w": turning})
        moved.put({n: v + next((s for end, s in shift.items() if n.endswith(end)), 0.0) for n, v in given.items()})
        still.step(1e-3 * i, 1e-3)
        moved.step(1e-3 * i, 1e-3)
        a, b = still.get(*OUTPUTS), moved.get(*OUTPUTS)
        assert b == pytest.approx(a, rel=1e-6, abs=1e-6)
        outside = {"flange_b.phi": moved.get("support.phi")[0], "flange_b.w": turning}
        for name, value in outside.items():
            assert moved.get(name)[0] - value == pytest.approx(still.get(name)[0], rel=1e-6, abs=1e-8)
        if kind in ("kinematic", "compliant"):
            assert moved.get("support.tau")[0] == pytest.approx(-sum(b[:2]), rel=1e-9)


def test_a_crank_that_is_held_turns_the_output_the_other_way(instance, drive):
    """With the crank held and the housing turned the output goes by 1 - 1/i of that (Willis)."""
    found = instance("kinematic", friction_torque=0.0)
    places = []
    pitch = 2.0 * math.pi / drive.pair.pins
    for angle in (0.0, pitch, 4.0 * pitch):
        found.put({"support.phi": angle, "flange_a.phi": 0.7, "flange_b.tau": 50.0})
        found.step(0.0, 1e-3)
        places.append(found.get("flange_b.phi")[0])
    wanted = np.multiply((pitch, 4.0 * pitch), 1.0 - 1.0 / drive.pair.ratio)
    assert np.diff(places).cumsum() == pytest.approx(wanted, rel=1e-9)


def test_torques_on_all_three_flanges_are_what_the_inertias_gain(instance):
    """A housing that is thrown to and fro: angular momentum of crank and output, their angles absolute."""
    found, gained = instance("joint", friction_torque=5.0), 0.0
    for i in range(60):
        t = 1e-3 * i
        housing = 0.02 * (1.0 - math.cos(60.0 * t)), 1.2 * math.sin(60.0 * t)
        driving, load = 0.4 * math.cos(90.0 * t), -15.0 * math.sin(55.0 * t)
        before = found.get("flange_a.w", "flange_b.w")
        found.put({"support.phi": housing[0], "support.w": housing[1], "flange_a.tau": driving, "flange_b.tau": load})
        assert found.get("flange_a.w", "flange_b.w") == pytest.approx(before, rel=1e-9, abs=1e-12)
        found.step(t, 1e-3)
        after = found.get("flange_a.w", "flange_b.w")
        change = 1e-3 * (after[0] - before[0]) + 0.5 * (after[1] - before[1])
        brought = 1e-3 * (driving + load + found.get("support.tau")[0])
        assert change == pytest.approx(brought, rel=1e-6, abs=1e-9)
        gained += abs(change)
    assert gained > 1e-2


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_the_fmu_in_python_has_the_housing_s_flange(drive, tmp_path, version):
    path = tmp_path / "drive.fmu"
    build_fmu(drive, path, interface=dataclasses.replace(KINDS["compliant"], support_flange=True), fmi_version=version)
    variables, problems = described(path)
    assert problems == []
    assert {"support.phi", "support.w", "support.tau"} <= {v["name"] for v in variables}
    found = fmpy.simulate_fmu(
        str(path),
        stop_time=2e-3,
        step_size=1e-3,
        output=["flange_a.tau", "flange_b.tau", "support.tau"],
        start_values={"support.phi": 0.5, "flange_a.phi": 0.5, "flange_b.phi": 0.5 + 4e-4},
    )
    assert abs(found["flange_b.tau"][-1]) > 5.0
    assert found["support.tau"] == pytest.approx(-found["flange_a.tau"] - found["flange_b.tau"], rel=1e-12)
