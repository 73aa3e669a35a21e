"""The contact problem: a drive as numbers and arrays."""

from __future__ import annotations

from typing import NamedTuple

from cycloid_fmu.contact.compiling import Array, compiled


class Deviations(NamedTuple):
    """Normal deviations of flanks and pins, > 0 material added, SI.

    Attributes
    ----------
    flank_alpha, flank_x, flank_y, flank_normal_x, flank_normal_y
        Profile parameter (rad), points (m) and normals of tooth 0 at its ends and its elements' middles, shape
        (elements + 2,).
    gear
        Deviation at those points, shape (discs, slices, teeth, elements + 2), m. Between the points it is linear in
        the parameter.
    pin
        Deviation at the middles of each pin's elements of equal angle, shape (slices, pins, elements), m.
    largest
        Sum of the largest deviations of gear and pins, m.
    gear_curvature, pin_curvature
        Curvature that the deviations add at the same places, > 0 convex, shapes as the deviations', 1/m; size 0 where
        none is counted.
    """

    flank_alpha: Array
    flank_x: Array
    flank_y: Array
    flank_normal_x: Array
    flank_normal_y: Array
    gear: Array
    pin: Array
    largest: float
    gear_curvature: Array
    pin_curvature: Array


class Problem(NamedTuple):
    """The contact problem as numbers and arrays, SI.

    Attributes
    ----------
    circle_radius, generating_radius, generating_eccentricity
        R, r and e of the flank that was made, m.
    eccentricity
        The crank's own eccentricity, m.
    teeth
        z_c; there is one pin more.
    ring
        Whether the pin ring is the output (the gear held) instead of the gear (the ring fixed).
    pin_x, pin_y, pin_radius
        Axis and radius of each pin in the ring's frame, shape (pins,), m.
    tooth_turn
        Rotation of each tooth about the gear's centre, shape (discs, teeth), rad.
    crank_phase
        Angle of each disc's crank ahead of disc 0's, shape (discs,), rad.
    centre_x, centre_y
        Offset of the gear's centre in each slice, shape (slices,), m.
    shift_x, shift_y, turn
        Where each disc stands off its place on a rigid crank: its centre (m) and its rotation beyond x (rad), shape
        (discs,). Zeros, unless bearings hold it (`cycloid_fmu.supports` writes them as it solves).
    slice_z
        Distance of each slice's middle from mid-width, shape (slices,), m.
    slice_width
        m.
    compliance_gear, compliance_pin
        (1 - ν²)/E, 1/Pa.
    largest_log_radius
        Limit of the flank's curvature radius in Hertz's logarithm, m; infinite for the law as printed.
    stray
        How far modifications and errors can take a pin's axis from the flank's generating path, m.
    seat_gap, seat_compliance
        Gap (m) and compliance (m/N, of one slice) of a pin in its seat; zeros where it is rigid.
    root_phase
        Phase from a root within which both its teeth are tried, rad.
    root_margin
        How far neighbouring teeth may stand apart at their root, m.
    deviations
        Where flanks or pins deviate from their nominal form; None compiles to kernels that know of none.
    """

    circle_radius: float
    generating_radius: float
    generating_eccentricity: float
    eccentricity: float
    teeth: int
    ring: bool
    pin_x: Array
    pin_y: Array
    pin_radius: Array
    tooth_turn: Array
    crank_phase: Array
    centre_x: Array
    centre_y: Array
    shift_x: Array
    shift_y: Array
    turn: Array
    slice_z: Array
    slice_width: float
    compliance_gear: float
    compliance_pin: float
    largest_log_radius: float
    stray: float
    seat_gap: float
    seat_compliance: float
    root_phase: float
    root_margin: float
    deviations: Deviations | None


class Drives(NamedTuple):
    """What errors change of a contact problem, of many drives: fields of `Problem`, with an axis of drives before."""

    circle_radius: Array
    generating_radius: Array
    eccentricity: Array
    pin_x: Array
    pin_y: Array
    pin_radius: Array
    tooth_turn: Array
    centre_x: Array
    centre_y: Array
    stray: Array
    root_phase: Array
    root_margin: Array


@compiled(inline=True)
def poses(problem: Problem, crank_angle: float, x: float, disc: int) -> tuple[float, float, float]:
    """Crank angle of a disc and rotations of ring and gear, at disc 0's crank angle and transmission error x, rad."""
    phase = problem.crank_phase[disc]
    if problem.ring:
        return crank_angle + phase, crank_angle / (problem.teeth + 1) + x, -phase / problem.teeth
    return crank_angle + phase, 0.0, x + problem.turn[disc] - (crank_angle + phase) / problem.teeth
