"""Panels of transmission error curves: measured ones, ones compared with a model, and drives that are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCSEC
from fitting.reports.panels import Panel, Trace, band, label_of, turn_panel
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]
ERROR = "transmission error [arcsec]"


def curve_panels(curves: Sequence[Curve]) -> list[Panel]:
    """Return the panels of curves over the output turn, and over the crank turn."""
    folded = []
    for number, curve in enumerate(curves):
        crank = np.degrees(curve.input_angle % (2.0 * np.pi))
        folded.append(Trace("", crank, curve.transmission_error * ARCSEC, "dots", number))
    return [
        turn_panel(curves, "Over the output turn"),
        Panel("Over the crank turn, all turns folded", "crank angle [°]", ERROR, tuple(folded), ""),
    ]


def comparison_panels(
    curves: Sequence[Curve], simulated: Sequence[Array], label: str, crank_turns: float = 3.0
) -> tuple[Panel, Panel]:
    """Return the panels of measured and simulated curves, rad, over the first crank turns, and of their differences."""
    both, differences = [], []
    for number, (curve, model) in enumerate(zip(curves, simulated, strict=True)):
        turns, residual = curve.input_angle / (2.0 * np.pi), (curve.transmission_error - model) * ARCSEC
        shown, rms = turns <= crank_turns, float(np.sqrt(np.mean(residual**2)))
        measured = curve.transmission_error[shown] * ARCSEC
        both.append(Trace("measured" if number == 0 else "", turns[shown], measured, "points", -1))
        both.append(Trace(label_of(curve), turns[shown], model[shown] * ARCSEC, "thin", number))
        differences.append(Trace(f"{label_of(curve)}: residual {rms:.2f}″ rms", turns, residual, "thin", number))
    return (
        Panel(f"Measured and {label}", "crank turns", ERROR, tuple(both), ""),
        Panel("Residual", "crank turns", f"measured minus {label} [arcsec]", tuple(differences), ""),
    )


def band_panels(drive: Drive, drawn: Sequence[Drive], torque: float) -> list[Panel]:
    """Return the error of a drive at a torque, N·m, with the 95 % band of drawn ones, and the difference."""
    angle = np.linspace(0.0, 2.0 * np.pi * abs(drive.ratio), 24 * round(abs(drive.ratio)), endpoint=False)

    def error(drive: Drive) -> Array:
        solved = solve(DriveValue(drive.pair, drive.surface), torque, angle, with_play=False)
        return np.asarray(solved.transmission_error[0] * ARCSEC)

    identified, turns = error(drive), angle / (2.0 * np.pi)
    low, high = np.quantile([error(drive) for drive in drawn], [0.025, 0.975], axis=0)
    whole = (band(f"95 % of {len(drawn)} drawn", turns, low, high), Trace("identified", turns, identified, "thin"))
    difference = (band("", turns, low - identified, high - identified),)
    return [
        Panel(f"{torque:+.4g} N·m", "crank turns", ERROR, whole, ""),
        Panel("Difference", "crank turns", "drawn minus identified\n[arcsec]", difference, ""),
    ]
