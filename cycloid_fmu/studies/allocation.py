"""Tolerance allocation: the cheapest tolerances that reach a yield.

A tolerance's cost is taken as inversely proportional to its width, the usual reciprocal law: at a width s times the
stated one it costs c/s, c its relative cost as stated. The same drives are scaled throughout (common random numbers).
At each step they are solved as they are and with each tolerance a little wider; their figures, linear in the widths in
between, give the next widths. Other drives confirm the result.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.studies.tolerance import Study, demand, figures_of, run, yields
from cycloid_fmu.surfaces.surface import nominal_surface

Array = NDArray[np.float64]
NARROWEST, WIDEST = 0.05, 4.0  # of the stated tolerances
_DRIVES = 256  # on which tolerances are found
_REGIONS = (2.0, 2.0, 1.6, 1.3, 1.15)  # by which widths may change in each step
_WIDER = 0.03  # by which a width is changed for the slopes
_NARROWER = 0.99  # widths of each attempt, relative to the last one that missed the yield


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
        Share of new drives that keep all limits; at least the required yield.
    exact_interval
        Lower and upper end of its Clopper-Pearson interval at 95 %.
    stated_yield
        Share of the drives on which the tolerances are found that keep them with the tolerances as stated.
    """

    scale: Array
    cost: float
    stated_cost: float
    exact_yield: float
    exact_interval: tuple[float, float]
    stated_yield: float


def scaled(study: Study, scale: Array) -> Study:
    """Return a study with scaled tolerances; every drive's errors scale with them."""
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
    """Return the cheapest tolerances with which a share `target` of the drives keeps all the study's limits.

    They are found on 256 drives, and confirmed on as many others as the study has, drawn with the next seed.

    Parameters
    ----------
    source
        The tolerances' file, for messages.
    workers, scheduler
        As in `tolerance.run`.
    progress
        Called with 1 after each of `steps` steps, and with 0 after a confirmation that fails.

    Raises
    ------
    edge.InputError
        If there are no limits, the target is invalid, or no tolerances, however narrow, reach it.
    """
    check_target(study, target, source)
    costs = np.array([study.tolerances.costs.get(name, 1.0) for name in study.factors])
    few = dataclasses.replace(study, samples=min(study.samples, _DRIVES), design="sobol")
    machines: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    scale, stated_yield = np.ones(costs.size), None
    for region in _REGIONS:
        here = run(scaled(few, scale), **machines).values
        if stated_yield is None:
            stated_yield = float(np.mean(_largest_demand(few, here) <= 1.0))
        wider = [run(scaled(few, scale * (1.0 + _WIDER * one)), **machines).values for one in np.eye(costs.size)]
        if not np.isfinite([here, *wider]).all():
            raise edge.InputError(
                f"{source}: [limits] can't be allocated: some drives jam, or no torque turns them backwards."
            )
        slopes = (np.array(wider) - here) / (_WIDER * scale[:, None, None])
        scale = _cheapest(few, target, costs, scale, region, here, slopes)
        progress(1)
    others = dataclasses.replace(study, seed=study.seed + 1)
    while (whole := yields(run(scaled(others, scale), **machines))["all"])["share"] < target:
        progress(0)
        scale = _NARROWER * scale
        if scale.max() < NARROWEST:
            problem = f"no tolerances of {source}, narrowed to {NARROWEST:g} of their width, reach it"
            raise edge.ArgumentError("target", f"{problem}; widen a limit or require a lower yield", target)
    progress(1)
    cost, interval = float((costs / scale).sum()), (whole["low"], whole["high"])
    return Allocation(scale, cost, float(costs.sum()), whole["share"], interval, stated_yield or 0.0)


def steps() -> int:
    """Return the number of steps that `allocate` reports."""
    return len(_REGIONS) + 1


def check_target(study: Study, target: float, source: str) -> None:
    """Raise `edge.InputError` for a yield that no tolerances can have."""
    if not 0.0 < target < 1.0:
        raise edge.ArgumentError("target", "the yield to reach must be between 0 and 1", target)
    if not study.tolerances.limits.stated():
        raise edge.InputError(f"{source}: [limits] is missing; a yield needs at least one limit.")
    if "self_locking" in study.friction:
        raise edge.InputError(f"{source}: [limits] self_locking can't be allocated, as it is true or false.")
    for name, taken in demand(study, figures_of(study, nominal_surface(study.pair))[None]).items():
        if taken[0] > 1.0:
            raise edge.InputError(
                f"{source}: [limits] {name}: the error-free drive itself takes {taken[0]:.3g} times the limit, so no "
                "tolerances reach the yield; widen the limit or change the pair."
            )


def _largest_demand(study: Study, values: Array) -> Array:
    """Return the figures of each drive as a share of the limit that is nearest, shape (drives,)."""
    return np.asarray(np.max([*demand(study, values).values()], axis=0))


def _cheapest(
    study: Study, target: float, costs: Array, scale: Array, region: float, here: Array, slopes: Array
) -> Array:
    """Return the cheapest widths within a region about others, by the drives' figures there and their slopes.

    Parameters
    ----------
    here, slopes
        Shape (drives, columns), and by each width (factors, drives, columns).
    """
    from scipy.optimize import minimize

    def beyond(logarithms: Array) -> float:
        """Logarithm of the demand about the target's rank, averaged over a few ranks so that it is smooth."""
        demands = _largest_demand(study, here + np.tensordot(np.exp(logarithms) - scale, slopes, 1))
        ordered = np.sort(demands)
        rank, spread = target * (ordered.size - 1), max(2.0, 0.015 * ordered.size)
        weight = np.exp(-0.5 * ((np.arange(ordered.size) - rank) / spread) ** 2)
        return float(np.log(max((weight * ordered).sum() / weight.sum(), 1e-6)))

    low, high = np.maximum(scale / region, NARROWEST), np.minimum(scale * region, WIDEST)
    found = minimize(
        lambda logarithms: float((costs * np.exp(-logarithms)).sum()) / costs.sum(),
        np.log(scale),
        method="SLSQP",
        bounds=np.log(np.transpose([low, high])),
        constraints={"type": "ineq", "fun": lambda logarithms: -beyond(logarithms)},
    ).x
    return np.asarray(np.clip(np.exp(found), low, high))
