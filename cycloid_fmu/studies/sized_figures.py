"""The figures of a first drive, each with the range that follows from material, process and friction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.losses import figures as friction
from cycloid_fmu.studies import tolerance
from cycloid_fmu.studies.sizing import Sizing
from cycloid_fmu.supports.figures import bearing_loads
from cycloid_fmu.surfaces.sampling import parse_tolerances
from cycloid_fmu.surfaces.surface import surface_of_pair

Array = NDArray[np.float64]
_ANGLES = 90  # crank angles of every figure
_DRIVES = 64  # sampled drives
_ENDS = (0.05, 0.95)  # of the sampled drives
_CRANK_SPEED = 1.0  # rad/s: friction of a drive that turns slowly, without drags of speed


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
        return [self.name, known[0] or "none", " … ".join(known[1:]) if all(known[1:]) else "", unit, self.basis]


def figures_of(drive: Sizing, progress: Callable[[str], None] = lambda step: None) -> list[Figure]:
    """Return the figures of a first drive.

    Parameters
    ----------
    drive
        Of `sizing.size`.
    progress
        Called with the name of each stage.
    """
    progress("tolerances")
    found = _of_tolerances(drive)
    progress("stiffness and pressure")
    found += _of_material(drive)
    if drive.pair.losses is not None:
        progress("losses")
        found += _of_friction(drive)
    return found + _of_mass(drive)


def _turn() -> Array:
    return np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)


def _of_tolerances(drive: Sizing) -> list[Figure]:
    """Backlash and transmission error, as drawn and of sampled drives."""
    pair = drive.pair.replace(supports=None, bodies=None, losses=None)
    tolerances = parse_tolerances(drive.tolerances, "tolerances of the process")
    torque = (pair.rated_load(),)
    study = tolerance.Study(pair, tolerances, samples=_DRIVES, seed=1, torque=torque, angles=_ANGLES)
    surfaces = [tolerance.surface_of(study, point) for point in tolerance.points(study)]
    sampled = tolerance.exact_figures(study, surfaces)
    (drawn,) = tolerance.exact_figures(study, [surface_of_pair(pair)])
    rows = []
    basis = f"the mesh alone; 90 % of drives by {drive.wish.process}"
    for key, shown in (("backlash", ("arcmin", edge.ARCMIN)), ("angular_transmission_error", ("arcmin", edge.ARCMIN))):
        column = next(k for k, (name, _) in enumerate(study.columns) if name == key)
        low, high = np.quantile(sampled[:, column], _ENDS).tolist()
        rows.append(Figure(key.replace("_", " "), "rad", (float(drawn[column]), low, high), basis, shown))
    return rows


def _values(results: Sequence[float]) -> tuple[float, float, float]:
    """Return the first of three results and the range of the others."""
    drawn, *ends = results
    return drawn, min(ends), max(ends)


def _with_modulus(pair: Pair, modulus: float) -> Pair:
    gear = pair.material.gear.replace(youngs_modulus=modulus)
    return pair.replace(material=pair.material.replace(gear=gear))


def _of_material(drive: Sizing) -> list[Figure]:
    """Stiffness, largest pressure and its safety, and bearing life, over the range of the discs' modulus."""
    pair, turn = drive.pair, _turn()
    material = MATERIALS[drive.wish.material]
    torque = np.array([pair.rated_load()])
    solved = []
    for modulus in (material.modulus, *material.youngs_modulus):
        one = _with_modulus(pair, modulus)
        solved.append(solve(DriveValue(one, surface_of_pair(one)), torque, turn, with_play=False))
    stiffness = [float(each.torsional_stiffness[0].mean()) for each in solved]
    pressure = [float(each.max_contact_pressure.max()) for each in solved]
    limit = pair.largest_pressure
    assert limit is not None
    of = f"range of the modulus of {drive.wish.material}"
    elastic = "contacts, eccentric bearing and output pins" if pair.supports else "contacts"
    permitted = f"permitted {limit.pressure * 1e-6:.0f} MPa {limit.basis}"
    rows = [
        Figure("torsional stiffness", "N·m/rad", _values(stiffness), f"mean; {elastic} alone; {of}"),
        Figure("contact pressure", "Pa", _values(pressure), permitted, ("MPa", 1e-6)),
    ]
    if pair.supports is not None:
        life = min(load.life for load in bearing_loads(pair, solved[0]) if math.isfinite(load.life))
        basis, million = "crank turns at rated torque, L10 of ISO 281", ("million turns", 1e-6)
        rows.append(Figure("life of the eccentric bearing", "1", (life, math.nan, math.nan), basis, million))
    return rows


def _of_friction(drive: Sizing) -> list[Figure]:
    """Efficiency, starting and back-driving torque, over the range of the friction coefficients."""
    pair = drive.pair
    value = DriveValue(pair, surface_of_pair(pair))
    found = friction.figures(value, [pair.rated_load()], _turn(), _CRANK_SPEED)
    of = "range of the friction in the table"

    def ends(get: Callable[[Any], float]) -> tuple[float, float, float]:
        low, high = (get(end) for end in found.ends) if found.ends else (math.nan, math.nan)
        return get(found), low, high

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


def disc_mass(drive: Sizing) -> tuple[float, float]:
    """Return the mass of one disc and its moment of inertia about its own axis, kg and kg·m².

    The flank's area by Green's theorem, less the holes for output pins and eccentric bearing, at the middle of the
    range of densities.
    """
    pair, supports = drive.pair, drive.pair.supports
    x, y = flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 400 * pair.gear_teeth + 1))
    cross = x[:-1] * y[1:] - x[1:] * y[:-1]
    area = 0.5 * float(cross.sum())
    second = float(
        (cross * (x[:-1] ** 2 + x[:-1] * x[1:] + x[1:] ** 2 + y[:-1] ** 2 + y[:-1] * y[1:] + y[1:] ** 2)).sum()
    )
    second /= 12.0
    if supports is not None and supports.output_roller is not None and supports.output_roller.radius is not None:
        hole = supports.output_roller.radius + pair.eccentricity
        bore = drive.bearing_seat
        area -= math.pi * (supports.count * hole**2 + bore**2)
        second -= math.pi * (supports.count * (0.5 * hole**4 + (hole * supports.circle_radius) ** 2) + 0.5 * bore**4)
    low, high = MATERIALS[drive.wish.material].density
    density = 0.5 * (low + high)
    return density * pair.face_width * area, density * pair.face_width * second


def _of_mass(drive: Sizing) -> list[Figure]:
    """Mass of discs and pins, inertia of the orbiting discs, unbalance."""
    pair = drive.pair
    mass, inertia = disc_mass(drive)
    low, high = MATERIALS[drive.wish.material].density
    spread = (high - low) / (high + low)
    pins = 0.5 * sum(MATERIALS[drive.wish.pin_material].density) * math.pi * pair.pin_radius**2
    pins *= pair.pins * pair.discs * pair.face_width
    discs = pair.discs * mass
    # A disc orbits with the eccentric, and turns about its own axis by 1/z_c of a crank turn, backwards.
    rotor = discs * pair.eccentricity**2 + pair.discs * inertia / pair.gear_teeth**2
    unbalance = mass * pair.eccentricity if pair.discs == 1 else 0.0
    of = f"range of the density of {drive.wish.material}"
    ends = (1.0, 1.0 - spread, 1.0 + spread)
    heavy, lazy = (_values([discs * share + pins for share in ends]), _values([rotor * share for share in ends]))
    how = "of one disc" if pair.discs == 1 else "discs opposite each other; a couple remains"
    return [
        Figure("mass of discs and pins", "kg", heavy, f"without ring, crank and carrier; {of}"),
        Figure("inertia of the discs at the input", "kg·m²", lazy, f"without crank and motor; {of}"),
        Figure("unbalance", "kg·m", (unbalance, unbalance, unbalance), how, ("g·mm", 1e6)),
    ]
