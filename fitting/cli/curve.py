"""`cycloid-fit curve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cycloid_fmu.edge import ARCSEC, commands
from fitting.cli import options


def curve(
    files: options.Recordings,
    drive: options.MaybePair = None,
    ratio: options.Ratio = None,
    mapping: options.MappingFiles = None,
    output: Annotated[Path | None, commands.output_option((".nc",), "CURVES.nc", "Write the curves (netCDF).")] = None,
    read_head: options.HeadFile = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Compute transmission error curves over one output turn, averaged over turns, by recording and direction.

    Without --pair and --ratio, the ratio is that of the mapping or the recording.

    Example: [cyan]cycloid-fit curve 20Nm.arrows 200Nm.arrows --pair pair.toml -o curves.nc --plot curves.png[/]
    """
    import numpy as np

    import fitting
    from fitting.reports.panels import label_of
    from fitting.transmission_error.curve import curves_json, noise_of

    nominal = options.drive_or_ratio(drive, ratio)
    curves = fitting.curves(fitting.read_recordings(files, mapping, read_head), nominal)
    if output is not None:
        fitting.write_curves(curves, output)
    options.write(curves, plot=plot)
    if as_json:
        commands.print_json(curves_json(curves))
        return
    rows = []
    for measured in curves:
        error = measured.transmission_error * ARCSEC
        turns = measured.turns
        counts = [str(measured.input_angle.size), f"{turns:.1f}" if turns > 0.95 else f"{turns:.2g}"]
        angles = [f"{angle:.3f}" for angle in (error.mean(), np.ptp(error), noise_of(measured) * ARCSEC)]
        rows.append([Path(measured.source).name, label_of(measured), *counts, *angles])
    columns = ["recording", "load", "points", "turns", "mean", "peak-peak", "noise"]
    commands.print_table("Transmission error [arcsec]", columns, rows)
    options.print_notes(note for measured in curves for note in measured.notes)
