"""The drive with history: play, friction, compliance, state, speed; FMI apart."""

import math

import numpy as np
import pytest
from clockworks import compliant_drive, kinematic_drive
from common import CASES, EXAMPLES, PAIR, make_pair

from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.clockwork import StepError
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.reducer import lost_motion as rv
from cycloid_fmu.reducer.description import read_reducer, surface_of_reducer
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

PLAY = parse_pair(PAIR + '[modification]\noffset = "-40 um"\nisometric = "-15 um"\n', "play.toml")


def step(model, crank=None, torque=None):
    if crank is not None:
        model.crank_angle = crank
    if torque is not None:
        model.torque = torque
    model.advance()
    return model.output_angle


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_loaded_it_is_the_analysis(output):
    pair = parse_pair((CASES / "errors-39-40.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"'), "p")
    surface = surface_of_pair(pair)
    model = kinematic_drive(DriveValue(pair, surface))
    angles = np.linspace(-700.0, 900.0, 60)
    for torque in (-120.0, 60.0):
        wanted, close = solve(DriveValue(pair, surface), torque, angles), 0
        for i, angle in enumerate(angles):
            step(model, angle, torque)
            assert model.transmission_error == pytest.approx(wanted.transmission_error[0, i], abs=1e-11)
            assert model.backlash == pytest.approx(wanted.backlash[i], abs=1e-11)
            # A pin within picometres of touching stiffens by percents in the last nanoradian of x.
            assert model.torsional_stiffness == pytest.approx(wanted.torsional_stiffness[0, i], rel=1e-2)
            close += model.torsional_stiffness == pytest.approx(wanted.torsional_stiffness[0, i], rel=1e-5)
            assert model.max_contact_pressure == pytest.approx(wanted.max_contact_pressure[0, i], rel=1e-6)
            assert model.contact_count == wanted.contact_count[0, i]
        assert close > 0.9 * angles.size


def test_at_zero_torque_it_starts_in_the_middle_and_stays_until_a_flank_pushes():
    model = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    step(model, 0.0, 0.0)
    free = model.backlash
    assert model.transmission_error == pytest.approx(0.0, abs=1e-9)
    assert free > 5e-6
    before = model.output_angle
    # A quarter of the play, in crank angle: nothing touches, the output does not move.
    step(model, 0.25 * free * 39)
    assert model.output_angle == before
    step(model, 0.0)
    assert model.output_angle == before
    # Far beyond the play the output is pushed along by the flank, and stays there when the crank turns back a little.
    pushed = step(model, 0.5)
    end = solve(DriveValue(PLAY, nominal_surface(PLAY)), 0.0, 0.5).play_high[0]
    assert pushed == pytest.approx(-0.5 / 39 + end, abs=1e-11)
    step(model, 0.5 - 0.5 * free * 39)
    assert model.output_angle == pushed


def test_unloading_leaves_the_output_on_its_flank():
    model = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    step(model, 1.0, 100.0)
    loaded = model.transmission_error
    step(model, torque=0.0)
    ends = solve(DriveValue(PLAY, nominal_surface(PLAY)), 0.0, 1.0)
    assert model.transmission_error == pytest.approx(ends.play_high[0], abs=1e-11)
    assert model.transmission_error < loaded
    step(model, torque=-1e-3)
    assert model.transmission_error == pytest.approx(ends.play_low[0], abs=1e-8)


def test_interference_at_zero_torque_is_an_equilibrium():
    pair = read_pair(CASES / "interference-21-22.toml")
    model = kinematic_drive(DriveValue.as_stated(pair))
    step(model, 0.3, 0.0)
    assert model.backlash == 0.0
    assert model.torsional_stiffness > 0.0
    assert model.contact_count > 1
    wanted = solve(DriveValue.as_stated(pair), 0.0, 0.3)
    assert model.transmission_error == pytest.approx(wanted.transmission_error[0, 0], abs=1e-11)


def test_friction_is_the_loop_of_the_definition():
    """docs/theory/measurement.md: θ = elastic(T ∓ T_f) on the loading, elastic(T ± T_f) on the unloading branch."""
    elastic, model = (kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY))) for _ in range(2))
    model.set_friction(1, coulomb=5.0, presliding_angle=1e-9)  # the definition's friction builds up without presliding

    def curve(torque):
        return step(elastic, 0.2, torque)

    step(model, 0.2, -100.0)
    for torque in np.arange(-90.0, 101.0, 7.0):
        if abs(torque - 5.0) > 1e-9 and torque > -80.0:
            assert step(model, torque=torque) == pytest.approx(curve(torque - 5.0), abs=1e-11)
    top = step(model, torque=101.0)
    for torque in (95.0, 92.0):  # friction holds it until the torque has fallen by twice the friction
        assert step(model, torque=torque) == pytest.approx(top, abs=2e-9)
        model.crank_speed = 1.0
        assert model.output_speed == pytest.approx(0.0, abs=1e-4)
    for torque in np.arange(90.0, -60.0, -7.0):
        assert step(model, torque=torque) == pytest.approx(curve(torque + 5.0), abs=1e-11)


def test_what_friction_holds_carries_the_torque_between():
    model = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    model.series_compliance = 1e-6
    model.set_friction(1, coulomb=5.0, presliding_angle=1e-9)
    step(model, 0.2, 50.0)
    step(model, torque=60.0)
    stiff, carried = model.torsional_stiffness, model.crank_torque
    step(model, torque=55.0)  # the teeth still carry it, the friction nothing
    free = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    step(free, 0.2, 55.0)
    assert carried == pytest.approx(free.crank_torque, rel=1e-4)
    assert model.crank_torque == pytest.approx(carried, rel=1e-4)
    assert model.torsional_stiffness == pytest.approx(stiff, rel=1e-4)


def test_series_compliance_adds_its_twist_and_softens():
    stiff, soft = (kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY))) for _ in range(2))
    soft.series_compliance = 2e-7
    for torque in (-150.0, 30.0):
        twist = step(soft, 0.7, torque) - step(stiff, 0.7, torque)
        assert twist == pytest.approx(2e-7 * torque, rel=1e-9, abs=0.0)
        assert 1 / soft.torsional_stiffness == pytest.approx(1 / stiff.torsional_stiffness + 2e-7, rel=1e-9, abs=0.0)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize("torque", [-120.0, 120.0, 0.0])
def test_speed_is_the_angle_s_derivative(output, torque):
    pair = parse_pair((CASES / "errors-39-40.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"'), "p")
    model = kinematic_drive(DriveValue.as_stated(pair))
    model.crank_speed = 10.0
    step(model, 0.0, torque)
    step(model, 0.5)  # at zero torque: far enough that a flank pushes
    for angle in np.linspace(0.6, 5.0, 12):
        before = step(model, angle - 1e-6)
        after = step(model, angle + 1e-6)
        step(model, angle + 2e-6)
        wanted = (after - before) / 2e-6 * 10.0
        assert model.output_speed == pytest.approx(wanted, rel=2e-5)


def test_a_state_restores_exactly():
    model = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    model.friction_torque, model.series_compliance = 3.0, 1e-8
    model.set_error("pin_radial_1_cos", 5e-6)
    path = [(0.1 * i, 40.0 * np.sin(0.7 * i)) for i in range(40)]
    for angle, torque in path[:20]:
        step(model, angle, torque)
    state = model.state()
    first = [(step(model, a, t), model.contact_count, model.crank_torque) for a, t in path[20:]]
    model.set_error("pin_radial_1_cos", 0.0)
    model.restore(state)
    again = [(step(model, a, t), model.contact_count, model.crank_torque) for a, t in path[20:]]
    other = kinematic_drive(DriveValue(PLAY, nominal_surface(PLAY)))
    other.restore(state)
    elsewhere = [(step(other, a, t), other.contact_count, other.crank_torque) for a, t in path[20:]]
    assert first == again == elsewhere


def test_many_turns_cost_no_accuracy():
    pair = read_pair(CASES / "errors-39-40.toml")
    model = kinematic_drive(DriveValue.as_stated(pair))
    step(model, 0.4, 100.0)
    near = model.transmission_error
    step(model, 0.4 + 2 * np.pi * 39 * 10000, 100.0)
    assert model.transmission_error == pytest.approx(near, abs=1e-9)


def test_an_error_set_is_an_error_built_in():
    text = PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n'
    pair = make_pair(text)
    stated = '[errors]\npin_tangential = { order_2 = ["3 um", "90 deg"] }\ncentre_distance_y = "2 um"\n'
    built = make_pair(text + stated)
    model = kinematic_drive(DriveValue(pair, nominal_surface(pair)))
    wanted = kinematic_drive(DriveValue.as_stated(built))
    step(model, 0.1, 50.0)
    model.set_error("pin_tangential_2_sin", 3e-6)
    model.set_error("centre_distance_y", 2e-6)
    assert step(model, 0.9, 50.0) == pytest.approx(step(wanted, 0.9, 50.0), abs=1e-12)
    assert wanted.errors["pin_tangential_2_sin"] == pytest.approx(3e-6, abs=1e-15)


def drives():
    whole = read_reducer(EXAMPLES / "rv-20e.toml")
    surface = surface_of_reducer(whole)
    return {
        "drive": (kinematic_drive, DriveValue(PLAY, nominal_surface(PLAY))),
        "compliant": (compliant_drive, DriveValue(PLAY, nominal_surface(PLAY))),
        "reducer": (kinematic_drive, DriveValue(whole.stage, surface, rv.parts_of(whole)[2])),
    }


@pytest.mark.parametrize("kind", ["drive", "compliant", "reducer"])
def test_a_refused_step_and_a_state_restored_leave_nothing_changed(kind):
    build, made_of = drives()[kind]

    def turned(angle):
        model.crank_angle = angle
        if kind == "compliant":
            model.output_angle = angle / model.pair.ratio + 2.2e-4

    model = build(made_of)
    model.friction_torque = 2.0
    model.set_loss(0, 3, 0.1)
    turned(0.2)
    model.advance(1e-3)
    first = model.state()
    turned(0.5)
    model.set_error("pin_radius", 1e-6)
    model.advance(1e-3)
    before = model.state()
    with pytest.raises(StepError, match="finite"):
        model.advance(math.nan)
    if kind == "compliant":
        model.output_angle += 1.0
        moved = model.state()
        with pytest.raises(StepError, match="must stay within"):
            model.advance(1e-3)
        assert model.state() == moved
        model.output_angle -= 1.0
    else:
        assert model.state() == before
    assert first["errors"] != before["errors"]
    assert first["memory"] != before["memory"]
    for other in (model, build(made_of)):
        other.restore(first)
        assert other.state() == first
