"""Unknowns that a user holds, bounds, ties or frees by lmfit, its search and its profiles."""

import copy
import dataclasses
import json

import lmfit
import numpy as np
import pytest
from common import BENCH, EXAMPLES
from sampled_drives import SMALL, recorded

import fitting
from cycloid_fmu import edge
from cycloid_fmu.drive import Drive, read_drive
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.confirmation import confirmed
from fitting.estimation.identify import identify
from fitting.estimation.minimisation import Search
from fitting.estimation.result import read_lmfit_parameters
from fitting.model.constraints import Constraints, read_parameters
from fitting.model.observations import linearise

TRUTH = {
    "centre_distance_x": 2e-6,
    "eccentricity": 1e-6,
    "pin_radius": 3e-6,
    "pin_radial_2_cos": 1.5e-6,
    "pin_tangential_2_sin": 3e-6,  # twice the former
    "tooth_cumulative_pitch_1_sin": -2e-6,
}
MODE = 1e-5  # standard errors
TIED, OF = "pin_tangential_2_sin", "pin_radial_2_cos"


@pytest.fixture(scope="module")
def drive():
    return Drive(read_pair(EXAMPLES / "drive-39-40.toml").replace(**SMALL))


@pytest.fixture(scope="module")
def runs(drive):
    made, generator = with_structured(surface_of_pair(drive.pair), TRUTH), np.random.default_rng(8)
    loads = (20.0, -20.0, 200.0, -200.0)
    return [recorded(drive.pair, made, load, generator, each=24.37, turns=1) for load in loads]


@pytest.fixture(scope="module")
def plain(runs, drive):
    return identify(runs, drive, held_out=False)


@pytest.fixture(scope="module")
def given(plain):
    """Parameters as a fit returns them, to be changed and given to the next one."""
    return plain.lmfit.params


def changed(given, **attributes):
    """Parameters with other attributes of some: changed(given, pin_radius={"max": 1e-6})."""
    other = copy.deepcopy(given)
    for name, values in attributes.items():
        other[name].set(**values)
    return other


def of(result, name):
    return next(p for p in result.parameters if p.name == name)


def linearised(estimate):
    """The same with the model at its state."""
    return dataclasses.replace(estimate, linear=linearise(estimate.pair, estimate.observed, estimate.state))


def test_parameters_before_a_fit_are_its_unknowns(plain, runs, drive):
    before = fitting.parameters(runs, drive)
    assert {*before} == {*plain.lmfit_parameters} == {*plain.lmfit.params}
    for name, one in plain.lmfit_parameters.items():
        assert (before[name].min, before[name].max) == (one.min, one.max)
    # What is resolved near the nominal drive; near the drive that was found it may be one error more or less.
    assert len({n for n, p in before.items() if p.vary} ^ {n for n, p in plain.lmfit.params.items() if p.vary}) <= 2


def test_the_parameters_of_a_fit_change_nothing(given, plain, runs, drive):
    same = identify(runs, drive, held_out=False, parameters=given)
    assert same.fitted == plain.fitted
    for p in plain.parameters:
        if p.held is None:
            assert abs(of(same, p.name).value - p.value) < 0.1 * p.standard_error, p.name
            assert of(same, p.name).standard_error == pytest.approx(p.standard_error, rel=0.05)


def test_an_error_tied_to_another_is_recovered_and_its_interval_scales(given, plain, runs, drive):
    found = identify(runs, drive, held_out=False, parameters=changed(given, **{TIED: {"expr": f"2 * {OF}"}}))
    assert found.verdict.state == "explained"
    one, other = of(found, TIED), of(found, OF)
    assert one.value == pytest.approx(2.0 * other.value, rel=1e-9)
    errors = found.lmfit_parameters
    assert errors[TIED].stderr == pytest.approx(2.0 * errors[OF].stderr, rel=1e-9)
    assert found.lmfit.params[TIED].stderr == pytest.approx(2.0 * found.lmfit.params[OF].stderr, rel=1e-6)
    assert one.interval[0] < TRUTH[TIED] < one.interval[1]
    # Both waves tell of one unknown: it is known better than by either alone.
    assert errors[OF].stderr < plain.lmfit_parameters[OF].stderr
    assert errors[TIED].stderr < plain.lmfit_parameters[TIED].stderr
    # The covariance of the fit without the tie, on the condition of the tie.
    posterior, scale = plain.search.start.posterior, plain.search.start.unknowns.scale
    at, row = posterior.names.index(OF), np.zeros((1, scale.size))
    row[0, posterior.names.index(TIED)], row[0, at] = 1.0, -2.0
    _, covariance = posterior.given(row, np.zeros(1))
    assert errors[OF].stderr == pytest.approx(np.sqrt(covariance[at, at]) * scale[at], rel=0.05)


@pytest.mark.slow(1)
def test_of_two_errors_with_opposite_effects_one_takes_what_the_other_is_held_at(given, plain, runs, drive):
    """Isometric modification and pin radius: only one combination of them shows (docs/theory/errors.md)."""
    shown = of(plain, "pin_radius").value
    held = changed(given, pin_radius={"value": shown + 1.5e-6, "vary": False}, isometric={"vary": True})
    found = identify(runs, drive, held_out=False, parameters=held)
    one, other = of(found, "isometric"), of(found, "pin_radius")
    assert other.value == pytest.approx(shown + 1.5e-6, abs=1e-9)
    assert other.standard_error == 0.0
    assert "parameters hold it" in other.held
    assert structured_value(found.surface, "pin_radius") == pytest.approx(other.value, abs=1e-12)
    assert one.held is None
    assert abs(abs(one.value) - 1.5e-6) < 0.3 * one.standard_error


@pytest.mark.slow(1)
def test_what_is_held_on_the_bench_is_as_stated(given, runs, drive):
    values = {"chain_compliance": 2e-9, "friction_torque": 0.0}
    held = changed(given, **{name: {"value": value, "vary": False} for name, value in values.items()})
    found = identify(runs, drive, held_out=False, parameters=held)
    assert found.bench["chain_compliance"] == pytest.approx(2e-9, rel=1e-12)
    assert found.bench["friction_torque"] == 0.0
    assert found.lmfit.params["chain_compliance"].vary is False
    again = found.lmfit_parameters
    assert again["friction_torque"].stderr == 0.0
    assert again["output_angle_offset"].stderr > 0.0
    assert "friction_torque" not in again["output_angle_offset"].correl


def test_a_bound_that_binds_moves_the_others_as_a_condition_does(given, plain, runs, drive):
    name, start = "pin_radius", plain.search.end
    best, sigma = of(plain, name), plain.lmfit_parameters[name].stderr
    bound = best.value - sigma
    bounded = changed(given, **{name: {"max": bound, "value": bound - sigma}})
    found = identify(runs, drive, held_out=False, parameters=bounded)
    assert found.lmfit.params[name].value <= bound
    assert of(found, name).value == pytest.approx(bound, abs=0.02 * sigma)
    assert any("pin_radius ends at" in note and "a bound of the given parameters" in note for note in found.notes)
    posterior, scale = start.posterior, start.unknowns.scale
    at, row = posterior.names.index(name), np.zeros((1, scale.size))
    row[0, at] = 1.0
    moved, _ = posterior.given(row, np.array([bound / scale[at] - start.vector[at]]))
    farthest = 0.0
    for other in ("eccentricity", "pin_circle_radius", "centre_distance_x", "tooth_cumulative_pitch_1_sin"):
        i, sigma = posterior.names.index(other), plain.lmfit_parameters[other].stderr
        expected = (start.vector[i] + moved[i]) * scale[i]
        # The sizes of scatter and noise, estimated anew, are a little larger.
        assert abs(of(found, other).value - expected) < 0.3 * sigma, other
        farthest = max(farthest, abs(expected - of(plain, other).value) / sigma)
    assert farthest > 0.6


def test_lmfit_ends_where_gauss_newton_steps_on_all_unknowns_do(plain):
    """With the scatter marginalised: the same mode, and the covariance is the marginal of that of all unknowns."""
    estimate = plain.search.start
    for _ in range(12):
        estimate = confirmed(estimate, 0.0)
    search = Search(estimate)
    posterior, scale = estimate.posterior, estimate.unknowns.scale
    names = search.result.var_names
    at = [posterior.names.index(n) for n in names]
    covariance = posterior.marginal(names).covariance * np.outer(scale[at], scale[at])
    sigma = np.sqrt(np.diag(covariance))
    found = np.array([search.result.params[n].value for n in names])
    assert np.abs((found - (estimate.vector * scale)[at]) / sigma).max() < MODE
    assert search.result.covar / np.outer(sigma, sigma) == pytest.approx(covariance / np.outer(sigma, sigma), abs=1e-5)
    assert search.result.chisqr == pytest.approx(estimate.misfit_with_priors, rel=1e-9)
    assert search.end.misfit <= estimate.misfit_with_priors * (1.0 + 1e-12)


@pytest.mark.slow(1)
def test_at_the_ends_of_a_profile_the_fit_is_worse_by_the_square_of_the_quantile(given, plain):
    """The best fit with the error held there is found by Gauss-Newton steps on all unknowns, without lmfit."""
    name, search = "pin_radius", Search(plain.search.start)
    best, sigma = of(plain, name).value, plain.lmfit_parameters[name].stderr
    low, high = search.interval(name, 1.96 * sigma, 1.96**2)
    assert (low, high) == pytest.approx((best - 1.96 * sigma, best + 1.96 * sigma), abs=0.2 * sigma)
    for end in (low, high):
        constraints = Constraints.of(changed(given, **{name: {"value": end, "vary": False}}))
        held = dataclasses.replace(search.start.observed, constraints=constraints)
        estimate = dataclasses.replace(search.end, observed=held)
        unknowns = estimate.unknowns
        # Where the linear model has the others.
        row = np.zeros((1, unknowns.scale.size))
        row[0, at := unknowns.names.index(name)] = 1.0
        moved, _ = search.end.posterior.given(row, np.array([end / unknowns.scale[at] - search.end.vector[at]]))
        there = unknowns.within(search.end.vector + moved)
        estimate = linearised(dataclasses.replace(estimate, state=unknowns.state(there)))
        for _ in range(6):
            estimate = confirmed(estimate, 1e-3)
        assert estimate.vector[at] * unknowns.scale[at] == pytest.approx(end, rel=1e-9)
        assert estimate.misfit - search.end.misfit == pytest.approx(1.96**2, rel=0.05)


@pytest.mark.slow(1)
def test_lmfit_reports_the_result_and_files_hold_ties(given, runs, drive, tmp_path):
    tied = changed(given, **{TIED: {"expr": f"2 * {OF}"}})
    with (tmp_path / "parameters.json").open("w") as file:
        tied.dump(file)
    again = read_parameters(tmp_path / "parameters.json")
    assert {n: (p.value, p.vary, p.min, p.max, p.expr) for n, p in again.items()} == {
        n: (p.value, p.vary, p.min, p.max, p.expr) for n, p in tied.items()
    }
    found = identify(runs, drive, held_out=False, parameters=again)
    assert f"{TIED}:" in lmfit.fit_report(found.lmfit)
    found.write(tmp_path / "fit.json")
    written = read_lmfit_parameters(tmp_path / "fit.json")
    assert written[TIED].expr == f"2 * {OF}"
    assert written[TIED].value == pytest.approx(2.0 * written[OF].value)


@pytest.mark.slow(12)
def test_the_command_takes_a_file_of_parameters(command, tmp_path):
    drive = read_drive(BENCH / "pair.toml")
    given = fitting.parameters(fitting.read_recordings(str(BENCH / "*.csv")), drive)
    given["eccentricity"].set(value=1e-6, vary=False)
    with (tmp_path / "held.json").open("w") as file:
        given.dump(file)
    files = sorted(BENCH.glob("*.csv"))
    drawn = BENCH / "pair.toml"
    run = command("cycloid-fit", "identify", *files, "--pair", drawn, "--parameters", "held.json", "-o", "fit.json")
    assert run.returncode == 0, run.stderr
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["parameters"]["eccentricity"]["value"] == 1e-6
    assert "parameters hold it" in fit["parameters"]["eccentricity"]["held"]
    run = command("cycloid-fit", "identify", *files, "--pair", drawn, "--parameters", "fit.json")
    assert run.returncode == 2
    assert "fit.json: this is not a file of lmfit.Parameters.dump" in run.stderr
    assert "Traceback" not in run.stderr


def dumped(expression, low=None, high=None):
    return json.dumps({"params": [["a", 1.0, True, expression, low, high, None, None, None, 1.0, None]]})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "not a file of lmfit"),
        ("[1", "not a file of lmfit"),
        (dumped("__import__('os')"), "arithmetic"),
        (dumped("b if c else d"), "arithmetic"),
        (dumped("1 +"), "arithmetic"),
        (dumped("2 * b"), "the expression of a names b, which is no parameter of it"),
        (dumped(None, -0.5, 0.5), "a = 1 is outside its bounds, -0.5 to 0.5"),
        (dumped(None, 1.5), "a = 1 is outside its bounds, 1.5 to inf"),
    ],
)
def test_files_that_are_no_parameters_or_run_anything_are_refused(text, said, tmp_path):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(edge.InputError, match=f"p.json.*{said}"):
        read_parameters(tmp_path / "p.json")


def test_unknown_names_are_refused_in_a_sentence(given, runs, drive):
    wrong = copy.deepcopy(given)
    wrong.add("eccentricty", 0.0)
    with pytest.raises(edge.ArgumentError, match="eccentricty is not an unknown of this fit; did you mean eccentric"):
        identify(runs, drive, parameters=wrong)
