"""Joints: the bearings between two bodies, and the output rollers in their holes, as one list for all kernels.

A joint connects two bodies, as a bearing its outer and inner ring: its law is the force over the displacement d of the
outer body's place from the inner body's. Bodies, joints and laws are records; a kernel takes `joint.place_x`, Python
`joints["place_x"]`. All kinds of joints have the same displacement, energy and derivatives: a kind is defined in
`assembly` alone.

=============== ======= ===========================================================================================
Body            Unit    Meaning
=============== ======= ===========================================================================================
shift           1       index of the first of the two unknowns that shift it; -1 for the housing
rotation        1       index of the unknown that rotates it; -1 for the housing and for cranks, which turn by θ
on              1       body that carries a crank's axis, from which its shift counts; -1 for other bodies
rate            1       its ideal rotation for each radian of the crank
crank_phase     rad     angle of a disc's eccentric ahead of disc 0's
=============== ======= ===========================================================================================

=============== ======= ===========================================================================================
Joint           Unit    Meaning
=============== ======= ===========================================================================================
outer, inner    1       the two bodies
seat            1       the body that carries the inner one if that is a crank, otherwise the inner one
law             1       its law
place_x, _y     m       ideal place in the outer body and in the seat, in their axes at θ = 0; 0 if their rates differ
outer_x, _y     m       error of the place in the outer body
inner_x, _y     m       error of the place in the seat
eccentricity    m       ideal eccentricity of the crank that is the inner body, the disc the outer; otherwise 0
throw, phase    m, rad  errors of the eccentric
throw_along     m       the eccentric's error by both along its ideal direction
throw_across    m       the same across it, counter-clockwise positive
reach           m       ideal |d|, along the eccentric's direction: a roller's contact in its hole; 0 for bearings
play            m       further |d| without contact
=============== ======= ===========================================================================================
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import Array, compiled
from cycloid_fmu.supports.bearing import push, stored
from cycloid_fmu.supports.ports import Elastic, Ports, ports_of

HOUSING, CARRIER, FIRST_DISC_BODY = range(3)  # bodies: after the discs come the cranks
FIRST_DISC = 3  # first unknown of disc 0: shift, then rotation; the carrier's unknowns are its rotation, then its shift
_INDEX, _VALUE = np.int64, np.float64
BODY = np.dtype(
    (
        np.record,
        [(name, _INDEX) for name in ("shift", "rotation", "on")] + [(name, _VALUE) for name in ("rate", "crank_phase")],
    )
)
JOINT = np.dtype(
    (
        np.record,
        [(name, _INDEX) for name in ("outer", "inner", "seat", "law")]
        + [(name, _VALUE) for name in ("place_x", "place_y", "outer_x", "outer_y", "inner_x", "inner_y")]
        + [
            (name, _VALUE)
            for name in ("eccentricity", "throw", "phase", "throw_along", "throw_across", "reach", "play")
        ],
    )
)
UNKNOWNS = 8  # at most of one joint


class Assembly(NamedTuple):
    """What holds discs, cranks and carrier, SI.

    Attributes
    ----------
    bodies, joints, laws
        Records, shapes (bodies,), (joints,) and (laws,).
    rotation_scale
        Radius that converts a rotation to a displacement, m, for convergence limits.
    balanced
        Tolerance of the balance, N.
    elastic
        Elastic bodies between the joints; None compiles to kernels that know of none.
    """

    bodies: NDArray[np.void]
    joints: NDArray[np.void]
    laws: NDArray[np.void]
    rotation_scale: float
    balanced: float
    elastic: Elastic | None

    @property
    def unknowns(self) -> int:
        """Number of unknowns: cranks, each shifted by two, come last."""
        return int(self.bodies["shift"].max()) + 2


class Work(NamedTuple):
    """Arrays that solving overwrites.

    Attributes
    ----------
    coordinates, residual, step, before, jump
        Shape (unknowns,): generalised coordinates q, residual, step, start of the step, and last jump within a step.
    jacobian, matrix
        Derivatives of the residual, and the matrix of the linear solution, shape (unknowns, unknowns).
    axes
        Directions of each body's x-axis and of its eccentric: see `orient`. Shape (bodies, 4).
    indices, by
        Which coordinates move one joint, shape (`UNKNOWNS`,), and derivatives of its displacement by them,
        shape (2, `UNKNOWNS`): see `derivatives`.
    pose, moved
        Last position of each disc, shape (discs, 3), and motion of the discs since all pins were solved, shape (1,), m.
    ports
        Memory of the ports of elastic bodies; None without any.
    """

    coordinates: Array
    residual: Array
    step: Array
    before: Array
    jump: Array
    jacobian: Array
    matrix: Array
    axes: Array
    indices: NDArray[np.int64]
    by: Array
    pose: Array
    moved: Array
    ports: Ports | None


def work_of(assembly: Assembly) -> Work:
    """Return uninitialized work arrays."""
    unknowns, discs = assembly.unknowns, int((assembly.bodies["rotation"] >= FIRST_DISC).sum())
    coordinates, residual, step, before, jump = np.zeros((5, unknowns))
    jacobian, matrix = np.zeros((2, unknowns, unknowns))
    return Work(
        coordinates,
        residual,
        step,
        before,
        jump,
        jacobian,
        matrix,
        np.zeros((assembly.bodies.size, 4)),
        np.zeros(UNKNOWNS, np.int64),
        np.zeros((2, UNKNOWNS)),
        np.zeros((discs, 3)),
        np.full(1, np.inf),
        None if assembly.elastic is None else ports_of(assembly.elastic, unknowns),
    )


class Displacement(NamedTuple):
    """Displacement d of a joint's outer body from its inner one, in axes that do not rotate."""

    normal_x: float  # direction of d
    normal_y: float
    length: float  # |d|, m
    excess: float  # |d| beyond the joint's reach, m
    outer_x: float  # lever arms of outer body and seat, m
    outer_y: float
    inner_x: float
    inner_y: float


class Reaction(NamedTuple):
    """Force of a joint along its displacement."""

    force: float  # N
    stiffness: float  # derivative by the displacement's length, N/m
    across: float  # stiffness at a right angle to the displacement, N/m


@compiled
def orient(assembly: Assembly, crank_angle: float, work: Work) -> None:
    """Write the direction of each body's x-axis, and that of a disc's ideal eccentric, at θ and `work.coordinates`."""
    for number in range(assembly.bodies.size):
        body, axes = assembly.bodies[number], work.axes[number]
        axes[0], axes[1] = 1.0, 0.0
        if body.rotation >= 0:
            angle, crank = body.rate * crank_angle + work.coordinates[body.rotation], crank_angle + body.crank_phase
            axes[0], axes[1], axes[2], axes[3] = math.cos(angle), math.sin(angle), math.cos(crank), math.sin(crank)


@compiled
def displacement(assembly: Assembly, joint: np.record, work: Work) -> Displacement:
    """Displacement of a joint after `orient`, computed from small terms, without cancellation."""
    q, px, py = work.coordinates, joint.place_x, joint.place_y
    outer, inner = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.inner)]
    seat = assembly.bodies[int(joint.seat)]
    axes, seat_axes = work.axes[int(joint.outer)], work.axes[int(joint.seat)]
    co, so, ci, si = axes[0], axes[1], seat_axes[0], seat_axes[1]
    dx, dy = co * joint.outer_x - so * joint.outer_y, so * joint.outer_x + co * joint.outer_y
    ex, ey = ci * joint.inner_x - si * joint.inner_y, si * joint.inner_x + ci * joint.inner_y
    hx, hy, ax, ay = co * px - so * py, so * px + co * py, ci * px - si * py, si * px + ci * py
    outer_x, outer_y, inner_x, inner_y = hx + dx, hy + dy, ax + ex, ay + ey
    dx, dy = dx - ex, dy - ey
    if px != 0.0 or py != 0.0:
        # R(γ + y) p - R(γ + x) p as a rotation about their mean.
        turn = math.tan(0.5 * (q[outer.rotation] - q[seat.rotation]))
        dx, dy = dx - turn * (hy + ay), dy + turn * (hx + ax)
    # A crank in the body that carries it is displaced by its own shift alone.
    carried = inner.on == joint.outer
    if outer.shift >= 0 and not carried:
        dx, dy = dx + q[outer.shift], dy + q[outer.shift + 1]
    if inner.shift >= 0:
        dx, dy = dx - q[inner.shift], dy - q[inner.shift + 1]
    if seat.shift >= 0 and joint.seat != joint.inner and not carried:
        dx, dy = dx - q[seat.shift], dy - q[seat.shift + 1]
    # Ideal eccentric e u(A) minus the actual one (e + de) u(A + dψ).
    along, across, cc, sc = joint.throw_along, joint.throw_across, axes[2], axes[3]
    dx, dy = dx - along * cc + across * sc, dy - along * sc - across * cc

    wx, wy = joint.reach * cc + dx, joint.reach * sc + dy
    length = math.hypot(wx, wy)
    excess = length
    if joint.reach > 0.0:
        excess = (2.0 * joint.reach * (cc * dx + sc * dy) + dx * dx + dy * dy) / (length + joint.reach)
    nx, ny = (wx / length, wy / length) if length > 0.0 else (1.0, 0.0)
    return Displacement(nx, ny, length, excess, outer_x, outer_y, inner_x, inner_y)


@compiled
def _by_shift(work: Work, column: int, unknown: int, sign: float) -> int:
    """Set the derivatives by two unknowns that shift a displacement directly; return the next column."""
    work.indices[column], work.indices[column + 1] = unknown, unknown + 1
    work.by[0, column], work.by[1, column] = sign, 0.0
    work.by[0, column + 1], work.by[1, column + 1] = 0.0, sign
    return column + 2


@compiled
def derivatives(assembly: Assembly, joint: np.record, d: Displacement, work: Work) -> int:
    """Write the unknowns that move a joint and the derivatives of d by them into `work`; return their number."""
    outer, inner = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.inner)]
    seat, index, by = assembly.bodies[int(joint.seat)], work.indices, work.by
    count, carried = 0, inner.on == joint.outer
    if outer.shift >= 0 and not carried:
        count = _by_shift(work, count, outer.shift, 1.0)
    if inner.shift >= 0:
        count = _by_shift(work, count, inner.shift, -1.0)
    if seat.shift >= 0 and joint.seat != joint.inner and not carried:
        count = _by_shift(work, count, seat.shift, -1.0)
    if outer.rotation >= 0:
        index[count], by[0, count], by[1, count] = outer.rotation, -d.outer_y, d.outer_x
        count += 1
    if seat.rotation >= 0:
        index[count], by[0, count], by[1, count] = seat.rotation, d.inner_y, -d.inner_x
        count += 1
    return count


@compiled
def reaction(assembly: Assembly, joint: np.record, d: Displacement, centring: float) -> Reaction:
    """Force of a joint, for bearings with that of a centring spring, N/m."""
    force, stiffness = push(assembly.laws[joint.law], d.excess - joint.play)
    if joint.reach == 0.0:
        force, stiffness = force + centring * d.length, stiffness + centring
    return Reaction(force, stiffness, force / d.length if d.length > 0.0 else stiffness)


@compiled
def stored_energy(assembly: Assembly, joint: np.record, d: Displacement, centring: float) -> float:
    """Energy of a joint, ∫ F dr with the force of `reaction`, J."""
    spring = 0.5 * centring * d.length * d.length if joint.reach == 0.0 else 0.0
    return stored(assembly.laws[joint.law], d.excess - joint.play) + spring


@compiled
def change(d: Displacement, acting: Reaction, vx: float, vy: float) -> tuple[float, float]:
    """Change of the force that draws the outer body to the inner one if the displacement changes by v."""
    normal = (acting.stiffness - acting.across) * (d.normal_x * vx + d.normal_y * vy)
    return normal * d.normal_x + acting.across * vx, normal * d.normal_y + acting.across * vy


@compiled
def eccentric(joint: np.record, work: Work) -> tuple[float, float]:
    """Position of a joint's eccentric from its crank's axis, after `orient`, m."""
    axes = work.axes[int(joint.outer)]
    along, across = joint.eccentricity + joint.throw_along, joint.throw_across
    return along * axes[2] - across * axes[3], along * axes[3] + across * axes[2]


@compiled
def turning_motion(assembly: Assembly, joint: np.record, d: Displacement, work: Work) -> tuple[float, float]:
    """Motion of a joint's displacement with the crank at fixed unknowns, m for each radian."""
    outer, seat, axes = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.seat)], work.axes[int(joint.outer)]
    ideal, (ex, ey) = joint.eccentricity + joint.reach, eccentric(joint, work)
    vx = seat.rate * d.inner_y - outer.rate * d.outer_y + ey - ideal * axes[3]
    vy = outer.rate * d.outer_x - seat.rate * d.inner_x - ex + ideal * axes[2]
    return vx, vy


@compiled
def turn_levers(assembly: Assembly, joint: np.record, d: Displacement, fx: float, fy: float, by_angle: Array) -> None:
    """Add the derivatives of the balance's equations by θ because the levers of a joint's force rotate."""
    outer, seat = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.seat)]
    if outer.rotation >= 0:
        by_angle[outer.rotation] -= outer.rate * (fx * d.outer_x + fy * d.outer_y)
    if seat.rotation >= 0:
        by_angle[seat.rotation] += seat.rate * (fx * d.inner_x + fy * d.inner_y)


@compiled
def add_turning(
    assembly: Assembly, joint: np.record, d: Displacement, acting: Reaction, work: Work, unknowns: int, by_angle: Array
) -> float:
    """Add the derivatives of the balance's equations by θ at fixed unknowns; return that of the joint's energy, N·m.

    `unknowns` is the result of `derivatives`.
    """
    vx, vy = turning_motion(assembly, joint, d, work)
    gx, gy = change(d, acting, vx, vy)
    for i in range(unknowns):
        by_angle[work.indices[i]] += work.by[0, i] * gx + work.by[1, i] * gy
    fx, fy = acting.force * d.normal_x, acting.force * d.normal_y
    turn_levers(assembly, joint, d, fx, fy, by_angle)
    return float(fx * vx + fy * vy)
