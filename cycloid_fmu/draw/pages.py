"""What reports as files have in common: tables and lists, in HTML and as lines of text on the pages of a PDF."""

from __future__ import annotations

import datetime
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cycloid_fmu import __version__
from cycloid_fmu.draw.figure import figure_of_names
from cycloid_fmu.edge import packaged_text

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

A4 = (8.27, 11.69)
"""Size of a page, inch."""
MONOSPACED = {"family": "DejaVu Sans Mono", "fontsize": 8}
HEADING = {"weight": "bold", "fontsize": 11}
GREY = {"color": "#555555"}
CHARACTERS = 110
"""Of a line of text on a page."""
_LINES = 62  # lines of text per page
_MOST_COLUMN = 42  # characters of a table's column but for checksums and definitions

HTML_HEAD = packaged_text("cycloid_fmu.draw", "report_head.html")
"""Head of an HTML report, a jinja2 template of `title` and `facts`."""


Line = tuple[str, dict[str, Any]]  # a line of text on a page, with matplotlib's properties of it


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Attributes
    ----------
    title
        Its heading, "" for none.
    head
        Names of the columns; empty where the first column names the values.
    rows
        Cells as text. A row whose first cell is indented is a part of the one above.
    name
        Its `id` in HTML, "" for none.
    styles
        Style of each column: "" or "number", also "number wrapped", "strong", "definition" in small letters, or "code".
    caption
        Sentences below it.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    name: str = ""
    styles: Sequence[str] = ()
    caption: str = ""


@dataclass(frozen=True)
class Sentences:
    """A list of sentences in a report: heading, sentences, `id` in HTML, and the text where there are none."""

    title: str
    sentences: Sequence[str]
    name: str = ""
    without: str = ""


def html_of(part: Table | Sentences) -> Markup:
    """Return a table or a list as HTML, with the characters of its texts escaped."""
    import jinja2
    from markupsafe import Markup

    name = "report_table.html" if isinstance(part, Table) else "report_sentences.html"
    template = jinja2.Environment(autoescape=True).from_string(packaged_text("cycloid_fmu.draw", name))
    return Markup(template.render(vars(part)))


def lines_of(part: Table | Sentences) -> list[Line]:
    """Return a table or a list as lines of text; a definition that finds no room is wrapped below its row."""
    lines: list[Line] = [("", {}), (part.title, HEADING)]
    if isinstance(part, Sentences):
        for sentence in part.sentences or (part.without,):
            wrapped = textwrap.wrap(sentence, CHARACTERS, initial_indent="- ", subsequent_indent="  ")
            lines += [(line, {}) for line in wrapped]
        return lines
    styles = [*part.styles, *[""] * (len(part.head) - len(part.styles))]
    is_defined = styles[-1] == "definition"
    cells = [[_cut(cell, style) for cell, style in zip(row, styles, strict=True)] for row in (part.head, *part.rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    widths = widths[:-1] if is_defined else widths
    whole = sum(widths) + 2 * len(widths)
    style = {**MONOSPACED, "fontsize": min(8.0, 8.0 * CHARACTERS / whole)}
    for number, row in enumerate(cells):
        row_style = {**style, "weight": "bold" if number == 0 else "normal"}
        columns = zip(row, widths, styles, strict=False)
        text = "  ".join(c.rjust(width) if kind == "number" else c.ljust(width) for c, width, kind in columns)
        if is_defined and len(row[-1]) <= CHARACTERS - whole:
            lines.append((f"{text}  {row[-1]}", row_style))
            continue
        lines.append((text, row_style))
        if is_defined and number > 0:
            lines += [(f"    {line}", {**GREY, "fontsize": 7}) for line in textwrap.wrap(row[-1], 125)]
    return lines


def _cut(cell: str, style: str) -> str:
    """Return a cell without its middle if it is too long for a column; names of files differ at their ends."""
    if len(cell) <= _MOST_COLUMN or style in ("definition", "code"):
        return cell
    return f"{cell[: _MOST_COLUMN // 3]}…{cell[1 + _MOST_COLUMN // 3 - _MOST_COLUMN :]}"


def made_now() -> str:
    """Return date and version for the head of a report."""
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return f"made {now} with cycloid-fmu {__version__}"


def text_pages(lines: Sequence[Line]) -> Iterator[Figure]:
    """Yield A4 pages of text lines, each with matplotlib's properties of its text."""
    for begin in range(0, len(lines), _LINES):
        page = figure_of_names()(figsize=A4)
        for number, (text, style) in enumerate(lines[begin : begin + _LINES]):
            page.text(0.07, 0.95 - number * 0.9 / _LINES, text, **{"fontsize": 8.5, **style})
        yield page
