"""Values of a pair file that a sweep varies: their names, ranges, and the resulting drives."""

from __future__ import annotations

import functools
import re
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import Config
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.geometry.pair import Pair, pair_of_tables
from cycloid_fmu.geometry.temperature import BODIES
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, surface_of_pair

_NUMBER = r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
_UNIT = r"(?:\s+(?P<unit>\S.*)|(?P<close>[^\W\d].*|°.*))?"
_RANGE = re.compile(rf"(?P<first>{_NUMBER}):(?P<last>{_NUMBER}):(?P<count>\d{{1,7}}){_UNIT}")
_LIST = re.compile(rf"(?P<each>{_NUMBER}(?:\s*,\s*{_NUMBER})*){_UNIT}")
_WAVE = re.compile(r"errors\.(\w+)\.order_[1-9]\d{0,8}")
_FEW, _MOST = 2, 100_000  # values of a range
_TABLES = {"isometric": "modification", "offset": "modification"}  # of names without one, others are in [pair]
_SOURCE = "sweep"
_HOW = 'write a range with its number of values, "2.5:3.5:11 mm", or values, "2.5, 3, 3.5 mm"'


@dataclass(frozen=True)
class Varied:
    """A varied value of a pair file.

    Attributes
    ----------
    name
        As in the file, with the names of its table before it unless that is [pair] or [modification].
    texts
        The values as a file has them, with their unit.
    values
        The same in SI.
    si, unit
        The SI unit, "1" for a number without one, and that of the texts.
    """

    name: str
    texts: tuple[str, ...]
    values: tuple[float, ...]
    si: str
    unit: str


def known_names() -> dict[str, tuple[str, bool]]:
    """Return every number that a pair file can have: {name: (its SI unit, "1" without one; whether it is an integer)}.

    Errors around a circle have a name for each order, which is not listed: `errors.pin_radial.order_2`.
    """
    errors = {f"errors.{kind.file_key}": (kind.unit, False) for kind in KINDS.values() if kind.of == "drive"}
    return {**_drawn_names(), **errors}


@functools.cache
def _drawn_names() -> dict[str, tuple[str, bool]]:
    """Return the numbers of a pair as drawn; error kinds may be added later."""
    found = {"temperature": ("K", False)}
    for name, field in Pair.model_fields.items():
        found |= _numbers(name, field)
    for name in _TABLES:
        found[name] = found.pop(f"modification.{name}")
    del found["pins"]  # one more than the teeth
    return found


def _numbers(name: str, field: Any) -> dict[str, tuple[str, bool]]:
    """Return the numbers in a field, by their dotted names."""
    parts = typing.get_args(field.annotation) if typing.get_origin(field.annotation) else (field.annotation,)
    if isinstance(field.annotation, types.UnionType):
        parts = field.annotation.__args__
    found: dict[str, tuple[str, bool]] = {}
    for part in parts:
        part = typing.get_args(part)[0] if hasattr(part, "__metadata__") else part
        if isinstance(part, type) and issubclass(part, Config):
            for below, one in part.model_fields.items():
                found |= _numbers(f"{name}.{below}", one)
        elif part in (int, float):
            found[name] = (edge.unit_of_field(field) or "1", part is int)
    return found


def varied(name: str, given: str | Iterable[float | str]) -> Varied:
    """Return one varied value.

    Parameters
    ----------
    name
        A name of `known_names`, `errors.pin_radial.order_2` for the amplitude of such an error, or `temperature` for
        that of all bodies.
    given
        "2.5:3.5:11 mm", eleven values with both ends, "2.5, 3, 3.5 mm" or "2.5 mm, 3 mm, 3.5 mm", or a sequence of
        SI numbers and texts with units.

    Raises
    ------
    edge.InputError
        If there is no such value, or these are invalid.
    """
    known = known_names()
    name = name.removeprefix("pair.").removeprefix("modification.")
    wave = _WAVE.fullmatch(name)
    of_waves = {kind.file_key: kind.unit for kind in KINDS.values() if kind.waves}
    if name not in known and not (wave and wave[1] in of_waves):
        if name == "pins":
            raise edge.ArgumentError("vary", "pins are one more than gear_teeth; vary these", name)
        near = edge.did_you_mean(name, known)
        raise edge.ArgumentError("vary", f"not a number of a pair file{f'; {near}' if near else ''}", name)
    si, whole = (of_waves[wave[1]], False) if wave else known[name]
    try:
        texts, unit = _texts(given, si)
        values = [_value(text, si, whole) for text in texts]
    except ValueError as problem:
        shown = given if isinstance(given, str) else ", ".join(map(str, given))
        raise edge.ArgumentError("vary", str(problem), f"{name}={shown}") from None
    if len(set(values)) != len(values):
        raise edge.ArgumentError("vary", "the values must be different", f"{name}={edge.listed(texts)}")
    if whole:
        texts = [str(int(value)) for value in values]
    return Varied(name, tuple(texts), tuple(values), si, unit)


def _texts(given: str | Iterable[float | str], si: str) -> tuple[list[str], str]:
    """Return the values as a file writes them, and their unit."""
    if not isinstance(given, str):
        texts = [one if isinstance(one, str) else (f"{float(one)!r} {si}" if si != "1" else repr(one)) for one in given]
        if not texts:
            raise ValueError(f"no values; {_HOW}")
        units = {text.split(" ", 1)[1] for text in texts if " " in text}
        return texts, units.pop() if len(units) == 1 else si
    if found := _RANGE.fullmatch(given.strip()):
        if not _FEW <= int(found["count"]) <= _MOST:
            raise ValueError(f"a range has between {_FEW} and {_MOST} values")
        even = np.linspace(float(found["first"]), float(found["last"]), int(found["count"]))
        numbers = [f"{number:.12g}" for number in even]
    elif found := _LIST.fullmatch(given.strip()):
        numbers = [one.strip() for one in found["each"].split(",")]
    else:
        raise ValueError(_HOW)
    unit = (found["unit"] or found["close"] or "").strip()
    if si == "1" and unit:
        raise ValueError("this is a number without a unit")
    if "," in unit:  # each value has its own
        return _texts([one.strip() for one in given.split(",")], si)
    return [f"{number} {unit}".strip() for number in numbers], unit or si


def _value(text: str, si: str, whole: bool) -> float:
    if si != "1":
        try:
            return edge.parse_quantity(text, si)
        except ValueError as problem:
            if str(problem).startswith("write one number"):
                raise ValueError(_HOW) from None
            raise
    value = edge.finite(text, "the value")
    if whole and value != round(value):
        raise ValueError("this takes whole numbers")
    return value


def drive_with(drive: DriveValue, stated: Mapping[str, str]) -> DriveValue:
    """Return the drive with other values of the pair file.

    Parameters
    ----------
    drive
        The drive; its pair states the surface's errors. Form and wear of the elements are kept.
    stated
        {name: the value as a file has it}.

    Raises
    ------
    edge.InputError
        If these values are not a valid drive; one sentence.
    """
    pair, surface = drive.pair, drive.surface
    tables: dict[str, Any] = tomllib.loads(pair.text)
    tables.pop("format")
    for name, text in stated.items():
        if name == "temperature":
            tables[name] = dict.fromkeys(BODIES, text)
            continue
        if name == "gear_teeth":
            tables["pair"].pop("pins")
        *path, key = name.split(".") if "." in name else (_TABLES.get(name, "pair"), name)
        table = tables
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise edge.InputError(f"{name}: the drive states single values of {part}, not its orders.")
        if key.startswith("order_"):
            table[key] = [text, table.get(key, ["", "0 rad"])[1]]
        else:
            si, whole = known_names()[name]
            table[key] = text if si != "1" else int(text) if whole else float(text)
    try:
        made = pair_of_tables(tables, _SOURCE)
        form = {name: getattr(surface, name) for name in DEVIATIONS}
        kept = surface_of_pair(made)
        if any(values is not None for values in form.values()):
            kept = ErrorSurface(made, kept.errors, **form)
        dimensions(made, kept, f"{_SOURCE}: errors")
    except edge.InputError as problem:
        raise edge.InputError(str(problem).splitlines()[0].removeprefix(f"{_SOURCE}: ")) from None
    return DriveValue(made, kept, drive.first_stage)
