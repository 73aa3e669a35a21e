"""Contents of test bench files, piece by piece, under the channel names of the file and without their meaning.

Every reader yields pieces of bounded size, so that files may be larger than memory.
"""

from __future__ import annotations

import abc
import contextlib
import gzip
import heapq
import importlib
import os
import re
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.edge.quantities import USUAL
from drivers.recording_format import Clock, Limits
from fitting.samples.block import PIECE as PIECE
from fitting.samples.block import Piece as Piece

Array = NDArray[np.float64]

LONGEST_NAME = 200  # characters kept of a channel's name; searching longer ones takes too long
_BLOCK = 1 << 20  # bytes unpacked at a time


@dataclass(frozen=True)
class RawChannel:
    """A channel of a file.

    Attributes
    ----------
    name
        Name of the channel, unique in the file.
    unit
        Unit as written in the file, "" if there is none.
    zero_reference
        "absolute" if the file states that the zero is the same in every recording, otherwise "incremental".
    """

    name: str
    unit: str = ""
    zero_reference: str = "incremental"


@dataclass
class BenchFile(abc.ABC):
    """An open bench file.

    Attributes
    ----------
    source
        The file's name.
    channels
        The file's channels.
    timed
        Whether the channels have their own times; otherwise one of them is the time, or there is none.
    ratio
        Signed ratio input/output of the drive, if the file states it.
    pair
        Name or fingerprint of the gear pair, if the file states it.
    problems
        One sentence for each problem of the file; complete when all pieces have been read.
    clocks
        {channel: clock of its time stamps against the host's} for channels with a device clock.
    limits
        Limits of the encoders, as far as the file states them.
    texts
        Names of columns that hold text; they can have no role.
    """

    source: str
    channels: tuple[RawChannel, ...] = ()
    timed: bool = False
    ratio: float | None = None
    pair: str = ""
    problems: list[str] = field(default_factory=list)
    clocks: dict[str, Clock] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    texts: tuple[str, ...] = ()

    @abc.abstractmethod
    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""


# Class or function that opens files with each ending; other packages add theirs as entry points of the group.
READERS = {
    "arrows": "fitting.readers.recorder_files:RecorderFile",
    **dict.fromkeys(("csv", "txt", "tsv", "dat"), "fitting.readers.scope:open_table"),
    "parquet": "fitting.readers.tables:ParquetFile",
    **dict.fromkeys(("mf4", "mdf"), "fitting.readers.limited_files:mdf_file"),
    "tdms": "fitting.readers.limited_files:tdms_file",
    **dict.fromkeys(("blf", "asc", "trc"), "fitting.readers.limited_files:can_log"),
}
GROUP = "cycloid.recordings"


COMPRESSED = ".gz"


def stem_of(path: str | os.PathLike[str]) -> str:
    """Return the name of a file without its ending, that of compression included."""
    name = Path(path)
    return name.with_suffix("").stem if name.suffix.lower() == COMPRESSED else name.stem


def open_bench_file(path: str | os.PathLike[str], dbc: str | os.PathLike[str] | None = None) -> BenchFile:
    """Open a bench file with the reader for its ending, one of `READERS` or of the entry points in `GROUP`.

    Parameters
    ----------
    path
        The file; `.gz` after the ending if it is compressed.
    dbc
        The DBC file that describes the frames of a CAN log.

    Raises
    ------
    edge.InputError
        If the file can't be read or parsed, or a package that reads it is missing.
    """
    edge.existing(path)
    if Path(path).suffix.lower() == COMPRESSED:
        return UnpackedFile(str(path), dbc)
    return _opened(path, path, dbc)


def _reader(path: str | os.PathLike[str], source: object) -> tuple[str, str]:
    """Return a file's ending and the reader for it, `module:name`; `source`: the file's name in messages."""
    ending = Path(path).suffix.lower().removeprefix(".")
    reader = READERS.get(ending) or next((e.value for e in metadata.entry_points(group=GROUP, name=ending)), None)
    if reader is None:
        if (refused := edge.wrong_kind(path, "a recording", tables=True)) is not None:
            raise refused
        known = sorted({*READERS, *(e.name for e in metadata.entry_points(group=GROUP))})
        endings = ", ".join(f".{ending}" for ending in known)
        raise edge.InputError(f"{source}: the ending must be one of {endings}; {COMPRESSED} may follow it.")
    return ending, reader


def _opened(path: str | os.PathLike[str], source: object, dbc: str | os.PathLike[str] | None) -> BenchFile:
    """Open a file by its ending; `source` as for `_reader`."""
    ending, reader = _reader(path, source)
    module, name = reader.split(":")
    kind = getattr(importlib.import_module(module), name)
    with edge.parsed_by_others(source, f"this is not a .{ending} file, or it is truncated or damaged"):
        opened: BenchFile = kind(str(path), dbc)
    return opened


class UnpackedFile(BenchFile):
    """A file compressed by gzip, read from an unpacked copy, which is removed with this object.

    Parameters
    ----------
    source
        The compressed file; the ending before `.gz` determines its reader.
    dbc
        As in `open_bench_file`.

    Raises
    ------
    edge.InputError
        If it is no such file, or unpacks to more than `edge.most_unpacked`.
    """

    def __init__(self, source: str, dbc: str | os.PathLike[str] | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="cycloid-")
        self._copy = Path(self._folder.name) / Path(source).with_suffix("").name
        _reader(self._copy, source)
        self._lost = self._unpack(source)
        with self._named(source):
            self._file = file = _opened(self._copy, source, dbc)
        super().__init__(
            source, file.channels, file.timed, file.ratio, file.pair, [], file.clocks, file.limits, file.texts
        )
        self._tell()

    def _unpack(self, source: str) -> list[str]:
        """Write the copy; return a sentence if the compressed file is damaged after its beginning."""
        size, most = 0, edge.most_unpacked(source)
        with gzip.open(source) as packed, edge.naming(self._copy), self._copy.open("wb") as copy:
            while True:
                try:
                    block = packed.read1(_BLOCK)
                except (EOFError, OSError, zlib.error) as problem:
                    reason = edge.first_line(problem)
                    if not size:
                        raise edge.InputError(
                            f"{source}: this is not a {COMPRESSED} file, or it is damaged ({reason})."
                        ) from None
                    return [f"{source}: it is truncated or damaged after {size} bytes of its contents ({reason})."]
                if not block:
                    return []
                size += len(block)
                if size > most:
                    raise edge.InputError(f"{source}: it unpacks to more than {most / 1e6:.0f} MB.")
                copy.write(block)

    @contextlib.contextmanager
    def _named(self, source: str) -> Iterator[None]:
        """Name the compressed file instead of its copy in errors."""
        try:
            yield
        except edge.InputError as problem:
            raise edge.InputError(str(problem).replace(str(self._copy), source)) from None

    def _tell(self) -> None:
        """Take over the problems of the copy."""
        self.problems = [
            *self._lost,
            *(problem.replace(str(self._copy), self.source) for problem in self._file.problems),
        ]

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        try:
            with self._named(self.source):
                for piece in self._file.pieces(names):
                    self.clocks = self._file.clocks
                    yield piece
        finally:
            self._tell()


def pieces_of(file: BenchFile, names: Sequence[str]) -> Iterator[Piece]:
    """Yield a file's pieces of these channels; if its library fails, stop and add the reason to the file's problems.

    Raises
    ------
    edge.InputError
        If the reader refuses the file, or its library fails before the first piece.
    """
    taken = 0
    try:
        for piece in file.pieces(names):
            for name, values in piece.values.items():
                if getattr(values, "ndim", 1) != 1:
                    raise edge.InputError(
                        f"{file.source}: {edge.shown(name)} holds arrays; it must be one number per sample."
                    )
            taken += max(map(len, piece.values.values()))
            yield piece
    except edge.InputError:
        raise
    except Exception as problem:  # as in `edge.parsed_by_others`
        sentence = f"{file.source}: it is truncated or damaged after {taken} samples ({edge.first_line(problem)})."
        if not taken:
            raise edge.InputError(sentence) from None
        file.problems.append(sentence)


def numbers_of(column: pa.Array) -> Array:
    """Return a column as an array, NaN for missing values.

    Arrow's own `to_numpy` imports pandas at its first call: 0.25 s of processor time, a fifth of reading and fitting a
    recording.
    """
    if column.null_count or not pa.types.is_float64(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False), float)
    return np.asarray(np.from_dlpack(column))


def seconds_of(column: pa.Array, begun: dict[str, int], name: str) -> Array:
    """Return Arrow's time stamps as seconds since the first of their channel, NaN for missing ones.

    Parameters
    ----------
    column
        Time stamps, shape (n,).
    begun
        {name: first stamp of a channel, ns}; it is added, so that later pieces count from it too.
    name
        The channel.
    """
    known = column.is_valid()
    stamps = np.asarray(column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64()).fill_null(0))
    there = np.asarray(known.to_numpy(zero_copy_only=False), bool)
    if there.any():
        begun.setdefault(name, int(stamps[there][0]))
    return np.where(there, (stamps - begun.get(name, 0)) * 1e-9, np.nan)


def name_and_unit(text: str) -> tuple[str, str]:
    """Split a column's name from its unit: `angle [deg]`, `angle (deg)` or `angle / deg`."""
    text = text.strip()[:LONGEST_NAME]
    match = re.fullmatch(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|\s/\s(.+))", text)
    if match is None:
        return text, ""
    return match[1].strip(), next((g for g in match.groups()[1:] if g is not None), "").strip()


def unique(channels: Sequence[RawChannel]) -> tuple[RawChannel, ...]:
    """Number channels of the same name, because a name in a mapping must identify one channel."""
    seen: dict[str, int] = {}
    numbered = []
    for c in channels:
        name = edge.without_controls(c.name[:LONGEST_NAME])
        seen[name] = seen.get(name, 0) + 1
        name = name if seen[name] == 1 else f"{name} #{seen[name]}"
        numbered.append(RawChannel(name, edge.without_controls(c.unit[:LONGEST_NAME]), c.zero_reference))
    return tuple(numbered)


def in_order(streams: Sequence[Iterator[Piece]]) -> Iterator[Piece]:
    """Merge several streams, each in order of time, by the start of their pieces."""

    def begins(piece: Piece) -> float:
        return 0.0 if piece.time is None else float(piece.time[0])

    yield from heapq.merge(*streams, key=begins)


_SPELLINGS = {
    "deg": ("°", "º"),
    "degC": ("°c",),
    "arcmin": ("′", "'", "’", "arc min", "bogenminuten"),
    "arcsec": ("″", '"', "”", "''", "′′", "arc sec", "bogensekunden"),
    "rev": ("umdr", "umdr.", "tr", "tour", "tours"),
    "rpm": ("r/min", "1/min", "tr/min", "min-1", "u/min"),
    "s": ("sec",),
}
_UNIT_OF = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings}


def measures(unit: str, si: str) -> bool:
    """Return whether a unit, as benches write it, is one of those of an SI unit.

    A count or a share is no angle, although both are numbers to pint: "counts" would be read as radians.

    Examples
    --------
    >>> measures("°", "rad"), measures("counts", "rad"), measures("Nm", "N*m")
    (True, False, True)
    """
    text = unit_text(unit)
    if not text or text in USUAL.get(si, {}):
        return bool(text)
    try:
        own, wanted = (edge.units().Quantity(1.0, edge.parse_unit(t)).to_base_units().units for t in (text, si))
    except ValueError:
        return False
    return bool(own == wanted)


def unit_text(text: str) -> str:
    """Return a unit in pint's notation; benches write `°`, `Nm`, `N·m`, `kNm`, `°C`."""
    text = text.strip()
    if text == "nm":  # this is nanometres
        return text
    torque = re.fullmatch(r"([kmMµu]?)N[ ·.⋅*-]?m", text)
    if torque:
        return f"{torque[1]}N*m"
    return _UNIT_OF.get(text.lower(), text)
