"""One thread per PLC, which reads the ring buffer of samples over ADS and passes on the new ones in blocks."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from typing import Any

import numpy as np

from cycloid_fmu import edge
from drivers.ads.ring import HEAD_BYTES, Block, Head, read_head, whole_samples
from drivers.ads.ring import spans as spans_of
from drivers.encoder import (
    EncoderConnectionError,
    EncoderProtocolError,
    EncoderSetupError,
    PlcConfig,
    steady_time,
)
from drivers.hubs import BLOCK_SECONDS, BlockQueue, SharedHubs

ADS_TCP_PORT = 48898
SYMBOL_INFORMATION = 0xF009  # index group of "symbol information by name"
SYMBOL_NOT_FOUND = 0x710
_READ_BYTES = 1 << 16  # most bytes per request
_ANSWER_SECONDS = 1.0  # far above a PLC cycle; pyads's 5 s would delay the detection of a broken connection


class PlcHub:
    """The thread that reads a PLC's ring buffer; see `plcs`."""

    def __init__(self, config: PlcConfig) -> None:
        self.config = config
        self.broken = False
        try:
            with edge.needs_extra("ads", lambda said: EncoderSetupError(f"PLC {config.place}: {said}.")):
                import pyads
        except EncoderSetupError:
            raise
        except Exception as problem:  # on Windows pyads looks for TwinCAT's library
            raise EncoderSetupError(
                f"The PLC {config.place} needs TwinCAT's ADS router on this machine ({problem})."
            ) from None
        self._ads = pyads
        self._lock, self._reading = threading.Lock(), threading.Lock()
        self._stopping, self._following = threading.Event(), threading.Event()
        self._queues: tuple[BlockQueue[Block], ...] = ()
        self._next: int | None = None
        self._arrived: tuple[float, float] | None = None
        self.connection = pyads.Connection(config.net_id, config.port, config.host)
        try:
            self.connection.open()
            self.connection.set_timeout(round(_ANSWER_SECONDS * 1000))
            self._group, self._offset, size = self._symbol()
            self.head = self._read_head()
            if self.head.ring_bytes > size:
                raise EncoderProtocolError(
                    f"{self._where}: it has {size} bytes, its head states {self.head.ring_bytes}."
                )
        except (pyads.ADSError, OSError, RuntimeError) as problem:
            self.connection.close()
            raise self._refused(problem) from problem
        except BaseException:
            self.connection.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"PLC {config.net_id}", daemon=True)
        self._thread.start()

    @property
    def _where(self) -> str:
        return f"The PLC {self.config.place}"

    def _refused(self, problem: Exception) -> EncoderSetupError:
        if getattr(problem, "err_code", None) == SYMBOL_NOT_FOUND:
            return EncoderSetupError(f'{self._where} has no variable "{self.config.ring}".')
        said = str(problem).removeprefix("ADSError: ").strip().rstrip(".")
        return EncoderSetupError(
            f"{self._where} does not answer ({said}); is it running, and does it have a route to this machine?"
        )

    def _symbol(self) -> tuple[int, int, int]:
        """Return index group, index offset and size, bytes, of the ring."""
        info = self.connection.read_write(
            SYMBOL_INFORMATION,
            0,
            self._ads.structs.SAdsSymbolEntry,
            self.config.ring,
            self._ads.PLCTYPE_STRING,
            check_length=False,
        )
        return int(info.iGroup), int(info.iOffs), int(info.size)

    def _bytes(self, offset: int, count: int) -> bytes:
        kind: Any = ctypes.c_ubyte * count
        return bytes(self.connection.read(self._group, self._offset + offset, kind, return_ctypes=True))

    def _read_head(self) -> Head:
        try:
            return read_head(self._bytes(0, HEAD_BYTES))
        except ValueError as problem:
            raise EncoderProtocolError(f"{self._where}: its variable is not a ring of samples: {problem}.") from None

    def follow(self, blocks: BlockQueue[Block], after: tuple[int, int] | None) -> None:
        """Pass all new samples to a queue, or all still in the ring after a sample, given its ring's start and number.

        Parameters
        ----------
        blocks
            The queue.
        after
            `Head.started` and number of the last known sample; None: only samples from now on.
        """
        with self._lock:
            if self.broken:
                blocks.fail(self._failure)
                return
            if after is not None:
                first = after[1] + 1 if after[0] == self.head.started else 1
                self._next = first if self._next is None else min(self._next, first)
            elif self._next is None:
                self._next = self.head.newest + 1
            self._queues = (*self._queues, blocks)
        self._following.set()

    def leave(self, blocks: object) -> None:
        """Stop passing samples to this queue."""
        with self._lock:
            self._queues = tuple(q for q in self._queues if q is not blocks)

    def close(self) -> None:
        """Stop reading and close the connection."""
        self._stopping.set()
        self._following.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            self.connection.close()

    def take(self) -> None:
        """Read the new samples and pass them on; the thread does so every `hubs.BLOCK_SECONDS`."""
        with self._reading:
            self._take()

    def _take(self) -> None:
        head = self._read_head()
        came = steady_time()
        if (head.columns, head.length) != (self.head.columns, self.head.length):
            raise EncoderProtocolError(f"{self._where}: its ring has changed.")
        with self._lock:
            if head.started != self.head.started:  # the PLC's program restarted, and with it the numbers
                self._next, self._arrived = 1, None
            elif head.newest < self.head.newest:
                raise EncoderProtocolError(
                    f"{self._where}: its newest number went back from {self.head.newest} to {head.newest}."
                )
            self.head = head
            assert self._next is not None, "follow() sets where to begin"
            first = max(self._next, head.newest - head.length + 1)
            self._next = head.newest + 1
            queues = self._queues
        parts, number = [], first
        for offset, count in spans_of(first, head.newest, head, _READ_BYTES):
            parts.append(whole_samples(self._bytes(offset, count), number, head.columns))
            number += count // head.sample_bytes
        samples: Any = np.concatenate(parts) if parts else ()
        if not len(samples):
            return
        # ns since the start are exact in a float for 104 days; ns since 2000 are not.
        device = (samples["time"] - np.uint64(head.started)).astype(np.int64) * 1e-9
        before, arrived = self._arrived or (0.0, 0.0)
        newest = float(device[-1])
        # The newest sample arrived now; earlier ones are placed between both arrivals by the PLC's clock.
        known = self._arrived is not None and newest > before and came > arrived
        rate = (came - arrived) / (newest - before) if known else 1.0
        self._arrived = newest, came
        block = Block(
            head.started, samples["number"].astype(np.int64), device, came - (newest - device) * rate, samples["values"]
        )
        for queue in queues:
            queue.put(block, len(samples))

    def _run(self) -> None:
        self._following.wait()
        try:
            while not self._stopping.wait(BLOCK_SECONDS):
                self.take()
        except Exception as problem:  # nobody else sees why this thread ends
            said = str(problem).removeprefix("ADSError: ").strip().rstrip(".")
            own = isinstance(problem, EncoderProtocolError)
            failure = EncoderConnectionError(str(problem) if own else f"{self._where} failed: {said}.")
            with self._lock:
                self._failure = failure
                self.broken = True
                queues = self._queues
            for queue in queues:
                queue.fail(failure)


plcs = SharedHubs(PlcHub)
"""The PLCs in use; `plcs.acquire` and `plcs.release` them."""
