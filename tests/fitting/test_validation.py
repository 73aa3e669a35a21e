"""Whether a fit explains its data: drives as the model holds them, drives and benches as they are."""

import json
import math

import numpy as np
import pytest
from benches_as_they_are import EFFECTS, identified, is_right, names, outcome, scores
from common import study_size
from sampled_drives import ARCSEC, SMALL

from cycloid_fmu import edge
from fitting.estimation.explanation import Explanation
from fitting.estimation.held_out import Prediction
from fitting.estimation.result import as_json
from fitting.reports.report import report

# Of the first the fit once held seven errors, whose part the scatter and the centre distances took: 24 standard errors.
# The second's supports seemed to give way, the third's zeros to creep.
QUICK = [("none", 2), pytest.param("flank form 1 µm", 0, marks=pytest.mark.slow(2))]
# Where supports give way, undetected forms of the flanks looked like eccentricities of 5 standard errors, and in the
# third drive a form of 4.6 standard errors took the place of displacements.
MIXTURE = [pytest.param("a realistic mixture", seed, marks=pytest.mark.slow(6)) for seed in (4, 15, 10)]
PLAY = pytest.param("ring shifts 2 µm with the side of the load", 4, marks=pytest.mark.slow(6))
SOFT_CHAIN = pytest.param("soft chain, 20″ at 200 N·m", 4, marks=pytest.mark.slow(6))


@pytest.fixture(scope="module")
def small(nominal):
    return nominal.replace(**SMALL)


@pytest.fixture(scope="module")
def floating(small):
    return identified("disc and cranks on bearings", small, 0, turns=1)[0]


@pytest.mark.parametrize(("effect", "seed"), [*QUICK, SOFT_CHAIN, PLAY, *MIXTURE])
def test_a_cause_is_named_and_the_intervals_allow_for_it(effect, seed):
    one = outcome(effect, seed)
    assert is_right(one)
    assert len(one["away"]) >= 21
    assert np.abs([*one["away"].values()]).max() < 4.0


@pytest.mark.slow(10)
def test_a_soft_chain_is_stated_as_a_compliance(small):
    found, _ = identified(*SOFT_CHAIN.values[:1], small, 4)
    assert found.bench["chain_compliance"] == pytest.approx(20.0 * ARCSEC / 200.0, rel=0.01)


def test_an_error_that_is_held_widens_those_that_do_nearly_the_same(small):
    """One load can't separate pin circle radius, which is held, from pin radius: neither is known to a micrometre."""
    found, values = identified("none", small, 1, loads=(200.0, -200.0))
    stated = {p.name: p for p in found.parameters}
    circle, pin = stated["pin_circle_radius"], stated["pin_radius"]
    assert found.verdict.state == "explained"
    assert circle.held
    assert abs(values["pin_circle_radius"]) > 2e-6
    assert pin.standard_error > circle.standard_error
    assert pin.interval[0] < values["pin_radius"] < pin.interval[1]
    assert stated["pin_radial_2_cos"].standard_error < 0.5e-6


@pytest.mark.slow(7)
def test_a_drive_on_bearings_is_not_explained_by_rigid_supports(floating):
    verdict = floating.verdict
    assert verdict.state == "not explained"
    assert "support_give" in names(verdict)
    assert verdict.failed
    assert floating.surface.covariance is None
    assert all(math.isnan(end) for p in floating.parameters if p.held is None for end in p.interval)


@pytest.mark.slow(6)
@pytest.mark.parametrize(
    "problem",
    [np.linalg.LinAlgError("singular"), edge.InputError("no contacts")],
)
def test_causes_that_leave_no_fit_leave_the_one_before(small, monkeypatch, problem):
    """On bearings that no file states the likely causes are not those of the drive."""
    fitted = Explanation.fitted

    def without_causes(search, hypothesis):
        if hypothesis.misfit.columns:
            raise problem
        return fitted(search, hypothesis)

    monkeypatch.setattr(Explanation, "fitted", without_causes)
    found, _ = identified("disc and cranks on bearings", small, 0, turns=1)
    assert found.verdict.state == "not explained"
    assert all(math.isnan(end) for p in found.parameters if p.held is None for end in p.interval)


@pytest.mark.slow(0)
def test_the_verdict_comes_first(floating, tmp_path):
    sentence = floating.verdict.sentence
    assert sentence.startswith("Not explained: ")
    assert "supports that are compliant" in sentence
    content = json.loads(edge.json_text(as_json(floating)))
    assert next(iter(content.items())) == ("verdict", sentence)
    assert content["validation"]["state"] == "not explained"
    one = next(p for p in floating.parameters if p.held is None)
    assert content["parameters"][one.name]["interval"] == [None, None]
    report(floating, tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert 0 < text.index('id="verdict"') < text.index("<h2>")
    assert "withheld" in text


@pytest.mark.slow(2)
def test_a_load_that_is_not_predicted_falsifies_and_the_noise_of_the_fit_is_no_yardstick(small, monkeypatch):
    """By errors alone it has several times the noise between its orders; their fit calls all of it noise."""

    def without_causes(held_out, explained):
        return held_out.start(explained.hypothesis.prior)[1]

    monkeypatch.setattr(Prediction, "again", without_causes)
    found, _ = identified("run-out 60″, orders 2 and 3", small, 0)
    assert found.held_out.noise == pytest.approx(0.5 * ARCSEC, rel=0.35)
    assert found.held_out.residual > 4.0 * found.held_out.noise
    assert names(found.verdict) == {"run_out"}
    assert found.verdict.state == "not explained"
    assert "held out of the fit, were predicted to" in found.verdict.failed[-1]


@pytest.mark.slow(10)
@pytest.mark.parametrize(
    "effect", ["run-out 60″, orders 2 and 3", "zero drifts 12″ and a 4″ wave", "ring shifts 4 µm with the load"]
)
def test_causes_predict_a_load_that_is_kept_back(small, effect):
    """Errors alone miss it by 2.6 to 20 times its noise; what is a recording's own is not asked for."""
    found, _ = identified(effect, small, 0)
    assert found.verdict.state == "explained but for"
    assert found.held_out.residual < 1.3 * found.held_out.noise


@pytest.mark.slow(5)
def test_a_late_clock_is_timed_and_corrected(small):
    found, values = identified("speed ripple and an output clock 30 µs late", small, 0)
    assert names(found.verdict) == {"clock_lag"}
    low, high = found.clock_lag.interval
    assert low < 30e-6 < high
    assert high - low < 3e-6
    assert any(note.startswith("The output angle's clock is ") for note in found.notes)
    assert np.abs([*scores(found, values).values()]).max() < 4.0


@pytest.mark.slow(10)
def test_effects_are_explained_or_told(record_property):
    """Right causes, few false alarms, coverage; a fortieth of CYCLOID_SEEDS drives, or some effects with few."""
    seeds = study_size("CYCLOID_SEEDS", 5, 200)
    drives = max(1, seeds // 40)
    for effect in list(EFFECTS)[:: 1 if seeds >= 40 else 5]:
        found = [outcome(effect, seed) for seed in range(drives)]
        right = sum(map(is_right, found))
        stated = np.abs([away for one in found for away in one["away"].values()])
        inside = f", {np.mean(stated < 1.96):.3f} of {stated.size} intervals hold the truth" if stated.size else ""
        record_property(effect, f"told rightly in {right} of {drives} drives{inside}")
        assert right >= 0.8 * drives, effect
        if stated.size:
            assert np.mean(stated < 1.96) >= 0.90 - 2.0 * np.sqrt(0.1 * 0.9 / stated.size), effect
