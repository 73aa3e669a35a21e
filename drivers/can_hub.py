"""One reader for each CAN bus: data frames in blocks to the channels, everything else to CANopen's supervision.

A callback a frame costs more than the frame; so one thread takes what the bus has, sorts it by identifier, notes for
each data frame the SYNC that it answers, and hands it on by the block for NumPy to decode.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import errno
import logging
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import can
import canopen
import numpy as np
import numpy.typing as npt
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.bus import SO_TIMESTAMPNS, GeneralPurposeUdpMulticastBus

from drivers.encoder import (
    BlockQueue,
    BusConfig,
    EncoderConnectionError,
    EncoderSetupError,
    judge_sequence,
)
from drivers.recording_format import CLOCK_JUMP, DUPLICATE, GAP, OUT_OF_ORDER, Event, FloatArray, IntArray

logging.getLogger("canopen").addHandler(logging.NullHandler())  # what it warns of is raised or an event here

SYNC_ID = 0x80
SYNC_COUNTER_MAX = 240
BLOCK_SECONDS = 0.05  # of a block, and so of what a kill can cost besides the batch being written
BLOCK_FRAMES = 4096
_RECEIVE_BUFFER = 8 << 20
_IP_MULTICAST_ALL = 49  # Linux: only the groups this very socket joined
_BUS_OFF = 0x40  # of an error frame's identifier, as Linux and python-can number them
_LOOPBACK, _PORT = "127.0.0.1", 43113  # the port is python-can's
_CLOCKS = {
    "socketcan": "kernel", "udp_multicast": "kernel", "pcan": "hardware", "kvaser": "hardware", "vector": "hardware",
    "ixxat": "hardware", "gs_usb": "hardware", "usb2can": "hardware", "canalystii": "hardware",
}  # fmt: skip


def time_source(config: BusConfig, what: str) -> str:
    """Say for a recording whose clock stamps what: 'hardware clock: the CAN interface's stamp of the frame (…)'."""
    clock = _CLOCKS.get(config.interface, "host")
    return f'{clock} clock: the CAN interface\'s stamp of the {what} ({config.interface} "{config.channel}")'


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


def _joined(blocks: list[Frames]) -> Frames:
    """Return one identifier's blocks as one."""
    if len(blocks) == 1:
        return blocks[0]

    def column(name: str) -> Any:
        parts = [getattr(block, name) for block in blocks]
        return None if parts[0] is None else np.concatenate(parts)

    columns = {name: column(name) for name in ("sync", "sync_time", "time", "device", "sync_device")}
    return Frames(data=[payload for block in blocks for payload in block.data], arrived=blocks[-1].arrived, **columns)


class _LoopbackMulticast(GeneralPurposeUdpMulticastBus):  # type: ignore[misc]
    """UDP multicast that stays on this machine: joined and sent on the loopback interface, time to live 0.

    `sent_last` says whether the datagram received last was sent by this very bus.
    """

    def _create_socket(self, address_family: socket.AddressFamily) -> socket.socket:
        if address_family != socket.AF_INET:
            raise can.CanInitializationError("the loopback interface carries IPv4 groups such as 239.74.163.2 only")
        udp = socket.socket(address_family, socket.SOCK_DGRAM)
        try:
            for option in ("SO_REUSEADDR", "SO_REUSEPORT"):
                if hasattr(socket, option):  # Windows has no SO_REUSEPORT
                    udp.setsockopt(socket.SOL_SOCKET, getattr(socket, option), 1)
            with contextlib.suppress(OSError):  # only Linux has it
                udp.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                self.timestamp_nanosecond = True
            udp.bind(("", self.port))
            loopback = socket.inet_aton(_LOOPBACK)
            udp.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(self.group) + loopback)
            self._sender = socket.socket(address_family, socket.SOCK_DGRAM)
            self._sender.bind((_LOOPBACK, 0))
            self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, loopback)
            self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            self._address = self._sender.getsockname()
        except OSError as problem:
            udp.close()
            raise can.CanInitializationError(problem.strerror) from problem
        self.sent_last = False
        return udp

    def send(self, data: bytes, timeout: float | None = None) -> None:
        self._sender.settimeout(timeout)
        try:
            self._sender.sendto(data, self._send_destination)
        except TimeoutError:
            raise can.CanTimeoutError from None
        except OSError as problem:
            raise can.CanOperationError("failed to send via socket") from problem

    def recv(self, timeout: float | None = None) -> tuple[bytes, Any, float] | None:
        found: tuple[bytes, Any, float] | None = super().recv(timeout)
        self.sent_last = found is not None and found[1] == self._address
        return found

    def shutdown(self) -> None:
        self._sender.close()
        super().shutdown()


class LoopbackMulticastBus(UdpMulticastBus):  # type: ignore[misc]
    """python-can's udp_multicast, kept on this machine, and with its own frames told from others'.

    python-can's own joins the group on the default interface, so it reaches a network where the machine has one, and
    all send from one port, so what comes back of a bus's own frames looks like anybody's. This one sends from a port of
    its own: frames from there have `is_rx` False.

    Parameters
    ----------
    channel
        An IPv4 multicast group.
    fd
        Whether frames of CAN FD pass.
    """

    def __init__(self, channel: str, fd: bool = True, **options: Any) -> None:
        can.BusABC.__init__(self, channel, **options)  # python-can's own would open its socket, too
        self._multicast = _LoopbackMulticast(channel, _PORT, 0)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message, filtered = super()._recv_internal(timeout)
        if message is not None and self._multicast.sent_last:
            message.is_rx = False
        return message, filtered


def open_bus(config: BusConfig, **options: Any) -> can.BusABC:
    """Open a bus with python-can.

    A UDP bus stays on this machine unless `config.network` says otherwise; it gets a receive buffer for seconds of
    frames (the usual one holds 256) and only its own group's frames (else Linux hands it those of every group that
    anybody on the machine has joined).

    Raises
    ------
    EncoderSetupError
        If the interface is unknown or does not open.
    """
    for name in ("bitrate", "data_bitrate"):
        if getattr(config, name) is not None:
            options[name] = getattr(config, name)
    if config.fd:
        options["fd"] = True
    if config.sync_period is not None and config.interface != "udp_multicast":
        options["receive_own_messages"] = True  # SYNC comes back in its place among the frames that answer it
    try:
        if config.interface == "udp_multicast":
            cls = UdpMulticastBus if config.network else LoopbackMulticastBus
            options.pop("bitrate", None), options.pop("data_bitrate", None)
            bus: can.BusABC = cls(config.channel, **options)
            _tuned(bus._multicast._socket)
        else:
            bus = can.Bus(interface=config.interface, channel=config.channel, **options)
    except Exception as problem:  # each backend of python-can raises its own
        raise EncoderSetupError(
            f'The CAN bus {config.interface} "{config.channel}" does not open: {_reason(problem)}.'
        ) from problem
    return bus


def _reason(problem: Exception) -> str:
    """Return the sentence at the bottom of what python-can raised."""
    while isinstance(problem.__cause__ or problem.__context__, OSError):
        problem = problem.__cause__ or problem.__context__  # type: ignore[assignment]
    code = getattr(problem, "errno", None) or getattr(problem, "error_code", None)
    if code == errno.ENODEV:
        return "there is no such interface"
    if code in (errno.EACCES, errno.EPERM):
        return "permission denied"
    return str(problem).rstrip(".") or type(problem).__name__


def _tuned(udp: socket.socket) -> None:
    with contextlib.suppress(OSError):
        # Beyond net.core.rmem_max only with the right to; without it the kernel gives what it allows.
        udp.setsockopt(socket.SOL_SOCKET, getattr(socket, "SO_RCVBUFFORCE", 33), _RECEIVE_BUFFER)
    with contextlib.suppress(OSError):
        if udp.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < _RECEIVE_BUFFER:
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        udp.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)


def _receiver(bus: can.BusABC) -> Callable[[float], tuple[can.Message | None, bool]]:
    """Return what takes one message off a bus within so many seconds.

    `recv` asks the clock, our buses' filters, of which there are none, and the logging module about each frame, which
    is a fourth of its time on a fast bus; so what it asks itself is asked here, where a backend has no `recv` of its
    own.
    """
    if type(bus).recv is can.BusABC.recv and bus.filters is None:
        inner: Callable[[float], tuple[can.Message | None, bool]] = bus._recv_internal
        return inner
    return lambda timeout: (bus.recv(timeout), True)


def drained(events: collections.deque[Event]) -> list[Event]:
    """Empty a queue of events that another thread may be filling."""
    return [events.popleft() for _ in range(len(events))]


def payload_array(data: list[bytearray], length: int) -> npt.NDArray[np.uint8]:
    """Return frames of one length as an array of shape (n, length)."""
    return np.frombuffer(b"".join(data), np.uint8).reshape(-1, length)


class CanHub:
    """The reader of one bus; use `acquire_hub`.

    `network` is a `canopen.Network` for SDO, NMT, heartbeat and EMCY, fed by the reader.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self.name = f'{config.interface} "{config.channel}"'
        self.bus = open_bus(config)
        self.network = canopen.Network(self.bus)
        self.broken = False
        self._quantities: dict[int, set[str]] = {}
        self._queues: dict[int, list[BlockQueue[Frames]]] = {}
        self._wanted = frozenset({SYNC_ID})
        self._events: collections.deque[Event] = collections.deque()
        self._sync, self._sync_time, self._sync_device, self._counter = -1, 0.0, 0.0, 0
        self._own_clock: bool | None = None
        self._receive_one = _receiver(self.bus)
        self._odd = {"error frames": 0, "echoes of own frames": 0}
        self._stopping = threading.Event()
        self._producer: threading.Thread | None = None
        self._thread = threading.Thread(target=self._run, name=f"CAN {self.name}", daemon=True)
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
                f"The {quantity} of node {number} on the CAN bus {self.name} is taken by another channel."
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
            self._producer = threading.Thread(target=self._produce, name=f"SYNC {self.name}", daemon=True)
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
        self._failure = EncoderConnectionError(f"The CAN bus {self.name} broke: {_reason(problem)}.")
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
        receive, append, own_clock = self._receive_one, block.append, self._own_clock
        end = time.monotonic() + BLOCK_SECONDS
        for _ in range(BLOCK_FRAMES):
            message = receive(0.0)[0]
            if message is None:  # the clock is only asked where there is time for it
                message = receive(max(0.0, end - time.monotonic()))[0]
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
                    self._events.append(Event(time.time(), "", f"{count} {what} on the CAN bus {self.name}"))
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
            self._events.append(Event(stamp, "", f"{lost} SYNC missing on the CAN bus {self.name} (counter {data[0]})"))
        self._sync += step
        self._sync_time = stamp


_hubs: dict[tuple[str, str], tuple[CanHub, list[int]]] = {}
_hubs_lock = threading.Lock()


def acquire_hub(config: BusConfig) -> CanHub:
    """Return the hub of this bus, opened for the first that asks, anew where it broke; see `release_hub`."""
    key = (config.interface, config.channel)
    with _hubs_lock:
        if key not in _hubs or _hubs[key][0].broken:
            if key in _hubs:
                _hubs.pop(key)[0].close()
            _hubs[key] = (CanHub(config), [0])
        hub, users = _hubs[key]
        users[0] += 1
        return hub


def release_hub(hub: CanHub) -> None:
    """Give a hub back; the last one closes the bus."""
    key = (hub.config.interface, hub.config.channel)
    with _hubs_lock:
        current, users = _hubs.get(key, (None, [0]))
        if current is not hub:  # it broke, and `acquire_hub` has closed it since
            return
        users[0] -= 1
        if users[0] == 0:
            del _hubs[key]
            hub.close()


@dataclasses.dataclass(frozen=True)
class Judged:
    """Frames that can be trusted: payloads (n, length), times of host and device, status bits, shape (n,)."""

    payloads: npt.NDArray[np.uint8]
    time_host: FloatArray
    time_device: FloatArray | None
    status: IntArray


class FrameReader:
    """The frames of one identifier as payloads, stamps and status: what CANopen and DBC channels have in common.

    Parameters
    ----------
    hub
        The bus.
    identifier
        11-bit identifier (29-bit ones are the same number here; no bench mixes them).
    length
        Bytes of the frame; others are skipped with an event.
    sync_step
        The frame answers every `sync_step`-th SYNC and is stamped by it; None: stamped by itself.
    channel
        The channel's name, for events.
    period
        Seconds between frames that come by a timer, None where that is not known: a longer silence is a gap.
    """

    def __init__(
        self,
        hub: CanHub,
        identifier: int,
        length: int,
        sync_step: int | None,
        channel: str,
        period: float | None = None,
    ) -> None:
        self.hub, self.identifier, self.length, self.sync_step, self.channel, self.period = (
            hub, identifier, length, sync_step, channel, period,
        )  # fmt: skip
        self._blocks = hub.subscribe(identifier)
        self._events: collections.deque[Event] = collections.deque()
        self._last_seen = -1
        self._newest: int | None = None
        self._last: tuple[float, bytearray, float] | None = None
        self._marks: collections.deque[int] = collections.deque()

    def close(self) -> None:
        """Take no more frames."""
        self.hub.unsubscribe(self.identifier, self._blocks)

    @property
    def waiting(self) -> int:
        """Frames that came and are not yet read."""
        return self._blocks.waiting

    def say(self, time_host: float, text: str, status: int = 0) -> None:
        """Note an event, and status bits for the sample that comes next."""
        self._events.append(Event(time_host, self.channel, text))
        if status:
            self._marks.append(status)

    def events(self) -> list[Event]:
        """Return the events of channel and bus since the last call."""
        return self.hub.events() + drained(self._events)

    def read(self, timeout: float) -> Judged | None:
        """Return the frames that came.

        Raises
        ------
        EncoderConnectionError
            If the bus broke, once what came before is read.
        """
        losses: list[tuple[int, int]] = []
        blocks: list[Frames] = []
        place = 0
        for lost, block in self._blocks.take(timeout):
            if lost:
                losses.append((place, lost))
            blocks.append(block)
            place += len(block.data)
        return self._judged(_joined(blocks), losses) if blocks else None

    def _judged(self, frames: Frames, losses: list[tuple[int, int]]) -> Judged | None:
        """Leave out frames that can't be trusted and mark what follows them."""
        n = len(frames.data)
        stamps = frames.time if self.sync_step is None else frames.sync_time
        before = np.zeros(n, np.int64)  # bits for the sample at, or the next kept one after, each place
        for place, lost in losses:
            before[place] |= GAP
            self.say(frames.time[place], f"{lost} frame 0x{self.identifier:03X} lost: the recorder was too slow")
        good = np.fromiter(map(len, frames.data), np.int64, n) == self.length
        if not good.all():
            wrong = frames.data[int(np.flatnonzero(~good)[0])]
            self._skipped(~good, frames, f"{len(wrong)} bytes long (0x{wrong.hex()}), not {self.length}")
            before[~good] |= GAP
        if self.sync_step is None:
            self._clocked(frames, before)
        else:
            good &= self._synced(frames, before)
        kept = np.flatnonzero(good)
        # What stands before a frame left out holds for the next one kept, be it in this block or a later one.
        marks = np.zeros(len(kept) + 1, np.int64)
        noted = np.flatnonzero(before)
        np.bitwise_or.at(marks, np.searchsorted(kept, noted), before[noted])
        while self._marks:
            marks[0] |= self._marks.popleft()
        status, left_over = marks[:-1], int(marks[-1])
        if left_over:
            self._marks.append(left_over)
        if len(kept) == 0:
            return None
        if self.sync_step is not None:
            numbers = frames.sync[kept] // self.sync_step
            judged, missing, self._newest = judge_sequence(numbers, 1 << 62, self._newest)
            status |= judged
            if missing.any():
                gaps = np.flatnonzero(missing)
                self.say(
                    stamps[kept[gaps[0]]],
                    f"{int(missing.sum())} SYNC without a sample, in {len(gaps)} gaps from here on",
                )
        own = frames.device if self.sync_step is None else frames.sync_device
        device = None if own is None else own[kept]
        data = frames.data if len(kept) == n else [frames.data[i] for i in kept]
        return Judged(payload_array(data, self.length), stamps[kept], device, status)

    def _synced(self, frames: Frames, before: IntArray) -> npt.NDArray[np.bool_]:
        """Return which frames have a SYNC of their own, and note in `before` what the others were."""
        sync = frames.sync
        previous = np.concatenate([[self._last_seen], sync[:-1]])
        self._last_seen = int(sync[-1])
        self._skipped(sync < 0, frames, "before the first SYNC")
        second = (sync >= 0) & (sync == previous)
        last = None if self._last is None else self._last[1]
        same = np.zeros(len(sync), bool)
        for i in np.flatnonzero(second):  # few: payloads are compared only where it matters
            same[i] = frames.data[i] == (frames.data[i - 1] if i else last)
        self._last = (0.0, frames.data[-1], frames.arrived)
        self._skipped(second & same, frames, "a duplicate of the frame before, or without a SYNC of its own")
        self._skipped(second & ~same, frames, "without a SYNC of its own, so its instant is unknown")
        before[second] |= np.where(same, DUPLICATE, GAP)[second]
        return np.asarray((sync >= 0) & ~second)

    def _clocked(self, frames: Frames, before: IntArray) -> None:
        """Note in `before` what the stamps tell."""
        times = frames.time if frames.device is None else frames.device
        first = self._last is None
        last_time, last_data, arrived = self._last or (times[0], bytearray(), frames.arrived)
        step = np.diff(times, prepend=last_time)
        copies = np.zeros(len(times), bool)
        for i in np.flatnonzero(step == 0):
            copies[i] = frames.data[i] == (frames.data[i - 1] if i else last_data)
        copies[0] &= not first
        waited = np.zeros(len(times))
        waited[0] = frames.arrived - arrived
        jumps = np.abs(step - waited) > CLOCK_JUMP
        jumps[0] &= not first
        # A block that was waited for is not a jump of its first stamp, however late it arrived.
        jumps &= ~((step > 0) & (step < waited + CLOCK_JUMP))
        for i in np.flatnonzero(jumps):
            self.say(
                frames.time[i], f"the clock of frame 0x{self.identifier:03X} jumped by {step[i] - waited[i]:+.3f} s"
            )
        before[jumps] |= GAP
        early = (step < 0) & ~jumps
        before[early] |= OUT_OF_ORDER
        self._say_count(early, frames, "older than the one before")
        self._say_count(copies, frames, "a duplicate of the frame before")
        before[copies] |= DUPLICATE
        if self.period is not None:
            missing = np.where(jumps, 0, np.rint(step / self.period).astype(np.int64) - 1)
            gaps = (missing > 0) & (step > 1.5 * self.period)
            if gaps.any():
                where = int(np.flatnonzero(gaps)[0])
                self.say(
                    frames.time[where],
                    f"{int(missing[gaps].sum())} frame 0x{self.identifier:03X} missing by the event timer, "
                    f"in {int(gaps.sum())} gaps from here on",
                )
                before[gaps] |= GAP
        self._last = (float(times[-1]), frames.data[-1], frames.arrived)

    def _skipped(self, which: npt.NDArray[np.bool_], frames: Frames, why: str) -> None:
        """Say, once a block, that frames were left out."""
        self._say_count(which, frames, f"skipped: {why}")

    def _say_count(self, which: npt.NDArray[np.bool_], frames: Frames, what: str) -> None:
        if which.any():
            first = int(np.flatnonzero(which)[0])
            self.say(frames.time[first], f"{int(which.sum())} frame 0x{self.identifier:03X} {what}")
