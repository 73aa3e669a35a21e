"""`cycloid-fmu joint`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import SurfaceFile
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.joint.document import Joint, Number


def joint(
    output: Annotated[Path, commands.output_option((".json",), "JOINT.json", "The joint document (cycloid-joint/1).")],
    pair_file: Annotated[
        Path | None,
        typer.Argument(metavar="[PAIR.toml]", help="The gear pair, or an RV reducer; none where --figures state all."),
    ] = None,
    surface_file: SurfaceFile = None,
    figures: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Numbers that replace the drive's own: stated or measured (cycloid-joint-figures/1), loops (metrics "
            "-o), friction (cycloid-friction/1, or friction -o as JSON); repeatable, the last one counts.",
        ),
    ] = None,
    rotor_inertia: Annotated[
        float | None,
        commands.quantity_option("kg*m^2", "Inertia of the rotor, at the motor.", metavar='"1e-4 kg*m^2"'),
    ] = None,
    tolerances_file: Annotated[
        Path | None,
        typer.Option(
            "--tolerances",
            metavar="T.toml",
            help="Draw drives within these tolerances (cycloid-tolerances/1), not from a fit.",
        ),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Number of draws in draws.csv.", show_default="100 with a fit or tolerances"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same drives.")] = 0,
    orders: Annotated[int, typer.Option(min=1, max=32, help="Number of orders of transmission error and of play.")] = 5,
    arm_inertia: Annotated[
        float,
        commands.quantity_option("kg*m^2", "Inertia of the arm in the files of simulators.", show_default="1 kg*m^2"),
    ] = 1.0,
    mjcf: Annotated[
        Path | None,
        commands.output_option((".xml",), "ARM.xml", "Write MuJoCo models, without and with play.", "--mjcf"),
    ] = None,
    urdf: Annotated[
        Path | None, commands.output_option((".urdf",), "ARM.urdf", "Write a URDF with ros2_control.", "--urdf")
    ] = None,
    isaac: Annotated[
        Path | None, commands.output_option((".py",), "ARM.py", "Write an actuator for Isaac Lab.", "--isaac")
    ] = None,
    drake: Annotated[
        Path | None, commands.output_option((".urdf",), "ARM.urdf", "Write a URDF for Drake.", "--drake")
    ] = None,
    bam: Annotated[Path | None, commands.output_option((".json",), "m5.json", "Write BAM's model m5.", "--bam")] = None,
    runtime: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Write the run-time for use with MuJoCo or Drake; it does not need this package."
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """Describe the drive as a joint of a robot simulator, with intervals and origins, and write it for simulators.

    Example: [cyan]cycloid-fmu joint pair.toml --rotor-inertia "1e-4 kg*m^2" -o joint.json --runtime arm[/]
    """
    from cycloid_fmu.joint.files import write_file
    from cycloid_fmu.joint.runtime import write_runtime

    found = _joint(pair_file, surface_file, figures or [], rotor_inertia, tolerances_file, draws, seed, orders)
    found.write(output)
    targets = {"mjcf": mjcf, "urdf": urdf, "isaac": isaac, "drake": drake, "bam": bam}
    for target, path in targets.items():
        if path is not None:
            write_file(found, target, path, arm_inertia)
    if runtime is not None:
        write_runtime(found, runtime)
    if as_json:
        commands.print_json(found.document)
    else:
        _print(found, output)


def _joint(
    pair_file: Path | None,
    surface_file: Path | None,
    figures: list[Path],
    rotor_inertia: float | None,
    tolerances_file: Path | None,
    draws: int | None,
    seed: int,
    orders: int,
) -> Joint:
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.joint.of_parts import Settings, joint_of

    given = {} if rotor_inertia is None else {"rotor_inertia": rotor_inertia}
    if pair_file is None:
        for name, value in (("surface", surface_file), ("tolerances", tolerances_file)):
            if value is not None:
                raise edge.ArgumentError(name, "needs a gear pair, PAIR.toml", str(value))
        return joint_of(None, figures, given, Settings(draws=draws, seed=seed))
    drive = read_drive(pair_file, surface_file)
    drive.pair.rated_load(str(pair_file))
    several = tolerances_file is not None or drive.surface.covariance is not None
    with commands.progress("drives", 1 + (draws or 100) * several) as progress:
        return drive.joint(
            files=figures,
            stated=given,
            tolerances=tolerances_file,
            draws=draws,
            seed=seed,
            orders=orders,
            progress=progress,
        )


def _print(found: Joint, output: Path) -> None:
    from cycloid_fmu.joint import joint_drive

    rows = [_row(found, name) for name in joint_drive.SCALARS]
    commands.print_table(f"{output.name}: the drive as a joint, SI", ["number", "value", "95 %", "origin"], rows)
    for text in found.not_represented:
        typer.echo(f"Not represented: {text[0].lower()}{text[1:]}")
    if found.rows:
        typer.echo(f"draws.csv: {len(found.rows) - 1} draws after the most likely values.")


def _row(found: Joint, name: str) -> list[str]:
    number: Number = found.numbers[name]
    if number["value"] is None:
        return [name, "unknown", "", number["reason"]]
    interval = "" if number["interval"] is None else " … ".join(f"{end:.5g}" for end in number["interval"])
    return [name, f"{number['value']:.6g}", interval, number["origin"]]
