"""Kernels are kept on disk where a folder can be written, and compiled by each process where none can."""

import os
import re
import subprocess
import sys
import warnings

import pytest
from common import EXAMPLES
from numba.core import caching

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
