"""Connections that a bench file may open: buses, serial devices and TCP sockets; others only if allowed."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from cycloid_fmu import edge

if TYPE_CHECKING:
    from drivers.encoder import BusConfig, PortConfig

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


def check_lines(
    buses: Mapping[str, BusConfig], ports: Mapping[str, PortConfig], allow: Collection[str], source: str
) -> None:
    """Refuse connections that a bench file may not open.

    pyserial opens URLs with plug-ins, of which "spy" writes a file and "alt" loads a class; python-can has plug-ins
    too.

    Parameters
    ----------
    buses, ports
        Buses and ports of the file, by name.
    allow
        Additional URL schemes and python-can interfaces that may be opened, such as "rfc2217".
    source
        The file's name.

    Raises
    ------
    edge.InputError
        If one may not be opened; names file, table and value.
    """
    for name, port in ports.items():
        if not _may_open(port.url, allow):
            raise edge.InputError(
                f"{source}: [port.{name}] url = {edge.shown(port.url)}: {_PORTS}{_asked(_scheme(port.url))}."
            )
    for name, bus in buses.items():
        if bus.interface in BUSES or bus.interface in allow:
            continue
        where = f"{source}: [bus.{name}]"
        if bus.interface not in SERIAL_BUSES:
            raise edge.InputError(
                f"{where} interface = {edge.shown(bus.interface)}: a bench file may name one of "
                f"{', '.join(sorted(BUSES | SERIAL_BUSES))}{_asked(bus.interface)}."
            )
        if "://" in bus.channel or not _DEVICE.fullmatch(device_of(bus.channel)):
            raise edge.InputError(
                f"{where} channel = {edge.shown(bus.channel)}: the channel of {bus.interface} must be a serial device, "
                f"such as COM3 or /dev/ttyUSB0{_asked(bus.interface)}."
            )


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower() if "://" in url else ""


def _may_open(url: str, allow: Collection[str]) -> bool:
    if "://" in url:
        return bool(_SOCKET.fullmatch(url)) or _scheme(url) in allow
    return bool(_DEVICE.fullmatch(url))


def _asked(kind: str) -> str:
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
