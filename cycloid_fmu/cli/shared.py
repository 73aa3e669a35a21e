"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.fmu.friction_file import Friction
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
        help="The inputs over time: time \\[s] and a column each, such as flange_a.phi \\[rad]; or a recording.",
    ),
]
LimitsFile = Annotated[
    Path | None,
    typer.Option(
        "--limits",
        metavar="REQUIREMENTS.toml",
        help="Requirements of the application (cycloid-requirements/1): judge each limit; status 4 if one is not met.",
    ),
]
TolerancesFile = Annotated[
    Path, typer.Option("--tolerances", metavar="T.toml", help="Tolerances, limits and costs (cycloid-tolerances/1).")
]


def with_measured(friction: Friction, coulomb: float, option: str) -> Friction:
    """Return friction at the output with the dry friction (N·m) that an option's file has; only one may state it."""
    if friction.coulomb > 0.0:
        raise edge.InputError(f"{option}: it has a dry friction; remove coulomb from [friction.output].")
    return friction.replace(coulomb=coulomb)


def print_verdicts(title: str, verdicts: Sequence[Verdict], not_judged: Sequence[str]) -> None:
    """Print each limit's verdict, margin and place, and the limits that this command does not judge."""
    from cycloid_fmu.studies.limits import HEAD, row_of

    if verdicts:
        commands.print_table(title, HEAD, [row_of(one) for one in verdicts])
    if not_judged:
        names = ", ".join(name.replace("_", " ") for name in not_judged)
        typer.echo(f"Limits that this command does not judge: {names}.")


def print_judged(judged: Judged, title: str) -> None:
    """Print the verdicts, and before them the bearings' lives and the sliding over the duty."""
    from cycloid_fmu.studies.verdicts import LIVES_HEAD, SLIDING_HEAD, life_rows, sliding_rows

    if judged.lives:
        commands.print_table("Bearings over the duty", LIVES_HEAD, life_rows(judged))
    if judged.sliding:
        commands.print_table("Sliding of flanks on pins, the largest", SLIDING_HEAD, sliding_rows(judged))
    print_verdicts(title, judged.verdicts, judged.not_judged)


def leave(verdicts: Sequence[Verdict]) -> None:
    """If a limit is not met, end the command with the exit status for it."""
    if not all(one.met for one in verdicts):
        raise typer.Exit(edge.NOT_MET)
