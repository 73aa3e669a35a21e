"""Which figures moved: before and after, two drives, two temperatures."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cycloid_fmu import edge
from fitting.figures.figure import DEFINITIONS, Figure
from fitting.figures.metrics import FORMAT


@dataclass(frozen=True)
class Change:
    """One figure before and after, SI.

    Attributes
    ----------
    name
        The figure, and after a dot its part: `torsional_stiffness.positive`.
    before, after
        The figure of either.
    difference, uncertainty
        After less before, and half its 95 % interval: both uncertainties, which are independent, together.
    """

    name: str
    before: Figure
    after: Figure

    @property
    def difference(self) -> float:
        """After less before."""
        return self.after.value - self.before.value

    @property
    def uncertainty(self) -> float:
        """Half the 95 % interval of the difference; NaN where one of the two is unknown."""
        return math.hypot(self.before.uncertainty, self.after.uncertainty)

    @property
    def moved(self) -> bool | None:
        """Whether it moved beyond its uncertainty; None where that is unknown."""
        return None if math.isnan(self.uncertainty) else abs(self.difference) > self.uncertainty


def compare(before: Mapping[str, Figure], after: Mapping[str, Figure]) -> tuple[list[Change], list[str]]:
    """Compare figures, their parts included.

    Returns
    -------
    changes
        Of the figures that both have, taken over the same interval.
    notes
        One sentence for each figure that can't be compared.
    """
    changes, notes = [], []
    for name in DEFINITIONS:
        one, other = before.get(name), after.get(name)
        if one is None and other is None:
            continue
        if one is None or other is None:
            notes.append(f"{name}: only {'the second' if one is None else 'the first'} has it.")
            continue
        if not _same_interval(one, other):
            notes.append(
                f"{name}: it was taken over {_said(one)} in the first and {_said(other)} in the second; give both the "
                "same rated torque."
            )
            continue
        changes.append(Change(name, one, other))
        changes += [Change(f"{name}.{p}", one.parts[p], other.parts[p]) for p in one.parts if p in other.parts]
    return changes, notes


def _same_interval(one: Figure, other: Figure) -> bool:
    if one.interval is None or other.interval is None:
        return one.interval == other.interval
    return all(math.isclose(a, b, rel_tol=1e-3) for a, b in zip(one.interval, other.interval, strict=True))


def _said(figure: Figure) -> str:
    low, high = figure.interval or (math.nan, math.nan)
    return f"{low:.4g} … {high:.4g} {figure.interval_unit}"


def changes_json(changes: list[Change], notes: list[str]) -> dict[str, Any]:
    """Return changes for scripts (SI)."""
    return {
        **{
            c.name: {
                "before": c.before.value, "after": c.after.value, "difference": c.difference,
                "uncertainty": c.uncertainty, "unit": c.before.unit, "moved": c.moved,
            }
            for c in changes
        },
        "notes": notes,
    }  # fmt: skip


def read_figures(path: str | os.PathLike[str]) -> dict[str, Figure]:
    """Read the figures that `cycloid-fit metrics -o` wrote.

    Raises
    ------
    edge.InputError
        If the file is no such file.
    """
    data = edge.json_table(path, FORMAT, "figures")
    try:
        return {name: _figure(data[name]) for name in DEFINITIONS if name in data}
    except (KeyError, TypeError, ValueError) as problem:
        raise edge.InputError(f"{path}: a figure lacks something or is no number ({problem}).") from None


_COUNTED = ("loops", "turns", "starts")


def _figure(data: dict[str, Any]) -> Figure:
    counted = next(c for c in (*_COUNTED, None) if c is None or c in data)
    if counted is None:
        raise KeyError(" or ".join(_COUNTED))
    known = {"value", "uncertainty", "unit", "definition", "interval", "interval_unit", "runs", counted}
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
    )
