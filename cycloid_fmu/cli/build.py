"""`cycloid-fmu build`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PlatformNames, SurfaceFile
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive


def build(
    pair_file: Annotated[
        Path, typer.Argument(metavar="PAIR.toml", help="The gear pair, or an RV reducer (cycloid-reducer/1).")
    ],
    output: Annotated[Path, commands.output_option((".fmu",), "DRIVE.fmu", "The FMU file.")],
    surface_file: SurfaceFile = None,
    interface: Annotated[
        str,
        commands.choice_option(
            ("kinematic", "compliant"),
            "kinematic: crank motion and load in, output motion out; compliant: both motions in, both torques out.",
        ),
    ] = "kinematic",
    native: Annotated[
        bool,
        typer.Option("--native", help="Build an FMU that needs no Python: C code with tables of the contact model."),
    ] = False,
    fmi_version: Annotated[str, commands.choice_option(("2.0", "3.0"), "FMI version.", "--fmi")] = "2.0",
    stiffness: Annotated[
        float | None,
        commands.quantity_option(
            "N*m/rad",
            'Stiffness of the whole drive, such as a catalogue\'s "49 N*m/arcmin"; sets the compliance in series.',
            show_default=False,
        ),
    ] = None,
    output_inertia: Annotated[
        float,
        commands.quantity_option(
            "kg*m^2",
            "Internal inertia on the output of a compliant FMU, whose output then takes a torque.",
            show_default=False,
        ),
    ] = 0.0,
    crank_inertia: Annotated[
        float,
        commands.quantity_option(
            "kg*m^2",
            "Internal inertia on the crank, which then takes a torque; alone, the arm is in your tool.",
            show_default=False,
        ),
    ] = 0.0,
    support_flange: Annotated[
        bool,
        typer.Option("--support-flange", help="For a rotating housing: its motion is an input, its torque an output."),
    ] = False,
    losses: Annotated[
        Path | None,
        typer.Option(
            metavar="LOSSES.csv",
            help="Losses as in Modelica's LossyGear: speed \\[rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],"
            "tau_bf2 [N*m]; or measured: speed \\[rpm],torque [N*m],loss [N*m],temperature [K].",
        ),
    ] = None,
    friction_file: Annotated[
        Path | None,
        typer.Option("--friction", metavar="FRICTION.toml", help="Friction at both flanges (cycloid-friction/1)."),
    ] = None,
    loop: Annotated[
        Path | None,
        typer.Option(
            metavar="FIGURES.json",
            help="Stiffness and dry friction of a measured loop: figures written by cycloid-fit metrics -o.",
        ),
    ] = None,
    largest_torque: Annotated[
        float | None,
        commands.quantity_option(
            "N*m", "With --native: largest torque of the tables.", show_default="2.5 times rated_torque"
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=10000,
            help="Number of drives drawn from the fit of an identified drive: DRIVE-0000.fmu, … besides DRIVE.fmu.",
            show_default=False,
        ),
    ] = 0,
    age: Annotated[
        list[float] | None,
        commands.quantity_option(
            "s",
            "Age of a drive with a forecast; repeatable: DRIVE-0000.fmu, … instead of DRIVE.fmu.",
            show_default=False,
            metavar='"5000 h"',
        ),
    ] = None,
    wear_factor: Annotated[
        float, typer.Option(help="With --age: ratio of the wear coefficient to the forecast's median.")
    ] = 1.0,
    crank_turns: Annotated[
        list[float] | None,
        typer.Option(
            help="Crank turns since new of a drive with a life; repeatable: DRIVE-0000.fmu, … instead of DRIVE.fmu.",
            show_default=False,
        ),
    ] = None,
    platforms: PlatformNames = None,
) -> None:
    """Build an FMU of the drive, or of a whole RV reducer with the sun as input.

    Example: [cyan]cycloid-fmu build pair.toml --surface identified.nc -o drive.fmu[/]
    """
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.fmu.build import checked_interface
    from cycloid_fmu.fmu.interface_files import read_interface
    from cycloid_fmu.fmu.model_losses import states_friction, with_model_losses
    from cycloid_fmu.fmu.variables import Interface

    if platforms and not native:
        raise edge.InputError("--platform is only for --native; an FMU in Python runs wherever Python does.")
    if largest_torque is not None and not native:
        raise edge.InputError("--largest-torque is only for --native; an FMU in Python solves every torque.")
    if loop is not None and stiffness is not None:
        raise edge.InputError("--loop and --stiffness both state a stiffness; give one of them.")
    drive = read_drive(pair_file, surface_file)
    kind: Any = interface
    stated = Interface(
        kind, output_inertia, crank_inertia=crank_inertia, stiffness=stiffness, support_flange=support_flange
    )
    offered, measured = read_interface(stated, drive.ratio, losses=losses, friction=friction_file, loop=loop)
    if measured is not None:
        typer.echo(f"{losses}: {measured.summary}.")
    if drive.pair.losses is not None and (states_friction(offered) or drive.pair.supports is None):
        source = next((file for file in (losses, friction_file, loop) if file is not None), None)
        why = "there are no [supports] that they act on"
        if source is not None:
            why = f"{source} states the losses or friction of this FMU"
        typer.echo(f"{pair_file}: [losses] are not used: {why}.")
    if native and drive.pair.rated_torque is None and largest_torque is None:
        from cycloid_fmu.fmu.constants import LARGEST_LOAD

        raise edge.InputError(
            f"{pair_file}: [pair] rated_torque is missing; state it (tables reach {LARGEST_LOAD:g} times as far) or "
            "give --largest-torque."
        )
    for path, one in _drives(drive, output, draws, age or [], wear_factor, crank_turns or []).items():
        _print_notes(one)
        complete, found = with_model_losses(checked_interface(offered, one), one)
        if found is not None:
            typer.echo(f"{path}: {found.summary}")
        if native:
            tables = {"platforms": platforms or (), "largest_torque": largest_torque}
            _build_native(one, path, interface=complete, fmi_version=fmi_version, **tables)
        else:
            one.build_fmu(path, complete, fmi_version=fmi_version)  # type: ignore[arg-type]


def _drives(
    drive: Drive, output: Path, draws: int, ages: list[float], wear_factor: float, crank_turns: list[float]
) -> dict[Path, Drive]:
    """Return the drives to build by their files: one as it is, or those drawn, or those of ages or crank turns."""
    from cycloid_fmu.drive import Drive, numbered
    from cycloid_fmu.surfaces.posterior import drawn_surfaces

    if sum(map(bool, (draws, ages, crank_turns))) > 1:
        raise edge.InputError("--draws, --age and --crank-turns each choose the drives; give one of them.")
    if wear_factor != 1.0 and not ages:
        raise edge.InputError("--wear-factor is only for --age.")
    worn = [drive.at_age(age, wear_factor) for age in ages] + [drive.after(turns) for turns in crank_turns]
    if len(worn) == 1:
        return {output: worn[0]}
    surfaces = drawn_surfaces(drive.pair, drive.surface, draws, seed=0) if draws else []
    drawn = [Drive(drive.pair, surface, drive.first_stage) for surface in surfaces]
    files = {numbered(output, number): one for number, one in enumerate(worn or drawn)}
    return files if worn else {output: drive, **files}


def _print_notes(drive: Drive) -> None:
    """Print notes on contacts that press without load and on a tilt beyond first order."""
    import numpy as np

    from cycloid_fmu.analysis import interference_notes, solve, tilt_notes

    turn = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    free = solve(drive, [], turn)
    for note in [*interference_notes(free), *tilt_notes(drive)]:
        typer.echo(f"Note: {note}", err=True)


def _build_native(drive: Drive, path: Path, **options: Any) -> None:
    """Build a native FMU with progress, and print the accuracy of its tables."""
    from cycloid_fmu.fmu.native import build_native
    from cycloid_fmu.fmu.tables import PROBES

    with commands.Bar("crank angles", None) as bar:
        made = build_native(
            drive,
            path,
            **options,
            workers=os.cpu_count() or 1,
            progress=bar.advance,
            total=lambda count: bar.update(completed=0, total=count),
        )
    typer.echo(
        f"{path}: {path.stat().st_size / 1e6:.2f} MB, {made.accuracy}; compared with the exact model at {PROBES} "
        "random crank angles and torques, the transmission error also around its largest errors."
    )
