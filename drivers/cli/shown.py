"""Output of the commands on a recording: live line, summary, failures."""

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
        "--allow",
        metavar="KIND",
        help="Further connection that the bench file may open besides devices, socket:// and CAN, such as rfc2217.",
    ),
]


def live_text(live: Live) -> str:
    """Return the state of a recording in one line: counts, rates, values, marks, buffer, running TE and disk."""
    parts = []
    for name, state in live.channels.items():
        shown = "–" if state.value is None else f"{state.value:.5g}"
        part = f"{name} {state.samples} ({state.rate:.0f}/s) at {shown}"
        part += "".join(f", {n} {mark}" for mark, n in state.marks.items() if n and mark != "rollovers")
        part += f", {state.lost} lost" if state.lost else ""
        part += f", {state.waiting} waiting" if state.waiting else ""
        parts.append(part + (", FAILED" if state.failure is not None else ""))
    if live.transmission_error is not None:
        parts.append(f"TE {math.degrees(live.transmission_error) * 3600:+.2f}″")
    parts.append(f"{live.events} events, disk {live.disk_free / 1e9:.1f} GB free")
    return " · ".join(parts)


class LiveLine:
    """A live line on standard error, since scripts read standard output; shown from the first call until `pause`.

    If the terminal is closed, the recording continues and nothing more is shown.
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
        """Remove the line until the next call."""
        display, self._display = self._display, None
        if display is not None:
            with contextlib.suppress(OSError):
                display.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *problem: object) -> None:
        self.pause()


def bytes_of(path: Path) -> contextlib.AbstractContextManager[Callable[[float], None]]:
    """Return a progress display in bytes of a file read."""
    return progress("bytes", path.stat().st_size if path.is_file() else None)


@contextlib.contextmanager
def failures() -> Iterator[None]:
    """Print the error of a bench or recording, and exit with its status."""
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
    """Print the summary of an interrupted recording, and exit with the status of its signal; see also `failures`."""
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
    """Print the summary of a recording."""
    from drivers.counts import counted

    samples = ", ".join(f"{n} {name}" for name, n in done.samples.items())
    typer.echo(f"{done.path}: {samples}; {counted(done.events, 'event')}")
    for name, marks in done.marks.items():
        parts = [f"{n} {mark.removesuffix('s') if n == 1 else mark}" for mark, n in marks.items()]
        parts += [f"{done.lost[name]} lost"] if done.lost[name] else []
        if parts:
            typer.echo(f"{name}: {', '.join(parts)}")
    for failure in done.failures:
        typer.echo(str(failure), err=True)
    if not any(done.samples.values()):
        typer.echo("No samples arrived: is the bench sending?", err=True)


def report(done: Recorded) -> None:
    """Print the summary of a recording; exit status 1 if a channel was out at the end or empty, 3 after silence."""
    _print(done)
    if done.ended == "idle" and not done.failures:
        typer.echo("It ended because no more samples arrived.", err=True)
        raise typer.Exit(edge.NO_DATA)
    if done.failures or not any(done.samples.values()):
        raise typer.Exit(edge.FAILED)
