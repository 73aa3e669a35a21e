"""The FMU of a whole RV reducer: ratio, play, power, reversal, and the same interface as the drive's."""

import dataclasses
import math

import fmpy
import numpy as np
import pytest
from clockworks import Drive, kinematic_drive
from common import EXAMPLES
from fmpy.validation import validate_fmu
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.cli import app
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.run import described, simulate_fmu
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.reducer import lost_motion as rv
from cycloid_fmu.reducer.description import read_reducer, surface_of_reducer
from cycloid_fmu.surfaces.surface import nominal_surface

RV = read_reducer(EXAMPLES / "rv-20e.toml")
SURFACE = surface_of_reducer(RV)
STAGE = rv.parts_of(RV)[2]
TIGHT = dataclasses.replace(STAGE, sun_play=0.0, bearing_play=0.0)


def at(model, angle, torque, speed=0.0):
    model.crank_angle, model.torque, model.crank_speed = angle, torque, speed
    model.advance()
    return model.output_angle


def fresh(surface=SURFACE, stage=STAGE):
    return kinematic_drive(DriveValue(RV.stage, surface, stage))


def test_a_turn_of_the_output_takes_141_of_the_sun():
    model = fresh(nominal_surface(RV.stage), TIGHT)
    turn = at(model, 2 * math.pi * 141.0, 50.0) - at(model, 0.0, 50.0)
    assert turn == pytest.approx(2 * math.pi, abs=1e-12)
    half = at(model, math.pi * 141.0, 50.0) - at(model, 0.0, 50.0)
    assert half == pytest.approx(math.pi, abs=1e-5)  # the mesh's ripple


@pytest.mark.parametrize("torque", [120.0, -45.0])
@pytest.mark.parametrize("angle", [0.3, 77.0])
def test_the_solution_is_an_equilibrium_of_the_cycloid_stage(torque, angle):
    """Crank angle from the wheels' kinematics, the gear's torque less than the output's by the crank's share."""
    model = fresh()
    output = at(model, angle, torque)
    sun = angle + math.copysign(0.5 * STAGE.sun_play, torque)
    theta = output * (1 + 12 / 42) - sun * 12 / 42
    gear = output + math.copysign(0.5 * STAGE.bearing_play, torque) * -1.0
    crank_torque = model.crank_torque / (-12 / 42)
    wanted = solve(DriveValue(RV.stage, SURFACE), torque - (1 + 12 / 42) * crank_torque, theta, with_play=False)
    assert gear + theta / 39 == pytest.approx(float(wanted.transmission_error[0, 0]), abs=2e-12)


@pytest.mark.parametrize("torque", [100.0, -100.0])
def test_power_balances_over_a_period(torque):
    """The elastic energy returns after a mesh period of every part, so the work at both flanges adds up to nothing."""
    model = fresh(nominal_surface(RV.stage))
    # An error-free pair repeats each pin pitch of the crank against the gear: 141/(39 * 40) turns of the sun.
    angles = np.linspace(0.0, 2 * np.pi * 141.0 / (39 * 40), 41)
    outputs, torques = [], []
    for angle in angles:
        outputs.append(at(model, angle, torque))
        torques.append(model.crank_torque)
    work_in = np.trapezoid(torques, angles)
    assert work_in + torque * (outputs[-1] - outputs[0]) == pytest.approx(0.0, abs=2e-4 * abs(work_in))
    assert np.mean(torques) == pytest.approx(-torque / 141.0, rel=1e-3)


def test_speed_and_stiffness_are_the_derivatives():
    model = fresh()
    for angle in (3.0, 40.0):
        step = 1e-3
        rate = (at(model, angle + step, 90.0) - at(model, angle - step, 90.0)) / (2 * step)
        at(model, angle, 90.0, speed=1.0)
        assert model.output_speed == pytest.approx(rate, rel=1e-5)
        stiffness = model.torsional_stiffness
        more, less = at(model, angle, 90.5), at(model, angle, 89.5)
        assert stiffness == pytest.approx(1.0 / (more - less), rel=1e-4)


def test_play_is_that_of_all_stages_and_of_the_budget():
    model, found = fresh(), []
    for angle in np.linspace(0.0, 2 * np.pi * 141.0, 200, endpoint=False):
        model.forget_history()
        at(model, angle, 0.0)
        found.append(model.backlash)
    locked = rv.budget(RV)["geometric_sun_locked"]
    assert np.mean(found) == pytest.approx(locked["total"], rel=5e-3)


def test_reversal_takes_up_the_play():
    model = fresh()
    up, down = at(model, 5.0, 1e-4), at(model, 5.0, -1e-4)
    at(model, 5.0, 0.0)
    assert up - down == pytest.approx(model.backlash, rel=1e-3)
    # At zero torque the output stays where it is until a flank pushes it.
    at(model, 5.0, 1.0)
    held = at(model, 5.0, 0.0)
    inside = 0.5 * model.backlash * 141.0  # of the sun
    assert at(model, 5.0 - 0.2 * inside, 0.0) != held
    assert at(model, 5.0, 0.0) == model.output_angle
    pushed = model.output_angle
    assert at(model, 5.0 + 0.2 * inside, 0.0) == pushed


def test_friction_and_compliance_make_a_loop():
    model = fresh()
    model.friction_torque, model.series_compliance = 2.0, 1e-6
    loop = [at(model, 5.0, t) for t in (0.0, 50.0, 100.0, 50.0, 0.0, -100.0, -50.0, 50.0, 100.0)]
    assert loop[2] == pytest.approx(loop[-1], abs=1e-12)
    assert loop[3] > loop[1]  # unloading lags
    plain = fresh()
    plain.series_compliance = 1e-6
    # Coming down from 100, the output is where it would be at torque + friction without friction.
    assert loop[3] == pytest.approx(at(plain, 5.0, 52.0), abs=1e-12)


def test_states_are_returned_to_exactly():
    model = fresh()
    at(model, 1.0, 40.0)
    at(model, 1.2, 0.0)
    kept = model.state()
    ahead = [at(model, 1.2 + 0.1 * k, (-1) ** k * 30.0) for k in range(5)]
    model.restore(kept)
    assert [at(model, 1.2 + 0.1 * k, (-1) ** k * 30.0) for k in range(5)] == ahead
    other = fresh()
    other.restore(kept)
    assert [at(other, 1.2 + 0.1 * k, (-1) ** k * 30.0) for k in range(5)] == ahead


def test_without_a_first_stage_it_is_the_drive():
    """A sun much smaller than its planets hardly turns the carrier's cranks: the drive with its sun geared down."""
    slow = kinematic_drive(DriveValue(RV.stage, SURFACE, FirstStage(1, 10**6, 0.0, 0.0)))
    drive = kinematic_drive(DriveValue(RV.stage, SURFACE))
    sun = 0.4e6
    at(slow, sun, 60.0)
    # θ = φ_b - φ_a/10⁶ and φ_b is small: the drive at that crank angle, its crank standing on the output.
    theta = slow.output_angle * (1 + 1e-6) - sun * 1e-6
    at(drive, theta, 60.0 * 39 / 40)
    assert slow.output_angle == pytest.approx(drive.output_angle, abs=1e-7)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    made = tmp_path_factory.mktemp("reducer") / "rv.fmu"
    with pytest.warns(edge.InputWarning) as warned:
        built = CliRunner().invoke(app, ["build", str(EXAMPLES / "rv-20e.toml"), "-o", str(made)])
    assert built.exit_code == 0, built.output
    assert ["rv-20e.toml: " in str(warning.message) for warning in warned] == [True] * 3
    return made


def test_the_fmu_has_the_drive_s_interface(fmu):
    variables, problems = described(fmu)
    assert problems == []
    assert validate_fmu(str(fmu)) == []
    texts = {v["name"]: v["description"] for v in variables}
    assert texts["flange_a.phi"] == "sun angle, counter-clockwise"
    for name in ("flange_a.w", "flange_b.tau", "flange_b.phi", "backlash", "centre_distance_x", "pin_radial_1_cos"):
        assert name in texts


def test_the_fmu_moves_as_the_model(fmu):
    angles = np.linspace(0.0, 30.0, 40)
    torques = 80.0 * np.cos(angles)
    found = simulate_fmu(fmu, angles, torques, ("flange_b.phi", "flange_a.tau", "backlash"))
    model = fresh()
    for i, (angle, torque) in enumerate(zip(angles, torques, strict=True)):
        assert found["flange_b.phi"][i] == pytest.approx(at(model, angle, torque), abs=1e-12)
        assert found["flange_a.tau"][i] == pytest.approx(model.crank_torque, rel=1e-6, abs=1e-9)


@pytest.mark.slow(10)
def test_a_reducer_on_bearings_swings_with_inertias_inside(tmp_path):
    """From rest on its load it stays there, at the sun's torque that balances it."""
    reducer = read_reducer(EXAMPLES / "rv-20e-bearings.toml")
    interface = Interface("compliant", 0.5, crank_inertia=2e-5)
    build_fmu(cy.Drive(reducer), tmp_path / "rv.fmu", interface=interface, fmi_version="3.0")
    assert validate_fmu(str(tmp_path / "rv.fmu")) == []
    still = kinematic_drive(DriveValue(reducer.stage, *rv.parts_of(reducer)[1:]))
    at(still, 0.0, -80.0)
    found = fmpy.simulate_fmu(
        str(tmp_path / "rv.fmu"),
        stop_time=0.02,
        step_size=1e-3,
        output=["flange_b.phi", "flange_a.w"],
        start_values={"flange_b.tau": -80.0, "flange_a.tau": still.crank_torque},
    )
    assert np.ptp(found["flange_b.phi"]) < 1e-5
    assert np.abs(found["flange_a.w"]).max() < 0.5


def test_a_compliant_reducer_bears_the_torque_that_turns_the_quasi_static_one_so_far():
    """Its flanges held where the whole reducer carries 0.3 and 0.9 times the rated torque with the sun locked."""
    still = kinematic_drive(DriveValue(RV.stage, SURFACE, STAGE))
    held = Drive(DriveValue(RV.stage, SURFACE, STAGE), Interface("compliant"))
    for share in (0.3, -0.3, 0.9):
        at(still, 0.4, share * RV.stage.rated_torque)
        held.crank_angle, held.output_angle = 0.4, still.output_angle
        held.forget_history()
        held.advance()
        assert held.torque == pytest.approx(share * RV.stage.rated_torque, rel=5e-3)
