"""Options and printing shared by the commands of `cycloid-fit`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.drive import Drive
    from fitting.figures.figure import Figure
    from fitting.figures.metrics import Figures

Recordings = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings in any supported format.")]
PairFile = Annotated[Path, typer.Option("--pair", metavar="PAIR.toml", help="The nominal gear pair.")]
MaybePair = Annotated[Path | None, typer.Option("--pair", metavar="PAIR.toml", help="The nominal gear pair.")]
HeadFile = Annotated[
    Path | None,
    typer.Option(metavar="HEAD.toml", help="Correct the output angle for the coaxiality error of a single read head."),
]
Ratio = Annotated[float | None, commands.ratio_option("Instead of a pair.")]
RatedTorque = Annotated[float | None, commands.quantity_option("N*m", "Rated torque at the output.")]
InstrumentsFile = Annotated[
    Path | None,
    typer.Option(
        "--instruments",
        metavar="INSTRUMENTS.toml",
        help="Instruments of the bench, for uncertainty budgets by the GUM.",
    ),
]
StiffnessLimits = Annotated[
    str | None,
    typer.Option(
        "--stiffness-limits",
        metavar="TORQUES",
        help='Torque limits of the stiffness ranges K1, K2, ..., such as "5 N*m, 25 N*m, 80 N*m, 167 N*m".',
    ),
]
Form = Annotated[
    str, typer.Option(metavar="LENGTH", help="Expected form error shared by all flanks; 0 um if the form is known.")
]
MappingFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--mapping",
        metavar="MAP.toml",
        help="Mapping of the channels, see inspect; repeatable: each file takes the one whose columns it has.",
    ),
]


def check_report(target: Path | None) -> None:
    """Refuse a report in HTML before anything is computed, if the package that it needs is missing."""
    if target is not None and target.suffix.lower() == ".html":
        from fitting.reports.page import script

        script()


def drive_or_ratio(pair: Path | None, ratio: float | None) -> Drive | float | None:
    """Return the drive of --pair, or the ratio of --ratio, or None; refuse both."""
    from cycloid_fmu.drive import read_drive

    if pair is None:
        return ratio
    if ratio is not None:
        raise edge.InputError("--pair and --ratio: give one of the two; the pair states its ratio.")
    return read_drive(pair)


def figures_of(files: list[Path], pair: Path | None, mapping: list[Path] | None, **settings: Any) -> Figures:
    """Return the figures of recordings, with the settings of `fitting.metrics`."""
    import fitting
    from cycloid_fmu.drive import read_drive

    drive = None if pair is None else read_drive(pair)
    recordings = fitting.read_recordings(files, mapping)
    with commands.status() as progress:
        return fitting.metrics(recordings, drive, progress=progress, **settings)


def write(result: Any, *, output: Path | None = None, plot: Path | None = None, report: Path | None = None) -> None:
    """Write the files of a result that the options of a command name: itself, its picture and its report."""
    import fitting

    if output is not None:
        result.write(output)
    if plot is not None:
        fitting.plot(result, plot)
    if report is not None:
        fitting.report(result, report)


def write_drive(drive: Drive, surface: Path, bearings: str) -> list[str]:
    """Write the surface of a drive; with `bearings` ("updated", …) that differ from the pair file's, its pair too.

    A surface belongs to one pair. Returns a note on the pair's file.
    """
    from cycloid_fmu.geometry.pair import write_pair

    drive.write(surface)
    if not bearings:
        return []
    pair_file = surface.with_suffix(".toml")
    write_pair(drive.pair.nominal, pair_file)
    return [f"{pair_file}: the pair with its {bearings} bearings, to which {surface} belongs."]


def print_notes(notes: Iterable[str]) -> None:
    """Print notes for people on standard error."""
    for note in notes:
        typer.echo(note, err=True)


def print_figures(title: str, figures: Mapping[str, Figure]) -> None:
    """Print a table of figures with their parts, and the remarks on them."""
    from fitting.figures.figure import in_field_units

    rows = []
    for name, figure in figures.items():
        for label, shown in {name: figure, **{f"  {part}": of for part, of in figure.shown.items()}}.items():
            rows.append([label, *in_field_units(shown), f"{shown.count:.4g} {shown.counted}"])
    commands.print_table(title, ["figure", "value", "± 95 %", "unit", "of"], rows)
    for name, figure in figures.items():
        if figure.remark:
            typer.echo(f"{name}: {figure.remark}.")


def finish(figures: Figures, *, as_json: bool) -> None:
    """Print figures and notes for people, or the figures for scripts; exit with their status."""
    from fitting.figures.budget import BUDGET_HEAD, budget_rows
    from fitting.figures.figure import in_field_units
    from fitting.figures.loop_groups import GROUPS_HEAD, group_rows
    from fitting.figures.metrics import figures_json
    from fitting.figures.orders import ORDERS_HEAD, order_rows

    if as_json:
        commands.print_json(figures_json(figures))
    elif figures.shown:
        print_figures("Figures", figures.shown)
        if len(figures.loop_groups) > 1:
            commands.print_table("Loops by size and position", GROUPS_HEAD, group_rows(figures.loop_groups))
        if figures.play_range is not None:
            low, high = ("{} ± {} {}".format(*in_field_units(end)) for end in figures.play_range)
            typer.echo(f"Play over the positions of the loops, without friction: {low} to {high}.")
        if figures.orders:
            commands.print_table(
                "Largest orders of the transmission error, per output turn", ORDERS_HEAD, order_rows(figures.orders)
            )
        for name, budget in figures.budgets.items():
            commands.print_table(f"Uncertainty budget of {name}", BUDGET_HEAD, budget_rows(budget))
    print_notes(figures.problems if as_json and figures.figures else figures.notes)
    if figures.problems:
        raise typer.Exit(edge.INTERRUPTED if figures.interrupted else edge.BAD_INPUT)
    if not figures.figures:
        raise edge.NoDataError("No figure could be computed.")
