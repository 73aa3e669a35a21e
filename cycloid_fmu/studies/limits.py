"""Requirements of an application and verdicts on them: each limit met or not, with margin and place.

The requirements are not part of the drive but a separate file, `cycloid-requirements/1`: `[limits]` and the duty under
which they hold. Functions that judge take results as arrays by name (a dataset of `Drive.analyze`, or the same arrays)
and return verdicts.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pydantic
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair, PressureLimit, smallest_convex_radius
from cycloid_fmu.geometry.temperature import BodyTemperature
from cycloid_fmu.losses.heat import Heat
from cycloid_fmu.studies.friction import FrictionFigures
from cycloid_fmu.studies.strength import Stress
from cycloid_fmu.supports.figures import DutyLife
from cycloid_fmu.surfaces import sampling

Array = NDArray[np.float64]
FORMAT = "cycloid-requirements/1"
_SUM = 1e-6  # how far the shares of time may be from 1: decimals such as 0.333333
_ABOVE_ZERO = pydantic.Field(gt=0.0, allow_inf_nan=False)


class Limits(sampling.Limits):
    """Limits of a drive: those of a tolerance file and more; each is one number, an upper or lower limit by its figure.

    Attributes
    ----------
    angular_transmission_error
        Largest allowed; largest minus smallest transmission error over the crank angles, rad; at every load.
    backlash, lost_motion
        Largest allowed over the crank angles, rad.
    interference
        Largest allowed over the crank angles, m.
    max_contact_pressure
        Largest allowed, Pa; at every load.
    torsional_stiffness
        Smallest allowed over the crank angles, N·m/rad; at every load but zero. With the compliance in series up to
        [supports] catalogue_stiffness; without one that of contacts and bearings alone, or of the mesh alone.
    static_safety
        Smallest allowed static safety of the contacts, S_0 = (p_limit/p)²: the load at the pressure limit over the load
        (line contact). The limit is the pair's `largest_pressure`, for bearing steel 4 GPa (ISO 76); at every load.
    smallest_curvature_radius
        Smallest allowed convex curvature radius of the flank as drawn, m.
    bearing_life
        Smallest allowed basic rating life L10h of each bearing over the duty (ISO 281), s.
    sliding_speed
        Largest allowed between flank and pin over the duty, m/s.
    friction_power_density
        Largest allowed friction power per contact area, μ p v with the mean Hertzian pressure, W/m²; by [losses.flank].
    wear_depth
        Largest allowed on flanks and pins, m.
    temperature
        Largest allowed of the oil that runs the duty until nothing gets warmer, K; by [losses] and [thermal].
    pin_safety, output_pin_safety, disc_safety
        Smallest allowed of pins, output pins and discs against yield: permitted over nominal stress in bending, shear,
        pressure on their seats and webs; at every load.
    fatigue_safety
        Smallest allowed of all three against fatigue over a crank turn.
    """

    torsional_stiffness: Annotated[edge.TorsionalStiffness, _ABOVE_ZERO] | None = None
    static_safety: float | None = pydantic.Field(default=None, gt=0.0, allow_inf_nan=False)
    smallest_curvature_radius: Annotated[edge.Length, _ABOVE_ZERO] | None = None
    bearing_life: Annotated[edge.Seconds, _ABOVE_ZERO] | None = None
    sliding_speed: Annotated[edge.Velocity, _ABOVE_ZERO] | None = None
    friction_power_density: Annotated[edge.PowerDensity, _ABOVE_ZERO] | None = None
    wear_depth: Annotated[edge.Length, _ABOVE_ZERO] | None = None
    temperature: BodyTemperature | None = None
    pin_safety: float | None = pydantic.Field(default=None, gt=0.0, allow_inf_nan=False)
    output_pin_safety: float | None = pydantic.Field(default=None, gt=0.0, allow_inf_nan=False)
    disc_safety: float | None = pydantic.Field(default=None, gt=0.0, allow_inf_nan=False)
    fatigue_safety: float | None = pydantic.Field(default=None, gt=0.0, allow_inf_nan=False)

    @property
    def of_study(self) -> sampling.Limits:
        """The limits that a tolerance study judges."""
        return sampling.Limits(**{name: getattr(self, name) for name in sampling.Limits.model_fields})


STRENGTH = ("pin_safety", "output_pin_safety", "disc_safety", "fatigue_safety")
"""Limits on strength."""
LOWER = ("torsional_stiffness", "static_safety", "smallest_curvature_radius", "bearing_life", "efficiency", *STRENGTH)
"""Limits that are the smallest allowed; the others are the largest."""


class Shown(NamedTuple):
    """How reports show a figure: its unit, the factor, and the SI value that is shown as 0."""

    unit: str
    factor: float
    zero: float = 0.0

    def __call__(self, value: float) -> float:
        """Return an SI value in the unit."""
        return (value - self.zero) * self.factor


SHOWN = {
    "angular_transmission_error": Shown("arcsec", edge.ARCSEC),
    "backlash": Shown("arcmin", edge.ARCMIN),
    "lost_motion": Shown("arcmin", edge.ARCMIN),
    "interference": Shown("µm", 1e6),
    "max_contact_pressure": Shown("MPa", 1e-6),
    "torsional_stiffness": Shown("N·m/arcmin", 1.0 / edge.ARCMIN),
    "static_safety": Shown("", 1.0),
    "smallest_curvature_radius": Shown("mm", 1e3),
    "bearing_life": Shown("h", 1.0 / 3600.0),
    "sliding_speed": Shown("m/s", 1.0),
    "friction_power_density": Shown("W/mm²", 1e-6),
    "wear_depth": Shown("µm", 1e6),
    "efficiency": Shown("%", 100.0),
    "starting_torque": Shown("N·m", 1.0),
    "back_driving_torque": Shown("N·m", 1.0),
    "self_locking": Shown("", 1.0),
    "temperature": Shown("°C", 1.0, 273.15),
    **dict.fromkeys(STRENGTH, Shown("", 1.0)),
}
"""How reports show each figure."""


class DutyLoad(edge.Config):
    """One row of the duty: a load, a speed, and its share of the time.

    Attributes
    ----------
    torque
        Of the environment on the output, N·m.
    output_speed
        Of the output, in either direction, rad/s; 0 is a standstill under load.
    share
        Of the time, above 0 and at most 1; those of a duty add up to 1.
    """

    torque: edge.Torque
    output_speed: Annotated[edge.Speed, pydantic.Field(ge=0.0, allow_inf_nan=False)]
    share: float = pydantic.Field(gt=0.0, le=1.0)


class Requirements(edge.Config):
    """Requirements of an application.

    Attributes
    ----------
    limits
        The limits.
    duty
        Loads, speeds and shares of time: bearing lives and sliding are computed over it, everything else at each
        torque.

    Examples
    --------
    >>> from cycloid_fmu.studies.limits import Requirements
    >>> asked = Requirements(
    ...     limits={"backlash": "1 arcmin", "bearing_life": "6000 h"},
    ...     duty=[{"torque": "181 N*m", "output_speed": "15 rpm", "share": 1.0}],
    ... )
    >>> list(asked.limits.stated())
    ['backlash', 'bearing_life']
    """

    limits: Limits = Limits()
    duty: tuple[DutyLoad, ...] = ()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _friction_is_the_drive_s(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and "friction_coefficient" in given:
            raise ValueError(
                "friction_coefficient is not known here; friction is the drive's: state [losses.flank] "
                "friction_coefficient in the pair file"
            )
        return given

    @property
    def of_wear(self) -> Requirements:
        """The same without the limits on bearings, which a wear run can't judge."""
        return self.replace(limits=self.limits.replace(bearing_life=None))

    @pydantic.model_validator(mode="after")
    def _whole(self) -> Requirements:
        total = math.fsum(load.share for load in self.duty)
        if self.duty and abs(total - 1.0) > _SUM:
            raise ValueError(
                f"[[duty]] share adds up to {total:g} over the rows; it must add up to 1; a standstill is a row "
                "with output_speed 0"
            )
        for name in ("bearing_life", "sliding_speed", "friction_power_density", "efficiency", "temperature"):
            if getattr(self.limits, name) is not None and not any(load.output_speed > 0.0 for load in self.duty):
                raise ValueError(f"[limits] {name} needs speeds; state [[duty]] with an output_speed above 0")
        return self


def parse_requirements(text: str, source: str) -> Requirements:
    """Return the requirements of a TOML text; an `edge.InputError` names the invalid entries."""
    return edge.validated(Requirements, edge.toml_table(text, FORMAT, source), source)


def read_requirements(path: str | os.PathLike[str]) -> Requirements:
    """Return the requirements of a file, `cycloid-requirements/1`; an `edge.InputError` names the invalid entries."""
    return parse_requirements(edge.read_text(path, FORMAT), str(path))


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The verdict on one limit.

    Attributes
    ----------
    figure
        Its name, that of the limit.
    unit
        SI, of value, limit and margin.
    value, limit
        The worst value found, and the limit.
    side
        "max" where the limit is the largest value allowed, "min" where it is the smallest.
    where
        Place of the worst value: `torque` (N·m), `crank_angle` (rad), `disc`, `pin`, `bearing` and so on.
    basis
        What the value includes or is held against, such as "mesh alone" for a stiffness; mostly empty.
    """

    figure: str
    unit: str
    value: float
    limit: float
    side: Literal["min", "max"]
    where: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    basis: str = ""

    @property
    def margin(self) -> float:
        """The margin, below 0 if the limit is not met; in `unit`."""
        return self.limit - self.value if self.side == "max" else self.value - self.limit

    @property
    def share(self) -> float:
        """The margin as a share of the limit (1); NaN where the limit is 0 or a temperature."""
        return self.margin / abs(self.limit) if self.limit != 0.0 and self.unit != "K" else math.nan

    @property
    def met(self) -> bool:
        """Whether the limit is kept; at the limit it is."""
        return bool(self.margin >= 0.0)

    def numbers(self) -> dict[str, Any]:
        """Return the verdict for scripts, SI."""
        return {
            "figure": self.figure,
            "unit": self.unit,
            "value": self.value,
            self.side: self.limit,
            "met": self.met,
            "margin": self.margin,
            "margin_share": self.share,
            "where": dict(self.where),
            "basis": self.basis,
        }


def verdict(name: str, value: float, limit: float, where: Mapping[str, Any] | None = None, basis: str = "") -> Verdict:
    """Return the verdict on one figure of `Limits`, SI.

    Examples
    --------
    >>> found = verdict("max_contact_pressure", 1.1e9, 1.5e9, {"pin": 3})
    >>> found.met, round(found.margin * 1e-6), round(found.share, 3)
    (True, 400, 0.267)
    """
    unit = edge.unit_of_field(Limits.model_fields[name]) or "1"
    return Verdict(
        name, unit, float(value), float(limit), "min" if is_lower(name, limit) else "max", where or {}, basis
    )


def is_lower(name: str, limit: float) -> bool:
    """Return whether a limit is the smallest allowed value: those of `LOWER`, and a required self-locking."""
    return name in LOWER or (name == "self_locking" and bool(limit))


def static_safety(pair: Pair, pressure: float) -> float:
    """Return S_0 = (p_limit/p)² of the contacts: the load at the pressure limit over the load (1).

    The pressure of a line contact grows with the root of its load (Hertz), and ISO 76 rates by load. The limit is the
    pair's `largest_pressure`: stated, or that of the weaker material; of hardened bearing steel it is ISO 76's 4 GPa,
    at which the permanent deformation is 1e-4 of the roller's diameter. Infinite without contact.

    Raises
    ------
    edge.InputError
        If the pair states no limit and that of a body is not known.
    """
    limit = pressure_limit_of(pair).pressure
    return (limit / pressure) ** 2 if pressure > 0.0 else math.inf


def pressure_limit_of(pair: Pair, source: str = "the pair") -> PressureLimit:
    """Return the contact pressure that a pair may have at most: stated, or that of its weaker material.

    Raises
    ------
    edge.InputError
        If none is stated and gear or pin is neither named nor of steel, 206 GPa within 10 %.
    """
    if (limit := pair.largest_pressure) is not None:
        return limit
    body = "gear" if pair.material.gear.pressure_limit is None else "pin"
    modulus = getattr(pair.material, body).youngs_modulus
    raise edge.InputError(
        f"{source}: [pair] pressure_limit is missing; state it for static_safety, or name the material: "
        f"[material.{body}] youngs_modulus is {modulus * 1e-9:.4g} GPa, and no limit of such a material is known."
    )


def whole_stiffness(stiffness: Array, series: float) -> Array:
    """Return stiffnesses of contacts and bearings (N·m/rad) with a compliance in series (rad/(N·m)), N·m/rad."""
    return stiffness / (1.0 + stiffness * series)


def series_lost_motion(pair: Pair, series: float) -> float:
    """Return what a compliance in series (rad/(N·m)) adds to the lost motion, rad; 0 without a rated torque."""
    return series * float(np.ptp(pair.lost_motion_loads)) if pair.lost_motion_loads else 0.0


def what_is_elastic(pair: Pair, series: float) -> str:
    """Return what a stiffness includes, as text."""
    if pair.supports is None:
        return "mesh alone"
    if series == 0.0:
        return "contacts and bearings alone"
    return f"with {series * 1e6:.3g} µrad/(N·m) in series, up to the catalogue's stiffness"


def flank_curvature_radius(pair: Pair) -> float:
    """Return the smallest convex curvature radius of the flank as drawn, m; infinite where none is convex."""
    path = smallest_convex_radius(pair.generating_circle_radius, pair.eccentricity, pair.pins)
    return path - pair.generating_pin_radius


def judge(limits: Limits, pair: Pair, data: Mapping[Any, Any], series: float = 0.0) -> list[Verdict]:
    """Return the verdicts on an analysis: on every stated limit whose figure is in its arrays, at the worst load.

    Parameters
    ----------
    limits
        The limits of the application.
    pair
        For its pressure limit and its flank.
    data
        Arrays by name, SI: a dataset `cycloid-analysis/1`, or a mapping with `torque`, `crank_angle`,
        `transmission_error`, `backlash`, `interference`, `torsional_stiffness` (torque, crank_angle) and `pin_pressure`
        (torque, crank_angle, disc, pin). With `lost_motion` (crank_angle) it is judged too.
    series
        Compliance in series with contacts and bearings, rad/(N·m), for stiffness and lost motion
        (`analysis.series_compliance`).

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> from cycloid_fmu.studies.limits import Limits, judge
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> data = cy.Drive(pair).analyze("181 N*m", angles=45)
    >>> [(one.figure, one.met) for one in judge(Limits(static_safety=1.5, backlash="1 arcmin"), pair, data)]
    [('backlash', True), ('static_safety', True)]
    """
    stated, found = limits.stated(), list[Verdict]()
    torque, angle = np.atleast_1d(np.asarray(data["torque"])), np.asarray(data["crank_angle"])
    loaded = np.flatnonzero(torque != 0.0)

    def add(name: str, value: float, basis: str = "", **where: Any) -> None:
        if name in stated:
            found.append(verdict(name, value, stated[name], where, basis))

    def at(values: Array, place: int, torques: Array = torque) -> dict[str, Any]:
        """Return the place of a flat index over torque, crank angle, disc and pin."""
        index = np.unravel_index(place, values.shape)
        names = dict(zip(("torque", "crank_angle", "disc", "pin"), index, strict=False))
        where: dict[str, Any] = {"torque": float(torques[index[0]]), "crank_angle": float(angle[index[1]])}
        return where | {name: int(k) for name, k in names.items() if name in ("disc", "pin")}

    error = np.asarray(data["transmission_error"])
    ranges = np.ptp(error, axis=1)
    if ranges.size:
        k = int(ranges.argmax())
        add(
            "angular_transmission_error",
            ranges[k],
            torque=float(torque[k]),
            crank_angle=float(angle[error[k].argmax()]),
            crank_angle_of_smallest=float(angle[error[k].argmin()]),
        )
    backlash = np.nan_to_num(np.atleast_2d(np.asarray(data["backlash"])))[0]
    add("backlash", backlash.max(), crank_angle=float(angle[backlash.argmax()]))
    if "lost_motion" in data:
        lost = np.asarray(data["lost_motion"]) + series_lost_motion(pair, series)
        add("lost_motion", lost.max(), what_is_elastic(pair, series), crank_angle=float(angle[lost.argmax()]))
    interference = np.atleast_2d(np.asarray(data["interference"]))[0]
    pressed = interference.max() > 0.0
    place: dict[str, Any] = {"crank_angle": float(angle[interference.argmax()])} if pressed else {}
    add("interference", interference.max(), **place)
    pressure = np.asarray(data["pin_pressure"])
    if pressure.size:
        where = at(pressure, int(pressure.argmax()))
        add("max_contact_pressure", pressure.max(), **where)
        if "static_safety" in stated:
            limit = pressure_limit_of(pair)
            basis = f"at {limit.pressure * 1e-6:.5g} MPa {limit.basis}".rstrip()
            add("static_safety", static_safety(pair, float(pressure.max())), basis, **where)
    if loaded.size:
        stiffness = whole_stiffness(np.asarray(data["torsional_stiffness"])[loaded], series)
        place = at(stiffness, int(stiffness.argmin()), torque[loaded])
        add("torsional_stiffness", stiffness.min(), what_is_elastic(pair, series), **place)
    add("smallest_curvature_radius", flank_curvature_radius(pair))
    order = list(stated)
    return sorted(found, key=lambda one: order.index(one.figure))


def judge_lives(limits: Limits, lives: Iterable[DutyLife]) -> list[Verdict]:
    """Return the verdict on the bearing of the shortest life, none without a limit.

    Parameters
    ----------
    lives
        Of `supports.figures.lives_over_duty`; unknown ones, NaN, are left out.
    """
    known = {one.bearing: one.life for one in lives if not math.isnan(one.life)}
    if limits.bearing_life is None or not known:
        return []
    shortest = min(known, key=known.__getitem__)
    return [verdict("bearing_life", known[shortest], limits.bearing_life, {"bearing": shortest})]


def judge_sliding(
    limits: Limits, duty: Sequence[DutyLoad], crank_angle: Array, figures: Mapping[str, Array]
) -> list[Verdict]:
    """Return the verdicts on sliding.

    Parameters
    ----------
    duty
        The rows of `figures`.
    crank_angle
        rad.
    figures
        {"sliding_speed" (m/s), "friction_power_density" (W/m²)}, each over duty, crank angle, disc and pin.
    """
    found = []
    for name, limit in limits.stated().items():
        if name in figures and figures[name].size:
            row, angle, disc, pin = map(int, np.unravel_index(figures[name].argmax(), figures[name].shape))
            where = {
                "torque": duty[row].torque,
                "output_speed": duty[row].output_speed,
                "crank_angle": float(crank_angle[angle]),
                "disc": disc,
                "pin": pin,
            }
            found.append(verdict(name, figures[name].max(), limit, where))
    return found


def judge_friction(
    limits: Limits, duty: Sequence[DutyLoad], crank_angle: Array, figures: FrictionFigures
) -> list[Verdict]:
    """Return the verdicts on efficiency, starting and back-driving torque and self-locking.

    Parameters
    ----------
    duty
        The rows of `figures.efficiency`.
    crank_angle
        rad, of the others.
    """
    found = []
    if limits.efficiency is not None and figures.efficiency.size:
        row = int(figures.efficiency.argmin())
        where = {"torque": duty[row].torque, "output_speed": duty[row].output_speed}
        found.append(verdict("efficiency", figures.efficiency[row], limits.efficiency, where, "driving"))
    for name in ("starting_torque", "back_driving_torque"):
        if (limit := getattr(limits, name)) is not None:
            each = getattr(figures, name)
            none = f"none up to {figures.searched_to:g} N·m turns it" if np.isinf(each.max()) else ""
            place = {"crank_angle": float(crank_angle[each.argmax()])}
            found.append(verdict(name, each.max(), limit, place, none if name == "back_driving_torque" else ""))
    if limits.self_locking is not None:
        locks = np.isinf(figures.back_driving_torque)
        value = locks.all() if limits.self_locking else locks.any()
        basis = f"from rest, up to {figures.searched_to:g} N·m"
        found.append(verdict("self_locking", float(value), float(limits.self_locking), basis=basis))
    return found


def judge_strength(limits: Limits, stresses: Sequence[Stress]) -> list[Verdict]:
    """Return the verdicts on strength, each of the lowest safety; none where a stress that it needs is not judged."""
    found = []
    for name in STRENGTH:
        part = name.removesuffix("_safety").replace("_", " ")
        rows = [one for one in stresses if part in ((one.part,) if one.kind != "fatigue" else ("fatigue",))]
        limit = getattr(limits, name)
        if limit is not None and rows and not any(one.reason for one in rows):
            worst = min(rows, key=lambda one: one.safety)
            found.append(verdict(name, worst.safety, limit, worst.where, f"{worst.part}, {worst.kind}: {worst.basis}"))
    return found


def judge_heat(limits: Limits, warm: Heat | None) -> list[Verdict]:
    """Return the verdict on the steady temperature of the oil, infinite where there is none; none without a limit."""
    if limits.temperature is None or warm is None:
        return []
    oil = math.inf if warm.reason else warm.oil
    return [verdict("temperature", oil, limits.temperature, basis=warm.reason or "oil, over the duty")]


def judge_wear(limits: Limits, gear: Array, pin: Array, crank_turns: Array, deepest: Array) -> list[Verdict]:
    """Return the verdict on the deepest wear, none without a limit.

    Parameters
    ----------
    gear, pin
        Depth of each element at the end, m: shapes (discs, teeth, profile, slices) and (pins, angle, slices).
    crank_turns, deepest
        The history, and the largest depth of both bodies at each of its states, m: if the limit is not met, the verdict
        states the crank turns at which it was reached.
    """
    if limits.wear_depth is None:
        return []
    of_gear = gear.max() >= pin.max()
    values, names = (gear, ("disc", "tooth")) if of_gear else (pin, ("pin",))
    index = np.unravel_index(values.argmax(), values.shape)
    where: dict[str, Any] = {"body": "gear" if of_gear else "pin"}
    where |= dict(zip(names, map(int, index), strict=False))
    if values.max() > limits.wear_depth:
        where["reached_after_crank_turns"] = float(np.interp(limits.wear_depth, deepest, crank_turns))
    return [verdict("wear_depth", values.max(), limits.wear_depth, where)]


def judge_budget(limits: Limits, total: float, upper: float | None) -> list[Verdict]:
    """Return the verdict on the mean play of an RV reducer, as its backlash; none without a limit.

    Parameters
    ----------
    total
        By the contact model with the sun locked, of the deviations' values, rad.
    upper
        Upper end of the central 99.73 % of the reducers within tolerances, which is then judged; None without
        tolerances.
    """
    if limits.backlash is None:
        return []
    where = {"model": "contact model, sun locked, mean over the crank"}
    if upper is not None:
        where["of"] = "upper end of the central 99.73 % of the reducers"
    return [verdict("backlash", total if upper is None else upper, limits.backlash, where)]


def not_judged(limits: Limits, verdicts: Iterable[Verdict]) -> list[str]:
    """Return the stated limits without a verdict."""
    judged = {one.figure for one in verdicts}
    return [name for name in limits.stated() if name not in judged]


def not_judged_line(names: Iterable[str]) -> str:
    """Return limits without a verdict as one sentence for pictures and files; "" without any."""
    said = ", ".join(name.replace("_", " ") for name in names)
    return f"Not judged by this command, and so not met: {said}." if said else ""


def all_met(verdicts: Iterable[Verdict], not_judged: Iterable[str] = ()) -> bool:
    """Return whether all limits are met; those that are not judged are not."""
    return not list(not_judged) and all(one.met for one in verdicts)


HEAD = ("limit", "allowed", "found", "verdict", "margin", "where")
"""Columns of `row_of`."""


def row_of(one: Verdict) -> list[str]:
    """Return a verdict as a table row: figure, limit, value, met or not, margin and its share, place."""
    shown = SHOWN[one.figure]
    if one.figure == "self_locking":
        asked, found = ("yes" if value else "no" for value in (one.limit, one.value))
        return ["self locking", asked, found, "met" if one.met else "not met", "", place_of(one)]
    after = f" {shown.unit}" if shown.unit else ""
    share = "" if not math.isfinite(one.share) else f" ({one.share:+.1%})"
    return [
        one.figure.replace("_", " "),
        f"{'≤' if one.side == 'max' else '≥'} {shown(one.limit):.5g}{after}",
        f"{shown(one.value):.5g}{after}",
        "met" if one.met else "not met",
        f"{one.margin * shown.factor:+.4g}{' K' if shown.zero else after}{share}",
        place_of(one),
    ]


def place_of(one: Verdict) -> str:
    """Return the place of a verdict's value and what it includes, as text."""
    said = []
    for name, value in one.where.items():
        text = name.replace("_", " ")
        if name == "torque":
            said.append(f"at {value:g} N·m")
        elif name == "output_speed":
            said.append(f"{value * 30.0 / math.pi:.4g} rpm")
        elif name.startswith("crank_angle"):
            said.append(f"{text} {math.degrees(value):.2f}°")
        elif name == "body":
            said.append(f"on the {value}")
        elif name in ("bearing", "model", "of"):
            said.append(str(value))
        else:
            said.append(f"{text} {value:.4g}" if isinstance(value, float) else f"{text} {value}")
    return ", ".join([*said, one.basis] if one.basis else said)


def line_of(one: Verdict) -> str:
    """Return a verdict as one line, for pictures and files.

    Examples
    --------
    >>> print(line_of(verdict("max_contact_pressure", 1.1e9, 1.5e9, {"pin": 3})))
    max contact pressure 1100 MPa, allowed ≤ 1500 MPa: met (+26.7%), pin 3
    """
    name, limit, value, met, _, where = row_of(one)
    share = f" ({one.share:+.1%})" if math.isfinite(one.share) else ""
    return f"{name} {value}, allowed {limit}: {met}{share}{', ' if where else ''}{where}"
