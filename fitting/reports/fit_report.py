"""The report of a fit: measured and fitted curves, residuals, errors with intervals, and unresolved errors."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.pages import Sentences, Table
from cycloid_fmu.edge import ARCMIN, ARCSEC
from cycloid_fmu.errors.kinds import kind_of
from cycloid_fmu.surfaces.sampling import PitchErrors, Tolerances
from fitting.estimation.effects import Effect, words_of
from fitting.estimation.held_out import is_mispredicted
from fitting.estimation.parameter import NORMAL, Parameter
from fitting.estimation.realised import GAUGE, ORDERS_STATED, Realised
from fitting.estimation.result import Identification
from fitting.model.discrepancy import SENTENCES
from fitting.model.loops import LoopFit
from fitting.model.observations import CHAIN, MISFIT
from fitting.reports.curve_panels import comparison_panels
from fitting.reports.figures_report import notes_of
from fitting.reports.page import Part, write_page
from fitting.reports.panels import Panel, Trace, spectra_panel
from fitting.reports.ring import ring_panel
from fitting.transmission_error.spectrum import spectrum

if TYPE_CHECKING:
    from markupsafe import Markup

_CRANK_TURNS = 3.0  # range of the first panel
_SHOWN = 0.01  # of the largest effect: errors with less are only counted
FIELD_UNITS = {"m": (1e6, "µm"), "rad": (1e3, "mrad"), "1": (1.0, "of the stated")}
"""{SI unit of an error: factor to the unit in which it is shown, and that unit}."""


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
            caption=f"{quality_of(result)[0]} Click a curve's name to hide it; double-click it to hide all others.",
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
        residuals.append(Trace(branch, at, (measured - fitted) * ARCSEC, "thin", number))
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


def error_rows(result: Identification) -> list[list[str]]:
    """Return the rows of all fitted errors: name, value, 95 % interval, unit, and share from the data."""
    rows = []
    for parameter in (*result.parameters, *result.bearings, *result.coefficients):
        if parameter.held is not None:
            continue
        factor, unit = FIELD_UNITS[parameter.unit]
        low, high = (v * factor for v in parameter.interval)
        interval = "withheld" if math.isnan(low) else f"{low:.3f} … {high:.3f}"
        share = f"{100.0 * parameter.data_share:.1f} %"
        rows.append([parameter.name, f"{parameter.value * factor:.3f}", interval, unit, share])
    return rows


def held_rows(result: Identification) -> list[list[str]]:
    """Return the rows of the errors that are held fixed: name and reason."""
    every = (*result.parameters, *result.bearings, *result.coefficients)
    return [[parameter.name, parameter.held] for parameter in every if parameter.held is not None]


def _effects(result: Identification) -> Table:
    """Return the table of errors by their effect on the transmission error."""
    shown = [effect for effect in result.effects if effect.peak_to_peak > _SHOWN * result.effects[0].peak_to_peak]
    more = len(result.effects) - len(shown)
    rest = f"{more} more errors have an effect below {100.0 * _SHOWN:g} % of the largest. " if more else ""
    head = ["Error", "Effect [arcsec]", "Identified", "95 % interval", "Largest at"]
    if result.tolerances is None:
        rest += "With --tolerances the drawing's tolerances stand beside the errors."
    else:
        head.append("Drawing allows")
    caption = (
        "Effect: largest minus smallest contribution to the transmission error in one recording, by the derivatives at "
        "this drive, at the load at which it is largest. Orders are those of this ring and gear, with their "
        "amplitudes. They are largest at this angle from pin or tooth 0, and again after each turn divided by the "
        f"order. {rest}"
    )
    rows = [_effect_row(effect, result.tolerances) for effect in shown]
    title = "What to correct, by the effect on the transmission error"
    return Table(title, head, rows, "effects", ("", "number", "number", "number", "number"), caption)


def _effect_row(effect: Effect, tolerances: Tolerances | None) -> list[str]:
    factor, unit = FIELD_UNITS[effect.error.unit]
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
    return [
        words_of(effect),
        f"{effect.peak_to_peak * ARCSEC:.2f}",
        f"{effect.error.value * factor:.{digits}f} {unit}",
        stated,
        at,
        *([] if tolerances is None else [_allowed(effect.kind, tolerances)]),
    ]


def _allowed(name: str, tolerances: Tolerances) -> str:
    """Return the tolerance of an error as the drawing states it, and that of the error itself if it is half of that."""
    kind = kind_of(name)
    of = None if kind is None else kind.tolerance
    stated = None if of is None else tolerances.of(of.key)
    if kind is None or of is None or stated is None:
        return ""
    factor, unit = FIELD_UNITS[kind.unit]
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


def _ring_tables(ring: Realised) -> list[Table]:
    """Return the tables of every pin and tooth and of this ring's orders, with one column per circle."""
    circles = [ring.elements[part] for part in ring.circles.values()]
    elements = [
        [str(i), *(_with_interval(circle[i]) if i < len(circle) else "" for circle in circles)]
        for i in range(max(len(circle) for circle in circles))
    ]
    stated = {parameter.name: parameter for parameter in ring.orders}
    orders = []
    for order in range(ORDERS_STATED + 1):
        row = [str(order)]
        for name in ring.circles:
            parameters = [stated.get(f"{name}_{order}{part}") for part in ("", "_amplitude", "_phase")]
            row.append(
                " at ".join(_with_interval(parameter) for parameter in parameters if parameter is not None) or "–"
            )
        orders.append(row)
    columns = [name.replace("_", " ") for name in ring.circles]
    styles = ["number wrapped"] * (1 + len(columns))
    of_orders = (
        "Amplitudes of this ring's own orders, µm, at their phases (order times angle), with half the 95 % intervals. "
        "The table of fitted errors has the mean orders of rings with the same scatter, which are known less "
        "accurately."
    )
    of_elements = (
        "In µm, with half widths of the 95 % intervals; in brackets if a pin or tooth carries almost no load in these "
        "curves and is constrained only by its neighbours."
    )
    return [
        Table("", ["Order", *columns], orders, "realised-orders", styles, of_orders),
        Table("", ["Pin or tooth", *columns], elements, "realised", styles, of_elements),
    ]


def _correlation(result: Identification) -> Markup:
    """Return the correlation of the fitted errors as a table of coloured cells."""
    from markupsafe import Markup

    cell = Markup('<td style="padding:0; text-align:center; background:rgba({},{:.2f})">{:d}</td>')
    rows = [
        Markup('<tr><td style="width:22em">{} {}</td>{}</tr>').format(
            number,
            name,
            Markup("").join(
                cell.format("214,39,40" if v > 0 else "31,119,180", abs(v), round(100.0 * v)) for v in values
            ),
        )
        for number, (name, values) in enumerate(zip(result.fitted, result.correlation, strict=True), start=1)
    ]
    return Markup(
        '<h2>Correlation of the fitted errors</h2><table id="correlation" style="font-size:.62em; table-layout:fixed">'
        '<tbody>{}</tbody></table><p class="caption">In percent; columns in the order of the rows. Red: positive; '
        "blue: negative.</p>"
    ).format(Markup("").join(rows))


def quality_of(result: Identification) -> list[str]:
    """Return sentences on the quality of a fit: residual, prediction of held-out curves, scatter, and loops."""
    sentences = [
        f"Residual {result.residual * ARCSEC:.3f}″ rms of the curves; the noise of a point is "
        f"{result.noise * ARCSEC:.3f}″."
    ]
    if result.held_out is not None:
        prediction = result.held_out
        predicts = "does not predict it" if is_mispredicted(prediction) else "predicts it"
        misfit = f"residual {prediction.residual * ARCSEC:.3f}″ rms"
        sentences.append(
            f"Held out from a fit of the others, which {predicts}: {prediction.loads}: {misfit}, "
            f"noise {prediction.noise * ARCSEC:.3f}″."
            if np.isfinite(prediction.noise)
            else f"Held out from a fit of the others: {prediction.loads}: {misfit}; whether it is predicted is not "
            "judged, because its points are too few to know their noise."
        )
    else:
        sentences.append("No curve was held out for prediction, which requires three curves.")
    scatter = ", ".join(f"{n} {v * 1e6:.2f} µm" for n, v in result.scatter.items())
    sentences.append(
        f"Scatter of single pins and teeth beyond the errors of the table: {scatter} (standard deviations)."
    )
    for loop in result.loops:
        residual = np.concatenate([loop.measured[n] - loop.fitted[n] for n in loop.fitted])
        sentences.append(
            f"{Path(loop.source).name}: play at the crank angle {np.degrees(loop.crank_angle):.1f}°: "
            f"{loop.play * ARCSEC:.2f} ± {NORMAL * loop.standard_error * ARCSEC:.2f}″ from the identified errors; "
            f"{np.sqrt(np.mean(residual**2)) * ARCSEC:.3f}″ rms residual of the loop's points."
        )
    if result.inflation > 1.0:
        sentences.append(f"The residual is not white: intervals are {result.inflation:.2f} times those of white noise.")
    return sentences


def write_fit_report(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write the report of a fit as one self-contained HTML file; never a partial file."""
    from markupsafe import Markup

    above: list[Part] = [Markup('<p id="verdict"><strong>{}</strong></p>').format(result.verdict.sentence)]
    if not all(curve.known_index for curve in result.curves):
        above.append(
            Markup(
                '<p id="no-index">The recordings have no index: it is unknown which pin is number 0. Numbers and '
                "angles of pins and teeth count from an unknown one.</p>"
            )
        )
    above += [_effects(result), Sentences("Quality of the fit", quality_of(result), "trust")]
    errors = Table(
        "All fitted errors",
        ("Error", "Identified", "95 % interval", "Unit", "From the data"),
        error_rows(result),
        "errors",
        ("", "number", "number", "", "number"),
        "By their names in files. Orders of pins and teeth are the mean of rings with the same scatter.",
    )
    gauge = (*GAUGE, f"radius_lever is {result.realised.radius_lever:.2f}.")
    sources = [(Path(name).name, checksum) for name, checksum in result.checksums.items()]
    below: list[Part] = [
        errors,
        _correlation(result),
        Sentences("Errors that the data cannot resolve", result.weak_combinations, "weak", "All are resolved."),
        Table("", ("Held fixed", "Reason"), held_rows(result), "held"),
        Sentences("Every pin and tooth of this ring", gauge, "gauge"),
        *_ring_tables(result.realised),
        Table("The bench", (), _bench_rows(result), "bench", ("", "number")),
        notes_of(result.notes),
        Table("Recordings", ("File", "SHA-256"), sources, "recordings", ("", "code")),
    ]
    facts = [f"{result.pair.gear_teeth}/{result.pair.pins}", f"{len(result.curves)} curves"]
    write_page(path, "Identified drive", facts, fit_panels(result), above, below)


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
