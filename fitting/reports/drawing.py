"""Panels drawn with matplotlib, one below the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from cycloid_fmu.draw.figure import new_figure, show_legend
from fitting.reports.panels import Panel, Trace, names_above, x_range

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTHS = {"line": 1.2, "thin": 0.8, "dashed": 1.0, "thick": 2.5}
_DOT, _MANY = 2.5, 200  # points: diameter of dots, a third of it for so many
_HEIGHT, _ROW, _ROWS = 2.4, 0.22, 0.9  # inches: a panel, one of its names, and what is above and below them
_FEW_DECADES = 300.0  # largest over smallest value of a logarithmic axis, below which 1, 2 and 5 are labelled


def _draw_trace(axis: Axes, trace: Trace, *, named: bool) -> None:
    """Draw a line, points, words or a band, with the names of points beside them if `named`."""
    colour = "0.45" if trace.colour < 0 else f"C{trace.colour % 10}"
    if trace.style == "points":
        size, colour = (4.0, "0") if trace.texts else (1.0, "0.45")
        axis.plot(trace.x, trace.y, ".", ms=size, color=colour, label=trace.label or None)
        for x, y, text in zip(trace.x, trace.y, trace.texts if named else (), strict=False):
            axis.annotate(text, (x, y), (0, 3), textcoords="offset points", rotation=60, fontsize=7)
        return
    if trace.style in ("dots", "circles"):
        fill = "white" if trace.style == "circles" else colour
        size = _DOT if trace.x.size < _MANY else _DOT / 3.0
        axis.plot(trace.x, trace.y, "o", ms=size, color=colour, mfc=fill, label=trace.label or None)
        return
    if trace.style == "band":
        axis.fill(trace.x, trace.y, color=colour, alpha=0.25, lw=0, label=trace.label or None)
        return
    if trace.style == "words":
        axis.plot(trace.x, trace.y, " ")  # texts do not extend the axes
        for x, y, text in zip(trace.x, trace.y, trace.texts, strict=True):
            axis.annotate(text, (x, y), ha="center", va="center", fontsize=7)
        return
    style, width = "--" if trace.style == "dashed" else "-", _WIDTHS[trace.style]
    cap = "butt" if trace.style == "thick" else "projecting"  # a bar is as long as its value
    axis.plot(trace.x, trace.y, style, lw=width, solid_capstyle=cap, color=colour, label=trace.label or None)


def draw_panel(axis: Axes, panel: Panel) -> None:
    """Draw one panel of a report."""
    for trace in panel.traces:
        _draw_trace(axis, trace, named=not panel.log_x)
    axis.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.from_zero:
        ends = [float(end(t.y[np.isfinite(t.y)], initial=0.0)) for t in panel.traces for end in (np.min, np.max)]
        room = 0.05 * (max(ends) - min(ends))
        axis.set_ylim(min(ends) - room * (min(ends) < 0.0), max(ends) + room)
    if panel.log_y:
        axis.set_yscale("log")
    if panel.log_x:
        axis.set(xscale="log", xlim=x_range(panel))
    for logarithmic, scaled in ((panel.log_x, axis.xaxis), (panel.log_y, axis.yaxis)):
        low, high = scaled.get_view_interval()
        if logarithmic and high < _FEW_DECADES * low:
            scaled.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scaled.set_major_formatter(StrMethodFormatter("{x:g}"))
            scaled.set_minor_formatter(NullFormatter())
    axis.set(**{f"{name}lim": ends for name, ends in (("x", panel.x_limits), ("y", panel.y_limits)) if ends})
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
        for x, y, position, text in names_above(panel):
            axis.annotate(
                text,
                (x, y),
                (position, 0.99),
                textcoords="axes fraction",
                rotation=90,
                fontsize=7,
                ha="center",
                va="top",
                arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.5", "shrinkA": 1.0, "shrinkB": 1.0},
            )


def _draw_maps(figure: Figure, axes: Sequence[Axes], panel: Panel) -> None:
    """Draw the maps of a panel side by side, on one colour scale."""
    values = np.concatenate([heat.z.ravel() for heat in panel.heat])
    for axis, heat in zip(axes, panel.heat, strict=True):
        drawn = axis.imshow(heat.z, origin="lower", aspect="auto", vmin=np.nanmin(values), vmax=np.nanmax(values))
        axis.set_xticks(range(heat.x.size), ["" if np.isnan(v) else f"{v:.4g}" for v in heat.x], fontsize=6)
        axis.set_yticks(range(heat.y.size), ["" if np.isnan(v) else f"{v:.4g}" for v in heat.y], fontsize=6)
        axis.set_title(f"{panel.title}\n{heat.name}" if axis is axes[0] else heat.name, fontsize=7, loc="left")
        axis.grid(visible=False)
        axis.set_xlabel(panel.x_label, fontsize=6)
    axes[0].set_ylabel(panel.y_label, fontsize=6)
    figure.colorbar(drawn, ax=list(axes))


def _height(panel: Panel) -> float:
    """Return the height of a panel, inches; a round one keeps its proportions."""
    if panel.round:
        ends = [np.concatenate([getattr(trace, axis) for trace in panel.traces]) for axis in "xy"]
        spans = [float(np.nanmax(values) - np.nanmin(values)) for values in ends]
        return 9.0 * spans[1] / spans[0]
    return max(_HEIGHT, _ROWS + _ROW * len(panel.y_names))


def plot_panels(panels: Sequence[Panel], title: str = "") -> Figure:
    """Plot panels one below the other, below a title if there is one."""
    columns = max(len(panel.heat) or 1 for panel in panels)
    figure, axes = new_figure(len(panels), columns)
    heights = [_height(panel) for panel in panels]
    figure.set_figheight(sum(heights) + 0.8)
    grid = axes[0].get_subplotspec().get_gridspec()
    grid.set_height_ratios(heights)
    for number, (row, panel) in enumerate(zip(axes.reshape(-1, columns), panels, strict=True)):
        if panel.heat:
            _draw_maps(figure, list(row), panel)
            continue
        row[0].set_subplotspec(grid[number, :])
        for axis in row[1:]:
            figure.delaxes(axis)
        draw_panel(row[0], panel)
    if title:
        figure.suptitle(title, color="tab:red", fontsize=9)
    return figure
