"""From recordings to the drive's errors: the search for the best fit; `fitting.estimation.result` reports it.

The structured errors that the data resolve are fitted with the exact contact model and its analytic Jacobian;
`confirmation` takes the last step and gives the covariance. The deviations of single pins and teeth beyond them are a
random scatter of unknown size: it is estimated together with the noise (restricted maximum likelihood) and is part of
the fit, so it neither biases the structured errors nor makes their intervals too small.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.sampling import Tolerances, read_tolerances
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import DEVIATIONS, surface_of_pair
from fitting.arguments import positive
from fitting.estimation.continuation import earlier_of, identified, refuse_with_prior
from fitting.estimation.explanation import GAIN, Explained, Explanation, observed_with
from fitting.estimation.fit import TURNS, Estimate, fit
from fitting.estimation.held_out import Prediction, is_mispredicted, kept_back
from fitting.estimation.minimisation import default_parameters, names_of
from fitting.estimation.result import Identification, result_of
from fitting.estimation.starts import descriptions
from fitting.estimation.validation import HeldOut, mispredicted
from fitting.model.constraints import Constraints, checked
from fitting.model.gaussian import equations
from fitting.model.loops import observed_curves, on_the_curves_zero
from fitting.model.observations import errors_of
from fitting.model.posterior import Posterior
from fitting.model.prior import Prior, prior_of, tolerances_of
from fitting.readers.sources import Source
from fitting.transmission_error.curve import Curve

if TYPE_CHECKING:
    from lmfit import Parameters

Array = NDArray[np.float64]

_FEWEST_DRAWS = 20  # of turns: their standard deviation is then known to 16 %
_OVERLOAD = 10.0  # times the rated torque: no bench loads a drive so, a wrong unit does
_EXCLUDED = 10.0  # of -2 log likelihood: a description that is less likely by more is excluded, 150 to 1


def identify(
    recordings: Source | Curve | Iterable[Source | Curve],
    drive: Drive,
    *,
    tolerances: Tolerances | Prior | str | os.PathLike[str] | None = None,
    profiled: Sequence[str] = (),
    bootstrap: int = 0,
    held_out: bool = True,
    form: float | str = "1 um",
    parameters: Parameters | None = None,
    prior: Posterior | Identification | Drive | str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Identification:
    """Identify a drive's errors from recordings at one or more loads, one or both directions.

    Recordings with the input at rest are taken as hysteresis loops: they separate play from friction.

    Parameters
    ----------
    recordings
        Result of `fitting.read_recordings`, `fitting.Run`, or curves made from them. A recording that states the
        fingerprint of a drive as its `pair` must be of this drive, or of its nominal pair.
    drive
        The nominal drive; its stated errors are the prior and start.
    tolerances
        The drive's tolerances, their file or a prior: they give the scatter of pins and teeth, and the form that all
        teeth share is fitted as far as the data resolve it.
    profiled
        Errors whose intervals are found by their profile rather than by their standard error.
    bootstrap
        Number of bootstrap resamples of output turns, whose scatter widens the standard errors if it is more than white
        noise; 0 for none, otherwise at least 20.
    held_out
        Whether a load or direction is first kept from the fit and predicted.
    form
        Expected size of a form that all flanks share, standard deviation of each of its first four half waves, m. It is
        fitted if the curves show one; otherwise errors that the curves can't separate from it have intervals that allow
        for it. 0 if the flanks' form is known; a form in the tolerances is always fitted.
    parameters
        Decisions on errors, bench and bearings, SI, made from those of `fitting.parameters`: `vary=False` holds one at
        its value, `min` and `max` bound it, `expr` ties it to others, `vary=True` fits an error even if the data do not
        resolve it. Of all that they do not name the fit decides. The search ends with lmfit's `Minimizer`.
    prior
        A fit of this drive, or its file, from whose posterior this one goes on: its errors, pins and teeth, bearings
        and compliance of the chain have its distribution in place of the usual priors. Zeros, drift, friction and
        run-out of encoders, which may have been mounted again, are unknown as before. There is no search for other
        minima, no curve is held out, and no cause is fitted beside the errors. Also `Recalibration.posterior`, or a
        drive whose surface has a covariance, which does not allow for a form of the flanks.
    progress
        Called with the name of each stage.

    Raises
    ------
    edge.InputError
        If a recording can't be read, is of another drive or has no load, an argument is invalid, `prior` is of another
        drive or no prior, `parameters` name what is not an unknown, the data resolve no error, or there are too few
        turns to draw from.

    Examples
    --------
    A drive of 9 teeth whose eccentricity is 3 µm too large, measured at two loads in both directions:

    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> drive = cy.Drive(pair)
    >>> made, angle = drive.replace(errors={"eccentricity": "3 um"}), np.linspace(0.0, 2.0 * np.pi * 9, 120)
    >>> noise = np.random.default_rng(0)
    >>> def run(load):
    ...     error = made.analyze(load, crank_angle=angle).transmission_error.values[0]
    ...     output = angle / -9 + error + noise.normal(0.0, 1e-6, angle.size)
    ...     return fitting.Run(input_angle=angle, output_angle=output, torque=load, common_zero=True, known_index=True)
    >>> result = fitting.identify([run(load) for load in (20.0, -20.0, 100.0, -100.0)], drive, held_out=False)
    >>> round(next(p for p in result.parameters if p.name == "eccentricity").value * 1e6, 1)
    3.0
    >>> result.drive.surface.eccentricity == result.surface.eccentricity
    True
    """
    pair, shape = drive.pair, positive(form, "m", "form", zero=True)
    progress("reading")
    running, loops = _measured(recordings, drive, keep_turns=bootstrap > 0)
    curves = [*running, *loops]
    if isinstance(tolerances, str | os.PathLike):
        tolerances = read_tolerances(tolerances)
    usual, beside = _prior(drive, tolerances), []
    if pair.supports is not None and usual.profile:
        shape = max(usual.profile.values())
        usual = dataclasses.replace(usual, profile={})
        beside.append(
            f"On bearings the form of the flanks is not fitted: the intervals allow for {shape * 1e6:.2g} µm."
        )
    _check(curves, bootstrap, profiled, [*errors_of(pair), *usual.profile])
    if prior is not None:
        refuse_with_prior(tolerances=tolerances, parameters=parameters)
        return identified(curves, earlier_of(prior, drive), drive.pair, profiled, bootstrap, shape, progress)
    if parameters is not None:
        checked(parameters, names_of(pair, observed_with(curves, pair, usual)))
        usual = dataclasses.replace(usual, constraints=Constraints.of(parameters))
        pair = _stating(pair, {n: p.value for n, p in parameters.items() if n in errors_of(pair)})
    shape = 0.0 if usual.profile else shape
    with equations():
        # The model on bearings fits no form: intervals allow for it, and the verdict does not name it.
        cause = 0.0 if pair.supports is not None else shape
        prediction = Prediction(pair, running, loops, kept_back(running) if held_out else (), progress)
        explained, predicted = _explained(prediction, usual, cause)
        estimate, others = _described_otherwise(explained, progress)
        verdict = dataclasses.replace(explained.verdict, descriptions=1 + len(others), disagreeing=estimate.disagreeing)
        shape = 0.0 if estimate.observed.profile else shape
        result = result_of(estimate, verdict, predicted, usual.scatter, profiled, bootstrap, others, shape, progress)
    beside += _form_notes(drive)
    stated = tolerances if isinstance(tolerances, Tolerances) else None
    return dataclasses.replace(result, notes=(*result.notes, *beside), tolerances=stated)


def _form_notes(drive: Drive) -> list[str]:
    """Return a note on form of single elements, which is not part of a fit."""
    single = [name for name in DEVIATIONS if getattr(drive.surface, name) is not None]
    if not single:
        return []
    return [f"The drive's surface holds form of single elements ({', '.join(single)}); it is not part of the fit."]


def parameters(
    recordings: Source | Curve | Iterable[Source | Curve],
    drive: Drive,
    *,
    tolerances: Tolerances | Prior | str | os.PathLike[str] | None = None,
) -> Parameters:
    """Return the unknowns of an identification as lmfit parameters, SI, to be changed and given to `identify`.

    They are the errors, the bench and the bearings, at the values of the drive, with the bounds of a possible gear
    pair. Those errors vary that the recordings resolve near this drive.

    Parameters
    ----------
    recordings, drive, tolerances
        As for `identify`.

    Raises
    ------
    edge.InputError
        As of `identify`.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting, numpy as np
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 9, 120)
    >>> def run(load):
    ...     error = cy.Drive(pair).analyze(load, crank_angle=angle).transmission_error.values[0]
    ...     return fitting.Run(input_angle=angle, output_angle=angle / -9 + error, torque=load, known_index=True)
    >>> given = fitting.parameters([run(load) for load in (20.0, -20.0)], cy.Drive(pair))
    >>> given["pin_radius"].vary, given["isometric"].vary, float(round(given["pin_radius"].max, 6))
    (True, False, 0.001)
    """
    running, loops = _measured(recordings, drive)
    if isinstance(tolerances, str | os.PathLike):
        tolerances = read_tolerances(tolerances)
    pair, prior = drive.pair, _prior(drive, tolerances)
    observed = observed_with([*running, *loops], pair, prior)
    return default_parameters(pair, observed)


def _prior(drive: Drive, tolerances: Tolerances | Prior | None) -> Prior:
    prior = prior_of(drive.pair, tolerances) if isinstance(tolerances, Tolerances) else tolerances or Prior()
    return dataclasses.replace(prior, first_stage=drive.first_stage)


def _measured(
    recordings: Source | Curve | Iterable[Source | Curve], drive: Drive, keep_turns: bool = False
) -> tuple[list[Curve], list[Curve]]:
    """Curves of a turning crank, and the branches of loops."""
    pair, curves = drive.pair, observed_curves(recordings, drive, keep_turns=keep_turns)
    running = [c for c in curves if not c.branch]
    if not running:
        raise edge.InputError(
            "there is no transmission error curve: a loop sees the drive at one crank angle only; give recordings of a "
            "turning crank too."
        )
    loops = on_the_curves_zero([c for c in curves if c.branch], running)
    for curve in (*running, *loops):
        if abs(curve.ratio / pair.ratio - 1.0) > 1e-9:
            raise edge.InputError(
                f"{curve.source}: its ratio is {curve.ratio:g}, the pair's {pair.ratio:g}; it is of another drive."
            )
    for curve in running:
        if abs(curve.torque) < 1e-3 * max(abs(c.torque) for c in running) or curve.torque == 0.0:
            raise edge.InputError(
                f"{curve.source}: the mean torque is {curve.torque:g} N·m; the fit needs loaded curves."
            )
        times = abs(curve.torque) / (pair.rated_torque or np.inf)
        if times > _OVERLOAD:
            raise edge.InputError(
                f"{curve.source}: the mean torque is {curve.torque:g} N·m, {times:.3g} "
                f"times the rated torque of the pair, {pair.rated_torque:g} N·m; check its unit, such as N*mm."
            )
    return running, loops


def _stating(pair: Pair, values: Mapping[str, float]) -> Pair:
    """A pair with these structured errors, which are then its stated ones: the prior and start of a fit."""
    surface = surface_of_pair(pair)
    changed = {n: v for n, v in values.items() if v != structured_value(surface, n)}
    stated = with_structured(surface, changed)
    own = {name for name in stated.errors if not np.array_equal(stated.errors[name], surface.errors[name])}
    return pair.replace(errors={KINDS[name].file_key: stated.errors[name] for name in own}) if own else pair


def _explained(prediction: Prediction, prior: Prior, form: float) -> tuple[Explained, HeldOut | None]:
    """The best explanation of all curves, and the prediction of those that are held out."""
    start, predicted = prediction.start(prior) if prediction.numbers else (None, None)
    curves = [*prediction.running, *prediction.loops]
    explained = Explanation(curves, prediction.pair, prior, prediction.progress, form, start).explain()
    if predicted is not None and explained.verdict.state != "not explained" and is_mispredicted(predicted):
        # The first fit had no causes, and may have ended beside its best optimum, which the whole one has found.
        predicted = prediction.again(explained)
        if is_mispredicted(predicted):
            explained = dataclasses.replace(explained, verdict=mispredicted(explained.verdict, predicted))
    return explained, predicted


def _described_otherwise(
    explained: Explained, progress: Callable[[str], None]
) -> tuple[Estimate, tuple[Estimate, ...]]:
    """The same drive with each disc as the first: the description to report, and others that the curves do not exclude.

    Descriptions give the same curves; only the prior separates them. The one nearest to the errors of the pair file is
    reported.
    """
    end, known = explained.estimate, explained.hypothesis.prior.scatter
    pair, every = end.pair, [end]
    # On bearings the positions of the cranks distinguish the discs.
    for state in () if pair.supports is not None else descriptions(pair, end):
        progress("describing the drive from another disc")
        every.append(fit(pair, end.observed, end.chosen, state, end.scatter, gain=GAIN, known=known))
    least = min(each.unlikelihood for each in every)
    every = [each for each in every if each.unlikelihood - least < _EXCLUDED]
    sizes, stated = tolerances_of(end.chosen, end.observed.profile), surface_of_pair(pair)

    def distance(estimate: Estimate) -> float:
        surface = estimate.state.surface
        off = np.array([structured_value(surface, n) - structured_value(stated, n) for n in end.chosen])
        return round(float(np.sum((off / sizes) ** 2)), 1)

    first, *others = sorted(every, key=distance)
    return dataclasses.replace(first, disagreeing=end.disagreeing), tuple(others)


def _check(curves: Sequence[Curve], bootstrap: int, profiled: Sequence[str], errors: Sequence[str]) -> None:
    """Refuse a bootstrap of too few draws or turns, and profiles of what is no error."""
    if bootstrap < 0 or 0 < bootstrap < _FEWEST_DRAWS:
        rule = f"it must be 0, for none, or at least {_FEWEST_DRAWS}: fewer draws do not tell a standard deviation"
        raise edge.ArgumentError("bootstrap", rule, bootstrap)
    for curve in curves if bootstrap else ():
        turns = 0 if curve.each_turn is None else len(curve.each_turn)
        if turns < TURNS and not curve.branch:
            raise edge.InputError(
                f"{curve.source}: it has {turns} output turns; at least {TURNS} are needed to draw turns again."
            )
    for name in profiled:
        if name not in errors:
            near = edge.did_you_mean(name, errors) or f"give one of {', '.join(errors)}"
            raise edge.ArgumentError("profiled", f"it is not an error of this drive; {near}", name)
