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
crank_phase     rad     angle of the disc's eccentric ahead of disc 0's
eccentricity    m       ideal eccentricity of the crank that is the inner body; 0 without an eccentric
throw, phase    m, rad  errors of the eccentric
reach           m       ideal |d|, along the eccentric's direction: a roller's contact in its hole; 0 for bearings
play            m       further |d| without contact
=============== ======= ===========================================================================================
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import Array, part
from cycloid_fmu.supports.bearing import push, stored

HOUSING, CARRIER, FIRST_DISC_BODY = range(3)  # bodies: after the discs come the cranks
FIRST_DISC = 3  # first unknown of disc 0: shift, then rotation; the carrier's unknowns are its rotation, then its shift
_INDEX, _VALUE = np.int64, np.float64
BODY = np.dtype((np.record, [("shift", _INDEX), ("rotation", _INDEX), ("on", _INDEX), ("rate", _VALUE)]))
JOINT = np.dtype(
    (
        np.record,
        [(name, _INDEX) for name in ("outer", "inner", "seat", "law")]
        + [(name, _VALUE) for name in ("place_x", "place_y", "outer_x", "outer_y", "inner_x", "inner_y")]
        + [(name, _VALUE) for name in ("crank_phase", "eccentricity", "throw", "phase", "reach", "play")],
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
    """

    bodies: NDArray[np.void]
    joints: NDArray[np.void]
    laws: NDArray[np.void]
    rotation_scale: float
    balanced: float

    @property
    def unknowns(self) -> int:
        """Number of unknowns: cranks, each shifted by two, come last."""
        return int(self.bodies["shift"].max()) + 2


class Displacement(NamedTuple):
    """Displacement d of a joint's outer body from its inner one, in axes that do not rotate."""

    normal_x: float  # direction of d
    normal_y: float
    length: float  # |d|, m
    excess: float  # |d| beyond the joint's reach, m
    outer_angle: float  # rotation of the bodies that have the joint's place, rad
    inner_angle: float
    outer_x: float  # lever arms of these bodies, m
    outer_y: float
    inner_x: float
    inner_y: float
    unknowns: int  # number of unknowns that move it


class Reaction(NamedTuple):
    """Force of a joint along its displacement."""

    force: float  # N
    stiffness: float  # derivative by the displacement's length, N/m
    across: float  # stiffness at a right angle to the displacement, N/m


@part
def _by_shift(at: NDArray[np.int64], by: Array, column: int, unknown: int, sign: float) -> int:
    """Set the derivatives by two unknowns that shift the displacement directly; return the next column."""
    at[column], at[column + 1] = unknown, unknown + 1
    by[0, column], by[1, column] = sign, 0.0
    by[0, column + 1], by[1, column + 1] = 0.0, sign
    return column + 2


@part
def displacement(
    assembly: Assembly, joint: np.record, theta: float, q: Array, at: NDArray[np.int64], by: Array
) -> Displacement:
    """Displacement of a joint at crank angle θ and unknowns q, computed from small terms, without cancellation.

    Parameters
    ----------
    at, by
        Overwritten with the indices of the unknowns that move it, shape (`UNKNOWNS`,), and its derivatives by them,
        shape (2, `UNKNOWNS`).
    """
    outer, inner = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.inner)]
    seat = assembly.bodies[int(joint.seat)]
    y = q[outer.rotation] if outer.rotation >= 0 else 0.0
    x = q[seat.rotation] if seat.rotation >= 0 else 0.0
    outer_angle, inner_angle = outer.rate * theta + y, seat.rate * theta + x
    co, so, ci, si = math.cos(outer_angle), math.sin(outer_angle), math.cos(inner_angle), math.sin(inner_angle)
    px, py = joint.place_x, joint.place_y
    dx = co * joint.outer_x - so * joint.outer_y - ci * joint.inner_x + si * joint.inner_y
    dy = so * joint.outer_x + co * joint.outer_y - si * joint.inner_x - ci * joint.inner_y
    if px != 0.0 or py != 0.0:
        # Both places rotated; R(γ + y) p - R(γ + x) p as a rotation about their mean.
        turn, mean = 2.0 * math.sin(0.5 * (y - x)), seat.rate * theta + 0.5 * (x + y)
        cm, sm = math.cos(mean), math.sin(mean)
        dx += turn * (-sm * px - cm * py)
        dy += turn * (cm * px - sm * py)
    hx, hy, ax, ay = px + joint.outer_x, py + joint.outer_y, px + joint.inner_x, py + joint.inner_y
    hx, hy, ax, ay = co * hx - so * hy, so * hx + co * hy, ci * ax - si * ay, si * ax + ci * ay

    count = 0
    # A crank in the body that carries it is displaced by its own shift alone.
    carried = inner.on == joint.outer
    if outer.shift >= 0 and not carried:
        dx, dy = dx + q[outer.shift], dy + q[outer.shift + 1]
        count = _by_shift(at, by, count, outer.shift, 1.0)
    if inner.shift >= 0:
        dx, dy = dx - q[inner.shift], dy - q[inner.shift + 1]
        count = _by_shift(at, by, count, inner.shift, -1.0)
    if seat.shift >= 0 and joint.seat != joint.inner and not carried:
        dx, dy = dx - q[seat.shift], dy - q[seat.shift + 1]
        count = _by_shift(at, by, count, seat.shift, -1.0)
    if outer.rotation >= 0:
        at[count], by[0, count], by[1, count] = outer.rotation, -hy, hx
        count += 1
    if seat.rotation >= 0:
        at[count], by[0, count], by[1, count] = seat.rotation, ay, -ax
        count += 1

    ox = oy = 0.0
    if joint.eccentricity > 0.0:
        # Ideal eccentric e u(A) minus the actual one (e + de) u(A + dψ).
        half = 2.0 * joint.eccentricity * math.sin(0.5 * joint.phase)
        between = theta + joint.crank_phase + 0.5 * joint.phase
        made = theta + joint.crank_phase + joint.phase
        dx += half * math.sin(between) - joint.throw * math.cos(made)
        dy += -half * math.cos(between) - joint.throw * math.sin(made)
    if joint.reach > 0.0:
        ox, oy = joint.reach * math.cos(theta + joint.crank_phase), joint.reach * math.sin(theta + joint.crank_phase)
    length = math.hypot(ox + dx, oy + dy)
    excess = length
    if joint.reach > 0.0:
        excess = (2.0 * (ox * dx + oy * dy) + dx * dx + dy * dy) / (length + joint.reach)
    nx, ny = ((ox + dx) / length, (oy + dy) / length) if length > 0.0 else (1.0, 0.0)
    return Displacement(nx, ny, length, excess, outer_angle, inner_angle, hx, hy, ax, ay, count)


@part
def reaction(assembly: Assembly, joint: np.record, d: Displacement, centring: float) -> Reaction:
    """Force of a joint, for bearings with that of a centring spring, N/m."""
    force, stiffness = push(assembly.laws[joint.law], d.excess - joint.play)
    if joint.reach == 0.0:
        force, stiffness = force + centring * d.length, stiffness + centring
    return Reaction(force, stiffness, force / d.length if d.length > 0.0 else stiffness)


@part
def stored_energy(assembly: Assembly, joint: np.record, d: Displacement, centring: float) -> float:
    """Energy of a joint, ∫ F dr with the force of `reaction`, J."""
    spring = 0.5 * centring * d.length * d.length if joint.reach == 0.0 else 0.0
    return stored(assembly.laws[joint.law], d.excess - joint.play) + spring


@part
def change(d: Displacement, acting: Reaction, vx: float, vy: float) -> tuple[float, float]:
    """Change of the force that draws the outer body to the inner one if the displacement changes by v."""
    normal = (acting.stiffness - acting.across) * (d.normal_x * vx + d.normal_y * vy)
    return normal * d.normal_x + acting.across * vx, normal * d.normal_y + acting.across * vy


@part
def eccentric(joint: np.record, theta: float) -> tuple[float, float]:
    """Position of a joint's eccentric from its crank's axis, m."""
    throw, angle = joint.eccentricity + joint.throw, theta + joint.crank_phase + joint.phase
    return throw * math.cos(angle), throw * math.sin(angle)


@part
def add_turning(
    assembly: Assembly,
    joint: np.record,
    theta: float,
    d: Displacement,
    acting: Reaction,
    at: NDArray[np.int64],
    by: Array,
    by_angle: Array,
) -> float:
    """Add the derivatives of the balance's equations by θ at fixed unknowns; return that of the joint's energy, N·m."""
    outer, seat = assembly.bodies[int(joint.outer)], assembly.bodies[int(joint.seat)]
    vx = seat.rate * d.inner_y - outer.rate * d.outer_y
    vy = outer.rate * d.outer_x - seat.rate * d.inner_x
    ideal, crank = joint.eccentricity + joint.reach, theta + joint.crank_phase
    if ideal > 0.0:
        ex, ey = eccentric(joint, theta)
        vx, vy = vx + ey - ideal * math.sin(crank), vy - ex + ideal * math.cos(crank)
    gx, gy = change(d, acting, vx, vy)
    for i in range(d.unknowns):
        by_angle[at[i]] += by[0, i] * gx + by[1, i] * gy
    # The lever arms rotate as well.
    if outer.rotation >= 0:
        by_angle[outer.rotation] -= outer.rate * acting.force * (d.normal_x * d.outer_x + d.normal_y * d.outer_y)
    if seat.rotation >= 0:
        by_angle[seat.rotation] += seat.rate * acting.force * (d.normal_x * d.inner_x + d.normal_y * d.inner_y)
    return float(acting.force * (d.normal_x * vx + d.normal_y * vy))
