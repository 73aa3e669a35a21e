"""`cycloid-fit forecast`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options

if TYPE_CHECKING:
    from fitting.ageing.forecast import Forecast


def forecast(
    history_file: Annotated[
        Path, typer.Argument(metavar="HISTORY.toml", help="Duty, priors and dated recordings (cycloid-history/1).")
    ],
    drive: options.PairFile,
    wear_file: Annotated[
        Path, typer.Option("--wear", metavar="WEAR.toml", help="The wear law (cycloid-wear/1); its k_0 sets the prior.")
    ],
    surface: Annotated[
        Path | None,
        typer.Option(metavar="S.nc", help="Identified surface of the new drive. Default: the errors of the pair file."),
    ] = None,
    until: Annotated[
        float | None,
        commands.quantity_option(
            "s",
            "End of the forecast.",
            show_default="twice the age of the last recording",
            metavar='"20000 h"',
        ),
    ] = None,
    output: Annotated[
        Path | None, commands.output_option((".json",), "FORECAST.json", "Write the forecast (JSON).")
    ] = None,
    plot: commands.PlotFile = None,
    mapping: options.MappingFiles = None,
    twin: Annotated[
        Path | None,
        commands.output_option(
            (".nc",), "TWIN.nc", "Write the drive with its life (netCDF); build --age makes FMUs of it.", "--twin"
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """Estimate the wear coefficient from dated recordings, and predict lost motion, backlash and transmission error.

    Example: [cyan]cycloid-fit forecast history.toml --pair pair.toml --wear wear.toml --until "9000 h" --plot f.png[/]
    """
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.wear.law import read_wear_law
    from fitting.ageing.forecast import as_json as content
    from fitting.ageing.forecast import forecast as forecast_of
    from fitting.ageing.history import measured, read_history

    history, law, new_drive = read_history(history_file), read_wear_law(wear_file), read_drive(drive, surface)
    with commands.status() as step:
        figures = measured(
            history, new_drive, history_file.parent, mapping=mapping, source=str(history_file), progress=step
        )
    with commands.Bar("forecast, percent", 100.0) as bar:
        result = forecast_of(
            new_drive,
            law,
            history,
            figures,
            until=until,
            source=str(history_file),
            progress=lambda share: bar.update(completed=round(100.0 * share)),
        )
    options.write(result, output=output, plot=plot)
    if as_json:
        commands.print_json(content(result))
    else:
        _print(result, law.coefficient is None)
    options.print_notes(result.notes if result.alarm is None else (result.alarm.sentence, *result.notes))
    if twin is not None:
        write_surface(result.aged.surface, twin)


def _print(result: Forecast, regression: bool) -> None:
    from cycloid_fmu.studies.limits import SHOWN
    from fitting.ageing.forecast import INTERVAL

    low, middle, high = result.coefficient(INTERVAL)
    name = "Factor on the regression's wear coefficient" if regression else "Wear coefficient"
    unit = "" if regression else " m²/N"
    typer.echo(f"{name}: {middle:.3g}{unit}, 95 % interval {low:.3g} … {high:.3g}{unit}.")
    if result.bearing:
        low, middle, high = result.growth(INTERVAL) * 3.6e12
        growth = f"grows {middle:.3g} µm in 1000 h, 95 % interval {low:.3g} … {high:.3g} µm."
        typer.echo(f"Clearance of {result.bearing}: {growth}")
    rows, end = [], float(result.ages[-1])
    for name in result.bands:
        unit, factor, _ = SHOWN[name]
        for age in (result.now, end):
            low, middle, high = result.at(name, age, INTERVAL) * factor
            label = f"{name.replace('_', ' ')} [{unit}]"
            rows.append([label, f"{age / 3600.0:.6g}", f"{middle:.3f}", f"{low:.3f} … {high:.3f}"])
    commands.print_table("Figures", ["figure", "age [h]", "median", "95 % interval"], rows)
    rows, columns = [], ["figure", "limit"]
    for name, remaining in result.remaining.items():
        unit, factor, _ = SHOWN[name]
        hours = [("" if math.isfinite(age) else "> ", min(age, end) - result.now) for age in remaining.ages.values()]
        texts = [f"{sign}{max(seconds, 0.0) / 3600.0:.4g} h" for sign, seconds in hours]
        rows.append([name.replace("_", " "), f"{remaining.limit * factor:.4g} {unit}", *texts])
        columns = ["figure", "limit", *(f"with {p:.0%}" for p in remaining.ages)]
    if rows:
        commands.print_table("Remaining life until the limit is exceeded", columns, rows)
