"""Errors that measurements resolve, and the reason for each other error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitting.model.gaussian import Gaussian
from fitting.model.observations import ORDERS, Linear, Observations, nuisance_columns
from fitting.model.prior import tolerances_of

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
UNKNOWN = 1e-6  # precision of unknowns without a prior, so that those without effect on these curves stay unchanged
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


def chosen_errors(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> list[str]:
    """Choose the errors that observations resolve, in the order of `names`; orders of the profile are always included.

    Like the scatter, these orders have a prior size and add uncertainty to the other errors.

    Parameters
    ----------
    observed, linear, names
        The observations and the model at a state.
    spread
        Standard deviation of each scattered displacement of a pin or tooth, m.
    """
    information = _information(observed, linear, names, spread)
    free = [n not in observed.profile for n in names]
    own = np.flatnonzero([*free, *np.zeros(len(information) - len(names), bool)])
    # Information about the errors that remains with unknown scatter, form and nuisances.
    known = Gaussian(information).marginal(own).information
    found = choose(known, [n for n, one in zip(names, free, strict=True) if one])
    return [n for n in names if n in found or n in observed.profile]


def _information(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> Array:
    """Information matrix of errors, scatter and nuisances, each in units of its prior.

    Scatter, the orders of the profile and some nuisances have a prior; the errors and the other nuisances do not.
    """
    return information_of_points(observed, linear, names, spread) + known_before(observed, linear, names, spread)


def information_of_points(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> Array:
    """Return the information of the points on errors, scatter and nuisances; information of curves is additive.

    Returns
    -------
    information
        Shape (unknowns, unknowns), each in units of its prior: errors as `names`, scatter, nuisances.
    """
    nuisances, priors = nuisance_columns(observed, linear)
    columns = np.column_stack([linear.structured, linear.scatter, nuisances])
    columns *= observed.weight[:, None]
    columns *= np.concatenate(
        [
            tolerances_of(names, observed.profile),
            spread,
            np.where(np.isfinite(priors), priors, 1e-4),
        ]
    )
    information: Array = columns.T @ columns
    return information


def known_before(observed: Observations, linear: Linear, names: Sequence[str], spread: Array) -> Array:
    """Return the prior information on errors, scatter and nuisances, shape (unknowns, unknowns)."""
    _, priors = nuisance_columns(observed, linear)
    stated = np.array([float(n in observed.profile) for n in names])
    return np.diag(np.concatenate([stated, np.ones(spread.size), np.where(np.isfinite(priors), 1.0, UNKNOWN)]))


def weakness(
    observed: Observations, linear: Linear, names: Sequence[str], chosen: Sequence[str]
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
    weight = observed.weight[:, None]
    nuisances, priors = nuisance_columns(observed, linear)
    # A nuisance with a prior is an additional measurement of itself.
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
        left = float(np.linalg.norm(columns[:, i] - columns[:, keep] @ share)) / length
        leading = [
            j
            for j in np.argsort(-np.round(np.abs(share), 2), kind="stable")
            if abs(share[j]) > 0.2 * np.abs(share).max()
        ][:4]
        alike = " ".join(f"{share[j]:+.2f} {chosen[j]}" for j in leading)
        if left < 0.05:
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
    observed: Observations, linear: Linear, names: Sequence[str], chosen: Sequence[str], spread: Array
) -> Array:
    """Covariance of the chosen errors and of the scatter of every pin and tooth, the nuisances unknown.

    Parameters
    ----------
    chosen
        The fitted errors; they have no prior.
    spread
        Prior standard deviation of each scattered displacement, m.

    Returns
    -------
    covariance
        Shape (chosen + scatter, chosen + scatter), m² or rad².
    """
    return covariance_from(_information(observed, linear, names, spread), observed, names, chosen, spread)


def covariance_from(
    information: Array, observed: Observations, names: Sequence[str], chosen: Sequence[str], spread: Array
) -> Array:
    """Return the same covariance as `posterior_covariance` from given information."""
    chosen_first = [*(list(names).index(n) for n in chosen), *range(len(names), len(information))]
    scale = np.concatenate([tolerances_of(chosen, observed.profile), spread])
    covariance = Gaussian(information[np.ix_(chosen_first, chosen_first)]).covariance[: scale.size, : scale.size]
    return np.asarray(covariance * np.outer(scale, scale))


def _in_words(name: str, alike: Sequence[tuple[float, str]]) -> str:
    """Return the unresolved combination of an error with the same effect as others."""
    if len(alike) == 1 and abs(abs(alike[0][0]) - 1.0) < 0.05:
        (share, other), *_ = alike
        way, left = ("the same effect", "sum") if share > 0 else ("opposite effects", "difference")
        return f"{name} and {other} have {way} on the transmission error; only their {left} is known"
    # The error changed by one, and the others changed so that they cancel its effect.
    return f"+1.00 {name} {' '.join(f'{-share:+.2f} {other}' for share, other in alike)} is not known from these data"
