"""What earlier measurements have told of a drive: the prior of the next fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.model.losses import is_coefficient

Array = NDArray[np.float64]

OF_RECORDINGS = (
    "output_angle_",
    "loop_angle_offset",
    "crank_angle_offset",
    "friction",
    "loop_friction",
    "misfit",
    "form_",
)
"""How the names of unknowns begin that belong to recordings: zeros and their drift with warm-up, friction of the day,
and causes outside the model."""
OF_MOUNTING = ("output_encoder", "input_encoder")
"""The same of unknowns that last as long as the encoders stay mounted: their run-out."""
_CONSTANT = 1e-8  # standard deviation of a constant, in the unit of a fit: a usual size
_LEAST = 1e-12  # variance of a combination of unknowns, relative to theirs: below is rounding


def lasting(names: Sequence[str], mounted: bool) -> list[str]:
    """Return the unknowns of a fit that are the same in the next one, as long as encoders stay `mounted` or not.

    A fit's drive states its friction coefficients as numbers; what friction does otherwise is of each recording.
    """
    leaves = OF_RECORDINGS if mounted else (*OF_RECORDINGS, *OF_MOUNTING)
    return [name for name in names if not (name.startswith(leaves) or is_coefficient(name))]


def fitted_to(surface: ErrorSurface) -> tuple[str, ...]:
    """Return the SHA-256 of all recordings that a surface was fitted to, those of earlier fits included."""
    return tuple(str(surface.attributes.get("data", "")).split())


def factor_rows(covariance: Array) -> list[list[float]]:
    """Return the lower triangle of a factor of a covariance, row by row with nine digits; constants have zeros."""
    size = np.sqrt(np.diag(covariance))
    scale = np.where(size > 0.0, size, 1.0)
    correlation = covariance / np.outer(scale, scale)
    correlation[np.diag_indices(len(size))] = 1.0 + _LEAST
    factor = np.linalg.cholesky(correlation) * size[:, None]
    return [[float(f"{v:.9g}") for v in row[: i + 1]] for i, row in enumerate(factor)]


@dataclass(frozen=True)
class Posterior:
    """A normal distribution of the unknowns of a fit that are the same in the next one.

    Attributes
    ----------
    drive
        The most likely drive; its surface includes the scatter, its pair and first stage the bearings.
    plain
        Its surface without scatter.
    errors, bench, scatter
        Names of structured errors, of the bench with the bearings, and of single pins and teeth.
    mean
        Means of errors, bench and scatter in this order, SI; 0 for bearings, as they are in the drive.
    covariance
        Their covariance, SI; unknowns without variance are constants.
    """

    drive: Drive
    plain: ErrorSurface
    errors: tuple[str, ...]
    bench: tuple[str, ...]
    scatter: tuple[str, ...]
    mean: Array
    covariance: Array

    @property
    def names(self) -> list[str]:
        """Names of all unknowns, in their order."""
        return [*self.errors, *self.bench, *self.scatter]

    @property
    def bench_mean(self) -> Array:
        """Means of the bench, shape (bench,)."""
        return self.mean[len(self.errors) : len(self.errors) + len(self.bench)]

    @property
    def scatter_mean(self) -> Array:
        """Means of the scatter, shape (scatter,)."""
        return self.mean[len(self.errors) + len(self.bench) :]

    @property
    def of_surface(self) -> Array:
        """Covariance of errors and scatter, whatever the bench is."""
        own = np.r_[: len(self.errors), len(self.errors) + len(self.bench) : len(self.mean)]
        covariance: Array = self.covariance[np.ix_(own, own)]
        return covariance

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each unknown, SI."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def rows(self, names: Sequence[str], scale: Array) -> tuple[Array, Array]:
        """Return the distribution of some unknowns as measurements of them.

        Parameters
        ----------
        names, scale
            The unknowns of a fit, and the unit of each, SI, shape (unknowns,).

        Returns
        -------
        columns, values
            Shape (rows, unknowns) and (rows,): values - columns @ unknowns, with the unknowns in their units, is noise
            of size 1.
        """
        at = [i for i, name in enumerate(names) if name in set(self.names)]
        own = [self.names.index(names[i]) for i in at]
        covariance = self.covariance[np.ix_(own, own)] / np.outer(scale[at], scale[at])
        covariance[np.diag_indices(len(own))] += _CONSTANT**2
        size = np.sqrt(np.diag(covariance))
        variances, axes = np.linalg.eigh(covariance / np.outer(size, size))
        columns = np.zeros((len(own), len(names)))
        columns[:, at] = (axes / np.sqrt(np.maximum(variances, _LEAST))).T / size
        return columns, columns[:, at] @ (self.mean[own] / scale[at])

    def updated(self, names: Sequence[str], mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return mean and covariance of all unknowns after measurements of some; the others follow by correlation.

        Parameters
        ----------
        names, mean, covariance
            The distribution of some unknowns after the measurements, SI.
        """
        own = [self.names.index(name) for name in names]
        others = [i for i in range(len(self.mean)) if i not in set(own)]
        was = self.covariance[np.ix_(own, own)]
        size = np.sqrt(np.maximum(np.diag(was), np.finfo(float).tiny))
        cross = self.covariance[np.ix_(others, own)] / size
        gain = cross @ np.linalg.pinv(was / np.outer(size, size), rcond=_LEAST, hermitian=True) / size
        means, every = self.mean.copy(), self.covariance.copy()
        means[own] = mean
        means[others] += gain @ (mean - self.mean[own])
        every[np.ix_(own, own)] = covariance
        every[np.ix_(others, own)] = gain @ covariance
        every[np.ix_(own, others)] = covariance @ gain.T
        every[np.ix_(others, others)] += gain @ (covariance - was) @ gain.T
        return means, 0.5 * (every + every.T)

    def with_unknowns(self, deviations: dict[str, float]) -> Posterior:
        """Return the same with further unknowns of the bench, independent of the others, by their deviations, SI."""
        more = {name: size for name, size in deviations.items() if name not in self.bench}
        at = len(self.errors) + len(self.bench)
        places = np.r_[:at, at + len(more) : len(self.mean) + len(more)]
        covariance = np.zeros((len(self.mean) + len(more),) * 2)
        covariance[np.ix_(places, places)] = self.covariance
        covariance[range(at, at + len(more)), range(at, at + len(more))] = np.square([*more.values()])
        mean = np.insert(self.mean, at, np.zeros(len(more)))
        return dataclasses.replace(self, bench=(*self.bench, *more), mean=mean, covariance=covariance)
