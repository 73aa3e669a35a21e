"""The transmission error of all turns before they are averaged, at even steps of the unwrapped crank angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST = 1 << 16  # most steps of a recording; the steps of a longer one are wider
_HALVINGS = 12  # an output turn stays a whole number of steps when they are made this many times twice as wide


@dataclass(frozen=True)
class Unaveraged:
    """Transmission error before it is averaged over turns, arrays of shape (steps,).

    A step is an even part of the output turn; it has the mean of all samples that fall on it, also in several passes.

    Attributes
    ----------
    number
        Numbers of the steps with samples, ascending; step j covers crank angles from j to j + 1 times 2π|ratio|/`each`.
    input_angle
        Mean crank angle of the samples of each step, rad, unwrapped.
    transmission_error
        φ_b - φ_a/ratio, rad.
    angle_variance
        Variance of the crank angles within each step, rad².
    each
        Steps of an output turn.
    """

    number: NDArray[np.int64]
    input_angle: Array
    transmission_error: Array
    angle_variance: Array
    each: int


class Steps:
    """Adds up samples at even steps of the unwrapped crank angle; twice as wide steps whenever there are too many.

    Parameters
    ----------
    turn
        Crank angle of an output turn, rad.
    points
        Points of a turn that hold a sample or more in each turn: there are at most as many steps.
    """

    def __init__(self, turn: float, points: int) -> None:
        self._turn = turn
        whole = 1 << max(0, min(_HALVINGS, points.bit_length() - 4))
        self.each = points // whole * whole
        self._parts: list[tuple[NDArray[np.int64], Array]] = []
        self._held = 0

    def add(self, angle: Array, samples: NDArray[np.int64], inside: Array, squares: Array, error: Array) -> None:
        """Add groups of neighbouring samples.

        Parameters
        ----------
        angle, samples
            A crank angle near each group, rad, and its number of samples, shape (groups,).
        inside, squares, error
            Sums over the samples of each group of their crank angle less `angle`, of its square, and of the error.
        """
        spacing = self._turn / self.each
        number = np.floor((angle + inside / samples) / spacing).astype(np.int64)
        away = angle - (number + 0.5) * spacing
        sums = np.stack([samples, samples * away + inside, (samples * away + 2.0 * inside) * away + squares, error])
        self._keep(number, sums)
        if self._held > 2 * MOST:
            self._merge()
            while self._held > MOST and self.each % 2 == 0:
                self._widen()

    def _keep(self, number: NDArray[np.int64], sums: Array) -> None:
        """Hold groups by the number of their step, joined where neighbouring groups are of one step."""
        begins = np.flatnonzero(np.concatenate([[True], number[1:] != number[:-1]]))
        if begins.size < number.size:
            number, sums = number[begins], np.add.reduceat(sums, begins, axis=1)
        self._parts.append((number, sums))
        self._held += number.size

    def _merge(self) -> None:
        number, sums = (np.concatenate(columns, axis=-1) for columns in zip(*self._parts, strict=True))
        order = np.argsort(number, kind="stable")
        self._parts, self._held = [], 0
        self._keep(number[order], sums[:, order])

    def _widen(self) -> None:
        """Make the steps twice as wide."""
        ((number, sums),) = self._parts
        away = np.where(number % 2 == 0, -0.5, 0.5) * self._turn / self.each
        samples, inside, squares, error = sums
        sums = np.stack([samples, inside + samples * away, squares + (2.0 * inside + samples * away) * away, error])
        self.each //= 2
        self._parts, self._held = [], 0
        self._keep(number // 2, sums)

    def unaveraged(self, reference: float) -> Unaveraged:
        """Return the means of the steps; `reference`: transmission error, rad, that the added ones are relative to."""
        self._merge()
        while self._held > MOST and self.each % 2 == 0:
            self._widen()
        ((number, (samples, inside, squares, error)),) = self._parts
        inside = inside / samples
        angle = (number + 0.5) * (self._turn / self.each) + inside
        variance = np.maximum(squares / samples - inside**2, 0.0)
        return Unaveraged(number, angle, error / samples + reference, variance, self.each)
