"""Losses of an FMU from [losses]: as the balance has them, in both directions of power, warm and cold; and its heat."""

import dataclasses
import json
import math
import zipfile

import fmpy
import numpy as np
import pytest
from clockworks import Drive
from common import EXAMPLES, PAIR
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.cli import app
from cycloid_fmu.fmu.build import completed
from cycloid_fmu.fmu.model_losses import model_losses, nearest_line, table_torque, with_model_losses
from cycloid_fmu.fmu.variables import LOSSLESS
from cycloid_fmu.losses.heat import at_oil_temperature
from cycloid_fmu.losses.solver import sun_rate

CASES = EXAMPLES.parent / "tests" / "data" / "losses-cases"
RATIO, RATED, FAST = 39.0, 181.0, 50.0 * math.pi  # 1500 rpm
PER_TURN = 37


@pytest.fixture(scope="module")
def drive():
    """Friction at rest and at speed, preload, viscous bearings, drags of both shafts, and a heat capacity."""
    return cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml")


@pytest.fixture(scope="module")
def built(drive, tmp_path_factory):
    """The drive, its interface with losses, what was computed, and its FMUs by interface and version."""
    interface, found = with_model_losses(cy.Interface(), drive)
    paths = {}
    for kind, version in (("kinematic", "2.0"), ("compliant", "3.0")):
        paths[kind] = tmp_path_factory.mktemp("fmu") / f"{kind}.fmu"
        made = dataclasses.replace(interface, kind=kind, output_inertia=2.0 if kind == "compliant" else 0.0)
        drive.build_fmu(paths[kind], made, fmi_version=version)
    return interface, found, paths


def turning(path, speed, torque, temperature, turns=2):
    """Outputs of an FMU over the last of some crank turns at constant speed, torque and oil temperature."""
    step = 2.0 * math.pi / abs(speed) / PER_TURN
    time = np.arange(turns * PER_TURN + 1) * step
    inputs = np.zeros(time.size, [(n, "f8") for n in ("time", "flange_a.phi", "flange_a.w", "flange_b.tau")])
    inputs["time"], inputs["flange_a.phi"], inputs["flange_a.w"], inputs["flange_b.tau"] = (
        time,
        speed * time,
        speed,
        torque,
    )
    names = ["flange_a.tau", "power_loss", "heat_port.T", "flange_b.w"]
    run = fmpy.simulate_fmu(
        str(path),
        stop_time=time[-1],
        step_size=step,
        output_interval=step,
        input=inputs,
        output=names,
        start_values={"temperature_start": temperature, "heat_capacity": 1e12},  # which holds the temperature
    )
    return {name: run[name][-PER_TURN:] for name in names}


@pytest.mark.parametrize("kelvin", [293.15, pytest.param(320.0, marks=pytest.mark.slow(1)), 365.0])
@pytest.mark.parametrize("rpm", [30.0, 1500.0])
def test_the_fmu_needs_the_torque_of_the_balance_within_what_the_build_states(drive, built, kelvin, rpm):
    _, found, paths = built
    assert found.mean_deviation < 5e-3
    speed, loads = rpm * math.pi / 30.0, [18.1, RATED]
    warm = cy.Drive(at_oil_temperature(drive, kelvin).pair)
    figures = warm.losses(loads, speed, angles=PER_TURN, workers=1)
    for direction, sweep in figures.sweeps.items():
        for k, load in enumerate(loads):
            run, of_load = turning(paths["kinematic"], direction * speed, load, kelvin), load / RATIO
            off = run["flange_a.tau"].mean() - sweep.input_torque[k].mean()
            assert abs(off) <= 1.1 * found.mean_deviation * of_load, (direction, load)
            case = next(c for c in figures.cases if (c.torque, c.direction) == (load, direction))
            assert run["power_loss"].mean() == pytest.approx(
                case.heat, abs=2.0 * found.mean_deviation * of_load * speed
            )
            # What enters is what leaves and what is lost.
            power = (run["flange_a.tau"] * direction * speed + load * run["flange_b.w"]).mean()
            assert run["power_loss"].mean() == pytest.approx(power, abs=2e-3 * of_load * speed)


@pytest.fixture(scope="module", params=["crank", pytest.param("sun", marks=pytest.mark.slow(8))])
def driven(request, drive, built):
    """A drive by its crank, and an RV reducer whose friction falls with speed; with the interfaces and their losses."""
    if request.param == "crank":
        return drive, built[0]
    reducer = cy.read_drive(CASES / "rv-first-stage-seats.toml")
    return reducer, with_model_losses(cy.Interface(driven="sun"), reducer)[0]


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("share", [1.0, -0.5])
def test_at_single_crank_angles_it_loses_what_the_balance_loses(driven, share, direction):
    """Over the whole output turn, at angles, a load and a speed between those that its ripple was made at.

    Without it the differences are three times as large.
    """
    drive, interface = driven
    smooth, rate, turns = dataclasses.replace(interface, loss_ripple=None), sun_rate(drive), drive.pair.gear_teeth
    load = share * drive.pair.rated_torque
    sweep = drive.losses([load], FAST / abs(rate), angles=PER_TURN, turns=turns, workers=1).sweeps[direction]
    off = []
    for stated in (interface, smooth):
        clock, torque = Drive(drive, completed(stated, drive)), []
        clock.torque, clock.crank_speed = load, direction * math.copysign(FAST, rate)
        if drive.pair.thermal is not None:
            clock.temperature_start = interface.lubricant.temperature
        angles = np.linspace(0.0, 2.0 * math.pi * turns, PER_TURN, endpoint=False)[::direction]
        for angle in (angles[0] - 0.1 * direction, *angles):
            clock.crank_angle = rate * angle
            clock.advance()
            torque.append(clock.crank_torque)
        off.append(np.std(np.array(torque[1:])[::direction] - sweep.input_torque[0]))
    assert off[0] < 0.34 * off[1]


def test_inside_inertias_the_losses_are_the_same(built):
    _, found, paths = built
    still, moved = (turning(paths[kind], FAST, -RATED, 320.0, turns=4) for kind in ("kinematic", "compliant"))
    off = abs(moved["flange_a.tau"].mean() - still["flange_a.tau"].mean())
    assert off <= 2.0 * found.mean_deviation * RATED / RATIO


def test_the_fmu_warms_up_as_the_drive_does(drive, built):
    """In steps of some ten seconds, at ever other crank angles; power and viscosity follow each other to the end."""
    heat = drive.heat(RATED, FAST, angles=40, workers=1)
    rise = heat.oil - heat.thermal.ambient
    interface, _, _ = built
    clock = Drive(drive, completed(interface, drive))
    clock.crank_speed, clock.torque = FAST, RATED
    times, kelvins = [0.0], [293.15]
    clock.advance()
    while times[-1] < heat.time_to(0.95):
        clock.crank_angle = FAST * times[-1]  # in steps of many turns: friction slides
        clock.advance(9.97)
        times.append(times[-1] + 9.97)
        kelvins.append(clock.clockwork.get("heat_port.T"))
    for share in (0.632, 0.95):
        reached = np.interp(heat.time_to(share), times, kelvins)
        assert reached == pytest.approx(heat.thermal.ambient + share * rise, abs=0.015 * rise)


def test_a_dry_heat_capacity_is_one_exponential_whatever_the_step():
    """C dT/dt = P - (T - T_0)/R with constant power: T - T_0 = R P (1 - exp(-t/RC)), and the port's heat adds to P."""
    pair = cy.Pair(
        gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    )
    thermal = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair.thermal
    interface = cy.Interface(losses=((0.0, 1.0, 1.0, 0.2, 0.2),), thermal=thermal)
    for steps in (1, 40):
        clock = Drive(cy.Drive(pair), completed(interface, cy.Drive(pair)))
        clock.torque, clock.crank_speed = 50.0, 100.0
        clock.clockwork.set("heat_port.Q_flow", 5.0)
        clock.advance()
        for k in range(steps):
            clock.crank_angle = 0.3 + 0.1 * k  # so that its friction slides
            clock.advance(0.0)
            clock.advance(1200.0 / steps)
        power, resistance = clock.clockwork.get("power_loss"), thermal.whole
        assert power == pytest.approx(0.2 * 100.0, rel=1e-9)
        rise = resistance * (power + 5.0) * -math.expm1(-1200.0 / (resistance * thermal.capacity))
        assert clock.clockwork.get("heat_port.T") - thermal.ambient == pytest.approx(rise, rel=1e-6)


def test_a_state_holds_the_temperature_and_a_refused_step_changes_nothing(drive, built):
    interface, _, _ = built
    clock = Drive(drive, completed(interface, drive))
    clock.crank_speed, clock.torque = FAST, RATED
    clock.advance(100.0)
    state, before = clock.state(), clock.clockwork.get("heat_port.T")
    clock.advance(100.0)
    after = clock.clockwork.get("heat_port.T")
    clock.clockwork.set("heat_port.Q_flow", -1e9)
    with pytest.raises(ValueError, match=r"heat_port\.T = .* it must lie between 173\.15 and 573\.15 K"):
        clock.advance(100.0)
    assert clock.clockwork.get("heat_port.T") == after > before > 293.15
    clock.restore(state)
    assert clock.clockwork.get("heat_port.T") == before
    clock.advance(100.0)
    assert clock.clockwork.get("heat_port.T") == after


def test_the_heat_port_is_a_terminal_of_modelica_s_kind(built):
    _, _, paths = built
    with zipfile.ZipFile(paths["compliant"]) as archive:
        text = archive.read("terminalsAndIcons/terminalsAndIcons.xml").decode()
    assert 'terminalKind="Modelica.Thermal.HeatTransfer.Interfaces.HeatPort_a"' in text
    assert 'variableName="heat_port.Q_flow" memberName="Q_flow" variableKind="inflow"' in text


def test_without_a_capacity_the_temperature_of_the_oil_is_an_input(drive, built):
    """At the same viscosity times speed the losses are the same: the bearings know nothing else."""
    interface, _, _ = built
    oil = interface.lubricant
    thinning = oil.replace(temperature=350.0).viscosity / oil.viscosity

    def lost(kelvin, speed):
        clock = Drive(drive, interface)  # not completed: no heat capacity
        clock.torque, clock.crank_speed = RATED, speed
        clock.clockwork.set("temperature", kelvin)
        for angle in (0.0, 1.0, 2.0):
            clock.crank_angle = angle
            clock.advance(0.1)
        return clock.crank_torque

    assert lost(350.0, 100.0) == pytest.approx(lost(oil.temperature, 100.0 * thinning), rel=1e-9)
    assert lost(350.0, 100.0) < lost(oil.temperature, 100.0)


def test_the_nearest_line_is_one_that_equal_differences_touch():
    """Chebyshev: of three points in a row the differences are equal with alternating signs; a line fits itself."""
    load = np.array([0.1, 0.4, 1.0])
    slope, constant = nearest_line(load, 0.07 * load + 0.02)
    assert (slope, constant) == pytest.approx((0.07, 0.02))
    off = (
        0.02 + 0.05 * load + 0.03 * load**2 - np.polyval(nearest_line(load, 0.02 + 0.05 * load + 0.03 * load**2), load)
    ) / load
    assert off[0] == pytest.approx(-off[1]) == pytest.approx(off[2])
    assert off[0] != pytest.approx(0.0, abs=1e-6)


def test_the_stated_table_is_that_of_the_fmu(drive):
    """`table_torque`, by which the build judges, against the C model, where either flange drives."""
    rows = ((0.0, 0.9, 0.85, 0.02, 0.03), (200.0, 0.95, 0.9, 0.1, 0.2))
    clock = Drive(drive, cy.Interface(losses=rows))
    for direction, torque in ((1.0, 150.0), (1.0, -150.0), (-1.0, 20.0), (-1.0, -0.5)):
        free = Drive(drive, cy.Interface())
        for each in (clock, free):
            each.forget_history()
            each.torque, each.crank_speed, each.crank_angle = torque, direction * 70.0, direction
            each.advance(0.1)
            each.crank_angle = 2.0 * direction
            each.advance(0.1)
        asked = np.array([direction * free.crank_torque])
        assert direction * clock.crank_torque == pytest.approx(float(table_torque(rows, 70.0, asked)[0]), rel=1e-9)


# --- what is used, and what is refused ---


def test_measured_losses_and_friction_win_and_a_sentence_says_so(tmp_path):
    pair = EXAMPLES / "drive-39-40-bearings.toml"
    table, friction = tmp_path / "losses.csv", tmp_path / "friction.toml"
    table.write_text("speed [rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]\n0,0.8,0.7,0.1,0.1\n")
    friction.write_text('format = "cycloid-friction/1"\n[friction.output]\ncoulomb = "7 N*m"\n')
    for option, file, losses, coulomb in (
        ("--losses", table, ((0.0, 0.8, 0.7, 0.1, 0.1),), 0.0),
        ("--friction", friction, LOSSLESS, 7.0),
    ):
        out = tmp_path / "drive.fmu"
        done = CliRunner().invoke(app, ["build", str(pair), option, str(file), "-o", str(out)])
        assert done.exit_code == 0, done.output
        assert f"[losses] are not used: {file} states" in done.output.replace("\n", " ")
        with zipfile.ZipFile(out) as archive:
            stated = json.loads(archive.read("resources/pair.json"))["interface"]
        assert stated["losses"] == [list(row) for row in losses]
        assert stated["output_friction"]["coulomb"] == coulomb
        assert "lubricant" not in stated


def test_without_losses_an_fmu_has_none(drive):
    bare = cy.Drive(drive.pair.replace(losses=None, thermal=None))
    interface = completed("kinematic", bare)
    assert (interface.losses, interface.lubricant, interface.thermal) == (LOSSLESS, None, None)
    assert not interface.warms


def test_friction_without_bearings_is_not_used_and_a_sentence_says_so(tmp_path):
    """As wear needs it: the friction of the flanks alone."""
    pair, out = tmp_path / "pair.toml", tmp_path / "drive.fmu"
    pair.write_text(PAIR + "[losses.flank]\nfriction_coefficient = 0.06\n")
    done = CliRunner().invoke(app, ["build", str(pair), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert "[losses] are not used: there are no [supports]" in done.output.replace("\n", " ")
    assert fmpy.simulate_fmu(str(out), stop_time=0.01, output=["power_loss"])["power_loss"][-1] == 0.0


def test_a_drive_that_locks_itself_or_jams_is_refused_in_a_sentence():
    locking = cy.read_drive(CASES / "printed-self-locking.toml")
    with pytest.raises(edge.InputError, match=r"the drive locks itself: .* which a loss table can't state"):
        model_losses(locking)
    losses = locking.pair.losses
    stuck = locking.pair.replace(losses=losses.replace(flank=losses.flank.replace(friction_coefficient=0.9)))
    with pytest.raises(edge.InputError, match=r"\[losses\]: the drive (jams|locks)"):
        model_losses(cy.Drive(stuck))
