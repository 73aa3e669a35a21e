"""Pictures of sweeps: lines over one value, maps over two."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu.draw.figure import at_least, new_figure, show_legend
from cycloid_fmu.studies.sweep import figures_in
from cycloid_fmu.studies.sweep_files import SHOWN, label_of, shown_values, varied_names, with_free_positions

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Span that axes and colours have at least: a share of the largest value, and the accuracy of angles and lengths.
_SHARE, _ACCURACY = 0.01, {"arcsec": 0.01, "µm": 0.01}


def plot_sweep(data: xr.Dataset) -> Figure:
    """Every figure of a sweep: over one value as lines, one per torque; over two as maps, at the first torque.

    If more than two values vary, the first two are drawn, at the first value of the others. Invalid combinations and
    drives with interference are blank, in maps grey.
    """
    missing = int((data["reason"].values != "").sum())
    size, data = data["reason"].size, with_free_positions(data)
    names = varied_names(data)
    several = [name for name in names if data.sizes[name] > 1][:2] or names[:1]
    others = {name: 0 for name in names if name not in several}
    section = data.isel(others)
    figures = [
        name for name in figures_in(section) if np.isfinite(section[name].values).any() and not _is_zero(section, name)
    ]
    figure, axes = new_figure((len(figures) + 1) // 2, 2)
    for axis in axes[len(figures) :]:
        figure.delaxes(axis)
    draw = _draw_lines if len(several) == 1 else _draw_map
    for axis, name in zip(axes, figures, strict=False):
        unit, factor = SHOWN[section[name].attrs["units"]]
        label = label_of(name, unit).replace(" [", "\n[")
        largest = float(np.nan_to_num(np.abs(section[name].values)).max()) * factor
        draw(axis, section[name] * factor, several, label, max(_SHARE * largest, _ACCURACY.get(unit, 0.0)))
    held = [
        f"{name.replace('_', ' ')} = {shown_values(data, name)[0][0]:g} {shown_values(data, name)[1]}"
        for name in others
    ]
    if len(several) > 1:
        held.insert(0, f"{float(data['torque'].values[0]):g} N·m")
    if missing:
        held.append(f"{missing} of {size} drives not shown: invalid, or interference")
    figure.suptitle(", ".join(held), fontsize=9)
    return figure


def _axis_of(values: xr.DataArray, name: str) -> tuple[Any, str]:
    """The values of what is varied, as shown, and the label of their axis."""
    shown, unit = shown_values(values, name)
    return shown, label_of(name, unit)


def _draw_lines(axis: Axes, values: xr.DataArray, varied: list[str], label: str, least: float) -> None:
    """Draw a figure over one value, a line per torque; the axis spans `least` or more."""
    from matplotlib.ticker import MaxNLocator

    places, place_label = _axis_of(values, varied[0])
    loads = values["torque"].values if "torque" in values.dims else [None]
    for load in loads:
        line = values if load is None else values.sel(torque=load)
        axis.plot(places, line.values, ".-", ms=4, lw=1.2, label=None if load is None else f"{load:g} N·m")
    at_least(axis, least)
    axis.ticklabel_format(useOffset=False)
    axis.xaxis.set_major_locator(MaxNLocator(6))
    axis.set(xlabel=place_label, ylabel=label)
    margin = 0.03 * float(np.ptp(places))
    if margin > 0.0:
        axis.set_xlim(min(places) - margin, max(places) + margin)
    if len(loads) > 1:
        show_legend(axis)


def _draw_map(axis: Axes, values: xr.DataArray, varied: list[str], label: str, least: float) -> None:
    """Draw a figure over two values, at the first torque; the colours span `least` or more."""
    (rows, row_label), (columns, column_label) = (_axis_of(values, name) for name in varied)
    plane = (values.isel(torque=0) if "torque" in values.dims else values).transpose(*varied).values
    low, high = float(np.nanmin(plane)), float(np.nanmax(plane))
    wider = max(0.5 * (least - (high - low)), 0.0)
    image = axis.pcolormesh(columns, rows, plane, shading="nearest", vmin=low - wider, vmax=high + wider)
    axis.set_facecolor("0.85")
    axis.grid(False)
    axis.set(xlabel=column_label, ylabel=row_label)
    axis.figure.colorbar(image, ax=axis, label=label)


def _is_zero(data: xr.Dataset, name: str) -> bool:
    return name == "interference" and not data[name].fillna(0.0).values.any()
