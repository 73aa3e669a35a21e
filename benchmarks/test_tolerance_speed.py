"""Tolerance studies: drives per second, two workers over one, and the cost of a task on a dask cluster.

The baseline is the exact sweep called in a Python loop, one drive after the other; all ratios are of one session and in
`extra_info`. Processor time is stated too, because other work on the machine changes it little.
"""

import dataclasses
import resource
import time

import numpy as np
import pytest
from common import EXAMPLES

from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.studies.tolerance import Study, points, run, surface_of
from cycloid_fmu.surfaces.sampling import read_tolerances

PAIR = read_pair(EXAMPLES / "drive-39-40.toml")
# Form deviations and slices cost by themselves; the rest of the example's tolerances is sampled.
WITHOUT = ("gear_profile", "pin_profile", "misalignment_xz", "misalignment_yz")
TOLERANCES = read_tolerances(EXAMPLES / "tolerances.toml").replace(**dict.fromkeys(WITHOUT))
STUDY = Study(PAIR, TOLERANCES, 640, 1, (181.0, -181.0))


def clocks():
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return np.array([time.perf_counter(), sum(u.ru_utime + u.ru_stime for u in used)])


def timed(function):
    begin = clocks()
    function()
    return clocks() - begin


def in_a_loop(study):
    """The exact sweep of both loads with the play at each crank angle."""
    angles = np.linspace(0.0, 2 * np.pi, study.angles, endpoint=False)
    for point in points(study):
        solve(DriveValue(study.pair, surface_of(study, point)), study.torque, angles)


def test_exact_against_a_python_loop(benchmark):
    few = dataclasses.replace(STUDY, samples=64)
    in_a_loop(dataclasses.replace(STUDY, samples=2))
    run(few)
    loop = timed(lambda: in_a_loop(few)) / 64
    exact = timed(lambda: run(few)) / 64
    both = timed(lambda: run(STUDY, workers=2)) / STUDY.samples
    benchmark.pedantic(run, (few,), rounds=1)
    for name, one in (("loop", loop), ("exact", exact), ("exact, 2 workers", both)):
        benchmark.extra_info[f"{name}: ms a drive, wall and processor"] = [round(v * 1e3, 2) for v in one]
    benchmark.extra_info["exact over loop"] = round(loop[0] / exact[0], 2)
    benchmark.extra_info["exact on 2 workers over loop"] = round(loop[0] / both[0], 2)


def test_two_workers_over_one(benchmark):
    """Processes are started before; the order 1, 2, 1, 2 … so that other work meets both."""
    run(dataclasses.replace(STUDY, samples=64), workers=2)
    single, double = [], []
    for _ in range(3):
        single.append(timed(lambda: run(STUDY, workers=1))[0])
        double.append(timed(lambda: run(STUDY, workers=2))[0])
    benchmark.pedantic(run, (dataclasses.replace(STUDY, samples=64),), {"workers": 2}, rounds=1)
    benchmark.extra_info["1 worker over 2, each round"] = [round(a / b, 2) for a, b in zip(single, double, strict=True)]


@pytest.mark.parametrize("each", [1, 10, 100])
def test_overhead_of_a_task_on_a_cluster(benchmark, each):
    """Empty tasks of a study's size on two local workers: the scheduler's cost of a task."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        rows = points(dataclasses.replace(STUDY, samples=16))

        def submit():
            client.gather([client.submit(_nothing, STUDY, k, rows, pure=False) for k in range(2 * each)])

        submit()
        benchmark.pedantic(submit, rounds=5)
    benchmark.extra_info["ms a task"] = round(benchmark.stats.stats.median / (2 * each) * 1e3, 2)


def _nothing(study, first, rows):
    return first, np.zeros((len(rows), len(study.columns)))
