"""Plane elasticity of a body of constant thickness: quadratic finite elements, free of supports.

Loads are balanced by inertia: by a body force uniform over the area and one proportional to r times the direction of
rotation about the origin. The displacement's mean and mean rotation over the area are zero. Compliances are then
symmetric and positive semidefinite, with the rigid motions as their kernel.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from cycloid_fmu import edge
from cycloid_fmu.bodies.mesh import Indices, Mesh
from cycloid_fmu.geometry.pair import Material

Array = NDArray[np.float64]
_BLOCK = 64  # loads solved together
_RIGID = 3


class PlaneBody:
    """A plane elastic body with its factorised stiffness matrix.

    Parameters
    ----------
    mesh
        Its triangles, m.
    material
        Young's modulus and Poisson's ratio.
    thickness
        Its thickness, m.
    plane
        "stress" for free faces, "strain" for no strain across the thickness.

    Attributes
    ----------
    mesh
        Its triangles.
    nodes
        Places of displacements, corners and then middles of edges, x + iy, shape (nodes,), m.

    Raises
    ------
    edge.InputError
        If scikit-fem is not installed; it names the extra.
    """

    def __init__(self, mesh: Mesh, material: Material, thickness: float, plane: str = "stress") -> None:
        with edge.needs_extra("bodies"):
            import skfem
            from skfem.models.elasticity import lame_parameters, linear_elasticity
        young, poisson = material.youngs_modulus, material.poissons_ratio
        first, shear = lame_parameters(young, poisson)
        if plane == "stress":
            first = 2.0 * first * shear / (first + 2.0 * shear)
        triangles = skfem.MeshTri(np.array([mesh.nodes.real, mesh.nodes.imag]), np.ascontiguousarray(mesh.triangles.T))
        basis = skfem.Basis(triangles, skfem.ElementVector(skfem.ElementTriP2()))
        self.mesh, self._basis, self._lame = mesh, basis, (first, shear)
        stiffness = thickness * linear_elasticity(first, shear).assemble(basis)
        x, y = basis.doflocs
        number = np.arange(basis.N)
        along_x = np.zeros(basis.N, dtype=bool)
        along_x[np.concatenate([basis.nodal_dofs[0], basis.facet_dofs[0]])] = True
        self._dofs = np.array([number[along_x], self._partners(number[along_x])])
        self.nodes = x[self._dofs[0]] + 1j * y[self._dofs[0]]
        self._rigid = np.column_stack([along_x, ~along_x, np.where(along_x, -y, x)]).astype(float)
        mass = skfem.BilinearForm(lambda u, v, _: u[0] * v[0] + u[1] * v[1]).assemble(basis)
        self._inertia = mass @ self._rigid
        self._gram = self._rigid.T @ self._inertia
        self.area = float(self._gram[0, 0])
        held = self._held()
        self._free = np.setdiff1d(number, held)
        self._factor = _factorised(stiffness.tocsc()[self._free][:, self._free])

    def _partners(self, along_x: Indices) -> Indices:
        """Unknowns along y at the nodes of unknowns along x."""
        partner = np.empty(self._basis.N, dtype=np.int64)
        partner[self._basis.nodal_dofs[0]] = self._basis.nodal_dofs[1]
        partner[self._basis.facet_dofs[0]] = self._basis.facet_dofs[1]
        return partner[along_x]

    def _held(self) -> Indices:
        """Three unknowns that fix the rigid motions: a node, and a far node across the line to it."""
        first = int(np.argmin(np.abs(self.nodes)))
        second = int(np.argmax(np.abs(self.nodes - self.nodes[first])))
        across = self.nodes[second] - self.nodes[first]
        return np.array([*self._dofs[:, first], self._dofs[int(abs(across.real) >= abs(across.imag)), second]])

    @property
    def unknowns(self) -> int:
        """Number of unknown displacements."""
        return int(self._basis.N)

    @functools.cached_property
    def _edges(self) -> dict[tuple[int, int], int]:
        """Number of the middle node of the edge between two corners, by their numbers in order."""
        facets = np.sort(self._basis.mesh.facets, axis=0).T
        boundary = self._basis.mesh.boundary_facets()
        place = np.full(self._basis.N, -1)
        place[self._dofs[0]] = np.arange(self.nodes.size)
        middle = place[self._basis.facet_dofs[0]]
        return {(int(facets[f, 0]), int(facets[f, 1])): int(middle[f]) for f in boundary}

    @functools.cached_property
    def corners(self) -> Indices:
        """Numbers in `nodes` of the mesh's own nodes."""
        place = np.full(self._basis.N, -1)
        place[self._dofs[0]] = np.arange(self.nodes.size)
        return np.asarray(place[self._basis.nodal_dofs[0]])

    def edges_of(self, contour: int) -> Indices:
        """Start, middle and end node of each boundary edge of a contour in its order, shape (edges, 3)."""
        start = self.mesh.chains[contour]
        end = np.roll(start, -1)
        middle = [self._edges[min(a, b), max(a, b)] for a, b in zip(start.tolist(), end.tolist(), strict=True)]
        return np.column_stack([self.corners[start], middle, self.corners[end]])

    def both_components(self, weights: sp.csc_matrix) -> sp.csc_matrix:
        """Nodal forces along x and then along y of each density, shape (unknowns, 2 densities).

        `weights` are integrals of shape functions with the densities, shape (nodes, densities).
        """
        columns = [self.nodal(rows, *parts) for rows, *parts in _columns(weights)]
        return sp.hstack(columns).tocsc()

    def nodal(self, nodes: Indices, along_x: Array, along_y: Array) -> sp.csc_matrix:
        """One column of nodal forces from forces on nodes, which are added up, N, shape (unknowns, 1)."""
        rows = np.concatenate([self._dofs[0][nodes], self._dofs[1][nodes]])
        values = np.concatenate([along_x, along_y])
        return sp.csc_matrix((values, (rows, np.zeros_like(rows))), (self._basis.N, 1))

    def compliance(self, loads: sp.csc_matrix, progress: Callable[[int], None] = lambda loads: None) -> Array:
        """Work-conjugate displacements of all loads under each, m/N, shape (loads, loads), symmetric.

        `progress` is called with the number of loads just solved.
        """
        compliance = np.empty((loads.shape[1], loads.shape[1]))
        transposed = loads.T.tocsr()
        for begin in range(0, loads.shape[1], _BLOCK):
            block = slice(begin, min(begin + _BLOCK, loads.shape[1]))
            compliance[:, block] = transposed @ self.displacement(loads[:, block].toarray())
            progress(block.stop - begin)
        return 0.5 * (compliance + compliance.T)

    def displacement(self, forces: Array) -> Array:
        """Displacements of all unknowns under nodal forces, m, both of shape (unknowns, loads)."""
        balanced = forces - self._inertia @ np.linalg.solve(self._gram, self._rigid.T @ forces)
        moved = np.zeros_like(balanced)
        moved[self._free] = self._factor.solve(balanced[self._free])
        return np.asarray(moved - self._rigid @ np.linalg.solve(self._gram, self._inertia.T @ moved))

    def nodal_vector(self, nodes: NDArray[np.complex128]) -> Array:
        """Forces on all unknowns from forces x + iy at `nodes`, N, shape (unknowns,)."""
        forces = np.zeros(self._basis.N)
        forces[self._dofs[0]], forces[self._dofs[1]] = nodes.real, nodes.imag
        return forces

    def stress(self, points: NDArray[np.complex128]) -> tuple[sp.csr_matrix, sp.csr_matrix, sp.csr_matrix]:
        """Matrices that turn displacements of all unknowns into the stresses σ_x, σ_y and τ_xy at points, Pa.

        Parameters
        ----------
        points
            Places x + iy inside the body, m, shape (points,). Between elements stresses jump; the element is the first
            that has the point.
        """
        basis, at = self._basis, np.array([points.real, points.imag])
        cells = basis.mesh.element_finder()(*at)
        local = basis.mapping.invF(at[:, :, None], tind=cells)
        rows, columns, gradients = [], [], []
        for number in range(basis.Nbfun):
            shape = basis.elem.gbasis(basis.mapping, local, number, tind=cells)[0]
            rows.append(np.arange(points.size))
            columns.append(basis.element_dofs[number, cells])
            gradients.append(shape.grad[:, :, :, 0])
        place = np.concatenate(rows), np.concatenate(columns)
        size = (points.size, basis.N)

        def derivative(component: int, along: int) -> sp.csr_matrix:
            return sp.csr_matrix((np.concatenate([g[component, along] for g in gradients]), place), shape=size)

        along_x, along_y = derivative(0, 0), derivative(1, 1)
        first, shear = self._lame
        volume = first * (along_x + along_y)
        return (
            volume + 2.0 * shear * along_x,
            volume + 2.0 * shear * along_y,
            shear * (derivative(0, 1) + derivative(1, 0)),
        )

    def at_nodes(self, displacement: Array) -> NDArray[np.complex128]:
        """Displacements x + iy at `nodes` from those of the unknowns."""
        return np.asarray(displacement[self._dofs[0]] + 1j * displacement[self._dofs[1]])


def _columns(weights: sp.csc_matrix) -> Iterator[tuple[Indices, Array, Array]]:
    for column in range(weights.shape[1]):
        part = slice(weights.indptr[column], weights.indptr[column + 1])
        nodes, values = weights.indices[part], weights.data[part]
        yield nodes, values, np.zeros_like(values)
        yield nodes, np.zeros_like(values), values


def _factorised(matrix: sp.csc_matrix) -> SuperLU:
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
