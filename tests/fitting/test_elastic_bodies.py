"""Identification of drives with elastic bodies: the fit's model has them, and their stiffness may be unknown."""

import math

import numpy as np
import pytest
from test_bearings import as_made, cranked, distances, run_of

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive, read_drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair, write_pair
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify, parameters
from fitting.estimation.plan import planned_curve
from fitting.model.bearings import pair_with, sizes_of, unknown_bearings
from fitting.model.observations import State, linearise, observations, spread_of
from fitting.recalibration.drift import bearing_drift

SECTIONS = [{"from": "-18 mm", "to": "18 mm", "diameter": "9 mm"}]
CRANK = {"bearings": ["-17 mm", "17 mm"], "sections": SECTIONS}
COLUMNS = {"columns": 3, "circle_radius": "28 mm", "length": "26 mm", "share": 0.5}
CARRIER = {**COLUMNS, "radial_width": "9 mm", "tangential_width": "7 mm"}
SOFT = 0.7  # stiffness of the cranks as made over that by their dimensions


def elastic(pair, **of_crank):
    return pair.replace(bodies={"crank": {**CRANK, **of_crank}, "carrier": CARRIER})


def test_a_body_s_stiffness_is_an_unknown_where_its_uncertainty_is_stated():
    held, pair = elastic(cranked(1)), elastic(cranked(1), stiffness_uncertainty=0.3, stiffness_factor=1.2)
    assert unknown_bearings(held) == unknown_bearings(cranked(1))
    assert unknown_bearings(pair) == (*unknown_bearings(held), "crank_stiffness")
    assert sizes_of(pair)[-1] == 0.3
    changed = pair_with(pair, np.array([*np.zeros(6), math.log(0.5)]), rounded=True)
    assert changed.bodies.crank.stiffness_factor == 0.6
    assert changed.bodies.carrier == pair.bodies.carrier
    assert parse_pair(changed.text, "changed") == changed
    # Wear doesn't soften a shaft.
    assert bearing_drift(["crank_stiffness", "main_clearance"], 1e6, 1e-6).tolist()[0] == 0.0


@pytest.mark.parametrize(("key", "value"), [("stiffness_uncertainty", 0.0), ("stiffness_factor", -1.0)])
def test_what_is_no_uncertainty_or_factor_is_refused(key, value):
    text = elastic(cranked(1), stiffness_uncertainty=0.3, stiffness_factor=1.2).text
    stated = {"stiffness_uncertainty": "0.3", "stiffness_factor": "1.2"}[key]
    with pytest.raises(edge.InputError, match=rf"^pair\.toml: \[bodies\.crank\] {key} = {value:g}") as problem:
        parse_pair(text.replace(f"{key} = {stated}", f"{key} = {value:g}"), "pair.toml")
    assert str(problem.value).count("\n") == 0


def test_the_fit_s_model_and_derivatives_are_those_of_drives_with_these_bodies():
    pair = elastic(cranked(1), stiffness_uncertainty=0.3)
    surface = surface_of_pair(pair).replace(**as_made(3, 1)[1].errors)
    curves = [planned_curve(pair.ratio, t, int(np.sign(t)), 0.2, 7) for t in (60.0, -200.0)]
    observed = observations(curves, pair, [1e-6, 1e-6])
    at = observed.bearing_names.index("crank_stiffness")
    bearings = np.array([0.1, 1e-6, -0.1, 2e-6, 0.2, 3e-6, -0.2])

    def model(change):
        changed = pair_with(pair, bearings + change * np.eye(7)[at])
        each = (solve(DriveValue(changed, surface), c.torque, c.input_angle, with_play=False) for c in curves)
        return np.concatenate([found.transmission_error[0] for found in each])

    state = State(surface, np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]), bearings=bearings)
    linear = linearise(pair, observed, state)
    assert linear.model == pytest.approx(model(0.0), abs=1e-12)
    slope = (model(1e-3) - model(-1e-3)) / 2e-3
    assert linear.bearings[:, at] == pytest.approx(slope, abs=1e-3 * np.abs(slope).max())


@pytest.mark.slow(40)
def test_errors_and_the_stiffness_of_cranks_are_found(tmp_path):
    """Cranks 0.7 times as stiff as by their dimensions, which are uncertain by 30 %."""
    made, surface, values, generator = as_made(0, 1)
    truth, pair = elastic(made, stiffness_factor=SOFT), elastic(cranked(1), stiffness_uncertainty=0.3)
    surface = surface_of_pair(truth).replace(**surface.errors)
    runs = [run_of(truth, surface, load, generator, 12.37, 1) for load in (30.0, -30.0, 200.0, -200.0)]
    given = parameters(runs, Drive(pair))
    assert given["crank_stiffness"].vary
    found = identify(runs, Drive(pair), held_out=False)
    assert found.verdict.state == "explained"
    far = np.array([*distances(found, values).values()])
    assert far.size > 10
    assert np.mean(np.abs(far) < 1.0) > 0.8
    (crank,) = (p for p in found.bearings if p.name == "crank_stiffness")
    assert crank.interval[0] < SOFT < crank.interval[1]
    assert math.log(crank.interval[1] / crank.interval[0]) < 0.5 * 2.0 * 1.96 * 0.3
    # The drive that was found goes through its files, and further recordings go on from it.
    assert found.drive.pair.bodies.crank.stiffness_factor == pytest.approx(crank.value, rel=1e-5)
    write_pair(found.drive.pair.nominal, tmp_path / "found.toml")
    found.drive.write(tmp_path / "found.nc")
    assert read_drive(tmp_path / "found.toml", tmp_path / "found.nc") == found.drive
    found.write(tmp_path / "fit.json")
    further = [run_of(truth, surface, load, generator, 12.37, 1) for load in (100.0, -100.0)]
    again = identify(further, Drive(pair), prior=tmp_path / "fit.json")
    (later,) = (p for p in again.bearings if p.name == "crank_stiffness")
    assert again.posterior.deviations["crank_stiffness"] < 1.05 * crank.standard_error / crank.value
    assert later.interval[0] < SOFT < later.interval[1]


@pytest.mark.slow(40)
def test_errors_are_found_with_a_disc_of_finite_elements():
    """Its stiffness is held as stated; fitted as a rigid disc the same curves give other errors."""
    made, surface, values, generator = as_made(0, 1)
    disc = {"disc": {"bore_radius": "9 mm"}}
    truth, pair = made.replace(bodies=disc), cranked(1).replace(bodies=disc)
    truth, pair = (p.replace(supports=p.supports.replace(turning_arm={"stiffness": "300 N/um"})) for p in (truth, pair))
    surface = surface_of_pair(truth).replace(**surface.errors)
    runs = [run_of(truth, surface, load, generator, 12.37, 1) for load in (30.0, -30.0, 200.0, -200.0)]
    found = identify(runs, Drive(pair), held_out=False)
    assert found.verdict.state == "explained"
    far = np.array([*distances(found, values).values()])
    assert far.size > 10
    assert np.mean(np.abs(far) < 1.0) > 0.8
    assert found.drive.pair.bodies == pair.bodies
