"""Figures of the solved drives of a study: in memory, or on disk until the study is written."""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]
FORMAT = "cycloid-study-checkpoint/2"
_NUMBER = np.dtype("<f8")
_BLOCK = 1 << 16  # drives that are checked at a time
_THERE = 1 << 32  # beside the CRC-32 of a drive, so that no drive's check word is 0


def checkpoint_of(output: str | os.PathLike[str]) -> Path:
    """Return the file that keeps the solved drives of a study until its output is written."""
    return Path(f"{os.fspath(output)}.checkpoint")


@contextlib.contextmanager
def reserved(output: str | os.PathLike[str] | None) -> Iterator[None]:
    """Keep other processes from computing the same output meanwhile, and remove its checkpoint on success.

    Raises
    ------
    edge.InputError
        If another process computes it.
    """
    if output is None:
        yield
        return
    lock = FileLock(edge.writable(f"{os.fspath(output)}.lock"), timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise edge.InputError(
            f"{output}: another process computes this output; wait until it has ended, or give another name."
        ) from None
    except (OSError, NotImplementedError):  # a file system without locks
        pass
    try:
        yield
        checkpoint_of(output).unlink(missing_ok=True)
    finally:
        if os.name == "nt":  # where an open file, also of the next process, can't be removed
            lock.release()
        with contextlib.suppress(OSError):
            Path(lock.lock_file).unlink()
        lock.release()


class Kept(Protocol):
    """A study whose drives are solved one by one."""

    @property
    def drives(self) -> int:
        """Number of drives."""

    @property
    def columns(self) -> Sequence[Any]:
        """The figures of a drive."""

    def identity(self) -> dict[str, Any]:
        """Return its identity."""


class InMemory:
    """Solved drives of a study, in memory.

    Attributes
    ----------
    done
        Mask of the solved drives, shape (drives,).
    values
        Their figures, shape (drives, columns).
    notes
        Notes on drives, by their numbers.
    """

    def __init__(self, study: Kept) -> None:
        self.done = np.zeros(study.drives, dtype=bool)
        self.values: Array = np.full((study.drives, len(study.columns)), np.nan)
        self.notes: dict[int, str] = {}

    def add(self, first: int, values: Array, notes: Sequence[str] = ()) -> None:
        """Keep the figures of the drives from `first` on, NaN if there are none, and the notes on them."""
        self.values[first : first + len(values)] = values
        self.notes |= {first + k: note for k, note in enumerate(notes) if note}
        self.done[first : first + len(values)] = True


class Checkpoint:
    """Solved drives of a study, on disk; only the mask of the solved drives and the notes are in memory.

    The file begins with a line of JSON with its CRC-32. A check word of each drive follows, then the first figure of
    each drive, the second one and so on, as little-endian numbers of 8 bytes; then the notes, one line each in the form
    of the first line. A drive with a wrong check word was being written at a kill, and is solved again.

    Raises
    ------
    edge.InputError
        If the file is not a checkpoint, or that of another study.
    """

    def __init__(self, path: Path, study: Kept) -> None:
        self.path = path
        self.notes: dict[int, str] = {}
        identity = study.identity()
        there = edge.writable(path).exists()
        self._shape = (1 + len(study.columns), study.drives)
        if there:
            self._start = self._read_header(identity)
        else:
            header = _line({"format": FORMAT, "study": identity, "shape": self._shape})
            self._start = len(header)
            with edge.written_whole(path) as temporary, temporary.open("wb") as file:
                file.write(header)
                file.truncate(self._start + 8 * self._shape[0] * self._shape[1])
        self.done: NDArray[np.bool_] = np.zeros(self._shape[1], dtype=bool)
        if there:
            self._read()

    def _read_header(self, identity: dict[str, Any]) -> int:
        with self.path.open("rb") as file:
            line = file.readline()
        header = _content(line)
        if header is None:
            raise edge.InputError(f"{self.path}: this is not a checkpoint of a study; move it away.")
        edge.check_format(header.get("format"), FORMAT, str(self.path))
        with edge.parsed_by_others(self.path, "this checkpoint is damaged; move it away"):
            stated = dict(header["study"])
        for name in {**identity, **stated}:
            mine, theirs = identity.get(name), stated.get(name)
            if theirs != mine:
                long = isinstance(mine or theirs, str | dict) and name != "design"
                values = "" if long else f": {theirs} there, {mine} here"
                raise edge.InputError(
                    f"{self.path}: this checkpoint belongs to another study, its {name} differs{values}; finish that "
                    "study, or remove the file to start again."
                )
        if header.get("shape") != [*self._shape]:
            raise edge.InputError(f"{self.path}: this checkpoint is damaged; move it away.")
        return len(line)

    def _read(self) -> None:
        end = self._start + 8 * self._shape[0] * self._shape[1]
        with self.path.open("r+b") as file:
            if self.path.stat().st_size < end:
                file.truncate(end)
            file.seek(end)
            records = [record for record in map(_content, file) if record is not None]
        with edge.parsed_by_others(self.path, "this checkpoint is damaged; move it away"):
            self.notes = {int(one["drive"]): str(one["note"]) for one in records}
        check, values = self._mapped(), self.values
        for first in range(0, self._shape[1], _BLOCK):
            block = slice(first, first + _BLOCK)
            self.done[block] = check[0, block].view("<u8") == _check_words(first, values[block])

    def _mapped(self) -> Array:
        return np.memmap(self.path, _NUMBER, "r", self._start, self._shape)

    @property
    def values(self) -> Array:
        """Their figures, shape (drives, columns), a view of the file."""
        return self._mapped()[1:].T

    def add(self, first: int, values: Array, notes: Sequence[str] = ()) -> None:
        """Keep the figures of the drives from `first` on, NaN if there are none, and the notes on them."""
        said = {first + k: note for k, note in enumerate(notes) if note}
        self.notes |= said
        with edge.naming(self.path), edge.writable(self.path).open("r+b", buffering=0) as file:
            if said:
                file.seek(0, 2)
                # A newline first: a line that a kill cut short must not spoil these.
                _write(file, b"\n" + b"".join(_line({"drive": n, "note": note}) for n, note in said.items()))
            for row, column in enumerate((*values.T, _check_words(first, values)), 1):
                file.seek(self._start + 8 * (row % self._shape[0] * self._shape[1] + first))
                _write(file, column.astype(column.dtype.newbyteorder("<")).tobytes())
        self.done[first : first + len(values)] = True


def _write(file: Any, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


def _check_words(first: int, values: Array) -> NDArray[np.uint64]:
    """Return the CRC-32 of each drive's figures, started with its number, with a bit that marks them as present."""
    rows = np.ascontiguousarray(values, dtype=_NUMBER)
    return np.array([zlib.crc32(row, first + k) | _THERE for k, row in enumerate(rows)], dtype=np.uint64)


def _line(record: dict[str, Any]) -> bytes:
    text = json.dumps(record, allow_nan=False)
    return f"{zlib.crc32(text.encode()):08x} {text}\n".encode()


def _content(line: bytes) -> dict[str, Any] | None:
    """Return the record that `_line` wrote, None if the line is damaged."""
    check, _, text = line.rstrip(b"\n").partition(b" ")
    if check != f"{zlib.crc32(text):08x}".encode():
        return None
    try:
        record = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None
