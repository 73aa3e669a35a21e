"""The diagrams of a report as data: panels of lines and points in field units, for matplotlib and plotly."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.edge import ARCMIN, ARCSEC
from cycloid_fmu.geometry.pair import Pair
from fitting.figures.friction_free import FrictionFree
from fitting.figures.hysteresis import drift_of, loop_marks, without_drift
from fitting.figures.metrics import Figures
from fitting.figures.starts import STARTS
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.loops import SIDES, LoopData
from fitting.transmission_error.mid_curve import LINE
from fitting.transmission_error.orders import RunOrders
from fitting.transmission_error.spectrum import Spectrum, order_name

Array = NDArray[np.float64]

_MIDDLE = 0.12  # share of the rated torque shown around zero torque
_NAMED = 14  # most labelled orders
_BROKEN = 4  # most orders of a run that are no whole number
_APART = 0.045  # of the x axis: least distance of upright names, also on a phone
_DRAWN = 100_000  # most points of all lines of a panel


@dataclass(frozen=True)
class Trace:
    """One line or set of points: arrays of shape (points,) in the panel's units.

    Attributes
    ----------
    label
        Label in the legend; "" for none.
    x, y
        Coordinates; NaN interrupts a line.
    style
        "line", "thin", "dashed", "thick", "points" in grey, "dots" and "circles" (open) in the colour, "words" for only
        the texts, or "band": the area within the outline x, y.
    colour
        Number of the colour; -1 is grey.
    texts
        Names of the points; points without names are small.
    """

    label: str
    x: Array
    y: Array
    style: Literal["line", "thin", "dashed", "thick", "points", "dots", "circles", "words", "band"] = "line"
    colour: int = 0
    texts: tuple[str, ...] = ()


@dataclass(frozen=True)
class HeatMap:
    """Values `z` at coordinates x and y, shape (y, x), drawn with even spacing; NaN is left empty."""

    name: str
    x: Array
    y: Array
    z: Array


@dataclass(frozen=True)
class Panel:
    """One diagram with title, axes and caption.

    `y_names` replace the numbers of the y axis at 0, -1, -2, ...; a `round` panel has no axes and equal scales. `heat`
    are maps side by side, in place of traces, with one colour scale. With `log_x`, names of points are in a row above
    them, each with a line to its point. With `from_zero` the y axis includes zero, so that small changes look small.
    """

    title: str
    x_label: str
    y_label: str
    traces: tuple[Trace, ...]
    caption: str
    log_y: bool = False
    y_names: tuple[str, ...] = ()
    round: bool = False
    heat: tuple[HeatMap, ...] = ()
    log_x: bool = False
    from_zero: bool = False
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None


def stems(x: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the points of upright lines from `low` to `high` at each x, with NaN between them."""
    return np.repeat(x, 3), np.stack([low, high, np.full(x.size, np.nan)], axis=1).ravel()


def band(label: str, x: Array, low: Array, high: Array, colour: int = 0) -> Trace:
    """Return the area between two curves over x."""
    return Trace(label, np.concatenate([x, x[::-1]]), np.concatenate([low, high[::-1]]), "band", colour)


def apart(panel: Panel) -> list[Panel]:
    """Return one panel for each trace, with its label as title and the same y axis."""
    most = 1.1 * max(float(np.nanmax(np.abs(trace.y))) for trace in panel.traces)
    return [
        dataclasses.replace(panel, title=t.label, traces=(dataclasses.replace(t, label=""),), y_limits=(-most, most))
        for t in panel.traces
    ]


def names_above(panel: Panel) -> list[tuple[float, float, float, str]]:
    """Return x and y of each named point of a panel, the position of its name, and the name.

    Positions are fractions of the x axis, so far apart that upright names do not overlap.
    """
    from scipy.optimize import isotonic_regression

    named = sorted((x, y, t) for trace in panel.traces for x, y, t in zip(trace.x, trace.y, trace.texts, strict=False))
    if not named:
        return []
    low, high = (math.log10(end) for end in x_range(panel))
    number = np.arange(len(named))
    ideal = (np.log10([x for x, _, _ in named]) - low) / (high - low)
    # The positions closest to the points, subject to the least distance.
    places = isotonic_regression(ideal - _APART * number).x + _APART * number
    places = np.clip(places, _APART * number, 1.0 - _APART * number[::-1])
    return [(x, y, float(position), text) for (x, y, text), position in zip(named, places, strict=True)]


def x_range(panel: Panel) -> tuple[float, float]:
    """Return the smallest and largest x of a panel's traces with a margin, for a logarithmic scale."""
    every = np.concatenate([t.x for t in panel.traces])
    return 0.85 * float(np.nanmin(every)), 1.1 * float(np.nanmax(every))


def label_of(curve: Curve) -> str:
    """Return the label of a curve in plots: load and direction."""
    load = "unknown load" if np.isnan(curve.torque) else f"{curve.torque:+.4g} N·m"
    return f"{load}, {'forward' if curve.direction > 0 else 'backward'}"


def panels_of(figures: Figures) -> list[Panel]:
    """Return the panels of a report: curves, orders, loops, stiffness, starts, budgets, and torque over time.

    Parameters
    ----------
    figures
        The figures and their data.
    """
    panels = []
    if figures.curves:
        caption = (
            "Mean of all turns at each angle, one curve per load and direction; the mean of each curve is subtracted. "
            "Curves that agree cover each other; on an HTML page, click a curve's name to hide it."
        )
        panels.append(turn_panel(figures.curves, "Transmission error over one output turn", caption, centred=True))
        spectra = spectra_panel(figures.curves, figures.spectra, figures.pair, orders=figures.orders)
        if spectra is not None:
            panels.append(spectra)
    panels += [p for s in figures.surveyed if s.loops is not None for p in _loop_panels(s.loops)]
    panels += [p for source, free in figures.mid_curves for p in _mid_curve_panels(source, free)]
    panels += _stiffness_panel(figures)
    panels += _start_panels(figures) + _budget_panel(figures)
    panels += _torque_panels(figures)
    return [_lightened(panel) for panel in panels]


def _lightened(panel: Panel) -> Panel:
    """Return a panel with at most `_DRAWN` points in all lines: the smallest and largest value of each section."""
    total = sum(t.x.size for t in panel.traces)
    if total <= _DRAWN:
        return panel
    traces = []
    for trace in panel.traces:
        stretches = max(1, trace.x.size * _DRAWN // total // 2)
        length = math.ceil(trace.x.size / stretches)
        if length > 2 and not trace.texts and not np.isnan(trace.y).any():
            begins = np.arange(0, trace.x.size, length)
            parts = np.split(trace.y, begins[1:])
            lows, highs = ([b + int(f(p)) for b, p in zip(begins, parts, strict=True)] for f in (np.argmin, np.argmax))
            points = np.unique([0, *lows, *highs, trace.x.size - 1])
            trace = dataclasses.replace(trace, x=trace.x[points], y=trace.y[points])
        traces.append(trace)
    return dataclasses.replace(panel, traces=tuple(traces))


def turn_panel(curves: Sequence[Curve], title: str, caption: str = "", *, centred: bool = False) -> Panel:
    """Return the panel of curves over the output turn; `centred`: each without its mean."""
    traces = []
    for number, curve in enumerate(curves):
        error = (curve.transmission_error - centred * curve.transmission_error.mean()) * ARCSEC
        turn = np.degrees(curve.input_angle / abs(curve.ratio))
        traces.append(Trace(label_of(curve), turn, error, "thin", number))
    return Panel(title, "output turn [°]", "transmission error [arcsec]", tuple(traces), caption)


def spectra_panel(
    curves: Sequence[Curve],
    spectra: Sequence[Spectrum | None],
    pair: Pair | None,
    title: str = "Orders of the output",
    orders: Sequence[RunOrders] = (),
) -> Panel | None:
    """Return the panel of the orders of curves with their noise floors, or None without a spectrum.

    `orders` are those of the runs before averaging; those that are no whole number are drawn with their intervals.
    """
    pairs = [(c, s) for c, s in zip(curves, spectra, strict=True) if s is not None]
    if not pairs:
        return None
    highest = max(int(np.flatnonzero(s.significant).max(initial=10)) for _, s in pairs)
    traces = []
    for number, (curve, of_curve) in enumerate(pairs):
        upto = min(of_curve.amplitude.size, math.ceil(1.1 * highest) + 1)
        order = np.arange(1, upto, dtype=float)
        amplitude, floor = of_curve.amplitude[1:upto] * ARCSEC, of_curve.floor[1:upto] * ARCSEC
        seen = of_curve.significant[1:upto]
        at, top = order[seen], amplitude[seen]
        traces.append(Trace("", order[~seen], amplitude[~seen], "points", -1))
        traces.append(Trace("", *stems(at, floor[seen], top), "line", number))
        traces.append(Trace(label_of(curve), at, top, "dots", number))
        traces.append(Trace("noise floor" if number == 0 else "", order, floor, "dashed", -1))
    largest = np.zeros(highest + 1)
    for _, of_curve in pairs:
        significant = np.where(of_curve.significant, of_curve.amplitude, 0.0)[: highest + 1]
        largest[: significant.size] = np.maximum(largest[: significant.size], significant * ARCSEC)
    leading = np.array(_well_spaced(largest), dtype=int)
    names = tuple(f"{k} {order_name(int(k), pairs[0][0].ratio, pair)}".strip() for k in leading)
    traces.append(Trace("", leading.astype(float), largest[leading], "points", -1, names))
    traces += _broken_orders(orders)
    return Panel(
        title,
        "order of the output turn",
        "amplitude [arcsec]",
        tuple(traces),
        "Pin: errors of pins and ring; tooth: errors of the gear's teeth; mesh: both; rig: coaxiality and couplings "
        "(large errors of pins and teeth also beat at order 1). Orders above the noise have a line, others are grey "
        "points. Dashed: noise floor. The 95 % interval of an amplitude is ± 1.4 times the dashed line. Orders that "
        "are no whole number, which averaging over turns removes, are points with their intervals.",
        log_y=True,
        log_x=True,
    )


def _broken_orders(runs: Sequence[RunOrders]) -> list[Trace]:
    """Return traces of the orders that are no whole number: the largest of each run at each of them, with intervals."""
    traces = []
    for number, run in enumerate(runs):
        broken = [order for order in run.orders if not order.whole][:_BROKEN]
        if not broken:
            continue
        order, size, interval = (
            np.array([getattr(order, name) for order in broken]) for name in ("order", "amplitude", "uncertainty")
        )
        low, high = np.maximum(size - interval, 0.05 * size) * ARCSEC, (size + interval) * ARCSEC
        names = tuple(f"{order.order:.4g} {order.source}".strip() for order in broken) if number == 0 else ()
        traces.append(Trace("", *stems(order, low, high), "thin", number))
        traces.append(Trace("no whole order" if number == 0 else "", order, size * ARCSEC, "points", -1, names))
    return traces


def _well_spaced(amplitude: Array) -> list[int]:
    """Return the orders to label: the largest, without those next to a larger one of similar size."""
    chosen: list[int] = []
    for order in np.argsort(-amplitude)[: np.count_nonzero(amplitude)]:
        neighbours = [k for k in chosen if abs(k - order) < 0.06 * order]
        if all(amplitude[k] > 2.0 * amplitude[order] for k in neighbours) and len(neighbours) < 2:
            chosen.append(int(order))
        if len(chosen) == _NAMED:
            break
    return sorted(chosen)


_MARKS = {
    "hysteresis_loss": "hysteresis loss",
    "backlash": "backlash",
    "lost_motion": "lost motion",
    "torsional_stiffness": "torsional stiffness",
}


def _loop_panels(loop: LoopData) -> list[Panel]:
    """Return panels of the whole loop, and of its middle with play and friction."""
    step, marks = max(1, loop.torque.size // 20000), loop_marks(loop)
    loop = without_drift(loop, drift_of(loop))
    traces = [Trace("measured", loop.torque[::step], loop.windup[::step] * ARCMIN, "thin", -1)]
    for number, (name, lines) in enumerate(marks.items()):
        for first, line in enumerate(lines):
            label = _MARKS[name] if first == 0 else ""
            traces.append(Trace(label, line[:, 0], line[:, 1] * ARCMIN, "thick", number))
    axes = ("torque on the output [N·m]", "windup of the output [arcmin]")
    name = f"Hysteresis loop: {Path(loop.source).name}"
    seen = (
        "Windup without its drift. The coloured lines show where each figure is evaluated in the first loop, lost "
        "motion in the first loop after the virgin branch; the figures are means over all such loops."
    )
    near = np.abs(loop.torque) <= _MIDDLE * loop.rated_torque
    middle = [
        t if t.colour >= 0 else Trace(t.label, loop.torque[near], loop.windup[near] * ARCMIN, "points", -1)
        for t in traces
        if t.label != _MARKS["torsional_stiffness"]
        and (t.colour < 0 or np.abs(t.x).max() <= _MIDDLE * loop.rated_torque)
    ]
    return [Panel(name, *axes, tuple(traces), seen), Panel(f"{name}, around zero torque", *axes, tuple(middle), seen)]


def _mid_curve_panels(source: str, free: FrictionFree) -> list[Panel]:
    """Return the panels of the spring's torque over the windup, and of the friction over it."""
    curve, figures, largest = free.curve, free.figures, free.largest
    windup = curve.windup * ARCMIN
    traces = [
        Trace("up: spring's torque and friction", windup, curve.spring + curve.friction, "thin", -1),
        Trace("down: spring's torque less friction", windup, curve.spring - curve.friction, "thin", -1),
        Trace("spring's torque", windup, curve.spring, "thick", 0),
    ]
    for number, (sign, (end, slope)) in enumerate(zip((-1.0, 1.0), free.lines, strict=True)):
        at = sign * np.array([0.0, LINE[1] * largest])
        label = "play and stiffness" if number == 0 else ""
        traces.append(Trace(label, (end + at / slope) * ARCMIN, at, "dashed", 1))
    ends = np.array([end for end, _ in free.lines])
    traces.append(Trace("", ends * ARCMIN, np.zeros(2), "thick", 1))
    name = Path(source).name
    seen = (
        "Mean of the passes in each direction. Play is the distance of the dashed lines at zero torque, stiffness "
        "their mean slope."
    )
    first = Panel(
        f"Loop without friction: {name}", "windup of the output [arcmin]", "torque [N·m]", tuple(traces), seen
    )
    load = np.array([0.0, largest])
    fitted = figures["friction_torque"].value + figures["friction_per_load"].value * load
    traces = [
        Trace("", np.abs(curve.spring), curve.friction, "points", -1),
        Trace("line up to 70 %", load, fitted, "dashed", 1),
    ]
    seen = "Half the distance of both directions at the same windup, over the spring's torque; both sides."
    return [first, Panel(f"Friction: {name}", "spring's torque [N·m]", "friction [N·m]", tuple(traces), seen)]


def _stiffness_panel(figures: Figures) -> list[Panel]:
    """Return the panel of torsional stiffness by side and torque range, with its 95 % interval."""
    figure = figures.figures.get("torsional_stiffness")
    if figure is None or len(figure.segments) < 2:
        return []
    traces, middles = [], []
    for number, (side, sign) in enumerate(SIDES):
        label = side
        for name, segment in figure.segments.items():
            part = segment.parts.get(side)
            if part is None or part.interval is None:
                continue
            at, half = sign * np.array(part.interval), part.uncertainty
            traces.append(Trace(label, at, np.full(2, part.value / ARCMIN), "thick", number))
            for end in (part.value - half, part.value + half):
                traces.append(Trace("", at, np.full(2, end / ARCMIN), "dashed", number))
            middles.append((float(at.mean()), part.value / ARCMIN, name))
            label = ""
    x, y, names = zip(*middles, strict=True)
    traces.append(Trace("", np.array(x), np.array(y), "points", -1, names))
    caption = "Slope of the loading branches in each torque range, mean of the loops; dashed: 95 % interval."
    axes = ("torque on the output [N·m]", "torsional stiffness [N·m/arcmin]")
    return [Panel("Torsional stiffness by torque", *axes, tuple(traces), caption, from_zero=True)]


def _start_panels(figures: Figures) -> list[Panel]:
    """Return panels of the torque of each start, from standstill until the crank has turned 1°.

    It is over the time, or over the samples of recordings without times.
    """
    panels = []
    for (name, starts_of), timed in itertools.product(STARTS.items(), (True, False)):
        shaft = "input" if name == "starting_torque" else "output"
        traces: list[Trace] = []
        for overview in (s.overview for s in figures.surveyed if s.loops is None and s.overview.timed == timed):
            torque = overview.input_torque if shaft == "input" else overview.torque
            for start in starts_of(overview, figures.ratio or overview.ratio)[0]:
                assert torque is not None
                time = overview.time[start.part] - overview.time[start.part.start]
                number = len(traces) // 2
                traces.append(Trace("", time, np.abs(torque[start.part]), "thin", number))
                at = slice(start.peak - start.part.start, start.peak - start.part.start + 1)
                traces.append(Trace("", time[at], np.array([start.torque]), "points", number, (str(number + 1),)))
        if traces:
            quantity = name.replace("_", " ")
            caption = f"The {quantity} is the mean of the marked values, the largest before the crank has turned 1°."
            axes = (
                "time since standstill [s]" if timed else "samples since standstill",
                f"torque on the {shaft} [N·m]",
            )
            panels.append(Panel(f"Starts driven by the {shaft}", *axes, tuple(traces), caption))
    return panels


def _budget_panel(figures: Figures) -> list[Panel]:
    """Return the panel of each input quantity's share in the variance of each figure that has a budget."""
    rows: list[str] = []
    traces: list[Trace] = []
    for number, (name, budget) in enumerate(figures.budgets.items()):
        whole, first = budget.standard_uncertainty**2, True
        for contribution in sorted(budget.contributions, key=lambda c: -c.contribution):
            share = 100.0 * contribution.contribution**2 / whole if whole else 0.0
            if share < 1.0:
                continue
            at = np.full(2, -float(len(rows)))
            label = name.replace("_", " ") if first else ""
            traces.append(Trace(label, np.array([0.0, share]), at, "thick", number))
            rows.append(f"{contribution.source} ({contribution.kind})")
            first = False
    if not rows:
        return []
    caption = "Share of the variance (GUM); A: from the recordings, B: stated. Shares below 1 % are left out."
    return [Panel("Uncertainty budgets", "share of the variance [%]", "", tuple(traces), caption, y_names=tuple(rows))]


def _torque_panels(figures: Figures) -> list[Panel]:
    """Return the panels of the torque over time, and over the samples of recordings without times."""
    panels = []
    for timed, title, axis in ((True, "Torque over time", "time [s]"), (False, "Torque over samples", "sample")):
        traces = []
        for number, recording in enumerate(figures.surveyed):
            time, torque = recording.overview.time, recording.overview.torque
            if recording.overview.timed != timed or np.isnan(torque).all():
                continue
            step = max(1, time.size // 5000)
            traces.append(Trace(Path(recording.source).name, time[::step] - time[0], torque[::step], "thin", number))
        if traces:
            panels.append(Panel(title, axis, "torque [N·m]", tuple(traces), "From the start of each recording."))
    return panels
