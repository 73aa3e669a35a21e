"""Where a fit of all points starts: the best of fits of some points, from many places.

The curves' corners, where pins come into contact, cause further minima besides the best one. Each kind of proposal
yields places from which the minimum of those before would not be reached again. Fits of them use a model to first order
in the errors, a tenth of the work, where that is possible.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import wave_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_of_pair
from fitting.estimation.fit import Estimate, fit
from fitting.estimation.search import NO_FIT, Proposals, Search
from fitting.model.discs import other_descriptions
from fitting.model.identifiability import chosen_of
from fitting.model.near_drive import NearDrive
from fitting.model.observations import (
    CHAIN,
    CREEP,
    NO_CREEP,
    PIN_RADIUS,
    Linear,
    Observations,
    State,
    estimated_parts,
    left_of,
    linearisation_point,
    linearise,
    scatter_between,
    spread_of,
    with_scatter,
)
from fitting.model.unknowns import NO_SCATTER

Array = NDArray[np.float64]

_POINTS = 4000  # of all curves together: more change the minimum that is found by less than the fit of all of them does
_EVALUATIONS = 30  # of one fit of them, which needs ten to twenty
_GAIN = 8.0  # of the sum of squares in units of the noise, by whose predicted decrease it ends
_MOST = 24  # fits of them, of which 2 to 5 are usual
_AGREE = 0.01  # of the points: two fits agree whose -2 log likelihood differs by less, the noise by 0.5 %
_QUARTERS = 0.0, -0.25, 0.25, 0.5  # pin pitches: a fit leads to the crank's zero from a quarter of one away
_HIGH_LOAD = 0.7  # of the largest load: at high loads many pins carry, so that corners are few
_WORST_PINS, _NEIGHBOURS = 3, (1, 2, 4)  # pins that are put back, and with how many on either side
_UNEVEN = 1.3  # times the median of the curves' noises: more of one is a minimum beside the best
FIRST_SIZE = 2e-6  # rad: of creep and of causes of misfit, from which their sizes are estimated; 0.4″, a usual noise


@dataclass(frozen=True)
class Start:
    """A place from which to fit.

    Attributes
    ----------
    state, sizes
        The unknowns, and the standard deviations of the scatter and of the bench's groups, SI.
    first
        Curves that are fitted first, by themselves and about the nominal drive; None: all of them at once.
    """

    state: State
    sizes: Mapping[str, float]
    first: Sequence[int] | NDArray[np.int64] | None = None


class Multistart(Search[Start, Estimate]):
    """The search for a place from which to fit all points.

    Parameters
    ----------
    pair, observed
        The nominal pair and the observations.
    origin
        The end of another fit near which it is searched; None: near the drive of the pair file.
    progress
        Called with what is done.
    """

    def __init__(
        self, pair: Pair, observed: Observations, origin: Estimate | None, progress: Callable[[str], None]
    ) -> None:
        super().__init__()
        self.pair, self.origin, self.progress = pair, origin, progress
        self.few, self._half = observed.thinned(_POINTS), observed.thinned(_POINTS // 2)
        # A scatter that grows from nothing as the data ask for it leads past most of the wrong minima.
        self.sizes = {**first_sizes(observed), **no_scatter(pair)}
        # Radii of single pins could absorb errors that are not found yet: from the prior they scatter later.
        self._same_radius = {PIN_RADIUS: 1e-2 * NO_SCATTER} if origin is None else {}
        # A crank whose zero is unknown and discs that float need the exact model.
        self._is_exact = observed.fit_crank or pair.supports is not None or observed.first_stage is not None
        self._near: tuple[Estimate, Sequence[NearDrive] | None] | None = None
        self.is_settled = False  # whether two starts from the prior agree

    def estimate(self) -> Estimate:
        """Return the best end of all.

        Raises
        ------
        edge.InputError
            If from no start errors are found with which the contacts carry the loads.
        numpy.linalg.LinAlgError
            If the equations are singular.
        """
        self.run([_from_the_prior, _from_the_origin])
        if not self.ends and not isinstance(self.problem, np.linalg.LinAlgError):
            raise edge.InputError(
                "no errors were found with which the pair's contacts carry the loads of these curves; check counts per "
                "turn, directions and the pair file."
            )
        self.run([_mirrored, _from_another_disc, _with_pins_put_back])
        is_alike = self.is_settled or self.is_agreed
        return dataclasses.replace(self.best, disagreeing=0 if is_alike else len(self.ends))

    @property
    def is_agreed(self) -> bool:
        """Whether the two best ends are the same optimum."""
        best = sorted(end.unlikelihood for end in self.ends)
        return len(best) > 1 and best[1] < best[0] + _AGREE * self.few.measured.size

    def is_better(self, end: Estimate, best: Estimate) -> bool:
        """Whether an end is likelier."""
        return end.unlikelihood < best.unlikelihood

    def fit(self, start: Start) -> Estimate:
        """Fit some of the points from a start."""
        self.progress(f"finding a start ({len(self.ends) + 1})")
        if start.first is None:
            return self._ended(self.few, start, self._about(self.best if self.ends else self.origin))
        half = self._half.some(start.first)
        try:
            # To first order about the nominal drive with half of the points, then about where that ends with all.
            end = self._ended(half, start, self._about_nominal(half))
            # At one load creep, wind-up and play are the same: their sizes there say nothing.
            sizes = {**end.scatter, **{name: self.sizes[name] for name in self.few.estimated}}
            return self._ended(self.few, Start(end.state, sizes), self._about(end))
        except NO_FIT:
            return self._ended(self.few, start, None)

    def _about_nominal(self, part: Observations) -> Sequence[NearDrive] | None:
        return None if self._is_exact else linearisation_point(self.pair, surface_of_pair(self.pair), part)

    def _about(self, estimate: Estimate | None) -> Sequence[NearDrive] | None:
        """The drive of a fit, about which the model is linearised; None for the exact model."""
        if self._is_exact or estimate is None:
            return None
        if self._near is None or self._near[0] is not estimate:
            try:
                self._near = estimate, linearisation_point(self.pair, estimate.state.surface, self.few)
            except edge.InputError:
                self._near = estimate, None
        return self._near[1]

    def _ended(self, part: Observations, start: Start, around: Sequence[NearDrive] | None) -> Estimate:
        near = self.best.linear if self.ends and part is self.few else None
        state, linear = at_zeros(self.pair, part, start.state, around, near)
        end = fit(
            self.pair,
            part,
            chosen_of(self.pair, part, linear),
            state,
            start.sizes,
            gain=_GAIN,
            around=around,
            linear=linear,
            evaluations=_EVALUATIONS,
            known=self._same_radius,
        )
        return dataclasses.replace(end, scatter={**end.scatter, **dict.fromkeys(self._same_radius, NO_SCATTER)})


_Starts = Proposals[Start, Estimate]


def _from_the_prior(search: Multistart) -> _Starts:
    """The drive of the pair file, by all curves and by high loads, with each quarter turn of an unknown crank."""
    if search.origin is not None:
        return
    pair, loads = search.pair, np.array([0.0 if c.branch else abs(c.torque) for c in search.few.curves])
    high, every = np.flatnonzero(loads > _HIGH_LOAD * loads.max()), np.arange(loads.size)
    for number, turn in enumerate(_QUARTERS if search.few.fit_crank else (0.0, 0.0)):
        zero = np.zeros(spread_of(pair, {}).size)
        state = State(surface_of_pair(pair), zero, np.empty(0), turn * 2.0 * np.pi / pair.pins)
        yield Start(state, search.sizes, high if number == 1 else every)
        search.is_settled = search.is_agreed and not is_uneven(search.best)
        if search.is_settled:
            return


def _from_the_origin(search: Multistart) -> _Starts:
    """The end of the other fit."""
    if search.origin is not None:
        yield Start(search.origin.state, search.origin.scatter)


def _mirrored(search: Multistart) -> _Starts:
    """Of two discs, whose curves depend on products of odd orders round the ring only, each such order negated."""
    for order in (1, 3) if search.pair.discs == 2 else ():
        yield Start(_negated(search.pair, search.best, order), search.sizes)


def _from_another_disc(search: Multistart) -> _Starts:
    """The description from each other disc, which on bearings makes nearly the same curves."""
    for state in descriptions(search.pair, search.best) if search.pair.supports is not None else ():
        yield Start(state, search.best.scatter)


def _with_pins_put_back(search: Multistart) -> _Starts:
    """The best fit with the pins of the largest residuals put back, as long as this improves it.

    In a minimum beside the best one neighbouring pins are wrong in opposite ways; the residual is largest there.
    """
    least = np.inf
    while not search.is_settled and search.best.unlikelihood < least:
        best = search.best
        least = best.unlikelihood - _AGREE * search.few.measured.size
        for pin, reach in itertools.product(_worst_pins(search.pair, best), _NEIGHBOURS):
            if len(search.ends) >= _MOST:
                return
            yield Start(_put_back(search.pair, best.state, pin, reach), best.scatter)
            if search.best.unlikelihood < least:
                break


def descriptions(pair: Pair, estimate: Estimate) -> tuple[State, ...]:
    """Return the states of a fit as described from each other disc as the first."""
    return tuple(
        _described(pair, estimate, other_description)
        for other_description in other_descriptions(pair, estimate.state.surface)
    )


def _described(pair: Pair, estimate: Estimate, surface: ErrorSurface) -> State:
    values = {n: structured_value(surface, n) for n in estimate.chosen}
    plain = with_structured(surface_of_pair(pair), values)
    scatter = scatter_between(surface, plain)
    return dataclasses.replace(estimate.state, surface=with_scatter(plain, scatter), scatter=scatter)


def _worst_pins(pair: Pair, estimate: Estimate) -> list[int]:
    """Places in a scatter vector of the pins with the largest residuals, the worst first."""
    columns = estimate.linear.scatter
    share = columns[:, : pair.pins] ** 2 + columns[:, pair.pins : 2 * pair.pins] ** 2
    worst = (estimate.residual**2 @ share) / np.maximum(share.sum(axis=0), 1e-300)
    return [int(i) for i in np.argsort(-worst)[:_WORST_PINS]]


def _negated(pair: Pair, estimate: Estimate, order: int) -> State:
    """A state with the opposite sign of the errors of one order around the ring, without scatter."""
    state = unscattered(estimate.state)
    values = {n: structured_value(state.surface, n) for n in estimate.chosen}
    for name in values:
        wave = wave_of(name)
        is_of_order = wave is not None and wave[0].of == "pin" and wave[1] == order
        if is_of_order or (order == 1 and name.startswith("centre_distance")):
            values[name] = -values[name]
    return dataclasses.replace(state, surface=with_structured(surface_of_pair(pair), values))


def _put_back(pair: Pair, state: State, pin: int, reach: int) -> State:
    """A state in which a pin and its neighbours have no scatter."""
    window = np.mod(np.arange(pin - reach, pin + reach + 1), pair.pins)
    scatter = state.scatter.copy()
    scatter[np.concatenate([window, window + pair.pins])] = 0.0
    surface = with_scatter(state.surface, scatter - state.scatter)
    return dataclasses.replace(state, surface=surface, scatter=scatter)


def unscattered(state: State) -> State:
    """Return a state without the scatter of pins and teeth."""
    surface = with_scatter(state.surface, -state.scatter)
    return dataclasses.replace(state, surface=surface, scatter=np.zeros_like(state.scatter))


def at_zeros(
    pair: Pair,
    observed: Observations,
    state: State,
    around: Sequence[NearDrive] | None = None,
    near: Linear | None = None,
) -> tuple[State, Linear]:
    """Return a state with the unknown zeros of these observations, nothing else of the bench, and the model there.

    The arguments are those of `linearise`.
    """
    state = dataclasses.replace(state, bench=np.zeros(observed.bench.shape[1]))
    linear = linearise(pair, observed, state, around, near)
    free = ~np.isfinite(observed.bench_prior)
    state.bench[free] = np.linalg.lstsq(observed.bench[:, free], left_of(observed, linear, state), rcond=None)[0]
    return state, linear


def first_sizes(observed: Observations) -> dict[str, float]:
    """Return the sizes from which those of the bench's groups are estimated: rad, of the chain rad/(N·m)."""
    return {group: observed.chain_prior if group == CHAIN else FIRST_SIZE for group in observed.estimated}


def no_scatter(pair: Pair) -> dict[str, float]:
    """Return sizes of pins' and teeth's scatter, and of creep, that nobody can see."""
    return {**dict.fromkeys(estimated_parts(pair), NO_SCATTER), CREEP: NO_CREEP}


def is_uneven(estimate: Estimate) -> bool:
    """Whether a curve's noise is larger than that of the others, as in a fit that missed the best minimum."""
    noises = estimate.noises[estimate.observed.running]
    return bool(noises.max() > _UNEVEN * np.median(noises))
