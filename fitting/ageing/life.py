"""Figures of a drive over its life, as functions of the wear of flanks and pins and of a bearing's clearance.

By Archard's law the depth depends only on the product of wear coefficient k_0 and crank turns N, the wear dose k_0 N,
also when the profile is updated. So one wear run with any coefficient is valid for all.
"""

from __future__ import annotations

import dataclasses
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
        axes, points, values = [self.dose, self.clearance], [u, c], self.values[name]
        if self.clearance.size == 1:
            axes, points, values = axes[:1], points[:1], values[:, 0]
        linear = RegularGridInterpolator(axes, values, bounds_error=False, fill_value=None)
        return np.asarray(linear(np.stack(points, axis=-1)).reshape(u.shape))


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
    drive
        The drive, on rigid or on its stated bearings.
    torque
        On the output, for the transmission error, N·m.
    """
    pair, same = drive.pair, all(alike(drive.surface))
    count, turns = _ANGLES[not same], 1.0 / pair.pins if same else pair.gear_teeth
    if pair.supports is not None:
        count, turns = _OF_BEARINGS[not same], 1 if same else pair.gear_teeth
    angle = np.linspace(0.0, 2.0 * np.pi * turns, count, endpoint=False)
    solved = solve(drive, [torque, *pair.lost_motion_loads], angle, workers=workers)
    error, up, down = solved.transmission_error
    return dict(zip(FIGURES, (up - down, np.nan_to_num(solved.backlash), error), strict=True))


def means_of(curves: Mapping[str, Array]) -> dict[str, float]:
    """Return the figures of curves over the crank angle as one number each, rad, as on a bench."""
    return {name: float(np.mean(v) if name in FIGURES[:2] else np.ptp(v)) for name, v in curves.items()}


def life_figures(
    drive: Drive,
    law: WearLaw,
    loads: Sequence[Load],
    dose: float,
    *,
    growth: float = math.inf,
    bearing: str = "",
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
        Which bearing of `[supports]` wears (`supports.BEARINGS`), "" for none, and how far its diametral clearance
        grows at most, m.
    progress
        Called with the share done, 0 to 1.

    Raises
    ------
    edge.InputError
        If there is no rated torque, the drive has a first stage, or the pair states no such bearing.
    KeyboardInterrupt
        As raised.
    """
    refuse_first_stage(drive, "forecast")
    pair, workers = drive.pair, workers or os.cpu_count() or 1
    if pair.rated_torque is None:
        raise edge.InputError("rated_torque is missing; the lost motion is taken at 3 % of it.")
    if not any(load.torque for load in loads):
        raise edge.ArgumentError("torque", "no load wears the drive", "0 N*m")
    if bearing:
        with_clearance(pair, bearing, 0.0)  # refused before anything is computed
    scale = law.coefficient or 1.0
    rigid = pair if pair.supports is None else pair.nominal.replace(supports=None, bodies=None)
    # A cycle of one turn: the loads' order can't matter, as nobody knows where in it a recording was made.
    model = dataclasses.replace(wear_model(_on(rigid, drive.surface), law, loads), cycle=1.0)
    life = _worn_life(model, dose / scale, growth, workers, progress)
    if len(life.states) < _STATES:
        finer = law.replace(largest_step=min(law.largest_step, life.states[-1].depth.largest / (2.0 * _STATES)))
        life = _worn_life(dataclasses.replace(model, law=finer), dose / scale, growth, workers, progress)
    doses = scale * np.array([state.crank_turns for state in life.states])
    if doses[-1] == 0.0:
        raise edge.ArgumentError("dose", "the drive does not wear at all", dose)
    surfaces = [
        drive.surface.replace(**{n: getattr(worn, n) for n in DEVIATIONS}, origin="worn") for worn in life.surfaces
    ]
    nodes, new = np.zeros(1), life.curves[0]
    values = np.array([[[*means_of(curves).values()]] for curves in life.curves])  # (states, clearances, figures)
    if bearing:
        nodes = np.linspace(0.0, min(clearance, largest_growth(pair, bearing)), _CLEARANCES)
    if pair.supports is not None:
        pairs = [with_clearance(pair, bearing, float(more)) if bearing else pair for more in nodes]
        new = figures_of(_on(pairs[0], surfaces[0]), life.heaviest_torque, workers)
        chosen = np.unique(np.linspace(0, len(surfaces) - 1, _MOVED).round().astype(int))
        loaded = _on_bearings(pairs, [surfaces[k] for k in chosen], life.heaviest_torque, workers)
        chosen = chosen[: len(loaded)]
        effect = loaded - values[chosen]
        values = values + np.apply_along_axis(lambda each: np.interp(doses, doses[chosen], each), 0, effect)
    scatter = {name: 0.0 if name not in FIGURES[:2] else float(np.std(new[name])) for name in FIGURES}
    progress(1.0)
    return LifeFigures(
        doses, nodes, dict(zip(FIGURES, np.moveaxis(values, 2, 0), strict=True)), scatter, tuple(surfaces)
    )


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
            grown = float(np.mean(curves["lost_motion"] - life.curves[0]["lost_motion"]))
            progress(0.8 * min(max(state.crank_turns / crank_turns, grown / growth), 1.0))
            if grown >= growth:
                break
    except edge.InputError:
        # Worn so deep that contacts no longer balance the load: the life ends there.
        if len(life.curves) < 2:
            raise
    return life


def _on_bearings(pairs: Sequence[Pair], surfaces: Sequence[ErrorSurface], torque: float, workers: int) -> Array:
    """Return the figures of worn surfaces on each of the pairs, rad, shape (states, pairs, figures).

    Worn so deep that there is no balance at some angles, a state and those after it are left out.
    """
    states: list[list[list[float]]] = []
    for surface in surfaces:
        try:
            states.append([[*means_of(figures_of(_on(p, surface), torque, workers)).values()] for p in pairs])
        except edge.InputError:
            if not states:
                raise
            break
    return np.array(states)


def _on(pair: Pair, surface: ErrorSurface) -> DriveValue:
    """Return the drive of a surface on other supports, without the errors that these do not have."""
    possible = kinds_of(pair)
    errors = {name: values for name, values in surface.errors.items() if name in possible}
    deviations = {n: getattr(surface, n) for n in DEVIATIONS}
    return DriveValue(pair, ErrorSurface(pair.nominal, errors, **deviations, origin=surface.origin))
