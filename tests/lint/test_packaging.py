"""Published files: the source archive and the wheel, which needs nothing else."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import fmpy
import pytest
from common import ARCSEC, BENCH, CASES, EXAMPLES

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = PROJECT["version"]
PYTHONS = [
    python
    for python in (shutil.which(f"python3.{minor}") for minor in (11, 12, 13))
    if python and subprocess.run([python, "-c", ""], capture_output=True).returncode == 0
]


def build(source, folder, *kinds):
    """Build with the tools that are installed, so that nothing is downloaded."""
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), *kinds, str(source)],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """The source archive, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("published")
    build(ROOT, folder)
    return folder / f"cycloid_fmu-{VERSION}.tar.gz", folder / f"cycloid_fmu-{VERSION}-py3-none-any.whl"


def files_of_wheel(path):
    with zipfile.ZipFile(path) as wheel:
        return {name: hashlib.sha256(wheel.read(name)).hexdigest() for name in wheel.namelist()}


@pytest.mark.slow
def test_the_index_would_take_both(published):
    run = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *map(str, published)], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.slow
def test_the_source_archive_is_the_repository(published):
    known = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    )
    with tarfile.open(published[0]) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()} - {"PKG-INFO"}
    if known.returncode == 0:
        assert held == set(known.stdout.splitlines())
    assert {"tests/lint/test_packaging.py", "studies/README.md", ".ci/run", "docs/index.md"} <= held


@pytest.mark.slow
def test_archive_and_repository_build_the_same_wheel(published, tmp_path):
    build(ROOT, tmp_path, "--wheel")
    assert files_of_wheel(tmp_path / published[1].name) == files_of_wheel(published[1])


def installed(folder, wheel, python):
    """Install a wheel and all that it asks for in an empty environment; return where its commands are.

    Where other Pythons show that it asks for all, this one has the wheel alone, before what the suite is run with.
    """
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-compile", "--no-deps", "--target", str(folder)]
    scripts = folder / "bin"
    if len(PYTHONS) == 1 or not python.endswith(f".{sys.version_info.minor}"):
        subprocess.run([python, "-m", "venv", str(folder)], check=True, timeout=300)
        scripts = folder / ("Scripts" if os.name == "nt" else "bin")
        pip = [str(scripts / "python"), "-m", "pip", "install", "-q", "--no-compile"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True, timeout=1800)
    return scripts


@pytest.mark.slow(90)
@pytest.mark.parametrize("python", PYTHONS, ids=lambda path: Path(path).name)
def test_the_wheel_alone_runs_the_three_commands(published, python, tmp_path):
    folder = tmp_path / "environment"
    scripts = installed(folder, published[1], python)
    settings = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"PYTHONPATH": str(folder)}

    def run(*words):
        done = subprocess.run(
            [str(scripts / words[0]), *map(str, words[1:])],
            cwd=tmp_path,
            env=settings,
            capture_output=True,
            text=True,
            timeout=1800,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    case = CASES / "error-free-39-40.toml"
    run("cycloid-fmu", "build", case, "-o", "drive.fmu")
    assert fmpy.read_model_description(str(tmp_path / "drive.fmu")).version == VERSION
    if python == PYTHONS[-1]:  # only in the newest: all kernels are compiled, behind the FMI calls
        wanted = json.loads(case.with_suffix(".json").read_text())
        result = wanted["results"][0]
        load = f"{result['torque']:g} N*m"
        found = json.loads(
            run("cycloid-fmu", "simulate", "drive.fmu", "--torque", load, "--turns", 37, "--samples", 16, "--json")
        )
        assert found["flange_a.phi"][: 39 * 16 : 39] == pytest.approx(wanted["crank_angle"])
        error = found["transmission_error"][: 39 * 16 : 39]
        assert error == pytest.approx(result["transmission_error"], abs=0.01 * ARCSEC)

    curves = run("cycloid-fit", "curve", BENCH / "30Nm-forward.csv", "--pair", BENCH / "pair.toml", "--json")
    assert json.loads(curves)
    listed = run("cycloid-bench", "list").splitlines()[0]
    assert listed == "protocols: amt21, ascii, canopen, dbc, modbus, moteus, odrive, simplefoc"


@pytest.fixture
def licences(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import licences

    return licences


def test_the_page_lists_every_extra_with_its_packages(licences):
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    listed = {
        extra: re.findall(r"[\w-]+", packages)
        for extra, packages in re.findall(r"^\| `([\w-]+)` \| (.*?) \|", page, re.M)
    }
    stated = {
        extra: [re.split("[>=<~]", one)[0] for one in asked]
        for extra, asked in PROJECT["optional-dependencies"].items()
        if extra not in licences.OURS
    }
    assert listed == stated


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    """A fresh environment's Python, with the package and what it asks for without any extra.

    The suite's requirements are linked into it: nothing is downloaded.
    """
    sys.path.insert(0, str(ROOT / "docs"))
    import licences

    sys.path.remove(str(ROOT / "docs"))
    folder = tmp_path_factory.mktemp("core") / "environment"
    venv.create(folder, symlinks=True)
    (place,) = folder.glob("lib/python3.*/site-packages")
    for name in ("cycloid-fmu", *(one for one, extra in licences.needed().items() if not extra)):
        one = metadata.distribution(name)
        for top in {file.parts[0] for file in one.files or []} - {"..", "__pycache__"}:
            if not (place / top).exists():
                (place / top).symlink_to(one.locate_file(top))
    return folder / "bin" / "python"


def run_core(core, folder, *words):
    """Run Python code, or one of the commands, in the fresh environment."""
    code = words[0]
    if code.startswith("cycloid-"):
        (entry,) = metadata.entry_points(group="console_scripts", name=code)
        code = (
            f"import sys; sys.argv[0] = {words[0]!r}; from {entry.module} import {entry.attr}; sys.exit({entry.attr}())"
        )
    return subprocess.run(
        [str(core), "-c", code, *map(str, words[1:])], cwd=folder, capture_output=True, text=True, timeout=300
    )


DOORS = """
import importlib
from typer.main import get_command
from typer.testing import CliRunner

def pages(app, command, path):
    below = getattr(command, "commands", {})
    done = CliRunner().invoke(app, [*path, "--help"])
    assert done.exit_code == 0 and "Usage" in done.output, (path, done.output)
    return 1 + sum(pages(app, one, [*path, name]) for name, one in below.items())

for door in ("cycloid_fmu", "fitting", "drivers"):
    module = importlib.import_module(door)
    assert [name for name in module.__all__ if getattr(module, name) is None] == []
    app = importlib.import_module(f"{door}.cli").app
    print(door, pages(app, get_command(app), []))
"""


@pytest.mark.slow(10)
def test_front_doors_and_help_pages_need_no_extra(core, tmp_path):
    done = run_core(core, tmp_path, DOORS)
    assert done.returncode == 0, done.stderr
    assert {line.split()[0]: int(line.split()[1]) > 7 for line in done.stdout.splitlines()} == {
        "cycloid_fmu": True,
        "fitting": True,
        "drivers": True,
    }


LINE = '[port.tty]\nurl = "/dev/null"\n[channel.input_angle]\nport = "tty"\ncounts_per_turn = 4096\n'
CAN = '[bus.can0]\ninterface = "virtual"\nchannel = "core"\n[channel.input_angle]\nbus = "can0"\n'
DRIVE, TOLERANCES = EXAMPLES / "drive-39-40.toml", EXAMPLES / "tolerances.toml"
RECORD = ("cycloid-bench", "record", "bench.toml", "-o", "run.arrows")
SIMULATE = ("cycloid-bench", "simulate", "--ratio", "-39", "--torque", "20 N*m")
STUDY = ("cycloid-fmu", "tolerance", DRIVE, "--tolerances", TOLERANCES, "-o", "study.nc")
# Only Python has influence matrices yet.
BODIES = """
import sys
import cycloid_fmu as cy
from cycloid_fmu.geometry.bodies import Bodies

supports = {"kind": "cranks", "count": 3, "circle_radius": "28.5 mm"}
sizes = {"pin_circle_radius": "52 mm", "pin_radius": "2 mm", "eccentricity": "0.9 mm", "face_width": "10 mm"}
pair = cy.Pair(gear_teeth=39, supports=supports, **sizes)
try:
    cy.Drive(pair).influence(bodies=Bodies(disc={"bore_radius": "12.5 mm"}))
except cy.InputError as refused:
    print(refused, file=sys.stderr)
    sys.exit(refused.status)
"""
# Uses of an extra: the input files, the missing package, and the command.
TAKES = {
    "bench": [
        ({"bench.toml": CAN + 'protocol = "canopen"\nnode = 1\n'}, "canopen", RECORD),
        ({"bench.toml": CAN + 'protocol = "dbc"\nfile = "a"\nmessage = "m"\nsignal = "s"\n'}, "canopen", RECORD),
        ({"bench.toml": CAN + 'protocol = "odrive"\nnode = 1\n'}, "canopen", RECORD),
        ({"bench.toml": LINE + 'protocol = "modbus"\nregister = 0\n'}, "pymodbus", RECORD),
        ({}, "canopen", SIMULATE),
        ({"bus.toml": 'format = "cycloid-simulation/1"\n[modbus]\n'}, "pymodbus", (*SIMULATE, "--bus", "bus.toml")),
    ],
    "bench-files": [
        ({"run.tdms": "x"}, "nptdms", ("cycloid-fit", "inspect", "run.tdms")),
        ({"run.mf4": "x"}, "asammdf", ("cycloid-fit", "inspect", "run.mf4")),
        ({"run.asc": "x", "run.dbc": "x"}, "cantools", ("cycloid-fit", "inspect", "run.asc", "--dbc", "run.dbc")),
    ],
    "bodies": [({}, "skfem", (BODIES,))],
    "cad": [({}, "ezdxf", ("cycloid-fmu", "profile", DRIVE, "-o", "disc.dxf"))],
    "distributed": [({}, "distributed", (*STUDY, "--samples", "64", "--scheduler", "tcp://127.0.0.1:1"))],
    "reports": [
        ({}, "plotly", ("cycloid-fit", "report", BENCH / "30Nm-forward.csv", "--ratio", "-39", "-o", "r.html"))
    ],
    "sensitivity": [({}, "SALib", (*STUDY, "--samples", "256", "--design", "saltelli"))],
    "step": [({}, "OCP", ("cycloid-fmu", "profile", DRIVE, "-o", "disc.step"))],
}


def test_each_extra_is_tried_without_its_packages(licences):
    assert set(TAKES) == set(PROJECT["optional-dependencies"]) - licences.OURS


@pytest.mark.slow(25)
@pytest.mark.parametrize("extra", TAKES)
def test_what_takes_an_extra_names_it(core, tmp_path, extra):
    for files, package, words in TAKES[extra]:
        for name, text in files.items():
            wiring = name.endswith(".toml") and "format" not in text
            (tmp_path / name).write_text('format = "cycloid-bench/1"\n' * wiring + text, encoding="utf-8")
        done = run_core(core, tmp_path, *words)
        assert (done.returncode, done.stdout) == (2, "")
        assert f"this needs the package {package}: pip install 'cycloid-fmu[{extra}]'" in done.stderr
        assert done.stderr.count("\n") == 1, done.stderr
