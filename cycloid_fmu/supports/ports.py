"""Ports of a drive with elastic bodies, as arrays for the kernels (`elastic`): what they are, and their memory."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import Array, compiled
from cycloid_fmu.supports.influence import Indices, Influence, Moving, moving_of, turn_to

_FIRST_REACH = 5e-6  # m: pins this far from the flank may be pressed by elastic bodies
PIN, ROLLER, SECTOR, ALONG_X, ALONG_Y = range(5)  # kinds of ports; the last two are both components of a bearing
GATHERED_AT, FRESH, AGE, EXACT = range(4)  # of `Ports.numbers`
PORT = np.dtype(
    (
        np.record,
        [(name, np.int64) for name in ("kind", "slot", "joint", "law", "block")]
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
                "pull",  # change of the force by that of the unknowns that `pull_ports` was given
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
        Records `PORT` of each disc's joints and contact rows, then of the others, shape (ports,). `joint` is the number
        of a joint or row; ports with different `block` do not displace each other.
    of_row
        Port of each contact row, shape (rows,).
    first, ports_of_joint
        First port of each joint, and number of its ports, shape (joints,).
    patch_half_width
        Half width of the patches by which contacts load the discs, m; 0 if the discs are rigid.
    half_shell
        Diametral clearance of half-shell seats, m; NaN for linear ones.
    """

    influence: Influence
    ports: NDArray[np.void]
    of_row: Indices
    first: Indices
    ports_of_joint: Indices
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
    numbers
        `GATHERED_AT`: crank angle of `between`, rad; `FRESH`: whether `stiffness` is not that of `factor` yet; `AGE`:
        how often `factor` served; `EXACT`: whether forces are solved to the end, and with a factor of their own.
    begin, end
        First port under load of the block of each, and that after the last, shape (ports,).
    between
        Influence between the ports under load, shape (ports, ports), m/N.
    factor
        Upper factor R of RᵀR = C + D⁻¹ between them, shape (ports, ports).
    by_coordinate
        Derivatives of the approaches of ports under load by the unknowns, shape (ports, unknowns).
    forward, stiffness
        R⁻ᵀ of these, and AᵀSA, the product of it with its transpose, columns filled up to whole vectors.
    right, forces
        Right side, and the forces of ports under load, shape (ports,).
    of_slots, rates
        Forces of all slots, and dC/dθ f there, shape (slots,).
    pull_of_slots
        Changes of the forces of all slots that `pull_ports` wrote, shape (slots,).
    rubbing, by_crank
        Change of the balance and of the crank's torque with each port's force by what friction and the crank take of
        it, shapes (ports, unknowns) and (ports,): zero without friction (`add_rubbing`).
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
    numbers: Array
    begin: Indices
    end: Indices
    between: Array
    factor: Array
    by_coordinate: Array
    forward: Array
    stiffness: Array
    right: Array
    forces: Array
    of_slots: Array
    rates: Array
    pull_of_slots: Array
    rubbing: Array
    by_crank: Array
    of_joints: Array
    reach: Array


def ports_of(elastic: Elastic, unknowns: int) -> Ports:
    """Return the memory for one solver of a drive with this number of unknowns."""
    count, slots, width = elastic.ports.size, len(elastic.influence.fixed), (unknowns + 3) & -4
    listed, active, gathered, factored, begin, end = (np.zeros(count, np.int64) for _ in range(6))
    return Ports(
        moving=moving_of(elastic.influence),
        ports=elastic.ports.copy(),
        listed=listed,
        active=active,
        gathered=gathered,
        factored=factored,
        counts=np.full(3, -1, np.int64),
        numbers=np.array([math.nan, 0.0, 0.0, 1.0]),
        begin=begin,
        end=end,
        between=np.zeros((count, count)),
        factor=np.zeros((count, count)),
        by_coordinate=np.zeros((count, unknowns)),
        forward=np.zeros((count, width)),
        stiffness=np.zeros((width, width)),
        right=np.zeros(count),
        forces=np.zeros(count),
        of_slots=np.zeros(slots),
        rates=np.zeros(slots),
        pull_of_slots=np.zeros(slots),
        rubbing=np.zeros((count, unknowns)),
        by_crank=np.zeros(count),
        of_joints=np.zeros((elastic.first.size, 2)),
        reach=np.full(1, _FIRST_REACH),
    )


@compiled
def set_exact(ports: Ports | None, exact: float) -> bool:
    """Set whether forces are solved to the end (1) or as far as the unknowns are (0); return False without ports."""
    if ports is None:
        return False
    ports.numbers[EXACT] = exact
    return True


@compiled
def begin_anew(ports: Ports | None) -> None:
    """Forget all but the ports' records and `reach`, on which the next solution then depends alone, to the last bit."""
    if ports is None:
        return
    ports.numbers[GATHERED_AT], ports.numbers[FRESH], ports.numbers[AGE] = math.nan, 0.0, 0.0
    for i in range(ports.counts.size):
        ports.counts[i] = -1
    turn_to(ports.moving, math.nan)


@compiled
def is_rigid(elastic: Elastic | None) -> bool:
    """Whether all bodies are rigid."""
    return elastic is None


@compiled
def has_ports(elastic: Elastic | None, joint: int) -> bool:
    """Whether a joint's force goes through elastic bodies."""
    if elastic is None:
        return False
    return bool(elastic.ports_of_joint[joint] > 0)


@compiled
def reach_of(ports: Ports | None) -> float:
    """Gap up to which elastic bodies may press a pin, m."""
    if ports is None:
        return 0.0
    return float(ports.reach[0])
