"""Which errors measurements tell apart, which they do not and why, and what a planned bench run would tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from cycloid_fmu.pair import Pair
from cycloid_fmu.sampling import Tolerances, sample_surface
from cycloid_fmu.surface import Elements, profile_names, profile_wave, surface_of_pair, unit_of
from fitting.curve import Curve
from fitting.loop_branches import planned_branches
from fitting.observation import (
    ORDERS,
    PROFILE_ORDERS,
    Linear,
    Observations,
    State,
    errors_of,
    linearise,
    nuisance_columns,
    observations,
    scatter_parts,
    spread_of,
)

Array = NDArray[np.float64]

# Of each set of errors that move the transmission error alike the first is fitted (docs/theory/errors.md).
PREFERENCE = (
    "centre_distance_x", "centre_distance_y", "pin_radius", "pin_circle_radius", "eccentricity",
    *(f"{p}_{k}_{w}" for k in (2, 3) for p in ("pin_radial", "pin_tangential") for w in ("cos", "sin")),
    *(f"tooth_cumulative_pitch_{k}_{w}" for k in ORDERS for w in ("cos", "sin")),
    *(f"{p}_1_{w}" for p in ("pin_tangential", "pin_radial") for w in ("cos", "sin")),
    "isometric", "offset", "misalignment_xz", "misalignment_yz",
)  # fmt: skip
TOLERANCE = {"m": 5e-6, "rad": 1e-4}  # standard deviation that an error has before anything is measured
UNKNOWN = 1e-6  # precision of what has no prior, so that what these curves do not see at all can stay where it is
_DRAWN = 100  # drives from which tolerances' scatter is taken
_PROFILE_DRAWN = 50  # elements along the profile of each
KNOWN = 0.2  # an error counts as known where the data leave less than this share of its tolerance


def tolerances_of(names: Sequence[str], stated: Mapping[str, float] | None = None) -> Array:
    """Return the standard deviation of each error before anything is measured, m or rad, where none is stated."""
    return np.array([(stated or {}).get(n, TOLERANCE[unit_of(n)]) for n in names])


def choose(information: Array, names: Sequence[str]) -> list[str]:
    """Choose the errors that the data tell apart.

    Parameters
    ----------
    information
        Information matrix of the structured errors, scaled by their tolerances.
    names
        The structured errors in the matrix' order.

    Returns
    -------
    names
        In the order of `PREFERENCE`: each was added where all errors chosen stay known to `KNOWN` of their tolerance.
    """
    chosen: list[int] = []
    for name in PREFERENCE:
        if name not in names:
            continue
        trial = [*chosen, list(names).index(name)]
        block = information[np.ix_(trial, trial)]
        size = np.sqrt(np.maximum(np.diag(block), 0.0))
        if (size <= 0.0).any():
            continue
        values, vectors = np.linalg.eigh(block / np.outer(size, size))
        if values[0] < 1e-9:
            continue
        if (np.sqrt((vectors**2 / values).sum(axis=1)) / size < KNOWN).all():
            chosen = trial
    return [list(names)[i] for i in chosen]


def chosen_errors(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> list[str]:
    """Choose the errors that observations tell apart, in the order of `names`; orders of the profile are always there.

    Their size is known before measuring, as that of the scatter, and as that they blur the others.

    Parameters
    ----------
    observed, linear, names
        The observations and the model at a state.
    spread
        Standard deviation of each scattered displacement of a pin or tooth, which blurs the errors, m.
    """
    information = _information(observed, linear, names, spread)
    free = [n not in observed.profile for n in names]
    own = np.flatnonzero([*free, *np.zeros(len(information) - len(names), bool)])
    other = np.setdiff1d(np.arange(len(information)), own)
    # What scatter, form and nuisances leave of the information about the errors.
    blurred = linalg.solve(information[np.ix_(other, other)], information[np.ix_(other, own)], assume_a="pos")
    left = information[np.ix_(own, own)] - information[np.ix_(own, other)] @ blurred
    found = choose(0.5 * (left + left.T), [n for n, one in zip(names, free, strict=True) if one])
    return [n for n in names if n in found or n in observed.profile]


def _information(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> Array:
    """Information matrix of errors, scatter and nuisances, each in units of what it may be before measuring.

    Scatter, the profile's orders and the nuisances that have a prior are known by it; the errors and the other
    nuisances by the data alone.
    """
    nuisances, priors = nuisance_columns(observed, linear)
    known = np.isfinite(priors)
    columns = np.column_stack([
        linear.structured * tolerances_of(names, observed.profile), linear.scatter * spread,
        nuisances * np.where(known, priors, 1e-4),
    ])  # fmt: skip
    columns = observed.weight[:, None] * columns
    information: Array = columns.T @ columns
    stated = np.array([float(n in observed.profile) for n in names])
    prior = np.concatenate([stated, np.ones(spread.size), np.where(known, 1.0, UNKNOWN)])
    return information + np.diag(prior)


def weakness(
    observed: Observations, linear: Linear, names: Sequence[str], chosen: Sequence[str]
) -> tuple[Array, tuple[str, ...], dict[str, str]]:
    """Say what the data cannot tell.

    Returns
    -------
    singular_values
        Of the Jacobian scaled by tolerance and noise, the nuisances projected out.
    weak_combinations
        Combinations of errors that stay less known than `KNOWN` of their tolerance, in words: one for each error that
        is not chosen.
    reasons
        {name: why} of every error that is not chosen.
    """
    weight = observed.weight[:, None]
    nuisances, priors = nuisance_columns(observed, linear)
    # A nuisance with a prior is one more measurement of itself.
    known = np.isfinite(priors)
    rows = np.vstack([weight * nuisances, np.diag(1.0 / priors)[known]])
    scale = np.linalg.norm(rows, axis=0)
    rows = rows[:, scale > 0.0] / scale[scale > 0.0]
    q, _ = np.linalg.qr(rows)
    columns = np.vstack(
        [weight * linear.structured * tolerances_of(names, observed.profile), np.zeros((known.sum(), len(names)))]
    )
    columns = columns - q @ (q.T @ columns)
    singular = np.linalg.svd(columns, compute_uv=False)
    keep = [list(names).index(n) for n in chosen]
    weak, reasons = [], {}
    for i, name in enumerate(names):
        if i in keep:
            continue
        length = float(np.linalg.norm(columns[:, i]))
        if length < 1.0:
            reasons[name] = "it does not move these transmission errors"
            weak.append(f"{name} is not known from these data")
            continue
        share, *_ = np.linalg.lstsq(columns[:, keep], columns[:, i], rcond=None)
        left = float(np.linalg.norm(columns[:, i] - columns[:, keep] @ share)) / length
        leading = [j for j in np.argsort(-np.abs(share)) if abs(share[j]) > 0.2 * np.abs(share).max()][:4]
        alike = " ".join(f"{share[j]:+.2f} {chosen[j]}" for j in leading)
        if left < 0.05:
            reasons[name] = f"it moves the transmission errors as {alike}"
        else:
            reasons[name] = f"the data leave it too uncertain beside {alike}"
        weak.append(_in_words(name, [(float(share[j]), chosen[j]) for j in leading]))
    return singular, tuple(weak), reasons


def scatter_of(pair: Pair, tolerances: Tolerances) -> dict[str, float]:
    """Return what tolerances let single pins and teeth do beyond the structured orders: standard deviations, m.

    They are those of drives that the tolerances allow (`cycloid_fmu.sampling.sample_surface`). A pattern of which the
    tolerances say nothing is left out.
    """
    drawn = [sample_surface(pair, tolerances, seed, Elements(2, 2, 1)) for seed in range(_DRAWN)]
    found = {}
    for name in scatter_parts(pair):
        spectra = np.fft.rfft(np.array([np.atleast_2d(getattr(s, name))[0] for s in drawn]), axis=-1)
        spectra[:, : max(ORDERS) + 1] = 0.0
        count = np.asarray(getattr(drawn[0], name)).shape[-1]
        deviation = float(np.sqrt(np.mean(np.fft.irfft(spectra, count, axis=-1) ** 2)))
        if deviation > 0.0:
            found[name] = deviation
    return found


def profile_of(pair: Pair, tolerances: Tolerances) -> dict[str, float]:
    """Return what tolerances let the low orders of the profile deviation be that all teeth share, m.

    Cutter and grinding wheel make one form on every tooth, so it may be as large as one tooth's: standard deviation
    over the teeth of drives that the tolerances allow. Empty where they say nothing of the flanks' form.
    """
    if tolerances.gear_profile is None:
        return {}
    elements = Elements(_PROFILE_DRAWN, 2, 1)
    drawn = [sample_surface(pair, tolerances, seed, elements).gear_deviation for seed in range(_DRAWN // 10)]
    teeth = np.concatenate([d.reshape(-1, *d.shape[2:]) for d in drawn if d is not None]).mean(axis=-1)
    found = {}
    for name in profile_names(PROFILE_ORDERS):
        wave = profile_wave(name, _PROFILE_DRAWN)
        assert wave is not None
        found[name] = float(np.std(2.0 * (teeth * wave).mean(axis=1)))
    return found


def posterior_covariance(
    observed: Observations,
    linear: Linear,
    names: Sequence[str],
    chosen: Sequence[str],
    spread: Array,
) -> Array:
    """Covariance of the chosen errors and of the scatter of every pin and tooth, the nuisances unknown.

    Parameters
    ----------
    chosen
        The errors fitted; they have no prior.
    spread
        Standard deviation of each scattered displacement before anything is measured, m.

    Returns
    -------
    covariance
        Shape (chosen + scatter, chosen + scatter), m² or rad².
    """
    information = _information(observed, linear, names, spread)
    chosen_first = [*(list(names).index(n) for n in chosen), *range(len(names), len(information))]
    scale = np.concatenate([tolerances_of(chosen, observed.profile), spread])
    covariance = linalg.inv(information[np.ix_(chosen_first, chosen_first)])[: scale.size, : scale.size]
    covariance = 0.5 * (covariance + covariance.T)
    return np.asarray(covariance * np.outer(scale, scale))


def _in_words(name: str, alike: Sequence[tuple[float, str]]) -> str:
    """Say which combination is not known of an error that moves the transmission error as others do."""
    if len(alike) == 1 and abs(abs(alike[0][0]) - 1.0) < 0.05:
        (share, other), *_ = alike
        way, left = ("alike", "sum") if share > 0 else ("oppositely", "difference")
        return f"{name} and {other} move the transmission error {way}; only their {left} is known"
    # Moving the error by one and the others against what it does changes nothing.
    return f"+1.00 {name} {' '.join(f'{-share:+.2f} {other}' for share, other in alike)} is not known from these data"


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
