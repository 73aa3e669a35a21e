"""A result of a fit: value, standard error, interval, and the reason if it is held fixed."""

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
    """One error after the fit: SI value, standard error and 95 % interval, or the reason why it is held fixed.

    The interval is NaN if the verdict is that the errors do not explain the curves; the standard error is then that of
    the fit alone.

    `form` is the possible effect of a form that all flanks share: a standard deviation, included in the standard error.

    `data_share` is the share of information from the data: 1 minus the ratio of its variance after and before
    measuring.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]
    data_share: float
    held: str | None = None
    form: float = 0.0

    def times(self, factor: float) -> Parameter:
        """Return the same of a share with another reference; its standard error is of the logarithm."""
        low, high = self.interval
        return dataclasses.replace(self, value=self.value * factor, interval=(low * factor, high * factor))


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
        Half the interval in standard errors.
    """
    interval = (value - quantile * standard_error, value + quantile * standard_error)
    share = max(1.0 - (standard_error / before) ** 2, 0.0)
    return Parameter(name, unit, value, standard_error, interval, share, held)


def withheld(one: Parameter) -> Parameter:
    """The same without an interval, for curves that are not explained."""
    return one if one.held else dataclasses.replace(one, interval=(math.nan, math.nan))


def parameter_as_json(one: Parameter) -> dict[str, Any]:
    """Return it as in a `cycloid-identification/1` file."""
    fields = dataclasses.asdict(one)
    return {**fields, "interval": list(one.interval), "held": one.held or False}
