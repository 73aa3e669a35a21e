"""Common base of the threads that read CAN buses, serial ports and other lines."""

from __future__ import annotations

import abc
import collections
import errno
import threading
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from drivers.encoder import Encoder, EncoderError
from drivers.lines import LineConfig

BLOCK_SECONDS = 0.05  # length of a block, and so the most that a kill loses besides the batch being written
WAITING_LIMIT = 1 << 20  # most readings that wait for the recorder; further ones are lost, counted and marked

Block = TypeVar("Block")


class BlockQueue(Generic[Block]):
    """A bounded queue of blocks from a reader thread to a channel; blocks lost to a slow consumer are counted."""

    def __init__(self) -> None:
        self._blocks: collections.deque[tuple[int, Block, int]] = collections.deque()
        self._filled = threading.Condition()
        self._lost = 0
        self._failure: EncoderError | None = None
        self.waiting = 0

    def put(self, block: Block, readings: int) -> None:
        """Append a block of readings, or count them as lost if `WAITING_LIMIT` are waiting."""
        with self._filled:
            if self.waiting + readings > WAITING_LIMIT:
                self._lost += readings
                return
            self._blocks.append((self._lost, block, readings))
            self._lost = 0
            self.waiting += readings
            self._filled.notify()

    def fail(self, problem: EncoderError) -> None:
        """End the queue: `take` raises `problem` once all earlier blocks are taken."""
        with self._filled:
            self._failure = problem
            self._filled.notify()

    def take(self, timeout: float) -> list[tuple[int, Block]]:
        """Return all waiting blocks, each with the number of readings lost before it.

        Parameters
        ----------
        timeout
            Time to wait for the first block, s.

        Raises
        ------
        EncoderError
            The problem given to `fail`, once all earlier blocks are taken.
        """
        with self._filled:
            if not self._blocks and self._failure is None and timeout > 0:
                self._filled.wait(timeout)
            if not self._blocks and self._failure is not None:
                raise self._failure
            taken = [(lost, block) for lost, block, _ in self._blocks]
            self._blocks.clear()
            self.waiting = 0
            return taken


def drained(queue: collections.deque[Block]) -> list[Block]:
    """Empty a queue, such as of events, that another thread may be filling."""
    return [queue.popleft() for _ in range(len(queue))]


def reason(problem: Exception, what: str) -> str:
    """Return the root cause of an error of a bus or port as a sentence; `what` is "interface" or "port"."""
    below = problem.__cause__ or problem.__context__
    while isinstance(below, OSError) and not (problem.__cause__ is None and problem.__suppress_context__):
        problem, below = below, below.__cause__ or below.__context__
    code = getattr(problem, "errno", None) or getattr(problem, "error_code", None)
    if code in (errno.ENODEV, errno.ENOENT):
        return f"there is no such {what}"
    if code in (errno.EACCES, errno.EPERM):
        return "permission denied"
    return str(problem).rstrip(".") or type(problem).__name__


class _Hub(Protocol):
    config: Any

    @property
    def broken(self) -> bool: ...

    def close(self) -> None: ...


Hub = TypeVar("Hub", bound=_Hub)


class SharedHubs(Generic[Hub]):
    """The hubs in use, one for each bus or port, shared by its channels.

    Parameters
    ----------
    opened
        Function that opens the hub of a bus or port, given its configuration.
    """

    def __init__(self, opened: Callable[[Any], Hub]) -> None:
        self._opened = opened
        self._users: dict[str, tuple[Hub, list[int]]] = {}
        self._lock = threading.Lock()

    def __contains__(self, config: Any) -> bool:
        return config.address in self._users

    def acquire(self, config: Any) -> Hub:
        """Return the hub of this bus or port, opened for its first user and again after a failure; see `release`."""
        with self._lock:
            if config.address in self._users and self._users[config.address][0].broken:
                self._users.pop(config.address)[0].close()
            if config.address not in self._users:
                self._users[config.address] = (self._opened(config), [0])
            hub, users = self._users[config.address]
            users[0] += 1
            return hub

    def release(self, hub: Hub) -> None:
        """Release a hub; its last user closes it."""
        with self._lock:
            current, users = self._users.get(hub.config.address, (None, [0]))
            if current is not hub:  # it broke, and `acquire` has closed it
                return
            users[0] -= 1
            if users[0] == 0:
                del self._users[hub.config.address]
                hub.close()


class HubEncoder(Encoder, Generic[Hub]):
    """An encoder on a shared bus or port: acquires and releases the hub; `shared` are the hubs of all such encoders."""

    shared: SharedHubs[Any]
    line: ClassVar[type[LineConfig]]
    hub: Hub | None = None

    @abc.abstractmethod
    def set_up(self, hub: Hub) -> None:
        """Query the device and set `channel`.

        Raises
        ------
        EncoderError
            If it does not answer, or its answer is invalid.
        """

    @abc.abstractmethod
    def leave(self, hub: Hub) -> None:
        """Undo `set_up` and `start`, as far as they were done."""

    def __enter__(self) -> Self:
        """Open the bus or port and set up the device; see `Encoder.__enter__`."""
        self.hub = self.shared.acquire(self.line_config)
        try:
            self.set_up(self.hub)
        except BaseException:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Leave the device and release the bus or port."""
        hub, self.hub = self.hub, None
        if hub is not None:
            self.leave(hub)
            self.shared.release(hub)
