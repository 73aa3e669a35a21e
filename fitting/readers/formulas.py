"""Formulas of measurement files: parsed by a small grammar and computed in double precision, never run as code."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LONGEST = 300  # characters
_DEEPEST = 30  # levels of nested brackets and signs
_SYMBOL = re.compile(
    r"\s*(?:(?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z]\w*)|(?P<sign>\*\*|[-+*/(),]))"
)
# "log" and "^" are left out as ambiguous: natural or decimal logarithm, power or exclusive or.
_FUNCTIONS: dict[str, tuple[int, Callable[..., Array]]] = {
    "abs": (1, np.abs),
    "sqrt": (1, np.sqrt),
    "exp": (1, np.exp),
    "ln": (1, np.log),
    "log10": (1, np.log10),
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "tan": (1, np.tan),
    "asin": (1, np.arcsin),
    "acos": (1, np.arccos),
    "atan": (1, np.arctan),
    "arcsin": (1, np.arcsin),
    "arccos": (1, np.arccos),
    "arctan": (1, np.arctan),
    "sinh": (1, np.sinh),
    "cosh": (1, np.cosh),
    "tanh": (1, np.tanh),
    "pow": (2, np.power),
}
_SIGNS: dict[str, Callable[[Array, Array], Array]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "**": np.power,
}

Part = Callable[[Array], Array]


@dataclass(frozen=True)
class Formula:
    """A formula of one variable, X or X1: numbers, ``+ - * / **``, brackets and the usual functions.

    Parameters
    ----------
    text
        As in the file; 300 characters at most.

    Raises
    ------
    ValueError
        If the text is no such formula.

    Examples
    --------
    >>> Formula("2 * X + sqrt(X1) / 4")([0.0, 4.0]).tolist()
    [0.0, 8.5]
    """

    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "_compute", _Reader(self.text).formula())

    def __call__(self, x: ArrayLike) -> Array:
        """Return the values of the formula, of the shape of `x`; NaN where it is undefined."""
        given = np.asarray(x, dtype=float)
        compute: Part = self._compute  # type: ignore[attr-defined]
        with np.errstate(all="ignore"):
            return np.broadcast_to(compute(given), given.shape).astype(float)


class _Reader:
    """Recursive-descent parser; each method parses the part that it is named after."""

    def __init__(self, text: str) -> None:
        if len(text) > LONGEST:
            raise ValueError(f"it is longer than {LONGEST} characters")
        self._left: list[tuple[str, str]] = []
        position, end = 0, len(text.rstrip())
        while position < end:
            symbol = _SYMBOL.match(text, position)
            if symbol is None:
                raise ValueError(f'"{text[position:].strip()[:10]}" is not part of a formula')
            self._left.append((str(symbol.lastgroup), str(symbol[str(symbol.lastgroup)])))
            position = symbol.end()
        self._depth = 0

    def formula(self) -> Part:
        part = self._sum()
        if self._left:
            raise ValueError(f'unexpected "{self._left[0][1]}"')
        return part

    def _sign(self, *wanted: str) -> str:
        """Consume and return one of these signs if it is next, else ""."""
        if self._left and self._left[0][0] == "sign" and self._left[0][1] in wanted:
            return self._left.pop(0)[1]
        return ""

    def _need(self, sign: str) -> None:
        if not self._sign(sign):
            raise ValueError(f'"{sign}" is missing')

    def _sum(self) -> Part:
        part = self._product()
        while sign := self._sign("+", "-"):
            part = _joined(sign, part, self._product())
        return part

    def _product(self) -> Part:
        part = self._signed()
        while sign := self._sign("*", "/"):
            part = _joined(sign, part, self._signed())
        return part

    def _signed(self) -> Part:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError("it is nested too deeply")
        try:
            if sign := self._sign("+", "-"):
                part = self._signed()
                return part if sign == "+" else lambda x: np.negative(part(x))
            base = self._value()
            return _joined("**", base, self._signed()) if self._sign("**") else base
        finally:
            self._depth -= 1

    def _value(self) -> Part:
        if self._sign("("):
            part = self._sum()
            self._need(")")
            return part
        kind, text = self._left.pop(0) if self._left else ("", "")
        if kind == "number":
            number = np.array(float(text))
            return lambda x: number
        if kind == "name" and text.upper() in ("X", "X1"):
            return lambda x: x
        if kind == "name" and text.lower() in _FUNCTIONS:
            count, function = _FUNCTIONS[text.lower()]
            self._need("(")
            parts = [self._sum()]
            while self._sign(","):
                parts.append(self._sum())
            self._need(")")
            if len(parts) != count:
                raise ValueError(f"{text} takes {count} value{'s' * (count > 1)}, not {len(parts)}")
            return lambda x: function(*(part(x) for part in parts))
        raise ValueError(f'"{text}" is unknown' if text else "it ends too early")


def _joined(sign: str, first: Part, second: Part) -> Part:
    compute = _SIGNS[sign]
    return lambda x: compute(first(x), second(x))
