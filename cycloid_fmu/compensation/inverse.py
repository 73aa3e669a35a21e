"""The inverse of a drive as a small table: its transmission error over output angle and torque.

With the crank at θ under the torque T the output is at φ = θ/ratio + x(θ, T). A controller knows the desired φ, so the
table has the same transmission error over ψ = ratio φ, the crank angle that an ideal drive would have there,

    x̃(ψ, T) = x(θ, T)  where  ψ = θ + ratio x(θ, T),

and the crank must be at θ = ψ - ratio x̃(ψ, T): nothing is iterated at run time. The mean over a period, of wind-up and
play, is kept separately. The remainder is a short sum of functions of ψ times functions of T (singular value
decomposition): the first are uniform cubic B-splines with integer coefficients, the second are linear between nodes.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, special
from scipy.interpolate import CubicSpline, PchipInterpolator

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.tables import mesh_pitches
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import PLAY_LOAD
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
_MOST_STEPS = {np.int8: 127, np.int16: 32767}  # of a coefficient
_STEP_SHARE = 0.25  # of what a spline may err by: half a step of a coefficient in 8 bits
_LOAD_SHARE, _RANK_SHARE, _ANGLE_SHARE, _NODE_SHARE = 0.2, 0.6, 0.6, 0.2  # of the residual, for each approximation
_SPREAD = 240  # crank angles at which loads are chosen
_FIRST_LOADS = (0.02, 0.15, 0.5, 1.0)  # of the largest
_MOST_LOADS = 64  # of one direction
_SAMPLES = (8, 16, 32, 64)  # crank angles a mesh pitch that are solved: the first with which the residual is kept
_MOST_PITCHES = 4000  # after which a drive has to repeat
_FINER = 1.15  # times more knots, from one try to the next
_TORQUES = 64  # of one direction, at which the functions of the load are known before their nodes are chosen
_HELPS = 0.8  # times the error before: what twice as many crank angles have to bring
_TRIES = 3  # at what a table's approximations may err by
_SPLINE_TRIES = 12  # at what each function of the angle may err by
_PROBED = (24, 200)  # torques and crank angles at which the table is held against the model
_POINTS = 5  # of the mean over the torque there
SURE = 4.0  # standard deviations of the torque from none: where the flank that carries is certain


@dataclass(frozen=True)
class Inverse:
    """Transmission error over ideal crank angle and torque of the teeth.

    Attributes
    ----------
    period
        Crank angle after which the transmission error repeats, rad.
    steps
        Coefficients of each spline over the period, whole numbers, each of shape (its knots,).
    scale
        rad per unit of a spline coefficient where the torque's function is 1, shape (functions,).
    torque
        Torques of the nodes, of the environment on the output, ascending, shape (nodes,), N·m.
    temperature
        Temperatures of the nodes, ascending, shape (temperatures,), K.
    mean
        Mean transmission error over the crank angle there, shape (temperatures, nodes), rad.
    share
        Functions of the torque, shape (temperatures, nodes, functions), 1.
    flank
        Mean sign of the torque, 1 or -1, for a torque known to its accuracy, shape (nodes,).
    spread
        Variance of the transmission error for a torque known to its accuracy, mean over the crank angle, shape
        (temperatures, nodes), rad².
    residual
        Largest difference from the model at places not used to choose the table, at torques of `SURE` times their
        accuracy or more, rad.
    """

    period: float
    steps: tuple[NDArray[np.int8 | np.int16], ...]
    scale: Array
    torque: Array
    temperature: Array
    mean: Array
    share: Array
    flank: Array
    spread: Array
    residual: float

    @property
    def ripple_variance(self) -> Array:
        """Mean square of the part that depends on the crank angle, shape (temperatures, nodes), rad²."""
        angles = 2 * max((len(steps) for steps in self.steps), default=1)
        turn = np.arange(angles) / angles
        waves = np.array([scale * _spline(steps, turn) for steps, scale in zip(self.steps, self.scale, strict=True)])
        products = waves.reshape(len(self.steps), angles) @ waves.reshape(len(self.steps), angles).T / angles
        return np.asarray(np.einsum("tnr,rs,tns->tn", self.share, products, self.share))

    def at(self, angle: ArrayLike, torque: ArrayLike, temperature: ArrayLike) -> tuple[Array, Array]:
        """Mean transmission error, and the ripple about it (rad), at ideal crank angles, torques, temperatures."""
        at, torques, warmth = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (angle, torque, temperature)))
        weights = _weights(self.torque, torques)
        by_warmth = _weights(self.temperature, warmth)
        mean, share = np.zeros(at.shape), np.zeros((*at.shape, len(self.scale)))
        for (i, u), (j, v) in itertools.product(by_warmth, weights):
            mean += u * v * self.mean[i, j]
            share += (u * v)[..., None] * self.share[i, j]
        more = np.zeros(at.shape)
        for k, (steps, scale) in enumerate(zip(self.steps, self.scale, strict=True)):
            more += share[..., k] * scale * _spline(steps, at / self.period)
        return mean, more


def _weights(nodes: Array, at: Array) -> list[tuple[NDArray[np.intp], Array]]:
    """Return the nodes on both sides of values and their weights; constant beyond the outer ones."""
    if len(nodes) == 1:
        return [(np.zeros(at.shape, dtype=np.intp), np.ones(at.shape))]
    cell = np.clip(np.searchsorted(nodes, at, "right") - 1, 0, len(nodes) - 2)
    share = np.clip((at - nodes[cell]) / (nodes[cell + 1] - nodes[cell]), 0.0, 1.0)
    return [(cell, 1.0 - share), (cell + 1, share)]


def _spline(steps: NDArray[np.int8 | np.int16], turn: Array) -> Array:
    """Value of a periodic cubic B-spline at shares of its period."""
    position = (turn - np.floor(turn)) * len(steps)
    knot = np.minimum(position.astype(np.intp), len(steps) - 1)
    s = position - knot
    r = 1.0 - s
    parts = (r**3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 3.0 * r**3 - 6.0 * r**2 + 4.0, s**3)
    return np.asarray(sum(part * steps[(knot + k - 1) % len(steps)] for k, part in enumerate(parts)) / 6.0)


class Model(NamedTuple):
    """The exact model of a drive at one temperature.

    Attributes
    ----------
    temperature
        K.
    pair, surface, first_stage
        The drive there.
    workers
        Threads.
    """

    temperature: float
    pair: Pair
    surface: ErrorSurface
    first_stage: FirstStage | None
    workers: int

    def solved(self, torque: ArrayLike, crank: Array, progress: Callable[[int], None] = lambda n: None) -> Array:
        """Return transmission errors (rad) under torques other than 0, as `analysis.solve`: (torques, angles)."""
        return solve(
            DriveValue(self.pair, self.surface, self.first_stage),
            torque,
            crank,
            with_play=False,
            with_stiffness=False,
            workers=self.workers,
            progress=progress,
        ).transmission_error

    def ends(self, crank: Array) -> tuple[Array, Array]:
        """Return the ends of the play, or the unloaded position as both, each of shape (angles,), rad."""
        solution = solve(
            DriveValue(self.pair, self.surface, self.first_stage),
            [0.0],
            crank,
            with_stiffness=False,
            workers=self.workers,
        )
        rest, free = solution.transmission_error[0], np.isfinite(solution.play_low)
        return np.where(free, solution.play_low, rest), np.where(free, solution.play_high, rest)


def inverse_of(
    models: Sequence[Model],
    *,
    largest_torque: float,
    torque_accuracy: float,
    residual: float,
    total: Callable[[int], None] = lambda angles: None,
    progress: Callable[[int], None] = lambda angles: None,
) -> Inverse:
    """Return the smallest table of this kind within a given residual.

    Parameters
    ----------
    models
        The drive at each temperature of the table, ascending.
    largest_torque
        Largest torque of the table, N·m.
    torque_accuracy
        Standard deviation of the torque from the controller, N·m, above 0: the table has the mean over it, so the flank
        changes over this range and not at once.
    residual
        Largest difference from the model thus averaged, rad.
    total, progress
        Called with the number of solutions to come, and of those just finished.

    Returns
    -------
    Inverse
        Its `residual` is larger than required if a finer table would not help.

    Raises
    ------
    edge.InputError
        If a torque can't be carried or the period of the drive is too long.
    """
    pair, surface = models[0].pair, models[0].surface
    pitches = mesh_pitches(DriveValue(pair, surface))
    if pitches > _MOST_PITCHES:
        raise edge.InputError(
            f"the drive repeats after {pitches} mesh pitches, and a compensator's table has room for {_MOST_PITCHES}; "
            "take equal cranks and output rollers, and as many that their number divides the teeth."
        )
    period = pitches * 2.0 * math.pi / (pair.pins if pair.output == "gear" else pair.gear_teeth)
    spread = np.sort(np.random.default_rng(1).uniform(0.0, period, _SPREAD))
    loads = [
        [_chosen_loads(m, sign, largest_torque, spread, _LOAD_SHARE * residual) for sign in (-1.0, 1.0)] for m in models
    ]
    best: Inverse | None = None
    for samples in _SAMPLES:
        crank: Array = np.arange(float(pitches * samples)) * (period / (pitches * samples))
        total(crank.size * sum(torques.size for both in loads for torques in both))
        averaged = _averaged(*_inverses(models, loads, crank, period, progress), torque_accuracy)
        budget, before = residual, math.inf if best is None else best.residual
        for _ in range(_TRIES):
            table = _table(models, averaged, period, torque_accuracy, budget)
            if best is None or table.residual < best.residual:
                best = table
            if table.residual <= residual:
                return table
            budget *= max(0.5, 0.9 * residual / table.residual)
        if best is not None and best.residual > _HELPS * before:
            break
    assert best is not None
    return best


def _inverses(
    models: Sequence[Model],
    loads: Sequence[Sequence[Array]],
    crank: Array,
    period: float,
    progress: Callable[[int], None],
) -> tuple[Array, Array]:
    """Solve the drive: torques of both directions, zero in each, and transmission errors over ideal crank angles.

    The errors are of shape (temperatures, torques, angles).
    """
    torque = float(loads[0][0][-1]) * np.linspace(0.0, 1.0, _TORQUES) ** 2
    rows = []
    for model, of_model in zip(models, loads, strict=True):
        for sign, chosen, end in zip((-1.0, 1.0), of_model, model.ends(crank), strict=True):
            exact = np.vstack([end, model.solved(sign * chosen, crank, progress)])
            inverted = np.array([_inverted(model.pair.ratio, period, crank, x) for x in exact])
            curves = PchipInterpolator(np.sqrt(np.append(0.0, chosen)), inverted)(np.sqrt(torque))
            rows.append(curves[::-1] if sign < 0.0 else curves)
    both = np.concatenate([-torque[::-1], torque])
    return both, np.array(rows).reshape(len(models), both.size, crank.size)


class _Averaged(NamedTuple):
    """Over torques (torques,): the mean transmission error, its part that depends on the crank angle, and its variance.

    Shapes (temperatures, torques), (temperatures, torques, angles) and (temperatures, torques).
    """

    torque: Array
    mean: Array
    ripple: Array
    spread: Array


def _averaged(torque: Array, whole: Array, torque_accuracy: float) -> _Averaged:
    """Average transmission errors, shape (temperatures, torques, angles), over the torque's accuracy."""
    mixing = _normal_weights(torque, torque_accuracy)
    blurred = np.einsum("qt,mta->mqa", mixing, whole, optimize=True)
    spread = (np.einsum("qt,mta->mqa", mixing, whole**2, optimize=True) - blurred**2).mean(axis=-1)
    # Beyond the last torque squares do not go on straight.
    sure = np.flatnonzero(np.abs(torque) <= max(torque[-1] - SURE * torque_accuracy, 0.5 * torque[-1]))
    spread = spread[:, np.clip(np.arange(torque.size), sure[0], sure[-1])]
    mean = blurred.mean(axis=-1)
    return _Averaged(torque, mean, blurred - mean[..., None], np.maximum(spread, 0.0))


def _table(
    models: Sequence[Model], averaged: _Averaged, period: float, torque_accuracy: float, residual: float
) -> Inverse:
    torque, mean, ripple, spread = averaged
    functions, share = _low_rank(ripple, _RANK_SHARE * residual)
    steps, scale = _splines(functions, share, _ANGLE_SHARE * residual)
    sizes = np.abs(functions).max(axis=1)
    nodes = _nodes(torque, np.concatenate([mean[..., None], share * sizes], axis=-1), _NODE_SHARE * residual)
    table = Inverse(
        period=period,
        steps=steps,
        scale=scale,
        torque=torque[nodes],
        temperature=np.array([m.temperature for m in models]),
        mean=mean[:, nodes],
        share=share[:, nodes],
        flank=special.erf(torque[nodes] / (math.sqrt(2.0) * torque_accuracy)),
        spread=spread[:, nodes],
        residual=math.nan,
    )
    return dataclasses.replace(table, residual=_largest_error(table, models, torque_accuracy))


def _chosen_loads(model: Model, sign: float, largest: float, crank: Array, allowed: float) -> Array:
    """Return loads between which a monotone cubic over the load's root is within the allowed error."""
    end = model.ends(crank)[int(sign > 0.0)]
    first = set(_FIRST_LOADS)
    if model.pair.supports is not None:
        first.add(PLAY_LOAD * (model.pair.rated_torque or 0.0) / largest)
    known = {share: model.solved([sign * share * largest], crank)[0] for share in sorted(first)}
    unsure = set(itertools.pairwise(sorted(known)))
    if model.pair.supports is None:  # else all below the first runs straight
        unsure.add((0.0, min(known)))
    while unsure and len(known) < _MOST_LOADS:
        at = np.sqrt(np.append(0.0, sorted(known)))
        guess = PchipInterpolator(at, np.vstack([end, *(known[share] for share in sorted(known))]))
        further = set()
        for low, high in sorted(unsure):
            middle = (0.5 * (math.sqrt(low) + math.sqrt(high))) ** 2
            known[middle] = model.solved([sign * middle * largest], crank)[0]
            if np.abs(guess(math.sqrt(middle)) - known[middle]).max() > allowed:
                further |= {(low, middle), (middle, high)}
        unsure = further
    return largest * np.array(sorted(known))


def _inverted(ratio: float, period: float, crank: Array, transmission_error: Array) -> Array:
    """Convert transmission errors at crank angles to those at the same ideal crank angles."""
    ideal = crank + ratio * transmission_error
    if np.any(np.diff(ideal) <= 0.0):
        raise edge.InputError("the output does not always go on as the crank turns: no motion inverts this drive.")
    periodic = np.append(transmission_error, transmission_error[0])
    over = CubicSpline(np.append(ideal, ideal[0] + period), periodic, bc_type="periodic")
    return np.asarray(over(crank))


def _normal_weights(torque: Array, accuracy: float) -> Array:
    """Return the weights for the mean of a piecewise linear function of torque over a normal distribution.

    It jumps between the two zeros; the outer lines are extrapolated.
    """
    weights = np.zeros((torque.size, torque.size))
    width = np.diff(torque)
    for cell in np.flatnonzero(width > 0.0):
        low = -math.inf if cell == 0 else torque[cell]
        high = math.inf if cell == torque.size - 2 else torque[cell + 1]
        a, b = (low - torque) / accuracy, (high - torque) / accuracy
        inside = special.ndtr(b) - special.ndtr(a)
        first = torque * inside + accuracy * (np.exp(-0.5 * a**2) - np.exp(-0.5 * b**2)) / math.sqrt(2.0 * math.pi)
        share = (first - torque[cell] * inside) / width[cell]
        weights[:, cell] += inside - share
        weights[:, cell + 1] += share
    return weights


def _low_rank(ripple: Array, allowed: float) -> tuple[Array, Array]:
    """Return functions of the angle (functions, angles) and their shares in rows, as few as needed."""
    rows = ripple.reshape(-1, ripple.shape[-1])
    values, vectors = np.linalg.eigh(rows @ rows.T)
    vectors, residual = vectors[:, ::-1], rows.copy()
    rank = 0
    while rank < len(values) and np.abs(residual).max() > allowed:
        residual -= np.outer(vectors[:, rank], vectors[:, rank] @ rows)
        rank += 1
    share = vectors[:, :rank]
    return share.T @ rows, share.reshape(*ripple.shape[:-1], rank)


class _Spline(NamedTuple):
    """A spline's integer coefficients, their unit, and its error at every angle."""

    steps: NDArray[np.int8 | np.int16]
    scale: float
    error: Array


def _splines(functions: Array, share: Array, allowed: float) -> tuple[tuple[NDArray[np.int8 | np.int16], ...], Array]:
    """Return uniform periodic splines through functions of the angle, the fewest knots for each, and their scales.

    Each has the same allowed error, which is raised until all together, with their shares, reach the limit.
    """
    if not len(functions):
        return (), np.zeros(0)
    size, rows = functions.shape[1], share.reshape(-1, len(functions))
    turn, largest = np.arange(size) / size, np.abs(rows).max(axis=0)
    smooth = CubicSpline(
        np.linspace(0.0, 1.0, size + 1), np.append(functions, functions[:, :1], axis=1), axis=1, bc_type="periodic"
    )
    tried: dict[tuple[int, int, bool], _Spline] = {}

    def spline(k: int, knots: int) -> _Spline:
        small = 0.5 * np.abs(functions[k]).max() * largest[k] / _MOST_STEPS[np.int8] <= _STEP_SHARE * each
        if (k, knots, small) not in tried:
            kind = np.int8 if small else np.int16
            nodes = ndimage.spline_filter1d(smooth(np.arange(knots) / knots)[k], order=3, mode="grid-wrap")
            scale = float(np.abs(nodes).max()) / _MOST_STEPS[kind] or 1.0
            steps = np.round(nodes / scale).astype(kind)
            tried[k, knots, small] = _Spline(steps, scale, scale * _spline(steps, turn) - functions[k])
        return tried[k, knots, small]

    counts = [4]
    while counts[-1] < size:
        counts.append(min(size, math.ceil(counts[-1] * _FINER)))
    each, best = allowed, None
    for _ in range(_SPLINE_TRIES):
        splines = []
        for k in range(len(functions)):
            number = bisect.bisect_left(
                range(len(counts) - 1),
                True,
                key=lambda i: np.abs(spline(k, counts[i]).error).max() * largest[k] <= each,
            )
            splines.append(spline(k, counts[number]))
        error = float(np.abs(rows @ np.array([s.error for s in splines])).max()) if splines else 0.0
        if error <= allowed or best is None:
            best = splines
        if error <= allowed:
            break
        each *= max(0.5, 0.9 * allowed / error)
    else:
        best = splines
    return tuple(s.steps for s in best), np.array([s.scale for s in best])


def _nodes(torque: Array, functions: Array, allowed: float) -> NDArray[np.intp]:
    """Return the torques between which functions (temperatures, torques, functions) may be linear."""
    distinct = np.flatnonzero(np.append(np.diff(torque) > 0.0, True))  # one of both zeros, where all is alike
    chosen = [0, distinct.size - 1]
    at, values = torque[distinct], functions[:, distinct]
    while True:
        chosen.sort()
        cell = np.clip(np.searchsorted(at[chosen], at, "right") - 1, 0, len(chosen) - 2)
        low, high = (np.array(chosen)[cell + k] for k in (0, 1))
        share = ((at - at[low]) / (at[high] - at[low]))[None, :, None]
        off = np.abs((1.0 - share) * values[:, low] + share * values[:, high] - values).sum(axis=-1).max(axis=0)
        if off.max() <= allowed:
            return distinct[chosen]
        chosen.append(int(off.argmax()))


def _largest_error(table: Inverse, models: Sequence[Model], accuracy: float) -> float:
    """Compare a table with the model's mean over the torque's accuracy at random angles and torques."""
    random, largest = np.random.default_rng(2), float(table.torque[-1])
    least = min(SURE * accuracy, 0.5 * largest)
    points, weights = np.polynomial.hermite_e.hermegauss(_POINTS)
    worst = 0.0
    for model in models:
        torque = random.uniform(least, largest - SURE * accuracy, _PROBED[0]) * random.choice([-1.0, 1.0], _PROBED[0])
        crank = np.sort(random.uniform(0.0, table.period, _PROBED[1]))
        exact = model.solved((torque[:, None] + accuracy * points).ravel(), crank).reshape(-1, _POINTS, crank.size)
        mean = np.einsum("tpa,p->ta", exact, weights / weights.sum())
        mean_of_table, ripple = table.at(crank + model.pair.ratio * mean, torque[:, None], model.temperature)
        worst = max(worst, float(np.abs(mean_of_table + ripple - mean).max()))
    return worst
