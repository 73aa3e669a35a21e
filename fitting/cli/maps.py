"""`cycloid-fit maps`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options


def maps(
    files: options.Recordings,
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    mapping: options.MappingFiles = None,
    output: Annotated[Path | None, commands.output_option((".nc",), "MAPS.nc", "Write the maps (netCDF).")] = None,
    report: Annotated[
        Path | None, commands.output_option((".html",), "MAPS.html", "Write the maps as a page.", "--report")
    ] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Compute maps over torque, speed and temperature: transmission error, orders, gap between directions, stiffness.

    Without --pair and --ratio, the ratio is that of the mapping or the recording.

    Example: [cyan]cycloid-fit maps campaign/*.csv --mapping map.toml -o maps.nc --report maps.html[/]
    """
    import fitting
    from fitting.figures.maps import write_maps

    nominal = options.drive_or_ratio(drive, ratio)
    options.check_report(report)
    with commands.status() as progress:
        dataset = fitting.maps(fitting.read_recordings(files, mapping), nominal, progress=progress)
    if output is not None:
        write_maps(dataset, output)
    options.write(dataset, plot=plot, report=report)
    notes = [n for n in dataset.attrs["notes"].split("\n") if n]
    if as_json:
        numbers = {str(name): values.values for name, values in {**dataset.coords, **dataset.data_vars}.items()}
        commands.print_json({**numbers, "notes": notes})
        return
    counts = {"curve": dataset.attrs["curves"], **dataset.sizes}
    names = ("curve", "torque", "speed", "temperature")
    curves, *axes = (f"{counts[name]} {name}{'s' * (counts[name] != 1)}" for name in names)
    typer.echo(f"{curves} over {', '.join(axes)}.")
    options.print_notes(notes)
