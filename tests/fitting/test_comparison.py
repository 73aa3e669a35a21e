import json

import numpy as np
import pytest
from test_metrics import ARCMIN, ARCSEC, figures_from, loop

from fitting.figures.comparison import changes_between


def noisy(seed, *, stiffness=49.0, play=0.6):
    torque, angle = loop(167.0, stiffness / ARCMIN, play * ARCMIN, 2.0, loops=3)
    return torque, angle + np.random.default_rng(seed).normal(0, 0.3 * ARCSEC, angle.size)


def test_only_what_was_changed_moves():
    """More play moves hysteresis loss, backlash and lost motion by as much, and leaves the stiffness where it was."""
    before, after = figures_from(*noisy(1)).figures, figures_from(*noisy(2, play=0.7)).figures
    changes = {c.name: c for c in changes_between(before, after)[0]}
    for name in ("hysteresis_loss", "backlash", "lost_motion"):
        assert changes[name].moved
        assert changes[name].difference == pytest.approx(0.1 * ARCMIN, abs=2 * changes[name].uncertainty)
    assert not changes["torsional_stiffness"].moved
    assert "torsional_stiffness.positive" in changes


@pytest.mark.slow(6)
def test_the_same_drive_measured_again_seldom_moves():
    figures = [figures_from(*noisy(seed)).figures for seed in range(40)]
    moved = [c.moved for a, b in zip(figures[::2], figures[1::2], strict=True) for c in changes_between(a, b)[0]]
    assert np.mean(moved) < 0.1


def test_what_can_not_be_compared_is_said():
    torque, angle = noisy(1)
    whole, half = figures_from(torque, angle).figures, figures_from(torque[torque > 0], angle[torque > 0]).figures
    changes, notes = changes_between(whole, half)
    assert {c.name for c in changes} == {"torsional_stiffness", "torsional_stiffness.positive"}
    assert "lost_motion: only the first has it." in notes
    other = figures_from(torque, angle, rated=150.0).figures
    changes, notes = changes_between(whole, other)
    assert changes == []
    assert "use the same rated torque for both" in notes[0]


@pytest.mark.slow(2)
def test_compare_from_the_command_line(command, tmp_path):
    """A recording against figures that were written before."""
    for name, play in (("a", 0.6), ("b", 0.7)):
        torque, angle = noisy(3, play=play)
        rows = [f"{i / 100:.2f},0,{a / ARCSEC:.9f},{t:.9f}" for i, (t, a) in enumerate(zip(torque, angle, strict=True))]
        header = "time [s],input_angle [deg],output_angle [arcsec],torque [N*m]"
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    options = ("--rated-torque", "167 N*m")
    assert command("cycloid-fit", "metrics", "a.csv", *options, "-o", "a.json").returncode == 0
    run = command("cycloid-fit", "compare", "a.json", "b.csv", *options, "--plot", "moved.png", "--json")
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found["backlash"]["moved"] is True
    assert found["backlash"]["difference"] == pytest.approx(0.1 * ARCMIN, rel=1e-6)  # the same noise in both
    assert found["torsional_stiffness"]["moved"] is False
    assert (tmp_path / "moved.png").stat().st_size > 10000
    (tmp_path / "b.json").write_text('{"format": "cycloid-figures/1", "backlash": {"value": "x"}}')
    for other, said in (("b.json", "is incomplete"), ("missing.json", "No such file")):
        run = command("cycloid-fit", "compare", "a.json", other)
        assert run.returncode == 2
        assert said in run.stderr
        assert "Traceback" not in run.stderr
