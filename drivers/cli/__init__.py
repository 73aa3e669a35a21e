"""The command `cycloid-bench`; each module is a command."""

from __future__ import annotations

from typing import NoReturn

from cycloid_fmu.edge import commands

app = commands.command_line(
    "cycloid-bench",
    "Record encoders and torque of a gear test bench, real or simulated.",
    "drivers.cli",
    ["list", "simulate", "record", "run", "watch", "export", "repair"],
)


def main() -> NoReturn:
    """Run the command line."""
    commands.main(app)
