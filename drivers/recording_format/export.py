"""A recording in other formats, batch by batch: netCDF, Parquet, CSV, MDF4."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from drivers.recording_format.joining import joined_batches
from drivers.recording_format.reader import RecordingReader
from drivers.recording_format.schema import (
    COLUMN_DTYPES,
    Event,
    FloatArray,
    Samples,
    record_batch,
    recording_metadata,
    recording_schema,
)

Progress = Callable[[float], None]
_CHUNK = 1 << 16  # samples gathered for one write: small pieces make netCDF and MDF4 files large


@dataclasses.dataclass(frozen=True)
class Exported:
    """A recording in another format: file, number of rows, and one sentence for each problem of the recording."""

    path: Path
    rows: int
    problems: tuple[str, ...]


def export(
    recording: str | os.PathLike[str], output: str | os.PathLike[str], *, progress: Progress | None = None
) -> Exported:
    """Write a recording in the format of the file's ending, in constant memory; never leaves a partial file.

    Parameters
    ----------
    recording
        The `.arrows` file.
    output
        `.csv`: one table of the two angles, paired by the SYNC that latched both, and the torque interpolated to those
        instants. `.nc` (netCDF), `.parquet`, `.mf4` (MDF4, ASAM): the samples of each channel as received.
    progress
        Called with the number of bytes read since the previous call.

    Raises
    ------
    edge.InputError
        If the ending is unknown, a library is missing, or a channel that the CSV needs is missing.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
    ...     done = bench.record("test.arrows")
    >>> drivers.export("test.arrows", "test.csv").rows
    96
    """
    target = edge.output_path(output, "output", WRITERS)
    with RecordingReader(recording) as reader, edge.written_whole(target) as temporary:
        rows = WRITERS[target.suffix.lower()](reader, temporary, progress or (lambda _: None))
    return Exported(target, rows, tuple(reader.problems))


def batches(reader: RecordingReader, progress: Progress) -> Iterator[tuple[Samples, tuple[Event, ...]]]:
    """Yield the batches of `RecordingReader.batches` and report the bytes read."""
    done = 0
    for batch in reader.batches():
        progress(reader.position - done)
        done = reader.position
        yield batch


def _gathered(reader: RecordingReader, events: list[Event], progress: Progress) -> Iterator[Samples]:
    """Yield each channel's samples in large blocks, and collect the events."""
    for samples, new_events in joined_batches(batches(reader, progress), fill=True):
        events.extend(new_events)
        if len(samples):
            yield samples


def _event_text(events: list[Event]) -> str:
    return json.dumps([dataclasses.asdict(e) for e in events])


def _parquet(reader: RecordingReader, path: Path, progress: Progress) -> int:
    """Write the recording's own table with its metadata; the events become metadata of the file."""
    import pyarrow.parquet as pq

    schema, rows, events = recording_schema(reader.header), 0, []  # type: tuple[Any, int, list[Event]]
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for block in _gathered(reader, events, progress):
            writer.write_batch(record_batch(block, schema, [c.name for c in reader.header.channels]))
            rows += len(block)
        writer.add_key_value_metadata({"events": _event_text(events)})
    return rows


def _netcdf(reader: RecordingReader, path: Path, progress: Progress) -> int:
    """Write one group per channel; xarray opens each with `group=`."""
    import h5netcdf

    rows, events = 0, []  # type: tuple[int, list[Event]]
    units = {"time_host": "s", "time_device": "s", "counts": "1", "status": "1"}
    with edge.hdf5_target(path) as target, h5netcdf.File(target, "w") as file:
        for key, text in recording_metadata(reader.header).items():
            file.attrs[key] = text
        groups: dict[str, Any] = {}
        for channel in reader.header.channels:
            group = groups[channel.name] = file.create_group(channel.name)
            group.dimensions["sample"] = None
            for key, value in dataclasses.asdict(channel).items():
                group.attrs[key] = "" if value is None else value
        for block in _gathered(reader, events, progress):
            group = groups[block.channel]
            begin = group.dimensions["sample"].size
            group.resize_dimension("sample", begin + len(block))
            for name, kind in COLUMN_DTYPES.items():
                array = getattr(block, name)
                if array is None:
                    continue
                if name not in group.variables:
                    variable = group.create_variable(name, ("sample",), np.dtype(kind), chunks=(_CHUNK,))
                    variable.attrs["units"] = units.get(name, str(group.attrs["unit"]))
                group.variables[name][begin : begin + len(block)] = array
            target.check()
            rows += len(block)
        file.attrs["events"] = _event_text(events)
    return rows


def _mdf(reader: RecordingReader, path: Path, progress: Progress) -> int:
    """Write one channel group per channel, with the time since the start as its master channel."""
    with edge.needs_extra("bench-files", lambda new_events: edge.InputError(f"{path}: {new_events}.")):
        from asammdf import MDF, Signal

    rows, events = 0, []  # type: tuple[int, list[Event]]
    described = {c.name: c for c in reader.header.channels}
    groups: dict[str, tuple[int, list[str]]] = {}
    file = MDF(version="4.10")
    try:
        for block in _gathered(reader, events, progress):
            names = [n for n in ("value", "counts", "time_device", "status") if getattr(block, n) is not None]
            channel = described[block.channel]
            if block.channel not in groups:
                units = {"value": channel.unit, "time_device": "s"}
                signals = [
                    Signal(
                        getattr(block, n),
                        block.time_host,
                        units.get(n, ""),
                        block.channel if n == "value" else f"{block.channel}.{n}",
                    )
                    for n in names
                ]
                groups[block.channel] = (file.append(signals, comment=json.dumps(dataclasses.asdict(channel))), names)
            else:
                index, names = groups[block.channel]
                columns = [
                    (np.zeros(len(block)) if getattr(block, n) is None else getattr(block, n), None) for n in names
                ]
                file.extend(index, [(block.time_host, None), *columns])
            rows += len(block)
        file.header.comment = json.dumps({**recording_metadata(reader.header), "events": _event_text(events)})
        file.save(path, overwrite=True)
    finally:
        file.close()
    return rows


_TABLE = ("input_angle", "output_angle", "torque")


def _csv(reader: RecordingReader, path: Path, progress: Progress) -> int:
    """Write the table that `cycloid-fit` reads: angles paired by equal `time_host`, torque interpolated to these times.

    Channels latched by one SYNC have identical time stamps. A crank at 1500 rpm turns 33 arcsec in a microsecond, so
    angles read one after the other are not a pair. The torque is NaN outside the times of its own samples.
    """
    names = {c.role: c.name for c in reader.header.channels}
    source = reader.source
    ends = _last_times(source)
    for role in _TABLE:
        if ends.get(names.get(role, "")) is None:
            raise edge.InputError(f"{source}: the table needs the channel {role}; the recording has no samples of it.")
    rows, start = 0, None
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("time [s],input_angle [rad],output_angle [rad],torque [N*m]\n")
        for time, angle, output, torque in _paired(reader, names, ends, progress):
            start = float(time[0]) if start is None else start
            np.savetxt(file, np.column_stack([time - start, angle, output, torque]), "%.15g", ",")
            rows += len(time)
    if rows == 0:
        raise edge.InputError(
            f"{source}: input_angle and output_angle have no time in common (they were not latched by one SYNC) and "
            "cannot be paired; export .nc, .parquet or .mf4, or give the recording itself to cycloid-fit."
        )
    return rows


def _last_times(source: str) -> dict[str, float]:
    """Return the latest `time_host` of every channel that has samples."""
    ends: dict[str, float] = {}
    with RecordingReader(source) as reader:
        for samples, _ in reader.batches():
            if len(samples):
                ends[samples.channel] = max(ends.get(samples.channel, -np.inf), float(samples.time_host.max()))
    return ends


def _paired(
    reader: RecordingReader, names: dict[str, str], ends: dict[str, float], progress: Progress
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Yield time, input angle, output angle and torque; samples without a partner wait for it."""
    roles = {names[role]: role for role in _TABLE}
    held = {role: (np.zeros(0), np.zeros(0)) for role in _TABLE}
    newest = dict.fromkeys(_TABLE, -np.inf)

    def ready() -> Iterator[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
        # No channel will add samples before this time; a channel that has ended adds none at all.
        until = min((newest[r] for r in _TABLE if newest[r] < ends[names[r]]), default=np.inf)
        (ta, a), (tb, b), (tt, torque) = (held[r] for r in _TABLE)
        time, i, j = np.intersect1d(ta[ta < until], tb[tb < until], return_indices=True)
        if len(time):
            order = np.argsort(tt, kind="stable")
            yield (
                time,
                a[ta < until][i],
                b[tb < until][j],
                np.interp(time, tt[order], torque[order], left=np.nan, right=np.nan)
                if len(tt)
                else np.full(len(time), np.nan),
            )
        held["input_angle"], held["output_angle"] = (ta[ta >= until], a[ta >= until]), (tb[tb >= until], b[tb >= until])
        before = tt[tt < until]
        oldest = before.max() if len(before) else -np.inf  # the torque before the next instant is still needed
        held["torque"] = tt[tt >= oldest], torque[tt >= oldest]

    gathered = 0
    for samples, _ in batches(reader, progress):
        role = roles.get(samples.channel)
        if role is None or not len(samples):
            continue
        time, value = held[role]
        held[role] = np.concatenate([time, samples.time_host]), np.concatenate([value, samples.value])
        newest[role] = max(newest[role], float(samples.time_host.max()))
        gathered += len(samples)
        if gathered >= _CHUNK:
            gathered = 0
            yield from ready()
    newest = {role: ends[names[role]] for role in _TABLE}
    yield from ready()


WRITERS: dict[str, Callable[[RecordingReader, Path, Progress], int]] = {
    ".csv": _csv,
    ".nc": _netcdf,
    ".parquet": _parquet,
    ".mf4": _mdf,
}
