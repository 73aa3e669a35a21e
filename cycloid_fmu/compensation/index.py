"""Finding the index: the crank angle of the model at the zero of a controller's angles."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from cycloid_fmu.compensation.compensator import CORRELATION, Compensator, Memory, torque_of_teeth
from cycloid_fmu.edge import ArgumentError

Array = NDArray[np.float64]
LEAST_ROTATION = 2.0 * math.pi  # rad of the crank
_FINE = 0.25  # of the spacing of the finest spline's knots: distance of candidates where any angle may be the index
_MOST = 10000  # candidates of a spacing
_BLOCK = 256  # candidates at a time


class Index(NamedTuple):
    """The result of a search.

    Attributes
    ----------
    angle
        Crank angle of the model where the output angle is 0, rad, 0 to the model's period.
    probability
        Probability of this candidate; accept it above 0.99, otherwise move farther or load the drive more.
    residual
        Residual of the measured transmission error, rms, rad.
    rival
        Residual of the best other candidate, rms, rad.
    """

    angle: float
    probability: float
    residual: float
    rival: float


def find_index(
    compensator: Compensator,
    motor_angle: ArrayLike,
    output_angle: ArrayLike,
    load_torque: ArrayLike,
    temperature: float,
    *,
    spacing: float | None = None,
) -> Index:
    """Find the index from a slow motion of a crank turn or more with both angles measured.

    Each candidate's ripple is compared with the measured transmission error, with the zero, the play and the gain of
    wind-up free. Residuals are taken as independent from radian to radian of the crank, so the odds of two candidates
    are the ratio of their residuals to the power of the motion.

    Parameters
    ----------
    compensator
        Of this drive.
    motor_angle, output_angle, load_torque
        In order of time, of one shape (samples,), rad, rad and N·m.
    temperature
        Of the drive, K.
    spacing
        Crank angle between two candidates, rad: 2π if the motor's encoder knows its angle within a turn; None for any
        angle.

    Raises
    ------
    edge.ArgumentError
        If the crank turns by less than `LEAST_ROTATION`, the arrays are not of one shape or no numbers, or the
        compensator's table has no ripple.

    Examples
    --------
    >>> import cycloid_fmu as cy, numpy as np
    >>> from cycloid_fmu.compensation.index import find_index
    >>> pair = cy.Pair(
    ...     gear_teeth=11, pin_circle_radius=0.03, pin_radius=0.0025, eccentricity=0.001, face_width=0.008,
    ...     rated_torque=40.0,
    ... )
    >>> drive = cy.Drive(pair).replace(offset="-15 um", errors={"eccentricity": "4 um", "pin_radial": {1: ("3 um", 0)}})
    >>> crank = np.linspace(1.0, 12.0, 300)
    >>> output = crank / drive.ratio + drive.analyze(30.0, crank_angle=crank).transmission_error.values[0]
    >>> compensator = drive.compensator(residual="4 arcsec")
    >>> index = find_index(compensator, crank - 2.5, output - 2.5 / drive.ratio, 30.0, 293.15)
    >>> round(index.angle, 2), index.probability > 0.99
    (2.5, True)
    """
    if not compensator.inverse.steps:
        raise ArgumentError(
            "compensator", "its table has no ripple to find the index by; make it with a smaller residual"
        )
    motor, output, load = _samples(motor_angle, output_angle, load_torque)
    rotation = float(np.abs(np.diff(output)).sum()) * abs(compensator.crank_ratio)
    if rotation < LEAST_ROTATION:
        raise ArgumentError(
            "output_angle", f"the crank must turn by {LEAST_ROTATION:.3g} rad or more", f"{rotation:.3g} rad"
        )
    residual_at = _residual_function(compensator, motor, output, load, temperature)
    period = compensator.inverse.period
    index = _candidates(compensator, spacing)
    count = index.size
    residual = np.concatenate([residual_at(index[i : i + _BLOCK]) for i in range(0, count, _BLOCK)])
    best = int(residual.argmin())
    apart = np.abs((index - index[best] + 0.5 * period) % period - 0.5 * period)
    other = apart > (CORRELATION if spacing is None else 0.0)
    rival = float(residual[other].min()) if other.any() else math.inf
    odds = (residual[best] / residual[other]) ** (rotation / CORRELATION)
    angle = float(index[best])
    if spacing is None:
        ends = angle - period / count, angle + period / count
        angle = float(minimize_scalar(lambda at: residual_at(np.array([at]))[0], bounds=ends, method="bounded").x)
    each = 1.0 if spacing is not None else min(1.0, CORRELATION * count / period)
    return Index(angle % period, 1.0 / (1.0 + float(odds.sum()) / each), float(residual[best]), rival)


def _samples(motor_angle: ArrayLike, output_angle: ArrayLike, load_torque: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the recorded angles and torques as arrays of one shape (samples,)."""
    try:
        motor, output, load = np.broadcast_arrays(
            *(np.asarray(v, float) for v in (motor_angle, output_angle, load_torque))
        )
    except ValueError:
        raise ArgumentError("output_angle", "it must have as many samples as motor_angle and load_torque") from None
    if motor.ndim != 1 or not all(np.isfinite(v).all() for v in (motor, output, load)):
        raise ArgumentError("output_angle", "angles and torques must be finite and of shape (samples,)")
    return motor, output, load


def _candidates(compensator: Compensator, spacing: float | None) -> Array:
    """Return the crank angles that may be the index, rad, shape (candidates,)."""
    period = compensator.inverse.period
    if spacing is None:
        count = math.ceil(max(len(steps) for steps in compensator.inverse.steps) / _FINE)
        return np.asarray(np.arange(float(count)) * (period / count))
    if 0.0 < spacing < math.inf:
        count = Fraction(spacing / period).limit_denominator(_MOST).denominator
        return np.asarray(np.arange(float(count)) * spacing % period)
    raise ArgumentError("spacing", "it must be finite and above zero (rad)", spacing)


def _residual_function(
    compensator: Compensator, motor: Array, output: Array, load: Array, temperature: float
) -> Callable[[Array], Array]:
    """Return the function from indices to residuals, rms, rad; zero, play and wind-up are free."""
    memory, inverse = Memory(), compensator.inverse
    torque = np.array(
        [torque_of_teeth(compensator, memory, a, 0.0, t, temperature) for a, t in zip(output, load, strict=True)]
    )
    mean, _ = inverse.at(output, torque, temperature)
    windup = compensator.compliance * torque
    free = np.column_stack([np.ones(output.size), np.interp(torque, inverse.torque, inverse.flank), windup + mean])
    basis = np.linalg.qr(free / np.linalg.norm(free, axis=0))[0]
    crank = compensator.crank_ratio * (output - windup)
    measured = output - motor / compensator.ratio

    def residual(index: Array) -> Array:
        residuals = measured - inverse.at(crank + index[:, None], torque, temperature)[1]
        residuals = residuals - (residuals @ basis) @ basis.T
        return np.asarray(np.sqrt(np.mean(residuals**2, axis=1)))

    return residual
