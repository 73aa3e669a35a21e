import hashlib

import numpy as np
import pytest
from common import EXAMPLES

from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.transmission_error.curve import Curve

ARCSEC = np.pi / 648000
LOADS = (20.0, -20.0, 200.0, -200.0)


@pytest.fixture(scope="session")
def nominal():
    return read_pair(EXAMPLES / "drive-39-40.toml")


@pytest.fixture(scope="session")
def made():
    return read_pair(EXAMPLES / "drive-39-40-as-made.toml")


@pytest.fixture(scope="session")
def measured(made):
    """Curves of the drive as made, with 0.5″ of noise: measured(seed, loads=…, each=samples a crank turn, …)."""
    surface = surface_of_pair(made)
    clean = {}

    def curves(seed, *, loads=LOADS, each=24, crank=0.0, zeros=(0.0,) * 4, common_zero=True, known_index=True):
        rng = np.random.default_rng(seed)
        angle = np.arange(39 * each) * 2 * np.pi / each
        found = []
        for load, zero in zip(loads, zeros, strict=False):
            key = (load, each, crank)
            if key not in clean:
                clean[key] = solve(DriveValue(made, surface), load, angle + crank, with_play=False).transmission_error[
                    0
                ]
            error = clean[key] + zero + rng.normal(0.0, 0.5 * ARCSEC, angle.size)
            found.append(
                Curve(
                    angle,
                    error,
                    np.full(angle.size, np.nan),
                    np.ones(angle.size, int),
                    load,
                    0.0,
                    1 if load > 0 else -1,
                    -39.0,
                    common_zero,
                    known_index,
                    f"{load:g} N·m",
                    hashlib.sha256(error.tobytes()).hexdigest(),
                )
            )
        return found

    return curves
