"""Tolerance studies: designs, distributions, indices, workers, kills, checkpoints."""

import dataclasses
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from common import EXAMPLES, make_pair
from scipy import stats

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.studies import tolerance
from cycloid_fmu.studies.checkpoint import Checkpoint
from cycloid_fmu.studies.tolerance import (
    Study,
    check_study,
    exact_figures,
    figures_of,
    points,
    run,
    surface_of,
)
from cycloid_fmu.studies.yields import conduct, read_study
from cycloid_fmu.surfaces.sampling import parse_tolerances, read_tolerances, surface_at, within_tolerance

PAIR = read_pair(EXAMPLES / "drive-39-40.toml")
SINGLE = """[pin_radius]
tolerance = "1 um"
[centre_distance_x]
tolerance = "4 um"
distribution = "uniform"
[eccentricity]
tolerance = "2 um"
"""
PATTERNS = """[gear_pitch]
single = "3 um"
cumulative = "8 um"
[pin_radius_each]
tolerance = "0.5 um"
"""
HEAD = 'format = "cycloid-tolerances/1"\n'


def make_study(text=SINGLE + PATTERNS, samples=40, **keys):
    fields = {"seed": 1, "torque": (181.0, -90.0), "angles": 40, **keys}
    return Study(PAIR, parse_tolerances(HEAD + text, "t.toml"), samples, **fields)


@pytest.mark.parametrize("design", ["sobol", "latin-hypercube", "saltelli"])
def test_points_are_even_and_the_seed_s(design):
    study = make_study(SINGLE, 320, design=design)
    place = points(study)
    assert place.shape == (320, 3)
    assert (place == points(study)).all()
    assert not (place == points(dataclasses.replace(study, seed=2))).any()
    for column in place.T:
        assert stats.kstest(column, "uniform").statistic < 0.04  # 320 random ones: 0.076 at 95 %


def test_a_latin_hypercube_has_one_point_in_each_stratum():
    place = points(make_study(SINGLE, 50, design="latin-hypercube"))
    for column in place.T:
        assert sorted(np.floor(column * 50).astype(int)) == list(range(50))


def test_errors_have_their_stated_distribution_at_even_points():
    study = make_study(SINGLE, 512)
    drives = [surface_of(study, point) for point in points(study)]
    for name, width, distribution in (("centre_distance_x", 4e-6, "uniform"), ("pin_radius", 1e-6, "normal")):
        drawn = np.sort([getattr(d, name) for d in drives])
        wanted = within_tolerance((np.arange(512) + 0.5) / 512, width, distribution)
        assert np.abs(drawn - wanted)[20:-20].max() < 0.02 * width


def test_an_axis_moves_its_own_error_alone():
    study = make_study()
    low, high = np.full(5, 0.25), np.full(5, 0.25)
    names = {"gear_pitch": "tooth_cumulative_pitch", "pin_radius_each": "pin_radius_deviation"}
    for axis, name in enumerate(study.factors):
        high[:] = low
        high[axis] = 0.75
        one, two = (surface_of(study, p) for p in (low, high))
        moved = [n for n in one.errors if not np.array_equal(one.errors[n], two.errors[n])]
        assert moved == [names.get(name, name)]


def test_figures_are_those_of_the_analysis():
    study = make_study()
    surface = surface_at(PAIR, study.tolerances, dict.fromkeys(study.factors, 0.8), tolerance.FORM)
    values = dict(zip(study.columns, figures_of(study, surface), strict=True))
    angles = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    loaded = solve(DriveValue(PAIR, surface), study.torque, angles)
    assert values["angular_transmission_error", 1] == pytest.approx(np.ptp(loaded.transmission_error[1]), rel=1e-9)
    assert values["max_contact_pressure", 0] == pytest.approx(loaded.max_contact_pressure[0].max(), rel=1e-7)
    assert values["backlash", None] == pytest.approx(loaded.backlash.max(), rel=1e-9)
    load = 0.03 * 181.0
    up, down = solve(DriveValue(PAIR, surface), [load, -load], angles).transmission_error
    assert values["lost_motion", None] == pytest.approx((up - down).max(), rel=1e-9)
    assert values["lost_motion", None] > values["backlash", None]


@pytest.mark.system
def test_workers_change_no_bit_and_neither_does_the_company_of_other_samples():
    study = make_study()
    alone, two = run(study), run(study, workers=2)
    assert (alone.values == two.values).all()
    point = points(study)
    assert (figures_of(study, surface_of(study, point[33])) == alone.values[33]).all()


def test_a_drive_that_a_study_does_not_draw_is_solved_as_it_is():
    """A tilt without a tolerance takes its slices, and so do flanks with a form; the drives beside stay as they are."""
    study = make_study('[pin_radius]\ntolerance = "1 um"\n', 16)
    plain = surface_of(study, points(study)[0])
    tilted = plain.replace(misalignment_xz=1e-3)
    formed = plain.replace(gear_deviation=np.full((1, 39, 50, 1), -5e-6))
    found = exact_figures(study, [plain, tilted, formed])
    assert [tuple(row) for row in found] == [tuple(figures_of(study, s)) for s in (plain, tilted, formed)]
    angles, place = np.linspace(0.0, 2 * np.pi, 40, endpoint=False), ("max_contact_pressure", 0)
    pressure = solve(DriveValue(PAIR, tilted), study.torque[0], angles, 20).max_contact_pressure.max()
    assert dict(zip(study.columns, found[1], strict=True))[place] == pytest.approx(pressure, rel=1e-7)
    assert found[1, study.columns.index(place)] > 1.2 * found[0, study.columns.index(place)]


def test_yield_of_a_linear_figure_is_its_distribution_s():
    """Only the pins' radius affects the mean transmission error here; half of the drives are beyond the median."""
    study = make_study('[pin_radius]\ntolerance = "1 um"\n', 128, torque=(181.0,))
    result = run(study)
    mean = result.figure("mean_transmission_error")[:, 0]
    radius = np.array([surface_of(study, p).pin_radius for p in result.point])
    slope, _, correlation, *_ = stats.linregress(radius, mean)
    assert abs(correlation) > 0.9999
    drawn = (mean - mean.mean()) / slope
    assert stats.kstest(3e6 * drawn, stats.truncnorm(-3, 3).cdf).statistic < 0.02
    limit = float(np.median(result.figure("backlash")))
    judged = dataclasses.replace(
        study,
        tolerances=parse_tolerances(
            f'{HEAD}[pin_radius]\ntolerance = "1 um"\n[limits]\nbacklash = "{limit!r} rad"\n', "t.toml"
        ),
    )
    found = tolerance.yields(dataclasses.replace(result, study=judged))
    assert found["all"]["share"] == pytest.approx(0.5, abs=0.01)
    assert found["all"]["low"] < 0.5 < found["all"]["high"]


def test_sobol_indices_of_a_linear_figure_are_the_shares_of_variance():
    """The mean transmission error is nearly linear in the two radii: their indices are their shares of its variance."""
    text = '[pin_radius]\ntolerance = "1 um"\n[pin_circle_diameter]\ntolerance = "3 um"\n'
    study = make_study(text, 1024, torque=(181.0,), angles=20, design="saltelli")
    result = run(study, workers=2)
    found = tolerance.sobol_indices(result)["mean_transmission_error"]
    base = result.values[result.independent]
    place = result.point[result.independent]
    mean = base[:, [n for n, _ in study.columns].index("mean_transmission_error")]
    errors = np.array([[s.pin_radius, s.pin_circle_radius] for s in (surface_of(study, p) for p in place)])
    slopes = np.linalg.lstsq(errors - errors.mean(axis=0), mean - mean.mean(), rcond=None)[0]
    share = (slopes * errors.std(axis=0)) ** 2
    share /= share.sum()
    order = [study.factors.index(n) for n in ("pin_radius", "pin_circle_diameter")]
    for kind in ("first_order", "total"):
        assert np.abs(found[kind][order] - share).max() < 0.03
        assert (np.abs(found[kind][order] - share) <= found[f"{kind}_confidence"][order] + 0.01).all()


def test_a_figure_that_is_constant_over_the_base_points_has_no_indices(recwarn):
    """Interference of one drive between them has a variance that they do not show; and seed 0 is a seed too."""
    study = make_study(SINGLE, 80, design="saltelli", seed=0)
    base = tolerance.saltelli_base(study)
    values = np.random.default_rng(1).normal(size=(base * 5, len(study.columns)))
    rare = [n for n, _ in study.columns].index("interference")
    values[:, rare] = 0.0
    values[2, rare] = 1e-6
    result = tolerance.Result(study, values, np.arange(base * 5))
    assert not result.independent[2]
    found, again = tolerance.sobol_indices(result), tolerance.sobol_indices(result)
    assert "interference" not in found
    assert "backlash" in found
    assert all(np.array_equal(found[f][k], again[f][k]) for f in found for k in found[f])
    assert not recwarn.list


# Checkpoints and kills


def test_a_checkpoint_goes_on_where_it_was(tmp_path):
    study = make_study()
    whole = run(study)
    kept = Checkpoint(tmp_path / "c", study)
    kept.add(np.arange(16, 32), whole.values[16:32])
    told = []
    again = run(study, Checkpoint(tmp_path / "c", study), progress=told.append)
    assert (told[0], sum(told)) == (16, 40)  # that of the checkpoint first
    assert (again.values == whole.values).all()
    assert Checkpoint(tmp_path / "c", study).done.all()


def test_a_checkpoint_cut_at_any_byte_loses_its_last_drive_alone(tmp_path):
    """As a kill leaves it; what is added after that is read again."""
    study = make_study(samples=4)
    kept = Checkpoint(tmp_path / "c", study)
    start = (tmp_path / "c").stat().st_size
    values = np.arange(3.0 * len(study.columns)).reshape(3, -1) / 7
    values[1] = math.nan
    ends = []
    for number in range(3):
        kept.add(np.array([number]), values[number : number + 1], ["", "no such drive", ""][number : number + 1])
        ends.append((tmp_path / "c").stat().st_size)
    content = (tmp_path / "c").read_bytes()
    for size in range(start, len(content) + 1):
        (tmp_path / "c").write_bytes(content[:size])
        read = Checkpoint(tmp_path / "c", study)
        whole = sum(end <= size for end in ends)
        assert read.done.tolist() == [number < whole for number in range(4)]
        assert np.array_equal(read.values[:whole], values[:whole], equal_nan=True)
        assert read.notes == ({1: "no such drive"} if whole > 1 else {})
        read.add(np.array([3]), values[:1])
        again = Checkpoint(tmp_path / "c", study)
        assert again.done.tolist() == [*(number < whole for number in range(3)), True]
        assert (again.values[3] == values[0]).all()


def test_a_checkpoint_takes_no_changed_bit_for_a_figure(tmp_path):
    study = make_study(samples=2)
    kept = Checkpoint(tmp_path / "c", study)
    values = np.linspace(0.0, 1e-5, 2 * len(study.columns)).reshape(2, -1)
    kept.add(np.arange(2), values)
    content = bytearray((tmp_path / "c").read_bytes())
    first = content.index(b"\n") + 1
    for bit in range(8 * first, 8 * content.index(b"\n", first), 7):
        content[bit // 8] ^= 1 << bit % 8
        (tmp_path / "c").write_bytes(content)
        read = Checkpoint(tmp_path / "c", study)
        assert read.done.tolist() == [False, True]
        assert (read.values[1] == values[1]).all()
        content[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 3}, "its seed differs: 1 there, 3 here"),
        ({"angles": 80}, "its angles differs: 40 there, 80 here"),
        ({"design": "latin-hypercube"}, "its design differs: sobol there"),
    ],
)
def test_a_checkpoint_of_another_study_is_refused(tmp_path, change, said):
    study = make_study()
    Checkpoint(tmp_path / "c", study)
    with pytest.raises(edge.InputError, match=said) as caught:
        Checkpoint(tmp_path / "c", dataclasses.replace(study, **change))
    assert str(caught.value).count("\n") == 0
    reducer = dataclasses.replace(study, first_stage=FirstStage(12, 42, 0.0, 0.0))
    Checkpoint(tmp_path / "behind", reducer)
    with pytest.raises(edge.InputError, match="its first_stage differs; finish"):
        Checkpoint(tmp_path / "behind", study)
    (tmp_path / "c").write_text("something else\n")
    with pytest.raises(edge.InputError, match="not a checkpoint"):
        Checkpoint(tmp_path / "c", study)


@pytest.fixture
def files(tmp_path):
    (tmp_path / "pair.toml").write_text((EXAMPLES / "drive-39-40.toml").read_text())
    (tmp_path / "t.toml").write_text(HEAD + SINGLE + PATTERNS + '[limits]\nbacklash = "1.5 arcmin"\n')
    return ("cycloid-fmu", "tolerance", "pair.toml", "--tolerances", "t.toml", "--angles", 40)


def test_a_second_study_of_an_output_is_refused_while_the_first_one_computes(tmp_path):
    study = Study(PAIR, read_tolerances(EXAMPLES / "tolerances.toml"), 4, 1, (181.0,), angles=40)
    second = []

    def told(drives):
        with pytest.raises(edge.InputError, match=r"s.nc: another process computes this output; wait until") as refused:
            conduct(study, output=tmp_path / "s.nc")
        second.append(refused.value)

    conduct(study, output=tmp_path / "s.nc", progress=told)
    assert second
    conduct(study, output=tmp_path / "s.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["s.nc"]


@pytest.mark.slow(6)
def test_killed_in_mid_run_and_started_again(command, files, tmp_path):
    words = [str(Path(sys.executable).with_name(files[0])), *map(str, files[1:])]
    samples = 160
    words += ["--samples", str(samples), "--workers", "1", "-o", "s.nc"]
    checkpoint = tmp_path / "s.nc.checkpoint"
    pair, tolerances = read_pair(tmp_path / "pair.toml"), read_tolerances(tmp_path / "t.toml")
    study = Study(pair, tolerances, samples, 1, (181.0, -181.0), angles=40)
    with subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        while not (checkpoint.exists() and Checkpoint(checkpoint, study).done.any()):
            assert process.poll() is None, "it ended before it was killed"
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert not Checkpoint(checkpoint, study).done.all()
    assert not (tmp_path / "s.nc").exists()
    again = command(*files, "--samples", samples, "-o", "s.nc", "--plot", "p.png", "--json")
    assert again.returncode == 0, again.stderr
    assert not checkpoint.exists()
    assert (tmp_path / "p.png").stat().st_size > 20000
    whole = run(study)
    kept = xr.load_dataset(tmp_path / "s.nc")
    for name in ("angular_transmission_error", "backlash", "lost_motion"):
        assert (kept[name].values == whole.figure(name)).all()
    found = json.loads(again.stdout)
    assert found["statistics"]["backlash"]["mean"] == whole.figure("backlash").mean()
    assert found["yields"]["all"]["share"] == np.mean(whole.figure("backlash") <= np.radians(1.5 / 60))


@pytest.mark.slow(6)
def test_interrupted_with_workers_it_says_what_is_kept_and_nothing_else(files, tmp_path):
    words = [str(Path(sys.executable).with_name(files[0])), *map(str, files[1:]), "--samples", "3000"]
    words += ["--workers", "2", "-o", "s.nc"]
    checkpoint = tmp_path / "s.nc.checkpoint"
    with subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        while not (checkpoint.exists() and checkpoint.read_bytes().count(b"\n") > 1):
            assert process.poll() is None, "it ended before it was interrupted"
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        said = process.communicate()[1].splitlines()
    assert process.returncode == 130
    assert re.fullmatch(r"Interrupted: \d+ of 3000 drives are done; s.nc.checkpoint keeps them; the same .*", said[-1])
    assert all(line.startswith("drives: ") for line in said[:-1])


@pytest.mark.parametrize(
    ("text", "changes", "said"),
    [
        (SINGLE.replace('"2 um"', '"0 um"'), {}, "t.toml: [eccentricity] tolerance = 0: a distribution needs a width"),
        ('[gear_pitch]\nsingle = "0 um"\ncumulative = "1 um"\n', {}, "t.toml: [gear_pitch] single = 0"),
        ("", {}, "t.toml: no tolerance is stated"),
        (SINGLE + "[costs]\noffset = 2\n", {}, "t.toml: [costs] offset: there is no tolerance of this name"),
        (SINGLE + "[costs]\neccentricity = 0\n", {}, "t.toml: [costs] eccentricity = 0: it should be greater than 0"),
        (SINGLE, {"torque": (0.0,)}, "torque = 0.0: a study's loads must not be zero"),
        (SINGLE, {"design": "saltelli", "samples": 20}, "samples = 20: Sobol indices of 3 tolerances need 80"),
        (SINGLE, {"pair": make_pair()}, "p.toml: [pair] rated_torque is missing"),
        (SINGLE, {"seed": -1}, "seed = -1: it must be between 0 and"),
    ],
)
def test_bad_studies_are_one_sentence(text, changes, said):
    def prepare():
        study = make_study(text + ('[limits]\nlost_motion = "1 arcmin"\n' if "pair" in changes else ""))
        study = dataclasses.replace(study, **changes)
        check_study(study, "p.toml", "t.toml")
        points(study)

    with pytest.raises(edge.InputError) as caught:
        prepare()
    assert str(caught.value).startswith(said)
    assert str(caught.value).count("\n") == 0


@pytest.mark.slow(2)
def test_a_scheduler_that_does_not_answer(command, files, tmp_path):
    dask = pytest.importorskip("dask")
    # Loaded within `set`, its defaults would be gone after it.
    pytest.importorskip("distributed")
    with dask.config.set({"distributed.comm.timeouts.connect": "1 s"}):
        failed = command(*files, "--scheduler", "tcp://127.0.0.1:9", "-o", "s.nc")
    assert (failed.returncode, failed.stdout) == (2, "")
    assert failed.stderr.strip() == '--scheduler = "tcp://127.0.0.1:9": no scheduler answers there (OSError).'


# A real cluster


def _started(words, **environment):
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **environment},
    )


@pytest.fixture
def cluster():
    """A scheduler in a process of its own and a function that starts a worker in another."""
    pytest.importorskip("distributed")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{one.getsockname()[1]}"
    scheduler = _started(["dask_scheduler", "--host", address, "--no-dashboard"])
    workers = []

    def worker(**environment):
        words = ["dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        workers.append(_started(words, **environment))
        return workers[-1]

    try:
        yield address, worker
    finally:
        for process in (*workers, scheduler):
            process.kill()
        for process in (*workers, scheduler):
            process.wait()


def _wait_for(address, workers):
    from distributed import Client

    with Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=60)


@pytest.mark.slow(9)
def test_a_cluster_of_two_loses_a_worker_and_nothing_else(cluster):
    address, worker = cluster
    first, _ = worker(), worker()
    _wait_for(address, 2)
    study = make_study(samples=2000)
    done = []

    def progress(samples):
        done.append(samples)
        if len(done) == 2:
            first.kill()
            first.wait()

    found = run(study, scheduler=address, progress=progress)
    assert sum(done) == 2000
    assert (found.values == run(study).values).all()


@pytest.mark.slow(4)
def test_a_worker_of_another_version_is_refused(cluster, tmp_path):
    address, worker = cluster
    other = tmp_path / "cycloid_fmu-9.9.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: cycloid-fmu\nVersion: 9.9\n")
    with pytest.raises(edge.InputError, match="has no workers"):
        run(make_study(), scheduler=address)
    others = [path for path in (os.environ.get("PYTHONPATH"),) if path]
    for _ in range(2):  # joblib computes in this process where there is but one
        worker(PYTHONPATH=os.pathsep.join([str(tmp_path), *others]))
    _wait_for(address, 2)
    with pytest.raises(edge.InputError, match=r"a worker has cycloid-fmu 9\.9, this process"):
        run(make_study(), scheduler=address)


@pytest.mark.parametrize("name", ["drive-39-40-as-made.toml", "rv-20e.toml"])
@pytest.mark.filterwarnings("ignore::cycloid_fmu.edge.InputWarning")  # of the paper's numbers, which contradict
def test_a_study_of_a_drive_with_errors_says_that_they_are_no_part_of_it(name):
    with pytest.warns(edge.InputWarning, match=f"{name}: its errors are no part of the study"):
        asked = read_study(EXAMPLES / name, EXAMPLES / "tolerances-of-places.toml", [160.0], samples=2, seed=1)
    point = points(asked)[0]
    assert surface_of(asked, point) == surface_of(dataclasses.replace(asked, pair=asked.pair.nominal), point)
