"""The command `cycloid-bench`: simulate a bench, record one, watch it, export and repair what was recorded."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from drivers.bench import CanBench, Motion
    from drivers.recorder import Live, Recorded
    from drivers.recording_format import RecordingReader
    from drivers.serial_bench import Amt21Bench, AsciiBench, ModbusBench

app = commands.command_line("cycloid-bench", "Record encoders and torque of a gear test bench, real or simulated.")


class Direction(StrEnum):
    """Of the crank."""

    forward = "forward"
    backward = "backward"


class Serial(StrEnum):
    """What stands on the simulated serial line."""

    amt21 = "amt21"
    modbus = "modbus"
    ascii = "ascii"


class Trigger(StrEnum):
    """What makes the simulated CANopen encoders send."""

    controller = "controller"
    sync = "sync"
    timer = "timer"


def live_text(live: Live) -> str:
    """Return how a recording stands, in one line: rates, counts, positions, marks, buffer, disk and running TE."""
    parts = []
    for name, state in live.channels.items():
        shown = "–" if state.value is None else f"{state.value:.5g}"
        part = f"{name} {state.samples} ({state.rate:.0f}/s) at {shown}"
        part += "".join(f", {n} {mark}" for mark, n in state.marks.items() if n and mark != "rollovers")
        part += f", {state.waiting} waiting" if state.waiting else ""
        parts.append(part + (" OUT" if state.failure is not None else ""))
    if live.transmission_error is not None:
        parts.append(f"TE {math.degrees(live.transmission_error) * 3600:+.2f}″")
    parts.append(f"{live.events} events, disk {live.disk_free / 1e9:.1f} GB free")
    return " · ".join(parts)


@contextlib.contextmanager
def _live_line() -> Iterator[Callable[[Live], None]]:
    """Show the live line on the error stream: the output stays what scripts read."""
    from rich.console import Console
    from rich.live import Live as Display
    from rich.text import Text

    console = Console(stderr=True)
    with Display(console=console, transient=True, refresh_per_second=5) as display:
        yield lambda live: display.update(Text(live_text(live)))


def _record(bench: Path, output: Path, **stops: Any) -> None:
    from drivers.recorder import record_bench

    with _recording_to(output), _live_line() as progress:
        done = record_bench(bench, output, progress=progress, **stops)
    _report(done)


@contextlib.contextmanager
def _recording_to(path: Path) -> Iterator[None]:
    """Say what stopped a recording, with the exit status that belongs to it."""
    from drivers.encoder import EncoderError
    from drivers.recorder import RecordingError

    try:
        yield
    except KeyboardInterrupt:
        # Some versions of typer turn an interrupt into a failure of their own.
        typer.echo(f"Interrupted; {path} has all that came.", err=True)
        raise typer.Exit(edge.INTERRUPTED) from None
    except edge.InputError:
        raise
    except (EncoderError, RecordingError) as problem:
        typer.echo(str(problem), err=True)
        raise typer.Exit(edge.FAILED) from None


def _report(done: Recorded) -> None:
    shown = ", ".join(f"{n} {name}" for name, n in done.samples.items())
    typer.echo(f"{done.path}: {shown}; {done.events} events")
    for name, marks in done.marks.items():
        if marks:
            typer.echo(f"{name}: {', '.join(f'{n} {mark}' for mark, n in marks.items())}")
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

    Example: [cyan]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/]

    What came is in the file a twentieth of a second later, safe from a kill of the process; every second the disk is
    told to hold it, safe from a power cut. Buses and ports that fail are opened anew.
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
    trigger: Annotated[Trigger, typer.Option(help="What makes encoders on CAN send.")] = Trigger.controller,
    serial: Annotated[Serial | None, typer.Option(help="Encoders on a pseudo-terminal instead of CAN.")] = None,
    clock_drift: Annotated[
        float, typer.Option(help="Of the ASCII counter's or the virtual bus's clock, relative, such as 50e-6.")
    ] = 0.0,
    hysteresis: Annotated[
        bool, typer.Option("--hysteresis", help="Lock the input; the torque goes 0, +T, 0, -T, 0, as often as --turns.")
    ] = False,
    faults: Annotated[Path | None, typer.Option(metavar="FAULTS.toml", help="What goes wrong and when.")] = None,
    speed_factor: Annotated[
        float | None, typer.Option(help="1: at the crank's own speed; default: as fast as the bus carries.")
    ] = None,
    write_bench: Annotated[Path, typer.Option(metavar="BENCH.toml", help="Wiring to write.")] = Path("BENCH.toml"),
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="RUN.arrows", help="Record it here at once.")
    ] = None,
) -> None:
    """Be a bench: wait for a recorder, then send a motion as real encoders and transducers do.

    Example: [cyan]cycloid-bench simulate --fmu drive.fmu --ratio -39 --torque "20 N*m" --write-bench BENCH.toml[/],
    and in a second terminal [cyan]cycloid-bench record BENCH.toml -o run.arrows --idle "2 s"[/].
    The virtual bus ends at its process: with [cyan]--bus virtual[/] add [cyan]-o run.arrows[/].
    """
    from drivers.bench import BenchRun, CanBench, fmu_output_angle, simulate_hysteresis, simulate_motion
    from drivers.faults import read_faults
    from drivers.serial_bench import Amt21Bench, AsciiBench, ModbusBench

    if fmu is None and ratio is None:
        raise edge.InputError("--fmu or --ratio is missing: give the drive's FMU, or the ratio of an ideal drive.")
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.InputError(f"--ratio = {ratio}: write the signed ratio input/output, such as -39.")
    if speed_factor is not None and not speed_factor > 0:
        raise edge.InputError(f"--speed-factor = {speed_factor}: the factor must be above zero.")
    if bus == "virtual" and output is None and serial is None:
        raise edge.InputError("--bus = virtual: this bus ends at its process; add -o RUN.arrows or use udp_multicast.")
    if clock_drift and not (serial is Serial.ascii or (serial is None and bus == "virtual")):
        raise edge.InputError(f"--clock-drift = {clock_drift}: only --serial ascii and --bus virtual have a clock.")
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
            raise edge.InputError(f"{name} = {value:g}: it must {'be above' if least else 'not be below'} zero.")
    ideal = ratio or 1.0
    moved = simulate_hysteresis if hysteresis else simulate_motion
    motion = moved(fmu_output_angle(fmu) if fmu else lambda angle, _: angle / ideal, run)
    script = read_faults(faults) if faults is not None else []
    made: CanBench | Amt21Bench | ModbusBench | AsciiBench
    if serial is Serial.amt21:
        made = Amt21Bench(motion, speed_factor=speed_factor or 1.0, faults=script)
    elif serial is Serial.modbus:
        made = ModbusBench(motion, speed_factor=speed_factor or 1.0, faults=script)
    elif serial is Serial.ascii:
        made = AsciiBench(motion, speed_factor=speed_factor or 1.0, clock_drift=clock_drift, faults=script)
    else:
        group = "239.74.163.2" if bus == "udp_multicast" else "bench"
        made = CanBench(
            motion, interface=bus, channel=channel or group, trigger=trigger.value, speed_factor=speed_factor,
            clock_drift=clock_drift or None, faults=script,
        )  # fmt: skip
    _serve(made, motion, write_bench, ratio, fmu.stem if fmu else "ideal", output)


def _serve(
    made: CanBench | Amt21Bench | ModbusBench | AsciiBench,
    motion: Motion,
    wiring: Path,
    ratio: float | None,
    pair: str,
    output: Path | None,
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
                _record(wiring, output, **ends)
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


@app.command()
def run(
    sequence: Annotated[Path, typer.Argument(metavar="SEQUENCE.toml", help="Speeds, loads, directions, loops.")],
) -> None:
    """Run a test sequence: prompt for or drive each step, check that it was reached, write one recording a step.

    Example: [cyan]cycloid-bench run sequence.toml[/]

    Recordings lie beside the sequence; steps that are recorded are passed over, so an interrupted sequence goes on
    where it was. A step that falls short is kept under another name, and made again if you say so.
    """
    import subprocess

    from drivers.sequence import read_sequence, report_command, run_step

    made = read_sequence(sequence)
    done: list[Path] = []
    short = 0
    for number, step in enumerate(made.steps, 1):
        path = made.folder / f"{step.name}.arrows"
        typer.echo(f"{number} of {len(made.steps)}: {step.said()}")
        attempt = 0
        while not path.exists():
            attempt += 1
            trial = made.folder / f"{step.name}.trial-{attempt}.arrows"
            if trial.exists():
                continue
            if made.file.drive is None:
                typer.prompt("Press Enter when it runs", default="", show_default=False, err=True)
            with _recording_to(trial), _live_line() as progress:
                said = run_step(made, step, trial, progress)
            if not said:
                trial.rename(path)
                break
            typer.echo(f"{trial}: not reached: {'; '.join(said)}.", err=True)
            if made.file.drive is not None or not typer.confirm("Make it again?", default=True, err=True):
                short += 1
                break
        if path.exists():
            done.append(path)
            typer.echo(f"{path}: recorded")
    command = report_command(made, done)
    if command is not None:
        typer.echo(" ".join(command))
        if subprocess.run(command, check=False).returncode:
            raise typer.Exit(edge.FAILED)
    if short:
        raise typer.Exit(edge.FAILED)


@app.command()
def watch(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording, finished or growing.")],
    host: Annotated[
        str, typer.Option(help="Address to listen on; not a local one: a token is asked for.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 0,
) -> None:
    """Show a recording in the browser while it grows: transmission error, spectrum, health.

    Example: [cyan]cycloid-bench watch run.arrows[/]

    It listens on this machine only. With [cyan]--host 0.0.0.0[/] others see it too, who know the token.
    """
    import ipaddress
    import secrets

    from drivers.watch import Watcher, WatchServer

    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise edge.InputError(f'--host = "{host}": write an address, such as 127.0.0.1 or 0.0.0.0.') from None
    try:
        server = WatchServer(Watcher(recording), host, port, None if local else secrets.token_urlsafe(16))
    except OSError as problem:
        raise edge.InputError(f"--host = {host}, --port = {port}: {problem.strerror}.") from None
    typer.echo(f"Open {server.url} (Ctrl-C ends it)")
    with server, contextlib.suppress(KeyboardInterrupt):
        server.serve_forever()


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN.csv|nc|parquet|mf4", help="File to write.")],
) -> None:
    """Write a recording in another format, by the file's ending; it may be larger than the memory.

    Example: [cyan]cycloid-bench export run.arrows -o run.csv[/]

    .csv is one table: the two angles, paired by the SYNC that latched both, and the torque interpolated to those
    instants. .nc (netCDF), .parquet and .mf4 (MDF4, ASAM) hold every channel's samples as they came.
    """
    from drivers.export import WRITERS
    from drivers.export import export as write
    from drivers.recording_format import RecordingReader

    edge.output_path(output, "--output", WRITERS)
    with RecordingReader(recording) as reader, _bytes_bar(reader) as progress:
        rows = write(reader, output, progress)
    for problem in reader.problems:
        typer.echo(problem, err=True)
    typer.echo(f"{output}: {rows} rows")


@contextlib.contextmanager
def _bytes_bar(reader: RecordingReader) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    columns = (BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=reader.size)
        yield lambda: bar.update(task, completed=reader.position)


@app.command()
def repair(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="WHOLE.arrows", help="Write what it holds here.")
    ] = None,
) -> None:
    """Say what a torn or damaged recording still holds, and write that as a whole one if asked.

    Example: [cyan]cycloid-bench repair torn.arrows -o whole.arrows[/]

    The file itself is not changed. Exit status 1 where something is wrong with it.
    """
    from drivers.export import repaired
    from drivers.recording_format import RecordingReader

    with RecordingReader(recording) as reader, _bytes_bar(reader) as progress:
        held = repaired(reader, output, progress)
    for problem in reader.problems:
        typer.echo(problem, err=True)
    typer.echo(f"{recording}: {reader.complete} batches that can be trusted, {held.events} events")
    for name, channel in held.channels.items():
        lasts = f", from {channel.first:.6f} s to {channel.last:.6f} s" if channel.samples else ""
        gaps = f", {channel.gaps} of them after a gap" if channel.gaps else ""
        typer.echo(f"{name}: {channel.samples} samples{lasts}{gaps}")
    if output is not None:
        typer.echo(f"{output}: written")
    if reader.problems:
        raise typer.Exit(edge.FAILED)


@app.command("list")
def list_() -> None:
    """List protocols, serial ports and CAN interfaces.

    Example: [cyan]cycloid-bench list[/]
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
    commands.run(app)


if __name__ == "__main__":
    main()
