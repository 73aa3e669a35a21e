"""Linux's data on a socket's frames: time stamps, and the number of frames dropped because they were read too late.

The kernel attaches its count of dropped frames to the first frame after each gap (SO_RXQ_OVFL, used by can-utils'
candump: Documentation/networking/can.rst, socket(7)), which locates the loss; SO_MEMINFO has those dropped since.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Sequence

# asm-generic/socket.h; Python's socket module has none of them.
_TIMESTAMP_NS, _DROPS, _BUFFER_FORCE, _MEMORY_INFO = 35, 40, 33, 55
_MEMORY_DROPS = 8  # SK_MEMINFO_DROPS of linux/sock_diag.h
_STAMP, _COUNT, _MEMORY = struct.Struct("@ll"), struct.Struct("=I"), struct.Struct("=9I")
ANCILLARY = 128  # bytes, more than the ancillary data of a frame need
RECEIVE_BUFFER = 8 << 20  # bytes, for seconds of frames; the default holds 256 frames


class SocketDrops:
    """Time stamps and drops of a socket, on which it enables both and a receive buffer for seconds of frames.

    Attributes
    ----------
    known
        Whether this system reports drops.
    total
        Number of frames dropped before the last received one.
    """

    def __init__(self, line: socket.socket) -> None:
        self._socket, self.total, self.known = line, 0, False
        for option in (socket.SO_RCVBUF, _BUFFER_FORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,):
            with contextlib.suppress(OSError):  # exceeding the system's limit requires a privilege
                line.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        if sys.platform != "linux":
            return
        line.setsockopt(socket.SOL_SOCKET, _TIMESTAMP_NS, 1)
        with contextlib.suppress(OSError):
            line.setsockopt(socket.SOL_SOCKET, _DROPS, 1)
            self.known = True

    def stamp(self, ancillary: Sequence[tuple[int, int, bytes]]) -> float | None:
        """Return the time stamp in a frame's ancillary data, s since 1970, or None; update the count of drops."""
        stamp = None
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMP_NS:
                seconds, nanoseconds = _STAMP.unpack_from(data)
                stamp = seconds + nanoseconds * 1e-9
            elif level == socket.SOL_SOCKET and kind == _DROPS:
                self.total += (_COUNT.unpack_from(data)[0] - self.total) % (1 << 32)
        return stamp

    def since(self) -> int:
        """Return the number of frames dropped after the last received one."""
        if not self.known:
            return 0
        try:
            memory = self._socket.getsockopt(socket.SOL_SOCKET, _MEMORY_INFO, _MEMORY.size)
        except OSError:
            return 0
        return int(_MEMORY.unpack(memory)[_MEMORY_DROPS] - self.total) % (1 << 32)
