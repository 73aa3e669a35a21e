"""Changes of figures: before and after, two drives, two temperatures."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.figures.figure import Figure, in_field_units
from fitting.figures.metrics import FORMAT, FRICTION_FREE, Figures, metrics
from fitting.readers.sources import Source


@dataclass(frozen=True)
class Change:
    """One figure before and after, SI.

    Attributes
    ----------
    name
        Name of the figure, followed by a dot and the part, if any: `torsional_stiffness.positive`.
    before, after
        The figure on both sides.
    difference, uncertainty
        After minus before, and half width of its 95 % interval, from both uncertainties as independent.
    """

    name: str
    before: Figure
    after: Figure

    @property
    def difference(self) -> float:
        """After minus before."""
        return self.after.value - self.before.value

    @property
    def uncertainty(self) -> float:
        """Half width of the 95 % interval of the difference; NaN if one of the two is unknown."""
        return math.hypot(self.before.uncertainty, self.after.uncertainty)

    @property
    def moved(self) -> bool | None:
        """Whether the figure changed by more than the uncertainty of the difference; None if that is unknown."""
        return None if math.isnan(self.uncertainty) else abs(self.difference) > self.uncertainty

    def in_field_units(self) -> tuple[str, str, str, str, str]:
        """Return both values, their difference, its uncertainty and the unit, in field units."""
        larger = dataclasses.replace(self.after, value=max(abs(self.before.value), abs(self.after.value)))
        change = dataclasses.replace(self.before, value=self.difference, uncertainty=self.uncertainty)
        before, after = (in_field_units(figure, like=larger)[0] for figure in (self.before, self.after))
        return before, after, *in_field_units(change, like=larger)


@dataclass(frozen=True)
class Comparison:
    """Comparison of the figures of two sides.

    Attributes
    ----------
    changes
        Changes of the figures and parts that both sides have over the same interval.
    notes
        One sentence for each omission on either side, and for each figure that can't be compared.
    """

    changes: tuple[Change, ...]
    notes: tuple[str, ...]


def compare(
    before: Figures | Source | str | os.PathLike[str],
    after: Figures | Source | str | os.PathLike[str],
    drive: Drive | None = None,
    *,
    ratio: float | None = None,
    rated_torque: float | str | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Comparison:
    """Return the figures that changed by more than their uncertainty: before and after, two drives, two temperatures.

    Parameters
    ----------
    before, after
        Figures, their file, or a recording.
    drive, ratio, rated_torque, progress
        As in `fitting.metrics`, for a recording.

    Raises
    ------
    edge.InputError
        If a file can't be read or the two have no figure that can be compared.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> torque = 100.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4000))
    >>> new, worn = (fitting.Run(input_angle=0.0, output_angle=torque * c, torque=torque) for c in (1e-6, 1.1e-6))
    >>> stiffness, *_ = (c for c in fitting.compare(new, worn).changes if c.name == "torsional_stiffness")
    >>> stiffness.moved, round(stiffness.difference / stiffness.before.value, 3)
    (True, -0.091)
    """
    sides: list[dict[str, Figure]] = []
    notes: list[str] = []
    for side in (before, after):
        if isinstance(side, str | os.PathLike):
            sides.append(read_figures(side))
            continue
        if not isinstance(side, Figures):
            side = metrics(side, drive, ratio=ratio, rated_torque=rated_torque, progress=progress)
        sides.append(side.shown)
        notes += side.notes
    changes, missing = changes_between(*sides)
    notes += missing
    if not changes:
        raise edge.NoDataError("\n".join([*notes, "before and after have no figure that can be compared."]))
    return Comparison(tuple(changes), tuple(notes))


def changes_between(before: Mapping[str, Figure], after: Mapping[str, Figure]) -> tuple[list[Change], list[str]]:
    """Return the changes of figures that both sides have, and a sentence for each that can't be compared."""
    changes: list[Change] = []
    notes = []
    for name in dict.fromkeys((*before, *after)):
        first, second = before.get(name), after.get(name)
        if first is None or second is None:
            notes.append(f"{name}: only {'the second' if first is None else 'the first'} has it.")
            continue
        if not _same_interval(first, second, _ALIKE if name.startswith(FRICTION_FREE) else _SAME):
            notes.append(
                f"{name}: it was evaluated over {_interval(first)} in the first and {_interval(second)} in the second; "
                "use the same rated torque for both."
            )
            continue
        changes.append(Change(name, first, second))
        changes += [Change(f"{name}.{p}", first.parts[p], second.parts[p]) for p in first.parts if p in second.parts]
    return changes, notes


def _same_interval(first: Figure, second: Figure, tolerance: float) -> bool:
    if first.interval is None or second.interval is None:
        return first.interval == second.interval
    return all(math.isclose(a, b, rel_tol=tolerance) for a, b in zip(first.interval, second.interval, strict=True))


def _interval(figure: Figure) -> str:
    low, high = figure.interval or (math.nan, math.nan)
    return f"{low:.4g} … {high:.4g} {figure.interval_unit}"


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON data for scripts, SI."""
    same = ("difference", "uncertainty", "moved")
    changes = {
        c.name: {"before": c.before.value, "after": c.after.value, "unit": c.before.unit}
        | {name: getattr(c, name) for name in same}
        for c in comparison.changes
    }
    return {**changes, "notes": list(comparison.notes)}


def read_figures(path: str | os.PathLike[str]) -> dict[str, Figure]:
    """Read the figures written by `cycloid-fit metrics -o`.

    Raises
    ------
    edge.InputError
        If the file does not have this format.
    """
    data = edge.json_table(path, FORMAT, "figures")
    with edge.parsed_by_others(path, "a figure is incomplete or not a number"):
        free = {f"{FRICTION_FREE}{name}": content for name, content in data.pop("friction_free", {}).items()}
        return {
            n: _figure(content)
            for n, content in (data | free).items()
            if isinstance(content, dict) and n not in _SOURCES
        }


_SOURCES = ("data", "implausible", "locked")  # tables of the file that are not figures
_COUNTED = ("loops", "turns", "starts", "passes")
_SAME, _ALIKE = 1e-3, 0.25  # relative difference of intervals; that of friction-free figures is the loop's own


def _figure(data: dict[str, Any]) -> Figure:
    counted = next(c for c in (*_COUNTED, None) if c is None or c in data)
    if counted is None:
        raise KeyError(" or ".join(_COUNTED))
    known = {"budget", counted, *(field.name for field in dataclasses.fields(Figure))}
    return Figure(
        value=float(data["value"]),
        uncertainty=math.nan if data["uncertainty"] is None else float(data["uncertainty"]),
        unit=data["unit"],
        definition=data["definition"],
        interval=None if data["interval"] is None else (float(data["interval"][0]), float(data["interval"][1])),
        interval_unit=data["interval_unit"],
        count=float(data[counted]),
        counted=counted,
        parts={k: _figure(v) for k, v in data.items() if k not in known},
        runs={k: _figure(v) for k, v in data.get("runs", {}).items()},
        segments={k: _figure(v) for k, v in data.get("segments", {}).items()},
        remark=data.get("remark", ""),
    )
