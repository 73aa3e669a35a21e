"""A drive's bodies at their temperatures: thermal strains, and the resulting pair.

Each body has one temperature and expands equally in all directions (docs/theory/temperature.md). A disc keeps its form,
so a pair at temperature is the pair of its expanded discs; ring, pins, crank and carrier are displaced relative to it,
as by errors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Config
from cycloid_fmu.errors.stated import Errors

if TYPE_CHECKING:
    from cycloid_fmu.geometry.pair import Pair
    from cycloid_fmu.geometry.supports import Bearing

REFERENCE = 293.15
"""K: temperature at which the sizes of a drawing hold (ISO 1)."""
STEEL = 11.5e-6
"""1/K: expansion of steel, that of gauge blocks between 10 and 30 °C, ± 1e-6 (ISO 3650)."""
_COLDEST, HOTTEST = 213.15, 473.15
_LARGEST_EXPANSION = 3e-4  # 1/K, above that of any polymer that gears are made of
BODIES = ("ring", "pins", "discs", "carrier", "crank")
_AROUND = {
    "cranks": {"turning_arm": ("discs", "crank"), "crank_shaft": ("carrier", "crank"), "main": ("ring", "carrier")},
    "output_rollers": {
        "turning_arm": ("discs", "crank"),
        "crank_shaft": ("ring", "crank"),
        "main": ("ring", "carrier"),
    },
}
"""Bodies in which the outer and the inner raceway of each bearing are."""


def _in_range(value: float) -> float:
    if not _COLDEST <= value <= HOTTEST:
        raise ValueError("a temperature must be between -60 degC and 200 degC")
    return value


def _expansion(value: float) -> float:
    if not 0.0 < value <= _LARGEST_EXPANSION:
        raise ValueError(f"an expansion coefficient must be above 0 and at most {_LARGEST_EXPANSION:g} 1/K")
    return value


BodyTemperature = Annotated[edge.Temperature, pydantic.AfterValidator(_in_range)]
Coefficient = Annotated[edge.ThermalExpansion, pydantic.AfterValidator(_expansion)]


class Temperatures(Config):
    """Temperatures of a drive's bodies; bodies that are not stated are at 20 °C, the reference of the drawing (ISO 1).

    Attributes
    ----------
    ring
        Temperature of the pin ring and the housing, K: pin circle, seats of the pins and of the main bearing.
    pins
        Temperature of the pins, K; by default that of the ring.
    discs
        Temperature of the cycloid gears, K: flanks with their modification, holes for cranks or output rollers.
    carrier
        Temperature of the carrier, K: positions of the cranks, or output rollers and their positions.
    crank
        Temperature of crank shafts and eccentrics, K: the eccentricity.

    Examples
    --------
    >>> from cycloid_fmu.geometry.temperature import Temperatures
    >>> str(Temperatures(ring="50 degC", discs=333.15))
    'ring 50 °C, discs 60 °C, carrier 20 °C, crank 20 °C'
    """

    ring: BodyTemperature = REFERENCE
    pins: BodyTemperature | None = None
    discs: BodyTemperature = REFERENCE
    carrier: BodyTemperature = REFERENCE
    crank: BodyTemperature = REFERENCE

    def __str__(self) -> str:
        each = {name: getattr(self, name) for name in BODIES}
        stated = {name: f"{value - 273.15:.6g} °C" for name, value in each.items() if value is not None}
        if len(set(stated.values())) == 1:
            return f"all at {stated['ring']}"
        return ", ".join(f"{name} {value}" for name, value in stated.items())


class Expansions(Config):
    """Coefficients of linear thermal expansion of a drive's bodies; default: steel (ISO 3650).

    Attributes
    ----------
    ring
        Mean coefficient of the ring from 20 °C to its temperature, 1/K; aluminium has 23.1e-6 (CRC Handbook, at 25 °C).
    pins
        Coefficient of the pins, 1/K.
    discs
        Coefficient of the cycloid gears, 1/K.
    carrier
        Coefficient of the carrier and the output rollers, 1/K.
    crank
        Coefficient of crank shafts and eccentrics, 1/K.
    """

    ring: Coefficient = STEEL
    pins: Coefficient = STEEL
    discs: Coefficient = STEEL
    carrier: Coefficient = STEEL
    crank: Coefficient = STEEL


def parse_temperatures(text: str, before: Temperatures | None = None) -> Temperatures:
    """Return the temperatures in a text such as "ring = 50 degC, discs = 60 degC", or "60 degC" for all bodies.

    Parameters
    ----------
    text
        Bodies with their temperatures, or one temperature.
    before
        Temperatures of the bodies that are not in the text; by default 20 °C.

    Raises
    ------
    edge.ArgumentError
        If an entry names no body or no temperature; the error names the argument `temperature`.

    Examples
    --------
    >>> from cycloid_fmu.geometry.temperature import parse_temperatures
    >>> str(parse_temperatures("60 degC")), parse_temperatures("ring = 323.15 K").ring
    ('all at 60 °C', 323.15)
    """
    given: dict[str, Any] = {}
    for each in text.split(","):
        body, is_named, value = (part.strip() for part in each.rpartition("="))
        try:
            kelvin = _in_range(edge.parse_quantity(value, "K"))
        except ValueError as problem:
            raise edge.ArgumentError("temperature", str(problem), each.strip()) from None
        if not is_named and "," not in text:
            return Temperatures(**{name: kelvin for name in BODIES if name != "pins"})
        if body not in BODIES or body in given:
            known = f"give each of {', '.join(BODIES)} at most once, or one temperature for all"
            near = edge.did_you_mean(body, BODIES) if body not in BODIES else ""
            raise edge.ArgumentError("temperature", f"{known}{f'; {near}' if near else ''}", each.strip())
        given[body] = kelvin
    return (before or Temperatures()).replace(**given)


def strains(pair: Pair) -> dict[str, float]:
    """Return the thermal strain of each body from 20 °C, dimensionless, > 0 longer; 0 without temperatures."""
    at = pair.temperature
    if at is None:
        return dict.fromkeys(BODIES, 0.0)
    kelvin = {name: getattr(at, name) for name in BODIES} | {"pins": at.ring if at.pins is None else at.pins}
    return {name: getattr(pair.expansion, name) * (kelvin[name] - REFERENCE) for name in BODIES}


def displaced_by_temperature(pair: Pair) -> dict[str, Any]:
    """Return the displacements of bodies other than the discs from `at_temperature`, by the names of `errors.kinds`, m.

    Empty without temperatures.
    """
    if pair.temperature is None:
        return {}
    by = strains(pair)
    off = {name: by[name] - by["discs"] for name in BODIES}
    found: dict[str, Any] = {
        "crank_throw": pair.eccentricity * off["crank"],
        "pin_radial": np.full(pair.pins, pair.pin_circle_radius * off["ring"]),
        "pin_radius": np.full(pair.pins, pair.pin_radius * off["pins"]),
    }
    if (supports := pair.supports) is not None:
        angle = supports.first_angle + 2.0 * np.pi * np.arange(supports.count) / supports.count
        found["carrier_x"] = supports.circle_radius * off["carrier"] * np.cos(angle)
        found["carrier_y"] = supports.circle_radius * off["carrier"] * np.sin(angle)
    return found


def at_temperature(pair: Pair) -> Pair:
    """Return the pair with the sizes of its discs and all clearances at temperature, as a pair at 20 °C.

    Modifications and the eccentricity of the flanks expand with the discs too. Axial lengths and errors stay as drawn.
    A bearing's clearance follows its bodies if its raceway diameter is given; its rollers have the temperature of the
    inner body.

    Raises
    ------
    edge.InputError
        If the expanded bodies no longer fit together; one sentence.
    """
    if pair.temperature is None:
        return pair
    by = strains(pair)
    larger = 1.0 + by["discs"]
    sizes = {name: larger * getattr(pair, name) for name in ("pin_circle_radius", "pin_radius", "eccentricity")}
    supports = pair.supports
    if supports is not None:
        _check_rigid(pair, by)
        changes: dict[str, Any] = {"circle_radius": larger * supports.circle_radius}
        for name, (outer, inner) in _AROUND[supports.kind].items():
            bearing: Bearing = getattr(supports, name)
            if not bearing.is_rigid and bearing.raceway_diameter is not None:
                wider = bearing.raceway_diameter * (by[outer] - by[inner]) + bearing.clearance * (1.0 + by[inner])
                changes[name] = bearing.replace(clearance=_open(name, wider))
            else:
                changes[name] = bearing.replace(clearance=bearing.clearance * (1.0 + by[inner]))
        seat, roller = supports.pin_seat, supports.output_roller
        if seat.clearance > 0.0:
            wider = seat.clearance * (1.0 + by["ring"]) + 2.0 * pair.pin_radius * (by["ring"] - by["pins"])
            changes["pin_seat"] = seat.replace(clearance=_open("pin_seat", wider))
        if roller is not None and roller.stiffness is not None:
            wider = roller.clearance * larger + 2.0 * (roller.radius or 0.0) * (by["discs"] - by["carrier"])
            changes["output_roller"] = roller.replace(clearance=_open("output_roller", wider))
        supports = supports.replace(**changes)
    drawn = pair.modification
    return pair.replace(
        **sizes,
        isometric=larger * drawn.isometric,
        offset=larger * drawn.offset,
        supports=supports,
        temperature=None,
        errors=Errors(),
    )


def _open(name: str, clearance: float) -> float:
    if clearance < 0.0:
        raise edge.InputError(f"the clearance of {name} falls to {clearance * 1e6:.3g} um; the model has no preload.")
    return clearance


def _check_rigid(pair: Pair, by: dict[str, float]) -> None:
    """Refuse rigid bearings between bodies with different expansion."""
    supports = pair.supports
    assert supports is not None
    if supports.kind == "cranks":
        name, rigid, others = "turning_arm", supports.turning_arm.is_rigid, ["carrier"]
    else:
        roller = supports.output_roller
        name, rigid, others = "output_roller", roller is None or roller.stiffness is None, ["carrier", "crank"]
    for other in others:
        if rigid and by[other] != by["discs"]:
            raise edge.InputError(f"{name} is rigid, but {other} and discs expand differently; state its stiffness.")


def missing_for_clearances(pair: Pair) -> list[str]:
    """Return the missing sizes without which a clearance between bodies of different expansion stays as drawn."""
    supports = pair.supports
    if supports is None or pair.temperature is None:
        return []
    by = strains(pair)
    found = []
    for name, (outer, inner) in _AROUND[supports.kind].items():
        bearing: Bearing = getattr(supports, name)
        if by[outer] != by[inner] and not bearing.is_rigid and bearing.raceway_diameter is None:
            found.append(f"{name}.raceway_diameter")
    roller = supports.output_roller
    if roller is not None and roller.stiffness is not None and roller.radius is None and by["discs"] != by["carrier"]:
        found.append("output_roller.radius")
    return found
