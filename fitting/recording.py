"""The bench recording as evaluation sees it: one clock, one table, SI, validated.

Recordings come block by block, so that they may be larger than memory: times run on, angles are continuous, and what
is missing or was left out is marked and counted, never filled in silence.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import GAP, ROLLOVER
from fitting.mapping import ANGLES, CHANNELS, COLUMNS, ChannelMapping, FileMapping, TimeMapping, own_names, scales_of
from fitting.readers import Piece, open_bench_file

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_TURN = 2.0 * np.pi
_TOGETHER = 1 << 13  # samples of each channel that are put on one clock at a time
_GAP = 2.5  # a step of time beyond this many usual ones is a gap: one lost sample makes a step of two


@dataclass(frozen=True)
class Block:
    """Consecutive samples of a recording: SI arrays of one length, angles continuous with the blocks before.

    Attributes
    ----------
    time, input_angle, output_angle, torque
        s, rad, rad, N·m of the environment on the output.
    temperature
        K, or None where none was recorded.
    status
        Bits of the recording format: 1 a gap before, 32 an angle rolled over.
    input_torque
        N·m of the environment on the input, or None where none was recorded.
    """

    time: Array
    input_angle: Array
    output_angle: Array
    torque: Array
    temperature: Array | None
    status: Bytes
    input_torque: Array | None = None


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
    temperature
        K, or None where none was recorded.
    input_torque
        N·m of the environment on the input, or None where none was recorded.
    alignment, torque_alignment
        Half the 95 % interval, s, of how far the two angles' clocks, and those of output angle and torque, may be apart
        at the recording's ends; 0 where one clock stamped both, or none is known to be another.
    """

    time: Array
    input_angle: Array
    output_angle: Array
    torque: Array
    status: Bytes
    common_zero: bool
    known_index: bool
    ratio: float | None
    source: str
    checksum: str
    notes: tuple[str, ...] = ()
    temperature: Array | None = None
    input_torque: Array | None = None
    alignment: float = 0.0
    torque_alignment: float = 0.0

    def blocks(self) -> Iterator[Block]:
        """Yield the recording as one block."""
        yield Block(
            self.time, self.input_angle, self.output_angle, self.torque, self.temperature, self.status,
            self.input_torque,
        )  # fmt: skip


class BenchStream:
    """A recording in a file, taken block by block.

    Parameters
    ----------
    path
        The file; see `fitting.readers.open_bench_file` for the kinds.
    mapping
        Which channel is what; None where the channels bear our names: time, input_angle, output_angle, torque.

    Attributes
    ----------
    source, ratio, common_zero, known_index
        As in `BenchRecording`.
    notes, alignment, torque_alignment
        As in `BenchRecording`; complete when all blocks were taken.

    Raises
    ------
    edge.InputError
        If the file can't be read, or a channel, its unit or the time is missing.
    """

    def __init__(self, path: str | os.PathLike[str], mapping: FileMapping | None = None) -> None:
        self.source = str(path)
        self._file = open_bench_file(path, None if mapping is None else mapping.dbc)
        self._mapping = own_names(self._file) if mapping is None else mapping
        self._scales = scales_of(self._file, self._mapping)
        self.ratio = self._mapping.ratio if self._mapping.ratio is not None else self._file.ratio
        self.common_zero = self._zero_reference("output_angle") == "absolute"
        self.known_index = self._zero_reference("input_angle") == "absolute"
        self.notes: list[str] = []
        self.alignment = self.torque_alignment = 0.0
        self._digest: list[str] = []
        self._digesting: threading.Thread | None = None

    @property
    def checksum(self) -> str:
        """SHA-256 of the file."""
        self._start_digest().join()
        return self._digest[0]

    def _start_digest(self) -> threading.Thread:
        """Work the checksum out beside what reads the blocks: hours at kilohertz are gigabytes."""
        if self._digesting is None:
            # An interrupt or a refused file does not wait for it.
            file = Path(self.source).open("rb")  # noqa: SIM115
            self._digesting = threading.Thread(target=self._take_digest, args=(file,), daemon=True)
            self._digesting.start()
        return self._digesting

    def _take_digest(self, file: io.BufferedReader) -> None:
        with file:
            self._digest.append(hashlib.file_digest(file, "sha256").hexdigest())

    def _zero_reference(self, name: str) -> str:
        channel: ChannelMapping | None = getattr(self._mapping, name)
        if channel is None:
            return "incremental"
        if channel.zero_reference is not None:
            return channel.zero_reference
        return next(c.zero_reference for c in self._file.channels if c.name == channel.column)

    def blocks(self) -> Iterator[Block]:
        """Yield the recording's blocks in the order of time.

        Raises
        ------
        edge.InputError
            If a value of the file is no number, or it ends before a sample came.
        """
        self._start_digest()
        clocks = {n: (m.delay, m.drift) for n in CHANNELS if (m := getattr(self._mapping, n)) is not None}
        merge = _OneClock(self._scales, self._mapping.time, clocks)
        tidy = _Tidy({n: getattr(self._mapping, n) for n in ANGLES}, self.source)
        names = list(dict.fromkeys(column for column, _, _ in self._scales.values()))
        kept = 0
        for piece in self._file.pieces(names):
            for table, status in merge.add(piece):
                block = tidy.add(table, status)
                kept += block.time.size
                if block.time.size:
                    yield block
        for table, status in merge.finish():
            block = tidy.add(table, status)
            kept += block.time.size
            if block.time.size:
                yield block
        said = [*self._clock_notes(), *merge.notes(), *tidy.notes()]
        self.notes = [*self._file.problems, *(f"{self.source}: {n}" for n in said)]
        if self._mapping.input_angle is None:
            self.notes.append(f"{self.source}: no input angle is mapped; the input is taken as locked.")
        if kept < 2:
            raise edge.InputError(
                " ".join([*self.notes, f"{self.source}: the recording has {kept or 'no'} samples; a curve needs more."])
            )

    def _clock_notes(self) -> list[str]:
        """Say which channels were put on the host's clock, and keep how well those of a pair are known to agree."""
        clocks = {role: c for role, (name, _, _) in self._scales.items() if (c := self._file.clocks.get(name))}

        def apart(roles: tuple[str, ...]) -> float:
            own = {clocks.get(role) for role in roles if role in self._scales}
            return math.hypot(*(clock.uncertainty for clock in own if clock is not None)) if len(own) > 1 else 0.0

        self.alignment, self.torque_alignment = apart(ANGLES), apart(("output_angle", "torque"))
        return [
            f"{role} has a clock of its own, which runs {-clock.drift * 1e6:+.3g} ppm fast; its samples were put on "
            f"the host's to ± {clock.uncertainty * 1e6:.2g} µs (95 %)."
            for role, clock in clocks.items()
        ]


def open_bench_recording(path: str | os.PathLike[str], mapping: FileMapping | None = None) -> BenchStream:
    """Open a recording that may be larger than memory; see `BenchStream`."""
    return BenchStream(path, mapping)


def read_bench_recording(path: str | os.PathLike[str], mapping: FileMapping | None = None) -> BenchRecording:
    """Read a whole recording into memory; see `BenchStream`.

    Raises
    ------
    edge.InputError
        If the file can't be read, or a channel, its unit or the time is missing.
    """
    stream = open_bench_recording(path, mapping)
    blocks = list(stream.blocks())

    def joined(name: str) -> Array:
        return np.concatenate([getattr(b, name) for b in blocks])

    return BenchRecording(
        **{name: joined(name) for name in COLUMNS},
        status=np.concatenate([b.status for b in blocks]),
        common_zero=stream.common_zero,
        known_index=stream.known_index,
        ratio=stream.ratio,
        source=stream.source,
        checksum=stream.checksum,
        notes=tuple(stream.notes),
        temperature=None if blocks[0].temperature is None else joined("temperature"),
        input_torque=None if blocks[0].input_torque is None else joined("input_torque"),
        alignment=stream.alignment,
        torque_alignment=stream.torque_alignment,
    )


Table = dict[str, Array]


class _OneClock:
    """Puts channels that come in pieces of their own on one clock: the input angle's, or the output's without one.

    Where the angles share most of their instants only these are kept. Otherwise the others are interpolated between
    neighbours, but never over a gap: samples there are left out, and the next one is marked.
    """

    def __init__(
        self,
        scales: Mapping[str, tuple[str, float, float]],
        time: TimeMapping | None,
        clocks: Mapping[str, tuple[float, float]],
    ) -> None:
        self._scales = scales
        self._clocks = clocks
        self._begun: dict[str, float] = {}
        self._together = len(set(clocks.values())) == 1
        self._rate = None if time is None else time.rate
        self._roles = [r for r in scales if r != "time"]
        self._master = "input_angle" if "input_angle" in scales else "output_angle"
        self._waiting: dict[str, list[tuple[Array, Array, Bytes]]] = {r: [] for r in self._roles}
        self._usual: dict[str, float] = {}
        self._shared: bool | None = None
        self._came = 0
        self._unpaired = 0
        self._in_gap = 0
        self._outside = 0
        self._mark_next = False

    def add(self, piece: Piece) -> Iterator[tuple[Table, Bytes | None]]:
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
            yield from self._flush(min(parts[-1][0][-1] for parts in self._waiting.values()), last=False)

    def _corrected(self, role: str, time: Array) -> Array:
        """Return when samples were taken: without their delay, and by a clock that drifts no more."""
        delay, drift = self._clocks[role]
        if (delay, drift) == (0.0, 0.0) or not time.size:
            return time
        begun = self._begun.setdefault(role, float(time[0]))
        return begun - delay + (time - begun) / (1.0 + drift)

    def finish(self) -> Iterator[tuple[Table, Bytes | None]]:
        if any(self._waiting.values()) and all(self._waiting.values()):
            ends = [parts[-1][0][-1] for parts in self._waiting.values()]
            master = self._waiting[self._master][-1][0]
            self._outside += int(np.count_nonzero(master > min(ends)))
            yield from self._flush(min(ends), last=True)
        self._waiting = {r: [] for r in self._roles}

    def _flush(self, until: float, *, last: bool) -> Iterator[tuple[Table, Bytes | None]]:
        joined = {
            role: tuple(np.concatenate([p[i] for p in parts]) for i in range(3))
            for role, parts in self._waiting.items()
        }
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
            other, theirs, said = joined[role]
            after = np.clip(np.searchsorted(other, time, "left"), 0, other.size - 1)
            exact = other[after] == time
            usual = self._usual.setdefault(role, float(np.median(np.diff(other))) if other.size > 1 else np.inf)
            before = np.clip(after - 1, 0, other.size - 1)
            gap = ~exact & (other[after] - other[before] > _GAP * usual)
            if role == "output_angle" and self._shared:
                lonely = chosen & ~exact
                self._unpaired += int(np.count_nonzero(lonely))
                left_out |= lonely
            else:
                self._in_gap += int(np.count_nonzero(chosen & gap))
                left_out |= gap
            if role == "output_angle":
                status |= np.where(exact, said[after], 0).astype(np.uint8)
            table[role] = np.interp(time, other, theirs)
        keep = chosen & ~left_out
        if left_out.any():
            marked = np.flatnonzero(keep & np.concatenate([[self._mark_next], (left_out & chosen)[:-1]]))
            status[marked] |= GAP
        if chosen.any():
            self._mark_next = bool(left_out[np.flatnonzero(chosen)[-1]])
        if keep.any():
            yield (
                {"time": time[keep], self._master: value[keep], **{r: v[keep] for r, v in table.items()}},
                status[keep],
            )
        for role, (times, values, statuses) in joined.items():
            # Of the others one sample before stays: the next of the master's lies behind it.
            first = int(np.searchsorted(times, until, "right"))
            first = first if role == self._master else max(0, first - 1)
            self._waiting[role] = [(times[first:], values[first:], statuses[first:])] if first < times.size else []

    def notes(self) -> list[str]:
        said = []
        if self._unpaired:
            said.append(f"{self._unpaired} samples of one angle without the other's at the same instant were left out.")
        if self._shared is False:
            said.append("the angles share no instants; the output angle was interpolated to the input's times.")
        if self._in_gap:
            said.append(f"{self._in_gap} samples fall into another channel's gap and were left out.")
        if self._outside:
            said.append(f"{self._outside} samples before or after another channel's were left out.")
        return said


class _Angle:
    """Unrolls an angle block by block.

    An angle that has a rollover, or stays within one turn and then jumps by more than half a one, rolls over; one that
    ran beyond a turn is continuous already.
    """

    def __init__(self, rollover: float | None, name: str, source: str) -> None:
        self._period = rollover
        self._name, self._source = name, source
        self._low = self._high = self._last = self._offset = np.nan
        self.rolls: bool | None = None if rollover is None else True

    def add(self, angle: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """Return the angle continuous with what came before, and where it rolled over (None: nowhere)."""
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
        turns = -np.round(steps / period)
        unrolled = angle + (self._offset + period * np.cumsum(turns))
        self._offset += period * float(turns.sum())
        return unrolled, turns != 0.0

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
                    f"{self._source}: {self._name} jumps by {largest:.1f} rad, as an angle in degrees does where it "
                    "rolls over; its unit is deg, not rad."
                )
        self._low, self._high = low, high
        if self.rolls is None and high - low > _TURN * (1.0 + 1e-9):
            self.rolls = False


class _Tidy:
    """Leaves out what is no sample, marks gaps, makes angles continuous; block by block."""

    def __init__(self, mapped: Mapping[str, ChannelMapping | None], source: str) -> None:
        self._angles = {n: _Angle(m.rollover, n, source) for n, m in mapped.items() if m is not None}
        self._usual = np.nan
        self._last = -np.inf
        self._seen = 0
        self._not_finite: dict[str, tuple[int, int]] = {}
        self._duplicates = self._backwards = self._gaps = 0
        self._longest = self._longest_at = 0.0
        self._mark_next = False

    def add(self, table: Table, status: Bytes | None) -> Block:
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
            return Block(time, time, time, time, table.get("temperature"), bits, table.get("input_torque"))
        self._gaps_in(time, steps, bits)
        self._last = float(time[-1])
        for name, angle in self._angles.items():
            table[name], rolled = angle.add(table[name])
            if rolled is not None:
                bits[rolled] |= ROLLOVER
        return Block(
            time=time,
            input_angle=table.get("input_angle", np.zeros(time.size)),
            output_angle=table["output_angle"],
            torque=table["torque"],
            temperature=table.get("temperature"),
            status=bits,
            input_torque=table.get("input_torque"),
        )

    def _finite(self, table: Table) -> NDArray[np.bool_] | None:
        """Return which samples are finite in all that is needed, or None where all are."""
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
        if largest > _GAP * self._usual:
            wide = np.flatnonzero(steps > _GAP * self._usual)
            at = wide + (time.size - steps.size)
            bits[at] |= GAP
            self._gaps += wide.size
            if largest > self._longest:
                self._longest, self._longest_at = largest, float(time[at[np.argmax(steps[wide])]]) - largest

    def notes(self) -> list[str]:
        said = []
        for name, (count, first) in self._not_finite.items():
            also = f" and {count - 1} more" if count > 1 else ""
            said.append(f"{name} is not a finite number in sample {first}{also}; left out.")
        if self._duplicates:
            said.append(f"{self._duplicates} samples at the time of the one before were left out.")
        if self._backwards:
            said.append(f"{self._backwards} samples older than one before were left out.")
        if self._gaps:
            said.append(
                f"{self._gaps} gaps, the longest {self._longest:.3g} s at {self._longest_at:.6g} s; nothing was "
                "interpolated over them."
            )
        return said
