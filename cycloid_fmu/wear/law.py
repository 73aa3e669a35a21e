"""Input of a wear run: the wear file `cycloid-wear/1` and the duty cycle, a table of torques and crank turns."""

from __future__ import annotations

import math
import os
from typing import Annotated, Literal

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.sizes import PositiveLength
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT

FORMAT = "cycloid-wear/1"
_ABOVE_ZERO = pydantic.Field(gt=0.0)


class Regression(edge.Config):
    """Inputs of the wear coefficient's regression; none has a default, because k_0 is proportional to α^-7.4.

    Attributes
    ----------
    pressure_viscosity
        The lubricant's pressure-viscosity coefficient α, 1/Pa.
    roughness_gear, roughness_pin
        Arithmetic mean roughness Ra, m.
    """

    pressure_viscosity: Annotated[edge.PressureViscosity, _ABOVE_ZERO]
    roughness_gear: PositiveLength
    roughness_pin: PositiveLength


class Load(edge.Config):
    """One row of a duty cycle.

    Attributes
    ----------
    torque
        Torque of the environment on the output, N·m.
    crank_turns
        Crank turns under this torque.
    """

    torque: edge.Torque
    crank_turns: float = pydantic.Field(ge=0.0, allow_inf_nan=False)


class WearLaw(edge.Config):
    """How flanks and pins wear.

    Attributes
    ----------
    pins
        "fixed": a pin wears where contacts pass over it; "free": it turns in its hole and wears evenly.
    largest_step
        Largest wear of any element before the contact is solved again, m.
    coefficient, regression
        Either a constant wear coefficient k_0, m²/N, or the inputs of its regression.
    limit
        Depth at which the drive is worn out, m; None for 5 % of the tooth's thickness.
    friction_coefficient
        Coefficient of the sliding surfaces, for friction work and loss; None if not needed or in the pair's [losses].
    duty
        The duty cycle, if the wear file states it.
    """

    pins: Literal["fixed", "free"]
    largest_step: PositiveLength = 1e-6
    coefficient: Annotated[edge.WearCoefficient, _ABOVE_ZERO] | None = None
    regression: Regression | None = None
    limit: Annotated[edge.Length, pydantic.Field(gt=0.0, le=LARGEST_ELEMENT)] | None = None
    friction_coefficient: float | None = pydantic.Field(default=None, ge=0.0, le=1.0)
    duty: tuple[Load, ...] = ()

    @pydantic.model_validator(mode="after")
    def _one_coefficient(self) -> WearLaw:
        if (self.coefficient is None) == (self.regression is None):
            raise ValueError(
                'either coefficient = "1e-18 m^2/N" or a table [wear.regression] with pressure_viscosity, '
                "roughness_gear and roughness_pin is needed"
            )
        return self


class _WearFile(edge.Config):
    """A wear law, and the duty where it is stated here."""

    wear: WearLaw


def parse_wear_law(text: str, source: str) -> WearLaw:
    """Return the wear law of a TOML text; an `edge.InputError` names the invalid entries."""
    return edge.validated(_WearFile, edge.toml_table(text, FORMAT, source), source).wear


def read_wear_law(path: str | os.PathLike[str]) -> WearLaw:
    """Return the wear law of a wear file; an `edge.InputError` names the invalid entries."""
    return parse_wear_law(edge.read_text(path, FORMAT), str(path))


def duty_cycle(
    law: WearLaw,
    torque: float | None,
    crank_turns: float | None,
    duty_file: str | os.PathLike[str] | None,
    source: str,
    pair: Pair,
    pair_source: str = "the pair",
) -> tuple[tuple[Load, ...], float]:
    """Return the loads of a run and its crank turns: one torque, or the duty cycle of a file or of the wear file.

    Without any of them the load is the rated torque. A duty cycle is repeated so many times that its loads wear
    together, each by its share of the turns.

    Raises
    ------
    edge.InputError
        If loads are stated twice or not at all, or the turns are missing, negative or not finite.
    """
    stated = {
        "a torque": torque is not None,
        f"the duty cycle {duty_file}": duty_file is not None,
        "[[wear.duty]]": bool(law.duty),
    }
    places = [name for name, given in stated.items() if given]
    if len(places) > 1:
        raise edge.InputError(f"{source}: {' and '.join(places)} state the load; keep one of them.")
    if not places:
        torque = pair.rated_load(pair_source)
    if crank_turns is not None and not 0.0 <= crank_turns < math.inf:
        raise edge.ArgumentError("crank_turns", "it must be zero or above, and finite", crank_turns)
    if torque is not None:
        if crank_turns is None:
            raise edge.ArgumentError("crank_turns", "is missing; one torque does not determine the duration")
        return (Load(torque=torque, crank_turns=1.0),), crank_turns
    loads = law.duty if duty_file is None else read_duty_cycle(duty_file)
    total = sum(load.crank_turns for load in loads)
    if not total > 0.0:
        raise edge.InputError(
            f"{source}: crank_turns of [[wear.duty]] add up to zero; a duty cycle must turn the crank."
        )
    return loads, total if crank_turns is None else crank_turns


def read_duty_cycle(path: str | os.PathLike[str]) -> tuple[Load, ...]:
    """Read a duty cycle: CSV with the header `torque [N*m],crank_turns [1]` (any unit of torque), a row for each load.

    Raises
    ------
    edge.InputError
        If a column or its unit is missing, a value is not a number, turns are negative, or their sum is zero.
    """
    loads = []
    for number, values in edge.number_rows(path, {"torque": "N*m", "crank_turns": "1"}):
        if values["crank_turns"] < 0.0:
            raise edge.InputError(
                f"{path}: line {number}: crank_turns = {values['crank_turns']:g}: it must not be below zero."
            )
        loads.append(Load(torque=values["torque"], crank_turns=values["crank_turns"]))
    if not sum(load.crank_turns for load in loads) > 0.0:
        raise edge.InputError(f"{path}: crank_turns add up to zero; a duty cycle must turn the crank.")
    return tuple(loads)
