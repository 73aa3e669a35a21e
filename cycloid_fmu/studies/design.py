"""Search for drives that keep given limits: geometry and modification within ranges, for one goal or two.

The search is sequential quadratic programming in a trust region, on quadratic models of goal and limits that need no
derivatives (SciPy's COBYQA; Ragonneau, thesis, Hong Kong 2022), from several starts. Largest and smallest values over
loads, crank angles and pins are replaced by the Kreisselmeier-Steinhauser envelope (IFAC Proc. 12 (1979) 113). It is
never below the largest value: a design whose envelope keeps a limit keeps it. Where a yield is required, limits are
tightened by the difference between sampled drives and the drawn one, and the search is repeated from there until this
converges (sequential optimisation and reliability assessment; Du and Chen, J. Mech. Design 126 (2004) 225).

Isometric and offset modification can replace each other, so goals and limits are long curved valleys. There a method
that uses only the slopes of the limits (SLSQP) ended after its last iteration, far from the best drive.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pydantic
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import lost_motion, series_compliance, solve
from cycloid_fmu.analysis.validity import out_of_step
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_normals, flank_points
from cycloid_fmu.losses.flanks import flanks_rub
from cycloid_fmu.reducer.drive_file import parts_of_file
from cycloid_fmu.studies.friction import FIGURES as FRICTION
from cycloid_fmu.studies.friction import friction_figures, sliding_at
from cycloid_fmu.studies.limits import (
    LOWER,
    SHOWN,
    DutyLoad,
    Limits,
    Requirements,
    Verdict,
    flank_curvature_radius,
    pressure_limit_of,
    series_lost_motion,
    static_safety,
    whole_stiffness,
)
from cycloid_fmu.studies.tolerance import Study, check_study, shares_kept, surface_of
from cycloid_fmu.studies.tolerance import points as points_of
from cycloid_fmu.studies.verdicts import check, judge_drive, loads_of
from cycloid_fmu.supports.figures import bearing_loads, lives_over_duty
from cycloid_fmu.surfaces.sampling import Tolerances, read_tolerances
from cycloid_fmu.surfaces.structured import profile_names, profile_wave
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_of_pair

Array = NDArray[np.float64]
FORMAT = "cycloid-design/1"
SIZES = ("pin_circle_radius", "pin_radius", "eccentricity", "face_width")
MODIFICATIONS = ("isometric", "offset")
ROTATION = "profile_rotation"
FORMS = tuple(profile_names((1, 2, 3, 4)))
VARIABLES = {**dict.fromkeys((*SIZES, *MODIFICATIONS), "m"), ROTATION: "rad", **dict.fromkeys(FORMS, "m")}
"""Variables of a search with their units: sizes and modification of a pair file; rotation of both flanks of each tooth
towards each other about the gear's centre (> 0 removes material); orders of a profile that all teeth share."""
GOALS = tuple(name for name in Limits.model_fields if name not in ("wear_depth", "temperature", "self_locking"))
"""Figures that can be a goal or a limit of a design; a size can be a goal too and is minimised."""

_SHOWN = {
    **dict.fromkeys(SIZES, ("mm", 1e3)),
    **dict.fromkeys((*MODIFICATIONS, *FORMS), ("µm", 1e6)),
    ROTATION: ("mrad", 1e3),
}
_ELEMENTS = 50  # elements along the profile of a form, which has low orders only
_NOTICED = {"m": 1e-6, "rad": 5e-6}  # unit of the margin of a figure whose limit is 0
_ANGLES = 90  # crank angles of a sampled drive, at least
_PITCH_ANGLES = 24  # crank angles over one pin pitch, the period of a drive without errors
_SHARPNESS = 2500.0  # of the envelope, multiplied by the size of its values
_FIRST_STEP, _LAST_STEP = 0.2, 1e-5  # steps of a search relative to the range
_EVALUATIONS = 200  # largest number in a search, per variable
_STEP = 1e-3  # of differences, relative to the range
_SPARE = 1e-4  # margin of the search relative to a limit, because it ends slightly off
_BINDS = 5e-3  # a limit with a smaller relative margin is binding
_AT_END = 1e-6  # of a range: its end binds
_DIGITS = {"m": 9, "rad": 6}  # decimals of a drawing's values: whole nanometres, whole microradians
_ROUNDS, _SETTLED = 6, 0.02  # rounds of tightening, and the relative change of a limit that ends them
_GIVEN_WAY = 1e-3
_NO_TORQUE = 1e9  # N·m: in place of a torque that nothing reaches


class Robust(edge.Config):
    """The required yield, and how it is computed.

    Attributes
    ----------
    tolerances
        The tolerance file, relative to the design file; in Python given separately.
    required_yield
        Share of drives that keep every limit.
    samples
        Number of drives solved in each round.
    """

    tolerances: str = ""
    required_yield: float = pydantic.Field(alias="yield", gt=0.5, lt=1.0)
    samples: int = pydantic.Field(default=128, ge=32, strict=True)
    model_config = pydantic.ConfigDict(populate_by_name=True)


class DesignTask(Requirements):
    """A search: a drive, the ranges of the variables, the limits and the goals.

    Attributes
    ----------
    drive
        Pair file of everything that does not change, and the first start; relative to the design file. In Python the
        drive is given separately.
    duty
        Duty as in a requirements file; the search is at its torques, without a duty at the rated torque.
    goals
        One figure of the limits or a size, to be as good as possible, or two for a Pareto front.
    vary
        {name of a variable: (lowest, highest)}, SI; in a file `pin_radius = ["2 mm", "4 mm"]`. Variables are sizes,
        `isometric`, `offset`, `profile_rotation` and `profile_deviation_1` to `4`.
    robust
        None if the limits hold for the drive as drawn.
    """

    drive: str = ""
    duty: tuple[DutyLoad, ...] = ()
    goals: tuple[str, ...] = pydantic.Field(min_length=1, max_length=2)
    vary: dict[str, tuple[float, float]] = pydantic.Field(min_length=1)
    robust: Robust | None = None

    @pydantic.field_validator("goals")
    @classmethod
    def _known(cls, goals: tuple[str, ...]) -> tuple[str, ...]:
        for name in goals:
            if name not in (*GOALS, *SIZES):
                near = edge.did_you_mean(name, (*GOALS, *SIZES)) or f"give one of {', '.join((*GOALS, *SIZES))}"
                raise ValueError(f'"{name}" can\'t be a goal; {near}')
        if len(set(goals)) < len(goals):
            raise ValueError("both goals are the same")
        return goals

    @pydantic.field_validator("vary", mode="before")
    @classmethod
    def _ranges(cls, given: Any, info: pydantic.ValidationInfo) -> dict[str, tuple[float, float]]:
        if not isinstance(given, Mapping):
            raise ValueError("it must be a table of ranges")
        found = {}
        for name, ends in given.items():
            if name not in VARIABLES:
                near = edge.did_you_mean(str(name), VARIABLES) or f"give one of {', '.join(VARIABLES)}"
                raise ValueError(f"{name} can't be varied; {near}")
            stated = f"{name} = {edge.shown(ends)}"
            if not isinstance(ends, Sequence) or isinstance(ends, str) or len(ends) != 2:
                raise ValueError(f'{stated}: it must be two ends, such as ["-40 um", "0 um"]')
            try:
                low, high = (edge.quantity(end, VARIABLES[name], info) for end in ends)
            except ValueError as problem:
                raise ValueError(f"{stated}: {problem}") from None
            if not low < high:
                raise ValueError(f"{stated}: the first end must be below the second")
            found[str(name)] = (low, high)
        return found


def read_design_task(path: str | os.PathLike[str]) -> tuple[Pair, DesignTask, Tolerances | None]:
    """Return the drive, the task and the tolerances of a design file, `cycloid-design/1`.

    Raises
    ------
    edge.InputError
        If a file can't be read or is invalid; it names the file.
    """
    source, beside = str(path), Path(path).parent
    task = edge.validated(DesignTask, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, source), source)
    if not task.drive:
        raise edge.InputError(f"{source}: drive is missing.")
    if task.robust is not None and not task.robust.tolerances:
        raise edge.InputError(f"{source}: [robust] tolerances is missing.")
    for key, name in (("drive", task.drive), ("[robust] tolerances", task.robust.tolerances if task.robust else "")):
        if not (beside / name).exists():
            raise edge.InputError(f'{source}: {key} = "{name}": there is no {beside / name}.')
    pair, surface, first_stage = parts_of_file(beside / task.drive)
    if first_stage is not None:
        raise edge.InputError(f'{source}: drive = "{task.drive}": a whole reducer is not searched; give its gear pair.')
    if pair.errors or surface != surface_of_pair(pair):
        raise edge.InputError(
            f'{source}: drive = "{task.drive}": it states errors; a design is searched as drawn; remove them.'
        )
    check(task, pair, source, str(beside / task.drive))
    try:
        _check(pair, task)
    except edge.InputError as problem:
        raise edge.InputError(f"{source}: {problem}") from None
    return pair, task, None if task.robust is None else read_tolerances(beside / task.robust.tolerances)


def rotation_form(pair: Pair, elements: int) -> Array:
    """Return the form of a tooth whose flanks are turned towards each other by 1 rad, shape (elements,), m/rad.

    The rotation of the profile of Chinese practice (Guan, Zhang and others): the material that a rotation about the
    gear's centre removes along the flank's normal, on both sides; none at root and tip, so it is more than a clearance.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> form = rotation_form(pair, 100)
    >>> bool(form.max() <= 0.0), round(form.min() * 1e3)  # e z_c = 18 mm is the longest lever
    (True, -18)
    """
    alpha = equal_arc_parameters(pair, elements)
    x, y = flank_points(pair, alpha)
    along, up = flank_normals(pair, alpha)
    found: Array = -np.abs(x * up - y * along)
    return found


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A drive within the ranges: its pair as drawn, and the form of its flanks, if it is a variable."""

    pair: Pair
    surface: ErrorSurface


def candidate(pair: Pair, values: Mapping[str, float]) -> Candidate:
    """Return the drive with these values of `VARIABLES`, SI; an `edge.InputError` if it is impossible."""
    made = pair.replace(**{n: v for n, v in values.items() if n in (*SIZES, *MODIFICATIONS)})
    surface = surface_of_pair(made)
    shapes = [v * np.asarray(profile_wave(n, _ELEMENTS)) for n, v in values.items() if n in FORMS]
    if ROTATION in values:
        shapes.append(values[ROTATION] * rotation_form(made, _ELEMENTS))
    if shapes:
        form = np.broadcast_to(np.sum(shapes, axis=0)[:, None], (made.discs, made.gear_teeth, _ELEMENTS, 1))
        surface = surface.replace(gear_deviation=np.array(form))
    return Candidate(made, surface)


def values_over_sweep(
    task: Requirements, one: Candidate, names: Sequence[str], angles: Array, series: float
) -> dict[str, list[Array]]:
    """Return the values of each named figure, of which the worst counts, SI.

    Parameters
    ----------
    task
        For duty and friction.
    names
        Of `GOALS`.
    angles
        Crank angles, rad.
    series
        Compliance in series with contacts and bearings, rad/(N·m), that of the drive from which the search starts.

    Returns
    -------
    values
        {figure: arrays}: for the angular transmission error an array for each load, whose range counts; for the others
        one array, whose largest value counts, or for those in `LOWER` the smallest.
    """
    pair, limits = one.pair, set(names)
    loads = np.array(loads_of(task, None, pair))
    found = solve(DriveValue(pair, one.surface), loads, angles, with_play=bool(limits & {"backlash", "interference"}))
    loaded = loads != 0.0
    every: dict[str, list[Array]] = {"angular_transmission_error": list(found.transmission_error)}
    every["backlash"] = [np.nan_to_num(found.backlash)]
    # Below zero where there is play, so that a search sees how far it is from interference.
    room = 0.5 * pair.eccentricity * pair.gear_teeth * every["backlash"][0]
    every["interference"] = [np.where(found.interference > 0.0, found.interference, -room)]
    pressure = found.pin_pressure[loaded].max(axis=(-1, -2)).ravel()
    every["max_contact_pressure"] = [pressure]
    every["static_safety"] = [np.array([static_safety(pair, p) for p in pressure])] if "static_safety" in limits else []
    every["torsional_stiffness"] = [whole_stiffness(found.torsional_stiffness[loaded].ravel(), series)]
    every["smallest_curvature_radius"] = [np.array([flank_curvature_radius(pair)])]
    if "lost_motion" in limits:
        lost = lost_motion(DriveValue(pair, one.surface), angles)
        every["lost_motion"] = [lost + series_lost_motion(pair, series)]
    turning = [(load, int(np.flatnonzero(loads == load.torque)[0])) for load in task.duty if load.output_speed > 0.0]
    speeds = [load.output_speed * abs(pair.ratio) for load, _ in turning]
    if limits & {"sliding_speed", "friction_power_density"}:
        slides = [
            sliding_at(DriveValue(pair, one.surface), found, k, speed)
            for (_, k), speed in zip(turning, speeds, strict=True)
        ]
        for name in limits & {"sliding_speed", "friction_power_density"}:
            every[name] = [np.concatenate([getattr(s, name).max(axis=(-1, -2)) for s in slides])]
    if "bearing_life" in limits:
        lives = lives_over_duty(
            [bearing_loads(pair, found, k) for _, k in turning], speeds, [load.share for load, _ in turning]
        )
        every["bearing_life"] = [np.array([one.life for one in lives if math.isfinite(one.life)])]
    if limits & set(FRICTION):
        driven = [(load.torque, speed) for (load, _), speed in zip(turning, speeds, strict=True) if load.torque != 0.0]
        torques = [torque for torque, _ in driven] if driven else list(loads)
        rubbed = friction_figures(
            DriveValue(pair, one.surface), limits, torques, [speed for _, speed in driven], angles
        )
        for name in limits & set(FRICTION):
            every[name] = [np.minimum(getattr(rubbed, name), _NO_TORQUE)]
    return {name: every[name] for name in names}


def _envelope(values: Array, sharpness: float) -> float:
    """Kreisselmeier-Steinhauser envelope: at least the largest value, at most log(n)/sharpness of their size above."""
    largest = float(values.max())
    size = sharpness / max(float(np.abs(values).max()), 1e-300)
    return largest + float(np.log(np.exp(size * (values - largest)).sum())) / size


def _ripple(values: Array, sharpness: float) -> float:
    """Range of values by the envelopes of both ends, in units of the range."""
    offset, spread = float(values.mean()), max(float(np.ptp(values)), 1e-300)
    away = (values - offset) / spread
    return spread * (_envelope(away, sharpness) + _envelope(-away, sharpness))


def worst_of(name: str, values: Sequence[Array], sharpness: float = math.inf) -> float:
    """Return the worst of a figure's values, by the envelope if its sharpness is finite.

    Examples
    --------
    >>> import numpy as np
    >>> sharp = worst_of("backlash", [np.array([1.0, 3.0, 2.9])])
    >>> sharp, sharp < worst_of("backlash", [np.array([1.0, 3.0, 2.9])], 400.0) < 1.01 * sharp
    (3.0, True)
    """
    exact = math.isinf(sharpness)
    if name == "angular_transmission_error":
        each = [float(np.ptp(v)) if exact else _ripple(v, sharpness) for v in values]
        return max(each) if exact else _envelope(np.array(each), sharpness)
    every = np.concatenate(values)
    if name in LOWER:
        return float(every.min()) if exact else -_envelope(-every, sharpness)
    return float(every.max()) if exact else _envelope(every, sharpness)


@dataclasses.dataclass(frozen=True)
class Relaxed:
    """The cost of a binding limit or end of a range.

    Attributes
    ----------
    name, unit
        The limit, or the variable; SI.
    value
        The limit or the end of the range.
    of_a_tenth
        Gain of the first goal, > 0, for a relaxation by a tenth of the limit or of the range; to first order.
    """

    name: str
    unit: str
    value: float
    of_a_tenth: float


@dataclasses.dataclass(frozen=True)
class Design:
    """A found drive.

    Attributes
    ----------
    pair, surface
        The drive as drawn; the surface has the form of its flanks, if it was a variable.
    values
        {name: SI} of the variables.
    goals
        {name: SI} of the goals.
    verdicts
        On every limit, of the drive as drawn, over a whole crank turn.
    binding
        The binding constraints, the most costly first.
    allowance
        {limit: SI}: difference between drives within tolerances and the drawn drive, at the yield; empty without
        tolerances.
    yields
        {limit, or "all": share of drives that keep it, with the ends of its interval at 95 %}, of drives not used in
        the search; empty without tolerances.
    required_yield
        Required share of drives; None without tolerances.
    evaluations
        Number of solved drives.
    """

    pair: Pair
    surface: ErrorSurface
    values: dict[str, float]
    goals: dict[str, float]
    verdicts: tuple[Verdict, ...]
    binding: tuple[Relaxed, ...]
    allowance: dict[str, float]
    yields: dict[str, dict[str, float]]
    required_yield: float | None
    evaluations: int

    @property
    def met(self) -> bool:
        """Whether all limits are kept; for a yield, whether the samples do not exclude it."""
        return all(one.met for one in self.verdicts) and self.has_yield

    @property
    def has_yield(self) -> bool:
        """Whether the sampled drives do not exclude the required yield."""
        return self.required_yield is None or self.yields["all"]["high"] >= self.required_yield

    def numbers(self) -> dict[str, Any]:
        """Return the design for scripts, SI."""
        return {
            "values": self.values,
            "goals": self.goals,
            "verdicts": [one.numbers() for one in self.verdicts],
            "binding": [dataclasses.asdict(one) for one in self.binding],
            "allowance": self.allowance,
            "yields": self.yields,
            "required_yield": self.required_yield,
            "met": self.met,
            "evaluations": self.evaluations,
        }


class Search:
    """A task's search over the unit cube of the ranges: one goal at a time, with limits and levels of the other goal.

    Parameters are those of `search`. `levels` of its methods are {goal: the worst value that is allowed}, SI.
    """

    def __init__(
        self,
        pair: Pair,
        task: DesignTask,
        tolerances: Tolerances | None,
        seed: int,
        workers: int,
        progress: Callable[[str], None],
    ) -> None:
        self.pair, self.task, self.tolerances = pair, task, tolerances
        self.seed, self.workers, self.progress = seed, workers, progress
        self.allowance: dict[str, float] = {}
        self.names = list(task.vary)
        self.low, high = np.array([task.vary[n] for n in self.names]).T
        self.width = high - self.low
        self.limits = {n: v for n, v in task.limits.stated().items() if n in GOALS}
        self.angles = np.linspace(0.0, 2.0 * np.pi / pair.pins, _PITCH_ANGLES, endpoint=False)
        self.series = series_compliance(DriveValue.as_stated(pair))
        self.evaluations = 0
        self.refused = ""  # reason of the first invalid drive
        self._kept: dict[tuple[bytes, float], dict[str, float] | None] = {}

    def values_at(self, place: Array) -> dict[str, float]:
        """Return the values at a point of the unit cube, SI."""
        return dict(zip(self.names, (self.low + np.clip(place, 0.0, 1.0) * self.width).tolist(), strict=True))

    def place_of(self, pair: Pair) -> Array:
        """Return the point of a pair, moved into the ranges."""
        stated = {**{n: getattr(pair, n) for n in SIZES}, **{n: getattr(pair.modification, n) for n in MODIFICATIONS}}
        found = [
            (stated.get(n, 0.0) - low) / width for n, low, width in zip(self.names, self.low, self.width, strict=True)
        ]
        place: Array = np.clip(np.array(found), 0.0, 1.0)
        return place

    def figures(self, place: Array, sharpness: float) -> dict[str, float] | None:
        """Return the goals' and limits' figures at a point; None if the drive is impossible."""
        key = (np.asarray(place).tobytes(), sharpness)
        if key not in self._kept:
            self.evaluations += 1
            values = self.values_at(place)
            names = list(dict.fromkeys([*(g for g in self.task.goals if g not in SIZES), *self.limits]))
            try:
                one = candidate(self.pair, values)
                swept = values_over_sweep(self.task, one, names, self.angles, self.series)
                found = {n: worst_of(n, swept[n], sharpness) for n in names}
                found |= {n: getattr(one.pair, n) for n in self.task.goals if n in SIZES}
                self._kept[key] = found if all(map(math.isfinite, found.values())) else None
            except edge.InputError as problem:
                self._kept[key], self.refused = None, self.refused or str(problem)
        return self._kept[key]

    def exact(self, place: Array) -> dict[str, float]:
        """Return the figures at a valid point."""
        found = self.figures(place, math.inf)
        assert found is not None
        return found

    def margins(self, figures: Mapping[str, float], levels: Mapping[str, float]) -> Array:
        """Return the margin of each limit and of each level of another goal, as a share of it."""
        found = []
        for name, limit in self.limits.items():
            allowed = self.tightened(name, limit)
            found.append(_kept_by(name, figures[name], allowed, size_of(name, limit)))
        found += [_kept_by(name, figures[name], level, size_of(name, level)) for name, level in levels.items()]
        return np.array(found)

    def tightened(self, name: str, limit: float) -> float:
        """Return the tightened limit for the drive as drawn."""
        return limit + self.allowance.get(name, 0.0) * (1.0 if name in LOWER else -1.0)

    def gradients(self, place: Array, of: Callable[[Mapping[str, float]], Array]) -> Array:
        """Return central differences of some figures' values, (values, names); one-sided next to invalid points."""
        here = self.figures(place, _SHARPNESS)
        assert here is not None
        columns = []
        for k in range(place.size):
            ends = []
            for way in (1.0, -1.0):
                beside = place.copy()
                beside[k] = np.clip(place[k] + way * _STEP, 0.0, 1.0)
                figures = self.figures(beside, _SHARPNESS)
                ends.append((place[k], of(here)) if figures is None else (beside[k], of(figures)))
            (up, above), (down, below) = ends
            columns.append((above - below) / (up - down) if up > down else np.zeros_like(above))
        return np.array(columns).T

    def minimised(self, start: Array, goal: str, levels: Mapping[str, float]) -> Array | None:
        """Return the end point of the search from a start, None if the start is invalid."""
        from scipy.optimize import NonlinearConstraint, minimize

        first = self.figures(start, _SHARPNESS)
        if first is None:
            return None
        size, sign = max(abs(first[goal]), _NOTICED.get(_unit_of(goal), 1e-12)), -1.0 if goal in LOWER else 1.0

        def fun(x: Array) -> float:
            found = self.figures(x, _SHARPNESS)
            return 1e3 if found is None else sign * found[goal] / size

        def kept(x: Array) -> Array:
            found = self.figures(x, _SHARPNESS)
            if found is None:
                return np.full(len(self.limits) + len(levels), -1e3)
            return self.margins(found, levels) - _SPARE

        end = minimize(
            fun,
            start,
            bounds=[(0.0, 1.0)] * start.size,
            method="COBYQA",
            constraints=[NonlinearConstraint(kept, 0.0, np.inf)] if self.limits or levels else [],
            options={
                "initial_tr_radius": _FIRST_STEP,
                "final_tr_radius": _LAST_STEP,
                "maxfev": _EVALUATIONS * start.size,
            },
        ).x
        return start if self.figures(end, _SHARPNESS) is None else np.clip(end, 0.0, 1.0)

    def rank(self, place: Array, goal: str, levels: Mapping[str, float]) -> tuple[float, float]:
        """Return the rank of a point: the violation of limits, then the goal; smaller is better."""
        figures = self.figures(place, math.inf)
        if figures is None:
            return math.inf, math.inf
        missed = float(np.maximum(-self.margins(figures, levels), 0.0).sum()) if self.limits or levels else 0.0
        return (0.0 if missed < 1e-6 else missed), figures[goal] * (-1.0 if goal in LOWER else 1.0)

    def best(self, starts: Sequence[Array], goal: str, levels: Mapping[str, float]) -> Array:
        """Return the best point from all starts.

        Raises
        ------
        edge.InputError
            If no start is a valid drive that carries the loads.
        """
        ends = [end for start in starts if (end := self.minimised(start, goal, levels)) is not None]
        if not ends:
            raise edge.InputError(
                "vary: no gear was found within these ranges that can be made and carries the torques; give "
                f"ranges around the drive ({self.refused.rstrip('.')})."
            )
        return min(ends, key=lambda end: self.rank(end, goal, levels))

    def drawn(self, place: Array) -> dict[str, float]:
        """Return a point's values as a drawing states them, SI: rounded to `_DIGITS`, on the side that keeps limits."""
        digits = np.array([_DIGITS[VARIABLES[n]] for n in self.names])
        wanted = np.array([*self.values_at(place).values()]) * 10.0**digits
        whole = np.round(wanted)
        other = whole + np.where(wanted > whole, 1.0, -1.0)

        def values_of(numbers: Array) -> Array:
            rounded = [round(n / 10.0**d, int(d)) for n, d in zip(numbers.tolist(), digits.tolist(), strict=True)]
            values: Array = np.clip(rounded, *np.array([self.task.vary[n] for n in self.names]).T)
            return values

        def missed(numbers: Array) -> float:
            figures = self.figures((values_of(numbers) - self.low) / self.width, math.inf)
            if figures is None:
                return math.inf
            return max(0.0, -float(self.margins(figures, {}).min(initial=0.0)))

        least = missed(whole)
        while least > 0.0:
            best = min((np.where(np.arange(whole.size) == k, other, whole) for k in range(whole.size)), key=missed)
            if missed(best) >= least:
                break
            other, whole, least = whole + other - best, best, missed(best)
        return dict(zip(self.names, values_of(whole).tolist(), strict=True))

    def binding(self, place: Array, goal: str, levels: Mapping[str, float]) -> tuple[Relaxed, ...]:
        """Return the binding constraints at an optimum: multipliers of limits and ends of ranges.

        The gradient of the goal is a sum of the gradients of the constraints with non-negative multipliers (Karush,
        Kuhn and Tucker), found by non-negative least squares.
        """
        from scipy.optimize import nnls

        figures = self.figures(place, _SHARPNESS)
        if figures is None:
            return ()
        sign = -1.0 if goal in LOWER else 1.0
        slope, *slopes = self.gradients(place, lambda f: np.array([sign * f[goal], *self.margins(f, levels)]))
        # A goal with a level may have a limit too.
        limits, margins = [*self.limits.items(), *levels.items()], self.margins(figures, levels)
        rows = [
            (name, limit, row)
            for (name, limit), margin, row in zip(limits, margins, slopes, strict=True)
            if margin < _BINDS
        ]
        for name, at, row in zip(self.names, place, np.eye(place.size), strict=True):
            low, high = self.task.vary[name]
            rows += [(name, low, row)] if at < _AT_END else [(name, high, -row)] if at > 1.0 - _AT_END else []
        if not rows:
            return ()
        # Columns of one size, so that none is preferred.
        matrix = np.array([row for *_, row in rows]).T
        lengths = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        gains = 0.1 * nnls(matrix / lengths, slope)[0] / lengths
        found = [
            Relaxed(name, _unit_of(name), value, gain)
            for (name, value, _), gain in zip(rows, gains.tolist(), strict=True)
            if gain > 0.0
        ]
        return tuple(sorted(found, key=lambda one: -one.of_a_tenth))

    def sampled(self, one: Candidate, seed: int) -> dict[str, Array]:
        """Return the limits' figures of drives within tolerances about a drawn one: {limit: shape (samples,)}, SI."""
        assert self.task.robust is not None
        assert self.tolerances is not None
        torque = tuple(load for load in loads_of(self.task, None, one.pair) if load != 0.0)
        study = Study(one.pair, self.tolerances, samples=self.task.robust.samples, seed=seed, torque=torque)
        check_study(study, self.task.drive, self.task.robust.tolerances)
        angles = np.linspace(0.0, 2.0 * np.pi, out_of_step(one.pair.pins, _ANGLES), endpoint=False)

        def figures(point: Array) -> list[float]:
            made = _with_form(surface_of(study, point), one.surface)
            swept = values_over_sweep(self.task, Candidate(one.pair, made), [*self.limits], angles, self.series)
            return [worst_of(n, swept[n]) for n in self.limits]

        with ThreadPoolExecutor(self.workers) as pool:
            found = np.array(list(pool.map(figures, points_of(study))))
        return dict(zip(self.limits, found.T, strict=True))

    def best_within_tolerances(self, places: Sequence[Array], goal: str) -> Array:
        """Return the best point; for a yield with limits that are tightened until they converge."""
        best = self.best(places, goal, {})
        for number in range(_ROUNDS if self.tolerances is not None and self.limits else 0):
            self.progress(f"tightening the limits, round {number + 1} of at most {_ROUNDS}")
            figures = self.sampled(candidate(self.pair, self.values_at(best)), self.seed)
            before, self.allowance = self.allowance, allowances(self.task, self.exact(best), figures)
            best = self.best([best, *places[:1]], goal, {})
            changes = [abs(v - before.get(n, math.inf)) / size_of(n, self.limits[n]) for n, v in self.allowance.items()]
            if max(changes) < _SETTLED:
                break
        return best

    def designed(self, place: Array, levels: Mapping[str, float]) -> Design:
        """Return the drive at a point as a drawing states it, judged over a whole crank turn."""
        values = self.drawn(place)
        place = (np.array([*values.values()]) - self.low) / self.width
        one = candidate(self.pair, values)
        angles = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
        judged = judge_drive(DriveValue(one.pair, one.surface), self.task, None, angles, series=self.series)
        figures, limits, seen = self.exact(place), self.limits, dict[str, dict[str, float]]()
        if self.tolerances is not None and limits:
            fresh = self.sampled(one, self.seed + 1)
            seen = shares_kept({n: v >= limits[n] if n in LOWER else v <= limits[n] for n, v in fresh.items()})
        return Design(
            one.pair,
            one.surface,
            values,
            {n: max(figures[n], 0.0) for n in self.task.goals},
            judged.verdicts,
            self.binding(place, self.task.goals[0], levels),
            dict(self.allowance),
            seen,
            self.task.robust.required_yield if seen and self.task.robust else None,
            self.evaluations,
        )


def _with_form(made: ErrorSurface, drawn: ErrorSurface) -> ErrorSurface:
    """Return a sampled surface with the drawn form of all flanks as well."""
    form = drawn.gear_deviation
    if form is None:
        return made
    if made.gear_deviation is not None:
        # Both along the profile at the middles of their own elements.
        at, known = ((np.arange(size) + 0.5) / size for size in (made.gear_deviation.shape[2], form.shape[2]))
        form = made.gear_deviation + np.interp(at, known, form[0, 0, :, 0])[:, None]
    return made.replace(gear_deviation=form)


def _kept_by(name: str, value: float, allowed: float, size: float) -> float:
    away = value - allowed if name in LOWER else allowed - value
    return away / size


def size_of(name: str, limit: float) -> float:
    """Return the reference of a limit's margin: the limit itself, or for a limit of 0 a noticeable size, SI."""
    return abs(limit) if limit != 0.0 else _NOTICED.get(_unit_of(name), 1.0)


def _unit_of(name: str) -> str:
    return VARIABLES.get(name) or edge.unit_of_field(Limits.model_fields[name]) or "1"


def _starts(search: Search, count: int, seed: int) -> list[Array]:
    """Yield the drive itself, then evenly spread valid points."""
    from scipy.stats import qmc

    found = [search.place_of(search.pair)]
    for place in qmc.Sobol(len(search.names), rng=np.random.default_rng(seed)).random(16 * count):
        if len(found) > count:
            break
        if search.figures(place, _SHARPNESS) is not None:
            found.append(place)
    return found


def allowances(task: DesignTask, drawn: Mapping[str, float], figures: Mapping[str, Array]) -> dict[str, float]:
    """Return the differences of the limits' figures between sampled drives and the drawn one, at the task's yield.

    They hold together: the share of drives within all of them is the yield, at the smallest common quantile for which
    it is.
    """
    assert task.robust is not None
    names = list(figures)
    worse = np.array([(figures[n] - drawn[n]) * (-1.0 if n in LOWER else 1.0) for n in names])
    ranks, count = np.sort(worse, axis=1), worse.shape[1]
    needed = math.ceil(task.robust.required_yield * count)
    level = ranks[:, -1]
    for k in range(needed - 1, count):
        if np.count_nonzero((worse <= ranks[:, k, None]).all(axis=0)) >= needed:
            level = ranks[:, k]
            break
    return dict(zip(names, level.tolist(), strict=True))


def search(
    pair: Pair,
    task: DesignTask,
    tolerances: Tolerances | None = None,
    *,
    starts: int = 4,
    seed: int = 1,
    points: int = 7,
    workers: int = 1,
    progress: Callable[[str], None] = lambda step: None,
) -> list[Design]:
    """Search for drives that keep a task's limits.

    Parameters
    ----------
    pair
        The drive as drawn, without errors.
    task
        The search; its paths are not read.
    tolerances
        Of the task's `robust`.
    starts
        Starting points besides the drive itself.
    seed
        Seed of these points and of sampled drives; the same seed gives the same result.
    points
        Drives of a Pareto front, both ends among them.
    workers
        Threads for sampled drives.
    progress
        Called with the name of each stage.

    Returns
    -------
    designs
        One for one goal; for two goals those of the front, the best by the first goal first. If limits can't be kept,
        the nearest drives are returned, and the verdicts state it.

    Raises
    ------
    edge.InputError
        If no drive within the ranges is valid, or a goal or limit needs a missing value.
    """
    _check(pair, task)
    one = Search(pair, task, tolerances, seed, workers, progress)
    places = _starts(one, starts, seed)
    first, *others = task.goals
    progress(f"searching the best {_words(first)}")
    best = one.best_within_tolerances(places, first)
    ends = [(best, dict[str, float]())]
    if others:
        ends = _front(one, best, places, points)
    progress("judging")
    return [one.designed(*end) for end in ends]


def _front(one: Search, best: Array, places: Sequence[Array], points: int) -> list[tuple[Array, dict[str, float]]]:
    """Return the points of a Pareto front from the best by the first goal, each with its level of the second one."""
    first, second = one.task.goals
    one.progress(f"searching the best {_words(second)}")
    other = one.best([best, *places], second, {})
    # Among drives equally good in one goal, the best in the other.
    best = one.best([best], second, {first: _eased(first, one.exact(best)[first])})
    level = _eased(second, one.exact(other)[second])
    other = one.best([other], first, {second: level})
    ends, near = [(best, dict[str, float]())], best
    for number, between in enumerate(np.linspace(one.exact(best)[second], level, points)[1:-1].tolist()):
        one.progress(f"point {number + 2} of {points} of the front")
        near = one.best([near, other], first, {second: between})
        ends.append((near, {second: between}))
    return [*ends, (other, {second: level})]


def _eased(name: str, value: float) -> float:
    """Return a goal's best value, relaxed by a thousandth."""
    return value + (-_GIVEN_WAY if name in LOWER else _GIVEN_WAY) * abs(value)


def on_front(designs: Sequence[Design]) -> NDArray[np.bool_]:
    """Return which designs are on the Pareto front of their goals, shape (designs,).

    They meet all limits, and no other such design is better in one goal and as good in all others; differences of less
    than a thousandth do not count, as in a search.
    """
    signs = [-1.0 if name in LOWER else 1.0 for name in designs[0].goals]
    costs = np.array([list(one.goals.values()) for one in designs]) * signs
    met = np.array([one.met for one in designs])
    noticed = _GIVEN_WAY * np.abs(costs)
    at_least_as_good = (costs[:, None] <= costs + noticed).all(axis=2)
    better = (costs[:, None] < costs - noticed).any(axis=2)
    return np.asarray(met & ~(at_least_as_good & better & met[:, None]).any(axis=0))


def _words(name: str) -> str:
    return name.replace("_", " ")


def _check(pair: Pair, task: DesignTask) -> None:
    if not task.duty and pair.rated_torque is None:
        raise edge.InputError("[[duty]] is missing; state it, or rated_torque of the pair.")
    if task.limits.wear_depth is not None:
        raise edge.InputError("[limits] wear_depth: a search does not include wear; remove it.")
    if task.limits.temperature is not None:
        raise edge.InputError("[limits] temperature: a search does not include heat; limit efficiency or remove it.")
    if task.limits.self_locking is not None:
        raise edge.InputError("[limits] self_locking: a search needs numbers; limit back_driving_torque or remove it.")
    if pair.losses is None and (rubbing := {*task.goals, *task.limits.stated()} & set(FRICTION)):
        raise edge.InputError(f"no friction stated; state [losses] of the pair: {rubbing.pop()} depends on it.")
    if "static_safety" in (*task.goals, *task.limits.stated()):
        pressure_limit_of(pair)

    def refuse(needed: str) -> NoReturn:
        raise edge.ArgumentError("goals", needed, list(task.goals))

    asked = [name for name in task.goals if name in GOALS]
    if "lost_motion" in asked and pair.rated_torque is None:
        refuse("lost_motion needs the pair's rated_torque")
    for name in ("bearing_life", "sliding_speed", "friction_power_density", "efficiency"):
        if name in asked and not any(load.output_speed > 0.0 for load in task.duty):
            refuse(f"{name} needs speeds; state [[duty]] with an output_speed above 0")
    needs = "friction_power_density" in (*task.goals, *task.limits.stated())
    if needs and not flanks_rub(pair):
        raise edge.InputError("friction_power_density: no friction stated; state [losses.flank] of the pair.")
    supports = pair.supports
    bearings = () if supports is None else (supports.turning_arm, supports.crank_shaft, supports.main)
    if all(one.dynamic_capacity is None for one in bearings):
        if "bearing_life" in asked:
            refuse("bearing_life needs the pair's [supports] with a dynamic_capacity")
        if task.limits.bearing_life is not None:
            raise edge.InputError(
                "[limits] bearing_life: no bearing of the pair's [supports] states its dynamic_capacity; state it, or "
                "remove the limit."
            )


def shown(name: str, value: float) -> tuple[str, str]:
    """Return a goal's, limit's or variable's value in field units, and the unit.

    Examples
    --------
    >>> shown("backlash", 0.00029), shown("pin_radius", 0.003), shown("offset", -4e-05)
    (('0.99695', 'arcmin'), ('3', 'mm'), ('-40', 'µm'))
    """
    unit, factor = SHOWN[name][:2] if name in SHOWN else _SHOWN[name]
    return f"{value * factor:.5g}", unit


def write_designs(found: Sequence[Design], folder: str | os.PathLike[str]) -> list[Path]:
    """Write drives as pair files, with a surface file where flanks have form, and all of them as `designs.json`.

    Returns
    -------
    paths
        The written files: `design-1.toml`, `design-1.nc`, …, `designs.json`; a missing folder is created.

    Raises
    ------
    edge.InputError
        If a file can't be written.
    """
    from cycloid_fmu.geometry.pair import write_pair
    from cycloid_fmu.surfaces.files import write_surface

    target = edge.created_folder(folder)
    written = []
    for number, one in enumerate(found, 1):
        written.append(target / f"design-{number}.toml")
        write_pair(one.pair, written[-1])
        if one.surface.gear_deviation is not None:
            written.append(target / f"design-{number}.nc")
            write_surface(one.surface, written[-1])
    written.append(target / "designs.json")
    with edge.written_whole(written[-1]) as temporary:
        temporary.write_text(edge.json_text([one.numbers() for one in found]), encoding="utf-8")
    return written
