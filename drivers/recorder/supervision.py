"""Supervised encoders: a failed one is closed, reported, and reopened until it answers."""

from __future__ import annotations

import dataclasses
import threading

from cycloid_fmu import edge
from drivers.encoder import Encoder, EncoderConnectionError, EncoderError, steady_time
from drivers.recording_format import GAP, RESET, Channel, Event, Samples

RETRY_SECONDS = 0.5


class Supervised:
    """An encoder, open and started, that is reopened whenever it fails.

    Its first sample afterwards is marked "gap before" and, if it loses its zero when switched off, "reset".

    Parameters
    ----------
    encoder
        The encoder.
    """

    def __init__(self, encoder: Encoder) -> None:
        self.encoder = encoder
        self.channel = encoder.channel
        self.failure: EncoderError | None = None
        self._events: list[Event] = []
        self._mark = 0
        self._reported = ""
        self._stopping = threading.Event()
        self._reopened = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def waiting(self) -> int:
        """See `Encoder.waiting`."""
        return self.encoder.waiting

    def close(self) -> None:
        """Stop trying; the encoder itself is closed by its opener."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def read(self, timeout: float) -> Samples | None:
        """Return the new samples, None while the encoder has failed; see `Encoder.read`."""
        if self.failure is not None and not self._reopened.wait(timeout):
            return None
        if self.failure is not None:
            self._mark = GAP | (RESET if self.channel.zero_reference == "incremental" else 0)
            self.failure, self._thread = None, None
            self._reopened.clear()
        try:
            block = self.encoder.read(timeout)
        except EncoderError as problem:
            self.failure = problem
            if str(problem) != self._reported:  # one that opens but never delivers is reported once, not twice a second
                self._say(f"failed and will be reopened: {problem}")
            self._reported = str(problem)
            self._events += self.encoder.events()
            self._thread = threading.Thread(target=self._reopen, name=f"reopen {self.channel.name}", daemon=True)
            self._thread.start()
            return None
        if block is not None and len(block) and self._reported:
            self._say("samples arrive again")
            self._reported = ""
        if block is not None and len(block) and self._mark:
            status = block.status.copy()
            status[0] |= self._mark
            self._mark = 0
            block = dataclasses.replace(block, status=status)
        return block

    @property
    def lost(self) -> int:
        """See `Encoder.lost`."""
        return self.encoder.lost

    def drain(self) -> None:
        """See `Encoder.drain`; a failed encoder has nothing."""
        if self.failure is None:
            self.encoder.drain()

    def finish(self) -> None:
        """See `Encoder.finish`."""
        if self.failure is None:
            self.encoder.finish()

    def events(self) -> list[Event]:
        """Return the events of the encoder and its supervision; see `Encoder.events`."""
        events, self._events = self._events, []
        return events if self.failure is not None else events + self.encoder.events()

    def _say(self, text: str) -> None:
        self._events.append(Event(steady_time(), self.channel.name, text))

    def _reopen(self) -> None:
        """Try until it opens; runs in a separate thread, because opening may wait for answers."""
        self.encoder.close()
        last = ""
        while not self._stopping.wait(RETRY_SECONDS):
            try:
                self.encoder.__enter__()
                if _device(self.encoder.channel) != _device(self.channel):
                    raise EncoderConnectionError(
                        f"another device answers: {self.encoder.channel.identity}, not {self.channel.identity}"
                    )
                self.encoder.start()
            except (EncoderError, edge.InputError, OSError) as problem:
                self.encoder.close()
                if str(problem) != last and not last:
                    self._say(f"does not open yet: {problem}")
                last = str(problem)
            else:
                self._reopened.set()
                return


def _device(channel: Channel) -> Channel:
    """Return a channel without the state of its device, such as operating time, which changes during an outage."""
    return dataclasses.replace(channel, identity=channel.identity.partition(";")[0])
