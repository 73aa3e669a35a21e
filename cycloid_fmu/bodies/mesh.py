"""Meshes of triangles in a plane region with holes, graded from the boundary inwards.

The boundary is divided until no edge's diametral circle contains another boundary node. A point set with this property,
without other points in these circles, has all boundary edges in its Delaunay triangulation, so that the triangles
inside the region are those whose centroids are inside it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]
Points = NDArray[np.complex128]
Indices = NDArray[np.int64]

GROWTH = 0.45  # of the size of triangles per distance from the boundary
_ROUNDS = 4  # of smoothing: more do not change influence matrices by 1e-4
_LEAST_DISTANCE = 0.6  # of inner nodes from a boundary edge's middle, in edge lengths; 0.5 is the diametral circle
_MOST_DIVISIONS = 30
_NEIGHBOURS = 9  # edges whose lengths an edge is compared with
_MOST_TURN = np.radians(7.5)  # of the boundary's direction along an edge
_CIRCLE = 720  # points of a circle at least
_MOST_NODES = 400_000


@dataclass(frozen=True, eq=False)
class Contour:
    """A closed curve of a region's boundary, counter-clockwise, in pieces between its corners.

    Attributes
    ----------
    pieces
        Points x + iy of each piece, m: dense, with both ends, which are those of the neighbouring pieces.
    size
        Largest length of a mesh's edges on it, m.
    name
        What it is, for messages: "the flank", "windows[0]".
    """

    pieces: tuple[Points, ...]
    size: float
    name: str = ""

    @property
    def points(self) -> Points:
        """All points, each once."""
        return np.concatenate([piece[:-1] for piece in self.pieces])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a region.

    Attributes
    ----------
    nodes
        Corners, x + iy, shape (nodes,), m.
    triangles
        Nodes of each triangle, counter-clockwise, shape (triangles, 3).
    chains
        Boundary nodes of each contour in its order, the region's outline first.
    """

    nodes: Points
    triangles: Indices
    chains: tuple[Indices, ...]


def circle(centre: complex, radius: float, edges: int, name: str = "") -> Contour:
    """Contour of a circle in a whole number of edges of equal length, the first node at angle 0."""
    dense = edges * max(1, -(-_CIRCLE // edges))
    points = centre + radius * np.exp(2j * np.pi * np.arange(dense + 1) / dense)
    points[-1] = points[0]
    return Contour((points,), float(np.abs(np.diff(points)).sum()) / edges, name)


def inside(points: Points, polygon: Points) -> NDArray[np.bool_]:
    """Whether points are inside a closed polygon, by the number of sides left of them."""
    within = np.zeros(points.size, dtype=bool)
    x, y = points.real, points.imag
    order = np.argsort(y)
    for a, b in zip(polygon, np.roll(polygon, -1), strict=True):
        low, high = min(a.imag, b.imag), max(a.imag, b.imag)
        rows = order[np.searchsorted(y[order], low, "right") : np.searchsorted(y[order], high, "right")]
        if rows.size:
            within[rows] ^= x[rows] < a.real + (y[rows] - a.imag) * ((b.real - a.real) / (b.imag - a.imag))
    return within


def meshed(outline: Contour, holes: Sequence[Contour], largest: float, growth: float = GROWTH) -> Mesh:
    """Return the mesh of the region inside an outline and outside its holes.

    Parameters
    ----------
    outline, holes
        The boundary; contours that do not cut each other.
    largest
        Largest size of the triangles, m.
    growth
        Growth of their size with the distance from the boundary.

    Raises
    ------
    edge.InputError
        If contours touch or are so close that the mesh would become too large.
    """
    chains = _divided([outline, *holes], largest)
    boundary = np.concatenate(chains)
    following = np.concatenate([np.roll(chain, -1) for chain in chains])
    lengths = np.abs(following - boundary)
    size = _Size(0.5 * (boundary + following), lengths, largest, growth)
    inner = _lattice(boundary, size)
    inner = inner[_within(inner, chains)]
    nodes, triangles = _triangulated(boundary, size.clear(inner), chains)
    for _ in range(_ROUNDS):
        moved = _smoothed(nodes, triangles, boundary.size)
        nodes, triangles = _triangulated(boundary, size.clear(moved[boundary.size :]), chains)
    ends = np.cumsum([0, *(chain.size for chain in chains)])
    mesh = Mesh(nodes, triangles, tuple(np.arange(a, b) for a, b in itertools.pairwise(ends)))
    _check_boundary(mesh, [outline, *holes])
    return mesh


def _check_boundary(mesh: Mesh, contours: Sequence[Contour]) -> None:
    """Refuse a mesh whose boundary is not that of its contours: of one with slivers that vanish in the rounding."""
    sides = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    edges, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    wanted = np.concatenate([np.column_stack([chain, np.roll(chain, -1)]) for chain in mesh.chains])
    if not np.array_equal(edges[times == 1], np.unique(np.sort(wanted, axis=1), axis=0)):
        raise edge.InputError(
            f"the region can't be meshed: a contour of it ({_names(contours)}) is too sharp or too flat."
        )


def _names(contours: Sequence[Contour]) -> str:
    return edge.listed(dict.fromkeys(contour.name for contour in contours if contour.name))


class _Size:
    """Size of triangles near each point: that of the nearest edge, growing with the distance from it."""

    def __init__(self, middles: Points, lengths: Array, largest: float, growth: float) -> None:
        self._tree, self._lengths = scipy.spatial.KDTree(_columns(middles)), lengths
        self._largest, self._growth = largest, growth

    def at(self, points: Points) -> Array:
        distance, edges = self._tree.query(_columns(points))
        return np.asarray(np.minimum(self._lengths[edges] + self._growth * distance, self._largest))

    def clear(self, points: Points) -> Points:
        """Points that are in no edge's diametral circle and not very near to one."""
        distance, edges = self._tree.query(_columns(points), k=4)
        return np.asarray(points[(distance > _LEAST_DISTANCE * self._lengths[edges]).all(axis=1)])


def _columns(points: Points) -> Array:
    return np.column_stack([points.real, points.imag])


def _within(points: Points, chains: Sequence[Points]) -> NDArray[np.bool_]:
    within = inside(points, chains[0])
    for chain in chains[1:]:
        within &= ~inside(points, chain)
    return within


def _edges(piece: Points, size: float) -> int:
    """Number of edges of equal length on a piece of a contour, each within its size and `_MOST_TURN`."""
    sides = np.diff(piece)
    turn = np.abs(np.angle(sides[1:] / sides[:-1])).sum()
    return max(1, int(np.ceil(max(np.abs(sides).sum() / size, turn / _MOST_TURN) * (1.0 - 1e-9))))


def _divided(contours: Sequence[Contour], largest: float) -> list[Points]:
    """Nodes on each contour, so dense that no edge's diametral circle contains a node that is not its end.

    An edge is not much longer than those near it either.
    """
    curves = [
        (piece, np.concatenate([[0.0], np.cumsum(np.abs(np.diff(piece)))])) for c in contours for piece in c.pieces
    ]
    marks = [
        np.linspace(0.0, arc[-1], _edges(piece, min(c.size, largest)) + 1)
        for c, (piece, arc) in zip((c for c in contours for _ in c.pieces), curves, strict=True)
    ]
    for _ in range(_MOST_DIVISIONS):
        points = [np.interp(mark, arc, piece) for mark, (piece, arc) in zip(marks, curves, strict=True)]
        if sum(part.size for part in points) > _MOST_NODES:
            break
        split = _too_long(points)
        if not split.any():
            rows, chains = iter(points), []
            for contour in contours:
                chains.append(np.concatenate([next(rows)[:-1] for _ in contour.pieces]))
            return chains
        ends = np.cumsum([part.size - 1 for part in points])[:-1]
        for number, long in enumerate(np.split(split, ends)):
            marks[number] = np.sort(np.concatenate([marks[number], _halves(marks[number])[long]]))
    raise edge.InputError(
        f"the contours ({_names(contours)}) touch or nearly touch each other, so there is no mesh between them."
    )


def _too_long(pieces: Sequence[Points]) -> NDArray[np.bool_]:
    """Whether to divide each edge of all pieces: for a node in its diametral circle, or much shorter edges nearby."""
    middles = np.concatenate([0.5 * (points[1:] + points[:-1]) for points in pieces])
    lengths = np.concatenate([np.abs(np.diff(points)) for points in pieces])
    nearest, _ = scipy.spatial.KDTree(_columns(np.concatenate([points[:-1] for points in pieces]))).query(
        _columns(middles)
    )
    distance, near = scipy.spatial.KDTree(_columns(middles)).query(_columns(middles), k=min(_NEIGHBOURS, middles.size))
    graded = (2.0 * lengths[near] + distance).min(axis=1)
    return np.asarray((nearest < 0.4995 * lengths) | (lengths > graded))


def _halves(mark: Array) -> Array:
    """Places that divide edges; those at a corner at a power of two from it, so that both its sides become alike."""
    halves = 0.5 * (mark[1:] + mark[:-1])
    if mark.size > 2:
        halves[0] = 2.0 ** np.round(np.log2(halves[0]))
        halves[-1] = mark[-1] - 2.0 ** np.round(np.log2(mark[-1] - halves[-1]))
    return np.asarray(halves)


def _lattice(boundary: Points, size: _Size) -> Points:
    """Middles of the cells of a quadtree, each as large as triangles there; every other row is shifted by half."""
    low = complex(boundary.real.min(), boundary.imag.min())
    side = max(np.ptp(boundary.real), np.ptp(boundary.imag))
    cells, placed, total = np.array([low + 0.5 * side * (1 + 1j)]), [], 0
    while cells.size:
        small = side <= 1.2 * size.at(cells)
        row = np.round((cells.imag - low.imag) / side - 0.5)
        placed.append((cells + side * 0.25 * np.where(row % 2, 1.0, -1.0))[small])
        total += int(small.sum())
        side *= 0.5
        cells = (cells[~small][:, None] + 0.5 * side * np.array([1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j])).ravel()
        if total + cells.size > 4 * _MOST_NODES:
            raise edge.InputError(
                "the body's smallest details are too small for its size: its mesh would be too large."
            )
    return np.concatenate(placed)


def _triangulated(boundary: Points, inner: Points, chains: Sequence[Points]) -> tuple[Points, Indices]:
    nodes = np.concatenate([boundary, inner])
    try:
        triangles = scipy.spatial.Delaunay(_columns(nodes)).simplices.astype(np.int64)
    except scipy.spatial.QhullError as problem:
        raise edge.InputError(f"the body can't be meshed ({edge.first_line(problem)}).") from None
    triangles = triangles[_within(nodes[triangles].mean(axis=1), chains)]
    a, b, c = nodes[triangles].T
    twice = (np.conj(b - a) * (c - a)).imag
    triangles = triangles[np.abs(twice) > 1e-10 * np.abs(b - a) ** 2]
    a, b, c = nodes[triangles].T
    triangles[(np.conj(b - a) * (c - a)).imag < 0.0] = triangles[(np.conj(b - a) * (c - a)).imag < 0.0][:, ::-1]
    return nodes, triangles


def _smoothed(nodes: Points, triangles: Indices, fixed: int) -> Points:
    """Nodes moved to the area-weighted mean of the centroids of their triangles; the first `fixed` stay."""
    a, b, c = nodes[triangles].T
    area = np.abs((np.conj(b - a) * (c - a)).imag)
    weighted = area * (a + b + c) / 3.0
    total, moved = np.zeros(nodes.size), np.zeros(nodes.size, dtype=complex)
    for corner in range(3):
        total += np.bincount(triangles[:, corner], area, nodes.size)
        moved += np.bincount(triangles[:, corner], weighted.real, nodes.size)
        moved += 1j * np.bincount(triangles[:, corner], weighted.imag, nodes.size)
    placed = np.where(total > 0.0, moved / np.where(total > 0.0, total, 1.0), nodes)
    placed[:fixed] = nodes[:fixed]
    return placed
