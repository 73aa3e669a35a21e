"""The FMU as its users meet it: built, validated, loaded by fmpy."""

import json
import math
import os
import shutil
import subprocess
import sys
import zipfile
from contextlib import contextmanager
from pathlib import Path

import fmpy
import numpy as np
import pytest
from common import CASES, PAIR
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import simulate_fmu, turn_crank
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.files import write_surface
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

ERRORS = read_pair(CASES / "errors-39-40.toml")


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    path = tmp_path_factory.mktemp("fmü with spaces") / "drive ü.fmu"
    build_fmu(DriveValue.as_stated(ERRORS), path)
    return path


@contextmanager
def instance(path, name="one"):
    description = fmpy.read_model_description(str(path), validate=False)
    folder = fmpy.extract(str(path))
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName=name,
    )
    references = {v.name: v.valueReference for v in description.modelVariables}
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    try:
        yield slave, references
        slave.terminate()
    finally:
        slave.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)


def start(slave, references, angle=0.0, torque=0.0):
    slave.enterInitializationMode()
    slave.setReal([references["flange_a.phi"], references["flange_b.tau"]], [angle, torque])
    slave.exitInitializationMode()


def test_validation_finds_nothing(fmu):
    assert validate_fmu(str(fmu)) == []


def test_every_variable_is_described_with_its_unit(fmu):
    description = fmpy.read_model_description(str(fmu), validate=True)
    variables = {v.name: v for v in description.modelVariables}
    for name in ("flange_a.phi", "flange_a.w", "flange_b.tau"):
        assert variables[name].causality == "input"
    for name in (
        "flange_b.phi",
        "flange_b.w",
        "flange_a.tau",
        "transmission_error",
        "backlash",
        "torsional_stiffness",
        "contact_count",
        "max_contact_pressure",
    ):
        assert variables[name].causality == "output"
    for name in (
        "centre_distance_x",
        "eccentricity",
        "pin_radial_1_cos",
        "tooth_cumulative_pitch_3_sin",
        "friction_torque",
        "series_compliance",
    ):
        assert (variables[name].causality, variables[name].variability) == ("parameter", "tunable")
    assert all(v.description for v in description.modelVariables)
    assert [v.name for v in description.modelVariables if v.type == "Real" and not v.unit] == []
    units = {u.name: u for u in description.unitDefinitions}
    assert {v.unit for v in description.modelVariables if v.unit} <= set(units)
    displays = {d.name for d in units["rad"].displayUnits}
    assert variables["transmission_error"].displayUnit in displays
    assert float(variables["backlash"].min) == 0.0
    assert len(description.initialUnknowns) == len(description.outputs) == 10
    assert {u.variable.name for u in description.initialUnknowns} == {u.variable.name for u in description.outputs}


def test_start_values_are_the_surface_s_own(fmu):
    description = fmpy.read_model_description(str(fmu))
    starts = {v.name: v.start for v in description.modelVariables}
    assert float(starts["centre_distance_x"]) == pytest.approx(4e-6)
    assert float(starts["pin_radius"]) == pytest.approx(-0.5e-6, abs=0.0)
    pins = surface_of_pair(ERRORS).pin_radial
    wave = 2 / 40 * pins @ np.sin(2 * np.pi * 2 * np.arange(40) / 40)
    assert float(starts["pin_radial_2_sin"]) == pytest.approx(wave, rel=1e-12, abs=0.0)


def test_the_surface_lies_in_the_resources(fmu):
    assert "resources/surface.nc" in zipfile.ZipFile(fmu).namelist()


@pytest.mark.parametrize("case", ["errors-39-40", "two-discs-39-40", "interference-21-22"])
def test_it_says_what_the_independent_solver_says(case, tmp_path):
    pair = read_pair(CASES / f"{case}.toml")
    build_fmu(DriveValue.as_stated(pair), tmp_path / "d.fmu")
    wanted = json.loads((CASES / f"{case}.json").read_text())
    for result in wanted["results"]:
        found = simulate_fmu(tmp_path / "d.fmu", wanted["crank_angle"], result["torque"])
        assert found["transmission_error"] == pytest.approx(result["transmission_error"], abs=0.01 / 206265)
        ideal = np.array(wanted["crank_angle"]) / pair.ratio
        assert found["flange_b.phi"] - ideal == pytest.approx(found["transmission_error"], abs=1e-12)
        backlash = [b or 0.0 for b in result["backlash"]]
        assert found["backlash"] == pytest.approx(backlash, abs=0.01 / 206265)


def test_tuned_parameters_act_at_the_next_step(fmu):
    with instance(fmu) as (slave, v):
        start(slave, v, 1.0, 100.0)
        slave.setReal([v["centre_distance_x"], v["centre_distance_y"], v["series_compliance"]], [0.0, 0.0, 1e-7])
        slave.doStep(0.0, 0.01)
        found = slave.getReal([v["transmission_error"]])[0]
    import dataclasses

    changed = dataclasses.replace(surface_of_pair(ERRORS), centre_distance_x=0.0, centre_distance_y=0.0)
    wanted = solve(DriveValue(ERRORS, changed), 100.0, 1.0).transmission_error[0, 0] + 1e-5
    assert found == pytest.approx(wanted, abs=1e-11)


def test_rollback_through_the_interface_is_exact_also_in_another_instance(fmu):
    path = [(0.05 * i, 60.0 * np.cos(0.9 * i)) for i in range(30)]
    outputs = ("flange_b.phi", "flange_a.tau", "backlash", "max_contact_pressure")

    def walk(slave, v):
        found = []
        for angle, torque in path:
            slave.setReal([v["flange_a.phi"], v["flange_b.tau"]], [angle, torque])
            slave.doStep(0.0, 0.01)
            found.append(slave.getReal([v[n] for n in outputs]))
        return found

    with instance(fmu) as (slave, v), instance(fmu, "two") as (other, _):
        start(slave, v, 0.3, 5.0)
        start(other, v, 0.0, 0.0)
        kept = slave.getFMUState()
        blob = slave.serializeFMUState(kept)
        first = walk(slave, v)
        slave.setFMUState(kept)
        assert walk(slave, v) == first
        slave.freeFMUState(kept)
        other.setFMUState(other.deSerializeFMUstate(blob))
        assert walk(other, v) == first


def test_many_instances_come_and_go(fmu):
    with instance(fmu, "kept") as (kept, v):
        start(kept, v, 0.5, 80.0)
        before = kept.getReal([v["flange_b.phi"]])
        for number in range(12):
            with instance(fmu, str(number)) as (slave, _):
                start(slave, v, 0.1 * number, -50.0)
        kept.doStep(0.0, 0.01)
        assert kept.getReal([v["flange_b.phi"]]) == pytest.approx(before, abs=1e-12)


@pytest.mark.slow(2)
def test_an_exception_inside_is_an_error_outside_and_breaks_nothing(fmu, tmp_path):
    code = """
import gc, sys
sys.path.insert(0, sys.argv[2])
from test_fmu import instance, start
with instance(sys.argv[1]) as (slave, v):
    start(slave, v, 0.0, 50.0)
    try:
        slave.setReal([v["flange_b.phi"]], [1.0])
    except Exception as problem:
        print("refused", problem)
gc.collect()
"""
    run = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", code, str(fmu), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
    )
    assert run.returncode == 0, run.stderr
    assert "refused" in run.stdout


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_why_something_is_refused_is_in_the_log_whether_logging_is_on_or_not(tmp_path, version):
    path, said = tmp_path / "d.fmu", []
    build_fmu(DriveValue.as_stated(ERRORS), path, fmi_version=version)
    description, folder = fmpy.read_model_description(str(path)), Path(fmpy.extract(str(path), str(tmp_path / "fmu")))

    def opened():
        new = version == "3.0"
        slave = (FMU3Slave if new else FMU2Slave)(
            guid=description.guid or description.instantiationToken,
            unzipDirectory=str(folder),
            modelIdentifier="CycloidDrive",
            instanceName="one",
        )
        logger = fmi2.fmi2CallbackLoggerTYPE(listen)
        kept.append(logger)
        callbacks = fmi2.fmi2CallbackFunctions(
            logger, fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc), fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        )
        slave.instantiate(**({"logMessage": listen} if new else {"callbacks": callbacks}), loggingOn=False)
        return slave

    kept = []

    def listen(*words):
        said.append(words[-1].decode())

    slave = opened()
    of = {v.name: v.valueReference for v in description.modelVariables}
    integers = slave.getInteger if version == "2.0" else slave.getInt32
    with pytest.raises(FMICallException):
        integers([of["flange_b.phi"]])
    assert f"there is no integer variable with the value reference {of['flange_b.phi']}" in said[-1]
    with pytest.raises(FMICallException):
        slave.doStep(0.0, 1e-3)
    assert said[-1] == "a step is allowed while stepping only, not before initialization"
    stored = bytearray((folder / "resources" / "surface.npz").read_bytes())
    stored[len(stored) // 2] ^= 1
    (folder / "resources" / "surface.npz").write_bytes(stored)
    with pytest.raises(Exception, match="Failed to instantiate"):
        opened()
    assert "surface.npz: it is damaged" in said[-1]


def test_a_surface_of_another_pair_is_refused(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    other = parse_pair(PAIR.replace('"3 mm"', '"3.1 mm"'), "other")
    write_surface(nominal_surface(other), tmp_path / "other.nc")
    run = command("cycloid-fmu", "build", "pair.toml", "--surface", "other.nc", "-o", "d.fmu")
    assert run.returncode == 2
    assert "other.nc: this surface belongs to another pair: [pair] pin_radius is 0.0031 there" in run.stderr
    assert not (tmp_path / "d.fmu").exists()


@pytest.mark.parametrize("turns", [math.nan, math.inf, -math.inf, 1e300, 0.0])
def test_turns_that_are_no_run_are_refused(turns):
    with pytest.raises(edge.ArgumentError, match=r"^turns = .*: it must be from 1e-06 to 27777.8, or as "):
        turn_crank("drive.fmu", 100.0, turns, 1.0, 360)


def test_commands_build_inspect_simulate(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    assert command("cycloid-fmu", "build", "pair.toml", "-o", "d.fmu").returncode == 0
    seen = command("cycloid-fmu", "inspect", "d.fmu", "--json")
    assert seen.returncode == 0
    assert json.loads(seen.stdout)["problems"] == []
    run = command(
        "cycloid-fmu",
        "simulate",
        "d.fmu",
        "--torque=-181 N*m",
        "--samples",
        "100",
        "-o",
        "r.csv",
        "--plot",
        "r.png",
        "--json",
    )
    assert run.returncode == 0, run.stderr
    error = np.array(json.loads(run.stdout)["transmission_error"]) * 206265
    assert error.mean() == pytest.approx(-4.5015, abs=2e-3)
    table = np.loadtxt(tmp_path / "r.csv", delimiter=",", skiprows=1)
    assert table.shape == (101, 11)
    assert (tmp_path / "r.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["build", "pair.toml", "-o", "d.zip"], ".fmu"),
        (["build", "pair.toml", "-o", "nowhere/d.fmu"], "nowhere"),
        (["inspect", "pair.toml"], "an FMU is needed here"),
        (["inspect", "none.fmu"], "No such file"),
        (["simulate", "pair.toml", "--torque", "5 N*m"], "an FMU is needed here"),
        (["simulate", "pair.toml", "--torque", "5"], "--torque"),
        (["analyze", "pair.toml", "--torque", "5 N*m", "--plot", "a.bmp"], "png"),
        (["analyze", "pair.toml", "--torque", "5 kg"], "kg"),
        (["analyze", "none.toml", "--torque", "5 N*m"], "No such file"),
        (
            ["analyze", "pair.toml", "--torque", "5 N*m", "--surface", "pair.toml"],
            "an error surface (cycloid-surface/1) is needed here",
        ),
    ],
)
def test_bad_input_exits_2_with_a_sentence(command, tmp_path, words, said):
    (tmp_path / "pair.toml").write_text(PAIR)
    run = command("cycloid-fmu", *words)
    assert run.returncode == 2
    assert said in run.stderr
    assert "Traceback" not in run.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["pair.toml"]


@pytest.mark.slow(5)
def test_a_process_that_ran_an_fmu_can_build_another(fmu, tmp_path):
    """The FMU brings its own pythonfmu, which is imported where no other was, and is gone with the FMU's folder."""
    script = f"""
import shutil, zipfile, fmpy
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
folder = fmpy.extract({str(fmu)!r})
description = fmpy.read_model_description({str(fmu)!r}, validate=False)
slave = FMU2Slave(guid=description.guid, unzipDirectory=folder, instanceName="one",
                  modelIdentifier=description.coSimulation.modelIdentifier)
slave.instantiate()
import pythonfmu
assert pythonfmu.__file__.startswith(str(folder))
slave.freeInstance()
shutil.rmtree(folder)
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import nominal_surface
pair = read_pair({str(CASES / "errors-39-40.toml")!r})
build_fmu(DriveValue(pair, nominal_surface(pair)), "again.fmu")
names = zipfile.ZipFile("again.fmu").namelist()
assert "binaries/linux64/CycloidDrive.so" in names, names
assert "resources/pythonfmu/builder.py" in names, names
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
