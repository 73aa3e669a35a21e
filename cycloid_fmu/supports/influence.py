"""Influence of a drive's elastic bodies between the ports under load, at any crank angle (docs/theory/bodies.md).

The ports of a drive, each one slot of its influence matrix: each pin on each disc; each turning arm, by its sectors or
by both components; each output roller in each disc; both components of each crank in the carrier. Turning arms and
cranks are fixed in axes that turn with the ideal rotation of the output, pins and output rollers move over flanks and
holes. So what is between the fixed ones is the same for all crank angles, and the rest is interpolated for those pins
and rollers that are asked for (`DiscInfluence` says how).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import NDArray

from cycloid_fmu.bodies.matrices import BodyMatrices
from cycloid_fmu.bodies.outline import SECTORS, clocking, true_flank
from cycloid_fmu.contact import Array, compiled
from cycloid_fmu.contact.foot import path_curvature
from cycloid_fmu.contact.lanes import on_stack
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import arc_parts

if TYPE_CHECKING:
    from cycloid_fmu.bodies.disc import DiscInfluence, Track

Indices = NDArray[np.int64]
_COUPLING = ("pin", "ring", "crank", "output_pin", "carrier")  # bodies by which discs displace each other's ports
SPREAD = 12  # forces of both components at six places stand for that of a moving port
_ALONG = np.dtype((np.record, [("value", np.float64, (SPREAD,)), ("other", np.float64, (SPREAD,))]))
_ARCS = 256  # pieces of the spline of the arc length over a tooth


class Influence(NamedTuple):
    """Influence matrices of a drive's bodies as arrays, SI.

    Attributes
    ----------
    between
        Of each disc: displacements of both components of the places on flank and holes, and of the turning arms' ports,
        shape (discs, ports, ports); size 0 if the discs are rigid. The first six places of a curve follow its last.
    own
        Cubics of the compliance of a place by itself, along x, both and y, shape (discs, curves, places, 4, 3); curve 0
        is the flank, the others are holes.
    curve_offset, curve_first, curve_points
        First port of each curve, its first place in steps from the curve's origin, and its number of places, shape
        (discs, curves).
    arms_offset
        First port of a disc's turning arms, shape (discs,).
    arc
        Cubics of the arc length over a tooth in its parts, less what is proportional to the angle, shape (pieces, 4).
    clocking
        Angle of each disc's tooth 0 from its x-axis, rad.
    fixed
        Between all slots, what does not depend on the crank angle, shape (slots, slots).
    of_arms
        The part of it that cranks have, shape (ports of turning arms, ports of turning arms); size 0 if they are rigid.
    pin, output_pin
        Between the discs, shape (discs, discs); size 0 if they are rigid.
    ring
        Between both components of the pins' seats, shape (2 pins, 2 pins); size 0 if it is rigid.
    circle_radius, eccentricity, teeth
        Of the flank as drawn, without modification.
    arms_slot, rollers_slot
        First slot of the turning arms and of the output rollers.
    sectors
        Slots of each turning arm.
    arms, rollers
        Turning arms, and output rollers, of each disc.
    largest
        Largest compliance of a moving slot by itself, or somewhat more, m/N.
    coupled
        Whether discs displace each other's ports.
    """

    between: Array
    own: Array
    curve_offset: Indices
    curve_first: Array
    curve_points: Indices
    arms_offset: Indices
    arc: Array
    clocking: Array
    fixed: Array
    of_arms: Array
    pin: Array
    output_pin: Array
    ring: Array
    circle_radius: float
    eccentricity: float
    teeth: int
    arms_slot: int
    rollers_slot: int
    sectors: int
    arms: int
    rollers: int
    largest: float
    coupled: bool


class Moving(NamedTuple):
    """Influence at one crank angle, as far as it was asked for; kernels overwrite it.

    Attributes
    ----------
    matrix
        Between all slots, shape (slots, slots), m/N: rows of the known slots, and between fixed ones (`entry`).
    known
        Slots in the order in which they became known, shape (slots,).
    is_known
        Whether a moving slot is known, shape (slots,).
    known_count, angle
        Number of known slots, shape (1,), and the crank angle, shape (1,), rad; NaN without one.
    start
        First port of the places that stand for a moving slot, shape (slots,).
    spread, rate
        Forces there that stand for its unit force, shape (slots, `SPREAD`), and their derivatives by the crank angle.
    direction
        Of the force on the disc, in the disc's axes, and its derivative, shape (slots, 4).
    own
        Its own compliance, m/N, and its derivative, shape (slots, 2).
    loaded, loaded_rate, sums
        `spread` and `rate` times its force, shape (slots, `SPREAD`), and sums of rows, shape (ports of a disc's arms,):
        of `rate_of_energy`.
    """

    matrix: Array
    known: Indices
    is_known: NDArray[np.bool_]
    known_count: Indices
    angle: Array
    start: Indices
    spread: Array
    rate: Array
    direction: Array
    own: Array
    loaded: Array
    loaded_rate: Array
    sums: Array


def moving_of(influence: Influence) -> Moving:
    """Return the influence without a crank angle."""
    slots = len(influence.fixed)
    return Moving(
        influence.fixed.copy(),
        np.zeros(slots, np.int64),
        np.zeros(slots, np.bool_),
        np.zeros(1, np.int64),
        np.full(1, math.nan),
        np.zeros(slots, np.int64),
        np.zeros((slots, SPREAD)),
        np.zeros((slots, SPREAD)),
        np.zeros((slots, 4)),
        np.zeros((slots, 2)),
        np.zeros((slots, SPREAD)),
        np.zeros((slots, SPREAD)),
        np.zeros(influence.arms * influence.sectors),
    )


def influence_of(pair: Pair, matrices: BodyMatrices) -> Influence:
    """Return the influence of a drive's bodies for the kernels.

    Parameters
    ----------
    pair
        The pair as drawn, with supports.
    matrices
        Of its bodies, `cycloid_fmu.bodies.matrices.matrices_of`.
    """
    supports = pair.supports
    assert supports is not None
    cranks = supports.kind == "cranks"
    arms, rollers = supports.cranks, 0 if cranks else supports.count
    by_sector = bool(matrices.discs) and supports.turning_arm.rollers is not None
    sectors = SECTORS if by_sector else 2
    arms_slot = pair.discs * pair.pins
    rollers_slot = arms_slot + pair.discs * arms * sectors
    slots = rollers_slot + pair.discs * rollers + 2 * arms
    discs = [_ports_of(disc, "sector" if by_sector else "bore") for disc in matrices.discs]
    curves = 1 + rollers
    between, own = _stacked(discs, curves)
    fixed = np.zeros((slots, slots))
    for j, disc in enumerate(discs):
        first, held = arms_slot + j * arms * sectors, slice(disc.arms_offset, disc.arms_offset + arms * sectors)
        fixed[first : first + arms * sectors, first : first + arms * sectors] = disc.between[held, held]
    by_cranks = _by_cranks(pair, matrices.crank, arms, sectors)
    if by_cranks.size > 0:
        fixed[arms_slot:rollers_slot, arms_slot:rollers_slot] += by_cranks
    if matrices.carrier is not None:
        fixed[-2 * arms :, -2 * arms :] = matrices.carrier
    empty = np.zeros((0, 0))
    shape = (len(discs), curves)
    return Influence(
        between=between,
        own=own,
        curve_offset=np.array([disc.offsets for disc in discs], np.int64).reshape(shape),
        curve_first=np.array([disc.first for disc in discs], float).reshape(shape),
        curve_points=np.array([disc.points for disc in discs], np.int64).reshape(shape),
        arms_offset=np.array([disc.arms_offset for disc in discs], np.int64),
        arc=_arc_over_tooth(pair),
        clocking=np.array([clocking(pair, disc) for disc in range(pair.discs)]),
        fixed=fixed,
        of_arms=by_cranks,
        pin=empty if matrices.pin is None else matrices.pin,
        output_pin=empty.copy() if matrices.output_pin is None else matrices.output_pin,
        ring=empty.copy() if matrices.ring is None else np.ascontiguousarray(matrices.ring),
        circle_radius=pair.pin_circle_radius,
        eccentricity=pair.eccentricity,
        teeth=pair.gear_teeth,
        arms_slot=arms_slot,
        rollers_slot=rollers_slot,
        sectors=sectors,
        arms=arms,
        rollers=rollers,
        largest=max((disc.largest for disc in discs), default=0.0) + _largest_of_others(matrices),
        coupled=any(getattr(matrices, name) is not None for name in _COUPLING),
    )


def _stacked(discs: Sequence[_DiscPorts], curves: int) -> tuple[Array, Array]:
    """Return the influence between all discs' ports, and the pins' own along their curves, zero where one ends."""
    ports = max((len(disc.between) for disc in discs), default=0)
    points = max((int(disc.points.max()) for disc in discs), default=0)
    between, own = np.zeros((len(discs), ports, ports)), np.zeros((len(discs), curves, points, 4, 3))
    for j, disc in enumerate(discs):
        between[j, : len(disc.between), : len(disc.between)] = disc.between
        for curve, cubics in enumerate(disc.own):
            own[j, curve, : len(cubics)] = cubics
    return between, own


def _largest_of_others(matrices: BodyMatrices) -> float:
    """Largest compliance of a moving slot by pins, ring and output pins, or somewhat more, m/N."""
    parts = [float(np.abs(part).max()) for part in (matrices.pin, matrices.output_pin) if part is not None]
    parts += [2.0 * float(np.abs(matrices.ring.diagonal()).max())] if matrices.ring is not None else []
    return math.fsum(parts)


def _by_cranks(pair: Pair, crank: Array | None, arms: int, sectors: int) -> Array:
    """Influence of the cranks between all turning arms' ports; size 0 if they are rigid."""
    if crank is None:
        return np.zeros((0, 0))
    angle = 2.0 * np.pi * np.arange(sectors) / (sectors if sectors > 2 else 4)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    of_arms = np.arange(pair.discs * arms * sectors).reshape(pair.discs, arms, sectors)
    between = np.zeros((of_arms.size, of_arms.size))
    for j, k, arm in np.ndindex(pair.discs, pair.discs, arms):
        between[np.ix_(of_arms[j, arm], of_arms[k, arm])] = crank[j, k] * along @ along.T
    return between


class _DiscPorts(NamedTuple):
    """A disc's part of `Influence`."""

    between: Array
    own: list[Array]
    offsets: list[int]
    first: list[float]
    points: Indices
    arms_offset: int
    largest: float


def _ports_of(disc: DiscInfluence, arms: str) -> _DiscPorts:
    """Both components of all places along the curves, six of them twice, and then the ports of the turning arms."""
    matrix, curves = disc.matrix, (disc.flank, *disc.holes)
    rows: list[Array] = []
    offsets, size = [], 0
    for curve in curves:
        offsets.append(size)
        rows.append(_along(curve, len(matrix.compliance)))
        size += len(rows[-1])
    fixed = matrix.of(arms)
    rows.append(np.eye(len(matrix.compliance))[fixed])
    whole = np.concatenate(rows)
    return _DiscPorts(
        whole @ matrix.compliance @ whole.T,
        [_cubics(curve) for curve in curves],
        offsets,
        [curve.first for curve in curves],
        np.array([len(curve.ports) for curve in curves]),
        size,
        1.1 * max(float(np.linalg.norm(curve.own, 2, axis=(1, 2)).max()) for curve in curves),
    )


def _along(curve: Track, ports: int) -> Array:
    """Forces of a matrix's ports that make a unit force along x and y at each place, shape (2 places + 12, ports)."""
    count = len(curve.ports)
    rows = np.zeros((count, 2, ports))
    for n in range(2):
        rows[np.arange(count), :, curve.ports[:, n]] = curve.inverse[:, n, :]
    around = np.arange(count + SPREAD // 2) % count
    return rows[around].reshape(-1, ports)


def _cubics(curve: Track) -> Array:
    """Cubics of a curve's own compliance between its places, shape (places, 4, 3), highest power first."""
    coefficients = np.moveaxis(curve.own_spline.c, 1, 0)  # place, power, component, component
    return np.stack([coefficients[..., 0, 0], coefficients[..., 0, 1], coefficients[..., 1, 1]], axis=-1)


def _arc_over_tooth(pair: Pair) -> Array:
    share = np.arange(_ARCS + 1.0) / _ARCS
    parts = arc_parts(true_flank(pair), share[:-1] * 2.0 * np.pi / pair.gear_teeth) - share[:-1]
    spline = scipy.interpolate.CubicSpline(share * _ARCS, np.append(parts, parts[0]), bc_type="periodic")
    return np.ascontiguousarray(spline.c.T)


@compiled(inline=True)
def _between(block: Array, start: int, spread: Array, start2: int, spread2: Array) -> float:
    along = on_stack(_ALONG)
    for a in range(SPREAD):
        weight = spread[a]
        line = block[start + a, start2 : start2 + SPREAD]
        for b in range(SPREAD):
            along.value[b] += weight * line[b]
    value = 0.0
    for b in range(SPREAD):
        value += along.value[b] * spread2[b]
    return value


@compiled
def _weigh(block: Array, start: int, weights: Array, column: int, out: Array) -> None:
    """Write the sum of `SPREAD` rows of a matrix from `start` on, in the columns from `at` on, by their weights."""
    size = out.size
    for m in range(size):
        out[m] = 0.0
    for a in range(0, SPREAD, 4):
        w0, w1, w2, w3 = weights[a], weights[a + 1], weights[a + 2], weights[a + 3]
        l0, l1 = block[start + a, column : column + size], block[start + a + 1, column : column + size]
        l2, l3 = block[start + a + 2, column : column + size], block[start + a + 3, column : column + size]
        for m in range(size):
            out[m] += w0 * l0[m] + w1 * l1[m] + w2 * l2[m] + w3 * l3[m]


@compiled
def dot(a: Array, b: Array) -> float:
    """Scalar product, in four sums side by side."""
    whole = a.size - a.size % 4
    s0 = s1 = s2 = s3 = 0.0
    for m in range(0, whole, 4):
        s0 += a[m] * b[m]
        s1 += a[m + 1] * b[m + 1]
        s2 += a[m + 2] * b[m + 2]
        s3 += a[m + 3] * b[m + 3]
    for m in range(whole, a.size):
        s0 += a[m] * b[m]
    return (s0 + s1) + (s2 + s3)


@compiled
def _spread(influence: Influence, moving: Moving, slot: int, disc: int, curve: int, position: float, by: float) -> None:
    """Write the forces that stand for a moving slot's, after its direction; `by` is dposition/dθ, in steps."""
    points = influence.curve_points[disc, curve]
    along = position - influence.curve_first[disc, curve]
    along -= math.floor(along / points) * points
    below = math.floor(along)
    share = along - below
    piece = int(below) % points
    start = influence.curve_offset[disc, curve] + 2 * ((piece - 2) % points)
    moving.start[slot] = start
    direction = moving.direction[slot]
    fx, fy, rx, ry = direction[0], direction[1], direction[2], direction[3]
    for n in range(6):
        weight, rate = 1.0, 0.0
        for other in range(6):
            if other != n:
                factor = 1.0 / (n - other)
                rate = (rate * (share + 2.0 - other) + weight) * factor
                weight *= (share + 2.0 - other) * factor
        moving.spread[slot, 2 * n], moving.spread[slot, 2 * n + 1] = weight * fx, weight * fy
        moving.rate[slot, 2 * n] = by * rate * fx + weight * rx
        moving.rate[slot, 2 * n + 1] = by * rate * fy + weight * ry
    cubic = influence.own[disc, curve, piece]
    own = own_rate = 0.0
    for component in range(3):
        value = slope = 0.0
        for power in range(4):
            slope = slope * share + value
            value = value * share + cubic[power, component]
        if component == 0:
            product, product_rate = fx * fx, 2.0 * fx * rx
        elif component == 1:
            product, product_rate = 2.0 * fx * fy, 2.0 * (fx * ry + rx * fy)
        else:
            product, product_rate = fy * fy, 2.0 * fy * ry
        own += value * product
        own_rate += slope * by * product + value * product_rate
    moving.own[slot, 0], moving.own[slot, 1] = own, own_rate


@compiled
def _move_pin(influence: Influence, moving: Moving, slot: int, disc: int, pin: int, crank_angle: float) -> None:
    teeth, pins = influence.teeth, influence.teeth + 1
    discs = influence.clocking.size
    turn = 2.0 * math.pi
    alpha = turn * pin / pins + (crank_angle + turn * disc / discs) / teeth
    pitch = turn / teeth
    tooth = math.floor(alpha / pitch)
    e, R = influence.eccentricity, influence.circle_radius
    c, s = math.cos(teeth * alpha), math.sin(teeth * alpha)
    bx, by = R - e * pins * c, -e * pins * s
    speed = math.sqrt(bx * bx + by * by)
    ca, sa = math.cos(alpha + influence.clocking[disc]), math.sin(alpha + influence.clocking[disc])
    nx, ny = (ca * bx - sa * by) / speed, (sa * bx + ca * by) / speed
    turned = path_curvature(R, e, teeth, bx, speed) * speed / teeth
    direction = moving.direction[slot]
    direction[0], direction[1], direction[2], direction[3] = -nx, -ny, ny * turned, -nx * turned
    if influence.between.size == 0:
        return
    share = (alpha / pitch - tooth) * _ARCS
    piece = min(int(share), _ARCS - 1)
    share -= piece
    cubic = influence.arc[piece]
    value = ((cubic[0] * share + cubic[1]) * share + cubic[2]) * share + cubic[3]
    slope = (3.0 * cubic[0] * share + 2.0 * cubic[1]) * share + cubic[2]
    steps = influence.curve_points[disc, 0] // teeth
    position = (alpha / pitch + value) * steps
    _spread(influence, moving, slot, disc, 0, position, steps * (1.0 + slope * _ARCS) / (pitch * teeth))


@compiled
def _move_roller(influence: Influence, moving: Moving, slot: int, disc: int, roller: int, crank_angle: float) -> None:
    teeth, turn = influence.teeth, 2.0 * math.pi
    # Of −û(A_j) in the disc's axes.
    angle = crank_angle * (1.0 + 1.0 / teeth) + turn * disc / influence.clocking.size + math.pi
    c, s, rate = math.cos(angle), math.sin(angle), 1.0 + 1.0 / teeth
    direction = moving.direction[slot]
    direction[0], direction[1], direction[2], direction[3] = c, s, -s * rate, c * rate
    if influence.between.size > 0:
        points = influence.curve_points[disc, 1 + roller]
        _spread(influence, moving, slot, disc, 1 + roller, angle / turn * points, rate / turn * points)


@compiled
def _disc_of(influence: Influence, slot: int) -> int:
    """Disc of a moving slot."""
    if slot < influence.arms_slot:
        return slot // (influence.teeth + 1)
    return (slot - influence.rollers_slot) // influence.rollers


@compiled
def _of_others(influence: Influence, moving: Moving, slot: int, slot2: int, crank_angle: float, rate: bool) -> float:
    """Influence between two moving slots by other bodies than a disc, m/N, or its derivative by the crank angle."""
    of_pin, of_ring, of_output_pin = parts_of_others(influence, moving, slot, slot2, crank_angle, rate)
    return of_pin + of_ring + of_output_pin


@compiled
def parts_of_others(
    influence: Influence, moving: Moving, slot: int, slot2: int, crank_angle: float, rate: bool
) -> tuple[float, float, float]:
    """Influence between two moving slots by pins, ring and output pins, or its derivative by the crank angle."""
    first, second = moving.direction[slot], moving.direction[slot2]
    if slot < influence.arms_slot and slot2 < influence.arms_slot:
        pins, value, of_pin = influence.teeth + 1, 0.0, 0.0
        pin, pin2 = slot % pins, slot2 % pins
        if influence.pin.size > 0 and pin == pin2:
            cosine = first[0] * second[0] + first[1] * second[1]
            if rate:
                cosine = first[2] * second[0] + first[3] * second[1] + first[0] * second[2] + first[1] * second[3]
            of_pin = influence.pin[slot // pins, slot2 // pins] * cosine
        if influence.ring.size > 0:
            gamma = -crank_angle / influence.teeth
            c, s = math.cos(gamma), math.sin(gamma)
            ax, ay, bx, by = (
                c * first[0] - s * first[1],
                s * first[0] + c * first[1],
                c * second[0] - s * second[1],
                s * second[0] + c * second[1],
            )
            row, column, seats = 2 * pin, 2 * pin2, influence.ring
            if rate:
                turning = -1.0 / influence.teeth
                dax, day = c * first[2] - s * first[3] - turning * ay, s * first[2] + c * first[3] + turning * ax
                dbx, dby = c * second[2] - s * second[3] - turning * by, s * second[2] + c * second[3] + turning * bx
                value += dax * (seats[row, column] * bx + seats[row, column + 1] * by)
                value += day * (seats[row + 1, column] * bx + seats[row + 1, column + 1] * by)
                value += ax * (seats[row, column] * dbx + seats[row, column + 1] * dby)
                value += ay * (seats[row + 1, column] * dbx + seats[row + 1, column + 1] * dby)
            else:
                value += ax * (seats[row, column] * bx + seats[row, column + 1] * by)
                value += ay * (seats[row + 1, column] * bx + seats[row + 1, column + 1] * by)
        return of_pin, value, 0.0
    if slot >= influence.rollers_slot and slot2 >= influence.rollers_slot and influence.output_pin.size > 0:
        roller, roller2 = slot - influence.rollers_slot, slot2 - influence.rollers_slot
        if not rate and roller % influence.rollers == roller2 % influence.rollers:
            disc, disc2 = roller // influence.rollers, roller2 // influence.rollers
            # The angle between two eccentrics.
            cosine = math.cos(2.0 * math.pi * (disc - disc2) / influence.clocking.size)
            return 0.0, 0.0, influence.output_pin[disc, disc2] * cosine
    return 0.0, 0.0, 0.0


@compiled
def turn_to(moving: Moving, crank_angle: float) -> None:
    """Go to a crank angle, where no moving slot is known."""
    if moving.angle[0] == crank_angle:
        return
    moving.angle[0] = crank_angle
    for i in range(moving.known_count[0]):
        moving.is_known[moving.known[i]] = False
    moving.known_count[0] = 0


@compiled
def get_known(influence: Influence, moving: Moving, slot: int) -> None:
    """Have the influence of a moving slot at the crank angle of `turn_to`, with all that are known and the fixed."""
    if moving.is_known[slot]:
        return
    crank_angle = moving.angle[0]
    disc, matrix = _disc_of(influence, slot), moving.matrix
    if slot < influence.arms_slot:
        _move_pin(influence, moving, slot, disc, slot % (influence.teeth + 1), crank_angle)
    else:
        roller = (slot - influence.rollers_slot) % influence.rollers
        _move_roller(influence, moving, slot, disc, roller, crank_angle)
    moving.is_known[slot] = True
    moving.known[moving.known_count[0]] = slot
    moving.known_count[0] += 1
    elastic = influence.between.size > 0
    start, spread, row = moving.start[slot], moving.spread[slot], matrix[slot]
    if elastic:
        block, fixed = influence.between[disc], influence.arms * influence.sectors
        first, column = influence.arms_slot + disc * fixed, influence.arms_offset[disc]
        _weigh(block, start, spread, column, row[first : first + fixed])
    for i in range(moving.known_count[0]):
        other, value = moving.known[i], 0.0
        if influence.coupled:
            value = _of_others(influence, moving, slot, other, crank_angle, False)
        if other == slot:
            value += moving.own[slot, 0]
        elif elastic and _disc_of(influence, other) == disc:
            value += _between(influence.between[disc], start, spread, moving.start[other], moving.spread[other])
        row[other] = matrix[other, slot] = value


@compiled(inline=True)
def entry(influence: Influence, moving: Moving, slot: int, slot2: int) -> float:
    """Influence between two slots, m/N, each fixed or known."""
    if influence.arms_slot <= slot < influence.rollers_slot and not (
        influence.arms_slot <= slot2 < influence.rollers_slot
    ):
        return float(moving.matrix[slot2, slot])
    return float(moving.matrix[slot, slot2])


@compiled
def add_rates(influence: Influence, moving: Moving, force: Array, out: Array) -> None:
    """Add dC/dθ f of all known slots, and of the fixed ones that they move, to `out`, shape (slots,), m.

    `force` has the force of each slot; only known slots, and turning arms, carry any.
    """
    crank_angle, elastic = moving.angle[0], influence.between.size > 0
    fixed = influence.arms * influence.sectors
    for i in range(moving.known_count[0]):
        slot = moving.known[i]
        disc = _disc_of(influence, slot)
        start, rate = moving.start[slot], moving.rate[slot]
        if elastic:
            block, first, column = (
                influence.between[disc],
                influence.arms_slot + disc * fixed,
                influence.arms_offset[disc],
            )
            pressed = force[slot]
            for a in range(SPREAD):
                line, along, weight = block[start + a], 0.0, pressed * rate[a]
                for m in range(fixed):
                    along += line[column + m] * force[first + m]
                    out[first + m] += line[column + m] * weight
                out[slot] += rate[a] * along
        for k in range(moving.known_count[0]):
            other, value = moving.known[k], 0.0
            if force[other] == 0.0:
                continue
            if influence.coupled:
                value = _of_others(influence, moving, slot, other, crank_angle, True)
            if other == slot:
                value += moving.own[slot, 1]
            elif elastic and _disc_of(influence, other) == disc:
                block = influence.between[disc]
                value += _between(block, start, rate, moving.start[other], moving.spread[other])
                value += _between(block, start, moving.spread[slot], moving.start[other], moving.rate[other])
            out[slot] += value * force[other]


@compiled
def rate_of_energy(influence: Influence, moving: Moving, force: Array) -> float:
    """½ fᵀ dC/dθ f, N·m; `force` as in `add_rates`."""
    crank_angle, elastic = moving.angle[0], influence.between.size > 0
    fixed, total = influence.arms * influence.sectors, 0.0
    for i in range(moving.known_count[0]):
        slot = moving.known[i]
        pressed = force[slot]
        if pressed == 0.0:
            continue
        for b in range(SPREAD):
            moving.loaded[slot, b], moving.loaded_rate[slot, b] = (
                pressed * moving.spread[slot, b],
                pressed * moving.rate[slot, b],
            )
        disc, start = _disc_of(influence, slot), moving.start[slot]
        total += 0.5 * moving.own[slot, 1] * pressed * pressed
        if influence.coupled:
            for k in range(moving.known_count[0]):
                other = moving.known[k]
                between = _of_others(influence, moving, slot, other, crank_angle, True)
                total += 0.5 * between * force[other] * pressed
        if elastic:
            block, first, column = (
                influence.between[disc],
                influence.arms_slot + disc * fixed,
                influence.arms_offset[disc],
            )
            _weigh(block, start, moving.rate[slot], column, moving.sums)
            total += pressed * dot(moving.sums, force[first : first + fixed])
            for k in range(i):
                other = moving.known[k]
                if force[other] != 0.0 and _disc_of(influence, other) == disc:
                    total += _rate_between(block, moving, slot, other)
    return total


@compiled(inline=True)
def _rate_between(block: Array, moving: Moving, slot: int, slot2: int) -> float:
    """Derivative of what two loaded slots displace each other by, times their forces."""
    start, start2, along = moving.start[slot], moving.start[slot2], on_stack(_ALONG)
    loaded, rate = moving.loaded[slot], moving.loaded_rate[slot]
    for a in range(SPREAD):
        weight, weight_rate = loaded[a], rate[a]
        line = block[start + a, start2 : start2 + SPREAD]
        for b in range(SPREAD):
            along.value[b] += weight_rate * line[b]
            along.other[b] += weight * line[b]
    value, loaded, rate = 0.0, moving.loaded[slot2], moving.loaded_rate[slot2]
    for b in range(SPREAD):
        value += along.value[b] * loaded[b] + along.other[b] * rate[b]
    return value


@compiled
def write_shares(influence: Influence, moving: Moving, force: Array, other_force: Array, out: Array) -> None:
    """Write fᵀC_B g of disc, pin, ring, crank, output pin and carrier, N·m; `force` and the other as in `add_rates`."""
    for part in range(out.size):
        out[part] = 0.0
    first, last, whole = influence.arms_slot, influence.rollers_slot, 0.0
    for i in range(moving.known_count[0]):
        slot = moving.known[i]
        if force[slot] == 0.0 and other_force[slot] == 0.0:
            continue
        row = moving.matrix[slot]
        for k in range(moving.known_count[0]):
            other = moving.known[k]
            product = force[slot] * other_force[other]
            if product != 0.0:
                of_pin, of_ring, of_output_pin = parts_of_others(influence, moving, slot, other, moving.angle[0], False)
                whole += product * row[other]
                out[1], out[2] = out[1] + product * of_pin, out[2] + product * of_ring
                out[4] += product * of_output_pin
        whole += force[slot] * dot(row[first:last], other_force[first:last])
        whole += other_force[slot] * dot(row[first:last], force[first:last])
    for slot in range(first, last):
        if force[slot] != 0.0:
            whole += force[slot] * dot(influence.fixed[slot, first:last], other_force[first:last])
            if influence.of_arms.size > 0:
                out[3] += force[slot] * dot(influence.of_arms[slot - first], other_force[first:last])
    for slot in range(len(influence.fixed) - 2 * influence.arms, len(influence.fixed)):
        out[5] += force[slot] * dot(influence.fixed[slot], other_force)
    out[0] = whole - out[1] - out[2] - out[3] - out[4]
