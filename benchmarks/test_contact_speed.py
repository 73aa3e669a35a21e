"""The compiled kernel against a plain NumPy brute-force solution of the same contact.

The baseline is `tests/brute_force.py` as a bare scan of 6,400 profile points a tooth, the fewest at which a scan
agrees within 0.01″. Both run in the same session; `extra_info` has their ratio. All times are of the processor, so that
other work on the machine matters little.
"""

import time

import brute_force
import numpy as np
import pytest
from common import ARCSEC, CASES, DATA
from element_pairs import solve_elements

from cycloid_fmu.analysis import error_sensitivity, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import names_of
from cycloid_fmu.geometry.pair import parse_pair, read_pair

ANGLES = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
pytestmark = pytest.mark.benchmark(timer=time.process_time)


@pytest.mark.parametrize("case", ["error-free-39-40", "errors-39-40"])
@pytest.mark.parametrize("with_play", [False, True], ids=["loaded", "loaded and play"])
def test_sweep(benchmark, case, with_play):
    pair = read_pair(CASES / f"{case}.toml")
    drive = DriveValue.as_stated(pair)
    solve(drive, -120.0, ANGLES[:3])  # compile
    benchmark(solve, drive, -120.0, ANGLES, with_play=with_play)
    benchmark.extra_info["µs a crank angle"] = round(benchmark.stats.stats.median / ANGLES.size * 1e6, 2)


def test_against_brute_force(benchmark):
    case = CASES / "errors-39-40.toml"
    pair, plain = read_pair(case), brute_force.load_pair(case)
    drive = DriveValue.as_stated(pair)
    solve(drive, -120.0, ANGLES[:3])
    benchmark(solve, drive, -120.0, ANGLES, with_play=False)
    mine = benchmark.stats.stats.median / ANGLES.size
    took, found = [], []
    chosen = ANGLES[::720]
    for angle in chosen:
        begin = time.process_time()
        found.append(brute_force.solve(plain, angle, -120.0, points=6400, halvings=0, with_play=False))
        took.append(time.process_time() - begin)
    difference = solve(drive, -120.0, chosen).transmission_error[0] - [f["transmission_error"] for f in found]
    assert np.abs(difference).max() < 0.01 * ARCSEC  # at equal accuracy
    benchmark.extra_info["times faster than brute force"] = round(float(np.median(took)) / mine)


@pytest.mark.parametrize("case", ["error-free-39-40", "errors-39-40"])
def test_sweep_with_all_derivatives(benchmark, case):
    """By every displacement and every structured error, against the same sweep without them in turn."""
    pair = read_pair(CASES / f"{case}.toml")
    drive, names = DriveValue.as_stated(pair), names_of(pair)
    error_sensitivity(drive, -120.0, ANGLES[:3], names)
    solve(drive, -120.0, ANGLES[:3])
    took, bare = [], []

    def timed(times, call, *arguments, **options):
        begin = time.process_time()
        call(drive, -120.0, ANGLES, *arguments, **options)
        times.append(time.process_time() - begin)

    benchmark.pedantic(
        timed, (took, error_sensitivity, names), setup=lambda: timed(bare, solve, with_play=False), rounds=100
    )
    benchmark.extra_info["µs a crank angle"] = round(benchmark.stats.stats.median / ANGLES.size * 1e6, 2)
    ratio = np.median(np.divide(took, bare))
    benchmark.extra_info["times without derivatives"] = round(float(ratio), 2)


def test_a_hundred_slices_misaligned(benchmark):
    """100 slices x 40 pins: below 1 ms a crank angle on one core is asked for."""
    text = (CASES / "errors-39-40.toml").read_text().replace("[errors]", '[errors]\nmisalignment_xz = "0.3 mrad"')
    pair = parse_pair(text, "tilted")
    drive = DriveValue.as_stated(pair)
    solve(drive, -120.0, ANGLES[:3], 100)
    benchmark(solve, drive, -120.0, ANGLES[::10], 100, with_play=False)
    benchmark.extra_info["ms a crank angle"] = round(benchmark.stats.stats.median / 360 * 1e3, 3)


def test_against_the_paper_s_element_pairs(benchmark):
    """The paper's search at 800 x 100 elements on both surfaces, measured small and scaled by the number of pairs.

    It is linear in each number of elements; at least 10⁴ times slower is asked for.
    """
    text = (CASES / "errors-39-40.toml").read_text().replace("[errors]", '[errors]\nmisalignment_xz = "0.3 mrad"')
    pair = parse_pair(text, "tilted")
    drive = DriveValue.as_stated(pair)
    solve(drive, -120.0, ANGLES[:3], 100)
    benchmark(solve, drive, -120.0, ANGLES[::10], 100, with_play=False)
    mine = benchmark.stats.stats.median / 360
    small = solve_elements(pair, drive.surface, 1.7, -120.0, 1, 50, 50, pairs="all", with_play=False)
    scaled = small["seconds"] * (800 / 50) * (800 / 50) * 100
    benchmark.extra_info["times faster than the paper's search, scaled"] = round(scaled / mine)


@pytest.mark.parametrize("case", ["cranks-linear", "cranks-rollers-clearance", "rollers"])
def test_on_bearings(benchmark, case):
    """A loaded crank angle of two discs on their bearings: 60 µs are asked for; beside the same drive on rigid ones."""
    pair = read_pair(DATA / "supports-cases" / f"{case}.toml")
    drive, torque = DriveValue.as_stated(pair), pair.rated_torque
    rigid = DriveValue.as_stated(pair.nominal.replace(supports=None))
    for each in (drive, rigid):
        solve(each, torque, ANGLES[:3], with_play=False)
    begin = time.process_time()
    solve(rigid, torque, ANGLES, with_play=False)
    plain = (time.process_time() - begin) / ANGLES.size
    benchmark(solve, drive, torque, ANGLES, with_play=False)
    elastic = benchmark.stats.stats.median / ANGLES.size
    benchmark.extra_info["µs a crank angle"] = round(elastic * 1e6, 2)
    benchmark.extra_info["times rigid bearings"] = round(elastic / plain, 2)


@pytest.mark.parametrize("case", ["cranks-linear", "cranks-rollers-clearance", "rollers"])
def test_play_on_bearings(benchmark, case):
    """Both ends of the play at one in a thousand of the rated torque, beside a crank angle at that torque itself."""
    pair = read_pair(DATA / "supports-cases" / f"{case}.toml")
    drive = DriveValue.as_stated(pair)

    def seconds(torque, with_play):
        begin = time.process_time()
        solve(drive, torque, ANGLES[::10], with_play=with_play)
        return time.process_time() - begin

    seconds(pair.rated_torque, False)
    loaded = np.median([seconds(pair.rated_torque, False) for _ in range(5)])
    both = np.median([seconds(pair.rated_torque, True) for _ in range(5)]) - loaded
    benchmark(solve, drive, [], ANGLES[::10])
    benchmark.extra_info["µs a crank angle"] = round(both / 360 * 1e6)
    benchmark.extra_info["times a loaded crank angle"] = round(float(both / loaded), 1)
