"""The certificate of one drive: device, instruments, conditions, figures with limits, decision rule and verdict."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.draw.pages import made_now
from fitting.figures.budget import BUDGET_HEAD, field_factor
from fitting.figures.conformity import RULES, Certificate, Decision, decisions_of, verdict_of
from fitting.figures.metrics import Figures
from fitting.reports.figures_report import BUDGETS, SOURCES, budget_tables, sources_of, title_of
from fitting.reports.page import html_page
from fitting.reports.panels import Panel, Trace

FORMATS = (".html",)
_PAGE = """<p id="verdict"><strong>Verdict: {{ verdict }}</strong></p>
{% for title, rows in tables %}<section><h2>{{ title }}</h2><table class="facts"><tbody>
{% for name, value in rows %}<tr><th>{{ name }}</th><td>{{ value }}</td></tr>
{% endfor %}</tbody></table></section>
{% endfor %}<section><h2>Instruments</h2><table id="instruments"><thead><tr><th>Measures</th><th>Instrument</th>
<th>Serial number</th><th>Calibrated</th></tr></thead><tbody>
{% for row in instruments %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></section>
<section><h2>Results</h2><table id="results"><thead><tr><th>Figure</th><th>Value</th><th>± U</th><th>k</th><th>Unit</th>
<th>Min</th><th>Max</th><th>Decision</th></tr></thead><tbody>
{% for row in results %}<tr>{% for cell in row[:-1] %}<td class="{{ 'number' if 0 < loop.index0 < 4 }}">{{ cell }}</td>
{% endfor %}<td><strong>{{ row[-1] }}</strong></td></tr>
{% endfor %}</tbody></table>
<p class="caption">U is the expanded uncertainty for 95 % (JCGM 100:2008); there is no decision without limits.</p>
<p id="rule">Decision rule: {{ rule }}</p></section>
"""


def write_certificate(figures: Figures, certificate: Certificate, path: str | os.PathLike[str]) -> None:
    """Write the certificate of one drive as a self-contained HTML page; never a partial file.

    Raises
    ------
    edge.InputError
        If the instruments, which the decisions need, are not stated, or the name has another ending.
    """
    target = edge.output_path(path, "path", FORMATS)
    if figures.instruments is None:
        raise edge.InputError(
            "certificate: it needs the instruments of the bench; state them in a file (--instruments)."
        )
    decisions = decisions_of(figures, certificate)
    device = certificate.device
    tables = [
        ("Device", [("Type", device.name), ("Serial number", device.serial_number), ("Maker", device.maker)]),
        ("Conditions", [*_loads(figures), *certificate.conditions.items()]),
    ]
    if certificate.number or certificate.issued_by:
        tables.insert(0, ("Certificate", [("Number", certificate.number), ("Issued by", certificate.issued_by)]))
    instruments = [
        [
            name.replace("_", " "),
            instrument.name or "not stated",
            instrument.serial_number or "not stated",
            "not stated" if instrument.calibrated is None else instrument.calibrated.isoformat(),
        ]
        for name, instrument in figures.instruments.stated.items()
    ]
    page = html_page(
        "Certificate of measurement",
        made_now(),
        _PAGE,
        _limit_panels(decisions),
        BUDGETS + SOURCES,
        verdict=verdict_of(decisions),
        tables=[(t, [(n, v) for n, v in rows if v]) for t, rows in tables],
        instruments=instruments,
        results=_results(figures, decisions),
        rule=RULES[certificate.decision_rule],
        budgets=budget_tables(figures),
        budget_head=BUDGET_HEAD,
        notes=figures.notes,
        sources=sources_of(figures),
    )
    with edge.written_whole(target) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _loads(figures: Figures) -> list[tuple[str, str]]:
    """Return the conditions of the recordings as rows (name, text)."""
    warm = [t for recording in figures.surveyed if (t := recording.overview.temperature) is not None]
    rows = [
        ("Ratio", "" if figures.ratio is None else f"{figures.ratio:g}"),
        ("Rated torque", "" if figures.rated_torque is None else f"{figures.rated_torque:.5g} N·m"),
    ]
    if warm:
        low, high = min(np.nanmin(t) for t in warm) - 273.15, max(np.nanmax(t) for t in warm) - 273.15
        rows.append(("Temperature as recorded", f"{low:.1f} … {high:.1f} °C"))
    rows.append(("Recordings", ", ".join(Path(recording.source).name for recording in figures.surveyed)))
    return rows


def _shown(value: float, expanded: float) -> str:
    if not math.isfinite(value):
        return "" if math.isinf(value) else "missing"
    digits = (
        4 if not math.isfinite(expanded) or expanded <= 0.0 else min(max(1 - math.floor(math.log10(expanded)), 0), 6)
    )
    return f"{value:.{digits}f}"


def _results(figures: Figures, decisions: list[Decision]) -> list[list[str]]:
    """Return the table of figures with their expanded uncertainties; those with limits first."""
    rows = []
    for decision in decisions:
        factor, unit = field_factor(decision.unit)
        expanded = decision.expanded * factor
        rows.append(
            [
                title_of(decision.figure),
                _shown(decision.value * factor, expanded),
                "unknown" if math.isnan(expanded) else _shown(expanded, expanded),
                "" if math.isnan(expanded) else f"{decision.coverage_factor:.2f}",
                unit,
                "" if math.isinf(decision.low) else f"{decision.low * factor:.6g}",
                "" if math.isinf(decision.high) else f"{decision.high * factor:.6g}",
                decision.verdict,
            ]
        )
    limited = {decision.figure for decision in decisions}
    for name, budget in figures.budgets.items():
        if name not in limited:
            factor, unit = field_factor(budget.unit)
            expanded = budget.expanded * factor
            rows.append(
                [
                    title_of(name),
                    _shown(budget.value * factor, expanded),
                    _shown(expanded, expanded),
                    f"{budget.coverage_factor:.2f}",
                    unit,
                    "",
                    "",
                    "",
                ]
            )
    return rows


def _limit_panels(decisions: list[Decision]) -> list[Panel]:
    """Return the panel of decided figures with ± U, in percent of the upper limit, or of the lower one without it."""
    traces = []
    shown = [decision for decision in decisions if math.isfinite(decision.value)]
    for row, decision in enumerate(shown):
        whole = decision.high if math.isfinite(decision.high) and decision.high != 0.0 else decision.low
        scale = 100.0 / whole if whole else 100.0
        y = np.array([-row, -row], float)
        if math.isfinite(decision.expanded):
            ends = np.array([decision.value - decision.expanded, decision.value + decision.expanded]) * scale
            traces.append(Trace("value ± U" if row == 0 else "", ends, y, "thick", 0))
        # From zero, so that a small margin to the limit looks small.
        traces.append(Trace("", np.array([0.0, decision.value * scale]), y, "thin", -1))
        traces.append(Trace("", np.array([decision.value * scale]), y[:1], "points", -1, (decision.verdict,)))
        for bound in (decision.low, decision.high):
            if math.isfinite(bound):
                label = "" if any(t.label == "limit" for t in traces) else "limit"
                at = np.full(2, bound * scale)
                traces.append(Trace(label, at, np.array([-row - 0.35, -row + 0.35]), "thick", 1))
    if not shown:
        return []
    caption = "In percent of the upper limit, or of the lower limit if there is no upper limit."
    names = tuple(title_of(decision.figure) for decision in shown)
    return [Panel("Figures and their limits", "percentage of the limit [%]", "", tuple(traces), caption, y_names=names)]
