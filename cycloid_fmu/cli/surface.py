"""`cycloid-fmu surface`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu.cli.shared import PairFile, TolerancesFile
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.surfaces.surface import ErrorSurface

surface = commands.subcommands("Make error surfaces.")

SurfaceOutput = Annotated[Path, commands.output_option((".nc",), "SURFACE.nc", "The surface file (netCDF).")]
Profile = Annotated[int, typer.Option(min=1, help="Number of elements along a tooth's profile.")]
Width = Annotated[int, typer.Option(min=1, help="Number of elements across the width.")]
Angle = Annotated[int, typer.Option(min=1, help="Number of elements around the inner half of a pin.")]


def _write(made: ErrorSurface, output: Path, plot: Path | None) -> None:
    from cycloid_fmu.surfaces.files import write_surface

    write_surface(made, output)
    if plot is not None:
        from cycloid_fmu.draw import plots

        plots.save(plots.plot_surface(made), plot)


@surface.command()
def nominal(pair_file: PairFile, output: SurfaceOutput, plot: commands.PlotFile = None) -> None:
    """Write the surface described by the pair file: nominal flanks with the errors in the file.

    Example: [cyan]cycloid-fmu surface nominal pair.toml -o surface.nc[/]
    """
    from cycloid_fmu.drive import read_drive

    _write(read_drive(pair_file).surface, output, plot)


@surface.command()
def sampled(
    pair_file: PairFile,
    tolerances_file: TolerancesFile,
    seed: Annotated[int, typer.Option(help="The same seed draws the same drive.")],
    output: SurfaceOutput,
    profile: Profile = 200,
    width: Width = 20,
    angle: Angle = 100,
    plot: commands.PlotFile = None,
) -> None:
    """Draw one random drive within the tolerances; the errors in the pair file are not included.

    Example: [cyan]cycloid-fmu surface sampled pair.toml --tolerances tolerances.toml --seed 1 -o surface.nc[/]
    """
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.sampling import read_tolerances, sample_surface
    from cycloid_fmu.surfaces.surface import Elements

    pair, tolerances = read_pair(pair_file), read_tolerances(tolerances_file)
    _write(sample_surface(pair, tolerances, seed, Elements(profile, width, angle)), output, plot)


@surface.command()
def measured(
    pair_file: PairFile,
    points_file: Annotated[
        Path,
        typer.Option(
            "--points",
            metavar="CMM.csv",
            help="Points of flanks and pins: body,disc,number,x \\[mm],y \\[mm],z \\[mm].",
        ),
    ],
    output: SurfaceOutput,
    profile: Profile = 50,
    width: Width = 5,
    angle: Angle = 25,
    plot: commands.PlotFile = None,
) -> None:
    """Fit an error surface to points of a coordinate measuring machine: alignment, outlier removal, averaging.

    Example: [cyan]cycloid-fmu surface measured pair.toml --points cmm.csv -o surface.nc --plot surface.png[/]
    """
    import numpy as np

    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.measuring import measured_surface, read_points
    from cycloid_fmu.surfaces.surface import Elements

    made, report = measured_surface(read_pair(pair_file), read_points(points_file), Elements(profile, width, angle))
    _write(made, output, plot)
    found = report.alignments
    rows = [
        ["points", *(str(a.points) for a in found)],
        ["outliers removed", *(str(a.outliers) for a in found)],
        ["frame, x", *(f"{a.x * 1e3:.4f} mm" for a in found)],
        ["frame, y", *(f"{a.y * 1e3:.4f} mm" for a in found)],
        ["frame, turn", *(f"{np.degrees(a.rotation):.5f}°" for a in found)],
        ["form, rms", *(f"{a.rms * 1e6:.3f} µm" for a in found)],
        ["scatter, rms", *(f"{a.scatter * 1e6:.3f} µm" for a in found)],
    ]
    commands.print_table(points_file.name, ["figure", *(a.body for a in found)], rows)
    for outlier in report.outliers:
        typer.echo(
            f"{points_file.name}: line {outlier.line}: {outlier.place} is {outlier.distance * 1e6:.1f} µm from its "
            "neighbours and was removed."
        )
    for note in report.notes:
        typer.echo(note)
