"""Files of measurement loggers: ASAM MDF 4 and LabVIEW TDMS."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cycloid_fmu import edge
from fitting.recordings.formats import PIECE, BenchFile, Piece, RawChannel, in_order, unique


def _extra(package: str, extra: str, source: str) -> edge.InputError:
    return edge.InputError(f"{source}: reading this needs the package {package}: pip install 'cycloid-fmu[{extra}]'.")


def _drop(problem: BaseException | None) -> None:
    """Free what a failed constructor left behind, without its destructor's complaints about what it lacks."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        while problem is not None:
            problem.__traceback__, problem = None, problem.__context__
        gc.collect(1)  # what was made a moment ago is young
    finally:
        sys.unraisablehook = hook


class MdfFile(BenchFile):
    """An ASAM MDF 4 file."""

    def __init__(self, source: str, dbc: object = None) -> None:
        try:
            from asammdf import MDF
        except ImportError:
            raise _extra("asammdf", "bench-files", source) from None
        try:
            self._mdf = MDF(source)
        except Exception as problem:  # asammdf raises whatever its parser meets
            reason = edge.first_line(problem)
            _drop(problem)
            raise edge.InputError(f"{source}: this is not an MDF file, or it is cut or damaged ({reason}).") from None
        channels, self._places = [], []
        for index, group in enumerate(self._mdf.groups):
            master = self._mdf.masters_db.get(index)
            for number, channel in enumerate(group.channels):
                if number != master:
                    channels.append(RawChannel(channel.name, channel.unit or ""))
                    self._places.append((channel.name, index, number))
        super().__init__(source, unique(channels), timed=True)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
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
                why = edge.first_line(problem)
                self.problems.append(f"{self.source}: it is cut or damaged after {begin} of {total} samples ({why}).")
                return
            if got:
                values = {n: np.asarray(s.samples[:got], float) for n, s in zip(names, signals, strict=True)}
                yield Piece(np.asarray(signals[0].timestamps[:got], float), values)
            begin += got
            if got < min(PIECE, total - begin + got):
                self.problems.append(f"{self.source}: it is cut after {begin} of {total} samples.")
                return


class TdmsFile(BenchFile):
    """A LabVIEW TDMS file."""

    def __init__(self, source: str, dbc: object = None) -> None:
        try:
            from nptdms import TdmsFile
        except ImportError:
            raise _extra("npTDMS", "bench-files", source) from None
        self._file = TdmsFile.open(source)
        found = [c for g in self._file.groups() for c in g.channels() if c.dtype is not None]
        self._found = [c for c in found if np.issubdtype(c.dtype, np.number)]
        units = [str(c.properties.get("unit_string", c.properties.get("unit", ""))) for c in self._found]
        channels = [RawChannel(c.name, u) for c, u in zip(self._found, units, strict=True)]
        timed = bool(self._found) and all(c.properties.get("wf_increment") for c in self._found)
        super().__init__(source, unique(channels), timed=timed)
        status = getattr(self._file, "file_status", None)
        if status is not None and status.incomplete_final_segment:
            self.problems.append(f"{source}: it is cut; its last segment is not complete and what it holds was read.")

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        places = dict(zip((c.name for c in self.channels), self._found, strict=True))
        if not self.timed:  # one clock for all: a channel holds the time
            yield from self._chunks([(n, places[n]) for n in names], None)
            return
        bases: dict[tuple[float, float], list[tuple[str, Any]]] = {}
        for name in names:
            properties = places[name].properties
            base = (float(properties.get("wf_start_offset", 0.0)), float(properties["wf_increment"]))
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
