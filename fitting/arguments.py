"""Arguments of the library's functions: SI numbers or text with a unit."""

from __future__ import annotations

import math
import numbers

from cycloid_fmu import edge


def check_ratio(ratio: float | None) -> None:
    """Raise an `edge.ArgumentError` if a given ratio is zero or not finite."""
    if ratio is not None and not (math.isfinite(ratio) and ratio):
        raise edge.ArgumentError("ratio", f"give the signed ratio input/output: {edge.RATIO}", ratio)


def positive(value: float | str, si: str, argument: str, *, zero: bool = False) -> float:
    """Return a positive quantity in SI units.

    Parameters
    ----------
    value
        SI number, or text with a unit such as "181 N*m".
    si
        The SI unit.
    argument
        Name of the argument, for the error.
    zero
        Whether zero is allowed.

    Raises
    ------
    edge.ArgumentError
        If it is no such quantity.
    """
    try:
        number = float(value) if isinstance(value, numbers.Real) else edge.parse_quantity(value, si)
    except ValueError as problem:
        raise edge.ArgumentError(argument, str(problem), value) from None
    if not (math.isfinite(number) and (number > 0.0 or (zero and number == 0.0))):
        raise edge.ArgumentError(argument, f"it must be {'zero or ' if zero else ''}above zero", value)
    return number
