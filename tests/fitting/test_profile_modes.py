"""The form shared by all teeth: its derivatives, its place in a surface, and its effect on a fit."""

import numpy as np
import pytest
from common import BENCH, EXAMPLES

from cycloid_fmu.analysis import error_sensitivity, solve
from cycloid_fmu.drive import Drive, read_drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.sampling import read_tolerances
from cycloid_fmu.surfaces.structured import profile_names, structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation import starts
from fitting.estimation.identify import identify
from fitting.model.prior import Prior, profile_of
from fitting.readers.sources import read_recordings
from fitting.transmission_error.curve import Curve

ARCSEC = np.pi / 648000
FORM = {
    "profile_deviation_1": -0.4e-6,
    "profile_deviation_2": 0.5e-6,
    "profile_deviation_3": 0.6e-6,
    "profile_deviation_4": -0.3e-6,
}


@pytest.mark.slow(6)
@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize("form", [{}, FORM])
def test_derivatives_are_those_of_finite_differences(made, output, form):
    """Between the elements deviations are linear, so a few angles have a contact at a corner: there both err."""
    pair = made.replace(output=output)
    surface = with_structured(surface_of_pair(pair), form)
    names, angles, step = profile_names(range(1, 6)), np.linspace(0.0, 5.0, 40), 2e-8
    jacobian = error_sensitivity(DriveValue(pair, surface), 150.0, angles, ["pin_radius", *names])[1][:, 1:]
    for name, column in zip(names, jacobian.T, strict=True):
        value = structured_value(surface, name)
        low, high = (
            solve(
                DriveValue(pair, with_structured(surface, {name: value + way * step})),
                150.0,
                angles,
                with_play=False,
            ).transmission_error[0]
            for way in (-1.0, 1.0)
        )
        wanted = (high - low) / (2.0 * step)
        off = np.abs(column - wanted) / np.abs(wanted).max()
        assert np.median(off) < 1e-3, name
        assert np.quantile(off, 0.9) < 5e-3, name


def test_the_form_goes_through_a_surface_and_its_file(made, tmp_path):
    surface = with_structured(surface_of_pair(made), FORM)
    write_surface(surface, tmp_path / "s.nc")
    again = read_surface(tmp_path / "s.nc")
    for name, value in FORM.items():
        assert structured_value(again, name) == pytest.approx(value, abs=1e-18)
    assert structured_value(again, "profile_deviation_5") == pytest.approx(0.0, abs=1e-18)
    back = with_structured(again, dict.fromkeys(FORM, 0.0))
    assert np.abs(back.gear_deviation).max() < 1e-18
    assert with_structured(surface_of_pair(made), dict.fromkeys(FORM, 0.0)).gear_deviation is None


@pytest.mark.slow(4)
def test_form_within_its_tolerance_no_longer_bends_the_other_errors(made, nominal):
    """A form of half a micrometre moves the eccentricity found by six standard errors, and leaves no residual."""
    tolerated = profile_of(nominal, read_tolerances(EXAMPLES / "tolerances.toml"))
    # A zone of 4 µm is ± 3 standard deviations of an element, and a wave has a part of that.
    assert all(0.05e-6 < deviation < 4e-6 / 6.0 for deviation in tolerated.values())
    surface = with_structured(surface_of_pair(made), FORM)
    generator, angle = np.random.default_rng(1), np.arange(39 * 12) * 2.0 * np.pi / 12
    curves = [
        Curve(
            angle,
            error + generator.normal(0.0, 0.5 * ARCSEC, angle.size),
            np.full(angle.size, np.nan),
            np.ones(angle.size, int),
            load,
            0.0,
            int(np.sign(load)),
            -39.0,
            True,
            True,
            f"{load:g} N·m",
            "0",
        )
        for load in (20.0, -20.0, 200.0, -200.0)
        for error in [solve(DriveValue(made, surface), load, angle, with_play=False).transmission_error[0]]
    ]
    without = identify(curves, Drive(nominal), held_out=False, form=0.0)
    found = identify(curves, Drive(nominal), tolerances=Prior(profile=tolerated), held_out=False)

    def distances(result):
        return {
            p.name: abs(p.value - structured_value(surface, p.name)) / p.standard_error
            for p in result.parameters
            if p.held is None
        }

    assert distances(without)["eccentricity"] > 4.0
    assert without.residual == pytest.approx(0.5 * ARCSEC, rel=0.05)
    assert set(tolerated) <= set(found.fitted)
    assert max(distances(found).values()) < 3.5
    for p in found.parameters:
        if p.name in tolerated:
            assert p.standard_error <= tolerated[p.name]
            assert structured_value(found.surface, p.name) == pytest.approx(p.value, abs=1e-12)
    assert found.surface.covariance_of[: len(found.fitted)] == found.fitted


@pytest.mark.slow(12)
def test_what_form_may_do_does_not_depend_on_where_the_fit_ended(monkeypatch):
    """A fit ends near the optimum, from other starts elsewhere near it."""
    drive, recordings = read_drive(BENCH / "pair.toml"), read_recordings(str(BENCH / "*.csv"))
    forms = []
    for points in (4000, 4100):
        monkeypatch.setattr(starts, "_POINTS", points)
        parameters = identify(recordings, drive).parameters
        forms.append({p.name: p.form for p in parameters if p.held is None})
    assert forms[0] == pytest.approx(forms[1], rel=0.05, abs=0.02e-6)
