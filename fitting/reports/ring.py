"""The actual ring: position of every pin and pitch of every tooth around their circles, with intervals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitting.estimation.realised import Realised
from fitting.reports.panels import Panel, Trace, stems

Array = NDArray[np.float64]

_DEPTH = 0.45  # of a circle's radius: drawn size of the largest displacement
_APART = 3.3  # radii between the centres of two circles
_NUMBERED = 8  # approximate number of elements of a circle that are numbered
_STEPS = (0.1, 0.2, 0.5)  # µm, times powers of ten: distances of the grid's circles
_TITLES = {
    "pin_radial": "pins, radial",
    "pin_tangential": "pins, tangential",
    "pin_radius_deviation": "pins, radius",
    "tooth_cumulative_pitch": "teeth, pitch",
}


def ring_panel(ring: Realised) -> Panel:
    """Return the panel of circles of pins and teeth side by side, with displacements drawn outwards and enlarged."""
    values = np.array([element.value for element in ring.elements]) * 1e6
    ends = np.array([element.interval for element in ring.elements]) * 1e6
    has_intervals = bool(np.isfinite(ends).all())
    largest = max(float(np.abs(ends if has_intervals else values).max()), 1e-3)
    step = next(s * 10.0**p for p in range(-3, 7) for s in _STEPS if 3.0 * s * 10.0**p >= largest)
    levels = step * np.arange(-math.ceil(largest / step - 1e-9), math.ceil(largest / step - 1e-9) + 1)
    scale = _DEPTH / levels[-1]
    round_about = np.linspace(0.0, 2.0 * np.pi, 181)
    traces: list[Trace] = []
    for number, (name, part) in enumerate(ring.circles.items()):
        middle, count = _APART * number, part.stop - part.start
        angle = 2.0 * np.pi * np.arange(count) / count

        def drawn(radius: Array, at: Array, middle: float = middle) -> tuple[Array, Array]:
            return middle + radius * np.cos(at), radius * np.sin(at)

        for level in levels:
            x, y = drawn(np.full(181, 1.0 + scale * level), round_about)
            traces.append(Trace("", x, y, "dashed" if level == 0.0 else "thin", -1))
        closed = np.append(np.arange(count), 0)
        traces.append(Trace("", *drawn(1.0 + scale * values[part][closed], angle[closed]), "thin", 0))
        if has_intervals:
            low, high = 1.0 + scale * ends[part].T
            label = "95 % interval" if number == 0 else ""
            at, spokes = stems(angle, low, high)
            traces.append(Trace(label, *drawn(spokes, at), "thick", 1))
        else:
            traces.append(Trace("", *drawn(1.0 + scale * values[part], angle), "dots", 0))
        every = max(1, round(count / _NUMBERED))
        numbers = tuple(str(i) if i % every == 0 else "" for i in range(count))
        traces.append(Trace("", *drawn(np.full(count, 1.0 + 1.25 * _DEPTH), angle), "words", 0, numbers))
        kind, _, disc = name.partition("_of_disc_")
        title = _TITLES[kind] + (f", disc {disc}" if disc else "")
        traces.append(Trace("", np.array([middle]), np.array([-1.0 - 1.9 * _DEPTH]), "words", 0, (title,)))
    return Panel(
        f"Every pin and tooth: grey circles are {step:g} µm apart",
        "",
        "",
        tuple(traces),
        "Positive values are drawn outwards from the dashed circle. Positive is radially outwards, or for tangential "
        "positions and teeth counter-clockwise. The part removed from the values is stated above the table.",
        round=True,
    )
