"""Figures of a drive with friction that have limits: efficiency, starting and back-driving torque, sliding."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.losses import figures
from cycloid_fmu.losses.back_driving import back_driving
from cycloid_fmu.losses.flanks import flanks_rub
from cycloid_fmu.losses.solver import solve
from cycloid_fmu.wear.friction import Sliding, sliding_of

Array = NDArray[np.float64]
FIGURES = ("efficiency", "starting_torque", "back_driving_torque", "self_locking")
"""The limits that friction decides."""


class FrictionFigures(NamedTuple):
    """Figures of a drive with friction, SI; empty where not asked for.

    Attributes
    ----------
    efficiency
        Of the driving drive at each load and speed, shape (loads,); 0 where it jams.
    starting_torque
        Of the input without a load, from rest, shape (angles,), N·m; infinite where it jams.
    back_driving_torque
        On the output, from rest, shape (angles,), N·m; infinite where none up to `searched_to` turns the drive.
    searched_to
        N·m.
    """

    efficiency: Array
    starting_torque: Array
    back_driving_torque: Array
    searched_to: float


def sliding_at(
    drive: DriveValue, frictionless: Transmission, load: int, crank_speed: float, workers: int = 1
) -> Sliding:
    """Return the sliding of every pin of the driving drive at a load of a sweep.

    Forces are those with friction where the drive states it and has [supports], otherwise those of the sweep.

    Parameters
    ----------
    drive
        The drive.
    frictionless
        Its sweep; `load` is the index of its torque.
    crank_speed
        rad/s, above zero.
    workers
        Threads.
    """
    pair, torque, angles = drive.pair, float(frictionless.torque[load]), frictionless.crank_angle
    force, pressure = frictionless.pin_force[load], frictionless.pin_pressure[load]
    if pair.supports is not None and flanks_rub(pair):
        rubbed = solve(drive, np.array([torque]), angles, 1 if torque >= 0.0 else -1, crank_speed, workers=workers)
        force, pressure = rubbed.motion.pin_force[0], rubbed.motion.pin_pressure[0]
    return sliding_of(pair, angles, force, pressure, crank_speed)


def friction_figures(
    drive: DriveValue,
    names: Collection[str],
    torque: Sequence[float],
    crank_speed: Sequence[float],
    crank_angle: Array,
    workers: int = 1,
) -> FrictionFigures:
    """Return the figures that some of `FIGURES` need.

    Parameters
    ----------
    drive
        A drive with [supports] and [losses].
    names
        Of `FIGURES`.
    torque, crank_speed
        Torques on the output (N·m), and the speed at each (rad/s), for the efficiency, in the driving direction.
    crank_angle
        rad.
    workers
        Threads.

    Raises
    ------
    edge.InputError
        As `losses.solver.solve`.
    """
    efficiency, start, back = list[float](), np.empty(0), np.empty(0)
    if "efficiency" in names:
        for load, speed in zip(torque, crank_speed, strict=True):
            found = solve(drive, np.array([load]), crank_angle, 1 if load > 0.0 else -1, speed, workers=workers)
            efficiency.append(figures.load_cases(drive, found)[0].efficiency)
    if "starting_torque" in names:
        start = figures.starting(drive, [0.0], crank_angle, workers=workers)[0.0]
    largest = drive.pair.rated_torque or max(map(abs, torque), default=0.0)
    if {"back_driving_torque", "self_locking"} & set(names):
        back = back_driving(drive, largest, crank_angle, workers=workers)
    return FrictionFigures(
        np.nan_to_num(np.array(efficiency), nan=0.0),
        np.where(np.isnan(start), np.inf, start),
        np.where(np.isnan(back), np.inf, back),
        largest,
    )
