"""Mutated frames and bytes: no crash, and no wrong sample that the checksums can detect."""

import hostile
import numpy as np
import pytest
from common import study_size

from cycloid_fmu import edge
from drivers.can.frames import FrameReader
from drivers.can.hub import Frames
from drivers.encoders.amt21 import Amt21Config, Amt21Encoder, check_bits
from drivers.encoders.ascii import AsciiConfig, AsciiCounter
from drivers.encoders.modbus import ModbusConfig, ModbusEncoder
from drivers.hubs import BlockQueue
from drivers.lines import PortConfig
from drivers.recording_format import read_recording
from drivers.serial.port import Exchange
from tests.drivers.test_recording_format import NAMES, block, write
from tests.drivers.test_serial_encoders import CONFIG, nmea

MUTATIONS = study_size("CYCLOID_MUTATIONS", 1e5, 1e6)
COUNTS = [4000, pytest.param(MUTATIONS, marks=pytest.mark.slow)]
PORT = PortConfig(url="loop://")


def mutated(random, data):
    """Return the bytes with flipped bits, deletions, repetitions and insertions."""
    data = bytearray(data)
    for _ in range(random.integers(0, 3)):
        kind = random.integers(0, 4)
        at = int(random.integers(0, len(data) + 1))
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << int(random.integers(0, 8))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = data[: int(random.integers(0, 4))]
        else:
            data[at:at] = random.bytes(int(random.integers(1, 4)))
    return bytes(data)


def odd(answer):
    """Return whether the check bits are correct by the datasheet: odd and even bits each have odd parity."""
    word = int.from_bytes(answer, "little")
    return all((word & mask).bit_count() % 2 == 1 for mask in (0xAAAA, 0x5555))


def polled(encoder, answers):
    encoder._answers.put([Exchange(float(i), a) for i, a in enumerate(answers)], len(answers))
    with hostile.within(20.0, 1 << 30):
        samples = encoder.read(0.0)
    encoder.events()
    return samples


@pytest.mark.parametrize("count", COUNTS)
def test_amt21(count):
    random = np.random.default_rng(1)
    encoder = Amt21Encoder("input_angle", Amt21Config(protocol="amt21", port="p"), PORT)
    for _ in range(0, count, 1000):
        words = check_bits(random.integers(0, 1 << 14, 1000).astype(np.uint16))
        answers = [mutated(random, w.tobytes()) for w in words]
        samples = polled(encoder, answers)
        right = [len(a) == 2 and odd(a) for a in answers]
        allowed = [a for a, good in zip(answers, right, strict=True) if good]
        assert len(samples) == len(allowed)
        raw = np.array([int.from_bytes(a, "little") & 0x3FFF for a in allowed])
        np.testing.assert_array_equal(samples.counts % (1 << 14), raw)


@pytest.mark.parametrize("count", COUNTS)
def test_modbus(count):
    random = np.random.default_rng(2)
    config = ModbusConfig(protocol="modbus", port="p", device=7, register=0, counts_per_turn=4096)
    encoder = ModbusEncoder("input_angle", config, PORT)
    from pymodbus.framer import FramerRTU

    for _ in range(0, count, 1000):
        sent = [b"\x07\x03\x04" + random.bytes(4) for _ in range(1000)]
        whole = [s + FramerRTU.compute_CRC(s).to_bytes(2, "big") for s in sent]
        answers = [mutated(random, w) for w in whole]
        samples = polled(encoder, answers)
        # A 16-bit CRC detects every change of up to three bits in a frame this short: an accepted frame is as sent.
        untouched = [a for a, w in zip(answers, whole, strict=True) if a == w]
        assert len(untouched) <= len(samples) <= len(untouched) + 1
        if len(samples) == len(untouched):
            raw = np.array([int.from_bytes(a[3:7], "big") for a in untouched])
            np.testing.assert_array_equal(samples.counts % (1 << 32), raw)


@pytest.mark.parametrize("count", COUNTS)
def test_lines(count):
    random = np.random.default_rng(3)
    counter = AsciiCounter("output_angle", CONFIG, PORT)
    counter._skipping = False
    for start in range(0, count, 1000):
        numbers = range(start, start + 1000)
        answers = [mutated(random, nmea(n, 7 * n)) for n in numbers]
        samples = polled(counter, answers)
        wrong = np.count_nonzero(samples.counts % 7)
        assert wrong <= 12, "an exclusive or of eight bits lets one mutated line of 256 pass, and most repeats"


@pytest.mark.parametrize("count", COUNTS)
def test_frames(count):
    random = np.random.default_rng(4)

    class Hub:
        gaps, tells_drops = 0, True

        def subscribe(self, identifier):
            return BlockQueue()

        def events(self):
            return []

    reader = FrameReader(Hub(), 0x181, 4, 1, "input_angle")
    sync = 0
    kept = 0
    for _ in range(0, count, 1000):
        numbers = sync + np.cumsum(random.integers(0, 3, 1000))
        sync = int(numbers[-1])
        frames = Frames(
            np.where(random.random(1000) < 0.99, numbers, -1),
            numbers * 0.01,
            numbers * 0.01 + random.normal(0, 1, 1000),
            [bytearray(mutated(random, i.to_bytes(4, "little"))) for i in range(1000)],
            np.zeros(1000),
            np.zeros(1000, int),
        )
        reader._blocks.put(frames, 1000)
        with hostile.within(20.0, 1 << 30):
            judged = reader.read(0.0)
        reader.events()
        kept += len(judged.payloads)
        assert judged.payloads.shape == (len(judged.status), 4)
        good = {bytes(d) for d in frames.data if len(d) == 4}
        assert {p.tobytes() for p in judged.payloads} <= good
    assert kept > count / 10


@pytest.mark.parametrize("count", COUNTS)
def test_recordings(tmp_path, count, record_property):
    """A file with flipped bits, inserted and missing bytes: samples read were written, the rest is reported."""
    random = np.random.default_rng(5)
    path = write(tmp_path / "run.arrows", [block(name, 10 * i, 10) for i in range(5) for name in NAMES])
    whole, header = path.read_bytes(), read_recording(path).header

    def rows(recording):
        held = ((n, s) for n, s in recording.samples.items() if len(s))
        return {(n, *row) for n, s in held for row in zip(s.time_host, s.value, s.counts, strict=True)}

    written, read = rows(read_recording(path)), 0
    for _ in range(count // 50):
        data = mutated(random, mutated(random, whole))
        path.write_bytes(data if random.integers(2) else data + whole[len(data) :])
        try:
            with hostile.within(20.0, 1 << 30):
                found = read_recording(path)
        except edge.InputError:
            continue
        assert found.header == header or any("header is damaged" in problem for problem in found.problems)
        read += 1
        assert rows(found) <= written
    assert read > count // 100
    record_property("damaged recordings read or refused without a wrong sample", str(count // 50))


def test_lines_without_a_checksum_are_checked_by_their_form():
    config = AsciiConfig(protocol="ascii", port="p", line="{counts}", counts_per_turn=10)
    counter = AsciiCounter("output_angle", config, PORT)
    counter._skipping = False
    assert polled(counter, [b"12\n1x\n", b"\xff\xfe\n", b"13\r\n", b"9" * 40 + b"\n"]).counts.tolist() == [12, 13]
