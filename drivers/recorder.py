"""Samples -> crash-safe recording on disk; and the `BENCH.toml` that says which encoders there are."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from cycloid_fmu import edge
from drivers.encoder import (
    BusConfig,
    ChannelConfig,
    Encoder,
    EncoderError,
    PortConfig,
    Wiring,
    encoder_class,
    opened,
)
from drivers.recording_format import Event, Header, RecordingWriter, Samples, check_new

BENCH_FORMAT = "cycloid-bench/1"
_WAIT = 0.05


class Conditions(edge.Config):
    """What a `[conditions]` says: load on the output (signed), crank speed, direction, temperature, a free note."""

    load: edge.Torque | None = None
    speed: edge.Speed | None = None
    direction: Literal["forward", "backward"] | None = None
    temperature: Annotated[float, pydantic.BeforeValidator(lambda value: edge.parse_quantity(value, "K"))] | None = None
    note: str | None = None


class _BenchFile(edge.Config):
    ratio: float | None = None
    pair: str = ""
    conditions: Conditions = Conditions()
    bus: dict[str, BusConfig] = pydantic.Field(default_factory=dict)
    port: dict[str, PortConfig] = pydantic.Field(default_factory=dict)
    channel: dict[str, dict[str, Any]]

    @pydantic.field_validator("ratio")
    @classmethod
    def _ratio(cls, value: float | None) -> float | None:
        if value is not None and not 0 < abs(value) < float("inf"):
            raise ValueError("write the signed ratio input/output of the ideal drive, such as -39")
        return value

    @pydantic.field_validator("channel")
    @classmethod
    def _some(cls, value: dict[str, Any]) -> dict[str, Any]:
        if not value:
            raise ValueError("write at least one table [channel.input_angle]")
        return value


@dataclasses.dataclass(frozen=True)
class Bench:
    """The wiring of a bench.

    Attributes
    ----------
    ratio
        Signed input/output ratio of the ideal drive, or None.
    pair
        Name of the gear pair.
    conditions
        SI numbers and text: load N*m, speed rad/s, direction, temperature K, note; absent where not stated.
    channels
        Class and configuration of each channel's encoder by its name.
    wiring
        Buses and ports.
    """

    ratio: float | None
    pair: str
    conditions: Mapping[str, float | str]
    channels: Mapping[str, tuple[type[Encoder], ChannelConfig]]
    wiring: Wiring

    def encoders(self) -> list[Encoder]:
        """Return new encoders for all channels, not yet opened."""
        return [cls.from_config(name, config, self.wiring) for name, (cls, config) in self.channels.items()]


def read_bench(path: str | os.PathLike[str]) -> Bench:
    """Read a `BENCH.toml` and check all that can be checked without a device.

    Raises
    ------
    edge.InputError
        Naming file, table and key.
    """
    source = str(path)
    table = edge.toml_table(edge.read_text(path), BENCH_FORMAT, source)
    file = edge.validated(_BenchFile, table, source)
    channels = {}
    for name, given in file.channel.items():
        cls = encoder_class(given.get("protocol"), name, source)
        channels[name] = (cls, edge.validated(cls.configuration, given, f"{source}: [channel.{name}]"))
    wiring = Wiring(file.bus, file.port, Path(path).parent, source)
    conditions = file.conditions.model_dump(exclude_none=True)
    bench = Bench(file.ratio, file.pair, conditions, channels, wiring)
    bench.encoders()
    return bench


@contextlib.contextmanager
def open_encoders(bench: Bench | str | os.PathLike[str]) -> Iterator[list[Encoder]]:
    """Open and start the encoders of a bench, or of the `BENCH.toml` of this path; close them at the end.

    Raises
    ------
    edge.InputError
        If the file is wrong.
    EncoderError
        If a bus, port or device does not answer.
    """
    with opened((bench if isinstance(bench, Bench) else read_bench(bench)).encoders()) as encoders:
        yield encoders


@dataclasses.dataclass(frozen=True)
class Recorded:
    """What a recording got: its path, the number of samples by channel, events, and why channels failed."""

    path: Path
    samples: Mapping[str, int]
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


def record(
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
    progress: Callable[[Mapping[str, int]], None] | None = None,
) -> Recorded:
    """Record open, started encoders until something says stop.

    A channel that fails is closed with an event and the others go on. SIGINT and SIGTERM end the recording with all
    that came, then raise KeyboardInterrupt. Memory does not grow with the recording.

    Parameters
    ----------
    encoders
        What to record, open and started.
    path
        New `.arrows` file.
    ratio, pair, conditions
        What the recording says about drive and test, see `Bench`.
    duration
        Seconds after which to stop.
    samples
        Stop when every channel has at least so many.
    idle
        Stop when no channel got a sample for so many seconds: how the end of a simulated bench is seen.
    stop
        Stop when it returns True; asked some twenty times a second.
    progress
        Called as often with the number of samples by channel.

    Raises
    ------
    edge.InputError
        If the file exists or can't be created.
    EncoderError
        If every channel failed; the file is closed and keeps all that came before.
    KeyboardInterrupt
        If interrupted; the file is closed and whole.
    """
    epoch = time.time()
    start = datetime.datetime.fromtimestamp(epoch, datetime.UTC).isoformat()
    header = Header(tuple(e.channel for e in encoders), conditions or {}, ratio, pair, start)
    counts = {e.channel.name: 0 for e in encoders}
    active, failures, said = list(encoders), [], 0

    def save(encoder: Encoder, timeout: float) -> bool:
        nonlocal said
        name = encoder.channel.name
        block: Samples | None = None
        events: list[Event] = []
        try:
            block = encoder.read(timeout)
        except EncoderError as problem:
            failures.append(problem)
            active.remove(encoder)
            events.append(Event(time.time(), name, f"recording of this channel ended: {problem}"))
        events = [dataclasses.replace(e, time=e.time - epoch) for e in encoder.events() + events]
        if block is None and not events:
            return False
        block = block or Samples.checked(name, [], [])
        writer.write(dataclasses.replace(block, time_host=block.time_host - epoch), events)
        counts[name] += len(block)
        said += len(events)
        return len(block) > 0

    with RecordingWriter(path, header) as writer, _interrupts() as interrupted:
        begun = last = time.monotonic()
        while active and not interrupted.is_set():
            # Only the first channel is waited for: the others have come meanwhile.
            came = [save(e, 0.0 if i else _WAIT) for i, e in enumerate(list(active))]
            now = time.monotonic()
            last = now if any(came) else last
            if progress is not None:
                progress(counts)
            if (
                (duration is not None and now - begun >= duration)
                or (samples is not None and min(counts.values()) >= samples)
                or (idle is not None and now - last >= idle)
                or (stop is not None and stop())
            ):
                break
        for encoder in list(active):
            save(encoder, 0.0)
    if interrupted.is_set():
        raise KeyboardInterrupt
    if failures and not active:
        raise failures[0]
    return Recorded(Path(path), counts, said, tuple(failures))


def record_bench(bench: Bench | str | os.PathLike[str], path: str | os.PathLike[str], **stops: Any) -> Recorded:
    """Record a bench, or the one of a `BENCH.toml`; `stops` are `record`'s `duration`, `samples`, `idle` and so on."""
    wired = bench if isinstance(bench, Bench) else read_bench(bench)
    check_new(path)  # before any device is set going
    with open_encoders(wired) as encoders:
        return record(encoders, path, ratio=wired.ratio, pair=wired.pair, conditions=wired.conditions, **stops)
