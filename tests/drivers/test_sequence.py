"""A test sequence from its file to its recordings: prompted, waited for, and driven by a plug-in."""

import contextlib
import importlib.metadata
import math
import os
import pty
import re
import signal
import threading
import time
import tty
from typing import ClassVar

import numpy as np
import pytest
from common import EXAMPLES

from cycloid_fmu import edge
from drivers.lines import BusConfig
from drivers.recorder import bench
from drivers.recorder.actuator import Actuator, ActuatorConfig
from drivers.recorder.sequence import read_sequence, run_sequence, shortfalls
from drivers.recording_format import read_recording
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_hysteresis, simulate_motion

SEQUENCE = """format = "cycloid-sequence/1"
bench = "BENCH.toml"
loads = ["20 N*m"]
speeds = ["300 rpm"]
directions = ["forward", "backward"]
turns = 3
load_tolerance = "1 N*m"
speed_tolerance = "30 rpm"
"""


class MotorConfig(ActuatorConfig):
    """Turns of the simulated bench after the step's own."""

    bus: str
    more: float = 1.0


class Motor(Actuator):
    """Switches on a simulated bench that makes the motion of each step, and notes what it was asked for."""

    configuration, line = MotorConfig, BusConfig
    noted: ClassVar[list[str]] = []

    def __init__(self, name, config, line):
        super().__init__(name, config, line)
        self.channel, self.benches = line.channel, contextlib.ExitStack()

    def __enter__(self):
        self.noted.append("open")
        return self

    def set(self, step):
        self.noted.append(step.name)
        options = {"hysteresis": True, "samples_per_turn": 4000} if step.is_hysteresis else {"speed": step.speed}
        turns = int(step.turns + (0 if step.is_hysteresis else self.config.more))
        made = moved(torque=step.torque, turns=turns, direction=step.direction, **options)
        self.benches.enter_context(
            SimulatedCanBench(made, SimulatedCan(interface="virtual", channel=self.channel, speed_factor=1.0))
        )

    def cycle(self, step):
        self.noted.append("cycle")

    def stop(self):
        self.benches.close()
        self.noted.append("stop")

    def close(self):
        self.noted.append("close")


@pytest.fixture
def motor(monkeypatch, wiring):
    """The bench file with an `[actuator]`, whose plug-in is registered."""
    point = importlib.metadata.EntryPoint("motor", f"{__name__}:Motor", Actuator.group)
    points = importlib.metadata.EntryPoints([*importlib.metadata.entry_points(group="cycloid.encoders"), point])
    monkeypatch.setattr(bench, "registered", lambda group: points.select(group=group))
    monkeypatch.setattr(Motor, "noted", [])
    wiring.write_text(wiring.read_text() + '[actuator]\nprotocol = "motor"\nbus = "can0"\n')
    return wiring


@pytest.fixture
def wiring(tmp_path, bus_name):
    motion = simulate_motion(lambda angle, torque: -angle / 39, SimulatedRun(torque=20.0, turns=1))
    return SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)).write_wiring(
        tmp_path / "BENCH.toml", ratio=-39
    )


def test_a_driven_sequence_records_every_step_and_stops_the_bench_after_each(command, tmp_path, motor):
    path = tmp_path / "sequence.toml"
    path.write_text(SEQUENCE + '[hysteresis]\ntorque = "100 N*m"\n')
    done = command("cycloid-bench", "run", path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("recorded") == 3
    assert "Press Enter" not in done.stderr
    steps = ["300rpm-20Nm-forward", "300rpm-20Nm-backward", "hysteresis-100Nm"]
    first, second, loop = ([name, "stop"] for name in steps)
    assert Motor.noted == ["open", *first, *second, loop[0], "cycle", "stop", "stop", "close"]
    for direction, sign in (("forward", 1), ("backward", -1)):
        recording = read_recording(tmp_path / f"300rpm-20Nm-{direction}.arrows")
        assert recording.header.conditions["direction"] == direction
        angle, torque = recording.samples["input_angle"].value, recording.samples["torque"].value
        assert sign * (angle[-1] - angle[0]) >= 6 * math.pi
        np.testing.assert_allclose(torque, sign * 20.0, atol=1e-3)
    looped = read_recording(tmp_path / "hysteresis-100Nm.arrows").samples
    assert np.ptp(looped["input_angle"].value) == 0
    assert looped["torque"].value.max() == pytest.approx(100, rel=0.02)
    assert looped["torque"].value.min() == pytest.approx(-100, rel=0.02)


@pytest.mark.parametrize("at", ["wait", "recording", "set"])
def test_the_bench_is_stopped_at_every_end_of_a_run(tmp_path, motor, monkeypatch, at):
    motor.write_text(motor.read_text() + "more = 300.0\n")
    path = tmp_path / "sequence.toml"
    path.write_text(SEQUENCE.replace("turns = 3", "turns = 200") + f'wait = "{60 if at == "wait" else 0} s"\n')
    seen = []

    def interrupt(live=None):
        if not seen:
            seen.append(threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)))
            seen[0].start()

    if at == "wait":
        interrupt()
    elif at == "set":
        monkeypatch.setattr(Motor, "set", lambda self, step: 1 / 0)
    with pytest.raises(ZeroDivisionError if at == "set" else KeyboardInterrupt):
        run_sequence(path, progress=interrupt if at == "recording" else None)
    assert Motor.noted[-3:] == ["stop", "stop", "close"]
    assert [p.name for p in tmp_path.glob("*.arrows")] == ["300rpm-20Nm-forward.trial-1.arrows"] * (at == "recording")


def test_a_bench_that_runs_by_itself_is_waited_for(command, tmp_path, wiring, bus_name):
    one_way = SEQUENCE.replace('"forward", "backward"', '"forward"')
    (tmp_path / "sequence.toml").write_text(one_way + 'wait = "0.5 s"\n')
    with SimulatedCanBench(
        moved(torque=20.0, turns=4), SimulatedCan(interface="virtual", channel=bus_name, speed_factor=8.0)
    ):
        begun = time.monotonic()
        run = command("cycloid-bench", "run", "sequence.toml")
        assert time.monotonic() - begun > 0.5
    assert run.returncode == 0, run.stderr
    assert "Press Enter" not in run.stderr


def test_the_documented_actuator_sends_each_step_s_torque_and_speed(tmp_path, monkeypatch):
    text = (EXAMPLES.parent / "docs" / "encoder.md").read_text(encoding="utf-8")
    code = re.search(r"<!-- actuator -->\n```python\n(.*?)```", text, re.S)[1]
    (tmp_path / "brake.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    point = importlib.metadata.EntryPoint("brake", "brake:Brake", Actuator.group)
    amt21 = importlib.metadata.entry_points(group="cycloid.encoders").select(name="amt21")
    points = importlib.metadata.EntryPoints([*amt21, point])
    monkeypatch.setattr(bench, "registered", lambda group: points.select(group=group))
    controller, line = pty.openpty()
    tty.setraw(line)
    (tmp_path / "BENCH.toml").write_text(
        f'format = "cycloid-bench/1"\nratio = 39.0\n[port.p]\nurl = "{os.ttyname(line)}"\n'
        '[channel.input_angle]\nprotocol = "amt21"\nport = "p"\n[actuator]\nprotocol = "brake"\nport = "p"\n'
    )
    (tmp_path / "sequence.toml").write_text(SEQUENCE + '[hysteresis]\ntorque = "100 N*m"\n')
    sequence = read_sequence(tmp_path / "sequence.toml")
    with sequence.bench.new_actuator() as brake:
        for step in sequence.steps:
            brake.set(step)
        brake.cycle(sequence.steps[-1])
    sent = os.read(controller, 4096).decode().split("\n")
    # A brake opposes the motion: with a positive ratio the output turns as the crank does.
    turning = ["S31.4159 T-20.000", "S-31.4159 T20.000", "S0.0000 T0.000"]
    assert sent == ["S0.0000 T0.000", *turning, "L100.000 N1", "S0.0000 T0.000", ""]
    os.close(controller)
    os.close(line)


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
        self.benches.enter_context(
            SimulatedCanBench(now, SimulatedCan(interface="virtual", channel=self.bus_name, speed_factor=8.0))
        )
        return "\n"


def moved(**options):
    made = simulate_hysteresis if options.pop("hysteresis", False) else simulate_motion
    return made(lambda angle, torque: -angle / 39 + 1e-6 * torque, SimulatedRun(**{"speed": 10 * math.pi, **options}))


@pytest.mark.slow(7)
def test_a_prompted_sequence_repeats_a_step_that_fell_short(command, tmp_path, wiring, bus_name):
    """First with a wrong brake torque, then all steps. No prompt remains."""
    (tmp_path / "sequence.toml").write_text(
        SEQUENCE.replace("turns = 3", "turns = 40") + '[hysteresis]\ntorque = "100 N*m"\n'
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
