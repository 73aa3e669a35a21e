"""A cycloid-pin gear pair: geometry, profile modification, material and stated errors.

The pair file `cycloid-pair/1` is read and written here; all values in this module are SI. A pair is identified by its
values: its text is generated from them, never copied from a file.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Config, Length
from cycloid_fmu.errors.kinds import KINDS, LARGEST_DEVIATION, kinds_of
from cycloid_fmu.errors.stated import Errors
from cycloid_fmu.geometry import sizes
from cycloid_fmu.geometry import temperature as thermal
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.losses import Losses
from cycloid_fmu.geometry.materials import MATERIALS, MaterialValue
from cycloid_fmu.geometry.sizes import ABOVE_ZERO, PositivePressure
from cycloid_fmu.geometry.supports import Supports
from cycloid_fmu.geometry.temperature import Expansions, Temperatures
from cycloid_fmu.geometry.thermal import Thermal

FORMAT = "cycloid-pair/1"
LOST_MOTION_LOAD = 0.03  # share of the rated torque (GB/T 40731)
_SHARE = f"{100.0 * LOST_MOTION_LOAD:g} %"
LOST_MOTION = f"output angle at +{_SHARE} of the rated torque minus that at -{_SHARE} (GB/T 40731)"


def _teeth(value: int) -> int:
    if value < LEAST_TEETH:
        raise ValueError(
            f"it must be at least {LEAST_TEETH}; with one tooth, at some crank angles no pin has a lever arm"
        )
    if value > MOST_TEETH:
        raise ValueError(f"it must be at most {MOST_TEETH}; larger numbers are not checked against a second solver")
    return value


LARGEST_PRESSURE = 4e9
"""Pa: contact stress at which rolling bodies of bearing steel are permanently deformed (ISO 76, static rating)."""
_STEEL = 0.1  # share by which Young's modulus of bearing steel differs from that of other steels at most
_LARGEST_SHARE = 1.0 / 64.0  # largest modification as a share of the pin circle's radius, if that is more than 1 mm
LEAST_TEETH, MOST_TEETH = 2, 300
GearTeeth = Annotated[int, pydantic.Field(strict=True), pydantic.AfterValidator(_teeth)]
PositiveTorque = Annotated[edge.Torque, ABOVE_ZERO]


class PressureLimit(NamedTuple):
    """Largest permitted contact pressure, Pa, and what it is, as text; "" where a pair file states it."""

    pressure: float
    basis: str


class Material(Config):
    """An elastic material; the default is bearing steel.

    Attributes
    ----------
    name
        Name of an entry of `MATERIALS`, such as "7075-T6", for what is not stated here: modulus, Poisson's
        ratio, and the contact pressure that a drive without a `pressure_limit` may have.
    youngs_modulus
        Young's modulus E, Pa.
    poissons_ratio
        Poisson's ratio ν.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> cy.Material(youngs_modulus="70 GPa").youngs_modulus
    70000000000.0
    >>> round(cy.Material(name="7075-T6").youngs_modulus * 1e-9, 1)
    71.5
    """

    name: str | None = None
    youngs_modulus: PositivePressure = 206e9
    poissons_ratio: float = pydantic.Field(default=0.3, ge=0.0, lt=0.5)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _from_table(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or given.get("name") is None:
            return given
        name = given["name"]
        edge.check_named(name, MATERIALS, "name")
        value = MATERIALS[name]
        # Text, because a quantity in a file needs its unit.
        return {"youngs_modulus": f"{value.modulus!r} Pa", "poissons_ratio": value.poissons_ratio, **given}

    @property
    def value(self) -> MaterialValue | None:
        """The table's entry of its name; None without a name."""
        return None if self.name is None else MATERIALS[self.name]

    @property
    def pressure_limit(self) -> PressureLimit | None:
        """Largest permitted pressure of a line contact: that of its name, or of steel; None for other materials."""
        if self.value is not None:
            return PressureLimit(self.value.largest_pressure, f"of {self.name} ({self.value.basis_of_pressure})")
        if abs(self.youngs_modulus / Material.model_fields["youngs_modulus"].default - 1.0) <= _STEEL:
            return PressureLimit(LARGEST_PRESSURE, "of hardened bearing steel (ISO 76)")
        return None

    @property
    def compliance(self) -> float:
        """V = (1 - ν²)/E of Hertz's line contact, 1/Pa."""
        return (1.0 - self.poissons_ratio**2) / self.youngs_modulus


class Materials(Config):
    """The materials of the parts.

    Attributes
    ----------
    gear, pin
        Of both flanks.
    output_pin, ring
        Of these bodies and their strength; None for steel whose strength is not known.
    """

    gear: Material = Material()
    pin: Material = Material()
    output_pin: Material | None = None
    ring: Material | None = None

    def of(self, part: str) -> Material:
        """Return the elastic material of a part, steel where none is stated."""
        return getattr(self, part) or Material()


class Modification(Config):
    """Profile modification of the gear, m; its two parts have opposite signs, as in the papers.

    Attributes
    ----------
    isometric
        ΔR_rp, added to the generating pin's radius: > 0 removes material, equally along the flank.
    offset
        ΔR_p, added to the generating circle's radius: < 0 removes material; > 0 adds it, so that gear and pins
        interfere.
    """

    isometric: Length = 0.0
    offset: Length = 0.0


class _Geometry(Config):
    """The geometry as drawn."""

    gear_teeth: GearTeeth
    pins: int | None = pydantic.Field(default=None, strict=True)
    pin_circle_radius: sizes.CircleRadius
    pin_radius: sizes.PinRadius
    eccentricity: sizes.Eccentricity
    face_width: sizes.Width
    discs: int = pydantic.Field(default=1, ge=1, le=4, strict=True)
    output: Literal["gear", "ring"] = "gear"
    rated_torque: PositiveTorque | None = None
    contact_law: Literal["capped", "as_printed"] = "capped"
    pressure_limit: PositivePressure | None = None


class PairTables(Config):
    """The tables of a file beside `[pair]` and `[errors]`."""

    modification: Modification = Modification()
    material: Materials = Materials()
    supports: Supports | None = None
    bodies: Bodies | None = None
    losses: Losses | None = None
    thermal: Thermal | None = None
    temperature: Temperatures | None = None
    expansion: Expansions = Expansions()


class _Drawn(Config):
    pair: _Geometry


class _File(PairTables, _Drawn):
    """A gear pair as drawn; `[errors]` states the errors of the part."""


class Pair(PairTables, _Geometry):
    """A cycloid-pin gear pair, SI units, validated: it has one more pin than teeth and can be made and assembled.

    Pairs with the same values are equal and have the same hash and `text`, however they were made. Lengths and other
    quantities are SI numbers or text with a unit, `0.064` or `"64 mm"`.

    Attributes
    ----------
    gear_teeth
        Teeth of the cycloid gear, z_c, 2 to 300.
    pins
        Pins of the ring, z_p = z_c + 1; can be left out.
    pin_circle_radius
        Radius R_p of the circle on which the pins' axes are, m.
    pin_radius
        Radius R_rp of a pin, m.
    eccentricity
        Eccentricity e of the crank: distance of the gear's axis from the ring's, m.
    face_width
        Contact width b of gear and pins, of each disc, m.
    discs
        Number of cycloid gears, evenly spaced around the crank.
    output
        "gear": the gear drives the output in a fixed ring; "ring": the ring is the output, and the gear only orbits.
    rated_torque
        Rated torque at the output, N·m: the default load, and the reference of the loads for lost motion.
    contact_law
        "capped" bounds the flank's curvature radius in Hertz's logarithm by the pin circle radius.
    pressure_limit
        Contact pressure above which results carry a note, Pa; by default that of named materials, or 4 GPa (ISO 76).
    modification, material
        Profile modification of the gear and the materials of both flanks.
    supports
        Supports of discs and carrier; None for rigid bearings.
    bodies
        Elastic bodies, which need supports; None for rigid ones.
    losses
        Friction and drags; None if no friction is stated. Part of `Drive.losses` alone.
    thermal
        How the drive gives off heat; None if that is not stated. Part of `Drive.heat` alone.
    temperature
        Temperatures of the bodies; None for 20 °C, the reference of the drawing.
    expansion
        Coefficients of thermal expansion of the bodies.
    errors
        The stated errors, by the keys of a pair file's `[errors]`.

    Raises
    ------
    edge.InputError
        If a value is missing or out of range, or the pair can't be made; one sentence for each problem, with the value.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius=0.003, eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> pair.pins, pair.ratio
    (40, -39.0)
    >>> pair.replace(eccentricity="1.7 mm")
    Traceback (most recent call last):
    ...
    cycloid_fmu.geometry.pair.ContradictionError: eccentricity = "1.7 mm": eccentricity x pins / pin circle radius is
    1.0625; it must stay below 1, so the eccentricity below "1.6 mm".
    """

    pins: int = pydantic.Field(strict=True)
    errors: pydantic.InstanceOf[Errors] = Errors()

    def __init__(self, /, **values: Any) -> None:
        errors = values.pop("errors", Errors())
        if not isinstance(errors, Errors):
            errors = Errors(errors)
        if values.get("pins") is None and isinstance(values.get("gear_teeth"), int):
            values["pins"] = values["gear_teeth"] + 1
        super().__init__(**{**values, "errors": errors})
        for table, sentence in _contradictions(self):
            raise ContradictionError(table, sentence)

    def replace(self, **changes: Any) -> Self:
        """Return the pair with other values, validated as a file is.

        `isometric` and `offset` may be given directly; `errors` contains only the errors that change.

        Raises
        ------
        edge.InputError
            As constructing it does.
        """
        values = {name: getattr(self, name) for name in type(self).model_fields}
        drawn = {n: changes.pop(n) for n in Modification.model_fields if n in changes}
        if drawn:
            values["modification"] = self.modification.replace(**drawn)
        if isinstance(errors := changes.get("errors"), Mapping) and not isinstance(errors, Errors):
            changes["errors"] = Errors({**self.errors, **Errors(errors), **_zeros(errors)})
        return type(self)(**{**values, **changes})

    @functools.cached_property
    def places(self) -> dict[str, tuple[int, ...]]:
        """Shape of an error's values by `ErrorKind.of`: {"pin": (40,), …}."""
        found: dict[str, tuple[int, ...]] = {"drive": (), "pin": (self.pins,), "tooth": (self.discs, self.gear_teeth)}
        if self.supports is not None:
            count = self.supports.count
            found |= {"hole": (self.discs, count), "support": (count,)}
            found["eccentric"] = (self.discs, self.supports.cranks)
            if self.supports.kind == "cranks":
                found["crank"] = (count,)
            else:
                found |= {"roller": (count,), "roller_hole": (self.discs, count)}
        return found

    @property
    def at_temperature(self) -> Pair:
        """The pair as drawn, with the sizes of its discs at their temperature; unchanged without temperatures."""
        return self if self.temperature is None else self.grown  # a pair that refers to itself can't be compared

    @functools.cached_property
    def grown(self) -> Pair:
        """The result of `at_temperature` for a pair with temperatures, cached."""
        return thermal.at_temperature(self)

    @property
    def nominal(self) -> Self:
        """The pair as drawn, without its stated errors."""
        return self.replace(errors=Errors()) if self.errors else self

    @functools.cached_property
    def text(self) -> str:
        """The pair as the text of a pair file, made from its values alone: `parse_pair` gives an equal pair."""
        return _text_of(self)

    @property
    def hash(self) -> str:
        """The values' fingerprint: the first 16 hexadecimal digits of SHA-256 over `text`."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:16]

    @property
    def ratio(self) -> float:
        """Signed ratio φ_a/φ_b of the ideal drive: -z_c with the gear as output, +z_p with the ring."""
        return float(-self.gear_teeth if self.output == "gear" else self.pins)

    @property
    def largest_pressure(self) -> PressureLimit | None:
        """The stated pressure limit, or that of the weaker of gear and pin; None if that of one is not known."""
        if self.pressure_limit is not None:
            return PressureLimit(self.pressure_limit, "")
        of = [material.pressure_limit for material in (self.material.gear, self.material.pin)]
        known = [limit for limit in of if limit is not None]
        return min(known) if len(known) == len(of) else None

    def rated_load(self, source: str = "the pair") -> float:
        """Return the rated torque, N·m: the load wherever none is given.

        Raises
        ------
        edge.ArgumentError
            If the pair has none; `source` is the name of its file.
        """
        if self.rated_torque is None:
            raise edge.ArgumentError("torque", f"is missing; give it, or state [pair] rated_torque in {source}")
        return self.rated_torque

    @property
    def lost_motion_loads(self) -> list[float]:
        """Torques of the lost motion, ± `LOST_MOTION_LOAD` times the rated one, N·m; empty without a rated torque."""
        rated = self.rated_torque
        return [] if rated is None else [LOST_MOTION_LOAD * rated, -LOST_MOTION_LOAD * rated]

    @property
    def generating_circle_radius(self) -> float:
        """R = R_p + ΔR_p of the nominal flank, m."""
        return self.pin_circle_radius + self.modification.offset

    @property
    def generating_pin_radius(self) -> float:
        """R = R_rp + ΔR_rp of the nominal flank, m."""
        return self.pin_radius + self.modification.isometric

    @property
    def shortening(self) -> float:
        """K = e z_p/R of the nominal flank (the papers' shortening coefficient)."""
        return self.eccentricity * self.pins / self.generating_circle_radius


class ContradictionError(edge.InputError):
    """Values that contradict each other, though each is valid by itself; `table` is their table in a pair file."""

    def __init__(self, table: str, sentence: str) -> None:
        super().__init__(f"{sentence}.")
        self.table = table


def _contradictions(pair: Pair) -> list[tuple[str, str]]:
    """Return the reasons why a pair or its errors are impossible: the table in a pair file, and a sentence."""
    geometric = _contradiction_of_numbers(pair) or _contradiction_of_flank(pair)
    if geometric is not None:
        return [geometric]
    reasons = _contradictions_of_supports(pair)
    if not reasons:
        try:
            _ = pair.at_temperature
        except edge.InputError as problem:
            reasons.append(("temperature", f"at these temperatures, {problem}".rstrip(".")))
    return reasons + _contradictions_of_errors(pair)


def _contradiction_of_numbers(pair: Pair) -> tuple[str, str] | None:
    """Return why the numbers of pins and teeth do not belong together."""
    teeth = pair.gear_teeth
    if pair.pins == teeth + 1:
        return None
    sentence = f"pins = {pair.pins}: a gear of gear_teeth = {teeth} needs one pin more, {teeth + 1}"
    if pair.pins > teeth:
        why = "with more pins, flanks of neighbouring teeth cross, and contact on the truncated tips"
        sentence += f"; {why} is not modelled"
    elif pair.pins < teeth:
        why = "with fewer pins than lobes (hypocycloid) the flanks lie around the pins, in a ring, which"
        sentence += f"; {why} is not modelled"
    return "pair", sentence


def _contradiction_of_flank(pair: Pair) -> tuple[str, str] | None:
    """Return why there is no flank with these radii, eccentricity and modification."""
    most = max(LARGEST_DEVIATION, _LARGEST_SHARE * pair.pin_circle_radius)
    for name in Modification.model_fields:
        if abs(value := getattr(pair.modification, name)) > most:
            limits = f"it must be between -{most * 1e3:.6g} mm and {most * 1e3:.6g} mm for this pin circle"
            return "modification", f"{name} = {_mm(value)}: {limits}"
    k = pair.shortening
    if k >= 1.0:
        largest = pair.generating_circle_radius / pair.pins
        return (
            "pair",
            f"eccentricity = {_mm(pair.eccentricity)}: eccentricity x pins / pin circle radius is {k:.4f}; "
            f"it must stay below 1, so the eccentricity below {_mm(largest)}",
        )
    smallest = smallest_convex_radius(pair.generating_circle_radius, pair.eccentricity, pair.pins)
    if pair.generating_pin_radius >= smallest:
        return (
            "pair",
            f"pin_radius = {_mm(pair.pin_radius)}: the flank is undercut; with its modification the pin radius "
            f"must stay below the smallest curvature radius of its centre's path, {_mm(smallest)}",
        )
    gap = 2.0 * pair.pin_circle_radius * math.sin(math.pi / pair.pins)
    if 2.0 * pair.pin_radius >= gap:
        sentence = f"neighbouring pins overlap; it must stay below {_mm(gap / 2)}"
        return "pair", f"pin_radius = {_mm(pair.pin_radius)}: {sentence}"
    return None


def _contradictions_of_errors(pair: Pair) -> list[tuple[str, str]]:
    """Return which lists of errors do not fit the pair's supports, discs, teeth or pins."""
    reasons = []
    possible = kinds_of(pair)
    for kind in KINDS.values():
        stated = getattr(pair.errors, kind.file_key)
        if not isinstance(stated, tuple) or not stated:
            continue
        if kind.name not in possible:
            has = "no [supports]" if pair.supports is None else f'supports of kind = "{pair.supports.kind}"'
            reasons.append(("errors.supports", f"{kind.file_key} is stated, but the pair has {has}"))
            continue
        rows = stated if isinstance(stated[0], tuple) else (stated,)
        if isinstance(stated[0], tuple) and len(stated) != pair.discs:
            sentence = f"{kind.file_key} has {len(stated)} lists; it needs one for each disc, {pair.discs}"
            reasons.append(("errors", sentence))
        count = kind.shape(pair)[-1]
        for row in rows:
            if len(row) != count:
                what = kind.of.replace("_", " ")
                sentence = f"{kind.file_key} has {len(row)} values; it needs one for each {what}, {count}"
                reasons.append(("errors", sentence))
    return reasons


def _contradictions_of_supports(pair: Pair) -> list[tuple[str, str]]:
    supports, errors = pair.supports, pair.errors
    if supports is None and pair.bodies is not None:
        return [("bodies", "it needs [supports]: what bears the discs also loads them")]
    if supports is None:
        return []
    found = []
    if pair.losses is not None and supports.kind == "cranks" and pair.losses.output_roller is not None:
        found.append(("losses.output_roller", 'it belongs to kind = "output_rollers"; cranks have none'))
    if pair.output == "ring":
        found.append(("supports", 'output = "ring": supports need a carrier that turns; give output = "gear"'))
    for name in ("misalignment_xz", "misalignment_yz"):
        if getattr(errors, name) != 0.0:
            found.append(("errors", f"{name}: the model of a drive with supports is plane, so it has no misalignment"))
    if supports.kind == "cranks":
        part, bodies, mend, is_rigid = "turning_arm", "cranks", "stiffness or rollers", supports.turning_arm.is_rigid
    else:
        roller = supports.output_roller
        part, bodies, mend, is_rigid = "output_roller", "rollers", "stiffness", roller is None or not roller.stiffness
    stated = [key for key in _ASSEMBLED[part] if key in errors]
    if is_rigid and stated:
        sentence = f"{part} is rigid, so {bodies} and holes with an error ({stated[0]}) can't be assembled"
        found.append(("supports", f"{sentence}; state its {mend}"))
    return found


_CRANK, _HOLE, _ROLLER = ("crank_throw", "crank_phase"), ("hole_x", "hole_y"), ("roller_x", "roller_y", "hole_radius")
_ASSEMBLED = {
    "turning_arm": (*_HOLE, "crank_x", "crank_y", *_CRANK),
    "output_roller": ("eccentricity", *_CRANK, *_HOLE, *_ROLLER),
}
"""Errors with which a drive can't be assembled if this part is rigid."""


def _zeros(errors: Mapping[str, Any]) -> dict[str, Any]:
    """Return the errors to remove: those whose new value is zero."""
    return {key: value for key, value in errors.items() if key not in Errors(errors)}


def _mm(value: float) -> str:
    return f'"{value * 1e3:.6g} mm"'


def smallest_convex_radius(circle_radius: float, eccentricity: float, pins: int) -> float:
    """Smallest convex curvature radius of the pin centre's path in the gear, m; infinite if it is nowhere convex.

    With K = e z_p/R the radius is R S³/(1 + z_p K² - K (z_p + 1) cos φ). Its minimum is where the derivative vanishes,
    cos φ = (K²(2 z_p - 1) + 2 - z_p)/(K (z_p + 1)), or at the tip (cos φ = -1) if that is outside.
    """
    k = eccentricity * pins / circle_radius
    stationary = (k * k * (2.0 * pins - 1.0) + 2.0 - pins) / (k * (pins + 1.0))
    radii = []
    for c in (max(-1.0, min(1.0, stationary)), -1.0, 1.0):
        denominator = 1.0 + pins * k * k - k * (pins + 1.0) * c
        if denominator > 0.0:
            radii.append(circle_radius * (1.0 + k * k - 2.0 * k * c) ** 1.5 / denominator)
    return min(radii, default=math.inf)


_SHOWN_UNITS = {
    "m": ("mm", "um"),
    "Pa": ("GPa",),
    "N*m": (),
    "rad": ("mrad",),
    "N/m": ("N/um",),
    "N*m/rad": ("N*m/arcmin",),
    "N": ("kN",),
    "K": (),
    "m/s": (),
    "m^2/s": ("mm^2/s",),
    "N*m*s/rad": (),
    "1/K": (),
    "W/(m^2*K)": (),
    "K/W": (),
    "J/K": (),
    "m^2": (),
}


def _written(value: float, si: str) -> str:
    """Write a quantity so that reading it gives the same number, in the unit of drawings where possible."""
    value += 0.0  # -0 is 0
    units = _SHOWN_UNITS[si]
    for unit in reversed(units) if 0.0 < abs(value) < 1e-4 else units:
        shown = f"{value / edge.unit_scale(unit, si):.12g} {unit}"
        if edge.parse_quantity(shown, si) == value:
            return shown
    return f"{value!r} {si}"


def _toml(value: Any, si: str | None) -> str:
    if isinstance(value, Config):
        return f"{{ {', '.join(_table_lines('', value, type(value))[1:])} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(each, si) for each in value)}]"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, int) or si is None:
        return repr(value)
    return f'"{_written(value, si)}"'


def _error_toml(stated: Any, unit: str) -> str:
    if isinstance(stated, Mapping):
        waves = (f"order_{k} = [{_toml(a, unit)}, {_toml(p, 'rad')}]" for k, (a, p) in sorted(stated.items()))
        return f"{{ {', '.join(waves)} }}"
    if isinstance(stated, tuple):
        return f"[{', '.join(_error_toml(v, unit) for v in stated)}]"
    return _toml(stated, unit)


def _table_lines(title: str, table: Config, model: type[Config]) -> list[str]:
    lines = [f"[{title}]"]
    for name, field in model.model_fields.items():
        value = getattr(table, name)
        if not (value is None or value is False or isinstance(value, Config) or name == "windows"):
            lines.append(f"{field.alias or name} = {_toml(value, edge.unit_of_field(field))}")
    return lines


def _tables_below(title: str, table: Config) -> list[str]:
    """Return the lines of a table's own tables that state something."""
    lines = []
    for name in type(table).model_fields:
        below = getattr(table, name)
        if isinstance(below, Config) and below != type(below).model_construct():
            lines += _table_lines(f"{title}.{name}", below, type(below))
    return lines


def _text_of(pair: Pair) -> str:
    lines = [f'format = "{FORMAT}"']
    tables: dict[str, Config] = {
        "modification": pair.modification,
        "material.gear": pair.material.gear,
        "material.pin": pair.material.pin,
    }
    for part in ("output_pin", "ring"):
        if (material := getattr(pair.material, part)) is not None:
            tables[f"material.{part}"] = material
    for title, table in {"pair": pair, **tables}.items():
        lines += _table_lines(title, table, _Geometry if table is pair else type(table))
    if pair.supports is not None:
        lines += [*_table_lines("supports", pair.supports, Supports), *_tables_below("supports", pair.supports)]
    if pair.bodies is not None:
        lines += _table_lines("bodies", pair.bodies, Bodies)
        for name, body in pair.bodies.stated():
            lines += _table_lines(f"bodies.{name}", body, type(body))
            for window in getattr(body, "windows", ()):
                lines += ["[[bodies.disc.windows]]", *_table_lines("", window, type(window))[1:]]
    if pair.losses is not None:
        lines += _tables_below("losses", pair.losses) or ["[losses]"]
    if pair.thermal is not None:
        lines += _table_lines("thermal", pair.thermal, Thermal)
    if pair.temperature is not None:
        lines += _table_lines("temperature", pair.temperature, Temperatures)
    if pair.expansion != Expansions():
        lines += _table_lines("expansion", pair.expansion, Expansions)
    kinds = {kind.file_key: kind for kind in KINDS.values()}
    for title, of_supports in (("errors", False), ("errors.supports", True)):
        stated = {key: value for key, value in pair.errors.items() if kinds[key].of_supports == of_supports}
        if stated:
            lines.append(f"[{title}]")
            lines += [f"{key} = {_error_toml(value, kinds[key].unit)}" for key, value in stated.items()]
    return "\n".join(lines) + "\n"


def parse_pair(text: str, source: str, folder: Path | None = None) -> Pair:
    """Return the pair that a TOML text describes.

    Parameters
    ----------
    text
        The text of a pair file.
    source
        The file's name, for messages.
    folder
        That of the file, to which file names in [bodies] are relative; None for the working folder.

    Raises
    ------
    edge.InputError
        If it is not a valid pair; one sentence for each problem, with field, value and file.
    """
    return pair_of_tables(edge.toml_table(text, FORMAT, source), source, folder)


def pair_of_tables(tables: Mapping[str, Any], source: str, folder: Path | None = None) -> Pair:
    """Return the pair that a file's tables describe; raise an `edge.InputError` that names invalid entries.

    File names in [bodies] are relative to `folder`, that of the file, or to the working folder.
    """
    tables = dict(tables)
    stated = tables.pop("errors", {})
    if not isinstance(stated, Mapping):
        raise edge.InputError(f"{source}: errors = {edge.shown(stated)}: it must be a table, [errors].")
    file, errors = edge.validated(_File, tables, source), Errors(stated, source)
    values: dict[str, Any] = {name: getattr(file.pair, name) for name in _Geometry.model_fields}
    values |= {name: getattr(file, name) for name in PairTables.model_fields}
    if file.bodies is not None and folder is not None:
        values["bodies"] = file.bodies.in_folder(folder)
    try:
        return Pair(**values, errors=errors)
    except ContradictionError as problem:
        raise edge.InputError(f"{source}: [{problem.table}] {problem}") from None


def read_pair(path: str | os.PathLike[str]) -> Pair:
    """Return the pair of a pair file; raise an `edge.InputError` that names invalid entries."""
    return parse_pair(edge.read_text(path, FORMAT), str(path), Path(path).parent)


def write_pair(pair: Pair, path: str | os.PathLike[str]) -> None:
    """Write a pair file that `read_pair` reads as an equal pair; never a partial file.

    Names of files of elastic bodies are written as seen from its folder.
    """
    if pair.bodies is not None:
        pair = pair.replace(bodies=pair.bodies.seen_from(Path(path).parent))
    with edge.written_whole(path) as temporary:
        temporary.write_text(pair.text, encoding="utf-8")
