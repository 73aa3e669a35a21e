"""`cycloid-fmu sweep`."""

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
    import xarray as xr

    from cycloid_fmu.drive import Drive


def sweep(
    pair_file: PairFile,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar='"NAME=2.5:3.5:11 mm"',
            help="A value of the pair file with its range and number of values, or a list "
            '"NAME=2.5, 3 mm"; repeatable.',
        ),
    ],
    torque: Annotated[
        list[float] | None,
        commands.quantity_option("N*m", "Torque on the output; repeatable.", show_default="the rated torque"),
    ] = None,
    crank_speed: Annotated[
        float,
        commands.quantity_option("rad/s", "Crank speed, for the efficiency by \\[losses].", show_default="at rest"),
    ] = 0.0,
    output: Annotated[
        Path | None,
        commands.output_option(
            (".csv", ".parquet", ".nc"),
            "TABLE.csv|parquet|nc",
            "Output file; until it is complete, partial results are in a file next to it.",
        ),
    ] = None,
    plot: commands.PlotFile = None,
    surface_file: SurfaceFile = None,
    angles: Annotated[int, typer.Option(min=20, help="Number of crank angles from 0, end excluded.")] = ANGLES,
    turns: Annotated[int, typer.Option(min=1, help="Number of crank turns that the angles span.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = os.cpu_count() or 1,
    as_json: commands.AsJson = False,
) -> None:
    """Solve a drive for every combination of several values of its pair file; gives a table, lines and maps.

    With an output file, repeating the command resumes an interrupted run.

    Example: [cyan]cycloid-fmu sweep pair.toml --vary "pin_radius=2.5:3.5:11 mm" --torque "181 N*m" -o table.csv[/]
    """
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.studies.sweep import vary_of

    given: dict[str, str] = {}
    for each in vary:
        name, is_given, values = each.partition("=")
        if not is_given or name.strip() in given:
            problem = "it is varied twice" if is_given else 'write NAME=VALUES, such as "pin_radius=2.5:3.5:11 mm"'
            raise edge.ArgumentError("vary", problem, each)
        given[name.strip()] = values.strip()
    drive = read_drive(pair_file, surface_file)
    torque = torque or [drive.pair.rated_load(str(pair_file))]
    size = math.prod(len(one.values) for one in vary_of(given))  # type: ignore[arg-type]
    with commands.progress("drives", size) as progress:
        data = drive.sweep(
            given,
            torque,
            output,
            angles=angles,
            turns=turns,
            crank_speed=crank_speed,
            workers=workers,
            progress=progress,
        )
    if plot is not None:
        from cycloid_fmu.draw import plots, sweeps

        plots.save(sweeps.plot_sweep(data), plot)
    if as_json:
        commands.print_json({str(k): v.values for k, v in {**data.coords, **data.data_vars}.items()})
    else:
        _print(data, f"{pair_file.name}: {size} drives")
    _print_notes(drive, data, angles, turns)


def _print_notes(drive: Drive, data: xr.Dataset, angles: int, turns: int) -> None:
    """Print a note for drives that are tilted beyond first order, and for angles in step with the pins."""
    from cycloid_fmu.analysis import step_notes, tilt_notes

    tilt = {"xz": abs(drive.displacements["tilt_x"]), "yz": abs(drive.displacements["tilt_y"])}
    for plane in tilt:
        if (name := f"errors.misalignment_{plane}") in data.coords:
            tilt[plane] = float(abs(data[name]).max())
    tilted = tilt_notes(drive, math.hypot(*tilt.values()), "Drives of this sweep are tilted by up to")
    for note in [*tilted, *step_notes(drive.pair.pins, angles, turns)]:
        typer.echo(f"Note: {note}", err=True)


def _print(data: xr.Dataset, title: str) -> None:
    from cycloid_fmu.studies.sweep import figures_in
    from cycloid_fmu.studies.sweep_files import SHOWN, label_of, shown_values, varied_names, with_free_positions

    def where(place: dict[str, int]) -> str:
        shown = []
        for name in varied_names(data):
            values, unit = shown_values(data, name)
            shown.append(f"{name} {values[place[name]]:g}{'' if unit == '1' else f' {unit}'}")
        return ", ".join(shown)

    rows, every = [], data["reason"].values
    data = with_free_positions(data)
    for name in figures_in(data):
        unit, factor = SHOWN[data[name].attrs["units"]]
        for load in data["torque"].values if "torque" in data[name].dims else [None]:
            values = data[name] if load is None else data[name].sel(torque=load)
            if not values.notnull().any():
                continue
            ends = [{str(d): int(k) for d, k in found.items()} for found in (values.argmin(...), values.argmax(...))]
            shown = [f"{float(values[place]) * factor:.5g}" for place in ends]
            at = "" if load is None else f"{load:g} N·m"
            if shown[0] == shown[1]:
                rows.append([label_of(name, unit), at, "all", shown[0], ""])
                continue
            rows.append([label_of(name, unit), at, "smallest", shown[0], where(ends[0])])
            rows.append(["", "", "largest", shown[1], where(ends[1])])
    commands.print_table(title, ["figure", "torque", "", "value", "at"], rows)
    if reasons := list(dict.fromkeys(str(reason) for reason in every.ravel() if reason)):
        rest = f" ({len(reasons) - 1} more in the output)" if len(reasons) > 1 else ""
        missing = f"{int((every != '').sum())} of {every.size}"
        typer.echo(f"{missing} drives are not shown or incomplete: {reasons[0]}{rest}.", err=True)
