"""Normal distributions of the unknowns of linear models, and the normal equations that give them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from threadpoolctl import threadpool_limits

from cycloid_fmu import edge

Array = NDArray[np.float64]
Part = Sequence[str] | Sequence[int] | NDArray[np.int64]
"""Some unknowns, by name or by number."""


@contextmanager
def equations() -> Iterator[None]:
    """Solve the equations of a fit on one thread: the kernel's keep the processor busy, others would spin beside them.

    Raises
    ------
    edge.InputError
        If they are singular.
    """
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    except np.linalg.LinAlgError:
        raise edge.InputError(
            "the equations of the fit are singular, as for curves without noise; add some to simulated ones."
        ) from None


class Gaussian:
    """A normal distribution of unknowns in its canonical form, information and slope.

    Unknowns are scaled to an information of 1 each before a factor is computed: their uncertainties differ by orders of
    magnitude. The factor is computed on first use.

    Parameters
    ----------
    information
        Inverse of the covariance, positive definite, shape (unknowns, unknowns).
    slope
        Information times mean, shape (unknowns,); by default the mean is zero.
    names
        Names of the unknowns, if they have any.
    along
        On the condition that the unknowns' distance from zero is `along` times that of those which are free, shape
        (unknowns, unknowns); columns of others are zero. By default all are free.

    Raises
    ------
    numpy.linalg.LinAlgError
        On first use of the factor, if the information is not positive definite.

    Examples
    --------
    >>> import numpy as np
    >>> from fitting.model.gaussian import Gaussian
    >>> joint = Gaussian.of(np.array([1.0, 2.0]), np.array([[4.0, 1.0], [1.0, 1.0]]), ["a", "b"])
    >>> joint.marginal(["a"]).covariance.round(9), joint.mean.round(9)
    (array([[4.]]), array([1., 2.]))
    """

    def __init__(
        self,
        information: Array,
        slope: Array | None = None,
        names: Sequence[str] = (),
        along: Array | None = None,
    ) -> None:
        self.information, self.names, self.along = information, tuple(names), along
        self.slope = np.zeros(len(information)) if slope is None else slope
        self._ways = None if along is None else along[:, along.any(axis=0)]

    @classmethod
    def of(cls, mean: Array, covariance: Array, names: Sequence[str] = ()) -> Gaussian:
        """Return the distribution with a mean and a covariance, which must be positive definite."""
        information = Gaussian(covariance).covariance
        return cls(information, information @ mean, names)

    @cached_property
    def _reduced(self) -> Array:
        """Information on the free unknowns."""
        return self.information if self._ways is None else self._ways.T @ self.information @ self._ways

    @cached_property
    def _size(self) -> Array:
        return np.sqrt(np.diag(self._reduced))

    @cached_property
    def _scaled(self) -> Array:
        scaled: Array = self._reduced / np.outer(self._size, self._size)
        return scaled

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        if not np.isfinite(self._scaled).all():
            raise np.linalg.LinAlgError("the information is not finite")
        factor: tuple[Array, bool] = linalg.cho_factor(self._scaled, check_finite=False)
        return factor

    def solve(self, right: Array) -> Array:
        """Return the covariance times a vector, or times each column of a matrix."""
        size = self._size if right.ndim == 1 else self._size[:, None]
        own = right if self._ways is None else self._ways.T @ right
        solved: Array = linalg.cho_solve(self._factor, own / size) / size
        return solved if self._ways is None else self._ways @ solved

    @cached_property
    def mean(self) -> Array:
        """Mean of each unknown, shape (unknowns,)."""
        return self.solve(self.slope)

    @cached_property
    def covariance(self) -> Array:
        """Covariance, symmetric, shape (unknowns, unknowns)."""
        inverse = linalg.cho_solve(self._factor, np.eye(self._size.size)) / np.outer(self._size, self._size)
        symmetric: Array = 0.5 * (inverse + inverse.T)
        return symmetric if self._ways is None else self._ways @ symmetric @ self._ways.T

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the information."""
        return float(2.0 * (np.log(np.diag(self._factor[0])).sum() + np.log(self._size).sum()))

    @property
    def condition(self) -> float:
        """Condition number of the scaled information, estimated from its factor; infinite if it is singular."""
        try:
            factor, lower = self._factor
        except np.linalg.LinAlgError:
            return np.inf
        share, _ = linalg.lapack.dpocon(factor, np.linalg.norm(self._scaled, 1), uplo="L" if lower else "U")
        return float(1.0 / share) if share > 0.0 else np.inf

    def _numbers(self, part: Part) -> NDArray[np.int64]:
        return np.array([self.names.index(one) if isinstance(one, str) else one for one in part], dtype=np.int64)

    def marginal(self, part: Part) -> Gaussian:
        """Return the distribution of some unknowns, by name or number, whatever the others are (Schur complement)."""
        own = self._numbers(part)
        others = np.setdiff1d(np.arange(len(self.information)), own)
        cross = self.information[np.ix_(others, own)]
        rest = Gaussian(self.information[np.ix_(others, others)], self.slope[others])
        information = self.information[np.ix_(own, own)] - cross.T @ rest.solve(cross)
        slope = self.slope[own] - cross.T @ rest.mean
        return Gaussian(0.5 * (information + information.T), slope, [self.names[i] for i in own] if self.names else ())

    def given(self, rows: Array, values: Array) -> tuple[Array, Array]:
        """Return mean and covariance of all unknowns x on the condition rows @ x = values; rows are independent."""
        shared = self.covariance @ rows.T
        gain = np.linalg.solve(rows @ shared, shared.T).T
        return self.mean + gain @ (values - rows @ self.mean), self.covariance - gain @ shared.T

    def bounded(self, low: Array, high: Array, rows: Array | None = None) -> Array:
        """Return the most likely values within bounds: what is beyond is put at its bound, the farthest first.

        What cannot move keeps its value, also one that rounding has put beyond its bound.

        Parameters
        ----------
        low, high
            Bounds of rows @ values, shape (rows,).
        rows
            Shape (rows, unknowns); by default the bounds are those of the unknowns.
        """
        every, values, held = np.eye(self.slope.size) if rows is None else rows, self.mean, dict[int, float]()
        is_fixed = np.zeros(len(every), dtype=bool) if self._ways is None else ~(every @ self._ways).any(axis=1)
        while True:
            combined = values if rows is None else rows @ values
            beyond = np.maximum(low - combined, combined - high)
            beyond[list(held)], beyond[is_fixed] = 0.0, 0.0
            if not beyond.size or beyond[at := int(np.argmax(beyond))] <= 0.0:
                return np.clip(values, low, high) if rows is None else values
            held[at] = float(low[at] if combined[at] < low[at] else high[at])
            values, _ = self.given(every[list(held)], np.array([*held.values()]))

    def holding(self, held: NDArray[np.bool_]) -> Gaussian:
        """Return the distribution on the condition that some unknowns are zero, shape (unknowns,) of bool."""
        if not held.any():
            return self
        along = np.eye(held.size) if self.along is None else self.along
        return Gaussian(self.information, self.slope, self.names, np.where(held, 0.0, along))

    def extended(self, cross: Array, own: Array) -> Gaussian:
        """Return the distribution with further unknowns, all means zero.

        Parameters
        ----------
        cross, own
            Information on these with the others, shape (unknowns, further), and on these, shape (further, further).
        """
        along = None if self.along is None else linalg.block_diag(self.along, np.eye(len(own)))
        return Gaussian(np.block([[self.information, cross], [cross.T, own]]), along=along)

    def damped(self, share: float) -> Gaussian:
        """Return the distribution with more information on each unknown by a share (Levenberg and Marquardt's step)."""
        damped = self.information + share * np.diag(np.diag(self.information))
        return Gaussian(damped, self.slope, self.names, self.along)

    def gain(self, change: Array) -> float:
        """Return by how much x = change is a better solution than x = 0: the decrease of the sum of squares."""
        return float(2.0 * self.slope @ change - change @ self.information @ change)

    def score(self, part: Part, values: Array) -> float:
        """Return the squared Mahalanobis distance of some unknowns' values from their mean: χ² with as many degrees."""
        own = self._numbers(part)
        units = np.zeros((len(self.information), len(own)))
        units[own, np.arange(len(own))] = 1.0
        away = values - self.mean[own]
        return float(away @ np.linalg.solve(self.solve(units)[own], away))


@dataclass(frozen=True)
class Evidence:
    """What the rows of a linear model, residual = columns @ unknowns + noise of size 1, tell of its unknowns.

    Attributes
    ----------
    gram, moment, square
        Of columns C and residual r: CᵀC, shape (unknowns, unknowns); Cᵀr, shape (unknowns,); rᵀr.
    """

    gram: Array
    moment: Array
    square: float = 0.0

    @classmethod
    def of(cls, columns: Array, residual: Array | None = None) -> Evidence:
        """Return the evidence of rows in units of their noise; without a residual it is zero."""
        if residual is None:
            return cls(columns.T @ columns, np.zeros(columns.shape[1]))
        return cls(columns.T @ columns, columns.T @ residual, float(residual @ residual))

    def __add__(self, other: Evidence) -> Evidence:
        """Return what both tell together."""
        return Evidence(self.gram + other.gram, self.moment + other.moment, self.square + other.square)

    def repeated(self, times: float) -> Evidence:
        """Return what so many measurements tell together, of which each has the same rows."""
        return Evidence(times * self.gram, times * self.moment, times * self.square)

    def posterior(
        self,
        precision: Array,
        away: Array | None = None,
        names: Sequence[str] = (),
        along: Array | None = None,
    ) -> Gaussian:
        """Return the distribution of the unknowns' changes, from where the residual was evaluated.

        Parameters
        ----------
        precision
            1/variance of each unknown's prior, shape (unknowns,).
        away
            Distance of the unknowns from the prior's mean where the residual was evaluated; by default zero.
        names, along
            As in `Gaussian`.
        """
        slope = self.moment if away is None else self.moment - precision * away
        return Gaussian(self.gram + np.diag(precision), slope, names, along)


def truncated(slope: Array, spread: Array, size: Array, least: float) -> tuple[float, int, Array]:
    """χ² of a vector with a covariance that may be singular, from the directions in which it varies.

    Parameters
    ----------
    slope, spread
        The vector and its covariance.
    size
        Scale of each entry of the vector.
    least
        Directions with a smaller variance in this scale are left out.

    Returns
    -------
    square, count
        χ², and the number of its degrees of freedom.
    coefficients
        Generalised inverse of the covariance times the vector.
    """
    values, vectors = np.linalg.eigh(spread / np.outer(size, size))
    inside = values > least
    slopes = (vectors.T @ (slope / size))[inside]
    coefficients: Array = vectors[:, inside] @ (slopes / values[inside]) / size
    return float(slopes**2 @ (1.0 / values[inside])), int(np.count_nonzero(inside)), coefficients


def factor_of(covariance: Array) -> Array:
    """Return F with F Fᵀ the covariance, which may be singular: unknowns without variance stay exactly constant."""
    size = np.sqrt(np.diag(covariance))
    scale = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    factor: Array = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return factor
