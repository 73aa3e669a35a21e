"""SocketCAN of python-can with the kernel's count of dropped frames, which python-can does not provide."""

from __future__ import annotations

import select
import socket
import struct
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus

from drivers.can.drops import ANCILLARY, SocketDrops

_HEAD = struct.Struct("=IBBxx")  # struct can_frame and canfd_frame of linux/can.h: identifier, length, flags
_FD_SIZE = 72
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_BIT_RATE_SWITCH, _ERROR_STATE = 1, 2


class CountingSocketcanBus(SocketcanBus):  # type: ignore[misc]
    """A SocketCAN interface that counts in `drops` the frames not read in time."""

    def __init__(self, channel: str, **options: Any) -> None:
        super().__init__(channel, **options)
        self.drops = SocketDrops(self.socket)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame; python-can documents this method for backends to override."""
        try:
            if not select.select([self.socket], [], [], timeout)[0]:
                return None, self._is_filtered
            frame, ancillary, flags, _ = self.socket.recvmsg(_FD_SIZE, ANCILLARY)
        except OSError as problem:
            raise can.CanOperationError(f"no frame can be read: {problem.strerror}", problem.errno) from problem
        identifier, length, kind = _HEAD.unpack_from(frame)
        extended, fd = bool(identifier & _EXTENDED), len(frame) == _FD_SIZE
        message = can.Message(
            timestamp=self.drops.stamp(ancillary) or 0.0,
            channel=self.channel,
            arbitration_id=identifier & (0x1FFFFFFF if extended or identifier & _ERROR else 0x7FF),
            is_extended_id=extended,
            is_remote_frame=bool(identifier & _REMOTE),
            is_error_frame=bool(identifier & _ERROR),
            is_fd=fd,
            bitrate_switch=fd and bool(kind & _BIT_RATE_SWITCH),
            error_state_indicator=fd and bool(kind & _ERROR_STATE),
            is_rx=not flags & socket.MSG_DONTROUTE,  # set on frames sent by this machine: can.rst, 4.1.7
            dlc=length,
            data=frame[_HEAD.size : _HEAD.size + length],
        )
        return message, self._is_filtered
