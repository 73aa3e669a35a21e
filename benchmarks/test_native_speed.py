"""How fast tables are computed, and how fast a native FMU steps, in the C host and through fmpy.

The latter is compared with an FMU that does nothing.
"""

import re
import statistics
import time

import fmpy
import numpy as np
import pytest
from common import EXAMPLES
from fmpy.fmi2 import FMU2Slave
from native.c_host import HERE, compiled, run_host

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.fmu import tables
from cycloid_fmu.fmu.library import headers, this_platform
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair

STEPS = 20_000

EMPTY = """
#include "fmi2FunctionTypes.h"
static double values[16];
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[])
{ for (size_t i = 0; i < n; i++) values[r[i] & 15] = v[i]; return fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[])
{ for (size_t i = 0; i < n; i++) v[i] = values[r[i] & 15]; return fmi2OK; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean n) { return fmi2OK; }
void *fmi2Instantiate(void) { return values; }
"""
GIVEN = ("fmi2SetReal", "fmi2GetReal", "fmi2DoStep", "fmi2Instantiate")


@pytest.mark.parametrize("which", ["as made", "2 um on every pin", "2 um on every pin and tooth"])
def test_tables(benchmark, which):
    """Tables of drives with errors on one thread; the last takes a minute."""
    pair = read_pair(EXAMPLES / ("drive-39-40-as-made.toml" if which == "as made" else "drive-39-40.toml"))
    surface, random = surface_of_pair(pair), np.random.default_rng(2)
    for name in ("pin_radial", "tooth_cumulative_pitch")[: which.count("pin") + which.count("tooth")]:
        surface = surface.replace(**{name: 2e-6 * random.normal(size=getattr(surface, name).shape)})
    tables.compute(DriveValue.as_stated(pair.nominal))  # compile
    begun = time.process_time()
    made = benchmark.pedantic(tables.compute, (DriveValue(pair, surface),), rounds=1)
    benchmark.extra_info["processor seconds"] = round(time.process_time() - begun, 1)
    benchmark.extra_info["accuracy"] = made.accuracy


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    """The drive of the examples as a native FMU, unpacked."""
    folder = tmp_path_factory.mktemp("native")
    pair = read_pair(EXAMPLES / "drive-39-40.toml")
    native_build.build_native(DriveValue.as_stated(pair), folder / "drive.fmu", platforms=[this_platform()])
    fmpy.extract(str(folder / "drive.fmu"), unzipdir=str(folder))
    return folder


def nanoseconds(folder, guid):
    """CPU time of a set-step-get through fmpy."""
    slave = FMU2Slave(guid=guid, unzipDirectory=str(folder), modelIdentifier="CycloidDrive", instanceName="drive")
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    begun = time.process_time_ns()
    for i in range(STEPS):
        slave.setReal([0, 1, 2], [1e-3 * i, 1.0, 50.0])
        slave.doStep(1e-3 * i, 1e-3)
        slave.getReal([3, 4])
    spent = time.process_time_ns() - begun
    slave.terminate()
    slave.freeInstance()
    return spent / STEPS


def test_step_through_fmpy(benchmark, native, tmp_path):
    """Against a native FMU whose functions only store their arguments."""
    names = re.findall(r"TYPE +(fmi2\w+);", (headers() / "fmi2Functions.h").read_text())
    others = "\n".join(f"int {name}(void) {{ return 0; }}" for name in names if name not in GIVEN)
    (tmp_path / "empty.c").write_text(EMPTY + others)
    library = tmp_path / "binaries" / "linux64" / "CycloidDrive.so"
    library.parent.mkdir(parents=True)
    compiled(library, [tmp_path / "empty.c"], "-O2", "-shared", "-fPIC")
    guid = fmpy.read_model_description(str(native / "drive.fmu")).guid
    ratios = [nanoseconds(native, guid) / nanoseconds(tmp_path, "") for _ in range(9)]
    benchmark.extra_info["of an empty FMU's time"] = f"{statistics.median(ratios):.3f}"
    benchmark.pedantic(nanoseconds, args=(native, guid), rounds=3)


def test_step_in_the_c_host(benchmark, native, tmp_path):
    """Set three inputs, step, get angle and speed; CPU time that the host measures over a million steps."""
    program = compiled(tmp_path / "host", [HERE / "host.c"], "-O2")
    guid = fmpy.read_model_description(str(native / "drive.fmu")).guid
    library, uri = native / "binaries" / "linux64" / "CycloidDrive.so", (native / "resources").as_uri()

    def once():
        return float(
            re.match(r"[\d.]+", run_host(program, library, uri, guid, "kinematic", "time", 1_000_000).stdout)[0]
        )

    benchmark.extra_info["ns a step"] = f"{statistics.median(once() for _ in range(5)):.0f}"
    benchmark.pedantic(once, rounds=1)
