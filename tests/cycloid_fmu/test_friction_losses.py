"""Friction in the balance: an independent solver's results, closed forms, symmetries, energy, and checks of files."""

import dataclasses
import json
import math

import numpy as np
import pytest
from common import ARCSEC, DATA
from typer.testing import CliRunner

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import labelled_losses
from cycloid_fmu.analysis import sensitivity as frictionless_sensitivity
from cycloid_fmu.analysis import solve as frictionless
from cycloid_fmu.errors.kinds import structured_names
from cycloid_fmu.geometry.losses import PARTS, Drag, FirstStage, Losses, Lubricant
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.losses.back_driving import back_driving
from cycloid_fmu.losses.sensitivity import motion_sensitivity, sensitivity
from cycloid_fmu.losses.solver import laws_of, solve
from cycloid_fmu.surfaces.structured import displacement_columns, structured_value, with_structured

CASES = sorted((DATA / "losses-cases").glob("*.toml"))
ANGLES = 0.1 + np.array([0.0, 1.7, 3.1, 4.4, 12.3])
STEEL = {
    "gear_teeth": 39,
    "pin_circle_radius": 64e-3,
    "pin_radius": 3e-3,
    "eccentricity": 1.3e-3,
    "face_width": 0.01,
    "discs": 2,
    "rated_torque": 181.0,
    "modification": {"isometric": -15e-6, "offset": -40e-6},
}
SPRINGS = {"stiffness": "400 N/um"}
CRANKS = {"kind": "cranks", "count": 3, "circle_radius": 36e-3, "first_angle": 0.3}
CRANKS |= {"turning_arm": SPRINGS, "crank_shaft": SPRINGS, "main": {"stiffness": "1200 N/um"}}
FRICTION = {
    "flank": {"friction_coefficient": 0.06},
    "turning_arm": {"mean_diameter": 25e-3, "load_factor": 4e-4},
    "crank_shaft": {"mean_diameter": 22e-3, "load_factor": 4e-4},
    "main": {"mean_diameter": 0.12, "load_factor": 5e-4, "preload": 2000.0},
}


def drive(losses=None, **changes):
    return cy.Drive(cy.Pair(**{**STEEL, "supports": CRANKS, "losses": losses, **changes}))


def case(name):
    return cy.read_drive(DATA / "losses-cases" / f"{name}.toml")


def torque(found):
    return found.crank_torque[0]


def scaled(losses, share):
    """The same friction with every coefficient times a share."""
    names = ("friction_coefficient", "static_friction_coefficient", "load_factor", "speed_factor", "coulomb", "viscous")
    return Losses(
        **{
            part: {k: v * share if k in names and v is not None else v for k, v in dict(table).items()}
            for part, table in losses
            if table is not None
        }
    )


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_an_independent_solver_agrees(path):
    """Torques within 2e-4 T/z_c, positions 0.01″ + 1e-5, forces 0.5 % or 1 N, losses 0.5 %, efficiency 5e-4."""
    wanted, made = json.loads(path.with_suffix(".json").read_text()), cy.read_drive(path)
    loads = sorted({row["torque"] for row in wanted["results"]})
    found = made.losses(loads, wanted["speed"], angles=wanted["angles"], turns=wanted["turns"], workers=1)
    for row in wanted["results"]:
        k, sweep = loads.index(row["torque"]), found.sweeps[row["direction"]]
        size = abs(row["torque"]) / made.pair.gear_teeth
        motion = sweep.motion
        near = {"abs": 2e-4 * size + 1e-4, "rel": 0.0}
        assert sweep.crank_torque[k] == pytest.approx(np.array(row["crank_torque"]), **near)
        assert sweep.input_torque[k] == pytest.approx(np.array(row["input_torque"]), **near)
        error = np.array(row["transmission_error"])
        assert motion.transmission_error[k] == pytest.approx(error, rel=1e-5, abs=0.01 * ARCSEC)
        for name in ("pin_force", "turning_arm_force", "crank_bearing_force", "main_bearing_force"):
            force = np.squeeze(np.array(row[name]))
            assert np.squeeze(getattr(motion, name)[k]) == pytest.approx(force, rel=5e-3, abs=1.0)
        (one,) = (c for c in found.cases if (c.torque, c.direction) == (row["torque"], row["direction"]))
        assert dict(one.loss) == pytest.approx(row["loss"], rel=5e-3, abs=1e-4 * size)
        assert one.efficiency == pytest.approx(row["efficiency"], abs=5e-4)
        assert (one.mode, one.self_locking) == (row["mode"], row["self_locking"])
    for name in ("no_load_running_torque", "starting_torque", "back_driving_torque"):
        if name in wanted:
            value = math.nan if wanted[name] is None else wanted[name]
            scale = made.pair.gear_teeth if name == "back_driving_torque" else 1.0
            assert getattr(found, name) == pytest.approx(value, rel=5e-3, abs=1e-4 * scale, nan_ok=True)
    by_load = {one["torque"]: one["value"] for one in found.friction_hysteresis}
    assert by_load == pytest.approx({o["torque"]: o["value"] for o in wanted["friction_hysteresis"]}, rel=1e-3)


@pytest.mark.parametrize("name", ["cranks-fixed-pins", "output-sleeves", "printed-self-locking"])
def test_without_friction_the_drive_is_the_frictionless_one(name):
    made = case(name)
    smooth = made.replace(losses=scaled(made.pair.losses, 0.0).replace(main=None))
    load = np.array([made.pair.rated_torque])
    free = frictionless(made, load, ANGLES, with_play=False)
    for s in (1, -1):
        found = solve(smooth, load, ANGLES, s, 60.0)
        assert found.motion.transmission_error == pytest.approx(free.transmission_error, rel=1e-9)
        assert found.crank_torque == pytest.approx(free.crank_torque, rel=1e-7)
        assert found.motion.pin_force == pytest.approx(free.pin_force, abs=1e-4)
        assert found.loss == pytest.approx(0.0, abs=1e-15)


def test_stated_friction_changes_no_analysis():
    """A drive's analysis is without friction, whatever its [losses], to the last bit."""
    plain, rough = drive(), drive(FRICTION)
    assert rough.hash != plain.hash
    a, b = (frictionless(one, [100.0, 0.0], ANGLES) for one in (plain, rough))
    for name, values in vars(a).items():
        assert np.array_equal(values, getattr(b, name), equal_nan=True), name


def test_a_lossless_first_stage_passes_the_whole_torque():
    """Virtual work: mean τ_in times the ratio is -T; the carrier also takes the torques of sun and cranks."""
    made = case("rv-first-stage-seats")
    smooth = made.replace(losses=scaled(made.pair.losses, 0.0).replace(main=None, first_stage={"loss": 0.0}))
    turn = np.linspace(0.0, 2.0 * np.pi * 39, 39 * 12 + 1)[:-1]
    found = solve(smooth, np.array([167.0]), turn, 1, 60.0)
    assert found.input_torque.mean() * smooth.ratio == pytest.approx(-167.0, rel=2e-4)
    assert found.crank_torque.mean() / (167.0 / 39) == pytest.approx(0.968, abs=5e-4)


def test_the_first_order_of_friction_is_the_power_of_the_frictionless_forces():
    """At small load: velocities are those of the ideal motion, without the rates of deflections."""
    turn = np.linspace(0.0, 2.0 * np.pi, 281)[:-1]
    load, free = np.array([60.0]), frictionless(drive(), [60.0], turn, with_play=False)
    power = {}
    for share, near in ((1e-3, 5e-4), (1.0, 0.04)):
        found = solve(drive(scaled(Losses(**FRICTION), share)), load, turn, 1, 60.0)
        power[share] = found.loss.sum(axis=-1).mean() / share
        more = torque(found).mean() - free.crank_torque.mean()
        assert more / share / power[1e-3] == pytest.approx(1.0, abs=near)


def flank_alone(coefficient, **changes):
    """Rigid bearings, unmodified flanks, and pins in seats so soft that forces are proportional to their lever arms."""
    supports = {"kind": "cranks", "count": 3, "circle_radius": 36e-3, "pin_seat": {"stiffness_per_width": 1e9}}
    hard = {"gear": {"youngs_modulus": 1e15}, "pin": {"youngs_modulus": 1e15}}
    sizes = {**STEEL, "modification": {}, "material": hard, "rated_torque": 1.0, "discs": 1, **changes}
    return cy.Drive(cy.Pair(**sizes, supports=supports, losses={"flank": {"friction_coefficient": coefficient}}))


@pytest.mark.parametrize(("teeth", "circle", "radius", "throw"), [(39, 64e-3, 3e-3, 1.3e-3), (10, 40e-3, 4e-3, 1.6e-3)])
@pytest.mark.parametrize("coefficient", [0.01, 0.06])
def test_flanks_lose_what_the_closed_form_says(teeth, circle, radius, throw, coefficient):
    """λ = A μ/(1 ∓ B μ) of the output's work, driving and back-driving: docs/theory/losses.md."""
    sizes = {"gear_teeth": teeth, "pin_circle_radius": circle, "pin_radius": radius, "eccentricity": throw}
    made, z = flank_alone(coefficient, **sizes), teeth + 1
    k = throw * z / circle
    a = 4.0 * (circle - radius) / (math.pi * throw * teeth)
    b = a + 2.0 / math.pi * ((1.0 - k * k) * math.log((1.0 + k) / (1.0 - k)) - 2.0 * k) / (2.0 * k * k)
    turn = np.linspace(0.0, 2.0 * np.pi / z, 24, endpoint=False)
    for s, sign in ((1, -1.0), (-1, 1.0)):
        found = solve(made, np.array([1.0]), turn, s, 10.0)
        share = found.loss[0, :, PARTS.index("flank")].mean() / (1.0 / teeth)
        assert share == pytest.approx(a * coefficient / (1.0 + sign * b * coefficient), rel=1e-3)
        assert (torque(found).mean() / (1.0 / teeth) - 1.0) * s == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize("coefficient", [0.02, 0.2])
def test_output_pins_lose_what_the_closed_form_says(coefficient):
    """λ = (4/π) μ e z_p/a / (1 ± (4/π) μ r_w/a) with rigid bearings and many pins that do not turn."""
    supports = {"kind": "output_rollers", "count": 10, "circle_radius": 36e-3}
    supports["output_roller"] = {"stiffness": "200 N/um"}
    losses = {"output_contact": {"friction_coefficient": coefficient}, "output_roller": {"outer_radius": 5e-3}}
    made = cy.Drive(cy.Pair(**{**STEEL, "discs": 2}, supports=supports, losses=losses))
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    for s in (1, -1):
        found = solve(made, np.array([50.0]), turn, s, 10.0)
        share = found.loss[0, :, PARTS.index("output_contact")].mean() / (50.0 / 39)
        force = 4.0 / math.pi * coefficient / 36e-3
        assert share == pytest.approx(force * 1.3e-3 * 40 / (1.0 + s * force * 5e-3), rel=5e-3)


def test_moments_that_do_not_depend_on_load_add_to_the_crank():
    """τ of the drive with them is M (1 + 1/z_c) for each bearing larger; the balance moves by their effect on discs."""
    preloaded = {"mean_diameter": 25e-3, "load_factor": 1e-12, "preload": 1e12 * 0.05 / 25e-3}
    made = drive({"turning_arm": preloaded, "crank_shaft": preloaded})
    turn = np.linspace(0.0, 2.0 * np.pi * 39, 39 * 12 + 1)[:-1]
    found = solve(made, np.array([181.0]), turn, 1, 10.0)
    moments = (2 * 3 + 3) * 0.05
    assert torque(found).mean() - 181.0 / 39 == pytest.approx(moments * (1.0 + 1.0 / 39), rel=3e-3)


def test_a_pin_that_turns_is_a_fixed_one_with_the_smaller_ratio():
    seat = {"radius": 2e-3, "friction_coefficient": 0.05, "pressure": "cosine"}
    turning = drive({"flank": {"friction_coefficient": 0.1}, "pin": seat})
    fixed = drive({"flank": {"friction_coefficient": 4.0 / math.pi * 0.05 * 2.0 / 3.0}})
    a, b = (solve(one, np.array([181.0]), ANGLES, 1, 60.0) for one in (turning, fixed))
    assert torque(a) == pytest.approx(torque(b), rel=1e-9)
    assert a.loss[..., PARTS.index("pin_joint")] == pytest.approx(b.loss[..., PARTS.index("flank")], rel=1e-9)
    assert not a.loss[..., PARTS.index("flank")].any()


def test_a_mirrored_drive_that_turns_the_other_way_loses_the_same():
    made = drive(FRICTION)
    mirrored = made.replace(supports={**CRANKS, "first_angle": -0.3})
    a = solve(made, np.array([181.0]), ANGLES, 1, 60.0)
    b = solve(mirrored, np.array([-181.0]), -ANGLES, -1, 60.0)
    assert torque(b) == pytest.approx(-torque(a), rel=1e-7)
    assert b.loss == pytest.approx(a.loss, rel=1e-6)
    assert b.motion.transmission_error == pytest.approx(-a.motion.transmission_error, rel=1e-7)


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_power_in_is_power_out_and_heat(path):
    """Means over whole turns, within 1e-3 of the output's power in steel and 1e-2 in plastic."""
    made, wanted = cy.read_drive(path), json.loads(path.with_suffix(".json").read_text())
    load, teeth = made.pair.rated_torque, made.pair.gear_teeth
    for s in (1, -1):
        found = solve(made, np.array([load]), np.array(wanted["crank_angle"]), s, wanted["speed"])
        left = found.input_work[0] - s * load / teeth - found.loss[0].sum(axis=-1).mean()
        assert abs(left) < (1e-2 if "printed" in path.stem else 1e-3) * load / teeth


def test_at_the_threshold_of_self_locking_all_power_is_lost():
    """Where the back-driven input needs nothing, the losses are the output's power: a plain eccentric's friction."""

    def work(coefficient):
        arm = {"radius": 15e-3, "friction_coefficient": coefficient}
        found = solve(drive({"turning_arm": arm}), np.array([181.0]), turn, -1, 10.0)
        return -found.input_work[0], found.loss[0].sum(axis=-1).mean()

    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if work(middle)[0] > 0.0 else (low, middle)
    assert work(low)[1] == pytest.approx(181.0 / 39, rel=2e-3)
    locked = drive({"turning_arm": {"radius": 15e-3, "friction_coefficient": 1.05 * high}})
    assert all(one.self_locking == (one.mode == "back-driving") for one in locked.losses(angles=40, workers=1).cases)
    assert math.isnan(locked.losses(angles=8, workers=1).back_driving_torque)


@pytest.mark.parametrize("name", ["cranks-fixed-pins", "output-sleeves", "rv-first-stage-seats"])
def test_at_the_back_driving_torque_the_input_needs_nothing(name):
    """More turns the drive, less does not; angles too far apart to follow, each searched by itself, agree."""
    made, turn = case(name), np.linspace(0.0, 2.0 * np.pi, 150, endpoint=False)
    rated, teeth = made.pair.rated_torque, made.pair.gear_teeth
    threshold = back_driving(made, rated, turn)

    def given(share):
        rest = solve(made, share * threshold[None], turn, -1, 0.0)
        return rest.input_rate * rest.input_torque[0]

    assert given(1.0) == pytest.approx(np.zeros(turn.size), abs=1e-6 * rated / teeth)
    assert (given(0.999) < 0.0).all()
    for share in np.geomspace(1.001, rated / threshold.max(), 6):
        assert (given(share) > 0.0).all()
    assert back_driving(made, rated, turn[::15]) == pytest.approx(threshold[::15], rel=1e-6)


def test_friction_in_proportion_to_the_load_needs_no_torque_to_turn_backwards():
    turn = np.linspace(0.0, 0.5, 12)
    assert not back_driving(drive({"flank": {"friction_coefficient": 0.06}}), 181.0, turn).any()


def test_a_drive_jams_where_friction_outweighs_the_normal_forces():
    """Fixed pins of a 10/11 pair jam near μ = 1/B; the result says so and is no error."""
    sizes = {"gear_teeth": 10, "pin_circle_radius": 40e-3, "pin_radius": 4e-3, "eccentricity": 1.6e-3}
    found = flank_alone(0.9, **sizes).losses(0.1, "100 rpm", angles=6, workers=1)
    driving = found.cases[0]
    assert driving.jams
    assert math.isnan(driving.efficiency)


def test_a_torque_beyond_any_drive_is_no_jam():
    """Without friction this drive can't carry it either, so friction is not to blame."""
    sizes = {"gear_teeth": 10, "pin_circle_radius": 40e-3, "pin_radius": 4e-3, "eccentricity": 1.6e-3}
    with pytest.raises(edge.InputError, match=r"the drive can't balance it"):
        flank_alone(0.1, **sizes).losses(1e9, "100 rpm", angles=3, workers=1)


@pytest.mark.parametrize("name", [path.stem for path in CASES])
def test_derivatives_of_the_crank_torque_are_finite_differences(name):
    made, load = case(name), np.array([case(name).pair.rated_torque])
    losses, some = made.pair.losses, ANGLES[:2]
    for s, speed in ((1, 60.0), (-1, 0.0)):
        by = sensitivity(made, solve(made, load, some, s, speed))
        for key, derivative in by.items():
            part, coefficient = key.split(".")
            table = getattr(losses, part)
            if not (value := getattr(table, coefficient, None)):
                continue
            step, moved = (0.02 if "drag" in key else 1e-3) * value, []
            for sign in (1.0, -1.0):
                changed = losses.replace(**{part: table.replace(**{coefficient: value + sign * step})})
                moved.append(torque(solve(made.replace(losses=changed), load, some, s, speed)))
            expected = (moved[0] - moved[1]) / (2.0 * step)
            assert derivative == pytest.approx(expected, rel=1e-4, abs=1e-6 * abs(derivative).max() + 1e-9), key


def with_errors(made, seed=0):
    """The drive with random errors of single pins, teeth, holes and cranks, within a micrometre or so."""
    generator = np.random.default_rng(seed)
    sizes = {"crank_phase": 1e-4}
    errors = {
        name: value + generator.normal(0.0, sizes.get(name, 1e-6), np.shape(value))
        for name, value in made.surface.errors.items()
        if not name.startswith(("misalignment", "isometric", "offset"))
    }
    return cy.Drive(made.pair, made.surface.replace(**errors))


def error_of(made, load, angles, s, speed):
    return solve(made, np.array([load]), angles, s, speed).motion.transmission_error[0]


@pytest.mark.parametrize("name", ["cranks-fixed-pins", "output-sleeves", "printed-self-locking"])
@pytest.mark.parametrize("s", [1, pytest.param(-1, marks=pytest.mark.slow(1))])
def test_derivatives_of_the_motion_with_friction_are_finite_differences(name, s):
    """By torque, crank angle and every kind of error that moves contacts and joints, and by every coefficient."""
    made, speed = with_errors(case(name)), 60.0
    load, losses = 0.5 * made.pair.rated_torque, made.pair.losses
    found = motion_sensitivity(made, load, ANGLES, s, speed)
    assert found.motion.transmission_error == pytest.approx(error_of(made, load, ANGLES, s, speed), abs=1e-12)

    def differs(derivative, moved, step):
        expected = (moved(step) - moved(-step)) / (2.0 * step)
        return np.abs(derivative - expected).max() / np.abs(expected).max()

    by_torque = differs(found.motion.by_torque, lambda d: error_of(made, load + d, ANGLES, s, speed), 1e-6 * load)
    by_angle = differs(found.motion.by_crank_angle, lambda d: error_of(made, load, ANGLES + d, s, speed), 1e-6)
    assert max(by_torque, by_angle) < 1e-4

    names = structured_names([1, 2])
    columns = found.motion.by_displacement @ displacement_columns(made.pair, names)
    for key, derivative in zip(names, columns.T, strict=True):
        if key.startswith("misalignment"):
            continue

        def with_error(d, key=key):
            changed = with_structured(made.surface, {key: structured_value(made.surface, key) + d})
            return error_of(cy.Drive(made.pair, changed), load, ANGLES, s, speed)

        assert differs(derivative, with_error, 1e-8) < 2e-3, key
    for key, derivative in found.by_coefficient.items():
        part, coefficient = key.split(".")
        table = getattr(losses, part)
        if not (value := getattr(table, coefficient, None)) or not np.abs(derivative).max() > 0.0:
            continue

        def with_coefficient(d, part=part, coefficient=coefficient, table=table, value=value):
            changed = losses.replace(**{part: table.replace(**{coefficient: value + d})})
            return error_of(made.replace(losses=changed), load, ANGLES, s, speed)

        assert differs(derivative, with_coefficient, 1e-3 * value) < 2e-3, key


@pytest.mark.parametrize("name", ["cranks-fixed-pins", "output-sleeves"])
def test_without_friction_the_motion_has_the_frictionless_derivatives(name):
    made = with_errors(case(name))
    load = 0.5 * made.pair.rated_torque
    smooth = made.replace(losses=scaled(made.pair.losses, 0.0).replace(input_drag=Drag(), output_drag=Drag()))
    wanted = frictionless_sensitivity(made, load, ANGLES)
    for s in (1, -1):
        found = motion_sensitivity(smooth, load, ANGLES, s, 60.0).motion
        for field in dataclasses.fields(found):
            of, values = getattr(wanted, field.name), getattr(found, field.name)
            assert values == pytest.approx(of, rel=1e-6, abs=1e-6 * np.abs(of).max()), field.name


def test_a_drive_that_jams_has_no_motion_and_says_so():
    sizes = {"gear_teeth": 10, "pin_circle_radius": 40e-3, "pin_radius": 4e-3, "eccentricity": 1.6e-3}
    with pytest.raises(edge.InputError, match="jams"):
        motion_sensitivity(flank_alone(0.9, **sizes), 0.1, ANGLES, 1, 60.0)


def test_oil_and_bearings_follow_the_published_formulas():
    """ASTM D341 goes through both stated viscosities; Palmgren's moment in N·mm, mm and rpm."""
    oil = {"viscosity_40": "150 mm^2/s", "viscosity_100": "15 mm^2/s"}
    for kelvin, value in ((313.15, 150e-6), (373.15, 15e-6)):
        assert Lubricant(**oil, temperature=kelvin).viscosity == pytest.approx(value, rel=1e-9)
    main = {"mean_diameter": "100 mm", "load_factor": 5e-4, "speed_factor": 3, "preload": "1000 N"}
    pair = drive({"main": main, "lubricant": {**oil, "temperature": "313.15 K"}}).pair
    at_speed = laws_of(pair, pair.losses, 390.0 * math.pi)
    # 39/40: the carrier turns at 300 rpm; ν n = 45000, above 2000.
    constant = 5e-4 * 1000.0 * 100.0 + 1e-7 * 3.0 * 100.0**3 * 45000.0 ** (2.0 / 3.0)
    assert at_speed["constant"][2] == pytest.approx(1e-3 * constant)
    slow = laws_of(pair, pair.losses, 0.0)["constant"][2]
    assert slow == pytest.approx(1e-3 * (5e-4 * 1000.0 * 100.0 + 1e-7 * 3.0 * 100.0**3 * 160.0))


def test_teeth_of_the_first_stage_lose_by_their_contact_ratios():
    """Ohlendorf's H_v grows in proportion to μ and falls with the numbers of teeth; a stated loss is taken as it is."""
    by_teeth = [FirstStage(friction_coefficient=0.06).share(z, 3 * z) for z in (12, 20, 40)]
    assert by_teeth == sorted(by_teeth, reverse=True)
    assert FirstStage(friction_coefficient=0.12).share(12, 42) == pytest.approx(
        2.0 * FirstStage(friction_coefficient=0.06).share(12, 42)
    )
    assert FirstStage(loss=0.012).share(12, 42) == 0.012


def test_the_pair_text_holds_the_friction():
    for path in CASES:
        pair = cy.read_drive(path).pair
        assert parse_pair(pair.nominal.text, "pair").losses == pair.losses


@pytest.mark.parametrize(
    ("losses", "part"),
    [
        ({"flank": {"friction_coefficient": -0.1}}, "friction_coefficient = -0.1"),
        ({"output_roller": {"radius": 3e-3}}, "outer_radius is missing"),
        ({"output_roller": {"outer_radius": 3e-3}}, "cranks have none"),
        ({"output_contact": {"friction_coefficient": 0.1}}, "outer_radius, which is missing"),
        ({"main": {"load_factor": 1e-3}}, "mean_diameter"),
        ({"main": {"radius": 5e-3, "load_factor": 1e-3}}, "load_factor does not belong to a plain"),
        ({"first_stage": {"loss": 0.01, "friction_coefficient": 0.1}}, "state one of them"),
        ({"flank": {"mu": 0.1}}, "not a known key"),
    ],
)
def test_impossible_friction_is_refused(losses, part):
    with pytest.raises(edge.InputError, match=part):
        drive(losses)


def test_what_is_missing_is_named():
    with pytest.raises(edge.InputError, match=r"no friction stated; state \[losses\]"):
        drive().losses()
    with pytest.raises(edge.InputError, match=r"\[losses\] needs \[supports\], which is missing"):
        cy.Drive(cy.Pair(**STEEL, losses=FRICTION)).losses()
    rolling = {"main": {"mean_diameter": 0.1, "speed_factor": 3}}
    with pytest.raises(edge.InputError, match=r"\[losses.lubricant\] is missing"):
        drive(rolling).losses(crank_speed=10.0, angles=2)
    assert drive(rolling).losses(angles=2, workers=1).starting_torque > 0.0
    with pytest.raises(edge.InputError, match="no first stage"):
        drive({"first_stage": {"loss": 0.01}}).losses(angles=2)


@pytest.mark.slow(2)
def test_the_command_prints_writes_and_draws(tmp_path):
    import xarray as xr

    from cycloid_fmu.cli import app

    options = ["losses", str(CASES[0]), "--crank-speed", "600 rpm", "--angles", "6", "--turns", "39"]
    written = ["-o", str(tmp_path / "out.nc"), "--plot", str(tmp_path / "l.png"), "--map", str(tmp_path / "m.png")]
    shown = CliRunner().invoke(app, [*options, *written, "--json"])
    assert shown.exit_code == 0, shown.output
    numbers = json.loads(shown.stdout)
    first = numbers["results"][0]
    assert first["heat"] == pytest.approx(sum(first["loss"].values()) * 20.0 * math.pi)
    with xr.open_dataset(tmp_path / "out.nc") as data:
        assert dict(data.efficiency.sizes) == {"torque": 1, "direction": 2}
        mean = data.loss.sel(direction=1).mean("crank_angle").squeeze().to_series()
        assert mean.to_dict() == pytest.approx(first["loss"])
    assert (tmp_path / "l.png").stat().st_size > 20000
    assert (tmp_path / "m.png").stat().st_size > 20000
    assert "efficiency" in CliRunner().invoke(app, options).output
    with pytest.raises(edge.InputError, match="a map over speeds needs one above zero"):
        CliRunner().invoke(app, [*options[:3], "0 rpm", "--map", str(tmp_path / "n.png")], catch_exceptions=False)


def test_results_are_labelled():
    found = drive(FRICTION).losses("181 N*m", angles=4, workers=1)
    data = labelled_losses(drive(FRICTION), found)
    assert data.input_torque.dims == ("torque", "direction", "crank_angle")
    assert all("units" in data[name].attrs for name in ("loss", "pin_force", "crank_torque", "starting_torque"))
    assert dataclasses.is_dataclass(found)


def test_a_sweep_shows_what_friction_costs():
    """Losses grow with the coefficient, and each drive of the sweep is the drive alone."""
    rated = {"turning_arm": {"radius": 15e-3, "friction_coefficient": 0.05}}
    made = drive({**FRICTION, **rated})
    found = made.sweep(
        {"losses.flank.friction_coefficient": "0, 0.06, 0.12"}, "181 N*m", angles=40, crank_speed="60 rpm", workers=1
    )
    efficiency = found.efficiency.values[:, 0]
    assert (np.diff(efficiency) < 0.0).all()
    alone = made.losses(crank_speed="60 rpm", angles=40, workers=1)
    assert efficiency[1] == pytest.approx(alone.cases[0].efficiency, abs=1e-9)
    assert found.back_driving_efficiency.values[1, 0] == pytest.approx(alone.cases[1].efficiency, abs=1e-9)
    assert found.starting_torque.values[1] == pytest.approx(alone.starting_torque, rel=1e-9)
    assert found.back_driving_torque.values[1] == pytest.approx(alone.back_driving_torque, rel=1e-6)
    assert "efficiency" not in drive().sweep({"offset": "-40, -30 um"}, angles=20, workers=1)


def test_limits_of_friction_are_judged():
    """At the worst row of the duty, in the driving direction; starting and back-driving from rest."""
    from cycloid_fmu.studies.limits import Requirements

    duty = [
        {"torque": "181 N*m", "output_speed": "15 rpm", "share": 0.5},
        {"torque": "-10 N*m", "output_speed": "15 rpm", "share": 0.5},
    ]
    limits = {"efficiency": 0.9, "starting_torque": "1 N*m", "back_driving_torque": "100 N*m", "self_locking": False}
    made = drive(FRICTION)
    judged = made.judge(Requirements(limits=limits, duty=duty), angles=40, workers=1)
    by = {one.figure: one for one in judged.verdicts}
    assert set(by) == set(limits)
    alone = made.losses([181.0, -10.0], 39 * 15.0 * math.pi / 30.0, angles=40, workers=1)
    driving = {case.torque: case.efficiency for case in alone.cases if case.mode == "driving"}
    worst = min(driving, key=driving.__getitem__)
    assert by["efficiency"].value == pytest.approx(driving[worst], abs=1e-9)
    assert by["efficiency"].where["torque"] == worst
    assert by["starting_torque"].value == pytest.approx(alone.starting_torque)
    assert by["back_driving_torque"].value == pytest.approx(alone.back_driving_torque)
    assert by["self_locking"].met
    locking = case("printed-self-locking").judge(
        Requirements(limits={"self_locking": True, "back_driving_torque": "1 N*m"}), angles=13, workers=1
    )
    assert [one.met for one in locking.verdicts] == [False, True]
    assert set(drive().judge(Requirements(limits=limits, duty=duty), angles=20, workers=1).not_judged) == set(limits)
    with pytest.raises(edge.InputError, match=r"efficiency needs speeds"):
        Requirements(limits={"efficiency": 0.9})


@pytest.mark.parametrize("seat", [None, {"radius": 2e-3, "friction_coefficient": 0.02}])
def test_the_pins_friction_power_is_the_flanks_loss(seat):
    """Over whole turns within 1 %, by closed forms of velocities; on pins that turn in their seats nothing slides."""
    from cycloid_fmu.studies.limits import Requirements

    flank = {"friction_coefficient": 0.06, "static_friction_coefficient": 0.12, "stribeck_speed": "0.1 m/s"}
    made, speed = drive({"flank": flank, "pin": seat}), 39 * 15.0 * math.pi / 30.0
    duty = [{"torque": "181 N*m", "output_speed": "15 rpm", "share": 1.0}]
    ((_, slides),) = made.judge(Requirements(duty=duty), angles=117, turns=39, workers=1).sliding
    case = made.losses(181.0, speed, angles=117, turns=39, workers=1).cases[0]
    lost = speed * (case.loss["flank"] + case.loss["pin_joint"])
    assert slides.friction_power.sum(axis=(1, 2)).mean() == pytest.approx(lost, rel=0.01)
    assert bool(case.loss["pin_joint"]) == (seat is not None)
    assert slides.sliding_speed.any() == (seat is None)
    assert slides.friction_power_density.any() == (seat is None)


def test_the_friction_of_wear_is_the_drive_s():
    """A seat that turns takes its friction; stated twice it is refused."""
    from cycloid_fmu.wear.law import WearLaw
    from cycloid_fmu.wear.life import friction_of

    law = WearLaw(pins="fixed", coefficient="1e-18 m^2/N")
    assert friction_of(drive().pair, law) is None
    assert friction_of(drive().pair, law.replace(friction_coefficient=0.08)) == 0.08
    assert friction_of(drive(FRICTION).pair, law) == 0.06
    seat = {"radius": 2e-3, "friction_coefficient": 0.03, "pressure": "cosine"}
    assert friction_of(drive({**FRICTION, "pin": seat}).pair, law) == pytest.approx(4.0 / math.pi * 0.03 * 2.0 / 3.0)
    with pytest.raises(edge.InputError, match=r"friction_coefficient = 0.08 is stated by \[losses.flank\]"):
        friction_of(drive(FRICTION).pair, law.replace(friction_coefficient=0.08))


@pytest.mark.slow(1)
def test_a_tolerance_study_judges_friction():
    """Its figures are those of each drawn drive alone; efficiency and self-locking are kept above their limits."""
    from cycloid_fmu.studies.limits import Requirements
    from cycloid_fmu.studies.tolerance import surface_of
    from cycloid_fmu.studies.yields import judged

    duty = [{"torque": "181 N*m", "output_speed": "15 rpm", "share": 1.0}]
    limits = {"efficiency": 0.9, "starting_torque": "1 N*m", "back_driving_torque": "100 N*m", "self_locking": False}
    asked, tolerances = Requirements(limits=limits, duty=duty), cy.Tolerances(offset={"tolerance": "10 um"})
    made = drive(FRICTION)
    found = made.study(tolerances, 181.0, samples=3, angles=40, requirements=asked, workers=1)
    result, verdicts = found.result, {one.figure: one for one in judged(found.result)}
    assert set(verdicts) == set(limits)
    for k, point in enumerate(result.point):
        drawn = cy.Drive(made.pair, surface_of(result.study, point))
        alone = drawn.losses(181.0, 39 * 15.0 * math.pi / 30.0, angles=40, workers=1)
        assert result.figure("efficiency")[k] == pytest.approx(alone.cases[0].efficiency, abs=1e-9)
        assert result.figure("starting_torque")[k] == pytest.approx(alone.starting[0.0].max(), rel=1e-6)
        assert result.figure("back_driving_torque")[k] == pytest.approx(alone.back_driving.max(), rel=1e-6)
    worst = int(result.figure("efficiency").argmin())
    assert verdicts["efficiency"].where["sample"] == worst
    assert verdicts["efficiency"].value == pytest.approx(result.figure("efficiency")[worst], abs=1e-12)
    limit = float(np.sort(result.figure("efficiency"))[1])
    stricter = asked.replace(limits=asked.limits.replace(efficiency=limit))
    again = made.study(tolerances, 181.0, samples=3, angles=40, requirements=stricter, workers=1)
    assert again.yields["efficiency"]["share"] == pytest.approx(2.0 / 3.0)
    assert "efficiency" not in drive().study(tolerances, samples=2, angles=20, requirements=asked, workers=1).yields
    with pytest.raises(edge.InputError, match=r"efficiency needs a torque and a speed"):
        made.study(tolerances.replace(limits={"efficiency": 0.9}), samples=2, workers=1)
    with pytest.raises(edge.InputError, match="no friction stated"):
        drive().study(tolerances.replace(limits={"self_locking": True}), samples=2, workers=1)


def test_a_tolerance_study_counts_drives_that_lock_themselves():
    """A printed drive that locks at every angle has no back-driving torque, and so no mean of it."""
    locking = case("printed-self-locking")
    limits = {"self_locking": True, "back_driving_torque": "1 N*m"}
    tolerances = cy.Tolerances(pin_radius={"tolerance": "5 um"}, limits=limits)
    found = locking.study(tolerances, samples=3, angles=20, workers=1)
    assert found.yields["self_locking"]["share"] == 1.0
    assert found.yields["back_driving_torque"]["share"] == 0.0
    assert math.isnan(found.statistics["back_driving_torque"]["mean"])
    assert found.statistics["back_driving_torque"]["quantiles"]["1"] == math.inf


def test_a_named_friction_is_its_range_and_the_result_states_what_follows():
    """Figures lie between those of both ends; numbers beside a name are refused, and unknown names are suggested."""
    made = drive({"flank": {"friction": "steel, grease"}})
    flank = made.pair.losses.flank
    assert flank.friction_coefficient == pytest.approx(math.sqrt(0.04 * 0.25))
    assert parse_pair(made.pair.text, "pair") == made.pair
    found = made.losses(angles=40, workers=1)
    low, high = (
        drive({"flank": {"friction_coefficient": mu, "static_friction_coefficient": mu_s}}).losses(angles=40, workers=1)
        for mu, mu_s in ((0.04, 0.12), (0.25, 0.35))
    )
    numbers = found.numbers()
    for k, result in enumerate(numbers["results"]):
        assert result["efficiency_range"] == pytest.approx([low.cases[k].efficiency, high.cases[k].efficiency])
        assert high.cases[k].efficiency < result["efficiency"] < low.cases[k].efficiency
    assert numbers["range"]["back_driving_torque"][0] == pytest.approx(low.back_driving_torque, nan_ok=True)
    assert "range" not in low.numbers()
    by = sensitivity(made, found.sweeps[1])
    assert (by["flank.static_friction_coefficient"] > 0.0).all()
    with pytest.raises(edge.InputError, match="stated by friction and friction_coefficient"):
        drive({"flank": {"friction": "steel, grease", "friction_coefficient": 0.05}})
    with pytest.raises(edge.InputError, match="steel, grease"):
        drive({"flank": {"friction": "steel, greese"}})


def test_each_friction_value_has_a_range_and_a_source():
    from cycloid_fmu.geometry.friction_values import VALUES

    page = (DATA.parents[1] / "docs" / "losses.md").read_text(encoding="utf-8")
    for name, value in VALUES.items():
        assert 0.0 < value.low <= value.high <= value.static_high
        assert value.low <= value.static_low
        assert value.source
        assert f"| `{name}` | {value.low:.2f} to {value.high:.2f} |" in page
