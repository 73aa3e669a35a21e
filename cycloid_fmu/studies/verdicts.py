"""The verdicts on one drive: computations in addition to a sweep, for every stated limit that can be judged."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import lost_motion, series_compliance, solve
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.heat import Heat, Running, heat
from cycloid_fmu.studies import limits as judging
from cycloid_fmu.studies.friction import FIGURES, friction_figures, sliding_at
from cycloid_fmu.studies.limits import DutyLoad, Requirements, Verdict
from cycloid_fmu.studies.strength import Stress, strength
from cycloid_fmu.supports.figures import DutyLife, bearing_loads, lives_over_duty
from cycloid_fmu.wear.friction import Sliding
from cycloid_fmu.wear.life import WearRun

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Judged:
    """The results of judging a drive.

    Attributes
    ----------
    verdicts
        One for each limit that could be judged; none without limits.
    not_judged
        Stated limits that are not judged here.
    lives
        Bearings over the duty; none without speeds or supports.
    crank_angle
        Shape (angles,), rad, of `sliding`.
    sliding
        Sliding of the pins for each row of the duty that turns under load.
    stresses
        Nominal stresses of pins, output pins and discs, if a limit asks for them.
    """

    verdicts: tuple[Verdict, ...]
    not_judged: tuple[str, ...]
    lives: tuple[DutyLife, ...]
    crank_angle: Array
    sliding: tuple[tuple[DutyLoad, Sliding], ...]
    stresses: tuple[Stress, ...] = ()

    @property
    def met(self) -> bool:
        """Whether all limits are judged and met."""
        return judging.all_met(self.verdicts, self.not_judged)

    def numbers(self) -> dict[str, Any]:
        """Return everything for scripts, SI; for sliding the largest value of each pin."""
        sliding = [
            {
                "torque": load.torque,
                "output_speed": load.output_speed,
                **{name: values.max(axis=(0, 1)) for name, values in found._asdict().items() if values.size},
            }
            for load, found in self.sliding
        ]
        return {
            "verdicts": [one.numbers() for one in self.verdicts],
            "not_judged": list(self.not_judged),
            "bearing_lives": [dataclasses.asdict(one) for one in self.lives],
            "sliding": sliding,
            "stresses": [one.numbers() for one in self.stresses],
        }

    def labelled(self, data: xr.Dataset) -> xr.Dataset:
        """Return a sweep's dataset with the verdicts and the sliding over `duty`, its rows that turn.

        The attribute `verdicts` has a line for each verdict and one for the limits not judged.
        `sliding_speed`, `friction_power` and `friction_power_density` are over duty, crank angle, disc and pin;
        `duty_torque`, `duty_output_speed` and `duty_share` state the rows.
        """
        lines = [*map(judging.line_of, self.verdicts), judging.not_judged_line(self.not_judged)]
        data = data.assign_attrs(verdicts="\n".join(filter(None, lines)))
        if not self.sliding:
            return data
        for name, unit in (("torque", "N*m"), ("output_speed", "rad/s"), ("share", "1")):
            data[f"duty_{name}"] = ("duty", [getattr(load, name) for load, _ in self.sliding], {"units": unit})
        for name, (unit, text) in _LABELS.items():
            values = [getattr(found, name) for _, found in self.sliding]
            if values[0].size:
                label = {"units": unit, "long_name": text}
                data[name] = (("duty", "crank_angle", "disc", "pin"), np.stack(values), label)
        return data


_LABELS = {
    "sliding_speed": ("m/s", "sliding speed of the flank on each pin that carries load"),
    "friction_power": ("W", "friction power of each pin"),
    "friction_power_density": ("W/m^2", "friction power of each pin over its contact's area"),
}


def loads_of(
    requirements: Requirements, torque: Sequence[float] | None, pair: Pair, source: str = "the pair"
) -> list[float]:
    """Return the torques to solve, N·m: the given ones and those of the duty; the rated torque if there are neither.

    Raises
    ------
    edge.InputError
        If there are none; `source` is the name of the pair's file.
    """
    found = list(dict.fromkeys([*(torque or ()), *(load.torque for load in requirements.duty)]))
    return found or [pair.rated_load(source)]


def check(requirements: Requirements, pair: Pair, source: str, pair_source: str) -> None:
    """Raise `edge.InputError` for limits that need a value that the pair lacks; it names both files."""
    limits = requirements.limits
    if limits.static_safety is not None:
        judging.pressure_limit_of(pair, pair_source)
    if limits.lost_motion is not None and pair.rated_torque is None:
        raise edge.InputError(
            f"{pair_source}: [pair] rated_torque is missing; state it: [limits] lost_motion of {source} is taken at a "
            "share of it."
        )


def judge_sweep(
    drive: DriveValue,
    requirements: Requirements,
    found: Transmission,
    workers: int = 1,
    series: float | None = None,
) -> Judged:
    """Judge a sweep that was solved at the torques of `loads_of`.

    Parameters
    ----------
    pair, surface, first_stage
        The drive.
    requirements
        The requirements, checked by `check`.
    found
        Its sweep, with play and stiffness.
    workers
        Threads for the lost motion, which is solved here if it has a limit.
    series
        Compliance in series with contacts and bearings, rad/(N·m); None for that of this drive
        (`analysis.series_compliance`).
    """
    pair = drive.pair
    if series is None:
        series = series_compliance(drive)
    data: dict[str, Any] = {**vars(found), "backlash": found.backlash}
    if requirements.limits.lost_motion is not None:
        data["lost_motion"] = lost_motion(drive, found.crank_angle, workers=workers)
    verdicts = judging.judge(requirements.limits, pair, data, series)
    lives, sliding = list[DutyLife](), list[tuple[DutyLoad, Sliding]]()
    duty = [load for load in requirements.duty if load.output_speed > 0.0]
    row = [int(np.flatnonzero(found.torque == load.torque)[0]) for load in duty]
    speed = [load.output_speed * abs(pair.ratio) for load in duty]
    if duty and pair.supports is not None:
        lives = lives_over_duty([bearing_loads(pair, found, k) for k in row], speed, [load.share for load in duty])
        verdicts += judging.judge_lives(requirements.limits, lives)
    for load, k, turning in zip(duty, row, speed, strict=True):
        sliding.append((load, sliding_at(drive, found, k, turning, workers)))
    if sliding:
        figures = {
            name: np.stack([getattr(slides, name) for _, slides in sliding])
            for name in ("sliding_speed", "friction_power_density")
        }
        verdicts += judging.judge_sliding(requirements.limits, duty, found.crank_angle, figures)
    asked = [name for name in FIGURES if name in requirements.limits.stated()]
    if asked and pair.losses is not None and pair.supports is not None:
        driven = [(load, turning) for load, turning in zip(duty, speed, strict=True) if load.torque != 0.0]
        loads = [load.torque for load, _ in driven] if driven else list(found.torque)
        rubbed = friction_figures(drive, asked, loads, [w for _, w in driven], found.crank_angle, workers)
        verdicts += judging.judge_friction(requirements.limits, [load for load, _ in driven], found.crank_angle, rubbed)
    verdicts += judging.judge_heat(requirements.limits, _heat_over(drive, requirements, found.crank_angle, workers))
    stresses = list[Stress]()
    if not set(judging.STRENGTH).isdisjoint(requirements.limits.stated()):
        stresses = strength(drive, found)
        verdicts += judging.judge_strength(requirements.limits, stresses)
    missing = judging.not_judged(requirements.limits, verdicts)
    return Judged(tuple(verdicts), tuple(missing), tuple(lives), found.crank_angle, tuple(sliding), tuple(stresses))


def _heat_over(drive: DriveValue, requirements: Requirements, crank_angle: Array, workers: int) -> Heat | None:
    """Return how warm a drive gets over the duty; None if that has no limit, or friction or heat are not stated."""
    pair = drive.pair
    if requirements.limits.temperature is None or None in (pair.losses, pair.supports, pair.thermal):
        return None
    duty = [load for load in requirements.duty if load.output_speed > 0.0]
    running = [Running(load.torque, load.output_speed * abs(pair.ratio), load.share) for load in duty]
    return heat(drive, running, crank_angle, workers=workers)


def judge_drive(
    drive: DriveValue,
    requirements: Requirements,
    torque: Sequence[float] | None,
    crank_angle: Array,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
    series: float | None = None,
) -> Judged:
    """Solve a drive at the torques given and those of the duty, and judge it; `series` is that of `judge_sweep`.

    Raises
    ------
    edge.InputError
        If there is no torque, or the pair lacks something that a limit needs.
    """
    pair = drive.pair
    check(requirements, pair, "the requirements", "the pair")
    loads = loads_of(requirements, torque, pair)
    found = solve(drive, loads, crank_angle, workers=workers, progress=progress)
    return judge_sweep(drive, requirements, found, workers, series)


def judge_worn(
    run: WearRun, requirements: Requirements, *, workers: int = 1, progress: Callable[[int], None] = lambda angles: None
) -> Judged:
    """Judge a drive at the end of a wear run, at the loads of its life and of the duty, and its wear depth.

    Bearings are not part of the wear model and are not judged.
    """
    model, last = run.model, run.states[-1]
    torque = list(dict.fromkeys(load.torque for load in model.loads if load.torque != 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    judged = judge_drive(
        DriveValue(model.pair, run.surface), requirements.of_wear, torque, angle, workers=workers, progress=progress
    )
    turns = np.array([state.crank_turns for state in run.states])
    deepest = np.array([state.depth.largest for state in run.states])
    worn = judging.judge_wear(requirements.limits, last.depth.gear, last.depth.pin, turns, deepest)
    verdicts = (*judged.verdicts, *worn)
    missing = judging.not_judged(requirements.limits, verdicts)
    return dataclasses.replace(judged, verdicts=verdicts, not_judged=tuple(missing))


LIVES_HEAD = ("bearing", "equivalent", "L10h (ISO 281)")
SLIDING_HEAD = ("load", "sliding speed", "friction power of a pin", "over its contact", "pin, crank angle")


def life_rows(judged: Judged) -> list[list[str]]:
    """Return the bearings' lives over the duty as table rows, columns `LIVES_HEAD`."""

    def shown(life: float) -> str:
        return "-" if math.isnan(life) else "unlimited" if math.isinf(life) else f"{life / 3600.0:.4g} h"

    return [[one.bearing, f"{one.equivalent:.0f} N", shown(one.life)] for one in judged.lives]


def sliding_rows(judged: Judged) -> list[list[str]]:
    """Return the largest sliding at each row of the duty as table rows, columns `SLIDING_HEAD`.

    The place is that of the largest friction power, or of the largest speed without a friction coefficient.
    """
    rows = []
    for load, found in judged.sliding:
        power = found.friction_power
        values = power if power.size else found.sliding_speed
        angle, _, pin = np.unravel_index(values.argmax(), values.shape)
        rows.append(
            [
                f"{load.torque:g} N·m, {load.output_speed * 30.0 / math.pi:.4g} rpm",
                f"{found.sliding_speed.max():.3g} m/s",
                f"{power.max():.3g} W" if power.size else "",
                f"{found.friction_power_density.max() * 1e-6:.3g} W/mm²" if power.size else "",
                f"{pin}, {math.degrees(judged.crank_angle[angle]):.2f}°",
            ]
        )
    return rows
