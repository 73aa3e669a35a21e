"""Rolling and sliding of gear and pins where they touch: velocities, slip coefficients, sliding distance.

All velocities are per radian of the pin ring relative to the crank: the paper holds the crank, turns the ring at
ω_1 and the gear at ω_1 z_p/z_c. They are along the flank, > 0 towards decreasing profile parameter, the direction of
the contact's motion on the gear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact.loaded_contacts import LoadedContacts
from cycloid_fmu.geometry.pair import Pair

Array = NDArray[np.float64]


class Velocities(NamedTuple):
    """Velocities at contacts, m per radian of the ring relative to the crank.

    `pin` and `gear` are the velocities of the contact along the pin and along the flank (the paper's v_1r and v_2r),
    and `sliding` is their difference v_12 = v_2r - v_1r, the sliding velocity of the surfaces.
    """

    pin: Array
    gear: Array
    sliding: Array

    @property
    def gear_slip(self) -> Array:
        """σ_1 = v_12/v_2r, the slip coefficient of the gear (1)."""
        return self.sliding / self.gear

    @property
    def pin_slip(self) -> Array:
        """σ_2 = -v_12/v_1r, the slip coefficient of the pin (1); infinite where the contact reverses on the pin."""
        with np.errstate(divide="ignore"):
            return -self.sliding / self.pin


def ideal_velocities(pair: Pair, phase: ArrayLike) -> Velocities:
    """Velocities of the unmodified pair, in closed form.

    Parameters
    ----------
    pair
        The pair; its modification is ignored.
    phase
        φ, the pin's angle from the crank, rad.

    Notes
    -----
    loaded-contact-wear section 3.3 written out: v_1r = R_rp K (cos φ - K)/S², v_12 = (R_p S - R_rp)/z_c, with
    K = e z_p/R_p and S = sqrt(1 + K² - 2K cos φ) (docs/theory/wear.md).
    """
    g, cosine = pair, np.cos(np.asarray(phase, dtype=float))
    k = g.eccentricity * g.pins / g.pin_circle_radius
    stretch = 1.0 + k * k - 2.0 * k * cosine
    along_pin = g.pin_radius * k * (cosine - k) / stretch
    sliding = (g.pin_circle_radius * np.sqrt(stretch) - g.pin_radius) / g.gear_teeth
    return Velocities(along_pin, along_pin + sliding, sliding)


def slip_pole(pair: Pair) -> float:
    """Pin's angle from the crank at which the unmodified pair's contact reverses on the pin, cos φ = K, rad.

    There the pin's slip coefficient is infinite and the gear's is 1; it is where the moment arm is largest.
    """
    g = pair
    return float(np.arccos(g.eccentricity * g.pins / g.pin_circle_radius))


def velocities(drive: contact.Problem, contacts: LoadedContacts) -> Velocities:
    """Velocities at solved contacts, of modified flanks and with the rates of transmission error and disc's motion.

    Notes
    -----
    Seen from the gear the pin's axis moves with velocity w. The flank's point nearest to it, of curvature 1/ρ_c, moves
    along the flank by w·t/(1 + R_rp/ρ_c); the sliding is w·t minus the pin's own rotation.
    """
    teeth = drive.teeth
    angle, disc = contacts.angle, contacts.disc
    rate = np.gradient(contacts.transmission_error, contacts.crank_angle)[angle]
    moved, turned = (
        np.gradient(of, contacts.crank_angle, axis=0)[angle, disc] for of in (contacts.shift, contacts.turn)
    )
    ring = 1.0 / (teeth + 1) + rate if drive.ring else np.zeros(rate.size)
    gear = np.zeros(rate.size) if drive.ring else rate + turned - 1.0 / teeth
    crank = contacts.crank_angle[angle] + drive.crank_phase[disc]
    centre = 1j * drive.eccentricity * np.exp(1j * crank)
    # The pins move with the ring about its centre; all positions are relative to the gear's centre, which moves.
    held = (drive.eccentricity * np.exp(1j * crank)) + (drive.centre_x + 1j * drive.centre_y)[contacts.slice_]
    axis = 1j * ring * (contacts.pin_axis + held) - centre - moved - 1j * gear * contacts.pin_axis
    along = -(axis * np.conj(1j * contacts.normal)).real
    radius = drive.pin_radius[contacts.pin]
    per_ring = ring - 1.0
    over_gear = along / (1.0 + radius * contacts.gear_curvature) / per_ring
    sliding = (along + radius * (ring - gear)) / per_ring
    return Velocities(over_gear - sliding, over_gear, sliding)
