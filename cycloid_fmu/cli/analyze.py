"""`cycloid-fmu analyze`."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import LimitsFile, PairFile, SurfaceFile, leave, print_judged
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.contact.transmission import Transmission
    from cycloid_fmu.drive import Drive
    from cycloid_fmu.supports.figures import Share


def analyze(
    pair_file: PairFile,
    torque: Annotated[
        list[float] | None,
        commands.quantity_option(
            "N*m", "Torque on the output; repeatable. Those of a duty are added.", show_default="the rated torque"
        ),
    ] = None,
    limits_file: LimitsFile = None,
    output: Annotated[Path | None, commands.output_option((".nc",), "OUT.nc", "Write the dataset (netCDF).")] = None,
    plot: commands.PlotFile = None,
    surface_file: SurfaceFile = None,
    as_json: commands.AsJson = False,
    angles: Annotated[int, typer.Option(min=1, help="Number of crank angles from 0, end excluded.")] = ANGLES,
    turns: Annotated[int, typer.Option(min=1, help="Number of crank turns that the angles span.")] = 1,
    slices: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of slices across the face width; adds contact lines and element pressures.",
            show_default=False,
        ),
    ] = None,
    temperature: Annotated[
        str | None,
        typer.Option(
            metavar='"ring = 50 degC, discs = 60 degC"',
            help="Temperatures of ring, pins, discs, carrier and crank, or one for all. Default: as in the file.",
        ),
    ] = None,
) -> None:
    """Compute transmission error, backlash, stiffness, load sharing and pressure over a crank sweep.

    Example: [cyan]cycloid-fmu analyze pair.toml --torque "-181 N*m" --torque "181 N*m" -o out.nc --plot out.png[/]
    """
    asked = None
    if limits_file is not None:
        from cycloid_fmu.studies import limits, verdicts

        asked = limits.read_requirements(limits_file)
    import numpy as np

    from cycloid_fmu.analysis import labelled, notes, solve, step_notes
    from cycloid_fmu.contact.transmission import Interrupted
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.geometry.temperature import parse_temperatures

    drive = read_drive(pair_file, surface_file)
    if temperature is not None:
        drive = drive.replace(temperature=parse_temperatures(temperature, drive.pair.temperature))
    if asked is None:
        torque = torque or [drive.pair.rated_load(str(pair_file))]
    else:
        verdicts.check(asked, drive.pair, str(limits_file), str(pair_file))
        torque = verdicts.loads_of(asked, torque, drive.pair, str(pair_file))
    used = slices or drive.slices
    angle = np.linspace(0.0, 2.0 * np.pi * turns, angles, endpoint=False)
    with commands.progress("crank angles", angles * len(torque)) as progress:
        try:
            found = solve(
                drive,
                torque,
                angle,
                used,
                with_elements=slices is not None,
                workers=os.cpu_count() or 1,
                progress=progress,
            )
        except Interrupted as interrupted:
            found = interrupted.result
    finished = found.crank_angle.size
    if finished < angles:
        typer.echo(f"Interrupted: {finished} of {angles} crank angles are done.", err=True)
    if finished == 0:
        raise typer.Exit(edge.INTERRUPTED)
    judged = None
    if asked is not None and finished == angles:
        judged = verdicts.judge_sweep(drive, asked, found, os.cpu_count() or 1)
    supported = drive.pair.supports is not None and drive.pair.rated_torque is not None
    shares = drive.compliance() if supported and (plot is not None or not as_json) else []
    if output is not None or plot is not None or as_json:
        # Imported here, because loading xarray takes longer than the sweep.
        whole = finished == angles
        data = labelled(drive, found, used, complete=whole)
        if judged is not None:
            data = judged.labelled(data)
        if output is not None:
            edge.write_netcdf(data, output)
        if plot is not None:
            from cycloid_fmu.draw import plots

            if drive.pair.supports is not None:
                plots.save(plots.plot_bearings(data, drive.pair, shares), plot.with_stem(f"{plot.stem}-bearings"))
            figure = plots.plot_analysis(data)
            if judged is not None:
                from cycloid_fmu.draw.verdicts import plot_duty, show_verdicts

                if judged.sliding:
                    plots.save(plot_duty(judged), plot.with_stem(f"{plot.stem}-duty"))
                show_verdicts(figure, judged.verdicts, judged.not_judged)
            plots.save(figure, plot)
            if slices is not None:
                plots.save(plots.plot_lines(data), plot.with_stem(f"{plot.stem}-lines"))
        if as_json:
            arrays: dict[str, Any] = {str(k): v.values for k, v in {**data.coords, **data.data_vars}.items()}
            if "compliance" in arrays:
                parts = arrays.pop("body")
                arrays["compliance"] = {part: arrays["compliance"][..., k] for k, part in enumerate(parts)}
            commands.print_json(arrays | ({} if judged is None else judged.numbers()))
    if not as_json:
        held = "" if drive.first_stage is None else f", ratio {drive.ratio:g}, sun locked"
        warm = "" if drive.pair.temperature is None else f", {drive.pair.temperature}"
        _print(found, f"{pair_file.name}, {finished} crank angles over {turns} turn(s){held}{warm}")
        if drive.pair.bodies is None:
            typer.echo(_RIGID)
        if drive.pair.supports is not None:
            _print_bearings(drive, found, shares)
        if judged is not None:
            print_judged(judged, f"Limits of {limits_file.name if limits_file else ''}")
            if "bearing_life" in judged.not_judged:
                typer.echo("Bearing life needs a bearing of [supports] with its dynamic_capacity.")
            if drive.pair.losses is None and "efficiency" in judged.not_judged:
                typer.echo("Efficiency needs [losses]: no friction stated.")
            if "temperature" in judged.not_judged:
                typer.echo("Temperature needs [supports], [losses] and [thermal].")
    for note in [*notes(drive.stage, found), *step_notes(drive.pair.pins, angles, turns)]:
        typer.echo(f"Note: {note}", err=True)
    if finished < angles:
        raise typer.Exit(edge.INTERRUPTED)
    if judged is not None:
        leave(judged.verdicts, judged.not_judged)


def _print(found: Transmission, title: str) -> None:
    import numpy as np

    from cycloid_fmu.analysis import statistics

    figures = statistics({**vars(found), "backlash": found.backlash[None]})
    rows, deepest = [], found.interference.max() * 1e6
    has_play = np.isfinite(found.backlash).all()  # in clearances of bearings there is, whatever interferes
    for k, load in enumerate(found.torque):
        mean, range_ = (figures[n][k] * edge.ARCSEC for n in ("MTE", "PPTE"))
        play, play_range = (figures[n][0] * edge.ARCSEC for n in ("MB", "PPB"))
        backlash = [f"{play:z.4f}″", f"{play_range:z.4f}″"] if has_play else ["interference", f"{deepest:.3f} µm"]
        count = found.contact_count[k]
        rows.append(
            [
                f"{load:g} N·m",
                f"{mean:z.4f}″",
                f"{range_:z.4f}″",
                *backlash,
                f"{figures['MCS'][k] * 1e-6:.1f} MPa",
                f"{count.min()}–{count.max()}",
            ]
        )
    commands.print_table(title, ["torque", "MTE", "PPTE", "MB", "PPB", "MCS", "pins"], rows)
    typer.echo("Mean and peak-to-peak transmission error and backlash, largest contact pressure, pins in contact.")


_RIGID = (
    "Bodies are rigid, as the file states no [bodies]. Discs with holes are usually 4 to 15 times softer than the "
    "contacts: less stiffness, up to half of the load on other pins, and -28 to +8 % of the largest pressure."
)


def _print_bearings(drive: Drive, found: Transmission, shares: list[Share]) -> None:
    from cycloid_fmu.supports import figures

    for k, load in enumerate(found.torque):
        rows = [
            [
                one.bearing,
                f"{one.largest:.0f} N",
                f"{one.equivalent:.0f} N",
                "-" if math.isnan(one.life) else f"{one.life:.3g}",
            ]
            for one in figures.bearing_loads(drive.pair, found, k)
        ]
        commands.print_table(
            f"Bearings at {load:g} N·m", ["bearing", "largest", "equivalent", "L10, crank turns (ISO 281)"], rows
        )
    if not shares or drive.pair.supports is None:
        return
    whole, rows = 0.0, []
    for share in shares:
        whole += share.compliance
        rows.append(
            [
                share.part,
                f"{share.compliance * 1e6:.4f}",
                f"{1.0 / whole / edge.ARCMIN:.1f}",
                f"{share.lost_motion * edge.ARCMIN:.3f}′",
            ]
        )
    left = figures.remaining(drive.pair.supports, shares)
    if not math.isnan(left):
        rows.append(["rest, up to catalogue", f"{left * 1e6:.4f}", f"{1.0 / (whole + left) / edge.ARCMIN:.1f}", ""])
    commands.print_table(
        "Shares of compliance and lost motion, as drawn" + ("" if drive.pair.temperature is None else ", at 20 °C"),
        ["part", "compliance, µrad/(N·m)", "stiffness up to here, N·m/arcmin", "lost motion"],
        rows,
    )
