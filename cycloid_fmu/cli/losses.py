"""`cycloid-fmu losses`."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PairFile, SurfaceFile
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive
    from cycloid_fmu.losses.figures import LossFigures
    from cycloid_fmu.losses.heat import Heat


def losses(
    pair_file: PairFile,
    crank_speed: Annotated[
        float, commands.quantity_option("rad/s", 'Crank speed, in both directions; "0 rpm" for friction at rest.')
    ],
    torque: Annotated[
        list[float] | None,
        commands.quantity_option("N*m", "Torque on the output; repeatable.", show_default="the rated torque"),
    ] = None,
    output: Annotated[Path | None, commands.output_option((".nc",), "OUT.nc", "Write the dataset (netCDF).")] = None,
    plot: commands.PlotFile = None,
    map_file: Annotated[
        Path | None,
        commands.output_option(
            edge.PICTURES, "FILE.png|pdf", "Draw the efficiency over torque and speed, up to the given ones.", "--map"
        ),
    ] = None,
    duty_file: Annotated[
        Path | None,
        typer.Option(
            "--duty",
            metavar="REQUIREMENTS.toml",
            help="Heat over this duty (cycloid-requirements/1), in place of each torque; it needs a thermal table.",
        ),
    ] = None,
    surface_file: SurfaceFile = None,
    as_json: commands.AsJson = False,
    angles: Annotated[int, typer.Option(min=1, help="Number of crank angles from 0, end excluded.")] = ANGLES,
    turns: Annotated[int, typer.Option(min=1, help="Number of crank turns that the angles span.")] = 1,
) -> None:
    """Compute efficiency, losses by part, and torques to start, run and drive backwards, with stated friction.

    With a thermal table also how warm the drive gets, and how fast; exit status 4 above its largest temperature.

    Example: [cyan]cycloid-fmu losses pair.toml --crank-speed "600 rpm" --torque "181 N*m" --plot losses.png[/]
    """
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.losses.solver import losses_of

    if map_file is not None and crank_speed == 0.0:
        raise edge.ArgumentError("crank_speed", "a map over speeds needs one above zero", "0 rad/s")
    drive = read_drive(pair_file, surface_file)
    losses_of(drive, str(pair_file))
    loads = torque or [drive.pair.rated_load(str(pair_file))]
    with commands.progress("crank angles", 2 * angles * len(loads)) as progress:
        found = drive.losses(loads, crank_speed, angles=angles, turns=turns, progress=progress)
    if output is not None:
        from cycloid_fmu.analysis import labelled_losses

        edge.write_netcdf(labelled_losses(drive, found), output)
    if plot is not None or map_file is not None:
        from cycloid_fmu.draw.losses import plot_heat, plot_losses, plot_map, save

        if plot is not None:
            save(plot_losses(found), plot)
        if map_file is not None:
            from cycloid_fmu.losses.figures import efficiency_map

            drawn = efficiency_map(drive, max(map(abs, loads)), crank_speed, found.crank_angle, os.cpu_count() or 1)
            save(plot_map(drawn), map_file)
    warm = _heat(drive, loads, crank_speed, duty_file, (angles, turns), str(pair_file))
    if plot is not None and warm:
        save(plot_heat(warm), plot.with_stem(f"{plot.stem}-heat"))
    if as_json:
        commands.print_json(found.numbers() | ({"thermal": [each.numbers() for each in warm]} if warm else {}))
    else:
        _print(drive, found, pair_file.name)
        _print_heat(warm)
    if any(each.too_warm for each in warm):
        raise typer.Exit(edge.NOT_MET)


def _heat(
    drive: Drive, loads: list[float], crank_speed: float, duty_file: Path | None, sweep: tuple[int, int], source: str
) -> list[Heat]:
    """Return how warm the drive gets over the duty, or at each torque at the speed; nothing without [thermal]."""
    from cycloid_fmu.losses.heat import SCANNED, thermal_of

    if duty_file is not None:
        thermal_of(drive, source)
    if drive.pair.thermal is None or (duty_file is None and crank_speed == 0.0):
        return []
    angles, turns = sweep
    with commands.progress("temperatures", SCANNED * (1 if duty_file else len(loads))) as progress:
        if duty_file is not None:
            return [drive.heat(requirements=duty_file, angles=angles, turns=turns, progress=progress)]
        return [drive.heat(load, crank_speed, angles=angles, turns=turns, progress=progress) for load in loads]


def _print_heat(warm: list[Heat]) -> None:
    from cycloid_fmu.losses.heat import SHARES

    rows = []
    for each in warm:
        (torque, speed, _), several = each.running[0], len(each.running) > 1
        load = "the duty" if several else f"{torque:g} N·m, {speed * 30.0 / math.pi:.4g} rpm"
        times = [each.time_to(share) for share in SHARES]
        minutes = ["" if math.isnan(time) else f"{time / 60.0:.3g} min" for time in times]
        if each.reason:
            rows.append([load, "none"])
            continue
        efficiency = ", ".join("-" if math.isnan(value) else f"{value:.2%}" for value in each.efficiency)
        degrees = [f"{kelvin - 273.15:.1f} °C" for kelvin in (each.oil, each.housing)]
        rows.append([load, *degrees, f"{each.power:.3g} W", efficiency, *minutes])
    if rows:
        head = ["load", "oil", "housing", "heat", "efficiency", "63 % warm", "95 % warm"]
        commands.print_table("Steady temperature", head, [row + [""] * (len(head) - len(row)) for row in rows])
    for each, row in zip(warm, rows, strict=True):
        if each.reason:
            typer.echo(f"At {row[0]} no temperature is steady: {each.reason}.")
        if each.others:
            typer.echo(f"At {row[0]} it would get still warmer above {each.others[0] - 273.15:.4g} °C of the oil.")
        if each.ends:
            ends = ["none" if end.reason else f"{end.oil - 273.15:.1f} °C" for end in each.ends]
            typer.echo(f"Within the ranges of the friction the oil at {row[0]} is at {' to '.join(ends)}.")
        if each.too_warm and each.thermal.largest is not None:
            typer.echo(f"At {row[0]} the oil is warmer than the largest {each.thermal.largest - 273.15:g} °C.")


def _print(drive: Drive, found: LossFigures, name: str) -> None:
    from cycloid_fmu.geometry.friction_values import VALUES

    rpm = found.crank_speed * 30.0 / math.pi
    rows = []
    for case in found.cases:
        efficiency = "jams" if case.jams else "-" if math.isnan(case.efficiency) else f"{case.efficiency:.2%}"
        parts = [f"{value:.4g}" if value else "" for value in case.loss.values()]
        mode = case.mode + (", self-locking" if case.self_locking else "")
        rows.append([f"{case.torque:g} N·m", f"{case.direction:+d}", mode, efficiency, *parts, f"{case.heat:.3g} W"])
    used = [k for k in range(len(rows[0])) if k < 4 or any(row[k] for row in rows)]
    columns = ["torque", "crank", "mode", "efficiency", *(p.replace("_", " ") for p in found.cases[0].loss), "heat"]
    commands.print_table(
        f"{name}: losses [J per rad of the crank] at {rpm:.4g} rpm of the crank",
        [columns[k] for k in used],
        [[row[k] for k in used] for row in rows],
    )
    if found.ends and drive.pair.losses is not None:
        for table, name_ in drive.pair.losses.from_table.items():
            value = VALUES[name_]
            typer.echo(f"[losses.{table}] {name_}: {value.low:g} to {value.high:g} ({value.source}).")
        for case, *ends in zip(found.cases, *(end.cases for end in found.ends), strict=True):
            if not math.isnan(case.efficiency):
                high, low = ("jams" if end.jams else f"{end.efficiency:.1%}" for end in ends)
                typer.echo(f"Within these ranges the {case.mode} efficiency at {case.torque:g} N·m is {low} to {high}.")
    shaft = "crank" if drive.first_stage is None else "sun"
    typer.echo(f"Without load the {shaft} takes {found.no_load_running_torque:.4g} N·m at this speed.")
    for load, each in found.starting.items():
        against = f"against {load:g} N·m" if load else "without load"
        takes = "jams at a crank angle" if math.isnan(each.max()) else f"takes up to {each.max():.4g} N·m"
        typer.echo(f"To start {against}, the {shaft} {takes}.")
    if math.isnan(found.back_driving_torque):
        typer.echo(f"No torque up to {found.searched_to:g} N·m on the output turns the drive at every crank angle.")
    else:
        typer.echo(f"{found.back_driving_torque:.4g} N·m on the output turn the drive backwards from rest.")
    for hysteresis in found.friction_hysteresis:
        if not math.isnan(hysteresis["value"]):
            apart = hysteresis["value"] * edge.ARCSEC
            typer.echo(
                f"Between the two directions the output differs by {apart:.3g}″ at {hysteresis['torque']:g} N·m."
            )
