"""Encoders of the AMT21 family (Same Sky, CUI Devices) on RS-485: a byte asks, two bytes answer.

The answer is a 16-bit word, low byte first: check bits K1 K0 and 14 bits H5 … H0 L7 … L0 of position,
K1 = NOT(H5 ^ H3 ^ H1 ^ L7 ^ L5 ^ L3 ^ L1), K0 = NOT(H4 ^ H2 ^ H0 ^ L6 ^ L4 ^ L2 ^ L0) (AMT21 datasheet). So all odd
bits of a good word together have odd parity, and so have all even ones. A 12-bit encoder leaves the lowest two of the
14 bits zero. The address is a multiple of four; address + 1 asks for the turns, address + 2 opens extended commands.
"""

from __future__ import annotations

import collections
import contextlib
import queue
import threading
import time
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
import pydantic
import serial

from drivers.can_hub import drained
from drivers.encoder import (
    AngleConfig,
    Encoder,
    EncoderConnectionError,
    EncoderProtocolError,
    EncoderTimeout,
    PortConfig,
    Wiring,
    counts_to_value,
    role_of,
    unwrap,
)
from drivers.recording_format import CHECKSUM, GAP, ROLLOVER, Channel, Event, Samples

ANSWER_SECONDS = 0.1  # far above the encoder's microseconds: it covers a USB adapter and a busy machine
BLOCK_SECONDS = 0.05
_ODD, _EVEN = 0xAAAA, 0x5555


def check_bits(position: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return the words that carry these 14-bit positions, check bits included."""
    low = np.asarray(position, np.uint16) & np.uint16(0x3FFF)
    odd = 1 - np.bitwise_count(low & np.uint16(_ODD)) % 2
    even = 1 - np.bitwise_count(low & np.uint16(_EVEN)) % 2
    return np.asarray(low | odd.astype(np.uint16) << 15 | even.astype(np.uint16) << 14, np.uint16)


def checked_position(words: npt.NDArray[np.uint16]) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
    """Return the 14-bit positions of words as sent, and which of them the check bits confirm."""
    words = np.asarray(words, np.uint16)
    good = (np.bitwise_count(words & np.uint16(_ODD)) % 2 == 1) & (np.bitwise_count(words & np.uint16(_EVEN)) % 2 == 1)
    return words & np.uint16(0x3FFF), good


class Amt21Config(AngleConfig):
    """A `[channel.X]` with protocol = "amt21"."""

    port: str
    address: Annotated[int, pydantic.Field(ge=0, le=0xFC, multiple_of=4)] = 0x54
    bits: Literal[12, 14] = 14


Exchange = tuple[float, bytes]
ExchangeQueue = queue.SimpleQueue[list[Exchange] | EncoderConnectionError]


class PortHub:
    """The one thread that polls the encoders of a serial port in turn; use `acquire_port`."""

    def __init__(self, config: PortConfig) -> None:
        self.config = config
        try:
            self.port = serial.serial_for_url(
                config.url, baudrate=config.baud_rate, timeout=ANSWER_SECONDS, write_timeout=1.0
            )
        except (serial.SerialException, ValueError, OSError) as problem:
            raise EncoderConnectionError(f'The serial port "{config.url}" does not open: {problem}.') from problem
        self._lock = threading.Lock()
        self._queues: dict[int, ExchangeQueue] = {}
        self._stopping = threading.Event()
        self._polling = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port {config.url}", daemon=True)
        self._thread.start()

    def exchange(self, address: int) -> Exchange:
        """Ask once: return the middle of the exchange, in seconds since 1970, and the bytes of the answer."""
        with self._lock:
            if self.port.in_waiting:
                self.port.reset_input_buffer()  # what comes late must not be taken for the next answer
            before = time.time()
            self.port.write(bytes([address]))
            answer = bytes(self.port.read(2))
            return (before + time.time()) / 2, answer

    def poll(self, address: int, answers: ExchangeQueue) -> None:
        """Poll this address from now on."""
        self._queues = {**self._queues, address: answers}
        self._polling.set()

    def stop_polling(self, address: int) -> None:
        """Poll this address no more."""
        self._queues = {k: v for k, v in self._queues.items() if k != address}

    def close(self) -> None:
        """Stop polling and close the port."""
        self._stopping.set()
        self._polling.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            self.port.close()

    def _run(self) -> None:
        self._polling.wait()
        try:
            while not self._stopping.is_set():
                queues = self._queues
                blocks: dict[int, list[Exchange]] = {a: [] for a in queues}
                end = time.monotonic() + BLOCK_SECONDS
                while queues and time.monotonic() < end:
                    for address, block in blocks.items():
                        block.append(self.exchange(address))
                for address, block in blocks.items():
                    queues[address].put(block)
                if not queues:
                    self._stopping.wait(BLOCK_SECONDS)
        except Exception as problem:  # the poller must say why it ends: nobody else sees it
            failure = EncoderConnectionError(f'The serial port "{self.config.url}" broke: {problem}.')
            for answers in self._queues.values():
                answers.put(failure)


_ports: dict[str, tuple[PortHub, list[int]]] = {}
_ports_lock = threading.Lock()


def acquire_port(config: PortConfig) -> PortHub:
    """Return the hub of this port, opened for the first that asks; `release_port` gives it back."""
    with _ports_lock:
        if config.url not in _ports:
            _ports[config.url] = (PortHub(config), [0])
        hub, users = _ports[config.url]
        users[0] += 1
        return hub


def release_port(hub: PortHub) -> None:
    """Give a hub back; the last one closes the port."""
    with _ports_lock:
        _, users = _ports[hub.config.url]
        users[0] -= 1
        if users[0] == 0:
            del _ports[hub.config.url]
            hub.close()


class Amt21Encoder(Encoder):
    """One encoder at one address of a port.

    A word that fails its check bits, or an answer that does not come, is never an angle: the sample is left out, the
    next good one is marked (gap before; checksum failed) and an event says how many there were.

    Parameters
    ----------
    name
        Name of the channel.
    config
        Address, bits, direction, zero.
    port
        The port.
    """

    configuration = Amt21Config

    def __init__(self, name: str, config: Amt21Config, port: PortConfig) -> None:
        self.name, self.config, self.port = name, config, port
        self._hub: PortHub | None = None
        self._answers: ExchangeQueue = queue.SimpleQueue()
        self._events: collections.deque[Event] = collections.deque()
        self._previous: int | None = None
        self._pending = 0
        self._failure: EncoderConnectionError | None = None
        self._counts_per_turn = config.counts_per_turn or 1 << config.bits

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> Amt21Encoder:
        """Return the encoder of a `[channel.name]`; see `Encoder.from_config`."""
        return cls(name, config, wiring.port(config.port, name))

    def __enter__(self) -> Self:
        """Open the port and ask the encoder once; see `Encoder.__enter__`."""
        where = f'{self.name}: AMT21 at address 0x{self.config.address:02X} on "{self.port.url}"'
        self._hub = acquire_port(self.port)
        try:
            try:
                _, answer = self._hub.exchange(self.config.address)
            except (serial.SerialException, OSError) as problem:
                raise EncoderConnectionError(f"{where}: the port broke: {problem}.") from problem
            if not answer:
                raise EncoderTimeout(f"{where} does not answer; is it powered, and are address and baud rate right?")
            if len(answer) < 2 or not checked_position(np.frombuffer(answer, "<u2"))[1].all():
                raise EncoderProtocolError(f"{where} answers 0x{answer.hex()}, whose check bits are wrong.")
        except BaseException:
            self.close()
            raise
        self.channel = Channel(
            name=self.name,
            role=role_of(self.name),
            protocol="amt21",
            unit="rad",
            counts_per_turn=self._counts_per_turn,
            direction=self.config.direction,
            zero=self.config.zero,
            zero_reference=self.config.zero_reference,
            identity=f"AMT21, address 0x{self.config.address:02X}, {self.config.bits} bit",
            time_source="host clock: middle of the serial exchange",
        )
        return self

    def start(self) -> None:
        """Poll it from now on."""
        assert self._hub is not None, "start() is for an encoder that is open"
        self._hub.poll(self.config.address, self._answers)

    def close(self) -> None:
        """Poll it no more and release the port."""
        hub, self._hub = self._hub, None
        if hub is not None:
            hub.stop_polling(self.config.address)
            release_port(hub)

    def read(self, timeout: float) -> Samples | None:
        """Return the positions that came; see `Encoder.read`."""
        exchanges: list[Exchange] = []
        with contextlib.suppress(queue.Empty):
            wait = timeout
            while self._failure is None:
                block = self._answers.get(timeout=wait) if wait > 0 else self._answers.get_nowait()
                wait = 0.0
                if isinstance(block, list):
                    exchanges += block
                else:
                    self._failure = block
        if self._failure is not None and not exchanges:
            raise self._failure
        return self._judged(exchanges) if exchanges else None

    def _judged(self, exchanges: list[Exchange]) -> Samples | None:
        """Leave out what the check bits don't confirm and mark what follows it."""
        stamps = np.array([t for t, _ in exchanges])
        there = np.array([len(a) == 2 for _, a in exchanges])
        words = np.frombuffer(b"".join(a if len(a) == 2 else b"\0\0" for _, a in exchanges), "<u2")
        position, right = checked_position(words)
        good = there & right
        for which, what in ((~there, "no answer"), (there & ~right, "wrong check bits")):
            if which.any():
                first = int(np.flatnonzero(which)[0])
                said = f"{int(which.sum())} reading lost: {what}"
                if there[first]:
                    said += f" (0x{words[first]:04X})"
                self._events.append(Event(float(stamps[first]), self.name, said))
        kept = np.flatnonzero(good)
        marks = np.zeros(len(kept) + 1, np.int64)
        # bitwise_or.at, because several losses may come before the same sample
        np.bitwise_or.at(marks, np.searchsorted(kept, np.flatnonzero(~good)), GAP)
        np.bitwise_or.at(marks, np.searchsorted(kept, np.flatnonzero(there & ~right)), CHECKSUM)
        marks[0] |= self._pending
        self._pending = int(marks[-1])
        if len(kept) == 0:
            return None
        raw = position[kept].astype(np.int64) >> (14 - self.config.bits)
        counts, rolled = unwrap(raw, 1 << self.config.bits, self._previous, signed=True)
        self._previous = int(counts[-1])
        value = counts_to_value(counts, self._counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(self.name, stamps[kept], value, counts=counts, status=marks[:-1] | rolled * ROLLOVER)

    def events(self) -> list[Event]:
        """Return lost readings; see `Encoder.events`."""
        return drained(self._events)
