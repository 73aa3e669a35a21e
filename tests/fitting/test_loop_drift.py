"""Drift, virgin branches and friction of loops, of an independently simulated drive: play, spring, Maxwell slip."""

import itertools

import numpy as np
import pytest

import fitting
from cycloid_fmu import edge
from fitting.figures.comparison import read_figures
from fitting.figures.hysteresis import drift_of
from fitting.figures.metrics import figures_json, figures_of
from fitting.readers.recording import Recording
from fitting.reports.panels import panels_of
from fitting.transmission_error.survey import survey

ARCMIN = np.pi / 10800
RATED, STIFFNESS, EACH = 167.0, 30.0, 500  # N·m, N·m/arcmin, samples a branch
NAMES = ("hysteresis_loss", "backlash", "lost_motion", "torsional_stiffness")


def swung(lobes):
    """A torque that goes from zero to each side in turn and back."""
    up = np.arange(EACH) / EACH
    return RATED * np.concatenate([side * way for side in lobes for way in (up, 1.0 - up)] + [[0.0]])


def wound(torque, play, thresholds):
    """Windup in arcmin: Maxwell slip elements that begin relaxed, each an equal share of the spring, then the play."""
    state, passed = np.zeros(len(thresholds)), []
    for now in torque:
        state = np.clip(state, now - thresholds, now + thresholds)
        passed.append(state.mean())
    return np.array(passed) / STIFFNESS + np.clip(1e9 * np.array(passed), -play / 2, play / 2)


def figures(torque, windup, drift=0.0, noise=0.5 / 60, seed=0):
    """The product's figures of a loop that drifts by so many arcmin in the time of four branches."""
    time = 0.01 * np.arange(torque.size)
    angle = windup + drift * time / (0.04 * EACH) + np.random.default_rng(seed).normal(0.0, noise, time.size)
    made = Recording(
        time,
        0.0 * time,
        angle * ARCMIN,
        torque,
        np.zeros(time.size, np.uint8),
        common_zero=True,
        known_index=True,
        ratio=-39.0,
        source="loop.csv",
        checksum="",
    )
    surveyed = survey(made, -39.0, RATED)
    return figures_of([surveyed], -39.0, RATED), surveyed.loops


COULOMB, SPREAD = np.array([3.0]), np.linspace(0.5, 5.5, 20)
STRONG, STRONG_SPREAD = np.array([10.3]), np.linspace(0.6, 20.0, 20)


def steady(play, thresholds):
    """The figures by their definitions: of an endless loop, without noise or drift, read off exactly."""
    torque = swung([1, -1, 1, -1])
    windup = wound(torque, play, thresholds)
    lobes = [slice(2 * EACH * n, 2 * EACH * (n + 1) + 1) for n in (2, 3)]
    branch = {}
    for sign, lobe in zip((1, -1), lobes, strict=True):
        load, wind = np.abs(torque[lobe]), windup[lobe]
        up, down = (load[: EACH + 1], wind[: EACH + 1]), (load[: EACH - 1 : -1], wind[: EACH - 1 : -1])
        branch[sign] = [lambda share, b=b: np.interp(share * RATED, *b) for b in (up, down)]
    width = 0.5 * sum(sign * (branch[sign][1](0.5) - branch[sign][0](0.5)) for sign in (1, -1))
    share = np.linspace(0.03, 0.1, 300)
    loss = sum(sign * np.polyfit(share, branch[sign][1](share), 1)[1] for sign in (1, -1))
    lost = sum(0.5 * sign * b(0.03) for sign in (1, -1) for b in branch[sign])
    return dict(zip(NAMES, np.array([loss, loss - width, lost, STIFFNESS / ARCMIN**2]) * ARCMIN, strict=True))


@pytest.mark.parametrize("seeds", [4, pytest.param(16, marks=pytest.mark.slow(1))])
@pytest.mark.parametrize("drift", [0.0, 0.3, -0.3])
@pytest.mark.parametrize(
    "thresholds", [COULOMB, pytest.param(SPREAD, marks=pytest.mark.slow(2))], ids=["Coulomb", "Maxwell slip"]
)
@pytest.mark.parametrize(
    "lobes",
    [
        [1, -1],
        [-1, 1],
        pytest.param([1, -1, 1], marks=pytest.mark.slow(1)),
        pytest.param([1, -1] * 3, marks=pytest.mark.slow(3)),
    ],
    ids=len,
)
def test_a_drift_is_taken_off_and_the_intervals_hold_the_truth(lobes, thresholds, drift, seeds):
    """95 % intervals over seeds; a drift of 0.3′ moved the hysteresis loss of a single loop by 0.15′, 15 of its own."""
    torque = swung(lobes)
    windup, truth = wound(torque, 0.5, thresholds), steady(0.5, thresholds)
    inside = dict.fromkeys(NAMES, 0)
    for seed in range(seeds):
        found, _ = figures(torque, windup, drift, seed=seed)
        assert any("the windup drifts by" in note for note in found.notes) == bool(drift)
        for name, figure in found.figures.items():
            inside[name] += abs(figure.value - truth[name]) <= figure.uncertainty
    assert min(inside.values()) >= 0.75 * seeds, inside
    assert sum(inside.values()) >= 0.87 * 4 * seeds, inside


def test_the_drift_is_that_of_the_recording():
    """0.3′ in the 20 s of four branches, from branches passed again or from the two sides of one loop."""
    for lobes, repeated in (([1, -1], False), ([1, -1, 1], True), ([1, 1], True)):
        torque = swung(lobes)
        _, data = figures(torque, wound(torque, 0.5, COULOMB), 0.3)
        drift = drift_of(data)
        assert drift.repeated == repeated
        assert drift.rate == pytest.approx(0.3 * ARCMIN / (0.04 * EACH), abs=3.0 * drift.uncertainty)
        assert 0.0 < drift.uncertainty < 0.1 * drift.rate
    torque = swung([1])
    assert drift_of(figures(torque, wound(torque, 0.5, COULOMB))[1]) is None


def test_friction_that_differs_from_side_to_side_is_no_drift():
    torque = swung([1, -1])
    windup = wound(torque, 0.5, COULOMB)
    windup[(torque > 0) & (np.arange(torque.size) >= EACH)] += 0.1
    found, _ = figures(torque, windup)
    assert not any("drifts" in note for note in found.notes)
    assert found.figures["torsional_stiffness"].value * ARCMIN == pytest.approx(STIFFNESS, rel=0.005)


@pytest.mark.slow(4)
@pytest.mark.parametrize("thresholds", [STRONG, STRONG_SPREAD], ids=["Coulomb", "Maxwell slip"])
def test_a_virgin_loop_gives_the_lost_motion_of_a_steady_one(thresholds):
    """Friction of 6 % of the rated torque: with the virgin branch lost motion was 0.57′, not 0.33′."""
    truth = steady(0.6, thresholds)["lost_motion"]
    for lobes, virgin in (([1, -1], True), ([-1, 1], True), ([1, -1, 1], False), ([1, -1] * 3, False)):
        torque = swung(lobes)
        windup = wound(torque, 0.6, thresholds)
        held = 0
        for seed in range(10):
            found, _ = figures(torque, windup, seed=seed)
            lost = found.figures["lost_motion"]
            held += abs(lost.value - truth) <= lost.uncertainty
            assert any("only a virgin loop" in note for note in found.notes) == virgin
            (note,) = (n for n in found.notes if "inside the friction band" in n)
            assert "±5.01 N·m" in note
        assert held >= 8, (lobes, held, lost.value / ARCMIN, truth / ARCMIN)
    if thresholds is STRONG:
        assert truth == pytest.approx(0.06 * RATED / STIFFNESS * ARCMIN, rel=1e-3)  # the play is not in it


def test_a_recording_that_begins_in_a_steady_loop_is_not_called_virgin():
    """Cut out of a longer one: it ends where it began."""
    torque = swung([1, -1, 1, -1])
    windup = wound(torque, 0.5, STRONG)
    found, _ = figures(torque[4 * EACH :], windup[4 * EACH :])
    assert not any("virgin" in note for note in found.notes)
    lost = found.figures["lost_motion"]
    assert lost.value == pytest.approx(steady(0.5, STRONG)["lost_motion"], abs=1.5 * lost.uncertainty)


def test_friction_below_the_load_of_lost_motion_is_not_noted():
    for lobes in ([1, -1], [1, -1, 1]):
        torque = swung(lobes)
        found, _ = figures(torque, wound(torque, 0.5, COULOMB))
        assert not any("friction band" in note for note in found.notes)


def test_too_few_samples_to_tell_a_drift_are_said():
    torque = swung([1, -1])
    windup = wound(torque, 0.5, COULOMB)
    kept = (np.abs(torque) < 0.2 * RATED) | (np.abs(torque) > 0.85 * RATED)
    found, _ = figures(torque[kept], windup[kept])
    assert any("a drift of the windup cannot be determined" in note for note in found.notes)


def test_stiffness_by_segments_is_that_of_the_spring_there():
    """A spring of 20, 30 and 50 N·m/arcmin up to 25, 83.5 and 167 N·m, with dry friction of 3 N·m in its way."""
    torque = swung([1, -1] * 2)
    state, el = 0.0, []
    for now in torque:
        state = min(max(state, now - 3.0), now + 3.0)
        el.append(state)
    knees = np.array([0.0, 25.0, 83.5, 200.0])
    at = np.concatenate([[0.0], np.cumsum(np.diff(knees) / [20.0, 30.0, 50.0])])
    windup = np.sign(el) * np.interp(np.abs(el), knees, at)
    time = 0.01 * np.arange(torque.size)
    angle = (windup + 0.2 * time / time[-1] + np.random.default_rng(1).normal(0.0, 0.5 / 60, time.size)) * ARCMIN
    run = fitting.Run(0.0, angle, torque, time=time)
    limits = [6.0, "25 N*m", 88.0, RATED]
    found = fitting.metrics(run, ratio=-39.0, rated_torque=RATED, stiffness_limits=limits)
    segments = found.figures["torsional_stiffness"].segments
    assert [one.interval for one in segments.values()] == [(6.0, 25.0), (25.0, 88.0), (88.0, RATED)]
    for (name, one), known in zip(segments.items(), (20.0, 30.0, 50.0), strict=True):
        assert one.value * ARCMIN == pytest.approx(known, abs=max(1.5 * one.uncertainty * ARCMIN, 0.02 * known)), name
        assert one.uncertainty * ARCMIN < 0.1 * known
        assert set(one.parts) == {"positive", "negative"}
    stated = figures_json(found)["torsional_stiffness"]["segments"]
    assert stated["K3"]["value"] == segments["K3"].value
    (panel,) = (p for p in panels_of(found) if p.title == "Torsional stiffness by torque")
    assert [t.texts for t in panel.traces if t.texts] == [("K1", "K2", "K3") * 2]
    default = fitting.metrics(run, ratio=-39.0, rated_torque=RATED).figures["torsional_stiffness"].segments
    ends = [share * RATED for share in (0.03, 0.15, 0.5, 1.0)]
    assert [one.interval for one in default.values()] == [pytest.approx(e) for e in itertools.pairwise(ends)]
    with pytest.raises(edge.InputError, match="stiffness_limits"):
        fitting.metrics(run, ratio=-39.0, stiffness_limits=[30.0, 10.0])


def test_segments_are_stated_at_the_command_line_and_read_back(command, tmp_path):
    torque = swung([1, -1])
    windup = wound(torque, 0.5, COULOMB) * 60.0
    rows = "\n".join(f"{0.01 * n:.2f},0,{w:.6f},{t:.6f}" for n, (w, t) in enumerate(zip(windup, torque, strict=True)))
    (tmp_path / "loop.csv").write_text(f"time [s],input_angle [deg],output_angle [arcsec],torque [N*m]\n{rows}\n")
    words = ("cycloid-fit", "metrics", "loop.csv", "--rated-torque", "167 N*m", "-o", "f.json", "--stiffness-limits")
    run = command(*words, "25 N*m, 80 N*m, 167 N*m")
    assert run.returncode == 0, run.stderr
    assert "K2, 80 … 167 N·m" in run.stdout
    assert set(read_figures(tmp_path / "f.json")["torsional_stiffness"].segments) == {"K1", "K2"}
    run = command(*words, "25 N*m, 80 mm")
    assert run.returncode == 2
    assert "stiffness" in run.stderr
    assert "80 mm" in run.stderr
