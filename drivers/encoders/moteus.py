"""Position, velocity and torque of a moteus controller, queried over CAN FD.

Frames as the public documentation of the multiplex protocol states them: a query reads four float32 registers from
0x001 on (position in turns, velocity in turns/s, torque in N*m, current of the q axis in A), and one reply has all
four. It has not been tried on a controller.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import threading
import time
from typing import Annotated, Any

import can
import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.can.bus import frame_key
from drivers.can.frames import FrameReader, Judged
from drivers.can.hub import CanHub
from drivers.can.motor import CanMotor
from drivers.counts import counted
from drivers.hubs import SharedHubs
from drivers.lines import BusConfig
from drivers.motor import MotorConfig
from drivers.recording_format import GAP, FloatArray, Samples

_QUERY, _REPLY = b"\x1c\x04\x01", b"\x2c\x04\x01"  # read, and reply of, 4 float32 from register 0x001 on
_REPLY_BYTES = 20  # with one byte of padding to a length that CAN FD has
_REPLY_WANTED = 0x8000
_COLUMNS = {"position": 0, "velocity": 1, "torque": 2, "current": 3}
_REMEMBERED, _LATEST = 1 << 14, 1.0  # queries, and seconds that a reply may take
_PAUSE = 0.1  # s without a query that are a gap


class MoteusConfig(MotorConfig):
    """A `[channel.X]` with protocol = "moteus".

    Attributes
    ----------
    bus, node
        Name of the bus's table, which has fd = true, and number of the controller (`id.id`).
    period
        Interval of the queries, s; the channels of a controller share those of the first one.
    """

    bus: str
    node: Annotated[int, pydantic.Field(ge=1, le=126)]
    period: Annotated[edge.Seconds, pydantic.Field(ge=1e-3, le=1.0)] = 5e-3


@dataclasses.dataclass(frozen=True)
class _Queried:
    """A controller on a bus and the interval of its queries, s, which its first channel states."""

    hub: CanHub
    node: int
    period: float

    @property
    def address(self) -> str:
        """What identifies the controller on this machine."""
        return f"{self.hub.config.address} {self.node}"


class _Queries:
    """The thread that queries a controller for all its channels.

    Queries are numbered. Those that it could not send in a pause of this process have numbers too: they are missing.
    """

    def __init__(self, config: _Queried) -> None:
        self.config, self._lock = config, threading.Lock()
        self._sent: collections.deque[tuple[float, int]] = collections.deque(maxlen=_REMEMBERED)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"moteus {config.node}", daemon=True)
        self._thread.start()

    @property
    def broken(self) -> bool:
        """Whether its bus has failed."""
        return self.config.hub.broken

    def close(self) -> None:
        """Stop querying."""
        self._stopping.set()
        self._thread.join()

    @property
    def newest(self) -> int:
        """Number of the newest query; -1 before the first."""
        with self._lock:
            return self._sent[-1][1] if self._sent else -1

    def asked(self, times: FloatArray) -> FloatArray:
        """Return the number of the newest query before each reply, received at times in s since 1970, shape (n,)."""
        oldest = float(times[0]) - _LATEST
        with self._lock:
            recent = list(itertools.takewhile(lambda query: query[0] > oldest, reversed(self._sent)))[::-1]
        sent, numbers = np.array([(-np.inf, -1), *recent]).T
        return np.asarray(numbers[np.searchsorted(sent, times, side="right") - 1])

    def _run(self) -> None:
        number, due, period = 0, time.monotonic(), self.config.period
        asked = due
        while not self._stopping.wait(max(0.0, due - time.monotonic())) and not self.broken:
            now = time.monotonic()
            if now - asked > max(_PAUSE, 5.0 * period):
                number += int((now - asked) / period) - 1
            with self._lock:
                self._sent.append((time.time(), number))
            with contextlib.suppress(can.CanError):  # no buffer is free, as nobody acknowledges; no reply will come
                query(self.config.hub, self.config.node)
            # Not at once after a late query, whose reply would count as that of the next.
            number, asked, due = number + 1, now, max(due + period, now + 0.25 * period)


_QUERIES = SharedHubs(_Queries)


def query(hub: CanHub, node: int) -> None:
    """Ask a controller for its registers."""
    message = can.Message(
        arbitration_id=_REPLY_WANTED | node, is_extended_id=True, is_fd=True, bitrate_switch=True, data=_QUERY
    )
    hub.bus.send(message)


class MoteusServo(CanMotor):
    """One quantity of one controller. All quantities of one reply have exactly the same time.

    Replies that are not as asked are left out with an event; they and queries without a reply are counted as lost. A
    float32 of turns resolves 0.02 deg after 1,000 turns.
    """

    configuration = MoteusConfig

    def __init__(self, name: str, config: MoteusConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        if not bus.fd:
            raise edge.InputError(f'bus = "{config.bus}": a moteus speaks CAN FD; write fd = true in its table.')
        self._queries: _Queries | None = None
        self._unanswered, self._lost_earlier = 0.0, 0

    def set_up(self, hub: CanHub) -> None:
        """Query the controller once; see `HubEncoder.set_up`."""
        node = self.config.node
        key = frame_key(node << 8, extended=node << 8 > 0x7FF, fd=True)
        reader = FrameReader(hub, key, _REPLY_BYTES, None, self.name)
        self.listen(reader, f"moteus {node}", "reply", lambda: query(hub, node))
        self._lost_earlier += int(self._unanswered)
        self._begun: float | None = None
        self._newest, self._replies, self._unanswered = 0.0, 0, 0.0

    def start(self) -> None:
        """Query the controller from now on."""
        super().start()
        assert self.hub is not None, "start() is for a controller that is open"
        self._queries = _QUERIES.acquire(_Queried(self.hub, self.config.node, self.config.period))

    def leave(self, hub: CanHub) -> None:
        """Stop querying and reading."""
        if self._queries is not None:
            _QUERIES.release(self._queries)
            self._queries = None
        super().leave(hub)

    @property
    def lost(self) -> int:
        """Number of queries without a reply as asked."""
        return self._lost_earlier + int(self._unanswered)

    def finish(self) -> None:
        """Report the queries without a reply after the last one; see `Encoder.finish`."""
        super().finish()
        if self._queries is not None and self._begun is not None:
            missing = self._queries.newest - int(self._newest) - 1  # the newest may still be answered
            if missing > 0:
                self._unanswered += missing
                self.reader.say(time.time(), f"{counted(missing, 'query')} without a reply after the last one")

    def _missing(self, asked: FloatArray) -> FloatArray:
        """Return how many queries before each reply have none, shape (n,); `asked`: the newest query before each."""
        begun = float(asked[0]) if self._begun is None else self._begun
        replies = self._replies + np.arange(1.0, len(asked) + 1.0)
        open_queries = asked - begun + 1 - replies
        if (surplus := float(open_queries.min())) < 0.0:  # the first reply was late, to an earlier query
            begun, open_queries = begun + surplus, open_queries - surplus
        # A late reply, after the next query, leaves more open for a moment; a lost one for good.
        for_good = np.minimum.accumulate(open_queries[::-1])[::-1]
        before = min(self._unanswered, float(for_good[0]))
        level = np.maximum.accumulate(np.maximum(for_good, before))
        self._begun, self._replies, self._unanswered = begun, int(replies[-1]), float(level[-1])
        self._newest = float(asked[-1])
        return np.diff(level, prepend=before)

    def valid(self, block: Judged) -> Any:
        """Return the mask of the replies with the registers asked for; see `CanMotor.valid`."""
        return (block.payloads[:, : len(_REPLY)] == np.frombuffer(_REPLY, np.uint8)).all(axis=1)

    def read(self, timeout: float) -> Samples | None:
        """Return the new values; see `Encoder.read`."""
        block = self.reader.read(timeout)
        if block is None:
            return None
        right = self.valid(block)
        if not right.all():
            wrong = int(np.count_nonzero(~right))
            self.reader.say(float(block.time_host[~right][0]), f"{wrong} replies left out: not the registers asked for")
        if self._queries is None:
            return None
        asked = self._queries.asked(block.time_host)
        right &= asked >= 0  # replies to queries of the set-up are no samples
        if not right.any():
            return None
        block, asked = block.at(right), asked[right]
        missing = self._missing(asked)
        if missing.any():
            first = float(block.time_host[np.flatnonzero(missing)[0]])
            self.reader.say(first, f"{counted(int(missing.sum()), 'query')} without a reply from here on")
        registers = np.ascontiguousarray(block.payloads[:, len(_REPLY) : len(_REPLY) + 16]).view("<f4")
        stated = registers[:, _COLUMNS[self.stated]].astype(np.float64)
        return self.samples(block, stated, block.status | (missing > 0) * GAP)
