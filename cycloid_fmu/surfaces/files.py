"""The error surface file: netCDF, format `cycloid-surface/1`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import FIRST_KINDS, KINDS
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.surfaces.structured import unit_of
from cycloid_fmu.surfaces.surface import DEVIATION_TEXTS, DEVIATIONS, Ageing, ErrorSurface, Life

FORMAT = "cycloid-surface/1"
_AGEING = "life_ageing"
_DIMENSIONS = {
    "drive": (),
    "pin": ("pin",),
    "tooth": ("disc", "tooth"),
    "hole": ("disc", "support"),
    "crank": ("support",),
    "roller": ("support",),
    "eccentric": ("disc", "crank"),
    "roller_hole": ("disc", "support"),
}


def write_surface(surface: ErrorSurface, path: str | os.PathLike[str]) -> None:
    """Write a surface file (netCDF, `cycloid-surface/1`); never a partial file."""
    import xarray as xr

    data: dict[str, Any] = {name: (_DIMENSIONS[KINDS[name].of], values) for name, values in surface.errors.items()}
    for name, dimensions in DEVIATIONS.items():
        if (elements := getattr(surface, name)) is not None:
            data[name] = (dimensions, elements)
    if surface.life is not None:
        for name, values in surface.life.arrays.items():
            data[f"life_{name}"] = (("state", *DEVIATIONS.get(name, ())), values)
    coordinates: dict[str, Any] = {}
    if surface.covariance is not None:
        data["covariance"] = (("parameter", "parameter_"), surface.covariance)
        coordinates["parameter"] = np.array(surface.covariance_of, dtype=object)
    dataset = xr.Dataset(data, coordinates)
    for name, text in {**{n: k.description for n, k in KINDS.items()}, **DEVIATION_TEXTS}.items():
        if name not in dataset:
            continue
        dataset[name].attrs.update(units=unit_of(name), long_name=text)
        if f"life_{name}" in dataset:
            dataset[f"life_{name}"].attrs.update(units=unit_of(name), long_name=f"{text}; over life")
    if surface.life is not None:
        dataset["life_crank_turns"].attrs.update(units="1", long_name="crank turns since new")
        if surface.life.ageing is not None:
            dataset.attrs[_AGEING] = json.dumps(vars(surface.life.ageing))
    dataset.attrs.update(surface.attributes, format=FORMAT, origin=surface.origin, pair=surface.pair.text)
    edge.write_netcdf(dataset, path, {str(n): {"zlib": True} for n in dataset.data_vars if str(n).startswith("life_")})


def read_surface(path: str | os.PathLike[str]) -> ErrorSurface:
    """Read a surface file.

    Raises
    ------
    edge.InputError
        If it can't be read, has another format, lacks a variable, or has a wrong unit or size or a value out of range.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> made = cy.Drive(pair).replace(errors={"pin_radius": "-1 um"})
    >>> made.write("made.nc")
    >>> cy.read_surface("made.nc") == made.surface
    True
    """
    attributes, data = edge.netcdf(path, FORMAT)
    for name, variable in data.items():
        if name != "parameter" and variable.values.dtype.kind not in "fiu":
            raise edge.InputError(f"{path}: {name} must hold numbers.")
    pair = parse_pair(attributes.get("pair", ""), f"{path} (its pair)")
    for name in FIRST_KINDS:
        # A kind that was added later is zero in older files.
        if name not in data:
            raise edge.InputError(f"{path}: the variable {name} is missing.")
    for name in (*KINDS, *DEVIATIONS):
        if name in data and (unit := data[name].attrs.get("units")) != unit_of(name):
            raise edge.InputError(f'{path}: {name} has the unit {edge.shown(unit)}; it must be "{unit_of(name)}".')
    for name, dimensions in DEVIATIONS.items():
        if name in data and data[name].dims != dimensions:
            raise edge.InputError(f"{path}: {name} has the dimensions {data[name].dims}; it must have {dimensions}.")
    covariance = data["covariance"].values.astype(float) if "covariance" in data else None
    names = tuple(str(n) for n in data["parameter"].values) if covariance is not None else ()
    if covariance is not None and not (
        covariance.shape == (len(names),) * 2 and np.isfinite(covariance).all() and (covariance == covariance.T).all()
    ):
        raise edge.InputError(f"{path}: covariance must be symmetric and finite, {len(names)} by {len(names)}.")
    try:
        return ErrorSurface(
            pair,
            {name: data[name].values for name in KINDS if name in data},
            **{name: data[name].values for name in DEVIATIONS if name in data},
            life=_life_of(data, attributes.get(_AGEING), str(path)),
            origin=str(attributes.get("origin")),
            covariance_of=names,
            covariance=covariance,
            attributes={k: v for k, v in attributes.items() if k not in ("format", "origin", "pair", _AGEING)},
        )
    except edge.InputError as problem:
        raise edge.InputError(f"{path}: {problem}") from None


def _life_of(data: Mapping[str, Any], stated: Any, source: str) -> Life | None:
    if "life_crank_turns" not in data:
        return None
    for name in DEVIATIONS:
        if f"life_{name}" not in data:
            raise edge.InputError(
                f"{source}: life_{name} is missing or its shape is not that of {name} for each state."
            )
    ageing = None
    if stated is not None:
        try:
            given = json.loads(stated)
            bearing = str(given.pop("bearing", ""))
            ageing = Ageing(**{name: float(value) for name, value in given.items()}, bearing=bearing)
        except (AttributeError, TypeError, ValueError):
            raise edge.InputError(f"{source}: {_AGEING} is damaged; write the file again.") from None
    return Life(**{n: data[f"life_{n}"].values.astype(float) for n in ("crank_turns", *DEVIATIONS)}, ageing=ageing)
