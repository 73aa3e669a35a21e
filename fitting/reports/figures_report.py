"""The report of figures: one self-contained HTML file, or a PDF of the same content."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.draw.figure import figure_of_names
from cycloid_fmu.draw.pages import A4, GREY, Line, Sentences, Table, lines_of, made_now, text_pages
from fitting.figures.budget import BUDGET_HEAD, budget_rows
from fitting.figures.figure import DEFINITIONS, Figure, in_field_units
from fitting.figures.metrics import FRICTION_FREE, Figures
from fitting.figures.orders import ORDERS_HEAD, order_rows
from fitting.reports.page import write_page
from fitting.reports.panels import Panel, panels_of

FORMATS = (".html", ".pdf")
TITLE = "Test bench report"


def title_of(name: str) -> str:
    """Return a figure's name as a heading: of two with the same name, one with friction, that without says so."""
    own = name.removeprefix(FRICTION_FREE)
    return own.replace("_", " ").capitalize() + (" without friction" if own != name and own in DEFINITIONS else "")


def write_figures_report(figures: Figures, path: str | os.PathLike[str]) -> None:
    """Write the report of figures as HTML or PDF, by the ending of the name; never a partial file."""
    target = edge.output_path(path, "path", FORMATS)
    facts = [] if figures.ratio is None else [f"ratio {figures.ratio:g}"]
    facts += [] if figures.rated_torque is None else [f"rated torque {figures.rated_torque:.5g} N·m"]
    panels = panels_of(figures)
    above, below = figure_tables(figures), data_of(figures)
    if target.suffix.lower() == ".html":
        write_page(target, TITLE, facts, panels, above, below)
        return
    lines: list[Line] = [(TITLE, {"fontsize": 16, "weight": "bold"}), (", ".join([*facts, made_now()]), GREY)]
    lines += [line for part in (*above, *below) for line in lines_of(part)]
    with edge.written_whole(target) as temporary:
        _write_pdf(lines, panels, temporary)


def figure_tables(figures: Figures) -> list[Table | Sentences]:
    """Return the tables of figures, of their uncertainty budgets, and of the largest orders."""
    rows = []
    for name, figure in figures.shown.items():
        definition = f"{figure.definition}. Here it {figure.remark}" if figure.remark else figure.definition
        rows.append(_figure_row(title_of(name), figure, _interval(figure), definition))
        rows += [_figure_row(f"  {part}", of_part) for part, of_part in figure.shown.items()]
    head = ("Figure", "Value", "± (95 %)", "Unit", "Of", "Interval", "Definition")
    styles = ("", "number", "number", "", "number", "", "definition")
    without = "No figure could be computed; the notes give the reasons."
    tables: list[Table | Sentences] = [Sentences("Figures", (), "figures", without)]
    if rows:
        tables = [Table("Figures", head, rows, "figures", styles), *budget_tables(figures)]
    if orders := order_rows(figures.orders):
        title = "Largest orders of the transmission error, per output turn"
        tables.append(Table(title, ORDERS_HEAD, orders, "orders", ("", "number", "number")))
    return tables


def _figure_row(name: str, figure: Figure, interval: str = "", definition: str = "") -> list[str]:
    return [name, *in_field_units(figure), f"{figure.count:.4g} {figure.counted}", interval, definition]


def _interval(figure: Figure) -> str:
    if figure.interval is None:
        return ""
    low, high = figure.interval
    if figure.interval_unit == "rad":
        return f"{math.degrees(low):g} … {math.degrees(high):g}°"
    return f"{low:.4g} … {high:.4g} N·m"


def budget_tables(figures: Figures) -> list[Table]:
    """Return the table of each uncertainty budget."""
    title = "Uncertainty budget (JCGM 100:2008): "
    return [Table(title + title_of(name), BUDGET_HEAD, budget_rows(b)) for name, b in figures.budgets.items()]


def notes_of(notes: Sequence[str]) -> Sentences:
    """Return the list of notes on data that are left out."""
    return Sentences("Excluded data and notes", notes, "notes", "No data were excluded.")


def data_of(figures: Figures) -> list[Table | Sentences]:
    """Return the notes, and the table of recordings: file, kind, samples, time, temperature and checksum."""
    rows = []
    for recording in figures.surveyed:
        temperature = recording.overview.temperature
        rows.append(
            [
                Path(recording.source).name,
                "loops" if recording.loops is not None else "run",
                f"{recording.samples:,}",
                f"{recording.duration:.4g} s" if recording.overview.timed else "unknown",
                "" if temperature is None else f"{np.nanmean(temperature) - 273.15:.1f} °C",
                recording.checksum,
            ]
        )
    head = ("File", "Kind", "Samples", "Time", "Temperature", "SHA-256")
    recordings = Table("Recordings", head, rows, "recordings", ("", "", "number", "number", "", "code"))
    return [notes_of(figures.notes), recordings]


def _write_pdf(lines: Sequence[Line], panels: Sequence[Panel], path: Path) -> None:
    from matplotlib.backends.backend_pdf import PdfPages

    from fitting.reports.drawing import draw_panel

    with PdfPages(path, metadata={"Title": TITLE, "Creator": f"cycloid-fmu {__version__}"}) as pdf:
        for page in text_pages(lines):
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
