"""Tables of numbers: CSV in its dialects, and Parquet."""

from __future__ import annotations

import codecs
import csv
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cycloid_fmu import edge
from fitting.recordings.formats import PIECE, BenchFile, Piece, RawChannel, name_and_unit, numbers_of, unique, unit_text

_NUMERIC = re.compile(r"\s*[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?\s*")
_ROWS = 4 * PIECE  # rows of a Parquet file read together
_NOT_A_NUMBER = {"", "nan", "inf", "-inf", "n/a", "na", "null"}


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
        Number of lines before the first row of numbers.
    """

    encoding: str
    delimiter: str
    decimal: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    skip: int


def decoded_start(data: bytes, source: str) -> tuple[str, str]:
    """Return encoding and text of a table's first bytes, by the byte order mark, else UTF-8, else Windows-1252."""
    for mark, encoding in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if data.startswith(mark):
            return encoding, codecs.getincrementaldecoder(encoding)(errors="replace").decode(data)
    if b"\0" in data:
        raise edge.InputError(f"{source}: this is not a text table; it contains zero bytes.")
    for encoding in ("utf-8", "cp1252"):
        try:
            return encoding, codecs.getincrementaldecoder(encoding)().decode(data)
        except UnicodeDecodeError:
            continue
    raise edge.InputError(f"{source}: this is not a text table; its encoding is none of UTF-8, UTF-16, Windows-1252.")


def _is_number(cell: str) -> bool:
    return bool(_NUMERIC.fullmatch(cell)) or cell.strip().lower() in _NOT_A_NUMBER


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
    encoding, text = decoded_start(data, source)
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith(("\n", "\r")):
        lines = lines[:-1]  # the last line may be incomplete
    if not any(line.strip() for line in lines):
        raise edge.InputError(f"{source}: the file is empty.")
    candidates = []
    for delimiter in (";", "\t", "|", ","):
        rows = [next(csv.reader([line], delimiter=delimiter), []) for line in lines[:200]]
        for first, row in enumerate(rows):
            if len(row) > 1 and all(_is_number(c) for c in row) and any(_NUMERIC.fullmatch(c) for c in row):
                candidates.append((first, delimiter, rows))
                break
    # Choose the delimiter whose rows of numbers begin first; a comma would split "1,5;2,5" into numbers and text.
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
        edge.parse_unit(text)
    except ValueError:
        return False
    return True


class CsvFile(BenchFile):
    """A text table with comma, semicolon, tab or bar between cells."""

    def __init__(self, source: str, dbc: object = None) -> None:
        with Path(source).open("rb") as file:
            start = file.read(1 << 16)
        self.dialect = find_dialect(start, source)
        named = zip(self.dialect.header, self.dialect.units, strict=True)
        super().__init__(source, unique([RawChannel(n, u) for n, u in named]))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        columns = [c.name for c in self.channels]
        truncated: list[str] = []

        def short_row(row: Any) -> str:
            truncated.append(row.text)
            return "skip" if len(truncated) == 1 else "error"

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
                    table = [numbers_of(batch.column(i)) for i in range(len(names))]
                    for begin in range(0, batch.num_rows, PIECE):
                        yield Piece(None, {n: v[begin : begin + PIECE] for n, v in zip(names, table, strict=True)})
        except pa.ArrowInvalid as problem:
            if "Empty CSV file" in str(problem):
                return
            raise edge.InputError(f"{self.source}: {self._first_bad_cell(names, problem)}") from None
        if truncated:
            with Path(self.source).open("rb") as file:
                file.seek(-1, os.SEEK_END)
                whole = file.read(1) in b"\r\n"
            if whole:
                raise edge.InputError(f"{self.source}: {self._first_bad_cell(names, ValueError(truncated[0]))}")
            self.problems.append(f"{self.source}: its last line is incomplete; it was left out.")

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
                        word, given = "point" if d.decimal == "." else "comma", edge.shown(cell or "")
                        return f"line {number}: {name} is {given}; it must be a number with a decimal {word}."
                if len(row) != len(self.channels):
                    return f"line {number}: it has {len(row)} cells, the header {len(self.channels)}."
        return f"it is not a table of numbers ({edge.first_line(problem)})."


class ParquetFile(BenchFile):
    """A Parquet file."""

    def __init__(self, source: str, dbc: object = None) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        self._file = parquet.ParquetFile(source)
        self._names, channels = {}, []
        for number, part in enumerate(self._file.schema_arrow):
            if not (pa.types.is_floating(part.type) or pa.types.is_integer(part.type)):
                continue
            name, unit = name_and_unit(part.name)
            metadata = part.metadata or {}
            stated = metadata.get(b"unit", metadata.get(b"units", b"")).decode("utf-8", "replace")
            channels.append(RawChannel(name, unit or stated))
            self._names[number] = part.name
        super().__init__(source, unique(channels))

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        stored = dict(zip((c.name for c in self.channels), self._names.values(), strict=True))
        columns = [stored[n] for n in names]
        for groups in self._row_groups():
            for batch in self._file.iter_batches(batch_size=PIECE, row_groups=groups, columns=columns):
                yield Piece(None, {n: numbers_of(batch.column(stored[n])) for n in names})

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
