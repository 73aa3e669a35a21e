"""Sources of recordings: files by name or pattern, or arrays of another bench."""

from __future__ import annotations

import glob
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cycloid_fmu import edge
from fitting.readers.mapping import ANGLES, OPTIONAL, FileMapping, read_mapping
from fitting.readers.read_head import ReadHead, read_read_head, without_coaxiality_error
from fitting.readers.recording import Recording, RecordingStream, open_with_mapping
from fitting.samples.cleaning import Cleaning


@dataclass(frozen=True)
class RecordingFile:
    """A recording in a file, which is opened on use; see `read_recordings`."""

    path: Path
    mapping: FileMapping | Mapping[str, FileMapping] | None = None
    read_head: ReadHead | None = None
    run: str = ""

    def open(self, ratio: float | None = None) -> Recording | RecordingStream:
        """Open the file; with a read head, read the whole recording and correct the head's coaxiality error.

        Parameters
        ----------
        ratio
            Signed ratio input/output of the drive, which overrides those of mapping and file.

        Raises
        ------
        edge.InputError
            If the file can't be read, or a channel, its unit or the time is missing.
        """
        stream = RecordingStream(self.path, self.mapping, ratio, self.run)
        return stream if self.read_head is None else without_coaxiality_error(stream.read(), self.read_head)


@dataclass(frozen=True)
class Run:
    """A recording as arrays of shape (samples,), from any bench; a single number applies to all samples.

    Attributes
    ----------
    input_angle, output_angle
        Angles, rad; those that roll over at a turn are unwrapped. A single number as input angle is a locked input.
    torque
        Torque of the environment on the output, N·m.
    time
        Times, s; None for evenly spaced samples at an unknown rate, so that speeds are unknown.
    temperature, input_torque
        Temperature, K, and torque of the environment on the input, N·m, if measured.
    group
        Number of the group of loops (their position or size) to which each sample belongs, if there are several.
    name
        Name of the run in messages and reports.
    common_zero
        Whether the output angle's zero is the same in every run of the bench (an absolute encoder).
    known_index
        Whether input angle 0 is the crank at pin 0.
    speed
        Speed of the run, rad/s, of the shaft to which the bench's speed refers, if known.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, 2.0 * np.pi, 200)
    >>> run = fitting.Run(input_angle=angle, output_angle=angle / -39, torque=20.0, name="20 N*m")
    >>> run.open().time.size
    200
    """

    input_angle: ArrayLike
    output_angle: ArrayLike
    torque: ArrayLike
    time: ArrayLike | None = None
    temperature: ArrayLike | None = None
    input_torque: ArrayLike | None = None
    group: ArrayLike | None = None
    name: str = "run"
    common_zero: bool = False
    known_index: bool = False
    speed: float | None = None

    def open(self) -> Recording:
        """Return the arrays as a recording; invalid samples are left out, with a note.

        Raises
        ------
        edge.InputError
            If the arrays' shapes differ or fewer than two samples remain.
        """
        size = np.size(self.output_angle)
        given = {n: getattr(self, n) for n in (*ANGLES, "torque", *OPTIONAL)}
        given["time"] = np.arange(float(size)) if self.time is None else self.time
        columns = {n: np.asarray(v, dtype=float) for n, v in given.items() if v is not None}
        for name, values in columns.items():
            if values.shape not in ((), (size,)):
                raise edge.InputError(
                    f"{self.name}: {name} has the shape {values.shape}, output_angle ({size},); they must be the same."
                )
        columns = {n: np.broadcast_to(v, size).copy() for n, v in columns.items()}
        digest = hashlib.sha256(b"".join(v.tobytes() for v in columns.values())).hexdigest()
        cleaning = Cleaning(dict.fromkeys(ANGLES), self.name)
        block = cleaning.add(columns, None)
        if block.time.size < 2:
            raise edge.InputError(f"{self.name}: it has {block.time.size} samples; a curve needs more.")
        return Recording(
            **vars(block),
            source=self.name,
            checksum=digest,
            common_zero=self.common_zero,
            known_index=self.known_index,
            speed=self.speed,
            timed=self.time is not None,
            locked="" if np.ndim(self.input_angle) else "input",
            notes=tuple(f"{self.name}: {note}" for note in cleaning.notes()),
        )


Source = RecordingFile | Run | Recording | RecordingStream
Mappings = FileMapping | str | os.PathLike[str] | Sequence[FileMapping | str | os.PathLike[str]]


_Given = TypeVar("_Given")


def each_source(recordings: _Given | Iterable[_Given]) -> list[_Given]:
    """Return one or several sources or curves as a list; an `edge.ArgumentError` refuses a path."""
    if isinstance(recordings, Iterable) and not isinstance(recordings, str | os.PathLike):
        given = list(recordings)
    else:
        given = [recordings]
    for source in given:
        if isinstance(source, str | os.PathLike):
            path = os.fspath(source)
            raise edge.ArgumentError("recordings", f"read it first: fitting.read_recordings({path!r})", path)
    return given


def open_source(source: Source, ratio: float | None = None) -> Recording | RecordingStream:
    """Open a source to read it block by block; the drive's ratio converts a measured transmission error to angles."""
    if isinstance(source, RecordingFile):
        return source.open(ratio)
    return source.open() if isinstance(source, Run) else source


def read_recordings(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    mapping: Mappings | None = None,
    read_head: ReadHead | str | os.PathLike[str] | None = None,
) -> list[RecordingFile]:
    """Return recordings in files, in order of their names: CSV, TwinCAT Scope, Parquet, MDF 4, TDMS, CAN, `.arrows`.

    A table with several runs side by side yields several recordings, by the `runs` of its mapping. Files are opened on
    use and may be larger than memory. `metrics` leaves out an unreadable file, with a note; `curves` and `identify`
    raise an error that names it.

    Parameters
    ----------
    paths
        A path, a pattern such as `*.arrows`, or several of either.
    mapping
        Roles of the channels, or their file, or several of either: each recording has the one whose columns it has, and
        a recording with our names needs none. None if all channels have our names: time, input_angle, output_angle,
        torque.
    read_head
        Single read head of the output encoder, or its file, to correct the coaxiality error.

    Raises
    ------
    edge.InputError
        If a pattern matches no file, or a mapping or the read head can't be read.

    Examples
    --------
    >>> import fitting, pathlib
    >>> for load in (20, 200):
    ...     _ = pathlib.Path(f"{load:03}Nm.csv").write_text("time [s],output_angle [rad],torque [N*m]")
    >>> [recording.path.name for recording in fitting.read_recordings("*0Nm.csv")]
    ['020Nm.csv', '200Nm.csv']
    """
    if read_head is not None and not isinstance(read_head, ReadHead):
        read_head = read_read_head(read_head)
    given = [paths] if isinstance(paths, str | os.PathLike) else paths
    mappings = _mappings(mapping)
    return [
        RecordingFile(path, of_run, read_head, run)
        for pattern in given
        for path in _files(pattern)
        for run, of_run in _runs(path, mappings)
    ]


def _mappings(mapping: Mappings | None) -> dict[str, FileMapping]:
    """Return the given mappings by name."""
    given = [] if mapping is None else [mapping] if isinstance(mapping, FileMapping | str | os.PathLike) else mapping
    file_mappings: dict[str, FileMapping] = {}
    for number, candidate in enumerate(given, start=1):
        if isinstance(candidate, FileMapping):
            file_mappings[f"mapping {number}"] = candidate
        else:
            file_mappings[str(candidate)] = read_mapping(candidate)
    return file_mappings


def _runs(
    path: Path, mappings: Mapping[str, FileMapping]
) -> Iterator[tuple[str, FileMapping | Mapping[str, FileMapping] | None]]:
    """Yield the runs in a file, with a mapping for each; mappings without runs are chosen when the file is opened."""
    if not any(mapping.runs for mapping in mappings.values()):
        yield "", mappings or None
        return
    try:
        _, chosen = open_with_mapping(path, mappings)
    except edge.InputError:  # raised again when the recording is opened
        yield "", mappings
        return
    yield from chosen.each() if chosen.runs else [("", mappings)]


def _files(pattern: str | os.PathLike[str]) -> Iterator[Path]:
    if Path(pattern).exists() or not glob.has_magic(str(pattern)):
        yield Path(pattern)
    elif paths := sorted(glob.glob(str(pattern), recursive=True)):
        yield from map(Path, paths)
    else:
        raise edge.InputError(f"{pattern}: no file matches this pattern.")
