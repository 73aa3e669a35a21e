"""Ports of a drive with elastic bodies, as arrays for the kernels (`elastic`): what they are, and their memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import Array, compiled
from cycloid_fmu.supports.influence import Indices, Influence, Moving, moving_of

_FIRST_REACH = 5e-6  # m: pins this far from the flank may be pressed by elastic bodies
PIN, ROLLER, SECTOR, ALONG_X, ALONG_Y = range(5)  # kinds of ports; the last two are both components of a bearing
PORT = np.dtype(
    (
        np.record,
        [(name, np.int64) for name in ("kind", "slot", "joint", "law")]
        + [
            (name, np.float64)
            for name in (
                "along_x",  # direction in the ideal axes of the outer body, of a bearing's port
                "along_y",
                "clearance",  # half of it, of a sector or an output roller
                "scale",  # force over deflection^exponent, of these
                "exponent",
                "approach",
                "deflection",
                "force",
                "softness",  # derivative of the deflection by the force, and that between both components
                "across",
            )
        ],
    )
)
class Elastic(NamedTuple):
    """What elastic bodies add to the joints of a drive.

    Attributes
    ----------
    influence
        Of the bodies.
    ports
        `PORT`s of the joints, and then of each contact row, whose number is their `joint`, shape (ports,).
    first, count
        First port of each joint, and number of its ports, shape (joints,).
    patch_half_width
        Half width of the patches by which contacts load the discs, m; 0 if the discs are rigid.
    half_shell
        Diametral clearance of half-shell seats, m; NaN for linear ones.
    """

    influence: Influence
    ports: NDArray[np.void]
    first: Indices
    count: Indices
    patch_half_width: float
    half_shell: float


class Ports(NamedTuple):
    """Memory of the ports of one drive.

    Attributes
    ----------
    moving
        Influence at the last crank angle.
    ports
        As `Elastic.ports`, with their state.
    listed, active, gathered, factored
        Ports that may be pressed, those under load, those between which `between` is, and those whose matrix `factor`
        is, shape (ports,).
    counts
        Numbers of the last three, shape (3,).
    between
        Influence between the ports under load, shape (ports, ports), m/N.
    factor
        Upper factor R of RᵀR = C + D⁻¹ between them, shape (ports, ports).
    by_place, forces_by_place
        Derivatives of the approaches and of the forces of ports under load by the unknowns, shape (ports, unknowns).
    curved
        What the curvature of the flank adds to the first ones of a disc's three unknowns, shape (ports, 3).
    right
        Right side, shape (ports,).
    of_slots, rates
        Forces of all slots, and dC/dθ f there, shape (slots,).
    of_joints
        Force on each joint's displacement, N, shape (joints, 2).
    reach
        Gap up to which pins may be pressed, shape (1,), m.
    """

    moving: Moving
    ports: NDArray[np.void]
    listed: Indices
    active: Indices
    gathered: Indices
    factored: Indices
    counts: Indices
    between: Array
    factor: Array
    by_place: Array
    forces_by_place: Array
    curved: Array
    right: Array
    of_slots: Array
    rates: Array
    of_joints: Array
    reach: Array


def ports_of(elastic: Elastic, unknowns: int) -> Ports:
    """Return the memory for one solver of a drive with this number of unknowns."""
    count, slots = elastic.ports.size, len(elastic.influence.fixed)
    return Ports(
        moving_of(elastic.influence),
        elastic.ports.copy(),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.full(3, -1, np.int64),
        np.zeros((count, count)),
        np.zeros((count, count)),
        np.zeros((count, unknowns)),
        np.zeros((count, unknowns)),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(slots),
        np.zeros(slots),
        np.zeros((elastic.first.size, 2)),
        np.full(1, _FIRST_REACH),
    )


@compiled
def has_ports(elastic: Elastic | None, joint: int) -> bool:
    """Whether a joint's force goes through elastic bodies."""
    if elastic is None:
        return False
    return bool(elastic.count[joint] > 0)


@compiled
def reach_of(ports: Ports | None) -> float:
    """Gap up to which elastic bodies may press a pin, m."""
    if ports is None:
        return 0.0
    return float(ports.reach[0])
