"""Fits from the prior, from the ends of other fits, and around them: where a fit starts and which errors it has."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import wave_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_of_pair
from fitting.estimation.fit import Estimate, fit
from fitting.estimation.result import is_uneven
from fitting.model.discs import other_descriptions
from fitting.model.identifiability import chosen_errors
from fitting.model.near_drive import NearDrive
from fitting.model.observations import (
    CHAIN,
    CREEP,
    MISFIT,
    NO_CREEP,
    PIN_RADIUS,
    Discrepancy,
    Linear,
    Observations,
    State,
    estimated_parts,
    left_of,
    linearisation_point,
    linearise,
    observations,
    scatter_between,
    spread_of,
    with_scatter,
)
from fitting.model.prior import Prior, tolerances_of
from fitting.model.unknowns import NO_SCATTER
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

_START_POINTS = 4000  # of all curves together, for the way from the prior
_MOST_STARTS, _START_EVALUATIONS = 24, 30
_SUSPECTS, _REACHES = 3, (1, 2, 4)  # pins that are put back, and with how many neighbours on either side
_AGREE = 0.01  # of the points: two starts agree where -2 log likelihood differs by less, the noise by 0.5 %
_CRANK_STARTS = (0.0, -0.25, 0.25, 0.5)  # pin pitches, where the crank's zero is not known
_STILL, _AS_WELL = 0.1, 1.05  # times the creep and the noise without a soft chain
_MISFIT = 2e-6  # rad: from where the size of a cause of misfit is estimated
_CHOICES = 3  # of errors to fit, which change where the state at which they are chosen does
# A fit ends where a step reduces the sum of squares in units of the noise by less than this: such a step moves one
# estimate by a standard error at most, or all of them by a tenth. The last step follows.
_START_GAIN, GAIN = 8.0, 1.0


def started(
    curves: Sequence[Curve], pair: Pair, known: Prior, progress: Callable[[str], None]
) -> tuple[Estimate, Prior, Estimate | None]:
    """A fit near the best one from the prior, and the prior with a soft chain if zeros creep that do not creep with it.

    Then the fit without one is returned as well. Not at once: a chain that may be soft can take the part of errors and
    of friction that are not found yet.
    """
    rough, _ = starting_estimate(pair, observed_with(curves, pair, known), None, False, progress)
    if known.soft_chain or not rough.scatter.get(CREEP, 0.0) > _MISFIT:
        return rough, known, None
    soft = dataclasses.replace(known, soft_chain=True)
    other, _ = starting_estimate(pair, observed_with(curves, pair, soft), None, False, progress)
    # Two unknowns in place of one for each recording are likelier even where this start fits a little worse.
    is_still = other.scatter[CREEP] < _STILL * rough.scatter[CREEP] and other.noise < _AS_WELL * rough.noise
    return (other, soft, rough) if is_still or other.unlikelihood < rough.unlikelihood else (rough, known, None)


def starting_estimate(
    pair: Pair, observed: Observations, start: Estimate | None, searched: bool, progress: Callable[[str], None]
) -> tuple[Estimate, Linear | None]:
    """A fit near the best one, and the exact model there if it was evaluated.

    It is the end of another fit, or the best of several starts on some of the points.

    The curves' corners cause further minima besides the best one. Fits from the prior and via the largest load alone
    rarely end in the same wrong one, so two that agree are enough if all curves are explained equally. Otherwise the
    pins with the largest residuals are reset to their prior, with their neighbours, as long as this improves the fit.
    """
    size = spread_of(pair, {}).size
    prior = surface_of_pair(pair)

    def zeroed(part: Observations, state: State, around: Sequence[NearDrive] | None) -> tuple[State, Linear]:
        """The state with the unknown zeros of these observations, and the model there."""
        state = dataclasses.replace(state, bench=np.zeros(part.bench.shape[1]))
        free = ~np.isfinite(part.bench_prior)
        linear = linearise(pair, part, state, around)
        state.bench[free] = np.linalg.lstsq(part.bench[:, free], left_of(part, linear, state), rcond=None)[0]
        return state, linear

    if start is not None and not searched:
        if len(start.observed.curves) != len(observed.curves):
            state, linear = zeroed(observed, start.state, None)
            return dataclasses.replace(start, state=state), linear
        known = dict(zip(start.observed.bench_names, start.state.bench, strict=True))
        state = dataclasses.replace(start.state, bench=np.array([known.get(n, 0.0) for n in observed.bench_names]))
        return dataclasses.replace(start, state=state), None
    few, fewer = observed.thinned(_START_POINTS), observed.thinned(_START_POINTS // 2)
    loads = np.array([0.0 if c.branch else abs(c.torque) for c in few.curves])
    high, all_of_them = np.flatnonzero(loads > 0.7 * loads.max()), np.arange(loads.size)
    # A scatter that grows from nothing as the data ask for it leads past most of the wrong minima.
    unknown = {**_first_sizes(observed), **_no_scatter(pair)}
    # Radii of single pins could absorb errors that are not found yet: in starts from the prior they scatter later.
    same_radius = {PIN_RADIUS: 1e-2 * NO_SCATTER} if start is None else {}
    pitch = 2.0 * np.pi / pair.pins if observed.fit_crank else 0.0

    def ended(
        part: Observations, state: State, scatter: Mapping[str, float], around: Sequence[NearDrive] | None
    ) -> Estimate | None:
        try:
            state, linear = zeroed(part, state, around)
            chosen = _chosen(part, linear, pair)
            one = fit(
                pair,
                part,
                chosen,
                state,
                scatter,
                gain=_START_GAIN,
                around=around,
                linear=linear,
                evaluations=_START_EVALUATIONS,
                known=same_radius,
            )
            return dataclasses.replace(one, scatter={**one.scatter, **dict.fromkeys(same_radius, NO_SCATTER)})
        except edge.InputError:
            # To first order a fit may end where no contacts balance the load.
            return None
        except np.linalg.LinAlgError as problem:
            # Creep may grow into what wind-up does.
            singular.append(problem)
            return None

    def take(one: Estimate | None) -> None:
        found.extend([] if one is None else [one])

    # To first order from the prior, and from there once more; a crank whose zero is unknown and discs that float need
    # the exact model.
    exact = observed.fit_crank or pair.supports is not None or observed.first_stage is not None
    nominal = None if exact else linearisation_point(pair, prior, fewer)
    found: list[Estimate] = []
    singular: list[np.linalg.LinAlgError] = []

    def around(surface: ErrorSurface) -> Sequence[NearDrive] | None:
        try:
            return None if nominal is None else linearisation_point(pair, surface, few)
        except edge.InputError:
            return None

    def agree() -> bool:
        """Put the best first; return whether the next one ended there too."""
        found.sort(key=lambda e: e.unlikelihood)
        return len(found) > 1 and found[1].unlikelihood < found[0].unlikelihood + _AGREE * few.measured.size

    cranks = _CRANK_STARTS if observed.fit_crank else (0.0, 0.0)
    alike = False
    for number, crank in enumerate(() if start else cranks):
        state = State(prior, np.zeros(size), np.empty(0), crank * pitch)
        part = high if number == 1 else all_of_them
        progress(f"finding a start ({len(found) + 1})")
        one = ended(fewer.some(part), state, unknown, None if nominal is None else tuple(nominal[n] for n in part))
        # At one load creep, wind-up and play are the same: their sizes there say nothing.
        bench = {n: unknown[n] for n in few.estimated}
        on = None if one is None else ended(few, one.state, {**one.scatter, **bench}, around(one.state.surface))
        take(on or ended(few, state, unknown, None))
        alike = agree() and not is_uneven(found[0])
        if alike:
            break
    if start is not None:
        take(ended(few, start.state, start.scatter, around(start.state.surface)))
    if not found and singular:
        raise singular[0]
    if not found:
        raise edge.InputError(
            "no errors were found with which the pair's contacts carry the loads of these curves; check counts per "
            "turn, directions and the pair file."
        )
    for order in (1, 3) if pair.discs == 2 else ():
        # The curves of two discs depend on products of odd orders around the ring only: each pair may be found negated.
        progress(f"finding a start ({len(found) + 1})")
        state = _negated(pair, found[0].state, order, found[0].chosen)
        take(ended(few, state, unknown, around(found[0].state.surface)))
        agree()
    # On bearings another disc as the first makes nearly the same curves: a minimum beside the best one.
    for surface in other_descriptions(pair, found[0].state.surface) if pair.supports is not None else ():
        progress(f"finding a start ({len(found) + 1})")
        take(ended(few, described_by(pair, found[0], surface), found[0].scatter, None))
        agree()
    # In a minimum beside the best one neighbouring pins are wrong in opposite ways; the residual is largest there.
    searching = not alike
    while searching and len(found) < _MOST_STARTS:
        best, searching = found[0], False
        near = around(best.state.surface)
        for pin, reach in itertools.product(_suspects(pair, best), _REACHES):
            progress(f"finding a start ({len(found) + 1})")
            one = ended(few, _put_back(pair, best.state, pin, reach), best.scatter, near)
            take(one)
            if one is not None and one.unlikelihood < best.unlikelihood - _AGREE * few.measured.size:
                searching = True
                break
        alike = agree()
    return dataclasses.replace(found[0], disagreeing=0 if alike else len(found)), None


def _suspects(pair: Pair, fit: Estimate) -> list[int]:
    """Places in a scatter vector of the pins with the largest residuals, the worst first."""
    left = fit.observed.weight * left_of(fit.observed, fit.linear, fit.state)
    share = fit.linear.scatter[:, : pair.pins] ** 2 + fit.linear.scatter[:, pair.pins : 2 * pair.pins] ** 2
    worst = (left**2 @ share) / np.maximum(share.sum(axis=0), 1e-300)
    return [int(i) for i in np.argsort(-worst)[:_SUSPECTS]]


def described_by(pair: Pair, found: Estimate, surface: ErrorSurface) -> State:
    """The state of a fit with the errors of a surface."""
    values = {n: structured_value(surface, n) for n in found.chosen}
    plain = with_structured(surface_of_pair(pair), values)
    scatter = scatter_between(surface, plain)
    return dataclasses.replace(found.state, surface=with_scatter(plain, scatter), scatter=scatter)


def _negated(pair: Pair, state: State, order: int, chosen: Sequence[str]) -> State:
    """A state with the opposite sign of the errors of one order around the ring, without scatter."""
    plain = with_scatter(state.surface, -state.scatter)
    waves = {n: wave_of(n) for n in chosen}
    of_order = [
        name
        for name, wave in waves.items()
        if (wave and wave[0].of == "pin" and wave[1] == order) or (order == 1 and name.startswith("centre_distance"))
    ]
    values = {n: structured_value(plain, n) for n in chosen}
    values |= {n: -values[n] for n in of_order}
    surface = with_structured(surface_of_pair(pair), values)
    return dataclasses.replace(state, surface=surface, scatter=np.zeros_like(state.scatter))


def _put_back(pair: Pair, state: State, pin: int, reach: int) -> State:
    """A state in which a pin and its neighbours have no scatter."""
    window = np.mod(np.arange(pin - reach, pin + reach + 1), pair.pins)
    scatter = state.scatter.copy()
    scatter[np.concatenate([window, window + pair.pins])] = 0.0
    surface = with_scatter(state.surface, scatter - state.scatter)
    return dataclasses.replace(state, surface=surface, scatter=scatter)


def observed_with(curves: Sequence[Curve], pair: Pair, known: Prior) -> Observations:
    """Return the observations of curves, with the unknowns that a prior asks for."""
    return observations(
        curves,
        pair,
        profile=known.profile,
        first_stage=known.first_stage,
        soft_chain=known.soft_chain,
        constraints=known.constraints,
    )


def _first_sizes(observed: Observations) -> dict[str, float]:
    """Sizes from which those of the bench's groups are estimated: rad, of the chain rad/(N·m)."""
    return {group: observed.chain_prior if group == CHAIN else _MISFIT for group in observed.estimated}


def _no_scatter(pair: Pair) -> dict[str, float]:
    return {**dict.fromkeys(estimated_parts(pair), NO_SCATTER), CREEP: NO_CREEP}


def without_scatter(pair: Pair, found: Estimate) -> Estimate:
    """The same, starting again with zero scatter of pins and teeth."""
    surface = with_scatter(found.state.surface, -found.state.scatter)
    state = dataclasses.replace(found.state, surface=surface, scatter=np.zeros_like(found.state.scatter))
    sizes = {n: v for n, v in found.scatter.items() if n.startswith(MISFIT)}
    return dataclasses.replace(found, state=state, scatter={**_no_scatter(pair), **sizes})


def fitted(
    curves: Sequence[Curve],
    pair: Pair,
    start: Estimate | None,
    known: Prior,
    progress: Callable[[str], None],
    misfit: Discrepancy | None = None,
    searched: bool = False,
    chosen: Sequence[str] | None = None,
) -> Estimate:
    """Fit curves from the end of another fit, or `searched` around it for a better minimum, or from the prior.

    Parameters
    ----------
    curves, pair, known
        The curves, the nominal pair, and the prior.
    start
        The other fit, of the same curves or of others; None: from the prior.
    progress
        Is told what is done.
    misfit
        Causes of misfit beside the errors.
    searched
        Whether minima near the other fit are tried as well.
    chosen
        The errors to fit; None: those that the curves resolve.

    Raises
    ------
    edge.InputError
        If no contacts balance the loads, or the curves resolve none of the errors.
    numpy.linalg.LinAlgError
        If the equations are singular.
    """
    observed = observed_with(curves, pair, known)
    if misfit is not None:
        observed = observed.with_misfit(misfit)
    rough, linear = starting_estimate(pair, observed, start, searched, progress)
    state, scatter = rough.state, {**_first_sizes(observed), **rough.scatter}
    weight = observed.weight * np.median(rough.observed.weight) / np.median(observed.weight)
    observed = dataclasses.replace(observed, weight=weight).with_sizes(scatter)
    rough = dataclasses.replace(rough, state=state, scatter=scatter)
    if chosen is None:
        estimate = _settled(pair, observed, rough, linear, known, progress)
    else:
        estimate = fit(pair, observed, chosen, state, scatter, gain=GAIN, linear=linear, known=known.scatter)
    return dataclasses.replace(estimate, disagreeing=rough.disagreeing)


def _settled(
    pair: Pair,
    observed: Observations,
    start: Estimate,
    linear: Linear | None,
    known: Prior,
    progress: Callable[[str], None],
) -> Estimate:
    """Fit from a start, until the errors chosen at its end are those that were fitted.

    `linear` is the model at the start, if known.
    """
    state, scatter, before = start.state, start.scatter, list(start.chosen)
    linear = linearise(pair, observed, state) if linear is None else linear
    chosen = _chosen(observed, linear, pair)
    for _ in range(_CHOICES):
        carried = _carried_over(pair, observed, linear, state, before, chosen)
        progress(f"fitting {len(chosen)} errors and the scatter of pins and teeth")
        there = linear if carried is state else None
        estimate = fit(pair, observed, chosen, carried, scatter, gain=GAIN, linear=there, known=known.scatter)
        state, scatter, linear, before = estimate.state, estimate.scatter, estimate.linear, chosen
        chosen = _chosen(estimate.observed, linear, pair)
        if chosen == before:
            break
    return estimate


def _carried_over(
    pair: Pair, observed: Observations, linear: Linear, state: State, before: Sequence[str], chosen: Sequence[str]
) -> State:
    """A state in which the effect of errors that are no longer fitted is replaced by others."""
    dropped = [n for n in before if n not in chosen]
    if not dropped:
        return state
    at, prior = observed.errors.index, surface_of_pair(pair)
    plain = with_scatter(state.surface, -state.scatter)
    excess = {n: structured_value(plain, n) - structured_value(prior, n) for n in dropped}
    size = tolerances_of(chosen, observed.profile)
    columns = np.hstack([linear.structured[:, [at(n) for n in chosen]] * size, observed.bench])
    lost = sum(linear.structured[:, at(n)] * value for n, value in excess.items())
    weight = observed.weight[:, None]
    share = np.linalg.lstsq(weight * columns, observed.weight * lost, rcond=1e-6)[0]
    values = {n: structured_value(plain, n) + d for n, d in zip(chosen, size * share[: size.size], strict=True)}
    values |= {n: structured_value(prior, n) for n in dropped}
    plain = with_structured(plain, values)
    return dataclasses.replace(
        state, surface=with_scatter(plain, state.scatter), bench=state.bench + share[size.size :]
    )


def _chosen(observed: Observations, linear: Linear, pair: Pair) -> list[str]:
    # Without the scatter of single pins and teeth, which widens the intervals: a scatter that has absorbed held errors
    # would keep them held, and fitted errors of nearly the same effect would absorb the rest.
    chosen, decided = chosen_errors(pair, observed, linear, {}), observed.constraints
    if decided is not None:
        own = {*decided.free, *decided.ties}
        chosen = [n for n in observed.errors if n in own or (n in chosen and n not in decided.held)]
    if not chosen:
        raise edge.InputError("the data resolve none of the structured errors; record more loads or more turns.")
    return chosen
