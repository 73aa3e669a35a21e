"""Posterior of wear coefficient and bearing wear from dated figures, and predictions: quadrature, no sampling.

The unknowns are the logarithms of two factors: wear coefficient over its stated median, and growth of a bearing's
clearance over its stated one. For given factors all other uncertainties are normal: noise of the figures, difference
between bench and model when new, variation of the loads (to first order of the wear), and the wear law itself. The arc
over which wear affects a contact is a choice that changes the worn area by 8 or 9 % (docs/wear.md), so the growth has a
relative error, with a correlation that depends on the ratio of two ages. The distribution of a figure at any age is
then a mixture of normal distributions over a grid of the two factors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp, ndtr, ndtri

from fitting.ageing.life import LifeFigures

Array = NDArray[np.float64]
_WIDE = 4.5  # standard deviations that the grid reaches in each direction
_NODES = (161, 41)  # of the grid, over one factor or along each axis of two
_SMALLEST = 16.0  # nodes with a density below exp(-this) of the largest are ignored
_MOVES = 12  # most grids
_SETTLED = 0.8  # the grid is final if its deviations shrink by less than this factor
_DIFFERENCE = 1e-4  # of the dose, for derivatives of the figures
_LAW = 0.05  # relative standard deviation of the growth: 8.5 % either way, a rectangular distribution (GUM)
_LAW_LENGTH = 1.0  # correlation length in the logarithm of age
_ROUNDING = (1e-18, 1e-12)  # rad², and share of a variance: keep covariances invertible


@dataclass(frozen=True)
class Measured:
    """One figure of one recording.

    Attributes
    ----------
    crank_turns
        Of the drive since new.
    figure
        Name, one of `life.FIGURES`.
    value, standard_error
        rad.
    source
        File.
    """

    crank_turns: float
    figure: str
    value: float
    standard_error: float
    source: str = ""


@dataclass(frozen=True)
class Prior:
    """Prior of the factors.

    Attributes
    ----------
    coefficient
        Median of the wear coefficient k_0, m²/N; 1 with a regression.
    coefficient_factor
        95 % interval of k_0: from the median divided by this to the median times this; log-normal.
    growth, growth_factor
        The same for the growth of the bearing's clearance, m for each crank turn; 0: no bearing wears.
    offset
        {figure: standard deviation of the difference between bench and model, the same at every age}, rad.
    scatter, period
        Variation of the loads: relative standard deviation of the wear in `period` crank turns.
    """

    coefficient: float
    coefficient_factor: float = 10.0
    growth: float = 0.0
    growth_factor: float = 10.0
    offset: Mapping[str, float] = field(default_factory=dict)
    scatter: float = 0.0
    period: float = 1.0

    @property
    def deviations(self) -> Array:
        """Standard deviation of the logarithm of each unknown factor, shape (factors,)."""
        factors = [self.coefficient_factor] + [self.growth_factor] * (self.growth > 0.0)
        return np.log(factors) / float(ndtri(0.975))


@dataclass(frozen=True)
class Posterior:
    """Distribution of the factors, given some figures.

    Attributes
    ----------
    life, prior, measured
        As given.
    logs
        Nodes, shape (nodes, factors): logarithm of k_0 over its median, and of the clearance's growth over its median.
    weight
        Of the nodes, shape (nodes,), of sum 1.
    """

    life: LifeFigures
    prior: Prior
    measured: tuple[Measured, ...]
    logs: Array
    weight: Array

    def factor(self, probability: ArrayLike, number: int = 0) -> Array:
        """Return quantiles of a factor, of k_0 (0) or of the clearance's growth (1) over their stated medians."""
        # Nodes in a row of the grid are one node of this factor.
        values, index = np.unique(self.logs[:, number].round(9), return_inverse=True)
        weight = np.bincount(index, self.weight)
        below = np.cumsum(weight) - 0.5 * weight
        return np.asarray(np.exp(np.interp(np.asarray(probability, dtype=float), below, values)))

    def predicted(self, figure: str, crank_turns: ArrayLike) -> Mixture:
        """Return the distribution of a figure at some ages, as measured on the bench, without noise."""
        turns = np.array(crank_turns, dtype=float, ndmin=1)
        ahead = _expected(self.life, self.prior, self.logs, [figure] * turns.size, turns)
        residual, past, covariance = _residuals(self.life, self.prior, self.logs, self.measured)
        cross = _covariance(self.prior, past, ahead)
        solved = np.linalg.solve(covariance, np.concatenate([residual[:, :, None], cross], axis=2))
        mean = ahead.mean + np.einsum("gnm,gn->gm", cross, solved[:, :, 0])
        variance = _variance(self.prior, ahead) - np.einsum("gnm,gnm->gm", cross, solved[:, :, 1:])
        return Mixture(self.weight, mean, np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True)
class Mixture:
    """Normal distributions with weights: `weight` of shape (nodes,), `mean` and `deviation` (nodes, ages), rad."""

    weight: Array
    mean: Array
    deviation: Array

    def below(self, value: ArrayLike) -> Array:
        """Probability that the figure is below values of shape (ages,), or one."""
        width = np.maximum(self.deviation, 1e-15)
        return np.asarray(self.weight @ ndtr((np.asarray(value, dtype=float) - self.mean) / width))

    def with_noise(self, standard_error: float) -> Mixture:
        """Return the distribution of measured values with a standard error, rad."""
        return Mixture(self.weight, self.mean, np.hypot(self.deviation, standard_error))

    def quantile(self, probability: float) -> Array:
        """Values below which the figure lies with a probability, shape (ages,), by bisection."""
        reach = 9.0 * self.deviation + 1e-12
        low, high = (self.mean - reach).min(axis=0), (self.mean + reach).max(axis=0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            less = self.below(middle) < probability
            low, high = np.where(less, middle, low), np.where(less, high, middle)
        return np.asarray(0.5 * (low + high))


def posterior(life: LifeFigures, prior: Prior, measured: Sequence[Measured]) -> Posterior:
    """Return the distribution of the factors given the figures, on a grid moved and scaled to its own moments."""
    spread = prior.deviations
    middle, axes, along = np.zeros(spread.size), np.diag(spread), np.linspace(-_WIDE, _WIDE, _NODES[spread.size - 1])
    grid = np.stack(np.meshgrid(*[along] * spread.size, indexing="ij"), axis=-1).reshape(-1, spread.size)
    for _ in range(_MOVES):
        logs = middle + grid @ axes.T
        density = -0.5 * ((logs / spread) ** 2).sum(axis=1) + _likelihood(life, prior, logs, measured)
        likely = density > density.max() - _SMALLEST
        logs, weight = logs[likely], np.exp(density[likely] - logsumexp(density[likely]))
        middle = weight @ logs
        # A maximum narrower than a cell of the grid has at least its size.
        cells = np.vstack([np.sqrt(weight)[:, None] * (logs - middle), (along[1] - along[0]) * axes.T])
        narrowed = np.linalg.cholesky(cells.T @ cells)
        if np.linalg.det(narrowed) > _SETTLED * np.linalg.det(axes):
            break
        axes = narrowed
    return Posterior(life, prior, tuple(measured), logs, weight)


def scores(life: LifeFigures, prior: Prior, measured: Sequence[Measured]) -> Array:
    """Return the quantile of each figure in its prediction from the earlier ones, as a standard normal score.

    Shape (figures,). If the model is valid the scores are independent standard normal numbers (Rosenblatt 1952). A
    contradicting recording or accelerating wear changes one score or the mean of several.
    """
    below = np.zeros(len(measured))
    for number, figure in enumerate(measured):
        earlier = posterior(life, prior, measured[:number]).predicted(figure.figure, figure.crank_turns)
        below[number] = earlier.with_noise(figure.standard_error).below(figure.value)[0]
    return np.asarray(ndtri(np.clip(below, 1e-300, 1.0 - 1e-16)))


class _Expected(NamedTuple):
    """Names of figures, their crank turns (figures,), and (nodes, figures) means, growth since new, slope per turn."""

    names: Sequence[str]
    turns: Array
    mean: Array
    growth: Array
    slope: Array


def _expected(life: LifeFigures, prior: Prior, logs: Array, names: Sequence[str], turns: Array) -> _Expected:
    """Return the model's figures at every node."""
    dose = prior.coefficient * np.exp(logs[:, :1]) * turns
    grown = prior.growth * np.exp(logs[:, -1:]) * turns
    mean, growth, slope = (np.zeros_like(dose) for _ in range(3))
    for name in dict.fromkeys(names):
        at = [k for k, other in enumerate(names) if other == name]
        mean[:, at] = life.at(name, dose[:, at], grown[:, at])
        growth[:, at] = mean[:, at] - life.at(name, 0.0)
        # Flanks and bearing wear simultaneously.
        more = life.at(name, dose[:, at] * (1.0 + _DIFFERENCE), grown[:, at] * (1.0 + _DIFFERENCE))
        slope[:, at] = (more - mean[:, at]) / (_DIFFERENCE * np.maximum(turns[at], 1e-300))
    return _Expected(names, turns, mean, growth, slope)


def _covariance(prior: Prior, first: _Expected, second: _Expected) -> Array:
    """Covariance of figures at ages from bench, loads and wear law, shape (nodes, first, second)."""
    offset = np.array([[prior.offset.get(a, 0.0) ** 2 * (a == b) for b in second.names] for a in first.names])
    logs = (np.log(np.maximum(ages.turns, 1.0)) for ages in (first, second))
    alike = _LAW**2 * np.exp(-0.5 * (np.subtract.outer(*logs) / _LAW_LENGTH) ** 2)
    # Loads of different periods are independent: the effective crank turns are a random walk.
    loads = prior.scatter**2 * prior.period * np.minimum.outer(first.turns, second.turns)
    both = first.slope[:, :, None] * loads * second.slope[:, None, :]
    both += first.growth[:, :, None] * alike * second.growth[:, None, :]
    return np.asarray(both + offset.reshape(alike.shape))


def _variance(prior: Prior, figures: _Expected) -> Array:
    """Diagonal of `_covariance`, shape (nodes, figures)."""
    offset = np.array([prior.offset.get(name, 0.0) for name in figures.names])
    loads = prior.scatter**2 * prior.period * figures.turns
    return np.asarray(offset**2 + loads * figures.slope**2 + (_LAW * figures.growth) ** 2)


def _residuals(
    life: LifeFigures, prior: Prior, logs: Array, measured: Sequence[Measured]
) -> tuple[Array, _Expected, Array]:
    """Measured minus expected (nodes, n), the expected figures, and the covariance (nodes, n, n) at every node."""
    turns, value, error = (
        np.array([getattr(m, name) for m in measured], dtype=float)
        for name in ("crank_turns", "value", "standard_error")
    )
    expected = _expected(life, prior, logs, [m.figure for m in measured], turns)
    covariance = _covariance(prior, expected, expected) + np.diag(error**2 + _ROUNDING[0])
    covariance *= 1.0 + _ROUNDING[1] * np.eye(turns.size)
    return value - expected.mean, expected, covariance


def _likelihood(life: LifeFigures, prior: Prior, logs: Array, measured: Sequence[Measured]) -> Array:
    """Logarithm of the density of the measured figures at every node, shape (nodes,)."""
    residual, _, covariance = _residuals(life, prior, logs, measured)
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, residual[:, :, None])[:, :, 0]
    size = np.log(2.0 * math.pi * np.diagonal(factor, axis1=1, axis2=2) ** 2)
    return np.asarray(-0.5 * (white**2 + size).sum(axis=1))
