"""Errors that measurements resolve, and the reason for each other error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from fitting.model.gaussian import Evidence, Gaussian
from fitting.model.observations import ORDERS, Linear, Observations
from fitting.model.unknowns import Unknowns

Array = NDArray[np.float64]

# Of each set of errors with the same effect on the transmission error the first is fitted (docs/theory/errors.md);
# errors that are not listed come last.
PREFERENCE = (
    "centre_distance_x",
    "centre_distance_y",
    "pin_radius",
    "pin_circle_radius",
    "eccentricity",
    *(f"{p}_{k}_{w}" for k in (2, 3) for p in ("pin_radial", "pin_tangential") for w in ("cos", "sin")),
    *(f"tooth_cumulative_pitch_{k}_{w}" for k in ORDERS for w in ("cos", "sin")),
    *(f"{p}_1_{w}" for p in ("pin_tangential", "pin_radial") for w in ("cos", "sin")),
    "isometric",
    "offset",
    "misalignment_xz",
    "misalignment_yz",
)
_STOOD_FOR = 2e-3  # relative remainder of an effect below which the other errors reproduce it completely
KNOWN = 0.2  # an error is known if its uncertainty is below this share of its tolerance


def choose(information: Array, names: Sequence[str]) -> list[str]:
    """Choose the errors that the data resolve.

    Parameters
    ----------
    information
        Information matrix of the structured errors, scaled by their tolerances.
    names
        The structured errors in the matrix' order.

    Returns
    -------
    names
        In the order of `PREFERENCE`, then of `names`: an error is added if all chosen errors remain known to `KNOWN` of
        their tolerance.
    """
    chosen: list[int] = []
    for name in (*(n for n in PREFERENCE if n in names), *(n for n in names if n not in PREFERENCE)):
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


def chosen_errors(pair: Pair, observed: Observations, linear: Linear, sizes: Mapping[str, float]) -> list[str]:
    """Choose the errors that observations resolve, in their order; orders of the profile are always included.

    Like the scatter, these orders have a prior size and add uncertainty to the other errors.

    Parameters
    ----------
    pair, observed, linear
        The nominal pair, the observations and the model at a state.
    sizes
        Standard deviation of each scattered pattern, m; of those that are not named it is the usual one, or none.
    """
    unknowns = Unknowns(pair, observed, observed.errors)
    evidence = Evidence.of(unknowns.columns(observed, linear))
    return chosen_from(unknowns, observed, evidence.posterior(unknowns.precision(sizes)))


def chosen_of(pair: Pair, observed: Observations, linear: Linear) -> list[str]:
    """Choose the errors to fit: those that observations resolve, as far as a user has not decided.

    Without the scatter of single pins and teeth, which widens the intervals: a scatter that has absorbed held errors
    would keep them held, and fitted errors of nearly the same effect would absorb the rest.

    Raises
    ------
    edge.InputError
        If it is none.
    """
    chosen, decided = chosen_errors(pair, observed, linear, {}), observed.constraints
    if decided is not None:
        own = {*decided.free, *decided.ties}
        chosen = [n for n in observed.errors if n in own or (n in chosen and n not in decided.held)]
    if not chosen:
        raise edge.InputError("the data resolve none of the structured errors; record more loads or more turns.")
    return chosen


def chosen_from(unknowns: Unknowns, observed: Observations, posterior: Gaussian) -> list[str]:
    """Return the same from the distribution of all errors of the observations, the nuisances and the scatter."""
    free = [i for i, n in enumerate(unknowns.chosen) if n not in observed.profile]
    # Information about the errors that remains with unknown scatter, form and nuisances.
    known = posterior.marginal(free).information
    resolved = choose(known, [unknowns.chosen[i] for i in free])
    return [n for n in unknowns.chosen if n in resolved or n in observed.profile]


def weakness(
    pair: Pair, observed: Observations, linear: Linear, chosen: Sequence[str]
) -> tuple[Array, tuple[str, ...], dict[str, str], tuple[str, ...]]:
    """Return what the data cannot resolve.

    Returns
    -------
    singular_values
        Singular values of the Jacobian scaled by tolerance and noise, with the nuisances projected out.
    weak_combinations
        Combinations of errors with an uncertainty above `KNOWN` of their tolerance, as text: one for each error that is
        not chosen.
    reasons
        {name: reason} for every error that is not chosen.
    beside
        Errors not chosen whose effect on the curves differs at least a little from that of the chosen ones: held errors
        may bias these. Of a set with equal effects it has the first.
    """
    unknowns, names = Unknowns(pair, observed, observed.errors), observed.errors
    every, precision = unknowns.columns(observed, linear), unknowns.precision({})[unknowns.nuisances]
    # A nuisance with a prior is an additional measurement of itself.
    rows = np.vstack([every[:, unknowns.nuisances], np.diag(np.sqrt(precision))])
    q, _ = np.linalg.qr(rows / np.linalg.norm(rows, axis=0))
    columns = np.vstack([every[:, unknowns.errors], np.zeros((precision.size, len(names)))])
    columns = columns - q @ (q.T @ columns)
    singular = np.linalg.svd(columns, compute_uv=False)
    keep = [list(names).index(n) for n in chosen]
    weak, reasons = [], {}
    beside: list[str] = []
    for i, name in enumerate(names):
        if i in keep:
            continue
        length = float(np.linalg.norm(columns[:, i]))
        if length < 1.0:
            reasons[name] = "it has no effect on these transmission errors"
            weak.append(f"{name} is not known from these data")
            continue
        share, *_ = np.linalg.lstsq(columns[:, keep], columns[:, i], rcond=None)
        residual = float(np.linalg.norm(columns[:, i] - columns[:, keep] @ share)) / length
        leading = [
            j
            for j in np.argsort(-np.round(np.abs(share), 2), kind="stable")
            if abs(share[j]) > 0.2 * np.abs(share).max()
        ][:4]
        alike = " ".join(f"{share[j]:+.2f} {chosen[j]}" for j in leading)
        if residual < 0.05:
            reasons[name] = f"its effect on the transmission errors is that of {alike}"
        else:
            reasons[name] = f"these data do not separate it from {alike}"
        weak.append(_in_words(name, [(float(share[j]), chosen[j]) for j in leading]))
        others = columns[:, [*keep, *(list(names).index(n) for n in beside)]]
        rest = columns[:, i] - others @ np.linalg.lstsq(others, columns[:, i], rcond=None)[0]
        if float(np.linalg.norm(rest)) > _STOOD_FOR * length:
            beside.append(name)
    return singular, tuple(weak), reasons, tuple(beside)


def posterior_covariance(
    pair: Pair, observed: Observations, linear: Linear, chosen: Sequence[str], sizes: Mapping[str, float]
) -> Array:
    """Covariance of the chosen errors and of the scatter of every pin and tooth, the nuisances unknown.

    Parameters
    ----------
    pair, observed, linear, sizes
        As in `chosen_errors`.
    chosen
        The fitted errors; they have no prior.

    Returns
    -------
    covariance
        Shape (chosen + scatter, chosen + scatter), m² or rad².
    """
    unknowns = Unknowns(pair, observed, chosen)
    evidence = Evidence.of(unknowns.columns(observed, linear))
    return covariance_of(unknowns, evidence.posterior(unknowns.precision(sizes)))


def covariance_of(unknowns: Unknowns, posterior: Gaussian) -> Array:
    """Return the same from a distribution of the unknowns in their scale."""
    own = np.r_[unknowns.errors, unknowns.scatter]
    covariance: Array = posterior.covariance[np.ix_(own, own)] * np.outer(unknowns.scale[own], unknowns.scale[own])
    return covariance


def _in_words(name: str, alike: Sequence[tuple[float, str]]) -> str:
    """Return the unresolved combination of an error with the same effect as others."""
    if len(alike) == 1 and abs(abs(alike[0][0]) - 1.0) < 0.05:
        (share, other), *_ = alike
        way, left = ("the same effect", "sum") if share > 0 else ("opposite effects", "difference")
        return f"{name} and {other} have {way} on the transmission error; only their {left} is known"
    # The error changed by one, and the others changed so that they cancel its effect.
    return f"+1.00 {name} {' '.join(f'{-share:+.2f} {other}' for share, other in alike)} is not known from these data"
