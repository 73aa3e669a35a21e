"""The production kernel against the error-surface paper's own brute force over element pairs, on both flanks."""

import dataclasses

import numpy as np
import pytest
from common import ARCSEC, CASES
from element_pairs import solve_elements

from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair

PAIR = read_pair(CASES / "nearly-conformal-13-14.toml")
PROFILE, ANGLE = 400, 100


def raised(kind):
    """The pair's own errors with a smooth form or an independent height for every element, and a form of the pins."""
    arc = (np.arange(PROFILE) + 0.5) / PROFILE
    heights = 3e-6 * np.cos(2 * np.pi * 3 * arc)[None, None, :, None] * np.ones((1, 13, 1, 1))
    if kind == "rough":
        heights = np.random.default_rng(0).normal(0.0, 2e-6, (1, 13, PROFILE, 1))
    pins = 1e-6 * np.cos(np.linspace(0.0, 9.0, ANGLE))[None, :, None] * np.ones((14, 1, 1))
    return dataclasses.replace(surface_of_pair(PAIR), gear_deviation=heights, pin_deviation=pins)


@pytest.mark.slow(4)
@pytest.mark.parametrize(("kind", "angle", "torque"), [("smooth", 1.7, -70.0), ("rough", 4.0, 70.0)])
def test_kernel_and_element_pairs_agree(kind, angle, torque):
    surface = raised(kind)
    wanted = solve_elements(PAIR, surface, angle, torque, contact="deepest", pairs="directed", sampling=16e-6)
    found = solve(DriveValue(PAIR, surface), torque, angle)
    assert found.transmission_error[0, 0] == pytest.approx(wanted["transmission_error"], abs=0.01 * ARCSEC)
    assert found.backlash[0] == pytest.approx(wanted["backlash"], abs=0.01 * ARCSEC)
    assert found.pin_force[0, 0] == pytest.approx(wanted["pin_force"], abs=5e-3 * wanted["pin_force"].max())
    assert found.max_contact_pressure[0, 0] == pytest.approx(wanted["max_contact_pressure"], rel=5e-3)
    assert found.contact_count[0, 0] == wanted["contact_count"]


@pytest.mark.slow(20)
def test_slices_and_the_paper_s_arcs_agree():
    """Misaligned axes: slices at their middles against the paper's mean depth over three arcs a slice."""
    pair = read_pair(CASES / "misaligned-31-32.toml")
    surface = surface_of_pair(pair)
    wanted = solve_elements(pair, surface, 1.0, 200.0, width_elements=20, pairs="directed", arcs=3, with_play=False)
    found = solve(DriveValue(pair, surface), 200.0, 1.0, 20)
    assert found.transmission_error[0, 0] == pytest.approx(wanted["transmission_error"], abs=0.01 * ARCSEC)
    assert found.pin_force[0, 0] == pytest.approx(wanted["pin_force"], abs=1e-2 * wanted["pin_force"].max())
