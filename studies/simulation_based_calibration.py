"""Simulation-based calibration of an identification: ranks of the truth among draws from the fit.

`python studies/simulation_based_calibration.py DRIVES [PICTURE]` prints how uniform the ranks are and draws them.
Drives and benches are drawn from what the fit takes to be usual before measuring, recorded by `second_drive` and
identified; then the rank of each true error among draws from its stated distribution is uniform (Talts et al.,
arXiv:1804.06788). Bands of the ranks' distribution that hold all of it in 95 % of studies are those of Säilynoja,
Bürkner and Vehtari, Statistics and Computing 32 (2022) 32.
"""

import sys

import numpy as np
import second_drive
from benches_as_they_are import NOISE, kept_file, resumed, small
from sampled_drives import LOADS, structured
from scipy import special, stats

import fitting
from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify
from fitting.estimation.realised import displaced
from fitting.model.observations import (
    COMPLIANCE_SHARE,
    DRIFT,
    FRICTION_SHARE,
    INPUT_ENCODER,
    OUTPUT_ENCODER,
    scatter_names,
)

DRAWS, BINS = 99, 20
EACH, TURNS = 24.37, 2
PATTERNS = ("pin_radial", "pin_tangential", "tooth_cumulative_pitch")
SINGLE = tuple(f"{pattern}_at_3" for pattern in PATTERNS)
GROUPS = {
    "sizes and places": ("eccentricity", "pin_radius", "pin_circle_radius", "centre_distance"),
    "orders of the pins' radial places": tuple(f"pin_radial_{k}_" for k in (1, 2, 3)),
    "orders of their tangential places": tuple(f"pin_tangential_{k}_" for k in (1, 2, 3)),
    "orders of the teeth": tuple(f"tooth_cumulative_pitch_{k}_" for k in (1, 2, 3)),
    "single pins and teeth": SINGLE,
    "bench": ("friction_torque", "chain_compliance"),
}


def drawn(seed):
    """A drive and its bench drawn from the prior, recorded: runs, and the truth by name, SI."""
    pair, generator = small(), np.random.default_rng([11, seed])
    draw = generator.normal

    def size(low, high):
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    values = structured(pair, generator, share=1.0)
    counts = {"pin_radial": pair.pins, "pin_tangential": pair.pins, "tooth_cumulative_pitch": pair.gear_teeth}
    # No prior of these sizes is stated: the fit estimates them.
    scatter = {name: draw(0.0, size(0.2e-6, 2e-6), count) for name, count in counts.items()}
    noise, creep = NOISE * size(0.5, 2.0), NOISE * size(0.2, 10.0)
    m, largest = pair.modification, max(LOADS)
    made = second_drive.body(second_drive.sizes_of(pair), values, scatter, isometric=m.isometric, offset=m.offset)
    surface = with_structured(surface_of_pair(pair), values)
    surface = surface.replace(**{name: surface.errors[name] + each for name, each in scatter.items()})
    nominal = second_drive.body(second_drive.sizes_of(pair), isometric=m.isometric, offset=m.offset)
    at = np.linspace(0.0, 2.0 * np.pi, 40)
    ends = [second_drive.transmission_error(nominal, at, largest + way).mean() for way in (-1.0, 1.0)]
    chain = draw(0.0, COMPLIANCE_SHARE * (ends[1] - ends[0]) / 2.0)
    friction = draw(0.0, FRICTION_SHARE * largest)
    outer, inner = draw(0.0, OUTPUT_ENCODER, 2), draw(0.0, INPUT_ENCODER, 2)
    runs, zero = [], draw(0.0, 1e-4)
    for load in LOADS:
        count = round(TURNS * pair.gear_teeth * EACH)
        theta = np.sign(load) * (generator.uniform(0.0, 2.0 * np.pi) + np.arange(count) * 2.0 * np.pi / EACH)
        error = second_drive.transmission_error(made, theta, load + np.sign(load) * friction) + chain * load
        place = np.abs(theta - theta[0]) / (2.0 * np.pi * pair.gear_teeth)
        for angle, lever, wave in ((theta / pair.gear_teeth, 1.0, outer), (theta, 1.0 / pair.gear_teeth, inner)):
            error = error + lever * (wave[0] * np.cos(angle) + wave[1] * np.sin(angle))
        error = error + zero + draw(0.0, creep) + draw(0.0, DRIFT) * (place - place.mean()) + draw(0.0, noise, count)
        runs.append(
            fitting.Run(
                input_angle=theta,
                output_angle=theta / pair.ratio + error,
                torque=load,
                common_zero=True,
                known_index=True,
                name=f"{load:g} N·m",
            )
        )
    truth = {
        **values,
        "friction_torque": friction,
        "chain_compliance": chain,
        **dict(zip(scatter_names(pair), displaced(pair, surface), strict=False)),
    }
    return runs, truth


def ranks(seed):
    """Rank, 0 to DRAWS, of the truth among draws of each stated error: {name: rank}, and the verdict."""
    runs, truth = drawn(seed)
    try:
        found = identify(runs, Drive(small()), held_out=False, form="0 um")
    except edge.InputError:
        return {"state": "refused", "ranks": {}}
    state = found.verdict.state
    if state == "not explained":
        return {"state": state, "ranks": {}}
    stated = {
        p.name: (p.value, p.standard_error, 0.5 * (p.interval[1] - p.interval[0]))
        for p in (*found.parameters, *found.realised.elements)
        if p.held is None
    }
    for name in GROUPS["bench"]:
        one = found.lmfit_parameters[name]
        stated[name] = one.value, one.stderr, 1.96 * one.stderr
    generator, above = np.random.default_rng([12, seed]), {}
    for name, (value, error, half) in stated.items():
        if name in SINGLE or "_at_" not in name:
            degrees = float(special.stdtridf(0.975, max(half / error, 1.96 + 1e-4)))
            draws = value + error * generator.standard_t(degrees, DRAWS)
            above[name] = int(np.count_nonzero(draws < truth[name]))
    return {"state": state, "ranks": above}


def band(count, confidence=0.95, studies=4000):
    """Places and half-open bands of the ranks' distribution minus the uniform one, which all of it keeps to."""
    places = np.arange(1, BINS) / BINS
    uniform = np.random.default_rng(0).integers(0, DRAWS + 1, (studies, count))
    below = np.array([(uniform < place * (DRAWS + 1)).sum(axis=1) for place in places]).T
    law = stats.binom(count, places)
    chance = 2.0 * np.minimum(law.cdf(below), law.sf(below - 1)).min(axis=1)
    each = np.quantile(chance, 1.0 - confidence)
    return places, law.ppf(0.5 * each) / count - places, law.ppf(1.0 - 0.5 * each) / count - places


def away(ranks):
    """Distribution of ranks minus the uniform one at the places of `band`."""
    places = np.arange(1, BINS) / BINS
    return np.array([np.mean(np.asarray(ranks) < place * (DRAWS + 1)) for place in places]) - places


def by_name(every):
    """Ranks of each error over all drives: {name: ranks}."""
    names = dict.fromkeys(name for one in every for name in one["ranks"])
    return {name: [one["ranks"][name] for one in every if name in one["ranks"]] for name in names}


def uniformity(ranks):
    """Chance of a chi-square as large of the ranks in BINS bins, and whether the distribution keeps to its band."""
    counts = np.histogram(ranks, BINS, (0, DRAWS + 1))[0]
    _, low, high = band(len(ranks))
    found = away(ranks)
    return float(stats.chisquare(counts).pvalue), bool(np.all((low <= found) & (found <= high)))


def lines(every):
    """The results of the study, in lines."""
    states = [one["state"] for one in every]
    told = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    yield f"{len(every)} drives: {told}."
    found = by_name(every)
    tests = {name: uniformity(ranks) for name, ranks in found.items()}
    for name, (chance, inside) in tests.items():
        band_is = "inside" if inside else "outside"
        yield f"{name}: {len(found[name])} drives, chi-square {chance:.3f}, {band_is} the band"
    least = min(chance for chance, _ in tests.values())
    yield (
        f"{sum(inside for _, inside in tests.values())} of {len(tests)} keep to their 95 % band; least chance of a "
        f"chi-square {least:.4f}, of {len(tests)}."
    )
    pooled = np.concatenate([*found.values()])
    for share in (50, 90, 95):
        inside = np.mean(np.abs(pooled - 0.5 * DRAWS) < 0.5 * share / 100 * (DRAWS + 1))
        yield f"{share} % intervals hold {inside:.1%} of the truths."


def draw(every, path):
    """Rank histograms of the groups, and below them the distributions of each error minus the uniform one."""
    from cycloid_fmu.draw.figure import new_figure, save

    found = by_name(every)
    figure, axes = new_figure(4, 3)
    figure.set_size_inches(11.0, 10.0)
    for number, (group, starts) in enumerate(GROUPS.items()):
        row, column = divmod(number, 3)
        top, low = axes[6 * row + column], axes[6 * row + 3 + column]
        members = {name: one for name, one in found.items() if name.startswith(starts)}
        pooled = np.concatenate([*members.values()])
        top.hist(pooled, BINS, range=(0, DRAWS + 1), color="#4c78a8")
        top.axhline(pooled.size / BINS, color="0.3", lw=0.8)
        top.set_title(group, fontsize=10)
        top.set(xlabel="rank of the truth", ylabel="errors of all drives")
        count = int(np.median([len(one) for one in members.values()]))
        places, least, most = band(count)
        low.fill_between(places, least, most, color="0.88")
        for one in members.values():
            low.plot(places, away(one), lw=0.9)
        low.set(xlabel="share of all ranks", ylabel="ECDF difference", ylim=(-0.16, 0.16))
    save(figure, path)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    kept = kept_file("calibration", "benches_as_they_are", "simulation_based_calibration")
    every = resumed(ranks, [(seed,) for seed in range(int(sys.argv[1]))], kept, "drives")
    for line in lines(every):
        print(line, flush=True)
    for path in sys.argv[2:]:
        draw(every, path)
