"""The command `cycloid-bench`: simulate a bench, record one, export what was recorded."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cycloid_fmu import edge

if TYPE_CHECKING:
    from drivers.bench import Amt21Bench, CanBench, Motion
    from drivers.recorder import Recorded
    from drivers.recording_format import FloatArray, Samples

app = typer.Typer(
    name="cycloid-bench",
    help="Record encoders and torque of a gear test bench, real or simulated.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


class Direction(StrEnum):
    """Of the crank."""

    forward = "forward"
    backward = "backward"


@app.callback()
def _root() -> None:
    pass


@contextlib.contextmanager
def _progress(label: str, total: int | None) -> Iterator[Callable[[Mapping[str, int]], None]]:
    """Show samples as they come, on the error stream: the output stays what scripts read."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda counts: bar.update(task, completed=min(counts.values()))


def _record(bench: Path, output: Path, total: int | None = None, **stops: Any) -> None:
    from drivers.encoder import EncoderError
    from drivers.recorder import record_bench

    try:
        with _progress("recording", total) as progress:
            done = record_bench(bench, output, progress=progress, **stops)
    except KeyboardInterrupt:
        # Some versions of typer turn an interrupt into a failure of their own.
        typer.echo(f"Interrupted; {output} has all that came.", err=True)
        raise typer.Exit(edge.INTERRUPTED) from None
    except EncoderError as problem:
        typer.echo(str(problem), err=True)
        raise typer.Exit(edge.FAILED) from None
    _report(done)


def _report(done: Recorded) -> None:
    shown = ", ".join(f"{n} {name}" for name, n in done.samples.items())
    typer.echo(f"{done.path}: {shown}; {done.events} events")
    for failure in done.failures:
        typer.echo(str(failure), err=True)
    if done.failures:
        raise typer.Exit(edge.FAILED)
    if not any(done.samples.values()):
        typer.echo("No sample came: does the bench send?", err=True)
        raise typer.Exit(edge.FAILED)


@app.command()
def record(
    bench: Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The wiring: buses, ports and channels.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN.arrows", help="New file to record to.")],
    duration: Annotated[str | None, typer.Option(help='Stop after this time, such as "30 s".')] = None,
    idle: Annotated[str | None, typer.Option(help='Stop when nothing came for this time, such as "2 s".')] = None,
) -> None:
    """Record all channels of a bench until Ctrl-C, the duration or silence.

    Example: [bold]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/bold]
    """
    _record(bench, output, duration=_seconds(duration, "--duration"), idle=_seconds(idle, "--idle"))


def _seconds(text: str | None, name: str) -> float | None:
    if text is None:
        return None
    seconds = edge.quantity_option(text, "s", name)
    if seconds <= 0:
        raise edge.InputError(f'{name} = "{text}": the time must be above zero.')
    return seconds


@app.command()
def simulate(
    torque: Annotated[str, typer.Option(help='Torque on the output, such as "20 N*m"; the sign counts.')],
    fmu: Annotated[Path | None, typer.Option(metavar="DRIVE.fmu", help="The drive; without it an ideal one.")] = None,
    ratio: Annotated[float | None, typer.Option(help="Signed ratio input/output, such as -39.")] = None,
    turns: Annotated[int, typer.Option(min=1, help="Crank turns.")] = 39,
    samples_per_turn: Annotated[int, typer.Option(min=3, help="Samples each crank turn.")] = 96,
    direction: Annotated[Direction, typer.Option(help="Way the crank turns.")] = Direction.forward,
    speed: Annotated[str, typer.Option(help="Crank speed.")] = "60 rpm",
    noise: Annotated[str, typer.Option(help="Noise of each encoder, rms.")] = "0 arcsec",
    torque_noise: Annotated[str, typer.Option(help="Noise of the torque, rms.")] = "0 N*m",
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 0,
    bus: Annotated[str, typer.Option(help="python-can interface.")] = "udp_multicast",
    channel: Annotated[str | None, typer.Option(help="Channel of the bus.")] = None,
    pty: Annotated[bool, typer.Option("--pty", help="AMT21 encoders on a pseudo-terminal instead of CAN.")] = False,
    speed_factor: Annotated[
        float | None, typer.Option(help="1: at the crank's own speed; default: as fast as the bus carries.")
    ] = None,
    write_bench: Annotated[Path, typer.Option(metavar="BENCH.toml", help="Wiring to write.")] = Path("BENCH.toml"),
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="RUN.arrows", help="Record it here at once.")
    ] = None,
) -> None:
    """Be a bench: wait for a recorder, then send a motion as real encoders and transducers do.

    Example: [bold]cycloid-bench simulate --fmu drive.fmu --ratio -39 --torque "20 N*m" --write-bench BENCH.toml[/bold],
    and in a second terminal [bold]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/bold].
    The virtual bus ends at its process: with [bold]--bus virtual[/bold] add [bold]-o run.arrows[/bold].
    """
    from drivers.bench import Amt21Bench, BenchRun, CanBench, fmu_output_angle, simulate_motion

    if fmu is None and ratio is None:
        raise edge.InputError("--fmu or --ratio is missing: give the drive's FMU, or the ratio of an ideal drive.")
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.InputError(f"--ratio = {ratio}: write the signed ratio input/output, such as -39.")
    if speed_factor is not None and not speed_factor > 0:
        raise edge.InputError(f"--speed-factor = {speed_factor}: the factor must be above zero.")
    if bus == "virtual" and output is None and not pty:
        raise edge.InputError("--bus = virtual: this bus ends at its process; add -o RUN.arrows or use udp_multicast.")
    run = BenchRun(
        torque=edge.quantity_option(torque, "N*m", "--torque"),
        turns=turns,
        samples_per_turn=samples_per_turn,
        direction=direction.value,
        speed=edge.quantity_option(speed, "rad/s", "--speed"),
        noise=edge.quantity_option(noise, "rad", "--noise"),
        torque_noise=edge.quantity_option(torque_noise, "N*m", "--torque-noise"),
        seed=seed,
    )
    for name, value, least in (
        ("--speed", run.speed, 1e-9),
        ("--noise", run.noise, 0),
        ("--torque-noise", run.torque_noise, 0),
    ):
        if value < least:
            raise edge.InputError(f"{name}: the value must be {'above' if least else 'at least'} zero.")
    ideal = ratio or 1.0
    motion = simulate_motion(fmu_output_angle(fmu) if fmu else lambda angle, _: angle / ideal, run)
    made: CanBench | Amt21Bench
    if pty:
        made = Amt21Bench(motion, speed_factor=speed_factor or 1.0)
    else:
        group = "239.74.163.2" if bus == "udp_multicast" else "bench"
        made = CanBench(motion, interface=bus, channel=channel or group, speed_factor=speed_factor)
    _serve(made, motion, write_bench, ratio, fmu.stem if fmu else "ideal", output)


def _serve(
    made: CanBench | Amt21Bench, motion: Motion, wiring: Path, ratio: float | None, pair: str, output: Path | None
) -> None:
    from drivers.encoder import EncoderError

    try:
        with made:
            made.write_wiring(wiring, ratio=ratio, pair=pair)
            typer.echo(
                f"{wiring}: wiring of a bench that sends {motion.run.samples} samples once it is recorded", err=True
            )
            if output is not None:
                # A line that is polled has no number of samples of its own: it ends with the motion.
                ends: dict[str, Any] = {"stop": lambda: made.wait(0.0)}
                if not hasattr(made, "url"):
                    ends = {"samples": motion.run.samples, "idle": 5.0}
                _record(wiring, output, motion.run.samples, **ends)
            else:
                while not made.wait(0.2):
                    pass
                typer.echo("The motion ended.", err=True)
    except KeyboardInterrupt:
        typer.echo("Interrupted.", err=True)
        raise typer.Exit(edge.INTERRUPTED) from None
    except EncoderError as problem:
        typer.echo(str(problem), err=True)
        raise typer.Exit(edge.FAILED) from None


def paired_table(path: Path) -> dict[str, FloatArray]:
    """Return a recording as one table of columns time s, input_angle rad, output_angle rad, torque N*m.

    The angles are paired by equal `time_host`, which channels latched by the same SYNC share to the last bit: a crank
    at 1500 rpm turns 33 arcsec in a microsecond, so angles read one after the other are not a pair. The torque, which
    changes slowly, is interpolated linearly to those times; it is NaN outside of its own times.

    Raises
    ------
    edge.InputError
        If a channel is missing or the angles share no times.
    """
    import numpy as np

    from drivers.recording_format import read_recording

    recording = read_recording(path)
    for problem in recording.problems:
        typer.echo(problem, err=True)
    roles: dict[str, Samples] = {c.role: recording.samples[c.name] for c in recording.header.channels}
    for role in ("input_angle", "output_angle", "torque"):
        if role not in roles or len(roles[role]) == 0:
            raise edge.InputError(f"{path}: the table needs the channel {role}; the recording has no samples of it.")
    angle, output, torque = roles["input_angle"], roles["output_angle"], roles["torque"]
    shared, i, j = np.intersect1d(angle.time_host, output.time_host, return_indices=True)
    if len(shared) == 0:
        raise edge.InputError(
            f"{path}: input_angle and output_angle share no instant (they were not latched by one SYNC), so they are "
            "no pairs; read the recording itself."
        )
    at = np.interp(shared, torque.time_host, torque.value, left=np.nan, right=np.nan)
    return {"time [s]": shared - shared[0], "input_angle [rad]": angle.value[i], "output_angle [rad]": output.value[j],
            "torque [N*m]": at}  # fmt: skip


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN.csv", help="Table to write.")],
) -> None:
    """Write a recording as one CSV table: time, input angle, output angle, torque.

    Example: [bold]cycloid-bench export run.arrows -o run.csv[/bold]

    The two angles are paired by the SYNC that latched both; the torque is interpolated to those instants.
    """
    import numpy as np

    if output.suffix.lower() != ".csv":
        raise edge.InputError(f"--output = {output}: the file must end in .csv.")
    table = paired_table(recording)
    with edge.written_whole(output) as temporary:
        columns = np.column_stack(list(table.values()))
        np.savetxt(temporary, columns, "%.15g", ",", header=",".join(table), comments="", encoding="utf-8")
    typer.echo(f"{output}: {len(columns)} rows")


@app.command("list")
def list_() -> None:
    """List protocols, serial ports and CAN interfaces.

    Example: [bold]cycloid-bench list[/bold]
    """
    import can
    from serial.tools import list_ports

    from drivers.encoder import protocols

    ports = [f"{p.device} ({p.description})" for p in list_ports.comports()]
    buses = [f'{b["interface"]} "{b["channel"]}"' for b in can.detect_available_configs(["socketcan", "udp_multicast"])]
    for title, names in (("protocols", sorted(protocols())), ("serial ports", ports), ("CAN buses", buses)):
        typer.echo(f"{title}: {', '.join(names) or 'none'}")


def main() -> NoReturn:
    """Run the command line."""
    edge.run(lambda: app)


if __name__ == "__main__":
    main()
