"""Plot of a forecast: history, bands, limits, remaining life, and agreement of recordings with the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.studies.limits import SHOWN
from fitting.ageing.forecast import QUANTILES, Forecast

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HOUR = 3600.0
_NORMAL = 1.959964
_INTERVALS = ((0, 6, 0.18, "95 %"), (1, 5, 0.18, "90 %"), (2, 4, 0.25, "50 %"))


def plot_forecast(found: Forecast) -> Figure:
    """Plot history, band and limit of each figure, the probability of exceeding limits, and scores of recordings."""
    several = bool(found.remaining) + bool(found.scores.size)
    figure, axes = new_figure(len(found.bands) + several, 1)
    figure.set_size_inches(9.0, 2.9 * axes.size + 0.6)
    for axis, name in zip(axes, found.bands, strict=False):
        _band(axis, found, name)
    below = list(axes[len(found.bands) :])
    if found.remaining:
        axis = below.pop(0)
        for name, one in found.remaining.items():
            axis.plot(found.ages / _HOUR, 100.0 * one.probability, lw=1.5, label=name.replace("_", " "))
        axis.axvline(found.now / _HOUR, color="0.4", lw=0.8, ls=":")
        axis.set(xlabel="age [h]", ylabel="probability of\nexceeding limit [%]", ylim=(-2.0, 102.0))
        axis.set_xlim(axes[0].get_xlim())
        show_legend(axis, loc="upper left")
    if found.scores.size:
        axis = below.pop(0)
        ages = np.array([m.crank_turns for m in found.posterior.measured]) / found.crank_turns_per_second / _HOUR
        names = [m.figure for m in found.posterior.measured]
        axis.axhspan(-_NORMAL, _NORMAL, color="0.9", label="95 % of scores")
        for name in found.bands:
            mine = [k for k, one in enumerate(names) if one == name]
            if mine:
                axis.plot(ages[mine], found.scores[mine], "o", ms=4, label=name.replace("_", " "))
        most = max(3.0, 1.1 * float(np.abs(found.scores).max()))
        axis.set(xlabel="age [h]", ylabel="score of\neach figure", ylim=(-most, most), xlim=axes[0].get_xlim())
        show_legend(axis, loc="center right")
    if found.alarm is not None:
        figure.suptitle(found.alarm.sentence.replace("; ", ";\n").replace("): ", "):\n"), color="tab:red", fontsize=9)
    return figure


def _band(axis: Axes, found: Forecast, name: str) -> None:
    band, (unit, factor, _) = found.bands[name], SHOWN[name]
    hours = found.ages / _HOUR
    for low, high, alpha, text in _INTERVALS:
        axis.fill_between(
            hours, band[low] * factor, band[high] * factor, color="tab:blue", alpha=alpha, lw=0, label=text
        )
    axis.plot(hours, band[QUANTILES.index(0.5)] * factor, color="tab:blue", lw=1.5, label="median")
    mine = [m for m in found.posterior.measured if m.figure == name]
    if mine:
        at = [m.crank_turns / found.crank_turns_per_second / _HOUR for m in mine]
        axis.errorbar(
            at,
            [m.value * factor for m in mine],
            [_NORMAL * m.standard_error * factor for m in mine],
            fmt="ko",
            ms=3.5,
            lw=1,
            capsize=2,
            label="recorded, ± 95 %",
        )
    axis.axvline(found.now / _HOUR, color="0.4", lw=0.8, ls=":")
    top = band[-1].max() * factor
    if name in found.remaining:
        one = found.remaining[name]
        axis.axhline(one.limit * factor, color="tab:red", lw=1.2, ls="--", label="limit")
        known = [age for age in one.ages.values() if np.isfinite(age)]
        if known:
            left = ", ".join(f"{p:.0%}" for p, age in one.ages.items() if np.isfinite(age))
            axis.plot(
                np.array(known) / _HOUR,
                [one.limit * factor] * len(known),
                "|",
                color="tab:red",
                ms=12,
                mew=2,
                label=f"exceeded with {left}",
            )
        # A wide band must not hide the limit.
        top = min(top, 2.5 * one.limit * factor)
    least = min([band[0].min() * factor, *(m.value * factor for m in mine)])
    axis.set(
        xlabel="age [h]", ylabel=f"{name.replace('_', ' ')}\n[{unit}]", ylim=(least - 0.05 * (top - least), 1.02 * top)
    )
    axis.set_xlim(-0.01 * hours[-1], hours[-1])
    show_legend(axis, loc="upper left", ncols=2)
