"""Recalibration in place: its exact parts, its alarms, its file, its plan, and lives of drives unknown to it."""

import dataclasses
import json

import numpy as np
import pytest
from benches_as_they_are import springs
from lived_drives import (
    ARCSEC,
    BITS,
    TURNS,
    Joint,
    backlash,
    fitted,
    life,
    made,
    off,
    on_cranks,
    small,
    visit,
    worn,
)

import fitting
from cycloid_fmu.drive import Drive
from cycloid_fmu.edge import InputError
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.model.loops import observed_curves
from fitting.model.observations import scatter_parts
from fitting.recalibration.drift import REFERENCE_TURNS, drifted, fitted_drive
from fitting.recalibration.figures import figures_of
from fitting.recalibration.files import as_json, read_recalibration, write_recalibration
from fitting.recalibration.measured import LostMotion, observed_in_place, quantised
from fitting.recalibration.plan import plan_visit
from fitting.recalibration.recalibrate import alarm_of, recalibrate
from fitting.recalibration.update import updated


@pytest.fixture(scope="module")
def case():
    """A drive as a fit leaves it, its joint, and the joint's runs after some wear."""
    pair, generator = small(), np.random.default_rng(3)
    drive, values, scatter = fitted(pair, generator)
    joint = Joint.drawn(generator)
    values, scatter = worn(pair, values, scatter, generator, monotone=True)
    return drive, values, scatter, joint, visit(pair, made(pair, values, scatter), joint, generator)


@pytest.fixture(scope="module")
def result(case):
    drive, _, _, _, runs = case
    return recalibrate(drive, runs, crank_turns=TURNS, bits=BITS)


def narrow(pair, share=1e-3):
    """A drive so well known that its model is linear over its uncertainty."""
    drive, *_ = fitted(pair, np.random.default_rng(5))
    surface = drive.surface.replace(covariance=drive.surface.covariance * share**2)
    return Drive(pair, surface)


def quiet(pair, drive, load, generator, noise):
    """A curve of a drive as the product has it, its zero its own."""
    angle = np.arange(pair.gear_teeth * 20) * 2.0 * np.pi / 20
    error = drive.analyze(load, crank_angle=angle).transmission_error.values[0]
    error = error + generator.normal(0.0, noise, angle.size)
    run = fitting.Run(
        input_angle=-np.sign(pair.ratio * load) * angle,
        output_angle=-np.sign(pair.ratio * load) * angle / pair.ratio + error,
        torque=load,
        known_index=True,
        name=f"{load:g}",
    )
    return observed_curves([run], drive)


def test_without_data_and_turns_nothing_changes():
    drive = narrow(small())
    known = fitted_drive(drive)
    again = drifted(known, 0.0, 1e-6)
    assert np.array_equal(again.covariance, known.covariance)
    # A measurement without information changes nothing: a lost motion known to a full turn.
    found = updated(observed_in_place([], [LostMotion(1e-3, 6.0, 6.0)], known)).posterior
    # Constants vary by a millionth of a usual error.
    assert np.allclose(found.of_surface, known.covariance, rtol=1e-3, atol=1e-22)
    for name, values in drive.surface.errors.items():
        assert found.drive.surface.errors[name] == pytest.approx(values, abs=1e-12), name


def test_one_long_interval_is_two_short_ones():
    drive = narrow(small())
    known = fitted_drive(drive)
    twice = drifted(drifted(known, 4e6, 1e-6), 6e6, 1e-6)
    once = drifted(known, 1e7, 1e-6)
    assert np.allclose(twice.covariance, once.covariance, rtol=1e-12)
    added = np.sqrt(np.diag(once.covariance - known.covariance))[known.errors.index("pin_radius")]
    assert added == pytest.approx(1e-6 * np.sqrt(1e7 / REFERENCE_TURNS), rel=1e-6)


def test_two_updates_after_one_another_are_one_with_all_data(monkeypatch):
    """Where the model is linear Bayes' theorem does not care about the order; nuisances that last are carried along."""
    pair = small()
    drive, generator = narrow(pair), np.random.default_rng(7)
    known = fitted_drive(drive)
    # The noise is stated.
    monkeypatch.setattr("fitting.recalibration.update._WHITE", np.inf)
    first = [c for load in (6.0, -6.0) for c in quiet(pair, drive, load, generator, 1e-9)]
    second = [c for load in (120.0, -120.0) for c in quiet(pair, drive, load, generator, 1e-9)]

    def posterior(curves, earlier):
        observed = observed_in_place(curves, [], earlier, noise=[1e-6] * len(curves))
        # Limits that depend on the largest load are those of all.
        prior = np.where([n == "chain_compliance" for n in observed.bench_names], 1e-9, observed.bench_prior)
        return updated(dataclasses.replace(observed, bench_prior=prior, friction_prior=1e-5)).posterior

    one = posterior(first, known)
    two, both = posterior(second, one), posterior([*first, *second], known)
    assert two.bench == both.bench
    deviation = np.sqrt(np.diag(both.covariance))
    told = np.sqrt(np.diag(known.with_unknowns(dict.fromkeys(both.bench, 1.0)).covariance)) > 0.0
    scale = np.outer(deviation[told], deviation[told])
    assert np.abs((two.covariance - both.covariance)[np.ix_(told, told)] / scale).max() < 1e-3
    radius = deviation[known.errors.index("pin_radius")]
    assert two.drive.surface.pin_radius == pytest.approx(both.drive.surface.pin_radius, abs=0.05 * radius)
    assert abs(both.drive.surface.pin_radius - drive.surface.pin_radius) > 0.0
    # Both have the friction of the same runs; the first update by itself has less information.
    assert np.trace(two.of_surface) < np.trace(one.of_surface) < np.trace(known.covariance)


def test_a_worn_drive_is_found_as_it_is(case, result):
    drive, values, scatter, _, _ = case
    pair = drive.pair
    true = backlash(pair, made(pair, values, scatter))
    before, now = (one.figures["backlash"] for one in result.history)
    assert not result.alarm, result.alarm
    assert now.interval[0] < true < now.interval[1]
    assert now.standard_error < 0.2 * before.standard_error
    assert abs(now.value - true) < 0.3 * abs(before.value - true)
    assert result.history[-1].crank_turns == TURNS
    assert any(one.startswith("pin_radius:") for one in result.better_known)
    # All that follows from a posterior follows from this one.
    drawn = fitting.ensemble(result.drive, 3)
    assert len({one.hash for one in drawn}) == 3


@pytest.mark.slow(4)
def test_further_steps_do_not_change_the_result(case, monkeypatch):
    """A few evaluations of the model come as near to the most likely drive as its corners let any number come."""
    drive, _, _, _, runs = case
    known = drifted(fitted_drive(drive), TURNS, 1e-6)
    observed = observed_in_place(observed_curves(runs, drive), [], known, bits=BITS)
    found = updated(observed)
    monkeypatch.setattr("fitting.recalibration.update._SETTLED", 0.0)
    further = updated(observed)
    assert further.evaluations > found.evaluations
    one, two = (figures_of(f.posterior)["backlash"] for f in (found, further))
    assert one.value == pytest.approx(two.value, abs=0.3 * two.standard_error)
    assert one.standard_error == pytest.approx(two.standard_error, rel=0.02)


def test_the_figures_are_those_of_the_drive():
    """Backlash of a drive without scatter is the play that the contact model states, its derivative a difference."""
    pair = small()
    surface = surface_of_pair(pair).replace(covariance=np.array([[1e-14]]), covariance_of=("pin_radius",))
    drive = Drive(pair, surface)
    known = fitted_drive(drive)
    angle = np.arange(241) * 2.0 * np.pi / 241
    play = Drive(pair).analyze(100.0, crank_angle=angle).backlash.values.mean()
    found = figures_of(known)["backlash"]
    assert found.value == pytest.approx(play, rel=3e-4)
    thinner = Drive(pair, surface.replace(pin_radius=-1e-7))
    slope = (figures_of(fitted_drive(thinner))["backlash"].value - found.value) / 1e-7
    assert found.standard_error == pytest.approx(slope * 1e-7, rel=1e-2)


@pytest.mark.parametrize("what", ["a broken pin", pytest.param("another drive", marks=pytest.mark.slow(1))])
def test_what_is_not_wear_raises_the_alarm(case, result, what):
    drive, values, scatter, joint, _ = case
    pair, generator = drive.pair, np.random.default_rng(11)
    if what == "a broken pin":
        scatter = scatter.copy()
        scatter[scatter_parts(pair)["pin_radius_deviation"].start + 4] -= 50e-6
    else:
        _, values, scatter = fitted(pair, generator)
    runs = visit(pair, made(pair, values, scatter), joint, generator)
    found = recalibrate(result, runs, crank_turns=TURNS, bits=BITS)
    assert found.alarm.startswith("The model no longer holds: ")
    if what == "a broken pin":
        assert "_at_4 by" in found.alarm
    # The drive is kept, but less is known of it.
    assert found.drive.surface.errors["pin_radius"] == result.drive.surface.errors["pin_radius"]
    assert found.figures["backlash"].standard_error > result.figures["backlash"].standard_error
    assert [bool(one.alarm) for one in found.history] == [False, False, True]


def true_figures(pair, body, stage=None):
    torques = {"backlash": 1e-2, "lost_motion": 0.03 * pair.rated_torque}
    return {name: backlash(pair, body, torque, stage) for name, torque in torques.items()}


@pytest.mark.slow(20)
def test_bearings_are_found_with_the_wear(case, tmp_path):
    """Bearings a third stiffer than stated, by a solver that knows each disc's bearings as one spring and a windup."""
    drive, values, scatter, joint, _ = case
    stated, generator = on_cranks(drive, 2e8), np.random.default_rng(4)
    body = made(drive.pair, values, scatter, **springs(2.6e8))
    found = recalibrate(stated, visit(drive.pair, body, joint, generator), crank_turns=TURNS, bits=BITS)
    assert not found.alarm, found.alarm
    before, now = (one.figures for one in found.history)
    for name, true in true_figures(drive.pair, body).items():
        assert now[name].interval[0] < true < now[name].interval[1]
        assert now[name].standard_error < 0.1 * before[name].standard_error
    supports = found.drive.pair.supports
    windup = sum(1.0 / getattr(supports, n).stiffness for n in ("turning_arm", "crank_shaft"))
    assert windup == pytest.approx(2.0 / 2.6e8, rel=0.1)
    # The next date begins with these bearings.
    write_recalibration(found, tmp_path / "r.json")
    again = read_recalibration(tmp_path / "r.json", found.drive)
    assert np.array_equal(again.posterior.covariance, found.posterior.covariance)
    assert figures_of(again.posterior)["backlash"].value == pytest.approx(now["backlash"].value, rel=1e-12)


@pytest.mark.slow(3)
def test_clearances_do_not_fall_below_zero(case):
    """A smaller lost motion than was known is taken from the gear pair where bearings have no clearance."""
    drive = on_cranks(case[0], 2e8)
    known = fitted_drive(drive)
    now = figures_of(known)["lost_motion"].value
    found = updated(observed_in_place([], [LostMotion(now - 60.0 * ARCSEC, 1.0 * ARCSEC, 6.0)], known)).posterior
    for name in ("turning_arm", "crank_shaft", "main"):
        assert getattr(found.drive.pair.supports, name).clearance == pytest.approx(0.0, abs=1e-15)
    assert figures_of(found)["lost_motion"].value < now - 30.0 * ARCSEC


def test_bearings_drift_with_the_crank_turns(case):
    drive = on_cranks(case[0], 2e8)
    known = fitted_drive(drive)
    at = [known.names.index(n) for n in ("turning_arm_clearance", "turning_arm_stiffness")]
    once, twice = (np.diag(drifted(known, n * TURNS, 1e-6).covariance)[at] for n in (1, 2))
    assert once[0] - known.covariance[at[0], at[0]] == pytest.approx(1e-12)
    assert twice - once == pytest.approx(once - np.diag(known.covariance)[at])


@pytest.mark.slow(4)
def test_the_play_of_a_first_stage_is_found(case):
    """The sun is measured; the play of its stage is a half more than stated."""
    drive, values, scatter, joint, _ = case
    generator = np.random.default_rng(6)
    stated, true = (FirstStage(12, 42, play, 0.0, crank_stiffness=2e4) for play in (4e-3, 6e-3))
    body = made(drive.pair, values, scatter)
    runs = visit(drive.pair, body, joint, generator, stage=true)
    found = recalibrate(Drive(drive.pair, drive.surface, stated), runs, crank_turns=TURNS, bits=BITS)
    assert not found.alarm, found.alarm
    for name, value in true_figures(drive.pair, body, true).items():
        assert found.figures[name].interval[0] < value < found.figures[name].interval[1]
    size = found.posterior.deviations["first_stage_play"]
    assert found.drive.first_stage.crank_play == pytest.approx(true.crank_play, abs=2.5 * size)
    before, now = (one.figures["backlash"].standard_error for one in found.history)
    assert now < 0.1 * before


def test_a_lost_motion_alone_tells_the_play(case):
    drive, values, scatter, _, _ = case
    true = backlash(drive.pair, made(drive.pair, values, scatter), 6.0)
    found = recalibrate(drive, lost_motions=[LostMotion(true, 2.0 * ARCSEC, 6.0)], crank_turns=TURNS)
    figure = found.figures["lost_motion"]
    # The chain beside the gear pair is compliant too, as far as known.
    assert figure.standard_error == pytest.approx(2.0 * ARCSEC, rel=0.1)
    assert abs(figure.value - true) < 2.0 * ARCSEC
    assert found.remaining == found.told.size - 1
    wrong = recalibrate(drive, lost_motions=[LostMotion(true + 200.0 * ARCSEC, 2.0 * ARCSEC, 6.0)], crank_turns=TURNS)
    assert "moved further than its wear" in wrong.alarm


def test_an_update_that_begins_with_few_points_ends_as_with_all(case, result, monkeypatch):
    drive, _, _, _, runs = case
    monkeypatch.setattr("fitting.recalibration.update._COARSE", 400)
    found = recalibrate(drive, runs, crank_turns=TURNS, bits=BITS)
    for name, figure in found.figures.items():
        usual = result.figures[name]
        assert figure.value == pytest.approx(usual.value, abs=0.3 * usual.standard_error)
        # Of 200 drawn drives a deviation is known to 5 %.
        assert figure.standard_error == pytest.approx(usual.standard_error, rel=0.1)


def test_samples_on_one_step_err_alike():
    angle = np.linspace(0.0, 2.0 * np.pi * 11, 1101)
    run = fitting.Run(input_angle=angle, output_angle=-angle / 11, torque=1.0, known_index=True)
    (curve,) = fitting.curves(run, -11.0)
    step = 2.0 * np.pi / 2**12
    dense = dataclasses.replace(curve, sample_count=np.full_like(curve.sample_count, 10**6))
    passed = 2.0 * np.pi / 1100 / step
    assert quantised(dense, 12) == pytest.approx(step / np.sqrt(12.0) / np.sqrt(passed), rel=0.01)
    assert quantised(curve, 12) == pytest.approx(step / np.sqrt(12.0), rel=0.01)


def test_its_file_goes_on_where_it_ended(case, result, tmp_path):
    drive, _, _, _, runs = case
    write_recalibration(result, tmp_path / "r.json")
    again = read_recalibration(tmp_path / "r.json", result.drive)
    assert json.loads(json.dumps(as_json(again), default=list)) == json.loads(json.dumps(as_json(result), default=list))
    later = dataclasses.replace(runs[0], output_angle=np.asarray(runs[0].output_angle) + 0.1 * ARCSEC)
    one, two = (recalibrate(last, later, crank_turns=1e6, bits=BITS) for last in (result, again))
    assert np.array_equal(one.posterior.covariance, two.posterior.covariance)
    assert one.drive == two.drive
    with pytest.raises(InputError, match="belongs to the drive"):
        read_recalibration(tmp_path / "r.json", drive)
    text = (tmp_path / "r.json").read_text().replace('"history"', '"geschichte"')
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(InputError, match="not as recalibrate writes it"):
        read_recalibration(tmp_path / "r.json", result.drive)


def test_a_plan_promises_what_a_visit_keeps(case, result):
    drive = case[0]
    loads = (6.0, 120.0)
    visits = {one.runs: one for one in plan_visit(drive, loads, crank_turns=TURNS, bits=BITS, mark=10.0 * ARCSEC)}
    both = visits["120 and 6 N·m both ways"]
    # Both directions cross the play; one direction does not, nor does a load that deflects the chain.
    assert both.half_width[1] < visits["6 N·m both ways"].half_width[1] < visits["6 N·m one way"].half_width[1]
    assert visits["120 N·m one way"].half_width[100] > 5.0 * both.half_width[1]
    assert all(np.diff([*one.half_width.values()]).max() <= 0.0 for one in visits.values())
    kept = 1.96 * result.figures["backlash"].standard_error
    assert both.half_width[1] == pytest.approx(kept, rel=0.4)
    wanted = plan_visit(drive, loads, crank_turns=TURNS, bits=BITS, wanted=both.half_width[5])
    assert next(one for one in wanted if one.runs == both.runs).turns == 5


@pytest.mark.slow(1)
def test_it_is_drawn(case, result, tmp_path):
    fitting.plot(result, tmp_path / "r.png")
    fitting.plot(plan_visit(case[0], [6.0, 120.0], crank_turns=TURNS, bits=BITS), tmp_path / "p.png")
    assert min((tmp_path / name).stat().st_size for name in ("r.png", "p.png")) > 20000


def test_wrong_arguments_are_named(case):
    drive, _, _, _, runs = case
    with pytest.raises(InputError, match="nothing was measured"):
        recalibrate(drive, crank_turns=1e6)
    with pytest.raises(InputError, match=r"crank_turns.*zero or above zero"):
        recalibrate(drive, runs, crank_turns=-1.0)
    with pytest.raises(InputError, match=r"bits.*from 8 to 32"):
        recalibrate(drive, runs, crank_turns=1e6, bits=3)
    with pytest.raises(InputError, match="has no covariance of a fit"):
        recalibrate(Drive(drive.pair), runs, crank_turns=1e6)
    with pytest.raises(InputError, match="known_index of a Run"):
        recalibrate(drive, dataclasses.replace(runs[0], known_index=False), crank_turns=1e6)
    with pytest.raises(InputError, match="standard_error"):
        LostMotion("10 arcsec", "0 arcsec", "5 N*m")
    with pytest.raises(InputError, match="torque"):
        plan_visit(drive, [], crank_turns=1e6, bits=17)


@pytest.mark.slow(2)
def test_from_the_command_line(case, command, tmp_path):
    drive, *_, runs = case
    Drive(drive.pair).write(tmp_path / "pair.toml")
    drive.write(tmp_path / "s.nc")
    (tmp_path / "map.toml").write_text(
        'format = "cycloid-mapping/1"\n[time]\nrate = 1000.0\n'
        + "".join(f'[{n}]\ncolumn = "{n}"\nzero_reference = "absolute"\n' for n in ("input_angle", "output_angle"))
        + '[torque]\ncolumn = "torque"\n'
    )
    for number, run in enumerate(runs):
        rows = [
            f"{a!r},{o!r},{run.torque}"
            for a, o in zip(run.input_angle.tolist(), run.output_angle.tolist(), strict=True)
        ]
        text = "\n".join(["input_angle [rad],output_angle [rad],torque [N*m]", *rows])
        (tmp_path / f"run-{number}.csv").write_text(text + "\n")
    common = ["cycloid-fit", "recalibrate", "--pair", "pair.toml", "--crank-turns", "1e7", "--bits", "17"]
    files = [f"run-{number}.csv" for number in range(len(runs))]
    run = command(
        *common,
        *files,
        "--mapping",
        "map.toml",
        "--before",
        "s.nc",
        "-o",
        "now.json",
        "--surface",
        "now.nc",
        "--plot",
        "now.png",
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("The model is valid")
    found = json.loads((tmp_path / "now.json").read_text())
    assert len(found["history"]) == 2
    run = command(
        *common, "--before", "now.nc", "--after", "now.json", "--lost-motion", "900 arcsec +- 5 arcsec at 6 N*m"
    )
    assert run.returncode == 4
    assert run.stdout.startswith("The model no longer holds")
    run = command(*common, "--before", "now.nc", "--plan", "6 N*m", "--plan", "120 N*m", "--wanted", "3 arcsec")
    assert run.returncode == 0, run.stderr
    assert "120 and 6 N·m both ways" in run.stdout
    run = command(*common, "--before", "s.nc", "--after", "now.json", "--lost-motion", "1 arcsec +- 1 arcsec at 6 N*m")
    assert run.returncode == 2
    assert "belongs to the drive" in run.stderr


@pytest.mark.slow(240)
def test_lives_of_drives_stay_within_their_intervals():
    """Thirty drives wear four times, flanks unevenly: intervals hold the truth as often as stated, alarms stay away."""
    lives = [life(small(), seed, 4, monotone=True, form=0.3) for seed in range(30)]
    away = np.concatenate([off(found, true) for found, true in lives])
    inside = np.mean(np.abs(away) < 1.96)
    assert 0.88 < inside <= 1.0, inside
    assert np.sqrt(np.mean(away**2)) < 1.25
    alarms = sum(bool(one.alarm) for found, _ in lives for one in found)
    assert alarms <= 2


def test_an_alarm_states_a_cranks_phase_as_an_angle(case):
    moved = {"crank_phase_at_0": (5.7e-5, 7.0), "crank_throw_at_0": (2e-6, 6.0)}
    found = updated(observed_in_place([], [LostMotion(1e-3, 6.0, 6.0)], fitted_drive(case[0])))
    said = alarm_of(dataclasses.replace(found, moved=moved, drift_chance=0.0), ())
    assert "crank_phase_at_0 by +0.057 mrad" in said
    assert "crank_throw_at_0 by +2.00 µm" in said
