"""`cycloid-fmu compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import FmuFile, MotionFile
from cycloid_fmu.edge import commands


def compare(
    fmu_file: FmuFile,
    other: Annotated[Path, typer.Argument(metavar="OTHER.fmu|RECORDING.csv", help="Another FMU, or a recording.")],
    motion: MotionFile = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Run two FMUs, or an FMU and a recorded drive, through the same motion and report the differences.

    A recording (CSV from `cycloid-bench export` or `simulate -o`) contains the motion itself.

    Example: [cyan]cycloid-fmu compare exact.fmu native.fmu --input motion.csv --plot differences.png[/]
    """
    import numpy as np

    from cycloid_fmu.draw import plots
    from cycloid_fmu.fmu import run

    recorded = other.suffix != ".fmu"
    if not recorded and motion is None:
        raise edge.InputError("two FMUs need --input with the inputs over time; a recording contains them.")
    source = motion or other
    runs = 1 if recorded else 2
    with commands.progress("samples", runs * (run.read_inputs(source, fmu_file)[0].size - 1)) as progress:
        time, pairs = run.compare(fmu_file, other, source, progress)
    if plot is not None:
        plots.save(plots.plot_comparison(time, pairs, fmu_file.name, other.name), plot)
    figures = {
        name: {"mean": float(d.mean()), "rms_about_mean": float(d.std()), "largest": float(np.abs(d).max())}
        for name, d in ((n, a - b) for n, (a, b) in pairs.items())
    }
    if as_json:
        commands.print_json(figures)
        return
    rows = []
    for name, found in figures.items():
        unit, factor = plots.DIFFERENCE_UNITS.get(name, ("", 1.0))
        rows.append([name, unit, *(f"{v * factor:.4g}" for v in found.values())])
    columns = ["variable", "unit", "mean", "rms about it", "largest"]
    commands.print_table(f"{fmu_file.name} minus {other.name}", columns, rows)
