"""Counters and transducers that send lines of text, described by a line with fields: "{sequence};{time};{counts}".

Fields: `{counts}` or `{value}` is the measured quantity (exactly one is required), `{time}` the device's own clock,
`{sequence}` the line's sequence number, `{checksum}` two hexadecimal digits, `{skip}` any text. Text between the fields
must match exactly; a line that differs is lost, which is counted and marked.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
import time
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pydantic

from cycloid_fmu import edge
from drivers.counts import Pace, counted, counts_to_value, judge_sequence, missing_by_pace, unwrap
from drivers.encoder import AngleConfig, ChannelConfig, EncoderProtocolError, EncoderTimeout, channel_of
from drivers.lines import PortConfig
from drivers.recording_format import GAP, OUT_OF_ORDER, RESET, ROLLOVER, Samples
from drivers.serial.polled import SerialEncoder
from drivers.serial.port import Exchange, PortHub, ask

LONGEST_LINE = 4096
FIRST_LINE_SECONDS = 2.0
_RESET_SECONDS = 1.0
_FIELDS = {
    "counts": r"([+-]?\d{1,18})",
    "value": r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)",
    "time": r"(\d{1,18}(?:\.\d{0,12})?)",
    "sequence": r"(\d{1,18})",
    "checksum": r"([0-9A-Fa-f]{2})",
}
_MOST_SKIPS = 6  # matching takes too long with more
_CHECKSUMS: dict[str, Callable[[bytes], int]] = {
    "xor": lambda text: functools.reduce(operator.xor, text, 0),
    "sum": lambda text: sum(text) & 0xFF,
}


class AsciiConfig(AngleConfig):
    """A `[channel.X]` with protocol = "ascii".

    Attributes
    ----------
    port
        Name of the port's table.
    line
        The line as sent, without its line end: `{counts}` or `{value}` is the measured quantity, `{time}` the device's
        clock, `{sequence}` the line's number, `{checksum}` two hexadecimal digits, `{skip}` any text.
    request
        Text that requests a line; absent: the device sends lines on its own.
    counts_modulus, sequence_modulus, time_modulus
        Values at which the device's numbers start again from 0; absent: they do not (the sequence: 2^32).
    time_unit
        Unit of the device's time, such as "1 us".
    unit
        Unit of `{value}`, such as "N*m".
    checksum
        "xor" (NMEA 0183: of the text between a leading "$" or "!" and the "*" before the field) or "sum" (modulo 256,
        of all text before the field).
    """

    port: str
    line: str
    request: str | None = None
    counts_modulus: Annotated[int, pydantic.Field(ge=2, le=1 << 62)] | None = None
    sequence_modulus: Annotated[int, pydantic.Field(ge=2, le=1 << 62)] = 1 << 32
    time_modulus: Annotated[int, pydantic.Field(ge=2, le=1 << 62)] | None = None
    time_unit: edge.Seconds = 1.0
    unit: str | None = None
    checksum: Literal["xor", "sum"] | None = None

    @pydantic.field_validator("line")
    @classmethod
    def _line(cls, value: str) -> str:
        fields = re.findall(r"\{(\w*)\}", value)
        unknown = [f for f in fields if f not in _FIELDS and f != "skip"]
        if unknown:
            raise ValueError(f"there is no field {{{unknown[0]}}}; the fields are {', '.join(_FIELDS)} and skip")
        if ("counts" in fields) == ("value" in fields):
            raise ValueError("write exactly one of the fields {counts} and {value}")
        if fields.count("skip") > _MOST_SKIPS or "{skip}{skip}" in value:
            raise ValueError(f"{{skip}} is allowed at most {_MOST_SKIPS} times, and not twice in a row")
        twice = [f for f in _FIELDS if fields.count(f) > 1]
        if twice:
            raise ValueError(f"the field {{{twice[0]}}} occurs twice")
        return value


def line_pattern(line: str) -> tuple[re.Pattern[bytes], list[str]]:
    """Return the regular expression of a line with fields, and the names of its groups in order."""
    parts, names = [], []
    for part in re.split(r"(\{\w+\})", line):
        name = part[1:-1] if part.startswith("{") else ""
        if name in _FIELDS:
            parts.append(_FIELDS[name])
            names.append(name)
        else:
            parts.append(r"[^\r\n]*?" if name == "skip" else re.escape(part))
    return re.compile("".join(parts).encode()), names


class _Line(NamedTuple):
    """A line without its line end, when that arrived, s since 1970, and `note` and `late` of its `Exchange`."""

    time: float
    text: bytes
    noted: bool
    late: bool


class AsciiCounter(SerialEncoder):
    """A device that sends one line per sample.

    Lost lines are detected by the sequence number, else by the device's clock, else by errors of the port and pauses. A
    line without the device's clock that may have waited in the port has no known time and is left out.

    Raises
    ------
    edge.InputError
        If an angle has no counts per turn, or the unit is unknown.
    """

    configuration: ClassVar[type[ChannelConfig]] = AsciiConfig
    cyclic: ClassVar[bool] = False  # whether it is known to send at one interval

    def __init__(self, name: str, config: AsciiConfig, port: PortConfig) -> None:
        super().__init__(name, config, port)
        self.where = f'{name}: line-based device on "{port.url}"'
        self._pattern, self._names = line_pattern(config.line)
        self._unit = {"torque": "N*m", "input_angle": "rad", "output_angle": "rad"}.get(name, config.unit or "rad")
        self._scale = 1.0
        if "counts" in self._names and config.counts_per_turn is None:
            raise edge.InputError("counts_per_turn is missing: lines with counts do not state it.")
        if "checksum" in self._names and config.checksum is None:
            raise edge.InputError('checksum is missing: write "xor" or "sum".')
        if "value" in self._names:
            try:
                self._scale = edge.unit_scale(config.unit or self._unit, self._unit)
            except ValueError as problem:
                raise edge.InputError(f'unit = "{config.unit}": {problem}.') from None
        self._shows_losses = not {"sequence", "time"}.isdisjoint(self._names)  # these show missing lines
        self._request = (config.request or "").encode()
        self.asked = bool(self._request)
        self._forget()

    def _forget(self) -> None:
        """Reset to the state before the first line."""
        self._rest, self._skipping = b"", True
        self._counts: int | None = None
        self._newest: int | None = None
        self._device = 0.0  # the device's clock, continuous, in its own unit
        self._device_start: float | None = None
        self._ticks: tuple[float, float] | None = None
        self._noted, self._doubtful = 0, False
        self._pace = Pace(cyclic=self.cyclic)

    def question(self, port: Any) -> bytes:
        """Request a line and return it; see `SerialEncoder.question`."""
        return ask(port, self._request, 0) + bytes(port.read_until(b"\n", LONGEST_LINE))

    def set_up(self, hub: PortHub) -> None:
        """Wait for a line that matches; see `HubEncoder.set_up`."""
        self._rest, self._skipping = b"", not self._request
        deadline = time.monotonic() + FIRST_LINE_SECONDS
        came = b""
        while time.monotonic() < deadline:
            came = (came + hub.exchange(self.question, self.asked).answer)[-LONGEST_LINE:]
            if any(self._fields(line) for line in came.split(b"\n")[1 - bool(self._request) : -1]):
                break
        else:
            if not came:
                raise EncoderTimeout(f"{self.where} sends nothing; is it powered, and is the baud rate right?")
            shown = came[-24:].decode("ascii", "backslashreplace")
            raise EncoderProtocolError(
                f'{self.where} sends no line like "{self.config.line}" but "{shown}"; is the baud rate right?'
            )
        clock = "; the device's own clock is in time_device" if "time" in self._names else ""
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f'lines "{self.config.line}"',
            time_source=f"host clock: {'middle of the exchange' if self.asked else 'arrival of the line'}{clock}",
            unit=self._unit,
            counts_per_turn=self.config.counts_per_turn,
        )

    def _fields(self, line: bytes) -> dict[str, str] | None:
        """Return the fields of a line; None if it does not match."""
        match = self._pattern.fullmatch(line.rstrip(b"\r"))
        return None if match is None else dict(zip(self._names, (g.decode() for g in match.groups()), strict=True))

    def _sum_right(self, line: bytes, fields: dict[str, str]) -> bool:
        if "checksum" not in fields:
            return True
        match = self._pattern.match(line)
        assert match is not None, "a line with fields has matched"
        text = line[: match.start(1 + self._names.index("checksum"))]
        if self.config.checksum == "xor":
            text = text.lstrip(b"$!").removesuffix(b"*")
        return _CHECKSUMS[self.config.checksum](text) == int(fields["checksum"], 16)

    def _lines(self, exchanges: list[Exchange]) -> list[_Line]:
        """Split the received bytes into lines, each with the arrival time of its line end."""
        lines: list[_Line] = []
        for exchange in exchanges:
            when, data, note, late = exchange
            if note:  # within a line, the loss may be in it or after it
                self._noted = 1 + bool(self._rest)
            if self._request and not data.endswith(b"\n"):
                ended = [data]
            else:
                *ended, self._rest = (self._rest + data).split(b"\n")
                if len(self._rest) > LONGEST_LINE:
                    ended.append(self._rest[:64])
                    self._rest = b""
            for text in ended:
                lines.append(_Line(when, text, self._noted > 0, late))
                self._noted = max(0, self._noted - 1)
        if lines and self._skipping:  # the first line may have begun before listening did
            self._skipping = False
            return lines[1:]
        return lines

    def read(self, timeout: float) -> Samples | None:
        """Return the samples of the new lines; see `Encoder.read`."""
        lines = self._lines(self.taken(timeout))
        if not lines:
            return None
        parsed = [self._fields(line.text) for line in lines]
        there = np.array([p is not None for p in parsed])
        right = np.array(
            [p is not None and self._sum_right(line.text, p) for p, line in zip(parsed, lines, strict=True)]
        )
        wrong = there & ~right
        late = right & np.array([line.late and "time" not in self._names for line in lines])
        causes = {"not as described": ~there, "wrong checksum": wrong, "delayed, so its time is unknown": late}
        shown = [line.text[:40] for line in lines]
        self.say_lost(
            "line",
            [line.time for line in lines],
            causes,
            lambda k: f' ("{shown[k].decode("ascii", "backslashreplace")}")',
        )
        shows_losses = self._shows_losses
        noted = np.array([line.noted and not shows_losses for line in lines])
        right &= ~late
        if not shows_losses and (self.asked or self._pace.period is None):
            self._lost += int(np.count_nonzero(~right))
        valid = np.flatnonzero(right)
        status = self.marked(valid, ~there | late | noted, wrong)
        if len(valid) == 0:
            return None
        fields = [parsed[i] or {} for i in valid]
        times = np.array([lines[i].time for i in valid])
        # Near delayed lines and errors of the port, before or after them, lines may be lost.
        doubtful = np.array([self._doubtful, *(line.late or line.noted for line in lines)])
        self._doubtful = bool(doubtful[-1])
        doubtful = (doubtful[1:] | doubtful[:-1])[valid]
        status, device, expected = self._clocked(fields, times, status, doubtful)
        status = self._numbered(fields, times, status, expected)
        if "value" in self._names:
            value = self.config.direction * self._scale * np.array([float(f["value"]) for f in fields])
            return Samples.checked(self.name, times, value - self.config.zero, time_device=device, status=status)
        counts = np.array([int(f["counts"]) for f in fields], np.int64)
        if self.config.counts_modulus is not None:
            signed = bool(counts[0] < 0)
            counts, rolled = unwrap(counts, self.config.counts_modulus, self._counts, signed=signed)
            status = status | rolled * ROLLOVER
        self._counts = int(counts[-1])
        value = counts_to_value(counts, self.config.counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(self.name, times, value, time_device=device, counts=counts, status=status)

    def _clocked(
        self, fields: list[dict[str, str]], times: Any, status: Any, doubtful: npt.NDArray[np.bool_]
    ) -> tuple[Any, Any, Any]:
        """Evaluate the device's clock.

        Parameters
        ----------
        fields, times, status
            Fields, arrival times, s, and status bits of the lines, n each.
        doubtful
            Mask of the lines before which others may be lost, shape (n,).

        Returns
        -------
        status
            Status with resets of the clock, and with gaps that nothing else shows, shape (n,).
        time_device, expected
            Unwrapped device times, s, and number of lines expected since the previous one, NaN where unknown, shape
            (n,) both; None without a device clock.
        """
        first = self._ticks is None
        if "time" not in self._names:
            if not (self._shows_losses or self.asked):
                step = np.diff(times, prepend=times[0] if self._ticks is None else self._ticks[1])
                self._ticks = 0.0, float(times[-1])
                known = status & GAP > 0
                # With one interval, a pause is a gap if no lines come in quick succession after it, delayed ones.
                pauses = step > (self._pace.longest if self.cyclic else math.inf)
                missing = self._paced(times, times, step, known | pauses, first, known)
                status = status | (missing > 0) * GAP
            return status, None, None
        ticks = np.array([float(f["time"]) for f in fields])
        last, arrived = self._ticks or (ticks[0], times[0])
        before = np.concatenate([[last], ticks[:-1]])
        step, waited = ticks - before, np.diff(times, prepend=arrived)
        self._ticks = float(ticks[-1]), float(times[-1])
        if self.config.time_modulus is not None:
            step = step % self.config.time_modulus
            step = np.where(step > self.config.time_modulus / 2, step - self.config.time_modulus, step)
        # The clock goes back slightly at a line out of order, and by all its time at a restart of the device.
        reset = (ticks < before / 2) & (np.abs(step * self.config.time_unit - waited) > _RESET_SECONDS)
        reset |= (ticks < before / 2) & (step < 0)
        step = np.where(reset, ticks - before, step)
        device = self._device + np.cumsum(step)
        if self._device_start is None:
            self._device_start = float(ticks[0])
            device += ticks[0]
        self._device = float(device[-1])
        if reset.any():
            self.say(times[np.flatnonzero(reset)[0]], "the device's clock went back: it restarted")
            status = status | reset * (RESET | GAP)
        device, step = device * self.config.time_unit, step * self.config.time_unit
        period = self._pace.period
        expected = np.where(reset, np.nan, step / (period or math.nan))
        gaps = ~reset & ((step > self._pace.longest) | (status & GAP > 0) | (doubtful & (expected > 1.5)))
        if "sequence" in self._names:  # which is more reliable
            gaps[:] = False
        missing = self._paced(times, device, step, gaps, first, reset | (status & GAP > 0) | (expected > 30))
        status = status | (missing > 0) * GAP
        return status, device, expected

    def _paced(self, arrived: Any, times: Any, step: Any, gaps: Any, first: bool, odd: Any = False) -> Any:
        """Return how many lines are missing at the gaps, from the usual interval, and update that interval.

        `first`: there is no line before the first one; `odd`: mask of steps that are no usual interval.
        """
        period = self._pace.period
        missing, waited = missing_by_pace(times, step, gaps & (period is not None), period or 1.0)
        if missing.any():
            self._lost += int(missing.sum())
            where = arrived[np.flatnonzero(missing)[0]]
            self.say(where, f"{counted(int(missing.sum()), 'line')} missing by the usual interval")
        # Include late lines, as those after them are early; but not lines delayed at a gap, as the gap is left out.
        plain = (step >= 0) & (missing == 0) & ~waited & ~np.asarray(odd)
        plain[0] &= not first
        self._pace.add(*step[plain].tolist())
        return missing

    def _numbered(self, fields: list[dict[str, str]], times: Any, status: Any, expected: Any) -> Any:
        """Return the status with the bits from sequence numbers, whose missed rollovers follow from `expected`."""
        if "sequence" not in self._names:
            return status
        numbers = np.array([int(f["sequence"]) for f in fields], np.int64)
        # When the device restarts, so do its numbers.
        starts = [0, *(np.flatnonzero(status & RESET).tolist()), len(numbers)]
        for low, high in itertools.pairwise(starts):
            if low == high:
                continue
            if status[low] & RESET:
                self._newest = None
            judged, missing, self._newest = judge_sequence(
                numbers[low:high],
                self.config.sequence_modulus,
                self._newest,
                None if expected is None else expected[low:high],
            )
            status[low:high] |= judged
            # A line out of order was counted as missing before.
            self._lost += int(missing.sum()) - int(np.count_nonzero(judged & OUT_OF_ORDER))
            if missing.any():
                where = times[low + np.flatnonzero(missing)[0]]
                self.say(where, f"{counted(int(missing.sum()), 'line')} missing by the sequence number")
        return status
