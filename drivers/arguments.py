"""Arguments of the library's functions: SI numbers or text with a unit."""

from __future__ import annotations

import math

from cycloid_fmu import edge


def in_si(value: float | str, si: str, argument: str, *, above: float = -math.inf, least: float = -math.inf) -> float:
    """Return a quantity in SI units, given as a number in these or as text with its unit, such as "20 N*m".

    Raises
    ------
    edge.ArgumentError
        If the text is not such a quantity, or is not above `above` or is below `least`.
    """
    try:
        number = edge.parse_quantity(value, si) if isinstance(value, str) else float(value)
    except ValueError as problem:
        raise edge.ArgumentError(argument, str(problem), value) from None
    if not (number > above and number >= least):
        limit = f"be above {above:g}" if above > -math.inf else f"not be below {least:g}"
        raise edge.ArgumentError(argument, f"it must {limit}", value)
    return number
