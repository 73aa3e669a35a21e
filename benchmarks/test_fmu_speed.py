"""A step of the FMU through fmpy, and how long a fresh process takes to have one ready."""

import json
import subprocess
import sys

import fmpy
import pytest
from common import CASES
from fmpy.fmi2 import FMU2Slave

from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.pair import read_pair
from cycloid_fmu.surface import surface_of_pair

START = """
import json, sys, time
import fmpy
from fmpy.fmi2 import FMU2Slave
path = sys.argv[1]
description = fmpy.read_model_description(path, validate=False)
v = {m.name: m.valueReference for m in description.modelVariables}
folder = fmpy.extract(path)
begin = time.perf_counter()
slave = FMU2Slave(guid=description.guid, unzipDirectory=folder, instanceName="one",
                  modelIdentifier=description.coSimulation.modelIdentifier)
slave.instantiate()
slave.setupExperiment(startTime=0.0)
slave.enterInitializationMode()
slave.setReal([v["flange_a.phi"], v["flange_b.tau"]], [0.0, 100.0])
slave.exitInitializationMode()
print(json.dumps(time.perf_counter() - begin))
"""


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    path = tmp_path_factory.mktemp("fmu") / "drive.fmu"
    pair = read_pair(CASES / "errors-39-40.toml")
    build_fmu(pair, surface_of_pair(pair), path)
    return path


def test_set_step_get(benchmark, fmu):
    description = fmpy.read_model_description(str(fmu))
    v = {m.name: m.valueReference for m in description.modelVariables}
    slave = FMU2Slave(
        guid=description.guid, unzipDirectory=fmpy.extract(str(fmu)), instanceName="one",
        modelIdentifier=description.coSimulation.modelIdentifier,
    )  # fmt: skip
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    inputs, outputs = [v["flange_a.phi"], v["flange_b.tau"]], [v["flange_b.phi"]]
    angle = iter(range(10**9))

    def round_trip():
        slave.setReal(inputs, [next(angle) * 1e-3, -120.0])
        slave.doStep(0.0, 1e-3)
        return slave.getReal(outputs)

    benchmark(round_trip)
    slave.terminate()
    slave.freeInstance()


def test_ready_in_a_fresh_process(benchmark, fmu):
    def ready():
        run = subprocess.run([sys.executable, "-c", START, str(fmu)], capture_output=True, check=True)
        return json.loads(run.stdout)

    ready()  # fills numba's cache
    inside = []
    benchmark.pedantic(lambda: inside.append(ready()), rounds=5)
    benchmark.extra_info["s from instantiate to initialised"] = round(sorted(inside)[len(inside) // 2], 3)
