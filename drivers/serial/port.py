"""One thread for each serial port: it puts the channels' questions in turn and hands on the answers by the block."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import serial

from drivers.encoder import (
    EncoderConnectionError,
    EncoderSetupError,
    PortConfig,
    steady_time,
)
from drivers.hubs import BLOCK_SECONDS, BlockQueue, SharedHubs, reason
from drivers.lines import no_terminal

ANSWER_SECONDS = 0.1  # far above the encoders' microseconds: it covers a USB adapter and a busy machine

MIDDLE = "host clock: middle of the serial exchange"  # where an answer's stamp is

Exchange = tuple[float, bytes]
Question = Callable[[Any], bytes]


def ask(port: Any, question: bytes, length: int) -> bytes:
    """Write a question and return the answer: `length` bytes, fewer where they do not come in time."""
    port.write(question)
    answer: bytes = port.read(length)
    return answer


class PortHub:
    """The one thread that asks the devices on a serial port in turn; see `ports`."""

    def __init__(self, config: PortConfig) -> None:
        self.config = config
        self.broken = False
        if refused := no_terminal(config.url):
            raise EncoderSetupError(f"The serial port {config.place} does not open: {refused}.")
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
            raise EncoderSetupError(
                f"The serial port {config.place} does not open: {reason(problem, 'port')}."
            ) from problem
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
            self._failure = EncoderConnectionError(
                f"The serial port {self.config.place} broke: {reason(problem, 'port')}."
            )
            self.broken = True
            for answers in self._queues:
                block = blocks.get(answers, [])
                answers.put(block, len(block))
                answers.fail(self._failure)


ports = SharedHubs(PortHub)
"""The serial ports in use; `ports.acquire` and `ports.release` them."""
