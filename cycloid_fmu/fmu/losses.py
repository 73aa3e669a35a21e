"""Losses of the mesh and bearings as in Modelica's `LossyGear`: a table over the input's speed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

Row = Sequence[float]


def interpolated(table: Sequence[Row], speed: float) -> tuple[float, float, float, float]:
    """Efficiencies (1) and friction torques (N·m) at a speed: linear between the rows, constant beyond the last."""
    speed = abs(speed)
    last, a, b, c, d = table[-1]
    if speed < last:
        below, above = next(two for two in itertools.pairwise(table) if speed < two[1][0])
        share = (speed - below[0]) / (above[0] - below[0])
        a, b, c, d = (low + share * (high - low) for low, high in zip(below[1:], above[1:], strict=True))
    return a, b, c, d


def lost_torque(table: Sequence[Row], speed: float, asked: float) -> float:
    """Sliding friction torque at flange_a against its motion, N·m.

    `Modelica.Mechanics.Rotational.Components.LossyGear` (Modelica Standard Library 4.0): with τ the torque of the
    teeth, with the sign of the motion, flange_a needs (τ + τ_bf1)/η_mf1 while it drives and η_mf2 (τ + τ_bf2) while
    flange_b does. Its stuck mode is that of `friction`.

    Parameters
    ----------
    table
        Rows of |w|, η_mf1, η_mf2, τ_bf1, τ_bf2 (`Interface.losses`).
    speed
        Speed of flange_a, rad/s, of any sign.
    asked
        Torque τ of the teeth, N·m.
    """
    # A single row is used directly, for speed: this runs at every step.
    forward, backward, friction_forward, friction_backward = (
        table[0][1:] if len(table) == 1 else interpolated(table, speed)
    )
    # Modelica decides which side drives by flange_a's torque without the bearings' part, `tau_bf_a`.
    if forward == 1.0 and backward == 1.0:
        bearing = 0.5 * friction_forward
    else:
        bearing = (friction_forward - friction_backward) * backward / (forward * backward - 1.0)
    if asked >= forward * bearing - friction_forward:
        return (asked + friction_forward) / forward - asked
    return backward * (asked + friction_backward) - asked


def check_losses(rows: Sequence[Row]) -> None:
    """Check a loss table.

    Raises
    ------
    ValueError
        If speeds do not ascend from 0, an efficiency is not between 0 and 1 or a torque is below 0; the text is one
        sentence.
    """
    for i, (speed, forward, backward, *torques) in enumerate(rows, start=1):
        if not (speed == 0.0 if i == 1 else rows[i - 2][0] < speed < math.inf):
            raise ValueError(f"loss_table[{i},1] = {speed:g}: speeds must ascend from 0")
        if not 0.0 < forward <= 1.0:
            raise ValueError(f"loss_table[{i},2] = {forward:g}: an efficiency must be above 0 and not above 1")
        if not 0.0 <= backward <= 1.0:
            raise ValueError(f"loss_table[{i},3] = {backward:g}: an efficiency must be between 0 and 1")
        for j, torque in enumerate(torques, start=4):
            if not 0.0 <= torque < math.inf:
                raise ValueError(f"loss_table[{i},{j}] = {torque:g}: a friction torque must not be below 0")
