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

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp, ndtr, ndtri

from fitting.ageing.life import LifeFigures

Array = NDArray[np.float64]
_WIDE = 4.5  # standard deviations of the prior on each side of the first grid
_NODES = (161, 41)  # of the grid, over one factor or each of two
_LEFT_OUT = 16.0  # nodes with a density below exp(-this) of the largest are ignored
_ZOOMS = 12
_SETTLED = 0.25  # the grid is final if the nodes that count span this fraction of each axis
_SHAPED = 20  # nodes that count, from which the axes of the density are computed
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
        values, place = np.unique(self.logs[:, number].round(9), return_inverse=True)
        weight = np.bincount(place, self.weight)
        below = np.cumsum(weight) - 0.5 * weight
        return np.asarray(np.exp(np.interp(np.asarray(probability, dtype=float), below, values)))

    def predicted(self, figure: str, crank_turns: ArrayLike) -> Mixture:
        """Return the distribution of a figure at some ages, as measured on the bench, without noise."""
        turns = np.array(crank_turns, dtype=float, ndmin=1)
        there = _model(self.life, self.prior, self.logs, [figure] * turns.size, turns)
        mean, offset = there.mean, self.prior.offset.get(figure, 0.0) ** 2
        own = np.diagonal(_shared(self.prior, there, there), axis1=1, axis2=2)
        variance = offset + own
        if self.measured:
            left, seen, covariance = _residuals(self.life, self.prior, self.logs, self.measured)
            same = np.array([m.figure == figure for m in self.measured])
            shared = _shared(self.prior, seen, there) + offset * same[:, None]
            solved = np.linalg.solve(covariance, np.concatenate([left[:, :, None], shared], axis=2))
            mean = mean + np.einsum("gnm,gn->gm", shared, solved[:, :, 0])
            variance = variance - np.einsum("gnm,gnm->gm", shared, solved[:, :, 1:])
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
    """Return the distribution of the factors given the figures, on a grid that is moved and rotated to its maximum."""
    spread = prior.deviations
    axes, middle, half = np.eye(spread.size), np.zeros(spread.size), _WIDE * spread
    nodes = _NODES[spread.size - 1]
    logs, density = np.zeros((1, spread.size)), np.zeros(1)
    for _ in range(_ZOOMS):
        grid = np.stack(np.meshgrid(*(np.linspace(-h, h, nodes) for h in half), indexing="ij"), axis=-1)
        places = grid.reshape(-1, spread.size)
        logs = middle + places @ axes.T
        density = -0.5 * ((logs / spread) ** 2).sum(axis=1) + _likelihood(life, prior, logs, measured)
        counts = density > density.max() - _LEFT_OUT
        low, high = places[counts].min(axis=0), places[counts].max(axis=0)
        if ((high - low) >= _SETTLED * 2.0 * half).all():
            break
        cell = axes * (2.0 * half / (nodes - 1))  # its edges, in the columns
        if spread.size > 1 and counts.sum() > _SHAPED:
            # The grid's axes are rotated to the ridge along which the two factors compensate each other.
            weight = np.exp(density[counts] - density.max())
            about = (logs[counts] - weight @ logs[counts] / weight.sum()) / spread
            axes = spread[:, None] * np.linalg.eigh(np.einsum("k,ki,kj->ij", weight, about, about))[1]
        there, edge = np.linalg.solve(axes, logs[counts].T), np.abs(np.linalg.solve(axes, cell)).max(axis=1)
        low, high = there.min(axis=1) - edge, there.max(axis=1) + edge
        middle, half = axes @ (0.5 * (low + high)), 0.5 * (high - low)
    kept = density > density.max() - _LEFT_OUT
    weight = np.exp(density[kept] - logsumexp(density[kept]))
    return Posterior(life, prior, tuple(measured), logs[kept], weight)


def scores(life: LifeFigures, prior: Prior, measured: Sequence[Measured]) -> Array:
    """Return the quantile of each figure in its prediction from the earlier ones, as a standard normal score.

    Shape (figures,). If the model is valid the scores are independent standard normal numbers (Rosenblatt 1952). A
    contradicting recording or accelerating wear changes one score or the mean of several.
    """
    found = np.zeros(len(measured))
    for number, one in enumerate(measured):
        before = posterior(life, prior, measured[:number])
        mixture = before.predicted(one.figure, one.crank_turns).with_noise(one.standard_error)
        below = float(mixture.below(one.value)[0])
        found[number] = ndtri(np.clip(below, 1e-300, 1.0 - 1e-16))
    return found


@dataclass(frozen=True)
class _Foretold:
    """Figures at ages (`turns`, shape (figures,)), their growth since new and their derivative by the crank turns."""

    turns: Array
    mean: Array
    growth: Array
    slope: Array


def _model(life: LifeFigures, prior: Prior, logs: Array, figures: Sequence[str], turns: Array) -> _Foretold:
    """Evaluate the model at every node: arrays of shape (nodes, figures)."""
    dose = prior.coefficient * np.exp(logs[:, :1]) * turns
    grown = prior.growth * np.exp(logs[:, 1:2]) * turns if logs.shape[1] > 1 else np.zeros_like(dose)
    mean, growth, slope = (np.zeros_like(dose) for _ in range(3))
    for name in dict.fromkeys(figures):
        at = [k for k, one in enumerate(figures) if one == name]
        mean[:, at] = life.at(name, dose[:, at], grown[:, at])
        growth[:, at] = mean[:, at] - life.at(name, 0.0)
        more = 1.0 + _DIFFERENCE
        # Flanks and bearing wear simultaneously.
        change = life.at(name, dose[:, at] * more, grown[:, at] * more) - mean[:, at]
        slope[:, at] = change / (_DIFFERENCE * np.maximum(turns[at], 1e-300))
    return _Foretold(turns, mean, growth, slope)


def _shared(prior: Prior, first: _Foretold, second: _Foretold) -> Array:
    """Covariance of figures at ages from loads and wear law, shape (nodes, first, second)."""
    logs = [np.log(np.maximum(one.turns, 1.0)) for one in (first, second)]
    alike = _LAW**2 * np.exp(-0.5 * ((logs[0][:, None] - logs[1]) / _LAW_LENGTH) ** 2)
    # Loads of different periods are independent: the effective crank turns are a random walk.
    loads = prior.scatter**2 * prior.period * np.minimum(first.turns[:, None], second.turns)
    each = first.slope[:, :, None] * loads * second.slope[:, None, :]
    return np.asarray(each + first.growth[:, :, None] * alike * second.growth[:, None, :])


def _residuals(
    life: LifeFigures, prior: Prior, logs: Array, measured: Sequence[Measured]
) -> tuple[Array, _Foretold, Array]:
    """Measured minus predicted (nodes, n), the prediction, and the covariance (nodes, n, n) at every node."""
    figures, turns = [m.figure for m in measured], np.array([m.crank_turns for m in measured])
    there = _model(life, prior, logs, figures, turns)
    offset = np.array([prior.offset.get(name, 0.0) ** 2 for name in figures])
    same = np.array([[a == b for b in figures] for a in figures])
    noise = np.array([m.standard_error**2 for m in measured])
    covariance = np.diag(noise + _ROUNDING[0]) + same * offset + _shared(prior, there, there)
    covariance[:, range(len(turns)), range(len(turns))] *= 1.0 + _ROUNDING[1]
    return np.array([m.value for m in measured]) - there.mean, there, covariance


def _likelihood(life: LifeFigures, prior: Prior, logs: Array, measured: Sequence[Measured]) -> Array:
    if not measured:
        return np.zeros(len(logs))
    left, _, covariance = _residuals(life, prior, logs, measured)
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, left[:, :, None])[:, :, 0]
    logs_of = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(-0.5 * (white**2).sum(axis=1) - logs_of - 0.5 * math.log(2.0 * math.pi) * len(measured))
