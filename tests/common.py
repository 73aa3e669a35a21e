"""What several tests share: the data, the 39/40 pair and field units."""

import importlib
import json
from pathlib import Path

import numpy as np

from cycloid_fmu.geometry.pair import parse_pair

DATA = Path(__file__).parent / "data"
CASES = DATA / "reference-cases"
BENCH = DATA / "reference-bench"
EXAMPLES = Path(__file__).parent.parent / "examples"
ARCSEC = np.pi / 648000

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


def make_pair(text=PAIR, **keys):
    """The error-free 39/40 pair with other keys of its [pair] table."""
    lines = text.splitlines()
    at = lines.index("[pair]") + 1
    for key, value in keys.items():
        lines = [line for line in lines if not line.startswith(f"{key} =")]
        lines.insert(at, f"{key} = {json.dumps(value)}")
    return parse_pair("\n".join(lines) + "\n", "test.toml")


def resolved(name):
    """What a dotted name is: of a function and a module of one name the function, as in Python."""
    first, *parts = name.split(".")
    found = importlib.import_module(first)
    for part in parts:
        if not hasattr(found, part):
            importlib.import_module(f"{found.__name__}.{part}")
        found = getattr(found, part)
    return found
