"""Common base of all encoders on serial ports: a repeated request and its answers."""

from __future__ import annotations

import abc
import collections
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import serial

from drivers.counts import UnseenTurns, carried, counted
from drivers.encoder import EncoderConnectionError, EncoderProtocolError, EncoderTimeout
from drivers.hubs import BlockQueue, HubEncoder, drained, reason
from drivers.lines import PortConfig
from drivers.recording_format import CHECKSUM, GAP, RESET, Event, FloatArray, IntArray, Samples
from drivers.serial.port import Exchange, PortHub, ports


class SerialEncoder(HubEncoder[PortHub]):
    """Common base of all encoders on serial ports: a repeated request and its answers."""

    shared = ports
    line = PortConfig
    where: str
    asked = True  # False: the device sends without request

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
        """Open the port and query the device once; see `Encoder.__enter__`."""
        try:
            return super().__enter__()
        except (serial.SerialException, OSError) as problem:
            raise EncoderConnectionError(f"{self.where}: the port failed: {reason(problem, 'port')}.") from problem

    def start(self) -> None:
        """Start polling."""
        assert self.hub is not None, "start() is for an encoder that is open"
        if self._started:  # before the port failed: readings were missed meanwhile
            self._pending |= GAP
        self._started = True
        self._answers = BlockQueue()
        self.hub.poll(self.question, self.asked, self._answers)

    def leave(self, hub: PortHub) -> None:
        """Stop polling."""
        hub.stop_polling(self._answers)

    @property
    def waiting(self) -> int:
        """Number of answers received but not yet read."""
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
        """Return the received answers, waiting up to `timeout` s; losses of recorder and port become events."""
        exchanges: list[Exchange] = []
        for lost, block in self._answers.take(timeout):
            if lost:
                self.say(block[0].time, f"{counted(lost, 'reading')} lost: the recorder was too slow", GAP)
                self._lost += lost
            exchanges += block
        for exchange in exchanges:
            if exchange.note:
                self.say(exchange.time, exchange.note)
        return exchanges

    def say(self, time_host: float, text: str, status: int = 0) -> None:
        """Add an event, and status bits for the next sample."""
        self._events.append(Event(time_host, self.name, text))
        self._pending |= status

    def say_lost(
        self,
        what: str,
        times: Sequence[float] | FloatArray,
        causes: Mapping[str, npt.NDArray[np.bool_]],
        shown: Callable[[int], str],
    ) -> None:
        """Add an event for each cause of losses, with the number of those lost and what came in the place of the first.

        Parameters
        ----------
        what
            What is lost: "reading", "line".
        times
            Time of each, s, shape (n,).
        causes
            {cause: mask of those lost by it, shape (n,)}.
        shown
            Returns what came in the place of number k.
        """
        for cause, lost in causes.items():
            if lost.any():
                first = int(np.flatnonzero(lost)[0])
                self.say(times[first], f"{counted(int(lost.sum()), what)} lost: {cause}{shown(first)}")

    def marked(
        self, valid: npt.NDArray[np.intp], lost: npt.NDArray[np.bool_], wrong: npt.NDArray[np.bool_]
    ) -> IntArray:
        """Return the status bits of the valid readings, shape (k,): bits of a lost reading go to the next valid one.

        Parameters
        ----------
        valid
            Indices of the valid readings, shape (k,).
        lost, wrong
            Masks of the readings lost, and of those with a wrong checksum, shape (n,).
        """
        status, self._pending = carried(valid, GAP * (lost | wrong) | CHECKSUM * wrong, self._pending)
        return status

    def events(self) -> list[Event]:
        """Return the events of lost readings; see `Encoder.events`."""
        return drained(self._events)


class PolledEncoder(SerialEncoder):
    """An encoder that answers each request with a fixed number of bytes and a checksum.

    A missing answer, or one with a wrong checksum, is never used as an angle: the sample is left out, the next valid
    one is marked (gap before; checksum error), and an event reports the number.
    """

    answer_bytes: int
    checksum_name: ClassVar[str]

    @abc.abstractmethod
    def checked(self, answers: list[bytes]) -> npt.NDArray[np.bool_]:
        """Return the mask of answers with a correct checksum, shape (n,); all have the full length."""

    def asked_once(self, hub: PortHub) -> bytes:
        """Query the device once and return its answer.

        Raises
        ------
        EncoderTimeout, EncoderProtocolError
            If it does not answer, or its answer is invalid.
        """
        answer = hub.exchange(self.question, self.asked).answer
        if not answer:
            raise EncoderTimeout(f"{self.where} does not answer; is it powered, and are address and baud rate right?")
        if len(answer) < self.answer_bytes or not self.checked([answer]).all():
            raise EncoderProtocolError(f"{self.where} answers 0x{answer.hex()}, whose {self.checksum_name} wrong.")
        return answer

    def over_gaps(self, unseen: UnseenTurns, times: FloatArray, counts: IntArray, status: IntArray) -> IntArray:
        """Return the counts corrected by `unseen`; where turns may have been missed, mark gap and reset, with an event.

        Parameters
        ----------
        unseen
            The correction for rollovers missed in gaps.
        times, counts, status
            Times, s, counts and status bits of the readings, shape (k,); `status` is changed in place.
        """
        counts, turned = unseen(times, counts, status & GAP > 0)
        status |= turned * (GAP | RESET)
        for i in np.flatnonzero(turned):
            self.say(
                times[i], "it may have turned by half a range or more in a gap: extrapolated from the speed before"
            )
        return counts

    @abc.abstractmethod
    def samples(self, times: FloatArray, answers: list[bytes], status: IntArray) -> Samples:
        """Return the samples of valid answers.

        Parameters
        ----------
        times, answers, status
            Times, s since 1970, valid answers and status bits of the readings, k > 0 each.
        """

    def read(self, timeout: float) -> Samples | None:
        """Return the new positions; see `Encoder.read`."""
        times, answers, status = self.judged(self.taken(timeout))
        return self.samples(times, answers, status) if answers else None

    def judged(self, exchanges: list[Exchange]) -> tuple[FloatArray, list[bytes], IntArray]:
        """Return times, s, answers and status of the valid readings, k each, marked where others are left out."""
        times = np.array([e.time for e in exchanges])
        there = np.array([len(e.answer) == self.answer_bytes for e in exchanges], bool)
        late = there & np.array([e.late for e in exchanges], bool)
        right = np.zeros(len(exchanges), bool)
        if there.any():
            right[there] = self.checked([exchanges[i].answer for i in np.flatnonzero(there)])
        wrong = there & ~right
        causes = {
            "no answer": ~there,
            f"wrong {self.checksum_name.replace(' are', '')}": wrong,
            "it took too long, so its time is unknown": late & right,
        }
        answers = [exchange.answer for exchange in exchanges]
        self.say_lost("reading", times, causes, lambda k: f" (0x{answers[k].hex()})" if answers[k] else "")
        valid = np.flatnonzero(right & ~late)
        self._lost += len(exchanges) - len(valid)
        noted = np.array([bool(e.note) for e in exchanges], bool)
        status = self.marked(valid, ~there | late | noted, wrong)
        return times[valid], [answers[i] for i in valid], status
