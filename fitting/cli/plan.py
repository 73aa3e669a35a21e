"""`cycloid-fit plan`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu.edge import ARCSEC, commands
from fitting.cli import options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fitting.estimation.plan import Plan


def plan(
    drive: Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The nominal gear pair.")],
    torque: Annotated[
        list[float] | None,
        commands.quantity_option(
            "N*m", "Torque that the bench can apply; repeatable.", show_default="the rated torque"
        ),
    ] = None,
    turns: Annotated[float, typer.Option(min=0.05, help="Output turns of each run.")] = 2.0,
    samples: Annotated[int, typer.Option(min=6, help="Samples per crank turn.")] = 24,
    noise: Annotated[
        float,
        commands.quantity_option(
            "rad",
            "Standard deviation of one sample's transmission error.",
            show_default="0.5 arcsec",
            metavar='"0.5 arcsec"',
        ),
    ] = 0.5 / ARCSEC,
    loop: Annotated[
        float | None,
        commands.quantity_option("N*m", "Add a hysteresis loop to this torque, with the crank locked at pin 0."),
    ] = None,
    plot: commands.PlotFile = None,
    scatter: Annotated[
        float,
        commands.quantity_option(
            "m",
            "Standard deviation of single pins and teeth beyond their low orders.",
            show_default="0.3 um",
            metavar='"0.3 um"',
        ),
    ] = 0.3e-6,
    form: options.Form = "1 um",
    as_json: commands.AsJson = False,
) -> None:
    """Predict before a measurement which errors each set of loads and directions identifies, and how accurately.

    For each set the further run is given that would improve single pins and teeth most.

    Example: [cyan]cycloid-fit plan pair.toml --torque "20 N*m" --torque "200 N*m"[/]
    """
    import fitting
    from cycloid_fmu.drive import read_drive

    nominal = read_drive(drive)
    plans = fitting.plan(
        nominal,
        torque or nominal.pair.rated_load(str(drive)),
        turns=turns,
        samples=samples,
        noise=noise,
        scatter=scatter,
        form=form,
        loop=loop,
    )
    options.write(plans, plot=plot)
    if as_json:
        commands.print_json([dataclasses.asdict(p) for p in plans])
    else:
        _print(plans)


def _print(plans: Sequence[Plan]) -> None:
    from cycloid_fmu.surfaces.structured import unit_of
    from fitting.reports.fit_report import FIELD_UNITS

    rows = []
    for name in [*plans[-1].standard_error, *plans[-1].held]:
        factor, unit = FIELD_UNITS[unit_of(name)]
        known = [f"{p.standard_error[name] * factor:.3f}" if name in p.standard_error else "–" for p in plans]
        rows.append([f"{name} [{unit}]", *known])
    for name in plans[-1].realised:
        rows.append([f"{name}, each [µm]", *(f"{p.realised[name] * 1e6:.3f}" for p in plans)])
    labels = [chr(ord("A") + i) for i in range(len(plans))]
    commands.print_table("Standard error of the errors that each set of runs would identify", ["error", *labels], rows)
    for label, plan in zip(labels, plans, strict=True):
        typer.echo(f"{label}: {plan.runs}; next {plan.next_runs[0].run}")
    further = [[n.run, *(f"{error * 1e6:.3f}" for error in n.realised.values())] for n in plans[-1].next_runs]
    each = [f"{name}, each [µm]" for name in plans[-1].realised]
    commands.print_table("Effect of a further run on every pin and tooth", ["run", *each], further)
    commands.print_table("Held with all runs", ["error", "why"], [list(item) for item in plans[-1].held.items()])
