"""Alignment of channels in separate pieces on one clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.recording_format import IMPLAUSIBLE
from fitting.samples.block import GapMarks, Piece

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
_TOGETHER = 1 << 13  # samples of each channel that are aligned at a time
GAP_STEPS = 2.5  # a time step above this many usual steps is a gap; one lost sample makes a step of two

Table = dict[str, Array]


class OneClock:
    """Aligns channels in separate pieces with the times of the input angle, or else of the output angle.

    If the angles share most of their times, only samples at these are kept. Otherwise the other channels are
    interpolated between neighbours, but never across a gap: samples there are left out, and the next one is marked.

    Parameters
    ----------
    scales
        {role: (channel, scale, offset)}, see `fitting.readers.mapping.scales_of`.
    rate
        Samples per second, if the file has no times.
    clocks
        {role: (delay, s, relative drift)} of the time stamps.
    """

    def __init__(
        self,
        scales: Mapping[str, tuple[str, float, float]],
        rate: float | None,
        clocks: Mapping[str, tuple[float, float]],
    ) -> None:
        self._scales = scales
        self._clocks = clocks
        self._begun: dict[str, float] = {}
        self._together = len(set(clocks.values())) == 1
        self._rate = rate
        self._roles = [r for r in scales if r != "time"]
        self._master = "input_angle" if "input_angle" in scales else "output_angle"
        self._waiting: dict[str, list[tuple[Array, Array, Bytes]]] = {r: [] for r in self._roles}
        self._usual: dict[str, float] = {}
        self._shared: bool | None = None
        self._came = 0
        self._unpaired = 0
        self._in_gap = 0
        self._outside = 0
        self._marks = GapMarks()

    def add(self, piece: Piece) -> Iterator[tuple[Table, Bytes | None]]:
        """Add the next piece and yield complete samples: {role: SI values} with the time, and the status bits."""
        columns = {r: c for r, (c, _, _) in self._scales.items()}
        here = [r for r in self._scales if columns[r] in piece.values]
        values = {}
        for role in here:
            _, scale, offset = self._scales[role]
            value = piece.values[columns[role]]
            values[role] = value if scale == 1.0 and offset == 0.0 else value * scale + offset
        size = next(iter(values.values())).size
        if "time" in values:
            time = values.pop("time")
        elif piece.time is not None:
            time = piece.time
        else:
            assert self._rate is not None
            time = (self._came + np.arange(size)) / self._rate
        self._came += size
        if self._together and len(values) == len(self._roles) and not any(self._waiting.values()):
            yield {"time": self._corrected(self._master, time), **values}, piece.status
            return
        status = np.zeros(size, np.uint8) if piece.status is None else piece.status
        for role, value in values.items():
            self._waiting[role].append((self._corrected(role, time), value, status))
        if min(sum(t.size for t, _, _ in parts) for parts in self._waiting.values()) >= _TOGETHER:
            yield from self._flush(min(parts[-1][0][-1] for parts in self._waiting.values()))

    def _corrected(self, role: str, time: Array) -> Array:
        """Return the times of samples, s, corrected for delay and clock drift."""
        delay, drift = self._clocks[role]
        if (delay, drift) == (0.0, 0.0) or not time.size:
            return time
        begun = self._begun.setdefault(role, float(time[0]))
        return begun - delay + (time - begun) / (1.0 + drift)

    def finish(self) -> Iterator[tuple[Table, Bytes | None]]:
        """Yield the remaining samples after the last piece."""
        if any(self._waiting.values()) and all(self._waiting.values()):
            ends = [parts[-1][0][-1] for parts in self._waiting.values()]
            master = self._waiting[self._master][-1][0]
            self._outside += int(np.count_nonzero(master > min(ends)))
            yield from self._flush(min(ends))
        self._waiting = {r: [] for r in self._roles}

    def _flush(self, until: float) -> Iterator[tuple[Table, Bytes | None]]:
        joined: dict[str, tuple[Array, Array, Bytes]] = {}
        for role, parts in self._waiting.items():
            columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
            joined[role] = columns[0], columns[1], columns[2]
        for role, (time, value, status) in joined.items():
            if time.size > 1 and (np.diff(time) < 0).any():
                order = np.argsort(time, kind="stable")
                joined[role] = (time[order], value[order], status[order])
        time, value, status = joined[self._master]
        status = status.copy()
        start = max(t[0] for t, _, _ in joined.values())
        chosen = (time >= start) & (time <= until)
        self._outside += int(np.count_nonzero(time < start))
        others = [r for r in self._roles if r != self._master]
        if self._shared is None and chosen.any():
            together = np.isin(time[chosen], joined["output_angle"][0])
            self._shared = bool(self._master == "output_angle" or 2 * together.sum() >= together.size)
        table = {}
        left_out = np.zeros(time.size, bool)
        for role in others:
            other, theirs, statuses = joined[role]
            after = np.clip(np.searchsorted(other, time, "left"), 0, other.size - 1)
            exact = other[after] == time
            usual = self._usual_step(role, other)
            before = np.clip(after - 1, 0, other.size - 1)
            gap = ~exact & (other[after] - other[before] > GAP_STEPS * usual)
            if role == "output_angle" and self._shared:
                lonely = chosen & ~exact
                self._unpaired += int(np.count_nonzero(lonely))
                left_out |= lonely
            else:
                self._in_gap += int(np.count_nonzero(chosen & gap))
                left_out |= gap
            if role == "output_angle":
                status |= np.where(exact, statuses[after], 0).astype(np.uint8)
            status |= (statuses[after] | np.where(exact, 0, statuses[before]).astype(np.uint8)) & np.uint8(IMPLAUSIBLE)
            table[role] = np.interp(time, other, theirs)
        keep = chosen & ~left_out
        marked = self._marks.of_kept(status[chosen], ~left_out[chosen])
        if keep.any():
            yield ({"time": time[keep], self._master: value[keep], **{r: v[keep] for r, v in table.items()}}, marked)
        self._keep(joined, until)

    def _usual_step(self, role: str, time: Array) -> float:
        """Return a channel's usual time step, s, from its first samples."""
        if role not in self._usual:
            self._usual[role] = float(np.median(np.diff(time))) if time.size > 1 else np.inf
        return self._usual[role]

    def _keep(self, joined: Mapping[str, tuple[Array, Array, Bytes]], until: float) -> None:
        """Keep samples after `until` for the next pieces."""
        for role, (times, values, statuses) in joined.items():
            # Keep one earlier sample of the other channels, to interpolate up to the master's next sample.
            first = int(np.searchsorted(times, until, "right"))
            first = first if role == self._master else max(0, first - 1)
            self._waiting[role] = [(times[first:], values[first:], statuses[first:])] if first < times.size else []

    def notes(self) -> list[str]:
        """Return one sentence for each kind of sample that was left out or interpolated."""
        notes = []
        if self._unpaired:
            notes.append(f"{self._unpaired} samples of one angle without the other at the same time were left out.")
        if self._shared is False:
            notes.append("the angles have no times in common; the output angle was interpolated to the input's times.")
        if self._in_gap:
            notes.append(f"{self._in_gap} samples within a gap of another channel were left out.")
        if self._outside:
            notes.append(f"{self._outside} samples before or after those of another channel were left out.")
        return notes
