"""The bench recording as evaluation sees it: one clock, one table, validated.

Read from our recorder's `.arrows` files and from CSV with units in the header.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]

COLUMNS = {"time": "s", "input_angle": "rad", "output_angle": "rad", "torque": "N*m"}


@dataclass(frozen=True)
class BenchRecording:
    """What a bench recorded, SI, arrays of shape (samples,).

    Attributes
    ----------
    time, input_angle, output_angle, torque
        s, rad, rad, N·m of the environment on the output; angles are continuous.
    status
        Bits of the recording format; 0 where nothing is wrong.
    common_zero
        Whether the output encoder's zero is the same in every recording of the bench (an absolute encoder).
    known_index
        Whether crank angle 0 is the crank at pin 0 (an absolute or indexed input encoder).
    ratio
        Signed ratio of the drive, where the recording says it.
    source
        The file's name.
    checksum
        SHA-256 of the file.
    notes
        One sentence for each thing that a reader should know: what was left out, what was interpolated.
    """

    time: Array
    input_angle: Array
    output_angle: Array
    torque: Array
    status: NDArray[np.uint8]
    common_zero: bool
    known_index: bool
    ratio: float | None
    source: str
    checksum: str
    notes: tuple[str, ...] = ()


def read_bench_recording(path: str | os.PathLike[str]) -> BenchRecording:
    """Read a recording by its ending, `.arrows` or `.csv`.

    Raises
    ------
    edge.InputError
        If a channel is missing, there are no samples, a value is not finite, or the file is neither.
    """
    suffix = Path(path).suffix.lower()
    edge.existing(path)
    if suffix == ".arrows":
        recording = _from_arrows(path)
    elif suffix == ".csv":
        recording = _from_csv(path)
    else:
        raise edge.InputError(f"{path}: recordings end in .arrows or .csv.")
    if recording.time.size < 2:
        raise edge.InputError(f"{path}: the recording has {recording.time.size} samples; a curve needs more.")
    for name in COLUMNS:
        wrong = np.flatnonzero(~np.isfinite(getattr(recording, name)))
        if wrong.size:
            raise edge.InputError(
                f"{path}: {name} is not a finite number in sample {wrong[0]}"
                + (f" and {wrong.size - 1} more." if wrong.size > 1 else ".")
            )
    return recording


def _checksum(path: str | os.PathLike[str]) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _from_arrows(path: str | os.PathLike[str]) -> BenchRecording:
    from drivers.recording_format import read_recording

    read = read_recording(path)
    channels = {c.name: c for c in read.header.channels}
    for name in ("input_angle", "output_angle", "torque"):
        if name not in channels:
            raise edge.InputError(f"{path}: the recording has no {name} channel.")
        if len(read.samples[name]) == 0:
            raise edge.InputError(f"{path}: the {name} channel has no samples.")
    notes = list(read.problems)
    turning, driven, torque = (read.samples[n] for n in ("input_angle", "output_angle", "torque"))
    common, first, second = np.intersect1d(turning.time_host, driven.time_host, return_indices=True)
    torque_time, torque_value, _ = _in_order(torque.time_host, torque)
    if 2 * common.size >= min(len(turning), len(driven)):
        lost = max(len(turning), len(driven)) - common.size
        if lost:
            notes.append(f"{path}: {lost} samples of one angle without the other's at the same instant were left out.")
        time, input_angle = common, turning.value[first]
        output_angle, status = driven.value[second], turning.status[first] | driven.status[second]
    else:
        # Each channel by its own clock, where it has one: free of the delays on its way to the host.
        (time, input_angle, status), (driven_time, driven_angle, _), (torque_time, torque_value, _) = (
            _in_order(read.aligned_time(n), read.samples[n]) for n in ("input_angle", "output_angle", "torque")
        )
        inside = (time >= driven_time[0]) & (time <= driven_time[-1])
        time, input_angle, status = time[inside], input_angle[inside], status[inside]
        output_angle = np.interp(time, driven_time, driven_angle)
        notes.append(f"{path}: the angles share no instants; the output angle was interpolated to the input's times.")
    return BenchRecording(
        time=time,
        input_angle=input_angle,
        output_angle=output_angle,
        torque=np.interp(time, torque_time, torque_value),
        status=status,
        common_zero=channels["output_angle"].zero_reference == "absolute",
        known_index=channels["input_angle"].zero_reference == "absolute",
        ratio=read.header.ratio,
        source=str(path),
        checksum=_checksum(path),
        notes=tuple(notes),
    )


def _in_order(time: Array, samples: Any) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Return times, values and status in the order of time: frames may come out of order, and are marked so."""
    order = np.argsort(time, kind="stable")
    return time[order], samples.value[order], samples.status[order]


def _from_csv(path: str | os.PathLike[str]) -> BenchRecording:
    """Read the plain table: a header of names with units in brackets, then one row a sample."""
    lines = edge.read_text(path).splitlines()
    if not lines:
        raise edge.InputError(f"{path}: the file is empty.")
    scales = edge.unit_columns(next(csv.reader(lines[:1])), COLUMNS, str(path))
    if len(lines) < 2:
        raise edge.InputError(f"{path}: the recording has no samples.")
    columns = [position for position, _ in scales.values()]
    try:
        table = np.loadtxt(lines[1:], delimiter=",", usecols=columns, ndmin=2)
    except ValueError:
        raise edge.InputError(f"{path}: {_first_bad_cell(lines, scales)}") from None
    data: dict[str, Any] = {name: table[:, i] * scale for i, (name, (_, scale)) in enumerate(scales.items())}
    for name in ("input_angle", "output_angle"):
        data[name] = _continuous(data[name])
    return BenchRecording(
        **data,
        status=np.zeros(len(table), np.uint8),
        common_zero=False,
        known_index=True,
        ratio=None,
        source=str(path),
        checksum=_checksum(path),
    )


def _first_bad_cell(lines: list[str], scales: dict[str, tuple[int, float]]) -> str:
    for number, row in enumerate(csv.reader(lines[1:]), start=2):
        for name, (position, _) in scales.items():
            cell = row[position] if position < len(row) else ""
            try:
                float(cell)
            except ValueError:
                return f'line {number}: {name} is "{cell}"; it must be a number with a decimal point.'
    return "it is not a table of numbers separated by commas."


def _continuous(angle: Array) -> Array:
    """Unroll an angle that was recorded within one turn; one that runs beyond a turn is continuous already."""
    if np.ptp(angle) <= 2.0 * np.pi * (1.0 + 1e-9) and np.abs(np.diff(angle)).max(initial=0.0) > np.pi:
        return np.unwrap(angle)
    return angle


def one_direction(recording: BenchRecording) -> tuple[int, BenchRecording]:
    """Return the direction of a recording (+1: the crank angle grows) and the samples that move in it.

    Samples that stand still or move back by less than a hundredth of the whole way are left out, with a note.

    Raises
    ------
    edge.InputError
        If the recording turns in both directions.
    """
    steps = np.diff(recording.input_angle)
    direction = 1 if recording.input_angle[-1] >= recording.input_angle[0] else -1
    back = -direction * steps[direction * steps < 0.0].sum()
    way = np.ptp(recording.input_angle)
    if back > 0.01 * way:
        raise edge.InputError(f"{recording.source}: the crank turns in both directions; record each one by itself.")
    furthest = np.maximum.accumulate(direction * recording.input_angle)
    moving = np.concatenate([[True], np.diff(furthest) > 0.0])
    if moving.all():
        return direction, recording
    kept = {n: getattr(recording, n)[moving] for n in (*COLUMNS, "status")}
    note = (
        f"{recording.source}: {np.count_nonzero(~moving)} samples in which the crank stood or moved back were left out."
    )
    return direction, dataclasses.replace(recording, **kept, notes=(*recording.notes, note))
