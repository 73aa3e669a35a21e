"""The bench recording, `cycloid-recording/1`: an Arrow IPC stream that survives a kill at any byte.

No bus library stands behind this module: it is what a recorder writes and an evaluation reads.

A file is a schema, record batches and an end mark. Every batch holds samples of one channel as they came, in the
columns `channel` (dictionary of the channels' names), `time_host`, `time_device`, `counts`, `value` and `status`.
The schema's metadata, UTF-8 text, are `format`, `channels` (a JSON list of objects, the fields of `Channel`),
`conditions` (a JSON object, SI numbers and text), `ratio` (JSON number or null), `pair`, `start` (ISO 8601, UTC) and
`header_crc32`, the CRC-32 of the texts before, each behind its key, in this order; the first recordings have none.
Each batch's custom metadata are `sequence` (decimal, from 0), `events` (a JSON list of {time, channel, text}) and
`crc32` (eight hexadecimal digits).

The CRC-32 is that of zlib and PNG, over these bytes in this order: `sequence` and `events` as stored, the channel's
name in UTF-8, then the columns `time_host`, `time_device`, `counts`, `value`, `status` as little-endian arrays without
padding, where a column that is null contributes nothing.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import sys
import time
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cycloid_fmu import edge

FORMAT = "cycloid-recording/1"
GAP, CHECKSUM, RESET, DUPLICATE, OUT_OF_ORDER, ROLLOVER = 1, 2, 4, 8, 16, 32
ROLES = ("input_angle", "output_angle", "torque", "other")

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
ByteArray: TypeAlias = npt.NDArray[np.uint8]

FLUSH_SECONDS = 1.0  # of samples that a power cut can cost; a kill costs none that `write` returned for
CLOCK_JUMP = 1.0  # s between the stamps' step and the arrivals' that no bus and no scheduler explains
_CLOCK = "clock: "
_HEADER_CRC = "header_crc32"
_MESSAGE = b"\xff\xff\xff\xff"  # what every message of an Arrow stream begins with, at a multiple of eight bytes
_END_OF_STREAM = _MESSAGE + b"\x00\x00\x00\x00"
_SEARCH_BYTES = 1 << 20
_PIECE_BYTES = 1 << 22  # of a file, decoded at a time


@dataclasses.dataclass(frozen=True)
class Channel:
    """One measured quantity and where it comes from.

    Attributes
    ----------
    name
        Unique in the recording: "input_angle", "output_angle", "torque" or another.
    role
        What an evaluation takes it for: the name where it is one of these three, else "other".
    protocol
        Name of the protocol that delivered it.
    unit
        SI unit of the values: "rad", "N*m" or another.
    counts_per_turn
        Counts of one turn; None where the channel has no counts.
    direction
        +1 where the counts grow with the angle counter-clockwise, -1 where they fall.
    zero
        Value, in `unit`, that the sensor shows (with its direction) when the shaft is at zero; already subtracted.
    zero_reference
        "absolute": the zero is the same in every recording; "incremental": each recording has its own.
    identity
        What the device says it is; behind a semicolon its state when it was opened.
    time_source
        What event `time_host` marks and whose clock it is: a hardware clock's device stands in brackets at the end.
    """

    name: str
    role: str
    protocol: str
    unit: str
    counts_per_turn: int | None
    direction: int
    zero: float
    zero_reference: str
    identity: str
    time_source: str


@dataclasses.dataclass(frozen=True)
class Event:
    """Something that happened to a channel: `time` in seconds on the host's clock, as the samples' `time_host`."""

    time: float
    channel: str
    text: str


@dataclasses.dataclass(frozen=True)
class Clock:
    """How a device's clock runs against the host's: host = origin_host + (1 + drift) (device - origin_device).

    Attributes
    ----------
    origin_device, origin_host
        A point of the line in the middle of the samples, s.
    drift
        Relative rate of the host's clock to the device's, less one.
    uncertainty
        Half width at 95 %, s, at the ends of the samples, of a band about the line.
    """

    origin_device: float
    origin_host: float
    drift: float
    uncertainty: float

    def host(self, device: npt.ArrayLike) -> FloatArray:
        """Return the host's time, s, of device times, s: earliest arrival, the constant part of the delay included."""
        away = np.asarray(device, np.float64) - self.origin_device
        return np.asarray(self.origin_host + away + self.drift * away, np.float64)


def clock_event(time: float, channel: str, clock: Clock, restarts: int) -> Event:
    """Return the event that says how a channel's own clock runs after so many restarts; see `read_clocks`."""
    return Event(time, channel, _CLOCK + json.dumps({**dataclasses.asdict(clock), "restarts": restarts}))


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples of one channel, arrays of shape (n,).

    Attributes
    ----------
    channel
        The channel's name.
    time_host
        Seconds: in a recording since its `start`, fresh from an encoder since 1970.
    time_device
        Seconds on the device's own clock, or None where it has none.
    counts
        Unwrapped counts as the device sent them, or None where it sends none.
    value
        SI value: continuous radians of an angle, newton metres of a torque.
    status
        Bits: 1 gap before, 2 checksum failed (before), 4 reset, 8 duplicate (it, or one left out before it), 16 out of
        order, 32 rollover.
    """

    channel: str
    time_host: FloatArray
    time_device: FloatArray | None
    counts: IntArray | None
    value: FloatArray
    status: ByteArray

    @classmethod
    def checked(
        cls,
        channel: str,
        time_host: npt.ArrayLike,
        value: npt.ArrayLike,
        *,
        time_device: npt.ArrayLike | None = None,
        counts: npt.ArrayLike | None = None,
        status: npt.ArrayLike | None = None,
    ) -> Samples:
        """Return samples of these arrays, converted; no `status` means that nothing is wrong.

        Raises
        ------
        ValueError
            If an array isn't one-dimensional and of the same length as the others.
        """
        host = np.asarray(time_host, np.float64)
        made = cls(
            channel,
            host,
            None if time_device is None else np.asarray(time_device, np.float64),
            None if counts is None else np.asarray(counts, np.int64),
            np.asarray(value, np.float64),
            np.zeros(host.shape, np.uint8) if status is None else np.asarray(status, np.uint8),
        )
        shapes = {name: a.shape for name in _COLUMNS if (a := getattr(made, name)) is not None}
        if len(host.shape) != 1 or len(set(shapes.values())) != 1:
            raise ValueError(f"the samples of {channel} must be one-dimensional and of one length, not {shapes}")
        return made

    def __len__(self) -> int:
        return len(self.time_host)


@dataclasses.dataclass(frozen=True)
class Header:
    """What a recording says about itself: channels, conditions (SI), signed ratio, pair's name, start in UTC."""

    channels: tuple[Channel, ...]
    conditions: Mapping[str, float | str]
    ratio: float | None
    pair: str
    start: str


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording that was read.

    Attributes
    ----------
    header
        Channels and conditions.
    samples
        Samples of every channel by its name, in the order of the file; length 0 where a channel has none.
    events
        All events in the order of the file, `time` in seconds since the start.
    problems
        One sentence for each thing wrong with the file; empty where it is whole.
    """

    header: Header
    samples: Mapping[str, Samples]
    events: tuple[Event, ...]
    problems: tuple[str, ...]

    def clock(self, channel: str) -> Clock | None:
        """Return the last estimate of a channel's clock; None where it has none."""
        clocks = _clocks(self.events).get(channel, {})
        return clocks[max(clocks)] if clocks else None

    def aligned_time(self, channel: str) -> FloatArray:
        """Return when a channel's samples were taken, s since the start on the host's clock, shape (n,).

        By the channel's own clock where it has one and its offset and drift were estimated: free of the delays on the
        way to the host, which `time_host` has. Else `time_host`.
        """
        return Alignment(_clocks(self.events).get(channel, {})).time(self.samples[channel])


def _clocks(events: Iterable[Event]) -> dict[str, dict[int, Clock]]:
    """Return the last estimate of each channel's clock after each of its restarts."""
    found: dict[str, dict[int, Clock]] = {}
    for event in events:
        if event.text.startswith(_CLOCK):
            said = json.loads(event.text.removeprefix(_CLOCK))
            restarts = said.pop("restarts", 0)
            found.setdefault(event.channel, {})[restarts] = Clock(**said)
    return found


def clock_restarts(samples: Samples, last: tuple[float, float] | None) -> npt.NDArray[np.bool_]:
    """Return at which samples the device's clock starts anew, shape (n,).

    Where they are marked reset, or the device's time goes back or ahead of the host's by more than `CLOCK_JUMP`.
    Arrivals that were held up and then come at once are no restart.

    Parameters
    ----------
    samples
        Samples that have a device time.
    last
        Device and host time of the sample before, s; None at the beginning.
    """
    assert samples.time_device is not None
    if not len(samples):
        return np.zeros(0, np.bool_)
    device, host = last if last is not None else (samples.time_device[0], samples.time_host[0])
    step = np.diff(samples.time_device, prepend=device)
    waited = np.diff(samples.time_host, prepend=host)
    return np.asarray((samples.status & RESET != 0) | (step < -CLOCK_JUMP) | (step > waited + CLOCK_JUMP))


class Alignment:
    """Puts one channel's samples, block by block in their order, on the host's clock by the device's own.

    Parameters
    ----------
    clocks
        The device's clock after each of its restarts, as `read_clocks` gives it.
    """

    def __init__(self, clocks: Mapping[int, Clock]) -> None:
        self._clocks = clocks
        self._restarts = 0
        self._last: tuple[float, float] | None = None

    def time(self, samples: Samples) -> FloatArray:
        """Return when the samples were taken, s since the start; `time_host` where the device's clock is not known."""
        if samples.time_device is None or not len(samples):
            return samples.time_host
        number = self._restarts + np.cumsum(clock_restarts(samples, self._last))
        self._restarts = int(number[-1])
        self._last = float(samples.time_device[-1]), float(samples.time_host[-1])
        time = samples.time_host.copy()
        for restarts in np.unique(number).tolist():
            if (clock := self._clocks.get(restarts)) is not None:
                time[number == restarts] = clock.host(samples.time_device[number == restarts])
        return time


_COLUMNS: Mapping[str, tuple[pa.DataType, str, bool]] = {
    "time_host": (pa.float64(), "<f8", False),
    "time_device": (pa.float64(), "<f8", True),
    "counts": (pa.int64(), "<i8", True),
    "value": (pa.float64(), "<f8", False),
    "status": (pa.uint8(), "u1", False),
}
_BYTES_OF = tuple((name, np.dtype(kind)) for name, (_, kind, _) in _COLUMNS.items())
COLUMN_DTYPES: Mapping[str, str] = {name: kind for name, (_, kind, _) in _COLUMNS.items()}


def batch_checksum(sequence: int, events: str, samples: Samples) -> str:
    """Return the CRC-32 of a batch as eight hexadecimal digits; the module's text defines the bytes."""
    crc = zlib.crc32(f"{sequence}{events}{samples.channel}".encode())
    for name, kind in _BYTES_OF:
        array = getattr(samples, name)
        if array is not None:
            crc = zlib.crc32(np.ascontiguousarray(array, kind).data, crc)
    return f"{crc:08x}"


def recording_metadata(header: Header) -> dict[str, str]:
    """Return what a recording says about itself as texts, see the module's."""
    return {
        "format": FORMAT,
        "channels": json.dumps([dataclasses.asdict(c) for c in header.channels]),
        "conditions": json.dumps(dict(header.conditions)),
        "ratio": json.dumps(header.ratio),
        "pair": header.pair,
        "start": header.start,
    }


def _header_checksum(texts: Mapping[str, str]) -> str:
    said = "".join(f"{key}{texts[key]}" for key in ("format", "channels", "conditions", "ratio", "pair", "start"))
    return f"{zlib.crc32(said.encode()):08x}"


def recording_schema(header: Header) -> pa.Schema:
    """Return the Arrow schema of a recording: columns and metadata."""
    fields = [pa.field("channel", pa.dictionary(pa.int16(), pa.string()), nullable=False)]
    fields += [pa.field(name, kind, nullable=nullable) for name, (kind, _, nullable) in _COLUMNS.items()]
    texts = recording_metadata(header)
    return pa.schema(fields, metadata={**texts, _HEADER_CRC: _header_checksum(texts)})


def record_batch(samples: Samples, schema: pa.Schema, names: Sequence[str]) -> pa.RecordBatch:
    """Return samples as a batch of a recording's table; ValueError if its channel is none of `names`."""
    n = len(samples)
    index = np.full(n, list(names).index(samples.channel), np.int16)
    columns = [pa.DictionaryArray.from_arrays(pa.array(index), pa.array(names, pa.string()))]
    for name, (kind, _, _) in _COLUMNS.items():
        array = getattr(samples, name)
        columns.append(pa.nulls(n, kind) if array is None else pa.array(array, kind))
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def check_new(path: str | os.PathLike[str]) -> None:
    """Refuse, with an `edge.InputError`, a path at which there is something already: no recording is overwritten."""
    if Path(path).exists():
        raise edge.InputError(f"{path}: this file exists and recordings are not overwritten; name another.")


class _Sink(io.RawIOBase):
    """A file that has the header of a stream at once: Arrow's writer gives it only with the first batch.

    Each message is gathered until `flush` and given to the operating system in one piece.
    """

    def __init__(self, descriptor: int, schema: pa.Schema) -> None:
        self._descriptor = descriptor
        empty = pa.BufferOutputStream()
        pa.ipc.new_stream(empty, schema).close()
        header = bytes(empty.getvalue())[: -len(_END_OF_STREAM)]
        self._put(header)
        self._skip = len(header)
        self._parts: list[bytes] = []

    def _put(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        """Take a piece; the header that Arrow's writer repeats is passed over."""
        given = bytes(data)
        passed = min(self._skip, len(given))
        self._skip -= passed
        self._parts.append(given[passed:])
        return len(given)

    def flush(self) -> None:
        """Give what was taken to the operating system."""
        data, self._parts = b"".join(self._parts), []
        self._put(data)


class RecordingWriter:
    """A recording being written: every batch is with the operating system when `write` returns.

    A kill loses at most the batch being written, a power cut at most the last `FLUSH_SECONDS`: that often the disk is
    asked to hold all of it.

    Parameters
    ----------
    path
        New file; what is recorded is never overwritten.
    header
        Channels and conditions.

    Raises
    ------
    edge.InputError
        If the file exists or can't be created.
    """

    def __init__(self, path: str | os.PathLike[str], header: Header) -> None:
        self._names = [c.name for c in header.channels]
        self._schema = recording_schema(header)
        self._sequence = 0
        self._whole = True
        try:
            self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            check_new(path)
            raise
        except OSError as problem:
            raise edge.InputError(f"{path}: {problem.strerror or problem}.") from None
        self._sink = _Sink(self._descriptor, self._schema)
        self._stream = pa.ipc.new_stream(pa.PythonFile(self._sink, "w"), self._schema)
        self._end, self._flushed = os.lseek(self._descriptor, 0, os.SEEK_CUR), time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, samples: Samples, events: Sequence[Event] = ()) -> None:
        """Append samples of one channel and what happened meanwhile; no samples, events only, is a batch too.

        Raises
        ------
        ValueError
            If the header has no such channel.
        OSError
            If the disk does not take them; the batches before stay readable, what was written of this one is cut off.
        """
        said = json.dumps([dataclasses.asdict(e) for e in events])
        metadata = {
            "sequence": str(self._sequence),
            "events": said,
            "crc32": batch_checksum(self._sequence, said, samples),
        }
        batch = record_batch(samples, self._schema, self._names)
        self._whole = False
        try:
            self._stream.write_batch(batch, custom_metadata=metadata)
            self._sink.flush()
        except OSError:
            os.ftruncate(self._descriptor, self._end)
            raise
        self._whole = True
        self._end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        self._sequence += 1
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            os.fsync(self._descriptor)
            self._flushed = time.monotonic()

    def close(self) -> None:
        """End the stream; after a failed write the end mark is left out, so that the file says it was not closed."""
        if self._descriptor < 0:
            return
        try:
            if self._whole:
                self._stream.close()
                self._sink.flush()
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
            self._descriptor = -1


def _header(metadata: Mapping[bytes, bytes] | None, source: str) -> tuple[Header, list[str]]:
    """Return what a recording says about itself, and a sentence where that is damaged."""
    try:
        text = {k.decode(): v.decode() for k, v in (metadata or {}).items()}
    except UnicodeDecodeError:
        raise edge.InputError(f"{source}: the recording's header is damaged; it is no text.") from None
    if "format" not in text:
        raise edge.InputError(f"{source}: this is an Arrow stream but not a recording; it names no format.")
    if text["format"] != FORMAT:
        raise edge.InputError(f'{source}: format = "{text["format"]}": this version reads "{FORMAT}".')
    try:
        header = Header(
            tuple(Channel(**c) for c in json.loads(text["channels"])),
            json.loads(text["conditions"]),
            json.loads(text["ratio"]),
            text["pair"],
            text["start"],
        )
    except (KeyError, TypeError, ValueError) as problem:
        raise edge.InputError(f"{source}: the recording's header can't be understood ({problem}).") from None
    # Without its checksum it is one of the first recordings, unless a damaged key stands in the place.
    unknown = text.keys() - recording_metadata(header).keys() - {_HEADER_CRC}
    if not unknown and text.get(_HEADER_CRC) in (None, _header_checksum(text)):
        return header, []
    return header, [
        f"{source}: the header is damaged, its CRC-32 is wrong: what it says of channels (units, counts per turn, "
        "direction, zero), conditions, ratio, pair or start may be wrong; the samples have checksums of their own."
    ]


def _decoded(
    batches: Sequence[tuple[pa.RecordBatch, Mapping[bytes, bytes] | None]], names: Sequence[str]
) -> Iterator[tuple[int, Samples, tuple[Event, ...]] | Exception]:
    """Yield sequence number, samples and events of each batch, or why it can't be trusted.

    Their columns are taken together: a batch is a twentieth of a second, and to ask Arrow for each one's costs more
    than what is in it.
    """
    sound: list[pa.RecordBatch] = []
    problems: dict[int, Exception] = {}
    for place, (batch, _) in enumerate(batches):
        try:
            batch.validate()
        except pa.ArrowException as problem:
            problems[place] = problem
        else:
            sound.append(batch)
    if not sound:
        yield from problems.values()
        return
    ends = np.cumsum([0, *(batch.num_rows for batch in sound)])
    table = pa.Table.from_batches(sound)
    arrays: dict[str, npt.NDArray[Any]] = {}
    gaps: dict[str, list[bool]] = {}
    for name, (_, dtype, _) in _COLUMNS.items():
        column = table.column(name)
        missing = np.asarray(column.is_null()) if column.null_count else np.zeros(len(column), bool)
        nulls = np.concatenate([[0], np.cumsum(missing)])
        gaps[name] = (np.diff(nulls[ends]) > 0).tolist()
        arrays[name] = np.asarray(column.fill_null(0) if column.null_count else column, dtype)
    # By the number, as the header counts its channels: a damaged dictionary names them wrongly.
    numbers = pa.chunked_array([batch.column(0).indices for batch in sound], pa.int16())
    rows = np.asarray(numbers.fill_null(-1) if numbers.null_count else numbers)
    changes = np.flatnonzero(np.diff(rows)) + 1
    mixed = (np.searchsorted(changes, ends[1:]) > np.searchsorted(changes, ends[:-1], "right")).tolist()
    spans = zip(mixed, *gaps.values(), ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    for place, (_, metadata) in enumerate(batches):
        if place in problems:
            yield problems[place]
            continue
        mixes, *null, begin, end = next(spans)
        columns = {
            name: None if absent else array[begin:end]
            for (name, array), absent in zip(arrays.items(), null, strict=True)
        }
        try:
            if mixes:
                raise ValueError("it mixes channels")
            yield _checked(metadata or {}, columns, int(rows[begin]) if end > begin else None, names)
        except (ValueError, TypeError, KeyError) as problem:
            yield problem


def _checked(
    metadata: Mapping[bytes, bytes], columns: Mapping[str, Any], number: int | None, names: Sequence[str]
) -> tuple[int, Samples, tuple[Event, ...]]:
    """Return sequence number, samples and events of a batch of channel `number`; ValueError says why not."""
    try:
        number_said, said, crc = (metadata[key] for key in (b"sequence", b"events", b"crc32"))
    except KeyError:
        raise ValueError("it has no sequence number, events or CRC-32") from None
    sequence, text = int(number_said), said.decode()
    events = () if text == "[]" else tuple(Event(**e) for e in json.loads(text))
    if number is not None and not 0 <= number < len(names):
        raise ValueError("its channel is none of the header's")
    # An empty batch has no row that names its channel: it is the one the CRC-32 fits.
    for name in [names[number]] if number is not None else names:
        samples = Samples(name, **columns)
        if batch_checksum(sequence, text, samples).encode() == crc:
            return sequence, samples, events
    raise ValueError("its CRC-32 is wrong")


def joined(name: str, blocks: Sequence[Samples]) -> Samples:
    """Return a channel's blocks as one; a column that one of them lacks is None."""

    def column(attribute: str, kind: str) -> npt.NDArray[Any]:
        return np.concatenate([np.zeros(0, kind), *(getattr(b, attribute) for b in blocks)]).astype(kind)

    def has(attribute: str) -> bool:
        return bool(blocks) and all(getattr(b, attribute) is not None for b in blocks)

    return Samples(
        name,
        column("time_host", "f8"),
        column("time_device", "f8") if has("time_device") else None,
        column("counts", "i8") if has("counts") else None,
        column("value", "f8"),
        column("status", "u1"),
    )


class RecordingReader:
    """A recording read batch by batch, at constant memory; it may be torn, damaged or still growing.

    A context manager. A batch whose CRC-32 is wrong is left out. Where bytes are damaged, the next batch whose CRC-32
    is right is searched for and reading goes on there. The next sample of each channel that may have lost samples so
    is marked "gap before".

    Parameters
    ----------
    path
        A `.arrows` file.

    Attributes
    ----------
    header
        Channels and conditions.
    problems
        One sentence for each thing wrong with the file, as far as it was read.
    complete
        Number of complete batches read.

    Raises
    ------
    edge.InputError
        If the file can't be read, is no recording or has another format.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.source = str(path)
        self._path = edge.existing(path)
        if self._path.stat().st_size == 0:
            raise edge.InputError(f"{self.source}: the file is empty; it was cut before the header of a recording.")
        self._file = pa.OSFile(self.source, "rb")
        try:
            schema = pa.ipc.read_schema(pa.ipc.read_message(self._file))
        except (pa.ArrowException, OSError, EOFError):
            self._file.close()
            raise edge.InputError(f"{self.source}: this is not a recording, or it was cut within its header.") from None
        self.header, self.problems = _header(schema.metadata, self.source)
        expected = recording_schema(self.header)
        if not schema.equals(expected):
            raise edge.InputError(f"{self.source}: the columns are not those of {FORMAT}: {', '.join(schema.names)}.")
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
            The end is where the recorder is just now, not a cut: it is no problem, and a later call goes on there.
        """
        while True:
            batches, ends = self._sound()
            for decoded, end in zip(_decoded(batches, self._names), ends, strict=True):
                self._offset = end
                if (taken := self._judged(decoded)) is not None:
                    yield taken
            # What is read many at a time stops at the end, at damage and where a piece is cut: one by one from there.
            size = self._path.stat().st_size
            if self._bytes(self._offset, 8) == _END_OF_STREAM:
                return
            found = self._message(self._offset, size)
            if found is None:
                if growing:
                    return
                if not self._resume(size):
                    if self._offset >= size and self._good_end == self._offset:
                        self.problems.append(
                            f"{self.source}: it was not closed; all {self.complete} batches were read."
                        )
                    else:
                        self.problems.append(
                            f"{self.source}: it is cut or damaged after {self.complete} complete batches; "
                            "these were read."
                        )
                    return
                continue
            data, self._offset = found
            if data is None:
                continue
            if (taken := self._judged(self._decoded(data))) is not None:
                yield taken

    def _judged(
        self, decoded: tuple[int, Samples, tuple[Event, ...]] | Exception
    ) -> tuple[Samples, tuple[Event, ...]] | None:
        """Return samples and events of the next batch, marked where something is lost before; None if it is wrong."""
        if isinstance(decoded, Exception):
            self._left_out(decoded)
            return None
        sequence, samples, said = decoded
        if sequence != self._next_sequence:
            self.problems.append(
                f"{self.source}: batch {self._number} has sequence number {sequence}, not {self._next_sequence}."
            )
            self._lost = set(self._names)
        self._number += 1
        self._good_end, self._next_sequence = self._offset, sequence + 1
        self.complete += 1
        if len(samples) and samples.channel in self._lost:
            status = samples.status.copy()
            status[0] |= GAP
            samples = dataclasses.replace(samples, status=status)
            self._lost.discard(samples.channel)
        return samples, said

    def _left_out(self, problem: Exception) -> None:
        self.problems.append(f"{self.source}: batch {self._number} was left out: {problem}.")
        self._lost = set(self._names)
        self._number += 1
        self._next_sequence += 1

    def _sound(self) -> tuple[list[tuple[pa.RecordBatch, Mapping[bytes, bytes] | None]], list[int]]:
        """Return the next batches and the byte where each ends, as far as one piece of the file holds them."""
        begin = self._offset - len(self._preamble)
        source = pa.BufferReader(self._preamble + self._bytes(self._offset, _PIECE_BYTES))
        batches: list[tuple[pa.RecordBatch, Mapping[bytes, bytes] | None]] = []
        ends: list[int] = []
        with pa.ipc.open_stream(source) as reader:
            reader.read_next_batch()
            while True:
                try:
                    batches.append(reader.read_next_batch_with_custom_metadata())
                except (StopIteration, ValueError, OSError, EOFError, pa.ArrowException):
                    return batches, ends
                ends.append(begin + source.tell())

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return int(self._path.stat().st_size)

    @property
    def position(self) -> int:
        """Byte up to which it was read."""
        return self._offset

    def _bytes(self, offset: int, count: int) -> bytes:
        self._file.seek(offset)
        return bytes(self._file.read(count))

    def _message(self, offset: int, size: int) -> tuple[bytes | None, int] | None:
        """Return a batch (None if it is none) here and where the message ends; None if there is no message."""
        if offset + 8 > size or self._bytes(offset, 4) != _MESSAGE:
            return None
        try:
            self._file.seek(offset)
            message = pa.ipc.read_message(self._file)
            end = self._file.tell()
        except (pa.ArrowException, OSError, EOFError):
            return None
        if not offset < end <= size:
            return None
        return (self._bytes(offset, end - offset) if message.type == "record batch" else None), end

    def _decoded(self, data: bytes) -> tuple[int, Samples, tuple[Event, ...]] | Exception:
        """Return the batch of a message, as the one batch of a stream, or what is wrong with it."""
        try:
            with pa.ipc.open_stream(pa.BufferReader(self._preamble + data)) as reader:
                reader.read_next_batch()
                return next(_decoded([reader.read_next_batch_with_custom_metadata()], self._names))
        except (ValueError, OSError, pa.ArrowException, StopIteration) as problem:  # OSError of lengths beyond the end
            return problem

    def _resume(self, size: int) -> bool:
        """Find the next batch that can be trusted behind a damaged place and go on there; False if there is none."""
        position = self._good_end + 8
        while position < size:
            block = self._bytes(position, _SEARCH_BYTES)
            found = block.find(_MESSAGE)
            while found >= 0:
                at = position + found
                taken = self._message(at, size) if at % 8 == 0 else None
                if taken is not None and taken[0] is not None and not isinstance(self._decoded(taken[0]), Exception):
                    self.problems.append(
                        f"{self.source}: damaged from byte {self._good_end} on; reading went on at byte {at}."
                    )
                    self._lost = set(self._names)
                    self._offset = at
                    return True
                found = block.find(_MESSAGE, found + 1)
            if len(block) < _SEARCH_BYTES:
                break
            position += len(block) - len(_MESSAGE)
        return False


def _preamble(schema: pa.Schema, names: Sequence[str]) -> bytes:
    """Return the start of a stream, to the end of an empty batch: schema and the dictionary of channel names."""
    sink = pa.BufferOutputStream()
    columns = [pa.DictionaryArray.from_arrays(pa.array([], pa.int16()), pa.array(names, pa.string()))]
    columns += [pa.array([], kind) for kind, _, _ in _COLUMNS.values()]
    with pa.ipc.new_stream(sink, schema) as stream:
        stream.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
    return bytes(sink.getvalue())[: -len(_END_OF_STREAM)]


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Read a whole recording, however it ended; see `RecordingReader`.

    Raises
    ------
    edge.InputError
        If the file can't be read, is no recording or has another format.
    """
    with RecordingReader(path) as reader:
        blocks: dict[str, list[Samples]] = {c.name: [] for c in reader.header.channels}
        events: list[Event] = []
        for samples, said in reader.batches():
            events.extend(said)
            if len(samples):
                blocks[samples.channel].append(samples)
        samples_of = {n: joined(n, b) for n, b in blocks.items()}
        return Recording(reader.header, samples_of, tuple(events), tuple(reader.problems))


def read_clocks(path: str | os.PathLike[str], channels: Collection[str]) -> dict[str, dict[int, Clock]]:
    """Return, for `Alignment`, how the own clocks of channels run: {channel: {after how many restarts: clock}}.

    Channels without a clock of their own are not in it, nor those too short to tell. Two channels that one clock
    stamped, those of one CAN interface or those that one SYNC latches, share the better known of its two estimates:
    what was one instant stays one. Where no channel has a clock of its own, the file is read only to each one's first
    samples.

    Raises
    ------
    edge.InputError
        If the file can't be read, is no recording or has another format.
    """
    first: dict[str, Samples] = {}
    events: list[Event] = []
    with RecordingReader(path) as reader:
        devices = {c.name: _clock_device(c.time_source) for c in reader.header.channels}
        for samples, said in reader.batches():
            events.extend(said)
            if len(samples) and samples.channel in channels:
                first.setdefault(samples.channel, samples)
            if len(first) == len(channels) and all(s.time_device is None for s in first.values()):
                return {}
    found = {name: clocks for name, clocks in _clocks(events).items() if name in channels}
    names = list(found)
    for number, one in enumerate(names):
        for other in names[number + 1 :]:
            same = devices[one] is not None and devices[one] == devices[other]
            if same or _stamps(first[one]) & _stamps(first[other]):
                for restarts in found[one].keys() & found[other].keys():
                    best = min(found[one][restarts], found[other][restarts], key=lambda clock: clock.uncertainty)
                    found[one][restarts] = found[other][restarts] = best
    return found


def _clock_device(time_source: str) -> str | None:
    """Return the device whose hardware clock stamps a channel; None where it is no such clock."""
    return time_source.rpartition(" (")[2] if time_source.startswith("hardware clock") else None


def _stamps(samples: Samples) -> set[tuple[float, float]]:
    """Return the pairs of device and host time of samples: two clocks have none in common."""
    assert samples.time_device is not None
    return set(zip(samples.time_device.tolist(), samples.time_host.tolist(), strict=True))


if sys.byteorder != "little":  # Arrow buffers and the checksum are little-endian
    raise ImportError("cycloid recordings are written and read on little-endian machines only")
