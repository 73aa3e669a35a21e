"""The product's solver against a second one that shares nothing with it, over random drives."""

import dataclasses

import numpy as np
import pytest
import second_drive
from benches_as_they_are import on_bearings, springs
from common import ARCSEC, EXAMPLES
from sampled_drives import SMALL

from cycloid_fmu.analysis import solve
from cycloid_fmu.analysis import solve as solve_on_bearings
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.structured import profile_names, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.model.observations import errors_of

ANGLES = np.random.default_rng(3).uniform(0.0, 20.0, 150)


def both(pair, seed, form=()):
    """A drive with errors of everything, as the second solver and as the product have it."""
    draw = np.random.default_rng(seed).normal
    values = {name: draw(0.0, 2e-6) for name in errors_of(pair) if not name.startswith("misalignment")}
    scatter = {
        "pin_radial": draw(0.0, 2e-6, pair.pins),
        "pin_tangential": draw(0.0, 2e-6, pair.pins),
        "tooth_cumulative_pitch": draw(0.0, 2e-6, (pair.discs, pair.gear_teeth)),
    }
    m = pair.modification
    second = second_drive.body(
        second_drive.sizes_of(pair),
        values,
        scatter,
        isometric=m.isometric,
        offset=m.offset,
        discs=pair.discs,
        form=form,
    )
    surface = with_structured(surface_of_pair(pair), values)
    surface = surface.replace(**{name: surface.errors[name] + each for name, each in scatter.items()})
    if form:
        names = profile_names(range(1, len(form) + 1))
        surface = with_structured(surface, dict(zip(names, form, strict=True)))
    return second, surface


@pytest.mark.parametrize("size", [{}, SMALL], ids=["39/40", "11/12"])
@pytest.mark.parametrize("discs", [1, 2])
def test_random_drives(size, discs, record_property):
    pair = read_pair(EXAMPLES / "drive-39-40.toml").replace(**size, discs=discs)
    second, surface = both(pair, discs)
    for load in (20.0, -200.0):
        wanted = second_drive.transmission_error(second, ANGLES, load)
        found = solve(DriveValue(pair, surface), load, ANGLES, with_play=False).transmission_error[0]
        away = np.abs(found - wanted).max() / ARCSEC
        record_property(f"away from the second solver at {load:g} N·m, arcsec", f"{away:.2g}")
        assert away < 1e-4
        assert np.ptp(wanted) > 10.0 * ARCSEC


def test_form_that_all_flanks_share():
    """In the product a form is a line between a hundred points of a flank, in the second solver the function itself."""
    pair = read_pair(EXAMPLES / "drive-39-40.toml").replace(**SMALL)
    form = (1e-6, -0.7e-6, 0.5e-6, 0.3e-6)
    second, surface = both(pair, 1, form)
    found, plain = (
        solve(DriveValue(pair, s), 200.0, ANGLES, with_play=False).transmission_error[0]
        for s in (surface, both(pair, 1)[1])
    )
    wanted = second_drive.transmission_error(second, ANGLES, 200.0)
    assert np.abs(found - wanted).max() < 0.1 * ARCSEC
    assert np.abs(found - plain).max() > 1.0 * ARCSEC


@pytest.mark.parametrize("load", [20.0, -200.0])
def test_a_disc_that_floats(load):
    """Cranks on springs hold one disc as one spring does and let the output turn by as much as they give.

    Where a pin passes to the next tooth, which is displaced, there may be two balances, or none.
    """
    pair = read_pair(EXAMPLES / "drive-39-40.toml").replace(**SMALL)
    second, surface = both(pair, 1)
    floating, surface = on_bearings(pair, surface)
    wanted = second_drive.transmission_error(dataclasses.replace(second, **springs()), ANGLES, load)
    there = np.isfinite(wanted)
    found = solve_on_bearings(DriveValue(floating, surface), load, ANGLES[there], with_play=False).transmission_error[0]
    away = np.abs(found - wanted[there]) / ARCSEC
    assert np.quantile(away, 0.97) < 1e-4
    assert np.count_nonzero(~there) < 3


def test_a_jammed_disc_that_floats():
    """Without a torque the pins press as far as bearings let them: here the mean of a small torque in both directions.

    A force depends on the torque of the other direction alike, to first order.
    """
    pair = read_pair(EXAMPLES / "drive-39-40.toml").replace(**SMALL, offset=25e-6, isometric=0.0)
    second, surface = both(pair, 4)
    floating, surface = on_bearings(pair, surface)
    held, angles = dataclasses.replace(second, **springs()), ANGLES[:20]
    wanted = np.zeros((angles.size, pair.pins))
    for torque in (-0.05, 0.05):
        row, pin, _, _, force, _, _ = second_drive.contacts(held, angles, torque)
        np.add.at(wanted, (row, pin), 0.5 * force)
    found = solve_on_bearings(DriveValue(floating, surface), 0.0, angles)
    assert wanted.max() > 100.0
    assert found.pin_force[0, :, 0] == pytest.approx(wanted, abs=1e-4 * wanted.max())
    assert found.preload == pytest.approx(wanted.max(axis=1), rel=1e-4)
    assert (found.preload_count == (wanted > 0.01 * wanted.max(axis=1)[:, None]).sum(axis=1)).all()
