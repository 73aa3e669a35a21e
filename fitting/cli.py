"""The command `cycloid-fit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cycloid_fmu import edge

if TYPE_CHECKING:
    from fitting.recording import BenchRecording

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich",
    help="Measured transmission errors: curves, and the errors of the drive behind them.",
)  # fmt: skip

Recordings = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings, .arrows or .csv.")]
PairFile = Annotated[Path, typer.Option("--pair", metavar="PAIR.toml", help="The nominal gear pair.")]
PlotFile = Annotated[Path | None, typer.Option("--plot", metavar="FILE.png|pdf", help="Draw the result.")]
HeadFile = Annotated[
    Path | None,
    typer.Option(
        "--read-head", metavar="HEAD.toml", help="Free the output angle of its single head's coaxiality error."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result for scripts: SI, names as in the files.")]


@app.command()
def curve(
    files: Recordings,
    pair_file: PairFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Write the curves (netCDF).")] = None,
    read_head: HeadFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Transmission error curves over one output turn, averaged over turns, one for each recording.

    Example: [cyan]cycloid-fit curve 20Nm.arrows 200Nm.arrows --pair pair.toml -o curves.nc --plot curves.png[/]
    """
    import numpy as np

    from cycloid_fmu import plots
    from cycloid_fmu.cli import print_table
    from cycloid_fmu.pair import read_pair
    from fitting.curve import curves_dataset, noise_of, transmission_error_curve, write_curves
    from fitting.plots import label_of, plot_curves

    if plot is not None:
        plots.check_path(plot)
    pair = read_pair(pair_file)
    curves = [transmission_error_curve(r, pair.ratio) for r in _recordings(files, read_head)]
    if output is not None:
        write_curves(curves, output)
    if plot is not None:
        plots.save(plot_curves(curves), plot)
    if as_json:
        data = curves_dataset(curves)
        typer.echo(edge.json_text({str(k): v.values for k, v in {**data.coords, **data.data_vars}.items()}))
        return
    rows = []
    for file, one in zip(files, curves, strict=True):
        error = one.transmission_error * plots.ARCSEC
        rows.append(
            [file.name, label_of(one), str(one.input_angle.size), f"{one.sample_count.mean():.1f}",
             f"{error.mean():.3f}", f"{np.ptp(error):.3f}", f"{noise_of(one) * plots.ARCSEC:.3f}"]
        )  # fmt: skip
    print_table(
        "Transmission error [arcsec]",
        ["recording", "load", "points", "turns", "mean", "peak-peak", "noise"],
        rows,
    )
    _say_notes([note for one in curves for note in one.notes])


def _recordings(files: list[Path], read_head: Path | None) -> list[BenchRecording]:
    from fitting.coaxiality import read_read_head, without_coaxiality_error
    from fitting.recording import read_bench_recording

    recordings = [read_bench_recording(f) for f in files]
    if read_head is None:
        return recordings
    head = read_read_head(read_head)
    return [without_coaxiality_error(r, head) for r in recordings]


def _say_notes(notes: list[str]) -> None:
    for note in notes:
        typer.echo(note, err=True)


@app.command()
def identify(
    files: Recordings,
    pair_file: PairFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Write the identification (JSON).")] = None,
    surface_file: Annotated[
        Path | None, typer.Option("--surface", metavar="S.nc", help="Write the identified error surface (netCDF).")
    ] = None,
    read_head: HeadFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Fit the drive's errors to recordings at one or more loads, and say what the data can't tell.

    Example: [cyan]cycloid-fit identify *.arrows --pair pair.toml -o fit.json --surface identified.nc --plot fit.png[/]
    """
    from rich.console import Console

    from cycloid_fmu import plots
    from cycloid_fmu.pair import read_pair
    from cycloid_fmu.surface import write_surface
    from fitting.curve import transmission_error_curve
    from fitting.identify import as_json as content
    from fitting.identify import identify as fit
    from fitting.identify import write_identification
    from fitting.plots import plot_identification

    if plot is not None:
        plots.check_path(plot)
    pair = read_pair(pair_file)
    curves = [transmission_error_curve(r, pair.ratio) for r in _recordings(files, read_head)]
    console = Console(stderr=True)
    with console.status("reading") as status:
        result = fit(curves, pair, lambda step: status.update(f"{step} …"))
    if output is not None:
        write_identification(result, output)
    if surface_file is not None:
        write_surface(result.surface, surface_file)
    if plot is not None:
        plots.save(plot_identification(curves, result), plot)
    if as_json:
        typer.echo(edge.json_text(content(result)))
        return
    print_identification(result)
    _say_notes([*result.notes, *(note for one in curves for note in one.notes)])


def print_identification(result: object, truth: dict[str, float] | None = None) -> None:
    """Print identified errors with their 95 % intervals, what is held and why; beside the truth where it is known."""
    from cycloid_fmu.cli import print_table
    from cycloid_fmu.plots import ARCSEC
    from fitting.identify import Identification

    assert isinstance(result, Identification)
    scale = {"m": (1e6, "µm"), "rad": (1e3, "mrad")}
    rows, held = [], []
    for p in result.parameters:
        factor, unit = scale[p.unit]
        true = [] if truth is None else [f"{truth.get(p.name, 0.0) * factor:.3f}"]
        if p.held is None:
            low, high = (v * factor for v in p.interval)
            rows.append(
                [f"{p.name} [{unit}]".replace("[", "\\["), *true, f"{p.value * factor:.3f}", f"{low:.3f} … {high:.3f}"]
            )
        else:
            held.append([p.name, p.held])
    known = [] if truth is None else ["true"]
    print_table("Identified errors", ["error", *known, "identified", "95 % interval"], rows)
    print_table("Held, because the data can't tell", ["error", "why"], held)
    if result.held_out is not None:
        kept = result.held_out
        typer.echo(
            f"Kept from a first fit and predicted by it: {kept.said}: {kept.residual * ARCSEC:.3f}″ rms left, "
            f"noise {kept.noise * ARCSEC:.3f}″."
        )
    scatter = ", ".join(f"{n} {v * 1e6:.2f} µm" for n, v in result.scatter.items())
    typer.echo(
        f"Residual {result.residual * ARCSEC:.3f}″ rms, noise {result.noise * ARCSEC:.3f}″; "
        f"scatter beyond these errors: {scatter}."
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
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Say before anything is measured which loads and directions would identify which errors, and how well.

    Example: [cyan]cycloid-fit plan pair.toml --torque "20 N*m" --torque "200 N*m"[/]
    """
    import dataclasses

    from cycloid_fmu import plots
    from cycloid_fmu.cli import print_table
    from cycloid_fmu.pair import read_pair
    from cycloid_fmu.surface import unit_of
    from fitting.identifiability import bench_plans, errors_of
    from fitting.plots import plot_plans

    if plot is not None:
        plots.check_path(plot)
    pair = read_pair(pair_file)
    loads = [edge.quantity_option(t, "N*m", "--torque") for t in torque]
    if min(loads) <= 0.0:
        raise edge.InputError("--torque: it must be above zero; the sign follows from the direction.")
    level, spread = edge.quantity_option(noise, "rad", "--noise"), edge.quantity_option(scatter, "m", "--scatter")
    if level <= 0.0 or spread < 0.0:
        raise edge.InputError("--noise must be above zero and --scatter not below it.")
    plans = bench_plans(pair, loads, turns=turns, samples=samples, noise=level, scatter=spread)
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
        rows.append([f"{name} \\[{unit}]", *known])
    labels = [chr(ord("A") + i) for i in range(len(plans))]
    print_table("Standard error of what each set of runs would identify", ["error", *labels], rows)
    for label, one in zip(labels, plans, strict=True):
        typer.echo(f"{label}: {one.said}")
    print_table("Held with all runs", ["error", "why"], [list(item) for item in plans[-1].held.items()])


@app.command()
def ensemble(
    surface_file: Annotated[Path, typer.Argument(metavar="S.nc", help="An identified error surface.")],
    pair_file: PairFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Where the surfaces go.")],
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

    from cycloid_fmu import plots
    from cycloid_fmu.pair import read_pair
    from cycloid_fmu.surface import check_surface, read_surface, write_surface
    from fitting.ensemble import drawn_surfaces
    from fitting.plots import plot_band

    if plot is not None:
        plots.check_path(plot)
    if (plot is None) != (torque is None):
        raise edge.InputError("--plot and --torque belong together: the band is drawn at one torque.")
    load = 0.0 if torque is None else edge.quantity_option(torque, "N*m", "--torque")
    pair, surface = read_pair(pair_file), read_surface(surface_file)
    check_surface(pair, surface, str(pair_file), str(surface_file))
    drawn = drawn_surfaces(pair, surface, count, seed)
    output.mkdir(parents=True, exist_ok=True)
    for number, one in enumerate(track(drawn, "writing", transient=True)):
        write_surface(one, output / f"{surface_file.stem}-{number:04d}.nc")
    if plot is not None:
        plots.save(plot_band(pair, surface, drawn, load), plot)
    typer.echo(f"{count} error surfaces are in {output}.")


def main() -> None:
    """Run the command line."""
    edge.run(lambda: app)
