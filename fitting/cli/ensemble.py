"""`cycloid-fit ensemble`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands
from fitting.cli import options


def ensemble(
    surface: Annotated[Path, typer.Argument(metavar="S.nc", help="An identified error surface.")],
    drive: options.PairFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for the surfaces.")],
    count: Annotated[int, typer.Option("--draws", min=1, max=10000, help="Number of surfaces drawn.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same surfaces.")] = 0,
    torque: Annotated[
        float | None,
        commands.quantity_option(
            "N*m", "Torque at which --plot draws the band of transmission errors.", show_default="the rated torque"
        ),
    ] = None,
    plot: commands.PlotFile = None,
) -> None:
    """Draw error surfaces that agree with the measurement as well as the identified one; their FMUs span a band.

    Example: [cyan]cycloid-fit ensemble s.nc --pair pair.toml -o drawn --torque "100 N*m" --plot band.png[/]
    """
    import fitting
    from cycloid_fmu.drive import read_drive
    from fitting.reports.plots import plot_band

    if plot is None and torque is not None:
        raise edge.InputError("--torque is only for --plot, which draws the band at this torque.")
    identified = read_drive(drive, surface)
    load = identified.pair.rated_load(str(drive)) if plot is not None and torque is None else torque
    drawn = fitting.ensemble(identified, count, seed)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise edge.ArgumentError("output", f"the folder can't be created: {problem.strerror}", output) from None
    with commands.progress("surfaces", count) as written:
        for number, member in enumerate(drawn):
            member.write(output / f"{surface.stem}-{number:04d}.nc")
            written(1.0)
    if plot is not None and load is not None:
        plot_band(identified, drawn, load, plot)
    typer.echo(f"{output}: {count} error surfaces written.")
