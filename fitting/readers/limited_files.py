"""Bench files that other people's parsers read, in a process with limits."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from cycloid_fmu import edge
from fitting.readers.can_logs import CanLog, read_dbc
from fitting.readers.formats import BenchFile, Piece, pieces_of
from fitting.readers.loggers import MdfFile, TdmsFile


class LimitedFile(BenchFile):
    """A bench file of a kind, which a package reads in the process with limits; see `edge.each_limited`."""

    def __init__(
        self, kind: type[BenchFile], package: str, source: str, dbc: str | os.PathLike[str] | None = None
    ) -> None:
        self._file, self._package = (kind, source, dbc), package
        if dbc is not None:  # alone, so that a message names it
            edge.call_limited(edge.existing(dbc), check_dbc, dbc, needs="cantools")
        super().__init__(source, **edge.call_limited(source, attributes_of, *self._file, needs=package))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        for content in edge.each_limited(self.source, contents_of, *self._file, list(names), needs=self._package):
            if isinstance(content, Piece):
                yield content
            else:
                self.problems = content


mdf_file = partial(LimitedFile, MdfFile, "asammdf")
tdms_file = partial(LimitedFile, TdmsFile, "nptdms")
can_log = partial(LimitedFile, CanLog, "cantools")


def check_dbc(path: str | os.PathLike[str]) -> None:
    """Raise an `edge.InputError` if a DBC file can't be read."""
    read_dbc(path)


def attributes_of(kind: Any, source: str, dbc: str | os.PathLike[str] | None) -> dict[str, Any]:
    """Return the attributes of a bench file as it is opened, without its source."""
    file = kind(source, dbc)
    return {f.name: getattr(file, f.name) for f in dataclasses.fields(BenchFile) if f.name != "source"}


def contents_of(
    kind: Any, source: str, dbc: str | os.PathLike[str] | None, names: Sequence[str]
) -> Iterator[Piece | list[str]]:
    """Yield the pieces of a bench file, and its problems as soon as there are more."""
    file, known = kind(source, dbc), 0
    for piece in pieces_of(file, names):
        if len(file.problems) > known:
            known = len(file.problems)
            yield list(file.problems)
        yield piece
    yield file.problems
