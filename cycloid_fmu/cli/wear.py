"""`cycloid-fmu wear`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import LimitsFile, PairFile, SurfaceFile, leave, print_judged
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive
    from cycloid_fmu.studies.limits import Requirements
    from cycloid_fmu.studies.verdicts import Judged
    from cycloid_fmu.wear.life import WearRun


def wear(
    pair_file: PairFile,
    wear_file: Annotated[Path, typer.Option("--wear", metavar="WEAR.toml", help="The wear law (cycloid-wear/1).")],
    torque: Annotated[
        float | None,
        commands.quantity_option("N*m", "Torque on the output.", show_default="the rated torque"),
    ] = None,
    crank_turns: Annotated[
        float | None, typer.Option(help="Crank turns. Default: those of the duty cycle.", show_default=False)
    ] = None,
    duty_file: Annotated[
        Path | None,
        typer.Option(
            "--duty", metavar="DUTY.csv", help="Duty cycle instead of one torque: torque [N*m],crank_turns [1]."
        ),
    ] = None,
    output: Annotated[
        Path | None, commands.output_option((".nc",), "WORN.nc", "Write the worn surface and its life (netCDF).")
    ] = None,
    plot: commands.PlotFile = None,
    surface_file: SurfaceFile = None,
    limits_file: LimitsFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Compute the wear of flanks and pins over a life, with the profile updated as it wears.

    Example: [cyan]cycloid-fmu wear pair.toml --wear wear.toml --torque "-400 N*m" --crank-turns 3e6 -o worn.nc[/]
    """
    from cycloid_fmu.drive import read_drive, refuse_first_stage
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.wear import life
    from cycloid_fmu.wear.law import duty_cycle, read_wear_law

    law = read_wear_law(wear_file)
    drive = read_drive(pair_file, surface_file)
    loads, turns = duty_cycle(law, torque, crank_turns, duty_file, str(wear_file), drive.pair, str(pair_file))
    refuse_first_stage(drive, "wear")
    requirements = None if limits_file is None else _requirements(limits_file, drive, str(pair_file))
    with commands.Bar("crank turns", turns or 1.0) as bar:
        run = life.run_wear(
            drive.stage,
            law,
            loads,
            turns,
            str(wear_file),
            workers=os.cpu_count() or 1,
            progress=lambda done: bar.update(completed=done),
        )
    judged = None if requirements is None else _judged(run, requirements, len(loads))
    if output is not None:
        write_surface(run.surface, output)
    if plot is not None:
        _plot(run, judged, plot)
    for note in run.notes:
        typer.echo(note, err=True)
    if as_json:
        commands.print_json(run.figures | ({} if judged is None else judged.numbers()))
    else:
        _print(run.figures, pair_file.name)
        if judged is not None and limits_file is not None:
            print_judged(judged, f"Limits of {limits_file.name}, the drive as worn")
    if judged is not None:
        leave(judged.verdicts, judged.not_judged)


def _requirements(limits_file: Path, drive: Drive, source: str) -> Requirements:
    """Read the limits, and refuse those that need what the pair of file `source` does not state."""
    from cycloid_fmu.studies import verdicts
    from cycloid_fmu.studies.limits import read_requirements

    requirements = read_requirements(limits_file)
    verdicts.check(requirements.of_wear, drive.pair, str(limits_file), source)
    return requirements


def _judged(run: WearRun, requirements: Requirements, loads: int) -> Judged:
    from cycloid_fmu.studies.verdicts import judge_worn

    with commands.progress("crank angles", ANGLES * loads) as progress:
        return judge_worn(run, requirements, workers=os.cpu_count() or 1, progress=progress)


def _plot(run: WearRun, judged: Judged | None, plot: Path) -> None:
    from cycloid_fmu.draw.figure import save
    from cycloid_fmu.draw.verdicts import show_verdicts
    from cycloid_fmu.draw.wear_plots import plot_wear

    figure = plot_wear(run.model, run.states, run.new, run.figures)
    if judged is not None:
        show_verdicts(figure, judged.verdicts, judged.not_judged)
    save(figure, plot)


def _print(figures: dict[str, Any], name: str) -> None:
    kinds = {"linear": "without update", "updated": "profile updated"}
    rows = [
        [f"{body}, {text}", *(f"{figures[kind][f'{body}_depth_{key}'] * 1e6:.3f} µm" for kind in kinds)]
        for body in ("gear", "pin")
        for key, text in (("max", "deepest"), ("mean", "mean over the worn area"))
    ]
    commands.print_table(f"{name}, {figures['crank_turns']:g} crank turns", ["wear depth", *kinds.values()], rows)
    life = figures["life"]
    names = {"transmission_error": "Transmission error", "backlash": "Backlash", "lost_motion": "Lost motion"}
    for key, text in names.items():
        new_mean, worn_mean, new_range, worn_range = (
            f"{life[figure][k] * edge.ARCSEC:.3f}″" for figure in (key, f"{key}_range") for k in (0, -1)
        )
        typer.echo(f"{text}: mean {new_mean} new, {worn_mean} worn; peak to peak {new_range} new, {worn_range} worn.")
    step = figures["step"]
    deepest = " and ".join(
        f"{(figures['updated'][key] - step['whole_steps'][key]) * 1e6:+.3f} µm"
        for key in ("gear_depth_max", "pin_depth_max")
    )
    typer.echo(
        f"Steps: {step['count']}; halving all steps changes the depth by at most "
        f"{step['halving_difference'] * 1e6:.3f} µm, the largest depth of gear and pin by {deepest}."
    )
    typer.echo(f"Sliding work at friction coefficient 1: {figures['sliding_work']:.4g} J per crank turn.")
    if "sliding_loss" in figures:
        typer.echo(
            f"Friction: {figures['friction_work']:.4g} J per crank turn, "
            f"{figures['sliding_loss']:.3%} of the work of the load."
        )
