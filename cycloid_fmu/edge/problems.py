"""What a user is told when something given cannot be used, and the exit codes that belong to it."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable

DONE, FAILED, BAD_INPUT, SILENT, INTERRUPTED = 0, 1, 2, 3, 130
_NOTHING = object()


class InputError(ValueError):
    """What a user gave can't be used; the text is one sentence that says where, what and what is allowed."""


class ArgumentError(InputError):
    """An argument of a function can't be used; a command line shows the option that stands for it instead.

    Parameters
    ----------
    argument
        Name of the function's argument.
    problem
        What is wrong and what is allowed, without the closing full stop.
    value
        What was given; leave it out where nothing was, and begin `problem` with a verb: "is missing".

    Examples
    --------
    >>> print(ArgumentError("seed", "it must not be negative", -1))
    seed = -1: it must not be negative.
    >>> print(ArgumentError("crank_turns", "is missing").named("--crank-turns"))
    --crank-turns is missing.
    """

    def __init__(self, argument: str, problem: str, value: object = _NOTHING) -> None:
        self.argument, self.problem, self.value = argument, problem, value
        super().__init__(self.named(argument))

    def named(self, name: str) -> str:
        """Return the sentence with `name` for the argument."""
        given = "" if self.value is _NOTHING else f" = {shown(self.value)}:"
        return f"{name}{given} {self.problem}."


def shown(value: object) -> str:
    """Return a value as it is written in a sentence: text in quotes, anything long but a path cut."""
    if isinstance(value, os.PathLike):
        return str(value)
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "did you mean …?" with the known word nearest to `word`, or nothing where none is near.

    Examples
    --------
    >>> did_you_mean("eccentricty", ["eccentricity", "pins"])
    'did you mean eccentricity?'
    >>> did_you_mean("speed", ["eccentricity", "pins"])
    ''
    """
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean {near[0]}?" if near else ""
