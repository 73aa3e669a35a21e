"""RV reducers between two flanges: exact and native, energy, plays around the gears, inertias inside."""

import itertools
import math
from types import SimpleNamespace

import fmpy
import numpy as np
import pytest
from c_host import INTERFACES, Slave, coarse, native_of
from clockworks import compliant_drive, kinematic_drive
from common import EXAMPLES, PAIR

import cycloid_fmu as cy
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import simulate
from cycloid_fmu.fmu.variables import LOSSLESS, Interface
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.reducer import lost_motion as rv
from cycloid_fmu.reducer.description import read_reducer
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

ARCSEC = math.pi / 648000
PLAYFUL = FirstStage(12, 42, 2e-3, 4e-5)


@pytest.fixture(scope="module")
def reducers():
    """With play in the gears, and with gears that are pressed between the plays of sun and bearings."""
    whole = read_reducer(EXAMPLES / "rv-20e.toml")
    loose = nominal_surface(whole.stage).replace(pin_radius=-6e-6)
    pressed = parse_pair(PAIR + 'rated_torque = "180 N*m"\n[modification]\noffset = "3 um"\n', "pressed.toml")
    found = {}
    for name, drive in (
        ("play", DriveValue(whole.stage, loose, rv.parts_of(whole)[2])),
        ("pressed", DriveValue(pressed, surface_of_pair(pressed), PLAYFUL)),
    ):
        found[name] = SimpleNamespace(drive=drive, tables=coarse(drive.stage, 0.3 * ARCSEC))
    return found


@pytest.fixture
def native(tmp_path):
    made = []

    def one(reducer, interface):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        path = native_of(folder, reducer.drive, reducer.tables, interface)
        made.append(Slave(path, folder / "unpacked"))
        return made[-1]

    yield one
    for slave in made:
        slave.fmi.freeInstance()


def exact_of(reducer, interface=None):
    drive, interface = reducer.drive, interface or Interface("compliant")
    inertias = interface.output_inertia, interface.crank_inertia
    return compliant_drive(drive, interface.losses, *inertias)


class Exact:
    def __init__(self, model):
        self.model, self.ratio = model, model.ratio

    def at(self, sun, deviation):
        self.model.crank_angle, self.model.output_angle = sun, sun / self.ratio + deviation
        return [self.model.elastic_energy, self.model.crank_torque, self.model.torque]


class Table:
    def __init__(self, slave, ratio):
        self.slave, self.ratio = slave, ratio

    def at(self, sun, deviation):
        self.slave.put(flange_a_phi=sun, flange_b_phi=sun / self.ratio + deviation)
        return self.slave.get("elastic_energy", "flange_a.tau", "flange_b.tau")


@pytest.fixture(params=["exact", "native"])
def flanges(request, reducers, native):
    def one(name, **parameters):
        model = exact_of(reducers[name])
        if request.param == "exact":
            for key, value in parameters.items():
                setattr(model, key, value)
            return Exact(model)
        slave = native(reducers[name], Interface("compliant", mesh_damping=0.0))
        slave.start(**parameters)
        return Table(slave, model.ratio)

    return one


@pytest.mark.parametrize(
    ("name", "parameters"),
    [("play", {}), ("play", {"series_compliance": 5e-6}), ("play", {"backlash_on": False}), ("pressed", {})],
)
def test_both_torques_are_derivatives_of_the_stored_energy(flanges, name, parameters):
    drive, pressed = flanges(name, **parameters), 0
    for sun, deviation in ((3.0, 6e-4), (50.0, -7e-4), (77.0, 5e-4), (20.0, 2e-5), (21.0, -3e-5), (140.9, 8e-4)):
        h, k = 1e-5, 1e-8
        at_sun = [drive.at(sun + step, deviation - step / drive.ratio)[0] for step in (-h, h)]
        at_output = [drive.at(sun, deviation + step)[0] for step in (-k, k)]
        _, crank_torque, torque = drive.at(sun, deviation)
        assert crank_torque == pytest.approx((at_sun[1] - at_sun[0]) / (2 * h), rel=1e-4, abs=3e-4)
        assert torque == pytest.approx((at_output[1] - at_output[0]) / (2 * k), rel=1e-4, abs=1e-4)
        pressed += abs(torque) > 5.0
    assert pressed >= 3


@pytest.mark.parametrize("name", ["play", "pressed"])
def test_a_closed_path_through_all_plays_gives_nothing_back(flanges, name):
    drive = flanges(name)
    corners = [(3.0, 6e-4), (3.3, 5e-4), (3.4, -6e-4), (3.1, -4e-4), (3.0, 6e-4)]
    done = passed = 0.0
    for start, end in itertools.pairwise(corners):
        way, parts = np.subtract(end, start), 600
        found = np.array([drive.at(*np.add(start, way * i / parts))[1:] for i in range(parts + 1)])
        weights = np.ones(parts + 1)
        weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
        work = found * np.array([way[0], way[0] / drive.ratio + way[1]]) * weights[:, None] / (3.0 * parts)
        done, passed = done + work.sum(), passed + np.abs(work).sum()
    assert passed > 0.05
    assert abs(done) < 2e-4 * passed


@pytest.mark.parametrize("parameters", [{}, {"series_compliance": 5e-6}, {"backlash_on": False}])
def test_it_is_the_quasi_static_reducer_seen_from_both_flanges(reducers, parameters):
    """The energy's torques and the balance's differ by what moving curvature adds; a series compliance turns the
    crank, which it does not do there, by a hundredth of a mesh pitch."""
    drive = reducers["play"].drive
    model, driven = exact_of(reducers["play"]), kinematic_drive(drive)
    for name, value in parameters.items():
        setattr(model, name, value)
        setattr(driven, name, value)
    for sun, torque in ((3.0, 120.0), (50.0, -80.0), (77.0, 30.0)):
        driven.forget_history()
        driven.crank_angle, driven.torque = sun, torque
        driven.advance()
        model.crank_angle, model.output_angle = sun, driven.output_angle
        assert model.torque == pytest.approx(torque, rel=3e-3)
        assert model.crank_torque == pytest.approx(driven.crank_torque, rel=3e-3)
        assert model.torsional_stiffness == pytest.approx(driven.torsional_stiffness, rel=1e-3)
        assert model.backlash == pytest.approx(driven.backlash, rel=1e-3, abs=1e-12)


@pytest.mark.parametrize(("name", "swing"), [("play", 1.6e-4), ("pressed", 5e-5)])
def test_native_follows_the_exact_model(reducers, native, name, swing):
    model, slave = exact_of(reducers[name]), native(reducers[name], Interface("compliant", mesh_damping=0.0))
    slave.start(mesh_damping=30.0, friction_torque=1.0)
    model.mesh_damping, model.friction_torque = 30.0, 1.0
    model.forget_history()
    model.advance()
    names = ("flange_a.tau", "flange_b.tau", "elastic_energy", "backlash", "torsional_stiffness")
    found = []
    for i in range(120):
        t = 1e-3 * i
        sun, speed = 2.0 * math.sin(6 * t), 12.0 * math.cos(6 * t)
        off, rate = swing * math.sin(40 * t), 40 * swing * math.cos(40 * t)
        output, output_speed = sun / model.ratio + off, speed / model.ratio + rate
        slave.put(flange_a_phi=sun, flange_a_w=speed, flange_b_phi=output, flange_b_w=output_speed)
        slave.fmi.doStep(t, 1e-3)
        model.crank_angle, model.crank_speed, model.output_angle, model.output_speed = sun, speed, output, output_speed
        model.advance(1e-3)
        exact = [model.crank_torque, model.torque, model.elastic_energy, model.backlash, model.torsional_stiffness]
        found.append((slave.get(*names), exact))
    interpolated, exact = np.moveaxis(np.array(found), 1, 0)
    for energy in (interpolated[:, 2], exact[:, 2]):
        energy -= energy[0]  # tables of pressed gears have no zero of energy
    assert (np.abs(interpolated - exact)[:, :4].max(axis=0) <= 0.02 * np.abs(exact).max(axis=0)[:4]).all()
    assert np.median(np.abs(interpolated - exact)[:, 4]) <= 0.02 * np.abs(exact[:, 4]).max()


@pytest.mark.parametrize("kind", ["exact", "native"])
def test_with_inertias_inside_work_is_stored_lost_or_given_back(reducers, native, kind):
    interface = Interface("compliant", 0.5, LOSSLESS, crank_inertia=2e-5, mesh_damping=20.0)
    names = ("flange_a.phi", "flange_a.w", "flange_b.phi", "flange_b.w", "elastic_energy", "dissipated_energy")
    if kind == "exact":
        model = exact_of(reducers["play"], interface)
        model.mesh_damping, model.torque = 20.0, -20.0
        model.forget_history()
        model.advance()
    else:
        slave = native(reducers["play"], interface)
        slave.start(**{"flange_b.tau": -20.0})

    def values():
        if kind == "native":
            return slave.get(*names)
        return [
            model.crank_angle,
            model.crank_speed,
            model.output_angle,
            model.output_speed,
            model.elastic_energy,
            model.dissipated_energy,
        ]

    before, passed, done = values(), 0.0, 0.0
    begun = before[4]
    for i in range(60):
        driving, load = 0.3 * math.cos(0.35 * i), -20.0 * math.cos(0.13 * i)
        if kind == "native":
            slave.put(**{"flange_a.tau": driving, "flange_b.tau": load})
            slave.fmi.doStep(1e-3 * i, 1e-3)
        else:
            model.crank_torque, model.torque = driving, load
            model.advance(1e-3)
        now = values()
        work = driving * (now[0] - before[0]), load * (now[2] - before[2])
        done, passed, before = done + sum(work), passed + sum(map(abs, work)), now
    moving = 0.5 * (2e-5 * now[1] ** 2 + 0.5 * now[3] ** 2)
    assert passed > 0.05
    assert abs(done - moving - (now[4] - begun) - now[5]) < 1e-4 * passed


def test_at_constant_speed_the_sun_bears_the_load_over_the_ratio(reducers, native):
    slave = native(reducers["play"], Interface("compliant", 0.5, mesh_damping=500.0))
    slave.start(**{"flange_a.w": 200.0, "flange_b.tau": -60.0, "series_compliance": 5e-6})
    torque, ratio = [], exact_of(reducers["play"]).ratio
    for i in range(400):
        slave.fmi.doStep(1e-3 * i, 1e-3)
        torque += slave.get("flange_a.tau") if i >= 100 else []
    assert np.mean(torque) == pytest.approx(60.0 / ratio, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("play", "inertia"), ("pressed", "compliant"), pytest.param("pressed", "inertia", marks=pytest.mark.slow)],
)
def test_nonsense_and_rollback(reducers, host, tmp_path, name, kind):
    reducer = reducers[name]
    path = native_of(tmp_path, reducer.drive, reducer.tables, INTERFACES[kind])
    folder = tmp_path / "unpacked"
    fmpy.extract(str(path), unzipdir=str(folder))
    fmu = SimpleNamespace(
        version="2.0",
        kind=kind,
        uri=(folder / "resources").as_uri(),
        guid=fmpy.read_model_description(str(path)).guid,
        library=folder / "binaries" / "linux64" / "CycloidDrive.so",
    )
    assert "3000 steps" in host(fmu, "random", 3000)
    if kind == "inertia":  # between two flanges the host moves those of a drive without a first stage
        assert "50 states restored" in host(fmu, "rollback", 50)


@pytest.mark.slow(90)
def test_on_bearings_behind_its_first_stage_the_tables_run_up_as_the_exact_model(tmp_path):
    """Both FMUs from standstill to 6000 rpm of the sun, while the load grows from a tenth of the rated torque to all.

    The transmission error of the output is that of the tables' own accuracy, as wheels add nothing to it; the torque at
    the sun is within a thousandth of the rated load's, a tenth of what matters for an efficiency.
    """
    drive = cy.read_drive(EXAMPLES / "rv-20e-bearings.toml")
    made, interface = coarse(drive.stage, 0.3 * ARCSEC), Interface("kinematic")
    build_fmu(drive, tmp_path / "exact.fmu", interface=interface)
    native_of(tmp_path, drive, made, interface)
    rated, speed, time = drive.pair.rated_torque, 200.0 * math.pi, np.linspace(0.0, 0.2, 121)
    inputs = {
        "flange_a.phi": 0.5 * speed / 0.2 * time**2,
        "flange_a.w": speed / 0.2 * time,
        "flange_b.tau": -rated * (0.1 + 0.9 * time / 0.2),
    }
    names = ("transmission_error", "flange_a.tau", "torsional_stiffness")
    exact, tabled = (simulate(tmp_path / name, inputs, names, time) for name in ("exact.fmu", "drive.fmu"))
    off = {name: np.abs(exact[name] - tabled[name]).max() for name in names}
    assert np.ptp(exact["transmission_error"]) > 20.0 * ARCSEC
    assert off["transmission_error"] <= made.largest_error
    assert off["flange_a.tau"] <= 1e-3 * rated / abs(drive.ratio)
    assert off["torsional_stiffness"] <= 0.02 * exact["torsional_stiffness"].max()
