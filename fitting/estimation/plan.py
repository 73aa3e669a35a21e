"""What bench runs that are only planned would tell: which errors, how exactly, and which not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.model.identifiability import chosen_errors, posterior_covariance, weakness
from fitting.model.loops import planned_branches
from fitting.model.observations import State, errors_of, linearise, observations, scatter_parts, spread_of
from fitting.transmission_error.curve import Curve


@dataclass(frozen=True)
class Plan:
    """What a set of bench runs would tell.

    Attributes
    ----------
    said
        The runs in words.
    standard_error
        {name: m or rad} of the errors that would be identified, the pins' and teeth's scatter allowed for.
    held
        {name: why} of the others.
    """

    said: str
    standard_error: dict[str, float]
    held: dict[str, str]


def planned_curve(ratio: float, torque: float, direction: int, turns: float, samples: int) -> Curve:
    """Return the curve that a run would give, its transmission error all zero.

    Parameters
    ----------
    ratio
        Signed ratio.
    torque
        N·m.
    direction
        ±1.
    turns
        Output turns; more than one are averaged.
    samples
        Samples in a crank turn.
    """
    points = round(samples * abs(ratio) * min(turns, 1.0))
    angle = np.arange(points) * 2.0 * np.pi / samples
    return Curve(
        input_angle=angle, transmission_error=np.zeros(points), standard_error=np.full(points, np.nan),
        sample_count=np.full(points, max(1, int(turns)), dtype=np.int64), torque=torque, torque_deviation=0.0,
        direction=direction, ratio=ratio, common_zero=True, known_index=True, source="plan", checksum="",
    )  # fmt: skip


def plan(
    pair: Pair,
    torques: Sequence[float],
    directions: Sequence[int],
    *,
    turns: float,
    samples: int,
    noise: float,
    scatter: float,
    said: str,
    loops: Sequence[tuple[float, float]] = (),
) -> Plan:
    """Return what bench runs at these torques, each in these directions, would tell of a pair.

    Parameters
    ----------
    torques
        Sizes of the torque, N·m; it opposes the motion, so that it changes its sign with the direction.
    directions
        ±1 each.
    turns, samples
        Output turns of each run, and samples in a crank turn.
    noise
        Standard deviation of a single sample of the transmission error, rad.
    scatter
        What single pins and teeth do beyond the structured errors, standard deviation, m.
    said
        The runs in words.
    loops
        Torque up to which each loop with the input locked goes, N·m, and the crank angle there, rad.
    """
    curves = [planned_curve(pair.ratio, way * torque, way, turns, samples) for torque in torques for way in directions]
    for number, (torque, crank) in enumerate(loops):
        curves += planned_branches(pair, torque, crank, number)
    level = [noise / np.sqrt(c.sample_count[0]) for c in curves]
    observed = observations(curves, pair, level)
    names = errors_of(pair)
    spread = spread_of(pair, dict.fromkeys(scatter_parts(pair), scatter))
    state = State(surface_of_pair(pair), np.zeros_like(spread), np.zeros(observed.bench.shape[1]))
    linear = linearise(pair, observed, state)
    chosen = chosen_errors(observed, linear, names, spread)
    _, _, reasons = weakness(observed, linear, names, chosen)
    covariance = posterior_covariance(observed, linear, names, chosen, spread)
    error = np.sqrt(np.diag(covariance)[: len(chosen)])
    return Plan(said, dict(zip(chosen, error.tolist(), strict=True)), reasons)


def bench_plans(
    pair: Pair,
    torques: Sequence[float],
    *,
    turns: float,
    samples: int,
    noise: float,
    scatter: float,
    loop: float | None = None,
) -> list[Plan]:
    """Return what ever larger sets of runs would tell: the largest torque one way, both ways, then torque by torque.

    Parameters are those of `plan`; the torques are added from the largest, then the smallest, to those between. With a
    `loop` to a torque (N·m) the first and the last set come with it too, the crank locked at pin 0.
    """
    ordered = sorted(set(torques), reverse=True)
    ordered = ordered[:1] + ordered[:0:-1]
    sets: list[tuple[list[float], tuple[int, ...], str, bool]]
    sets = [(ordered[:1], (1,), f"{ordered[0]:g} N·m forward", False)]
    for count in range(1, len(ordered) + 1):
        loads = " and ".join(f"{t:g}" for t in ordered[:count])
        sets.append((ordered[:count], (1, -1), f"{loads} N·m both ways", False))
    if loop is not None:
        wound = [(s[0], s[1], f"{s[2]} and a loop to {loop:g} N·m", True) for s in (sets[0], sets[-1])]
        sets = [sets[0], wound[0], *sets[1:], wound[1]]
    loops = [] if loop is None else [(loop, 0.0)]
    return [
        plan(pair, loads, ways, turns=turns, samples=samples, noise=noise, scatter=scatter, said=said,
             loops=loops if with_loop else ())
        for loads, ways, said, with_loop in sets
    ]  # fmt: skip
