"""Forecast of an ageing drive: figures over age with their intervals, remaining life, an alarm."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.posterior import drawn_surfaces
from cycloid_fmu.wear.law import WearLaw, duty_cycle
from fitting.ageing.history import HOUR, History
from fitting.ageing.life import FIGURES, LifeFigures, figures_of, life_figures, mean_figures
from fitting.ageing.posterior import Measured, Posterior, Prior, posterior, scores
from fitting.ageing.twin import aged_surface

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
        prior = self.posterior.prior
        if prior.growth == 0.0:
            return np.zeros_like(np.asarray(probability, dtype=float))
        return prior.growth * self.crank_turns_per_second * self.posterior.factor(probability, 1)

    def at(self, figure: str, age: float, probability: ArrayLike = QUANTILES) -> Array:
        """Return quantiles of a figure at an age (s), rad."""
        found = self.posterior.predicted(figure, age * self.crank_turns_per_second)
        return np.array([found.quantile(float(p))[0] for p in np.ravel(probability)]).reshape(np.shape(probability))

    @property
    def aged(self) -> Drive:
        """The twin: the drive at the last recording, with its life from new to the forecast's end.

        `Drive.at_age` returns the drive at any age, and `Drive.build_fmu` builds it at the last recording.
        """
        surface = aged_surface(
            self.posterior,
            self.drive.surface,
            self.crank_turns_per_second,
            self.now,
            float(self.ages[-1]),
            self.bearing,
        )
        return Drive(self.drive.pair.nominal, surface)

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
    end = _end(until, now)
    median, worn = law.coefficient or 1.0, history.bearing
    growth = 0.0 if worn is None else worn.clearance_growth / worn.within / per_second
    if life is None:
        reach = [*history.limits.stated().values(), *(m.value for m in measured)]
        most = {"dose": median * history.coefficient_factor**_BEYOND * end * per_second}
        if worn is not None:
            most["clearance"] = growth * worn.factor**_BEYOND * end * per_second
        life = life_figures(
            drive,
            law,
            loads,
            **most,
            growth=max(reach, default=_ROOM / edge.ARCSEC),
            bearing=None if worn is None else worn.name,
            workers=workers,
            progress=lambda share: progress(0.9 * share),
        )
    heaviest = max((load.torque for load in loads), key=abs)
    offset, factor = _offsets(drive, history, life, heaviest, workers), 10.0 if worn is None else worn.factor
    period = history.load_period * per_second
    prior = Prior(median, history.coefficient_factor, growth, factor, offset, history.load_scatter, period)
    after = posterior(life, prior, measured)
    progress(0.95)
    ages = np.linspace(0.0, end, _AGES)
    bands, remaining = _predicted(after, ages, per_second, {m.figure for m in measured}, history.limits.stated())
    placed = scores(life, prior, measured)
    progress(1.0)
    return Forecast(
        after,
        per_second,
        now,
        ages,
        bands,
        remaining,
        placed,
        _alarm(measured, placed, per_second),
        _notes(after, ages[-1] * per_second),
        drive,
        "" if worn is None else worn.name,
    )


def _end(until: float | None, now: float) -> float:
    """Return the age at the end of the forecast, s, from the stated one and that of the last recording."""
    if until is None and now == 0.0:
        raise edge.ArgumentError(
            "until", "is missing; there is no recording of a drive in use, whose age it could double"
        )
    end = until if until is not None else 2.0 * now
    if not end > now or not math.isfinite(end):
        raise edge.ArgumentError(
            "until", f"it must lie after the last recording, {now / HOUR:g} h", f"{end / HOUR:g} h"
        )
    return end


def _offsets(drive: Drive, history: History, life: LifeFigures, torque: float, workers: int | None) -> dict[str, float]:
    """Return the standard deviation of each figure's offset from the model, rad."""
    stated, unresolved = history.offsets.stated(), _left_open(drive, torque, workers)
    return {
        name: math.hypot(stated.get(name, _OFFSETS[name] / edge.ARCSEC), life.scatter[name], unresolved[name])
        for name in FIGURES
    }


def _predicted(
    after: Posterior, ages: Array, per_second: float, measured: Collection[str], limits: Mapping[str, float]
) -> tuple[dict[str, Array], dict[str, Remaining]]:
    """Return the bands of lost motion and all figures measured or limited, and the remaining life of the limited."""
    bands, remaining = {}, {}
    for name in FIGURES:
        if name not in measured and name not in limits and name != FIGURES[0]:
            continue
        mixture = after.predicted(name, ages * per_second)
        bands[name] = np.array([mixture.quantile(p) for p in QUANTILES])
        if name in limits:
            remaining[name] = _remaining(limits[name], 1.0 - mixture.below(limits[name]), ages)
    return bands, remaining


def _left_open(drive: Drive, torque: float, workers: int | None) -> dict[str, float]:
    """Return the standard deviation of the figures when new from a fit's covariance, rad."""
    if drive.surface.covariance is None:
        return dict.fromkeys(FIGURES, 0.0)
    drawn = drawn_surfaces(drive.pair, drive.surface, _DRAWS, 0)
    found = [mean_figures(figures_of(DriveValue(drive.pair, one), torque, workers or 1)) for one in drawn]
    return {name: float(np.std([one[name] for one in found], ddof=1)) for name in FIGURES}


def _remaining(limit: float, beyond: Array, ages: Array) -> Remaining:
    """Return when a limit is exceeded: wear is irreversible, so the probability never decreases."""
    probability = np.maximum.accumulate(beyond)
    found: dict[float, float] = {}
    for wanted in _TIMES:
        at = int(np.searchsorted(probability, wanted))
        if at == ages.size:
            found[wanted] = math.inf
        elif at == 0:
            found[wanted] = float(ages[0])
        else:
            low, high = probability[at - 1], probability[at]
            found[wanted] = float(ages[at - 1] + (wanted - low) / (high - low) * (ages[at] - ages[at - 1]))
    return Remaining(limit, probability, found)


def _alarm(measured: Sequence[Measured], placed: Array, per_second: float) -> Alarm | None:
    """Return the consecutive recordings with the largest contradiction to the model, if chance hardly explains it.

    Of every run of figures in a row the mean score times the root of its number is a standard normal number; the
    probabilities of all runs add up (Bonferroni).
    """
    total = np.concatenate([[0.0], np.cumsum(placed)])
    best, where = 0.0, (0, 0)
    for first in range(placed.size):
        for last in range(first + 1, placed.size + 1):
            score = float((total[last] - total[first]) / math.sqrt(last - first))
            if abs(score) > abs(best):
                best, where = score, (first, last)
    runs = placed.size * (placed.size + 1) / 2.0
    chance = min(1.0, 2.0 * runs * math.exp(float(log_ndtr(-abs(best)))))
    if placed.size == 0 or chance >= ALARM:
        return None
    begun, ended = (measured[k].crank_turns / per_second for k in (where[0], where[1] - 1))
    when = f"from {begun / HOUR:.6g} h to {ended / HOUR:.6g} h" if begun < ended else f"at {begun / HOUR:.6g} h"
    how = "faster" if best > 0.0 else "more slowly"
    why = "wear may be running away" if best > 0.0 else "the drive, its zero or its bench may have changed"
    sentence = (
        f"Alarm: the figures {when} contradict the model; they grow {how} than predicted from the earlier ones (score "
        f"{best:.1f}, chance {chance:.1g}): {why}, and the forecast is not valid."
    )
    return Alarm(begun, ended, best, chance, sentence)


def _notes(after: Posterior, turns: float) -> tuple[str, ...]:
    """Return notes on extrapolation, and on factors with little information from the recordings."""
    notes = []
    prior, life = after.prior, after.life
    beyond = float(after.weight[prior.coefficient * np.exp(after.logs[:, 0]) * turns > life.dose[-1]].sum())
    if beyond > 0.01:
        notes.append(
            f"With a probability of {beyond:.0%} the wear at the forecast's end is deeper than computed; figures are "
            "extrapolated linearly there."
        )
    if prior.growth > 0.0:
        grown = prior.growth * np.exp(after.logs[:, 1]) * turns
        if float(after.weight[grown > life.clearance[-1]].sum()) > 0.01:
            notes.append(
                "The clearance may grow beyond the largest computed one; figures are extrapolated linearly there."
            )
    names = ["wear coefficient", "growth of the clearance"]
    for number, before in enumerate(prior.deviations):
        about = math.sqrt(float(after.weight @ (after.logs[:, number] - after.weight @ after.logs[:, number]) ** 2))
        if about > 0.7 * before:
            notes.append(
                f"The recordings hardly determine the {names[number]}: it is nearly as uncertain as before them."
            )
    return tuple(notes)


def as_json(found: Forecast) -> dict[str, Any]:
    """Return a forecast as the content of a `cycloid-forecast/1` file (SI)."""
    after = found.posterior
    levels = {f"{p:g}": k for k, p in enumerate(QUANTILES)}
    grown = (
        {}
        if after.prior.growth == 0.0
        else {"clearance_growth": dict(zip(levels, found.growth(QUANTILES), strict=True))}
    )
    return {
        "format": FORMAT,
        "holds": found.alarm is None,
        "alarm": None if found.alarm is None else vars(found.alarm),
        "wear_coefficient": dict(zip(levels, found.coefficient(QUANTILES), strict=True)),
        "wear_factor": dict(zip(levels, after.factor(QUANTILES) / after.factor(0.5), strict=True)),
        **grown,
        "bearing": found.bearing or None,
        "crank_turns_per_second": found.crank_turns_per_second,
        "now": found.now,
        "ages": found.ages,
        "bands": {name: {p: band[k] for p, k in levels.items()} for name, band in found.bands.items()},
        "limits": {
            name: {
                "limit": one.limit,
                "probability_beyond": one.probability,
                "age": {f"{p:g}": age if math.isfinite(age) else None for p, age in one.ages.items()},
            }
            for name, one in found.remaining.items()
        },
        "measured": [
            {**vars(m), "age": m.crank_turns / found.crank_turns_per_second, "score": z}
            for m, z in zip(after.measured, found.scores, strict=True)
        ],
        "notes": list(found.notes),
    }
