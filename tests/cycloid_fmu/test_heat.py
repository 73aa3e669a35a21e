"""How warm a drive gets: closed forms of one heat capacity, the balance at the end, and drives that run away."""

import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.geometry.thermal import Thermal
from cycloid_fmu.losses.heat import at_oil_temperature
from cycloid_fmu.studies.limits import Requirements, row_of

ICE = 273.15
SPRINGS = {"stiffness": "400 N/um"}
PAIR = {
    "gear_teeth": 39,
    "pin_circle_radius": 64e-3,
    "pin_radius": 3e-3,
    "eccentricity": 1.3e-3,
    "face_width": 0.01,
    "rated_torque": 181.0,
    "modification": {"isometric": -15e-6, "offset": -40e-6},
    "supports": {
        "kind": "cranks",
        "count": 3,
        "circle_radius": 36e-3,
        "turning_arm": SPRINGS,
        "crank_shaft": SPRINGS,
        "main": {"stiffness": "1200 N/um"},
    },
}
DRY = {"flank": {"friction_coefficient": 0.06}}
OILED = {
    **DRY,
    "turning_arm": {"mean_diameter": 25e-3, "load_factor": 4e-4, "speed_factor": 3.0},
    "main": {"mean_diameter": 0.12, "load_factor": 5e-4, "speed_factor": 3.0},
    "input_drag": {"churning": 1e-3},
    "lubricant": {"viscosity_40": 150e-6, "viscosity_100": 15e-6, "temperature": "40 degC"},
}
THERMAL = {"resistance": 0.8, "capacity": 3000.0, "ambient": "20 degC"}
SPEED = 50.0 * math.pi  # 1500 rpm


def drive(losses, thermal, **changes):
    return cy.Drive(cy.Pair(**{**PAIR, "losses": losses, "thermal": thermal, **changes}))


def watts(made, torque=181.0, speed=SPEED):
    """Heat of the driving drive by another way."""
    return made.losses(torque, speed, angles=40, workers=1).cases[0].heat


def test_losses_that_do_not_depend_on_temperature_are_one_resistance_and_one_capacity():
    """Dry flanks: T - T_0 = R P, 63.2 % of it after RC, 95 % after RC ln 20; a steel drive that grows as a whole."""
    made = drive(DRY, THERMAL)
    found = made.heat(crank_speed=SPEED, angles=40, workers=1)
    power = watts(made)
    assert found.oil - 293.15 == pytest.approx(0.8 * power, rel=2e-3)
    assert found.housing == found.oil
    assert found.time_to(1.0 - math.exp(-1.0)) == pytest.approx(2400.0, rel=3e-3)
    assert found.time_to(0.95) == pytest.approx(2400.0 * math.log(20.0), rel=3e-3)
    assert found.efficiency[0] == pytest.approx(181.0 / 39 * SPEED / (181.0 / 39 * SPEED + power), abs=2e-3)
    assert not found.others
    assert not found.reason
    again = drive(DRY, {"area": "0.0625 m^2", "convection": "20 W/(m^2*K)", "ambient": "20 degC"})
    other = again.heat(crank_speed=SPEED, angles=40, workers=1)
    assert other.oil == pytest.approx(found.oil, abs=1e-6)
    assert math.isnan(other.time_to(0.95))


def test_at_the_steady_temperature_all_heat_is_given_off():
    """With the oil's viscosity there: the drive that states these temperatures makes (T - T_0)/R."""
    made = drive(OILED, {**THERMAL, "oil_resistance": 0.05})
    found = made.heat(crank_speed=SPEED, angles=40, workers=1)
    assert found.housing - 293.15 == pytest.approx(0.8 / 0.85 * (found.oil - 293.15), rel=1e-9)
    inside = dict.fromkeys(("discs", "carrier", "crank"), found.oil)
    losses = {**OILED, "lubricant": {**OILED["lubricant"], "temperature": found.oil}}
    there = made.replace(temperature={"ring": found.housing, **inside}, losses=losses)
    assert watts(there) == pytest.approx((found.oil - 293.15) / 0.85, rel=1e-4)
    assert watts(there) < 0.8 * watts(made)
    thinner = made.replace(thermal={**THERMAL, "resistance": 0.4}).heat(crank_speed=SPEED, angles=40, workers=1)
    assert thinner.power > found.power


@pytest.mark.slow(2)
def test_the_warm_up_is_that_of_the_differential_equation():
    """C dT/dt = P(T) - (T - T_0)/R, integrated step by step with the drive solved at each temperature."""
    made = drive(OILED, THERMAL)
    found = made.heat(crank_speed=SPEED, angles=10, workers=1)

    def rate(_, state):
        warm = at_oil_temperature(made, float(state[0]))
        heat = cy.Drive(warm.pair).losses(181.0, SPEED, angles=10, workers=1).cases[0].heat
        return [(heat - (state[0] - 293.15) / 0.8) / 3000.0]

    moments = [found.time_to(share) for share in (0.3, 1.0 - math.exp(-1.0), 0.95)]
    solved = solve_ivp(rate, (0.0, moments[-1]), [293.15], t_eval=moments, rtol=1e-4, atol=1e-2)
    rise = found.oil - 293.15
    assert (solved.y[0] - 293.15) / rise == pytest.approx([0.3, 1.0 - math.exp(-1.0), 0.95], abs=2e-3)


def test_over_a_duty_heat_counts_by_its_time():
    duty = [
        {"torque": "181 N*m", "output_speed": SPEED / 39, "share": 0.4},
        {"torque": "-60 N*m", "output_speed": SPEED / 78, "share": 0.35},
        {"torque": "100 N*m", "output_speed": "0 rpm", "share": 0.25},
    ]
    made = drive(DRY, THERMAL)
    found = made.heat(requirements=Requirements(duty=duty), angles=40, workers=1)
    back = made.losses(-60.0, 0.5 * SPEED, angles=40, workers=1).cases
    driven = next(case for case in back if case.mode == "driving")
    mean = 0.4 * watts(made) + 0.35 * driven.heat
    assert found.power == pytest.approx(mean, rel=3e-3)
    assert found.oil == pytest.approx(293.15 + 0.8 * mean, rel=1e-3)
    assert len(found.efficiency) == 2


def squeezed(resistance, **changes):
    """Discs that are warmer than their ring, without enough clearance for it."""
    thermal = {"resistance": resistance, "oil_resistance": 0.25, "capacity": 3000.0, "ambient": "20 degC", **changes}
    return drive(DRY, thermal, modification={"isometric": -5e-6, "offset": -16e-6})


def test_a_drive_whose_discs_outgrow_their_ring_runs_away():
    """Warmer discs press on the pins, which makes heat, which makes them warmer: no temperature is steady."""
    found = squeezed(0.5, largest="90 degC").heat(crank_speed=2.0 * SPEED, angles=20, workers=1)
    assert math.isnan(found.oil)
    assert "gives off" in found.reason
    assert found.too_warm
    assert math.isnan(found.time_to(0.95))
    assert found.warming[-1] > 363.15
    assert (np.diff(found.time) > 0.0).all()
    numbers = json.loads(edge.json_text(found.numbers()))
    assert numbers["oil"] is None
    assert numbers["reason"] == found.reason


def test_a_second_balance_of_heat_is_stated():
    """At half the speed the same drive has a steady temperature, and a higher one above which it would run away."""
    found = squeezed(0.5).heat(crank_speed=SPEED, angles=20, workers=1)
    assert not found.reason
    (second,) = found.others
    warm = at_oil_temperature(squeezed(0.5), second)
    power = cy.Drive(warm.pair).losses(181.0, SPEED, angles=20, workers=1).cases[0].heat
    assert power == pytest.approx((second - 293.15) / 0.75, rel=1e-3)
    hotter = at_oil_temperature(squeezed(0.5), second + 5.0)
    power = cy.Drive(hotter.pair).losses(181.0, SPEED, angles=20, workers=1).cases[0].heat
    assert power > (second + 5.0 - 293.15) / 0.75


def test_a_clearance_that_is_used_up_ends_the_search_where_it_is():
    """The carrier outgrows the main bearing by E (ε_c - ε_r): below that a steady temperature is found, above none."""
    main = {"stiffness": "1200 N/um", "clearance": "5 um", "raceway_diameter": "100 mm"}
    supports = {**PAIR["supports"], "main": main}
    expansion = dict.fromkeys(("carrier", "discs"), 12.6e-6)
    limit = 293.15 + 5e-6 / (0.1 * 1.1e-6)
    for resistance, steady in ((0.6, True), (2.0, False)):
        thermal = {"resistance": resistance, "capacity": 3000.0, "ambient": "20 degC"}
        made = drive(DRY, thermal, supports=supports, expansion=expansion)
        found = made.heat(crank_speed=SPEED, angles=10, workers=1)
        assert math.isnan(found.oil) != steady
        assert found.scanned[-1] == pytest.approx(limit, abs=0.3)
        if not steady:
            assert "clearance of main" in found.reason
        else:
            assert found.power == pytest.approx((found.oil - 293.15) / resistance, rel=1e-3)


def test_a_drive_that_jams_has_no_temperature():
    """Fixed pins of a 10/11 pair jam near a coefficient of 0.37."""
    sizes = {"gear_teeth": 10, "pin_circle_radius": 40e-3, "pin_radius": 4e-3, "eccentricity": 1.6e-3}
    found = drive({"flank": {"friction_coefficient": 0.9}}, THERMAL, **sizes).heat(0.1, 10.0, angles=6, workers=1)
    assert math.isnan(found.oil)
    assert "jams" in found.reason
    assert not found.time.size


def test_churning_falls_with_the_oil_s_viscosity():
    """At the input alone: D ν/ν_40 W, and the carrier's over z_c²."""
    oil = {"viscosity_40": 150e-6, "viscosity_100": 15e-6}
    for side, share in (("input_drag", 1.0), ("output_drag", 1.0 / 39**2)):
        cold, hot = (
            drive({side: {"churning": 2e-3}, "lubricant": {**oil, "temperature": kelvin}}, None)
            .losses(0.0, 10.0, angles=4, workers=1)
            .no_load_running_torque
            for kelvin in (313.15, 373.15)
        )
        assert cold == pytest.approx(2e-2 * share, rel=1e-3)
        assert hot == pytest.approx(2e-3 * share, rel=1e-3)
    with pytest.raises(edge.InputError, match="churning needs its viscosity"):
        drive({"input_drag": {"churning": 1e-3}}, None)


def test_the_range_of_a_named_friction_is_a_range_of_temperatures():
    made = drive({"flank": {"friction": "steel, grease"}}, THERMAL)
    found = made.heat(crank_speed=10.0, angles=10, workers=1)
    low, high = (
        drive({"flank": {"friction_coefficient": mu}}, THERMAL).heat(crank_speed=10.0, angles=10, workers=1).oil
        for mu in (0.04, 0.25)
    )
    assert [end.oil for end in found.ends] == pytest.approx([low, high], abs=1e-3)
    assert low < found.oil < high


def test_the_largest_temperature_is_a_limit():
    duty = [{"torque": "181 N*m", "output_speed": SPEED / 39, "share": 1.0}]
    made = drive(DRY, THERMAL)
    oil = made.heat(requirements=Requirements(duty=duty), angles=20, workers=1).oil
    for degrees, met in ((oil - ICE + 1.0, True), (oil - ICE - 1.0, False)):
        asked = Requirements(limits={"temperature": f"{degrees} degC"}, duty=duty)
        (one,) = made.judge(asked, angles=20, workers=1).verdicts
        assert one.met == met
        assert one.value == pytest.approx(oil, abs=0.01)
        assert row_of(one)[1] == f"≤ {degrees:.5g} °C"
        assert row_of(one)[4] == f"{1.0 if met else -1.0:+.4g} K"
    asked = Requirements(limits={"temperature": "90 degC"}, duty=duty)
    fast = Requirements(limits={"temperature": "90 degC"}, duty=[{**duty[0], "output_speed": SPEED / 19}])
    (away,) = squeezed(0.5).judge(fast, angles=20, workers=1).verdicts
    assert not away.met
    assert math.isinf(away.value)
    assert drive(DRY, None).judge(asked, angles=20, workers=1).not_judged == ("temperature",)
    with pytest.raises(edge.InputError, match="temperature needs speeds"):
        Requirements(limits={"temperature": "90 degC"})


@pytest.mark.parametrize(
    ("thermal", "part"),
    [
        ({"ambient": "20 degC"}, "state resistance, or area and convection"),
        ({"ambient": "20 degC", "resistance": 1.0, "area": 1.0, "convection": 5.0}, "state resistance, or area"),
        ({"ambient": "20 degC", "resistance": 1.0, "area": 1.0}, "state resistance, or area"),
        ({"ambient": "20 degC", "area": 1.0}, "state resistance, or area"),
        ({"resistance": 1.0}, "ambient is missing"),
        ({"ambient": "20 degC", "resistance": 0.0}, "resistance = 0"),
        ({"ambient": "300 degC", "resistance": 1.0}, "between -60 degC and 200 degC"),
        ({"ambient": "20 degC", "resistance": 1.0, "largest": "20 degC"}, "largest must be above ambient"),
        ({"ambient": "20 degC", "resistance": "1 K"}, "K/W"),
    ],
)
def test_impossible_heat_is_refused(thermal, part):
    with pytest.raises(edge.InputError, match=part):
        Thermal(**thermal)


def test_what_is_missing_is_named():
    with pytest.raises(edge.InputError, match=r"\[thermal\] is missing; state its resistance"):
        drive(DRY, None).heat(crank_speed=10.0)
    with pytest.raises(edge.InputError, match="no friction stated"):
        drive(None, THERMAL).heat(crank_speed=10.0)
    with pytest.raises(edge.InputError, match="give a speed above zero"):
        drive(DRY, THERMAL).heat()


def test_the_pair_s_text_holds_it():
    pair = drive(OILED, {**THERMAL, "oil_resistance": 0.05, "largest": "90 degC"}).pair
    assert parse_pair(pair.text, "pair") == pair
    assert "thermal" not in drive(OILED, None).pair.text


@pytest.mark.slow(2)
def test_the_command_prints_draws_and_judges(tmp_path):
    from cycloid_fmu.cli import app

    drive(DRY, {**THERMAL, "largest": "40 degC"}).write(tmp_path / "pair.toml")
    options = ["losses", str(tmp_path / "pair.toml"), "--crank-speed", "1500 rpm", "--angles", "20"]
    shown = CliRunner().invoke(app, [*options, "--plot", str(tmp_path / "l.png"), "--json"])
    assert shown.exit_code == edge.NOT_MET, shown.output
    (thermal,) = json.loads(shown.stdout)["thermal"]
    assert thermal["oil"] - 293.15 == pytest.approx(0.8 * thermal["power"], rel=1e-3)
    assert (tmp_path / "l-heat.png").stat().st_size > 20000
    duty = 'format = "cycloid-requirements/1"\n[[duty]]\ntorque = "20 N*m"\noutput_speed = "5 rpm"\nshare = 1.0\n'
    (tmp_path / "r.toml").write_text(duty)
    shown = CliRunner().invoke(app, [*options, "--duty", str(tmp_path / "r.toml")])
    assert shown.exit_code == 0, shown.output
    assert "20 N·m, 195 rpm" in shown.output
    drive(DRY, None).write(tmp_path / "pair.toml")
    with pytest.raises(edge.InputError, match=r"pair.toml: \[thermal\] is missing"):
        CliRunner().invoke(app, [*options, "--duty", str(tmp_path / "r.toml")], catch_exceptions=False)
