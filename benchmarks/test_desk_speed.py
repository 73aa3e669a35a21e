"""A change on the desk in processor time (limit 0.3 s), and its ratio to the loaded curves without play.

299 teeth are drawn on two discs. With limits the duty's torques and the lost motion are solved too.
"""

import itertools
import time

import numpy as np
import pytest
from common import EXAMPLES

from cycloid_fmu.analysis import solve
from cycloid_fmu.desk.view import look, open_desk, pair_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.surfaces.surface import surface_of_pair

MANY_TEETH = {
    "pair.gear_teeth": "299",
    "pair.pin_circle_radius": "128 mm",
    "pair.pin_radius": "1 mm",
    "pair.discs": "2",
    "pair.eccentricity": "0.3 mm",
}
TURN = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)


def processor_seconds(of, rounds=7):
    took = []
    for _ in range(rounds):
        begin = time.process_time()
        of()
        took.append(time.process_time() - begin)
    return float(np.median(took))


@pytest.mark.parametrize(
    ("drive", "limits", "changed"),
    [
        ("drive-39-40", None, {}),
        ("drive-39-40", None, MANY_TEETH),
        ("drive-39-40-bearings", None, {}),
        ("drive-39-40-bearings", "requirements", {}),
    ],
    ids=["rigid bearings", "299 teeth", "on bearings", "on bearings with limits"],
)
def test_a_change_on_the_desk(benchmark, drive, limits, changed):
    desk = open_desk(EXAMPLES / f"{drive}.toml", limits and EXAMPLES / f"{limits}.toml")
    offsets = itertools.count(-50.0, 0.25)  # no two alike, or the last is shown again

    def change():
        return look(desk, {**desk.values, **changed, "modification.offset": f"{next(offsets)} um"})

    assert not change().problems
    pair = pair_of(desk, {**desk.values, **changed})
    surface = surface_of_pair(pair)

    def loaded():
        solve(DriveValue(pair, surface), pair.rated_torque, TURN, with_play=False)

    loaded()
    alone, whole = processor_seconds(loaded), processor_seconds(change)
    benchmark(change)
    benchmark.extra_info["processor ms"] = round(whole * 1e3)
    benchmark.extra_info["times the curves under load alone"] = round(whole / alone, 1)
