"""Limits of the sizes of a drive: a length beyond them almost certainly has a wrong unit.

Drives in catalogues and papers have pin circles of about 10 mm to 500 mm radius. The limits, chosen here, are a factor
of ten beyond, so that metres or micrometres instead of millimetres are detected.
"""

from __future__ import annotations

from typing import Annotated, Any

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Length, format_quantity
from cycloid_fmu.edge.quantities import EXAMPLES


def _positive(value: float) -> float:
    if not value > 0.0:
        raise ValueError("it must be above zero")
    return value


def _between(least: float, most: float) -> tuple[pydantic.AfterValidator, Any]:
    """Return the validator of a length between two limits, m."""
    low, high = (format_quantity(limit, "m", "mm" if limit < 1.0 else "m") for limit in (least, most))

    def check(value: float) -> float:
        if not least <= value <= most:
            raise ValueError(f"it must be between {low} and {high}")
        return value

    said: dict[str, Any] = {"quantity": EXAMPLES["m"], "si": "m", "limits": f"{low} … {high}"}
    return pydantic.AfterValidator(check), pydantic.Field(json_schema_extra=said)


ABOVE_ZERO = pydantic.AfterValidator(_positive)
PositiveLength = Annotated[Length, ABOVE_ZERO]
PositivePressure = Annotated[edge.Pressure, ABOVE_ZERO]
CircleRadius = Annotated[Length, *_between(1e-3, 5.0)]
"""Radius of the circle of pins, cranks, output rollers or similar parts."""
PinRadius = Annotated[Length, *_between(20e-6, 0.5)]
Eccentricity = Annotated[Length, *_between(10e-6, 0.25)]
Width = Annotated[Length, *_between(0.1e-3, 2.0)]
"""Face width of a gear, and length of a bearing's roller."""
Dimension = Annotated[Length, *_between(20e-6, 5.0)]
"""Radius, diameter or width of a part or of a hole in it."""
Module = Annotated[Length, *_between(0.05e-3, 60e-3)]
"""Module of involute gears: the series of DIN 780-1."""
