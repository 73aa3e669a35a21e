"""Variation of the lost motion of an RV reducer within its tolerances: worst case, root sum square, Monte Carlo."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.reducer.description import Deviations, Reducer, surface_of_reducer, values_of
from cycloid_fmu.reducer.lost_motion import (
    bearing_share,
    contact_play,
    outer_stages,
    standard,
    summed,
)
from cycloid_fmu.surfaces.sampling import error_stream, within_tolerance

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Stack:
    """Variation of the play within the tolerances.

    Attributes
    ----------
    worst_case, root_sum_square
        Lowest and highest total play, rad, by the closed form, linear in the tolerances.
    samples
        Sampled total plays, rad: {"standard": shape (samples,), "geometric": shape (samples,), with the sun locked}.
    interfering
        {variant: share of samples whose cycloid stage interferes}: by the closed form, a play below zero; by the
        contact model, a crank angle without a free position.
    interval
        {variant: Clopper-Pearson interval of that share at 95 %}.
    """

    worst_case: tuple[float, float]
    root_sum_square: tuple[float, float]
    samples: dict[str, Array]
    interfering: dict[str, float]
    interval: dict[str, tuple[float, float]]


def stack(
    reducer: Reducer, samples: int, seed: int, progress: Callable[[int], None] = lambda samples: None
) -> Stack | None:
    """Return worst case, root sum square and Monte Carlo of the total play; None without tolerances.

    Parameters
    ----------
    samples, seed
        Number of reducers drawn within the tolerances, and the seed; each deviation has its own stream.
    progress
        Called with the number of samples just finished.
    """
    from scipy.stats import binomtest

    values = values_of(reducer)
    free = {n: d for n in Deviations.model_fields if (d := getattr(reducer.deviations, n)).tolerance > 0.0}
    if not free:
        return None
    nominal = float(summed(standard(reducer, values))["total"])
    half = []
    for name, deviation in free.items():
        ends = values[name] + np.array([-1.0, 1.0]) * deviation.tolerance
        half.append(0.5 * float(np.ptp(summed(standard(reducer, {**values, name: ends}))["total"])))
    drawn = {
        name: d.value + within_tolerance(error_stream(seed, name).random(samples), d.tolerance, d.distribution)
        for name, d in free.items()
    }
    closed = summed(standard(reducer, {**{n: np.full(samples, v) for n, v in values.items()}, **drawn}))
    exact, pressed = np.empty(samples), np.empty(samples, dtype=bool)
    angles = reducer.stage.gear_teeth + 2
    loose = "crank_bearing_clearance" in free or values["crank_bearing_clearance"] != 0.0
    share = bearing_share(reducer, surface_of_reducer(reducer)) if loose else 1.0
    for i in range(samples):
        one = values | {n: float(v[i]) for n, v in drawn.items()}
        play = contact_play(reducer, surface_of_reducer(reducer, one), angles)
        outer = outer_stages(reducer, one, reducer.involute.sun_base_radius)
        exact[i] = float(outer["base_tangent_length"]) + reducer.sun_locked * (
            share * float(outer["crank_bearing_clearance"]) + float(play.backlash.mean())
        )
        pressed[i] = play.interference.max() > 0.0
        progress(1)
    counts = {"standard": int(np.count_nonzero(closed["cycloid"] < 0.0)), "geometric": int(np.count_nonzero(pressed))}
    intervals = {v: binomtest(c, samples).proportion_ci() for v, c in counts.items()}
    worst, root = sum(half), math.hypot(*half)
    return Stack(
        worst_case=(nominal - worst, nominal + worst),
        root_sum_square=(nominal - root, nominal + root),
        samples={"standard": closed["total"], "geometric": exact},
        interfering={v: c / samples for v, c in counts.items()},
        interval={v: (float(i.low), float(i.high)) for v, i in intervals.items()},
    )


def stack_summary(stack: Stack) -> dict[str, Any]:
    """Return a stack's figures as plain numbers, rad; `central` spans the middle 99.73 % of the samples."""
    drawn = {
        variant: {
            "mean": float(total.mean()),
            "standard_deviation": float(total.std()),
            "central": np.quantile(total, [0.00135, 0.99865]).tolist(),
            "interfering": stack.interfering[variant],
            "interval": list(stack.interval[variant]),
        }
        for variant, total in stack.samples.items()
    }
    return {
        "worst_case": list(stack.worst_case),
        "root_sum_square": list(stack.root_sum_square),
        "samples": int(stack.samples["standard"].size),
        "monte_carlo": drawn,
    }
