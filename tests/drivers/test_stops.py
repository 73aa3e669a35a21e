"""A recorder that is stopped for a while, as by a busy machine or a debugger: no gap without a mark, no wrong pair.

The bench, in this process, knows what it sent and when; its line buffers no more than a real one while nobody reads.
`CYCLOID_STOPS` is the number of stops per protocol and source of time in the slow campaign.
"""

import contextlib
import datetime
import json
import os
import signal
import struct
import subprocess
import sys
import time
import tty
from pathlib import Path

import can
import numpy as np
import pytest
from common import study_size

from drivers import recording_format as rf
from drivers.recording_format import read_recording
from drivers.simulated.buses import SimulatedAmt21, SimulatedAscii, SimulatedCan, SimulatedModbus
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.serial_bench import SimulatedAsciiBench
from drivers.simulated.simulate import bench_of
from tests.drivers.test_bench_cli import ENVIRONMENT, filled, needs_multicast
from tests.drivers.test_motor_controllers import moteus as replying
from tests.drivers.test_motor_controllers import sending

pytestmark = pytest.mark.system


STOPS = study_size("CYCLOID_STOPS", 2, 100)
SHORTEST, LONGEST = 0.1, 5.0  # s
CAN_BUFFER, SERIAL_BUFFER = 1 << 16, 4095  # bytes: a fifth of a second of frames, half a second of lines
GROUP = f"239.78.{os.getpid() // 256 % 256}.{os.getpid() % 256}"
VCAN = "vcan0"

RECORDER = """
import json, os, sys
if hasattr(os, "sched_setscheduler"):
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # normal priority, unlike the bench
from drivers.can import drops
from drivers.recorder.session import RecordingInterrupted, record
drops.RECEIVE_BUFFER = int(sys.argv[1])
if sys.argv[2] == "untold":  # an interface whose driver does not count its drops
    drops._DROPS, drops.SocketDrops.since = 9999, lambda self: 0
try:
    record("BENCH.toml", "run.arrows", idle=2.0)
except RecordingInterrupted as interrupt:
    print(json.dumps(dict(interrupt.recorded.lost)))
"""


@contextlib.contextmanager
def prompt():
    """Give threads started inside, those of a bench, priority over all others if permitted, like a real device.

    If not permitted, a busy machine delays the bench, and results from its clock or usual interval are off by that.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):  # Linux only, and only with the privilege
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def motion(rate):
    """Return a motion that is long enough at this sampling rate, samples per second, with one crank turn per second."""
    return simulate_motion(
        lambda angle, torque: -angle / 39, SimulatedRun(torque=5.0, turns=1000, samples_per_turn=rate)
    )


def recorded_over_stops(folder, bench, stops, seed, told="told"):
    """Record a bench with a recorder stopped this often; return the recording, reported losses and the start time."""
    random = np.random.default_rng(seed)
    process = subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(CAN_BUFFER), told],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        filled(folder / "run.arrows", 20, 60)
        for _ in range(stops):
            time.sleep(random.uniform(0.2, 0.5))  # random moments are the purpose of the test
            process.send_signal(signal.SIGSTOP)
            time.sleep(SHORTEST * (LONGEST / SHORTEST) ** random.uniform(0.0, 1.0))
            process.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, error
    recording = read_recording(folder / "run.arrows")
    assert recording.problems == ()
    return recording, json.loads(out), datetime.datetime.fromisoformat(recording.header.start).timestamp()


def missing_and_marked(samples, own):
    """Return how many of the bench's sample numbers are missing; assert that each gap is marked."""
    step = np.diff(own)
    assert np.all(step > 0)
    assert np.all(samples.status[1:][step > 1] & rf.GAP), "a gap without a mark"
    return int(np.sum(step - 1))


def assert_told(told, missing, ends=1):
    assert abs(told - missing) <= ends + 0.01 * missing, f"{told} told of {missing} lost"


CAN = {
    "SYNC with counter, kernel's stamps": {},
    "SYNC without counter, kernel's stamps": {"sync_counter": False},
    "event timer, kernel's stamps": {"trigger": "timer"},
    "recorder's SYNC, kernel's stamps": {"trigger": "sync"},
    "SYNC with counter, interface's clock": {"clock_drift": 50e-6},
    "event timer, interface's clock": {"clock_drift": 50e-6, "trigger": "timer"},
    "SYNC with counter, interface's clock, drops not told": {"clock_drift": 50e-6},
    "SYNC without counter, interface's clock, drops not told": {"clock_drift": 50e-6, "sync_counter": False},
    "event timer, interface's clock, drops not told": {"clock_drift": 50e-6, "trigger": "timer"},
}
# A bus on this machine, and the kernel's virtual CAN if it has one.
BUSES = {"loopback": GROUP, **({"socketcan": VCAN} if Path("/sys/class/net", VCAN).exists() else {})}


def can_case(folder, bus, case, stops, record_property):
    options = CAN[case]
    if bus == "socketcan" and "clock_drift" in options:
        return  # its stamps are the kernel's
    sent = motion(100 if options.get("trigger") == "sync" else 500)
    with (
        prompt(),
        SimulatedCanBench(sent, SimulatedCan(interface=bus, channel=BUSES[bus], speed_factor=1.0, **options)) as bench,
    ):
        bench.write_wiring(folder / "BENCH.toml", ratio=-39)
        seed = list(CAN).index(case)
        recording, told, start = recorded_over_stops(
            folder, bench, stops, seed, "untold" if "not told" in case else "told"
        )
    angles = {"input_angle": sent.input_angle, "output_angle": sent.output_angle}
    own, total, off = {}, 0, []
    for name, angle in angles.items():
        samples = recording.samples[name]
        own[name] = np.rint((samples.value - angle[0]) / (angle[1] - angle[0])).astype(int)
        missing = missing_and_marked(samples, own[name])
        assert_told(told[name], missing)
        total += missing
        clean = samples.status & ~np.uint8(rf.ROLLOVER) == 0
        taken = recording.aligned_time(name) + start
        off.append(np.maximum(bench.sent_at[own[name]] - taken, taken - bench.sent_by[own[name]])[clean])
        stood = np.diff(samples.time_host) > 0.09
        if "clock_drift" not in options:
            assert np.all(samples.status[1:][stood] & rf.GAP)
    assert np.max(np.concatenate(off)) < 1e-3, "the next SYNC is 2 ms off"
    one, other = (recording.samples[name] for name in angles)
    if options.get("trigger") != "timer":
        _, i, j = np.intersect1d(one.time_host, other.time_host, return_indices=True)
        clean = (one.status[i] | other.status[j]) & ~np.uint8(rf.ROLLOVER) == 0
        assert clean.sum() > 50
        assert np.array_equal(own["input_angle"][i][clean], own["output_angle"][j][clean]), "a wrong pair"
    if options.get("trigger") != "sync":
        assert total > 0, "the line lost nothing: the stops tell nothing"
    else:
        assert any("not sent in time" in event.text for event in recording.events)
    record_property(f"{bus}, {case}: stops, frames lost, told", f"{stops}, {total}, {sum(map(told.get, angles))}")


@needs_multicast
def test_a_stopped_recorder_reports_its_losses_on_can(tmp_path, record_property):
    can_case(tmp_path, "loopback", next(iter(CAN)), 2, record_property)


def nearest_places(sorted_values, values):
    """Return for each of `others` the index of the nearest of sorted values."""
    after = np.clip(np.searchsorted(sorted_values, values), 1, len(sorted_values) - 1)
    before_is_nearer = values - sorted_values[after - 1] < sorted_values[after] - values
    return after - before_is_nearer


@needs_multicast
@pytest.mark.slow(30)
@pytest.mark.parametrize("case", CAN)
@pytest.mark.parametrize("bus", BUSES)
def test_random_stops_on_can(tmp_path, bus, case, record_property):
    can_case(tmp_path, bus, case, STOPS, record_property)


LINES = {
    "number and clock": "${sequence},{time},{counts}*{checksum}",
    "clock": "${skip},{time},{counts}*{checksum}",
    "number": "${sequence},{skip},{counts}*{checksum}",
    "neither": "${skip},{skip},{counts}*{checksum}",
}


@pytest.mark.slow(30)
@pytest.mark.parametrize("case", LINES)
def test_random_stops_with_a_device_that_sends(tmp_path, case, record_property):
    with prompt(), SimulatedAsciiBench(motion(500), SimulatedAscii()) as bench:
        bench.receive_buffer = SERIAL_BUFFER
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        toml.write_text(toml.read_text().replace(LINES["number and clock"], LINES[case]))
        recording, told, start = recorded_over_stops(tmp_path, bench, STOPS, list(LINES).index(case))
    samples = recording.samples["output_angle"]
    when, counts = map(np.array, zip(*bench.sent, strict=True))
    own = np.searchsorted(-counts, -samples.counts)  # the output turns backwards
    assert np.array_equal(counts[own], samples.counts), "a count that was never sent"
    missing = missing_and_marked(samples, own)
    clean = samples.status == 0
    late = (recording.aligned_time("output_angle") + start - when[own])[clean]
    # Without its own clock a line gets its arrival time; lines that may have been delayed are left out.
    assert np.max(np.abs(late)) < (2e-3 if "clock" in case else 0.06)
    assert missing > 0 or STOPS < 10  # a few short stops may lose nothing
    # Without a number, lines of a gap follow from its length: it is known to 0.06 s, 30 lines, like their times; by the
    # device's clock it is exact, but the simulated device sends as late as that on a busy machine.
    assert_told(told["output_angle"], missing, 1 if "number" in case else 1 + 30 * STOPS**0.5)
    record_property(f"lines with {case}: stops, lines lost, told", f"{STOPS}, {missing}, {told['output_angle']}")


@pytest.mark.slow(30)
@pytest.mark.parametrize("kind", [SimulatedAmt21(), SimulatedModbus()])
def test_random_stops_with_polled_devices(tmp_path, kind, record_property):
    sent = motion(1000)  # so that a single-turn encoder turns several times in a gap
    with prompt(), bench_of(kind, sent) as bench:
        bench.receive_buffer = SERIAL_BUFFER
        bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        recording, told, start = recorded_over_stops(tmp_path, bench, STOPS, 7)
    total = 0
    for address, name, angle in zip(
        bench.answered, ("input_angle", "output_angle"), (sent.input_angle, sent.output_angle), strict=True
    ):
        samples = recording.samples[name]
        begun = bench.answered_at[address][0] - sent.time[bench.answered[address][0]]
        clean = samples.status & ~np.uint8(rf.ROLLOVER) == 0
        turned = np.interp(samples.time_host + start - begun, sent.time, angle)
        # An exchange of half ANSWER_SECONDS may be off by half of that.
        assert np.max(np.abs(samples.value - turned)[clean]) < 0.03 * abs(angle[-1] / sent.time[-1]) + 5e-4
        assert np.all(samples.status[1:][np.diff(samples.time_host) > 0.3] & rf.GAP)
        answered_at = np.array(bench.answered_at[address])
        # A single time may be 25 ms off, but not most of the first and last thirty, before and after all stops.
        nearest = nearest_places(answered_at, samples.time_host + start)
        first = int(np.median(nearest[:30] - np.arange(30)))
        last = int(np.median(nearest[-30:] + np.arange(30)[::-1]))
        total += last - first + 1 - len(samples)
    assert_told(sum(told.values()), total)
    record_property(f"{type(kind).__name__}: stops, answers lost, told", f"{STOPS}, {total}, {sum(told.values())}")


@contextlib.contextmanager
def odrive(folder):
    """An ODrive that sends its position every 5 ms: the number of the message, in 1/1024 turns."""
    with can.Bus(interface="loopback", channel=GROUP) as bus:

        def send(number):
            data = struct.pack("<ff", number / 1024, 0.0)
            bus.send(can.Message(arbitration_id=3 << 5 | 9, is_extended_id=False, data=data))

        with sending(send, 0.005):
            yield (
                f'[bus.b]\ninterface = "loopback"\nchannel = "{GROUP}"\n',
                'protocol = "odrive"\nbus = "b"\nnode = 3\n',
            )


@contextlib.contextmanager
def moteus(folder):
    """A moteus that replies to each query with its number, in 1/1024 turns."""
    with replying(GROUP, 3, interface="loopback"):
        line = f'[bus.b]\ninterface = "loopback"\nchannel = "{GROUP}"\nfd = true\n'
        yield line, 'protocol = "moteus"\nbus = "b"\nnode = 3\n'


@contextlib.contextmanager
def simplefoc(folder):
    """SimpleFOC's monitor with the number of each line, every 10 ms."""
    controller, line = os.openpty()
    tty.setraw(line)
    os.set_blocking(controller, False)

    def send(number):
        with contextlib.suppress(BlockingIOError):  # nobody reads
            os.write(controller, f"{number * 2 * np.pi / 1024:.5f}\r\n".encode())

    with sending(send, 0.01):
        yield f'[port.p]\nurl = "{os.ttyname(line)}"\n', 'protocol = "simplefoc"\nport = "p"\nvariables = ["angle"]\n'
    os.close(controller)
    os.close(line)


@needs_multicast
@pytest.mark.slow(30)
@pytest.mark.parametrize("rig", [odrive, moteus, simplefoc])
def test_random_stops_with_motor_controllers(tmp_path, rig, record_property):
    with prompt(), rig(tmp_path) as (line, keys):
        (tmp_path / "BENCH.toml").write_text(
            f'format = "cycloid-bench/1"\n{line}[channel.input_angle]\n{keys}quantity = "position"\nside = "motor"\n'
        )
        recording, told, _ = recorded_over_stops(tmp_path, None, STOPS, 3)
    samples = recording.samples["input_angle"]
    missing = missing_and_marked(samples, np.rint(samples.value * 1024 / (2 * np.pi)).astype(int))
    stood = np.diff(samples.time_host) > 0.25
    assert np.all(samples.status[1:][stood] & rf.GAP), "a pause without a mark"
    assert told["input_angle"] >= 0.9 * missing - 10
    record_property(f"{rig.__name__}: stops, messages lost, told", f"{STOPS}, {missing}, {told['input_angle']}")
