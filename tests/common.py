"""Shared by several tests: the data, the 39/40 pair and field units."""

import importlib
import inspect
import json
import os
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from cycloid_fmu.geometry.pair import parse_pair

DATA = Path(__file__).parent / "data"
CASES = DATA / "reference-cases"
BENCH = DATA / "reference-bench"
EXAMPLES = Path(__file__).parent.parent / "examples"
ARCSEC = np.pi / 648000
MEASURED = Path(os.environ.get("CYCLOID_MEASURED_DRIVES", Path(__file__).parents[2] / "shared" / "measured-drives"))
"""Folder of measured drives, which are not part of the project."""
MOTOR_MAPPING = """format = "cycloid-mapping/1"
[time]
column = "TIME"
unit = "s"
[output_angle]
column = "POSITION"
unit = "rev"
[torque]
column = "TORQUE"
unit = "N*m"
"""

PAIR = """format = "cycloid-pair/1"
[pair]
gear_teeth = 39
pins = 40
pin_circle_radius = "64 mm"
pin_radius = "3 mm"
eccentricity = "1.3 mm"
face_width = "10 mm"
"""
# The wear paper's pair, its modifications with the signs that give clearance.
WEAR_PAIR = PAIR.replace("64 mm", "66 mm") + '[modification]\noffset = "-50 um"\nisometric = "-30 um"\n'


def study_size(name, short, full):
    """Size of a study: the environment variable's value, or else the full one with CYCLOID_FULL=1, or the short one."""
    return int(float(os.environ.get(name, full if os.environ.get("CYCLOID_FULL") else short)))


def draws(short, full, seconds, **strategies):
    """Draw a property's values `short` times in the default set and, in `seconds`, `full` times in the slow one."""

    def decorate(check):
        fixtures = [name for name in inspect.signature(check).parameters if name not in strategies]

        @pytest.mark.parametrize("examples", [short, pytest.param(full, marks=pytest.mark.slow(seconds))])
        def test(examples, request):
            values = {name: request.getfixturevalue(name) for name in fixtures}

            def drawn_once(**drawn):
                check(**values, **drawn)

            drawn_once.__name__ = check.__name__
            settings(max_examples=examples)(given(**strategies)(drawn_once))()

        test.__name__, test.__doc__ = check.__name__, check.__doc__
        return test

    return decorate


def make_pair(text=PAIR, **keys):
    """The error-free 39/40 pair with other keys of its [pair] table."""
    lines = text.splitlines()
    at = lines.index("[pair]") + 1
    for key, value in keys.items():
        lines = [line for line in lines if not line.startswith(f"{key} =")]
        lines.insert(at, f"{key} = {json.dumps(value)}")
    return parse_pair("\n".join(lines) + "\n", "test.toml")


def resolved(name):
    """The object of a dotted name; of a function and a module of one name the function, as in Python."""
    first, *parts = name.split(".")
    found = importlib.import_module(first)
    for part in parts:
        if not hasattr(found, part):
            importlib.import_module(f"{found.__name__}.{part}")
        found = getattr(found, part)
    return found


_TOKEN = re.compile(rb"[-+.\w]+")
_ODD = (
    b"",
    b"nan",
    b"-inf",
    b"1e999",
    b"1e-320",
    b"-1",
    b"0",
    b"9" * 400,
    b"1e18",
    b"0x",
    b"true",
    b"null",
    b"{}",
    b"[" * 2000,
    b'"',
    b"\\u0000",
    b"\n",
    b"\0",
    b"\xff\xfe",
    "٣".encode(),
    b"../..",
    b"%s{0}",
    b"1" + b"0" * 20,
    b"1e308",
    b"-1e308",
    b".1e308",
)


def damaged(random, data):
    """Other bytes, mostly those of a file: bits flip, bytes come and go, stretches move, words become others."""
    data = bytearray(data)
    longest = np.log2(max(2, min(1024, len(data) // 16)))
    for _ in range(random.choice([1, 1, 1, 2, 3])):
        kind, at = int(random.integers(0, 10)), int(random.integers(0, len(data) + 1))
        length = int(2 ** random.uniform(0, longest))
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << int(random.integers(0, 8))
        elif kind == 1 and random.integers(3) == 0:
            del data[at:]
        elif kind == 2:
            data[at:at] = random.bytes(min(length, 8))
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            begin = int(random.integers(0, len(data) + 1))
            data[at:at] = data[begin : begin + length]
        elif kind == 5:  # lengths, offsets and counts lie at multiples of four
            number = random.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, random.integers(0, 1 << 32)])
            data[at // 4 * 4 : at // 4 * 4 + 4] = int(number).to_bytes(4, "little")
        elif found := _TOKEN.search(data, at):
            word = random.integers(0, len(_ODD))
            data[found.start() : found.end()] = _ODD[word]
    return bytes(data)


def lengths_of(text):
    """The lengths in the text of a pair file, m, as exact decimal numbers."""
    scale = {"m": 0, "mm": -3, "um": -6}
    return [Decimal(number).scaleb(scale[unit]) for number, unit in re.findall(r'"([-+.\de]+) (m|mm|um)"', text)]
