"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands

PairFile = Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The gear pair (format cycloid-pair/1).")]
SurfaceFile = Annotated[
    Path | None,
    typer.Option("--surface", metavar="S.nc", help="Error surface; without it the errors that the pair file states."),
]
FmuFile = Annotated[Path, commands.zip_argument("DRIVE.fmu", "FMU", "An FMU made by cycloid-fmu build.")]
MotionFile = Annotated[
    Path | None,
    typer.Option(
        "--input",
        metavar="MOTION.csv",
        help="The inputs over time: time \\[s] and a column each, such as flange_a.phi \\[rad]; a recording will do.",
    ),
]
TolerancesFile = Annotated[
    Path, typer.Option("--tolerances", metavar="T.toml", help="Tolerances, limits and costs (cycloid-tolerances/1).")
]
