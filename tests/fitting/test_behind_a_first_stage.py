"""RV reducers on the bench: the sun is recorded, the cycloid stage's errors and the first stage's play are found."""

import numpy as np
import pytest
from common import EXAMPLES
from sampled_drives import ARCSEC, SMALL, distances, random_drive

import fitting
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify
from fitting.model.first_stage import of_cranks
from fitting.model.observations import State, linearise, observations, spread_of
from fitting.transmission_error.folding import curves

SUN_PLAY = 4e-3  # rad


def reducer(play=SUN_PLAY):
    """A small pair behind a first stage that gives way."""
    pair = read_pair(EXAMPLES / "drive-39-40.toml").replace(**SMALL)
    return Drive(pair, None, FirstStage(12, 42, play, 0.0, crank_stiffness=2e4))


def run_of(drive, surface, load, generator, each, turns, noise=0.5 * ARCSEC):
    """A recording of sun and output: the product's own solver settles both stages together."""
    pair, first = drive.pair, drive.first_stage
    ideal = np.sign(load) * (generator.uniform(0.0, 6.0) + np.arange(round(turns * 11 * each)) * 2.0 * np.pi / each)
    error = solve(
        DriveValue(pair, surface, first), load, ideal, with_play=False, with_stiffness=False
    ).transmission_error[0]
    sun = ideal * drive.ratio / pair.ratio
    return fitting.Run(
        input_angle=sun,
        output_angle=sun / drive.ratio + error + generator.normal(0.0, noise, sun.size),
        torque=load,
        common_zero=True,
        known_index=True,
        name=f"{load:g} N·m",
    )


def test_the_model_is_the_reducer_solved_as_a_whole():
    drive = reducer()
    generator = np.random.default_rng(5)
    surface, _ = random_drive(drive.pair, generator, 0.5e-6)
    for load in (150.0, -30.0):
        (curve,) = curves([run_of(drive, surface, load, generator, 31.0, 0.4, 0.0)], drive.ratio)
        assert curve.ratio == pytest.approx(drive.ratio)
        crank = of_cranks(curve, drive)
        assert crank.ratio == drive.pair.ratio
        # The sun that turns forward turns the cranks backward.
        assert crank.direction == -curve.direction
        observed = observations([crank], drive.pair, [1e-6], first_stage=drive.first_stage)
        state = State(surface, np.zeros(spread_of(drive.pair, {}).size), np.zeros(observed.bench.shape[1]))
        linear = linearise(drive.pair, observed, state)
        # The cranks' torque is taken as its mean.
        assert linear.model == pytest.approx(crank.transmission_error, abs=0.05 * ARCSEC)
        more = linearise(drive.pair, observed, State(surface, state.scatter, state.bench, bearings=np.array([1e-5])))
        assert linear.bearings[:, 0] == pytest.approx((more.model - linear.model) / 1e-5, rel=1e-3)


@pytest.mark.slow(10)
def test_errors_and_play_of_a_reducer_are_found_through_its_first_stage(tmp_path):
    drawn, made = reducer(), reducer(1.5 * SUN_PLAY)
    generator = np.random.default_rng(2)
    surface, values = random_drive(made.pair, generator, 0.3e-6)
    runs = [run_of(made, surface, load, generator, 24.37, 1) for load in (20.0, -20.0, 150.0, -150.0)]
    found = identify(runs, drawn, held_out=False)
    assert found.verdict.state == "explained"
    far = np.array([*distances(found, values).values()])
    assert np.mean(np.abs(far) < 1.0) > 0.8
    (play,) = found.bearings
    assert play.name == "first_stage_play"
    assert play.interval[0] < made.first_stage.crank_play < play.interval[1]
    assert found.drive.first_stage.crank_play == pytest.approx(play.value)
    assert found.drive.ratio == pytest.approx(drawn.ratio)
    fitting.report(found, tmp_path / "fit.html")
    assert "first_stage_play" in (tmp_path / "fit.html").read_text()


@pytest.mark.slow(2)
def test_a_plan_for_a_reducer_lists_its_stage():
    *_, last = fitting.plan(reducer(), [20.0, 150.0], turns=1.0, samples=12)
    assert len(last.standard_error) > 10
    assert surface_of_pair(reducer().pair).errors["eccentricity"] == 0.0
