"""Supports of the discs: bearings, cranks and holes as numbers and arrays."""

from __future__ import annotations

from typing import NamedTuple

from cycloid_fmu.contact import Array
from cycloid_fmu.supports.bearing import Bearing


class Assembly(NamedTuple):
    """The parts that hold discs and carrier, SI; axes and angles as docs/theory/supports.md.

    Attributes
    ----------
    cranks
        Whether cranks hold the discs and transmit the load to the carrier; otherwise one eccentric holds them and
        rollers in their holes transmit the load.
    eccentricity
        Nominal e, m.
    place_x, place_y
        Cranks or output rollers in the carrier, and their holes in the discs, as drawn, shape (count,), m.
    crank_x, crank_y
        Errors of their places in the carrier, shape (count,), m.
    hole_x, hole_y
        Errors of the holes' places in each disc, shape (discs, count), m.
    hole_play
        Of output rollers: free motion of a roller in its hole beyond e, shape (discs, count), m.
    throw, phase
        Errors of each eccentric's throw (m) and phase (rad), shape (discs, cranks), of one crank with output rollers.
    seat_x, seat_y
        Place of the housing's seats of main bearing and central crank, m.
    turning_arm, crank_shaft, main, output_roller
        The bearings; an output roller's clearance is in `hole_play`.
    rotation_scale
        Radius that converts a rotation to a displacement, m.
    balanced
        Tolerance of the balance, N.
    """

    cranks: bool
    eccentricity: float
    place_x: Array
    place_y: Array
    crank_x: Array
    crank_y: Array
    hole_x: Array
    hole_y: Array
    hole_play: Array
    throw: Array
    phase: Array
    seat_x: float
    seat_y: float
    turning_arm: Bearing
    crank_shaft: Bearing
    main: Bearing
    output_roller: float
    rotation_scale: float
    balanced: float
