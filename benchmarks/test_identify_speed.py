"""Identification against a plain method in one run: time, evaluations of the model, errors found, coverage.

Three loads, both directions, 720 angles each, of drives whose pins scatter by 2 µm beyond their structured errors. The
plain method is scipy's least_squares with finite differences and all structured errors free. CYCLOID_SEEDS drives (1).
From the command line the same recordings are CSV files, and the baseline is a process that loads the packages which
reading and fitting cannot do without.
"""

import os
import resource
import statistics
import subprocess
import sys
import time

import numpy as np
from scipy.optimize import least_squares

import fitting.model.observations
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify
from fitting.model.observations import errors_of, observations
from fitting.model.prior import tolerances_of
from fitting.transmission_error.curve import Curve

ARCSEC = np.pi / 648000
LOADS = (20.0, -20.0, 60.0, -60.0, 200.0, -200.0)
PAIR = os.path.join(os.path.dirname(__file__), "..", "examples", "drive-39-40.toml")


def drive(pair, seed):
    """Curves of a random drive and its structured errors."""
    generator = np.random.default_rng(seed)
    names = [n for n in errors_of(pair) if not n.startswith(("misalignment", "isometric", "offset", "pin_radial_1"))]
    values = dict(zip(names, generator.normal(0.0, 0.3, len(names)) * tolerances_of(names), strict=True))
    surface = with_structured(surface_of_pair(pair), values)
    scattered = {
        name: surface.errors[name] + generator.normal(0.0, 2e-6, pair.pins) for name in ("pin_radial", "pin_tangential")
    }
    surface = surface.replace(**scattered)
    angle = np.arange(720) * 2.0 * np.pi * 39 / 720
    curves = []
    for load in LOADS:
        error = solve(DriveValue(pair, surface), load, angle, with_play=False).transmission_error[0]
        noisy = error + generator.normal(0.0, 0.5 * ARCSEC, angle.size)
        curves.append(
            Curve(
                angle,
                noisy,
                np.full(angle.size, np.nan),
                np.ones(angle.size, int),
                load,
                0.0,
                int(np.sign(load)),
                -39.0,
                True,
                True,
                f"{load:g}",
                "0",
            )
        )
    return curves, values


def processor_seconds(*words):
    """User and system time of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([str(word) for word in words], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_from_the_command_line(benchmark, tmp_path):
    files = []
    for curve in drive(read_pair(PAIR), 0)[0]:
        files.append(tmp_path / f"{curve.torque:g}.csv")
        way = slice(None, None, curve.direction)
        output = curve.transmission_error + curve.input_angle / curve.ratio
        columns = np.arange(720) * 0.01, curve.input_angle[way], output[way], np.full(720, curve.torque)
        head = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
        np.savetxt(files[-1], np.column_stack(columns), "%.17g", delimiter=",", header=head, comments="")
    words = ("cycloid-fit", "identify", *files, "--pair", PAIR, "-o", tmp_path / "fit.json")
    bare = (sys.executable, "-c", "import numba, pyarrow, pydantic, scipy.linalg, scipy.special, typer")
    processor_seconds(*words)  # kernels are compiled
    spent, alone = [], []
    benchmark.pedantic(
        lambda: spent.append(processor_seconds(*words)), setup=lambda: alone.append(processor_seconds(*bare)), rounds=5
    )
    benchmark.extra_info["processor seconds, least and median"] = f"{min(spent):.2f}, {statistics.median(spent):.2f}"
    benchmark.extra_info["loading its packages alone"] = f"{min(alone):.2f}, {statistics.median(alone):.2f}"
    ratio = statistics.median(one / other for one, other in zip(spent, alone, strict=True))
    benchmark.extra_info["times loading its packages alone"] = round(ratio, 2)


def plain_fit(pair, curves):
    """All structured errors and the bench free, by finite differences: {name: (value, standard error)}, evaluations."""
    observed = observations(curves, pair, [0.5 * ARCSEC] * len(curves))
    names = errors_of(pair)
    keep = ~np.array([n.startswith("output_angle_creep") for n in observed.bench_names])
    scale = np.concatenate([tolerances_of(names), np.full(keep.sum(), 1e-4), [observed.friction_prior]])
    scale[len(names) : -1][-1] = observed.bench_prior[-1]  # the chain's compliance
    evaluations = 0

    def left(unknowns):
        nonlocal evaluations
        evaluations += 1
        values = unknowns * scale
        surface = with_structured(surface_of_pair(pair), dict(zip(names, values, strict=False)))
        model = [
            solve(
                DriveValue(pair, surface), c.torque + c.direction * values[-1], c.input_angle, with_play=False
            ).transmission_error[0]
            for c in curves
        ]
        rest = observed.measured - np.concatenate(model) - observed.bench[:, keep] @ values[len(names) : -1]
        return observed.weight * rest

    found = least_squares(left, np.zeros(scale.size), diff_step=1e-4, max_nfev=25)
    residual = 2.0 * found.cost / (observed.measured.size - scale.size)
    deviation = np.sqrt(residual * np.diag(np.linalg.pinv(found.jac.T @ found.jac, rcond=1e-12))) * scale
    return dict(zip(names, zip(found.x * scale, deviation, strict=True), strict=False)), evaluations


def test_identification_against_the_plain_way(benchmark, monkeypatch):
    pair = read_pair(PAIR)
    solved = 0
    kernel = fitting.model.observations.curve_sensitivity

    def counted(drive, torque, angles, *others):
        nonlocal solved
        solved += np.size(angles)
        return kernel(drive, torque, angles, *others)

    monkeypatch.setattr(fitting.model.observations, "curve_sensitivity", counted)
    identify([c.points(slice(None, 100)) for c in drive(pair, 0)[0]], Drive(pair), held_out=False)
    rows = {"identify": [], "plain": []}

    def both():
        nonlocal solved
        for seed in range(int(os.environ.get("CYCLOID_SEEDS", "1"))):
            curves, values = drive(pair, seed)
            solved, wall, cpu = 0, time.perf_counter(), time.process_time()
            found = identify(curves, Drive(pair), held_out=False)
            told = {p.name: (p.value, p.standard_error) for p in found.parameters if p.held is None}
            spent = time.perf_counter() - wall, time.process_time() - cpu, solved / (720 * len(LOADS))
            rows["identify"].append((*spent, *accuracy(told, values, told)))
            wall, cpu = time.perf_counter(), time.process_time()
            other, evaluations = plain_fit(pair, curves)
            spent = time.perf_counter() - wall, time.process_time() - cpu, evaluations
            rows["plain"].append((*spent, *accuracy(other, values, told)))

    benchmark.pedantic(both, rounds=1)
    for name, row in rows.items():
        wall, cpu, evaluations, error, inside = np.mean(row, axis=0)
        benchmark.extra_info[name] = (
            f"{wall:.3g} s, {cpu:.3g} s of processor time, {evaluations:.3g} evaluations of the exact model, "
            f"{error * 1e6:.3g} µm rms error, 95 % intervals that hold the truth {100.0 * inside:.0f} %"
        )


def accuracy(found, values, among):
    """Rms error and coverage of the 95 % intervals over the errors that `identify` calls identified."""
    off = np.array([found[n][0] - values.get(n, 0.0) for n in among])
    inside = np.array([abs(found[n][0] - values.get(n, 0.0)) < 1.96 * found[n][1] for n in among])
    return float(np.sqrt(np.mean(off**2))), float(inside.mean())
