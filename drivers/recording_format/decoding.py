"""A batch of a recording, decoded and checked against its checksum."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import pyarrow as pa

from drivers.recording_format.schema import COLUMNS, Event, Samples, batch_checksum

# A batch and its own metadata: sequence number, events and CRC-32.
Batch: TypeAlias = tuple[pa.RecordBatch, Mapping[bytes, bytes] | None]


class DamagedBatchError(Exception):
    """The batch is damaged; the text states the reason."""


def decoded(batch: Batch, names: Sequence[str]) -> tuple[int, Samples, tuple[Event, ...]]:
    """Return sequence number, samples and events of a batch.

    Parameters
    ----------
    batch
        The batch with its metadata.
    names
        Names of the recording's channels.

    Raises
    ------
    DamagedBatchError
        If it is damaged.
    """
    table, metadata = batch
    try:
        table.validate()
        return _checked(table, metadata or {}, names)
    except (pa.ArrowException, ValueError, TypeError, RecursionError) as problem:
        raise DamagedBatchError(str(problem)) from problem
    except KeyError as problem:
        raise DamagedBatchError("it has no sequence number, events or CRC-32") from problem


def _checked(
    table: pa.RecordBatch, metadata: Mapping[bytes, bytes], names: Sequence[str]
) -> tuple[int, Samples, tuple[Event, ...]]:
    sequence, text, crc = int(metadata[b"sequence"]), metadata[b"events"].decode(), metadata[b"crc32"]
    events = () if text == "[]" else tuple(Event(**event) for event in json.loads(text))
    # By the channel's number in the header: a damaged dictionary has wrong names.
    numbers = table.column(0).indices
    rows = np.asarray(numbers.fill_null(-1) if numbers.null_count else numbers)
    if rows.size and (rows != rows[0]).any():
        raise ValueError("it mixes channels")
    if rows.size and not 0 <= rows[0] < len(names):
        raise ValueError("its channel is not in the header")
    columns = {
        name: None if column.null_count else np.asarray(column, dtype)
        for (name, (_, dtype, _)), column in zip(COLUMNS.items(), table.columns[1:], strict=True)
    }
    # An empty batch has no row that names its channel: the CRC-32 identifies it.
    for name in [names[rows[0]]] if rows.size else names:
        samples = Samples(name, **columns)  # type: ignore[arg-type]
        if batch_checksum(sequence, text, samples).encode() == crc:
            return sequence, samples, events
    raise ValueError("its CRC-32 is wrong")
