"""Tolerance allocation: the cheapest tolerances that reach a yield.

A tolerance's cost is taken as inversely proportional to its width, the usual reciprocal law: at a width s times the
stated one it costs c/s, c its relative cost as stated. The same drives are scaled throughout (common random numbers),
to first order in their errors; the exact model confirms the result on other drives. On rigid bearings the expansion is
about the error-free drive; where errors open and close bearings' clearances it is about each drive, solved at every
step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.studies.tolerance import (
    PLAY_STEP,
    Study,
    crank_angles,
    demand,
    figures_near,
    figures_of,
    near_drives,
    points,
    run,
    surface_of,
    yields,
)
from cycloid_fmu.supports.transmission import PLAY_LOAD, sensitivity, solve
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import ErrorSurface, nominal_surface

Array = NDArray[np.float64]
NARROWEST, WIDEST = 0.05, 4.0  # of the stated tolerances
_ROUNDS = 12
_SLOPE_STEP = 0.03  # of a tolerance's logarithm
_ON_BEARINGS = 256  # drives with supports on which tolerances are found: each is solved at every step


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Tolerances that reach a yield at the lowest cost.

    Attributes
    ----------
    scale
        Width of each tolerance relative to the stated one, shape (factors,).
    cost, stated_cost
        Sum of the tolerances' relative costs, found and as stated.
    exact_yield
        Share of new drives that keep all limits, by the exact model; at least the required yield.
    stated_yield
        Share of the study's own drives that keep them with the tolerances as stated, to first order.
    """

    scale: Array
    cost: float
    stated_cost: float
    exact_yield: float
    stated_yield: float


def errors_of_factors(study: Study, place: Array) -> Array:
    """Return the displacements by each factor's errors in each drive, shape (factors, drives, displacements).

    Parameters
    ----------
    place
        Points of the unit cube, shape (drives, factors); the displacements are those of `displacement_vector`.
    """
    kinds = {kind.tolerance.key: kind.name for kind in KINDS.values() if kind.tolerance is not None}
    rows, none = [], displacement_vector(study.pair, nominal_surface(study.pair))
    for point in place:
        drawn = surface_of(study, point)
        alone = (ErrorSurface(study.pair, {kinds[name]: drawn.errors[kinds[name]]}) for name in study.factors)
        rows.append([displacement_vector(study.pair, surface) - none for surface in alone])
    return np.swapaxes(np.array(rows), 0, 1)


def scaled(study: Study, scale: Array) -> Study:
    """Return a study with scaled tolerances; every drive's errors scale with them."""
    changes = {}
    for name, factor in zip(study.factors, scale, strict=True):
        stated = getattr(study.tolerances, name)
        widths = ("single", "cumulative") if hasattr(stated, "single") else ("tolerance",)
        changes[name] = stated.replace(**{w: getattr(stated, w) * float(factor) for w in widths})
    return dataclasses.replace(study, tolerances=study.tolerances.replace(**changes))


class Nearby:
    """Drives on bearings, solved at some widths of the tolerances and linearised for nearby widths.

    It replaces `contact.near_drives.NearDrives`, whose first order about the error-free drive would keep the clearances
    of all bearings as in that drive.

    Parameters
    ----------
    study
        With supports and a rated torque.
    place
        The drives, points of the unit cube, shape (drives, factors).
    errors
        The result of `errors_of_factors` for them.
    scale
        The widths relative to the stated ones, shape (factors,).
    workers
        Threads.
    """

    def __init__(self, study: Study, place: Array, errors: Array, scale: Array, workers: int = 1) -> None:
        self._scale = scale
        pair, angles = study.pair, crank_angles(study)
        assert pair.rated_torque is not None
        few = angles[::PLAY_STEP]
        ends = (PLAY_LOAD * pair.rated_torque, -PLAY_LOAD * pair.rated_torque)
        sweeps = [*((t, angles) for t in study.torque), *((t, few) for t in (*pair.lost_motion_loads, *ends))]
        limited = study.tolerances.limits.max_contact_pressure is not None
        at = scaled(study, scale)
        steps = _SLOPE_STEP * scale
        wider = [scaled(study, scale + step) for step in np.diag(steps)] if limited else []

        def largest(one: Study, point: Array) -> Array:
            found = solve(pair, surface_of(one, point), study.torque, angles, with_play=False)
            return np.asarray(found.max_contact_pressure.max(axis=1))

        def solved(drive: int) -> tuple[list[Array], list[Array], Array, Array]:
            deviations, slopes = [], []
            surface = surface_of(at, place[drive])
            for number, (torque, theta) in enumerate(sweeps):
                one = sensitivity(pair, surface, torque, theta)
                # The ends of the play are where the tangents at two small torques reach zero torque.
                left = torque * one.by_torque if number >= len(sweeps) - len(ends) else 0.0
                deviations.append(one.transmission_error - left)
                slopes.append(errors[:, drive] @ one.by_displacement.T)
            pressure, rates = np.zeros(len(study.torque)), np.zeros((scale.size, len(study.torque)))
            if limited:
                pressure = largest(at, place[drive])
                rates = (np.array([largest(one, place[drive]) for one in wider]) - pressure) / steps[:, None]
            return deviations, slopes, pressure, rates

        with ThreadPoolExecutor(workers) as pool:
            drives = list(pool.map(solved, range(len(place))))
        self._deviation = [np.array([one[0][k] for one in drives]) for k in range(len(sweeps))]
        self._slope = [np.array([one[1][k] for one in drives]) for k in range(len(sweeps))]
        self._pressure, self._rate = np.array([one[2] for one in drives]), np.array([one[3] for one in drives])

    def loaded(self, sweep_number: int, scale: Array, /) -> tuple[Array, Array]:
        """Return transmission error (drives, angles), rad, and largest pressure, (drives, 1), Pa, at nearby widths.

        The pressure is given at the study's torques if it has a limit; otherwise it is 0.
        """
        moved = scale - self._scale
        deviation = self._deviation[sweep_number] + np.tensordot(moved, self._slope[sweep_number], (0, 1))
        known = min(sweep_number, self._pressure.shape[1] - 1)
        pressure = self._pressure[:, known] + np.tensordot(moved, self._rate[:, :, known], (0, 1))
        return deviation, pressure[:, None]

    def play(self, sweep_number: int, scale: Array, /) -> tuple[Array, Array]:
        """Return backlash (rad) and interference (m, none), each (drives, angles)."""
        above, below = (self.loaded(sweep_number + k, scale)[0] for k in range(2))
        return np.maximum(above - below, 0.0), np.zeros_like(above)


def allocate(
    study: Study,
    target: float,
    source: str,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], None] = lambda steps: None,
) -> Allocation:
    """Return the cheapest tolerances with which a share `target` of the drives keeps all the study's limits.

    They are found on the study's own drives, of a pair with supports on the first `_ON_BEARINGS` of them, and confirmed
    on as many others as the study has, drawn with the next seed.

    Starting from the stated tolerances, the logarithm of the demand that the share just meets is linearised in the
    logarithms of the widths; the cheapest step within a shrinking region has a closed form, c/(s λ) = slope.

    Parameters
    ----------
    source
        The tolerances' file, for messages.
    workers, scheduler
        Of the exact model, as in `tolerance.solved`.
    progress
        Called with 1 after each of `steps` steps, and with 0 after a confirmation that fails.

    Raises
    ------
    edge.InputError
        If there are no limits, the target is invalid, or no tolerances, however narrow, reach it.
    """
    limits = study.tolerances.limits.stated()
    if not limits:
        raise edge.InputError(f"{source}: [limits] is missing; a yield needs at least one limit.")
    if not 0.0 < target < 1.0:
        raise edge.InputError(f"target = {target:g}: the yield to reach must be between 0 and 1.")
    nominal = demand(study, figures_of(study, nominal_surface(study.pair))[None])
    for name, taken in nominal.items():
        if taken[0] > 1.0:
            raise edge.InputError(
                f"{source}: [limits] {name}: the error-free drive itself takes {taken[0]:.3g} times the limit, so no "
                "tolerances reach the yield; widen the limit or change the pair."
            )
    costs = np.array([study.tolerances.costs.get(name, 1.0) for name in study.factors])
    place = points(study)
    if study.pair.supports is not None:
        place = place[:_ON_BEARINGS]
    errors, none = errors_of_factors(study, place), displacement_vector(study.pair, nominal_surface(study.pair))

    def demands_about(width: Array) -> Callable[[Array], Array]:
        """Return the demand of every drive over the scale, valid near these widths."""
        nearby = Nearby(study, place, errors, width, workers) if study.pair.supports is not None else None

        def demands(scale: Array) -> Array:
            if nearby is None:
                near = near_drives(study, first_order=True)
                values = figures_near(study, near, near.made(np.tensordot(scale, errors, 1) + none))
            else:
                values = figures_near(study, nearby, scale)
            return np.asarray(np.max([*demand(study, values).values()], axis=0))

        return demands

    def reached(scale: Array) -> float:
        return float(np.mean(demands(scale) <= 1.0))

    def edge_of(scale: Array) -> float:
        """Logarithm of the demand about the target's rank, averaged over a few ranks so that it is smooth."""
        ordered = np.sort(demands(scale))
        rank = target * (ordered.size - 1)
        spread = max(2.0, 0.015 * ordered.size)
        weight = np.exp(-0.5 * ((np.arange(ordered.size) - rank) / spread) ** 2)
        return float(np.log(max((weight * ordered).sum() / weight.sum(), 1e-6)))

    width = np.zeros(costs.size)
    demands = demands_about(np.exp(width))
    stated_yield = reached(np.ones(costs.size))
    low, high = np.log(NARROWEST), np.log(WIDEST)
    for step in range(_ROUNDS):
        region = 0.6 * 0.77**step
        here = edge_of(np.exp(width))
        slope = np.empty(costs.size)
        for i in range(costs.size):
            moved = width.copy()
            moved[i] += _SLOPE_STEP
            slope[i] = (edge_of(np.exp(moved)) - here) / _SLOPE_STEP
        box = np.maximum(width - region, low), np.minimum(width + region, high)
        width = _cheapest_step(width, here, slope, costs, *box)
        demands = demands_about(np.exp(width))
        progress(1)
    scale = np.exp(width)
    # The linear step may end beyond the target: narrow all alike until it is met, first to first order, then exactly.
    narrower = 1.0
    while reached(narrower * scale) < target:
        narrower *= 0.99
        if narrower * scale.max() < NARROWEST:
            raise edge.InputError(
                f"target = {target:g}: no tolerances of {source}, narrowed to {NARROWEST:g} of their width, reach "
                "it; widen a limit or require a lower yield."
            )
    others = dataclasses.replace(study, seed=study.seed + 1)
    while True:
        confirmed = run(scaled(others, narrower * scale), workers=workers, scheduler=scheduler)
        exact = yields(confirmed)["all"]["share"]
        progress(int(exact >= target))
        if exact >= target:
            break
        narrower *= 0.99
    scale = narrower * scale
    return Allocation(
        scale=scale,
        cost=float((costs / scale).sum()),
        stated_cost=float(costs.sum()),
        exact_yield=exact,
        stated_yield=stated_yield,
    )


def steps() -> int:
    """Return the number of steps that `allocate` reports."""
    return _ROUNDS + 1


def _cheapest_step(width: Array, here: float, slope: Array, costs: Array, low: Array, high: Array) -> Array:
    """Minimise Σ c e^{-u} within the box where here + slope (u - width) ≤ 0, u the logarithms of the widths."""

    def at(multiplier: float) -> Array:
        with np.errstate(divide="ignore"):
            free = np.where(slope > 0.0, np.log(costs / np.maximum(multiplier * slope, 1e-300)), high)
        return np.clip(free, low, high)

    def beyond(multiplier: float) -> float:
        return here + float(slope @ (at(multiplier) - width))

    least, most = 1e-9, 1e9
    if beyond(least) <= 0.0:
        return at(least)
    for _ in range(100):
        middle = float(np.sqrt(least * most))
        least, most = (middle, most) if beyond(middle) > 0.0 else (least, middle)
    return at(most)
