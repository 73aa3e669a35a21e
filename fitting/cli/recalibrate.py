"""`cycloid-fit recalibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import ARCSEC, commands
from fitting.cli import options

if TYPE_CHECKING:
    from fitting.recalibration.measured import LostMotion
    from fitting.recalibration.plan import PlannedVisit
    from fitting.recalibration.recalibrate import Recalibration

_SHOWN = 4  # most errors listed as more accurately known
_NAMES = {
    "backlash": "backlash, mean",
    "lost_motion": "lost motion at ± 3 %, mean",
    "transmission_error": "transmission error at rated torque, peak to peak",
}


def recalibrate(
    drive: options.PairFile,
    before: Annotated[Path, typer.Option(metavar="S.nc", help="The last surface that identify or recalibrate wrote.")],
    crank_turns: Annotated[float, typer.Option(min=0.0, help="Crank turns since that surface's date.")],
    bits: Annotated[
        int | None, typer.Option(min=8, max=32, help="Resolution of the output encoder, bits per turn.")
    ] = None,
    output: Annotated[
        Path | None, commands.output_option((".json",), "NOW.json", "Write the recalibration (JSON).")
    ] = None,
    surface: Annotated[
        Path | None, commands.output_option((".nc",), "NOW.nc", "Write the updated surface.", "--surface")
    ] = None,
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILE...]", help="Recordings against the joint's output encoder.")
    ] = None,
    after: Annotated[
        Path | None, typer.Option(metavar="LAST.json", help="The last recalibration; its history is continued.")
    ] = None,
    mapping: options.MappingFiles = None,
    lost_motion: Annotated[
        list[str] | None,
        typer.Option(
            metavar='"58 arcsec +- 6 arcsec at 5 N*m"',
            help="A measured lost motion, half its 95 % interval, and the torque in each direction; repeatable.",
        ),
    ] = None,
    drift: Annotated[
        float,
        commands.quantity_option(
            "m", "Standard deviation of uniform wear in 10^7 crank turns.", show_default="1 um", metavar='"1 um"'
        ),
    ] = 1e-6,
    plan: Annotated[
        list[float] | None,
        commands.quantity_option("N*m", "Only plan, for this possible load of the joint; repeatable.", "--plan"),
    ] = None,
    wanted: Annotated[
        float | None,
        commands.quantity_option(
            "rad", "With --plan: required half width of the backlash's 95 % interval.", metavar='"5 arcsec"'
        ),
    ] = None,
    mark: Annotated[
        float | None,
        commands.quantity_option(
            "rad", "With --plan: standard deviation of one passage of an index mark.", metavar='"1 arcsec"'
        ),
    ] = None,
    plot: commands.PlotFile = None,
    as_json: commands.AsJson = False,
) -> None:
    """Update the model of a drive from measurements of its joint, and report whether it is still valid.

    Exit status 4 if it is not; the drive is then not updated.

    Example: [cyan]cycloid-fit recalibrate *.csv --pair pair.toml --before s.nc --crank-turns 1e7 --bits 17 -o now.json
    --surface now.nc --plot now.png[/]
    """
    import fitting
    from cycloid_fmu.drive import read_drive
    from fitting.recalibration.files import as_json as content
    from fitting.recalibration.files import read_recalibration, write_recalibration
    from fitting.recalibration.plan import plan_visit
    from fitting.recalibration.recalibrate import recalibrate

    known = read_drive(drive, before)
    last = known if after is None else read_recalibration(after, known)
    if plan:
        if bits is None:
            raise edge.InputError("--plan needs --bits: the resolution of the output encoder.")
        visits = plan_visit(last, plan, crank_turns=crank_turns, bits=bits, wanted=wanted, mark=mark, drift=drift)
        options.write(visits, plot=plot)
        if as_json:
            commands.print_json([vars(visit) for visit in visits])
        else:
            _print_plan(visits, wanted)
        return
    if wanted is not None or mark is not None:
        raise edge.InputError("--wanted and --mark belong to --plan.")
    result = recalibrate(
        last,
        fitting.read_recordings(files, mapping) if files else (),
        lost_motions=[_lost_motion(text) for text in lost_motion or ()],
        crank_turns=crank_turns,
        bits=bits,
        drift=drift,
    )
    if output is not None:
        write_recalibration(result, output)
    notes = list(result.notes)
    if surface is not None:
        has_bearings = result.drive.pair.supports is not None or result.drive.first_stage is not None
        notes += options.write_drive(result.drive, surface, "updated" if has_bearings else "")
    options.write(result, plot=plot)
    if as_json:
        commands.print_json(content(result))
    else:
        _print(result)
        options.print_notes(notes)
    if result.alarm:
        raise typer.Exit(edge.NOT_MET)


def _lost_motion(text: str) -> LostMotion:
    """Return a lost motion from text such as "58 arcsec +- 6 arcsec at 5 N*m"."""
    from fitting.estimation.parameter import NORMAL
    from fitting.recalibration.measured import LostMotion

    value, _, rest = text.replace("±", "+-").partition("+-")
    spread, _, torque = rest.partition(" at ")
    try:
        parts = ((value, "rad"), (spread, "rad"), (torque, "N*m"))
        numbers = [edge.parse_quantity(part.strip(), si) for part, si in parts]
        return LostMotion(numbers[0], numbers[1] / NORMAL, numbers[2])
    except (ValueError, edge.InputError):
        raise edge.ArgumentError(
            "lost_motion", 'write value, half interval and torque, such as "58 arcsec +- 6 arcsec at 5 N*m"', text
        ) from None


def _print(result: Recalibration) -> None:
    typer.echo(
        result.alarm
        or "The model is valid: the measurements agree with it within noise and the drift since the last date."
    )
    rows = []
    for name, label in _NAMES.items():
        if name in result.figures:
            was, now = (dated.figures[name] for dated in result.history[-2:])
            low, high = (end * ARCSEC for end in now.interval)
            rows.append([label, f"{was.value * ARCSEC:.2f}", f"{now.value * ARCSEC:.2f}", f"{low:.2f} … {high:.2f}"])
    commands.print_table("Figures [arcsec]", ["figure", "last date", "now", "95 % interval"], rows)
    if result.alarm:
        return
    if result.better_known:
        more = len(result.better_known) - _SHOWN
        rest = f" and {more} more, see --output" if more > 0 else ""
        typer.echo(f"Now known more accurately (standard deviations): {'; '.join(result.better_known[:_SHOWN])}{rest}.")
    typer.echo(
        f"The measurements determine {result.told.size - result.remaining} combinations of errors; "
        f"{result.remaining} keep their prior uncertainty."
    )


def _print_plan(visits: list[PlannedVisit], wanted: float | None) -> None:
    turns = [*visits[0].half_width]
    rows = []
    for visit in visits:
        enough = [] if wanted is None else ["–" if visit.turns is None else str(visit.turns)]
        rows.append([visit.runs, *(f"{width * ARCSEC:.2f}" for width in visit.half_width.values()), *enough])
    head = ["runs", *(str(t) for t in turns), *([] if wanted is None else ["turns needed"])]
    commands.print_table("Half width of the backlash's 95 % interval [arcsec] by output turns", head, rows)
