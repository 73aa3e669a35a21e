"""Hysteresis loops: detection in a recording, and the figures from them.

Lost motion, backlash, hysteresis loss and torsional stiffness, each with its definition, 95 % uncertainty and number of
loops. Loops are recorded with the input locked or turning slowly; they are plotted as windup, output angle minus input
angle over ratio, against torque.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD
from fitting.figures.figure import DEFINITIONS, Figure, half_interval_of_mean
from fitting.transmission_error.loops import SIDES, Line, Lobe, Loop, LoopData, fit_line, residual_variance

Array = NDArray[np.float64]

# Intervals, as shares of the rated torque.
UNLOADING = (0.03, 0.10)  # of the straight lines extrapolated to zero torque for the hysteresis loss
FRICTION = 0.50
STIFFNESS = (0.50, 1.00)
SEGMENTS = (LOST_MOTION_LOAD, 0.15, 0.50, 1.00)  # limits of K1, K2 and K3
NEAR = 0.01  # a value "at" a torque is from samples within this distance at most; see `value_at`
FRICTION_NEAR = 0.05
_FEWEST = 6  # samples through which a cubic is fitted; through fewer, a straight line
_FEWER = 1.5  # factor between the numbers of samples from which values at a torque are compared
_AGREEING = 3.0  # standard deviations within which such values agree
DRIFT = (0.30, 0.80)  # of the peak: branches between these are beyond the friction band and before the reversal
_GROUPS = 10000  # most groups of neighbours, whose means determine a drift


def branch_line(torque: Array, windup: Array, part: slice, low: float, high: float) -> Line | None:
    """Fit a line to the part of a branch with `low` ≤ |torque| ≤ `high`, N·m; None as in `fit_line`."""
    t = torque[part]
    inside = (np.abs(t) >= low) & (np.abs(t) <= high)
    return fit_line(t[inside], windup[part][inside])


_Value = tuple[float, float]  # and its variance


def value_at(torque: Array, windup: Array, part: slice, at: float, near: float) -> _Value | None:
    """Return the windup, rad, of a branch at a torque, N·m, and its variance, rad²; None with fewer than three samples.

    It is from the cubic through the branch's samples within `near`, or through the nearest of them where the branch is
    no cubic so far: through as many as agree with all smaller numbers within the noise (Lepskii, Theory Probab. Appl.
    35 (1990) 454). The noise is from each sample and its two neighbours (Gasser, Sroka and Jennen-Steinmetz, Biometrika
    73 (1986) 625). The variance is from what a parabola leaves, so that a bend counts even where the cubic follows it;
    with few samples it is larger by the square of Student's t over the normal quantile.

    Parameters
    ----------
    torque, windup
        Of the recording, N·m and rad, shape (samples,).
    part
        Samples of the branch.
    at, near
        Signed torque, and the largest distance from it, N·m.
    """
    index = part.start + np.flatnonzero(np.abs(torque[part] - at) <= near)
    if index.size < 3 or np.ptp(torque[index]) == 0.0:
        return None
    noise = _noise(torque[index], windup[index])
    nearest = index[np.argsort(np.abs(torque[index] - at), kind="stable")]
    sizes = [index.size]
    while sizes[-1] / _FEWER >= _FEWEST:
        sizes.append(int(sizes[-1] / _FEWER))
    rounding = 1e-12 * float(np.ptp(windup[index]))
    agreed: list[tuple[float, float]] = []
    scatter = math.inf
    for size in reversed(sizes):
        chosen = np.sort(nearest[:size])
        x, y = (torque[chosen] - at) / near, windup[chosen]
        torques = np.unique(x).size
        if torques < 2:
            continue
        terms = 4 if size >= _FEWEST and torques >= 4 else 2
        q, r = np.linalg.qr(np.vander(x, terms, increasing=True))
        weights = np.linalg.solve(r.T, np.eye(terms)[0])  # of the orthogonal terms in the value at the torque
        value, share = float(weights @ (q.T @ y)), float(weights @ weights)
        if any(abs(value - v) > _AGREEING * noise * math.sqrt(max(s - share, 0.0)) + rounding for v, s in agreed):
            break
        agreed.append((value, share))
        parabola = q[:, :3]
        degrees = size - parabola.shape[1]
        variance = max(residual_variance(y - parabola @ (parabola.T @ y), degrees), noise**2)
        scatter = variance * (float(stdtrit(degrees, 0.975)) / 1.96) ** 2
    return agreed[-1][0], agreed[-1][1] * scatter


def _noise(torque: Array, windup: Array) -> float:
    """Return the standard deviation of the noise, rad, from the lines between the two neighbours of each sample."""
    order = np.argsort(torque, kind="stable")
    (before, here, after), (first, middle, last) = (
        (v[order][:-2], v[order][1:-1], v[order][2:]) for v in (torque, windup)
    )
    wide = np.where(after > before, after - before, 1.0)
    share = np.where(after > before, (after - here) / wide, 0.5)
    residual = share * first + (1.0 - share) * last - middle
    return float(np.sqrt(np.mean(residual**2 / (share**2 + (1.0 - share) ** 2 + 1.0))))


def _stiffness(torque: Array, windup: Array, lobe: Lobe, low: float, high: float) -> _Value | None:
    line = branch_line(torque, windup, lobe.loading, low, high)
    if line is None or line.slope <= 0.0:
        return None
    return 1.0 / line.slope, line.slope_variance / line.slope**4


def _loop_values(torque: Array, windup: Array, loop: Loop, rated: float) -> dict[str, _Value]:
    """Return the values of one loop, rad, each with its variance; without those that its branches do not contain.

    `width` is the mean distance of loading and unloading branch at half the rated torque, `wider` the excess of this
    distance at the load of lost motion, on the second side; `middle` is the centre of the hysteresis loss.
    """
    sides, values = (loop.positive, loop.negative), dict[str, _Value]()
    unloading = [branch_line(torque, windup, s.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated) for s in sides]
    ends = [line.at(0.0) for line in unloading if line is not None]
    if len(ends) == 2:
        (up, up_variance), (down, down_variance) = ends
        values["hysteresis_loss"] = up - down, up_variance + down_variance
        values["middle"] = 0.5 * (up + down), 0.25 * (up_variance + down_variance)

    def both(share: float, near: float) -> list[_Value] | None:
        """Loading and unloading branch of the positive, then of the negative side."""
        branches = [(side.sign, branch) for side in sides for branch in (side.loading, side.unloading)]
        at = [value_at(torque, windup, branch, sign * share * rated, near * rated) for sign, branch in branches]
        known = [value for value in at if value is not None]
        return known if len(known) == 4 else None

    widths = both(FRICTION, FRICTION_NEAR)
    if widths is not None:
        a, b, c, d = widths
        # The unloading branch is above the loading branch on the positive side and below on the negative side; both
        # widths are 2 T_f / k.
        width = values["width"] = 0.5 * ((b[0] - a[0]) + (c[0] - d[0])), 0.25 * (a[1] + b[1] + c[1] + d[1])
        if "hysteresis_loss" in values:
            loss, variance = values["hysteresis_loss"]
            values["backlash"] = loss - width[0], variance + width[1]
    at = both(LOST_MOTION_LOAD, NEAR)
    if at is not None:
        a, b, c, d = at
        values["lost_motion"] = 0.5 * (a[0] + b[0] - c[0] - d[0]), 0.25 * (a[1] + b[1] + c[1] + d[1])
        if "width" in values:
            upper, lower = (c, d) if loop.negative.loading.start > loop.positive.loading.start else (b, a)
            distance, variance = values["width"]
            values["wider"] = upper[0] - lower[0] - distance, upper[1] + lower[1] + variance
    return values


def _behind_the_virgin_branch(torque: Array, windup: Array, loop: Loop, rated: float) -> _Value | None:
    """Return the lost motion of a loop whose first loading branch is virgin, from the two branches after it.

    With equal friction on both sides, a steady loop's loading branches mirror each other: the distance of the
    first side's unloading branch and the second side's loading branch is its lost motion.
    """
    first, second = sorted((loop.positive, loop.negative), key=lambda lobe: lobe.loading.start)
    unloading, loading = (
        value_at(torque, windup, part, sign * LOST_MOTION_LOAD * rated, NEAR * rated)
        for part, sign in ((first.unloading, first.sign), (second.loading, second.sign))
    )
    if unloading is None or loading is None:
        return None
    return first.sign * (unloading[0] - loading[0]), unloading[1] + loading[1]


def mean_of_loops(values: Sequence[_Value], moved: float = 0.0) -> tuple[float, float, float]:
    """Return mean, half width of its 95 % interval, and degrees of freedom, from the fits or from the loops' scatter.

    The scatter of three or more loops is used if it is larger. `moved`: change of the mean by one standard uncertainty
    of the drift.
    """
    value = float(np.mean([v for v, _ in values]))
    count = len(values)
    uncertainty, degrees = math.sqrt(sum(variance for _, variance in values)) / count * 1.96, math.inf
    if count > 2:
        scatter = half_interval_of_mean([v for v, _ in values])
        if scatter > uncertainty:
            uncertainty, degrees = scatter, count - 1.0
    return value, math.hypot(uncertainty, 1.96 * moved), degrees


@dataclass(frozen=True)
class Drift:
    """A drift of the windup, linear in time: rate and its standard uncertainty, rad/s.

    `repeated` states whether it was determined from branches passed more than once, or else from the difference of the
    two sides of a single loop.
    """

    rate: float
    uncertainty: float
    repeated: bool


def drift_of(data: LoopData) -> Drift | None:
    """Return the drift of a recording's windup from the closure of its loops; None with too few samples.

    Without drift, a branch that is passed again is at the same place. A single loop passes no branch twice; there the
    distance of loading and unloading branch must be equal on both sides except for a constant, as dry friction may
    differ between the sides. Drift widens it on one side and narrows it on the other, increasingly with the time since
    the peak.

    Parameters
    ----------
    data
        The recording; the part of each branch between 30 and 80 % of the lowest peak is used.
    """
    share = np.abs(data.torque) / data.rated_torque
    peak = min(float(share[lobe.loading.start : lobe.unloading.stop].max()) for lobe in data.lobes)
    chosen: dict[tuple[int, bool], list[NDArray[np.intp]]] = {}
    for lobe in data.lobes:
        for loading, part in ((True, lobe.loading), (False, lobe.unloading)):
            at = part.start + np.flatnonzero((share[part] >= DRIFT[0] * peak) & (share[part] <= DRIFT[1] * peak))
            chosen.setdefault((lobe.sign, loading), []).append(at)
    fewest = min(at.size for pieces in chosen.values() for at in pieces)
    repeated = max(len(pieces) for pieces in chosen.values()) > 1
    if fewest < 4 or (not repeated and len(chosen) < 4):
        return None
    powers = range(1, 4 if fewest >= 12 else 2)
    # Many samples are averaged in groups of neighbours, which determine drift and noise equally well.
    size = max(1, min(fewest // 12, sum(at.size for pieces in chosen.values() for at in pieces) // _GROUPS))

    def grouped(values: Array) -> Array:
        parts = [at[: at.size - at.size % size] for pieces in chosen.values() for at in pieces]
        means: Array = np.concatenate([values[at].reshape(-1, size).mean(axis=1) for at in parts])
        return means

    branch = {of: np.zeros(share.size) for of in chosen}
    for of, pieces in chosen.items():
        for at in pieces:
            branch[of][at] = 1.0
    order = np.argsort(grouped(data.time), kind="stable")
    x = grouped(share)[order] - 0.5 * (DRIFT[0] + DRIFT[1]) * peak
    time, windup = grouped(data.time - data.time.mean())[order], grouped(data.windup)[order]
    member = {of: grouped(inside)[order] for of, inside in branch.items()}
    columns = list(member.values())
    if repeated:
        shapes = columns
    else:
        positive, negative = (member[sign, True] + member[sign, False] for sign in (1, -1))
        shapes = [positive, negative, member[1, False] - member[-1, False]]
    columns = columns + [shape * x**power for shape in shapes for power in powers]
    length = float(np.ptp(time))
    matrix = np.column_stack([*columns, time / length])
    if x.size <= matrix.shape[1] or np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        return None
    solution = np.linalg.lstsq(matrix, windup, rcond=None)[0]
    residual = windup - matrix @ solution
    variance = residual_variance(residual, x.size - matrix.shape[1])
    variance *= float(np.linalg.inv(matrix.T @ matrix)[-1, -1])
    return Drift(float(solution[-1]) / length, math.sqrt(variance) / length, repeated)


def without_drift(data: LoopData, drift: Drift | None, *, more: float = 0.0) -> LoopData:
    """Return the recording without its drift; `more`: multiple of the drift's standard uncertainty to add to it."""
    if drift is None:
        return data
    rate = drift.rate + more * drift.uncertainty
    return dataclasses.replace(data, windup=data.windup - rate * (data.time - data.time.mean()))


def _moved(values: Sequence[_Value], others: Sequence[_Value]) -> float:
    """Return the absolute difference of the means of values and others; 0 without others."""
    return abs(float(np.mean([v for v, _ in others]) - np.mean([v for v, _ in values]))) if others else 0.0


def _values(data: LoopData, band: bool) -> dict[str, list[_Value]]:
    """Return each figure's values from each loop; `band`: whether the load of lost motion is in the friction band."""
    torque, windup, rated = data.torque, data.windup, data.rated_torque
    every = [_loop_values(torque, windup, loop, rated) for loop in data.loops]
    steady = [_loop_values(torque, windup, loop, rated) for loop in data.steady] or every
    lost = [loop.get("lost_motion") for loop in (steady if band else every)]
    if not data.steady and band and not _closed(data):
        lost = [_behind_the_virgin_branch(torque, windup, loop, rated) for loop in data.loops]
    stiffness = {
        side: [
            _stiffness(torque, windup, lobe, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
            for lobe in data.lobes
            if lobe.sign == sign
        ]
        for side, sign in SIDES
    }
    values = {
        **{name: [loop.get(name) for loop in every] for name in ("hysteresis_loss", "backlash", "width")},
        "lost_motion": lost,
        "wider": [loop.get("wider") for loop in steady],
        **stiffness,
    }
    return {name: [v for v in these if v is not None] for name, these in values.items()}


def _closed(data: LoopData) -> bool:
    """Return whether a single loop, without its drift, ends where it began: then it was steady from the start."""
    loop, near = data.loops[0], NEAR * data.rated_torque
    first, second = sorted((loop.positive, loop.negative), key=lambda lobe: lobe.loading.start)
    begin, end = (value_at(data.torque, data.windup, part, 0.0, near) for part in (first.loading, second.unloading))
    loss = _loop_values(data.torque, data.windup, loop, data.rated_torque).get("hysteresis_loss")
    if begin is None or end is None or loss is None:
        return False
    return abs(end[0] - begin[0]) < 0.02 * abs(loss[0]) + 3.0 * math.sqrt(begin[1] + end[1])


def _friction_band(values: dict[str, list[_Value]], rated: float) -> tuple[bool, float | None]:
    """Return whether the load of lost motion is inside the friction band, and the dry friction, N·m, if known.

    It is if friction exceeds that load, or if the branches are further apart there than at half the rated torque: the
    loading branch has then not yet passed all of the play.
    """
    stiffness = [v for side in ("positive", "negative") for v, _ in values[side]]
    width = values["width"]
    friction = 0.5 * float(np.mean([v for v, _ in width])) * float(np.mean(stiffness)) if width and stiffness else None
    if friction is not None and friction > LOST_MOTION_LOAD * rated:
        return True, friction
    wider, lost = values["wider"], values["lost_motion"]
    if not wider or not lost:
        return False, friction
    value, variance = np.mean(wider, axis=0)
    return bool(value > 0.05 * abs(lost[0][0]) + 3.0 * math.sqrt(variance / len(wider))), friction


def stiffness_segments(data: LoopData, drift: Drift | None, limits: Sequence[float]) -> dict[str, Figure]:
    """Return the torsional stiffness by torque ranges, the K1, K2, K3 of catalogues: {"K1": the figure with its sides}.

    It is evaluated on loading branches, with three or more half loops without the virgin one. Ranges are left out of
    which the torque covers less than nine tenths, or which have no deflection.

    Parameters
    ----------
    data, drift
        The recording as measured, and its drift.
    limits
        Limits of the ranges, N·m, ascending.
    """
    freed = (without_drift(data, drift), without_drift(data, drift, more=1.0))
    lobes = data.lobes[1:] if len(data.lobes) > 2 else data.lobes
    reached = float(np.abs(data.torque).max())
    figures = {}
    for number, (low, high) in enumerate(itertools.pairwise(limits), start=1):
        if reached < low + 0.9 * (high - low):
            continue
        parts = {}
        for side, sign in SIDES:
            values, drifted = (
                [
                    v
                    for lobe in lobes
                    if lobe.sign == sign and (v := _stiffness(loops.torque, loops.windup, lobe, low, high))
                ]
                for loops in freed
            )
            if values:
                parts[side] = _mean_figure("torsional_stiffness", values, drifted, (low, high))
        if parts:
            figures[f"K{number}"] = _of_sides(parts)
    return figures


def _of_sides(parts: dict[str, Figure]) -> Figure:
    """Return the mean of a figure over its sides."""
    first = next(iter(parts.values()))
    return dataclasses.replace(
        first,
        value=float(np.mean([p.value for p in parts.values()])),
        uncertainty=math.hypot(*(p.uncertainty for p in parts.values())) / len(parts),
        count=min(p.count for p in parts.values()),
        degrees=min(p.degrees for p in parts.values()),
        parts=parts,
    )


def loop_figures(data: LoopData, limits: Sequence[float] | None = None) -> tuple[dict[str, Figure], list[str]]:
    """Return the figures of loops, and the reasons for missing ones.

    The drift of the windup is removed first. Only lost motion uses the virgin branch, which depends on the start within
    play and friction: if friction reaches its load, lost motion is evaluated on the loops after that branch.

    Parameters
    ----------
    data
        Torque and windup with their loops.
    limits
        Limits of the torque ranges of `torsional_stiffness`, N·m, ascending; None: 3, 15, 50 and 100 % of the rated
        torque.

    Returns
    -------
    figures
        Figures by name; `torsional_stiffness` also by side and torque range.
    notes
        One sentence for each missing figure, for a drift, for a single virgin loop and for friction that reaches the
        load of lost motion.
    """
    rated, drift = data.rated_torque, drift_of(data)
    undrifted = without_drift(data, drift)
    band, friction = _friction_band(_values(undrifted, False), rated)
    values, drifted = (_values(loops, band) for loops in (undrifted, without_drift(data, drift, more=1.0)))
    later = values if data.late is None else _values(dataclasses.replace(undrifted, torque=data.late), band)
    notes = _loop_notes(data, undrifted, drift, values, band, friction)
    figures, missing = _whole_loop_figures(data, values, drifted, later)
    stiffness, remarks = _stiffness_figure(data, drift, values, drifted, limits)
    if stiffness is not None:
        figures["torsional_stiffness"] = stiffness
    return figures, [*notes, *missing, *remarks]


_Values = dict[str, list[_Value]]


def _whole_loop_figures(
    data: LoopData, values: _Values, drifted: _Values, later: _Values
) -> tuple[dict[str, Figure], list[str]]:
    """Return hysteresis loss, backlash and lost motion, and the reasons for missing ones.

    `drifted` and `later` are the values with a standard deviation more of the drift, and with the torque read later.
    """
    rated = data.rated_torque
    figures: dict[str, Figure] = {}
    notes: list[str] = []
    for name, interval in (
        ("hysteresis_loss", UNLOADING),
        ("backlash", UNLOADING),
        ("lost_motion", (-LOST_MOTION_LOAD, LOST_MOTION_LOAD)),
    ):
        if values[name]:
            figure = _mean_figure(name, values[name], drifted[name], (interval[0] * rated, interval[1] * rated))
            uncertainty = math.hypot(figure.uncertainty, data.runaway, _moved(values[name], later[name]))
            figures[name] = dataclasses.replace(figure, uncertainty=uncertainty)
        elif data.loops:
            notes.append(
                f"{data.source}: {name} could not be determined: a branch has fewer than three samples in its interval."
            )
    if not data.loops:
        sides = {lobe.sign for lobe in data.lobes}
        only = "positive" if sides == {1} else "negative"
        notes.append(
            f"{data.source}: the torque is always {only}; hysteresis loss, backlash and lost motion need both signs."
        )
    return figures, notes


def _stiffness_figure(
    data: LoopData, drift: Drift | None, values: _Values, drifted: _Values, limits: Sequence[float] | None
) -> tuple[Figure | None, list[str]]:
    """Return the torsional stiffness by side and torque range, None if the torque is too small, and a note on it."""
    rated, reached = data.rated_torque, float(np.abs(data.torque).max())
    low, high = STIFFNESS[0] * rated, min(STIFFNESS[1] * rated, reached)
    if high < 0.75 * rated:
        return None, [
            f"{data.source}: torsional_stiffness could not be determined: the torque reaches {reached:.4g} N·m, less "
            f"than three quarters of the rated {rated:.4g} N·m."
        ]
    parts = {
        side: _mean_figure("torsional_stiffness", values[side], drifted[side], (low, high))
        for side, _ in SIDES
        if values[side]
    }
    if not parts:
        return None, []
    notes = []
    if high < 0.95 * rated:
        notes.append(
            f"{data.source}: the torque reaches {reached:.4g} N·m of the rated {rated:.4g} N·m; the stiffness is "
            "evaluated up to there."
        )
    segments = stiffness_segments(data, drift, limits or [share * rated for share in SEGMENTS])
    return dataclasses.replace(_of_sides(parts), segments=segments), notes


def _mean_figure(name: str, values: list[_Value], drifted: list[_Value], interval: tuple[float, float]) -> Figure:
    """Return the mean of a figure's values over loops, with the drift's part of its uncertainty."""
    value, uncertainty, degrees = mean_of_loops(values, _moved(values, drifted))
    return Figure(value, uncertainty, *DEFINITIONS[name], interval, "N*m", len(values), "loops", degrees=degrees)


def _loop_notes(
    data: LoopData,
    freed: LoopData,
    drift: Drift | None,
    values: dict[str, list[_Value]],
    band: bool,
    friction: float | None,
) -> list[str]:
    """Return notes on drift, on a single virgin loop, and on friction, N·m, that reaches the load of lost motion."""
    notes = []
    if not data.loops or not values["hysteresis_loss"]:
        return []
    loss = abs(values["hysteresis_loss"][0][0])
    if drift is None:
        notes.append(
            f"{data.source}: a drift of the windup cannot be determined: a branch has fewer than four samples between "
            f"{100.0 * DRIFT[0]:g} and {100.0 * DRIFT[1]:g} % of its peak."
        )
    else:
        loop = data.loops[0]
        ends = sorted((loop.positive, loop.negative), key=lambda lobe: lobe.loading.start)
        length = data.time[ends[1].unloading.stop - 1] - data.time[ends[0].loading.start]
        moved, uncertain = drift.rate * length * edge.ARCSEC, 1.96 * drift.uncertainty * length * edge.ARCSEC
        if abs(moved) > 1.5 * uncertain and abs(moved) > 0.02 * loss * edge.ARCSEC:
            by = (
                "repeated branches"
                if drift.repeated
                else (
                    "loading and unloading branch of the two sides, whose friction is assumed equal except for a "
                    "constant"
                )
            )
            notes.append(
                f"{data.source}: the windup drifts by {moved:.3g} ± {uncertain:.2g}″ per loop, as {by} show; the drift "
                "is subtracted as linear in time, and its uncertainty is included in those of the figures."
            )
    if not data.steady and not _closed(freed):
        notes.append(
            f"{data.source}: there is only a virgin loop, whose first branch depends on its start within play and "
            "friction; record a preconditioning loop before it (GB/T 40731)."
            + (
                " Lost motion is from the two branches after the first, assuming equal friction on both sides."
                if band
                else ""
            )
        )
    if band:
        load = LOST_MOTION_LOAD * data.rated_torque
        at = f"{data.source}: ±{100.0 * LOST_MOTION_LOAD:g} % of the rated torque, ±{load:.3g} N·m,"
        if friction is not None and friction > load:
            notes.append(
                f"{at} is inside the friction band, whose mean half width is {friction:.3g} N·m: lost motion there may "
                "not include the play; friction_free.play does."
            )
        else:
            notes.append(
                f"{at} is inside the knee of the loop: the branches are further apart there than at "
                f"±{100.0 * FRICTION:g} %, so lost motion does not include all of the play; friction_free.play does."
            )
    return notes


def loop_marks(data: LoopData) -> dict[str, list[Array]]:
    """Return lines that show a loop's figures, without drift: {figure: lines of (torque, windup)}, shape (points, 2).

    Hysteresis loss: the lines of both unloading branches down to zero torque, and the distance there. Backlash: the
    distance without friction, about the same centre. Lost motion: from the mean at its negative load to the mean at its
    positive load, in the first steady loop. Torsional stiffness: the fitted lines.
    """
    data = without_drift(data, drift_of(data))
    torque, windup, rated = data.torque, data.windup, data.rated_torque
    marks: dict[str, list[Array]] = {}
    for lobe in data.lobes[:2]:
        line = branch_line(torque, windup, lobe.loading, STIFFNESS[0] * rated, STIFFNESS[1] * rated)
        if line is not None:
            ends = [lobe.sign * share * rated for share in STIFFNESS]
            marks.setdefault("torsional_stiffness", []).append(np.array([(t, line.at(t)[0]) for t in ends]))
    if not data.loops:
        return marks
    loop = data.loops[0]
    values = _loop_values(torque, windup, loop, rated)
    if "hysteresis_loss" not in values:
        return marks
    middle, half = values["middle"][0], 0.5 * values["hysteresis_loss"][0]
    lines = [np.array([(0.0, middle - half), (0.0, middle + half)])]
    for side in (loop.positive, loop.negative):
        line = branch_line(torque, windup, side.unloading, UNLOADING[0] * rated, UNLOADING[1] * rated)
        assert line is not None
        lines.append(np.array([(t, line.at(t)[0]) for t in (0.0, side.sign * UNLOADING[1] * rated)]))
    marks["hysteresis_loss"] = lines
    if "backlash" in values:
        half = 0.5 * values["backlash"][0]
        marks["backlash"] = [np.array([(0.0, middle - half), (0.0, middle + half)])]
    loop = next(iter(data.steady), loop)
    if "lost_motion" in _loop_values(torque, windup, loop, rated):
        at = []
        for side in (loop.negative, loop.positive):
            t = side.sign * LOST_MOTION_LOAD * rated
            both = [value_at(torque, windup, b, t, NEAR * rated) for b in (side.loading, side.unloading)]
            at.append((t, float(np.mean([value[0] for value in both if value is not None]))))
        marks["lost_motion"] = [np.array(at)]
    return marks
