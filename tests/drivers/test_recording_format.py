"""The recording format: round trips, and truncation or a kill loses no complete batch."""

import dataclasses
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from common import draws
from hypothesis import given, settings
from hypothesis import strategies as st

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.recording_format import (
    Channel,
    Event,
    Header,
    RecordingReader,
    RecordingWriter,
    Samples,
    joining,
    read_recording,
    schema,
)
from drivers.recording_format.repair import repair

NAMES = ("input_angle", "output_angle", "torque")


def channel(name):
    return Channel(name, name, "canopen", "rad", 1 << 22, 1, 0.0, "absolute", "node 1", "SYNC")


HEADER = Header(
    tuple(map(channel, NAMES)), {"load": 20.0, "direction": "forward"}, -39.0, "pair", "2025-01-01T00:00:00Z"
)


def block(name, first, n):
    time_host = np.arange(first, first + n, dtype=float)
    return Samples.checked(name, time_host, time_host / 7, counts=np.arange(first, first + n))


def write(path, batches):
    with RecordingWriter(path, HEADER) as writer:
        for samples in batches:
            writer.write(samples)
    return path


finite = st.floats(allow_nan=False, allow_infinity=False)
batches = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.lists(st.tuples(finite, finite, st.integers(-(2**63), 2**63 - 1), st.integers(0, 63)), max_size=5),
        st.lists(st.tuples(finite, st.text(max_size=20)), max_size=2),
    ),
    max_size=6,
)


@draws(15, 60, 3, given_batches=batches)
def test_a_recording_is_read_as_written(tmp_path_factory, given_batches):
    path = tmp_path_factory.mktemp("r") / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        for name, rows, said in given_batches:
            t, v, c, s = zip(*rows, strict=True) if rows else ((), (), (), ())
            samples = Samples.checked(
                name, t, v, counts=np.array(c, np.int64), time_device=t, status=np.array(s, np.uint8)
            )
            writer.write(samples, [Event(when, name, text) for when, text in said])
    recording = read_recording(path)
    assert recording.problems == ()
    assert recording.header == HEADER
    assert recording.events == tuple(Event(t, n, x) for n, _, said in given_batches for t, x in said)
    for name in NAMES:
        rows = [row for n, block_rows, _ in given_batches if n == name for row in block_rows]
        samples = recording.samples[name]
        assert samples.time_host.tolist() == [r[0] for r in rows]
        assert samples.value.tolist() == [r[1] for r in rows]
        assert samples.status.tolist() == [r[3] for r in rows]
        if rows:
            assert samples.counts.tolist() == [r[2] for r in rows]


def test_the_file_is_a_plain_arrow_stream_with_the_documented_checksum(tmp_path):
    path = write(tmp_path / "run.arrows", [block("torque", 0, 3)])
    with pa.ipc.open_stream(path.read_bytes()) as reader:
        batch, metadata = reader.read_next_batch_with_custom_metadata()
    columns = batch.to_pydict()
    assert columns["channel"] == ["torque"] * 3
    assert columns["time_device"] == [None] * 3
    said = {k.decode(): v for k, v in metadata.items()}
    packed = np.array(columns["time_host"], "<f8").tobytes() + np.array(columns["counts"], "<i8").tobytes()
    packed += np.array(columns["value"], "<f8").tobytes() + bytes(columns["status"])
    assert said["crc32"].decode() == f"{zlib.crc32(said['sequence'] + said['events'] + b'torque' + packed):08x}"


@pytest.mark.slow(9)
def test_a_file_truncated_at_any_byte_of_its_last_two_batches_loses_no_complete_batch(tmp_path):
    all_batches = [block(NAMES[i % 3], 10 * i, 4) for i in range(6)]
    ends = [len(write(tmp_path / f"{n}.arrows", all_batches[:n]).read_bytes()) - 8 for n in (4, 5, 6)]
    data = (tmp_path / "6.arrows").read_bytes()
    cut = tmp_path / "cut.arrows"
    for length in range(ends[0], len(data)):
        cut.write_bytes(data[:length])
        recording = read_recording(cut)
        complete = 4 + sum(length >= end for end in ends[1:])
        assert sum(map(len, recording.samples.values())) == 4 * complete
        assert len(recording.problems) == 1, "a cut is always stated"
        for name in NAMES:
            expected = np.concatenate([b.value for b in all_batches[:complete] if b.channel == name])
            np.testing.assert_array_equal(recording.samples[name].value, expected)


def test_a_flipped_bit_loses_only_its_batch_and_is_reported(tmp_path):
    path = write(tmp_path / "run.arrows", [block("torque", 0, 4), block("torque", 1000, 4), block("torque", 2000, 4)])
    data = bytearray(path.read_bytes())
    where = data.index(np.float64(1002.0).tobytes())
    data[where] ^= 1
    path.write_bytes(data)
    recording = read_recording(path)
    assert recording.samples["torque"].time_host.tolist() == [0, 1, 2, 3, 2000, 2001, 2002, 2003]
    assert recording.samples["torque"].status.tolist() == [0, 0, 0, 0, rf.GAP, 0, 0, 0]
    assert "batch 1 was left out: its CRC-32 is wrong" in recording.problems[0]


EARLY = Path(__file__).parents[1] / "data" / "first-version" / "batches-of-50-ms.arrows"


def plainly(path):
    """Samples by channel and events of a file, read by Arrow alone, whose checksums and numbers are right."""
    columns, events = {}, []
    with pa.ipc.open_stream(Path(path).read_bytes()) as reader:
        for number in range(1 << 20):
            try:
                batch, metadata = reader.read_next_batch_with_custom_metadata()
            except StopIteration:
                return {
                    name: {c: list(itertools.chain(*v)) for c, v in parts.items()} for name, parts in columns.items()
                }, events
            assert metadata[b"sequence"] == b"%d" % number
            events += json.loads(metadata[b"events"])
            said = batch.to_pydict()
            name = next(iter(said["channel"]), None)
            packed = metadata[b"sequence"] + metadata[b"events"] + (name or "").encode()
            for column, kind in schema.COLUMN_DTYPES.items():
                packed += b"" if None in said[column] else np.array(said[column], kind).tobytes()
            assert name is None or metadata[b"crc32"].decode() == f"{zlib.crc32(packed):08x}"
            for column in schema.COLUMN_DTYPES if name is not None else ():
                columns.setdefault(name, {}).setdefault(column, []).append(said[column])
    raise AssertionError("too many batches")


def batches_in(path):
    with pa.ipc.open_stream(Path(path).read_bytes()) as reader:
        return sum(1 for _ in reader)


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.tuples(st.sampled_from(NAMES), st.integers(0, 4), st.booleans()), max_size=12),
    events=st.booleans(),
    limit=st.sampled_from([1, 5, 1 << 15]),
)
def test_joined_batches_have_the_same_samples_and_events(tmp_path_factory, sizes, events, limit):
    path = tmp_path_factory.mktemp("r") / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        for number, (name, rows, counted) in enumerate(sizes):
            samples = block(name, 10 * number, rows)
            if not counted:
                samples = dataclasses.replace(samples, counts=None)
            writer.write(samples, [Event(float(number), name, "said")] * (events and number % 2))
    before = plainly(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joining, "JOINED_SAMPLES", limit)
        assert joining.join_batches(path)
    assert plainly(path) == before
    with RecordingReader(path) as reader:
        list(reader.batches())
        assert reader.problems == []


@pytest.mark.parametrize("damage", ["a bit", "the end", "the last batch"])
def test_a_recording_that_is_not_whole_is_not_joined(tmp_path, damage):
    path = write(tmp_path / "run.arrows", [block("torque", 10 * i, 10) for i in range(20)])
    data = bytearray(path.read_bytes())
    if damage == "a bit":
        data[data.index(np.float64(105.0).tobytes())] ^= 1
    path.write_bytes(data[: len(data) - {"a bit": 0, "the end": 8, "the last batch": 100}[damage]])
    before = path.read_bytes()
    assert not joining.join_batches(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.arrows"]


def test_an_interruption_of_joining_at_any_write_leaves_the_recording(tmp_path, monkeypatch):
    path = write(tmp_path / "run.arrows", [block(NAMES[i % 3], 10 * i, 10) for i in range(60)])
    before, whole = path.read_bytes(), plainly(path)
    monkeypatch.setattr(joining, "JOINED_SAMPLES", 100)
    plain_write, done, stopped = os.write, [], 0
    for stop in range(100):

        def until(descriptor, data, stop=stop):
            done.append(len(data))
            if len(done) > stop:
                plain_write(descriptor, data[: len(data) // 2])
                raise KeyboardInterrupt
            return plain_write(descriptor, data)

        done.clear()
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", until)
            try:
                assert joining.join_batches(path)
            except KeyboardInterrupt:
                stopped += 1
                assert path.read_bytes() == before
                continue
        break
    assert stopped > 10
    assert plainly(path) == whole
    assert batches_in(path) < 60


@pytest.mark.slow(20)
def test_a_kill_while_batches_are_joined_loses_nothing(tmp_path):
    path = write(tmp_path / "run.arrows", [block(NAMES[i % 3], 10 * i, 10) for i in range(6000)])
    whole = plainly(path)
    code = "import sys; from drivers.recording_format.joining import join_batches; print('', flush=True); "
    killed = 0
    for wait in np.linspace(0.0, 1.0, 24):
        with subprocess.Popen(
            [sys.executable, "-c", f"{code} join_batches(sys.argv[1])", path], stdout=subprocess.PIPE
        ) as joiner:
            joiner.stdout.readline()
            time.sleep(wait)
            joiner.kill()
            killed += joiner.wait() != 0
        assert plainly(path) == whole
    assert killed
    assert joining.join_batches(path)
    assert [p.name for p in tmp_path.iterdir()] == ["run.arrows"], "what killed ones left is removed"


def test_a_watcher_reads_on_in_the_file_that_was_replaced(tmp_path):
    path = write(tmp_path / "run.arrows", [block("torque", 10 * i, 10) for i in range(20)])
    with RecordingReader(path) as reader:
        first, _ = next(taken := reader.batches(growing=True))
        assert joining.join_batches(path)
        assert len(first) + sum(len(samples) for samples, _ in taken) == 200
        assert reader.problems == []


def test_a_recording_of_the_first_version_reads_as_arrow_alone_reads_it(tmp_path):
    columns, events = plainly(EARLY)
    shutil.copy(EARLY, tmp_path / "run.arrows")
    assert batches_in(tmp_path / "run.arrows") > 30
    assert joining.join_batches(tmp_path / "run.arrows")
    assert batches_in(tmp_path / "run.arrows") <= 3
    for path in (EARLY, tmp_path / "run.arrows"):
        recording = read_recording(path)
        assert recording.problems == ()
        assert [dataclasses.asdict(event) for event in recording.events] == events
        for name, samples in recording.samples.items():
            for column, values in columns[name].items():
                array = getattr(samples, column)
                assert (array is None and set(values) == {None}) or array.tolist() == values
        assert recording.clock("input_angle") is not None


FIRST_BATCH = """
import sys
from drivers.recording_format import Channel, Header, RecordingWriter, Samples
channel = Channel("torque", "torque", "canopen", "N*m", None, 1, 0.0, "absolute", "node 1", "SYNC")
with RecordingWriter(sys.argv[1], Header((channel,), {}, None, "", "2025-01-01T00:00:00Z")) as writer:
    before = set(sys.modules)
    writer.write(Samples.checked("torque", [0.0], [1.0]))
    print(*set(sys.modules) - before)
"""


def test_the_first_batch_waits_for_no_import(tmp_path):
    """One of pandas, by Arrow, kept the first samples from the file for up to seconds."""
    run = subprocess.run(
        [sys.executable, "-c", FIRST_BATCH, tmp_path / "run.arrows"], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == []


def test_a_missing_batch_is_reported(tmp_path):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        writer.write(block("torque", 0, 2))
        writer.batches += 1
        writer.write(block("torque", 9, 2))
    recording = read_recording(path)
    assert recording.problems == (f"{path}: batch 1 has sequence number 2, not 1.",)
    assert recording.samples["torque"].status.tolist() == [0, 0, rf.GAP, 0]


def test_an_empty_recording_is_readable(tmp_path):
    recording = read_recording(write(tmp_path / "run.arrows", []))
    assert recording.problems == ()
    assert [len(s) for s in recording.samples.values()] == [0, 0, 0]


def test_events_without_samples_are_kept(tmp_path):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        writer.write(Samples.checked("torque", [], []), [Event(1.5, "torque", "cable pulled")])
    assert read_recording(path).events == (Event(1.5, "torque", "cable pulled"),)


def test_a_recording_is_not_overwritten(tmp_path):
    path = write(tmp_path / "run.arrows", [block("torque", 0, 2)])
    before = path.read_bytes()
    with pytest.raises(edge.InputError, match="not overwritten"):
        RecordingWriter(path, HEADER)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"time [s],torque [N*m]\n", "a recording is needed here"),
        (b"01234567" * 9, r"not a recording, or it was cut within its header\.$"),
        (pa.schema([]).serialize().to_pybytes(), "states no format"),
        (
            pa.schema([], {"format": "cycloid-recording/9"}).serialize().to_pybytes(),
            'this version reads "cycloid-recording/1"',
        ),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path, content, said):
    path = tmp_path / "run.arrows"
    path.write_bytes(content)
    with pytest.raises(edge.InputError, match=said) as problem:
        read_recording(path)
    assert str(problem.value).startswith(f"{path}: ")
    assert "\n" not in str(problem.value)


def test_samples_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="equal length"):
        Samples.checked("torque", [0.0, 1.0], [0.0])


WRITE_FOREVER = """
import sys
sys.path.insert(0, "tests")
from tests.drivers.test_recording_format import HEADER, NAMES, block
from drivers.recording_format import RecordingWriter
with RecordingWriter(sys.argv[1], HEADER) as writer:
    for i in range(10**9):
        writer.write(block(NAMES[i % 3], 16 * (i // 3), 16))
        print(i + 1, flush=True)
"""


@pytest.mark.system
def test_a_killed_recorder_leaves_every_flushed_batch_readable(tmp_path):
    path = tmp_path / "run.arrows"
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, "-c", WRITE_FOREVER, path], cwd=root, env=environment, stdout=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 30
    flushed = 0
    while flushed < 200 and time.monotonic() < deadline:
        flushed = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    flushed = max([flushed, *(int(n) for n in process.stdout.read().split("\n")[:-1])])
    process.wait()
    recording = read_recording(path)
    assert sum(map(len, recording.samples.values())) >= 16 * flushed
    assert len(recording.problems) == 1
    for samples in recording.samples.values():
        np.testing.assert_array_equal(samples.counts, np.arange(len(samples)))


def test_header_fields_survive(tmp_path):
    header = dataclasses.replace(HEADER, ratio=None, pair="Zykloid µ", conditions={})
    with RecordingWriter(tmp_path / "run.arrows", header):
        pass
    assert read_recording(tmp_path / "run.arrows").header == header


def test_a_damaged_header_is_reported_and_an_old_one_without_checksum_is_read(tmp_path, monkeypatch):
    path = write(tmp_path / "run.arrows", [block("torque", 0, 5)])
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"-39.0", b"-38.0"))
    found = read_recording(path)
    (problem,) = found.problems
    assert "run.arrows: the header is damaged" in problem
    assert found.header.ratio == -38.0
    assert len(found.samples["torque"]) == 5
    mended = tmp_path / "mended.arrows"
    repair(path, mended)
    assert "the header is damaged" in read_recording(mended).header.conditions["damaged header"]
    path.write_bytes(whole.replace(b"header_crc32", b"header_crc33"))
    assert "damaged" in read_recording(path).problems[0]
    made = schema.recording_schema
    monkeypatch.setattr(
        rf.writer, "recording_schema", lambda header: made(header).with_metadata(schema.recording_metadata(header))
    )
    old = write(tmp_path / "old.arrows", [block("torque", 0, 5)])
    assert b"header_crc32" not in old.read_bytes()
    assert read_recording(old).problems == ()
    assert read_recording(old).header == HEADER


def test_a_recording_without_a_schema_is_refused(tmp_path):
    """Arrow accepts any message as a schema, and crashes the process."""
    path = write(tmp_path / "run.arrows", [block("torque", 0, 4)])
    data = bytearray(path.read_bytes())
    place = next(at for at in range(8, 64) if data[at] and message_type(data, at) == "unknown")
    data[place] = 0
    path.write_bytes(data)
    with pytest.raises(edge.InputError, match="this is not a recording, or it was cut within its header"):
        read_recording(path)


def message_type(data, place):
    """Return the type that Arrow reads for a recording's first message if one of its bytes is zero."""
    try:
        return pa.ipc.read_message(pa.py_buffer(bytes(data[:place]) + b"\0" + bytes(data[place + 1 :]))).type
    except (pa.ArrowException, OSError):
        return ""
