"""A number that a fit states: value, standard error, interval, and why it is held where it is."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

CONFIDENCE = 0.95
NORMAL = float(stdtrit(np.inf, 0.5 + 0.5 * CONFIDENCE))  # standard errors in half an interval


@dataclass(frozen=True)
class Parameter:
    """One error after the fit: SI value, standard error and 95 % interval, or why it is held.

    The interval is NaN where the verdict is that the errors do not explain the curves; the standard error is the fit's
    alone.

    `form` is how far a form that all flanks share may have moved it: a standard deviation, which the standard error
    holds.

    `data_share` says how much of what is known of it comes from the data: 1 minus the ratio of its variance after and
    before measuring.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]
    data_share: float
    held: str | None = None
    form: float = 0.0


def parameter(
    name: str,
    unit: str,
    value: float,
    standard_error: float,
    before: float,
    held: str | None = None,
    quantile: float = NORMAL,
) -> Parameter:
    """Return an error with its interval.

    Parameters
    ----------
    name, unit, value, standard_error, held
        As in `Parameter`.
    before
        Its standard deviation before measuring.
    quantile
        Standard errors in half an interval.
    """
    interval = (value - quantile * standard_error, value + quantile * standard_error)
    share = max(1.0 - (standard_error / before) ** 2, 0.0)
    return Parameter(name, unit, value, standard_error, interval, share, held)


def withheld(one: Parameter) -> Parameter:
    """The same without an interval, where the curves are not explained."""
    return one if one.held else dataclasses.replace(one, interval=(math.nan, math.nan))


def parameter_as_json(one: Parameter) -> dict[str, Any]:
    """Return it as in a `cycloid-identification/1` file."""
    fields = dataclasses.asdict(one)
    return {**fields, "interval": list(one.interval), "held": one.held or False}
