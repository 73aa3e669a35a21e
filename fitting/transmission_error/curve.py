"""Transmission error curves over one output turn, their noise and their file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from fitting.transmission_error.unaveraged import Unaveraged

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FORMAT = "cycloid-curve/1"
_WRITTEN = 1e-10  # rad: a table's digits change an angle by less, the noise of another recording by more


@dataclass(frozen=True)
class Curve:
    """Transmission error over one output turn, arrays of shape (points,).

    Attributes
    ----------
    input_angle
        Crank angle of each point, rad, from 0 to one output turn: the mean of its samples, so nothing is interpolated.
    transmission_error, standard_error
        φ_b - φ_a/ratio, rad, averaged over turns, and standard error of this mean from the scatter of turns, NaN for a
        single turn.
    sample_count
        Number of samples in each point.
    torque, torque_deviation
        Mean and standard deviation of the torque over the recording, N·m.
    direction
        +1 if the crank angle increases, -1 if it decreases.
    ratio
        Signed ratio φ_a/φ_b of the ideal drive.
    common_zero, known_index
        As in `Recording`.
    source, checksum
        Name and SHA-256 of the recording.
    notes
        Notes on the data.
    turns
        Number of output turns recorded in this direction.
    grid
        Number of even points over a whole turn, as many as a turn has samples, and crank angle at which the first
        begins, rad; (0, 0) if the points themselves are this grid.
    angle_variance
        Variance of the crank angles within each point, rad²; None if each point is a single angle.
    torque_each
        Mean torque of the samples in each point, N·m; None if its variation is unknown.
    speed, travel
        Mean speed of the crank in each point, rad/s (without times: rad per sample), and its mean rotation since the
        start of the recording, rad, > 0; None if unknown.
    each_turn
        Transmission error of every single turn, rad, shape (turns, points), NaN where a turn has no sample; None if the
        turns were not kept.
    unaveraged
        Transmission error of all turns before averaging; None if it was not kept.
    branch
        "" for a curve over the turn. For a loop with the input locked, its branch; the points are then over the torque,
        and the direction is that of a crank that would move the output as the torque does.
    implausible
        Number of implausible samples of the recording that were left out.
    temperature, running_speed
        Mean temperature of the recording, K, and speed of the run, rad/s: as stated, of the shaft to which the bench's
        speed refers, otherwise the mean speed of the output; None if unknown.
    crank_speed
        Mean speed of the crank, rad/s, > 0; None without times.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, -2.0 * np.pi * 39, 2000)
    >>> run = fitting.Run(input_angle=angle, output_angle=-angle / 39 + 1e-5 * np.cos(angle), torque=20.0)
    >>> (curve,) = fitting.curves(run, -39.0)
    >>> curve.direction, curve.torque
    (-1, 20.0)
    >>> curve.transmission_error.shape == curve.input_angle.shape
    True
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
    turns: float = 1.0
    grid: tuple[int, float] = (0, 0.0)
    angle_variance: Array | None = None
    torque_each: Array | None = None
    speed: Array | None = None
    travel: Array | None = None
    each_turn: Array | None = None
    unaveraged: Unaveraged | None = None
    branch: str = ""
    implausible: int = 0
    temperature: float | None = None
    running_speed: float | None = None
    crank_speed: float | None = None

    @property
    def torque_at_points(self) -> Array:
        """Torque at each point, shape (points,), N·m."""
        return np.full(self.input_angle.size, self.torque) if self.torque_each is None else self.torque_each

    def moved(self, angle: float) -> Curve:
        """Return the curve with another zero of the output: its transmission error is larger by an angle, rad."""
        other = self.unaveraged
        if other is not None:
            other = dataclasses.replace(other, transmission_error=other.transmission_error + angle)
        each = None if self.each_turn is None else self.each_turn + angle
        return dataclasses.replace(
            self, transmission_error=self.transmission_error + angle, each_turn=each, unaveraged=other
        )

    def points(self, chosen: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Curve:
        """Return the curve with some of its points, without the grid and the turns before averaging."""
        arrays = {f.name: v for f in dataclasses.fields(self) if isinstance(v := getattr(self, f.name), np.ndarray)}
        part: dict[str, Any] = {name: values[..., chosen] for name, values in arrays.items()}
        return dataclasses.replace(self, grid=(0, 0.0), unaveraged=None, **part)


def whole_turns(angle: ArrayLike, turn: float = 2.0 * np.pi) -> Array:
    """Return the whole turns nearest to an angle, rad: an encoder's angle does not tell how many it has passed."""
    return np.asarray(turn * np.round(np.asarray(angle, dtype=float) / turn))


def refuse_repeated(curves: Sequence[Curve]) -> None:
    """Refuse a curve that is given twice, also from an export: it would count twice, with too narrow intervals."""

    def same(a: Array, b: Array) -> bool:
        return a.size == b.size and bool(np.abs(a - b).max(initial=0.0) < _WRITTEN)

    for number, curve in enumerate(curves):
        for other in curves[:number]:
            if same(curve.transmission_error, other.transmission_error) and same(curve.input_angle, other.input_angle):
                raise edge.InputError(
                    f"{curve.source}: its samples are those of {other.source} too; give them once, or they count twice."
                )


def noise_of(curve: Curve) -> float:
    """Return the noise of one point of a curve, rad rms, from the scatter of turns or, for one turn, of neighbours.

    Sixth differences vanish for smooth values and have √924 times the standard deviation for noise; their median is not
    affected by the corners where pins come into contact.
    """
    repeated = np.isfinite(curve.standard_error)
    if np.count_nonzero(repeated) > 20:
        single = np.mean(curve.standard_error[repeated] ** 2 * curve.sample_count[repeated])
        return float(np.sqrt(single / np.median(curve.sample_count)))
    differences = np.diff(curve.transmission_error, 6)
    return float(np.median(np.abs(differences)) / 0.6745 / np.sqrt(924.0)) if differences.size else 0.0


def curves_dataset(curves: Sequence[Curve]) -> xr.Dataset:
    """Return curves as a labelled dataset, `cycloid-curve/1`, dimensions (run, point); short runs end in NaN."""
    import xarray as xr

    points = max(c.input_angle.size for c in curves)

    def padded(name: str, fill: float) -> Array:
        rows = [
            np.pad(getattr(c, name).astype(float), (0, points - c.input_angle.size), constant_values=fill)
            for c in curves
        ]
        return np.array(rows)

    grid = ("run", "point")
    of_runs = {
        name: [getattr(c, name) for c in curves] for name in ("torque", "torque_deviation", "direction", "implausible")
    }
    texts = {name: np.array([getattr(c, name) for c in curves], dtype=object) for name in ("source", "checksum")}
    data = xr.Dataset(
        {
            "transmission_error": (grid, padded("transmission_error", np.nan)),
            "standard_error": (grid, padded("standard_error", np.nan)),
            "sample_count": (grid, padded("sample_count", 0.0).astype(np.int64)),
            **{name: ("run", values) for name, values in {**of_runs, **texts}.items()},
        },
        {"input_angle": (grid, padded("input_angle", np.nan))},
    )
    for name in ("transmission_error", "standard_error", "input_angle"):
        data[name].attrs["units"] = "rad"
    for name in ("torque", "torque_deviation"):
        data[name].attrs["units"] = "N*m"
    data.attrs.update(format=FORMAT, ratio=curves[0].ratio)
    return data


def curves_json(curves: Sequence[Curve]) -> dict[str, Any]:
    """Return curves and their notes as JSON data for scripts, SI."""
    data = curves_dataset(curves)
    numbers = {str(name): values.values for name, values in {**data.coords, **data.data_vars}.items()}
    return {**numbers, "notes": [note for curve in curves for note in curve.notes]}


def write_curves(curves: Sequence[Curve], path: str | os.PathLike[str]) -> None:
    """Write curves to a netCDF file; never a partial file.

    Examples
    --------
    >>> import numpy as np, fitting, xarray as xr
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 39, 2000)
    >>> run = fitting.Run(input_angle=angle, output_angle=-angle / 39 + 1e-5 * np.cos(angle), torque=20.0)
    >>> fitting.write_curves(fitting.curves(run, -39.0), "curves.nc")
    >>> xr.load_dataset("curves.nc").torque.values.tolist()
    [20.0]
    """
    edge.write_netcdf(curves_dataset(curves), path)
