"""`cycloid-fmu build`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import SurfaceFile, with_measured
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.fmu.friction_file import FrictionTables
    from cycloid_fmu.fmu.variables import LossRow


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
            "kg*m^2", "Internal inertia on the crank too, which then takes a torque as well.", show_default=False
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
            "N*m", "With --native: largest torque of the tables; 2.5 times rated_torque by default.", show_default=False
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            help="Number of drives drawn from the fit of an identified drive; the parameter draw selects one.",
            show_default=False,
        ),
    ] = 0,
    platforms: Annotated[
        list[str] | None,
        typer.Option(
            "--platform", help="With --native: x86_64-linux, aarch64-darwin, ...; all by default. Repeatable."
        ),
    ] = None,
) -> None:
    """Build an FMU of the drive, or of a whole RV reducer with the sun as input.

    Example: [cyan]cycloid-fmu build pair.toml --surface identified.nc -o drive.fmu[/]
    """
    import numpy as np

    from cycloid_fmu.contact.transmission import interference_notes, slices_needed
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.fmu.bench_losses import is_of_bench
    from cycloid_fmu.fmu.build import build_fmu, ratio_of, read_losses
    from cycloid_fmu.fmu.chain import read_loop
    from cycloid_fmu.fmu.friction_file import FrictionTables, read_friction
    from cycloid_fmu.fmu.variables import LOSSLESS, Interface
    from cycloid_fmu.reducer.transmission import solve

    if platforms and not native:
        raise edge.InputError("--platform is only for --native; an FMU in Python runs wherever Python does.")
    if largest_torque is not None and not native:
        raise edge.InputError("--largest-torque is only for --native; an FMU in Python solves every torque.")
    if loop is not None and stiffness is not None:
        raise edge.InputError("--loop and --stiffness both state a stiffness; give one of them.")
    drive = read_drive(pair_file, surface_file)
    table, friction = LOSSLESS, FrictionTables()
    if friction_file is not None:
        friction = read_friction(friction_file)
    if losses is not None and is_of_bench(losses):
        table, friction = _measured(losses, ratio_of(drive.pair, drive.first_stage), friction)
    elif losses is not None:
        table = read_losses(losses)
    if loop is not None:
        stiffness, coulomb = read_loop(loop)
        friction = friction.replace(output=with_measured(friction.output, coulomb, "--loop"))
    kind: Any = interface
    offered = Interface(
        kind,
        output_inertia,
        table,
        crank_inertia=crank_inertia,
        stiffness=stiffness,
        support_flange=support_flange,
        input_friction=friction.input,
        output_friction=friction.output,
    )
    options: dict[str, Any] = {"interface": offered, "fmi_version": fmi_version, "draws": draws}
    turn = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    free = solve(drive.pair, drive.surface, drive.first_stage, [], turn, slices_needed(drive.surface))
    for note in interference_notes(free):
        typer.echo(f"Note: {note}", err=True)
    if not native:
        build_fmu(drive, output, **options)
        return
    from cycloid_fmu.fmu.constants import LARGEST_LOAD
    from cycloid_fmu.native.build import build_native, platforms_of
    from cycloid_fmu.native.tables import PROBES

    if drive.pair.rated_torque is None and largest_torque is None:
        raise edge.InputError(
            f"{pair_file}: [pair] rated_torque is missing; state it (tables reach {LARGEST_LOAD:g} times as far) or "
            "give --largest-torque."
        )
    names = platforms or platforms_of(fmi_version)  # type: ignore[arg-type]
    life = drive.surface.life
    ages = draws == 0 and life is not None and life.ageing is not None

    def of(number: int) -> str:
        if ages:
            return f"crank angles of state {number + 1} of the life"
        return f"crank angles of draw {number} of {draws}" if number else "crank angles"

    with commands.Bar("compiling", len(names)) as bar:
        made = build_native(
            drive,
            output,
            **options,
            platforms=names,
            largest_torque=largest_torque,
            workers=os.cpu_count() or 1,
            compiled=lambda name: bar.advance(),
            progress=bar.advance,
            total=lambda count: bar.update(completed=0, total=count),
            drawing=lambda number: bar.update(completed=0, description=of(number)),
        )
    places = "random crank angles and torques, the transmission error also around its largest errors"
    typer.echo(
        f"{output}: {output.stat().st_size / 1e6:.2f} MB, {made.told}; compared with the exact model at {PROBES} "
        f"{'random crank angles and torques, at random ages' if ages else places}."
    )


def _measured(losses: Path, ratio: float, friction: FrictionTables) -> tuple[tuple[LossRow, ...], FrictionTables]:
    """Loss table fitted to measured losses, and the friction with their temperature coefficient at the input."""
    from cycloid_fmu.fmu.bench_losses import read_bench_losses

    found, at = read_bench_losses(losses, ratio), friction.input
    warm = f", proportional to exp(-{found.temperature_coefficient:.4g}/K (T - {found.reference_temperature:.5g} K))"
    typer.echo(
        f"{losses}: the loss table's residual is {100.0 * found.misfit:.2g} % of the losses (rms)"
        f"{warm if found.temperature_coefficient != 0.0 else ''}."
    )
    if found.temperature_coefficient == 0.0:
        return found.rows, friction
    if at.temperature_coefficient != 0.0:
        raise edge.InputError(
            f"[friction.input] temperature_coefficient = {at.temperature_coefficient:g} 1/K: {losses} has one as "
            "well; remove one of them."
        )
    temperature = {name: getattr(found, name) for name in ("temperature_coefficient", "reference_temperature")}
    return found.rows, friction.replace(input=at.replace(**temperature))
