"""The ring as an annulus in plane stress, its outer surface held: influence of forces on its inner surface, exactly.

Displacements and tractions are Fourier series around the ring. For each order n, displacement and stress are four
functions of the radius r, which satisfy linear differential equations with constant coefficients over ln r.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import j1

from cycloid_fmu.bodies.mesh import Array
from cycloid_fmu.geometry.pair import Material

_ORDERS_PER_PATCH = 60.0  # divided by the patch's half angle: the sum is within 1e-6 (terms fall with the fourth power)


def annulus_influence(
    inner: float, outer: float, width: float, material: Material, half_width: float, count: int
) -> Array:
    """Displacements of equally spaced patches on the inner surface under their unit forces, m/N.

    Parameters
    ----------
    inner, outer, width
        Radii and axial width of the annulus, m.
    material
        Young's modulus and Poisson's ratio.
    half_width
        Half width w of the semi-elliptic patches along the circle, m.
    count
        Number of patches; patch i is at 2πi/`count` from +x.

    Returns
    -------
    compliance
        Mean displacement, weighted with the patch's density, along x and y in turn for each patch, shape (2 count,
        2 count); symmetric, positive definite.
    """
    angle = half_width / inner
    orders = np.arange(-int(_ORDERS_PER_PATCH / angle), int(_ORDERS_PER_PATCH / angle) + 1)
    below, above = _density(orders - 1, angle), _density(orders + 1, angle)
    cosine, sine = 0.5 * (below + above), -0.5j * (below - above)
    loads = np.array([[cosine, -sine], [sine, cosine]])  # along x, y; in polar components
    positive = _compliances(np.arange(orders[-1] + 1), inner, outer, material)
    each = np.where(orders[:, None, None] < 0, np.conj(positive[np.abs(orders)]), positive[np.abs(orders)])
    terms = 2.0 * np.pi / (inner * width) * np.einsum("ain,nij,bjn->nab", np.conj(loads), each, loads)
    steps = 2.0 * np.pi * np.arange(count) / count
    local = np.einsum("nab,kn->kab", terms, np.exp(1j * np.outer(steps, orders))).real
    turned = np.array([[np.cos(steps), -np.sin(steps)], [np.sin(steps), np.cos(steps)]]).transpose(2, 0, 1)
    number = np.arange(count)
    blocks = local[(number[:, None] - number) % count]
    whole = np.einsum("iab,ilbc,ldc->iald", turned, blocks, turned).reshape(2 * count, 2 * count)
    return np.asarray(0.5 * (whole + whole.T))


def _density(order: NDArray[np.int64], angle: float) -> Array:
    """Fourier coefficients of the density 2/(πβ) sqrt(1 - (φ/β)²) over |φ| < β: J1(nβ)/(π nβ)."""
    n = np.abs(order) * angle
    return np.asarray(np.where(n > 0.0, j1(n) / np.where(n > 0.0, np.pi * n, 1.0), 0.5 / np.pi))


def _compliances(orders: NDArray[np.int64], inner: float, outer: float, material: Material) -> NDArray[np.complex128]:
    """Radial and tangential displacement of each order at the inner surface over traction there, m/Pa.

    With u_r = U cos nφ, u_φ = V sin nφ, S = rσ_r and T = rτ, the functions (U, V, S, T) of ln r have the derivatives
    of the matrix below, from Hooke's law in plane stress and from equilibrium.
    """
    nu, n = material.poissons_ratio, orders.astype(float)
    zero, whole = np.zeros_like(n), np.ones_like(n)
    rows = [
        [-nu * whole, -nu * n, (1.0 - nu**2) * whole, zero],
        [n, whole, zero, 2.0 * (1.0 + nu) * whole],
        [whole, n, nu * whole, -n],
        [n, n**2, nu * n, -whole],
    ]
    system = np.array(rows).transpose(2, 0, 1)  # S and T divided by Young's modulus
    length = np.log(outer / inner)
    compliance = np.empty((orders.size, 2, 2))
    for low in range(min(2, orders.size)):  # powers of r coincide there
        across = expm(system[low] * length)
        compliance[low] = np.linalg.solve(across[:2, :2], across[:2, 2:])
    if orders.size > 2:
        powers, modes = (part.real for part in np.linalg.eig(system[2:]))
        at_inner = (
            modes * np.exp(-np.maximum(powers, 0.0) * length)[:, None, :]
        )  # each is 1 at the end where it is largest
        at_outer = modes * np.exp(np.minimum(powers, 0.0) * length)[:, None, :]
        conditions = np.concatenate([at_outer[:, :2], at_inner[:, 2:]], axis=1)
        stresses = np.concatenate([np.zeros((2, 2)), -np.eye(2)])
        compliance[2:] = at_inner[:, :2] @ np.linalg.solve(
            conditions, np.broadcast_to(stresses, (orders.size - 2, 4, 2))
        )
    phase = np.array([1.0, -1.0j])
    return np.asarray(compliance * inner / material.youngs_modulus * phase[:, None] / phase)
