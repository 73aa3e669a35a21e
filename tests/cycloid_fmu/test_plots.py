"""Plots: choice of panels and labels."""

import itertools
import math
import types

import numpy as np
import pytest
from common import EXAMPLES

import cycloid_fmu as cy
from cycloid_fmu.draw.designs import plot_designs
from cycloid_fmu.draw.drive_picture import close_up
from cycloid_fmu.draw.figure import new_figure
from cycloid_fmu.draw.plots import plot_analysis, plot_bearings, plot_tolerance
from cycloid_fmu.draw.sweeps import plot_sweep
from cycloid_fmu.draw.verdicts import plot_duty, show_verdicts
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.studies.design import DesignTask, on_front
from cycloid_fmu.studies.limits import Limits, line_of, not_judged, not_judged_line, read_requirements, verdict
from cycloid_fmu.studies.tolerance import Result, Study
from cycloid_fmu.studies.verdicts import judge_drive, loads_of
from cycloid_fmu.surfaces.sampling import read_tolerances
from cycloid_fmu.surfaces.surface import surface_of_pair

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


@pytest.mark.parametrize("discs", [1, 2, 3])
def test_without_errors_a_drawn_turn_has_as_many_equal_peaks_as_pins(discs):
    """Each pin pitch is the same curve, so every peak is of one height."""
    curve = cy.Drive(MODIFIED.replace(discs=discs)).motion(181.0, 0.0).curve[0] * cy.ARCSEC
    pitches = curve[:-1].reshape(40, -1)
    assert np.ptp(pitches[0]) > 0.01
    assert np.ptp(pitches, axis=0).max() < 1e-4
    highest = np.abs(curve - curve.max()) < 1e-4
    assert np.flatnonzero(highest[:-1]).size == 40 * np.flatnonzero(highest[: pitches.shape[1]]).size


def test_rounding_is_no_force_of_a_bearing():
    """On four cranks two like discs half a turn apart leave none to the main bearing; its axis is that of forces."""
    drawn = (EXAMPLES / "drive-39-40-bearings.toml").read_text().split("[errors.supports]")[0]
    pair = parse_pair(drawn.replace("count = 3", "count = 4").replace('clearance = "10 um"\n', ""), "drive.toml")
    data = cy.Drive(pair).analyze(-181.0, angles=20)
    held = data["crank_bearing_force"].values.max()
    assert 0.0 < data["main_bearing_force"].values.max() < 1e-9 * held
    figure = plot_bearings(data, pair, [])
    (axis,) = [axis for axis in figure.axes if axis.get_title().startswith("main bearing")]
    assert np.ptp(axis.get_ylim()) >= 0.01 * held


def test_bars_start_at_zero_and_lives_on_a_logarithmic_axis_are_dots():
    pair = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair
    asked = read_requirements(EXAMPLES / "requirements.toml")
    angles, surface = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False), surface_of_pair(pair)
    judged = judge_drive(DriveValue(pair, surface), asked, loads_of(asked, [], pair), angles)
    figure = plot_duty(judged)
    for axis in figure.axes:
        assert not (axis.patches and axis.get_xscale() == "log")
        assert all(bar.get_x() == 0.0 for bar in axis.patches)
    (axis,) = [axis for axis in figure.axes if axis.get_xscale() == "log"]
    assert axis.lines[0].get_linestyle() == "None"
    assert axis.lines[0].get_xdata() == pytest.approx(
        [one.life / 3600.0 for one in judged.lives if np.isfinite(one.life)]
    )


def test_a_picture_lists_the_limits_that_are_not_judged_within_its_width():
    asked = Limits(backlash="1 arcmin", **dict.fromkeys(["wear_depth", "interference"], "1 um"), static_safety=2.0)
    verdicts = [verdict("backlash", 2e-4, asked.backlash)]
    missing = not_judged(asked, verdicts)
    assert missing == ["interference", "static_safety", "wear_depth"]
    figure = show_verdicts(new_figure()[0], verdicts, missing * 5)
    figure.canvas.draw()
    met, *rest = figure.texts
    assert (met.get_text(), met.get_color()) == (line_of(verdicts[0]), "black")
    assert " ".join(line.get_text() for line in rest) == not_judged_line(missing * 5)
    assert not_judged_line(missing).endswith("and so not met: interference, static safety, wear depth.")
    for line in rest:
        assert line.get_color() == "tab:red"
        assert line.get_window_extent().x1 <= figure.bbox.x1
    assert show_verdicts(new_figure()[0], []).texts == []


def task_for(*goals):
    duty = [{"torque": "181 N*m", "output_speed": "15 rpm", "share": 1.0}]
    return DesignTask(drive="d.toml", vary={"offset": ("-60 um", "0 um")}, goals=goals, duty=duty)


def design(backlash, stiffness, met=True):
    return types.SimpleNamespace(
        goals={"backlash": backlash, "torsional_stiffness": stiffness}, met=met, values={"offset": -3e-5}, verdicts=()
    )


def test_a_front_has_no_design_that_another_is_better_than():
    """Less backlash and more stiffness are better; a design that does not meet its limits is on no front."""
    found = [design(1e-4, 1e6), design(2e-4, 2e6), design(2.5e-4, 1.9e6), design(3e-4, 3e6), design(5e-5, 4e6, False)]
    assert on_front(found).tolist() == [True, True, False, True, False]
    task = task_for("backlash", "torsional_stiffness")
    figure = plot_designs(found, task, "front")
    line = figure.axes[0].lines[0]
    assert len(line.get_xdata()) == 3
    assert (np.diff(line.get_ydata()) > 0.0).all()
    assert "hollow" in figure.axes[0].get_title()
    # A ten-thousandth of backlash is no gain for which to give up a tenth of the stiffness, and fills no axis.
    alike = [design(1e-4, 1e6), design(1.0001e-4, 1.1e6)]
    assert on_front(alike).tolist() == [False, True]
    (axis, _) = plot_designs(alike, task, "front").axes
    assert np.ptp(axis.get_xlim()) > 50 * np.ptp([line.get_xdata()[0] for line in axis.lines[1:]])


def test_a_figure_that_is_the_same_in_all_drives_is_one_bar_of_all_drives():
    """One that varies is a histogram, and without a limit such a figure is not drawn."""
    tolerances = read_tolerances(EXAMPLES / "tolerances.toml")
    study = Study(read_pair(EXAMPLES / "drive-39-40.toml"), tolerances, 64, 1, (181.0, -90.0))
    values = np.random.default_rng(1).normal(2e-4, 2e-5, (64, len(study.columns)))
    same = [i for i, (name, _) in enumerate(study.columns) if name in ("backlash", "interference")]
    values[:, same] = 5e-4
    axes = {
        axis.get_xlabel().split(" [")[0]: axis for axis in plot_tolerance(Result(study, values, np.arange(64))).axes
    }
    assert "interference" not in axes
    (bar,) = axes["backlash"].collections
    ((bottom, top),) = bar.get_segments()
    assert bottom == pytest.approx([5e-4 * ARCSEC, 0.0])
    assert top == pytest.approx([5e-4 * ARCSEC, 64.0])
    assert not axes["backlash"].patches
    assert axes["lost motion"].patches


def test_numbers_of_designs_do_not_overlap():
    """Designs in bunches along a front, as a search returns them: each number is written once."""
    backlash = np.array([1.0, 1.02, 1.04, 1.06, 1.5, 1.52, 2.4, 2.42, 2.44, 3.0]) * 1e-4
    found = [design(b, 1e6 * (1.0 + 0.3 * math.log(b / 1e-4))) for b in backlash]
    figure = plot_designs(found, task_for("backlash", "torsional_stiffness"), "front")
    figure.canvas.draw()
    labels = figure.axes[0].texts
    assert sorted(int(n) for label in labels for n in label.get_text().split(",")) == list(range(1, 11))
    boxes = [label.get_window_extent() for label in labels]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_a_margin_of_nearly_nothing_looks_like_it():
    one = types.SimpleNamespace(
        goals={"backlash": 1e-4},
        met=True,
        values={"offset": -3e-5},
        verdicts=[types.SimpleNamespace(figure="interference", share=2e-4)],
    )
    task = task_for("backlash")
    axis = plot_designs([one], task, "margins").axes[0]
    assert axis.patches[0].get_width() < 1e-3 * np.ptp(axis.get_xlim())


def test_a_tooth_as_drawn_has_nothing_enlarged():
    """Without modification no rounding is multiplied; a modification of 1 um is."""
    plain = close_up(cy.Drive(cy.Pair(**SIZES)).motion(181.0, 0.0))
    assert plain.title == "tooth 0, without modification and deviations"
    assert [one.label for one in plain.curves] == ["unmodified"]
    made = close_up(cy.Drive(cy.Pair(**SIZES, modification={"isometric": "-1 um"})).motion(181.0, 0.0))
    assert "× 1000" in made.title


def test_a_sweep_s_axes_are_no_finer_than_its_figures():
    """Backlash does not depend on the face width, and a thousandth of it hardly changes the stiffness."""
    data = cy.Drive(MODIFIED).sweep({"face_width": "9.99:10.01:3 mm"}, 100.0, angles=41, workers=1)
    for axis in plot_sweep(data).axes:
        (line,) = axis.lines
        values, span = line.get_ydata(), np.ptp(axis.get_ylim())
        assert span >= 0.999 * max(0.01 * np.abs(values).max(), 0.01 if "arcsec" in axis.get_ylabel() else 0.0)
