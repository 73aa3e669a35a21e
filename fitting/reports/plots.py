"""Plots of recordings, curves, figures, fits and plans."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.draw.figure import new_figure, save, show_legend
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.surfaces.structured import unit_of
from fitting.ageing.forecast import Forecast
from fitting.estimation.plan import Plan
from fitting.estimation.realised import Realised
from fitting.estimation.result import Identification
from fitting.figures.comparison import Change, Comparison
from fitting.figures.friction import FrictionFit
from fitting.figures.maps import FORMAT as MAPS
from fitting.figures.metrics import Figures
from fitting.model.prior import TOLERANCE
from fitting.readers.first_samples import FirstSamples
from fitting.readers.inspection import Inspection
from fitting.recalibration.plan import PlannedVisit
from fitting.recalibration.recalibrate import Recalibration
from fitting.reports.forecast_plot import plot_forecast
from fitting.reports.friction_panels import friction_panels
from fitting.reports.life_plots import plot_recalibration, plot_visits
from fitting.reports.maps_report import map_panels
from fitting.reports.panels import Panel, label_of, names_above, panels_of, x_range
from fitting.reports.ring import ring_panel
from fitting.transmission_error.curve import Curve

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


_LEAST_CHANGE = 1.0  # %: an axis of changes covers at least this much on either side
_WIDTHS = {"line": 1.2, "thin": 0.8, "dashed": 1.0, "thick": 2.5}


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
    pictures: list[tuple[type, Callable[[Any], Figure]]] = [
        (Figures, lambda found: plot_panels(panels_of(found))),
        (FrictionFit, lambda found: plot_panels(friction_panels(found))),
        (Comparison, lambda found: plot_changes(found.changes)),
        (Identification, plot_identification),
        (Realised, plot_ring),
        (Inspection, lambda found: plot_channels(found.looks, found.roles)),
        (Curve, plot_curves),
        (Plan, plot_plans),
        (Forecast, plot_forecast),
        (Recalibration, plot_recalibration),
        (PlannedVisit, plot_visits),
    ]
    one = result[0] if isinstance(result, list | tuple) and result else result
    draw = next((draw for kind, draw in pictures if isinstance(one, kind)), None)
    if getattr(one, "attrs", {}).get("format") == MAPS:
        draw = plot_maps
    if draw is None:
        raise edge.InputError(f"result: there is no plot of {type(one).__name__}.")
    figure = draw(result)
    if path is not None:
        save(figure, path)
    return figure


def draw_panel(axis: Axes, panel: Panel) -> None:
    """Draw one panel of a report."""
    for trace in panel.traces:
        colour = "0.45" if trace.colour < 0 else f"C{trace.colour % 10}"
        if trace.style == "points":
            size, colour = (4.0, "0") if trace.texts else (1.0, "0.45")
            axis.plot(trace.x, trace.y, ".", ms=size, color=colour, label=trace.label or None)
            for x, y, text in zip(trace.x, trace.y, () if panel.log_x else trace.texts, strict=False):
                axis.annotate(text, (x, y), (0, 3), textcoords="offset points", rotation=60, fontsize=7)
            continue
        if trace.style == "dots":
            axis.plot(trace.x, trace.y, ".", ms=4.0, color=colour, label=trace.label or None)
            continue
        if trace.style == "words":
            axis.plot(trace.x, trace.y, " ")  # texts do not extend the axes
            for x, y, text in zip(trace.x, trace.y, trace.texts, strict=True):
                axis.annotate(text, (x, y), ha="center", va="center", fontsize=7)
            continue
        style, width = "--" if trace.style == "dashed" else "-", _WIDTHS[trace.style]
        cap = "butt" if trace.style == "thick" else "projecting"  # a bar is as long as its value
        axis.plot(trace.x, trace.y, style, lw=width, solid_capstyle=cap, color=colour, label=trace.label or None)
    axis.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.from_zero:
        ends = [float(end(t.y[np.isfinite(t.y)], initial=0.0)) for t in panel.traces for end in (np.min, np.max)]
        room = 0.05 * (max(ends) - min(ends))
        axis.set_ylim(min(ends) - room * (min(ends) < 0.0), max(ends) + room)
    if panel.log_y:
        axis.set_yscale("log")
    if panel.log_x:
        axis.set(xscale="log", xlim=x_range(panel))
    if panel.y_names:
        axis.set_yticks([-float(row) for row in range(len(panel.y_names))], panel.y_names, fontsize=7)
    axis.set_title(panel.title, fontsize=10, loc="left")
    axis.grid(alpha=0.3)
    if any(t.label for t in panel.traces):
        show_legend(axis, fontsize=7, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    if panel.round:
        axis.set_aspect("equal")
        axis.set_axis_off()
    elif any(t.texts for t in panel.traces) and not panel.y_names:
        scale = axis.yaxis.get_transform()
        low, high = scale.transform(axis.get_ylim())
        above = high + (0.6 if panel.log_x else 0.25) * (high - low)  # room for names
        axis.set_ylim(top=float(scale.inverted().transform(above)))
    if panel.log_x:
        for x, y, place, text in names_above(panel):
            axis.annotate(
                text,
                (x, y),
                (place, 0.99),
                textcoords="axes fraction",
                rotation=90,
                fontsize=7,
                ha="center",
                va="top",
                arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.5", "shrinkA": 1.0, "shrinkB": 1.0},
            )


def plot_panels(panels: Sequence[Panel]) -> Figure:
    """Plot panels of a report one below the other."""
    figure, axes = new_figure(len(panels))
    for axis, panel in zip(axes, panels, strict=True):
        draw_panel(axis, panel)
    return figure


def plot_maps(found: xr.Dataset) -> Figure:
    """Plot the maps without orders, one row per map and one column per temperature."""
    panels = [p for p in map_panels(found) if not p.title.startswith("Order")]
    figure, axes = new_figure(len(panels), found.temperature.size)
    figure.set_figheight(max(float(figure.get_figheight()), 1.0 + 0.2 * max(len(p.y_names) for p in panels)))
    for number, (row, panel) in enumerate(zip(np.reshape(axes, (len(panels), -1)), panels, strict=True)):
        if not panel.heat:
            row[0].set_subplotspec(row[0].get_subplotspec().get_gridspec()[number, :])
            for axis in row[1:]:
                figure.delaxes(axis)
            draw_panel(row[0], panel)
            continue
        values = np.concatenate([one.z.ravel() for one in panel.heat])
        for axis, one in zip(row, panel.heat, strict=True):
            drawn = axis.imshow(one.z, origin="lower", aspect="auto", vmin=np.nanmin(values), vmax=np.nanmax(values))
            axis.set_xticks(range(one.x.size), ["" if np.isnan(v) else f"{v:.4g}" for v in one.x], fontsize=6)
            axis.set_yticks(range(one.y.size), ["" if np.isnan(v) else f"{v:.4g}" for v in one.y], fontsize=6)
            axis.set_title(f"{panel.title}\n{one.name}" if axis is row[0] else one.name, fontsize=7, loc="left")
            axis.grid(visible=False)
            axis.set_xlabel(panel.x_label, fontsize=6)
        row[0].set_ylabel(panel.y_label, fontsize=6)
        figure.colorbar(drawn, ax=list(row))
    return figure


def plot_changes(changes: Sequence[Change]) -> Figure:
    """Plot each figure's change in percent of its old value with its 95 % interval; significant changes are filled."""
    figure, axes = new_figure(max(1, round(0.25 * len(changes) + 0.5)))
    for axis in axes[1:]:
        figure.delaxes(axis)
    axis = axes[0]
    axis.set_subplotspec(axis.get_gridspec()[:, :])
    for row, change in enumerate(reversed(changes)):
        share = 100.0 / abs(change.before.value) if change.before.value else np.nan
        error = 0.0 if np.isnan(change.uncertainty) else change.uncertainty * share
        fill = "C0" if change.moved else "white"
        axis.errorbar(change.difference * share, row, xerr=error, fmt="o", color="C0", mfc=fill, capsize=3)
    axis.axvline(0.0, color="0.5", lw=0.8)
    axis.set_xlim(min(axis.get_xlim()[0], -_LEAST_CHANGE), max(axis.get_xlim()[1], _LEAST_CHANGE))
    axis.set_yticks(range(len(changes)), [c.name.replace("_", " ").replace(".", ", ") for c in reversed(changes)])
    axis.set(xlabel="change [%]; filled: larger than its uncertainty")
    return figure


def plot_curves(curves: Sequence[Curve]) -> Figure:
    """Plot the transmission error of each curve over one output turn, and over the crank turn."""
    figure, axes = new_figure(2)
    for curve in curves:
        error = curve.transmission_error * ARCSEC
        axes[0].plot(np.degrees(curve.input_angle / abs(curve.ratio)), error, lw=0.8, label=label_of(curve))
        axes[1].plot(np.degrees(np.mod(curve.input_angle, 2.0 * np.pi)), error, ".", ms=1.5)
    axes[0].set(xlabel="output turn [°]", ylabel="transmission error [arcsec]")
    axes[1].set(xlabel="crank angle, all turns folded [°]", ylabel="transmission error [arcsec]")
    figure.legend(loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    return figure


def plot_channels(looks: Sequence[FirstSamples], roles: Mapping[str, FirstSamples]) -> Figure:
    """Plot channels of a bench file over time, those with a proposed role first."""
    role_of = {one.channel.name: role for role, one in roles.items()}
    clock = roles.get("time")
    shown = sorted((o for o in looks if o is not clock), key=lambda o: o.channel.name not in role_of)[:8]
    figure, axes = new_figure(len(shown))
    for axis, one in zip(axes, shown, strict=True):
        step = max(1, one.values.size // 20000)
        time, label = one.time, "time [s]"
        if time is None and clock is not None:
            time, label = clock.values, f"{clock.channel.name} [{clock.channel.unit or 'no unit'}]"
        across, label = (np.arange(one.values.size), "sample") if time is None else (time, label)
        axis.plot(across[::step], one.values[::step], lw=0.8)
        axis.set(xlabel=label, ylabel=one.channel.unit or "no unit")
        role = role_of.get(one.channel.name)
        axis.set_title(one.channel.name + (f": {role}?" if role else ""), fontsize=9, loc="left")
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
    figure, axes = new_figure(1 + len(curves))
    figure.set_size_inches(9.0, 3.4 + 1.3 * len(curves))
    axes[0].set_subplotspec(figure.add_gridspec(2, 1, height_ratios=(2.4, 1.3 * len(curves)))[0])
    rows = axes[0].get_gridspec()[1].subgridspec(len(curves), 1)
    widest = max(np.abs(c.transmission_error - m).max() for c, m in zip(curves, simulated, strict=True)) * ARCSEC
    for number, (curve, model) in enumerate(zip(curves, simulated, strict=True)):
        turns = curve.input_angle / (2.0 * np.pi)
        shown = turns <= crank_turns
        colour = f"C{number}"
        left = (curve.transmission_error - model) * ARCSEC
        entry = f"{label_of(curve)}: residual {np.sqrt(np.mean(left**2)):.2f}″ rms"
        axes[0].plot(turns[shown], curve.transmission_error[shown] * ARCSEC, ".", ms=4, color=colour, alpha=0.5)
        axes[0].plot(turns[shown], model[shown] * ARCSEC, lw=1.2, color=colour, label=entry)
        below = axes[1 + number]
        below.set_subplotspec(rows[number])
        below.plot(turns, left, ".", ms=1.5, color=colour)
        below.set(ylim=(-1.1 * widest, 1.1 * widest))
        below.tick_params(labelbottom=number == len(curves) - 1)
    axes[0].set(ylabel="transmission error\n[arcsec]", xlabel="first crank turns")
    axes[-1].set(xlabel="crank turns")
    axes[1].set_title(f"measured minus {label}, by curve [arcsec]", fontsize=9, loc="left")
    handles, labels = axes[0].get_legend_handles_labels()
    title = f"points: measured, lines: {label}"
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=9, frameon=False, title=title)
    return figure


def plot_identification(result: Identification) -> Figure:
    """Plot measured and fitted transmission errors with their residuals."""
    return plot_comparison(result.curves, result.fitted_curves, "fitted")


def plot_ring(ring: Realised) -> Figure:
    """Plot every pin and tooth around its circle, displacements enlarged, with 95 % intervals."""
    figure, (axis,) = new_figure(1)
    figure.set_figheight(1.0 + 9.0 / len(ring.circles))
    draw_panel(axis, ring_panel(ring))
    return figure


def _readable(name: str) -> str:
    """Return a readable name of a structured error: `pin_radial_2_cos` is "pin radial, order 2, cos"."""
    wave = re.fullmatch(r"(.+)_(\d+)_(cos|sin)", name)
    return (f"{wave[1]}, order {wave[2]}, {wave[3]}" if wave else name).replace("_", " ")


def plot_plans(plans: Sequence[Plan]) -> Figure:
    """Plot the standard errors of errors, pins and teeth for each set of runs, relative to their tolerances.

    Errors that no set of runs resolves have no row; the title lists them.
    """
    figure, (axis,) = new_figure(1)
    each = {f"{name}, each": name for name in plans[-1].realised}
    names = [*plans[-1].standard_error, *plans[-1].held, *each]
    errors = [{**p.standard_error, **{label: p.realised[name] for label, name in each.items()}} for p in plans]
    unknown = [n for n in names if not any(np.isfinite(one.get(n, np.nan)) for one in errors)]
    names = [n for n in names if n not in unknown]
    figure.set_figheight(1.8 + 0.24 * len(names))
    for number, (plan, found) in enumerate(zip(plans, errors, strict=True)):
        share = [found.get(n, np.nan) / TOLERANCE["m" if n in each else unit_of(n)] for n in names]
        beside = 0.5 * (number - 0.5 * (len(plans) - 1)) / len(plans)  # so that equal values do not cover each other
        axis.plot(share, np.arange(len(names)) + beside, "o", ms=4.5, color=f"C{number}", label=plan.runs)
    axis.set(xscale="log", xlabel="standard error relative to its prior (smaller is better)")
    axis.set_yticks(np.arange(len(names)), [_readable(n) for n in names], fontsize=8)
    axis.set_ylim(len(names) - 0.4, -0.6)
    if unknown:
        held = textwrap.fill(f"not resolved by any set: {'; '.join(_readable(n) for n in unknown)}", 100)
        axis.set_title(held, fontsize=8, loc="left", color="0.3")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    return figure


def plot_band(drive: Drive, drawn: Sequence[Drive], torque: float, path: str | os.PathLike[str]) -> None:
    """Plot the transmission error of the identified drive at a torque, N·m, and the 95 % band of the drawn ones."""

    def error(one: Drive) -> Array:
        found: Array = (
            solve(DriveValue(one.pair, one.surface), torque, angle, with_play=False).transmission_error[0] * ARCSEC
        )
        return found

    figure, axes = new_figure(2)
    angle = np.linspace(0.0, 2.0 * np.pi * abs(drive.pair.ratio), 24 * round(abs(drive.pair.ratio)), endpoint=False)
    identified = error(drive)
    low, high = np.quantile(np.array([error(one) for one in drawn]), [0.025, 0.975], axis=0)
    turn = angle / (2.0 * np.pi)
    axes[0].fill_between(turn, low, high, alpha=0.4, lw=0, label=f"95 % of {len(drawn)} drawn")
    axes[0].plot(turn, identified, lw=0.8, label="identified")
    axes[0].set(ylabel="transmission error [arcsec]", title=f"{torque:+.4g} N·m")
    show_legend(axes[0], ncols=2)
    axes[1].fill_between(turn, low - identified, high - identified, alpha=0.4, lw=0)
    axes[1].set(xlabel="crank turns", ylabel="drawn minus identified [arcsec]")
    save(figure, path)
