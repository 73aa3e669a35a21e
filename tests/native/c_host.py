"""What the tests of the native FMU share: its interfaces, and how C is compiled beside it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.native import build as native_build

HERE = Path(__file__).parent
INTERFACES = {
    "kinematic": Interface(losses=((0.0, 0.9, 0.85, 0.01, 0.02), (100.0, 0.95, 0.9, 0.02, 0.03))),
    "compliant": Interface("compliant"),
    "inertia": Interface("compliant", 0.5),
}


# The system's compiler where there is one: it is done sooner than zig, which the tests bring along.
COMPILER = ("cc",) if shutil.which("cc") else (sys.executable, "-m", "ziglang", "cc")


def zig(platform):
    """Command of zig's compiler for one of `native_build.PLATFORMS`."""
    return (sys.executable, "-m", "ziglang", "cc", "-target", native_build.PLATFORMS[platform].target)


def compiled(target, sources, *flags, compiler=COMPILER):
    """Compile C sources with FMI's headers."""
    include = ["-I", str(native_build.headers()), "-I", str(HERE.parents[1] / "cycloid_fmu" / "native" / "sources")]
    libraries = [] if target.suffix == ".exe" else ["-ldl", "-lm"]
    subprocess.run(
        [*compiler, "-std=c99", "-g", *flags, *include, *map(str, sources), "-o", str(target), *libraries],
        check=True,
    )  # fmt: skip
    return target


def run_host(program, library, uri, guid, *words, prefix=(), **environment):
    """Run the C host."""
    return subprocess.run(
        [*prefix, str(program), str(library), uri, guid, *map(str, words)], capture_output=True, text=True,
        timeout=900, env={**os.environ, **environment}, check=False,
    )  # fmt: skip


def needs(program):
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"{program} is not installed")


WINE = shutil.which("wine64") or "/usr/lib/wine/wine64"
needs_wine = pytest.mark.skipif(not os.path.exists(WINE), reason="wine64 is not installed")
