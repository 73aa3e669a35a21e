"""The fit itself: the same optimum as finite differences, its intervals, and benches that are not as they should be."""

import dataclasses
import json
import re

import numpy as np
import pytest
from common import EXAMPLES
from scipy.optimize import least_squares

import fitting
import fitting.estimation.fit
import fitting.model.observations
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.sampling import parse_tolerances
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.confirmation import confirmed, stated, with_covariance
from fitting.estimation.fit import fit, turn_bootstrap
from fitting.estimation.identify import identify
from fitting.estimation.minimisation import Search
from fitting.estimation.realised import displaced
from fitting.model.identifiability import chosen_errors, posterior_covariance
from fitting.model.observations import State, errors_of, linearise, observations, spread_of, with_scatter
from fitting.model.prior import Prior, scatter_of
from fitting.model.unknowns import possible
from fitting.readers.recording import Recording
from fitting.reports.report import report
from fitting.transmission_error.curve import Curve

ARCSEC = np.pi / 648000
ERRORS = [
    "centre_distance_x",
    "centre_distance_y",
    "eccentricity",
    "pin_radius",
    "pin_radial_2_cos",
    "tooth_cumulative_pitch_1_sin",
]


def at_nominal(pair, observed):
    return State(surface_of_pair(pair), np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]))


def curve(pair, surface, torque, generator, *, each=12, turns=1.0, wave=0.0, drift=0.0):
    """A curve with 0.5″ of noise, a torque that swings by a share once a crank turn, and a zero that creeps."""
    teeth = abs(round(pair.ratio))
    angle = np.arange(round(teeth * each * turns)) * 2.0 * np.pi / each
    loads = torque * (1.0 + wave * np.cos(angle))
    error = (
        np.array(
            [
                solve(DriveValue(pair, surface), t, a, with_play=False).transmission_error[0, 0]
                for t, a in zip(loads, angle, strict=True)
            ]
        )
        if wave
        else (solve(DriveValue(pair, surface), torque, angle, with_play=False).transmission_error[0])
    )
    error = error + generator.normal(0.0, 0.5 * ARCSEC, angle.size) + drift * angle / (2.0 * np.pi * teeth)
    return Curve(
        angle,
        error,
        np.full(angle.size, np.nan),
        np.ones(angle.size, int),
        float(loads.mean()),
        float(loads.std()),
        int(np.sign(torque)),
        pair.ratio,
        True,
        True,
        f"{torque:g} N·m",
        "0",
        torque_each=loads if wave else None,
    )


def distances(found, pair, surface):
    return {
        p.name: (p.value - structured_value(surface, p.name)) / p.standard_error
        for p in found.parameters
        if p.held is None
    }


@pytest.fixture(scope="module")
def simple(nominal):
    """A drive with a few errors, its observations, and the fit without scatter."""
    made = with_structured(
        surface_of_pair(nominal), dict(zip(ERRORS, np.array([4, -3, 1, 1, 2, -2]) * 1e-6, strict=True))
    )
    generator = np.random.default_rng(3)
    curves = [curve(nominal, made, t, generator, each=6) for t in (20.0, -20.0, 200.0, -200.0)]
    observed = observations(curves, nominal, [0.5 * ARCSEC] * 4)
    return made, observed


@pytest.mark.slow(12)
def test_the_optimum_is_that_of_finite_differences_for_a_twentieth_of_the_evaluations(simple, nominal, monkeypatch):
    observed = simple[1]
    errors = chosen_errors(nominal, observed, linearise(nominal, observed, at_nominal(nominal, observed)), {})
    assert len(errors) > 15
    solved = {"fit": 0, "differences": 0}
    kernel = fitting.model.observations.curve_sensitivity

    def counted(drive, torque, angles, *others):
        solved["fit"] += angles.size
        return kernel(drive, torque, angles, *others)

    monkeypatch.setattr(fitting.model.observations, "curve_sensitivity", counted)
    found = fit(nominal, observed, errors, at_nominal(nominal, observed), {}, gain=0.01, estimated=False)
    known = np.isfinite(observed.bench_prior)
    scale = np.concatenate(
        [np.full(len(errors), 5e-6), np.where(known, observed.bench_prior, 1e-4), [observed.friction_prior]]
    )
    prior = np.concatenate([np.full(len(errors), 1e-3), np.where(known, 1.0, 1e-3), [1.0]])

    def left(unknowns):
        values = unknowns * scale
        surface = with_structured(surface_of_pair(nominal), dict(zip(errors, values, strict=False)))
        model = [
            solve(
                DriveValue(nominal, surface), c.torque + c.direction * values[-1], c.input_angle, with_play=False
            ).transmission_error[0]
            for c in observed.curves
        ]
        solved["differences"] += observed.measured.size
        rest = observed.measured - np.concatenate(model) - observed.bench @ values[len(errors) : -1]
        return np.concatenate([observed.weight * rest, unknowns * prior])

    # Smaller differences see one side of the curves' corners only, and their search ends at one, above the optimum.
    plain = least_squares(left, np.zeros(scale.size), diff_step=1e-4, xtol=1e-6, ftol=1e-6)
    assert solved["differences"] > 20 * solved["fit"] > 0
    assert found.misfit < 2.0 * plain.cost + 0.01
    deviation = np.sqrt(np.diag(np.linalg.inv(plain.jac.T @ plain.jac)))[: len(errors)] * scale[: len(errors)]
    for name, value, one in zip(errors, plain.x * scale, deviation, strict=False):
        assert structured_value(found.state.surface, name) == pytest.approx(value, abs=0.1 * one), name


@pytest.mark.slow(3)
def test_the_last_step_confirms_the_optimum_and_its_covariance(simple, nominal, monkeypatch):
    """It moves no error by more than a twentieth of its standard error, for two evaluations of the model at most."""
    _, observed = simple
    found = fit(
        nominal, observed, ERRORS, at_nominal(nominal, observed), {"pin_radial": 1e-6}, gain=1e-3, estimated=False
    )
    solved = 0
    kernel = fitting.model.observations.curve_sensitivity

    def counted(drive, torque, angles, *others):
        nonlocal solved
        solved += angles.size
        return kernel(drive, torque, angles, *others)

    monkeypatch.setattr(fitting.model.observations, "curve_sensitivity", counted)
    again = confirmed(found, gain=1e-6)
    parameters, covariance = stated(again)
    parameters = with_covariance(parameters, covariance)
    assert 0 < solved <= 2 * observed.measured.size
    assert again.misfit <= found.misfit * (1.0 + 1e-12)
    for name in ERRORS:
        moved = parameters[name].value - structured_value(with_scatter(found.state.surface, -found.state.scatter), name)
        assert abs(moved) < 0.05 * parameters[name].stderr
    wanted = posterior_covariance(nominal, found.observed, again.linear, ERRORS, found.scatter)
    wanted = wanted[: len(ERRORS), : len(ERRORS)]
    size = np.sqrt(np.diag(wanted))
    assert covariance[: len(ERRORS), : len(ERRORS)] / np.outer(size, size) == pytest.approx(
        wanted / np.outer(size, size), abs=1e-3
    )
    assert parameters["eccentricity"].correl["centre_distance_x"] == pytest.approx(
        wanted[2, 0] / (size[2] * size[0]), abs=1e-3
    )


def test_the_last_step_leads_to_the_optimum_from_beside_it(simple, nominal):
    _, observed = simple
    found = fit(nominal, observed, ERRORS, at_nominal(nominal, observed), {}, gain=1e-3, estimated=False)
    moved = with_structured(
        found.state.surface,
        {"eccentricity": structured_value(found.state.surface, "eccentricity") + 200e-9},
    )
    state = dataclasses.replace(found.state, surface=moved)
    beside = dataclasses.replace(found, state=state, linear=linearise(nominal, found.observed, state))
    again = confirmed(beside, gain=1e-3)
    parameters, covariance = stated(again)
    parameters = with_covariance(parameters, covariance)
    assert parameters["eccentricity"].stderr < 100e-9
    for name in ERRORS:
        value = structured_value(found.state.surface, name)
        assert parameters[name].value == pytest.approx(value, abs=0.1 * parameters[name].stderr), name
    assert again.misfit == pytest.approx(found.misfit, rel=1e-3)


def test_bounds_are_where_the_pair_ceases_to_be_one(nominal):
    for name in ("pin_radius", "eccentricity"):
        low, high = possible(nominal, name)
        assert -1e-3 <= low < 0.0 < high <= 1e-3
    thin = nominal.replace(eccentricity=0.4e-3)
    assert possible(thin, "eccentricity")[0] == -0.4e-3
    assert possible(nominal, "misalignment_xz") == (-0.02, 0.02)
    touching = nominal.pin_circle_radius * np.sin(np.pi / nominal.pins)
    wide = nominal.replace(eccentricity=0.1e-3, pin_radius=touching - 1e-4)
    assert possible(wide, "pin_radius")[1] == pytest.approx(1e-4)


@pytest.mark.slow(3)
def test_a_fit_that_leaves_what_is_possible_ends_at_its_bound_and_says_so(simple, nominal, monkeypatch):
    _, observed = simple
    monkeypatch.setattr(
        "fitting.model.unknowns.possible",
        lambda pair, name: (-0.5e-6, 0.5e-6) if name == "pin_radius" else (-1e-3, 1e-3),
    )
    found = identify(observed.curves, Drive(nominal), held_out=False)
    one = found.lmfit_parameters["pin_radius"]
    assert one.value == pytest.approx(0.5e-6, rel=1e-3)  # 1 µm was made
    assert one.value <= one.max
    assert any("pin_radius ends at 0.0005 mm, as far as it can be" in n for n in found.notes)


@pytest.mark.slow(2)
def test_a_profile_is_the_interval_by_standard_error_where_the_model_is_linear(simple, nominal):
    _, observed = simple
    found = fit(nominal, observed, ERRORS, at_nominal(nominal, observed), {}, gain=1e-3, estimated=False)
    columns = observed.weight[:, None] * np.column_stack(
        [found.linear.structured, observed.bench, found.linear.by_friction]
    )
    names = errors_of(nominal)
    kept = [names.index(n) for n in ERRORS] + list(range(len(names), columns.shape[1]))
    known = np.concatenate([np.zeros(len(ERRORS)), observed.bench_prior**-2.0, [observed.friction_prior**-2.0]])
    deviation = np.sqrt(np.diag(np.linalg.inv(columns[:, kept].T @ columns[:, kept] + np.diag(known))))
    low, high = Search(found).interval("centre_distance_x", 1.5 * deviation[0], 1.96**2)
    value = structured_value(found.state.surface, "centre_distance_x")
    assert high - value == pytest.approx(1.96 * deviation[0], rel=0.1)
    assert value - low == pytest.approx(1.96 * deviation[0], rel=0.1)


def test_turns_drawn_again_show_what_is_not_white(simple, nominal):
    """White turns give the result of white noise; turns that wander together at order 39 give more."""
    _, observed = simple
    found = fit(nominal, observed, ERRORS, at_nominal(nominal, observed), {}, gain=1e-3, estimated=False)
    generator = np.random.default_rng(0)
    turns = 30

    def errors(wander):
        curves = []
        for c in found.observed.curves:
            each = generator.normal(0.0, 0.5 * ARCSEC * np.sqrt(turns), (turns, c.input_angle.size))
            each = each + wander * np.outer(generator.normal(0.0, 1.0, turns), np.cos(c.input_angle))
            curves.append(dataclasses.replace(c, each_turn=c.transmission_error + each - each.mean(axis=0)))
        one = dataclasses.replace(found, observed=dataclasses.replace(found.observed, curves=tuple(curves)))
        return turn_bootstrap(one, 400, seed=1)

    drawn, white = errors(0.0)
    assert drawn == pytest.approx(white, rel=0.35)
    assert np.median(drawn / white) == pytest.approx(1.0, abs=0.12)
    drawn, white = errors(5.0 * ARCSEC)
    assert drawn[ERRORS.index("centre_distance_x")] > 3.0 * white[ERRORS.index("centre_distance_x")]
    assert drawn[ERRORS.index("tooth_cumulative_pitch_1_sin")] < 1.5 * white[-1]
    with pytest.raises(ValueError, match="turns"):
        turn_bootstrap(found, 10, seed=1)


def test_a_curve_keeps_its_turns_where_asked_to(nominal):
    angle = np.arange(5 * 39 * 20) * 2.0 * np.pi / 20
    number = np.floor(angle / (2.0 * np.pi * 39) + 1e-9)
    recording = Recording(
        time=np.arange(angle.size) * 1e-3,
        input_angle=angle,
        output_angle=angle / -39.0 + 1e-5 * number,
        torque=20.0 + 5.0 * np.cos(angle),
        status=np.zeros(angle.size, np.uint8),
        source="run",
        checksum="0",
        common_zero=True,
        known_index=True,
        ratio=-39.0,
    )
    (one,) = fitting.curves(recording, -39.0, keep_turns=True)
    assert one.each_turn.shape == (5, one.input_angle.size)
    assert np.nanmean(one.each_turn, axis=1) == pytest.approx(1e-5 * np.arange(5), abs=1e-12)
    assert np.nanmean(one.each_turn, axis=0) == pytest.approx(one.transmission_error, abs=1e-12)
    assert one.torque_each == pytest.approx(20.0 + 5.0 * np.cos(one.input_angle), abs=1e-6)
    assert fitting.curves(recording, -39.0)[0].each_turn is None


def swinging(nominal, made, seed):
    """Curves with a torque that swings by 0.3 of itself and a zero that creeps by 2″ from each to the next."""
    generator = np.random.default_rng(seed)
    loads = (20.0, -20.0, 200.0, -200.0)
    return [curve(nominal, made, t, generator, wave=0.3, drift=k * 2.0 * ARCSEC) for k, t in enumerate(loads)]


@pytest.mark.slow(7)
def test_a_torque_that_swings_and_a_zero_that_creeps_do_not_bend_the_errors(simple, nominal):
    made, _ = simple
    found = identify(swinging(nominal, made, 5), Drive(nominal), held_out=False)
    far = distances(found, nominal, made)
    assert len(far) > 15
    assert max(abs(z) for z in far.values()) < 4.0
    assert found.residual < 0.55 * ARCSEC
    drifts = [found.bench[f"output_angle_drift_{k}"] for k in range(4)]
    assert np.diff(drifts) == pytest.approx(np.full(3, 2.0 * ARCSEC), abs=0.5 * ARCSEC)


@pytest.mark.slow(40)
@pytest.mark.parametrize("seed", [5, 6, 7])  # a fit of its first-order effect alone missed 5 and 6
def test_a_torque_that_swings_unseen_is_named(simple, nominal, seed):
    made, _ = simple
    blind = [dataclasses.replace(c, torque_each=None) for c in swinging(nominal, made, seed)]
    found = identify(blind, Drive(nominal), held_out=False)
    assert found.verdict.state == "explained but for"
    assert found.verdict.misfits[0].cause == "torque_ripple"
    assert max(abs(z) for z in distances(found, nominal, made).values()) < 4.0


@pytest.mark.slow(1)
@pytest.mark.parametrize("pattern", ["pin_tangential", "tooth_cumulative_pitch"])
def test_errors_of_pins_and_teeth_are_never_swapped(nominal, pattern):
    made = with_structured(surface_of_pair(nominal), {f"{pattern}_2_cos": 3e-6, f"{pattern}_3_sin": -2e-6})
    generator = np.random.default_rng(7)
    curves = [curve(nominal, made, t, generator) for t in (20.0, -20.0, 200.0, -200.0)]
    found = identify(curves, Drive(nominal), held_out=False)
    far = distances(found, nominal, made)
    assert max(abs(z) for z in far.values()) < 4.0
    other = {"pin_tangential": "tooth_cumulative_pitch", "tooth_cumulative_pitch": "pin_tangential"}[pattern]
    values = {p.name: p.value for p in found.parameters if p.held is None}
    assert values[f"{pattern}_2_cos"] == pytest.approx(3e-6, rel=0.1)
    assert all(abs(v) < 0.1e-6 for n, v in values.items() if n.startswith(other))


def panels_in(page):
    return json.loads(re.search(r"const panels = (.*);", page)[1])


@pytest.mark.slow(3)
def test_every_pin_and_tooth_by_itself(nominal, tmp_path):
    """With tolerances as prior each pin's position is found within its interval; the report needs no other file."""
    generator = np.random.default_rng(11)
    made = surface_of_pair(nominal)
    made = dataclasses.replace(made, pin_tangential=generator.normal(0.0, 1e-6, 40))
    curves = [curve(nominal, made, t, generator, each=24) for t in (20.0, -20.0, 200.0, -200.0)]
    tolerances = parse_tolerances((EXAMPLES / "tolerances.toml").read_text(), "tolerances.toml")
    known = scatter_of(nominal, tolerances)
    assert set(known) == {"pin_tangential", "tooth_cumulative_pitch", "pin_radius_deviation"}
    assert 0.2e-6 < known["pin_tangential"] < 3e-6  # within a single pitch of ± 3 µm
    found = identify(curves, Drive(nominal), held_out=False, tolerances=Prior(known), profiled=["isometric"])
    assert any(n.startswith("isometric is held, so it has no profile") for n in found.notes)
    assert len(found.realised.elements) == 40 + 40 + 39 + 40
    tangential = found.realised.circles["pin_tangential"]
    truth = displaced(nominal, made)[tangential]
    values = np.array([p.value for p in found.realised.elements[tangential]])
    errors = np.array([p.standard_error for p in found.realised.elements[tangential]])
    assert np.mean(np.abs(values - truth) < 1.96 * errors) > 0.85
    report(found, tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text()
    assert text.count('<table id="realised') == 2
    assert 'id="correlation"' in text
    (axis,) = (p["layout"]["yaxis"] for p in panels_in(text) if p["layout"]["yaxis"].get("ticktext"))
    assert axis["ticktext"] == [p.name for p in found.parameters if p.held is None and p.unit == "m"]
    assert "<link" not in text
    assert 'src="http' not in text
    with pytest.raises(edge.InputError, match=r"must end in \.html"):
        report(found, tmp_path / "fit.pdf")


@pytest.mark.slow(2)
def test_what_bench_runs_lack_is_said(simple, nominal):
    made, _ = simple
    generator = np.random.default_rng(13)
    curves = [curve(nominal, made, t, generator, turns=0.4) for t in (20.0, 200.0)]
    found = identify(curves, Drive(nominal))
    assert any("covers 0.40 of an output turn" in n for n in found.notes)
    assert any("one way only" in n for n in found.notes)
    assert any("one sign" in n for n in found.notes)
    whole = [curve(nominal, made, t, generator) for t in (20.0, -20.0, 200.0)]
    added = 300 * ARCSEC * np.cos(whole[0].input_angle / 39)
    strong = [dataclasses.replace(c, transmission_error=c.transmission_error + added) for c in whole]
    found = identify(strong, Drive(nominal), held_out=False)
    assert any("order 1 of the output 300" in n for n in found.notes), found.notes
    assert max(abs(z) for z in distances(found, nominal, made).values()) < 4.5
    with pytest.raises(edge.InputError, match="of another drive"):
        identify([dataclasses.replace(curves[0], ratio=-29.0)], Drive(nominal))
    with pytest.raises(edge.InputError, match="turns again"):
        identify(curves, Drive(nominal), bootstrap=50)
    with pytest.raises(edge.InputError, match="bootstrap = 1: it must be 0, for none, or at least 20"):
        identify(curves, Drive(nominal), bootstrap=1)  # whose scatter is zero, so that it widened nothing
    with pytest.raises(
        edge.InputError, match='profiled = "eccentric": it is not an error of this drive; did you mean eccentricity'
    ):
        identify(curves, Drive(nominal), profiled=["eccentric"])
