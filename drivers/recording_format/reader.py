"""Reading of recordings, complete or damaged."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Self

import numpy as np
import pyarrow as pa
import pydantic

from cycloid_fmu import edge
from drivers.recording_format.clocks import Alignment, Clock, clocks_of
from drivers.recording_format.decoding import Batch, DamagedBatchError, decoded
from drivers.recording_format.schema import (
    COLUMNS,
    FORMAT,
    GAP,
    HEADER_CRC,
    Event,
    FloatArray,
    Header,
    Samples,
    channel_column,
    header_checksum,
    joined,
    recording_metadata,
    recording_schema,
)
from drivers.recording_format.writer import END_OF_STREAM, MESSAGE

_SEARCH_BYTES, _PIECE_BYTES = 1 << 20, 1 << 22


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording in memory.

    Attributes
    ----------
    header
        Channels and conditions.
    samples
        Samples by channel name, in the order of the file; of length 0 if a channel has none.
    events
        All events in the order of the file, `time` in seconds since the start.
    problems
        One sentence for each problem of the file; empty if it is complete.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
    ...     done = bench.record("aligned.arrows")
    >>> recording = drivers.read_recording("aligned.arrows")
    >>> [c.unit for c in recording.header.channels], recording.aligned_time("torque").shape
    (['rad', 'rad', 'N*m'], (96,))
    """

    header: Header
    samples: Mapping[str, Samples]
    events: tuple[Event, ...]
    problems: tuple[str, ...]

    def clock(self, channel: str) -> Clock | None:
        """Return the last estimate of a channel's device clock, or None."""
        clocks = clocks_of(self.events).get(channel, {})
        return clocks[max(clocks)] if clocks else None

    def aligned_time(self, channel: str) -> FloatArray:
        """Return the times of a channel's samples, s since the start on the host's clock, shape (n,).

        They are from the device clock if its offset and drift were estimated, and then free of the varying delay in
        `time_host`; otherwise they are `time_host`.
        """
        return Alignment(clocks_of(self.events).get(channel, {})).time(self.samples[channel])


def _header(metadata: Mapping[bytes, bytes] | None, source: str) -> tuple[Header, list[str]]:
    """Return the header of a recording, and one sentence if it is damaged."""
    try:
        text = {k.decode(): v.decode() for k, v in (metadata or {}).items()}
    except UnicodeDecodeError:
        raise edge.InputError(f"{source}: the recording's header is damaged; it is not text.") from None
    if "format" not in text:
        raise edge.InputError(f"{source}: this is an Arrow stream but not a recording; it states no format.")
    edge.check_format(text["format"], FORMAT, source)
    with edge.parsed_by_others(source, "the recording's header can't be understood"):
        values = {name: json.loads(text[name]) for name in ("channels", "conditions", "ratio")}
        header = pydantic.TypeAdapter(Header).validate_python({**values, "pair": text["pair"], "start": text["start"]})
        if not all(channel.name.isprintable() for channel in header.channels):
            raise ValueError("a channel's name must be printable")
    # A header without checksum is from an early recording, unless its key is damaged.
    unknown = text.keys() - recording_metadata(header).keys() - {HEADER_CRC}
    if not unknown and text.get(HEADER_CRC) in (None, header_checksum(text)):
        return header, []
    return header, [
        f"{source}: the header is damaged, its CRC-32 is wrong: its data on channels (units, counts per turn, "
        "direction, zero), conditions, ratio, pair or start may be wrong; the samples have their own checksums."
    ]


class RecordingReader:
    """Reads a recording batch by batch, in constant memory; it may be truncated, damaged or still growing.

    A context manager. A batch with a wrong CRC-32 is left out. After damaged bytes, reading continues at the next batch
    with a correct CRC-32. In each channel that may have lost samples, the next sample is marked "gap before".

    Parameters
    ----------
    path
        A `.arrows` file.

    Attributes
    ----------
    header
        Channels and conditions.
    problems
        One sentence for each problem of the file so far.
    complete
        Number of complete batches read.

    Raises
    ------
    edge.InputError
        If the file can't be read, is not a recording or has another format.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.source = str(path)
        self._path = edge.existing(path)
        if self._path.stat().st_size == 0:
            raise edge.InputError(f"{self.source}: the file is empty; it was cut before the header of a recording.")
        self._file = self._path.open("rb")
        try:
            message = pa.ipc.read_message(self._file)
            if message.type != "schema":  # Arrow does not check this, and would end the process
                raise ValueError
            schema = pa.ipc.read_schema(message)
            names = edge.listed(schema.names)
        except Exception:  # Arrow raises exceptions of any class, whose reasons are those of its format
            cut = f"{self.source}: this is not a recording, or it was cut within its header."
            raise edge.wrong_kind(self.source, "a recording") or edge.InputError(cut) from None
        self.header, self.problems = _header(schema.metadata, self.source)
        expected = recording_schema(self.header)
        if not schema.equals(expected):
            raise edge.InputError(f"{self.source}: the columns are not those of {FORMAT}: {names}.")
        self.complete = 0
        self._number = 0
        self._offset: int = self._file.tell()
        self._good_end = self._offset
        self._next_sequence = 0
        self._lost: set[str] = set()
        self._names = [c.name for c in self.header.channels]
        self._preamble = _preamble(expected, self._names)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def batches(self, *, growing: bool = False) -> Iterator[tuple[Samples, tuple[Event, ...]]]:
        """Yield samples and events of every batch not yet yielded.

        Parameters
        ----------
        growing
            Whether a recorder may still be writing the file: its end is then no problem, and a later call continues
            there.
        """
        while True:
            for batch, end in self._piece():
                self._offset = end
                if (taken := self._taken(batch)) is not None:
                    yield taken
            # Pieces stop at the end, at damage and at a batch that is not all in the piece: continue with this one.
            size = self.size
            if self._bytes(self._offset, 8) == END_OF_STREAM:
                return
            message = self._message(self._offset, size)
            if message is not None:
                data, self._offset = message
                if data is not None and (taken := self._taken(data)) is not None:
                    yield taken
            elif growing:
                return
            elif not self._resume(size):
                if self._offset >= size and self._good_end == self._offset:
                    state = f"it was not closed; all {self.complete} batches were read."
                else:
                    state = f"it is truncated or damaged after {self.complete} complete batches; these were read."
                self.problems.append(f"{self.source}: {state}")
                return

    def _piece(self) -> Iterator[tuple[Batch, int]]:
        """Yield the next batches that one piece of the file holds, and the byte at which each ends."""
        begin = self._offset - len(self._preamble)
        source = pa.BufferReader(self._preamble + self._bytes(self._offset, _PIECE_BYTES))
        with pa.ipc.open_stream(source) as reader:
            reader.read_next_batch()
            while True:
                try:
                    batch = reader.read_next_batch_with_custom_metadata()
                except (StopIteration, ValueError, OSError, EOFError, pa.ArrowException):
                    return
                yield batch, begin + source.tell()

    def _taken(self, data: Batch | bytes) -> tuple[Samples, tuple[Event, ...]] | None:
        """Return a batch or that of a message, its first sample marked after a loss; None if it is damaged."""
        try:
            sequence, samples, events = self._decoded(data)
        except DamagedBatchError as problem:
            self.problems.append(f"{self.source}: batch {self._number} was left out: {problem}.")
            self._lost = set(self._names)
            self._number += 1
            self._next_sequence += 1
            return None
        if sequence != self._next_sequence:
            self.problems.append(
                f"{self.source}: batch {self._number} has sequence number {sequence}, not {self._next_sequence}."
            )
            self._lost = set(self._names)
        self._number += 1
        self._good_end, self._next_sequence = self._offset, sequence + 1
        self.complete += 1
        return self._marked(samples), events

    def _marked(self, samples: Samples) -> Samples:
        """Return samples, the first one marked if samples of the channel may be lost before it."""
        if not len(samples) or samples.channel not in self._lost:
            return samples
        self._lost.discard(samples.channel)
        status = samples.status.copy()
        status[0] |= GAP
        return dataclasses.replace(samples, status=status)

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return os.fstat(self._file.fileno()).st_size  # of this file, even where another has taken its name

    @property
    def position(self) -> int:
        """Byte up to which the file was read."""
        return self._offset

    def _bytes(self, offset: int, count: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(count)

    def _message(self, offset: int, size: int) -> tuple[bytes | None, int] | None:
        """Return the bytes and end of the message here; bytes None if it is no batch; None if there is no message."""
        if offset + 8 > size or self._bytes(offset, 4) != MESSAGE:
            return None
        try:
            self._file.seek(offset)
            message = pa.ipc.read_message(self._file)
            end = self._file.tell()
        except (pa.ArrowException, OSError, EOFError, MemoryError):  # MemoryError: a damaged length
            return None
        if not offset < end <= size:
            return None
        return (self._bytes(offset, end - offset) if message.type == "record batch" else None), end

    def _decoded(self, data: Batch | bytes) -> tuple[int, Samples, tuple[Event, ...]]:
        """Return sequence number, samples and events of a batch or message; `DamagedBatchError` if it is damaged."""
        if not isinstance(data, bytes):
            return decoded(data, self._names)
        try:
            with pa.ipc.open_stream(pa.BufferReader(self._preamble + data)) as reader:
                reader.read_next_batch()
                batch = reader.read_next_batch_with_custom_metadata()
        except (ValueError, OSError, pa.ArrowException, StopIteration) as problem:  # OSError: lengths beyond the end
            raise DamagedBatchError(str(problem)) from problem
        return decoded(batch, self._names)

    def _is_sound(self, data: bytes) -> bool:
        with contextlib.suppress(DamagedBatchError):
            self._decoded(data)
            return True
        return False

    def _resume(self, size: int) -> bool:
        """Continue at the next batch with a correct CRC-32 after damage; False if there is none."""
        position = self._good_end + 8
        while position < size:
            block = self._bytes(position, _SEARCH_BYTES)
            begin = block.find(MESSAGE)
            while begin >= 0:
                at = position + begin
                taken = self._message(at, size) if at % 8 == 0 else None
                if taken is not None and taken[0] is not None and self._is_sound(taken[0]):
                    self.problems.append(
                        f"{self.source}: damaged from byte {self._good_end} on; reading continued at byte {at}."
                    )
                    self._lost = set(self._names)
                    self._offset = at
                    return True
                begin = block.find(MESSAGE, begin + 1)
            if len(block) < _SEARCH_BYTES:
                break
            position += len(block) - len(MESSAGE)
        return False


def _preamble(schema: pa.Schema, names: Sequence[str]) -> bytes:
    """Return the start of a stream up to an empty batch: the schema and the dictionary of channel names."""
    sink = pa.BufferOutputStream()
    columns = [channel_column(np.zeros(0, np.int16), names), *(pa.nulls(0, kind) for kind, _, _ in COLUMNS.values())]
    with pa.ipc.new_stream(sink, schema) as stream:
        stream.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
    return bytes(sink.getvalue())[: -len(END_OF_STREAM)]


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Read a whole recording, complete or damaged; see `RecordingReader`.

    Raises
    ------
    edge.InputError
        If the file can't be read, is not a recording or has another format.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
    ...     done = bench.record("read.arrows")
    >>> recording = drivers.read_recording("read.arrows")
    >>> recording.header.ratio, len(recording.samples["torque"]), recording.problems
    (-39.0, 96, ())
    """
    with RecordingReader(path) as reader:
        blocks: dict[str, list[Samples]] = {c.name: [] for c in reader.header.channels}
        events: list[Event] = []
        for samples, new_events in reader.batches():
            events.extend(new_events)
            if len(samples):
                blocks[samples.channel].append(samples)
        samples_of = {n: joined(n, b) for n, b in blocks.items()}
        return Recording(reader.header, samples_of, tuple(events), tuple(reader.problems))


def read_clocks(path: str | os.PathLike[str], channels: Collection[str]) -> dict[str, dict[int, Clock]]:
    """Return the device clocks of channels for `Alignment`: {channel: {number of restarts: clock}}.

    Channels without a device clock, or too short for an estimate, are absent. Two channels stamped by one clock, that
    of a CAN interface or of the SYNC that latched both, get the better of the two estimates, so that equal times stay
    equal. If no channel has a device clock, the file is read only up to the first samples of each channel.

    Raises
    ------
    edge.InputError
        If the file can't be read, is not a recording or has another format.
    """
    first: dict[str, Samples] = {}
    events: list[Event] = []
    with RecordingReader(path) as reader:
        devices = {c.name: _clock_device(c.time_source) for c in reader.header.channels}
        for samples, new_events in reader.batches():
            events.extend(new_events)
            if len(samples) and samples.channel in channels:
                first.setdefault(samples.channel, samples)
            if len(first) == len(channels) and all(s.time_device is None for s in first.values()):
                return {}
    by_channel = {name: clocks for name, clocks in clocks_of(events).items() if name in channels}
    names = list(by_channel)
    for number, name in enumerate(names):
        for other in names[number + 1 :]:
            same = devices[name] is not None and devices[name] == devices[other]
            if same or _stamps(first[name]) & _stamps(first[other]):
                for restarts in by_channel[name].keys() & by_channel[other].keys():
                    best = min(
                        by_channel[name][restarts], by_channel[other][restarts], key=lambda clock: clock.uncertainty
                    )
                    by_channel[name][restarts] = by_channel[other][restarts] = best
    return by_channel


def _clock_device(time_source: str) -> str | None:
    """Return the device whose hardware clock stamps a channel, or None."""
    return time_source.rpartition(" (")[2] if time_source.startswith("hardware clock") else None


def _stamps(samples: Samples) -> set[tuple[float, float]]:
    """Return the pairs of device and host time of samples; stamps of different clocks have none in common."""
    assert samples.time_device is not None
    return set(zip(samples.time_device.tolist(), samples.time_host.tolist(), strict=True))
