"""Measured losses over speed, torque and temperature, converted to the loss table of an FMU."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.fmu.constants import REFERENCE_TEMPERATURE
from cycloid_fmu.fmu.variables import LossRow

_LEAST_LOSS = 1e-12  # N·m, below which nothing is measured and squares vanish
_LARGEST_COEFFICIENT = 0.1  # 1/K, bound of the temperature coefficient


@dataclass(frozen=True)
class BenchLosses:
    """A loss table fitted to measured losses.

    Attributes
    ----------
    rows
        As for `Interface.losses`.
    temperature_coefficient, reference_temperature
        As for `Friction`, 1/K and K.
    misfit
        Root mean square of the residual losses over that of the measured losses, dimensionless.
    """

    rows: tuple[LossRow, ...]
    temperature_coefficient: float
    reference_temperature: float
    misfit: float

    @property
    def summary(self) -> str:
        """How well the table agrees, and its temperature coefficient."""
        text = f"the loss table's residual is {100.0 * self.misfit:.2g} % of the losses (rms)"
        if self.temperature_coefficient == 0.0:
            return text
        coefficient, reference = self.temperature_coefficient, self.reference_temperature
        return f"{text}, proportional to exp(-{coefficient:.4g}/K (T - {reference:.5g} K))"


def fitted_losses(
    speed: NDArray[np.float64],
    torque: NDArray[np.float64],
    loss: NDArray[np.float64],
    temperature: NDArray[np.float64] | None = None,
) -> BenchLosses:
    """Return the loss table nearest to measured losses, by least squares.

    At each speed the lost torque of Modelica's `LossyGear` is linear in the torque of the teeth, with different
    coefficients when `flange_b` drives; all losses are proportional to exp(-β(T - T_ref)). Without measurements with
    `flange_b` driving, it gets the same losses. Below the lowest speed the losses are constant.

    Parameters
    ----------
    speed
        Speed of flange_a, rad/s; points measured at one set speed have the same value. All shapes are (points,).
    torque
        Torque of the teeth at flange_a, N·m: the load over the ratio, above 0 where flange_a drives.
    loss
        Lost torque at flange_a, N·m.
    temperature
        Temperature, K; None if it was not measured.

    Raises
    ------
    ValueError
        If a speed has fewer than two torques with flange_a driving, or there are no losses; the text is one sentence.

    Examples
    --------
    >>> import numpy as np
    >>> from cycloid_fmu.fmu.bench_losses import fitted_losses
    >>> torque = np.array([0.0, 1.0, 2.0])
    >>> fit = fitted_losses(np.full(3, 10.0), torque, (torque + 0.02) / 0.9 - torque)
    >>> [round(float(value), 6) for value in fit.rows[0][1:]]
    [0.9, 0.888889, 0.02, 0.025]
    """
    from scipy.optimize import minimize_scalar, nnls

    if speed.size == 0 or not (loss > _LEAST_LOSS).any():
        raise ValueError(f"a loss table needs measured points with losses above {_LEAST_LOSS:g} N·m")
    reference = REFERENCE_TEMPERATURE if temperature is None else float(np.mean(temperature))
    warmer = np.zeros(speed.size) if temperature is None else temperature - reference
    speeds = np.unique(np.abs(speed))
    for set_speed in speeds:
        if np.unique(torque[(np.abs(speed) == set_speed) & (torque >= 0.0)]).size < 2:
            raise ValueError(
                f"at {set_speed:g} rad/s there are fewer than two torques with flange_a driving: friction and "
                "efficiency need two"
            )

    def lines(coefficient: float) -> tuple[list[LossRow], float]:
        """Return the nearest table for a temperature coefficient, and its residual sum of squares."""
        warmth, rows, residual = np.exp(-coefficient * warmer), [], 0.0
        for set_speed in speeds:
            coefficients: list[NDArray[np.float64]] = []
            for side in (torque >= 0.0, torque < 0.0):
                selected = (np.abs(speed) == set_speed) & side
                if not selected.any():
                    coefficients.append(coefficients[0])
                    continue
                matrix = np.column_stack([np.abs(torque[selected]), np.ones(selected.sum())]) * warmth[selected, None]
                line, off = nnls(matrix, loss[selected])
                coefficients.append(line)
                residual += off**2
            (a, b), (back, friction) = coefficients
            efficiency = max(1.0 - back, 0.0)
            rows.append(
                (
                    float(set_speed),
                    1.0 / (1.0 + a),
                    efficiency,
                    b / (1.0 + a),
                    friction / efficiency if efficiency else 0.0,
                )
            )
        return rows, residual

    coefficient = 0.0
    if np.ptp(warmer) > 0.0:
        span = (-_LARGEST_COEFFICIENT, _LARGEST_COEFFICIENT)
        coefficient = float(minimize_scalar(lambda c: lines(c)[1], bounds=span, options={"xatol": 1e-8}).x)
    rows, residual = lines(coefficient)
    table = [tuple(map(float, row)) for row in rows]
    if table[0][0] > 0.0:
        table.insert(0, (0.0, *table[0][1:]))
    return BenchLosses(tuple(table), coefficient, reference, math.sqrt(residual / float(np.sum(loss**2))))  # type: ignore[arg-type]


def read_bench_losses(path: str | os.PathLike[str], ratio: float) -> BenchLosses:
    """Return the loss table of a CSV file `speed [rpm],torque [N*m],loss [N*m]`, optionally with `temperature [K]`.

    Parameters
    ----------
    path
        The file: speed and loss at flange_a, torque at the output, above 0 where flange_a drives.
    ratio
        Ratio of the drive, signed: angle of flange_a over that of the output.

    Raises
    ------
    edge.InputError
        If the file can't be read, a column or its unit is missing, or there are too few points.
    """
    wanted = {"speed": "rad/s", "torque": "N*m", "loss": "N*m"}
    points = [row for _, row in edge.number_rows(path, wanted, {"temperature": "K"})]
    columns = {name: np.array([row[name] for row in points]) for name in (points[0] if points else wanted)}
    try:
        return fitted_losses(
            columns["speed"], columns["torque"] / abs(ratio), columns["loss"], columns.get("temperature")
        )
    except ValueError as problem:
        raise edge.InputError(f"{path}: {problem}.") from None


def is_of_bench(path: str | os.PathLike[str]) -> bool:
    """Return whether a file of losses has the columns of measured losses instead of a loss table."""
    header = next(edge.csv_rows(path), [])
    return any(cell.partition("[")[0].strip() == "loss" for cell in header)
