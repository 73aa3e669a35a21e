"""Common part of all encoders on serial ports: a repeated request, and its answers."""

from __future__ import annotations

import abc
import collections
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import serial

from drivers.counts import UnseenTurns
from drivers.encoder import (
    EncoderConnectionError,
    EncoderProtocolError,
    EncoderTimeout,
    PortConfig,
)
from drivers.hubs import BlockQueue, HubEncoder, drained, reason
from drivers.recording_format import CHECKSUM, GAP, RESET, Event, FloatArray, IntArray, Samples
from drivers.serial.port import Exchange, PortHub, ports


class SerialEncoder(HubEncoder[PortHub]):
    """Common part of all encoders on serial ports: one repeated request, and its answers."""

    shared = ports
    line = "port"
    where: str
    asked = True  # False: the device sends by itself

    def __init__(self, name: str, config: Any, port: PortConfig) -> None:
        super().__init__(name, config, port)
        self._answers: BlockQueue[list[Exchange]] = BlockQueue()
        self._events: collections.deque[Event] = collections.deque()
        self._pending = 0
        self._lost = 0
        self._started = False

    @abc.abstractmethod
    def question(self, port: Any) -> bytes:
        """Send the request and return the answer; called repeatedly by the port's thread."""

    def __enter__(self) -> Self:
        """Open the port and ask the device once; see `Encoder.__enter__`."""
        try:
            return super().__enter__()
        except (serial.SerialException, OSError) as problem:
            raise EncoderConnectionError(f"{self.where}: the port broke: {reason(problem, 'port')}.") from problem

    def start(self) -> None:
        """Poll it from now on."""
        assert self.hub is not None, "start() is for an encoder that is open"
        if self._started:  # before: while the port was out, readings were missed
            self._pending |= GAP
        self._started = True
        self._answers = BlockQueue()
        self.hub.poll(self.question, self.asked, self._answers)

    def leave(self, hub: PortHub) -> None:
        """Stop polling it."""
        hub.stop_polling(self._answers)

    @property
    def waiting(self) -> int:
        """Received answers that are not yet read."""
        return self._answers.waiting

    def drain(self) -> None:
        """Let the port's thread read waiting data; see `Encoder.drain`."""
        if self.hub is not None:
            self.hub.drain()

    @property
    def lost(self) -> int:
        """Number of lost readings."""
        return self._lost

    def taken(self, timeout: float) -> list[Exchange]:
        """Return the received answers; those missed by the recorder or lost by the port are events."""
        exchanges: list[Exchange] = []
        for lost, block in self._answers.take(timeout):
            if lost:
                self.say(block[0].time, f"{lost} reading lost: the recorder was too slow", GAP)
                self._lost += lost
            exchanges += block
        for exchange in exchanges:
            if exchange.note:
                self.say(exchange.time, exchange.note)
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
        answer = hub.exchange(self.question, self.asked).answer
        if not answer:
            raise EncoderTimeout(f"{self.where} does not answer; is it powered, and are address and baud rate right?")
        if len(answer) < self.answer_bytes or not self.checked([answer]).all():
            raise EncoderProtocolError(f"{self.where} answers 0x{answer.hex()}, whose {self.checksum_name} wrong.")
        return answer

    def over_gaps(self, unseen: UnseenTurns, times: FloatArray, counts: IntArray, status: IntArray) -> IntArray:
        """Return counts as `unseen` gives them; where turns may have been unseen is an event, a gap and a reset.

        Parameters
        ----------
        times, counts, status
            Of the readings, shape (k,); `status` gets the marks.
        """
        counts, turned = unseen(times, counts, status & GAP > 0)
        status |= turned * (GAP | RESET)
        for i in np.flatnonzero(turned):
            self.say(times[i], "it may have turned unseen by half a range and more: counted on by the speed before")
        return counts

    @abc.abstractmethod
    def samples(self, times: FloatArray, answers: list[bytes], status: IntArray) -> Samples:
        """Return the samples of good answers, all arguments of shape (k,), k > 0."""

    def read(self, timeout: float) -> Samples | None:
        """Return the positions that came; see `Encoder.read`."""
        times, answers, status = self.judged(self.taken(timeout))
        return self.samples(times, answers, status) if answers else None

    def judged(self, exchanges: list[Exchange]) -> tuple[FloatArray, list[bytes], IntArray]:
        """Leave out what the checksum doesn't confirm and mark what follows it: times, answers, status, shape (k,)."""
        times = np.array([e.time for e in exchanges])
        there = np.array([len(e.answer) == self.answer_bytes for e in exchanges], bool)
        late = there & np.array([e.late for e in exchanges], bool)
        right = np.zeros(len(exchanges), bool)
        if there.any():
            right[there] = self.checked([exchanges[i].answer for i in np.flatnonzero(there)])
        wrong = there & ~right
        for which, what in (
            (~there, "no answer"),
            (wrong, f"wrong {self.checksum_name.replace(' are', '')}"),
            (late & right, "it took so long that its time is unknown"),
        ):
            if which.any():
                first = int(np.flatnonzero(which)[0])
                shown = f" (0x{exchanges[first].answer.hex()})" if exchanges[first].answer else ""
                self.say(times[first], f"{int(which.sum())} reading lost: {what}{shown}")
        kept = np.flatnonzero(right & ~late)
        self._lost += len(exchanges) - len(kept)
        noted = np.array([bool(e.note) for e in exchanges], bool)
        status = self.marked(kept, ~there | late | noted, wrong)
        return times[kept], [exchanges[i].answer for i in kept], status
