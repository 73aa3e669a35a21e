"""The uncertainty budget of each figure by the GUM (JCGM 100:2008): instruments and repeatability.

Sensitivities are found by adding the instrument's error to the recording and computing the figure again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from fitting.figures.figure import Figure, pooled
from fitting.figures.hysteresis import loop_figures
from fitting.figures.instruments import Distribution, Encoder, Instruments, TorqueSensor, standard_uncertainty
from fitting.transmission_error.loops import Lobe, LoopData, find_loops
from fitting.transmission_error.spectrum import RIG_ORDERS, Spectrum, range_of, run_label, without_orders
from fitting.transmission_error.survey import Surveyed

Array = NDArray[np.float64]
# Root of the sum of the squared weights of the readings that make up a figure.
_READINGS = {
    "hysteresis_loss": math.sqrt(2.0),
    "backlash": math.sqrt(3.0),
    "lost_motion": 1.0,
    "angular_transmission_error": math.sqrt(2.0),
    "angular_transmission_error_without_rig": math.sqrt(2.0),
}
COVERAGE = 0.95
_TORQUE_STEP = 0.005  # of the rated torque
_SAMPLES = 20000  # most samples of a loop for sensitivities


@dataclass(frozen=True)
class Contribution:
    """One input quantity of a budget.

    Attributes
    ----------
    source
        The source of uncertainty.
    kind
        Type of evaluation: "A", from the recordings, or "B", from stated values.
    distribution
        Distribution of the input quantity.
    standard_uncertainty, unit
        Standard uncertainty u(x) and its SI unit.
    sensitivity
        Sensitivity coefficient c: change of the figure over change of the quantity, SI.
    degrees
        Degrees of freedom of u(x).
    """

    source: str
    kind: Literal["A", "B"]
    distribution: str
    standard_uncertainty: float
    unit: str
    sensitivity: float
    degrees: float = math.inf

    @property
    def contribution(self) -> float:
        """|c| u(x), in the figure's unit."""
        return abs(self.sensitivity) * self.standard_uncertainty

    @classmethod
    def within(cls, source: str, limit: float, unit: str, sensitivity: float) -> Contribution:
        """Return the contribution of a quantity that is stated to be within ± `limit`."""
        return cls(source, "B", "rectangular", standard_uncertainty(limit, "rectangular"), unit, sensitivity)


@dataclass(frozen=True)
class Budget:
    """The uncertainty budget of a figure.

    Attributes
    ----------
    figure
        Name of the figure.
    value, unit
        Value of the figure and its SI unit.
    contributions
        Contributions of the input quantities, which are uncorrelated.
    """

    figure: str
    value: float
    unit: str
    contributions: tuple[Contribution, ...]

    @property
    def standard_uncertainty(self) -> float:
        """Combined standard uncertainty u_c, SI (JCGM 100, equation 10)."""
        return math.hypot(*(contribution.contribution for contribution in self.contributions))

    @property
    def degrees(self) -> float:
        """Effective degrees of freedom by Welch and Satterthwaite (JCGM 100, equation G.2b)."""
        below = sum(contribution.contribution**4 / contribution.degrees for contribution in self.contributions)
        return self.standard_uncertainty**4 / below if below > 0.0 else math.inf

    @property
    def coverage_factor(self) -> float:
        """Coverage factor k for 95 %: Student's t with the effective degrees of freedom."""
        return student(self.degrees)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty U = k u_c, SI."""
        return self.coverage_factor * self.standard_uncertainty


def student(degrees: float) -> float:
    """Return the two-sided 95 % quantile of Student's t."""
    return 1.959964 if math.isinf(degrees) else float(stdtrit(degrees, 0.5 + 0.5 * COVERAGE))


@dataclass(frozen=True)
class _Wave:
    """An encoder error of one order of the turn, whose sine and cosine have the standard uncertainty `standard`, rad.

    `graduation`: the wave represents the graduation error, which has other orders too.
    """

    source: str
    distribution: str
    standard: float
    order: int
    graduation: bool = False


def _waves(encoder: Encoder | None, name: str) -> list[_Wave]:
    if encoder is None:
        return []
    errors: tuple[tuple[str, float, Distribution, int], ...] = (
        ("accuracy", encoder.accuracy, encoder.distribution, 1),
        ("run-out", encoder.run_out, "arcsine", 1),
        ("subdivision", encoder.subdivision, "arcsine", encoder.periods_per_turn or 1),
    )
    waves = [
        _Wave(f"{name}, {error}", kind, standard_uncertainty(limit, kind), order, error == "accuracy")
        for error, limit, kind, order in errors
    ]
    return [wave for wave in waves if wave.standard > 0.0]


def _loop_values(data: Sequence[LoopData]) -> dict[str, float]:
    of_recordings = [loop_figures(loops)[0] for loops in data]
    names = {name for figures in of_recordings for name in figures}
    return {name: pooled([figures[name] for figures in of_recordings if name in figures]).value for name in names}


def _thinned(data: LoopData, step: int) -> LoopData:
    """Return every `step`-th sample of a long recording, sufficient for sensitivities."""

    def part(of: slice) -> slice:
        return slice(-(-of.start // step), -(-of.stop // step))

    lobes = tuple(Lobe(lobe.sign, part(lobe.loading), part(lobe.unloading)) for lobe in data.lobes)
    return dataclasses.replace(
        data,
        time=data.time[::step],
        torque=data.torque[::step],
        windup=data.windup[::step],
        lobes=lobes,
        loops=tuple(find_loops(lobes)),
        late=None if data.late is None else data.late[::step],
    )


_ByFigure = dict[str, list[Contribution]]


def _of_loops(surveyed: Sequence[Surveyed], instruments: Instruments, ratio: float | None) -> _ByFigure:
    """Return the contributions of encoders and torque sensor to the figures of loops, by name of the figure."""
    data, angles = [], []
    for recording in surveyed:
        if recording.loops is not None:
            step = max(1, recording.loops.time.size // _SAMPLES)
            data.append(_thinned(recording.loops, step))
            overview = recording.overview
            angles.append({"input": overview.input_angle[::step], "output": overview.output_angle[::step]})
    if not data:
        return {}
    nominal = _loop_values(data)
    parts = [_of_loop_encoder("output", instruments.output_encoder, 1.0, data, angles, nominal)]
    if ratio is not None:
        parts.append(_of_loop_encoder("input", instruments.input_encoder, -1.0 / ratio, data, angles, nominal))
    parts.append(_of_loop_torque(instruments.torque_sensor, data, nominal))
    return {name: [row for part in parts for row in part[name]] for name in nominal}


def _sensitivities(
    nominal: Mapping[str, float], changed: Sequence[Sequence[LoopData]], step: float
) -> Iterator[tuple[str, float]]:
    """Yield how much each figure of loops changes with a quantity, per its unit.

    `changed` are the recordings with the quantity, or each of its components, changed by `step`.
    """
    values = [_loop_values(loops) for loops in changed]
    for name, value in nominal.items():
        yield name, math.hypot(*(of.get(name, value) - value for of in values)) / step


def _of_loop_encoder(
    shaft: str,
    encoder: Encoder | None,
    scale: float,
    data: Sequence[LoopData],
    angles: Sequence[Mapping[str, Array]],
    nominal: Mapping[str, float],
) -> _ByFigure:
    """Return the contributions of a shaft's encoder; the windup contains its angle times `scale`."""
    rows: _ByFigure = {name: [] for name in nominal}
    for wave in _waves(encoder, f"{shaft} encoder"):
        changed = [
            [
                dataclasses.replace(loops, windup=loops.windup + scale * wave.standard * of(wave.order * angle[shaft]))
                for loops, angle in zip(data, angles, strict=True)
            ]
            for of in (np.cos, np.sin)
        ]
        for name, sensitivity in _sensitivities(nominal, changed, wave.standard):
            rows[name].append(Contribution(wave.source, "B", wave.distribution, wave.standard, "rad", sensitivity))
    if encoder is not None and encoder.resolution > 0.0:
        rated = max(loops.rated_torque for loops in data)
        for name, value in nominal.items():
            # Stiffness: torque over the difference of two readings, mean of two sides.
            readings = abs(scale) * _READINGS.get(name, value**2 / (0.5 * rated))
            source = f"{shaft} encoder, resolution"
            rows[name].append(Contribution.within(source, 0.5 * encoder.resolution, "rad", readings))
    return rows


def _of_loop_torque(sensor: TorqueSensor | None, data: Sequence[LoopData], nominal: Mapping[str, float]) -> _ByFigure:
    """Return the contributions of the torque sensor's accuracy class and zero."""
    rows: _ByFigure = {name: [] for name in nominal}
    if sensor is None:
        return rows
    rated = max(loops.rated_torque for loops in data)
    for (source, limit), (gain, offset) in zip(_torque_errors(sensor), ((1.0 / rated, 0.0), (0.0, 1.0)), strict=True):
        if limit > 0.0:
            # With a smaller step, the effect of noisy samples entering or leaving an interval would dominate.
            by = max(standard_uncertainty(limit, "rectangular"), _TORQUE_STEP * rated)
            more = [dataclasses.replace(loops, torque=loops.torque * (1.0 + gain * by) + offset * by) for loops in data]
            for name, sensitivity in _sensitivities(nominal, [more], by):
                rows[name].append(Contribution.within(f"torque sensor, {source}", limit, "N*m", sensitivity))
    return rows


def _torque_errors(sensor: TorqueSensor) -> list[tuple[str, float]]:
    """Return the sources of a torque sensor's errors with their limits, N·m: the class, at its range, and the zero."""
    return [(f"class {sensor.accuracy_class:g}", 0.01 * sensor.accuracy_class * sensor.range), ("zero", sensor.zero)]


def _of_orders(
    name: str,
    figure: Figure,
    surveyed: Sequence[Surveyed],
    spectra: Sequence[Spectrum | None],
    instruments: Instruments,
) -> list[Contribution]:
    """Return the contributions of the encoders to an angular transmission error, for the run with the largest one."""
    largest = next(label for label, run in figure.runs.items() if run.value == figure.value)
    labelled = [(run_label(recording.source, c), c) for recording in surveyed for c in recording.curves]
    (curve, orders), *_ = (
        (c, s) for (label, c), s in zip(labelled, spectra, strict=True) if s is not None and label == largest
    )
    left_out = RIG_ORDERS if name == "angular_transmission_error_without_rig" else ()
    remaining = without_orders(orders, left_out)
    coefficient: NDArray[np.complex128] = np.where(remaining.significant, remaining.coefficient, 0.0)
    points = 1 << max(12, math.ceil(math.log2(8 * coefficient.size)))
    nominal, contributions = float(range_of(coefficient, points)[0]), []
    for shaft, encoder, scale, turns in (
        ("output", instruments.output_encoder, 1.0, 1.0),
        ("input", instruments.input_encoder, 1.0 / abs(curve.ratio), abs(curve.ratio)),
    ):
        for wave in _waves(encoder, f"{shaft} encoder"):
            order = round(wave.order * turns)
            while wave.graduation and order in left_out:
                order += round(turns)  # the whole graduation error may be in an order that is not left out
            moved = 0.0
            if order < coefficient.size and order not in left_out:
                # With many equally high peaks, a wave of either sign increases the range: use the larger change.
                for part in (1.0, 1j):
                    step = np.zeros_like(coefficient)
                    step[order] = scale * wave.standard * part
                    changes = [float(range_of(coefficient + sign * step, points)[0]) - nominal for sign in (1.0, -1.0)]
                    moved = math.hypot(moved, max(map(abs, changes)))
            contributions.append(
                Contribution(wave.source, "B", wave.distribution, wave.standard, "rad", moved / wave.standard)
            )
        if encoder is not None and encoder.resolution > 0.0:
            source, readings = f"{shaft} encoder, resolution", scale * _READINGS[name]
            contributions.append(Contribution.within(source, 0.5 * encoder.resolution, "rad", readings))
    return contributions


def _of_start(name: str, figure: Figure, sensor: TorqueSensor | None) -> list[Contribution]:
    """Return the contributions of the torque sensor to a starting torque, which is its reading."""
    if sensor is None:
        return []
    where = "torque sensor" if name == "back_driving_torque" else "input torque sensor"
    sensitivities = (min(1.0, abs(figure.value) / sensor.range), 1.0)
    return [
        Contribution.within(f"{where}, {source}", limit, "N*m", sensitivity)
        for (source, limit), sensitivity in zip(_torque_errors(sensor), sensitivities, strict=True)
        if limit > 0.0
    ]


def budgets_of(
    figures: Mapping[str, Figure],
    surveyed: Sequence[Surveyed],
    spectra: Sequence[Spectrum | None],
    instruments: Instruments,
    ratio: float | None,
    progress: Callable[[str], None] = lambda step: None,
) -> dict[str, Budget]:
    """Return the uncertainty budget of each figure.

    Parameters
    ----------
    figures, surveyed, spectra
        As in `Figures`.
    instruments
        The stated instruments of the bench.
    ratio
        Signed ratio input/output; without it, budgets of loops do not include the input encoder.
    progress
        Called with the name of the stage.

    Returns
    -------
    budgets
        Budgets by name of the figure; figures of unknown repeatability (a single start) have none.
    """
    progress("uncertainty budgets")
    loops = _of_loops(surveyed, instruments, ratio if ratio is not None else surveyed[0].overview.ratio)
    budgets = {}
    for name, figure in figures.items():
        if not math.isfinite(figure.uncertainty):
            continue
        repeated = figure.uncertainty / student(figure.degrees)
        source = f"repeatability, {figure.count:.4g} {figure.counted}"
        distribution = "t" if figure.degrees < 1e6 else "normal"
        rows = [Contribution(source, "A", distribution, repeated, figure.unit, 1.0, figure.degrees)]
        rows += loops.get(name, [])
        if figure.runs:
            rows += _of_orders(name, figure, surveyed, spectra, instruments)
        if name == "starting_torque":
            rows += _of_start(name, figure, instruments.input_torque_sensor)
        if name == "back_driving_torque":
            rows += _of_start(name, figure, instruments.torque_sensor)
        warm = instruments.thermometer
        if warm is not None and warm.coefficient(name) and warm.limit > 0.0:
            rows.append(Contribution.within("temperature", warm.limit, "K", warm.coefficient(name)))
        budgets[name] = Budget(name, figure.value, figure.unit, tuple(rows))
    return budgets


def budget_json(budget: Budget) -> dict[str, Any]:
    """Return a budget as part of a `cycloid-figures/1` file (SI); infinite degrees of freedom are null."""

    def finite(degrees: float) -> float | None:
        return degrees if math.isfinite(degrees) else None

    same = ("source", "distribution", "standard_uncertainty", "unit", "sensitivity", "contribution")
    return {
        "combined_standard_uncertainty": budget.standard_uncertainty,
        "degrees_of_freedom": finite(budget.degrees),
        "coverage_factor": budget.coverage_factor,
        "expanded_uncertainty": budget.expanded,
        "contributions": [
            {name: getattr(contribution, name) for name in same}
            | {"type": contribution.kind, "degrees_of_freedom": finite(contribution.degrees)}
            for contribution in budget.contributions
        ],
    }


def field_factor(unit: str) -> tuple[float, str]:
    """Return the factor from SI to the field unit of a budget, and that unit."""
    return {
        "rad": (edge.ARCSEC, "arcsec"),
        "N*m": (1.0, "N·m"),
        "K": (1.0, "K"),
        "N*m/rad": (1.0 / edge.ARCMIN, "N·m/arcmin"),
    }[unit]


def budget_rows(budget: Budget) -> list[list[str]]:
    """Return a budget as table rows: source, type, distribution, u(x), |c| u(x) and degrees, the largest first."""
    factor, unit = field_factor(budget.unit)

    def degrees(value: float) -> str:
        return "∞" if value > 1e6 else f"{value:.3g}"

    def shown(of: Contribution, number: float) -> str:
        return f"{number:.3g}" if of.contribution > 1e-6 * budget.standard_uncertainty else "0"

    rows = []
    for contribution in sorted(budget.contributions, key=lambda c: -c.contribution):
        own, of = field_factor(contribution.unit)
        rows.append(
            [
                contribution.source,
                contribution.kind,
                contribution.distribution,
                f"{contribution.standard_uncertainty * own:.3g} {of}",
                shown(contribution, contribution.sensitivity * factor / own),
                f"{shown(contribution, contribution.contribution * factor)} {unit}",
                degrees(contribution.degrees),
            ]
        )
    combined, expanded = (f"{value * factor:.3g} {unit}" for value in (budget.standard_uncertainty, budget.expanded))
    rows.append(["combined", "", "", "", "", combined, degrees(budget.degrees)])
    rows.append([f"expanded, k = {budget.coverage_factor:.2f} (95 %)", "", "", "", "", expanded, ""])
    return rows


BUDGET_HEAD = ["source", "type", "distribution", "u(x)", "sensitivity", "contribution", "degrees of freedom"]
