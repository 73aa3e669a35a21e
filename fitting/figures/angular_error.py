"""The angular transmission error of a curve, with the noise of its orders."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitting.figures.figure import DEFINITIONS, Figure
from fitting.transmission_error.curve import Curve, noise_of
from fitting.transmission_error.spectrum import Spectrum, detectable, range_of, significant, synthesised

Array = NDArray[np.float64]
_NEAREST = 3  # points around an extreme value, at least
_REDRAWN = 200  # spectra drawn with the noise found, for the uncertainty of a largest and a smallest value


def angular_transmission_error(curve: Curve, orders: Spectrum, runaway: float = 0.0, unresolved: float = 0.0) -> Figure:
    """Return the largest minus the smallest transmission error over one output turn of a curve.

    Only orders above the noise are used, because the range of noisy values is too large. The contribution of the noise
    in these orders is estimated from spectra with random noise: its mean is subtracted, its scatter is the uncertainty.
    Without any order above the noise the value is 0, and the uncertainty is the range of the largest order that the
    noise could hide.

    Parameters
    ----------
    curve, orders
        A curve over a whole turn and its orders.
    runaway
        Half width of the 95 % interval, rad, of the error's drift over the recording between two clocks; the share of
        one turn is added to the uncertainty, because every turn starts again.
    unresolved
        Range, rad, that the orders above the noise lack, see `unresolved_range`. It is known too roughly for a
        correction, so all of it is added to the uncertainty (GUM, F.2.4.5).
    """
    rng = np.random.default_rng(0)
    significant_part = np.where(orders.significant, orders.coefficient, 0.0)
    highest = int(np.flatnonzero(orders.significant).max(initial=1))
    points = 1 << max(10, math.ceil(math.log2(64 * highest)))
    largest_range = float(range_of(significant_part[: highest + 1], points)[0])
    drawn = np.empty(_REDRAWN)
    step = max(1, (1 << 22) // points)
    for begin in range(0, _REDRAWN, step):
        rows = min(step, _REDRAWN - begin)
        noise = rng.normal(size=(rows, 2, highest + 1)) * (orders.floor[: highest + 1] / math.sqrt(2.0))
        noisy = significant_part[: highest + 1] + noise[:, 0] + 1j * noise[:, 1]
        out = significant(noisy, orders.floor[: highest + 1], orders.floor.size)
        drawn[begin : begin + rows] = range_of(np.where(out, noisy, 0.0), points)
    bias = float(drawn.mean()) - largest_range
    scatter = 1.96 * float(drawn.std(ddof=1))
    if not orders.significant.any():
        scatter = 2.0 * float(detectable(orders.floor[1:], orders.floor.size).max())
    uncertainty = math.hypot(scatter + unresolved, runaway / max(curve.turns, 1.0))
    definition, interval = DEFINITIONS["angular_transmission_error"], (0.0, 2.0 * math.pi)
    return Figure(max(largest_range - bias, 0.0), uncertainty, *definition, interval, "rad", curve.turns, "turns")


def unresolved_range(curve: Curve, orders: Spectrum, used: Spectrum) -> float:
    """Return the range, rad, by which that of a curve may differ from that of its orders above the noise.

    Corners, where pins come into contact, consist of many small orders: noise hides most of them, and samples are too
    few for the highest. The sum of two estimates:

    - the mean deviation of the points around both extreme values from the orders above the noise, within half a wave of
      the highest, as far as it exceeds that of noise;
    - the contribution of orders from a third to the highest above the noise. That of all higher ones is half as large,
      and hardly more than as large, where amplitudes fall with the square of the order, as at corners. As far as noise
      and not the samples' number hides them, they are at most as many times the largest amplitude that noise hides as
      orders are above it: the sum of amplitudes that fall with the square from there.

    Parameters
    ----------
    curve, orders
        A curve over a whole turn and its orders.
    used
        The orders of which the range is taken, such as those without the rig's.
    """
    present = np.flatnonzero(orders.significant)
    if not used.significant.any():
        return 0.0
    highest, resolved = int(present.max()), orders.floor.size
    coefficient = np.where(used.significant, used.coefficient, 0.0)[: highest + 1]
    grid = 1 << max(10, math.ceil(math.log2(64 * highest)))
    lower = np.where(3 * np.arange(highest + 1) <= highest, coefficient, 0.0)
    higher = abs(float(np.diff(range_of(np.stack([coefficient, lower]), grid))[0]))
    if 2 * highest < resolved:
        missed = detectable(orders.floor, resolved) + orders.uncertainty
        higher = min(higher, present.size * float(missed[present].max()))
    course = synthesised(coefficient.copy(), grid)
    angle = np.mod(curve.input_angle / abs(curve.ratio), 2.0 * np.pi)
    count = curve.sample_count.astype(float)
    noise, order = noise_of(curve) ** 2 * float(np.median(count)), np.append(0, present)
    deviation, variance = 0.0, 0.0
    for extreme, sign in ((int(course.argmax()), 1.0), (int(course.argmin()), -1.0)):
        away = np.abs(np.mod(angle - 2.0 * np.pi * extreme / grid + np.pi, 2.0 * np.pi) - np.pi)
        near = np.argsort(away)[: max(_NEAREST, int(np.count_nonzero(away < 0.5 * np.pi / highest)))]
        wave = np.exp(1j * np.multiply.outer(angle[near], order))
        rest = curve.transmission_error[near] - (wave @ orders.coefficient[order]).real
        deviation += sign * float(np.average(rest, weights=count[near]))
        variance += noise / float(count[near].sum())
    return math.sqrt(max(deviation**2 - variance, 0.0)) + higher
