"""One reader for each CAN bus: data frames in blocks to the channels, everything else to CANopen's supervision.

A callback a frame costs more than the frame; so one thread takes what the bus has, sorts it by identifier, notes for
each data frame the SYNC that it answers, and hands it on by the block for NumPy to decode.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import os
import queue
import socket
import threading
import time
from typing import Any, TypeAlias

import can
import canopen
import numpy as np

from drivers.encoder import BusConfig, EncoderConnectionError
from drivers.recording_format import GAP, Event, FloatArray, IntArray

SYNC_ID = 0x80
SYNC_COUNTER_MAX = 240
BLOCK_SECONDS = 0.05  # of a block, and so of what a kill can cost besides the batch being written
BLOCK_FRAMES = 4096
_RECEIVE_BUFFER = 4 << 20
_IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 49, 29


@dataclasses.dataclass
class Frames:
    """Data frames of one identifier, in order; `sync` is the running number of the SYNC before, -1 where none came."""

    sync: list[int] = dataclasses.field(default_factory=list)
    sync_time: list[float] = dataclasses.field(default_factory=list)
    time: list[float] = dataclasses.field(default_factory=list)
    data: list[bytes] = dataclasses.field(default_factory=list)

    def extend(self, other: Frames) -> None:
        """Append the frames of a later block."""
        self.sync += other.sync
        self.sync_time += other.sync_time
        self.time += other.time
        self.data += other.data


FrameQueue: TypeAlias = "queue.SimpleQueue[Frames | EncoderConnectionError]"


def open_bus(config: BusConfig, **options: Any) -> can.BusABC:
    """Open a bus with python-can.

    A UDP bus gets a receive buffer for a second of frames (the usual one holds 256) and only its own group's frames
    (else Linux hands it those of every group that anybody on the machine has joined).

    Raises
    ------
    EncoderConnectionError
        If the interface is unknown or does not open.
    """
    if config.bitrate is not None:
        options["bitrate"] = config.bitrate
    try:
        bus = can.Bus(interface=config.interface, channel=config.channel, **options)
    except Exception as problem:  # each backend of python-can raises its own
        raise EncoderConnectionError(
            f'The CAN bus {config.interface} "{config.channel}" does not open: {problem}.'
        ) from problem
    if config.interface == "udp_multicast":
        with socket.socket(fileno=os.dup(bus.fileno())) as udp, contextlib.suppress(OSError):
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            if udp.family == socket.AF_INET6:
                udp.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
            else:
                udp.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    return bus


def drained(events: collections.deque[Event]) -> list[Event]:
    """Empty a queue of events that another thread may be filling."""
    return [events.popleft() for _ in range(len(events))]


def payload_array(data: list[bytes], length: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return frames of one length as an array of shape (n, 8), zero-padded behind."""
    padded = np.zeros((len(data), 8), np.uint8)
    padded[:, :length] = np.frombuffer(b"".join(data), np.uint8).reshape(-1, length)
    return padded


class CanHub:
    """The reader of one bus; use `shared_hub`.

    `network` is a `canopen.Network` for SDO, NMT, heartbeat and EMCY, fed by the reader.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self.name = f'{config.interface} "{config.channel}"'
        self.bus = open_bus(config)
        self.network = canopen.Network(self.bus)
        self._queues: dict[int, list[FrameQueue]] = {}
        self._events: collections.deque[Event] = collections.deque()
        self._pending: dict[int, Frames] = {}
        self._sync, self._sync_time, self._counter = -1, 0.0, 0
        self._offset: float | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"CAN {self.name}", daemon=True)
        self._thread.start()

    def subscribe(self, identifier: int) -> FrameQueue:
        """Return a queue into which the frames of this identifier go from now on, block by block."""
        blocks: FrameQueue = queue.SimpleQueue()
        self._queues = {**self._queues, identifier: [*self._queues.get(identifier, []), blocks]}
        return blocks

    def unsubscribe(self, identifier: int, blocks: object) -> None:
        """Stop filling a queue."""
        left = [q for q in self._queues.get(identifier, []) if q is not blocks]
        others = {k: v for k, v in self._queues.items() if k != identifier}
        self._queues = {**others, identifier: left} if left else others

    def events(self) -> list[Event]:
        """Return what happened on the bus itself since the last call; `channel` is empty."""
        return drained(self._events)

    def close(self) -> None:
        """Stop the reader and close the bus."""
        self._stopping.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            self.bus.shutdown()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                message = self.bus.recv(BLOCK_SECONDS)
                end = time.monotonic() + BLOCK_SECONDS
                count = 0
                while message is not None:
                    self._take(message)
                    count += 1
                    left = end - time.monotonic()
                    if count == BLOCK_FRAMES or left <= 0:
                        break
                    message = self.bus.recv(left)
                self._publish()
        except Exception as problem:  # the reader must say why it ends: nobody else sees it
            self._publish()
            failure = EncoderConnectionError(f"The CAN bus {self.name} broke: {problem}.")
            for queues in self._queues.values():
                for blocks in queues:
                    blocks.put(failure)

    def _publish(self) -> None:
        pending, self._pending = self._pending, {}
        for identifier, frames in pending.items():
            for blocks in self._queues.get(identifier, ()):
                blocks.put(frames)

    def _take(self, message: can.Message) -> None:
        identifier = message.arbitration_id
        if self._offset is None:
            # Some interfaces count from power-up; a constant puts their stamps on the host's calendar.
            offset = time.time() - message.timestamp
            self._offset = offset if abs(offset) > 3600 else 0.0
        stamp = message.timestamp + self._offset
        if message.is_error_frame:
            self._events.append(Event(stamp, "", f"error frame on the CAN bus {self.name}"))
        elif message.is_remote_frame:
            pass
        elif identifier == SYNC_ID and not message.is_extended_id:
            self._on_sync(message.data, stamp)
        elif identifier in self._queues:
            frames = self._pending.get(identifier)
            if frames is None:
                frames = self._pending[identifier] = Frames()
            frames.sync.append(self._sync)
            frames.sync_time.append(self._sync_time)
            frames.time.append(stamp)
            frames.data.append(bytes(message.data))
        else:
            with contextlib.suppress(Exception):  # a malformed service frame must not end the recording
                self.network.notify(identifier, message.data, stamp)

    def _on_sync(self, data: bytearray, stamp: float) -> None:
        step = 1
        if len(data) == 1 and 1 <= data[0] <= SYNC_COUNTER_MAX:
            if self._counter:
                step = (data[0] - self._counter) % SYNC_COUNTER_MAX or SYNC_COUNTER_MAX
            self._counter = data[0]
        if step > 1:
            lost = step - 1
            self._events.append(Event(stamp, "", f"{lost} SYNC missing on the CAN bus {self.name} (counter {data[0]})"))
        self._sync += step
        self._sync_time = stamp


_hubs: dict[tuple[str, str], tuple[CanHub, list[int]]] = {}
_hubs_lock = threading.Lock()


def acquire_hub(config: BusConfig) -> CanHub:
    """Return the hub of this bus, opened for the first that asks; `release_hub` gives it back."""
    key = (config.interface, config.channel)
    with _hubs_lock:
        if key not in _hubs:
            _hubs[key] = (CanHub(config), [0])
        hub, users = _hubs[key]
        users[0] += 1
        return hub


def release_hub(hub: CanHub) -> None:
    """Give a hub back; the last one closes the bus."""
    key = (hub.config.interface, hub.config.channel)
    with _hubs_lock:
        _, users = _hubs[key]
        users[0] -= 1
        if users[0] == 0:
            del _hubs[key]
            hub.close()


class FrameReader:
    """The frames of one identifier as payloads, stamps and status: what CANopen and DBC channels have in common.

    Parameters
    ----------
    hub
        The bus.
    identifier
        11-bit identifier (29-bit ones are the same number here; no bench mixes them).
    length
        Bytes of the frame, at most 8; others are skipped with an event.
    sync_step
        The frame answers every `sync_step`-th SYNC and is stamped by it; None: stamped by itself.
    channel
        The channel's name, for events.
    """

    def __init__(self, hub: CanHub, identifier: int, length: int, sync_step: int | None, channel: str) -> None:
        self.hub, self.identifier, self.length, self.sync_step, self.channel = (
            hub, identifier, length, sync_step, channel,
        )  # fmt: skip
        self._blocks = hub.subscribe(identifier)
        self._events: collections.deque[Event] = collections.deque()
        self._last_seen, self._last_kept = -1, -1
        self._marks: collections.deque[int] = collections.deque()
        self._failure: EncoderConnectionError | None = None

    def close(self) -> None:
        """Take no more frames."""
        self.hub.unsubscribe(self.identifier, self._blocks)

    def say(self, time_host: float, text: str, status: int = 0) -> None:
        """Note an event, and status bits for the sample that comes next."""
        self._events.append(Event(time_host, self.channel, text))
        if status:
            self._marks.append(status)

    def events(self) -> list[Event]:
        """Return the events of channel and bus since the last call."""
        return self.hub.events() + drained(self._events)

    def read(self, timeout: float) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], FloatArray, IntArray] | None:
        """Return payloads (n, 8), stamps in seconds since 1970 (n,) and status bits (n,) of the frames that came.

        Raises
        ------
        EncoderConnectionError
            If the bus broke, once what came before is read.
        """
        frames = Frames()
        with contextlib.suppress(queue.Empty):
            wait = timeout
            while self._failure is None:
                block = self._blocks.get(timeout=wait) if wait > 0 else self._blocks.get_nowait()
                wait = 0.0
                if isinstance(block, Frames):
                    frames.extend(block)
                else:
                    self._failure = block
        if self._failure is not None and not frames.data:
            raise self._failure
        return self._judged(frames) if frames.data else None

    def _judged(self, frames: Frames) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], FloatArray, IntArray] | None:
        """Leave out frames that can't be trusted and mark what follows them."""
        stamps = np.array(frames.time if self.sync_step is None else frames.sync_time)
        good = np.array([len(d) == self.length for d in frames.data])
        if not good.all():
            wrong = frames.data[int(np.flatnonzero(~good)[0])]
            self._skipped(~good, frames, f"{len(wrong)} bytes long (0x{wrong.hex()}), not {self.length}")
        lost = ~good
        sync = np.array(frames.sync)
        if self.sync_step is not None:
            before = np.concatenate([[self._last_seen], sync[:-1]])
            self._last_seen = int(sync[-1])
            self._skipped(sync < 0, frames, "before the first SYNC")
            second = (sync >= 0) & (sync == before)
            self._skipped(second, frames, "without a SYNC of its own, so its instant is unknown")
            good &= (sync >= 0) & ~second
            lost = ~good & (sync >= 0)
        kept = np.flatnonzero(good)
        # A frame left out is a gap before the next one kept, be it in this block or, in the last place, a later one.
        marks = np.zeros(len(kept) + 1, np.int64)
        marks[np.searchsorted(kept, np.flatnonzero(lost))] |= GAP
        while self._marks:
            marks[0] |= self._marks.popleft()
        status, left_over = marks[:-1], int(marks[-1])
        if left_over:
            self._marks.append(left_over)
        if len(kept) == 0:
            return None
        if self.sync_step is not None:
            numbers = sync[kept]
            steps = np.diff(numbers, prepend=self._last_kept if self._last_kept >= 0 else numbers[0] - self.sync_step)
            self._last_kept = int(numbers[-1])
            gaps = np.flatnonzero(steps > self.sync_step)
            if len(gaps):
                status[gaps] |= GAP
                missing = int(np.sum(steps[gaps] // self.sync_step - 1))
                self.say(stamps[kept[gaps[0]]], f"{missing} SYNC without a sample, in {len(gaps)} gaps from here on")
        return payload_array([frames.data[i] for i in kept], self.length), stamps[kept], status

    def _skipped(self, which: np.ndarray[Any, np.dtype[np.bool_]], frames: Frames, why: str) -> None:
        """Say, once a block, that frames were left out."""
        if which.any():
            first = int(np.flatnonzero(which)[0])
            self.say(frames.time[first], f"{int(which.sum())} frame 0x{self.identifier:03X} skipped: {why}")
