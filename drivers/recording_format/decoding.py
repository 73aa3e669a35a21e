"""The batches of a recording, decoded by columns and checked against their checksums."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from drivers.recording_format.schema import (
    COLUMN_DTYPES,
    COLUMNS,
    Event,
    Samples,
    batch_checksum,
    bytes_checksum,
)

# A batch and its own metadata: sequence number, events and CRC-32.
Batch: TypeAlias = tuple[pa.RecordBatch, Mapping[bytes, bytes] | None]


@dataclasses.dataclass(frozen=True)
class _Columns:
    """Batches as one table: columns, channel number of each row, and the rows at which batches begin and end.

    For each batch also the columns that it lacks, and whether it mixes channels.
    """

    arrays: dict[str, npt.NDArray[Any]]
    rows: npt.NDArray[np.int16]
    ends: npt.NDArray[np.int64]
    absent: dict[str, npt.NDArray[np.bool_]]
    mixed: npt.NDArray[np.bool_]


def _columns(sound: Sequence[pa.RecordBatch]) -> _Columns:
    ends = np.cumsum([0, *(batch.num_rows for batch in sound)])
    table = pa.Table.from_batches(sound)
    arrays: dict[str, npt.NDArray[Any]] = {}
    absent: dict[str, npt.NDArray[np.bool_]] = {}
    for name, (_, dtype, _) in COLUMNS.items():
        column = table.column(name)
        missing = np.asarray(column.is_null()) if column.null_count else np.zeros(len(column), bool)
        nulls = np.concatenate([[0], np.cumsum(missing)])
        absent[name] = np.diff(nulls[ends]) > 0
        arrays[name] = np.asarray(column.fill_null(0) if column.null_count else column, dtype)
    # By the channel's number in the header: a damaged dictionary has wrong names.
    numbers = pa.chunked_array([batch.column(0).indices for batch in sound], pa.int16())
    rows = np.asarray(numbers.fill_null(-1) if numbers.null_count else numbers)
    changes = np.flatnonzero(np.diff(rows)) + 1
    mixed = np.searchsorted(changes, ends[1:]) > np.searchsorted(changes, ends[:-1], "right")
    return _Columns(arrays, rows, ends, absent, mixed)


_Part: TypeAlias = tuple[int, int]  # begin and end of bytes, from the begin of a batch


@dataclasses.dataclass(frozen=True)
class _Layout:
    """The bytes of a batch: where its texts are, content that it must have, and columns that are not null.

    `checked` are the columns with neighbours joined.
    """

    channel: str
    size: int
    crc32: _Part
    sequence: _Part
    fixed: Sequence[tuple[int, bytes]]
    columns: Mapping[str, _Part]
    checked: Sequence[_Part]


class Layouts:
    """Batches that equal an earlier one in all but samples, sequence number and CRC-32.

    A recorder writes few kinds of batches: those of a channel with equally many samples have their columns in the same
    places. Arrow reads the first of each kind; the others are compared with it, which for batches of 50 ms takes a
    fifth of the time.

    Parameters
    ----------
    names
        Names of the channels, in the order of the header.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._heads: dict[bytes, _Part] = {}  # places of CRC-32 and channel number in a head with these first bytes
        self._layouts: dict[tuple[bytes, bytes], _Layout] = {}

    def learn(self, data: bytes, begin: int, end: int, batch: Batch) -> None:
        """Add the layout of a batch that Arrow has read from these bytes of `data`.

        Not added are batches with events, without samples, of several channels, or with a column that is null in part.
        """
        table, stated = batch[0], batch[1] or {}
        indices, rows = table.column(0).indices, table.num_rows
        whole = data[begin:end]
        body = 8 + int.from_bytes(whole[4:8], "little")
        crc32, sequence = (_place(whole[:body], stated.get(key, b"")) for key in (b"crc32", b"sequence"))
        if not rows or indices.null_count or stated.get(b"events") != b"[]" or not 0 < crc32[0] < sequence[0]:
            return
        try:
            table.validate()
        except pa.ArrowException:
            return
        origin = pa.py_buffer(data).address + begin

        def part(buffer: pa.Buffer, size: int) -> _Part:
            return buffer.address - origin, buffer.address - origin + size

        number = indices[0].as_py()
        equal = [(part(indices.buffers()[1], 2 * rows), number.to_bytes(2, "little", signed=True) * rows)]
        columns: dict[str, _Part] = {}
        for name, dtype in COLUMN_DTYPES.items():
            nulls, values = table.column(name).buffers()
            if table.column(name).null_count:
                equal.append((part(nulls, (rows + 7) // 8), bytes((rows + 7) // 8)))
            else:
                columns[name] = part(values, rows * np.dtype(dtype).itemsize)
        spans = [*(span for span, _ in equal), *columns.values()]
        inside = equal[0][0][0] == body and all(body <= first <= last <= len(whole) for first, last in spans)
        alike = all(whole[first:last] == content for (first, last), content in equal)
        if not (inside and alike and 0 <= number < len(self._names)):
            return
        head = (0, crc32[0]), (crc32[1], sequence[0]), (sequence[1], body)
        checked: list[_Part] = []
        for first, last in columns.values():
            joins = checked and checked[-1][1] == first
            checked.append((checked.pop()[0] if joins else first, last))
        self._heads[whole[:8]] = crc32[0], body
        self._layouts[whole[8 : crc32[0]], whole[body : body + 2]] = _Layout(
            self._names[number],
            len(whole),
            crc32,
            sequence,
            [(first, whole[first:last]) for first, last in (*head, *(span for span, _ in equal))],
            columns,
            checked,
        )

    def known(self, data: bytes, at: int) -> _Layout | None:
        """Return the layout of the batch that begins here; None if it is not known or not all of the batch is here."""
        if (places := self._heads.get(data[at : at + 8])) is None:
            return None
        crc32, body = places
        layout = self._layouts.get((data[at + 8 : at + crc32], data[at + body : at + body + 2]))
        if layout is None or at + layout.size > len(data):
            return None
        for place, content in layout.fixed:
            if not data.startswith(content, at + place):
                return None
        return layout

    def joined(self, data: bytes, sequence: int) -> tuple[list[Samples], int, int]:
        """Return the joined samples of the first batches, by channel, the number of these batches and their end.

        They end before the first batch that is damaged or whose layout is not known.

        Parameters
        ----------
        data
            Bytes of the recording from the begin of a batch.
        sequence
            Sequence number that the first batch must have.
        """
        view = memoryview(data)
        found: dict[str, list[tuple[int, _Layout]]] = {}
        at, number = 0, sequence
        while (layout := self.known(data, at)) is not None:
            checked = (view[at + begin : at + end] for begin, end in layout.checked)
            crc32 = bytes_checksum(number, "[]", layout.channel, checked).encode()
            intact = data[at + layout.crc32[0] : at + layout.crc32[1]] == crc32
            next_one = data[at + layout.sequence[0] : at + layout.sequence[1]] == b"%d" % number
            batches = found.get(layout.channel, [])
            alike = not batches or batches[0][1].columns.keys() == layout.columns.keys()
            if not (intact and next_one and alike):
                break
            found.setdefault(layout.channel, batches).append((at, layout))
            at, number = at + layout.size, number + 1
        samples = []
        for channel, batches in found.items():
            columns: dict[str, Any] = dict.fromkeys(COLUMN_DTYPES)
            for name in batches[0][1].columns:
                spans = [(at, *layout.columns[name]) for at, layout in batches]
                parts = [view[at + begin : at + end] for at, begin, end in spans]
                columns[name] = np.frombuffer(bytearray().join(parts), COLUMN_DTYPES[name])
            samples.append(Samples(channel, **columns))
        return samples, number - sequence, at


def _place(head: bytes, text: bytes) -> _Part:
    """Return where the head of a batch has this text, after its length; (0, 0) if it is not in exactly one place."""
    stored = len(text).to_bytes(4, "little") + text + b"\0"
    if head.count(stored) != 1:
        return 0, 0
    begin = head.index(stored) + 4
    return begin, begin + len(text)


def decoded(
    batches: Sequence[Batch], names: Sequence[str]
) -> Iterator[tuple[int, Samples, tuple[Event, ...]] | Exception]:
    """Yield sequence number, samples and events of each batch, or the reason why it is damaged.

    The columns of all batches are converted together: batches last 50 ms, and to convert each one's columns separately
    takes 1.7 times the processor time of reading a whole recording.
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
    found = _columns(sound)
    arrays, rows, ends = found.arrays, found.rows, found.ends
    gaps = [absent.tolist() for absent in found.absent.values()]
    spans = zip(found.mixed.tolist(), *gaps, ends[:-1].tolist(), ends[1:].tolist(), strict=True)
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
        except (ValueError, TypeError, KeyError, RecursionError) as problem:
            yield problem


def _checked(
    metadata: Mapping[bytes, bytes], columns: Mapping[str, Any], number: int | None, names: Sequence[str]
) -> tuple[int, Samples, tuple[Event, ...]]:
    """Return sequence number, samples and events of a batch of channel `number`; ValueError if it is damaged."""
    try:
        number_said, said, crc = (metadata[key] for key in (b"sequence", b"events", b"crc32"))
    except KeyError:
        raise ValueError("it has no sequence number, events or CRC-32") from None
    sequence, text = int(number_said), said.decode()
    events = () if text == "[]" else tuple(Event(**e) for e in json.loads(text))
    if number is not None and not 0 <= number < len(names):
        raise ValueError("its channel is not in the header")
    # An empty batch has no row that names its channel: the CRC-32 identifies it.
    for name in [names[number]] if number is not None else names:
        samples = Samples(name, **columns)
        if batch_checksum(sequence, text, samples).encode() == crc:
            return sequence, samples, events
    raise ValueError("its CRC-32 is wrong")
