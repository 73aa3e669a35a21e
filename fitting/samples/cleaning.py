"""Cleaning of recordings block by block: unwrapped angles, marked gaps, invalid samples left out and counted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import GAP, ROLLOVER
from fitting.samples.block import Block, GapMarks
from fitting.samples.one_clock import GAP_STEPS

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
_TURN = 2.0 * np.pi
_STILL = np.radians(1.0)  # of the crank: samples with one time stamp are averaged within this motion


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
    """Leaves out invalid samples, marks gaps, unwraps angles and resolves a coarse clock, block by block.

    Samples with one time stamp are averaged if the crank turns by less than 1° among them; otherwise they get
    even times up to the next stamp, as a mean would smooth the transmission error.

    Parameters
    ----------
    rollover
        {angle: its rollover, rad, or None if it is unknown} of every recorded angle.
    source
        The recording, for messages.
    ratio
        Signed ratio input/output, to convert a measured transmission error to the input angle.
    pulley
        Ratio of the output's encoder to the output.
    timed
        Whether the times are seconds; otherwise they count samples.
    """

    def __init__(
        self,
        rollover: Mapping[str, float | None],
        source: str,
        ratio: float | None = None,
        *,
        pulley: float = 1.0,
        timed: bool = True,
    ) -> None:
        self._ratio, self._pulley, self._timed = ratio, pulley, timed
        self._angles = {name: _Angle(period, name, source) for name, period in rollover.items()}
        self._usual = np.nan
        self._last = -np.inf
        self._seen = 0
        self._not_finite: dict[str, tuple[int, int]] = {}
        self._backwards = self._gaps = 0
        self._averaged = self._spread = 0
        self._waiting: tuple[dict[str, Array], Bytes] | None = None
        self._longest = self._longest_at = 0.0
        self._marks = GapMarks()

    def add(self, table: dict[str, Array], status: Bytes | None) -> Block:
        """Return the valid ones of the next samples, given as SI arrays by role; the block may be empty."""
        time = table["time"]
        bits = np.zeros(time.size, np.uint8) if status is None else status.copy()
        keep = self._finite(table)
        bits = self._marks.of_kept(bits, keep)
        if keep is not None:
            table, time = {n: v[keep] for n, v in table.items()}, time[keep]
        self._seen += keep.size if keep is not None else time.size
        repeated = False
        if time.size:
            steps = np.diff(time, prepend=self._last)
            if (least := float(steps.min())) < 0.0 or (least == 0.0 and time[0] == self._last and not self._waiting):
                furthest = np.maximum.accumulate(np.concatenate([[self._last], time]))
                onward = time >= furthest[:-1]
                if not self._waiting:
                    onward &= time > self._last
                self._backwards += int(np.count_nonzero(~onward))
                table, bits, time = {n: v[onward] for n, v in table.items()}, bits[onward], time[onward]
                steps = np.diff(time, prepend=self._last)
            repeated = bool((steps == 0.0).any()) if least <= 0.0 else False
        if not time.size:
            table.pop("transmission_error", None)
            return self._block(table, bits)
        self._gaps_in(time, steps, bits)
        self._last = float(time[-1])
        for name, angle in self._angles.items():
            table[name], rolled = angle.add(table[name])
            if rolled is not None:
                bits[rolled] |= ROLLOVER
        if self._pulley != 1.0:
            table["output_angle"] = table["output_angle"] / self._pulley
        if self._ratio is not None and "transmission_error" in table:
            table["input_angle"] = (table["output_angle"] - table.pop("transmission_error")) * self._ratio
        if repeated or self._waiting:
            table, bits = self._resolved(table, bits)
        return self._block(table, bits)

    def finish(self) -> Block | None:
        """Return the samples of the last time stamp, if they were held back for more of them."""
        if self._waiting is None:
            return None
        (table, bits), self._waiting = self._waiting, None
        return self._block(*self._resolved(table, bits, last=True))

    def _block(self, table: dict[str, Array], bits: Bytes) -> Block:
        """Return a block; an input that is not recorded is at rest, and a torque that is not recorded is unknown."""
        size = table["time"].size
        return Block(**{"input_angle": np.zeros(size), "torque": np.full(size, np.nan), **table}, status=bits)  # type: ignore[arg-type]

    def _resolved(self, table: dict[str, Array], bits: Bytes, *, last: bool = False) -> tuple[dict[str, Array], Bytes]:
        """Return samples with one time each; those of the last stamp are held back unless they are the `last`."""
        if self._waiting is not None:
            held, before = self._waiting
            table, bits = {n: np.concatenate([held[n], v]) for n, v in table.items()}, np.concatenate([before, bits])
        time = table["time"]
        begins = np.flatnonzero(np.concatenate([[True], time[1:] != time[:-1]]))
        stamps = time[begins]
        if last:
            stamps = np.append(stamps, np.inf)
        else:
            end = int(begins[-1])
            self._waiting = {n: v[end:] for n, v in table.items()}, bits[end:]
            table, bits, begins = {n: v[:end] for n, v in table.items()}, bits[:end], begins[:-1]
            if not end:
                return table, bits
        count = np.diff(begins, append=bits.size)
        width = np.diff(stamps)
        width = np.where(np.isinf(width) | (width > GAP_STEPS * self._usual), np.nan_to_num(self._usual), width)
        within = np.arange(bits.size) - np.repeat(begins, count)
        pitch = np.divide(width, count, out=np.zeros(count.size), where=count > 1)
        table["time"] = table["time"] + within * np.repeat(pitch, count)
        crank = table.get("input_angle", np.zeros(bits.size))
        still = np.maximum.reduceat(crank, begins) - np.minimum.reduceat(crank, begins) < _STILL
        self._averaged += int(count[still & (count > 1)].sum())
        self._spread += int(count[~still].sum())
        keep = ~np.repeat(still, count)
        keep[begins[still]] = True
        for name, values in table.items():
            means = values.copy()
            means[begins[still]] = (np.add.reduceat(values, begins) / count)[still]
            table[name] = means[keep]
        joined = bits.copy()
        joined[begins[still]] = np.bitwise_or.reduceat(bits, begins)[still]
        return table, joined[keep]

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
            onward = np.diff(time)
            onward = onward if onward.all() else onward[onward > 0.0]
            self._usual = float(np.median(onward)) if onward.size else np.nan
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
        step = "" if np.isnan(self._usual) else f" (the clock's usual step is {self._usual:.3g} s)"
        stamps = f"share their time stamp with others{step}"
        if self._averaged:
            notes.append(f"{self._averaged} samples {stamps}; those of each stamp were averaged.")
        if self._spread:
            notes.append(
                f"{self._spread} samples {stamps} while the crank turns; they were given even times up to the next "
                "stamp."
            )
        if self._backwards:
            notes.append(f"{self._backwards} samples older than a previous one were left out.")
        if self._gaps:
            longest = "{:.3g} s at {:.6g} s" if self._timed else "{:.3g} samples at sample {:.6g}"
            notes.append(
                f"{self._gaps} gaps, the longest {longest.format(self._longest, self._longest_at)}; they were not "
                "interpolated."
            )
        return notes
