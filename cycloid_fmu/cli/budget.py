"""`cycloid-fmu budget`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import LimitsFile, leave, print_verdicts
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.reducer.stack import Stack


def budget(
    reducer_file: Annotated[Path, typer.Argument(metavar="REDUCER.toml", help="Format cycloid-reducer/1.")],
    samples: Annotated[int, typer.Option(min=100, help="Number of reducers drawn within the tolerances.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same reducers.")] = 1,
    limits_file: LimitsFile = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Lost motion budget of an RV reducer: each term by closed form and by the contact model, and the scatter.

    Example: [cyan]cycloid-fmu budget rv.toml --plot budget.png[/]
    """
    from cycloid_fmu.reducer import lost_motion as rv
    from cycloid_fmu.reducer.description import contradictions, read_reducer, values_of
    from cycloid_fmu.reducer.stack import stack as scattered
    from cycloid_fmu.reducer.stack import stack_summary

    reducer = read_reducer(reducer_file)
    asked = None
    if limits_file is not None:
        from cycloid_fmu.studies.limits import judge_budget, not_judged, read_requirements

        asked = read_requirements(limits_file).limits
    warnings = contradictions(reducer, str(reducer_file))
    found = rv.budget(reducer)
    remarks = rv.remarks(reducer, found)
    with commands.progress("reducers", samples) as progress:
        stack = scattered(reducer, samples, seed, progress)
    scatter = None if stack is None else stack_summary(stack)
    verdicts, missing = [], []
    if asked is not None:
        upper = None if scatter is None else scatter["monte_carlo"]["geometric"]["central"][1]
        verdicts = judge_budget(asked, found["geometric_sun_locked"]["total"], upper)
        missing = not_judged(asked, verdicts)
    if plot is not None:
        from cycloid_fmu.draw import plots

        figure = plots.plot_budget(found, stack)
        if verdicts:
            from cycloid_fmu.draw.verdicts import show_verdicts

            show_verdicts(figure, verdicts)
        plots.save(figure, plot)
    if as_json:
        judged = {"verdicts": [one.numbers() for one in verdicts], "not_judged": missing} if asked else {}
        commands.print_json(
            {**found, "ratio": reducer.ratio, "stack": scatter, "remarks": remarks, "warnings": warnings, **judged}
        )
        leave(verdicts, missing)
        return
    values, closed = values_of(reducer), found["standard"]
    terms = sorted((n for n in rv.TERMS if any(v[n] for v in found.values())), key=lambda n: -abs(closed[n]))
    rows = []
    for name in (*terms, "interaction", *rv.STAGES, "total"):
        amount = f"{values[name] * 1e6:+.2f} µm" if name in terms else ""
        plays = [f"{found[v][name] * edge.ARCMIN:+.5f}" if name in found[v] else "" for v in rv.VARIANTS]
        rows.append([name, amount, *plays])
    columns = ["term", "amount", *(v.replace("_", " ") for v in rv.VARIANTS)]
    commands.print_table(f"{reducer_file.name}: play at the output [arcmin], ratio {reducer.ratio:g}", columns, rows)
    exact = found["geometric"]
    if exact["interference"] > 0.0:
        typer.echo(
            f"Interference: no free position at {exact['interfering']:.0%} of the crank angles, up to "
            f"{exact['interference'] * 1e6:.2f} µm."
        )
    for name, remark in remarks.items():
        typer.echo(f"{name}: {remark}.")
    if stack is None:
        typer.echo("No deviation has a tolerance, so there is no Monte Carlo stack.")
    else:
        _print_stack(stack, samples)
    for warning in warnings:
        typer.echo(warning, err=True)
    if asked is not None and limits_file is not None:
        print_verdicts(f"Limits of {limits_file.name}", verdicts, missing)
    leave(verdicts, missing)


def _print_stack(stack: Stack, samples: int) -> None:
    from cycloid_fmu.reducer.stack import stack_summary

    shown = stack_summary(stack)
    rows = []
    for name in ("worst_case", "root_sum_square"):
        rows.append([name.replace("_", " "), *(f"{v * edge.ARCMIN:.4f}" for v in shown[name]), "", ""])
    for name in stack.samples:
        one = shown["monte_carlo"][name]
        low, high = one["interval"]
        rows.append(
            [
                f"Monte Carlo, {name}",
                *(f"{v * edge.ARCMIN:.4f}" for v in (*one["central"], one["mean"])),
                f"{one['interfering']:.1%} ({low:.1%} … {high:.1%})",
            ]
        )
    columns = ["stack", "from", "to", "mean", "interference (95 %)"]
    commands.print_table("Total play within the tolerances [arcmin]", columns, rows)
    typer.echo(f"Monte Carlo: {samples} reducers, their central 99.73 %; geometric: with the sun locked.")
