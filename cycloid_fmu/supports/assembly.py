"""Supports of the discs: bearings, cranks and holes as numbers and arrays."""

from __future__ import annotations

from typing import NamedTuple

from cycloid_fmu.contact import Array
from cycloid_fmu.supports.bearing import Bearing


class Assembly(NamedTuple):
    """The parts that hold discs and carrier, SI; axes and angles as in docs/theory/supports.md.

    Attributes
    ----------
    cranks
        Whether cranks hold the discs and transmit the load to the carrier; otherwise one eccentric holds them and
        rollers in their holes transmit the load.
    eccentricity
        Nominal eccentricity e, m.
    place_x, place_y
        Position of each crank or output roller in the carrier, and of its holes in the discs, as drawn, shape (count,),
        m.
    crank_x, crank_y
        Errors of these positions in the carrier, shape (count,), m.
    hole_x, hole_y
        Position errors of the holes in each disc, shape (discs, count), m.
    hole_play
        For output rollers: free motion of a roller in its hole beyond e, shape (discs, count), m.
    throw, phase
        Errors of each eccentric's throw (m) and phase (rad), shape (discs, cranks), with one crank for output rollers.
    seat_x, seat_y
        Position of the housing's seats of main bearing and central crank, m.
    turning_arm, crank_shaft, main, output_roller
        The bearings; an output roller's clearance is in `hole_play`.
    rotation_scale
        Radius that converts a rotation to a displacement, m, for convergence limits.
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
