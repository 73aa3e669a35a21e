"""History of one drive: its duty, the prior of its wear, and its dated recordings (`cycloid-history/1`)."""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.sizes import PositiveLength
from fitting.ageing.life import FIGURES
from fitting.ageing.posterior import Measured
from fitting.estimation.parameter import NORMAL
from fitting.figures.comparison import read_figures
from fitting.figures.figure import Figure
from fitting.figures.metrics import metrics
from fitting.readers.sources import Mappings, read_recordings

FORMAT = "cycloid-history/1"
HOUR = 3600.0
_ABOVE_ZERO = pydantic.Field(gt=0.0, allow_inf_nan=False)
_PositiveAngle = Annotated[edge.Angle, _ABOVE_ZERO]
_PositiveTime = Annotated[edge.Seconds, _ABOVE_ZERO]
_Age = Annotated[edge.Seconds, pydantic.Field(ge=0.0, allow_inf_nan=False)]
_Factor = Annotated[float, pydantic.Field(gt=1.0, le=1000.0)]


class PerFigure(edge.Config):
    """A value for each figure of a forecast.

    Attributes
    ----------
    lost_motion, backlash, angular_transmission_error
        Value of the figure, rad.
    """

    lost_motion: _PositiveAngle | None = None
    backlash: _PositiveAngle | None = None
    angular_transmission_error: _PositiveAngle | None = None

    def stated(self) -> dict[str, float]:
        """Return the stated values by name."""
        return {name: value for name in FIGURES if (value := getattr(self, name)) is not None}


class WornBearing(edge.Config):
    """A bearing of `[supports]` whose clearance grows in proportion to the crank turns.

    Attributes
    ----------
    name
        Of the bearing.
    clearance_growth, within
        Median growth of the diametral clearance (m) within a running time (s).
    factor
        95 % interval of the growth: from the median divided by this to the median times this.
    """

    name: Literal["turning_arm", "crank_shaft", "main", "output_roller"]
    clearance_growth: PositiveLength
    within: _PositiveTime
    factor: _Factor = 10.0


class Recorded(edge.Config):
    """Recordings at one age: a file of figures, recordings, or the figures themselves.

    Attributes
    ----------
    age
        Running time of the drive since new, s; or:
    date
        The day, counted from `in_service`.
    figures
        Output file of `cycloid-fit metrics -o`, relative to the history's file.
    recordings
        Recordings from which the figures are computed.
    lost_motion, backlash, angular_transmission_error
        The figure and half its 95 % interval, rad.
    """

    age: _Age | None = None
    date: datetime.date | None = None
    figures: str | None = None
    recordings: tuple[str, ...] = ()
    lost_motion: tuple[edge.Angle, _PositiveAngle] | None = None
    backlash: tuple[edge.Angle, _PositiveAngle] | None = None
    angular_transmission_error: tuple[edge.Angle, _PositiveAngle] | None = None

    @pydantic.model_validator(mode="after")
    def _dated_once(self) -> Recorded:
        if (self.age is None) == (self.date is None):
            raise ValueError('either age = "1200 h" or date = 2026-03-01 is needed')
        own = any(getattr(self, name) is not None for name in FIGURES)
        if (self.figures is not None) + bool(self.recordings) + own != 1:
            raise ValueError("state one of figures, recordings, or the figures themselves")
        return self


class History(edge.Config):
    """History of one drive.

    Attributes
    ----------
    crank_turns_per_hour
        Of running; ages are running times.
    torque
        On the output, N·m: the load that causes the wear, instead of `[[wear.duty]]` of the wear file.
    coefficient_factor
        95 % interval of the prior of the wear coefficient: the wear file's divided by this to times this.
    load_scatter, load_period
        Variation of the loads: relative standard deviation of the wear in one such period (s), independent of others.
    in_service, hours_per_day
        Day on which the drive was new, and its running hours a day, for recordings with a date.
    limits
        Largest allowed figures, for the remaining life.
    offsets
        Standard deviation of the difference between the figures of bench and model, the same at every age.
    bearing
        The bearing that wears; None for none.
    recorded
        The dated recordings.
    """

    crank_turns_per_hour: float = pydantic.Field(gt=0.0, le=1e7)
    torque: edge.Torque | None = None
    coefficient_factor: _Factor = 10.0
    load_scatter: float = pydantic.Field(default=0.1, ge=0.0, le=1.0)
    load_period: _PositiveTime = 100.0 * HOUR
    in_service: datetime.date | None = None
    hours_per_day: float | None = pydantic.Field(default=None, gt=0.0, le=24.0)
    limits: PerFigure = PerFigure()
    offsets: PerFigure = PerFigure()
    bearing: WornBearing | None = None
    recorded: tuple[Recorded, ...] = ()

    @pydantic.model_validator(mode="after")
    def _ages_known(self) -> History:
        dated = [entry.date for entry in self.recorded if entry.date is not None]
        if not dated:
            return self
        if self.in_service is None or self.hours_per_day is None:
            raise ValueError("recordings with a date need in_service and hours_per_day")
        if early := next((day for day in dated if day < self.in_service), None):
            raise ValueError(f"recorded date {early} is before in_service {self.in_service}")
        return self

    def age_of(self, entry: Recorded) -> float:
        """Return the running time of the drive when something was recorded, s."""
        if entry.date is None or self.in_service is None:
            return entry.age or 0.0
        return (entry.date - self.in_service).days * (self.hours_per_day or 0.0) * HOUR


def read_history(path: str | os.PathLike[str]) -> History:
    """Return the history that a file states; an `edge.InputError` names errors in it."""
    return edge.validated(History, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path)), str(path))


def measured(
    history: History,
    drive: Drive,
    folder: str | os.PathLike[str] = ".",
    *,
    mapping: Mappings | None = None,
    source: str = "history",
    progress: Callable[[str], None] = lambda step: None,
) -> list[Measured]:
    """Return the figures of all recordings, by age.

    Parameters
    ----------
    history, drive
        The history, and the drive, for ratio and rated torque.
    folder
        Folder of the history's file, to which its paths are relative.
    mapping
        Of the channels, for recordings of other benches, as in `read_recordings`.
    source
        The history's file, for messages.
    progress
        Called with the name of each step.

    Raises
    ------
    edge.InputError
        If a file can't be read, or has none of the figures with an uncertainty.
    """
    figures: list[Measured] = []
    for number, entry in enumerate(history.recorded):
        turns = history.age_of(entry) / HOUR * history.crank_turns_per_hour
        where = f"{source}: recorded[{number}]"
        if entry.figures is not None:
            where = str(Path(folder) / entry.figures)
            rows = _rows(read_figures(where))
        elif entry.recordings:
            files = [Path(folder) / name for name in entry.recordings]
            where = ", ".join(map(str, files))
            rows = _rows(metrics(read_recordings(files, mapping), drive, progress=progress).figures)
        else:
            rows = [(name, *stated) for name in FIGURES if (stated := getattr(entry, name)) is not None]
        if not rows:
            raise edge.InputError(
                f"{where}: none of {', '.join(FIGURES)} is there with an uncertainty; record three turns or loops."
            )
        # Of few loops an interval is wider, and stays so.
        figures += [Measured(turns, name, value, half / NORMAL, where) for name, value, half in rows]
    return sorted(figures, key=lambda m: m.crank_turns)


def _rows(figures: Mapping[str, Figure]) -> list[tuple[str, float, float]]:
    """Return names, values and half 95 % intervals of the figures of a forecast.

    The uncertainty of the instruments is the same at every age, so it is part of the offset.
    """
    return [
        (name, figure.value, figure.uncertainty)
        for name in FIGURES
        if (figure := figures.get(name)) is not None
        and 0.0 < figure.uncertainty < math.inf
        and math.isfinite(figure.value)
    ]
