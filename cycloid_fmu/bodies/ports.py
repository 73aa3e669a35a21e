"""Ports of a body: unit loads spread over a patch or around a bore, and its influence matrix between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from cycloid_fmu.bodies.mesh import Array, Indices, Points

if TYPE_CHECKING:
    from cycloid_fmu.bodies.elastic import PlaneBody

KINDS = ("flank", "bore", "sector", "roller_hole", "pin", "plane", "seat")
_GAUSS, _WEIGHT = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True, eq=False)
class PortMatrix:
    """Influence matrix of a body: work-conjugate displacements of its ports under their unit loads.

    Attributes
    ----------
    kind
        Kind of each port, one of `KINDS`, shape (ports,).
    index
        Its tooth, crank, pin or disc, shape (ports,).
    place
        Its place x + iy in the body's axes at crank angle 0, shape (ports,), m.
    direction
        Its unit direction, of the force on the body, shape (ports,).
    compliance
        Displacement of each port under each, symmetric, shape (ports, ports), m/N.
    gauge
        "free": loads are balanced by supports of any kind; "held": the body is held.
    patch_half_width
        Half width w of the patches of flank or seats, m; 0 if the body has none.
    """

    kind: NDArray[np.str_]
    index: Indices
    place: Points
    direction: Points
    compliance: Array
    gauge: Literal["free", "held"]
    patch_half_width: float = 0.0

    def of(self, kind: str) -> Indices:
        """Numbers of the ports of a kind, in their order."""
        return np.flatnonzero(self.kind == kind)


def patch(body: PlaneBody, contour: int, middles: Points, tangents: Points, half_width: float) -> sp.csc_matrix:
    """Integrals of shape functions with a semi-elliptic density on a body's boundary, shape (nodes, patches).

    The density is 2/(πw) sqrt(1 - (s/w)²) over s, the distance from the patch's middle along its tangent, so that the
    integrals of a patch have the sum 1.

    Parameters
    ----------
    body, contour
        The body and the number of its contour.
    middles, tangents
        Middle of each patch on the contour, m, and unit vector along the contour there.
    half_width
        Half width w, m.
    """
    edges = body.edges_of(contour)
    start, end = body.nodes[edges[:, 0]], body.nodes[edges[:, 2]]
    rows, columns, values = [], [], []
    for number, (middle, tangent) in enumerate(zip(middles, tangents, strict=True)):
        s0, s1 = (((p - middle) * np.conj(tangent)).real / half_width for p in (start, end))
        near = np.minimum(np.abs(start - middle), np.abs(end - middle)) < 2.0 * half_width + np.abs(end - start)
        low, high = np.clip(np.minimum(s0, s1), -1.0, 1.0), np.clip(np.maximum(s0, s1), -1.0, 1.0)
        for e in np.flatnonzero(near & (high > low) & (s1 > s0)):
            a, b = np.arcsin(low[e]), np.arcsin(high[e])
            angle = 0.5 * (b - a) * _GAUSS + 0.5 * (a + b)
            weight = (b - a) / np.pi * _WEIGHT * np.cos(angle) ** 2
            rows.append(edges[e])
            values.append(_shapes((np.sin(angle) - s0[e]) / (s1[e] - s0[e])) @ weight)
            columns.append(np.full(3, number))
    data = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csc_matrix(sp.coo_matrix(data, shape=(body.nodes.size, middles.size)))


def _shapes(t: Array) -> Array:
    """Quadratic shape functions of an edge's start, middle and end at the share t of its length."""
    return np.array([(1.0 - t) * (1.0 - 2.0 * t), 4.0 * t * (1.0 - t), t * (2.0 * t - 1.0)])


def around(body: PlaneBody, contour: int, centre: complex, sectors: int) -> sp.csc_matrix:
    """Nodal forces of pressures around a bore, shape (unknowns, 2 + sectors).

    The first two are tractions along the outward direction ψ, proportional to cos ψ and sin ψ, with the resultant 1
    along x and y. The others are pressures with the integral 1, each a hat over two sectors about ψ = 2πs/`sectors`.

    Parameters
    ----------
    body, contour
        The body and the number of the bore's contour.
    centre
        The bore's axis, m.
    sectors
        Number of sectors, or 0.
    """
    edges = body.edges_of(contour)
    t, length = 0.5 + 0.5 * _GAUSS, np.abs(body.nodes[edges[:, 2]] - body.nodes[edges[:, 0]])
    shapes = _shapes(t)
    at = body.nodes[edges[:, 0]][:, None] * (1.0 - t) + body.nodes[edges[:, 2]][:, None] * t
    angle = np.angle(at - centre)
    radius = float(np.abs(body.nodes[edges[:, 0]] - centre).mean())
    density = [np.cos(angle) / (np.pi * radius), np.sin(angle) / (np.pi * radius)]
    pitch = 2.0 * np.pi / max(sectors, 1)
    for s in range(sectors):
        away = np.abs((angle - pitch * s + np.pi) % (2.0 * np.pi) - np.pi)
        density.append(np.maximum(1.0 - away / pitch, 0.0) / (pitch * radius))
    columns = []
    for values in density:
        parts = [
            np.einsum("eg,ng,g,e->en", values * along, shapes, 0.5 * _WEIGHT, length)
            for along in (np.cos(angle), np.sin(angle))
        ]
        columns.append(body.nodal(edges.ravel(), parts[0].ravel(), parts[1].ravel()))
    return sp.hstack(columns).tocsc()
