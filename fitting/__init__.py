"""From bench recordings to transmission error curves, the standard figures and the actual errors of a drive."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.estimation.ensemble import ensemble
    from fitting.estimation.identify import identify
    from fitting.estimation.plan import Plan, plan
    from fitting.estimation.result import Identification
    from fitting.figures.comparison import Comparison, compare
    from fitting.figures.figure import Figure
    from fitting.figures.metrics import Figures, metrics
    from fitting.recordings.inspection import Inspection, inspect
    from fitting.recordings.mapping import FileMapping, read_mapping
    from fitting.recordings.sources import Run, read_recordings
    from fitting.reports.plots import plot
    from fitting.reports.report import report
    from fitting.transmission_error.curve import Curve, write_curves
    from fitting.transmission_error.folding import curves

_HOMES = {
    "estimation.ensemble": ("ensemble",),
    "estimation.identify": ("identify",),
    "estimation.plan": ("Plan", "plan"),
    "estimation.result": ("Identification",),
    "figures.comparison": ("Comparison", "compare"),
    "figures.figure": ("Figure",),
    "figures.metrics": ("Figures", "metrics"),
    "recordings.inspection": ("Inspection", "inspect"),
    "recordings.mapping": ("FileMapping", "read_mapping"),
    "recordings.sources": ("Run", "read_recordings"),
    "reports.plots": ("plot",),
    "reports.report": ("report",),
    "transmission_error.curve": ("Curve", "write_curves"),
    "transmission_error.folding": ("curves",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Comparison",
    "Curve",
    "Figure",
    "Figures",
    "FileMapping",
    "Identification",
    "Inspection",
    "Plan",
    "Run",
    "compare",
    "curves",
    "ensemble",
    "identify",
    "inspect",
    "metrics",
    "plan",
    "plot",
    "read_mapping",
    "read_recordings",
    "report",
    "write_curves",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for: NumPy and numba take most of a second."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
