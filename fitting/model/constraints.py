"""What a user decides of a fit's unknowns by `lmfit.Parameters`: held at a value, bounded, or tied to others."""

from __future__ import annotations

import ast
import copy
import dataclasses
import json
import math
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cycloid_fmu import edge

if TYPE_CHECKING:
    import lmfit

_ROUNDED = 1e-9  # share by which rounding may have put a value beyond its bound
_ARITHMETIC = (
    *(ast.Expression, ast.BinOp, ast.UnaryOp, ast.Name, ast.Load, ast.Constant),
    *(ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.UAdd, ast.USub),
)


@dataclass(frozen=True)
class Constraints:
    """Decisions on unknowns by name, SI; of all that are not named the fit decides.

    Attributes
    ----------
    free
        Unknowns that vary: errors among them are fitted even if the data do not resolve them.
    held
        {name: value} of those that do not vary.
    bounds
        {name: (smallest, largest value)}.
    ties
        {name: expression of others}.
    parameters
        The `lmfit.Parameters` that evaluate the expressions, without bounds.
    """

    free: frozenset[str]
    held: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]
    ties: Mapping[str, str]
    parameters: lmfit.Parameters

    @classmethod
    def of(cls, given: lmfit.Parameters) -> Constraints:
        """Return the decisions of lmfit parameters."""
        ties = {name: one.expr for name, one in given.items() if one.expr}
        unbounded = copy.deepcopy(given)
        for one in unbounded.values():
            one.min, one.max = -math.inf, math.inf
        return cls(
            frozenset(name for name, one in given.items() if one.vary and name not in ties),
            {name: float(one.value) for name, one in given.items() if not one.vary and name not in ties},
            {name: (float(one.min), float(one.max)) for name, one in given.items()},
            ties,
            unbounded,
        )

    @property
    def named(self) -> list[str]:
        """All unknowns that are named, in their order."""
        return list(self.bounds)

    def only(self, names: Collection[str]) -> Constraints:
        """The same for some unknowns alone."""
        return dataclasses.replace(
            self,
            free=self.free & set(names),
            held={n: v for n, v in self.held.items() if n in names},
            bounds={n: v for n, v in self.bounds.items() if n in names},
            ties={n: v for n, v in self.ties.items() if n in names},
        )

    def tied(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values of tied unknowns from those of the others."""
        for name, value in values.items():
            if name in self.parameters and name not in self.ties:
                self.parameters[name].value = value
        return {name: float(self.parameters[name].value) for name in self.ties}


def checked(given: lmfit.Parameters, names: Collection[str]) -> None:
    """Refuse parameters that are not unknowns of the fit, or have values that are impossible.

    Raises
    ------
    edge.ArgumentError
        If a name is unknown, a bound is not a number, or a value is outside the bounds.
    """
    for name, one in given.items():
        # Causes of misfit that another fit found are suspected anew.
        if name not in names and not name.startswith("misfit_"):
            near = edge.did_you_mean(name, names) or "fitting.parameters states all"
            raise edge.ArgumentError("parameters", f"{name} is not an unknown of this fit; {near}")
        if not math.isfinite(one.value):
            raise edge.ArgumentError("parameters", f"{name} must have a finite value", one.value)


def read_parameters(path: str | os.PathLike[str]) -> lmfit.Parameters:
    """Read a file written by `lmfit.Parameters.dump`.

    Expressions may only be arithmetic, and functions that lmfit has pickled in the file are not read.

    Raises
    ------
    edge.InputError
        If the file cannot be read, or holds anything else.
    """
    text = edge.read_text(path)
    with edge.parsed_by_others(path, "this is not a file of lmfit.Parameters.dump"):
        return loaded(json.loads(text)["params"])


def loaded(states: list[list[Any]]) -> lmfit.Parameters:
    """Return lmfit parameters from the `params` of their file.

    Raises
    ------
    ValueError
        If an expression is more than arithmetic or names what is no parameter, or a value is outside its bounds, to
        which lmfit would move it without a word.
    """
    from lmfit import Parameters

    names = {state[0] for state in states}
    for name, value, _, expression, low, high, *_ in states:
        if expression is None:
            least, most = -math.inf if low is None else low, math.inf if high is None else high
            if math.isfinite(value) and not least - _ROUNDED * abs(least) <= value <= most + _ROUNDED * abs(most):
                raise ValueError(f"{name} = {value:g} is outside its bounds, {least:g} to {most:g}")
            continue
        # lmfit would run what an expression says.
        parts = list(ast.walk(_parsed(str(expression))))
        if not all(isinstance(part, _ARITHMETIC) for part in parts):
            raise ValueError(f"the expression of {name} is more than arithmetic")
        if unknown := sorted({part.id for part in parts if isinstance(part, ast.Name)} - names):
            raise ValueError(f"the expression of {name} names {edge.listed(unknown)}, which is no parameter of it")
    return Parameters().loads(json.dumps({"unique_symbols": {}, "params": states}))


def _parsed(expression: str) -> ast.AST:
    try:
        return ast.parse(expression.strip(), mode="eval")
    except SyntaxError:
        raise ValueError("an expression is not arithmetic") from None
