"""Cycloid-pin gear drives: contact model, error surfaces and FMUs, without measurements and encoders.

The names below are those that a notebook needs; they are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from cycloid_fmu.draw.plots import plot
    from cycloid_fmu.drive import Drive, build_fmus, field_units, read_drive
    from cycloid_fmu.edge import ARCMIN, ARCSEC, InputError
    from cycloid_fmu.errors.kinds import ErrorKind, register_error_kind
    from cycloid_fmu.fmu.friction_file import Friction
    from cycloid_fmu.fmu.run import simulate_fmu
    from cycloid_fmu.fmu.variables import Interface
    from cycloid_fmu.geometry.pair import Material, Pair
    from cycloid_fmu.reducer.description import Reducer, read_reducer
    from cycloid_fmu.reducer.lost_motion import budget
    from cycloid_fmu.surfaces.files import read_surface
    from cycloid_fmu.surfaces.sampling import Tolerances, read_tolerances
    from cycloid_fmu.surfaces.surface import ErrorSurface

_HOMES = {
    "draw.plots": ("plot",),
    "drive": ("Drive", "build_fmus", "field_units", "read_drive"),
    "edge": ("ARCMIN", "ARCSEC", "InputError"),
    "errors.kinds": ("ErrorKind", "register_error_kind"),
    "fmu.friction_file": ("Friction",),
    "fmu.run": ("simulate_fmu",),
    "fmu.variables": ("Interface",),
    "geometry.pair": ("Material", "Pair"),
    "reducer.description": ("Reducer", "read_reducer"),
    "reducer.lost_motion": ("budget",),
    "surfaces.files": ("read_surface",),
    "surfaces.sampling": ("Tolerances", "read_tolerances"),
    "surfaces.surface": ("ErrorSurface",),
}

__all__ = [
    "ARCMIN",
    "ARCSEC",
    "Drive",
    "ErrorKind",
    "ErrorSurface",
    "Friction",
    "InputError",
    "Interface",
    "Material",
    "Pair",
    "Reducer",
    "Tolerances",
    "__version__",
    "budget",
    "build_fmus",
    "field_units",
    "plot",
    "read_drive",
    "read_reducer",
    "read_surface",
    "read_tolerances",
    "register_error_kind",
    "simulate_fmu",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("cycloid-fmu")
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
