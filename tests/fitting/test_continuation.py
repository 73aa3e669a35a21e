"""Fits that go on from the posterior of another: Bayes' theorem, recalibration, files, and what is no prior."""

import dataclasses
import json

import numpy as np
import pytest

import fitting
from cycloid_fmu.drive import Drive
from cycloid_fmu.edge import InputError
from cycloid_fmu.surfaces.structured import structured_value
from fitting.estimation.continuation import read_posterior
from fitting.model.posterior import Posterior, lasting
from fitting.model.prior import posterior_of
from fitting.recalibration.recalibrate import recalibrate


@pytest.fixture(scope="module")
def drive(nominal):
    return Drive(nominal)


@pytest.fixture(scope="module")
def before(measured, drive):
    return fitting.identify(measured(1), drive, held_out=False)


@pytest.fixture(scope="module")
def curves(measured):
    return [dataclasses.replace(one, source=f"{one.source}, again") for one in measured(2)]


@pytest.fixture(scope="module")
def after(curves, drive, before):
    return fitting.identify(curves, drive, prior=before)


def resolved(result):
    return {p.name: p for p in result.parameters if p.held is None}


@pytest.mark.slow(2)
def test_a_fit_from_the_posterior_of_another_is_that_of_all_curves(measured, curves, drive, before, after):
    """Bayes' theorem, with a noise and a scatter that each fit estimates by itself."""
    both = resolved(fitting.identify([*measured(1), *curves], drive, held_out=False))
    one, two = resolved(before), resolved(after)
    assert two.keys() == both.keys()
    assert after.verdict.state == "explained"
    ratio = np.array([two[n].standard_error / both[n].standard_error for n in both])
    assert ((ratio > 0.85) & (ratio < 1.2)).all()
    away = np.array([(two[n].value - both[n].value) / both[n].standard_error for n in both])
    assert np.abs(away).max() < 0.7
    # Twice the data: a variance of noise halves.
    of_noise = [n for n in both if n.startswith("tooth_cumulative_pitch")]
    gained = np.mean([(two[n].standard_error / one[n].standard_error) ** 2 for n in of_noise])
    assert gained == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow(2)
def test_a_recalibration_without_drift_is_this_fit(curves, drive, before):
    """It allows for a coarse encoder's orders and a friction of each run too, and takes the noise as known."""
    fit = fitting.identify(curves, drive, prior=before.drive, form=0.0)
    visit = recalibrate(before.drive, curves, crank_turns=0.0, drift=0.0, torque_share=0.0)
    assert not visit.alarm
    deviation = visit.posterior.deviations
    for one in resolved(fit).values():
        assert deviation[one.name] == pytest.approx(one.standard_error, rel=0.2), one.name
        away = structured_value(visit.drive.surface, one.name) - structured_value(fit.surface, one.name)
        assert abs(away) < 0.5 * one.standard_error, one.name


def test_bench_and_drive_are_carried_run_outs_and_zeros_are_not(before):
    names = before.posterior.names
    assert "chain_compliance" in names
    assert {"pin_radius", "pin_radial_at_7", "tooth_cumulative_pitch_at_38"} < set(names)
    assert not [n for n in names if n.startswith(("output_", "input_", "friction"))]
    known = ["eccentricity", "output_encoder_eccentricity_cos", "output_angle_offset", "turning_arm_clearance"]
    assert lasting(known, mounted=True) == ["eccentricity", "output_encoder_eccentricity_cos", "turning_arm_clearance"]
    assert lasting(known, mounted=False) == ["eccentricity", "turning_arm_clearance"]


def test_measurements_of_some_unknowns_move_those_that_depend_on_them(drive):
    """Against conditioning the joint normal distribution on a measurement of one unknown."""
    names, generator = ("a", "b", "c"), np.random.default_rng(4)
    factor = generator.normal(size=(3, 3))
    covariance, mean, noise = factor @ factor.T, np.array([1.0, 2.0, 3.0]), 0.3
    prior = Posterior(drive, drive.surface, names, (), (), mean, covariance)
    gain = covariance[:, 0] / (covariance[0, 0] + noise)
    exact = mean + gain * (4.0 - mean[0]), covariance - np.outer(gain, covariance[0])
    moved = prior.updated(["a"], exact[0][:1], exact[1][:1, :1])
    assert moved[0] == pytest.approx(exact[0])
    assert moved[1] == pytest.approx(exact[1])
    # As rows of a linear model it is the same distribution, the others marginal.
    columns, values = prior.rows(["x", "b", "a"], np.array([1.0, 10.0, 0.1]))
    information = columns[:, 1:].T @ columns[:, 1:]
    own = covariance[np.ix_([1, 0], [1, 0])] / np.outer([10.0, 0.1], [10.0, 0.1])
    assert np.linalg.inv(information) == pytest.approx(own)
    assert np.linalg.lstsq(columns[:, 1:], values, rcond=None)[0] == pytest.approx([0.2, 10.0])


@pytest.mark.slow(2)
def test_the_file_is_the_prior(curves, drive, before, after, tmp_path):
    before.write(tmp_path / "fit.json")
    read = read_posterior(tmp_path / "fit.json", drive)
    assert read.covariance == pytest.approx(before.posterior.covariance, rel=1e-6, abs=1e-22)
    assert read.drive.surface.errors.keys() == before.surface.errors.keys()
    for name, values in read.drive.surface.errors.items():
        assert values == pytest.approx(before.surface.errors[name], abs=1e-12), name
    # The surface of a fit does not tell scatter and errors apart; the file of the next fit has all of it.
    of_surface = fitting.identify(curves, drive, prior=before.drive)
    of_surface.write(tmp_path / "next.json")
    for name, values in read_posterior(tmp_path / "next.json", drive).drive.surface.errors.items():
        assert values == pytest.approx(of_surface.surface.errors[name], abs=1e-12), name
    again = resolved(fitting.identify(curves, drive, prior=tmp_path / "fit.json"))
    for name, one in resolved(after).items():
        assert again[name].value == pytest.approx(one.value, abs=1e-2 * one.standard_error)
        assert again[name].standard_error == pytest.approx(one.standard_error, rel=1e-3)


def test_files_without_a_posterior_are_read(curves, drive, before, tmp_path):
    """Files of earlier versions hold errors and bench alone."""
    before.write(tmp_path / "fit.json")
    data = json.loads((tmp_path / "fit.json").read_text())
    del data["posterior"]
    (tmp_path / "old.json").write_text(json.dumps(data))
    read, one = read_posterior(tmp_path / "old.json", drive), resolved(before)
    assert set(read.errors) == set(one)
    for name in read.errors:
        assert read.deviations[name] == pytest.approx(one[name].standard_error, rel=1e-6)
        assert structured_value(read.plain, name) == pytest.approx(one[name].value, abs=1e-12)
    two = resolved(fitting.identify(curves, drive, prior=tmp_path / "old.json"))
    both = 1.0 / np.sqrt(2.0)
    assert np.median([two[n].standard_error / one[n].standard_error for n in one]) == pytest.approx(both, abs=0.1)


def test_a_recording_counts_once(measured, drive, before, tmp_path):
    """Given twice, or once more after the fit that is the prior, it would halve variances without new information."""
    runs = measured(1)
    with pytest.raises(InputError, match=r"-200 N·m: its samples are those of -200 N·m too; give them once"):
        fitting.identify([*runs, runs[-1]], drive)
    exported = np.array([float(f"{angle:.15g}") for angle in runs[0].transmission_error + 100.0]) - 100.0
    with pytest.raises(InputError, match="give them once"):
        fitting.identify([*runs, dataclasses.replace(runs[0], transmission_error=exported)], drive)
    before.write(tmp_path / "fit.json")
    before.drive.write(tmp_path / "surface.nc")
    for prior in (before, before.drive, tmp_path / "fit.json"):
        with pytest.raises(InputError, match="the earlier fit already used this recording"):
            fitting.identify(runs[:1], drive, prior=prior)
    with pytest.raises(InputError, match="the earlier fit already used this recording"):
        recalibrate(before.drive, runs[:1], crank_turns=0.0)


@pytest.mark.slow(2)
def test_a_chain_of_fits_knows_all_its_recordings(measured, drive, before, after, curves, tmp_path):
    after.write(tmp_path / "fit.json")
    with pytest.raises(InputError, match="the earlier fit already used this recording"):
        fitting.identify(measured(1)[:1], drive, prior=tmp_path / "fit.json")
    visit = recalibrate(before.drive, curves, crank_turns=1e6)
    for again in (curves, measured(1)):
        with pytest.raises(InputError, match="the earlier fit already used this recording"):
            recalibrate(visit, again, crank_turns=1e6)


def test_what_is_no_prior_is_refused(measured, drive, before, made, tmp_path):
    other = Drive(made.replace(pin_radius=3.1e-3))
    with pytest.raises(InputError, match="fit of another drive"):
        fitting.identify(measured(3), other, prior=before)
    before.write(tmp_path / "fit.json")
    with pytest.raises(InputError, match=r"fit\.json: it is a fit of another drive"):
        read_posterior(tmp_path / "fit.json", other)
    with pytest.raises(InputError, match="known_index of a Run"):
        fitting.identify(measured(3, known_index=False), drive, prior=before)
    with pytest.raises(InputError, match="is no prior"):
        fitting.identify(measured(3), drive, prior=dataclasses.replace(before, posterior=None))
    with pytest.raises(InputError, match=r"tolerances.*prior"):
        fitting.identify(measured(3), drive, prior=before, tolerances=fitting.estimation.identify.Prior())
    text = (tmp_path / "fit.json").read_text()
    (tmp_path / "fit.json").write_text(text.replace('"factor"', '"faktor"'))
    with pytest.raises(InputError, match="not as identify writes it"):
        read_posterior(tmp_path / "fit.json", drive)
    with pytest.raises(InputError, match="has no covariance"):
        fitting.identify(measured(3), drive, prior=drive)


def test_a_posterior_of_a_surface_has_its_covariance(before):
    known = posterior_of(before.drive)
    assert np.array_equal(known.of_surface, before.surface.covariance)
    assert known.errors == before.fitted
