"""`cycloid-bench simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import drivers
from cycloid_fmu import edge
from cycloid_fmu.edge.commands import choice_option, output_option, quantity_option, ratio_option
from drivers.cli.shown import LiveLine, recording, report
from drivers.simulated.buses import SimulatedCan, read_simulation


def simulate(
    drive: Annotated[
        Path | None, typer.Option("--fmu", metavar="DRIVE.fmu", help="The drive. Default: an ideal one.")
    ] = None,
    torque: Annotated[
        float | None, quantity_option("N*m", "Torque on the output.", show_default="the rated torque of the FMU")
    ] = None,
    ratio: Annotated[float | None, ratio_option("Default: that of the FMU.")] = None,
    turns: Annotated[int, typer.Option(min=1, help="Crank turns.")] = 39,
    write_bench: Annotated[Path, output_option((".toml",), "BENCH.toml", "Wiring to write.", "--write-bench")] = Path(
        "BENCH.toml"
    ),
    output: Annotated[
        Path | None, output_option((".arrows",), "RUN.arrows", "Record the simulated run here directly.")
    ] = None,
    direction: Annotated[Any, choice_option(("forward", "backward"), "Direction of the crank's rotation.")] = "forward",
    speed: Annotated[
        float, quantity_option("rad/s", "Crank speed.", "--crank-speed", show_default="60 rpm")
    ] = 6.283185307179586,
    noise: Annotated[
        float, quantity_option("rad", "RMS noise of each encoder.", show_default="none", metavar='"0.5 arcsec"')
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed makes the same noise.")] = 0,
    samples_per_turn: Annotated[int, typer.Option(min=3, help="Samples per crank turn.")] = 96,
    hysteresis: Annotated[
        bool,
        typer.Option(
            "--hysteresis", help="Lock the input and cycle the torque through 0, +T, 0, -T, 0, --turns times."
        ),
    ] = False,
    simulation: Annotated[
        Path | None,
        typer.Option("--bus", metavar="SIMULATION.toml", help="Bus and faults. Default: CAN on this machine."),
    ] = None,
) -> None:
    """Simulate a bench: wait for a recorder, then send the signals of a motion as real sensors do.

    Example: [cyan]cycloid-bench simulate --fmu drive.fmu --torque "20 N*m" --write-bench BENCH.toml[/],
    and in a second terminal [cyan]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/].
    With [cyan]-o run.arrows[/] no recorder is needed.
    """
    if simulation is not None:
        bus = read_simulation(simulation)
    else:
        bus = SimulatedCan(interface="loopback" if output is None else "virtual")
    if isinstance(bus, SimulatedCan) and bus.interface == "virtual" and output is None:
        raise edge.InputError(f'{simulation}: [can] interface = "virtual": other processes cannot reach it; add -o.')
    motion = drivers.SimulatedMotion(samples_per_turn, direction, speed, noise, seed=seed, hysteresis=hysteresis)
    bench = drivers.simulate_bench(drive, torque=torque, ratio=ratio, turns=turns, motion=motion, bus=bus)
    with recording(), bench:
        if output is not None:
            with LiveLine() as progress:
                done = bench.record(output, wiring=write_bench, progress=progress)
            report(done)
            return
        bench.write_wiring(write_bench)
        count = bench.motion.run.samples
        typer.echo(
            f"{write_bench}: wiring; {count} samples are sent once a recorder starts; in a second terminal: "
            f"cycloid-bench record {write_bench} -o run.arrows",
            err=True,
        )
        while not bench.wait(0.2):
            pass
        typer.echo("The motion ended.", err=True)
