"""Normal equations of unknowns whose uncertainties differ by orders of magnitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

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
        self._factor = linalg.cho_factor(gram / np.outer(self._size, self._size))

    def solve(self, slope: Array) -> Array:
        """Return the unknowns of a right side, shape (unknowns,)."""
        found: Array = linalg.cho_solve(self._factor, slope / self._size) / self._size
        return found

    def inverse(self) -> Array:
        """Return the inverse of the matrix."""
        size = self._size
        found: Array = linalg.cho_solve(self._factor, np.eye(size.size)) / np.outer(size, size)
        return found
