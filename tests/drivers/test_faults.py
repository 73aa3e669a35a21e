"""The table of faults on a bench, and their traces in the recording. Each row is a test."""

import itertools
import os
import re
import subprocess
import sys
import threading
import time
import types

import can
import numpy as np
import pytest
from common import study_size

from cycloid_fmu import edge
from drivers import hubs as hubs_module
from drivers import recording_format as rf
from drivers.can.hub import BLOCK_SECONDS
from drivers.encoder import EncoderError, EncoderSetupError
from drivers.recorder import session
from drivers.recorder.bench import open_encoders
from drivers.recorder.session import record, record_encoders
from drivers.recording_format import read_clocks, read_recording
from drivers.serial import port as serial_port
from drivers.simulated.buses import SimulatedAmt21, SimulatedAscii, SimulatedCan, read_simulation
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.faults import Fault, at_wrong_baud
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.serial_bench import SimulatedAmt21Bench, SimulatedAsciiBench
from tests.drivers.test_bench_cli import ENVIRONMENT, needs_multicast

pytestmark = pytest.mark.system


INPUT, OUTPUT, TORQUE = 0x181, 0x182, 0x2A0
KILLS = study_size("CYCLOID_KILLS", 10, 300)
needs_pty = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")


def ideal(angle, torque):
    return -angle / 39 + 1e-6 * torque


def slow_motion(turns=1, samples_per_turn=96):
    """A motion of more than a second."""
    return simulate_motion(ideal, SimulatedRun(torque=5.0, turns=turns, samples_per_turn=samples_per_turn))


def can_recording(tmp_path, bus_name, faults, motion=None, edit=lambda text: text, idle=0.7, **options):
    motion = motion or slow_motion(2)
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(
        motion, SimulatedCan(interface="virtual", channel=bus_name, faults=faults, **options)
    ) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        toml.write_text(edit(toml.read_text()))
        done = record(toml, path, idle=idle)
    recording = read_recording(path)
    assert recording.problems == ()
    return recording, done, motion


def serial_recording(tmp_path, bench, edit=lambda text: text, **stops):
    path = tmp_path / "run.arrows"
    with bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        toml.write_text(edit(toml.read_text()))
        done = record(toml, path, **({"stop": lambda: bench.wait(0.0)} | stops))
    recording = read_recording(path)
    assert recording.problems == ()
    return recording, done


def texts(recording, channel):
    return [e.text for e in recording.events if e.channel == channel]


def marked(samples, bit):
    return np.flatnonzero(samples.status & bit).tolist()


def lies_on(samples, time, angle, tolerance):
    """Return whether every value occurs in the motion: a wrong one would be off the line."""
    slope = np.gradient(angle, time)
    expected = np.interp((samples.value - angle[0]) / slope[0] + time[0], time, angle)
    return np.max(np.abs(samples.value - expected)) <= tolerance


@needs_pty
def test_cable_unplugged_and_plugged_in(tmp_path):
    bench = SimulatedAmt21Bench(slow_motion(2), SimulatedAmt21(faults=[Fault("pull", 200, by=0.2)]))
    recording, done = serial_recording(tmp_path, bench)
    assert done.failures == ()
    for name in ("input_angle", "output_angle"):
        said = texts(recording, name)
        assert any("failed and will be reopened: The serial port" in t for t in said), said
        assert "samples arrive again" in said
        samples = recording.samples[name]
        gap = np.argmax(np.diff(samples.time_host)) + 1
        assert gap in marked(samples, rf.GAP)
        assert np.diff(samples.time_host)[gap - 1] > 0.2
        assert samples.time_host[-1] - samples.time_host[gap] > 0.3, "it is recorded on"
    # The crank turned by less than half a turn meanwhile; otherwise a multi-turn encoder would be needed.
    assert lies_on(recording.samples["output_angle"], bench.motion.time, bench.motion.output_angle, 1e-3)


@needs_pty
@pytest.mark.parametrize("kind", ["half", "garbage", "wrong_baud"])
def test_half_frames_garbage_and_a_wrong_baud_rate_are_never_used_as_angles(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(serial_port, "ANSWER_SECONDS", 1.0)  # a busy machine delays the simulated encoder
    motion = slow_motion(3)
    # The output hardly moves: at one in nine positions an answer at a wrong baud rate has correct check bits.
    bench = SimulatedAmt21Bench(motion, SimulatedAmt21(faults=[Fault(kind, 100, 3, target=0x58)], speed_factor=0.001))
    recording, done = serial_recording(tmp_path, bench, samples=60)
    output = recording.samples["output_angle"]
    assert done.marks["output_angle"]["gaps"] >= 1
    lost = [t for t in texts(recording, "output_angle") if re.search("readings? lost", t)]
    assert sum(int(t.split()[0]) for t in lost) >= 1
    assert lies_on(output, motion.time, motion.output_angle, 1e-3)
    assert np.max(np.abs(np.diff(output.value))) < 0.2
    assert not marked(recording.samples["input_angle"], rf.GAP)


def test_a_wrong_baud_rate_is_detected_at_the_start(tmp_path):
    faults = [Fault("wrong_baud", 0, 10**9)]
    with SimulatedAmt21Bench(slow_motion(), SimulatedAmt21(faults=faults)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        with (
            pytest.raises(EncoderError, match=r"check bits are wrong|baud rate right"),
            open_encoders(toml),
        ):
            pass


def test_a_byte_received_at_another_baud_rate():
    # 0x55 is a square wave with the bit time: at half the rate, each of its ten bits is every other bit sent.
    assert at_wrong_baud(b"\x00", 0.5) != b"\x00"
    assert at_wrong_baud(b"\x12\x34\xfe", 1.0) == b"\x12\x34\xfe"


@pytest.mark.slow(6)
def test_bus_off(tmp_path, bus_name):
    motion = slow_motion(3)
    recording, done, _ = can_recording(tmp_path, bus_name, [Fault("bus_off", 40)], motion, speed_factor=1.0, idle=3.0)
    assert done.failures == ()
    for name in ("input_angle", "output_angle", "torque"):
        said = texts(recording, name)
        assert any("bus-off" in t for t in said), said
        samples = recording.samples[name]
        assert len(samples) > 100
        gap = int(np.argmax(np.diff(samples.time_host))) + 1
        assert samples.status[gap] & rf.GAP
    assert lies_on(recording.samples["input_angle"], motion.time, motion.input_angle, 1e-5)


def test_rollover(tmp_path, bus_name):
    # 2^31 counts per turn: a 32-bit position rolls over every second turn.
    motion = simulate_motion(ideal, SimulatedRun(torque=0.0, turns=5, samples_per_turn=24))
    recording, done, _ = can_recording(tmp_path, bus_name, [], motion, input_counts_per_turn=1 << 31)
    assert done.marks["input_angle"] == {"rollovers": 2}
    assert np.max(np.abs(recording.samples["input_angle"].value - motion.input_angle)) < 1e-8


@needs_pty
def test_counter_reset(tmp_path):
    motion = slow_motion(1)
    bench = SimulatedAsciiBench(motion, SimulatedAscii(faults=[Fault("reset", 50)]))
    recording, done = serial_recording(tmp_path, bench)
    samples = recording.samples["output_angle"]
    assert done.marks["output_angle"]["resets"] == 1
    (reset,) = marked(samples, rf.RESET)
    assert samples.counts[reset] == 0
    assert any("restarted" in t for t in texts(recording, "output_angle"))
    # Its clock restarted too: before and after, it is converted to the host's clock by separate lines.
    clocks = read_clocks(tmp_path / "run.arrows", ["output_angle"])["output_angle"]
    assert clocks.keys() == {0, 1}
    late = samples.time_host - recording.aligned_time("output_angle")
    assert late.min() > -max(clock.uncertainty for clock in clocks.values())
    assert np.median(late) < 0.1


def test_a_restarted_node_is_set_operational_again(tmp_path, bus_name):
    recording, done, _ = can_recording(
        tmp_path,
        bus_name,
        [Fault("reboot", 30, target=OUTPUT), Fault("reset", 30, target=OUTPUT)],
        speed_factor=1.0,
        idle=1.0,
    )
    output = recording.samples["output_angle"]
    assert any("restarted" in t for t in texts(recording, "output_angle"))
    assert done.marks["output_angle"]["resets"] == 1
    assert len(output) > 120, "it sends again"
    first = marked(output, rf.RESET)[0]
    assert output.counts[first] == pytest.approx(0, abs=1e6), "the counter began at 0 again"
    assert not marked(recording.samples["input_angle"], rf.GAP | rf.RESET)


@pytest.mark.parametrize("by", [3600.0, -3600.0])
def test_clock_jump_of_the_frames(tmp_path, bus_name, by):
    faults = [Fault("clock_jump", 60, by=by)]
    recording, _done, _ = can_recording(tmp_path, bus_name, faults, trigger="timer")
    for name in ("input_angle", "output_angle", "torque"):
        samples = recording.samples[name]
        assert marked(samples, rf.GAP) == [60]
        assert samples.time_host[60] - samples.time_host[59] == pytest.approx(by, abs=0.1)
        assert sum("jumped by" in t for t in texts(recording, name)) == 1


def test_clock_jump_of_the_host(tmp_path, bus_name, monkeypatch):
    calls = itertools.count()
    clock = types.SimpleNamespace(
        time=lambda: time.time() + (7200.0 if next(calls) > 5 else 0.0), monotonic=time.monotonic
    )
    monkeypatch.setattr(session, "time", clock)
    recording, _, _ = can_recording(tmp_path, bus_name, [], speed_factor=2.0)
    said = [e.text for e in recording.events if "calendar clock was set by +7200" in e.text]
    assert len(said) == 1


@pytest.mark.parametrize("trigger", ["controller", "timer"])
def test_duplicate(tmp_path, bus_name, trigger):
    recording, done, motion = can_recording(tmp_path, bus_name, [Fault("duplicate", 20, 1, OUTPUT)], trigger=trigger)
    output = recording.samples["output_angle"]
    assert done.marks["output_angle"]["duplicates"] == 1
    assert any("duplicate" in t for t in texts(recording, "output_angle"))
    clean = output.value[output.status & rf.DUPLICATE == 0] if trigger == "timer" else output.value
    assert len(clean) == len(motion.time)
    np.testing.assert_allclose(clean, motion.output_angle, atol=1e-6)


@pytest.mark.parametrize("trigger", ["controller", "timer"])
def test_out_of_order(tmp_path, bus_name, trigger):
    recording, _done, motion = can_recording(tmp_path, bus_name, [Fault("swap", 20, 1, OUTPUT)], trigger=trigger)
    output = recording.samples["output_angle"]
    if trigger == "timer":
        assert marked(output, rf.OUT_OF_ORDER) == [21]
        order = np.argsort(output.time_host, kind="stable")
        np.testing.assert_allclose(output.value[order], motion.output_angle, atol=1e-6)
    else:  # an answer to an older SYNC looks like one without SYNC: it is left out, not assigned a wrong time
        kept = np.setdiff1d(np.arange(len(motion.time)), [20])
        np.testing.assert_allclose(output.value, motion.output_angle[kept], atol=1e-6)
        assert marked(output, rf.GAP) != []


@needs_pty
def test_missing_duplicate_and_out_of_order_lines_are_detected_by_their_number(tmp_path):
    faults = [Fault("drop", 30), Fault("duplicate", 40), Fault("swap", 50)]
    motion = slow_motion(1)
    _recording, done = serial_recording(
        tmp_path, SimulatedAsciiBench(motion, SimulatedAscii(faults=faults)), idle=0.5, stop=None
    )
    # The swapped pair causes a gap, where the older line is missing at first.
    assert done.marks["output_angle"]["duplicates"] == 1
    assert done.marks["output_angle"]["out of order"] == 1
    assert done.marks["output_angle"]["gaps"] == 2


@needs_pty
@pytest.mark.parametrize("kind", ["half", "corrupt", "garbage", "wrong_baud"])
def test_incomplete_or_wrong_lines_are_never_used_as_angles(tmp_path, kind):
    motion = slow_motion(1)
    bench = SimulatedAsciiBench(motion, SimulatedAscii(faults=[Fault(kind, 60, 2)]))
    recording, done = serial_recording(tmp_path, bench, idle=0.5, stop=None)
    samples = recording.samples["output_angle"]
    assert any(re.search("lines? lost", t) for t in texts(recording, "output_angle"))
    assert done.marks["output_angle"]["gaps"] >= 1
    assert np.max(np.abs(np.diff(samples.value))) < 0.02
    assert len(samples) > 80


DISK_FULL = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.recorder.session import RecordingError, record
motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=5.0, turns=1000, samples_per_turn=480))
# At the crank's real speed the file is full only after some seconds, so that samples are acknowledged before.
with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel="full", speed_factor=1.0)) as bench:
    toml = bench.write_wiring("BENCH.toml")
    try:
        record(toml, "run.arrows", progress=lambda live: print(*live.samples.values(), flush=True))
    except RecordingError as problem:
        print(problem)
"""


def test_disk_full(tmp_path):
    """A limit on the file size replaces a full disk: write() fails in the same way."""
    run = subprocess.run(
        [sys.executable, "-c", DISK_FULL], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    *counts, said = run.stdout.splitlines()
    assert "run.arrows: the disk is full or failed (" in said
    assert "all data written before are kept" in said
    acknowledged = [int(n) for n in counts[-1].split()]
    recording = read_recording(tmp_path / "run.arrows")
    assert recording.problems[0].endswith("batches were read.")
    for have, n in zip(recording.samples.values(), acknowledged, strict=True):
        assert len(have) >= n > 0


RECORDER = """
import sys
from drivers.recorder.session import record
record("BENCH.toml", sys.argv[1], progress=lambda live: print(*live.samples.values(), flush=True))
"""


def kill_once(folder, number, after, wait):
    """Kill a recorder `wait` s into one of its loops; return the samples acknowledged and those in the file."""
    path = folder / f"run-{number}.arrows"
    process = subprocess.Popen(
        [sys.executable, "-c", RECORDER, path], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    )
    said = ""
    for _ in range(after):
        said = process.stdout.readline()
    time.sleep(wait)  # a moment between two acknowledgements, possibly within a write
    process.kill()
    rest = process.stdout.read().split("\n")
    process.wait()
    whole = [line for line in [said.strip(), *rest[:-1]] if line]
    acknowledged = [int(n) for n in whole[-1].split()] if whole else []
    return acknowledged, read_recording(path)


@needs_multicast
@pytest.mark.parametrize("kills", [1, pytest.param(KILLS, marks=pytest.mark.slow(40))])
def test_kill_9_at_any_moment_loses_nothing_acknowledged(tmp_path, kills, record_property):
    random = np.random.default_rng(5)
    group = f"239.76.{os.getpid() // 256 % 256}.{os.getpid() % 256}"
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=2000))
    for number in range(kills):
        with SimulatedCanBench(motion, SimulatedCan(interface="loopback", channel=group, speed_factor=20)) as bench:
            bench.write_wiring(tmp_path / "BENCH.toml")
            acknowledged, recording = kill_once(
                tmp_path, number, int(random.integers(2, 12)), random.uniform(0.0, 2 * BLOCK_SECONDS)
            )
        for have, n in zip(recording.samples.values(), acknowledged, strict=True):
            assert len(have) >= n
            assert not np.any(have.status & ~np.uint8(rf.ROLLOVER))
        (tmp_path / f"run-{number}.arrows").unlink()
    record_property("kills at random moments without loss of what was acknowledged", str(kills))


def test_slow_consumer(tmp_path, bus_name, monkeypatch):
    monkeypatch.setattr(hubs_module, "WAITING_LIMIT", 200)
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=40, samples_per_turn=24))
    path = tmp_path / "run.arrows"
    slept = threading.Event()

    def sleepy(live):
        if not slept.is_set():
            slept.set()
            time.sleep(0.5)  # like a disk that spins up

    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, speed_factor=20)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        done = record(toml, path, idle=1.0, progress=sleepy)
    recording = read_recording(path)
    for name in ("input_angle", "output_angle", "torque"):
        lost = [t for t in texts(recording, name) if "recorder was too slow" in t]
        count = sum(int(t.split()[0]) for t in lost)
        assert count > 0
        assert done.marks[name]["gaps"] >= 1
        missing = sum(int(t.split()[0]) for t in texts(recording, name) if "SYNC without a sample" in t)
        assert len(recording.samples[name]) + max(count, missing) >= len(motion.time)


@pytest.mark.slow(5)
def test_dead_heartbeat(tmp_path, bus_name):
    motion = slow_motion(4)
    edit = lambda text: text.replace("node = 2", 'node = 2\nheartbeat = "50 ms"')  # noqa: E731
    recording, done, _ = can_recording(
        tmp_path, bus_name, [Fault("silence", 40, 60, OUTPUT)], motion, edit, idle=1.0, speed_factor=1.0
    )
    said = texts(recording, "output_angle")
    assert any("no heartbeat and no frame for" in t for t in said), said
    assert "samples arrive again" in said
    output = recording.samples["output_angle"]
    gap = int(np.argmax(np.diff(output.time_host))) + 1
    assert output.status[gap] & rf.GAP
    assert done.failures == ()
    assert not marked(recording.samples["input_angle"], rf.GAP)


def test_emergency(tmp_path, bus_name):
    recording, _, _ = can_recording(tmp_path, bus_name, [Fault("emergency", 30, target=INPUT)], speed_factor=4.0)
    assert any(t.startswith("EMCY 0x5530, register 0x01") for t in texts(recording, "input_angle"))


@pytest.mark.parametrize("interface", ["virtual", pytest.param("loopback", marks=needs_multicast)])
def test_echoes_of_own_frames_are_counted_and_never_samples(tmp_path, bus_name, interface):
    motion = slow_motion(1)
    path = tmp_path / "run.arrows"
    channel = bus_name if interface == "virtual" else f"239.74.164.{os.getpid() % 250}"
    with SimulatedCanBench(motion, SimulatedCan(interface=interface, channel=channel, trigger="sync")) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        with open_encoders(toml) as encoders:
            hub = encoders[0].hub
            hub.bus.send(can.Message(arbitration_id=OUTPUT, is_extended_id=False, data=b"\xff\xff\xff\x7f"))
            record_encoders(encoders, path, idle=1.0)
    recording = read_recording(path)
    assert any("1 echoes of own frames" in e.text for e in recording.events)
    assert np.max(np.abs(recording.samples["output_angle"].value)) < 1.0


def test_a_reader_thread_that_dies_is_an_event(tmp_path, bus_name):
    motion = slow_motion(2)
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, speed_factor=1.0)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        with open_encoders(toml) as encoders:
            hub = encoders[0].hub

            def die(block, arrivals):
                raise RuntimeError("a bug nobody thought of")

            def progress(live):
                if live.samples["input_angle"] > 20 and hub._take is not die:
                    hub._take = die

            done = record_encoders(encoders, path, idle=1.5, progress=progress)
    recording = read_recording(path)
    for name in ("input_angle", "output_angle", "torque"):
        assert any("a bug nobody thought of" in t for t in texts(recording, name))
        assert len(recording.samples[name]) > 60, "a new reader goes on"
    assert done.failures == ()


def test_counts_per_turn_that_contradict_the_device_are_refused(tmp_path, bus_name):
    with SimulatedCanBench(slow_motion(), SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().replace("node = 1", "node = 1\ncounts_per_turn = 4096"))
        said = "counts_per_turn = 4096 contradicts the device, which has 4194304"
        with pytest.raises(EncoderSetupError, match=said), open_encoders(toml):
            pass


def test_a_simulation_is_read_with_its_bus_and_its_faults(tmp_path):
    path = tmp_path / "simulation.toml"
    head = 'format = "cycloid-simulation/1"\n'
    path.write_text(head + '[amt21]\nbits = 12\n[[amt21.faults]]\nkind = "pull"\nsample = 3\nby = "200 ms"\n')
    assert read_simulation(path) == SimulatedAmt21(bits=12, faults=[Fault("pull", 3, by=0.2)])
    path.write_text(head)
    assert read_simulation(path) == SimulatedCan()
    for text, said in (
        ('[[can.faults]]\nkind = "earthquake"\nsample = 3\n', r"simulation.toml: can.faults\[0\].kind = "),
        ('[[can.faults]]\nkind = "pull"\nsample = 3\nbuy = 1\n', r"simulation.toml: can.faults\[0\].*buy"),
        ("[can]\nspeed_factor = 0\n", r"simulation.toml: \[can\] speed_factor = 0"),
        ("[can]\n[ascii]\n", "simulation.toml: it has several buses"),
        ("[morse]\n", "morse is not a known key"),
    ):
        path.write_text(head + text)
        with pytest.raises(edge.InputError, match=said):
            read_simulation(path)
