"""`cycloid-fit inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options


def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A bench file in any supported format.")],
    dbc: Annotated[Path | None, typer.Option(help="The DBC of a CAN log.")] = None,
    output: Annotated[
        Path | None, commands.output_option((".toml",), "MAP.toml", "Write the proposed mapping (TOML).")
    ] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Show the contents of a file, propose a mapping of its channels, and draw them.

    Example: [cyan]cycloid-fit inspect run.tdms -o map.toml --plot channels.png[/], then check map.toml and use it with
    [cyan]--mapping map.toml[/]
    """
    import fitting
    from fitting.readers.first_samples import INSPECTED
    from fitting.readers.inspection import inspection_json

    inspection = fitting.inspect(file, dbc)
    options.write(inspection, output=output, plot=plot)
    if as_json:
        commands.print_json(inspection_json(inspection))
        return
    roles = {look.channel.name: role for role, look in inspection.roles.items()}
    if len(inspection.runs) > 1:
        for run in inspection.runs:
            roles[run.output_angle.channel.name] = "output_angle"
            roles[run.transmission_error.channel.name] = f"transmission_error, {run.name}"
    rows = []
    for look in inspection.looks:
        name, extremes = look.channel.name, [f"{value:.6g}" for value in look.extremes]
        rows.append([name, look.channel.unit, str(look.values.size), *extremes, roles.get(name, "")])
    rows += [[name, "", "", "", "", "(text)"] for name in inspection.file.texts]
    commands.print_table(file.name, ["channel", "unit", "samples", "smallest", "largest", "proposed as"], rows)
    if max(look.values.size for look in inspection.looks) >= INSPECTED:
        typer.echo(f"Based on the first {INSPECTED} samples.")
    typer.echo("\n# A proposed mapping; check it and use it with --mapping.\n" + inspection.text)
    options.print_notes(inspection.file.problems)
