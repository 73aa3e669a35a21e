"""Compliance in series with a drive: catalogue stiffness, a measured loop, and its values in an FMU."""

import dataclasses
import json

import fmpy
import numpy as np
import pytest
from clockworks import Drive
from common import EXAMPLES
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.cli import app
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import native as native_build
from cycloid_fmu.fmu.build import build_fmu, completed
from cycloid_fmu.fmu.chain import own_stiffness, read_loop, with_chain
from cycloid_fmu.fmu.run import description_of
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.reducer.lost_motion import parts_of
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.figures.metrics import figures_of
from fitting.readers.recording import Recording
from fitting.transmission_error.survey import survey

PAIR = read_pair(EXAMPLES / "drive-39-40.toml")
SURFACE = surface_of_pair(PAIR)


def windup(model, pair, turns=40):
    """Mean windup of a model between half its rated torque and all of it, over a crank turn."""
    found = []
    for torque in (0.5 * pair.rated_torque, pair.rated_torque):
        model.torque = torque
        for angle in np.linspace(0.0, 2.0 * np.pi, turns, endpoint=False):
            model.crank_angle = angle * abs(model.ratio / pair.ratio)
            model.advance()
            found.append(model.transmission_error)
    low, high = np.array(found).reshape(2, -1).mean(axis=1)
    return high - low


def test_the_whole_drive_has_the_stiffness_that_was_stated():
    catalogue = 49.0 * edge.ARCMIN
    interface = completed(Interface(stiffness=catalogue), DriveValue(PAIR, SURFACE))
    model = Drive(DriveValue(PAIR, SURFACE), interface)
    assert 0.5 * PAIR.rated_torque / windup(model, PAIR, 90) == pytest.approx(catalogue, rel=1e-6)


def test_a_drive_that_is_softer_than_stated_is_refused():
    own = own_stiffness(DriveValue(PAIR, SURFACE))
    with pytest.raises(edge.InputError, match=r"stiffness = .*must not be above the drive's own of \d+ N\*m/arcmin"):
        with_chain(Interface(stiffness=1.01 * own), DriveValue(PAIR, SURFACE))
    assert with_chain(Interface(stiffness=own), DriveValue(PAIR, SURFACE)).series_compliance == 0.0
    with pytest.raises(edge.InputError, match="rated_torque is missing"):
        with_chain(Interface(stiffness=1e5), DriveValue(PAIR.replace(rated_torque=None), SURFACE))
    with pytest.raises(edge.InputError, match="one follows from the other"):
        with_chain(Interface(stiffness=1e5, series_compliance=1e-6), DriveValue(PAIR, SURFACE))


def test_a_first_stage_that_gives_way_is_in_series():
    """The reducer's own solution of it has the crank where its stage lets it be: within 1e-3 of the compliance."""
    reducer = cy.read_reducer(EXAMPLES / "rv-20e.toml")
    involute = reducer.involute.replace(face_width="8 mm", planets=2)
    pair, surface, soft = parts_of(reducer.replace(involute=involute))
    rigid = dataclasses.replace(soft, crank_stiffness=float("inf"))
    with_it = with_chain(Interface(), DriveValue(pair, surface, soft))
    whole = 1.0 / (1.0 / with_it.own_stiffness + with_it.series_compliance)
    assert with_it.series_compliance > 0.0
    assert with_it.own_stiffness == pytest.approx(own_stiffness(DriveValue(pair, surface, rigid)), rel=1e-12)
    assert whole == pytest.approx(own_stiffness(DriveValue(pair, surface, soft)), rel=1e-3)
    model = Drive(DriveValue(pair, surface, soft), with_it)
    assert 0.5 * pair.rated_torque / windup(model, pair) == pytest.approx(whole, rel=5e-3)


def test_a_measured_loop_gives_stiffness_and_friction(tmp_path):
    """A loop of known stiffness and friction, through cycloid-fit's figures and back."""
    stiffness, friction, play, rated = 50.0 * edge.ARCMIN, 4.0, 2e-4, 200.0
    ramp = np.arange(500) / 500
    share = np.concatenate([ramp, 1.0 - ramp, -ramp, ramp - 1.0])
    side, loading = np.repeat([1.0, -1.0], 1000), np.tile(np.repeat([1.0, -1.0], 500), 2)
    torque = rated * np.where(share == 0.0, 1e-12 * side, share)
    angle = 0.5 * play * side + (torque - side * loading * friction) / stiffness
    n = torque.size
    made = Recording(
        np.arange(n) * 1e-2,
        np.zeros(n),
        angle,
        torque,
        np.zeros(n, np.uint8),
        common_zero=True,
        known_index=True,
        ratio=-39.0,
        source="loop.csv",
        checksum="0",
    )
    figures_of([survey(made, -39.0, rated)], -39.0, rated).write(tmp_path / "figures.json")
    assert read_loop(tmp_path / "figures.json") == pytest.approx((stiffness, friction), rel=1e-5)
    done = CliRunner().invoke(
        app,
        [
            "build",
            str(EXAMPLES / "drive-39-40.toml"),
            "-o",
            str(tmp_path / "drive.fmu"),
            "--loop",
            str(tmp_path / "figures.json"),
        ],
    )
    assert done.exit_code == 0, done.output
    start = {v.name: v.start for v in fmpy.read_model_description(str(tmp_path / "drive.fmu")).modelVariables}
    assert float(start["friction_torque"]) == pytest.approx(friction, rel=1e-5)
    whole = 1.0 / (1.0 / own_stiffness(DriveValue(PAIR, SURFACE)) + float(start["series_compliance"]))
    assert whole == pytest.approx(stiffness, rel=1e-5)


def test_where_friction_grows_with_load_the_figures_without_it_are_taken(tmp_path):
    """The loading branches have 1.4 times the spring's stiffness, and their distance is no friction."""
    standard = {
        "torsional_stiffness": {"value": 420.0, "remark": "contains friction that grows with load"},
        "hysteresis_loss": {"value": 0.04},
        "backlash": {"value": 0.015},
    }
    free = {"torsional_stiffness": {"value": 300.0}, "friction_torque": {"value": 2.5}}
    (tmp_path / "f.json").write_text(json.dumps({"format": "cycloid-figures/1", **standard, "friction_free": free}))
    assert read_loop(tmp_path / "f.json") == (300.0, 2.5)
    del standard["torsional_stiffness"]["remark"]
    (tmp_path / "f.json").write_text(json.dumps({"format": "cycloid-figures/1", **standard, "friction_free": free}))
    assert read_loop(tmp_path / "f.json") == (420.0, pytest.approx(0.5 * 420.0 * 0.025))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"format": "cycloid-figures/1"}, "torsional_stiffness is missing"),
        ({"format": "other/1"}, "format"),
        ([], "figures"),
    ],
)
def test_figures_without_a_loop_are_refused(tmp_path, given, said):
    (tmp_path / "figures.json").write_text(json.dumps(given))
    with pytest.raises(edge.InputError, match=said):
        read_loop(tmp_path / "figures.json")


@pytest.mark.slow(7)
def test_every_fmu_says_how_stiff_it_is(tmp_path):
    number = f"{own_stiffness(DriveValue(PAIR, SURFACE)) / edge.ARCMIN:.4g} N.m/arcmin"
    build_fmu(DriveValue.as_stated(PAIR), tmp_path / "2.fmu")
    build_fmu(
        DriveValue.as_stated(PAIR),
        tmp_path / "3.fmu",
        fmi_version="3.0",
        interface=Interface("compliant", stiffness=1e5),
    )
    for name, more in (("2", ""), ("3", ", 29.09 with the start value of series_compliance")):
        description = fmpy.read_model_description(str(tmp_path / f"{name}.fmu"))
        text = f"mesh alone, rigid bodies: {number}{more}"
        assert description_of(tmp_path / f"{name}.fmu").endswith(text)
        (variable,) = (v for v in description.modelVariables if v.name == "torsional_stiffness")
        assert variable.description.endswith(text)
    held = read_pair(EXAMPLES / "drive-39-40-bearings.toml")
    said = native_build.stiffness_text(held, completed("kinematic", DriveValue.as_stated(held)))
    assert said.startswith("contacts and bearings alone: ")


def test_the_page_says_how_stiff_the_example_is():
    text = (EXAMPLES.parent / "docs" / "fmu.md").read_text(encoding="utf-8")
    stiffness = own_stiffness(DriveValue(*parts_of(cy.read_reducer(EXAMPLES / "rv-20e.toml")))) / edge.ARCMIN
    assert f"{stiffness:.3g} N·m/arcmin of `examples/rv-20e.toml`" in " ".join(text.split())
