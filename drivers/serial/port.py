"""One thread per serial port, which sends the channels' requests in turn and passes on the answers in blocks."""

from __future__ import annotations

import contextlib
import struct
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import serial

from drivers.encoder import EncoderConnectionError, EncoderSetupError, steady_time
from drivers.hubs import BLOCK_SECONDS, BlockQueue, SharedHubs, reason
from drivers.lines import PortConfig, no_terminal

ANSWER_SECONDS = 0.1  # far above the encoders' microseconds, for USB adapters and busy machines

MIDDLE = "host clock: middle of the serial exchange"  # time stamp of an answer

_WRITE_SECONDS = 1.0  # longest time for writing a request
_FEW_BYTES, _FRESH = 256, 2  # after this many reads in a row that find at most so few bytes, none have waited long
_SILENT_ANSWERS = 2.5  # ANSWER_SECONDS that two requests without an answer may take
_DRAIN_SECONDS = 1.0  # most time for a device that sends without pause
_BUFFER_FULL = 4095  # bytes that Linux buffers for a terminal; more may be lost
_LINE_COUNTS = struct.Struct("=20i")  # serial_icounter_struct of linux/serial.h, filled by TIOCGICOUNT
_GET_LINE_COUNTS = 0x545D  # TIOCGICOUNT of asm-generic/ioctls.h
_LINE_ERRORS = {6: "framing errors", 7: "overruns", 8: "parity errors", 10: "buffer overruns"}


class Exchange(NamedTuple):
    """The answer to a request, or data sent by a device on its own: time, s since 1970, and bytes.

    `note` reports a fault of the port since the channel's last exchange: readings may be missing before this one.
    `late`: the bytes may have been delayed, so that `time` may be wrong.
    """

    time: float
    answer: bytes
    note: str = ""
    late: bool = False


Question = Callable[[Any], bytes]


def ask(port: Any, question: bytes, length: int) -> bytes:
    """Send a request and return the answer: `length` bytes, or fewer after the port's timeout."""
    begun = time.monotonic()
    try:
        port.write(question)
    except serial.SerialTimeoutException:
        # A blocked line times out on time; a later timeout only means that this process was stopped meanwhile.
        if time.monotonic() - begun < 1.25 * _WRITE_SECONDS:
            raise
    answer: bytes = port.read(length)
    return answer


def line_errors(port: Any) -> dict[str, int]:
    """Return the errors by kind that a port's driver has counted since it was loaded; {} if it counts none."""
    if sys.platform != "linux":
        return {}
    import fcntl

    try:
        counts = _LINE_COUNTS.unpack(fcntl.ioctl(port.fileno(), _GET_LINE_COUNTS, bytes(_LINE_COUNTS.size)))
    except (OSError, AttributeError, ValueError):  # a pseudo-terminal, a socket, a URL without a descriptor
        return {}
    return {what: counts[index] for index, what in _LINE_ERRORS.items()}


class PortHub:
    """The thread that polls the devices on a serial port in turn; see `ports`."""

    def __init__(self, config: PortConfig) -> None:
        self.config = config
        self.broken = False
        if refused := no_terminal(config.url):
            raise EncoderSetupError(f"The serial port {config.address} does not open: {refused}.")
        try:
            self.port = serial.serial_for_url(
                config.url,
                baudrate=config.baud_rate,
                parity=config.parity,
                stopbits=config.stop_bits,
                timeout=ANSWER_SECONDS,
                # pyserial's RFC 2217 client has its own timeout and accepts no other.
                write_timeout=None if config.url.startswith("rfc2217:") else _WRITE_SECONDS,
            )
        except (serial.SerialException, ValueError, OSError) as problem:
            raise EncoderSetupError(
                f"The serial port {config.address} does not open: {reason(problem, 'port')}."
            ) from problem
        self._lock = threading.Lock()
        self._queues: dict[BlockQueue[list[Exchange]], tuple[Question, bool]] = {}
        self._errors = line_errors(self.port)
        self._drain_from: float | None = None
        self._drained = threading.Event()
        self._stopping = threading.Event()
        self._polling = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port {config.url}", daemon=True)
        self._thread.start()

    def exchange(self, question: Question, asked: bool) -> Exchange:
        """Query a device once and return the time, s since 1970, and the bytes of the answer.

        If the device is `asked`, the time is the middle of the exchange, otherwise that of arrival.
        """
        with self._lock:
            if asked:
                self._surplus()
            done = self._exchange(question, asked, None)[0]
            return done._replace(answer=done.answer + self._surplus()) if asked and done.answer else done

    def _exchange(self, question: Question, asked: bool, ended: float | None) -> tuple[Exchange, float, float]:
        """Query once; return the exchange, the time for which this thread was stopped, s, or 0, and the end, s.

        `ended` is the end of the previous exchange. If an exchange takes half of `ANSWER_SECONDS`, its time is too
        uncertain.
        """
        before = steady_time()
        answer = question(self.port) if asked else bytes(self.port.read(1))
        came = steady_time()
        if not asked:
            answer += bytes(self.port.read(self.port.in_waiting))
        after = steady_time()
        apart, took, longest = before - (ended or before), after - before, ANSWER_SECONDS / 2
        if asked:
            late = took > longest and bool(answer)
            stood = apart if apart > longest else took if took > _SILENT_ANSWERS * ANSWER_SECONDS else 0.0
            return Exchange((before + after) / 2, answer, late=late), stood, after
        # Reading ends with the first byte, or after ANSWER_SECONDS without one.
        stood = apart + took if apart + took > 1.5 * ANSWER_SECONDS else 0.0
        late = bool(stood) or after - came > longest
        if apart + took > longest and not late:  # waiting for one line is usual, finding several at once is not
            late = answer.count(b"\n") > 1 or self.port.in_waiting > _FEW_BYTES
        return Exchange(after, answer, late=late), stood, after

    def _surplus(self) -> bytes:
        """Remove and return unexpected bytes on the line, so that they are not read as the next answer."""
        waiting = self.port.in_waiting
        return bytes(self.port.read(waiting)) if waiting else b""

    def poll(self, question: Question, asked: bool, answers: BlockQueue[list[Exchange]]) -> None:
        """Repeat this request and put its answers into a queue; see `exchange`."""
        self._queues = {**self._queues, answers: (question, asked)}
        if self.broken:
            answers.fail(self._failure)
        self._polling.set()

    def stop_polling(self, answers: object) -> None:
        """Stop repeating the request of this queue."""
        self._queues = {k: v for k, v in self._queues.items() if k is not answers}

    def close(self) -> None:
        """Stop polling and close the port."""
        self._stopping.set()
        self._polling.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            self.port.close()

    def _put_back(self, newest: list[Exchange]) -> None:
        """Append surplus bytes to the newest answer: its length then reveals it as garbled, check bits miss 1 in 4."""
        if (surplus := self._surplus()) and newest and newest[-1].answer:
            newest[-1] = newest[-1]._replace(answer=newest[-1].answer + surplus)

    def drain(self) -> None:
        """Wait until all data now on the port are in the queues."""
        if self._queues and not self.broken:
            self._drained.clear()
            self._drain_from = time.monotonic()
            self._drained.wait(10 * _DRAIN_SECONDS)

    def _is_drained(self) -> bool:
        """Return whether `drain` is waiting and no data are left on the port."""
        if (since := self._drain_from) is None:
            return False
        spontaneous = any(not asked for _, asked in self._queues.values())
        return not (spontaneous and self.port.in_waiting) or time.monotonic() - since > _DRAIN_SECONDS

    def _driver_note(self) -> str:
        """Return a text on the losses that the driver counted since the last call, or ""."""
        before, self._errors = self._errors, line_errors(self.port)
        more = {what: count - before.get(what, count) for what, count in self._errors.items()}
        text = ", ".join(f"{count} {what}" for what, count in more.items() if count > 0)
        return f"the port lost bytes: {text}" if text else ""

    def _run(self) -> None:
        self._polling.wait()
        blocks: dict[BlockQueue[list[Exchange]], list[Exchange]] = {}
        notes: dict[BlockQueue[list[Exchange]], str] = {}
        ended: float | None = None
        fresh = _FRESH
        try:
            while not self._stopping.is_set():
                queues = self._queues
                blocks = {answers: [] for answers in queues}
                begun = time.monotonic()
                newest: list[Exchange] = []
                while queues and time.monotonic() < begun + BLOCK_SECONDS and not self._is_drained():
                    heard: Exchange | None = None  # without request: for all channels that listen
                    for answers, (question, asked) in queues.items():
                        if heard is not None and not asked:
                            blocks[answers].append(heard._replace(note=notes.pop(answers, "")))
                            continue
                        with self._lock:
                            if asked:
                                self._put_back(newest)
                            else:
                                ready = self.port.in_waiting
                            done, stood, ended = self._exchange(question, asked, ended)
                            if not asked:  # more delayed bytes may follow: the driver passes them on in parts
                                fresh = 0 if done.late or (fresh < _FRESH and ready > _FEW_BYTES) else fresh + 1
                                done = done._replace(late=fresh < _FRESH)
                        if stood:
                            text = f"no reading for {stood:.3f} s: the recorder was delayed"
                            notes.update(dict.fromkeys(queues, text))
                        heard = heard if asked else done
                        block = blocks[answers]
                        block.append(done._replace(note=notes.pop(answers, "")))
                        if not asked and len(done.answer) >= _BUFFER_FULL:  # the loss is after the buffered bytes
                            text = "the port's buffer was full: bytes may be lost"
                            notes.update({a: text for a, (_, theirs) in queues.items() if not theirs})
                        newest = block if asked else []
                if newest:
                    with self._lock:
                        self._put_back(newest)
                for answers, block in blocks.items():
                    answers.put(block, len(block))
                if text := self._driver_note():
                    notes.update(dict.fromkeys(queues, text))
                if self._is_drained():
                    self._drain_from = None
                    self._drained.set()
                if not queues:
                    ended = None
                    self._stopping.wait(BLOCK_SECONDS)
        except Exception as problem:  # nobody else sees why this thread ends
            self._failure = EncoderConnectionError(
                f"The serial port {self.config.address} failed: {reason(problem, 'port')}."
            )
            self.broken = True
            self._drained.set()
            for answers in self._queues:
                block = blocks.get(answers, [])
                answers.put(block, len(block))
                answers.fail(self._failure)


ports = SharedHubs(PortHub)
"""The serial ports in use; `ports.acquire` and `ports.release` them."""
