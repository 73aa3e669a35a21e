"""`cycloid-fmu desk`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from cycloid_fmu.cli.shared import PairFile


def desk(
    pair_file: PairFile,
    limits_file: Annotated[
        Path | None,
        typer.Option(
            "--limits", metavar="REQUIREMENTS.toml", help="Requirements of the application (cycloid-requirements/1)."
        ),
    ] = None,
) -> None:
    """Edit a pair in the browser, with live drawing, transmission error, backlash, pressure and verdicts.

    Example: [cyan]cycloid-fmu desk pair.toml --limits requirements.toml[/]

    The page is served to this machine only. It saves pair files in the folder of the given one.
    """
    from cycloid_fmu.desk.server import DeskServer

    with DeskServer(pair_file, limits_file) as server, contextlib.suppress(KeyboardInterrupt):
        typer.echo(f"Open {server.url} (Ctrl-C ends it)")
        server.wait()
