"""Common base of all sensors on a CAN bus: opening and release of the bus, and the reader of their frames."""

from __future__ import annotations

from drivers.can.frames import FrameReader
from drivers.can.hub import CanHub, hubs
from drivers.hubs import HubEncoder
from drivers.lines import BusConfig
from drivers.recording_format import Event


class CanEncoder(HubEncoder[CanHub]):
    """A sensor on a CAN bus; `set_up` must create the `reader`; see `HubEncoder`."""

    shared = hubs
    line = BusConfig
    reader: FrameReader
    _lost_before = 0

    @property
    def bus(self) -> BusConfig:
        """The table of its bus."""
        config: BusConfig = self.line_config
        return config

    def start(self) -> None:
        """Let the hub send SYNC, if the wiring requires it."""
        assert self.hub is not None, "start() is for a sensor that is open"
        self.hub.produce_sync()

    def leave(self, hub: CanHub) -> None:
        """Stop reading frames."""
        if hasattr(self, "reader"):
            self.reader.close()
            self._lost_before += self.reader.lost
            self.reader.lost = 0

    def drain(self) -> None:
        """Let the hub read waiting frames; see `Encoder.drain`."""
        if self.hub is not None:
            self.hub.drain()

    def finish(self) -> None:
        """See `Encoder.finish`."""
        self.reader.finish()

    @property
    def lost(self) -> int:
        """Number of lost frames."""
        return self._lost_before + (self.reader.lost if hasattr(self, "reader") else 0)

    @property
    def waiting(self) -> int:
        """Number of frames received but not yet read."""
        return self.reader.waiting

    def events(self) -> list[Event]:
        """Return gaps, skipped frames and events of the bus; see `Encoder.events`."""
        return self.reader.events()
