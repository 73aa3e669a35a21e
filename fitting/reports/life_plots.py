"""Plots of a drive's life: figures at each date, changed errors, and planned visits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.edge import ARCSEC
from fitting.recalibration.plan import PlannedVisit
from fitting.recalibration.recalibrate import Recalibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LABELS = {
    "backlash": "backlash [arcsec]",
    "lost_motion": "lost motion [arcsec]",
    "transmission_error": "transmission error,\npeak to peak [arcsec]",
}
_MOST = 14  # most errors shown


def plot_recalibration(result: Recalibration) -> Figure:
    """Plot figures with 95 % bands over crank turns since the fit, with alarms, and the errors that changed most."""
    names = [n for n in _LABELS if n in result.figures]
    figure, axes = new_figure(len(names) + 1)
    turns = np.array([one.crank_turns for one in result.history]) / 1e6
    alarms = np.array([bool(one.alarm) for one in result.history])
    for axis, name in zip(axes, names, strict=False):
        found = [one.figures[name] for one in result.history]
        value = np.array([f.value for f in found]) * ARCSEC
        low, high = (np.array([f.interval[end] for f in found]) * ARCSEC for end in (0, 1))
        axis.fill_between(turns, low, high, alpha=0.25, lw=0, label="95 %")
        axis.plot(turns, value, "o-", ms=4, lw=1.0)
        if alarms.any():
            axis.plot(turns[alarms], value[alarms], "x", ms=9, color="C3", label="alarm: not updated")
        axis.set(ylabel=_LABELS[name])
        axis.tick_params(labelbottom=name == names[-1])
        if name == names[0]:
            show_legend(axis, ncols=2)
    axes[len(names) - 1].set(xlabel="crank turns since the fit [10⁶]")
    moved = sorted(result.moved.items(), key=lambda item: -abs(item[1][1]))[:_MOST]
    axis = axes[-1]
    axis.barh(range(len(moved)), [times for _, (_, times) in moved], color="C3" if result.alarm else "C0")
    axis.axvspan(-2.0, 2.0, color="0.9", zorder=0)
    axis.set_yticks(range(len(moved)), [name.replace("_", " ") for name, _ in moved], fontsize=7)
    axis.invert_yaxis()
    axis.set(xlabel="change since the last date, in standard deviations of the expected change (grey: ± 2)")
    figure.set_figheight(2.0 * len(names) + 3.6)
    return figure


def plot_visits(visits: Sequence[PlannedVisit]) -> Figure:
    """Plot the half width of the backlash's interval over the turns of each planned set of runs."""
    figure, (axis,) = new_figure(1)
    figure.set_figheight(4.2)
    for one in visits:
        axis.plot([*one.half_width], np.array([*one.half_width.values()]) * ARCSEC, "o-", ms=4, lw=1.0, label=one.runs)
    axis.set(
        xscale="log",
        yscale="log",
        xlabel="output turns of each run, or passages of the mark in each direction",
        ylabel="half width of the backlash's\n95 % interval [arcsec]",
    )
    turns = [*visits[0].half_width]
    axis.set_xticks(turns, [str(t) for t in turns])
    axis.minorticks_off()
    widths = [w * ARCSEC for one in visits for w in one.half_width.values()]
    ticks = [t for d in range(-3, 5) for t in (10.0**d, 2.0 * 10.0**d, 5.0 * 10.0**d)]
    inside = [t for t in ticks if 0.8 * min(widths) < t < 1.25 * max(widths)]
    axis.set_yticks(inside, [f"{t:g}" for t in inside])
    figure.legend(loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    return figure
