"""What the commands show of a recording: the line while it grows, what it got, and why it failed."""

from __future__ import annotations

import contextlib
import math
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge.commands import progress

if TYPE_CHECKING:
    from rich.live import Live as Display

    from drivers.recorder.session import Live, Recorded

Allowed = Annotated[
    list[str] | None,
    typer.Option(
        "--allow", metavar="KIND",
        help="Kind of connection that the bench file may open besides devices, socket:// and CAN: rfc2217.",
    ),
]  # fmt: skip


def live_text(live: Live) -> str:
    """Return the state of a recording, in one line: rates, counts, positions, marks, buffer, disk and running TE."""
    parts = []
    for name, state in live.channels.items():
        shown = "–" if state.value is None else f"{state.value:.5g}"
        part = f"{name} {state.samples} ({state.rate:.0f}/s) at {shown}"
        part += "".join(f", {n} {mark}" for mark, n in state.marks.items() if n and mark != "rollovers")
        part += f", {state.lost} lost" if state.lost else ""
        part += f", {state.waiting} waiting" if state.waiting else ""
        parts.append(part + (" OUT" if state.failure is not None else ""))
    if live.transmission_error is not None:
        parts.append(f"TE {math.degrees(live.transmission_error) * 3600:+.2f}″")
    parts.append(f"{live.events} events, disk {live.disk_free / 1e9:.1f} GB free")
    return " · ".join(parts)


class LiveLine:
    """The live line on the error stream, as the output is what scripts read: from the first call until a pause.

    A terminal that is gone is no reason to end a recording: from then on nothing is shown.
    """

    def __init__(self) -> None:
        self._display: Display | None = None
        self._gone = False

    def __call__(self, live: Live) -> None:
        """Show the state of the recording."""
        from rich.console import Console
        from rich.live import Live as Display
        from rich.text import Text

        if self._gone:
            return
        try:
            if self._display is None:
                self._display = Display(console=Console(stderr=True), transient=True, refresh_per_second=5)
                self._display.start()
            self._display.update(Text(live_text(live)))
        except OSError:
            self._gone = True

    def pause(self) -> None:
        """Take the line away until the next call."""
        display, self._display = self._display, None
        if display is not None:
            with contextlib.suppress(OSError):
                display.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *problem: object) -> None:
        self.pause()


def bytes_of(path: Path) -> contextlib.AbstractContextManager[Callable[[float], None]]:
    """Show how much of a file is read."""
    return progress("bytes", path.stat().st_size if path.is_file() else None)


@contextlib.contextmanager
def failures() -> Iterator[None]:
    """Show why a bench or a recording failed, with the exit status that belongs to it."""
    from drivers.encoder import EncoderError
    from drivers.recorder.session import RecordingError

    try:
        yield
    except edge.InputError:
        raise
    except (EncoderError, RecordingError) as problem:
        typer.echo(str(problem), err=True)
        raise typer.Exit(edge.FAILED) from None


@contextlib.contextmanager
def recording() -> Iterator[None]:
    """Print what an interrupted recording got, and end with the exit status of its signal; see also `failures`."""
    from drivers.recorder.session import RecordingInterrupted

    try:
        with failures():
            yield
    except RecordingInterrupted as interrupt:
        try:
            _print(interrupt.recorded)
            typer.echo(str(interrupt), err=True)
            sys.stdout.flush()
        except OSError:  # the terminal is gone; Python's own flush at the end would fail and change the status
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for descriptor in (1, 2):
                os.dup2(nowhere, descriptor)
        raise typer.Exit(interrupt.exit_status) from None


def _print(done: Recorded) -> None:
    """Print what a recording got."""
    typer.echo(f"{done.path}: {', '.join(f'{n} {name}' for name, n in done.samples.items())}; {done.events} events")
    for name, marks in done.marks.items():
        said = [f"{n} {mark}" for mark, n in marks.items()]
        said += [f"{done.lost[name]} lost"] if done.lost[name] else []
        if said:
            typer.echo(f"{name}: {', '.join(said)}")
    for failure in done.failures:
        typer.echo(str(failure), err=True)
    if not any(done.samples.values()):
        typer.echo("No sample came: is the bench sending?", err=True)


def report(done: Recorded) -> None:
    """Print what a recording got; exit status 1 where a channel was out at the end or nothing came, 3 after silence."""
    _print(done)
    if done.ended == "idle" and not done.failures:
        typer.echo("It ended because no more samples came.", err=True)
        raise typer.Exit(edge.SILENT)
    if done.failures or not any(done.samples.values()):
        raise typer.Exit(edge.FAILED)
