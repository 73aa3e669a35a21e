"""Options shared by several commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.studies.limits import Verdict
    from cycloid_fmu.studies.verdicts import Judged

PairFile = Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The gear pair (format cycloid-pair/1).")]
SurfaceFile = Annotated[
    Path | None,
    typer.Option("--surface", metavar="S.nc", help="Error surface. Default: the errors in the pair file."),
]
FmuFile = Annotated[Path, commands.zip_argument("DRIVE.fmu", "FMU", "An FMU made by cycloid-fmu build.")]
MotionFile = Annotated[
    Path | None,
    typer.Option(
        "--input",
        metavar="MOTION.csv",
        help="Inputs over time: time \\[s] and one column per input, such as flange_a.phi \\[rad]; or a recording.",
    ),
]
LimitsFile = Annotated[
    Path | None,
    typer.Option(
        "--limits",
        metavar="REQUIREMENTS.toml",
        help="Requirements of the application (cycloid-requirements/1); exit status 4 if one is not met or not judged.",
    ),
]
PlatformNames = Annotated[
    list[str] | None,
    typer.Option(
        "--platform",
        metavar="PLATFORM",
        help="Platform of a native FMU: x86_64-linux, aarch64-linux, x86_64-windows, x86_64-darwin, aarch64-darwin; "
        "repeatable. Default: all.",
    ),
]
TolerancesFile = Annotated[
    Path, typer.Option("--tolerances", metavar="T.toml", help="Tolerances, limits and costs (cycloid-tolerances/1).")
]


def print_verdicts(title: str, verdicts: Sequence[Verdict], not_judged: Sequence[str]) -> None:
    """Print verdict, margin and position for each limit, and the limits that this command does not judge."""
    from cycloid_fmu.studies.limits import HEAD, not_judged_line, row_of

    if verdicts:
        commands.print_table(title, HEAD, [row_of(one) for one in verdicts])
    if not_judged:
        typer.echo(not_judged_line(not_judged))


def print_judged(judged: Judged, title: str) -> None:
    """Print bearing lives and sliding over the duty, and then the verdicts."""
    from cycloid_fmu.studies.verdicts import LIVES_HEAD, SLIDING_HEAD, life_rows, sliding_rows

    if judged.lives:
        commands.print_table("Bearings over the duty", LIVES_HEAD, life_rows(judged))
    if judged.sliding:
        commands.print_table("Largest sliding of flanks on pins", SLIDING_HEAD, sliding_rows(judged))
    if judged.stresses:
        from cycloid_fmu.studies.strength import HEAD

        commands.print_table("Nominal stresses", HEAD, [one.row() for one in judged.stresses])
    print_verdicts(title, judged.verdicts, judged.not_judged)


def leave(verdicts: Sequence[Verdict], not_judged: Sequence[str]) -> None:
    """End the command with its exit status if a limit is not met or not judged."""
    from cycloid_fmu.studies.limits import all_met

    if not all_met(verdicts, not_judged):
        raise typer.Exit(edge.NOT_MET)
