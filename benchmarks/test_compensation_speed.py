"""Time of a compensator's step in C: the longest call of a motion, with an output encoder and without."""

import math
import subprocess
import sys

import numpy as np
import pytest
from common import EXAMPLES

import cycloid_fmu as cy
from cycloid_fmu.compensation.compensator import Memory, step

sys.path.insert(0, str(EXAMPLES.parent / "tests" / "native"))
from compensators import NONE
from test_compensation_forms import host

ROUNDS = 300
ALLOWED = 500.0  # ns, including the call of the clock


@pytest.fixture(scope="module")
def compensator():
    friction = cy.Friction(coulomb=2.0, load_share=0.02, stribeck=0.5, viscous=0.1, temperature_coefficient=0.01)
    return cy.read_drive(EXAMPLES / "drive-39-40-as-made.toml").compensator(friction=friction, series_compliance=1e-6)


def motion(c, *, measured):
    """Back and forth by 86° of the output under a load that changes with place and direction; an encoder's readings."""
    random, rows, motor, before, memory = np.random.default_rng(1), [], NONE, 0.0, Memory()
    for t in np.linspace(0.0, 8.0 * math.pi, 2000):
        angle, speed = 1.5 * math.sin(t), 1.5 * math.cos(t)
        load = 170.0 * math.cos(3.0 * angle) * np.sign(speed)
        shown = before + 1e-6 * random.standard_normal() if measured else NONE
        rows.append([angle, speed, load, 300.0, motor, shown])
        motor, before = step(c, memory, *rows[-1]).motor_angle, angle
    return np.array(rows)


@pytest.mark.parametrize(
    "compiler", [("gcc",), ("clang",), (sys.executable, "-m", "ziglang", "cc")], ids=lambda c: c[-1]
)
@pytest.mark.parametrize("measured", [False, True])
def test_worst_step(benchmark, compensator, tmp_path, compiler, measured):
    """Each call is timed in 300 rounds and its least time used: interruptions are not part of the step."""
    timed = (*compiler, f"-DTIMED={ROUNDS}", "-D_POSIX_C_SOURCE=199309L")
    program = host(compensator, motion(compensator, measured=measured), 0.0, tmp_path, timed, "-lm")
    call = {"capture_output": True, "text": True, "check": True}
    done = benchmark.pedantic(subprocess.run, ([program],), call, rounds=1)
    clock, *spent = map(float, done.stdout.split())
    benchmark.extra_info["ns of a call, median and longest"] = f"{np.median(spent):.0f}, {max(spent):.0f}"
    benchmark.extra_info["of which the clock takes"] = f"{clock:.0f}"
    assert max(spent) < ALLOWED
