"""An update in place of a 39/40 drive: runs at two loads, both ways, a turn each, 17 bits; from arrays to figures."""

import os

import numpy as np
from lived_drives import BITS, TURNS, Joint, fitted, made, visit, worn

from cycloid_fmu.geometry.pair import read_pair
from fitting.recalibration.recalibrate import recalibrate

PAIR = os.path.join(os.path.dirname(__file__), "..", "examples", "drive-39-40.toml")


def test_update(benchmark):
    pair, generator = read_pair(PAIR), np.random.default_rng(1)
    drive, values, scatter = fitted(pair, generator)
    joint, now = Joint.drawn(generator), drive
    for _ in range(2):
        values, scatter = worn(pair, values, scatter, generator, monotone=True)
        runs = visit(pair, made(pair, values, scatter), joint, generator, each=60.3)
        last, now = now, recalibrate(now, runs, crank_turns=TURNS, bits=BITS)
    found = benchmark(lambda: recalibrate(last, runs, crank_turns=TURNS, bits=BITS))
    benchmark.extra_info["alarm"] = found.alarm or "none"
