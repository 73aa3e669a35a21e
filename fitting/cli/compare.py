"""`cycloid-fit compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options


def compare(
    before: Annotated[Path, typer.Argument(metavar="A", help="A recording, or the figures (JSON) of several.")],
    after: Annotated[Path, typer.Argument(metavar="B", help="The recording or figures to compare it with.")],
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    rated_torque: options.RatedTorque = None,
    mapping: options.MappingFiles = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Find the figures that differ by more than their uncertainty: before and after, two drives, two temperatures.

    Example: [cyan]cycloid-fit metrics new/*.csv --ratio -39 -o new.json[/], the same for worn.json, then
    [cyan]cycloid-fit compare new.json worn.json --plot changes.png[/]
    """
    import fitting
    from cycloid_fmu.drive import read_drive
    from fitting.figures.comparison import comparison_json

    nominal = None if drive is None else read_drive(drive)
    first, second = (
        file if file.suffix.lower() == ".json" else fitting.read_recordings(file, mapping)[0]
        for file in (before, after)
    )
    with commands.status() as progress:
        comparison = fitting.compare(first, second, nominal, ratio=ratio, rated_torque=rated_torque, progress=progress)
    options.write(comparison, plot=plot)
    if as_json:
        commands.print_json(comparison_json(comparison))
        return
    moved = {True: "yes", False: "no", None: "unknown"}
    rows = [[change.name, *change.in_field_units(), moved[change.moved]] for change in comparison.changes]
    commands.print_table("Changes", ["figure", "A", "B", "B - A", "± 95 %", "unit", "changed"], rows)
    options.print_notes(comparison.notes)
