"""Transmission error, backlash, torsional stiffness, load sharing and contact pressure over a crank sweep."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact, edge
from cycloid_fmu.contact.parts import Stopped, solve_in_parts
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_normals, flank_points
from cycloid_fmu.geometry.temperature import missing_for_clearances
from cycloid_fmu.surfaces.provenance import provenance
from cycloid_fmu.surfaces.structured import (
    PROFILE_POINTS,
    dimensions,
    dimensions_of,
    displacement_columns,
    displacements,
    displacements_of,
    profile_wave,
)
from cycloid_fmu.surfaces.surface import ErrorSurface

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FORMAT = "cycloid-analysis/1"
PROFILE_ELEMENTS = 800  # of a tooth, as in the error-surface paper, where a surface does not say
ANGLE_ELEMENTS = 400  # of half a pin
SLICES_MISALIGNED = 20  # transmission error within 0.1 % to 0.5 mrad, by midpoints (docs/theory/contact.md)
_UNBALANCED = 0.2  # of the torque: where a worn flank's curvature jumps, so do forces, and 5 % were seen to stay
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
        Shape (angles,): deviations between which the output is free (rad), their difference (rad; NaN without a free
        position), and by how much there is none (m).
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


def slices_needed(surface: ErrorSurface) -> int:
    """Return the slices that a surface needs: its elements across the width, 20 where the gear's axis is tilted."""
    made = displacements(surface.pair, surface, {})
    tilted = made["tilt_x"] != 0.0 or made["tilt_y"] != 0.0
    elements = [int(d.shape[-1]) for d in (surface.gear_deviation, surface.pin_deviation) if d is not None]
    return max([SLICES_MISALIGNED if tilted else 1, *elements])


def drive_of(pair: Pair, surface: ErrorSurface, slices: int = 1) -> contact.Problem:
    """Return the contact problem of a pair with an error surface.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.
    slices
        Slices across the face width, each independent and taken at its middle; 1 where nothing varies across it.

    Raises
    ------
    edge.InputError
        If the pair has supports: a drive on bearings is more than its contacts.
    """
    if pair.supports is not None:
        raise edge.InputError(
            "the pair has [supports], which this does not take into account yet; analyze does. Remove the table for a "
            "drive on rigid bearings."
        )
    return mesh_of(pair, surface, slices)


def mesh_of(pair: Pair, surface: ErrorSurface, slices: int = 1) -> contact.Problem:
    """Return the contact problem of gear and pins alone, whatever holds them, at the pair's temperatures.

    Parameters are those of `drive_of`.
    """
    warm, modification = pair.at_temperature, _modification(pair)
    made, z = dimensions(pair, surface), _heights(pair, slices)
    stray = _stray(pair, displacements(pair, surface, modification))
    # Form is added here, because not every drive has it.
    stray += sum(float(np.abs(d).max()) for d in (surface.gear_deviation, surface.pin_deviation) if d is not None)
    return contact.Problem(
        **_made(pair, made, stray, z),
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
        deviations=_deviations(pair, surface, z),
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
    displaced = displacements_of(pair, vectors)
    made, modification = dimensions_of(pair, displaced), _modification(pair)
    stray = _stray(pair, displaced | {name: value + displaced[name] for name, value in modification.items()}, 1)
    return contact.Drives(**_made(pair, made, stray, _heights(pair, slices)))


def _heights(pair: Pair, slices: int) -> Array:
    return np.asarray(pair.face_width * ((np.arange(slices) + 0.5) / slices - 0.5))


def _modification(pair: Pair) -> dict[str, float]:
    return {
        "generating_pin_radius": pair.modification.isometric,
        "generating_circle_radius": pair.modification.offset,
    }


def _made(pair: Pair, made: Mapping[str, Any], stray: Any, z: Array) -> dict[str, Any]:
    """Fields of the contact problem of a drive, or of many in a leading axis, that its errors change."""
    warm = pair.at_temperature
    angle = 2.0 * np.pi * np.arange(pair.pins) / pair.pins + made["pin_tangential"] / warm.pin_circle_radius
    circle = np.asarray(made["generating_circle_radius"])
    spread = np.ptp(made["tooth_turn"], axis=-1).max(axis=-1)
    found = {
        "circle_radius": circle,
        "generating_radius": np.asarray(made["generating_pin_radius"]),
        "eccentricity": np.asarray(made["crank_throw"]),
        "stray": np.asarray(stray),
        "root_phase": _root_phase(warm, np.asarray(stray), circle),
        "root_margin": 1e-6 + 1.5 * warm.pin_circle_radius * spread,
    }
    if circle.ndim == 0:
        found = {name: float(value) for name, value in found.items()}
    centre_x, centre_y, tilt_x, tilt_y = (
        np.asarray(made[name])[..., None] for name in ("centre_x", "centre_y", "tilt_x", "tilt_y")
    )
    return found | {
        "pin_x": made["pin_radial"] * np.cos(angle),
        "pin_y": made["pin_radial"] * np.sin(angle),
        "pin_radius": made["pin_radius"],
        "tooth_turn": np.ascontiguousarray(made["tooth_turn"]),
        "centre_x": centre_x + tilt_x * z,
        "centre_y": centre_y + tilt_y * z,
    }


def _deviations(pair: Pair, surface: ErrorSurface, z: Array) -> contact.Deviations | None:
    """Deviations of flanks and pins at the slices' middles; None where all is nominal."""
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
        *_flank_points(pair, surface, gear.shape[2]),
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


def _flank_points(pair: Pair, surface: ErrorSurface, elements: int) -> tuple[Array, Array, Array, Array, Array]:
    """Parameters, points and normals of tooth 0's ends and its elements' middles on the flank that was made."""
    alpha = np.concatenate([[0.0], equal_arc_parameters(pair, elements), [2.0 * np.pi / pair.gear_teeth]])
    warm = pair.at_temperature
    errors, drawn = displacements(pair, surface, {}), warm.modification
    made = warm.replace(
        isometric=drawn.isometric + errors["generating_pin_radius"],
        offset=drawn.offset + errors["generating_circle_radius"],
    )
    (x, y), (nx, ny) = flank_points(made, alpha), flank_normals(made, alpha)
    return alpha, x, y, nx, ny


def _across_width(deviation: Array, z: Array, face_width: float) -> Array:
    """Values at heights z of elements along the last axis, linear between the elements' middles."""
    count = deviation.shape[-1]
    place = np.clip((z / face_width + 0.5) * count - 0.5, 0.0, count - 1.0)
    low = np.minimum(place.astype(int), max(count - 2, 0))
    high = np.minimum(low + 1, count - 1)
    share = place - low
    return np.asarray((1.0 - share) * deviation[..., low] + share * deviation[..., high])


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
    found = np.empty(circle.shape)
    for drive in np.ndindex(circle.shape):
        found[drive] = np.interp(reach[drive], path[drive], phase)
    return found


def _contiguous(values: ArrayLike) -> Array:
    # A copy: for a view with steps, or one that is read only, the kernel would be compiled once more.
    return np.array(values, dtype=float, order="C", ndmin=1)


def along_sweep(torques: Array, angles: Array) -> Array:
    """Return torques (N·m), shape (torques,) or (torques, angles), at every crank angle, shape (torques, angles)."""
    each = torques if torques.ndim == 2 else torques[:, None]
    return np.array(np.broadcast_to(each, (each.shape[0], angles.size)))


def carried(contacts: contact.Rows) -> Array:
    """Torque that contacts carry, N·m: force times arm, summed over the rows, shape (..., rows), of each."""
    force, arm = contacts["force"], contacts["arm"]
    return np.asarray(np.sum(np.where(force > 0.0, force * arm, 0.0), axis=-1))


def balances(torque: ArrayLike, balance: ArrayLike) -> NDArray[np.bool_]:
    """Whether what contacts carry is the torque, both N·m, shapes that broadcast: else the search ended without it."""
    return np.asarray(np.abs(np.subtract(balance, torque)) <= _UNBALANCED * np.abs(torque))


def check_balance(torque: ArrayLike, balance: ArrayLike) -> None:
    """Refuse a torque that contacts do not carry.

    Parameters
    ----------
    torque, balance
        N·m, and what contacts carry, shapes that broadcast.

    Raises
    ------
    edge.InputError
        It names the torque.
    """
    failed = ~balances(torque, balance)
    if failed.any():
        first = np.broadcast_to(torque, failed.shape)[failed][0]
        raise edge.InputError(
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
    rows = contact.contact_rows(drive)
    for i in np.flatnonzero(falling & (torque != 0.0)):
        contact.equilibrium(drive, crank_angle[i], torque[i], 0.0, rows, True)
        check_balance(torque[i], carried(rows))


def empty_lines(pair: Pair, surface: ErrorSurface, slices: int, places: tuple[int, ...]) -> contact.ContactLines:
    """Return empty contact lines at `places` (torques, angles, discs, pins), of the surface's elements or the usual."""
    g = pair
    profile = PROFILE_ELEMENTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
    around = ANGLE_ELEMENTS if surface.pin_deviation is None else surface.pin_deviation.shape[1]
    alpha, x, y, _, _ = _flank_points(pair, surface, profile)
    return contact.ContactLines(
        np.zeros((*places, slices), np.float32),
        np.zeros((*places, slices), np.float32),
        np.zeros((places[0], g.discs, g.gear_teeth, profile, slices)),
        np.zeros((places[0], g.pins, around, slices)),
        alpha,
        x,
        y,
    )


def no_lines(torques: int) -> contact.ContactLines:
    """Return what stands for contact lines where none are kept."""
    slices, elements = np.zeros((torques, 0, 0, 0, 0), np.float32), np.zeros((torques, 0, 0, 0, 0))
    none = np.empty(0)
    return contact.ContactLines(slices, slices, elements, elements.reshape(torques, 0, 0, 0), none, none, none)


def solve(
    pair: Pair,
    surface: ErrorSurface,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    *,
    with_play: bool = True,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> Transmission:
    """Solve the loaded contact at every torque and crank angle.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.
    torque
        Torques of the environment on the output, N·m, shape (torques,), or (torques, angles) where they change along
        the sweep; at 0 the transmission error is the middle of the play.
    crank_angle
        Crank angles, rad; neighbours should be neighbours in the array, each solution starts from the one before.
    slices
        Slices across the face width.
    with_play
        Whether to compute play, backlash and interference; NaN otherwise.
    with_elements
        Whether to keep the contact lines and the largest pressure of each element.
    workers
        Threads. The work is divided in the same way whatever their number, so the results are the same bits.
    progress
        Told how many crank angles (times loads) were just finished.

    Raises
    ------
    edge.InputError
        If a torque is too large to be balanced.
    Interrupted
        At a KeyboardInterrupt; it holds the results of the crank angles that were finished.
    """
    problem = drive_of(pair, surface, slices)
    g = pair
    torques, angles = _contiguous(torque), _contiguous(crank_angle)
    if not (np.isfinite(torques).all() and np.isfinite(angles).all()):
        raise ValueError("torque and crank_angle must be finite")
    at_angles = along_sweep(torques, angles)
    loads, places = at_angles.shape, (*at_angles.shape, g.discs, g.pins)
    found, low, high, gap = _unsolved(problem, loads)
    deviation, stiffness, pressure = found.deviation, found.stiffness, found.max_contact_pressure
    lines = empty_lines(pair, surface, slices, places) if with_elements else None
    merging = threading.Lock()

    def part(first: int, last: int) -> None:
        # Parts that are solved at once each raise pressures of their own.
        mine = lines and lines._replace(
            gear_pressure=np.zeros_like(lines.gear_pressure), pin_pressure=np.zeros_like(lines.pin_pressure)
        )
        contact.sweep(problem, angles, at_angles, first, last, with_play, low, high, gap, found, mine)
        if lines is not None and mine is not None:
            with merging:
                np.maximum(lines.gear_pressure, mine.gear_pressure, out=lines.gear_pressure)
                np.maximum(lines.pin_pressure, mine.pin_pressure, out=lines.pin_pressure)

    def result(done: slice) -> Transmission:
        kept = lines or no_lines(loads[0])
        return Transmission(
            torques,
            angles[done],
            deviation[:, done],
            stiffness[:, done],
            found.contact_count[:, done],
            pressure[:, done],
            found.pin_force[:, done],
            found.pin_pressure[:, done],
            low[done],
            high[done],
            gap[done],
            kept.slice_force[:, done],
            kept.slice_direction[:, done],
            kept.gear_pressure,
            kept.pin_pressure,
        )

    try:
        solve_in_parts(part, angles.size, PART, workers, lambda size: progress(size * loads[0]))
    except Stopped as stopped:
        raise Interrupted(result(slice(0, stopped.finished))) from None
    for k in range(loads[0]):
        check_falling(problem, angles, at_angles[k], stiffness[k] <= 0.0)
    return result(slice(None))


class Swept(NamedTuple):
    """Arrays of `contact.sweep`: loads, and the play's ends (rad) and interference (m), shape (angles,)."""

    loaded: contact.LoadedSweep
    low: Array
    high: Array
    interference: Array


def _unsolved(problem: contact.Problem, loads: tuple[int, ...]) -> Swept:
    deviation, stiffness, pressure = (np.full(loads, np.nan) for _ in range(3))
    # In one array, which the allocator keeps for the next sweep: 1.15 times as fast where sweeps are repeated.
    pin_force, pin_pressure = np.zeros((2, *loads, problem.crank_phase.size, problem.pin_x.size))
    loaded = contact.LoadedSweep(
        deviation, stiffness, np.zeros(loads, dtype=np.int64), pressure, pin_force, pin_pressure
    )
    return Swept(loaded, *(np.full(loads[1], np.nan) for _ in range(3)))


def solve_problem(problem: contact.Problem, torque: Array, crank_angle: Array, *, with_play: bool) -> Swept:
    """Solve a contact problem at torques (torques, angles), N·m, and crank angles (rad), in a row.

    Whether contacts balance the torques is not checked (`check_falling`).
    """
    found = _unsolved(problem, torque.shape)
    contact.sweep(
        problem,
        crank_angle,
        torque,
        0,
        crank_angle.size,
        with_play,
        found.low,
        found.high,
        found.interference,
        found.loaded,
        None,
    )
    return found


class Interrupted(KeyboardInterrupt):
    """A sweep was interrupted; `result` holds what was finished, from the first crank angle on."""

    def __init__(self, result: Transmission) -> None:
        super().__init__()
        self.result = result


def error_sensitivity(
    pair: Pair, surface: ErrorSurface, torque: ArrayLike, crank_angle: ArrayLike, names: list[str], slices: int = 1
) -> tuple[Array, Array, Array, Array]:
    """Transmission error at one torque, or one for each angle, with its derivatives by errors, angle and torque.

    Returns
    -------
    transmission_error
        Shape (angles,), rad.
    jacobian
        By the structured errors of `names`, orders of the profile deviation among them, shape (angles, names), rad/m
        (rad/rad for angles).
    each
        By every single error, columns as in `contact.sensitivities`.
    further
        By crank angle (rad/rad) and torque (rad/(N·m)), shape (angles, 2).

    Raises
    ------
    edge.InputError
        If a torque is too large to be balanced.
    """
    drive = drive_of(pair, surface, slices)
    angles = _contiguous(crank_angle)
    columns = displacement_columns(pair, names)
    each, jacobian = (np.empty((angles.size, size)) for size in columns.shape)
    deviation, by_angle, by_torque = (np.empty(angles.size) for _ in range(3))
    torques = _contiguous(np.broadcast_to(torque, angles.shape))
    contact.sweep_sensitivities(drive, angles, torques, columns, deviation, each, jacobian, by_angle, by_torque)
    check_falling(drive, angles, torques, ~(by_torque > 0.0))
    profiles = [at for at, name in enumerate(names) if profile_wave(name, PROFILE_POINTS) is not None]
    if profiles:
        jacobian[:, profiles] = form_sensitivity(
            pair, surface, deviation, angles, [names[at] for at in profiles], slices
        )
    return deviation, jacobian, each, np.stack([by_angle - 1.0 / pair.ratio, by_torque], axis=1)


def form_sensitivity(
    pair: Pair,
    surface: ErrorSurface,
    transmission_error: ArrayLike,
    crank_angle: ArrayLike,
    names: list[str],
    slices: int = 1,
) -> Array:
    """Derivatives of a solved transmission error by orders of the profile deviation, shape (angles, names), rad/m."""
    angles, deviation = _contiguous(crank_angle), _contiguous(transmission_error)
    elements = PROFILE_POINTS if surface.gear_deviation is None else surface.gear_deviation.shape[2]
    places = np.concatenate([[0.0], equal_arc_parameters(pair, elements), [2.0 * np.pi / pair.gear_teeth]])
    waves = np.pad(np.array([profile_wave(name, elements) for name in names]), ((0, 0), (1, 1)), "edge")
    found = np.empty((angles.size, len(names)))
    contact.sweep_flank_sensitivities(drive_of(pair, surface, slices), angles, deviation, places, waves, found)
    return found


LARGEST_PRESSURE = 4e9
"""Pa: contact stress at which rolling bodies of bearing steel are permanently deformed (ISO 76, static rating)."""
_LARGEST_TILT_ERROR = 0.02 / edge.ARCSEC  # rad
_LARGEST_HALF_WIDTH = 0.25  # of the pin's radius: Hertz's half space ends there


def tilt_error(pair: Pair, tilt: ArrayLike) -> Array:
    """Return the largest error of the transmission error by what slices neglect of a tilted gear, β²/2K, rad.

    Parameters
    ----------
    pair
        For its shortening coefficient K.
    tilt
        β, the angle of the gear's axis from the pins' axes, rad.

    Notes
    -----
    Slices are displaced; that sections of a tilted gear are wider along the tilt is neglected (docs/theory/errors.md).
    """
    return np.asarray(0.5 * np.square(tilt) / pair.shortening)


def notes(pair: Pair, surface: ErrorSurface, found: Transmission) -> list[str]:
    """Return where results lie outside what the model is made for, one sentence each, none where all is well.

    Parameters
    ----------
    pair
        Its `pressure_limit`, or `LARGEST_PRESSURE`, and its rated torque are what results are held against.
    surface
        Its errors, for the tilt of the gear.
    found
        Of `solve`.
    """
    said = []
    limit = LARGEST_PRESSURE if pair.pressure_limit is None else pair.pressure_limit
    largest = found.max_contact_pressure.max(initial=0.0)
    if largest > limit:
        said.append(
            f"The contact pressure reaches {largest * 1e-6:.0f} MPa, above {limit * 1e-6:.0f} MPa"
            + (" (ISO 76)" if pair.pressure_limit is None else "")
            + ": real flanks and pins deform for good there, and the model does not."
        )
    pressed = found.pin_pressure > 0.0
    half = 2.0 * found.pin_force[pressed] / (math.pi * pair.face_width * found.pin_pressure[pressed])
    if half.max(initial=0.0) > _LARGEST_HALF_WIDTH * pair.pin_radius:
        said.append(
            f"The contact's half width reaches {half.max() * 1e3:.3g} mm with a pin radius of "
            f"{pair.pin_radius * 1e3:.3g} mm: Hertz's law holds only for contacts that are narrow beside the pin."
        )
    if pair.rated_torque is not None and np.abs(found.torque).max(initial=0.0) > pair.rated_torque:
        torque = found.torque[np.abs(found.torque).argmax()]
        said.append(f"The torque {torque:g} N*m is above the rated torque, {pair.rated_torque:g} N*m.")
    said += interference_notes(found)
    made = displacements(pair, surface, {})
    tilt = math.hypot(made["tilt_x"], made["tilt_y"])
    if (error := float(tilt_error(pair, tilt))) > _LARGEST_TILT_ERROR:
        said.append(
            f"The gear's axis is tilted by {tilt * 1e3:.3g} mrad, modelled to first order: the transmission error "
            f"is uncertain by {error * edge.ARCSEC:.2g}″ (0.02″ at "
            f"{math.sqrt(2.0 * pair.shortening * _LARGEST_TILT_ERROR) * 1e3:.2g} mrad)."
        )
    if missing := missing_for_clearances(pair):
        said.append(f"Clearances stay as drawn at these temperatures; not stated are: {', '.join(missing)}.")
    return said


def interference_notes(found: Transmission) -> list[str]:
    """Return one sentence if flanks and pins interfere without a torque, none otherwise."""
    if not found.interference.max(initial=0.0) > 0.0:
        return []
    pressed = ""
    if found.preload is not None and found.preload_count is not None:
        most = int(found.preload.argmax())
        pressed = f", and {found.preload_count[most]} pins are pressed by up to {found.preload[most]:.3g} N"
    return [
        f"Without load flanks and pins interfere by up to {found.interference.max() * 1e6:.3g} um{pressed}: there is "
        "no play between them. To remove material, take an isometric above zero or an offset below zero."
    ]


_LABELS = {
    "transmission_error": ("rad", "transmission error at the output"),
    "backlash": ("rad", "backlash: free rotation of the output with the crank locked"),
    "interference": ("m", "interference where no free position exists"),
    "torsional_stiffness": ("N*m/rad", "torsional stiffness at the output"),
    "contact_count": ("1", "pins that carry more than 1 % of the most loaded pin's force"),
    "max_contact_pressure": ("Pa", "largest contact pressure"),
    "pin_force": ("N", "force of each pin"),
    "pin_pressure": ("Pa", "largest contact pressure of each pin"),
    "slice_force": ("N", "contact lines: force of each pin in each slice"),
    "slice_direction": ("rad", "contact lines: direction about the pin's axis, from that to the pin circle's centre"),
    "gear_element_pressure": ("Pa", "largest pressure that each element of the flanks has seen"),
    "pin_element_pressure": ("Pa", "largest pressure that each element of the pins has seen"),
    "slice": ("m", "middle of the slice from mid-width"),
    "profile": ("1", "middle of the element along the tooth's arc, from its first root to its second"),
    "angle": ("rad", "middle of the element about the pin's axis, from the direction to the pin circle's centre"),
    "torque": ("N*m", "torque of the environment on the output"),
    "crank_angle": ("rad", "crank angle"),
}


def analyze(
    pair: Pair,
    surface: ErrorSurface,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    *,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> xr.Dataset:
    """Return the labelled dataset of a crank sweep (format `cycloid-analysis/1`).

    Parameters are those of `solve`. Interrupted, it returns the crank angles that were finished, and the attribute
    `complete` is 0.
    """
    complete = True
    try:
        result = solve(
            pair, surface, torque, crank_angle, slices, with_elements=with_elements, workers=workers, progress=progress
        )
    except Interrupted as interrupted:
        result, complete = interrupted.result, False
    return labelled(pair, surface, result, slices, complete=complete)


def labelled(pair: Pair, surface: ErrorSurface, result: Transmission, slices: int, *, complete: bool) -> xr.Dataset:
    """Return results as `analyze` does: a dataset that states the drive, its slices and whether it is complete."""
    data = dataset_of(pair, result)
    data.attrs.update(provenance(pair, surface), slices=slices, complete=int(complete))
    data.attrs["notes"] = "\n".join(notes(pair, surface, result))
    if pair.temperature is not None:
        data.attrs["temperature"] = str(pair.temperature)
    if pair.supports is None:
        data["torsional_stiffness"].attrs["long_name"] += ", mesh alone, rigid bodies"
    return data


def dataset_of(pair: Pair, result: Transmission) -> xr.Dataset:
    """Return results as a labelled dataset with units."""
    import xarray as xr

    g = pair
    grid = ("torque", "crank_angle")
    pins = (*grid, "disc", "pin")
    each = np.ones((result.torque.size, 1))
    data: dict[str, Any] = {
        "transmission_error": (grid, result.transmission_error),
        "backlash": (grid, each * result.backlash),
        "interference": (grid, each * result.interference),
        "torsional_stiffness": (grid, result.torsional_stiffness),
        "contact_count": (grid, result.contact_count),
        "max_contact_pressure": (grid, result.max_contact_pressure),
        "pin_force": (pins, result.pin_force),
        "pin_pressure": (pins, result.pin_pressure),
    }
    coordinates: dict[str, Any] = {
        "torque": result.torque,
        "crank_angle": result.crank_angle,
        "disc": np.arange(g.discs),
        "pin": np.arange(g.pins),
    }
    if result.slice_force.size:
        slices = result.slice_force.shape[-1]
        profile, around = result.gear_element_pressure.shape[3], result.pin_element_pressure.shape[2]
        data["slice_force"] = ((*pins, "slice"), result.slice_force)
        data["slice_direction"] = ((*pins, "slice"), result.slice_direction)
        data["gear_element_pressure"] = (("torque", "disc", "tooth", "profile", "slice"), result.gear_element_pressure)
        data["pin_element_pressure"] = (("torque", "pin", "angle", "slice"), result.pin_element_pressure)
        coordinates["slice"] = g.face_width * ((np.arange(slices) + 0.5) / slices - 0.5)
        coordinates["tooth"] = np.arange(g.gear_teeth)
        coordinates["profile"] = (np.arange(profile) + 0.5) / profile
        coordinates["angle"] = np.pi * ((np.arange(around) + 0.5) / around - 0.5)
    dataset = xr.Dataset(data, coordinates)
    for name, (unit, text) in _LABELS.items():
        if name in dataset.variables:
            dataset[name].attrs.update(units=unit, long_name=text)
    dataset.attrs["format"] = FORMAT
    return dataset


def statistics(data: Mapping[Any, Any]) -> dict[str, NDArray[np.float64]]:
    """Return the error-surface paper's figures of an analysis (dataset or arrays by name), one value for each torque.

    MTE and PPTE are the mean and peak-to-peak transmission error, MB and PPB those of the backlash (rad; NaN where
    there is no free position), MCS the largest contact pressure (Pa).
    """
    error, backlash = np.asarray(data["transmission_error"]), np.asarray(data["backlash"])
    return {
        "MTE": error.mean(axis=1),
        "PPTE": np.ptp(error, axis=1),
        "MB": backlash.mean(axis=1),
        "PPB": np.ptp(backlash, axis=1),
        "MCS": np.asarray(data["max_contact_pressure"]).max(axis=1),
    }
