"""`cycloid-fit friction`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands
from fitting.cli import options

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive
    from fitting.figures.friction import FrictionFit


def friction(
    files: options.Recordings,
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    speeds: Annotated[
        str | None,
        typer.Option(
            metavar="SPEEDS",
            help='Range of speeds of the output that is fitted, such as "0.1 rev/s, 1 rev/s"; default: from 2 % of the '
            "largest speed on.",
            show_default=False,
        ),
    ] = None,
    loop: Annotated[
        Path | None,
        typer.Option(
            metavar="FIGURES.json",
            help="Figures of loops (metrics -o); their friction per load is used if the recordings resolve none.",
        ),
    ] = None,
    mapping: options.MappingFiles = None,
    output: Annotated[
        Path | None,
        commands.output_option(
            (".toml", ".json"),
            "FRICTION.toml",
            "Write the friction file of an FMU (build --friction), or the fit (JSON).",
        ),
    ] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Fit the friction of a turning drive, from ramps of the speed or runs at constant speeds, at one or more loads.

    Coulomb, viscous, Stribeck and load-dependent friction, referred to the output, as far as the recordings resolve
    them. With a pair that states its friction also the coefficients of it that the recordings tell apart.

    Example: [cyan]cycloid-fit friction ramp.csv --mapping map.toml --speeds "0.1 rev/s, 1 rev/s" -o friction.toml[/]
    """
    import fitting
    from cycloid_fmu.drive import Drive
    from fitting.figures.friction import friction_json

    nominal = options.drive_or_ratio(drive, ratio)
    stated_drive = nominal if isinstance(nominal, Drive) else None
    with commands.status() as progress:
        fit = fitting.friction(
            fitting.read_recordings(files, mapping),
            ratio=ratio if stated_drive is None else stated_drive.ratio,
            loop=loop,
            progress=progress,
            speeds=commands.separated(speeds),
        )
        if stated_drive is not None and stated_drive.pair.losses is not None and stated_drive.pair.supports is not None:
            fit = _with_coefficients(fit, stated_drive, loop)
    options.write(fit, output=output, plot=plot)
    if as_json:
        commands.print_json(friction_json(fit))
        return
    low, high = fit.speeds
    title = f"Friction at the output, {low:.4g} to {high:.4g} rad/s"
    options.print_figures(title, {**fit.figures, **fit.coefficients})
    options.print_notes(fit.notes)


def _with_coefficients(friction_fit: FrictionFit, drive: Drive, loop: Path | None) -> FrictionFit:
    """Return the fit with the coefficients of [losses], or with a note on why there are none."""
    import fitting

    try:
        return fitting.loss_coefficients(friction_fit, drive, loop)
    except edge.InputError as problem:
        return dataclasses.replace(friction_fit, notes=(*friction_fit.notes, f"No coefficients of [losses]: {problem}"))
