"""`cycloid-fmu design`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import print_verdicts
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.studies.design import Design, DesignTask


def design(
    design_file: Annotated[
        Path, typer.Argument(metavar="DESIGN.toml", help="Drive, ranges, goals and limits (cycloid-design/1).")
    ],
    starts: Annotated[int, typer.Option(min=0, help="Number of starting points besides the drive itself.")] = 4,
    points: Annotated[int, typer.Option(min=3, help="Number of drives on the Pareto front, with two goals.")] = 7,
    seed: Annotated[int, typer.Option(min=0, help="The same seed finds the same drive.")] = 1,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            file_okay=False,
            help="Folder for a pair file of each drive, a surface file if its flanks have form, and designs.json.",
        ),
    ] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Search for the geometry and modification that meet given limits and optimize one goal, or two.

    Example: [cyan]cycloid-fmu design design.toml -o found --plot found.png[/]
    """
    from cycloid_fmu.studies import design as searching

    pair, task, tolerances = searching.read_design_task(design_file)
    with commands.status() as progress:
        found = searching.search(
            pair,
            task,
            tolerances,
            starts=starts,
            seed=seed,
            points=points,
            workers=os.cpu_count() or 1,
            progress=progress,
        )
    if output is not None:
        searching.write_designs(found, output)
    if plot is not None:
        from cycloid_fmu.draw.designs import plot_designs
        from cycloid_fmu.draw.plots import save

        save(plot_designs(found, task, design_file.stem), plot)
    if as_json:
        commands.print_json([one.numbers() for one in found])
    else:
        for number, one in enumerate(found, 1):
            _print(one, task, f"Design {number} of {len(found)}" if len(found) > 1 else "Design")
    if not all(one.met for one in found):
        raise typer.Exit(edge.NOT_MET)


def _print(one: Design, task: DesignTask, title: str) -> None:
    from cycloid_fmu.studies.design import shown

    goals = [[f"goal: {name.replace('_', ' ')}", *shown(name, value), ""] for name, value in one.goals.items()]
    rows = []
    for name, value in one.values.items():
        low, high = (shown(name, end)[0] for end in task.vary[name])
        rows.append([name.replace("_", " "), *shown(name, value), f"{low} … {high}"])
    commands.print_table(title, ["", "value", "unit", "range"], [*goals, *rows])
    print_verdicts("Limits for the drive as drawn", one.verdicts, [])
    if one.binding:
        (goal, *_) = one.goals
        held = [
            [b.name.replace("_", " "), " ".join(shown(b.name, b.value)), " ".join(shown(goal, b.of_a_tenth))]
            for b in one.binding
        ]
        better = f"gain in {goal.replace('_', ' ')} if relaxed by 10 %"
        commands.print_table("Binding constraints", ["limit or end of a range", "at", better], held)
    if one.required_yield is not None:
        whole = one.yields["all"]
        typer.echo(
            f"{whole['share']:.1%} of sampled drives meet all limits ({whole['low']:.1%} … {whole['high']:.1%}); "
            f"required {one.required_yield:.1%}."
        )
