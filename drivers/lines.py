"""Lines that connect encoders to this machine: their tables in a bench file, and which of them it may open."""

from __future__ import annotations

import abc
import os
import re
from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

import pydantic

from cycloid_fmu import edge

# Interfaces of python-can whose channel can only name a piece of hardware or a multicast group.
BUSES = frozenset(
    {
        "canalystii",
        "cantact",
        "etas",
        "gs_usb",
        "iscan",
        "ixxat",
        "kvaser",
        "loopback",
        "neousys",
        "neovi",
        "nican",
        "nixnet",
        "pcan",
        "socketcan",
        "systec",
        "udp_multicast",
        "usb2can",
        "vector",
        "virtual",
    }
)
# Interfaces on a serial port: pyserial opens whatever their channel names.
SERIAL_BUSES = frozenset({"robotell", "seeedstudio", "serial", "slcan"})
_DEVICE = re.compile(r"(\\\\\.\\)?[A-Z]{3,5}\d{1,3}|/[^\0-\x1f]+")
_SOCKET = re.compile(r"socket://[\w.:\[\]-]+:\d{1,5}/?")
_TERMINAL = re.compile(r"/dev/(pts/\d+|rfcomm\d+|(gsm)?tty[A-Za-z]\w*|gsmtty\d+|(tty|cu)\.[^/]+|cua\w+)")
_PORTS = "a bench file may name a serial device, such as COM3 or /dev/ttyUSB0, or socket://HOST:PORT"


class LineConfig(edge.Config, abc.ABC):
    """A line shared by channels, such as a bus: a table `[kind.NAME]`, which channels name by the key `kind`.

    Attributes
    ----------
    kind
        Name of the table and of the channels' key, such as "bus".
    noun
        What the line is, for messages, such as "CAN bus".

    Examples
    --------
    >>> from drivers.lines import PortConfig
    >>> port = PortConfig(url="/dev/ttyUSB0")
    >>> port.kind, port.noun, port.address
    ('port', 'serial port', '"/dev/ttyUSB0"')
    """

    kind: ClassVar[str]
    noun: ClassVar[str]

    @property
    @abc.abstractmethod
    def address(self) -> str:
        """What identifies the line on this machine, for messages; lines with the same address are the same line."""

    @property
    def is_private(self) -> bool:
        """Whether the line belongs to one process, so that recordings of others cannot disturb it."""
        return False

    def refusal(self, allow: Collection[str]) -> str:
        """Return why a bench file may not open this line, as "key = value: reason"; "" if it may.

        Parameters
        ----------
        allow
            Kinds of connections that the user allows in addition, such as "rfc2217".
        """
        return ""


class BusConfig(LineConfig):
    """A CAN bus, opened by python-can.

    Attributes
    ----------
    interface
        Interface name of python-can: "socketcan", "slcan", "pcan", "kvaser", "vector", "gs_usb", "virtual",
        "udp_multicast" and others; "loopback" is the interface of the simulated bench.
    channel
        Channel of the interface, such as "can0".
    bitrate
        Bit rate, bit/s; None: the interface's default.
    fd, data_bitrate
        Whether the bus is CAN FD, and the bit rate of its data phase, bit/s.
    sync_period
        Interval of the SYNC frames that the recorder sends, s; None: it sends none.
    """

    kind = "bus"
    noun = "CAN bus"

    interface: str
    channel: str
    bitrate: Annotated[int, pydantic.Field(gt=0)] | None = None
    fd: bool = False
    data_bitrate: Annotated[int, pydantic.Field(gt=0)] | None = None
    sync_period: Annotated[edge.Seconds, pydantic.Field(gt=0)] | None = None

    @property
    def address(self) -> str:
        """Interface and channel, which identify the bus, for messages."""
        return f'{self.interface} "{self.channel}"'

    @property
    def is_private(self) -> bool:
        """See `LineConfig.is_private`."""
        return self.interface == "virtual"

    def refusal(self, allow: Collection[str]) -> str:
        """See `LineConfig.refusal`: python-can loads plug-ins, and some of its interfaces open any URL of pyserial."""
        if self.interface in BUSES or self.interface in allow:
            return ""
        if self.interface not in SERIAL_BUSES:
            return (
                f"interface = {edge.shown(self.interface)}: a bench file may name one of "
                f"{', '.join(sorted(BUSES | SERIAL_BUSES))}{_permission(self.interface)}"
            )
        if "://" in self.channel or not _DEVICE.fullmatch(device_of(self.channel)):
            return (
                f"channel = {edge.shown(self.channel)}: the channel of {self.interface} must be a serial device, "
                f"such as COM3 or /dev/ttyUSB0{_permission(self.interface)}"
            )
        return ""


class PortConfig(LineConfig):
    """A serial port with 8 data bits, opened by pyserial.

    Attributes
    ----------
    url
        A device such as "/dev/ttyUSB0", or a URL such as "socket://host:5000".
    baud_rate
        Bit rate, bit/s.
    parity
        "N" none, "E" even, "O" odd.
    stop_bits
        Number of stop bits.
    """

    kind = "port"
    noun = "serial port"

    url: str
    baud_rate: Annotated[int, pydantic.Field(gt=0)] = 2_000_000
    parity: Literal["N", "E", "O"] = "N"
    stop_bits: Literal[1, 2] = 1

    @property
    def address(self) -> str:
        """The URL in quotes, which identifies the port, for messages."""
        return f'"{self.url}"'

    def refusal(self, allow: Collection[str]) -> str:
        """See `LineConfig.refusal`: pyserial's URL "spy" writes a file and "alt" loads a class."""
        if _may_open(self.url, allow):
            return ""
        return f"url = {edge.shown(self.url)}: {_PORTS}{_permission(_scheme(self.url))}"


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower() if "://" in url else ""


def _may_open(url: str, allow: Collection[str]) -> bool:
    if "://" in url:
        return bool(_SOCKET.fullmatch(url)) or _scheme(url) in allow
    return bool(_DEVICE.fullmatch(url))


def _permission(kind: str) -> str:
    return f'; if you trust the file, allow "{kind}" when recording' if re.fullmatch(r"\w+", kind) else ""


def device_of(channel: str) -> str:
    """Return the serial device of a serial bus, without the bit rate that may follow it ("/dev/ttyACM0@115200")."""
    return channel.rpartition("@")[0] or channel


def no_terminal(device: str) -> str:
    """Return why a device is no serial port, or "" if it may be one: opening other devices can have side effects."""
    real = os.path.realpath(device)
    if "://" in device or os.name == "nt" or not os.path.exists(real) or _TERMINAL.fullmatch(real):
        return ""
    return f"{real} is not a serial port"
