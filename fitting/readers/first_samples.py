"""The first samples of the channels of a bench file, from which a mapping is proposed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.readers.formats import BenchFile, RawChannel, pieces_of

Array = NDArray[np.float64]

INSPECTED = 1 << 20  # samples of a channel


@dataclass(frozen=True)
class FirstSamples:
    """The first samples of a channel: arrays of shape (samples,) in the file's unit.

    Attributes
    ----------
    channel
        Name and unit.
    time
        Times, s, or None if a channel is the time.
    values
        Values as stored.
    """

    channel: RawChannel
    time: Array | None
    values: Array

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest value; NaN without any."""
        finite = self.values[np.isfinite(self.values)]
        return (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)

    @property
    def travel(self) -> float:
        """Sum of the absolute steps, without those beyond half the range (rollovers)."""
        steps = np.abs(np.diff(self.values[np.isfinite(self.values)]))
        return float(steps[steps < 0.5 * np.ptp(self.values)].sum()) if steps.size else 0.0


def first_samples(file: BenchFile) -> list[FirstSamples]:
    """Read the first samples of every channel of a file."""
    names = [c.name for c in file.channels]
    if not names:
        return []
    parts: dict[str, list[tuple[Array | None, Array]]] = {n: [] for n in names}
    taken = dict.fromkeys(names, 0)
    for piece in pieces_of(file, names):
        for name, values in piece.values.items():
            if taken[name] < INSPECTED:
                parts[name].append((piece.time, values))
                taken[name] += values.size
        if min(taken.values()) >= INSPECTED:
            break
    looks = []
    for channel in file.channels:
        mine = parts[channel.name]
        if not mine:
            continue
        times = [t for t, _ in mine if t is not None]
        looks.append(
            FirstSamples(
                channel,
                np.concatenate(times) if len(times) == len(mine) else None,
                np.concatenate([v for _, v in mine]),
            )
        )
    return looks
