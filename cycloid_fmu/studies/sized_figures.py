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
from cycloid_fmu.surfaces.surface import surface_of_pair

Array = NDArray[np.float64]
_ANGLES = 90  # crank angles of every figure, at least
_DRIVES = 64  # sampled drives
_ENDS = (0.05, 0.95)  # of the sampled drives
_UNKNOWN = (math.nan, math.nan, math.nan)
_SLOW = 1.0  # rad/s of the crank: friction of a drive that turns slowly, without drags of speed


FIGURES_HEAD = ("", "as drawn", "range", "unit", "of")
"""Columns of `Figure.row`."""
NOT_COMPUTED = "Not computed: strength of crank, carrier, ring and housing, seals, wear, heat and noise."


class Figure(NamedTuple):
    """A figure of a drive with its range, SI; NaN is unknown.

    Attributes
    ----------
    name, unit
        Its name and SI unit.
    values
        As drawn, and the ends of its range.
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
    pair: Pair,
    tolerances: Tolerances | None = None,
    bodies: Bodies | None = None,
    progress: Callable[[str], None] = lambda step: None,
    crank_speed: float = CRANK_SPEED,
) -> tuple[list[Figure], list[Stress]]:
    """Return the figures of a drive as drawn, at its rated torque, and its nominal stresses.

    Parameters
    ----------
    pair
        The drive; it must state its rated torque.
    tolerances
        What its parts hold, for the range of backlash and transmission error; None without ranges.
    bodies
        Dimensions of discs and pins, for masses and stresses; None for those of the pair.
    progress
        Called with the name of each stage.
    crank_speed
        Of a bearing's life in hours, rad/s.
    """
    bodies = bodies or pair.bodies
    progress("tolerances")
    found = _of_tolerances(pair, tolerances)
    progress("stiffness and pressure")
    solved = _over_modulus(pair)
    found += _of_material(pair, solved, crank_speed)
    if pair.losses is not None and pair.supports is not None:
        progress("losses")
        found += _of_friction(pair.replace(bodies=None))
    progress("strength")
    stresses = strength(DriveValue(pair, surface_of_pair(pair)), solved[0], bodies)
    return found + _of_mass(pair, bodies), stresses


def _turn(pair: Pair) -> Array:
    return np.linspace(0.0, 2.0 * np.pi, out_of_step(pair.pins, _ANGLES), endpoint=False)


def _of_tolerances(pair: Pair, tolerances: Tolerances | None) -> list[Figure]:
    """Backlash and transmission error, as drawn and of sampled drives."""
    torque = (pair.rated_load(),)
    bare = dict.fromkeys(("supports", "bodies", "losses", "thermal", "temperature", "rated_torque"))
    pair = pair.nominal.replace(**bare)
    samples = 1 if tolerances is None else _DRIVES
    stated = Tolerances() if tolerances is None else tolerances
    study = tolerance.Study(pair, stated, samples=samples, seed=1, torque=torque, angles=_turn(pair).size)
    (drawn,) = tolerance.exact_figures(study, [surface_of_pair(pair)])
    sampled, basis = np.full((1, drawn.size), np.nan), "the mesh alone"
    if tolerances is not None:
        surfaces = [tolerance.surface_of(study, point) for point in tolerance.points(study)]
        sampled, basis = tolerance.exact_figures(study, surfaces), "the mesh alone; 90 % of drives in the tolerances"
    rows = []
    for key, shown in (("backlash", ("arcmin", edge.ARCMIN)), ("angular_transmission_error", ("arcmin", edge.ARCMIN))):
        column = next(k for k, (name, _) in enumerate(study.columns) if name == key)
        low, high = np.quantile(sampled[:, column], _ENDS).tolist()
        taken = "; their errors take from the play as drawn" if key == "backlash" and tolerances is not None else ""
        rows.append(Figure(key.replace("_", " "), "rad", (float(drawn[column]), low, high), basis + taken, shown))
    return rows


def _values(results: Sequence[float]) -> tuple[float, float, float]:
    """Return the first of the results and the range of the others, NaN without others."""
    drawn, *ends = results
    return drawn, min(ends, default=math.nan), max(ends, default=math.nan)


def _with_modulus(pair: Pair, modulus: float) -> Pair:
    gear = pair.material.gear.replace(youngs_modulus=modulus)
    return pair.replace(material=pair.material.replace(gear=gear))


def _over_modulus(pair: Pair) -> list[Transmission]:
    """Return the drive as drawn at its rated torque, and with the ends of the range of its discs' modulus."""
    value, load = pair.material.gear.value, np.array([pair.rated_load()])
    drives = [pair, *(_with_modulus(pair, modulus) for modulus in (value.youngs_modulus if value else ()))]
    return [solve(DriveValue(one, surface_of_pair(one)), load, _turn(pair), with_play=False) for one in drives]


def _of_material(pair: Pair, solved: Sequence[Transmission], crank_speed: float) -> list[Figure]:
    """Stiffness, largest pressure, and bearing life, over the range of the discs' modulus."""
    stiffness = [float(each.torsional_stiffness[0].mean()) for each in solved]
    pressure = [float(each.max_contact_pressure.max()) for each in solved]
    limit, name = pair.largest_pressure, pair.material.gear.name
    of = f"; range of the modulus of {name}" if name else ""
    elastic = "contacts" + (", bearings" if pair.supports else "") + (" and elastic bodies" if pair.bodies else "")
    permitted = "not judged: the material has no name" + of
    if limit is not None:
        permitted = f"permitted {limit.pressure * 1e-6:.0f} MPa {limit.basis}"
    rows = [
        Figure("torsional stiffness", "N·m/rad", _values(stiffness), f"mean; {elastic} alone{of}"),
        Figure("contact pressure", "Pa", _values(pressure), permitted, ("MPa", 1e-6)),
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


def _of_friction(pair: Pair) -> list[Figure]:
    """Efficiency, starting and back-driving torque, over the range of the friction coefficients."""
    value = DriveValue(pair, surface_of_pair(pair))
    found = friction.figures(value, [pair.rated_load()], _turn(pair), _SLOW)
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


def _of_mass(pair: Pair, bodies: Bodies | None) -> list[Figure]:
    """Mass of discs and pins, inertia of the orbiting discs, unbalance."""
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
    how = "of one disc" if pair.discs == 1 else "discs opposite each other; a couple remains"
    return [
        Figure("mass of discs and pins", "kg", heavy, f"without ring, crank and carrier; {of}"),
        Figure("inertia of the discs at the input", "kg·m²", lazy, f"without crank and motor; {of}"),
        Figure("unbalance", "kg·m", (unbalance, unbalance, unbalance), how, ("g·mm", 1e6)),
    ]
