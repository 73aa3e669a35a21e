"""Detection of lost readings by each source: the kernel's count, SYNC, stamps, counters, the serial driver."""

import fcntl
import os
import pty
import socket
import struct
import subprocess
import sys
import termios
import time
import tty

import can
import numpy as np
import pytest

from drivers import recording_format as rf
from drivers.can import drops
from drivers.can.bus import frame_key, open_bus
from drivers.can.frames import FrameReader
from drivers.can.hub import BEHIND_GAP, hubs
from drivers.can.socketcan import CountingSocketcanBus
from drivers.counts import Pace, UnseenTurns, judge_sequence, missing_by_pace, unwrap
from drivers.encoders.amt21 import Amt21Config, Amt21Encoder, check_bits
from drivers.encoders.ascii import AsciiConfig, AsciiCounter
from drivers.lines import BusConfig, PortConfig
from drivers.recorder.bench import open_encoders
from drivers.recording_format import read_recording
from drivers.serial import port as serial_port
from drivers.serial.port import Exchange
from drivers.simulated.buses import SimulatedAmt21, SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.serial_bench import SimulatedAmt21Bench
from tests.drivers.test_bench_cli import ENVIRONMENT, filled, needs_multicast

SYNC, INPUT = 0x80, 0x181
linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux counts what it drops")


def frame(identifier, data=b"", at=0.0, **what):
    return can.Message(**{"arbitration_id": identifier, "is_extended_id": False, "data": data, "timestamp": at} | what)


@pytest.fixture
def hub(bus_name):
    """A hub that receives only the frames from the test."""
    made = hubs.acquire(BusConfig(interface="virtual", channel=bus_name))
    yield made
    hubs.release(made)


def handed(hub, messages, gaps=()):
    """Pass a block to the hub, which arrives with its last frame."""
    hub._publish(list(messages), [], list(gaps), messages[-1].timestamp)


def said(hub):
    return [event.text.partition(" on the CAN bus")[0] for event in hub.events()]


def cycle(number, *, counter=240, period=0.01):
    """A SYNC, with a counter that rolls over to 1 after this number, and the frame that answers it."""
    now = 100.0 + number * period
    data = bytes([number % counter + 1]) if counter else b""
    return [frame(SYNC, data, now), frame(INPUT, struct.pack("<i", number), now + 1e-4)]


def flat(cycles):
    return [message for each in cycles for message in each]


def test_after_a_gap_no_frame_is_assigned_to_an_earlier_sync(hub):
    blocks = hub.subscribe(INPUT)
    sync, answer = cycle(0)
    late = frame(INPUT, struct.pack("<i", 90), 101.0)
    handed(hub, [sync, answer, late, *cycle(100)], [(2, 200)])
    ((_, frames),) = blocks.take(0.0)
    assert frames.sync.tolist() == [0, BEHIND_GAP, 100]
    assert frames.gap.tolist() == [0, 1, 1]
    assert said(hub) == ["99 SYNC missing", "200 frames lost"]


@pytest.mark.parametrize("counter", [240, 10, 0])
def test_sync_is_counted_across_a_gap_from_the_elapsed_time(hub, counter):
    """1,234 are lost, more than the range of any counter; by 0x1019 it may roll over before 240."""
    reader = FrameReader(hub, INPUT, 4, 1, "input_angle")
    handed(hub, flat(cycle(n, counter=counter) for n in range(300)))
    first = reader.read(0.0)
    assert (len(first.status), first.status.any(), said(hub), reader.lost) == (300, False, [], 0)
    orphan = frame(INPUT, struct.pack("<i", 1533), 115.335)
    handed(hub, [orphan, *flat(cycle(n, counter=counter) for n in range(1534, 1540))], [(0, 2468)])
    then = reader.read(0.0)
    assert then.payloads.view("<i4").ravel().tolist() == list(range(1534, 1540))
    assert then.status.tolist() == [rf.GAP, 0, 0, 0, 0, 0]
    assert said(hub)[0].startswith("1234 SYNC missing")
    assert reader.lost == 1234


@pytest.mark.parametrize("counter", [240, 0])
def test_gaps_of_an_interface_without_drop_counts_are_detected_by_stamps(hub, counter):
    hub.tells_drops = False
    reader = FrameReader(hub, INPUT, 4, 1, "input_angle")
    handed(hub, flat(cycle(n, counter=counter) for n in range(300)))
    orphan = frame(INPUT, struct.pack("<i", 1533), 115.335)
    handed(hub, [orphan, *flat(cycle(n, counter=counter) for n in range(1534, 1536))])
    found = reader.read(0.0)
    assert found.payloads.view("<i4").ravel().tolist() == [*range(300), 1534, 1535]
    assert np.flatnonzero(found.status).tolist() == [300]
    assert reader.lost == 1234


def test_answers_after_a_later_sync_are_lost(hub):
    """Also at the beginning, with no sample before the SYNCs without one."""
    reader = FrameReader(hub, INPUT, 4, 1, "input_angle")
    for n in (0, 10):
        syncs, answers = zip(*map(cycle, range(n, n + 4)), strict=True)
        handed(hub, [*syncs, *answers, *flat(map(cycle, range(n + 4, n + 10)))])
    found = reader.read(0.0)
    assert found.payloads.view("<i4").ravel().tolist() == [0, *range(4, 11), *range(14, 20)]
    assert np.flatnonzero(found.status).tolist() == [1, 7, 8]
    assert reader.lost == 6


def test_frames_without_sync_are_counted_across_a_gap_by_their_usual_interval(hub):
    reader = FrameReader(hub, INPUT, 4, None, "torque")
    frames = [frame(INPUT, struct.pack("<i", n), 100.0 + 0.01 * n) for n in [*range(100), *range(600, 700)]]
    handed(hub, frames[:90])
    reader.read(0.0)
    handed(hub, frames[90:], [(10, 2000)])
    found = reader.read(0.0)
    assert np.flatnonzero(found.status).tolist() == [10]
    assert reader.lost == 500
    assert any("500 × frame 0x181 missing" in event.text for event in reader.events())


def test_an_overrun_of_the_controller_is_a_gap(hub):
    blocks = hub.subscribe(INPUT)
    with open_bus(hub.config) as bus:
        for message in [*cycle(0), frame(0x04, b"\0\1\0\0\0\0\0\0", is_error_frame=True), *cycle(1)[1:]]:
            bus.send(message)
        found = []
        while sum(len(frames.data) for frames in found) < 2:
            found += [frames for _, frames in blocks.take(1.0)]
    assert [number for frames in found for number in frames.sync] == [0, BEHIND_GAP]
    assert "frames lost" in said(hub)


def test_samples_missing_after_the_last_one_are_reported(hub):
    reader = FrameReader(hub, INPUT, 4, 1, "input_angle")
    handed(hub, flat(cycle(n) for n in range(10)))
    reader.read(0.0)
    handed(hub, [cycle(n)[0] for n in range(10, 15)])
    reader.finish()
    assert reader.lost == 4, "the newest SYNC may still be answered"
    assert any("4 SYNC without a sample after the last one" in event.text for event in reader.events())


def test_frames_after_the_end_are_not_lost(hub):
    """The bus continues between the last reading and the end."""
    reader = FrameReader(hub, INPUT, 4, 1, "input_angle")
    handed(hub, flat(cycle(n) for n in range(10)))
    reader.read(0.0)
    handed(hub, flat(cycle(n) for n in range(10, 40)))
    reader.finish()
    assert reader.lost == 0


def test_frames_in_another_format_are_other_frames(tmp_path, bus_name):
    """A 29-bit identifier of the same number or a CAN FD frame is no sample; the DBC states which frames are."""
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=5.0, turns=1))
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        (tmp_path / "torque.dbc").write_text(
            (tmp_path / "torque.dbc").read_text().replace(f"BO_ {0x2A0}", f"BO_ {0x2A0 | 1 << 31}")
        )
        with open_encoders(toml) as encoders, open_bus(BusConfig(interface="virtual", channel=bus_name)) as other:
            for _ in range(3):
                other.send(frame(0x182, b"\1\2\3\4", time.time(), is_extended_id=True))
                other.send(frame(0x182, b"\1\2\3\4", time.time(), is_fd=True))
            assert bench.wait(10)
            encoders[1].drain()
            samples, events = encoders[1].read(1.0), encoders[1].events()
            assert encoders[2].read(0.0) is None, "the torque has 29 bits now"
    np.testing.assert_allclose(samples.value, motion.output_angle, atol=1e-6)
    assert not np.any(samples.status & ~np.uint8(rf.ROLLOVER))
    assert sum(int(e.text.split()[0]) for e in events if "in another format" in e.text) >= 6
    assert len({frame_key(0x182), frame_key(0x182, extended=True), frame_key(0x182, fd=True)}) == 3


@linux
def test_socketcan_frames_are_read_with_the_drops_before_them(monkeypatch):
    """The bytes of struct can_frame and canfd_frame over UDP: queue, stamps and counts are the same for any socket."""
    monkeypatch.setattr(drops, "RECEIVE_BUFFER", 4096)
    receiver, sender = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    receiver.bind(("127.0.0.1", 0))
    bus = object.__new__(CountingSocketcanBus)
    bus.socket, bus.channel, bus._is_filtered, bus.drops = receiver, "can0", True, drops.SocketDrops(receiver)
    kinds = [
        struct.pack("=IB3x8s", 0x181, 4, b"\1\2\3\4"),
        struct.pack("=IB3x8s", 0x18DA0102 | 1 << 31, 8, b"abcdefgh"),
        struct.pack("=IBB2x64s", 0x182, 12, 1, b"abcdefghijkl"),
        struct.pack("=IB3x8s", 0x04 | 1 << 29, 8, b"\0\1"),
    ]
    with receiver, sender:
        for data in kinds:
            sender.sendto(data, receiver.getsockname())
        came = [bus.recv(1.0) for _ in kinds]
        assert [(m.arbitration_id, m.is_extended_id, m.is_fd, m.is_error_frame, bytes(m.data)) for m in came] == [
            (0x181, False, False, False, b"\1\2\3\4"),
            (0x18DA0102, True, False, False, b"abcdefgh"),
            (0x182, False, True, False, b"abcdefghijkl"),
            (0x04, False, False, True, b"\0\1\0\0\0\0\0\0"),
        ]
        assert came[2].bitrate_switch
        assert all(abs(m.timestamp - time.time()) < 5 for m in came)
        for number in range(100):
            sender.sendto(struct.pack("=IB3x8s", number, 0, b""), receiver.getsockname())
        held = []
        while (message := bus.recv(0.0)) is not None:
            held.append(message.arbitration_id)
        lost = bus.drops.since()
        assert lost == 100 - len(held) > 0
        assert bus.drops.total == 0, "no frame has come behind the gap"
        sender.sendto(kinds[0], receiver.getsockname())
        assert bus.recv(1.0).arbitration_id == 0x181
        assert (bus.drops.total, bus.drops.since()) == (lost, 0)
        bus._is_shutdown = True


def test_missed_rollovers_of_sequence_numbers_are_counted_from_the_time():
    """An 8-bit counter over a gap of 1,000, of which it shows only 231."""
    numbers = np.array([250, 251, 252, (252 + 1001) % 256, (252 + 1002) % 256])
    _, by_itself, _ = judge_sequence(numbers, 256, 249)
    assert by_itself.tolist() == [0, 0, 0, 232, 0] or by_itself.max() < 256
    expected = np.array([np.nan, np.nan, 1.0, 1002.7, 1.1])
    status, missing, newest = judge_sequence(numbers, 256, 249, expected)
    assert missing.tolist() == [0, 0, 0, 1000, 0]
    assert status.tolist() == [0, 0, 0, rf.GAP, 0]
    assert newest == 252 + 1002


def test_delayed_readings_are_not_missing():
    times = np.array([0.0, 1.0, 2.0, 6.4, 6.5, 6.6, 6.7, 7.0, 8.0, 20.0, 21.0])
    steps = np.diff(times, prepend=-1.0)
    missing, waited = missing_by_pace(times, steps, steps > 1.5, 1.0)
    assert missing.tolist() == [0] * 9 + [11, 0]
    assert np.flatnonzero(waited).tolist() == [4, 5, 6, 7]
    times = np.array([0.0, *[0.06] * 30, 0.062, 0.064])  # the thirtieth was 2 ms late
    steps = np.diff(times, prepend=-0.002)
    assert not missing_by_pace(times, steps, steps > 0.003, 0.002)[0].any()


def test_lines_delayed_at_a_gap_do_not_shorten_the_usual_interval():
    """Lines without number and clock, in turn: 200 on time, 100 lost, and 20 delayed ones that arrive at once."""
    config = AsciiConfig(protocol="ascii", port="p", line="{counts}", counts_per_turn=100_000)
    counter = AsciiCounter("output_angle", config, PortConfig(url="loop://"))
    counter._skipping = False
    for turn in range(20):
        lines = range(320 * turn, 320 * (turn + 1))
        came = [(n + 1, n) for n in lines[:200]] + [(lines[-1] + 1, n) for n in lines[300:]]
        noted = {lines[300]: "the port's buffer was full: bytes may be lost"}
        exchanges = [Exchange(0.002 * when, b"%d\n" % n, noted.get(n, "")) for when, n in came]
        for block in (exchanges[:100], exchanges[100:]):
            counter._answers.put(block, len(block))
            counter.read(0.0)
    assert counter.lost == pytest.approx(20 * 100, rel=0.005)


def test_the_usual_interval_needs_few_readings_and_ignores_a_pause():
    pace = Pace()
    assert (pace.period, pace.longest) == (None, np.inf)
    pace.add(*[0.01] * 100, 5.0)
    assert pace.period == pytest.approx(0.01)
    assert pace.longest == pytest.approx(0.015)
    uneven = Pace()
    uneven.add(*[0.01, 0.1, 1.0] * 10)
    assert uneven.longest == np.inf


def test_a_late_reading_before_a_gap_loses_no_turn():
    """One turn per second, 5.2 s without a reading, before which the last stamp is 25 ms late, as it may be."""
    unseen = UnseenTurns(4096)
    taken = np.concatenate([np.arange(1000), np.arange(6200, 6400)]) / 1000
    counts = np.rint(4096 * taken).astype(np.int64)
    gaps = np.diff(taken, prepend=0.0) > 0.1
    times = np.where(np.append(gaps[1:], False), taken + 0.025, taken)
    found = 0
    for block in np.split(np.arange(1200), 24):
        shortest, _ = unwrap(counts[block] % 4096, 4096, found)
        found = int(unseen(times[block], shortest, gaps[block])[0][-1])
    assert found == counts[-1]


@linux
def test_a_line_has_no_time_if_the_recorder_was_delayed_after_its_first_byte(monkeypatch):
    bench, line = pty.openpty()
    tty.setraw(line)
    hub = serial_port.ports.acquire(PortConfig(url=os.ttyname(line)))
    for instants, late in (((0.0, 0.08, 0.08), False), ((0.0, 0.01, 0.137), True)):
        monkeypatch.setattr(serial_port, "steady_time", iter(instants).__next__)
        os.write(bench, b"1\n")
        exchange = hub.exchange(lambda port: b"", False)
        assert (exchange.answer, exchange.late) == (b"1\n", late)
    serial_port.ports.release(hub)
    os.close(bench)
    os.close(line)


def test_an_answer_that_took_too_long_has_no_time():
    encoder = Amt21Encoder("input_angle", Amt21Config(protocol="amt21", port="p"), PortConfig(url="loop://"))
    answers = [word.tobytes() for word in check_bits(np.arange(5))]
    note = "no reading for 3.000 s: the recorder was delayed"
    encoder._answers.put(
        [
            Exchange(0.0, answers[0]),
            Exchange(1.5, answers[1], late=True),
            Exchange(3.0, answers[2]),
            Exchange(6.0, answers[3], note),
            Exchange(6.1, answers[4]),
        ],
        5,
    )
    samples = encoder.read(0.0)
    assert samples.time_host.tolist() == [0.0, 3.0, 6.0, 6.1]
    assert samples.status.tolist() == [0, rf.GAP, rf.GAP, 0]
    assert encoder.lost == 1
    texts = [event.text for event in encoder.events()]
    assert note in texts
    assert any("its time is unknown" in text for text in texts)


def test_a_delayed_line_has_a_time_only_from_its_device_clock():
    for line, kept in (("{counts}", [1, 3]), ("{time},{counts}", [1, 2, 3])):
        config = AsciiConfig(protocol="ascii", port="p", line=line, counts_per_turn=100)
        counter = AsciiCounter("output_angle", config, PortConfig(url="loop://"))
        counter._skipping = False
        text = [f"{number},{number}\n" if "time" in line else f"{number}\n" for number in (1, 2, 3)]
        counter._answers.put([Exchange(float(i), t.encode(), late=i == 1) for i, t in enumerate(text)], 3)
        samples = counter.read(0.0)
        assert samples.counts.tolist() == kept
        assert (samples.status & rf.GAP).astype(bool).tolist() == [n == 3 and len(kept) == 2 for n in kept]


@linux
def test_a_full_buffer_is_followed_by_a_gap():
    """512 lines of 8 bytes fill the buffer; the following bytes are lost, up to the end of a line."""
    bench, line = pty.openpty()
    tty.setraw(line)
    config, port = AsciiConfig(protocol="ascii", port="p", line="{counts}", counts_per_turn=10_000), os.ttyname(line)
    counter = AsciiCounter("output_angle", config, PortConfig(url=port))
    counter.hub = serial_port.ports.acquire(PortConfig(url=port))
    os.write(bench, b"".join(b"%07d\n" % n for n in range(512)))
    while counter.hub.port.in_waiting < 4095:
        pass
    counter.start()
    blocks = []
    for more in ((700, 701), (702, 703)):
        while (block := counter.read(1.0)) is None:
            pass
        blocks.append(block)
        os.write(bench, b"%07d\n%07d\n" % more)
    while sum(map(len, blocks)) < 515:
        if (block := counter.read(1.0)) is not None:
            blocks.append(block)
    counter.close()
    assert np.concatenate([b.counts for b in blocks]).tolist() == [*range(1, 512), 700, 701, 702, 703]
    marked = np.flatnonzero(np.concatenate([b.status for b in blocks])).tolist()
    assert marked in ([511], [510, 511]), "the line that the port has the beginning of may be marked too"
    os.close(bench)
    os.close(line)


@linux
def test_losses_counted_by_a_serial_driver_are_an_event_and_a_gap(monkeypatch):
    """With a substitute for TIOCGICOUNT, which a pseudo-terminal does not have."""
    counts = [0] * 20
    real = fcntl.ioctl

    def ioctl(descriptor, request, *given):
        if request == 0x545D:
            counts[7] += 3
            return struct.pack("=20i", *counts)
        return real(descriptor, request, *given)

    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=1))
    with SimulatedAmt21Bench(motion, SimulatedAmt21()) as bench:
        config = Amt21Config(protocol="amt21", port="p")
        with Amt21Encoder("input_angle", config, PortConfig(url=bench.url)) as encoder:
            assert serial_port.line_errors(encoder.hub.port) == {}
            monkeypatch.setattr(fcntl, "ioctl", ioctl)
            encoder.hub._errors = serial_port.line_errors(encoder.hub.port)
            encoder.start()
            blocks = [encoder.read(2.0) for _ in range(4)]
            texts = [event.text for event in encoder.events()]
    assert "the port lost bytes: 3 overruns" in texts
    assert any(block is not None and block.status[0] & rf.GAP for block in blocks[1:])


@pytest.mark.slow(3)
@needs_multicast
def test_a_closed_terminal_leaves_a_complete_recording(tmp_path):
    """A lost connection hangs up the terminal: SIGHUP, and no more output is possible."""
    group = f"239.79.{os.getpid() // 256 % 256}.{os.getpid() % 256}"
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=5.0, turns=4000))
    ours, theirs = pty.openpty()

    def become_the_terminal_s():
        os.setsid()
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)

    with SimulatedCanBench(motion, SimulatedCan(interface="loopback", channel=group, speed_factor=5)) as bench:
        bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        recorder = subprocess.Popen(
            [sys.executable, "-m", "drivers.cli", "record", "BENCH.toml", "-o", "run.arrows"],
            cwd=tmp_path,
            env=ENVIRONMENT,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            preexec_fn=become_the_terminal_s,
        )
        os.close(theirs)
        filled(tmp_path / "run.arrows", 20, 60)
        os.close(ours)
        assert recorder.wait(60) == 129
    recording = read_recording(tmp_path / "run.arrows")
    assert recording.problems == ()
    assert all(len(samples) > 20 for samples in recording.samples.values())
