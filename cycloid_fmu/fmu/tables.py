"""Tables of the exact contact model, for FMUs that run without it.

Everything follows from one function of crank angle θ and torque T: the transmission error x(θ, T) of the output at rest
under load. On each side of zero torque it is, over t = |T|, the cubic Hermite interpolation of transmission errors and
compliances at chosen torques, and over θ a periodic cubic B-spline. With the energy at zero torque V_0(θ), 0 where
there is play,

    G(θ, T) = ∫_0^T x dT - V_0(θ),    φ_b - φ_a/ratio = ∂G/∂T,    τ_a = -T/ratio - ∂G/∂θ,

so that the torques of both flanges are the derivatives of one elastic energy, T x - G (Legendre), for any error of the
table, and no path generates or loses energy. Between the two sides at zero torque is the play.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import InputError
from cycloid_fmu.errors.kinds import EACH_SUPPORT, kinds_of
from cycloid_fmu.fmu import table_nodes
from cycloid_fmu.fmu.constants import LARGEST_LOAD, LEAST_COMPLIANCE, MOST_LOADS
from cycloid_fmu.fmu.table_nodes import Array, Array32, Rest, Solved
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import play_loads
from cycloid_fmu.surfaces.surface import ErrorSurface, alike

ACCURACY = 0.02 / 3600 * math.pi / 180  # rad: allowed error of the transmission error
RANGE_SHARE = 1e-3  # of the transmission error's range over the crank angle, where that is more
# Where a pin comes into contact, stiffness and speed nearly jump, which no grid can follow: the allowed error of the
# stiffness is for most states, that of the speed for the rms over all.
STIFFNESS_SHARE = 0.02  # allowed relative error of the stiffness in `MOST_STATES`
SPEED_SHARE = 0.2  # allowed rms error of the output speed's ripple, of its own rms
MOST_STATES = 0.95
STATED_FROM = 0.01  # of the largest torque: above it these hold and are stated
_MOST_VALUES = 7_000_000  # transmission errors and compliances up to which stiffness and speed are refined: 14 MB
_SAMPLES = (16, 128, 1024)  # crank angles per mesh pitch: fewest, most of any drive, most of a drive of few pitches
_MOST_ANGLES = 200_000  # in total, with more than 128 per mesh pitch
_SHARE = 0.7  # of the allowed error, at most in the middle of a cell between loads
_NEIGHBOURS, _REACHES = 5, (1.0, 0.5, 0.25)  # places drawn around each of the worst probes, and within how many cells
_BLAMED = 2 / 3  # of the errors of stiffness and speed: the cells that cause this share are halved
_WORST = 200  # probes that decide whether loads or crank angles are too few
_DIRECTIONS = (1.0, -1.0)
# Interpolation between crank angles is accurate enough where the fourth differences of the transmission error are
# within this share of the allowed error, and those of the compliance within this one of it: then 999 of 1000
# transmission errors are within 0.2 of the allowed error and compliances within 0.004. With 2 µm on every pin and tooth
# 12 of 44 million are solved.
_MIDWAY, _MIDWAY_COMPLIANCE = 0.25, 0.01
_LIKE = 512  # probes of similar torque, solved in a row
_SPREAD = 1000  # random crank angles at which the loads are chosen
_TOLD_LOADS = 24  # at most
_PRESSURE_STEP = 2.5e-3  # of the largest pressure's square
_FAR = (4.0, 2.0, 1.2)  # times the last load: the first at which contacts can balance it ends the cell beyond
_STEPS = 16  # quantisation steps of the transmission error, and of a compliance's part in it, in the allowed error
_COMPLIANCE_SHARE = 0.005  # largest step of the stored compliance, of its mean
_MOST_STEPS = 65000  # of any channel, in 16 bits
PROBES = 20000  # random crank angles and torques at which the finished tables are compared with the model


@dataclass(frozen=True)
class Side:
    """One direction of torque; mirrored, so that everything increases with the load.

    Attributes
    ----------
    load
        |T| at the nodes, ascending from 0, shape (loads,), N·m.
    transmission_error, compliance
        Spline coefficients over the crank angle of the transmission error times the direction (rad) and of its
        derivative with respect to the load (rad/(N·m)), shape (loads, angles).
    pressure_load
        Some of the loads, from the first to the last, shape (loads of the pressure,), N·m.
    contact_count
        Pins in contact at these loads and at some of the crank angles, shape (loads, angles of the pressure).
    pressure
        Spline coefficients of the square of the largest contact pressure, at the same points and of the same shape,
        Pa²; the square is nearly linear in the load.
    steps
        Quantisation steps of transmission error, compliance and pressure of each load.
    far
        A load beyond the last one, N·m, and coefficients of the transmission error and of the compliance at it, each of
        shape (angles,). The cell up to it has no stated accuracy; beyond it the tangent continues.
    """

    load: Array
    transmission_error: Array
    compliance: Array
    pressure_load: Array
    contact_count: NDArray[np.uint8]
    pressure: Array
    steps: tuple[Array, Array, Array]
    far: tuple[float, Array, Array]


class States(NamedTuple):
    """State of a drive at crank angles and torques, arrays of one shape; NaN where the exact model has no value.

    Attributes
    ----------
    transmission_error
        Deviation of the output from its ideal angle, rad.
    stiffness
        N·m/rad.
    rate
        Derivative of the transmission error with respect to the crank angle at constant torque, dφ_b/dθ - 1/ratio.
    crank_torque
        N·m.
    pressure
        Largest contact pressure, Pa.
    """

    transmission_error: Array
    stiffness: Array
    rate: Array
    crank_torque: Array
    pressure: Array


class Errors(NamedTuple):
    """Errors of tables at random crank angles and torques from `TOLD_FROM` of the largest on.

    Attributes
    ----------
    stiffness, pressure
        Relative errors: the largest over the share `MOST_STATES` of the states, and over all of them.
    speed
        Rms error of the output's speed at constant crank speed and torque, relative to the rms of its ripple.
    crank_torque
        Errors relative to torque over ratio: rms and largest.
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
        Allowed error of the transmission error, rad.
    largest_error
        Largest error of the transmission error at random crank angles and torques, and increasingly close to the
        largest errors, rad.
    errors
        Errors of the other quantities, at points that were not used for refinement.
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
    def accuracy(self) -> str:
        """Accuracy of the tables, for an FMU's description."""
        largest, reach = self.largest_error * 648000 / math.pi, self.positive.load[-1]
        text = f"from tables up to {reach:.4g} N.m with errors of at most {largest:.3f} arcsec"
        if self.errors is None:
            return text
        stiffness, pressure, crank = self.errors.stiffness, self.errors.pressure, self.errors.crank_torque
        text += (
            f"; above {STATED_FROM * reach:.2g} N.m errors of the stiffness of at most {100 * stiffness[0]:.2g} % in "
            f"{100 * MOST_STATES:.0f} of 100 states and {100 * stiffness[1]:.2g} % in all, of the pressure of "
            f"{100 * pressure[0]:.2g} % and {100 * pressure[1]:.2g} %"
        )
        if math.isnan(self.errors.speed):
            return text
        return (
            f"{text}, of the speed ripple of {100 * self.errors.speed:.2g} % (rms), of the crank torque of "
            f"{100 * crank[0]:.2g} % (rms) and at most {100 * crank[1]:.2g} %"
        )


def mesh_pitches(drive: DriveValue) -> int:
    """Return the period of the drive in mesh pitches: 1 for equal parts, up to z_c z_p for different ones.

    Cranks or output rollers repeat after z_c over the greatest common divisor of their count and z_c.
    """
    pair, surface = drive.pair, drive.surface
    teeth_alike, pins_alike = alike(surface)
    turn = 1 if teeth_alike else pair.gear_teeth
    if teeth_alike and pair.supports is not None:
        turn = pair.gear_teeth // (math.gcd(pair.gear_teeth, pair.supports.count) if _evenly_held(surface) else 1)
    return (1 if pins_alike else pair.pins) * turn


def _evenly_held(surface: ErrorSurface) -> bool:
    """Whether cranks or output rollers, their eccentrics and holes have no errors, and so are equal."""
    kinds = kinds_of(surface.pair).items()
    return not any(np.any(surface.errors[name]) for name, kind in kinds if EACH_SUPPORT.keys() & kind.displaces)


def _hermite(
    share: float | Array,
    width: float | Array,
    transmission_error: Sequence[Array] | Array | Array32,
    compliance: Sequence[Array] | Array | Array32,
) -> Array:
    """Cubic Hermite interpolation between values and slopes at the ends of a cell, at a share (0 to 1) of its width."""
    s, h = share, width
    value = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * transmission_error[0] + (3.0 - 2.0 * s) * s * s * transmission_error[1]
    return np.asarray(value + h * s * (1.0 - s) ** 2 * compliance[0] + h * s * s * (s - 1.0) * compliance[1])


def _slope(
    share: float | Array, width: float | Array, transmission_error: Array | Array32, compliance: Array | Array32
) -> Array:
    """Derivative of the Hermite interpolation with respect to the load."""
    u, v = share, 1.0 - share
    slopes = v * (1.0 - 3.0 * u) * compliance[0] + u * (3.0 * u - 2.0) * compliance[1]
    return np.asarray(6.0 * u * v * (transmission_error[1] - transmission_error[0]) / width + slopes)


def _integral(
    share: float | Array,
    width: float | Array,
    transmission_error: Sequence[Array] | Array,
    compliance: Sequence[Array] | Array,
) -> Array:
    """Integral of the Hermite interpolation over the load, from the start of a cell to a share of its width."""
    s, h = share, width
    value = (s - s**3 + 0.5 * s**4) * transmission_error[0] + (s**3 - 0.5 * s**4) * transmission_error[1]
    slopes = (0.5 * s**2 - 2.0 / 3.0 * s**3 + 0.25 * s**4) * compliance[0] + (0.25 * s**4 - s**3 / 3.0) * compliance[1]
    return np.asarray(h * (value + h * slopes))


def _middle(low: float, high: float) -> float:
    return math.sqrt(low * high) if low > 0.0 else 0.25 * high


def _chosen_loads(
    drive: DriveValue, direction: float, largest: float, angles: Array, rest: Rest, allowed: float
) -> Array:
    """Return loads between which Hermite interpolation is within the allowed error, by bisection of cells."""
    pair = drive.pair

    def solve_at(loads: Sequence[float], following: float | None = None) -> None:
        nodes = table_nodes.solved(drive, direction, np.array(loads), angles, rest, following=following)
        known.update(zip(loads, zip(nodes.transmission_error, nodes.compliance, strict=True), strict=True))

    def halved(cells: list[tuple[float, float]]) -> list[tuple[float, float, float, float]]:
        """Return the error in the middle of each cell, negative so that the largest is the first, and the cell."""
        middles = [_middle(low, high) for low, high in cells]
        solve_at(middles)
        halves = []
        for (low, high), middle in zip(cells, middles, strict=True):
            ends = [np.stack(both) for both in zip(known[low], known[high], strict=True)]
            guess = _hermite((middle - low) / (high - low), high - low, *ends)
            halves.append((-float(np.abs(guess - known[middle][0]).max()), low, middle, high))
        return halves

    loads = [0.0, 0.01 * largest, 0.1 * largest, largest]
    if pair.supports is not None:
        loads.insert(1, play_loads(pair)[1])
    known: dict[float, tuple[Array32, Array32]] = {}
    solve_at(loads)
    # On bearings the first cell is a tangent, which is exact.
    cells = halved([(low, high) for low, high in itertools.pairwise(loads) if low > 0.0 or pair.supports is None])
    # One load more is beyond the last.
    while wide := sorted(cell for cell in cells if -cell[0] > allowed)[: MOST_LOADS - 1 - len(loads)]:
        loads += [middle for _, _, middle, _ in wide]
        if min(low for _, low, _, _ in wide) == 0.0:
            solve_at([0.0], min(loads[1:]))
        cells = [cell for cell in cells if cell not in wide]
        cells += halved([half for _, low, middle, high in wide for half in ((low, middle), (middle, high))])
    return np.array(sorted(loads))


def _with_loads(nodes: Solved, node_loads: Array, solved: Solved, loads: Array) -> Solved:
    """Insert loads."""
    order = np.argsort(np.append(node_loads, loads))
    return Solved(*(np.concatenate(both)[order] for both in zip(nodes, solved, strict=True)))


def _coefficients(values: Array | Array32) -> Array:
    """Coefficients of the periodic cubic B-spline through values along the last axis."""
    return np.asarray(ndimage.spline_filter1d(values, order=3, axis=-1, mode="grid-wrap"))


def _side(loads: Array, exact: Solved, far: tuple[float, Solved], step: float) -> Side:
    """Convert nodes to coefficients that are monotone in the load for every crank angle, rounded as stored.

    Where the coefficients satisfy Fritsch and Carlson's condition (SIAM J. Numer. Anal. 17 (1980) 238), every spline
    between them does, because a B-spline's weights are positive. Both directions have the same step of the transmission
    error.
    """
    some = np.unique(np.round(np.linspace(0, loads.size - 1, _TOLD_LOADS)).astype(int))
    square, count = exact.pressure[some], exact.contact_count[some]
    h = np.diff(loads)
    widest = np.maximum(np.append(h[:1], h), np.append(h, h[-1:]))
    steps = (
        np.full(loads.size, step),
        np.maximum(
            np.minimum(4.0 * step / widest, _COMPLIANCE_SHARE * np.abs(exact.compliance).mean(axis=1)),
            2.0 * exact.compliance.max(axis=1) / _MOST_STEPS,  # a spline overshoots its values
        ),
        _PRESSURE_STEP * np.maximum(square.max(axis=1), 1.0),
    )
    p_fine = steps[2][:, None]
    x, c = _coefficients(exact.transmission_error), _coefficients(exact.compliance)
    _make_monotone(loads, x, c, steps)
    p = np.maximum(np.round(_coefficients(square) / p_fine), 0.0) * p_fine
    return Side(loads, x, c, loads[some], count.astype(np.uint8), p, steps, _far_end(loads[-1], x[-1], c[-1], *far))


def _make_monotone(loads: Array, transmission_error: Array, compliance: Array, steps: Sequence[Array]) -> None:
    """Round coefficients of transmission error and compliance to their steps, in place, rising with the load."""
    # Row by row, which the processor's cache holds: 5 times as fast as all at once.
    for k, fine in enumerate(steps[0]):
        row = transmission_error[k]
        np.multiply(np.round(row / fine, out=row), fine, out=row)
        np.maximum(transmission_error[max(k - 1, 0)], row, out=row)
    before: ArrayLike = math.inf
    for k, fine in enumerate(steps[1]):
        slope = (
            (transmission_error[k + 1] - transmission_error[k]) / (loads[k + 1] - loads[k])
            if k + 1 < loads.size
            else before
        )
        row = compliance[k]
        np.minimum(np.maximum(row, 0.0, out=row), 3.0 * np.minimum(before, slope), out=row)
        np.multiply(np.minimum(np.floor(row / fine, out=row), _MOST_STEPS, out=row), fine, out=row)
        before = slope


def _far_end(
    last: float, transmission_error: Array, compliance: Array, load: float, exact: Solved
) -> tuple[float, Array, Array]:
    """Return the end of the cell beyond the last load, with one tangent for all crank angles.

    A tangent that changes with the angle would cause a crank torque that grows with the square of the excess.
    """
    x = np.maximum(_coefficients(exact.transmission_error[0]), transmission_error + compliance * (load - last) / 3.0)
    c = min(float(exact.compliance.mean()), 3.0 * float((x - transmission_error).min()) / (load - last))
    return load, x, np.full(x.shape, max(c, 0.0))


def _rest_step(rest: Array) -> float:
    return max(1e-6 * float(np.abs(rest).max()), 1e-12)


def compute(
    drive: DriveValue,
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
    drive
        The drive.
    accuracy
        Allowed error of the transmission error, rad; or `RANGE_SHARE` of its range over the crank angle, if that is
        more. The allowed errors of stiffness and speed, `STIFFNESS_SHARE` and `SPEED_SHARE`, are in proportion.
    largest_load
        Largest |torque|, N·m; None for 2.5 times the rated torque.
    workers
        Threads.
    total, progress
        Called with the number of crank angles (times loads) before each step of the refinement, and with the number
        just finished.

    Raises
    ------
    ValueError
        If the pair states no rated torque and no largest load is given.
    """
    pair = drive.pair
    if largest_load is None:
        if pair.rated_torque is None:
            raise ValueError("the pair has no rated_torque, which determines the range of the tables")
        largest_load = LARGEST_LOAD * pair.rated_torque
    allowed, loads = _first_loads(drive, accuracy, largest_load, workers)
    return _refined(_Grid(drive, allowed, loads, workers, total, progress), largest_load, accuracy / ACCURACY)


def _pitch(pair: Pair) -> float:
    """Return the crank angle from one pin's contact to the next one's, rad."""
    return 2.0 * math.pi / (pair.pins if pair.output == "gear" else pair.gear_teeth)


def _first_loads(drive: DriveValue, accuracy: float, largest: float, workers: int) -> tuple[float, list[Array]]:
    """Return the transmission error's allowed error, and loads of both directions chosen at random crank angles."""
    pair = drive.pair
    period = mesh_pitches(drive) * _pitch(pair)
    spread = np.sort(np.random.default_rng(1).uniform(0.0, period, _SPREAD))
    rest = table_nodes.at_rest(drive, spread, workers)
    ends = table_nodes.solved(drive, 1.0, np.array([0.0, largest]), spread, rest)
    allowed = max(accuracy, RANGE_SHARE * float(np.ptp(ends.transmission_error, axis=1).max()))

    def chosen_loads(direction: float) -> Array:
        return _chosen_loads(drive, direction, largest, spread, rest, _SHARE * allowed)

    with ThreadPoolExecutor(min(workers, len(_DIRECTIONS))) as pool:
        return allowed, list(pool.map(chosen_loads, _DIRECTIONS))


@dataclass
class _Grid:
    """The exact model at loads of both directions and at equidistant crank angles; both become more.

    Attributes
    ----------
    drive
        The drive.
    allowed
        Allowed error of the transmission error, rad.
    loads, exact, far
        Of both directions: loads, the model at them, and at a load far beyond the last.
    workers, total, progress
        As in `compute`.
    samples, angles
        Crank angles per mesh pitch, and all of a period, rad.
    rest
        The drive without a load at these angles.
    """

    drive: DriveValue
    allowed: float
    loads: list[Array]
    workers: int
    total: Callable[[int], None]
    progress: Callable[[int], None]
    samples: int = _SAMPLES[0]
    angles: Array = field(init=False)
    rest: Rest = field(init=False)
    exact: list[Solved] = field(init=False)
    far: list[tuple[float, Solved]] = field(init=False)

    def __post_init__(self) -> None:
        self.pitches = mesh_pitches(self.drive)
        self.angles = self._equidistant()
        self.rest = table_nodes.at_rest(self.drive, self.angles, self.workers)
        self.exact = [self._solved(d, n) for d, n in zip(_DIRECTIONS, self.loads, strict=True)]
        self.far = [
            _far(self.drive, d, n[-1], self.angles, nodes, self.workers)
            for d, n, nodes in zip(_DIRECTIONS, self.loads, self.exact, strict=True)
        ]

    @property
    def period(self) -> float:
        """Crank angle after which the drive repeats, rad."""
        return self.pitches * _pitch(self.drive.pair)

    @property
    def spacing(self) -> float:
        """Distance of the crank angles, rad."""
        return _pitch(self.drive.pair) / self.samples

    @property
    def most_samples(self) -> int:
        """Largest number of crank angles per mesh pitch."""
        return max(_SAMPLES[1], min(_SAMPLES[2], _MOST_ANGLES // self.pitches))

    @property
    def load_count(self) -> int:
        """Number of loads of both directions."""
        return sum(n.size for n in self.loads)

    def _equidistant(self) -> Array:
        return self.spacing * np.arange(self.pitches * self.samples, dtype=float)

    def _between(self, coarse: Solved, direction: float, loads: Array) -> Solved:
        """Insert the crank angles midway, solved where interpolation between neighbours is not accurate enough."""
        inserted = [np.empty_like(channel) for channel in coarse[:2]]
        needed = np.empty(inserted[0].shape, dtype=bool)
        for k in range(loads.size):  # a row at a time stays in the processor's cache
            (inserted[0][k], off), (inserted[1][k], bent) = (table_nodes.midway(channel[k]) for channel in coarse[:2])
            needed[k] = (off > _MIDWAY * self.allowed) | (bent > _MIDWAY_COMPLIANCE * coarse.compliance[k])
        load, angle = np.nonzero(needed)
        if load.size:
            self.total(load.size)
        step = self.angles.size // (2 * coarse.transmission_error.shape[1])
        middles = self.angles[step :: 2 * step]
        here = Rest._make(channel[step :: 2 * step] for channel in self.rest)
        solver = functools.partial(table_nodes.solved_at, self.drive, direction, loads, middles)
        nodes = solver(load, angle, here, self.workers, self.progress)
        inserted[0][needed], inserted[1][needed] = nodes.transmission_error, nodes.compliance
        finer = [np.stack(both, axis=-1).reshape(loads.size, -1) for both in zip(coarse[:2], inserted, strict=True)]
        return coarse._replace(transmission_error=finer[0], compliance=finer[1])

    def _solved(self, direction: float, loads: Array) -> Solved:
        """Solve loads at the fewest crank angles, and between them."""
        fewest = self.pitches * _SAMPLES[0]
        self.total(fewest * loads.size)
        step = self.angles.size // fewest
        here = Rest._make(channel[::step] for channel in self.rest)
        solver = functools.partial(table_nodes.solved, self.drive, direction, loads)
        nodes = solver(self.angles[::step], here, self.workers, self.progress)
        while nodes.transmission_error.shape[1] < self.angles.size:
            nodes = self._between(nodes, direction, loads)
        return nodes

    def add_angles(self) -> None:
        """Insert the crank angles midway."""
        self.samples *= 2
        self.angles = self._equidistant()
        here = table_nodes.at_rest(self.drive, self.angles[1::2], self.workers)
        self.rest = Rest._make(np.ravel(channels, "F") for channels in zip(self.rest, here, strict=True))
        for k, direction in enumerate(_DIRECTIONS):
            self.exact[k] = self._between(self.exact[k], direction, self.loads[k])
            last, beyond = self.far[k]
            self.far[k] = last, self._between(beyond, direction, np.array([last]))

    def add_loads(self, further: Sequence[Array]) -> None:
        """Insert loads of both directions."""
        for k, (direction, new) in enumerate(zip(_DIRECTIONS, further, strict=True)):
            loads = self.loads[k]
            # The slope at zero load is taken towards the first load: with a new first load it is solved again.
            again = int(new.size > 0 and new[0] < loads[1])
            more = np.append(loads[:again], new)
            if more.size:
                present = Solved(*(channel[again:] for channel in self.exact[k]))
                self.exact[k] = _with_loads(present, loads[again:], self._solved(direction, more), more)
                self.loads[k] = np.union1d(loads, more)

    def tables(self) -> Tables:
        """Return the tables through these nodes."""
        spread = max(float(np.ptp(nodes.transmission_error, axis=1).max()) for nodes in self.exact)
        step = max(self.allowed / _STEPS, 1.2 * spread / _MOST_STEPS)
        with ThreadPoolExecutor(min(self.workers, len(_DIRECTIONS))) as pool:
            positive, negative = pool.map(functools.partial(_side, step=step), self.loads, self.exact, self.far)
        # A mean crank torque at rest is not the derivative of a periodic energy.
        rest = _coefficients(self.rest.crank_torque - self.rest.crank_torque.mean())
        rest_step = _rest_step(rest)
        # Where there is hardly any play the splines of its two ends must not cross.
        negative.transmission_error[0] = np.maximum(negative.transmission_error[0], -positive.transmission_error[0])
        for lower, higher in itertools.pairwise(negative.transmission_error):
            np.maximum(lower, higher, out=higher)
        rest = np.round(rest / rest_step) * rest_step
        return Tables(self.drive.pair.ratio, self.period, positive, negative, rest, self.allowed)


def _refined(grid: _Grid, largest: float, looser: float) -> Tables:
    """Add nodes to a grid until its tables are within the allowed errors, `looser` times the default ones; return them.

    They are compared with the model at random places, of torques up to the largest.
    """
    drive, workers, allowed = grid.drive, grid.workers, grid.allowed

    def random_probes(seed: int) -> _Probed:
        return _probed(drive, *_random_states(grid.period, largest, PROBES, seed), workers)

    drawn = 1
    chosen = random_probes(drawn)
    tables = grid.tables()
    probed = _around_the_worst(tables, drive, chosen, grid.spacing, drawn, workers)
    while True:
        off = np.abs(_off(tables, probed))
        coarse = off.max() > allowed
        room = _MOST_VALUES // (2 * grid.angles.size) - grid.load_count
        further, by_angle = (
            _missing_loads(drive, grid.loads, probed, off, allowed)
            if coarse
            else _missing_elsewhere(drive, tables, chosen, room, looser)
        )
        enough = max(a.size + b.size for a, b in zip(grid.loads, further, strict=True)) >= MOST_LOADS
        if by_angle and 2 * grid.samples <= grid.most_samples and (coarse or room >= grid.load_count):
            grid.add_angles()
        elif any(n.size for n in further) and not enough:
            grid.add_loads(further)
        else:
            # Compared at places that refined nothing; where these have larger errors, they are used for refinement too.
            drawn += 1
            fresh = random_probes(drawn)
            near = _around_the_worst(tables, drive, fresh, grid.spacing, drawn, workers)
            probed = _together(probed, near)
            if coarse or np.abs(_off(tables, near)).max() <= allowed:
                break
            continue
        tables = grid.tables()
    states = interpolated(tables, fresh.crank_angle, fresh.torque)
    return dataclasses.replace(
        tables,
        largest_error=float(np.abs(_off(tables, probed)).max()),
        errors=errors_of(tables, states, fresh.exact, fresh.torque),
    )


def _far(
    drive: DriveValue, direction: float, last: float, angles: Array, exact: Solved, workers: int
) -> tuple[float, Solved]:
    """Solve the model at a load far beyond the last."""
    for times in _FAR:
        with contextlib.suppress(InputError):  # contacts can't balance every load
            return times * last, table_nodes.solved(drive, direction, np.array([times * last]), angles, workers=workers)
    end = Solved(*(channel[-1:] for channel in exact))
    beyond = (_FAR[-1] - 1.0) * last
    return _FAR[-1] * last, end._replace(
        transmission_error=end.transmission_error + np.float32(beyond) * end.compliance
    )


def _missing_loads(
    drive: DriveValue, loads: Sequence[Array], probed: _Probed, off: Array, allowed: float
) -> tuple[list[Array], bool]:
    """Return the middles of cells too wide for the allowed error, and whether the angles are too wide instead.

    If exact nodes at the probe's own crank angle have half of the error, the cell of the load is the cause.
    """
    worst = np.argsort(-np.abs(off))[: min(int(np.sum(np.abs(off) > allowed)), _WORST)]
    crank_angle, torque = probed.crank_angle[worst], probed.torque[worst]
    transmission_error, _ = _between_loads(drive, loads, crank_angle, torque)
    by_load = np.abs(transmission_error - probed.exact.transmission_error[worst]) > 0.5 * np.abs(off[worst])
    further = []
    for side_loads, direction in zip(loads, _DIRECTIONS, strict=True):
        cells, _, _ = _cells(side_loads, np.abs(torque[by_load & (torque * direction > 0.0)]))
        further.append(np.array([_middle(*map(float, side_loads[j : j + 2])) for j in np.unique(cells)]))
    return further, bool(2 * by_load.sum() < worst.size)


def _between_loads(drive: DriveValue, loads: Sequence[Array], crank_angle: Array, torque: Array) -> tuple[Array, Array]:
    """Interpolate transmission error and stiffness between exact nodes of the loads at the very crank angles."""
    transmission_error, stiffness = np.empty((2, crank_angle.size))
    for side_loads, direction in zip(loads, _DIRECTIONS, strict=True):
        side = np.flatnonzero(torque * direction > 0.0)
        side = side[np.argsort(crank_angle[side])]
        cells, shares, widths = _cells(side_loads, np.abs(torque[side]))
        for j in np.unique(cells):
            here = side[cells == j]
            rest = table_nodes.at_rest(drive, crank_angle[here]) if j == 0 else None
            ends = table_nodes.solved(drive, direction, side_loads[j : j + 2], crank_angle[here], rest)
            u, h = shares[cells == j], widths[cells == j]
            transmission_error[here] = direction * _hermite(u, h, ends.transmission_error, ends.compliance)
            stiffness[here] = 1.0 / _slope(u, h, ends.transmission_error, ends.compliance)
    return transmission_error, stiffness


def _missing_elsewhere(
    drive: DriveValue, tables: Tables, probed: _Probed, room: int, looser: float
) -> tuple[list[Array], bool]:
    """Return the middles of the cells with the largest errors of stiffness and speed, as many as there is room for.

    None if both are within `looser` times their allowed errors, and on bearings, whose states take longer to solve; and
    whether angles are too wide for the stiffness.
    """
    pair = drive.pair
    if pair.supports is not None:
        return [np.empty(0) for _ in _DIRECTIONS], False
    crank_angle, torque, e = probed
    f = interpolated(tables, crank_angle, torque)
    stated = np.abs(torque) >= STATED_FROM * tables.positive.load[-1]
    allowed = looser * STIFFNESS_SHARE
    stiff = stated & (np.abs(f.stiffness / e.stiffness - 1.0) > allowed)
    most = looser * SPEED_SHARE * np.sqrt(np.mean(np.square(e.rate[stated])))
    speed = np.where(stated & np.isfinite(e.rate), np.square((f.rate - e.rate) / most), 0.0)
    too_stiff, too_fast = stiff.sum() > (1.0 - MOST_STATES) * stated.sum(), speed.sum() > stated.sum()
    blame = too_stiff * stiff / (1.0 - MOST_STATES) + too_fast * speed
    cells: list[tuple[float, int, float]] = []
    sides = (tables.positive, tables.negative)
    for k, side in enumerate(sides):
        here = torque * _DIRECTIONS[k] > 0.0
        j, _, _ = _cells(side.load, np.abs(torque[here]))
        shares = np.bincount(j, blame[here], side.load.size - 1)
        cells += [(float(shares[i]), k, _middle(*side.load[i : i + 2])) for i in np.flatnonzero(shares)]
    cells.sort(reverse=True)
    until = np.searchsorted(np.cumsum([share for share, _, _ in cells]), _BLAMED * blame.sum(), "right") + 1
    chosen = cells[: max(min(int(until), room), 0)]
    further = [np.array(sorted(middle for _, side, middle in chosen if side == k)) for k in range(len(_DIRECTIONS))]
    some = np.flatnonzero(stiff)[:: max(int(stiff.sum()) // _WORST, 1)] if too_stiff else np.empty(0, dtype=int)
    _, exact_stiffness = _between_loads(drive, [side.load for side in sides], crank_angle[some], torque[some])
    by_load = np.abs(e.stiffness[some] / exact_stiffness - 1.0) > allowed
    return further, bool(2 * by_load.sum() < some.size)


def interpolated(tables: Tables, crank_angle: ArrayLike, torque: ArrayLike) -> States:
    """Interpolate as the native FMU does.

    Parameters
    ----------
    crank_angle, torque
        Of shape (places,), rad and N·m, the torque within the tables and other than 0.
    """
    angle, signed = (np.asarray(v, dtype=float) for v in (crank_angle, torque))
    angles = tables.rest_torque.size
    near, weights, rates = _spline_weights(tables.period, angles, angle)
    coarse, coarse_weights, _ = _spline_weights(tables.period, tables.positive.pressure.shape[1], angle)
    states = States(*np.empty((len(States._fields), *angle.shape)))
    states.transmission_error[...] = _transmission_error(tables, angle, signed)
    for side, direction in ((tables.positive, 1.0), (tables.negative, -1.0)):
        here = signed * direction > 0.0
        load, among, weight, by_angle = np.abs(signed[here]), near[:, here], weights[:, here], rates[:, here]
        j, u, h = _cells(side.load, load)
        x, c = _ends(side, j, weight, among)
        states.stiffness[here] = 1.0 / np.maximum(_slope(u, h, x, c), LEAST_COMPLIANCE)
        x, c = _ends(side, j, by_angle, among)
        states.rate[here] = direction * _hermite(u, h, x, c)
        energy_rate = _integral(u, h, x, c) + np.sum(by_angle * _energy(side)[j, among], axis=0)
        rest = np.sum(weight * tables.rest_torque[among], axis=0)
        states.crank_torque[here] = rest - direction * load / tables.ratio - energy_rate
        j, u, _ = _cells(side.pressure_load, load)
        low, high = (
            np.sum(coarse_weights[:, here] * side.pressure[row, coarse[:, here]], axis=0) for row in (j, j + 1)
        )
        states.pressure[here] = np.sqrt(np.maximum((1.0 - u) * low + u * high, 0.0))
    return states


def _energy(side: Side) -> Array:
    """Coefficients of the transmission error integrated over the load, up to each load, shape (loads, angles)."""
    energy = np.zeros_like(side.transmission_error)
    for k, width in enumerate(np.diff(side.load)):
        ends = np.s_[k : k + 2]
        energy[k + 1] = energy[k] + _integral(1.0, float(width), side.transmission_error[ends], side.compliance[ends])
    return energy


def _transmission_error(tables: Tables, crank_angle: Array, torque: Array) -> Array:
    """Interpolate the transmission error as `interpolated` does."""
    near, weights, _ = _spline_weights(tables.period, tables.rest_torque.size, crank_angle)
    transmission_error = np.empty_like(crank_angle)
    for side, direction in zip((tables.positive, tables.negative), _DIRECTIONS, strict=True):
        here = torque * direction > 0.0
        j, u, h = _cells(side.load, np.abs(torque[here]))
        transmission_error[here] = direction * _hermite(u, h, *_ends(side, j, weights[:, here], near[:, here]))
    return transmission_error


def _spline_weights(period: float, angles: int, crank_angle: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Nodes of crank angles, shape (4, places), and the weights there of a spline and of its derivative."""
    position = crank_angle / period % 1.0 * angles
    first = np.minimum(position.astype(int), angles - 1)
    s = position - first
    weights = np.array([(1.0 - s) ** 3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 1.0 + 3.0 * s + 3.0 * s**2 - 3.0 * s**3, s**3])
    rates = np.array([-((1.0 - s) ** 2), 3.0 * s**2 - 4.0 * s, 1.0 + 2.0 * s - 3.0 * s**2, s**2])
    return (first + np.arange(-1, 3)[:, None]) % angles, weights / 6.0, 0.5 * angles / period * rates


def _ends(side: Side, cell: NDArray[np.int64], weights: Array, near: NDArray[np.int64]) -> tuple[Array, Array]:
    """Deviations and compliances at both ends of cells, or their rates by the crank angle, shape (2, places)."""
    x, c = (
        np.array([np.sum(weights * values[row, near], axis=0) for row in (cell, cell + 1)])
        for values in (side.transmission_error, side.compliance)
    )
    return x, c


def _cells(loads: Array, load: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Cells that contain loads, the loads' places in them as shares (0 to 1), and the cells' widths."""
    j = np.clip(np.searchsorted(loads, load, "right") - 1, 0, loads.size - 2)
    width = loads[j + 1] - loads[j]
    return j, (load - loads[j]) / width, width


def errors_of(tables: Tables, approximate: States, exact: States, torque: Array) -> Errors:
    """Return the errors of tables from their states and the exact ones at torques (N·m)."""
    stated = np.abs(torque) >= STATED_FROM * tables.positive.load[-1]
    f, e = (States(*(channel[stated] for channel in states)) for states in (approximate, exact))

    def share(channel: Array, of: Array) -> tuple[float, float]:
        off = np.abs(channel / of - 1.0)
        return float(np.quantile(off, MOST_STATES)), float(off.max())

    crank = np.abs(f.crank_torque - e.crank_torque) / np.abs(torque[stated] / tables.ratio)
    return Errors(
        share(f.stiffness, e.stiffness),
        share(f.pressure, e.pressure),
        float(np.sqrt(np.mean((f.rate - e.rate) ** 2) / np.mean(e.rate**2))),
        (float(np.sqrt(np.mean(crank**2))), float(crank.max())),
    )


def _off(tables: Tables, probed: _Probed) -> Array:
    """Errors of the transmission error, rad."""
    return _transmission_error(tables, probed.crank_angle, probed.torque) - probed.exact.transmission_error


class _Probed(NamedTuple):
    """The exact model at crank angles (rad) and torques (N·m), each of shape (probes,)."""

    crank_angle: Array
    torque: Array
    exact: States


def _random_states(period: float, largest: float, probes: int, seed: int) -> tuple[Array, Array]:
    """Random crank angles, and torques evenly and evenly in the logarithm."""
    random = np.random.default_rng(seed)
    size = np.where(
        random.random(probes) < 0.5, random.uniform(0.0, 1.0, probes), 10.0 ** random.uniform(-4.0, 0.0, probes)
    )
    torque = largest * size * random.choice([-1.0, 1.0], probes)
    return np.sort(random.uniform(0.0, period, probes)), torque


def _around_the_worst(
    tables: Tables, drive: DriveValue, probed: _Probed, spacing: float, seed: int, workers: int
) -> _Probed:
    """Add places increasingly close to the largest errors, which are narrower than the distance between probes."""
    random, probes = np.random.default_rng(seed), probed
    largest = min(tables.positive.load[-1], tables.negative.load[-1])
    for reach in _REACHES:
        worst = np.repeat(np.argsort(-np.abs(_off(tables, probes)))[:_WORST], _NEIGHBOURS)
        crank_angle = probes.crank_angle[worst] + reach * spacing * random.uniform(-1.0, 1.0, worst.size)
        torque = probes.torque[worst] * (1.0 + 0.1 * reach * random.uniform(-1.0, 1.0, worst.size))
        near = _probed(drive, np.mod(crank_angle, tables.period), np.clip(torque, -largest, largest), workers)
        probes = _together(probes, near)
    return probes


def _together(*parts: _Probed) -> _Probed:
    angles, torques, states = zip(*parts, strict=True)
    exact = States(*(np.concatenate(channel) for channel in zip(*states, strict=True)))
    return _Probed(np.concatenate(angles), np.concatenate(torques), exact)


def _probed(drive: DriveValue, crank_angle: Array, torque: Array, workers: int = 1) -> _Probed:
    pair = drive.pair
    slices = drive.slices
    if pair.supports is not None:
        # Smaller torques are on a tangent.
        torque = np.copysign(np.maximum(np.abs(torque), play_loads(pair)[1]), torque)
    # A solution is found quickly from a neighbour's under a similar torque.
    rank = np.argsort(np.argsort(torque)) // _LIKE
    order = np.lexsort((crank_angle, rank))
    crank_angle, torque = crank_angle[order], torque[order]
    swept = solve(drive, torque[None], crank_angle, slices, with_play=False, workers=workers)
    crank_torque, rate = np.full((2, crank_angle.size), math.nan)
    if pair.supports is None:
        problem = rigid_problem(drive, slices)
        contact.sweep_crank_side(problem, crank_angle, swept.transmission_error[0], crank_torque, rate)
    stiffness, pressure = swept.torsional_stiffness[0], swept.max_contact_pressure[0]
    return _Probed(
        crank_angle,
        torque,
        States(swept.transmission_error[0], stiffness, rate - 1.0 / pair.ratio, crank_torque, pressure),
    )
