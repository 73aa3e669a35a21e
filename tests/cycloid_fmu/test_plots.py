"""Plots: choice of panels and labels."""

import numpy as np
import pytest

import cycloid_fmu as cy
from cycloid_fmu.draw.plots import plot_analysis

SIZES = dict(gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm")
MODIFIED = cy.Pair(**SIZES, modification={"isometric": "-15 um", "offset": "-40 um"})


def of_title(figure, word):
    (axis,) = [axis for axis in figure.axes if axis.get_title().startswith(word)]
    return axis


@pytest.mark.parametrize("angles", [200, 367])
def test_what_repeats_in_each_pin_pitch_is_drawn_over_one(angles):
    """Without errors everything does; one wave round the pins differs from pitch to pitch."""
    plain = plot_analysis(cy.Drive(MODIFIED).analyze([-181.0, 20.0], angles=angles))
    wavy = MODIFIED.replace(errors={"pin_radial": {1: ("5 um", "0 deg")}})
    made = plot_analysis(cy.Drive(wavy).analyze([-181.0, 20.0], angles=angles))
    for word in ("backlash", "largest contact pressure", "torsional stiffness"):
        for line in of_title(plain, word).lines:
            assert np.ptp(line.get_xdata()) <= 360.0 / 40
        for line in of_title(made, word).lines:
            assert np.ptp(line.get_xdata()) > 350.0


def test_mean_and_ripple_are_apart_and_title_names_drive_and_loads():
    data = cy.Drive(MODIFIED).analyze([-181.0, 181.0])
    figure = plot_analysis(data)
    for line in of_title(figure, "transmission error").lines:
        assert abs(np.mean(line.get_ydata())) < 1e-9
        assert np.abs(line.get_ydata()).max() < 0.5  # arcsec, of 48
    (legend,) = figure.legends
    assert "39/40" in legend.get_title().get_text()
    for load, text in zip((-181.0, 181.0), legend.get_texts(), strict=True):
        mean = float(data.transmission_error.sel(torque=load).mean()) * cy.ARCSEC
        assert text.get_text().startswith(f"{load:g} N·m: mean {mean:.2f}″")
