"""Figures of a drive over its life, as functions of the wear of flanks and pins and of a bearing's clearance.

By Archard's law the depth depends only on the product of wear coefficient k_0 and crank turns N, the wear dose k_0 N,
also when the profile is updated. So one wear run with any coefficient is valid for all.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RegularGridInterpolator

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive import Drive, refuse_first_stage
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import kinds_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, alike
from cycloid_fmu.wear.law import Load, WearLaw
from cycloid_fmu.wear.progress import WearModel, WearState, wear_model, wear_states, worn_surface

Array = NDArray[np.float64]
FIGURES = ("lost_motion", "backlash", "angular_transmission_error")
"""Figures of a forecast, by the names of the standard figures, rad."""
_STATES = 6  # of a life at least; figures are interpolated linearly between them
_CLEARANCES = 4
_MOVED = 3  # states in which the clearance is varied: its effect on the figures hardly depends on wear
_ANGLES = (48, 468)  # crank angles: in one pin pitch if all pins and teeth are identical, else in an output turn
_OF_BEARINGS = (48, 117)  # in a crank turn or an output turn, on bearings


@dataclass(frozen=True)
class LifeFigures:
    """Figures of one drive over wear dose and growth of a clearance; linear between the nodes and beyond the last.

    Attributes
    ----------
    dose
        k_0 N, shape (states,), from 0, m²/N.
    clearance
        Growth of the diametral clearance, shape (nodes,), from 0, m; one node if no bearing wears.
    values
        {figure: shape (states, nodes)}, rad: lost motion and backlash are means over the crank angles, the angular
        transmission error is the largest less the smallest value under the heaviest load.
    scatter
        {figure: standard deviation over the crank angle when new}, rad: a loop is measured at one angle.
    surfaces
        The worn drive in each state.
    """

    dose: Array
    clearance: Array
    values: Mapping[str, Array]
    scatter: Mapping[str, float]
    surfaces: tuple[ErrorSurface, ...] = ()

    def at(self, name: str, dose: ArrayLike, clearance: ArrayLike = 0.0) -> Array:
        """Return a figure at doses and growths of the clearance of one shape, rad."""
        u, c = np.broadcast_arrays(np.asarray(dose, dtype=float), np.asarray(clearance, dtype=float))
        axes, places = [self.dose, self.clearance], [u.ravel(), c.ravel()]
        values = self.values[name]
        if self.clearance.size == 1:
            axes, places, values = axes[:1], places[:1], values[:, 0]
        found = RegularGridInterpolator(axes, values, bounds_error=False, fill_value=None)(np.stack(places, axis=-1))
        return np.asarray(found.reshape(u.shape))


def with_clearance(pair: Pair, bearing: str, growth: float) -> Pair:
    """Return the pair with the diametral clearance of a bearing grown, m.

    Raises
    ------
    edge.InputError
        If the pair has no such bearing, or it is rigid.
    """
    if pair.supports is None:
        raise edge.ArgumentError("bearing", "the pair has no [supports]", bearing)
    return pair.replace(supports=pair.supports.grown(bearing, growth))


def largest_growth(pair: Pair, bearing: str) -> float:
    """Return the largest growth of a bearing's clearance, m: to the largest value in a pair file."""
    assert pair.supports is not None
    return float(pair.supports.largest_clearance - getattr(pair.supports, bearing).clearance)


def figures_of(drive: DriveValue, torque: float, workers: int = 1) -> dict[str, Array]:
    """Return lost motion, backlash and transmission error of a drive over crank angles, rad, each of shape (angles,).

    Parameters
    ----------
    pair, surface
        The pair, on rigid or on its stated bearings, and its errors.
    torque
        On the output, for the transmission error, N·m.
    """
    pair, surface = drive.pair, drive.surface
    both = all(alike(surface))
    g, count = pair, _ANGLES[not both]
    angle = np.linspace(0.0, 2.0 * np.pi * (1.0 / g.pins if both else g.gear_teeth), count, endpoint=False)
    if pair.supports is not None:
        turns = 1 if both else g.gear_teeth
        angle = np.linspace(0.0, 2.0 * np.pi * turns, _OF_BEARINGS[not both], endpoint=False)
    torques = [torque, *pair.lost_motion_loads]
    found = solve(drive, torques, angle, workers=workers)
    error, up, down = found.transmission_error
    return {
        "lost_motion": up - down,
        "backlash": np.nan_to_num(found.backlash),
        "angular_transmission_error": error,
    }


def mean_figures(curves: Mapping[str, Array]) -> dict[str, float]:
    """Return the figures of curves over the crank angle as one number each, rad, as on a bench."""
    return {name: _value(name, curve) for name, curve in curves.items()}


def _value(name: str, curve: Array) -> float:
    return float(np.ptp(curve) if name == "angular_transmission_error" else np.mean(curve))


def life_figures(
    drive: Drive,
    law: WearLaw,
    loads: Sequence[Load],
    dose: float,
    *,
    growth: float = math.inf,
    bearing: str | None = None,
    clearance: float = 0.0,
    workers: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> LifeFigures:
    """Return the figures of a drive over its life with wear of flanks, pins and a bearing.

    Flanks wear as on rigid bearings: a clearance shifts the discs, which hardly changes the loads of single pins.

    Parameters
    ----------
    drive
        The new drive; it needs a rated torque.
    law, loads
        Wear law and duty; each load has its share of the turns. A constant coefficient has no effect here; with a
        regression the dose is a multiple of it.
    dose
        Up to which the life goes, m²/N (crank turns times the regression's coefficients, 1).
    growth
        The life ends also where lost motion has grown by so much, rad, or where no contacts balance the loads.
    bearing, clearance
        Which bearing of `[supports]` wears (`supports.BEARINGS`), and how far its diametral clearance grows at most, m.
    progress
        Told which share is done, 0 to 1.

    Raises
    ------
    edge.InputError
        If there is no rated torque, the drive has a first stage, or the pair states no such bearing.
    KeyboardInterrupt
        As raised.
    """
    refuse_first_stage(drive, "forecast")
    pair, cores = drive.pair, workers or os.cpu_count() or 1
    if pair.rated_torque is None:
        raise edge.InputError("rated_torque is missing; the lost motion is taken at 3 % of it.")
    if not loads or not any(load.torque for load in loads):
        raise edge.ArgumentError("torque", "no load wears the drive", "0 N*m")
    if bearing is not None:
        with_clearance(pair, bearing, 0.0)  # refused before anything is computed
    unit = law if law.coefficient is None else law.replace(coefficient=_UNIT)
    scale = 1.0 if law.coefficient is None else _UNIT
    bare, made = _on_rigid_bearings(DriveValue(pair, drive.surface))
    # Shares of a turn: the cycle's order can't matter, as nobody knows where in it a recording was made.
    total = sum(load.crank_turns for load in loads)
    shares = [load.replace(crank_turns=load.crank_turns / total) for load in loads]

    def run(step: float, most: float, begun: float) -> _WornLife:
        model = wear_model(DriveValue(bare, made), unit.replace(largest_step=step), shares)
        return _worn_life(model, most / scale, growth, cores, lambda done: progress(begun + 0.4 * done))

    life = run(law.largest_step, dose, 0.0)
    if len(life.states) < _STATES:
        last = life.states[-1]
        life = run(min(law.largest_step, last.depth.largest / (2.0 * _STATES)), last.crank_turns * scale, 0.4)
    surfaces = [
        drive.surface.replace(**{n: getattr(worn, n) for n in DEVIATIONS}, origin="worn") for worn in life.surfaces
    ]
    at = np.array([state.crank_turns * scale for state in life.states])
    if at[-1] == 0.0:
        raise edge.ArgumentError("dose", "the drive does not wear at all", dose)
    values = {name: np.array([[_value(name, row[name])] for row in life.curves]) for name in FIGURES}
    first, nodes = life.curves[0], np.zeros(1)
    if bearing is not None:
        nodes = np.linspace(0.0, min(clearance, largest_growth(pair, bearing)), _CLEARANCES)
    if pair.supports is not None:
        first, moved, places = _on_bearings(
            pair, surfaces, values, bearing, nodes, life.heaviest_torque, cores, progress
        )
        for name in FIGURES:
            each = [np.interp(at, at[places], moved[name][:, j]) for j in range(nodes.size)]
            values[name] = values[name] + np.array(each).T
    scatter = {name: 0.0 if name not in FIGURES[:2] else float(np.std(first[name])) for name in FIGURES}
    progress(1.0)
    return LifeFigures(at, nodes, values, scatter, tuple(surfaces))


class _WornLife(NamedTuple):
    """States of a wear run on rigid bearings, the worn surfaces, and the curves of `figures_of` in each state."""

    heaviest_torque: float
    states: list[WearState]
    surfaces: list[ErrorSurface]
    curves: list[dict[str, Array]]


def _worn_life(
    model: WearModel, crank_turns: float, growth: float, workers: int, progress: Callable[[float], None]
) -> _WornLife:
    """Return a life of so many crank turns, or until lost motion has grown by `growth`, rad, or nothing balances."""
    life = _WornLife(model.heaviest_torque, [], [], [])
    try:
        for state in wear_states(model, crank_turns, workers):
            worn = worn_surface(model, state.depth)
            curves = figures_of(DriveValue(model.pair, worn), life.heaviest_torque, workers)
            life.states.append(state)
            life.surfaces.append(worn)
            life.curves.append(curves)
            grown = _value("lost_motion", curves["lost_motion"]) - _value("lost_motion", life.curves[0]["lost_motion"])
            done = max(state.crank_turns / crank_turns, grown / growth if growth < math.inf else 0.0)
            progress(min(done, 1.0))
            if grown >= growth:
                break
    except edge.InputError:
        # Worn so deep that contacts no longer balance the load: the life ends there.
        if len(life.curves) < 2:
            raise
    return life


def _on_bearings(
    pair: Pair,
    surfaces: Sequence[ErrorSurface],
    rigid: Mapping[str, Array],
    bearing: str | None,
    nodes: Array,
    torque: float,
    workers: int,
    progress: Callable[[float], None],
) -> tuple[dict[str, Array], dict[str, Array], list[int]]:
    """Return the curves when new, the effect of bearings in some states and clearances, and these states."""
    chosen = np.unique(np.linspace(0, len(surfaces) - 1, _MOVED).round().astype(int)).tolist()
    first: dict[str, Array] = {}
    rows: list[list[dict[str, float]]] = []
    for i, state in enumerate(chosen):
        row = []
        for j, growth in enumerate(nodes):
            on = pair if bearing is None else with_clearance(pair, bearing, float(growth))
            try:
                curves = figures_of(DriveValue(on, _of_pair(surfaces[state], on)), torque, workers)
            except edge.InputError:
                if i == 0:
                    raise
                # Worn so deep that there is no balance at some angles: the effect of the bearings stays constant.
                return first, _by_figure(rows), chosen[:i]
            first = first or curves
            row.append({name: _value(name, curves[name]) - float(rigid[name][state, 0]) for name in FIGURES})
            progress(0.8 + 0.2 * (i * nodes.size + j + 1) / (len(chosen) * nodes.size))
        rows.append(row)
    return first, _by_figure(rows), chosen


def _by_figure(rows: Sequence[Sequence[Mapping[str, float]]]) -> dict[str, Array]:
    return {name: np.array([[one[name] for one in row] for row in rows]) for name in FIGURES}


_UNIT = 1e-18  # m²/N: any coefficient serves; this one keeps crank turns of the run usual numbers


def _on_rigid_bearings(drive: DriveValue) -> tuple[Pair, ErrorSurface]:
    """Return the drive without its supports and their errors."""
    pair, surface = drive.pair, drive.surface
    if pair.supports is None:
        return pair, surface
    return (bare := pair.nominal.replace(supports=None, bodies=None)), _of_pair(surface, bare)


def _of_pair(surface: ErrorSurface, pair: Pair) -> ErrorSurface:
    """Return the surface as one of a pair with other supports."""
    possible = kinds_of(pair)
    kept = {name: values for name, values in surface.errors.items() if name in possible}
    return ErrorSurface(pair.nominal, kept, **{n: getattr(surface, n) for n in DEVIATIONS}, origin=surface.origin)
