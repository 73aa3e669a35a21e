"""The interface of encoders, its errors and the registry of protocols."""

from __future__ import annotations

import abc
import dataclasses
import importlib.metadata
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import pydantic

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.lines import LineConfig
from drivers.recording_format import Channel, Event, Samples

ENTRY_POINTS = "cycloid.encoders"


Line = TypeVar("Line", bound=LineConfig)
_LONGEST_STEP = 0.1  # s: twice the time that a recorder waits for a sample
_EPOCH = time.time() - time.monotonic()


class EncoderError(Exception):
    """A failure of an encoder or its bus; the text is one sentence that names channel and place.

    Examples
    --------
    >>> import drivers
    >>> from drivers.encoder import EncoderTimeout
    >>> issubclass(EncoderTimeout, drivers.EncoderError)
    True
    """


class EncoderTimeout(EncoderError):  # noqa: N818
    """The device does not answer."""


class EncoderProtocolError(EncoderError):
    """The device's answer violates its protocol."""


class EncoderConnectionError(EncoderError):
    """The bus or port failed, or a different device answers."""


class EncoderSetupError(EncoderConnectionError, edge.InputError):
    """The wiring cannot work: no such bus or port, no permission, a node in use, contradictory counts per turn."""


class ChannelConfig(edge.Config):
    """Keys of every channel of a `BENCH.toml`; each protocol adds its own.

    Attributes
    ----------
    protocol
        Name of the protocol.
    direction
        +1 if the sensor's values increase counter-clockwise, -1 if they decrease.
    zero_reference
        "absolute": the zero is the same in every recording; "incremental": each recording has its own.
    """

    protocol: str
    direction: Literal[1, -1] = 1
    zero_reference: Literal["absolute", "incremental"] = "absolute"


class AngleConfig(ChannelConfig):
    """Keys of every angle channel.

    Attributes
    ----------
    counts_per_turn
        Counts in one turn of the shaft; absent: read from the device.
    zero
        Angle that the encoder, with its direction, shows at the zero of the shaft, rad; it is subtracted.
    largest_speed
        Largest speed of the shaft, rad/s; faster steps are implausible. Absent: unknown.
    """

    counts_per_turn: Annotated[int, pydantic.Field(gt=0)] | None = None
    zero: edge.Angle = 0.0
    largest_speed: Annotated[edge.Speed, pydantic.Field(gt=0)] | None = None


@dataclasses.dataclass(frozen=True)
class Wiring:
    """Lines of a `BENCH.toml` by kind and name, the base folder of file names in it, and the file's own name."""

    lines: Mapping[str, Mapping[str, LineConfig]]
    folder: Path
    source: str

    def line(self, kind: type[Line], name: str, table: str) -> Line:
        """Return the line of this kind and name; an `edge.InputError` names the table that asks if there is none."""
        named = self.lines.get(kind.kind, {})
        line = named.get(name)
        if not isinstance(line, kind):
            there = ", ".join(edge.shown(k) for k in named) or "none"
            raise edge.InputError(
                f"{self.source}: {table} {kind.kind} = {edge.shown(name)}: there is no {kind.kind} of this "
                f"name; the file has {there}."
            )
        return line


class Encoder(abc.ABC):
    """A sensor that yields time-stamped samples in blocks; a context manager that opens and closes it.

    `start` is called once all channels of a bench are open, so that none misses samples triggered by the first one.

    Attributes
    ----------
    configuration
        The keys of its `[channel.X]`.
    line
        The table of the line that its channels share, see `LineConfig`; None: there is none.
    channel
        The channel's description, from `__enter__` on.

    Examples
    --------
    Methods that a new protocol must define:

    >>> import drivers
    >>> sorted(drivers.Encoder.__abstractmethods__)
    ['__enter__', 'close', 'events', 'from_config', 'read']
    """

    configuration: ClassVar[type[ChannelConfig]]
    line: ClassVar[type[LineConfig] | None] = None
    channel: Channel

    @classmethod
    @abc.abstractmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> Encoder:
        """Return the encoder that a `[channel.name]` of a `BENCH.toml` describes, not yet opened.

        Raises
        ------
        edge.InputError
            If it names a line or file that does not exist.
        """

    @abc.abstractmethod
    def __enter__(self) -> Self:
        """Open the device; from then on `channel` describes it.

        Raises
        ------
        EncoderError
            If the bus, port or device does not answer, or its answer is invalid.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the bus or port; closing twice is allowed."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self) -> None:  # noqa: B027
        """Start the device's transmission, if necessary."""

    @abc.abstractmethod
    def read(self, timeout: float) -> Samples | None:
        """Return all samples received since the last call, `time_host` in seconds since 1970.

        Parameters
        ----------
        timeout
            Time to wait for the first sample, s; 0: return only the samples available now.

        Returns
        -------
        Samples or None
            None if there are none.

        Raises
        ------
        EncoderError
            If the device has failed; faults that it recovers from are events and status bits.
        """

    @abc.abstractmethod
    def events(self) -> list[Event]:
        """Return the events since the last call, `time` in seconds since 1970, and clear them."""

    def drain(self) -> None:  # noqa: B027
        """Read all data waiting on the bus or port, so that the next `read` returns it; sampling continues."""

    def finish(self) -> None:  # noqa: B027
        """Report samples missing after the last one, in `events` and `lost`; called once, after the last `read`."""

    @property
    def lost(self) -> int:
        """Number of readings known to be lost since the encoder was created."""
        return 0

    @property
    def measuring_range(self) -> tuple[float, float] | None:
        """Smallest and largest value that the sensor can measure, SI units; None if unknown."""
        return None

    @property
    def waiting(self) -> int:
        """Number of readings received but not yet read; 0 if unknown."""
        return 0


def device_counts(config: AngleConfig, device: int, where: str) -> int:
    """Return the device's counts per turn, which the wiring may repeat but not contradict.

    Parameters
    ----------
    config, device
        The channel's table, and the counts per turn that the device reports.
    where
        Channel and device, for the error.

    Raises
    ------
    EncoderSetupError
        If the wiring states other counts per turn.
    """
    if config.counts_per_turn not in (None, device):
        raise EncoderSetupError(
            f"{where}: counts_per_turn = {config.counts_per_turn} contradicts the device, which has {device}."
        )
    return device


def channel_of(
    name: str,
    config: ChannelConfig,
    *,
    identity: str,
    time_source: str,
    unit: str = "rad",
    counts_per_turn: int | None = None,
) -> Channel:
    """Return a channel's description from its table in the wiring, the device and its protocol.

    The role is the channel's name if that is one of `recording_format.ROLES` and the unit is not rad/s, else "other".

    Parameters
    ----------
    name, config
        Name of the channel, and its table.
    identity, time_source, unit, counts_per_turn
        See `recording_format.Channel`.
    """
    return Channel(
        name=name,
        role=name if name in rf.ROLES and unit != "rad/s" else "other",
        protocol=config.protocol,
        unit=unit,
        counts_per_turn=counts_per_turn,
        direction=config.direction,
        zero=config.zero if isinstance(config, AngleConfig) else 0.0,
        zero_reference=config.zero_reference,
        identity=identity,
        time_source=time_source,
        largest_speed=config.largest_speed if isinstance(config, AngleConfig) and unit == "rad" else None,
    )


def steady_time() -> float:
    """Return the host's time in seconds since 1970; it does not jump when the calendar clock is set."""
    return _EPOCH + time.monotonic()


class ListeningTime:
    """Time for which this process could listen, without most pauses by a stop signal or a busy machine.

    Timeouts use it: silence while nobody listened is no sign of a failed device.
    """

    def __init__(self) -> None:
        self._last = time.monotonic()
        self.seconds = 0.0

    def __call__(self) -> float:
        """Return the time up to now, s; to be called at intervals shorter than `_LONGEST_STEP`."""
        now = time.monotonic()
        self.seconds += min(now - self._last, _LONGEST_STEP)
        self._last = now
        return self.seconds


def registered(group: str = ENTRY_POINTS) -> importlib.metadata.EntryPoints:
    """Return the entry points of a group of all installed packages, whose files are read."""
    return importlib.metadata.entry_points(group=group)


def protocols() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the registered protocols of encoders by name."""
    return {e.name: e for e in registered()}


PlugIn = TypeVar("PlugIn")


def plug_in(
    protocol: object, table: str, source: str, installed: importlib.metadata.EntryPoints, base: type[PlugIn]
) -> type[PlugIn]:
    """Return the class of a protocol, from this package or another installed one.

    Parameters
    ----------
    protocol, table, source
        Protocol that a table of a bench file states, such as "[channel.torque]", and the names of both.
    installed
        What is `registered`.
    base
        Class from which it must derive: `Encoder`, or `recorder.actuator.Actuator`.

    Raises
    ------
    edge.InputError
        If no installed package provides the protocol, two do, or its class does not load; names table and file.
    """
    known = {e.name: e for e in installed}
    names = ", ".join(sorted(known)) or "none"
    if protocol is None:
        raise edge.InputError(f"{source}: {table} protocol is missing; installed are {names}.")
    where = f"{source}: {table} protocol = {edge.shown(protocol)}"
    if not isinstance(protocol, str) or protocol not in known:
        raise edge.InputError(f"{where}: no such protocol is installed; installed are {names}.")
    owners = {e.dist.name for e in installed.select(name=protocol) if e.dist}
    if len(owners) > 1:
        raise edge.InputError(f"{where}: the packages {' and '.join(sorted(owners))} both provide it; uninstall one.")
    owner = "".join(owners) or known[protocol].value
    try:
        loaded = known[protocol].load()
    except edge.InputError as problem:  # an extra that is not installed
        raise edge.InputError(f"{where}: {problem}") from None
    except Exception as problem:  # a plug-in's module may raise anything
        said = str(problem).rstrip(".") or type(problem).__name__
        raise edge.InputError(f"{where}: the package {owner} that provides it does not load: {said}.") from problem
    if not (isinstance(loaded, type) and issubclass(loaded, base) and hasattr(loaded, "configuration")):
        raise edge.InputError(
            f"{where}: the package {owner} must provide a subclass of {base.__name__} with a configuration, "
            f"not {loaded!r}."
        )
    return loaded
