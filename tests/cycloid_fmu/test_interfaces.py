"""The FMUs of both interfaces and both FMI versions, as fmpy meets them."""

import json
import shutil
import subprocess
import sys
import uuid
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from common import CASES, EXAMPLES, PAIR
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu
from lxml import etree
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu.cli import app
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.core import MAGIC, state_from_bytes, state_to_bytes
from cycloid_fmu.fmu.run import open_fmu, simulate
from cycloid_fmu.fmu.variables import Interface, variables
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.reducer.description import read_reducer
from cycloid_fmu.surfaces.surface import surface_of_pair

ERRORS = read_pair(CASES / "errors-39-40.toml")
SURFACE = surface_of_pair(ERRORS)
KINDS = {
    "kinematic": Interface(losses=((0.0, 0.9, 0.85, 0.1, 0.1),)),
    "compliant": Interface("compliant"),
    "inertia": Interface("compliant", 0.05),
}


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmü s")
    made = {}

    def built(kind, version):
        if (kind, version) not in made:
            made[kind, version] = path = folder / f"{kind} {version}.fmu"
            build_fmu(DriveValue(ERRORS, SURFACE), path, interface=KINDS[kind], fmi_version=version)
        return made[kind, version]

    return built


def loaded(path, name="one", logger=None, folder=None):
    description = fmpy.read_model_description(str(path), validate=False)
    new = description.fmiVersion.startswith("3")
    slave = (FMU3Slave if new else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(path), unzipdir=folder),
        instanceName=name,
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    if new and logger is not None:
        slave.instantiate(logMessage=logger, loggingOn=True)
    else:
        slave.instantiate()
    if not new:
        slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    return slave, {v.name: v.valueReference for v in description.modelVariables}


def freed(slave):
    slave.freeInstance()
    shutil.rmtree(slave.unzipDirectory, ignore_errors=True)


@pytest.mark.parametrize("version", [pytest.param("2.0", marks=pytest.mark.slow(1)), "3.0"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_description_is_the_table_and_validation_finds_nothing(fmus, kind, version):
    path = fmus(kind, version)
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path))
    table = variables(DriveValue(ERRORS, SURFACE), KINDS[kind], version)
    assert [v.name for v in description.modelVariables] == [v.name for v in table]
    assert [v.valueReference for v in description.modelVariables] == list(range(len(table)))
    for found, wanted in zip(description.modelVariables, table, strict=True):
        assert (found.causality, found.unit) == (wanted.causality, wanted.unit)
        assert (found.nominal is None) == (wanted.nominal is None)
    known = {u.variable.name: {k.name for k in u.dependencies} for u in description.outputs}
    assert known == {v.name: set(v.depends) for v in table if v.causality == "output"}
    assert description.coSimulation.needsExecutionTool is True
    assert description.coSimulation.canSerializeFMUstate is True


def test_scalars_have_the_same_references_in_both_versions():
    for interface in KINDS.values():
        old, new = (variables(DriveValue(ERRORS, SURFACE), interface, version) for version in ("2.0", "3.0"))
        assert new[: len(old)] != ()
        assert [v.name for v in new[: len(old)]] == [v.name for v in old]


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_drive_gives_the_same_bytes_again_and_its_name_holds_no_machine_s_address(fmus, tmp_path, version):
    path = fmus("kinematic", version)
    build_fmu(DriveValue(ERRORS, SURFACE), tmp_path / "again.fmu", interface=KINDS["kinematic"], fmi_version=version)
    assert (tmp_path / "again.fmu").read_bytes() == path.read_bytes()
    assert uuid.UUID(fmpy.read_model_description(str(path)).guid).version == 5


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_run_of_long_steps_is_made_and_one_that_can_not_go_on_ends_as_an_exception(fmus, version):
    path = str(fmus("compliant", version))
    done = fmpy.simulate_fmu(path, stop_time=0.05, step_size=0.01, output_interval=0.01)
    assert done["time"][-1] == pytest.approx(0.05)
    with pytest.raises(FMICallException) as refused:
        fmpy.simulate_fmu(path, stop_time=2.0, start_values={"flange_b.w": 1.0})
    assert refused.value.status == 3  # error


def test_what_lies_inside(fmus):
    with zipfile.ZipFile(fmus("kinematic", "3.0")) as archive:
        names = archive.namelist()
        terminals = archive.read("terminalsAndIcons/terminalsAndIcons.xml")
        page = archive.read("documentation/index.html").decode()
        licence = archive.read("documentation/licenses/license.txt").decode()
        assert archive.read("terminalsAndIcons/icon.png").startswith(b"\x89PNG")
    assert len(names) == len(set(names))
    schema = Path(fmpy.__file__).parent / "schema" / "fmi3" / "fmi3TerminalsAndIcons.xsd"
    etree.XMLSchema(etree.parse(schema)).assertValid(etree.fromstring(terminals))
    kinds = [t.get("terminalKind") for t in ElementTree.fromstring(terminals).iter("Terminal")]
    assert kinds == [f"Modelica.Mechanics.Rotational.Interfaces.Flange_{end}" for end in "ab"]
    assert all(
        f"<code>{v.name}</code>" in page for v in variables(DriveValue(ERRORS, SURFACE), KINDS["kinematic"], "3.0")
    )
    assert licence.count("MIT License") + licence.count("Copyright") >= 2
    with zipfile.ZipFile(fmus("kinematic", "2.0")) as archive:
        assert archive.read("model.png").startswith(b"\x89PNG")
        assert "documentation/index.html" in archive.namelist()


def test_both_versions_run_the_same_model(fmus):
    time = np.arange(0.0, 0.05, 1e-3)
    inputs = {
        "flange_a.phi": 20.0 * time,
        "flange_a.w": np.full(time.size, 20.0),
        "flange_b.tau": 80.0 * np.cos(60.0 * time),
    }
    outputs = ("flange_b.phi", "flange_a.tau", "backlash", "power_loss", "max_contact_pressure")
    old, new = (simulate(fmus("kinematic", v), inputs, outputs, time) for v in ("2.0", "3.0"))
    for name in outputs:
        assert np.array_equal(old[name], new[name])
    assert new["power_loss"].min() > 0.0


def test_arrays_are_the_pins(fmus):
    slave, v = loaded(fmus("kinematic", "3.0"))
    slave.setFloat64([v["flange_a.phi"], v["flange_b.tau"]], [1.0, 120.0])
    slave.exitInitializationMode()
    force = np.array(slave.getFloat64([v["pin_force"]], nValues=40))
    assert np.count_nonzero(force > 0.01 * force.max()) == slave.getInt32([v["contact_count"]])[0]
    pressure = slave.getFloat64([v["pin_pressure"]], nValues=40)
    assert max(pressure) == slave.getFloat64([v["max_contact_pressure"]])[0]
    radial = slave.getFloat64([v["pin_radial"]], nValues=40)
    assert radial == SURFACE.pin_radial.tolist()
    # One pin farther out, set as an array, equals its Fourier components.
    slave.setFloat64([v["pin_radial"]], (np.array(radial) + 1e-6 * np.cos(2 * np.pi * np.arange(40) / 40)).tolist())
    assert slave.getFloat64([v["pin_radial_1_cos"]])[0] == pytest.approx(
        SURFACE.pin_radial @ np.cos(2 * np.pi * np.arange(40) / 40) / 20 + 1e-6, abs=1e-15
    )
    slave.doStep(0.0, 1e-3)
    by_array = slave.getFloat64([v["transmission_error"]])[0]
    slave.setFloat64([v["pin_radial"]], radial)
    cosine = slave.getFloat64([v["pin_radial_1_cos"]])[0]
    slave.setFloat64([v["pin_radial_1_cos"]], [cosine + 1e-6])
    slave.doStep(1e-3, 1e-3)
    assert slave.getFloat64([v["transmission_error"]])[0] == pytest.approx(by_array, abs=1e-12)
    freed(slave)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_wrong_reference_is_an_error_with_its_number_and_the_instance_goes_on(fmus, version):
    """With FMI 3.0 the status is fatal, since its library knows no other one; the instance goes on nevertheless."""
    said = []
    slave, v = loaded(fmus("compliant", version), logger=lambda *words: said.append(words[-1]))
    slave.exitInitializationMode()
    types = ("Real", "Integer", "Boolean") if version == "2.0" else ("Float64", "Int32", "Boolean", "Int64", "UInt64")
    for _ in range(5):
        for kind in types:
            reference = 10**6 if kind in ("Real", "Float64") else v["flange_a.phi"]
            for ask in (
                lambda kind=kind, r=reference: getattr(slave, f"get{kind}")([r]),
                lambda kind=kind, r=reference: getattr(slave, f"set{kind}")([r], [1]),
            ):
                with pytest.raises(FMICallException) as refused:
                    ask()
                assert refused.value.status == (3 if version == "2.0" else 4)
                assert version == "2.0" or f"variable with the value reference {reference}" in str(said[-1])
    slave.doStep(0.0, 1e-3)
    freed(slave)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_refused_value_or_step_is_an_error_status_with_a_message_and_nothing_breaks(fmus, version):
    said = []
    slave, v = loaded(fmus("inertia", version), logger=lambda *words: said.append(words[-1]))
    put = slave.setReal if version == "2.0" else slave.setFloat64
    get = slave.getReal if version == "2.0" else slave.getFloat64
    put([v["flange_b.tau"]], [50.0])
    slave.exitInitializationMode()
    slave.doStep(0.0, 1e-3)
    before = get([v["flange_b.phi"], v["flange_a.tau"], v["elastic_energy"]])
    for name, value in (
        ("flange_b.tau", float("nan")),
        ("flange_a.phi", float("inf")),
        ("friction_torque", -1.0),
        ("pin_radius", 0.5),
    ):
        put([v[name]], [value])
        with pytest.raises(FMICallException) as refused:
            slave.doStep(1e-3, 1e-3)
        assert refused.value.status == 3  # error
        put([v[name]], [{"flange_b.tau": 50.0, "pin_radius": -0.5e-6}.get(name, 0.0)])
    for step in (-1e-3, float("nan")):
        with pytest.raises(FMICallException):
            slave.doStep(1e-3, step)
    assert get([v["flange_b.phi"], v["flange_a.tau"], v["elastic_energy"]]) == before
    slave.doStep(1e-3, 1e-3)
    assert np.isfinite(get([v["flange_b.phi"]])[0])
    if version == "3.0":
        texts = [t.decode() if isinstance(t, bytes) else str(t) for t in said]
        assert any("friction_torque = -1: it must be finite and lie between 0 and inf" in t for t in texts)
        assert any("a step of -0.001 s: it must be finite" in t for t in texts)
    freed(slave)


def test_inspect_says_that_damping_is_an_assumption(fmus):
    """With the range that is published, also in the FMU's own description, which every tool shows."""
    shown = CliRunner().invoke(app, ["inspect", str(fmus("inertia", "3.0"))]).stdout
    assert "an assumption unless you have measured it" in shown
    assert "0.03 to 0.17" in shown.rpartition("mesh_damping is")[2]
    described = fmpy.read_model_description(str(fmus("inertia", "3.0"))).modelVariables
    (damping,) = (one for one in described if one.name == "mesh_damping")
    assert "an assumption" in damping.description
    assert damping.description.endswith("0.03 to 0.17")
    assert "mesh_damping is" not in CliRunner().invoke(app, ["inspect", str(fmus("kinematic", "3.0"))]).stdout


@pytest.mark.system
def test_a_state_restores_in_another_process_bit_by_bit(fmus, tmp_path):
    walk = """
def walk(fmu):
    put, get = fmu.writer(["flange_a.phi", "flange_a.w", "flange_b.tau"]), fmu.reader(
        ["flange_b.phi", "flange_b.w", "flange_a.tau", "backlash", "elastic_energy", "dissipated_energy"])
    found = []
    for i in range(15):
        put([0.02 * i, 20.0, 60.0 * (-1) ** i])
        fmu.step(i * 1e-3, 1e-3)
        found.append(get())
    return found
"""
    space = {}
    exec(walk, space)
    with open_fmu(fmus("inertia", "3.0")) as fmu:
        fmu.initialize({"flange_b.tau": 10.0, "friction_torque": 1.0, "mesh_damping": 3.0, "pin_radial_1_cos": 2e-6})
        space["walk"](fmu)
        kept = fmu.slave.getFMUState()
        (tmp_path / "state").write_bytes(fmu.slave.serializeFMUState(kept))
        first = space["walk"](fmu)
        fmu.slave.setFMUState(kept)
        assert space["walk"](fmu) == first
        fmu.slave.freeFMUState(kept)
    code = (
        walk
        + """
import json, sys
from cycloid_fmu.fmu.run import open_fmu
with open_fmu(sys.argv[1]) as fmu:
    fmu.initialize()
    fmu.slave.setFMUState(fmu.slave.deserializeFMUState(open(sys.argv[2], "rb").read()))
    print(json.dumps(walk(fmu)))
"""
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(fmus("inertia", "3.0")), str(tmp_path / "state")],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == first


def test_a_damaged_or_foreign_state_is_refused(fmus):
    slave, _ = loaded(fmus("kinematic", "3.0"))
    slave.exitInitializationMode()
    blob = slave.serializeFMUState(slave.getFMUState())
    assert state_to_bytes(state_from_bytes(blob)) == blob
    for place in (0, 16, 20, 24, 60, 100, len(blob) - 1):
        bad = bytearray(blob)
        bad[place] ^= 4
        with pytest.raises(ValueError, match="state"):
            state_from_bytes(bytes(bad))
    for bad in (b"", blob[:-1], blob + b"x", b"{}", MAGIC):
        with pytest.raises(ValueError, match="state"):
            state_from_bytes(bad)
    other, _ = loaded(fmus("inertia", "3.0"), "other")
    other.exitInitializationMode()
    with pytest.raises(FMICallException):
        other.setFMUState(other.deserializeFMUState(blob))
    other.doStep(0.0, 1e-3)
    freed(other)
    freed(slave)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_instances_come_go_and_reset(fmus, version):
    kept, v = loaded(fmus("kinematic", version), "kept")
    put = kept.setReal if version == "2.0" else kept.setFloat64
    get = kept.getReal if version == "2.0" else kept.getFloat64
    put([v["flange_a.phi"], v["flange_b.tau"]], [0.5, 80.0])
    kept.exitInitializationMode()
    first = get([v["flange_b.phi"]])
    for number in range(4):
        slave, _ = loaded(fmus("kinematic", version), str(number))
        slave.exitInitializationMode()
        slave.doStep(0.0, 1e-3)
        freed(slave)
    put([v["centre_distance_x"]], [9e-6])
    kept.doStep(0.0, 1e-3)
    assert get([v["flange_b.phi"]]) != first
    kept.reset()
    if version == "2.0":
        kept.setupExperiment(startTime=0.0)
    kept.enterInitializationMode()
    put([v["flange_a.phi"], v["flange_b.tau"]], [0.5, 80.0])
    kept.exitInitializationMode()
    assert get([v["flange_b.phi"]]) == first
    freed(kept)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_fmu_runs_from_a_folder_with_other_letters(fmus, tmp_path, version):
    found = []
    for folder in (None, str(tmp_path / "Gerät 100% 歯車 #1")):
        slave, v = loaded(fmus("kinematic", version), "é", folder=folder)
        new = version == "3.0"
        put, get = (slave.setFloat64, slave.getFloat64) if new else (slave.setReal, slave.getReal)
        put([v["flange_a.phi"], v["flange_b.tau"]], [0.5, 80.0])
        slave.exitInitializationMode()
        found.append(get([v["flange_b.phi"]]))
        freed(slave)
    assert found[0] == found[1]


@pytest.mark.slow(2)
def test_commands_lead_and_compare(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    assert command("cycloid-fmu", "build", "pair.toml", "-o", "k.fmu").returncode == 0
    built = command("cycloid-fmu", "build", "pair.toml", "-o", "c.fmu", "--interface", "compliant", "--fmi", "3.0")
    assert built.returncode == 0, built.stderr
    run = command("cycloid-fmu", "simulate", "k.fmu", "--torque", "100 N*m", "--samples", "120", "-o", "run.csv")
    assert run.returncode == 0, run.stderr
    # The compliant drive, led as the kinematic one moved, asks for the torque that moved that.
    led = command("cycloid-fmu", "simulate", "c.fmu", "--input", "run.csv", "--json", "--plot", "led.png")
    assert led.returncode == 0, led.stderr
    assert np.array(json.loads(led.stdout)["flange_b.tau"])[3:] == pytest.approx(100.0, rel=0.02)
    same = command("cycloid-fmu", "compare", "k.fmu", "run.csv", "--json", "--plot", "same.png")
    assert same.returncode == 0, same.stderr
    found = json.loads(same.stdout)
    assert found["transmission_error"]["largest"] < 1e-12
    assert (tmp_path / "same.png").stat().st_size > 5000
    both = command("cycloid-fmu", "compare", "k.fmu", "k.fmu", "--input", "run.csv", "--json")
    assert json.loads(both.stdout)["flange_b.phi"]["largest"] == 0.0
    names = ",".join(f"flange_{end}" for end in ("a.phi [rad]", "b.phi [rad]"))
    (tmp_path / "late.csv").write_text(f"time [s],{names}\n0,0,0\n0.002,0,0.1\n")
    for words, said in (
        (["compare", "k.fmu", "c.fmu", "--input", "run.csv"], "c.fmu: it has no input flange_b.tau, which k.fmu has"),
        (["compare", "k.fmu", "c.fmu"], "--input"),
        (["compare", "k.fmu", "pair.toml"], "pair.toml"),
        (["simulate", "c.fmu", "--torque", "5 N*m"], "c.fmu: this FMU has no"),
        (
            ["simulate", "c.fmu", "--input", "late.csv"],
            "c.fmu: the step from 0 s was refused: flange_b.phi is 0.01 rad from",
        ),
        (
            ["simulate", "k.fmu", "--torque", "1e9 N*m"],
            "k.fmu: the start was refused: flange_b.tau = 1e+09 N.m: no contacts of this drive can balance it.",
        ),
        (
            ["analyze", "pair.toml", "--torque", "1e9 N*m"],
            "torque = 1e+09 N*m: no contacts of this pair can balance it",
        ),
        (["simulate", "k.fmu"], "--torque"),
        (["simulate", "k.fmu", "--input", "none.csv"], "none.csv: No such file"),
        (["simulate", "k.fmu", "--input", "run.csv", "--turns", "2"], "--turns is not for --input"),
        (["build", "pair.toml", "-o", "x.fmu", "--interface", "stiff"], "kinematic, compliant"),
        (["build", "pair.toml", "-o", "x.fmu", "--fmi", "1.0"], "2.0, 3.0"),
        (["build", "pair.toml", "-o", "x.fmu", "--output-inertia", "1 kg*m^2"], "--output-inertia is only for"),
        (["build", "pair.toml", "-o", "x.fmu", "--interface", "compliant", "--output-inertia", "1 kg"], "kg*m^2"),
    ):
        refused = command("cycloid-fmu", *words)
        assert refused.returncode == 2, words
        assert said in refused.stderr
        assert len(refused.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x.fmu").exists()
    for words, said in (
        (["c.fmu", "--torque", "5 N*m"], "c.fmu: the bench needs a kinematic FMI 2.0 co-simulation FMU of a drive"),
        (["k.fmu", "--torque", "1e9 N*m"], "k.fmu: the run was refused: flange_b.tau = 1e+09 N.m: no contacts of"),
    ):
        refused = command("cycloid-bench", "simulate", "-o", "run.arrows", "--fmu", *words)
        assert refused.returncode == 2, words
        assert refused.stderr.startswith(said), refused.stderr
        assert len(refused.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run.arrows").exists()


def test_an_fmu_compares_with_a_recording(command, tmp_path):
    """A recording's zero is its encoder's: the mean is that, the rest is the transmission error's own."""
    (tmp_path / "pair.toml").write_text(PAIR)
    command("cycloid-fmu", "build", "pair.toml", "-o", "k.fmu")
    angle = np.linspace(0.0, 6.0, 50)
    pair = parse_pair(PAIR, "p")
    lines = [f"{i * 1e-3},{a},{np.degrees(a / pair.ratio) + 1.0},50" for i, a in enumerate(angle)]
    header = "time [s],input_angle [rad],output_angle [deg],torque [N*m]\n"
    (tmp_path / "r.csv").write_text(header + "\n".join(lines))
    run = command("cycloid-fmu", "compare", "k.fmu", "r.csv", "--json")
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)["flange_b.phi"]
    assert found["mean"] == pytest.approx(-np.radians(1.0), abs=1e-4)
    assert found["rms_about_mean"] < 1e-6


def test_the_library_itself_tells_a_pair_a_drive_and_a_reducer_apart(tmp_path):
    """The same pair gives the same file as a pair with its surface or as a drive; a reducer's input is the sun."""
    drive = cy.Drive(ERRORS)
    build_fmu(drive, tmp_path / "drive.fmu", fmi_version="3.0")
    build_fmu(DriveValue.as_stated(ERRORS), tmp_path / "pair.fmu", fmi_version="3.0")
    drive.build_fmu(tmp_path / "method.fmu", "kinematic", fmi_version="3.0")
    drive.build_fmu(tmp_path / "compliant.fmu", Interface("compliant", 0.5), fmi_version="3.0")
    build_fmu(cy.Drive(read_reducer(EXAMPLES / "rv-20e.toml")), tmp_path / "reducer.fmu", fmi_version="3.0")
    inputs = {
        path.stem: [v for v in fmpy.read_model_description(str(path)).modelVariables if v.causality == "input"]
        for path in tmp_path.glob("*.fmu")
    }
    names = {stem: [v.name for v in found] for stem, found in inputs.items()}
    assert names["drive"] == names["pair"] == names["method"] == names["reducer"] == names["compliant"]
    assert {stem for stem, found in inputs.items() if found[0].description.startswith("sun")} == {"reducer"}
    model = {stem: zipfile.ZipFile(tmp_path / f"{stem}.fmu").read("resources/pair.json") for stem in ("drive", "pair")}
    assert model["drive"] == model["pair"]


@pytest.mark.parametrize(
    ("interface", "argument"),
    [
        ("stiff", "interface"),
        (Interface("kinematic", 1.0), "output_inertia"),
        (Interface("compliant", -1.0), "output_"),
        (Interface(losses=((1.0, 1.0, 1.0, 0.0, 0.0),)), r"loss_table\[1,1\]"),
    ],
)
def test_errors_name_the_argument_and_leave_no_file(tmp_path, interface, argument):
    with pytest.raises(cy.InputError, match=f"^{argument}"):
        cy.Drive(ERRORS).build_fmu(tmp_path / "d.fmu", interface)
    assert not list(tmp_path.iterdir())
