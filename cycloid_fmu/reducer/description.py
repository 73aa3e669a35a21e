"""An RV reducer: its cycloid stage, its first stage and its deviations, as in a reducer file.

The file `cycloid-reducer/1` is read here; all values in this module are SI. Source of the deviations: Liu et al.,
"Analysis of the coaxiality-geometric hysteresis model of a rotate vector reducer" (2022), called the RV paper below.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.edge import Angle, Config
from cycloid_fmu.errors.kinds import LARGEST_DEVIATION
from cycloid_fmu.geometry import sizes
from cycloid_fmu.geometry.first_stage import sun_locked_share
from cycloid_fmu.geometry.pair import Pair, pair_of_tables
from cycloid_fmu.geometry.supports import Stiffness
from cycloid_fmu.surfaces.sampling import Distribution
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_of_pair

Array = NDArray[np.float64]
FORMAT = "cycloid-reducer/1"
MESH_STIFFNESS = 20e9
"""Mesh stiffness c_γ of steel gears per face width, N/m per m: ISO 6336-1, method C (20 N/(mm·µm))."""


class Deviation(Config):
    """A deviation within `value` ± `tolerance`, m; in a file also a bare length, or `{ lower, upper }`.

    Attributes
    ----------
    value
        Middle of the deviation, m.
    tolerance
        Half of its range, m; a bare length has none.
    distribution
        "normal", truncated at the tolerance, which is three standard deviations, or "uniform".
    """

    value: edge.Length = 0.0
    tolerance: edge.Length = 0.0
    distribution: Distribution = "normal"


def _deviation(given: Any) -> Any:
    """Normalize the three forms of a deviation; values remain text, so that they are parsed only once."""
    if isinstance(given, Deviation):
        return given
    if not isinstance(given, dict):
        given = {"value": given}
    table = dict(given)
    if {"lower", "upper"} <= table.keys() and not {"value", "tolerance"} & table.keys():
        lower, upper = (edge.parse_quantity(table.pop(k), "m") for k in ("lower", "upper"))
        if lower >= upper:
            raise ValueError("lower must be below upper: a distribution needs a width")
        table.update(value=f"{0.5 * (lower + upper):.17g} m", tolerance=f"{0.5 * (upper - lower):.17g} m")
    elif "value" not in table:
        raise ValueError(
            'write "10 um", { value = "10 um", tolerance = "2 um" } or { lower = "8 um", upper = "12 um" }'
        )
    value, tolerance = (edge.parse_quantity(table.get(k, "0 m"), "m") for k in ("value", "tolerance"))
    if "tolerance" in table and tolerance <= 0.0:
        raise ValueError("a distribution needs a width: write a tolerance above zero, or the value alone")
    if abs(value) + tolerance > LARGEST_DEVIATION:
        raise ValueError("deviations must be between -1 mm and 1 mm")
    return table


OfDeviation = Annotated[Deviation, pydantic.BeforeValidator(_deviation)]


class Deviations(Config):
    """The deviations δ and E of the RV paper's table 9, m.

    Attributes
    ----------
    base_tangent_length
        E_w, deviation of the sun's base tangent length, < 0 thinner teeth; the paper's E_ws and E_wi are its upper and
        lower limits.
    pin_circle_radius, pin_radius, eccentricity, isometric, offset
        δr_p, δr_rp, δe, δΔr_rp, δΔr_p, with the signs of the pair file's `[errors]`.
    pin_hole_clearance
        δJ, diametral clearance of a pin in its hole.
    gear_runout
        ΔF_r, radial runout of the cycloid gear's teeth: twice the eccentricity of the toothing.
    pin_tangential
        δt, circumferential position error of the pins; in the contact model its sign alternates from pin to pin.
    tooth_cumulative_pitch
        ΔF_p, largest minus smallest tooth position; in the contact model it is one wave around the gear.
    crank_bearing_clearance
        Δu, diametral clearance of the crank bearings.
    """

    base_tangent_length: OfDeviation = Deviation()
    pin_circle_radius: OfDeviation = Deviation()
    pin_radius: OfDeviation = Deviation()
    pin_hole_clearance: OfDeviation = Deviation()
    gear_runout: OfDeviation = Deviation()
    pin_tangential: OfDeviation = Deviation()
    tooth_cumulative_pitch: OfDeviation = Deviation()
    isometric: OfDeviation = Deviation()
    offset: OfDeviation = Deviation()
    eccentricity: OfDeviation = Deviation()
    crank_bearing_clearance: OfDeviation = Deviation()


def _below_right_angle(value: float) -> float:
    if not 0.0 <= value < 0.25 * math.pi:
        raise ValueError("it must be between 0 and 45 deg")
    return value


class Involute(Config):
    """The first stage: a sun in mesh with the planets on the crank shafts.

    Attributes
    ----------
    sun_teeth, planet_teeth
        Number of teeth.
    module
        Module of both gears, m.
    pressure_angle
        Pressure angle of both gears, rad.
    centre_distance
        Distance from sun to planet axis, m, which is the radius of the crank circle; by default from module and teeth.
    shaft_tilt
        β of the RV paper, tilt of the input shaft, rad.
    shaft_displacement
        a_1 of the RV paper, radial displacement of the sun in mesh, m.
    planets
        Number of planets, one on each crank shaft; default: the cranks of `[supports]`.
    face_width
        Common face width of sun and planets, m, which gives their mesh stiffness by ISO 6336-1, method C.
    mesh_stiffness
        Stiffness of one planet's mesh along the line of action, N/m, instead of `face_width`; without either, the first
        stage is rigid.
    """

    sun_teeth: int = pydantic.Field(ge=6, le=200, strict=True)
    planet_teeth: int = pydantic.Field(ge=6, le=200, strict=True)
    module: sizes.Module
    pressure_angle: Annotated[Angle, pydantic.AfterValidator(_below_right_angle)] = math.radians(20.0)
    centre_distance: sizes.CircleRadius | None = None
    shaft_tilt: Annotated[Angle, pydantic.AfterValidator(_below_right_angle)] = 0.0
    shaft_displacement: edge.Length = 0.0
    planets: int | None = pydantic.Field(default=None, ge=2, le=12, strict=True)
    face_width: sizes.Width | None = None
    mesh_stiffness: Stiffness | None = None

    @pydantic.model_validator(mode="after")
    def _one_stiffness(self) -> Involute:
        if self.face_width is not None and self.mesh_stiffness is not None:
            raise ValueError("it is stated by face_width and mesh_stiffness; state one of them")
        return self

    @property
    def one_mesh(self) -> float:
        """Stiffness of one planet's mesh along the line of action, N/m; infinite if not stated."""
        if self.mesh_stiffness is not None:
            return self.mesh_stiffness
        return math.inf if self.face_width is None else MESH_STIFFNESS * self.face_width

    @property
    def planet_base_radius(self) -> float:
        """Radius of a planet's base circle, m z_2 cos α/2, m."""
        return 0.5 * self.module * self.planet_teeth * math.cos(self.pressure_angle)

    @property
    def crank_circle_radius(self) -> float:
        """a_0, m."""
        return self.centre_distance or 0.5 * self.module * (self.sun_teeth + self.planet_teeth)

    @property
    def sun_base_radius(self) -> float:
        """Radius of the sun's base circle, m z_1 cos α/2, m."""
        return 0.5 * self.module * self.sun_teeth * math.cos(self.pressure_angle)


class Stated(Config):
    """Redundant values of a drawing or paper; the closed forms use them as stated.

    Attributes
    ----------
    shortening
        K_1; default: eccentricity x pins/pin circle radius.
    sun_pitch_radius
        r_1, radius of the sun's pitch circle, m; default: module x sun teeth/2.
    """

    shortening: float | None = pydantic.Field(default=None, gt=0.0, lt=1.0)
    sun_pitch_radius: sizes.CircleRadius | None = None


class Reducer(Config):
    """An RV reducer, SI units, validated: fixed pin ring, sun as input, carrier as output.

    Attributes
    ----------
    stage
        The cycloid stage; its errors are those of `deviations`.
    involute, stated, deviations
        The first stage, redundant values, and the deviations of both stages.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> stage = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="52 mm", pin_radius="2 mm", eccentricity="0.9 mm", face_width="14 mm"
    ... )
    >>> involute = {"sun_teeth": 12, "planet_teeth": 42, "module": "1.5 mm"}
    >>> cy.Reducer(stage=stage, involute=involute).ratio
    141.0
    """

    stage: Pair
    involute: Involute
    stated: Stated = Stated()
    deviations: Deviations = Deviations()

    @pydantic.model_validator(mode="after")
    def _together(self) -> Reducer:
        supports, planets = self.stage.supports, self.involute.planets
        if supports is not None and supports.kind != "cranks":
            raise ValueError(f'[supports] kind = "{supports.kind}": planets need cranks; write kind = "cranks"')
        if supports is not None and planets not in (None, supports.count):
            raise ValueError(
                f"[involute] planets = {planets}, but [supports] count = {supports.count}: each planet needs one crank"
            )
        if math.isfinite(self.involute.one_mesh) and self.planets is None:
            raise ValueError("[involute] planets is missing: the first stage's stiffness depends on their number")
        if supports is not None and self.turning_arm_clearance < 0.0:
            raise ValueError(
                "[deviations] crank_bearing_clearance: the total clearance must not be below zero with [supports]"
            )
        return self

    @property
    def planets(self) -> int | None:
        """Number of planets, one on each crank; None if neither they nor cranks are stated."""
        supports = self.stage.supports
        return self.involute.planets if supports is None else supports.count

    @property
    def turning_arm_clearance(self) -> float:
        """Diametral clearance of the crank bearings, m: from the deviations, otherwise from the supports as drawn."""
        made, supports = self.deviations.crank_bearing_clearance, self.stage.supports
        if supports is None or made.value != 0.0 or made.tolerance != 0.0:
            return made.value
        return supports.turning_arm.clearance

    @property
    def planet_keys(self) -> Array:
        """Angle of each planet on its crank relative to that of the first, rad, shape (planets,).

        All cranks have the same angle, so planet k of n is advanced by k (z_1 + z_2)/n of its tooth pitch; if n divides
        z_1 + z_2, all planets are equal.
        """
        if self.planets is None:
            raise edge.InputError("[involute] planets is missing; the angles of the planets depend on it.")
        teeth = self.involute.planet_teeth
        share = np.arange(self.planets) * (self.involute.sun_teeth + teeth) % self.planets / self.planets
        return np.asarray(2.0 * np.pi / teeth * share)

    @property
    def ratio(self) -> float:
        """Total ratio 1 + z_2 z_p/(z_1 (z_p - z_c)) (RV paper, equation 4), > 0: same direction."""
        g = self.stage
        return 1.0 + self.involute.planet_teeth * g.pins / (self.involute.sun_teeth * (g.pins - g.gear_teeth))

    @property
    def sun_locked(self) -> float:
        """Ratio of a play with the sun locked to that with the crank locked (`first_stage.sun_locked_share`)."""
        return sun_locked_share(self.crank_share, self.stage.gear_teeth)

    @property
    def crank_share(self) -> float:
        """Crank turns per turn of the output with the sun locked, 1 + z_1/z_2."""
        return 1.0 + self.involute.sun_teeth / self.involute.planet_teeth


def values_of(reducer: Reducer) -> dict[str, float]:
    """Return the amount of each of `lost_motion.TERMS`, m: nominal modifications and values of the deviations."""
    m = reducer.stage.modification
    stated = {name: getattr(reducer.deviations, name).value for name in Deviations.model_fields}
    stated["crank_bearing_clearance"] = reducer.turning_arm_clearance
    return {"isometric_modification": m.isometric, "offset_modification": m.offset, **stated}


def surface_of_reducer(reducer: Reducer, values: Mapping[str, float] | None = None) -> ErrorSurface:
    """Return the error surface of the cycloid stage with the deviations.

    The runout is modelled as an offset of the gear fixed in the frame, so over an output turn it meets the pitch error
    in every direction. A pin moves in its hole by half the clearance and is modelled as thinner by this.

    Parameters
    ----------
    values
        Amount of each of `lost_motion.TERMS`, m; default: those of the reducer.
    """
    v = values_of(reducer) if values is None else values
    g, m = reducer.stage, reducer.stage.modification
    pin, tooth = np.arange(g.pins), np.arange(g.gear_teeth)
    wave = 0.5 * v["tooth_cumulative_pitch"] * np.cos(2.0 * np.pi * tooth / g.gear_teeth)
    return surface_of_pair(g).replace(
        pin_circle_radius=v["pin_circle_radius"],
        pin_radius=v["pin_radius"] - 0.5 * v["pin_hole_clearance"],
        eccentricity=v["eccentricity"],
        isometric=v["isometric_modification"] - m.isometric + v["isometric"],
        offset=v["offset_modification"] - m.offset + v["offset"],
        centre_distance_x=0.5 * v["gear_runout"],
        pin_tangential=v["pin_tangential"] * np.where(pin % 2 == 0, 1.0, -1.0),
        tooth_cumulative_pitch=np.tile(wave, (g.discs, 1)),
    )


def parse_reducer(text: str, source: str, folder: Path | None = None) -> Reducer:
    """Return the reducer of a TOML text; file names in [bodies] are relative to `folder`, or to the working folder.

    Raises
    ------
    edge.InputError
        If it is not a valid reducer; one sentence for each problem, with field, value and `source`.
    """
    table = edge.toml_table(text, FORMAT, source)
    of_stage = ("pair", "modification", "material", "supports", "bodies", "losses", "thermal", "expansion")
    stage: dict[str, Any] = {k: table.pop(k) for k in of_stage if k in table}
    if isinstance(stated := table.pop("errors", {}), dict) and set(stated) <= {"supports"}:
        stage["errors"] = stated
    else:
        raise edge.InputError(f"{source}: [errors]: a reducer states its errors in [deviations] and [errors.supports].")
    if "stage" in table:
        raise edge.InputError(f"{source}: stage is not a known key; check its spelling or remove it.")
    pair = pair_of_tables(stage, source, folder)
    if pair.output != "gear":
        raise edge.InputError(
            f'{source}: [pair] output = "ring": the pin ring of an RV reducer is fixed; write "gear".'
        )
    reducer = edge.validated(Reducer, {**table, "stage": pair}, source)
    dimensions(pair, surface_of_reducer(reducer), f"{source}: deviations")
    return reducer


def read_reducer(path: str | os.PathLike[str]) -> Reducer:
    """Return the reducer of a file; raise an `edge.InputError` that names invalid entries.

    Examples
    --------
    >>> import cycloid_fmu as cy, pathlib
    >>> lines = ['format = "cycloid-reducer/1"', "[pair]", "gear_teeth = 39", 'pin_circle_radius = "52 mm"',
    ...          'pin_radius = "2 mm"', 'eccentricity = "0.9 mm"', 'face_width = "14 mm"', "[involute]",
    ...          "sun_teeth = 12", "planet_teeth = 42", 'module = "1.5 mm"']
    >>> _ = pathlib.Path("rv.toml").write_text(chr(10).join(lines))
    >>> cy.read_reducer("rv.toml").ratio
    141.0
    """
    return parse_reducer(edge.read_text(path, FORMAT), str(path), Path(path).parent)


def contradictions(reducer: Reducer, source: str) -> list[str]:
    """Return one sentence for each contradiction of stated numbers, with both and the one used."""
    g, involute, stated = reducer.stage, reducer.involute, reducer.stated
    found = []
    follows = g.eccentricity * g.pins / g.pin_circle_radius
    if stated.shortening is not None and abs(stated.shortening / follows - 1.0) > 1e-3:
        circle = g.eccentricity * g.pins / stated.shortening
        found.append(
            f'{source}: [stated] shortening = {stated.shortening:g} means a pin circle radius of "{circle * 1e3:.6g} '
            f'mm", but [pair] pin_circle_radius = "{g.pin_circle_radius * 1e3:.6g} mm" means {follows:.4f}: the closed '
            "forms use the stated shortening, the contact model the radius."
        )
    pitch = 0.5 * involute.module * involute.sun_teeth
    if stated.sun_pitch_radius is not None and abs(stated.sun_pitch_radius / pitch - 1.0) > 1e-3:
        found.append(
            f'{source}: [stated] sun_pitch_radius = "{stated.sun_pitch_radius * 1e3:.6g} mm", but [involute] module = '
            f'"{involute.module * 1e3:.6g} mm" with {involute.sun_teeth} teeth means "{pitch * 1e3:.6g} mm": '
            "the closed forms use the stated radius, the geometry uses the module."
        )
    unshifted = 0.5 * involute.module * (involute.sun_teeth + involute.planet_teeth)
    if involute.centre_distance is not None and abs(involute.centre_distance - unshifted) > involute.module:
        found.append(
            f'{source}: [involute] centre_distance = "{involute.centre_distance * 1e3:.6g} mm", but module = '
            f'"{involute.module * 1e3:.6g} mm" with {involute.sun_teeth} and {involute.planet_teeth} teeth means '
            f'"{unshifted * 1e3:.6g} mm": the cranks use the stated centre distance; the play of the first stage '
            "does not depend on it."
        )
    if g.supports is not None and abs(g.supports.circle_radius / involute.crank_circle_radius - 1.0) > 1e-3:
        found.append(
            f'{source}: [supports] circle_radius = "{g.supports.circle_radius * 1e3:.6g} mm", but [involute] puts the '
            f'cranks at "{involute.crank_circle_radius * 1e3:.6g} mm": the closed forms use the latter, the model the '
            "former."
        )
    drawn = 0.0 if g.supports is None else g.supports.turning_arm.clearance
    if drawn not in (0.0, made := reducer.turning_arm_clearance):
        found.append(
            f'{source}: [supports.turning_arm] clearance = "{drawn * 1e6:.6g} um", but [deviations] '
            f'crank_bearing_clearance = "{made * 1e6:.6g} um": the latter is used.'
        )
    if reducer.planets is not None and reducer.planet_keys.any():
        found.append(
            f"{source}: {involute.sun_teeth} and {involute.planet_teeth} teeth don't allow {reducer.planets} "
            "equal planets: each has a different angle on its crank."
        )
    return found
