"""`cycloid-bench export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import drivers
from cycloid_fmu.edge.commands import output_option
from drivers.cli.shown import bytes_of


def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording.")],
    output: Annotated[
        Path, output_option((".csv", ".nc", ".parquet", ".mf4"), "RUN.csv|nc|parquet|mf4", "File to write.")
    ],
) -> None:
    """Write a recording in the format of the file's ending; it may be larger than memory.

    Example: [cyan]cycloid-bench export run.arrows -o run.csv[/]

    .csv is one table: the two angles, paired by the SYNC that latched both, and the torque interpolated to these times.
    .nc (netCDF), .parquet and .mf4 (MDF4, ASAM) hold the samples of each channel as received.
    """
    with bytes_of(recording) as advance:
        done = drivers.export(recording, output, progress=advance)
    for problem in done.problems:
        typer.echo(problem, err=True)
    typer.echo(f"{done.path}: {done.rows} rows")
