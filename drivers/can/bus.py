"""Opening of CAN buses with python-can, and identifiers of frames."""

from __future__ import annotations

import can

from drivers.encoder import EncoderSetupError
from drivers.hubs import reason
from drivers.lines import SERIAL_BUSES, BusConfig, device_of, no_terminal

SYNC_ID = 0x80
_CLOCKS = {
    "socketcan": "kernel",
    "udp_multicast": "kernel",
    "loopback": "kernel",
    "pcan": "hardware",
    "kvaser": "hardware",
    "vector": "hardware",
    "ixxat": "hardware",
    "gs_usb": "hardware",
    "usb2can": "hardware",
    "canalystii": "hardware",
}


def frame_key(identifier: int, *, extended: bool = False, fd: bool = False) -> int:
    """Return the number that identifies frames by identifier and format; of a classical 11-bit frame the identifier."""
    return identifier | extended << 29 | fd << 30


def frame_name(key: int) -> str:
    """Return the name of frames in messages: "frame 0x182", "FD frame 0x18DA0102 (29 bits)"; `key`: `frame_key`."""
    name = f"frame 0x{key & 0x1FFFFFFF:03X}"
    return f"{'FD ' if key & 1 << 30 else ''}{name}{' (29 bits)' if key & 1 << 29 else ''}"


def time_source(config: BusConfig, what: str) -> str:
    """Return a channel's `time_source`: 'hardware clock: the CAN interface's stamp of the frame (…)'; `what`: frame."""
    clock = _CLOCKS.get(config.interface, "host")
    return f"{clock} clock: the CAN interface's stamp of the {what} ({config.address})"


def open_bus(config: BusConfig, **options: object) -> can.BusABC:
    """Open a bus with python-can; `options` go to its backend.

    Raises
    ------
    EncoderSetupError
        If the interface is unknown or does not open.
    """
    if config.interface in SERIAL_BUSES and (refused := no_terminal(device_of(config.channel))):
        raise EncoderSetupError(f"The CAN bus {config.address} does not open: {refused}.")
    for name in ("bitrate", "data_bitrate"):
        if getattr(config, name) is not None:
            options[name] = getattr(config, name)
    if config.fd:
        options["fd"] = True
    if config.sync_period is not None and config.interface != "udp_multicast":
        options["receive_own_messages"] = True  # SYNC is received back in order with the frames that answer it
    try:
        if config.interface == "socketcan":
            from drivers.can.socketcan import CountingSocketcanBus

            return CountingSocketcanBus(config.channel, **options)
        return can.Bus(interface=config.interface, channel=config.channel, **options)
    except Exception as problem:  # each backend of python-can raises its own
        raise EncoderSetupError(
            f"The CAN bus {config.address} does not open: {reason(problem, 'interface')}."
        ) from problem
