"""`cycloid-bench watch`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

import drivers


def watch(
    recording: Annotated[Path, typer.Argument(metavar="RUN.arrows", help="The recording, finished or growing.")],
    host: Annotated[
        str, typer.Option(help="Address to listen on. A non-local address requires a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port.")] = 0,
) -> None:
    """Show a recording in the browser while it grows: transmission error, spectrum, state of the channels.

    Example: [cyan]cycloid-bench watch run.arrows[/]

    The page is reachable from this machine only; with [cyan]--host 0.0.0.0[/] also from others, with the token.
    """
    with drivers.watch(recording, host=host, port=port) as server, contextlib.suppress(KeyboardInterrupt):
        typer.echo(f"Open {server.url} (Ctrl-C ends it)")
        server.wait()
