"""IEC 61131-3 Structured Text of a compensator: a function block with its tables."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.compensation.compensator import SUPPORT, Compensator
from cycloid_fmu.compensation.forms.c_source import SOURCES
from cycloid_fmu.compensation.forms.numbers import about, arrays, counts, scalars
from cycloid_fmu.fmu.constants import REFERENCE_TEMPERATURE

_PLACES = {
    "TORQUE": "TORQUE",
    "TEMPERATURE": "TEMPERATURE",
    "STRIBECK": "STRIBECK_SPEED",
    "WARMTH": "WARMTH_TEMPERATURE",
}


def structured_text(c: Compensator, name: str) -> str:
    """Return a compensator in Structured Text (IEC 61131-3, also its second edition): a named function block.

    Constants begin with ``C_``, tables with ``T_``; blocks that it calls have the same name with a suffix.
    """
    text = (SOURCES / "compensator.st").read_text(encoding="utf-8")
    tables = arrays(c)
    starts, places, rates = {}, np.zeros(0), np.zeros(0)
    for kind, table in _PLACES.items():
        starts[f"{kind}_START"] = places.size
        places = np.append(places, tables.pop(table))
        rates = np.append(rates, tables.pop(f"{kind}_RATE"))
    whole, numbers = counts(c), scalars(c)
    whole.pop("SUPPORT")
    per_period = numbers.pop("PER_PERIOD")
    main = [_whole(n, k) for n, k in {**whole, **starts}.items()]
    main += [_real(n, v) for n, v in numbers.items()]
    main += [_table(n, "LREAL", map(_number, values.ravel())) for n, values in tables.items()]
    filled = {
        "places": "\n".join(_table(n, "LREAL", map(_number, v)) for n, v in (("PLACE", places), ("RATE", rates))),
        "splines": "\n".join([_whole("FUNCTIONS", whole["FUNCTIONS"]), _real("PER_PERIOD", per_period), *_splines(c)]),
        "tables": "\n".join(main),
        "last_function": str(max(0, whole["FUNCTIONS"] - 1)),
        "start_temperature": _number(REFERENCE_TEMPERATURE),
    }
    for place, one in filled.items():
        text = text.replace(f"{{{place}}}", one)
    head = textwrap.fill(f"{about(c)} Made by cycloid-fmu {__version__}.", 112, subsequent_indent="   ")
    return f"(* {head} *)\n" + re.sub(r"\bcompensator(?=_(between|ripple|shares)\b|$| is the)", name, text, flags=re.M)


def _splines(c: Compensator) -> list[str]:
    """Return the coefficients of all splines, those of 8 bits and those of 16 one after the other."""
    made: dict[bool, list[int]] = {True: [], False: []}
    start, knots, small = [], [], []
    for steps in c.tables.steps:
        kind = steps.dtype == np.int8
        start.append(len(made[kind]))
        knots.append(f"{len(steps) - SUPPORT}.0")
        small.append("TRUE" if kind else "FALSE")
        made[kind] += steps.tolist()
    return [
        _table("START", "DINT", map(str, start)),
        _table("KNOTS", "LREAL", knots),
        _table("IS_SMALL", "BOOL", small, "FALSE"),
        _table("SMALL", "SINT", map(str, made[True])),
        _table("LARGE", "INT", map(str, made[False])),
    ]


def _whole(name: str, value: int) -> str:
    return f"  C_{name} : DINT := {value};"


def _real(name: str, value: float) -> str:
    return f"  C_{name} : LREAL := {_number(value)};"


def _table(name: str, kind: str, words: Iterable[str], none: str = "") -> str:
    """Return an array; the language has no empty ones."""
    values = list(words) or [none or ("0.0" if kind == "LREAL" else "0")]
    text = textwrap.fill(", ".join(values), 118, initial_indent="    ", subsequent_indent="    ")
    return f"  T_{name} : ARRAY [0..{len(values) - 1}] OF {kind} := [\n{text}];"


def _number(value: float) -> str:
    """Return a number with the fewest digits that read back to the same bits; the language requires a decimal point."""
    mantissa, _, exponent = repr(float(value)).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{f'E{int(exponent)}' if exponent else ''}"
