"""Errors as a pair file's `[errors]` states them, checked against the kinds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import ErrorKind, by_file_key

_EACH_DISC = ("tooth", "hole", "eccentric", "roller_hole")
_ORDER = re.compile(r"order_([1-9]\d{0,8})")


def limited(value: float, kind: ErrorKind) -> float:
    """Return the value of an error, m or rad; raise a `ValueError` if its magnitude exceeds the kind's limit."""
    if abs(value) > kind.limit:
        if kind.unit == "rad":
            raise ValueError("misalignments must be between -20 mrad and 20 mrad")
        raise ValueError("modifications and errors must be between -1 mm and 1 mm")
    return value


def _quantity(value: object, unit: str, in_file: bool) -> float:
    return edge.parse_quantity(value, unit) if in_file else edge.quantity(value, unit)


def _orders(table: Mapping[Any, Any], kind: ErrorKind, in_file: bool) -> dict[int, tuple[float, float]]:
    found = {}
    for key, entry in table.items():
        match = _ORDER.fullmatch(f"order_{key}" if isinstance(key, int) else str(key))
        if match is None:
            raise ValueError(f'the key "{key}" is unknown; orders are written order_1 = ["3 um", "40 deg"]')
        if not isinstance(entry, list | tuple) or len(entry) != 2:
            raise ValueError(f'{key} needs an amplitude and a phase, such as ["3 um", "40 deg"]')
        try:
            amplitude = limited(_quantity(entry[0], "m", in_file), kind)
            phase = _quantity(entry[1], "rad", in_file)
        except ValueError as problem:
            raise ValueError(f"{key}: {problem}") from None
        found[int(match[1])] = (amplitude, phase)
    # Sorted by order: a sum in another sequence would differ in its last bit.
    return dict(sorted(found.items()))


def _each(values: Any, kind: ErrorKind, in_file: bool) -> tuple[float, ...]:
    found = []
    for index, value in enumerate(values):
        try:
            found.append(limited(_quantity(value, kind.unit, in_file), kind))
        except ValueError as problem:
            raise ValueError(f"value {index} ({value!r}): {problem}") from None
    return tuple(found)


def _value(given: Any, kind: ErrorKind, in_file: bool) -> Any:
    """Check and return one stated error: a number, {order: (amplitude, phase)}, one value each, or a list per disc."""
    if kind.of == "drive":
        return limited(_quantity(given, kind.unit, in_file), kind)
    if isinstance(given, Mapping) and not kind.of_supports:
        return _orders(given, kind, in_file)
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if isinstance(given, list | tuple):
        lists = [isinstance(v, list | tuple) for v in given]
        if kind.of in _EACH_DISC and lists and all(lists):
            return tuple(_each(v, kind, in_file) for v in given)
        if not any(lists) and kind.of not in _EACH_DISC[1:]:
            return _each(given, kind, in_file)
    if kind.of_supports:
        where = "a list for each disc" if kind.of in _EACH_DISC else "a list"
        raise ValueError(f"write {where}, with one {'angle' if kind.unit == 'rad' else 'length'} each")
    raise ValueError('write a list of lengths or orders such as { order_1 = ["3 um", "40 deg"] }')


def _is_none(stated: Any) -> bool:
    """Whether a stated error is zero: the number 0, no waves, an empty list, or only zeros for each disc."""
    return stated in (0.0, (), {}) or (
        isinstance(stated, tuple) and all(isinstance(row, tuple) and not any(row) for row in stated)
    )


class Errors(Mapping[str, Any]):
    """The stated errors of a drive, by their keys in a pair file; others are zero.

    A kind with one value has a float (m or rad); one of pins or teeth has {order: (amplitude, phase)}, a tuple with one
    value each, or for teeth one such tuple for each disc. `errors.pin_radius` is the value, zero or () if not stated.
    Immutable, equal by value.

    Parameters
    ----------
    stated
        Values as above, in SI units or as text with a unit.
    source
        Their file, in which each quantity must be text with a unit; None for values from Python.

    Raises
    ------
    edge.InputError
        One sentence for each unknown key or value out of range.
    """

    __slots__ = ("_values",)

    def __init__(self, stated: Mapping[str, Any] | None = None, source: str | None = None) -> None:
        kinds = by_file_key()
        where = f"{source}: [errors] " if source is not None else "errors: "
        values, problems = {}, []
        flat = dict(stated or {})
        held = flat.pop("supports", {})
        if not isinstance(held, Mapping):
            raise edge.InputError(f"{where}supports = {edge.shown(held)}: it must be a table, [errors.supports].")
        for key in (*held, *flat):
            in_supports = key in kinds and kinds[key].of_supports
            if key in held and key in kinds and not in_supports:
                problems.append(f"{where}{key} belongs in [errors], not in [errors.supports].")
            if key in flat and in_supports and source is not None:
                problems.append(f"{where}{key} belongs in [errors.supports].")
        for key, given in ({} if problems else {**flat, **held}).items():
            if key not in kinds:
                hint = edge.did_you_mean(str(key), kinds) or "check its spelling or remove it."
                problems.append(f"{where}{key} is not a known key; {hint}")
                continue
            try:
                values[key] = _value(given, kinds[key], source is not None)
            except ValueError as problem:
                problems.append(f"{where}{key} = {edge.shown(given)}: {problem}.")
        if problems:
            raise edge.InputError("\n".join(problems))
        # A stated zero is the same drive as an error that is not stated, and -0 is 0.
        kept = {key: values[key] for key in kinds if key in values and not _is_none(values[key])}
        object.__setattr__(self, "_values", kept)

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __getattr__(self, key: str) -> Any:
        kinds = by_file_key()
        if key.startswith("_") or key not in kinds:
            raise AttributeError(key)
        return self._values.get(key, 0.0 if kinds[key].of == "drive" else ())

    def __setattr__(self, key: str, value: Any) -> None:
        raise AttributeError(f"{key}: errors can't be changed; make others with replace")

    def __reduce__(self) -> Any:
        return (Errors, (self._values,))

    def __hash__(self) -> int:
        return hash(repr(self._values))

    def __repr__(self) -> str:
        return f"Errors({self._values})"


def values_of(kind: ErrorKind, stated: Any, shape: tuple[int, ...]) -> NDArray[np.float64] | float:
    """Return the values of a kind stated as in `Errors`, in its shape for a pair, m or rad."""
    if kind.of == "drive":
        return float(stated)
    if kind.of in _EACH_DISC and isinstance(stated, tuple) and stated and isinstance(stated[0], tuple):
        return np.array(stated, dtype=float)
    return np.broadcast_to(_one_circle(stated, shape[-1]), shape).copy()


def _one_circle(stated: Any, count: int) -> NDArray[np.float64]:
    """Values around one circle, shape (count,), m or rad, from {order: (amplitude, phase)} or one value each."""
    if isinstance(stated, Mapping):
        index = np.arange(count)
        waves = [a * np.cos(2.0 * np.pi * k * index / count - phase) for k, (a, phase) in stated.items()]
        return np.asarray(np.sum(waves, axis=0)) if waves else np.zeros(count)
    return np.array(stated, dtype=float) if len(stated) else np.zeros(count)
