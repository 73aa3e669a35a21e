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
    figures = options.figures_of(
        files,
        drive,
        mapping,
        ratio=ratio,
        rated_torque=rated_torque,
        instruments=instruments,
        stiffness_limits=commands.separated(stiffness_limits),
    )
    options.write(figures, output=output, plot=plot)
    options.finish(figures, as_json=as_json)
