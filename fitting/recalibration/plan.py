"""Plan of measurements, runs or index marks, that give a required interval of the backlash from the last state."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.arguments import positive
from fitting.estimation.continuation import state_before
from fitting.estimation.parameter import NORMAL
from fitting.estimation.plan import planned_curve
from fitting.model.gaussian import Evidence, equations
from fitting.model.posterior import Posterior
from fitting.model.unknowns import Unknowns
from fitting.recalibration.drift import DRIFT, drifted, fitted_drive
from fitting.recalibration.figures import EACH, Gradient
from fitting.recalibration.measured import SIZES, TORQUE_SHARE, LostMotion, linear_near, observed_in_place, quantised
from fitting.recalibration.recalibrate import Recalibration
from fitting.recalibration.update import with_joint

Array = NDArray[np.float64]

TURNS = (1, 2, 5, 10, 20, 50, 100)
"""Compared numbers of output turns, or of passings of an index mark in each direction."""
_SAMPLES = 100  # samples per crank turn: 1 kHz at 600 rpm


@dataclass(frozen=True)
class PlannedVisit:
    """The interval of the backlash that a set of runs would give.

    Attributes
    ----------
    runs
        The runs in words.
    half_width
        {output turns of each run, or passings of the mark in each direction: half of the backlash's 95 % interval,
        rad}.
    turns
        Smallest number of `TURNS` that gives the wanted half width; None if none does, or if no width is given.
    """

    runs: str
    half_width: dict[int, float]
    turns: int | None


def plan_visit(
    before: Drive | Recalibration,
    torque: Sequence[float | str],
    *,
    crank_turns: float,
    bits: int,
    wanted: float | str | None = None,
    mark: float | str | None = None,
    drift: float | str = DRIFT,
    torque_share: float = TORQUE_SHARE,
) -> list[PlannedVisit]:
    """Predict the intervals of the backlash after sets of runs.

    The sets are: each load in one direction and in both, all loads in both directions, and the lost motion at an index
    mark at the smallest load.

    Parameters
    ----------
    before, crank_turns, bits, drift, torque_share
        As in `fitting.recalibration.recalibrate.recalibrate`.
    torque
        Possible loads, N·m; the smallest must keep the flanks in contact, and may be friction.
    wanted
        Required half width of the backlash's 95 % interval, rad.
    mark
        Standard deviation of one passing of an index mark, rad at the output; None plans no mark.

    Returns
    -------
    visits
        Sorted by the half width after one turn.

    Raises
    ------
    edge.InputError
        If an argument is invalid, or the drive has no covariance.

    Examples
    --------
    >>> import cycloid_fmu as cy, numpy as np
    >>> from fitting.recalibration.plan import plan_visit
    >>> sizes = dict(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> pair = cy.Pair(**sizes, rated_torque=20.0)
    >>> fitted = cy.Drive(pair).replace(errors={"pin_radius": "-2 um"}).surface
    >>> fitted = fitted.replace(covariance=np.array([[1e-14]]), covariance_of=("pin_radius",))
    >>> best, *_ = plan_visit(cy.Drive(pair, fitted), ["1 N*m", "20 N*m"], crank_turns=1e7, bits=17)
    >>> best.runs
    '20 and 1 N·m both ways'
    """
    loads = sorted({positive(one, "N*m", "torque") for one in torque}, reverse=True)
    if not loads:
        raise edge.ArgumentError("torque", "is missing")
    turns = positive(crank_turns, "1", "crank_turns", zero=True)
    walked, share = positive(drift, "m", "drift", zero=True), positive(torque_share, "1", "torque_share", zero=True)
    goal = None if wanted is None else positive(wanted, "rad", "wanted")
    passing = None if mark is None else positive(mark, "rad", "mark")
    if not 8 <= bits <= 32:
        raise edge.ArgumentError("bits", "it must be from 8 to 32", bits)
    known = before.posterior if isinstance(before, Recalibration) else fitted_drive(before)
    known = drifted(known, turns, walked)
    sets: dict[str, tuple[list[tuple[float, int]], list[LostMotion]]] = {}
    for load in loads:
        sets[f"{load:g} N·m one way"] = [(load, 1)], []
        sets[f"{load:g} N·m both ways"] = [(load, 1), (load, -1)], []
    if len(loads) > 1:
        words = f"{', '.join(f'{t:g}' for t in loads[:-1])} and {loads[-1]:g} N·m both ways"
        sets[words] = [(t, direction) for t, direction in itertools.product(loads, (1, -1))], []
    if passing is not None:
        # The position of the mark has hardly any effect on the information about the mean.
        marks = [LostMotion(0.0, passing * np.sqrt(2.0), loads[-1], 0.0)]
        sets[f"an index mark passed both ways at {loads[-1]:g} N·m"] = [], marks
    with equations():
        gradient = Gradient(known).gradients["backlash"]
        widths = {
            words: _half_widths(known, gradient, runs, marks, bits, share) for words, (runs, marks) in sets.items()
        }
    visits = [
        PlannedVisit(words, width, next((t for t in TURNS if goal is not None and width[t] <= goal), None))
        for words, width in widths.items()
    ]
    return sorted(visits, key=lambda visit: visit.half_width[TURNS[0]])


def _half_widths(
    known: Posterior,
    gradient: Array,
    runs: Sequence[tuple[float, int]],
    marks: Sequence[LostMotion],
    bits: int,
    share: float,
) -> dict[int, float]:
    """Return half of the backlash's 95 % interval after each of `TURNS` of a set of runs, or passings of marks, rad."""
    ratio = known.drive.pair.ratio
    thick = round(_SAMPLES / EACH)
    curves = [planned_curve(ratio, direction * load, direction, 1.0, EACH) for load, direction in runs]
    curves = [dataclasses.replace(c, sample_count=np.full_like(c.sample_count, thick)) for c in curves]
    noise = [quantised(c, bits) * np.sqrt(thick) for c in curves]
    observed, names = observed_in_place(curves, marks, known, torque_share=share, noise=noise), known.names
    known = with_joint(known, observed)
    state = state_before(known, observed)
    observed, linear = linear_near(dataclasses.replace(observed, earlier=known), known.drive, state)
    unknowns = Unknowns(known.drive.pair, observed, known.errors)
    told = Evidence.of(observed.rows(unknowns.columns(observed, linear)))
    by_name = dict(zip(names, gradient.tolist(), strict=True))
    slope = unknowns.scale * [by_name.get(name, 0.0) for name in unknowns.names]
    widths = {}
    for count in TURNS:
        posterior = (told.repeated(count) + unknowns.earlier(slope)).posterior(unknowns.precision(SIZES))
        widths[count] = float(NORMAL * np.sqrt(slope @ posterior.solve(slope)))
    return widths
