"""Update the model of a drive from measurements of its joint in the field; raise an alarm if it is no longer valid."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.surfaces.structured import unit_of
from fitting.arguments import positive
from fitting.estimation.continuation import check_comparable
from fitting.model.bearings import unit_of_bearing, unknown_bearings
from fitting.model.gaussian import equations
from fitting.model.loops import observed_curves
from fitting.model.posterior import Posterior
from fitting.readers.sources import Source
from fitting.recalibration.drift import DRIFT, drifted, fitted_drive
from fitting.recalibration.figures import FigureOfDrive, figures_of
from fitting.recalibration.measured import TORQUE_SHARE, LostMotion, observed_in_place
from fitting.recalibration.update import Updated, updated
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

FALSE_ALARM = 1e-3
"""Probability of a false alarm of each of the two tests, one of the drift and one of the residual."""
_HARMONICS = 8  # of the orders of pins and teeth in the output, at which the residual is tested
_NAMED = 3  # most errors or orders in a message
_LEAST_VARIANCE = 1e-9  # of a row, in units of its noise: rounding
_WEAK = 1.0  # information below which the prior determines a combination more than the measurements do


@dataclass(frozen=True)
class Dated:
    """Figures of a drive at one date: crank turns since the fit, {figure: value and interval}, and the alarm or ""."""

    crank_turns: float
    figures: Mapping[str, FigureOfDrive]
    alarm: str = ""


@dataclass(frozen=True)
class Recalibration:
    """The result of a recalibration.

    Attributes
    ----------
    drive
        The drive at this date, its surface with its covariance. With an alarm it is the drive at the last date, with a
        covariance that includes the drift.
    alarm
        "" if the model is valid; else a sentence with the deviations.
    history
        Figures of all dates, this one last; the first entry is the drive as given.
    moved
        {name: (change in m, rad or as a share; the same in standard deviations of the drift)} of every error, bearing,
        single pin and tooth. With an alarm, the changes that would follow from the measurements.
    told
        Information about each combination of errors relative to the prior's, largest first: above 1 the measurements
        contain more information than the prior.
    better_known
        Errors, bearings, pins and teeth whose standard deviation is now below 0.7 of the prior's, as text.
    remaining
        Number of combinations with an information below 1, which keep their prior uncertainty.
    drift_chance, left_chance
        Probability that wear causes a change as large, and that noise causes a residual as large.
    posterior
        What is known of the drive: the prior of the next date, before drift, or of `fitting.identify`.
    notes
        Notes for the reader.
    """

    drive: Drive
    alarm: str
    history: tuple[Dated, ...]
    moved: Mapping[str, tuple[float, float]]
    told: Array
    better_known: tuple[str, ...]
    remaining: int
    drift_chance: float
    left_chance: float
    posterior: Posterior
    notes: tuple[str, ...]

    @property
    def figures(self) -> Mapping[str, FigureOfDrive]:
        """Figures at this date: `backlash`, `lost_motion` and `transmission_error`, rad."""
        return self.history[-1].figures


def recalibrate(
    before: Drive | Recalibration,
    recordings: Source | Curve | Iterable[Source | Curve] = (),
    *,
    lost_motions: Sequence[LostMotion] = (),
    crank_turns: float,
    bits: int | None = None,
    drift: float | str = DRIFT,
    torque_share: float = TORQUE_SHARE,
) -> Recalibration:
    """Update a drive from measurements of its joint: motor angle against a coarse output reference.

    Parameters
    ----------
    before
        The drive that `identify` found, or the last recalibration.
    recordings
        As for `fitting.identify`: runs under load in both directions, and loops. The torque may be estimated from the
        motor's current or the load's weight.
    lost_motions
        Measured values of the lost motion, for example from an index mark passed in both directions.
    crank_turns
        Number of crank turns since the last date, ≥ 0.
    bits
        Resolution of the output reference, bits per turn; None if the noise of the curves includes it.
    drift
        Standard deviation of the uniform wear in 10^7 crank turns, m.
    torque_share
        Relative standard deviation of the torque's scale.

    Raises
    ------
    edge.InputError
        If a recording cannot be read or belongs to another drive, an argument is invalid, the drive has no covariance,
        or there is no measurement.

    Examples
    --------
    A drive whose backlash has grown by 20″ since its identification, measured at an index mark:

    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> from fitting.recalibration.measured import LostMotion
    >>> from fitting.recalibration.recalibrate import recalibrate
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> fitted = cy.Drive(pair).replace(errors={"pin_radius": "-2 um"}).surface
    >>> fitted = fitted.replace(covariance=np.array([[1e-14]]), covariance_of=("pin_radius",))
    >>> drive = cy.Drive(pair, fitted)
    >>> first = recalibrate(drive, lost_motions=[LostMotion("65 arcsec", "5 arcsec", "1 N*m")], crank_turns=1e7)
    >>> first.alarm, first.drive.surface.pin_radius < drive.surface.pin_radius
    ('', True)
    """
    if isinstance(before, Recalibration):
        known, history = before.posterior, before.history
    else:
        known = fitted_drive(before)
        history = (Dated(0.0, figures_of(known)),)
    drive = known.drive
    turns = positive(crank_turns, "1", "crank_turns", zero=True)
    walked = positive(drift, "m", "drift", zero=True)
    share = positive(torque_share, "1", "torque_share", zero=True)
    if bits is not None and not 8 <= bits <= 32:
        raise edge.ArgumentError("bits", "it must be from 8 to 32", bits)
    with equations():
        curves = observed_curves(recordings, drive)
        for curve in curves:
            check_comparable(curve, drive)
        known = drifted(known, turns, walked)
        found = updated(observed_in_place(curves, lost_motions, known, bits=bits, torque_share=share))
        chance, sentences = contradictions(found, lost_motions)
        alarm = alarm_of(found, sentences)
        if alarm:
            surface = drive.surface.replace(covariance=known.of_surface, covariance_of=(*known.errors, *known.scatter))
            stays = Drive(drive.pair, surface, drive.first_stage)
            posterior = dataclasses.replace(known, drive=stays)
        else:
            posterior = found.posterior
        figures = figures_of(posterior)
    return Recalibration(
        drive=posterior.drive,
        alarm=alarm,
        history=(*history, Dated(history[-1].crank_turns + turns, figures, alarm)),
        moved=found.moved,
        told=found.told,
        better_known=_better_known(known, found.posterior),
        remaining=int(np.count_nonzero(found.told < _WEAK)),
        drift_chance=found.drift_chance,
        left_chance=chance,
        posterior=posterior,
        notes=_notes(curves, found, lost_motions),
    )


def contradictions(found: Updated, lost_motions: Sequence[LostMotion]) -> tuple[float, list[str]]:
    """Return the probability that noise causes the residual at the gear's orders, and the significant orders as text.

    Residuals at other orders of the output are errors of the coarse reference and are not tested.
    """
    observed = found.observed
    residuals = observed.rows_of_curves(found.residual)
    teeth = round(abs(observed.curves[0].ratio))
    # Pins repeat with every crank turn; teeth repeat once more or once less per output turn.
    cogs = {abs(teeth + 1), teeth} if observed.curves[0].ratio < 0 else {teeth, abs(teeth - 1)}
    orders = sorted({k * cog for cog in cogs for k in range(1, _HARMONICS + 1)})
    chances: dict[str, float] = {}
    if observed.running:
        power = np.zeros(len(orders))
        for i in observed.running:
            turned = observed.curves[i].input_angle / abs(observed.curves[i].ratio)
            power += np.abs(np.exp(-1j * np.outer(orders, turned)) @ residuals[i]) ** 2 / turned.size
        for order, chance in zip(orders, special.gammaincc(len(observed.running), power), strict=True):
            chances[f"order {order} of the output"] = float(chance)
    count = len(lost_motions)
    ends = zip(found.residual[-count:], found.variance[-count:], strict=True) if count else ()
    for lost_motion, (residual, variance) in zip(lost_motions, ends, strict=True):
        chances[f"the lost motion of {lost_motion.value * ARCSEC:.1f}″ at {lost_motion.torque:.3g} N·m"] = float(
            special.chdtrc(1, residual**2 / max(variance, _LEAST_VARIANCE))
        )
    if not chances:
        return 1.0, []
    least = min(1.0, min(chances.values()) * len(chances))
    standing = sorted((c, name) for name, c in chances.items() if c * len(chances) < FALSE_ALARM)
    return least, [name for _, name in standing[:_NAMED]]


def alarm_of(found: Updated, standing: Sequence[str]) -> str:
    """Return the alarm as text, "" if the model is valid."""
    parts = []
    if found.drift_chance < FALSE_ALARM:
        worst = sorted(found.moved.items(), key=lambda item: -abs(item[1][1]))[:_NAMED]
        named = ", ".join(f"{n} by {_sized(n, by)}, {abs(times):.1f} times" for n, (by, times) in worst)
        parts.append(
            f"the drive would have moved further than its wear since the last date allows (mainly {named} the standard "
            "deviation of what can be expected)"
        )
    if standing:
        parts.append(f"the residual is more than noise: {', '.join(standing)}")
    if not parts:
        return ""
    return (
        f"The model no longer holds: {'; '.join(parts)}. Was a part exchanged or broken, or is a torque or an angle "
        "wrong? The drive is not updated; record again, and identify it again if the alarm remains."
    )


def _sized(name: str, value: float) -> str:
    if name.endswith("_stiffness"):
        return f"{value:+.1%}"
    is_bearing = name.rpartition("_")[2] in ("clearance", "play")
    unit = unit_of_bearing(name) if is_bearing else unit_of(name.partition("_at_")[0])
    return f"{value * 1e6:+.2f} µm" if unit == "m" else f"{value * 1e3:+.3f} mrad"


def _better_known(before: Posterior, after: Posterior) -> tuple[str, ...]:
    """Return the errors that are known more accurately than before, the largest gain first."""
    was, now = before.deviations, after.deviations
    bearings = unknown_bearings(after.drive.pair, after.drive.first_stage)
    ratio = {n: now[n] / was[n] for n in before.names if was[n] > 0.0 and (n not in before.bench or n in bearings)}
    return tuple(
        f"{n}: {_sized(n, now[n])[1:]} instead of {_sized(n, was[n])[1:]}"
        for n in sorted(ratio, key=lambda name: ratio[name])
        if ratio[n] < np.sqrt(0.5)
    )


def _notes(curves: Sequence[Curve], found: Updated, lost_motions: Sequence[LostMotion]) -> tuple[str, ...]:
    notes = [note for curve in curves for note in curve.notes]
    if found.outliers:
        points = np.count_nonzero(~found.observed.of_lost_motions)
        notes.append(f"{found.outliers} of {points} points are far off and were left out.")
    running = [c for c in curves if not c.branch]
    if len(running) > 1 and not all(c.common_zero for c in running):
        notes.append(
            "The recordings have no common zero, so the offset of the output between the directions is unknown: "
            'if its encoder is absolute, state zero_reference = "absolute" of [output_angle] in the mapping.'
        )
    if not lost_motions and len({np.sign(c.torque) for c in running}) == 1 and len(running) == len(curves):
        notes.append(
            "All torques have one sign, so the play was not crossed: the backlash follows from one side of the flanks."
        )
    return tuple(dict.fromkeys(notes))
