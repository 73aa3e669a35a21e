"""`cycloid-fmu example`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import cycloid_fmu
from cycloid_fmu import edge
from cycloid_fmu.edge import commands

_ENDINGS = (".toml", ".csv")


def example(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="The example. Default: list them.")] = None,
    output: Annotated[
        Path | None, commands.output_option(_ENDINGS, "FILE", "File to write. Default: the example's own name.")
    ] = None,
) -> None:
    """Write an example file to start from: a pair, tolerances, limits, wear, a reducer and others.

    Example: [cyan]cycloid-fmu example drive-39-40.toml -o drive.toml[/]
    """
    found = {path.name: path for path in sorted(_folder().iterdir()) if path.suffix in _ENDINGS}
    if name is None:
        rows = [[file, str(edge.format_of(path) or "table")] for file, path in found.items()]
        commands.print_table("Examples", ["name", "format"], rows)
        return
    if name not in found:
        near = edge.did_you_mean(name, found)
        raise edge.InputError(f"{name} is not an example; {near or 'see cycloid-fmu example.'}")
    target = output or Path(name)
    if target.exists():
        raise edge.ArgumentError("output", "this file exists and is not overwritten; give another name", target)
    with edge.written_whole(target) as part:
        part.write_bytes(found[name].read_bytes())


def _folder() -> Path:
    """Return the folder of the examples: inside an installed package, next to it in the repository."""
    package = Path(cycloid_fmu.__file__).parent
    inside = package / "examples"
    return inside if inside.is_dir() else package.parent / "examples"
