"""`cycloid-fmu compensate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PlatformNames, SurfaceFile
from cycloid_fmu.edge import ARCSEC, commands

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cycloid_fmu.compensation.compensator import Compensator
    from cycloid_fmu.fmu.description import Version
    from cycloid_fmu.fmu.friction_file import Friction

ENDINGS = (".c", ".h", ".csv", ".fmu")


def compensate(
    drive_file: Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The gear pair, or an RV reducer.")],
    output: Annotated[
        Path,
        commands.output_option(ENDINGS, "OUT.c|csv|fmu", "C99 source with header, look-up table or FMU."),
    ],
    surface_file: SurfaceFile = None,
    fit: Annotated[
        Path | None,
        typer.Option(metavar="FIT.json", help="Series compliance and dry friction, identified (identify -o)."),
    ] = None,
    friction_file: Annotated[
        Path | None,
        typer.Option("--friction", metavar="FRICTION.toml", help="Friction at the output (cycloid-friction/1)."),
    ] = None,
    stiffness: Annotated[
        float | None,
        commands.quantity_option(
            "N*m/rad", "Stiffness of the whole drive; determines the compliance in series.", show_default=False
        ),
    ] = None,
    plot: commands.PlotFile = None,
    loop: Annotated[
        Path | None,
        typer.Option(metavar="FIGURES.json", help="Stiffness and dry friction of a measured loop (metrics -o)."),
    ] = None,
    temperatures: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPERATURES",
            help='Temperature range of the drive, such as "10 degC, 60 degC". Default: the pair\'s.',
        ),
    ] = None,
    torque_accuracy: Annotated[
        float | None,
        commands.quantity_option(
            "N*m", "Standard deviation of the controller's torque.", show_default="1 % of rated_torque"
        ),
    ] = None,
    residual: Annotated[
        float,
        commands.quantity_option(
            "rad",
            "Largest error of the tables; the smallest tables within it are used.",
            show_default="0.5 arcsec",
            metavar='"0.5 arcsec"',
        ),
    ] = 0.5 / ARCSEC,
    sensor: Annotated[
        float,
        commands.quantity_option(
            "rad", "Standard deviation of an output encoder.", show_default="1 arcsec", metavar='"1 arcsec"'
        ),
    ] = 1.0 / ARCSEC,
    tolerances_file: Annotated[
        Path | None,
        typer.Option("--tolerances", metavar="T.toml", help="Widen the band to any drive within these tolerances."),
    ] = None,
    fmi_version: Annotated[str, commands.choice_option(("2.0", "3.0"), "FMI version of an FMU.", "--fmi")] = "2.0",
    platforms: PlatformNames = None,
) -> None:
    """Write a compensator: the motor angle for each desired output angle of a known drive.

    Example: [cyan]cycloid-fmu compensate pair.toml --surface identified.nc --fit fit.json -o joint.c[/]
    """
    from cycloid_fmu.compensation.forms.write import write_compensator
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.fmu.constants import LARGEST_LOAD

    stated = {"--fit": fit, "--stiffness": stiffness, "--loop": loop}
    sources = [name for name, value in stated.items() if value is not None]
    if len(sources) > 1:
        raise edge.InputError(f"{sources[1]}: {sources[0]} determines the series compliance too; give one of the two.")
    names = _platforms_of(output, platforms or [], fmi_version)
    drive = read_drive(drive_file, surface_file)
    friction, stiffness, compliance = _chain(fit, friction_file, stiffness, loop)
    with commands.Bar("crank angles", None) as bar:
        compensator = drive.compensator(
            friction=friction,
            stiffness=stiffness,
            series_compliance=compliance,
            temperatures=_range(temperatures),
            torque_accuracy=torque_accuracy,
            residual=residual,
            sensor=sensor,
            tolerances=tolerances_file,
            total=lambda count: bar.update(completed=0, total=count),
            progress=bar.advance,
        )
    files = write_compensator(
        compensator,
        output,
        fmi_version=fmi_version,  # type: ignore[arg-type]
        platforms=names,
    )
    rated = drive.pair.rated_torque or float(compensator.inverse.torque[-1]) / LARGEST_LOAD
    if plot is not None:
        from cycloid_fmu.draw.compensation import plot_compensator
        from cycloid_fmu.draw.figure import save

        save(plot_compensator(compensator, rated), plot)
    _print(compensator, files, rated)
    if compensator.inverse.residual > residual:
        typer.echo(f"No table is fine enough for the required {residual * ARCSEC:.3g}″.", err=True)


def _platforms_of(output: Path, platforms: list[str], fmi_version: str) -> tuple[str, ...]:
    """Return the platforms of an FMU, none for other forms, whose options and names are checked."""
    if output.suffix == ".fmu":
        from cycloid_fmu.fmu.native import checked_platforms

        version: Version = fmi_version  # type: ignore[assignment]
        return checked_platforms(platforms, version)
    if platforms or fmi_version != "2.0":
        raise edge.InputError(
            f"{'--platform' if platforms else '--fmi'}: this option is for FMUs; give --output the ending .fmu."
        )
    if output.suffix != ".csv":
        from cycloid_fmu.compensation.forms.numbers import name_of

        name_of(output, "output")
    return ()


def _range(temperatures: str | None) -> tuple[str, str] | None:
    """Return the two ends of a temperature range, each as text with a unit."""
    ends = commands.separated(temperatures)
    if ends is None:
        return None
    if len(ends) != 2:
        raise edge.ArgumentError(
            "temperatures", 'give two values separated by a comma, such as "10 degC, 60 degC"', temperatures
        )
    return ends[0], ends[1]


def _print(compensator: Compensator, files: Sequence[Path], rated: float) -> None:
    from cycloid_fmu.compensation.compensator import Memory, step

    inverse = compensator.inverse
    middle = 0.5 * float(inverse.temperature[0] + inverse.temperature[-1])
    indexed, unindexed = (
        step(compensator, Memory(0.0, known), 0.0, 0.0, rated, middle).band * ARCSEC for known in (1.0, 0.0)
    )
    typer.echo(
        f"{' and '.join(map(str, files))}: tables of {compensator.size} bytes; largest difference from the model: "
        f"{inverse.residual * ARCSEC:.3g}″; band (standard deviation) at {rated:.4g} N·m: {indexed:.3g}″, without an "
        f"index {unindexed:.3g}″."
    )


def _chain(
    fit: Path | None, friction_file: Path | None, stiffness: float | None, loop: Path | None
) -> tuple[Friction, float | None, float]:
    """Return friction at the output, stiffness of the whole drive, N*m/rad, and series compliance, rad/(N*m)."""
    from cycloid_fmu.fmu.chain import read_chain, read_loop
    from cycloid_fmu.fmu.friction_file import FrictionTables, read_friction
    from cycloid_fmu.fmu.interface_files import with_measured

    friction = (FrictionTables() if friction_file is None else read_friction(friction_file)).output
    compliance, option = 0.0, "--fit"
    if fit is not None:
        compliance, coulomb = read_chain(fit)
    elif loop is not None:
        option = "--loop"
        stiffness, coulomb = read_loop(loop)
    else:
        return friction, stiffness, 0.0
    return with_measured(friction, coulomb, option), stiffness, compliance
