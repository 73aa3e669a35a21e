"""What to correct: the effect of each identified error, and the run-out of the bench, stated once."""

import dataclasses
import html
import json
import re
import shutil

import numpy as np
import pytest
from benches_as_they_are import EFFECTS, identified
from common import EXAMPLES, study_size
from sampled_drives import SMALL

import fitting
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.effects import words_of
from fitting.estimation.parameter import NORMAL
from fitting.estimation.realised import realised
from fitting.estimation.result import as_json
from fitting.estimation.run_out import RunOut
from fitting.reports.report import report

ARCSEC = np.pi / 648000
SEEDS = study_size("CYCLOID_SEEDS", 5, 100)
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
RUN_OUT = {1: 90.0, 2: 3.0, 3: 1.4}  # order of the output: amplitude, arcsec


@pytest.fixture(scope="module")
def found(measured, nominal):
    """With run-out, no index and the drawing's tolerances."""
    curves = [
        dataclasses.replace(
            c,
            transmission_error=c.transmission_error
            + sum(a * ARCSEC * np.cos(order * c.input_angle / 39 - order) for order, a in RUN_OUT.items()),
        )
        for c in measured(1, known_index=False)
    ]
    return fitting.identify(curves, Drive(nominal), tolerances=EXAMPLES / "tolerances-of-places.toml")


def test_the_errors_are_ranked_by_what_the_transmission_error_loses_without_them(found, made):
    """Against the exact contact of the identified drive with and without the error, at the stated load."""
    sizes = [one.peak_to_peak for one in found.effects]
    assert sizes == sorted(sizes, reverse=True)
    surface, pair = found.surface, found.pair
    at = 2.0 * np.pi * np.arange(pair.pins) / pair.pins
    tooth = 2.0 * np.pi * np.arange(pair.gear_teeth) / pair.gear_teeth
    compared = set()
    for one in found.effects[:7]:
        if one.phase is None:
            without = with_structured(surface, {one.kind: 0.0})
        else:
            around = tooth if one.kind == "tooth_cumulative_pitch" else at
            wave = one.error.value * np.cos(one.order * around - one.phase.value)
            without = surface.replace(**{one.kind: surface.errors[one.kind] - wave})
        angle = next(c for c in found.curves if c.torque == one.torque).input_angle
        errors = [
            solve(DriveValue(pair, s), one.torque, angle, with_play=False).transmission_error[0]
            for s in (surface, without)
        ]
        assert np.ptp(errors[0] - errors[1]) == pytest.approx(one.peak_to_peak, rel=0.15), words_of(one)
        compared.add((one.kind, one.order))
    # Those of the drawing of this drive that are not small.
    assert compared >= {
        ("centre_distance_x", None),
        ("centre_distance_y", None),
        ("pin_radial", 2),
        ("tooth_cumulative_pitch", 1),
    }


@pytest.mark.slow(1)
def test_amplitude_and_angle_of_an_order_are_those_it_was_made_with(measured, nominal, made):
    found = fitting.identify(measured(2), Drive(nominal))
    truth = surface_of_pair(made)
    (one,) = (e for e in found.effects if (e.kind, e.order) == ("pin_radial", 2))
    around = 2.0 * np.pi * np.arange(made.pins) / made.pins
    made_with = 2.0 * np.mean(truth.pin_radial * np.exp(2j * around))
    assert one.error.interval[0] < abs(made_with) < one.error.interval[1]
    assert one.phase.value == pytest.approx(np.angle(made_with), abs=2.0 * one.phase.standard_error)
    assert not any("no index" in note for note in found.notes)


def test_the_amplitude_of_a_run_out_is_one_number_with_its_interval(found):
    """Of run-out and the encoder's eccentricity together: the verdict stated a part of it, and a note another."""
    of_output = {one.order: one for one in found.run_out if one.shaft == "output"}
    for order, amplitude in RUN_OUT.items():
        one = of_output[order]
        assert abs(one.amplitude / ARCSEC - amplitude) < NORMAL * one.standard_error / ARCSEC + 0.02
        assert one.standard_error < 0.05 * ARCSEC
    assert of_output[1].text in found.verdict.sentence
    said = [float(n) for text in (found.verdict.sentence, *found.notes) for n in re.findall(r"output ([\d.]+) ±", text)]
    assert {round(n) for n in said} == {90, 3, 1}
    (note,) = (n for n in found.notes if "mounted eccentrically" in n)
    assert of_output[1].text in note
    written = json.loads(edge.json_text(as_json(found)))
    (misfit,) = written["validation"]["misfits"]
    assert misfit["size"] == pytest.approx(np.sqrt(sum(o["amplitude"] ** 2 for o in written["run_out"]) / 2.0))
    assert written["effects"][0]["peak_to_peak"] == found.effects[0].peak_to_peak


def test_a_run_out_is_shown_as_exactly_as_it_is_known():
    assert RunOut("output", 1, 59.99 * ARCSEC, 0.05 * ARCSEC).text == "order 1 of the output 59.990 ± 0.098″"
    assert RunOut("input", 2, 3.0 * ARCSEC, np.nan).text == "order 2 of the input 3.00″"
    assert not RunOut("input", 1, 1.0 * ARCSEC, 0.6 * ARCSEC).is_seen


def test_the_report_begins_with_what_to_correct(found, tmp_path):
    report(found, tmp_path / "fit.html")
    text = html.unescape((tmp_path / "fit.html").read_text(encoding="utf-8"))
    assert text.index('id="verdict"') < text.index('id="no-index"') < text.index('id="effects"')
    assert text.index('id="effects"') < text.index('id="panel-0"') < text.index('id="errors"')
    rows = re.findall(r"<tr><td>(.*?)</tr>", text[text.index('id="effects"') : text.index('id="trust"')], re.S)
    effects = [float(re.search(r'class="number">([\d.]+)</td>', row)[1]) for row in rows]
    assert effects == sorted(effects, reverse=True)
    assert effects[-1] >= 0.01 * effects[0]
    assert "± 3 µm" in next(row for row in rows if "> 0 along +x" in row)
    assert "single ± 2, cumulative 6 µm" in next(row for row in rows if "each tooth" in row)
    assert "pin_radial" not in "".join(rows)
    bench = text[text.index('id="bench"') : text.index('id="notes"')]
    assert "misfit" not in bench
    assert bench.count("<tr>") < 20
    assert "unknown which pin is number 0" in text


@pytest.mark.system
def test_the_report_fits_a_screen_of_1280_pixels(found, nominal, tmp_path):
    """Also with two discs, whose tables are the widest."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    pair = nominal.replace(discs=2)
    chosen = ["pin_radial_2_cos"]
    size = len(chosen) + 3 * pair.pins + 2 * pair.gear_teeth + 1
    rng = np.random.default_rng(0)
    surface = surface_of_pair(pair)
    surface = surface.replace(
        **{
            name: 1e-5 * rng.normal(size=np.shape(getattr(surface, name)))
            for name in ("pin_radial", "pin_tangential", "tooth_cumulative_pitch")
        }
    )
    ring = realised(DriveValue(pair, surface), chosen, 1e-12 * np.eye(size), np.full(size - len(chosen), 1e-6))
    report(dataclasses.replace(found, realised=ring), tmp_path / "fit.html")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": 1280, "height": 900})
        opened.goto((tmp_path / "fit.html").as_uri())
        opened.wait_for_selector(".panel >> nth=-1 >> .main-svg >> nth=0")
        assert opened.evaluate("document.documentElement.scrollWidth") <= 1280
        body = opened.evaluate("document.body.getBoundingClientRect().right")
        tables = "[...document.querySelectorAll('table')].map(t => t.getBoundingClientRect().right)"
        assert max(opened.evaluate(tables)) <= body
        browser.close()


@pytest.mark.slow(10)
def test_the_intervals_of_run_out_contain_the_amplitudes_of_independent_benches(nominal, record_property):
    """Benches of a solver that shares no code with the product's, with 60, 8 and 4″ at orders 1 to 3 of the output."""
    name, pair, scores = "run-out 60″, orders 2 and 3", nominal.replace(**SMALL), []
    for seed in range(max(2, SEEDS // 10)):
        found, _ = identified(name, pair, seed)
        for one in found.run_out:
            if one.shaft == "output":
                truth = EFFECTS[name].run_out[one.order - 1] * ARCSEC
                scores.append(abs(one.amplitude - truth) / one.standard_error)
    inside = sum(score < NORMAL for score in scores)
    record_property("amplitudes inside their 95 % interval", f"{inside} of {len(scores)}")
    assert inside >= 0.95 * len(scores) - 4.0 * np.sqrt(0.05 * 0.95 * len(scores))
    assert max(scores) < 4.5
