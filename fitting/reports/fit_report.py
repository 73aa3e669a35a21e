"""The report of a fit: measured and fitted curves, residuals, errors with intervals, and unresolved errors."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.draw.pages import made_now
from cycloid_fmu.edge import ARCMIN, ARCSEC
from cycloid_fmu.errors.kinds import kind_of
from cycloid_fmu.surfaces.sampling import PitchErrors, Tolerances
from fitting.estimation.effects import Effect, words_of
from fitting.estimation.parameter import NORMAL, Parameter
from fitting.estimation.realised import GAUGE, ORDERS_STATED, Realised
from fitting.estimation.result import Identification
from fitting.model.discrepancy import SENTENCES
from fitting.model.loops import LoopFit
from fitting.model.observations import CHAIN, MISFIT
from fitting.reports.curve_panels import comparison_panels
from fitting.reports.page import html_page
from fitting.reports.panels import Panel, Trace, spectra_panel
from fitting.reports.ring import ring_panel
from fitting.transmission_error.spectrum import spectrum

FORMATS = (".html",)
_CRANK_TURNS = 3.0  # range of the first panel
_SHOWN = 0.01  # of the largest effect: errors with less are only counted
_FIELD_UNITS = {"m": (1e6, "µm"), "rad": (1e3, "mrad"), "1": (1.0, "of the stated")}


def fit_panels(result: Identification) -> list[Panel]:
    """Return the panels of a fit: measured and fitted curves, residuals, their orders, and the errors' intervals."""
    both, residual = comparison_panels(result.curves, result.fitted_curves, "fitted", _CRANK_TURNS)
    rest = [
        dataclasses.replace(curve, transmission_error=curve.transmission_error - model)
        for curve, model in zip(result.curves, result.fitted_curves, strict=True)
    ]
    panels = [
        dataclasses.replace(
            both,
            caption="Points are measured; lines are the fit, including the bench's errors. First crank turns only.",
        ),
        dataclasses.replace(
            residual,
            caption=f"{result.residual / _ARC:.3f}″ rms residual; the noise of a point is {result.noise / _ARC:.3f}″. "
            "Click a curve's name to hide it; double-click it to hide all others.",
        ),
    ]
    orders = spectra_panel(rest, [spectrum(c) for c in rest], result.pair, "Orders of the residual")
    loops = [panel for loop in result.loops for panel in _loop_panels(loop)]
    ring = ring_panel(result.realised)
    return [*panels, *([orders] if orders is not None else []), *loops, _intervals(result.parameters), ring]


def _loop_panels(loop: LoopFit) -> list[Panel]:
    """Return panels of a loop as measured and fitted, and of its residual, by branch."""
    name, torque = f"Hysteresis loop: {Path(loop.source).name}", "torque on the output [N·m]"
    middle = float(np.mean(list(loop.measured.values())))
    both, residuals = [], []
    for number, (branch, at) in enumerate(loop.torque.items()):
        measured, fitted = loop.measured[branch], loop.fitted[branch]
        both.append(Trace("measured" if number == 0 else "", at, (measured - middle) * ARCMIN, "points", -1))
        both.append(Trace(branch, at, (fitted - middle) * ARCMIN, "thin", number))
        residuals.append(Trace(branch, at, (measured - fitted) / _ARC, "thin", number))
    return [
        Panel(
            name,
            torque,
            "windup [arcmin]",
            tuple(both),
            f"Input locked at a crank angle of {np.degrees(loop.crank_angle):.1f}°. Points are means over the "
            "torque; lines are the fit, outside play and friction.",
        ),
        Panel(
            f"{name}: residual", torque, "measured minus fitted [arcsec]", tuple(residuals), "Each branch separately."
        ),
    ]


def _intervals(parameters: Sequence[Parameter]) -> Panel:
    shown = [p for p in parameters if p.held is None and p.unit == "m"]
    lines = [
        Trace("95 % interval" if i == 0 else "", np.array(p.interval) * 1e6, np.array([-i, -i], float), "thick", 0)
        for i, p in enumerate(shown)
    ]
    at, rows = np.array([p.value * 1e6 for p in shown]), -np.arange(float(len(shown)))
    ends = np.array([at, *zip(*(t.x for t in lines), strict=True)]) if lines else np.zeros((1, 1))
    column = np.full(at.size, np.nanmax(ends) + 0.15 * max(np.nanmax(ends) - np.nanmin(ends), 1e-3))
    # In a separate column: next to the points they would overlap.
    values = Trace("", column, rows, "words", -1, tuple(f"{value:.2f}" for value in at))
    return Panel(
        "Identified errors",
        "error [µm]",
        "",
        (*lines, Trace("", at, rows, "dots", 1), values),
        "Errors with their 95 % intervals; values in the column on the right.",
        y_names=tuple(p.name for p in shown),
    )


_ARC = 1.0 / ARCSEC

_ABOVE = """<p id="verdict"><strong>{{ verdict }}</strong></p>
{% if not has_index %}<p id="no-index">The recordings have no index: it is unknown which pin is number 0. Numbers and
angles of pins and teeth count from an unknown one.</p>
{% endif %}<h2>What to correct, by the effect on the transmission error</h2>
<table id="effects"><thead><tr><th>Error</th><th>Effect [arcsec]</th><th>Identified</th><th>95 % interval</th>
<th>Largest at</th>{% if drawing %}<th>Drawing allows</th>{% endif %}</tr></thead><tbody>
{% for r in effects %}<tr><td>{{ r.name }}</td><td class="number">{{ r.effect }}</td>
<td class="number">{{ r.value }}</td><td class="number">{{ r.interval }}</td><td class="number">{{ r.at }}</td>
{% if drawing %}<td>{{ r.tolerance }}</td>{% endif %}</tr>
{% endfor %}</tbody></table>
<p class="caption">Effect: largest minus smallest contribution to the transmission error in one recording, by the
derivatives at this drive, at the load at which it is largest. Orders are those of this ring and gear, with their
amplitudes. They are largest at this angle from pin or tooth 0, and again after each turn divided by the order.
{{ rest }}{% if not drawing %}With --tolerances the drawing's tolerances stand beside the errors.{% endif %}</p>
<h2>Quality of the fit</h2><ul id="trust">{% for t in trust %}<li>{{ t }}</li>{% endfor %}</ul>
"""
_BELOW = """<h2>All fitted errors</h2>
<p class="caption">By their names in files. Orders of pins and teeth are the mean of rings with the same scatter.</p>
<table id="errors"><thead><tr><th>Error</th><th>Identified</th><th>95 % interval</th><th>Unit</th>
<th>From the data</th></tr></thead><tbody>
{% for r in known %}<tr><td>{{ r.name }}</td><td class="number">{{ r.value }}</td><td class="number">{{ r.interval }}
</td><td>{{ r.unit }}</td><td class="number">{{ r.share }}</td></tr>
{% endfor %}</tbody></table>
<h2>Correlation of the fitted errors</h2>
<table id="correlation" style="font-size:.62em; table-layout:fixed"><tbody>
{% for row in correlation %}<tr><td style="width:22em">{{ row.number }} {{ row.name }}</td>
{% for c in row.cells %}<td style="padding:0; text-align:center; background:rgba({{ c.colour }})">{{ c.text }}</td>
{% endfor %}</tr>{% endfor %}</tbody></table>
<p class="caption">In percent; columns in the order of the rows. Red: positive; blue: negative.</p>
<h2>Errors that the data cannot resolve</h2><ul id="weak">{% for w in weak %}<li>{{ w }}</li>{% endfor %}</ul>
<table id="held"><thead><tr><th>Held fixed</th><th>Reason</th></tr></thead><tbody>
{% for p in held %}<tr><td>{{ p.name }}</td><td>{{ p.held }}</td></tr>
{% endfor %}</tbody></table>
<h2>Every pin and tooth of this ring</h2>
<ul id="gauge">{% for g in gauge %}<li>{{ g }}</li>{% endfor %}</ul>
{% for t in ring %}<table id="{{ t.id }}"><thead><tr><th>{{ t.of }}</th>{% for n in t.columns %}<th>{{ n }}</th>
{% endfor %}</tr></thead><tbody>{% for r in t.rows %}<tr>{% for cell in r %}<td class="number wrapped">{{ cell }}</td>
{% endfor %}</tr>{% endfor %}</tbody></table>
<p class="caption">{{ t.caption }}</p>
{% endfor %}
<h2>The bench</h2><table id="bench"><tbody>{% for name, value in bench %}<tr><td>{{ name }}</td>
<td class="number">{{ value }}</td></tr>
{% endfor %}</tbody></table>
<h2>Notes</h2>{% if notes %}<ul id="notes">{% for n in notes %}<li>{{ n }}</li>{% endfor %}</ul>{% else %}
<p id="notes">No data were excluded.</p>{% endif %}
<h2>Recordings</h2><table id="recordings"><thead><tr><th>File</th><th>SHA-256</th></tr></thead><tbody>
{% for name, checksum in sources %}<tr><td>{{ name }}</td><td><code>{{ checksum }}</code></td></tr>
{% endfor %}</tbody></table>
"""


def _row(parameter: Parameter) -> dict[str, str]:
    factor, unit = _FIELD_UNITS[parameter.unit]
    low, high = (v * factor for v in parameter.interval)
    interval = "withheld" if math.isnan(low) else f"{low:.3f} … {high:.3f}"
    return {
        "name": parameter.name,
        "value": f"{parameter.value * factor:.3f}",
        "interval": interval,
        "unit": unit,
        "share": f"{100.0 * parameter.data_share:.1f} %",
    }


def _effect_row(effect: Effect, tolerances: Tolerances | None) -> dict[str, str]:
    factor, unit = _FIELD_UNITS[effect.error.unit]
    low, high = (v * factor for v in effect.error.interval)
    digits = 3 if math.isnan(low) else min(max(1 - math.floor(math.log10(max(0.5 * (high - low), 1e-3))), 0), 3)
    at = ""
    if effect.phase is not None and effect.order:
        around = 360.0 / effect.order
        angle = math.degrees(effect.phase.value) / effect.order % around
        half = (effect.phase.interval[1] - effect.phase.interval[0]) / 2.0
        known = "" if math.isnan(half) else f" ± {math.degrees(half) / effect.order:.1f}"
        at = f"{angle:.1f}{known}°" if math.isnan(half) or half < math.pi / 2.0 else "unknown"
    stated = f"{low:.{digits}f} … {high:.{digits}f}"
    if math.isnan(low):
        stated = "" if math.isnan(effect.error.standard_error) else "withheld"
    return {
        "name": words_of(effect),
        "effect": f"{effect.peak_to_peak * ARCSEC:.2f}",
        "value": f"{effect.error.value * factor:.{digits}f} {unit}",
        "interval": stated,
        "at": at,
        "tolerance": "" if tolerances is None else _allowed(effect.kind, tolerances),
    }


def _allowed(name: str, tolerances: Tolerances) -> str:
    """Return the tolerance of an error as the drawing states it, and that of the error itself if it is half of that."""
    kind = kind_of(name)
    of = None if kind is None else kind.tolerance
    stated = None if of is None else tolerances.of(of.key)
    if kind is None or of is None or stated is None:
        return ""
    factor, unit = _FIELD_UNITS[kind.unit]
    if isinstance(stated, PitchErrors):
        return f"single ± {stated.single * factor:g}, cumulative {stated.cumulative * factor:g} {unit}"
    own = f"± {stated.tolerance * of.share * factor:g} {unit}"
    return own if of.share == 1.0 else f"{own} ({of.key.replace('_', ' ')} ± {stated.tolerance * factor:g} {unit})"


def _with_interval(parameter: Parameter) -> str:
    """Return a displacement in µm, or a phase in degrees, with its half interval; in brackets if not measured."""
    factor, digits, unit = (1e6, 3, "") if parameter.unit == "m" else (math.degrees(1.0), 1, "°")
    text = f"{parameter.value * factor:.{digits}f}"
    if not math.isnan(parameter.interval[0]):
        text += f"\u00a0±\u00a0{NORMAL * parameter.standard_error * factor:.{digits}f}"
    text += unit
    return f"({text})" if parameter.held else text


def _ring_tables(ring: Realised) -> list[dict[str, Any]]:
    """Return the tables of every pin and tooth and of this ring's orders, with one column per circle."""
    circles = [ring.elements[part] for part in ring.circles.values()]
    columns = [name.replace("_", " ") for name in ring.circles]
    elements = [
        [i, *(_with_interval(circle[i]) if i < len(circle) else "" for circle in circles)]
        for i in range(max(len(circle) for circle in circles))
    ]
    stated = {parameter.name: parameter for parameter in ring.orders}
    orders = []
    for order in range(ORDERS_STATED + 1):
        row = []
        for name in ring.circles:
            parameters = [stated.get(f"{name}_{order}{part}") for part in ("", "_amplitude", "_phase")]
            row.append(
                " at ".join(_with_interval(parameter) for parameter in parameters if parameter is not None) or "–"
            )
        orders.append([order, *row])
    return [
        {
            "id": "realised-orders",
            "of": "Order",
            "columns": columns,
            "rows": orders,
            "caption": "Amplitudes of this ring's own orders, µm, at their phases (order times angle), with half the "
            "95 % intervals. The table of fitted errors has the mean orders of rings with the same scatter, which are "
            "known less accurately.",
        },
        {
            "id": "realised",
            "of": "Pin or tooth",
            "columns": columns,
            "rows": elements,
            "caption": "In µm, with half widths of the 95 % intervals; in brackets if a pin or tooth carries almost no "
            "load in these curves and is constrained only by its neighbours.",
        },
    ]


def _correlation(result: Identification) -> list[dict[str, Any]]:
    rows = []
    for number, (name, values) in enumerate(zip(result.fitted, result.correlation, strict=True), start=1):
        cells = [
            {"text": f"{round(100.0 * v):d}", "colour": f"{'214,39,40' if v > 0 else '31,119,180'},{abs(v):.2f}"}
            for v in values
        ]
        rows.append({"number": number, "name": name, "cells": cells})
    return rows


def _trust(result: Identification) -> list[str]:
    trust = [
        f"{result.residual / _ARC:.3f}″ rms residual of the curves; the noise of a point is {result.noise / _ARC:.3f}″."
    ]
    if result.held_out is not None:
        prediction = result.held_out
        trust.append(
            f"{prediction.loads} were held out from a first fit, which predicts them: residual "
            f"{prediction.residual / _ARC:.3f}″ rms, {prediction.residual / prediction.noise:.2f} times the noise."
        )
    else:
        trust.append("No curve was held out for prediction, which requires three curves.")
    scatter = ", ".join(f"{n} {v * 1e6:.2f} µm" for n, v in result.scatter.items())
    trust.append(f"Scatter of single pins and teeth beyond the errors of the table: {scatter} (standard deviations).")
    for loop in result.loops:
        residual = np.concatenate([loop.measured[n] - loop.fitted[n] for n in loop.fitted])
        trust.append(
            f"{Path(loop.source).name}: the play at the crank angle {np.degrees(loop.crank_angle):.1f}° is "
            f"{loop.play / _ARC:.2f} ± {1.96 * loop.standard_error / _ARC:.2f}″ from the identified errors; "
            f"{np.sqrt(np.mean(residual**2)) / _ARC:.3f}″ rms residual of the loop's points."
        )
    if result.inflation > 1.0:
        trust.append(f"The residual is not white: intervals are {result.inflation:.2f} times those of white noise.")
    return trust


def write_fit_report(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write the report of a fit as one self-contained HTML file; never a partial file."""
    target, pair = edge.output_path(path, "path", FORMATS), result.pair
    shown = [effect for effect in result.effects if effect.peak_to_peak > _SHOWN * result.effects[0].peak_to_peak]
    more = len(result.effects) - len(shown)
    rest = f"{more} more errors have an effect below {100.0 * _SHOWN:g} % of the largest. " if more else ""
    text = html_page(
        "Identified drive",
        f"{pair.gear_teeth}/{pair.pins}, {len(result.curves)} curves, {made_now()}",
        _ABOVE,
        fit_panels(result),
        _BELOW,
        verdict=result.verdict.sentence,
        has_index=all(c.known_index for c in result.curves),
        drawing=result.tolerances is not None,
        rest=rest,
        effects=[_effect_row(effect, result.tolerances) for effect in shown],
        known=[_row(p) for p in (*result.parameters, *result.bearings, *result.coefficients) if p.held is None],
        trust=_trust(result),
        correlation=_correlation(result),
        weak=result.weak_combinations,
        held=[p for p in (*result.parameters, *result.bearings, *result.coefficients) if p.held is not None],
        gauge=(*GAUGE, f"radius_lever is {result.realised.radius_lever:.2f}."),
        ring=_ring_tables(result.realised),
        bench=_bench_rows(result),
        notes=result.notes,
        sources=[(Path(n).name, c) for n, c in result.checksums.items()],
    )
    with edge.written_whole(target) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _bench_rows(result: Identification) -> list[tuple[str, str]]:
    """Return the bench's unknowns as rows: run-out by orders, causes of misfit by their size, the others by name."""
    rows = [
        (f"run-out, order {run_out.order} of the {run_out.shaft}", run_out.text.partition(f"{run_out.shaft} ")[2])
        for run_out in result.run_out
    ]
    rows += [
        (f"{SENTENCES.get(misfit.cause, misfit.cause)}, rms", f"{misfit.size * ARCSEC:.3g}″")
        for misfit in result.verdict.misfits
        if not misfit.run_out
    ]
    groups: dict[str, list[float]] = {}
    for name, value in result.bench.items():
        if not name.startswith(MISFIT) and "encoder_eccentricity" not in name:
            groups.setdefault(name.rstrip("0123456789").rstrip("_"), []).append(value)
    for name, values in groups.items():
        factor, unit = _bench_unit(name)
        low, high = min(values) * factor, max(values) * factor
        of, shown = ("", f"{low:.3g}") if len(values) == 1 else (f", {len(values)} of them", f"{low:.3g} … {high:.3g}")
        rows.append((f"{name.replace('_', ' ')}{of}", f"{shown} {unit}"))
    return rows


def _bench_unit(name: str) -> tuple[float, str]:
    """Return the factor from SI, and the unit of an unknown of the bench."""
    if name == CHAIN:
        return ARCSEC, "arcsec/(N·m)"
    if name.endswith("friction_per_load"):
        return 1.0, "N·m/(N·m)"
    return (1.0, "N·m") if name.endswith("friction_torque") else (ARCSEC, "arcsec")
