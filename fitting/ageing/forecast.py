"""Forecast of an ageing drive: figures over age with their intervals, remaining life, an alarm."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.posterior import drawn_surfaces
from cycloid_fmu.surfaces.surface import DEVIATIONS, Ageing, Life, surface_after
from cycloid_fmu.wear.law import WearLaw, duty_cycle
from cycloid_fmu.wear.life import LARGEST_LIFE
from fitting.ageing.history import HOUR, History
from fitting.ageing.life import FIGURES, LifeFigures, figures_of, largest_growth, life_figures, means_of
from fitting.ageing.posterior import Measured, Mixture, Posterior, Prior, posterior, scores

Array = NDArray[np.float64]
FORMAT = "cycloid-forecast/1"
QUANTILES = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
"""Probabilities of a forecast's bands: intervals of 50, 90 and 95 %, and the median."""
ALARM = 1e-3
"""Probability of a false alarm in a history."""
_AGES = 121
_TIMES = (0.05, 0.5, 0.95)  # probabilities of the remaining life
_OFFSETS = {"lost_motion": 30.0, "backlash": 30.0, "angular_transmission_error": 10.0}  # arcsec, defaults
_BEYOND = 2.3  # times the prior's 95 % interval (4.5 standard deviations): end of the computed life
_DRAWS = 12  # of an identified drive, for the uncertainty of its figures when new
_UNLIKELY = 0.01  # probability of wear beyond the computed life, from which on it is noted
_NO_NEWS = 0.7  # of the prior's standard deviation of a factor: recordings that leave more of it hardly determine it
INTERVAL = (0.025, 0.5, 0.975)
"""Probabilities of a median and its 95 % interval."""
_ROOM = 120.0  # arcsec: growth of the lost motion in a life without limits and recordings


@dataclass(frozen=True)
class Alarm:
    """Recordings that contradict the model.

    Attributes
    ----------
    first, last
        Ages of the first and the last of them, s.
    score
        Mean of their scores times the root of their number: > 0 if the drive wears faster than predicted.
    chance
        Probability of a score as large anywhere in the history, if the model is valid.
    sentence
        The same as text.
    """

    first: float
    last: float
    score: float
    chance: float
    sentence: str


@dataclass(frozen=True)
class Remaining:
    """When a figure exceeds its limit.

    Attributes
    ----------
    limit
        rad.
    probability
        That the figure is beyond the limit at each of the forecast's ages, shape (ages,).
    ages
        {probability: age at which the limit is exceeded with it}, s; infinite if that is after the forecast's end.
    """

    limit: float
    probability: Array
    ages: Mapping[float, float]


@dataclass(frozen=True)
class Forecast:
    """Forecast of a drive from dated recordings.

    Attributes
    ----------
    posterior
        The distribution of wear coefficient and bearing wear, and the figures measured.
    crank_turns_per_second
        Of running.
    now
        Age at the last recording, s.
    ages
        Shape (ages,), from 0 to the forecast's end, s.
    bands
        {figure: quantiles of `QUANTILES`, shape (7, ages)}, rad: the figure as measured on the bench, without noise.
    remaining
        {figure: when it exceeds its limit}, for figures with a limit.
    scores
        Quantile of each figure in its prediction from the earlier ones: standard normal numbers if the model is valid.
    alarm
        Recordings that contradict the model, or None.
    notes
        Remarks on the result.
    """

    posterior: Posterior
    crank_turns_per_second: float
    now: float
    ages: Array
    bands: Mapping[str, Array]
    remaining: Mapping[str, Remaining]
    scores: Array
    alarm: Alarm | None
    notes: tuple[str, ...]
    drive: Drive
    bearing: str = ""

    def coefficient(self, probability: ArrayLike = 0.5) -> Array:
        """Return quantiles of the wear coefficient, m²/N; with a regression, of the factor on it."""
        return self.posterior.prior.coefficient * self.posterior.factor(probability)

    def growth(self, probability: ArrayLike = 0.5) -> Array:
        """Return quantiles of the growth of the bearing's clearance, m/s; zero if none wears."""
        return self.posterior.prior.growth * self.crank_turns_per_second * self.posterior.factor(probability, -1)

    def at(self, figure: str, age: float, probability: ArrayLike = QUANTILES) -> Array:
        """Return quantiles of a figure at an age (s), rad."""
        figures = self.posterior.predicted(figure, age * self.crank_turns_per_second)
        return np.asarray(np.vectorize(lambda p: float(figures.quantile(p)[0]))(probability))

    @property
    def aged(self) -> Drive:
        """The twin: the drive at the last recording, with its life from new to the forecast's end.

        `Drive.at_age` returns the drive at any age, and `Drive.build_fmu` builds it at the last recording. The life
        has the median wear coefficient, and ends at the forecast's end, or where the wear is no longer computed.

        Raises
        ------
        edge.InputError
            If the wear was not computed up to the last recording.
        """
        surface, life, turning = self.drive.surface, self.posterior.life, self.crank_turns_per_second
        coefficients = self.coefficient(INTERVAL)
        low, high = np.clip(coefficients[[0, 2]] / coefficients[1], (0.0, 1.0), (1.0, np.inf))
        turns = life.dose / coefficients[1]
        largest, growth = min(self.ages[-1], turns[-1] / (turning * high)), float(self.growth())
        if growth > 0.0:
            largest = min(largest, largest_growth(surface.pair, self.bearing) / growth)
        if largest < self.now:
            raise edge.InputError(
                f"The drive is worn deeper at {self.now / HOUR:g} h than computed: there is no twin of it; state "
                "larger limits of the figures, or of the wear file's depth."
            )
        # States beyond the largest age are not needed; a worn surface has a limited number of them.
        states = int(np.searchsorted(turns, largest * turning * high * (1.0 - 1e-9))) + 1
        chosen = np.unique(np.linspace(0, min(states, turns.size) - 1, LARGEST_LIFE).round().astype(int))
        worn = {n: np.stack([getattr(life.surfaces[k], n) for k in chosen]) for n in DEVIATIONS}
        ageing = Ageing(turning, self.now, float(largest), float(low), float(high), growth, self.bearing)
        surface = surface.replace(
            **{name: values[-1] for name, values in worn.items()},
            origin="worn",
            covariance=None,
            covariance_of=(),
            life=Life(turns[chosen], *worn.values(), ageing=ageing),
        )
        return Drive(self.drive.pair.nominal, surface_after(surface, self.now * turning))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the forecast, `cycloid-forecast/1` (JSON), whole or not at all."""
        with edge.written_whole(path) as temporary:
            temporary.write_text(edge.json_text(as_json(self)), encoding="utf-8")


def forecast(
    drive: Drive,
    law: WearLaw,
    history: History,
    measured: Sequence[Measured],
    *,
    until: float | None = None,
    life: LifeFigures | None = None,
    source: str = "history",
    workers: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Forecast:
    """Estimate wear coefficient and bearing wear from dated figures, and predict the figures.

    Parameters
    ----------
    drive
        The new drive: nominal, with its errors, or identified; the covariance of an identified one widens the offsets.
    law
        The wear law; its coefficient is the median of the prior. With a regression the median is a factor of 1.
    history, measured
        Duty, priors and limits, and the dated figures from `history.measured`.
    until
        Age at the end of the forecast, s; twice that of the last recording if None.
    life
        Result of `life.life_figures` for this drive and duty; computed if None.
    source
        The history's file, for messages.
    workers, progress
        Threads; called with the fraction done, 0 to 1.

    Raises
    ------
    edge.InputError
        If there is no duty or no rated torque, or the forecast would end before the last recording.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> from cycloid_fmu.wear.law import WearLaw
    >>> from fitting.ageing.forecast import forecast
    >>> from fitting.ageing.history import History, measured
    >>> pair = cy.Pair(
    ...     gear_teeth=11, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
    ...     rated_torque="181 N*m", modification={"isometric": "-15 um", "offset": "-40 um"},
    ... )
    >>> history = History(
    ...     crank_turns_per_hour=9e4, torque="-181 N*m", coefficient_factor=2.0, limits={"lost_motion": "800 arcsec"},
    ...     recorded=[
    ...         {"age": "0 h", "lost_motion": ["734 arcsec", "1 arcsec"]},
    ...         {"age": "500 h", "lost_motion": ["750 arcsec", "1 arcsec"]},
    ...     ],
    ... )
    >>> drive = cy.Drive(pair)
    >>> law = WearLaw(pins="free", coefficient="2e-20 m^2/N", largest_step="4 um")
    >>> found = forecast(drive, law, history, measured(history, drive), until=3000 * 3600.0, workers=1)
    >>> 1900 < found.remaining["lost_motion"].ages[0.5] / 3600.0 < 2300
    True
    """
    loads, _ = duty_cycle(law, history.torque, 1.0, None, source, drive.pair)
    per_second = history.crank_turns_per_hour / HOUR
    now = max((m.crank_turns for m in measured), default=0.0) / per_second
    ages, bearing, limits = np.linspace(0.0, _end(until, now), _AGES), history.bearing, history.limits.stated()
    turns = ages * per_second
    prior = Prior(
        law.coefficient or 1.0,
        history.coefficient_factor,
        scatter=history.load_scatter,
        period=history.load_period * per_second,
    )
    name = ""
    if bearing is not None:
        name, growth = bearing.name, bearing.clearance_growth / bearing.within / per_second
        prior = dataclasses.replace(prior, growth=growth, growth_factor=bearing.factor)
    if life is None:
        life = life_figures(
            drive,
            law,
            loads,
            prior.coefficient * prior.coefficient_factor**_BEYOND * turns[-1],
            growth=max([*limits.values(), *(m.value for m in measured)], default=_ROOM / edge.ARCSEC),
            bearing=name,
            clearance=prior.growth * prior.growth_factor**_BEYOND * turns[-1],
            workers=workers,
            progress=lambda share: progress(0.9 * share),
        )
    heaviest = max((load.torque for load in loads), key=abs)
    prior = dataclasses.replace(prior, offset=_offsets(drive, history, life, heaviest, workers or 1))
    after = posterior(life, prior, measured)
    progress(0.95)
    shown = {FIGURES[0], *limits, *(m.figure for m in measured)}
    predicted = {name: after.predicted(name, turns) for name in FIGURES if name in shown}
    score = scores(life, prior, measured)
    progress(1.0)
    return Forecast(
        after,
        per_second,
        now,
        ages,
        {name: np.array([figure.quantile(p) for p in QUANTILES]) for name, figure in predicted.items()},
        {name: _remaining(limit, predicted[name], ages) for name, limit in limits.items()},
        score,
        _alarm(np.array([m.crank_turns for m in measured]) / per_second, score),
        _notes(after, turns[-1]),
        drive,
        name,
    )


def _end(until: float | None, now: float) -> float:
    """Return the age at the end of the forecast, s, from the stated one and that of the last recording."""
    if until is None and now == 0.0:
        problem = "is missing; there is no recording of a drive in use, whose age it could double"
        raise edge.ArgumentError("until", problem)
    end = 2.0 * now if until is None else until
    if not now < end < math.inf:
        problem = f"it must lie after the last recording, {now / HOUR:g} h"
        raise edge.ArgumentError("until", problem, f"{end / HOUR:g} h")
    return end


def _offsets(drive: Drive, history: History, life: LifeFigures, torque: float, workers: int) -> dict[str, float]:
    """Return the standard deviation of each figure's offset from the model, rad, with that of a fit's covariance."""
    offsets = {**{name: value / edge.ARCSEC for name, value in _OFFSETS.items()}, **history.offsets.stated()}
    drawn = []
    if drive.surface.covariance is not None:
        for surface in drawn_surfaces(drive.pair, drive.surface, _DRAWS, 0):
            drawn.append(means_of(figures_of(DriveValue(drive.pair, surface), torque, workers)))
    fitted = {name: float(np.std([means[name] for means in drawn], ddof=1)) if drawn else 0.0 for name in FIGURES}
    return {name: math.hypot(offsets[name], life.scatter[name], fitted[name]) for name in FIGURES}


def _remaining(limit: float, figure: Mixture, ages: Array) -> Remaining:
    """Return when a limit is exceeded: wear is irreversible, so the probability never decreases."""
    beyond = np.maximum.accumulate(1.0 - figure.below(limit))
    return Remaining(limit, beyond, {p: float(np.interp(p, beyond, ages, right=math.inf)) for p in _TIMES})


def _alarm(ages: Array, score: Array) -> Alarm | None:
    """Return the consecutive recordings with the largest contradiction to the model, if chance hardly explains it.

    Of every run of figures in a row the mean score times the root of its number is a standard normal number; the
    probabilities of all runs add up (Bonferroni).
    """
    total = np.concatenate([[0.0], np.cumsum(score)])
    runs = {(a, b): float(total[b] - total[a]) / math.sqrt(b - a) for a, b in combinations(range(total.size), 2)}
    (first, end), largest = max(runs.items(), key=lambda run: abs(run[1]), default=((0, 0), 0.0))
    chance = min(1.0, 2.0 * len(runs) * math.exp(float(log_ndtr(-abs(largest)))))
    if not runs or chance >= ALARM:
        return None
    begun, ended = float(ages[first]), float(ages[end - 1])
    when = f"from {begun / HOUR:.6g} h to {ended / HOUR:.6g} h" if begun < ended else f"at {begun / HOUR:.6g} h"
    how, why = (
        ("faster", "wear may be running away")
        if largest > 0.0
        else ("more slowly", "the drive, its zero or its bench may have changed")
    )
    sentence = (
        f"Alarm: the figures {when} contradict the model; they grow {how} than predicted from the earlier ones (score "
        f"{largest:.1f}, chance {chance:.1g}): {why}, and the forecast is not valid."
    )
    return Alarm(begun, ended, largest, chance, sentence)


def _notes(after: Posterior, turns: float) -> tuple[str, ...]:
    """Return notes on extrapolation, and on factors with little information from the recordings."""
    notes, prior, life = [], after.prior, after.life
    factors = (
        ("wear", "wear coefficient", prior.coefficient * turns, life.dose[-1]),
        ("bearing's clearance", "growth of the clearance", prior.growth * turns, life.clearance[-1]),
    )
    for (name, unknown, median, computed), logs, before in zip(factors, after.logs.T, prior.deviations, strict=False):
        beyond = float(after.weight[median * np.exp(logs) > computed].sum())
        if beyond > _UNLIKELY:
            notes.append(
                f"With a probability of {beyond:.0%} the {name} at the forecast's end is larger than computed; figures "
                "are extrapolated linearly there."
            )
        if math.sqrt(float(after.weight @ (logs - after.weight @ logs) ** 2)) > _NO_NEWS * before:
            notes.append(f"The recordings hardly determine the {unknown}: it is nearly as uncertain as before them.")
    return tuple(notes)


def as_json(result: Forecast) -> dict[str, Any]:
    """Return a forecast as the content of a `cycloid-forecast/1` file (SI)."""

    def levels(values: Array) -> dict[str, Any]:
        return dict(zip(map("{:g}".format, QUANTILES), values, strict=True))

    factor, measured = result.posterior.factor, result.posterior.measured
    growth = {"clearance_growth": levels(result.growth(QUANTILES))} if result.bearing else {}
    return {
        "format": FORMAT,
        "holds": result.alarm is None,
        "alarm": None if result.alarm is None else vars(result.alarm),
        "wear_coefficient": levels(result.coefficient(QUANTILES)),
        "wear_factor": levels(factor(QUANTILES) / factor(0.5)),
        **growth,
        "bearing": result.bearing or None,
        "crank_turns_per_second": result.crank_turns_per_second,
        "now": result.now,
        "ages": result.ages,
        "bands": {name: levels(band) for name, band in result.bands.items()},
        "limits": {
            name: {
                "limit": remaining.limit,
                "probability_beyond": remaining.probability,
                "age": {f"{p:g}": age if math.isfinite(age) else None for p, age in remaining.ages.items()},
            }
            for name, remaining in result.remaining.items()
        },
        "measured": [
            {**vars(m), "age": m.crank_turns / result.crank_turns_per_second, "score": score}
            for m, score in zip(measured, result.scores, strict=True)
        ],
        "notes": list(result.notes),
    }
