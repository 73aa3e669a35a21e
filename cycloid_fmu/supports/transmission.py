"""A drive on its bearings over crank angles: motion of the bodies, loads of all bearings, and a labelled dataset."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact import ContactLines, Problem, transmission
from cycloid_fmu.contact.parts import Stopped, solve_in_parts
from cycloid_fmu.contact.transmission import Interrupted, Options, Sensitivity, Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports import bearing
from cycloid_fmu.supports.assembly import (
    add_by_displacements,
    as_drawn,
    by_kind,
    elastic_of,
    is_elastic,
    joint_list,
    kinds_of,
)
from cycloid_fmu.supports.joints import Assembly, work_of
from cycloid_fmu.supports.sensitivity import PARAMETERS, Derivatives, sweep_supported_sensitivities
from cycloid_fmu.supports.sweeps import Solutions, sweep_interference, sweep_supported
from cycloid_fmu.surfaces.structured import displacement_size

Array = NDArray[np.float64]
PLAY_LOAD = 1e-3  # of the rated torque: the play is that between the tangents at this torque in both directions
_CENTRED = 1e-4 * bearing.CENTRING  # N: at most what the centring springs press without a torque
LAW_NAMES = ("turning_arm", "crank_shaft", "main", "output_roller")
_PART = 64  # crank angles that one thread solves at a time


def assembly_of(drive: DriveValue) -> Assembly:
    """Return the joints of a drive as the list for the kernels, at its temperatures."""
    grown = drive.pair.at_temperature
    return joint_list(grown, kinds_of(grown), drive.displacements, elastic_of(as_drawn(drive.pair)))


def problem_of(drive: DriveValue, slices: int = 1) -> Problem:
    """Return the mesh of a pair with supports: bearings position the discs, and pins are compliant in their seats."""
    mesh, pair = transmission.mesh_of(drive, slices), drive.pair.at_temperature
    if slices > 1 and is_elastic(pair):
        raise edge.InputError(
            f"{slices} slices across the face width: elastic bodies are loaded alike over the width; give one slice, "
            "or remove [bodies] and half-shell seats for a drive whose flanks or pins vary along it."
        )
    supports = pair.supports
    assert supports is not None
    seat = supports.pin_seat
    compliance = 0.0 if seat.stiffness_per_width is None else 1.0 / (seat.stiffness_per_width * mesh.slice_width)
    centre = np.zeros(slices)
    return mesh._replace(
        eccentricity=pair.eccentricity,
        centre_x=centre,
        centre_y=centre.copy(),
        seat_gap=0.5 * seat.clearance,
        seat_compliance=compliance,
    )


@dataclass(frozen=True)
class OnBearings(Transmission):
    """Results of a crank sweep of a drive on its bearings, SI: `Transmission` with the motion of the bodies.

    The play is extrapolated to zero torque by the tangents at ± `PLAY_LOAD` of the rated torque. The interference is
    how far flanks and pins overlap that no rotation of the output frees, with the discs where they stand without a
    torque: bearings give way, so it differs from that on rigid bearings.

    Attributes
    ----------
    disc_shift_x, disc_shift_y
        Shift of each disc's centre from its ideal position, shape (torques, angles, discs), m.
    disc_turn
        Rotation of each disc relative to the output's transmission error, shape (torques, angles, discs), rad.
    turning_arm_force
        Force of each turning arm, shape (torques, angles, discs, cranks), N; one crank with output rollers.
    crank_bearing_force
        Force of each crank's bearings in carrier or housing, shape (torques, angles, cranks), N.
    main_bearing_force
        Force of the main bearing, shape (torques, angles), N.
    output_roller_force
        Force of each output roller, shape (torques, angles, discs, rollers), N; no rollers with cranks.
    compliance
        Shares of `PARTS` in the compliance dx/dT, shape (torques, angles, parts), rad/(N·m); none if all bodies are
        rigid.
    """

    disc_shift_x: Array
    disc_shift_y: Array
    disc_turn: Array
    turning_arm_force: Array
    crank_bearing_force: Array
    main_bearing_force: Array
    output_roller_force: Array
    compliance: Array


BODIES = ("disc", "pin", "ring", "crank", "output_pin", "carrier")
PARTS = ("mesh", *LAW_NAMES, *BODIES)
"""Parts of the compliance of a drive with elastic bodies: laws of contacts and bearings, then bodies."""


def empty(pair: Pair, loads: int, angles: int) -> Solutions:
    """Return zeros for the results of a sweep."""
    supports = pair.supports
    assert supports is not None
    discs, cranks = pair.discs, supports.cranks
    grid = (loads, angles)
    pins = (*grid, discs, pair.pins)
    return Solutions(
        steps=np.zeros(grid, dtype=np.int64),
        coordinates=np.zeros((*grid, 3 + 3 * discs + 2 * cranks)),
        stiffness=np.zeros(grid),
        crank_torque=np.zeros(grid),
        contact_count=np.zeros(grid, dtype=np.int64),
        max_contact_pressure=np.zeros(grid),
        pin_force=np.zeros(pins),
        pin_pressure=np.zeros(pins),
        force=np.zeros((*grid, sum(kind.size for kind in kinds_of(pair)))),
        compliance=np.zeros((*grid, len(PARTS) if is_elastic(pair) else 0)),
    )


def of_part(solutions: Solutions, part: Any) -> Solutions:
    """Return the results at some indices, as views."""
    return Solutions(*(array[part] for array in cast(tuple[Any, ...], solutions)))


def solve(drive: DriveValue, torque: Array, crank_angle: Array, options: Options) -> Transmission:
    """Solve a drive on rigid or stated bearings; see `cycloid_fmu.analysis.solve`.

    Returns
    -------
    Transmission
        For a pair with supports an `OnBearings`.
    """
    if drive.pair.supports is None:
        return transmission.solve(drive, torque, crank_angle, options)
    pair, torques, angles = drive.pair, np.array(torque, dtype=float), np.array(crank_angle, dtype=float)
    at_angles = transmission.along_sweep(torques, angles)
    play = [0.0, *play_loads(pair)] if options.with_play or 0.0 in at_angles else []
    at_angles = np.concatenate([transmission.along_sweep(np.array(play), angles), at_angles])

    lines = transmission.no_lines(len(torques))
    if options.with_elements:
        grid = (len(torques), angles.size, pair.discs, pair.pins)
        lines = transmission.empty_lines(drive, options.slices, grid)
    solutions = empty(pair, len(at_angles), angles.size)

    def result(done: slice) -> OnBearings:
        finished = lines._replace(
            slice_force=lines.slice_force[:, done], slice_direction=lines.slice_direction[:, done]
        )
        of_angles = of_part(solutions, np.s_[:, done])
        _clear_centred(of_angles, at_angles[:, done])
        interference = np.full(of_angles.steps.shape[1], np.nan)
        if play:
            interference = _interference(problem_of(drive, options.slices), angles[done], of_angles)
        return results(pair, torques, angles[done], at_angles[:, done], of_angles, len(play), finished, interference)

    try:
        _solve(drive, at_angles, angles, solutions, options, len(play), lines)
    except Stopped as stopped:
        raise Interrupted(result(slice(0, stopped.finished))) from None
    return result(slice(None))


def _solve(
    drive: DriveValue,
    torques: Array,
    angles: Array,
    solutions: Solutions,
    options: Options,
    first: int = 0,
    lines: ContactLines | None = None,
    near: Array | None = None,
) -> None:
    """Find solutions at every torque, shape (torques, angles); contact lines of the torques from `first` on.

    `near` are the coordinates of solutions of nearly the same drive, shape (torques, angles, unknowns).
    """
    merging, none = threading.Lock(), transmission.no_lines(1)
    assembly = assembly_of(drive)
    mesh = problem_of(drive, options.slices)
    if near is not None:
        solutions.coordinates[:] = near

    def part(start: int, last: int) -> None:
        problem = with_own_discs(mesh)
        for k, torque in enumerate(torques):
            part_of_sweep = of_part(solutions, np.s_[k, start:last])
            work = work_of(assembly)
            part_lines = none if lines is None or k < first else _lines_of(lines, k - first, slice(start, last))
            of_sweep = angles[start:last], torque[start:last], part_of_sweep
            sweep_supported(problem, assembly, *of_sweep, work, part_lines, near is not None)
            if lines is not None and k >= first:
                with merging:
                    gear, pin = lines.gear_pressure[k - first], lines.pin_pressure[k - first]
                    np.maximum(gear, part_lines.gear_pressure[0], out=gear)
                    np.maximum(pin, part_lines.pin_pressure[0], out=pin)

    solve_in_parts(
        part, angles.size, _PART, options.workers, lambda size: options.progress(size * (len(torques) - first))
    )
    for k, torque in enumerate(torques):
        if not solutions.steps[k].all():
            unsolved = int(np.argmin(solutions.steps[k]))
            raise unbalanced(torque[unsolved], angles[unsolved])


def with_own_discs(mesh: Problem) -> Problem:
    """Return the mesh with places of the discs that one thread overwrites."""
    shift_x, shift_y, turn = np.zeros((3, mesh.shift_x.size))
    return mesh._replace(shift_x=shift_x, shift_y=shift_y, turn=turn)


def _lines_of(lines: ContactLines, load: int, angles: slice) -> ContactLines:
    """Return the lines of one torque at some angles, with separate pressures for each thread."""
    torque = np.s_[load : load + 1]
    return lines._replace(
        slice_force=lines.slice_force[torque, angles],
        slice_direction=lines.slice_direction[torque, angles],
        gear_pressure=np.zeros_like(lines.gear_pressure[torque]),
        pin_pressure=np.zeros_like(lines.pin_pressure[torque]),
    )


def unbalanced(torque: float, crank_angle: float) -> edge.InputError:
    """Return the error of a drive that has no balance at a torque (N·m) and crank angle (rad)."""
    return transmission.UnbalancedError(
        f"torque = {torque:g} N*m: the drive can't balance it at a crank angle of {crank_angle:.6g} rad; give a "
        "smaller one."
    )


def play_loads(pair: Pair) -> list[float]:
    """Return the torques whose tangents give the ends of the play, N·m; without a rated torque an `edge.InputError`."""
    if pair.rated_torque is None:
        raise edge.InputError(
            f"rated_torque is missing; with [supports] the play is computed from {PLAY_LOAD:g} of it."
        )
    return [-PLAY_LOAD * pair.rated_torque, PLAY_LOAD * pair.rated_torque]


def _clear_centred(solutions: Solutions, torques: Array) -> None:
    """Set to zero what only the centring springs press where there is no torque, shape (torques, angles)."""
    free = (torques == 0.0) & (solutions.pin_force.max(axis=(-1, -2)) <= _CENTRED)
    for pressed in (
        solutions.pin_force,
        solutions.pin_pressure,
        solutions.contact_count,
        solutions.max_contact_pressure,
    ):
        pressed[free] = 0


def _interference(mesh: Problem, angles: Array, solutions: Solutions) -> Array:
    """Return the interference, shape (angles,), m, of a sweep whose first torque is 0."""
    interference = np.zeros(angles.size)
    sweep_interference(
        with_own_discs(mesh),
        angles,
        np.ascontiguousarray(solutions.coordinates[0]),
        solutions.pin_force[0].max(axis=(-1, -2)),
        interference,
    )
    return interference


def results(
    pair: Pair,
    torques: Array,
    angles: Array,
    at_angles: Array,
    solutions: Solutions,
    first: int = 0,
    lines: ContactLines | None = None,
    interference: Array | None = None,
) -> OnBearings:
    """Return the results of a sweep as a dataclass.

    Parameters
    ----------
    torques, angles, at_angles
        As for `solve`, and the torques at each angle, shape (torques, angles).
    solutions
        Solutions at `at_angles`.
    first
        3 if no torque and the play's two torques precede the others, otherwise 0: without a play.
    lines, interference
        Contact lines, and the interference at each angle, shape (angles,).
    """
    lines = transmission.no_lines(len(torques)) if lines is None else lines
    interference = np.full(angles.size, np.nan) if interference is None else interference
    transmission_error, stiffness = solutions.coordinates[..., 0], solutions.stiffness
    low = high = np.full(angles.size, np.nan)
    preload = count = None
    if first:
        # The ends of the play are where the tangents at a small torque in either direction reach zero torque. Without
        # clearance but with errors every position stores energy, yet the output still moves freely.
        ends = transmission_error[1:3] - at_angles[1:3] / stiffness[1:3]
        middle = ends.mean(axis=0)
        low, high = np.minimum(ends[0], middle), np.maximum(ends[1], middle)
        transmission_error = np.where(at_angles == 0.0, middle, transmission_error)
        stiffness = np.where((at_angles == 0.0) & (interference == 0.0), 0.0, stiffness)
        preload, count = solutions.pin_force[0].max(axis=(-1, -2)), solutions.contact_count[0].copy()
    loaded = of_part(solutions, np.s_[first:])
    discs, force = pair.discs, {kind.name: force for kind, force in by_kind(kinds_of(pair), loaded.force)}
    return OnBearings(
        torques,
        angles,
        transmission_error[first:],
        stiffness[first:],
        loaded.contact_count,
        loaded.max_contact_pressure,
        loaded.pin_force,
        loaded.pin_pressure,
        low,
        high,
        interference,
        *lines[:4],
        preload=preload,
        preload_count=count,
        disc_shift_x=loaded.coordinates[..., 3 : 3 + 3 * discs : 3],
        disc_shift_y=loaded.coordinates[..., 4 : 3 + 3 * discs : 3],
        disc_turn=loaded.coordinates[..., 5 : 3 + 3 * discs : 3] - loaded.coordinates[..., :1],
        turning_arm_force=force["turning_arm"],
        crank_bearing_force=force["crank_shaft"],
        main_bearing_force=force["main"],
        output_roller_force=force["output_roller"],
        compliance=loaded.compliance,
        crank_torque=loaded.crank_torque,
    )


LAWS = tuple(f"{law}_{what}" for law in LAW_NAMES for what in ("stiffness", "clearance"))
"""Columns of the sensitivity to bearings: to the logarithm of a stiffness (rad), to a clearance (rad/m)."""


def parameters_of(pair: Pair) -> tuple[str, ...]:
    """Return what the columns of `Sensitivity.by_bearing` are by: `LAWS`, and each body's stiffness as a logarithm."""
    if pair.supports is None:
        return ()
    stated = () if pair.bodies is None else pair.bodies.stated()
    return (*LAWS, *(f"{name}_stiffness" for name, _ in stated))


def no_derivatives(pair: Pair, assembly: Assembly, angles: int) -> Derivatives:
    """Return zeros for the derivatives at a number of crank angles."""
    return Derivatives(
        by_displacement=np.zeros((angles, displacement_size(pair))),
        by_joint=np.zeros((angles, assembly.joints.size, len(PARAMETERS))),
        by_angle=np.zeros(angles),
        by_torque=np.zeros(angles),
        by_body=np.zeros((angles, len(BODIES))),
    )


def sensitivity_of(pair: Pair, coordinates: Array, by: Derivatives) -> Sensitivity:
    """Return the sensitivity by displacements and by `parameters_of` from solutions and the kernel's derivatives."""
    laws = add_by_displacements(pair, by.by_joint, by.by_displacement)
    stated = [] if pair.bodies is None else [BODIES.index(name) for name, _ in pair.bodies.stated()]
    by_bearing = np.hstack([laws, by.by_body[:, stated]])
    return Sensitivity(coordinates[:, 0].copy(), by.by_displacement, by.by_angle, by.by_torque, by_bearing, coordinates)


def sensitivity(
    drive: DriveValue, torque: Array, crank_angle: Array, slices: int, near: Array | None = None
) -> Sensitivity:
    """Return transmission error and derivatives of a drive on rigid or stated bearings.

    See `cycloid_fmu.analysis.sensitivity`; `torque` has shape (angles,).
    """
    if drive.pair.supports is None:
        return transmission.sensitivity(drive, torque, crank_angle, slices)
    pair, angles, at_angles = drive.pair, np.array(crank_angle, dtype=float), np.array(torque, dtype=float)
    solutions = empty(pair, 1, angles.size)
    _solve(drive, at_angles[None], angles, solutions, Options(slices), near=near)
    assembly = assembly_of(drive)
    derivatives = no_derivatives(pair, assembly, angles.size)
    if not sweep_supported_sensitivities(
        problem_of(drive, slices),
        assembly,
        angles,
        at_angles,
        solutions.coordinates[0],
        derivatives,
        work_of(assembly),
    ):
        raise unbalanced(float(at_angles[0]), angles[0])
    return sensitivity_of(pair, solutions.coordinates[0], derivatives)
