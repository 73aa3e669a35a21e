"""What reports as files have in common: the head of an HTML page, and lines of text on the pages of a PDF."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from cycloid_fmu import __version__
from cycloid_fmu.draw.figure import figure_of_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

A4 = (8.27, 11.69)
"""Size of a page, inch."""
MONOSPACED = {"family": "DejaVu Sans Mono", "fontsize": 8}
HEADING = {"weight": "bold", "fontsize": 11}
_LINES = 62  # lines of text per page

HTML_HEAD = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #222; max-width: 960px;
  margin: 1.5em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin: 0; } h2 { font-size: 1.15em; margin: 1.6em 0 .3em; }
p.facts, p.caption { color: #555; margin: .2em 0 .6em; } p.caption { font-size: .9em; }
table { border-collapse: collapse; width: 100%; } th { text-align: left; font-weight: 600; }
th, td { padding: .25em .6em .25em 0; border-bottom: 1px solid #ddd; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.wrapped { white-space: normal; }
tr.part td { color: #555; font-size: .92em; border-bottom-style: dotted; }
tr.part td:first-child { padding-left: 1.2em; }
td.definition { font-size: .85em; color: #555; } code { font-size: .8em; word-break: break-all; color: #777; }
.panel { height: 380px; } section { break-inside: avoid; } li { margin: .2em 0; }
@media (max-width: 700px) { table { display: block; overflow-x: auto; } td.definition { min-width: 16em; }
  code { word-break: normal; } }
@media print { body { margin: 0; max-width: none; font-size: 11px; } .panel { height: 300px; }
  .modebar { display: none; } }
</style></head><body>
<h1>{{ title }}</h1><p class="facts">{{ facts }}</p>
"""
"""Head of an HTML report, a jinja2 template of `title` and `facts`."""


def made_now() -> str:
    """Return date and version for the head of a report."""
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return f"made {now} with cycloid-fmu {__version__}"


def text_pages(lines: Sequence[tuple[str, dict[str, Any]]]) -> Iterator[Figure]:
    """Yield A4 pages of text lines, each with matplotlib's properties of its text."""
    for begin in range(0, len(lines), _LINES):
        page = figure_of_names()(figsize=A4)
        for number, (text, style) in enumerate(lines[begin : begin + _LINES]):
            page.text(0.07, 0.95 - number * 0.9 / _LINES, text, **{"fontsize": 8.5, **style})
        yield page
