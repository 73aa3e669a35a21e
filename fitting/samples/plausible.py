"""Recordings without implausible samples: values impossible for two encoders on one drive are left out and counted."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import ANGLES, IMPLAUSIBLE, Finding, Limits, Plausibility, Samples
from fitting.samples.block import Block, GapMarks

_SAID = 3  # most findings listed in a note


class Stream(Protocol):
    """A recording of any source, as in `fitting.readers.recording.Recording`."""

    @property
    def source(self) -> str:
        """Its name."""

    @property
    def notes(self) -> Sequence[str]:
        """Notes on it; complete when all blocks have been read."""

    @property
    def limits(self) -> Limits:
        """Limits of the encoders."""

    @property
    def timed(self) -> bool:
        """Whether the times are seconds."""

    @property
    def has_input_angle(self) -> bool:
        """Whether the input angle was recorded."""

    @property
    def locked(self) -> str:
        """The shaft that was locked, or ""."""

    def blocks(self) -> Iterator[Block]:
        """Yield its blocks in the order of time."""


class PlausibleBlocks:
    """The blocks of a recording from any source, with the same plausibility check as during recording.

    Samples marked or found implausible are left out, and the next one is marked as after a gap. Each block is held
    until the next one, which may reveal a fault that began in it.

    Parameters
    ----------
    stream
        The recording.
    ratio
        Signed ratio of the drive; without it, without an input angle, or with a locked shaft, the angles are judged
        only by their steps.

    Attributes
    ----------
    count, samples
        Number of samples left out so far, and of all samples.
    """

    def __init__(self, stream: Stream, ratio: float | None) -> None:
        # A locked shaft stands still while the other one moves.
        self._stream, self._ratio = stream, ratio if stream.has_input_angle and not stream.locked else None
        self._found: list[Finding] = []
        self._faults = 0
        self._marked = 0
        self._marks = GapMarks()
        self.count = self.samples = 0

    def __iter__(self) -> Iterator[Block]:
        """Yield each block without implausible samples.

        Raises
        ------
        edge.InputError
            As the recording's `blocks`; `edge.NoDataError` if fewer than two samples remain.
        """
        judge: Plausibility | None = None
        before: tuple[Block, NDArray[np.bool_]] | None = None
        for block in (piece for whole in self._stream.blocks() for piece in whole.pieces()):
            if judge is None:
                judge = Plausibility(self._ratio, _with_resolution(self._stream.limits, block))
            marks, faults = judge.add(
                {role: Samples(role, block.time, None, None, getattr(block, role), block.status) for role in ANGLES}
            )
            implausible = marks["input_angle"] | marks["output_angle"]
            already = block.status & IMPLAUSIBLE != 0
            self._marked += int(np.count_nonzero(already & ~implausible))
            self._found += faults[: _SAID - len(self._found)]
            self._faults += len(faults)
            if before is not None:
                for fault in faults:
                    before[1][before[0].time >= fault.time] = True
                yield from self._left(*before)
            before = block, implausible | already
        if before is not None:
            yield from self._left(*before)
        if self.count and self.samples - self.count < 2:
            raise edge.NoDataError(" ".join([*self._stream.notes, *self.notes(), "Fewer than two samples remain."]))

    def _left(self, block: Block, implausible: NDArray[np.bool_]) -> Iterator[Block]:
        self.samples += block.time.size
        keep = ~implausible if implausible.any() else None
        status = self._marks.of_kept(block.status, keep)
        if keep is None:
            yield block if status is block.status else dataclasses.replace(block, status=status)
            return
        self.count += int(np.count_nonzero(implausible))
        if keep.any():
            yield block.where(keep, status)

    def notes(self) -> list[str]:
        """Return one sentence on the samples left out, if any."""
        if not self.count:
            return []
        moment = "from {:.6g} s" if self._stream.timed else "from sample {:.6g}"
        text = [f"{fault.text} ({moment.format(fault.time)})" for fault in self._found]
        if self._faults > _SAID:
            text.append(f"{self._faults - _SAID} more such faults")
        if self._marked:
            text.append(f"{self._marked} were marked in the file")
        return [
            f"{self._stream.source}: {self.count} of {self.samples} samples are implausible and were left out: "
            f"{'; '.join(text)}."
        ]


def _with_resolution(limits: Limits, block: Block) -> Limits:
    """Return limits with the encoders' resolutions, rad, inferred from repeated values if not stated."""
    shown = {}
    for role in ANGLES:
        name = f"{role.removesuffix('_angle')}_resolution"
        steps = np.abs(np.diff(getattr(block, role)))
        moving = steps[steps > 0.0]
        if getattr(limits, name) == 0.0 and 0 < moving.size < steps.size:
            shown[name] = float(moving.min())
    return dataclasses.replace(limits, **shown)
