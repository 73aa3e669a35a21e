"""`cycloid-fit metrics`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cycloid_fmu.edge import commands
from fitting.cli import options


def metrics(
    files: options.Recordings,
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    rated_torque: options.RatedTorque = None,
    mapping: options.MappingFiles = None,
    output: Annotated[
        Path | None, commands.output_option((".json",), "FIGURES.json", "Write the figures (JSON).")
    ] = None,
    plot: commands.PlotFile = None,
    stiffness_limits: options.StiffnessLimits = None,
    instruments: options.InstrumentsFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Compute the standard figures: transmission error, lost motion, backlash, stiffness, hysteresis, starting torques.

    Example: [cyan]cycloid-fit metrics loop.csv *.arrows --ratio -39 --rated-torque "167 N*m"[/]
    """
    import fitting

    figures = options.figures_of(
        files,
        drive,
        mapping,
        ratio=ratio,
        rated_torque=rated_torque,
        instruments=instruments,
        stiffness_limits=commands.separated(stiffness_limits),
    )
    if plot is not None:
        fitting.plot(figures, plot)
    if output is not None:
        figures.write(output)
    options.finish(figures, as_json=as_json)
