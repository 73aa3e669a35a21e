"""Random drives recorded at any rate, and how often the intervals of their identification hold the truth.

`python studies/sampled_drives.py DRIVES` prints the table of docs/identify_coverage.md.
"""

import sys
from pathlib import Path

import numpy as np

import fitting
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify
from fitting.model.observations import errors_of
from fitting.model.prior import tolerances_of

ARCSEC = np.pi / 648000
LOADS = (20.0, -20.0, 60.0, -60.0, 200.0, -200.0)
SAMPLINGS = ((24.0, 1), (24.0, 2), (24.37, 1), (24.37, 2), (24.37, 6), (24.37, 10), (20.7, 3), (10.0, 10), (6.0, 10))
SMALL = {"gear_teeth": 11, "pins": 12, "pin_circle_radius": 50e-3, "pin_radius": 5e-3, "eccentricity": 2.5e-3}


def structured(pair, generator, share=0.3):
    """Random structured errors, standard deviation a share of their tolerance: {name: m}.

    Of errors with the same effect on the curves one is the drive's; the others stay nominal.
    """
    names = [n for n in errors_of(pair) if not n.startswith(("misalignment", "isometric", "offset", "pin_radial_1"))]
    return dict(zip(names, generator.normal(0.0, share, len(names)) * tolerances_of(names), strict=True))


def random_drive(pair, generator, scatter):
    """A drive with structured errors within half their tolerance and a scatter of every pin that none of them holds."""
    values = structured(pair, generator)
    surface = with_structured(surface_of_pair(pair), values)
    scattered = {
        name: surface.errors[name] + generator.normal(0.0, scatter, pair.pins)
        for name in ("pin_radial", "pin_tangential")
    }
    return surface.replace(**scattered), values


def recorded(pair, surface, load, generator, *, each, turns, noise=0.5 * ARCSEC, left=None):
    """A run of so many output turns at so many samples a crank turn, begun anywhere.

    `left`, of crank angle (rad) and load (N·m), is the deviation outside the drive's rigid contact, rad.
    """
    count = round(turns * abs(pair.ratio) * each)
    angle = generator.uniform(0.0, 2.0 * np.pi) + np.arange(count) * 2.0 * np.pi / each
    angle *= np.sign(load)
    error = solve(DriveValue(pair, surface), load, angle, with_play=False).transmission_error[0]
    error = error + generator.normal(0.0, noise, count)
    if left is not None:
        error = error + left(angle, load)
    return fitting.Run(
        input_angle=angle,
        output_angle=angle / pair.ratio + error,
        torque=load,
        common_zero=True,
        known_index=True,
        name=f"{load:g} N·m",
    )


def distances(found, values):
    """Distance of each fitted error from the truth in half widths of its 95 % interval."""
    return {
        p.name: 2.0 * (p.value - values.get(p.name, 0.0)) / (p.interval[1] - p.interval[0])
        for p in found.parameters
        if p.held is None
    }


def coverage(pair, each, turns, drives, *, loads=LOADS, scatter=0.3e-6, seed=0):
    """Distances of all errors of random drives recorded so, as of `distances`."""
    every = []
    for number in range(drives):
        generator = np.random.default_rng([seed, number])
        surface, values = random_drive(pair, generator, scatter)
        runs = [recorded(pair, surface, load, generator, each=each, turns=turns) for load in loads]
        every.append(distances(identify(runs, Drive(pair), held_out=False), values))
    return every


def table(drives):
    """Lines of the table of docs/identify_coverage.md."""
    nominal = read_pair(Path(__file__).parent.parent / "examples" / "drive-39-40.toml")
    yield "| samples a crank turn | output turns | intervals that contain the truth | farthest, standard errors |"
    yield "| --- | --- | --- | --- |"
    for each, turns in SAMPLINGS:
        found = np.concatenate([[*one.values()] for one in coverage(nominal, each, turns, drives)])
        inside = np.abs(found) < 1.0
        yield (
            f"| {each:g} | {turns} | {inside.sum()} of {found.size}, {inside.mean():.1%} | "
            f"{1.96 * np.abs(found).max():.1f} |"
        )


if __name__ == "__main__":
    for line in table(int(sys.argv[1])):
        print(line, flush=True)
