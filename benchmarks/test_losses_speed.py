"""A crank angle with friction against one without, in the same run; processor time."""

import time

import numpy as np
import pytest
from common import DATA

import cycloid_fmu as cy
from cycloid_fmu.analysis import solve as frictionless
from cycloid_fmu.losses.sensitivity import sensitivity
from cycloid_fmu.losses.solver import solve

ANGLES = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
pytestmark = pytest.mark.benchmark(timer=time.process_time)


def _median(call, rounds=9):
    took = []
    for _ in range(rounds):
        begin = time.process_time()
        call()
        took.append(time.process_time() - begin)
    return float(np.median(took))


@pytest.mark.parametrize("name", ["cranks-fixed-pins", "output-sleeves", "printed-self-locking"])
def test_a_crank_angle_with_friction(benchmark, name):
    drive = cy.read_drive(DATA / "losses-cases" / f"{name}.toml")
    load = np.array([drive.pair.rated_torque])
    frictionless(drive, load, ANGLES[:3], with_play=False)  # compile
    found = solve(drive, load, ANGLES[:3], 1, 60.0)
    sensitivity(drive, found)
    benchmark(solve, drive, load, ANGLES, 1, 60.0)
    mine = benchmark.stats.stats.median
    ratio = mine / _median(lambda: frictionless(drive, load, ANGLES, with_play=False))
    found = solve(drive, load, ANGLES, 1, 60.0)
    benchmark.extra_info["µs a crank angle"] = round(mine / ANGLES.size * 1e6, 1)
    benchmark.extra_info["times one without friction"] = round(ratio, 2)
    benchmark.extra_info["µs for all derivatives"] = round(
        _median(lambda: sensitivity(drive, found)) / ANGLES.size * 1e6, 1
    )
    assert ratio < 2.5
