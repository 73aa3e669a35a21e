"""Transmission error, backlash, torsional stiffness, load sharing and contact pressure over a crank sweep."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact, edge
from cycloid_fmu.contact.parts import Stopped, solve_in_parts
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_normals, flank_points
from cycloid_fmu.surfaces.structured import (
    PROFILE_POINTS,
    dimensions_of,
    displacement_size,
    displacements_of,
    profile_wave,
)

Array = NDArray[np.float64]
FORMAT = "cycloid-analysis/1"
PROFILE_ELEMENTS = 800  # of a tooth, as in the error-surface paper, where a surface does not say
ANGLE_ELEMENTS = 400  # of half a pin
UNBALANCED = 0.2  # of the torque: where a worn flank's curvature jumps, so do forces, and 5 % were seen to stay
PART = 360  # crank angles that are solved in a row, each from its neighbour


@dataclass(frozen=True)
class Transmission:
    """Results of a crank sweep, SI.

    Attributes
    ----------
    torque, crank_angle
        Shapes (torques,), or (torques, angles) as given, and (angles,): N·m on the output, rad.
    transmission_error, torsional_stiffness, contact_count, max_contact_pressure
        Shape (torques, angles): rad at the output, N·m/rad, pins, Pa.
    pin_force, pin_pressure
        Shape (torques, angles, discs, pins): N, Pa.
    play_low, play_high, backlash, interference
        Shape (angles,): transmission errors between which the output is free (rad), their difference (rad; NaN without
        a free position), and by how much there is none (m).
    slice_force, slice_direction
        Shape (torques, angles, discs, pins, slices), or size 0: the instantaneous contact lines as force in each slice
        (N) and direction of the contact about the pin's axis from that to the pin circle's centre (rad).
    gear_element_pressure, pin_element_pressure
        Shapes (torques, discs, teeth, profile, slices) and (torques, pins, angle, slices), or size 0: the largest
        pressure that each element has seen, Pa.
    crank_torque
        Torque of the environment on the crank, shape (torques, angles), N·m; None where it was not asked for.
    preload, preload_count
        Largest pin force without a torque (N), and number of pins that carry more than 1 % of it, shape (angles,); None
        on rigid bearings, or where the play was not asked for.
    """

    torque: Array
    crank_angle: Array
    transmission_error: Array
    torsional_stiffness: Array
    contact_count: NDArray[np.int64]
    max_contact_pressure: Array
    pin_force: Array
    pin_pressure: Array
    play_low: Array
    play_high: Array
    interference: Array
    slice_force: NDArray[np.float32]
    slice_direction: NDArray[np.float32]
    gear_element_pressure: Array
    pin_element_pressure: Array
    crank_torque: Array | None = field(default=None, kw_only=True)
    preload: Array | None = field(default=None, kw_only=True)
    preload_count: NDArray[np.int64] | None = field(default=None, kw_only=True)

    @property
    def backlash(self) -> Array:
        """Free rotation of the output with the crank locked, shape (angles,), rad; NaN without a free position."""
        return self.play_high - self.play_low


class UnbalancedError(edge.InputError):
    """A torque that no contacts of a pair can balance."""


def rigid_problem(drive: DriveValue, slices: int = 1) -> contact.Problem:
    """Return the contact problem of a drive on rigid bearings.

    Parameters
    ----------
    drive
        The drive.
    slices
        Slices across the face width, each independent and taken at its middle; 1 where nothing varies across it.

    Raises
    ------
    edge.InputError
        If the pair has supports: a drive on bearings is more than its contacts.
    """
    pair = drive.pair
    if pair.supports is not None:
        raise edge.InputError(
            "the pair has [supports], which this does not take into account yet; analyze does. Remove the table for a "
            "drive on rigid bearings."
        )
    return mesh_of(drive, slices)


def mesh_of(drive: DriveValue, slices: int = 1) -> contact.Problem:
    """Return the contact problem of gear and pins alone, whatever holds them, at the pair's temperatures.

    Parameters are those of `rigid_problem`.
    """
    pair, surface = drive.pair, drive.surface
    warm, z = pair.at_temperature, _heights(pair, slices)
    dimensions, stray = _dimensions_of(pair, drive.displacements)
    # Form is added here, because not every drive has it.
    stray += sum(float(np.abs(d).max()) for d in (surface.gear_deviation, surface.pin_deviation) if d is not None)
    return contact.Problem(
        **_error_fields(pair, dimensions, stray, z),
        generating_eccentricity=warm.eccentricity,
        teeth=pair.gear_teeth,
        ring=pair.output == "ring",
        crank_phase=2.0 * np.pi * np.arange(pair.discs) / pair.discs,
        shift_x=np.zeros(pair.discs),
        shift_y=np.zeros(pair.discs),
        turn=np.zeros(pair.discs),
        slice_z=z,
        slice_width=pair.face_width / slices,
        compliance_gear=pair.material.gear.compliance,
        compliance_pin=pair.material.pin.compliance,
        largest_log_radius=warm.pin_circle_radius if pair.contact_law == "capped" else math.inf,
        seat_gap=0.0,
        seat_compliance=0.0,
        deviations=_deviations(drive, z),
    )


def meshes_of(pair: Pair, vectors: Array, slices: int = 1) -> contact.Drives:
    """Return what differs between the contact problems of many drives without deviations of form.

    Parameters
    ----------
    pair, slices
        As in `mesh_of`.
    vectors
        The drives' errors, rows of `displacement_vector`.

    Raises
    ------
    edge.InputError
        If a drive is impossible.
    """
    dimensions, stray = _dimensions_of(pair, displacements_of(pair, vectors), 1)
    return contact.Drives(**_error_fields(pair, dimensions, stray, _heights(pair, slices)))


def _dimensions_of(pair: Pair, displaced: Mapping[str, Any], leading: int = 0) -> tuple[dict[str, Any], Any]:
    """Dimensions and `_stray` of a drive, or of many in a leading axis, from the displacements by its errors."""
    modified = {name: value + displaced[name] for name, value in _modification(pair).items()}
    return dimensions_of(pair, displaced), _stray(pair, {**displaced, **modified}, leading)


def _heights(pair: Pair, slices: int) -> Array:
    return np.asarray(pair.face_width * ((np.arange(slices) + 0.5) / slices - 0.5))


def _modification(pair: Pair) -> dict[str, float]:
    return {
        "generating_pin_radius": pair.modification.isometric,
        "generating_circle_radius": pair.modification.offset,
    }


def _error_fields(pair: Pair, dimensions: Mapping[str, Any], stray: Any, z: Array) -> dict[str, Any]:
    """Fields of the contact problem of a drive, or of many in a leading axis, that its errors change."""
    warm = pair.at_temperature
    angle = 2.0 * np.pi * np.arange(pair.pins) / pair.pins + dimensions["pin_tangential"] / warm.pin_circle_radius
    circle = np.asarray(dimensions["generating_circle_radius"])
    spread = np.ptp(dimensions["tooth_turn"], axis=-1).max(axis=-1)
    numbers = {
        "circle_radius": circle,
        "generating_radius": np.asarray(dimensions["generating_pin_radius"]),
        "eccentricity": np.asarray(dimensions["crank_throw"]),
        "stray": np.asarray(stray),
        "root_phase": _root_phase(warm, np.asarray(stray), circle),
        "root_margin": 1e-6 + 1.5 * warm.pin_circle_radius * spread,
    }
    if circle.ndim == 0:
        numbers = {name: float(value) for name, value in numbers.items()}
    centre_x, centre_y, tilt_x, tilt_y = (
        np.asarray(dimensions[name])[..., None] for name in ("centre_x", "centre_y", "tilt_x", "tilt_y")
    )
    return numbers | {
        "pin_x": dimensions["pin_radial"] * np.cos(angle),
        "pin_y": dimensions["pin_radial"] * np.sin(angle),
        "pin_radius": dimensions["pin_radius"],
        "tooth_turn": np.ascontiguousarray(dimensions["tooth_turn"]),
        "centre_x": centre_x + tilt_x * z,
        "centre_y": centre_y + tilt_y * z,
    }


def _deviations(drive: DriveValue, z: Array) -> contact.Deviations | None:
    """Deviations of flanks and pins at the slices' middles; None where all is nominal."""
    pair, surface = drive.pair, drive.surface
    gear, pin = surface.gear_deviation, surface.pin_deviation
    g = pair
    if gear is None and pin is None:
        return None
    if gear is None:
        gear = np.zeros((g.discs, g.gear_teeth, PROFILE_ELEMENTS, 1))
    if pin is None:
        pin = np.zeros((g.pins, 2, 1))
    gear_bend, pin_bend = surface.gear_curvature, surface.pin_curvature
    return contact.Deviations(
        *_flank_points(drive, gear.shape[2]),
        gear=_flanks_of(gear, z, g.face_width),
        pin=_pins_of(pin, z, g.face_width),
        largest=float(gear.max() + pin.max()),
        gear_curvature=np.empty((0, 0, 0, 0)) if gear_bend is None else _flanks_of(gear_bend, z, g.face_width),
        pin_curvature=np.empty((0, 0, 0)) if pin_bend is None else _pins_of(pin_bend, z, g.face_width),
    )


def _flanks_of(values: Array, z: Array, face_width: float) -> Array:
    """Values of the flanks' elements for `contact.Deviations`; an end has the value of the element it is in."""
    flanks = np.moveaxis(_across_width(values, z, face_width), 3, 1)
    return np.ascontiguousarray(np.concatenate([flanks[..., :1], flanks, flanks[..., -1:]], axis=3))


def _pins_of(values: Array, z: Array, face_width: float) -> Array:
    """Values of the pins' elements as `contact.Deviations` takes them."""
    return np.ascontiguousarray(np.moveaxis(_across_width(values, z, face_width), 2, 0))


def _flank_points(drive: DriveValue, elements: int) -> tuple[Array, Array, Array, Array, Array]:
    """Parameters, points and normals of tooth 0's ends and its elements' middles on the flank as generated."""
    pair = drive.pair
    alpha = np.concatenate([[0.0], equal_arc_parameters(pair, elements), [2.0 * np.pi / pair.gear_teeth]])
    warm = pair.at_temperature
    errors, drawn = drive.displacements, warm.modification
    generating = warm.replace(
        isometric=drawn.isometric + errors["generating_pin_radius"],
        offset=drawn.offset + errors["generating_circle_radius"],
    )
    (x, y), (nx, ny) = flank_points(generating, alpha), flank_normals(generating, alpha)
    return alpha, x, y, nx, ny


def _across_width(values: Array, z: Array, face_width: float) -> Array:
    """Values at heights z of elements along the last axis, linear between the elements' middles."""
    count = values.shape[-1]
    position = np.clip((z / face_width + 0.5) * count - 0.5, 0.0, count - 1.0)
    low = np.minimum(position.astype(int), max(count - 2, 0))
    high = np.minimum(low + 1, count - 1)
    share = position - low
    return np.asarray((1.0 - share) * values[..., low] + share * values[..., high])


def _stray(pair: Pair, displaced: Mapping[str, Any], leading: int = 0) -> Any:
    """How far modifications and errors can take a pin's axis from the flank's generating path, m.

    Values of one drive, or of many in a leading axis.
    """
    scale = {"tilt_x": pair.face_width, "tilt_y": pair.face_width, "tooth_turn": pair.pin_circle_radius}
    return sum(
        np.abs(values).max(axis=tuple(range(leading, np.ndim(values)))) * scale.get(name, 1.0)
        for name, values in displaced.items()
    )


def _root_phase(pair: Pair, stray: Array, circle: Array) -> Array:
    """Phase from a root within which a pin may stand before the neighbouring tooth, rad, of one drive or of many.

    It is where the generating path has run three times as far as the pin's axis may stray from it, the rotation that
    errors and modifications allow included.
    """
    g = pair
    turning = circle / (g.eccentricity * g.gear_teeth)
    reach = 3.0 * (1.0 + turning) * stray + 5e-5
    k = (g.eccentricity * g.pins / circle)[..., None]
    phase = np.linspace(0.0, 0.9 * np.pi, 200)
    speed = (circle / g.gear_teeth)[..., None] * np.sqrt(1.0 + k * k - 2.0 * k * np.cos(phase))
    path = np.cumsum(0.5 * (speed[..., 1:] + speed[..., :-1]) * np.diff(phase), axis=-1)
    path = np.concatenate([np.zeros((*circle.shape, 1)), path], axis=-1)
    root_phase = np.empty(circle.shape)
    for drive in np.ndindex(circle.shape):
        root_phase[drive] = np.interp(reach[drive], path[drive], phase)
    return root_phase


def _contiguous(values: ArrayLike) -> Array:
    # A copy: for a view with steps, or one that is read only, the kernel would be compiled once more.
    return np.array(values, dtype=float, order="C", ndmin=1)


def along_sweep(torques: Array, angles: Array) -> Array:
    """Return torques (N·m), shape (torques,) or (torques, angles), at every crank angle, shape (torques, angles)."""
    each = torques if torques.ndim == 2 else torques[:, None]
    return np.array(np.broadcast_to(each, (each.shape[0], angles.size)))


def balances(torque: ArrayLike, balance: ArrayLike) -> NDArray[np.bool_]:
    """Whether what contacts carry is the torque, both N·m, shapes that broadcast: else the search ended without it."""
    return np.asarray(np.abs(np.subtract(balance, torque)) <= UNBALANCED * np.abs(torque))


def check_balance(torque: ArrayLike, balance: ArrayLike) -> None:
    """Refuse a torque that contacts do not carry.

    Parameters
    ----------
    torque, balance
        N·m, and what contacts carry, shapes that broadcast.

    Raises
    ------
    UnbalancedError
        It names the torque.
    """
    failed = ~balances(torque, balance)
    if failed.any():
        first = np.broadcast_to(torque, failed.shape)[failed][0]
        raise UnbalancedError(
            f"torque = {first:g} N*m: no contacts of this pair can balance it; give one that it can carry."
        )


def check_falling(drive: contact.Problem, crank_angle: Array, torque: Array, falling: NDArray[np.bool_]) -> None:
    """Check the balance where the torque falls with the rotation, which it does on worn flanks or beyond any load.

    Parameters
    ----------
    drive, crank_angle, torque
        The contact problem, crank angles (rad) and the torque at each (N·m), shape (angles,).
    falling
        Where the torque falls, shape (angles,).

    Raises
    ------
    edge.InputError
        As `check_balance`.
    """
    doubtful = np.flatnonzero(falling & (torque != 0.0))
    if doubtful.size == 0:
        return
    rows = contact.contact_rows(drive)
    for i in doubtful:
        contact.equilibrium(drive, crank_angle[i], torque[i], 0.0, rows, True)
        check_balance(torque[i], contact.carried(rows))


def empty_lines(drive: DriveValue, slices: int, grid: tuple[int, ...]) -> contact.ContactLines:
    """Return empty contact lines at `places` (torques, angles, discs, pins), of the surface's elements or the usual."""
    pair, surface = drive.pair, drive.surface
    g = pair
    profile = PROFILE_ELEMENTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
    around = ANGLE_ELEMENTS if surface.pin_deviation is None else surface.pin_deviation.shape[1]
    alpha, x, y, _, _ = _flank_points(drive, profile)
    return contact.ContactLines(
        np.zeros((*grid, slices), np.float32),
        np.zeros((*grid, slices), np.float32),
        np.zeros((grid[0], g.discs, g.gear_teeth, profile, slices)),
        np.zeros((grid[0], g.pins, around, slices)),
        alpha,
        x,
        y,
    )


def no_lines(torques: int) -> contact.ContactLines:
    """Return what stands for contact lines where none are contact_lines."""
    slices, elements = np.zeros((torques, 0, 0, 0, 0), np.float32), np.zeros((torques, 0, 0, 0, 0))
    none = np.empty(0)
    return contact.ContactLines(slices, slices, elements, elements.reshape(torques, 0, 0, 0), none, none, none)


@dataclass(frozen=True)
class Options:
    """How a sweep is solved, as `cycloid_fmu.analysis.solve` describes it."""

    slices: int = 1
    with_play: bool = True
    with_stiffness: bool = True
    with_elements: bool = False
    workers: int = 1
    progress: Callable[[int], None] = lambda angles: None


def solve(drive: DriveValue, torque: Array, crank_angle: Array, options: Options) -> Transmission:
    """Solve a drive on rigid bearings; see `cycloid_fmu.analysis.solve`.

    Parts are the same whatever the number of threads, so the results are the same bits.
    """
    pair, slices = drive.pair, options.slices
    problem = rigid_problem(drive, slices)
    torques, angles = _contiguous(torque), _contiguous(crank_angle)
    at_angles = along_sweep(torques, angles)
    loads, grid = at_angles.shape, (*at_angles.shape, pair.discs, pair.pins)
    loaded, low, high, gap = _unsolved(problem, loads)
    lines = empty_lines(drive, slices, grid) if options.with_elements else None
    merging = threading.Lock()

    def part(first: int, last: int) -> None:
        # Parts that are solved at once each raise pressures of their own.
        part_lines = lines and lines._replace(
            gear_pressure=np.zeros_like(lines.gear_pressure), pin_pressure=np.zeros_like(lines.pin_pressure)
        )
        contact.sweep(problem, angles, at_angles, first, last, options.with_play, low, high, gap, loaded, part_lines)
        if lines is not None and part_lines is not None:
            with merging:
                np.maximum(lines.gear_pressure, part_lines.gear_pressure, out=lines.gear_pressure)
                np.maximum(lines.pin_pressure, part_lines.pin_pressure, out=lines.pin_pressure)

    def result(done: slice) -> Transmission:
        contact_lines = lines or no_lines(loads[0])
        return Transmission(
            torques,
            angles[done],
            loaded.transmission_error[:, done],
            loaded.stiffness[:, done],
            loaded.contact_count[:, done],
            loaded.max_contact_pressure[:, done],
            loaded.pin_force[:, done],
            loaded.pin_pressure[:, done],
            low[done],
            high[done],
            gap[done],
            contact_lines.slice_force[:, done],
            contact_lines.slice_direction[:, done],
            contact_lines.gear_pressure,
            contact_lines.pin_pressure,
        )

    try:
        solve_in_parts(part, angles.size, PART, options.workers, lambda size: options.progress(size * loads[0]))
    except Stopped as stopped:
        raise Interrupted(result(slice(0, stopped.finished))) from None
    for k in range(loads[0]):
        check_falling(problem, angles, at_angles[k], loaded.stiffness[k] <= 0.0)
    return result(slice(None))


class Swept(NamedTuple):
    """Arrays of `contact.sweep`: loads, and the play's ends (rad) and interference (m), shape (angles,)."""

    loaded: contact.LoadedSweep
    low: Array
    high: Array
    interference: Array


def _unsolved(problem: contact.Problem, loads: tuple[int, ...]) -> Swept:
    transmission_error, stiffness, pressure = (np.full(loads, np.nan) for _ in range(3))
    # In one array, which the allocator keeps for the next sweep: 1.15 times as fast where sweeps are repeated.
    pin_force, pin_pressure = np.zeros((2, *loads, problem.crank_phase.size, problem.pin_x.size))
    loaded = contact.LoadedSweep(
        transmission_error, stiffness, np.zeros(loads, dtype=np.int64), pressure, pin_force, pin_pressure
    )
    return Swept(loaded, *(np.full(loads[1], np.nan) for _ in range(3)))


def solve_problem(problem: contact.Problem, torque: Array, crank_angle: Array, *, with_play: bool) -> Swept:
    """Solve a contact problem at torques (torques, angles), N·m, and crank angles (rad), in a row.

    Whether contacts balance the torques is not checked (`check_falling`).
    """
    swept = _unsolved(problem, torque.shape)
    ends, loaded = (swept.low, swept.high, swept.interference), swept.loaded
    contact.sweep(problem, crank_angle, torque, 0, crank_angle.size, with_play, *ends, loaded, None)
    return swept


class Interrupted(KeyboardInterrupt):
    """A sweep was interrupted; `result` holds what was finished, from the first crank angle on."""

    def __init__(self, result: Transmission) -> None:
        super().__init__()
        self.result = result


@dataclass(frozen=True)
class Sensitivity:
    """Transmission error with its derivatives.

    Attributes
    ----------
    transmission_error
        Shape (angles,), rad.
    by_displacement
        Derivative by all displacements (`structured.displacement_layout`), shape (angles, displacements), rad/m, for
        angles rad/rad.
    by_crank_angle, by_torque
        Derivatives by crank angle (dimensionless) and torque (rad/(N·m)), shape (angles,).
    by_bearing
        Derivative by the parameters of bearings and elastic bodies (`cycloid_fmu.supports.transmission.parameters_of`),
        shape (angles, parameters); none on rigid bearings.
    coordinates
        Unknowns of the balance, shape (angles, unknowns): the transmission error, and on bearings the positions of all
        bodies, from which a drive near this one is solved in fewer steps.
    """

    transmission_error: Array
    by_displacement: Array
    by_crank_angle: Array
    by_torque: Array
    by_bearing: Array
    coordinates: Array


def sensitivity(drive: DriveValue, torque: Array, crank_angle: Array, slices: int) -> Sensitivity:
    """Return transmission error and derivatives of a drive on rigid bearings; see `cycloid_fmu.analysis.sensitivity`.

    `torque` has shape (angles,).
    """
    problem = rigid_problem(drive, slices)
    angles, torques = _contiguous(crank_angle), _contiguous(torque)
    by_displacement = np.empty((angles.size, displacement_size(drive.pair)))
    transmission_error, by_angle, by_torque = (np.empty(angles.size) for _ in range(3))
    contact.sweep_sensitivities(problem, angles, torques, transmission_error, by_displacement, by_angle, by_torque)
    check_falling(problem, angles, torques, ~(by_torque > 0.0))
    by_angle -= 1.0 / drive.pair.ratio
    return Sensitivity(
        transmission_error,
        by_displacement,
        by_angle,
        by_torque,
        by_bearing=np.zeros((angles.size, 0)),
        coordinates=transmission_error[:, None],
    )


def form_sensitivity(
    drive: DriveValue,
    transmission_error: ArrayLike,
    crank_angle: ArrayLike,
    names: list[str],
    slices: int = 1,
) -> Array:
    """Derivatives of a solved transmission error by orders of the profile deviation, shape (angles, names), rad/m."""
    pair, surface = drive.pair, drive.surface
    angles, transmission_error = _contiguous(crank_angle), _contiguous(transmission_error)
    elements = PROFILE_POINTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
    profile_parameters = np.concatenate([[0.0], equal_arc_parameters(pair, elements), [2.0 * np.pi / pair.gear_teeth]])
    waves = np.pad(np.array([profile_wave(name, elements) for name in names]), ((0, 0), (1, 1)), "edge")
    by_order = np.empty((angles.size, len(names)))
    contact.sweep_flank_sensitivities(
        rigid_problem(drive, slices), angles, transmission_error, profile_parameters, waves, by_order
    )
    return by_order
