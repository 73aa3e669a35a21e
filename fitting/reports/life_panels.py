"""Panels of a drive's life: a forecast, a recalibration with its history, and planned visits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.studies.limits import SHOWN
from fitting.ageing.forecast import QUANTILES, Forecast
from fitting.ageing.history import HOUR
from fitting.estimation.parameter import NORMAL
from fitting.recalibration.plan import PlannedVisit
from fitting.recalibration.recalibrate import Recalibration
from fitting.reports.panels import Panel, Trace, band, stems

_BANDS = ((0, 6, "95 %"), (1, 5, "90 %"), (2, 4, "50 %"))  # quantiles of an interval
_MOST = 14  # most errors shown


def forecast_panels(forecast: Forecast) -> list[Panel]:
    """Return each figure over age with its recordings and limit, the probability of exceeding it, and the scores."""
    panels = [_figure_panel(forecast, name) for name in forecast.bands]
    hours, now = forecast.ages / HOUR, np.full(2, forecast.now / HOUR)
    if forecast.remaining:
        lines = [
            Trace(name.replace("_", " "), hours, 100.0 * remaining.probability, "line", number)
            for number, (name, remaining) in enumerate(forecast.remaining.items())
        ]
        mark = Trace("", now, np.array([-2.0, 102.0]), "dashed", -1)
        panels.append(Panel("Probability of exceeding the limit", "age [h]", "[%]", (*lines, mark), ""))
    if forecast.scores.size:
        ages, names = _recorded_ages(forecast), np.array([m.figure for m in forecast.posterior.measured])
        usual = band("95 % of scores", hours[[0, -1]], np.full(2, -NORMAL), np.full(2, NORMAL), -1)
        dots = [
            Trace(name.replace("_", " "), ages[names == name], forecast.scores[names == name], "dots", number)
            for number, name in enumerate(forecast.bands)
        ]
        panels.append(Panel("Score of each recorded figure", "age [h]", "score", (usual, *dots), ""))
    return panels


def _recorded_ages(forecast: Forecast) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([m.crank_turns for m in forecast.posterior.measured]) / forecast.crank_turns_per_second / HOUR


def _figure_panel(forecast: Forecast, name: str) -> Panel:
    unit, factor, _ = SHOWN[name]
    hours, quantiles = forecast.ages / HOUR, forecast.bands[name] * factor
    traces = [band(label, hours, quantiles[low], quantiles[high]) for low, high, label in _BANDS]
    traces.append(Trace("median", hours, quantiles[QUANTILES.index(0.5)], "line"))
    measured = [m for m in forecast.posterior.measured if m.figure == name]
    value, half = (np.array([getattr(m, n) for m in measured]) * factor for n in ("value", "standard_error"))
    low, high = value - NORMAL * half, value + NORMAL * half
    top, least = float(quantiles[-1].max()), float(min(quantiles[0].min(), low.min(initial=np.inf)))
    if measured:
        ages = _recorded_ages(forecast)[[m.figure == name for m in forecast.posterior.measured]]
        traces += [Trace("recorded, ± 95 %", *stems(ages, low, high), "line", -1), Trace("", ages, value, "dots", -1)]
    if (remaining := forecast.remaining.get(name)) is not None:
        limit = remaining.limit * factor
        traces.append(Trace("limit", hours[[0, -1]], np.full(2, limit), "dashed", 3))
        known = {p: age / HOUR for p, age in remaining.ages.items() if np.isfinite(age)}
        if known:
            label = f"exceeded with {', '.join(f'{p:.0%}' for p in known)}"
            traces.append(Trace(label, np.array([*known.values()]), np.full(len(known), limit), "dots", 3))
        top = min(top, 2.5 * limit)  # a wide band must not hide the limit
    room = 0.05 * (top - least)
    limits = least - room, max(top, float(high.max(initial=-np.inf))) + room
    traces.append(Trace("", np.full(2, forecast.now / HOUR), np.array(limits), "dashed", -1))
    title = name.replace("_", " ").capitalize()
    return Panel(title, "age [h]", f"[{unit}]", tuple(traces), "", y_limits=limits)


def recalibration_panels(result: Recalibration) -> list[Panel]:
    """Return figures with 95 % bands over crank turns since the fit, with alarms, and the errors that changed most."""
    turns = np.array([dated.crank_turns for dated in result.history]) / 1e6
    alarms = np.array([bool(dated.alarm) for dated in result.history])
    panels = []
    for name in (n for n in ("backlash", "lost_motion", "transmission_error") if n in result.figures):
        figures = [dated.figures[name] for dated in result.history]
        value = np.array([figure.value for figure in figures]) * ARCSEC
        low, high = np.array([figure.interval for figure in figures]).T * ARCSEC
        traces = [band("95 %", turns, low, high), Trace("", turns, value, "line"), Trace("", turns, value, "dots")]
        if alarms.any():
            traces.append(Trace("alarm: not updated", turns[alarms], value[alarms], "circles", 3))
        title = name.replace("_", " ").capitalize() + (", peak to peak" if name == "transmission_error" else "")
        panels.append(Panel(title, "crank turns since the fit [10⁶]", "[arcsec]", tuple(traces), ""))
    moved = sorted(result.moved.items(), key=lambda item: -abs(item[1][1]))[:_MOST]
    usual = (np.array([-2.0, 2.0]), np.full(2, 0.6 - len(moved)), np.full(2, 0.4))
    bars = [
        Trace("", np.array([0.0, times]), np.full(2, -float(row)), "thick", 3 if result.alarm else 0)
        for row, (_, (_, times)) in enumerate(moved)
    ]
    names = tuple(name.replace("_", " ") for name, _ in moved)
    axis = "change since the last date, in standard deviations of the expected change (grey: ± 2)"
    return [*panels, Panel("", axis, "", (band("", *usual, -1), *bars), "", y_names=names)]


def visits_panel(visits: Sequence[PlannedVisit]) -> Panel:
    """Return the half width of the backlash's interval over the turns of each planned set of runs."""
    traces = []
    for number, visit in enumerate(visits):
        turns, width = np.array([*visit.half_width], float), np.array([*visit.half_width.values()]) * ARCSEC
        traces += [Trace(visit.runs, turns, width, "line", number), Trace("", turns, width, "dots", number)]
    x_label = "output turns of each run, or passages of the mark in each direction"
    y_label = "half width of the backlash's\n95 % interval [arcsec]"
    return Panel("", x_label, y_label, tuple(traces), "", log_x=True, log_y=True)
