"""A page of a report: self-contained HTML with interactive panels."""

from __future__ import annotations

import base64
import html
import json
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.draw.pages import HTML_HEAD, Sentences, Table, html_of, made_now
from fitting.reports.panels import Panel, Trace, names_above, x_range

if TYPE_CHECKING:
    from markupsafe import Markup

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2")
GREY = "#777777"


_PAGE = (
    HTML_HEAD
    + """{% for part in above %}{{ part }}{% endfor %}
{% for p in panels %}<section><h2>{{ p.title }}</h2><div class="panel" id="panel-{{ loop.index0 }}"
{% if p.y_names|length > 16 %} style="height: {{ 110 + 17 * p.y_names|length }}px"{% endif %}></div>
<p class="caption">{{ p.caption }}</p></section>
{% endfor %}{% for part in below %}{{ part }}{% endfor %}
<script>{{ plotly }}</script>
<script>
const panels = {{ data }};
panels.forEach((p, i) => Plotly.newPlot("panel-" + i, p.data, p.layout, {responsive: true, displaylogo: false}));
const fit = () => panels.forEach((_, i) => Plotly.Plots.resize("panel-" + i));
window.matchMedia("print").addEventListener("change", fit);
window.addEventListener("beforeprint", fit);
</script></body></html>
"""
)

Part: TypeAlias = "Table | Sentences | Markup"
"""A part of a page besides its panels."""


def html_page(
    title: str, facts: str, panels: Sequence[Panel], above: Sequence[Part] = (), below: Sequence[Part] = ()
) -> str:
    """Return one self-contained HTML page: parts above the panels, the panels, parts below; texts are escaped."""
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(_PAGE).render(
        title=title,
        facts=facts,
        panels=panels,
        above=[part if isinstance(part, Markup) else html_of(part) for part in above],
        below=[part if isinstance(part, Markup) else html_of(part) for part in below],
        plotly=Markup(script()),
        data=Markup(json.dumps([_named(_plotly(panel)) for panel in panels])),
    )


def write_page(
    path: str | os.PathLike[str],
    title: str,
    facts: Sequence[str],
    panels: Sequence[Panel],
    above: Sequence[Part] = (),
    below: Sequence[Part] = (),
) -> None:
    """Write a page with the date below its title; never a partial file.

    Raises
    ------
    edge.InputError
        If the name does not end in `.html`, or plotly is not installed.
    """
    target = edge.output_path(path, "path", (".html",))
    text = html_page(title, ", ".join([*facts, made_now()]), panels, above, below)
    with edge.written_whole(target) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _named(data: Any) -> Any:
    """Return data of plotly with names as names: it reads tags such as links in texts, and none can end the script."""
    if isinstance(data, dict):
        return {key: _named(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_named(value) for value in data]
    return html.escape(data, quote=False) if isinstance(data, str) else data


def script() -> str:
    """Return the JavaScript of plotly.

    Raises
    ------
    edge.InputError
        If plotly is not installed; it names the extra.
    """
    with edge.needs_extra("reports", lambda message: edge.InputError(f"report in HTML: {message}.")):
        from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _packed(values: Any) -> dict[str, str]:
    """Pack numbers for plotly with sufficient digits: 32 bit, base 64."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


_PLOTLY_LINES: dict[str, dict[str, Any]] = {
    "line": {"width": 1.5},
    "thin": {"width": 1.0},
    "dashed": {"width": 1.2, "dash": "dash"},
    "thick": {"width": 3.5},
}


def _colour(trace: Trace) -> str:
    return GREY if trace.colour < 0 else COLOURS[trace.colour % len(COLOURS)]


def _heat(panel: Panel) -> dict[str, Any]:
    """Return the plotly data of maps side by side on one colour scale."""
    finite = np.concatenate([heat.z[np.isfinite(heat.z)] for heat in panel.heat])
    scale = {"cmin": float(finite.min()), "cmax": float(finite.max()), "colorscale": "Viridis"}
    layout: dict[str, Any] = {"margin": {"l": 60, "r": 20, "t": 30, "b": 55}, "coloraxis": scale}
    data, room, notes = [], 1.0 / len(panel.heat), []
    for number, heat in enumerate(panel.heat):
        key = "" if number == 0 else str(number + 1)
        x, y = ([f"{v:.4g}" if np.isfinite(v) else "" for v in axis] for axis in (heat.x, heat.y))
        z = [[None if np.isnan(v) else float(f"{v:.6g}") for v in row] for row in heat.z]
        data.append(
            {
                "type": "heatmap",
                "x": x,
                "y": y,
                "z": z,
                "name": heat.name,
                "coloraxis": "coloraxis",
                "xaxis": f"x{key}",
                "yaxis": f"y{key}",
            }
        )
        begin = number * room
        domain = [begin, begin + room * (0.92 if len(panel.heat) > 1 else 1.0)]
        layout[f"xaxis{key}"] = {"type": "category", "domain": domain, "anchor": f"y{key}", "tickfont": {"size": 10}}
        layout[f"yaxis{key}"] = {"type": "category", "anchor": f"x{key}", "showticklabels": number == 0}
        notes.append(
            {"text": heat.name, "x": sum(domain) / 2, "y": 1.06, "xref": "paper", "yref": "paper", "showarrow": False}
        )
    layout["xaxis"]["title"], layout["yaxis"]["title"] = {"text": panel.x_label}, {"text": panel.y_label}
    return {"data": data, "layout": {**layout, "annotations": notes}}


def _plotly(panel: Panel) -> dict[str, Any]:
    if panel.heat:
        return _heat(panel)
    return {"data": [_scatter(trace, named=not panel.log_x) for trace in panel.traces], "layout": _layout(panel)}


def _scatter(trace: Trace, *, named: bool) -> dict[str, Any]:
    """Return the plotly data of a curve or of points, with the names of points beside them if `named`."""
    data: dict[str, Any] = {
        "type": "scatter",
        "x": _packed(trace.x),
        "y": _packed(trace.y),
        "name": trace.label,
        "showlegend": bool(trace.label),
        "mode": "lines",
    }
    if trace.colour >= 0:
        data["legendgroup"] = str(trace.colour)  # a click on the name hides lines and points of one colour
    words = {"text": list(trace.texts), "textfont": {"size": 11}, "cliponaxis": False}
    if trace.style == "points":
        marker = {"color": "#222" if trace.texts else GREY, "size": 5 if trace.texts else 2}
        data |= {"mode": "markers", "marker": marker}
        if trace.texts and named:
            data |= {"mode": "markers+text", "textposition": "top center", **words}
    elif trace.style in ("dots", "circles"):
        symbol = "circle-open" if trace.style == "circles" else "circle"
        data |= {"mode": "markers", "marker": {"color": _colour(trace), "size": 4, "symbol": symbol}}
    elif trace.style == "band":
        data |= {"fill": "toself", "fillcolor": _colour(trace), "opacity": 0.3, "line": {"width": 0}}
    elif trace.style == "words":
        data |= {"mode": "text", "hoverinfo": "skip", **words}
    else:
        data["line"] = {**_PLOTLY_LINES[trace.style], "color": _colour(trace)}
    return data


def _layout(panel: Panel) -> dict[str, Any]:
    """Return the plotly layout of a panel of curves."""
    axis = {"gridcolor": "#e5e5e5", "zeroline": False, "ticks": "outside", "automargin": True}
    layout: dict[str, Any] = {
        "margin": {"l": 60, "r": 20, "t": 30, "b": 45},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "xaxis": {**axis, "title": {"text": panel.x_label}},
        "yaxis": {**axis, "title": {"text": panel.y_label}, "type": "log" if panel.log_y else "linear"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        "modebar": {"orientation": "v"},
        "hovermode": "closest",
    }
    if panel.from_zero:
        layout["yaxis"]["rangemode"] = "tozero"
    if panel.y_names:
        rows = [-row for row in range(len(panel.y_names))]
        layout["yaxis"] |= {"tickvals": rows, "ticktext": list(panel.y_names), "tickfont": {"size": 10}}
    for name, limits, logarithmic in (("x", panel.x_limits, panel.log_x), ("y", panel.y_limits, panel.log_y)):
        if limits is not None:
            layout[f"{name}axis"]["range"] = np.log10(limits).tolist() if logarithmic else limits
    if panel.log_x:
        layout["xaxis"] |= {"type": "log", "range": np.log10(x_range(panel)).tolist()}
        if any(trace.texts for trace in panel.traces):
            _name_above(panel, layout)
    if panel.round:
        layout["margin"] |= {"l": 10, "r": 10, "b": 10}
        layout["xaxis"] = {"visible": False}
        layout["yaxis"] = {"visible": False, "scaleanchor": "x"}
    return layout


def _name_above(panel: Panel, layout: dict[str, Any]) -> None:
    """Make room for the names of points, and put them upright in a row above, each with a line to its point."""
    low, high = (math.log10(end) for end in x_range(panel))
    lowest, highest = (
        math.log10(end(float(end(t.y[t.y > 0.0])) for t in panel.traces if (t.y > 0.0).any())) for end in (min, max)
    )
    top = highest + 0.5 * (highest - lowest)
    layout["yaxis"] |= {"range": [lowest, top]}
    layout["annotations"] = [
        {
            "text": text,
            "x": math.log10(x),
            "y": math.log10(y),
            "ax": low + position * (high - low),
            "ay": highest + 0.3 * (highest - lowest),
            "axref": "x",
            "ayref": "y",
            "textangle": -90,
            "font": {"size": 11},
            "arrowhead": 0,
            "arrowwidth": 0.6,
            "arrowcolor": GREY,
        }
        for x, y, position, text in names_above(panel)
    ]
