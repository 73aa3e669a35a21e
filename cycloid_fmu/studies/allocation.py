"""Tolerance allocation: the cheapest tolerances that reach a yield.

A tolerance's cost is taken as inversely proportional to its width, the usual reciprocal law: at a width s times the
stated one it costs c/s, c its relative cost as stated. The same drives are scaled throughout (common random numbers),
to first order in their errors; the exact kernel confirms what is found on other drives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.studies.tolerance import (
    Study,
    demand,
    figures_of,
    figures_to_first_order,
    points,
    run,
    screen_of,
    surface_of,
    yields,
)
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import ErrorSurface, nominal_surface

Array = NDArray[np.float64]
NARROWEST, WIDEST = 0.05, 4.0  # of the stated tolerances
_ROUNDS = 12
_SLOPE_STEP = 0.03  # of a tolerance's logarithm


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Tolerances that reach a yield at least cost.

    Attributes
    ----------
    scale
        Width of each tolerance relative to the stated one, shape (factors,).
    cost, stated_cost
        Sum of the tolerances' relative costs, found and as stated.
    exact_yield
        Share of drives drawn anew that keep all limits, by the exact kernel; it reaches what was asked for.
    stated_yield
        Share of the study's own drives that keep them with the tolerances as stated, to first order.
    """

    scale: Array
    cost: float
    stated_cost: float
    exact_yield: float
    stated_yield: float


def errors_of_factors(study: Study, place: Array) -> Array:
    """Return what each factor's errors displace in each drive, shape (factors, drives, displacements).

    Parameters
    ----------
    place
        Points of the unit cube, shape (drives, factors); the displacements are those of `displacement_vector`.
    """
    kinds = {kind.tolerance.key: kind.name for kind in KINDS.values() if kind.tolerance is not None}
    rows = []
    for point in place:
        drawn = surface_of(study, point)
        alone = (ErrorSurface(study.pair, {kinds[name]: drawn.errors[kinds[name]]}) for name in study.factors)
        rows.append([displacement_vector(study.pair, surface) for surface in alone])
    return np.swapaxes(np.array(rows), 0, 1)


def scaled(study: Study, scale: Array) -> Study:
    """Return a study whose tolerances are so much wider; every drive's errors are as much larger."""
    changes = {}
    for name, factor in zip(study.factors, scale, strict=True):
        stated = getattr(study.tolerances, name)
        widths = ("single", "cumulative") if hasattr(stated, "single") else ("tolerance",)
        changes[name] = stated.replace(**{w: getattr(stated, w) * float(factor) for w in widths})
    return dataclasses.replace(study, tolerances=study.tolerances.replace(**changes))


def allocate(
    study: Study,
    target: float,
    source: str,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], None] = lambda steps: None,
) -> Allocation:
    """Return the cheapest tolerances by which a share `target` of the drives keeps all the study's limits.

    They are found on the study's own drives and confirmed on as many others, drawn with the next seed.

    From the stated tolerances on, the logarithm of the demand that the share just meets is made linear in the
    logarithms of the widths; the cheapest step within a shrinking region has a closed form, c/(s λ) = slope.

    Parameters
    ----------
    source
        The tolerances' file, for messages.
    workers, scheduler
        Of the exact kernel, as in `tolerance.solved`.
    progress
        Told 1 after each step, `steps` times at least.

    Raises
    ------
    edge.InputError
        If there are no limits, the target is none, or no tolerances, however narrow, reach it.
    """
    limits = study.tolerances.limits.stated()
    if not limits:
        raise edge.InputError(f"{source}: [limits] is missing; a yield needs at least one limit.")
    if not 0.0 < target < 1.0:
        raise edge.InputError(f"target = {target:g}: the yield to reach must lie between 0 and 1.")
    nominal = demand(study, figures_of(study, nominal_surface(study.pair))[None])
    for name, taken in nominal.items():
        if taken[0] > 1.0:
            raise edge.InputError(
                f"{source}: [limits] {name}: the error-free drive itself takes {taken[0]:.3g} times the limit, so no "
                "tolerances reach the yield; widen the limit or change the pair."
            )
    costs = np.array([study.tolerances.costs.get(name, 1.0) for name in study.factors])
    place = points(study)
    errors, screen = errors_of_factors(study, place), screen_of(study, WIDEST)

    def demands(scale: Array) -> Array:
        values = figures_to_first_order(study, screen, np.tensordot(scale, errors, 1))
        return np.asarray(np.max([*demand(study, values).values()], axis=0))

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
        progress(1)
    scale = np.exp(width)
    # The linear step may end beyond the target: narrow all alike until it is met, first to first order, then exactly.
    narrower = 1.0
    while reached(narrower * scale) < target:
        narrower *= 0.99
        if narrower * scale.max() < NARROWEST:
            raise edge.InputError(
                f"target = {target:g}: no tolerances of {source}, narrowed to {NARROWEST:g} of their width, reach "
                "it; widen a limit or ask for less."
            )
    others = dataclasses.replace(study, seed=study.seed + 1)
    while True:
        confirmed = run(scaled(others, narrower * scale), workers=workers, scheduler=scheduler)
        exact = yields(confirmed)["all"]["share"]
        progress(1)
        if exact >= target:
            break
        narrower *= 0.99
    scale = narrower * scale
    return Allocation(
        scale=scale, cost=float((costs / scale).sum()), stated_cost=float(costs.sum()),
        exact_yield=exact, stated_yield=reached(np.ones(costs.size)),
    )  # fmt: skip


def steps() -> int:
    """Return how many steps `allocate` tells of, at least."""
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
