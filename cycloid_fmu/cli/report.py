"""`cycloid-fmu report`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import LimitsFile, PairFile, leave
from cycloid_fmu.edge import commands
from cycloid_fmu.geometry import ANGLES


def report(
    pair_file: PairFile,
    output: Annotated[Path, commands.output_option((".html", ".pdf"), "REPORT.html|pdf", "The report.")],
    limits_file: LimitsFile = None,
    tolerances_file: Annotated[
        Path | None,
        typer.Option(
            "--tolerances", metavar="T.toml", help="Tolerances, for the ranges of the figures (cycloid-tolerances/1)."
        ),
    ] = None,
) -> None:
    """Write a report of a drive, HTML or PDF: drawing, figures with ranges, strength, verdicts, assumptions.

    Example: [cyan]cycloid-fmu report joint/drive.toml --tolerances joint/tolerances.toml -o report.pdf[/]
    """
    import numpy as np

    from cycloid_fmu.draw import design_report
    from cycloid_fmu.drive import read_drive
    from cycloid_fmu.studies import limits, verdicts
    from cycloid_fmu.studies.sized_figures import figures_of
    from cycloid_fmu.surfaces.sampling import read_tolerances

    drive = read_drive(pair_file)
    pair, text = drive.pair, edge.read_text(pair_file)
    pair.rated_load(str(pair_file))
    asked = None if limits_file is None else limits.read_requirements(limits_file)
    tolerances = None if tolerances_file is None else read_tolerances(tolerances_file)
    judged = None
    with commands.status() as progress:
        figures, stresses = figures_of(drive, tolerances, None, progress)
        if asked is not None:
            progress("limits")
            verdicts.check(asked, pair, str(limits_file), str(pair_file))
            turn = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
            judged = verdicts.judge_drive(drive, asked, None, turn, workers=os.cpu_count() or 1)
        progress("drawing")
        motion = drive.motion(pair.rated_torque, 0.0)
        report_ = design_report.report_of(drive, motion, pair_file.name, text, figures, stresses, judged)
    design_report.write_design_report(report_, output)
    typer.echo(f"{output}: {len(figures)} figures, {len(stresses)} stresses")
    if judged is not None:
        leave(judged.verdicts, judged.not_judged)
