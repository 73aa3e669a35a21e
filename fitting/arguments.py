"""Arguments as a caller of the front door gives them: numbers in SI units or text with a unit, a drive or its ratio."""

from __future__ import annotations

import math
import numbers

from cycloid_fmu import edge


def wrong(argument: str, problem: str, value: object) -> edge.InputError:
    """Return the error for an argument that can't be used; `problem` says what is allowed."""
    return edge.InputError(f"{argument} = {value}: {problem}.")


def si_value(value: float | str, si: str, argument: str, *, above: float = -math.inf) -> float:
    """Return a quantity given as a number in SI units or as text with a unit, such as "181 N*m".

    Parameters
    ----------
    value, si, argument
        What was given, the SI unit and the argument's name.
    above
        The value must be larger.

    Raises
    ------
    edge.InputError
        If it is no such quantity, not finite or not above the limit.
    """
    try:
        found = float(value) if isinstance(value, numbers.Real) else edge.parse_quantity(value, si)
    except ValueError as problem:
        raise wrong(argument, str(problem), value) from None
    if not (math.isfinite(found) and found > above):
        limit = "zero" if abs(above) < 1e-200 else f"{above:g} {si}"
        raise wrong(argument, f"it must be finite and {'not below' if above < 0.0 else 'above'} {limit}", value)
    return found
