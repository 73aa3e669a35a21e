"""Positions of all bodies of a drive over crank angles and loads, with contacts and their forces.

Points are complex, x + iy in the housing's frame, or in a disc's frame where stated.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import Transmission, mesh_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_curvature, flank_normals, flank_points
from cycloid_fmu.supports.transmission import OnBearings, problem_of
from cycloid_fmu.surfaces.structured import dimensions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Points = NDArray[np.complex128]
PROFILE = 60  # points of each tooth's outline: of the 39/40 pair chords are within 5 µm of the flank
LARGEST_FACTOR = 1000.0
_EACH_PITCH = 48


@dataclass(frozen=True)
class Motion:
    """Bodies, contacts and forces of a drive over loads and crank angles, SI.

    Attributes
    ----------
    pair
        The pair with the sizes at its temperatures.
    torque, crank_angle
        Torques of the environment on the output, shape (torques,), N·m, counter-clockwise positive; crank angles, shape
        (angles,), rad.
    transmission_error
        Transmission error, shape (torques, angles), rad.
    curve_angle, curve
        Transmission error over a whole crank turn as it is drawn, shapes (points,) and (torques, points), rad.
    swept
        Transmission error at `ANGLES` crank angles evenly over a turn, shape (torques, angles), rad: its mean and peak
        to peak are those of an analysis. They are not those of `curve`, which may miss a peak in every pitch alike.
    exaggeration
        Enlargement of the gaps between discs and pins in pictures, dimensionless.
    unmodified, drawn, normal
        Tooth 0 in its disc's frame from root to root, shape (profile,), m: without modification, as drawn, and the unit
        normals of the unmodified flank, out of the material.
    made
        Every tooth as made, in its disc's frame, shape (discs, teeth, profile), m.
    centre, rotation
        Centre (m) and rotation (rad) of each disc, shape (torques, angles, discs).
    ideal_rotation
        Rotation of each disc without errors, modification, load and play, shape (angles, discs), rad.
    pin_axis
        Axis of each pin, shape (torques, angles, pins), m.
    pin_radius
        Radius of each pin, shape (pins,), m.
    gap, force, touching, direction
        Contacts of each pin on each disc, with the conjugate tooth and the one across the nearest root, shape (torques,
        angles, discs, pins, 2): gap (m, below zero if the bodies press on each other; infinite without a nearest
        point), force (N), the flank's point nearest to the pin (m), and the unit vector from the pin's axis to it, the
        direction of the pin's force on the disc. With several slices, positions are those of the slice with the largest
        force or the smallest gap; forces are those of the whole width.
    pressure
        Largest contact pressure of each pin on each disc, shape (torques, angles, discs, pins), Pa.
    behind_first_stage
        Whether this is only the cycloid stage of a reducer.
    """

    pair: Pair
    torque: Array
    crank_angle: Array
    transmission_error: Array
    curve_angle: Array
    curve: Array
    swept: Array
    exaggeration: float
    unmodified: Points
    drawn: Points
    normal: Points
    made: Points
    centre: Points
    rotation: Array
    ideal_rotation: Array
    pin_axis: Points
    pin_radius: Array
    gap: Array
    force: Array
    touching: Points
    direction: Points
    pressure: Array
    behind_first_stage: bool = False

    @property
    def raised(self) -> Array:
        """Height of each tooth as made above the unmodified flank, shape (discs, teeth, profile), m."""
        turned = tooth_turns(self.pair)[:, None]
        return along(self.made - turned * self.unmodified, turned * self.normal)

    @property
    def nearest(self) -> Array:
        """Gap of each pin on each disc, shape (torques, angles, discs, pins), m; 0 without a nearest point."""
        gap = self.gap.min(axis=4)  # a pin may touch two teeth
        return np.where(np.isfinite(gap), gap, 0.0)

    @property
    def room(self) -> float:
        """Largest gap in a picture, m: flanks moved back this far still have no cusps."""
        pair = self.pair
        sharpest = flank_curvature(pair, np.linspace(0.0, 2.0 * np.pi / pair.gear_teeth, 1000)).max()
        return float(min(0.3 * pair.pin_radius, 0.6 * pair.eccentricity, 0.7 / sharpest))

    def outline(self, load: int, angle: int, disc: int, factor: float | None = None) -> Points:
        """Return a disc's outline with exaggerated gaps, in the housing's frame, shape (teeth x profile,), m.

        Every point is moved back along the flank's normal by this multiple of the opening due to modification, errors,
        load and play, but at least the gap of the nearest pin and at most its own distance from that pin. So the gap of
        each pin is `factor` times as large, at the same place, as long as that is within `room`; flanks in contact stay
        in contact, and 1 is to scale.

        Parameters
        ----------
        load, angle, disc
            Indices of the torque, the crank angle and the disc.
        factor
            The enlargement; None for `exaggeration`.
        """
        factor = self.exaggeration if factor is None else factor
        pins, pitch = self.pin_axis[load, angle], 2.0 * np.pi / self.pair.pins
        teeth, ideal = tooth_turns(self.pair)[:, None], np.exp(1j * self.ideal_rotation[angle, disc])
        point = self.centre[load, angle, disc] + np.exp(1j * self.rotation[load, angle, disc]) * self.made[disc]
        crank = self.crank_angle[angle] + 2.0 * np.pi * disc / self.pair.discs
        unmoved = self.pair.eccentricity * np.exp(1j * crank) + ideal * teeth * self.unmodified
        # Relative to the pins, which turn by the transmission error if the ring is the output.
        turned = np.exp(-1j * self.transmission_error[load, angle]) if self.pair.output == "ring" else 1.0
        normal = (ideal * teeth * self.normal).ravel()
        point, opened = point.ravel(), -along((turned * point - unmoved).ravel(), normal)
        place = np.angle(point / pins[0]) / pitch
        before = np.floor(place).astype(np.int64)
        around = (before[:, None] + np.arange(-1, 3)) % pins.size
        clearance = (np.abs(point[:, None] - pins[around]) - self.pin_radius[around]).min(axis=1)
        gap = self.nearest[load, angle, disc]
        beside = gap[around[:, 1]] + (place - before) * (gap[around[:, 2]] - gap[around[:, 1]])
        back = np.minimum(np.minimum(clearance, self.room / factor), np.maximum(opened, beside))
        return np.asarray(point - (factor - 1.0) * back * normal)


def mesh_angles(pins: int, each: int = _EACH_PITCH) -> Array:
    """Return crank angles of a curve over a crank turn, its end included, rad: the same `each` in every pin pitch.

    So equal pitches look equal; angles out of step meet a peak here and miss it there. With an `each` that is divisible
    by the number of discs, every disc meets the same phases.
    """
    return np.linspace(0.0, 2.0 * np.pi, each * pins + 1)


def along(vector: Points, normal: Points) -> Array:
    """Component of vectors along unit normals."""
    return np.asarray((vector * np.conj(normal)).real)


def tooth_turns(pair: Pair) -> Points:
    """Rotation of each tooth from tooth 0 as a complex number of magnitude 1, shape (teeth,)."""
    return np.asarray(np.exp(2j * np.pi * np.arange(pair.gear_teeth) / pair.gear_teeth))


def motion_of(
    drive: DriveValue,
    torque: Sequence[float],
    crank_angle: ArrayLike,
    exaggeration: float | None = None,
    *,
    with_curve: bool = True,
    progress: Callable[[int], None] = lambda angles: None,
) -> Motion:
    """Solve a drive at torques and crank angles, and find the positions of all bodies and contacts.

    Parameters
    ----------
    pair, surface
        The nominal pair, on its stated bearings, and its errors.
    torque
        Torques of the environment on the output, counter-clockwise positive, N·m, shape (torques,); at 0 the output is
        in the middle of its play.
    crank_angle
        Crank angles, rad, shape (angles,).
    exaggeration
        Enlargement of the gaps; None for the largest round number for which all of them fit.
    with_curve
        Whether to solve the transmission error over a crank turn as well; otherwise `curve` and `swept` are empty.
    progress
        Called with the number of crank angles (times loads) that were just finished.

    Raises
    ------
    edge.InputError
        If a torque can't be carried.
    """
    pair, surface = drive.pair, drive.surface
    loads, theta = np.array(torque, dtype=float, ndmin=1), np.array(crank_angle, dtype=float, ndmin=1)
    slices = drive.slices
    turn = mesh_angles(pair.pins) if with_curve else np.zeros(0)
    evenly = np.linspace(0.0, 2.0 * np.pi, ANGLES if with_curve else 0, endpoint=False)
    curve, swept = (solve(drive, loads, each, slices, with_play=False).transmission_error for each in (turn, evenly))
    found = solve(drive, loads, theta, slices, with_play=False)
    problem = (mesh_of if pair.supports is None else problem_of)(drive, slices)
    warm = pair.at_temperature
    tilted = dimensions(pair, surface)
    middle = complex(tilted["centre_x"], tilted["centre_y"]) if pair.supports is None else 0j
    profile = _profile(warm, tilted, problem)
    crank = theta[:, None] + problem.crank_phase
    ideal_ring = theta / pair.pins if problem.ring else np.zeros(theta.size)
    ideal_gear = -problem.crank_phase / pair.gear_teeth + np.zeros(crank.shape)
    if not problem.ring:
        ideal_gear = -crank / pair.gear_teeth
    x = found.transmission_error
    shift, turned = np.zeros((*x.shape, pair.discs), complex), np.zeros((*x.shape, pair.discs))
    if isinstance(found, OnBearings):
        shift, turned = found.disc_shift_x + 1j * found.disc_shift_y, found.disc_turn
    centre = problem.eccentricity * np.exp(1j * crank) + middle + shift
    rotation = ideal_gear + turned + (0.0 if problem.ring else x[..., None])
    ring = np.exp(1j * (ideal_ring + (x if problem.ring else 0.0 * x)))
    pin_axis = ring[..., None] * (problem.pin_x + 1j * problem.pin_y)
    contacts = _contacts(problem, warm, tilted, found, shift, turned, centre, rotation, pin_axis, middle, progress)
    motion = Motion(
        warm,
        loads,
        theta,
        x,
        turn,
        curve,
        swept,
        1.0,
        *profile,
        centre,
        rotation,
        ideal_gear,
        pin_axis,
        problem.pin_radius,
        *contacts,
        found.pin_pressure,
    )
    return dataclasses.replace(motion, exaggeration=exaggeration or _fitting(motion))


def _made(warm: Pair, sizes: dict[str, float]) -> Pair:
    """Return a pair whose drawn flank is the flank as made, without form deviations."""
    return warm.nominal.replace(
        isometric=float(sizes["generating_pin_radius"]) - warm.pin_radius,
        offset=float(sizes["generating_circle_radius"]) - warm.pin_circle_radius,
    )


def _points(pair: Pair, alpha: Array) -> tuple[Points, Points]:
    (x, y), (nx, ny) = flank_points(pair, alpha), flank_normals(pair, alpha)
    return x + 1j * y, nx + 1j * ny


def _profile(warm: Pair, sizes: dict[str, float], problem: contact.Problem) -> tuple[Points, Points, Points, Points]:
    """Tooth 0 without modification and as drawn, its normals, and every tooth as it was made."""
    pitch = 2.0 * np.pi / warm.gear_teeth
    alpha = np.concatenate([[0.0], equal_arc_parameters(warm, PROFILE - 2), [pitch]])
    plain = warm.nominal.replace(isometric=0.0, offset=0.0)
    unmodified, normal = _points(plain, alpha)
    tooth = np.arange(warm.gear_teeth)[None, :, None]
    disc = np.arange(warm.discs)[:, None, None]
    made = _flank(problem, _made(warm, sizes), disc, problem.centre_x.size // 2, tooth, alpha)
    return unmodified, _points(warm, alpha)[0], normal, made


def _flank(
    problem: contact.Problem, made: Pair, disc: Indices, slice_: Indices | int, tooth: Indices, along: Array
) -> Points:
    """Points of teeth as made, in their disc's frame, m; `along` is the profile parameter from the first root, rad."""
    point, normal = _points(made, along)
    if problem.deviations is not None:
        places, heights = problem.deviations.flank_alpha, problem.deviations.gear
        after = np.clip(np.searchsorted(places, along), 1, places.size - 1)
        share = (along - places[after - 1]) / (places[after] - places[after - 1])
        low, high = heights[disc, slice_, tooth, after - 1], heights[disc, slice_, tooth, after]
        point = point + ((1.0 - share) * low + share * high) * normal
    turn = 2.0 * np.pi * tooth / made.gear_teeth + problem.tooth_turn[disc, tooth]
    return np.asarray(point * np.exp(1j * turn))


def _contacts(
    problem: contact.Problem,
    warm: Pair,
    sizes: dict[str, float],
    found: Transmission,
    shift: Points,
    turned: Array,
    centre: Points,
    rotation: Array,
    pin_axis: Points,
    middle: complex,
    progress: Callable[[int], None],
) -> tuple[Array, Array, Points, Points]:
    """Gap, force, nearest point of the flank and direction of every pin's contacts, of `Motion`."""
    # Wide as the arrays of the placed bodies are what a motion consists of, of which this returns the last.
    places = (*found.transmission_error.shape, warm.discs, warm.pins, 2)
    gap, force = np.full(places, np.inf), np.zeros(places)
    touching, direction = np.zeros(places, complex), np.zeros(places, complex)
    made, pitch = _made(warm, sizes), 2.0 * np.pi / warm.gear_teeth
    slices = problem.centre_x.size
    disc, pin, side = np.indices(places[2:])
    offset = problem.centre_x + 1j * problem.centre_y - (middle if warm.supports is None else 0.0)
    rows = contact.contact_rows(problem)
    here = problem._replace(shift_x=np.zeros(warm.discs), shift_y=np.zeros(warm.discs), turn=np.zeros(warm.discs))
    for at in np.ndindex(places[:2]):
        theta, x = float(found.crank_angle[at[1]]), float(found.transmission_error[at])
        here.shift_x[:], here.shift_y[:], here.turn[:] = shift[at].real, shift[at].imag, turned[at]
        contact.place_contacts(here, theta, x, rows, True, math.inf, math.inf)
        rows["force"] = 0.0
        if isinstance(found, OnBearings) and found.compliance.shape[-1] > 0:
            # Elastic bodies press elsewhere than their mean motions overlap; each pin is on the nearer of two teeth.
            each = rows.reshape(warm.discs, warm.pins, 2)
            nearer = each["gap"].argmin(axis=-1)
            each["force"][disc[..., 0], pin[..., 0], nearer] = found.pin_force[at]
        elif found.pin_pressure[at].any():  # otherwise the output is free in its play
            _press(here, rows)
        by_slice = rows.reshape(warm.discs, slices, warm.pins, 2)
        # Without contact, the slice with the smallest gap.
        best = np.where(by_slice["force"].any(axis=1), by_slice["force"].argmax(axis=1), by_slice["gap"].argmin(axis=1))
        chosen = by_slice[disc, best, pin, side]
        gap[at], force[at] = chosen["gap"], by_slice["force"].sum(axis=1)
        near = np.isfinite(chosen["gap"])
        alpha = chosen["profile_parameter"][near]
        number = np.floor(alpha / pitch).astype(np.int64)
        point = _flank(here, made, disc[near], best[near], number % warm.gear_teeth, alpha - number * pitch)
        point = centre[at][disc[near]] + offset[best[near]] + np.exp(1j * rotation[at][disc[near]]) * point
        apart = point - pin_axis[at][pin[near]]
        touching[at][near], direction[at][near] = point, apart / np.abs(apart)
        progress(1)
    return gap, force, touching, direction


def _press(problem: contact.Problem, rows: contact.Rows) -> None:
    """Write the force of every row, as `contact.equilibrium.load` does within kernels."""
    for row in np.flatnonzero(rows["gap"] + problem.seat_gap < 0.0):
        pin = row // 2 % problem.pin_x.size
        rows["force"][row], _, _ = contact.hertz(
            -float(rows["gap"][row]) - problem.seat_gap,
            float(rows["curvature"][row]),
            float(problem.pin_radius[pin]),
            problem.slice_width,
            problem.compliance_gear,
            problem.compliance_pin,
            problem.largest_log_radius,
            0.0,
            problem.seat_compliance,
        )


def _fitting(motion: Motion) -> float:
    largest = float(np.abs(motion.nearest).max())  # interference is enlarged as well
    if not largest * LARGEST_FACTOR > motion.room:
        return LARGEST_FACTOR
    return max(1.0, round_number(motion.room / largest))


def round_number(largest: float) -> float:
    """Return the largest of 1, 2, 5, 10 and so on that is not above a number."""
    power = 10.0 ** math.floor(math.log10(largest))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= largest * (1.0 + 1e-9)))
