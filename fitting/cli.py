"""The command `cycloid-fit`."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge
from cycloid_fmu.edge import commands

if TYPE_CHECKING:
    from cycloid_fmu.geometry.pair import Pair
    from fitting.curve import Curve
    from fitting.figure import Figure
    from fitting.identification import Identification
    from fitting.metrics import Figures
    from fitting.survey import Surveyed

app = commands.command_line(
    "cycloid-fit", "Measured transmission errors: curves, and the errors of the drive behind them."
)

Recordings = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings of any kind that is read.")]
PairFile = Annotated[Path, typer.Option("--pair", metavar="PAIR.toml", help="The nominal gear pair.")]
PlotFile = Annotated[Path | None, typer.Option("--plot", metavar="FILE.png|pdf", help="Draw the result.")]
HeadFile = Annotated[
    Path | None,
    typer.Option(
        "--read-head", metavar="HEAD.toml", help="Free the output angle of its single head's coaxiality error."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result for scripts: SI, names as in the files.")]

MaybePair = Annotated[Path | None, typer.Option("--pair", metavar="PAIR.toml", help="The nominal gear pair.")]
Ratio = Annotated[float | None, typer.Option(help="Signed ratio input/output, such as -39, in place of a pair.")]
RatedTorque = Annotated[str | None, typer.Option(help='Rated torque at the output, such as "167 N*m".')]
MappingFile = Annotated[
    Path | None, typer.Option("--mapping", metavar="MAP.toml", help="Which channel is what; see [cyan]inspect[/].")
]


@dataclasses.dataclass(frozen=True)
class _Taken:
    """Figures of the recordings that could be taken, the pair where one is named, and what became of the others.

    `left_out` has a sentence for each of these, which is a note of the figures too; `status` is the exit status.
    """

    figures: Figures
    pair: Pair | None
    left_out: list[str]
    status: int

    def say(self, *, as_json: bool) -> None:
        """Print figures and notes for people, or the figures for scripts; leave with the status that belongs to it."""
        from fitting.metrics import figures_json

        if as_json:
            typer.echo(edge.json_text(figures_json(self.figures)))
        else:
            print_figures(self.figures)
        _say_notes(self.left_out if as_json and self.figures.figures else list(self.figures.notes))
        if not self.figures.figures:
            raise edge.InputError("No figure could be computed.")
        if self.status:
            raise typer.Exit(self.status)


def _figures(
    files: list[Path], pair_file: Path | None, ratio: float | None, rated_torque: str | None, mapping: Path | None
) -> _Taken:
    """Take recordings with a progress bar; one that can't be read, or an interrupt, leaves the others' figures."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from cycloid_fmu.geometry.pair import read_pair
    from fitting.mapping import read_mapping
    from fitting.metrics import figures_of
    from fitting.recording import open_bench_recording
    from fitting.survey import survey

    if pair_file is not None and ratio is not None:
        raise edge.InputError(f"--ratio = {ratio:g}: the pair {pair_file} says the ratio; give one of the two.")
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.InputError(f"--ratio = {ratio}: write the signed ratio input/output, such as -39.")
    rated = None if rated_torque is None else edge.quantity_option(rated_torque, "N*m", "--rated-torque")
    if rated is not None and rated <= 0.0:
        raise edge.InputError(f'--rated-torque = "{rated_torque}": it must be above zero.')
    pair = None if pair_file is None else read_pair(pair_file)
    if pair is not None:
        ratio, rated = pair.ratio, rated if rated is not None else pair.rated_torque
    mapped = None if mapping is None else read_mapping(mapping)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    surveyed: list[Surveyed] = []
    left_out: list[str] = []
    status = 0
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading")
        for number, file in enumerate(files, start=1):
            said = f"{file.name} ({number} of {len(files)})"

            def progress(samples: int, said: str = said) -> None:
                bar.update(task, description=f"{said}: {samples / 1e6:.1f} million samples")

            try:
                surveyed.append(survey(open_bench_recording(file, mapped), ratio, rated, progress))
            except edge.InputError as problem:
                left_out.append(str(problem))
                status = edge.BAD_INPUT
            except KeyboardInterrupt:
                if not surveyed:
                    raise
                left_out.append(f"Interrupted: {len(surveyed)} of {len(files)} recordings were taken.")
                status = edge.INTERRUPTED
                break
    if not surveyed:
        raise edge.InputError("\n".join(left_out))
    found = figures_of(surveyed, ratio, rated)
    return _Taken(dataclasses.replace(found, notes=(*left_out, *found.notes)), pair, left_out, status)


def _curves(
    files: list[Path], ratio: float, mapping: Path | None, read_head: Path | None, *, keep_turns: bool = False
) -> list[Curve]:
    """Return the curves of recordings, one for each direction; with a read head, free of its coaxiality error."""
    from fitting.coaxiality import read_read_head, without_coaxiality_error
    from fitting.curve import transmission_error_curves
    from fitting.mapping import read_mapping
    from fitting.recording import open_bench_recording, read_bench_recording

    mapped = None if mapping is None else read_mapping(mapping)
    curves_of = functools.partial(transmission_error_curves, ratio=ratio, keep_turns=keep_turns)
    if read_head is None:
        return [c for f in files for c in curves_of(open_bench_recording(f, mapped))]
    head = read_read_head(read_head)
    corrected = (without_coaxiality_error(read_bench_recording(f, mapped), head) for f in files)
    return [c for one in corrected for c in curves_of(one)]


def _curves_and_loops(
    files: list[Path], pair: Pair, mapping: Path | None, read_head: Path | None, *, keep_turns: bool
) -> tuple[list[Curve], list[Curve]]:
    """Return the curves of recordings and the branches of those that are loops with the input locked."""
    from fitting.loop_branches import branches_of, is_locked
    from fitting.mapping import read_mapping
    from fitting.recording import open_bench_recording
    from fitting.survey import survey

    mapped = None if mapping is None else read_mapping(mapping)
    locked = [f for f in files if is_locked(open_bench_recording(f, mapped))]
    turning = [f for f in files if f not in locked]
    surveyed = [survey(open_bench_recording(f, mapped), pair.ratio, pair.rated_torque) for f in locked]
    return (
        _curves(turning, pair.ratio, mapping, read_head, keep_turns=keep_turns),
        [branch for one in surveyed for branch in branches_of(one, pair.ratio)],
    )


@app.command()
def curve(
    files: Recordings,
    pair_file: PairFile,
    mapping: MappingFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="CURVES.nc", help="Write the curves (netCDF).")
    ] = None,
    read_head: HeadFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Transmission error curves over one output turn, averaged over turns, one for each recording and direction.

    Example: [cyan]cycloid-fit curve 20Nm.arrows 200Nm.arrows --pair pair.toml -o curves.nc --plot curves.png[/]
    """
    import numpy as np

    from cycloid_fmu.draw import plots
    from cycloid_fmu.edge.commands import print_table
    from cycloid_fmu.geometry.pair import read_pair
    from fitting.curve import curves_dataset, noise_of, write_curves
    from fitting.panels import label_of
    from fitting.plots import plot_curves

    if plot is not None:
        plots.check_path(plot)
    pair = read_pair(pair_file)
    curves = _curves(files, pair.ratio, mapping, read_head)
    if output is not None:
        write_curves(curves, output)
    if plot is not None:
        plots.save(plot_curves(curves), plot)
    if as_json:
        data = curves_dataset(curves)
        numbers = {str(k): v.values for k, v in {**data.coords, **data.data_vars}.items()}
        typer.echo(edge.json_text({**numbers, "notes": [note for one in curves for note in one.notes]}))
        return
    rows = []
    for one in curves:
        error = one.transmission_error * edge.ARCSEC
        rows.append(
            [Path(one.source).name, label_of(one), str(one.input_angle.size), f"{one.sample_count.mean():.1f}",
             f"{error.mean():.3f}", f"{np.ptp(error):.3f}", f"{noise_of(one) * edge.ARCSEC:.3f}"]
        )  # fmt: skip
    print_table(
        "Transmission error [arcsec]",
        ["recording", "load", "points", "turns", "mean", "peak-peak", "noise"],
        rows,
    )
    _say_notes([note for one in curves for note in one.notes])


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A bench file of any kind that is read.")],
    dbc: Annotated[Path | None, typer.Option(help="The DBC of a CAN log.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="MAP.toml", help="Write the proposed mapping (TOML).")
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Say what is in a file, propose which channel is what, and draw the channels.

    Example: [cyan]cycloid-fit inspect run.tdms -o map.toml --plot channels.png[/], then check map.toml and give it as
    [cyan]--mapping map.toml[/]
    """
    from cycloid_fmu.draw import plots
    from cycloid_fmu.edge.commands import print_table
    from fitting.inspection import LOOKED_AT, look, propose
    from fitting.plots import plot_channels
    from fitting.readers import open_bench_file

    if plot is not None:
        plots.check_path(plot)
    opened = open_bench_file(file, dbc)
    looks = look(opened)
    if not looks:
        raise edge.InputError(" ".join([*opened.problems, f"{file}: it holds no samples of a numeric channel."]))
    near = None if dbc is None else str(dbc.resolve() if output is None else _beside(dbc, output))
    found = propose(opened, looks, near)
    if output is not None:
        with edge.written_whole(output) as temporary:
            temporary.write_text(found.text, encoding="utf-8")
    if plot is not None:
        plots.save(plot_channels(looks, found.roles), plot)
    if as_json:
        channels = {
            o.channel.name: {
                "unit": o.channel.unit, "samples": o.values.size, "min": float(o.values.min()),
                "max": float(o.values.max()),
            }
            for o in looks
        }  # fmt: skip
        roles = {role: o.channel.name for role, o in found.roles.items()}
        typer.echo(edge.json_text({"channels": channels, "proposed": roles, "problems": opened.problems}))
        return
    roles_of = {o.channel.name: role for role, o in found.roles.items()}
    rows = [
        [o.channel.name, o.channel.unit, str(o.values.size),
         f"{o.values.min():.6g}", f"{o.values.max():.6g}", roles_of.get(o.channel.name, "")]
        for o in looks
    ]  # fmt: skip
    print_table(file.name, ["channel", "unit", "samples", "smallest", "largest", "proposed as"], rows)
    if max(o.values.size for o in looks) >= LOOKED_AT:
        typer.echo(f"Looked at the first {LOOKED_AT} samples.")
    typer.echo("\n# A mapping that may fit; check it and give it as --mapping.\n" + found.text)
    _say_notes(opened.problems)


def _beside(file: Path, other: Path) -> str:
    return os.path.relpath(file.resolve(), other.resolve().parent)


@app.command()
def metrics(
    files: Recordings,
    pair_file: MaybePair = None,
    ratio: Ratio = None,
    rated_torque: RatedTorque = None,
    mapping: MappingFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FIGURES.json", help="Write the figures (JSON).")
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """The standard figures: transmission error, lost motion, backlash, stiffness, hysteresis, starting torques.

    Example: [cyan]cycloid-fit metrics loop.csv *.arrows --ratio -39 --rated-torque "167 N*m"[/]
    """
    from cycloid_fmu.draw import plots
    from fitting.metrics import figures_json
    from fitting.panels import panels_of
    from fitting.plots import plot_panels

    if plot is not None:
        plots.check_path(plot)
    taken = _figures(files, pair_file, ratio, rated_torque, mapping)
    if plot is not None:
        plots.save(plot_panels(panels_of(taken.figures, taken.pair)), plot)
    if output is not None:
        with edge.written_whole(output) as temporary:
            temporary.write_text(edge.json_text(figures_json(taken.figures)), encoding="utf-8")
    taken.say(as_json=as_json)


@app.command()
def report(
    files: Recordings,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REPORT.html|pdf", help="The report.")],
    pair_file: MaybePair = None,
    ratio: Ratio = None,
    rated_torque: RatedTorque = None,
    mapping: MappingFile = None,
    as_json: AsJson = False,
) -> None:
    """A report to hand on: figures, curves, orders, loops, what was left out and why. One file, HTML or PDF.

    Example: [cyan]cycloid-fit report loop.csv *.arrows --pair pair.toml -o report.html[/]
    """
    from fitting.report import FORMATS, write_report

    edge.output_path(output, "--output", FORMATS)
    taken = _figures(files, pair_file, ratio, rated_torque, mapping)
    write_report(taken.figures, output, taken.pair)
    taken.say(as_json=as_json)


@app.command()
def compare(
    before: Annotated[Path, typer.Argument(metavar="A", help="A recording, or figures (JSON) of several.")],
    after: Annotated[Path, typer.Argument(metavar="B", help="What it is compared with.")],
    pair_file: MaybePair = None,
    ratio: Ratio = None,
    rated_torque: RatedTorque = None,
    mapping: MappingFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Which figures moved beyond their uncertainty: before and after, two drives, two temperatures.

    Example: [cyan]cycloid-fit metrics new/*.csv --ratio -39 -o new.json[/], the same for worn.json, then
    [cyan]cycloid-fit compare new.json worn.json --plot moved.png[/]
    """
    from cycloid_fmu.draw import plots
    from cycloid_fmu.edge.commands import print_table
    from fitting.comparison import changes_json, read_figures
    from fitting.comparison import compare as compare_figures
    from fitting.figure import in_field_units
    from fitting.plots import plot_changes

    if plot is not None:
        plots.check_path(plot)
    sides: list[dict[str, Figure]] = []
    notes: list[str] = []
    for file in (before, after):
        if file.suffix.lower() == ".json":
            sides.append(read_figures(file))
        else:
            found = _figures([file], pair_file, ratio, rated_torque, mapping).figures
            sides.append(found.figures)
            notes += found.notes
    changes, said = compare_figures(*sides)
    notes += said
    if not changes:
        raise edge.InputError("\n".join([*notes, f"{before} and {after} have no figure that can be compared."]))
    if plot is not None:
        plots.save(plot_changes(changes), plot)
    if as_json:
        typer.echo(edge.json_text(changes_json(changes, notes)))
        return
    rows = []
    for c in changes:
        as_figure = dataclasses.replace(c.before, value=c.difference, uncertainty=c.uncertainty)
        unit_of = dataclasses.replace(c.after, value=max(abs(c.before.value), abs(c.after.value)))
        difference, uncertainty, unit = in_field_units(as_figure, like=unit_of)
        values = [in_field_units(f, like=unit_of)[0] for f in (c.before, c.after)]
        moved = {True: "yes", False: "no", None: "not known"}[c.moved]
        rows.append([c.name, *values, difference, uncertainty, unit, moved])
    print_table("Changes", ["figure", "A", "B", "B - A", "± 95 %", "unit", "moved"], rows)
    _say_notes(notes)


def _say_notes(notes: list[str]) -> None:
    for note in notes:
        typer.echo(note, err=True)


@app.command()
def identify(
    files: Recordings,
    pair_file: PairFile,
    mapping: MappingFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FIT.json", help="Write the identification (JSON).")
    ] = None,
    surface_file: Annotated[
        Path | None, typer.Option("--surface", metavar="S.nc", help="Write the identified error surface (netCDF).")
    ] = None,
    read_head: HeadFile = None,
    tolerances: Annotated[
        Path | None,
        typer.Option(
            metavar="TOL.toml",
            help="Report every pin and tooth by itself, and the form that all teeth share, with these as prior.",
        ),
    ] = None,
    profile: Annotated[
        list[str] | None, typer.Option(metavar="ERROR", help="Find this error's interval by its profile; repeatable.")
    ] = None,
    bootstrap: Annotated[int, typer.Option(min=0, help="Draw turns again so often; widens what they scatter.")] = 0,
    report_file: Annotated[
        Path | None, typer.Option("--report", metavar="FIT.html", help="Write a report of the fit.")
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Fit the drive's errors to recordings at one or more loads, and say what the data can't tell.

    Hysteresis loops with the input locked may stand among them: they tell the play apart from friction.

    Example: [cyan]cycloid-fit identify loop.csv *.arrows --pair pair.toml -o fit.json --surface s.nc --plot fit.png[/]
    """
    from rich.console import Console

    from cycloid_fmu.draw import plots
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.surfaces.sampling import read_tolerances
    from fitting.fit_report import FORMATS, write_fit_report
    from fitting.identification import as_json as content
    from fitting.identification import write_identification
    from fitting.identify import identify as fit
    from fitting.plots import plot_identification
    from fitting.prior import profile_of, scatter_of

    if plot is not None:
        plots.check_path(plot)
    if report_file is not None:
        edge.output_path(report_file, "--report", FORMATS)
    pair = read_pair(pair_file)
    allowed = None if tolerances is None else read_tolerances(tolerances)
    with Console(stderr=True).status("reading …") as status:
        curves, loops = _curves_and_loops(files, pair, mapping, read_head, keep_turns=bootstrap > 0)
        result = fit(
            curves, pair, lambda step: status.update(f"{step} …"), loops=loops,
            scatter=None if allowed is None else scatter_of(pair, allowed),
            profile=None if allowed is None else profile_of(pair, allowed), profiled=profile or [], bootstrap=bootstrap,
        )  # fmt: skip
    if output is not None:
        write_identification(result, output)
    if surface_file is not None:
        write_surface(result.surface, surface_file)
    if plot is not None:
        plots.save(plot_identification(curves, result), plot)
    if report_file is not None:
        write_fit_report(curves, result, pair, report_file)
    if as_json:
        typer.echo(edge.json_text(content(result)))
        return
    print_identification(result)
    _say_notes([*result.notes, *(note for one in curves for note in one.notes)])


def print_figures(found: Figures) -> None:
    """Print the figures in field units, each with its uncertainty and what is behind it."""
    from cycloid_fmu.edge.commands import print_table
    from fitting.figure import in_field_units

    rows = []
    for name, figure in found.figures.items():
        value, uncertainty, unit = in_field_units(figure)
        rows.append([name, value, uncertainty, unit, f"{figure.count:.4g} {figure.counted}"])
        for part, one in {**figure.parts, **figure.runs}.items():
            value, uncertainty, unit = in_field_units(one)
            rows.append([f"  {Path(part).name}", value, uncertainty, unit, f"{one.count:.4g} {one.counted}"])
    print_table("Figures", ["figure", "value", "± 95 %", "unit", "of"], rows)


def print_identification(result: Identification, truth: dict[str, float] | None = None) -> None:
    """Print identified errors with their 95 % intervals, what is held and why; beside the truth where it is known."""
    from cycloid_fmu.edge.commands import print_table

    scale = {"m": (1e6, "µm"), "rad": (1e3, "mrad")}
    rows, held = [], []
    for p in result.parameters:
        factor, unit = scale[p.unit]
        true = [] if truth is None else [f"{truth.get(p.name, 0.0) * factor:.3f}"]
        if p.held is None:
            low, high = (v * factor for v in p.interval)
            rows.append([f"{p.name} [{unit}]", *true, f"{p.value * factor:.3f}", f"{low:.3f} … {high:.3f}"])
        else:
            held.append([p.name, p.held])
    known = [] if truth is None else ["true"]
    print_table("Identified errors", ["error", *known, "identified", "95 % interval"], rows)
    print_table("Held, because the data can't tell", ["error", "why"], held)
    if result.held_out is not None:
        kept = result.held_out
        typer.echo(
            f"Kept from a first fit and predicted by it: {kept.said}: {kept.residual * edge.ARCSEC:.3f}″ rms left, "
            f"noise {kept.noise * edge.ARCSEC:.3f}″."
        )
    scatter = ", ".join(f"{n} {v * 1e6:.2f} µm" for n, v in result.scatter.items())
    typer.echo(
        f"Residual {result.residual * edge.ARCSEC:.3f}″ rms, noise {result.noise * edge.ARCSEC:.3f}″; "
        f"scatter beyond these errors: {scatter}."
    )
    for one in result.loops:
        typer.echo(
            f"{Path(one.source).name}: play at the crank angle {math.degrees(one.crank_angle):.1f}°: "
            f"{one.play * edge.ARCSEC:.2f} ± {1.96 * one.standard_error * edge.ARCSEC:.2f}″ by the identified errors."
        )


@app.command()
def plan(
    pair_file: Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The nominal gear pair.")],
    torque: Annotated[
        list[str], typer.Option(help='A torque that the bench can hold, such as "20 N*m"; repeat it for each.')
    ],
    turns: Annotated[float, typer.Option(min=0.05, help="Output turns of each run.")] = 2.0,
    samples: Annotated[int, typer.Option(min=6, help="Samples in a crank turn.")] = 24,
    noise: Annotated[str, typer.Option(help="Standard deviation of one sample's transmission error.")] = "0.5 arcsec",
    scatter: Annotated[
        str, typer.Option(help="What single pins and teeth do beyond their low orders, standard deviation.")
    ] = "0.3 um",
    loop: Annotated[
        str | None,
        typer.Option(help='Also with a hysteresis loop to this torque, such as "181 N*m", the crank locked at pin 0.'),
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Say before anything is measured which loads and directions would identify which errors, and how well.

    Example: [cyan]cycloid-fit plan pair.toml --torque "20 N*m" --torque "200 N*m"[/]
    """
    from cycloid_fmu.draw import plots
    from cycloid_fmu.edge.commands import print_table
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.structured import unit_of
    from fitting.observation import errors_of
    from fitting.plan import bench_plans
    from fitting.plots import plot_plans

    if plot is not None:
        plots.check_path(plot)
    pair = read_pair(pair_file)
    loads = [edge.quantity_option(t, "N*m", "--torque") for t in torque]
    if min(loads) <= 0.0:
        raise edge.InputError(
            f"--torque = {min(loads):g} N*m: it must be above zero; the sign follows from the direction."
        )
    level, spread = edge.quantity_option(noise, "rad", "--noise"), edge.quantity_option(scatter, "m", "--scatter")
    if level <= 0.0 or spread < 0.0:
        raise edge.InputError(
            f'--noise = "{noise}", --scatter = "{scatter}": the noise must be above zero, the scatter not below it.'
        )
    wound = None if loop is None else edge.quantity_option(loop, "N*m", "--loop")
    if wound is not None and wound <= 0.0:
        raise edge.InputError(f'--loop = "{loop}": it must be above zero; a loop goes to both sides.')
    plans = bench_plans(pair, loads, turns=turns, samples=samples, noise=level, scatter=spread, loop=wound)
    if plot is not None:
        plots.save(plot_plans(plans), plot)
    if as_json:
        typer.echo(edge.json_text([dataclasses.asdict(p) for p in plans]))
        return
    scale = {"m": (1e6, "µm"), "rad": (1e3, "mrad")}
    rows = []
    for name in errors_of(pair):
        factor, unit = scale[unit_of(name)]
        known = [f"{p.standard_error[name] * factor:.3f}" if name in p.standard_error else "–" for p in plans]
        rows.append([f"{name} [{unit}]", *known])
    labels = [chr(ord("A") + i) for i in range(len(plans))]
    print_table("Standard error of what each set of runs would identify", ["error", *labels], rows)
    for label, one in zip(labels, plans, strict=True):
        typer.echo(f"{label}: {one.said}")
    print_table("Held with all runs", ["error", "why"], [list(item) for item in plans[-1].held.items()])


@app.command()
def ensemble(
    surface_file: Annotated[Path, typer.Argument(metavar="S.nc", help="An identified error surface.")],
    pair_file: PairFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where the surfaces go.")],
    count: Annotated[int, typer.Option(min=1, max=10000, help="How many.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same surfaces.")] = 0,
    torque: Annotated[
        str | None, typer.Option(help="Torque on the output at which --plot draws the transmission errors' band.")
    ] = None,
    plot: PlotFile = None,
) -> None:
    """Draw error surfaces that the fit can't tell from the identified one: FMUs built from them make a band.

    Example: [cyan]cycloid-fit ensemble s.nc --pair pair.toml -o drawn --torque "100 N*m" --plot band.png[/]
    """
    from rich.progress import track

    from cycloid_fmu.draw import plots
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.files import read_surface, write_surface
    from cycloid_fmu.surfaces.surface import check_surface
    from fitting.ensemble import drawn_surfaces
    from fitting.plots import plot_band

    if plot is not None:
        plots.check_path(plot)
    if (plot is None) != (torque is None):
        raise edge.InputError("--plot and --torque belong together: the band is drawn at one torque.")
    load = 0.0 if torque is None else edge.quantity_option(torque, "N*m", "--torque")
    pair, surface = read_pair(pair_file), read_surface(surface_file)
    check_surface(pair, surface, str(pair_file), str(surface_file))
    if surface.covariance is None:
        raise edge.InputError(f"{surface_file}: there is no covariance of a fit; give what cycloid-fit identify wrote.")
    drawn = drawn_surfaces(pair, surface, count, seed)
    output.mkdir(parents=True, exist_ok=True)
    for number, one in enumerate(track(drawn, "writing", transient=True)):
        write_surface(one, output / f"{surface_file.stem}-{number:04d}.nc")
    if plot is not None:
        plots.save(plot_band(pair, surface, drawn, load), plot)
    typer.echo(f"{count} error surfaces are in {output}.")


def main() -> None:
    """Run the command line."""
    commands.run(app)
