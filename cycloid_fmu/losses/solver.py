"""A drive with friction over torques and crank angles, in one direction and at one speed of the crank."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.parts import solve_in_parts
from cycloid_fmu.contact.transmission import Options, along_sweep
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import PARTS, Bearing, Friction, Losses, Seat
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.rubbing import DRAG_INPUT, LAW, Rubbing
from cycloid_fmu.losses.sweeps import slope_of, sweep_rubbing
from cycloid_fmu.supports import transmission as stage
from cycloid_fmu.supports.assembly import bodies_of, kinds_of
from cycloid_fmu.supports.joints import work_of
from cycloid_fmu.supports.transmission import (
    OnBearings,
    assembly_of,
    empty,
    of_part,
    problem_of,
    results,
    with_own_discs,
)

Array = NDArray[np.float64]
PART = 64  # crank angles that one thread solves at a time
_RPM = 30.0 / math.pi


def losses_of(drive: DriveValue, source: str = "the pair") -> Losses:
    """Return what is stated of friction; `source` is the name of the file.

    Raises
    ------
    edge.InputError
        If nothing is, there are no [supports], or the loss is that of a first stage that the drive does not have.
    """
    losses = drive.pair.losses
    if losses is None:
        raise edge.InputError(
            f"{source}: no friction stated; state [losses], such as [losses.flank] friction_coefficient, and the "
            "[supports] that it acts on."
        )
    if drive.pair.supports is None:
        raise edge.InputError(
            f"{source}: [losses] needs [supports], which is missing: friction depends on the bearings' forces."
        )
    if losses.first_stage is not None and drive.first_stage is None:
        raise edge.InputError(
            f"{source}: [losses.first_stage]: the drive has no first stage; state it in a reducer file."
        )
    return losses


def _coefficients(friction: Friction | None, speed: float, thinning: float) -> tuple[float, float, float]:
    """Return coefficients at speed and at rest, and the decay between them, as those of `LAW`."""
    if friction is None:
        return 0.0, 0.0, 0.0
    if friction.stribeck_speed is None and speed > 0.0:
        return friction.friction_coefficient, friction.friction_coefficient, 0.0
    decay = 0.0 if friction.stribeck_speed is None else (speed * thinning / friction.stribeck_speed) ** 2
    return friction.friction_coefficient, friction.static, decay


def contact_law(law: np.record, contact: Friction, seat: Seat | None, speed: float, thinning: float) -> None:
    """Write the friction of a contact and of what its pin or roller turns in, at a speed of the crank, rad/s."""
    law["kinetic"], law["static"], law["decay"] = _coefficients(contact, speed, thinning)
    if seat is not None and seat.radius is not None:
        law["joint_kinetic"], law["joint_static"], decay = _coefficients(seat, speed, thinning)
        law["joint_radius"] = seat.pressure_factor * seat.radius
        law["joint_decay"] = decay / seat.pressure_factor**2


def _bearing_law(law: np.record, bearing: Bearing, relative: float, speed: float, losses: Losses) -> None:
    """Write M_0 and l of a bearing; `relative` is its rotation for each radian of the crank."""
    if bearing.radius is not None:
        kinetic, static, decay = _coefficients(bearing, speed, losses.thinning)
        rest = math.exp(-decay * (relative * bearing.radius) ** 2)
        law["arm"] = bearing.radius * (kinetic + (static - kinetic) * rest)
        return
    assert bearing.mean_diameter is not None
    viscosity = 0.0 if losses.lubricant is None else losses.lubricant.viscosity
    # Palmgren's formula in mm²/s, rpm, mm and N·mm.
    moved = max((1e6 * viscosity * relative * speed * _RPM) ** (2.0 / 3.0), 160.0)
    law["arm"] = bearing.load_factor * bearing.mean_diameter
    law["constant"] = bearing.load_factor * bearing.mean_diameter * bearing.preload
    law["constant"] += 1e-10 * bearing.speed_factor * (1e3 * bearing.mean_diameter) ** 3 * moved


def laws_of(pair: Pair, losses: Losses, crank_speed: float) -> NDArray[np.void]:
    """Return the friction of each kind of joint and, last, of the flanks at a speed of the crank, rad/s.

    Raises
    ------
    edge.InputError
        If a rolling bearing's speed factor needs the lubricant's viscosity, which is missing.
    """
    if crank_speed > 0.0 and (lacking := losses.without_viscosity):
        raise edge.InputError(
            f"[losses.lubricant] is missing: [losses.{lacking[0]}] speed_factor needs its viscosity; state it, or "
            "speed_factor = 0."
        )
    kinds, rate, thinning = kinds_of(pair), bodies_of(pair)["rate"], losses.thinning
    laws: Any = np.zeros(len(kinds) + 1, LAW)
    for law, kind in zip(laws, kinds, strict=False):
        if kind.name == "output_roller":
            contact_law(law, losses.output_contact, losses.output_roller, crank_speed, thinning)
            roller = losses.output_roller
            law["outer_radius"] = roller.outer_radius if roller is not None else 0.0
        elif (bearing := getattr(losses, kind.name)) is not None:
            relative = float(np.abs(rate[kind.outer] - rate[kind.inner]).max())
            _bearing_law(law, bearing, relative, crank_speed, losses)
    contact_law(laws[-1], losses.flank, losses.pin, crank_speed, thinning)
    return cast(NDArray[np.void], laws)


def sun_rate(drive: DriveValue) -> float:
    """Return the rotation of the input, crank or sun, for each radian of the crank."""
    if drive.first_stage is None:
        return 1.0
    share = 1.0 / drive.pair.gear_teeth
    return -((1.0 + share) / drive.first_stage.sun_share + share)


def input_held(drive: DriveValue) -> float:
    """Return what holds the cranks of a drive at rest, which its input's drag is, behind a first stage: N·m, ≥ 0.

    A drive turns backwards where the cranks give off more.
    """
    losses, first = losses_of(drive), drive.first_stage
    drag = losses.input_drag.torque(0.0, losses.thinning)
    if first is None:
        return drag
    return drag / (first.sun_share * (1.0 - rubbing_of(drive, -1, 0.0).loss))


def rubbing_of(drive: DriveValue, direction: int, crank_speed: float) -> Rubbing:
    """Return the friction of a drive for the kernels.

    Parameters
    ----------
    drive
        A drive with losses.
    direction
        Of the crank's rotation, 1 counter-clockwise or -1.
    crank_speed
        rad/s, not below 0; at 0 friction is that at rest.
    """
    losses, first = losses_of(drive), drive.first_stage
    drag, loss = losses.output_drag.torque(crank_speed / drive.pair.gear_teeth, losses.thinning), 0.0
    if first is not None and losses.first_stage is not None:
        loss = losses.first_stage.share(first.sun_teeth, first.planet_teeth)
    laws = laws_of(drive.pair.at_temperature, losses, crank_speed)
    return Rubbing(laws, float(direction), drag, 0.0 if first is None else first.sun_share, loss)


@dataclass(frozen=True)
class Rubbed:
    """A drive with friction over torques and crank angles, SI.

    Attributes
    ----------
    direction, crank_speed
        1 or -1; rad/s, not below 0.
    motion
        Motion, forces and the crank's torque; NaN where the drive jams.
    coordinates
        Unknowns of the balance, shape (torques, angles, unknowns).
    loss
        What each of `PARTS` loses for each radian of the crank, shape (torques, angles, parts), J.
    input_torque
        Torque of the environment on the input shaft with its drag, shape (torques, angles), N·m.
    input_rate
        Rotation of the input shaft for each radian of the crank.
    """

    direction: int
    crank_speed: float
    motion: OnBearings
    coordinates: Array
    loss: Array
    input_torque: Array
    input_rate: float

    @property
    def crank_torque(self) -> Array:
        """Torque of the environment on the crank, on all cranks together, N·m; shape (torques, angles)."""
        assert self.motion.crank_torque is not None
        return self.motion.crank_torque

    @property
    def input_work(self) -> Array:
        """Work of the environment at the input for each radian of the crank, mean over the angles, J; (torques,)."""
        return np.asarray(self.direction * self.input_rate * self.input_torque.mean(axis=1))


def solve(
    drive: DriveValue,
    torque: Array,
    crank_angle: Array,
    direction: int,
    crank_speed: float,
    *,
    slices: int | None = None,
    near: Array | None = None,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> Rubbed:
    """Solve a drive with friction.

    Parameters
    ----------
    drive
        A drive with [supports] and [losses]. Behind a first stage the results are at the cranks' angle, and the first
        stage is rigid.
    torque
        Torques of the environment on the output, N·m, shape (torques,) or (torques, angles).
    crank_angle
        rad, shape (angles,).
    direction, crank_speed
        Of the crank: 1 counter-clockwise or -1; rad/s, not below 0, where 0 is the start with friction at rest.
    slices
        Slices across the face width; None for as many as the errors need.
    near
        `coordinates` of a solution at nearly the same torques, to start from.
    workers, progress
        Threads; function called with the number of crank angles (times loads) that were just finished.

    Raises
    ------
    edge.InputError
        As `losses_of` and `laws_of`, and if a torque can't be carried even without friction. A drive that jams is a
        result: NaN.
    """
    pair, rubbing = drive.pair, rubbing_of(drive, direction, crank_speed)
    angles, at_angles = np.array(crank_angle, dtype=float), along_sweep(np.asarray(torque, dtype=float), crank_angle)
    slices = slices or drive.slices
    solutions = empty(pair, len(at_angles), angles.size)
    loss = np.zeros((*solutions.steps.shape, len(PARTS)))
    if near is not None:
        solutions.coordinates[:] = near
    assembly, mesh = assembly_of(drive), problem_of(drive, slices)

    def part(start: int, last: int) -> None:
        problem = with_own_discs(mesh)
        for k, torques in enumerate(at_angles):
            part_of_sweep, unknowns = of_part(solutions, np.s_[k, start:last]), solutions.coordinates.shape[-1]
            sweep_rubbing(
                problem,
                assembly,
                angles[start:last],
                torques[start:last],
                rubbing,
                part_of_sweep,
                loss[k, start:last],
                work_of(assembly),
                slope_of(unknowns),
                near is not None,
            )

    solve_in_parts(part, angles.size, PART, workers, lambda size: progress(size * len(at_angles)))
    jammed = solutions.steps == 0
    if jammed.any():
        # Only a torque that the drive carries without friction can jam it.
        load, angle = np.argwhere(jammed)[0]
        stage.solve(drive.stage, at_angles[load, angle : angle + 1], angles[angle : angle + 1], Options(slices, False))
    for values in (
        *solutions[1:4],
        solutions.max_contact_pressure,
        solutions.pin_force,
        solutions.pin_pressure,
        solutions.force,
        loss,
    ):
        values[jammed] = np.nan
    rate = sun_rate(drive)
    drag = losses_of(drive).input_drag.torque(rate * crank_speed, losses_of(drive).thinning)
    loss[..., DRAG_INPUT] = np.where(jammed, np.nan, drag * abs(rate))
    of_input = solutions.crank_torque
    if drive.first_stage is not None:
        factor = np.where(direction * of_input > 0.0, 1.0 / (1.0 - rubbing.loss), 1.0 - rubbing.loss)
        of_input = -of_input * drive.first_stage.sun_share * factor
    of_input = of_input + math.copysign(drag, rate) * direction
    motion = results(pair, np.asarray(torque, dtype=float), angles, at_angles, solutions)
    return Rubbed(direction, crank_speed, motion, solutions.coordinates, loss, of_input, rate)
