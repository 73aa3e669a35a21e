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
            'End of the forecast, such as "20000 h"; default: twice the age of the last recording.',
            show_default=False,
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
    import fitting
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.wear.law import read_wear_law
    from fitting.ageing.forecast import as_json as content
    from fitting.ageing.forecast import forecast as foretell
    from fitting.ageing.history import measured, read_history

    history, law, made = read_history(history_file), read_wear_law(wear_file), read_drive(drive, surface)
    with commands.status() as step:
        figures = measured(history, made, history_file.parent, mapping=mapping, source=str(history_file), progress=step)
    with commands.Bar("forecast, percent", 100.0) as bar:
        found = foretell(
            made,
            law,
            history,
            figures,
            until=until,
            source=str(history_file),
            progress=lambda share: bar.update(completed=round(100.0 * share)),
        )
    if output is not None:
        found.write(output)
    if plot is not None:
        fitting.plot(found, plot)
    if as_json:
        commands.print_json(content(found))
    else:
        _print(found, law.coefficient is None)
    options.print_notes(found.notes if found.alarm is None else (found.alarm.sentence, *found.notes))
    if twin is not None:
        write_surface(found.aged.surface, twin)


def _print(found: Forecast, regression: bool) -> None:
    from cycloid_fmu.studies.limits import SHOWN

    low, middle, high = found.coefficient((0.025, 0.5, 0.975))
    name = "Factor on the regression's wear coefficient" if regression else "Wear coefficient"
    unit = "" if regression else " m²/N"
    typer.echo(f"{name}: {middle:.3g}{unit}, 95 % interval {low:.3g} … {high:.3g}{unit}.")
    if found.bearing:
        low, middle, high = found.growth((0.025, 0.5, 0.975)) * 3.6e12
        typer.echo(
            f"Clearance of {found.bearing}: grows {middle:.3g} µm in 1000 h, 95 % interval {low:.3g} … {high:.3g} µm."
        )
    end = float(found.ages[-1])
    rows = []
    for name in found.bands:
        unit, factor, _ = SHOWN[name]
        for age in (found.now, end):
            low, middle, high = found.at(name, age, (0.025, 0.5, 0.975)) * factor
            label = f"{name.replace('_', ' ')} [{unit}]"
            rows.append([label, f"{age / 3600.0:.6g}", f"{middle:.3f}", f"{low:.3f} … {high:.3f}"])
    commands.print_table("Figures", ["figure", "age [h]", "median", "95 % interval"], rows)
    rows = []
    for name, one in found.remaining.items():
        unit, factor, _ = SHOWN[name]
        left = [
            _hours(age - found.now) if math.isfinite(age) else f"> {_hours(end - found.now)}"
            for age in one.ages.values()
        ]
        rows.append([name.replace("_", " "), f"{one.limit * factor:.4g} {unit}", *left])
    if rows:
        probabilities = [f"with {p:.0%}" for p in next(iter(found.remaining.values())).ages]
        commands.print_table("Remaining life until the limit is exceeded", ["figure", "limit", *probabilities], rows)


def _hours(seconds: float) -> str:
    return f"{max(seconds, 0.0) / 3600.0:.4g} h"
