"""Tables of the exact contact model, for FMUs that run without it.

Everything follows from one function of crank angle θ and torque T: the deviation x(θ, T) of the output at rest under
load. On each side of zero torque it is, over t = |T|, the cubic Hermite interpolation of deviations and compliances at
chosen torques, and over θ a periodic cubic B-spline. With the energy at zero torque V_0(θ), 0 where there is play,

    G(θ, T) = ∫_0^T x dT - V_0(θ),    φ_b - φ_a/ratio = ∂G/∂T,    τ_a = -T/ratio - ∂G/∂θ,

so that the torques of both flanges are the derivatives of one elastic energy, T x - G (Legendre), for any error of the
table, and no path generates or loses energy. Between the two sides at zero torque is the play.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import drive_of, slices_needed
from cycloid_fmu.edge import InputError
from cycloid_fmu.errors.kinds import EACH_SUPPORT, kinds_of
from cycloid_fmu.fmu.constants import LARGEST_LOAD, LEAST_COMPLIANCE, MOST_LOADS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import play_loads, solve
from cycloid_fmu.surfaces.surface import ErrorSurface, alike

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

ACCURACY = 0.02 / 3600 * math.pi / 180  # rad: what the deviation may err
RANGE_SHARE = 1e-3  # of the transmission error's range over the crank angle, where that is more
# Where a pin begins to carry, stiffness and speed all but jump, and no grid follows a jump: what they may err is said
# of most states, and of all in the mean of squares.
STIFFNESS_SHARE = 0.02  # of itself: what the stiffness may err in `MOST_STATES`
SPEED_SHARE = 0.2  # of its own: rms that the ripple of the output's speed may err by
MOST_STATES = 0.95
TOLD_FROM = 0.01  # of the largest torque: where these hold, and what is told of them
_MOST_VALUES = 7_000_000  # deviations and compliances that finer stiffness and speed may make: 14 MB
_SAMPLES = (16, 128, 1024)  # crank angles a mesh pitch: the fewest, doubled to the most of any drive and of few pitches
_MOST_ANGLES = 200_000  # in all, of more than 128 a mesh pitch
_SHARE = 0.7  # of the allowed error that a cell between loads may have in its middle
_NEIGHBOURS, _REACHES = 5, (1.0, 0.5, 0.25)  # places drawn around each of the worst probes, and how far: cells
_BLAMED = 2 / 3  # of what stiffness and speed err: the cells that make so much of it are halved
_WORST = 200  # probes that tell whether loads or crank angles are too few
_DIRECTIONS = (1.0, -1.0)
_LIKE = 512  # probes that are solved one after the other
_SPREAD = 1000  # random crank angles at which the loads are chosen
_FIRST_SLOPE = 0.125  # of the first torque: where the slope at zero load is taken, which Hertz's logarithm has infinite
# Contact count and pressure are told, nothing follows from them: their crank angles are the fewest of a mesh pitch.
_TOLD_LOADS = 24  # at most
_PRESSURE_STEP = 2.5e-3  # of the largest pressure's square
_FAR = (4.0, 2.0, 1.2)  # times the last load: the first at which contacts can balance it ends the cell beyond
_STEPS = 16  # of the stored deviation, and of what a stored compliance adds to it, in what it may err
_COMPLIANCE_SHARE = 0.005  # largest step of the stored compliance, of its mean
_MOST_STEPS = 65000  # of any channel, in 16 bits
PROBES = 20000  # random crank angles and torques at which the finished tables are held against the model


@dataclass(frozen=True)
class Side:
    """One direction of torque; mirrored, so that everything increases with the load.

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
        Quantisation steps of deviation, compliance and pressure of each load.
    far
        Load beyond the last, N·m, and coefficients of the deviation and of the compliance there, each of shape
        (angles,): in between is a last cell, of no stated accuracy, and beyond it the tangent continues.
    """

    load: Array
    deviation: Array
    compliance: Array
    told_load: Array
    contact_count: NDArray[np.uint8]
    pressure: Array
    steps: tuple[Array, Array, Array]
    far: tuple[float, Array, Array]


class States(NamedTuple):
    """State of a drive at crank angles and torques, arrays of one shape; NaN where the exact model has no value.

    Attributes
    ----------
    deviation
        Of the output from its ideal place, rad.
    stiffness
        N·m/rad.
    rate
        The deviation's change with the crank angle at constant torque, dφ_b/dθ - 1/ratio.
    crank_torque
        N·m.
    pressure
        The largest, Pa.
    """

    deviation: Array
    stiffness: Array
    rate: Array
    crank_torque: Array
    pressure: Array


class Errors(NamedTuple):
    """Errors of tables at random crank angles and torques from `TOLD_FROM` of the largest on.

    Attributes
    ----------
    stiffness, pressure
        Relative errors: the largest of `MOST_STATES`, and the largest.
    speed
        Rms error of the output's speed at constant crank speed and torque, relative to the rms of its ripple.
    crank_torque
        Errors relative to torque over ratio: rms, and the largest.
    """

    stiffness: tuple[float, float]
    pressure: tuple[float, float]
    speed: float
    crank_torque: tuple[float, float]


@dataclass(frozen=True)
class Tables:
    """A drive as tables over crank angle and torque.

    Attributes
    ----------
    ratio
        φ_a/φ_b of the ideal drive.
    period
        Crank angle after which the drive repeats, rad; the nodes divide it evenly.
    positive, negative
        The two directions of torque.
    rest_torque
        Spline coefficients of the crank's torque at zero load, due to interference, shape (angles,), N·m.
    allowed
        Allowed error of the deviation, rad.
    largest_error
        Largest error of the deviation at random crank angles and torques, and increasingly close to the largest errors,
        rad.
    errors
        Errors of the other quantities, at places not used for refinement.
    """

    ratio: float
    period: float
    positive: Side
    negative: Side
    rest_torque: Array
    allowed: float
    largest_error: float = math.nan
    errors: Errors | None = None

    @property
    def told(self) -> str:
        """What an FMU's description says of its tables."""
        largest, reach = self.largest_error * 648000 / math.pi, self.positive.load[-1]
        text = f"from tables up to {reach:.4g} N.m that err by at most {largest:.3f} arcsec"
        if self.errors is None:
            return text
        stiffness, pressure, crank = self.errors.stiffness, self.errors.pressure, self.errors.crank_torque
        text += (
            f"; from {TOLD_FROM * reach:.2g} N.m on the stiffness by at most {100 * stiffness[0]:.2g} % in "
            f"{100 * MOST_STATES:.0f} of 100 states and {100 * stiffness[1]:.2g} % in all, the pressure by "
            f"{100 * pressure[0]:.2g} % and {100 * pressure[1]:.2g} %"
        )
        if math.isnan(self.errors.speed):
            return text
        return (
            f"{text}, the ripple of the output's speed by {100 * self.errors.speed:.2g} % (rms), the crank's torque by "
            f"{100 * crank[0]:.2g} % (rms) and at most {100 * crank[1]:.2g} %"
        )


def mesh_pitches(pair: Pair, surface: ErrorSurface) -> int:
    """Return the period of the drive in mesh pitches: 1 for equal parts, up to z_c z_p for different ones.

    Cranks or output rollers repeat after z_c over the greatest common divisor of their count and z_c.
    """
    teeth_alike, pins_alike = alike(surface)
    turn = 1 if teeth_alike else pair.gear_teeth
    if teeth_alike and pair.supports is not None:
        turn = pair.gear_teeth // (math.gcd(pair.gear_teeth, pair.supports.count) if _evenly_held(surface) else 1)
    return (1 if pins_alike else pair.pins) * turn


def _evenly_held(surface: ErrorSurface) -> bool:
    """Whether cranks or output rollers, their eccentrics and holes have no errors, and so are equal."""
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
    share: float | Array, width: float | Array, deviation: Sequence[Array] | Array | Array32,
    compliance: Sequence[Array] | Array | Array32,
) -> Array:  # fmt: skip
    """Hermite's interpolation between the values and slopes at both ends of a cell, at a share (0 to 1) of it."""
    s, h = share, width
    value = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * deviation[0] + (3.0 - 2.0 * s) * s * s * deviation[1]
    return np.asarray(value + h * s * (1.0 - s) ** 2 * compliance[0] + h * s * s * (s - 1.0) * compliance[1])


def _slope(
    share: float | Array, width: float | Array, deviation: Array | Array32, compliance: Array | Array32
) -> Array:
    """Derivative of Hermite's interpolation by the load."""
    u, v = share, 1.0 - share
    slopes = v * (1.0 - 3.0 * u) * compliance[0] + u * (3.0 * u - 2.0) * compliance[1]
    return np.asarray(6.0 * u * v * (deviation[1] - deviation[0]) / width + slopes)


def _integral(share: float | Array, width: float | Array, deviation: Array, compliance: Array) -> Array:
    """Hermite's interpolation integrated over the load, from a cell's beginning to a share of it."""
    s, h = share, width
    value = (s - s**3 + 0.5 * s**4) * deviation[0] + (s**3 - 0.5 * s**4) * deviation[1]
    slopes = (0.5 * s**2 - 2.0 / 3.0 * s**3 + 0.25 * s**4) * compliance[0] + (0.25 * s**4 - s**3 / 3.0) * compliance[1]
    return np.asarray(h * (value + h * slopes))


def _middle(low: float, high: float) -> float:
    return math.sqrt(low * high) if low > 0.0 else 0.25 * high


def _chosen_loads(
    pair: Pair, surface: ErrorSurface, direction: float, largest: float, angles: Array, allowed: float
) -> Array:
    """Return loads between which Hermite's interpolation is within the allowed error: cells are halved until then."""

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
    while -cells[0][0] > allowed and len(loads) < MOST_LOADS - 1:  # and one beyond
        _, low, middle, high = heapq.heappop(cells)
        loads.append(middle)
        if low == 0.0:
            known[0.0] = at(0.0, middle)
        for cell in ((low, middle), (middle, high)):
            heapq.heappush(cells, halved(*cell))
    return np.array(sorted(loads))


def _joined(parts: Sequence[_Solved], order: NDArray[np.int64], axis: int) -> _Solved:
    """Sort loads (axis 0) or crank angles (axis 1) that were solved one after another."""
    channels = zip(*parts, strict=True)
    return _Solved(*(np.take(np.concatenate(channel, axis), order, axis) for channel in channels))


def _with_angles(coarse: _Solved, between: _Solved) -> _Solved:
    """Insert the midway crank angles."""
    return _joined([coarse, between], np.arange(2 * coarse.deviation.shape[1]).reshape(2, -1).T.ravel(), 1)


def _with_loads(kept: _Solved, kept_loads: Array, solved: _Solved, loads: Array) -> _Solved:
    """Insert loads."""
    return _joined([kept, solved], np.argsort(np.append(kept_loads, loads)), 0)


def _coefficients(values: Array | Array32) -> Array:
    """Coefficients of the periodic cubic B-spline through values along the last axis."""
    return np.asarray(ndimage.spline_filter1d(values, order=3, axis=-1, mode="grid-wrap"))


def _side(loads: Array, exact: _Solved, far: tuple[float, _Solved], step: float, told: int) -> Side:
    """Convert nodes to coefficients that are monotone in the load for every crank angle, rounded as stored.

    Where the coefficients satisfy Fritsch and Carlson's condition (SIAM J. Numer. Anal. 17 (1980) 238), every spline
    between them does, for a B-spline's weights are positive. Count and pressure are kept at every `told`th node. Both
    directions have the same step of the deviation.
    """
    some = np.unique(np.round(np.linspace(0, loads.size - 1, _TOLD_LOADS)).astype(int))
    square, count = exact.pressure[some, ::told], exact.contact_count[some, ::told]
    h = np.diff(loads)
    widest = np.maximum(np.append(h[:1], h), np.append(h, h[-1:]))
    steps = (
        np.full(loads.size, step),
        np.maximum(
            np.minimum(4.0 * step / widest, _COMPLIANCE_SHARE * np.abs(exact.compliance).mean(axis=1)),
            2.0 * exact.compliance.max(axis=1) / _MOST_STEPS,  # a spline swings beyond its values
        ),
        _PRESSURE_STEP * np.maximum(square.max(axis=1), 1.0),
    )
    p_fine = steps[2][:, None]
    x, c = monotone(loads, _coefficients(exact.deviation), _coefficients(exact.compliance), steps)
    p = np.maximum(np.round(_coefficients(square) / p_fine), 0.0) * p_fine
    return Side(loads, x, c, loads[some], count.astype(np.uint8), p, steps, _far_end(loads[-1], x[-1], c[-1], *far))


def monotone(loads: Array, deviation: Array, compliance: Array, steps: Sequence[Array]) -> tuple[Array, Array]:
    """Round coefficients of deviation and compliance to their steps such that they are monotone in the load."""
    fine, c_fine = (s[:, None] for s in steps[:2])
    x = np.maximum.accumulate(np.round(deviation / fine), axis=0) * fine
    slope = np.diff(x, axis=0) / np.diff(loads)[:, None]
    most = 3.0 * np.minimum(np.vstack([slope[:1], slope]), np.vstack([slope, slope[-1:]]))
    c = np.minimum(np.maximum(compliance, 0.0), most)
    return x, np.minimum(np.floor(c / c_fine), _MOST_STEPS) * c_fine


def _far_end(
    last: float, deviation: Array, compliance: Array, load: float, exact: _Solved
) -> tuple[float, Array, Array]:
    """Return the end of the cell beyond the last load, with one tangent for all crank angles.

    A tangent that changes with the angle would cause a crank torque that grows with the square of the excess.
    """
    x = np.maximum(_coefficients(exact.deviation[0]), deviation + compliance * (load - last) / 3.0)
    c = min(float(exact.compliance.mean()), 3.0 * float((x - deviation).min()) / (load - last))
    return load, x, np.full(x.shape, max(c, 0.0))


def _rest_torque(pair: Pair, surface: ErrorSurface, angles: Array, workers: int) -> Array:
    """Crank torque at zero load, where interference presses the contacts."""
    if pair.supports is not None:
        return np.zeros(angles.size)
    slices = slices_needed(surface)
    one = solve(pair, surface, [0.0], angles, slices, workers=workers)
    drive, rows = drive_of(pair, surface, slices), None
    found = np.zeros(angles.size)
    for i in np.flatnonzero(one.interference > 0.0):
        cold = rows is None
        rows = contact.contact_rows(drive) if rows is None else rows
        x, _ = contact.equilibrium(drive, angles[i], 0.0, one.transmission_error[0, i], rows, cold)
        found[i] = contact.crank_side(drive, angles[i], x, rows)[0]
    return found


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
    """Compute the tables of a drive, with as many nodes as an accuracy needs.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.
    accuracy
        Allowed error of the deviation, rad; or `RANGE_SHARE` of its range over the crank angle, if that is more. The
        allowed errors of stiffness and speed, `STIFFNESS_SHARE` and `SPEED_SHARE`, are in proportion.
    largest_load
        Largest |torque|, N·m; None for 2.5 times the rated torque.
    workers
        Threads.
    total, progress
        Called with the total number of crank angles (times loads), and with the number just finished.

    Raises
    ------
    ValueError
        If the pair states no rated torque and no largest load is given.
    """
    if largest_load is None:
        if pair.rated_torque is None:
            raise ValueError("the pair has no rated_torque, which determines the range of the tables")
        largest_load = LARGEST_LOAD * pair.rated_torque
    g = pair
    pitches = mesh_pitches(pair, surface)
    pitch = 2.0 * math.pi / (g.pins if g.output == "gear" else g.gear_teeth)
    period = pitches * pitch
    random = np.random.default_rng(1)
    spread = np.sort(random.uniform(0.0, period, _SPREAD))
    range_ = float(np.ptp(_solved(pair, surface, 1.0, np.array([0.0, largest_load]), spread).deviation, axis=1).max())
    allowed = max(accuracy, RANGE_SHARE * range_)
    with ThreadPoolExecutor(min(workers, len(_DIRECTIONS))) as pool:
        loads = list(
            pool.map(lambda d: _chosen_loads(pair, surface, d, largest_load, spread, _SHARE * allowed), _DIRECTIONS)
        )
    samples, most = _SAMPLES[0], max(_SAMPLES[1], min(_SAMPLES[2], _MOST_ANGLES // pitches))
    angles: Array = np.arange(pitches * samples, dtype=float) * (pitch / samples)
    rest = _rest_torque(pair, surface, angles, workers)
    total(angles.size * sum(n.size for n in loads))

    def solved(direction: float, at: Array, crank_angle: Array) -> _Solved:
        return _solved(pair, surface, direction, at, crank_angle, workers, progress)

    def closer() -> None:
        """Put crank angles midway."""
        nonlocal samples, angles, rest
        samples *= 2
        angles = np.arange(pitches * samples, dtype=float) * (pitch / samples)
        total(angles[1::2].size * sum(n.size for n in loads))
        for k, direction in enumerate(_DIRECTIONS):
            exact[k] = _with_angles(exact[k], solved(direction, loads[k], angles[1::2]))
            far[k] = far[k][0], _with_angles(far[k][1], solved(direction, np.array([far[k][0]]), angles[1::2]))
        rest = np.ravel([rest, _rest_torque(pair, surface, angles[1::2], workers)], "F")

    def with_more(further: Sequence[Array]) -> None:
        """Put loads between."""
        total(angles.size * sum(n.size for n in further))
        for k, direction in enumerate(_DIRECTIONS):
            if further[k].size:
                # The slope at zero load is taken on the way to the first load.
                anew = int(further[k][0] < loads[k][1])
                more = np.append(loads[k][:anew], further[k])
                kept = _Solved(*(channel[anew:] for channel in exact[k]))
                exact[k] = _with_loads(kept, loads[k][anew:], solved(direction, more, angles), more)
                loads[k] = np.union1d(loads[k], more)

    def random_places(seed: int) -> _Probed:
        return _probed(pair, surface, *_places(period, largest_load, PROBES, seed), workers)

    exact = [solved(d, n, angles) for d, n in zip(_DIRECTIONS, loads, strict=True)]
    far = [
        _far(pair, surface, d, n[-1], angles, one, workers) for d, n, one in zip(_DIRECTIONS, loads, exact, strict=True)
    ]
    drawn = 1
    chosen = random_places(drawn)
    tables = _assembled(pair, surface, period, loads, exact, rest, allowed, far)
    probed = _around_the_worst(tables, pair, surface, chosen, pitch / samples, drawn, workers)
    while True:
        off = np.abs(_off(tables, probed))
        coarse = off.max() > allowed
        room = _MOST_VALUES // (2 * angles.size) - sum(n.size for n in loads)
        further, by_angle = (
            _missing_loads(pair, surface, loads, probed, off, allowed)
            if coarse
            else _missing_elsewhere(pair, surface, tables, chosen, room, accuracy / ACCURACY)
        )
        enough = max(a.size + b.size for a, b in zip(loads, further, strict=True)) >= MOST_LOADS
        if by_angle and 2 * samples <= most and (coarse or room >= sum(n.size for n in loads)):
            closer()
        elif any(n.size for n in further) and not enough:
            with_more(further)
        else:
            # Held against places that nothing was chosen by; where they find more, they are chosen by too.
            drawn += 1
            fresh = random_places(drawn)
            near = _around_the_worst(tables, pair, surface, fresh, pitch / samples, drawn, workers)
            probed = _together(probed, near)
            if coarse or np.abs(_off(tables, near)).max() <= allowed:
                break
            continue
        tables = _assembled(pair, surface, period, loads, exact, rest, allowed, far)
    found = interpolated(tables, fresh.crank_angle, fresh.torque)
    return dataclasses.replace(
        tables,
        largest_error=float(np.abs(_off(tables, probed)).max()),
        errors=errors_of(tables, found, fresh.exact, fresh.torque),
    )


def _far(
    pair: Pair, surface: ErrorSurface, direction: float, last: float, angles: Array, exact: _Solved, workers: int
) -> tuple[float, _Solved]:
    """Solve the model at a load far beyond the last."""
    for times in _FAR:
        with contextlib.suppress(InputError):  # contacts can't balance every load
            return times * last, _solved(pair, surface, direction, np.array([times * last]), angles, workers)
    end = _Solved(*(channel[-1:] for channel in exact))
    beyond = (_FAR[-1] - 1.0) * last
    return _FAR[-1] * last, end._replace(deviation=end.deviation + np.float32(beyond) * end.compliance)


def _assembled(
    pair: Pair, surface: ErrorSurface, period: float, loads: Sequence[Array], exact: Sequence[_Solved], rest: Array,
    allowed: float, far: Sequence[tuple[float, _Solved]],
) -> Tables:  # fmt: skip
    told = rest.size // (mesh_pitches(pair, surface) * _SAMPLES[0])
    spread = max(float(np.ptp(one.deviation, axis=1).max()) for one in exact)
    step = max(allowed / _STEPS, 1.2 * spread / _MOST_STEPS)
    made = [_side(n, one, f, step, told) for n, one, f in zip(loads, exact, far, strict=True)]
    # Its mean is no energy's.
    rest = _coefficients(rest - rest.mean())
    rest_step = _rest_step(rest)
    # Where there is hardly any play the splines of its two ends must not cross.
    made[1].deviation[0] = np.maximum(made[1].deviation[0], -made[0].deviation[0])
    np.maximum.accumulate(made[1].deviation, axis=0, out=made[1].deviation)
    return Tables(pair.ratio, period, made[0], made[1], np.round(rest / rest_step) * rest_step, allowed)


def _missing_loads(
    pair: Pair, surface: ErrorSurface, loads: Sequence[Array], probed: _Probed, off: Array, allowed: float
) -> tuple[list[Array], bool]:
    """Return the middles of cells too wide for the allowed error, and whether the angles are too wide instead.

    If exact nodes at the probe's own crank angle have half of the error, the cell of the load is the cause.
    """
    worst = np.argsort(-np.abs(off))[: min(int(np.sum(np.abs(off) > allowed)), _WORST)]
    further: list[set[float]] = [set() for _ in loads]
    by_angle = 0
    for i in worst:
        side = int(probed.torque[i] < 0.0)
        direction, load = _DIRECTIONS[side], abs(float(probed.torque[i]))
        j = int(np.clip(np.searchsorted(loads[side], load) - 1, 0, loads[side].size - 2))
        low, high = (float(n) for n in loads[side][j : j + 2])
        ends = _solved(pair, surface, direction, np.array([low, high]), probed.crank_angle[i : i + 1])
        found = float(_hermite((load - low) / (high - low), high - low, ends.deviation, ends.compliance)[0])
        if abs(found - direction * probed.exact.deviation[i]) > 0.5 * abs(off[i]):
            further[side].add(_middle(low, high))
        else:
            by_angle += 1
    return [np.array(sorted(middles)) for middles in further], 2 * by_angle > worst.size


def _missing_elsewhere(
    pair: Pair, surface: ErrorSurface, tables: Tables, probed: _Probed, room: int, looser: float
) -> tuple[list[Array], bool]:
    """Return the middles of the cells with the largest errors of stiffness and speed, as many as there is room for.

    None if both are within `looser` times their allowed errors, and on bearings, whose states take longer to solve; and
    whether angles are too wide for the stiffness.
    """
    if pair.supports is not None:
        return [np.empty(0) for _ in _DIRECTIONS], False
    theta, torque, e = probed
    f = interpolated(tables, theta, torque)
    told = np.abs(torque) >= TOLD_FROM * tables.positive.load[-1]
    allowed = looser * STIFFNESS_SHARE
    stiff = told & (np.abs(f.stiffness / e.stiffness - 1.0) > allowed)
    most = looser * SPEED_SHARE * np.sqrt(np.mean(np.square(e.rate[told])))
    speed = np.where(told & np.isfinite(e.rate), np.square((f.rate - e.rate) / most), 0.0)
    too_stiff, too_fast = stiff.sum() > (1.0 - MOST_STATES) * told.sum(), speed.sum() > told.sum()
    blame = too_stiff * stiff / (1.0 - MOST_STATES) + too_fast * speed
    cells: list[tuple[float, int, float]] = []
    for k, side in enumerate((tables.positive, tables.negative)):
        here = torque * _DIRECTIONS[k] > 0.0
        j, _, _ = _cells(side.load, np.abs(torque[here]))
        shares = np.bincount(j, blame[here], side.load.size - 1)
        cells += [(float(shares[i]), k, _middle(*side.load[i : i + 2])) for i in np.flatnonzero(shares)]
    cells.sort(reverse=True)
    until = np.searchsorted(np.cumsum([share for share, _, _ in cells]), _BLAMED * blame.sum(), "right") + 1
    kept = cells[: max(min(int(until), room), 0)]
    further = [np.array(sorted(middle for _, side, middle in kept if side == k)) for k in range(len(_DIRECTIONS))]
    some = np.flatnonzero(stiff)[:: max(int(stiff.sum()) // _WORST, 1)] if too_stiff else np.empty(0, dtype=int)
    by_load = sum(_blames_load(pair, surface, tables, theta[i], torque[i], e.stiffness[i], allowed) for i in some)
    return further, bool(2 * by_load < some.size)


def _blames_load(
    pair: Pair, surface: ErrorSurface, tables: Tables, theta: float, torque: float, stiffness: float, allowed: float
) -> bool:
    """Whether exact nodes at a probe's own crank angle exceed the allowed error too."""
    side, direction = (tables.positive, 1.0) if torque > 0.0 else (tables.negative, -1.0)
    (j,), (u,), (h,) = _cells(side.load, np.array([abs(torque)]))
    ends = _solved(pair, surface, direction, side.load[j : j + 2], np.array([theta]))
    x, c = ends.deviation[:, 0], ends.compliance[:, 0]
    return bool(abs(stiffness * _slope(u, h, x, c) - 1.0) > allowed)


def interpolated(tables: Tables, crank_angle: ArrayLike, torque: ArrayLike) -> States:
    """Interpolate as the native FMU does.

    Parameters
    ----------
    crank_angle, torque
        Of shape (places,), rad and N·m, the torque within the tables and other than 0.
    """
    theta, signed = (np.asarray(v, dtype=float) for v in (crank_angle, torque))
    angles = tables.rest_torque.size
    nodes, weights, rates = _place(tables.period, angles, theta)
    told, told_weights, _ = _place(tables.period, tables.positive.pressure.shape[1], theta)
    found = States(*np.empty((len(States._fields), *theta.shape)))
    for side, direction in ((tables.positive, 1.0), (tables.negative, -1.0)):
        here = signed * direction > 0.0
        load, among, weight, by_angle = np.abs(signed[here]), nodes[:, here], weights[:, here], rates[:, here]
        j, u, h = _cells(side.load, load)
        x, c = _ends(side, j, weight, among)
        found.deviation[here] = direction * _hermite(u, h, x, c)
        found.stiffness[here] = 1.0 / np.maximum(_slope(u, h, x, c), LEAST_COMPLIANCE)
        x, c = _ends(side, j, by_angle, among)
        found.rate[here] = direction * _hermite(u, h, x, c)
        energy_rate = _integral(u, h, x, c)
        for k in range(side.load.size - 1):  # the whole cells below
            above = j > k
            width = float(side.load[k + 1] - side.load[k])
            energy_rate[above] += _integral(1.0, width, *_ends(side, k, by_angle[:, above], among[:, above]))
        rest = np.sum(weight * tables.rest_torque[among], axis=0)
        found.crank_torque[here] = rest - direction * load / tables.ratio - energy_rate
        j, u, _ = _cells(side.told_load, load)
        low, high = (np.sum(told_weights[:, here] * side.pressure[row, told[:, here]], axis=0) for row in (j, j + 1))
        found.pressure[here] = np.sqrt(np.maximum((1.0 - u) * low + u * high, 0.0))
    return found


def _place(period: float, angles: int, theta: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Nodes of crank angles, shape (4, places), and the weights there of a spline and of its derivative."""
    at = theta / period % 1.0 * angles
    first = np.minimum(at.astype(int), angles - 1)
    s = at - first
    weights = np.array([(1.0 - s) ** 3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 1.0 + 3.0 * s + 3.0 * s**2 - 3.0 * s**3, s**3])
    rates = np.array([-((1.0 - s) ** 2), 3.0 * s**2 - 4.0 * s, 1.0 + 2.0 * s - 3.0 * s**2, s**2])
    return (first + np.arange(-1, 3)[:, None]) % angles, weights / 6.0, 0.5 * angles / period * rates


def _ends(side: Side, cell: NDArray[np.int64] | int, weights: Array, nodes: NDArray[np.int64]) -> tuple[Array, Array]:
    """Deviations and compliances at both ends of cells, or their rates by the crank angle, shape (2, places)."""
    x, c = (
        np.array([np.sum(weights * values[row, nodes], axis=0) for row in (cell, cell + 1)])
        for values in (side.deviation, side.compliance)
    )
    return x, c


def _cells(loads: Array, load: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Cells that loads lie in, at what share of them, and their widths."""
    j = np.clip(np.searchsorted(loads, load, "right") - 1, 0, loads.size - 2)
    width = loads[j + 1] - loads[j]
    return j, (load - loads[j]) / width, width


def errors_of(tables: Tables, found: States, exact: States, torque: Array) -> Errors:
    """Return what tables err by, from what they and the exact model give at torques (N·m)."""
    told = np.abs(torque) >= TOLD_FROM * tables.positive.load[-1]
    f, e = (States(*(channel[told] for channel in states)) for states in (found, exact))

    def share(channel: Array, of: Array) -> tuple[float, float]:
        off = np.abs(channel / of - 1.0)
        return float(np.quantile(off, MOST_STATES)), float(off.max())

    crank = np.abs(f.crank_torque - e.crank_torque) / np.abs(torque[told] / tables.ratio)
    return Errors(
        share(f.stiffness, e.stiffness),
        share(f.pressure, e.pressure),
        float(np.sqrt(np.mean((f.rate - e.rate) ** 2) / np.mean(e.rate**2))),
        (float(np.sqrt(np.mean(crank**2))), float(crank.max())),
    )


def _off(tables: Tables, probed: _Probed) -> Array:
    """What the deviation errs by, rad."""
    return interpolated(tables, probed.crank_angle, probed.torque).deviation - probed.exact.deviation


class _Probed(NamedTuple):
    """The exact model at crank angles (rad) and torques (N·m), each of shape (probes,)."""

    crank_angle: Array
    torque: Array
    exact: States


def _places(period: float, largest: float, probes: int, seed: int) -> tuple[Array, Array]:
    """Random crank angles, and torques evenly and evenly in the logarithm."""
    random = np.random.default_rng(seed)
    size = np.where(
        random.random(probes) < 0.5, random.uniform(0.0, 1.0, probes), 10.0 ** random.uniform(-4.0, 0.0, probes)
    )  # fmt: skip
    torque = largest * size * random.choice([-1.0, 1.0], probes)
    return np.sort(random.uniform(0.0, period, probes)), torque


def _around_the_worst(
    tables: Tables, pair: Pair, surface: ErrorSurface, probed: _Probed, spacing: float, seed: int, workers: int
) -> _Probed:
    """Add places ever closer around those where tables err most: the largest errors are narrower than probes lie."""
    random, found = np.random.default_rng(seed), probed
    largest = min(tables.positive.load[-1], tables.negative.load[-1])
    for reach in _REACHES:
        worst = np.repeat(np.argsort(-np.abs(_off(tables, found)))[:_WORST], _NEIGHBOURS)
        theta = found.crank_angle[worst] + reach * spacing * random.uniform(-1.0, 1.0, worst.size)
        torque = found.torque[worst] * (1.0 + 0.1 * reach * random.uniform(-1.0, 1.0, worst.size))
        near = _probed(pair, surface, np.mod(theta, tables.period), np.clip(torque, -largest, largest), workers)
        found = _together(found, near)
    return found


def _together(*parts: _Probed) -> _Probed:
    angles, torques, states = zip(*parts, strict=True)
    exact = States(*(np.concatenate(channel) for channel in zip(*states, strict=True)))
    return _Probed(np.concatenate(angles), np.concatenate(torques), exact)


def _probed(pair: Pair, surface: ErrorSurface, theta: Array, torque: Array, workers: int = 1) -> _Probed:
    if pair.supports is not None:
        # What is nearer to no torque lies on a tangent.
        torque = np.copysign(np.maximum(np.abs(torque), play_loads(pair)[1]), torque)
        # A place is soon found from one near by under a like torque.
        rank = np.argsort(np.argsort(torque)) // _LIKE
        order = np.lexsort((theta, rank))
        theta, torque = theta[order], torque[order]
        one = solve(pair, surface, torque[None], theta, slices_needed(surface), with_play=False, workers=workers)
        unsaid = np.full_like(theta, math.nan)
        stiffness, pressure = one.torsional_stiffness[0], one.max_contact_pressure[0]
        return _Probed(theta, torque, States(one.transmission_error[0], stiffness, unsaid, unsaid, pressure))
    drive = drive_of(pair, surface, slices_needed(surface))
    rows, force, pressure = contact.contact_rows(drive), *np.empty((2, pair.discs, pair.pins))
    found = np.empty((len(States._fields), theta.size))
    for i, (angle, load) in enumerate(zip(theta, torque, strict=True)):
        x, stiffness = contact.equilibrium(drive, angle, load, 0.0, rows, True)
        crank_torque, rate = contact.crank_side(drive, angle, x, rows)
        _, highest = contact.load_sharing(drive, rows, force, pressure)
        found[:, i] = x, stiffness, rate - 1.0 / pair.ratio, crank_torque, highest
    return _Probed(theta, torque, States(*found))


def probed_at(pair: Pair, surface: ErrorSurface, largest: float, probes: int, seed: int = 1) -> _Probed:
    """Solve the exact model at random crank angles and torques, the latter up to a largest (N·m)."""
    pitch = 2.0 * math.pi / (pair.pins if pair.output == "gear" else pair.gear_teeth)
    return _probed(pair, surface, *_places(mesh_pitches(pair, surface) * pitch, largest, probes, seed))


def at_loads(side: Side, loads: Array) -> tuple[Array, Array]:
    """Return a side's coefficients of deviation and compliance at loads up to its far one, (loads, angles)."""
    own = np.append(side.load, side.far[0])
    ends = (np.vstack([side.deviation, side.far[1]]), np.vstack([side.compliance, side.far[2]]))
    j, u, width = _cells(own, loads)
    x, c = (values[np.stack([j, j + 1])] for values in ends)
    return _hermite(u[:, None], width[:, None], x, c), _slope(u[:, None], width[:, None], x, c)
