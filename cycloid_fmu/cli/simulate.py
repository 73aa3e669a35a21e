"""`cycloid-fmu simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import FmuFile, MotionFile
from cycloid_fmu.edge import commands

_SPEED = edge.parse_quantity("600 rpm", "rad/s")


def simulate(
    fmu_file: FmuFile,
    torque: Annotated[
        float | None,
        commands.quantity_option("N*m", "Torque on the output.", show_default="the rated torque"),
    ] = None,
    turns: Annotated[
        float | None, typer.Option(help="Crank turns; a negative number turns backwards.", show_default="1")
    ] = None,
    crank_speed: Annotated[
        float | None, commands.quantity_option("rad/s", "Crank speed.", show_default="600 rpm")
    ] = None,
    samples: Annotated[int | None, typer.Option(min=2, help="Samples per crank turn.", show_default="360")] = None,
    motion: MotionFile = None,
    output: Annotated[Path | None, commands.output_option((".csv",), "RUN.csv", "Write the results (CSV).")] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Turn the crank of an FMU at constant speed and torque, or move it through a given motion (with fmpy).

    Example: [cyan]cycloid-fmu simulate drive.fmu --torque "100 N*m" --turns 2 -o run.csv --plot run.png[/]
    """
    import numpy as np

    from cycloid_fmu.fmu import run

    if torque is not None and motion is not None:
        raise edge.InputError("--torque and --input both state the load; give one of them.")
    stated = {"turns": turns, "crank_speed": crank_speed, "samples": samples}
    if motion is not None and (unused := [name for name, value in stated.items() if value is not None]):
        raise edge.ArgumentError(unused[0], "is not for --input, which has the whole motion")
    turns, samples = 1.0 if turns is None else turns, samples or 360
    speed = _SPEED if crank_speed is None else crank_speed
    if motion is None:
        torque = run.rated_load(fmu_file) if torque is None else torque
        results = run.turn_crank(fmu_file, torque, turns, speed, samples)
    else:
        time, inputs = run.read_inputs(motion, fmu_file)
        with commands.progress("samples", time.size) as progress:
            found = run.simulate(fmu_file, inputs, list(run.units_of(fmu_file, "output")), time, progress=progress)
        results = {"time": time, **inputs, **found}
    if output is not None:
        run.write_motion(output, results, fmu_file)
    if plot is not None:
        from cycloid_fmu.draw import plots

        load = f", {torque:g} N·m, {speed / (2.0 * np.pi) * 60.0:g} rpm" if torque is not None else ""
        plots.save(plots.plot_simulation(results, f"{fmu_file.name}{load}"), plot)
    if as_json:
        commands.print_json(results)
        return
    te = results["transmission_error"] * edge.ARCSEC
    rows = [
        ["TE mean", f"{te.mean():z.4f}″"],
        ["TE peak-peak", f"{np.ptp(te):z.4f}″"],
        ["backlash mean", f"{results['backlash'].mean() * edge.ARCSEC:z.4f}″"],
        ["largest pressure", f"{results['max_contact_pressure'].max() * 1e-6:.1f} MPa"],
    ]
    commands.print_table(fmu_file.name, ["figure", "value"], rows)
