"""The page of maps of a drive over its conditions: heat maps over torque and speed, one per temperature."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.edge import ARCMIN, ARCSEC
from fitting.figures.maps import DIRECTIONS
from fitting.reports.figures_report import notes_of
from fitting.reports.page import write_page
from fitting.reports.panels import HeatMap, Panel, Trace

if TYPE_CHECKING:
    import xarray as xr

_RPM = 30.0 / math.pi


def map_panels(dataset: xr.Dataset) -> list[Panel]:
    """Return one panel for each map and direction, in field units; of a single condition, one panel with bars.

    Parameters
    ----------
    dataset
        Result of `fitting.maps`.
    """
    if dataset.torque.size == dataset.speed.size == dataset.temperature.size == 1:
        return [_bars(dataset)]
    shown = {
        "angular_transmission_error": "Angular transmission error",
        "angular_transmission_error_without_rig": "Angular transmission error without the rig's orders",
        "gap": "Gap between directions",
        "torsional_stiffness": "Torsional stiffness",
    }
    panels = []
    for name, title in shown.items():
        unit, factor = ("N·m/arcmin", 1.0 / ARCMIN) if name == "torsional_stiffness" else ("arcsec", ARCSEC)
        if name == "gap":
            panels += _panel(title, unit, dataset, dataset[name] * factor)
            continue
        for direction in DIRECTIONS:
            panels += _panel(f"{title}, {direction}", unit, dataset, dataset[name].sel(direction=direction) * factor)
    for order, kind in zip(dataset.order.values, dataset.order_name.values, strict=True):
        for direction in DIRECTIONS:
            values = dataset.order_amplitude.sel(order=order, direction=direction) * ARCSEC
            of = f" ({kind})" if kind else ""
            panels += _panel(f"Order {order}{of}, amplitude, {direction}", "arcsec", dataset, values)
    return panels


def _bars(dataset: xr.Dataset) -> Panel:
    """Return the values of a single condition as bars, rad as arcsec."""
    values: list[tuple[str, xr.DataArray]] = [
        ("angular transmission error", dataset.angular_transmission_error),
        ("the same without the rig's orders", dataset.angular_transmission_error_without_rig),
        ("gap between directions", dataset.gap),
    ]
    values += [
        (f"order {order}" + (f", {kind}" if kind else ""), dataset.order_amplitude.sel(order=order))
        for order, kind in zip(dataset.order.values, dataset.order_name.values, strict=True)
    ]
    bars = [
        (name, direction, (each.sel(direction=direction) if direction else each).values.item() * ARCSEC)
        for name, each in values
        for direction in (DIRECTIONS if "direction" in each.dims else ("",))
    ]
    bars = [bar for bar in bars if np.isfinite(bar[2])]
    traces: list[Trace] = []
    for row, (_, direction, value) in enumerate(bars):
        label = direction if all(trace.label != direction for trace in traces) else ""
        at = np.full(2, -float(row))
        traces.append(Trace(label, np.array([0.0, value]), at, "thick", (*DIRECTIONS, "").index(direction)))
    lengths = np.array([value for *_, value in bars])
    column = np.full(lengths.size, lengths.max() + 0.08 * np.ptp([0.0, *lengths]))
    texts = tuple(f"{value:.3g}" for value in lengths)
    traces.append(Trace("", column, -np.arange(float(lengths.size)), "words", -1, texts))
    stated = (
        ("torque", float(dataset.torque[0]), "N·m"),
        ("speed", float(dataset.speed[0]) * _RPM, "rpm"),
        ("temperature", float(dataset.temperature[0]) - 273.15, "°C"),
    )
    condition = ", ".join(f"{name} {value:.4g} {unit}" for name, value, unit in stated if np.isfinite(value))
    caption = "Largest minus smallest transmission error, and amplitudes of orders of the output turn."
    names = tuple(name for name, *_ in bars)
    return Panel(f"One condition: {condition}", "[arcsec]", "", tuple(traces), caption, y_names=names)


def _panel(title: str, unit: str, dataset: xr.Dataset, values: xr.DataArray) -> list[Panel]:
    """Return a panel with one map per temperature; lines over the only axis with several values; [] if empty."""
    if not np.isfinite(values).any():
        return []
    names = tuple("" if not np.isfinite(t) else f"{t - 273.15:.4g} °C" for t in dataset.temperature.values)
    labels = {"torque": "torque [N·m]", "speed": "speed [rpm]", "temperature": "temperature [°C]"}
    axes = {
        "torque": dataset.torque.values,
        "speed": dataset.speed.values * _RPM,
        "temperature": dataset.temperature.values - 273.15,
    }
    several = [name for name in ("torque", "speed") if axes[name].size > 1]
    if len(several) < 2:
        across = several[0] if several else "temperature"
        lines = [values.isel(temperature=i) for i in range(len(names))] if several else [values]
        traces: list[Trace] = []
        for i, (name, line) in enumerate(zip(names if several else ("",), lines, strict=True)):
            traces.append(Trace(name, axes[across], line.values.ravel(), "line", i))
            traces.append(Trace("", axes[across], line.values.ravel(), "dots", i))
        at = [
            f"a {name} of {axes[name][0]:.4g} {labels[name].rstrip(']').split(' [')[1]}"
            for name in ("torque", "speed")
            if name not in several and np.isfinite(axes[name][0])
        ]
        caption = f"At {' and '.join(at)}." if at else ""
        return [Panel(title, labels[across], f"[{unit}]", tuple(traces), caption, from_zero=True)]
    maps = tuple(
        HeatMap(
            name,
            dataset.torque.values,
            dataset.speed.values * _RPM,
            values.isel(temperature=i).transpose("speed", "torque").values,
        )
        for i, name in enumerate(names)
    )
    return [Panel(f"{title} [{unit}]", labels["torque"], labels["speed"], (), "", heat=maps)]


def write_maps_report(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write the page of maps (HTML); never a partial file."""
    from markupsafe import Markup

    signs = {
        "size": "Torque is the load's magnitude: its sign follows the direction.",
        "signed": "Torque is signed, of the environment on the output.",
    }
    about = Markup("<p>{} curves. {} Forward: the crank angle increases. The gap is forward minus backward.</p>")
    above = [about.format(dataset.attrs["curves"], signs[dataset.attrs["torque_is"]])]
    notes = notes_of([note for note in dataset.attrs["notes"].split("\n") if note])
    write_page(path, "Maps of a drive", [f"ratio {dataset.attrs['ratio']:g}"], map_panels(dataset), above, [notes])
