"""`cycloid-bench repair`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import drivers
from cycloid_fmu import edge
from cycloid_fmu.edge.commands import output_option
from drivers.cli.shown import bytes_of


def repair(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording.")],
    output: Annotated[
        Path | None, output_option((".arrows",), "WHOLE.arrows", "File for the recovered recording.")
    ] = None,
) -> None:
    """Report the intact content of a truncated or damaged recording, and with -o write it to a new file.

    Example: [cyan]cycloid-bench repair truncated.arrows -o whole.arrows[/]

    The file itself is not changed. Exit status 1 if it is damaged.
    """
    with bytes_of(recording) as advance:
        repaired = drivers.repair(recording, output, progress=advance)
    for problem in repaired.problems:
        typer.echo(problem, err=True)
    typer.echo(f"{recording}: {repaired.batches} intact batches, {repaired.events} events")
    for name, channel in repaired.channels.items():
        lasts = f", from {channel.first:.6f} s to {channel.last:.6f} s" if channel.samples else ""
        gaps = f", {channel.gaps} of them after a gap" if channel.gaps else ""
        typer.echo(f"{name}: {channel.samples} samples{lasts}{gaps}")
    if output is not None:
        typer.echo(f"{output}: written")
    if repaired.problems:
        raise typer.Exit(edge.FAILED)
