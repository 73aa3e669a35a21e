"""The numbers of a compensator under the names of its forms in other languages."""

from __future__ import annotations

import keyword
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation import compensator as core
from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.edge import ArgumentError, InputError
from cycloid_fmu.fmu.constants import FRICTION_ELEMENTS, LARGEST_TRANSMISSION_ERROR, MOST_FUNCTIONS
from cycloid_fmu.fmu.resource_file import padding, variable_bytes
from cycloid_fmu.fmu.variables import Variable

Array = NDArray[np.float64]
LIMITS = {
    name: getattr(core, name)
    for name in (
        "LARGEST",
        "FIRST",
        "LARGEST_GAIN",
        "GAIN_RATE",
        "ANGLE_RATE",
        "OUTLIER",
        "ALARM",
        "LEAST_GAIN",
        "ENOUGH",
        "SURE_FLANK",
        "SETTLED",
    )
} | {
    "LARGEST_TRANSMISSION_ERROR": LARGEST_TRANSMISSION_ERROR,
    "PER_MEMORY": 1.0 / core.MEMORY,
    "PER_CORRELATION": 1.0 / core.CORRELATION,
}

SIZES = ("FUNCTIONS", "TORQUES", "TEMPERATURES", "STRIBECK_SPEEDS", "WARMTHS")  # of `counts`, those of one drive


def counts(c: Compensator) -> dict[str, int]:
    """Return the sizes of the tables."""
    t = c.inverse
    return {
        "FRICTION_ELEMENTS": FRICTION_ELEMENTS,
        "FUNCTIONS": len(t.scale),
        "COLUMNS": core.COLUMNS,
        "SUPPORT": core.SUPPORT,
        "TORQUES": len(t.torque),
        "TEMPERATURES": len(t.temperature),
        "STRIBECK_SPEEDS": len(c.stribeck_speed),
        "WARMTHS": len(c.warmth),
    }


def scalars(c: Compensator) -> dict[str, float]:
    """Return the numbers of the drive and those common to all drives."""
    t = c.tables
    own = {
        "RATIO": c.ratio,
        "PER_RATIO": t.per_ratio,
        "CRANK_RATIO": c.crank_ratio,
        "PER_PERIOD": t.per_period,
        "COMPLIANCE": c.compliance,
        "COULOMB": c.coulomb,
        "LOAD_SHARE": c.load_share,
        "STRIBECK": c.stribeck,
        "VISCOUS": c.viscous,
        "STRAIN": t.strain,
        "STIFFNESS": t.stiffness,
        "NOISE": t.noise,
        "LEAST": t.least,
        "REACH": c.inverse.torque[-1],
    }
    return {name: float(value) for name, value in (own | LIMITS).items()}


def arrays(c: Compensator) -> dict[str, Array]:
    """Return tables; that of torque and temperature row by row."""
    t = c.inverse
    return {
        "EXPECTED": np.array(core.EXPECTED),
        "KNOWN": np.array(core.KNOWN),
        "PRIOR": np.array(core.PRIOR),
        "TORQUE": t.torque,
        "TORQUE_RATE": c.tables.torque_rate,
        "TEMPERATURE": t.temperature,
        "TEMPERATURE_RATE": c.tables.temperature_rate,
        "NODE": c.tables.node.ravel(),
        "STRIBECK_SPEED": c.stribeck_speed,
        "STRIBECK_RATE": c.tables.stribeck_rate,
        "STRIBECK_SHARE": c.stribeck_share,
        "WARMTH_TEMPERATURE": c.warmth_temperature,
        "WARMTH_RATE": c.tables.warmth_rate,
        "WARMTH": c.warmth,
    }


def table_body(c: Compensator, variables: Sequence[Variable]) -> bytes:
    """Return the body of the file of an FMU with these numbers, for `resource_file.sealed`.

    Raises
    ------
    edge.InputError
        If there are more functions of the crank angle than an FMU has room for.
    """
    sizes = counts(c)
    if sizes["FUNCTIONS"] > MOST_FUNCTIONS:
        raise InputError(
            f"the table has {sizes['FUNCTIONS']} functions of the crank angle, and an FMU has room for "
            f"{MOST_FUNCTIONS}; state a larger residual, or use C99 source."
        )
    body = variable_bytes(variables, variables.index)
    body += padding(body)
    body += struct.pack("<5I", *(sizes[name] for name in SIZES))
    body += np.array([*scalars(c).values(), *np.concatenate(list(arrays(c).values()))], "<f8").tobytes()
    for steps in c.tables.steps:
        body += struct.pack("<II", len(steps) - core.SUPPORT, steps.itemsize)
        body += steps.astype(steps.dtype.newbyteorder("<")).tobytes()
        body += padding(body)
    return body


def name_of(path: Path, argument: str = "path") -> str:
    """Return the prefix of a form's names: the name of its file.

    Raises
    ------
    edge.InputError
        If it is not a valid identifier.
    """
    name = re.sub(r"[\s.-]+", "_", path.stem)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) or keyword.iskeyword(name.lower()):
        raise ArgumentError(
            argument,
            "its name is also that of its content: it must begin with a letter; letters, digits, single _",
            path.name,
        )
    return name


def about(c: Compensator) -> str:
    """Return a sentence on the drive and its table."""
    t = c.inverse
    reach = f"{t.torque[0]:g} to {t.torque[-1]:g} N.m"
    warm = f", {t.temperature[0]:g} to {t.temperature[-1]:g} K" if len(t.temperature) > 1 else ""
    arcsec = t.residual * 648000.0 / np.pi
    return (
        f"Cycloid drive, ratio {c.ratio:g}: tables of {c.size} bytes, {reach}{warm}; largest difference from the model "
        f"{arcsec:.3g} arcsec."
    )
