"""Writing of recordings, safe from a kill at any byte."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import pyarrow as pa

from cycloid_fmu import edge
from drivers.recording_format.schema import Event, Header, Samples, batch_checksum, record_batch, recording_schema

FLUSH_SECONDS = 1.0  # of samples that a power cut may lose; a kill loses none for which `write` has returned


MESSAGE = b"\xff\xff\xff\xff"  # start of every message of an Arrow stream, at a multiple of eight bytes
END_OF_STREAM = MESSAGE + b"\x00\x00\x00\x00"


def check_new(path: str | os.PathLike[str]) -> None:
    """Raise `edge.InputError` for an existing path, including a dangling link."""
    if edge.writable(path).exists():
        raise edge.InputError(f"{path}: this file exists and recordings are not overwritten; name another.")


class _Sink(io.RawIOBase):
    """A file that has the stream's header from the start: Arrow's writer writes it only with the first batch.

    Each message is collected until `flush` and passed to the operating system in one piece.
    """

    def __init__(self, descriptor: int, schema: pa.Schema) -> None:
        self._descriptor = descriptor
        self._parts: list[bytes] = []  # before anything is written: a sink that could not be opened is flushed too
        empty = pa.BufferOutputStream()
        pa.ipc.new_stream(empty, schema).close()
        header = bytes(empty.getvalue())[: -len(END_OF_STREAM)]
        self._put(header)
        self._skip = len(header)

    def _put(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        """Collect a piece; skip the header that Arrow's writer repeats."""
        given = bytes(data)
        passed = min(self._skip, len(given))
        self._skip -= passed
        self._parts.append(given[passed:])
        return len(given)

    def flush(self) -> None:
        """Pass the collected pieces to the operating system."""
        data, self._parts = b"".join(self._parts), []
        self._put(data)


class RecordingWriter:
    """Writes a recording; every batch has reached the operating system when `write` returns.

    A kill loses at most the batch being written; a power cut at most the last `FLUSH_SECONDS`, the interval at which
    the file is synced to disk. The file must be new: recordings are never overwritten.

    Attributes
    ----------
    counts, batches
        Number of samples of each channel in the file, and of batches.

    Raises
    ------
    edge.InputError
        If the file exists or can't be created.
    OSError
        If the header can't be written; it names the file, which is removed.
    """

    def __init__(self, path: str | os.PathLike[str], header: Header) -> None:
        self._names = [c.name for c in header.channels]
        self.counts = dict.fromkeys(self._names, 0)
        self._schema = recording_schema(header)
        self.batches = 0
        self._whole = True
        try:
            self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            check_new(path)
            raise
        except OSError as problem:
            raise edge.InputError(f"{path}: {problem.strerror or problem}.") from None
        try:
            with edge.naming(path):
                self._sink = _Sink(self._descriptor, self._schema)
        except OSError:  # without a header the file is no recording
            os.close(self._descriptor)
            os.unlink(path)
            raise
        self._stream = pa.ipc.new_stream(pa.PythonFile(self._sink, "w"), self._schema)
        self._end, self._flushed = os.lseek(self._descriptor, 0, os.SEEK_CUR), time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, samples: Samples, events: Sequence[Event] = ()) -> None:
        """Append samples of one channel and the events since the last batch, as one batch; there may be no samples.

        Raises
        ------
        ValueError
            If the header has no such channel.
        OSError
            If the batch can't be written; it is removed, and earlier batches stay readable.
        """
        text = json.dumps([dataclasses.asdict(e) for e in events])
        metadata = {"sequence": str(self.batches), "events": text, "crc32": batch_checksum(self.batches, text, samples)}
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
        self.batches += 1
        self.counts[samples.channel] += len(samples)
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            os.fsync(self._descriptor)
            self._flushed = time.monotonic()

    def close(self) -> None:
        """Close the file; after a failed write without the end mark, so that it is recognised as not closed."""
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
