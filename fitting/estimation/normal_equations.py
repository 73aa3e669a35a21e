"""Normal equations of unknowns whose uncertainties differ by orders of magnitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]


class Factor:
    """Cholesky factor of normal equations, after each unknown was scaled to 1 on the diagonal.

    Parameters
    ----------
    gram
        Matrix of the normal equations, positive definite, shape (unknowns, unknowns).

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """

    def __init__(self, gram: Array) -> None:
        self._size = np.sqrt(np.diag(gram))
        scaled = gram / self._size[:, None]
        scaled /= self._size
        # Symmetric: its transpose is the same matrix in the order of LAPACK.
        self._factor, failed = lapack.dpotrf(scaled.T, lower=True, clean=False, overwrite_a=True)
        if failed or not np.isfinite(np.diag(self._factor)).all():
            raise np.linalg.LinAlgError("the normal equations are not positive definite")

    def solve(self, slope: Array) -> Array:
        """Return the unknowns of right sides, shape (unknowns,) or (unknowns, sides)."""
        size = self._size.reshape(-1, *[1] * (slope.ndim - 1))
        found: Array = lapack.dpotrs(self._factor, slope / size, lower=True)[0]
        return found / size

    def inverse(self) -> Array:
        """Return the inverse of the matrix."""
        half = np.tril(lapack.dpotri(self._factor, lower=True)[0])
        found: Array = half + np.tril(half, -1).T
        found /= self._size[:, None]
        found /= self._size
        return found

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the matrix."""
        return float(2.0 * (np.log(np.diag(self._factor)).sum() + np.log(self._size).sum()))
