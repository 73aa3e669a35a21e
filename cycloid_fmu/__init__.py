"""Cycloid-pin gear drives: contact model, error surfaces and FMUs; knows neither measurements nor encoders.

The names below are what a notebook needs; they are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

__version__ = version("cycloid-fmu")

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive, field_units, read_drive
    from cycloid_fmu.edge import ARCMIN, ARCSEC, InputError
    from cycloid_fmu.errors.kinds import ErrorKind, register
    from cycloid_fmu.geometry.pair import Material, Pair, read_pair
    from cycloid_fmu.surfaces.files import read_surface
    from cycloid_fmu.surfaces.sampling import Tolerances, read_tolerances
    from cycloid_fmu.surfaces.surface import ErrorSurface

_HOME = {
    "Pair": "geometry.pair", "Drive": "drive", "ErrorSurface": "surfaces.surface", "Material": "geometry.pair",
    "Tolerances": "surfaces.sampling", "ErrorKind": "errors.kinds", "register": "errors.kinds", "InputError": "edge",
    "read_drive": "drive", "read_pair": "geometry.pair", "read_surface": "surfaces.files",
    "read_tolerances": "surfaces.sampling", "field_units": "drive", "ARCSEC": "edge", "ARCMIN": "edge",
}  # fmt: skip
__all__ = [
    "ARCMIN", "ARCSEC", "Drive", "ErrorKind", "ErrorSurface", "InputError", "Material", "Pair", "Tolerances",
    "__version__", "field_units", "read_drive", "read_pair", "read_surface", "read_tolerances", "register",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
