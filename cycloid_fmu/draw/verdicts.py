"""Verdicts below a picture, red if a limit is not met; sliding and bearing lives over a duty."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.studies.limits import Verdict, line_of, not_judged_line
from cycloid_fmu.studies.verdicts import Judged

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINE = 0.17  # inch
_CHARACTERS = 15  # for each inch of a line


def show_verdicts(figure: Figure, verdicts: Sequence[Verdict], not_judged: Sequence[str] = ()) -> Figure:
    """Add a line for each verdict and one for the limits not judged below a figure, enlarge it, and return it."""
    lines = [(line_of(one), one.met) for one in verdicts]
    width, height = figure.get_size_inches()
    lines += [(line, False) for line in textwrap.wrap(not_judged_line(not_judged), int(_CHARACTERS * width))]
    if not lines:
        return figure
    below = _LINE * (len(lines) + 1)
    figure.set_size_inches(width, height + below)
    share = below / (height + below)
    if (layout := figure.get_layout_engine()) is not None:
        layout.set(rect=(0.0, share, 1.0, 1.0 - share))  # type: ignore[call-arg]
    for k, (line, met) in enumerate(lines):
        place = share * (len(lines) - k) / (len(lines) + 1)
        figure.text(0.02, place, line, fontsize=7.5, va="center", color="black" if met else "tab:red")
    return figure


def plot_duty(judged: Judged) -> Figure:
    """Sliding speed and friction power of the pins over the crank for each row of a duty, and the bearing lives."""
    rows = len(judged.sliding)
    figure, axes = new_figure(rows + bool(judged.lives), 2)
    angle = np.degrees(judged.crank_angle)
    for k, (load, found) in enumerate(judged.sliding):
        title = f"{load.torque:g} N·m, {load.output_speed * 30.0 / np.pi:.4g} rpm, {load.share:.0%} of the time"
        worst, pins = axes[2 * k], axes[2 * k + 1]
        worst.plot(angle, found.sliding_speed.max(axis=(1, 2)), lw=1.0)
        worst.set(xlabel="crank angle [°]", ylabel="largest sliding speed [m/s]", title=title)
        worst.set_ylim(0.0, 1.1 * worst.get_ylim()[1])
        values, label = found.sliding_speed, "sliding speed [m/s]"
        if found.friction_power.size:
            values, label = found.friction_power, "friction power [W]"
            density = found.friction_power_density.max(axis=(1, 2)) * 1e-6
            beside = worst.twinx()
            beside.plot(angle, density, "C1", lw=1.0)
            beside.set_ylabel("friction power per\ncontact area [W/mm²]", color="C1")
            beside.set_ylim(0.0, 1.1 * beside.get_ylim()[1])
            worst.yaxis.label.set_color("C0")
        disc = int(values.max(axis=(0, 2)).argmax())
        place = np.arange(values.shape[2])
        image = pins.pcolormesh(angle, place, values[:, disc].T, cmap="viridis", shading="nearest")
        pins.set(xlabel="crank angle [°]", ylabel="pin", title=f"each pin, disc {disc}")
        figure.colorbar(image, ax=pins, label=label)
    if judged.lives:
        known = [one for one in judged.lives if np.isfinite(one.life)]
        for axis, lengths, label in (
            (axes[-2], [one.life / 3600.0 for one in known], "L10h over the duty [h]"),
            (axes[-1], [one.equivalent for one in known], "equivalent load [N]"),
        ):
            names = [one.bearing for one in known]
            if axis is axes[-2]:  # a logarithmic axis has no zero for a bar to start from
                axis.plot(lengths, names, "o", color="#4c78a8")
                axis.set_xscale("log")
            else:
                axis.barh(names, lengths, color="#4c78a8")
            axis.invert_yaxis()
            axis.set(xlabel=label)
            axis.tick_params(axis="y", labelsize=7)
        for one in judged.verdicts:
            if one.figure == "bearing_life":
                axes[-2].axvline(one.limit / 3600.0, color="k", ls="--", lw=1, label="limit")
                show_legend(axes[-2], loc="lower left", bbox_to_anchor=(0.0, 1.0))
    for axis in axes:
        axis.title.set_fontsize(9)
    return figure
