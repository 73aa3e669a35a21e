"""Transmission error curves, the standard figures and the actual errors of a drive, from bench recordings."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.estimation.ensemble import ensemble as ensemble
    from fitting.estimation.identify import identify as identify
    from fitting.estimation.identify import parameters as parameters
    from fitting.estimation.plan import Plan as Plan
    from fitting.estimation.plan import plan as plan
    from fitting.estimation.result import Identification as Identification
    from fitting.figures.coefficients import loss_coefficients as loss_coefficients
    from fitting.figures.comparison import compare as compare
    from fitting.figures.friction import FrictionFit as FrictionFit
    from fitting.figures.friction import friction as friction
    from fitting.figures.maps import maps as maps
    from fitting.figures.metrics import Figures as Figures
    from fitting.figures.metrics import metrics as metrics
    from fitting.readers.inspection import inspect as inspect
    from fitting.readers.mapping import read_mapping as read_mapping
    from fitting.readers.sources import Run as Run
    from fitting.readers.sources import read_recordings as read_recordings
    from fitting.reports.plots import plot as plot
    from fitting.reports.plots import plot_comparison as plot_comparison
    from fitting.reports.report import report as report
    from fitting.transmission_error.curve import Curve as Curve
    from fitting.transmission_error.curve import write_curves as write_curves
    from fitting.transmission_error.folding import curves as curves

_NAMES = {
    "estimation.ensemble": "ensemble",
    "estimation.identify": "identify parameters",
    "estimation.plan": "Plan plan",
    "estimation.result": "Identification",
    "figures.coefficients": "loss_coefficients",
    "figures.comparison": "compare",
    "figures.friction": "FrictionFit friction",
    "figures.maps": "maps",
    "figures.metrics": "Figures metrics",
    "readers.inspection": "inspect",
    "readers.mapping": "read_mapping",
    "readers.sources": "Run read_recordings",
    "reports.plots": "plot plot_comparison",
    "reports.report": "report",
    "transmission_error.curve": "Curve write_curves",
    "transmission_error.folding": "curves",
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Import a name on first use: importing NumPy and numba takes most of a second."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    attribute = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = attribute
    return attribute


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
