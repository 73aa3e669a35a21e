"""Plots of losses: by part, torques over the crank angle, and the efficiency over torque and speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.draw.figure import save as save  # re-exported for the command

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cycloid_fmu.losses.figures import EfficiencyMap, LossFigures

_RPM = 30.0 / math.pi


def plot_losses(found: LossFigures) -> Figure:
    """Draw losses by part, and the input's, starting and back-driving torques over the crank angle."""
    figure, axes = new_figure(4)
    _show_parts(axes[0], found)
    angle = np.degrees(found.crank_angle)
    for direction, sweep in found.sweeps.items():
        for k, torque in enumerate(sweep.motion.torque):
            label = f"{torque:g} N·m, crank {direction:+d}"
            axes[1].plot(angle, sweep.input_torque[k], "-" if direction > 0 else "--", color=f"C{k}", label=label)
    axes[1].set_title(f"Torque of the environment on the input at {found.crank_speed * _RPM:.4g} rpm of the crank")
    axes[1].set_ylabel("N·m")
    for load, each in found.starting.items():
        axes[2].plot(angle, each, label=f"against {load:g} N·m" if load else "without load")
    axes[2].set_title("Torque of the input that starts the drive from rest")
    axes[2].set_ylabel("N·m")
    locked = np.isnan(found.back_driving)
    if not locked.all():
        axes[3].plot(angle, found.back_driving, color="C3", label="from rest")
    if locked.any():
        height = np.full(locked.sum(), found.searched_to)
        axes[3].plot(angle[locked], height, ".", color="C7", label=f"none up to {found.searched_to:g} N·m")
    axes[3].set_title("Torque on the output that turns the drive backwards")
    axes[3].set_ylabel("N·m")
    axes[3].set_xlabel("crank angle, °")
    for axis in axes[2:]:
        axis.set_ylim(0.0, 1.2 * axis.dataLim.y1 or 1.0)
    for axis in axes[1:]:
        show_legend(axis)
    return figure


def _show_parts(axis: Axes, found: LossFigures) -> None:
    """Show each part's share of the power that enters, one bar for each torque and direction."""
    names = [f"{case.torque:g} N·m\n{case.mode}" for case in found.cases]
    place, base = np.arange(len(names)), np.zeros(len(names))
    for number, part in enumerate(found.cases[0].loss):
        watts = np.array([found.crank_speed * case.loss[part] for case in found.cases])
        if found.crank_speed == 0.0:
            watts = np.array([case.loss[part] for case in found.cases])
        if np.nansum(watts) > 0.0:
            axis.bar(place, watts, bottom=base, width=0.6, color=f"C{number}", label=part.replace("_", " "))
            base = base + np.nan_to_num(watts)
    for x, top, case in zip(place, base, found.cases, strict=True):
        said = "jams" if case.jams else "" if math.isnan(case.efficiency) else f"{case.efficiency:.1%}"
        axis.annotate(said, (x, top), ha="center", va="bottom", fontsize=8)
    axis.set_xticks(place, names, fontsize=8)
    axis.set_xlim(-0.6, len(names) + 0.4)
    axis.margins(y=0.15)
    axis.set_title("Losses by part; efficiency above each bar")
    axis.set_ylabel("W" if found.crank_speed else "J/rad of the crank")
    show_legend(axis, loc="upper right")


def plot_map(found: EfficiencyMap) -> Figure:
    """Draw the efficiency over torque and speed, driving and back-driving."""
    figure, axes = new_figure(1, 2)
    figure.set_figheight(4.2)
    for axis, values, mode in zip(axes, (found.driving, found.back_driving), ("driving", "back-driving"), strict=True):
        axis.grid(visible=False)
        shown = 100.0 * values
        place = (found.torque, found.crank_speed * _RPM)
        if np.isnan(shown).all():
            axis.text(0.5, 0.5, "the drive jams", transform=axis.transAxes, ha="center")
            continue
        filled = axis.contourf(*place, shown, 12, cmap="viridis")
        if (shown <= 0.0).any():
            axis.contourf(*place, shown, [-np.inf, 0.0], colors="none", hatches=["///"])
        figure.colorbar(filled, ax=axis, label="efficiency, %")
        hatched = ", hatched: self-locking" if (shown <= 0.0).any() else ""
        axis.set_title(f"{mode}{hatched}")
        axis.set_xlabel("torque on the output, N·m")
        axis.set_ylabel("speed of the crank, rpm")
    return figure
