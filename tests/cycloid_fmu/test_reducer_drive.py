"""An RV reducer as a drive: the cycloid stage behind its first stage, with the sun held."""

import dataclasses
import json
import math

import numpy as np
import pytest
import xarray as xr
from clockworks import kinematic_drive
from common import EXAMPLES

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import compliance, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.reducer.description import MESH_STIFFNESS, parse_reducer
from cycloid_fmu.reducer.lost_motion import parts_of
from cycloid_fmu.surfaces.surface import nominal_surface

TEXT = (EXAMPLES / "rv-20e.toml").read_text()
RIGID = parse_reducer(TEXT, "rv.toml")
SUPPORTS = """[supports]
kind = "cranks"
count = 3
circle_radius = "27.5 mm"
[supports.turning_arm]
rollers = 15
roller_length = "7 mm"
clearance = "6 um"
[supports.crank_shaft]
stiffness = "300 N/um"
[supports.main]
stiffness = "1200 N/um"
[involute]
"""
HELD = parse_reducer(TEXT.replace("discs = 1", "discs = 2").replace("[involute]", SUPPORTS), "rv.toml")
ANGLES = np.array([0.3, 2.0, 4.1])


def soft(drive, stiffness):
    return cy.Drive(drive.pair, drive.surface, dataclasses.replace(drive.first_stage, crank_stiffness=stiffness))


def test_it_is_what_the_fmu_s_model_finds_one_place_after_the_other():
    """The FMU turns the crank by an iteration of its own: places, stiffness, torque and play with the sun locked."""
    pair, surface, first_stage = parts_of(RIGID)
    found = solve(DriveValue(pair, surface, first_stage), [167.0, -45.0], ANGLES)
    model = kinematic_drive(DriveValue(pair, surface, first_stage))
    for k, torque in enumerate(found.torque):
        for i, crank in enumerate(ANGLES):
            sun = -crank * 141.0 / 39.0
            model.crank_angle, model.torque, model.crank_speed = sun, torque, 0.0
            model.advance()
            assert model.output_angle - sun / 141.0 == pytest.approx(found.transmission_error[k, i], abs=1e-12)
            assert model.torsional_stiffness == pytest.approx(found.torsional_stiffness[k, i], rel=1e-5)
            assert model.crank_torque == pytest.approx(-12 / 42 * found.crank_torque[k, i], rel=1e-7)
    model.torque = 0.0
    model.advance()
    assert model.backlash == pytest.approx(found.backlash[-1], abs=1e-6)


@pytest.mark.parametrize("reducer", [RIGID, HELD], ids=["rigid bearings", "on bearings"])
def test_stiffness_is_the_torque_s_derivative(reducer):
    """First stage wound up, cranks that turn with the output, torque that changes with the cranks."""
    pair, surface, first_stage = parts_of(reducer)
    first_stage = dataclasses.replace(first_stage, crank_stiffness=2e4)
    found = solve(DriveValue(pair, surface, first_stage), [99.5, 100.0, 100.5], ANGLES, with_play=False)
    by_torque = 1.0 / (found.transmission_error[2] - found.transmission_error[0])
    assert found.torsional_stiffness[1] == pytest.approx(by_torque, rel=2e-3)


def test_the_first_stage_s_wind_up_and_play_reach_the_output_by_the_ratio():
    """Torque T/(z_c + a) on the cranks winds them up; of their turn 1/(z_c + a) reaches the output."""
    pair = RIGID.stage.nominal.replace(modification={})
    surface, first_stage = nominal_surface(pair), parts_of(RIGID)[2]
    first_stage = dataclasses.replace(first_stage, bearing_play=0.0)
    tight = dataclasses.replace(first_stage, sun_play=0.0)
    wound = dataclasses.replace(tight, crank_stiffness=3e4)
    error = [
        solve(DriveValue(pair, surface, one), 120.0, ANGLES, with_play=False).transmission_error[0]
        for one in (tight, wound, first_stage)
    ]
    cranks = 39.0 + 1.0 + 12 / 42
    assert error[1] - error[0] == pytest.approx(120.0 / cranks**2 / 3e4, rel=1e-3)
    assert error[2] - error[0] == pytest.approx(0.5 * first_stage.sun_play / 141.0, rel=1e-3)
    assert first_stage.sun_play == pytest.approx(13.7e-6 / (9e-3 * math.cos(math.radians(20.0))), rel=1e-9)


def test_mean_sun_torque_is_the_ratio_s():
    """Over whole periods the work of the load on an error-free reducer is that on the sun."""
    pair, _, first_stage = parts_of(HELD)
    pair = pair.nominal
    crank = np.linspace(0.0, 2.0 * np.pi * 13 / 40, 60, endpoint=False) * 40 / 39
    found = solve(DriveValue(pair, nominal_surface(pair), first_stage), 167.0, crank, with_play=False)
    assert -12 / 42 * found.crank_torque.mean() == pytest.approx(-167.0 / 141.0, rel=3e-4)


def test_sensitivities_are_differences():
    drive = soft(cy.Drive(HELD), 2e4)
    names, step = ["eccentricity", "pin_radius", "centre_distance_x", "turning_arm_clearance"], 2e-8
    by = drive.sensitivity(167.0, names, crank_angle=ANGLES).values

    def error(name, by):
        if name in drive.surface.errors:
            made = drive.replace(errors={name: float(drive.surface.errors[name]) + by})
        else:
            arm = drive.pair.supports.turning_arm
            made = drive.replace(
                supports=drive.pair.supports.replace(turning_arm=arm.replace(clearance=arm.clearance + by))
            )
        return made.analyze(167.0, crank_angle=ANGLES).transmission_error.values[0]

    for name, row in zip(names, by, strict=True):
        differences = (error(name, step) - error(name, -step)) / (2.0 * step)
        assert row == pytest.approx(differences, rel=3e-3, abs=3e-3 * np.abs(differences).max())


def test_parts_of_the_compliance_add_up_to_the_reducer():
    """From half to all of the rated torque, and at ± 3 % of it, the sun locked."""
    pair, _, first_stage = parts_of(HELD.replace(involute=HELD.involute.replace(face_width="8 mm")))
    shares = compliance(DriveValue(pair, nominal_surface(pair.nominal), first_stage))
    assert shares[-1].part == "first stage"
    torques = [83.5, 167.0, 0.03 * 167.0, -0.03 * 167.0]
    angles = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    found = solve(
        DriveValue(pair.nominal, nominal_surface(pair.nominal), first_stage), torques, angles, with_play=False
    )
    place = found.transmission_error.mean(axis=1)
    assert sum(share.compliance for share in shares) == pytest.approx((place[1] - place[0]) / 83.5, rel=1e-4)
    assert sum(share.lost_motion for share in shares) == pytest.approx(place[2] - place[3], rel=1e-4)


@pytest.mark.parametrize(("sun", "planet", "planets"), [(12, 42, 3), (13, 42, 3), (15, 40, 2)])
def test_planets_mesh_with_the_sun_wherever_their_crank_stands(sun, planet, planets):
    """At each pitch point a planet's tooth must face a gap of the sun when all cranks have the same angle."""
    reducer = RIGID.replace(involute=RIGID.involute.replace(sun_teeth=sun, planet_teeth=planet, planets=planets))
    place = 2.0 * np.pi * np.arange(planets) / planets
    phase = (planet * (place - reducer.planet_keys) + sun * place) / (2.0 * np.pi)
    assert np.abs(phase - np.round(phase)).max() < 1e-12
    assert (not reducer.planet_keys.any()) == ((sun + planet) % planets == 0)


def test_mesh_stiffness_is_method_c_s_or_stated():
    """c_γ times the width of one mesh, on the planets' base circles, of all planets."""
    wide = HELD.replace(involute=HELD.involute.replace(face_width="8 mm"))
    base = 0.5 * 1.5e-3 * 42 * math.cos(math.radians(20.0))
    assert parts_of(wide)[2].crank_stiffness == pytest.approx(3 * 20e9 * 8e-3 * base**2)
    stated = HELD.replace(involute=HELD.involute.replace(mesh_stiffness=MESH_STIFFNESS * 8e-3))
    assert parts_of(stated)[2] == parts_of(wide)[2]
    assert parts_of(HELD)[2].crank_stiffness == math.inf


def test_clearance_of_the_crank_bearings_is_play_either_way():
    """Beside rigid bearings the closed form's, c/a; on bearings the turning arms', as made where that is stated."""
    pair, _, beside = parts_of(RIGID)
    assert beside.bearing_play == pytest.approx(2e-6 / 27.5e-3)
    pair, _, first_stage = parts_of(HELD)
    assert first_stage.bearing_play == 0.0
    assert pair.supports.turning_arm.clearance == 2e-6
    drawn = HELD.replace(deviations=HELD.deviations.replace(crank_bearing_clearance="0 um"))
    assert parts_of(drawn)[0].supports.turning_arm.clearance == 6e-6


def test_a_drive_behind_another_first_stage_is_another():
    drive = cy.Drive(RIGID)
    assert drive != cy.Drive(drive.pair, drive.surface)
    assert drive != soft(drive, 1e5)
    assert drive == cy.Drive(RIGID)
    assert drive.ratio == 141.0
    assert drive.replace(errors={"pin_radius": 0.0}).first_stage == drive.first_stage
    data = drive.analyze("167 N*m", angles=3)
    assert data.attrs["drive"] == drive.hash
    assert data.sun_angle.values[1] == pytest.approx(-data.crank_angle.values[1] * 141.0 / 39.0)


def test_what_knows_the_cycloid_stage_alone_says_so():
    drive = cy.Drive(RIGID)
    with pytest.raises(edge.InputError, match="has the first stage of an RV reducer, which"):
        drive.wear(None, 100.0, 1.0)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('kind = "cranks"', 'kind = "output_rollers"', 'write kind = "cranks"'),
        ("sun_teeth = 12", "sun_teeth = 12\nplanets = 2", "planets = 2, but [supports] count = 3"),
        ("sun_teeth = 12", 'sun_teeth = 12\nface_width = "8 mm"\nmesh_stiffness = "1 N/um"', "state one of them"),
        ('crank_bearing_clearance = "2 um"', 'crank_bearing_clearance = "-7 um"', "must not be below zero"),
        (
            "[deviations]",
            '[errors]\npin_radius = "1 um"\n[deviations]',
            "states its errors in [deviations] and [errors.supports]",
        ),
    ],
)
def test_contradictions_are_refused_in_a_sentence(old, new, sentence):
    text = TEXT.replace("[involute]", SUPPORTS)
    assert old in text
    with pytest.raises(edge.InputError) as refused:
        parse_reducer(text.replace(old, new), "rv.toml")
    assert sentence in str(refused.value)
    assert str(refused.value).startswith("rv.toml: ")


def test_planets_without_a_number_have_no_stiffness():
    with pytest.raises(edge.InputError, match="planets is missing"):
        parse_reducer(TEXT.replace("sun_teeth = 12", 'sun_teeth = 12\nface_width = "8 mm"'), "rv.toml")


@pytest.mark.slow(2)
def test_a_reducer_from_the_command_line(command, tmp_path):
    """Analysis and tolerance study of a reducer file; contradictions are reported with the results."""
    text = TEXT.replace("discs = 1", "discs = 2").replace("[involute]", SUPPORTS)
    (tmp_path / "rv.toml").write_text(text)
    run = command("cycloid-fmu", "analyze", "rv.toml", "--torque", "167 N*m", "--angles", 12, "--plot", "rv.png")
    assert run.returncode == 0, run.stderr
    assert "ratio 141, sun locked" in run.stdout
    assert "first stage" in run.stdout
    assert run.stderr.count("rv.toml: ") == 4
    run = command("cycloid-fmu", "analyze", "rv.toml", "--torque", "167 N*m", "--angles", 12, "--json")
    content = json.loads(run.stdout)
    assert np.mean(content["sun_torque"]) == pytest.approx(-167.0 / 141.0, rel=0.01)
    (tmp_path / "t.toml").write_text('format = "cycloid-tolerances/1"\n[pin_radius]\ntolerance = "2 um"\n')
    run = command(
        "cycloid-fmu",
        "tolerance",
        "rv.toml",
        "--tolerances",
        "t.toml",
        "--samples",
        3,
        "--angles",
        20,
        "--workers",
        1,
        "-o",
        "study.nc",
    )
    assert run.returncode == 0, run.stderr
    study = xr.load_dataset(tmp_path / "study.nc")
    assert study.attrs["format"] == "cycloid-tolerance-study/1"
    assert json.loads(study.attrs["first_stage"])["sun_teeth"] == 12
