"""One thread for each serial port: it puts the channels' questions in turn and hands on the answers by the block."""

from __future__ import annotations

import abc
import collections
import contextlib
import errno
import os
import select
import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import serial

from cycloid_fmu import edge
from drivers.can_hub import BLOCK_SECONDS, drained
from drivers.encoder import (
    BlockQueue,
    Encoder,
    EncoderConnectionError,
    EncoderProtocolError,
    EncoderSetupError,
    EncoderTimeout,
    PortConfig,
    steady_time,
)
from drivers.recording_format import CHECKSUM, GAP, Event, FloatArray, IntArray, Samples

ANSWER_SECONDS = 0.1  # far above the encoders' microseconds: it covers a USB adapter and a busy machine

MIDDLE = "host clock: middle of the serial exchange"  # where an answer's stamp lies

Exchange = tuple[float, bytes]
Question = Callable[[Any], bytes]


def ask(port: Any, question: bytes, length: int) -> bytes:
    """Write a question and return the answer: `length` bytes, fewer where they do not come in time.

    A port of this machine's is written and read by its file descriptor, where the system has such: pyserial's own
    `write` and `read` wait for more and take longer than an encoder at 2 Mbaud.
    """
    if os.name != "posix" or type(port) is not serial.Serial:
        port.write(question)
        answer: bytes = port.read(length)
        return answer
    descriptor = port.fileno()
    if os.write(descriptor, question) < len(question):
        raise serial.SerialTimeoutException("it takes no more bytes")
    got = b""
    while len(got) < length and select.select([descriptor], [], [], port.timeout)[0]:
        part = os.read(descriptor, length - len(got))
        if not part:
            raise serial.SerialException("it is ready to read and has nothing, as one that was pulled")
        got += part
    return got


class PortHub:
    """The one thread that asks the devices on a serial port in turn; use `acquire_port`."""

    def __init__(self, config: PortConfig) -> None:
        self.config = config
        self.broken = False
        try:
            self.port = serial.serial_for_url(
                config.url,
                baudrate=config.baud_rate,
                parity=config.parity,
                stopbits=config.stop_bits,
                timeout=ANSWER_SECONDS,
                # pyserial's RFC 2217 client has its own and refuses any other.
                write_timeout=None if config.url.startswith("rfc2217:") else 1.0,
            )
        except (serial.SerialException, ValueError, OSError) as problem:
            raise EncoderSetupError(f'The serial port "{config.url}" does not open: {_reason(problem)}.') from problem
        self._lock = threading.Lock()
        self._queues: dict[BlockQueue[list[Exchange]], tuple[Question, bool]] = {}
        self._stopping = threading.Event()
        self._polling = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port {config.url}", daemon=True)
        self._thread.start()

    def exchange(self, question: Question, asked: bool) -> Exchange:
        """Ask once and return when, in seconds since 1970, and the bytes of the answer.

        The time is the middle of the exchange where the device is `asked`; that of the arrival where it only is waited
        for.
        """
        with self._lock:
            if asked:
                self._surplus()
            when, answer = self._exchange(question, asked)
            return when, answer + self._surplus() if asked and answer else answer

    def _exchange(self, question: Question, asked: bool) -> Exchange:
        before = steady_time()
        answer = question(self.port)
        after = steady_time()
        return (before + after) / 2 if asked else after, answer

    def _surplus(self) -> bytes:
        """Take bytes that nobody waits for off the line: they must not be taken for the next answer."""
        waiting = self.port.in_waiting
        return bytes(self.port.read(waiting)) if waiting else b""

    def poll(self, question: Question, asked: bool, answers: BlockQueue[list[Exchange]]) -> None:
        """Put this question again and again from now on; see `exchange`."""
        self._queues = {**self._queues, answers: (question, asked)}
        if self.broken:
            answers.fail(self._failure)
        self._polling.set()

    def stop_polling(self, answers: object) -> None:
        """Put the question with these answers no more."""
        self._queues = {k: v for k, v in self._queues.items() if k is not answers}

    def close(self) -> None:
        """Stop polling and close the port."""
        self._stopping.set()
        self._polling.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            self.port.close()

    def _put_back(self, newest: list[Exchange]) -> None:
        """Put bytes left over behind the newest answer: check bits pass one garbled answer in four, its length none."""
        if (surplus := self._surplus()) and newest and newest[-1][1]:
            when, answer = newest[-1]
            newest[-1] = when, answer + surplus

    def _run(self) -> None:
        self._polling.wait()
        blocks: dict[BlockQueue[list[Exchange]], list[Exchange]] = {}
        try:
            while not self._stopping.is_set():
                queues = self._queues
                blocks = {answers: [] for answers in queues}
                turns = [(question, asked, blocks[answers]) for answers, (question, asked) in queues.items()]
                end = time.monotonic() + BLOCK_SECONDS
                newest: list[Exchange] = []
                while queues and time.monotonic() < end:
                    for question, asked, block in turns:
                        with self._lock:
                            if asked:
                                self._put_back(newest)
                            block.append(self._exchange(question, asked))
                        newest = block if asked else []
                if newest:
                    with self._lock:
                        self._put_back(newest)
                for answers, block in blocks.items():
                    answers.put(block, len(block))
                if not queues:
                    self._stopping.wait(BLOCK_SECONDS)
        except Exception as problem:  # the poller must say why it ends: nobody else sees it
            self._failure = EncoderConnectionError(f'The serial port "{self.config.url}" broke: {_reason(problem)}.')
            self.broken = True
            for answers in self._queues:
                block = blocks.get(answers, [])
                answers.put(block, len(block))
                answers.fail(self._failure)


def _reason(problem: Exception) -> str:
    code = getattr(problem, "errno", None)
    if code == errno.ENOENT:
        return "there is no such port"
    if code in (errno.EACCES, errno.EPERM):
        return "permission denied"
    return str(problem).rstrip(".") or type(problem).__name__


_ports: dict[str, tuple[PortHub, list[int]]] = {}
_ports_lock = threading.Lock()


def acquire_port(config: PortConfig) -> PortHub:
    """Return the hub of this port, opened for the first that asks and anew where it broke; see `release_port`."""
    with _ports_lock:
        if config.url not in _ports or _ports[config.url][0].broken:
            if config.url in _ports:
                _ports.pop(config.url)[0].close()
            _ports[config.url] = (PortHub(config), [0])
        hub, users = _ports[config.url]
        users[0] += 1
        return hub


def release_port(hub: PortHub) -> None:
    """Give a hub back; the last one closes the port."""
    with _ports_lock:
        current, users = _ports.get(hub.config.url, (None, [0]))
        if current is not hub:  # it broke, and `acquire_port` has closed it since
            return
        users[0] -= 1
        if users[0] == 0:
            del _ports[hub.config.url]
            hub.close()


class SerialEncoder(Encoder):
    """What all encoders on serial ports share: one question, put again and again, and its answers.

    Parameters
    ----------
    name
        Name of the channel.
    config
        The channel's table in the `BENCH.toml`.
    port
        The port.
    """

    where: str
    asked = True  # False: the device sends by itself

    def __init__(self, name: str, config: Any, port: PortConfig) -> None:
        self.name, self.config, self.port = name, config, port
        self._hub: PortHub | None = None
        self._answers: BlockQueue[list[Exchange]] = BlockQueue()
        self._events: collections.deque[Event] = collections.deque()
        self._pending = 0

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Any) -> Self:
        """Return the encoder of a `[channel.name]`; see `Encoder.from_config`."""
        port = wiring.port(config.port, name)
        try:
            return cls(name, config, port)
        except edge.InputError as problem:
            raise edge.InputError(f"{wiring.source}: [channel.{name}] {problem}") from None

    @abc.abstractmethod
    def question(self, port: Any) -> bytes:
        """Put the question and return the answer; called by the port's thread, again and again."""

    @abc.abstractmethod
    def set_up(self, hub: PortHub) -> None:
        """Ask the device whether it is there and say in `channel` what it is.

        Raises
        ------
        EncoderError
            If it does not answer or answers nonsense.
        """

    def __enter__(self) -> Self:
        """Open the port and ask the device once; see `Encoder.__enter__`."""
        self._hub = acquire_port(self.port)
        try:
            try:
                self.set_up(self._hub)
            except (serial.SerialException, OSError) as problem:
                raise EncoderConnectionError(f"{self.where}: the port broke: {_reason(problem)}.") from problem
        except BaseException:
            self.close()
            raise
        return self

    def start(self) -> None:
        """Poll it from now on."""
        assert self._hub is not None, "start() is for an encoder that is open"
        self._answers = BlockQueue()
        self._hub.poll(self.question, self.asked, self._answers)

    def close(self) -> None:
        """Poll it no more and release the port."""
        hub, self._hub = self._hub, None
        if hub is not None:
            hub.stop_polling(self._answers)
            release_port(hub)

    @property
    def waiting(self) -> int:
        """Answers that came and are not yet read."""
        return self._answers.waiting

    def taken(self, timeout: float) -> list[Exchange]:
        """Return the answers that came; what the recorder was too slow for is an event and a gap."""
        exchanges: list[Exchange] = []
        for lost, block in self._answers.take(timeout):
            if lost:
                self.say(block[0][0], f"{lost} reading lost: the recorder was too slow", GAP)
            exchanges += block
        return exchanges

    def say(self, time_host: float, text: str, status: int = 0) -> None:
        """Note an event, and status bits for the sample that comes next."""
        self._events.append(Event(time_host, self.name, text))
        self._pending |= status

    def marked(self, kept: npt.NDArray[np.intp], lost: npt.NDArray[np.bool_], wrong: npt.NDArray[np.bool_]) -> IntArray:
        """Return the status of the readings kept: what was lost, or came wrong, stands before the next one kept.

        Parameters
        ----------
        kept
            Places of the readings kept, shape (k,).
        lost, wrong
            Which readings are missing, and which of them came with a wrong checksum, shape (n,).
        """
        marks = np.zeros(len(kept) + 1, np.int64)
        # bitwise_or.at, because several losses may come before the same sample
        np.bitwise_or.at(marks, np.searchsorted(kept, np.flatnonzero(lost)), GAP)
        np.bitwise_or.at(marks, np.searchsorted(kept, np.flatnonzero(wrong)), GAP | CHECKSUM)
        marks[0] |= self._pending
        self._pending = int(marks[-1])
        return marks[:-1]

    def events(self) -> list[Event]:
        """Return lost readings; see `Encoder.events`."""
        return drained(self._events)


class PolledEncoder(SerialEncoder):
    """An encoder that is asked and answers with a fixed number of bytes that carry a checksum.

    An answer whose checksum fails, or that does not come, is never an angle: the sample is left out, the next good one
    is marked (gap before; checksum failed) and an event says how many there were.
    """

    answer_bytes: int
    checksum_name: ClassVar[str]

    @abc.abstractmethod
    def checked(self, answers: list[bytes]) -> npt.NDArray[np.bool_]:
        """Return which of these answers, all of the full length, the checksum confirms, shape (n,)."""

    def asked_once(self, hub: PortHub) -> bytes:
        """Return one good answer.

        Raises
        ------
        EncoderTimeout, EncoderProtocolError
            If none comes, or a wrong one.
        """
        _, answer = hub.exchange(self.question, self.asked)
        if not answer:
            raise EncoderTimeout(f"{self.where} does not answer; is it powered, and are address and baud rate right?")
        if len(answer) < self.answer_bytes or not self.checked([answer]).all():
            raise EncoderProtocolError(f"{self.where} answers 0x{answer.hex()}, whose {self.checksum_name} wrong.")
        return answer

    @abc.abstractmethod
    def samples(self, times: FloatArray, answers: list[bytes], status: IntArray) -> Samples:
        """Return the samples of good answers, all arguments of shape (k,), k > 0."""

    def read(self, timeout: float) -> Samples | None:
        """Return the positions that came; see `Encoder.read`."""
        times, answers, status = self.judged(self.taken(timeout))
        return self.samples(times, answers, status) if answers else None

    def judged(self, exchanges: list[Exchange]) -> tuple[FloatArray, list[bytes], IntArray]:
        """Leave out what the checksum doesn't confirm and mark what follows it: times, answers, status, shape (k,)."""
        times = np.array([t for t, _ in exchanges])
        there = np.array([len(a) == self.answer_bytes for _, a in exchanges], bool)
        right = np.zeros(len(exchanges), bool)
        if there.any():
            right[there] = self.checked([exchanges[i][1] for i in np.flatnonzero(there)])
        for which, what in ((~there, "no answer"), (there & ~right, self.checksum_name.replace(" are", ""))):
            if which.any():
                first = int(np.flatnonzero(which)[0])
                shown = f" (0x{exchanges[first][1].hex()})" if exchanges[first][1] else ""
                wrong = "" if what == "no answer" else "wrong "
                self.say(times[first], f"{int(which.sum())} reading lost: {wrong}{what}{shown}")
        kept = np.flatnonzero(right)
        status = self.marked(kept, ~there, there & ~right)
        return times[kept], [exchanges[i][1] for i in kept], status
