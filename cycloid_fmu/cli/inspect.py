"""`cycloid-fmu inspect`."""

from __future__ import annotations

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import FmuFile
from cycloid_fmu.edge import commands

_NOTHING = 1e-15  # SI: smaller start values are rounding errors


def inspect(fmu_file: FmuFile, as_json: commands.AsJson = False) -> None:
    """List the variables of an FMU and check it against the standard.

    Example: [cyan]cycloid-fmu inspect drive.fmu[/]
    """
    from cycloid_fmu.fmu.run import described, description_of, stated_drive
    from cycloid_fmu.fmu.variables import DAMPING_RATIOS

    description, problems = described(fmu_file)
    if as_json:
        commands.print_json(
            {
                "drive": stated_drive(fmu_file),
                "description": description_of(fmu_file),
                "variables": description,
                "problems": problems,
            }
        )
    else:
        rows = [
            [v["name"], v["causality"], v["unit"], _shown(v["start"]), v["description"].strip()] for v in description
        ]
        commands.print_table(
            f"{fmu_file.name}, drive {stated_drive(fmu_file)}",
            ["variable", "causality", "unit", "start", "meaning"],
            rows,
        )
        typer.echo(f"{description_of(fmu_file)}.")
        for damping in (v for v in description if v["name"] == "mesh_damping"):
            low, high = DAMPING_RATIOS
            typer.echo(
                f"mesh_damping is {_shown(damping['start'])} N·m·s/rad, an assumption unless you have measured it: "
                "vibration at a resonance of the mesh is inversely proportional to it. Published damping ratios of "
                f"gear meshes are {low:g} to {high:g}."
            )
        typer.echo("\n".join(problems) or "fmpy's validation finds no problem.")
    if problems:
        raise typer.Exit(edge.FAILED)


def _shown(start: object) -> str:
    try:
        value = float(str(start))
    except ValueError:
        return str(start)
    return "0" if abs(value) < _NOTHING else f"{value:.9g}"
