"""The numbers of a compensator under the names of its forms in other languages."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation import compensator as core
from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.edge import ArgumentError
from cycloid_fmu.fmu.constants import FRICTION_ELEMENTS, LARGEST_TRANSMISSION_ERROR

Array = NDArray[np.float64]
LIMITS = {
    name: getattr(core, name)
    for name in (
        "LARGEST", "CORRELATION", "MEMORY", "FIRST", "LARGEST_GAIN", "GAIN_RATE", "ANGLE_RATE", "OUTLIER", "ALARM",
        "ENOUGH", "SURE_FLANK", "SETTLED",
    )
} | {"LARGEST_TRANSMISSION_ERROR": LARGEST_TRANSMISSION_ERROR}  # fmt: skip


def counts(c: Compensator) -> dict[str, int]:
    """Return the sizes of the tables."""
    t = c.inverse
    return {
        "FRICTION_ELEMENTS": FRICTION_ELEMENTS, "FUNCTIONS": len(t.scale), "TORQUES": len(t.torque),
        "TEMPERATURES": len(t.temperature), "STRIBECK_SPEEDS": len(c.stribeck_speed), "WARMTHS": len(c.warmth),
    }  # fmt: skip


def scalars(c: Compensator) -> dict[str, float]:
    """Return the numbers of the drive and those common to all drives."""
    own = {
        "RATIO": c.ratio, "CRANK_RATIO": c.crank_ratio, "PERIOD": c.inverse.period, "COMPLIANCE": c.compliance,
        "COULOMB": c.coulomb, "LOAD_SHARE": c.load_share, "STRIBECK": c.stribeck, "VISCOUS": c.viscous,
        "PRESLIDING_ANGLE": c.presliding_angle, "SENSOR": c.sensor, "LEAST_VARIANCE": c.least_variance,
    }  # fmt: skip
    return {name: float(value) for name, value in (own | LIMITS).items()}


def arrays(c: Compensator) -> dict[str, Array]:
    """Return tables, row by row; that of the functions of torque and temperature has two dimensions."""
    t = c.inverse
    return {
        "EXPECTED": np.array(core.EXPECTED), "KNOWN": np.array(core.KNOWN), "TORQUE": t.torque,
        "TEMPERATURE": t.temperature, "MEAN": t.mean.ravel(), "FLANK": t.flank, "VARIANCE": c.variance.ravel(),
        "RIPPLE_VARIANCE": c.ripple_variance.ravel(),
        "SHARE": t.share.reshape(t.mean.size, len(t.scale)), "SCALE": t.scale, "STRIBECK_SPEED": c.stribeck_speed,
        "STRIBECK_SHARE": c.stribeck_share, "WARMTH_TEMPERATURE": c.warmth_temperature, "WARMTH": c.warmth,
    }  # fmt: skip


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
            argument, "its name also names what is in it: it must begin with a letter; letters, digits, single _",
            path.name,
        )  # fmt: skip
    return name


def about(c: Compensator) -> str:
    """Return a sentence on the drive and its table."""
    t = c.inverse
    reach = f"{t.torque[0]:g} to {t.torque[-1]:g} N.m"
    warm = f", {t.temperature[0]:g} to {t.temperature[-1]:g} K" if len(t.temperature) > 1 else ""
    arcsec = t.residual * 648000.0 / np.pi
    return (
        f"Cycloid drive, ratio {c.ratio:g}: tables of {c.size} bytes, {reach}{warm}; largest difference from the model "
        f"that was found: {arcsec:.3g} arcsec."
    )
