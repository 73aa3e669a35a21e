"""Pieces of a file and blocks of a recording, block by block, and the marks of samples that are left out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.recording_format import GAP

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
PIECE = 1 << 17  # samples per piece, whose arrays then fit into a processor's cache


@dataclass(frozen=True)
class Piece:
    """Consecutive samples of channels with common times: arrays of equal length.

    Attributes
    ----------
    time
        Seconds in the file's own time base, or None if one of the channels is the time.
    values
        {name: values in the file's unit}.
    status
        Bits of the recording format, or None if the file has none.
    """

    time: Array | None
    values: dict[str, Array]
    status: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Block:
    """Consecutive samples of a recording: SI arrays of equal length, angles unwrapped across blocks.

    Attributes
    ----------
    time, input_angle, output_angle
        Time, s, and angles, rad, counter-clockwise positive.
    torque
        Torque of the environment on the output, N·m.
    temperature
        Temperature, K, or None if not recorded.
    status
        Bits of the recording format: 1 gap before, 32 an angle rolled over, 128 implausible.
    input_torque
        Torque of the environment on the input, N·m, or None if not recorded.
    group
        Number of the group of loops, or None if not recorded.
    """

    time: Array
    input_angle: Array
    output_angle: Array
    torque: Array
    status: Bytes
    temperature: Array | None = None
    input_torque: Array | None = None
    group: Array | None = None

    def where(self, chosen: NDArray[np.bool_] | slice, status: Bytes | None = None) -> Block:
        """Return the chosen samples, with another status if one is given."""
        columns = {f.name: getattr(self, f.name) for f in dataclasses.fields(Block)}
        part = {n: None if v is None else v[chosen] for n, v in columns.items()}
        return Block(**{**part, **({} if status is None else {"status": status})})  # type: ignore[arg-type]

    def pieces(self) -> Iterator[Block]:
        """Yield the block in pieces of at most `PIECE` samples."""
        if self.time.size <= PIECE:
            yield self
            return
        for begin in range(0, self.time.size, PIECE):
            yield self.where(slice(begin, begin + PIECE))


class GapMarks:
    """Carries the mark of samples that are left out to the next one that is not, block by block.

    Examples
    --------
    >>> import numpy as np
    >>> from fitting.samples.block import GapMarks
    >>> marks, none = GapMarks(), np.zeros(3, np.uint8)
    >>> marks.of_kept(none, np.array([True, False, False])), marks.of_kept(none, np.array([False, True, True]))
    (array([0], dtype=uint8), array([1, 0], dtype=uint8))
    """

    def __init__(self) -> None:
        self._pending = False

    def of_kept(self, status: Bytes, keep: NDArray[np.bool_] | None = None) -> Bytes:
        """Return the status of the samples that are kept, by default all; one after others is marked as after a gap."""
        if keep is None:
            if not self._pending or not status.size:
                return status
            status, self._pending = status.copy(), False
            status[0] |= GAP
            return status
        before = np.cumsum(np.concatenate([[self._pending], ~keep]))  # samples left out before each
        indices = np.flatnonzero(keep)
        bits = status[indices]
        bits[np.diff(before[indices], prepend=0) > 0] |= GAP
        self._pending = bool(before[-1] > (before[indices[-1]] if indices.size else 0))
        return bits
