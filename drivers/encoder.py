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
from drivers.recording_format import Channel, Event, Samples

ENTRY_POINTS = "cycloid.encoders"


Line = TypeVar("Line")
_LONGEST_STEP = 0.1  # s: twice what a recorder waits for a sample
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
    """The device answers something that its protocol does not allow."""


class EncoderConnectionError(EncoderError):
    """The bus or port failed, or the device is another one."""


class EncoderSetupError(EncoderConnectionError, edge.InputError):
    """Impossible wiring: no such bus or port, no permission, a node in use, contradicting counts."""


class BusConfig(edge.Config):
    """A CAN bus as python-can opens it.

    Attributes
    ----------
    interface, channel, bitrate
        As python-can names them: "socketcan", "slcan", "pcan", "kvaser", "vector", "gs_usb", "virtual", "udp_multicast"
        and others; "loopback" is that of the simulated bench.
    fd, data_bitrate
        CAN FD, and the bit rate of its data phase.
    sync_period
        Seconds between the SYNC frames that the recorder itself produces; None: another device does, or none.
    """

    interface: str
    channel: str
    bitrate: Annotated[int, pydantic.Field(gt=0)] | None = None
    fd: bool = False
    data_bitrate: Annotated[int, pydantic.Field(gt=0)] | None = None
    sync_period: Annotated[edge.Seconds, pydantic.Field(gt=0)] | None = None

    @property
    def place(self) -> str:
        """Interface and channel, which identify the bus, for messages."""
        return f'{self.interface} "{self.channel}"'


class PortConfig(edge.Config):
    """A serial port of 8 data bits as pyserial opens it: a device such as "/dev/ttyUSB0", or a URL."""

    url: str
    baud_rate: Annotated[int, pydantic.Field(gt=0)] = 2_000_000
    parity: Literal["N", "E", "O"] = "N"
    stop_bits: Literal[1, 2] = 1

    @property
    def place(self) -> str:
        """The URL in quotes, which identifies the port, for messages."""
        return f'"{self.url}"'


class PlcConfig(edge.Config):
    """A Beckhoff PLC that keeps a ring of samples, as ADS reaches it.

    Attributes
    ----------
    net_id, port
        AMS address: the PLC's net id, such as "5.12.82.20.1.1", and its run-time's port.
    host
        Its IP address or name; absent: the first four numbers of the net id.
    ring
        The variable that holds the ring, such as "Recorder.Ring".
    """

    net_id: Annotated[str, pydantic.Field(pattern=r"^\d{1,3}(\.\d{1,3}){5}$")]
    port: Annotated[int, pydantic.Field(ge=1, le=65535)] = 851
    host: Annotated[str, pydantic.Field(pattern=r"^[A-Za-z0-9.:-]+$")] | None = None
    ring: Annotated[str, pydantic.Field(pattern=r"^[\w.\[\]]+$")]

    @property
    def place(self) -> str:
        """Net id, port and ring, which identify the PLC's ring, for messages."""
        return f'{self.net_id}:{self.port} "{self.ring}"'


class ChannelConfig(edge.Config):
    """Keys of every channel of a `BENCH.toml`; the protocols add theirs."""

    protocol: str
    direction: Literal[1, -1] = 1
    zero_reference: Literal["absolute", "incremental"] = "absolute"


class AngleConfig(ChannelConfig):
    """Keys of every angle channel.

    Attributes
    ----------
    counts_per_turn
        Absent: taken from the device.
    zero
        The angle shown at zero, rad.
    largest_speed
        Largest speed of the shaft, rad/s: faster steps are marked implausible. Absent: not known.
    """

    counts_per_turn: Annotated[int, pydantic.Field(gt=0)] | None = None
    zero: edge.Angle = 0.0
    largest_speed: Annotated[edge.Speed, pydantic.Field(gt=0)] | None = None


@dataclasses.dataclass(frozen=True)
class Wiring:
    """Buses, ports and PLCs of a `BENCH.toml` by name, the folder its file names are relative to, and its name."""

    buses: Mapping[str, BusConfig]
    ports: Mapping[str, PortConfig]
    folder: Path
    source: str
    plcs: Mapping[str, PlcConfig] = dataclasses.field(default_factory=dict)

    def bus(self, name: str, channel: str) -> BusConfig:
        """Return the bus of this name; an `edge.InputError` names the channel if there is none."""
        return self._named(self.buses, name, "bus", channel)

    def port(self, name: str, channel: str) -> PortConfig:
        """Return the port of this name; an `edge.InputError` names the channel if there is none."""
        return self._named(self.ports, name, "port", channel)

    def plc(self, name: str, channel: str) -> PlcConfig:
        """Return the PLC of this name; an `edge.InputError` names the channel that wants it where there is none."""
        return self._named(self.plcs, name, "plc", channel)

    def _named(self, table: Mapping[str, Line], name: str, kind: str, channel: str) -> Line:
        if name not in table:
            there = ", ".join(edge.shown(k) for k in table) or "none"
            raise edge.InputError(
                f"{self.source}: [channel.{channel}] {kind} = {edge.shown(name)}: there is no {kind} of this name; "
                f"the file has {there}."
            )
        return table[name]


class Encoder(abc.ABC):
    """A sensor that yields time-stamped samples in blocks; a context manager that opens and closes it.

    `start` is called once all channels of a bench are open, so that none misses samples triggered by the first one.

    Examples
    --------
    Methods that an own protocol must define:

    >>> import drivers
    >>> sorted(drivers.Encoder.__abstractmethods__)
    ['__enter__', 'close', 'events', 'from_config', 'read']
    """

    configuration: ClassVar[type[ChannelConfig]]
    channel: Channel

    @classmethod
    @abc.abstractmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> Encoder:
        """Return the encoder that a `[channel.name]` of a `BENCH.toml` describes, not yet opened.

        Raises
        ------
        edge.InputError
            If it names a bus, port or file that isn't there.
        """

    @abc.abstractmethod
    def __enter__(self) -> Self:
        """Open it; from now on `channel` describes it.

        Raises
        ------
        EncoderError
            If bus, port or device do not answer or answer nonsense.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release bus or port; closing twice is allowed."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self) -> None:  # noqa: B027
        """Start the device's transmission, if necessary."""

    @abc.abstractmethod
    def read(self, timeout: float) -> Samples | None:
        """Return all samples that came since the last call, `time_host` in seconds since 1970.

        Parameters
        ----------
        timeout
            Seconds to wait for the first sample; 0 to return available ones.

        Returns
        -------
        Samples or None
            None if there are none.

        Raises
        ------
        EncoderError
            If the device is lost permanently; recoverable faults are events and status bits.
        """

    @abc.abstractmethod
    def events(self) -> list[Event]:
        """Return the events since the last call, `time` in seconds since 1970, and clear them."""

    def rest(self) -> None:  # noqa: B027
        """Stop the device's transmission, though it was not opened here: a killed process had started it."""

    def drain(self) -> None:  # noqa: B027
        """Read all waiting data of bus or port, so that the next `read` returns it; sampling continues."""

    def finish(self) -> None:  # noqa: B027
        """Note missing samples after the last one as events and in `lost`; called once, after the last `read`."""

    @property
    def lost(self) -> int:
        """Readings that are known to be lost since the encoder was made."""
        return 0

    @property
    def measuring_range(self) -> tuple[float, float] | None:
        """Smallest and largest value that the sensor can measure, SI, if known."""
        return None

    @property
    def waiting(self) -> int:
        """Received readings that are not yet read, if known."""
        return 0


def device_counts(config: AngleConfig, device: int, where: str) -> int:
    """Return the device's counts per turn, which the wiring may repeat but not contradict.

    Raises
    ------
    EncoderSetupError
        If it does.
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

    Its role is its name if that is a role, unless it is a speed.

    Parameters
    ----------
    name, config
        The channel and its table.
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
    """Return the host's time in seconds since 1970, continuous when the calendar clock is set."""
    return _EPOCH + time.monotonic()


class ListeningTime:
    """Seconds in which this process could listen, almost without pauses by a signal or a busy machine.

    Timeouts use it: silence while nobody listened is no sign of a failed device.
    """

    def __init__(self) -> None:
        self._last = time.monotonic()
        self.seconds = 0.0

    def __call__(self) -> float:
        """Update to now and return the seconds; to be called more often than every `_LONGEST_STEP`."""
        now = time.monotonic()
        self.seconds += min(now - self._last, _LONGEST_STEP)
        self._last = now
        return self.seconds


def protocols() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the registered protocols by name: the entry points of the group `cycloid.encoders`."""
    return {e.name: e for e in importlib.metadata.entry_points(group=ENTRY_POINTS)}


def encoder_class(protocol: object, channel: str, source: str) -> type[Encoder]:
    """Return the class of a protocol: of this package or of another installed one.

    Raises
    ------
    edge.InputError
        Naming channel and file, if no installed package has the protocol, two have it, or its class does not load.
    """
    known = protocols()
    if protocol is None:
        raise edge.InputError(
            f"{source}: [channel.{channel}] protocol is missing; there are {', '.join(sorted(known))}."
        )
    if not isinstance(protocol, str) or protocol not in known:
        raise edge.InputError(
            f'{source}: [channel.{channel}] protocol = "{protocol}": no such protocol is installed; '
            f"there are {', '.join(sorted(known)) or 'none'}."
        )
    where = f'{source}: [channel.{channel}] protocol = "{protocol}"'
    owners = {e.dist.name for e in importlib.metadata.entry_points(group=ENTRY_POINTS, name=protocol) if e.dist}
    if len(owners) > 1:
        raise edge.InputError(f"{where}: the packages {' and '.join(sorted(owners))} both have it; remove one.")
    owner = "".join(owners) or known[protocol].value
    try:
        loaded = known[protocol].load()
    except edge.InputError as problem:  # an extra that is not installed
        raise edge.InputError(f"{where}: {problem}") from None
    except Exception as problem:  # a plug-in's module may raise anything
        said = str(problem).rstrip(".") or type(problem).__name__
        raise edge.InputError(f"{where}: the package {owner} that has it does not load: {said}.") from problem
    if not (isinstance(loaded, type) and issubclass(loaded, Encoder) and hasattr(loaded, "configuration")):
        raise edge.InputError(f"{where}: the package {owner} gives no encoder with a configuration, but {loaded!r}.")
    return loaded
