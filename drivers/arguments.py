"""Arguments of the library's functions: SI numbers or text with a unit."""

from __future__ import annotations

import math

from cycloid_fmu import edge


def in_si(value: float | str, si: str, argument: str, *, above: float = -math.inf, least: float = -math.inf) -> float:
    """Return a quantity in SI units, given as an SI number or as text with a unit, such as "20 N*m".

    Parameters
    ----------
    value
        The SI number or the text.
    si
        The SI unit, such as "N*m".
    argument
        Name of the argument, for the error.
    above, least
        The value must be greater than `above` and at least `least`, in SI units.

    Raises
    ------
    edge.ArgumentError
        If the text is no such quantity, or the value is outside these limits.
    """
    try:
        number = edge.parse_quantity(value, si) if isinstance(value, str) else float(value)
    except ValueError as problem:
        raise edge.ArgumentError(argument, str(problem), value) from None
    if not (number > above and number >= least):
        limit = f"be above {above:g}" if above > -math.inf else f"not be below {least:g}"
        raise edge.ArgumentError(argument, f"it must {limit}", value)
    return number
