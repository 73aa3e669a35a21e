"""What files of test benches hold, piece by piece and as they name it: nothing here knows which channel is what.

CSV in its dialects, Parquet, MDF4, TDMS, CAN logs with a DBC, and our recorder's files. Every reader yields pieces of
bounded size, so that a file may be larger than memory.
"""

from __future__ import annotations

import abc
import codecs
import csv
import gc
import heapq
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import Alignment, Clock, RecordingReader, Samples, joined, read_clocks

Array = NDArray[np.float64]

PIECE = 1 << 17  # samples of a piece: its arrays stay within a processor's cache
_GATHERED = 1 << 13  # samples of a channel in our recorder's files
TABLES = (".csv", ".txt", ".tsv", ".dat")
CAN_LOGS = (".blf", ".asc", ".trc")


@dataclass(frozen=True)
class RawChannel:
    """A channel as the file names it.

    Attributes
    ----------
    name
        Its name, unique in the file.
    unit
        Its unit as the file writes it, "" where it says none.
    zero_reference
        "absolute" where the file says that the zero is the same in every recording, else "incremental".
    """

    name: str
    unit: str = ""
    zero_reference: str = "incremental"


@dataclass(frozen=True)
class Piece:
    """Consecutive samples of channels that share their instants: arrays of one length.

    Attributes
    ----------
    time
        Seconds by the file's own time base, or None where a channel holds the time.
    values
        {name: values in the file's unit}.
    status
        Bits of the recording format, or None where the file has none.
    """

    time: Array | None
    values: dict[str, Array]
    status: NDArray[np.uint8] | None = None


@dataclass
class BenchFile(abc.ABC):
    """A file that was opened.

    Attributes
    ----------
    source
        The file's name.
    channels
        What it holds.
    timed
        Whether its channels bring their time with them; else one of them is the time.
    ratio
        Signed ratio of the drive, where the file says it.
    problems
        One sentence for each thing found wrong with the file; complete when all pieces were taken.
    clocks
        {channel: the clock that stamped it, in the host's time} where a device stamped it with a clock of its own.
    """

    source: str
    channels: tuple[RawChannel, ...] = ()
    timed: bool = False
    ratio: float | None = None
    problems: list[str] = field(default_factory=list)
    clocks: dict[str, Clock] = field(default_factory=dict)

    @abc.abstractmethod
    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""


def open_bench_file(path: str | os.PathLike[str], dbc: str | os.PathLike[str] | None = None) -> BenchFile:
    """Open a bench file by its ending.

    Parameters
    ----------
    path
        `.arrows`, `.csv` (`.txt`, `.tsv`, `.dat`), `.parquet`, `.mf4` (`.mdf`), `.tdms`, `.blf`, `.asc`, `.trc`.
    dbc
        The DBC file that describes the frames of a CAN log.

    Raises
    ------
    edge.InputError
        If the file can't be read or understood, or a package that reads it is missing.
    """
    edge.existing(path)
    suffix = Path(path).suffix.lower()
    source = str(path)
    if suffix == ".arrows":
        return _RecorderFile(source)
    if suffix == ".parquet":
        return _ParquetFile(source)
    if suffix in (".mf4", ".mdf"):
        return _MdfFile(source)
    if suffix == ".tdms":
        return _TdmsFile(source)
    if suffix in CAN_LOGS:
        return _CanLog(source, dbc)
    if suffix in TABLES:
        return _CsvFile(source)
    raise edge.InputError(
        f"{path}: the ending must be .arrows, .csv (.txt, .tsv, .dat), .parquet, .mf4, .tdms, .blf, .asc or .trc."
    )


def name_and_unit(text: str) -> tuple[str, str]:
    """Split a column's name from its unit: `angle [deg]`, `angle (deg)` or `angle / deg`."""
    text = text.strip()
    match = re.fullmatch(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|\s/\s(.+))", text)
    if match is None:
        return text, ""
    return match[1].strip(), next((g for g in match.groups()[1:] if g is not None), "").strip()


def _first_line(problem: Exception) -> str:
    """What a library's error says, in one line."""
    return (str(problem).strip() or type(problem).__name__).splitlines()[0].rstrip(".")


def _unique(channels: Sequence[RawChannel]) -> tuple[RawChannel, ...]:
    """Give channels of one name a number: what a mapping names must be one channel."""
    seen: dict[str, int] = {}
    found = []
    for c in channels:
        seen[c.name] = seen.get(c.name, 0) + 1
        name = c.name if seen[c.name] == 1 else f"{c.name} #{seen[c.name]}"
        found.append(RawChannel(name, c.unit, c.zero_reference))
    return tuple(found)


# ---------------------------------------------------------------------------------------------------------------- CSV

_NUMERIC = re.compile(r"\s*[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?\s*")
_NOT_A_NUMBER = {"", "nan", "inf", "-inf", "n/a", "na", "null"}


@dataclass(frozen=True)
class Dialect:
    """How a table is written.

    Attributes
    ----------
    encoding
        Of the text.
    delimiter, decimal
        Between cells, and in numbers.
    header
        The header's cells; made up where there is none.
    units
        Units of the columns, "" where none is said.
    skip
        Lines before the first row of numbers.
    """

    encoding: str
    delimiter: str
    decimal: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    skip: int


def _decoded_start(data: bytes, source: str) -> tuple[str, str]:
    """Return encoding and text of a table's first bytes: by the byte order mark, else UTF-8, else Windows-1252."""
    for mark, encoding in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if data.startswith(mark):
            return encoding, codecs.getincrementaldecoder(encoding)(errors="replace").decode(data)
    if b"\0" in data:
        raise edge.InputError(f"{source}: this is not a text table; it holds zero bytes.")
    for encoding in ("utf-8", "cp1252"):
        try:
            return encoding, codecs.getincrementaldecoder(encoding)().decode(data)
        except UnicodeDecodeError:
            continue
    raise edge.InputError(f"{source}: this is not a text table; its encoding is none of UTF-8, UTF-16, Windows-1252.")


def _is_number(cell: str) -> bool:
    return bool(_NUMERIC.fullmatch(cell)) or cell.strip().lower() in _NOT_A_NUMBER


def find_dialect(data: bytes, source: str) -> Dialect:
    """Find how a table is written from its first bytes.

    Parameters
    ----------
    data
        The file's first bytes, some lines at least.
    source
        The file's name, for messages.

    Raises
    ------
    edge.InputError
        If it is empty or no table of numbers.
    """
    encoding, text = _decoded_start(data, source)
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith(("\n", "\r")):
        lines = lines[:-1]  # it may be cut within
    if not any(line.strip() for line in lines):
        raise edge.InputError(f"{source}: the file is empty.")
    candidates = []
    for delimiter in (";", "\t", "|", ","):
        rows = [next(csv.reader([line], delimiter=delimiter), []) for line in lines[:200]]
        for first, row in enumerate(rows):
            if len(row) > 1 and all(_is_number(c) for c in row) and any(_NUMERIC.fullmatch(c) for c in row):
                candidates.append((first, delimiter, rows))
                break
    # The delimiter whose rows of numbers begin first; a decimal comma splits "1,5;2,5" into three numbers and text.
    candidates.sort(key=lambda found: found[0])
    if not candidates:
        delimiter = max((";", "\t", "|", ","), key=lines[0].count)
        header = next(csv.reader([lines[0]], delimiter=delimiter))
        if len(header) < 2:
            raise edge.InputError(f"{source}: it is not a table; no line has two numbers or names.")
        named = [name_and_unit(c) for c in header]
        return Dialect(encoding, delimiter, ".", tuple(n for n, _ in named), tuple(u for _, u in named), 1)
    first, delimiter, rows = candidates[0]
    width = len(rows[first])
    numbers = rows[first : first + 50]
    decimal = "," if delimiter != "," and any("," in c for row in numbers for c in row) else "."
    above = [r for r in rows[:first] if len(r) == width and any(c.strip() for c in r)]
    if not above:
        return Dialect(
            encoding, delimiter, decimal, tuple(f"column {i + 1}" for i in range(width)), ("",) * width, first
        )
    named = [name_and_unit(c) for c in above[-1]]
    if len(above) > 1 and not any(u for _, u in named) and sum(_looks_like_unit(c) for c in above[-1]) > width / 2:
        units = [c.strip().strip("[]()") for c in above[-1]]
        named = [(name_and_unit(n)[0], u) for n, u in zip(above[-2], units, strict=True)]
    return Dialect(encoding, delimiter, decimal, tuple(n for n, _ in named), tuple(u for _, u in named), first)


def _looks_like_unit(cell: str) -> bool:
    text = unit_text(cell.strip().strip("[]()"))
    if not text:
        return False
    try:
        edge.units().Unit(text)
    except Exception:
        return False
    return True


class _CsvFile(BenchFile):
    def __init__(self, source: str) -> None:
        with Path(source).open("rb") as file:
            start = file.read(1 << 16)
        self.dialect = find_dialect(start, source)
        named = zip(self.dialect.header, self.dialect.units, strict=True)
        super().__init__(source, _unique([RawChannel(n, u) for n, u in named]))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        columns = [c.name for c in self.channels]
        torn: list[str] = []

        def short_row(row: Any) -> str:
            torn.append(row.text)
            return "skip" if len(torn) == 1 else "error"

        d = self.dialect
        plain = d.encoding in ("utf-8", "utf-8-sig")
        options = {
            "read_options": arrow_csv.ReadOptions(
                column_names=columns, skip_rows=d.skip, block_size=1 << 23, encoding="utf8" if plain else d.encoding
            ),
            "parse_options": arrow_csv.ParseOptions(delimiter=d.delimiter, invalid_row_handler=short_row),
            "convert_options": arrow_csv.ConvertOptions(
                column_types={n: pa.float64() for n in names}, include_columns=list(names), decimal_point=d.decimal
            ),
        }
        try:
            with arrow_csv.open_csv(self.source, **options) as reader:
                for batch in reader:
                    table = [batch.column(i).to_numpy(zero_copy_only=False) for i in range(len(names))]
                    for begin in range(0, batch.num_rows, PIECE):
                        yield Piece(None, {n: v[begin : begin + PIECE] for n, v in zip(names, table, strict=True)})
        except pa.ArrowInvalid as problem:
            if "Empty CSV file" in str(problem):
                return
            raise edge.InputError(f"{self.source}: {self._first_bad_cell(names, problem)}") from None
        if torn:
            with Path(self.source).open("rb") as file:
                file.seek(-1, os.SEEK_END)
                whole = file.read(1) in b"\r\n"
            if whole:
                raise edge.InputError(f"{self.source}: {self._first_bad_cell(names, ValueError(torn[0]))}")
            self.problems.append(f"{self.source}: its last line is cut; it was left out.")

    def _first_bad_cell(self, names: Sequence[str], problem: Exception) -> str:
        d = self.dialect
        places = [(n, [c.name for c in self.channels].index(n)) for n in names]
        with open(self.source, encoding=d.encoding, newline="") as file:
            for number, row in enumerate(csv.reader(file, delimiter=d.delimiter), start=1):
                if number <= d.skip or not row:
                    continue
                for name, position in places:
                    cell = row[position].strip() if position < len(row) else None
                    try:
                        float((cell or "nan").replace(d.decimal, "."))
                        if cell is None or (d.decimal == "," and "." in cell):
                            raise ValueError
                    except ValueError:
                        word = "point" if d.decimal == "." else "comma"
                        return f'line {number}: {name} is "{cell or ""}"; it must be a number with a decimal {word}.'
                if len(row) != len(self.channels):
                    return f"line {number}: it has {len(row)} cells, the header {len(self.channels)}."
        return f"it is not a table of numbers ({_first_line(problem)})."


# ------------------------------------------------------------------------------------------------------------ Parquet


class _ParquetFile(BenchFile):
    def __init__(self, source: str) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        try:
            self._file = parquet.ParquetFile(source)
        except (pa.ArrowException, OSError):
            raise edge.InputError(
                f"{source}: this is not a Parquet file, or it is cut; Parquet's index lies at its end, so nothing of a "
                "cut file can be read."
            ) from None
        self._names, channels = {}, []
        for number, part in enumerate(self._file.schema_arrow):
            if not (pa.types.is_floating(part.type) or pa.types.is_integer(part.type)):
                continue
            name, unit = name_and_unit(part.name)
            said = {k.decode(): v.decode() for k, v in (part.metadata or {}).items()}
            channels.append(RawChannel(name, unit or said.get("unit", said.get("units", ""))))
            self._names[number] = part.name
        super().__init__(source, _unique(channels))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        stored = dict(zip((c.name for c in self.channels), self._names.values(), strict=True))
        for batch in self._file.iter_batches(batch_size=PIECE, columns=[stored[n] for n in names]):
            yield Piece(
                None,
                {n: np.asarray(batch.column(stored[n]).to_numpy(zero_copy_only=False), float) for n in names},
            )


# ------------------------------------------------------------------------------------------------------ MDF4 and TDMS


def _extra(package: str, extra: str, source: str) -> edge.InputError:
    return edge.InputError(f"{source}: reading this needs the package {package}: pip install 'cycloid-fmu[{extra}]'.")


def _drop(problem: BaseException | None) -> None:
    """Free what a failed constructor left behind, without its destructor's complaints about what it lacks."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        while problem is not None:
            problem.__traceback__, problem = None, problem.__context__
        gc.collect()
    finally:
        sys.unraisablehook = hook


class _MdfFile(BenchFile):
    def __init__(self, source: str) -> None:
        try:
            from asammdf import MDF
        except ImportError:
            raise _extra("asammdf", "bench-files", source) from None
        try:
            self._mdf = MDF(source)
        except Exception as problem:  # asammdf raises whatever its parser meets
            said = _first_line(problem)
            _drop(problem)
            raise edge.InputError(f"{source}: this is not an MDF file, or it is cut or damaged ({said}).") from None
        channels, self._places = [], []
        for index, group in enumerate(self._mdf.groups):
            master = self._mdf.masters_db.get(index)
            for number, channel in enumerate(group.channels):
                if number != master:
                    channels.append(RawChannel(channel.name, channel.unit or ""))
                    self._places.append((channel.name, index, number))
        super().__init__(source, _unique(channels), timed=True)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        places = {c.name: p for c, p in zip(self.channels, self._places, strict=True)}
        groups: dict[int, list[str]] = {}
        for name in names:
            groups.setdefault(places[name][1], []).append(name)
        yield from in_order([self._group(index, members, places) for index, members in groups.items()])

    def _group(self, index: int, names: Sequence[str], places: dict[str, tuple[str, int, int]]) -> Iterator[Piece]:
        group = self._mdf.groups[index]
        total, begin = group.channel_group.cycles_nr, 0
        while begin < total:
            try:
                signals = self._mdf.select(
                    [places[n] for n in names], record_offset=begin, record_count=PIECE,
                    ignore_value2text_conversions=True,
                )  # fmt: skip
                got = min(len(s.timestamps) for s in signals)
            except Exception as problem:
                self.problems.append(
                    f"{self.source}: it is cut or damaged after {begin} of {total} samples ({_first_line(problem)})."
                )
                return
            if got:
                values = {n: np.asarray(s.samples[:got], float) for n, s in zip(names, signals, strict=True)}
                yield Piece(np.asarray(signals[0].timestamps[:got], float), values)
            begin += got
            if got < min(PIECE, total - begin + got):
                self.problems.append(f"{self.source}: it is cut after {begin} of {total} samples.")
                return


class _TdmsFile(BenchFile):
    def __init__(self, source: str) -> None:
        try:
            from nptdms import TdmsFile
        except ImportError:
            raise _extra("npTDMS", "bench-files", source) from None
        try:
            self._file = TdmsFile.open(source)
            found = [c for g in self._file.groups() for c in g.channels() if c.dtype is not None]
        except Exception as problem:
            raise edge.InputError(
                f"{source}: this is not a TDMS file, or it is cut or damaged ({_first_line(problem)})."
            ) from None
        self._found = [c for c in found if np.issubdtype(c.dtype, np.number)]
        units = [str(c.properties.get("unit_string", c.properties.get("unit", ""))) for c in self._found]
        channels = [RawChannel(c.name, u) for c, u in zip(self._found, units, strict=True)]
        timed = bool(self._found) and all(c.properties.get("wf_increment") for c in self._found)
        super().__init__(source, _unique(channels), timed=timed)
        status = getattr(self._file, "file_status", None)
        if status is not None and status.incomplete_final_segment:
            self.problems.append(f"{source}: it is cut; its last segment is not complete and what it holds was read.")

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        places = dict(zip((c.name for c in self.channels), self._found, strict=True))
        if not self.timed:  # one clock for all: a channel holds the time
            yield from self._chunks([(n, places[n]) for n in names], None)
            return
        bases: dict[tuple[float, float], list[tuple[str, Any]]] = {}
        for name in names:
            said = places[name].properties
            base = (float(said.get("wf_start_offset", 0.0)), float(said["wf_increment"]))
            bases.setdefault(base, []).append((name, places[name]))
        yield from in_order([self._chunks(members, base) for base, members in bases.items()])

    def _chunks(self, members: Sequence[tuple[str, Any]], base: tuple[float, float] | None) -> Iterator[Piece]:
        total = min(len(channel) for _, channel in members)
        longest = max(len(channel) for _, channel in members)
        if longest != total:
            self.problems.append(
                f"{self.source}: its channels end after {total} to {longest} samples; {total} are used."
            )
        for begin in range(0, total, PIECE):
            count = min(PIECE, total - begin)
            values = {n: np.asarray(c.read_data(begin, count), float) for n, c in members}
            time = None if base is None else base[0] + base[1] * np.arange(begin, begin + count, dtype=float)
            yield Piece(time, values)


# ------------------------------------------------------------------------------------------------------------ CAN logs


class _CanLog(BenchFile):
    def __init__(self, source: str, dbc: str | os.PathLike[str] | None) -> None:
        import cantools

        if dbc is None:
            raise edge.InputError(f"{source}: a CAN log needs the DBC of its frames; name it as dbc in the mapping.")
        try:
            self._database: Any = cantools.database.load_string(edge.read_text(dbc), "dbc")
        except edge.InputError:
            raise
        except Exception as problem:
            raise edge.InputError(f"{dbc}: this is not a DBC file: {_first_line(problem)}.") from None
        channels = [
            RawChannel(f"{m.name}.{s.name}", s.unit or "") for m in self._database.messages for s in m.signals
        ]  # fmt: skip
        super().__init__(source, tuple(channels), timed=True)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        import can

        wanted: dict[int, tuple[Any, list[tuple[str, str]]]] = {}
        for message in self._database.messages:
            signals = [(f"{message.name}.{s.name}", s.name) for s in message.signals]
            chosen = [(full, short) for full, short in signals if full in names]
            if chosen:
                wanted[message.frame_id] = (message, chosen)
        try:
            log = can.LogReader(self.source)
        except Exception as problem:
            raise edge.InputError(f"{self.source}: this CAN log can't be read ({_first_line(problem)}).") from None
        kept: dict[int, tuple[list[float], list[list[float]]]] = {k: ([], []) for k in wanted}
        failed, count = 0, 0

        def flush() -> Iterator[Piece]:
            for key, (times, rows) in kept.items():
                if times:
                    table = np.array(rows, float)
                    yield Piece(np.array(times), {full: table[:, i] for i, (full, _) in enumerate(wanted[key][1])})
                    times.clear()
                    rows.clear()

        messages = iter(log)
        while True:
            try:
                frame = next(messages)
            except StopIteration:
                break
            except Exception as problem:  # a cut or damaged log
                self.problems.append(
                    f"{self.source}: it is cut or damaged after {count} frames ({_first_line(problem)})."
                )
                break
            count += 1
            if frame.arbitration_id not in wanted or frame.is_error_frame or frame.is_remote_frame:
                continue
            message, chosen = wanted[frame.arbitration_id]
            try:
                decoded = message.decode(bytes(frame.data), decode_choices=False)
            except Exception:  # too short for the message, or a multiplexer it does not know
                failed += 1
                continue
            times, rows = kept[frame.arbitration_id]
            times.append(frame.timestamp)
            rows.append([float(decoded.get(short, np.nan)) for _, short in chosen])
            if len(times) >= PIECE // 4:
                yield from flush()
        yield from flush()
        if failed:
            self.problems.append(f"{self.source}: {failed} frames do not fit the DBC and were left out.")


# ------------------------------------------------------------------------------------------------- our recorder's files


class _RecorderFile(BenchFile):
    def __init__(self, source: str) -> None:
        with RecordingReader(source) as reader:
            header = reader.header
        channels = [RawChannel(c.name, c.unit, c.zero_reference) for c in header.channels]
        super().__init__(source, tuple(channels), timed=True, ratio=header.ratio)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        known = read_clocks(self.source, names)
        # The least certain stretch of a channel says how well its time is known.
        self.clocks = {n: max(c.values(), key=lambda clock: clock.uncertainty) for n, c in known.items()}
        alignments = {n: Alignment(known.get(n, {})) for n in names}
        silent = set(names)
        waiting: dict[str, list[Samples]] = {n: [] for n in names}

        gathered = dict.fromkeys(names, 0)

        def piece(name: str) -> Piece:
            samples = joined(name, waiting[name])
            waiting[name].clear()
            gathered[name] = 0
            return Piece(alignments[name].time(samples), {name: samples.value}, samples.status)

        with RecordingReader(self.source) as reader:
            for samples, _ in reader.batches():
                if samples.channel in waiting and len(samples):
                    silent.discard(samples.channel)
                    waiting[samples.channel].append(samples)
                    # A batch is a twentieth of a second; to take each by itself costs more than what is in it.
                    gathered[samples.channel] += len(samples)
                    if gathered[samples.channel] >= _GATHERED:
                        yield piece(samples.channel)
            for name in names:
                if waiting[name]:
                    yield piece(name)
            self.problems = list(reader.problems)
        if silent:
            said = " ".join([*self.problems, f"{self.source}: the {min(silent)} channel has no samples."])
            raise edge.InputError(said)


def in_order(streams: Sequence[Iterator[Piece]]) -> Iterator[Piece]:
    """Take from several streams, each in the order of its time, always the piece that begins first."""

    def begins(piece: Piece) -> float:
        return 0.0 if piece.time is None else float(piece.time[0])

    yield from heapq.merge(*streams, key=begins)


_SPELLINGS = {
    "°": "deg", "º": "deg", "°c": "degC", "′": "arcmin", "'": "arcmin", "″": "arcsec", '"': "arcsec", "sec": "s",
}  # fmt: skip


def unit_text(text: str) -> str:
    """Return a unit as pint reads it; benches write `°`, `Nm`, `N·m`, `kNm`, `°C`."""
    text = text.strip()
    if text == "nm":  # nanometres are what this says
        return text
    torque = re.fullmatch(r"([kmMµu]?)N[ ·.⋅*-]?m", text)
    if torque:
        return f"{torque[1]}N*m"
    return _SPELLINGS.get(text.lower(), text)
