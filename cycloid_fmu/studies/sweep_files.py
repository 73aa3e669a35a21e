"""Sweeps in files: netCDF in SI, and tables in field units as CSV and Parquet."""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.edge.quantities import FIELD_UNITS
from cycloid_fmu.studies.checkpoint import reserved
from cycloid_fmu.studies.sweep import Sweep, figures_in, run

if TYPE_CHECKING:
    import xarray as xr

ENDINGS = (".csv", ".parquet", ".nc")
SHOWN = {**FIELD_UNITS, "N*m": ("N*m", 1.0), "1": ("1", 1.0)}
"""Units of figures in tables, and how many are one in SI."""


def conduct(
    sweep: Sweep,
    output: str | os.PathLike[str] | None = None,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda drives: None,
) -> xr.Dataset:
    """Solve a sweep and write it, as `Drive.sweep`; parameters are those of `sweep.run`."""
    target = None if output is None else edge.output_path(output, "output", ENDINGS)
    with reserved(target):
        data = run(sweep, target, workers=workers, progress=progress)
        if target is not None:
            write(data, target)
    return data


def write(data: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a sweep in the format of the name's ending; never a partial file.

    Raises
    ------
    edge.InputError
        If the ending is another or no file may be written there.
    """
    target = edge.output_path(path, "path", ENDINGS)
    if target.suffix.lower() == ".nc":
        edge.write_netcdf(data, target)
        return
    with edge.written_whole(target) as temporary:
        (_write_csv if target.suffix.lower() == ".csv" else _write_parquet)(table_of(data), temporary)


def label_of(name: str, unit: str) -> str:
    """Return the label of a figure or a varied value, with its unit."""
    shown = unit.replace("um", "µm").replace("*", "·").replace("degC", "°C")
    words = "share of loaded pins" if name == "loaded_pins" else name.replace("_", " ")
    return words + ("" if unit == "1" else f" [{shown}]")


def varied_names(data: xr.Dataset) -> list[str]:
    """Return the names of the varied values, in order."""
    return [str(name) for name in data["reason"].dims]


def with_free_positions(data: xr.Dataset) -> xr.Dataset:
    """Return a sweep without the figures of drives with interference, unless all have it; the interference stays.

    A preloaded drive is many times stiffer and carries on all pins: it would hide the differences of the others.
    """
    free = ~(data["interference"] > 0.0)
    if not free.any():
        return data
    kept = {name: data[name].where(free).transpose(*data[name].dims) for name in figures_in(data)}
    return data.assign({**kept, "interference": data["interference"]})


def shown_values(data: xr.Dataset | xr.DataArray, name: str) -> tuple[list[float], str]:
    """Return the varied values and their unit, as given."""
    place = data[name]
    si, unit = place.attrs["units"], place.attrs["shown_units"]
    if si == "1":
        return [float(value) for value in place.values], "1"
    texts = [edge.format_quantity(float(value), si, unit) for value in place.values]
    return [float(f"{float(text.split(' ')[0]):.12g}") for text in texts], unit


def table_of(data: xr.Dataset) -> dict[str, list[Any]]:
    """Return a sweep as a table, a row for each drive and torque: {name with its unit: values}.

    Figures are in arcsec, N·m/arcmin, MPa and µm, NaN where there are none.
    """
    names = varied_names(data)
    axes = [shown_values(data, name) for name in names]
    torque = [float(one) for one in data["torque"].values]
    rows = list(itertools.product(*(values for values, _ in axes), torque))
    found: dict[str, list[Any]] = {}
    for k, name in enumerate(names):
        found[f"{name} [{axes[k][1]}]"] = [row[k] for row in rows]
    found["torque [N*m]"] = [row[-1] for row in rows]
    every = data["angular_transmission_error"]
    for name in figures_in(data):
        unit, factor = SHOWN[data[name].attrs["units"]]
        found[f"{name} [{unit}]"] = (
            (data[name].broadcast_like(every).transpose(*every.dims) * factor).values.ravel().tolist()
        )
    found["reason"] = list(np.repeat(data["reason"].values.ravel(), len(torque)))
    return found


def _write_csv(table: dict[str, list[Any]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        for row in zip(*table.values(), strict=True):
            writer.writerow("" if cell != cell else cell for cell in row)  # NaN is an empty cell


def _write_parquet(table: dict[str, list[Any]], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({name: pa.array(values) for name, values in table.items()}), path)
