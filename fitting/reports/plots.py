"""Plots of recordings, curves, figures, fits, plans and forecasts: the panels of each kind of result, drawn."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.draw.figure import save
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.structured import unit_of
from fitting.ageing.forecast import Forecast
from fitting.estimation.plan import Plan
from fitting.estimation.realised import Realised
from fitting.estimation.result import Identification
from fitting.figures.comparison import Comparison
from fitting.figures.friction import FrictionFit
from fitting.figures.maps import FORMAT as MAPS
from fitting.figures.metrics import Figures
from fitting.model.prior import TOLERANCE
from fitting.readers.inspection import Inspection
from fitting.recalibration.plan import PlannedVisit
from fitting.recalibration.recalibrate import Recalibration
from fitting.reports.curve_panels import band_panels, comparison_panels, curve_panels
from fitting.reports.drawing import plot_panels
from fitting.reports.friction_panels import friction_panels
from fitting.reports.life_panels import forecast_panels, recalibration_panels, visits_panel
from fitting.reports.maps_report import map_panels
from fitting.reports.panels import Panel, Trace, apart, panels_of
from fitting.reports.ring import ring_panel
from fitting.transmission_error.curve import Curve

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_LEAST_CHANGE = 1.0  # %: an axis of changes covers at least this much on either side
_CHANNELS = 8  # most channels of a bench file that are shown


def plot(result: object, path: str | os.PathLike[str] | None = None) -> Figure:
    """Plot a result, and write the plot to a file if a path is given.

    Parameters
    ----------
    result
        Result of `fitting.curves`, `metrics`, `friction`, `maps`, `compare`, `identify`, `plan`, `inspect`, a
        forecast or `fitting.recalibration`, or the pins and teeth of an identification, `result.realised`.
    path
        File to write, `.png` or `.pdf`.

    Raises
    ------
    edge.InputError
        If there is no plot of such a result, or the name has another ending.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 39, 2000)
    >>> run = fitting.Run(input_angle=angle, output_angle=-angle / 39 + 1e-5 * np.cos(angle), torque=20.0)
    >>> len(fitting.plot(fitting.curves(run, -39.0)).axes)
    2
    """
    kinds: list[tuple[type, Callable[[Any], list[Panel]]]] = [
        (Figures, panels_of),
        (FrictionFit, friction_panels),
        (Comparison, lambda comparison: [changes_panel(comparison)]),
        (Identification, lambda fit: _comparison(fit.curves, fit.fitted_curves, "fitted")),
        (Realised, lambda ring: [ring_panel(ring)]),
        (Inspection, channel_panels),
        (Curve, curve_panels),
        (Plan, lambda plans: [plans_panel(plans)]),
        (Forecast, forecast_panels),
        (Recalibration, recalibration_panels),
        (PlannedVisit, lambda visits: [visits_panel(visits)]),
    ]
    first = result[0] if isinstance(result, list | tuple) and result else result
    panels = next((panels for kind, panels in kinds if isinstance(first, kind)), None)
    if getattr(first, "attrs", {}).get("format") == MAPS:
        panels = _whole_maps
    if panels is None:
        raise edge.InputError(f"result: there is no plot of {type(first).__name__}.")
    alarm = result.alarm if isinstance(result, Forecast) else None
    figure = plot_panels(panels(result), "" if alarm is None else textwrap.fill(alarm.sentence, 120))
    if path is not None:
        save(figure, path)
    return figure


def plot_comparison(
    curves: Sequence[Curve], simulated: Sequence[Array], label: str, *, crank_turns: float = 3.0
) -> Figure:
    """Plot measured and simulated transmission error on one axis, and their differences below.

    Parameters
    ----------
    curves
        Measured curves.
    simulated
        Simulated transmission error at the same angles, with the bench's zeros, rad.
    label
        Name of the simulation in the legend.
    crank_turns
        Range of the upper axis; the residuals below, one row per curve, cover the whole output turn.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 39, 2000)
    >>> run = fitting.Run(input_angle=angle, output_angle=-angle / 39 + 1e-5 * np.cos(angle), torque=20.0)
    >>> (curve,) = fitting.curves(run, -39.0)
    >>> len(fitting.plot_comparison([curve], [1e-5 * np.cos(curve.input_angle)], "simulated").axes)
    2
    """
    return plot_panels(_comparison(curves, simulated, label, crank_turns))


def _comparison(
    curves: Sequence[Curve], simulated: Sequence[Array], label: str, crank_turns: float = 3.0
) -> list[Panel]:
    both, residual = comparison_panels(curves, simulated, label, crank_turns)
    return [both, *apart(residual)]


def _whole_maps(maps: xr.Dataset) -> list[Panel]:
    """Return the panels of maps without those of orders."""
    return [panel for panel in map_panels(maps) if not panel.title.startswith("Order")]


def _readable(name: str) -> str:
    """Return a readable name of a structured error: `pin_radial_2_cos` is "pin radial, order 2, cos"."""
    wave = re.fullmatch(r"(.+)_(\d+)_(cos|sin)", name)
    return (f"{wave[1]}, order {wave[2]}, {wave[3]}" if wave else name).replace("_", " ").replace(".", ", ")


def changes_panel(comparison: Comparison) -> Panel:
    """Return each figure's change in percent of its old value with its 95 % interval; significant ones are filled."""
    traces = []
    widest = _LEAST_CHANGE
    for row, change in enumerate(comparison.changes):
        share = 100.0 / abs(change.before.value) if change.before.value else np.nan
        at, y = np.array([change.difference * share]), np.array([-float(row)])
        half = 0.0 if np.isnan(change.uncertainty) else change.uncertainty * share
        traces.append(Trace("", np.array([at[0] - half, at[0] + half]), np.repeat(y, 2), "line", 0))
        traces.append(Trace("", at, y, "dots" if change.moved else "circles", 0))
        widest = max(widest, 1.05 * float(np.nan_to_num(abs(at[0]) + half)))
    rows = tuple(_readable(change.name) for change in comparison.changes)
    zero = Trace("", np.zeros(2), np.array([0.5, 0.5 - len(rows)]), "thin", -1)
    axis = "change [%]; filled: larger than its uncertainty"
    return Panel("", axis, "", (zero, *traces), "", y_names=rows, x_limits=(-widest, widest))


def channel_panels(inspection: Inspection) -> list[Panel]:
    """Return channels of a bench file over time, those with a proposed role first."""
    role_of = {channel.channel.name: role for role, channel in inspection.roles.items()}
    clock = inspection.roles.get("time")
    shown = [channel for channel in inspection.looks if channel is not clock]
    panels = []
    for look in sorted(shown, key=lambda channel: channel.channel.name not in role_of)[:_CHANNELS]:
        step = max(1, look.values.size // 20000)
        x, label = np.arange(float(look.values.size)), "sample"
        if look.time is not None:
            x, label = look.time, "time [s]"
        elif clock is not None:
            x, label = clock.values, f"{clock.channel.name} [{clock.channel.unit or 'no unit'}]"
        role = role_of.get(look.channel.name)
        title = look.channel.name + (f": {role}?" if role else "")
        line = Trace("", x[::step], look.values[::step], "thin")
        panels.append(Panel(title, label, look.channel.unit or "no unit", (line,), ""))
    return panels


def plans_panel(plans: Sequence[Plan]) -> Panel:
    """Return the standard errors of errors, pins and teeth for each set of runs, relative to their tolerances.

    Errors that no set of runs resolves have no row; the label of the axis lists them.
    """
    each = {f"{name}, each": name for name in plans[-1].realised}
    names = [*plans[-1].standard_error, *plans[-1].held, *each]
    errors = [{**p.standard_error, **{label: p.realised[name] for label, name in each.items()}} for p in plans]
    unknown = [n for n in names if not any(np.isfinite(error.get(n, np.nan)) for error in errors)]
    names = [n for n in names if n not in unknown]
    rows, traces = -np.arange(float(len(names))), []
    for number, (plan, error) in enumerate(zip(plans, errors, strict=True)):
        share = [error.get(n, np.nan) / TOLERANCE["m" if n in each else unit_of(n)] for n in names]
        shift = 0.5 * (number - 0.5 * (len(plans) - 1)) / len(plans)  # so that equal values do not cover each other
        traces.append(Trace(plan.runs, np.array(share), rows - shift, "dots", number))
    axis, readable = "standard error relative to its prior (smaller is better)", tuple(_readable(n) for n in names)
    if unknown:
        axis += "\n" + textwrap.fill(f"not resolved by any set: {'; '.join(_readable(n) for n in unknown)}", 100)
    return Panel("", axis, "", tuple(traces), "", log_x=True, y_names=readable, y_limits=(rows[-1] - 0.6, 0.6))


def plot_band(drive: Drive, drawn: Sequence[Drive], torque: float, path: str | os.PathLike[str]) -> None:
    """Plot the transmission error of the identified drive at a torque, N·m, and the 95 % band of the drawn ones."""
    save(plot_panels(band_panels(drive, drawn, torque)), path)
