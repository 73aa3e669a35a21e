"""The result of an identification: errors with their intervals, unresolved errors, and its file.

The intervals allow for noise as correlated as the residual, for the scatter of single pins and teeth, and for the
degrees of freedom of the data.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from cycloid_fmu.analysis import tilt_notes
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.sampling import Tolerances
from cycloid_fmu.surfaces.structured import structured_value, unit_of
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.estimation.allowances import (
    LAG_NAME,
    allowing,
    bearings_found,
    clock_lag_found,
    form_note,
    lag_note,
    moved_by_form,
    moved_by_held,
)
from fitting.estimation.confirmation import Confirmed, as_lmfit, confirmed, lmfit_states, stated, with_covariance
from fitting.estimation.effects import Effect, effects_of
from fitting.estimation.effects import as_json as effect_as_json
from fitting.estimation.explanation import GAIN
from fitting.estimation.fit import Estimate, allowed_radius, freedom, turn_bootstrap
from fitting.estimation.minimisation import Search
from fitting.estimation.parameter import CONFIDENCE, Parameter, parameter, parameter_as_json, withheld
from fitting.estimation.realised import GAUGE, Realised, realised
from fitting.estimation.run_out import RunOut, run_outs_of
from fitting.estimation.starts import is_uneven
from fitting.estimation.validation import SAME_LOAD, HeldOut, Verdict, with_run_out
from fitting.model.bearings import (
    pair_with,
)
from fitting.model.constraints import Constraints, loaded
from fitting.model.discrepancy import SHIFTS
from fitting.model.first_stage import share_of, with_play
from fitting.model.identifiability import weakness
from fitting.model.loops import LoopFit, play_of
from fitting.model.losses import friction_notes, is_coefficient, key_of, separation_notes
from fitting.model.observations import (
    CHAIN,
    MISFIT,
    PIN_RADIUS,
    Observations,
    estimated_parts,
    left_of,
    scatter_columns,
    scatter_names,
    scatter_parts,
    spread_of,
    with_scatter,
)
from fitting.model.posterior import Posterior, fitted_to, lasting
from fitting.model.prior import posterior_as_json, tolerances_of
from fitting.model.unknowns import NO_SCATTER
from fitting.transmission_error.curve import Curve

if TYPE_CHECKING:
    from lmfit import Parameters
    from lmfit.minimizer import MinimizerResult

Array = NDArray[np.float64]
FORMAT = "cycloid-identification/1"

_ANGLES = 720  # of a crank turn that count as different: samples in step with it are closer than that
_ENOUGH = 1.5  # angles of the crank in all curves for each single displacement: with fewer a fit finds many minima
_WHOLE_TURN = 0.95  # of an output turn: curves of less do not see every pin with every tooth
_AT_BOUND = 1e-3  # of the bound: the last step ends so close beside it


@dataclass(frozen=True)
class Identification:
    """The result of a fit.

    Attributes
    ----------
    verdict
        Whether the errors explain the curves, and the most likely further causes.
    parameters
        All structured errors, fitted and held.
    realised
        Every pin and tooth of this ring, and its orders: structured errors and scatter together, without the gauge.
    effects
        The errors of this drive, the one with the largest effect on the transmission error first.
    bearings
        Of a drive with supports: each bearing's stiffness as a share of that in the pair file (unit "1"), and its
        clearance, m.
    coefficients
        Friction coefficients that [losses] has from a range: "flank.friction_coefficient" …, as of
        `fitting.loss_coefficients`.
    clock_lag
        Delay of the output angle (> 0) or of the input angle (< 0), s, if the curves show it.
    run_out
        Run-out of each shaft of the bench by its orders.
    bench
        {name: value} of the bench's nuisances: zeros and encoder eccentricity (rad), compliance of the chain in series
        with the gear pair (rad/(N·m)), friction torque, and that of loops (N·m).
    confirmed
        All structured errors and the bench's nuisances in SI: values, standard errors, correlations, and the possible
        range as bounds. Held ones do not vary; their standard error is that of the prior.
    surface
        The identified error surface, including the scatter of pins and teeth; without a covariance if the errors do not
        explain the curves.
    correlation
        Of the fitted parameters, in the order of `fitted`.
    singular_values, weak_combinations
        Of the Jacobian scaled by tolerance and noise (below 1 a combination is less known than before measuring), and
        the weak ones in words.
    noise, scatter
        Noise of a point (rad) and standard deviation of each scattered pattern (m).
    inflation
        Factor of the standard errors relative to white noise, because the residual is not white.
    residual
        rms of measured minus fitted transmission error, rad.
    outliers
        {source: points that were left out}.
    held_out
        Prediction of held-out curves by a fit of the others, or None with too few curves.
    fitted_curves
        Fitted transmission error of each curve, the bench's nuisances included, rad.
    loops
        The given loops.
    checksums
        {source: SHA-256} of the data.
    implausible
        {source: number of implausible samples that were left out}.
    other_descriptions
        {name: value} of the fitted errors with another disc as the first, if the curves do not exclude it: they give
        the same curves, and the standard errors are the same.
    notes
        Notes on the fit and the data.
    pair
        The nominal pair, with the identified bearings.
    first_stage
        Of a reducer, with its identified play; otherwise None.
    curves
        The fitted curves without the branches of loops; behind a first stage over the angle of ideal cranks.
    search
        The search for the best values, whose result is `lmfit`.
    posterior
        What the fit tells of the next one, whose prior it may be; None if the errors do not explain the curves, or the
        crank's zero is unknown.
    tolerances
        The tolerances of the drawing, if they were given.

    Examples
    --------
    An example is that of `fitting.identify`.
    """

    verdict: Verdict
    parameters: tuple[Parameter, ...]
    realised: Realised
    effects: tuple[Effect, ...]
    bearings: tuple[Parameter, ...]
    coefficients: tuple[Parameter, ...]
    clock_lag: Parameter | None
    run_out: tuple[RunOut, ...]
    bench: dict[str, float]
    confirmed: Mapping[str, Confirmed]
    surface: ErrorSurface
    correlation: Array
    singular_values: Array
    weak_combinations: tuple[str, ...]
    noise: float
    scatter: dict[str, float]
    inflation: float
    residual: float
    outliers: dict[str, int]
    held_out: HeldOut | None
    fitted_curves: tuple[Array, ...]
    loops: tuple[LoopFit, ...]
    checksums: dict[str, str]
    implausible: dict[str, int]
    other_descriptions: tuple[dict[str, float], ...]
    notes: tuple[str, ...]
    pair: Pair
    first_stage: FirstStage | None
    curves: tuple[Curve, ...]
    search: Search = field(repr=False, compare=False)
    posterior: Posterior | None = None
    tolerances: Tolerances | None = None

    @property
    def fitted(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(p.name for p in self.parameters if p.held is None)

    @property
    def lmfit(self) -> MinimizerResult:
        """The last search for the best values of errors, bench and bearings as lmfit's result.

        Its residual and covariance are in units of the noise and have a row for each prior, the scatter of pins and
        teeth is marginalised, and allowances for held errors and a form of the flanks are not part of its errors. If
        lmfit was not needed for the fit, the search starts where that ended; it moves values by a small share of their
        standard errors.
        """
        return self.search.result

    @cached_property
    def lmfit_parameters(self) -> Parameters:
        """`confirmed` as lmfit parameters."""
        return as_lmfit(self.confirmed)

    @property
    def drive(self) -> Drive:
        """The drive with the identified errors."""
        return Drive(self.pair, self.surface, self.first_stage)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the identification, `cycloid-identification/1`; never a partial file."""
        with edge.written_whole(path) as temporary:
            temporary.write_text(edge.json_text(as_json(self)), encoding="utf-8")


def inflation_of(residuals: Sequence[Array]) -> float:
    """Ratio of the standard error of a mean of these residuals to that of white noise of the same size.

    The square root of the integrated autocorrelation time, summed to the first lag that noise could make.
    """
    time, lag = 1.0, 1
    total = sum(float(r @ r) for r in residuals)
    count = sum(r.size for r in residuals)
    while lag < min(r.size for r in residuals) // 4:
        correlation = sum(float(r[lag:] @ r[:-lag]) for r in residuals) / total
        if correlation < 2.0 / np.sqrt(count):
            break
        time += 2.0 * correlation
        lag += 1
    return float(np.sqrt(time))


def result_of(
    fit: Estimate,
    verdict: Verdict,
    predicted: HeldOut | None,
    known: Mapping[str, float],
    profiled: Sequence[str],
    bootstrap: int,
    others: Sequence[Estimate],
    form: float,
    progress: Callable[[str], None],
) -> Identification:
    """Confirm a fit's optimum and return its result.

    Parameters
    ----------
    fit, verdict, predicted
        The end of the fit, whether it explains the curves, and the prediction of held-out curves.
    known, profiled, bootstrap, progress
        `scatter` and the others of `fitting.estimation.identify.identify`.
    others
        Fits of the same curves with another disc as the first.
    form
        Expected size of each order of a form that all flanks share, standard deviation, m: intervals allow for it.
    """
    pair = fit.pair
    if PIN_RADIUS not in known:
        fit = dataclasses.replace(fit, scatter={**fit.scatter, PIN_RADIUS: allowed_radius(fit)})
    names, chosen, spread = list(fit.observed.errors), list(fit.chosen), spread_of(pair, fit.scatter)
    whitened = fit.observed.weight * left_of(fit.observed, fit.linear, fit.state)
    each = np.split(whitened, fit.observed.ends)
    inflation = inflation_of([each[i] for i in fit.observed.running])
    observed = dataclasses.replace(fit.observed, weight=fit.observed.weight / inflation)
    progress("confirming the optimum")
    search, decided = Search(dataclasses.replace(fit, observed=observed)), observed.constraints
    if decided is None and not profiled:
        # Loading lmfit takes as much processor time as a third of a fit of six recordings.
        search = Search(confirmed(search.start, GAIN))
    optimum = search.start if decided is None and not profiled else search.end
    estimates, every = stated(optimum)
    fit = dataclasses.replace(optimum, observed=fit.observed)
    state, linear = fit.state, fit.linear
    fitted = np.concatenate([c.transmission_error for c in observed.curves]) - left_of(observed, linear, state)
    if bootstrap:
        progress("drawing turns")
        turns, white = turn_bootstrap(fit, bootstrap, seed=0)
        # What the turns' scatter adds to the noise that the covariance holds already.
        added = np.maximum(turns**2 - (inflation * white) ** 2, 0.0)
        every[np.diag_indices(len(chosen))] += added
    quantiles = stdtrit(freedom(fit, every, known), 0.5 + 0.5 * CONFIDENCE)
    singular, combinations, reasons, unfitted = weakness(pair, observed, linear, chosen)
    by_user = set() if decided is None else {*decided.held}
    unfitted = tuple(n for n in unfitted if n not in by_user)
    # Held errors that no fitted one represents may be as large as is usual; the intervals allow for it.
    moved_by = moved_by_held(fit, unfitted)
    every += moved_by @ moved_by.T
    unknowns = fit.unknowns
    before_scatter = slice(0, unknowns.scatter.start)
    table = with_covariance(estimates, every[before_scatter, before_scatter])
    held = [name for name in names if name not in chosen]
    for name, sigma in zip(held, tolerances_of(held, observed.profile), strict=True):
        table[name] = dataclasses.replace(estimates[name], stderr=0.0 if name in by_user else float(sigma))
    own = observed.bearing_names
    bench = {n: p.value for n, p in table.items() if n not in names and n not in own}
    bench[CHAIN] = _chain_compliance(observed, bench)
    deviations = np.array([table[n].stderr for n in own], dtype=float)
    if own:
        moved_by = moved_by_held(fit, [n for n in names if n not in (*chosen, *unfitted, *by_user)])
        deviations = np.hypot(deviations, np.linalg.norm(moved_by[unknowns.bearings], axis=1))
    of_drive = bearings_found(pair, observed, state.bearings, deviations)
    separation = separation_notes(unknowns.names, every, [p.name for p in of_drive if p.held is None])
    identified_pair = pair_with(pair, state.bearings, rounded=True)
    whole, own_rows = every, np.r_[unknowns.errors, unknowns.scatter]
    every = every[np.ix_(own_rows, own_rows)]
    covariance = every[: len(chosen), : len(chosen)]
    error = np.sqrt(np.diag(covariance))
    prior = unknowns.prior
    plain = with_scatter(state.surface, -state.scatter)
    lag = None
    if LAG_NAME in bench:
        lag = clock_lag_found(observed, linear, bench[LAG_NAME], float(table[LAG_NAME].stderr or 0.0))
    of_form = moved_by_form(fit, form) if form else np.zeros_like(whole)
    moved = dict(zip(chosen, np.sqrt(np.maximum(np.diag(of_form), 0.0)).tolist(), strict=False))
    parameters = []
    for name, tolerance in zip(names, tolerances_of(names, observed.profile), strict=True):
        if name in chosen:
            sigma, quantile = float(error[chosen.index(name)]), float(quantiles[chosen.index(name)])
            value = structured_value(plain, name)
            unknown = parameter(name, unit_of(name), value, sigma, float(tolerance), quantile=quantile)
            if name in profiled and estimates[name].expr is None:
                progress(f"profile of {name}")
                interval = search.interval(name, quantile * sigma, quantile**2)
                unknown = dataclasses.replace(unknown, interval=interval)
            unknown = allowing(unknown, float(moved[name]), float(tolerance))
        else:
            value, sigma = structured_value(prior, name), 0.0 if name in by_user else float(tolerance)
            why = "the given parameters hold it at this value" if name in by_user else reasons[name]
            unknown = parameter(name, unit_of(name), value, sigma, float(tolerance), why)
        parameters.append(unknown)
    ring = realised(DriveValue(pair, state.surface), chosen, every, spread)
    run_out = run_outs_of(observed, table)
    explained = verdict.state != "not explained"
    if not explained:
        run_out = tuple(wave.withheld() for wave in run_out)
        parameters, ring = [withheld(unknown) for unknown in parameters], ring.withheld()
        of_drive = [withheld(unknown) for unknown in of_drive]
        lag = withheld(lag) if lag else None
    verdict = with_run_out(verdict, run_out)
    earlier = () if observed.earlier is None else fitted_to(observed.earlier.drive.surface)
    surface = state.surface.replace(
        pair=identified_pair.nominal,
        origin="identified",
        covariance_of=(*chosen, *scatter_names(pair)) if explained else (),
        covariance=every if explained else None,
        attributes={"data": " ".join(dict.fromkeys([*earlier, *(c.checksum for c in observed.curves)]))},
    )
    stage = observed.first_stage
    stage = None if stage is None else with_play(stage, float(state.bearings[-1]))
    is_prior = explained and not observed.fit_crank
    posterior = _posterior(fit, Drive(identified_pair, surface, stage), whole + of_form) if is_prior else None
    used = (observed.weight > 0.0) & ~observed.of_loops
    parts = np.split(fitted, observed.ends)
    outliers = dict.fromkeys((c.source for c in observed.curves), 0)
    for curve, part in zip(observed.curves, np.split(observed.weight, observed.ends), strict=True):
        outliers[curve.source] += int(np.count_nonzero(part == 0.0))
    return Identification(
        verdict=verdict,
        parameters=tuple(parameters),
        realised=ring,
        effects=effects_of(pair, observed, linear, state, parameters, ring),
        bearings=tuple(unknown for unknown in of_drive if not is_coefficient(unknown.name)),
        coefficients=tuple(
            dataclasses.replace(unknown, name=key_of(unknown.name))
            for unknown in of_drive
            if is_coefficient(unknown.name)
        ),
        clock_lag=lag,
        run_out=run_out,
        bench=bench,
        confirmed=table,
        search=search,
        surface=surface,
        correlation=covariance / np.outer(error, error),
        singular_values=singular,
        weak_combinations=combinations,
        noise=float(np.sqrt(1.0 / np.mean((inflation * observed.weight[used]) ** 2))),
        scatter={n: fit.scatter[n] for n in estimated_parts(pair)},
        inflation=inflation,
        residual=float(np.sqrt(np.mean(left_of(observed, linear, state)[used] ** 2))),
        outliers=outliers,
        held_out=predicted,
        fitted_curves=tuple(parts[i] for i in observed.running),
        loops=_loops(identified_pair, fit, parts, every),
        checksums={c.source: c.checksum for c in observed.curves},
        implausible={c.source: c.implausible for c in observed.curves},
        other_descriptions=tuple(_structured(pair, other) for other in others),
        notes=(
            *((lag_note(lag),) if lag else ()),
            *_notes(pair, fit, verdict, run_out),
            *friction_notes(pair, observed.curves),
            *separation,
            *form_note(parameters, form),
            *tilt_notes(DriveValue(pair, state.surface)),
            *_of_discs(len(others)),
            *(_at_bound(n, estimates[n], decided) for n in chosen if _bounded(estimates[n])),
            *(f"{n} is held, so it has no profile: {reasons[n]}." for n in profiled if n not in chosen),
            *(
                f"{n} is tied to others, so it has no profile."
                for n in profiled
                if n in estimates and estimates[n].expr
            ),
            *dict.fromkeys(note for curve in observed.curves for note in curve.notes),
        ),
        pair=identified_pair,
        first_stage=stage,
        posterior=posterior,
        curves=tuple(observed.curves[i] for i in observed.running),
    )


def _posterior(fit: Estimate, drive: Drive, covariance: Array) -> Posterior:
    """Return the distribution of the unknowns that are the same in other recordings, from that of all, SI."""
    unknowns = fit.unknowns
    own = {*lasting(unknowns.names, mounted=False)}
    at = [i for i, name in enumerate(unknowns.names) if name in own]
    values = fit.vector * unknowns.scale
    values[unknowns.bearings] = 0.0
    bench = [n for n in unknowns.names[unknowns.nuisances] if n in own]
    scatter = unknowns.names[unknowns.scatter]
    plain = with_scatter(drive.surface.replace(covariance=None, covariance_of=()), -fit.state.scatter)
    return Posterior(
        drive, plain, tuple(fit.chosen), tuple(bench), tuple(scatter), values[at], covariance[np.ix_(at, at)]
    )


def _structured(pair: Pair, fit: Estimate) -> dict[str, float]:
    plain = with_scatter(fit.state.surface, -fit.state.scatter)
    return {name: structured_value(plain, name) for name in fit.chosen}


def _of_discs(others: int) -> list[str]:
    if others == 0:
        return []
    return [
        f"The curves do not determine which disc is the first: seen from another disc {others} other set"
        f"{'s' * (others > 1)} of errors make{'s' * (others == 1)} the same curves (other_descriptions in the file); "
        "the result is the one nearest to the pair file. State any known error of the parts there to decide."
    ]


def _bounded(parameter: Confirmed) -> bool:
    ends = [end for end in (parameter.min, parameter.max) if math.isfinite(end)]
    return any(abs(parameter.value - end) <= _AT_BOUND * abs(end) for end in ends)


def _at_bound(name: str, confirmed: Confirmed, decided: Constraints | None) -> str:
    ends = f"{name} ends at {confirmed.value * 1e3:.2g} {'mm' if unit_of(name) == 'm' else 'mrad'}, "
    if decided is not None and name in decided.bounds:
        return f"{ends}a bound of the given parameters."
    return f"{ends}as far as it can be; check counts per turn, directions and the pair file."


def _loops(pair: Pair, fit: Estimate, fitted: Sequence[Array], covariance: Array) -> tuple[LoopFit, ...]:
    """Each loop as measured and fitted, and its play with the standard error due to the errors."""
    observed, chosen, loops = fit.observed, list(fit.chosen), []
    stage = observed.first_stage
    if stage is not None:
        stage = with_play(stage, float(fit.state.bearings[-1]))
    branches = [i for i, c in enumerate(observed.curves) if c.branch]
    for source in dict.fromkeys(observed.curves[i].source for i in branches):
        own = [i for i in branches if observed.curves[i].source == source]
        crank = float(np.mean([observed.curves[i].input_angle.mean() for i in own]))
        play, by_error, each = play_of(DriveValue(pair, fit.state.surface), crank + fit.state.crank_offset, chosen)
        if stage is not None:
            s = share_of(stage, pair)
            play = s * (play + stage.bearing_play + stage.crank_play / pair.gear_teeth)
            by_error, each = s * by_error, s * each
        slope = np.concatenate([by_error, scatter_columns(pair, each)])
        loops.append(
            LoopFit(
                source,
                crank,
                {observed.curves[i].branch: observed.curves[i].torque_at_points for i in own},
                {observed.curves[i].branch: observed.curves[i].transmission_error for i in own},
                {observed.curves[i].branch: fitted[i] for i in own},
                play,
                float(np.sqrt(max(slope @ covariance @ slope, 0.0))),
            )
        )
    return tuple(loops)


def _ambiguity(pair: Pair, fit: Estimate) -> list[str]:
    """Return notes if the best of several minima may have been missed, and the number of samples that would decide."""
    notes = []
    if fit.disagreeing:
        notes.append(
            f"No two of {fit.disagreeing} starts ended in the same optimum; the best was taken, and a better one may "
            "have been missed: compare the residual with the encoders' noise, and record more samples a crank turn."
        )
    curves = [fit.observed.curves[i] for i in fit.observed.running]
    if is_uneven(fit):
        noises = fit.noises[fit.observed.running]
        notes.append(
            f"{curves[int(np.argmax(noises))].source}: its noise is {noises.max() * ARCSEC:.2f}″, the "
            f"others' {np.median(noises) * ARCSEC:.2f}″; if the bench has equal noise there, the fit has "
            "missed the best optimum and the intervals are too narrow."
        )
    unknown = sum(
        p.stop - p.start
        for n, p in scatter_parts(pair).items()
        if n in ("pin_radial", "pin_tangential") and fit.scatter[n] > NO_SCATTER
    )
    seen = sum(np.unique(np.rint(c.input_angle / (2.0 * np.pi) * _ANGLES) % _ANGLES).size for c in curves)
    if seen < _ENOUGH * unknown:
        notes.append(
            f"The curves contain {seen} crank angles in total, too few for the {unknown} displacements of single "
            f"pins: the fit may miss the best optimum; record at least "
            f"{math.ceil(_ENOUGH * unknown / len(curves))} samples a crank turn, not in step with it."
        )
    return notes


def _notes(pair: Pair, fit: Estimate, verdict: Verdict, run_out: Sequence[RunOut]) -> tuple[str, ...]:
    """Return notes on missing curves, and on an encoder that runs out by more than the gear."""
    notes = []
    running = fit.observed.running
    curves = [fit.observed.curves[i] for i in running]
    if fit.observed.fit_crank:
        notes.append(
            "The zero of the input angle is unknown (no index), so it is unknown which pin is number 0: numbers and "
            "angles of pins and teeth count from an unknown one."
        )
    sizes = np.array([abs(c.torque) for c in curves])
    if np.ptp(sizes) < SAME_LOAD * sizes.max():
        notes.append(
            f"There is one load only, {sizes.mean():.4g} N·m: compliance elsewhere cannot be separated from "
            "clearances; record a second one, ten times smaller."
        )
    if len({np.sign(c.torque) for c in curves}) == 1:
        notes.append(
            "All torques have one sign, so one side of the teeth was never loaded; record the other direction too."
        )
    if len({c.direction for c in curves}) == 1:
        notes.append(
            "The crank turned one way only, so friction and compliance cannot be separated; record the other direction."
        )
    for curve in curves:
        turns = float(np.ptp(curve.input_angle)) / (2.0 * np.pi * abs(curve.ratio))
        if turns < _WHOLE_TURN:
            notes.append(
                f"{curve.source}: it covers {turns:.2f} of an output turn; pins and teeth are resolved less well."
            )
    if verdict.state == "not explained":
        notes.append("Is this the drive of the pair file, and are counts per turn and directions right?")
        if indexed := [c.source for c in curves if c.known_index]:
            notes.append(
                f"Is the crank at pin 0 where the input angle of {edge.listed(dict.fromkeys(indexed))} is zero? "
                'If not, state zero_reference = "incremental" of [input_angle] in a mapping.'
            )
    if pair.supports is None and any({*SHIFTS} & {m.cause, *m.alike} for m in verdict.misfits):
        notes.append(
            "Supports are compliant or have play: state the drive's bearings in the pair file ([supports]); then they "
            "are part of the model, and their stiffness and clearance are identified."
        )
    notes += _ambiguity(pair, fit)
    gear = np.abs(fit.linear.model - fit.linear.model.mean()).max()
    for wave in run_out:
        if wave.order == 1 and wave.amplitude > gear:
            notes.append(
                f"Run-out of {wave.text} is more than the gear's effect in total: an encoder is mounted eccentrically, "
                "or the shafts are not aligned."
            )
    for curve, outliers in zip(
        fit.observed.curves, np.split(fit.observed.weight == 0.0, fit.observed.ends), strict=True
    ):
        if outliers.any():
            named = ", ".join(n for n in (curve.source, curve.branch) if n)
            notes.append(
                f"{named}: {np.count_nonzero(outliers)} of {outliers.size} points are outliers and were left out."
            )
    return tuple(notes)


def as_json(result: Identification) -> dict[str, Any]:
    """Return an identification as the content of a `cycloid-identification/1` file (SI)."""
    verdict = result.verdict
    return {
        "verdict": verdict.sentence,
        "format": FORMAT,
        "validation": {
            "state": verdict.state,
            "misfits": [dataclasses.asdict(m) for m in verdict.misfits],
            "noise": verdict.noise,
            "residual": verdict.residual,
            "failed": list(verdict.failed),
            "descriptions": verdict.descriptions,
            "disagreeing": verdict.disagreeing,
        },
        "drive": result.drive.hash,
        "pair": result.pair.nominal.text,
        "parameters": {p.name: parameter_as_json(p) for p in result.parameters},
        "other_descriptions": list(result.other_descriptions),
        "realised": {
            "gauge": list(GAUGE),
            "radius_lever": result.realised.radius_lever,
            "elements": {p.name: parameter_as_json(p) for p in result.realised.elements},
            "orders": {p.name: parameter_as_json(p) for p in result.realised.orders},
        },
        "effects": [effect_as_json(effect) for effect in result.effects],
        "run_out": [dataclasses.asdict(wave) for wave in result.run_out],
        **({"bearings": {p.name: parameter_as_json(p) for p in result.bearings}} if result.bearings else {}),
        **(
            {"coefficients": {p.name: parameter_as_json(p) for p in result.coefficients}} if result.coefficients else {}
        ),
        **({"clock_lag": parameter_as_json(result.clock_lag)} if result.clock_lag else {}),
        "bench": result.bench,
        "lmfit_parameters": lmfit_states(result.confirmed),
        "correlation": {"of": list(result.fitted), "matrix": result.correlation},
        "posterior": None if result.posterior is None else posterior_as_json(result.posterior),
        "singular_values": result.singular_values,
        "weak_combinations": list(result.weak_combinations),
        "noise": result.noise,
        "scatter": result.scatter,
        "inflation": result.inflation,
        "residual": result.residual,
        "outliers": result.outliers,
        "loops": {
            loop.source: {"crank_angle": loop.crank_angle, "play": loop.play, "standard_error": loop.standard_error}
            for loop in result.loops
        },
        "held_out": None if result.held_out is None else dataclasses.asdict(result.held_out),
        "data": result.checksums,
        "implausible": result.implausible,
        "notes": list(result.notes),
    }


def _chain_compliance(observed: Observations, bench: Mapping[str, float]) -> float:
    """Compliance in series with the gear pair, rad/(N·m): as a nuisance, and as a cause if it is softer than usual."""
    of = [i for i, n in enumerate(observed.bench_names) if n == CHAIN or n.startswith(f"{MISFIT}_compliance_")]
    if len(of) == 1:
        return bench[CHAIN]
    turned = observed.bench[:, of] @ [bench[observed.bench_names[i]] for i in of]
    torque = np.concatenate([c.torque_at_points for c in observed.curves])
    return float(turned @ torque / (torque @ torque)) if torque.any() else bench[CHAIN]


def read_lmfit_parameters(path: str | os.PathLike[str]) -> Parameters:
    """Read the errors and the bench of an identification file as lmfit parameters, SI.

    Raises
    ------
    edge.InputError
        If the file is not an identification, or its parameters are not those of lmfit.
    """
    data = edge.json_table(path, FORMAT, "identification")
    if "lmfit_parameters" not in data:
        raise edge.InputError(f"{path}: lmfit_parameters is missing; identify once more.")
    with edge.parsed_by_others(path, "lmfit_parameters are not as lmfit writes them"):
        return loaded(data["lmfit_parameters"]["params"])
