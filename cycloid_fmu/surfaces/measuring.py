"""Measured error surfaces: coordinates of flanks and pins from a coordinate measuring machine.

A point's deviation is its distance along the normal from the closest point of the nominal surface. Points are in the
machine's frame, so the nominal frame is fitted: for each disc's gear a rotation about the axis and a shift normal to
it, together with a rotation of each tooth (its pitch); for the pins a circle each, and the rotation and shift of all
their centres. z, along the axis and 0 at mid-width, is not fitted.

Quantities that a fitted frame can't determine are set to zero: the mean pitch of the teeth, the mean tangential error
of the pins, and the common shift in the pins' position errors. The mean of the pins' radial errors is the error of the
pin circle, the mean of their radius errors that of all pins; the remainders are the errors of each pin.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import spatial
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import (
    arc_parts,
    equal_arc_parameters,
    flank_curvature,
    flank_normals,
    flank_points,
    flank_speed,
)
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT, Elements, ErrorSurface

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

LENGTHS = ("x", "y", "z")
FEWEST_TOOTH_POINTS = 8
FEWEST_PIN_POINTS = 6
DEFAULT_ELEMENTS = Elements(profile=50, width=5, angle=25)

_MICRON = 1e-6
_NEIGHBOURS = 8
# A point is an outlier if its distance from its neighbours exceeds this many robust standard deviations (1.4826 times
# the median absolute deviation) and the floor; without the floor, points of a noiseless, steep form would be outliers.
_OUTLYING, _OUTLYING_FLOOR = 8.0, 2e-6
_ROUGH_POINTS = 600


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of one or more bodies, SI, arrays of shape (points,).

    Attributes
    ----------
    gear
        True for a point on a gear's flank, False for one on a pin.
    disc, number
        Number of the disc (0 for pins), and of the tooth or pin, from 0.
    x, y, z
        Coordinates in the machine's frame, m; z along the axis from mid-width.
    line
        The line of the file, from 1.
    source
        The file's name.
    """

    gear: Booleans
    disc: Integers
    number: Integers
    x: Array
    y: Array
    z: Array
    line: Integers
    source: str


@dataclass(frozen=True)
class Alignment:
    """The fitted frame of one measured body.

    Attributes
    ----------
    body
        "gear, disc 0" and so on, or "pins".
    x, y, rotation
        Position (m) and rotation (rad, counter-clockwise) of the nominal frame in the machine's frame.
    points, outliers
        Number of measured points, and of outliers among them.
    rms
        Root mean square of the points' deviations after pitch, positions and radii are removed, m.
    scatter
        Root mean square of the points about the mean of their element, m: noise, and form within an element.
    """

    body: str
    x: float
    y: float
    rotation: float
    points: int
    outliers: int
    rms: float
    scatter: float


@dataclass(frozen=True)
class Outlier:
    """A removed point: its line in the file, its position, and its distance from its neighbours, m."""

    line: int
    place: str
    distance: float


@dataclass(frozen=True)
class MeasurementReport:
    """Report of the fit; `gear_empty` and `pin_empty` are True for interpolated elements."""

    alignments: tuple[Alignment, ...]
    outliers: tuple[Outlier, ...]
    gear_empty: Booleans | None
    pin_empty: Booleans | None
    notes: tuple[str, ...]


def read_points(path: str | os.PathLike[str]) -> MeasuredPoints:
    """Read points from CSV: a header `body,disc,number,x [mm],y [mm],z [mm]`, one row for each point.

    `body` is gear or pin, `disc` is empty or 0 for pins, `number` is the tooth or pin from 0; any unit of length is
    accepted.

    Raises
    ------
    edge.InputError
        If a column or its unit is missing, or a cell is invalid; the sentence names the line.
    """
    lines = edge.csv_rows(path)
    header = next(lines, [])
    lengths = edge.unit_columns(header, dict.fromkeys(LENGTHS, "m"), str(path))
    names = [cell.strip() for cell in header]
    for name in ("body", "disc", "number"):
        if name not in names:
            raise edge.InputError(f'{path}: there is no column "{name}" in the header.')
    places = {name: names.index(name) for name in ("body", "disc", "number")}
    places.update({name: position for name, (position, _) in lengths.items()})
    rows: list[tuple[bool, int, int, float, float, float, int]] = []
    for line, row in enumerate(lines, start=2):
        if not row:
            continue
        cells = {name: row[position].strip() if position < len(row) else "" for name, position in places.items()}
        if cells["body"] not in ("gear", "pin"):
            raise edge.InputError(f"{path}: line {line}: body = {edge.shown(cells['body'])}: it must be gear or pin.")
        gear = cells["body"] == "gear"
        disc = _whole(cells["disc"] if gear else cells["disc"] or "0", "disc", line, path)
        number = _whole(cells["number"], "number", line, path)
        x, y, z = (edge.finite(cells[name], f"{path}: line {line}: {name}") * lengths[name][1] for name in LENGTHS)
        rows.append((gear, disc, number, x, y, z, line))
    if not rows:
        raise edge.InputError(f"{path}: the file has no points; write one line per point below the header.")
    columns = list(zip(*rows, strict=True))
    return MeasuredPoints(
        gear=np.array(columns[0], dtype=bool),
        disc=np.array(columns[1], dtype=np.int64),
        number=np.array(columns[2], dtype=np.int64),
        x=np.array(columns[3]),
        y=np.array(columns[4]),
        z=np.array(columns[5]),
        line=np.array(columns[6], dtype=np.int64),
        source=str(path),
    )


def _whole(cell: str, name: str, line: int, path: object) -> int:
    if not (cell.isascii() and cell.isdigit() and len(cell) < 10):
        raise edge.InputError(f"{path}: line {line}: {name} = {edge.shown(cell)}: it must be a whole number from 0.")
    return int(cell)


def closest_on_tooth(pair: Pair, points: Complex) -> tuple[Array, Array, Complex]:
    """Closest points of tooth 0's nominal flank.

    Parameters
    ----------
    pair
        The pair.
    points
        Points x + iy in the gear frame, rotated back to tooth 0, shape (points,), m.

    Returns
    -------
    alpha
        Profile parameter of the closest point, rad; limited to a twentieth of the tooth beyond its ends.
    deviation
        Distance from this point, m, > 0 outside the material; along the normal unless limited by the tooth's ends.
    normal
        Unit normal at this point, out of the material, x + iy.

    Notes
    -----
    Newton's method along the arc: with deviation d, the tangential distance changes by -(1 + d/ρ_c) per arc length.
    """
    span = 2.0 * np.pi / pair.gear_teeth
    starts = np.linspace(0.0, span, 97)
    x, y = flank_points(pair, starts)
    tree = spatial.cKDTree(np.column_stack([x, y]))
    alpha = starts[tree.query(np.column_stack([points.real, points.imag]))[1]]
    low, high = -0.05 * span, 1.05 * span
    for _ in range(20):
        x, y = flank_points(pair, alpha)
        normal = _complex(*flank_normals(pair, alpha))
        away = (points - _complex(x, y)) * normal.conj()
        # Near the centre of curvature 1 + d/ρ_c is unreliable, so the step is that of a straight flank.
        turn = 1.0 + away.real * flank_curvature(pair, alpha)
        step = away.imag / np.where(turn > 0.2, turn, 1.0) / flank_speed(pair, alpha)
        new = np.clip(alpha + np.clip(step, -0.05 * span, 0.05 * span), low, high)
        # An error of 1e-9 rad of the foot point changes the distance only by its square.
        done = np.abs(new - alpha).max(initial=0.0) < 1e-9
        alpha = new
        if done:
            break
    x, y = flank_points(pair, alpha)
    normal = _complex(*flank_normals(pair, alpha))
    away = points - _complex(x, y)
    return alpha, np.copysign(np.abs(away), (away * normal.conj()).real), normal


def _complex(x: Array, y: Array) -> Complex:
    return np.asarray(x + 1j * y)


def outlying(surface: Integers, along: Array, z: Array, deviation: Array) -> tuple[Booleans, Array]:
    """Outliers among the points of each tooth or pin, and the distances of all points from their neighbours.

    Parameters
    ----------
    surface
        Number of each point's tooth or pin, shape (points,).
    along, z
        Position along the profile and across the width, shape (points,), m.
    deviation
        Deviation of each point, shape (points,), m.

    Returns
    -------
    outlier, distance
        A point's distance is from the median of its 8 nearest neighbours; it is an outlier beyond 8 robust standard
        deviations of all such distances (1.4826 x their median size), and beyond 2 µm.
    """
    apart = 10.0 * (np.ptp(along) + np.ptp(z))
    places = np.column_stack([along, z, surface * apart])
    nearest = spatial.cKDTree(places).query(places, k=min(_NEIGHBOURS + 1, along.size))[1]
    # If a tooth has few points, neighbours on other teeth are ignored.
    same = surface[nearest] == surface[:, None]
    same[:, 0] = False
    distance = deviation - np.nanmedian(np.where(same, deviation[nearest], np.nan), axis=1)
    limit = max(_OUTLYING * 1.4826 * float(np.median(np.abs(distance))), _OUTLYING_FLOOR)
    return np.abs(distance) > limit, distance


def element_means(
    surface: Integers, row: Integers, column: Integers, values: Array, shape: tuple[int, int, int]
) -> Any:
    """Mean of the points in each element; elements without points are interpolated along rows, then columns.

    Parameters
    ----------
    surface, row, column
        Indices of each point's element: tooth or pin, along the profile, across the width; shape (points,).
    values
        Value of each point, shape (points,).
    shape
        Shape of the result.

    Returns
    -------
    means, empty
        Means, and whether an element is empty, shape `shape`. Empty elements are interpolated linearly along the
        profile within the same slice of the width, and constant beyond the last; a slice without points is interpolated
        between slices.
    """
    flat = np.ravel_multi_index((surface, row, column), shape)
    count = np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)
    means = np.bincount(flat, values, minlength=count.size).reshape(shape) / np.maximum(count, 1)
    empty = count == 0
    for one, missing in zip(means, empty, strict=True):
        full = np.flatnonzero(~missing.all(axis=0))
        for w in full:
            known = np.flatnonzero(~missing[:, w])
            one[:, w] = np.interp(np.arange(shape[1]), known, one[known, w])
        for p in range(shape[1]) if full.size < shape[2] else ():
            one[p] = np.interp(np.arange(shape[2]), full, one[p, full])
    return means, empty


def _length(value: float) -> str:
    unit, factor = ("m", 1.0) if value >= 1.0 else ("mm", 1e3) if value >= 1e-3 else ("um", 1e6)
    return f'"{value * factor:.4g} {unit}"'


def _check_units(points: MeasuredPoints, mask: Booleans, pair: Pair, body: str) -> list[str]:
    """Refuse coordinates whose extent can't be that of this pair; return a note for a narrow trace."""
    g = pair
    reach = g.pin_circle_radius + (0.0 if body == "gear" else g.pin_radius)
    for name in ("x", "y"):
        values = getattr(points, name)[mask]
        found = 0.5 * float(np.subtract(*np.percentile(values, [98, 2])))
        if not 0.5 < found / reach < 2.0:
            times = "a factor of 1000, so " if 1.5 < abs(np.log10(max(found, 1e-12) / reach)) < 4.5 else ""
            raise edge.InputError(
                f"{points.source}: {name} of the {body} extends {_length(found)} from its middle, that of the pair "
                f"{_length(reach)}: {times}check the unit of the column {name}."
            )
    z = points.z[mask]
    found, reach = float(np.abs(z).max()), 0.5 * g.face_width
    if found > 1.001 * reach:
        worst = points.line[mask][np.abs(z).argmax()]
        raise edge.InputError(
            f"{points.source}: line {worst}: z is {_length(found)} from mid-width, but the face ends at "
            f"{_length(reach)}: check the unit of the column z and its zero."
        )
    if np.ptp(z) >= g.face_width / 100.0:
        return []
    spans = f"z of the {body} spans {_length(float(np.ptp(z)))} of a face width of {_length(g.face_width)}"
    return [f"{points.source}: {spans}: one trace, unless the unit of the column z is wrong."]


def _check_counts(points: MeasuredPoints, mask: Booleans, what: str, count: int, fewest: int, where: str) -> None:
    number = points.number[mask]
    if (number >= count).any():
        first = np.flatnonzero(number >= count)[0]
        raise edge.InputError(
            f"{points.source}: line {points.line[mask][first]}: {what} {number[first]} does not exist; the pair's are "
            f"0 to {count - 1}."
        )
    found = np.bincount(number, minlength=count)
    if (found < fewest).any():
        few = int(np.flatnonzero(found < fewest)[0])
        raise edge.InputError(
            f"{points.source}: {what} {few}{where} has {found[few]} points; it needs at least {fewest}."
        )


def _fit(
    pair: Pair,
    points: Complex,
    tooth: Integers,
    turning: Integers,
    start: Array,
    loss: str,
    scale: float,
    steps: int = 100,
) -> tuple[Array, Array, Array]:
    """Fit a shift and rotations (of the groups `turning`, as arc length at R_p, all in µm) of points to the flank.

    Return the fitted vector (x, y, rotations), and profile parameter and deviation of each point.
    """
    back = np.exp(-2j * np.pi * tooth / pair.gear_teeth)
    radius = pair.pin_circle_radius

    def moved(v: Array) -> Complex:
        return np.asarray((points - _MICRON * (v[0] + 1j * v[1])) * np.exp(-1j * _MICRON * v[2:][turning] / radius))

    def residual(v: Array) -> Array:
        return closest_on_tooth(pair, moved(v) * back)[1] / _MICRON

    def slope(v: Array) -> csr_array:
        at = moved(v)
        normal = closest_on_tooth(pair, at * back)[2] * back.conj()
        columns = np.column_stack([np.zeros_like(turning), np.ones_like(turning), 2 + turning])
        entries = np.column_stack([-normal.real, -normal.imag, -(normal * at.conj()).imag / radius])
        return csr_array((entries.ravel(), columns.ravel(), 3 * np.arange(tooth.size + 1)), (tooth.size, v.size))

    fit = least_squares(
        residual, start, slope, loss=loss, f_scale=scale, xtol=1e-9, gtol=1e-9, ftol=1e-10, max_nfev=steps
    )
    alpha, deviation, _ = closest_on_tooth(pair, moved(fit.x) * back)
    return fit.x, alpha, deviation


def _rough_frame(pair: Pair, points: Complex, tooth: Integers) -> tuple[complex, float, float]:
    """Approximate shift (x + iy, m) and rotation (rad) of the gear frame, and the remaining misfit (m).

    The mean positions of the teeth's points determine the rotation only to a fraction of a tooth (they may be on one
    side of it), so eight starts over one pitch are fitted and the best is used.
    """
    teeth = pair.gear_teeth
    count = np.maximum(np.bincount(tooth, minlength=teeth), 1)
    middle = (np.bincount(tooth, points.real, teeth) + 1j * np.bincount(tooth, points.imag, teeth)) / count
    wanted = np.exp(2j * np.pi * (np.arange(teeth) + 0.5) / teeth)
    centre = complex(middle.mean())
    rotation = float(np.angle(np.vdot(wanted, middle - centre)))
    chosen = slice(None, None, max(1, tooth.size // _ROUGH_POINTS))
    best, frame = np.inf, (centre, rotation, np.inf)
    for start in rotation + 2.0 * np.pi / teeth * np.arange(-4, 4) / 8.0:
        near = (points[chosen] - centre) * np.exp(-1j * start)
        one = np.zeros_like(tooth[chosen])
        v, _, deviation = _fit(pair, near, tooth[chosen], one, np.zeros(3), "soft_l1", 20.0, steps=8)
        misfit = float(np.median(np.abs(deviation)))
        if misfit < best:
            shift = centre + _MICRON * (v[0] + 1j * v[1]) * np.exp(1j * start)
            best, frame = misfit, (complex(shift), float(start + _MICRON * v[2] / pair.pin_circle_radius), misfit)
    return frame


def _robust_scale(deviation: Array) -> float:
    """Scale of a robust loss, µm: 1.4826 x the median absolute deviation, at least 0.1."""
    return max(1.4826 * float(np.median(np.abs(deviation))) / _MICRON, 0.1)


def _measured_disc(pair: Pair, points: MeasuredPoints, mask: Booleans, disc: int, elements: Elements) -> Any:
    """Cumulative pitch, deviations, empty elements, alignment and outliers of one disc's gear."""
    g = pair
    tooth, z, body = points.number[mask], points.z[mask], f"gear, disc {disc}"
    at = _complex(points.x[mask], points.y[mask])
    shift, rotation, off = _rough_frame(pair, at, tooth)
    if off > 0.5 * LARGEST_ELEMENT:
        raise edge.InputError(
            f"{points.source}: the points of the {body} are {_length(off)} (median) from the nominal flank: check the "
            "pair, and that teeth are numbered counter-clockwise."
        )
    near = (at - shift) * np.exp(-1j * rotation)
    # Frame and rotations of all teeth are fitted together: in sequence, a shift would absorb pitch errors.
    v, alpha, deviation = _fit(pair, near, tooth, tooth, np.zeros(2 + g.gear_teeth), "soft_l1", 20.0)
    v, alpha, deviation = _fit(pair, near, tooth, tooth, v, "soft_l1", _robust_scale(deviation))
    length = flank_speed(pair, equal_arc_parameters(pair, 200)).mean() * 2.0 * np.pi / g.gear_teeth
    pitch = _MICRON * (v[2:] - np.median(v[2:]))
    if np.abs(pitch).max() > LARGEST_ELEMENT:
        far = int(np.abs(pitch).argmax())
        off = float(np.abs(pitch[far]))
        raise edge.InputError(
            f"{points.source}: tooth {far} of disc {disc} is {_length(off)} from its position: check its number."
        )
    outlier, distance = outlying(tooth, arc_parts(pair, alpha) * length, z, deviation)
    kept = ~outlier
    _check_counts(points, _sub(mask, kept), "tooth", g.gear_teeth, FEWEST_TOOTH_POINTS, f" of disc {disc}")
    v, alpha, deviation = _fit(pair, near[kept], tooth[kept], tooth[kept], v, "linear", 1.0)
    turn = v[2:].mean()
    row = np.minimum((arc_parts(pair, alpha) * elements.profile).astype(np.int64), elements.profile - 1)
    column = _slice(z[kept], g.face_width, elements.width)
    means, empty = element_means(tooth[kept], row, column, deviation, (g.gear_teeth, elements.profile, elements.width))
    frame = shift + _MICRON * (v[0] + 1j * v[1]) * np.exp(1j * rotation)
    alignment = Alignment(
        body=body,
        x=float(frame.real),
        y=float(frame.imag),
        rotation=_wrapped(rotation + _MICRON * turn / g.pin_circle_radius),
        points=int(tooth.size),
        outliers=int(outlier.sum()),
        rms=_rms(deviation),
        scatter=_rms(deviation - means[tooth[kept], row, column]),
    )
    left_out = _outliers(points, mask, outlier, distance, f"{body}, tooth")
    return (v[2:] - turn) * _MICRON, means, empty, alignment, left_out


def _sub(mask: Booleans, kept: Booleans) -> Booleans:
    """Mask of all points, from the mask of a body and a mask of its kept points."""
    result = mask.copy()
    result[mask] = kept
    return result


def _slice(z: Array, face_width: float, count: int) -> Integers:
    return np.clip(np.floor((z / face_width + 0.5) * count), 0, count - 1).astype(np.int64)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _wrapped(angle: float) -> float:
    return float(np.angle(np.exp(1j * angle)))


def _outliers(
    points: MeasuredPoints, mask: Booleans, outlier: Booleans, distance: Array, place: str
) -> tuple[Outlier, ...]:
    lines, numbers = points.line[mask][outlier], points.number[mask][outlier]
    return tuple(
        Outlier(int(line), f"{place} {number}", float(d))
        for line, number, d in zip(lines, numbers, distance[outlier], strict=True)
    )


def fitted_circle(points: Complex, robust: bool) -> tuple[complex, float]:
    """Centre (x + iy) and radius, m, of the circle with least-squares (or robust) distances to the points.

    The start is the algebraic fit |p|² = 2 Re(conj(c) p) + r² - |c|², which is linear.
    """
    middle = complex(points.mean())
    p = points - middle
    matrix = np.column_stack([2.0 * p.real, 2.0 * p.imag, np.ones(p.size) * np.abs(p).max() ** 2])
    x, y, rest = np.linalg.lstsq(matrix, np.abs(p) ** 2, rcond=None)[0]
    radius = np.sqrt(max(rest * np.abs(p).max() ** 2 + x * x + y * y, 0.0))

    def residual(v: Array) -> Array:
        return np.asarray((np.abs(p - _MICRON * (v[0] + 1j * v[1])) - _MICRON * v[2]) / _MICRON)

    def slope(v: Array) -> Array:
        away = p - _MICRON * (v[0] + 1j * v[1])
        towards = away / np.maximum(np.abs(away), 1e-12)
        return np.column_stack([-towards.real, -towards.imag, -np.ones(p.size)])

    fit = np.array([x, y, radius]) / _MICRON
    for scale in (20.0, 2.0) if robust else (1.0,):
        fit = least_squares(
            residual,
            fit,
            slope,
            loss="soft_l1" if robust else "linear",
            f_scale=scale,
            xtol=1e-10,
            gtol=1e-10,
            ftol=1e-12,
        ).x
    return middle + _MICRON * complex(fit[0], fit[1]), float(_MICRON * fit[2])


def _pin_circles(pins: int, number: Integers, at: Complex, *, robust: bool) -> tuple[Complex, Array]:
    """Centre and radius, m, of each pin, both of shape (pins,)."""
    circles = [fitted_circle(at[number == pin], robust) for pin in range(pins)]
    return np.array([centre for centre, _ in circles]), np.array([radius for _, radius in circles])


def _pin_outliers(pair: Pair, number: Integers, z: Array, at: Complex) -> tuple[Booleans, Array, Array]:
    """Outliers, distances from neighbours, m, and angles on the pin from the direction to the circle's centre, rad."""
    centre, radius = _pin_circles(pair.pins, number, at, robust=True)
    away = at - centre[number]
    inwards = np.angle(away * np.conj(centre.mean() - centre)[number])
    outlier, distance = outlying(number, inwards * pair.pin_radius, z, np.abs(away) - radius[number])
    return outlier, distance, inwards


def _check_spans(source: str, pins: int, number: Integers, inwards: Array) -> None:
    """Refuse pins whose points span an arc too short for their centre and radius."""
    for pin in range(pins):
        reach = float(np.ptp(inwards[number == pin]))
        if reach < 0.5 * np.pi:
            raise edge.InputError(
                f"{source}: the points of pin {pin} span {np.degrees(reach):.0f}°; its centre and radius "
                "need at least 90°."
            )


def _aligned_pins(pair: Pair, centre: Complex) -> tuple[complex, float, Complex]:
    """Shift, m, and rotation, rad, of the pin circle, and the pins' errors in it, radial + i tangential, m."""
    direction = np.exp(2j * np.pi * np.arange(pair.pins) / pair.pins)
    nominal = pair.pin_circle_radius * direction
    shift = complex(centre.mean())
    rotation = float(np.angle(np.vdot(nominal, centre - shift)))
    return shift, rotation, ((centre - shift) * np.exp(-1j * rotation) - nominal) * direction.conj()


def _check_pins(source: str, error: Complex, thicker: Array) -> None:
    """Refuse deviations, m, that are larger than those of any pin of this pair."""
    if np.abs(error).max() > LARGEST_ELEMENT or np.abs(thicker).max() > LARGEST_ELEMENT:
        raise edge.InputError(
            f"{source}: aligned pins deviate by {_length(float(np.abs(error).max()))} in position and "
            f"{_length(float(np.abs(thicker).max()))} in radius: check the pair, and "
            "that pins are numbered counter-clockwise."
        )


def _measured_pins(pair: Pair, points: MeasuredPoints, mask: Booleans, elements: Elements) -> Any:
    """Changes of the surface, empty elements, alignment and outliers of the pins."""
    number, z = points.number[mask], points.z[mask]
    at = _complex(points.x[mask], points.y[mask])
    outlier, distance, inwards = _pin_outliers(pair, number, z, at)
    kept = ~outlier
    facing = _sub(mask, kept & (np.abs(inwards) <= 0.5 * np.pi))
    _check_counts(points, facing, "pin", pair.pins, FEWEST_PIN_POINTS, " on the half that faces the circle's centre")
    _check_spans(points.source, pair.pins, number[kept], inwards[kept])
    centre, radius = _pin_circles(pair.pins, number[kept], at[kept], robust=False)
    direction = np.exp(2j * np.pi * np.arange(pair.pins) / pair.pins)
    shift, rotation, error = _aligned_pins(pair, centre)
    _check_pins(points.source, error, radius - pair.pin_radius)
    away = (at - centre[number]) * np.exp(-1j * rotation)
    deviation = np.abs(away) - radius[number]
    # Counter-clockwise about the pin's axis from the direction to the circle's centre.
    part = np.angle(-away * direction.conj()[number]) / np.pi + 0.5
    inner = kept & (part >= 0.0) & (part < 1.0)
    row = (part[inner] * elements.angle).astype(np.int64)
    column = _slice(z[inner], pair.face_width, elements.width)
    shape = (pair.pins, elements.angle, elements.width)
    means, empty = element_means(number[inner], row, column, deviation[inner], shape)
    thicker = radius - pair.pin_radius
    changes = {
        "pin_circle_radius": float(error.real.mean()),
        "pin_radial": error.real - error.real.mean(),
        "pin_tangential": error.imag,
        "pin_radius": float(thicker.mean()),
        "pin_radius_deviation": thicker - thicker.mean(),
        "pin_deviation": means,
    }
    alignment = Alignment(
        body="pins",
        x=shift.real,
        y=shift.imag,
        rotation=rotation,
        points=int(number.size),
        outliers=int(outlier.sum()),
        rms=_rms(deviation[kept]),
        scatter=_rms(deviation[inner] - means[number[inner], row, column]),
    )
    return changes, empty, alignment, _outliers(points, mask, outlier, distance, "pin")


def measured_surface(
    pair: Pair, points: MeasuredPoints, elements: Elements = DEFAULT_ELEMENTS
) -> tuple[ErrorSurface, MeasurementReport]:
    """Fit an error surface of origin "measured" to points, and report on the fit.

    Parameters
    ----------
    pair
        The nominal pair; deviations are relative to its modified flank.
    points
        Points of every tooth of every disc, or every pin, or both; a body without points stays nominal, with a note.
    elements
        Numbers of elements, coarse enough that most elements contain points.

    Raises
    ------
    edge.InputError
        If the points can't be this pair's (unit, numbering), a tooth or pin has too few, or a deviation exceeds half a
        millimetre.
    """
    g = pair
    notes: list[str] = []
    alignments: list[Alignment] = []
    left_out: list[Outlier] = []
    changes: dict[str, Any] = {}
    gear_empty: Booleans | None = None
    pin_empty: Booleans | None = None
    if points.gear.any():
        wrong = points.gear & (points.disc >= g.discs)
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise edge.InputError(
                f"{points.source}: line {points.line[at]}: disc {points.disc[at]} does not exist; the pair has "
                f"{g.discs}, from 0."
            )
        discs = [points.gear & (points.disc == disc) for disc in range(g.discs)]
        for disc, mask in enumerate(discs):
            _check_counts(points, mask, "tooth", g.gear_teeth, FEWEST_TOOTH_POINTS, f" of disc {disc}")
        notes += _check_units(points, points.gear, pair, "gear")
        found = [_measured_disc(pair, points, mask, disc, elements) for disc, mask in enumerate(discs)]
        changes["tooth_cumulative_pitch"] = np.array([f[0] for f in found])
        changes["gear_deviation"] = np.array([f[1] for f in found])
        gear_empty = np.array([f[2] for f in found])
        alignments += [f[3] for f in found]
        left_out += [o for f in found for o in f[4]]
    else:
        notes.append(f"{points.source}: there are no points of the gear; it is assumed nominal.")
    if not points.gear.all():
        mask = ~points.gear
        _check_counts(points, mask, "pin", g.pins, FEWEST_PIN_POINTS, "")
        notes += _check_units(points, mask, pair, "pins")
        of_pins, pin_empty, alignment, outliers = _measured_pins(pair, points, mask, elements)
        changes.update(of_pins)
        alignments.append(alignment)
        left_out += outliers
    else:
        notes.append(f"{points.source}: there are no points of pins; they are assumed nominal.")
    notes += [_empty_note(points.source, "flanks", "tooth", "profile", gear_empty)] if gear_empty is not None else []
    notes += [_empty_note(points.source, "pins", "pin", "angle", pin_empty)] if pin_empty is not None else []
    attributes = {"points": Path(points.source).name, "outlier_lines": " ".join(str(o.line) for o in left_out)}
    try:
        surface = ErrorSurface(pair, origin="measured", attributes=attributes, **changes)
    except edge.InputError as problem:
        raise edge.InputError(f"{points.source}: {problem}") from None
    report = MeasurementReport(tuple(alignments), tuple(left_out), gear_empty, pin_empty, tuple(n for n in notes if n))
    return surface, report


def _empty_note(source: str, what: str, number: str, along: str, empty: Booleans) -> str:
    """Return a note on the elements without points; empty if there are none."""
    if not empty.any():
        return ""
    *disc, one, row, column = (int(i) for i in np.argwhere(empty)[0])
    place = f"{f'disc {disc[0]}, ' if disc else ''}{number} {one}, {along} {row}, width {column}"
    return (
        f"{source}: {int(empty.sum())} of {empty.size} elements of the {what} have no points and were interpolated, "
        f"first {place}."
    )
