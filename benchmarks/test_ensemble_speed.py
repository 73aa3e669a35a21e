"""An ensemble of identified drives through a load cycle, in threads, against one drive after the other.

A robot joint's cycle has ten torques, each over a crank turn: it starts, moves, brakes and holds, and does the same
backwards. The drives are those that a fit cannot distinguish, with every pin and tooth displaced. As in the example of
`fitting.ensemble`, threads analyze them and only the band of their transmission errors is kept. The baseline is the
exact sweep of the first drives in a Python loop, with the play and without any labels. CYCLOID_DRIVES drives (1,000).
"""

import os
import resource
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from common import EXAMPLES

import fitting
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive, read_drive
from cycloid_fmu.drive_value import DriveValue
from fitting.model.observations import scatter_names

CYCLE = [half * torque for half in (1.0, -1.0) for torque in (181.0, 90.0, -60.0, 20.0, -120.0)]  # N·m
DRIVES, FIRST, ANGLES = int(float(os.environ.get("CYCLOID_DRIVES", "1000"))), 20, 360


def clocks():
    return np.array([time.perf_counter(), time.process_time()])


def test_a_thousand_drives_through_a_load_cycle(benchmark):
    made = read_drive(EXAMPLES / "drive-39-40-as-made.toml")
    names = ("eccentricity", "pin_radius", *scatter_names(made.pair))
    surface = made.surface.replace(covariance=0.25e-12 * np.eye(len(names)), covariance_of=names)
    identified = Drive(made.pair, surface)
    angle = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)

    def through(drive):
        return drive.analyze(CYCLE, crank_angle=angle, workers=1).transmission_error.values

    def band(count):
        low, high = np.full((len(CYCLE), ANGLES), np.inf), np.full((len(CYCLE), ANGLES), -np.inf)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for error in pool.map(through, fitting.ensemble(identified, count)):
                np.minimum(low, error, out=low)
                np.maximum(high, error, out=high)
        return high - low

    band(2)
    begun = clocks()
    for one in fitting.ensemble(identified, FIRST):
        solve(DriveValue(one.pair, one.surface), CYCLE, angle, workers=1)
    loop = (clocks() - begun) / FIRST
    before, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, clocks()
    benchmark.pedantic(band, (DRIVES,), rounds=1)
    each = (clocks() - begun) / DRIVES
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    benchmark.extra_info["ms a drive, wall and processor"] = [round(v * 1e3, 2) for v in each]
    benchmark.extra_info["loop: ms a drive, wall and processor"] = [round(v * 1e3, 2) for v in loop]
    benchmark.extra_info["over the loop, wall and processor"] = [round(v, 2) for v in each / loop]
    benchmark.extra_info["memory beyond that of two drives, MB"] = round(grown)
