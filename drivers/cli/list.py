"""`cycloid-bench list`."""

from __future__ import annotations

import typer

import drivers


def list_() -> None:
    """List protocols, serial ports and CAN interfaces.

    Example: [cyan]cycloid-bench list[/]
    """
    found = drivers.list_connections()
    for title, names in (
        ("protocols", found.protocols),
        ("serial ports", found.serial_ports),
        ("CAN buses", found.can_buses),
    ):
        typer.echo(f"{title}: {', '.join(names) or 'none'}")
