"""Samples -> crash-safe recording on disk."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.arguments import in_si
from drivers.encoder import (
    Encoder,
    EncoderError,
    steady_time,
)
from drivers.recorder.bench import Bench, open_encoders, read_bench
from drivers.recorder.clock import ClockEstimate
from drivers.recorder.supervision import Supervised
from drivers.recording_format import MARKS, Event, Header, RecordingWriter, Samples, check_new

_WAIT = 0.05
_CLOCK_SECONDS = 10.0  # between two notes of a device's clock
_CALENDAR_STEP = 0.1  # s; slower corrections are slewed, and the monotonic clock follows them


class RecordingError(Exception):
    """A recording can't be written on; the text says what of it is safe."""


@dataclasses.dataclass
class ChannelState:
    """What one channel has got so far.

    Attributes
    ----------
    samples, marks
        How many were written, and how many of them carry each mark, by name.
    rate, waiting
        Samples a second over the last second or so; readings that came and are not written yet.
    time, value, first
        Of the newest sample: seconds since the start, SI; value of the first sample; None before the first.
    lowest, highest
        Values of the newest block.
    failure
        Why it is out just now, None where it is not.
    """

    samples: int = 0
    marks: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(MARKS, 0))
    rate: float = 0.0
    waiting: int = 0
    time: float | None = None
    value: float | None = None
    first: float | None = None
    lowest: float | None = None
    highest: float | None = None
    failure: EncoderError | None = None


@dataclasses.dataclass
class Live:
    """A recording in progress, for whoever shows it: state by channel, number of events, bytes left on the disk.

    `transmission_error` is the newest TE, rad at the output, minus the first one: output angle - input angle / ratio at
    one instant; None where an angle or the ratio is missing.
    """

    channels: dict[str, ChannelState]
    events: int = 0
    transmission_error: float | None = None
    disk_free: int = 0

    @property
    def samples(self) -> dict[str, int]:
        """Samples written, by channel."""
        return {name: state.samples for name, state in self.channels.items()}


@dataclasses.dataclass(frozen=True)
class Recorded:
    """What a recording got: its path, the number of samples by channel, of marks by channel and name, and of events.

    Marks that no sample carries are absent; `failures` are why channels were out at the end.
    """

    path: Path
    samples: Mapping[str, int]
    marks: Mapping[str, Mapping[str, int]]
    events: int
    failures: tuple[EncoderError, ...]


@contextlib.contextmanager
def _interrupts() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into an event, so that what is at hand is written before it is obeyed."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number: int, frame: object) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Session:
    """One recording being made: encoders in, batches out."""

    def __init__(self, encoders: Sequence[Encoder], writer: RecordingWriter, ratio: float | None, epoch: float) -> None:
        self.encoders = [Supervised(e) for e in encoders]
        self.writer, self.ratio, self.epoch = writer, ratio, epoch
        self.live = Live({e.channel.name: ChannelState() for e in encoders})
        self._clocks = {e.channel.name: ClockEstimate() for e in encoders}
        self._clock_said = dict.fromkeys(self._clocks, 0.0)
        self._clock_last: dict[str, tuple[float, float]] = {}
        self._restarts = dict.fromkeys(self._clocks, 0)
        self._input: Samples | None = None
        self._zero: float | None = None
        self._rates = (time.monotonic(), dict.fromkeys(self.live.channels, 0))
        self._calendar = time.time() - time.monotonic()

    def take(self, encoder: Supervised, timeout: float) -> bool:
        """Write what a channel has; return whether there were samples."""
        name = encoder.channel.name
        state = self.live.channels[name]
        block = encoder.read(timeout)
        events = [dataclasses.replace(e, time=e.time - self.epoch) for e in encoder.events()]
        events += self._jump(name)
        state.waiting, state.failure = encoder.waiting, encoder.failure
        if block is not None:
            block = dataclasses.replace(block, time_host=block.time_host - self.epoch)
            events += self._clock(block)
            self._note(encoder.channel.role, block, state)
        if block is None and not events:
            return False
        block = block or Samples.checked(name, [], [])
        self.writer.write(block, events)
        self.live.events += len(events)
        return len(block) > 0

    def _note(self, role: str, block: Samples, state: ChannelState) -> None:
        """Count a block and follow the TE."""
        state.samples += len(block)
        present = np.bitwise_or.reduce(block.status) if len(block) else 0
        for mark, bit in MARKS.items():
            if present & bit:
                state.marks[mark] += int(np.count_nonzero(block.status & bit))
        if not len(block):
            return
        state.time, state.value = float(block.time_host[-1]), float(block.value[-1])
        state.first = float(block.value[0]) if state.first is None else state.first
        state.lowest, state.highest = float(block.value.min()), float(block.value.max())
        if role == "input_angle":
            self._input = block
        elif role == "output_angle" and self._input is not None and self.ratio:
            turning = self._input
            inside = (block.time_host >= turning.time_host[0]) & (block.time_host <= turning.time_host[-1])
            if inside.any():
                last = int(np.flatnonzero(inside)[-1])
                angle = np.interp(block.time_host[last], turning.time_host, turning.value)
                error = float(block.value[last] - angle / self.ratio)
                self._zero = error if self._zero is None else self._zero
                self.live.transmission_error = error - self._zero

    def _clock(self, block: Samples) -> list[Event]:
        """Follow the device's clock and say now and then, and when it ends, what is known of it."""
        if block.time_device is None or not len(block):
            return []
        name = block.channel
        restarts = np.flatnonzero(rf.clock_restarts(block, self._clock_last.get(name)))
        self._clock_last[name] = float(block.time_device[-1]), float(block.time_host[-1])
        said: list[Event] = []
        for part in np.split(np.arange(len(block)), restarts):
            if len(part) and part[0] in restarts:
                said += self.clock_event(name)
                self._clocks[name], self._restarts[name] = ClockEstimate(), self._restarts[name] + 1
            self._clocks[name].add(block.time_device[part], block.time_host[part])
        if block.time_host[-1] - self._clock_said[name] >= _CLOCK_SECONDS:
            said += self.clock_event(name)
        return said

    def clock_event(self, name: str) -> list[Event]:
        """Return what is known of a channel's clock, as an event."""
        clock = self._clocks[name].fit()
        if clock is None:
            return []
        now = steady_time() - self.epoch
        self._clock_said[name] = now
        return [rf.clock_event(now, name, clock, self._restarts[name])]

    def _jump(self, name: str) -> list[Event]:
        """Say that somebody set the host's calendar clock; our own stamps do not follow it, a kernel's do."""
        calendar = time.time() - time.monotonic()
        step, self._calendar = calendar - self._calendar, calendar
        if abs(step) < _CALENDAR_STEP:
            return []
        return [Event(steady_time() - self.epoch, name, f"the host's calendar clock was set by {step:+.3f} s")]

    def refresh(self, path: str | os.PathLike[str]) -> None:
        """Work out rates and free space, once a second."""
        then, counted = self._rates
        now = time.monotonic()
        if now - then < 1.0 and self.live.disk_free:
            return
        for name, state in self.live.channels.items():
            state.rate = (state.samples - counted[name]) / max(now - then, 1e-3)
        self._rates = now, self.live.samples
        self.live.disk_free = shutil.disk_usage(Path(path).parent).free


def record_encoders(
    encoders: Sequence[Encoder],
    path: str | os.PathLike[str],
    *,
    ratio: float | None = None,
    pair: str = "",
    conditions: Mapping[str, float | str] | None = None,
    duration: float | None = None,
    samples: int | None = None,
    idle: float | None = None,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[Live], None] | None = None,
) -> Recorded:
    """Record open, started encoders until one of the ends comes; see `record` for the parameters and errors.

    A channel that fails is noted, opened again until it answers, and marked; the others go on. SIGINT and SIGTERM end
    the recording with all that came, then raise KeyboardInterrupt. Memory does not grow with the recording. What is
    written is safe from a kill within `hubs.BLOCK_SECONDS` of its arrival and from a power cut within
    `recording_format.FLUSH_SECONDS`. `ratio`, `pair` and `conditions` go into the header, see `Bench`.

    Raises
    ------
    EncoderError
        If every channel was out and none had got a sample; the file is closed.
    """
    epoch = steady_time()
    start = datetime.datetime.fromtimestamp(epoch, datetime.UTC).isoformat()
    header = Header(tuple(e.channel for e in encoders), conditions or {}, ratio, pair, start)
    with RecordingWriter(path, header) as writer, _interrupts() as interrupted:
        session = _Session(encoders, writer, ratio, epoch)
        live = session.live
        begun = last = time.monotonic()
        try:
            while not interrupted.is_set():
                # Only the first channel is waited for: the others have come meanwhile.
                came = [session.take(e, 0.0 if i else _WAIT) for i, e in enumerate(session.encoders)]
                now = time.monotonic()
                last = now if any(came) else last
                session.refresh(path)
                if progress is not None:
                    progress(live)
                if (
                    (duration is not None and now - begun >= duration)
                    or (samples is not None and min(live.samples.values()) >= samples)
                    or (idle is not None and now - last >= idle)
                    or (stop is not None and stop())
                ):
                    break
            for encoder in session.encoders:
                session.take(encoder, 0.0)
                clocks = session.clock_event(encoder.channel.name)
                if clocks:
                    writer.write(Samples.checked(encoder.channel.name, [], []), clocks)
        except OSError as problem:
            kept = ", ".join(f"{n} {name}" for name, n in live.samples.items())
            raise RecordingError(
                f"{path}: the disk takes no more ({problem.strerror or problem}); all written before is kept: {kept}."
            ) from problem
        finally:
            for encoder in session.encoders:
                encoder.close()
    if interrupted.is_set():
        raise KeyboardInterrupt
    failures = tuple(e.failure for e in session.encoders if e.failure is not None)
    if failures and not any(live.samples.values()):
        raise failures[0]
    marks = {name: {m: n for m, n in state.marks.items() if n} for name, state in live.channels.items()}
    return Recorded(Path(path), live.samples, marks, live.events, failures)


def record(
    bench: Bench | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    duration: float | str | None = None,
    samples: int | None = None,
    idle: float | str | None = None,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[Live], None] | None = None,
    allow: Collection[str] = (),
) -> Recorded:
    """Record all channels of a bench: until Ctrl-C, or what comes first of the others.

    What came is in the file a twentieth of a second later, safe from a kill of the process; every second the disk is
    told to hold it, safe from a power cut. Buses and ports that fail are opened again.

    Parameters
    ----------
    bench
        The bench, or its `BENCH.toml`.
    path
        New `.arrows` file.
    duration
        Time after which to stop, s, or text such as "30 s".
    samples
        Stop when every channel has at least so many.
    idle
        Stop when no channel got a sample for so long, s, or text such as "2 s".
    stop, progress
        See `record_encoders`.
    allow
        See `read_bench`.

    Raises
    ------
    edge.InputError
        If the wiring is wrong or the file exists.
    EncoderError
        If a bus, port or device does not answer.
    RecordingError
        If the disk takes no more; the file keeps all that came before.
    KeyboardInterrupt
        If interrupted; the file is closed and whole.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque="20 N*m", turns=1, interface="virtual") as bench:
    ...     wiring = bench.write_wiring("BENCH.toml")
    ...     done = drivers.record(wiring, "recorded.arrows", samples=96, idle="2 s")
    >>> done.samples
    {'input_angle': 96, 'output_angle': 96, 'torque': 96}
    """
    wired = bench if isinstance(bench, Bench) else read_bench(bench, allow=allow)
    duration = None if duration is None else in_si(duration, "s", "duration", above=0.0)
    idle = None if idle is None else in_si(idle, "s", "idle", above=0.0)
    check_new(edge.output_path(path, "path", (".arrows",)))  # before any device is set going
    with open_encoders(wired) as encoders:
        return record_encoders(
            encoders, path, ratio=wired.ratio, pair=wired.pair, conditions=wired.conditions, duration=duration,
            samples=samples, idle=idle, stop=stop, progress=progress,
        )  # fmt: skip
