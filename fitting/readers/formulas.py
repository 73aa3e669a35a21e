"""Formulas of measurement files: read with Python's grammar, computed in double precision, never run as code."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]

LONGEST = 300  # characters
_DEEPEST = 160  # levels; a sum of as many terms as a formula can hold has fewer
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
_SIGNS: dict[type[ast.operator], Callable[[Array, Array], Array]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
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
        if len(self.text) > LONGEST:
            raise ValueError(f"it is longer than {LONGEST} characters")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                parsed = ast.parse(" ".join(self.text.split()), mode="eval")
        except (SyntaxError, MemoryError, RecursionError) as problem:
            reason = getattr(problem, "msg", None) or "nested too deeply"
            raise ValueError(f"it is no formula ({reason})") from None
        object.__setattr__(self, "_compute", _part(parsed.body, _DEEPEST))

    def __call__(self, x: ArrayLike) -> Array:
        """Return the values of the formula, of the shape of `x`; NaN where it is undefined."""
        given = np.asarray(x, dtype=float)
        compute: Part = self._compute  # type: ignore[attr-defined]
        with np.errstate(all="ignore"):
            return np.broadcast_to(compute(given), given.shape).astype(float)


def _part(node: ast.expr, levels: int) -> Part:
    """Return a part of a formula as a function of X; there are numbers, X, the signs and the functions above."""
    if not levels:
        raise ValueError("it is nested too deeply")
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            number = np.array(float(value))
            return lambda x: number
        case ast.Name(id=name) if name.upper() in ("X", "X1"):
            return lambda x: x
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _part(operand, levels - 1)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            positive = _part(operand, levels - 1)
            return lambda x: np.negative(positive(x))
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _SIGNS:
            compute, first, second = _SIGNS[type(sign)], _part(left, levels - 1), _part(right, levels - 1)
            return lambda x: compute(first(x), second(x))
        case ast.Call(func=ast.Name(id=name), args=given, keywords=[]) if name.lower() in _FUNCTIONS:
            count, function = _FUNCTIONS[name.lower()]
            if len(given) != count:
                raise ValueError(f"{name} takes {count} value{'s' * (count > 1)}, not {len(given)}")
            parts = [_part(argument, levels - 1) for argument in given]
            return lambda x: function(*(part(x) for part in parts))
    raise ValueError(f"{edge.shown(ast.unparse(node))} is not part of a formula")
