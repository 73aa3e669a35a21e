"""The certificate of one drive: device, instruments, conditions, figures with limits, decision rule and verdict."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.draw.pages import Table
from fitting.figures.budget import field_factor
from fitting.figures.conformity import RULES, Certificate, Decision, decisions_of, verdict_of
from fitting.figures.metrics import Figures
from fitting.reports.figures_report import budget_tables, data_of, title_of
from fitting.reports.page import Part, write_page
from fitting.reports.panels import Panel, Trace


def write_certificate(figures: Figures, certificate: Certificate, path: str | os.PathLike[str]) -> None:
    """Write the certificate of one drive as a self-contained HTML page; never a partial file.

    Raises
    ------
    edge.InputError
        If the instruments, which the decisions need, are not stated, or the name has another ending.
    """
    from markupsafe import Markup

    if figures.instruments is None:
        raise edge.InputError(
            "certificate: it needs the instruments of the bench; state them in a file (--instruments)."
        )
    decisions, device = decisions_of(figures, certificate), certificate.device
    facts = {
        "Certificate": [("Number", certificate.number), ("Issued by", certificate.issued_by)],
        "Device": [("Type", device.name), ("Serial number", device.serial_number), ("Maker", device.maker)],
        "Conditions": [*_loads(figures), *certificate.conditions.items()],
    }
    stated = {title: [(name, text) for name, text in rows if text] for title, rows in facts.items()}
    instruments = [
        [
            name.replace("_", " "),
            instrument.name or "not stated",
            instrument.serial_number or "not stated",
            "not stated" if instrument.calibrated is None else instrument.calibrated.isoformat(),
        ]
        for name, instrument in figures.instruments.stated.items()
    ]
    head = ("Measures", "Instrument", "Serial number", "Calibrated")
    above: list[Part] = [
        Markup('<p id="verdict"><strong>Verdict: {}</strong></p>').format(verdict_of(decisions)),
        *(Table(title, (), rows) for title, rows in stated.items() if rows),
        Table("Instruments", head, instruments, "instruments"),
        _results(figures, decisions, RULES[certificate.decision_rule]),
    ]
    below: list[Part] = [*budget_tables(figures), *data_of(figures)]
    write_page(path, "Certificate of measurement", [], _limit_panels(decisions), above, below)


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


def _results(figures: Figures, decisions: list[Decision], rule: str) -> Table:
    """Return the table of figures with their expanded uncertainties; those with limits first."""
    limited = {decision.figure for decision in decisions}
    others = [
        Decision(name, budget.unit, budget.value, budget.expanded, budget.coverage_factor)
        for name, budget in figures.budgets.items()
        if name not in limited
    ]
    rows = []
    for decision in (*decisions, *others):
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
    head = ("Figure", "Value", "± U", "k", "Unit", "Min", "Max", "Decision")
    caption = (
        "U is the expanded uncertainty for 95 % (JCGM 100:2008); there is no decision without limits. Decision rule: "
        f"{rule}"
    )
    return Table("Results", head, rows, "results", ("", "number", "number", "number", "", "", "", "strong"), caption)


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
