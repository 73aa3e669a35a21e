"""Loops of several sizes, or at several positions, in one recording: each group of like loops has its own figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitting.figures.figure import DEFINITIONS, Figure, in_field_units
from fitting.figures.friction_free import FrictionFree, friction_free
from fitting.figures.hysteresis import loop_figures, mean_of_loops
from fitting.transmission_error.loop_groups import ALIKE
from fitting.transmission_error.loops import LoopData

Array = NDArray[np.float64]
_ROUND = 0.85  # of a group's largest torque, up to which the loading stiffness is taken


@dataclass(frozen=True)
class LoopGroup:
    """Loops of like size and position in one recording, with their figures.

    Attributes
    ----------
    source
        Name of the recording.
    largest_torque
        Largest torque of the group, N·m.
    group
        Number that the recording states for these loops; None without such a column.
    loops_found, loops_used
        Number of loops, and of those that the hysteresis loss is from.
    figures
        The standard figures, at shares of the largest torque; and `loading_stiffness`.
    friction_free
        Figures without friction; None where the loops are too small for them.
    notes
        Why figures are missing, one sentence each.
    """

    source: str
    largest_torque: float
    group: float | None
    loops_found: int
    loops_used: int
    figures: dict[str, Figure]
    friction_free: FrictionFree | None
    notes: tuple[str, ...]


def round_interval(largest: float) -> tuple[float, float]:
    """Return the largest interval from a power of ten to its double below 85 % of a torque, N·m.

    Examples
    --------
    >>> round_interval(25.0), round_interval(4.0)
    ((10.0, 20.0), (1.0, 2.0))
    """
    low = 10.0 ** math.floor(math.log10(0.5 * _ROUND * largest))
    return low, 2.0 * low


def loading_stiffness(data: LoopData) -> Figure | None:
    """Return the secant stiffness of the loading branches over `round_interval`; None where no branch has it.

    Friction that grows with load is part of it.
    """
    low, high = round_interval(data.rated_torque)
    slopes = []
    for lobe in data.lobes:
        torque, windup = data.torque[lobe.loading] * lobe.sign, data.windup[lobe.loading] * lobe.sign
        ends = []
        for at in (low, high):
            near = np.abs(torque - at) < 0.1 * at
            if near.sum() >= 3:
                line = np.polynomial.Polynomial.fit(torque[near], windup[near], 1)
                ends.append(float(line(at)))
        if len(ends) == 2 and ends[1] > ends[0]:
            slopes.append((ends[1] - ends[0]) / (high - low))
    if not slopes:
        return None
    soft, uncertainty, degrees = mean_of_loops([(slope, 0.0) for slope in slopes])
    if len(slopes) < 3:
        uncertainty = math.nan
    definition, half = DEFINITIONS["loading_stiffness"], uncertainty / soft**2
    return Figure(1.0 / soft, half, *definition, (low, high), "N*m", len(slopes), "branches", degrees=degrees)


def group_of(data: LoopData) -> LoopGroup:
    """Return the figures of one group of loops."""
    figures, notes = loop_figures(data)
    stiffness = loading_stiffness(data)
    if stiffness is not None:
        figures["loading_stiffness"] = stiffness
    used = int(figures["hysteresis_loss"].count) if "hysteresis_loss" in figures else 0
    return LoopGroup(
        data.source,
        data.rated_torque,
        data.group,
        len(data.loops),
        used,
        figures,
        friction_free(data),
        tuple(note for note in notes if "drift" not in note),
    )


def play_range(groups: Sequence[LoopGroup]) -> tuple[Figure, Figure] | None:
    """Return the smallest and the largest play over the positions of loops; None with fewer than two positions.

    Of the groups that reach `ALIKE` of the largest torque, as play depends on the load up to which it is extrapolated.
    """
    largest = max((group.largest_torque for group in groups), default=0.0)
    plays = [
        group.friction_free.figures["play"]
        for group in groups
        if group.friction_free is not None and group.largest_torque > ALIKE * largest
    ]
    if len(plays) < 2:
        return None
    return min(plays, key=lambda f: f.value), max(plays, key=lambda f: f.value)


GROUPS_HEAD = ("recording", "group", "largest torque", "loops used", "hysteresis loss", "play", "loading stiffness")
"""Columns of `group_rows`."""


def group_rows(groups: Sequence[LoopGroup]) -> list[list[str]]:
    """Return groups of loops as table rows, columns `GROUPS_HEAD`."""

    def shown(figure: Figure | None) -> str:
        return "" if figure is None else "{} ± {} {}".format(*in_field_units(figure))

    rows = []
    for group in groups:
        stiffness = group.figures.get("loading_stiffness")
        over = "" if stiffness is None or stiffness.interval is None else "{:g} … {:g} N·m".format(*stiffness.interval)
        play = None if group.friction_free is None else group.friction_free.figures["play"]
        rows.append(
            [
                Path(group.source).name,
                "" if group.group is None else f"{group.group:g}",
                f"{group.largest_torque:.4g} N·m",
                f"{group.loops_used} of {group.loops_found}",
                shown(group.figures.get("hysteresis_loss")),
                shown(play),
                f"{shown(stiffness)} {f'({over})' if over else ''}",
            ]
        )
    return rows
