"""`cycloid-fmu draw`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PairFile, SurfaceFile
from cycloid_fmu.edge import commands

_FRAMES = 180  # crank angles of an animated page, or a few more: as many in each pin pitch, so that all peaks are alike


def draw(
    pair_file: PairFile,
    output: Annotated[
        Path,
        commands.output_option(
            (".html", ".svg", *edge.PICTURES), "OUT.html|svg|png|pdf", "An animated page, or a picture."
        ),
    ],
    torque: Annotated[
        list[float] | None,
        commands.quantity_option(
            "N*m", "Torque on the output; a page may have several.", show_default="the rated torque"
        ),
    ] = None,
    crank_angle: Annotated[
        float, commands.quantity_option("rad", "Crank angle of the picture.", show_default="0 deg", metavar='"30 deg"')
    ] = 0.0,
    surface_file: SurfaceFile = None,
    exaggeration: Annotated[
        float | None,
        typer.Option(
            help="Enlargement of the gaps between discs and pins; 1 is to scale.",
            show_default="a round number that fits",
        ),
    ] = None,
) -> None:
    """Draw discs, pins, contacts and forces, with enlarged gaps: a picture, or a page that animates a crank turn.

    A page with one torque also shows half of it, zero, and both with the opposite sign. One tooth is drawn enlarged,
    with its modification and deviations, including wear. Of an elastic disc a second picture, OUT-disc, has its mesh
    and its displacement under the most loaded pin and under its whole load, enlarged and as colours.

    Example: [cyan]cycloid-fmu draw pair.toml --torque "181 N*m" --crank-angle "30 deg" -o drive.html[/]
    """
    import numpy as np

    from cycloid_fmu.analysis import tilt_notes
    from cycloid_fmu.draw.drive_page import write_motion
    from cycloid_fmu.drive import read_drive

    drive = read_drive(pair_file, surface_file)
    torque = torque or [drive.pair.rated_load(str(pair_file))]
    moves = output.suffix.lower() == ".html"
    if len(torque) > 1 and not moves:
        raise edge.ArgumentError(
            "torque", "a picture shows one load; give one torque, or write a page, .html", f"{torque[1]:g} N*m"
        )
    loads, first, angles = torque, 0, np.array([crank_angle])
    if moves:
        if len(torque) == 1 and torque[0] != 0.0:
            # On bearings the play is defined only with a rated torque.
            none = [0.0] if drive.pair.supports is None or drive.pair.rated_torque is not None else []
            loads = sorted([-torque[0], -0.5 * torque[0], *none, 0.5 * torque[0], torque[0]])
            first = loads.index(torque[0])
        frames = drive.pair.pins * max(2, math.ceil(_FRAMES / drive.pair.pins))
        angles = (crank_angle + np.linspace(0.0, 2.0 * math.pi, frames, endpoint=False)) % (2.0 * math.pi)
        angles.sort()
    with commands.progress("crank angles", angles.size * len(loads)) as progress:
        motion = drive.motion(loads, angles, exaggeration=exaggeration, progress=progress)
    write_motion(motion, output, first, int(np.argmin(np.abs(angles - crank_angle % (2.0 * math.pi)))))
    typer.echo(f"{output}: gaps × {motion.exaggeration:g}")
    body = None if drive.pair.bodies is None else drive.pair.bodies.disc
    if body is not None and body.matrix is None:
        from cycloid_fmu.draw import plots
        from cycloid_fmu.draw.bodies import plot_disc
        from cycloid_fmu.supports.disc_forces import disc_forces

        at = int(np.argmin(np.abs(angles - crank_angle % (2.0 * math.pi))))
        pressed = int(motion.force[first, at, 0].sum(axis=-1).argmax())
        picture = output.with_name(f"{output.stem}-disc{'.svg' if moves else output.suffix}")
        forces = disc_forces(drive.stage, loads[first], crank_angle) if loads[first] != 0.0 else None
        plots.save(plot_disc(drive.pair, body, pin=pressed, crank_angle=crank_angle, forces=forces), picture)
        typer.echo(f"{picture}: the elastic disc 0, displaced by its most loaded pin and by all its forces")
    for note in tilt_notes(drive):
        typer.echo(f"Note: {note}", err=True)
