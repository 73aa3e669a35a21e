"""The command `cycloid-fmu`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cycloid_fmu import edge
from cycloid_fmu.edge import commands
from cycloid_fmu.edge.commands import print_table

if TYPE_CHECKING:
    import numpy
    from numpy.typing import NDArray

    from cycloid_fmu.fmu.description import Version
    from cycloid_fmu.fmu.variables import Interface
    from cycloid_fmu.geometry.pair import Pair
    from cycloid_fmu.reducer.budget import Reducer
    from cycloid_fmu.surfaces.surface import ErrorSurface

app = commands.command_line(
    "cycloid-fmu", "Cycloid-pin gear drives: transmission error, backlash, load sharing, and FMUs made from them."
)

PairFile = Annotated[Path, typer.Argument(metavar="PAIR.toml", help="The gear pair (format cycloid-pair/1).")]
SurfaceFile = Annotated[
    Path | None,
    typer.Option("--surface", metavar="S.nc", help="Error surface; without it the errors that the pair file states."),
]
PlotFile = Annotated[Path | None, typer.Option("--plot", metavar="FILE.png|pdf", help="Draw the result.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result for scripts: SI, names as in the files.")]


def _load(pair_file: Path, surface_file: Path | None) -> tuple[Pair, ErrorSurface]:
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.files import read_surface
    from cycloid_fmu.surfaces.surface import check_surface, surface_of_pair

    pair = read_pair(pair_file)
    if surface_file is None:
        return pair, surface_of_pair(pair)
    surface = read_surface(surface_file)
    check_surface(pair, surface, str(pair_file), str(surface_file))
    return pair, surface


@contextlib.contextmanager
def _bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)


@app.command()
def analyze(
    pair_file: PairFile,
    torque: Annotated[list[str], typer.Option(help='Torque on the output, such as "-181 N*m"; may be repeated.')],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT.nc", help="Write the dataset (netCDF).")
    ] = None,
    surface_file: SurfaceFile = None,
    angles: Annotated[int, typer.Option(min=1, help="Crank angles, evenly from 0, end excluded.")] = 360,
    turns: Annotated[int, typer.Option(min=1, help="Crank turns that they span.")] = 1,
    slices: Annotated[
        int | None,
        typer.Option(
            min=1, help="Slices across the face, with contact lines and element pressures.", show_default=False
        ),
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Transmission error, backlash, stiffness, load sharing and pressure over a crank sweep.

    Example: [cyan]cycloid-fmu analyze pair.toml --torque "-181 N*m" --torque "181 N*m" -o out.nc --plot out.png[/]
    """
    import numpy as np
    from rich.progress import Progress

    from cycloid_fmu.contact.transmission import analyze as analyze_pair
    from cycloid_fmu.contact.transmission import slices_needed, statistics
    from cycloid_fmu.draw import plots

    loads = [edge.quantity_option(t, "N*m", "--torque") for t in torque]
    if plot is not None:
        plots.check_path(plot)
    pair, surface = _load(pair_file, surface_file)
    angle = np.linspace(0.0, 2.0 * np.pi * turns, angles, endpoint=False)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("crank angles", total=angles * len(loads))
        data = analyze_pair(
            pair,
            surface,
            loads,
            angle,
            slices or slices_needed(surface),
            with_elements=slices is not None,
            workers=os.cpu_count() or 1,
            progress=lambda done: bar.advance(task, done),
        )
    if output is not None:
        with edge.written_whole(output) as temporary:
            data.to_netcdf(temporary, engine="h5netcdf")
    finished = data.sizes["crank_angle"]
    if finished < angles:
        typer.echo(f"Interrupted: {finished} of {angles} crank angles are done.", err=True)
    if finished == 0:
        raise typer.Exit(edge.INTERRUPTED)
    if plot is not None:
        plots.save(plots.plot_analysis(data), plot)
        if slices is not None:
            plots.save(plots.plot_lines(data), plot.with_stem(f"{plot.stem}-lines"))
    if as_json:
        typer.echo(edge.json_text({str(k): v.values for k, v in {**data.coords, **data.data_vars}.items()}))
    else:
        rows = []
        figures = statistics(data)
        for k, load in enumerate(data["torque"].values):
            mte, ppte, mb, ppb = (figures[n][k] * edge.ARCSEC for n in ("MTE", "PPTE", "MB", "PPB"))
            count = data["contact_count"].values[k]
            deepest = data["interference"].values[k].max() * 1e6
            backlash = [f"{mb:.4f}″", f"{ppb:.4f}″"] if deepest == 0.0 else ["interference", f"{deepest:.3f} µm"]
            rows.append(
                [f"{load:g} N·m", f"{mte:.4f}″", f"{ppte:.4f}″", *backlash, f"{figures['MCS'][k] * 1e-6:.1f} MPa",
                 f"{count.min()}–{count.max()}"]
            )  # fmt: skip
        columns = ["torque", "MTE", "PPTE", "MB", "PPB", "MCS", "pins"]
        print_table(f"{pair_file.name}, {finished} crank angles over {turns} turn(s)", columns, rows)
        typer.echo("Mean and peak-to-peak transmission error and backlash, largest contact pressure, pins in contact.")
    if finished < angles:
        raise typer.Exit(edge.INTERRUPTED)


surface_app = commands.subcommands("Make error surfaces.")
app.add_typer(surface_app, name="surface")


SurfaceOutput = Annotated[Path, typer.Option("--output", "-o", metavar="SURFACE.nc", help="The surface file (netCDF).")]


@surface_app.command()
def nominal(
    pair_file: PairFile,
    output: SurfaceOutput,
    plot: PlotFile = None,
) -> None:
    """Write the surface that the pair file itself describes: nominal flanks with the errors it states.

    Example: [cyan]cycloid-fmu surface nominal pair.toml -o surface.nc[/]
    """
    from cycloid_fmu.draw import plots
    from cycloid_fmu.surfaces.files import write_surface

    if plot is not None:
        plots.check_path(plot)
    _, surface = _load(pair_file, None)
    write_surface(surface, output)
    if plot is not None:
        plots.save(plots.plot_surface(surface), plot)


@surface_app.command()
def sampled(
    pair_file: PairFile,
    tolerances_file: Annotated[
        Path, typer.Option("--tolerances", metavar="T.toml", help="The tolerances (format cycloid-tolerances/1).")
    ],
    seed: Annotated[int, typer.Option(help="The same seed draws the same drive.")],
    output: SurfaceOutput,
    profile: Annotated[int, typer.Option(min=1, help="Elements along a tooth's profile.")] = 200,
    width: Annotated[int, typer.Option(min=1, help="Elements across the width.")] = 20,
    angle: Annotated[int, typer.Option(min=1, help="Elements round the half of a pin.")] = 100,
    plot: PlotFile = None,
) -> None:
    """Draw one drive that the tolerances allow; the errors that the pair file itself states are not part of it.

    Example: [cyan]cycloid-fmu surface sampled pair.toml --tolerances tolerances.toml --seed 1 -o surface.nc[/]
    """
    from cycloid_fmu.draw import plots
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.surfaces.sampling import read_tolerances, sample_surface
    from cycloid_fmu.surfaces.surface import Elements

    if plot is not None:
        plots.check_path(plot)
    pair, tolerances = read_pair(pair_file), read_tolerances(tolerances_file)
    surface = sample_surface(pair, tolerances, seed, Elements(profile, width, angle))
    write_surface(surface, output)
    if plot is not None:
        plots.save(plots.plot_surface(surface), plot)


@surface_app.command()
def measured(
    pair_file: PairFile,
    points_file: Annotated[
        Path,
        typer.Option(
            "--points",
            metavar="CMM.csv",
            help="Points of flanks and pins: body,disc,number,x \\[mm],y \\[mm],z \\[mm].",
        ),
    ],
    output: SurfaceOutput,
    profile: Annotated[int, typer.Option(min=1, help="Elements along a tooth's profile.")] = 50,
    width: Annotated[int, typer.Option(min=1, help="Elements across the width.")] = 5,
    angle: Annotated[int, typer.Option(min=1, help="Elements round the half of a pin.")] = 25,
    plot: PlotFile = None,
) -> None:
    """Find the surface that coordinates of a measuring machine show: aligned, outliers left out, averaged.

    Example: [cyan]cycloid-fmu surface measured pair.toml --points cmm.csv -o surface.nc --plot surface.png[/]
    """
    import numpy as np

    from cycloid_fmu.draw import plots
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.surfaces.measuring import measured_surface, read_points
    from cycloid_fmu.surfaces.surface import Elements

    if plot is not None:
        plots.check_path(plot)
    pair, points = read_pair(pair_file), read_points(points_file)
    surface, report = measured_surface(pair, points, Elements(profile, width, angle))
    write_surface(surface, output)
    if plot is not None:
        plots.save(plots.plot_surface(surface), plot)
    found = report.alignments
    rows = [
        ["points", *(str(a.points) for a in found)],
        ["outliers left out", *(str(a.outliers) for a in found)],
        ["frame, x", *(f"{a.x * 1e3:.4f} mm" for a in found)],
        ["frame, y", *(f"{a.y * 1e3:.4f} mm" for a in found)],
        ["frame, turn", *(f"{np.degrees(a.rotation):.5f}°" for a in found)],
        ["form, rms", *(f"{a.rms * 1e6:.3f} µm" for a in found)],
        ["scatter, rms", *(f"{a.scatter * 1e6:.3f} µm" for a in found)],
    ]
    print_table(points_file.name, ["figure", *(a.body for a in found)], rows)
    for outlier in report.outliers:
        typer.echo(
            f"{points_file.name}: line {outlier.line}: {outlier.place} lies {outlier.distance * 1e6:.1f} µm off its "
            "neighbours and was left out."
        )
    for note in report.notes:
        typer.echo(note)


@app.command()
def build(
    pair_file: Annotated[
        Path, typer.Argument(metavar="PAIR.toml", help="The gear pair, or an RV reducer (cycloid-reducer/1).")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DRIVE.fmu", help="The FMU file.")],
    surface_file: SurfaceFile = None,
    interface: Annotated[
        str,
        typer.Option(
            help="kinematic: crank motion and load in, output motion out; compliant: both motions in, both torques out."
        ),
    ] = "kinematic",
    output_inertia: Annotated[
        str | None,
        typer.Option(
            metavar='"J kg*m^2"', help="Inertia on the output inside a compliant FMU, which then takes the load."
        ),
    ] = None,
    losses: Annotated[
        Path | None,
        typer.Option(
            metavar="LOSSES.csv",
            help="Losses: speed \\[rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m], as Modelica's LossyGear.",
        ),
    ] = None,
    fmi: Annotated[str, typer.Option(help="FMI version, 2.0 or 3.0.")] = "2.0",
    native: Annotated[
        bool, typer.Option("--native", help="An FMU that needs no Python: C around tables of the contact model.")
    ] = False,
    platforms: Annotated[
        list[str] | None,
        typer.Option(
            "--platform", help="With --native: x86_64-linux, aarch64-darwin, ...; all by default. Repeatable."
        ),
    ] = None,
) -> None:
    """Build a Co-Simulation FMU of the drive, or of a whole RV reducer with the sun as input.

    Example: [cyan]cycloid-fmu build pair.toml --surface identified.nc -o drive.fmu[/]
    """
    from cycloid_fmu.fmu import build as builder
    from cycloid_fmu.fmu.variables import INTERFACES, LOSSLESS, Interface
    from cycloid_fmu.reducer import budget as rv
    from cycloid_fmu.surfaces.files import read_surface
    from cycloid_fmu.surfaces.surface import check_surface

    edge.output_path(output, "--output", (".fmu",))
    if interface not in INTERFACES:
        raise edge.InputError(f"--interface = {interface}: it must be one of {', '.join(INTERFACES)}.")
    if fmi not in ("2.0", "3.0"):
        raise edge.InputError(f"--fmi = {fmi}: it must be 2.0 or 3.0.")
    inertia = 0.0 if output_inertia is None else edge.quantity_option(output_inertia, "kg*m^2", "--output-inertia")
    rows = LOSSLESS if losses is None else builder.read_losses(losses)
    offered = Interface(interface, inertia, rows)  # type: ignore[arg-type]
    if platforms and not native:
        raise edge.InputError("--platform: only a --native FMU has platforms; one in Python runs where Python does.")
    drive: Pair | Reducer
    if edge.format_of(pair_file) == rv.FORMAT:
        drive = rv.read_reducer(pair_file)
        for warning in rv.contradictions(drive, str(pair_file)):
            typer.echo(warning, err=True)
        surface = None if surface_file is None else read_surface(surface_file)
        if surface is not None:
            check_surface(drive.stage, surface, str(pair_file), str(surface_file))
    else:
        drive, surface = _load(pair_file, surface_file)
    if native:
        _build_native(pair_file, drive, surface, output, offered, fmi, platforms or [])  # type: ignore[arg-type]
        return
    builder.build_fmu(drive, output, surface, interface=offered, fmi_version=fmi)  # type: ignore[arg-type]


def _build_native(
    pair_file: Path,
    drive: Pair | Reducer,
    surface: ErrorSurface | None,
    output: Path,
    interface: Interface,
    fmi: Version,
    platforms: list[str],
) -> None:
    """Build a native FMU for the given platforms (all, if none is named), and say how good its tables are."""
    from rich.progress import Progress

    from cycloid_fmu.fmu.build import whole_drive
    from cycloid_fmu.native.build import build_native, platforms_of
    from cycloid_fmu.native.tables import LARGEST_LOAD, PROBES

    if whole_drive(drive, surface)[0].rated_torque is None:
        raise edge.InputError(
            f"{pair_file}: [pair] rated_torque is missing; state it: the tables reach {LARGEST_LOAD:g} times as far."
        )
    with Progress(transient=True) as bar:
        names = platforms or list(platforms_of(fmi))
        libraries = bar.add_task(f"compiling for {names[0]}", total=len(names))
        angles = bar.add_task("crank angles", total=None)

        def compiled(name: str) -> None:
            following = names[names.index(name) + 1 :]
            bar.update(libraries, advance=1, description=f"compiling for {following[0]}" if following else "compiled")

        made = build_native(
            drive, output, surface, interface=interface, fmi_version=fmi, platforms=names, compiled=compiled,
            workers=os.cpu_count() or 1, total=lambda count: bar.update(angles, total=count, completed=0),
            progress=lambda done: bar.advance(angles, done),
        )  # fmt: skip
    typer.echo(
        f"{output}: {output.stat().st_size / 1e6:.2f} MB, up to {made.positive.load[-1]:.5g} N*m; transmission error "
        f"within {made.largest_error * edge.ARCSEC:.3f} arcsec of the exact model "
        f"({PROBES} random crank angles and torques, and more around the worst)."
    )


FmuFile = Annotated[Path, typer.Argument(metavar="DRIVE.fmu", help="An FMU made by cycloid-fmu build.")]


@app.command()
def inspect(fmu_file: FmuFile, as_json: AsJson = False) -> None:
    """List the variables of an FMU and check it against the standard.

    Example: [cyan]cycloid-fmu inspect drive.fmu[/]
    """
    from cycloid_fmu.fmu.run import described

    description, problems = described(fmu_file)
    if as_json:
        typer.echo(edge.json_text({"variables": description, "problems": problems}))
    else:
        rows = [[str(v[k]) for k in ("name", "causality", "unit", "start", "description")] for v in description]
        print_table(fmu_file.name, ["variable", "causality", "unit", "start", "meaning"], rows)
        typer.echo("\n".join(problems) or "fmpy's validation finds nothing to object to.")
    if problems:
        raise typer.Exit(edge.FAILED)


MotionFile = Annotated[
    Path | None,
    typer.Option(
        "--input",
        metavar="MOTION.csv",
        help="The inputs over time: time \\[s] and a column each, such as flange_a.phi \\[rad]; a recording will do.",
    ),
]


def _motion(fmu_file: Path, torque: str, turns: float, speed: str, samples: int) -> dict[str, NDArray[numpy.float64]]:
    from cycloid_fmu.fmu.run import turn_crank

    load = edge.quantity_option(torque, "N*m", "--torque")
    crank_speed = edge.quantity_option(speed, "rad/s", "--speed")
    if crank_speed <= 0.0:
        raise edge.InputError(f'--speed = "{speed}": it must be above zero; turn backwards with --turns below zero.')
    if turns == 0.0:
        raise edge.InputError("--turns = 0: it must not be zero.")
    return turn_crank(fmu_file, load, turns, crank_speed, samples)


@app.command()
def simulate(
    fmu_file: FmuFile,
    torque: Annotated[str | None, typer.Option(help='Torque on the output, such as "100 N*m".')] = None,
    turns: Annotated[float, typer.Option(help="Crank turns; below zero turns backwards.")] = 1.0,
    speed: Annotated[str, typer.Option(help="Crank speed.")] = "600 rpm",
    samples: Annotated[int, typer.Option(min=2, help="Samples for each crank turn.")] = 360,
    motion: MotionFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="RUN.csv", help="Write the results (CSV).")
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Turn the crank of an FMU at constant speed and torque, or lead it through a motion (with fmpy).

    Example: [cyan]cycloid-fmu simulate drive.fmu --torque "100 N*m" --turns 2 -o run.csv --plot run.png[/]
    """
    import numpy as np

    from cycloid_fmu.draw import plots
    from cycloid_fmu.fmu import run

    if (torque is None) == (motion is None):
        raise edge.InputError("simulate needs --torque, or --input with the inputs over time.")
    if plot is not None:
        plots.check_path(plot)
    if motion is None:
        results = _motion(fmu_file, torque or "", turns, speed, samples)
    else:
        time, inputs = run.read_inputs(motion, fmu_file)
        with _bar("samples", time.size) as progress:
            found = run.lead(fmu_file, inputs, list(run.units_of(fmu_file, "output")), time, progress=progress)
        results = {"time": time, **inputs, **found}
    if output is not None:
        run.write_motion(output, results, fmu_file)
    if plot is not None:
        plots.save(plots.plot_simulation(results), plot)
    if as_json:
        typer.echo(edge.json_text(results))
        return
    te = results["transmission_error"] * edge.ARCSEC
    print_table(
        fmu_file.name, ["figure", "value"],
        [["TE mean", f"{te.mean():.4f}″"], ["TE peak-peak", f"{np.ptp(te):.4f}″"],
         ["backlash mean", f"{results['backlash'].mean() * edge.ARCSEC:.4f}″"],
         ["largest pressure", f"{results['max_contact_pressure'].max() * 1e-6:.1f} MPa"]],
    )  # fmt: skip


@app.command()
def compare(
    fmu_file: FmuFile,
    other: Annotated[Path, typer.Argument(metavar="OTHER.fmu|RECORDING.csv", help="Another FMU, or a recording.")],
    motion: MotionFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Lead two FMUs, or an FMU and the drive of a recording, through the same motion and tell their differences.

    A recording (CSV, as `cycloid-bench export` and `simulate -o` write it) has the motion itself.

    Example: [cyan]cycloid-fmu compare exact.fmu native.fmu --input motion.csv --plot differences.png[/]
    """
    import numpy as np

    from cycloid_fmu.draw import plots
    from cycloid_fmu.fmu import run

    if plot is not None:
        plots.check_path(plot)
    recorded = other.suffix != ".fmu"
    if not recorded and motion is None:
        raise edge.InputError("compare needs --input with the inputs over time, unless it compares with a recording.")
    source = motion or other
    runs = 1 if recorded else 2
    with _bar("samples", runs * (run.read_inputs(source, fmu_file)[0].size - 1)) as progress:
        time, pairs = run.compare(fmu_file, other, source, progress)
    if plot is not None:
        plots.save(plots.plot_comparison(time, pairs, fmu_file.name, other.name), plot)
    figures = {
        name: {"mean": float(d.mean()), "rms_about_mean": float(d.std()), "largest": float(np.abs(d).max())}
        for name, d in ((n, a - b) for n, (a, b) in pairs.items())
    }
    if as_json:
        typer.echo(edge.json_text(figures))
        return
    rows = []
    for name, found in figures.items():
        unit, factor = plots.DIFFERENCE_UNITS.get(name, ("", 1.0))
        rows.append([name, unit, *(f"{v * factor:.4g}" for v in found.values())])
    print_table(f"{fmu_file.name} less {other.name}", ["variable", "unit", "mean", "rms about it", "largest"], rows)


@app.command()
def wear(
    pair_file: PairFile,
    wear_file: Annotated[Path, typer.Option("--wear", metavar="WEAR.toml", help="The wear law (cycloid-wear/1).")],
    torque: Annotated[str | None, typer.Option(help='Torque on the output, such as "-400 N*m".')] = None,
    crank_turns: Annotated[
        float | None, typer.Option(help="Crank turns; without them those of the duty cycle.", show_default=False)
    ] = None,
    duty_file: Annotated[
        Path | None,
        typer.Option(
            "--duty", metavar="DUTY.csv", help="Duty cycle instead of one torque: torque [N*m],crank_turns [1]."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="WORN.nc", help="Write the worn surface and its life (netCDF)."),
    ] = None,
    surface_file: SurfaceFile = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Wear of flanks and pins over a life, with the profile updated as it wears; run again to go on after a kill.

    Example: [cyan]cycloid-fmu wear pair.toml --wear wear.toml --torque "-400 N*m" --crank-turns 3e6 -o worn.nc[/]
    """
    import os

    from rich.progress import Progress

    from cycloid_fmu.draw import plots
    from cycloid_fmu.surfaces.files import write_surface
    from cycloid_fmu.wear import life as wear_run
    from cycloid_fmu.wear.law import duty_cycle, read_wear_law
    from cycloid_fmu.wear.progress import tooth_thickness, wear_model, wear_rate

    if plot is not None:
        plots.check_path(plot)
    if output is not None:
        edge.output_path(output, "--output", (".nc",))
    load = None if torque is None else edge.quantity_option(torque, "N*m", "--torque")
    law = read_wear_law(wear_file)
    loads, turns = duty_cycle(law, load, crank_turns, duty_file, str(wear_file))
    pair, surface = _load(pair_file, surface_file)
    workers = os.cpu_count() or 1
    model = wear_model(pair, surface, law, loads)
    new = wear_rate(model, model.surface, workers)
    thickness = tooth_thickness(pair)
    if new.depth.largest * turns > thickness:
        raise edge.InputError(
            f"{wear_file}: {turns:g} crank turns would wear {new.depth.largest * turns * 1e3:.4g} mm deep, and the "
            f"tooth is {thickness * 1e3:.4g} mm thick; check the wear coefficient's units and the turns."
        )
    if (doubt := wear_run.coefficient_warning(new.coefficient, model, str(wear_file))) is not None:
        typer.echo(doubt, err=True)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("crank turns", total=turns or 1.0)
        try:
            states = wear_run.run_wear(model, turns, output, workers, lambda done: bar.update(task, completed=done))
        except wear_run.Interrupted as interrupted:
            typer.echo(str(interrupted), err=True)
            raise typer.Exit(edge.INTERRUPTED) from None
    figures = wear_run.wear_figures(model, states, new, workers)
    if output is not None:
        write_surface(wear_run.surface_of_run(model, states, new.half_width), output)
        wear_run.unfinished_path(output).unlink()
    if plot is not None:
        plots.save(plots.plot_wear(model, states, new, figures), plot)
    if figures["crank_turns"] < turns:
        typer.echo(
            f"The wear limit of {figures['wear_limit'] * 1e6:.1f} µm is reached after {figures['crank_turns']:.4g} of "
            f"{turns:.4g} crank turns; the run ends there.", err=True,
        )  # fmt: skip
    if as_json:
        typer.echo(edge.json_text(figures))
        return
    kinds = {"linear": "at the new profile's rate", "updated": "profile updated"}
    rows = [
        [f"{body}, {name}", *(f"{figures[kind][f'{body}_depth_{key}'] * 1e6:.3f} µm" for kind in kinds)]
        for body in ("gear", "pin") for key, name in (("max", "deepest"), ("mean", "mean of what is worn"))
    ]  # fmt: skip
    print_table(f"{pair_file.name}, {figures['crank_turns']:g} crank turns", ["wear depth", *kinds.values()], rows)
    life = figures["life"]
    names = {"transmission_error": "Transmission error", "backlash": "Backlash", "lost_motion": "Lost motion"}
    for name, text in names.items():
        new_mean, worn_mean, new_range, worn_range = (
            f"{life[key][k] * edge.ARCSEC:.3f}″" for key in (name, f"{name}_range") for k in (0, -1)
        )
        typer.echo(f"{text}: mean {new_mean} new, {worn_mean} worn; peak to peak {new_range} new, {worn_range} worn.")
    step = figures["step"]
    deepest = " and ".join(
        f"{(figures['updated'][key] - step['whole_steps'][key]) * 1e6:+.3f} µm"
        for key in ("gear_depth_max", "pin_depth_max")
    )
    typer.echo(
        f"Steps: {step['count']}; halving all of them changes the depth by at most "
        f"{step['halving_difference'] * 1e6:.3f} µm, the deepest of gear and pin by {deepest}."
    )
    typer.echo(f"Sliding work at friction coefficient 1: {figures['sliding_work']:.4g} J a crank turn.")
    if "sliding_loss" in figures:
        typer.echo(
            f"Friction: {figures['friction_work']:.4g} J a crank turn, {figures['sliding_loss']:.3%} of the load's."
        )


@app.command()
def budget(
    reducer_file: Annotated[Path, typer.Argument(metavar="REDUCER.toml", help="Format cycloid-reducer/1.")],
    samples: Annotated[int, typer.Option(min=100, help="Reducers drawn within the tolerances.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same reducers.")] = 1,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Lost motion budget of an RV reducer: every term by the closed form and by the contact model, and its scatter.

    Example: [cyan]cycloid-fmu budget rv.toml --plot budget.png[/]
    """
    from rich.progress import Progress

    from cycloid_fmu.draw import plots
    from cycloid_fmu.reducer import budget as rv

    if plot is not None:
        plots.check_path(plot)
    reducer = rv.read_reducer(reducer_file)
    warnings = rv.contradictions(reducer, str(reducer_file))
    found = rv.budget(reducer)
    remarks = rv.remarks(reducer, found)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reducers", total=samples)
        stack = rv.stack(reducer, samples, seed, lambda done: bar.advance(task, done))
    if plot is not None:
        plots.save(plots.plot_budget(found, stack), plot)
    if as_json:
        scatter = None if stack is None else rv.stack_summary(stack)
        typer.echo(
            edge.json_text(
                {**found, "ratio": reducer.ratio, "stack": scatter, "remarks": remarks, "warnings": warnings}
            )
        )
        return
    values, closed = rv.values_of(reducer), found["standard"]
    terms = sorted((n for n in rv.TERMS if any(v[n] for v in found.values())), key=lambda n: -abs(closed[n]))
    rows = [
        [n, f"{values[n] * 1e6:+.2f} µm", *(f"{found[v][n] * edge.ARCMIN:+.5f}" for v in rv.VARIANTS)] for n in terms
    ]
    for name in ("interaction", *rv.STAGES, "total"):
        rows.append([name, "", *(
            f"{found[v][name] * edge.ARCMIN:+.5f}" if name in found[v] else "" for v in rv.VARIANTS
        )])  # fmt: skip
    print_table(
        f"{reducer_file.name}: play at the output [arcmin], ratio {reducer.ratio:g}",
        ["term", "amount", *(v.replace("_", " ") for v in rv.VARIANTS)], rows,
    )  # fmt: skip
    exact = found["geometric"]
    if exact["interference"] > 0.0:
        typer.echo(
            f"Interference: at {exact['interfering']:.0%} of the crank angles no free position, by up to "
            f"{exact['interference'] * 1e6:.2f} µm."
        )
    for name, remark in remarks.items():
        typer.echo(f"{name}: {remark}.")
    if stack is None:
        typer.echo("No deviation has a tolerance, so nothing scatters.")
    else:
        shown = rv.stack_summary(stack)
        rows = []
        for name in ("worst_case", "root_sum_square"):
            rows.append([name.replace("_", " "), *(f"{v * edge.ARCMIN:.4f}" for v in shown[name]), "", ""])
        for name in stack.samples:
            one = shown["monte_carlo"][name]
            low, high = one["interval"]
            rows.append(
                [f"Monte Carlo, {name}", *(f"{v * edge.ARCMIN:.4f}" for v in (*one["central"], one["mean"])),
                 f"{one['interfering']:.1%} ({low:.1%} … {high:.1%})"]
            )  # fmt: skip
        print_table("Total play within the tolerances [arcmin]",
                    ["stack", "from", "to", "mean", "interference (95 %)"], rows)  # fmt: skip
        typer.echo(f"Monte Carlo: {samples} reducers, the central 99.73 %; geometric with the sun locked.")
    for warning in warnings:
        typer.echo(warning, err=True)


@app.command()
def tolerance(
    pair_file: PairFile,
    tolerances_file: Annotated[
        Path,
        typer.Option("--tolerances", metavar="T.toml", help="Tolerances, limits and costs (cycloid-tolerances/1)."),
    ],
    torque: Annotated[
        list[str] | None, typer.Option(help="Torque on the output; may be repeated. Default: ± rated.")
    ] = None,
    samples: Annotated[int, typer.Option(min=2, help="Drives to solve.")] = 1000,
    seed: Annotated[int, typer.Option(help="The same seed draws the same drives.")] = 1,
    design: Annotated[
        str, typer.Option(help="sobol, latin-hypercube, or saltelli, which gives Sobol indices as well.")
    ] = "sobol",
    angles: Annotated[int, typer.Option(min=20, help="Crank angles, evenly from 0, end excluded.")] = 360,
    turns: Annotated[int, typer.Option(min=1, help="Crank turns that they span.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = os.cpu_count() or 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Use a dask cluster instead of this machine's cores.")
    ] = None,
    screen: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Solve to first order and confirm this share by the exact kernel."),
    ] = None,
    allocate: Annotated[
        float | None,
        typer.Option(metavar="YIELD", help="Find the cheapest tolerances that reach this share of good drives."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="STUDY.nc",
            help="Write the study (netCDF); what is done is kept beside it until then.",
        ),
    ] = None,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Solve many drives within their tolerances: distributions, yields against limits, sensitivities.

    Stopped or killed, the same command goes on where it was, if it has an output.

    Example: [cyan]cycloid-fmu tolerance pair.toml --tolerances tolerances.toml --samples 10000 -o study.nc[/]
    """
    import numpy as np
    from rich.progress import Progress

    from cycloid_fmu.draw import plots
    from cycloid_fmu.geometry.pair import read_pair
    from cycloid_fmu.studies import tolerance as study_of
    from cycloid_fmu.surfaces.sampling import read_tolerances

    if plot is not None:
        plots.check_path(plot)
    if design not in study_of.DESIGNS:
        raise edge.InputError(f"--design = {design}: it must be one of {', '.join(study_of.DESIGNS)}.")
    pair, tolerances = read_pair(pair_file), read_tolerances(tolerances_file)
    rated = pair.rated_torque
    if torque is None and rated is None:
        raise edge.InputError(f"{pair_file}: [pair] rated_torque is missing; state it, or give --torque.")
    loads = [edge.quantity_option(t, "N*m", "--torque") for t in torque] if torque else [rated or 0.0, -(rated or 0.0)]
    study = study_of.Study(pair, tolerances, samples, seed, tuple(loads), design, angles, turns)  # type: ignore[arg-type]
    study_of.check_study(study, str(pair_file), str(tolerances_file))
    if screen is not None or allocate is not None:
        study_of.check_first_order(study, str(tolerances_file))
    if screen is not None and not 0.0 < screen <= 1.0:
        raise edge.InputError(f"--screen = {screen:g}: the share must lie between 0 and 1.")
    kept = None
    if output is not None and screen is None:
        kept = study_of.Checkpoint(output.with_name(output.name + ".checkpoint"), study)
    size = len(study_of.points(study))
    confirmation = None
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("drives", total=size if screen is None else size + math.ceil(screen * size))
        try:
            if screen is None:
                result = study_of.run(
                    study, kept, workers=workers, scheduler=scheduler, progress=lambda done: bar.advance(task, done)
                )
            else:
                confirmation = study_of.screened(
                    study, screen, workers=workers, scheduler=scheduler, progress=lambda done: bar.advance(task, done)
                )
                result = confirmation.result
        except study_of.Interrupted as interrupted:
            bar.stop()
            where = f"{kept.path} keeps them; the same command goes on" if kept else "nothing is kept without --output"
            typer.echo(f"Interrupted: {interrupted.result.sample.size} of {size} drives are done; {where}.", err=True)
            raise typer.Exit(edge.INTERRUPTED) from None
    if output is not None:
        with edge.written_whole(output) as temporary:
            study_of.dataset_of(result).to_netcdf(temporary, engine="h5netcdf")
        if kept is not None:
            kept.path.unlink()
    allocation = None
    if allocate is not None:
        from cycloid_fmu.studies import allocation as allocation_of

        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("allocation", total=allocation_of.steps())
            allocation = allocation_of.allocate(
                study, allocate, str(tolerances_file), workers=workers, scheduler=scheduler,
                progress=lambda done: bar.advance(task, done),
            )  # fmt: skip
    indices = study_of.sobol_indices(result) if design == "saltelli" else {}
    if plot is not None:
        plots.save(plots.plot_tolerance(result), plot)
        if indices:
            plots.save(plots.plot_indices(study.factors, indices), plot.with_stem(f"{plot.stem}-indices"))
        if allocation is not None:
            title = (
                f"{allocation.exact_yield:.2%} of the drives keep all limits, as stated {allocation.stated_yield:.2%}"
            )
            drawn = plots.plot_allocation(study.factors, allocation.scale, title)
            plots.save(drawn, plot.with_stem(f"{plot.stem}-allocation"))
    statistics, kept_shares = study_of.statistics(result), study_of.yields(result)
    if as_json:
        content = {"samples": result.sample.size, "torque": loads, "factors": study.factors, "statistics": statistics}
        more = {
            "allocation": None if allocation is None else dataclasses.asdict(allocation),
            "screening": None if confirmation is None else {
                "confirmed": confirmation.confirmed.size, "difference": confirmation.difference,
                "changed": confirmation.changed,
            },
        }  # fmt: skip
        typer.echo(edge.json_text({**content, "yields": kept_shares, "indices": indices, **more}))
        return
    limits = tolerances.limits.stated()
    rows = []
    for name, found in statistics.items():
        unit, factor = plots.SHOWN[study_of.FIGURES[name][0]]
        shown = f"{name.replace('_', ' ')} [{unit}]"
        for k in range(len(loads) if name in study_of.PER_TORQUE else 1):
            figures = [found["mean"], found["standard_deviation"], *found["quantiles"].values()]
            load = f"{loads[k]:g} N·m" if name in study_of.PER_TORQUE else ""
            rows.append([shown, load, *(f"{np.atleast_1d(v)[k] * factor:.4g}" for v in figures)])
    print_table(
        f"{pair_file.name}: {int(result.independent.sum())} drives within {tolerances_file.name}",
        ["figure", "torque", "mean", "σ", "5 %", "50 %", "95 %", "largest"], rows,
    )  # fmt: skip
    rows = []
    for name, limit in limits.items():
        unit, factor = plots.SHOWN[study_of.FIGURES[name][0]]
        rows.append([name.replace("_", " "), f"{limit * factor:g} {unit}", f"{kept_shares[name]['share']:.2%}"])
    if limits:
        whole = kept_shares["all"]
        rows.append(["all", "", f"{whole['share']:.2%} ({whole['low']:.2%} … {whole['high']:.2%})"])
        print_table("Yield", ["limit", "largest allowed", "keep it (95 % interval)"], rows)
    for label, one in indices.items():
        order = np.argsort(-one["total"])
        rows = [
            [study.factors[i], *(f"{one[kind][i]:.3f} ± {one[kind + '_confidence'][i]:.3f}" for kind in
                                 ("first_order", "total"))] for i in order
        ]  # fmt: skip
        print_table(f"Sobol indices: {label.replace('_', ' ')}", ["tolerance", "first order", "total"], rows)
    if confirmation is not None:
        differences = []
        for name, worst in confirmation.difference.items():
            unit, factor = plots.SHOWN[study_of.FIGURES[name][0]]
            differences.append(f"{name.replace('_', ' ')} {worst * factor:.3g} {unit}")
        typer.echo(
            f"To first order; {confirmation.confirmed.size} drives confirmed by the exact kernel, "
            f"{confirmation.changed} of them judged otherwise; largest differences: {', '.join(differences)}."
        )
    if allocation is not None:
        rows = []
        for name, scale in zip(study.factors, allocation.scale, strict=True):
            stated = getattr(tolerances, name)
            for field in ("single", "cumulative") if hasattr(stated, "single") else ("tolerance",):
                factor, unit = (1e3, "mrad") if name.startswith("misalignment") else (1e6, "µm")
                width = getattr(stated, field) * factor
                rows.append([name, field, f"{width:.3g} {unit}", f"{width * scale:.3g} {unit}",
                             f"{tolerances.costs.get(name, 1.0) / scale:.3g}"])  # fmt: skip
        print_table("Cheapest tolerances", ["tolerance", "", "stated", "allocated", "cost"], rows)
        typer.echo(
            f"Yield {allocation.exact_yield:.2%} (as stated {allocation.stated_yield:.2%}), cost {allocation.cost:.4g} "
            f"(as stated {allocation.stated_cost:.4g}), cost as 1/width, confirmed by the exact kernel."
        )


def main() -> None:
    """Run the command line."""
    commands.run(app)
