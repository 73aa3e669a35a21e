"""The search for a fit: one loop over proposals, and the likelihood by which fits with different errors are ranked."""

import dataclasses

import numpy as np
import pytest
from test_estimation import ERRORS, at_nominal, curve

from cycloid_fmu import edge
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.fit import fit
from fitting.estimation.search import Search
from fitting.model.observations import observations
from fitting.model.unknowns import Unknowns


class Valleys(Search):
    """The lowest place of sin(3x) + x²/9, from each start by halved steps; there is no fit beyond ± 8."""

    def fit(self, start):
        if abs(start) > 8.0:
            raise edge.InputError("too far")
        place, step = start, 0.1
        while step > 1e-9:
            best = min((place - step, place, place + step), key=height)
            place, step = best, step if best != place else 0.5 * step
        return place

    def is_better(self, end, best):
        return height(end) < height(best) - 1e-6


def height(place):
    return np.sin(3.0 * place) + place**2 / 9.0


def downhill(search):
    """One valley further, as long as this is lower."""
    before = None
    while before != search.best:
        before = search.best
        for step in (-2.0, 2.0):
            yield search.best + step


def test_a_search_goes_on_as_long_as_something_new_wins():
    search = Valleys()
    search.run([lambda search: iter_of(9.0, 7.0), downhill])
    everywhere = np.linspace(-8.0, 8.0, 400001)
    assert search.best == pytest.approx(everywhere[np.argmin(height(everywhere))], abs=1e-4)
    # A start without a fit is passed over; each other one has an end.
    assert len(search.starts) == len(search.ends) + 1
    assert str(search.problem) == "too far"


def iter_of(*starts):
    for start in starts:
        _ = yield start


def test_a_search_without_any_fit_says_why():
    search = Valleys()
    search.run([lambda search: iter_of(9.0)])
    with pytest.raises(edge.InputError, match="too far"):
        _ = search.best


def test_fits_with_different_errors_have_one_likelihood(nominal):
    """That of the measured values under all errors' priors, from their covariance: V = 1 + C P⁻¹ Cᵀ."""
    made = with_structured(
        surface_of_pair(nominal), dict(zip(ERRORS, np.array([4, -3, 1, 1, 2, -2]) * 1e-6, strict=True))
    )
    generator = np.random.default_rng(3)
    curves = [curve(nominal, made, torque, generator, each=6) for torque in (20.0, -20.0, 200.0, -200.0)]
    observed = observations(curves, nominal)
    sizes = {"pin_radial": 1e-7}
    for chosen in (ERRORS, ERRORS[:-1]):
        end = fit(nominal, observed, chosen, at_nominal(nominal, observed), sizes, gain=1e-3, estimated=False)
        end = dataclasses.replace(end, misfit=end.misfit_with_priors)
        unknowns = Unknowns(nominal, end.observed, end.observed.errors)
        columns, away = unknowns.columns(end.observed, end.linear), unknowns.vector(end.state)
        precision = unknowns.precision(end.scatter)
        precision[unknowns.errors] = 1.0
        spread = np.eye(len(columns)) + (columns / precision) @ columns.T
        unmoved = end.residual + columns @ away
        square = unmoved @ np.linalg.solve(spread, unmoved)
        seen = end.observed.weight[end.observed.weight > 0.0]
        exact = square + np.linalg.slogdet(spread)[1] - 2.0 * np.log(seen).sum()
        # At the place of the fit, not at the optimum of all errors.
        slope = columns.T @ end.residual - precision * away
        above = slope @ np.linalg.solve(columns.T @ columns + np.diag(precision), slope)
        assert end.unlikelihood_of_all == pytest.approx(exact + above, abs=1e-3)
