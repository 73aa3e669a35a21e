"""Friction of flanks on pins at given forces and sliding speeds, by the law that the balance has too."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact import Array, compiled
from cycloid_fmu.geometry.losses import Losses
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.rubbing import LAW, sliding_friction
from cycloid_fmu.losses.solver import contact_law


class FlankFriction(NamedTuple):
    """Friction of flanks on pins, SI, in the shape of the given forces.

    Attributes
    ----------
    force
        Friction force at the flank, not below 0, N.
    turns
        Whether the pin turns in its seat and rolls on the flank.
    """

    force: Array
    turns: NDArray[np.bool_]


@compiled
def _frictions(laws: NDArray[np.void], radius: float, speed: Array, force: Array, out: Array, turns: Array) -> None:
    for i in range(speed.size):
        acting = sliding_friction(laws[0], 1.0, radius, speed[i], force[i])
        out[i] = abs(acting.amplitude)
        turns[i] = 1.0 if acting.turns else 0.0


def flanks_rub(pair: Pair) -> bool:
    """Return whether a pair states friction of its flanks."""
    return pair.losses is not None and pair.losses.flank.static + pair.losses.flank.friction_coefficient > 0.0


def flank_friction(pair: Pair, losses: Losses, speed: Array, force: Array, crank_speed: float) -> FlankFriction:
    """Return the friction of flanks on pins.

    Parameters
    ----------
    pair
        For the radius of its pins.
    losses
        What is stated of the flanks, of what the pins turn in, and of the lubricant.
    speed, force
        Sliding for each radian of the crank, m, in either direction; normal force, N, of the same shape.
    crank_speed
        rad/s, not below 0; infinite for coefficients at speed.
    """
    laws: Any = np.zeros(1, LAW)
    contact_law(laws[0], losses.flank, losses.pin, crank_speed, losses.thinning)
    out, turns = np.zeros(speed.size), np.zeros(speed.size)
    speeds, forces = (np.ascontiguousarray(values, dtype=float).ravel() for values in (speed, force))
    _frictions(laws, pair.pin_radius, speeds, forces, out, turns)
    return FlankFriction(out.reshape(speed.shape), turns.reshape(speed.shape) > 0.0)


def coefficient_at_speed(pair: Pair, losses: Losses) -> float:
    """Return the ratio of friction to normal force of flanks on pins without its rise towards rest."""
    unit = np.ones(1)
    return float(flank_friction(pair, losses, unit, unit, math.inf).force[0])
