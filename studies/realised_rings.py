"""Random rings with scatter in every pin and tooth, and how near an identification states each of them.

`python studies/realised_rings.py DRIVES` prints the table of docs/identify_coverage.md.
"""

import sys
from pathlib import Path

import numpy as np
from sampled_drives import ARCSEC, LOADS, random_drive, recorded

from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import read_pair
from fitting.estimation.identify import identify
from fitting.estimation.realised import displaced, displaced_covariance
from fitting.model.discs import other_descriptions
from fitting.model.identifiability import chosen_errors, posterior_covariance
from fitting.model.observations import (
    PIN_RADIUS,
    RADIUS_SPREAD,
    State,
    estimated_parts,
    linearise,
    observations,
    scatter_parts,
    spread_of,
)
from fitting.model.unknowns import NO_SCATTER

SCATTER = 2e-6


def random_ring(pair, generator, scatter=SCATTER, radius=RADIUS_SPREAD):
    """A drive as of `random_drive`, whose teeth scatter too, and the radii of whose pins do."""
    surface, values = random_drive(pair, generator, scatter)
    pitch = surface.tooth_cumulative_pitch
    pitch = pitch + generator.normal(0.0, scatter, pitch.shape)
    each = surface.pin_radius_deviation + generator.normal(0.0, radius, pair.pins)
    return surface.replace(tooth_cumulative_pitch=pitch, pin_radius_deviation=each), values


def cramer_rao(pair, surface, curves, noise, scatter, radius, lever):
    """Covariance of every pin and tooth, gauge removed, that no estimate can fall below, shape as of `displaced`.

    `noise` is a single sample's, rad; radial places are those of pins of the mean radius, by the lever. From the exact
    model's derivatives at the drive itself, structured errors and the bench's zeros unknown, with the scatters' sizes
    as prior: ten times that of the places changes it by 0.1 %.
    """
    observed = observations(curves, pair, [noise / np.sqrt(np.median(c.sample_count)) for c in curves])
    state = State(surface, np.zeros(spread_of(pair, {}).size), np.zeros(observed.bench.shape[1]))
    linear = linearise(pair, observed, state)
    sizes = {**dict.fromkeys(scatter_parts(pair), scatter), PIN_RADIUS: radius}
    chosen = chosen_errors(pair, observed, linear, sizes)
    covariance = posterior_covariance(pair, observed, linear, chosen, sizes)
    return displaced_covariance(pair, chosen, covariance, lever)


def ring(
    pair, number, *, loads=LOADS, each=24.0, turns=1, noise=0.5 * ARCSEC, scatter=SCATTER, radius=RADIUS_SPREAD, seed=0
):
    """One random ring: identification, distances of its elements from the truth, m, and their Cramér-Rao bounds, m.

    With several discs any may be called the first: the truth is the description closest to the identified drive.
    """
    generator = np.random.default_rng([seed, number])
    surface, _ = random_ring(pair, generator, scatter, radius)
    runs = [recorded(pair, surface, load, generator, each=each, turns=turns, noise=noise) for load in loads]
    found = identify(runs, Drive(pair), held_out=False)
    stated = np.array([one.value for one in found.realised.elements])
    lever = found.realised.radius_lever
    sizes = max(scatter, NO_SCATTER), max(radius, NO_SCATTER)
    bound = np.sqrt(np.diag(cramer_rao(pair, surface, found.curves, noise, *sizes, lever)))
    away = [stated - displaced(pair, one, lever) for one in (surface, *other_descriptions(pair, surface))]
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
        for name, part in estimated_parts(found.pair).items()
    }


def table(drives, first=0):
    """Lines of the table of docs/identify_coverage.md, a ring's once it is done."""
    pair = read_pair(Path(__file__).parent.parent / "examples" / "drive-39-40.toml")
    every = []
    for number in range(first, first + drives):
        found, distance, bound = ring(pair, number)
        every.append(figures_of(found, distance, bound))
        words = ", ".join(f"{n} {d * 1e6:.4f} ({d / b:.2f} bounds, {i}/{c})" for n, (d, b, i, c) in every[-1].items())
        yield f"{number}: {found.verdict.state}, {found.residual / ARCSEC:.3f}″, {words}"
    yield (
        "| element | rms distance from the truth, µm | worst ring | times the Cramér–Rao bound "
        "| intervals that contain the truth |"
    )
    yield "| --- | --- | --- | --- | --- |"
    for name in estimated_parts(pair):
        distance, bound, inside, count = np.array([one[name] for one in every]).T
        yield (
            f"| `{name}` | {rms(distance) * 1e6:.3f} | {distance.max() * 1e6:.3f} | {rms(distance) / rms(bound):.2f} | "
            f"{inside.sum():.0f} of {count.sum():.0f}, {inside.sum() / count.sum():.1%} |"
        )


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    for line in table(*map(int, sys.argv[1:])):
        print(line, flush=True)
