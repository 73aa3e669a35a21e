"""The standard figures of a drive from all its recordings: which of them count, and how they become one figure each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cycloid_fmu import edge
from fitting.figures.figure import Figure, figure_json, pooled
from fitting.figures.hysteresis import loop_figures
from fitting.figures.spectrum import Spectrum, angular_transmission_error, spectrum
from fitting.figures.starts import Start, back_driving_torques, start_figure, starting_torques
from fitting.figures.survey import Surveyed
from fitting.transmission_error.curve import Curve

FORMAT = "cycloid-figures/1"


@dataclass(frozen=True)
class Figures:
    """The figures of one drive from all its recordings.

    Attributes
    ----------
    figures
        By name; those that the recordings don't tell are not there, and `notes` say why.
    surveyed
        What each recording gave.
    spectra
        Orders of each curve, in the order of the recordings and their curves; None where less than a turn is there.
    rated_torque, ratio
        T_N (N·m) and signed ratio, where known.
    notes
        What was left out and why, one sentence each.
    """

    figures: dict[str, Figure]
    surveyed: tuple[Surveyed, ...]
    spectra: tuple[Spectrum | None, ...]
    rated_torque: float | None
    ratio: float | None
    notes: tuple[str, ...]

    @property
    def curves(self) -> list[Curve]:
        """All curves."""
        return [c for s in self.surveyed for c in s.curves]


def figures_of(surveyed: Sequence[Surveyed], ratio: float | None, rated_torque: float | None) -> Figures:
    """Return the figures that recordings of one drive give together.

    Several recordings' loops count together; of transmission errors the largest is the figure, the others are its
    runs.

    Parameters
    ----------
    surveyed
        What each recording gave.
    ratio, rated_torque
        As given to `survey`.
    """
    notes = [n for s in surveyed for n in s.notes]
    figures: dict[str, Figure] = {}
    of_loops = []
    for one in surveyed:
        if one.loops is not None:
            found, said = loop_figures(one.loops)
            notes += said
            of_loops.append(found)
    for name in ("hysteresis_loss", "backlash", "lost_motion", "torsional_stiffness"):
        same = [f[name] for f in of_loops if name in f]
        if same:
            figures[name] = pooled(same)
    spectra: list[Spectrum | None] = []
    ways: dict[str, dict[str, Figure]] = {"forward": {}, "backward": {}}
    for one in surveyed:
        for curve in one.curves:
            way = "forward" if curve.direction > 0 else "backward"
            try:
                orders = spectrum(curve)
            except edge.InputError as problem:
                notes.append(f"{problem} No angular transmission error is given for it.")
                spectra.append(None)
                continue
            spectra.append(orders)
            around, varies = abs(curve.torque), curve.torque_deviation
            if 0.1 * around < varies < around or varies > 0.1 * (rated_torque or math.inf):
                notes.append(
                    f"{curve.source}: the torque varies by {varies:.3g} N·m around {curve.torque:.4g} "
                    "N·m; the transmission error holds the windup that this makes."
                )
            figure = angular_transmission_error(curve, orders)
            # Clocks that run apart add their way over one turn, for every turn begins anew.
            uncertainty = math.hypot(figure.uncertainty, one.apart / max(curve.turns, 1.0))
            figure = dataclasses.replace(figure, uncertainty=uncertainty)
            ways[way][f"{one.source}, {curve.torque:.4g} N*m, {way}"] = figure
    parts = {way: max(runs.values(), key=lambda f: f.value) for way, runs in ways.items() if runs}
    if parts:
        largest = max(parts.values(), key=lambda f: f.value)
        runs = {name: f for way in ways.values() for name, f in way.items()}
        figures["angular_transmission_error"] = Figure(
            largest.value, largest.uncertainty, largest.unit, largest.definition, largest.interval,
            largest.interval_unit, largest.count, largest.counted, parts, runs,
        )  # fmt: skip
    started: dict[str, list[Start]] = {"starting_torque": [], "back_driving_torque": []}
    for one in surveyed:
        if one.loops is not None:
            continue
        for name, starts_by in (("starting_torque", starting_torques), ("back_driving_torque", back_driving_torques)):
            starts, said = starts_by(one.overview, ratio if ratio is not None else one.overview.ratio)
            started[name] += starts
            notes += said
            if one.averaged > 1 and starts:
                notes.append(
                    f"{one.source}: {name}: its torques are means of {one.averaged} samples of a long recording."
                )
    for name, starts in started.items():
        if starts:
            figures[name] = start_figure(name, [s.torque for s in starts])
    return Figures(figures, tuple(surveyed), tuple(spectra), rated_torque, ratio, tuple(dict.fromkeys(notes)))


def figures_json(found: Figures) -> dict[str, Any]:
    """Return all figures as the content of a `cycloid-figures/1` file: each under its name, and whence they are."""
    return {
        "format": FORMAT,
        **{name: figure_json(f) for name, f in found.figures.items()},
        "rated_torque": found.rated_torque,
        "ratio": found.ratio,
        "data": {s.source: s.checksum for s in found.surveyed},
        "notes": list(found.notes),
    }
