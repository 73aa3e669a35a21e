"""Plot of a compensator: its correction, the parts of the correction, and the band."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend
from cycloid_fmu.edge import ARCSEC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cycloid_fmu.compensation.compensator import Compensator

_ANGLES, _TORQUES, _TURNS = 2000, 400, 2.0  # points over angle and torque, and most crank turns shown


def plot_compensator(c: Compensator, torque: float) -> Figure:
    """Draw the correction of a compensator at the output, at the middle of its temperature range.

    Over the crank angle, at ± `torque`, N·m: the correction with a band of ± two standard deviations, and its ripple;
    over the torque: mean deviation and wind-up, and the band (one standard deviation).
    """
    at = 0.5 * float(c.inverse.temperature[0] + c.inverse.temperature[-1])
    crank = np.linspace(0.0, min(c.inverse.period, _TURNS * 2.0 * np.pi), _ANGLES)
    figure, (whole, ripple, mean, band) = new_figure(4)
    for number, load in enumerate((torque, -torque)):
        level, more = c.inverse.at(crank, load, at)
        level = level + c.compliance * load
        wide = 2.0 * np.sqrt(_variance(c, np.array([load]), at)[0]) * ARCSEC
        color, label = f"C{number}", f"{load:+.4g} N·m"
        total = (level + more) * ARCSEC
        whole.plot(np.degrees(crank), total, lw=0.9, color=color, label=label)
        whole.fill_between(np.degrees(crank), total - wide, total + wide, color=color, alpha=0.2, lw=0)
        whole.plot(np.degrees(crank), level * ARCSEC, "--", lw=0.8, color=color)
        ripple.plot(np.degrees(crank), more * ARCSEC, lw=0.9, color=color, label=label)
    whole.set(
        xlabel="ideal crank angle [°]",
        ylabel="correction [arcsec]",
        title="Correction with two standard deviations; mean dashed",
    )
    ripple.set(xlabel="ideal crank angle [°]", ylabel="correction [arcsec]", title="Ripple only")
    loads = np.linspace(c.inverse.torque[0], c.inverse.torque[-1], _TORQUES)
    wound = c.compliance * loads
    level = c.inverse.at(0.0, loads, at)[0]
    for values, label in ((level + wound, "mean and wind-up in series"), (wound, "wind-up in series")):
        mean.plot(loads, values * ARCSEC, lw=0.9, label=label)
    band.plot(loads, np.sqrt(_variance(c, loads, at)) * ARCSEC, lw=0.9)
    band.set(
        xlabel="torque through the teeth [N·m]", ylabel="band [arcsec]", title="Band before measurements", yscale="log"
    )
    mean.set(xlabel="torque through the teeth [N·m]", ylabel="correction [arcsec]", title="Mean over the crank angle")
    for axis in (whole, ripple, mean, band):
        axis.title.set_fontsize(9)
    for axis in (whole, ripple, mean):
        show_legend(axis)
    return figure


def _variance(c: Compensator, torque: np.ndarray, temperature: float) -> np.ndarray:
    """Return the variance at torques, N·m, before any measurement, rad², shape as `torque`."""
    rows = [np.interp(torque, c.inverse.torque, row) for row in c.variance]
    over = np.array(rows)
    return np.array([np.interp(temperature, c.inverse.temperature, column) for column in over.T])
