import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from cycloid_fmu.pair import parse_pair

# The first call of a kernel compiles it; a time limit for each example would measure that.
settings.register_profile("default", deadline=None)
settings.load_profile("default")

sys.path.insert(0, str(Path(__file__).parent))  # brute_force.py, the independent solver

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


def make_pair(text=PAIR, **keys):
    """The error-free 39/40 pair with other keys of its [pair] table."""
    lines = text.splitlines()
    at = lines.index("[pair]") + 1
    for key, value in keys.items():
        lines = [line for line in lines if not line.startswith(f"{key} =")]
        lines.insert(at, f"{key} = {json.dumps(value)}")
    return parse_pair("\n".join(lines) + "\n", "test.toml")


@pytest.fixture
def command(tmp_path):
    """Run an installed command in an empty folder, as a user does."""

    def run(*words, folder=tmp_path, **options):
        name = str(Path(sys.executable).with_name(words[0]))
        return subprocess.run(
            [name, *map(str, words[1:])], cwd=folder, capture_output=True, text=True, timeout=300,
            env={**os.environ, "COLUMNS": "200"}, **options,
        )  # fmt: skip

    return run
