"""Many drives to first order in their errors: what screens a tolerance study before the exact model confirms it.

At each crank angle and load one drive, the error-free pair for a study, is solved exactly, once. Other drives' errors
then change the gaps linearly, by the displacement of pin and flank along the common normal; arms and gaps follow the
rotation to second order, Hertz's law is exact, and the equilibrium is solved for each drive. What is left out is how
the errors change normals and curvatures. An identification finds its start in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact import compiled, part
from cycloid_fmu.contact.compiling import allocating
from cycloid_fmu.contact.hertz import PRESSED, hertz_in_lanes
from cycloid_fmu.contact.lanes import LANES, on_stack, vectors
from cycloid_fmu.contact.sensitivity import (
    BODY_COUNT,
    CENTRE_X,
    CENTRE_Y,
    CIRCLE_GENERATING,
    CRANK_THROW,
    PIN_GENERATING,
    TILT_X,
    TILT_Y,
)  # fmt: skip
from cycloid_fmu.contact.transmission import drive_of, solve
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface, nominal_surface

Array = NDArray[np.float64]
(
    _GAP, _ARM, _RATE, _CURVATURE, _RADIAL, _TANGENTIAL, _X, _Y, _HEIGHT, _CRANK, _FACING, _TURN, _PIN, _TOOTH,
    _COLUMNS,
) = range(15)  # fmt: skip
_STEP = 1e-8  # rad: Newton's last step of an equilibrium, after which the square of it is left
_NEAR = 1e-4  # rad: contacts that touch within this rotation are looked at in each step; others when it was passed


class Contacts(NamedTuple):
    """A drive's contacts at each crank angle, from which drives near it are taken to first order.

    Attributes
    ----------
    rows, number
        Contacts nearer than the reach, shape (angles, contacts, columns), and how many there are, shape (angles,).
    deviation
        Rotation at which they were solved, shape (angles,), rad.
    torque
        N·m; 0 for the middle of the play.
    """

    rows: Array
    number: NDArray[np.int64]
    deviation: Array
    torque: float


def contacts_of(
    pair: Pair, surface: ErrorSurface, torque: float, crank_angle: Array, slices: int, reach: float
) -> Contacts:
    """Solve a drive and keep the contacts whose gap is below the reach (m).

    Parameters
    ----------
    pair, surface
        The drive.
    torque
        N·m on the output; at 0 the contacts are those at the middle of the play.
    crank_angle
        Shape (angles,), rad.
    slices
        Across the face width.
    reach
        By how much further errors and their rotation may close a gap, m.
    """
    drive = drive_of(pair, surface, slices)
    kept = np.zeros((crank_angle.size, contact.contact_rows(drive).size, _COLUMNS))
    count = np.zeros(crank_angle.size, dtype=np.int64)
    deviation = solve(pair, surface, [torque], crank_angle, slices, with_play=False).transmission_error[0]
    _near(drive, np.ascontiguousarray(crank_angle), deviation, reach, kept, count)
    return Contacts(np.ascontiguousarray(kept[:, : max(int(count.max()), 1)]), count, deviation, float(torque))


@compiled
def _near(
    drive: contact.Problem, thetas: Array, deviation: Array, reach: float, kept: Array, count: NDArray[np.int64]
) -> None:
    contacts = contact.contact_rows(drive)
    for i in range(thetas.size):
        x = deviation[i]
        contact.place(drive, thetas[i], x, contacts, i == 0, math.inf, reach)
        number = 0
        for row in range(contacts.shape[0]):
            if not contacts[row].gap < reach:
                continue
            local = contact.local_frame(drive, thetas[i], x, contacts, row)
            c, s = math.cos(local.direction), math.sin(local.direction)
            nx, ny = local.normal_x, local.normal_y
            one = kept[i, number]
            one[_GAP], one[_ARM], one[_RATE] = contacts[row].gap, contacts[row].arm, contacts[row].arm_rate
            one[_CURVATURE] = contacts[row].curvature
            one[_RADIAL], one[_TANGENTIAL] = nx * c + ny * s, ny * c - nx * s
            one[_X], one[_Y], one[_HEIGHT] = nx, ny, drive.slice_z[local.slice]
            one[_CRANK] = nx * local.crank_x + ny * local.crank_y
            one[_FACING] = local.facing
            one[_TURN] = nx * local.gear_y - ny * local.gear_x
            one[_PIN], one[_TOOTH] = local.pin, local.disc * drive.teeth + local.tooth
            number += 1
        count[i] = number


@part
def _gaps(rows: Array, count: int, pins: int, errors: Array, gaps: Array) -> None:
    """Gaps of drives with further errors at the rotation of the contacts, shape (contacts, drives).

    `errors` has the shape (errors, drives): loops over neighbouring drives become vector instructions, two of them,
    because the compiler gives up where it must compare too many arrays. So, with `_NEAR` and Hertz's law in lanes,
    drives are screened 2.2 times as fast.
    """
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    for k in range(count):
        one = rows[k]
        pin, tooth = int(one[_PIN]), BODY_COUNT + 3 * pins + int(one[_TOOTH])
        gap, by_radial, by_tangential, by_turn = one[_GAP], one[_RADIAL], one[_TANGENTIAL], one[_TURN]
        for j in range(errors.shape[1]):
            gaps[k, j] = (
                gap + by_radial * errors[radial + pin, j] + by_tangential * errors[tangential + pin, j]
                - errors[radius + pin, j] + by_turn * errors[tooth, j]
            )  # fmt: skip
        x, y, height, crank, facing = one[_X], one[_Y], one[_HEIGHT], one[_CRANK], one[_FACING]
        for j in range(errors.shape[1]):
            gaps[k, j] += (
                errors[PIN_GENERATING, j] - facing * errors[CIRCLE_GENERATING, j] - crank * errors[CRANK_THROW, j]
                - x * (errors[CENTRE_X, j] + height * errors[TILT_X, j])
                - y * (errors[CENTRE_Y, j] + height * errors[TILT_Y, j])
            )  # fmt: skip


class _Work(NamedTuple):
    """Memory of the equilibria, written and read within one."""

    gaps: Array  # (contacts, drives), at the rotation of the contacts, m
    forces: Array  # (contacts,), N
    near: NDArray[np.int64]  # numbers of the contacts that may touch, then those that do
    pressed: NDArray[np.int64]


@allocating
def _work(contacts: Contacts, drives: int) -> _Work:
    size = contacts.rows.shape[1]
    return _Work(
        np.empty((size, drives)), np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64),
    )  # fmt: skip


@part
def _equilibrium(
    rows: Array, count: int, drive: int, work: _Work, torque: float, start: float, pin_radius: float, width: float,
    compliance_gear: float, compliance_pin: float, largest_log_radius: float,
) -> tuple[float, float]:  # fmt: skip
    """Rotation that balances the torque, from that of the contacts, and the largest pressure."""
    gaps, forces, near, pressed = work.gaps, work.forces, work.near, work.pressed
    one = on_stack(PRESSED)
    x, low, high, listed_at = start, -math.inf, math.inf, math.inf
    listed = touching = 0
    farther = math.inf
    for k in range(count):
        forces[k] = 0.0
    for _ in range(60):
        if abs(x - listed_at) > _NEAR:
            listed_at = x
            listed = 0
            farther = math.inf
            for k in range(count):
                arm, rate = rows[k, _ARM], rows[k, _RATE]
                gap, now = gaps[k, drive] - x * (arm + 0.5 * x * rate), arm + x * rate
                if gap < _NEAR * (abs(now) + _NEAR * abs(rate)):
                    near[listed] = k
                    listed += 1
                    continue
                forces[k] = 0.0
                if now * torque > 0.0:
                    farther = min(farther, gap / abs(now))
        moment = stiffness = 0.0
        touch = farther if farther < math.inf else 0.0
        touching = 0
        for at in range(listed):
            k = near[at]
            arm, rate = rows[k, _ARM], rows[k, _RATE]
            gap = gaps[k, drive] - x * (arm + 0.5 * x * rate)
            if gap < 0.0:
                pressed[touching] = k
                touching += 1
                continue
            forces[k] = 0.0
            now = arm + x * rate
            if now * torque > 0.0:
                touch = min(touch, gap / abs(now))
        for first in range(0, touching, LANES):
            filled = min(LANES, touching - first)
            for lane in range(vectors(filled)):
                k = pressed[min(first + lane, touching - 1)]
                one.approach[lane] = x * (rows[k, _ARM] + 0.5 * x * rows[k, _RATE]) - gaps[k, drive]
                one.curvature[lane], one.pin_radius[lane] = rows[k, _CURVATURE], pin_radius
                one.force[lane] = forces[k]
            hertz_in_lanes(one, filled, width, compliance_gear, compliance_pin, largest_log_radius, 0.0)
            for lane in range(filled):
                k = pressed[first + lane]
                rate = rows[k, _RATE]
                arm = rows[k, _ARM] + x * rate
                forces[k] = one.force[lane]
                moment += one.force[lane] * arm
                stiffness += one.stiffness[lane] * arm * arm + one.force[lane] * rate
        if torque > moment:
            low = x
        else:
            high = x
        step = (torque - moment) / stiffness if stiffness > 0.0 else math.copysign(touch + 1e-6, torque - moment)
        if abs(step) < _STEP:
            x += step
            break
        step = min(max(step, -1e-3), 1e-3)
        x = x + step if low < x + step < high else 0.5 * (low + high)
    pressure = 0.0
    for at in range(touching):
        k = pressed[at]
        if forces[k] > 0.0:
            half = contact.half_width(
                forces[k], rows[k, _CURVATURE], pin_radius, width, compliance_gear, compliance_pin
            )
            pressure = max(pressure, 2.0 * forces[k] / (math.pi * half * width))
    return x, pressure


@compiled
def sweep(
    contacts: Contacts, pins: int, teeth: int, errors: Array, pin_radius: float, width: float, compliance_gear: float,
    compliance_pin: float, largest_log_radius: float, deviation: Array, pressure: Array,
) -> None:  # fmt: skip
    """Solve the loaded contact of many drives.

    Parameters
    ----------
    contacts
        At the load.
    errors
        Shape (drives, errors), rows of `displacement_vector` minus that of the contacts' drive.
    deviation, pressure
        Overwritten, shape (drives, angles): rotation (rad) and largest contact pressure (Pa).
    """
    drives = errors.shape[0]
    side_by_side, work = errors.T.copy(), _work(contacts, drives)
    turned, before = np.zeros(drives), np.zeros(drives)
    for i in range(contacts.number.size):
        rows, count = contacts.rows[i], contacts.number[i]
        _gaps(rows, count, pins, side_by_side, work.gaps)
        for j in range(drives):
            start = 2.0 * turned[j] - before[j] if i > 1 else turned[j]
            before[j] = turned[j]
            turned[j], pressure[j, i] = _equilibrium(
                rows, count, j, work, contacts.torque, start, pin_radius, width, compliance_gear, compliance_pin,
                largest_log_radius,
            )  # fmt: skip
            deviation[j, i] = contacts.deviation[i] + turned[j]


@compiled
def _sweep_sensitivities(
    contacts: Contacts, pins: int, teeth: int, errors: Array, pin_radius: float, width: float, compliance_gear: float,
    compliance_pin: float, largest_log_radius: float, torque: Array, deviation: Array, each: Array, by_torque: Array,
) -> None:  # fmt: skip
    one_drive, work = errors.copy().reshape(errors.size, 1), _work(contacts, 1)
    gaps, forces = work.gaps, work.forces
    x = 0.0
    for i in range(contacts.number.size):
        rows, count, out = contacts.rows[i], contacts.number[i], each[i]
        _gaps(rows, count, pins, one_drive, gaps)
        x, _ = _equilibrium(
            rows, count, 0, work, torque[i], x, pin_radius, width, compliance_gear, compliance_pin, largest_log_radius
        )
        deviation[i] = contacts.deviation[i] + x
        stiffness = 0.0
        for column in range(out.size):
            out[column] = 0.0
        for k in range(count):
            if forces[k] <= 0.0:
                continue
            one = rows[k]
            arm = one[_ARM] + x * one[_RATE]
            force, spring, _ = contact.hertz(
                0.5 * x * x * one[_RATE] + x * one[_ARM] - gaps[k, 0], one[_CURVATURE], pin_radius, width,
                compliance_gear, compliance_pin, largest_log_radius, forces[k], 0.0,
            )  # fmt: skip
            stiffness += spring * arm * arm + force * one[_RATE]
            opened = spring * arm
            pin, tooth = int(one[_PIN]), int(one[_TOOTH])
            out[CENTRE_X] -= opened * one[_X]
            out[CENTRE_Y] -= opened * one[_Y]
            out[TILT_X] -= opened * one[_X] * one[_HEIGHT]
            out[TILT_Y] -= opened * one[_Y] * one[_HEIGHT]
            out[CRANK_THROW] -= opened * one[_CRANK]
            out[PIN_GENERATING] += opened
            out[CIRCLE_GENERATING] -= opened * one[_FACING]
            out[BODY_COUNT + pin] += opened * one[_RADIAL]
            out[BODY_COUNT + pins + pin] += opened * one[_TANGENTIAL]
            out[BODY_COUNT + 2 * pins + pin] -= opened
            out[BODY_COUNT + 3 * pins + tooth] += opened * one[_TURN]
        for column in range(out.size):
            out[column] /= stiffness
        by_torque[i] = 1.0 / stiffness


def sensitivities(
    pair: Pair, contacts: Contacts, slices: int, errors: Array, torque: Array
) -> tuple[Array, Array, Array]:
    """Solve one drive near that of the contacts, with the derivatives of its transmission error.

    Parameters
    ----------
    pair, contacts, slices
        The nominal pair and what `contacts_of` found.
    errors
        `displacement_vector` of the drive minus that of the contacts' drive.
    torque
        At each crank angle, shape (angles,), N·m, not 0.

    Returns
    -------
    transmission_error
        Shape (angles,), rad.
    each
        By every single error, columns as in `contact.sensitivities`.
    by_torque
        Shape (angles,), rad/(N·m).
    """
    g, angles = pair, contacts.number.size
    teeth = g.discs * g.gear_teeth
    each = np.empty((angles, BODY_COUNT + 3 * g.pins + teeth))
    deviation, by_torque = np.empty(angles), np.empty(angles)
    _sweep_sensitivities(contacts, g.pins, teeth, errors, *_law(pair, slices), torque, deviation, each, by_torque)
    return deviation, each, by_torque


@compiled
def sweep_play(
    contacts: Contacts, pins: int, teeth: int, errors: Array, low: Array, high: Array, interference: Array
) -> None:
    """Solve the play of many drives; overwrites arrays (drives, angles) as `contact.sweep_play` does."""
    side_by_side, gaps = errors.T.copy(), np.empty((contacts.rows.shape[1], errors.shape[0]))
    for i in range(contacts.number.size):
        rows, count, deviation = contacts.rows[i], contacts.number[i], contacts.deviation[i]
        _gaps(rows, count, pins, side_by_side, gaps)
        for j in range(errors.shape[0]):
            below, above = -math.inf, math.inf
            for k in range(count):
                arm = rows[k, _ARM]
                inside = arm * arm + 2.0 * rows[k, _RATE] * gaps[k, j]
                if arm == 0.0 or inside < 0.0:
                    continue
                root = 2.0 * gaps[k, j] / (arm + math.copysign(math.sqrt(inside), arm))
                if arm > 0.0:
                    above = min(above, root)
                else:
                    below = max(below, root)
            low[j, i], high[j, i] = deviation + below, deviation + above
            interference[j, i] = 0.0
            if below > above:
                deepest = _deepest(rows, count, gaps[:, j], above, below)
                if deepest > contact.TOUCHING:
                    low[j, i] = high[j, i] = math.nan
                    interference[j, i] = deepest


@part
def _deepest(rows: Array, count: int, gaps: Array, first: float, last: float) -> float:
    """Interference at the rotation between two where the smallest gap is largest, by halving where it turns."""
    worst = 0.0
    for _ in range(40):
        x = 0.5 * (first + last)
        worst, falling = math.inf, False
        for k in range(count):
            gap = gaps[k] - x * (rows[k, _ARM] + 0.5 * x * rows[k, _RATE])
            if gap < worst:
                worst, falling = gap, rows[k, _ARM] > 0.0
        if falling:
            last = x
        else:
            first = x
    return -worst


def _law(pair: Pair, slices: int) -> tuple[float, float, float, float, float]:
    """Return what Hertz's law takes of a pair."""
    g, material = pair, pair.material
    largest_log_radius = g.pin_circle_radius if g.contact_law == "capped" else math.inf
    return (g.pin_radius, g.face_width / slices, material.gear.compliance, material.pin.compliance,
            largest_log_radius)  # fmt: skip


_Drives = TypeVar("_Drives", contravariant=True)


class NearDrives(Protocol[_Drives]):
    """Drives near those that were solved: at several loads, by their errors or what stands for them."""

    def loaded(self, sweep_number: int, drives: _Drives, /) -> tuple[Array, Array]:
        """Return transmission error (rad) and largest pressure (Pa), each (drives, angles)."""

    def play(self, sweep_number: int, drives: _Drives, /) -> tuple[Array, Array]:
        """Return backlash (rad, NaN without a free position) and interference (m), each (drives, angles)."""


class Screen:
    """The error-free pair at a study's loads and crank angles, ready to take drives from.

    Parameters
    ----------
    pair
        The nominal pair.
    loads
        (torque N·m, crank angles rad), one a sweep; torque 0 is the play.
    slices, reach
        As in `contacts_of`.
    """

    def __init__(self, pair: Pair, loads: Sequence[tuple[float, Array]], slices: int, reach: float) -> None:
        g, error_free = pair, nominal_surface(pair)
        self.pair = pair
        self._contacts = [contacts_of(pair, error_free, torque, angles, slices, reach) for torque, angles in loads]
        self._sizes, self._law = (g.pins, g.discs * g.gear_teeth), _law(pair, slices)

    def loaded(self, sweep_number: int, errors: Array) -> tuple[Array, Array]:
        """Return transmission error (rad) and largest pressure (Pa), each of shape (drives, angles)."""
        contacts = self._contacts[sweep_number]
        deviation, pressure = (np.empty((len(errors), contacts.number.size)) for _ in range(2))
        sweep(contacts, *self._sizes, errors, *self._law, deviation, pressure)
        return deviation, pressure

    def play(self, sweep_number: int, errors: Array) -> tuple[Array, Array]:
        """Return backlash (rad, NaN without a free position) and interference (m), each (drives, angles)."""
        contacts = self._contacts[sweep_number]
        low, high, gap = (np.empty((len(errors), contacts.number.size)) for _ in range(3))
        sweep_play(contacts, *self._sizes, errors, low, high, gap)
        return high - low, gap
