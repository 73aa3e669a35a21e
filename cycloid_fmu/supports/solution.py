"""The balance of a drive on its bearings over crank angles: what its bodies do, what every bearing carries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact import Problem, transmission
from cycloid_fmu.contact.parts import Stopped, solve_in_parts
from cycloid_fmu.contact.transmission import Interrupted, Transmission
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.supports import Bearing
from cycloid_fmu.supports import bearing
from cycloid_fmu.supports.assembly import Assembly
from cycloid_fmu.supports.balance import work_of
from cycloid_fmu.supports.sensitivity import sweep_supported_sensitivities
from cycloid_fmu.supports.sweeps import Found, sweep_supported
from cycloid_fmu.surfaces.structured import displacement_layout, displacements
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
PLAY_LOAD = 1e-3  # of the rated torque: what leaves the play between its two directions
_PART = 64  # crank angles that one thread solves at a time

LAWS = tuple(
    f"{bearing_}_{what}"
    for bearing_ in ("turning_arm", "crank_shaft", "main", "output_roller")
    for what in ("stiffness", "clearance")
)
"""Columns of a sensitivity by bearings: by the logarithm of a stiffness (rad), by a clearance (rad/m)."""


def _law(stated: Bearing) -> bearing.Bearing:
    if stated.rollers is not None and stated.roller_length is not None:
        return bearing.rollers(stated.rollers, stated.roller_length, stated.clearance)
    return bearing.linear(bearing.RIGID if stated.stiffness is None else stated.stiffness, stated.clearance)


def assembly_of(pair: Pair, surface: ErrorSurface) -> Assembly:
    """Return what holds the discs of a pair with supports, as numbers and arrays."""
    supports = pair.supports
    assert supports is not None
    made = displacements(pair, surface, {})
    angle = supports.first_angle + 2.0 * np.pi * np.arange(supports.count) / supports.count
    roller = supports.output_roller
    play = np.zeros((pair.discs, supports.count)) if roller is None else made["hole_play"] + 0.5 * roller.clearance
    stiffness = 0.0 if supports.kind == "cranks" else bearing.RIGID
    if roller is not None and roller.stiffness is not None:
        stiffness = roller.stiffness
    arm, shaft, main = (_law(getattr(supports, name)) for name in ("turning_arm", "crank_shaft", "main"))
    rigid = bearing.RIGID in (arm.stiffness, shaft.stiffness, main.stiffness, stiffness)
    mesh = pair.face_width / (pair.material.gear.compliance + pair.material.pin.compliance)
    return Assembly(
        cranks=supports.kind == "cranks",
        eccentricity=pair.eccentricity,
        place_x=supports.circle_radius * np.cos(angle),
        place_y=supports.circle_radius * np.sin(angle),
        crank_x=made["carrier_x"],
        crank_y=made["carrier_y"],
        hole_x=made["hole_x"],
        hole_y=made["hole_y"],
        hole_play=play,
        throw=made["eccentric_throw"] + made["crank_throw"],
        phase=made["eccentric_phase"],
        seat_x=float(made["centre_x"]),
        seat_y=float(made["centre_y"]),
        turning_arm=arm,
        crank_shaft=shaft,
        main=main,
        output_roller=stiffness,
        rotation_scale=pair.pin_circle_radius,
        # The last digits of a rotation move a crank by 1e-19 m, those of a gap are 1e-17 m.
        balanced=max(1e-3 if rigid else 1e-7, 1e-17 * mesh),
    )


def problem_of(pair: Pair, surface: ErrorSurface, slices: int = 1) -> Problem:
    """Return the mesh of a pair with supports: discs stand where bearings let them, pins give in their seats."""
    supports = pair.supports
    assert supports is not None
    mesh = transmission.mesh_of(pair, surface, slices)
    seat = supports.pin_seat
    compliance = 0.0 if seat.stiffness_per_width is None else 1.0 / (seat.stiffness_per_width * mesh.slice_width)
    none = np.zeros(slices)
    return mesh._replace(
        eccentricity=pair.eccentricity, centre_x=none, centre_y=none.copy(), seat_gap=0.5 * seat.clearance,
        seat_compliance=compliance,
    )  # fmt: skip


@dataclass(frozen=True)
class OnBearings(Transmission):
    """Results of a crank sweep of a drive on its bearings, SI: those of `Transmission`, and what the bodies do.

    The play is what `PLAY_LOAD` of the rated torque leaves, either way, at no torque; there is no interference.

    Attributes
    ----------
    disc_shift_x, disc_shift_y
        Shape (torques, angles, discs): shift of each disc's centre from its ideal place, m.
    turning_arm_force
        Shape (torques, angles, discs, cranks), N; one crank with output rollers.
    crank_bearing_force
        Shape (torques, angles, cranks), N.
    main_bearing_force, crank_torque
        Shape (torques, angles): N, N·m.
    output_roller_force
        Shape (torques, angles, discs, rollers), N; none with cranks.
    """

    disc_shift_x: Array
    disc_shift_y: Array
    turning_arm_force: Array
    crank_bearing_force: Array
    main_bearing_force: Array
    output_roller_force: Array
    crank_torque: Array


def _empty(pair: Pair, loads: int, angles: int) -> Found:
    supports = pair.supports
    assert supports is not None
    discs, cranks, rollers = pair.discs, supports.cranks, supports.count if supports.kind == "output_rollers" else 0
    grid = (loads, angles)
    pins = (*grid, discs, pair.pins)
    return Found(
        steps=np.zeros(grid, dtype=np.int64),
        place=np.zeros((*grid, 3 + 3 * discs + 2 * cranks)),
        stiffness=np.zeros(grid),
        crank_torque=np.zeros(grid),
        contact_count=np.zeros(grid, dtype=np.int64),
        max_contact_pressure=np.zeros(grid),
        pin_force=np.zeros(pins),
        pin_pressure=np.zeros(pins),
        turning_arm=np.zeros((*grid, discs, cranks)),
        crank_bearing=np.zeros((*grid, cranks)),
        main_bearing=np.zeros(grid),
        output_roller=np.zeros((*grid, discs, rollers)),
    )


def _of(found: Found, part: Any) -> Found:
    return Found(*(array[part] for array in cast(tuple[Any, ...], found)))


def solve(
    pair: Pair,
    surface: ErrorSurface,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int,
    *,
    with_play: bool,
    workers: int,
    progress: Callable[[int], None],
) -> OnBearings:
    """Solve a drive with supports; parameters and errors are those of `supports.transmission.solve`."""
    torques, angles = np.array(torque, dtype=float, ndmin=1), np.array(crank_angle, dtype=float, ndmin=1)
    if not (np.isfinite(torques).all() and np.isfinite(angles).all()):
        raise ValueError("torque and crank_angle must be finite")
    loads = np.concatenate([_play_loads(pair) if with_play or 0.0 in torques else [], torques])
    first = loads.size - torques.size

    found = _empty(pair, loads.size, angles.size)

    def result(done: slice) -> OnBearings:
        return _result(pair, torques, angles[done], loads, _of(found, np.s_[:, done]))

    try:
        _solve(pair, surface, loads, angles, slices, found, first, workers, lambda size: progress(size * torques.size))
    except Stopped as stopped:
        raise Interrupted(result(slice(0, stopped.finished))) from None
    return result(slice(None))


def _solve(
    pair: Pair, surface: ErrorSurface, loads: Sequence[float] | Array, angles: Array, slices: int, found: Found,
    first: int = 0, workers: int = 1, progress: Callable[[int], None] = lambda angles: None,
) -> None:  # fmt: skip
    """Find places at every load but 0 and crank angle, and from the load `first` on forces; told parts of angles."""
    assembly = assembly_of(pair, surface)
    mesh = problem_of(pair, surface, slices)

    def part(start: int, last: int) -> None:
        # Each thread moves discs of its own.
        shift_x, shift_y, turn = (np.zeros(pair.discs) for _ in range(3))
        problem = mesh._replace(shift_x=shift_x, shift_y=shift_y, turn=turn)
        for k, load in enumerate(loads):
            if load != 0.0:
                here = _of(found, np.s_[k, start:last])
                work = work_of(here.place.shape[-1], pair.discs)
                sweep_supported(problem, assembly, angles[start:last], float(load), k >= first, here, work)

    solve_in_parts(part, angles.size, _PART, workers, progress)
    for k, load in enumerate(loads):
        if load != 0.0 and not found.steps[k].all():
            raise _unbalanced(load, angles[np.argmin(found.steps[k])])


def _unbalanced(torque: float, crank_angle: float) -> edge.InputError:
    return edge.InputError(
        f"torque = {torque:g} N*m: nothing balances it at a crank angle of {crank_angle:.6g} rad; give one that the "
        "drive can carry."
    )


def _play_loads(pair: Pair) -> list[float]:
    if pair.rated_torque is None:
        raise edge.InputError(
            f"rated_torque is missing; with [supports] the play is what {PLAY_LOAD:g} of it leaves at no torque."
        )
    return [-PLAY_LOAD * pair.rated_torque, PLAY_LOAD * pair.rated_torque]


def _result(pair: Pair, torques: Array, angles: Array, loads: Array, found: Found) -> OnBearings:
    """Return what was found at `loads`, the play's two before the torques."""
    deviation, first = found.place[..., 0], loads.size - torques.size
    low = high = np.full(angles.size, np.nan)
    if first:
        # Where the tangents at a small torque either way meet no torque: without clearance but with errors no place is
        # without energy, yet the output swings.
        ends = deviation[:2] - loads[:2, None] / found.stiffness[:2]
        middle = ends.mean(axis=0)
        low, high = np.minimum(ends[0], middle), np.maximum(ends[1], middle)
        deviation = np.where(loads[:, None] == 0.0, middle, deviation)
    kept = _of(found, np.s_[first:])
    discs = pair.discs
    return OnBearings(
        torques, angles, deviation[first:], kept.stiffness, kept.contact_count, kept.max_contact_pressure,
        kept.pin_force, kept.pin_pressure, low, high, np.zeros(angles.size),
        *transmission.no_lines(torques.size)[:4],
        disc_shift_x=kept.place[..., 3 : 3 + 3 * discs : 3],
        disc_shift_y=kept.place[..., 4 : 3 + 3 * discs : 3],
        turning_arm_force=kept.turning_arm,
        crank_bearing_force=kept.crank_bearing,
        main_bearing_force=kept.main_bearing,
        output_roller_force=kept.output_roller,
        crank_torque=kept.crank_torque,
    )  # fmt: skip


@dataclass(frozen=True)
class Sensitivity:
    """Transmission error of a drive on its bearings, with its derivatives.

    Attributes
    ----------
    transmission_error
        Shape (angles,), rad.
    by_displacement
        By everything that errors displace, `structured.displacement_layout`, shape (angles, displacements), rad/m.
    by_bearing
        By `LAWS`, shape (angles, 8).
    by_crank_angle, by_torque
        Shape (angles,): 1 and rad/(N·m).
    """

    transmission_error: Array
    by_displacement: Array
    by_bearing: Array
    by_crank_angle: Array
    by_torque: Array


def sensitivity(
    pair: Pair, surface: ErrorSurface, torque: float, crank_angle: ArrayLike, slices: int = 1
) -> Sensitivity:
    """Return the transmission error of a drive on its bearings at one torque, differentiated.

    Raises
    ------
    edge.InputError
        If a torque can't be carried.
    """
    angles = np.array(crank_angle, dtype=float, ndmin=1)
    found = _empty(pair, 1, angles.size)
    _solve(pair, surface, [torque], angles, slices, found)
    size = max(place.stop for place in displacement_layout(pair).values())
    each, laws = np.zeros((angles.size, size)), np.zeros((angles.size, len(LAWS)))
    by_angle, by_torque = (np.zeros(angles.size) for _ in range(2))
    if not sweep_supported_sensitivities(
        problem_of(pair, surface, slices), assembly_of(pair, surface), angles, torque, found.place[0], each, laws,
        by_angle, by_torque, work_of(found.place.shape[-1], pair.discs),
    ):  # fmt: skip
        raise _unbalanced(torque, angles[0])
    return Sensitivity(found.place[0, :, 0].copy(), each, laws, by_angle, by_torque)
