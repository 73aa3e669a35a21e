"""Pictures of sweeps: lines over one value, maps over two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import at_least, new_figure, show_legend
from cycloid_fmu.studies.sweep import figures_in
from cycloid_fmu.studies.sweep_files import SHOWN, label_of, shown_values, varied_names, with_free_positions

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


# Span that axes and colours have at least: a share of the largest value, and the accuracy of angles and lengths.
_SHARE, _ACCURACY = 0.01, {"arcsec": 0.01, "µm": 0.01}


def plot_sweep(data: xr.Dataset) -> Figure:
    """Every figure of a sweep: over one value as lines, one per torque; over two as maps, at the first torque.

    If more than two values vary, the first two are drawn, at the first value of the others. Invalid combinations and
    drives with interference are blank, in maps grey.
    """
    from matplotlib.ticker import MaxNLocator

    missing = int((data["reason"].values != "").sum())
    size, data = data["reason"].size, with_free_positions(data)
    names = varied_names(data)
    several = [name for name in names if data.sizes[name] > 1][:2] or names[:1]
    others = {name: 0 for name in names if name not in several}
    one = data.isel(others)
    shown = [name for name in figures_in(one) if np.isfinite(one[name].values).any() and not _is_zero(one, name)]
    figure, axes = new_figure((len(shown) + 1) // 2, 2)
    for axis in axes[len(shown) :]:
        figure.delaxes(axis)
    labels = [label_of(name, shown_values(data, name)[1]) for name in several]
    for axis, name in zip(axes, shown, strict=False):
        unit, factor = SHOWN[one[name].attrs["units"]]
        label = label_of("share_of_loaded_pins" if name == "loaded_pins" else name, unit).replace(" [", "\n[")
        places = [shown_values(data, each)[0] for each in several]
        largest = float(np.nan_to_num(np.abs(one[name].values)).max()) * factor
        least = max(_SHARE * largest, _ACCURACY.get(unit, 0.0))
        if len(several) == 1:
            loads = data["torque"].values if "torque" in one[name].dims else [None]
            for load in loads:
                values = one[name] if load is None else one[name].sel(torque=load)
                axis.plot(
                    places[0],
                    values.values * factor,
                    ".-",
                    ms=4,
                    lw=1.2,
                    label=None if load is None else f"{load:g} N·m",
                )
            at_least(axis, least)
            axis.ticklabel_format(useOffset=False)
            axis.xaxis.set_major_locator(MaxNLocator(6))
            margin = 0.03 * float(np.ptp(places[0]))
            axis.set(xlabel=labels[0], ylabel=label)
            if margin > 0.0:
                axis.set_xlim(min(places[0]) - margin, max(places[0]) + margin)
            if "torque" in one[name].dims and len(loads) > 1:
                show_legend(axis)
            continue
        values = one[name].isel(torque=0) if "torque" in one[name].dims else one[name]
        shown_here = values.transpose(*several).values * factor
        low, high = float(np.nanmin(shown_here)), float(np.nanmax(shown_here))
        wider = max(0.5 * (least - (high - low)), 0.0)
        image = axis.pcolormesh(
            places[1], places[0], shown_here, shading="nearest", vmin=low - wider, vmax=high + wider
        )
        axis.set_facecolor("0.85")
        axis.grid(False)
        axis.set(xlabel=labels[1], ylabel=labels[0])
        figure.colorbar(image, ax=axis, label=label)
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


def _is_zero(data: xr.Dataset, name: str) -> bool:
    return name == "interference" and not data[name].fillna(0.0).values.any()
