"""`cycloid-fmu budget`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import LimitsFile, leave, print_verdicts
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.reducer.description import Reducer
    from cycloid_fmu.reducer.stack import Stack
    from cycloid_fmu.studies.limits import Verdict

_Terms = dict[str, dict[str, float]]


def budget(
    reducer_file: Annotated[
        Path, typer.Argument(metavar="REDUCER.toml", help="The RV reducer (format cycloid-reducer/1).")
    ],
    samples: Annotated[int, typer.Option(min=100, help="Number of reducers drawn within the tolerances.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same reducers.")] = 1,
    limits_file: LimitsFile = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Compute the lost motion budget of an RV reducer: terms by closed form and by the contact model, and the scatter.

    Example: [cyan]cycloid-fmu budget rv.toml --plot budget.png[/]
    """
    from cycloid_fmu.reducer import lost_motion
    from cycloid_fmu.reducer.description import contradictions, read_reducer
    from cycloid_fmu.reducer.stack import stack as scattered
    from cycloid_fmu.reducer.stack import stack_summary
    from cycloid_fmu.studies.limits import judge_budget, not_judged, read_requirements

    reducer = read_reducer(reducer_file)
    limits = None if limits_file is None else read_requirements(limits_file).limits
    warnings = contradictions(reducer, str(reducer_file))
    terms = lost_motion.budget(reducer)
    remarks = lost_motion.remarks(reducer, terms)
    with commands.progress("reducers", samples) as progress:
        stack = scattered(reducer, samples, seed, progress)
    scatter = None if stack is None else stack_summary(stack)
    verdicts, missing = [], []
    if limits is not None:
        upper = None if scatter is None else scatter["monte_carlo"]["geometric"]["central"][1]
        verdicts = judge_budget(limits, terms["geometric_sun_locked"]["total"], upper)
        missing = not_judged(limits, verdicts)
    if plot is not None:
        _plot(terms, stack, verdicts, missing, plot)
    if as_json:
        judged = {"verdicts": [one.numbers() for one in verdicts], "not_judged": missing} if limits else {}
        commands.print_json(
            {**terms, "ratio": reducer.ratio, "stack": scatter, "remarks": remarks, "warnings": warnings, **judged}
        )
    else:
        _print_terms(reducer, terms, reducer_file.name)
        for name, remark in remarks.items():
            typer.echo(f"{name}: {remark}.")
        if stack is None:
            typer.echo("No deviation has a tolerance, so there is no Monte Carlo stack.")
        else:
            _print_stack(stack, samples)
        for warning in warnings:
            typer.echo(warning, err=True)
        if limits_file is not None:
            print_verdicts(f"Limits of {limits_file.name}", verdicts, missing)
    leave(verdicts, missing)


def _plot(terms: _Terms, stack: Stack | None, verdicts: list[Verdict], missing: list[str], plot: Path) -> None:
    from cycloid_fmu.draw import plots
    from cycloid_fmu.draw.verdicts import show_verdicts

    figure = plots.plot_budget(terms, stack)
    plots.save(show_verdicts(figure, verdicts, missing), plot)


def _print_terms(reducer: Reducer, terms: _Terms, title: str) -> None:
    """Print each term's amount and play, the largest first, and the interference."""
    from cycloid_fmu.reducer.description import values_of
    from cycloid_fmu.reducer.lost_motion import STAGES, TERMS, VARIANTS

    values, closed = values_of(reducer), terms["standard"]
    names = sorted((n for n in TERMS if any(plays[n] for plays in terms.values())), key=lambda n: -abs(closed[n]))
    rows = []
    for name in (*names, "interaction", *STAGES, "total"):
        amount = f"{values[name] * 1e6:+.2f} µm" if name in names else ""
        plays = [f"{terms[v][name] * edge.ARCMIN:+.5f}" if name in terms[v] else "" for v in VARIANTS]
        rows.append([name, amount, *plays])
    columns = ["term", "amount", *(v.replace("_", " ") for v in VARIANTS)]
    commands.print_table(f"{title}: play at the output [arcmin], ratio {reducer.ratio:g}", columns, rows)
    exact = terms["geometric"]
    if exact["interference"] > 0.0:
        typer.echo(
            f"Interference: no free position at {exact['interfering']:.0%} of the crank angles, up to "
            f"{exact['interference'] * 1e6:.2f} µm."
        )


def _print_stack(stack: Stack, samples: int) -> None:
    from cycloid_fmu.reducer.stack import stack_summary

    shown = stack_summary(stack)
    rows = []
    for name in ("worst_case", "root_sum_square"):
        rows.append([name.replace("_", " "), *(f"{v * edge.ARCMIN:.4f}" for v in shown[name]), "", ""])
    for name in stack.samples:
        drawn = shown["monte_carlo"][name]
        low, high = drawn["interval"]
        rows.append(
            [
                f"Monte Carlo, {name}",
                *(f"{v * edge.ARCMIN:.4f}" for v in (*drawn["central"], drawn["mean"])),
                f"{drawn['interfering']:.1%} ({low:.1%} … {high:.1%})",
            ]
        )
    columns = ["stack", "from", "to", "mean", "interference (95 %)"]
    commands.print_table("Total play within the tolerances [arcmin]", columns, rows)
    typer.echo(f"Monte Carlo: {samples} reducers, their central 99.73 %; geometric: with the sun locked.")
