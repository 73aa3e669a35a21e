"""Maps of a drive over its conditions: transmission error, its orders, gap between directions and stiffness.

A condition is torque, speed and temperature. Recordings are processed one by one, and only the orders of each are kept,
so that memory does not grow with their length.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.arguments import check_ratio
from fitting.readers.sources import RecordingFile, Source, each_source, open_source
from fitting.transmission_error.curve import Curve, whole_turns
from fitting.transmission_error.spectrum import (
    RIG_ORDERS,
    Spectrum,
    order_name,
    range_of_orders,
    spectrum,
    without_orders,
)
from fitting.transmission_error.survey import survey

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FORMAT = "cycloid-maps/1"
AXES = ("torque", "speed", "temperature")
DIRECTIONS = ("forward", "backward")
_HARMONICS = 3  # harmonics of pins and teeth
_OTHERS = 4  # strongest orders in addition to the named ones
_MANY = 24  # recordings from which starting processes saves time
_OFTEN = 0.25  # share of the curves in which such an order must exceed the noise
_ALIKE = {"torque": 0.01, "speed": 0.02}  # of the largest value: closer values are one condition
_WARM = 1.5  # K: closer temperatures are one condition


@dataclass(frozen=True)
class _Point:
    """Values of one curve for a map."""

    condition: tuple[float, float, float]
    direction: int
    table: str
    ratio: float
    mean: float
    orders: Spectrum
    common_zero: bool


def maps(
    recordings: Source | Iterable[Source],
    drive: Drive | float | None = None,
    *,
    progress: Callable[[str], None] = lambda step: None,
) -> xr.Dataset:
    """Return maps of a drive over torque, speed and temperature from recordings at many conditions.

    Parameters
    ----------
    recordings
        Recordings from `fitting.read_recordings`, or `fitting.Run`, or one of them: whole output turns at one load
        each.
    drive
        The drive, or its signed ratio input/output; by default the ratio of the mappings or recordings.
    progress
        Called with the number of the recording being read, as text.

    Returns
    -------
    xarray.Dataset
        `cycloid-maps/1`, over (torque N·m, speed rad/s, temperature K, direction), SI; NaN without a recording:
        `angular_transmission_error`, largest minus smallest value of the orders above the noise;
        `angular_transmission_error_without_rig`, the same without `RIG_ORDERS`, which a rig's run-out causes;
        `order_amplitude` of each `order`, with its `order_name`; `mean_transmission_error`; `gap`, mean of forward
        minus mean of backward; and `torsional_stiffness` (N·m/rad), the slope of torque over mean transmission error. A
        gap is known within a table, or if all recordings share the zero of the output angle; a stiffness only in the
        latter case. If the torque's sign always follows the direction, the axis is its magnitude. The attribute `notes`
        states omissions.

    Raises
    ------
    edge.InputError
        If no recording has a curve over a whole output turn, or their ratios differ.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 39, 2000, endpoint=False)
    >>> def run(load):
    ...     output = -angle / 39 + load * 1e-6 * (1.0 + 0.1 * np.cos(angle))
    ...     return fitting.Run(input_angle=angle, output_angle=output, torque=load, speed=1.0, common_zero=True)
    >>> found = fitting.maps([run(100.0), run(200.0)], -39.0)
    >>> (found.angular_transmission_error.squeeze().sel(direction="forward").values * 1e6).round(1).tolist()
    [20.0, 40.0]
    >>> round(float(found.torsional_stiffness.sel(direction="forward").values[0, 0, 0]))
    1000000
    """
    ratio = drive.ratio if isinstance(drive, Drive) else None if drive is None else float(drive)
    check_ratio(ratio)
    given: list[Source] = each_source(recordings)
    points: list[_Point] = []
    notes: list[str] = []
    for number, (values, remarks) in enumerate(_taken(given, ratio), start=1):
        progress(f"recording {number} of {len(given)}")
        points += values
        notes += remarks
    if not points:
        raise edge.NoDataError(" ".join(["no recording has a curve over a whole output turn.", *notes[:3]]))
    ratios: dict[float, str] = {}
    for point in points:
        ratios.setdefault(point.ratio, point.table)
    if len(ratios) > 1:
        stated = edge.listed(f"{value:g} ({table})" for value, table in ratios.items())
        raise edge.InputError(f"the recordings state several ratios, {stated}; maps are those of one drive.")
    return _dataset(points, points[0].ratio, drive if isinstance(drive, Drive) else None, notes)


def _taken(given: Sequence[Source], ratio: float | None) -> Iterator[tuple[list[_Point], list[str]]]:
    """Yield the values of each recording; many files are read by all processors, each with one recording in memory."""
    if len(given) < _MANY or not all(isinstance(source, RecordingFile) for source in given):
        yield from (_points(source, ratio) for source in given)
        return
    import joblib

    parallel = joblib.Parallel(n_jobs=-1, return_as="generator", pre_dispatch="4*n_jobs")
    yield from parallel(joblib.delayed(_points)(source, ratio) for source in given)


def _points(source: Source, ratio: float | None) -> tuple[list[_Point], list[str]]:
    """Return the values of a recording, and its notes."""
    notes: list[str] = []
    try:
        surveyed = survey(open_source(source, ratio), ratio, None)
        notes += surveyed.notes
        if surveyed.loops is not None:
            notes.append(f"{surveyed.source}: loops are not used for maps.")
        table = str(source.path) if isinstance(source, RecordingFile) else surveyed.source
        return [_point(curve, table) for curve in surveyed.curves], notes
    except edge.InputError as problem:
        return [], [*notes, f"{problem} It is not in the maps."]


_MAP_UNITS = {"torque": "N*m", "speed": "rad/s", "temperature": "K", "torsional_stiffness": "N*m/rad"}
"""Units of the maps and their axes; those of the others are rad."""


def _merged(notes: Sequence[str]) -> list[str]:
    """Merge equal notes on several recordings into one that names the first."""
    of: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        source, colon, text = note.partition(": ")
        of.setdefault(text if colon else note, []).append(source if colon else "")
    return [
        text if not sources[0] else f"{sources[0]}{f' and {len(sources) - 1} more' if sources[1:] else ''}: {text}"
        for text, sources in of.items()
    ]


def _point(curve: Curve, table: str) -> _Point:
    speed, temperature = (np.nan if v is None else v for v in (curve.running_speed, curve.temperature))
    orders = spectrum(curve)
    return _Point(
        (curve.torque, speed, temperature),
        curve.direction,
        table,
        curve.ratio,
        float(orders.coefficient[0].real),
        orders,
        curve.common_zero,
    )


def _gathered(values: Array, apart: float) -> tuple[Array, NDArray[np.int64]]:
    """Return the distinct values, each the mean of those within `apart` of a neighbour, and the index of each."""
    known = np.isfinite(values)
    order = np.argsort(np.where(known, values, np.inf), kind="stable")
    step = np.diff(values[order]) > apart
    step |= known[order][1:] != known[order][:-1]
    number = np.empty(values.size, np.int64)
    number[order] = np.concatenate([[0], np.cumsum(step)])
    means = np.array([values[number == i].mean() for i in range(number.max() + 1)])
    return means, number


def _named_orders(points: Sequence[_Point], ratio: float, drive: Drive | None) -> list[int]:
    highest = min(p.orders.amplitude.size for p in points) - 1
    pair = None if drive is None else drive.pair
    per_turn = [round(abs(ratio))] if pair is None else [pair.gear_teeth, pair.pins]
    named = {*RIG_ORDERS, *(k * n for n in per_turn for k in range(1, _HARMONICS + 1))}
    if pair is not None:
        named.add(pair.gear_teeth * pair.pins)
    amplitude = np.median([p.orders.amplitude[: highest + 1] for p in points], axis=0)
    often = np.mean([p.orders.significant[: highest + 1] for p in points], axis=0) > _OFTEN
    often[[0, *(k for k in named if k <= highest)]] = False
    strongest = [int(k) for k in np.argsort(-amplitude) if often[k]][:_OTHERS]
    return sorted(k for k in {*named, *strongest} if k <= highest)


def _dataset(points: Sequence[_Point], ratio: float, drive: Drive | None, notes: list[str]) -> xr.Dataset:
    import xarray as xr

    direction = np.array([p.direction for p in points])
    load = np.array([p.condition[0] for p in points])
    turned = np.sign(load) * direction
    with_motion = bool((direction > 0).any() and (direction < 0).any() and (turned == turned[0]).all() and turned[0])
    sign = np.sign(load) if with_motion else np.ones(direction.size)
    axes, at = _axes(points, sign)
    shape = (*(a.size for a in axes), 2)
    count = np.zeros(shape, np.int64)
    np.add.at(count, at, 1)

    def mean(values: Array) -> Array:
        total = np.zeros(shape)
        np.add.at(total, at, values)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    orders = _named_orders(points, ratio, drive)
    level = np.array([p.mean for p in points])
    common = all(p.common_zero for p in points)
    level = level - whole_turns(level - level[0]) if common else level
    stiffness = np.full(shape, np.nan)
    if common and axes[0].size > 1:
        stiffness = _slope(axes[0], mean(level * sign))
    elif not common:
        notes.append(
            "No stiffness is mapped: it is not known that all recordings share the zero of the output angle. If they "
            'do, state zero_reference = "absolute" for [output_angle] in the mapping.'
        )
    gap = mean(level)[..., 0] - mean(level)[..., 1] if common else _gaps(points, at, shape[:3])
    without_rig = [range_of_orders(without_orders(p.orders, RIG_ORDERS)) for p in points]
    amplitude = [mean(np.array([p.orders.amplitude[k] for p in points])) for k in orders]
    grid = (*AXES, "direction")
    pair = None if drive is None else drive.pair
    data = xr.Dataset(
        {
            "angular_transmission_error": (grid, mean(np.array([range_of_orders(p.orders) for p in points]))),
            "angular_transmission_error_without_rig": (grid, mean(np.array(without_rig))),
            "order_amplitude": (("order", *grid), np.array(amplitude)),
            "mean_transmission_error": (grid, mean(level)),
            "gap": (AXES, gap),
            "torsional_stiffness": (grid, stiffness),
            "recordings": (grid, count),
        },
        {
            **{name: ((name,), values) for name, values in zip(AXES, axes, strict=True)},
            "direction": ("direction", np.array(DIRECTIONS, dtype=object)),
            "order": ("order", orders),
            "order_name": ("order", np.array([order_name(k, ratio, pair) for k in orders], dtype=object)),
        },
    )
    for name in (*AXES, *data.data_vars):
        if name != "recordings":
            data[name].attrs["units"] = _MAP_UNITS.get(str(name), "rad")
    data.attrs.update(
        format=FORMAT,
        ratio=ratio,
        torque_is=("size" if with_motion else "signed"),
        curves=len(points),
        notes="\n".join(_merged(notes)),
    )
    return data


def _axes(points: Sequence[_Point], sign: Array) -> tuple[tuple[Array, ...], tuple[NDArray[np.int64], ...]]:
    """Return the values of torque (times `sign`), speed and temperature, and the cell of each point in the maps."""
    condition = np.array([p.condition for p in points])
    condition[:, 0] *= sign
    largest = np.nanmax(np.abs(condition), axis=0, initial=0.0)
    apart = (_ALIKE["torque"] * largest[0], _ALIKE["speed"] * largest[1], _WARM)
    axes, numbers = zip(*(_gathered(condition[:, i], apart[i]) for i in range(3)), strict=True)
    return axes, (*numbers, np.array([0 if p.direction > 0 else 1 for p in points]))


def _slope(torque: Array, windup: Array) -> Array:
    """Return dT/dTE along the first axis, N·m/rad, from the recorded neighbours; NaN without any."""
    slope = np.full(windup.shape, np.nan)
    for cell in np.ndindex(windup.shape[1:]):
        line = windup[(slice(None), *cell)]
        there = np.isfinite(line)
        if np.count_nonzero(there) > 1:
            with np.errstate(divide="ignore"):
                slope[(there, *cell)] = 1.0 / np.gradient(line[there], torque[there])
    return slope


def _gaps(points: Sequence[_Point], at: tuple[NDArray[np.int64], ...], shape: tuple[int, ...]) -> Array:
    """Return forward minus backward in tables with both directions, averaged over the tables of a condition, rad."""
    pairs: dict[str, dict[int, int]] = {}
    for i, p in enumerate(points):
        pairs.setdefault(p.table, {})[p.direction] = i
    total, count = np.zeros(shape), np.zeros(shape)
    for both in pairs.values():
        if len(both) == 2:
            cell = tuple(int(axis[both[1]]) for axis in at[:3])
            total[cell] += points[both[1]].mean - points[both[-1]].mean
            count[cell] += 1.0
    return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)


def write_maps(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write maps to a netCDF file; never a partial file."""
    edge.write_netcdf(dataset, path)
