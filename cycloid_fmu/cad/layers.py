"""Layers of a disc's drawing besides the outline, in mm."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu import edge

if TYPE_CHECKING:
    from cycloid_fmu.cad.outline import Array, Points
    from cycloid_fmu.cad.profile import Profile

LAYERS = ("DISC", "PINS", "RING", "HOLES")
MM = 1e3
_CROSS = 0.01  # of the pin circle's radius: half the size of the cross at a hole whose radius is not stated


def about(profile: Profile) -> dict[str, str]:
    """Return the description of a profile for its file, {name: text}."""
    return {
        "pair": profile.pair.hash,
        "disc": str(profile.disc),
        "chord error": edge.format_quantity(profile.chord_error, "m", "um"),
        "frame": "disc axis at the origin, axes at crank angle 0, mm, 20 degC",
    }


def crosses(profile: Profile) -> Iterator[tuple[complex, complex]]:
    """Yield the ends, in mm, of the lines that mark the centres of holes whose radius is not stated."""
    arm = MM * _CROSS * profile.ring_radius
    for place, radius in zip(MM * profile.hole_place, profile.hole_radius, strict=True):
        if math.isnan(radius):
            for way in (arm, 1j * arm):
                yield complex(place - way), complex(place + way)


def circles(profile: Profile) -> Iterator[tuple[str, complex, float]]:
    """Yield layer, centre and radius, in mm, of each pin, the pin circle and each hole whose radius is stated."""
    for place, radius in zip(profile.pin_place, profile.pin_radius, strict=True):
        yield "PINS", MM * complex(place), MM * float(radius)
    yield "RING", MM * profile.ring_place, MM * profile.ring_radius
    for place, radius in zip(profile.hole_place, profile.hole_radius, strict=True):
        if not math.isnan(radius):
            yield "HOLES", MM * complex(place), MM * float(radius)


def outlines(profile: Profile) -> Iterator[tuple[str, Points, Array]]:
    """Yield layer, starts, in mm, and bulges of the arcs of the flank and of each hole that is no circle."""
    yield "DISC", MM * profile.start, profile.bulge
    for start, bulge in profile.windows:
        yield "HOLES", MM * start, bulge


def corners(profile: Profile) -> tuple[complex, complex]:
    """Return the lower left and the upper right corner of the drawing, m."""
    places = np.concatenate([profile.start, profile.pin_place])
    beyond = np.concatenate([np.zeros(profile.start.size), profile.pin_radius])
    return (
        complex((places.real - beyond).min(), (places.imag - beyond).min()),
        complex((places.real + beyond).max(), (places.imag + beyond).max()),
    )
