"""What is published: the source archive, the wheel, and that the wheel alone is enough."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import fmpy
import pytest
from common import ARCSEC, BENCH, CASES

ROOT = Path(__file__).parent.parent
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PYTHONS = [
    python
    for python in (shutil.which(f"python3.{minor}") for minor in (11, 12, 13))
    if python and subprocess.run([python, "-c", ""], capture_output=True).returncode == 0
]

pytestmark = pytest.mark.slow


def build(source, folder, *kinds):
    """Build with the tools that are installed, so that nothing is downloaded."""
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), *kinds, str(source)],
        check=True, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """The source archive, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("published")
    build(ROOT, folder)
    return folder / f"cycloid_fmu-{VERSION}.tar.gz", folder / f"cycloid_fmu-{VERSION}-py3-none-any.whl"


def files_of_wheel(path):
    with zipfile.ZipFile(path) as wheel:
        return {name: hashlib.sha256(wheel.read(name)).hexdigest() for name in wheel.namelist()}


def test_the_index_would_take_both(published):
    run = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *map(str, published)], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout + run.stderr


def test_the_source_archive_is_the_repository(published):
    known = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    )
    with tarfile.open(published[0]) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()} - {"PKG-INFO"}
    if known.returncode == 0:
        assert held == set(known.stdout.splitlines())
    assert {"tests/test_packaging.py", "CITATION.cff", ".ci/run", "docs/index.md", "examples/bench_to_fmu.py"} <= held


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
            cwd=tmp_path, env=settings, capture_output=True, text=True, timeout=1800,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    case = CASES / "error-free-39-40.toml"
    run("cycloid-fmu", "build", case, "-o", "drive.fmu")
    assert fmpy.read_model_description(str(tmp_path / "drive.fmu")).version == VERSION
    if python == PYTHONS[-1]:  # in the newest alone: all kernels are compiled, behind the FMI calls
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
    assert run("cycloid-bench", "list").startswith("protocols: ads, amt21, ascii, canopen, dbc, modbus\n")
