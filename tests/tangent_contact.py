"""Unloaded contact of every pin by the wear paper's tangency: a second computation of the play's ends without gaps.

The paper's two vector equations (position and normal of both flanks, loaded-contact-wear equations 5 to 13) put the
pin's axis on the curve parallel to the flank at the pin's radius. A rotation of the output keeps the distance of the
axis from the centre of that rotation, so one scalar equation gives the flank's parameter, and the angle between both
points is the rotation. From a tooth's root to its tip that distance only grows, and behind it only falls: a bracket for
bisection. Flanks have no deviations of elements here; `element_pairs.py` is a second computation of those.
"""

import numpy as np

from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue


def unloaded_error(pair, surface, crank_angle, side):
    """Each pin's own transmission error, shape (angles, discs, pins), rad; NaN where its flank doesn't reach it.

    The sign of the torque that seats the flanks is `side`.
    """
    drive = rigid_problem(DriveValue(pair, surface))
    theta = np.asarray(crank_angle, dtype=float)[:, None, None]
    teeth, half = drive.teeth, np.pi / drive.teeth
    crank = theta + drive.crank_phase[None, :, None]
    gear = -drive.crank_phase[None, :, None] / teeth + 0.0 * theta if drive.ring else -crank / teeth
    axis = (drive.pin_x + 1j * drive.pin_y) * np.exp(1j * theta / (teeth + 1) * drive.ring) + 0.0 * crank
    centre = drive.eccentricity * np.exp(1j * crank) + complex(drive.centre_x[0], drive.centre_y[0])
    # The pin is in the gap between two tips. Of its two flanks that one bears whose normal opposes a rotation.
    behind = (side > 0) != drive.ring
    gap = np.floor(np.angle((axis - centre) * np.exp(-1j * gear)) / (2.0 * half) + 0.5).astype(int)
    tooth = gap - 1 if behind else gap
    turned = np.exp(1j * (gear + 2.0 * half * tooth + drive.tooth_turn[np.arange(pair.discs)[:, None], tooth % teeth]))
    # Of the gear as output the rotation is about its own centre, of the ring about that of the pin circle.
    offset, target = (centre / turned, axis / turned) if drive.ring else (0.0, (axis - centre) / turned)

    def parallel(alpha):
        wave = drive.generating_eccentricity * np.exp(1j * teeth * alpha)
        normal = np.exp(1j * alpha) * (1.0 - wave * (teeth + 1) / drive.circle_radius)
        path = (drive.circle_radius - wave) * np.exp(1j * alpha)
        return path + (drive.pin_radius - drive.generating_radius) * normal / np.abs(normal) + offset

    low = np.full(target.shape, half * behind)
    high = low + half
    rising = 1.0 - 2.0 * behind
    short = [rising * (np.abs(parallel(end)) - np.abs(target)) for end in (low, high)]
    for _ in range(55):
        middle = 0.5 * (low + high)
        beyond = rising * (np.abs(parallel(middle)) - np.abs(target)) > 0.0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    error = np.angle(target / parallel(low)) * (-1.0 if drive.ring else 1.0)
    return np.where((short[0] <= 0.0) & (short[1] >= 0.0), error, np.nan)


def first_touch(error, side):
    """The drive's own transmission error and the bearing pin's number, disc x pins + pin, shape (angles,)."""
    flat = side * np.where(np.isnan(error), side * np.inf, error).reshape(len(error), -1)
    return side * flat.min(axis=1), flat.argmin(axis=1)
