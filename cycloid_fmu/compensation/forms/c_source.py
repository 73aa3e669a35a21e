"""C99 source of a compensator: the step, common to all, and the tables of one drive."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.compensation.compensator import SUPPORT, Compensator
from cycloid_fmu.compensation.forms.numbers import about, arrays, counts, scalars

SOURCES = Path(__file__).with_name("sources")
_TYPES = {np.dtype(np.int8): ("int8_t", "small"), np.dtype(np.int16): ("int16_t", "large")}


def c_source(c: Compensator, name: str) -> tuple[str, str]:
    """Return source and header of a compensator in C99; all its names begin with the given name.

    The header is the same for all drives except for that name; the tables are in the source. Numbers are written so
    that a compiler reads the same bits.
    """
    banner = f"/* {textwrap.fill(f'{about(c)} Made by cycloid-fmu {__version__}.', 112, subsequent_indent='   ')} */\n"
    header, source = ((SOURCES / f"compensator{ending}").read_text(encoding="utf-8") for ending in (".h", ".c"))
    spline = re.search(
        r"/\* Integer coefficients.*?^};\n", (SOURCES / "compensator_numbers.h").read_text("utf-8"), re.S | re.M
    )
    assert spline is not None
    source = _constant(source).replace('#include "compensator_numbers.h"\n', f"{spline[0]}\n{tables_text(c)}")
    header = re.sub(r"\nstruct compensator;.*\n", "", header)
    return banner + _named(source, name), banner + _named(_constant(header), name)


def _constant(text: str) -> str:
    """Return C with the numbers of a drive as constants, not as a structure that is an argument of each function."""
    text = re.sub(r"\(const struct compensator \*c,\s+", "(", text)
    text = re.sub(r"\(c,\s+", "(", text)
    text = text.replace("MOST_FUNCTIONS", "FUNCTIONS")
    return re.sub(r"\bc->(\w+)", lambda number: number[1].upper(), text)


def _named(text: str, name: str) -> str:
    text = text.replace('"compensator.h"', f'"{name}.h"')
    text = re.sub(r"\bcompensator_(?=[a-z])", f"{name}_", text)
    return re.sub(r"\bCOMPENSATOR_(?=[A-Z])", f"{name.upper()}_", text)


def tables_text(c: Compensator) -> str:
    """Return the drive's numbers in C."""
    sizes = counts(c)
    lines = [f"#define {name} {count}" for name, count in sizes.items()]
    lines += [f"#define {name} {_number(value)}" for name, value in scalars(c).items()]
    for name, values in arrays(c).items():
        lines.append(f"static const double {name}[{max(1, values.size)}] = {_list(map(_number, values.ravel()))};")
    splines = []
    for k, steps in enumerate(c.tables.steps):
        kind, member = _TYPES[steps.dtype]
        lines.append(f"static const {kind} STEPS_{k}[{len(steps)}] = {_list(map(str, steps.tolist()))};")
        places = f"STEPS_{k}, 0" if member == "small" else f"0, STEPS_{k}"
        splines.append(f"    {{{places}, {len(steps) - SUPPORT}.0}}")
    body = ",\n".join(splines) or "    {0, 0, 1.0}"
    lines.append(f"static const struct spline SPLINE[{max(1, len(splines))}] = {{\n{body}\n}};")
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Return a number with the fewest digits that read back to the same bits."""
    return repr(float(value)) if value >= 0.0 else f"({float(value)!r})"


def _list(words: Iterable[str]) -> str:
    text = ", ".join(word.strip("()") for word in words) or "0"  # C has no empty arrays
    return "{" + textwrap.fill(text, 118, initial_indent="\n    ", subsequent_indent="    ") + "\n}"
