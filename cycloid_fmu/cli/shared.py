"""Options that several commands have, and the drive that a pair file and a surface file describe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.geometry.pair import Pair
    from cycloid_fmu.surfaces.surface import ErrorSurface

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


def load(pair_file: Path, surface_file: Path | None) -> tuple[Pair, ErrorSurface]:
    """Return a pair and its errors: those of the surface file, or those that the pair file states."""
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.surface import check_surface, surface_of_pair

    pair = read_pair(pair_file)
    if surface_file is None:
        return pair, surface_of_pair(pair)
    from cycloid_fmu.surfaces.files import read_surface

    surface = read_surface(surface_file)
    check_surface(pair, surface, str(pair_file), str(surface_file))
    return pair, surface
