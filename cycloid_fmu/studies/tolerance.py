"""Tolerance studies: many drives within tolerances, each solved exactly, and the resulting yield and cost.

A drive is a point of the unit cube with one axis for each tolerance (`sampling.surface_at`). The design of a study is a
set of such points, fixed by its seed; what a drive gives does not depend on the others, so the number of workers, their
order and interruptions do not change a result.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance, solve
from cycloid_fmu.contact.lanes import LANES
from cycloid_fmu.contact.near_drives import NearDrives
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import SLICES_MISALIGNED, DriveValue
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import LOST_MOTION, Pair
from cycloid_fmu.losses.solver import losses_of
from cycloid_fmu.studies.checkpoint import Checkpoint
from cycloid_fmu.studies.friction import FIGURES as OF_FRICTION
from cycloid_fmu.studies.friction import FrictionFigures, friction_figures
from cycloid_fmu.studies.limits import DutyLoad, is_lower, series_lost_motion
from cycloid_fmu.studies.machines import Numbers, Solved, complete, versions
from cycloid_fmu.surfaces.sampling import LARGEST_SEED, Tolerances, surface_at
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import Elements, ErrorSurface, nominal_surface

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
Design = Literal["sobol", "latin-hypercube", "saltelli"]
DESIGNS: tuple[Design, ...] = ("sobol", "latin-hypercube", "saltelli")
FORMAT = "cycloid-tolerance-study/1"
TOGETHER = 8 * LANES  # drives of a task on a cluster, where a task costs as much as several drives
FORM = Elements(profile=50, width=5, angle=25)  # of sampled form deviations
PER_TORQUE = ("angular_transmission_error", "mean_transmission_error", "max_contact_pressure")
FIGURES = {
    "angular_transmission_error": ("rad", "largest minus smallest transmission error over the crank angles"),
    "mean_transmission_error": ("rad", "mean transmission error over the crank angles"),
    "max_contact_pressure": ("Pa", "largest contact pressure over the crank angles"),
    "mean_backlash": ("rad", "mean backlash over the crank angles, 0 where there is no free position"),
    "backlash": ("rad", "largest backlash over the crank angles"),
    "lost_motion": ("rad", f"largest over the crank angles of the {LOST_MOTION}, up to a catalogue's stiffness"),
    "interference": ("m", "largest interference over the crank angles"),
    "efficiency": ("1", "efficiency of the driving drive at the worst row of the duty, 0 where it jams"),
    "starting_torque": ("N*m", "largest torque of the input without a load from rest, infinite where it jams"),
    "back_driving_torque": ("N*m", "largest torque on the output that turns it backwards from rest, infinite if none"),
    "self_locking": ("1", "share of the crank angles at which no torque up to the rated one turns it backwards"),
}
"""Unit and meaning; those of `friction.FIGURES` are solved where they have a limit."""


@dataclasses.dataclass(frozen=True)
class Study:
    """Definition of a study; two studies with equal fields have equal results.

    Attributes
    ----------
    pair, tolerances
        The nominal pair, and the tolerances.
    samples, seed, design
        Points: "sobol" (scrambled), "latin-hypercube", or "saltelli" for Sobol indices, whose number of points is the
        largest multiple of tolerances + 2 by a power of two that `samples` allows.
    torque
        Loads on the output, N·m, not zero.
    angles, turns
        Crank angles evenly from 0 over so many crank turns, end excluded.
    first_stage
        The first stage of an RV reducer: figures are then those with the sun locked.
    duty
        Loads and speeds of the efficiency, which needs one at least where it has a limit.
    """

    pair: Pair
    tolerances: Tolerances
    samples: int
    seed: int
    torque: tuple[float, ...]
    design: Design = "sobol"
    angles: int = ANGLES
    turns: int = 1
    first_stage: FirstStage | None = None
    duty: tuple[DutyLoad, ...] = ()

    @property
    def factors(self) -> tuple[str, ...]:
        """The tolerances, in the order of the points' columns."""
        return self.tolerances.factors

    @property
    def drives(self) -> int:
        """Number of the points."""
        return saltelli_base(self) * (len(self.factors) + 2) if self.design == "saltelli" else self.samples

    @functools.cached_property
    def columns(self) -> tuple[tuple[str, int | None], ...]:
        """Name and index of the torque (None where there is none) of each number that a sample yields."""
        others = {*PER_TORQUE, *OF_FRICTION} - set(self.friction)
        single: list[tuple[str, int | None]] = [(n, None) for n in FIGURES if n not in others]
        if self.pair.rated_torque is None:
            single.remove(("lost_motion", None))
        return (*((n, k) for n in PER_TORQUE for k in range(len(self.torque))), *single)

    @property
    def friction(self) -> tuple[str, ...]:
        """The figures of friction that have a limit."""
        return tuple(name for name in OF_FRICTION if name in self.tolerances.limits.stated())

    @property
    def driven(self) -> tuple[DutyLoad, ...]:
        """The rows of the duty that turn under load."""
        return tuple(load for load in self.duty if load.output_speed > 0.0 and load.torque != 0.0)

    @property
    def drive(self) -> DriveValue:
        """The drive as stated."""
        return DriveValue.as_stated(self.pair, self.first_stage)

    def drive_of(self, surface: ErrorSurface) -> DriveValue:
        """Return the drive with other errors."""
        return DriveValue(self.pair, surface, self.first_stage)

    def identity(self) -> dict[str, Any]:
        """Return the identity of this study, for a checkpoint."""
        return {
            "pair": self.pair.nominal.text,
            "tolerances": self.tolerances.text,
            "design": self.design,
            "samples": self.samples,
            "seed": self.seed,
            "torque": list(self.torque),
            "angles": self.angles,
            "turns": self.turns,
            "versions": versions(),
            **({} if self.first_stage is None else {"first_stage": self.first_stage.text}),
        } | ({"duty": [[*load.model_dump().values()] for load in self.driven]} if "efficiency" in self.friction else {})


def check_study(study: Study, pair_source: str, tolerances_source: str) -> None:
    """Refuse a study that can't be made.

    Raises
    ------
    edge.InputError
        If nothing has a tolerance, a tolerance has no width, a load is zero, the seed is out of range, or a limit needs
        the rated torque, friction or speeds, and there are none.
    """
    if not study.factors:
        raise edge.InputError(
            f"{tolerances_source}: no tolerance is stated; a study needs a table such as [pin_radial]."
        )
    for name in study.factors:
        stated = getattr(study.tolerances, name)
        field = "single" if hasattr(stated, "single") else "tolerance"
        if getattr(stated, field) == 0.0:
            raise edge.InputError(
                f"{tolerances_source}: [{name}] {field} = 0: a distribution needs a width above zero; remove the table "
                "where there is no error."
            )
    if 0.0 in study.torque:
        raise edge.ArgumentError("torque", "a study's loads must not be zero; the play has its own figures", 0.0)
    if not 0 <= study.seed <= LARGEST_SEED:
        raise edge.ArgumentError("seed", f"it must be between 0 and {LARGEST_SEED}", study.seed)
    if study.tolerances.limits.lost_motion is not None and study.pair.rated_torque is None:
        raise edge.InputError(
            f"{pair_source}: [pair] rated_torque is missing; state it: [limits] lost_motion of {tolerances_source} is "
            "taken at a share of it."
        )
    if study.friction:
        losses_of(study.drive, pair_source)
    if "efficiency" in study.friction and not study.driven:
        raise edge.InputError(
            f"{tolerances_source}: [limits] efficiency needs a torque and a speed; state it in a requirements file "
            "with a [[duty]] that turns under load, and give that as the limits."
        )


def points(study: Study) -> Array:
    """Return the study's points in the unit cube, shape (samples, factors), determined by the seed.

    Raises
    ------
    edge.InputError
        If the design is Saltelli's and the samples are too few for it.
    """
    from scipy.stats import qmc

    size = len(study.factors)
    if study.design == "saltelli":
        with edge.needs_extra("sensitivity", lambda said: edge.ArgumentError("design", said, study.design)):
            from SALib.sample import sobol
        base = saltelli_base(study)
        return np.asarray(sobol.sample(_problem(study), base, calc_second_order=False, seed=study.seed))
    if study.design == "latin-hypercube":
        return np.asarray(qmc.LatinHypercube(size, rng=np.random.default_rng(study.seed)).random(study.samples))
    with warnings.catch_warnings():
        # Without a power of two of points the sequence is no longer balanced, but still even.
        warnings.filterwarnings("ignore", message="The balance properties")
        return np.asarray(qmc.Sobol(size, rng=np.random.default_rng(study.seed)).random(study.samples))


def saltelli_base(study: Study) -> int:
    """Return the base points of Saltelli's design, a power of two; each takes tolerances + 2 samples."""
    each = len(study.factors) + 2
    if study.samples < 16 * each:
        problem = f"Sobol indices of {each - 2} tolerances need {16 * each} samples at least"
        raise edge.ArgumentError("samples", problem, study.samples)
    return 1 << int(math.log2(study.samples // each))


def _problem(study: Study) -> dict[str, Any]:
    names = list(study.factors)
    return {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}


def surface_of(study: Study, point: Array) -> ErrorSurface:
    """Return the drive of one point."""
    return surface_at(study.pair, study.tolerances, dict(zip(study.factors, map(float, point), strict=True)), FORM)


def crank_angles(study: Study) -> Array:
    """Return the crank angles of a study, shape (angles,), rad."""
    return _crank_angles(study.angles, study.turns)


def _crank_angles(angles: int, turns: int) -> Array:
    return np.linspace(0.0, 2.0 * np.pi * turns, angles, endpoint=False)


def loaded_figures(found: Transmission) -> dict[str, Array]:
    """Return the figures at each torque of a solution under load, by their names in `FIGURES`, shape (torques,)."""
    return {
        "angular_transmission_error": np.ptp(found.transmission_error, axis=1),
        "mean_transmission_error": found.transmission_error.mean(axis=1),
        "max_contact_pressure": found.max_contact_pressure.max(axis=1),
    }


def free_figures(drive: DriveValue, angles: Array, series: float) -> dict[str, float]:
    """Return the figures of play and lost motion, by their names in `FIGURES`, at crank angles (rad).

    There is no lost motion without a rated torque; a compliance in series with contacts and bearings, rad/(N·m), adds
    to it.
    """
    pair = drive.pair
    free = solve(drive, pair.lost_motion_loads, angles, with_stiffness=False)
    backlash = np.where(np.isnan(free.backlash), 0.0, free.backlash)
    found = {"mean_backlash": backlash.mean(), "backlash": backlash.max(), "interference": free.interference.max()}
    if pair.lost_motion_loads:
        found["lost_motion"] = (free.transmission_error[0] - free.transmission_error[1]).max()
        found["lost_motion"] += series_lost_motion(pair, series)
    return found


def figures_of(study: Study, surface: ErrorSurface) -> Array:
    """Return the figures of one drive in the order of `Study.columns`, by the exact model."""
    found: Array = exact_figures(study, [surface])[0]
    return found


def exact_figures(study: Study, surfaces: Sequence[ErrorSurface]) -> Array:
    """Return the figures of drives in the order of `Study.columns`, by the exact model, shape (drives, columns).

    Drives on rigid bearings without deviations of form, which have no first stage, are solved side by side. A drive's
    figures do not depend on the others.
    """
    slices = _slices(study)
    alone = _is_alone(study)
    beside = np.array(
        [not (alone or _has_form(s)) and study.drive_of(s).slices <= slices for s in surfaces], dtype=bool
    )
    found = np.empty((len(surfaces), len(study.columns)))
    for number in np.flatnonzero(~beside).tolist():
        found[number] = _figures_alone(study, surfaces[number])
    if beside.any():
        found[beside] = _figures_side_by_side(study, [surfaces[number] for number in np.flatnonzero(beside).tolist()])
    return found


def _is_alone(study: Study) -> bool:
    """Whether each drive of the study is solved by itself: on bearings, behind a first stage, with form."""
    has_form = any(name.endswith("_profile") for name in study.factors)
    return study.first_stage is not None or study.pair.supports is not None or has_form


def _has_form(surface: ErrorSurface) -> bool:
    return surface.gear_deviation is not None or surface.pin_deviation is not None


def _figures_alone(study: Study, surface: ErrorSurface) -> Array:
    angles = crank_angles(study)
    loaded = solve(study.drive_of(surface), study.torque, angles, with_play=False, with_stiffness=False)
    series = series_compliance(study.drive)
    found: dict[str, Any] = {
        **loaded_figures(loaded),
        **free_figures(study.drive_of(surface), angles, series),
        **(_worst_of(friction_of(study, surface)) if study.friction else {}),
    }
    return np.array([found[name] if k is None else found[name][k] for name, k in study.columns])


def friction_of(study: Study, surface: ErrorSurface) -> FrictionFigures:
    """Return the figures of friction of one drive that have a limit."""
    drive, angles, asked = study.drive_of(surface), crank_angles(study), {*study.friction}
    loads, speeds = ([getattr(row, name) for row in study.driven] for name in ("torque", "output_speed"))
    turning = [abs(study.pair.ratio) * speed for speed in speeds]
    running = friction_figures(drive, asked & {"efficiency"}, loads, turning, angles)
    at_rest = friction_figures(drive, asked - {"efficiency"}, study.torque, [], angles)
    return at_rest._replace(efficiency=running.efficiency)


def _worst_of(friction: FrictionFigures) -> dict[str, float]:
    """Return the figures of a drive, by their names in `FIGURES`; those that were not asked for are missing."""
    efficiency, starting, back_driving, _ = friction
    worst = {"efficiency": efficiency.min()} if efficiency.size else {}
    worst |= {"starting_torque": starting.max()} if starting.size else {}
    if back_driving.size:
        worst |= {"back_driving_torque": back_driving.max(), "self_locking": np.isinf(back_driving).mean()}
    return worst


def _loads(pair: Pair, torque: Sequence[float], angles: Array) -> list[tuple[float, Array]]:
    """Return a study's loads and crank angles: first those under load, then ± lost motion, then the play."""
    return [(t, angles) for t in (*torque, *pair.lost_motion_loads, 0.0)]


def _slices(study: Study) -> int:
    """Return the slices that a study's drives need, whatever of its tolerances they have."""
    displaced = {
        name
        for kind in KINDS.values()
        if kind.tolerance is not None and kind.tolerance.key in study.factors
        for name in kind.displaces
    }
    return SLICES_MISALIGNED if displaced & {"tilt_x", "tilt_y"} else 1


def _figures_side_by_side(study: Study, surfaces: Sequence[ErrorSurface]) -> Array:
    near = _near_drives(study.pair, study.torque, study.angles, study.turns, _slices(study))
    drives = near.displaced(np.array([displacement_vector(study.pair, surface) for surface in surfaces]))
    loads = len(study.torque)
    solutions = [near.loaded(k, drives) for k in range(loads)]
    has_rated = study.pair.rated_torque is not None
    backlash, interference = near.play(loads + 2 * has_rated, drives)
    free = np.where(np.isnan(backlash), 0.0, backlash)
    found: dict[str, Any] = {
        "angular_transmission_error": [np.ptp(error, axis=1) for error, _ in solutions],
        "mean_transmission_error": [error.mean(axis=1) for error, _ in solutions],
        "max_contact_pressure": [pressure.max(axis=1) for _, pressure in solutions],
        "mean_backlash": free.mean(axis=1),
        "backlash": free.max(axis=1),
        "interference": interference.max(axis=1),
    }
    if has_rated:
        up, down = (near.loaded(loads + k, drives)[0] for k in range(2))
        found["lost_motion"] = (up - down).max(axis=1)
    return np.column_stack([found[name] if k is None else found[name][k] for name, k in study.columns])


@functools.lru_cache(maxsize=2)
def _near_drives(pair: Pair, torque: tuple[float, ...], angles: int, turns: int, slices: int) -> NearDrives:
    return NearDrives(
        DriveValue(pair, nominal_surface(pair)), _loads(pair, torque, _crank_angles(angles, turns)), slices
    )


def _task(study: Study, numbers: Numbers, rows: Array) -> Solved:
    """Solve some samples in any process."""
    return numbers, exact_figures(study, [surface_of(study, row) for row in rows]), ()


@dataclasses.dataclass(frozen=True)
class Result:
    """The solved samples of a study, all or some of them.

    Attributes
    ----------
    values
        Shape (samples, columns) in the order of `Study.columns`, SI.
    sample
        Numbers of the samples, shape (samples,).
    """

    study: Study
    values: Array
    sample: NDArray[np.int64]

    @functools.cached_property
    def point(self) -> Array:
        """Coordinates of the samples in the unit cube, shape (samples, factors)."""
        return points(self.study)[self.sample]

    def figure(self, name: str) -> Array:
        """Return a figure, shape (samples, torques) or (samples,), a view of the values."""
        found = [i for i, (n, _) in enumerate(self.study.columns) if n == name]
        return self.values[:, found[0] : found[-1] + 1] if name in PER_TORQUE else self.values[:, found[0]]

    @functools.cached_property
    def independent(self) -> NDArray[np.bool_]:
        """Mask of the samples that are independent: all except those of Saltelli's design that share coordinates."""
        if self.study.design != "saltelli":
            return np.ones(self.sample.size, dtype=bool)
        place = self.sample % (len(self.study.factors) + 2)
        return np.asarray((place == 0) | (place == len(self.study.factors) + 1))


def run(
    study: Study,
    checkpoint: Checkpoint | None = None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], None] = lambda samples: None,
) -> Result:
    """Solve a study's samples, those of the checkpoint excepted.

    Parameters
    ----------
    checkpoint
        Storage of finished samples.
    workers, scheduler
        As in `machines.complete`; the result does not depend on them.
    progress
        Called with the number of samples just finished, first those of the checkpoint.

    Raises
    ------
    KeyboardInterrupt
        As `machines.complete`.
    """
    solved = checkpoint or Checkpoint(None, study)
    place = points(study)
    complete(
        solved,
        _task,
        lambda numbers: (study, numbers, place[numbers]),
        together=1 if _is_alone(study) else LANES if scheduler is None else TOGETHER,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    return Result(study, solved.values, np.arange(study.drives))


def statistics(result: Result) -> dict[str, dict[str, Any]]:
    """Return each figure's distribution: {figure: {"mean", "standard_deviation", "quantiles"}}, SI, one a torque.

    `quantiles` are {"0.05", "0.5", "0.95", "1"}: the last is the largest. Where a drive's figure is infinite there is
    no mean (NaN), and a quantile is a drive's value.
    """
    found = {}
    for name in dict.fromkeys(n for n, _ in result.study.columns):
        values = result.figure(name)[result.independent]
        finite = bool(np.isfinite(values).all())
        method: Literal["linear", "higher"] = "linear" if finite else "higher"
        found[name] = {
            "mean": values.mean(axis=0) if finite else math.nan,
            "standard_deviation": values.std(axis=0) if finite else math.nan,
            "quantiles": {f"{q:g}": np.quantile(values, q, axis=0, method=method) for q in (0.05, 0.5, 0.95, 1.0)},
        }
    return found


def demand(study: Study, values: Array) -> dict[str, Array]:
    """Return the samples' figures as shares of each stated limit, largest over the loads: {limit: shape (samples,)}.

    1 is at the limit. A limit of 0 is met (share 0) by figures that do not exceed it. Of a smallest allowed value it is
    the limit's share of the figure, infinite at 0.
    """
    found = {}
    for name, limit in study.tolerances.limits.stated().items():
        taken = values[:, [i for i, (n, _) in enumerate(study.columns) if n == name]].max(axis=1)
        if is_lower(name, limit):
            found[name] = np.divide(limit, taken, out=np.full(taken.size, np.inf), where=taken > 0.0)
        else:
            found[name] = taken / limit if limit > 0.0 else np.where(taken > 0.0, 1.0 + taken * 1e6, 0.0)
    return found


def yields(result: Result) -> dict[str, dict[str, float]]:
    """Return the shares of drives that keep the study's limits, as `shares_kept` does.

    Evenly spread points have smaller errors than this interval of independent ones.
    """
    return shares_kept({n: d[result.independent] <= 1.0 for n, d in demand(result.study, result.values).items()})


def shares_kept(kept: Mapping[str, NDArray[np.bool_]]) -> dict[str, dict[str, float]]:
    """Return the share of drives that keep each limit, and "all" of them, with its Clopper-Pearson interval at 95 %.

    Parameters
    ----------
    kept
        {limit: shape (drives,)}, at least one.
    """
    from scipy.stats import binomtest

    found = {}
    for name, good in {**kept, "all": np.logical_and.reduce([*kept.values()])}.items():
        interval = binomtest(int(good.sum()), good.size).proportion_ci()
        found[name] = {"share": float(good.mean()), "low": float(interval.low), "high": float(interval.high)}
    return found


def sobol_indices(result: Result) -> dict[str, dict[str, Array]]:
    """Return Sobol's indices of each figure that varies over the base points of Saltelli's design, shape (factors,).

    A figure that is infinite for a drive has none.

    SALib estimates them, with the variance over these points; interference may differ from zero at other points only.

    Returns
    -------
    indices
        {figure, at several loads with its torque: {"first_order", "first_order_confidence", "total",
        "total_confidence"}}; the confidence is half of the 95 % interval (bootstrap).

    Raises
    ------
    ValueError
        If the design is another or some samples are missing.
    """
    from SALib.analyze import sobol

    study = result.study
    if study.design != "saltelli" or result.sample.size != saltelli_base(study) * (len(study.factors) + 2):
        raise ValueError("Sobol indices need all samples of Saltelli's design")
    found = {}
    for column, (name, k) in enumerate(study.columns):
        values = result.values[:, column]
        if not np.isfinite(values).all() or np.ptp(values[result.independent]) == 0.0:
            continue
        indices = sobol.analyze(
            _problem(study),
            (values - values.mean()) / values.std(),
            calc_second_order=False,
            seed=np.random.default_rng(study.seed),  # SALib ignores a seed of 0
        )
        label = name if k is None or len(study.torque) == 1 else f"{name} {study.torque[k]:g} N*m"
        found[label] = {
            "first_order": np.asarray(indices["S1"]),
            "first_order_confidence": np.asarray(indices["S1_conf"]),
            "total": np.asarray(indices["ST"]),
            "total_confidence": np.asarray(indices["ST_conf"]),
        }
    return found


def dataset_of(result: Result) -> xr.Dataset:
    """Return a study as a labelled dataset, format `cycloid-tolerance-study/1`, dimensions sample, factor, torque."""
    import xarray as xr

    study = result.study
    data: dict[str, Any] = {"point": (("sample", "factor"), result.point)}
    for name in dict.fromkeys(n for n, _ in study.columns):
        data[name] = (("sample", "torque") if name in PER_TORQUE else ("sample",), result.figure(name))
    coordinates = {
        "sample": result.sample,
        "factor": np.array(study.factors, dtype=object),
        "torque": np.array(study.torque),
    }
    dataset = xr.Dataset(data, coordinates)
    for name, (unit, text) in FIGURES.items():
        if name in dataset:
            dataset[name].attrs.update(units=unit, long_name=text)
    dataset["point"].attrs.update(units="1", long_name="coordinate in the unit cube: the probability of a single error")
    dataset["torque"].attrs.update(units="N*m", long_name="torque of the environment on the output")
    identity = study.identity()
    for name in ("torque", "versions"):
        identity.pop(name)
    identity |= {"duty": json.dumps(identity["duty"])} if "duty" in identity else {}
    dataset.attrs.update(identity, format=FORMAT)
    return dataset
