"""Conformity of figures with limits under a stated decision rule, for the certificate of a drive."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import pydantic

from cycloid_fmu import edge
from fitting.figures.figure import unit_of_figure
from fitting.figures.metrics import Figures

FORMAT = "cycloid-certificate/1"
LOWER = ("torsional_stiffness",)  # figures for which a single limit is the minimum
Verdict = Literal["pass", "fail", "undecided"]
Rule = Literal["guard band", "simple acceptance"]
RULES = {
    "guard band": "Guard band of the expanded uncertainty U (ISO 14253-1, ILAC-G8): a figure passes if its value meets "
    "the limit by at least U, fails if it violates the limit by more than U, and is otherwise undecided.",
    "simple acceptance": "Simple acceptance (ILAC-G8): a figure passes if its value meets the limit, regardless of U; "
    "near the limit up to half of the decisions are wrong.",
}


class Device(edge.Config):
    """The measured drive.

    Attributes
    ----------
    name
        Type of the drive.
    serial_number
        Serial number of the drive.
    maker
        Manufacturer.
    """

    name: str
    serial_number: str
    maker: str = ""


class Limit(edge.Config):
    """Limits of one figure.

    Attributes
    ----------
    min, max
        Text with a unit, such as "1 arcmin" or "45 N*m/arcmin"; at least one of the two.
    """

    min: str | None = None
    max: str | None = None

    @pydantic.model_validator(mode="after")
    def _states_one(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("state min, max or both")
        return self

    def bounds(self, unit: str) -> tuple[float, float]:
        """Return the smallest and largest permitted value, SI; `unit`: the figure's SI unit."""
        low = -math.inf if self.min is None else edge.parse_quantity(self.min, unit)
        high = math.inf if self.max is None else edge.parse_quantity(self.max, unit)
        return low, high


class Certificate(edge.Config):
    """Content of a certificate in addition to the figures.

    Attributes
    ----------
    number
        Number of the certificate.
    issued_by
        Issuing laboratory or person.
    device
        The measured drive.
    conditions
        Conditions of the measurement: {name: text}, such as ambient temperature, lubricant, running in.
    decision_rule
        "guard band" (ISO 14253-1) or "simple acceptance" (both ILAC-G8).
    limits
        {figure: limits}: a single text (the largest permitted value, for the torsional stiffness the smallest), or min
        and max.
    """

    number: str = ""
    issued_by: str = ""
    device: Device
    conditions: dict[str, str] = pydantic.Field(default_factory=dict)
    decision_rule: Rule
    limits: dict[str, Limit]

    @pydantic.field_validator("limits", mode="before")
    @classmethod
    def _of_one_side(cls, given: Any) -> Any:
        """Convert a limit of a single text to the figure's upper or lower limit, as in a requirements file."""
        if not isinstance(given, Mapping):
            return given
        sides = {True: "min", False: "max"}
        return {name: {sides[name in LOWER]: v} if isinstance(v, str) else v for name, v in given.items()}

    @pydantic.field_validator("limits")
    @classmethod
    def _of_figures(cls, given: dict[str, Limit]) -> dict[str, Limit]:
        for name, limit in given.items():
            unit = unit_of_figure(name)
            try:
                low, high = limit.bounds(unit)
            except ValueError as problem:
                raise ValueError(f"{name}: {problem}") from None
            if low > high:
                raise ValueError(f"{name}: min is above max")
        return given


def read_certificate(path: str | os.PathLike[str]) -> Certificate:
    """Read the content of a certificate from a TOML file, `cycloid-certificate/1`.

    Raises
    ------
    edge.InputError
        If the file can't be read or is invalid; one sentence for each problem.
    """
    return edge.validated(Certificate, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path)), str(path))


def decide(value: float, expanded: float, low: float, high: float, rule: Rule) -> Verdict:
    """Return whether a value meets its limits.

    Parameters
    ----------
    value, expanded
        The figure and its expanded uncertainty U (95 %); NaN if U is unknown.
    low, high
        Limits in the same unit; infinite if there is none.
    rule
        Guard band (ISO 14253-1): conformity is proved if value ± U is inside the limits, non-conformity if it is
        outside. Simple acceptance: only the value counts.

    Examples
    --------
    >>> [decide(value, 0.1, 0.0, 1.0, "guard band") for value in (0.8, 0.95, 1.05, 1.2)]
    ['pass', 'undecided', 'undecided', 'fail']
    >>> [decide(value, 0.1, 0.0, 1.0, "simple acceptance") for value in (0.95, 1.05)]
    ['pass', 'fail']
    """
    guard = expanded if rule == "guard band" else 0.0
    if low + guard <= value <= high - guard:
        return "pass"
    if value < low - guard or value > high + guard:
        return "fail"
    return "undecided"


@dataclass(frozen=True)
class Decision:
    """The decision on one figure.

    Attributes
    ----------
    figure, unit
        Name of the figure, and its SI unit.
    value, expanded, coverage_factor
        Value, expanded uncertainty U, SI, and coverage factor k; NaN if the figure or its budget is missing.
    low, high
        Limits, SI; infinite if there is none.
    verdict
        Verdict under the certificate's decision rule; a missing figure is undecided; "" without limits.
    """

    figure: str
    unit: str
    value: float
    expanded: float
    coverage_factor: float
    low: float = -math.inf
    high: float = math.inf
    verdict: Verdict | Literal[""] = ""


def decisions_of(figures: Figures, certificate: Certificate) -> list[Decision]:
    """Return the decision on each figure that has a limit, with the expanded uncertainty of its budget."""
    decisions = []
    for name, limit in certificate.limits.items():
        low, high = limit.bounds(unit_of_figure(name))
        figure, budget = figures.figures.get(name), figures.budgets.get(name)
        value = math.nan if figure is None else figure.value
        expanded, factor = (math.nan, math.nan) if budget is None else (budget.expanded, budget.coverage_factor)
        verdict = decide(value, expanded, low, high, certificate.decision_rule)
        decisions.append(Decision(name, unit_of_figure(name), value, expanded, factor, low, high, verdict))
    return decisions


def verdict_of(decisions: Sequence[Decision]) -> Verdict:
    """Return the verdict on the drive: fail if one figure fails, undecided if none fails and one is undecided."""
    verdicts = {decision.verdict for decision in decisions}
    return "fail" if "fail" in verdicts else "pass" if verdicts == {"pass"} else "undecided"
