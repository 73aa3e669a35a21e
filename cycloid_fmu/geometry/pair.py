"""What a cycloid-pin gear pair is: geometry, profile modification, material and the errors it is given.

The pair file `cycloid-pair/1` is read here; everything leaves this module in SI units.
"""

from __future__ import annotations

import math
import os
import re
from typing import Annotated, Any, Literal

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Angle, Config, Length

FORMAT = "cycloid-pair/1"
LARGEST_DEVIATION = 1e-3
LARGEST_MISALIGNMENT = 0.02
LOST_MOTION_LOAD = 0.03  # of the rated torque (GB/T 40731)
_SHARE = f"{100.0 * LOST_MOTION_LOAD:g} %"
LOST_MOTION = f"output angle at +{_SHARE} of the rated torque less that at -{_SHARE} (GB/T 40731)"


def _positive(value: float) -> float:
    if not value > 0.0:
        raise ValueError("it must be above zero")
    return value


def _deviation(value: float) -> float:
    if abs(value) > LARGEST_DEVIATION:
        raise ValueError("modifications and errors must lie between -1 mm and 1 mm")
    return value


def _small_angle(value: float) -> float:
    if abs(value) > LARGEST_MISALIGNMENT:
        raise ValueError("misalignments must lie between -20 mrad and 20 mrad")
    return value


PositiveLength = Annotated[Length, pydantic.AfterValidator(_positive)]
Deviation = Annotated[Length, pydantic.AfterValidator(_deviation)]
Misalignment = Annotated[Angle, pydantic.AfterValidator(_small_angle)]
PositivePressure = Annotated[edge.Pressure, pydantic.AfterValidator(_positive)]
PositiveTorque = Annotated[edge.Torque, pydantic.AfterValidator(_positive)]


class Material(Config):
    """An elastic material; the default is bearing steel."""

    youngs_modulus: PositivePressure = 206e9
    poissons_ratio: float = pydantic.Field(default=0.3, ge=0.0, lt=0.5)

    @property
    def compliance(self) -> float:
        """V = (1 - ν²)/E of Hertz's line contact, 1/Pa."""
        return (1.0 - self.poissons_ratio**2) / self.youngs_modulus


class Materials(Config):
    """The materials of both flanks."""

    gear: Material = Material()
    pin: Material = Material()


class Modification(Config):
    """Profile modification of the gear with the papers' signs, m.

    Isometric > 0 is a larger generating pin (material removed), offset > 0 a larger generating circle (interference).
    """

    isometric: Deviation = 0.0
    offset: Deviation = 0.0


_ORDER = re.compile(r"order_([1-9]\d*)")
# Values in TOML: {order_1 = ["3 um", "40 deg"]} or one value each; afterwards: {order: (amplitude, phase)} or a tuple.
Orders = dict[int, tuple[float, float]]


def _orders(table: dict[str, Any]) -> Orders:
    found: Orders = {}
    for key, entry in table.items():
        match = _ORDER.fullmatch(key)
        if match is None:
            raise ValueError(f'the key "{key}" is unknown; orders are written order_1 = ["3 um", "40 deg"]')
        if not isinstance(entry, list) or len(entry) != 2:
            raise ValueError(f'{key} needs an amplitude and a phase, such as ["3 um", "40 deg"]')
        try:
            amplitude = _deviation(edge.parse_quantity(entry[0], "m"))
            phase = edge.parse_quantity(entry[1], "rad")
        except ValueError as problem:
            raise ValueError(f"{key}: {problem}") from None
        found[int(match[1])] = (amplitude, phase)
    return found


def _each(values: list[Any]) -> tuple[float, ...]:
    found = []
    for index, value in enumerate(values):
        try:
            found.append(_deviation(edge.parse_quantity(value, "m")))
        except ValueError as problem:
            raise ValueError(f"value {index} ({value!r}): {problem}") from None
    return tuple(found)


def _pattern(value: Any) -> Any:
    if isinstance(value, dict):
        return _orders(value)
    if isinstance(value, list) and not any(isinstance(v, list) for v in value):
        return _each(value)
    raise ValueError('write a list of lengths or orders such as { order_1 = ["3 um", "40 deg"] }')


def _pattern_of_discs(value: Any) -> Any:
    if isinstance(value, list) and value and all(isinstance(v, list) for v in value):
        return tuple(_each(v) for v in value)
    return _pattern(value)


Pattern = Annotated[Any, pydantic.BeforeValidator(_pattern)]
PatternOfDiscs = Annotated[Any, pydantic.BeforeValidator(_pattern_of_discs)]


class Errors(Config):
    """The errors that a pair file states: what really was made and assembled.

    Attributes
    ----------
    centre_distance_x, centre_distance_y
        Offset of the gear, standing still in the frame, m.
    misalignment_xz, misalignment_yz
        Tilt of the gear's axis about mid-width, its +z end towards +x or +y, rad.
    eccentricity, pin_circle_radius, pin_radius
        What was made less what is drawn, m.
    isometric, offset
        Modification that was made less the one drawn, m.
    pin_radial, pin_tangential
        Position of the pins, > 0 outwards and counter-clockwise: a table `order_N = ["2.5 um", "40 deg"]` of amplitudes
        and phases, {order: (m, rad)}, or a list of one length for each pin, m.
    pin_radius_each
        One length for each pin, m.
    tooth_cumulative_pitch
        Position of the teeth, > 0 counter-clockwise, as arc length at the pin circle radius: orders, a list, or a list
        for each disc, m.
    """

    centre_distance_x: Deviation = 0.0
    centre_distance_y: Deviation = 0.0
    misalignment_xz: Misalignment = 0.0
    misalignment_yz: Misalignment = 0.0
    eccentricity: Deviation = 0.0
    pin_circle_radius: Deviation = 0.0
    pin_radius: Deviation = 0.0
    isometric: Deviation = 0.0
    offset: Deviation = 0.0
    pin_radial: Pattern = ()
    pin_tangential: Pattern = ()
    pin_radius_each: Pattern = ()
    tooth_cumulative_pitch: PatternOfDiscs = ()


class Geometry(Config):
    """The gear pair as drawn.

    Attributes
    ----------
    gear_teeth, pins
        z_c; z_p = z_c + 1.
    pin_circle_radius, pin_radius, eccentricity, face_width
        R_p, R_rp, e, b, m.
    discs
        Cycloid gears, evenly spread around the crank.
    output
        What turns: the gear in the fixed ring, or the ring round the gear that only orbits.
    rated_torque
        At the output, for limits and loads that are parts of it, N·m.
    contact_law
        "capped" bounds the flank's curvature radius in Hertz's logarithm by the pin circle radius.
    """

    gear_teeth: int = pydantic.Field(ge=6, le=120, strict=True)
    pins: int = pydantic.Field(strict=True)
    pin_circle_radius: PositiveLength
    pin_radius: PositiveLength
    eccentricity: PositiveLength
    face_width: PositiveLength
    discs: int = pydantic.Field(default=1, ge=1, le=4, strict=True)
    output: Literal["gear", "ring"] = "gear"
    rated_torque: PositiveTorque | None = None
    contact_law: Literal["capped", "as_printed"] = "capped"


class Pair(Config):
    """A cycloid-pin gear pair, SI units, validated: it has one more pin than teeth and can be made and assembled.

    Attributes
    ----------
    text
        The pair file's text, which travels with every result.
    """

    pair: Geometry
    modification: Modification = Modification()
    material: Materials = Materials()
    errors: Errors = Errors()
    text: str = ""

    @pydantic.model_validator(mode="after")
    def _can_be_made(self) -> Pair:
        g = self.pair
        if g.pins != g.gear_teeth + 1:
            raise ValueError(
                f"[pair] pins = {g.pins}: a gear of gear_teeth = {g.gear_teeth} needs one pin more, {g.gear_teeth + 1}"
            )
        k = self.shortening
        if k >= 1.0:
            largest = self.generating_circle_radius / g.pins
            raise ValueError(
                f"[pair] eccentricity = {_mm(g.eccentricity)}: eccentricity x pins / pin circle radius is {k:.4f}; "
                f"it must stay below 1, so the eccentricity below {_mm(largest)}"
            )
        smallest = smallest_convex_radius(self.generating_circle_radius, g.eccentricity, g.pins)
        if self.generating_pin_radius >= smallest:
            raise ValueError(
                f"[pair] pin_radius = {_mm(g.pin_radius)}: the flank is undercut; with its modification the pin radius "
                f"must stay below the smallest curvature radius of its centre's path, {_mm(smallest)}"
            )
        gap = 2.0 * g.pin_circle_radius * math.sin(math.pi / g.pins)
        if 2.0 * g.pin_radius >= gap:
            raise ValueError(
                f"[pair] pin_radius = {_mm(g.pin_radius)}: neighbouring pins overlap; it must stay below {_mm(gap / 2)}"
            )
        for name in ("pin_radial", "pin_tangential", "pin_radius_each"):
            values = getattr(self.errors, name)
            if isinstance(values, tuple) and values and len(values) != g.pins:
                raise ValueError(f"[errors] {name} has {len(values)} values; it needs one a pin, {g.pins}")
        pitch = self.errors.tooth_cumulative_pitch
        if isinstance(pitch, tuple) and pitch:
            if isinstance(pitch[0], tuple) and len(pitch) != g.discs:
                raise ValueError(
                    f"[errors] tooth_cumulative_pitch has {len(pitch)} lists; it needs one a disc, {g.discs}"
                )
            for row in pitch if isinstance(pitch[0], tuple) else (pitch,):
                if len(row) != g.gear_teeth:
                    raise ValueError(
                        f"[errors] tooth_cumulative_pitch has {len(row)} values; it needs one a tooth, {g.gear_teeth}"
                    )
        return self

    def numbers(self) -> dict[str, Any]:
        """Return the nominal pair as plain numbers, SI, for JSON; `Pair.from_numbers` reads them back."""
        return self.model_dump(include={"pair", "modification", "material", "text"})

    @classmethod
    def from_numbers(cls, numbers: dict[str, Any]) -> Pair:
        """Return the pair of `numbers`, which were checked when they were written: no units to parse, no time lost."""
        gear, pin = (Material.model_construct(**numbers["material"][side]) for side in ("gear", "pin"))
        return cls.model_construct(
            pair=Geometry.model_construct(**numbers["pair"]),
            modification=Modification.model_construct(**numbers["modification"]),
            material=Materials.model_construct(gear=gear, pin=pin),
            errors=Errors(),
            text=numbers["text"],
        )

    @property
    def ratio(self) -> float:
        """Signed ratio φ_a/φ_b of the ideal drive: -z_c with the gear as output, +z_p with the ring."""
        return float(-self.pair.gear_teeth if self.pair.output == "gear" else self.pair.pins)

    @property
    def lost_motion_loads(self) -> list[float]:
        """Torques between which the lost motion lies, + and - `LOST_MOTION_LOAD`, N·m; none without a rated torque."""
        rated = self.pair.rated_torque
        return [] if rated is None else [LOST_MOTION_LOAD * rated, -LOST_MOTION_LOAD * rated]

    @property
    def generating_circle_radius(self) -> float:
        """R = R_p + ΔR_p of the nominal flank, m."""
        return self.pair.pin_circle_radius + self.modification.offset

    @property
    def generating_pin_radius(self) -> float:
        """R = R_rp + ΔR_rp of the nominal flank, m."""
        return self.pair.pin_radius + self.modification.isometric

    @property
    def shortening(self) -> float:
        """K = e z_p/R of the nominal flank (the papers' shortening coefficient)."""
        return self.pair.eccentricity * self.pair.pins / self.generating_circle_radius


def _mm(value: float) -> str:
    return f'"{value * 1e3:.6g} mm"'


def smallest_convex_radius(circle_radius: float, eccentricity: float, pins: int) -> float:
    """Smallest convex curvature radius of the path of the pin's centre in the gear, m; infinite where none is convex.

    With K = e z_p/R the radius is R S³/(1 + z_p K² - K (z_p + 1) cos φ). Its minimum is where the derivative vanishes,
    cos φ = (K²(2 z_p - 1) + 2 - z_p)/(K (z_p + 1)), or at the tip (cos φ = -1) where that lies outside.
    """
    k = eccentricity * pins / circle_radius
    stationary = (k * k * (2.0 * pins - 1.0) + 2.0 - pins) / (k * (pins + 1.0))
    radii = []
    for c in (max(-1.0, min(1.0, stationary)), -1.0, 1.0):
        denominator = 1.0 + pins * k * k - k * (pins + 1.0) * c
        if denominator > 0.0:
            radii.append(circle_radius * (1.0 + k * k - 2.0 * k * c) ** 1.5 / denominator)
    return min(radii, default=math.inf)


def parse_pair(text: str, source: str) -> Pair:
    """Return the pair that a TOML text describes.

    Parameters
    ----------
    text
        The text of a pair file.
    source
        The file's name, for messages.

    Raises
    ------
    edge.InputError
        If it is not a valid pair; one sentence a problem, naming field, value and file.
    """
    table = edge.toml_table(text, FORMAT, source)
    if "text" in table:
        raise edge.InputError(f"{source}: text is not a key known here; check its spelling or remove it.")
    return edge.validated(Pair, {**table, "text": text}, source)


def read_pair(path: str | os.PathLike[str]) -> Pair:
    """Return the pair of a pair file; an `edge.InputError` names what is wrong in it."""
    return parse_pair(edge.read_text(path), str(path))
