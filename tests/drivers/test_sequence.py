"""A test sequence from its file to its recordings, driven by a simulated bench in its own process."""

import contextlib
import itertools
import math
import os
import sys

import numpy as np
import pytest

from cycloid_fmu import edge
from drivers.recorder.sequence import read_sequence, shortfalls
from drivers.recording_format import read_recording
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_hysteresis, simulate_motion
from tests.drivers.test_bench_cli import ENVIRONMENT, needs_multicast

numbers = itertools.count(10)

SEQUENCE = """format = "cycloid-sequence/1"
bench = "BENCH.toml"
loads = ["20 N*m"]
speeds = ["300 rpm"]
directions = ["forward", "backward"]
turns = 3
load_tolerance = "1 N*m"
speed_tolerance = "30 rpm"
"""


def drive(group):
    cycloid_bench = f"'{sys.executable}' -m drivers.cli"
    common = f"--ratio -39 --channel {group} --speed-factor 1 --speed '300 rpm'"
    return f"""
[hysteresis]
torque = "100 N*m"
[drive]
run = "{cycloid_bench} simulate {common} --torque '{{torque}}' --turns 4 --direction {{direction}}"
hysteresis = "{cycloid_bench} simulate {common} --torque '{{torque}}' --turns {{turns}} --hysteresis"
"""


@pytest.fixture
def wiring(tmp_path, bus_name):
    motion = simulate_motion(lambda angle, torque: -angle / 39, SimulatedRun(torque=20.0, turns=1))
    return SimulatedCanBench(motion, channel=bus_name).write_wiring(tmp_path / "BENCH.toml", ratio=-39)


@needs_multicast
def test_a_driven_sequence_records_every_step(command, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    group = f"239.75.{os.getpid() % 250}.{next(numbers)}"
    path = tmp_path / "sequence.toml"
    path.write_text(SEQUENCE + drive(group))
    done = command("cycloid-bench", "run", path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("recorded") == 3
    for direction, sign in (("forward", 1), ("backward", -1)):
        recording = read_recording(tmp_path / f"300rpm-20Nm-{direction}.arrows")
        assert recording.header.conditions["direction"] == direction
        angle, torque = recording.samples["input_angle"].value, recording.samples["torque"].value
        assert sign * (angle[-1] - angle[0]) >= 6 * math.pi
        np.testing.assert_allclose(torque, sign * 20.0, atol=1e-3)
    loop = read_recording(tmp_path / "hysteresis-100Nm.arrows").samples
    assert np.ptp(loop["input_angle"].value) == 0
    assert loop["torque"].value.max() == pytest.approx(100, rel=0.02)
    assert loop["torque"].value.min() == pytest.approx(-100, rel=0.02)


class Person:
    """Answers the prompts in turn: a motion is started on the bench before Enter, a text is typed."""

    def __init__(self, bus_name, *script):
        self.bus_name, self.script = bus_name, list(script)
        self.benches = contextlib.ExitStack()

    def readline(self):
        now = self.script.pop(0)
        if isinstance(now, str):
            return now + "\n"
        self.benches.close()  # the bench of the previous step is switched off
        self.benches.enter_context(SimulatedCanBench(now, channel=self.bus_name, speed_factor=8.0))
        return "\n"


def moved(**options):
    made = simulate_hysteresis if options.pop("hysteresis", False) else simulate_motion
    return made(lambda angle, torque: -angle / 39 + 1e-6 * torque, SimulatedRun(**{"speed": 10 * math.pi, **options}))


@pytest.mark.slow(7)
def test_a_prompted_sequence_repeats_a_step_that_fell_short_and_writes_the_report(command, tmp_path, wiring, bus_name):
    """First with a wrong brake torque, then all steps, then the real `cycloid-fit report`. No prompt remains."""
    from common import EXAMPLES

    (tmp_path / "drive.toml").write_text((EXAMPLES / "drive-39-40.toml").read_text())
    handed = 'pair = "drive.toml"\nreport = "report.html"\n'
    (tmp_path / "sequence.toml").write_text(
        SEQUENCE.replace("turns = 3", "turns = 40") + handed + '[hysteresis]\ntorque = "100 N*m"\n'
    )
    person = Person(
        bus_name,
        moved(torque=15.0, turns=41),
        "y",
        moved(torque=20.0, turns=41),
        moved(torque=-20.0, turns=41, direction="backward"),
        moved(torque=100.0, turns=1, samples_per_turn=4000, hysteresis=True),
    )
    with person.benches:
        run = command("cycloid-bench", "run", "sequence.toml", input=person)
    assert run.returncode == 0, run.stderr
    assert person.script == []
    assert "1 of 3: 300 rpm forward, +20 N*m on the output, 40 crank turns." in run.stdout
    assert "3 of 3: Lock the input. Torque 0 → +100 → 0 → −100 → 0 N*m, 1 times." in run.stdout
    short = "300rpm-20Nm-forward.trial-1.arrows: not reached: the mean torque is 15 N*m, not 20 ± 1."
    assert short in run.stderr
    assert run.stderr.count("Press Enter when the bench is running") == 4
    kept = {p.name for p in tmp_path.glob("*.arrows")}
    steps = {"300rpm-20Nm-forward.arrows", "300rpm-20Nm-backward.arrows", "hysteresis-100Nm.arrows"}
    assert kept == steps | {"300rpm-20Nm-forward.trial-1.arrows"}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("Angular transmission error", "Lost motion", *steps))
    assert "trial-1" not in page


def test_an_abandoned_step_is_kept_and_reported_and_recorded_steps_are_skipped(command, tmp_path, wiring, bus_name):
    (tmp_path / "sequence.toml").write_text(SEQUENCE)
    person = Person(bus_name, moved(torque=20.0, turns=4), moved(torque=-20.0, turns=4), "n")
    with person.benches:
        run = command("cycloid-bench", "run", "sequence.toml", input=person)
    assert run.returncode == 1, run.stdout + run.stderr
    assert "the crank turns forward, not backward" in run.stderr
    assert {p.name for p in tmp_path.glob("*.arrows")} == {
        "300rpm-20Nm-forward.arrows",
        "300rpm-20Nm-backward.trial-1.arrows",
    }
    # Run again, it continues with the missing step, under the next free name.
    person = Person(bus_name, moved(torque=-20.0, turns=4, direction="backward"))
    with person.benches:
        run = command("cycloid-bench", "run", "sequence.toml", input=person)
    assert run.returncode == 0, run.stderr
    assert run.stderr.count("Press Enter when the bench is running") == 1
    assert (tmp_path / "300rpm-20Nm-backward.arrows").exists()


def step_and_samples(tmp_path, wiring, step_number=0, motion=None, **run_options):
    path = tmp_path / "sequence.toml"
    path.write_text(SEQUENCE + '[hysteresis]\ntorque = "100 N*m"\n')
    sequence = read_sequence(path)
    step = sequence.steps[step_number]
    given = SimulatedRun(**{"torque": step.torque, "turns": 3, "speed": 10 * math.pi, **run_options})
    made = motion(lambda a, t: -a / 39, given) if motion else simulate_motion(lambda a, t: -a / 39, given)
    from drivers.recording_format import Samples

    roles = {"input_angle": made.input_angle, "output_angle": made.output_angle, "torque": made.torque}
    return shortfalls(step, {n: Samples.checked(n, made.time, v) for n, v in roles.items()}, sequence.file)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"torque": 17.0}, r"the mean torque is 17 N\*m, not 20 ± 1"),
        ({"torque": -20.0}, r"the mean torque is -20 N\*m"),
        ({"direction": "backward"}, "the crank turns backward, not forward"),
        ({"turns": 2}, r"the crank makes 1.99 turns, not 3"),
        ({"speed": 5 * math.pi}, r"the mean speed is 150 rpm, not 300 ± 30"),
        ({"torque_noise": 10.0}, "the torque varies by"),
    ],
)
def test_a_step_that_falls_short_states_the_reason(tmp_path, wiring, options, said):
    found = step_and_samples(tmp_path, wiring, **options)
    if said is None:
        assert found == []
    else:
        import re

        assert any(re.search(said, s) for s in found), found


def test_a_loop_that_falls_short_states_the_reason(tmp_path, wiring):
    assert step_and_samples(tmp_path, wiring, 2, simulate_hysteresis, turns=1, torque=100.0) == []
    found = step_and_samples(tmp_path, wiring, 2, simulate_hysteresis, turns=1, torque=90.0)
    assert found == [
        "the highest torque reaches 90 of 100 N*m",
        "the lowest torque reaches 90 of 100 N*m",
    ]
    assert any("not locked" in s for s in step_and_samples(tmp_path, wiring, 2))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            '"20 N*m"',
            '"300000 N*m"',
            r"loads: 300000 N\*m is outside the range of the torque sensor, -2",
        ),
        ("turns = 3", "turns = 0", "turns = 0: it should be greater than 0"),
        ("turns = 3", "twists = 3", "twists is not a known key"),
        ('["300 rpm"]', "[]", "loads and speeds belong together"),
        ("BENCH.toml", "none.toml", "none.toml: No such file"),
    ],
)
def test_an_invalid_sequence_is_refused_in_one_sentence(tmp_path, wiring, old, new, said):
    path = tmp_path / "sequence.toml"
    path.write_text(SEQUENCE.replace(old, new))
    with pytest.raises(edge.InputError, match=said):
        read_sequence(path)
