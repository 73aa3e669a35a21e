"""A PLC's ring of samples over ADS: real AMS/TCP frames between Beckhoff's client (in pyads) and a simulated PLC."""

import contextlib
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from common import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st

import drivers
from cycloid_fmu import edge
from drivers.ads import ring
from drivers.ads.plc import plcs
from drivers.encoder import EncoderError, PlcConfig
from drivers.encoders.ads import AdsConfig, AdsEncoder
from drivers.hubs import BlockQueue
from drivers.recorder.bench import open_encoders
from drivers.recording_format import GAP, RESET, ROLLOVER
from drivers.simulated.ads_bench import RING, SimulatedAdsBench
from drivers.simulated.faults import Fault
from drivers.simulated.motion import SimulatedRun, simulate_motion

pytest.importorskip("pyads")
RATE = 2000.0


@pytest.fixture
def host():
    """An address of this machine used by no other test process, because ADS has a fixed port."""
    own = os.getpid() % 60_000 + 300
    return f"127.0.{own >> 8}.{own & 255}"


def motion(samples):
    run = SimulatedRun(torque=20.0, turns=1, samples_per_turn=samples, speed=2 * math.pi * RATE / samples)
    return simulate_motion(lambda a, t: a / -39, run)


def record(tmp_path, bench):
    done = bench.record(tmp_path / "run.arrows")
    return done, drivers.read_recording(done.path)


def told(recording):
    return [e.text for e in recording.events if not e.text.startswith("clock: ")]


def take_all(blocks):
    while blocks.take(5.0):
        pass


def test_all_columns_of_every_sample_have_one_time(tmp_path, host):
    moved = motion(600)
    with SimulatedAdsBench(moved, host=host, clock_drift=1e-3) as bench:
        done, recording = record(tmp_path, bench)
    assert set(done.samples.values()) == {600}
    first, second, third = (recording.samples[n] for n in ("input_angle", "output_angle", "torque"))
    assert first.value == pytest.approx(moved.input_angle, abs=math.pi / (1 << 22))
    assert second.value == pytest.approx(moved.output_angle, abs=math.pi / (1 << 25))
    assert third.value == pytest.approx(moved.torque, abs=1e-12)
    assert (first.time_host == second.time_host).all()
    assert (first.time_host == third.time_host).all()
    assert first.time_device == pytest.approx(moved.time * 1.001, abs=1e-9)
    assert (np.diff(first.time_host) > 0).all()
    assert not first.status.any()
    assert told(recording) == []


def test_overwritten_samples_are_counted_exactly_and_marked(tmp_path, host):
    moved = motion(1000)
    with SimulatedAdsBench(moved, host=host, length=32) as bench:  # it holds 16 ms and is read every 50 ms
        read, wiring = [], bench.write_wiring(tmp_path / "BENCH.toml")
        drivers.record(wiring, tmp_path / "run.arrows", stop=lambda: bench.wait(0.0), progress=read.append)
    recording = drivers.read_recording(tmp_path / "run.arrows")
    for samples in recording.samples.values():
        number = np.rint(samples.time_device * RATE).astype(int)
        assert 0 < len(number) < 900
        holes = np.diff(number, prepend=number[0] - 1) > 1
        assert ((samples.status & GAP != 0) == holes).all()
        lost = [
            int(e.text.split()[0]) for e in recording.events if e.channel == samples.channel and "missing" in e.text
        ]
        assert sum(lost) == number[-1] - number[0] + 1 - len(number)


def test_drain_reads_the_ring_and_losses_are_counted(tmp_path, host):
    with SimulatedAdsBench(motion(4000), host=host, length=32) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        with open_encoders(wiring) as encoders:
            first = encoders[0]
            got = [first.read(1.0)]
            begun = bench.written
            while (before := bench.written) < begun + 5:
                time.sleep(0.001)
            first.drain()
            got.append(first.read(0.0))
    times = np.concatenate([block.time_device for block in got])
    assert round(times[-1] * RATE) >= before - 1
    assert first.lost == round((times[-1] - times[0]) * RATE) + 1 - len(times)


def test_an_interruption_shorter_than_the_ring_loses_nothing(tmp_path, host, monkeypatch):
    monkeypatch.setattr("drivers.ads.plc._ANSWER_SECONDS", 0.2)
    moved = motion(1600)
    with SimulatedAdsBench(moved, host=host, faults=[Fault("pull", 400, by=0.2)]) as bench:
        done, recording = record(tmp_path, bench)
    assert set(done.samples.values()) == {1600}
    assert recording.samples["input_angle"].value == pytest.approx(moved.input_angle, abs=1e-6)
    assert any("failed" in text for text in told(recording))
    assert not any("missing" in text for text in told(recording))


def test_a_restarted_program_is_marked_as_reset(tmp_path, host):
    with SimulatedAdsBench(motion(1600), host=host, faults=[Fault("reset", 1200)]) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        done = drivers.record(wiring, tmp_path / "run.arrows", stop=lambda: bench.wait(0.0))
    recording = drivers.read_recording(done.path)
    samples = recording.samples["output_angle"]
    (again,) = np.flatnonzero(samples.status & RESET)
    assert samples.counts[again] == 0  # incremental: the zero has changed
    assert samples.time_device[again] == 0.0
    assert sum("program restarted" in text for text in told(recording)) == 3
    assert len(samples) - again == 400  # unread earlier samples are lost


def test_a_half_written_sample_is_left_out(tmp_path, host):
    with SimulatedAdsBench(motion(600), host=host, faults=[Fault("corrupt", 300, count=2)]) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        drivers.record(wiring, tmp_path / "run.arrows", stop=lambda: bench.wait(0.0))
    recording = drivers.read_recording(tmp_path / "run.arrows")
    torque = recording.samples["torque"]
    assert len(torque) == 598
    assert np.flatnonzero(torque.status).tolist() == [300]
    assert torque.status[300] == GAP
    assert sum(text.startswith("2 samples missing by their number") for text in told(recording)) == 3


@pytest.mark.parametrize(
    ("was", "becomes", "said"),
    [
        (f'ring = "{RING}"', 'ring = "Recorder.Rang"', 'has no variable "Recorder.Rang"'),
        ("column = 3", "column = 4", "the ring has 3 columns"),
        ("column = 3", "column = 0", "column"),
        ('plc = "plc1"', 'plc = "plc\\n2"', 'plc = "plc 2": there is no plc of this name; the file has "plc1"'),
        ("torque_per_count", "counts_per_turn = 4\ntorque_per_count", "one of counts_per_turn"),
        ('host = "127', 'host = "127.255', "host|does not answer"),
    ],
)
def test_an_impossible_wiring_is_refused_in_one_sentence(tmp_path, host, was, becomes, said):
    with SimulatedAdsBench(motion(100), host=host) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        wiring.write_text(wiring.read_text().replace(was, becomes))
        with pytest.raises((edge.InputError, EncoderError), match=said) as problem:
            drivers.record(wiring, tmp_path / "run.arrows", samples=1)
    assert "\n" not in str(problem.value)
    assert not (tmp_path / "run.arrows").exists()


def test_a_variable_that_is_not_a_ring_is_refused(tmp_path, host, monkeypatch):
    monkeypatch.setattr(ring.Head, "pack", lambda self: bytes(32))
    with (
        SimulatedAdsBench(motion(100), host=host) as bench,
        pytest.raises(EncoderError, match=r"not a ring of samples: it begins with 16#00000000"),
    ):
        drivers.record(bench.write_wiring(tmp_path / "BENCH.toml"), tmp_path / "run.arrows", samples=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda head: replace(head, newest=head.newest - 1), r"its newest number went back from \d+ to \d+"),
        (lambda head: ring.read_head(replace(head, newest=1 << 63).pack()), "which no task can reach"),
        (lambda head: replace(head, columns=2), "its ring has changed"),
    ],
)
def test_a_changed_ring_is_reopened(host, change, said):
    with SimulatedAdsBench(motion(4000), host=host) as bench:
        hub = plcs.acquire(PlcConfig(net_id=bench.net_id, host=host, ring=RING))
        blocks = BlockQueue()
        hub.follow(blocks, None)
        assert blocks.take(5.0)
        hub._read_head = lambda: change(hub.head)
        with pytest.raises(EncoderError, match=said):
            take_all(blocks)
        assert hub.broken
        plcs.release(hub)


def test_without_pyads_the_extra_is_named(tmp_path, host, monkeypatch):
    with SimulatedAdsBench(motion(100), host=host) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        monkeypatch.setitem(sys.modules, "pyads", None)
        with pytest.raises(edge.InputError, match=r"needs the package pyads: pip install 'cycloid-fmu\[ads\]'"):
            drivers.record(wiring, tmp_path / "run.arrows", samples=1)


RECORD = "import drivers; drivers.record('BENCH.toml', 'run.arrows', samples={}, idle=5.0)"


@pytest.mark.slow(60)
def test_a_stopped_recorder_marks_and_counts_its_losses(tmp_path, host):
    """Random stops of 0.1 to 2 s, a tenth of CYCLOID_KILLS times, with a ring of 0.25 s or 4 s."""
    chance = np.random.default_rng(5)
    for trial in range(max(1, int(os.environ.get("CYCLOID_KILLS", "300")) // 10)):
        folder = tmp_path / str(trial)
        folder.mkdir()
        length, seconds = int(chance.choice([512, 8192])), float(chance.uniform(0.1, 2.0))
        with SimulatedAdsBench(motion(6000), host=host, length=length) as bench:
            bench.write_wiring(folder / "BENCH.toml")
            least = 6000 if length > 4500 else 6000 - round(2.1 * RATE)
            recorder = subprocess.Popen([sys.executable, "-c", RECORD.format(least)], cwd=folder)
            while bench.written < 500:
                time.sleep(0.01)
            recorder.send_signal(signal.SIGSTOP)
            time.sleep(seconds)
            recorder.send_signal(signal.SIGCONT)
            assert recorder.wait(60) == 0
        recording = drivers.read_recording(folder / "run.arrows")
        for name, samples in recording.samples.items():
            number = np.rint(samples.time_device * RATE).astype(int)
            missing = np.diff(number, prepend=-1) - 1
            assert (missing >= 0).all()
            assert ((samples.status & GAP != 0) >= (missing > 0)).all(), "no hole is unmarked"
            texts = [e.text for e in recording.events if e.channel == name and "missing" in e.text]
            assert sum(int(text.split()[0]) for text in texts) == missing.sum()
            assert length == 512 or not missing.any(), "the ring was long enough"


def test_simulate_from_the_command_line(command, tmp_path, host):
    words = (
        "--torque",
        "20 N*m",
        "--ratio",
        "-39",
        "--turns",
        "1",
        "--speed",
        "600 rpm",
        "--plc",
        host,
        "-o",
        "run.arrows",
    )
    run = command("cycloid-bench", "simulate", *words)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("run.arrows: 96 input_angle, 96 output_angle, 96 torque")


def test_a_counter_that_rolls_over_and_runs_backwards(tmp_path, host):
    moved = motion(300)
    with SimulatedAdsBench(moved, host=host) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        keys = f'counts_per_turn = {1 << 22}\ncounts_modulus = {1 << 20}\ndirection = -1\nzero = "1 rad"'
        wiring.write_text(wiring.read_text().replace(f"counts_per_turn = {1 << 22}", keys))
        drivers.record(wiring, tmp_path / "run.arrows", samples=300, idle=5.0)
    samples = drivers.read_recording(tmp_path / "run.arrows").samples["input_angle"]
    assert samples.value == pytest.approx(-moved.input_angle - 1.0, abs=math.pi / (1 << 22))
    assert np.flatnonzero(samples.status).tolist() == [75, 150, 225]
    assert set(samples.status) == {0, ROLLOVER}


@given(
    st.lists(
        st.tuples(st.booleans(), st.lists(st.integers(1, 6), min_size=1, max_size=20), st.integers(0, 10)), max_size=12
    )
)
def test_gaps_repetitions_and_restarts_are_detected_by_sample_numbers(blocks):
    """Each block: whether the program restarted, steps of its numbers, number of last samples that are repeated."""
    config = AdsConfig(protocol="ads", plc="p", column=1, counts_per_turn=100)
    encoder = AdsEncoder("input_angle", config, PlcConfig(net_id="1.2.3.4.1.1", ring="R"))
    started, last, lost, first = 1, 40, 0, True
    for anew, steps, again in blocks:
        if anew and not first:
            started, last, again = started + 1, 0, 0
        new = last + np.cumsum(steps)
        numbers = np.concatenate([np.arange(max(1, last + 1 - again), last + 1), new]) if not first else new
        block = ring.Block(started, numbers, numbers * 0.1, numbers * 0.1, numbers[:, None])
        got = encoder._samples(block)
        assert got.counts.tolist() == new.tolist()
        holes = np.diff(new, prepend=new[0] - 1 if first else last) - 1
        restarted = anew and not first
        expected = (holes > 0) * GAP
        expected[0] |= (RESET | GAP) * restarted
        assert got.status.tolist() == expected.tolist()
        lost += int(holes.sum())
        assert encoder.lost == lost
        last, first = int(new[-1]), False
    assert sum(int(e.text.split()[0]) for e in encoder.events() if "missing" in e.text) == lost


@given(st.integers(2, 50), st.integers(1, 8), st.integers(1, 300), st.data())
def test_any_section_of_a_ring_is_read_back(length, columns, newest, data):
    head = ring.Head(columns, length, 7, newest)
    memory = np.zeros(length, ring.sample_type(columns))
    for number in range(1, newest + 1):
        memory[(number - 1) % length] = (number, 1000 * number, range(number, number + columns), number)
    raw = head.pack() + memory.tobytes()
    assert ring.read_head(raw) == head
    assert len(raw) == head.ring_bytes
    oldest = max(1, newest - length + 1)
    first = data.draw(st.integers(oldest, newest))
    most = data.draw(st.integers(1, 2000))
    found, number = [], first
    for offset, count in ring.spans(first, newest, head, most):
        assert count <= max(most, head.sample_bytes)
        part = ring.whole_samples(raw[offset : offset + count], number, columns)
        number += count // head.sample_bytes
        found += part["number"].tolist()
        assert (part["values"][:, -1] == part["number"] + columns - 1).all()
    assert found == list(range(first, newest + 1))


def test_the_documented_plc_program_has_the_layout_of_the_ring():
    text = (EXAMPLES.parent / "docs" / "bench.md").read_text(encoding="utf-8")
    program = re.search(r"<!-- plc -->\n```text\n(.*?)```", text, re.S)[1]
    program = re.sub(r"//.*", "", program)
    kinds = {"ULINT": "<u8", "UDINT": "<u4", "LINT": "<i8"}
    sizes = {}
    for name, members in re.findall(r"TYPE (\w+) :\nSTRUCT\n(.*?)END_STRUCT", program, re.S):
        fields = []
        for member, low, high, kind in re.findall(r"(\w+)\s*: (?:ARRAY \[(\d+)\.\.(\d+)\] OF )?(\w+)", members):
            shape = (int(high) - int(low) + 1,) if low else ()
            fields.append((member.lower(), kinds.get(kind) or sizes[kind], shape))
        sizes[name] = np.dtype(fields)
    assert sizes["ST_Sample"] == ring.sample_type(3)
    laid = sizes["ST_Ring"]
    head = np.zeros((), laid)
    for member, value in re.findall(r"(\w+)\s*: \w+ := ([#\w]+);", program):
        head[member.lower()] = int(value.removeprefix("16#"), 16 if "#" in value else 10)
    head["started"], head["newest"] = 5, 6
    read = ring.read_head(head.tobytes()[: ring.HEAD_BYTES])
    assert read == ring.Head(3, laid["samples"].shape[0], 5, 6)
    assert read.ring_bytes == laid.itemsize
    order = re.findall(r"\.(Check|Number|Time|Values|Newest)\S* := ", program)
    assert (order[0], order[-2:]) == ("Check", ["Check", "Newest"])


@given(st.binary(max_size=48))
def test_any_bytes_are_a_valid_head_or_refused_in_one_sentence(data):
    with contextlib.suppress(ValueError):
        assert ring.read_head(data).pack() == data[: ring.HEAD_BYTES]


@given(st.binary(min_size=32, max_size=320), st.integers(1, 1 << 40))
def test_only_samples_with_the_expected_number_are_accepted(data, first):
    size = ring.Head(1, 2, 0, 0).sample_bytes
    found = ring.whole_samples(data[: len(data) // size * size], first, 1)
    assert (found["number"] == found["check"]).all()


def test_a_sample_being_written_is_detected_at_any_moment():
    """The PLC writes during a read from low to high addresses: at each interleaving the sample is valid or refused."""
    old, new = (np.array((n, 10 * n, [n, n], n), ring.sample_type(2)).tobytes() for n in (1, 3))
    words = [slice(8 * i, 8 * i + 8) for i in range(5)]
    steps = [(words[4], bytes(8)), *((words[i], new[words[i]]) for i in range(5))]
    stages = [bytearray(old)]
    for place, word in steps:
        stages.append(bytearray(stages[-1]))
        stages[-1][place] = word
    for begun in range(len(stages)):
        for pace in range(1, 8):
            seen = b"".join(bytes(stages[min(begun + i * pace // 2, len(stages) - 1)][words[i]]) for i in range(5))
            for number, whole in ((1, old), (3, new)):
                found = ring.whole_samples(seen, number, 2)
                assert len(found) == 0 or found.tobytes() == whole, SimpleNamespace(begun=begun, pace=pace)
