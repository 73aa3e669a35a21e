"""The page that holds predicted losses against published measurements."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from common import MEASURED

import cycloid_fmu as cy

ROOT = Path(__file__).parents[2]


@pytest.fixture
def published(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    yield __import__("published")
    sys.modules.pop("published")


@pytest.mark.slow(15)
def test_the_page_has_the_table_that_its_script_computes(published):
    page = published.PAGE.read_text(encoding="utf-8")
    assert published.written(page, published.rows()) == page


@pytest.mark.slow(60)
def test_the_page_of_elastic_bodies_has_the_table_that_its_script_computes(published):
    page = published.BODIES.read_text(encoding="utf-8")
    assert published.with_stiffness(page) == page


def test_the_measured_stiffness_is_within_the_prediction_with_bodies_and_not_without(published):
    """250 to 340 N·m/rad of the open thesis: between the ends of what is not published, and below any rigid body's."""
    soft, _ = published.stiffness_of(published.printed_bodies(()))
    pins, shares = published.stiffness_of(published.printed_bodies({"output pins"}))
    rigid = published.printed_bodies(())
    rigid = cy.Drive(rigid.pair.replace(bodies=None)).analyze("15 N*m", angles=13)
    assert soft < 250.0 < 340.0 < rigid.torsional_stiffness.values.min()
    assert pins > 2.5 * soft  # the output pins decide
    assert shares["output_pin"] < 0.02 < shares["crank"]


@pytest.mark.parametrize("run", ["onyx_init1", "onyx_runin1"])
def test_what_the_page_says_of_stiffness_is_in_the_measurements(run):
    if not (MEASURED / "expected.json").exists():
        pytest.skip(f"{MEASURED / 'expected.json'} is missing")
    measured = json.loads((MEASURED / "expected.json").read_text())["runs"][run]
    page = (ROOT / "docs" / "theory" / "bodies.md").read_text(encoding="utf-8")
    ends = map(float, re.search(r"locked: (\d+) to (\d+) N·m/rad, (\d+) to (\d+) without", page).groups())
    low, high, free_low, free_high = ends
    assert low <= measured["published"]["stiffness_Nm_rad"] <= high
    assert free_low - 1.0 <= measured["friction_free_stiffness_Nm_rad"]["value"] <= free_high + 1.0


def test_friction_at_an_end_of_the_table_is_what_the_drive_gets(published):
    """The ends of a named friction are those of the predictions, and a wide table is a wide prediction."""
    for end in published.ENDS:
        flank = published.rv(end).pair.losses.flank
        assert (flank.friction_coefficient, flank.static) == ((0.04, 0.12) if end == "low" else (0.25, 0.35))
    low, high = (published.efficiency(published.rv(end), 167.0, 61.0, 13) for end in published.ENDS)
    assert high < 85.0 < low


def test_breakaway_without_friction_is_none_and_with_a_stated_drag_is_that_drag(published):
    """Half the difference of the two directions is the output's drag, whatever the load."""
    drive = published.printed("low", turning=True)
    smooth = drive.replace(losses={"flank": {}, "output_drag": {"coulomb": "2.5 N*m"}})
    without, per_load = published.breakaway(smooth, 15.0, np.linspace(0.0, 2.0 * np.pi, 26, endpoint=False))
    assert without == pytest.approx(2.5, rel=0.02)
    assert per_load == pytest.approx(0.0, abs=5e-3)


@pytest.mark.parametrize("run", ["onyx_init1", "onyx_runin1"])
def test_what_the_page_says_was_measured_is_in_the_measurements(run):
    if not (MEASURED / "expected.json").exists():
        pytest.skip(f"{MEASURED / 'expected.json'} is missing")
    measured = json.loads((MEASURED / "expected.json").read_text())["runs"][run]
    page = (ROOT / "docs" / "losses_published.md").read_text(encoding="utf-8")
    low, high = map(float, re.search(r"friction per load, from rest \| ([0-9.]+) to ([0-9.]+) ", page).groups())
    assert low <= measured["friction_per_load"]["value"] <= high
    without = float(re.search(r"friction without load \| ([0-9.]+) N·m", page).group(1))
    for name in ("friction_small_loop_Nm", "friction_at_no_load_Nm"):
        assert abs(measured[name]["value"] - without) < measured[name]["u95"] + 0.3
