"""`cycloid-fmu build`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import SurfaceFile
from cycloid_fmu.edge import commands


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
    output_inertia: Annotated[
        float,
        commands.quantity_option(
            "kg*m^2",
            "Inertia on the output inside a compliant FMU, which then takes the load.",
            show_default=False,
        ),
    ] = 0.0,
    crank_inertia: Annotated[
        float,
        commands.quantity_option(
            "kg*m^2", "Inertia on the crank inside as well: that flange too then takes a torque.", show_default=False
        ),
    ] = 0.0,
    losses: Annotated[
        Path | None,
        typer.Option(
            metavar="LOSSES.csv",
            help="Losses: speed \\[rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m], as Modelica's LossyGear.",
        ),
    ] = None,
    fmi_version: Annotated[str, commands.choice_option(("2.0", "3.0"), "FMI version.", "--fmi")] = "2.0",
    native: Annotated[
        bool, typer.Option("--native", help="An FMU that needs no Python: C around tables of the contact model.")
    ] = False,
    largest_torque: Annotated[
        float | None,
        commands.quantity_option(
            "N*m", "With --native: how far the tables reach; 2.5 times rated_torque by default.", show_default=False
        ),
    ] = None,
    platforms: Annotated[
        list[str] | None,
        typer.Option(
            "--platform", help="With --native: x86_64-linux, aarch64-darwin, ...; all by default. Repeatable."
        ),
    ] = None,
) -> None:
    """Build a Co-Simulation FMU of the drive, or of a whole RV reducer with the sun as input.

    Example: [cyan]cycloid-fmu build pair.toml --surface identified.nc -o drive.fmu[/]
    """
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.fmu.build import build_fmu, read_losses
    from cycloid_fmu.fmu.variables import LOSSLESS, Interface

    if platforms and not native:
        raise edge.InputError("--platform: only a --native FMU has platforms; one in Python runs where Python does.")
    if largest_torque is not None and not native:
        raise edge.InputError("--largest-torque: only a --native FMU has tables; one in Python solves every torque.")
    table = LOSSLESS if losses is None else read_losses(losses)
    offered = Interface(interface, output_inertia, table, crank_inertia=crank_inertia)  # type: ignore[arg-type]
    drive = read_drive(pair_file, surface_file)
    options: dict[str, Any] = {"interface": offered, "fmi_version": fmi_version}
    if not native:
        build_fmu(drive, output, **options)
        return
    from cycloid_fmu.fmu.constants import LARGEST_LOAD
    from cycloid_fmu.native.build import build_native, platforms_of
    from cycloid_fmu.native.tables import PROBES

    if drive.pair.rated_torque is None and largest_torque is None:
        raise edge.InputError(
            f"{pair_file}: [pair] rated_torque is missing; state it: tables reach {LARGEST_LOAD:g} times as far, or "
            "give --largest-torque."
        )
    names = platforms or platforms_of(fmi_version)  # type: ignore[arg-type]
    with commands.Bar("compiling", len(names)) as bar:
        made = build_native(
            drive, output, **options, platforms=names, largest_torque=largest_torque,
            workers=os.cpu_count() or 1, compiled=lambda name: bar.advance(), progress=bar.advance,
            total=lambda count: bar.update(completed=0, total=count, description="crank angles"),
        )  # fmt: skip
    typer.echo(
        f"{output}: {output.stat().st_size / 1e6:.2f} MB, {made.told}; held against the exact model at {PROBES} random "
        "crank angles and torques, the transmission error also around the worst."
    )
