"""Text exports of TwinCAT Scope.

The format is that of "Export to csv" in Beckhoff's documentation of TE13xx and of published exports: lines
"Name", "File", "Starttime of export" and "Endtime of export"; a header whose rows each state one property ("Name",
"Unit", "Data-Type", …) of all channels; then the numbers. Channels with one sample time form a group, preceded by a
column with their time, ms since the export's first sample, in which the header has the row names. Groups end at
different rows: missing cells are blank, or the row is shorter.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from cycloid_fmu import edge
from fitting.readers.formats import Array, BenchFile, Piece, RawChannel, unique
from fitting.readers.tables import Cells, CsvFile

_ROWS = 1 << 15  # rows per piece
_START = 1 << 22  # bytes within which the header must end
_PLACE = ("File", "Starttime of export", "Endtime of export")
_FULL_TIME = 1e14  # ms: a larger time is a FILETIME, whose microseconds a float cannot hold
_SCALES = {"Offset": 0.0, "ScaleFactor": 1.0, "Unit ScaleFactor": 1.0, "Unit Offset": 0.0}


def open_table(source: str, dbc: object = None) -> BenchFile:
    """Open a table of text: an export of TwinCAT Scope, or any other."""
    with Path(source).open("rb") as file:
        lines = edge.decoded(file.read(1 << 16), source)[1].split("\n")[:4]
    named = [re.match(r"Name([\t;:,|])", line) for line in lines[:1]]
    if named and named[0] and any(line.startswith(tuple(p + named[0][1] for p in _PLACE)) for line in lines[1:]):
        return ScopeFile(source, named[0][1])
    return CsvFile(source, dbc)


class ScopeFile(BenchFile):
    """A text export of TwinCAT Scope.

    Parameters
    ----------
    source
        The file.
    delimiter
        Delimiter between cells.
    """

    def __init__(self, source: str, delimiter: str) -> None:
        self._delimiter = delimiter
        with Path(source).open("rb") as file:
            self._encoding, text = edge.decoded(file.read(_START), source)
        lines = text.split("\n")  # like the reading below; splitlines() knows more line ends
        begin = next((i for i, line in enumerate(lines) if i > 0 and self._cells(line)[0] == "Name"), None)
        if begin is None:
            raise edge.InputError(f'{source}: this TwinCAT Scope export has no row "Name" in its header.')
        header: dict[str, list[str]] = {}
        end = begin
        while end < len(lines) and lines[end].strip() and not re.match(r"[-+\d]", lines[end]):
            cells = self._cells(lines[end])
            header[cells[0]] = cells
            end += 1
        while end < len(lines) and not lines[end].strip():
            end += 1
        self._skip = end
        names = header["Name"]
        self._width = len(names)
        times = [i for i, cell in enumerate(names) if cell == "Name"]
        first = lines[end : end + 50]
        if any(len(self._cells(line)) > self._width for line in first):
            raise edge.InputError(
                f"{source}: its rows have more cells than its header; export it with a separator that is not the "
                "decimal mark and does not occur in names."
            )
        if first and max(len(self._cells(line)) for line in first) < self._width:
            raise edge.InputError(f"{source}: its rows have fewer cells than its header; export it with time columns.")
        self._decimal = "," if delimiter != "," and any("," in line for line in first) else "."
        owners = {i: max(t for t in times if t <= i) for i in range(self._width)}
        columns = [i for i in range(self._width) if i not in times]
        self._scaled = {i for i in columns if self._scale_of(header, i)}
        units = header.get("Unit", [])
        channels = unique([RawChannel(names[i], self._unit(units, i)) for i in columns])
        self._places = {c.name: (owners[i], i) for c, i in zip(channels, columns, strict=True)}
        super().__init__(source, channels, timed=True)
        if not channels:
            raise edge.InputError(f"{source}: this TwinCAT Scope export has no channels.")

    def _cells(self, line: str) -> list[str]:
        return line.rstrip("\r\n").split(self._delimiter)

    def _unit(self, units: Sequence[str], column: int) -> str:
        """Return the symbol of a unit, which is followed by its quantity: "dV (Voltage)", "(None)"."""
        return "" if column >= len(units) else units[column].partition("(")[0].strip()

    def _scale_of(self, header: dict[str, list[str]], column: int) -> bool:
        """Return whether Scope has a scale or offset for a channel; the file does not state whether it is applied."""
        for row, neutral in _SCALES.items():
            cells = header.get(row, [])
            if len(cells) == self._width:
                try:
                    if float(cells[column].replace(",", ".")) != neutral:
                        return True
                except ValueError:
                    continue
        return False

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time, group by group."""
        groups: dict[int, list[str]] = {}
        for name in names:
            groups.setdefault(self._places[name][0], []).append(name)
            if self._places[name][1] in self._scaled:
                self.problems.append(
                    f"{self.source}: {name} has a scale in TwinCAT Scope; the file does not state whether it was "
                    'exported with "Scale values before export", which is assumed.'
                )
        wanted = {i: "the time" for i in groups} | {self._places[n][1]: n for n in names}
        number, cells = self._skip, Cells(self.source, self._decimal)
        with open(self.source, encoding=self._encoding, errors="strict", newline="\n") as file:
            lines = itertools.islice(file, self._skip, None)
            while True:
                try:
                    rows = list(itertools.islice(lines, _ROWS))
                except UnicodeDecodeError as problem:
                    raise edge.InputError(f"{self.source}: its text is damaged ({problem.reason}).") from None
                if not rows:
                    self.problems += cells.notes()
                    return
                table = self._numbers(rows, number, wanted, cells)
                number += len(rows)
                for time, members in groups.items():
                    there = ~np.isnan(table[time])
                    if not there.any():
                        continue
                    if (table[time][there] > _FULL_TIME).any():
                        raise edge.InputError(
                            f'{self.source}: its times are full time stamps; export it without "Full Timestamp".'
                        )
                    values = {n: table[self._places[n][1]][there] for n in members}
                    yield Piece(table[time][there] * 1e-3, values)

    def _numbers(self, rows: list[str], number: int, wanted: Mapping[int, str], cells: Cells) -> dict[int, Array]:
        """Return the wanted columns of some rows, NaN for blank cells."""
        from pyarrow import csv as arrow_csv

        if rows[-1].strip() == "EOF":
            rows = rows[:-1]
        elif not rows[-1].endswith("\n"):
            self.problems.append(f"{self.source}: its last line is incomplete; it was left out.")
            rows = rows[:-1]
        padded = []
        for i, row in enumerate(rows):
            line = row.rstrip("\r\n")
            lacking = self._width - 1 - line.count(self._delimiter)
            if lacking < 0:
                raise edge.InputError(
                    f"{self.source}: line {number + i + 1}: it has {self._width - lacking} cells, the header "
                    f"{self._width}."
                )
            padded.append(line + lacking * self._delimiter)
        if not padded:
            return {i: np.zeros(0) for i in wanted}
        columns = [str(i) for i in range(self._width)]
        chosen = [str(i) for i in wanted]
        try:
            table = arrow_csv.read_csv(
                io.BytesIO("\n".join(padded).encode()),
                read_options=arrow_csv.ReadOptions(column_names=columns, block_size=1 << 26),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=self._delimiter, quote_char=False, ignore_empty_lines=False
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=dict.fromkeys(chosen, pa.string()), include_columns=chosen
                ),
            )
        except pa.ArrowException:
            raise edge.InputError(
                f"{self.source}: lines {number + 1} to {number + len(rows)} are not a table of numbers."
            ) from None
        return {i: cells.numbers(name, table.column(str(i)).combine_chunks(), number + 1) for i, name in wanted.items()}
