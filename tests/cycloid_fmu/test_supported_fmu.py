"""Drives on their bearings behind an FMU's flanges, against an independent solver, `analyze` and their energy."""

import functools
import itertools
import json
import math

import fmpy
import numpy as np
import pytest
from clockworks import check_restored, compliant_drive, kinematic_drive
from common import ARCSEC, DATA

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.supports.transmission import PLAY_LOAD

CASES = DATA / "supports-cases"
NAMES = ("cranks-linear", "cranks-rollers-clearance", "rollers")


@functools.cache
def drive(case):
    pair = read_pair(CASES / f"{case}.toml")
    return DriveValue.as_stated(pair)


def put(model, crank, deviation, crank_speed=0.0, deviation_speed=0.0):
    ratio = model.pair.ratio
    model.crank_angle, model.crank_speed = crank, crank_speed
    model.output_angle, model.output_speed = crank / ratio + deviation, crank_speed / ratio + deviation_speed


@pytest.mark.parametrize("case", NAMES)
def test_the_kinematic_model_is_the_independent_solver_s(case):
    wanted, model = json.loads((CASES / f"{case}.json").read_text()), kinematic_drive(drive(case))
    for result in wanted["results"]:
        model.forget_history()
        for i, angle in list(enumerate(wanted["crank_angle"]))[::3]:
            model.crank_angle, model.torque = angle, result["torque"]
            model.advance()
            at = {name: np.ravel(values)[i] for name, values in result.items() if np.size(values) > i}
            assert model.transmission_error == pytest.approx(at["transmission_error"], abs=0.01 * ARCSEC)
            assert model.torsional_stiffness == pytest.approx(at["torsional_stiffness"], rel=5e-3)
            assert model.backlash == pytest.approx(at["backlash"], abs=0.05 * ARCSEC)
            assert model.crank_torque == pytest.approx(at["crank_torque"], abs=1e-4 * abs(result["torque"]))


@pytest.mark.parametrize("case", NAMES)
@pytest.mark.parametrize(("compliance", "backlash_on"), [(0.0, True), (5e-6, True), (1e-6, False)])
def test_both_torques_are_derivatives_of_the_stored_energy(case, compliance, backlash_on):
    model = compliant_drive(drive(case))
    model.series_compliance, model.backlash_on = compliance, backlash_on

    def energy(crank, output):
        model.crank_angle, model.output_angle = crank, output
        return model.elastic_energy

    pressed = 0
    for crank, deviation in ((0.3, 1.9e-3), (2.0, -2.1e-3), (5.5, 4e-4)):
        output = crank / model.ratio + deviation
        by_crank = (energy(crank + 1e-6, output) - energy(crank - 1e-6, output)) / 2e-6
        by_output = (energy(crank, output + 1e-8) - energy(crank, output - 1e-8)) / 2e-8
        model.crank_angle, model.output_angle = crank, output
        pressed += abs(model.torque) > 10.0
        assert model.crank_torque == pytest.approx(by_crank, rel=1e-5, abs=1e-4)
        assert model.torque == pytest.approx(by_output, rel=1e-5, abs=1e-4)
    assert pressed >= 2


@pytest.mark.parametrize("backlash_on", [True, False])
@pytest.mark.parametrize(("crank_angle", "has_play"), [(0.45, False), (0.3, False), (0.6, True), (0.9, True)])
def test_the_output_s_speed_is_the_rate_of_its_angle_below_the_load_of_the_play(crank_angle, has_play, backlash_on):
    """Also where there is no play because the ends cross that the drive's own tangents give."""
    model, near = kinematic_drive(drive("cranks-rollers-clearance")), 1e-4
    model.torque, model.backlash_on, model.crank_speed = 0.5 * PLAY_LOAD * model.pair.rated_torque, backlash_on, 1.0

    def output_angle(place):
        model.crank_angle = place
        model.advance()
        return model.output_angle

    rate = (output_angle(crank_angle + near) - output_angle(crank_angle - near)) / (2.0 * near)
    output_angle(crank_angle)
    assert (model.backlash > 0.0) == (has_play and backlash_on)
    assert model.output_speed == pytest.approx(rate, abs=3e-6)


@pytest.mark.parametrize("case", NAMES)
def test_it_is_the_quasi_static_drive_seen_from_both_flanges(case):
    """The energy's torque and the balance's differ by the term of moving curvature; inside the play by nothing."""
    model, driven = compliant_drive(drive(case)), kinematic_drive(drive(case))
    for crank, torque in ((0.4, 100.0), (3.0, -60.0), (40.0, 150.0)):
        driven.crank_angle, driven.torque = crank, torque
        driven.advance()
        put(model, crank, driven.transmission_error)
        assert model.torque == pytest.approx(torque, rel=3e-3)
        assert model.crank_torque == pytest.approx(driven.crank_torque, rel=5e-3)
        assert model.backlash == pytest.approx(driven.backlash, abs=1e-9)
    driven.forget_history()
    driven.torque = 0.0
    driven.advance()
    put(model, 40.0, driven.transmission_error)
    assert abs(model.torque) < PLAY_LOAD * model.pair.rated_torque


def test_a_closed_path_through_the_play_gives_nothing_back():
    """Work by Simpson's rule along straight lines, in parts short enough for what bends between them."""
    model = compliant_drive(drive("cranks-rollers-clearance"))
    done = passed = 0.0
    corners = [(0.0, 6e-4), (0.07, 7e-4), (0.1, -6e-4), (-0.05, -3e-4), (0.0, 6e-4)]
    for start, end in itertools.pairwise(corners):
        way, parts, torques = np.subtract(end, start), 400, []
        for share in np.linspace(0.0, 1.0, parts + 1):
            put(model, *np.add(start, way * share))
            torques.append((model.crank_torque, model.torque))
        turned = np.array([way[0], way[0] / model.ratio + way[1]])
        weights = np.ones(parts + 1)
        weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
        work = np.array(torques) * turned * weights[:, None] / (3.0 * parts)
        done, passed = done + work.sum(), passed + np.abs(work).sum()
    assert passed > 0.1
    assert abs(done) < 1e-4 * passed


@pytest.mark.parametrize("case", ["cranks-rollers-clearance"])
def test_with_inertias_inside_work_is_stored_lost_or_given_back(case):
    model = compliant_drive(drive(case), output_inertia=0.5, crank_inertia=2e-4)
    model.mesh_damping = 50.0
    model.forget_history()
    model.advance()
    begun, done, passed = model.elastic_energy, 0.0, 0.0
    for i in range(60):
        before = model.crank_angle, model.output_angle
        model.crank_torque = driving = 2.0 * math.cos(300.0 * i * 1e-3)
        model.torque = load = -20.0 * math.cos(130.0 * i * 1e-3)
        model.advance(1e-3)
        work = driving * (model.crank_angle - before[0]), load * (model.output_angle - before[1])
        done, passed = done + sum(work), passed + sum(map(abs, work))
    moving = 0.5 * (0.5 * model.output_speed**2 + 2e-4 * model.crank_speed**2)
    assert passed > 0.1
    assert abs(done - moving - (model.elastic_energy - begun) - model.dissipated_energy) < 1e-4 * passed


def test_a_state_restores_exactly_also_in_another_instance():
    model, other = kinematic_drive(drive("rollers")), kinematic_drive(drive("rollers"))
    model.friction_torque = 3.0
    check_restored(model, other, 12, 40.0)


def test_friction_and_play_hold_the_output_between_both_directions():
    """At no torque the drive keeps its position within its play, and moves with the end of the play that it meets."""
    pair, surface = drive("rollers").pair, drive("rollers").surface
    model = kinematic_drive(DriveValue(pair, surface))
    for torque in (50.0, 0.0):
        model.torque = torque
        model.advance()
    at_high, play = model.transmission_error, model.backlash
    for torque in (-50.0, 0.0):
        model.torque = torque
        model.advance()
    assert at_high - model.transmission_error == pytest.approx(play, rel=1e-9)
    model.friction_torque = 5.0
    model.torque = 4.0
    model.advance()
    assert model.torsional_stiffness == 0.0


def test_rigid_bearings_are_the_drive_without_them():
    pair = read_pair(CASES / "cranks-linear.toml").nominal.replace(errors={"pin_radius": "-2 um"})
    rigid = {"kind": "cranks", "count": 3, "circle_radius": "36 mm"}
    held, free = (
        compliant_drive(DriveValue.as_stated(one))
        for one in (pair.replace(supports=rigid), pair.replace(supports=None))
    )
    for model in (held, free):
        put(model, 1.3, 3.5e-4)
    assert abs(free.torque) > 20.0
    for name in ("torque", "crank_torque", "elastic_energy", "torsional_stiffness", "max_contact_pressure"):
        assert getattr(held, name) == pytest.approx(getattr(free, name), rel=2e-3)


def test_without_a_rated_torque_it_is_refused(tmp_path):
    pair = drive("cranks-linear").pair.replace(rated_torque=None)
    with pytest.raises(edge.InputError, match=r"rated_torque is missing; with \[supports\] the play"):
        build_fmu(DriveValue.as_stated(pair), tmp_path / "drive.fmu")


def test_a_built_fmu_is_what_analyze_says(tmp_path):
    pair = drive("cranks-rollers-clearance").pair
    cy.Drive(pair).build_fmu(tmp_path / "drive.fmu")
    time = np.arange(12) * 0.01
    motion = np.array(
        [(t, 20.0 * t, 120.0) for t in time], [("time", float), ("flange_a.phi", float), ("flange_b.tau", float)]
    )
    found = fmpy.simulate_fmu(
        str(tmp_path / "drive.fmu"),
        stop_time=time[-1],
        step_size=0.01,
        input=motion,
        output=["flange_a.phi", "transmission_error", "flange_a.tau"],
    )
    angles = found["flange_a.phi"] if "flange_a.phi" in found.dtype.names else 20.0 * found["time"]
    wanted = cy.Drive(pair).analyze("120 N*m", crank_angle=angles)
    away = found["transmission_error"] - wanted.transmission_error.values[0]
    assert np.abs(away[1:]).max() < 1e-3 * ARCSEC
    assert found["flange_a.tau"][1:] == pytest.approx(wanted.crank_torque.values[0][1:], rel=1e-6)


@pytest.mark.parametrize("case", NAMES)
def test_a_place_is_the_same_wherever_the_drive_came_from(case):
    """Jumps of crank, torque and flanges, through the play and beyond the rated torque, against a drive just made."""
    generator = np.random.default_rng(5)
    held, pressed = kinematic_drive(drive(case)), compliant_drive(drive(case))
    for _ in range(10):
        crank, deviation = generator.uniform(0.0, 50.0), generator.uniform(-2e-3, 2e-3)
        torque = held.pair.rated_torque * generator.choice([5e-4, 0.01, 0.5, 2.5]) * generator.uniform(-1.0, 1.0)
        alone, apart = kinematic_drive(drive(case)), compliant_drive(drive(case))
        for model in (held, alone):
            model.crank_angle, model.torque = crank, torque
            model.advance()
        for model in (pressed, apart):
            put(model, crank, deviation)
        assert held.transmission_error == pytest.approx(alone.transmission_error, abs=1e-5 * ARCSEC)
        assert pressed.torque == pytest.approx(apart.torque, abs=1e-6 * held.pair.rated_torque)
        assert pressed.elastic_energy == pytest.approx(apart.elastic_energy, abs=1e-7)
