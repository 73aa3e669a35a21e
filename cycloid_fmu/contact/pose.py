"""Where disc, pins and teeth are at a crank angle: the pin's axis in the gear's frame, and the tooth that it faces."""

from __future__ import annotations

import math
from typing import NamedTuple

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.gap import Flank
from cycloid_fmu.contact.lanes import sine_cosine
from cycloid_fmu.contact.problem import Problem, poses


class DiscPose(NamedTuple):
    """Where a disc and the pin ring are: rotations, and centres in the gear's frame."""

    shift: float  # of the conjugate points, rad
    number: int  # of the tooth that pin 0 faces
    tooth: int  # the same within one turn
    along: float  # pin 0's conjugate point on it, in pitches from its beginning
    ring_cosine: float  # of the ring's rotation in the gear's frame
    ring_sine: float
    cosine: float  # of the gear
    sine: float
    x: float  # the gear's centre, m, in the housing's frame
    y: float
    crank_x: float  # the crank's part of it, in the gear's frame
    crank_y: float


class PinAxis(NamedTuple):
    """A pin's axis from the gear's centre, and that centre from the pin circle's, in the gear's frame, m."""

    x: float
    y: float
    centre_x: float
    centre_y: float


class FacedTooth(NamedTuple):
    """The tooth that a pin faces."""

    number: int  # counted on over the turns of the gear
    along: float  # the pin's conjugate point on it, in pitches from its beginning
    tooth: int
    beyond: int  # the tooth across the nearest root


class Tooth(NamedTuple):
    """Ends of the tooth that a pin faces, and of the one across the nearest root."""

    number: float
    beyond: float
    turn: float  # rad, by pitch errors
    turn_beyond: float
    phase: float  # from the root, rad
    near: bool  # whether the pin may touch the tooth beyond as well
    root: float  # profile parameters, rad
    inwards: float  # direction from the root into the tooth
    extent: float  # where the two teeth meet, from the root
    lower: float  # ends of the tooth
    upper: float


@compiled(inline=True)
def disc_pose(problem: Problem, eccentricity: float, crank_angle: float, x: float, disc: int) -> DiscPose:
    """Where a disc and the pin ring are at a crank angle and transmission error, on a crank of an eccentricity (m)."""
    crank, ring, gear = poses(problem, crank_angle, x, disc)
    s, c = sine_cosine(gear)
    ring_sine, ring_cosine = sine_cosine(ring - gear)
    oy, ox = sine_cosine(crank)
    oy, ox = eccentricity * oy, eccentricity * ox
    teeth = problem.teeth
    shift = (crank - ring) / teeth
    pitches = shift * teeth / (2.0 * math.pi)
    number = math.floor(pitches)
    return DiscPose(
        shift,
        number,
        number % teeth,
        pitches - number,
        ring_cosine,
        ring_sine,
        c,
        s,
        ox + problem.shift_x[disc],
        oy + problem.shift_y[disc],
        ox * c + oy * s,
        oy * c - ox * s,
    )


@compiled(inline=True)
def pin_axis(pose: DiscPose, pin_x: float, pin_y: float, centre_x: float, centre_y: float) -> PinAxis:
    """Axis of the pin at (pin_x, pin_y) in the ring's frame, of a gear whose centre is displaced, m."""
    px = pin_x * pose.ring_cosine - pin_y * pose.ring_sine
    py = pin_x * pose.ring_sine + pin_y * pose.ring_cosine
    ux, uy = pose.x + centre_x, pose.y + centre_y
    cx, cy = ux * pose.cosine + uy * pose.sine, uy * pose.cosine - ux * pose.sine
    return PinAxis(px - cx, py - cy, cx, cy)


@compiled(inline=True)
def conjugate_point(pose: DiscPose, teeth: int, pin: int) -> float:
    """Profile parameter at which the ideal pin touches the ideal flank, rad."""
    return pin * 2.0 * math.pi / (teeth + 1) + pose.shift


@compiled(inline=True)
def faced_tooth(pose: DiscPose, teeth: int, pin: int) -> FacedTooth:
    """Return the tooth that a pin faces."""
    # The conjugate points of neighbouring pins are a pin's pitch apart, which is less than a tooth's.
    passed = pin / (teeth + 1.0)
    steps = pin if passed <= pose.along else pin - 1
    along = pose.along - passed + (0.0 if passed <= pose.along else 1.0)
    tooth = _within_turn(pose.tooth + steps, teeth)
    return FacedTooth(pose.number + steps, along, tooth, _within_turn(tooth - 1 if along < 0.5 else tooth + 1, teeth))


@compiled(inline=True)
def _within_turn(tooth: int, teeth: int) -> int:
    tooth = tooth - teeth if tooth >= teeth else tooth
    return tooth + teeth if tooth < 0 else tooth


@compiled(inline=True)
def tooth_ends(number: float, along: float, turn: float, turn_beyond: float, teeth: int, root_phase: float) -> Tooth:
    """Ends of the tooth that a pin faces, from its conjugate point on it and the turns of it and its neighbour."""
    pitch = 2.0 * math.pi / teeth
    before = along < 0.5
    phase = 2.0 * math.pi * (along if before else 1.0 - along)
    near = phase < root_phase
    lower, upper = number * pitch, (number + 1.0) * pitch
    # Two teeth end where they meet, midway between where pitch errors leave the root of each.
    extent = 0.5 * (turn_beyond - turn) if near else 0.0
    return Tooth(
        number,
        number - 1.0 if before else number + 1.0,
        turn,
        turn_beyond,
        phase,
        near,
        root=lower if before else upper,
        inwards=1.0 if before else -1.0,
        extent=extent,
        lower=lower + extent if before else lower,
        upper=upper if before else upper + extent,
    )


@compiled(inline=True)
def around_root(flank: Flank, margin: float) -> tuple[float, float]:
    """Distance from the path within which a point near a root has one foot only (m), and the margin as a parameter."""
    R, pins = flank.circle_radius, flank.teeth + 1
    k = flank.eccentricity * pins / R
    return R * (1.0 - k) ** 2 / max(pins * k - 1.0, 1e-9) - margin, margin / (R * (1.0 - k))
