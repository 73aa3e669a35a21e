import dataclasses
import itertools
import json

import numpy as np
import pytest
from boundary_wear import Mesh
from clockworks import kinematic_drive
from common import ARCSEC, WEAR_PAIR, make_pair

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.draw import figure as plots_of
from cycloid_fmu.draw import wear_plots
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import write_pair
from cycloid_fmu.geometry.profile import flank_normals, flank_points
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.surface import at_own_age, nominal_surface, surface_after
from cycloid_fmu.wear import progress as wear
from cycloid_fmu.wear.law import Load, Regression, duty_cycle, parse_wear_law, read_duty_cycle
from cycloid_fmu.wear.life import coefficient_warning, run_wear, surface_of_run, wear_figures
from cycloid_fmu.wear.progress import Sweep, accuracy, surface_loss, wear_model, wear_rate, wear_states, worn_surface

PAIR = WEAR_PAIR.replace("[modification]", 'contact_law = "as_printed"\n[modification]')
LAW = """format = "cycloid-wear/1"
[wear]
pins = "fixed"
[wear.regression]
pressure_viscosity = "2.73e-8 1/Pa"
roughness_gear = "0.4 um"
roughness_pin = "0.4 um"
"""
CONSTANT = LAW.split("[wear.regression]")[0] + 'coefficient = "1e-18 m^2/N"\n'
TURNS = 3e6


def law(text=LAW, **changes):
    return parse_wear_law(text, "wear.toml").replace(**changes)


def load(torque=-400.0, turns=1.0):
    return Load(torque=torque, crank_turns=turns)


def model(pair=None, text=LAW, loads=(load(),), elements=(800, 400), surface=None, **changes):
    pair = pair or make_pair(PAIR)
    return wear_model(DriveValue(pair, surface or nominal_surface(pair)), law(text, **changes), loads, *elements)


@pytest.fixture(scope="module")
def run():
    """A history of the wear pair, its model and its rate when new."""
    worn = model(text=CONSTANT, coefficient=5e-17, elements=(400, 200))
    return worn, list(wear_states(worn, 4e5)), wear_rate(worn, worn.surface)


@pytest.mark.parametrize(
    ("torque", "gear", "pin", "free", "printed"),
    [(-400.0, 50.47e-6, 57.58e-6, 0.598e-6, 62.7e-6), (-200.0, 12.78e-6, 17.47e-6, 0.1314e-6, 12.95e-6)],
)
def test_depths_without_update(torque, gear, pin, free, printed):
    """3·10⁶ turns, the law as printed: 400 N·m on one disc, or on two as the paper's T_c = 2ΣFL has it.

    The gear's depth by the paper's slip distance is the bounded one within a quarter.
    """
    fixed, turning = (model(pins=pins, loads=(load(torque),)) for pins in ("fixed", "free"))
    one, other = wear_rate(fixed, fixed.surface), wear_rate(turning, turning.surface)
    assert TURNS * one.depth.gear.max() == pytest.approx(gear, rel=1e-3)
    assert TURNS * one.depth.pin.max() == pytest.approx(pin, rel=1e-3)
    assert TURNS * other.depth.pin.max() == pytest.approx(free, rel=2e-3)
    assert (other.depth.pin == other.depth.pin[0, 0, 0]).all()
    assert wear.depth_as_printed(fixed, TURNS)[1].max() == pytest.approx(printed, rel=2e-3)


def test_the_paper_s_own_depths():
    """As printed the gear's mean is 17.0 and the pin's off the pole 22 µm, for 21; 60 µm set α at 400 and 200 N·m."""
    printed = model()
    figures = wear_figures(
        printed, [wear.WearState(TURNS, printed.unworn, printed.unworn)], wear_rate(printed, printed.surface)
    )
    as_printed = figures["as_printed"]
    assert as_printed["gear_depth_mean"] == pytest.approx(17.0e-6, rel=0.01)
    assert as_printed["pin_depth_mean_off_pole"] == pytest.approx(22e-6, rel=0.02)
    milder = law().regression.replace(pressure_viscosity=2.22e-8)
    half = model(loads=(load(-200.0),), regression=milder)
    _, gear, _ = wear.depth_as_printed(half, TURNS)
    assert gear.max() == pytest.approx(59.5e-6, rel=2e-3)
    assert 21e-6 * 1.4043 / (2 * np.pi) == pytest.approx(4.69e-6, rel=1e-3)


def test_the_pin_s_depth_as_printed_is_what_the_grid_makes_it():
    """2a|σ_2| has a pole: finer crank angles find ever larger depths, the bounded ones stay."""
    found = []
    for angles in (50, 200, 800, 3200):
        fine = dataclasses.replace(
            model(), sweep=Sweep(np.arange(angles) / angles * 2 * np.pi / 40, teeth_alike=True, pins_alike=True)
        )
        found.append(
            [wear.depth_as_printed(fine, TURNS)[2].max(), TURNS * wear_rate(fine, fine.surface).depth.pin.max()]
        )
    printed, bounded = np.array(found).T
    assert printed[-1] > 4 * printed[0]
    np.testing.assert_allclose(bounded[1:], bounded[-1], rtol=0.01)


def test_the_bounded_depth_converges_with_the_grid():
    """First order or better in the elements' length."""
    rates = [wear_rate(m, m.surface).depth for m in (model(elements=(k, k // 2)) for k in (200, 400, 800, 3200))]
    for body in ("gear", "pin"):
        error = [abs(getattr(r, body).max() / getattr(rates[-1], body).max() - 1) for r in rates[:-1]]
        assert error[0] > 2 * error[1] > 4 * error[2]
        assert error[2] < 0.02


def test_wear_volume_is_conserved(run):
    """The area between the new and the worn outline of a tooth and a pin is k_0 ∫ F |v_12|."""
    worn, _, new = run
    turns = 5e4
    surface = worn_surface(worn, surface_loss(worn, new.depth * turns, new.half_width))
    alpha = rigid_problem(DriveValue(worn.pair, surface)).deviations.flank_alpha[1:-1]
    base, normal = (np.array([1, 1j]) @ np.stack(f(worn.pair, alpha)) for f in (flank_points, flank_normals))
    round_ = np.exp(1j * np.pi * ((np.arange(200) + 0.5) / 200 - 0.5))
    for bodies, outline, deviation in (
        (39, (base, normal), surface.gear_deviation[0, 0, :, 0]),
        (40, (3e-3 * round_, round_), surface.pin_deviation[0, :, 0]),
    ):
        assert deviation.min() < -0.5e-6
        ring = np.concatenate([outline[0], (outline[0] + deviation * outline[1])[::-1]])
        area = abs(0.5 * (np.conj(ring) * np.roll(ring, -1)).imag.sum())
        assert area * 10e-3 * bodies == pytest.approx(new.volume * turns, rel=1e-3, abs=0.0)


def test_a_rate_s_depths_hold_its_volume():
    for changes in ({}, {"pins": "free"}, {"loads": (load(), load(300.0))}):
        one = model(elements=(100, 50), **changes)
        rate = wear_rate(one, one.surface)
        assert rate.depth.gear.sum() * one.gear_element * 0.01 == pytest.approx(rate.volume, rel=1e-12, abs=0.0)
        around = 2.0 if one.law.pins == "free" else 1.0
        assert around * rate.depth.pin.sum() * one.pin_element * 0.01 == pytest.approx(rate.volume, rel=1e-12, abs=0.0)


def test_no_load_or_no_turns_no_wear():
    for idle, turns in ((model(loads=(load(0.0),)), 1e6), (model(), 0.0)):
        states = list(wear_states(idle, turns))
        assert states[-1].crank_turns == turns
        assert states[-1].depth.largest == 0.0
        figures = wear_figures(idle, states, wear_rate(idle, idle.surface))
        assert figures["updated"]["gear_depth_max"] == figures["linear"]["pin_volume"] == 0.0


def test_below_one_step_depth_is_proportional_to_turns():
    short = model(elements=(400, 200))
    one, two = (list(wear_states(short, n)) for n in (50.0, 100.0))
    assert len(one) == len(two) == 2
    assert two[-1].depth.largest == pytest.approx(2 * one[-1].depth.largest, rel=1e-3)


def test_depth_is_proportional_to_the_coefficient_and_the_work():
    """With a constant k_0 the volume is k_0 times the sliding work: Archard's law itself."""
    rate = wear_rate(one := model(text=CONSTANT, elements=(100, 50)), one.surface)
    assert rate.volume == pytest.approx(1e-18 * rate.sliding_work, rel=1e-12, abs=0.0)


def test_regression_scales_as_printed():
    base = Regression(pressure_viscosity=2e-8, roughness_gear=4e-7, roughness_pin=3e-7)
    modulus = 206e9 / 2 / (1 - 0.09)
    k = wear.regression_coefficient(base, 1e5, 3e-3, modulus)
    printed = 3.981e29 / modulus * (1e5 / modulus / 3e-3) ** 1.219 * (2e-8 * modulus) ** -7.377 * (5e-7 / 3e-3) ** 1.589
    assert k == pytest.approx(printed, rel=1e-6, abs=0.0)
    assert wear.regression_coefficient(base, 2e5, 3e-3, modulus) / k == pytest.approx(2**1.219)
    assert wear.regression_coefficient(base, 1e5, 6e-3, modulus) / k == pytest.approx(2 ** -(1.219 + 1.589))


@pytest.mark.parametrize(
    ("output", "discs"),
    [("gear", 1), ("ring", 2), *(pytest.param(*one, marks=pytest.mark.slow(1)) for one in (("gear", 2), ("ring", 1)))],
)
def test_one_pitch_stands_for_a_turn_of_the_output(output, discs):
    """Pins and teeth that are alike wear alike, so the short sweep and the long one, which mixes them, agree."""
    pair = make_pair(PAIR, output=output, discs=discs)
    short = model(pair, elements=(200, 100), text=CONSTANT)
    long = dataclasses.replace(
        short,
        sweep=Sweep(
            np.arange(39 * 40 * 6 + 1) / (39 * 40 * 6 + 1) * 2 * np.pi * (39 if output == "gear" else 40), False, False
        ),
    )
    one, other = (wear_rate(m, m.surface, workers=2) for m in (short, long))
    assert other.volume == pytest.approx(one.volume, rel=1e-3, abs=0.0)
    for body in ("gear", "pin"):
        np.testing.assert_allclose(
            getattr(other.depth, body), getattr(one.depth, body), atol=0.01 * getattr(one.depth, body).max()
        )


def test_a_pin_that_stands_out_wears_most():
    pair = make_pair(PAIR)
    radial = np.zeros(40)
    radial[7] = -2e-6
    errors = dataclasses.replace(nominal_surface(pair), pin_radial=radial)
    one = model(pair, surface=errors, elements=(200, 100))
    assert not one.sweep.pins_alike
    assert one.sweep.teeth_alike
    depth = wear_rate(one, one.surface, workers=2).depth
    assert depth.pin.max(axis=(1, 2)).argmax() == 7
    assert (depth.gear == depth.gear[:1, :1]).all()


def test_discs_with_the_same_teeth_wear_a_pin_alike():
    """Half a crank turn later each disc is where the other was, so the mean over the discs is the wear by each of them.

    So a pin's depth is the same whichever disc's loads are counted: half the torque on one disc only.
    """
    radial = np.zeros(40)
    radial[[3, 23]] = -2e-6  # alike half a turn apart, as the discs are
    rates = []
    for discs, torque in ((1, -400.0), (2, -800.0)):
        pair = make_pair(PAIR, discs=discs)
        one = model(
            pair,
            surface=dataclasses.replace(nominal_surface(pair), pin_radial=radial),
            loads=(load(torque),),
            elements=(200, 100),
        )
        rates.append(wear_rate(one, one.surface).depth)
    for body in ("gear", "pin"):
        alone, both = (getattr(r, body)[0] for r in rates)
        np.testing.assert_allclose(both, alone, atol=1e-3 * alone.max())


def test_a_duty_cycle_mixes_its_loads():
    both = [load(-400.0, 3.0), load(300.0, 1.0)]
    rates = [
        wear_rate(m, m.surface)
        for m in (model(loads=loads, elements=(200, 100)) for loads in (both, both[:1], both[1:]))
    ]
    expected = rates[1].depth * 0.75 + rates[2].depth * 0.25
    for body in ("gear", "pin"):
        np.testing.assert_allclose(getattr(rates[0].depth, body), getattr(expected, body), rtol=1e-9, atol=1e-22)
    # The two directions wear the two flanks of a tooth: mirror images at the same load.
    mirrored = [
        wear_rate(m, m.surface).depth for m in (model(loads=(load(t),), elements=(200, 100)) for t in (-300.0, 300.0))
    ]
    np.testing.assert_allclose(
        mirrored[0].gear[0, 0, :, 0], mirrored[1].gear[0, 0, ::-1, 0], atol=0.01 * mirrored[0].gear.max()
    )


def test_wear_limits_itself(run):
    """With the profile updated it wears less, and in no half of a step more than the largest step."""
    _, states, new = run
    assert states[-1].depth.largest < 0.6 * (new.depth * 4e5).largest
    assert (np.diff([s.depth.largest for s in states]) <= 2.0e-6).all()


@pytest.mark.slow(2)
def test_halving_every_step_changes_what_the_history_says(run):
    """A run in half as large steps differs from one by less than that, and its own difference is smaller."""
    _, states, _ = run
    assert 0.0 < states[-1].difference < 0.05 * states[-1].depth.largest
    finer = model(text=CONSTANT, coefficient=5e-17, elements=(400, 200), largest_step=0.25e-6)
    *_, last = wear_states(finer, 4e5)
    assert (last.depth + states[-1].depth * -1.0).largest < states[-1].difference
    assert last.difference < 0.5 * states[-1].difference


def test_rates_that_lead_to_a_step_s_middle_need_few_crank_angles(run, monkeypatch):
    """With those of all crank angles the depth changes by less than half of what halving the steps changes."""
    worn, states, _ = run
    monkeypatch.setattr(wear, "_LEADING", 1)
    *_, all_angles = wear_states(worn, 4e5)
    change = (all_angles.depth + states[-1].depth * -1.0).largest
    assert 0.0 < change < 0.5 * states[-1].difference


def updated_depths(elements, turns=4e5, angles=32, **changes):
    """Depths of the first tooth and pin, each element's width of the coarsest, at the end of a history."""
    one = model(text=CONSTANT, coefficient=5e-17, elements=(elements, elements // 2), **changes)
    sweep = Sweep(np.arange(angles) / angles * 2 * np.pi / 40, teeth_alike=True, pins_alike=True)
    *_, last = wear_states(dataclasses.replace(one, sweep=sweep), turns)
    return [
        d.reshape(-1, d.size // n).mean(axis=1) for d, n in ((last.depth.gear[0, 0], 200), (last.depth.pin[0], 100))
    ]


def check_convergence(depths):
    """First order or better: each halving of the elements at least halves the mean difference from the finest."""
    for body in (0, 1):
        finest = depths[-1][body]
        error = [np.abs(d[body] - finest).sum() / finest.sum() for d in depths[:-1]]
        assert all(after < 0.5 * before for before, after in itertools.pairwise(error))
    return error


def test_the_updated_depth_converges_with_the_grid():
    error = check_convergence([updated_depths(k) for k in (200, 400, 800)])
    assert error[-1] < 0.03


@pytest.mark.slow(10)
def test_the_updated_depth_converges_with_the_grid_far():
    """At the 800 elements that are the default the profile is within a hundredth of the finest."""
    error = check_convergence([updated_depths(k, angles=128) for k in (200, 400, 800, 1600, 3200)])
    assert error[-2] < 0.01


@pytest.mark.slow(3)
@pytest.mark.parametrize(("teeth", "eccentricity"), [(14, "3.4 mm"), (39, "1.3 mm")])
def test_few_crank_angles_stand_for_all_where_nothing_is_alike(monkeypatch, teeth, eccentricity):
    """The rates of a worn drive, felt over a contact's width, err by less than a hundredth of the deepest."""
    pair = make_pair(PAIR, gear_teeth=teeth, pins=teeth + 1, eccentricity=eccentricity)
    rng = np.random.default_rng(5)
    errors = {
        "pin_radial": rng.normal(size=teeth + 1) * 1e-6,
        "tooth_cumulative_pitch": rng.normal(size=(1, teeth)) * 1e-6,
    }
    for names in (["pin_radial"], list(errors)):
        surface = dataclasses.replace(nominal_surface(pair), **{name: errors[name] for name in names})
        few = model(pair, surface=surface)
        new = wear_rate(few, few.surface, workers=2)
        worn = worn_surface(few, surface_loss(few, new.depth * (4e-6 / new.depth.largest), new.half_width))
        monkeypatch.setattr(wear, "ANGLES", tuple(10 * n for n in wear.ANGLES))
        many = model(pair, surface=surface)
        monkeypatch.undo()
        assert many.sweep.crank_angle.size > 9 * few.sweep.crank_angle.size
        one, other = (wear_rate(m, worn, workers=2).depth for m in (few, many))
        felt, error = (surface_loss(few, d, new.half_width) for d in (other, one + other * -1.0))
        for body in ("gear", "pin"):
            assert np.abs(getattr(error, body)).max() < 1e-2 * np.abs(getattr(felt, body)).max()


@pytest.mark.slow(3)
def test_the_worn_surface_is_that_of_boundary_elements():
    """6 and 8 µm deep: without Hertz's pressure and averages it is the same within what the average blunts.

    What contacts removed from single elements, which nothing feels, was a tenth deeper.
    """
    pair, dose = make_pair(PAIR), 3e-11
    gear, pin, volume = Mesh(pair, 300).wear(-400.0, dose, 40)
    *_, last = wear_states(model(text=CONSTANT, elements=(900, 600)), dose / 1e-18)
    depths = last.depth.gear[0, 0].reshape(300, 3).mean(axis=1), last.depth.pin[0].reshape(300, 2).mean(axis=1)
    for depth, other, most in zip(depths, (gear, pin), (0.05, 0.08), strict=True):
        assert other.max() > 5e-6
        assert depth.max() == pytest.approx(other.max(), rel=0.05)
        assert np.abs(depth - other).sum() < most * other.sum()
    length = 40 * np.pi * pair.pin_radius * pair.face_width
    assert last.depth.pin.mean() * length == pytest.approx(volume, rel=0.01)


def test_figures_are_those_of_the_written_surface(run):
    worn, states, new = run
    figures, surface = wear_figures(worn, states, new)["updated"], surface_of_run(worn, states)
    for body, length in (("gear", worn.tooth_arc * 39), ("pin", np.pi * 3e-3 * 40)):
        lost = getattr(worn.surface, f"{body}_deviation") - getattr(surface, f"{body}_deviation")
        assert lost.min() >= 0.0
        assert figures[f"{body}_depth_max"] == pytest.approx(lost.max(), rel=1e-12)
        assert figures[f"{body}_volume"] == pytest.approx(lost.mean() * length * 10e-3, rel=1e-12)


def test_a_duty_cycle_that_wears_more_than_a_step_goes_in_order():
    """Clockwise and counter-clockwise loads wear different flanks, so each flank wears under its own load only."""
    one_way = model(loads=(load(-300.0),), elements=(400, 200))
    *_, alone = wear_states(one_way, 4e5)
    both = model(loads=(load(-300.0, 4e5), load(300.0, 2e5)), elements=(400, 200))
    states = list(wear_states(both, 6e5))
    half = next(s for s in states if s.crank_turns == 4e5).depth
    np.testing.assert_allclose(half.gear, alone.depth.gear, atol=1e-11)
    gear, pin = states[-1].depth.gear[0, 0, :, 0], states[-1].depth.pin[0, :, 0]
    np.testing.assert_allclose(gear[:200], half.gear[0, 0, :200, 0], atol=1e-11)
    *_, shorter = wear_states(one_way, 2e5)
    np.testing.assert_allclose(gear[:199:-1], shorter.depth.gear[0, 0, :200, 0], atol=0.03 * gear.max())
    np.testing.assert_allclose(pin[:99:-1], shorter.depth.pin[0, :100, 0], atol=0.03 * pin.max())


@pytest.mark.slow(3)
def test_the_order_of_loads_matters_less_the_shorter_the_cycle():
    """A heavy load before a light one wears otherwise than after it; short cycles wear as the mix of both does."""

    def end(loads, turns):
        *_, last = wear_states(model(loads=loads, elements=(200, 100)), turns)
        return last.depth

    def apart(count):
        heavy, light = load(-400.0, 2e5 / count), load(-100.0, 2e6 / count)
        one, other = end((heavy, light), 2.2e6), end((light, heavy), 2.2e6)
        return (one + other * -1.0).largest

    once, often = apart(1), apart(5)
    assert once > 0.1e-6
    assert often < 0.5 * once


def test_a_history_ends_at_the_wear_limit():
    short = model(elements=(200, 100), limit=1e-6)
    *_, last = wear_states(short, 1e9)
    assert last.crank_turns < 1e9
    assert last.depth.largest == pytest.approx(1e-6, rel=0.15)


def test_wear_costs_accuracy_by_what_is_lost(run):
    """Backlash grows by less than the depths allow for, and the mean error leaves it on the worn side."""
    worn, states, _ = run
    curve = accuracy(worn, [s.depth for s in states])
    assert (np.diff(curve.backlash) > 0).all()
    depth = states[-1].depth.gear.max() + states[-1].depth.pin.max()
    largest_arm = 1.3e-3 * 39
    assert 0.3 * depth / largest_arm < curve.backlash[-1] - curve.backlash[0] < 1.2 * depth / largest_arm
    assert curve.transmission_error[-1] < curve.transmission_error[0] < 0
    # Lost motion is the play and the deflection by 3 % of the load on both sides; less than by the whole load on one.
    bent = curve.lost_motion - curve.backlash
    assert (bent > 0.0).all()
    assert (bent < -curve.transmission_error - 0.5 * curve.backlash).all()


def test_the_worn_surface_travels(run, tmp_path):
    """Through its file, in time, into the FMU's model, and as any surface into an analysis."""
    worn, states, _ = run
    surface = surface_of_run(worn, states)
    write_surface(surface, tmp_path / "worn.nc")
    read = read_surface(tmp_path / "worn.nc")
    assert read.origin == "worn"
    assert read.attributes["crank_turns"] == 4e5
    for name in ("gear_deviation", "pin_deviation", "gear_curvature", "pin_curvature"):
        assert (getattr(read, name) == getattr(surface, name)).all()
        assert (getattr(read.life, name) == getattr(surface.life, name)).all()
    assert (read.life.crank_turns == [s.crank_turns for s in states]).all()
    theta = worn.sweep.crank_angle[::80]
    for turns in (0.0, 1e5, 4e5):
        at = surface_after(read, turns)
        drive = kinematic_drive(DriveValue(*at_own_age(worn.pair, at)))
        drive.torque = -400.0
        expected = solve(DriveValue(worn.pair, at), -400.0, theta)
        found, play = [], []
        for angle in theta:
            drive.crank_angle = float(angle)
            drive.advance()
            found.append(drive.transmission_error)
            play.append(drive.backlash)
        np.testing.assert_allclose(found, expected.transmission_error[0], atol=1e-3 * ARCSEC)
        np.testing.assert_allclose(play, expected.backlash, atol=1e-3 * ARCSEC)
    assert np.abs(surface_after(read, 0.0).gear_deviation).max() == 0.0
    assert (surface_after(read, 4e5).gear_deviation == read.gear_deviation).all()
    with pytest.raises(edge.InputError, match="between 0 and 400000"):
        surface_after(read, 5e5)


@pytest.mark.slow(10)
def test_fmus_of_a_worn_drive_at_its_crank_turns(run, command, tmp_path):
    """From the command line, one FMU for each; without the option, one of the end of the life."""
    worn, states, _ = run
    surface = surface_of_run(worn, states)
    write_surface(surface, tmp_path / "worn.nc")
    write_pair(worn.pair, tmp_path / "pair.toml")
    given = ("cycloid-fmu", "build", "pair.toml", "--surface", "worn.nc", "-o", "worn.fmu")
    for more in ((), ("--crank-turns", "0", "--crank-turns", "1.5e5")):
        done = command(*given, *more)
        assert done.returncode == 0, done.stderr
    for name, turns in (("worn", 4e5), ("worn-0000", 0.0), ("worn-0001", 1.5e5)):
        found = cy.simulate_fmu(tmp_path / f"{name}.fmu", crank_angle=[0.0, 0.1], torque=-400.0)["transmission_error"]
        expected = solve(DriveValue(worn.pair, surface_after(surface, turns)), -400.0, [0.0, 0.1]).transmission_error[0]
        assert found == pytest.approx(expected, abs=1e-3 * ARCSEC)
    done = command(*given, "--crank-turns", "5e5")
    assert done.returncode == 2
    assert "--crank-turns = 500000.0: it must be between 0 and 400000, the end of the life" in done.stderr


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (('pressure_viscosity = "2.73e-8 1/Pa"\n', ""), "[wear.regression] pressure_viscosity is missing."),
        (('roughness_pin = "0.4 um"\n', ""), "[wear.regression] roughness_pin is missing."),
        (('"2.73e-8 1/Pa"', '"2.73e-8"'), "write one number with a decimal point, a space and a unit"),
        (('"2.73e-8 1/Pa"', '"-2.73e-8 1/Pa"'), "greater than 0"),
        (('"fixed"', '"loose"'), "'fixed' or 'free'"),
        (("[wear.regression]", 'coefficient = "1e-18 m^2/N"\n[wear.regression]'), "either coefficient"),
        (('"fixed"', '"fixed"\nlimit = "1 mm"'), "limit"),
        (('"fixed"', '"fixed"\nlargest_step = "0 um"'), "above zero"),
        (("cycloid-wear/1", "cycloid-wear/2"), "cycloid-wear/1"),
    ],
)
def test_bad_wear_files_get_a_sentence(change, sentence):
    with pytest.raises(edge.InputError) as said:
        parse_wear_law(LAW.replace(*change), "w.toml")
    assert sentence in str(said.value)
    assert str(said.value).startswith("w.toml: ")
    assert len(str(said.value)) < 250


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("torque [N*m],crank_turns [1]\n-400,-5\n", "line 2: crank_turns = -5: it must not be below zero"),
        ("torque [N*m],crank_turns [1]\n-400,nan\n", 'line 2: crank_turns = "nan": it must be a finite number'),
        ("torque [N*m],crank_turns [1]\nmuch,1\n", 'torque = "much"'),
        ("torque [N*m],crank_turns [1]\n-400\n", 'crank_turns = ""'),
        ("torque,crank_turns [1]\n", "has no unit"),
        ("torque [mm],crank_turns [1]\n", "measures something else"),
        ("torque [N*m],crank_turns [1]\n1,0\n", "add up to zero"),
        ("", 'no column "torque [N*m]"'),
    ],
)
def test_bad_duty_cycles_get_a_sentence(table, sentence, tmp_path):
    (tmp_path / "duty.csv").write_text(table)
    with pytest.raises(edge.InputError) as said:
        read_duty_cycle(tmp_path / "duty.csv")
    assert sentence in str(said.value)
    assert "duty.csv" in str(said.value)


def test_duty_cycles_come_from_one_place(tmp_path):
    (tmp_path / "duty.csv").write_text("torque [kN*m],crank_turns [1]\n-0.4,1e6\n0.1,2e6\n\n")
    pair = make_pair(rated_torque="181 N*m")
    loads, turns = duty_cycle(law(), None, None, tmp_path / "duty.csv", "w.toml", pair)
    assert [(one.torque, one.crank_turns) for one in loads] == [(-400.0, 1e6), (100.0, 2e6)]
    assert turns == 3e6
    stated = LAW.replace("[wear.reg", '[[wear.duty]]\ntorque = "-400 N*m"\ncrank_turns = 1e6\n[wear.reg')
    assert duty_cycle(law(stated), None, 5e6, None, "w.toml", pair)[1] == 5e6
    assert duty_cycle(law(), None, 5e6, None, "w.toml", pair) == ((Load(torque=181.0, crank_turns=1.0),), 5e6)
    twice = r"^w\.toml: a torque and \[\[wear\.duty\]\] state the load; keep one of them\.$"
    with pytest.raises(edge.InputError, match=twice):
        duty_cycle(law(stated), -400.0, 5e6, None, "w.toml", pair)
    with pytest.raises(edge.InputError, match=r"^torque is missing; give it, or state \[pair\] rated"):
        duty_cycle(law(), None, 5e6, None, "w.toml", make_pair())
    with pytest.raises(edge.InputError, match=r"^crank_turns = -1\.0: it must be zero or above"):
        duty_cycle(law(), -400.0, -1.0, None, "w.toml", pair)


def test_absurd_coefficients_are_named():
    """m²/N mistaken for mm²/N, and a viscosity coefficient per MPa."""
    wild = model(text=CONSTANT, coefficient=1e-12)
    assert "[wear] coefficient = 1e-12 m²/N" in coefficient_warning(1e-12, wild, "w.toml")
    regression = law().regression.replace(pressure_viscosity=2.73e-9)
    odd = model(regression=regression)
    assert "pressure_viscosity = 2.73e-09" in coefficient_warning(
        wear_rate(odd, odd.surface).coefficient, odd, "w.toml"
    )
    assert coefficient_warning(1e-17, model(), "w.toml") is None


def test_the_command_wears_a_drive(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    (tmp_path / "wear.toml").write_text(LAW.replace('"fixed"', '"fixed"\nfriction_coefficient = 0.05'))
    words = ["pair.toml", "--wear", "wear.toml", "--torque", "-400 N*m", "--crank-turns", "1e5", "-o", "worn.nc"]
    run = command("cycloid-fmu", "wear", *words, "--json")
    assert run.returncode == 0, run.stderr

    whole = model(friction_coefficient=0.05)
    states, new = list(wear_states(whole, 1e5)), wear_rate(whole, whole.surface)
    figures = wear_figures(whole, states, new)
    assert json.loads(run.stdout) == json.loads(edge.json_text(figures))
    worn = read_surface(tmp_path / "worn.nc")
    assert (worn.gear_deviation == worn_surface(whole, states[-1].depth).gear_deviation).all()
    assert (worn.life.crank_turns == [s.crank_turns for s in states]).all()
    assert figures["linear"]["gear_depth_max"] == pytest.approx(50.47e-6 / 30, rel=0.01)
    assert figures["updated"]["gear_depth_max"] < figures["linear"]["gear_depth_max"]
    assert figures["sliding_loss"] == pytest.approx(0.05 * figures["sliding_work"] / (400 * 2 * np.pi / 39))
    plots_of.save(wear_plots.plot_wear(whole, states, new, figures), tmp_path / "wear.png")
    assert (tmp_path / "wear.png").stat().st_size > 50000


@pytest.mark.parametrize(
    ("coefficient", "words", "sentence"),
    [
        ("1e-12 m^2/N", ["--torque", "-400 N*m", "--crank-turns", "1e6"], "mm deep, and the tooth is 5.133 mm thick"),
        ("1e-18 m^2/N", ["--crank-turns", "1e6"], "--torque is missing; give it, or state [pair] rated_torque"),
        ("1e-18 m^2/N", ["--torque", "-400 N*m"], "--crank-turns is missing"),
        ("1e-18 m^2/N", ["--torque", "-400 N*m", "--crank-turns", "-1"], "zero or above"),
        ("1e-18 m^2/N", ["--torque", "-400", "--crank-turns", "1"], "--torque"),
        ("1e-18 m^2/N", ["--torque", "-400 N*m", "--crank-turns", "1", "-o", "worn.csv"], "must end in .nc"),
    ],
)
def test_the_command_says_what_is_wrong(command, coefficient, words, sentence, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    (tmp_path / "wear.toml").write_text(CONSTANT.replace("1e-18 m^2/N", coefficient))
    run = command("cycloid-fmu", "wear", "pair.toml", "--wear", "wear.toml", *words)
    assert (run.returncode, run.stderr.count("\n")) == (2, 1)
    assert sentence in run.stderr


@pytest.mark.parametrize(("turns", "noted"), [(1e3, True), (2e5, False)])
def test_light_wear_says_what_the_average_takes_from_the_deepest_point(turns, noted):
    """The depth in proportion to the turns is exact while the wear is far below the new drive's deformation."""
    pair = make_pair(PAIR)
    worn = run_wear(
        DriveValue(pair, nominal_surface(pair)), law(CONSTANT, coefficient=5e-17), (load(),), turns, "wear.toml"
    )
    exact, averaged = (worn.figures[kind]["pin_depth_max"] for kind in ("linear", "updated"))
    notes = [note for note in worn.notes if "averaged over a contact's width" in note]
    assert len(notes) == noted
    assert not noted or f"{1.0 - averaged / exact:.0%} on the pin" in notes[0]


def test_an_interrupted_run_says_how_far_it_was():
    def interrupt(turns):
        if turns > 0.0:
            raise KeyboardInterrupt

    pair, short = make_pair(PAIR), law(CONSTANT, coefficient=5e-17)
    with pytest.raises(KeyboardInterrupt, match=r"^Interrupted: .* of 1e\+06 crank turns are done\.$"):
        run_wear(DriveValue(pair, nominal_surface(pair)), short, (load(),), 1e6, "w.toml", progress=interrupt)


def test_errors_a_pair_states_are_part_of_it():
    stated = make_pair(PAIR + '[errors]\npin_radial = { order_1 = ["1 um", "0 deg"] }\n')
    one = wear_model(DriveValue.as_stated(stated), law(), (load(),), 100, 50)
    assert not one.sweep.pins_alike
    assert one.sweep.crank_angle[-1] < 2 * np.pi
