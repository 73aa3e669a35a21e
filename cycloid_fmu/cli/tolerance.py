"""`cycloid-fmu tolerance`."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cycloid_fmu.cli.shared import LimitsFile, PairFile, TolerancesFile, leave, print_verdicts
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES

if TYPE_CHECKING:
    from cycloid_fmu.studies.allocation import Allocation
    from cycloid_fmu.studies.limits import Verdict
    from cycloid_fmu.studies.tolerance import Study
    from cycloid_fmu.studies.yields import Findings


def tolerance(
    pair_file: PairFile,
    tolerances_file: TolerancesFile,
    torque: Annotated[
        list[float] | None,
        commands.quantity_option("N*m", "Torque on the output; repeatable.", show_default="± the rated torque"),
    ] = None,
    samples: Annotated[int, typer.Option(min=2, help="Number of drives.")] = 1000,
    limits_file: LimitsFile = None,
    output: Annotated[
        Path | None,
        commands.output_option(
            (".nc",), "STUDY.nc", "Write the study (netCDF); until it is complete, partial results are next to it."
        ),
    ] = None,
    plot: commands.PlotFile = None,
    seed: Annotated[int, typer.Option(help="The same seed draws the same drives.")] = 1,
    design: Annotated[
        str,
        commands.choice_option(
            ("sobol", "latin-hypercube", "saltelli"), "Sampling method; saltelli also gives Sobol indices."
        ),
    ] = "sobol",
    angles: Annotated[int, typer.Option(min=20, help="Number of crank angles from 0, end excluded.")] = ANGLES,
    turns: Annotated[int, typer.Option(min=1, help="Number of crank turns that the angles span.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = os.cpu_count() or 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Use a dask cluster instead of this machine's cores.")
    ] = None,
    target: Annotated[
        float | None,
        typer.Option(
            "--allocate", metavar="YIELD", help="Find the cheapest tolerances that reach this yield, such as 0.95."
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """Solve many drives within their tolerances: distributions, yields against limits, sensitivities.

    With an output file, repeating the command resumes an interrupted run.

    Example: [cyan]cycloid-fmu tolerance pair.toml --tolerances tolerances.toml --samples 10000 -o study.nc[/]
    """
    from cycloid_fmu.studies import yields
    from cycloid_fmu.studies.allocation import check_target
    from cycloid_fmu.studies.limits import not_judged, read_requirements

    asked = None if limits_file is None else read_requirements(limits_file)
    requirements = None if asked is None else (asked, str(limits_file))
    settings = {"samples": samples, "seed": seed, "design": design, "angles": angles, "turns": turns}
    study = yields.read_study(pair_file, tolerances_file, torque, requirements, **settings)
    if target is not None:
        check_target(study, target, str(tolerances_file))
    machines = {"workers": workers, "scheduler": scheduler}
    with commands.progress("drives", study.drives) as progress:
        found = yields.conduct(study, output, progress=progress, **machines)  # type: ignore[arg-type]
    allocation = None if target is None else _allocated(study, target, str(tolerances_file), machines)
    verdicts = [] if asked is None else yields.judged(found.result)
    missing = [] if asked is None else not_judged(asked.limits, verdicts)
    if plot is not None:
        _plot(found, allocation, verdicts, missing, plot)
    if as_json:
        judged = {"verdicts": [one.numbers() for one in verdicts], "not_judged": missing} if asked else {}
        given = None if allocation is None else dataclasses.asdict(allocation)
        commands.print_json({**found.numbers(), "allocation": given, **judged})
    else:
        _print(found, allocation, f"{pair_file.name}: {{}} drives within {tolerances_file.name}")
        if limits_file is not None:
            title = f"Limits of {limits_file.name}, worst drive: met if every drive meets them"
            print_verdicts(title, verdicts, missing)
    for note in yields.notes_of(study):
        typer.echo(f"Note: {note}", err=True)
    leave(verdicts, missing)


def _allocated(study: Study, target: float, source: str, machines: dict[str, Any]) -> Allocation:
    from cycloid_fmu.studies.allocation import allocate, steps

    with commands.progress("allocation", steps()) as progress:
        return allocate(study, target, source, progress=progress, **machines)


def _plot(
    found: Findings, allocation: Allocation | None, verdicts: list[Verdict], missing: list[str], plot: Path
) -> None:
    from cycloid_fmu.draw import plots
    from cycloid_fmu.draw.verdicts import show_verdicts

    factors, figure = found.result.study.factors, plots.plot_tolerance(found.result)
    plots.save(show_verdicts(figure, verdicts, missing), plot)
    if found.indices:
        plots.save(plots.plot_indices(factors, found.indices), plot.with_stem(f"{plot.stem}-indices"))
    if allocation is not None:
        title = f"{allocation.exact_yield:.2%} of the drives meet all limits, {allocation.stated_yield:.2%} as stated"
        drawn = plots.plot_allocation(factors, allocation.scale, title)
        plots.save(drawn, plot.with_stem(f"{plot.stem}-allocation"))


def _units() -> dict[str, tuple[str, float]]:
    """Return the unit in which each figure is shown, and its size."""
    from cycloid_fmu.draw.plots import SHOWN
    from cycloid_fmu.studies.tolerance import FIGURES

    return {name: SHOWN[unit] for name, (unit, _) in FIGURES.items()}


def _print(found: Findings, allocation: Allocation | None, title: str) -> None:
    _print_statistics(found, title.format(int(found.result.independent.sum())))
    _print_yields(found)
    _print_indices(found)
    if allocation is not None:
        _print_allocation(found, allocation)


def _print_statistics(found: Findings, title: str) -> None:
    import numpy as np

    from cycloid_fmu.studies.tolerance import PER_TORQUE

    units = _units()
    rows = []
    for name, one in found.statistics.items():
        unit, factor = units[name]
        figures = [one["mean"], one["standard_deviation"], *one["quantiles"].values()]
        for k, load in enumerate(found.result.study.torque if name in PER_TORQUE else [None]):
            values = [f"{np.atleast_1d(v)[k] * factor:.4g}" for v in figures]
            rows.append([f"{name.replace('_', ' ')} [{unit}]", "" if load is None else f"{load:g} N·m", *values])
    commands.print_table(title, ["figure", "torque", "mean", "σ", "5 %", "50 %", "95 %", "largest"], rows)


def _print_yields(found: Findings) -> None:
    from cycloid_fmu.studies.limits import is_lower

    rows, units = [], _units()
    for name, limit in found.result.study.tolerances.limits.stated().items():
        unit, factor = units[name]
        allowed = f"{'≥' if is_lower(name, limit) else '≤'} {limit * factor:g} {unit}"
        rows.append([name.replace("_", " "), allowed, f"{found.yields[name]['share']:.2%}"])
    if rows:
        whole = found.yields["all"]
        rows.append(["all", "", f"{whole['share']:.2%} ({whole['low']:.2%} … {whole['high']:.2%})"])
        commands.print_table("Yield", ["limit", "allowed", "yield (95 % interval)"], rows)


def _print_indices(found: Findings) -> None:
    import numpy as np

    factors = found.result.study.factors
    for label, indices in found.indices.items():
        kinds = ("first_order", "total")
        rows = [
            [factors[i], *(f"{indices[kind][i]:.3f} ± {indices[kind + '_confidence'][i]:.3f}" for kind in kinds)]
            for i in np.argsort(-indices["total"])
        ]
        commands.print_table(f"Sobol indices: {label.replace('_', ' ')}", ["tolerance", "first order", "total"], rows)


def _print_allocation(found: Findings, allocation: Allocation) -> None:
    from cycloid_fmu.errors.kinds import KINDS

    kinds = {kind.tolerance.key: kind for kind in KINDS.values() if kind.tolerance is not None}
    tolerances = found.result.study.tolerances
    rows = []
    for name, scale in zip(found.result.study.factors, allocation.scale, strict=True):
        stated = getattr(tolerances, name)
        factor, unit = (1e3, "mrad") if kinds[name].unit == "rad" else (1e6, "µm")
        for field in ("single", "cumulative") if hasattr(stated, "single") else ("tolerance",):
            width = getattr(stated, field) * factor
            cost = tolerances.costs.get(name, 1.0) / scale
            rows.append([name, field, f"{width:.3g} {unit}", f"{width * scale:.3g} {unit}", f"{cost:.3g}"])
    commands.print_table("Cheapest tolerances", ["tolerance", "", "stated", "allocated", "cost"], rows)
    low, high = allocation.exact_interval
    typer.echo(
        f"Yield of other drives {allocation.exact_yield:.2%} (95 % interval {low:.2%} … {high:.2%}), as stated "
        f"{allocation.stated_yield:.2%}; cost, inverse to the width, {allocation.cost:.4g}, as stated "
        f"{allocation.stated_cost:.4g}."
    )
