"""The figures of a drive for its report, each with the range that follows from material, tolerances and friction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.analysis.validity import out_of_step
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import CRANK_SPEED
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.losses import figures as friction
from cycloid_fmu.studies import tolerance
from cycloid_fmu.studies.strength import Stress, strength
from cycloid_fmu.supports.figures import bearing_loads
from cycloid_fmu.surfaces.sampling import Tolerances
from cycloid_fmu.surfaces.surface import nominal_surface

Array = NDArray[np.float64]
_ANGLES = 90  # crank angles of every figure, at least
_DRIVES = 64  # sampled drives
_ENDS = (0.05, 0.95)  # of the sampled drives
_UNKNOWN = (math.nan, math.nan, math.nan)
_SLOW = 1.0  # rad/s of the crank: friction of a drive that turns slowly, without drags of speed


def _is_drawn(drive: DriveValue) -> bool:
    return drive.surface == nominal_surface(drive.pair)


def figures_head(drive: DriveValue) -> tuple[str, ...]:
    """Return the columns of `Figure.row`."""
    return ("", "as drawn" if _is_drawn(drive) else "with its errors", "range", "unit", "of")


NOT_COMPUTED = "Not computed: strength of crank, carrier, ring and housing, seals, wear, heat and noise."


class Figure(NamedTuple):
    """A figure of a drive with its range, SI; NaN is unknown.

    Attributes
    ----------
    name, unit
        Its name and SI unit.
    values
        Of the drive as stated, and the ends of its range.
    basis
        What the range is of, or why the value is not known.
    shown
        Unit of reports, and what SI values are multiplied by for it.
    """

    name: str
    unit: str
    values: tuple[float, float, float]
    basis: str
    shown: tuple[str, float] = ("", 1.0)

    def numbers(self) -> dict[str, Any]:
        """Return it for scripts, SI."""
        ends = dict(zip(("value", "low", "high"), self.values, strict=True))
        return {"name": self.name, "unit": self.unit, **ends, "basis": self.basis}

    def row(self) -> list[str]:
        """Return it as a table row."""
        unit, factor = self.shown[0] or self.unit, self.shown[1]
        known = [f"{value * factor:.3g}" if math.isfinite(value) else "" for value in self.values]
        is_wider = all(known[1:]) and {*known} != {known[0]}
        return [self.name, known[0] or "none", " … ".join(known[1:]) if is_wider else "", unit, self.basis]


def figures_of(
    drive: DriveValue,
    tolerances: Tolerances | None = None,
    bodies: Bodies | None = None,
    progress: Callable[[str], None] = lambda step: None,
    crank_speed: float = CRANK_SPEED,
) -> tuple[list[Figure], list[Stress]]:
    """Return the figures of a drive with its errors, at its rated torque, and its nominal stresses.

    Parameters
    ----------
    drive
        The drive; its pair must state the rated torque.
    tolerances
        What its parts hold, for the range of backlash, transmission error and pressure; None without ranges. Sampled
        drives have none of the drive's errors.
    bodies
        Dimensions of discs and pins, for masses and stresses; None for those of the pair.
    progress
        Called with the name of each stage.
    crank_speed
        Of a bearing's life in hours, rad/s.
    """
    pair = drive.pair
    bodies = bodies or pair.bodies
    progress("stiffness and pressure")
    solved = _over_modulus(drive)
    progress("tolerances")
    sampled = None if tolerances is None else _sampled(drive, tolerances)
    figures = [*_of_play(drive, solved[0], sampled), *_of_material(drive, solved, sampled, crank_speed)]
    if pair.losses is not None and pair.supports is not None:
        progress("losses")
        figures += _of_friction(_with_pair(drive, pair.replace(bodies=None)))
    progress("strength")
    stresses = strength(drive, solved[0], bodies)
    return figures + _of_mass(drive, bodies), stresses


def _turn(pair: Pair) -> Array:
    return np.linspace(0.0, 2.0 * np.pi, out_of_step(pair.pins, _ANGLES), endpoint=False)


def _with_pair(drive: DriveValue, pair: Pair) -> DriveValue:
    return DriveValue(pair, drive.surface, drive.first_stage)


def _sampled(drive: DriveValue, tolerances: Tolerances) -> dict[str, Array]:
    """Return the figures of sampled drives with rigid bodies at rated torque, each of shape (drives,)."""
    without = dict.fromkeys(("bodies", "losses", "thermal"))
    pair = drive.pair.nominal.replace(**without)
    torque, count = (pair.rated_load(),), _turn(pair).size
    study = tolerance.Study(pair, tolerances, _DRIVES, 1, torque, angles=count, first_stage=drive.first_stage)
    surfaces = [tolerance.surface_of(study, point) for point in tolerance.points(study)]
    columns = tolerance.exact_figures(study, surfaces).T
    return {name: column for (name, _), column in zip(study.columns, columns, strict=True)}


def _elastic(pair: Pair) -> str:
    """Return what of a drive is not rigid."""
    return "contacts" + (", bearings" if pair.supports else "") + (" and elastic bodies" if pair.bodies else "")


def _of_play(drive: DriveValue, solved: Transmission, sampled: dict[str, Array] | None) -> list[Figure]:
    """Backlash and transmission error, of the drive and of sampled ones."""
    pair = drive.pair
    play = solve(_with_pair(drive, pair.replace(bodies=None)), [], _turn(pair), with_stiffness=False).backlash
    error = solved.transmission_error[0]
    values = {
        "backlash": float(np.where(np.isnan(play), 0.0, play).max()),
        "angular_transmission_error": float(error.max() - error.min()),
    }
    rows = []
    for key, value in values.items():
        ends, basis = (math.nan, math.nan), f"{_elastic(pair)} alone"
        if sampled is not None:
            low, high = np.quantile(sampled[key], _ENDS).tolist()
            ends, basis = (low, high), f"{basis}; {_of_sampled(drive)}"
            if key == "backlash" and _is_drawn(drive):
                basis += "; their errors take from the play as drawn"
        rows.append(Figure(key.replace("_", " "), "rad", (value, *ends), basis, ("arcmin", edge.ARCMIN)))
    return rows


def _of_sampled(drive: DriveValue) -> str:
    """Return what the range of sampled drives is of."""
    without = "" if _is_drawn(drive) else " without these errors"
    return f"90 % of drives in the tolerances{without}{', with rigid bodies' if drive.pair.bodies else ''}"


def _values(results: Sequence[float]) -> tuple[float, float, float]:
    """Return the first of the results and the range of the others, NaN without others."""
    drawn, *ends = results
    return drawn, min(ends, default=math.nan), max(ends, default=math.nan)


def _with_modulus(pair: Pair, modulus: float) -> Pair:
    gear = pair.material.gear.replace(youngs_modulus=modulus)
    return pair.replace(material=pair.material.replace(gear=gear))


def _over_modulus(drive: DriveValue) -> list[Transmission]:
    """Return the drive at its rated torque, and with the ends of the range of its discs' modulus."""
    pair = drive.pair
    value, load = pair.material.gear.value, np.array([pair.rated_load()])
    pairs = [pair, *(_with_modulus(pair, modulus) for modulus in (value.youngs_modulus if value else ()))]
    return [solve(_with_pair(drive, each), load, _turn(pair), with_play=False) for each in pairs]


def _of_material(
    drive: DriveValue, solved: Sequence[Transmission], sampled: dict[str, Array] | None, crank_speed: float
) -> list[Figure]:
    """Stiffness and bearing life, over the range of the discs' modulus; largest pressure, also of sampled drives."""
    pair = drive.pair
    stiffness = [float(each.torsional_stiffness[0].mean()) for each in solved]
    pressure = _values([float(each.max_contact_pressure.max()) for each in solved])
    limit, name = pair.largest_pressure, pair.material.gear.name
    of = f"; range of the modulus of {name}" if name else ""
    permitted = "not judged: the material has no name"
    if limit is not None:
        permitted = f"permitted {limit.pressure * 1e-6:.0f} MPa {limit.basis}"
    if sampled is None:
        permitted += of
    else:
        column = sampled["max_contact_pressure"]
        low, high = np.quantile(column, _ENDS).tolist()
        pressure = (pressure[0], low, high)
        permitted += f"; {_of_sampled(drive)}"
        if limit is not None:
            permitted += f"; {np.sum(column > limit.pressure)} of {column.size} drives exceed the permitted"
    mean = f"mean slope at rated torque; {_elastic(pair)} alone{of}"
    rows = [
        Figure("torsional stiffness", "N·m/rad", _values(stiffness), mean, ("N·m/arcmin", 1.0 / edge.ARCMIN)),
        Figure("contact pressure", "Pa", pressure, permitted, ("MPa", 1e-6)),
    ]
    if pair.supports is None:
        return rows
    lives = {load.bearing: load.life for load in bearing_loads(pair, solved[0]) if math.isfinite(load.life)}
    if not lives:
        return [*rows, Figure("bearing life", "1", _UNKNOWN, "no bearing states its dynamic_capacity")]
    shortest = min(lives, key=lives.__getitem__)
    rpm = crank_speed * 30.0 / math.pi
    hours = lives[shortest] / (60.0 * rpm)
    basis = f"{shortest}: L10 (ISO 281) at rated torque, {hours:.3g} h at {rpm:.4g} rpm of the crank"
    million = ("million turns", 1e-6)
    return [*rows, Figure("bearing life", "1", (lives[shortest], math.nan, math.nan), basis, million)]


def _of_friction(drive: DriveValue) -> list[Figure]:
    """Efficiency, starting and back-driving torque, over the range of the friction coefficients."""
    found = friction.figures(drive, [drive.pair.rated_load()], _turn(drive.pair), _SLOW)
    of = "range of the friction in the table"

    def ends(get: Callable[[Any], float]) -> tuple[float, float, float]:
        return _values([get(one) for one in (found, *found.ends)])

    def efficiency(each: Any) -> float:
        (case,) = (case for case in each.cases if case.mode == "driving")
        return 0.0 if case.jams else float(case.efficiency)

    rows = [
        Figure("efficiency", "1", ends(efficiency), f"driving at rated torque, turning slowly; {of}", ("%", 100.0)),
        Figure("starting torque", "N·m", ends(lambda each: each.starting_torque), f"at the input, without load; {of}"),
    ]
    back = ends(lambda each: each.back_driving_torque)
    none = "" if math.isfinite(back[0]) else f"self-locking from rest up to {found.searched_to:g} N·m; "
    rows.append(Figure("back-driving torque", "N·m", back, f"{none}from rest; {of}"))
    return rows


def disc_mass(pair: Pair, bodies: Bodies | None) -> tuple[float, float]:
    """Return the mass of one disc and its moment of inertia about its own axis, kg and kg·m²; NaN where not known.

    The flank's area by Green's theorem, less bores and holes, at the middle of the material's range of densities.
    """
    from cycloid_fmu.bodies.outline import bores, other_holes, windows

    disc, material = None if bodies is None else bodies.disc, pair.material.gear.value
    if disc is None or disc.matrix is not None or material is None:
        return math.nan, math.nan
    x, y = flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 400 * pair.gear_teeth + 1))
    area, second = _area(x + 1j * y)
    for hole in [*bores(pair, disc, 360), *other_holes(pair, disc, 360), *windows(disc)]:
        less = _area(np.append(hole.points, hole.points[0]))
        area, second = area - less[0], second - less[1]
    density = 0.5 * sum(material.density)
    return density * pair.face_width * area, density * pair.face_width * second


def _area(curve: NDArray[np.complex128]) -> tuple[float, float]:
    """Return the area in a closed curve (m²) and its polar moment about the origin (m⁴), by Green's theorem."""
    x, y = curve.real, curve.imag
    cross = x[:-1] * y[1:] - x[1:] * y[:-1]
    squares = x[:-1] ** 2 + x[:-1] * x[1:] + x[1:] ** 2 + y[:-1] ** 2 + y[:-1] * y[1:] + y[1:] ** 2
    return 0.5 * float(cross.sum()), float((cross * squares).sum()) / 12.0


def _of_mass(drive: DriveValue, bodies: Bodies | None) -> list[Figure]:
    """Mass of discs and pins, inertia of the orbiting discs where the crank is the input, unbalance."""
    pair = drive.pair
    mass, inertia = disc_mass(pair, bodies)
    gear, pin = pair.material.gear, pair.material.pin
    if gear.value is None or pin.value is None or math.isnan(mass):
        missing = (
            "name the materials of discs and pins" if gear.value is None or pin.value is None else "state [bodies.disc]"
        )
        units = {"mass of discs and pins": "kg", "inertia of the discs at the input": "kg·m²", "unbalance": "kg·m"}
        return [Figure(name, unit, _UNKNOWN, f"not computed: {missing}") for name, unit in units.items()]
    low, high = gear.value.density
    spread = (high - low) / (high + low)
    pins = 0.5 * sum(pin.value.density) * math.pi * pair.pin_radius**2
    pins *= pair.pins * pair.discs * pair.face_width
    discs = pair.discs * mass
    # A disc orbits with the eccentric, and turns about its own axis by 1/z_c of a crank turn, backwards.
    rotor = discs * pair.eccentricity**2 + pair.discs * inertia / pair.gear_teeth**2
    unbalance = mass * pair.eccentricity if pair.discs == 1 else 0.0
    of = f"range of the density of {gear.name}"
    ends = (1.0, 1.0 - spread, 1.0 + spread)
    heavy, lazy = (_values([discs * share + pins for share in ends]), _values([rotor * share for share in ends]))
    at_input = f"without crank and motor; {of}"
    if drive.first_stage is not None:
        lazy, at_input = _UNKNOWN, "not computed behind a first stage"
    how = "of one disc" if pair.discs == 1 else "discs evenly around the crank; a couple remains"
    return [
        Figure("mass of discs and pins", "kg", heavy, f"without ring, crank and carrier; {of}"),
        Figure("inertia of the discs at the input", "kg·m²", lazy, at_input),
        Figure("unbalance", "kg·m", (unbalance, unbalance, unbalance), how, ("g·mm", 1e6)),
    ]
