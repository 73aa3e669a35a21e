"""What planned bench runs would identify: which errors, how exactly, and which not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.arguments import positive
from fitting.model.identifiability import chosen_errors, posterior_covariance, weakness
from fitting.model.loops import planned_branches
from fitting.model.observations import State, errors_of, estimated_parts, linearise, observations, spread_of
from fitting.transmission_error.curve import Curve


@dataclass(frozen=True)
class Plan:
    """What a set of bench runs would identify.

    Attributes
    ----------
    runs
        The runs in words.
    standard_error
        {name: m or rad} of the errors that would be identified, the pins' and teeth's scatter allowed for.
    held
        {name: why} of the others.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> *_, one = fitting.plan(cy.Drive(pair), torque=100.0, turns=1.0, samples=12)
    >>> one.runs, one.held["misalignment_xz"]
    ('100 N·m both ways', 'it does not move these transmission errors')
    """

    runs: str
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
    drive: Drive,
    torque: float | str | Sequence[float | str],
    *,
    turns: float = 2.0,
    samples: int = 24,
    noise: float | str = "0.5 arcsec",
    scatter: float | str = "0.3 um",
    loop: float | str | None = None,
) -> list[Plan]:
    """Return what ever larger sets of bench runs would identify of a drive, before anything is measured.

    The sets are the largest torque one way, both ways, then with the smallest and those between added.

    Parameters
    ----------
    drive
        The nominal drive.
    torque
        The torques that the bench can hold, N·m; it opposes the motion, so its sign changes with the direction.
    turns, samples
        Output turns of each run, and samples in a crank turn.
    noise
        Standard deviation of a single sample of the transmission error, rad.
    scatter
        What single pins and teeth do beyond the structured errors, standard deviation, m.
    loop
        Torque up to which a hysteresis loop goes, N·m, the crank locked at pin 0: the first and the last set come with
        it too.

    Raises
    ------
    edge.InputError
        If an argument is wrong.

    Examples
    --------
    >>> import cycloid_fmu as cy, fitting
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> first, *_, last = fitting.plan(cy.Drive(pair), torque=[20.0, "200 N*m"], turns=1.0, samples=12)
    >>> last.runs
    '200 and 20 N·m both ways'
    >>> len(last.standard_error) > len(first.standard_error)
    True
    """
    pair = drive.pair
    given = [torque] if isinstance(torque, float | int | str) else torque
    loads = {positive(one, "N*m", "torque") for one in given}
    level = positive(noise, "rad", "noise")
    spread = positive(scatter, "m", "scatter", zero=True)
    peak = None if loop is None else positive(loop, "N*m", "loop")
    if not loads:
        raise edge.ArgumentError("torque", "is missing")
    if not turns > 0.0:
        raise edge.ArgumentError("turns", "it must be above zero", turns)
    if samples < 6:
        raise edge.ArgumentError("samples", "it must be 6 or more", samples)
    ordered = sorted(loads, reverse=True)
    ordered = ordered[:1] + ordered[:0:-1]
    sets: list[tuple[str, list[float], tuple[int, ...], bool]]
    sets = [(f"{ordered[0]:g} N·m forward", ordered[:1], (1,), False)]
    for count in range(1, len(ordered) + 1):
        names = " and ".join(f"{t:g}" for t in ordered[:count])
        sets.append((f"{names} N·m both ways", ordered[:count], (1, -1), False))
    if peak is not None:
        wound = [(f"{s[0]} and a loop to {peak:g} N·m", s[1], s[2], True) for s in (sets[0], sets[-1])]
        sets = [sets[0], wound[0], *sets[1:], wound[1]]
    plans = []
    for runs, torques, directions, with_loop in sets:
        curves = [planned_curve(pair.ratio, way * t, way, turns, samples) for t in torques for way in directions]
        if peak is not None and with_loop:
            curves += planned_branches(pair, peak, 0.0, 0)
        plans.append(_planned(drive, curves, level, spread, runs))
    return plans


def _planned(drive: Drive, curves: Sequence[Curve], noise: float, scatter: float, runs: str) -> Plan:
    pair = drive.pair
    observed = observations(
        curves, pair, [noise / np.sqrt(c.sample_count[0]) for c in curves], first_stage=drive.first_stage
    )
    names = errors_of(pair)
    spread = spread_of(pair, dict.fromkeys(estimated_parts(pair), scatter))
    state = State(surface_of_pair(pair), np.zeros_like(spread), np.zeros(observed.bench.shape[1]))
    linear = linearise(pair, observed, state)
    chosen = chosen_errors(observed, linear, names, spread)
    _, _, reasons = weakness(observed, linear, names, chosen)
    covariance = posterior_covariance(observed, linear, names, chosen, spread)
    error = np.sqrt(np.diag(covariance)[: len(chosen)])
    return Plan(runs, dict(zip(chosen, error.tolist(), strict=True)), reasons)
