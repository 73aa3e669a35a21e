"""A CAN bus between the processes of one machine, for the simulated bench: UDP multicast on the loopback interface.

A backend of python-can, interface "loopback", registered as an entry point of the group `can.interface`. python-can's
own "udp_multicast" joins the group on the default interface, so it reaches a network where the machine has one, and
cannot distinguish a bus's own frames from those of others.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time

import can

from drivers.can.drops import ANCILLARY, SocketDrops

_LOOPBACK, _PORT = "127.0.0.1", 43114
_HEAD = struct.Struct("<dIBB")  # the sender's stamp or 0, identifier, flags, DLC; then the data
_EXTENDED, _REMOTE, _ERROR, _FD, _BIT_RATE_SWITCH = 1, 2, 4, 8, 16
_MULTICAST_ALL = 49  # Linux; 0: only receive groups joined by this socket


class LoopbackBus(can.BusABC):  # type: ignore[misc]
    """A bus shared by all processes that open the same group; its frames never reach a network.

    It sends from its own port, so that its own frames, when received back, have `is_rx` False. `drops` counts the
    frames that were not read in time.

    Parameters
    ----------
    channel
        An IPv4 multicast group, such as "239.74.163.2".
    preserve_timestamps
        Whether sent frames keep the time stamps they are given, as from an interface with its own clock; otherwise the
        kernel stamps received frames.
    """

    def __init__(self, channel: str, preserve_timestamps: bool = False, **options: object) -> None:
        self._preserve = preserve_timestamps
        self._receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            group = socket.inet_aton(channel)
            for level, option, value in (
                (socket.SOL_SOCKET, socket.SO_REUSEADDR, 1),
                (socket.SOL_SOCKET, getattr(socket, "SO_REUSEPORT", socket.SO_REUSEADDR), 1),  # Windows has none
                (socket.IPPROTO_IP, _MULTICAST_ALL, 0),
            ):
                with contextlib.suppress(OSError):  # the last one is Linux only
                    self._receiver.setsockopt(level, option, value)
            self.drops = SocketDrops(self._receiver)
            self._receiver.bind(("", _PORT))
            loopback = socket.inet_aton(_LOOPBACK)
            self._receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + loopback)
            self._sender.bind((_LOOPBACK, 0))
            self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, loopback)
            self._sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        except OSError as problem:
            self._receiver.close()
            self._sender.close()
            raise can.CanInitializationError(
                f"the loopback interface carries IPv4 groups such as 239.74.163.2 only ({problem})"
            ) from None
        self._own, self._group = self._sender.getsockname(), (channel, _PORT)
        self.channel_info = f"loopback {channel}"
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel, **options)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame; python-can documents this method for backends to override."""
        if not select.select([self._receiver], [], [], timeout)[0]:
            return None, False
        data, ancillary, _, address = self._receiver.recvmsg(128, ANCILLARY)
        stamp, identifier, flags, dlc = _HEAD.unpack_from(data)
        came = self.drops.stamp(ancillary)
        message = can.Message(
            timestamp=stamp or came or time.time(),
            arbitration_id=identifier,
            is_extended_id=bool(flags & _EXTENDED),
            is_remote_frame=bool(flags & _REMOTE),
            is_error_frame=bool(flags & _ERROR),
            is_fd=bool(flags & _FD),
            bitrate_switch=bool(flags & _BIT_RATE_SWITCH),
            is_rx=address != self._own,
            dlc=dlc,
            data=data[_HEAD.size :],
        )
        return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to all processes on this bus."""
        flags = (
            msg.is_extended_id * _EXTENDED
            | msg.is_remote_frame * _REMOTE
            | msg.is_error_frame * _ERROR
            | msg.is_fd * _FD
            | msg.bitrate_switch * _BIT_RATE_SWITCH
        )
        try:
            stamp = msg.timestamp if self._preserve else 0.0
            self._sender.sendto(_HEAD.pack(stamp, msg.arbitration_id, flags, msg.dlc) + bytes(msg.data), self._group)
        except OSError as problem:
            raise can.CanOperationError(f"no frame can be sent: {problem.strerror}") from problem

    def fileno(self) -> int:
        """Return the file descriptor of the receiving socket."""
        return self._receiver.fileno()

    def shutdown(self) -> None:
        """Close the bus."""
        super().shutdown()
        self._receiver.close()
        self._sender.close()
