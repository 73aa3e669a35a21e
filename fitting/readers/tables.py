"""Tables: CSV in its dialects, and Parquet."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cycloid_fmu import edge
from fitting.readers.formats import (
    PIECE,
    Array,
    BenchFile,
    Piece,
    RawChannel,
    name_and_unit,
    numbers_of,
    seconds_of,
    unique,
    unit_text,
)

_DELIMITERS = (";", "\t", "|", ",")  # a comma last: it may be the decimal mark
_MISSING = ("", "nan", "inf", "-inf", "+inf", "n/a", "na", "null", "none", "-", "--")
_DATE_TIME = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?"
_ZONE = r"(?:Z|[+-]\d\d(?::?\d\d)?)"
_STAMP = re.compile(_DATE_TIME + _ZONE + "?")  # ISO 8601
_ROWS = 4 * PIECE  # rows of a Parquet file read together


# Units of the registers of a moteus, which the CSV logger of its Python library (examples/csv_output.py) writes below
# their names, without units. Its temperatures are those of the board and the motor, not of the drive.
_MOTEUS = {
    "ABS_POSITION": "rev",
    "POWER": "W",
    "VOLTAGE": "V",
    **{f"{kind}_CURRENT": "A" for kind in ("Q", "D", "COMMAND_Q", "COMMAND_D")},
    **{f"{kind}POSITION": "rev" for kind in ("", "COMMAND_", "CONTROL_", "ENCODER_0_", "ENCODER_1_", "ENCODER_2_")},
    **{f"{kind}VELOCITY": "rev/s" for kind in ("", "COMMAND_", "CONTROL_", "ENCODER_0_", "ENCODER_1_", "ENCODER_2_")},
    **{f"{kind}TORQUE": "N*m" for kind in ("", "COMMAND_FEEDFORWARD_", "CONTROL_")},
    "POSITION_ERROR": "rev",
    "VELOCITY_ERROR": "rev/s",
    "TORQUE_ERROR": "N*m",
}
_REGISTER = re.compile(r"[A-Z][A-Z0-9_]*|0x[0-9a-f]{3}")


def _is_moteus(names: Sequence[str]) -> bool:
    """Return whether a header is that of moteus's logger: `time`, then registers by their names in capitals."""
    return names[0] == "time" and "POSITION" in names and all(map(_REGISTER.fullmatch, names[1:]))


def _number(decimal: str) -> str:
    """Return the pattern of numbers with a decimal mark."""
    return rf"[+-]?(?:\d+{decimal}?\d*|{decimal}\d+)(?:[eE][+-]?\d+)?"


_MARKS = {".": "point", ",": "comma"}
_NUMBERS = {mark: _number(f"[{mark}]") for mark in _MARKS}
_ANY_NUMBER = re.compile("|".join(_NUMBERS.values()))
_THOUSANDS = re.compile(r"[+-]?\d{1,3},\d{3}")


@dataclass(frozen=True)
class Dialect:
    """The format of a table.

    Attributes
    ----------
    encoding
        Encoding of the text.
    delimiter, decimal
        Delimiter between cells, and decimal mark.
    header
        Names of the columns; generated if there is no header.
    units
        Units of the columns, "" if not stated.
    skip
        Number of lines before the first row of data.
    kinds
        Contents of the columns: "number", "stamp" (ISO 8601 date and time) or "text".
    """

    encoding: str
    delimiter: str
    decimal: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    skip: int
    kinds: tuple[str, ...]


def _kind(cell: str) -> str:
    """Return what a cell holds: "number" (with either decimal mark), "stamp", "text", or "" for no value."""
    cell = cell.strip()
    if cell.lower() in _MISSING:
        return ""
    return "number" if _ANY_NUMBER.fullmatch(cell) else "stamp" if _STAMP.fullmatch(cell) else "text"


@dataclass(frozen=True)
class _Table:
    """The lines of a text that seem to be rows of a table, in one delimiter.

    Attributes
    ----------
    lines
        Numbers of the lines, from 0.
    rows
        Their cells, all of one number.
    cells
        Kinds of the cells, as `_kind`.
    kinds
        Kinds of the columns: that of most cells in the lower half, below a header of any length.
    """

    lines: list[int]
    rows: list[list[str]]
    cells: list[list[str]]
    kinds: tuple[str, ...]

    def misfits(self, row: int) -> list[str]:
        """Return the cells of a row that are not of their column's kind, in the columns of numbers and stamps."""
        columns = zip(self.rows[row], self.cells[row], self.kinds, strict=True)
        return [cell for cell, kind, column in columns if column != "text" and kind not in ("", column)]

    def fits(self, row: int) -> list[str]:
        """Return the cells of a row that are values of their column's kind."""
        columns = zip(self.rows[row], self.cells[row], self.kinds, strict=True)
        return [cell for cell, kind, column in columns if column != "text" and kind == column]

    def begin(self) -> int:
        """Return the index of the first row of data.

        Columns of numbers and stamps decide: in the header all their cells are text. A first row of data may hold text
        in place of some of its numbers.
        """
        rows = range(len(self.rows))
        first = next((i for i in rows if self.fits(i) and not self.misfits(i)), None)
        if first is None:
            return next(i for i in rows if self.fits(i))
        names = next((i for i in reversed(range(first)) if self.misfits(i) and not self.fits(i)), None)
        if names is None:
            # Channels may have numbers as names; a decimal mark, sign or exponent is that of data.
            data = [i for i in range(first) if any(not cell.strip().isdigit() for cell in self.fits(i))]
            return data[0] if data else first
        if names + 1 < first and all(map(_looks_like_unit, self.misfits(names + 1))):
            return names + 2  # a row of units, one of them 1
        return names + 1


def _table(lines: Sequence[str], delimiter: str) -> _Table | None:
    """Return the table in some lines, or None if there is none in this delimiter."""
    split = [next(csv.reader([line], delimiter=delimiter), []) for line in lines]
    widths = Counter(len(row) for row in split if len(row) > 1)
    if not widths:
        return None
    width = max(widths, key=lambda n: (widths[n], n))
    if not any(
        row[-1].strip() for row in split if len(row) == width
    ):  # rows of data end in a delimiter, the header not
        split = [[*row, ""] if len(row) == width - 1 else row for row in split]
    numbers = [i for i, row in enumerate(split) if len(row) == width]
    if 2 * len(numbers) < sum(any(row) for row in split[numbers[0] :]):
        return None
    rows = [split[i] for i in numbers]
    cells = [[_kind(cell) for cell in row] for row in rows]
    first = next((i for i, row in enumerate(cells) if {"number", "stamp"} & {*row}), None)
    if first is None:
        return None
    kinds = []
    for column in zip(*cells[max(first, len(cells) // 2) :], strict=True):
        count = Counter(kind for kind in column if kind)
        kinds.append(max(("number", "stamp", "text"), key=lambda kind: count[kind]))
    return _Table(numbers, rows, cells, tuple(kinds)) if {"number", "stamp"} & {*kinds} else None


def find_dialect(data: bytes, source: str) -> Dialect:
    """Determine the format of a table from its first bytes.

    Parameters
    ----------
    data
        The first bytes of the file, at least a few lines.
    source
        The file's name, for messages.

    Raises
    ------
    edge.InputError
        If it is empty or not a table of numbers.
    """
    encoding, text = edge.decoded(data, source)
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith(("\n", "\r")):
        lines = lines[:-1]  # the last line may be incomplete
    if not any(line.strip() for line in lines):
        raise edge.InputError(f"{source}: the file is empty.")
    tables = ((delimiter, _table(lines, delimiter)) for delimiter in _DELIMITERS)
    delimiter, table = next(((d, t) for d, t in tables if t is not None), ("", None))
    if table is None:
        delimiter = max(_DELIMITERS, key=lines[0].count)
        header = next(csv.reader([lines[0]], delimiter=delimiter))
        if len(header) < 2:
            raise edge.InputError(f"{source}: it is not a table; no line has two numbers or names.")
        named = [name_and_unit(c) for c in header]
        names, units = tuple(n for n, _ in named), tuple(u for _, u in named)
        return Dialect(encoding, delimiter, ".", names, units, 1, ("number",) * len(named))
    begin = table.begin()
    fits = [cell for row in range(begin, len(table.rows)) for cell in table.fits(row) if not _STAMP.fullmatch(cell)]
    commas = sum("," in cell for cell in fits)
    decimal = "," if commas > sum("." in cell for cell in fits) else "."
    if delimiter == "," and all(_THOUSANDS.fullmatch(cell.strip()) for cell in fits if "," in cell):
        decimal = "."  # quoted cells such as "1,234" are refused: they may be whole thousands
    above = [row for row in table.rows[:begin] if any(c.strip() for c in row)]
    named = [name_and_unit(c) for c in above[-1]] if above else [("", "") for _ in table.kinds]
    if len(above) > 1 and _are_units_of(above[-2], above[-1]):
        units_below = [c.strip().strip("[]()") for c in above[-1]]
        named = [(name_and_unit(n)[0], u) for n, u in zip(above[-2], units_below, strict=True)]
    names = tuple(n or f"column {i + 1}" for i, (n, _) in enumerate(named))
    units = tuple(u for _, u in named)
    if _is_moteus(names):
        units = ("s", *(_MOTEUS.get(name, "") for name in names[1:]))
    return Dialect(encoding, delimiter, decimal, names, units, table.lines[begin], table.kinds)


def _are_units_of(names: Sequence[str], row: Sequence[str]) -> bool:
    """Return whether the row below a header states units: most of its cells, each below a name."""
    stated = [(name, cell) for name, cell in zip(names, row, strict=True) if cell.strip()]
    units = [name for name, cell in stated if _looks_like_unit(cell)]
    return all(name.strip() for name in units) and 2 * len(units) > len(stated)


def _looks_like_unit(cell: str) -> bool:
    text = unit_text(cell.strip().strip("[]()"))
    if not text:
        return False
    if text == "-":  # a quantity without a unit
        return True
    try:
        edge.parse_unit(text)
    except ValueError:
        return False
    return True


class Cells:
    """Converts cells of text to numbers, and counts those that are none.

    Parameters
    ----------
    source
        The file, for messages.
    decimal
        Decimal mark.
    """

    def __init__(self, source: str, decimal: str) -> None:
        self._source, self._decimal = source, decimal
        self._stamps: dict[str, tuple[str, str]] = {}
        self._begun: dict[str, int] = {}
        self._wrong: dict[str, tuple[int, int, str]] = {}

    def numbers(self, name: str, cells: pa.Array, line: int) -> Array:
        """Return the numbers in the cells of a column, NaN for other cells.

        Parameters
        ----------
        name
            Name of the column.
        cells
            Text, shape (n,).
        line
            Line of the first of them in the file.

        Raises
        ------
        edge.InputError
            If a cell is a number with the other decimal mark: it may not be left out like a missing one.
        """
        plain = pc.replace_substring(cells, ",", ".") if self._decimal == "," else cells
        if self._decimal == "." or not pc.any(pc.match_substring(cells, ".")).as_py():
            try:
                return numbers_of(plain.cast(pa.float64()))
            except pa.ArrowInvalid:
                pass
        trimmed = pc.utf8_trim_whitespace(cells)
        fits = pc.match_substring_regex(trimmed, f"^(?:{_NUMBERS[self._decimal]})$")
        other = f"^(?:{_NUMBERS['.' if self._decimal == ',' else ',']}|[+-]?\\d{{1,3}}([.,']\\d{{3}})+([.,]\\d*)?)$"
        wrong = pc.and_not(pc.match_substring_regex(trimmed, other), fits)
        if pc.any(wrong).as_py():
            at = pc.index(wrong, True).as_py()
            raise edge.InputError(
                f"{self._source}: line {line + at}: {name} is {edge.shown(trimmed[at].as_py())}; it must be a number "
                f"with a decimal {_MARKS[self._decimal]} and without other marks."
            )
        self._count(name, trimmed, fits, line)
        plain = pc.utf8_trim_whitespace(plain)
        return numbers_of(pc.if_else(fits, plain, pa.scalar(None, plain.type)).cast(pa.float64()))

    def seconds(self, name: str, cells: pa.Array, line: int) -> Array:
        """Return the seconds since a column's first ISO 8601 stamp, NaN for other cells; parameters as `numbers`."""
        trimmed = pc.replace_substring(pc.utf8_trim_whitespace(cells), ",", ".")
        zoned = f"^{_DATE_TIME}{_ZONE}$"
        if name not in self._stamps:
            with_zone = pc.any(pc.match_substring_regex(trimmed, zoned)).as_py()
            self._stamps[name] = (zoned, "UTC") if with_zone else (f"^{_DATE_TIME}$", "")
        pattern, zone = self._stamps[name]
        kind = pa.timestamp("ns", zone or None)
        fits = pc.match_substring_regex(trimmed, pattern)
        stamps = pc.if_else(fits, trimmed, pa.scalar(None, trimmed.type))
        try:
            times = stamps.cast(kind)
        except pa.ArrowInvalid:  # a date that the calendar does not have
            times = pa.array([_time_of(stamp, kind) for stamp in stamps], kind)
            fits = pc.is_valid(times)
        self._count(name, trimmed, fits, line)
        return seconds_of(times, self._begun, name)

    def _count(self, name: str, cells: pa.Array, fits: pa.Array, line: int) -> None:
        """Count the cells that are neither a value nor a word for a missing one."""
        missing = pc.is_in(pc.utf8_lower(cells), pa.array(_MISSING, cells.type))
        wrong = pc.and_not(pc.invert(fits), missing)
        if not (number := pc.sum(wrong).as_py()):
            return
        at = pc.index(wrong, True).as_py()
        count, first, cell = self._wrong.get(name, (0, line + at, str(cells[at].as_py())))
        self._wrong[name] = (count + number, first, cell)

    def notes(self) -> list[str]:
        """Return one sentence for each column with cells that are no values."""
        return [
            f"{self._source}: line {line}: {name} is {edge.shown(cell)}, no value"
            + (f"; the column has {count} such cells." if count > 1 else ".")
            for name, (count, line, cell) in self._wrong.items()
        ]


def _time_of(stamp: pa.Scalar, kind: pa.DataType) -> pa.Scalar:
    try:
        return stamp.cast(kind)
    except pa.ArrowInvalid:
        return pa.scalar(None, kind)


class CsvFile(BenchFile):
    """A text table with comma, semicolon, tab or bar between cells."""

    def __init__(self, source: str, dbc: object = None) -> None:
        with Path(source).open("rb") as file:
            start = file.read(1 << 16)
        d = self.dialect = find_dialect(start, source)
        units = ["s" if kind == "stamp" else u for u, kind in zip(d.units, d.kinds, strict=True)]
        every = unique([RawChannel(n, u) for n, u in zip(d.header, units, strict=True)])
        self._kinds = {c.name: kind for c, kind in zip(every, d.kinds, strict=True)}
        channels = tuple(c for c in every if self._kinds[c.name] != "text")
        super().__init__(source, channels, texts=tuple(c.name for c in every if c not in channels))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        from pyarrow import csv as arrow_csv

        misshaped: list[Any] = []

        def refuse(row: Any) -> str:
            misshaped.append(row)
            return "skip" if len(misshaped) == 1 else "error"

        d = self.dialect
        plain = d.encoding in ("utf-8", "utf-8-sig")
        options = {
            "read_options": arrow_csv.ReadOptions(
                column_names=list(self._kinds),
                skip_rows=d.skip,
                block_size=1 << 23,
                encoding="utf8" if plain else d.encoding,
            ),
            "parse_options": arrow_csv.ParseOptions(delimiter=d.delimiter, invalid_row_handler=refuse),
            "convert_options": arrow_csv.ConvertOptions(
                column_types={n: pa.string() for n in names}, include_columns=list(names)
            ),
        }
        cells, line = Cells(self.source, d.decimal), d.skip + 1
        try:
            with arrow_csv.open_csv(self.source, **options) as reader:
                for batch in reader:
                    table = [
                        (cells.seconds if self._kinds[n] == "stamp" else cells.numbers)(n, batch.column(i), line)
                        for i, n in enumerate(names)
                    ]
                    line += batch.num_rows
                    for begin in range(0, batch.num_rows, PIECE):
                        yield Piece(None, {n: v[begin : begin + PIECE] for n, v in zip(names, table, strict=True)})
        except pa.ArrowInvalid as problem:
            if "Empty CSV file" in str(problem):
                return
            if not misshaped:
                raise edge.InputError(
                    f"{self.source}: it is not a table of numbers ({edge.first_line(problem)})."
                ) from None
        finally:
            self.problems += cells.notes()
        if len(misshaped) == 1 and self._ends_with(misshaped[0].text):
            self.problems.append(f"{self.source}: its last line is incomplete; it was left out.")
        elif misshaped:
            row = misshaped[0]
            with open(self.source, encoding=d.encoding, errors="replace") as file:
                number = next((i for i, text in enumerate(file, start=1) if text.rstrip("\r\n") == row.text), 0)
            where = f"line {number}" if number else edge.shown(row.text)
            raise edge.InputError(
                f"{self.source}: {where}: it has {row.actual_columns} cells, the table {row.expected_columns}."
            )

    def _ends_with(self, text: str) -> bool:
        """Whether a line is the last of the file, without an end of its own."""
        encodings = {"utf-8-sig": ("utf-8",), "utf-16": ("utf-16-le", "utf-16-be")}
        ends = [text.encode(e, "replace") for e in encodings.get(self.dialect.encoding, (self.dialect.encoding,))]
        with Path(self.source).open("rb") as file:
            file.seek(-min(len(ends[0]), os.stat(self.source).st_size), os.SEEK_END)
            return file.read() in ends


class ParquetFile(BenchFile):
    """A Parquet file.

    Raises
    ------
    edge.InputError
        If it unpacks to more than `edge.most_unpacked`.
    """

    def __init__(self, source: str, dbc: object = None) -> None:
        from pyarrow import parquet

        self._file = parquet.ParquetFile(source)
        size, most = (
            8 * self._file.metadata.num_rows * self._file.metadata.num_columns,
            edge.most_unpacked(source, False),
        )
        if size > most:
            raise edge.InputError(f"{source}: it unpacks to {size / 1e6:.0f} MB; at most are read {most / 1e6:.0f} MB.")
        self._names, channels = {}, []
        for number, part in enumerate(self._file.schema_arrow):
            stamps = pa.types.is_timestamp(part.type)
            if not (pa.types.is_floating(part.type) or pa.types.is_integer(part.type) or stamps):
                continue
            name, unit = name_and_unit(part.name)
            metadata = part.metadata or {}
            stated = metadata.get(b"unit", metadata.get(b"units", b"")).decode("utf-8", "replace")
            channels.append(RawChannel(name, "s" if stamps else unit or stated))
            self._names[number] = part.name
        super().__init__(source, unique(channels))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        stored = dict(zip((c.name for c in self.channels), self._names.values(), strict=True))
        columns = [stored[n] for n in names]
        begun: dict[str, int] = {}

        def values(name: str, column: pa.Array) -> Array:
            return seconds_of(column, begun, name) if pa.types.is_timestamp(column.type) else numbers_of(column)

        for groups in self._row_groups():
            for batch in self._file.iter_batches(batch_size=PIECE, row_groups=groups, columns=columns):
                yield Piece(None, {n: values(n, batch.column(stored[n])) for n in names})

    def _row_groups(self) -> Iterator[list[int]]:
        """Yield lists of consecutive row groups, each a few pieces long.

        Arrow keeps data in memory until the last requested row group is read: for two hours at 4 kHz half the memory of
        the process.
        """
        groups, rows = [], 0
        for number in range(self._file.num_row_groups):
            groups.append(number)
            rows += self._file.metadata.row_group(number).num_rows
            if rows >= _ROWS:
                yield groups
                groups, rows = [], 0
        if groups:
            yield groups
