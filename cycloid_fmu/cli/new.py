"""`cycloid-fmu new`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import CRANK_SPEED
from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.processes import PROCESSES


def new(
    ratio: Annotated[int, typer.Option(help="Whole number: motor speed over output speed, either sign.")],
    outer_diameter: Annotated[float, commands.quantity_option("m", "Largest diameter of the ring.", metavar='"70 mm"')],
    torque: Annotated[float, commands.quantity_option("N*m", "Rated torque at the output.")],
    material: Annotated[str, commands.choice_option(MATERIALS, "Material of the discs.")],
    process: Annotated[str, commands.choice_option(PROCESSES, "Process by which discs and ring are made.")],
    pin_material: Annotated[
        str | None, commands.choice_option(MATERIALS, "Material of the pins.", show_default="bearing steel")
    ] = None,
    ring: Annotated[
        str,
        commands.choice_option(("pins", "conjugate"), "Pins that are dowels, or arcs in one piece with the ring."),
    ] = "pins",
    discs: Annotated[int, typer.Option(help="Number of discs, 1 to 4.")] = 2,
    output: Annotated[
        str,
        commands.choice_option(("gear", "ring"), "Part that is the output: the gear with its carrier, or the ring."),
    ] = "gear",
    length: Annotated[
        float | None,
        commands.quantity_option(
            "m",
            "Largest length of all discs along the axis, with the gaps beside them.",
            show_default="discs of 0.3 of the outer diameter",
            metavar='"30 mm"',
        ),
    ] = None,
    life: Annotated[
        float | None,
        commands.quantity_option(
            "s", "Required L10 life of the eccentric bearing.", show_default="none", metavar='"5000 h"'
        ),
    ] = None,
    crank_speed: Annotated[
        float, commands.quantity_option("rad/s", "Crank speed at which it lives that long.", show_default="1000 rpm")
    ] = CRANK_SPEED,
    bodies: Annotated[
        bool, typer.Option("--bodies", help="Size the drive with elastic discs, output pins and ring; takes minutes.")
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            "-o",
            metavar="FOLDER",
            file_okay=False,
            help="Folder for drive.toml, tolerances.toml, figures.json and report.html.",
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """Size a first drive from ratio, diameter, torque, material and process, with its figures and their ranges.

    Example: [cyan]cycloid-fmu new --ratio 15 --outer-diameter "70 mm" --torque "15 N*m" --material POM --process CNC[/]
    """
    from cycloid_fmu.draw.design_report import report_of, write_design_report
    from cycloid_fmu.drive import Drive
    from cycloid_fmu.studies.sized_figures import NOT_COMPUTED, figures_head, figures_of
    from cycloid_fmu.studies.sizing import SIZED_FILES, Wish, size, write_sizing
    from cycloid_fmu.studies.strength import HEAD
    from cycloid_fmu.surfaces.sampling import parse_tolerances

    wish = Wish(
        ratio=ratio,
        outer_diameter=outer_diameter,
        torque=torque,
        material=material,
        process=process,
        pin_material=pin_material,
        ring=ring,
        discs=discs,
        output=output,
        length=length,
        life=life,
        crank_speed=crank_speed,
        bodies=bodies,
    )
    with commands.status() as progress:
        sized = size(wish, progress)
        tolerances, drive = parse_tolerances(sized.tolerances, "tolerances of the process"), Drive(sized.pair)
        figures, stresses = figures_of(drive, tolerances, sized.bodies, progress, wish.crank_speed)
    numbers = {"figures": [each.numbers() for each in figures], "stresses": [each.numbers() for each in stresses]}
    if folder is not None:
        write_sizing(sized, folder, numbers)
        motion = drive.motion(sized.pair.rated_torque, 0.0)
        report = report_of(drive, motion, "drive.toml", sized.text, figures, stresses)
        write_design_report(report, folder / "report.html")
    if as_json:
        commands.print_json({"pair": sized.text, "tolerances": sized.tolerances, **numbers})
        return
    if folder is None:
        typer.echo(sized.text)
    commands.print_table("Figures", figures_head(drive), [each.row() for each in figures])
    commands.print_table("Nominal stresses at rated torque", HEAD, [each.row() for each in stresses])
    for note in sized.notes:
        typer.echo(note)
    typer.echo(NOT_COMPUTED)
    if folder is not None:
        typer.echo(f"Written: {', '.join(str(folder / name) for name in (*SIZED_FILES, 'report.html'))}. Next:")
        for line in _NEXT:
            typer.echo(f"  cycloid-fmu {line.format(folder=folder)}")


_NEXT = (
    "profile {folder}/drive.toml -o {folder}/disc.dxf",
    "build {folder}/drive.toml --native -o {folder}/drive.fmu",
    'joint {folder}/drive.toml --rotor-inertia "1e-5 kg*m^2" -o {folder}/joint.json',
)
