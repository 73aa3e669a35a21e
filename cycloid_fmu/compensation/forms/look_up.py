"""A look-up table of a compensator, for controllers that only add a tabulated correction to the motor angle.

It has no memory of reversals and does not learn; the torque is that through the teeth, the load minus friction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.edge import ArgumentError, InputError

Array = NDArray[np.float64]
_MOST_ANGLES = 100_000
_SHARE = 0.5  # largest error of linear interpolation over the crank angle, relative to the table's residual
_BETWEEN = 8  # points between two crank angles or torques at which this error is found


@dataclass(frozen=True)
class LookUp:
    """The correction to the motor angle of an ideal drive.

    Attributes
    ----------
    crank_angle
        Ideal crank angles, those of the desired output angle times the ratio, over one period, its end included, rad.
    torque
        Torque of the teeth, N·m.
    correction
        Shape (torques, crank angles), rad of the motor; linear between the nodes.
    period
        rad of the crank.
    temperature
        K.
    residual
        Largest difference from the model at the output, rad: that of the compensator's table plus that of linear
        interpolation.
    """

    crank_angle: Array
    torque: Array
    correction: Array
    period: float
    temperature: float
    residual: float


def look_up(c: Compensator, temperature: float | None = None) -> LookUp:
    """Return the look-up table of a compensator at one temperature (K), by default the middle of its range.

    Raises
    ------
    edge.InputError
        If the temperature is not one of the compensator's or the table would need too many crank angles.
    """
    nodes = c.inverse.temperature
    if temperature is None:
        temperature = 0.5 * float(nodes[0] + nodes[-1])
    elif len(nodes) > 1 and not nodes[0] <= temperature <= nodes[-1]:
        allowed = f"it must be within {nodes[0]:g} K and {nodes[-1]:g} K, as the compensator's tables are"
        raise ArgumentError("temperature", allowed, f"{temperature:g} K")
    torque, period = c.inverse.torque, c.inverse.period
    most = max((len(steps) for steps in c.inverse.steps), default=2)
    count, allowed_more = 2 * most, _SHARE * c.inverse.residual
    while count <= _MOST_ANGLES:
        crank = np.linspace(0.0, period, count + 1)
        error = _error_with_windup(c, crank, torque, temperature)
        fine = np.linspace(0.0, period, _BETWEEN * count + 1)
        straight = np.array([np.interp(fine, crank, row) for row in error])
        more = float(np.abs(straight - _error_with_windup(c, fine, torque, temperature)).max())
        if more <= allowed_more:
            return LookUp(crank, torque, -c.ratio * error, period, temperature, c.inverse.residual + more)
        # The error of linear interpolation is proportional to the square of the step.
        count = math.ceil(count * max(1.2, 1.05 * math.sqrt(more / allowed_more)))
    raise InputError(
        f"a look-up table of this residual takes more than {_MOST_ANGLES} crank angles; state a larger residual, or "
        "use another form."
    )


def _error_with_windup(c: Compensator, crank: Array, torque: Array, temperature: float) -> Array:
    """Transmission error with the wind-up at desired angles times the crank's ratio, shape (torques, angles)."""
    wound = c.compliance * torque[:, None]
    mean, more = c.inverse.at(crank - c.crank_ratio * wound, torque[:, None], temperature)
    return np.asarray(wound + mean + more)


def csv_text(c: Compensator, table: LookUp) -> str:
    """Return the table as CSV, a line for each torque and crank angle; comment lines begin with #."""
    arcsec = 648000.0 / math.pi
    at = f"at {table.temperature:g} K; " if len(c.inverse.temperature) > 1 else ""
    lines = [
        f"# motor angle = {c.ratio!r} * desired output angle + correction; all angles counter-clockwise",
        f"# crank_angle = {c.crank_ratio!r} * desired output angle + index; it repeats after {table.period!r} rad",
        "# torque: through the teeth, of the environment on the output without friction; straight between all lines",
        f"# {at}largest difference from the model: {table.residual * arcsec:.3g} arcsec of the output",
        "torque [N*m],crank_angle [rad],correction [rad]",
    ]
    for torque, row in zip(table.torque.tolist(), table.correction.tolist(), strict=True):
        lines += [
            f"{torque:.9g},{angle!r},{value!r}" for angle, value in zip(table.crank_angle.tolist(), row, strict=True)
        ]
    return "\n".join(lines) + "\n"
