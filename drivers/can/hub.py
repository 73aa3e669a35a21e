"""One reader for each CAN bus: data frames in blocks to the channels, everything else to CANopen's supervision.

A callback a frame costs more than the frame; so one thread takes what the bus has, sorts it by identifier, notes for
each data frame the SYNC that it answers, and hands it on by the block for NumPy to decode.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import threading
import time
from typing import Any

import can
import canopen
import numpy as np

from drivers.can.bus import SYNC_ID, open_bus
from drivers.encoder import BusConfig, EncoderConnectionError, EncoderSetupError
from drivers.hubs import BLOCK_SECONDS, BlockQueue, SharedHubs, drained, reason
from drivers.recording_format import Event, FloatArray, IntArray

SYNC_COUNTER_MAX = 240
BLOCK_FRAMES = 4096


_BUS_OFF = 0x40  # of an error frame's identifier, as Linux and python-can number them


@dataclasses.dataclass
class Frames:
    """Data frames of one identifier, in order; arrays of shape (n,).

    `sync` is the running number of the SYNC before, -1 where none came; `device` and `sync_device` are stamps of an
    interface that has a clock of its own, None otherwise; `arrived` is when the last of them was taken, on the host's
    monotonic clock.
    """

    sync: IntArray
    sync_time: FloatArray
    time: FloatArray
    data: list[bytearray]
    arrived: float = 0.0
    device: FloatArray | None = None
    sync_device: FloatArray | None = None


def joined_frames(blocks: list[Frames]) -> Frames:
    """Return one identifier's blocks as one."""
    if len(blocks) == 1:
        return blocks[0]

    def column(name: str) -> Any:
        parts = [getattr(block, name) for block in blocks]
        return None if parts[0] is None else np.concatenate(parts)

    columns = {name: column(name) for name in ("sync", "sync_time", "time", "device", "sync_device")}
    return Frames(data=[payload for block in blocks for payload in block.data], arrived=blocks[-1].arrived, **columns)


class CanHub:
    """The reader of one bus; see `hubs`.

    `network` is a `canopen.Network` for SDO, NMT, heartbeat and EMCY, fed by the reader.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self.bus = open_bus(config)
        self.network = canopen.Network(self.bus)
        self.broken = False
        self._quantities: dict[int, set[str]] = {}
        self._queues: dict[int, list[BlockQueue[Frames]]] = {}
        self._wanted = frozenset({SYNC_ID})
        self._events: collections.deque[Event] = collections.deque()
        self._sync, self._sync_time, self._sync_device, self._counter = -1, 0.0, 0.0, 0
        self._own_clock: bool | None = None
        self._odd = {"error frames": 0, "echoes of own frames": 0}
        self._stopping = threading.Event()
        self._producer: threading.Thread | None = None
        self._thread = threading.Thread(target=self._run, name=f"CAN {self.config.place}", daemon=True)
        self._thread.start()

    def subscribe(self, identifier: int) -> BlockQueue[Frames]:
        """Return a queue into which the frames of this identifier go from now on, block by block."""
        blocks: BlockQueue[Frames] = BlockQueue()
        self._queues = {**self._queues, identifier: [*self._queues.get(identifier, []), blocks]}
        self._wanted = frozenset({SYNC_ID, *self._queues})
        if self.broken:
            blocks.fail(self._failure)
        return blocks

    def unsubscribe(self, identifier: int, blocks: object) -> None:
        """Stop filling a queue."""
        left = [q for q in self._queues.get(identifier, []) if q is not blocks]
        others = {k: v for k, v in self._queues.items() if k != identifier}
        self._queues = {**others, identifier: left} if left else others
        self._wanted = frozenset({SYNC_ID, *self._queues})

    def node(self, number: int, quantity: str) -> Any:
        """Return the remote node for one of its quantities; `leave_node` gives it back.

        Raises
        ------
        EncoderSetupError
            If another channel has this quantity of this node.
        """
        taken = self._quantities.setdefault(number, set())
        if quantity in taken:
            raise EncoderSetupError(
                f"The {quantity} of node {number} on the CAN bus {self.config.place} is taken by another channel."
            )
        taken.add(quantity)
        if number not in self.network:
            self.network.add_node(number, canopen.ObjectDictionary())
        return self.network[number]

    def leave_node(self, number: int, quantity: str) -> None:
        """Give a quantity of a node back; the last one forgets the node."""
        self._quantities[number].discard(quantity)
        if not self._quantities[number]:
            del self._quantities[number], self.network[number]

    def produce_sync(self) -> None:
        """Send SYNC from now on, where the wiring says so."""
        if self.config.sync_period is not None and self._producer is None:
            self._producer = threading.Thread(target=self._produce, name=f"SYNC {self.config.place}", daemon=True)
            self._producer.start()

    def events(self) -> list[Event]:
        """Return what happened on the bus itself since the last call; `channel` is empty."""
        return drained(self._events)

    def close(self) -> None:
        """Stop the reader and close the bus."""
        self._stopping.set()
        for thread in (self._producer, self._thread):
            if thread is not None:
                thread.join()
        with contextlib.suppress(Exception):
            self.bus.shutdown()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                block: list[can.Message] = []
                arrivals: list[float] = []
                try:
                    self._receive(block, arrivals)
                finally:  # what came before the bus broke came
                    self._take(block, arrivals)
        except Exception as problem:  # the reader must say why it ends: nobody else sees it
            self._break(problem)

    def _break(self, problem: Exception) -> None:
        self._failure = EncoderConnectionError(
            f"The CAN bus {self.config.place} broke: {reason(problem, 'interface')}."
        )
        self.broken = True
        for queues in self._queues.values():
            for blocks in queues:
                blocks.fail(self._failure)

    def _produce(self) -> None:
        """Send SYNC at its times; a time that is missed is left out."""
        period = self.config.sync_period
        assert period is not None
        message = can.Message(arbitration_id=SYNC_ID, is_extended_id=False)
        begun, number = time.monotonic(), 0
        try:
            while not self._stopping.wait(max(0.0, begun + number * period - time.monotonic())):
                self.bus.send(message)
                number = max(number + 1, int((time.monotonic() - begun) / period))
        except Exception as problem:  # as in `_run`
            self._break(problem)

    def _receive(self, block: list[can.Message], arrivals: list[float]) -> None:
        """Append the data and SYNC frames of a block; what else comes is served at once, somebody waits for it.

        `arrivals` gets the host's time of each where the interface has a clock of its own.
        """
        receive, append, own_clock = self.bus.recv, block.append, self._own_clock
        end = time.monotonic() + BLOCK_SECONDS
        for _ in range(BLOCK_FRAMES):
            message = receive(0.0)
            if message is None:  # the clock is only asked where there is time for it
                message = receive(max(0.0, end - time.monotonic()))
                if message is None:
                    return
            if own_clock is None:
                # Some interfaces count from power-up: theirs is a clock of its own.
                own_clock = self._own_clock = abs(time.time() - message.timestamp) > 3600
            if message.arbitration_id in self._wanted:
                append(message)
                if own_clock:
                    arrivals.append(time.time())
            else:
                self._serve(message)

    def _serve(self, message: can.Message) -> None:
        """Hand a frame that is no channel's to CANopen's services."""
        if message.is_error_frame:
            self._odd["error frames"] += 1
            if message.arbitration_id & _BUS_OFF:
                raise can.CanOperationError("bus-off")
        elif not message.is_remote_frame:
            with contextlib.suppress(Exception):  # a malformed service frame must not end the recording
                stamp = time.time() if self._own_clock else message.timestamp
                self.network.notify(message.arbitration_id, message.data, stamp)

    def _take(self, block: list[can.Message], arrivals: list[float]) -> None:
        """Sort a block's frames by identifier, each with the SYNC before it, and hand them on."""
        try:
            errors: list[can.Message] = []
            if any([m.is_error_frame or m.is_remote_frame or not m.is_rx for m in block]):
                errors = [m for m in block if m.is_error_frame]
                kept = self._plain(block)
                block, arrivals = [block[i] for i in kept], [arrivals[i] for i in kept] if arrivals else []
            if block:
                self._publish(block, arrivals)
            for message in errors:  # last: bus-off ends the reader, not what came before it
                self._serve(message)
        finally:
            for what, count in self._odd.items():
                if count:
                    self._events.append(Event(time.time(), "", f"{count} {what} on the CAN bus {self.config.place}"))
                    self._odd[what] = 0

    def _plain(self, block: list[can.Message]) -> list[int]:
        """Return the places of what is no error frame, remote frame or echo of an own frame, SYNC being no echo."""
        kept = []
        for place, message in enumerate(block):
            if message.is_error_frame or message.is_remote_frame:
                continue
            if not message.is_rx and message.arbitration_id != SYNC_ID:
                self._odd["echoes of own frames"] += 1
            else:
                kept.append(place)
        return kept

    def _publish(self, block: list[can.Message], arrivals: list[float]) -> None:
        """Put the frames of a block, of which there is one at least, into their identifiers' queues."""
        arrived = time.monotonic()
        identifiers = np.array([m.arbitration_id for m in block])
        stamps = np.array([m.timestamp for m in block])
        host = np.array(arrivals) if arrivals else stamps
        synced = identifiers == SYNC_ID
        seen = [(self._sync, self._sync_time, self._sync_device)]
        for place in np.flatnonzero(synced).tolist():
            if block[place].is_extended_id:  # 29 bits of the same number
                synced[place] = False
                continue
            self._sync_device = block[place].timestamp
            self._on_sync(block[place].data, float(host[place]))
            seen.append((self._sync, self._sync_time, self._sync_device))
        before = np.cumsum(synced)
        numbers, times, devices = map(np.array, zip(*seen, strict=True))
        for identifier, queues in self._queues.items():
            mine = np.flatnonzero((identifiers == identifier) & ~synced)
            if not len(mine):
                continue
            frames = Frames(
                numbers[before[mine]], times[before[mine]], host[mine], [block[i].data for i in mine.tolist()], arrived,
                stamps[mine] if arrivals else None, devices[before[mine]] if arrivals else None,
            )  # fmt: skip
            for blocks in queues:
                blocks.put(frames, len(mine))

    def _on_sync(self, data: bytearray, stamp: float) -> None:
        step = 1
        if len(data) == 1 and 1 <= data[0] <= SYNC_COUNTER_MAX:
            if self._counter:
                step = (data[0] - self._counter) % SYNC_COUNTER_MAX or SYNC_COUNTER_MAX
            self._counter = data[0]
        if step > 1:
            lost = step - 1
            self._events.append(
                Event(stamp, "", f"{lost} SYNC missing on the CAN bus {self.config.place} (counter {data[0]})")
            )
        self._sync += step
        self._sync_time = stamp


hubs = SharedHubs(CanHub)
"""The buses in use; `hubs.acquire` and `hubs.release` them."""
