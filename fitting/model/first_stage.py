"""Recordings behind a first stage: the sun's angle is recorded, the model is that of the cycloid stage.

The angle of the cranks is θ = θ_ideal + a d + w, with θ_ideal that of ideal gears at the sun's angle. The output
deviates by d = s (x(θ, sT) + ½ u sgn T - w/z_c): w is the rotation of the cranks from the first stage, half its play
against the load plus its wind-up, and u the play of the carrier's bearings (`cycloid_fmu.reducer.behind_first_stage`,
docs/theory/reducer.md). The rotation of the cranks by d itself, some 1e-3 rad, is to first order, and the torque
of the cranks is its mean.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.first_stage import FirstStage, sun_locked_share
from cycloid_fmu.geometry.pair import Pair
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]


def of_cranks(curve: Curve, drive: Drive) -> Curve:
    """Return a curve over the sun's angle as one over that of ideal cranks; the transmission error is unchanged."""
    if drive.first_stage is None or abs(curve.ratio / drive.ratio - 1.0) > 1e-9:
        return curve
    share = drive.pair.ratio / drive.ratio
    sign = 1 if share > 0.0 else -1
    start = 0.0 if curve.branch else 2.0 * np.pi * abs(drive.pair.ratio)
    crank = curve.input_angle * share
    return dataclasses.replace(
        curve,
        input_angle=np.mod(crank, start) if start else crank,
        ratio=drive.pair.ratio,
        direction=sign * curve.direction,
        grid=(curve.grid[0], curve.grid[1] * share),
        angle_variance=None if curve.angle_variance is None else curve.angle_variance * share**2,
        speed=None if curve.speed is None else curve.speed * share,
        crank_speed=None if curve.crank_speed is None else curve.crank_speed * abs(share),
        travel=None if curve.travel is None else curve.travel * abs(share),
    )


def share_of(first_stage: FirstStage | None, pair: Pair) -> float:
    """Return s, the ratio of the output's deviation to that of the cycloid stage; 1 without a first stage."""
    return 1.0 if first_stage is None else sun_locked_share(first_stage.crank_share, pair.gear_teeth)


def turned(first_stage: FirstStage, pair: Pair, torque: Array, more_play: float) -> Array:
    """Return w, rad, at the torque on the output, where the cranks' play is larger than stated, rad."""
    on_cranks = (1.0 - share_of(first_stage, pair)) / first_stage.crank_share * torque
    found: Array = -on_cranks / first_stage.crank_stiffness
    return found - 0.5 * np.sign(torque) * (first_stage.crank_play + more_play)


def with_play(first_stage: FirstStage, more_play: float) -> FirstStage:
    """Return the stage with additional play of its cranks, rad."""
    return dataclasses.replace(first_stage, sun_play=first_stage.sun_play + more_play / first_stage.sun_share)
