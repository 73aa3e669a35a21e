"""Drives to first order against the exact ones, and the allocation of tolerances based on them."""

import dataclasses

import numpy as np
import pytest
from common import EXAMPLES, make_pair

from cycloid_fmu import edge
from cycloid_fmu.contact.near_drives import NearDrives
from cycloid_fmu.contact.transmission import error_sensitivity, solve
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.studies import tolerance
from cycloid_fmu.studies.allocation import Nearby, allocate, errors_of_factors, scaled, steps
from cycloid_fmu.studies.tolerance import Study, figures_near, points, screened, surface_of
from cycloid_fmu.supports.transmission import sensitivity
from cycloid_fmu.surfaces.sampling import parse_tolerances, read_tolerances
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import nominal_surface

DRIVE = read_pair(EXAMPLES / "drive-39-40.toml")
EVERY = read_tolerances(EXAMPLES / "tolerances.toml").replace(gear_profile=None, pin_profile=None)
ANGLES = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
ARCSEC = np.pi / 648000
HEAD = 'format = "cycloid-tolerances/1"\n'
MODIFIED = '\n[modification]\nisometric = "-15 um"\noffset = "-40 um"\n'


def near(pair, loads, slices=1, surface=None):
    """Drives to first order beside a drive, by default the error-free one."""
    return NearDrives(pair, surface or nominal_surface(pair), loads, slices, first_order=True)


def made(drives, pair, surfaces):
    return drives.made(np.array([displacement_vector(pair, s) for s in surfaces]))


def both(pair, surfaces, torque, slices=1):
    """Transmission error, pressure, backlash to first order and exactly, each (drives, angles)."""
    drives = near(pair, [(torque, ANGLES), (0.0, ANGLES)], slices)
    some = made(drives, pair, surfaces)
    first = (*drives.loaded(0, some), drives.play(1, some)[0])
    exact = [solve(pair, s, torque, ANGLES, slices) for s in surfaces]
    return zip(
        first,
        (
            [e.transmission_error[0] for e in exact],
            [e.max_contact_pressure[0] for e in exact],
            [e.backlash for e in exact],
        ),
        strict=True,
    )


@pytest.mark.parametrize("torque", [181.0, -30.0])
def test_without_errors_both_agree(torque):
    for first, exact in both(DRIVE, [nominal_surface(DRIVE)], torque):
        assert first == pytest.approx(np.array(exact), rel=1e-5)  # rotation to second order only


@pytest.mark.parametrize("pair", [DRIVE, make_pair(DRIVE.text, discs=2), make_pair(DRIVE.text, output="ring")])
def test_derivatives_to_first_order(pair):
    """At the contacts' own drive the exact ones but for the arms' part; beside it those of finite differences."""
    study = Study(pair, EVERY, 1, 3, (181.0,))
    surface = surface_of(study, points(study)[0])
    torque = np.where(ANGLES < 3.0, 181.0, 40.0)
    drives, errors = near(pair, [(181.0, ANGLES)], surface=surface), displacement_vector(pair, surface)
    error, each, by_torque = drives.sensitivities(0, errors, torque)
    exact, _, exact_each, further = error_sensitivity(pair, surface, torque, ANGLES, [])
    # Rotation to second order takes the contacts to another torque.
    assert (np.abs(error - exact) <= np.where(torque == 181.0, 1e-9, 2e-3 * np.abs(exact))).all()
    assert by_torque == pytest.approx(further[:, 1], rel=0.02)
    largest = np.abs(exact_each).max(axis=0)
    assert (np.abs(each - exact_each).max(axis=0) <= 0.05 * largest).all()
    moved = np.random.default_rng(1).normal(0.0, 1e-9, errors.size)
    there, back = (drives.sensitivities(0, errors + sign * moved, torque)[0] for sign in (1.0, -1.0))
    assert 0.5 * (there - back) == pytest.approx(each @ moved, rel=1e-4, abs=1e-13)


@pytest.mark.parametrize(
    ("pair", "slices"),
    [
        (DRIVE, 1),
        (make_pair(DRIVE.text, discs=2), 1),
        (make_pair(DRIVE.text, output="ring"), 1),
        (DRIVE, 4),
    ],
    ids=["one disc", "two discs", "ring", "misaligned"],
)
def test_errors_half_as_large_differ_a_quarter(pair, slices):
    """The terms that first order neglects are of second order in the errors: each error has its sign and size."""
    tolerances = EVERY if slices > 1 else EVERY.replace(**dict.fromkeys(("misalignment_xz", "misalignment_yz")))
    study = Study(pair, tolerances, 8, 5, (181.0,))
    worst = []
    for scale in (1.0, 0.5):
        narrow = scaled(study, np.full(len(study.factors), scale))
        surfaces = [surface_of(narrow, p) for p in points(study)]
        compared = both(pair, surfaces, 181.0, slices)
        worst.append([np.sqrt(np.mean((first - np.array(exact)) ** 2)) for first, exact in compared])
    error, pressure, backlash = np.array(worst).T
    assert backlash[0] < 0.2 * ARCSEC
    assert backlash[1] < 0.35 * backlash[0]
    # Under load a little of first order is left out as well: the curvatures' own change.
    assert error[0] < 0.1 * ARCSEC
    assert error[1] < 0.55 * error[0]
    assert pressure[0] < 10e6
    assert pressure[1] < 0.75 * pressure[0]


def test_a_drive_among_others_is_the_same_drive():
    study = Study(DRIVE, EVERY, 11, 7, (181.0,))
    drives, surfaces = near(DRIVE, [(-60.0, ANGLES), (0.0, ANGLES)], 4), [surface_of(study, p) for p in points(study)]
    every = made(drives, DRIVE, surfaces)
    together = (*drives.loaded(0, every), *drives.play(1, every))
    for k in range(11):
        one = made(drives, DRIVE, surfaces[k : k + 1])
        alone = (*drives.loaded(0, one), *drives.play(1, one))
        assert all((a[0] == b[k]).all() for a, b in zip(alone, together, strict=True))


def test_the_derivative_by_torque_is_the_slope_of_the_rotation_through_zero():
    """Contacts that were pressed at the crank angle before leave no force behind."""
    angles, torque = (
        np.linspace(0.0, 2.0 * np.pi, 60),
        np.concatenate([np.linspace(100.0, 3.0, 30), np.linspace(-3.0, -100.0, 30)]),
    )
    drives, none = near(DRIVE, [(100.0, angles)]), displacement_vector(DRIVE, nominal_surface(DRIVE))
    errors = none + np.random.default_rng(0).normal(0.0, 2e-6, none.size)
    up, down = (drives.sensitivities(0, errors, torque + step)[0] for step in (1e-3, -1e-3))
    by_torque = drives.sensitivities(0, errors, torque)[2]
    assert by_torque == pytest.approx((up - down) / 2e-3, rel=1e-4)


def test_a_small_drive_with_much_play_is_pressed():
    """Its play is a hundred times the rotation within which contacts are looked at in each step."""
    small = DRIVE.replace(
        gear_teeth=9,
        pins=10,
        pin_circle_radius=0.01,
        pin_radius=0.001,
        eccentricity=0.0005,
        face_width=0.01,
        rated_torque=5.0,
    )
    loose = dataclasses.replace(nominal_surface(small), pin_radius=-40e-6)
    drives = near(small, [(2.0, ANGLES)])
    rotation, pressure = drives.loaded(0, made(drives, small, [loose]))
    exact = solve(small, loose, 2.0, ANGLES, 1)
    assert np.abs(exact.transmission_error).min() > 5e-3
    assert rotation[0] == pytest.approx(exact.transmission_error[0], rel=0.02)
    assert pressure.min() > 0.0


def test_interference_is_found_with_its_depth():
    tight = dataclasses.replace(nominal_surface(DRIVE), pin_radius=12e-6, centre_distance_x=3e-6)
    drives = near(DRIVE, [(0.0, ANGLES)])
    backlash, depth = drives.play(0, made(drives, DRIVE, [tight]))
    exact = solve(DRIVE, tight, [], ANGLES)
    assert np.isnan(exact.backlash).any()
    assert (np.isnan(backlash[0]) == np.isnan(exact.backlash)).all()
    assert depth[0] == pytest.approx(exact.interference, abs=0.1e-6)


def test_screening_confirms_what_is_near_the_limits_exactly():
    text = '[pin_radius]\ntolerance = "2 um"\n[centre_distance_x]\ntolerance = "4 um"\n'
    limits = parse_tolerances(HEAD + text + '[limits]\nbacklash = "70 arcsec"\n', "t.toml")
    study = Study(DRIVE, limits, 60, 1, (181.0,), angles=40)
    found, exact = screened(study, 0.2), tolerance.run(study)
    assert found.confirmed.size == 12
    assert (found.result.values[found.confirmed] == exact.values[found.confirmed]).all()
    assert found.difference["backlash"] < 0.5 * ARCSEC
    assert found.difference["angular_transmission_error"] > 0.0
    rest = np.setdiff1d(np.arange(60), found.confirmed)
    distance = np.abs(exact.figure("backlash") - 70 * ARCSEC)
    assert distance[found.confirmed].max() < distance[rest].min() + 0.5 * ARCSEC
    assert tolerance.yields(found.result) == tolerance.yields(exact)


def test_each_factor_has_its_own_columns():
    study = Study(DRIVE, EVERY, 4, 1, (181.0,))
    place = points(study)[1]
    whole = displacement_vector(DRIVE, surface_of(study, place))
    of_factors = errors_of_factors(study, place[None])[:, 0]
    assert of_factors.sum(axis=0) == pytest.approx(whole, rel=1e-12, abs=1e-18)
    for i, of_factor in enumerate(of_factors):
        scale = np.ones(len(study.factors))
        scale[i] = 2.0
        wider = displacement_vector(DRIVE, surface_of(scaled(study, scale), place))
        assert wider == pytest.approx(whole + of_factor, rel=1e-12, abs=1e-18)


@pytest.mark.slow(5)
def test_allocation_is_the_optimum_of_two_linear_errors():
    """Backlash is linear in two radii; with a reciprocal cost the optimum is s ∝ (c/a²)^(1/3) for slopes a."""
    text = (
        '[pin_radius]\ntolerance = "2 um"\n[pin_circle_diameter]\ntolerance = "4 um"\n'
        '[limits]\nbacklash = "{} arcsec"\n[costs]\npin_radius = 6\n'
    )
    nominal = solve(DRIVE, nominal_surface(DRIVE), [], ANGLES).backlash
    study = Study(
        DRIVE, parse_tolerances(HEAD + text.format(nominal.max() / ARCSEC + 8.0), "t.toml"), 400, 1, (181.0,), angles=20
    )
    reported = []
    found = allocate(study, 0.9, "t.toml", progress=reported.append)
    assert sum(reported) == steps()
    assert 0.9 <= found.exact_yield < 0.92
    slope = []
    for name, width in (("pin_radius", 2e-6), ("pin_circle_radius", 2e-6)):
        changed = dataclasses.replace(nominal_surface(DRIVE), **{name: width})
        slope.append((solve(DRIVE, changed, [], ANGLES).backlash - nominal).mean())
    order = [study.factors.index(n) for n in ("pin_radius", "pin_circle_diameter")]
    ratio = found.scale[order[0]] / found.scale[order[1]]
    assert ratio == pytest.approx((6.0 * slope[1] ** 2 / slope[0] ** 2) ** (1 / 3), rel=0.15)
    costs = np.array([1.0, 1.0])
    costs[order[0]] = 6.0
    assert found.cost == pytest.approx((costs / found.scale).sum())


ON_BEARINGS = (
    '[hole_x]\ntolerance = "5 um"\n[hole_y]\ntolerance = "5 um"\n[crank_throw]\ntolerance = "3 um"\n'
    '[pin_pitch]\nsingle = "2 um"\ncumulative = "8 um"\n'
)


@pytest.mark.slow(11)
def test_first_order_on_bearings_is_about_each_drive(record_property):
    """Errors open and close clearances: about the error-free drive a tenth is missed, about each drive itself 1 %."""
    pair = read_pair(EXAMPLES / "drive-39-40-bearings.toml")
    limits = '[limits]\nlost_motion = "150 arcsec"\nmax_contact_pressure = "2 GPa"\n'
    study = Study(pair, parse_tolerances(HEAD + ON_BEARINGS + limits, "t.toml"), 8, 1, (543.0,), angles=50)
    place, scale = points(study), np.array([0.8, 0.8, 0.8, 1.2])
    errors = errors_of_factors(study, place)
    exact = tolerance.run(scaled(study, scale))
    near = Nearby(study, place, errors, np.ones(4))
    found = dict(zip(study.columns, figures_near(study, near, scale).T, strict=True))
    sure = dict(zip(study.columns, exact.values.T, strict=True))
    crank = tolerance.crank_angles(study)
    one = sensitivity(pair, nominal_surface(pair), 543.0, crank)
    about_none = [np.ptp(one.transmission_error + one.by_displacement @ e) for e in np.tensordot(scale, errors, 1)]
    error = sure["angular_transmission_error", 0]
    record_property("first order about the error-free drive", f"{np.abs(about_none / error - 1).max():.1%}")
    record_property(
        "first order about each drive", f"{np.abs(found['angular_transmission_error', 0] / error - 1).max():.2%}"
    )
    assert 0.05 < np.abs(about_none / error - 1).max() < 0.2
    assert found["angular_transmission_error", 0] == pytest.approx(error, rel=0.01)
    assert found["mean_transmission_error", 0] == pytest.approx(sure["mean_transmission_error", 0], abs=0.05 * ARCSEC)
    assert found["max_contact_pressure", 0] == pytest.approx(sure["max_contact_pressure", 0], rel=0.02)
    assert found["lost_motion", None] == pytest.approx(sure["lost_motion", None], abs=2 * ARCSEC)
    assert found["backlash", None] == pytest.approx(sure["backlash", None], abs=5 * ARCSEC)


@pytest.mark.slow(5)
def test_allocation_on_bearings_widens_what_hardly_matters():
    """Pins all alike thicker make play, holes and throws the transmission error that is limited."""
    pair = read_pair(EXAMPLES / "drive-39-40-bearings.toml")
    limits = '[limits]\nangular_transmission_error = "9 arcsec"\n'
    text = '[hole_x]\ntolerance = "4 um"\n[crank_throw]\ntolerance = "3 um"\n[pin_radius]\ntolerance = "1 um"\n'
    study = Study(pair, parse_tolerances(HEAD + text + limits, "t.toml"), 8, 1, (543.0,), angles=12)
    found = allocate(study, 0.75, "t.toml")
    assert found.exact_yield >= 0.75
    assert found.scale[0] > 2.0 * found.scale[1:].max()
    assert found.cost < found.stated_cost
    with pytest.raises(edge.InputError, match="leave it out with supports"):
        screened(study, 0.5)


@pytest.mark.parametrize(
    ("limits", "target", "said"),
    [
        ('[limits]\nbacklash = "1 arcsec"\n', 0.9, "t.toml: [limits] backlash: the error-free drive itself takes"),
        ("", 0.9, "t.toml: [limits] is missing"),
        ('[limits]\nbacklash = "99 arcsec"\n', 1.0, "target = 1: the yield to reach must be between 0 and 1"),
    ],
)
def test_yields_that_can_t_be_met_are_one_sentence(limits, target, said):
    tolerances = parse_tolerances(HEAD + '[pin_radius]\ntolerance = "2 um"\n' + limits, "t.toml")
    with pytest.raises(edge.InputError) as caught:
        allocate(Study(DRIVE, tolerances, 16, 1, (181.0,), angles=20), target, "t.toml")
    assert str(caught.value).startswith(said)
    assert str(caught.value).count("\n") == 0


def test_form_deviations_are_left_to_the_exact_model():
    study = Study(DRIVE, read_tolerances(EXAMPLES / "tolerances.toml"), 4, 1, (181.0,))
    with pytest.raises(edge.InputError, match=r"gear_profile.*exact model"):
        tolerance.check_first_order(study, "t.toml")
