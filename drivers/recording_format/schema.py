"""The bench recording, `cycloid-recording/1`: an Arrow IPC stream that survives a kill at any byte.

This module needs no bus library: recorders write this format and evaluations read it.

A file is a schema, record batches and an end mark. Every batch holds samples of one channel in the order of their
arrival: of 50 ms while it is recorded, in a closed file of several thousand samples (`joining`). The columns are
`channel` (dictionary of the channels' names), `time_host`, `time_device`, `counts`, `value` and `status`.
The schema's metadata, UTF-8 text, are `format`, `channels` (a JSON list of objects, the fields of `Channel`),
`conditions` (a JSON object, SI numbers and text), `ratio` (JSON number or null), `pair`, `start` (ISO 8601, UTC) and
`header_crc32`, the CRC-32 of the preceding keys, each followed by its text, in this order; early recordings lack it.
Each batch's custom metadata are `sequence` (decimal, from 0), `events` (a JSON list of {time, channel, text}) and
`crc32` (eight hexadecimal digits).

The CRC-32 is that of zlib and PNG, over these bytes in this order: `sequence` and `events` as stored, the channel's
name in UTF-8, then the columns `time_host`, `time_device`, `counts`, `value`, `status` as little-endian arrays without
padding; a column that is null contributes nothing.
"""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

FORMAT = "cycloid-recording/1"
GAP, CHECKSUM, RESET, DUPLICATE, OUT_OF_ORDER, ROLLOVER = 1, 2, 4, 8, 16, 32
IMPLAUSIBLE = 128
MARKS = {
    "gaps": GAP,
    "checksum": CHECKSUM,
    "resets": RESET,
    "duplicates": DUPLICATE,
    "out of order": OUT_OF_ORDER,
    "rollovers": ROLLOVER,
    "implausible": IMPLAUSIBLE,
}
ANGLES = ("input_angle", "output_angle")
ROLES = (*ANGLES, "torque", "other")

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
ByteArray: TypeAlias = npt.NDArray[np.uint8]


HEADER_CRC = "header_crc32"


@dataclasses.dataclass(frozen=True)
class Channel:
    """One measured quantity and its source.

    Attributes
    ----------
    name
        Unique in the recording: "input_angle", "output_angle", "torque" or another.
    role
        Its role in evaluation: the name if it is one of these three, otherwise "other".
    protocol
        Name of the protocol that delivered it.
    unit
        SI unit of the values: "rad", "N*m" or another.
    counts_per_turn
        Counts in one turn; None if the channel has no counts.
    direction
        +1 if the counts increase with the counter-clockwise angle, -1 if they decrease.
    zero
        Value of the sensor, with its direction, at the zero of the shaft, in `unit`; already subtracted.
    zero_reference
        "absolute": the zero is the same in every recording; "incremental": each recording has its own.
    identity
        Identity reported by the device, and after a semicolon its state when it was opened.
    time_source
        The clock of `time_host` and the event that it stamps; the device of a hardware clock is in brackets at the end.
    largest_speed
        Largest speed of an angle, rad/s, if stated; faster steps are implausible.
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
    largest_speed: float | None = None


@dataclasses.dataclass(frozen=True)
class Event:
    """An event of a channel: `time` in seconds on the host's clock, like the samples' `time_host`."""

    time: float
    channel: str
    text: str


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples of one channel, arrays of shape (n,).

    Attributes
    ----------
    channel
        The channel's name.
    time_host
        Time on the host's clock, s: in a recording since its `start`, from an encoder since 1970.
    time_device
        Time on the device's own clock, s; None if it has none.
    counts
        Unwrapped counts from the device; None if it sends none.
    value
        SI value: angles in rad, unwrapped; torques in N*m.
    status
        Bits: 1 gap before, 2 checksum error (here or before), 4 reset, 8 duplicate (this sample, or one left out before
        it), 16 out of order, 32 rollover; in early recordings 128 implausible.
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
        """Return samples of these arrays, converted to the column types; without `status` no sample is marked.

        Parameters
        ----------
        channel, time_host, value, time_device, counts, status
            As in `Samples`.

        Raises
        ------
        ValueError
            If an array is not one-dimensional or not of the same length as the others.
        """
        host = np.asarray(time_host, np.float64)
        samples = cls(
            channel,
            host,
            None if time_device is None else np.asarray(time_device, np.float64),
            None if counts is None else np.asarray(counts, np.int64),
            np.asarray(value, np.float64),
            np.zeros(host.shape, np.uint8) if status is None else np.asarray(status, np.uint8),
        )
        shapes = {name: a.shape for name in COLUMNS if (a := getattr(samples, name)) is not None}
        if len(host.shape) != 1 or len(set(shapes.values())) != 1:
            raise ValueError(f"the samples of {channel} must be one-dimensional and of equal length, not {shapes}")
        return samples

    def __len__(self) -> int:
        return len(self.time_host)


@dataclasses.dataclass(frozen=True)
class Header:
    """The header of a recording: channels, conditions (SI), signed ratio input/output, pair's name, start in UTC."""

    channels: tuple[Channel, ...]
    conditions: Mapping[str, float | str]
    ratio: float | None
    pair: str
    start: str


COLUMNS: Mapping[str, tuple[pa.DataType, str, bool]] = {
    "time_host": (pa.float64(), "<f8", False),
    "time_device": (pa.float64(), "<f8", True),
    "counts": (pa.int64(), "<i8", True),
    "value": (pa.float64(), "<f8", False),
    "status": (pa.uint8(), "u1", False),
}
_BYTES_OF = tuple((name, np.dtype(kind)) for name, (_, kind, _) in COLUMNS.items())
COLUMN_DTYPES: Mapping[str, str] = {name: kind for name, (_, kind, _) in COLUMNS.items()}


def batch_checksum(sequence: int, events: str, samples: Samples) -> str:
    """Return the CRC-32 of a batch as eight hexadecimal digits; the module's docstring defines the bytes."""
    crc = zlib.crc32(f"{sequence}{events}{samples.channel}".encode())
    for name, kind in _BYTES_OF:
        if (array := getattr(samples, name)) is not None:
            crc = zlib.crc32(np.ascontiguousarray(array, kind).data, crc)
    return f"{crc:08x}"


def recording_metadata(header: Header) -> dict[str, str]:
    """Return the header of a recording as texts; see the module's docstring."""
    channels = [dataclasses.asdict(c) for c in header.channels]
    for channel in channels:  # omitted if not stated, so that earlier versions can read the recording
        if channel["largest_speed"] is None:
            del channel["largest_speed"]
    return {
        "format": FORMAT,
        "channels": json.dumps(channels),
        "conditions": json.dumps(dict(header.conditions)),
        "ratio": json.dumps(header.ratio),
        "pair": header.pair,
        "start": header.start,
    }


def header_checksum(texts: Mapping[str, str]) -> str:
    """Return the CRC-32 of the header's texts as eight hexadecimal digits; the module's docstring defines the bytes."""
    text = "".join(f"{key}{texts[key]}" for key in ("format", "channels", "conditions", "ratio", "pair", "start"))
    return f"{zlib.crc32(text.encode()):08x}"


def recording_schema(header: Header) -> pa.Schema:
    """Return the Arrow schema of a recording: columns and metadata."""
    fields = [pa.field("channel", pa.dictionary(pa.int16(), pa.string()), nullable=False)]
    fields += [pa.field(name, kind, nullable=nullable) for name, (kind, _, nullable) in COLUMNS.items()]
    texts = recording_metadata(header)
    return pa.schema(fields, metadata={**texts, HEADER_CRC: header_checksum(texts)})


def record_batch(samples: Samples, schema: pa.Schema, names: Sequence[str]) -> pa.RecordBatch:
    """Return samples as a batch of a recording's table; ValueError if its channel is none of `names`."""
    index = np.full(len(samples), list(names).index(samples.channel), np.int16)
    columns = [channel_column(index, names)]
    for name, dtype in _BYTES_OF:
        array, kind = getattr(samples, name), COLUMNS[name][0]
        columns.append(
            pa.nulls(len(samples), kind) if array is None else _column(np.ascontiguousarray(array, dtype), kind)
        )
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def channel_column(index: npt.NDArray[np.int16], names: Sequence[str]) -> pa.DictionaryArray:
    """Return the column of channels, whose dictionary is all the names."""
    texts = [name.encode() for name in names]
    ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
    dictionary = pa.StringArray.from_buffers(len(texts), pa.py_buffer(ends), pa.py_buffer(b"".join(texts)))
    return pa.DictionaryArray.from_arrays(_column(index, pa.int16()), dictionary)


def _column(array: npt.NDArray[Any], kind: pa.DataType) -> pa.Array:
    """Return a contiguous array of the same type as a column without nulls; they share their memory.

    pa.array would import pandas, which holds up the first batch of a recording, on a slow machine for seconds.
    """
    return pa.Array.from_buffers(kind, len(array), [None, pa.py_buffer(array)])


def joined(name: str, blocks: Sequence[Samples], *, fill: bool = False) -> Samples:
    """Return a channel's blocks as one; a column that a block lacks is None or, with `fill`, NaN or 0 in that block."""
    if len(blocks) == 1 and not fill:
        return blocks[0]
    columns: dict[str, npt.NDArray[Any] | None] = {}
    for column, (_, kind, optional) in COLUMNS.items():
        parts = [getattr(block, column) for block in blocks]
        lacking = sum(part is None for part in parts)
        if optional and (lacking == len(parts) or (lacking and not fill)):
            columns[column] = None
            continue
        blank = np.nan if kind == "<f8" else 0
        filled = [np.full(len(b), blank, kind) if p is None else p for b, p in zip(blocks, parts, strict=True)]
        columns[column] = np.concatenate([np.zeros(0, kind), *filled])
    return Samples(name, **columns)  # type: ignore[arg-type]
