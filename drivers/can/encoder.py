"""What all sensors on a CAN bus share: the bus, opened and given back, and the reader of their frames."""

from __future__ import annotations

import abc
from typing import Any, Self

from drivers.can.frames import FrameReader
from drivers.can.hub import CanHub, hubs
from drivers.encoder import BusConfig, Encoder
from drivers.recording_format import Event


class CanEncoder(Encoder):
    """A sensor on a CAN bus.

    Parameters
    ----------
    name
        Name of the channel.
    config
        The channel's table in the `BENCH.toml`.
    bus
        The bus.
    """

    reader: FrameReader

    def __init__(self, name: str, config: Any, bus: BusConfig) -> None:
        self.name, self.config, self.bus = name, config, bus
        self.hub: CanHub | None = None

    @abc.abstractmethod
    def set_up(self, hub: CanHub) -> None:
        """Find out what the sensor is and begin to read: set `channel` and `reader`.

        Raises
        ------
        EncoderError
            If it does not answer or answers nonsense.
        """

    def __enter__(self) -> Self:
        """Open the bus and set the sensor up; see `Encoder.__enter__`."""
        self.hub = hubs.acquire(self.bus)
        try:
            self.set_up(self.hub)
        except BaseException:
            self.close()
            raise
        return self

    def start(self) -> None:
        """Let the hub send SYNC, where the wiring has it do so."""
        assert self.hub is not None, "start() is for a sensor that is open"
        self.hub.produce_sync()

    def leave(self, hub: CanHub) -> None:
        """Take back what `set_up` did besides the reader."""

    def close(self) -> None:
        """Take no more frames and give the bus back."""
        hub, self.hub = self.hub, None
        if hub is not None:
            if hasattr(self, "reader"):
                self.reader.close()
            self.leave(hub)
            hubs.release(hub)

    @property
    def waiting(self) -> int:
        """Frames that came and are not yet read."""
        return self.reader.waiting

    def events(self) -> list[Event]:
        """Return gaps, skipped frames and what happened on the bus; see `Encoder.events`."""
        return self.reader.events()
