"""One reader per CAN bus: data frames go to the channels in blocks, all other frames to the CANopen network.

A callback per frame costs more than reading the frame. So one thread reads the bus, sorts frames by identifier, assigns
each data frame to the SYNC that it answers, and passes on blocks for NumPy to decode.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import math
import threading
import time
from typing import Any

import can
import numpy as np

from cycloid_fmu import edge
from drivers.can.bus import SYNC_ID, frame_key, open_bus
from drivers.counts import Pace, wraps
from drivers.encoder import EncoderConnectionError, EncoderSetupError
from drivers.hubs import BLOCK_SECONDS, BlockQueue, SharedHubs, drained, reason
from drivers.lines import BusConfig
from drivers.recording_format import CLOCK_JUMP, Event, FloatArray, IntArray

with edge.needs_extra("bench"):
    import canopen

SYNC_COUNTER_MAX = 240
BLOCK_FRAMES = 4096
NO_SYNC, BEHIND_GAP = -1, -2  # in place of a SYNC's number: none received yet; it may be lost in the gap before

_BUS_OFF, _CONTROLLER = 0x40, 0x04  # bits of an error frame's identifier in Linux and python-can
_OVERRUN = 0x01  # bit in the second byte of a controller's error frame
_DRAIN_SECONDS = 10.0
_PAUSE = 0.25  # s without SYNC that are a gap even if no frame was lost


@dataclasses.dataclass
class Frames:
    """Data frames of one identifier, in order; arrays of shape (n,), times in s.

    `sync` is the sequence number of the previous SYNC, `NO_SYNC` if there was none, `BEHIND_GAP` if it may be lost;
    `gap` counts the gaps of the bus before each frame; `device` and `sync_device` are stamps of an interface with its
    own clock, otherwise None; `arrived` is when the block was read, on the host's monotonic clock.
    """

    sync: IntArray
    sync_time: FloatArray
    time: FloatArray
    data: list[bytearray]
    arrived: FloatArray
    gap: IntArray
    device: FloatArray | None = None
    sync_device: FloatArray | None = None


def joined_frames(blocks: list[Frames]) -> Frames:
    """Return one identifier's blocks as one."""
    if len(blocks) == 1:
        return blocks[0]

    def column(name: str) -> Any:
        parts = [getattr(block, name) for block in blocks]
        return None if parts[0] is None else np.concatenate(parts)

    columns = {name: column(name) for name in ("sync", "sync_time", "time", "arrived", "gap", "device", "sync_device")}
    return Frames(data=[payload for block in blocks for payload in block.data], **columns)


class CanHub:
    """The reader of one bus; see `hubs`.

    Frames are identified by their `frame_key`. After a gap no frame is assigned to a SYNC before it, and SYNCs are
    counted from the elapsed time.

    Attributes
    ----------
    network
        A `canopen.Network` for SDO, NMT, heartbeat and EMCY, fed by the reader.
    gaps, sync, handed_on
        Number of gaps of the bus so far; sequence number of the newest SYNC, and of the newest SYNC up to which all
        frames are in the queues.
    tells_drops
        Whether all drops are known: the kernel counts them, or the bus never drops frames. Otherwise gaps are detected
        only from the stamps.
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
        self.sync, self._sync_time, self._sync_device = NO_SYNC, 0.0, 0.0
        self.handed_on = NO_SYNC
        self._counter, self._counter_max = 0, SYNC_COUNTER_MAX
        self._pace, self._floor = Pace(), math.inf
        self._produced: collections.deque[tuple[int, float]] = collections.deque()
        self._produced_last: int | None = None
        self.gaps, self._in_gap = 0, False
        self._drops = getattr(self.bus, "drops", None)
        self._dropped = 0
        self.tells_drops = config.interface == "virtual" or (self._drops is not None and self._drops.known)
        self._block_gaps: list[tuple[int, int]] = []  # place in the block, number of frames lost there (0: unknown)
        self._drain_from: float | None = None
        self._drained, self._drained_at = threading.Event(), 0.0
        self._own_clock: bool | None = None
        self._odd = {"error frames": 0, "echoes of own frames": 0, "frames like a channel's in another format": 0}
        self._emptied = False
        self._stopping = threading.Event()
        self._producer: threading.Thread | None = None
        self._thread = threading.Thread(target=self._run, name=f"CAN {self.config.address}", daemon=True)
        self._thread.start()

    def subscribe(self, identifier: int) -> BlockQueue[Frames]:
        """Return a queue that receives the frames of this `frame_key` from now on, block by block."""
        blocks: BlockQueue[Frames] = BlockQueue()
        self._queues = {**self._queues, identifier: [*self._queues.get(identifier, []), blocks]}
        self._wanted = frozenset({SYNC_ID, *self._queues})
        if self.broken:
            blocks.fail(self._failure)
        return blocks

    def unsubscribe(self, identifier: int, blocks: object) -> None:
        """Stop filling a queue."""
        remaining = [q for q in self._queues.get(identifier, []) if q is not blocks]
        others = {k: v for k, v in self._queues.items() if k != identifier}
        self._queues = {**others, identifier: remaining} if remaining else others
        self._wanted = frozenset({SYNC_ID, *self._queues})

    def node(self, number: int, quantity: str) -> Any:
        """Return the remote node of this number, reserved for one of its quantities until `leave_node`.

        Raises
        ------
        EncoderSetupError
            If another channel uses this quantity of this node.
        """
        taken = self._quantities.setdefault(number, set())
        if quantity in taken:
            raise EncoderSetupError(
                f"The {quantity} of node {number} on the CAN bus {self.config.address} is in use by another channel."
            )
        taken.add(quantity)
        if number not in self.network:
            self.network.add_node(number, canopen.ObjectDictionary())
        return self.network[number]

    def leave_node(self, number: int, quantity: str) -> None:
        """Release a quantity of a node; the last one removes the node."""
        self._quantities[number].discard(quantity)
        if not self._quantities[number]:
            del self._quantities[number], self.network[number]

    def produce_sync(self) -> None:
        """Send SYNC from now on, if the wiring requires it."""
        if self.config.sync_period is not None and self._producer is None:
            self._producer = threading.Thread(target=self._produce, name=f"SYNC {self.config.address}", daemon=True)
            self._producer.start()

    def events(self) -> list[Event]:
        """Return the events of the bus itself since the last call; `channel` is empty."""
        return drained(self._events)

    def drain(self) -> None:
        """Wait until all frames now on the bus are in the queues."""
        if time.monotonic() - self._drained_at < BLOCK_SECONDS:  # for another channel of this bus, just now
            return
        self._drained.clear()
        self._drain_from = time.time()
        came = self.broken or self._drained.wait(_DRAIN_SECONDS)
        self._drained_at = time.monotonic()
        if not came:
            self._events.append(Event(time.time(), "", f"unread frames remain on the CAN bus {self.config.address}"))

    def finish(self) -> None:
        """Report the frames lost after the last one, at the end of reading."""
        if self._drops is not None and (lost := self._drops.since()):
            self._say_lost(lost, time.time())
            self.gaps += 1
            self._drops.total += lost

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
                finally:  # keep frames received before the bus failed
                    self._take(block, arrivals)
                if self._drain_from is not None and self._emptied:
                    self._drain_from = None
                    self._drained.set()
        except Exception as problem:  # nobody else sees why this thread ends
            self._break(problem)

    def _break(self, problem: Exception) -> None:
        self._failure = EncoderConnectionError(
            f"The CAN bus {self.config.address} failed: {reason(problem, 'interface')}."
        )
        self.broken = True
        self._drained.set()
        for queues in self._queues.values():
            for blocks in queues:
                blocks.fail(self._failure)

    def _produce(self) -> None:
        """Send SYNC periodically; missed times are skipped."""
        period = self.config.sync_period
        assert period is not None
        message = can.Message(arbitration_id=SYNC_ID, is_extended_id=False)
        begun, number = time.monotonic(), 0
        try:
            while not self._stopping.wait(max(0.0, begun + number * period - time.monotonic())):
                number = max(number, int((time.monotonic() - begun) / period))  # some may be missed
                self._produced.append((number, time.time()))
                self.bus.send(message)
                number = max(number + 1, int((time.monotonic() - begun) / period))
        except Exception as problem:  # as in `_run`
            self._break(problem)

    def _receive(self, block: list[can.Message], arrivals: list[float]) -> None:
        """Append the data and SYNC frames of a block; serve other frames at once, as callers wait for them.

        If the interface has its own clock, append the host's time of each frame to `arrivals`.
        """
        receive, append, own_clock, drops = self.bus.recv, block.append, self._own_clock, self._drops
        end = time.monotonic() + BLOCK_SECONDS
        self._emptied = False
        for _ in range(BLOCK_FRAMES):
            message = receive(0.0)
            if message is None:  # read the clock only when there is time for it
                if self._drain_from is not None:
                    self._emptied = True
                    return
                message = receive(max(0.0, end - time.monotonic()))
                if message is None:
                    return
            if own_clock is None and message.is_rx:
                # Some interfaces count from power-up, on their own clock.
                own_clock = self._own_clock = abs(time.time() - message.timestamp) > 3600
            if drops is not None and drops.total != self._dropped:
                self._block_gaps.append((len(block), drops.total - self._dropped))
                self._dropped = drops.total
            key = message.arbitration_id
            if message.is_extended_id or message.is_fd:
                key = frame_key(key, extended=message.is_extended_id, fd=message.is_fd)
            if key in self._wanted and not message.is_error_frame:
                append(message)
                if own_clock:
                    arrivals.append(time.time())
            else:
                self._serve(message, key, len(block))
        since = self._drain_from  # with constant traffic the bus is never empty
        self._emptied = since is not None and (bool(own_clock) or (bool(block) and block[-1].timestamp > since))

    def _serve(self, message: can.Message, key: int, index: int) -> None:
        """Pass a frame of no channel to CANopen's services; `index`: number of frames before it in the block."""
        if message.is_error_frame:
            self._odd["error frames"] += 1
            if message.arbitration_id & _CONTROLLER and _OVERRUN & sum(message.data[1:2]):
                self._block_gaps.append((index, 0))
            if message.arbitration_id & _BUS_OFF:
                raise can.CanOperationError("bus-off")
        elif key != message.arbitration_id:
            numbers = {wanted & 0x1FFFFFFF for wanted in self._wanted}
            self._odd["frames like a channel's in another format"] += message.arbitration_id in numbers
        elif not message.is_remote_frame:
            with contextlib.suppress(Exception):  # a malformed service frame must not end the recording
                stamp = time.time() if self._own_clock else message.timestamp
                self.network.notify(message.arbitration_id, message.data, stamp)

    def _take(self, block: list[can.Message], arrivals: list[float]) -> None:
        """Sort a block's frames by key, each with the SYNC before it, into the queues."""
        gaps, self._block_gaps = self._block_gaps, []
        if any([m.is_remote_frame or not m.is_rx for m in block]):
            indices = self._plain(block)
            gaps = [(int(np.searchsorted(indices, index)), lost) for index, lost in gaps]
            block, arrivals = [block[i] for i in indices], [arrivals[i] for i in indices] if arrivals else []
        if block or gaps:
            self._publish(block, arrivals, gaps, time.monotonic())
        for what, count in self._odd.items():
            if count:
                self._events.append(Event(time.time(), "", f"{count} {what} on the CAN bus {self.config.address}"))
                self._odd[what] = 0

    def _plain(self, block: list[can.Message]) -> list[int]:
        """Return the places of all frames except remote frames and echoes of own frames other than SYNC."""
        indices = []
        for index, message in enumerate(block):
            if message.is_remote_frame:
                continue
            if not message.is_rx and message.arbitration_id != SYNC_ID:
                self._odd["echoes of own frames"] += 1
            else:
                indices.append(index)
        return indices

    def _publish(
        self, block: list[can.Message], arrivals: list[float], gaps: list[tuple[int, int]], arrived: float
    ) -> None:
        """Put the frames of a block into their queues; `gaps`: places in the block and numbers of frames lost there."""
        keys = np.array([m.arbitration_id for m in block], np.int64)
        if any([m.is_extended_id or m.is_fd for m in block]):
            keys |= np.array([frame_key(0, extended=m.is_extended_id, fd=m.is_fd) for m in block])
        stamps = np.array([m.timestamp for m in block])
        host = np.array(arrivals) if arrivals else stamps
        synced = keys == SYNC_ID
        # Changes of the state along the block, in order: before a frame after a gap, and at each SYNC.
        changes = sorted([(index, 0) for index, _ in gaps] + [(index, 1) for index in np.flatnonzero(synced).tolist()])
        seen = [self._state()]
        for index, is_sync in changes:
            if is_sync:
                self._on_sync(block[index].data, float(host[index]), block[index].timestamp, arrived)
            else:
                self.gaps, self._in_gap = self.gaps + 1, True
            seen.append(self._state())
        if gaps:
            at = float(host[min(gaps[0][0], len(block) - 1)]) if block else time.time()
            self._say_lost(sum(lost for _, lost in gaps), at)
        state = np.searchsorted([index for index, _ in changes], np.arange(len(block)), side="right")
        numbers, times, devices, counted = map(np.array, zip(*seen, strict=True))
        sync, sync_stamps = numbers[state], (devices if arrivals else times)[state]
        if not self.tells_drops and (period := self._pace.period) is not None:
            sync = np.where((sync >= 0) & (stamps - sync_stamps > period), BEHIND_GAP, sync)
        for key, queues in self._queues.items():
            mine = np.flatnonzero((keys == key) & ~synced)
            if not len(mine):
                continue
            frames = Frames(
                sync[mine],
                times[state[mine]],
                host[mine],
                [block[i].data for i in mine.tolist()],
                np.full(len(mine), arrived),
                counted[state[mine]],
                stamps[mine] if arrivals else None,
                devices[state[mine]] if arrivals else None,
            )
            for blocks in queues:
                blocks.put(frames, len(mine))
        self.handed_on = self.sync

    def _state(self) -> tuple[int, float, float, int]:
        """Return number, host time and device stamp of the next frame's SYNC, and the number of gaps so far."""
        bound = BEHIND_GAP if self._in_gap and self.sync >= 0 else self.sync
        return bound, self._sync_time, self._sync_device, self.gaps

    def _say_lost(self, lost: int, at: float) -> None:
        what, why = (f"{lost} frames", "not read in time") if lost else ("frames", "overrun of the controller")
        self._events.append(Event(at, "", f"{what} lost on the CAN bus {self.config.address}: {why}"))

    def _on_sync(self, data: bytearray, host: float, stamp: float, arrived: float) -> None:
        """Count a SYNC and those missing before it."""
        elapsed = stamp - self._sync_device
        # Like ClockJumps, frame by frame: the clock goes back, or a stamp is later than its arrival.
        jumped = self.sync >= 0 and (elapsed < -CLOCK_JUMP or arrived - stamp < self._floor - CLOCK_JUMP)
        self._floor = arrived - stamp if jumped else min(self._floor, arrived - stamp)
        if jumped:
            self._events.append(Event(host, "", f"the clock of SYNC jumped on the CAN bus {self.config.address}"))
            self.gaps += 1
        counter = data[0] if len(data) == 1 and 1 <= data[0] <= SYNC_COUNTER_MAX else 0
        asked = self._in_gap or not self.tells_drops or elapsed > _PAUSE or counter == 1
        usual = self._pace.period if asked and not jumped else None
        expected = elapsed / usual if usual else None
        step = 1
        if self._produced:
            self._say_held_up(host, elapsed)
        elif self.sync < 0:
            pass
        elif counter and self._counter:
            step = self._counter_step(counter, expected)
        elif expected is not None and (self._in_gap or elapsed > min(self._pace.longest, _PAUSE)):
            step = max(1, round(expected))
        if step > 1:
            how = f" (counter {counter})" if counter else ""
            self._events.append(Event(host, "", f"{step - 1} SYNC missing on the CAN bus {self.config.address}{how}"))
        elif self.sync >= 0 and not self._in_gap and not jumped:
            self._pace.add(elapsed)
        self.sync, self._counter, self._in_gap = max(self.sync, -1) + step, counter, False
        self._sync_time, self._sync_device = host, stamp

    def _counter_step(self, counter: int, expected: float | None) -> int:
        """Return the steps of a SYNC counter, which rolls over to 1 at the value set in its producer (0x1019).

        `expected`: steps expected from the elapsed time, None if unknown.
        """
        modulus = self._counter_max
        step = (counter - self._counter) % modulus or modulus
        if counter > modulus or self._counter > modulus:
            modulus = self._counter_max = SYNC_COUNTER_MAX
            step = (counter - self._counter) % modulus or modulus
        elif counter == 1 and not self._in_gap and (expected is None or abs(expected - 1) < abs(expected - step)):
            step, self._counter_max = 1, self._counter  # by its time it is the next SYNC, not one 240 - counter later
        if expected is not None and (self._in_gap or not self.tells_drops):
            step += modulus * int(wraps(np.array([step]), modulus, np.array([expected]))[0])
        return step

    def _say_held_up(self, host: float, elapsed: float) -> None:
        """Report the SYNCs that this recorder failed to send before the received one: the samples have a gap."""
        assert self.config.sync_period is not None, "it sends SYNC"
        number, _ = self._produced.popleft()
        while not self._own_clock and self._produced and self._produced[0][1] <= host:  # its echo was lost
            number, _ = self._produced.popleft()
        before, self._produced_last = self._produced_last, number
        if before is None or self._in_gap:
            return
        missed = number - before - 1
        if elapsed > 3 * self.config.sync_period:  # delayed between taking the number and sending
            missed = max(missed, round(elapsed / self.config.sync_period) - 1)
        if missed:
            self.gaps += 1
            text = f"{missed} SYNC not sent in time on the CAN bus {self.config.address}"
            self._events.append(Event(host, "", f"{text}: the recorder was delayed"))


hubs = SharedHubs(CanHub)
"""The buses in use; `hubs.acquire` and `hubs.release` them."""
