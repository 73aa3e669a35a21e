"""The report of a drive: drawing, figures, stresses, verdicts, and what is assumed or not judged."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cycloid_fmu import __version__, edge
from cycloid_fmu.draw.pages import (
    CHARACTERS,
    GREY,
    HEADING,
    HTML_HEAD,
    MONOSPACED,
    Line,
    Sentences,
    Table,
    html_of,
    lines_of,
    made_now,
    text_pages,
)
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.studies import limits
from cycloid_fmu.studies.sized_figures import NOT_COMPUTED, Figure, figures_head
from cycloid_fmu.studies.strength import HEAD as STRESS_HEAD
from cycloid_fmu.studies.strength import Stress

if TYPE_CHECKING:
    from cycloid_fmu.motion import Motion
    from cycloid_fmu.studies.verdicts import Judged

FORMATS = (".html", ".pdf")


class DesignReport(NamedTuple):
    """What a report of a drive says.

    Attributes
    ----------
    title, facts
        Its heading, and one line below.
    motion
        The drive at its rated torque, for the drawing.
    parts
        Tables of figures, stresses, verdicts and materials, and lists of what is assumed and what is not judged.
    text
        The pair file, with its comments.
    """

    title: str
    facts: str
    motion: Motion
    parts: Sequence[Table | Sentences]
    text: str


def comments_of(text: str) -> list[str]:
    """Return the comments at the head of a TOML text, before its first key, a sentence each."""
    found = []
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            break
        if said := line.strip("# "):
            found.append(said)
    return found


def facts_of(drive: DriveValue) -> str:
    """Return the line below a report's heading."""
    pair = drive.pair
    discs = f"{pair.discs} disc{'s' * (pair.discs > 1)}"
    torque = f"rated torque {pair.rated_load():g} N·m"
    outside = f"pin circle {2e3 * pair.pin_circle_radius:g} mm, pins {2e3 * pair.pin_radius:g} mm"
    return f"ratio {drive.ratio:g}, {discs} {pair.face_width * 1e3:g} mm wide, {outside}, {torque}; {made_now()}"


def report_of(
    drive: DriveValue,
    motion: Motion,
    source: str,
    text: str,
    figures: Sequence[Figure],
    stresses: Sequence[Stress],
    judged: Judged | None = None,
) -> DesignReport:
    """Return the report of a drive from what was computed of it.

    Parameters
    ----------
    drive, motion
        The drive, and how it is at its rated torque and a crank angle of 0, of `Drive.motion`.
    source, text
        Name and text of its pair file; comments at its head are what is assumed.
    figures, stresses
        Of `sized_figures.figures_of`.
    judged
        Verdicts on limits, if there are any.
    """
    pair = drive.pair
    tables = [
        _table("Figures at rated torque", figures_head(drive), [each.row() for each in figures]),
        _table("Nominal stresses", STRESS_HEAD, [each.row() for each in stresses]),
    ]
    if judged is not None:
        tables.append(_table("Limits", limits.HEAD, [limits.row_of(each) for each in judged.verdicts]))
    tables.append(_table("Materials", MATERIALS_HEAD, material_rows(pair)))
    missing = [f"{each.part}, {each.kind}: {each.reason}." for each in stresses if each.reason]
    missing += [f"{each.name}: {each.basis}." for each in figures if math.isnan(each.values[0])]
    if pair.losses is None or pair.supports is None:
        missing.append("Efficiency, starting and back-driving torque: state [supports] and [losses].")
    if judged is not None and judged.not_judged:
        missing.append(limits.not_judged_line(judged.not_judged))
    assumed = comments_of(text)
    if pair.bodies is None and not any("rigid" in line for line in assumed):
        assumed.append("Bodies are rigid, as the file states no [bodies]; the real drive is softer.")
    lists = [Sentences("Assumed", assumed, "assumed"), Sentences("Not judged", [*missing, NOT_COMPUTED], "not-judged")]
    return DesignReport("Design report", f"{source}: {facts_of(drive)}", motion, [*tables, *lists], text)


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table whose last column is text."""
    return Table(title, head, rows, styles=(*[""] * (len(head) - 1), "definition"))


MATERIALS_HEAD = ("part", "material", "E, GPa", "yield, MPa", "fatigue, MPa", "source")


def material_rows(pair: Pair) -> list[list[str]]:
    """Return the materials of a drive as table rows, columns `MATERIALS_HEAD`."""
    rows = []
    for part in type(pair.material).model_fields:
        stated = getattr(pair.material, part)
        if stated is None:
            continue
        value = stated.value
        known = ["", "", "no name: strength is not known"]
        if value is not None:
            fatigue = value.bending_fatigue
            known = [
                f"{value.yield_strength[0] * 1e-6:.0f} … {value.yield_strength[1] * 1e-6:.0f}",
                "" if fatigue is None else f"{fatigue[0] * 1e-6:.0f} … {fatigue[1] * 1e-6:.0f}",
                value.source,
            ]
        rows.append([part.replace("_", " "), stated.name or "", f"{stated.youngs_modulus * 1e-9:.4g}", *known])
    return rows


def write_design_report(report: DesignReport, path: str | os.PathLike[str]) -> None:
    """Write a report as one file, HTML or PDF by the ending of the name; never a partial file.

    Raises
    ------
    edge.InputError
        If the name does not end in one of `FORMATS`.
    """
    target = edge.output_path(path, "path", FORMATS)
    with edge.written_whole(target) as temporary:
        if target.suffix.lower() == ".html":
            temporary.write_text(_html(report), encoding="utf-8")
        else:
            _write_pdf(report, temporary)


_BODY = """<section class="drawing">{{ drawing }}</section><p class="caption">{{ caption }}</p>
{% for part in parts %}{{ part }}{% endfor %}
<h2>The file</h2><pre style="white-space: pre-wrap; font-size: .8em">{{ text }}</pre></body></html>
"""
_DRAWING = "<style>section.drawing svg { display: block; max-width: 34em; margin: auto; }</style>"


def _html(report: DesignReport) -> str:
    import jinja2
    from markupsafe import Markup

    from cycloid_fmu.draw.drive_picture import caption_of
    from cycloid_fmu.draw.drive_svg import drive_svg

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(HTML_HEAD + _BODY).render(
        title=report.title,
        facts=report.facts,
        drawing=Markup(_DRAWING + drive_svg(report.motion)),
        caption=caption_of(report.motion),
        parts=[html_of(part) for part in report.parts],
        text=report.text,
    )


def _write_pdf(report: DesignReport, path: Path) -> None:
    from matplotlib.backends.backend_pdf import PdfPages

    from cycloid_fmu.draw.drive_picture import plot_motion

    with PdfPages(path, metadata={"Title": report.title, "Creator": f"cycloid-fmu {__version__}"}) as pdf:
        pdf.savefig(plot_motion(report.motion))
        for page in text_pages(_lines(report)):
            pdf.savefig(page)


def _lines(report: DesignReport) -> list[Line]:
    """Return the text of a report, line by line, with the properties of each."""
    lines: list[Line] = [(report.title, {"fontsize": 16, "weight": "bold"})]
    lines += [(line, GREY) for line in textwrap.wrap(report.facts, CHARACTERS)]
    lines += [line for part in report.parts for line in lines_of(part)]
    lines += [("", {}), ("The file", HEADING)]
    small = {**MONOSPACED, "fontsize": 6.5}
    for line in report.text.splitlines():
        lines += [(part, small) for part in textwrap.wrap(line, 140, subsequent_indent="    ") or [""]]
    return lines
