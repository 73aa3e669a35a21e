"""The cheapest tolerances that reach a yield."""

import dataclasses

import numpy as np
import pytest
from common import EXAMPLES
from scipy.stats import beta

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.studies.allocation import allocate, scaled, steps
from cycloid_fmu.studies.tolerance import Study, points, surface_of
from cycloid_fmu.surfaces.sampling import parse_tolerances, read_tolerances
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import nominal_surface

DRIVE = read_pair(EXAMPLES / "drive-39-40.toml")
ANGLES = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
ARCSEC = np.pi / 648000
HEAD = 'format = "cycloid-tolerances/1"\n'


def test_errors_scale_with_their_own_tolerance():
    every = read_tolerances(EXAMPLES / "tolerances.toml").replace(gear_profile=None, pin_profile=None)
    study = Study(DRIVE, every, 4, 1, (181.0,))
    place, none = points(study)[1], displacement_vector(DRIVE, nominal_surface(DRIVE))
    whole = displacement_vector(DRIVE, surface_of(study, place)) - none
    moved = []
    for one in np.eye(len(study.factors)):
        moved.append(displacement_vector(DRIVE, surface_of(scaled(study, 1.0 + one), place)) - none - whole)
    assert np.sum(moved, axis=0) == pytest.approx(whole, rel=1e-12, abs=1e-18)
    assert all(np.abs(one).max() > 0.0 for one in moved)


@pytest.mark.parametrize("correlation", ['"none"', "{ profile = 0.2, width = 0.4 }"])
def test_form_deviations_scale_with_their_tolerance(correlation):
    text = f'[gear_profile]\ntolerance = "4 um"\ncorrelation = {correlation}\n'
    study = Study(DRIVE, parse_tolerances(HEAD + text, "t.toml"), 2, 1, (181.0,))
    place = points(study)[1]
    once, twice = (surface_of(each, place).gear_deviation for each in (study, scaled(study, np.array([2.0]))))
    assert np.abs(once).max() > 0.0
    assert twice == pytest.approx(2.0 * once)


@pytest.mark.slow(5)
@pytest.mark.parametrize("room", [8.0, 1.5])
def test_allocation_is_the_optimum_of_two_linear_errors(room):
    """Backlash is linear in two radii; with a reciprocal cost the optimum is s ∝ (c/a²)^(1/3) for slopes a.

    The tolerances as stated are too narrow for 8″ of room, and far too wide for 1.5″.
    """
    text = (
        '[pin_radius]\ntolerance = "2 um"\n[pin_circle_diameter]\ntolerance = "4 um"\n'
        '[limits]\nbacklash = "{} arcsec"\n[costs]\npin_radius = 6\n'
    )
    nominal = solve(DriveValue(DRIVE, nominal_surface(DRIVE)), [], ANGLES).backlash
    limited = parse_tolerances(HEAD + text.format(nominal.max() / ARCSEC + room), "t.toml")
    study = Study(DRIVE, limited, 400, 1, (181.0,), angles=20)
    reported = []
    found = allocate(study, 0.9, "t.toml", progress=reported.append)
    assert sum(reported) == steps()
    assert 0.9 <= found.exact_yield < 0.92
    drives = 400
    good = round(found.exact_yield * drives)
    ends = beta.ppf(0.025, good, drives - good + 1), beta.ppf(0.975, good + 1, drives - good)
    assert found.exact_interval == pytest.approx(ends)  # Clopper and Pearson 1934, by the beta distribution
    slope = []
    for name, width in (("pin_radius", 2e-6), ("pin_circle_radius", 2e-6)):
        changed = dataclasses.replace(nominal_surface(DRIVE), **{name: width})
        slope.append((solve(DriveValue(DRIVE, changed), [], ANGLES).backlash - nominal).mean())
    order = [study.factors.index(n) for n in ("pin_radius", "pin_circle_diameter")]
    ratio = found.scale[order[0]] / found.scale[order[1]]
    assert ratio == pytest.approx((6.0 * slope[1] ** 2 / slope[0] ** 2) ** (1 / 3), rel=0.15)
    costs = np.array([1.0, 1.0])
    costs[order[0]] = 6.0
    assert found.cost == pytest.approx((costs / found.scale).sum())


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


@pytest.mark.parametrize(
    ("limits", "target", "said"),
    [
        ('[limits]\nbacklash = "1 arcsec"\n', 0.9, "t.toml: [limits] backlash: the error-free drive itself takes"),
        ("", 0.9, "t.toml: [limits] is missing"),
        ('[limits]\nbacklash = "99 arcsec"\n', 1.0, "target = 1.0: the yield to reach must be between 0 and 1"),
    ],
)
def test_yields_that_can_t_be_met_are_one_sentence(limits, target, said):
    tolerances = parse_tolerances(HEAD + '[pin_radius]\ntolerance = "2 um"\n' + limits, "t.toml")
    with pytest.raises(edge.InputError) as caught:
        allocate(Study(DRIVE, tolerances, 16, 1, (181.0,), angles=20), target, "t.toml")
    assert str(caught.value).startswith(said)
    assert str(caught.value).count("\n") == 0
