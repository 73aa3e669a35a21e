"""Solved drives of a study, kept on disk until the study is written."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]
FORMAT = "cycloid-study-checkpoint/1"


class Identified(Protocol):
    """A study."""

    def identity(self) -> dict[str, Any]:
        """Return its identity."""


class Checkpoint:
    """Solved drives on disk: a header and a line for each task, each with its CRC-32.

    A line cut short by a kill is ignored, and its drives are solved again. `done` has the figures of each task by its
    first drive, `notes` the notes on its drives.

    Raises
    ------
    edge.InputError
        If the file is not a checkpoint, or that of another study.
    """

    def __init__(self, path: Path, study: Identified) -> None:
        self.path = path
        self.done: dict[int, Array] = {}
        self.notes: dict[int, list[str]] = {}
        identity = study.identity()
        if edge.writable(path).exists():
            self._read(identity)
        else:
            with edge.written_whole(path) as temporary:
                temporary.write_text(_line({"format": FORMAT, "study": identity}), encoding="utf-8")

    def _read(self, identity: dict[str, Any]) -> None:
        lines = edge.read_text(self.path).splitlines()
        header = _content(lines[0]) if lines else None
        if header is None:
            raise edge.InputError(f"{self.path}: this is not a checkpoint of a study; move it away.")
        edge.check_format(header.get("format"), FORMAT, str(self.path))
        with edge.parsed_by_others(self.path, "this checkpoint is damaged; move it away"):
            stated = dict(header["study"])
            records = [record for record in map(_content, lines[1:]) if record is not None]
            self.done = {int(one["first"]): np.array(one["values"], dtype=float) for one in records}
            self.notes = {int(one["first"]): list(map(str, one["notes"])) for one in records if "notes" in one}
        for name in {**identity, **stated}:
            mine, theirs = identity.get(name), stated.get(name)
            if theirs != mine:
                long = isinstance(mine or theirs, str | dict) and name != "design"
                values = "" if long else f": {theirs} there, {mine} here"
                raise edge.InputError(
                    f"{self.path}: this checkpoint belongs to another study, its {name} differs{values}; finish that "
                    "study, or remove the file to start again."
                )

    def add(self, first: int, values: Array, notes: Sequence[str] = ()) -> None:
        """Store the figures of the drives from `first` on, NaN where there are none, and the notes on them."""
        numbers = [[None if math.isnan(number) else number for number in row] for row in values.tolist()]
        record = {"first": first, "values": numbers, **({"notes": list(notes)} if notes else {})}
        # A newline first: a line that a kill cut short must not spoil this one.
        with edge.naming(self.path), edge.writable(self.path).open("a", encoding="utf-8") as file:
            file.write("\n" + _line(record))


def _line(record: dict[str, Any]) -> str:
    text = json.dumps(record, allow_nan=False)
    return f"{zlib.crc32(text.encode()):08x} {text}\n"


def _content(line: str) -> dict[str, Any] | None:
    """Return the content that `_line` wrote, None if the line is incomplete."""
    check, _, text = line.partition(" ")
    if check != f"{zlib.crc32(text.encode()):08x}":
        return None
    try:
        record = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None
