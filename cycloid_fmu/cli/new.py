"""`cycloid-fmu new`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.processes import PROCESSES


def new(
    ratio: Annotated[int, typer.Option(help="Whole number: motor speed over output speed, either sign.")],
    outer_diameter: Annotated[float, commands.quantity_option("m", "Largest diameter of the ring.")],
    torque: Annotated[float, commands.quantity_option("N*m", "Rated torque at the output.")],
    material: Annotated[str, commands.choice_option(MATERIALS, "Of the discs.")],
    process: Annotated[str, commands.choice_option(PROCESSES, "By which discs and ring are made.")],
    pin_material: Annotated[str, commands.choice_option(MATERIALS, "Of pins and output pins.")] = "bearing steel",
    discs: Annotated[int, typer.Option(min=1, max=4, help="Number of discs.")] = 2,
    turning: Annotated[
        str,
        commands.choice_option(
            ("gear", "ring"), "What turns with the output: the gear's carrier or the ring.", "--output"
        ),
    ] = "gear",
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            "-o",
            metavar="FOLDER",
            file_okay=False,
            help="Folder for drive.toml, tolerances.toml and figures.json.",
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """A first drive from ratio, diameter, torque, material and process, with its figures and their ranges.

    Example: [cyan]cycloid-fmu new --ratio 15 --outer-diameter "70 mm" --torque "15 N*m" --material POM --process CNC[/]
    """
    from cycloid_fmu.studies.sized_figures import figures_of
    from cycloid_fmu.studies.sizing import Wish, size, write_sizing

    wish = Wish(
        ratio=ratio,
        outer_diameter=outer_diameter,
        torque=torque,
        material=material,
        process=process,
        pin_material=pin_material,
        discs=discs,
        output=turning,
    )
    with commands.status() as progress:
        drive = size(wish, progress)
        figures = figures_of(drive, progress)
    numbers = [figure.numbers() for figure in figures]
    if folder is not None:
        write_sizing(drive, folder, numbers)
    if as_json:
        commands.print_json({"pair": drive.text, "tolerances": drive.tolerances, "figures": numbers})
        return
    if folder is None:
        typer.echo(drive.text)
    commands.print_table("Figures", ["", "as drawn", "range", "unit", "of"], [figure.row() for figure in figures])
    for note in drive.notes:
        typer.echo(note)
    typer.echo("Not computed: strength of discs, ring and housing, seals, wear, heat and noise.")
    if folder is not None:
        typer.echo(
            f"Written: {', '.join(str(folder / name) for name in ('drive.toml', 'tolerances.toml', 'figures.json'))}"
        )
