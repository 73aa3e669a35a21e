"""The report of figures: one self-contained HTML file, or a PDF of the same content."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.draw.figure import figure_of_names
from cycloid_fmu.draw.pages import A4, HEADING, MONOSPACED, made_now, text_pages
from fitting.figures.budget import BUDGET_HEAD, budget_rows
from fitting.figures.figure import DEFINITIONS, Figure, in_field_units
from fitting.figures.metrics import FRICTION_FREE, Figures
from fitting.figures.orders import ORDERS_HEAD, order_rows
from fitting.reports.page import html_page
from fitting.reports.panels import Panel, panels_of

FORMATS = (".html", ".pdf")


def title_of(name: str) -> str:
    """Return a figure's name as a heading: of two with the same name, one with friction, that without says so."""
    own = name.removeprefix(FRICTION_FREE)
    return own.replace("_", " ").capitalize() + (" without friction" if own != name and own in DEFINITIONS else "")


def write_figures_report(figures: Figures, path: str | os.PathLike[str]) -> None:
    """Write the report of figures as HTML or PDF, by the ending of the name; never a partial file."""
    target = edge.output_path(path, "path", FORMATS)
    panels = panels_of(figures)
    with edge.written_whole(target) as temporary:
        if target.suffix.lower() == ".html":
            temporary.write_text(html_report(figures, panels), encoding="utf-8")
        else:
            _write_pdf(figures, panels, temporary)


def figure_rows(figures: Figures) -> list[dict[str, str]]:
    """Return the table of figures: a row for each figure, and rows with `part` set for its parts and runs."""
    rows = []
    for name, figure in figures.shown.items():
        definition = f"{figure.definition}. Here it {figure.remark}" if figure.remark else figure.definition
        rows.append(_row(title_of(name), figure, definition=definition))
        rows += [_row(part, of_part, part="yes") for part, of_part in figure.shown.items()]
    return rows


def _row(name: str, figure: Figure, *, definition: str = "", part: str = "") -> dict[str, str]:
    value, uncertainty, unit = in_field_units(figure)
    interval = ""
    if figure.interval is not None:
        low, high = figure.interval
        if figure.interval_unit == "rad":
            interval = f"{math.degrees(low):g} … {math.degrees(high):g}°"
        else:
            interval = f"{low:.4g} … {high:.4g} N·m"
    return {
        "name": name,
        "value": value,
        "uncertainty": uncertainty,
        "unit": unit,
        "interval": interval,
        "of": f"{figure.count:.4g} {figure.counted}",
        "definition": definition,
        "part": part,
    }


def sources_of(figures: Figures) -> list[dict[str, str]]:
    """Return the table of recordings: file, kind, samples, time, temperature and checksum."""
    rows = []
    for recording in figures.surveyed:
        temperature = recording.overview.temperature
        warm = "" if temperature is None else f"{np.nanmean(temperature) - 273.15:.1f} °C"
        kind = "loops" if recording.loops is not None else "run"
        rows.append(
            {
                "name": Path(recording.source).name,
                "kind": kind,
                "samples": f"{recording.samples:,}",
                "time": f"{recording.duration:.4g} s" if recording.overview.timed else "unknown",
                "temperature": warm,
                "checksum": recording.checksum,
            }
        )
    return rows


def _facts(figures: Figures) -> str:
    facts = []
    if figures.ratio is not None:
        facts.append(f"ratio {figures.ratio:g}")
    if figures.rated_torque is not None:
        facts.append(f"rated torque {figures.rated_torque:.5g} N·m")
    return ", ".join([*facts, made_now()])


BUDGETS = """{% for title, table in budgets %}{% if loop.first %}<h2>Uncertainty budgets (JCGM 100:2008)</h2>
{% endif %}<section><h3>{{ title }}</h3><table class="budget"><thead><tr>
{% for h in budget_head %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for row in table %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></section>
{% endfor %}"""


def budget_tables(figures: Figures) -> list[tuple[str, list[list[str]]]]:
    """Return the title and rows of each budget."""
    return [(title_of(name), budget_rows(budget)) for name, budget in figures.budgets.items()]


_FIGURES = (
    """<h2>Figures</h2>
{% if rows %}<table id="figures"><thead><tr><th>Figure</th><th>Value</th><th>± (95 %)</th><th>Unit</th><th>Of</th>
<th>Interval</th><th>Definition</th></tr></thead><tbody>
{% for r in rows %}<tr class="{{ 'part' if r.part else 'figure' }}"><td>{{ r.name }}</td>
<td class="number">{{ r.value }}</td><td class="number">{{ r.uncertainty }}</td><td>{{ r.unit }}</td>
<td class="number">{{ r.of }}</td>
<td>{{ r.interval if not r.part }}</td><td class="definition">{{ r.definition }}</td></tr>
{% endfor %}</tbody></table>{% else %}<p>No figure could be computed; the notes give the reasons.</p>{% endif %}
"""
    + BUDGETS
    + """{% if orders %}<h2>Largest orders of the transmission error, per output turn</h2><table id="orders"><thead><tr>
{% for h in orders_head %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for row in orders %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>{% endif %}
"""
)
SOURCES = """<h2>Excluded data and notes</h2>
{% if notes %}<ul id="notes">{% for n in notes %}<li>{{ n }}</li>{% endfor %}</ul>{% else %}
<p id="notes">No data were excluded.</p>{% endif %}
<h2>Recordings</h2><table id="recordings"><thead><tr><th>File</th><th>Kind</th><th>Samples</th><th>Time</th>
<th>Temperature</th><th>SHA-256</th></tr></thead><tbody>
{% for s in sources %}<tr><td>{{ s.name }}</td><td>{{ s.kind }}</td><td class="number">{{ s.samples }}</td>
<td class="number">{{ s.time }}</td><td>{{ s.temperature }}</td><td><code>{{ s.checksum }}</code></td></tr>
{% endfor %}</tbody></table>
"""


def html_report(figures: Figures, panels: Sequence[Panel]) -> str:
    """Return the report as one self-contained HTML page."""
    return html_page(
        "Test bench report",
        _facts(figures),
        _FIGURES,
        panels,
        SOURCES,
        rows=figure_rows(figures),
        notes=figures.notes,
        sources=sources_of(figures),
        budgets=budget_tables(figures),
        budget_head=BUDGET_HEAD,
        orders=order_rows(figures.orders),
        orders_head=ORDERS_HEAD,
    )


def _write_pdf(figures: Figures, panels: Sequence[Panel], path: Path) -> None:
    from matplotlib.backends.backend_pdf import PdfPages

    from fitting.reports.drawing import draw_panel

    with PdfPages(path, metadata={"Title": "Test bench report", "Creator": f"cycloid-fmu {__version__}"}) as pdf:
        for page in text_pages(_text_lines(figures)):
            pdf.savefig(page)
        for begin in range(0, len(panels), 2):
            page = figure_of_names()(figsize=A4, layout="constrained")
            page.get_layout_engine().set(rect=(0.03, 0.03, 0.94, 0.94), hspace=0.08)  # type: ignore[union-attr, call-arg]
            axes = page.subplots(2, 1)
            for axis in axes[len(panels[begin : begin + 2]) :]:
                axis.set_axis_off()
            for axis, panel in zip(axes, panels[begin : begin + 2], strict=False):
                draw_panel(axis, panel)
                caption = "\n".join(textwrap.wrap(panel.caption, 110))
                axis.set_xlabel(f"{panel.x_label}\n{caption}", fontsize=8)
            pdf.savefig(page)


def _text_lines(figures: Figures) -> list[tuple[str, dict[str, Any]]]:
    """Return text lines with the table of figures, the budgets, the notes and the recordings."""
    lines: list[tuple[str, dict[str, Any]]] = [
        ("Test bench report", {"fontsize": 16, "weight": "bold"}),
        (_facts(figures), {"color": "#555555"}),
        ("", {}),
    ]
    mono, heading = MONOSPACED, HEADING
    lines.append(("Figures", heading))
    lines.append((f"{'figure':<42} {'value':>10} {'± (95 %)':>10} {'unit':<11} of", {**mono, "weight": "bold"}))
    for row in figure_rows(figures):
        name = f"  {row['name']}" if row["part"] else row["name"]
        name = name if len(name) <= 42 else f"{name[:3]}…{name[-38:]}"
        text = f"{name:<42} {row['value']:>10} {row['uncertainty']:>10} {row['unit']:<11} {row['of']}"
        lines.append((text, mono))
        if row["definition"]:
            text = f"{row['definition']}; {row['interval']}" if row["interval"] else row["definition"]
            lines += [(f"    {line}", {"color": "#555555", "fontsize": 7}) for line in textwrap.wrap(text, 120)]
    for title, table in budget_tables(figures):
        lines += [("", {}), (f"Uncertainty budget: {title}", heading)]
        for cells in (BUDGET_HEAD, *table):
            source, kind, distribution, uncertainty, sensitivity, contribution, degrees = cells
            text = f"{source:<32} {kind:<4} {distribution:<12} {uncertainty:<20} {sensitivity:>11} {contribution:>20}"
            lines.append((f"{text} {degrees:>8.7}", {**mono, "fontsize": 6.5}))
    if orders := order_rows(figures.orders):
        lines += [("", {}), ("Largest orders of the transmission error, per output turn", heading)]
        lines += [("{:<30} {:>12} {:>12} {:<10} {}".format(*row), mono) for row in (ORDERS_HEAD, *orders)]
    lines += [("", {}), ("Excluded data and notes", heading)]
    for note in figures.notes or ("No data were excluded.",):
        lines += [(line, {}) for line in textwrap.wrap(note, 112, subsequent_indent="    ")]
    lines += [("", {}), ("Recordings", heading)]
    for s in sources_of(figures):
        lines.append(
            (
                ", ".join(filter(None, (s["name"], s["kind"], f"{s['samples']} samples", s["time"], s["temperature"]))),
                {},
            )
        )
        lines.append((f"    SHA-256 {s['checksum']}", {**mono, "fontsize": 6.5, "color": "#777777"}))
    return lines
