"""A column of the ring buffer of samples in a Beckhoff PLC, read over ADS."""

from __future__ import annotations

import collections
import contextlib
from typing import Annotated

import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.ads.plc import PlcHub, plcs
from drivers.ads.ring import Block
from drivers.counts import counts_to_value, unwrap
from drivers.encoder import AngleConfig, EncoderSetupError, PlcConfig, channel_of
from drivers.hubs import BlockQueue, HubEncoder, drained
from drivers.recording_format import GAP, RESET, ROLLOVER, Event, Samples, joined


class AdsConfig(AngleConfig):
    """A `[channel.X]` with protocol = "ads".

    Attributes
    ----------
    plc, column
        Name of the PLC's table, and number of the column in its ring, from 1.
    counts_modulus
        Number of counts after which an angle starts again from 0; absent: it does not.
    torque_per_count
        Torque of one count, N*m or text such as "1 mN*m"; an angle has `counts_per_turn` instead.
    """

    plc: str
    column: Annotated[int, pydantic.Field(ge=1)]
    counts_modulus: Annotated[int, pydantic.Field(ge=2, le=1 << 62)] | None = None
    torque_per_count: edge.Torque | None = None


class AdsEncoder(HubEncoder[PlcHub]):
    """A column of a PLC's ring. All columns of a sample have exactly the same time.

    Samples that the PLC overwrote before they were read are detected by their numbers: they are counted and reported as
    an event, and the next sample is marked. While the PLC can't be reached its ring continues; samples still in it
    are recorded afterwards.
    """

    configuration = AdsConfig
    shared = plcs
    line = "plc"

    def __init__(self, name: str, config: AdsConfig, plc: PlcConfig) -> None:
        super().__init__(name, config, plc)
        if (config.counts_per_turn is None) == (config.torque_per_count is None):
            raise edge.InputError("write one of counts_per_turn (an angle) and torque_per_count.")
        self.where = f"{name}: PLC {plc.place}, column {config.column}"
        self._blocks: BlockQueue[Block] = BlockQueue()
        self._events: collections.deque[Event] = collections.deque()
        self._last: tuple[int, int] | None = None
        self._counts: int | None = None
        self._lost = 0

    def set_up(self, hub: PlcHub) -> None:
        """See `HubEncoder.set_up`."""
        if self.config.column > hub.head.columns:
            raise EncoderSetupError(f"{self.where}: the ring has {hub.head.columns} columns.")
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"PLC {hub.config.place} column {self.config.column} of {hub.head.columns}",
            time_source=f"hardware clock: cycle of the PLC's task (PLC {hub.config.net_id})",
            unit="N*m" if self.config.counts_per_turn is None else "rad",
            counts_per_turn=self.config.counts_per_turn,
        )

    def start(self) -> None:
        """Follow the ring from now on, or after an interruption from the last sample read."""
        assert self.hub is not None, "start() is for an encoder that is open"
        self._blocks = BlockQueue()
        self.hub.follow(self._blocks, self._last)

    def leave(self, hub: PlcHub) -> None:
        """Stop following the ring."""
        hub.leave(self._blocks)

    @property
    def waiting(self) -> int:
        """Number of samples received but not yet read."""
        return self._blocks.waiting

    @property
    def lost(self) -> int:
        """Number of samples known to be lost since the encoder was created."""
        return self._lost

    def drain(self) -> None:
        """Read the new samples of the ring, so that the next `read` returns them."""
        if self.hub is not None and not self.hub.broken:
            with contextlib.suppress(Exception):  # the hub's thread runs into it too, and reports it
                self.hub.take()

    def events(self) -> list[Event]:
        """Return missing samples and restarts; see `Encoder.events`."""
        return drained(self._events)

    def read(self, timeout: float) -> Samples | None:
        """Return the new samples; see `Encoder.read`."""
        # Samples lost to a slow recorder are detected by their numbers too.
        blocks = [self._samples(block) for _, block in self._blocks.take(timeout)]
        blocks = [block for block in blocks if len(block)]
        return joined(self.name, blocks) if blocks else None

    def _samples(self, block: Block) -> Samples:
        restarted = self._last is not None and self._last[0] != block.started
        after = 0 if restarted else block.numbers[0] - 1 if self._last is None else self._last[1]
        new = block.numbers > after  # another channel of this ring may have requested earlier ones again
        numbers, host = block.numbers[new], block.time_host[new]
        counts = block.values[new, self.config.column - 1].astype(np.int64)
        status = np.zeros(len(numbers), np.int64)
        if not len(numbers):
            return Samples.checked(self.name, [], [], time_device=[], counts=[])
        if restarted:
            status[0] = RESET | GAP
            self._events.append(Event(float(host[0]), self.name, "the PLC's program restarted"))
            self._counts = None
        missing = np.diff(numbers, prepend=after) - 1
        if missing.any():
            status[missing > 0] |= GAP
            self._lost += int(missing.sum())
            where = float(host[np.flatnonzero(missing)[0]])
            text = f"{int(missing.sum())} samples missing by their number: overwritten before they were read"
            self._events.append(Event(where, self.name, text))
        self._last = block.started, int(numbers[-1])
        if self.config.counts_modulus is not None:
            counts, rolled = unwrap(counts, self.config.counts_modulus, self._counts)
            status |= rolled * ROLLOVER
            self._counts = int(counts[-1])
        if self.config.counts_per_turn is None:
            value = self.config.direction * self.config.torque_per_count * counts - self.config.zero
        else:
            value = counts_to_value(counts, self.config.counts_per_turn, self.config.direction, self.config.zero)
        device = block.time_device[new]
        return Samples.checked(self.name, host, value, time_device=device, counts=counts, status=status)
