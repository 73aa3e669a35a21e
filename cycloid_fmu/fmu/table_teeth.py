"""How the tables of `tables.py` are read and interpolated in Python, by the formulas of native/table.c and drive.c.

Everything lies in two arrays, for each further argument of a kernel is time at every step. `numbers`: ratio, period,
crank angles, how many loads each direction has, and for what is told alone (contact count and pressure), whether there
is a torque at rest, and the crank angles of what is told alone; the loads of each direction, all and told; the
deviation's integral over the load up to each node; torque and energy at rest. `values`, of each direction: deviation,
compliance, contact count and square of the largest pressure. The loads of one crank angle stand side by side.
"""

from __future__ import annotations

import copy
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import compiled
from cycloid_fmu.fmu.teeth import ContactTeeth, StepError

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Side = tuple[Array, Array, Array32, Array32, Array32, Array32]
_Nodes = tuple[int, int, int, int]
_Weights = tuple[float, float, float, float]
_Place = tuple[_Nodes, _Weights, _Weights, float]

TABLE = "drive.table"  # in an FMU's resources
MAGIC, VERSION = b"cycltab\n", 4
HEAD = struct.Struct("<8sIIQQ")  # magic, version, nothing, size of the file, hash of the rest
MOST_LOADS = 192  # of one direction; table.h has the same
NO_PLAY = 1e-13  # rad
_LEAST_COMPLIANCE = 1e-12  # rad/(N·m): between nodes a table may have none
_CLOSE = 1e-9  # of a cell: a step this short is the last
_FIRST = 9  # number of the loads' first


@dataclass(frozen=True)
class Interpolation:
    """The tables of a file, as the kernels want them (see above).

    Attributes
    ----------
    numbers, values
        All that is interpolated.
    largest
        |T| that both directions reach, N·m.
    """

    numbers: Array
    values: Array32

    @property
    def largest(self) -> tuple[float, float]:
        """|T| that positive and negative torque reach, N·m."""
        (positive, first, *_), (negative, second, *_) = _side(self.numbers, 0), _side(self.numbers, 1)
        return float(self.numbers[first + positive - 1]), float(self.numbers[second + negative - 1])


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, size: int) -> bytes:
        self._at += size
        if self._at > len(self._data):
            raise ValueError
        return self._data[self._at - size : self._at]

    def numbers(self, form: str) -> tuple[Any, ...]:
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def text(self) -> str:
        return self.take(*self.numbers("H")).decode()

    def channel(self, angles: int, order: int) -> tuple[Array, float]:
        """Whole steps of each crank angle from first or second differences of seven bits a byte, and the step."""
        step, size = self.numbers("dI")
        data = np.frombuffer(self.take(size), dtype=np.uint8)
        first = np.append(0, np.flatnonzero(data < 128) + 1)
        if first.size != angles + 1 or first[-1] != size or not 0.0 < step < math.inf:
            raise ValueError
        place = np.arange(size) - np.repeat(first[:-1], np.diff(first))
        if place.size and place.max() > 9:
            raise ValueError
        groups = (data & np.uint8(127)).astype(np.uint64) << (np.uint64(7) * place.astype(np.uint64))
        folded = np.add.reduceat(groups, first[:-1])
        differences = (folded >> np.uint64(1)) ^ (np.uint64(0) - (folded & np.uint64(1)))
        whole = np.cumsum(differences) if order == 1 else np.cumsum(np.cumsum(differences))
        return whole.astype(np.int64).astype(float), step

    def channels(self, angles: int, loads: int, order: int) -> Array32:
        """Return values of a channel at each load, shape (angles, loads)."""
        values = np.empty((angles, loads), np.float32)
        for j in range(loads):
            whole, step = self.channel(angles, order)
            values[:, j] = whole * step
        if not (np.abs(values) < 1e30).all():
            raise ValueError
        return values

    def end(self) -> None:
        if self._at != len(self._data):
            raise ValueError


def read(data: bytes, name: str) -> Interpolation:
    """Return the tables in the bytes of a file.

    Parameters
    ----------
    data
        As `tables.write` returns them.
    name
        What a message calls the file.

    Raises
    ------
    ValueError
        If the bytes are none of a table, of another version, or damaged; the text is one sentence.
    """
    if len(data) < HEAD.size or data[: len(MAGIC)] != MAGIC:
        raise ValueError(f"{name}: this is not a table of a cycloid drive")
    _, version, _, size, hashed = HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"{name}: the table has version {version}, this package reads {VERSION}; build the FMU again")
    if size != len(data) or hashed != fnv1a(data[HEAD.size :]):
        raise ValueError(f"{name}: the table is damaged: its size or hash does not fit")
    try:
        return _read_body(_Reader(data[HEAD.size :]))
    except (ValueError, struct.error, OverflowError):
        raise ValueError(f"{name}: the table is damaged") from None


def _read_body(reader: _Reader) -> Interpolation:
    reader.text()
    _, variables = reader.numbers("II")
    for _ in range(variables):
        reader.text()
        *_, size = reader.numbers("BBBBddI")
        reader.take(8 * size)
    ratio, period, *_, angles, told, positive, told_positive, negative, told_negative = reader.numbers("7dIIIIII")
    loads = (positive, told_positive), (negative, told_negative)
    if not (abs(ratio) >= 1.0 and 0.0 < period < 1e6 and 4 <= told <= angles <= 10**8 and min(map(min, loads)) >= 2):
        raise ValueError
    sides = [_read_side(reader, angles, told, *counts) for counts in loads]
    whole, step = reader.channel(angles, 2)
    reader.take(*reader.numbers("Q"))  # the native FMU's contact problem
    reader.end()
    return assembled(ratio, period, sides, whole * step)


def assembled(ratio: float, period: float, sides: Sequence[Side], rest_torque: Array) -> Interpolation:
    """Return tables as the kernels want them.

    Parameters
    ----------
    ratio, period
        As of `tables.Tables`.
    sides
        Of positive and of negative torque: the loads, those of what is told alone, deviation and compliance, each of
        shape (angles, loads), contact count and the pressure's square, each (told angles, told loads).
    rest_torque
        Spline coefficients, shape (angles,), N·m.
    """
    angles, loads = rest_torque.size, [(load.size, told_load.size) for load, told_load, *_ in sides]
    told = sides[0][-1].shape[0]
    rest = _rest(rest_torque, period / angles) if rest_torque.any() else np.empty(0)
    head = [ratio, period, angles, *loads[0], *loads[1], float(rest.size > 0), told]
    integrals = [_integral(load, x, c).ravel() for load, _, x, c, _, _ in sides]
    numbers = np.concatenate([head, *(load for side in sides for load in side[:2]), *integrals, rest])
    return Interpolation(numbers, np.concatenate([part.ravel() for side in sides for part in side[2:]]))


def _integral(load: Array, deviation: Array32, compliance: Array32) -> Array:
    """Integral of Hermite's cubics over the load, up to each load."""
    h, x, c = np.diff(load), deviation.astype(float), compliance.astype(float)
    cells = 0.5 * h * (x[:, :-1] + x[:, 1:]) + h * h / 12.0 * (c[:, :-1] - c[:, 1:])
    return np.hstack([np.zeros((x.shape[0], 1)), np.cumsum(cells, axis=1)])


def _read_side(reader: _Reader, angles: int, told: int, loads: int, told_loads: int) -> Side:
    load, told_load = (_read_loads(reader, count) for count in (loads, told_loads))
    if load[-1] != told_load[-1]:
        raise ValueError
    shapes = ((angles, loads, 2), (angles, loads, 1), (told, told_loads, 1), (told, told_loads, 1))
    deviation, compliance, contact_count, pressure = (reader.channels(*shape) for shape in shapes)
    return load, told_load, deviation, compliance, contact_count, pressure


def _read_loads(reader: _Reader, count: int) -> Array:
    load = np.array(reader.numbers(f"{count}d"))
    if count > MOST_LOADS or load[0] != 0.0 or not (np.diff(load) > 0.0).all() or not np.isfinite(load).all():
        raise ValueError
    return load


def _rest(torque: Array, width: float) -> Array:
    """Torque at rest, and its integral, the energy, at the nodes: a crank turned round gives none."""
    torque = torque - torque.mean()
    mass = np.roll(torque, 2) + 11.0 * np.roll(torque, 1) + 11.0 * torque + np.roll(torque, -1)
    energy = np.append(0.0, np.cumsum(width * mass[1:] / 24.0))
    return np.concatenate([torque, energy - energy.min()])


def fnv1a(data: bytes) -> int:
    """Return the 64-bit FNV-1a hash over eight-byte words (the last filled with zeros)."""
    words = np.frombuffer(data + bytes(-len(data) % 8), dtype="<u8")
    return int(_fnv1a(words))


@compiled
def _fnv1a(words: NDArray[np.uint64]) -> np.uint64:
    found = np.uint64(0xCBF29CE484222325)
    for word in words:
        found = np.uint64((found ^ word) * np.uint64(0x100000001B3))
    return found


# ---- kernels; a side is 0 for positive torque, 1 for negative, mirrored so that everything grows with the load ----


@compiled
def _place(numbers: Array, theta: float) -> _Place:
    """Nodes and weights at a crank angle, those of the derivative, and its share of the way between two nodes."""
    return _place_among(numbers[1], int(numbers[2]), theta)


@compiled
def _place_among(period: float, n: int, theta: float) -> _Place:
    turns = theta / period
    at = (turns - math.floor(turns)) * n
    first = int(at)
    s = at - first
    if first >= n:
        first = 0
    weights = (
        (1.0 - s) * (1.0 - s) * (1.0 - s) / 6.0, (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
        (1.0 + 3.0 * s + 3.0 * s * s - 3.0 * s * s * s) / 6.0, s * s * s / 6.0,
    )  # fmt: skip
    scale = n / period
    rates = (
        -0.5 * (1.0 - s) * (1.0 - s) * scale, (1.5 * s * s - 2.0 * s) * scale, (0.5 + s - 1.5 * s * s) * scale,
        0.5 * s * s * scale,
    )  # fmt: skip
    return ((first + n - 1) % n, first, (first + 1) % n, (first + 2) % n), weights, rates, s


@compiled
def _side(numbers: Array, side: int) -> tuple[int, int, int, int]:
    """Loads, where the first of them stands among the numbers, where the side's values begin, and a channel's size."""
    angles, positive, told_loads = int(numbers[2]), int(numbers[3]), int(numbers[4])
    if side == 0:
        return positive, _FIRST, 0, angles * positive
    negative, told = int(numbers[5]), int(numbers[8])
    begin = 2 * (angles * positive + told * told_loads)
    return negative, _FIRST + positive + told_loads, begin, angles * negative


@compiled
def _integrals(numbers: Array) -> int:
    """Where the deviation's integrals begin among the numbers."""
    return _FIRST + int(numbers[3]) + int(numbers[4]) + int(numbers[5]) + int(numbers[6])


@compiled
def _blend(values: Array | Array32, first: int, loads: int, nodes: _Nodes, weights: _Weights) -> float:
    return float(
        weights[0] * values[first + nodes[0] * loads] + weights[1] * values[first + nodes[1] * loads]
        + weights[2] * values[first + nodes[2] * loads] + weights[3] * values[first + nodes[3] * loads]
    )  # fmt: skip


@compiled
def _cell(numbers: Array, first: int, loads: int, load: float) -> int:
    low, count = 0, loads - 1
    while count > 1:
        half = count // 2
        if numbers[first + low + half] <= load:
            low += half
        count -= half
    return low


@compiled
def _hermite(u: float, h: float, a: float, b: float, ca: float, cb: float) -> float:
    v = 1.0 - u
    return (1.0 + 2.0 * u) * v * v * a + (3.0 - 2.0 * u) * u * u * b + h * u * v * (v * ca - u * cb)


@compiled
def _hermite_slope(u: float, h: float, a: float, b: float, ca: float, cb: float) -> float:
    v = 1.0 - u
    return 6.0 * u * v * (b - a) / h + v * (1.0 - 3.0 * u) * ca + u * (3.0 * u - 2.0) * cb


@compiled
def _at(numbers: Array, values: Array32, place: _Place, side: int, load: float) -> tuple[float, float, float]:
    """Deviation, its change with the crank angle, and compliance."""
    nodes, weights, rates, _ = place
    loads, first, begin, size = _side(numbers, side)
    j = _cell(numbers, first, loads, load)
    h = numbers[first + j + 1] - numbers[first + j]
    u = (load - numbers[first + j]) / h
    x, c = begin + j, begin + size + j
    a, b = _blend(values, x, loads, nodes, weights), _blend(values, x + 1, loads, nodes, weights)
    ca, cb = _blend(values, c, loads, nodes, weights), _blend(values, c + 1, loads, nodes, weights)
    ra, rb = _blend(values, x, loads, nodes, rates), _blend(values, x + 1, loads, nodes, rates)
    rca, rcb = _blend(values, c, loads, nodes, rates), _blend(values, c + 1, loads, nodes, rates)
    return _hermite(u, h, a, b, ca, cb), _hermite(u, h, ra, rb, rca, rcb), _hermite_slope(u, h, a, b, ca, cb)


@compiled
def _energy(numbers: Array, values: Array32, place: _Place, side: int, load: float) -> tuple[float, float]:
    """Integral of the deviation over the load, and its change with the crank angle."""
    nodes, weights, rates, _ = place
    loads, first, begin, size = _side(numbers, side)
    j = _cell(numbers, first, loads, load)
    h = numbers[first + j + 1] - numbers[first + j]
    u = (load - numbers[first + j]) / h
    u2 = u * u
    low, high = h * (u - u2 * u + 0.5 * u2 * u2), h * (u2 * u - 0.5 * u2 * u2)
    low_slope = h * h * (0.5 * u2 - 2.0 / 3.0 * u2 * u + 0.25 * u2 * u2)
    high_slope = h * h * (0.25 * u2 * u2 - u2 * u / 3.0)
    below = _integrals(numbers) + side * int(numbers[2]) * int(numbers[3])
    energy = rate = 0.0
    for i in range(4):
        x = begin + nodes[i] * loads + j
        total = numbers[below + nodes[i] * loads + j] + low * values[x] + high * values[x + 1]
        total += low_slope * values[x + size] + high_slope * values[x + size + 1]
        energy += weights[i] * total
        rate += rates[i] * total
    return energy, rate


@compiled
def _rest_first(numbers: Array) -> int:
    """Where the torque at rest stands among the numbers; 0 where there is none."""
    return _integrals(numbers) + int(numbers[2]) * (int(numbers[3]) + int(numbers[5])) if numbers[7] else 0


@compiled
def _rest_torque(numbers: Array, place: _Place) -> float:
    first = _rest_first(numbers)
    if first == 0:
        return 0.0
    nodes, weights, _, _ = place
    return _blend(numbers, first, 1, nodes, weights)


@compiled
def _rest_energy(numbers: Array, place: _Place) -> float:
    first = _rest_first(numbers)
    if first == 0:
        return 0.0
    nodes, _, _, s = place
    t = 1.0 - s
    total = (1.0 - t * t * t * t) * numbers[first + nodes[0]]
    total += (3.0 * s * s * s * s - 8.0 * s * s * s + 16.0 * s) * numbers[first + nodes[1]]
    total += (4.0 * s + 6.0 * s * s + 4.0 * s * s * s - 3.0 * s * s * s * s) * numbers[first + nodes[2]]
    total += s * s * s * s * numbers[first + nodes[3]]
    return float(numbers[first + int(numbers[2]) + nodes[1]] + numbers[1] / numbers[2] * total / 24.0)


@compiled
def loaded(numbers: Array, values: Array32, theta: float, torque: float) -> tuple[float, float, float, float]:
    """Deviation (rad), stiffness (N·m/rad), crank torque (N·m) and dφ_b/dθ (1) under a torque within the tables."""
    place = _place(numbers, theta)
    side, load = (0, torque) if torque >= 0.0 else (1, -torque)
    direction = 1.0 if side == 0 else -1.0
    deviation, rate, compliance = _at(numbers, values, place, side, load)
    by_angle = _energy(numbers, values, place, side, load)[1]
    crank_torque = _rest_torque(numbers, place) - torque / numbers[0] - by_angle
    return (
        direction * deviation,
        1.0 / max(compliance, _LEAST_COMPLIANCE),
        crank_torque,
        direction * rate + 1.0 / numbers[0],
    )


@compiled
def ends(numbers: Array, values: Array32, theta: float) -> tuple[float, float, float, float]:
    """Low and high end of the play (rad; the low one above the high one where there is none), and dφ_b/dθ of both."""
    nodes, weights, rates, _ = _place(numbers, theta)
    positive, _, first, _ = _side(numbers, 0)
    negative, _, second, _ = _side(numbers, 1)
    return (
        -_blend(values, second, negative, nodes, weights), _blend(values, first, positive, nodes, weights),
        1.0 / numbers[0] - _blend(values, second, negative, nodes, rates),
        1.0 / numbers[0] + _blend(values, first, positive, nodes, rates),
    )  # fmt: skip


@compiled
def _load(numbers: Array, values: Array32, place: _Place, side: int, goal: float, series: float) -> float:
    """Load at which deviation and compliance in series make the goal; 0 below the first, infinite above the last."""
    nodes, weights, _, _ = place
    loads, first, begin, size = _side(numbers, side)
    low, high = 0, loads - 1
    a = _blend(values, begin, loads, nodes, weights)
    b = _blend(values, begin + high, loads, nodes, weights) + series * numbers[first + high]
    if goal <= a:
        return 0.0
    if not goal <= b:
        return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        at = _blend(values, begin + middle, loads, nodes, weights) + series * numbers[first + middle]
        if at <= goal:
            low, a = middle, at
        else:
            high, b = middle, at
    h = numbers[first + high] - numbers[first + low]
    ca = _blend(values, begin + size + low, loads, nodes, weights) + series
    cb = _blend(values, begin + size + high, loads, nodes, weights) + series
    u = (goal - a) / (b - a) if b > a else 0.0
    left, right = 0.0, 1.0
    for _ in range(60):
        short, slope = goal - _hermite(u, h, a, b, ca, cb), h * _hermite_slope(u, h, a, b, ca, cb)
        if abs(short) < _CLOSE * slope:  # Newton's next error is the square of this step: below rounding
            return float(numbers[first + low] + min(max(u + short / slope, 0.0), 1.0) * h)
        if short > 0.0:
            left = u
        else:
            right = u
        following = u + short / slope if slope > 0.0 else math.inf
        u = following if left <= following <= right else 0.5 * (left + right)
    return float(numbers[first + low] + u * h)


@compiled
def held(numbers: Array, values: Array32, theta: float, flange: float, series: float) -> float:
    """Torque at which the flange stands at a deviation behind a compliance; infinite beyond the tables."""
    place = _place(numbers, theta)
    nodes, weights, _, _ = place
    loads, _, begin, _ = _side(numbers, 0)
    if flange > _blend(values, begin, loads, nodes, weights):
        return _load(numbers, values, place, 0, flange, series)
    return -_load(numbers, values, place, 1, -flange, series)


@compiled
def stored(numbers: Array, values: Array32, theta: float, torque: float) -> tuple[float, float]:
    """Integral of the deviation over a torque from 0, and the energy at rest, J."""
    place = _place(numbers, theta)
    side, load = (0, torque) if torque >= 0.0 else (1, -torque)
    return _energy(numbers, values, place, side, load)[0], _rest_energy(numbers, place)


@compiled
def pressed(
    numbers: Array, values: Array32, theta: float, flange: float, series: float
) -> tuple[float, float, float, float, float, float]:
    """What holds the flange at a deviation behind a compliance, as `TableTeeth.press` needs it.

    Torque (N·m; infinite beyond the tables), deviation (rad), stiffness (N·m/rad; 0 within the play), stored energy
    (J), crank torque (N·m) and dφ_b/dθ (1).
    """
    torque = held(numbers, values, theta, flange, series)
    if not math.isfinite(torque):
        return torque, math.nan, math.nan, math.nan, math.nan, math.nan
    deviation, stiffness, crank_torque, rate = loaded(numbers, values, theta, torque)
    if torque == 0.0:
        low, high, _, _ = ends(numbers, values, theta)
        free = high - low > NO_PLAY
        deviation, stiffness = (flange, 0.0) if free else (0.5 * (low + high), stiffness)
    below, rest = stored(numbers, values, theta, torque)
    energy = torque * flange - below - 0.5 * series * torque * torque + rest
    return torque, deviation, stiffness, energy, crank_torque, rate


@compiled
def sharing(numbers: Array, values: Array32, theta: float, torque: float) -> tuple[int, float]:
    """Pins in contact, and the largest pressure (Pa), under a torque."""
    told, told_loads = int(numbers[8]), int(numbers[4 if torque >= 0.0 else 6])
    nodes, weights, _, s = _place_among(numbers[1], told, theta)
    side, load = (0, torque) if torque >= 0.0 else (1, -torque)
    loads, first, begin, size = _side(numbers, side)
    first, counts = first + loads, begin + 2 * size
    j = _cell(numbers, first, told_loads, load)
    low, high = numbers[first + j], numbers[first + j + 1]
    nearest = j + 1 if 2.0 * load > low + high or j == 0 else j
    count = values[counts + nodes[1 if s < 0.5 else 2] * told_loads + nearest]
    u, pressure = (load - low) / (high - low), counts + told * told_loads + j
    square = (1.0 - u) * _blend(values, pressure, told_loads, nodes, weights)
    square += u * _blend(values, pressure + 1, told_loads, nodes, weights)
    return int(count), math.sqrt(max(square, 0.0))


class TableTeeth:
    """`Teeth` that are interpolated; the forces of single pins, which tables do not hold, are solved when asked for.

    Parameters
    ----------
    tables
        What is interpolated.
    contacts
        Gives the exact contacts that the tables were made of, nothing solved; they are left as they are.
    """

    def __init__(self, tables: Interpolation, contacts: Callable[[], ContactTeeth]) -> None:
        self._numbers, self._values = tables.numbers, tables.values
        self._contacts = contacts
        self._solved: tuple[tuple[float, float], ContactTeeth] | None = None
        self._positive, self._negative = tables.largest
        self.torque = 0.0
        self._crank: tuple[float, float] | None = None
        self._before: tuple[float, tuple[float, float] | None] = self.torque, self._crank

    def play(self, theta: float, x: float) -> tuple[float, float, float]:
        """As of `Teeth`; by how much there is none is not in the tables."""
        low, high, _, _ = ends(self._numbers, self._values, theta)
        return (low, high, 0.0) if high - low > NO_PLAY else (math.nan, math.nan, math.inf)

    def touch_rate(self, theta: float, x: float, side: float) -> float:
        """As of `Teeth`."""
        rates = ends(self._numbers, self._values, theta)[2:]
        return float(rates[side > 0.0])

    def equilibrium(self, theta: float, torque: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        if not -self._negative <= torque <= self._positive:
            raise StepError(
                f"flange_b.tau and friction_torque make {torque:g} N.m: the FMU's table reaches "
                f"{self._positive if torque > 0.0 else self._negative:g} N.m; build it with a larger rated torque"
            )
        self.torque = torque
        x, stiffness, crank_torque, rate = loaded(self._numbers, self._values, theta, torque)
        if torque == 0.0:
            low, high, _, _ = ends(self._numbers, self._values, theta)
            x = 0.5 * (low + high)
        self._crank = crank_torque, rate
        return x, stiffness

    def behind(self, theta: float, flange: float, compliance: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        return self.press(theta, flange, compliance, x)[:2]

    def press(
        self, theta: float, flange: float, compliance: float, x: float
    ) -> tuple[float, float, float, float, float]:
        """As of `Teeth`."""
        torque, x, stiffness, energy, crank_torque, rate = pressed(
            self._numbers, self._values, theta, flange, compliance
        )
        if not -self._negative <= torque <= self._positive:
            raise StepError(
                f"flange_b.phi is {flange:g} rad from flange_a.phi/ratio, where the torque is beyond the "
                f"{self._positive if torque > 0.0 else self._negative:g} N.m of the FMU's table: build it with a "
                "larger rated torque"
            )
        self.torque, self._crank = torque, (crank_torque, rate)
        return x, stiffness, energy, crank_torque, torque

    def crank_side(self, theta: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        if self._crank is None:
            self._crank = loaded(self._numbers, self._values, theta, self.torque)[2:]
        return self._crank

    def sharing(self, theta: float) -> tuple[int, float]:
        """As of `Teeth`."""
        return sharing(self._numbers, self._values, theta, self.torque)

    def _solve_pins(self, theta: float) -> ContactTeeth:
        """Return contacts that carry the torque, solved from nothing: what was asked for before is of no effect."""
        at = theta, self.torque
        if self._solved is None or self._solved[0] != at:
            teeth = self._contacts().copy()
            teeth.equilibrium(theta, self.torque, loaded(self._numbers, self._values, theta, self.torque)[0])
            teeth.sharing(theta)
            self._solved = at, teeth
        return self._solved[1]

    def pin_force(self, theta: float) -> list[float]:
        """As of `Teeth`."""
        return self._solve_pins(theta).pin_force(theta)

    def pin_pressure(self, theta: float) -> list[float]:
        """As of `Teeth`."""
        return self._solve_pins(theta).pin_pressure(theta)

    def begin(self) -> None:
        """As of `Teeth`."""
        self._before = self.torque, self._crank

    def undo(self) -> None:
        """As of `Teeth`."""
        self.torque, self._crank = self._before

    def copy(self) -> Self:
        """As of `Teeth`."""
        return copy.copy(self)

    def state(self) -> dict[str, Any]:
        """As of `Teeth`."""
        return {"torque": self.torque, "crank": self._crank}

    def restore(self, state: dict[str, Any]) -> None:
        """As of `Teeth`."""
        self.torque, crank = state["torque"], state["crank"]
        self._crank = None if crank is None else tuple(crank)
