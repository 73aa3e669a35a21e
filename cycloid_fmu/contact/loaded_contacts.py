"""Every contact that carries load in a sweep over the crank angle, with what wear needs of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import check_balance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoadedContacts:
    """Every contact that carries load in a sweep at one torque; arrays without a stated shape are (contacts,), SI.

    Attributes
    ----------
    crank_angle, transmission_error
        Shape (angles,): rad, and the transmission error under load, rad.
    shift, turn
        Of each disc, shape (angles, discs): shift of its centre from the ideal one, complex in the housing's frame (m),
        and its rotation beyond the transmission error (rad); 0 on rigid bearings.
    angle, disc, slice_, pin, tooth
        Indices: crank angle, disc, slice, pin, and the tooth touched.
    phase
        φ, the pin's angle from the crank, in -π to π, rad.
    profile_parameter
        Profile parameter of the contact on its tooth, 0 to 2π/z_c, rad.
    pin_direction
        Direction of the contact about the pin's axis from that to the pin circle's centre, > 0 counter-clockwise, rad.
    force, moment_arm, approach
        N; -∂gap/∂(rotation of the output), m; by how far flank and pin overlap as rigid bodies, m: on rigid bearings
        Hertz's δ, otherwise with what seats and elastic bodies give way and with a seat's clearance.
    half_width, pressure, radius
        Hertz's a and largest pressure 2F/(πab), Pa; equivalent radius ρ*, m.
    pin_axis, normal
        The pin's axis from the gear's centre (m) and the flank's normal, complex in the housing's frame.
    gear_curvature
        1/ρ_c, > 0 convex, 1/m.
    """

    crank_angle: Array
    transmission_error: Array
    shift: NDArray[np.complex128]
    turn: Array
    angle: NDArray[np.int64]
    disc: NDArray[np.int64]
    slice_: NDArray[np.int64]
    pin: NDArray[np.int64]
    tooth: NDArray[np.int64]
    phase: Array
    profile_parameter: Array
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
    transmission_error = np.empty(crank_angle.size)
    table = np.empty((crank_angle.size, contact.contact_rows(drive).size), contact.ROW)
    contact.sweep_contacts(drive, crank_angle, torque, transmission_error, table)
    check_balance(torque, np.array([contact.carried(rows) for rows in table]))
    still = np.zeros((crank_angle.size, drive.crank_phase.size))
    return contacts_of(drive, crank_angle, transmission_error, still.astype(np.complex128), still, table)


def contacts_of(
    drive: contact.Problem,
    crank_angle: Array,
    transmission_error: Array,
    shift: NDArray[np.complex128],
    turn: Array,
    table: contact.Rows,
) -> LoadedContacts:
    """Return the contacts that carry load of solved rows, shape (angles, rows); the others as in `LoadedContacts`."""
    angle, row = np.nonzero(table["force"] > 0.0)
    loaded = table[angle, row]
    pins, teeth = drive.teeth + 1, drive.teeth
    disc, slice_, pin = np.unravel_index(row // 2, (drive.crank_phase.size, drive.centre_x.size, pins))
    angle_of_crank, x = crank_angle[angle], transmission_error[angle]
    crank = angle_of_crank + drive.crank_phase[disc]
    ring = angle_of_crank / pins + x if drive.ring else np.zeros(x.size)
    gear = -drive.crank_phase[disc] / teeth if drive.ring else x + turn[angle, disc] - crank / teeth
    pitch = 2.0 * np.pi / teeth
    alpha = loaded["profile_parameter"]
    tooth = np.floor(alpha / pitch).astype(np.int64)
    profile_parameter, tooth = alpha - tooth * pitch, tooth % teeth
    # Flank and normal in the gear's frame: a curve parallel to the generating path (docs/theory/contact.md).
    wave = drive.generating_eccentricity * np.exp(1j * teeth * alpha)
    normal = np.exp(1j * alpha) * (1.0 - wave * pins / drive.circle_radius)
    normal /= np.abs(normal)
    flank = (drive.circle_radius - wave) * np.exp(1j * alpha) - drive.generating_radius * normal
    turned = np.exp(1j * (gear + drive.tooth_turn[disc, tooth]))
    axis = (drive.pin_x + 1j * drive.pin_y)[pin] * np.exp(1j * ring)
    centre = drive.eccentricity * np.exp(1j * crank) + (drive.centre_x + 1j * drive.centre_y)[slice_]
    centre += shift[angle, disc]
    inwards = -np.exp(1j * (2.0 * np.pi * pin / pins + ring))
    force, compliance = loaded["force"], drive.compliance_gear + drive.compliance_pin
    radius = 1.0 / np.maximum(np.abs(1.0 / drive.pin_radius[pin] + loaded["curvature"]), 1e-9)
    half = np.sqrt(4.0 * force * radius * compliance / (np.pi * drive.slice_width))
    phase = 2.0 * np.pi * pin / pins + ring - crank
    return LoadedContacts(
        crank_angle,
        transmission_error,
        shift,
        turn,
        angle,
        disc,
        slice_,
        pin,
        tooth,
        (phase + np.pi) % (2.0 * np.pi) - np.pi,
        profile_parameter,
        np.angle((flank * turned - axis + centre) / inwards),
        force,
        loaded["arm"],
        -loaded["gap"],
        half,
        2.0 * force / (np.pi * half * drive.slice_width),
        radius,
        axis - centre,
        normal * turned,
        loaded["curvature"],
    )


def contact_ratio(contacts: LoadedContacts) -> float:
    """Mean number of pins of disc 0 in contact, 1: the length of a pin's mesh under load over the pin pitch."""
    first = contacts.disc == 0
    pairs = np.unique(np.stack([contacts.angle[first], contacts.pin[first]]), axis=1)
    return float(pairs.shape[1]) / contacts.crank_angle.size
