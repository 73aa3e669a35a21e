"""Figures of the solved drives of a study, in memory and in a file that a killed study resumes from."""

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
FORMAT = "cycloid-study-checkpoint/4"
_LONG = 60  # characters of a value that a message does not show


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


class Checkpoint:
    """Solved drives of a study, in memory and in a file.

    The file has a line of JSON with its CRC-32 for the study and one for each solved drive, which are only appended: a
    kill damages the last line at most. Lines that are damaged are not read, and their drives are solved again.

    Parameters
    ----------
    path
        The file; a missing one is created. None: in memory only.
    study
        The study.

    Attributes
    ----------
    done
        Mask of the solved drives, shape (drives,).
    values
        Their figures, shape (drives, columns), NaN where there are none.
    notes
        Notes on drives, by their numbers.

    Raises
    ------
    edge.InputError
        If the file is not a checkpoint, or that of another study.
    """

    def __init__(self, path: Path | None, study: Kept) -> None:
        self.path = path
        is_there = path is not None and edge.writable(path).exists()
        identity = study.identity()
        if path is not None and not is_there:
            with edge.written_whole(path) as temporary:
                temporary.write_bytes(_line({"format": FORMAT, "study": identity}))
        self.done: NDArray[np.bool_] = np.zeros(study.drives, dtype=bool)
        self.values: Array = np.full((study.drives, len(study.columns)), np.nan)
        self.notes: dict[int, str] = {}
        if path is not None and is_there:
            self._read(path, identity)

    def _read(self, path: Path, identity: dict[str, Any]) -> None:
        with path.open("rb") as file:
            _check_header(path, _content(file.readline()), identity)
            for record in filter(None, map(_content, file)):
                with edge.parsed_by_others(path, "this checkpoint is damaged; move it away"):
                    self._keep(range(self.done.size)[record["drive"]], record["figures"], str(record["note"]))

    def _keep(self, number: int, figures: Any, note: str) -> None:
        self.values[number] = np.asarray(figures, dtype=float).reshape(self.values.shape[1:])
        self.done[number] = True
        self.notes |= {number: note} if note else {}

    @contextlib.contextmanager
    def counted_at_interrupt(self) -> Iterator[None]:
        """Give an interrupt a text: how many drives are solved, and what keeps them."""
        try:
            yield
        except KeyboardInterrupt:
            where = "nothing is kept without an output"
            if self.path is not None:
                where = f"{self.path} keeps them; the same study continues from there"
            done, drives = np.count_nonzero(self.done), self.done.size
            raise KeyboardInterrupt(f"Interrupted: {done} of {drives} drives are done; {where}.") from None

    def add(self, numbers: NDArray[np.int64], values: Array, notes: Sequence[str] = ()) -> None:
        """Keep the figures of drives, shape (drives, columns), NaN if there are none, and a note on each, or none."""
        rows = [*zip(numbers.tolist(), values.tolist(), notes or [""] * len(numbers), strict=True)]
        if self.path is not None:
            # Each line begins where another process may have been killed within one.
            text = b"".join(b"\n" + _line({"drive": n, "figures": row, "note": note}) for n, row, note in rows)
            with edge.naming(self.path), edge.writable(self.path).open("ab") as file:
                file.write(text)
        for row in rows:
            self._keep(*row)


def _check_header(path: Path, header: dict[str, Any] | None, identity: dict[str, Any]) -> None:
    """Refuse what is not a checkpoint of this study."""
    if header is None:
        raise edge.InputError(f"{path}: this is not a checkpoint of a study; move it away.")
    edge.check_format(header.get("format"), FORMAT, str(path))
    with edge.parsed_by_others(path, "this checkpoint is damaged; move it away"):
        stated = dict(header["study"])
    for name in {**identity, **stated}:
        mine, theirs = identity.get(name), stated.get(name)
        if theirs != mine:
            what = name if name.isidentifier() else "definition"
            texts = [str(value) for value in (theirs, mine)]
            is_short = all(len(text) < _LONG and text.isprintable() for text in texts)
            values = ": {} there, {} here".format(*texts) if is_short else ""
            raise edge.InputError(
                f"{path}: this checkpoint belongs to another study, its {what} differs{values}; finish that "
                "study, or remove the file to start again."
            )


def _line(record: dict[str, Any]) -> bytes:
    text = json.dumps(record)
    return f"{zlib.crc32(text.encode()):08x} {text}".encode()


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
