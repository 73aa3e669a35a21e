"""The orders of a transmission error curve, per output turn, with the noise around each, and their range."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

RIG_ORDERS = (1, 2, 3)
"""Orders of the output turn caused by the rig: run-out, and couplings at two and three times per turn. Those of the
input turn are not included: pins cause them too, and the run-out of the input is divided by the ratio."""
_WINDOW = 101  # neighbouring orders whose median is the noise floor of an order
_HOLES = 0.02  # share of a turn's points that may be empty


@dataclass(frozen=True)
class Spectrum:
    """Orders of the output in a transmission error curve, arrays of shape (orders,) from order 0.

    Attributes
    ----------
    coefficient
        Complex amplitude, rad: order k is Re(c_k exp(ikψ)), ψ the crank angle over |ratio|; order 0 is the mean.
    floor
        Noise floor, rad: the rms amplitude of the noise around each order.
    turns
        Number of output turns.
    """

    coefficient: NDArray[np.complex128]
    floor: Array
    turns: float

    @property
    def amplitude(self) -> Array:
        """Amplitude of each order, rad."""
        return np.abs(self.coefficient)

    @property
    def uncertainty(self) -> Array:
        """Half width of the 95 % interval of each amplitude, rad."""
        half: Array = 1.96 * self.floor / np.sqrt(2.0)
        return half

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Mask of the orders above the noise, without the mean; see `significant`."""
        return significant(self.coefficient, self.floor, self.floor.size)


def significant(coefficient: NDArray[np.complex128], floor: Array, orders: int) -> NDArray[np.bool_]:
    """Return the mask of orders above the noise, without order 0.

    In a spectrum of `orders` orders of noise only, one of them exceeds the threshold with a probability of 1 %.

    Parameters
    ----------
    coefficient
        Complex amplitudes, rad, from order 0, shape (…, n).
    floor
        Noise floor of each order, rad, shape (n,).
    orders
        Number of orders of the whole spectrum.
    """
    above: NDArray[np.bool_] = np.abs(coefficient) > detectable(floor, orders)
    above[..., 0] = False
    return above


def detectable(floor: Array, orders: int) -> Array:
    """Return the amplitude, rad, that an order exceeds if it is above the noise; the arguments are of `significant`."""
    threshold: Array = floor * np.sqrt(np.log(orders / 0.01))
    return threshold


def spectrum(curve: Curve) -> Spectrum:
    """Return the orders of a curve over a whole output turn.

    The points are not evenly spaced: each is a mean over the angles of its samples. The orders reproduce the measured
    means at these angles, to second order in the angle, by iteration on an even grid. The noise floor of an order is
    from the median around it, so it follows coloured noise and is not affected by single orders.

    Raises
    ------
    edge.InputError
        If the curve is incomplete: less than a turn was recorded, gaps are always at the same angles, or the samples
        are too few for the order of the input turn, the lowest of a drive's own.
    """
    turn = 2.0 * np.pi * abs(curve.ratio)
    points, shift = curve.grid
    if not points:
        points = curve.input_angle.size
        shift = float(curve.input_angle[0]) - 0.5 * turn / points
    scale = 1.0 / abs(curve.ratio)  # from crank angles to those of the output turn
    position = np.mod(curve.input_angle - shift, turn) * scale
    variance = np.zeros(position.size) if curve.angle_variance is None else curve.angle_variance * scale**2
    while True:
        gathered = _gridded(position, curve.transmission_error, variance, curve.sample_count.astype(float), points)
        filled = gathered[3]
        if np.count_nonzero(filled) >= (1.0 - _HOLES) * points or points <= 64:
            break
        points //= 2
    value, inside, spread, filled = gathered
    runs = np.diff(np.flatnonzero(np.concatenate([filled, filled, [True]])))
    if np.count_nonzero(filled) < (1.0 - _HOLES) * points or runs.max() > max(2, points // 64):
        raise edge.InputError(
            f"{curve.source}: {np.count_nonzero(filled) / points:.1%} of an output turn was recorded; its orders need "
            "all of it."
        )
    if points <= 2.0 * abs(curve.ratio):
        raise edge.InputError(
            f"{curve.source}: an output turn has {points} samples, at most two per turn of the input; its orders need "
            "more."
        )
    # Highest order for which two terms of the series in the angle suffice; evenly sampled turns have the full band.
    reach = float(np.max(np.abs(inside[filled]) + np.sqrt(spread[filled])))
    highest = max(1, min((points - 1) // 2, max(points // 4, int(0.25 * np.pi / max(reach, 1e-9)))))
    order = np.arange(highest + 1)
    shift_phase = np.exp(1j * order * (shift * scale + np.pi / points))
    coefficient = np.zeros(highest + 1, complex)
    for _ in range(50):
        wave = coefficient * shift_phase
        model = synthesised(wave, points)
        model += synthesised(1j * order * wave, points) * inside
        model += synthesised(-(order**2) * wave, points) * (0.5 * (inside**2 + spread))
        step = coefficients_of(np.where(filled, value - model, 0.0), points)[: highest + 1] / shift_phase
        coefficient = coefficient + step
        # Converged far below the noise of an order, or without noise, relative to the largest order.
        amplitude = np.abs(coefficient[1:])
        if np.abs(step[1:]).max() <= max(1e-9 * amplitude.max(), 1e-4 * float(np.median(amplitude))):
            break
    power = np.abs(coefficient[1:]) ** 2
    floor = noise_floor(power, _WINDOW)
    floor = np.maximum(np.concatenate([floor[:1], floor]), 1e-15)
    return Spectrum(coefficient, floor, curve.turns)


def run_label(source: str, curve: Curve) -> str:
    """Return the label of a run: recording, load and direction."""
    load = "unknown load" if np.isnan(curve.torque) else f"{curve.torque:.4g} N*m"
    return f"{source}, {load}, {'forward' if curve.direction > 0 else 'backward'}"


def without_orders(orders: Spectrum, left_out: Sequence[int]) -> Spectrum:
    """Return a spectrum without some of its orders; its noise floor is unchanged."""
    remaining = ~np.isin(np.arange(orders.coefficient.size), left_out)
    return dataclasses.replace(orders, coefficient=np.where(remaining, orders.coefficient, 0.0))


def coefficients_of(values: ArrayLike, samples: int, points: int | None = None) -> NDArray[np.complex128]:
    """Return the complex amplitudes of even values, shape (n,): the inverse of `synthesised`.

    Parameters
    ----------
    values
        Values at even angles from 0; 0 where there is none.
    samples
        Number of them that are there.
    points
        Values to which they are extended by zeros, for finer orders.
    """
    coefficient: NDArray[np.complex128] = np.fft.rfft(values, points) * (2.0 / samples)
    coefficient[0] *= 0.5
    return coefficient


def noise_floor(power: Array, window: int) -> Array:
    """Return the rms amplitude of the noise at each order from the median of the squares of its neighbours."""
    return np.asarray(
        np.sqrt(scipy.ndimage.median_filter(power, min(window, power.size), mode="reflect") / np.log(2.0))
    )


def synthesised(coefficient: NDArray[np.complex128], points: int) -> Array:
    """Return Re Σ c_k exp(ikψ) at `points` even angles from 0; the coefficients are along the last axis.

    Parameters
    ----------
    coefficient
        Complex amplitudes from order 0, shape (…, orders); orders below half the points.
    points
        Angles over a turn.
    """
    scaled = coefficient * (0.5 * points)
    scaled[..., 0] *= 2.0
    values: Array = np.fft.irfft(scaled, points, axis=-1)
    return values


def _gridded(
    position: Array, error: Array, variance: Array, weight: Array, points: int
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Gather points on an even grid of the output turn: mean error, mean and variance of the angle within, filled.

    All results have shape (points,); angles are relative to the centre of each grid cell, rad of the output.
    """
    spacing = 2.0 * np.pi / points
    number = np.minimum((position / spacing + 1e-9).astype(np.int64), points - 1)
    total = np.bincount(number, weight, points)
    filled = total > 0.0
    total[~filled] = 1.0
    offset = position - (number + 0.5) * spacing
    inside = np.bincount(number, weight * offset, points) / total
    second = np.bincount(number, weight * (offset**2 + variance), points) / total
    value = np.bincount(number, weight * error, points) / total
    return value, inside, np.maximum(second - inside**2, 0.0), filled


def order_name(order: int, ratio: float, pair: Pair | None) -> str:
    """Return the cause of an order of the output turn, "" if unknown.

    Errors of pins and ring repeat at multiples of the number of teeth, those of teeth at multiples of the number of
    pins, with gear or ring as output; common multiples are the mesh. `RIG_ORDERS` are from the rig: coaxiality and
    couplings. Without the pair only orders of the input turn are known.
    """
    if order in RIG_ORDERS:
        return "rig"
    if pair is None:
        return "input turn" if abs(order / ratio - round(order / ratio)) * abs(ratio) < 1e-6 else ""
    teeth, pins = pair.gear_teeth, pair.pins
    kinds = [name for name, per_turn in (("pin", teeth), ("tooth", pins)) if order % per_turn == 0]
    return "mesh" if len(kinds) > 1 else "".join(kinds)


def range_of_orders(orders: Spectrum) -> float:
    """Return the largest minus the smallest value of the curve made of the orders above the noise, rad.

    Unlike `angular_transmission_error`, it does not subtract the contribution of the noise in these orders, and takes a
    thousandth of the time.

    Parameters
    ----------
    orders
        Orders of a curve.
    """
    coefficient = np.where(orders.significant, orders.coefficient, 0.0)
    coefficient[0] = 0.0
    highest = int(np.flatnonzero(coefficient).max(initial=1))
    points = 1 << max(10, math.ceil(math.log2(16 * highest)))
    return float(range_of(coefficient[: highest + 1], points)[0])


def range_of(coefficient: NDArray[np.complex128], points: int) -> Array:
    """Return the largest minus the smallest value of curves, shape (curves,), in the unit of the coefficients.

    Each extreme is refined by a parabola through the extreme point and its neighbours.

    Parameters
    ----------
    coefficient
        Complex amplitudes from order 0, shape (orders,) or (curves, orders).
    points
        Number of evenly spaced points of a turn in which to search for the extremes.
    """
    curves = synthesised(np.atleast_2d(coefficient), points)
    return _top(curves) + _top(-curves)


def _top(curves: Array) -> Array:
    """Return the largest value of each row, refined by a parabola through it and its neighbours (periodic)."""
    rows, at = np.arange(curves.shape[0]), np.argmax(curves, axis=-1)
    before, peak, after = (curves[rows, (at + step) % curves.shape[1]] for step in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * peak + after, -1e-300)
    top: Array = peak - (before - after) ** 2 / (8.0 * bend)
    return top
