"""Cleaning of recordings block by block: unwrapped angles, marked gaps, invalid samples left out and counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import GAP, ROLLOVER
from fitting.recordings.one_clock import GAP_STEPS

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
_TURN = 2.0 * np.pi


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
    """

    time: Array
    input_angle: Array
    output_angle: Array
    torque: Array
    status: Bytes
    temperature: Array | None = None
    input_torque: Array | None = None


class _Angle:
    """Unwraps an angle block by block.

    An angle rolls over if a rollover is stated, or if it stays within one turn and then jumps by more than half a turn;
    one that exceeds a turn is already continuous.
    """

    def __init__(self, rollover: float | None, name: str, source: str) -> None:
        self._period = rollover
        self._name, self._source = name, source
        self._low = self._high = self._last = self._offset = np.nan
        self.rolls: bool | None = None if rollover is None else True

    def add(self, angle: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """Return the angle unwrapped across blocks, and the mask of its rollovers (None: none)."""
        if np.isnan(self._offset):
            self._offset, self._last = 0.0, angle[0]
            self._low = self._high = angle[0]
        steps = np.diff(angle, prepend=self._last)
        largest = max(float(steps.max()), -float(steps.min()))
        if self.rolls is None:
            self._decide(angle, steps, largest)
        self._last = angle[-1]
        if not self.rolls:
            return angle, None
        period = self._period or _TURN
        if largest <= 0.5 * period:
            return (angle if self._offset == 0.0 else angle + self._offset), None
        # Few samples roll over: 1.4 times as fast as rounding every step.
        wide = np.flatnonzero(np.abs(steps) > 0.5 * period)
        turns = np.concatenate([[0.0], -np.round(steps[wide] / period)])
        offsets = self._offset + period * np.cumsum(turns)
        self._offset = float(offsets[-1])
        rolled = np.zeros(angle.size, np.bool_)
        rolled[wide] = turns[1:] != 0.0
        return angle + np.repeat(offsets, np.diff(wide, prepend=0, append=angle.size)), rolled

    def _decide(self, angle: Array, steps: Array, largest: float) -> None:
        low, high = min(self._low, float(angle.min())), max(self._high, float(angle.max()))
        if largest > np.pi:
            jump = int(np.argmax(np.abs(steps) > np.pi))
            before = angle[:jump]
            span = max(self._high, before.max(initial=-np.inf)) - min(self._low, before.min(initial=np.inf))
            turn = _TURN * (1.0 + 1e-9)
            if high - low <= turn and span <= turn:
                self.rolls = True
            elif 0.9 * 360.0 < largest <= high - low <= 360.0 * (1.0 + 1e-9) and np.count_nonzero(
                np.abs(steps) > 180.0
            ) < 0.1 * max(steps.size, 10):
                raise edge.InputError(
                    f"{self._source}: {self._name} jumps by {largest:.1f} rad, as an angle in degrees does when it "
                    "rolls over; its unit is deg, not rad."
                )
        self._low, self._high = low, high
        if self.rolls is None and high - low > _TURN * (1.0 + 1e-9):
            self.rolls = False


class Cleaning:
    """Leaves out invalid samples, marks gaps and unwraps angles, block by block.

    Given the ratio, it converts a measured transmission error to the input angle.
    """

    def __init__(self, rollover: Mapping[str, float | None], source: str, ratio: float | None = None) -> None:
        self._ratio = ratio
        self._angles = {name: _Angle(period, name, source) for name, period in rollover.items()}
        self._usual = np.nan
        self._last = -np.inf
        self._seen = 0
        self._not_finite: dict[str, tuple[int, int]] = {}
        self._duplicates = self._backwards = self._gaps = 0
        self._longest = self._longest_at = 0.0
        self._mark_next = False

    def add(self, table: dict[str, Array], status: Bytes | None) -> Block:
        """Return the valid ones of the next samples, given as SI arrays by role; the block may be empty."""
        time = table["time"]
        bits = np.zeros(time.size, np.uint8) if status is None else status.copy()
        keep = self._finite(table)
        if keep is not None:
            bits[1:][keep[1:] & ~keep[:-1]] |= GAP
            if self._mark_next and keep[0]:
                bits[0] |= GAP
            self._mark_next = not keep[-1]
            table, bits, time = {n: v[keep] for n, v in table.items()}, bits[keep], time[keep]
        elif self._mark_next and time.size:
            bits[0] |= GAP
            self._mark_next = False
        self._seen += keep.size if keep is not None else time.size
        if time.size:
            steps = np.diff(time, prepend=self._last)
            if steps.min() <= 0.0:
                furthest = np.maximum.accumulate(np.concatenate([[self._last], time]))
                onward = time > furthest[:-1]
                same = ~onward & (time == furthest[:-1])
                self._duplicates += int(np.count_nonzero(same))
                self._backwards += int(np.count_nonzero(~onward & ~same))
                table, bits, time = {n: v[onward] for n, v in table.items()}, bits[onward], time[onward]
                steps = np.diff(time, prepend=self._last)
        if not time.size:
            table.pop("transmission_error", None)
            return Block(**{"input_angle": time, **table}, status=bits)  # type: ignore[arg-type]
        self._gaps_in(time, steps, bits)
        self._last = float(time[-1])
        for name, angle in self._angles.items():
            table[name], rolled = angle.add(table[name])
            if rolled is not None:
                bits[rolled] |= ROLLOVER
        if self._ratio is not None and "transmission_error" in table:
            table["input_angle"] = (table["output_angle"] - table.pop("transmission_error")) * self._ratio
        return Block(**{"input_angle": np.zeros(time.size), **table}, status=bits)  # type: ignore[arg-type]

    def _finite(self, table: dict[str, Array]) -> NDArray[np.bool_] | None:
        """Return the mask of samples that are finite in all needed channels, or None if all are."""
        keep = None
        for name, value in table.items():
            if name == "temperature" or np.isfinite(value.sum()):
                continue
            wrong = ~np.isfinite(value)
            if not wrong.any():
                continue
            count, first = self._not_finite.get(name, (0, self._seen + int(np.argmax(wrong))))
            self._not_finite[name] = (count + int(np.count_nonzero(wrong)), first)
            keep = ~wrong if keep is None else keep & ~wrong
        return keep

    def _gaps_in(self, time: Array, steps: Array, bits: Bytes) -> None:
        if np.isnan(self._usual) and time.size > 2:
            self._usual = float(np.median(np.diff(time)))
        if not np.isfinite(self._last):
            steps = steps[1:]
        largest = float(steps.max(initial=0.0))
        if largest > GAP_STEPS * self._usual:
            wide = np.flatnonzero(steps > GAP_STEPS * self._usual)
            at = wide + (time.size - steps.size)
            bits[at] |= GAP
            self._gaps += wide.size
            if largest > self._longest:
                self._longest, self._longest_at = largest, float(time[at[np.argmax(steps[wide])]]) - largest

    def notes(self) -> list[str]:
        """Return one sentence for each kind of sample that was left out or marked so far."""
        notes = []
        for name, (count, first) in self._not_finite.items():
            also = f" and {count - 1} more" if count > 1 else ""
            notes.append(f"{name} is not a finite number in sample {first}{also}; left out.")
        if self._duplicates:
            notes.append(f"{self._duplicates} samples with the time of the previous one were left out.")
        if self._backwards:
            notes.append(f"{self._backwards} samples older than a previous one were left out.")
        if self._gaps:
            notes.append(
                f"{self._gaps} gaps, the longest {self._longest:.3g} s at {self._longest_at:.6g} s; they were not "
                "interpolated."
            )
        return notes
