"""`cycloid-bench run`."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import drivers
from cycloid_fmu import edge
from drivers.cli.shown import Allowed, LiveLine, recording

if TYPE_CHECKING:
    from drivers.recorder.sequence import Step


def run(
    sequence: Annotated[
        Path, typer.Argument(metavar="SEQUENCE.toml", help="The sequence: speeds, loads, directions, loops.")
    ],
    allow: Allowed = None,
) -> None:
    """Run a test sequence: prompt for each step, wait, or drive it; check it, and write one recording for each step.

    Example: [cyan]cycloid-bench run sequence.toml[/]

    Recordings are written next to the sequence file. Steps already recorded are skipped, so an interrupted sequence is
    resumed. A recording that falls short is kept under another name, and you are asked whether to repeat the step.
    """
    from drivers.recorder.sequence import read_sequence

    plan = read_sequence(sequence, allow=allow or ())
    numbers = itertools.count(1)

    def note(step: Step, path: Path | None) -> None:
        line.pause()
        begun = f"{next(numbers)} of {len(plan.steps)}: {step.instruction()}" if path is None else f"{path}: recorded"
        typer.echo(begun)

    def ready(step: Step) -> None:
        typer.prompt("Press Enter when the bench is running", default="", show_default=False, err=True)

    def again(step: Step, trial: Path, short: list[str]) -> bool:
        line.pause()
        typer.echo(f"{trial}: not reached: {'; '.join(short)}.", err=True)
        return plan.is_prompted and typer.confirm("Repeat this step?", default=True, err=True)

    with recording(), LiveLine() as line:
        done = drivers.run_sequence(plan, note=note, ready=ready, again=again, progress=line)
    if done.shortfalls:
        raise typer.Exit(edge.FAILED)
