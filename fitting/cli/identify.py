"""`cycloid-fit identify`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options

if TYPE_CHECKING:
    from fitting.estimation.result import Identification


def identify(
    files: options.Recordings,
    drive: options.PairFile,
    mapping: options.MappingFiles = None,
    output: Annotated[Path | None, commands.output_option((".json",), "FIT.json", "Write the fit (JSON).")] = None,
    surface: Annotated[
        Path | None, commands.output_option((".nc",), "S.nc", "Write the identified surface (netCDF).", "--surface")
    ] = None,
    report: Annotated[
        Path | None, commands.output_option((".html",), "FIT.html", "Write a report of the fit.", "--report")
    ] = None,
    plot: commands.PlotFile = None,
    read_head: options.HeadFile = None,
    tolerances: Annotated[
        Path | None,
        typer.Option(
            metavar="T.toml",
            help="Tolerances that set the prior of single pins and teeth, and of the form shared by all teeth.",
        ),
    ] = None,
    profiled: Annotated[
        list[str] | None,
        typer.Option(
            "--profile", metavar="ERROR", help="Compute this error's interval by profile likelihood; repeatable."
        ),
    ] = None,
    form: options.Form = "1 um",
    parameters: Annotated[
        Path | None,
        typer.Option(
            metavar="PARAMETERS.json",
            help="Unknowns to hold, bound, tie or free, as lmfit.Parameters.dump writes them.",
        ),
    ] = None,
    prior: Annotated[
        Path | None,
        typer.Option(metavar="LAST.json", help="Go on from this fit of the drive: its posterior is the prior."),
    ] = None,
    bootstrap: Annotated[
        int, typer.Option(min=0, help="Number of bootstrap resamples of output turns: 0 for none, or from 20.")
    ] = 0,
    as_json: commands.AsJson = False,
) -> None:
    """Fit the drive's errors to recordings at one or more loads, and list the errors that the data cannot resolve.

    The recordings may include hysteresis loops with the input locked: they separate play from friction.

    Example: [cyan]cycloid-fit identify loop.csv *.arrows --pair pair.toml -o fit.json --surface s.nc --plot fit.png[/]
    """
    import fitting
    from cycloid_fmu.drive import read_drive
    from fitting.estimation.result import as_json as content
    from fitting.model.constraints import read_parameters

    options.check_report(report)
    nominal = read_drive(drive)
    recordings = fitting.read_recordings(files, mapping, read_head)
    with commands.status() as progress:
        result = fitting.identify(
            recordings,
            nominal,
            tolerances=tolerances,
            profiled=profiled or (),
            bootstrap=bootstrap,
            form=form,
            parameters=None if parameters is None else read_parameters(parameters),
            prior=prior,
            progress=progress,
        )
    notes = list(result.notes)
    options.write(result, output=output, plot=plot, report=report)
    if surface is not None:
        notes += options.write_drive(
            result.drive, surface, "identified" if result.bearings or result.coefficients else ""
        )
    if as_json:
        commands.print_json(content(result))
        return
    _print(result)
    options.print_notes(notes)


def _print(result: Identification) -> None:
    from fitting.estimation.realised import errors_by_pattern
    from fitting.reports.fit_report import error_rows, held_rows, quality_of

    typer.echo(result.verdict.sentence)
    title = "Identified errors and bearings" if result.bearings else "Identified errors"
    title += ", friction" if result.coefficients else ""
    rows = [row[:4] for row in error_rows(result)]
    commands.print_table(title, ["error", "identified", "95 % interval", "unit"], rows)
    commands.print_table("Held fixed, because the data cannot resolve them", ["error", "why"], held_rows(result))
    for sentence in quality_of(result):
        typer.echo(sentence)
    each = errors_by_pattern(result.pair, result.realised.covariance)
    known = ", ".join(f"{n} {error * 1e6:.3f} µm" for n, error in each.items())
    typer.echo(f"Standard errors of every pin and tooth of this ring, which --output and --report state: {known}.")
