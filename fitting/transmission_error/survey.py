"""A recording read once, block by block: overview, transmission error curves or loops, and notes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from fitting.readers.mapping import ANGLES, OPTIONAL
from fitting.readers.recording import Recording, RecordingStream
from fitting.samples.block import Block
from fitting.samples.plausible import PlausibleBlocks
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.folding import Folding
from fitting.transmission_error.loop_groups import loop_groups, positions_of
from fitting.transmission_error.loops import LoopData, loops_of, residual_variance

Array = NDArray[np.float64]

_OVERVIEW = 1 << 20
_COLUMNS = ("time", "input_angle", "output_angle", "torque", *OPTIONAL)
_SEEN = 4000  # samples from which an encoder's counts are seen
_WHOLE = 0.02  # of a count: differences that are whole numbers of counts


@dataclass(frozen=True)
class Surveyed:
    """Result of reading one recording block by block; its size is bounded for recordings of any length.

    Attributes
    ----------
    source, checksum
        Name and SHA-256 of the recording.
    samples, duration
        Number of samples, and their time span, s; NaN without times.
    overview
        The recording; if it is long, each sample is the mean of `averaged` consecutive samples.
    averaged
        Number of samples averaged into one of the overview.
    curves
        Transmission error curves, one per direction; empty for loops and without a ratio.
    loops
        The loops, or None.
    loop_groups
        Loops by size and position, the largest first.
    notes
        Omissions and their reasons.
    runaway
        Half width of the 95 % interval of the transmission error's drift over the whole recording between the two
        angles' clocks, rad of the output.
    implausible
        Number of implausible samples that were left out.
    """

    source: str
    checksum: str
    samples: int
    duration: float
    overview: Recording
    averaged: int
    curves: tuple[Curve, ...]
    loops: LoopData | None
    notes: tuple[str, ...]
    runaway: float = 0.0
    implausible: int = 0
    loop_groups: tuple[LoopData, ...] = ()


class _Overview:
    """Holds the whole recording; its resolution is halved whenever it exceeds twice `_OVERVIEW` samples."""

    def __init__(self) -> None:
        self.averaged = 1
        self.samples = 0
        self._names: tuple[str, ...] = ()
        self._parts: list[Array] = []  # of shape (columns, samples), as the rest
        self._rest: Array | None = None
        self._held = 0

    def add(self, block: Block) -> None:
        self._names = tuple(name for name in _COLUMNS if getattr(block, name) is not None)
        self.samples += block.time.size
        columns = np.stack([getattr(block, name) for name in self._names])
        if self._rest is not None:
            columns = np.hstack([self._rest, columns])
        whole = columns.shape[1] - columns.shape[1] % self.averaged
        self._parts.append(_means(columns[:, :whole], self.averaged))
        self._held += whole // self.averaged
        self._rest = columns[:, whole:].copy()
        while self._held > 2 * _OVERVIEW:
            joined, even = np.hstack(self._parts), self._held - self._held % 2
            self._rest = np.hstack([np.repeat(joined[:, even:], self.averaged, axis=1), self._rest])
            self._parts = [_means(joined[:, :even], 2)]
            self.averaged *= 2
            self._held = even // 2

    def table(self) -> dict[str, Array]:
        """Return the columns; the last sample may be the mean of fewer than `averaged`."""
        last = [self._rest.mean(axis=1, keepdims=True)] if self._rest is not None and self._rest.size else []
        return dict(zip(self._names, np.hstack([*self._parts, *last]), strict=True))


def _means(columns: Array, size: int) -> Array:
    """Return the means of this many samples each, a power of two: 3 times as fast as a mean along rows."""
    while size > 1:
        columns, size = 0.5 * (columns[:, ::2] + columns[:, 1::2]), size // 2
    return columns


@dataclass(frozen=True)
class Overview:
    """A recording in memory, of bounded size for recordings of any length.

    Attributes
    ----------
    recording
        The recording without implausible samples; of a long one each sample is the mean of `averaged` ones.
    averaged, samples
        That number, and the number of samples read.
    blocks
        The blocks that were read, for their counts.
    """

    recording: Recording
    averaged: int
    samples: int
    blocks: PlausibleBlocks

    @property
    def notes(self) -> list[str]:
        """Notes on samples left out."""
        return self.blocks.notes()


def count_of(angle: NDArray[np.float64]) -> float:
    """Return the angle of one count of an encoder, rad, from the steps between samples; 0 if they show none.

    Examples
    --------
    >>> import numpy as np
    >>> angle = np.cumsum(0.01 + 0.003 * np.sin(np.arange(400.0)))
    >>> count = 2.0 * np.pi / 8192
    >>> round(count_of(np.round(angle / count) * count) / count, 6), count_of(angle)
    (1.0, 0.0)
    """
    steps = np.unique(np.abs(np.diff(angle[:_SEEN])))
    steps = steps[steps > 1e-12 * float(np.abs(angle[:_SEEN]).max(initial=0.0))]
    if steps.size < 2:
        return 0.0
    gaps = np.diff(steps)
    gaps = gaps[gaps > 1e-6 * float(steps[-1])]
    count = float(min(gaps.min(initial=np.inf), steps[0]))
    whole = steps / count
    if np.unique(np.round(whole)).size < 3:  # an even motion
        return 0.0
    return count if bool(np.all(np.abs(whole - np.round(whole)) < _WHOLE)) else 0.0


def overview_of(
    stream: Recording | RecordingStream,
    ratio: float | None,
    each: Callable[[Block, int], None] = lambda block, samples: None,
) -> Overview:
    """Read a recording once, block by block, and return it at a bounded size.

    Parameters
    ----------
    stream
        The recording, in memory or in its file.
    ratio
        Signed ratio input/output; None: that of the recording.
    each
        Called with every block and the number of samples read so far.

    Raises
    ------
    edge.InputError
        If the file can't be read.
    """
    ratio = stream.ratio if ratio is None else ratio
    held, counts = _Overview(), dict[str, float]()
    blocks = PlausibleBlocks(stream, ratio)
    for block in blocks:
        counts = counts or {role: count_of(getattr(block, role)) for role in ANGLES}
        held.add(block)
        each(block, held.samples)
    table: dict[str, NDArray[Any]] = {**held.table()}
    table["status"] = np.zeros(table["time"].size, np.uint8)
    recording = dataclasses.replace(stream.recording(table), ratio=ratio)
    shown = {f"{role.removesuffix('_angle')}_resolution": count for role, count in counts.items() if count > 0.0}
    known = {name: value for name, value in shown.items() if getattr(recording.limits, name) == 0.0}
    recording = dataclasses.replace(recording, limits=dataclasses.replace(recording.limits, **known))
    return Overview(recording, held.averaged, held.samples, blocks)


def survey(
    stream: Recording | RecordingStream,
    ratio: float | None,
    rated_torque: float | None,
    progress: Callable[[int], None] = lambda samples: None,
) -> Surveyed:
    """Read a recording once, block by block, and return the data for figures, report and comparison.

    Parameters
    ----------
    stream
        The recording, in memory or in its file.
    ratio
        Signed ratio input/output; None: that of the recording. Without one the input must be locked.
    rated_torque
        Rated torque T_N, N·m; None: the largest torque of the recording, with a note.
    progress
        Called with the number of samples read so far.

    Raises
    ------
    edge.InputError
        If the file can't be read. Unusable content becomes a note.
    """
    ratio = stream.ratio if ratio is None else ratio
    folding = Folding(ratio, stream.source, evenly=True) if ratio is not None and stream.has_input_angle else None

    def each(block: Block, samples: int) -> None:
        if folding is not None:
            folding.add(block)
        progress(samples)

    overview = overview_of(stream, ratio, each)
    shortened, blocks, notes = overview.recording, overview.blocks, [*stream.notes, *overview.notes]
    loops, loop_notes = loops_of(shortened, ratio, rated_torque)
    notes += loop_notes
    curves: list[Curve] = []
    if loops is None and folding is not None:
        try:
            curves = folding.curves(stream, blocks)
            notes = list(curves[0].notes) + loop_notes + (_lag_note(shortened, folding.ratio) if stream.timed else [])
        except edge.InputError as problem:
            notes.append(str(problem))
    elif loops is None and np.ptp(shortened.input_angle) > 0.0:
        notes.append(
            f"{stream.source}: the input turns but the ratio is unknown; give the drive or its ratio: {edge.RATIO}."
        )
    duration = float(shortened.time[-1] - shortened.time[0]) if stream.timed else np.nan
    speed = float(np.abs(np.diff(shortened.output_angle)).sum()) / duration if duration > 0.0 else 0.0
    return Surveyed(
        stream.source,
        shortened.checksum,
        overview.samples,
        duration,
        shortened,
        overview.averaged,
        tuple(curves),
        loops,
        tuple(notes),
        2.0 * stream.alignment * speed,
        blocks.count,
        tuple(loop_groups(shortened, ratio)) if loops is not None else (),
    )


def at_positions(surveyed: Surveyed, ratio: float | None, rated_torque: float | None) -> list[Surveyed]:
    """Return a survey for each position at which a recording has loops of the largest size; smaller ones go with one.

    Between positions the windup has no common zero: their loops are pooled like those of several recordings.

    Parameters
    ----------
    surveyed, ratio, rated_torque
        A recording's survey, and what it was called with.
    """
    positions, smaller = positions_of(surveyed.loop_groups)
    if len(positions) < 2:
        return [surveyed]
    overview = surveyed.overview
    rated = rated_torque or float(np.abs(overview.torque).max())
    surveys = []
    for number, group in enumerate(positions):
        part = slice(*np.searchsorted(overview.time, [group.time[0], np.nextafter(group.time[-1], np.inf)]))
        columns = {f.name: getattr(overview, f.name) for f in dataclasses.fields(Block)}
        here = dataclasses.replace(overview, **{n: v[part] for n, v in columns.items() if v is not None})
        name = f"position {number + 1}" if group.group is None else f"group {group.group:g}"
        here = dataclasses.replace(here, source=f"{surveyed.source}, {name}")
        loops, notes = loops_of(here, ratio, rated)
        surveys.append(
            dataclasses.replace(
                surveyed,
                source=here.source,
                overview=here,
                loops=loops,
                loop_groups=(group, *smaller),
                notes=(*surveyed.notes, *notes),
                samples=here.time.size,
            )
        )
        smaller = []
    return surveys


def _lag_note(recording: Recording, ratio: float) -> list[str]:
    """Return a note if the output angle is delayed by more than the uncertainty and 0.1 arcsec at full speed."""
    estimate = lag_of(recording, ratio)
    if estimate is None:
        return []
    lag, uncertainty = estimate
    fastest = float(np.abs(np.gradient(recording.output_angle, recording.time)).max())
    arcsec = abs(lag) * fastest * edge.ARCSEC
    if abs(lag) < 2.0 * uncertainty or arcsec < 0.1:
        return []
    return [
        f"{recording.source}: at changes of speed the output angle is {'late' if lag > 0.0 else 'early'} by "
        f"{abs(lag) * 1e3:.3g} ± {uncertainty * 1e3:.1g} ms, {arcsec:.3g}″ at full speed; if this is not windup, "
        "state it as delay in the mapping."
    ]


def lag_of(recording: Recording, ratio: float) -> tuple[float, float] | None:
    """Estimate the delay of the output angle against the input angle from changes of speed.

    An output angle delayed by τ is short by τ times its speed. At constant speed that is a constant offset; at varying
    speed it can be separated from errors periodic with output or crank turns, and from the lost motion, which has the
    sign of the speed. A windup that grows with speed (viscous friction) has the same effect.

    Parameters
    ----------
    recording
        The recording.
    ratio
        Signed ratio input/output.

    Returns
    -------
    lag, uncertainty
        Delay, s, > 0 if the output is late, and half width of its 95 % interval; None if the speed hardly changes.
    """
    step = max(1, recording.time.size // 50000)
    time, angle, output = recording.time[::step], recording.input_angle[::step], recording.output_angle[::step]
    if time.size < 50:
        return None
    speed = np.gradient(angle, time) / ratio
    waves = np.multiply.outer(angle, np.array([1.0, 2.0, 1.0 + 1.0 / abs(ratio), 1.0 / abs(ratio)]))
    columns = np.column_stack([np.ones(angle.size), np.sign(speed), np.cos(waves), np.sin(waves)])
    both = np.column_stack([output - angle / ratio, speed])
    residual = both - columns @ np.linalg.lstsq(columns, both, rcond=None)[0]
    error, changes = residual.T
    spread = float(changes @ changes)
    if np.sqrt(spread / time.size) < 0.02 * np.abs(speed).max():
        return None
    slope = float(changes @ error) / spread
    variance = residual_variance(error - slope * changes, time.size - columns.shape[1] - 1) / spread
    return -slope, 1.96 * float(np.sqrt(variance))
