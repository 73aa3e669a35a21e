"""Files of measurement loggers: ASAM MDF 4 and LabVIEW TDMS."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from fitting.readers.formats import PIECE, Array, BenchFile, Piece, RawChannel, in_order, unique
from fitting.readers.formulas import Formula


def _drop(problem: BaseException | None) -> None:
    """Free the remains of a failed constructor, without errors from its destructor."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        while problem is not None:
            problem.__traceback__, problem = None, problem.__context__
        gc.collect(1)  # new objects are in the young generations
    finally:
        sys.unraisablehook = hook


class MdfFile(BenchFile):
    """An ASAM MDF 4 file."""

    def __init__(self, source: str, dbc: object = None) -> None:
        with edge.needs_extra("bench-files", lambda text: edge.InputError(f"{source}: {text}.")):
            from asammdf import MDF
        try:
            # Given a name, asammdf reads in C, which trusts the block sizes of damaged files; given an open file, not.
            self._open = Path(source).open("rb")  # noqa: SIM115
            # Attachments are not read: they may name other files.
            self._mdf = MDF(self._open, process_bus_logging=False)
        except Exception as problem:  # asammdf raises any kind of exception
            reason = edge.first_line(problem)
            _drop(problem)
            raise edge.InputError(
                f"{source}: this is not an MDF file, or it is truncated or damaged ({reason})."
            ) from None
        channels, self._places, refused = [], [], []
        self._conversions: dict[tuple[int, int], Callable[[Any], Any]] = {}
        self._masters: dict[int, Formula] = {}
        for index, group in enumerate(self._mdf.groups):
            master = self._mdf.masters_db.get(index)
            if master is not None and (reason := self._time_of(index, group.channels[master])):
                refused.append(f"{source}: {reason}")
                continue
            for number, channel in enumerate(group.channels):
                if number == master:
                    continue
                try:
                    _check_within(channel, group.channel_group)
                    self._conversions[index, number] = _conversion(channel)
                except ValueError as problem:
                    refused.append(f'{source}: the channel "{channel.name}" is left out: {problem}.')
                    continue
                channels.append(RawChannel(channel.name, channel.unit or ""))
                self._places.append((channel.name, index, number))
        super().__init__(source, unique(channels), timed=True)
        self.problems += refused

    def _time_of(self, index: int, master: Any) -> str:
        """Remove a formula from a group's time channel; return the reason if the group can't be read, else ""."""
        conversion = master.conversion
        try:
            _check_within(master, self._mdf.groups[index].channel_group)
            if conversion is None:
                return ""
            if text := _formula_text(conversion):
                self._masters[index], master.conversion = _formula(text), None
            elif _nests_formula(conversion):
                raise ValueError("its conversion has a formula within a table")
            elif not _is_v4(conversion) and conversion.conversion_type not in _V3_TIME:
                raise ValueError("its conversion is not linear")
        except ValueError as problem:
            return f'the channels with the time "{master.name}" are left out: {problem}.'
        return ""

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        places = {c.name: p for c, p in zip(self.channels, self._places, strict=True)}
        groups: dict[int, list[str]] = {}
        for name in names:
            groups.setdefault(places[name][1], []).append(name)
        yield from in_order([self._group(index, members, places) for index, members in groups.items()])

    def _group(self, index: int, names: Sequence[str], places: dict[str, tuple[str, int, int]]) -> Iterator[Piece]:
        group = self._mdf.groups[index]
        stated, held = group.channel_group.cycles_nr, _records_held(group, os.stat(self.source).st_size)
        total, begin = min(stated, held), 0
        if held < stated:
            self.problems.append(f"{self.source}: it is truncated or damaged; it has {held} of {stated} samples.")
        while begin < total:
            try:
                signals = [self._mdf.get(*places[n], record_offset=begin, record_count=PIECE, raw=True) for n in names]
                got = min(len(s.timestamps) for s in signals)
                values = {n: self._converted(places[n], s.samples[:got]) for n, s in zip(names, signals, strict=True)}
                time = np.asarray(signals[0].timestamps[:got], float) if got else np.zeros(0)
            except Exception as problem:
                why = edge.first_line(problem)
                self.problems.append(
                    f"{self.source}: it is truncated or damaged after {begin} of {total} samples ({why})."
                )
                return
            if got:
                yield Piece(self._masters[index](time) if index in self._masters else time, values)
            begin += got
            if got < min(PIECE, total - begin + got):
                self.problems.append(f"{self.source}: it is truncated after {begin} of {total} samples.")
                return

    def _converted(self, address: tuple[str, int, int], raw: Any) -> Array:
        return np.asarray(self._conversions[address[1:]](raw), float)


def _check_within(channel: Any, group: Any) -> None:
    """Refuse a channel outside its group's records: asammdf's C code would read beyond them."""
    first = 8 * channel.byte_offset + channel.bit_offset if hasattr(channel, "byte_offset") else channel.start_offset
    first += 8 * getattr(channel, "additional_byte_offset", 0)
    marked = getattr(channel, "flags", 0) & _MAY_BE_INVALID
    within, marks = 8 * group.samples_byte_nr, 8 * getattr(group, "invalidation_bytes_nr", 0)
    if first + channel.bit_count > within or (marked and channel.pos_invalidation_bit >= marks):
        raise ValueError("it is outside its records")


def _records_held(group: Any, size: int) -> int:
    """Return the number of records that a group has in a file of this size, bytes: asammdf makes up missing ones."""
    blocks = list(group.get_data_blocks())
    held = sum(
        min(b.original_size, max(0, size - b.address)) if b.block_type == b.location == 0 else b.original_size
        for b in blocks
    )
    record = group.channel_group.samples_byte_nr
    if not any(b.invalidation_block for b in blocks):
        record += getattr(group.channel_group, "invalidation_bytes_nr", 0)
    return int(held // max(record, 1))


_MAY_BE_INVALID = 2  # ASAM's flag of a channel with an invalidation bit
_V4_FORMULA, _V3_FORMULA = 3, 10  # ASAM's numbers of conversion types
_V4_TEXTS, _V3_TEXTS = (7, 8), (11, 12)
_V3_TIME = (0, 65535)  # linear, none


def _is_v4(conversion: Any) -> bool:
    return bool(conversion.id == b"##CC")


def _formula_text(conversion: Any) -> str:
    """Return the formula of a conversion, "" if it has none."""
    formula = _V4_FORMULA if _is_v4(conversion) else _V3_FORMULA
    return (str(conversion.formula) or "nothing") if conversion.conversion_type == formula else ""


def _formula(text: str) -> Formula:
    try:
        return Formula(text)
    except ValueError as problem:
        raise ValueError(f"its conversion, the formula {edge.shown(text)}, can't be computed: {problem}") from None


def _nests_formula(conversion: Any, depth: int = 0) -> bool:
    """Return whether a conversion's table refers to a formula, or is nested too deeply."""
    below = [c for c in (getattr(conversion, "referenced_blocks", None) or {}).values() if hasattr(c, "convert")]
    return depth > 4 or any(_formula_text(c) or _nests_formula(c, depth + 1) for c in below)


def _conversion(channel: Any) -> Callable[[Any], Any]:
    """Return the function from a channel's raw to physical values; asammdf would pass formulas to Python's `eval`.

    If the channel has a unit, text in place of a number becomes NaN.

    Raises
    ------
    ValueError
        If it is a formula that can't be computed here.
    """
    conversion = channel.conversion
    if conversion is None:
        return np.asarray
    if text := _formula_text(conversion):
        return _formula(text)
    if _nests_formula(conversion):
        raise ValueError("its conversion has a formula within a table")
    texts = _V4_TEXTS if _is_v4(conversion) else _V3_TEXTS
    keep = not (conversion.conversion_type in texts and channel.unit)

    def convert(raw: Any) -> Any:
        values = conversion.convert(raw, ignore_value2text_conversions=keep)
        return np.full(len(values), np.nan) if not keep and values.dtype.kind in "SU" else values

    return convert


# Scales that npTDMS computes; for others it returns raw numbers.
_SCALES = frozenset(
    {"Add", "AdvancedAPI", "Linear", "Polynomial", "RTD", "Strain", "Subtract", "Table", "Thermistor", "Thermocouple"}
)
_SCALE_TYPE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_MOST_SCALES = 100


def _unknown_scale(*properties: Mapping[str, Any]) -> str:
    """Return the first unsupported scale of a TDMS channel, its group or its file, or "" if there is none."""
    for stated in properties:
        if stated.get("NI_Scaling_Status") == "scaled":
            continue
        if int(stated.get("NI_Number_Of_Scales", 0)) > _MOST_SCALES:
            return f"{stated['NI_Number_Of_Scales']} scales"
        for key, kind in stated.items():
            if _SCALE_TYPE.fullmatch(key) and kind not in _SCALES:
                return f"the scale {edge.shown(kind)}"
    return ""


class TdmsFile(BenchFile):
    """A LabVIEW TDMS file."""

    def __init__(self, source: str, dbc: object = None) -> None:
        with edge.needs_extra("bench-files", lambda text: edge.InputError(f"{source}: {text}.")):
            from nptdms import TdmsFile
        self._file = TdmsFile.open(source)
        self._found, refused = [], []
        for group in self._file.groups():
            for channel in group.channels():
                if kind := _unknown_scale(channel.properties, group.properties, self._file.properties):
                    refused.append(f'{source}: the channel "{channel.name}" is left out: {kind} is not supported.')
                elif channel.dtype is not None and np.issubdtype(channel.dtype, np.number):
                    self._found.append(channel)
        units = [str(c.properties.get("unit_string", c.properties.get("unit", ""))) for c in self._found]
        channels = [RawChannel(c.name, u) for c, u in zip(self._found, units, strict=True)]
        timed = bool(self._found) and all(c.properties.get("wf_increment") for c in self._found)
        super().__init__(source, unique(channels), timed=timed)
        self.problems += refused
        status = getattr(self._file, "file_status", None)
        if status is not None and status.incomplete_final_segment:
            self.problems.append(
                f"{source}: it is truncated; its last segment is incomplete, and the data up to its end were read."
            )

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        places = dict(zip((c.name for c in self.channels), self._found, strict=True))
        if not self.timed:  # one clock for all: a channel is the time
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
