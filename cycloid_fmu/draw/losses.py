"""Plots of losses: by part, torques over the crank angle, and the efficiency over torque and speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.draw.figure import save as save  # re-exported for the command
from cycloid_fmu.losses.heat import SHARES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cycloid_fmu.losses.figures import EfficiencyMap, LossFigures
    from cycloid_fmu.losses.heat import Heat

_RPM, _ICE = 30.0 / math.pi, 273.15


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
    axes[2].set(title="Torque of the input that starts the drive from rest", ylabel="N·m")
    locked = np.isnan(found.back_driving)
    if not locked.all():
        axes[3].plot(angle, found.back_driving, color="C3", label="from rest")
    if locked.any():
        height = np.full(locked.sum(), found.searched_to)
        axes[3].plot(angle[locked], height, ".", color="C7", label=f"none up to {found.searched_to:g} N·m")
    axes[3].set(title="Torque on the output that turns the drive backwards", ylabel="N·m", xlabel="crank angle, °")
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


def plot_heat(warm: Sequence[Heat]) -> Figure:
    """Draw heat and what is given off over the oil's temperature, and the course of warming up."""
    timed = any(each.time.size for each in warm)
    figure, axes = new_figure(1 + timed)
    figure.set_figheight(3.2 * (1 + timed))
    for k, each in enumerate(warm):
        torque, speed, _ = each.running[0]
        load = "the duty" if len(each.running) > 1 else f"{torque:g} N·m, {speed * _RPM:.4g} rpm of the crank"
        axes[0].plot(each.scanned - _ICE, each.scanned_power, ".-", color=f"C{k}", label=load)
        axes[0].plot(each.oil - _ICE, each.power, "o", color=f"C{k}")
        if each.time.size:
            hours = each.time / 3600.0
            axes[1].plot(hours, each.warming - _ICE, color=f"C{k}", label=load)
            for share in SHARES:
                reached = each.thermal.ambient + share * (each.oil - each.thermal.ambient)
                axes[1].plot(each.time_to(share) / 3600.0, reached - _ICE, "o", ms=4, color=f"C{k}")
    thermal = warm[0].thermal
    oil = np.array([thermal.ambient, max([thermal.ambient + 1.0, *(each.scanned.max(initial=0.0) for each in warm)])])
    axes[0].plot(oil - _ICE, (oil - thermal.ambient) / thermal.whole, "k--", lw=1, label="given off")
    axes[0].set(title="Heat made and given off; steady where they meet", xlabel="temperature of the oil, °C")
    axes[0].set_ylabel("W")
    if timed:
        axes[1].set(title="Warming up from the surroundings; dots: 63 and 95 % of the rise", xlabel="h")
        axes[1].set_ylabel("temperature of the oil, °C")
    if thermal.largest is not None:
        axes[0].axvline(thermal.largest - _ICE, color="r", lw=1, label="largest permissible")
        if timed:
            axes[1].axhline(thermal.largest - _ICE, color="r", lw=1, label="largest permissible")
    for axis in axes:
        show_legend(axis)
    return figure


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
        axis.set(title=f"{mode}{hatched}", xlabel="torque on the output, N·m", ylabel="speed of the crank, rpm")
    return figure
