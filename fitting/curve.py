"""From a recording to its transmission error curve: over one output turn, averaged over turns, one direction each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from fitting.recording import BenchRecording, one_direction

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FORMAT = "cycloid-curve/1"


@dataclass(frozen=True)
class Curve:
    """Transmission error over one output turn, arrays of shape (points,).

    Attributes
    ----------
    input_angle
        Crank angle of each point, rad, from 0 to one output turn: the mean of the samples in it, so nothing is
        interpolated.
    transmission_error, standard_error
        φ_b - φ_a/ratio (rad) and the standard error of its mean over turns, NaN where one turn was recorded.
    sample_count
        Samples in each point.
    torque, torque_deviation
        Mean and standard deviation of the torque over the recording, N·m.
    direction
        +1 where the crank angle grows.
    ratio
        Signed ratio.
    common_zero, known_index
        As in the recording.
    source, checksum
        Of the recording.
    notes
        What a reader should know of the data.
    """

    input_angle: Array
    transmission_error: Array
    standard_error: Array
    sample_count: NDArray[np.int64]
    torque: float
    torque_deviation: float
    direction: int
    ratio: float
    common_zero: bool
    known_index: bool
    source: str
    checksum: str
    notes: tuple[str, ...] = ()


def transmission_error_curve(recording: BenchRecording, ratio: float) -> Curve:
    """Return the transmission error curve of a recording in one direction.

    The crank angle is folded to one output turn and divided into as many points as samples were taken in a turn; what
    falls into a point is averaged, angle and transmission error alike.

    Parameters
    ----------
    recording
        The recording.
    ratio
        Signed ratio φ_a/φ_b of the ideal drive.

    Raises
    ------
    edge.InputError
        If the recording turns both ways, or its two angles do not belong to this ratio.
    """
    direction, moving = one_direction(recording)
    turn = 2.0 * np.pi * abs(ratio)
    way = np.ptp(moving.input_angle)
    if way == 0.0:
        raise edge.InputError(f"{recording.source}: the crank does not turn.")
    error = moving.output_angle - moving.input_angle / ratio
    drift = np.polynomial.Polynomial.fit(moving.input_angle, error, 1).convert().coef[1] if error.size > 2 else 0.0
    if abs(drift * way) > 0.02 * way / abs(ratio):
        raise edge.InputError(
            f"{recording.source}: the output turns {1.0 / ratio + drift:.6g} of the input, the ratio {ratio:g} means "
            f"{1.0 / ratio:.6g}; check the pair, the directions and the counts per turn."
        )
    points = max(1, round((moving.input_angle.size - 1) * min(1.0, turn / way)))
    spacing = min(turn, way) / points
    folded = np.mod(moving.input_angle, turn)
    # The points' borders lie midway between the first turn's samples.
    shift = folded[0] - 0.5 * spacing
    number = np.floor(np.mod(folded - shift, turn) / spacing + 1e-9).astype(np.int64)
    number, order = np.unique(number, return_inverse=True)
    count = np.bincount(order)
    # An angle just past the end of the turn belongs to the point at its beginning, a whole turn away.
    centre = folded[np.unique(order, return_index=True)[1]]
    unrolled = folded - turn * np.round((folded - centre[order]) / turn)
    angle = np.bincount(order, unrolled) / count
    mean = np.bincount(order, error) / count
    scatter = np.bincount(order, (error - mean[order]) ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        standard_error = np.sqrt(scatter / (count - 1) / count)
    sequence = np.argsort(angle)
    return Curve(
        input_angle=angle[sequence],
        transmission_error=mean[sequence],
        standard_error=standard_error[sequence],
        sample_count=count[sequence],
        torque=float(moving.torque.mean()),
        torque_deviation=float(moving.torque.std()),
        direction=direction,
        ratio=ratio,
        common_zero=recording.common_zero,
        known_index=recording.known_index,
        source=recording.source,
        checksum=recording.checksum,
        notes=moving.notes,
    )


def noise_of(curve: Curve) -> float:
    """Noise of one point of a curve, rad: from the turns' scatter, or, after one turn, from neighbours' differences.

    The sixth differences of smooth values vanish and those of noise have √924 times its deviation; the median is not
    moved by the corners where pins come into contact.
    """
    repeated = curve.sample_count > 1
    if np.count_nonzero(repeated) > 20:
        return float(np.sqrt(np.mean(curve.standard_error[repeated] ** 2)))
    differences = np.diff(curve.transmission_error, 6)
    return float(np.median(np.abs(differences)) / 0.6745 / np.sqrt(924.0)) if differences.size else 0.0


def curves_dataset(curves: Sequence[Curve]) -> xr.Dataset:
    """Return curves as a labelled dataset, format `cycloid-curve/1`, dimensions (run, point); short runs end in NaN."""
    import xarray as xr

    points = max(c.input_angle.size for c in curves)

    def padded(name: str, fill: float) -> Array:
        rows = [np.pad(getattr(c, name).astype(float), (0, points - c.input_angle.size), constant_values=fill)
                for c in curves]  # fmt: skip
        return np.array(rows)

    grid = ("run", "point")
    data = xr.Dataset(
        {
            "transmission_error": (grid, padded("transmission_error", np.nan)),
            "standard_error": (grid, padded("standard_error", np.nan)),
            "sample_count": (grid, padded("sample_count", 0.0).astype(np.int64)),
            "torque": ("run", [c.torque for c in curves]),
            "torque_deviation": ("run", [c.torque_deviation for c in curves]),
            "direction": ("run", [c.direction for c in curves]),
            "source": ("run", np.array([c.source for c in curves], dtype=object)),
            "checksum": ("run", np.array([c.checksum for c in curves], dtype=object)),
        },
        {"input_angle": (grid, padded("input_angle", np.nan))},
    )
    for name, unit in (("transmission_error", "rad"), ("standard_error", "rad"), ("input_angle", "rad"),
                       ("torque", "N*m"), ("torque_deviation", "N*m")):  # fmt: skip
        data[name].attrs["units"] = unit
    data.attrs.update(format=FORMAT, ratio=curves[0].ratio)
    return data


def write_curves(curves: Sequence[Curve], path: str | os.PathLike[str]) -> None:
    """Write curves to a netCDF file, whole or not at all."""
    with edge.written_whole(path) as temporary:
        curves_dataset(curves).to_netcdf(temporary, engine="h5netcdf")
