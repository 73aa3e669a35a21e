"""The compensator inverts the exact model, has the memory of friction, and learns what the model lacks."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

import cycloid_fmu as cy
from cycloid_fmu.analysis import solve
from cycloid_fmu.compensation.compensator import LARGEST, Memory, step, torque_of_teeth
from cycloid_fmu.compensation.index import find_index
from cycloid_fmu.compensation.inverse import SURE, _normal_weights
from cycloid_fmu.fmu.constants import FRICTION_ELEMENTS

EXAMPLES = Path(__file__).parents[2] / "examples"
ARCSEC = math.pi / 648000.0
RATED = 40.0
AMBIENT = 293.15
FRICTION = cy.Friction(coulomb=1.0, load_share=0.02, stribeck=0.5, viscous=0.1, temperature_coefficient=0.01)


def small(**errors):
    pair = cy.Pair(
        gear_teeth=11,
        pin_circle_radius="30 mm",
        pin_radius="2.5 mm",
        eccentricity="1 mm",
        face_width="8 mm",
        rated_torque=RATED,
    ).replace(offset="-15 um")
    return cy.Drive(pair).replace(
        errors=errors or {"eccentricity": "4 um", "pin_radial": {1: ("3 um", "40 deg"), 3: ("2 um", "-20 deg")}}
    )


@pytest.fixture(scope="module")
def drive():
    return small()


@pytest.fixture(scope="module")
def compensator(drive):
    return drive.compensator(residual="1 arcsec", torque_accuracy=0.2)


def output(drive, motor_angle, torque):
    angle = np.atleast_1d(motor_angle)
    found = solve(drive.stage, torque, angle, with_play=False).transmission_error[0]
    return angle / drive.ratio + found


@pytest.mark.parametrize("torque", [-90.0, -13.0, 2.0, 55.0])
def test_the_exact_output_stands_where_it_should(drive, compensator, torque):
    wanted = np.random.default_rng(4).uniform(-7.0, 7.0, 40)
    motor = [step(compensator, Memory(), angle, 0.0, torque, AMBIENT).motor_angle for angle in wanted]
    off = output(drive, motor, torque) - wanted
    assert np.abs(off).max() < 1.1 * ARCSEC
    assert np.abs(output(drive, drive.ratio * wanted, torque) - wanted).max() > 20.0 * ARCSEC


@pytest.mark.slow(8)
def test_a_tighter_residual_takes_a_larger_table_and_both_keep_theirs(drive):
    sizes = []
    for residual in ("4 arcsec", "2 arcsec", "1 arcsec"):
        made = drive.compensator(residual=residual)
        assert made.inverse.residual < float(residual.split()[0]) * ARCSEC
        sizes.append(made.size)
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.5 * sizes[-1]


def test_the_flank_changes_over_what_the_torque_is_known_to(drive, compensator):
    # Where the torque is as likely of either sign the output is expected in the middle of its play.
    memory, wanted = Memory(), 0.3
    middle = step(compensator, memory, wanted, 0.0, 0.0, AMBIENT)
    ends = [output(drive, middle.motor_angle, sign * 1e-3)[0] - wanted for sign in (-1.0, 1.0)]
    assert abs(sum(ends)) < 0.01 * (ends[1] - ends[0])
    assert middle.band == pytest.approx(0.5 * (ends[1] - ends[0]), rel=0.05)
    sure = step(compensator, memory, wanted, 0.0, SURE * 0.2, AMBIENT)
    assert sure.band < 0.05 * middle.band


def test_weights_are_the_mean_over_a_normal_distribution():
    torque = np.array([-3.0, -1.0, 0.0, 0.0, 2.0, 5.0])
    values, accuracy = np.array([-4.0, -3.0, -2.5, 1.0, 2.0, 2.5]), 0.8

    def straight(t):
        side = torque[:3] if t < 0.0 else torque[3:]
        found = values[:3] if t < 0.0 else values[3:]
        cell = 0 if t < side[1] else 1
        slope = (found[cell + 1] - found[cell]) / (side[cell + 1] - side[cell])
        return found[cell] + slope * (t - side[cell])

    for at, row in zip(torque, _normal_weights(torque, accuracy), strict=True):
        parts = [-math.inf, -1.0, 0.0, 2.0, math.inf]
        mean = sum(
            integrate.quad(lambda t, at=at: straight(t) * stats.norm.pdf(t, at, accuracy), a, b)[0]
            for a, b in itertools.pairwise(parts)
        )
        assert row @ values == pytest.approx(mean, abs=1e-8)


@given(
    way=st.lists(st.floats(-1e-4, 1e-4), min_size=1, max_size=40),
    load=st.floats(-90.0, 90.0),
    temperature=st.floats(270.0, 340.0),
)
@settings(max_examples=60, deadline=None)
def test_friction_is_that_of_the_fmu(compensator_with_friction, way, load, temperature):
    """Elements in parallel slip one after the other, the ith at i times the first one's torque (docs/theory/fmu.md)."""
    made, memory = compensator_with_friction, Memory()
    law, number = FRICTION.law(1), np.arange(1, FRICTION_ELEMENTS + 1)
    at_reference = law.coulomb + law.load_share * abs(load) + law.stribeck
    stiffness = 2.0 * at_reference / (law.presliding_angle * (FRICTION_ELEMENTS + 1))
    slides = at_reference * math.exp(-law.temperature_coefficient * (temperature - law.reference_temperature))
    most = slides * number / number.sum() / stiffness
    strains, angle = np.zeros(FRICTION_ELEMENTS), 0.0
    torque_of_teeth(made, memory, angle, 0.0, load, temperature)
    for turn in way:
        angle += turn
        teeth = torque_of_teeth(made, memory, angle, 0.0, load, temperature)
        strains = np.clip(strains + turn, -most, most)
        assert load - teeth == pytest.approx(stiffness * strains.sum(), abs=1e-3 * slides)


@pytest.fixture(scope="module")
def compensator_with_friction(drive):
    return drive.compensator(friction=FRICTION, residual="2 arcsec")


def test_a_reversal_is_remembered(drive, compensator_with_friction):
    """Under no load the flank that carries is that of the last way, once it was longer than presliding."""
    made = compensator_with_friction
    memory, motor = Memory(), []
    for angle in [0.0, 0.01, 0.02, 0.02 - 1e-7, 0.01, 0.0]:
        motor.append(step(made, memory, angle, 0.0, 0.0, AMBIENT).motor_angle / drive.ratio - angle)
    forward, back = motor[2], motor[4]
    play = float(drive.analyze(0.0, angles=90).backlash.mean())
    assert forward - back == pytest.approx(play, rel=0.3)
    assert forward > back
    assert motor[3] == pytest.approx(forward, abs=0.02 * play)


def test_wind_up_is_that_of_the_whole_drive(drive):
    stiffness = 1e5
    plain, soft = (drive.compensator(residual="4 arcsec", **more) for more in ({}, {"series_compliance": 1e-5}))
    for torque in (-60.0, 30.0):
        command = step(soft, Memory(), 0.7, 0.0, torque, AMBIENT)
        same = step(plain, Memory(), 0.7 - torque / stiffness, 0.0, torque, AMBIENT)
        assert command.motor_angle == pytest.approx(same.motor_angle, abs=1e-9 * abs(drive.ratio))


def followed(made, plant, memory, *, scatter=0.3 * ARCSEC, turns=8.0, points=600, every=1):
    """Errors of the output, with the compensator and without, while the motor obeys.

    An encoder looks on, every so many samples.
    """
    random, motor = np.random.default_rng(5), math.nan
    angle = math.pi / 3.0 * turns / 8.0 * (1.0 - np.cos(np.linspace(0.0, turns, points)))
    torque = np.where(np.diff(angle, append=angle[-1]) < 0.0, -1.0, 1.0) * RATED * (0.5 + 0.4 * np.cos(3.0 * angle))
    errors, plain, shown = [], [], math.nan
    for number, (wanted, load) in enumerate(zip(angle, torque, strict=True)):
        shown = shown if number % every == 0 else math.nan
        command = step(made, memory, wanted, 0.0, load, AMBIENT, motor, shown)
        motor = command.motor_angle
        real, ideal = output(plant, [motor, plant.ratio * wanted], load)
        shown = real + scatter * random.standard_normal()
        errors.append(real - wanted)
        plain.append(ideal - wanted)
    return np.array(errors), np.array(plain), command


def rms(values):
    return math.sqrt(np.mean(np.square(values)))


def test_with_an_encoder_a_right_model_stays(drive, compensator):
    memory = Memory()
    errors, plain, last = followed(compensator, drive, memory)
    assert rms(errors) < 0.02 * rms(plain)
    assert last.holds
    assert memory.applied[2:] == pytest.approx([1.0, 1.0], abs=0.05)


def test_a_wrong_index_fades_out_what_hangs_on_it(drive, compensator):
    memory = Memory(index=2.4)
    errors, plain, last = followed(compensator, drive, memory)
    half = len(errors) // 2
    assert rms(errors[half:]) < rms(plain[half:])
    assert last.gain < 0.2
    assert not last.holds
    assert rms(errors[half:]) < 2.0 * last.band


@pytest.mark.slow(10)
@pytest.mark.parametrize(("scatter", "every"), [(6.0 * ARCSEC, 1), (0.5 * ARCSEC, 10)])
def test_a_coarse_or_rare_measurement_shows_a_wrong_index(drive, compensator, scatter, every):
    made = dataclasses.replace(compensator, sensor=scatter)
    errors, plain, last = followed(made, drive, made.start(2.4), scatter=scatter, every=every, points=300)
    assert not last.holds
    assert last.gain < 0.2
    assert rms(errors) < rms(plain)


def left_of(made, plant, index, probability, load=0.6 * RATED):
    """Errors of a plant whose crank is at 0 at some angles, with the compensator and without, and the band."""
    wanted = np.random.default_rng(4).uniform(-7.0, 7.0, 40)
    found = [step(made, made.start(index, probability), one, 0.0, load, AMBIENT) for one in wanted]
    motor = np.append([one.motor_angle for one in found], plant.ratio * wanted)
    errors, plain = np.split(output(plant, motor, load) - np.tile(wanted, 2), 2)
    return errors, plain, found[0].band


@pytest.mark.parametrize("probability", [0.0, 0.5, 0.9])
def test_the_band_is_what_an_index_of_this_probability_leaves(drive, compensator, probability):
    """The index is right with this probability, else anywhere."""
    anywhere = np.random.default_rng(8).uniform(0.0, 2.0 * math.pi, 8)
    wrong = np.mean([left_of(compensator, drive, index, probability)[0] ** 2 for index in anywhere])
    right, _, band = left_of(compensator, drive, 0.0, probability)
    expected = probability * np.mean(right**2) + (1.0 - probability) * wrong
    assert band == pytest.approx(math.sqrt(expected), rel=0.3)


@pytest.mark.slow(8)
def test_the_band_of_a_kind_is_the_spread_of_its_drives():
    """Drives that the tolerances allow, none of which the compensator knows."""
    tolerances = cy.Tolerances(
        eccentricity={"tolerance": "6 um"},
        pin_radius={"tolerance": "4 um"},
        pin_pitch={"single": "4 um", "cumulative": "12 um"},
    )
    nominal = small(eccentricity="0 um")
    made = nominal.compensator(residual="4 arcsec", torque_accuracy=0.2, tolerances=tolerances)
    every = [left_of(made, nominal.sample(tolerances, seed), math.nan, 1.0) for seed in range(1000, 1012)]
    assert rms([errors for errors, _, _ in every]) == pytest.approx(every[0][2], rel=0.35)
    assert all(np.abs(errors).max() < np.abs(plain).max() for errors, plain, _ in every)


def test_another_drive_is_learned_where_it_can_be(compensator):
    other = small(pin_radius="-10 um", eccentricity="-3 um")
    errors, plain, last = followed(compensator, other, Memory())
    half = len(errors) // 2
    assert rms(errors) < rms(plain)
    assert rms(errors[half:]) < 0.2 * rms(plain[half:])
    assert not last.holds


def test_without_an_index_the_band_is_what_stays(drive, compensator):
    errors, plain, last = followed(compensator, drive, Memory(index=math.nan), scatter=math.nan)
    assert rms(errors) < rms(plain)
    assert rms(errors) == pytest.approx(last.band, rel=0.25)


@pytest.mark.parametrize("bad", [{"desired_angle": math.nan}, {"load_torque": math.inf}, {"temperature": math.nan}])
def test_no_number_gives_no_compensation(drive, compensator, bad):
    memory = Memory()
    step(compensator, memory, 0.4, 0.0, 10.0, AMBIENT)
    given = {"desired_angle": 0.4, "desired_speed": 0.0, "load_torque": 10.0, "temperature": AMBIENT} | bad
    command = step(compensator, memory, **given)
    assert command.motor_angle == drive.ratio * 0.4
    assert not command.holds
    assert command.band == LARGEST


def test_the_band_grows_with_what_a_fit_leaves_open(drive):
    surface = drive.surface.replace(covariance=np.array([[4e-12]]), covariance_of=("eccentricity",))
    known, unsure = (cy.Drive(drive.pair, s).compensator(residual="4 arcsec") for s in (drive.surface, surface))
    steps = [drive.replace(errors={"eccentricity": 4e-6 + by}).analyze(30.0).transmission_error for by in (0.0, 2e-6)]
    spread = rms(steps[1] - steps[0])
    bands = [step(one, Memory(), 0.3, 0.0, 30.0, AMBIENT).band for one in (known, unsure)]
    assert math.sqrt(bands[1] ** 2 - bands[0] ** 2) == pytest.approx(spread, rel=0.35)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"residual": "0 arcsec"}, r"residual = 0\.0: it must be finite and above zero"),
        ({"temperatures": ("40 degC", "20 degC")}, "temperatures"),
        ({"torque_accuracy": "5 mm"}, "torque_accuracy"),
        ({"stiffness": 1e9}, "stiffness"),
    ],
)
def test_what_makes_no_compensator_is_said(drive, options, words):
    with pytest.raises(cy.InputError, match=words):
        drive.compensator(**options)


def searched(made, plant, index, turns, spacing=None, load=0.6 * RATED):
    crank = np.linspace(0.3, 0.3 + 2.0 * math.pi * turns, 240)
    noise = 0.5 * ARCSEC * np.random.default_rng(6).standard_normal(crank.size)
    shown = output(plant, crank, load) + noise - index / plant.ratio
    return find_index(made, crank - index, shown, load, AMBIENT, spacing=spacing)


@pytest.mark.slow(3)
def test_the_index_is_found_and_said_to_be_sure(drive, compensator):
    for index in (0.7, 5.1):
        found = searched(compensator, drive, index, 1.5)
        assert found.angle == pytest.approx(index, abs=0.02)
        assert found.probability > 0.99
        assert found.residual < 1.5 * ARCSEC


@pytest.mark.slow(8)
def test_the_turn_of_a_drive_whose_teeth_differ_is_found():
    plant = small(
        tooth_cumulative_pitch={1: ("6 um", "20 deg"), 2: ("4 um", "0 deg")}, pin_radial={1: ("3 um", "0 deg")}
    )
    made = plant.compensator(residual="2 arcsec")
    found = searched(made, plant, 2.0 * math.pi * 7, 3.0, spacing=2.0 * math.pi)
    assert found.angle == pytest.approx(2.0 * math.pi * 7, abs=1e-9)
    assert found.probability > 0.99


def test_an_index_that_another_drive_does_not_show_is_not_sure(compensator):
    found = searched(compensator, small(tooth_cumulative_pitch={3: ("8 um", "0 deg")}), 1.0, 1.1)
    assert found.residual > 5.0 * ARCSEC
    assert found.probability < 0.99


def test_too_short_a_way_is_refused(drive, compensator):
    with pytest.raises(cy.InputError, match=r"the crank must turn by 6\.28 rad or more"):
        searched(compensator, drive, 0.0, 0.5)


def test_a_table_without_ripple_finds_no_index(drive):
    made = drive.compensator(residual="0.1 deg")
    assert made.ripple_variance.max() == 0.0
    with pytest.raises(cy.InputError, match="its table has no ripple to find the index by"):
        searched(made, drive, 0.0, 1.5)
