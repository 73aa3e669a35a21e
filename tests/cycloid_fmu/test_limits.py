"""Limits and verdicts: margins, the worst place, lives over a duty, sliding, and checks of files."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from common import EXAMPLES, WEAR_PAIR, make_pair
from hypothesis import given
from hypothesis import strategies as st

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance
from cycloid_fmu.contact.hertz import half_width
from cycloid_fmu.desk.view import look, open_desk
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.chain import with_chain
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.studies import limits as asked
from cycloid_fmu.studies.design import DesignTask, search
from cycloid_fmu.studies.tolerance import Study, surface_of
from cycloid_fmu.studies.yields import conduct
from cycloid_fmu.studies.yields import judged as judged_of
from cycloid_fmu.supports.figures import BearingLoad, lives_over_duty
from cycloid_fmu.wear.friction import sliding_of
from cycloid_fmu.wear.law import Load, WearLaw
from cycloid_fmu.wear.progress import wear_model, wear_rate

HEAD = f'format = "{asked.FORMAT}"\n'
ROW = '[[duty]]\ntorque = "1 N*m"\noutput_speed = "{}"\nshare = {}\n'


@given(
    st.sampled_from([name for name in asked.SHOWN if name != "self_locking"]),
    st.floats(1e-6, 1e6),
    st.floats(1e-6, 1e6),
)
def test_a_limit_is_met_up_to_itself_and_the_margin_says_by_how_much(name, value, limit):
    one = asked.verdict(name, value, limit)
    kept = value >= limit if name in asked.LOWER else value <= limit
    assert one.met == kept
    assert abs(one.margin) == abs(value - limit)
    assert (one.margin >= 0.0) == kept
    assert asked.verdict(name, limit, limit).met
    assert ("not met" in asked.row_of(one)) != kept


def test_self_locking_is_required_or_excluded():
    for value, limit in itertools.product((0.0, 1.0), repeat=2):
        one = asked.verdict("self_locking", value, limit)
        assert one.met == (value == limit)
        assert asked.row_of(one)[1:3] == ["yes" if limit else "no", "yes" if value else "no"]


@given(
    st.sampled_from(["angular_transmission_error", "backlash", "lost_motion"]),
    st.decimals(0, 600, places=3),
    st.sampled_from(["arcsec", "arcmin", "mrad"]),
)
def test_a_limit_in_a_file_is_the_limit_in_a_tolerance_file_and_in_python(name, number, unit):
    text = f'[limits]\n{name} = "{number} {unit}"\n'
    read = asked.parse_requirements(HEAD + text, "r.toml").limits
    assert read.of_study == cy.Tolerances(limits={name: f"{number} {unit}"}).limits
    assert read.stated() == {name: edge.parse_quantity(f"{number} {unit}", "rad")}


def test_the_worst_angle_load_and_pin_are_those_of_a_plain_search():
    drive = cy.Drive(make_pair(discs=2)).replace({"pin_radial": {1: ("4 um", "40 deg")}}, isometric="5 um")
    data = drive.analyze([120.0, -60.0], angles=30)
    every = asked.Limits(
        angular_transmission_error=1.0,
        backlash=1.0,
        interference=1.0,
        max_contact_pressure=1.0,
        static_safety=1.0,
        torsional_stiffness=1.0,
    )
    found = {one.figure: one for one in asked.judge(every, drive.pair, data)}
    assert set(found) == set(every.stated())
    largest, where = -1.0, None
    pressure = data.pin_pressure.values
    for k, torque in enumerate(data.torque.values):
        for n, angle in enumerate(data.crank_angle.values):
            for disc in range(2):
                for pin in range(drive.pair.pins):
                    if pressure[k, n, disc, pin] > largest:
                        largest = pressure[k, n, disc, pin]
                        where = {"torque": torque, "crank_angle": angle, "disc": disc, "pin": pin}
    assert found["max_contact_pressure"].value == largest
    assert found["max_contact_pressure"].where == found["static_safety"].where == where
    one = found["angular_transmission_error"]
    error = data.transmission_error.sel(torque=one.where["torque"])
    ends = [float(error.sel(crank_angle=one.where[n])) for n in ("crank_angle", "crank_angle_of_smallest")]
    assert one.value == ends[0] - ends[1] == max(float(e.max() - e.min()) for e in data.transmission_error)
    soft = found["torsional_stiffness"]
    assert soft.value == float(data.torsional_stiffness.min())
    assert soft.value == float(data.torsional_stiffness.sel(**soft.where))
    play = found["backlash"]
    assert play.value == float(data.backlash.max()) == float(data.backlash.sel(**play.where)[0])


@given(st.floats(10.0, 5e4), st.floats(-300.0, 300.0), st.floats(1e-3, 10e-3))
def test_static_safety_is_the_factor_on_the_load_that_makes_the_limit(force, curvature, radius):
    """Hertz's pressure 2F/(πab) at S_0 times the force is the pressure limit."""
    pair = make_pair()

    def pressure(load):
        return 2.0 * load / (math.pi * half_width(load, curvature, radius, 0.01, 4.4e-12, 4.4e-12) * 0.01)

    for limit, stated in ((4e9, pair), (1.2e9, pair.replace(pressure_limit="1200 MPa"))):
        safety = asked.static_safety(stated, pressure(force))
        assert pressure(safety * force) == pytest.approx(limit, rel=1e-9)


@pytest.mark.parametrize("modification", [{}, {"isometric": "40 um", "offset": "-60 um"}, {"isometric": "-300 um"}])
def test_smallest_curvature_radius_is_that_of_circles_through_three_points(modification):
    pair = make_pair().replace(**modification)
    alpha = np.linspace(0.0, 2.0 * np.pi / pair.gear_teeth, 40001)
    x, y = flank_points(pair, alpha)
    # Circumscribed circle of each three neighbours by Heron; > 0 where the flank turns left, which is convex.
    a, b, c = x[:-2] + 1j * y[:-2], x[1:-1] + 1j * y[1:-1], x[2:] + 1j * y[2:]
    area = 0.5 * ((b - a).conj() * (c - a)).imag
    radius = np.abs(b - a) * np.abs(c - b) * np.abs(c - a) / (4.0 * area)
    smallest = min(radius.min(where=radius > 0.0, initial=math.inf), math.inf)
    assert asked.flank_curvature_radius(pair) == pytest.approx(smallest, rel=1e-4)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('[limits]\nbacklsh = "1 arcmin"', "[limits] backlsh is not a known key; did you mean backlash?"),
        ('[limits]\nbearing_life = "6000"', '[limits] bearing_life = "6000": write one number'),
        ("[limits]\nstatic_safety = -1", "[limits] static_safety = -1: it should be greater than 0."),
        ('[limits]\nbacklash = "-1 arcmin"', '[limits] backlash = "-1 arcmin": a limit must not be below zero'),
        ('[limits]\nbearing_life = "9 h"', "[limits] bearing_life needs speeds; state [[duty]]"),
        ('[limits]\nsliding_speed = "1 m/s"\n' + ROW.format("0 rpm", "1.0"), "[limits] sliding_speed needs speeds"),
        (ROW.format("3 rpm", 0.4), "[[duty]] share adds up to 0.4 over the rows; it must add up to 1"),
        (ROW.format("-3 rpm", "1.0"), 'duty[0].output_speed = "-3 rpm": it should be greater than or equal to 0.'),
        (
            "friction_coefficient = 0.06\n" + ROW.format("3 rpm", "1.0"),
            "r.toml: friction_coefficient is not known here; friction is the drive's: state [losses.flank] "
            "friction_coefficient in the pair file.",
        ),
    ],
)
def test_what_can_t_be_asked_is_refused_in_a_sentence(text, sentence):
    with pytest.raises(edge.InputError) as problem:
        asked.parse_requirements(HEAD + text, "r.toml")
    said = str(problem.value)
    assert said.startswith("r.toml: ")
    assert sentence in said
    assert "\n" not in said


def test_the_example_asks_for_every_limit_that_needs_no_named_materials():
    read = asked.read_requirements(EXAMPLES / "requirements.toml")
    strength = {"pin_safety", "output_pin_safety", "disc_safety", "fatigue_safety"}
    assert set(read.limits.stated()) | strength == set(asked.Limits.model_fields) == set(asked.SHOWN)
    assert all(field.name in asked.Verdict.__doc__ for field in dataclasses.fields(asked.Verdict))


def test_life_over_a_duty_is_iso_281_s_mean_load():
    """Palmgren-Miner's sum and ISO 281's mean load and speed are one; shares and speeds from their own formulas."""
    turns_each = 1.0 + 1.0 / 39.0
    capacity = 18e3

    def at(force):
        return [BearingLoad("arm", force, force, 1e6 * (capacity / force) ** (10.0 / 3.0) / turns_each)]

    loads, speeds, shares = (3000.0, 5000.0, 900.0), (40.0, 20.0, 0.0), (0.5, 0.3, 0.2)
    (found,) = lives_over_duty([at(f) for f in loads], speeds, shares)
    rpm = [w * 30.0 / math.pi * turns_each for w in speeds]
    mean_speed = sum(q * n for q, n in zip(shares, rpm, strict=True))
    mean_load = (sum(q * n * f ** (10.0 / 3.0) for q, n, f in zip(shares, rpm, loads, strict=True)) / mean_speed) ** 0.3
    hours = 1e6 / (60.0 * mean_speed) * (capacity / mean_load) ** (10.0 / 3.0)
    assert found.life / 3600.0 == pytest.approx(hours, rel=1e-12)
    assert found.equivalent == pytest.approx(mean_load, rel=1e-12)


def test_a_duty_that_never_turns_or_a_bearing_without_capacity_has_no_life():
    balls = [[BearingLoad("arm", f, f, 1e6 * (1e4 / f) ** 3, 3.0)] for f in (1e3, 2e3)]
    (rolling,) = lives_over_duty(balls, [10.0, 10.0], [0.5, 0.5])
    assert rolling.equivalent == pytest.approx(((1e9 + 8e9) / 2.0) ** (1.0 / 3.0))
    (still,) = lives_over_duty([[BearingLoad("arm", 1e3, 1e3, 1e9)]], [0.0], [1.0])
    assert math.isinf(still.life)
    (unknown,) = lives_over_duty([[BearingLoad("main", 1e3, 1e3, math.nan)]], [10.0], [1.0])
    assert math.isnan(unknown.life)
    assert asked.judge_lives(asked.Limits(bearing_life=1.0), [unknown]) == []


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_friction_power_over_a_crank_turn_is_the_sliding_work_of_the_wear_model(output):
    """Its velocities are numerical, from contacts that it solves itself, of a modified pair: within 1 %."""
    pair = make_pair(WEAR_PAIR, output=output)
    law = WearLaw(pins="fixed", coefficient="1e-20 m^2/N")
    model = wear_model(DriveValue.as_stated(pair), law, (Load(torque=200.0, crank_turns=1.0),))
    work = wear_rate(model, model.surface).sliding_work
    angle = np.linspace(0.0, 2.0 * np.pi, 367, endpoint=False)
    found = cy.Drive(pair).analyze(200.0, crank_angle=angle)
    speed = 5.0
    rubbing = pair.replace(losses={"flank": {"friction_coefficient": 0.05}})
    slides = sliding_of(rubbing, angle, found.pin_force.values[0], found.pin_pressure.values[0], speed)
    power = slides.friction_power.sum(axis=(1, 2)).mean()
    assert power == pytest.approx(0.05 * work * speed / (2.0 * np.pi), rel=0.01)
    half = 2.0 * found.pin_force.values[0] / (np.pi * pair.face_width * np.maximum(found.pin_pressure.values[0], 1.0))
    area = 2.0 * half * pair.face_width
    assert slides.friction_power_density * area == pytest.approx(slides.friction_power, rel=1e-9)


REQUIRED = """
[limits]
max_contact_pressure = "{}"
lost_motion = "10 arcmin"
sliding_speed = "1 m/s"
{}
[[duty]]
torque = "100 N*m"
output_speed = "15 rpm"
share = 1.0
"""


@pytest.mark.parametrize(
    ("allowed", "depth", "status"),
    [
        pytest.param("3000 MPa", "", 0, marks=pytest.mark.slow(3)),
        pytest.param("500 MPa", 'wear_depth = "1 um"', edge.NOT_MET, marks=pytest.mark.slow(2)),
        pytest.param("3000 MPa", 'wear_depth = "1 um"', edge.NOT_MET, marks=pytest.mark.slow(3)),
    ],
)
def test_the_status_says_whether_limits_are_met_and_everything_is_written(command, tmp_path, allowed, depth, status):
    (tmp_path / "r.toml").write_text(HEAD + REQUIRED.format(allowed, depth))
    words = ("cycloid-fmu", "analyze", EXAMPLES / "drive-39-40.toml", "--limits", "r.toml", "--angles", "20")
    shown = command(*words, "-o", "out.nc", "--plot", "out.png")
    assert shown.returncode == status, shown.stderr
    assert ("Not judged by this command, and so not met: wear depth." in shown.stdout) == bool(depth)
    assert "dynamic_capacity" not in shown.stdout
    assert ("not met" in shown.stdout) == (status != 0)
    assert (tmp_path / "out.nc").exists()
    assert (tmp_path / "out.png").exists()
    printed = json.loads(command(*words, "--json").stdout)
    drive = cy.read_drive(EXAMPLES / "drive-39-40.toml")
    judged = drive.judge(tmp_path / "r.toml", angles=20)
    assert printed["verdicts"] == [one.numbers() for one in judged.verdicts]
    assert printed["not_judged"] == (["wear_depth"] if depth else [])
    assert judged.met == (status == 0)
    data = drive.analyze([100.0], angles=20)
    values = {one["figure"]: one["value"] for one in printed["verdicts"]}
    assert values["max_contact_pressure"] == float(data.max_contact_pressure.max())
    up, down = drive.analyze([5.43, -5.43], angles=20).transmission_error.values
    lost = next(one for one in judged.verdicts if one.figure == "lost_motion")
    assert lost.value == pytest.approx((up - down).max(), rel=1e-9)


def test_one_requirements_file_judges_drives_with_and_without_bearings(command):
    """Without a bearing's capacity its life is listed as not judged, with the reason."""
    shown = command(
        "cycloid-fmu",
        "analyze",
        EXAMPLES / "drive-39-40.toml",
        "--limits",
        EXAMPLES / "requirements.toml",
        "--angles",
        "20",
    )
    assert shown.returncode == edge.NOT_MET, shown.stderr
    of_friction = "efficiency, starting torque, back driving torque, self locking"
    assert f"not met: {of_friction}, bearing life, friction power density, wear depth, temperature." in shown.stdout
    assert "Efficiency needs [losses]: no friction stated." in shown.stdout
    assert "Bearing life needs a bearing of [supports] with its dynamic_capacity." in shown.stdout


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["analyze", "drive-39-40.toml", "--limits", "none.toml"], "none.toml: No such file or directory."),
        (["analyze", "wear-39-40.toml", "--limits", "only.toml"], "--torque is missing"),
        (["analyze", "wear-39-40.toml", "--limits", "lost.toml", "--torque", "9 N*m"], "rated_torque is missing"),
        (
            ["tolerance", "drive-39-40.toml", "--tolerances", "tolerances.toml", "--limits", "only.toml"],
            "tolerances.toml: [limits] is stated here and in only.toml; state the limits in one of them.",
        ),
        (["budget", "rv-20e.toml", "--limits", "rv-20e.toml"], "(cycloid-requirements/1) is needed here"),
    ],
)
def test_limits_that_a_command_can_t_judge_are_refused_in_a_sentence(command, tmp_path, words, sentence):
    for name in ("drive-39-40", "wear-39-40", "tolerances", "rv-20e", "requirements"):
        (tmp_path / f"{name}.toml").write_text((EXAMPLES / f"{name}.toml").read_text())
    (tmp_path / "only.toml").write_text(HEAD + '[limits]\nbacklash = "1 arcmin"\n')
    (tmp_path / "lost.toml").write_text(HEAD + '[limits]\nlost_motion = "1 arcmin"\n')
    run = command("cycloid-fmu", *words)
    assert run.returncode == edge.BAD_INPUT
    assert sentence in run.stderr
    assert run.stdout == ""


def test_a_study_s_verdict_is_on_its_worst_drive_at_its_angle_and_pin(tmp_path):
    study = Study(
        cy.read_drive(EXAMPLES / "drive-39-40.toml").pair,
        cy.Tolerances(eccentricity={"tolerance": "4 um"}),
        samples=6,
        seed=3,
        torque=(100.0, -100.0),
        angles=24,
    )
    wanted = asked.Limits(max_contact_pressure="9 GPa", backlash="9 arcmin", lost_motion="1 arcsec", static_safety=9.0)
    result = conduct(dataclasses.replace(study, tolerances=study.tolerances.replace(limits=wanted.of_study))).result
    found = {one.figure: one for one in judged_of(result)}
    assert {name: one.met for name, one in found.items()} == {
        "max_contact_pressure": True,
        "backlash": True,
        "lost_motion": False,
    }
    for name, one in found.items():
        assert one.value == result.figure(name).max()
    worst = found["max_contact_pressure"]
    drive = cy.Drive(study.pair, surface_of(study, result.point[worst.where["sample"]]))
    place = {"torque": worst.where["torque"], "crank_angle": worst.where["crank_angle"], "disc": 0}
    there = drive.analyze(place["torque"], crank_angle=[place["crank_angle"]]).pin_pressure
    assert float(there.max()) == pytest.approx(worst.value, rel=1e-6)
    assert int(there.values.argmax()) == worst.where["pin"]


def test_wear_is_judged_where_it_is_deepest_and_says_when_the_limit_was_reached():
    gear, pin = np.zeros((1, 39, 10, 1)), np.zeros((40, 8, 1))
    gear[0, 7, 3, 0], pin[5, 2, 0] = 3e-6, 4e-6
    turns, deepest = np.array([0.0, 1e5, 3e5]), np.array([0.0, 3e-6, 4e-6])
    (deep,) = asked.judge_wear(asked.Limits(wear_depth="3.5 um"), gear, pin, turns, deepest)
    assert not deep.met
    assert deep.where == {"body": "pin", "pin": 5, "reached_after_crank_turns": pytest.approx(2e5)}
    (kept,) = asked.judge_wear(asked.Limits(wear_depth="5 um"), gear, 0.1 * pin, turns, deepest)
    assert kept.met
    assert kept.where == {"body": "gear", "disc": 0, "tooth": 7}
    assert kept.margin == pytest.approx(2e-6)


@pytest.mark.slow(2)
def test_a_catalogue_s_stiffness_is_a_compliance_in_series():
    """As drawn the drive then has the catalogue's stiffness; with errors it has the same compliance in series."""
    drive = cy.read_drive(EXAMPLES / "rv-20e-bearings.toml")
    catalogue, rated = drive.pair.supports.catalogue_stiffness, drive.pair.rated_torque
    series = series_compliance(drive)
    half, full = drive.analyze([0.5 * rated, rated], angles=60).transmission_error.mean("crank_angle").values
    assert (full - half) / (0.5 * rated) + series == pytest.approx(1.0 / catalogue, rel=1e-4)
    worse = drive.replace(errors={"pin_radius": "-3 um"})
    for one in (drive, worse):
        judged = one.judge(asked.Requirements(limits={"torsional_stiffness": "120 N*m/arcmin"}), rated, angles=30)
        (found,) = judged.verdicts
        own = float(one.analyze(rated, angles=30).torsional_stiffness.min())
        assert 1.0 / found.value == pytest.approx(1.0 / own + series, rel=1e-9)
        assert not found.met
        assert "up to the catalogue's stiffness" in asked.line_of(found)
    fmu = with_chain(cy.Interface(), drive)
    assert fmu.series_compliance == pytest.approx(series + first_stage_compliance(drive), rel=1e-12)


def first_stage_compliance(drive):
    """Of the first stage at the output with the sun locked, s²/(z_c² κ) (docs/theory/reducer.md)."""
    a, teeth = drive.first_stage.crank_share, drive.pair.gear_teeth
    return (1.0 / (1.0 + a / teeth) / teeth) ** 2 / drive.first_stage.crank_stiffness


def test_a_stiffness_says_which_bodies_are_rigid():
    limits = asked.Requirements(limits={"torsional_stiffness": "1 N*m/arcmin", "lost_motion": "9 arcmin"})
    bearings = cy.Drive(cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair.nominal)
    for drive, text in (
        (bearings, "contacts and bearings alone"),
        (cy.Drive(bearings.pair.replace(supports=None)), "mesh alone"),
    ):
        for one in drive.judge(limits, angles=10, torque="181 N*m").verdicts:
            assert asked.row_of(one)[-1].endswith(text)


def test_lost_motion_includes_what_is_in_series():
    """The same wind-up at ± 3 % of the rated torque as the stiffness has, in an analysis and in a tolerance study."""
    drive = cy.read_drive(EXAMPLES / "rv-20e-bearings.toml")
    stiff = drive.pair.replace(supports=drive.pair.supports.replace(catalogue_stiffness=None))
    limits = asked.Requirements(limits={"lost_motion": "9 arcmin"})
    both = [
        cy.Drive(pair, None, drive.first_stage).judge(limits, 167.0, angles=20).verdicts[0].value
        for pair in (drive.pair, stiff)
    ]
    wind_up = 0.06 * 167.0 * series_compliance(drive)
    assert both[0] - both[1] == pytest.approx(wind_up, rel=1e-9)
    tolerances = cy.Tolerances(limits={"lost_motion": "9 arcmin"}, pin_radius={"tolerance": "1 um"})
    study = Study(drive.pair, tolerances, samples=2, seed=1, torque=(167.0,), angles=20, first_stage=drive.first_stage)
    found = [conduct(dataclasses.replace(study, pair=p)).result.figure("lost_motion") for p in (drive.pair, stiff)]
    assert found[0] - found[1] == pytest.approx(wind_up, rel=1e-9)


@pytest.mark.parametrize("body", ["gear", "pin"])
def test_static_safety_of_another_material_needs_its_pressure_limit(body, tmp_path, command):
    soft = make_pair().replace(material={body: {"youngs_modulus": "70 GPa"}})
    limits = asked.Requirements(limits={"static_safety": 2.0})
    with pytest.raises(edge.InputError, match=rf"pressure_limit is missing; .* \[material.{body}\] .* is 70 GPa"):
        cy.Drive(soft).judge(limits, "20 N*m", angles=10)
    (found,) = cy.Drive(soft.replace(pressure_limit="300 MPa")).judge(limits, "20 N*m", angles=10).verdicts
    assert "at 300 MPa" in asked.line_of(found)
    (found,) = cy.Drive(make_pair()).judge(limits, "20 N*m", angles=10).verdicts
    assert "of hardened bearing steel (ISO 76)" in asked.line_of(found)
    (tmp_path / "r.toml").write_text(HEAD + "[limits]\nstatic_safety = 2\n")
    cy.Drive(soft).write(tmp_path / "soft.toml")
    done = command("cycloid-fmu", "analyze", "soft.toml", "--torque", "20 N*m", "--limits", "r.toml")
    assert done.returncode == 2
    assert done.stderr.startswith("soft.toml: [pair] pressure_limit is missing; state it for static_safety")


def test_a_limit_that_is_not_judged_is_not_met(tmp_path, command):
    (tmp_path / "r.toml").write_text(HEAD + '[limits]\nbacklash = "9 arcmin"\nwear_depth = "1 um"\n')
    cy.Drive(make_pair()).write(tmp_path / "pair.toml")
    done = command("cycloid-fmu", "analyze", "pair.toml", "--torque", "20 N*m", "--limits", "r.toml", "--angles", "20")
    assert done.returncode == edge.NOT_MET
    assert "Not judged by this command, and so not met: wear depth." in done.stdout
    limits = asked.Requirements(limits={"backlash": "9 arcmin", "wear_depth": "1 um"})
    judged = cy.Drive(make_pair()).judge(limits, 20.0, angles=20)
    assert judged.not_judged == ("wear_depth",)
    met, missing = judged.labelled(cy.Drive(make_pair()).analyze(20.0, angles=20)).verdicts.split("\n")
    assert met == asked.line_of(judged.verdicts[0])
    assert missing == "Not judged by this command, and so not met: wear depth."
    assert not judged.met


def test_a_jammed_drive_on_bearings_is_not_free(tmp_path, command):
    """All its pins are pressed without a torque, so no verdict says that it runs free."""
    supports = {
        "kind": "output_rollers",
        "count": 6,
        "circle_radius": "20 mm",
        "turning_arm": {"stiffness": "200 N/um"},
        "crank_shaft": {"stiffness": "200 N/um"},
        "main": {"stiffness": "200 N/um"},
        "output_roller": {"stiffness": "100 N/um", "clearance": "20 um"},
    }
    pair = cy.Pair(
        gear_teeth=15,
        pin_circle_radius="35 mm",
        pin_radius="3 mm",
        eccentricity="1.2 mm",
        face_width="8 mm",
        discs=2,
        rated_torque="20 N*m",
        supports=supports,
    ).replace(offset="40 um")
    cy.Drive(pair).write(tmp_path / "jam.toml")
    (tmp_path / "r.toml").write_text(HEAD + '[limits]\ninterference = "0 um"\n')
    done = command("cycloid-fmu", "analyze", "jam.toml", "--torque", "20 N*m", "--limits", "r.toml", "--angles", "2")
    assert done.returncode == edge.NOT_MET
    assert "32 pins are pressed" in done.stderr
    tolerances = cy.Tolerances(limits={"interference": "0 um"}, pin_radius={"tolerance": "1 um"})
    study = Study(pair, tolerances, samples=4, seed=1, torque=(20.0,), angles=20)
    assert conduct(study).yields["interference"]["share"] == 0.0
    built = command("cycloid-fmu", "build", "jam.toml", "-o", "jam.fmu")
    assert built.returncode == 0
    assert "32 pins are pressed" in built.stderr
    desk = open_desk(tmp_path / "jam.toml", tmp_path / "r.toml")
    seen = look(desk, desk.values)
    assert any("32 pins are pressed" in note for note in seen.notes)
    assert [(one.figure, one.met) for one in seen.verdicts] == [("interference", False)]
    duty = [{"torque": "20 N*m", "output_speed": "1 rpm", "share": 1.0}]
    vary = {"offset": ("20 um", "40 um")}
    task = DesignTask(drive="jam.toml", goals=["backlash"], vary=vary, limits={"interference": "0 um"}, duty=duty)
    assert not any(one.met for one in search(pair, task, starts=0))
