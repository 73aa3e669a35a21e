"""Random rings with scatter in every pin and tooth, and how near an identification states each of them.

`python tests/realised_rings.py DRIVES` prints the table of docs/identify.md.
"""

import sys
from pathlib import Path

import numpy as np
from sampled_drives import ARCSEC, LOADS, random_drive, recorded

from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import read_pair
from fitting.estimation.fit import NO_SCATTER
from fitting.estimation.identify import identify
from fitting.estimation.realised import displaced, displaced_covariance
from fitting.model.discs import other_descriptions
from fitting.model.identifiability import chosen_errors, posterior_covariance
from fitting.model.observations import State, errors_of, linearise, observations, scatter_parts, spread_of

SCATTER = 2e-6


def random_ring(pair, generator, scatter=SCATTER):
    """A drive as of `random_drive`, whose teeth scatter too."""
    surface, values = random_drive(pair, generator, scatter)
    pitch = surface.tooth_cumulative_pitch
    return surface.replace(tooth_cumulative_pitch=pitch + generator.normal(0.0, scatter, pitch.shape)), values


def cramer_rao(pair, surface, curves, noise, scatter=SCATTER):
    """Covariance of every pin and tooth, gauge removed, that no estimate can fall below, shape as of `displaced`.

    `noise` is a single sample's, rad. From the exact model's derivatives at the drive itself, structured errors and the
    bench's zeros unknown, with the scatter's size as prior: ten times that size as prior changes it by 0.1 %.
    """
    observed = observations(curves, pair, [noise / np.sqrt(np.median(c.sample_count)) for c in curves])
    state = State(surface, np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]))
    linear, names = linearise(pair, observed, state), errors_of(pair)
    spread = spread_of(pair, dict.fromkeys(scatter_parts(pair), scatter))
    chosen = chosen_errors(observed, linear, names, spread)
    return displaced_covariance(pair, chosen, posterior_covariance(observed, linear, names, chosen, spread))


def ring(pair, number, *, loads=LOADS, each=24.0, turns=1, noise=0.5 * ARCSEC, scatter=SCATTER, seed=0):
    """One random ring: identification, distances of its elements from the truth, m, and their Cramér-Rao bounds, m.

    Of several discs any may be called the first: the truth is the description of the drive that lies nearest.
    """
    generator = np.random.default_rng([seed, number])
    surface, _ = random_ring(pair, generator, scatter)
    runs = [recorded(pair, surface, load, generator, each=each, turns=turns, noise=noise) for load in loads]
    found = identify(runs, Drive(pair), held_out=False)
    stated = np.array([one.value for one in found.realised.elements])
    bound = np.sqrt(np.diag(cramer_rao(pair, surface, found.curves, noise, max(scatter, NO_SCATTER))))
    away = [stated - displaced(pair, one) for one in (surface, *other_descriptions(pair, surface))]
    return found, min(away, key=rms), bound


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def figures_of(found, distance, bound):
    """Figures of one ring by pattern: {pattern: (rms distance, rms bound, elements inside, elements)}."""
    low, high = np.array([one.interval for one in found.realised.elements]).T
    stated = np.array([one.value for one in found.realised.elements])
    inside = (low <= stated - distance) & (stated - distance <= high)
    return {
        name: (rms(distance[part]), rms(bound[part]), int(inside[part].sum()), part.stop - part.start)
        for name, part in scatter_parts(found.pair).items()
    }


def table(drives, first=0):
    """Lines of the table of docs/identify.md, a ring's as soon as it is there."""
    pair = read_pair(Path(__file__).parent.parent / "examples" / "drive-39-40.toml")
    every = []
    for number in range(first, first + drives):
        found, distance, bound = ring(pair, number)
        every.append(figures_of(found, distance, bound))
        words = ", ".join(f"{n} {d * 1e6:.4f} ({d / b:.2f} bounds, {i}/{c})" for n, (d, b, i, c) in every[-1].items())
        yield f"{number}: {found.verdict.state}, {found.residual / ARCSEC:.3f}″, {words}"
    yield "| each | rms distance from the truth, µm | worst ring | times the Cramér–Rao bound | intervals that hold |"
    yield "| --- | --- | --- | --- | --- |"
    for name in scatter_parts(pair):
        distance, bound, inside, count = np.array([one[name] for one in every]).T
        yield (
            f"| `{name}` | {rms(distance) * 1e6:.3f} | {distance.max() * 1e6:.3f} | {rms(distance) / rms(bound):.2f} | "
            f"{inside.sum():.0f} of {count.sum():.0f}, {inside.sum() / count.sum():.1%} |"
        )


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    for line in table(*map(int, sys.argv[1:])):
        print(line, flush=True)
