"""`cycloid-bench record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import drivers
from cycloid_fmu.edge.commands import output_option, quantity_option
from drivers.cli.shown import Allowed, LiveLine, recording, report


def record(
    bench: Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The wiring: buses, ports and channels.")],
    output: Annotated[Path, output_option((".arrows",), "RUN.arrows", "New file to record to.")],
    duration: Annotated[float | None, quantity_option("s", "Stop after this time.")] = None,
    idle: Annotated[float | None, quantity_option("s", "Stop after this time of silence.")] = None,
    allow: Allowed = None,
) -> None:
    """Record all channels of a bench until Ctrl-C, the duration or silence.

    Example: [cyan]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/]

    Samples are in the file after a twentieth of a second, safe from a kill of the process; the file is synced to disk
    every second, safe from a power cut. Buses and ports that fail are opened again.

    Exit status: 0 the duration is over, 3 nothing came for the idle time, 130 Ctrl-C, 143 SIGTERM, 129 SIGHUP (a lost
    connection): in each case the file is complete and a summary states its content and losses.
    """
    with recording(), LiveLine() as progress:
        done = drivers.record(bench, output, duration=duration, idle=idle, progress=progress, allow=allow or ())
    report(done)
