"""Predicted identification by planned bench runs: identified errors with their standard errors, and the others."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.arguments import positive
from fitting.estimation.realised import (
    displaced_covariance,
    errors_by_pattern,
    radius_lever_of,
)
from fitting.model.gaussian import Evidence, Gaussian
from fitting.model.identifiability import (
    chosen_from,
    covariance_of,
    weakness,
)
from fitting.model.loops import planned_branches
from fitting.model.observations import (
    PIN_RADIUS,
    RADIUS_SPREAD,
    Linear,
    Observations,
    State,
    estimated_parts,
    form_columns,
    joined,
    linearise,
    observations,
    spread_of,
    with_scatter,
)
from fitting.model.unknowns import Unknowns
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]


_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class NextRun:
    """A possible next run, and its effect on every pin and tooth: `Plan.realised` with it, m."""

    run: str
    realised: dict[str, float]


@dataclass(frozen=True)
class Plan:
    """Prediction for a set of bench runs.

    Attributes
    ----------
    runs
        The runs in words.
    standard_error
        {name: m or rad} of the errors that would be identified, allowing for the scatter of pins and teeth and a form
        of the flanks.
    held
        {name: reason} of the others.
    realised
        {pattern: m}: standard error of every pin's radial and tangential place and of every tooth's cumulative pitch,
        rms over the elements, their gauge removed as in `fitting.estimation.realised`.
    next_runs
        The same after one further run, the most useful first: at the bench's torques and those in between, in either
        direction, and a hysteresis loop with the crank locked at pin 0.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> *_, one = fitting.plan(cy.Drive(pair), torque=100.0, turns=1.0, samples=12)
    >>> one.runs, one.held["misalignment_xz"]
    ('100 N·m both ways', 'it has no effect on these transmission errors')
    >>> one.next_runs[0].realised["pin_radial"] < one.realised["pin_radial"]
    True
    """

    runs: str
    standard_error: dict[str, float]
    held: dict[str, str]
    realised: dict[str, float]
    next_runs: tuple[NextRun, ...]


def planned_curve(ratio: float, torque: float, direction: int, turns: float, samples: int) -> Curve:
    """Return the curve that a run would give, its transmission error all zero.

    Parameters
    ----------
    ratio
        Signed ratio.
    torque
        N·m.
    direction
        ±1.
    turns
        Output turns; more than one are averaged.
    samples
        Samples per crank turn.
    """
    points = round(samples * abs(ratio) * min(turns, 1.0))
    angle = np.arange(points) * 2.0 * np.pi / samples
    return Curve(
        input_angle=angle,
        transmission_error=np.zeros(points),
        standard_error=np.full(points, np.nan),
        sample_count=np.full(points, max(1, int(turns)), dtype=np.int64),
        torque=torque,
        torque_deviation=0.0,
        direction=direction,
        ratio=ratio,
        common_zero=True,
        known_index=True,
        source="plan",
        checksum="",
    )


def plan(
    drive: Drive,
    torque: float | str | Sequence[float | str] | None = None,
    *,
    turns: float = 2.0,
    samples: int = 24,
    noise: float | str = "0.5 arcsec",
    scatter: float | str = "0.3 um",
    form: float | str = "1 um",
    loop: float | str | None = None,
) -> list[Plan]:
    """Predict the identification of a drive by increasingly large sets of bench runs, before measuring.

    The sets are the largest torque in one direction, in both directions, then with the smallest and those in between
    added. Each set states the further run that improves every pin and tooth most.

    Parameters
    ----------
    drive
        The nominal drive.
    torque
        The torques that the bench can hold, N·m; it opposes the motion, so its sign changes with the direction. By
        default the rated torque.
    turns, samples
        Output turns of each run, and samples per crank turn.
    noise
        Standard deviation of a single sample of the transmission error, rad.
    scatter
        Scatter of the places of single pins and teeth beyond the structured errors, standard deviation, m; the same for
        single pins' radii, 0.3 µm at most. The derivatives are those of a ring drawn with it.
    form
        Expected size of a form that all flanks share, m, as in `fitting.identify`.
    loop
        Largest torque of a hysteresis loop, N·m, with the crank locked at pin 0: the first and the last set are also
        given with it.

    Raises
    ------
    edge.InputError
        If an argument is invalid.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> first, *_, last = fitting.plan(cy.Drive(pair), torque=[20.0, "200 N*m"], turns=1.0, samples=12)
    >>> last.runs
    '200 and 20 N·m both ways'
    >>> len(last.standard_error) > len(first.standard_error)
    True
    """
    torque = drive.pair.rated_load() if torque is None else torque
    given = [torque] if isinstance(torque, float | int | str) else torque
    loads = {positive(one, "N*m", "torque") for one in given}
    level = positive(noise, "rad", "noise")
    spread = positive(scatter, "m", "scatter", zero=True)
    shape = positive(form, "m", "form", zero=True)
    peak = None if loop is None else positive(loop, "N*m", "loop")
    if not loads:
        raise edge.ArgumentError("torque", "is missing")
    if not turns > 0.0:
        raise edge.ArgumentError("turns", "it must be above zero", turns)
    if samples < 6:
        raise edge.ArgumentError("samples", "it must be 6 or more", samples)
    ordered = sorted(loads, reverse=True)
    ordered = ordered[:1] + ordered[:0:-1]
    sets: list[tuple[str, list[float], tuple[int, ...], bool]]
    sets = [(f"{ordered[0]:g} N·m forward", ordered[:1], (1,), False)]
    for count in range(1, len(ordered) + 1):
        names = " and ".join(f"{t:g}" for t in ordered[:count])
        sets.append((f"{names} N·m both ways", ordered[:count], (1, -1), False))
    if peak is not None:
        wound = [(f"{s[0]} and a loop to {peak:g} N·m", s[1], s[2], True) for s in (sets[0], sets[-1])]
        sets = [sets[0], wound[0], *sets[1:], wound[1]]
    foretold = _Foretold(drive, ordered, peak, turns, samples, level, spread, shape)
    return [
        foretold.plan(runs, [(t, direction) for t in torques for direction in directions], with_loop)
        for runs, torques, directions, with_loop in sets
    ]


class _Foretold:
    """The model's derivatives in every run of a plan and every possible next run, evaluated once each."""

    def __init__(
        self,
        drive: Drive,
        torques: Sequence[float],
        loop: float | None,
        turns: float,
        samples: int,
        noise: float,
        scatter: float,
        form: float,
    ) -> None:
        pair = drive.pair
        self.pair = pair
        self.sizes = {**dict.fromkeys(estimated_parts(pair), scatter), PIN_RADIUS: min(scatter, RADIUS_SPREAD)}
        spread = spread_of(pair, self.sizes)
        self.peak = max(torques) if loop is None else loop
        loads = [*torques, *_between(torques)]
        self.runs = [(t, direction) for t in loads for direction in (1, -1)]
        running = [planned_curve(pair.ratio, direction * t, direction, turns, samples) for t, direction in self.runs]
        winding = planned_branches(pair, self.peak, 0.0, 0)
        # The next run may repeat one of these: the same derivatives, but a drift and a zero of its own.
        # Runs begin anywhere between two samples.
        running = [
            dataclasses.replace(c, input_angle=c.input_angle + np.mod(i * _GOLDEN, 1.0) * 2.0 * np.pi / samples)
            for i, c in enumerate(running)
        ]
        curves = [*running, *winding, *running, *planned_branches(pair, self.peak, 0.0, 1)]
        self.second = len(running) + len(winding)
        self.observed = observations(
            curves, pair, [noise / np.sqrt(c.sample_count[0]) for c in curves], first_stage=drive.first_stage
        )
        # Pins and teeth that scatter share a small load unevenly, so that single ones show more of themselves.
        drawn = spread * np.random.default_rng(0).standard_normal(spread.size)
        surface = with_scatter(surface_of_pair(pair), drawn)
        state = State(surface, np.zeros_like(spread), np.zeros(self.observed.bench.shape[1]))
        once = linearise(pair, self.observed.some(range(self.second)), state)
        self.linear = joined([once, once])
        whole = self.observed
        if form > 0.0:
            columns = form_columns(pair, self.observed.some(range(self.second)), state, once, form)
            whole = whole.with_form(np.vstack([columns, columns]), form)
        self.formed, self.unknowns = whole, Unknowns(pair, whole, whole.errors)
        self.told = [Evidence.of(self.unknowns.columns(*self._some(whole, [n]))).gram for n in range(2 * self.second)]
        self.precision = self.unknowns.precision(self.sizes)

    def plan(self, words: str, runs: Sequence[tuple[float, int]], with_loop: bool) -> Plan:
        """Prediction for a set of runs, and the possible next runs."""
        loop = list(range(len(self.runs), self.second))
        numbers = [self.runs.index(one) for one in runs] + loop * with_loop
        observed, linear = self._some(self.observed, numbers)
        information = np.diag(self.precision) + sum(self.told[n] for n in numbers)
        # As in a fit, errors are chosen as if the flanks had no form, which then widens their intervals.
        formless = Unknowns(self.pair, observed, observed.errors)
        chosen = chosen_from(formless, observed, Gaussian(self._of(formless, information)))
        _, _, reasons, _ = weakness(self.pair, observed, linear, chosen)
        covariance = self._known(chosen, information)
        error = np.sqrt(np.diag(covariance)[: len(chosen)])
        further = {
            f"{t:g} N·m {'forward' if direction > 0 else 'backward'}{' once more' * ((t, direction) in runs)}": [
                self.second + at
            ]
            for at, (t, direction) in enumerate(self.runs)
        }
        further[f"a loop to {self.peak:g} N·m{' once more' * with_loop}"] = [self.second + at for at in loop]
        nexts = []
        for run, added in further.items():
            more = information + sum(self.told[n] for n in added)
            nexts.append(NextRun(run, self._of_elements(chosen, self._known(chosen, more))))
        nexts.sort(key=lambda one: self._mean_square(one.realised))
        return Plan(
            words,
            dict(zip(chosen, error.tolist(), strict=True)),
            reasons,
            self._of_elements(chosen, covariance),
            tuple(nexts),
        )

    def _of(self, unknowns: Unknowns, information: Array) -> Array:
        """Information on some of all unknowns, if the others are zero."""
        at = np.array([self.unknowns.names.index(name) for name in unknowns.names])
        part: Array = information[np.ix_(at, at)]
        return part

    def _known(self, chosen: Sequence[str], information: Array) -> Array:
        """Covariance of chosen errors and of the scatter."""
        unknowns = Unknowns(self.pair, self.formed, chosen)
        return covariance_of(unknowns, Gaussian(self._of(unknowns, information)))

    def _some(self, observed: Observations, numbers: Sequence[int]) -> tuple[Observations, Linear]:
        places = np.split(np.arange(self.observed.measured.size), self.observed.ends)
        part = np.concatenate([places[n] for n in numbers])
        linear = Linear(*(getattr(self.linear, f.name)[part] for f in dataclasses.fields(Linear)))
        return observed.some(numbers), linear

    def _of_elements(self, chosen: Sequence[str], covariance: Array) -> dict[str, float]:
        lever = radius_lever_of(self.pair, chosen, covariance)
        return errors_by_pattern(self.pair, displaced_covariance(self.pair, chosen, covariance, lever))

    def _mean_square(self, realised: Mapping[str, float]) -> float:
        sizes = {name: part.stop - part.start for name, part in estimated_parts(self.pair).items()}
        return float(sum(sizes[name] * error**2 for name, error in realised.items()))


def _between(torques: Sequence[float]) -> list[float]:
    """Torques between the given ones, at their geometric mean; for a single one a third and a tenth."""
    if len(torques) == 1:
        return [float(f"{torques[0] * share:.2g}") for share in (0.3, 0.1)]
    ordered = sorted(torques)
    middles = {float(f"{np.sqrt(low * high):.2g}") for low, high in itertools.pairwise(ordered)}
    return sorted(middles - set(torques))
