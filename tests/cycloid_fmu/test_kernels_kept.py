"""Kernels are kept on disk where a folder can be written, and compiled by each process where none can."""

import ast
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from common import CASES, DATA, EXAMPLES
from numba.core import caching

import cycloid_fmu
from cycloid_fmu import edge
from cycloid_fmu.contact import compiling
from cycloid_fmu.edge import kernels


@pytest.fixture
def no_folder(monkeypatch):
    """What numba finds where neither the installation nor the user's cache can be written."""
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    kernels._say.cache_clear()
    yield
    kernels._say.cache_clear()


@pytest.mark.usefixtures("no_folder")
def test_without_a_folder_a_kernel_is_compiled_and_that_is_said_once():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        square = compiling.compiled(lambda x: x * x)
        cube = kernels.kept_njit(fastmath=True)(lambda x: x * x * x)
        assert (square(3.0), cube(3.0)) == (9.0, 27.0)
    assert [one.category for one in said] == [edge.InputWarning]
    assert "Set NUMBA_CACHE_DIR to a folder" in str(said[0].message)


@pytest.mark.slow(40)
def test_a_command_runs_where_nothing_can_be_written(tmp_path, command):
    """As with an installed package of another user, and a home that can't be written."""
    (tmp_path / "drive.toml").write_bytes((EXAMPLES / "drive-39-40.toml").read_bytes())
    words = ["cycloid-fmu", "analyze", "drive.toml", "--torque", "181 N*m", "--json"]
    kept = command(*words)
    environment = {**os.environ, "NUMBA_CACHE_LOCATOR_CLASSES": "ZipCacheLocator", "XDG_CACHE_HOME": os.devnull}
    code = f"import sys; sys.argv = {words!r}; from cycloid_fmu.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    assert (done.returncode, done.stdout) == (0, kept.stdout)
    assert len(re.findall("NUMBA_CACHE_DIR", done.stderr)) == 1


@pytest.mark.system
@pytest.mark.skipif(compiling.internals is None, reason="numba alone reads the types before it compares the sources")
def test_what_an_earlier_version_kept_is_compiled_again(tmp_path):
    """Its kernels may take types that are gone: the folder of an installation outlives an update."""
    module = tmp_path / "kernels_of_versions.py"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
    for version, factor in (("Earlier", 2.0), ("Later", 3.0)):
        module.write_text(
            "from typing import NamedTuple\nfrom cycloid_fmu.contact import compiled\n"
            f"class {version}(NamedTuple):\n    x: float\n"
            f"@compiled\ndef times(given):\n    return {factor} * given.x\n"
            f"print(times({version}(5.0)))\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", "import kernels_of_versions"],
            cwd=tmp_path,
            env={**environment, "PYTHONPATH": os.pathsep.join([str(tmp_path), environment.get("PYTHONPATH", "")])},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert (done.stdout.strip(), done.returncode) == (str(5.0 * factor), 0), done.stderr


@pytest.mark.slow(30)
@pytest.mark.parametrize("plain", ["0", "1"])
def test_a_kernel_is_compiled_again_when_one_that_it_calls_changes(tmp_path, plain):
    """The other's file is unchanged, and the changed one has the size and the time of before."""
    package, folder = Path(cycloid_fmu.__file__).parent, tmp_path / "changed"
    shutil.copytree(package, folder / "cycloid_fmu", ignore=shutil.ignore_patterns("__pycache__"))
    called = folder / "cycloid_fmu" / "contact" / "lanes.py"
    settings = {
        **os.environ,
        "CYCLOID_PLAIN_NUMBA": plain,
        "NUMBA_CACHE_DIR": str(tmp_path / "kept"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": str(folder),
    }
    code = "from cycloid_fmu.contact.hertz import hertz; print(*hertz(1e-6, 100.0, 3e-3, 0.01, 4e-12, 4e-12, 0.1))"

    def force():
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=settings, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return float(done.stdout.split()[0])

    before, times = force(), called.stat()
    assert force() == before
    text = called.read_text(encoding="utf-8")
    changed = text.replace("_LN2 = 6.93", "_LN2 = 6.94")
    assert len(changed) == len(text)
    assert changed != text
    called.write_text(changed, encoding="utf-8")
    os.utime(called, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert force() != before


def test_constants_of_kernels_come_from_files_that_they_are_kept_by():
    package = Path(cycloid_fmu.__file__).parent
    kernel_files = [file for file in compiling.KERNEL_FILES if "import" in file.read_text(encoding="utf-8")]
    for file in kernel_files:
        text = file.read_text(encoding="utf-8")
        if re.search(r"^@compiled", text, re.M):
            for node in ast.walk(ast.parse(text)):
                if (
                    isinstance(node, ast.ImportFrom)
                    and any(alias.name.isupper() for alias in node.names)
                    and node.module != "typing"
                ):
                    source = package.parent.joinpath(*node.module.split(".")).with_suffix(".py")
                    assert source in compiling.KERNEL_FILES, f"{file.name} takes constants of {node.module}"


@pytest.mark.slow(300)
@pytest.mark.skipif(compiling.internals is None, reason="there are no two ways")
def test_an_exact_fmu_runs_alike_with_public_names_of_numba_alone(tmp_path):
    """The same contacts, inertias and friction, on rigid and on elastic bearings, over a ramp of the speed."""
    code = f"""
import sys
import numpy as np
from cycloid_fmu.contact import compiling
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import simulate
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.pair import read_pair
print(compiling.internals is None, file=sys.stderr)
time = np.linspace(0.0, 0.05, 26)
inputs = {{"flange_a.phi": 400.0 * time**2, "flange_a.w": 800.0 * time, "flange_b.tau": 2000.0 * time}}
for path in ({str(CASES / "errors-39-40.toml")!r}, {str(DATA / "supports-cases" / "rollers.toml")!r}):
    drive = DriveValue.as_stated(read_pair(path))
    for interface in (Interface("kinematic"), Interface("compliant", output_inertia=0.05)):
        build_fmu(drive, "drive.fmu", interface=interface)
        outputs = ("flange_b.phi", "flange_a.tau", "torsional_stiffness", "max_contact_pressure")
        for name, values in simulate("drive.fmu", inputs, outputs, time).items():
            print(name, *(value.hex() for value in values.tolist()))
"""
    shown = []
    for plain in ("0", "1"):
        settings = {**os.environ, "CYCLOID_PLAIN_NUMBA": plain}
        run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=settings, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        assert str(plain == "1") in run.stderr.split()
        shown.append([(name, *map(float.fromhex, values)) for name, *values in map(str.split, run.stdout.splitlines())])
    assert len(shown[0]) == 16
    for (name, *private), (_, *public) in zip(*shown, strict=True):
        # Sums are in another order, and a balance on bearings ends within 1e-6 N of forces of some 100 N.
        assert public == pytest.approx(private, rel=1e-8, abs=1e-9 * max(map(abs, private))), name
