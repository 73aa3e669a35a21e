"""Drives near one that is solved, to first order in their errors: on the way to a fit's start, in a tenth of the time.

Contacts are not solved: errors change their gaps linearly, by the displacement of pin and flank along the common
normal. Arms and gaps follow the rotation to second order, Hertz's law is exact, and the equilibrium is that of each
drive. What is left out is how errors change normals and curvatures.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.analysis import solve
from cycloid_fmu.contact import ROW, Array, Problem, compiled, hertz
from cycloid_fmu.contact.equilibrium import LINEAR_STEP, touched_after
from cycloid_fmu.contact.sensitivity import (
    BODY_COUNT,
    CENTRE_X,
    CENTRE_Y,
    CIRCLE_GENERATING,
    CRANK_THROW,
    PIN_GENERATING,
    TILT_X,
    TILT_Y,
)
from cycloid_fmu.contact.side_by_side import GUIDE, guide_rows
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import displacement_vector

_ITERATIONS = 60
_COLUMNS = 11  # displacements that change a contact's gap: those of the bodies, of its pin and of its tooth


class NearDrive:
    """Drives near one that is solved under a torque.

    Parameters
    ----------
    drive
        The drive that is solved, on rigid bearings.
    torque
        N·m, not 0.
    angles
        Crank angles, shape (angles,), rad.

    Raises
    ------
    edge.InputError
        If the drive can't balance the torque.
    """

    def __init__(self, drive: DriveValue, torque: float, angles: Array) -> None:
        pair = drive.pair
        self._problem, self._errors = rigid_problem(drive, 1), displacement_vector(pair, drive.surface)
        self._transmission_error = solve(drive, [torque], angles, 1, with_play=False).transmission_error[0].copy()
        self._guide = np.zeros((angles.size, pair.discs * pair.pins), GUIDE)
        guide_rows(self._problem, angles, self._transmission_error, self._guide)

    def sensitivities(self, errors: Array, torque: Array) -> tuple[Array, Array, Array]:
        """Return the transmission error of one drive to first order, and its derivatives.

        Parameters
        ----------
        errors
            `displacement_vector` of the drive.
        torque
            At each crank angle, shape (angles,), N·m, not 0.

        Returns
        -------
        transmission_error
            Shape (angles,), rad.
        each
            By every single error, columns as in `contact.sensitivities`.
        by_torque
            Shape (angles,), rad/(N·m).
        """
        angles, contacts = self._guide.shape
        transmission_error, by_torque, each = np.empty(angles), np.empty(angles), np.zeros((angles, errors.size))
        _sweep(
            self._problem,
            self._guide,
            self._transmission_error,
            errors - self._errors,
            torque,
            np.zeros(contacts, ROW),
            transmission_error,
            each,
            by_torque,
        )
        return transmission_error, each, by_torque


@compiled
def _columns(guide: np.record, pin: int, pins: int) -> tuple[int, ...]:
    """Columns of a displacement vector that change the gap of a contact."""
    of_pin, of_tooth = BODY_COUNT + pin, BODY_COUNT + 3 * pins + int(guide.tooth)
    bodies = (CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING)
    return (*bodies, of_pin, of_pin + pins, of_pin + 2 * pins, of_tooth)


@compiled
def _rates(guide: np.record) -> tuple[float, ...]:
    """Derivatives of the gap of a contact by its `_columns`."""
    nx, ny, height = guide.normal_x, guide.normal_y, guide.height
    bodies = (-nx, -ny, -nx * height, -ny * height, -guide.crank, 1.0, -guide.facing)
    return (*bodies, guide.radial, guide.tangential, -1.0, guide.turn)


@compiled
def _load(problem: Problem, contacts: NDArray[np.void], moved: float, pressed: NDArray[np.void]) -> tuple[float, float]:
    """Press the contacts of a drive rotated by `moved` from the solved one; return torque and stiffness."""
    torque = stiffness = 0.0
    for k in range(contacts.size):
        guide, near = contacts[k], pressed[k]
        near.arm = guide.arm + moved * guide.arm_rate
        approach = moved * (guide.arm + 0.5 * moved * guide.arm_rate) - near.gap
        if approach <= 0.0:
            near.force = 0.0
            continue
        near.force, near.stiffness, _ = hertz(
            approach,
            guide.curvature,
            problem.pin_radius[k % problem.pin_radius.size],
            problem.slice_width,
            problem.compliance_gear,
            problem.compliance_pin,
            problem.largest_log_radius,
            near.force,
        )
        torque += near.force * near.arm
        stiffness += near.stiffness * near.arm * near.arm + near.force * guide.arm_rate
    return torque, stiffness


@compiled
def _to_touch(contacts: NDArray[np.void], moved: float, pressed: NDArray[np.void], direction: float) -> float:
    best = math.inf
    for k in range(contacts.size):
        gap = pressed[k].gap - moved * (contacts[k].arm + 0.5 * moved * contacts[k].arm_rate)
        best = min(best, touched_after(gap, direction * pressed[k].arm, contacts[k].arm_rate))
    return best


@compiled
def _balance(
    problem: Problem, contacts: NDArray[np.void], torque: float, moved: float, pressed: NDArray[np.void]
) -> tuple[float, float]:
    """Balance a torque by Newton's method inside a bracket; return rotation from the solved drive, and stiffness."""
    low, high, stiffness = -math.inf, math.inf, 0.0
    for _ in range(_ITERATIONS):
        balance, stiffness = _load(problem, contacts, moved, pressed)
        short = torque - balance
        if short > 0.0:
            low = moved
        else:
            high = moved
        step = short / stiffness if stiffness > 0.0 else math.inf
        # A load against the torque is on the wrong flanks.
        if stiffness <= 0.0 or (balance * torque < 0.0 and abs(step) < LINEAR_STEP):
            direction = math.copysign(1.0, short)
            step = direction * (max(_to_touch(contacts, moved, pressed, direction), 0.0) + 1e-6)
        step = min(max(step, -1e-3), 1e-3)
        if abs(step) < LINEAR_STEP:
            return moved + step, stiffness
        if not low < moved + step < high:
            step = 0.5 * (low + high) - moved
        moved += step
    return moved, stiffness


@compiled
def _sweep(
    problem: Problem,
    contacts: NDArray[np.void],
    solved: Array,
    errors: Array,
    torque: Array,
    pressed: NDArray[np.void],
    transmission_error: Array,
    each: Array,
    by_torque: Array,
) -> None:
    """Solve a drive whose displacements differ by `errors`, with the derivatives of its transmission_error.

    Parameters
    ----------
    contacts, solved
        Of the solved drive: contacts (angles, contacts) and transmission_error, shape (angles,), rad.
    pressed
        Memory, shape (contacts,), zeros.
    transmission_error, each, by_torque
        Overwritten, as `NearDrive.sensitivities` returns them; `each` is zeros.
    """
    moved, pins = 0.0, problem.pin_x.size
    for i in range(solved.size):
        for k in range(pressed.size):
            columns, rates = _columns(contacts[i, k], k % pins, pins), _rates(contacts[i, k])
            pressed[k].gap = contacts[i, k].gap
            for at in range(_COLUMNS):
                pressed[k].gap += rates[at] * errors[columns[at]]
        moved, stiffness = _balance(problem, contacts[i], torque[i], moved, pressed)
        transmission_error[i], by_torque[i] = solved[i] + moved, 1.0 / stiffness
        for k in range(pressed.size):
            if pressed[k].force > 0.0:
                columns, rates = _columns(contacts[i, k], k % pins, pins), _rates(contacts[i, k])
                share = pressed[k].stiffness * pressed[k].arm / stiffness
                for at in range(_COLUMNS):
                    each[i, columns[at]] += share * rates[at]
