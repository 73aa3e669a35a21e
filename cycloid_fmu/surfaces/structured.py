"""Structured errors: the parameters in which errors are fitted, tuned and compared, and their displacements.

A kind with one value is itself a structured error. For errors around a circle, the structured errors are the cosine and
sine parts of low orders; for the flank, the low orders of a profile deviation common to all teeth.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import BODIES, EACH_PIN, EACH_SUPPORT, KINDS, ErrorKind, kind_of, kinds_of, wave_of
from cycloid_fmu.geometry.pair import Pair, smallest_convex_radius
from cycloid_fmu.geometry.temperature import displaced_by_temperature
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
PROFILE_POINTS = 100  # elements of a profile without deviation arrays: its low orders are smooth
_PROFILE = re.compile(r"profile_deviation_([1-9])")


def unit_of(name: str) -> str:
    """SI unit of an error: "m" or "rad" for a kind, "1/m" for curvatures."""
    kind = kind_of(name)
    if kind is not None:
        return kind.unit
    return "1/m" if name.endswith("_curvature") else "m"


def profile_names(orders: Collection[int]) -> list[str]:
    """Names of the profile deviation's orders: cosines with order/2 waves along every tooth's arc, root to root."""
    return [f"profile_deviation_{order}" for order in orders]


def profile_wave(name: str, elements: int) -> Array | None:
    """Values of an order of the profile deviation at the elements' middles, shape (elements,); None for other names."""
    match = _PROFILE.fullmatch(name)
    return None if match is None else np.cos(np.pi * int(match[1]) * (np.arange(elements) + 0.5) / elements)


def _wave(pair: Pair, name: str) -> tuple[ErrorKind, Array]:
    found = wave_of(name)
    if found is None:
        raise ValueError(f'"{name}" is not a structured error')
    kind, order, part = found
    return kind, _wave_of(name, kind.shape(pair)[-1], order, part)


@functools.lru_cache(maxsize=1024)
def _wave_of(name: str, count: int, order: int, part: str) -> Array:
    if 2 * order > count:
        raise ValueError(f'"{name}": the order must be at most half of {count}')
    argument = 2.0 * np.pi * order * np.arange(count) / count
    wave = np.cos(argument) if part == "cos" else np.sin(argument)
    wave.flags.writeable = False
    return wave


def _is_number(name: str) -> bool:
    return name in KINDS and KINDS[name].of == "drive"


def structured_value(surface: ErrorSurface, name: str) -> float:
    """Value of a structured error in a surface, m or rad; errors of teeth are averaged over teeth and discs."""
    if _is_number(name):
        return float(surface.errors[name])
    flanks = surface.gear_deviation
    profile = profile_wave(name, PROFILE_POINTS if flanks is None else flanks.shape[2])
    if profile is not None:
        return 0.0 if flanks is None else float(2.0 * (flanks * profile[:, None]).mean())
    kind, wave = _wave(surface.pair, name)
    return float((surface.errors[kind.name] * wave).mean() / np.mean(wave**2)) if wave.any() else 0.0


def with_structured(surface: ErrorSurface, values: Mapping[str, float]) -> ErrorSurface:
    """Return a surface with given values (m or rad) of the named structured errors; all others are kept.

    Raises
    ------
    ValueError
        If a name is not a structured error of this pair.
    """
    pair = surface.pair
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if _is_number(name):
            changes[name] = float(value)
            continue
        profile = profile_wave(
            name, PROFILE_POINTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
        )
        if profile is not None:
            before = structured_value(surface, name)
            blank = np.zeros((pair.discs, pair.gear_teeth, profile.size, 1)) if value != before else None
            flanks = changes.get("gear_deviation", surface.gear_deviation)
            flanks = blank if flanks is None else flanks
            changes["gear_deviation"] = None if flanks is None else flanks + (value - before) * profile[:, None]
            continue
        kind, wave = _wave(pair, name)
        held = changes.get(kind.name, surface.errors[kind.name])
        changes[kind.name] = held + (value - structured_value(surface, name)) * wave
    return surface.replace(**changes)


def displacement_layout(pair: Pair) -> dict[str, slice]:
    """Return the position of each displacement in the vector of all: `BODIES`, pins, teeth, supports."""
    found = {name: slice(i, i + 1) for i, name in enumerate(BODIES)}
    start = len(BODIES)
    for name in EACH_PIN:
        found[name] = slice(start, start + pair.pins)
        start += pair.pins
    teeth = pair.discs * pair.gear_teeth
    found["tooth_turn"] = slice(start, start + teeth)
    start += teeth
    for name, place in EACH_SUPPORT.items():
        if place in pair.places:
            size = math.prod(pair.places[place])
            found[name] = slice(start, start + size)
            start += size
    return found


def displacement_size(pair: Pair) -> int:
    """Return the number of all displacements."""
    return int(max(place.stop for place in displacement_layout(pair).values()))


def displacements(pair: Pair, surface: ErrorSurface, nominal: Mapping[str, Any]) -> dict[str, Any]:
    """Return the displacements due to all errors of a surface and the temperatures, to be added to `nominal` by name.

    The result has a value for every name of `BODIES`, an array (pins,) for each of `EACH_PIN`, `tooth_turn` (discs,
    teeth) and, for a pair with supports, an array for each of `EACH_SUPPORT`, in m and rad.
    """
    found: dict[str, Any] = dict.fromkeys(BODIES, 0.0)
    found |= dict.fromkeys(EACH_PIN, np.zeros(pair.pins))
    found["tooth_turn"] = np.zeros((pair.discs, pair.gear_teeth))
    found |= {name: np.zeros(pair.places[place]) for name, place in EACH_SUPPORT.items() if place in pair.places}
    for name, value in nominal.items():
        found[name] = value + found[name] if np.ndim(found[name]) else value
    for name, value in displaced_by_temperature(pair).items():
        found[name] = found[name] + value
    for name, kind in kinds_of(pair).items():
        for displaced, displacement in kind.displaces.items():
            found[displaced] = found[displaced] + displacement(pair, surface.errors[name])
    return found


def dimensions(pair: Pair, surface: ErrorSurface, source: str = "errors") -> dict[str, Any]:
    """Return the dimensions of a drive with its errors, at its temperatures, as `displacements` does.

    Parameters
    ----------
    source
        Source of the errors, for messages.

    Raises
    ------
    edge.InputError
        If the drive is impossible; the checks are those of a pair as drawn, with its errors.
    """
    made = displacements(pair, surface, _nominal_dimensions(pair))
    _check_dimensions(pair, made, source)
    return made


def dimensions_of(pair: Pair, displaced: Mapping[str, Array]) -> dict[str, Array]:
    """Return the dimensions of many drives, checked as those of one.

    Parameters
    ----------
    displaced
        Displacements by their names, as `displacements_of` returns them.

    Raises
    ------
    edge.InputError
        As `dimensions`, for the first drive that is impossible.
    """
    made = {**displaced, **{name: value + displaced[name] for name, value in _nominal_dimensions(pair).items()}}
    _check_dimensions(pair, made, "errors")
    return made


def _nominal_dimensions(pair: Pair) -> dict[str, float]:
    warm = pair.at_temperature
    return {
        "crank_throw": warm.eccentricity,
        "generating_pin_radius": warm.generating_pin_radius,
        "generating_circle_radius": warm.generating_circle_radius,
        "pin_radial": warm.pin_circle_radius,
        "pin_radius": warm.pin_radius,
    }


def _check_dimensions(pair: Pair, made: Mapping[str, Any], source: str) -> None:
    """Check the dimensions of one drive, or of many in a leading axis, as `dimensions` does."""
    if pair.temperature is not None:
        source = source.replace("errors", "temperature and errors")
    pair = pair.at_temperature
    radius = np.asarray(made["pin_radius"])
    place = made["pin_radial"] * np.exp(
        1j * (2.0 * np.pi * np.arange(pair.pins) / pair.pins + made["pin_tangential"] / pair.pin_circle_radius)
    )
    after = np.arange(1, pair.pins + 1) % pair.pins
    room = np.abs(place - place[..., after]) - radius - radius[..., after]
    thinnest, closest = radius.min(axis=-1), room.min(axis=-1)
    for drive in np.ndindex(thinnest.shape):
        throw, circle, pin = (
            float(np.asarray(made[name])[drive])
            for name in ("crank_throw", "generating_circle_radius", "generating_pin_radius")
        )
        why = ""
        if not throw > 0.0:
            why = f"the eccentricity is {throw * 1e3:.6g} mm; it must stay above zero"
        elif pair.eccentricity * pair.pins >= circle:
            why = f"the generating circle's radius is {circle * 1e3:.6g} mm; it must stay above eccentricity x pins"
        elif not 0.0 < pin < (smallest := smallest_convex_radius(circle, pair.eccentricity, pair.pins)):
            limit = "it must stay above zero" if pin <= 0.0 else f"the flank is undercut above {smallest * 1e3:.6g} mm"
            why = f"the flank's generating pin radius is {pin * 1e3:.6g} mm; {limit}"
        elif not thinnest[drive] > 0.0:
            why = f"a pin's radius is {thinnest[drive] * 1e3:.6g} mm; it must stay above zero"
        elif not closest[drive] > 0.0:
            first = int(room[drive].argmin())
            why = f"pins {first} and {(first + 1) % pair.pins} overlap by {-closest[drive] * 1e6:.6g} um"
        if why:
            raise edge.InputError(f"{source}: with these, {why}.")


def displacement_vector(pair: Pair, surface: ErrorSurface) -> Array:
    """Return the displacements due to all errors of a surface as a vector in the order of `displacement_layout`."""
    return np.concatenate([np.ravel(values) for values in displacements(pair, surface, {}).values()])


def displacements_of(pair: Pair, vectors: Array) -> dict[str, Array]:
    """Return displacements by their names, shape (drives, ...), from rows of `displacement_vector`."""
    found = {}
    for name, at in displacement_layout(pair).items():
        values = vectors[:, at]
        found[name] = values[:, 0] if name in BODIES else values
    found["tooth_turn"] = found["tooth_turn"].reshape(len(vectors), pair.discs, pair.gear_teeth)
    return found


def displacement_columns(pair: Pair, names: Iterable[str]) -> Array:
    """Return the linear map from structured errors to displacements, shape (displacements, names).

    Orders of the profile deviation are not included.
    """
    return _columns_of(pair.nominal, tuple(names))


@functools.lru_cache(maxsize=16)
def _columns_of(pair: Pair, names: tuple[str, ...]) -> Array:
    layout = displacement_layout(pair)
    columns = np.zeros((max(place.stop for place in layout.values()), len(names)))
    for column, name in zip(columns.T, names, strict=True):
        if _is_number(name):
            kind, shape = KINDS[name], np.asarray(1.0)
        elif profile_wave(name, 1) is None:
            kind, shape = _wave(pair, name)
            shape = np.broadcast_to(shape, kind.shape(pair))
        else:
            continue
        for displaced, displacement in kind.displaces.items():
            column[layout[displaced]] += np.ravel(displacement(pair, shape))
    columns.flags.writeable = False
    return columns
