"""Drives to first order in their errors, about one that is solved, against the exact ones."""

import dataclasses

import numpy as np
import pytest
from common import EXAMPLES, make_pair

from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.studies.allocation import scaled
from cycloid_fmu.studies.tolerance import Study, points, surface_of
from cycloid_fmu.surfaces.sampling import read_tolerances
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import nominal_surface
from fitting.model.near_drive import NearDrive

DRIVE = read_pair(EXAMPLES / "drive-39-40.toml")
WITHOUT = ("gear_profile", "pin_profile", "misalignment_xz", "misalignment_yz")
PLACES = read_tolerances(EXAMPLES / "tolerances.toml").replace(**dict.fromkeys(WITHOUT))
ANGLES = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
ARCSEC = np.pi / 648000
PAIRS = [DRIVE, make_pair(DRIVE.text, discs=2), make_pair(DRIVE.text, output="ring")]
NAMES = ["one disc", "two discs", "ring"]


def near(pair, torque, surface=None, angles=ANGLES):
    """What takes drives near one, by default the error-free one, to first order."""
    return NearDrive(DriveValue(pair, surface or nominal_surface(pair)), torque, angles)


def error_of(pair, drive, surface, torque):
    return drive.sensitivities(displacement_vector(pair, surface), np.full(ANGLES.size, torque))[0]


@pytest.mark.parametrize("torque", [181.0, -30.0])
def test_without_errors_both_agree(torque):
    plain = nominal_surface(DRIVE)
    exact = solve(DriveValue(DRIVE, plain), torque, ANGLES, with_play=False).transmission_error[0]
    assert error_of(DRIVE, near(DRIVE, torque), plain, torque) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("pair", PAIRS, ids=NAMES)
def test_derivatives_to_first_order(pair):
    """At the contacts' own drive the exact ones but for the arms' part; beside it those of finite differences."""
    study = Study(pair, PLACES, 1, 3, (181.0,))
    surface = surface_of(study, points(study)[0])
    torque = np.where(ANGLES < 3.0, 181.0, 40.0)
    drive, errors = near(pair, 181.0, surface), displacement_vector(pair, surface)
    error, each, by_torque = drive.sensitivities(errors, torque)
    exact = sensitivity(DriveValue(pair, surface), torque, ANGLES)
    # Rotation to second order takes the contacts to another torque.
    allowed = np.where(torque == 181.0, 1e-9, 2e-3 * np.abs(exact.transmission_error))
    assert (np.abs(error - exact.transmission_error) <= allowed).all()
    assert by_torque == pytest.approx(exact.by_torque, rel=0.02)
    largest = np.abs(exact.by_displacement).max(axis=0)
    assert (np.abs(each - exact.by_displacement).max(axis=0) <= 0.05 * largest).all()
    moved = np.random.default_rng(1).normal(0.0, 1e-9, errors.size)
    there, back = (drive.sensitivities(errors + sign * moved, torque)[0] for sign in (1.0, -1.0))
    assert 0.5 * (there - back) == pytest.approx(each @ moved, rel=1e-4, abs=1e-13)


@pytest.mark.parametrize("pair", PAIRS, ids=NAMES)
def test_errors_half_as_large_differ_by_half_or_less(pair):
    """Of first order only the curvatures' own change is neglected; each error has its sign and size."""
    study = Study(pair, PLACES, 8, 5, (181.0,))
    drive, worst = near(pair, 181.0), []
    for scale in (1.0, 0.5):
        narrow = scaled(study, np.full(len(study.factors), scale))
        surfaces = [surface_of(narrow, p) for p in points(study)]
        first = np.array([error_of(pair, drive, s, 181.0) for s in surfaces])
        exact = np.array(
            [solve(DriveValue(pair, s), 181.0, ANGLES, with_play=False).transmission_error[0] for s in surfaces]
        )
        worst.append(np.sqrt(np.mean((first - exact) ** 2)))
    assert worst[0] < 0.1 * ARCSEC
    assert worst[1] < 0.55 * worst[0]


def test_the_derivative_by_torque_is_the_slope_of_the_rotation_through_zero():
    """Contacts that were pressed at the crank angle before leave no force behind."""
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    torque = np.concatenate([np.linspace(100.0, 3.0, 30), np.linspace(-3.0, -100.0, 30)])
    drive, none = near(DRIVE, 100.0, angles=angles), displacement_vector(DRIVE, nominal_surface(DRIVE))
    errors = none + np.random.default_rng(0).normal(0.0, 2e-6, none.size)
    up, down = (drive.sensitivities(errors, torque + step)[0] for step in (1e-3, -1e-3))
    by_torque = drive.sensitivities(errors, torque)[2]
    assert by_torque == pytest.approx((up - down) / 2e-3, rel=1e-4)


def test_a_small_drive_with_much_play_is_pressed():
    """Its play is a thousand times the rotation of a step that ends the search."""
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
    exact = solve(DriveValue(small, loose), 2.0, ANGLES, 1).transmission_error[0]
    assert np.abs(exact).min() > 5e-3
    assert error_of(small, near(small, 2.0), loose, 2.0) == pytest.approx(exact, rel=0.02)
