"""One standard figure: definition, value and 95 % uncertainty; pooling, display and writing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from cycloid_fmu.geometry.pair import LOST_MOTION


class Definition(NamedTuple):
    """What a figure is: SI unit, and definition in words."""

    unit: str
    text: str


DEFINITIONS = {
    "hysteresis_loss": Definition(
        "rad",
        "distance of the two unloading branches, each extrapolated to zero torque by a straight line "
        "over the interval on its own side (Nabtesco)",
    ),
    "backlash": Definition(
        "rad",
        "hysteresis loss minus twice the dry friction torque over the stiffness: minus the mean distance of "
        "loading and unloading branch at ±50 % of the rated torque",
    ),
    "lost_motion": Definition("rad", f"{LOST_MOTION}, mean of loading and unloading branch (Nabtesco)"),
    "torsional_stiffness": Definition(
        "N*m/rad", "torque over windup along the loading branches in the interval, mean of both sides"
    ),
    "loading_stiffness": Definition(
        "N*m/rad",
        "rise of the torque over that of the windup between the ends of the interval, loading "
        "branches, mean of both sides; friction that grows with load is part of it",
    ),
    "starting_torque": Definition(
        "N*m",
        "largest torque on the input, the output without load, from a standstill until the crank has "
        "turned 1 degree, mean of the starts (no-load starting torque)",
    ),
    "back_driving_torque": Definition(
        "N*m",
        "largest torque on the output, while it drives, from a standstill until the crank has "
        "turned 1 degree, mean of the starts (overhauling starting torque)",
    ),
    "angular_transmission_error": Definition(
        "rad",
        "largest minus smallest value over one output turn, in one direction, of the curve "
        "averaged over turns and made of the orders above the noise (GB/T 35089); the largest of the runs",
    ),
    "angular_transmission_error_without_rig": Definition(
        "rad",
        "angular transmission error of the curve without the orders of the rig: "
        "1, 2 and 3 of the output turn, run-out and couplings; the drive's "
        "own part in these orders is removed too",
    ),
}


def unit_of_figure(name: str) -> str:
    """Return the SI unit of a standard figure.

    Raises
    ------
    ValueError
        If there is no such figure; it lists them.
    """
    if name not in DEFINITIONS:
        raise ValueError(f"{name} is not a figure; the figures are {', '.join(DEFINITIONS)}")
    return DEFINITIONS[name].unit


@dataclass(frozen=True)
class Figure:
    """One figure, SI.

    Attributes
    ----------
    value, uncertainty
        Value and half width of its 95 % interval; NaN if unknown, such as without repetition.
    unit
        SI unit of both.
    definition
        Definition of the figure in words.
    interval
        Interval of the curve in which the figure is evaluated, in `interval_unit`; None if there is none.
    interval_unit
        "N*m" of torque or "rad" of the output.
    count, counted
        Number of loops, turns or starts, and which of these.
    parts
        The same figure from parts of the data: `forward` and `backward`, or `positive` and `negative`.
    runs
        {run: the figure of this run} if there are several runs.
    segments
        {"K1": the figure in this torque range, ...}; each states its interval.
    degrees
        Degrees of freedom of the uncertainty; finite if it is from the scatter of loops or starts.
    remark
        What the value contains on this drive, if its definition does not say so; mostly empty.
    """

    value: float
    uncertainty: float
    unit: str
    definition: str
    interval: tuple[float, float] | None
    interval_unit: str
    count: float
    counted: str
    parts: dict[str, Figure] = field(default_factory=dict)
    runs: dict[str, Figure] = field(default_factory=dict)
    segments: dict[str, Figure] = field(default_factory=dict)
    degrees: float = math.inf
    remark: str = ""

    @property
    def shown(self) -> dict[str, Figure]:
        """Parts, segments and runs by the names under which a table shows them."""
        between = {
            f"{name}, {segment.interval[0]:.4g} … {segment.interval[1]:.4g} N·m": segment
            for name, segment in self.segments.items()
            if segment.interval is not None
        }
        return {**self.parts, **between, **{Path(run).name: figure for run, figure in self.runs.items()}}


def half_interval_of_mean(values: Sequence[float]) -> float:
    """Return half the 95 % interval of the mean of two or more values, by their scatter and Student's t."""
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) * float(stdtrit(len(values) - 1, 0.975))


def pooled(figures: Sequence[Figure]) -> Figure:
    """Return the mean of a figure over several recordings, weighted by their numbers of loops."""
    if len(figures) == 1:
        return figures[0]
    weight = np.array([f.count for f in figures]) / sum(f.count for f in figures)
    values = np.array([f.value for f in figures])
    value = float(weight @ values)
    uncertainty = float(np.sqrt(np.sum((weight * [f.uncertainty for f in figures]) ** 2)))
    degrees = min(f.degrees for f in figures)
    if len(figures) > 2:
        scatter = half_interval_of_mean([f.value for f in figures])
        if scatter > uncertainty:
            uncertainty, degrees = scatter, len(figures) - 1.0
    first = figures[0]
    parts = {
        side: pooled([f.parts[side] for f in figures if side in f.parts])
        for side in {s: None for f in figures for s in f.parts}
    }
    segments = {
        name: pooled(
            [f.segments[name] for f in figures if name in f.segments and f.segments[name].interval == interval]
        )
        for name, interval in {n: segment.interval for f in figures for n, segment in f.segments.items()}.items()
    }
    return dataclasses.replace(
        first,
        value=value,
        uncertainty=uncertainty,
        count=sum(f.count for f in figures),
        parts=parts,
        runs={},
        segments=segments,
        degrees=degrees,
        remark="",
    )


_FIELD_UNITS = {
    "rad": (10800.0 / math.pi, "arcmin"),
    "N*m/rad": (math.pi / 10800.0, "N·m/arcmin"),
    "N*m": (1.0, "N·m"),
    "1": (1.0, ""),
    "N*m*s/rad": (1.0, "N·m·s/rad"),
    "rad/s": (1.0, "rad/s"),
    "kg*m^2": (1.0, "kg·m²"),
}


def in_field_units(figure: Figure, like: Figure | None = None) -> tuple[str, str, str]:
    """Return value, uncertainty and unit as texts for reports; angles in arcmin, or in arcsec below one arcmin.

    Value and uncertainty are shown to two significant digits of the uncertainty. `like`: the figure that determines the
    unit, so that several can be shown together.
    """
    factor, unit = _FIELD_UNITS[figure.unit]
    if unit == "arcmin" and abs((like or figure).value) * factor < 1.0:
        factor, unit = factor * 60.0, "arcsec"
    value, uncertainty = figure.value * factor, figure.uncertainty * factor
    if not math.isfinite(uncertainty):
        return f"{value:.4g}", "unknown", unit
    digits = 6 if uncertainty <= 0.0 else min(max(1 - math.floor(math.log10(uncertainty)), 0), 6)
    return f"{value:.{digits}f}", f"{uncertainty:.{digits}f}", unit


def figure_json(figure: Figure) -> dict[str, Any]:
    """Return one figure as the content of a `cycloid-figures/1` file (SI)."""
    names = ("value", "uncertainty", "unit", "definition", "interval", "interval_unit")
    content = {name: getattr(figure, name) for name in names} | {figure.counted: figure.count}
    if figure.remark:
        content["remark"] = figure.remark
    content.update({side: figure_json(part) for side, part in figure.parts.items()})
    if figure.segments:
        content["segments"] = {name: figure_json(segment) for name, segment in figure.segments.items()}
    if figure.runs:
        content["runs"] = {name: figure_json(run) for name, run in figure.runs.items()}
    return content
