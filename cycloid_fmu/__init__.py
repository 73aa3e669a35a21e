"""Cycloid-pin gear drives: contact model, error surfaces and FMUs, without measurements and encoders.

The names below are those that a notebook needs; they are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from cycloid_fmu.draw.plots import plot as plot
    from cycloid_fmu.drive import Drive as Drive
    from cycloid_fmu.drive import build_fmus as build_fmus
    from cycloid_fmu.drive import field_units as field_units
    from cycloid_fmu.drive import read_drive as read_drive
    from cycloid_fmu.edge import ARCMIN as ARCMIN
    from cycloid_fmu.edge import ARCSEC as ARCSEC
    from cycloid_fmu.edge import InputError as InputError
    from cycloid_fmu.errors.kinds import ErrorKind as ErrorKind
    from cycloid_fmu.errors.kinds import register_error_kind as register_error_kind
    from cycloid_fmu.fmu.friction_file import Friction as Friction
    from cycloid_fmu.fmu.run import simulate_fmu as simulate_fmu
    from cycloid_fmu.fmu.variables import Interface as Interface
    from cycloid_fmu.geometry.pair import Material as Material
    from cycloid_fmu.geometry.pair import Pair as Pair
    from cycloid_fmu.reducer.description import Reducer as Reducer
    from cycloid_fmu.reducer.description import read_reducer as read_reducer
    from cycloid_fmu.reducer.lost_motion import budget as budget
    from cycloid_fmu.surfaces.files import read_surface as read_surface
    from cycloid_fmu.surfaces.sampling import Tolerances as Tolerances
    from cycloid_fmu.surfaces.sampling import read_tolerances as read_tolerances
    from cycloid_fmu.surfaces.surface import ErrorSurface as ErrorSurface

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

__all__ = sorted(("__version__", *(name for names in _HOMES.values() for name in names)))


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
