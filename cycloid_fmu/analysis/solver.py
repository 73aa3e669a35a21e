"""Solving a drive over torques and crank angles, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.transmission import Options, Sensitivity, Transmission, form_sensitivity
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.reducer import behind_first_stage
from cycloid_fmu.supports import transmission as stage
from cycloid_fmu.supports.transmission import parameters_of
from cycloid_fmu.surfaces.structured import displacement_columns, profile_wave

Array = NDArray[np.float64]


def _finite(values: ArrayLike, name: str) -> Array:
    array = np.array(values, dtype=float, ndmin=1)
    if not np.isfinite(array).all():
        raise edge.ArgumentError(name, "it must be finite", values)
    return array


def solve(
    drive: DriveValue,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int | None = None,
    *,
    with_play: bool = True,
    with_stiffness: bool = True,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> Transmission:
    """Solve a drive at every torque and crank angle.

    Parameters
    ----------
    drive
        The drive; one with a life is that at the age of its surface. On stated bearings the discs are solved with them;
        behind a first stage the sun is locked where ideal gears have the cranks at `crank_angle`, and transmission
        error, stiffness and play are those of the output of the whole reducer.
    torque
        Torques of the environment on the output, N·m, shape (torques,), or without a first stage (torques, angles)
        where they change along the sweep; at 0 the transmission error is the middle of the play.
    crank_angle
        Crank angles, rad; neighbours should be neighbours in the array, each solution starts from the one before.
    slices
        Slices across the face width; None for as many as the errors need.
    with_play
        Whether to compute play, backlash and interference; NaN otherwise.
    with_stiffness
        Whether to compute the torsional stiffness behind a first stage; NaN otherwise.
    with_elements
        Whether to keep the contact lines and the largest pressure of each element.
    workers
        Threads. The work is divided in the same way whatever their number, so the results are the same bits.
    progress
        Called with the number of crank angles (times loads) that were just finished.

    Returns
    -------
    Transmission
        On stated bearings an `OnBearings`.

    Raises
    ------
    edge.InputError
        If a torque can't be carried, or play is asked for on bearings without a rated torque.
    Interrupted
        At a KeyboardInterrupt without a first stage; it holds the results of the crank angles that were finished.
    """
    drive = drive.at_own_age
    options = Options(slices or drive.slices, with_play, with_stiffness, with_elements, workers, progress)
    torques, angles = _finite(torque, "torque"), _finite(crank_angle, "crank_angle")
    if drive.first_stage is None:
        return stage.solve(drive, torques, angles, options)
    return behind_first_stage.solve(drive, torques, angles, options)


def lost_motion(drive: DriveValue, crank_angle: ArrayLike, *, workers: int = 1) -> Array:
    """Return the lost motion of a drive with a rated torque at crank angles (rad), shape (angles,), rad."""
    loads = drive.pair.lost_motion_loads
    up, down = solve(
        drive, loads, crank_angle, with_play=False, with_stiffness=False, workers=workers
    ).transmission_error
    return np.asarray(up - down)


def sensitivity(
    drive: DriveValue,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int | None = None,
    near: Array | None = None,
) -> Sensitivity:
    """Return transmission error and derivatives of the cycloid stage at one torque, or one for each crank angle.

    Parameters
    ----------
    drive, crank_angle, slices
        As for `solve`; a first stage is left out.
    torque
        Torque on the stage's output, N·m, not 0; one, or shape (angles,).
    near
        On bearings, `coordinates` of the same crank angles of a drive near this one, to start from.

    Raises
    ------
    edge.InputError
        If a torque can't be carried.
    """
    drive, angles = drive.at_own_age, _finite(crank_angle, "crank_angle")
    torques = np.array(np.broadcast_to(_finite(torque, "torque"), angles.shape))
    return stage.sensitivity(drive, torques, angles, slices or drive.slices, near)


def error_sensitivity(
    drive: DriveValue, torque: ArrayLike, crank_angle: ArrayLike, names: list[str], slices: int | None = None
) -> tuple[Array, Array]:
    """Return the transmission error at one torque and its derivatives by errors or bearings.

    Parameters
    ----------
    drive, torque, crank_angle, slices
        As for `sensitivity`; behind a first stage one torque.
    names
        Structured errors, orders of the profile deviation among them, and those of `parameters_of`.

    Returns
    -------
    transmission_error, jacobian
        Shapes (angles,) and (angles, names): rad; rad/m, rad/rad for angles, rad for logarithms of stiffness.

    Raises
    ------
    edge.InputError
        If a torque can't be carried, or a derivative by a profile deviation is asked for on stated bearings.
    """
    slices = slices or drive.slices
    if drive.first_stage is not None:
        output, gear_torque, crank, by_stage = behind_first_stage.moved_by_errors(
            drive, float(np.squeeze(torque)), _finite(crank_angle, "crank_angle"), slices
        )
        return output, by_stage[:, None] * error_sensitivity(drive.stage, gear_torque, crank, names, slices)[1]
    profiles = [name for name in names if profile_wave(name, 1) is not None]
    if profiles and drive.pair.supports is not None:
        raise edge.ArgumentError("errors", "no derivative by the flank profile is available with supports", profiles[0])
    found = sensitivity(drive, torque, crank_angle, slices)
    parameters = parameters_of(drive.pair)
    errors = [name for name in names if name not in parameters]
    columns = dict(zip(errors, (found.by_displacement @ displacement_columns(drive.pair, errors)).T, strict=True))
    columns |= {name: found.by_bearing[:, parameters.index(name)] for name in names if name in parameters}
    if profiles:
        by_form = form_sensitivity(drive, found.transmission_error, crank_angle, profiles, slices)
        columns |= dict(zip(profiles, by_form.T, strict=True))
    jacobian = [columns[name] for name in names]
    return found.transmission_error, np.array(jacobian).T if names else np.zeros((found.transmission_error.size, 0))
