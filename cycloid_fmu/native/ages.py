"""Tables of an ageing drive: at several states of its life, on the same nodes, for interpolation in an FMU.

Between two states everything is linear in the crank turns worn, and in the clearance of a bearing that wears. A linear
combination of energies is an energy: the torques of both flanges stay its derivatives. Splines over the crank angle and
Hermite's cubics over the load are refined without an error, which gives tables with different nodes common ones.
"""

from __future__ import annotations

import dataclasses
import functools
import heapq
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.fmu.constants import MOST_AGES, MOST_LOADS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.native import tables
from cycloid_fmu.native.tables import Side, States, Tables
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_after

Array = NDArray[np.float64]
ACCURACY = 0.5 / 3600 * math.pi / 180  # rad: largest error of the deviation between two states
_PROBES = 2000  # random crank angles and torques in the middle between two states
_MOST_WORDS = 65535  # of a stored compliance, in 16 bits
_MIDDLES = 8  # random states at which the finished tables are compared with the model


@dataclasses.dataclass(frozen=True)
class Ages:
    """Tables of a drive over its life.

    Attributes
    ----------
    crank_turns, clearance
        Crank turns worn, and growth of the wearing bearing's diametral clearance (m): the nodes, ascending from 0.
    crank_turns_per_second, clearance_per_second
        Growth rates of both with the age; the first is also proportional to the wear factor.
    tables
        Tables at each combination of both, the clearance varying fastest; all on the same nodes.
    largest_error
        Largest error of the deviation between them at random states, crank angles and torques, rad.
    """

    crank_turns: Array
    clearance: Array
    crank_turns_per_second: float
    clearance_per_second: float
    tables: tuple[Tables, ...]
    largest_error: float


def ages_of(pair: Pair, surface: ErrorSurface, tables_at: Callable[[Pair, ErrorSurface, int], Tables]) -> Ages:
    """Return the tables of a drive whose surface has a life with a forecast, at as many states as `ACCURACY` needs.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors with their life.
    tables_at
        Function that makes the tables of a drive at one state; arguments are the drive and the number of tables made
        before.
    """
    life = surface.life
    assert life is not None
    assert life.ageing is not None
    ageing = life.ageing
    grows = bool(ageing.bearing) and pair.supports is not None and ageing.clearance_per_second > 0.0
    last = min(
        ageing.largest_age * ageing.crank_turns_per_second * ageing.largest_wear_factor, float(life.crank_turns[-1])
    )
    ends = [0.0, last], [0.0, ageing.largest_age * ageing.clearance_per_second] if grows else [0.0]

    @functools.cache
    def made(turns: float, clearance: float) -> Tables:
        return tables_at(*drive_at(pair, surface, turns, clearance), made.cache_info().currsize)

    def middle(axis: int, low: float, high: float) -> tuple[float, int, float, float]:
        """Return the error in the middle between two nodes of an axis, negative for the heap, and the cell."""
        at, worst = 0.5 * (low + high), 0.0
        for other in {ends[1 - axis][0], ends[1 - axis][-1]}:
            state, before, after = ((v, other) if axis == 0 else (other, v) for v in (at, low, high))
            found = [made(*one) for one in (before, after)]
            probed = tables.probed_at(*drive_at(pair, surface, *state), _reach(found), _PROBES)
            mixed = sum(0.5 * tables.interpolated(one, probed.crank_angle, probed.torque).deviation for one in found)
            worst = max(worst, float(np.abs(mixed - probed.exact.deviation).max()))
        return -worst, axis, low, high

    nodes = tuple(map(list, ends))
    cells = [middle(axis, *one) for axis in (0, 1) for one in itertools.pairwise(ends[axis])]
    heapq.heapify(cells)
    while cells and -cells[0][0] > ACCURACY:
        _, axis, low, high = cells[0]
        if (len(nodes[axis]) + 1) * len(nodes[1 - axis]) > MOST_AGES:
            break
        heapq.heappop(cells)
        at = 0.5 * (low + high)
        nodes[axis].append(at)
        for cell in ((low, at), (at, high)):
            heapq.heappush(cells, middle(axis, *cell))
    turns, clearance = (np.array(sorted(one)) for one in nodes)
    alike = on_common_nodes([made(float(t), float(c)) for t, c in itertools.product(turns, clearance)])
    ages = Ages(turns, clearance, ageing.crank_turns_per_second, ageing.clearance_per_second * grows, alike, math.nan)
    worst, errors = _errors(ages, pair, surface)
    return dataclasses.replace(
        ages,
        largest_error=worst,
        tables=tuple(dataclasses.replace(one, largest_error=worst, errors=errors) for one in alike),
    )


def drive_at(pair: Pair, surface: ErrorSurface, crank_turns: float, clearance: float) -> tuple[Pair, ErrorSurface]:
    """Return the drive at a state of its life: the pair with its grown clearance (m), and the worn surface."""
    assert surface.life is not None
    ageing = surface.life.ageing
    if ageing is not None and ageing.bearing and pair.supports is not None:
        pair = pair.replace(supports=pair.supports.grown(ageing.bearing, clearance))
    return pair, surface_after(surface, crank_turns).replace(life=None)


def _reach(of: Sequence[Tables]) -> float:
    return float(min(side.load[-1] for one in of for side in (one.positive, one.negative)))


def _errors(ages: Ages, pair: Pair, surface: ErrorSurface) -> tuple[float, tables.Errors]:
    """Return the largest error of the deviation at random states, and the errors of the other quantities."""
    random, found, exact, torque = np.random.default_rng(3), [], [], []
    for seed in range(_MIDDLES):
        turns, clearance = (random.uniform(0.0, float(nodes[-1])) for nodes in (ages.crank_turns, ages.clearance))
        one, state = between(ages, turns, clearance), drive_at(pair, surface, turns, clearance)
        probed = tables.probed_at(*state, _reach([one]), tables.PROBES // _MIDDLES, seed + 2)
        found.append(tables.interpolated(one, probed.crank_angle, probed.torque))
        exact.append(probed.exact)
        torque.append(probed.torque)
    ours, exactly = (States(*map(np.concatenate, zip(*states, strict=True))) for states in (found, exact))
    worst = float(np.abs(ours.deviation - exactly.deviation).max())
    return worst, tables.errors_of(ages.tables[0], ours, exactly, np.concatenate(torque))


def between(ages: Ages, crank_turns: float, clearance: float) -> Tables:
    """Interpolate between the tables as the native FMU does, without its rounding."""
    weights = [(0, 1.0)]
    for nodes, at in ((ages.crank_turns, crank_turns), (ages.clearance, clearance)):
        cell = int(np.clip(np.searchsorted(nodes, at, "right") - 1, 0, max(nodes.size - 2, 0)))
        share = 0.0 if nodes.size == 1 else (at - float(nodes[cell])) / float(nodes[cell + 1] - nodes[cell])
        further = [(cell, 1.0 - share), (cell + 1, share)]
        weights = [(nodes.size * i + j, w * v) for i, w in weights for j, v in further if v != 0.0]
    mixed = [(ages.tables[number], weight) for number, weight in weights]

    def mean(value: Callable[[Tables], Array]) -> Array:
        return np.asarray(sum(weight * value(one) for one, weight in mixed))

    def side(of: Callable[[Tables], Side]) -> Side:
        far = of(ages.tables[0]).far[0], mean(lambda one: of(one).far[1]), mean(lambda one: of(one).far[2])
        return dataclasses.replace(
            of(ages.tables[0]),
            deviation=mean(lambda one: of(one).deviation),
            far=far,
            compliance=mean(lambda one: of(one).compliance),
            pressure=mean(lambda one: of(one).pressure),
        )

    return dataclasses.replace(
        ages.tables[0],
        positive=side(lambda one: one.positive),
        negative=side(lambda one: one.negative),
        rest_torque=mean(lambda one: one.rest_torque),
    )


def on_common_nodes(of: Sequence[Tables]) -> tuple[Tables, ...]:
    """Return tables on common crank angles, loads and steps.

    They differ from the given ones by rounding, as long as all their loads together have room in a file; otherwise the
    loads with the closest neighbours are left out.
    """
    period = max(one.period for one in of)
    repeats = [round(period / one.period) for one in of]
    finest = max(one.rest_torque.size * n for one, n in zip(of, repeats, strict=True))
    positive, negative = (
        _sides_alike(sides, repeats, finest) for sides in ([one.positive for one in of], [one.negative for one in of])
    )
    return tuple(
        dataclasses.replace(
            one,
            period=period,
            allowed=max(t.allowed for t in of),
            positive=positive[i],
            negative=negative[i],
            rest_torque=_refined(np.tile(one.rest_torque, repeats[i]), finest),
        )
        for i, one in enumerate(of)
    )


def _refined(values: Array, angles: int) -> Array:
    """Return the coefficients of the same periodic cubic splines on more crank angles, twice as many each time.

    Lane and Riesenfeld, IEEE Trans. Pattern Anal. 2 (1980) 35.
    """
    while values.shape[-1] < angles:
        before, after = np.roll(values, 1, -1), np.roll(values, -1, -1)
        values = np.stack([0.75 * values + 0.125 * (before + after), 0.5 * (values + after)], -1)
        values = values.reshape(*values.shape[:-2], -1)
    return values


def _fewer(loads: Array, most: int) -> Array:
    """Leave out the loads with the closest neighbours, in proportion to the load, until no more than `most` remain."""
    while loads.size > most:
        loads = np.delete(loads, 1 + np.argmin((loads[2:] - loads[:-2]) / loads[1:-1]))
    return loads


def _sides_alike(of: Sequence[Side], periods: Sequence[int], angles: int) -> list[Side]:
    loads = _fewer(functools.reduce(np.union1d, [side.load for side in of]), MOST_LOADS - 1)
    told = _fewer(functools.reduce(np.union1d, [side.told_load for side in of]), MOST_LOADS)
    far = min(side.far[0] for side in of)
    grown = [
        [_refined(np.tile(v, (1, n)), angles) for v in tables.at_loads(side, np.append(loads, far))]
        for side, n in zip(of, periods, strict=True)
    ]
    step = max(float(side.steps[0][0]) for side in of)
    c_step = np.max([np.interp(loads, side.load, side.steps[1]) for side in of], axis=0)
    c_step = np.maximum(c_step, np.max([2.0 * c.max(axis=1) / _MOST_WORDS for _, c in grown], axis=0)[:-1])
    steps = np.full(loads.size, step), c_step, np.max([np.interp(told, s.told_load, s.steps[2]) for s in of], axis=0)
    found = []
    for side, n, (deviation, compliance) in zip(of, periods, grown, strict=True):
        tables.make_monotone(np.append(loads, far), deviation, compliance, [np.append(s, s[-1]) for s in steps[:2]])
        share = np.searchsorted(side.told_load, told).clip(1, side.told_load.size - 1)
        low, high = side.told_load[share - 1], side.told_load[share]
        u = ((told - low) / (high - low))[:, None]
        pressure = np.tile((1.0 - u) * side.pressure[share - 1] + u * side.pressure[share], (1, n))
        count = np.tile(side.contact_count[np.where(u[:, 0] > 0.5, share, share - 1)], (1, n))
        p = np.round(pressure / steps[2][:, None]) * steps[2][:, None]
        found.append(
            Side(loads, deviation[:-1], compliance[:-1], told, count, p, steps, (far, deviation[-1], compliance[-1]))
        )
    return found
