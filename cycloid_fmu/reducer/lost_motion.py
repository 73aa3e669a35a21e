"""The RV reducer around the cycloid stage: involute first stage, crank bearings, and the budget of its lost motion.

Source: Liu et al., "Analysis of the coaxiality-geometric hysteresis model of a rotate vector reducer" (2022), in short
the RV paper; docs/theory/reducer.md says which of its equations hold. Plays are two-sided, in radians at the output,
> 0 is clearance. The file `cycloid-reducer/1` is read here; everything leaves this module in SI units.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact, edge
from cycloid_fmu.contact.transmission import mesh_of
from cycloid_fmu.edge import ARCMIN, Angle, Config
from cycloid_fmu.errors.kinds import LARGEST_DEVIATION
from cycloid_fmu.geometry import sizes
from cycloid_fmu.geometry.pair import Pair, pair_of_tables
from cycloid_fmu.geometry.supports import Bearing
from cycloid_fmu.reducer.first_stage import FirstStage, sun_locked_share
from cycloid_fmu.supports.transmission import solve
from cycloid_fmu.surfaces.sampling import Distribution
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
Variant = Literal["standard", "as_printed", "geometric", "geometric_sun_locked"]
VARIANTS: tuple[Variant, ...] = ("standard", "as_printed", "geometric", "geometric_sun_locked")
FORMAT = "cycloid-reducer/1"
STAGES = ("involute", "cycloid", "bearings")
# Of the closed form a term is called contradicted where the contact model differs by more than this share of it.
_AGREES = 0.05
_STIFF = 1e9  # N/m: of a turning arm that no one states; a play does not depend on it
_STAGE_OF = {"base_tangent_length": "involute", "crank_bearing_clearance": "bearings"}
TERMS = {
    "base_tangent_length": "thinner sun teeth: common normal shorter than without play",
    "isometric_modification": "isometric modification",
    "offset_modification": "offset modification",
    "pin_circle_radius": "larger pin circle",
    "pin_radius": "thicker pins",
    "pin_hole_clearance": "diametral clearance of the pins in their holes",
    "gear_runout": "radial runout of the cycloid gear's ring",
    "pin_tangential": "circumferential position of the pins",
    "tooth_cumulative_pitch": "cumulative pitch of the cycloid gear",
    "isometric": "isometric modification made beyond the nominal",
    "offset": "offset modification made beyond the nominal",
    "eccentricity": "longer crank",
    "crank_bearing_clearance": "diametral clearance of the crank bearings",
}


class Deviation(Config):
    """A deviation that lies within `value` ± `tolerance`, m.

    In a file a length alone has no tolerance; `{ value, tolerance }` and `{ lower, upper }` may name a `distribution`,
    "normal" (three standard deviations at the tolerance, cut off there) or "uniform".
    """

    value: edge.Length = 0.0
    tolerance: edge.Length = 0.0
    distribution: Distribution = "normal"


def _deviation(given: Any) -> Any:
    """Read a deviation in any of its three ways; values stay text, so that they are read once."""
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
        raise ValueError("deviations must lie between -1 mm and 1 mm")
    return table


OfDeviation = Annotated[Deviation, pydantic.BeforeValidator(_deviation)]


class Deviations(Config):
    """What was really made: the RV paper's table 9, its δ and E.

    Attributes
    ----------
    base_tangent_length
        Deviation of the sun's common normal (base tangent length), E_w < 0 thinner teeth; the paper's E_ws and E_wi are
        its upper and lower limit.
    pin_circle_radius, pin_radius, eccentricity, isometric, offset
        δr_p, δr_rp, δe, δΔr_rp, δΔr_p with the signs of the pair file's `[errors]`.
    pin_hole_clearance
        δJ, diametral clearance of a pin in its hole.
    gear_runout
        ΔF_r, radial runout of the cycloid gear's ring: twice its eccentricity.
    pin_tangential
        δt, circumferential position of the pins; the contact model takes it with alternating sign.
    tooth_cumulative_pitch
        ΔF_p, largest less smallest tooth position; the contact model takes it as one wave round the gear.
    crank_bearing_clearance
        Δu, diametral clearance.
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
        raise ValueError("it must lie between 0 and 45 deg")
    return value


class Involute(Config):
    """The first stage: a sun in mesh with the planets on the crank shafts.

    Attributes
    ----------
    centre_distance
        Sun to planet, which is the radius of the crank shafts' circle, m; from module and teeth where not stated.
    shaft_tilt
        The RV paper's β, tilt of the input shaft, rad (`shaft_tilt`).
    shaft_displacement
        The RV paper's a_1, radial displacement of the sun in mesh, m.
    """

    sun_teeth: int = pydantic.Field(ge=6, le=200, strict=True)
    planet_teeth: int = pydantic.Field(ge=6, le=200, strict=True)
    module: sizes.Module
    pressure_angle: Annotated[Angle, pydantic.AfterValidator(_below_right_angle)] = math.radians(20.0)
    centre_distance: sizes.CircleRadius | None = None
    shaft_tilt: Annotated[Angle, pydantic.AfterValidator(_below_right_angle)] = 0.0
    shaft_displacement: edge.Length = 0.0

    @property
    def crank_circle_radius(self) -> float:
        """a_0, m."""
        return self.centre_distance or 0.5 * self.module * (self.sun_teeth + self.planet_teeth)

    @property
    def sun_base_radius(self) -> float:
        """Radius of the sun's base circle, m z_1 cos α/2, m."""
        return 0.5 * self.module * self.sun_teeth * math.cos(self.pressure_angle)


class Stated(Config):
    """What a drawing or paper states although it follows from the rest; the closed forms then use it as stated.

    Attributes
    ----------
    shortening
        K_1; else eccentricity x pins/pin circle radius.
    sun_pitch_radius
        r_1, m; else module x sun teeth/2.
    """

    shortening: float | None = pydantic.Field(default=None, gt=0.0, lt=1.0)
    sun_pitch_radius: sizes.CircleRadius | None = None


class Reducer(Config):
    """An RV reducer, SI units, validated: pin ring fixed, sun in, carrier out.

    Attributes
    ----------
    stage
        The cycloid stage; its errors are those of `deviations`.
    involute, stated, deviations
        The first stage, what is stated although it follows from the rest, and the deviations of both stages.

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

    @property
    def ratio(self) -> float:
        """Total ratio 1 + z_2 z_p/(z_1 (z_p - z_c)) (RV paper, equation 4); > 0, the output turns as the sun does."""
        g = self.stage
        return 1.0 + self.involute.planet_teeth * g.pins / (self.involute.sun_teeth * (g.pins - g.gear_teeth))

    @property
    def sun_locked(self) -> float:
        """Share of a play with the crank locked that is left with the sun locked (`first_stage.sun_locked_share`)."""
        return sun_locked_share(self.crank_share, self.stage.gear_teeth)

    @property
    def crank_share(self) -> float:
        """Crank turn for each turn of the output with the sun locked, 1 + z_1/z_2."""
        return 1.0 + self.involute.sun_teeth / self.involute.planet_teeth


def parse_reducer(text: str, source: str) -> Reducer:
    """Return the reducer that a TOML text describes.

    Raises
    ------
    edge.InputError
        If it is not a valid reducer; one sentence a problem, naming field, value and `source`.
    """
    table = edge.toml_table(text, FORMAT, source)
    stage: dict[str, Any] = {k: table.pop(k) for k in ("pair", "modification", "material", "supports") if k in table}
    if "stage" in table:
        raise edge.InputError(f"{source}: stage is not a key known here; check its spelling or remove it.")
    pair = pair_of_tables(stage, source)
    if pair.output != "gear":
        raise edge.InputError(f'{source}: [pair] output = "ring": an RV reducer\'s pin ring is fixed; write "gear".')
    reducer = edge.validated(Reducer, {**table, "stage": pair}, source)
    dimensions(pair, surface_of_reducer(reducer), f"{source}: deviations")
    return reducer


def read_reducer(path: str | os.PathLike[str]) -> Reducer:
    """Return the reducer of a file; an `edge.InputError` names what is wrong in it.

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
    return parse_reducer(edge.read_text(path), str(path))


def contradictions(reducer: Reducer, source: str) -> list[str]:
    """Return one sentence for each stated number that another contradicts; it names both and says which is used."""
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
            "the closed forms use the stated radius, geometry the module."
        )
    unshifted = 0.5 * involute.module * (involute.sun_teeth + involute.planet_teeth)
    if involute.centre_distance is not None and abs(involute.centre_distance - unshifted) > involute.module:
        found.append(
            f'{source}: [involute] centre_distance = "{involute.centre_distance * 1e3:.6g} mm", but module = '
            f'"{involute.module * 1e3:.6g} mm" with {involute.sun_teeth} and {involute.planet_teeth} teeth means '
            f'"{unshifted * 1e3:.6g} mm": the cranks stand on the stated centre distance; the play of the first stage '
            "takes no centre distance."
        )
    if g.supports is not None and abs(g.supports.circle_radius / involute.crank_circle_radius - 1.0) > 1e-3:
        found.append(
            f'{source}: [supports] circle_radius = "{g.supports.circle_radius * 1e3:.6g} mm", but [involute] puts the '
            f'cranks at "{involute.crank_circle_radius * 1e3:.6g} mm": the closed forms use the latter, the model the '
            "former."
        )
    stated_clearance = 0.0 if g.supports is None else g.supports.turning_arm.clearance
    if stated_clearance not in (0.0, made := reducer.deviations.crank_bearing_clearance.value):
        found.append(
            f'{source}: [supports.turning_arm] clearance = "{stated_clearance * 1e6:.6g} um", but [deviations] '
            f'crank_bearing_clearance = "{made * 1e6:.6g} um": the budget uses the latter.'
        )
    return found


def shaft_tilt(displacement: ArrayLike, length: float) -> Array:
    """Return the tilt of a shaft, rad, whose end is displaced radially: β = arcsin(Y/L) (RV paper, equation 1).

    Parameters
    ----------
    displacement
        Y, any shape, m.
    length
        L of the shaft, m.
    """
    return np.asarray(np.arcsin(np.asarray(displacement, dtype=float) / length))


def values_of(reducer: Reducer) -> dict[str, float]:
    """Return the amount behind each of `TERMS`, m: the nominal modifications and the deviations' values."""
    m = reducer.stage.modification
    stated = {name: getattr(reducer.deviations, name).value for name in Deviations.model_fields}
    return {"isometric_modification": m.isometric, "offset_modification": m.offset, **stated}


def _shortening(reducer: Reducer) -> float:
    g = reducer.stage
    return reducer.stated.shortening or g.eccentricity * g.pins / g.pin_circle_radius


def outer_stages(reducer: Reducer, values: Mapping[str, ArrayLike], sun_radius: float) -> dict[str, Array]:
    """Play of the first stage for a common normal off by E_w, and of the crank bearings (RV paper, 5 and 20)."""
    involute = reducer.involute
    lever = involute.crank_circle_radius + involute.shaft_displacement
    return {
        "base_tangent_length": -np.asarray(values["base_tangent_length"]) / (sun_radius * reducer.ratio),
        "crank_bearing_clearance": np.asarray(values["crank_bearing_clearance"])
        * math.cos(involute.shaft_tilt)
        / lever,
    }


def _stated_base_radius(reducer: Reducer) -> float:
    involute = reducer.involute
    pitch = reducer.stated.sun_pitch_radius or 0.5 * involute.module * involute.sun_teeth
    return pitch * math.cos(involute.pressure_angle)


def standard(reducer: Reducer, values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the play that each amount makes by the RV paper's closed forms, typesetting corrected, rad.

    With d = e z_c and s = sqrt(1 - K²) the cycloid stage is [2 ΔR_rp - 2 ΔR_p s + 2 δr_p s - 2 δr_rp + δJ + ΔF_r/2 +
    2 K δt - K ΔF_p + 2 δΔR_rp - 2 δΔR_p s]/d - 2 K_n δe with K_n = ΔR_rp/(e² z_c) - [z_p²/(z_c R_p² s) +
    s/(e² z_c)] ΔR_p (RV paper, equations 5, 16, 17 and 20; the printed K_n has wrong dimensions: docs/theory).

    Parameters
    ----------
    reducer
        The nominal reducer; stated numbers are used as stated.
    values
        Amount behind each of `TERMS`, m, scalars or arrays of one shape.

    Returns
    -------
    terms
        {name: rad}, of the values' shape.
    """
    g, k = reducer.stage, _shortening(reducer)
    s, d = math.sqrt(1.0 - k * k), g.eccentricity * g.gear_teeth
    v = {name: np.asarray(value, dtype=float) for name, value in values.items()}
    moving = v["isometric_modification"] / (g.eccentricity * d)
    moving = (
        moving
        - (g.pins**2 / (g.gear_teeth * g.pin_circle_radius**2 * s) + s / (g.eccentricity * d))
        * (v["offset_modification"])
    )
    return {
        **outer_stages(reducer, values, _stated_base_radius(reducer)),
        **{name: factor * v[name] / d for name, factor in _factors(k, s).items()},
        "eccentricity": -2.0 * moving * v["eccentricity"],
    }


def _factors(k: float, s: float) -> dict[str, float]:
    return {
        "isometric_modification": 2.0,
        "offset_modification": -2.0 * s,
        "pin_circle_radius": 2.0 * s,
        "pin_radius": -2.0,
        "pin_hole_clearance": 1.0,
        "gear_runout": 0.5,
        "pin_tangential": 2.0 * k,
        "tooth_cumulative_pitch": -k,
        "isometric": 2.0,
        "offset": -2.0 * s,
    }


def as_printed(reducer: Reducer, values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the RV paper's equation 21 exactly as typeset, in millimetres, read as arcminutes; rad.

    The factor 10800/π and the root stand on the two modification terms alone, every other term of the cycloid stage is
    bare radians added to arcminutes, and K_n is the printed one. The pressure angle is the nominal one, because the
    forces that the paper takes it from are not published, and the bearings' term, printed twice, counts once.
    """
    g, k = reducer.stage, _shortening(reducer)
    s = math.sqrt(1.0 - k * k)
    mm = {name: 1e3 * np.asarray(value, dtype=float) for name, value in values.items()}
    e, circle = 1e3 * g.eccentricity, 1e3 * g.pin_circle_radius
    d = e * g.gear_teeth
    rooted = {"isometric_modification": 2.0 * s / d * ARCMIN, "offset_modification": -2.0 * s / d * ARCMIN}
    bare = {name: factor / d for name, factor in _factors(k, s).items() if name not in rooted}
    moving = mm["isometric_modification"] / (e * d)
    moving = moving - (g.gear_teeth / (e * circle**2 * s) + s / d) * mm["offset_modification"]
    return {
        **outer_stages(reducer, values, _stated_base_radius(reducer)),
        **{name: factor * mm[name] / ARCMIN for name, factor in {**rooted, **bare}.items()},
        "eccentricity": -2.0 * moving * mm["eccentricity"] / ARCMIN,
    }


def surface_of_reducer(reducer: Reducer, values: Mapping[str, float] | None = None) -> ErrorSurface:
    """Return the error surface of the cycloid stage that the deviations describe.

    The runout is an offset of the gear that stands still while the gear turns, so that over an output turn it meets the
    pitch error in every direction; a pin in its hole gives way by half the clearance, so it is as much thinner.

    Parameters
    ----------
    values
        Amount behind each of `TERMS`, m; the reducer's own where not given.
    """
    v = values_of(reducer) if values is None else values
    g, m = reducer.stage, reducer.stage.modification
    pin, tooth = np.arange(g.pins), np.arange(g.gear_teeth)
    wave = 0.5 * v["tooth_cumulative_pitch"] * np.cos(2.0 * np.pi * tooth / g.gear_teeth)
    return ErrorSurface(
        reducer.stage,
        pin_circle_radius=v["pin_circle_radius"],
        pin_radius=v["pin_radius"] - 0.5 * v["pin_hole_clearance"],
        eccentricity=v["eccentricity"],
        isometric=v["isometric_modification"] - m.isometric + v["isometric"],
        offset=v["offset_modification"] - m.offset + v["offset"],
        centre_distance_x=0.5 * v["gear_runout"],
        pin_tangential=v["pin_tangential"] * np.where(pin % 2 == 0, 1.0, -1.0),
        tooth_cumulative_pitch=np.tile(wave, (g.discs, 1)),
    )


@dataclasses.dataclass(frozen=True)
class Play:
    """The cycloid stage's play with the crank locked, over crank angles of one output turn; arrays (angles,).

    Attributes
    ----------
    backlash, interference
        rad, 0 where there is no free position; m, 0 where there is one.
    transmission_error
        Middle of the play, rad; NaN without a free position.
    """

    backlash: Array
    interference: Array
    transmission_error: Array


def contact_play(reducer: Reducer, surface: ErrorSurface, angles: int) -> Play:
    """Return the play of the contact model at so many crank angles, spread evenly over one output turn.

    It is the mesh's between rigid bodies, whatever holds them. Angles that share no factor with the teeth meet every
    tooth in another phase of the mesh.
    """
    teeth = reducer.stage.gear_teeth
    low, high, gap = np.empty(angles), np.empty(angles), np.empty(angles)
    crank = 2.0 * np.pi * teeth * np.arange(angles) / angles
    contact.sweep_play(mesh_of(reducer.stage, surface), crank, 0, angles, low, high, gap)
    free = np.where(np.isnan(high), 0.0, high - low)
    return Play(free, gap, 0.5 * (low + high))


def geometric(reducer: Reducer) -> dict[str, float]:
    """Return what the contact model says of the play with the crank locked, and what each amount changes in it.

    A term is the mean play less the mean play without that amount. Where there is interference there is no play to
    compare, so pins are thinned for the terms, not for the play, until all is free; what the terms' sum lacks of the
    play is `interaction`. With the crank locked the first stage takes no part. The bearings' term is that of the model
    with the stage's supports (`bearing_share`), without them the closed form.

    Returns
    -------
    budget
        {term: rad, "interaction", "involute", "cycloid", "bearings", "total": rad; "cycloid_smallest",
        "cycloid_largest": over the crank, rad; "transmission_error": peak to peak of the middle of the play, rad;
        "interference": m, the largest; "interfering": share of crank angles}.
    """
    values = values_of(reducer)
    angles = 10 * reducer.stage.gear_teeth + 1
    whole = contact_play(reducer, surface_of_reducer(reducer, values), angles)
    names = [n for n in TERMS if n not in _STAGE_OF]
    without = {n: surface_of_reducer(reducer, {**values, n: 0.0}) for n in names if values[n] != 0.0}
    surfaces = [surface_of_reducer(reducer, values), *without.values()]
    thinner = 0.0
    while True:
        thinned = [s.replace(pin_radius=s.pin_radius - thinner) for s in surfaces]
        plays = [contact_play(reducer, s, angles) for s in thinned]
        if all(p.interference.max() == 0.0 for p in plays):
            break
        thinner = max(2.0 * thinner, 5e-6)
    mean = [float(p.backlash.mean()) for p in plays]
    terms = dict.fromkeys(names, 0.0) | {n: mean[0] - m for n, m in zip(without, mean[1:], strict=True)}
    cycloid = float(whole.backlash.mean())
    bearings = float(outer_stages(reducer, values, reducer.involute.sun_base_radius)["crank_bearing_clearance"])
    bearings *= bearing_share(reducer, thinned[0]) if bearings != 0.0 else 1.0
    middle = whole.transmission_error[~np.isnan(whole.transmission_error)]
    return {
        "base_tangent_length": 0.0,
        **terms,
        "crank_bearing_clearance": bearings,
        "interaction": cycloid - sum(terms.values()),
        "involute": 0.0,
        "cycloid": cycloid,
        "bearings": bearings,
        "total": cycloid + bearings,
        "cycloid_smallest": float(whole.backlash.min()),
        "cycloid_largest": float(whole.backlash.max()),
        "transmission_error": float(np.ptp(middle)) if middle.size else math.nan,
        "interference": float(whole.interference.max()),
        "interfering": float(np.mean(whole.interference > 0.0)),
    }


def bearing_share(reducer: Reducer, surface: ErrorSurface) -> float:
    """Return how much more play the crank bearings' clearance makes on the stage's supports than by the closed form.

    Of the model it is the mean play with this clearance in the turning arms less that with none, crank locked, whatever
    else the supports state as it is; turning arms that are stated rigid are springs here. 1 without supports.

    Raises
    ------
    edge.InputError
        If there are supports and no rated torque.
    """
    pair, supports, values = reducer.stage, reducer.stage.supports, values_of(reducer)
    if supports is None:
        return 1.0
    if values["crank_bearing_clearance"] <= 0.0:
        values["crank_bearing_clearance"] = 1e-6  # play grows with the clearance
    arm = Bearing(stiffness=_STIFF) if supports.turning_arm.is_rigid else supports.turning_arm
    angles = 2 * pair.gear_teeth + 1
    crank = 2.0 * np.pi * pair.gear_teeth * np.arange(angles) / angles
    plays = []
    for clearance in (values["crank_bearing_clearance"], 0.0):
        held = pair.replace(supports=supports.replace(turning_arm=arm.replace(clearance=clearance)))
        plays.append(float(solve(held, surface.replace(pair=held), [], crank).backlash.mean()))
    closed = outer_stages(reducer, values, reducer.involute.sun_base_radius)["crank_bearing_clearance"]
    return (plays[0] - plays[1]) / float(closed)


def with_sun_locked(reducer: Reducer, crank_locked: Mapping[str, float]) -> dict[str, float]:
    """Return the budget of `geometric` as the bench measures it, the sun locked instead of the crank.

    The cranks turn with the output then, which leaves `Reducer.sun_locked` of every play behind them, and the first
    stage's play joins: the common normal is tangent to the sun's base circle.
    """
    kept = ("transmission_error", "interference", "interfering")
    found = {n: v if n in kept else reducer.sun_locked * v for n, v in crank_locked.items()}
    play = float(outer_stages(reducer, values_of(reducer), reducer.involute.sun_base_radius)["base_tangent_length"])
    found.update(base_tangent_length=play, involute=play, total=found["total"] + play)
    return found


def first_stage_of(reducer: Reducer) -> FirstStage:
    """Return what the FMU puts around the cycloid stage: the teeth, and the plays that the deviations make."""
    outer = outer_stages(reducer, values_of(reducer), reducer.involute.sun_base_radius)
    return FirstStage(
        sun_teeth=reducer.involute.sun_teeth,
        planet_teeth=reducer.involute.planet_teeth,
        sun_play=max(0.0, float(outer["base_tangent_length"]) * reducer.ratio),
        bearing_play=max(0.0, float(outer["crank_bearing_clearance"])),
    )


def summed(terms: Mapping[str, Array]) -> dict[str, Array]:
    """Return the plays of the three stages and their total from the terms, rad."""
    stages = {stage: np.asarray(sum(v for n, v in terms.items() if _STAGE_OF.get(n, "cycloid") == stage))
              for stage in STAGES}  # fmt: skip
    return {**stages, "total": np.asarray(sum(stages.values()))}


def budget(reducer: Reducer) -> dict[str, dict[str, float]]:
    """Return the lost motion budget in all `VARIANTS`: {variant: {term: rad, "involute", …, "total"}}.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> stage = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="52 mm", pin_radius="2 mm", eccentricity="0.9 mm", face_width="14 mm"
    ... )
    >>> reducer = cy.Reducer(
    ...     stage=stage, involute={"sun_teeth": 12, "planet_teeth": 42, "module": "1.5 mm"},
    ...     deviations={"pin_radius": "-4 um"},
    ... )
    >>> round(cy.budget(reducer)["standard"]["total"] * cy.ARCMIN, 3)
    0.784
    """
    values = values_of(reducer)
    found = {}
    for variant, closed in (("standard", standard), ("as_printed", as_printed)):
        terms = closed(reducer, values)
        found[variant] = {n: float(terms[n]) for n in TERMS} | {n: float(v) for n, v in summed(terms).items()}
    found["geometric"] = geometric(reducer)
    found["geometric_sun_locked"] = with_sun_locked(reducer, found["geometric"])
    return found


def remarks(reducer: Reducer, found: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Return a sentence for each term of the closed form that the contact model contradicts, {term: sentence}."""
    closed, exact = found["standard"], found["geometric"]
    values = values_of(reducer)
    unstated = standard(reducer.replace(stated=Stated()), values)
    said = {}
    modelled = {"crank_bearing_clearance"} if reducer.stage.supports is not None else set[str]()
    for name in (n for n in TERMS if n not in _STAGE_OF or n in modelled):
        a, b = closed[name], exact[name]
        if abs(a - b) <= _AGREES * abs(a) + 1e-9:
            continue
        text = f"geometry gives {b * ARCMIN:+.4f}′"
        if name in modelled:
            text += " on the stage's bearings: their clearance lets the discs shift as well as turn"
        elif name == "gear_runout":
            swing = runout_error(reducer, values[name]) * ARCMIN
            text += f": as an eccentricity it is a transmission error, {swing:.3f}′ peak to peak, not play"
        elif name == "tooth_cumulative_pitch":
            text += ": the closed form is only a bound"
        elif name == "eccentricity":
            text += ": second order, less play whatever its sign"
        elif a * b < 0.0:
            text += ": the other sign"
        else:
            alone = play_alone(reducer, name, values[name])
            text += f", and {alone * ARCMIN:+.4f}′ with nothing else off"
            if abs(a - unstated[name]) > 0.5 * abs(a - alone):
                text += f" (closed form with the shortening of the pin circle radius: {unstated[name] * ARCMIN:+.4f}′)"
        said[name] = text
    return said


def play_alone(reducer: Reducer, name: str, amount: float) -> float:
    """Return how one amount (m) of `TERMS` changes the mean play of an otherwise nominal, unmodified stage, rad.

    Pins 20 µm thinner, or thinner by twice the amount, make room for it.
    """
    room = max(20e-6, 2.0 * abs(amount))
    angles = 10 * reducer.stage.gear_teeth + 1
    plays = []
    for value in (amount, 0.0):
        amounts = dict.fromkeys(TERMS, 0.0) | {name: value}
        surface = surface_of_reducer(reducer, amounts)
        surface = surface.replace(pin_radius=surface.pin_radius - room)
        plays.append(float(contact_play(reducer, surface, angles).backlash.mean()))
    return plays[0] - plays[1]


def runout_error(reducer: Reducer, runout: float) -> float:
    """Return the transmission error, peak to peak (rad), of one disc that is eccentric by half the runout (m).

    Nothing else is off; the pins are 20 µm thinner, so that the gear runs free.
    """
    one = reducer.stage.replace(discs=1)
    alone = reducer.replace(stage=one)
    amounts = dict.fromkeys(TERMS, 0.0) | {"gear_runout": runout, "pin_radius": -20e-6}
    play = contact_play(alone, surface_of_reducer(alone, amounts), 10 * one.gear_teeth + 1)
    return float(np.ptp(play.transmission_error))
