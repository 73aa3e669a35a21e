"""Derivatives of the crank's torque and of the transmission error with friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.transmission import Sensitivity
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS, Losses
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.displacements import sweep_motion_sensitivities
from cycloid_fmu.losses.rubbing import COEFFICIENTS
from cycloid_fmu.losses.solver import Rubbed, laws_of, losses_of, rubbing_of, solve
from cycloid_fmu.losses.sweeps import slope_of, sweep_rubbing_sensitivities
from cycloid_fmu.supports.joints import work_of
from cycloid_fmu.supports.transmission import assembly_of, no_derivatives, problem_of, sensitivity_of

Array = NDArray[np.float64]
_LINEAR = ("friction_coefficient", "static_friction_coefficient", "load_factor", "speed_factor")
_IN_LAWS = ("flank", "pin", "output_contact", "output_roller", "turning_arm", "crank_shaft", "main")


def _alone(losses: Losses, part: str, coefficient: str) -> Losses | None:
    """Return the friction with one coefficient at 1 and all others at 0; None where the coefficient is not stated."""
    stated = getattr(losses, part)
    if stated is None or (part == "output_contact" and losses.output_roller is None):
        return None
    zeros = {name: 0.0 for name in stated.linear_in if getattr(stated, name) is not None}
    if coefficient not in zeros or (coefficient == "speed_factor" and losses.lubricant is None):
        return None  # without a viscosity a speed factor makes no friction
    table = stated.replace(friction=None, **{**zeros, coefficient: 1.0})
    others = {name: getattr(losses, name) for name in ("output_roller", "lubricant")}
    if part != "output_roller" and others["output_roller"] is not None:
        others["output_roller"] = others["output_roller"].replace(radius=None, friction=None, friction_coefficient=0.0)
    return Losses(**{**others, part: table})


def _by_name(pair: Pair, losses: Losses, crank_speed: float, by_law: Array, by_drag: Array) -> dict[str, Array]:
    """Return derivatives by "table.key" from those by the `COEFFICIENTS` of each law and by the carrier's drag."""
    by = dict[str, Array]()
    for part in _IN_LAWS:
        for coefficient in _LINEAR:
            if (alone := _alone(losses, part, coefficient)) is not None:
                laws: Any = laws_of(pair.at_temperature, alone, crank_speed)
                each = np.stack([laws[name] for name in COEFFICIENTS], axis=-1)
                by[f"{part}.{coefficient}"] = np.einsum("alc,lc->a", by_law, each)
    by["output_drag.coulomb"] = by_drag
    by["output_drag.viscous"] = by_drag * crank_speed / pair.gear_teeth
    by["output_drag.churning"] = by["output_drag.viscous"] * losses.thinning
    return by


def sensitivity(drive: DriveValue, rubbed: Rubbed, load: int = 0, slices: int | None = None) -> dict[str, Array]:
    """Return the derivatives of the crank's torque by the stated coefficients, by "table.key", shape (angles,) each.

    Parameters
    ----------
    drive
        The drive.
    rubbed
        Of `solver.solve`, with a balance at every angle.
    load
        Index of the torque.
    slices
        As for `solver.solve`.

    Returns
    -------
    dict
        {"flank.friction_coefficient": N·m, "turning_arm.load_factor": N·m, "output_drag.coulomb": 1, …}. Where no
        coefficient at rest is stated it is that at speed, and moves with it.

    Notes
    -----
    With r(q, p) = 0 the balance, dτ/dp = ∂τ/∂p - λ·∂r/∂p, λ (∂r/∂q) = ∂τ/∂q: one linear solution for all. Which of
    two contacts slides, and the speed of its sliding, are held.
    """
    pair, losses, angles = drive.pair, losses_of(drive), rubbed.motion.crank_angle
    rubbing = rubbing_of(drive, rubbed.direction, rubbed.crank_speed)
    by_law = np.zeros((angles.size, rubbing.laws.size, len(COEFFICIENTS)))
    by_carrier = np.zeros((angles.size, 2))
    torques = np.array(np.broadcast_to(rubbed.motion.torque[load], angles.shape))
    unknowns, assembly = rubbed.coordinates.shape[-1], assembly_of(drive)
    solved = sweep_rubbing_sensitivities(
        problem_of(drive, slices or drive.slices),
        assembly,
        angles,
        torques,
        np.ascontiguousarray(rubbed.coordinates[load]),
        rubbing,
        by_law,
        by_carrier,
        work_of(assembly),
        slope_of(unknowns),
        np.zeros(len(PARTS)),
    )
    if not solved:
        raise ValueError("the balance is singular: the drive jams")
    by = _by_name(pair, losses, rubbed.crank_speed, by_law, by_carrier[:, 0])
    if losses.first_stage is not None and drive.first_stage is not None:
        by["first_stage.loss"] = by_carrier[:, 1]
        if losses.first_stage.loss is None:
            stage = losses.first_stage.replace(friction_coefficient=1.0)
            share = stage.share(drive.first_stage.sun_teeth, drive.first_stage.planet_teeth)
            by["first_stage.friction_coefficient"] = by_carrier[:, 1] * share
    return by


@dataclass(frozen=True)
class MotionSensitivity:
    """Transmission error with friction and its derivatives.

    Attributes
    ----------
    motion
        Transmission error, and derivatives as without friction.
    by_coefficient
        Derivatives by the stated coefficients, by "table.key" as of `sensitivity`, shape (angles,) each: rad, of drags
        rad/(N·m).
    crank_torque
        As of `solver.Rubbed`, shape (angles,), N·m.
    """

    motion: Sensitivity
    by_coefficient: dict[str, Array]
    crank_torque: Array


def motion_sensitivity(
    drive: DriveValue,
    torque: Array,
    crank_angle: Array,
    direction: int,
    crank_speed: float,
    slices: int | None = None,
    near: Array | None = None,
) -> MotionSensitivity:
    """Return the transmission error of a drive that turns in one direction, with friction, and its derivatives.

    Parameters
    ----------
    drive
        A drive with [supports] and [losses], without a first stage.
    torque, crank_angle
        Torque of the environment on the output, N·m, one or shape (angles,); rad, shape (angles,).
    direction, crank_speed, slices, near
        As for `solver.solve`.

    Raises
    ------
    edge.InputError
        As `solver.solve`, and where the drive jams.

    Notes
    -----
    As those without friction (docs/theory/supports.md), dx/dp = -λ·∂r/∂p with the friction in the balance r. Which of
    two contacts slides, and the speed of its sliding, are held.
    """
    pair, losses, angles = drive.pair, losses_of(drive), np.array(crank_angle, dtype=float)
    torques, slices = np.array(np.broadcast_to(torque, angles.shape), dtype=float), slices or drive.slices
    rubbed = solve(drive, torques[None], angles, direction, crank_speed, slices=slices, near=near)
    coordinates, rubbing, assembly = (
        rubbed.coordinates[0],
        rubbing_of(drive, direction, crank_speed),
        assembly_of(drive),
    )
    error = rubbed.motion.transmission_error[0]
    if np.isnan(error).any():
        jammed = int(np.argmax(np.isnan(error)))
        raise edge.InputError(
            f"torque = {torques[jammed]:g} N*m: the drive jams at a crank angle of {angles[jammed]:.6g} rad, where the "
            f"crank turns in direction {direction}; state less friction in [losses] or give a smaller torque."
        )
    derivatives, by_drag = no_derivatives(pair, assembly, angles.size), np.zeros(angles.size)
    by_law = np.zeros((angles.size, rubbing.laws.size, len(COEFFICIENTS)))
    solved = sweep_motion_sensitivities(
        problem_of(drive, slices),
        assembly,
        angles,
        torques,
        np.ascontiguousarray(coordinates),
        rubbing,
        derivatives,
        by_law,
        by_drag,
        work_of(assembly),
        slope_of(coordinates.shape[-1]),
        np.zeros(len(PARTS)),
    )
    if not solved:
        raise edge.InputError(f"torque = {torques[0]:g} N*m: the balance is singular: the drive jams.")
    motion = sensitivity_of(pair, coordinates, derivatives)
    return MotionSensitivity(motion, _by_name(pair, losses, crank_speed, by_law, by_drag), rubbed.crank_torque[0])
