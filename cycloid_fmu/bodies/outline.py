"""Contours of a disc: the true nominal flank, bores, holes of output rollers and windows, and whether they can be."""

from __future__ import annotations

import functools
import itertools
import math
from pathlib import Path

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies.mesh import Array, Contour, Points, circle
from cycloid_fmu.geometry.bodies import DiscBody, Window
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import flank_normals, flank_points

SECTORS = 48  # of a bore
_PER_TOOTH = 400  # points of the flank's contour
_ARC = math.radians(1.0)  # between points of a window's arcs
_STEP = 5e-4  # between points of holes, for their distances, over the pin circle's radius; half of `_LEAST_BRIDGE`
_LARGEST = 5.0  # coordinate of a window's outline, m
_LEAST_BRIDGE = 1e-3  # of the pin circle's radius: material between two holes


@functools.lru_cache(maxsize=64)  # each crank angle needs it
def true_flank(pair: Pair) -> Pair:
    """Return the pair without modification, whose flank the elastic disc has."""
    return pair.replace(isometric=0.0, offset=0.0)


def clocking(pair: Pair, disc: int) -> float:
    """Angle of a disc's tooth 0's root from its +x, rad: −φ_j/z_c, as its teeth are turned against its holes."""
    return -2.0 * math.pi * disc / pair.discs / pair.gear_teeth


def flank_at(pair: Pair, disc: int, alpha: Array) -> tuple[Points, Points]:
    """Points of a disc's flank without modification, m, and unit normals out of the material, in the disc's axes.

    Parameters
    ----------
    pair, disc
        The pair and the number of its disc.
    alpha
        Profile parameter, rad, from tooth 0's root.
    """
    true, turned = true_flank(pair), np.exp(1j * clocking(pair, disc))
    x, y = flank_points(true, alpha)
    along_x, along_y = flank_normals(true, alpha)
    return turned * (x + 1j * y), turned * (along_x + 1j * along_y)


def places(pair: Pair) -> Points:
    """Middles of the holes for cranks or output rollers in a disc, m, in its axes."""
    supports = pair.supports
    assert supports is not None
    angle = supports.first_angle + 2.0 * math.pi * np.arange(supports.count) / supports.count
    return np.asarray(supports.circle_radius * np.exp(1j * angle))


def flank_contour(pair: Pair, disc: int, size: float) -> Contour:
    """The contour of a disc's teeth, one piece for each."""
    teeth = pair.gear_teeth
    points, _ = flank_at(pair, disc, np.linspace(0.0, 2.0 * math.pi, teeth * _PER_TOOTH + 1))
    points[-1] = points[0]
    pieces = tuple(points[_PER_TOOTH * j : _PER_TOOTH * (j + 1) + 1] for j in range(teeth))
    return Contour(pieces, size, "the flank")


def bores(pair: Pair, body: DiscBody, edges: int) -> list[Contour]:
    """Bores of the turning arms: of each crank, or in the middle the eccentric's."""
    assert pair.supports is not None
    assert body.bore_radius is not None
    if pair.supports.kind == "output_rollers":
        return [circle(0.0, body.bore_radius, edges, "bore_radius")]
    return [circle(complex(p), body.bore_radius, edges, "bore_radius") for p in places(pair)]


def other_holes(pair: Pair, body: DiscBody, edges: int) -> list[Contour]:
    """Holes of output rollers, or the one in the middle beside cranks."""
    assert pair.supports is not None
    if pair.supports.kind == "output_rollers":
        assert body.roller_hole_radius is not None
        return [circle(complex(p), body.roller_hole_radius, edges, "roller_hole_radius") for p in places(pair)]
    return [] if body.centre_radius is None else [circle(0.0, body.centre_radius, edges, "centre_radius")]


def windows(body: DiscBody) -> list[Contour]:
    """All windows of a disc."""
    contours = []
    for number, window in enumerate(body.windows):
        pieces = _window(window)
        for k in range(window.count):
            turned = np.exp(1j * (window.first_angle + 2.0 * math.pi * k / window.count))
            contours.append(Contour(tuple(turned * piece for piece in pieces), math.inf, f"windows[{number}]"))
    return contours


def _window(window: Window) -> list[Points]:
    if window.shape == "round":
        assert window.circle_radius is not None
        assert window.radius is not None
        return list(circle(complex(window.circle_radius), window.radius, 1).pieces)
    if window.shape == "fan":
        return _fan(window)
    if window.dxf is not None:
        return _outline_of_dxf(window.dxf)
    assert window.x is not None
    assert window.y is not None
    return _closed(np.array(window.x) + 1j * np.array(window.y))


def _closed(corners: Points) -> list[Points]:
    """Straight sides between corners, counter-clockwise."""
    if (np.conj(corners) * np.roll(corners, -1)).imag.sum() < 0.0:
        corners = corners[::-1]
    return [np.linspace(a, b, 2) for a, b in zip(corners, np.roll(corners, -1), strict=True) if a != b]


def _arc(centre: complex, radius: float, start: float, end: float) -> Points:
    angle = np.linspace(start, end, 2 + int(abs(end - start) / _ARC))
    return np.asarray(centre + radius * np.exp(1j * angle))


def _fan(window: Window) -> list[Points]:
    """Arc, corner, side, corner and so on of a fan about +x, counter-clockwise from its outer arc."""
    inner, outer, half, corner = (
        window.inner_radius,
        window.outer_radius,
        window.half_angle,
        window.corner_radius or 0.0,
    )
    assert inner is not None
    assert outer is not None
    assert half is not None
    quarter = 0.5 * math.pi
    out, within = math.asin(corner / (outer - corner)), math.asin(corner / (inner + corner))
    upper = [_arc(0.0, outer, 0.0, half - out)]
    if corner > 0.0:
        upper.append(_arc((outer - corner) * np.exp(1j * (half - out)), corner, half - out, half + quarter))
    side = np.sqrt([(outer - corner) ** 2 - corner**2, (inner + corner) ** 2 - corner**2])
    upper.append(side * np.exp(1j * half))
    if corner > 0.0:
        centre = (inner + corner) * np.exp(1j * (half - within))
        upper.append(_arc(centre, corner, half + quarter, half - within + math.pi))
    upper.append(_arc(0.0, inner, half - within, 0.0))
    for before, after in itertools.pairwise(upper):
        after[0] = before[-1]
    upper[0][0], upper[-1][-1] = outer, inner
    return [*upper, *(np.conj(piece[::-1]) for piece in upper[::-1])]


def _outline_of_dxf(path: str) -> list[Points]:
    """Pieces of the one closed outline in a DXF file, m, counter-clockwise."""
    with edge.needs_extra("bodies"):
        import ezdxf  # noqa: F401
    source = edge.existing(Path(path))
    with edge.parsed_by_others(source, "this is not a DXF file, or it is damaged"):
        chains = edge.call_limited(source, curves_of_dxf, str(source), needs="ezdxf")
    joined = _joined([chain for chain in chains if chain.size > 1])
    if joined is None:
        raise edge.InputError(f"{source}: it must have one closed outline of lines, arcs and curves, and nothing else.")
    return _closed(joined)


def curves_of_dxf(path: str) -> list[Points]:
    """Return points of each curve in a DXF file, m; to be called by `edge.call_limited`."""
    import ezdxf
    from ezdxf import path as paths
    from ezdxf import units

    document = ezdxf.readfile(path)
    scale = units.conversion_factor(document.units, units.M) if document.units else 1e-3
    entities = document.modelspace().query("LINE ARC CIRCLE ELLIPSE SPLINE POLYLINE LWPOLYLINE")
    curves = [[(v.x, v.y) for v in paths.make_path(entity).flattening(1e-3, 16)] for entity in entities]
    points = [scale * np.array(curve).reshape(-1, 2) @ np.array([1.0, 1j]) for curve in curves]
    if any(not np.isfinite(curve).all() or (np.abs(curve) > _LARGEST).any() for curve in points):
        raise edge.InputError(f"{path}: its outline must be within {_LARGEST:g} m of the origin.")
    return points


def _joined(chains: list[Points]) -> Points | None:
    """Corners of the one closed curve that chains form end to end; None if they do not."""
    if not chains:
        return None
    curve = chains.pop(0)
    near = 1e-6 * max(np.ptp(curve.real), np.ptp(curve.imag)) + 1e-9
    while chains:
        for number, chain in enumerate(chains):
            if abs(chain[-1] - curve[-1]) < near:
                chain = chain[::-1]
            if abs(chain[0] - curve[-1]) < near:
                curve = np.concatenate([curve, chain[1:]])
                del chains[number]
                break
        else:
            return None
    return curve[:-1] if curve.size > 3 and abs(curve[-1] - curve[0]) < near else None


def contradictions(pair: Pair, body: DiscBody) -> list[str]:
    """Return why holes of a disc can't be: those that cut the root circle or each other."""
    holes = [*bores(pair, body, 96), *other_holes(pair, body, 96), *windows(body)]
    root = pair.pin_circle_radius - pair.pin_radius - pair.eccentricity
    least = _LEAST_BRIDGE * pair.pin_circle_radius
    reasons = []
    dense = [dense_points(hole, _STEP * pair.pin_circle_radius) for hole in holes]
    centres = [points.mean() for points in dense]
    reaches = [np.abs(points - centre).max() for points, centre in zip(dense, centres, strict=True)]
    for hole, points in zip(holes, dense, strict=True):
        if (furthest := float(np.abs(points).max())) > root - least:
            reasons.append(
                f"{hole.name} reaches to {furthest * 1e3:.6g} mm from the disc's middle; the root circle of its teeth "
                f"has a radius of {root * 1e3:.6g} mm"
            )
    if reasons:
        return list(dict.fromkeys(reasons))
    dense = [dense_points(hole, _STEP * pair.pin_circle_radius) for hole in holes]
    centres = [points.mean() for points in dense]
    reaches = [np.abs(points - centre).max() for points, centre in zip(dense, centres, strict=True)]
    for first in range(len(holes)):
        for second in range(first + 1, len(holes)):
            a, b = dense[first], dense[second]
            if abs(centres[first] - centres[second]) > reaches[first] + reaches[second] + least:
                continue
            if _apart(a, b) <= least or encloses(b, a[0]) or encloses(a, b[0]):
                names = sorted({holes[first].name, holes[second].name})
                reasons.append(f"holes cut each other, or almost: {' and '.join(names)}")
    return list(dict.fromkeys(reasons))


def encloses(curve: Points, point: complex) -> bool:
    """Return whether a closed curve winds around a point."""
    away = curve - point
    return bool(abs(np.angle(np.roll(away, -1) / away).sum()) > math.pi)


def dense_points(hole: Contour, step: float) -> Points:
    """Return points of a contour at most about a step apart, m."""
    parts = []
    for piece in hole.pieces:
        arc = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(piece)))])
        count = max(2, int(arc[-1] / step))
        parts.append(np.interp(np.linspace(0.0, arc[-1], count, endpoint=False), arc, piece))
    return np.concatenate(parts)


def _apart(a: Points, b: Points) -> float:
    """Smallest distance of the points of two curves, m."""
    from scipy.spatial import KDTree

    columns = (np.column_stack([points.real, points.imag]) for points in (a, b))
    return float(KDTree(next(columns)).query(next(columns))[0].min())
