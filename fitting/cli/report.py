"""`cycloid-fit report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.edge import commands
from fitting.cli import options


def report(
    files: options.Recordings,
    output: Annotated[Path, commands.output_option((".html", ".pdf"), "REPORT.html|pdf", "The report.")],
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    rated_torque: options.RatedTorque = None,
    mapping: options.MappingFiles = None,
    instruments: options.InstrumentsFile = None,
    stiffness_limits: options.StiffnessLimits = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            metavar="CERTIFICATE.toml", help="Add a certificate: device, limits, decision rule; with --instruments."
        ),
    ] = None,
    as_json: commands.AsJson = False,
) -> None:
    """Write a report as one file, HTML or PDF: figures, curves, orders, loops, and excluded data with the reason.

    Example: [cyan]cycloid-fit report loop.csv *.arrows --pair pair.toml -o report.html[/]
    """
    import fitting

    options.check_report(output)
    figures = options.figures_of(
        files,
        drive,
        mapping,
        ratio=ratio,
        rated_torque=rated_torque,
        instruments=instruments,
        stiffness_limits=commands.separated(stiffness_limits),
    )
    fitting.report(figures, output, certificate=certificate)
    options.finish(figures, as_json=as_json)
