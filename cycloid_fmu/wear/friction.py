"""Sliding speed of every pin on the flank at a speed of the crank, and the friction power."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.flanks import flank_friction, flanks_rub
from cycloid_fmu.wear.sliding import ideal_velocities

Array = NDArray[np.float64]


class Sliding(NamedTuple):
    """Sliding of every pin that carries load, 0 elsewhere; shape (angles, discs, pins), SI.

    Attributes
    ----------
    sliding_speed
        Speed between flank and pin, m/s; 0 where the pin turns in its seat.
    friction_power
        μ F v of each pin, in its seat where it turns there, W; empty if no friction of the flanks is stated.
    friction_power_density
        Friction power per contact area 2ab, which is μ v times the mean Hertzian pressure π/4 p, W/m²; 0 where
        the pin turns, and empty likewise.
    """

    sliding_speed: Array
    friction_power: Array
    friction_power_density: Array


def sliding_of(
    pair: Pair, crank_angle: ArrayLike, pin_force: Array, pin_pressure: Array, crank_speed: float
) -> Sliding:
    """Return the sliding of every pin at one load, with the friction that the pair's `[losses]` state.

    Parameters
    ----------
    pair
        The pair.
    crank_angle
        Shape (angles,), rad.
    pin_force, pin_pressure
        Force (N) and largest pressure (Pa) of each pin, shape (angles, discs, pins).
    crank_speed
        rad/s, in either direction.

    Notes
    -----
    Velocities are those of the unmodified pair in closed form (`sliding.ideal_velocities`); modifications of some 50 µm
    change them by 0.7 %. Without [losses.pin] pins are fixed in the ring; one that turns in its seat or sleeve rolls on
    the flank, and its friction power is that of the seat (`losses.flanks`). Flash
    temperatures are left out: at 600 rpm of the crank the Péclet numbers of the wear paper's pair are below 1, and
    Blok's formula is for those above 5.
    """
    angle = np.asarray(crank_angle, dtype=float)[:, None, None]
    discs, pins = pin_force.shape[-2:]
    ring = angle / pair.pins if pair.output == "ring" else 0.0
    crank = angle + 2.0 * np.pi * np.arange(discs)[:, None] / discs
    phase = 2.0 * np.pi * np.arange(pins) / pins + ring - crank
    # The velocities are per radian of the ring's rotation relative to the crank.
    against = crank_speed * (pair.gear_teeth / pair.pins if pair.output == "ring" else 1.0)
    slip = np.where(pin_force > 0.0, np.abs(ideal_velocities(pair, phase).sliding * against), 0.0)
    if pair.losses is None or not flanks_rub(pair):
        return Sliding(slip, np.empty(0), np.empty(0))
    turning = abs(crank_speed)
    friction = flank_friction(pair, pair.losses, slip / turning if turning else slip, pin_force, turning)
    pressed = np.maximum(pin_force, 1e-300)
    density = np.where(friction.turns, 0.0, 0.25 * np.pi * pin_pressure * slip * friction.force / pressed)
    return Sliding(np.where(friction.turns, 0.0, slip), friction.force * slip, density)
