"""The interface of encoders, its errors and the registry of protocols."""

from __future__ import annotations

import abc
import importlib.metadata
import time
from typing import Annotated, ClassVar, Literal

import pydantic

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.plug_in import PlugIn, PlugInConfig, registered
from drivers.recording_format import Channel, Event, Samples

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


class ChannelConfig(PlugInConfig):
    """Keys of every channel of a `BENCH.toml`; each protocol adds its own.

    Attributes
    ----------
    direction
        +1 if the sensor's values increase counter-clockwise, -1 if they decrease.
    zero_reference
        "absolute": the zero is the same in every recording; "incremental": each recording has its own.
    """

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


class Encoder(PlugIn):
    """A sensor that yields time-stamped samples in blocks, described by a `[channel.name]`.

    From `__enter__` on, `channel` describes it. `start` is called once all channels of a bench are open, so that none
    misses samples triggered by the first one.

    Examples
    --------
    Methods that a new protocol must define:

    >>> import drivers
    >>> sorted(drivers.Encoder.__abstractmethods__)
    ['__enter__', 'close', 'events', 'read']
    """

    group = "cycloid.encoders"
    configuration: ClassVar[type[ChannelConfig]]
    channel: Channel

    def start(self) -> None:
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

    def drain(self) -> None:
        """Read all data waiting on the bus or port, so that the next `read` returns it; sampling continues."""

    def finish(self) -> None:
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


def protocols() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the registered protocols of encoders by name."""
    return {e.name: e for e in registered(Encoder.group)}
