"""Device clocks from the lower convex hull, against known clocks and against least squares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from drivers.recorder.clock import ClockEstimate, lower_hull
from drivers.recording_format import RESET, Alignment, Clock, ClockJumps, Samples

START = 1.7e9  # s since 1970: differences must not lose digits


def estimated(device, host, blocks=10):
    clock = ClockEstimate()
    for part in np.array_split(np.arange(len(device)), blocks):
        clock.add(device[part], host[part])
    return clock.fit()


def trial(seed, delay, drift=37e-6, seconds=10.0, rate=100):
    """Return the largest errors of hull and least squares in the trial, and the uncertainty from the hull, all in s."""
    random = np.random.default_rng(seed)
    device = np.arange(int(seconds * rate)) / rate
    true = START + 0.5 + device * (1 + drift)
    host = true + delay(random, len(device))
    fit = estimated(device, host)
    line = np.polyfit(device, host - START, 1)
    squares = np.polyval(line, device) + START - true
    return np.max(np.abs(fit.host(device) - true)), fit.uncertainty, np.max(np.abs(squares))


def test_after_10_s_at_100_hz_the_hull_is_right_to_7_us_and_least_squares_off_by_a_millisecond():
    trials = [trial(seed, lambda r, n: r.exponential(1e-3, n)) for seed in range(40)]
    error, uncertainty, squares = np.median(trials, axis=0)
    assert error < 7e-6
    assert squares > 0.9e-3
    assert uncertainty < 60e-6


@pytest.mark.parametrize(
    "delay",
    [
        lambda r, n: r.exponential(1e-3, n),
        lambda r, n: 1e-4 * r.pareto(1.5, n),
        lambda r, n: r.gamma(2, 5e-4, n),
        lambda r, n: r.exponential(2e-4, n) + (r.random(n) < 0.1) * r.exponential(20e-3, n),
    ],
)
def test_the_uncertainty_covers_the_true_clock(delay):
    trials = np.array([trial(seed, delay) for seed in range(60)])
    assert np.mean(trials[:, 0] <= trials[:, 1]) >= 0.9


def test_the_estimate_is_exact_without_delays():
    device = np.arange(1000) / 100
    fit = estimated(device, 2.0 + device * (1 - 80e-6))
    assert fit is None or fit.drift == pytest.approx(-80e-6, abs=1e-12)


def test_blocks_make_no_difference_and_memory_does_not_grow():
    random = np.random.default_rng(3)
    device = np.arange(20_000) / 1000
    host = START + device * (1 + 1e-5) + random.exponential(1e-3, len(device))
    once, often = estimated(device, host, 1), estimated(device, host, 2000)
    assert often.drift == once.drift
    assert often.origin_host == pytest.approx(once.origin_host, abs=1e-6)
    assert often.uncertainty == pytest.approx(once.uncertainty, rel=1e-9)
    clock = ClockEstimate()
    sizes = []
    for part in np.array_split(np.arange(len(device)), 500):
        clock.add(device[part], host[part])
        sizes.append(len(clock._points[0]))
    assert max(sizes) < 100


@given(st.lists(st.tuples(st.integers(-1000, 1000), st.integers(-1000, 1000)), min_size=3, max_size=150, unique=True))
def test_the_lower_hull_is_that_of_qhull(points):
    x, y = np.array(points, float).T
    if np.ptp(x) == 0 or np.linalg.matrix_rank(np.column_stack([x - x[0], y - y[0]])) < 2:
        return
    found = lower_hull(x, y)
    assert np.all(np.diff(x[found]) > 0)
    height = np.interp(x, x[found], y[found])
    assert np.all(y >= height - 1e-9), "no point lies below it"
    corners = set(ConvexHull(np.column_stack([x, y])).vertices.tolist())
    assert set(found.tolist()) <= corners


@given(
    at=st.lists(st.integers(1, 99), max_size=3, unique=True),
    again=st.floats(-5.0, 0.4),
    cut=st.integers(0, 100),
    stall=st.integers(0, 99),
    held=st.floats(0.0, 30.0),
)
def test_a_restarted_clock_is_distinguished_from_delayed_arrivals(at, again, cut, stall, held):
    """A device restarts at any sample, with or without a mark; a stalled line delivers many samples at once."""
    taken = 50.0 + np.arange(100) * 0.02
    device = taken.copy()
    for begin in at:
        device[begin:] = taken[begin:] - taken[begin] + again
    host = np.maximum(taken, np.where(np.arange(100) >= stall, min(taken[stall] + held, taken[-1] + held), 0.0))
    both = np.flatnonzero(ClockJumps()(device, host)).tolist()
    # Two restarts within a second of device time cannot be separated, nor one hidden by a stall.
    assert set(both) <= set(at)
    if len(at) <= 1:
        assert both == at
    status = np.zeros(100, np.uint8)
    status[at] = RESET
    assert np.flatnonzero(ClockJumps()(device, host, status != 0)).tolist() == sorted(at)
    # The result is the same block by block, and each section is converted by its own line.
    starts = [0, *sorted(at)]
    clocks = {i: Clock(device[begin], taken[begin], 0.0, 0.0) for i, begin in enumerate(starts)}
    alignment = Alignment(clocks)
    parts = [
        Samples.checked("x", host[p], taken[p], time_device=device[p], status=status[p])
        for p in (slice(0, cut), slice(cut, None))
    ]
    np.testing.assert_allclose(np.concatenate([alignment.time(p) for p in parts]), taken, atol=1e-9)


def test_a_section_with_an_unknown_clock_keeps_the_host_time():
    samples = Samples.checked("x", [1.0, 2.0, 3.0], [0.0, 0.0, 0.0], time_device=[7.0, 8.0, 0.5])
    found = Alignment({1: Clock(0.5, 2.9, 0.1, 0.0)}).time(samples)
    assert found.tolist() == [1.0, 2.0, 2.9]
