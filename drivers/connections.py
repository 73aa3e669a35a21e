"""Available connections of this machine."""

from __future__ import annotations

import dataclasses

from drivers.encoder import protocols


@dataclasses.dataclass(frozen=True)
class Connections:
    """Names of the installed protocols, serial ports and CAN buses."""

    protocols: tuple[str, ...]
    serial_ports: tuple[str, ...]
    can_buses: tuple[str, ...]


def list_connections() -> Connections:
    """Return the installed protocols, and the serial ports and CAN buses of this machine.

    Examples
    --------
    >>> import drivers
    >>> drivers.list_connections().protocols
    ('amt21', 'ascii', 'canopen', 'dbc', 'modbus', 'moteus', 'odrive', 'simplefoc')
    """
    import can
    from serial.tools import list_ports

    buses = can.detect_available_configs(["socketcan", "udp_multicast"])
    return Connections(
        tuple(sorted(protocols())),
        tuple(f"{port.device} ({port.description})" for port in list_ports.comports()),
        tuple(f'{bus["interface"]} "{bus["channel"]}"' for bus in buses),
    )
