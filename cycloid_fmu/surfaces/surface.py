"""The error surface: what really was made and assembled, beyond the nominal pair.

Signs and names are those of docs/theory/errors.md; the file is netCDF, format `cycloid-surface/1`.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact import SCALAR_ERRORS
from cycloid_fmu.geometry.pair import Pair, parse_pair

Array = NDArray[np.float64]
FORMAT = "cycloid-surface/1"
ORIGINS = ("nominal", "sampled", "measured", "identified", "worn")
PATTERNS = ("pin_radial", "pin_tangential", "tooth_cumulative_pitch")
ANGLES = ("misalignment_xz", "misalignment_yz")
_FLANKS, _PINS = ("disc", "tooth", "profile", "width"), ("pin", "angle", "width")
DEVIATIONS = {
    "gear_deviation": _FLANKS, "pin_deviation": _PINS, "gear_curvature": _FLANKS, "pin_curvature": _PINS,
}  # fmt: skip
_DEVIATION_TEXTS = {
    "gear_deviation": "normal deviation of each element of the flanks, > 0 material added",
    "pin_deviation": "normal deviation of each element of the pins, > 0 material added",
    "gear_curvature": "curvature that wear adds to each element of the flanks, > 0 convex",
    "pin_curvature": "curvature that wear adds to each element of the pins, > 0 convex",
}
LARGEST_ELEMENT = 5e-4
DESCRIPTIONS = {
    "centre_distance_x": "offset of the gear's centre along +x",
    "centre_distance_y": "offset of the gear's centre along +y",
    "misalignment_xz": "tilt of the gear's axis about mid-width, its +z end towards +x",
    "misalignment_yz": "tilt of the gear's axis about mid-width, its +z end towards +y",
    "eccentricity": "error of the crank's eccentricity, > 0 longer",
    "pin_circle_radius": "error of the pin circle's radius, > 0 larger",
    "pin_radius": "error of all pins' radius, > 0 thicker",
    "isometric": "isometric modification really made beyond the nominal, > 0 material removed",
    "offset": "offset modification really made beyond the nominal, > 0 material added",
    "pin_radial": "radial position error of each pin, > 0 outwards",
    "pin_tangential": "tangential position error of each pin, > 0 counter-clockwise, as arc length",
    "pin_radius_deviation": "radius error of each pin, > 0 thicker",
    "tooth_cumulative_pitch": "cumulative pitch error of each tooth, > 0 counter-clockwise, at the pin circle radius",
}


@dataclass(frozen=True)
class Elements:
    """How many elements a surface has: along a tooth's profile, across the width, and round the half of a pin."""

    profile: int = 200
    width: int = 20
    angle: int = 100

    def __post_init__(self) -> None:
        for name in ("profile", "width", "angle"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}: a surface has at least one element each way")


@dataclass(frozen=True)
class Life:
    """Deviations of a wearing drive over its life; each array's first axis is the state.

    `crank_turns` (states,) grows from 0; the others are as an `ErrorSurface` has them.
    """

    crank_turns: Array
    gear_deviation: Array
    pin_deviation: Array
    gear_curvature: Array
    pin_curvature: Array


@dataclass(frozen=True)
class ErrorSurface:
    """Errors of one pair, SI; the scalars' names and signs are those of the pair file's `[errors]`.

    Attributes
    ----------
    pin_radial, pin_tangential, pin_radius_deviation
        Shape (pins,), m.
    tooth_cumulative_pitch
        Shape (discs, teeth), m at the pin circle radius.
    gear_deviation
        Normal deviation of each element of the flanks, > 0 material added, shape (discs, teeth, profile, width), m; or
        None where the flanks are nominal. Elements are of equal arc length from a tooth's first root to its second
        (`profile.equal_arc_parameters`) and of equal width from -z to +z; values stand at their middles.
    pin_deviation
        Normal deviation of each element of the pins, > 0 material added, shape (pins, angle, width), m; or None.
        Elements are of equal angle over the half of the pin that faces the pin circle's centre: the angle runs
        counter-clockwise about the pin's axis from -90° to +90° of the direction to that centre.
    gear_curvature, pin_curvature
        Curvature that wear adds at the same places, > 0 convex, shapes as the deviations', 1/m; or None, where the
        deviations leave the curvature as it is (form and roughness of a scale that contact does not follow).
    life
        Of a worn surface: its states from new to the one that the deviations hold; else None.
    origin
        One of `ORIGINS`.
    pair_text
        The pair file's text that this surface belongs to.
    covariance_of, covariance
        Names of fitted parameters, shape (parameters,), and their covariance, shape (parameters, parameters).
    attributes
        Further provenance (seed, turns, data checksum), written as attributes of the file.
    """

    pin_radial: Array
    pin_tangential: Array
    pin_radius_deviation: Array
    tooth_cumulative_pitch: Array
    centre_distance_x: float = 0.0
    centre_distance_y: float = 0.0
    misalignment_xz: float = 0.0
    misalignment_yz: float = 0.0
    eccentricity: float = 0.0
    pin_circle_radius: float = 0.0
    pin_radius: float = 0.0
    isometric: float = 0.0
    offset: float = 0.0
    gear_deviation: Array | None = None
    pin_deviation: Array | None = None
    gear_curvature: Array | None = None
    pin_curvature: Array | None = None
    life: Life | None = None
    origin: str = "nominal"
    pair_text: str = ""
    covariance_of: tuple[str, ...] = ()
    covariance: Array | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)


def nominal_surface(pair: Pair) -> ErrorSurface:
    """Return the surface without errors of a pair."""
    g = pair.pair
    return ErrorSurface(
        pin_radial=np.zeros(g.pins),
        pin_tangential=np.zeros(g.pins),
        pin_radius_deviation=np.zeros(g.pins),
        tooth_cumulative_pitch=np.zeros((g.discs, g.gear_teeth)),
        pair_text=pair.text,
    )


def _pattern(value: Any, count: int) -> Array:
    """Values of a pattern error: from {order: (amplitude, phase)}, or one each."""
    if isinstance(value, dict):
        index = np.arange(count)
        waves = [a * np.cos(2.0 * np.pi * k * index / count - phase) for k, (a, phase) in value.items()]
        return np.sum(waves, axis=0) if waves else np.zeros(count)
    return np.array(value, dtype=float) if len(value) else np.zeros(count)


def surface_of_pair(pair: Pair) -> ErrorSurface:
    """Return the surface with the errors that the pair file itself states."""
    g, stated = pair.pair, pair.errors
    pitch = stated.tooth_cumulative_pitch
    rows = pitch if isinstance(pitch, tuple) and pitch and isinstance(pitch[0], tuple) else (pitch,) * g.discs
    return dataclasses.replace(
        nominal_surface(pair),
        pin_radial=_pattern(stated.pin_radial, g.pins),
        pin_tangential=_pattern(stated.pin_tangential, g.pins),
        pin_radius_deviation=_pattern(stated.pin_radius_each, g.pins),
        tooth_cumulative_pitch=np.array([_pattern(row, g.gear_teeth) for row in rows]),
        **{name: getattr(stated, name) for name in SCALAR_ERRORS},
    )


PROFILE_POINTS = 100  # elements of a profile that has none: its low orders are smooth
_PROFILE = re.compile(r"profile_deviation_([1-9])")
_STRUCTURED = re.compile(rf"({'|'.join(PATTERNS)})_([1-9]\d*)_(cos|sin)")


def structured_names(orders: Collection[int]) -> list[str]:
    """Names of the structured errors: the scalars, then cosine and sine part of each pattern at the given orders."""
    waves = [f"{pattern}_{order}_{part}" for pattern in PATTERNS for order in orders for part in ("cos", "sin")]
    return [*SCALAR_ERRORS, *waves]


def unit_of(name: str) -> str:
    """SI unit of an error: "rad" for the misalignments, "1/m" for curvatures, "m" for the others."""
    if name in ANGLES:
        return "rad"
    return "1/m" if name.endswith("_curvature") else "m"


def profile_names(orders: Collection[int]) -> list[str]:
    """Names of the profile deviation's orders: cosines of order/2 waves along the arc of every tooth, root to root."""
    return [f"profile_deviation_{order}" for order in orders]


def profile_wave(name: str, elements: int) -> Array | None:
    """Values of an order of the profile deviation at the elements' middles, shape (elements,), or None for others."""
    match = _PROFILE.fullmatch(name)
    return None if match is None else np.cos(np.pi * int(match[1]) * (np.arange(elements) + 0.5) / elements)


def _wave(pair: Pair, name: str) -> tuple[str, Array]:
    return _wave_of(pair.pair.pins, pair.pair.gear_teeth, name)


@functools.lru_cache(maxsize=1024)
def _wave_of(pins: int, gear_teeth: int, name: str) -> tuple[str, Array]:
    match = _STRUCTURED.fullmatch(name)
    if match is None:
        raise ValueError(f'"{name}" is not a structured error')
    pattern, order, part = match[1], int(match[2]), match[3]
    count = gear_teeth if pattern == "tooth_cumulative_pitch" else pins
    if 2 * order > count:
        raise ValueError(f'"{name}": the order must be at most half of {count}')
    argument = 2.0 * np.pi * order * np.arange(count) / count
    wave = np.cos(argument) if part == "cos" else np.sin(argument)
    wave.flags.writeable = False
    return pattern, wave


def structured_value(pair: Pair, surface: ErrorSurface, name: str) -> float:
    """Value of a structured error in a surface (m or rad); those of teeth are averaged over teeth and discs."""
    if name in SCALAR_ERRORS:
        return float(getattr(surface, name))
    flanks = surface.gear_deviation
    profile = profile_wave(name, PROFILE_POINTS if flanks is None else flanks.shape[2])
    if profile is not None:
        return 0.0 if flanks is None else float(2.0 * (flanks * profile[:, None]).mean())
    pattern, wave = _wave(pair, name)
    return float((getattr(surface, pattern) * wave).mean() / np.mean(wave**2)) if wave.any() else 0.0


def with_structured(pair: Pair, surface: ErrorSurface, values: Mapping[str, float]) -> ErrorSurface:
    """Return a surface in which the named structured errors have the given values (m or rad) and all else is kept.

    Raises
    ------
    ValueError
        If a name is not a structured error of this pair.
    """
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name in SCALAR_ERRORS:
            changes[name] = float(value)
            continue
        profile = profile_wave(
            name, PROFILE_POINTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
        )
        if profile is not None:
            g, before = pair.pair, structured_value(pair, surface, name)
            blank = np.zeros((g.discs, g.gear_teeth, profile.size, 1)) if value != before else None
            flanks = changes.get("gear_deviation", surface.gear_deviation)
            flanks = blank if flanks is None else flanks
            changes["gear_deviation"] = None if flanks is None else flanks + (value - before) * profile[:, None]
            continue
        pattern, wave = _wave(pair, name)
        held = changes.get(pattern, getattr(surface, pattern))
        changes[pattern] = held + (value - structured_value(pair, surface, name)) * wave
    return dataclasses.replace(surface, **changes)


def structured_columns(pair: Pair, names: Iterable[str]) -> Array:
    """Linear map from structured errors to the columns of `contact.sensitivities`, shape (columns, names).

    Orders of the profile deviation have no part in them.
    """
    g = pair.pair
    return _columns_of(g.pins, g.gear_teeth, g.discs, g.pin_circle_radius, tuple(names))


@functools.lru_cache(maxsize=16)
def _columns_of(pins: int, gear_teeth: int, discs: int, pin_circle_radius: float, names: tuple[str, ...]) -> Array:
    scalars = len(SCALAR_ERRORS)
    starts = {"pin_radial": scalars, "pin_tangential": scalars + pins, "tooth_cumulative_pitch": scalars + 3 * pins}
    columns = np.zeros((scalars + 3 * pins + discs * gear_teeth, len(names)))
    for column, name in zip(columns.T, names, strict=True):
        if name in SCALAR_ERRORS:
            column[SCALAR_ERRORS.index(name)] = 1.0
        elif profile_wave(name, 1) is None:
            pattern, wave = _wave_of(pins, gear_teeth, name)
            if pattern == "tooth_cumulative_pitch":
                wave = np.tile(wave, discs) / pin_circle_radius
            column[starts[pattern] : starts[pattern] + wave.size] = wave
    columns.flags.writeable = False
    return columns


def surface_after(surface: ErrorSurface, crank_turns: float) -> ErrorSurface:
    """Return a worn surface at another time of its life, linear between the states that it holds.

    Raises
    ------
    ValueError
        If it holds no life, or not up to so many turns.
    """
    life = surface.life
    if life is None:
        raise ValueError("this surface holds no states of a life")
    turns, last = life.crank_turns, life.crank_turns.size - 1
    if not 0.0 <= crank_turns <= turns[-1]:
        raise ValueError(
            f"crank_turns_worn = {crank_turns:g}: it must lie between 0 and {turns[-1]:g}, where the life ends"
        )
    after = min(max(int(np.searchsorted(turns, crank_turns)), 1), last)
    before = min(after - 1, last)
    span = turns[after] - turns[before]
    share = (crank_turns - turns[before]) / span if span > 0.0 else 0.0
    mixed = {n: (1.0 - share) * getattr(life, n)[before] + share * getattr(life, n)[after] for n in DEVIATIONS}
    return dataclasses.replace(surface, **mixed)


def write_surface(surface: ErrorSurface, path: str | os.PathLike[str]) -> None:
    """Write a surface file (netCDF, `cycloid-surface/1`), whole or not at all."""
    import xarray as xr

    pin, tooth = ("pin",), ("disc", "tooth")
    data: dict[str, Any] = {name: ((), float(getattr(surface, name))) for name in SCALAR_ERRORS}
    for name in ("pin_radial", "pin_tangential", "pin_radius_deviation"):
        data[name] = (pin, getattr(surface, name))
    data["tooth_cumulative_pitch"] = (tooth, surface.tooth_cumulative_pitch)
    for name, dimensions in DEVIATIONS.items():
        if (elements := getattr(surface, name)) is not None:
            data[name] = (dimensions, elements)
    if surface.life is not None:
        for name, values in vars(surface.life).items():
            data[f"life_{name}"] = (("state", *DEVIATIONS.get(name, ())), values)
    coordinates: dict[str, Any] = {}
    if surface.covariance is not None:
        data["covariance"] = (("parameter", "parameter_"), surface.covariance)
        coordinates["parameter"] = np.array(surface.covariance_of, dtype=object)
    dataset = xr.Dataset(data, coordinates)
    for name, text in {**DESCRIPTIONS, **_DEVIATION_TEXTS}.items():
        if name not in dataset:
            continue
        dataset[name].attrs.update(units=unit_of(name), long_name=text)
        if f"life_{name}" in dataset:
            dataset[f"life_{name}"].attrs.update(units=unit_of(name), long_name=f"{text}; over life")
    if surface.life is not None:
        dataset["life_crank_turns"].attrs.update(units="1", long_name="crank turns since new")
    dataset.attrs.update(surface.attributes, format=FORMAT, origin=surface.origin, pair=surface.pair_text)
    with edge.written_whole(path) as temporary:
        packed = {n: {"zlib": True} for n in dataset.data_vars if str(n).startswith("life_")}
        dataset.to_netcdf(temporary, engine="h5netcdf", encoding=packed)


def read_surface(path: str | os.PathLike[str]) -> ErrorSurface:
    """Read a surface file.

    Raises
    ------
    edge.InputError
        If it can't be read, is of another format, lacks a variable, holds a wrong unit, size or a value not finite.
    """
    data = edge.netcdf(path, FORMAT)
    pair = parse_pair(data.attrs.get("pair", ""), f"{path} (its pair)")
    origin = data.attrs.get("origin")
    if origin not in ORIGINS:
        raise edge.InputError(f'{path}: origin = "{origin}": it must be one of {", ".join(ORIGINS)}.')
    blank = nominal_surface(pair)
    values: dict[str, Any] = {}
    for name in DESCRIPTIONS:
        if name not in data:
            raise edge.InputError(f"{path}: the variable {name} is missing.")
        given, unit = data[name], data[name].attrs.get("units")
        if unit != unit_of(name):
            raise edge.InputError(f'{path}: {name} has the unit "{unit}"; it must be "{unit_of(name)}".')
        shape = np.shape(getattr(blank, name))
        if given.shape != shape:
            raise edge.InputError(f"{path}: {name} has the shape {given.shape}; its pair needs {shape}.")
        if not np.isfinite(given.values).all():
            raise edge.InputError(f"{path}: {name} holds a value that is not finite.")
        values[name] = given.values.astype(float) if shape else float(given)
    for name, dimensions in DEVIATIONS.items():
        if name in data:
            values[name] = _checked_deviation(data[name], name, dimensions, blank, str(path))
    _check_curvatures(values, str(path))
    if "life_crank_turns" in data:
        values["life"] = _checked_life(data, values, str(path))
    kept = {k: v for k, v in data.attrs.items() if k not in ("format", "origin", "pair")}
    covariance = data["covariance"].values.astype(float) if "covariance" in data else None
    names = tuple(str(n) for n in data["parameter"].values) if covariance is not None else ()
    if covariance is not None and not (
        covariance.shape == (len(names),) * 2 and np.isfinite(covariance).all() and (covariance == covariance.T).all()
    ):
        raise edge.InputError(f"{path}: covariance must be symmetric and finite, {len(names)} by {len(names)}.")
    return ErrorSurface(
        **values,
        origin=origin,
        pair_text=pair.text,
        covariance=covariance,
        covariance_of=names,
        attributes=kept,
    )


def _shown(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _checked_deviation(given: Any, name: str, dimensions: tuple[str, ...], blank: ErrorSurface, source: str) -> Array:
    """Check one array of deviations as it was read; the profile, angle and width may have any number of elements."""
    if given.dims != dimensions:
        raise edge.InputError(f"{source}: {name} has the dimensions {given.dims}; it must have {dimensions}.")
    if given.attrs.get("units") != unit_of(name):
        raise edge.InputError(
            f'{source}: {name} has the unit "{given.attrs.get("units")}"; it must be "{unit_of(name)}".'
        )
    sizes = {"disc": blank.tooth_cumulative_pitch.shape[0], "tooth": blank.tooth_cumulative_pitch.shape[1],
             "pin": blank.pin_radial.size}  # fmt: skip
    for dimension, size in zip(dimensions, given.shape, strict=True):
        if size == 0 or size != sizes.get(dimension, size):
            raise edge.InputError(f"{source}: {name} has {size} of {dimension}; its pair needs {sizes[dimension]}.")
    values: Array = given.values.astype(float)
    if not np.isfinite(values).all():
        raise edge.InputError(f"{source}: {name} holds a value that is not finite.")
    largest = np.abs(values).max()
    if unit_of(name) == "m" and largest > LARGEST_ELEMENT:
        raise edge.InputError(
            f"{source}: {name} reaches {largest * 1e3:.4g} mm; deviations must lie within half a millimetre."
        )
    return values


def _checked_life(data: Any, values: Mapping[str, Any], source: str) -> Life:
    """Check the states of a life as they were read."""
    turns = data["life_crank_turns"].values.astype(float)
    if turns.ndim != 1 or turns.size == 0 or turns[0] != 0.0 or not (np.diff(turns) > 0.0).all():
        raise edge.InputError(f"{source}: life_crank_turns must grow from 0, one value a state.")
    states = {}
    for name in DEVIATIONS:
        given = data.get(f"life_{name}")
        if given is None or name not in values or given.shape != (turns.size, *values[name].shape):
            raise edge.InputError(
                f"{source}: life_{name} is missing or its shape is not that of {name} for each state."
            )
        if not np.isfinite(given.values).all():
            raise edge.InputError(f"{source}: life_{name} holds a value that is not finite.")
        states[name] = given.values.astype(float)
    return Life(turns, **states)


def _check_curvatures(values: Mapping[str, Any], source: str) -> None:
    """Refuse curvatures that do not come for both bodies, each with deviations of the same elements."""
    present = [n for n in DEVIATIONS if n in values]
    if not any(n.endswith("_curvature") for n in present):
        return
    for name in DEVIATIONS:
        if name not in present:
            raise edge.InputError(
                f"{source}: the variable {name} is missing; curvatures need all of {', '.join(DEVIATIONS)}."
            )
    for body in ("gear", "pin"):
        mine, theirs = (values[f"{body}_{kind}"].shape for kind in ("curvature", "deviation"))
        if mine != theirs:
            raise edge.InputError(
                f"{source}: {body}_curvature has the shape {mine}; it must have that of {body}_deviation, {theirs}."
            )


def check_surface(pair: Pair, surface: ErrorSurface, pair_source: str, surface_source: str) -> None:
    """Refuse a surface that was made for another pair: geometry, modification and material must be the same.

    Raises
    ------
    edge.InputError
        Naming the first field that differs, both values and both files.
    """
    other = parse_pair(surface.pair_text, f"{surface_source} (its pair)")
    for table in ("pair", "modification", "material"):
        mine, theirs = getattr(pair, table), getattr(other, table)
        for name in type(mine).model_fields:
            if name in ("rated_torque", "contact_law"):
                continue
            if getattr(mine, name) != getattr(theirs, name):
                raise edge.InputError(
                    f"{surface_source}: this surface belongs to another pair: [{table}] {name} is "
                    f"{_shown(getattr(theirs, name))} there and {_shown(getattr(mine, name))} in {pair_source}."
                )
