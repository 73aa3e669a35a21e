"""Tables of the exact contact model, for FMUs that run without it.

One function of crank angle θ and torque T holds everything: the deviation x(θ, T) of the output at rest under load. On
each side of zero torque it is, over t = |T|, the cubic Hermite interpolation of deviations and compliances at chosen
torques, and over θ a periodic cubic B-spline. With the energy at zero torque V_0(θ), 0 where there is play,

    G(θ, T) = ∫_0^T x dT - V_0(θ),    φ_b - φ_a/ratio = ∂G/∂T,    τ_a = -T/ratio - ∂G/∂θ,

so that the torques of both flanges are the derivatives of one elastic energy, T x - G (Legendre), whatever the table's
own error, and no path makes or loses energy. Between the two sides at zero torque lies the play.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import drive_of, slices_needed
from cycloid_fmu.errors.kinds import EACH_SUPPORT, kinds_of
from cycloid_fmu.fmu.constants import LARGEST_LOAD, MOST_LOADS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import play_loads, solve
from cycloid_fmu.surfaces.surface import ErrorSurface, alike

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

ACCURACY = 0.02 / 3600 * math.pi / 180  # rad: what the deviation may err
RANGE_SHARE = 1e-3  # of the transmission error's range over the crank angle, where that is more
_SAMPLES = (16, 128, 1024)  # crank angles a mesh pitch: the fewest, doubled to the most of any drive and of few pitches
_MOST_ANGLES = 200_000  # in all, of more than 128 a mesh pitch
_SHARE = 1.1  # of the allowed error that a cell between loads may have in its middle
_NEIGHBOURS, _REACHES = 5, (1.0, 0.5, 0.25)  # places drawn around each of the worst probes, and how far: cells
_WORST = 200  # probes that tell whether loads or crank angles are too few
_DIRECTIONS = (1.0, -1.0)
_LIKE = 512  # probes that are solved one after the other
_SPREAD = 1000  # random crank angles at which the loads are chosen
_FIRST_SLOPE = 0.125  # of the first torque: where the slope at zero load is taken, which Hertz's logarithm has infinite
# Contact count and pressure are told, nothing follows from them: their crank angles are the fewest of a mesh pitch.
_TOLD_LOADS = 32  # at most
_PRESSURE_STEP = 4e-3  # of the largest pressure's square
_STEPS = 4  # of the stored deviation, and of what a stored compliance adds to it, in what it may err
_COMPLIANCE_SHARE = 0.04  # largest step of the stored compliance, of its mean
PROBES = 20000  # random crank angles and torques at which the finished tables are held against the model


@dataclass(frozen=True)
class Side:
    """One direction of torque; mirrored, so that everything grows with the load.

    Attributes
    ----------
    load
        |T| at the nodes, ascending from 0, shape (loads,), N·m.
    deviation, compliance
        Spline coefficients over the crank angle of the deviation times the direction (rad) and of its derivative by
        the load (rad/(N·m)), shape (loads, angles).
    told_load
        Some of the loads, from the first to the last, shape (told loads,), N·m.
    contact_count
        Pins in contact at those and at some of the nodes, shape (told loads, told angles).
    pressure
        Spline coefficients of the largest contact pressure's square there, shape (told loads, told angles), Pa²:
        force, so nearly linear in the load.
    steps
        What deviation, compliance and pressure of each load are whole multiples of.
    """

    load: Array
    deviation: Array
    compliance: Array
    told_load: Array
    contact_count: NDArray[np.uint8]
    pressure: Array
    steps: tuple[Array, Array, Array]


@dataclass(frozen=True)
class Tables:
    """A drive as tables over crank angle and torque.

    Attributes
    ----------
    ratio
        φ_a/φ_b of the ideal drive.
    period
        Crank angle after which all repeats, rad; the nodes divide it evenly.
    positive, negative
        The two directions of torque.
    rest_torque
        Spline coefficients of the crank's torque at zero load, which interference gives it, shape (angles,), N·m.
    allowed
        What the deviation may err, rad.
    largest_error
        What the deviation was found to err by at random crank angles and torques, and ever closer around those where
        it errs most, rad.
    """

    ratio: float
    period: float
    positive: Side
    negative: Side
    rest_torque: Array
    allowed: float
    largest_error: float = math.nan

    @property
    def told(self) -> str:
        """What an FMU's description says of its tables."""
        largest = self.largest_error * 648000 / math.pi
        return f"from tables up to {self.positive.load[-1]:.4g} N.m that err by at most {largest:.3f} arcsec"


def mesh_pitches(pair: Pair, surface: ErrorSurface) -> int:
    """Return after how many mesh pitches all repeats: 1 where all parts are alike, up to z_c z_p of unequal ones.

    Cranks or output rollers stand anew, as teeth do, after z_c over what divides both their count and z_c.
    """
    teeth_alike, pins_alike = alike(surface)
    turn = 1 if teeth_alike else pair.gear_teeth
    if teeth_alike and pair.supports is not None:
        turn = pair.gear_teeth // (math.gcd(pair.gear_teeth, pair.supports.count) if _evenly_held(surface) else 1)
    return (1 if pins_alike else pair.pins) * turn


def _evenly_held(surface: ErrorSurface) -> bool:
    """Whether cranks or output rollers, their eccentrics and holes have no errors, and so are alike."""
    kinds = kinds_of(surface.pair).items()
    return not any(np.any(surface.errors[name]) for name, kind in kinds if EACH_SUPPORT.keys() & kind.displaces)


class _Solved(NamedTuple):
    """The exact model at given crank angles, mirrored for one direction: shapes (loads, angles)."""

    deviation: Array32
    compliance: Array32
    pressure: Array32
    contact_count: Array32


def _solved(
    pair: Pair,
    surface: ErrorSurface,
    direction: float,
    loads: Array,
    angles: Array,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> _Solved:
    """Solve the model at loads, the first of which may be 0: the end of the play, or the rest without one."""
    slices = slices_needed(surface)
    parts = []
    for k, load in enumerate(loads):
        signed = direction * float(load)
        one = solve(pair, surface, [signed], angles, slices, with_play=load == 0.0, workers=workers, progress=progress)
        x, stiffness = direction * one.transmission_error[0], one.torsional_stiffness[0]
        if load == 0.0:
            free = one.interference == 0.0
            end = direction * (one.play_high if direction > 0.0 else one.play_low)
            x = np.where(free, end, x)
            if free.any():
                # On bearings the play is where the tangent at the first load ends.
                share = _FIRST_SLOPE if pair.supports is None else 1.0
                near = solve(
                    pair, surface, [direction * share * float(loads[k + 1])], angles, slices, with_play=False,
                    workers=workers,
                )  # fmt: skip
                stiffness = np.where(free, near.torsional_stiffness[0], stiffness)
        parts.append(
            (
                x,
                1.0 / stiffness,
                np.square(one.max_contact_pressure[0]),
                np.minimum(one.contact_count[0], 255),
            )
        )
    # Far finer than what tables err; a drive whose pins and teeth all differ takes a gigabyte otherwise.
    return _Solved(*(np.array(p, dtype=np.float32) for p in zip(*parts, strict=True)))


def _hermite(
    share: float | Array, width: float | Array, deviation: Sequence[Array] | Array32,
    compliance: Sequence[Array] | Array32,
) -> Array:  # fmt: skip
    """Hermite's interpolation between the values and slopes at both ends of a cell, at a share (0 to 1) of it."""
    s, h = share, width
    value = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * deviation[0] + (3.0 - 2.0 * s) * s * s * deviation[1]
    return np.asarray(value + h * s * (1.0 - s) ** 2 * compliance[0] + h * s * s * (s - 1.0) * compliance[1])


def _middle(low: float, high: float) -> float:
    return math.sqrt(low * high) if low > 0.0 else 0.25 * high


def _chosen_loads(
    pair: Pair, surface: ErrorSurface, direction: float, largest: float, angles: Array, allowed: float
) -> Array:
    """Return loads between which Hermite's interpolation errs by no more than allowed: cells are halved until then."""

    def at(load: float, following: float) -> tuple[Array, Array]:
        one = _solved(pair, surface, direction, np.array([load, following] if load == 0.0 else [load]), angles)
        return one.deviation[0], one.compliance[0]

    def halved(low: float, high: float) -> tuple[float, float, float, float]:
        """How much a cell's middle errs, below zero for the heap; and the cell."""
        middle = _middle(low, high)
        known[middle] = at(middle, high)
        ends = zip(known[low], known[high], strict=True)
        guess = _hermite((middle - low) / (high - low), high - low, *ends)
        return -float(np.abs(guess - known[middle][0]).max()), low, middle, high

    loads = [0.0, 0.01 * largest, 0.1 * largest, largest]
    if pair.supports is not None:
        loads.insert(1, play_loads(pair)[1])
    known = {load: at(load, loads[1]) for load in loads}
    # On bearings the first cell is a tangent, which is exact.
    cells = [halved(low, high) for low, high in itertools.pairwise(loads) if low > 0.0 or pair.supports is None]
    heapq.heapify(cells)
    while -cells[0][0] > allowed and len(loads) < MOST_LOADS:
        _, low, middle, high = heapq.heappop(cells)
        loads.append(middle)
        if low == 0.0:
            known[0.0] = at(0.0, middle)
        for cell in ((low, middle), (middle, high)):
            heapq.heappush(cells, halved(*cell))
    return np.array(sorted(loads))


def _joined(parts: Sequence[_Solved], order: NDArray[np.int64], axis: int) -> _Solved:
    """Put loads (axis 0) or crank angles (axis 1) solved one after another in their order."""
    channels = zip(*parts, strict=True)
    return _Solved(*(np.take(np.concatenate(channel, axis), order, axis) for channel in channels))


def _with_angles(coarse: _Solved, between: _Solved) -> _Solved:
    """Put the crank angles midway after those before them."""
    return _joined([coarse, between], np.arange(2 * coarse.deviation.shape[1]).reshape(2, -1).T.ravel(), 1)


def _with_loads(kept: _Solved, kept_loads: Array, solved: _Solved, loads: Array) -> _Solved:
    """Put loads among those that are kept."""
    return _joined([kept, solved], np.argsort(np.append(kept_loads, loads)), 0)


def _coefficients(values: Array | Array32) -> Array:
    """Coefficients of the periodic cubic B-spline through values along the last axis."""
    return np.asarray(ndimage.spline_filter1d(values, order=3, axis=-1, mode="grid-wrap"))


def _side(loads: Array, exact: _Solved, allowed: float, told: int) -> Side:
    """Turn nodes into coefficients that are monotone in the load for every crank angle, rounded as they are stored.

    Where the coefficients satisfy Fritsch and Carlson's condition (SIAM J. Numer. Anal. 17 (1980) 238), every spline
    between them does, for a B-spline's weights are positive. Count and pressure are kept at every `told`th node.
    """
    some = np.unique(np.round(np.linspace(0, loads.size - 1, _TOLD_LOADS)).astype(int))
    square, count = exact.pressure[some, ::told], exact.contact_count[some, ::told]
    h = np.diff(loads)
    widest = np.maximum(np.append(h[:1], h), np.append(h, h[-1:]))
    steps = (
        np.full(loads.size, allowed / _STEPS),
        np.minimum(4.0 * allowed / _STEPS / widest, _COMPLIANCE_SHARE * np.abs(exact.compliance).mean(axis=1)),
        _PRESSURE_STEP * np.maximum(square.max(axis=1), 1.0),
    )  # fmt: skip
    fine, c_fine, p_fine = (s[:, None] for s in steps)
    x = np.maximum.accumulate(np.round(_coefficients(exact.deviation) / fine), axis=0) * fine
    slope = np.diff(x, axis=0) / h[:, None]
    most = 3.0 * np.minimum(np.vstack([slope[:1], slope]), np.vstack([slope, slope[-1:]]))
    c = np.floor(np.minimum(np.maximum(_coefficients(exact.compliance), 0.0), most) / c_fine) * c_fine
    p = np.maximum(np.round(_coefficients(square) / p_fine), 0.0) * p_fine
    return Side(loads, x, c, loads[some], count.astype(np.uint8), p, steps)


def _rest_torque(pair: Pair, surface: ErrorSurface, angles: Array) -> Array:
    """Crank torque at zero load, where interference presses the contacts; its mean, which is no energy's, is 0."""
    if pair.supports is not None:
        return np.zeros(angles.size)
    slices = slices_needed(surface)
    one = solve(pair, surface, [0.0], angles, slices)
    drive, rows = drive_of(pair, surface, slices), None
    found = np.zeros(angles.size)
    for i in np.flatnonzero(one.interference > 0.0):
        cold = rows is None
        rows = contact.contact_rows(drive) if rows is None else rows
        x, _ = contact.equilibrium(drive, angles[i], 0.0, one.transmission_error[0, i], rows, cold)
        found[i] = contact.crank_side(drive, angles[i], x, rows)[0]
    return np.asarray(found - found.mean())


def _rest_step(rest: Array) -> float:
    return max(1e-6 * float(np.abs(rest).max()), 1e-12)


def compute(
    pair: Pair,
    surface: ErrorSurface,
    *,
    accuracy: float = ACCURACY,
    largest_load: float | None = None,
    workers: int = 1,
    total: Callable[[int], None] = lambda angles: None,
    progress: Callable[[int], None] = lambda angles: None,
) -> Tables:
    """Make the tables of a drive, with as many nodes as an accuracy needs.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.
    accuracy
        What the deviation may err, rad; or `RANGE_SHARE` of its range over the crank angle, where that is more.
    largest_load
        Largest |torque|, N·m; 2.5 times the rated torque where None.
    workers
        Threads.
    total, progress
        Told how many crank angles (times loads) there are to solve, and how many were just finished.

    Raises
    ------
    ValueError
        If the pair states no rated torque and no largest load is given.
    """
    if largest_load is None:
        if pair.rated_torque is None:
            raise ValueError("the pair has no rated_torque, which says how far the tables reach")
        largest_load = LARGEST_LOAD * pair.rated_torque
    g = pair
    pitches = mesh_pitches(pair, surface)
    pitch = 2.0 * math.pi / (g.pins if g.output == "gear" else g.gear_teeth)
    period = pitches * pitch
    random = np.random.default_rng(1)
    spread = np.sort(random.uniform(0.0, period, _SPREAD))
    range_ = float(np.ptp(_solved(pair, surface, 1.0, np.array([0.0, largest_load]), spread).deviation, axis=1).max())
    allowed = max(accuracy, RANGE_SHARE * range_)
    loads = [_chosen_loads(pair, surface, d, largest_load, spread, _SHARE * allowed) for d in _DIRECTIONS]
    samples, most = _SAMPLES[0], max(_SAMPLES[1], min(_SAMPLES[2], _MOST_ANGLES // pitches))
    angles: Array = np.arange(pitches * samples, dtype=float) * (pitch / samples)
    total(angles.size * sum(n.size for n in loads))

    def solved(direction: float, at: Array, crank_angle: Array) -> _Solved:
        return _solved(pair, surface, direction, at, crank_angle, workers, progress)

    exact = [solved(d, n, angles) for d, n in zip(_DIRECTIONS, loads, strict=True)]
    probed, drawn = _Probed(np.empty(0), np.empty(0), np.empty(0)), 0
    while True:
        tables = _assembled(pair, surface, period, loads, exact, angles, allowed)
        off = _off(tables, probed)
        if off.size == 0 or np.abs(off).max() <= allowed:
            # Held against places that nothing was chosen by; where they find more, they are chosen by too.
            drawn += 1
            fresh = _probed(pair, surface, *_places(period, largest_load, PROBES, drawn), workers)
            probed = _together(probed, _around_the_worst(tables, pair, surface, fresh, pitch / samples, drawn))
            off = _off(tables, probed)
            if np.abs(off).max() <= allowed:
                break
        further, by_angle = _missing_loads(pair, surface, loads, probed, off, allowed)
        if by_angle and 2 * samples <= most:
            samples *= 2
            angles = np.arange(pitches * samples, dtype=float) * (pitch / samples)
            total(angles[1::2].size * sum(n.size for n in loads))
            exact = [
                _with_angles(one, solved(d, n, angles[1::2]))
                for one, d, n in zip(exact, _DIRECTIONS, loads, strict=True)
            ]
        elif (
            any(n.size for n in further)
            and max(a.size + b.size for a, b in zip(loads, further, strict=True)) <= MOST_LOADS
        ):
            total(angles.size * sum(n.size for n in further))
            for k, direction in enumerate(_DIRECTIONS):
                if further[k].size:
                    # The slope at zero load is taken on the way to the first load.
                    anew = int(further[k][0] < loads[k][1])
                    more = np.append(loads[k][:anew], further[k])
                    kept = _Solved(*(channel[anew:] for channel in exact[k]))
                    exact[k] = _with_loads(kept, loads[k][anew:], solved(direction, more, angles), more)
                    loads[k] = np.union1d(loads[k], more)
        else:
            break
    return dataclasses.replace(tables, largest_error=float(np.abs(off).max()))


def _assembled(
    pair: Pair, surface: ErrorSurface, period: float, loads: Sequence[Array], exact: Sequence[_Solved], angles: Array,
    allowed: float,
) -> Tables:  # fmt: skip
    told = angles.size // (mesh_pitches(pair, surface) * _SAMPLES[0])
    made = [_side(n, one, allowed, told) for n, one in zip(loads, exact, strict=True)]
    rest = _coefficients(_rest_torque(pair, surface, angles))
    rest_step = _rest_step(rest)
    # Where there is hardly any play the splines of its two ends must not cross.
    made[1].deviation[0] = np.maximum(made[1].deviation[0], -made[0].deviation[0])
    np.maximum.accumulate(made[1].deviation, axis=0, out=made[1].deviation)
    return Tables(pair.ratio, period, made[0], made[1], np.round(rest / rest_step) * rest_step, allowed)


def _missing_loads(
    pair: Pair, surface: ErrorSurface, loads: Sequence[Array], probed: _Probed, off: Array, allowed: float
) -> tuple[list[Array], bool]:
    """Return the middles of the cells that are too wide for what tables err by, and whether angles are too wide too.

    Where exact nodes at the probe's own crank angle err by half as much, the load's cell is to blame.
    """
    worst = np.argsort(-np.abs(off))[: min(int(np.sum(np.abs(off) > allowed)), _WORST)]
    further: list[set[float]] = [set() for _ in loads]
    by_angle = False
    for i in worst:
        side = int(probed.torque[i] < 0.0)
        direction, load = _DIRECTIONS[side], abs(float(probed.torque[i]))
        j = int(np.clip(np.searchsorted(loads[side], load) - 1, 0, loads[side].size - 2))
        low, high = (float(n) for n in loads[side][j : j + 2])
        ends = _solved(pair, surface, direction, np.array([low, high]), probed.crank_angle[i : i + 1])
        found = float(_hermite((load - low) / (high - low), high - low, ends.deviation, ends.compliance)[0])
        if abs(found - direction * probed.exact[i]) > 0.5 * abs(off[i]):
            further[side].add(_middle(low, high))
        else:
            by_angle = True
    return [np.array(sorted(middles)) for middles in further], by_angle


def deviation(tables: Tables, crank_angle: ArrayLike, torque: ArrayLike) -> Array:
    """Interpolate the deviation as the native FMU does, in single precision as that keeps it.

    Parameters
    ----------
    crank_angle, torque
        Arrays of one shape, rad and N·m, the torque within the tables and other than 0.

    Returns
    -------
    deviation
        Of the output from its ideal place, rad, of that shape.
    """
    theta, signed = (np.asarray(v, dtype=float) for v in (crank_angle, torque))
    angles = tables.rest_torque.size
    at = theta / tables.period % 1.0 * angles
    first = np.minimum(at.astype(int), angles - 1)
    s = at - first
    weights = np.array([(1.0 - s) ** 3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 1.0 + 3.0 * s + 3.0 * s**2 - 3.0 * s**3, s**3])
    nodes, found = (first + np.arange(-1, 3).reshape(-1, *[1] * theta.ndim)) % angles, np.empty(theta.shape)
    for side, direction in ((tables.positive, 1.0), (tables.negative, -1.0)):
        here = signed * direction > 0.0
        load, among, weight = np.abs(signed[here]), nodes[:, here], weights[:, here] / 6.0
        j = np.clip(np.searchsorted(side.load, load, "right") - 1, 0, side.load.size - 2)
        width = side.load[j + 1] - side.load[j]
        ends = (
            [np.sum(weight * values[row, among].astype(np.float32), axis=0) for row in (j, j + 1)]
            for values in (side.deviation, side.compliance)
        )
        found[here] = direction * _hermite((load - side.load[j]) / width, width, *ends)
    return found


def _off(tables: Tables, probed: _Probed) -> Array:
    """What the tables err by, rad."""
    return deviation(tables, probed.crank_angle, probed.torque) - probed.exact


class _Probed(NamedTuple):
    """The exact model's deviation (rad) at crank angles and torques, each of shape (probes,)."""

    crank_angle: Array
    torque: Array
    exact: Array


def _places(period: float, largest: float, probes: int, seed: int) -> tuple[Array, Array]:
    """Random crank angles, and torques evenly and evenly in the logarithm."""
    random = np.random.default_rng(seed)
    size = np.where(
        random.random(probes) < 0.5, random.uniform(0.0, 1.0, probes), 10.0 ** random.uniform(-4.0, 0.0, probes)
    )  # fmt: skip
    torque = largest * size * random.choice([-1.0, 1.0], probes)
    return np.sort(random.uniform(0.0, period, probes)), torque


def _around_the_worst(
    tables: Tables, pair: Pair, surface: ErrorSurface, probed: _Probed, spacing: float, seed: int
) -> _Probed:
    """Add places ever closer around those where tables err most: the largest errors are narrower than probes lie."""
    random, found = np.random.default_rng(seed), probed
    largest = min(tables.positive.load[-1], tables.negative.load[-1])
    for reach in _REACHES:
        worst = np.repeat(np.argsort(-np.abs(_off(tables, found)))[:_WORST], _NEIGHBOURS)
        theta = found.crank_angle[worst] + reach * spacing * random.uniform(-1.0, 1.0, worst.size)
        torque = found.torque[worst] * (1.0 + 0.1 * reach * random.uniform(-1.0, 1.0, worst.size))
        near = _probed(pair, surface, np.mod(theta, tables.period), np.clip(torque, -largest, largest))
        found = _together(found, near)
    return found


def _together(*parts: _Probed) -> _Probed:
    return _Probed(*(np.concatenate(channel, axis=-1) for channel in zip(*parts, strict=True)))


def _probed(pair: Pair, surface: ErrorSurface, theta: Array, torque: Array, workers: int = 1) -> _Probed:
    if pair.supports is not None:
        # What is nearer to no torque lies on a tangent.
        torque = np.copysign(np.maximum(np.abs(torque), play_loads(pair)[1]), torque)
        # A place is soon found from one near by under a like torque.
        rank = np.argsort(np.argsort(torque)) // _LIKE
        order = np.lexsort((theta, rank))
        theta, torque = theta[order], torque[order]
        found = solve(pair, surface, torque[None], theta, slices_needed(surface), with_play=False, workers=workers)
        return _Probed(theta, torque, found.transmission_error[0])
    drive = drive_of(pair, surface, slices_needed(surface))
    rows = contact.contact_rows(drive)
    exact = [contact.equilibrium(drive, *place, 0.0, rows, True)[0] for place in zip(theta, torque, strict=True)]
    return _Probed(theta, torque, np.array(exact))
