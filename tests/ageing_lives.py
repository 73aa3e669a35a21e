"""Lives of drives by a second computation: Archard's wear on the second drive, bearings by a closed form, loads drawn.

Shares nothing with the product's wear: contacts and forces are `second_drive`'s, sliding is how a rigid disc's point
moves, worn flanks are cosine waves along the arc (smoothed with Lanczos' factors), worn pins are thinner ones.
"""

import dataclasses

import numpy as np
import second_drive

_BINS, _POINTS = 800, 24  # along a flank's arc; crank angles of one pin pitch
_SMALL = 1e-3  # of the lost motion's torque: the play is between such torques


def worn(made, depth, pin_depth, waves):
    """The body with flanks worn to a depth (bins along the arc), felt as so many waves, and pins worn evenly."""
    place = (np.arange(_BINS) + 0.5) / _BINS
    orders = np.arange(1, waves + 1)
    shape = 2.0 * np.cos(np.pi * orders[:, None] * place) @ depth / _BINS
    shape *= np.sinc(orders / (waves + 1.0))  # Lanczos: without it the edges of the worn part ring
    return dataclasses.replace(
        made,
        form=tuple(-shape),
        pin_radius=made.pin_radius - pin_depth,
        cut=(made.cut[0], made.cut[1] + float(depth.mean()), made.cut[2]),
    )


def rate(made, loads):
    """Depth along the arc of a flank, and of a pin all round, that a crank turn at k_0 = 1 m²/N wears (m)."""
    pins = made.pins.size
    theta = 2.0 * np.pi / pins * np.arange(_POINTS) / _POINTS
    depth, pin_depth = np.zeros(_BINS), 0.0
    for torque, share in loads:
        point, pin, _, s, force, bend, place = second_drive.contacts(made, theta, torque)
        # A point of the disc goes with its centre and turns about it.
        speed = 1j * made.throw * np.exp(1j * theta[point]) - 1j / made.teeth * place
        centre = made.throw * np.exp(1j * theta[point]) + made.axis
        normal = made.pins[pin] - centre - place
        slid = np.abs(np.imag(np.conj(normal) * speed)) / np.abs(normal)
        area = share * force / made.width * slid * (2.0 * np.pi / pins / _POINTS)
        at, arc = second_drive._along(s, made)
        radius = 1.0 / np.abs(1.0 / made.pin_radius[pin] + bend)
        half = np.sqrt(4.0 * force / made.width * radius * second_drive.GIVE / np.pi) / arc
        edges = np.arange(_BINS + 1) / _BINS
        u = np.clip((edges - at[:, None]) / half[:, None], -1.0, 1.0)
        part = np.diff(0.5 + (u * np.sqrt(1.0 - u * u) + np.arcsin(u)) / np.pi, axis=1)
        depth += pins / made.teeth * (area @ part) / (arc / _BINS)
        pin_depth += area.sum() / (2.0 * np.pi * made.pin_radius[0])
    return depth, pin_depth


def figures(made, rated):
    """Lost motion and backlash: means over a pin pitch, rad."""
    theta = 2.0 * np.pi / made.pins.size * np.arange(_POINTS) / _POINTS
    at = 0.03 * rated
    error = [second_drive.transmission_error(made, theta, t) for t in (at, -at, _SMALL * at, -_SMALL * at)]
    return {"lost_motion": float((error[0] - error[1]).mean()), "backlash": float((error[2] - error[3]).mean())}


def life(made, loads, rated, dose, steps, waves=40):
    """Figures over the dose k_0 N (m²/N): {figure: shape (steps + 1,)} at equal doses, by the midpoint rule."""
    depth, pin_depth, found = np.zeros(_BINS), 0.0, [figures(made, rated)]
    each = dose / steps
    for _ in range(steps):
        flank, pin = rate(worn(made, depth, pin_depth, waves), loads)
        flank, pin = rate(worn(made, depth + 0.5 * each * flank, pin_depth + 0.5 * each * pin, waves), loads)
        depth, pin_depth = depth + each * flank, pin_depth + each * pin
        found.append(figures(worn(made, depth, pin_depth, waves), rated))
    return {name: np.array([one[name] for one in found]) for name in found[0]}
