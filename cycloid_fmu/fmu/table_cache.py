"""Cache of tables in the user's cache folder (`edge.cached`): all FMUs of one drive share them."""

from __future__ import annotations

import functools
import io
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import tables
from cycloid_fmu.fmu.tables import Errors, Side, Tables

_PACKAGE = Path(__file__).parents[1]
_MAKERS = (
    *("analysis", "contact", "drive_value.py", "errors", "geometry", "supports", "surfaces"),
    *("fmu/table_nodes.py", "fmu/tables.py"),
)
_MOST_BYTES = 400_000_000  # of all tables in the cache
_SIDE = ("load", "transmission_error", "compliance", "pressure_load", "contact_count", "pressure")
_SCALARS = ("ratio", "period", "allowed", "largest_error")


def tables_of(drive: DriveValue, *, largest_load: float | None = None, **making: Any) -> Tables:
    """Return the tables of a drive from the cache, or by `tables.compute`, which are then stored.

    Parameters are those of `tables.compute`.
    """
    asked = f"{drive.hash} {largest_load} {making.get('accuracy', tables.ACCURACY)!r} {_makers()}"
    return edge.cached(
        "tables",
        asked,
        lambda: tables.compute(drive, largest_load=largest_load, **making),
        write=_written,
        read=_read,
        most_bytes=_MOST_BYTES,
    )


@functools.cache
def _makers() -> str:
    """Hash of the code that makes tables."""
    return edge.hash_of_code(_PACKAGE / name for name in _MAKERS)


def _written(drive_tables: Tables) -> bytes:
    arrays: dict[str, Any] = {name: getattr(drive_tables, name) for name in _SCALARS}
    arrays["rest_torque"] = drive_tables.rest_torque
    if drive_tables.errors is not None:
        e = drive_tables.errors
        arrays["errors"] = [*e.stiffness, *e.pressure, e.speed, *e.crank_torque]
    for name, side in (("positive", drive_tables.positive), ("negative", drive_tables.negative)):
        arrays[f"{name}_far"] = np.array(side.far[1:])
        arrays[f"{name}_far_load"] = side.far[0]
        for field in _SIDE:
            arrays[f"{name}_{field}"] = getattr(side, field)
        for i, (field, step) in enumerate(
            zip(("transmission_error", "compliance", "pressure"), side.steps, strict=True)
        ):
            whole = np.round(arrays[f"{name}_{field}"] / step[:, None])
            arrays[f"{name}_{field}"] = np.diff(whole, axis=1, prepend=0.0).astype(np.int32)
            arrays[f"{name}_step_{i}"] = step
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _read(data: bytes) -> Tables:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        stiffness, pressure, crank = file["errors"][:2], file["errors"][2:4], file["errors"][5:]
        sides = []
        for name in ("positive", "negative"):
            steps = tuple(file[f"{name}_step_{i}"] for i in range(3))
            fields = {field: file[f"{name}_{field}"] for field in _SIDE}
            for field, step in zip(("transmission_error", "compliance", "pressure"), steps, strict=True):
                fields[field] = np.cumsum(fields[field], axis=1) * step[:, None]
            far = float(file[f"{name}_far_load"]), *file[f"{name}_far"]
            sides.append(Side(**fields, steps=steps, far=far))
        scalars = {name: float(file[name]) for name in _SCALARS}
        errors = Errors(
            (float(stiffness[0]), float(stiffness[1])),
            (float(pressure[0]), float(pressure[1])),
            float(file["errors"][4]),
            (float(crank[0]), float(crank[1])),
        )
        return Tables(positive=sides[0], negative=sides[1], rest_torque=file["rest_torque"], errors=errors, **scalars)
