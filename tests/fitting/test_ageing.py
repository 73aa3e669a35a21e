"""Ageing drives: wear from dated figures, forecasts with their stated coverage, and the twin."""

import datetime
import itertools
import json

import ageing_lives
import numpy as np
import pytest
import second_drive
from common import EXAMPLES
from scipy.stats import binom

import cycloid_fmu as cy
import fitting
from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import write_pair
from cycloid_fmu.surfaces.surface import surface_after
from cycloid_fmu.wear.law import Load, WearLaw
from fitting.ageing import posterior as posterior_module
from fitting.ageing.forecast import ALARM, QUANTILES, forecast
from fitting.ageing.history import History, measured, read_history
from fitting.ageing.life import LifeFigures, life_figures, with_clearance
from fitting.ageing.posterior import Measured, Prior, posterior, scores

HOUR, ARCSEC = 3600.0, edge.ARCSEC
LAW = WearLaw(pins="free", coefficient="1e-18 m^2/N", largest_step="3 um")
LOADS = (Load(torque=-181.0, crank_turns=0.7), Load(torque=120.0, crank_turns=0.3))
LEVELS = (0.5, 0.9, 0.95)
SIZES = {"pin_circle_radius": "64 mm", "pin_radius": "3 mm", "eccentricity": "1.3 mm", "face_width": "10 mm"}
MODIFIED = {"isometric": "-15 um", "offset": "-40 um"}


def pair_of(teeth, **more):
    return cy.Pair(gear_teeth=teeth, **SIZES, rated_torque="181 N*m", modification=MODIFIED, **more)


def straight(slope=2e11, by_clearance=None):
    """A life whose figures (arcsec) grow in straight lines with dose, and with clearance where it matters."""
    dose, clearance = np.array([0.0, 5e-10]), np.array([0.0, 5e-5]) if by_clearance else np.zeros(1)
    lost = 70.0 + slope * dose[:, None] + (by_clearance or 0.0) * clearance
    figures = {"lost_motion": lost, "backlash": lost - 3.0, "angular_transmission_error": np.ones_like(lost)}
    return LifeFigures(dose, clearance, {n: v / ARCSEC for n, v in figures.items()}, dict.fromkeys(figures, 0.0))


PRIOR = Prior(1e-18, 10.0, offset={"lost_motion": 5 / ARCSEC, "backlash": 5 / ARCSEC}, scatter=0.2, period=1e6)


@pytest.mark.slow(27)
def test_a_life_is_that_of_the_dose_alone():
    """Twice the coefficient wears in half the turns as much as one does, profile update included."""
    drive = cy.Drive(pair_of(11))
    once, twice = (
        drive.wear(LAW.replace(coefficient=k), "-181 N*m", turns, workers=1)
        for k, turns in ((1e-18, 2e7), (2e-18, 1e7))
    )
    assert np.allclose(once.surface.gear_deviation, twice.surface.gear_deviation, rtol=0.0, atol=1e-15)
    assert once.figures["life"]["lost_motion"] == pytest.approx(twice.figures["life"]["lost_motion"], rel=1e-9)


@pytest.mark.slow(3)
def test_lost_motion_grows_as_a_second_computation_of_wear_says():
    pair, dose = pair_of(11), 1e-11
    life = life_figures(cy.Drive(pair), LAW, LOADS, dose, workers=1)
    made = second_drive.body(second_drive.sizes_of(pair), isometric=-15e-6, offset=-40e-6)
    second = ageing_lives.life(made, [(load.torque, load.crank_turns) for load in LOADS], 181.0, dose, 4)
    at = np.linspace(0.0, dose, 5)
    assert life.at("lost_motion", 0.0) == pytest.approx(second["lost_motion"][0], rel=1e-3)
    for name in ("lost_motion", "backlash"):
        grown = life.at(name, at) - life.at(name, 0.0)
        assert grown[1:] == pytest.approx(second[name][1:] - second[name][0], rel=0.02)


@pytest.mark.slow(30)
def test_a_growing_clearance_adds_the_closed_form_of_a_crank_bearing():
    """Lost motion of a clearance is the clearance over the cranks' circle (RV paper, equation 20), nearly."""
    made = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair
    pair = made.nominal.replace(discs=1)
    life = life_figures(cy.Drive(pair), LAW, LOADS, 5e-12, bearing="turning_arm", clearance=12e-6, workers=1)
    up, down = cy.Drive(pair).analyze([0.03 * 181.0, -0.03 * 181.0], angles=48).transmission_error
    assert life.at("lost_motion", 0.0) == pytest.approx(float((up - down).mean()), rel=1e-3)
    lost = life.at("lost_motion", 0.0, [0.0, 12e-6])
    assert lost[1] - lost[0] == pytest.approx(12e-6 / pair.supports.circle_radius, rel=0.15)
    assert life.values["lost_motion"].shape == (life.dose.size, life.clearance.size)


@pytest.mark.parametrize("by_clearance", [None, 6e6])
def test_without_recordings_the_prior_is_what_is_known(by_clearance):
    prior = PRIOR if by_clearance is None else Prior(1e-18, 10.0, 1e-13, 4.0)
    after = posterior(straight(by_clearance=by_clearance), prior, [])
    assert after.factor([0.025, 0.5, 0.975]) == pytest.approx([0.1, 1.0, 10.0], rel=0.03)
    if by_clearance:
        assert after.factor([0.025, 0.975], 1) == pytest.approx([0.25, 4.0], rel=0.06)


def test_the_grid_gives_what_a_normal_distribution_is_in_closed_form(monkeypatch):
    """Without the law's error, one exact figure of a straight life gives the coefficient by a closed form."""
    monkeypatch.setattr(posterior_module, "_LAW", 0.0)
    turns, grown, offset = 1e8, 20.0 / ARCSEC, 0.5 / ARCSEC
    prior = Prior(1e-18, 1000.0, offset={"lost_motion": offset})
    one = Measured(turns, "lost_motion", 70 / ARCSEC + grown, 0.5 / ARCSEC)
    after = posterior(straight(), prior, [one])
    assert after.factor(0.5) == pytest.approx(1.0, rel=2e-3)
    low, high = after.factor([0.025, 0.975])
    assert 0.5 * (high - low) == pytest.approx(1.96 * np.hypot(0.5, 0.5) / 20.0, rel=0.01)
    # The offset moves other observations in the same place too.
    assert after.predicted("lost_motion", turns).quantile(0.5) == pytest.approx(one.value, abs=0.02 / ARCSEC)
    assert after.predicted("lost_motion", 0.0).quantile(0.975) - 70 / ARCSEC == pytest.approx(1.96 * offset, rel=0.02)


def lived(rng, life, prior, seen, last, noise, grown=None, error=1.0):
    """One life drawn: its measured figures, and the true ones at the last ages."""
    turns = np.concatenate([seen, last])
    steps = rng.gamma(1.0 / prior.scatter**2, prior.scatter**2 * prior.period, int(turns.max() / prior.period))
    effective = np.concatenate([[0.0], np.cumsum(steps)])[np.round(turns / prior.period).astype(int)]
    factors = np.exp(rng.standard_normal(prior.deviations.size) * prior.deviations)
    dose = prior.coefficient * factors[0] * effective
    clearance = prior.growth * factors[-1] * effective
    offsets = {name: rng.normal() * offset for name, offset in prior.offset.items()}
    true = {}
    if grown is None:
        # The law's own error: relative, and alike at ages near each other by ratio.
        logs = np.log(np.maximum(turns, 1.0))
        alike = np.exp(-0.5 * ((logs[:, None] - logs) / posterior_module._LAW_LENGTH) ** 2)
        factor = np.linalg.cholesky(alike + 1e-9 * np.eye(turns.size)) @ rng.standard_normal(turns.size)
        for name in offsets:
            new = life.at(name, 0.0)
            more = life.at(name, dose, clearance) - new
            true[name] = new + more * (1.0 + posterior_module._LAW * error * factor) + offsets[name]
    else:
        for name in offsets:
            true[name] = life.at(name, 0.0) + grown(name, dose, clearance) + offsets[name]
    figures = [
        Measured(t, name, true[name][k] + noise * rng.normal(), noise) for k, t in enumerate(seen) for name in offsets
    ]
    return figures, {name: values[len(seen) :] for name, values in true.items()}


def coverage(life, prior, lives, noise, seed, grown=None, scored=0):
    """How many intervals hold at two ages ahead, of how many; and the scores of the recordings of some lives."""
    seen, last = np.array([0.0, 1e7, 2e7, 3e7, 4e7]), np.array([6e7, 8e7])
    rng, held, placed = np.random.default_rng(seed), np.zeros((len(LEVELS), last.size)), []
    for number in range(lives):
        which = grown[rng.integers(len(grown))] if grown else None
        figures, true = lived(rng, life, prior, seen, last, noise, which)
        after = posterior(life, prior, figures)
        mixture = after.predicted("lost_motion", last)
        below = np.diag(np.array([mixture.below(value) for value in true["lost_motion"]]))
        held += np.abs(below - 0.5) <= 0.5 * np.array(LEVELS)[:, None]
        if number < scored:
            placed.append(scores(life, prior, figures))
    return held, np.array(placed)


def in_band(held, lives, level):
    low, high = binom.ppf([5e-4, 1.0 - 5e-4], lives, level)
    return low <= held <= high


@pytest.mark.slow(3)
@pytest.mark.parametrize(("by_clearance", "lives"), [(None, 100), (6e6, 50)])
def test_intervals_hold_as_often_as_they_state(by_clearance, lives):
    prior = PRIOR if by_clearance is None else Prior(1e-18, 10.0, 1e-13, 5.0, PRIOR.offset, 0.2, 1e6)
    held, placed = coverage(straight(by_clearance=by_clearance), prior, lives, 1.0 / ARCSEC, 3, scored=20)
    for row, level in zip(held, LEVELS, strict=True):
        assert all(in_band(count, lives, level) for count in row), (level, row / lives)
    # Scores are standard normal numbers, independent of each other.
    assert abs(placed.mean()) < 4.0 / np.sqrt(placed.size)
    assert abs(placed.var() - 1.0) < 4.0 * np.sqrt(2.0 / placed.size)
    following = np.corrcoef(placed[:, :-1].ravel(), placed[:, 1:].ravel())[0, 1]
    assert abs(following) < 4.0 / np.sqrt(placed.size)


@pytest.mark.slow(100)
def test_forecasts_hold_over_200_lives_of_a_second_computation():
    """Wear by Archard's law on the second drive, smoothed over various widths, bearings by the closed form."""
    made = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair
    pair = made.nominal.replace(discs=1)
    dose, radius, lives = 3e-10, pair.supports.circle_radius, 200
    life = life_figures(cy.Drive(pair), LAW, LOADS, dose, bearing="turning_arm", clearance=40e-6)
    body = second_drive.body(second_drive.sizes_of(pair), isometric=-15e-6, offset=-40e-6)
    loads = [(load.torque, load.crank_turns) for load in LOADS]
    at = np.linspace(0.0, dose, 25)

    def second(waves):
        found = ageing_lives.life(body, loads, 181.0, dose, at.size - 1, waves)

        def grown(name, dose, clearance):
            values = found[name] - found[name][0]
            # Beyond the computed depth it continues as straight as the product's figures do.
            beyond = np.maximum(dose - at[-1], 0.0) * (values[-1] - values[-2]) / (at[-1] - at[-2])
            return np.interp(dose, at, values) + beyond + clearance / radius

        return grown

    prior = Prior(1e-18, 4.0, 2e-13, 3.0, PRIOR.offset, 0.2, 1e6)
    held, _ = coverage(life, prior, lives, 1.0 / ARCSEC, 1, [second(waves) for waves in (20, 30, 40, 60, 80)])
    for row, level in zip(held, LEVELS, strict=True):
        assert all(in_band(count, lives, level) for count in row), (level, row / lives)


def history_of(ages, lost, **more):
    recorded = [
        {"age": f"{age:g} h", "lost_motion": [f"{value:.6f} arcsec", "2 arcsec"]}
        for age, value in zip(ages, lost, strict=True)
    ]
    return History(crank_turns_per_hour=1e5, torque="-181 N*m", recorded=recorded, **more)


def foretold(history, life=None, until=4000.0):
    drive = cy.Drive(pair_of(11))
    return forecast(
        drive, LAW, history, measured(history, drive), until=until * HOUR, life=life or straight(), workers=1
    )


def test_wear_that_runs_away_raises_an_alarm_and_even_wear_none():
    ages = np.arange(0.0, 2001.0, 250.0)
    even = 70.0 + 0.01 * ages
    assert foretold(history_of(ages, even)).alarm is None
    found = foretold(history_of(ages, np.where(ages > 1000.0, even + 0.08 * (ages - 1000.0), even))).alarm
    assert found.score > 3.0
    assert found.first >= 1000.0 * HOUR
    assert found.chance < ALARM
    assert "wear may be running away" in found.sentence
    back = foretold(history_of(ages, np.where(ages > 1000.0, even - 25.0, even))).alarm
    assert back.score < -3.0
    assert "more slowly" in back.sentence


@pytest.mark.slow(4)
def test_false_alarms_are_as_rare_as_stated():
    rng, life = np.random.default_rng(0), straight()
    seen = np.arange(0.0, 6e7, 1e7)
    alarms = 0
    for _ in range(40):
        figures, _ = lived(rng, life, PRIOR, seen, [], 1.0 / ARCSEC)
        placed = scores(life, PRIOR, figures)
        runs = [placed[i:j].sum() / np.sqrt(j - i) for i, j in itertools.combinations(range(placed.size + 1), 2)]
        alarms += np.abs(runs).max() > 4.5
    assert alarms <= 1


def test_the_limit_is_left_at_the_age_where_its_probability_says():
    found = foretold(history_of([0, 500, 1000, 1500], [70, 75, 80, 85], limits={"lost_motion": "100 arcsec"}))
    left = found.remaining["lost_motion"]
    assert left.ages[0.05] < left.ages[0.5] < left.ages[0.95]
    assert (np.diff(left.probability) >= 0.0).all()
    assert left.ages[0.5] / HOUR == pytest.approx(3000.0, rel=0.05)
    # The limit is the figure's median there.
    assert found.at("lost_motion", left.ages[0.5], 0.5) == pytest.approx(100.0 / ARCSEC, rel=2e-3)
    assert found.bands["lost_motion"].shape == (len(QUANTILES), found.ages.size)
    assert (np.diff(found.bands["lost_motion"], axis=0) > 0.0).all()


def test_without_recordings_the_forecast_is_the_prior_s():
    found = foretold(history_of([], []))
    assert found.alarm is None
    assert found.now == 0.0
    assert any("hardly determine the wear coefficient" in note for note in found.notes)
    assert fitting.plot(found).axes


def test_what_a_fit_leaves_open_is_part_of_the_offset():
    """Thicker pins take 2/(e z_c) of lost motion for each metre (RV paper, equation 16)."""
    pair = pair_of(11)
    surface = cy.Drive(pair).surface.replace(covariance=np.array([[1e-6**2]]), covariance_of=("pin_radius",))
    history = history_of([0], [70], offsets={"lost_motion": "0.1 arcsec"})
    found = forecast(
        cy.Drive(pair, surface), LAW, history, measured(history, cy.Drive(pair)), until=HOUR, life=straight(), workers=1
    )
    # Twelve draws know a standard deviation to some 20 %.
    assert found.posterior.prior.offset["lost_motion"] == pytest.approx(2e-6 / (1.3e-3 * 11), rel=0.5)


def test_more_recordings_narrow_the_forecast():
    few, many = (
        foretold(history_of(np.linspace(0.0, 2000.0, n), np.linspace(70.0, 90.0, n))).bands["lost_motion"]
        for n in (2, 9)
    )
    assert np.ptp(many[:, -1]) < np.ptp(few[:, -1])


def test_dates_are_ages_in_running_hours():
    history = History(
        crank_turns_per_hour=1e5,
        in_service=datetime.date(2026, 1, 1),
        hours_per_day=16.0,
        recorded=[{"date": datetime.date(2026, 1, 11), "backlash": [1e-4, 1e-6]}],
    )
    (one,) = measured(history, cy.Drive(pair_of(11)))
    assert one.crank_turns == 10 * 16 * 1e5
    assert one.standard_error == pytest.approx(1e-6 / 1.959964)


def test_figures_of_a_file_are_those_that_were_written(tmp_path):
    torque = 181.0 * np.sin(np.linspace(0.0, 6.0 * np.pi, 6000))
    play = 1e-4 * np.tanh(torque / 2.0)
    rng = np.random.default_rng(0)
    run = fitting.Run(input_angle=0.0, output_angle=play + torque / 1e6 + 1e-7 * rng.normal(size=6000), torque=torque)
    figures = fitting.metrics(run, ratio=-39.0, rated_torque="181 N*m")
    figures.write(tmp_path / "new.json")
    history = History(crank_turns_per_hour=1e5, recorded=[{"age": "3 h", "figures": "new.json"}])
    found = {m.figure: m for m in measured(history, cy.Drive(pair_of(39)), tmp_path)}
    assert found["lost_motion"].value == pytest.approx(figures.figures["lost_motion"].value)
    assert found["lost_motion"].crank_turns == 3e5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("crank_turns_per_hour = 0.0", "crank_turns_per_hour = 0.0"),
        ('crank_turns_per_hour = 1e4\n[[recorded]]\nlost_motion = ["1 arcmin", "1 arcsec"]', "either age"),
        ('crank_turns_per_hour = 1e4\n[[recorded]]\nage = "1 h"', "state one of figures"),
        ('crank_turns_per_hour = 1e4\n[[recorded]]\ndate = 2026-01-01\nfigures = "a.json"', "need in_service and"),
        (
            "crank_turns_per_hour = 1e4\nhours_per_day = 8\nin_service = 2026-02-01\n"
            '[[recorded]]\ndate = 2026-01-01\nfigures = "a.json"',
            "is before in_service",
        ),
        ('crank_turns_per_hour = 1e4\n[limit]\nlost_motion = "1 arcmin"', "limits"),
        ('crank_turns_per_hour = 1e4\n[bearing]\nname = "arm"\nclearance_growth = "1 um"\nwithin = "1 h"', "_arm"),
    ],
)
def test_a_wrong_history_is_refused_in_a_sentence(text, said, tmp_path):
    (tmp_path / "history.toml").write_text(f'format = "cycloid-history/1"\n{text}\n')
    with pytest.raises(edge.InputError, match=said):
        read_history(tmp_path / "history.toml")


@pytest.fixture(scope="module")
def twin():
    """A forecast of a drive on bearings, and its twin."""
    made = cy.read_drive(EXAMPLES / "drive-39-40-bearings.toml").pair
    drive = cy.Drive(made.nominal.replace(discs=1, losses=None, thermal=None))  # friction moves an FMU's output
    bare = cy.Drive(drive.pair.replace(supports=None)).wear(LAW, "-181 N*m", 2e7, workers=1).surface.life
    surfaces = tuple(
        drive.surface.replace(
            **{n: getattr(bare, n)[k] for n in ("gear_deviation", "pin_deviation", "gear_curvature", "pin_curvature")},
            origin="worn",
        )
        for k in range(bare.crank_turns.size)
    )
    dose = 1e-18 * bare.crank_turns
    figures = {
        name: (70.0 + 2e12 * dose[:, None] + np.array([0.0, 200.0])) / ARCSEC
        for name in ("lost_motion", "backlash", "angular_transmission_error")
    }
    life = LifeFigures(dose, np.array([0.0, 4e-5]), figures, dict.fromkeys(figures, 0.0), surfaces)
    history = history_of(
        [0, 50, 100],
        [70, 75, 80],
        bearing={"name": "turning_arm", "clearance_growth": "2 um", "within": "100 h"},
        coefficient_factor=2.0,
    )
    return forecast(drive, LAW, history, measured(history, drive), until=120 * HOUR, life=life, workers=1)


@pytest.mark.slow(20)
def test_the_twin_is_the_worn_drive_at_every_age(twin, tmp_path):
    drive = twin.aged
    drive.write(tmp_path / "twin.nc")
    surface = cy.read_surface(tmp_path / "twin.nc")
    assert surface == drive.surface
    ageing = surface.life.ageing
    assert ageing.age == 100 * HOUR
    for age, factor in ((0.0, 1.0), (40 * HOUR, 1.0), (40 * HOUR, ageing.largest_wear_factor)):
        worn = surface_after(surface, age * ageing.crank_turns_per_second * factor).replace(life=None)
        grown = with_clearance(drive.pair.nominal, "turning_arm", age * ageing.clearance_per_second)
        found, same = (
            one.analyze(5.0, crank_angle=[0.0, 0.1]).transmission_error.values[0]
            for one in (drive.at_age(age, factor), cy.Drive(grown, worn.replace(pair=grown)))
        )
        assert found == pytest.approx(same, abs=1e-12)
    assert ageing.clearance_per_second > 0.0
    # Analysed as it is, it has the clearance of its own age, not that of the new bearing.
    found, same = (one.analyze(5.0, crank_angle=[0.0, 0.1]) for one in (drive, drive.at_age(ageing.age)))
    assert found.backlash.values == pytest.approx(same.backlash.values, abs=1e-12)
    new = drive.at_age(0.0).analyze(5.0, crank_angle=[0.0, 0.1])
    assert (found.backlash.values > new.backlash.values).all()


@pytest.mark.slow(10)
def test_an_fmu_of_a_twin_is_the_drive_of_its_age(twin, command, tmp_path):
    """One for each age, the clearance of the bearing included; without an age, that of the last recording."""
    drive = twin.aged
    drive.write(tmp_path / "twin.nc")
    write_pair(drive.pair.nominal, tmp_path / "pair.toml")
    given = ("cycloid-fmu", "build", "pair.toml", "--surface", "twin.nc", "-o", "twin.fmu")
    for more in ((), ("--age", "0 h", "--age", "40 h", "--wear-factor", "1.1")):
        done = command(*given, *more)
        assert done.returncode == 0, done.stderr
    plays = {}
    for name, (age, factor) in {"": (100.0, 1.0), "-0000": (0.0, 1.1), "-0001": (40.0, 1.1)}.items():
        found = cy.simulate_fmu(tmp_path / f"twin{name}.fmu", crank_angle=[0.0, 0.1], torque=5.0)
        there = drive.at_age(age * HOUR, factor).analyze(5.0, crank_angle=[0.0, 0.1])
        assert found["transmission_error"] == pytest.approx(there.transmission_error.values[0], abs=1e-10)
        plays[age] = there.backlash.mean().item()
    assert plays[0.0] < plays[40.0] < plays[100.0]


@pytest.mark.parametrize(
    ("age", "factor", "said"),
    [
        (-1.0, 1.0, r"^age = -1\.?0?: it must be between 0 and .* s \(.* h\), the end of the forecast\.$"),
        ("121 h", 1.0, r"^age = 435600\.?0?: it must be between 0 and 432000 s \(120 h\)"),
        (0.0, 100.0, r"^wear_factor = 100\.?0?: it must be between"),
    ],
)
def test_an_age_outside_of_the_forecast_is_refused(twin, age, factor, said):
    with pytest.raises(edge.InputError, match=said):
        twin.aged.at_age(age, factor)


def test_a_drive_without_a_forecast_has_no_age():
    with pytest.raises(edge.InputError, match=r"^age = .*: needs a drive with a forecast"):
        cy.Drive(pair_of(11)).at_age(5.0)
    with pytest.raises(edge.InputError, match=r"^crank_turns needs a worn drive"):
        cy.Drive(pair_of(11)).after(5.0)


@pytest.mark.slow(2)
def test_forecast_from_the_command_line(command, tmp_path):
    (tmp_path / "pair.toml").write_text(pair_of(11).text)
    (tmp_path / "wear.toml").write_text(
        'format = "cycloid-wear/1"\n[wear]\npins = "free"\ncoefficient = "1e-20 m^2/N"\nlargest_step = "3 um"\n'
    )
    text = 'format = "cycloid-history/1"\ncrank_turns_per_hour = 1e5\ntorque = "-181 N*m"\n[limits]\n'
    text += 'lost_motion = "14 arcmin"\n'
    for age, value in ((0, 12.23), (1000, 12.5)):
        text += f'[[recorded]]\nage = "{age} h"\nlost_motion = ["{value} arcmin", "0.05 arcmin"]\n'
    (tmp_path / "history.toml").write_text(text)
    given = ("cycloid-fit", "forecast", "history.toml", "--pair", "pair.toml", "--wear", "wear.toml")
    run = command(*given, "--until", "3000 h", "-o", "f.json", "--plot", "f.png", "--twin", "twin.nc")
    assert run.returncode == 0, run.stderr
    assert "Wear coefficient" in run.stdout
    found = json.loads((tmp_path / "f.json").read_text())
    assert found["holds"]
    assert found["now"] == 1000 * HOUR
    assert (tmp_path / "f.png").stat().st_size > 20000
    assert cy.read_surface(tmp_path / "twin.nc").life.ageing.age == 1000 * HOUR
    for more, said in (
        (("--until", "500 h"), "--until"),
        (("--until", "500"), "unit"),
        (("--surface", "none.nc"), "none.nc"),
    ):
        bad = command(*given, *more)
        assert bad.returncode == 2
        assert said in bad.stderr
        assert "Traceback" not in bad.stderr
