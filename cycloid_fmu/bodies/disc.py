"""Influence matrix of a disc: computed between fixed ports, then interpolated to where pins and rollers are."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from cycloid_fmu import edge
from cycloid_fmu.bodies import outline
from cycloid_fmu.bodies.beams import material_of
from cycloid_fmu.bodies.elastic import PlaneBody
from cycloid_fmu.bodies.mesh import Array, Indices, Mesh, Points, meshed
from cycloid_fmu.bodies.outline import SECTORS
from cycloid_fmu.bodies.ports import PortMatrix, around, patch
from cycloid_fmu.geometry.bodies import DiscBody
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import arc_parts, equal_arc_parameters

PLACES_PER_TOOTH = 8
PLACES_PER_HOLE = 16
LEAST_PLACES = 6  # of a tooth or hole: those of one interpolation
PATCH = 0.25  # half width of a patch over the radius of pin or hole
_EDGE = 0.6  # length of a mesh's edge over the half width of a patch
_EDGES_OF_BORE = 2 * SECTORS
_LARGEST = 1.0 / 16.0  # triangle over the pin circle's radius
_NODES = np.arange(-2, 4)  # places about a position, for interpolation
_UNEQUAL = 0.02  # deviation of a given place from equal arcs, in their lengths


def loads_of(pair: Pair) -> int:
    """Number of unit loads for the matrix of a disc."""
    assert pair.supports is not None
    rollers = pair.supports.kind == "output_rollers"
    arms = 1 if rollers else pair.supports.count
    moving = pair.gear_teeth * PLACES_PER_TOOTH + (pair.supports.count * PLACES_PER_HOLE if rollers else 0)
    return 2 * moving + arms * (2 + SECTORS)


def disc_mesh(pair: Pair, body: DiscBody, disc: int, fineness: float = 1.0) -> Mesh:
    """Return the mesh of a disc; `fineness` divides all its lengths."""
    half_width = PATCH * pair.pin_radius
    bores = outline.bores(pair, body, round(_EDGES_OF_BORE * fineness))
    other = outline.other_holes(pair, body, round(2.0 * math.pi / (_EDGE * PATCH) * fineness))
    flank = outline.flank_contour(pair, disc, _EDGE * half_width / fineness)
    return meshed(flank, [*bores, *other, *outline.windows(body)], _LARGEST * pair.pin_circle_radius / fineness)


def elastic_disc(pair: Pair, body: DiscBody, disc: int, fineness: float = 1.0) -> PlaneBody:
    """Return a disc's finite elements, their stiffness factorised.

    Raises
    ------
    edge.InputError
        If scikit-fem is not installed, or the disc can't be meshed.
    """
    material = material_of(body, pair.material.gear)
    return PlaneBody(disc_mesh(pair, body, disc, fineness), material, pair.face_width, body.plane)


def condensed(
    pair: Pair, body: DiscBody, disc: int, progress: Callable[[int], None] = lambda loads: None
) -> PortMatrix:
    """Return the influence matrix of a disc from finite elements.

    Parameters
    ----------
    pair, body, disc
        The pair with its supports, the disc's description and its number.
    progress
        Called with the number of unit loads that were just solved, of `loads_of`.
    """
    elastic = elastic_disc(pair, body, disc)
    half_width = PATCH * pair.pin_radius
    alpha = _alphas(pair, PLACES_PER_TOOTH)
    places, normals = outline.flank_at(pair, disc, alpha)
    loads = [elastic.both_components(patch(elastic, 0, places, 1j * normals, half_width))]
    ports = [_both("flank", np.repeat(np.arange(pair.gear_teeth), PLACES_PER_TOOTH), places)]
    bores = outline.bores(pair, body, 1)
    for number, bore in enumerate(bores):
        centre, radius = _circle_of(bore.points)
        loads.append(around(elastic, 1 + number, centre, SECTORS))
        ports.append(_both("bore", np.array([number]), np.array([centre])))
        outwards = np.exp(2j * np.pi * np.arange(SECTORS) / SECTORS)
        ports.append(("sector", np.full(SECTORS, number), centre + radius * outwards, outwards))
    if body.roller_hole_radius is not None:
        outwards = np.exp(2j * np.pi * np.arange(PLACES_PER_HOLE) / PLACES_PER_HOLE)
        for number, middle in enumerate(outline.places(pair)):
            at = middle + body.roller_hole_radius * outwards
            width = PATCH * body.roller_hole_radius
            loads.append(elastic.both_components(patch(elastic, 1 + len(bores) + number, at, 1j * outwards, width)))
            ports.append(_both("roller_hole", np.full(PLACES_PER_HOLE, number), at))
    kinds = np.concatenate([np.full(index.size, kind) for kind, index, *_ in ports])
    index, place, direction = (np.concatenate([port[n] for port in ports]) for n in (1, 2, 3))
    compliance = elastic.compliance(sp.hstack(loads).tocsc(), progress)
    return PortMatrix(kinds, index, place, direction, compliance, "free", half_width)


@dataclass(frozen=True, eq=False)
class DiscForces:
    """Forces on a disc in its axes, N, each at its ideal place.

    Attributes
    ----------
    pin
        Of each pin, against the flank's normal, shape (pins,).
    arm
        Of each turning arm: by its sectors, outwards, shape (arms, `SECTORS`); or along x and y, shape (arms, 2).
    roller
        Of each output roller, along -û(A_j), shape (rollers,).
    """

    pin: Array
    arm: Array
    roller: Array


def nodal_forces(
    elastic: PlaneBody, pair: Pair, body: DiscBody, disc: int, crank_angle: float, forces: DiscForces
) -> Array:
    """Forces on all unknowns of a disc at a crank angle (rad), N, shape (unknowns,): spread as the ports of its matrix.

    Forces below a thousandth of the largest of their kind are left out.
    """
    crank = crank_angle + 2.0 * math.pi * disc / pair.discs
    loaded = np.flatnonzero(forces.pin > 1e-3 * forces.pin.max())
    alpha = (2.0 * np.pi * loaded / pair.pins + crank / pair.gear_teeth) % (2.0 * np.pi)
    flank, normal = outline.flank_at(pair, disc, alpha)
    pressed = patch(elastic, 0, flank, 1j * normal, PATCH * pair.pin_radius) @ (-normal * forces.pin[loaded])
    bores = outline.bores(pair, body, 96)
    if forces.roller.size > 0:
        assert body.roller_hole_radius is not None
        inwards = -np.exp(1j * (crank + crank_angle / pair.gear_teeth))
        for number in np.flatnonzero(forces.roller > 1e-3 * forces.roller.max()).tolist():
            at = np.array([outline.places(pair)[number] + body.roller_hole_radius * inwards])
            width = PATCH * body.roller_hole_radius
            hole = patch(elastic, 1 + len(bores) + number, at, np.array([1j * inwards]), width)
            pressed = pressed + hole @ np.array([inwards * forces.roller[number]])
    whole = elastic.nodal_vector(np.asarray(pressed))
    sectors = SECTORS if forces.arm.shape[1] == SECTORS else 0
    for number, (bore, force) in enumerate(zip(bores, forces.arm, strict=True)):
        ports = around(elastic, 1 + number, _circle_of(bore.points)[0], sectors)
        whole = whole + (ports[:, 2:] if sectors else ports) @ force
    return np.asarray(whole)


def _alphas(pair: Pair, count: int) -> Array:
    """Profile parameters of all flank places, tooth by tooth, in the middles of equal arcs."""
    own = equal_arc_parameters(outline.true_flank(pair), count)
    return np.asarray((own + 2.0 * np.pi / pair.gear_teeth * np.arange(pair.gear_teeth)[:, None]).ravel())


def _circle_of(points: Points) -> tuple[complex, float]:
    centre = complex(points.mean())
    return centre, float(np.abs(points - centre).mean())


def _both(kind: str, index: Indices, place: Points) -> tuple[str, Indices, Points, Points]:
    """Ports of both components at places."""
    return kind, np.repeat(index, 2), np.repeat(place, 2), np.tile(np.array([1.0, 1j]), place.size)


@dataclass(frozen=True, eq=False)
class Track:
    """Places of ports on a closed curve, at equal steps.

    Attributes
    ----------
    ports
        Both components' ports of each place, in order along the curve, shape (places, 2).
    first
        Position of the first place, in steps from the curve's origin.
    inverse
        Forces of the ports that make a unit force along x or y at each place, shape (places, 2, 2).
    own
        Compliance of each place by itself, along x and y, shape (places, 2, 2), m/N.
    """

    ports: Indices
    first: float
    inverse: Array
    own: Array

    def rows(self, position: Array, force: Points, ports: int) -> sp.csr_matrix:
        """Forces of a matrix's ports that stand for unit forces at positions: six-point Lagrange interpolation."""
        at = position - self.first
        below = np.floor(at).astype(np.int64)
        place = (below[:, None] + _NODES) % len(self.ports)
        weight = np.ones((at.size, _NODES.size))
        for n, node in enumerate(_NODES):
            for other in _NODES[node != _NODES]:
                weight[:, n] *= (at - below - other) / (node - other)
        components = np.column_stack([force.real, force.imag])
        forces = weight[..., None] * np.einsum("pnij,pj->pni", self.inverse[place], components)
        row = np.broadcast_to(np.arange(at.size)[:, None, None], forces.shape)
        entries = forces.ravel(), (row.ravel(), self.ports[place].ravel())
        return sp.csr_matrix(entries, shape=(at.size, ports))

    def self_compliance(self, position: Array, force: Points) -> Array:
        """Compliance of ports at positions by themselves, m/N: a periodic cubic spline through `own`."""
        components = np.column_stack([force.real, force.imag])
        blocks = self.own_spline((position - self.first) % len(self.own))
        return np.asarray(np.einsum("pi,pij,pj->p", components, blocks, components))

    @functools.cached_property
    def own_spline(self) -> CubicSpline:
        """Compliance of a place by itself over the position, periodic; x is in places."""
        steps = np.arange(len(self.own) + 1.0)
        return CubicSpline(steps, np.concatenate([self.own, self.own[:1]]), bc_type="periodic")


def _track(matrix: PortMatrix, ports: Indices, first: float) -> Track:
    """Make a track of ports in pairs."""
    pairs = ports.reshape(-1, 2)
    directions = matrix.direction[pairs]
    columns = np.stack([directions.real, directions.imag], axis=1)  # place, component, port
    inverse: Array = np.linalg.inv(columns).astype(float)
    blocks = matrix.compliance[pairs[:, :, None], pairs[:, None, :]]
    return Track(pairs, first, inverse, np.einsum("pki,pkl,plj->pij", inverse, blocks, inverse))


@dataclass(frozen=True, eq=False)
class DiscInfluence:
    """A disc's matrix between fixed ports, with what is needed to move them.

    Attributes
    ----------
    pair, disc
        The pair with its supports, and the number of the disc.
    matrix
        Matrix between fixed ports.
    flank
        The flank's places; positions in steps of equal arc from tooth 0's root.
    holes
        Places of each roller's hole; positions in steps of equal angle from +x.
    """

    pair: Pair
    disc: int
    matrix: PortMatrix
    flank: Track
    holes: tuple[Track, ...]

    @property
    def places_per_tooth(self) -> int:
        """Places of the flank on each tooth."""
        return len(self.flank.ports) // self.pair.gear_teeth

    def at(self, crank_angle: float, arms: str = "bore") -> Array:
        """Influence matrix of a drive's ports on the disc, m/N.

        Parameters
        ----------
        crank_angle
            Crank angle θ, rad: pins and rollers are at their ideal places.
        arms
            "bore": both components of each turning arm, in the disc's axes; "sector": its sectors.

        Returns
        -------
        compliance
            Symmetric. Ports in order: each pin, force on the disc along −n; each turning arm; each output roller, force
            −û(A_j).
        """
        pair, size = self.pair, self.matrix.kind.size
        crank = crank_angle + 2.0 * math.pi * self.disc / pair.discs
        alpha = (2.0 * math.pi * np.arange(pair.pins) / pair.pins + crank / pair.gear_teeth) % (2.0 * math.pi)
        pitch = 2.0 * math.pi / pair.gear_teeth
        tooth = np.minimum(np.floor(alpha / pitch), pair.gear_teeth - 1)
        position = (tooth + arc_parts(outline.true_flank(pair), alpha - tooth * pitch)) * self.places_per_tooth
        _, normal = outline.flank_at(pair, self.disc, alpha)
        moving: list[tuple[Track, Array, Points]] = [(self.flank, position, -normal)]
        angle = crank + crank_angle / pair.gear_teeth + math.pi  # of −û(A_j) in the disc's axes
        for hole in self.holes:
            moving.append((hole, np.array([angle / (2.0 * math.pi) * len(hole.ports)]), np.array([np.exp(1j * angle)])))
        fixed = self.matrix.of(arms)
        arm_rows = sp.csr_matrix((np.ones(fixed.size), (np.arange(fixed.size), fixed)), shape=(fixed.size, size))
        rows = [track.rows(where, force, size) for track, where, force in moving]
        weights = sp.vstack([rows[0], arm_rows, *rows[1:]]).tocsr()
        compliance = np.asarray(weights @ (weights @ self.matrix.compliance).T)
        own = [track.self_compliance(where, force) for track, where, force in moving]
        places = np.concatenate([np.arange(pair.pins), np.arange(pair.pins + fixed.size, len(compliance))])
        compliance[places, places] = np.concatenate(own)
        return np.asarray(0.5 * (compliance + compliance.T))


def influence_of(pair: Pair, disc: int, matrix: PortMatrix, source: str) -> DiscInfluence:
    """Return a disc's influence with the places of its ports on flank and holes.

    Raises
    ------
    edge.InputError
        If a given matrix lacks ports or they are not where the disc's flank, bores and holes are; `source` is its file.
    """
    assert pair.supports is not None
    flank = _flank_track(pair, disc, matrix, source)
    rollers = pair.supports.kind == "output_rollers"
    for number in range(1 if rollers else pair.supports.count):
        ports = matrix.of("bore")[matrix.index[matrix.of("bore")] == number]
        if ports.size != 2 or not np.allclose(matrix.direction[ports], [1.0, 1j], atol=1e-6):
            raise edge.InputError(f"{source}: bore {number} needs two ports, along x and along y.")
    holes = [_hole_track(pair, matrix, number, source) for number in range(pair.supports.count if rollers else 0)]
    return DiscInfluence(pair, disc, matrix, flank, tuple(holes))


def _paired(matrix: PortMatrix, ports: Indices, what: str, least: int, source: str) -> Indices:
    """Check that ports follow each other in pairs at one place, and that there are enough."""
    if ports.size % 2 or ports.size < 2 * least:
        raise edge.InputError(
            f"{source}: {what} has {ports.size} ports; it needs both components at {least} places at least."
        )
    place, direction = matrix.place[ports].reshape(-1, 2), matrix.direction[ports].reshape(-1, 2)
    across = np.abs((np.conj(direction[:, 0]) * direction[:, 1]).imag)
    if not (np.abs(np.diff(place, axis=1)) < 1e-9).all() or not (across > 0.1).all():
        raise edge.InputError(
            f"{source}: the ports of {what} must be two components at each place, one after the other."
        )
    return ports


def _flank_track(pair: Pair, disc: int, matrix: PortMatrix, source: str) -> Track:
    """Order the ports on the flank by their arc length, and check that its steps are equal."""
    teeth = pair.gear_teeth
    ports = _paired(matrix, matrix.of("flank"), "the flank", LEAST_PLACES * teeth, source)
    count = ports.size // 2 // teeth
    alpha = np.linspace(0.0, 2.0 * np.pi, teeth * 500, endpoint=False)
    dense, _ = outline.flank_at(pair, disc, alpha)
    place = matrix.place[ports[::2]]
    distance, nearest = KDTree(np.column_stack([dense.real, dense.imag])).query(
        np.column_stack([place.real, place.imag])
    )
    spacing = float(np.abs(np.diff(dense)).sum()) / (teeth * count)
    if distance.max() > 0.1 * spacing:
        far = int(distance.argmax())
        raise edge.InputError(
            f"{source}: the port at ({place[far].real:.6g}, {place[far].imag:.6g}) m is {distance[far] * 1e3:.3g} mm "
            f"off the unmodified flank of disc {disc}, in its axes at crank angle 0."
        )
    alpha = _refined(pair, disc, place, alpha[nearest])
    pitch = 2.0 * np.pi / teeth
    tooth = np.floor(alpha / pitch)
    position = (tooth + arc_parts(outline.true_flank(pair), alpha - tooth * pitch)) * count
    order = np.argsort(position)
    first = position[order] - np.arange(position.size)
    if position.size != teeth * count or np.ptp(first) > 2.0 * _UNEQUAL:
        raise edge.InputError(f"{source}: the flank's ports must be at equal arcs, the same number on each tooth.")
    return _track(matrix, ports.reshape(-1, 2)[order].ravel(), float(first.mean()))


def _refined(pair: Pair, disc: int, place: Points, alpha: Array) -> Array:
    """Profile parameters of places near those of `alpha`, by a step along the tangent."""
    at, normal = outline.flank_at(pair, disc, alpha)
    ahead, _ = outline.flank_at(pair, disc, alpha + 1e-6)
    along = ((place - at) * np.conj(1j * normal)).real
    return np.asarray((alpha + 1e-6 * along / np.abs(ahead - at)) % (2.0 * np.pi))


def _hole_track(pair: Pair, matrix: PortMatrix, number: int, source: str) -> Track:
    numbers = matrix.of("roller_hole")
    ports = numbers[matrix.index[numbers] == number]
    ports = _paired(matrix, ports, f"the hole of output roller {number}", LEAST_PLACES, source)
    outwards = matrix.place[ports[::2]] - outline.places(pair)[number]
    count = outwards.size
    position = np.angle(outwards) / (2.0 * np.pi) % 1.0 * count
    order = np.argsort(position)
    first = position[order] - np.arange(count)
    if np.ptp(first) > 2.0 * _UNEQUAL or np.ptp(np.abs(outwards)) > 0.01 * np.abs(outwards).mean():
        raise edge.InputError(f"{source}: the ports of roller hole {number} must be at equal angles around its middle.")
    return _track(matrix, ports.reshape(-1, 2)[order].ravel(), float(first.mean()))
