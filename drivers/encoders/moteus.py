"""Position, velocity and torque of a moteus controller, queried over CAN FD.

Frames as the public documentation of the multiplex protocol states them: a query reads four float32 registers from
0x001 on (position in turns, velocity in turns/s, torque in N*m, current of the q axis in A), and one reply has all
four. It has not been tried on a controller.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Annotated, ClassVar

import can
import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.can.bus import frame_key, time_source
from drivers.can.encoder import CanEncoder
from drivers.can.frames import FrameReader, payload_array
from drivers.can.hub import CanHub
from drivers.encoder import EncoderSetupError, EncoderTimeout, channel_of
from drivers.lines import BusConfig
from drivers.motor import UNITS, MotorConfig, check_role
from drivers.recording_format import GAP, Samples

_QUERY, _REPLY = b"\x1c\x04\x01", b"\x2c\x04\x01"  # read, and reply of, 4 float32 from register 0x001 on
_REPLY_BYTES = 20  # with one byte of padding to a length that CAN FD has
_ANSWER_SECONDS = 1.0
_SILENCE = 0.1  # s without a reply from which on the next one is marked
_REPLY_WANTED = 0x8000
_COLUMNS = {"position": 0, "velocity": 1, "torque": 2, "current": 3}


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


class _Queries:
    """The thread that queries a controller for all its channels."""

    shared: ClassVar[dict[tuple[CanHub, int], _Queries]] = {}
    lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, hub: CanHub, node: int, period: float) -> None:
        self.users, self._hub, self._node, self._period = 0, hub, node, period
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"moteus {node}", daemon=True)

    @classmethod
    def join(cls, hub: CanHub, node: int, period: float) -> None:
        """Query a controller from now on; see `leave`."""
        with cls.lock:
            queries = cls.shared.get((hub, node))
            if queries is None:
                queries = cls.shared[hub, node] = cls(hub, node, period)
                queries._thread.start()
            queries.users += 1

    @classmethod
    def leave(cls, hub: CanHub, node: int) -> None:
        """Stop querying with the last user."""
        with cls.lock:
            queries = cls.shared[hub, node]
            queries.users -= 1
            if queries.users:
                return
            del cls.shared[hub, node]
        queries._stopping.set()
        queries._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        with contextlib.suppress(can.CanError):  # the hub reports a bus that failed
            while not self._stopping.wait(max(0.0, due - time.monotonic())):
                query(self._hub, self._node)
                due = max(due + self._period, time.monotonic())


def query(hub: CanHub, node: int) -> None:
    """Ask a controller for its registers."""
    message = can.Message(
        arbitration_id=_REPLY_WANTED | node, is_extended_id=True, is_fd=True, bitrate_switch=True, data=_QUERY
    )
    hub.bus.send(message)


class MoteusServo(CanEncoder):
    """One quantity of one controller. All quantities of one reply have exactly the same time.

    Replies that are not as asked are left out with an event. A float32 of turns resolves 0.02 deg after 1,000 turns.
    """

    configuration = MoteusConfig

    def __init__(self, name: str, config: MoteusConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        check_role(name, config)
        if not bus.fd:
            raise edge.InputError(f'bus = "{config.bus}": a moteus speaks CAN FD; write fd = true in its table.')
        self._column = _COLUMNS["current" if config.torque_constant is not None else config.quantity]
        self._queried = False
        self._replied: float | None = None

    def set_up(self, hub: CanHub) -> None:
        """See `HubEncoder.set_up`."""
        node = self.config.node
        identifier = node << 8
        self.reader = FrameReader(
            hub, frame_key(identifier, extended=identifier > 0x7FF, fd=True), _REPLY_BYTES, None, self.name
        )
        deadline = time.monotonic() + _ANSWER_SECONDS
        while True:
            query(hub, node)
            block = self.reader.read(0.1)
            if block is not None and _replies(block.payloads).any():
                break
            if time.monotonic() > deadline:
                raise EncoderTimeout(f"{self.name}: moteus {node} on the CAN bus {self.bus.place} does not answer.")
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"moteus {node}: {self.config.identity}",
            time_source=time_source(self.bus, "reply"),
            unit=UNITS[self.config.quantity],
        )

    def start(self) -> None:
        """Query the controller from now on."""
        if self.hub is None:
            raise EncoderSetupError(f"{self.name}: it is not open.")
        _Queries.join(self.hub, self.config.node, self.config.period)
        self._queried = True

    def leave(self, hub: CanHub) -> None:
        """Stop querying and reading."""
        if self._queried:
            _Queries.leave(hub, self.config.node)
            self._queried = False
        super().leave(hub)

    def read(self, timeout: float) -> Samples | None:
        """Return the new values; see `Encoder.read`."""
        block = self.reader.read(timeout)
        if block is None:
            return None
        right = _replies(block.payloads)
        if not right.all():
            odd = int(np.count_nonzero(~right))
            self.reader.say(float(block.time_host[~right][0]), f"{odd} replies left out: not the registers asked for")
        if not right.any():
            return None
        registers = np.ascontiguousarray(block.payloads[right, len(_REPLY) : len(_REPLY) + 16]).view("<f4")
        stated = registers[:, self._column].astype(np.float64)
        if self.config.quantity != "torque":
            stated = 2.0 * math.pi * stated
        device, host = block.time_device, block.time_host[right]
        times = host if device is None else device[right]
        waited = np.diff(times, prepend=times[0] if self._replied is None else self._replied)
        self._replied = float(times[-1])
        silent = waited > max(_SILENCE, 5.0 * self.config.period)
        if silent.any():
            self.reader.say(float(host[silent][0]), f"no reply for {float(waited.max()):.3f} s")
        return Samples.checked(
            self.name,
            host,
            self.config.of_side(stated),
            time_device=None if device is None else device[right],
            status=block.status[right] | silent * GAP,
        )


def _replies(payloads: np.ndarray) -> np.ndarray:
    """Return the mask of frames that are replies with the registers asked for, shape (n,)."""
    return np.asarray((payloads[:, : len(_REPLY)] == payload_array([bytearray(_REPLY)], len(_REPLY))).all(axis=1))
