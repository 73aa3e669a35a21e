"""`cycloid-fmu profile`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PairFile, SurfaceFile
from cycloid_fmu.edge import commands


def profile(
    pair_file: PairFile,
    output: Annotated[
        Path,
        commands.output_option(
            (".dxf", ".svg", ".csv", ".step", ".stp"), "DISC.dxf|svg|csv|step", "Write the disc, in mm."
        ),
    ],
    surface_file: SurfaceFile = None,
    disc: Annotated[int, typer.Option(help="Number of the disc, from 0.")] = 0,
    chord_error: Annotated[
        float,
        commands.quantity_option(
            "m",
            "Largest distance between the flank and the written outline.",
            show_default="0.1 um",
            metavar='"0.1 um"',
        ),
    ] = 1e-7,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Write a disc as made for CAD, CAM and measuring machines: outline in arcs, holes, pins and pin circle.

    Example: [cyan]cycloid-fmu profile pair.toml -o disc.dxf[/]
    """
    from cycloid_fmu.drive import read_drive

    made = read_drive(pair_file, surface_file).profile(disc=disc, chord_error=chord_error)
    try:
        made.write(output)
    except edge.ArgumentError as problem:
        raise edge.ArgumentError("output", problem.problem, output) from None
    if plot is not None:
        from cycloid_fmu.draw import plots, profiles

        plots.save(profiles.plot_profile(made), plot)
    if as_json:
        commands.print_json(
            {
                "arcs": made.bulge.size,
                "chord_error": made.chord_error,
                "largest_error": made.largest_error,
                "length": made.length,
                "area": made.area,
                "notes": list(made.notes),
            }
        )
        return
    rows = [
        ["arcs", str(made.bulge.size)],
        ["flank to arcs, largest", f"{made.largest_error * 1e6:.3g} µm"],
        ["length of the flank", f"{made.length * 1e3:.6f} mm"],
        ["area inside the flank", f"{made.area * 1e6:.4f} mm²"],
        ["holes", str(made.hole_place.size)],
        ["pins", str(made.pin_place.size)],
    ]
    if output.suffix.lower() == ".csv":
        rows[:2] = [["points", str(made.table["x"].size)]]
    commands.print_table(f"{output.name}: disc {disc} of {pair_file.name}, mm, at 20 °C", ["", "value"], rows)
    for note in made.notes if output.suffix.lower() != ".csv" else ():
        typer.echo(f"Note: {note}", err=True)
