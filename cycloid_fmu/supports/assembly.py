"""What holds the discs: bearings, cranks and holes as numbers and arrays."""

from __future__ import annotations

from typing import NamedTuple

from cycloid_fmu.contact import Array
from cycloid_fmu.supports.bearing import Bearing


class Assembly(NamedTuple):
    """The parts that hold discs and carrier, SI; axes and angles as docs/theory/supports.md.

    Attributes
    ----------
    cranks
        Whether cranks hold the discs and carry the load to the carrier; else one eccentric holds them and rollers in
        their holes carry the load.
    eccentricity
        Nominal e, m.
    place_x, place_y
        Cranks or output rollers in the carrier, and their holes in the discs, as drawn, shape (count,), m.
    crank_x, crank_y
        Errors of their places in the carrier, shape (count,), m.
    hole_x, hole_y
        Errors of the holes' places in each disc, shape (discs, count), m.
    hole_play
        Of output rollers: by how much more than e a hole lets its roller move, shape (discs, count), m.
    throw, phase
        Errors of each eccentric's throw (m) and phase (rad), shape (discs, cranks), of one crank with output rollers.
    seat_x, seat_y
        Place of the housing's seats of main bearing and central crank, m.
    turning_arm, crank_shaft, main, output_roller
        The bearings; an output roller's clearance is in `hole_play`.
    rotation_scale
        A radius that makes a rotation a displacement, m.
    balanced
        What may be left of a balance, N.
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
