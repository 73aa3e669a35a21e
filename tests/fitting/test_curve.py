import dataclasses
import itertools
import re
import tracemalloc

import numpy as np
import pytest
import xarray as xr
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import drivers
import fitting
from cycloid_fmu import edge
from fitting.cli import app
from fitting.figures.metrics import figures_of
from fitting.readers.recording import Block, Recording
from fitting.reports.panels import panels_of
from fitting.samples.plausible import PlausibleBlocks
from fitting.transmission_error.curve import noise_of, write_curves
from fitting.transmission_error.folding import Folding
from fitting.transmission_error.survey import survey


def recorded(angle, error, ratio=-39.0, torque=50.0):
    n = angle.size
    return Recording(
        np.arange(n) * 1e-3,
        angle,
        angle / ratio + error,
        np.full(n, torque),
        np.zeros(n, np.uint8),
        ratio=ratio,
        common_zero=True,
        known_index=True,
        source="run.arrows",
        checksum="0",
    )


@pytest.mark.slow(3)
@example(turns=2.4, forwards=False, start=0.0, each=37)  # every second turn is in step
@given(
    turns=st.floats(0.3, 3.5),
    forwards=st.booleans(),
    start=st.floats(-300, 300),
    each=st.integers(5, 60),
)
def test_a_known_curve_comes_back_at_the_angles_where_it_was_measured(turns, forwards, start, each):
    """Orders of the output that repeat after its turn, whatever the start, direction, length and sampling."""
    period = 2 * np.pi * 39
    samples = max(3, int(turns * 39 * each))
    angle = start + (1 if forwards else -1) * np.linspace(0, turns * period, samples)

    def known(phi):
        return 1e-4 * np.cos(39 * phi / 39 + 1) + 3e-5 * np.sin(40 * phi / 39) + 2e-5

    curve = fitting.curves(recorded(angle, known(angle)), -39.0)[0]
    assert curve.direction == (1 if forwards else -1)
    assert (np.diff(curve.input_angle) > 0).all()
    assert curve.sample_count.sum() == samples
    spacing = 2 * np.pi / each
    # Samples of one point are within one spacing; their mean error is the error at their mean angle to second order.
    assert curve.transmission_error == pytest.approx(known(curve.input_angle), abs=1.5e-4 * spacing**2 + 1e-12)


def test_turns_are_averaged_with_their_standard_error():
    rng = np.random.default_rng(0)
    angle = np.arange(39 * 40 * 16) * 2 * np.pi / 40
    curve = fitting.curves(recorded(angle, rng.normal(0, 1e-6, angle.size)), -39.0)[0]
    assert set(curve.sample_count) == {16}
    assert np.sqrt(np.mean(curve.standard_error**2)) == pytest.approx(1e-6 / 4, rel=0.05)
    assert curve.transmission_error.std() == pytest.approx(1e-6 / 4, rel=0.1)
    assert noise_of(curve) == pytest.approx(1e-6 / 4, rel=0.05)


def test_noise_of_a_single_turn_is_found_beside_the_curve():
    rng = np.random.default_rng(0)
    angle = np.arange(39 * 24) * 2 * np.pi / 24
    smooth = 1e-4 * np.cos(2 * angle)
    curve = fitting.curves(recorded(angle, smooth + rng.normal(0, 2e-6, angle.size)), -39.0)[0]
    assert np.isnan(curve.standard_error).all()
    assert noise_of(curve) == pytest.approx(2e-6, rel=0.1)


@pytest.mark.parametrize("ratio", [39.0, -40.0, -38.0])
def test_a_wrong_ratio_is_refused(ratio):
    angle = np.linspace(0, 245, 4000)
    with pytest.raises(edge.InputError, match="check the pair"):
        fitting.curves(recorded(angle, 0.0), ratio)[0]


def test_no_motion_is_refused():
    with pytest.raises(edge.InputError, match="turns by only 0°"):
        fitting.curves(recorded(np.zeros(10), 0.0), -39.0)[0]


def test_a_recorded_loop_is_no_curve(tmp_path):
    """The locked input's noise makes a way of some arcseconds, of which an output turn has a milliard points."""
    with drivers.simulate_bench(
        lambda angle, torque: -angle / 39.0 + 1e-5 * torque,
        ratio=-39.0,
        torque=200.0,
        turns=2,
        motion=drivers.SimulatedMotion(400, noise="0.1 arcsec", hysteresis=True),
        bus="virtual",
    ) as bench:
        bench.record(tmp_path / "loop.arrows")
    with pytest.raises(edge.InputError) as problem:
        fitting.curves(fitting.read_recordings(tmp_path / "loop.arrows"), -39.0)
    match = re.fullmatch(r".*loop\.arrows: the input turns by only (\S+)°.*more than 1°\.", str(problem.value))
    assert match is not None
    assert 0.1 / 3600 < float(match[1]) < 1.0 / 3600


def test_a_crank_that_stood_while_a_million_samples_came_is_refused_too():
    with pytest.raises(edge.InputError, match="turns by only"):
        fitting.curves(recorded(np.linspace(0.0, 1e-6, (1 << 20) + 1), 0.0, ratio=39.0), -39.0)


def test_memory_does_not_grow_with_the_speed_behind_a_slow_beginning():
    """As many points as a turn may have, then 500 turns in one block."""
    slow, fast = np.linspace(0.0, 250.0, 1 << 20), np.arange(1, 1 << 17)
    angle = np.append(slow, 250.0 + fast)
    made = recorded(angle, 1e-4 * np.cos(angle))
    folding = Folding(-39.0, "run.arrows")
    tracemalloc.start()
    try:
        for part in (slice(0, slow.size), slice(slow.size, None)):
            folding.add(
                Block(*(v[part] for v in (made.time, made.input_angle, made.output_angle, made.torque, made.status)))
            )
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 400e6
    (curve,) = folding.curves(made, PlausibleBlocks(made, -39.0))
    assert curve.sample_count.sum() == angle.size
    assert curve.transmission_error == pytest.approx(1e-4 * np.cos(curve.input_angle), abs=1e-6)


@pytest.mark.parametrize(("first", "second"), [(-0.5, 0.5), (179.5, 180.5)])
def test_where_an_encoder_rolls_over_does_not_count_as_transmission_error(first, second):
    """An angle within one turn begins at 0° or at 360° by chance; zeros 1° apart stay 1° apart if they are common."""
    crank = np.linspace(0.0, 2.0 * np.pi * 39, 39 * 100)

    def means(common):
        runs = [
            fitting.Run(
                input_angle=crank,
                output_angle=np.mod(-crank / 39 + 1e-4 * np.cos(crank) + np.radians(zero), 2.0 * np.pi),
                torque=20.0,
                common_zero=common,
            )
            for zero in (first, second)
        ]
        return np.degrees([curve.transmission_error.mean() for curve in fitting.curves(runs, -39.0)])

    assert np.diff(means(common=True)) == pytest.approx([1.0], abs=1e-3)
    for mean, zero in zip(means(common=False), (first, second), strict=True):
        assert -180.0 <= mean <= 180.0
        assert np.mod(mean - zero + 1.0, 360.0) == pytest.approx(1.0, abs=1e-3)


def test_curve_file(tmp_path):
    long = fitting.curves(recorded(np.arange(39 * 48) * 2 * np.pi / 48, 1e-5), -39.0)[0]
    short = fitting.curves(recorded(-np.arange(100) * 2 * np.pi / 48, 2e-5, torque=-50.0), -39.0)[0]
    write_curves([long, short], tmp_path / "c.nc")
    with xr.open_dataset(tmp_path / "c.nc") as data:
        assert data.attrs["format"] == "cycloid-curve/1"
        assert data["direction"].values.tolist() == [1, -1]
        assert data["transmission_error"].attrs["units"] == "rad"
        assert data["transmission_error"].values[0] == pytest.approx(np.full(39 * 48, 1e-5))
        assert np.isnan(data["transmission_error"].values[1]).sum() == 39 * 48 - 100


@pytest.mark.slow(5)
@example(ways=[20.0, 20.0, 20.0], forwards=False, cuts=[0.00390625], seed=0)
@given(
    ways=st.lists(st.floats(20, 400), min_size=1, max_size=4),
    forwards=st.booleans(),
    cuts=st.lists(st.floats(0, 1), max_size=6),
    seed=st.integers(0, 99),
)
def test_blocks_and_reversals_anywhere_give_the_same_curves(ways, forwards, cuts, seed):
    """There and back several times, the encoder shaking: each direction has its own curve, however the blocks fall."""
    turning = 1 if forwards else -1
    corners = np.cumsum([0.0, *(turning * way * (-1) ** i for i, way in enumerate(ways))])
    parts = [np.linspace(a, b, int(abs(b - a) * 5) + 1)[1:] for a, b in itertools.pairwise(corners)]
    angle = np.concatenate(parts) + np.random.default_rng(seed).normal(0, 1e-5, sum(p.size for p in parts))
    way = np.concatenate([np.full(p.size, np.sign(p[1] - p[0])) for p in parts])
    made = recorded(angle, way * 1e-4 + 2e-5 * np.cos(angle))
    whole = {c.direction: c for c in fitting.curves(made, -39.0)}
    borders = np.unique(np.r_[0, (np.array(cuts) * angle.size).astype(int), angle.size])
    folding = Folding(-39.0, "run.arrows")
    for a, b in itertools.pairwise(borders):
        folding.add(
            Block(*(v[a:b] for v in (made.time, made.input_angle, made.output_angle, made.torque, made.status)))
        )
    found = {c.direction: c for c in folding.curves(made, PlausibleBlocks(made, -39.0))}
    assert found.keys() == whole.keys() == set(way.astype(int))
    for direction, curve in whole.items():
        assert curve.transmission_error == pytest.approx(direction * 1e-4 + 2e-5 * np.cos(curve.input_angle), abs=1e-6)
        assert found[direction].sample_count.sum() == curve.sample_count.sum()
        assert found[direction].transmission_error == pytest.approx(curve.transmission_error, abs=1e-12)
    assert sum(c.sample_count.sum() for c in whole.values()) > 0.95 * angle.size


def test_standstill_is_left_out_and_both_directions_are_told_apart():
    angle = np.concatenate([np.zeros(200), np.linspace(0, 300, 6000), np.full(300, 300.0), np.linspace(300, 40, 5000)])
    error = np.where(np.arange(angle.size) < 6500, 1e-4, -1e-4) + 2e-5 * np.cos(angle)
    forward, backward = fitting.curves(recorded(angle, error), -39.0)
    assert (forward.direction, backward.direction) == (1, -1)
    assert forward.turns == pytest.approx(300 / (2 * np.pi * 39), abs=1e-3)
    assert backward.turns == pytest.approx(260 / (2 * np.pi * 39), abs=2e-3)
    assert forward.transmission_error == pytest.approx(1e-4 + 2e-5 * np.cos(forward.input_angle), abs=1e-7)
    assert backward.transmission_error == pytest.approx(-1e-4 + 2e-5 * np.cos(backward.input_angle), abs=1e-7)
    assert any("at rest" in note for note in forward.notes)


@given(ppm=st.floats(-300, 300), forwards=st.booleans(), turns=st.floats(1.5, 12.0), seed=st.integers(0, 99))
@settings(max_examples=30)
def test_a_transmission_error_that_runs_away_is_said_and_no_other_is(ppm, forwards, turns, seed):
    """The output's clock runs `ppm` fast; orders 1 and 39 of any phase, cut anywhere, are no ramp."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 2)
    angle = (1 if forwards else -1) * np.arange(int(turns * 39 * 20)) * 2 * np.pi / 20

    def error(phi):
        return 1e-4 * np.cos(phi / 39 + phase[0]) + 1e-4 * np.cos(phi + phase[1])

    seen = angle / (1 + ppm * 1e-6)  # at the time stamped the output was where it is shown a little earlier
    made = recorded(angle, error(seen) - (seen - angle) / 39)
    curve = fitting.curves(made, -39.0)[0]
    said = [note for note in curve.notes if "drifts by" in note]
    ramp = ppm * 1e-6 * 2 * np.pi
    wave = 12 / (2 * np.pi * turns**2)  # slope of a wave of amplitude 1 a turn; the ramp's own sawtooth is one, too
    if abs(ramp) > 2 * 3 * wave * (2e-4 + abs(ramp) / 2):
        shown = float(said[0].split("clock ran ")[1].split(" ppm")[0])
        assert shown == pytest.approx(ppm, rel=0.35)
    if abs(ramp) * turns < 0.9 * np.pi / 648000:
        assert said == []


def test_a_wrong_count_of_an_encoder_is_said_after_two_turns_less_a_sample():
    """The output is 0.8 ‰ off, as with 10,008 counts taken for 10,000: this was in the curve as noise."""
    angle = np.arange(2 * 39 * 20) * 2 * np.pi / 20
    for share in (0.9992, 1.0008):
        made = dataclasses.replace(recorded(angle, np.zeros(angle.size)), output_angle=-share * angle / 39)
        (note,) = (note for note in fitting.curves(made, -39.0)[0].notes if "drifts by" in note)
        assert f"{(1.0 - share) * 1e6:+.0f} ppm" in note


def test_the_table_of_curves_states_the_turns_that_were_recorded(tmp_path):
    """A few samples of a curve are no whole turn: "turns 1.0" stood beside 3 points."""
    for turns in (0.02, 0.6, 2.0):
        angle = np.linspace(0.0, turns * 2 * np.pi * 39, 300)
        table = np.column_stack([np.arange(angle.size) / 100.0, angle, -angle / 39, np.ones(angle.size)])
        header = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
        np.savetxt(tmp_path / f"{turns}.csv", table, delimiter=",", header=header, comments="", fmt="%.12g")
        shown = CliRunner().invoke(app, ["curve", str(tmp_path / f"{turns}.csv"), "--ratio", "-39"]).output
        (row,) = (line.split() for line in shown.splitlines() if ".csv" in line)
        assert f"{turns}" in row


def test_a_recording_of_less_than_a_turn_gives_its_curve_and_says_what_is_missing():
    angle = np.arange(0, 0.6 * 2 * np.pi * 39, 2 * np.pi / 64)
    made = recorded(angle, 1e-4 * np.cos(angle))
    surveyed = survey(made, -39.0, None)
    (curve,) = surveyed.curves
    assert curve.turns == pytest.approx(0.6, rel=1e-3)
    found = figures_of([surveyed], -39.0, None)
    assert "angular_transmission_error" not in found.figures
    (note,) = (n for n in found.notes if "output turn" in n)
    said = (
        r"run\.arrows: 6[01]\.\d% of an output turn was recorded; its orders need all of it\. No angular transmission "
    )
    assert re.fullmatch(rf"{said}error is computed for it\.", note), note
    titles = [panel.title for panel in panels_of(found)]
    assert "Transmission error over one output turn" in titles
    assert "Orders of the output" not in titles
