"""Tooth contact analysis: every pin's own transmission error unloaded, their envelope, and a pin's mesh under load.

Unloaded, the paper's two vector equations (position and normal of both flanks, loaded-contact-wear equation 13) say
that the pin's axis lies on the curve parallel to the flank at the pin's radius. A rotation of the output leaves the
distance of the axis from the centre of that rotation as it is; so one scalar equation gives the flank's parameter, and
the angle between both points the rotation. On the flank from a tooth's root to its tip that distance only grows, on
the flank behind it only falls: each has one solution or none, and which flank bears follows from the side alone.

Where elements deviate, form and roughness or wear, a flank has many tangents to a pin. There every point of the flank
says at which rotation it would meet the pin, in closed form, and the first to do so is the contact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import carried, check_balance, drive_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UnloadedContact:
    """Unloaded contact of each pin alone, SI.

    Attributes
    ----------
    crank_angle
        Shape (angles,), rad.
    pin_error
        Each pin's own transmission error curve: the output's deviation at which that pin and its flank touch, shape
        (angles, discs, pins), rad; NaN where a rotation brings none of that flank to the pin.
    profile_parameter
        α of the flank's point in contact, on tooth 0, shape as `pin_error`, rad.
    transmission_error
        The comprehensive curve, shape (angles,), rad: where the first pin touches.
    disc, pin
        Which one that is, shape (angles,).
    """

    crank_angle: Array
    pin_error: Array
    profile_parameter: Array
    transmission_error: Array
    disc: NDArray[np.int64]
    pin: NDArray[np.int64]


def unloaded_contact(pair: Pair, surface: ErrorSurface, crank_angle: ArrayLike, side: int) -> UnloadedContact:
    """Solve the tangency of every pin at every crank angle at once.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors, taken at mid-width.
    crank_angle
        rad, shape (angles,).
    side
        Sign of the torque that seats the flanks, -1 or 1.

    Raises
    ------
    ValueError
        If `side` is neither.

    Notes
    -----
    loaded-contact-wear equations 5 to 13. For the ring as output the rotation is about the pin circle's centre.
    """
    if side not in (-1, 1):
        raise ValueError(f"side = {side}: it must be -1 or 1, the sign of the torque")
    drive = drive_of(pair, surface)
    theta = np.atleast_1d(np.asarray(crank_angle, dtype=float))[:, None, None]
    teeth = drive.teeth
    crank = theta + drive.crank_phase[None, :, None]
    gear = -drive.crank_phase[None, :, None] / teeth + 0.0 * theta if drive.ring else -crank / teeth
    ring = theta / (teeth + 1) if drive.ring else 0.0
    axis = (drive.pin_x + 1j * drive.pin_y)[None, None] * np.exp(1j * ring)
    centre = drive.eccentricity * np.exp(1j * crank) + complex(drive.centre_x[0], drive.centre_y[0])
    reach = np.broadcast_to(drive.pin_radius - drive.generating_radius, (theta.shape[0], crank.shape[1], teeth + 1))
    # The flank whose normal opposes a rotation to this side: before a tooth's tip, or behind it. The pin lies in the
    # gap between two tips, and of that gap one flank is such.
    half = math.pi / teeth
    behind = (side > 0) != drive.ring
    first = half if behind else 0.0
    from_gear = (axis - centre) * np.exp(-1j * gear)
    gap = np.floor(np.angle(from_gear) / (2.0 * half) + 0.5).astype(np.int64)
    tooth = gap - 1 if behind else gap
    turn = 2.0 * half * tooth + drive.tooth_turn[np.arange(crank.shape[1])[None, :, None], tooth % teeth]
    turned = np.exp(1j * (gear + turn)) if drive.ring else np.exp(1j * turn)
    with np.errstate(invalid="ignore"):  # NaN where there is no contact
        if drive.deviations is not None:
            alpha, error = np.empty(from_gear.shape), np.empty(from_gear.shape)
            pin = np.arange(teeth + 1)
            if drive.ring:
                seen = (axis / turned, centre / turned, np.exp(1j * (2.0 * np.pi * pin / pin.size + ring)) / turned)
            else:
                facing = np.exp(1j * (2.0 * np.pi * pin / pin.size - gear)) / turned
                seen = (from_gear / turned, np.zeros_like(turned), facing)
            axis, offset, outwards = np.broadcast_arrays(*seen)
            _first_touches(
                drive, drive.deviations, axis, offset, outwards, tooth % teeth, first, float(side), alpha, error
            )
        elif drive.ring:
            alpha = _where_radius(drive, reach, np.abs(axis), first, first + half, centre / turned)
            error = np.angle((_parallel(drive, alpha, reach).point * turned + centre) / axis)
        else:
            alpha = _where_radius(drive, reach, np.abs(from_gear), first, first + half, 0.0)
            error = np.angle(from_gear / (_parallel(drive, alpha, reach).point * turned))
    flat = np.where(np.isnan(error), math.inf, side * error).reshape(theta.shape[0], -1)
    touching_pin = flat.argmin(axis=1)
    smallest = flat[np.arange(flat.shape[0]), touching_pin]
    return UnloadedContact(
        theta[:, 0, 0],
        error,
        alpha,
        np.where(np.isinf(smallest), math.nan, side * smallest),
        touching_pin // (teeth + 1),
        touching_pin % (teeth + 1),
    )


@contact.compiled
def _first_touches(
    drive: contact.Problem,
    deviations: contact.Deviations,
    axis: NDArray[np.complex128],
    offset: NDArray[np.complex128],
    outwards: NDArray[np.complex128],
    tooth: NDArray[np.int64],
    first: float,
    side: float,
    alpha: Array,
    error: Array,
) -> None:
    """Write the rotation at which each pin meets its flank with deviations, and the flank's parameter there.

    Parameters
    ----------
    axis, offset, outwards, tooth
        Pin's axis, the gear's centre, both from the centre of rotation, and the direction from the pin circle's centre
        to the pin, turned into the frame of tooth 0; the tooth; shape (angles, discs, pins).
    first
        Parameter at which the flank begins; it is half a tooth long.
    """
    elements = deviations.flank_alpha.size - 2
    begin = np.searchsorted(deviations.flank_alpha, first + 1e-12) if first > 0.0 else 0
    end = begin + elements // 2 + 1
    error[:] = math.nan
    alpha[:] = math.nan
    rotation, nominal = np.empty(elements + 2), np.empty(elements + 2)
    for i, disc, pin in np.ndindex(axis.shape):
        where = (axis[i, disc, pin], offset[i, disc, pin], outwards[i, disc, pin], disc, tooth[i, disc, pin], pin, side)
        best = begin
        for point in range(begin, end):
            rotation[point] = _touch_rotation(drive, deviations, where, point, deviations.flank_alpha[point], 1.0)
            nominal[point] = _touch_rotation(drive, deviations, where, point, deviations.flank_alpha[point], 0.0)
            if rotation[point] < rotation[best]:
                best = point
        if not begin < best < end - 1:
            continue
        # How far below its ends a piece between two points may come.
        sag = 0.25 * abs(nominal[best + 1] - 2.0 * nominal[best] + nominal[best - 1])
        smallest, at = rotation[best], deviations.flank_alpha[best]
        for point in range(begin, end - 1):
            if min(rotation[point], rotation[point + 1]) - sag > smallest:
                continue
            low, high = deviations.flank_alpha[point], deviations.flank_alpha[point + 1]
            for _ in range(40):
                left, right = high - 0.618034 * (high - low), low + 0.618034 * (high - low)
                at_left = _touch_rotation(drive, deviations, where, point, left, 1.0)
                if at_left < _touch_rotation(drive, deviations, where, point, right, 1.0):
                    high = right
                else:
                    low = left
            middle = _touch_rotation(drive, deviations, where, point, 0.5 * (low + high), 1.0)
            if middle < smallest:
                smallest, at = middle, 0.5 * (low + high)
        error[i, disc, pin] = side * smallest
        alpha[i, disc, pin] = at


_Where = tuple[Any, Any, Any, int, Any, int, float]


@contact.part
def _touch_rotation(
    drive: contact.Problem, deviations: contact.Deviations, where: _Where, point: int, alpha: float, raised: float
) -> float:
    """Rotation of the output, times the side, at which a point of the flank meets its pin; infinite if it never does.

    The point lies at α between the flank's points `point` and the next; `raised` is 1 with the deviations, 0 without.
    """
    axis, offset, outwards, disc, tooth, pin, side = where
    after = min(point + 1, deviations.flank_alpha.size - 1)
    span = deviations.flank_alpha[after] - deviations.flank_alpha[point]
    share = (alpha - deviations.flank_alpha[point]) / span if span > 0.0 else 0.0
    heights = deviations.gear[disc, 0, tooth]
    height = raised * ((1.0 - share) * heights[point] + share * heights[after])
    pins, R, e = drive.teeth + 1, drive.circle_radius, drive.generating_eccentricity
    k = e * pins / R
    turn = complex(math.cos(alpha), math.sin(alpha))
    wave = complex(math.cos(drive.teeth * alpha), math.sin(drive.teeth * alpha))
    normal = turn * (1.0 - k * wave) / abs(1.0 - k * wave)
    place = (R - e * wave) * turn - (drive.generating_radius - height) * normal + offset
    # The pin goes round, by the output's rotation if it is the ring and against it if it is the gear.
    sense = side if drive.ring else -side
    distances, apart = abs(place) * abs(axis), place * axis.conjugate()
    between = math.atan2(apart.imag, apart.real)
    pin_height, rotation = 0.0, math.inf
    for _ in range(5):
        reach = drive.pin_radius[pin] + pin_height
        cosine = (abs(place) ** 2 + abs(axis) ** 2 - reach * reach) / (2.0 * distances)
        if abs(cosine) > 1.0:
            return math.inf
        rotation = between - sense * math.acos(cosine)
        if raised == 0.0:
            break
        moved = complex(math.cos(rotation), math.sin(rotation))
        facing = (axis * moved - place) * (outwards * moved).conjugate()
        seen = (math.atan2(facing.imag, facing.real) / math.pi + 0.5) * deviations.pin.shape[2] - 0.5
        low = min(max(math.floor(seen), 0), deviations.pin.shape[2] - 2)
        part = min(max(seen - low, 0.0), 1.0)
        last = pin_height
        pin_height = (1.0 - part) * deviations.pin[0, pin, low] + part * deviations.pin[0, pin, low + 1]
        if abs(pin_height - last) < 1e-14:
            break
    return sense * rotation


@dataclass(frozen=True)
class Handovers:
    """Where one pin takes the unloaded contact over from another; every array has shape (handovers,).

    Attributes
    ----------
    crank_angle
        rad.
    leaving, entering
        Number of the pins, disc x pins + pin.
    leaving_phase, entering_phase
        Their angles φ from the crank, in -π to π, rad: ends of their mesh intervals.
    """

    crank_angle: Array
    leaving: NDArray[np.int64]
    entering: NDArray[np.int64]
    leaving_phase: Array
    entering_phase: Array


def handovers(pair: Pair, surface: ErrorSurface, crank_angle: ArrayLike, side: int) -> Handovers:
    """Find the crank angles at which the comprehensive curve passes from one pin to another.

    Parameters are those of `unloaded_contact`; the crank angles should be so close that at most one handover lies
    between two of them. Without errors a pin's mesh interval is one pin pitch long (loaded-contact-wear, section 5.1).
    """
    found = unloaded_contact(pair, surface, crank_angle, side)
    pins = pair.pins
    number = found.disc * pins + found.pin
    at = np.flatnonzero(number[1:] != number[:-1])
    leaving, entering = number[at], number[at + 1]
    low, high = found.crank_angle[at], found.crank_angle[at + 1]
    each = np.arange(at.size)
    for _ in range(48):
        middle = 0.5 * (low + high)
        error = side * unloaded_contact(pair, surface, middle, side).pin_error.reshape(at.size, -1)
        before = error[each, leaving] < error[each, entering]
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    phases = (phase_of_pin(pair, low, who // pins, who % pins) for who in (leaving, entering))
    return Handovers(low, leaving, entering, *phases)


def phase_of_pin(pair: Pair, crank_angle: ArrayLike, disc: ArrayLike, pin: ArrayLike) -> Array:
    """Angle φ of a pin from its disc's crank, in -π to π, rad; the output without error."""
    g = pair
    theta = np.asarray(crank_angle, dtype=float)
    ring = theta / g.pins if g.output == "ring" else 0.0
    angle = 2.0 * np.pi * np.asarray(pin) / g.pins + ring - theta - 2.0 * np.pi * np.asarray(disc) / g.discs
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


@dataclass(frozen=True)
class LoadedContacts:
    """Every contact that carries load in a sweep at one torque; arrays without a stated shape are (contacts,), SI.

    Attributes
    ----------
    crank_angle, deviation
        Shape (angles,): rad, and the output's deviation, the loaded transmission error, rad.
    angle, disc, slice_, pin, tooth
        Indices: crank angle, disc, slice, pin, and the tooth touched.
    phase
        φ, the pin's angle from the crank, in -π to π, rad.
    place
        Profile parameter of the contact on its tooth, 0 to 2π/z_c, rad.
    pin_direction
        Direction of the contact about the pin's axis from that to the pin circle's centre, > 0 counter-clockwise, rad.
    force, moment_arm, approach
        N; -∂gap/∂(rotation of the output), m; Hertz's δ, m.
    half_width, pressure, radius
        Hertz's a and largest pressure 2F/(πab), Pa; equivalent radius ρ*, m.
    pin_axis, normal
        The pin's axis from the gear's centre (m) and the flank's normal, complex in the housing's frame.
    gear_curvature
        1/ρ_c, > 0 convex, 1/m.
    """

    crank_angle: Array
    deviation: Array
    angle: NDArray[np.int64]
    disc: NDArray[np.int64]
    slice_: NDArray[np.int64]
    pin: NDArray[np.int64]
    tooth: NDArray[np.int64]
    phase: Array
    place: Array
    pin_direction: Array
    force: Array
    moment_arm: Array
    approach: Array
    half_width: Array
    pressure: Array
    radius: Array
    pin_axis: NDArray[np.complex128]
    normal: NDArray[np.complex128]
    gear_curvature: Array


def loaded_contacts(drive: contact.Problem, crank_angle: Array, torque: float) -> LoadedContacts:
    """Solve the equilibrium at every crank angle and return the contacts that carry load.

    Parameters
    ----------
    drive
        The contact problem (`transmission.drive_of`).
    crank_angle
        rad, shape (angles,); neighbours should be neighbours in the array.
    torque
        Of the environment on the output, not 0, N·m.

    Raises
    ------
    ValueError
        If the torque is 0, where there is play instead of an equilibrium; an `edge.InputError` if it is too large.

    Notes
    -----
    loaded-contact-wear equations 14 to 17; the clearance is taken up where the contact is, not on a linear path.
    """
    if torque == 0.0:
        raise ValueError("torque = 0: without load no contact carries any; it must not be zero")
    deviation = np.empty(crank_angle.size)
    table = np.empty((crank_angle.size, contact.contact_rows(drive).size), contact.ROW)
    contact.sweep_contacts(drive, crank_angle, torque, deviation, table)
    check_balance(torque, carried(table))
    angle, row = np.nonzero(table["force"] > 0.0)
    held = table[angle, row]
    pins, teeth = drive.teeth + 1, drive.teeth
    disc, slice_, pin = contact.disc_slice_pin(drive, row)
    theta, x = crank_angle[angle], deviation[angle]
    crank = theta + drive.crank_phase[disc]
    ring = theta / pins + x if drive.ring else np.zeros(theta.size)
    gear = -drive.crank_phase[disc] / teeth if drive.ring else x - crank / teeth
    pitch = 2.0 * np.pi / teeth
    alpha = held["place"]
    tooth = np.floor(alpha / pitch).astype(np.int64)
    place, tooth = alpha - tooth * pitch, tooth % teeth
    flank = _parallel(drive, alpha, np.array(-drive.generating_radius))
    turned = np.exp(1j * (gear + drive.tooth_turn[disc, tooth]))
    axis = (drive.pin_x + 1j * drive.pin_y)[pin] * np.exp(1j * ring)
    centre = drive.eccentricity * np.exp(1j * crank) + (drive.centre_x + 1j * drive.centre_y)[slice_]
    inwards = -np.exp(1j * (2.0 * np.pi * pin / pins + ring))
    force, both = held["force"], drive.compliance_gear + drive.compliance_pin
    radius = 1.0 / np.maximum(np.abs(1.0 / drive.pin_radius[pin] + held["curvature"]), 1e-9)
    half = np.sqrt(4.0 * force * radius * both / (np.pi * drive.slice_width))
    phase = 2.0 * np.pi * pin / pins + ring - crank
    return LoadedContacts(
        crank_angle,
        deviation,
        angle,
        disc,
        slice_,
        pin,
        tooth,
        (phase + np.pi) % (2.0 * np.pi) - np.pi,
        place,
        np.angle((flank.point * turned - axis + centre) / inwards),
        force,
        held["arm"],
        -held["gap"],
        half,
        2.0 * force / (np.pi * half * drive.slice_width),
        radius,
        axis - centre,
        -1j * flank.tangent * turned,
        held["curvature"],
    )


def contact_ratio(contacts: LoadedContacts) -> float:
    """Mean number of pins of disc 0 in contact, 1: the length of a pin's mesh under load over the pin pitch."""
    mine = contacts.disc == 0
    pairs = np.unique(np.stack([contacts.angle[mine], contacts.pin[mine]]), axis=1)
    return float(pairs.shape[1]) / contacts.crank_angle.size


def clearances(pair: Pair, surface: ErrorSurface, crank_angle: ArrayLike, side: int) -> Array:
    """Clearance of every pin while the first one touches without load, shape (angles, discs, pins), m.

    loaded-contact-wear equation 15, at mid-width; infinite where a pin has no nearest point on its teeth.
    """
    drive = drive_of(pair, surface)
    contacts = contact.contact_rows(drive)
    touching = unloaded_contact(pair, surface, crank_angle, side)
    found = np.empty(touching.pin_error.shape)
    for i, (theta, x) in enumerate(zip(touching.crank_angle, touching.transmission_error, strict=True)):
        contact.place(drive, theta, x, contacts, i == 0, math.inf, math.inf)
        found[i] = np.minimum(contacts["gap"][::2], contacts["gap"][1::2]).reshape(found[i].shape)
    return found


class _Parallel(NamedTuple):
    point: NDArray[np.complex128]
    tangent: NDArray[np.complex128]
    speed: Array


def _parallel(drive: contact.Problem, alpha: Array, reach: Array) -> _Parallel:
    """Point of the curve at `reach` outside the generating path, its tangent, and its arc length for each radian."""
    pins, R, e = drive.teeth + 1, drive.circle_radius, drive.generating_eccentricity
    k = e * pins / R
    stretch = np.sqrt(1.0 + k * k - 2.0 * k * np.cos(drive.teeth * alpha))
    normal = np.exp(1j * alpha) * (1.0 - k * np.exp(1j * drive.teeth * alpha)) / stretch
    bend = (1.0 + pins * k * k - k * (pins + 1) * np.cos(drive.teeth * alpha)) / (R * stretch**3)
    point = R * np.exp(1j * alpha) - e * np.exp(1j * pins * alpha) + reach * normal
    return _Parallel(point, 1j * normal, R * stretch * (1.0 + reach * bend))


def _where_radius(
    drive: contact.Problem,
    reach: Array,
    radius: Array,
    first: float,
    last: float,
    offset: NDArray[np.complex128] | float,
) -> Array:
    """Parameter in one flank at which the parallel curve, moved by `offset`, is at `radius` from the origin; or NaN."""

    def beyond(alpha: Array) -> tuple[Array, Array]:
        point, tangent, speed = _parallel(drive, alpha, reach)
        point = point + offset
        return np.abs(point) - radius, (point * np.conj(tangent)).real / np.abs(point) * speed

    shape = np.broadcast_shapes(radius.shape, reach.shape, np.shape(offset))
    low, high = (_turning(drive, reach, np.full(shape, end), offset) for end in (first, last))
    at_low, at_high = beyond(low)[0], beyond(high)[0]
    rising = np.sign(at_high - at_low)
    none = at_low * at_high > 0.0
    alpha = 0.5 * (low + high)
    for _ in range(60):
        value, slope = beyond(alpha)
        after = value * rising > 0.0
        low, high = np.where(after, low, alpha), np.where(after, alpha, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            following = alpha - value / slope
        following = np.where((following > low) & (following < high), following, 0.5 * (low + high))
        moved = np.abs(following - alpha).max()
        alpha = following
        if moved < 1e-16:
            break
    return np.where(none, math.nan, alpha)


def _turning(drive: contact.Problem, reach: Array, alpha: Array, offset: NDArray[np.complex128] | float) -> Array:
    """Parameter near a root or tip at which the distance from the origin is stationary: there itself without offset."""
    if isinstance(offset, float):
        return alpha
    step = 1e-6
    for _ in range(6):
        lever = [
            (q.point + offset) * np.conj(q.tangent) for q in (_parallel(drive, alpha + s, reach) for s in (-step, step))
        ]
        slope = (lever[1].real - lever[0].real) / (2.0 * step)
        alpha = alpha - 0.5 * (lever[0].real + lever[1].real) / slope
    return alpha
