"""The exact contact model at the nodes of tables: at many loads and crank angles, or at some of their places."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_FIRST_SLOPE = 0.125  # of the first torque: place of the slope at zero load, which Hertz's logarithm makes infinite
_AT_ONCE = 32_768  # states: the forces of all pins, of each, take 1.3 kB
_ASIDE = 0.3  # of the differences in the middle: below it those on one side decide


class Solved(NamedTuple):
    """The exact model, mirrored for one direction, at loads and crank angles, shape (loads, angles).

    No other output depends on contact count and pressure: they stay at the crank angles that were solved first.
    """

    transmission_error: Array32
    compliance: Array32
    pressure: Array32
    contact_count: Array32


class Rest(NamedTuple):
    """The drive without a load, each of shape (angles,); see `Transmission`.

    Attributes
    ----------
    low, high
        Ends of the play, rad.
    pressed
        Whether there is no play.
    transmission_error, stiffness, pressure, contact_count, crank_torque
        Values where there is no play; 0 elsewhere.
    """

    low: Array
    high: Array
    pressed: NDArray[np.bool_]
    transmission_error: Array
    stiffness: Array
    pressure: Array
    contact_count: Array
    crank_torque: Array


def at_rest(drive: DriveValue, angles: Array, workers: int = 1) -> Rest:
    """Solve the play, and the drive at rest where there is none: once for both directions."""
    slices = drive.slices
    free = solve(drive, [], angles, slices, workers=workers)
    rest = Rest(free.play_low, free.play_high, np.isnan(free.play_low), *np.zeros((5, angles.size)))
    here = np.flatnonzero(rest.pressed)
    if here.size:
        swept = solve(drive, [0.0], angles[here], slices, with_play=False, workers=workers)
        problem, crank_torque = rigid_problem(drive, slices), np.empty(here.size)
        contact.sweep_crank_side(problem, angles[here], swept.transmission_error[0], crank_torque, np.empty(here.size))
        rest.crank_torque[here] = crank_torque
        rest.transmission_error[here], rest.stiffness[here] = swept.transmission_error[0], swept.torsional_stiffness[0]
        rest.pressure[here], rest.contact_count[here] = swept.max_contact_pressure[0], swept.contact_count[0]
    return rest


def solved(
    drive: DriveValue,
    direction: float,
    loads: Array,
    angles: Array,
    rest: Rest | None = None,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
    following: float | None = None,
) -> Solved:
    """Solve the model at every load and crank angle; other arguments are those of `solved_at`."""
    load, angle = np.divmod(np.arange(loads.size * angles.size), angles.size)
    channels = solved_at(drive, direction, loads, angles, load, angle, rest, workers, progress, following)
    return Solved(*(channel.reshape(loads.size, angles.size) for channel in channels))


def solved_at(
    drive: DriveValue,
    direction: float,
    loads: Array,
    angles: Array,
    load: NDArray[np.intp],
    angle: NDArray[np.intp],
    rest: Rest | None = None,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
    following: float | None = None,
) -> Solved:
    """Solve the model at places of the grid of loads and crank angles; load 0 is the play's end or the rest without.

    Parameters
    ----------
    load, angle
        Index of each place's load and crank angle, shape (places,).
    following
        The slope at load 0 is taken towards this load, by default the second one.
    """
    # Wide as it takes places of a grid, and how the model is solved at them.
    pair = drive.pair
    node_loads = loads.copy()
    if loads[0] == 0.0:
        # On bearings the tangent at the first load ends at the play.
        node_loads[0] = (_FIRST_SLOPE if pair.supports is None else 1.0) * (following or loads[1])
    if pair.supports is None:
        # All loads of a crank angle one after another, up and down in turn: such neighbours are 1.8 times as fast.
        order = np.lexsort((np.where(angle % 2 == 0, load, -load), angle))
    else:
        order = np.arange(load.size)
    slices = drive.slices
    # Far finer than the tables' error; a drive whose pins and teeth all differ takes a gigabyte otherwise.
    nodes = Solved(*np.empty((len(Solved._fields), load.size), dtype=np.float32))
    for first in range(0, order.size, _AT_ONCE):
        some = order[first : first + _AT_ONCE]
        swept = solve(
            drive,
            direction * node_loads[load[some]][None],
            angles[angle[some]],
            slices,
            with_play=False,
            workers=workers,
            progress=progress,
        )
        nodes.transmission_error[some] = direction * swept.transmission_error[0]
        nodes.compliance[some] = 1.0 / swept.torsional_stiffness[0]
        nodes.pressure[some] = np.square(swept.max_contact_pressure[0])
        nodes.contact_count[some] = np.minimum(swept.contact_count[0], 255)
    if loads[0] == 0.0:
        assert rest is not None
        none = np.flatnonzero(load == 0)
        here = angle[none]
        pressed = rest.pressed[here]
        nodes.transmission_error[none] = direction * np.where(
            pressed, rest.transmission_error[here], (rest.high if direction > 0.0 else rest.low)[here]
        )
        nodes.compliance[none[pressed]] = 1.0 / rest.stiffness[here[pressed]]
        nodes.pressure[none], nodes.contact_count[none] = np.square(rest.pressure[here]), rest.contact_count[here]
    return nodes


def midway(values: Array32) -> tuple[Array32, Array32]:
    """Interpolate midway between equidistant values of a period, shape (angles,), and tell how far that may be off.

    Where a pin comes into contact the compliance nearly jumps. Of the cubics through four values on both sides of a
    middle, the one with no jump within its reach is taken (essentially non-oscillatory interpolation, A. Harten et al.,
    J. Comput. Phys. 71 (1987) 231). What tells of a jump is the larger of two neighbouring fourth differences, the
    least over their places that reach the middle: one alone may vanish beside a jump.
    """
    v = {k: np.roll(values, -k) for k in range(-2, 4)}
    fourth = np.abs(6.0 * v[0] - 4.0 * (v[-1] + v[1]) + v[-2] + v[2])
    pair = np.maximum(fourth, np.roll(fourth, -1))
    error_before, error_after = np.roll(pair, 2), np.roll(pair, -2)
    off = np.minimum(pair, np.minimum(np.roll(pair, 1), np.roll(pair, -1)))
    # The error of a cubic through one value on one side and three on the other is 1.7 times as large.
    one_sided_error = np.minimum(error_before, error_after)
    aside, before = one_sided_error < _ASIDE * off, error_before < error_after
    near, next_to = np.where(before, v[1], v[0]), np.where(before, v[0], v[1])
    beyond, last = np.where(before, v[-1], v[2]), np.where(before, v[-2], v[3])
    values_between = np.where(
        aside,
        (5.0 * near + 15.0 * next_to - 5.0 * beyond + last) / 16.0,
        (9.0 * (v[0] + v[1]) - v[-1] - v[2]) / 16.0,
    )
    return values_between, np.where(aside, 1.7 * one_sided_error, off)
