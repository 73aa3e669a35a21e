"""Orders of the transmission error of a run, whole and not whole, and what averaging over its turns removed.

Whole orders repeat each output turn, so averaging over turns keeps them. Others, as of a belt pulley between output and
encoder, are averaged away; they are found in the turns before averaging.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.spectrum import (
    Spectrum,
    coefficients_of,
    noise_floor,
    order_name,
    significant,
    synthesised,
)
from fitting.transmission_error.unaveraged import Unaveraged

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BAND = 0.4  # of the steps of a turn: highest order looked for
_FEWEST = 5.0  # turns from which orders that are not whole are looked for
_APART = 2.0  # over the number of turns: least distance of such an order from a whole one, whose changes are there
_SKIRT = 6.0  # the same up to which it must exceed what is nearer
_NOTCH = 1.2  # the same of lines that show the noise
_NEAR, _WIDE = 31, 201  # lines around an order whose median is its noise floor; a threshold has the larger of both
_MULTIPLES = 12  # multiples of a stated order that are fitted
_MOST = 8  # orders of unknown source that are looked for
_SLOWEST = 0.5  # lowest of them; slower changes are drift
_CLEAN = 1e-3  # of the largest whole order: smaller lines may be traces of it
_TERMS = 8  # of the series of the whole orders in the angle within a step
_KEPT = 0.15  # least share of a wave that whole orders and their changes do not explain
_FALSE = 0.01  # probability of an order in a run that has noise only


@dataclass(frozen=True)
class Order:
    """One order of the transmission error, SI.

    Attributes
    ----------
    order
        Periods for each output turn.
    amplitude, uncertainty
        Amplitude and half width of its 95 % interval, rad.
    phase, phase_uncertainty
        φ, rad, and half width of its 95 % interval: the order is amplitude · cos(order · ψ + φ), ψ the crank angle over
        |ratio|, for an order that is not whole from the zero of the unwrapped crank angle.
    source
        Its cause, if known: "pin", "tooth", "mesh", "rig", "input turn", "pulley".
    order_uncertainty
        Half width of the 95 % interval of the order itself; 0 if it is whole or a multiple of a stated one.
    """

    order: float
    amplitude: float
    uncertainty: float
    phase: float
    phase_uncertainty: float
    source: str
    order_uncertainty: float = 0.0

    @property
    def whole(self) -> bool:
        """Whether the order repeats each output turn."""
        return self.order == round(self.order)


@dataclass(frozen=True)
class TurnAveraging:
    """What averaging over turns removes from the transmission error, at `steps` even steps of an output turn.

    Attributes
    ----------
    variance_share_removed
        Variance about the mean of all turns over the whole variance: orders that are not whole, drift and noise.
    variance_share_of_other_orders
        The part of it in the orders found that are not whole.
    peak_to_peak_of_all_turns, peak_to_peak_of_one_turn, peak_to_peak_of_the_mean
        Largest minus smallest value, rad, with their noise: over all turns, in one turn (mean of the turns), and of the
        mean over turns.
    steps
        Steps of an output turn.
    """

    variance_share_removed: float
    variance_share_of_other_orders: float
    peak_to_peak_of_all_turns: float
    peak_to_peak_of_one_turn: float
    peak_to_peak_of_the_mean: float
    steps: int


@dataclass(frozen=True)
class RunOrders:
    """Orders of one run in one direction.

    Attributes
    ----------
    run, direction, turns
        Label of the run, +1 or -1, and output turns recorded.
    orders
        The orders above the noise, the largest first.
    searched
        Lowest and highest order between which others than whole ones were looked for; None with too few turns.
    turn_averaging
        What averaging removed; None below two turns.
    """

    run: str
    direction: int
    turns: float
    orders: tuple[Order, ...]
    searched: tuple[float, float] | None
    turn_averaging: TurnAveraging | None


class _Turns:
    """The turns of a recording as a matrix (turns, steps of a turn), without whole orders and their linear change.

    The mean at each step over turns contains the whole orders, a line over turns their slow change and a drift. Both
    are removed from the recording and from each wave that is fitted to it, so that neither is taken for the other.
    """

    def __init__(self, given: Unaveraged, curve: Curve, whole: Spectrum) -> None:
        self.each = given.each
        self.scale = 1.0 / abs(curve.ratio)
        self.first = int(given.number[0])
        self.span = (int(given.number[-1]) - self.first + 1) / self.each
        row, point = (given.number - self.first) // self.each, given.number % self.each
        rows, row = np.unique(row, return_inverse=True)
        self._at = (row, point)
        self._number = given.number - self.first
        self.psi = given.input_angle * self.scale
        self.middle = float(self.psi.mean())
        inside = self.psi - (given.number + 0.5) * (2.0 * np.pi / self.each)
        variance = given.angle_variance * self.scale**2
        self._width = np.sqrt(12.0 * variance)
        # The whole orders at the angles of the samples, as in `spectrum`: turns are not sampled at the same angles.
        highest = min(whole.coefficient.size - 1, int(_BAND * self.each))
        order = np.arange(highest + 1)
        wave = whole.coefficient[: highest + 1] * np.exp(1j * order * np.pi / self.each)
        # A series in the angle within a step, in which the highest order turns by 0.4 π at most.
        derivatives = [synthesised((1j * order) ** n * wave, self.each)[point] for n in range(_TERMS)]
        shift = np.zeros(inside.size)
        for n in range(_TERMS - 1, 0, -1):
            shift = (shift + derivatives[n]) * (inside / n)
        spread = variance * (0.5 * (derivatives[2] + inside * (derivatives[3] + 0.5 * inside * derivatives[4])))
        spread += variance**2 / 24.0 * derivatives[4]
        self.at_steps = given.transmission_error - shift - spread
        self.count = np.bincount(point, minlength=self.each)
        turn = rows[row].astype(float)
        self._turn = turn - (np.bincount(point, turn, self.each) / np.maximum(self.count, 1))[point]
        squares = np.bincount(point, self._turn**2, self.each)
        # A line over the turns of a step needs three of them.
        self._used = ((self.count >= 3) & (squares > 0.0))[point]
        self._squares = np.maximum(squares, 1e-300)
        self.samples = int(np.count_nonzero(self._used))
        self.rest = self._projected(given.transmission_error - derivatives[0] - shift - spread)

    def mean(self, values: Array) -> Array:
        """Return the mean over turns of values, shape (steps,), at each step of a turn; 0 without any."""
        mean: Array = np.bincount(self._at[1], values, self.each) / np.maximum(self.count, 1)
        return mean

    def _projected(self, values: Array) -> Array:
        """Remove the mean over turns and the line over turns at each step."""
        index = self._at[1]
        residual = values - self.mean(values)[index]
        residual -= self._turn * (np.bincount(index, self._turn * residual, self.each) / self._squares)[index]
        projected: Array = np.where(self._used, residual, 0.0)
        return projected

    def wave(self, order: float) -> Complex:
        """Return exp(i order ψ) in the means of the steps, from the middle of the recording, shape (steps,)."""
        angle = order * (self.psi - self.middle)
        half = (0.5 * order * self._width) ** 2  # sin x/x to 0.02 %: the steps of an order are less than x = 0.4 π wide
        values: Complex = (np.cos(angle) + 1j * np.sin(angle)) * (1.0 - half / 6.0 * (1.0 - half / 20.0))
        return values

    def columns(self, order: float) -> Array:
        """Return cosine and sine of an order without what whole orders explain, shape (2, steps)."""
        wave = self.wave(order)
        return np.stack([self._projected(wave.real), self._projected(-wave.imag)])

    def slope(self, order: float, coefficient: complex) -> Array:
        """Return the derivative of an order's wave with respect to the order, shape (steps,)."""
        return self._projected((1j * (self.psi - self.middle) * coefficient * self.wave(order)).real)

    def at_zero(self, order: float, coefficient: complex) -> complex:
        """Return a coefficient with its phase from crank angle zero."""
        return complex(coefficient * np.exp(-1j * order * self.middle))

    def lines(self, rest: Array, padded: int = 1) -> tuple[Array, Array]:
        """Return orders and their squared amplitudes, rad², one for each 1/(padded turns)."""
        line = np.zeros(int(self._number[-1]) + 1)
        line[self._number] = rest
        size = scipy.fft.next_fast_len(padded * line.size, real=True)
        power = np.abs(coefficients_of(line, self.samples, size)) ** 2
        return np.arange(power.size) * (self.each / size), power

    def stands_alone(self, order: Array, power: Array) -> NDArray[np.bool_]:
        """Return the mask of lines that are neither near a whole order nor on the skirt of what is there."""
        off = self.off_whole(order, _APART)
        nearest = np.round(order)
        begins = np.flatnonzero(np.diff(nearest, prepend=-1.0))
        there = np.maximum.reduceat(np.where(off, 0.0, power), begins)
        skirt = np.repeat(there, np.diff(begins, append=order.size))
        skirt[self.off_whole(order, _SKIRT)] = 0.0
        return off & (power > skirt)

    def off_whole(self, order: Array | float, distance: float) -> NDArray[np.bool_]:
        """Return the mask of orders at least `distance`, over the number of turns, from a whole one."""
        mask: NDArray[np.bool_] = np.abs(order - np.round(order)) >= distance / self.span
        return mask


@dataclass(frozen=True)
class _Floor:
    """Noise floor over the order, rad rms, from lines that whole orders do not reach."""

    order: Array
    near: Array
    wide: Array
    degrees: float

    def at(self, order: Array | float) -> Array:
        """Return the floor at orders, for an uncertainty."""
        return np.asarray(np.interp(order, self.order, self.near))

    def threshold(self, order: Array | float) -> Array:
        """Return the floor at orders, for a threshold: also where the noise falls steeply."""
        return np.asarray(np.interp(order, self.order, np.maximum(self.near, self.wide)))


def _floor(turns: _Turns, rest: Array) -> _Floor:
    order, power = turns.lines(rest)
    between = turns.off_whole(order, _NOTCH)
    order, power = order[between], power[between]
    near, wide = (noise_floor(power, window) for window in (_NEAR, _WIDE))
    # The median of n exponential values has the variance 1/n of their mean squared, as a mean of 0.48 n of them.
    return _Floor(
        order, np.maximum(near, 1e-15), np.maximum(wide, 1e-15), 2.0 * math.log(2.0) ** 2 * min(_NEAR, power.size)
    )


@dataclass
class _Wave:
    """A wave that is fitted: its order, whether that is fitted too, cosine and sine, and its coefficient, rad."""

    order: float
    is_free: bool
    columns: Array
    coefficient: complex = 0.0


class _Waves:
    """Waves fitted together to the turns: those of stated orders, and of orders found, which are fitted too."""

    def __init__(self, turns: _Turns) -> None:
        self.turns = turns
        self.each: list[_Wave] = []

    def add(self, order: float, *, free: bool) -> bool:
        """Add an order, unless whole orders and their changes explain most of it."""
        columns = self.turns.columns(order)
        if float((columns**2).sum()) < _KEPT * self.turns.samples:
            return False
        self.each.append(_Wave(order, free, columns))
        return True

    def rest(self) -> Array:
        """Return what the waves do not explain; sets their coefficients."""
        if not self.each:
            return self.turns.rest
        columns = np.concatenate([wave.columns for wave in self.each])
        solution = np.linalg.lstsq(columns @ columns.T, columns @ self.turns.rest, rcond=1e-12)[0]
        for wave, (cosine, sine) in zip(self.each, solution.reshape(-1, 2), strict=True):
            wave.coefficient = complex(cosine, sine)
        residual: Array = self.turns.rest - solution @ columns
        return residual

    def refine(self, waves: Sequence[_Wave], rest: Array) -> None:
        """Move free orders by a Gauss-Newton step each, at most half a line; `rest` is that of `rest`."""
        limit = 0.5 / self.turns.span
        for wave in waves:
            columns = np.concatenate([wave.columns, self.turns.slope(wave.order, wave.coefficient)[None]])
            step = float(np.linalg.lstsq(columns @ columns.T, columns @ rest, rcond=1e-12)[0][2])
            wave.order += min(max(step, -limit), limit)
            wave.columns = self.turns.columns(wave.order)

    def covariance(self) -> list[Array]:
        """Return for each wave the covariance of its cosine, sine and order for noise of variance 1 in the steps."""
        if not self.each:
            return []
        slopes = [self.turns.slope(wave.order, wave.coefficient)[None] for wave in self.each if wave.is_free]
        columns = np.concatenate([*(wave.columns for wave in self.each), *slopes])
        scale = np.sqrt(np.maximum((columns**2).sum(axis=1), 1e-300))
        columns = columns / scale[:, None]
        whole = np.linalg.pinv(columns @ columns.T, hermitian=True) / np.multiply.outer(scale, scale)
        blocks, at = [], 2 * len(self.each)
        for i, wave in enumerate(self.each):
            index = [2 * i, 2 * i + 1]
            if wave.is_free:
                index.append(at)
                at += 1
            block = np.zeros((3, 3))
            block[: len(index), : len(index)] = whole[np.ix_(index, index)]
            blocks.append(block)
        return blocks

    def model(self) -> Array:
        """Return the sum of the waves, shape (steps,), rad."""
        values = np.zeros(self.turns.psi.size)
        for wave in self.each:
            values += (wave.coefficient * self.turns.wave(wave.order)).real
        return values


def _search(waves: _Waves, least: float) -> tuple[Array, _Floor]:
    """Add orders above the noise, the largest first; return what is left, and its noise floor.

    `least`: amplitude, rad, that they exceed.
    """
    turns = waves.turns
    rest = waves.rest()
    floor = _floor(turns, rest)
    if turns.span < _FEWEST:
        return rest, floor
    for _ in range(_MOST):
        order, power = turns.lines(rest, padded=2)
        band = (order < _BAND * turns.each) & (order >= _SLOWEST)
        # What is above the band may be mirrored into it, as the angles of the samples in their steps vary.
        alone = (
            band
            & (power > least**2)
            & turns.stands_alone(order, power)
            & (power > power[order >= _BAND * turns.each].max())
        )
        for known in waves.each:
            alone &= np.abs(order - known.order) > 1.0 / turns.span
        ratio = np.where(alone, power / floor.threshold(order) ** 2, 0.0)
        largest = int(np.argmax(ratio))
        if ratio[largest] <= math.log(order.size / _FALSE) or not waves.add(float(order[largest]), free=True):
            break
        for _ in range(3):
            waves.refine(waves.each[-1:], waves.rest())
        for multiple in waves.each[-1].order * np.arange(2, _MULTIPLES + 1):
            if multiple < _BAND * turns.each and not turns.off_whole(multiple, _APART):
                waves.add(float(multiple), free=False)
        rest = waves.rest()
        floor = _floor(turns, rest)
        _keep_significant(waves, floor)
        rest = waves.rest()
    free = [wave for wave in waves.each if wave.is_free]
    for _ in range(3 if len(free) > 1 else 0):
        waves.refine(free, waves.rest())
    rest = waves.rest()
    return rest, _floor(turns, rest)


def _with_tied(orders: list[Order], span: float) -> list[Order]:
    """Give multiples that were fitted at multiples of a found order the uncertainty of it."""
    free = [order for order in orders if order.order_uncertainty > 0.0]
    return [
        next(
            (
                dataclasses.replace(order, order_uncertainty=round(order.order / base.order) * base.order_uncertainty)
                for base in free
                if not order.source
                and not order.order_uncertainty
                and base.order < order.order
                and _multiple(order.order, base.order, 0.5 / span)
            ),
            order,
        )
        for order in orders
    ]


def orders_of_run(
    curve: Curve,
    whole: Spectrum,
    run: str,
    pair: Pair | None = None,
    bases: Mapping[str, float] | None = None,
    resolution: float = 0.0,
) -> RunOrders:
    """Return the orders of a run above the noise, with what averaging over its turns removed.

    Parameters
    ----------
    curve, whole
        A curve over a whole turn, with its turns before averaging, and its orders.
    run
        Label of the run.
    pair
        The nominal pair, for the causes of orders.
    bases
        {cause: its order} of stated causes of orders that are not whole, such as {"pulley": 3.346}. Their multiples
        are fitted where the recording separates them from whole orders.
    resolution
        Resolution of the encoders at the output, rad; an order of unknown source below 1/π of it may be of its steps.
    """
    bases = {name: abs(base) for name, base in (bases or {}).items()}
    coefficient, noise = whole.coefficient, whole.floor.copy()
    others: list[Order] = []
    averaging, searched, degrees = None, None, math.inf
    if curve.unaveraged is not None and curve.turns >= 2.0:
        turns = _Turns(curve.unaveraged, curve, whole)
        waves = _Waves(turns)
        between = turns.off_whole(turns.lines(turns.rest)[0], _NOTCH)
        # The noise is seen in the lines between whole orders.
        if turns.samples > 4 * _NEAR and turns.span >= 3.0 and np.count_nonzero(between) > _NEAR:
            highest = _BAND * turns.each
            for base in bases.values():
                for order in base * np.arange(1, _MULTIPLES + 1):
                    if order < highest and all(abs(order - known.order) > 0.5 / turns.span for known in waves.each):
                        waves.add(float(order), free=False)
            least = max(_CLEAN * float(whole.amplitude[1:].max(initial=0.0)), resolution / math.pi)
            _, floor = _search(waves, least)
            _keep_significant(waves, floor)
            named = [_named(measured, bases, turns.span) for measured in _measured(waves, floor)]
            others = _with_tied(named, turns.span)
            coefficient = _without(waves, coefficient)
            if turns.span >= _FEWEST:
                searched = (_SLOWEST, highest)
                upto = min(noise.size, int(highest) + 1)
                # Uneven numbers of turns at the points of a curve spread other orders over whole ones.
                noise[:upto] = np.maximum(noise[:upto], floor.at(np.arange(float(upto))))
                degrees = floor.degrees
        averaging = _turn_averaging(turns, waves)
    peaks = np.flatnonzero(significant(coefficient, noise, noise.size))
    factor = float(scipy.special.stdtrit(degrees, 0.975)) if math.isfinite(degrees) else 1.96
    apart = 1.0 / max(curve.turns, 1.0)
    for k in peaks:
        amplitude, half = float(abs(coefficient[k])), factor * float(noise[k]) / math.sqrt(2.0)
        source = order_name(int(k), curve.ratio, pair)
        near = [n for n, base in bases.items() if _multiple(float(k), base, apart) and n != source]
        others.append(
            Order(
                float(k),
                amplitude,
                half,
                float(np.angle(coefficient[k])),
                min(half / amplitude, math.pi),
                " or ".join(filter(None, (source, *near))),
            )
        )
    others.sort(key=lambda order: -order.amplitude)
    return RunOrders(run, curve.direction, curve.turns, tuple(others), searched, averaging)


def _keep_significant(waves: _Waves, floor: _Floor) -> None:
    """Keep the waves above the noise; those that were found are."""
    while waves.each:
        stated = sum(not wave.is_free for wave in waves.each)
        significant_waves = []
        for wave, covariance in zip(waves.each, waves.covariance(), strict=True):
            of_noise = covariance[:2, :2] * (0.25 * waves.turns.samples * float(floor.at(wave.order)) ** 2)
            value = np.array([wave.coefficient.real, wave.coefficient.imag])
            if wave.is_free or value @ np.linalg.solve(of_noise, value) > 2.0 * math.log(stated / _FALSE):
                significant_waves.append(wave)
        if len(significant_waves) == len(waves.each):
            return
        waves.each = significant_waves
        waves.rest()


def _measured(waves: _Waves, floor: _Floor) -> list[Order]:
    """Return the waves as orders with uncertainties, which contain that of the noise around each."""
    orders = []
    turns, factor = waves.turns, float(scipy.special.stdtrit(floor.degrees, 0.975))
    for wave, covariance in zip(waves.each, waves.covariance(), strict=True):
        order, coefficient = wave.order, wave.coefficient
        # A line's amplitude has 4/samples of the variance of the steps.
        covariance = covariance * (0.25 * turns.samples * float(floor.at(order)) ** 2)
        size = abs(coefficient)
        along = np.array([coefficient.real, coefficient.imag, 0.0]) / size
        across = np.array([-coefficient.imag / size**2, coefficient.real / size**2, -turns.middle])
        half, turned, moved = (
            factor * math.sqrt(max(float(direction @ covariance @ direction), 0.0))
            for direction in (along, across, np.array([0.0, 0.0, 1.0]))
        )
        phase = float(np.angle(turns.at_zero(order, coefficient)))
        orders.append(Order(float(order), size, half, phase, min(turned, math.pi), "", moved))
    return orders


def _multiple(order: float, base: float, within: float) -> bool:
    times = max(1, round(order / base))
    return abs(order - times * base) < within


def _named(order: Order, bases: Mapping[str, float], span: float) -> Order:
    """Return an order with the stated cause that it is a multiple of."""
    names = [name for name, base in bases.items() if _multiple(order.order, base, 1.0 / span)]
    return dataclasses.replace(order, source=" or ".join(names))


def _without(waves: _Waves, coefficient: Complex) -> Complex:
    """Return whole orders of the mean over turns of what the waves do not explain, shape (orders,)."""
    turns = waves.turns
    if not waves.each or not turns.count.all():
        return coefficient
    line = coefficients_of(turns.mean(turns.at_steps - waves.model()), turns.each)
    upto = min(coefficient.size, int(_BAND * turns.each))
    remaining = coefficient.copy()
    remaining[1:upto] = line[1:upto] * np.exp(-1j * np.arange(1, upto) * np.pi / turns.each)
    return remaining


def _turn_averaging(turns: _Turns, waves: _Waves) -> TurnAveraging | None:
    """Return what averaging removes, at the steps of a turn."""
    row, point = turns._at
    values = turns.at_steps
    mean = turns.mean(values)
    filled = turns.count > 0
    repeated = int(turns.count.sum() - np.count_nonzero(filled))
    if repeated < turns.each // 2:
        return None
    within, whole = float(np.mean((values - mean[point]) ** 2)), float(np.var(values))
    model = waves.model()
    other = float(np.mean((model - turns.mean(model)[point]) ** 2))
    order = np.argsort(row, kind="stable")
    begins = np.flatnonzero(np.diff(row[order], prepend=-1))
    sizes = np.diff(begins, append=row.size)
    ranges = np.maximum.reduceat(values[order], begins) - np.minimum.reduceat(values[order], begins)
    complete = sizes >= 0.95 * np.count_nonzero(filled)
    return TurnAveraging(
        within / whole if whole else 0.0,
        min(other / whole, 1.0) if whole else 0.0,
        float(np.ptp(values)),
        float(ranges[complete].mean()) if complete.any() else math.nan,
        float(np.ptp(mean[turns.count >= 0.5 * turns.count.max()])),
        turns.each,
    )


def averaging_note(run_orders: RunOrders) -> list[str]:
    """Return a sentence on what averaging over turns removed from a run, if it is not little.

    That is if orders that are not whole were found, or if it is a tenth of the variance.
    """
    averaging = run_orders.turn_averaging
    if averaging is None:
        return []
    others = [order for order in run_orders.orders if not order.whole]
    if not others and averaging.variance_share_removed < 0.1:
        return []
    unit = 10800.0 / math.pi
    text = ""
    if others:
        listed = ", ".join(
            f"{other.order:.4g}{f' ({other.source})' if other.source else ''} {other.amplitude * unit:.2g}′"
            for other in others[:6]
        )
        more = f" and {len(others) - 6} more" if len(others) > 6 else ""
        text = f"; {averaging.variance_share_of_other_orders:.0%} is in orders that are no whole number: {listed}{more}"
        if not all(other.source for other in others):
            text += " (of a belt or gears beside the drive, of another shaft, or of a disturbance in time)"
    return [
        f"{run_orders.run}: averaging over {run_orders.turns:.4g} turns removed {averaging.variance_share_removed:.0%} "
        f"of the variance of the transmission error{text}. Peak to peak it is "
        f"{averaging.peak_to_peak_of_all_turns * unit:.3g}′ over all turns, "
        f"{averaging.peak_to_peak_of_one_turn * unit:.3g}′ in one turn and "
        f"{averaging.peak_to_peak_of_the_mean * unit:.3g}′ in their mean."
    ]


def orders_json(run_orders: RunOrders) -> dict[str, Any]:
    """Return the orders of a run as a part of a `cycloid-figures/1` file (SI)."""
    averaging = run_orders.turn_averaging
    return {
        "run": run_orders.run,
        "direction": "forward" if run_orders.direction > 0 else "backward",
        "turns": run_orders.turns,
        "searched": run_orders.searched,
        "orders": [
            vars(order) | {"order": int(order.order) if order.whole else order.order, "unit": "rad"}
            for order in run_orders.orders
        ],
        "turn_averaging": None if averaging is None else vars(averaging) | {"unit": "rad"},
    }
