"""The rated torque is the load wherever none is given: the same results as with it, and one sentence without it."""

import shutil

import numpy as np
import pytest
from common import EXAMPLES, PAIR, make_pair

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.studies.limits import Requirements

MISSING = "--torque is missing; give it, or state [pair] rated_torque in p.toml.\n"
# Commands without a load; the rest of their words makes them short.
COMMANDS = (
    "cycloid-fmu analyze p.toml --angles 20",
    "cycloid-fmu analyze p.toml --angles 20 --limits limits.toml",
    "cycloid-fmu draw p.toml -o p.svg",
    "cycloid-fmu sweep p.toml --vary face_width=9,10.mm --angles 20 --workers 1",
    "cycloid-fmu wear p.toml --wear wear.toml --crank-turns 1e3",
    "cycloid-fit plan p.toml --turns 0.1 --samples 6",
)
LIMITS = 'format = "cycloid-requirements/1"\n[limits]\nbacklash = "9 arcmin"\n'


@pytest.fixture
def folder(tmp_path):
    shutil.copy(EXAMPLES / "wear.toml", tmp_path)
    (tmp_path / "limits.toml").write_text(LIMITS)
    return tmp_path


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_takes_the_rated_torque(words, command, folder):
    split = [word.replace(".mm", " mm") for word in words.split()]
    (folder / "p.toml").write_text(PAIR + 'rated_torque = "181 N*m"\n[modification]\noffset = "-40 um"\n')
    default, given = command(*split), command(*split, "--torque", "181 N*m")
    assert default.returncode == given.returncode == 0, default.stderr
    assert default.stdout == given.stdout
    (folder / "p.toml").write_text(PAIR)
    unrated = command(*split)
    assert (unrated.returncode, unrated.stderr) == (2, MISSING)


def test_python_takes_the_rated_torque():
    drive, unrated = cy.Drive(make_pair(rated_torque="181 N*m")), cy.Drive(make_pair())
    assert drive.analyze(angles=5).equals(drive.analyze("181 N*m", angles=5))
    assert drive.motion().torque.tolist() == [181.0]
    wanted = Requirements(limits={"max_contact_pressure": "1 GPa"})
    assert drive.judge(wanted, angles=5).verdicts == drive.judge(wanted, 181.0, angles=5).verdicts
    names = ["eccentricity"]
    assert np.array_equal(drive.sensitivity(None, names, angles=5), drive.sensitivity(181.0, names, angles=5))
    for use in (unrated.analyze, unrated.motion, unrated.sensitivity, lambda: unrated.judge(wanted)):
        with pytest.raises(edge.ArgumentError, match=r"^torque is missing; give it, or state \[pair\] rated_torque"):
            use()


def test_an_fmu_runs_at_the_rated_torque_that_it_states(command, folder):
    (folder / "p.toml").write_text(PAIR + 'rated_torque = "181 N*m"\n[modification]\noffset = "-40 um"\n')
    assert command("cycloid-fmu", "build", "p.toml", "-o", "p.fmu").returncode == 0
    words = ["cycloid-fmu", "simulate", "p.fmu", "--turns", "0.1"]
    assert command(*words).stdout == command(*words, "--torque", "181 N*m").stdout
    bench = ["cycloid-bench", "simulate", "--fmu", "p.fmu", "--turns", "2"]
    assert command(*bench, "-o", "a.arrows").returncode == 0
    assert command(*bench, "-o", "b.arrows", "--torque", "181 N*m", "--ratio", "-39").returncode == 0
    import drivers

    first, second = (drivers.read_recording(folder / name) for name in ("a.arrows", "b.arrows"))
    assert first.header.ratio == second.header.ratio == -39.0
    for name, samples in first.samples.items():
        assert np.array_equal(samples.value, second.samples[name].value)
    (folder / "p.toml").write_text(PAIR)
    assert command("cycloid-fmu", "build", "p.toml", "-o", "u.fmu").returncode == 0
    for run in (command("cycloid-fmu", "simulate", "u.fmu"), command("cycloid-bench", "simulate", "--fmu", "u.fmu")):
        assert (run.returncode, run.stderr) == (2, "--torque is missing; give it: u.fmu states no rated_torque.\n")
