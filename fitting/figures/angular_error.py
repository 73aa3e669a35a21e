"""The angular transmission error of a curve, with the noise of its orders."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitting.figures.figure import DEFINITIONS, Figure
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.spectrum import Spectrum, range_of, significant

Array = NDArray[np.float64]
_REDRAWN = 200  # spectra drawn with the noise found, for the uncertainty of a largest and a smallest value


def angular_transmission_error(curve: Curve, orders: Spectrum, runaway: float = 0.0) -> Figure:
    """Return the largest minus the smallest transmission error over one output turn of a curve.

    Only orders above the noise are used, because the range of noisy values is too large. The contribution of the noise
    in these orders is estimated from spectra with random noise: its mean is subtracted, its scatter is the uncertainty.

    Parameters
    ----------
    curve, orders
        A curve over a whole turn and its orders.
    runaway
        Half width of the 95 % interval, rad, of the error's drift over the recording between two clocks; the share of
        one turn is added to the uncertainty, because every turn starts again.
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
    uncertainty = math.hypot(1.96 * float(drawn.std(ddof=1)), runaway / max(curve.turns, 1.0))
    definition, interval = DEFINITIONS["angular_transmission_error"], (0.0, 2.0 * math.pi)
    return Figure(max(largest_range - bias, 0.0), uncertainty, *definition, interval, "rad", curve.turns, "turns")
