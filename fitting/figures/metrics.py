"""The standard figures of a drive from all its recordings: selection and pooling."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair
from fitting.arguments import check_ratio, positive
from fitting.figures.angular_error import angular_transmission_error, unresolved_range
from fitting.figures.budget import Budget, budget_json, budgets_of
from fitting.figures.figure import DEFINITIONS, Figure, figure_json, pooled
from fitting.figures.friction_free import DEFINITIONS as OF_FRICTION_FREE
from fitting.figures.friction_free import FrictionFree, friction_free
from fitting.figures.hysteresis import loop_figures
from fitting.figures.instruments import Instruments, read_instruments
from fitting.figures.loop_groups import LoopGroup, group_of, play_range
from fitting.figures.starts import STARTS, Start, start_figures
from fitting.readers.recording import Recording
from fitting.readers.sources import Source, each_source, open_source
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.orders import RunOrders, averaging_note, orders_json, orders_of_run
from fitting.transmission_error.spectrum import RIG_ORDERS, Spectrum, run_label, spectrum, without_orders
from fitting.transmission_error.survey import Surveyed, at_positions, survey

FORMAT = "cycloid-figures/1"
FRICTION_FREE = "friction_free."
"""What stands before the names of figures without friction in tables and comparisons."""
_GROWS = 0.02  # growth of friction with load that standard figures are marked from


@dataclass(frozen=True)
class Figures:
    """The figures of one drive from all its recordings.

    Attributes
    ----------
    figures
        Figures by name; those that the recordings do not determine are missing, for reasons in `notes`.
    surveyed
        Survey of each recording.
    spectra
        Orders of each curve, in the order of the recordings and their curves; None below a whole turn.
    rated_torque, ratio
        Rated torque T_N, N·m, and signed ratio input/output; None if unknown.
    notes
        Omissions and their reasons, one sentence each.
    pair
        The nominal gear pair, if known.
    problems
        Notes on unreadable recordings and on an interrupt.
    friction_free
        Figures of the loops without friction (`friction_free.DEFINITIONS`); none without loops in both directions.
    loop_groups
        The loops of all recordings by size and position, each group with its own figures.
    mid_curves
        What they are from: source of each recording with loops, and its figures with their mid curve.
    interrupted
        Whether recordings are missing because of an interrupt.
    orders
        Orders of each curve with a spectrum, in the same order, with what averaging over turns removed.
    budgets, instruments
        The uncertainty budget of each figure, and the instruments, if stated.

    Examples
    --------
    >>> import numpy as np, fitting, pathlib
    >>> torque = 100.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4000))
    >>> loop = fitting.Run(input_angle=0.0, output_angle=torque / 1e6, torque=torque)
    >>> found = fitting.metrics(loop, ratio=-39.0)
    >>> "lost_motion" in found.figures
    True
    >>> found.write("figures.json")
    >>> pathlib.Path("figures.json").stat().st_size > 1000
    True
    """

    figures: dict[str, Figure]
    surveyed: tuple[Surveyed, ...]
    spectra: tuple[Spectrum | None, ...]
    rated_torque: float | None
    ratio: float | None
    notes: tuple[str, ...]
    pair: Pair | None = None
    problems: tuple[str, ...] = ()
    interrupted: bool = False
    budgets: Mapping[str, Budget] = dataclasses.field(default_factory=dict)
    instruments: Instruments | None = None
    friction_free: Mapping[str, Figure] = dataclasses.field(default_factory=dict)
    mid_curves: tuple[tuple[str, FrictionFree], ...] = ()
    loop_groups: tuple[LoopGroup, ...] = ()
    orders: tuple[RunOrders, ...] = ()

    @property
    def shown(self) -> dict[str, Figure]:
        """All figures by the names under which a table shows them."""
        return {**self.figures, **{f"{FRICTION_FREE}{name}": figure for name, figure in self.friction_free.items()}}

    @property
    def play_range(self) -> tuple[Figure, Figure] | None:
        """The smallest and the largest play without friction over the positions of the loops; None for one position."""
        return play_range(self.loop_groups)

    @property
    def curves(self) -> list[Curve]:
        """The curves of all recordings."""
        return [c for s in self.surveyed for c in s.curves]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the figures, `cycloid-figures/1`; never a partial file."""
        with edge.written_whole(path) as temporary:
            temporary.write_text(edge.json_text(figures_json(self)), encoding="utf-8")


def figures_of(
    surveyed: Sequence[Surveyed],
    ratio: float | None,
    rated_torque: float | None,
    stiffness_limits: Sequence[float] | None = None,
    pair: Pair | None = None,
) -> Figures:
    """Return the figures of all recordings of one drive.

    Loops of several recordings are pooled; of transmission errors the figure is the largest, and the runs are kept.

    Parameters
    ----------
    surveyed
        Survey of each recording.
    ratio, rated_torque
        As given to `survey`.
    stiffness_limits
        As in `loop_figures`.
    pair
        The nominal gear pair, for the causes of orders.
    """
    notes = [n for s in surveyed for n in s.notes]
    loops = _loop_results(surveyed, stiffness_limits)
    friction_free_figures = (
        {name: pooled([free.figures[name] for _, free in loops.mid_curves]) for name in OF_FRICTION_FREE}
        if loops.mid_curves
        else {}
    )
    figures = _with_remarks(loops.figures, friction_free_figures) if friction_free_figures else loops.figures
    ripple = _ripple_results(surveyed, rated_torque, pair)
    starts, remarks = _starts(surveyed, ratio)
    return Figures(
        figures | ripple.figures | starts,
        tuple(surveyed),
        ripple.spectra,
        rated_torque,
        ratio,
        tuple(dict.fromkeys([*notes, *loops.notes, *ripple.notes, *remarks])),
        friction_free=friction_free_figures,
        mid_curves=tuple(loops.mid_curves),
        loop_groups=tuple(sorted(loops.groups, key=lambda group: -group.largest_torque)),
        orders=ripple.orders,
        pair=pair,
    )


class _LoopResults(NamedTuple):
    """Of all loops: pooled figures, mid curves by source, groups and notes."""

    figures: dict[str, Figure]
    mid_curves: list[tuple[str, FrictionFree]]
    groups: list[LoopGroup]
    notes: list[str]


def _loop_results(surveyed: Sequence[Surveyed], stiffness_limits: Sequence[float] | None) -> _LoopResults:
    """Return the figures of the loops of all recordings."""
    each, mid_curves, groups, notes = list[dict[str, Figure]](), list[tuple[str, FrictionFree]](), [], list[str]()
    for recording in surveyed:
        if recording.loops is None:
            continue
        figures, missing = loop_figures(recording.loops, stiffness_limits)
        each.append(figures)
        notes += missing
        groups += [group_of(data) for data in recording.loop_groups]
        if (free := friction_free(recording.loops)) is not None:
            mid_curves.append((recording.source, free))
    names = ("hysteresis_loss", "backlash", "lost_motion", "torsional_stiffness")
    pools = {name: [figures[name] for figures in each if name in figures] for name in names}
    return _LoopResults({name: pooled(pool) for name, pool in pools.items() if pool}, mid_curves, groups, notes)


class _RippleResults(NamedTuple):
    """Of all curves: angular transmission errors, spectra (None below a whole turn), orders and notes."""

    figures: dict[str, Figure]
    spectra: tuple[Spectrum | None, ...]
    orders: tuple[RunOrders, ...]
    notes: list[str]


def _ripple_results(surveyed: Sequence[Surveyed], rated_torque: float | None, pair: Pair | None) -> _RippleResults:
    """Return the angular transmission errors and the orders of the curves of all recordings."""
    spectra, of_runs, notes = list[Spectrum | None](), list[RunOrders](), list[str]()
    names = ("angular_transmission_error", "angular_transmission_error_without_rig")
    runs: dict[str, dict[str, dict[str, Figure]]] = {name: {"forward": {}, "backward": {}} for name in names}
    for recording in surveyed:
        for curve in recording.curves:
            try:
                orders = spectrum(curve)
            except edge.InputError as problem:
                notes.append(f"{problem} No angular transmission error is computed for it.")
                spectra.append(None)
                continue
            spectra.append(orders)
            notes += _windup_note(curve, rated_torque)
            direction, label = "forward" if curve.direction > 0 else "backward", run_label(recording.source, curve)
            for name, used in zip(names, (orders, without_orders(orders, RIG_ORDERS)), strict=True):
                lacking = unresolved_range(curve, orders, used)
                runs[name][direction][label] = angular_transmission_error(curve, used, recording.runaway, lacking)
            bases, limits = _stated_bases(recording.overview, curve.ratio), recording.overview.limits
            coarsest = max(limits.output_resolution, limits.input_resolution / abs(curve.ratio))
            of_runs.append(orders_of_run(curve, orders, label, pair, bases, coarsest))
            notes += averaging_note(of_runs[-1])
    figures = {name: _largest_of_runs(name, by_way) for name, by_way in runs.items() if any(by_way.values())}
    return _RippleResults(figures, tuple(spectra), tuple(of_runs), notes)


def _windup_note(curve: Curve, rated_torque: float | None) -> list[str]:
    """Return a note if the torque of a run varies so much that windup shows in its transmission error."""
    around, varies = abs(curve.torque), curve.torque_deviation
    if not (0.1 * around < varies < around or varies > 0.1 * (rated_torque or math.inf)):
        return []
    return [
        f"{curve.source}: the torque varies by {varies:.3g} N·m around {curve.torque:.4g} "
        "N·m; the transmission error includes the resulting windup."
    ]


def _largest_of_runs(name: str, by_way: Mapping[str, Mapping[str, Figure]]) -> Figure:
    """Return the largest figure of all runs, with the largest of each direction as its parts."""
    parts = {
        direction: max(runs.values(), key=lambda figure: figure.value) for direction, runs in by_way.items() if runs
    }
    runs = {label: figure for each in by_way.values() for label, figure in each.items()}
    largest = max(parts.values(), key=lambda figure: figure.value)
    return dataclasses.replace(largest, parts=parts, runs=runs, definition=DEFINITIONS[name].text)


def _starts(surveyed: Sequence[Surveyed], ratio: float | None) -> tuple[dict[str, Figure], list[str]]:
    """Return the starting torques of the recordings without loops, and notes on them."""
    started: dict[str, list[Start]] = {name: [] for name in STARTS}
    notes: list[str] = []
    for recording in surveyed:
        if recording.loops is not None or not recording.overview.has_input_angle:
            continue
        for name, starts_by in STARTS.items():
            starts, remarks = starts_by(recording.overview, ratio if ratio is not None else recording.overview.ratio)
            started[name] += starts
            notes += remarks
            if recording.averaged > 1 and starts:
                notes.append(
                    f"{recording.source}: {name}: torques are means of {recording.averaged} samples, as the recording "
                    "is long."
                )
    return start_figures(started), notes


def _stated_bases(recording: Recording, ratio: float) -> dict[str, float]:
    """Return the stated causes of orders that are no whole number, with the lowest order of each."""
    stated = {"pulley": recording.pulley, "input turn": ratio}
    return {
        name: abs(base) for name, base in stated.items() if base != round(base) or (name == "pulley" and base != 1.0)
    }


def _with_remarks(figures: dict[str, Figure], without: Mapping[str, Figure]) -> dict[str, Figure]:
    """Return the standard figures with what they contain where friction grows with load."""
    growth = without["friction_per_load"]
    if not growth.value - growth.uncertainty > _GROWS:
        return figures
    remarks = {
        "backlash": "assumes a constant friction, but here it grows with load: friction_free.play is without it",
        "torsional_stiffness": f"contains friction that grows with load, about {1.0 + growth.value:.2f} times the "
        "stiffness: friction_free.torsional_stiffness is without it",
    }
    return {
        name: dataclasses.replace(figure, remark=remarks[name]) if name in remarks else figure
        for name, figure in figures.items()
    }


def metrics(
    recordings: Source | Iterable[Source],
    drive: Drive | None = None,
    *,
    ratio: float | None = None,
    rated_torque: float | str | None = None,
    stiffness_limits: Sequence[float | str] | None = None,
    instruments: Instruments | str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Figures:
    """Return the standard figures of a drive: transmission error, lost motion, backlash, stiffness, starting torques.

    If a recording can't be read, or after an interrupt, the figures of the others are returned, with a note.

    Parameters
    ----------
    recordings
        Recordings from `fitting.read_recordings`, or `fitting.Run`, or one of them: runs at a load, hysteresis loops,
        starts.
    drive
        The nominal drive, for ratio and rated torque.
    ratio
        In place of a drive: its ratio input/output, -gear_teeth with a fixed ring, +pins with a fixed carrier. Default:
        that stated by the recordings.
    rated_torque
        Rated torque T_N, N·m or text with a unit. Default: that of the drive, or else the largest torque of each
        recording.
    stiffness_limits
        Limits of the torque ranges K1, K2, ... of torsional stiffness, N·m or text with units, ascending. Default: 3,
        15, 50 and 100 % of T_N.
    instruments
        The bench's instruments, or their file, for an uncertainty budget of each figure.
    progress
        Called with the number of the recording being read, as text.

    Raises
    ------
    edge.InputError
        If an argument is invalid or no recording can be read.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> torque = 100.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4000))
    >>> loop = fitting.Run(input_angle=0.0, output_angle=torque / 1e6, torque=torque)
    >>> figures = fitting.metrics(loop, ratio=-39.0, rated_torque="100 N*m").figures
    >>> round(figures["torsional_stiffness"].value)
    1000000
    """
    if drive is not None and ratio is not None:
        raise edge.ArgumentError("ratio", "the drive states its ratio; give one of the two", ratio)
    check_ratio(ratio)
    rated = None if rated_torque is None else positive(rated_torque, "N*m", "rated_torque")
    limits = None if stiffness_limits is None else [positive(v, "N*m", "stiffness_limits") for v in stiffness_limits]
    if limits is not None and (len(limits) < 2 or sorted(set(limits)) != limits):
        raise edge.ArgumentError("stiffness_limits", "give two torques or more, ascending", stiffness_limits)
    if drive is not None:
        ratio, rated = drive.ratio, drive.pair.rated_torque if rated is None else rated
    if isinstance(instruments, str | os.PathLike):
        instruments = read_instruments(instruments)
    given: list[Source] = each_source(recordings)
    surveyed: list[Surveyed] = []
    problems: list[str] = []
    interrupted = False
    for number, source in enumerate(given, start=1):

        def report(samples: int, number: int = number) -> None:
            progress(f"recording {number} of {len(given)}: {samples / 1e6:.1f} million samples")

        try:
            surveyed += at_positions(survey(open_source(source, ratio), ratio, rated, report), ratio, rated)
        except edge.InputError as problem:
            if len(given) == 1:
                raise
            problems.append(str(problem))
        except KeyboardInterrupt:
            if not surveyed:
                raise
            problems.append(f"Interrupted: {len(surveyed)} of {len(given)} recordings were evaluated.")
            interrupted = True
            break
    if not surveyed:
        raise edge.InputError("\n".join(problems) or "recordings: there are none.")
    figures = figures_of(surveyed, ratio, rated, limits, None if drive is None else drive.pair)
    notes = (*problems, *figures.notes)
    figures = dataclasses.replace(figures, notes=notes, problems=tuple(problems), interrupted=interrupted)
    if instruments is None:
        return figures
    budgets = budgets_of(figures.figures, surveyed, figures.spectra, instruments, ratio, progress)
    return dataclasses.replace(figures, budgets=budgets, instruments=instruments)


def group_json(group: LoopGroup) -> dict[str, Any]:
    """Return a group of loops as part of a `cycloid-figures/1` file."""
    free = None if group.friction_free is None else group.friction_free.figures
    return {
        "source": group.source,
        "group": group.group,
        "largest_torque": group.largest_torque,
        "loops_found": group.loops_found,
        "loops_used": group.loops_used,
        **{name: figure_json(figure) for name, figure in group.figures.items()},
        "friction_free": None if free is None else {name: figure_json(figure) for name, figure in free.items()},
        "notes": list(group.notes),
    }


def figures_json(figures: Figures) -> dict[str, Any]:
    """Return all figures as the content of a `cycloid-figures/1` file: figures by name, and their sources."""
    return {
        "format": FORMAT,
        **{
            name: figure_json(f) | ({"budget": budget_json(figures.budgets[name])} if name in figures.budgets else {})
            for name, f in figures.figures.items()
        },
        "friction_free": {name: figure_json(figure) for name, figure in figures.friction_free.items()},
        "play_range": None if figures.play_range is None else [figure_json(figure) for figure in figures.play_range],
        "loop_groups": [group_json(loop_group) for loop_group in figures.loop_groups],
        "orders": [orders_json(order) for order in figures.orders],
        "rated_torque": figures.rated_torque,
        "ratio": figures.ratio,
        "data": {s.source: s.checksum for s in figures.surveyed},
        "locked": {s.source: s.overview.locked or None for s in figures.surveyed if s.loops is not None},
        "implausible": {s.source: s.implausible for s in figures.surveyed},
        "notes": list(figures.notes),
    }
