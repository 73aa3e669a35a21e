"""Recording of samples to disk, safe from crashes."""

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
from typing import Any, TypedDict, Unpack

import numpy as np

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.arguments import in_si
from drivers.encoder import Encoder, EncoderError, ListeningTime, steady_time
from drivers.recorder.bench import Bench, open_encoders, read_bench
from drivers.recorder.clock import ClockEstimate
from drivers.recorder.supervision import Supervised
from drivers.recording_format import MARKS, Event, Header, RecordingWriter, Samples, check_new
from drivers.recording_format.joining import LARGE, join_batches

_WAIT = 0.05
_CLOCK_SECONDS = 10.0  # between two estimates of a device's clock in the file
_CALENDAR_STEP = 0.1  # s; smaller corrections are slewed, and the monotonic clock follows them


class RecordingError(Exception):
    """A recording can't be continued; the text states which data are safe."""


@dataclasses.dataclass
class ChannelState:
    """State of one channel.

    Attributes
    ----------
    samples, marks
        Number of samples in the file, and of those with each mark, by the mark's name.
    lost
        Number of lost readings.
    rate, waiting
        Samples per second over about the last second; number of readings received but not yet written.
    time, value, first
        Time of the newest sample, s since the start, its value, SI, and the value of the first sample. None before the
        first sample.
    lowest, highest
        Lowest and highest value in the newest block, SI; None before the first.
    failure
        The error of a channel that is out at present, or None.
    """

    samples: int = 0
    marks: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(MARKS, 0))
    lost: int = 0
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
    """A recording in progress, for display: state by channel, number of events, free bytes on disk.

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
    """Result of a recording.

    Attributes
    ----------
    path
        The file.
    samples, events
        Number of samples by channel, and number of events.
    marks
        Number of samples with each mark, by channel and mark; unused marks are absent.
    lost
        Number of lost readings by channel.
    failures
        Errors of the channels that were out at the end.
    ended
        Why the recording ended: "duration", "samples", "idle", "stop", or the name of a signal, such as "SIGINT".
    """

    path: Path
    samples: Mapping[str, int]
    marks: Mapping[str, Mapping[str, int]]
    lost: Mapping[str, int]
    events: int
    failures: tuple[EncoderError, ...]
    ended: str


class RecordingInterrupted(KeyboardInterrupt):
    """A recording ended by a signal, with a complete file: `recorded` is its result, `exit_status` 128 + signal."""

    def __init__(self, recorded: Recorded) -> None:
        super().__init__(f"Interrupted by {recorded.ended}; {recorded.path} has all data up to then.")
        self.recorded = recorded
        self.exit_status = 128 + signal.Signals[recorded.ended]


@contextlib.contextmanager
def interrupts() -> Iterator[list[str]]:
    """Yield a list for the name of the first SIGINT, SIGTERM or SIGHUP, which is caught so that all data are written.

    The next signal takes effect at once, except SIGHUP: a closed terminal sends several.
    """
    asked: list[str] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number: int, frame: object) -> None:
        name = signal.Signals(number).name
        if asked and name != "SIGHUP":
            raise KeyboardInterrupt
        asked.append(name)

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {s: signal.signal(s, ask) for s in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Session:
    """A recording in progress: encoders in, batches out."""

    def __init__(
        self,
        encoders: Sequence[Encoder],
        writer: RecordingWriter,
        path: str | os.PathLike[str],
        ratio: float | None,
        epoch: float,
    ) -> None:
        self.encoders = [Supervised(e) for e in encoders]
        self.writer, self.path, self.ratio, self.epoch = writer, path, ratio, epoch
        self.live = Live({e.channel.name: ChannelState() for e in encoders})
        self._clocks = {e.channel.name: ClockEstimate() for e in encoders}
        self._clock_time = dict.fromkeys(self._clocks, 0.0)
        self._clock_jumps = {name: rf.ClockJumps() for name in self._clocks}
        self._restarts = dict.fromkeys(self._clocks, 0)
        self._input: Samples | None = None
        self._zero: float | None = None
        self._rates = (time.monotonic(), dict.fromkeys(self.live.channels, 0))
        self._calendar = time.time() - time.monotonic()

    def take(self, timeout: float) -> bool:
        """Write the new samples of all channels, waiting up to `timeout` s; return whether there were any."""
        # Wait for the first channel only: samples of the others arrive meanwhile.
        blocks = [self._read(e, 0.0 if i else timeout) for i, e in enumerate(self.encoders)]
        for encoder, block, events in blocks:
            if block is not None or events:
                self.write(block or Samples.checked(encoder.channel.name, [], []), events)
            if block is not None:
                self._note(encoder.channel.role, block, self.live.channels[encoder.channel.name])
        return any(block is not None and len(block) > 0 for _, block, _ in blocks)

    def _read(self, encoder: Supervised, timeout: float) -> tuple[Supervised, Samples | None, list[Event]]:
        """Return the samples and events of a channel."""
        name = encoder.channel.name
        state = self.live.channels[name]
        block = encoder.read(timeout)
        events = self._events(encoder) + self._jump(name)
        state.waiting, state.failure, state.lost = encoder.waiting, encoder.failure, encoder.lost
        if block is not None:
            block = dataclasses.replace(block, time_host=block.time_host - self.epoch)
            events += self._clock(block)
        return encoder, block, events

    def _events(self, encoder: Supervised) -> list[Event]:
        return [dataclasses.replace(e, time=e.time - self.epoch) for e in encoder.events()]

    def write(self, block: Samples, events: list[Event]) -> None:
        """Write a batch; if the disk is full, raise a `RecordingError` that states the data kept."""
        try:
            self.writer.write(block, events)
        except OSError as problem:
            raise self.full(problem) from problem
        self.live.events += len(events)

    def full(self, problem: OSError) -> RecordingError:
        """Return the error for a full disk, which states the content of the file."""
        counts = ", ".join(f"{n} {name}" for name, n in self.writer.counts.items())
        reason = problem.strerror or problem
        return RecordingError(
            f"{self.path}: the disk is full or failed ({reason}); all data written before are kept: {counts}."
        )

    def take_all(self) -> bool:
        """Read and write all data waiting on buses and ports; return whether there were samples."""
        for encoder in self.encoders:
            encoder.drain()
        return self.take(0.0)

    def finish(self) -> None:
        """Write the losses at the end and the final estimates of the clocks, as events."""
        for encoder in self.encoders:
            encoder.finish()
            name = encoder.channel.name
            events = [*self._events(encoder), *self.clock_event(name)]
            self.live.channels[name].lost = encoder.lost
            if events:
                self.write(Samples.checked(name, [], []), events)

    def recorded(self, ended: str) -> Recorded:
        """Return the result after the end."""
        channels = self.live.channels
        marks = {name: {m: n for m, n in state.marks.items() if n} for name, state in channels.items()}
        lost = {name: state.lost for name, state in channels.items()}
        failures = tuple(e.failure for e in self.encoders if e.failure is not None)
        return Recorded(Path(self.path), self.live.samples, marks, lost, self.live.events, failures, ended)

    def _note(self, role: str, block: Samples, state: ChannelState) -> None:
        """Update a channel's state and the running TE."""
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
        """Update the estimate of the device's clock; return it as an event every `_CLOCK_SECONDS` and at a restart."""
        if block.time_device is None or not len(block):
            return []
        name = block.channel
        reset = block.status & rf.RESET != 0
        restarts = np.flatnonzero(self._clock_jumps[name](block.time_device, block.time_host, reset))
        events: list[Event] = []
        for part in np.split(np.arange(len(block)), restarts):
            if len(part) and part[0] in restarts:
                events += self.clock_event(name)
                self._clocks[name], self._restarts[name] = ClockEstimate(), self._restarts[name] + 1
            self._clocks[name].add(block.time_device[part], block.time_host[part])
        if block.time_host[-1] - self._clock_time[name] >= _CLOCK_SECONDS:
            events += self.clock_event(name)
        return events

    def clock_event(self, name: str) -> list[Event]:
        """Return the estimate of a channel's clock, as an event."""
        clock = self._clocks[name].fit()
        if clock is None:
            return []
        now = steady_time() - self.epoch
        self._clock_time[name] = now
        return [rf.clock_event(now, name, clock, self._restarts[name])]

    def _jump(self, name: str) -> list[Event]:
        """Return an event if the host's calendar clock was set: it moves the kernel's stamps, not those made here."""
        calendar = time.time() - time.monotonic()
        step, self._calendar = calendar - self._calendar, calendar
        if abs(step) < _CALENDAR_STEP:
            return []
        return [Event(steady_time() - self.epoch, name, f"the host's calendar clock was set by {step:+.3f} s")]

    def refresh(self) -> None:
        """Update rates and free space, once a second."""
        then, counted = self._rates
        now = time.monotonic()
        if now - then < 1.0 and self.live.disk_free:
            return
        for name, state in self.live.channels.items():
            state.rate = (state.samples - counted[name]) / max(now - then, 1e-3)
        self._rates = now, self.live.samples
        self.live.disk_free = shutil.disk_usage(Path(self.path).parent).free


class End(TypedDict, total=False):
    """Conditions that end a recording, see `record`; those absent or None do not."""

    duration: float | None
    samples: int | None
    idle: float | None
    stop: Callable[[], bool] | None


def record_encoders(
    encoders: Sequence[Encoder],
    path: str | os.PathLike[str],
    *,
    ratio: float | None = None,
    pair: str = "",
    conditions: Mapping[str, float | str] | None = None,
    progress: Callable[[Live], None] | None = None,
    **end: Unpack[End],
) -> Recorded:
    """Record open, started encoders until one of the conditions `end`; see `record` for the parameters and errors.

    A failed channel is reported as an event, reopened until it answers, and its next sample marked; the others
    continue. At the end, also after SIGINT, SIGTERM and SIGHUP, all data waiting on buses and ports are read and
    missing samples reported; the signals then raise `RecordingInterrupted`. Memory does not grow with the recording.
    Data are safe from a kill within `hubs.BLOCK_SECONDS` of their arrival and from a power cut within
    `recording_format.FLUSH_SECONDS`. `ratio`, `pair` and `conditions` go into the header, see `Bench`; `stop` is called
    after each round of reading and ends the recording if true; `progress` is called with the state.

    Raises
    ------
    EncoderError
        If every channel failed without a sample; the file is closed.
    """
    epoch = steady_time()
    start = datetime.datetime.fromtimestamp(epoch, datetime.UTC).isoformat()
    header = Header(tuple(e.channel for e in encoders), conditions or {}, ratio, pair, start)
    writer = RecordingWriter(path, header)
    session = _Session(encoders, writer, path, ratio, epoch)
    try:
        with interrupts() as interrupted:
            ended = _run(session, interrupted, end, progress)
            session.take_all()
            session.finish()
    finally:
        for encoder in session.encoders:
            encoder.close()
        try:
            writer.close()
        except OSError as problem:
            raise session.full(problem) from problem
    if sum(writer.counts.values()) < LARGE * writer.batches:
        join_batches(path)
    done = session.recorded(ended)
    if interrupted:
        raise RecordingInterrupted(done)
    if done.failures and not any(done.samples.values()):
        raise done.failures[0]
    return done


def _run(session: _Session, interrupted: Sequence[str], end: End, progress: Callable[[Live], None] | None) -> str:
    """Record until one of the end conditions, and return it; see `Recorded`."""
    duration, samples, idle, stop = (dict[str, Any](end).get(key) for key in ("duration", "samples", "idle", "stop"))
    live, listened = session.live, ListeningTime()
    begun, heard = time.monotonic(), 0.0
    while not interrupted:
        came = session.take(_WAIT)
        now = listened()
        heard = now if came else heard
        session.refresh()
        if progress is not None:
            progress(live)
        if duration is not None and time.monotonic() - begun >= duration:
            return "duration"
        if samples is not None and min(live.samples.values()) >= samples:
            return "samples"
        if stop is not None and stop():
            return "stop"
        # The line must be silent, not this process slow: first read what is waiting.
        if idle is not None and now - heard >= idle:
            if not session.take_all():
                return "idle"
            heard = now
    return interrupted[0]


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
    """Record all channels of a bench until Ctrl-C or the first of the other end conditions.

    Samples are in the file within 50 ms, safe from a kill of the process; the file is synced to disk every second,
    safe from a power cut. Failed buses and ports are reopened.

    Parameters
    ----------
    bench
        The bench, or its `BENCH.toml`.
    path
        New `.arrows` file.
    duration
        Time after which to stop, s, or text such as "30 s".
    samples
        Stop when every channel has at least this many.
    idle
        Stop after this time without samples, s, or text such as "2 s"; pauses of this process do not count.
    stop, progress
        See `record_encoders`.
    allow
        See `read_bench`.

    Raises
    ------
    edge.InputError
        If the wiring is invalid or the file exists.
    EncoderError
        If a bus, port or device does not answer, or another recording uses it.
    RecordingError
        If the disk is full; the file keeps all earlier data.
    RecordingInterrupted
        At SIGINT, SIGTERM or SIGHUP, a KeyboardInterrupt; the file is closed and complete.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque="20 N*m", turns=1, bus="virtual") as bench:
    ...     wiring = bench.write_wiring("BENCH.toml")
    ...     done = drivers.record(wiring, "recorded.arrows", samples=96, idle="2 s")
    >>> done.samples
    {'input_angle': 96, 'output_angle': 96, 'torque': 96}
    """
    from drivers.recorder.in_use import Claims

    wired = bench if isinstance(bench, Bench) else read_bench(bench, allow=allow)
    duration = None if duration is None else in_si(duration, "s", "duration", above=0.0)
    idle = None if idle is None else in_si(idle, "s", "idle", above=0.0)
    check_new(edge.output_path(path, "path", (".arrows",)))  # before any device is started
    with Claims() as claims:
        claims.claim(wired.wiring)  # two recordings would stop each other's nodes
        with open_encoders(wired) as encoders:
            return record_encoders(
                encoders,
                path,
                ratio=wired.ratio,
                pair=wired.pair,
                conditions=wired.conditions,
                duration=duration,
                samples=samples,
                idle=idle,
                stop=stop,
                progress=progress,
            )
