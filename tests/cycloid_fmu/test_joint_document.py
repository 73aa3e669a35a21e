"""The joint document: of a drive, of a fit's posterior and of tolerances, and of measured and stated numbers."""

import json
import math

import joint_cases
import numpy as np
import pytest
from common import ARCSEC, EXAMPLES
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.cli import app
from cycloid_fmu.fmu.run import simulate
from cycloid_fmu.joint import joint_drive
from cycloid_fmu.joint.document import read_joint
from cycloid_fmu.joint.of_parts import Settings, joint_of

AS_MADE = cy.read_drive(EXAMPLES / "drive-39-40-as-made.toml")
ROTOR = {"rotor_inertia": "1e-4 kg*m^2"}
STATED = """format = "cycloid-joint-figures/1"
[joint]
ratio = 15.0
rotor_inertia = { value = "5e-5 kg*m^2", interval = ["4e-5 kg*m^2", "6e-5 kg*m^2"], origin = "measured" }
rated_torque = "20 N*m"
play = { value = "1.2 deg", interval = ["1.1 deg", "1.3 deg"], origin = "measured" }
stiffness = [{ torque = "0 N*m", windup = "0 rad" }, { torque = "20 N*m", windup = "60 mrad" }]
friction.motor.coulomb = "0.01 N*m"
"""


@pytest.fixture(scope="module")
def joint():
    return AS_MADE.joint(stated=ROTOR, workers=1)


def orders(values, name, count=5):
    return [[values[f"{name}.{k}.{member}"] for member in ("order", "amplitude", "phase")] for k in range(count)]


def test_play_and_windup_are_those_of_the_reference(joint):
    """They were computed over 949 angles, the wind-up here over fewer: within 0.3 % of the windup with the play."""
    exact, values = joint_cases.read("lumped-39-40-as-made")["asmade"], joint.values
    assert values["play"] == pytest.approx(2.0 * exact["gap"], rel=1e-3)
    points = np.array(joint_drive.members(values, "stiffness"))
    for torque, half in zip(exact["torque"], exact["half"], strict=True):
        if torque in (9.0, 18.0, 90.0, 181.0):
            windup = np.interp(torque, *points.T)
            assert exact["gap"] + windup == pytest.approx(half, rel=3e-3)


def test_the_largest_orders_are_those_of_the_reference(joint):
    exact = joint_cases.read("lumped-39-40-as-made")["asmade"]["te"]
    by_order = {order: (size, phase) for order, size, phase in exact["mid_18"]}
    for order, size, phase in orders(joint.values, "te_orders"):
        assert size == pytest.approx(by_order[order][0], rel=2e-3)
        # The reference counts the output's angle positive, whose ratio to the motor's is negative here.
        assert math.cos(phase + by_order[order][1]) == pytest.approx(-1.0, abs=1e-5)
    by_order = {order: size for order, size, _ in exact["half_18"]}
    assert {order for order, _, _ in orders(joint.values, "play_orders")} == set(list(by_order)[:5])
    for order, size, _ in orders(joint.values, "play_orders"):
        assert 0.5 * size == pytest.approx(by_order[order], rel=0.02)


def test_the_orders_give_the_transmission_error_between_the_angles_they_are_from(joint):
    """At the motor's angle, with sign and phase of the document, to what it says it leaves out."""
    angle, torque = np.linspace(3.0, 60.0, 41), joint.source["transmission_error_torque"]
    error = AS_MADE.analyze([torque, -torque], crank_angle=angle).transmission_error.values
    for name, exact in (("te_orders", 0.5 * (error[0] + error[1])), ("play_orders", error[0] - error[1])):
        given = sum(a * np.sin(k * angle / AS_MADE.ratio + p) for k, a, p in orders(joint.values, name))
        off = np.std(exact - exact.mean() - given)
        what = {"te_orders": "transmission error", "play_orders": "play"}[name]
        (text,) = (one for one in joint.not_represented if one.startswith(f"Other orders of the {what}"))
        assert off / ARCSEC == pytest.approx(float(text.partition(": ")[2].split(" ")[0]), rel=0.35)
        assert off < 0.25 * np.std(exact)


def test_each_number_has_an_origin_or_a_reason(joint):
    document = joint.document
    for name, number in joint_drive.flat(document).items():
        if number["value"] is None:
            assert number["reason"]
            assert "interval" not in number
        else:
            assert number["origin"] in joint_drive.ORIGINS, name
    assert document["friction"]["motor"]["coulomb"]["reason"] == "the pair states no [losses]"
    assert document["ratio"] == {"value": -39.0, "interval": None, "origin": "drawn"}
    assert document["rotor_inertia"]["origin"] == "stated"
    assert document["draws"] is None


@pytest.mark.slow(20)
def test_friction_of_a_drive_on_bearings_is_that_of_its_losses():
    """Torque to start and efficiency of `losses`, from the document's numbers."""
    drive = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml")
    joint = drive.joint(stated=ROTOR, angles=53)
    values = joint.values
    figures = drive.losses(crank_speed=100.0, angles=37)
    by_mode = {case.mode: case.efficiency for case in figures.cases}
    load = drive.pair.rated_torque / 39.0
    motor, output = values["friction.motor.coulomb"], values["friction.output.coulomb"] / 39.0
    running = motor + 100.0 * values["friction.motor.viscous"] + output / values["friction.motor.efficiency_driving"]
    driving = load / (load / values["friction.motor.efficiency_driving"] + running)
    assert driving == pytest.approx(by_mode["driving"], abs=0.005)
    assert joint.numbers["friction.motor.coulomb"]["origin"] == "predicted"
    assert values["temperature"] == pytest.approx(drive.pair.losses.lubricant.temperature)


@pytest.fixture(scope="module")
def fitted():
    """A drive with a covariance of two errors that go together."""
    deviation = np.array([0.5e-6, 1e-6])
    covariance = np.outer(deviation, deviation) * np.array([[1.0, 0.9], [0.9, 1.0]])
    surface = AS_MADE.surface.replace(covariance=covariance, covariance_of=("pin_radius", "eccentricity"))
    return cy.Drive(AS_MADE.pair, surface)


@pytest.mark.slow(3)
def test_a_fit_gives_intervals_and_draws_and_the_same_seed_the_same_bytes(fitted):
    one, other = (fitted.joint(stated=ROTOR, draws=40, seed=3, angles=211, workers=1) for _ in range(2))
    assert one.draws_text() == other.draws_text()
    assert one.draws_text() != fitted.joint(stated=ROTOR, draws=40, seed=4, angles=211, workers=1).draws_text()
    assert one.rows[0] == {name: one.values[name] for name in one.rows[0]}
    assert len(one.rows) == 41
    for name in ("play", "stiffness.6.windup", "te_orders.0.amplitude"):
        number, drawn = one.numbers[name], np.array([row[name] for row in one.rows[1:]])
        low, high = number["interval"]
        assert number["origin"] == "identified"
        assert (low, high) == pytest.approx(np.percentile(drawn, [2.5, 97.5]), rel=1e-9)
        assert low <= number["value"] <= high
        assert drawn.mean() == pytest.approx(number["value"], abs=0.6 * (high - low))
    assert not any("draws" in text for text in one.not_represented)


def test_draws_that_interfere_are_left_out_and_counted():
    surface = AS_MADE.surface.replace(covariance=np.array([[2.5e-5**2]]), covariance_of=("pin_radius",))
    joint = cy.Drive(AS_MADE.pair, surface).joint(draws=20, angles=211, workers=1)
    (text,) = (one for one in joint.not_represented if "draws" in one)
    assert text == f"{21 - len(joint.rows)} of 20 draws: their teeth interfere."
    assert 2 < len(joint.rows) < 21


def test_tolerances_give_draws_of_a_drawn_drive():
    tolerances = cy.Tolerances(pin_radius={"tolerance": "2 um"})
    joint = cy.Drive(AS_MADE.pair.nominal).joint(tolerances=tolerances, draws=5, angles=211, workers=1)
    assert len(joint.rows) == 6
    assert joint.numbers["play"]["origin"] == "drawn"
    assert joint.numbers["play"]["interval"] is not None
    assert joint.numbers["ratio"]["interval"] is None


def test_draws_without_a_covariance_are_refused():
    with pytest.raises(edge.InputError, match="draws = 5: the drive has no covariance of a fit"):
        AS_MADE.joint(draws=5, angles=211)


def test_stated_and_measured_numbers_alone_make_a_joint(tmp_path):
    (tmp_path / "printed.toml").write_text(STATED)
    joint = joint_of(None, [tmp_path / "printed.toml"], settings=Settings(draws=200, seed=1))
    assert joint.values["play"] == pytest.approx(math.radians(1.2))
    assert joint.numbers["play"]["interval"] == pytest.approx([math.radians(1.1), math.radians(1.3)])
    assert joint.numbers["play"]["origin"] == "measured"
    drawn = np.array([row["play"] for row in joint.rows[1:]])
    assert np.percentile(drawn, [2.5, 97.5]) == pytest.approx(joint.numbers["play"]["interval"], rel=0.02)
    assert set(joint.rows[0]) == {"rotor_inertia", "play"}
    joint.write(tmp_path / "joint.json")
    again = read_joint(tmp_path / "joint.json")
    assert again.numbers == joint.numbers
    assert again.rows == joint.rows


def test_figures_of_a_loop_and_of_a_turning_drive_replace_the_drive_s(tmp_path):
    unit = {"definition": "", "unit": ""}
    figures = {
        "format": "cycloid-figures/1",
        "backlash": {"value": 4e-4, "uncertainty": 1e-5, **unit},
        "torsional_stiffness": {"value": 1e5, "uncertainty": 2e3, **unit},
        "rated_torque": 181.0,
    }
    friction = {
        "format": "cycloid-friction-fit/1",
        "coulomb": {"value": 3.0, "uncertainty": 0.1, **unit},
        "friction_per_load": {"value": 0.1, "uncertainty": 0.02, **unit},
    }
    for name, content in (("loop", figures), ("friction", friction)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    files = [tmp_path / "loop.json", tmp_path / "friction.json"]
    joint = AS_MADE.joint(files=files, angles=211, workers=1)
    assert joint.numbers["play"]["origin"] == "measured"
    assert joint.numbers["play"]["interval"] == pytest.approx([3.9e-4, 4.1e-4])
    assert joint_drive.members(joint.values, "stiffness") == [(0.0, 0.0), (181.0, pytest.approx(181.0 / 1e5))]
    # The torque of the teeth without a load is the friction itself: 1 - 0.1 of it.
    assert joint.values["friction.output.coulomb"] == pytest.approx(2.7)
    assert joint.values["friction.output.load_share"] == pytest.approx(0.1)
    assert "measured at the output as a whole" in joint.numbers["friction.motor.coulomb"]["reason"]
    assert joint.values["te_orders.0.order"] == 39.0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ratio = 0.5", "ratio = 0.5: a reducer has at least 1 motor turn"),
        ('rotor_inertia = "-1 kg*m^2"', "rotor_inertia = -1.0: it must be above 0"),
        ('play = "-1 deg"', "it must not be below 0"),
        ('play = { interval = ["1 deg", "2 deg"] }', "play has an interval without its value"),
        ('play = "1 N*m"', 'play = "1 N*m": the unit'),
        ('ply = "1 deg"', "a joint has no number ply; did you mean"),
        ("friction.motor.efficiency_back_driving = -0.1", "self-locking"),
        ("friction.motor.efficiency_driving = 1.2", "an efficiency lies above 0 and not above 1"),
        (
            'stiffness = [{ torque = "0 N*m", windup = "0 rad" }, { torque = "0 N*m", windup = "1 mrad" }]',
            "torque and windup increase strictly from 0, 0",
        ),
    ],
)
def test_bad_numbers_are_one_sentence_and_no_traceback(tmp_path, line, message):
    name = line.split(" ")[0].split(".")[-1]
    kept = [one for one in STATED.split("\n") if not one.startswith((f"{name} =", f"friction.motor.{name}"))]
    (tmp_path / "bad.toml").write_text("\n".join([*kept, line]))
    done = CliRunner().invoke(app, ["joint", "--figures", str(tmp_path / "bad.toml"), "-o", str(tmp_path / "j.json")])
    assert isinstance(done.exception, edge.InputError)
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)
    assert not (tmp_path / "j.json").exists()


def test_the_command_writes_document_draws_and_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "printed.toml").write_text(STATED)
    words = "joint --figures printed.toml -o joint.json --draws 3 --mjcf arm.xml --isaac arm.py --bam m5.json"
    done = CliRunner().invoke(app, [*words.split(), "--urdf", "arm.urdf", "--drake", "drake.urdf", "--runtime", "run"])
    assert done.exit_code == 0, done.output
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    files = {"joint.json", "draws.csv", "arm.xml", "arm-play.xml", "arm_rows.py", "arm.py", "m5.json"}
    assert written >= files | {"arm.urdf", "drake.urdf", "run/joint.json", "run/draws.csv", "run/joint_drive.c"}
    assert (tmp_path / "draws.csv").read_text().count("\n") == 5


@pytest.mark.slow(60)
def test_the_lumped_joint_turns_as_the_drive_s_fmu(tmp_path):
    """Arm minus motor/ratio over 0.6 s, on both flanks: below 8 arcsec (rms), where a rigid joint has 30."""
    rotor, arm, h = 1e-4, 2.0, 1e-3
    joint = AS_MADE.joint(stated={**ROTOR, "mesh_damping": "17 N*m*s/rad"})
    interface = cy.Interface("compliant", output_inertia=arm, crank_inertia=rotor, mesh_damping=17.0)
    AS_MADE.build_fmu(tmp_path / "drive.fmu", interface, native=True)
    time = h * np.arange(601)
    torque = -1.2 * np.sin(2.0 * np.pi * time / 0.6)
    load = -20.0 * np.cos(2.0 * np.pi * 1.7 * time) * np.minimum(time / 0.02, 1.0)
    outputs = ("flange_a.phi", "flange_b.phi")
    found = simulate(tmp_path / "drive.fmu", {"flange_a.tau": torque, "flange_b.tau": load}, outputs, time)
    exact = found["flange_b.phi"] - found["flange_a.phi"] / AS_MADE.ratio
    drive, phi, w, deviation = joint_drive.JointDrive(joint.document, h, 0.0), 0.0, 0.0, [0.0]
    for own, other in zip(torque[1:], load[1:], strict=True):
        push, following = drive.step((own, 0.0, 0.0, 0.0, 0.0), phi, w, arm, other)
        w, phi = w + h * (push + other) / arm, following
        deviation.append(phi - drive.motor_angle / AS_MADE.ratio)
    lumped, rigid = (np.sqrt(np.mean(off**2)) / ARCSEC for off in (exact - deviation, exact))
    assert lumped < 8.0
    assert rigid > 30.0
    assert abs(found["flange_a.phi"]).max() > 50.0
