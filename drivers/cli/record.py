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
    duration: Annotated[float | None, quantity_option("s", "Stop after this time.", metavar='"60 s"')] = None,
    idle: Annotated[
        float | None, quantity_option("s", "Stop after this time without samples.", metavar='"2 s"')
    ] = None,
    allow: Allowed = None,
) -> None:
    """Record all channels of a bench until Ctrl-C, or until the duration or the idle time is over.

    Example: [cyan]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/]

    Samples are in the file within 50 ms, safe from a kill of the process; the file is synced to disk every second, safe
    from a power cut. Failed buses and ports are reopened.

    Exit status: 0 the duration is over, 3 no samples for the idle time, 130 Ctrl-C, 143 SIGTERM, 129 SIGHUP (a lost
    connection). In each case the file is complete, and a summary states its content and losses.
    """
    with recording(), LiveLine() as progress:
        done = drivers.record(bench, output, duration=duration, idle=idle, progress=progress, allow=allow or ())
    report(done)
