"""A gear on a tilted axis in three dimensions: its horizontal sections against upright pins, and their equilibrium.

The flank is extruded along the tilted axis and cut by horizontal planes, so a section is wider along the tilt. Gaps are
scanned point by point, arms are differences of gaps; only the flank's path and Hertz's law are those of `second_drive`.
"""

import dataclasses

import numpy as np
from scipy.optimize import brentq
from second_drive import _hertz, _trochoid

_SPAN = np.linspace(-0.15, 0.15, 1201)  # path parameter about the ideal contact, of 2π a tooth


def section(flank, centre, turn, tilt, height):
    """Points (complex, m) of a tilted gear's flank at a height above mid-width, m.

    Parameters
    ----------
    flank
        In the gear's frame, m.
    centre, turn
        Of the gear at mid-width: its place (m), and its rotation about the tilted axis as exp(ix).
    tilt
        Slope angle of the axis towards x (real) and y (imaginary), rad.
    """
    placed, angle = flank * turn, abs(tilt)
    towards = tilt / angle if angle > 0.0 else 1.0
    along, across = (placed * np.conj(towards)).real, (placed * np.conj(towards)).imag
    # Along the axis by this much a line of the extruded flank reaches the height.
    climb = (height + along * np.sin(angle)) / np.cos(angle)
    return centre + (along * np.cos(angle) + climb * np.sin(angle) + 1j * across) * towards


def transmission_error(made, theta, torque, tilt, slices):
    """Deviation of the output, rad, of a `second_drive.Body` whose gear is tilted by `tilt` (rad, complex)."""
    pins = made.pins.size
    ideal = theta - 2.0 * np.pi * np.arange(pins) / pins + 2.0 * np.pi * np.arange(pins)
    curve, first, second = _trochoid(ideal[:, None] + _SPAN, made)
    flank = curve + made.cut[1] * 1j * first / np.abs(first)
    path = np.imag(np.conj(first) * second) / np.abs(first) ** 3
    bend = path / (1.0 - path * made.cut[1])
    centre = made.throw * np.exp(1j * theta) + made.axis
    heights = made.width * ((np.arange(slices) + 0.5) / slices - 0.5)
    slice_ = dataclasses.replace(made, width=made.width / slices)
    row = np.arange(pins)

    def gaps(x):
        turn, found = np.exp(1j * (x - theta / made.teeth)), []
        for height in heights:
            apart = np.abs(section(flank, centre, turn, tilt, height) - made.pins[:, None])
            first = apart.argmin(axis=1)
            at = np.clip(first, 1, _SPAN.size - 2)
            before, nearest, after = (apart[row, at + k] for k in (-1, 0, 1))
            lowest = nearest - (before - after) ** 2 / (8.0 * (before - 2.0 * nearest + after))
            # A pin that is nearest to an end of the span is far from its contact.
            found.append((np.where(first == at, lowest, 1.0) - made.pin_radius, bend[row, at], made.pin_radius))
        return np.array(found).transpose(1, 0, 2)

    def unbalanced(x):
        gap, curvature, radius = gaps(x)
        touch = gap < 0.0
        arm = (gaps(x - 1e-7)[0] - gaps(x + 1e-7)[0])[touch] / 2e-7
        force, _ = _hertz(-gap[touch], curvature[touch], radius[touch], slice_)
        return float(force @ arm) - torque

    return brentq(unbalanced, *sorted((0.0, np.sign(torque) * 1.5e-3)), xtol=1e-11)
