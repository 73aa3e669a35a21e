"""The page of maps of a drive over its conditions: heat maps over torque and speed, one per temperature."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.edge import ARCMIN, ARCSEC
from fitting.reports.page import html_page, made_now
from fitting.reports.panels import HeatMap, Panel, Trace

if TYPE_CHECKING:
    import xarray as xr

_RPM = 30.0 / math.pi
_ABOVE = """<p>{{ curves }} curves. {{ axis }}</p>
"""
_BELOW = """<h2>Excluded data and notes</h2>
{% if notes %}<ul id="notes">{% for n in notes %}<li>{{ n }}</li>{% endfor %}</ul>{% else %}
<p id="notes">No data were excluded.</p>{% endif %}
"""


def map_panels(found: xr.Dataset) -> list[Panel]:
    """Return one panel for each map and direction, in field units.

    Parameters
    ----------
    found
        Result of `fitting.maps`.
    """
    two = [("forward", "forward"), ("backward", "backward")]
    shown = [
        ("angular_transmission_error", "Angular transmission error", "arcsec", ARCSEC, two),
        ("angular_transmission_error_without_rig", "Angular transmission error without the rig's orders", "arcsec",
         ARCSEC, two),
        ("gap", "Gap between directions", "arcsec", ARCSEC, [("", "")]),
        ("torsional_stiffness", "Torsional stiffness", "N·m/arcmin", 1.0 / ARCMIN, two),
    ]  # fmt: skip
    panels = []
    for name, title, unit, factor, ways in shown:
        for way, said in ways:
            values = found[name].sel(direction=way) if way else found[name]
            panels += _panel(f"{title}{', ' if said else ''}{said}", unit, found, values * factor)
    for order, kind in zip(found.order.values, found.order_name.values, strict=True):
        for way, said in two:
            values = found.order_amplitude.sel(order=order, direction=way) * ARCSEC
            of = f" ({kind})" if kind else ""
            panels += _panel(f"Order {order}{of}, amplitude, {said}", "arcsec", found, values)
    return panels


def _panel(title: str, unit: str, found: xr.Dataset, values: xr.DataArray) -> list[Panel]:
    """Return a panel with one map per temperature; for a single torque or speed, lines over the other; [] if empty."""
    if not np.isfinite(values).any():
        return []
    names = tuple(
        "" if not np.isfinite(t) else f"{t - 273.15:.4g} °C" for t in found.temperature.values
    )  # fmt: skip
    labels = {"torque": "torque [N·m]", "speed": "speed [rpm]"}
    axes = {"torque": found.torque.values, "speed": found.speed.values * _RPM}
    for across, alone in (("torque", "speed"), ("speed", "torque")):
        if axes[alone].size == 1 < axes[across].size:
            traces: list[Trace] = []
            for i, name in enumerate(names):
                line = values.isel(temperature=i).squeeze(alone).values
                traces.append(Trace(name, axes[across], line, "line", i))
                traces.append(Trace("", axes[across], line, "dots", i))
            (at,) = axes[alone]
            word, shown = labels[alone].rstrip("]").split(" [")
            caption = "" if np.isnan(at) else f"At a {word} of {at:.4g} {shown}."
            return [Panel(title, labels[across], f"[{unit}]", tuple(traces), caption)]
    maps = tuple(
        HeatMap(
            name, found.torque.values, found.speed.values * _RPM,
            values.isel(temperature=i).transpose("speed", "torque").values,
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    return [Panel(f"{title} [{unit}]", labels["torque"], labels["speed"], (), "", heat=maps)]


def write_maps_report(found: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write the page of maps (HTML); never a partial file."""
    target = edge.output_path(path, "path", (".html",))
    signs = {
        "size": "Torque is the load's magnitude: its sign follows the direction.",
        "signed": "Torque is signed, of the environment on the output.",
    }
    axis = f"{signs[found.attrs['torque_is']]} Forward: the crank angle increases. The gap is forward minus backward."
    text = html_page(
        "Maps of a drive", f"ratio {found.attrs['ratio']:g}, {made_now()}", _ABOVE, map_panels(found), _BELOW,
        curves=found.attrs["curves"], axis=axis, notes=[n for n in found.attrs["notes"].split("\n") if n],
    )  # fmt: skip
    with edge.written_whole(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
