"""`cycloid-bench list`."""

from __future__ import annotations

import typer

import drivers


def list_() -> None:
    """List protocols, serial ports and CAN interfaces.

    Example: [cyan]cycloid-bench list[/]
    """
    connections = drivers.list_connections()
    for title, names in (
        ("protocols", connections.protocols),
        ("serial ports", connections.serial_ports),
        ("CAN buses", connections.can_buses),
    ):
        typer.echo(f"{title}: {', '.join(names) or 'none'}")
