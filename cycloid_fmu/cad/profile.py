"""The profile of a disc: its outline in arcs, its holes, and the pins and the ring around it."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies import outline
from cycloid_fmu.cad.arcs import arcs_of
from cycloid_fmu.cad.outline import Array, Points, Tooth, teeth_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.bodies import DiscBody
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import dimensions

CHORD_ERROR = 1e-7
_LEAST, _MOST = 1e-9, 1e-4  # chord errors, m: the contact model is verified to a nanometre
_BETWEEN = 8  # points checked between two points of the table


@dataclass(frozen=True, eq=False)
class Profile:
    """A disc as made, at 20 °C and crank angle 0: the disc's axis is the origin, the axes are those of the frame.

    Points are complex numbers x + iy, m. Tooth 0 of the first disc has its root on +x; other discs have the
    orientation, holes and pins of the drive at crank angle 0.

    Attributes
    ----------
    pair, disc
        The pair as drawn, and the number of its disc.
    chord_error, largest_error
        Allowed and actual largest distance of the flank from its arcs, m.
    start, bulge
        Start of each arc of the outline, counter-clockwise, shape (arcs,), and its bulge as in DXF: the tangent of a
        quarter of its angle, > 0 counter-clockwise. The last arc ends at the first start.
    pin_place, pin_radius
        Axes and radii of the pins, shape (pins,), m.
    ring_place, ring_radius
        Axis and radius of the pin circle, m.
    hole_place, hole_radius
        Axes of the holes for cranks or output rollers and for the eccentric, and their radii, NaN if the pair does not
        state them; shape (holes,), m.
    windows
        Start and bulge of the arcs, as of the outline, of each further hole in an elastic disc that is no circle.
    notes
        One sentence for each size that the pair does not state.
    """

    pair: Pair
    disc: int
    chord_error: float
    largest_error: float
    start: Points
    bulge: Array
    pin_place: Points
    pin_radius: Array
    ring_place: complex
    ring_radius: float
    hole_place: Points
    hole_radius: Array
    windows: tuple[tuple[Points, Array], ...]
    notes: tuple[str, ...]
    teeth: Sequence[Tooth]

    @property
    def area(self) -> float:
        """Area inside the outline, without subtracting holes, m²."""
        end = np.roll(self.start, -1)
        angle = 4.0 * np.arctan(self.bulge)
        flat = np.abs(self.bulge) < 1e-9
        steep = np.where(flat, 1.0, self.bulge)
        radius = np.abs(end - self.start) * (1.0 + steep**2) / (4.0 * steep)
        beside = np.where(flat, 0.0, 0.5 * radius**2 * np.sign(steep) * (np.abs(angle) - np.sin(np.abs(angle))))
        return float(0.5 * (np.conj(self.start) * end).imag.sum() + beside.sum())

    @property
    def length(self) -> float:
        """Length of the outline, m."""
        angle = np.arctan(self.bulge)
        return float((np.abs(np.roll(self.start, -1) - self.start) * 2.0 * angle / np.sin(2.0 * angle)).sum())

    @functools.cached_property
    def table(self) -> dict[str, Array]:
        """Points of the flank, SI; straight lines between them stay within the chord error.

        Returns
        -------
        dict
            `tooth`, `arc_length` along the outline from tooth 0's first root, m, `angle` about the disc's axis, rad,
            `x`, `y`, m, the outward normal `normal_x`, `normal_y`, and `curvature`, 1/m, > 0 convex, of the flank with
            its modification, without deviations of its form.
        """
        found: dict[str, list[Array]] = {}
        length = 0.0
        for number, tooth in enumerate(self.teeth):
            alpha = _dense(tooth, self.chord_error)
            at, normal = tooth.points(alpha[:-1]), -1j * tooth.tangents(alpha[:-1])
            arc = length + np.concatenate([[0.0], np.cumsum(_arc_lengths(tooth, alpha))])
            length = float(arc[-1])
            row = {
                "tooth": np.full(at.size, float(number)),
                "arc_length": arc[:-1],
                "angle": np.angle(at) % (2.0 * math.pi),
                "x": at.real,
                "y": at.imag,
                "normal_x": normal.real,
                "normal_y": normal.imag,
                "curvature": tooth.curvature(alpha[:-1]),
            }
            for name, values in row.items():
                found.setdefault(name, []).append(values)
        return {name: np.concatenate(values) for name, values in found.items()}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the profile in mm: DXF, SVG, CSV or STEP by the ending of the name; never a partial file.

        DXF and SVG have the layers DISC, PINS, RING and HOLES; STEP has the disc and the pins as bodies of the face
        width, mid-width at z = 0; CSV has the points of `table`.

        Raises
        ------
        edge.InputError
            If the ending is not one of these, the file can't be written, or the library for the format is missing.
        """
        from cycloid_fmu.cad.files import write

        write(self, path)


def profile_of(drive: DriveValue, disc: int = 0, chord_error: float = CHORD_ERROR) -> Profile:
    """Return the profile of a disc as made.

    Parameters
    ----------
    pair, surface
        The pair and its actual errors.
    disc
        Number of the disc, from 0.
    chord_error
        Largest distance of the flank from the arcs, m.

    Raises
    ------
    edge.InputError
        If there is no such disc, the chord error is out of range, the drive is impossible or a hole cuts the flank.
    """
    pair, surface = drive.pair, drive.surface
    if not 0 <= disc < pair.discs:
        allowed = f"it must be between 0 and {pair.discs - 1}" if pair.discs > 1 else "the pair has only disc 0"
        raise edge.ArgumentError("disc", allowed, disc)
    if not _LEAST <= chord_error <= _MOST:
        given = edge.format_quantity(chord_error, "m", "um")
        raise edge.ArgumentError("chord_error", "it must be between 0.001 um and 100 um", given)
    teeth = teeth_of(drive, disc)
    cold = pair.replace(temperature=None)
    made = dimensions(cold, surface)
    start, bulge, largest = arcs_of(teeth, chord_error)
    crank = np.exp(2j * np.pi * disc / pair.discs)
    ring = -complex(made["crank_throw"] * crank + made["centre_x"] + 1j * made["centre_y"])
    around = 2.0 * np.pi * np.arange(pair.pins) / pair.pins + made["pin_tangential"] / cold.pin_circle_radius
    place, radius, notes = _holes(cold, made, disc)
    body = None if pair.bodies is None else pair.bodies.disc
    round_, windows = _windows(body)
    place, radius = np.append(place, round_[0]), np.append(radius, round_[1])
    outer = np.abs(place) + np.nan_to_num(radius)
    if place.size and outer.max() >= np.abs(start).min():
        raise edge.InputError(
            f"supports: a hole reaches {outer.max() * 1e3:.6g} mm from the disc's axis and cuts the flank, whose roots "
            f"are at {np.abs(start).min() * 1e3:.6g} mm."
        )
    return Profile(
        pair=pair,
        disc=disc,
        chord_error=chord_error,
        largest_error=largest,
        start=start,
        bulge=bulge,
        pin_place=ring + made["pin_radial"] * np.exp(1j * around),
        pin_radius=np.asarray(made["pin_radius"]),
        ring_place=ring,
        ring_radius=cold.pin_circle_radius + float(surface.errors["pin_circle_radius"]),
        hole_place=place,
        hole_radius=radius,
        windows=windows,
        notes=notes,
        teeth=teeth,
    )


def _holes(pair: Pair, made: dict[str, Array], disc: int) -> tuple[Points, Array, tuple[str, ...]]:
    """Axes and radii of a disc's holes, and notes on missing values."""
    supports = pair.supports
    if supports is None:
        return np.empty(0, complex), np.empty(0), ()
    angle = supports.first_angle + 2.0 * np.pi * np.arange(supports.count) / supports.count
    place = supports.circle_radius * np.exp(1j * angle) + made["hole_x"][disc] + 1j * made["hole_y"][disc]
    bore, body = supports.turning_arm.raceway_diameter, None if pair.bodies is None else pair.bodies.disc
    if bore is None and body is not None and body.bore_radius is not None:
        bore = 2.0 * body.bore_radius
    in_bore = math.nan if bore is None else 0.5 * bore
    notes = []
    if supports.kind == "cranks":
        if bore is None:
            notes.append(_unstated("turning_arm", "raceway_diameter", "holes for the cranks"))
        return place, np.full(place.size, in_bore), tuple(notes)
    roller = supports.output_roller
    radius = np.full(place.size, math.nan)
    if body is not None and body.roller_hole_radius is not None:
        radius = body.roller_hole_radius + made["hole_play"][disc]
    elif roller is None or roller.radius is None:
        notes.append(_unstated("output_roller", "radius", "holes for the output rollers"))
    else:
        # Definition of the contact of rollers and holes: the roller's axis orbits in the hole at the eccentricity.
        radius = roller.radius + pair.eccentricity + 0.5 * roller.clearance + made["hole_play"][disc]
    if bore is None:
        notes.append(_unstated("turning_arm", "raceway_diameter", "hole for the eccentric"))
    return np.append(place, 0.0), np.append(radius, in_bore), tuple(notes)


def _windows(body: DiscBody | None) -> tuple[tuple[Points, Array], tuple[tuple[Points, Array], ...]]:
    """Axes and radii of the round holes that an elastic disc has besides, and the others as arcs, by their bulges."""
    if body is None:
        return (np.empty(0, complex), np.empty(0)), ()
    place, radius, others = list[complex](), list[float](), list[tuple[Points, Array]]()
    if body.centre_radius is not None:
        place, radius = [0.0], [body.centre_radius]
    for window in body.windows:
        if window.shape == "round":
            assert window.circle_radius is not None
            assert window.radius is not None
            angle = window.first_angle + 2.0 * np.pi * np.arange(window.count) / window.count
            place += (window.circle_radius * np.exp(1j * angle)).tolist()
            radius += [window.radius] * window.count
    for contour in outline.windows(body.replace(windows=tuple(w for w in body.windows if w.shape != "round"))):
        # Half of an arc's angle is that between its chords to any of its points.
        chords = [(piece[piece.size // 2] - piece[0], piece[-1] - piece[piece.size // 2]) for piece in contour.pieces]
        bulge = [np.tan(0.5 * np.angle(after * np.conj(before))) if after else 0.0 for before, after in chords]
        others.append((np.array([piece[0] for piece in contour.pieces]), np.array(bulge)))
    return (np.array(place, complex), np.array(radius)), tuple(others)


def _unstated(table: str, key: str, holes: str) -> str:
    what = f"the {holes} have no radius" if holes.startswith("holes") else f"the {holes} has no radius"
    return f"[supports.{table}] {key} is not stated, so {what}: DXF and SVG mark centres, STEP has no hole."


def _dense(tooth: Tooth, limit: float) -> Array:
    """Profile parameters of points whose chords stay within a limit, both ends included."""
    inside = tooth.knots[(tooth.knots > tooth.low) & (tooth.knots < tooth.high)]
    fine = np.linspace(tooth.low, tooth.high, 2001)
    # The sagitta of a chord l is l²/8ρ; where the flank is nearly straight, points are at most a 50th of a tooth apart.
    need = tooth.speed(fine) * np.sqrt(np.abs(tooth.curvature(fine)) / (8.0 * limit)) + 50.0 / (tooth.high - tooth.low)
    grown = np.concatenate([[0.0], np.cumsum(0.5 * (need[1:] + need[:-1]) * np.diff(fine))])
    count = math.ceil(grown[-1])
    while True:
        even = np.interp(np.linspace(0.0, grown[-1], count + 1), grown, fine)
        even[0], even[-1] = tooth.low, tooth.high
        alpha = np.union1d(even, inside)
        ends = tooth.points(alpha)
        between = np.linspace(alpha[:-1], alpha[1:], _BETWEEN + 2, axis=1)[:, 1:-1]
        chord = np.diff(ends)[:, None]
        off = np.abs(((tooth.points(between) - ends[:-1, None]) / (chord / np.abs(chord))).imag)
        if off.max() <= 0.98 * limit:
            return alpha
        count = math.ceil(1.1 * count)


def _arc_lengths(tooth: Tooth, alpha: Array) -> Array:
    """Arc lengths between neighbouring profile parameters, m."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(alpha)
    middle = alpha[:-1] + half
    return np.asarray((tooth.speed(middle[:, None] + half[:, None] * nodes) * weights).sum(axis=1) * half)
