"""Strength: beams and bars of textbooks, the balance of the loads, and limits that say what is missing."""

import math

import numpy as np
import pytest
from common import make_pair

from cycloid_fmu.analysis import solve
from cycloid_fmu.bodies.beams import Beam
from cycloid_fmu.bodies.elastic import PlaneBody
from cycloid_fmu.bodies.mesh import Contour, meshed
from cycloid_fmu.bodies.outline import places
from cycloid_fmu.bodies.ports import patch
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.bodies import Bodies, DiscBody, Section
from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.pair import Material
from cycloid_fmu.studies.limits import Requirements, judge_strength
from cycloid_fmu.studies.strength import (
    fatigue_stress,
    least_web,
    output_directions,
    pin_directions,
    strength,
    web_stresses,
)
from cycloid_fmu.surfaces.surface import surface_of_pair

LENGTH, FORCE = 0.04, 181.0
TURN = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
NAMED = {"gear": {"name": "7075-T6"}, "pin": {"name": "bearing steel"}, "output_pin": {"name": "case-hardened steel"}}


def _on_pins(discs=2):
    supports = {
        "kind": "output_rollers",
        "count": 8,
        "circle_radius": "40 mm",
        "turning_arm": {"stiffness": "200 N/um"},
        "output_roller": {"stiffness": "200 N/um", "radius": "4 mm"},
    }
    return make_pair(discs=discs).replace(supports=supports, material=NAMED)


@pytest.fixture(scope="module")
def solved():
    pair = _on_pins()
    drive = DriveValue(pair, surface_of_pair(pair))
    return drive, solve(drive, np.array([FORCE]), TURN, with_play=False)


@pytest.mark.parametrize(
    ("ends", "width", "moment", "shear"),
    [
        # Roark's Formulas, beams: a force in the middle (of the cantilever on its end), and a uniform load.
        ("cantilever", 1e-6, 1.0, 1.0),
        ("supported", 1e-6, 1.0 / 4.0, 0.5),
        ("clamped", 1e-6, 1.0 / 8.0, 0.5),
        ("cantilever", 1.0, 1.0 / 2.0, 1.0),
        ("supported", 1.0, 1.0 / 8.0, 0.5),
        ("clamped", 1.0, 1.0 / 12.0, 0.5),
    ],
)
@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_moments_and_shear_forces_are_those_of_textbooks(ends, width, moment, shear, turned):
    beam = Beam((Section(start=-0.02, end=0.02, diameter=0.002),), Material())
    middle = turned * (0.5 - 0.5 * width) * LENGTH if ends == "cantilever" else 0.0
    load = (middle - 0.5 * width * LENGTH, middle + 0.5 * width * LENGTH)
    at = np.linspace(-0.02 + 1e-12, 0.02 - 1e-12, 2001)
    supports = (-0.02 * turned, 0.02 * turned)
    moments, shears = beam.internal_forces(ends, supports, [load], at)
    assert np.abs(moments).max() == pytest.approx(moment * LENGTH, rel=2e-3)
    assert np.abs(shears).max() == pytest.approx(shear, rel=2e-3)


def test_shear_is_the_slope_of_the_moment():
    beam = Beam((Section(start=-0.02, end=0.02, diameter=0.006),), Material())
    at = np.linspace(-0.0199, 0.0199, 4001)
    for ends in ("cantilever", "supported", "clamped"):
        moments, shears = beam.internal_forces(ends, (-0.02, 0.02), [(-0.012, -0.002), (0.001, 0.015)], at)
        slope = np.gradient(moments, at, axis=1)
        inside = np.abs(np.abs(slope) - np.abs(shears)) < 1e-3
        assert inside.mean() > 0.99  # but for the corners of uniform loads


def _bar(height):
    corners = [-0.05 - 0.5j * height, 0.05 - 0.5j * height, 0.05 + 0.5j * height, -0.05 + 0.5j * height]
    sides = tuple(np.linspace(a, b, 50) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True))
    mesh = meshed(Contour(sides, 0.1 * height, "bar"), [], 0.2 * height)
    return PlaneBody(mesh, Material(), 0.004)


@pytest.mark.parametrize("eccentric", [0.0, 2e-3])
def test_stress_in_a_bar_is_that_of_its_force_and_moment(eccentric):
    # Far from its ends a bar has σ = F/A + M y/I (Saint-Venant).
    height, force = 0.01, 500.0
    body = _bar(height)
    ends = np.array([-0.05 + 1j * eccentric, 0.05 + 1j * eccentric])
    weights = patch(body, 0, ends, np.array([-1j, 1j]), 1e-3)
    forces = body.nodal_vector(np.asarray(weights @ (force * np.array([-1.0, 1.0 + 0.0j]))))
    moved = body.displacement(forces[:, None])
    y = np.linspace(-0.4, 0.4, 5) * height
    xx, yy, xy = (matrix @ moved[:, 0] for matrix in body.stress(1e-4 + 1j * y))
    expected = force / (0.004 * height) + force * eccentric * y / (0.004 * height**3 / 12.0)
    assert xx == pytest.approx(expected, rel=5e-3, abs=5e-3 * np.abs(expected).max())
    assert np.abs(yy).max() < 0.02 * np.abs(xx).max()
    assert np.abs(xy).max() < 0.02 * np.abs(xx).max()


def test_forces_on_pins_and_output_pins_balance_the_torques(solved):
    drive, swept = solved
    pair = drive.pair
    axes = pair.pin_circle_radius * np.exp(2j * np.pi * np.arange(pair.pins) / pair.pins)
    on_ring = (np.conj(axes) * swept.pin_force * pin_directions(pair, TURN)).imag.sum(axis=(2, 3))
    on_output = np.conj(places(pair)) * swept.output_roller_force * output_directions(pair, TURN)[..., None]
    # The ring holds the torques of output and input together, and the output pins that of the output.
    assert on_ring == pytest.approx(FORCE * (1.0 + 1.0 / pair.gear_teeth), rel=0.02)
    assert -on_output.imag.sum(axis=(2, 3)) == pytest.approx(FORCE, rel=0.01)


def test_a_cantilevered_output_pin_bends_as_its_force_times_its_arm():
    pair = _on_pins(discs=1)
    width, reach, diameter = pair.face_width, 0.012, 0.008
    drive = DriveValue(pair, surface_of_pair(pair))
    swept = solve(drive, np.array([FORCE]), TURN, with_play=False)
    start = -0.5 * width - reach
    bodies = Bodies(output_pin={"ends": "cantilever", "from": start, "to": 0.5 * width, "diameter": diameter})
    rows = {(row.part, row.kind): row for row in strength(drive, swept, bodies)}
    force = swept.output_roller_force.max()
    bending = rows["output pin", "bending"]
    assert bending.value == pytest.approx(32.0 * force * (reach + 0.5 * width) / (math.pi * diameter**3), rel=1e-6)
    assert bending.permitted == MATERIALS["case-hardened steel"].yield_strength[0]
    assert rows["output pin", "shear"].value == pytest.approx(4.0 * force / (math.pi * diameter**2), rel=1e-6)
    assert rows["disc", "pressure"].value == pytest.approx(force / (0.008 * width))
    assert rows["pin", "pressure"].value == pytest.approx(swept.pin_force.max() / (2.0 * pair.pin_radius * width))


def test_soderberg_s_line_ends_at_fatigue_and_yield():
    steel = MATERIALS["case-hardened steel"]
    fatigue, limit = steel.bending_fatigue[0], steel.yield_strength[0]
    assert fatigue_stress(np.array([-fatigue, fatigue]), steel) == pytest.approx(fatigue)
    assert fatigue_stress(np.array([limit, limit]), steel) == pytest.approx(fatigue)


@pytest.mark.slow(2)
def test_webs_by_finite_elements_have_the_size_of_those_of_an_eye(solved):
    drive, swept = solved
    pair, hole, bore = drive.pair, 0.0053, 0.03
    body = DiscBody(bore_radius=bore, roller_hole_radius=hole)
    fibres, shear, width = web_stresses(pair, body, swept, 0, 0, np.arange(0, 36, 6))
    least = least_web(pair, hole, bore)
    assert width.min() == pytest.approx(least, rel=0.05)
    largest = np.sqrt(np.abs(fibres).max(axis=-1) ** 2 + 3.0 * shear**2).max()
    eye = math.sqrt(3.0) * swept.output_roller_force.max() / (2.0 * least * pair.face_width)
    assert 0.4 * eye < largest < 2.5 * eye


def test_what_is_not_known_is_not_judged(solved):
    drive, swept = solved
    asked = Requirements(
        limits={"pin_safety": 2.0, "output_pin_safety": 2.0, "disc_safety": 2.0, "fatigue_safety": 2.0}
    )
    rows = strength(drive, swept)
    assert [row.reason for row in rows if row.part == "output pin"] == 3 * [
        "state [bodies.output_pin] with its dimensions"
    ]
    judged = judge_strength(asked.limits, rows)
    assert [one.figure for one in judged] == ["pin_safety", "disc_safety"]
    for one in judged:
        part = one.figure.removesuffix("_safety")
        assert one.value == min(row.safety for row in rows if row.part == part and row.kind != "fatigue")
    pair = drive.pair.replace(material={"gear": {"youngs_modulus": "70 GPa"}})
    bare = strength(DriveValue(pair, drive.surface), swept)
    assert {row.reason.split(":")[0] for row in bare if row.part in ("pin", "disc")} >= {"state [material.gear] name"}
    assert judge_strength(asked.limits, bare) == []


def test_analyze_judges_strength(command, tmp_path):
    pair = _on_pins()
    (tmp_path / "pair.toml").write_text(pair.replace(rated_torque=FORCE).text)
    (tmp_path / "asked.toml").write_text(
        'format = "cycloid-requirements/1"\n[limits]\npin_safety = 1.5\ndisc_safety = 1.5\n'
    )
    done = command("cycloid-fmu", "analyze", "pair.toml", "--limits", "asked.toml")
    assert done.returncode == 0, done.stderr
    assert "Nominal stresses" in done.stdout
    (tmp_path / "asked.toml").write_text('format = "cycloid-requirements/1"\n[limits]\noutput_pin_safety = 1.5\n')
    done = command("cycloid-fmu", "analyze", "pair.toml", "--limits", "asked.toml")
    assert done.returncode == 4
    assert "state [bodies.output_pin]" in " ".join(done.stdout.split())
