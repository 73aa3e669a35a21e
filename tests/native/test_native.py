"""The native FMU: against the model in Python, in hosts that share no code, and with invalid input of hosts."""

import ctypes
import math
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import fmpy
import numpy as np
import pytest
from c_host import BUILT, COMPILER, HERE, INTERFACES, WINE, Slave, coarse, compiled, native_of, needs, needs_wine
from clockworks import compliant_drive, kinematic_drive
from common import ARCSEC, EXAMPLES, PAIR, make_pair, study_size
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from hypothesis import given, settings
from hypothesis import strategies as st
from libraries import windows_runtime, zig

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import constants, table_cache, tables
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.fmu.library import SOURCE_FOLDERS, SOURCES, library_path, this_platform
from cycloid_fmu.fmu.resource_file import DRIVE, HEAD, headed, sealed
from cycloid_fmu.fmu.run import open_fmu
from cycloid_fmu.fmu.table_file import constants_header, table_body
from cycloid_fmu.fmu.table_nodes import midway
from cycloid_fmu.fmu.variables import Interface, from_tables, variables
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.reducer import lost_motion as rv
from cycloid_fmu.reducer.description import read_reducer
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

ARM = Path("/usr/aarch64-linux-gnu")  # Debian's libc6-arm64-cross
MOTION = {
    "kinematic": 3,
    "compliant": 4,
    "inertia": 3,
    "rotor": 8,
}  # inputs, printed first, after the time
STEPS = study_size("CYCLOID_STEPS", 1e4, 1e6)
COLUMNS = (
    "time",
    "flange_a.phi",
    "flange_a.w",
    "flange_b.tau",
    "flange_b.phi",
    "flange_b.w",
    "flange_a.tau",
    "transmission_error",
    "backlash",
    "torsional_stiffness",
    "max_contact_pressure",
)


# Every interface in FMI 2.0; FMI 3.0, from the same source, with the two that take different inputs.
EACH = [(kind, "2.0") for kind in INTERFACES] + [("kinematic", "3.0"), ("compliant", "3.0")]


def rows_of(text):
    return np.array([[float(cell) for cell in line.split(",")] for line in text.splitlines()])


@pytest.fixture
def slave(built, tmp_path):
    made = []

    def one(kind="kinematic", path=None):
        made.append(Slave(path or built(kind), tmp_path / str(len(made))))
        return made[-1]

    yield one
    for each in made:
        if each.fmi.component:
            each.fmi.freeInstance()


# --- tables ---


def against_the_exact_model(native, pair, surface, made, probes):
    """Largest error of the transmission error (rad), and `tables.Errors` of the library's results.

    At random crank angles and torques: evenly, and evenly in the logarithm. The crank turns at 1 rad/s.
    """
    random, largest = np.random.default_rng(7), made.positive.load[-1]
    size = np.where(random.random(probes) < 0.5, random.uniform(0.0, 1.0, probes), 10 ** random.uniform(-4, 0, probes))
    torque = largest * size * random.choice([-1.0, 1.0], probes)
    angle = np.sort(random.uniform(0.0, made.period, probes))
    model, found = kinematic_drive(DriveValue(pair, surface)), np.empty((2, 5, probes))
    model.crank_speed = 1.0
    for i in range(probes):
        model.crank_angle, model.torque = angle[i], torque[i]
        model.advance()
        found[0, :, i] = (
            model.transmission_error,
            model.torsional_stiffness,
            model.output_speed - 1.0 / pair.ratio,
            model.crank_torque,
            model.max_contact_pressure,
        )
        native.put(flange_a_phi=angle[i], flange_b_tau=torque[i])
        native.fmi.doStep(0.0, 1e-3)
        found[1, :, i] = native.get(
            "transmission_error", "torsional_stiffness", "flange_b.w", "flange_a.tau", "max_contact_pressure"
        )
    found[1, 2] -= 1.0 / pair.ratio
    exact, interpolated = (tables.States(*channels) for channels in found)
    off = np.abs(interpolated.transmission_error - exact.transmission_error).max()
    return off, tables.errors_of(made, interpolated, exact, torque)


def within(found, told):
    """Compare errors with those stated, as far as random draws agree about quantiles, mean squares and extremes."""
    assert found.stiffness[0] < 1.5 * told.stiffness[0]
    assert found.pressure[0] < 1.5 * told.pressure[0]
    assert found.speed < 1.2 * told.speed
    assert found.crank_torque[0] < 1.1 * told.crank_torque[0]
    for name in ("stiffness", "pressure", "crank_torque"):
        assert getattr(found, name)[1] < 2.0 * getattr(told, name)[1]


@pytest.fixture(scope="module")
def without_losses(drive, tmp_path_factory):
    return native_of(tmp_path_factory.mktemp("lossless"), drive, drive.tables, Interface())


def test_tables_keep_their_accuracy_at_crank_angles_and_torques_they_were_not_made_at(
    drive, slave, without_losses, record_property
):
    native = slave(path=without_losses)
    native.start(flange_a_w=1.0)
    error, errors = against_the_exact_model(native, drive.pair, drive.surface, drive.tables, 3000)
    record_property("native TE, largest error", f"{error / ARCSEC:.4f}″")
    assert error < 0.02 * ARCSEC
    assert error <= 1.05 * drive.tables.largest_error
    within(errors, drive.tables.errors)
    assert drive.tables.errors.stiffness[0] < tables.STIFFNESS_SHARE
    assert errors.pressure[0] < 0.005
    assert errors.pressure[1] < 0.05
    assert drive.tables.errors.speed < tables.SPEED_SHARE
    assert errors.crank_torque[1] < 0.005


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    st.integers(0, 2),
    st.integers(0, 63).map(lambda part: part / 64),
    st.floats(-1.0, 1.0),
)
def test_only_where_a_pin_begins_to_carry_is_interpolation_between_crank_angles_in_doubt(cubic, order, share, jump):
    """A cubic with a jump of value, slope or curvature: exact but in the jump's own interval, where doubt is told."""
    at = np.arange(48) / 2.0
    begin = 10.0 + share
    curve = np.polynomial.polynomial.polyval(at / 10.0, cubic) + jump * (at > begin) * np.abs(at - begin) ** order
    found, off = midway(curve[::2])
    wrong = np.abs(found - curve[1::2])
    here, others = 10, np.r_[5:10, 11:18]  # the ends of the curve are not a period's
    assert wrong[others].max() < 1e-12
    assert off[others].max() < 1e-12
    assert wrong[here] <= 0.4 * off[here] + 1e-12


@pytest.mark.slow(3)
def test_progress_adds_up_to_what_was_said_before_each_step():
    pair = read_pair(EXAMPLES / "drive-39-40.toml")
    steps: list[list[int]] = []
    tables.compute(
        DriveValue.as_stated(pair),
        total=lambda count: steps.append([count, 0]),
        workers=2,
        progress=lambda count: steps[-1].__setitem__(1, steps[-1][1] + count),
    )
    assert len(steps) > 3
    assert all(count == done > 0 for count, done in steps)


def test_what_the_tables_say_they_err_is_what_the_library_errs(drive, slave, without_losses):
    """Python's interpolation, by which tables are refined, and C's give the same."""
    native, random = slave(path=without_losses), np.random.default_rng(5)
    native.start(flange_a_w=1.0)
    angle, torque = random.uniform(-50.0, 50.0, 400), random.uniform(0.01, 450.0, 400) * random.choice([-1, 1], 400)
    found = []
    for one, load in zip(angle, torque, strict=True):
        native.put(flange_a_phi=one, flange_b_tau=load)
        native.fmi.doStep(0.0, 1e-3)
        found.append(
            native.get(
                "transmission_error", "torsional_stiffness", "flange_b.w", "flange_a.tau", "max_contact_pressure"
            )
        )
    expected = tables.interpolated(drive.tables, angle, torque)
    expected.rate[:] += 1.0 / drive.pair.ratio
    np.testing.assert_allclose(expected.transmission_error, np.array(found)[:, 0], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(np.array(expected)[1:].T, np.array(found)[:, 1:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_fmu_whose_table_is_damaged_says_so_when_it_is_opened(built, tmp_path, version):
    damaged = tmp_path / "damaged.fmu"
    with zipfile.ZipFile(built("kinematic", version)) as whole, zipfile.ZipFile(damaged, "w") as archive:
        for name in whole.namelist():
            data = bytearray(whole.read(name))
            if name.endswith(DRIVE.file):
                data[len(data) // 2] ^= 1
            archive.writestr(name, bytes(data))
    with pytest.raises(edge.InputError, match=r"can't be instantiated: .* the table is damaged"), open_fmu(damaged):
        pass


@pytest.mark.slow(10)
def test_tables_of_a_drive_with_all_errors_keep_their_accuracy_over_the_whole_period(slave, tmp_path, record_property):
    pair = read_pair(EXAMPLES / "drive-39-40-as-made.toml")
    surface = surface_of_pair(pair)
    made = tables.compute(DriveValue(pair, surface), workers=2)
    path = native_of(tmp_path, DriveValue(pair, surface), made, Interface())
    native = slave(path=path)
    native.start(flange_a_w=1.0)
    largest, errors = against_the_exact_model(native, pair, surface, made, 20000)
    torques = np.array([-1.0, 1.0]) * 181.0
    error = solve(DriveValue(pair, surface), torques, np.linspace(0.0, made.period, 20000)).transmission_error
    with zipfile.ZipFile(path) as archive:
        size = archive.getinfo(f"resources/{DRIVE.file}").compress_size
    record_property("native TE with all errors, largest error", f"{largest / ARCSEC:.4f}″")
    record_property("its tables in the FMU", f"{size / 1e6:.2f} MB")
    allowed = max(0.02 * ARCSEC, 1e-3 * np.ptp(error, axis=1).max())
    assert largest < allowed
    assert made.largest_error <= allowed
    # The FMU's stated accuracy is valid at other places too, which find other extremes.
    assert largest <= 1.05 * made.largest_error
    within(errors, made.errors)
    assert errors.pressure[0] < 0.01
    assert size < 9e6  # and five libraries of some 0.1 MB


@pytest.mark.parametrize(
    ("keys", "errors", "pitches"),
    [
        ({}, {}, 1),
        ({}, {"pin_radial": True}, 40),
        ({}, {"tooth_cumulative_pitch": True}, 39),
        ({"output": "ring"}, {"pin_radial": True}, 40),
        ({"output": "ring"}, {"centre_distance_x": 3e-6}, 39),
        ({"discs": 2}, {"centre_distance_x": 3e-6}, 40),
        ({"discs": 2}, {"pin_radial": True, "tooth_cumulative_pitch": True}, 1560),
    ],
)
def test_transmission_error_repeats_after_the_tables_period(keys, errors, pitches):
    pair = make_pair(**keys).replace(modification=read_pair(EXAMPLES / "drive-39-40.toml").modification)
    surface = nominal_surface(pair)
    random = np.random.default_rng(2)
    changes = {
        name: 2e-6 * random.normal(size=getattr(surface, name).shape) if value is True else value
        for name, value in errors.items()
    }
    surface = surface.replace(**changes)
    assert tables.mesh_pitches(DriveValue(pair, surface)) == pitches
    period = pitches * 2.0 * np.pi / (39 if pair.output == "ring" else 40)
    angles = random.uniform(0.0, 50.0, 12)
    first, second = (
        solve(DriveValue(pair, surface), [150.0, -40.0], a).transmission_error for a in (angles, angles + period)
    )
    np.testing.assert_allclose(first, second, atol=1e-11)


def test_torques_of_the_tables_are_derivatives_of_one_function(drive, slave, without_losses):
    """∂x/∂θ at constant torque is -∂(τ_a + T/ratio)/∂T, whatever the tables err: G has one mixed derivative."""
    native, random = slave(path=without_losses), np.random.default_rng(4)
    native.start(flange_a_w=1.0)
    theta, torque = random.uniform(0, 10, 500), random.uniform(5, 400, 500) * random.choice([-1, 1], 500)
    step = 1e-3

    def at(angle, load):
        native.put(flange_a_phi=angle, flange_b_tau=load)
        native.fmi.doStep(0.0, 1e-3)
        return native.get("flange_a.tau", "flange_b.w")

    for angle, load in zip(theta, torque, strict=True):
        (above, _), (below, _), (_, rate) = (at(angle, load + d) for d in (step, -step, 0.0))
        assert (above - below) / (2 * step) == pytest.approx(-rate, abs=3e-9)


# --- against the model in Python ---


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"friction_torque": 8.0, "series_compliance": 1e-6},
        {"backlash_on": False, "friction_torque": 3.0},
    ],
)
def test_kinematic_follows_the_exact_model_through_reversals_and_zero_torque(drive, slave, parameters):
    native, model = slave(), kinematic_drive(drive.stage, INTERFACES["kinematic"].losses)
    begun(native, model, parameters)
    exact, interpolated = moved(native, model, steps=400, swing=2.0)
    off = np.abs(interpolated - exact)
    assert off[:, :2].max() < 0.02 * ARCSEC
    assert off[:, 2].max() < 0.04 * ARCSEC  # two ends
    scale = np.sqrt(np.mean(exact**2, axis=0))
    # Inside the play a rounding decides whether a flank pushes: then the speed is the other one.
    assert (np.sqrt(np.mean(off[:, 3:] ** 2, axis=0)) <= [0.003, 0.02, 0.02, 0.005, 0.05] * scale[3:] + 1e-12).all()


def begun(native, model, parameters):
    """Start both alike."""
    for name, value in parameters.items():
        setattr(model, name, value)
    model.forget_history()
    model.advance()
    native.start(**parameters)


def moved(native, model, steps, swing):
    """A random motion around a swing of the crank (rad), the torque's direction changing, a quarter without any."""
    random = np.random.default_rng(3)
    angle = np.cumsum(random.normal(0.0, 0.025 * swing, steps)) + swing * np.sin(np.arange(steps) / 40)
    torque = 150.0 * np.sin(np.arange(steps) / 23) * (random.random(steps) < 0.8)
    torque[steps // 4 : steps // 2] = 0.0
    return np.moveaxis(np.array([stepped(native, model, i, angle[i], torque[i]) for i in range(steps)]), 1, 0)


def stepped(native, model, i, angle, torque):
    """A step of the kinematic interface: the outputs of both, SI."""
    model.crank_angle, model.crank_speed, model.torque = angle, math.cos(i), torque
    model.advance()
    exact = [
        model.output_angle,
        model.transmission_error,
        model.backlash,
        model.crank_torque,
        model.output_speed,
        model.power_loss,
        model.max_contact_pressure,
        model.torsional_stiffness,
    ]
    native.put(flange_a_phi=angle, flange_a_w=math.cos(i), flange_b_tau=torque)
    native.fmi.doStep(1e-3 * i, 1e-3)
    return exact, native.get(
        "flange_b.phi",
        "transmission_error",
        "backlash",
        "flange_a.tau",
        "flange_b.w",
        "power_loss",
        "max_contact_pressure",
        "torsional_stiffness",
    )


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A native FMU of teeth that press the crank at zero torque, from coarse tables, which are soon made."""
    pair = parse_pair(PAIR + 'rated_torque = "180 N*m"\n[modification]\noffset = "3 um"\n', "pressed.toml")
    return built_coarse(tmp_path_factory.mktemp("pressed"), DriveValue.as_stated(pair))


@pytest.fixture(scope="module")
def reducer(tmp_path_factory):
    """Likewise of an RV reducer: the sun turns the crank through planets with play, the carrier plays in bearings."""
    whole = read_reducer(EXAMPLES / "rv-20e.toml")
    folder = tmp_path_factory.mktemp("reducer")
    return built_coarse(folder, DriveValue(whole.stage, nominal_surface(whole.stage), rv.parts_of(whole)[2]))


def built_coarse(folder, drive):
    made = coarse(drive.stage, 0.3 * ARCSEC)
    return SimpleNamespace(path=native_of(folder, drive, made, INTERFACES["kinematic"]), tables=made, drive=drive)


@pytest.mark.parametrize(
    "parameters", [{}, {"friction_torque": 8.0}, {"backlash_on": False, "series_compliance": 1e-6}]
)
def test_with_interference_the_exact_model_is_followed(slave, pressed, parameters):
    assert np.abs(pressed.tables.rest_torque).max() > 0.0
    native, model = slave(path=pressed.path), kinematic_drive(pressed.drive, INTERFACES["kinematic"].losses)
    begun(native, model, parameters)
    # Beside the places where the crank feels nothing: there a rounding decides which way power flows.
    found = [stepped(native, model, i, 0.003 + 0.01 * i, 100.0 * math.sin(0.1 * i) * (i % 7 > 1)) for i in range(200)]
    exact, interpolated = np.moveaxis(np.array(found), 1, 0)
    off = np.abs(interpolated - exact)
    assert off[:, 1].max() <= pressed.tables.allowed
    assert off[:, 3].max() <= 0.01 * np.abs(exact[:, 3]).max()
    assert (interpolated[:, 2] == 0.0).all()


@pytest.mark.parametrize(
    "parameters",
    [{}, {"friction_torque": 2.0, "series_compliance": 1e-6}, {"friction_torque": 3.0, "backlash_on": False}],
)
def test_a_reducer_follows_its_exact_model(slave, reducer, parameters):
    native, model = slave(path=reducer.path), kinematic_drive(reducer.drive, INTERFACES["kinematic"].losses)
    begun(native, model, parameters)
    exact, interpolated = moved(native, model, steps=200, swing=20.0)
    off, allowed = np.abs(interpolated - exact), reducer.tables.allowed
    assert off[:, 1].max() <= allowed
    assert off[:, 2].max() <= 2.0 * allowed
    assert np.ptp(exact[:, 1]) > 5.0 * allowed


@pytest.mark.parametrize("parameters", [{}, {"friction_torque": 8.0, "mesh_damping": 50.0, "series_compliance": 1e-6}])
def test_compliant_follows_the_exact_model(drive, slave, parameters):
    native, model = slave("compliant"), compliant_drive(drive.stage)
    begun(native, model, parameters)
    found, ratio = [], drive.pair.ratio
    for i in range(200):
        t = 1e-3 * i
        crank, speed = 0.5 * math.sin(6 * t), 3.0 * math.cos(6 * t)
        off, rate = 2.4e-4 * math.sin(40 * t), 40 * 2.4e-4 * math.cos(40 * t)
        native.put(
            flange_a_phi=crank, flange_a_w=speed, flange_b_phi=crank / ratio + off, flange_b_w=speed / ratio + rate
        )
        native.fmi.doStep(t, 1e-3)
        model.crank_angle, model.crank_speed = crank, speed
        model.output_angle, model.output_speed = crank / ratio + off, speed / ratio + rate
        model.advance(1e-3)
        found.append(
            (
                native.get("flange_a.tau", "flange_b.tau", "elastic_energy", "dissipated_energy"),
                [model.crank_torque, model.torque, model.elastic_energy, model.dissipated_energy],
            )
        )
    interpolated, exact = np.moveaxis(np.array(found), 1, 0)
    assert (np.abs(interpolated - exact).max(axis=0) <= 0.01 * np.abs(exact).max(axis=0)).all()


def test_an_output_inertia_follows_the_exact_model_under_a_load_that_turns_round(drive, slave):
    parameters = {"friction_torque": 8.0, "mesh_damping": 50.0, "series_compliance": 1e-6}
    native, inertia = slave("inertia"), INTERFACES["inertia"].output_inertia
    model = compliant_drive(drive.stage, output_inertia=inertia)
    model.torque = 100.0
    native.put(flange_b_tau=100.0)
    begun(native, model, parameters)
    found = []
    for i in range(200):
        t = 1e-3 * i
        speed, load = 4.0 * math.cos(15 * t), 100.0 * math.cos(12 * t)
        native.put(flange_a_w=speed, flange_b_tau=load)
        native.fmi.doStep(t, 1e-3)
        model.crank_speed, model.torque = speed, load
        model.advance(1e-3)
        found.append(
            (
                native.get("flange_b.phi", "flange_b.w", "flange_a.tau", "elastic_energy", "dissipated_energy"),
                [
                    model.output_angle,
                    model.output_speed,
                    model.crank_torque,
                    model.elastic_energy,
                    model.dissipated_energy,
                ],
            )
        )
    interpolated, exact = np.moveaxis(np.array(found), 1, 0)
    assert (np.abs(interpolated - exact) <= 0.002 * np.abs(exact).max(axis=0)).all()
    assert interpolated[-1, 2] * interpolated[0, 2] < 0.0


@pytest.mark.parametrize(("least", "most"), [(1.9e-4, 2.6e-4), (8e-4, 2e-3)])
def test_compliant_torques_are_the_derivatives_of_its_energy(slave, drive, least, most):
    """Beyond the tables too."""
    native, ratio = slave("compliant"), drive.pair.ratio
    native.start()
    random = np.random.default_rng(6)

    def energy(crank, output):
        native.put(flange_a_phi=crank, flange_b_phi=output)
        return native.get("elastic_energy")[0]

    for _ in range(100):
        crank, off = random.uniform(-9, 9), random.choice([-1, 1]) * random.uniform(least, most)
        output, step = crank / ratio + off, 1e-8
        by_output = (energy(crank, output + step) - energy(crank, output - step)) / (2 * step)
        by_crank = (energy(crank + step * 30, output) - energy(crank - step * 30, output)) / (60 * step)
        energy(crank, output)
        at_crank, at_output = native.get("flange_a.tau", "flange_b.tau")
        assert at_output == pytest.approx(by_output, abs=1e-3, rel=1e-5)
        assert at_crank == pytest.approx(by_crank, abs=1e-4, rel=1e-4)


def test_output_inertia_swings_without_gaining_energy(slave):
    native = slave("inertia")
    native.start(flange_b_tau=80.0)
    native.put(flange_b_tau=0.0)
    total = []
    for i in range(400):
        native.fmi.doStep(1e-3 * i, 1e-3)
        energy, speed, lost = native.get("elastic_energy", "flange_b.w", "dissipated_energy")
        total.append(energy + 0.25 * speed**2 + lost)
    assert np.ptp(total) < 1e-6 * max(total)  # the solution of a sub-step ends at 1e-10 of its way


# --- hosts that share no code ---


def by_fmuloader(path, motion):
    from fmuloader.fmi3 import Fmi3Slave

    description = fmpy.read_model_description(str(path))
    host = Fmi3Slave(str(path), model_identifier=description.coSimulation.modelIdentifier)
    host.instantiate_co_simulation("drive", instantiation_token=description.instantiationToken)
    host.enter_initialization_mode(start_time=0.0)
    host.exit_initialization_mode()
    found = []
    for i, inputs in enumerate(motion):
        host.set_float64([0, 1, 2], inputs)
        host.do_step(1e-3 * i, 1e-3)
        found.append(host.get_float64([3, 4, 5, 6, 7, 8, 9]))
    host.terminate()
    host.free_instance()
    return found


def by_libcosimpy(path, motion):
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=1_000_000)
    index = execution.add_local_slave(CosimLocalSlave(fmu_path=str(path), instance_name="drive"))
    given, seen = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(manipulator=given)
    execution.add_observer(observer=seen)
    found = []
    for inputs in motion:
        given.slave_real_values(index, [0, 1, 2], list(inputs))
        execution.step()
        found.append(seen.last_real_values(index, [3, 4, 5, 6, 7, 8, 9]))
    return found


def by_fmpy(path, motion):
    samples = np.array(
        [(1e-3 * i, *inputs) for i, inputs in enumerate(motion)],
        dtype=[("time", float), *((name, float) for name in COLUMNS[1:4])],
    )
    result = fmpy.simulate_fmu(
        str(path),
        input=samples,
        output=COLUMNS[4:],
        step_size=1e-3,
        output_interval=1e-3,
        stop_time=1e-3 * len(motion),
        use_event_mode=False,
    )
    return [[row[name] for name in COLUMNS[4:]] for row in result[1:]]


@pytest.mark.parametrize(
    ("importer", "version"),
    [(by_fmpy, "2.0"), (by_fmpy, "3.0"), (by_fmuloader, "3.0"), (by_libcosimpy, "2.0")],
)
def test_importers_see_the_same_trajectory(built, unpacked, host, importer, version):
    rows = rows_of(host(unpacked(), "run", 800))
    found = np.array(importer(built(version=version), rows[:, 1:4].tolist()))
    assert (np.abs(found - rows[:, 4:]) <= 1e-12 * np.abs(rows[:, 4:]).max(axis=0)).all()


@pytest.fixture(scope="module")
def reference():
    """The results that lie in the repository, in the form of the FMI Cross-Check."""
    with (HERE / "kinematic_ref.csv").open(encoding="utf-8") as file:
        assert file.readline().strip() == ",".join(f'"{name}"' for name in COLUMNS)
        return dict(zip(COLUMNS, rows_of(file.read()).T, strict=True))


def test_reference_results_are_met(unpacked, host, reference):
    found = rows_of(host(unpacked(), "run", 800))
    for place, name in ((4, "flange_b.phi"), (7, "transmission_error")):
        assert np.abs(found[:, place] - reference[name]).max() < 0.04 * ARCSEC


def test_reference_results_are_the_exact_analysis(drive, reference):
    """Loaded, each row is the contact's solution at its angle and torque, whose steps never were in a table.

    At zero torque the output is between the ends of the play, and remains where it was or on the end that passed it.
    """
    angle, torque, error = (reference[n] for n in ("flange_a.phi", "flange_b.tau", "transmission_error"))
    output = reference["flange_b.phi"]
    np.testing.assert_allclose(output, angle / drive.pair.ratio + error, rtol=0.0, atol=1e-12)
    within = 0.02 * ARCSEC
    for i, (place, load) in enumerate(zip(angle, torque, strict=True)):
        exact = solve(drive.stage, load, place)
        low, high = float(exact.play_low[0]), float(exact.play_high[0])
        assert reference["backlash"][i] == pytest.approx(high - low, abs=2.0 * within)
        if load != 0.0:
            assert error[i] == pytest.approx(float(exact.transmission_error[0, 0]), abs=within)
            pressure = float(exact.max_contact_pressure[0, 0])
            assert reference["max_contact_pressure"][i] == pytest.approx(pressure, rel=0.02)
        else:
            assert low - within <= error[i] <= high + within
            still = abs(output[i] - output[i - 1]) < 1e-12
            assert still or min(abs(error[i] - low), abs(error[i] - high)) < within or i == 0
    assert torque.min() < 0.0 < torque.max()


@pytest.mark.parametrize(("error", "share"), [("centre distance", 0.04), ("wave", 0.18), ("each pin", 0.6)])
def test_errors_to_first_order_would_be_too_coarse_for_parameters_of_native_fmus(drive, error, share):
    pins = drive.pair.pins
    shape = {
        "wave": np.cos(6.0 * np.pi * np.arange(pins) / pins),
        "each pin": np.random.default_rng(1).normal(size=pins),
    }
    angle = np.linspace(0.0, 2.0 * np.pi, 499)

    def deviation(size):
        changed = {"centre_distance_x": size} if error == "centre distance" else {"pin_radial": size * shape[error]}
        return solve(DriveValue(drive.pair, drive.surface.replace(**changed)), [181.0], angle).transmission_error[0]

    tiny, change = 1e-10, deviation(3e-6) - deviation(0.0)
    off = change - 3e-6 * (deviation(tiny) - deviation(-tiny)) / (2.0 * tiny)
    assert np.sqrt(np.mean(off**2) / np.mean(change**2)) == pytest.approx(share, rel=0.25)


# --- tables that are kept ---


@pytest.fixture
def computed(drive, tmp_path, monkeypatch):
    """Folder of kept tables, and drives whose tables were computed."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []
    monkeypatch.setattr(tables, "compute", lambda pair, *_, **asked: made.append(asked["largest_load"]) or drive.tables)
    return SimpleNamespace(folder=tmp_path / "cycloid-fmu" / "tables", made=made)


def test_tables_of_a_drive_are_computed_once_for_all_its_fmus(drive, computed, tmp_path):
    read = set()
    for interface in (Interface(), Interface("compliant", mesh_damping=0.0)):
        for version in ("2.0", "3.0"):
            path = tmp_path / f"{interface.kind}{version}.fmu"
            native_build.build_native(drive, path, interface=interface, fmi_version=version, platforms=[])
            again = tmp_path / "again.fmu"
            made = native_build.build_native(drive, again, interface=interface, fmi_version=version)
            assert path.read_bytes() == again.read_bytes()
            read.add(made.accuracy)
    assert read == {drive.tables.accuracy}
    assert computed.made == [None]
    native_build.build_native(drive, tmp_path / "d.fmu", largest_torque=300.0)
    native_build.build_native(DriveValue.as_stated(drive.pair.replace(pin_radius="3.001 mm")), tmp_path / "d.fmu")
    assert computed.made == [None, 300.0, None]


def test_tables_that_were_kept_and_are_damaged_are_made_anew(drive, computed):
    table_cache.tables_of(drive.stage)
    (kept,) = computed.folder.glob("*.tables")
    whole = kept.read_bytes()
    for number, place in enumerate(np.random.default_rng(2).integers(len(whole), size=10)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (number % 8)
        kept.write_bytes(damaged if number else whole[:place])
        table_cache.tables_of(drive.stage)
        assert len(computed.made) == number + 2
        assert kept.read_bytes() == whole


def test_kept_tables_do_not_grow_without_bound(drive, computed, monkeypatch):
    """The one that was used longest ago goes first."""
    table_cache.tables_of(drive.stage)
    size = next(computed.folder.glob("*.tables")).stat().st_size
    monkeypatch.setattr(table_cache, "_MOST_BYTES", int(3.5 * size))
    for reach in (300.0, 310.0, None, 320.0, 330.0, None):
        table_cache.tables_of(drive.stage, largest_load=reach)
        assert sum(p.stat().st_size for p in computed.folder.glob("*.tables")) <= 3.5 * size
    assert computed.made == [None, 300.0, 310.0, 320.0, 330.0]


def test_where_nothing_can_be_kept_tables_are_made_all_the_same(drive, computed, tmp_path):
    (tmp_path / "cycloid-fmu").write_text("no folder")
    assert table_cache.tables_of(drive.stage) is drive.tables


# --- history ---


@pytest.mark.parametrize(("kind", "version"), EACH)
def test_a_restored_state_repeats_the_same_bits(unpacked, host, kind, version):
    assert "300 states restored" in host(unpacked(kind, version), "rollback", 300)


@pytest.mark.parametrize(("kind", "version"), EACH)
def test_a_state_restores_in_another_process(unpacked, host, tmp_path, kind, version):
    saved = host(unpacked(kind, version), "save", tmp_path / "state")
    assert host(unpacked(kind, version), "load", tmp_path / "state") == saved
    data = (tmp_path / "state").read_bytes()
    assert data[:15] == b"cycloid native\n"


def test_instances_are_made_and_freed_again_and_again(unpacked, host):
    assert "100 times 8" in host(unpacked(), "open")


def test_instances_of_a_process_share_one_table(unpacked, tmp_path):
    """The second is there without the file behind the head, and stays when the first goes; the last lets it go."""
    fmu = unpacked()
    table = tmp_path / DRIVE.file
    whole = (fmu.folder / "resources" / DRIVE.file).read_bytes()
    table.write_bytes(whole)
    library, name = ctypes.CDLL(str(fmu.library)), (b"one", 1, fmu.guid.encode(), tmp_path.as_uri().encode())
    library.fmi2Instantiate.restype = ctypes.c_void_p
    for function in ("fmi2FreeInstance", "fmi2EnterInitializationMode", "fmi2ExitInitializationMode"):
        getattr(library, function).argtypes = [ctypes.c_void_p]

    def opened():
        return library.fmi2Instantiate(*name, None, 0, 0)

    first = opened()
    table.write_bytes(whole[: HEAD.size])
    second = opened()
    assert first
    assert second
    library.fmi2FreeInstance(first)
    assert library.fmi2EnterInitializationMode(second) == 0
    assert library.fmi2ExitInitializationMode(second) == 0
    library.fmi2FreeInstance(second)
    assert opened() is None


def test_instances_come_and_go_in_many_threads(unpacked):
    fmu = unpacked()
    library = ctypes.CDLL(str(fmu.library))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    for function in ("fmi2FreeInstance", "fmi2EnterInitializationMode", "fmi2ExitInitializationMode"):
        getattr(library, function).argtypes = [ctypes.c_void_p]
    library.fmi2DoStep.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int]

    def lives(_):
        for _ in range(30):
            one = library.fmi2Instantiate(b"one", 1, fmu.guid.encode(), fmu.uri.encode(), None, 0, 0)
            assert library.fmi2EnterInitializationMode(one) == 0
            assert library.fmi2ExitInitializationMode(one) == 0
            assert library.fmi2DoStep(one, 0.0, 1e-3, 0) == 0
            library.fmi2FreeInstance(one)
        return True

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(lives, range(4)))


def test_reset_is_a_new_beginning(slave):
    used, fresh = slave(), slave()
    used.start(friction_torque=5.0)
    used.put(flange_a_phi=1.0, flange_b_tau=30.0)
    used.fmi.doStep(0.0, 1e-3)
    used.fmi.reset()
    for each in (used, fresh):
        each.start()
        each.put(flange_a_phi=2.0)
        each.fmi.doStep(0.0, 1e-3)
    assert used.get("flange_b.phi", "friction_torque") == fresh.get("flange_b.phi", "friction_torque")


# --- invalid input of hosts ---


@pytest.mark.parametrize(("kind", "version"), EACH)
def test_random_steps_with_nonsense_among_them_bring_no_number_that_is_none(unpacked, host, kind, version):
    assert "20000 steps" in host(unpacked(kind, version), "random", 20000)


@pytest.mark.parametrize("made", ["reducer", "pressed"])
def test_nonsense_and_rollback_with_a_first_stage_or_interference(request, host, tmp_path, made):
    path = request.getfixturevalue(made).path
    folder = tmp_path / "unpacked"
    fmpy.extract(str(path), unzipdir=str(folder))
    fmu = SimpleNamespace(
        version="2.0",
        kind="kinematic",
        uri=(folder / "resources").as_uri(),
        guid=fmpy.read_model_description(str(path)).guid,
        library=folder / "binaries" / "linux64" / "CycloidDrive.so",
    )
    assert "5000 steps" in host(fmu, "random", 5000)
    assert "100 states restored" in host(fmu, "rollback", 100)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "version"), EACH)
def test_many_random_steps(unpacked, host, kind, version):
    assert "refused" in host(unpacked(kind, version), "random", STEPS)


@pytest.mark.slow
@needs("gcc")
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_the_library_is_clean_under_the_address_and_undefined_behaviour_sanitizers(unpacked, host, tmp_path, version):
    flags = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
    sources = [unpacked("kinematic", version).folder / "sources" / name for name in SOURCES]
    library = compiled(tmp_path / "drive.so", sources, *flags, "-shared", "-fPIC")
    program = compiled(tmp_path / "host", [HERE / "host.c"], f"-DFMI={version[0]}", *flags)
    for kind in INTERFACES:
        for words in (
            ("random", STEPS // 10),
            ("rollback", 50),
            ("open",),
            ("save", tmp_path / "s"),
            ("load", tmp_path / "s"),
        ):
            host(unpacked(kind, version), *words, program=program, library=library)


@pytest.mark.slow
@needs("valgrind")
@pytest.mark.parametrize(("kind", "version"), EACH)
def test_the_library_is_clean_under_valgrind(unpacked, host, kind, version):
    valgrind = ("valgrind", "--quiet", "--error-exitcode=9", "--leak-check=full", "--errors-for-leak-kinds=definite")
    for words in (("random", STEPS // 50), ("rollback", 20), ("run", 200)):
        host(unpacked(kind, version), *words, prefix=valgrind)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"flange_a_phi": math.nan}, "flange_a.phi = nan: it must be finite"),
        ({"friction_torque": -1.0}, "friction_torque = -1: it must be finite and lie between 0 and inf"),
        ({"pin_radial_1_cos": 2e-6}, "pin_radial_1_cos = 2e-06: this FMU holds it in its tables, made for 0"),
        ({"flange_b_phi": 0.0}, "flange_b.phi can't be set: it is an output"),
    ],
)
def test_what_can_not_be_set_is_an_error_with_a_message_that_says_why(slave, values, said):
    native = slave()
    native.start()
    before = native.get(*COLUMNS[1:])
    with pytest.raises(Exception, match="error"):
        native.put(**values)
    assert said in native.said[-1]
    assert native.get(*COLUMNS[1:]) == before
    native.fmi.doStep(0.0, 1e-3)


@pytest.mark.parametrize(
    ("kind", "values", "step", "said"),
    [
        ("kinematic", {"flange_b_tau": 1e9}, 1e-3, "1e+09 N.m, which turns the output by more than 0.01 rad"),
        ("kinematic", {}, -1e-3, "a step of -0.001 s: it must be finite and not below 0"),
        ("compliant", {"flange_b_phi": 0.1}, 1e-4, "rad from flange_a.phi/ratio: it must stay within 0.01 rad"),
        (
            "compliant",
            {"flange_b_phi": 0.1},
            2e-3,
            "after a step of 0.002 s: it must stay within 0.01 rad; make shorter steps (0.0001 s is suggested), or",
        ),
        ("compliant", {"flange_a_w": 1e9, "flange_b_w": 1e9 / -39, "mesh_damping": 1.0}, 1e3, "divided into more than"),
        ("inertia", {"flange_b_tau": 1e9}, 1e-3, "rad"),
        ("inertia", {"flange_a_w": 1e9}, 1e-3, "divided into more than"),
    ],
)
def test_a_refused_step_is_an_error_said_once_and_leaves_all_as_it_was(slave, kind, values, step, said):
    native = slave(kind)
    native.start(flange_a_phi=0.3, **({"flange_b_phi": 0.3 / -39} if kind == "compliant" else {}))
    before = native.get("flange_b.phi", "backlash")
    native.put(**values)
    with pytest.raises(FMICallException) as refused:
        native.fmi.doStep(0.0, step)
    assert refused.value.status == fmpy.fmi2.fmi2Error
    assert len(native.said) == 1
    assert said in native.said[0]
    native.put(**dict.fromkeys(values, 0.0) | ({"flange_b_phi": 0.3 / -39} if kind == "compliant" else {}))
    assert native.get("flange_b.phi", "backlash") == before
    native.fmi.doStep(0.0, 1e-3)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_steps_longer_than_the_largest_inside_are_made_and_one_that_can_not_be_made_ends_the_run(built, version):
    path, ratio = str(built("compliant", version)), -39.0
    turning = {"flange_a.w": 10.0, "flange_b.w": 10.0 / ratio}
    done = fmpy.simulate_fmu(path, stop_time=0.5, step_size=0.05, output_interval=0.05, start_values=turning)
    assert done["time"][-1] == pytest.approx(0.5)
    with pytest.raises(FMICallException):
        fmpy.simulate_fmu(path, stop_time=2.0, start_values={"flange_b.w": 1.0})


def test_libcosim_stops_at_a_step_that_can_not_be_made(built):
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=10_000_000)
    index = execution.add_local_slave(CosimLocalSlave(fmu_path=str(built("compliant")), instance_name="drive"))
    given = CosimManipulator.create_override()
    execution.add_manipulator(manipulator=given)
    assert execution.step()
    given.slave_real_values(index, [2], [0.1])
    assert not execution.step()
    assert not execution.step()


def test_fmuloader_is_told_of_a_step_that_can_not_be_made(built):
    from fmuloader.fmi3 import Fmi3Slave

    path = built("compliant", "3.0")
    description = fmpy.read_model_description(str(path))
    host = Fmi3Slave(str(path), model_identifier=description.coSimulation.modelIdentifier)
    host.instantiate_co_simulation("drive", instantiation_token=description.instantiationToken)
    host.enter_initialization_mode(start_time=0.0)
    host.exit_initialization_mode()
    host.do_step(0.0, 0.01)
    host.set_float64([2], [0.1])
    with pytest.raises(Exception, match=r"(?i)error"):
        host.do_step(0.01, 0.01)
    host.free_instance()


def test_beyond_the_tables_all_goes_on_near_the_exact_model_and_it_is_said_once(drive, slave, without_losses):
    reach, ratio = drive.tables.positive.load[-1], drive.pair.ratio
    native = slave(path=without_losses)
    native.start(flange_a_phi=0.4, flange_b_tau=reach)
    assert not native.fmi.getBoolean([native.references["outside_range"]])[0]
    found = []
    for i, times in enumerate((1.5, 2.5, 3.9, 5.0, 6.0)):
        native.put(flange_b_tau=times * reach)
        native.fmi.doStep(1e-3 * i, 1e-3)
        assert native.fmi.getBoolean([native.references["outside_range"]])[0]
        found.append(native.get("transmission_error", "torsional_stiffness", "max_contact_pressure", "flange_a.tau"))
        error, stiffness, pressure, crank = found[-1]
        exact = solve(drive.stage, [times * reach], [0.4])
        assert error == pytest.approx(exact.transmission_error[0, 0], rel=0.02)
        assert stiffness == pytest.approx(exact.torsional_stiffness[0, 0], rel=0.2)
        assert pressure == pytest.approx(exact.max_contact_pressure[0, 0], rel=0.2)
        assert crank == pytest.approx(-times * reach / ratio, rel=0.02)
    # From 4 times the last load on along the tangent.
    (near, stays, *_), (far, stiffness, *_) = found[-2:]
    assert far - near == pytest.approx(reach / stiffness, rel=1e-6)
    assert stays == pytest.approx(stiffness, rel=1e-9)
    native.put(flange_b_tau=0.5 * reach)
    native.fmi.doStep(3e-3, 1e-3)
    assert not native.fmi.getBoolean([native.references["outside_range"]])[0]
    assert len(native.said) == 1
    assert "beyond the 452.5 N.m of the FMU's tables" in native.said[0]


def test_tables_reach_as_far_as_asked(drive, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(tables, "compute", lambda *a, largest_load, **k: asked.append(largest_load) or drive.tables)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native_build.build_native(drive, tmp_path / "d.fmu", largest_torque=1e3)
    assert asked == [1e3]
    with pytest.raises(edge.InputError, match="largest_torque"):
        native_build.build_native(drive, tmp_path / "d.fmu", largest_torque=-1.0)


@settings(max_examples=40)
@given(at=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7), cut=st.booleans())
def test_a_damaged_table_is_refused_in_one_sentence(unpacked, host, tmp_path_factory, at, bit, cut):
    fmu = unpacked()
    data = bytearray((fmu.folder / "resources" / "drive.table").read_bytes())
    place = int(at * len(data))
    if cut:
        data = data[:place]
    else:
        data[place] ^= 1 << bit
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "drive.table").write_bytes(data)
    said = host(fmu, "open", uri=folder.as_uri(), fails=True)
    assert "table" in said
    assert "not instantiated" in said


def test_a_table_with_a_right_checksum_and_wrong_contents_is_refused(unpacked, host, tmp_path):
    fmu = unpacked()
    data = bytearray((fmu.folder / "resources" / "drive.table").read_bytes())
    random = np.random.default_rng(8)
    for _ in range(60):
        changed = bytearray(data)
        for place in random.integers(HEAD.size, len(data), 3):
            changed[place] = random.integers(256)
        (tmp_path / "drive.table").write_bytes(headed(bytes(changed[HEAD.size :]), DRIVE))
        assert host(fmu, "run", 5, uri=tmp_path.as_uri(), fails=None) in (0, 1)


def forged(data, fields):
    """A file of tables whose variables have other fields and causalities, with the right checksum."""
    changed, place = bytearray(data), HEAD.size + 8
    for field, causality in fields:
        place += 2 + int.from_bytes(changed[place : place + 2], "little")
        changed[place + 1 : place + 8] = struct.pack("<BBBi", causality, False, False, field)
        place += 8 + 4 * 8
    return headed(bytes(changed[HEAD.size :]), DRIVE)


def test_a_variable_of_no_field_is_refused(unpacked, host, tmp_path):
    """Its value would be read before the beginning of an array."""
    fmu = unpacked("compliant")
    data = (fmu.folder / "resources" / "drive.table").read_bytes()
    for field in (-1, -2, 10**6):
        (tmp_path / "drive.table").write_bytes(forged(data, [(field, 1)]))
        assert "the table is damaged" in host(fmu, "open", uri=tmp_path.as_uri(), fails=True)


@pytest.mark.slow(60)
@needs("gcc")
@pytest.mark.parametrize("kind", INTERFACES)
def test_outputs_that_are_none_reach_no_other_memory(unpacked, host, tmp_path, kind):
    """Every field as an output, an input, a parameter and a local variable, under the sanitizers."""
    fmu = unpacked(kind)
    flags = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
    sources = [fmu.folder / "sources" / name for name in SOURCES]
    library = compiled(tmp_path / "drive.so", sources, *flags, "-shared", "-fPIC")
    program = compiled(tmp_path / "host", [HERE / "host.c"], "-DFMI=2", *flags)
    data = (fmu.folder / "resources" / "drive.table").read_bytes()
    for causality in range(5):
        for first in range(0, 110, 10):
            (tmp_path / "drive.table").write_bytes(forged(data, [(first + k, causality) for k in range(10)]))
            for words in (("open",), ("run", 2), ("random", 20)):
                status = host(
                    fmu,
                    *words,
                    uri=tmp_path.as_uri(),
                    fails=None,
                    program=program,
                    library=library,
                    ASAN_OPTIONS="exitcode=99",
                    UBSAN_OPTIONS="exitcode=99",
                )
                assert status in (0, 1), (causality, first, words)


@needs("gcc")
def test_an_angle_that_is_no_number_has_a_place_and_no_weights(unpacked, tmp_path):
    program = """
    #include <math.h>
    #include <stdio.h>
    #include "table.h"
    int main(void) {
        const double angle[] = {NAN, INFINITY, -INFINITY, -1e-300, 0.75, 1e300};
        struct table table = {0};
        int i, k;
        table.period = 1.0, table.angles = table.pressure_angles = 4;
        for (i = 0; i < 6; i++) {
            struct place place = table_place(&table, angle[i]);
            for (k = 0; k < 4; k++) {
                printf("%u %.6f ", place.node[k], fabs(place.weight[k]));
            }
        }
        return 0;
    }
    """
    (tmp_path / "main.c").write_text(program)
    folder = unpacked().folder / "sources"
    flags = ("-fsanitize=undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-I", folder)
    made = compiled(tmp_path / "main", [tmp_path / "main.c", folder / "table.c"], *map(str, flags))
    words = subprocess.run([made], capture_output=True, text=True, check=True).stdout.split()
    places = np.reshape(np.array(words, float), (6, 4, 2))
    assert np.isnan(places[:3, :, 1]).all()
    assert (places[:, :, 0] < 4).all()
    spline = [1 / 6, 4 / 6, 1 / 6, 0.0]
    assert places[3].tolist() == [[n, pytest.approx(w, abs=1e-6)] for n, w in zip([3, 0, 1, 2], spline, strict=True)]
    assert places[4].tolist() == [[n, pytest.approx(w, abs=1e-6)] for n, w in zip([2, 3, 0, 1], spline, strict=True)]


def test_a_table_of_another_fmu_is_refused(unpacked, host):
    said = host(unpacked(), "open", uri=unpacked("compliant").uri, fails=True)
    assert "belong to two FMUs" in said


def test_a_state_of_another_drive_is_refused(slave):
    one, other = slave(), slave("compliant")
    for each in (one, other):
        each.start()
    state = one.fmi.getFMUState()
    data = one.fmi.serializeFMUState(state)
    with pytest.raises(Exception, match="error"):
        other.fmi.deserializeFMUState(data)
    assert "this state belongs to another drive" in other.said[-1]
    with pytest.raises(Exception, match="error"):
        one.fmi.deserializeFMUState(data[:-8])
    assert "this state is damaged" in one.said[-1]
    one.fmi.freeFMUState(state)


@pytest.mark.parametrize("form", ["file:{}", "file://{}", "file://localhost{}", "file:{}/", "plain"])
def test_the_resources_are_found_by_uri_or_path(unpacked, host, form):
    fmu = unpacked()
    path = fmu.uri.removeprefix("file://")
    uri = str(fmu.folder / "resources") if form == "plain" else form.format(path)
    assert "100 times 8" in host(fmu, "open", uri=uri)


def test_what_is_no_place_of_resources_is_refused(unpacked, host):
    for uri in ("https://somewhere/resources", "file:///nowhere%", "file:///nowhere%00"):
        assert "neither a path nor a file URI" in host(unpacked(), "open", uri=uri, fails=True)
    assert "can't be read" in host(unpacked(), "open", uri="file:///no/where", fails=True)


# --- shared by C and Python ---


def test_no_constant_of_the_models_is_copied_into_c_by_hand():
    """C has its own names for nothing that `constants.py` names, and no number of it as a literal."""
    named = {n: v for n, v in vars(constants).items() if n.isupper()}
    header = constants_header().decode()
    assert {n for n in named if f"#define {n} " in header} == set(named)
    told = {v: n for n, v in named.items() if not float(v).is_integer() or v > 100}
    for path in (path for folder in SOURCE_FOLDERS for path in folder.glob("*.[ch]")):
        code = re.sub(r"/\*.*?\*/|\"(\\.|[^\"])*\"", "", path.read_text(), flags=re.DOTALL)
        copied = {
            told[float(number)]
            for number in re.findall(r"(?<![\w.])(?:\d+\.?\d*(?:[eE][-+]?\d+)?)(?![\w.])", code)
            if float(number) in told
        }
        assert not copied, path
        assert not re.findall(rf"(?:define|double|int)\s+({'|'.join(named)})\b", code), path


def test_a_file_of_tables_is_read_as_it_was_written(drive, unpacked, host, tmp_path):
    kept = from_tables(variables(drive.stage, INTERFACES["kinematic"], "2.0"))
    fmu = unpacked()
    body = table_body(drive.tables, INTERFACES["kinematic"], kept)
    (tmp_path / DRIVE.file).write_bytes(sealed(body, fmu.guid, DRIVE))
    assert host(fmu, "run", 200, uri=tmp_path.as_uri()) == host(fmu, "run", 200)


# --- the archive ---


@pytest.mark.parametrize("version", [pytest.param("2.0", marks=pytest.mark.slow(1)), "3.0"])
@pytest.mark.parametrize("kind", list(BUILT))
def test_validation_finds_nothing(built, kind, version):
    assert validate_fmu(str(built(kind, version))) == []


def test_variables_have_the_references_of_the_fmu_in_python(built, drive):
    for version in ("2.0", "3.0"):
        described = fmpy.read_model_description(str(built(version=version))).modelVariables
        described = [v for v in described if not v.name.startswith("event_indicator")]
        table = variables(drive.stage, INTERFACES["kinematic"], version)
        assert all(table[v.valueReference].name == v.name and table[v.valueReference].unit == v.unit for v in described)
        assert {v.name for v in table if not v.dimensions} == {v.name for v in described}


STRICT = ("-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror")


@pytest.mark.parametrize(
    "compiler",
    [
        COMPILER,
        pytest.param(("clang",), marks=[needs("clang"), pytest.mark.slow(2)]),
        pytest.param(zig("x86_64-windows"), marks=pytest.mark.slow(10), id="zig for Windows"),
    ],
)
def test_the_sources_in_the_fmu_compile_alone_without_a_warning(unpacked, tmp_path, compiler):
    folder = shutil.copytree(unpacked().folder / "sources", tmp_path / "sources")
    for source in SOURCES:
        subprocess.run([*compiler, "-std=c99", *STRICT, "-c", source], cwd=folder, check=True)


@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD is of Linux")
@pytest.mark.parametrize(("kind", "version"), EACH)
def test_a_step_takes_no_memory(unpacked, host, tmp_path, kind, version):
    counter = compiled(tmp_path / "counter.so", [HERE / "allocations.c"], "-shared", "-fPIC", "-D_GNU_SOURCE")
    counts = []
    for steps in (100, 5000):
        log = tmp_path / f"{steps}.txt"
        host(unpacked(kind, version), "time", steps, LD_PRELOAD=str(counter), ALLOCATIONS=str(log))
        counts.append(int(log.read_text()))
    assert counts[0] == counts[1] > 10


def test_a_drive_gives_the_same_bytes_again(built, drive, tmp_path, monkeypatch):
    path = tmp_path / "again.fmu"
    native_build.build_native(
        drive,
        path,
        interface=INTERFACES["kinematic"],
        drive_tables=drive.tables,
        platforms=[this_platform()],
    )
    assert path.read_bytes() == built().read_bytes()


def test_each_platform_has_its_folder_and_macos_in_fmi_2_holds_both_processors(drive, tmp_path, monkeypatch):
    for version, expected in (
        ("2.0", {"linux64/CycloidDrive.so", "win64/CycloidDrive.dll", "darwin64/CycloidDrive.dylib"}),
        (
            "3.0",
            {
                "x86_64-linux/CycloidDrive.so",
                "aarch64-linux/CycloidDrive.so",
                "x86_64-windows/CycloidDrive.dll",
                "x86_64-darwin/CycloidDrive.dylib",
                "aarch64-darwin/CycloidDrive.dylib",
            },
        ),
    ):
        path = tmp_path / f"{version}.fmu"
        native_build.build_native(drive, path, fmi_version=version, drive_tables=drive.tables)
        with zipfile.ZipFile(path) as archive:
            found = {n.removeprefix("binaries/") for n in archive.namelist() if n.startswith("binaries/")}
            assert found == expected
            if version == "2.0":
                fat = archive.read("binaries/darwin64/CycloidDrive.dylib")
                assert struct.unpack_from(">II", fat) == (0xCAFEBABE, 2)
                for entry, name in ((8, "x86_64-darwin"), (28, "aarch64-darwin")):
                    _, _, offset, size, align = struct.unpack_from(">IIIII", fat, entry)
                    assert fat[offset : offset + size] == library_path(name).read_bytes()
                    assert offset % (1 << align) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--native", "--platform", "m68k-amiga"], '--platform = "m68k-amiga": this is none of x86_64-linux, '),
        (["--native", "--platform", "aarch64-linux", "--fmi", "2.0"], "FMI 2.0 does not know it, FMI 3.0 does"),
        (["--platform", "x86_64-linux"], "--platform is only for --native"),
    ],
)
def test_what_can_not_be_built_is_refused_and_nothing_written(command, tmp_path, words, said):
    (tmp_path / "drive.fmu").write_text("kept")
    done = command("cycloid-fmu", "build", EXAMPLES / "drive-39-40.toml", *words, "-o", "drive.fmu")
    assert done.returncode == edge.BAD_INPUT
    assert said in done.stderr
    assert (tmp_path / "drive.fmu").read_text() == "kept"
    assert [p.name for p in tmp_path.iterdir()] == ["drive.fmu"]


def test_a_pair_without_rated_torque_is_refused(command, tmp_path):
    text = (EXAMPLES / "drive-39-40.toml").read_text()
    (tmp_path / "pair.toml").write_text("\n".join(x for x in text.splitlines() if not x.startswith("rated_torque")))
    done = command("cycloid-fmu", "build", "pair.toml", "--native", "-o", "drive.fmu")
    assert done.returncode == edge.BAD_INPUT
    assert "pair.toml: [pair] rated_torque is missing" in done.stderr


# --- other machines ---


@pytest.mark.slow(30)
@needs_wine
def test_the_windows_library_does_the_same_under_wine(unpacked, host, tmp_path):
    runtime = ("-Wl,--entry=start", *windows_runtime("convert", "runtime", "time"))
    library = tmp_path / "CycloidDrive.dll"
    library.write_bytes(library_path("x86_64-windows").read_bytes())
    run = {"prefix": (WINE,), "WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"}
    for version in ("2.0", "3.0"):
        run["program"] = compiled(
            tmp_path / f"host{version[0]}.exe",
            [HERE / "host.c", HERE / "windows_start.c"],
            f"-DFMI={version[0]}",
            "-O2",
            *runtime,
            compiler=zig("x86_64-windows"),
        )
        for kind in INTERFACES:
            fmu = SimpleNamespace(**vars(unpacked(kind, version)))
            linux = rows_of(host(fmu, "run", 800))
            fmu.uri = fmu.uri.replace("file:///", "file:///Z:/") if version == "2.0" else f"Z:{fmu.uri}"
            fmu.library = library
            found = rows_of(host(fmu, "run", 800, **run))
            differing = np.abs(found - linux) / np.abs(linux).max(axis=0)
            # Each system has its own sine. An inertia that knocks about in its play doubles the last bits' difference
            # again and again: it is held to its first knocks.
            assert differing[: 100 if kind in ("inertia", "rotor") else 800].max() <= 1e-12, (kind, version)
            assert "100 states restored" in host(fmu, "rollback", 100, **run)
            assert "refused" in host(fmu, "random", STEPS // 20, **run)


@pytest.mark.slow(20)
@pytest.mark.skipif(
    shutil.which("qemu-aarch64") is None or not ARM.is_dir(), reason="qemu-user and libc6-arm64-cross are not installed"
)
def test_the_aarch64_library_does_the_same_under_qemu(unpacked, host, tmp_path):
    library = tmp_path / "CycloidDrive.so"
    library.write_bytes(library_path("aarch64-linux").read_bytes())
    program = compiled(tmp_path / "host", [HERE / "host.c"], "-DFMI=3", "-O2", compiler=zig("aarch64-linux"))
    run = {"prefix": ("qemu-aarch64", "-L", ARM), "program": program}
    for kind in INTERFACES:
        fmu = SimpleNamespace(**vars(unpacked(kind, "3.0")))
        own = rows_of(host(fmu, "run", 800))
        fmu.library = library
        found = rows_of(host(fmu, "run", 800, **run))
        # Each system has its own sine, which makes the motion: where it is the same bits, all that comes out is.
        alike = (found[:, : 1 + MOTION[kind]] == own[:, : 1 + MOTION[kind]]).all(axis=1)
        assert np.mean(alike) > 0.5
        assert (found[alike] == own[alike]).all()
        assert (np.abs(found - own) <= 1e-11 * np.abs(own).max(axis=0)).all()
        assert "100 states restored" in host(fmu, "rollback", 100, **run)
        assert "refused" in host(fmu, "random", STEPS // 20, **run)
