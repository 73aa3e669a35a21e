"""Linux's data on a socket's frames: the time of each, and the number dropped because they were not read in time.

The kernel adds its count of dropped frames to the first frame after each gap (SO_RXQ_OVFL, as can-utils' candump
reads it: Documentation/networking/can.rst, socket(7)), which locates the loss; SO_MEMINFO gives those dropped since.
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
ANCILLARY = 128  # bytes that the messages beside a frame take, with room to spare
RECEIVE_BUFFER = 8 << 20  # seconds of frames; the usual one holds 256


class SocketDrops:
    """Stamps and drops of a socket, for which it requests them and a buffer for seconds of frames.

    Attributes
    ----------
    known
        Whether this system reports drops.
    total
        Frames dropped before the one that was received last.
    """

    def __init__(self, line: socket.socket) -> None:
        self._socket, self.total, self.known = line, 0, False
        for option in (socket.SO_RCVBUF, _BUFFER_FORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,):
            with contextlib.suppress(OSError):  # forcing it beyond the system's limit takes a right
                line.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        if sys.platform != "linux":
            return
        line.setsockopt(socket.SOL_SOCKET, _TIMESTAMP_NS, 1)
        with contextlib.suppress(OSError):
            line.setsockopt(socket.SOL_SOCKET, _DROPS, 1)
            self.known = True

    def stamp(self, ancillary: Sequence[tuple[int, int, bytes]]) -> float | None:
        """Read the ancillary data of a frame: return its stamp, s since 1970, if there is one, and count the drops."""
        found = None
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMP_NS:
                seconds, nanoseconds = _STAMP.unpack_from(data)
                found = seconds + nanoseconds * 1e-9
            elif level == socket.SOL_SOCKET and kind == _DROPS:
                self.total += (_COUNT.unpack_from(data)[0] - self.total) % (1 << 32)
        return found

    def since(self) -> int:
        """Return the number dropped after the last received frame."""
        if not self.known:
            return 0
        try:
            memory = self._socket.getsockopt(socket.SOL_SOCKET, _MEMORY_INFO, _MEMORY.size)
        except OSError:
            return 0
        return int(_MEMORY.unpack(memory)[_MEMORY_DROPS] - self.total) % (1 << 32)
