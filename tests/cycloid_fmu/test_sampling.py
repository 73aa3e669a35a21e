"""Surfaces sampled from tolerances: limits, distributions, seeds."""

import numpy as np
import pytest
from common import EXAMPLES, make_pair
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.surfaces.files import read_surface, write_surface
from cycloid_fmu.surfaces.sampling import (
    PitchErrors,
    ProfileErrors,
    error_stream,
    parse_tolerances,
    read_tolerances,
    sample_pitch,
    sample_profile,
    sample_surface,
    within_tolerance,
)
from cycloid_fmu.surfaces.surface import DEVIATIONS, Elements

PAIR = make_pair(discs=2)
SMALL = Elements(profile=12, width=3, angle=8)
DISTRIBUTIONS = ("normal", "uniform")


def tolerances(text):
    return parse_tolerances('format = "cycloid-tolerances/1"\n' + text, "t.toml")


def pitch_errors(single, cumulative, distribution="normal"):
    """Limits in m; the file takes quantities."""
    return PitchErrors(single=f"{single:.17g} m", cumulative=f"{cumulative:.17g} m", distribution=distribution)


EVERY = read_tolerances(EXAMPLES / "tolerances.toml")


@settings(max_examples=200)
@given(
    seed=st.integers(0, 2**63 - 1),
    teeth=st.integers(6, 121),
    single=st.floats(1e-7, 1e-4),
    factor=st.floats(1.0, 8.0),
    distribution=st.sampled_from(DISTRIBUTIONS),
)
def test_pitch_keeps_both_limits_round_the_whole_circle(seed, teeth, single, factor, distribution):
    limits = pitch_errors(single, single * factor, distribution)
    position = sample_pitch(np.random.default_rng(seed), teeth, limits)
    pitch = np.diff(position, append=position[0])  # the closing tooth is one of them
    assert np.abs(pitch).max() <= limits.single
    assert np.ptp(position) <= limits.cumulative
    assert abs(pitch.sum()) < 1e-12 * single
    assert abs(position.mean()) < 1e-12 * single
    # It moves. Of six teeth, drawn normally, all stay within a tenth in one ring of 5000.
    assert np.abs(pitch).max() > (0.1 if teeth >= 20 else 1e-3) * limits.single


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("factor", [1.3, *(pytest.param(one, marks=pytest.mark.slow(1)) for one in (1.0, 3.0))])
def test_pitch_has_the_conditioned_distribution(distribution, factor):
    """A second computation: draw single pitches that sum to zero, and reject those beyond a limit."""
    teeth, single = 6, 3e-6
    generator = np.random.default_rng(5)
    chance = generator.random((800000, teeth - 1))
    free = within_tolerance(chance, single, distribution)
    last = -free.sum(axis=1)
    density = np.exp(-0.5 * (3.0 * last / single) ** 2) if distribution == "normal" else np.ones(last.size)
    kept = (np.abs(last) <= single) & (generator.random(last.size) < density)
    wanted = np.cumsum(free[kept], axis=1)
    wanted = np.hstack([np.zeros((len(wanted), 1)), wanted])
    wanted = wanted[np.ptp(wanted, axis=1) <= factor * single]
    assert len(wanted) > 1500
    wanted = wanted[:6000] - wanted[:6000].mean(axis=1, keepdims=True)
    limits = pitch_errors(single, factor * single, distribution)
    drawn = np.array([sample_pitch(generator, teeth, limits) for _ in range(3000)])
    for figure in (
        lambda x: x[:, 0],
        lambda x: x[:, 4] - x[:, 3],
        lambda x: np.ptp(x, axis=1),
        lambda x: x @ np.cos(2 * np.pi * np.arange(teeth) / teeth),
    ):
        assert stats.ks_2samp(figure(drawn), figure(wanted)).pvalue > 1e-3


def test_a_wide_cumulative_limit_leaves_a_closed_random_walk():
    """Variance of the free bridge of n normal steps: position k from tooth 0 has k(n - k)/n of a step's."""
    teeth, sigma = 40, 1e-6
    limits = pitch_errors(3.0 * sigma, 100.0 * sigma)
    drawn = np.array([sample_pitch(np.random.default_rng(i), teeth, limits) for i in range(800)])
    step = sigma * stats.truncnorm(-3, 3).std()
    for k in (1, 5, 20):
        wanted = step * np.sqrt(k * (teeth - k) / teeth)
        assert (drawn[:, k] - drawn[:, 0]).std() == pytest.approx(wanted, rel=0.1)


@settings(max_examples=100)
@given(
    seed=st.integers(0, 2**63 - 1),
    tolerance=st.floats(1e-7, 1e-4),
    distribution=st.sampled_from(DISTRIBUTIONS),
    correlation=st.one_of(
        st.just("none"),
        st.fixed_dictionaries({"profile": st.floats(0.02, 10.0), "width": st.floats(0.02, 10.0)}),
    ),
)
def test_total_profile_deviation_stays_within_its_tolerance(seed, tolerance, distribution, correlation):
    errors = ProfileErrors(tolerance=f"{tolerance} m", distribution=distribution, correlation=correlation)
    teeth = sample_profile(np.random.default_rng(seed), 7, 50, 6, errors)
    assert teeth.shape == (7, 50, 6)
    assert np.ptp(teeth.reshape(7, -1), axis=1).max() <= errors.tolerance
    assert np.ptp(teeth) > 0.1 * errors.tolerance


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("correlation", ['"none"', "{ profile = 0.1, width = 0.3 }"])
def test_each_element_has_the_stated_distribution(distribution, correlation):
    errors = tolerances(
        f'[gear_profile]\ntolerance = "6 um"\ndistribution = "{distribution}"\ncorrelation = {correlation}\n'
    )
    teeth = sample_profile(np.random.default_rng(3), 3000, 9, 4, errors.gear_profile)
    wanted = stats.truncnorm(-3, 3, scale=1e-6) if distribution == "normal" else stats.uniform(-3e-6, 6e-6)
    for element in ((0, 0), (4, 1), (8, 3)):  # an end is no different from the middle
        assert stats.kstest(teeth[:, *element], wanted.cdf).pvalue > 1e-3


def test_form_is_correlated_as_stated_and_the_same_on_finer_elements():
    errors = ProfileErrors(tolerance="6 um", correlation={"profile": 0.2, "width": 0.4})
    coarse, fine = (sample_profile(np.random.default_rng(1), 4000, n, 3, errors) for n in (11, 33))
    assert coarse == pytest.approx(fine[:, 1::3, :], abs=1e-15)
    part = np.corrcoef(fine[:, :, 1].T)[:, 0]
    apart = np.arange(33) / 33
    assert part == pytest.approx(np.exp(-0.5 * (apart / 0.2) ** 2), abs=0.08)
    assert np.corrcoef(fine[:, 5, 0], fine[:, 5, 1])[0, 1] == pytest.approx(np.exp(-0.5 / (3 * 0.4) ** 2), abs=0.05)
    white = sample_profile(np.random.default_rng(1), 4000, 11, 3, ProfileErrors(tolerance="6 um", correlation="none"))
    assert np.abs(np.corrcoef(white[:, :, 1].T) - np.eye(11)).max() < 0.08


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("name", ["eccentricity", "misalignment_xz", "pin_circle_diameter", "pin_radius_each"])
def test_scalars_have_the_stated_distribution(name, distribution):
    unit = "mrad" if name == "misalignment_xz" else "um"
    asked = tolerances(f'[{name}]\ntolerance = "3 {unit}"\ndistribution = "{distribution}"\n')
    field, part = {
        "pin_circle_diameter": ("pin_circle_radius", 0.5),
        "pin_radius_each": ("pin_radius_deviation", 1.0),
    }.get(name, (name, 1.0))
    count = 25 if name == "pin_radius_each" else 800
    values = np.ravel([getattr(sample_surface(PAIR, asked, seed, SMALL), field) for seed in range(count)])
    limit = part * (3e-3 if unit == "mrad" else 3e-6)
    wanted = stats.truncnorm(-3, 3, scale=limit / 3) if distribution == "normal" else stats.uniform(-limit, 2 * limit)
    assert np.abs(values).max() <= limit
    assert stats.kstest(values, wanted.cdf).pvalue > 1e-3


NUMBERS = [kind.name for kind in KINDS.values() if kind.of == "drive"]


def arrays_of(surface):
    return {**surface.errors, **{name: getattr(surface, name) for name in DEVIATIONS}}


def test_the_same_seed_is_the_same_surface_and_comes_back_from_its_file(tmp_path):
    surface, again, other = (sample_surface(PAIR, EVERY, seed, SMALL) for seed in (7, 7, 8))
    write_surface(surface, tmp_path / "s.nc")
    read = read_surface(tmp_path / "s.nc")
    assert (read.origin, int(read.attributes["seed"])) == ("sampled", 7)
    assert read.attributes["tolerances"] == EVERY.text
    assert read == surface
    for name, value in arrays_of(surface).items():
        assert np.array_equal(value, arrays_of(again)[name]), name
        assert np.array_equal(value, arrays_of(read)[name]), name
        if np.any(value):
            assert not np.array_equal(value, arrays_of(other)[name]), name


def test_each_error_is_the_same_whatever_else_is_sampled():
    whole = sample_surface(PAIR, EVERY, 3, SMALL)
    for name in EVERY.factors:
        alone = sample_surface(PAIR, EVERY.replace(**dict.fromkeys(set(EVERY.factors) - {name})), 3, SMALL)
        drawn = [k for k, v in arrays_of(alone).items() if v is not None and np.any(v)]
        assert len(drawn) == 1
        assert np.array_equal(arrays_of(alone)[drawn[0]], arrays_of(whole)[drawn[0]])


def test_streams_of_different_errors_are_independent():
    drawn = np.array([[error_stream(seed, name).random() for name in NUMBERS] for seed in range(3000)])
    parts = np.corrcoef(drawn.T) - np.eye(len(NUMBERS))
    assert np.abs(parts).max() < 0.08


def test_discs_and_sizes_are_the_pair_s_and_the_caller_s():
    surface = sample_surface(PAIR, EVERY, 0, SMALL)
    assert surface.gear_deviation.shape == (2, 39, 12, 3)
    assert surface.pin_deviation.shape == (40, 8, 3)
    assert not np.array_equal(surface.tooth_cumulative_pitch[0], surface.tooth_cumulative_pitch[1])
    assert sample_surface(make_pair(), EVERY, 0).gear_deviation.shape == (1, 39, 200, 20)
    nothing = sample_surface(PAIR, tolerances(""), 0)
    assert nothing.gear_deviation is None
    assert nothing.pin_deviation is None
    assert not nothing.tooth_cumulative_pitch.any()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            '[gear_pitch]\nsingle = "3 um"\ncumulative = "2 um"',
            ("gear_pitch", "cumulative", "at the single tolerance already causes this"),
        ),
        ('[gear_profile]\ntolerance = "4 um"\ncorrelation = "some"', ("gear_profile", "correlation", '"none"')),
        ('[gear_profile]\ntolerance = "4 um"\ncorrelation = { profile = 0 }', ("correlation", "profile = 0")),
        ('[isometric]\ntolerance = "-1 um"', ("isometric", "between 0 and 1 mm")),
        ('[isometric]\ntolerance = "1e3 m"', ("isometric", "between 0 and 1 mm")),
        ('[isometric]\ntolerance = "nan um"', ("isometric", "a space and a unit")),
        ('[isometric]\ntolerance = "1 um"\ndistribution = "laplace"', ("distribution", "'normal' or 'uniform'")),
        ('[offset]\ndistribution = "normal"', ("offset", "tolerance is missing")),
        ('[pin_weight]\ntolerance = "1 um"', ("pin_weight", "not a known key")),
        ('[misalignment_xz]\ntolerance = "1 um"', ("misalignment_xz", "measures something else")),
    ],
)
def test_bad_tolerances_are_one_sentence(text, said):
    with pytest.raises(edge.InputError) as caught:
        tolerances(text)
    assert str(caught.value).startswith("t.toml: ")
    assert str(caught.value).count("\n") == 0
    for part in said:
        assert part in str(caught.value)


@pytest.mark.slow(2)
def test_sampled_from_the_command_line(command, tmp_path):
    words = ("cycloid-fmu", "surface", "sampled", EXAMPLES / "drive-39-40.toml", "--tolerances")
    sizes = ("--profile", 12, "--width", 3, "--angle", 8)
    run = command(*words, EXAMPLES / "tolerances.toml", "--seed", 7, "-o", "s.nc", "--plot", "s.png", *sizes)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "s.png").stat().st_size > 20000
    assert read_surface(tmp_path / "s.nc").gear_deviation.shape == (1, 39, 12, 3)
    (tmp_path / "t.toml").write_text(
        'format = "cycloid-tolerances/1"\n[pin_pitch]\nsingle = "3 um"\ncumulative = "2 um"\n'
    )
    run = command(*words, "t.toml", "--seed", 1, "-o", "bad.nc")
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith("t.toml: [pin_pitch] cumulative")
    assert run.stderr.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.nc", "s.png", "t.toml"]
