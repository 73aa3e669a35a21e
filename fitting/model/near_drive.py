"""Drives near one that is solved, to first order in their errors: on the way to a fit's start, in a tenth of the time.

Contacts are not solved: errors change their gaps linearly, by the displacement of pin and flank along the common
normal. Arms and gaps follow the rotation to second order, Hertz's law is exact, and the equilibrium is that of each
drive. What is left out is how errors change normals and curvatures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.analysis import solve
from cycloid_fmu.contact import Array, Problem, Rows, compiled, contact_rows, hertz, local_frame, place
from cycloid_fmu.contact.equilibrium import LINEAR_STEP, touched_after
from cycloid_fmu.contact.local_frame import gap_gradient
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
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import displacement_vector

_ITERATIONS = 60
_COLUMNS = 11  # displacements that change a contact's gap: those of the bodies, of its pin and of its tooth


def _records(*names: str, more: Sequence[tuple[str, type, tuple[int]]] = ()) -> np.dtype[np.void]:
    return np.dtype((np.record, [*((name, np.float64) for name in names), *more]))


_SOLVED = _records(
    "gap",
    "arm",
    "arm_rate",
    "curvature",
    "pin_radius",
    more=[("column", np.int64, (_COLUMNS,)), ("rate", np.float64, (_COLUMNS,))],
)
"""A contact of the solved drive, with the gap's derivatives by the columns of a displacement vector."""
_PRESSED = _records("gap", "arm", "force", "stiffness")
"""A contact of a drive near it: gap at the solved drive's rotation; arm, force and stiffness at its own."""


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
        self._deviation = solve(drive, [torque], angles, 1, with_play=False).transmission_error[0].copy()
        self._contacts = np.zeros((angles.size, pair.discs * pair.pins), _SOLVED)
        _contacts_of(self._problem, angles, self._deviation, self._contacts)

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
        angles, contacts = self._contacts.shape
        deviation, by_torque, each = np.empty(angles), np.empty(angles), np.zeros((angles, errors.size))
        _sweep(
            self._problem,
            self._contacts,
            self._deviation,
            errors - self._errors,
            torque,
            np.zeros(contacts, _PRESSED),
            deviation,
            each,
            by_torque,
        )
        return deviation, each, by_torque


@compiled
def _contacts_of(problem: Problem, thetas: Array, deviation: Array, found: NDArray[np.void]) -> None:
    """Overwrite the contacts of a solved drive, shape (angles, contacts): of each pin the nearer one of two."""
    contacts = contact_rows(problem)
    for i in range(thetas.size):
        place(problem, thetas[i], deviation[i], contacts, i == 0, math.inf, math.inf)
        for k in range(found.shape[1]):
            _write_contact(problem, thetas[i], deviation[i], contacts, k, found[i, k])


@compiled
def _write_contact(problem: Problem, theta: float, x: float, contacts: Rows, k: int, one: np.record) -> None:
    row = 2 * k + 1 if contacts[2 * k + 1].gap < contacts[2 * k].gap else 2 * k
    contact, local = contacts[row], local_frame(problem, theta, x, contacts, row)
    c, s = math.cos(local.direction), math.sin(local.direction)
    nx, ny, height, pins = local.normal_x, local.normal_y, problem.slice_z[local.slice], problem.teeth + 1
    one.gap, one.arm, one.arm_rate, one.curvature = contact.gap, contact.arm, contact.arm_rate, contact.curvature
    one.pin_radius = problem.pin_radius[local.pin]
    pin = BODY_COUNT + local.pin
    tooth = BODY_COUNT + 3 * pins + local.disc * problem.teeth + local.tooth
    columns = (
        *(CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING),
        *(pin, pin + pins, pin + 2 * pins, tooth),
    )
    crank, turn = nx * local.crank_x + ny * local.crank_y, gap_gradient(local).gap[2]
    rates = (
        *(-nx, -ny, -nx * height, -ny * height, -crank, 1.0, -local.facing),
        *(nx * c + ny * s, ny * c - nx * s, -1.0, turn),
    )
    for at in range(_COLUMNS):
        one.column[at], one.rate[at] = columns[at], rates[at]


@compiled
def _load(problem: Problem, contacts: NDArray[np.void], moved: float, pressed: NDArray[np.void]) -> tuple[float, float]:
    """Press the contacts of a drive rotated by `moved` from the solved one; return torque and stiffness."""
    torque = stiffness = 0.0
    for k in range(contacts.size):
        one, near = contacts[k], pressed[k]
        near.arm = one.arm + moved * one.arm_rate
        approach = moved * (one.arm + 0.5 * moved * one.arm_rate) - near.gap
        if approach <= 0.0:
            near.force = 0.0
            continue
        near.force, near.stiffness, _ = hertz(
            approach,
            one.curvature,
            one.pin_radius,
            problem.slice_width,
            problem.compliance_gear,
            problem.compliance_pin,
            problem.largest_log_radius,
            near.force,
        )
        torque += near.force * near.arm
        stiffness += near.stiffness * near.arm * near.arm + near.force * one.arm_rate
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
    deviation: Array,
    each: Array,
    by_torque: Array,
) -> None:
    """Solve a drive whose displacements differ by `errors`, with the derivatives of its deviation.

    Parameters
    ----------
    contacts, solved
        Of the solved drive: contacts (angles, contacts) and deviation, shape (angles,), rad.
    pressed
        Memory, shape (contacts,), zeros.
    deviation, each, by_torque
        Overwritten, as `NearDrive.sensitivities` returns them; `each` is zeros.
    """
    moved = 0.0
    for i in range(solved.size):
        for k in range(pressed.size):
            one = contacts[i, k]
            pressed[k].gap = one.gap
            for at in range(_COLUMNS):
                pressed[k].gap += one.rate[at] * errors[one.column[at]]
        moved, stiffness = _balance(problem, contacts[i], torque[i], moved, pressed)
        deviation[i], by_torque[i] = solved[i] + moved, 1.0 / stiffness
        for k in range(pressed.size):
            if pressed[k].force > 0.0:
                one, share = contacts[i, k], pressed[k].stiffness * pressed[k].arm / stiffness
                for at in range(_COLUMNS):
                    each[i, one.column[at]] += share * one.rate[at]
