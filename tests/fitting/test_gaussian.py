"""Normal distributions of unknowns: identities of linear algebra and of probability, against dense computations."""

import numpy as np
import pytest
from scipy import linalg, optimize, stats

from fitting.model.gaussian import Evidence, Gaussian, factor_of, truncated

NAMES = ["a", "b", "c", "d", "e"]


@pytest.fixture
def joint():
    """Five unknowns whose uncertainties differ by seven orders of magnitude: mean, covariance, distribution."""
    generator = np.random.default_rng(4)
    size = np.array([1e-6, 1e-3, 1.0, 10.0, 1e-4])
    root = generator.normal(size=(5, 8)) * size[:, None]
    mean, covariance = generator.normal(size=5) * size, root @ root.T
    return mean, covariance, Gaussian.of(mean, covariance, NAMES)


def relative(found, expected):
    size = np.sqrt(np.diag(expected))
    return np.abs((found - expected) / np.outer(size, size)).max()


def test_a_start_that_leads_nowhere_is_singular():
    """As of a model that has left its range: the search goes on from another start."""
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        _ = Gaussian(np.array([[1.0, np.nan], [np.nan, 1.0]])).covariance


def test_information_is_the_inverse_of_the_covariance(joint):
    mean, covariance, distribution = joint
    assert relative(distribution.covariance, covariance) < 1e-10
    unit = distribution.covariance @ distribution.information
    size = np.sqrt(np.diag(covariance))
    assert unit * size / size[:, None] == pytest.approx(np.eye(5), abs=1e-10)
    assert distribution.mean == pytest.approx(mean, rel=1e-9)
    assert distribution.log_determinant == pytest.approx(-np.linalg.slogdet(covariance)[1], rel=1e-12)
    right = np.random.default_rng(1).normal(size=(5, 3))
    assert distribution.solve(right) == pytest.approx(covariance @ right, rel=1e-9)


def test_a_marginal_is_the_part_of_mean_and_covariance(joint):
    mean, covariance, distribution = joint
    part = distribution.marginal(["d", "a"])
    own = [3, 0]
    assert part.names == ("d", "a")
    assert part.mean == pytest.approx(mean[own], rel=1e-8)
    assert relative(part.covariance, covariance[np.ix_(own, own)]) < 1e-9
    # Schur's complement of the information, by the dense inverse.
    others, information = [1, 2, 4], distribution.information
    schur = (
        information[np.ix_(own, own)]
        - information[np.ix_(own, others)]
        @ linalg.inv(information[np.ix_(others, others)])
        @ information[np.ix_(others, own)]
    )
    assert relative(part.information, schur) < 1e-9
    again = distribution.marginal(["d", "a", "c"]).marginal(["a"])
    assert again.covariance[0, 0] == pytest.approx(covariance[0, 0], rel=1e-9)


def test_conditions_are_those_of_many_draws_and_of_an_observation_without_noise(joint):
    mean, covariance, distribution = joint
    rows = np.array([[0.0, 2e3, 1.0, 0.0, 0.0], [1e6, 0.0, 0.0, 0.3, 0.0]])
    values = rows @ mean + np.array([1.0, -2.0])
    given, left = distribution.given(rows, values)
    assert rows @ given == pytest.approx(values)
    # Rows with a noise that is almost none.
    noise = 1e-4
    observed = Evidence.of(rows / noise, (values - rows @ mean) / noise)
    posterior = Gaussian(distribution.information + observed.gram, observed.moment)
    size = np.sqrt(np.diag(covariance))
    assert (mean + posterior.mean) / size == pytest.approx(given / size, abs=1e-6)
    assert relative(left, covariance) <= 1.0 + 1e-12
    assert np.abs(left - posterior.covariance).max() / np.abs(covariance).max() < 1e-6
    # The draws near the condition, by brute force.
    drawn = np.random.default_rng(2).multivariate_normal(mean / size, covariance / np.outer(size, size), 400_000)
    one, wanted = rows[:1] * size, values[:1]
    spread = np.sqrt((one @ (covariance / np.outer(size, size)) @ one.T).item())
    near = np.abs(drawn @ one[0] - wanted) < 0.03 * spread
    brute = drawn[near].mean(axis=0)
    assert np.count_nonzero(near) > 3000
    assert distribution.given(rows[:1], wanted)[0] / size == pytest.approx(brute, abs=0.06)


def test_values_within_bounds_are_those_of_bounded_least_squares():
    """Where one bound binds; a step that is cut off there instead is no step downhill for the others."""
    generator = np.random.default_rng(9)
    columns, residual = generator.normal(size=(30, 4)), generator.normal(size=30)
    columns[:, 1] += 5.0 * columns[:, 0]  # strongly coupled
    distribution = Evidence.of(columns, residual).posterior(np.full(4, 1e-12))
    low, high = np.full(4, -np.inf), np.full(4, np.inf)
    low[0] = distribution.mean[0] + 0.1
    expected = optimize.lsq_linear(columns, residual, (low, high), tol=1e-14).x
    found = distribution.bounded(low, high)
    assert found == pytest.approx(expected, abs=1e-6)
    cut = np.clip(distribution.mean, low, high)
    assert distribution.gain(found) > distribution.gain(cut)
    row = np.array([[1.0, 0.0, 0.0, 0.0]])
    assert distribution.bounded(low[:1], high[:1], row) == pytest.approx(found, abs=1e-9)
    free = np.full(4, np.inf)
    assert distribution.bounded(-free, free) == pytest.approx(distribution.mean)


def test_unknowns_move_as_those_that_are_free(joint):
    """x = T f: the covariance is that of the condition, here of a tie c = 3 b and of e, which is held."""
    _, covariance, distribution = joint
    along = np.diag([1.0, 1.0, 0.0, 1.0, 0.0])
    along[2, 1] = 3.0
    tied = Gaussian(distribution.information, distribution.slope, NAMES, along)
    rows = np.array([[0.0, 3.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
    mean, expected = distribution.given(rows, np.zeros(2))
    size = np.sqrt(np.diag(covariance))
    assert tied.mean / size == pytest.approx(mean / size, abs=1e-8)
    assert tied.covariance / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), abs=1e-8)
    assert tied.covariance[2, 2] == pytest.approx(9.0 * tied.covariance[1, 1])
    assert not tied.covariance[4].any()


def test_held_unknowns_are_those_given_as_zero(joint):
    _, covariance, distribution = joint
    held = np.array([False, True, False, False, True])
    rest = distribution.holding(held)
    expected, _ = distribution.given(np.eye(5)[held], np.zeros(2))
    size = np.sqrt(np.diag(covariance))
    assert rest.mean / size == pytest.approx(expected / size, abs=1e-9)
    assert not rest.mean[held].any()
    # Rounding has put a held unknown beyond its bound: it stays, whatever bounds the others have.
    low, high = np.where(held, 1e-17, -np.inf), np.full(5, np.inf)
    assert rest.bounded(low, high) / size == pytest.approx(expected / size, abs=1e-9)
    low[0] = rest.mean[0] + size[0]
    expected, _ = distribution.given(np.eye(5)[held | (np.arange(5) == 0)], np.array([low[0], 0.0, 0.0]))
    assert rest.bounded(low, high) / size == pytest.approx(expected / size, abs=1e-9)
    assert distribution.holding(np.zeros(5, bool)) is distribution


def test_the_score_is_chi_square_and_that_of_a_marginal(joint):
    mean, covariance, distribution = joint
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(5), np.eye(5), 2000) @ factor_of(covariance).T + mean
    scores = [distribution.score(["e", "b"], one[[4, 1]]) for one in drawn]
    assert stats.kstest(scores, stats.chi2(2).cdf).pvalue > 0.01
    away = drawn[0] - mean
    assert distribution.score(range(5), drawn[0]) == pytest.approx(away @ distribution.information @ away, rel=1e-6)


def test_normal_equations_are_least_squares_with_a_row_for_each_prior():
    generator = np.random.default_rng(5)
    columns, residual = generator.normal(size=(40, 4)), generator.normal(size=40)
    precision, away = np.array([1.0, 4.0, 1e-6, 100.0]), generator.normal(size=4)
    posterior = Evidence.of(columns, residual).posterior(precision, away)
    rows = np.vstack([columns, np.diag(np.sqrt(precision))])
    right = np.concatenate([residual, -np.sqrt(precision) * away])
    step, square, *_ = np.linalg.lstsq(rows, right, rcond=None)
    assert posterior.mean == pytest.approx(step, rel=1e-10)
    assert posterior.covariance == pytest.approx(linalg.inv(rows.T @ rows), rel=1e-10)
    assert right @ right - posterior.gain(step) == pytest.approx(float(square[0]), rel=1e-10)
    assert np.abs(posterior.damped(1e9).mean).max() < 1e-7


def test_directions_without_variance_are_left_out():
    generator = np.random.default_rng(6)
    root = generator.normal(size=(6, 3))
    spread, weights = root @ root.T, generator.normal(size=3)
    square, count, coefficients = truncated(root @ weights, spread, np.sqrt(np.diag(spread)), 1e-9)
    assert count == 3
    assert square == pytest.approx(weights @ weights)
    assert spread @ coefficients == pytest.approx(root @ weights)
    factor = factor_of(spread)
    assert factor @ factor.T == pytest.approx(spread)
    constant = factor_of(np.diag([4.0, 0.0]))
    assert not constant[1].any()


def test_singular_equations_are_said_to_be():
    columns = np.random.default_rng(7).normal(size=(9, 2)) @ np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    assert Evidence.of(columns).posterior(np.zeros(3)).condition > 1e14
    regular = Evidence.of(columns).posterior(np.full(3, 1.0))
    size = np.sqrt(np.diag(regular.information))
    expected = np.linalg.cond(regular.information / np.outer(size, size), 1)
    assert regular.condition == pytest.approx(expected, rel=0.5)
