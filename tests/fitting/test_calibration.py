"""Whether the truth ranks uniformly among draws from an identification."""

import numpy as np
import pytest
from common import study_size
from simulation_based_calibration import DRAWS, away, band, by_name, ranks, uniformity


def ranks_of(share, count=400, off=0.0):
    """Ranks of standard normal truths among draws with a wrong scatter, or with an offset."""
    generator = np.random.default_rng(5)
    truth = generator.standard_normal(count)
    return (share * generator.standard_normal((DRAWS, count)) + off < truth).sum(axis=0)


def test_ranks_of_a_right_posterior_keep_to_the_band():
    chance, inside = uniformity(ranks_of(1.0))
    assert inside
    assert chance > 0.01


@pytest.mark.parametrize(("share", "off"), [(0.6, 0.0), (1.6, 0.0), (1.0, 0.4)])
def test_ranks_of_a_wrong_posterior_leave_it(share, off):
    """Too narrow, too wide, and beside the truth."""
    chance, inside = uniformity(ranks_of(share, off=off))
    assert not inside
    assert chance < 1e-3


def test_the_band_holds_95_of_100_studies():
    generator = np.random.default_rng(6)
    _, low, high = band(150)
    found = np.array([away(generator.integers(0, DRAWS + 1, 150)) for _ in range(1000)])
    inside = np.mean(((low <= found) & (found <= high)).all(axis=1))
    assert inside == pytest.approx(0.95, abs=0.03)


@pytest.mark.slow(60)
def test_the_truth_ranks_uniformly(record_property):
    """A tenth of CYCLOID_SEEDS drives, at least ten; docs/identify_coverage.md has all of them."""
    every = [ranks(seed) for seed in range(max(10, study_size("CYCLOID_SEEDS", 5, 200) // 10))]
    stated = [one for one in every if one["ranks"]]
    assert len(stated) >= 0.9 * len(every)
    found = by_name(stated)
    for name, one in found.items():
        _, low, high = band(len(one), 1.0 - 0.01 / len(found))
        assert np.all((low <= away(one)) & (away(one) <= high)), name
    pooled = np.concatenate([*found.values()])
    inside = np.mean(np.abs(pooled - 0.5 * DRAWS) < 0.475 * (DRAWS + 1))
    record_property("95 % intervals that hold the truth", f"{inside:.1%} of {pooled.size}")
    assert inside > 0.92
