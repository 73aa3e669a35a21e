"""Errors and warnings about invalid input, and the exit statuses."""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Callable, Iterable, Iterator

DONE, FAILED, BAD_INPUT, NO_DATA, NOT_MET, INTERRUPTED = 0, 1, 2, 3, 4, 130
_NOTHING = object()
_LONGEST = 2000  # characters of a sentence
_NEAR_PART = 0.9  # similarity of a word to a part of a known one
_CONTROLS = frozenset([*range(0x20), *range(0x7F, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)])


class InputWarning(UserWarning):
    """Contradictory input that can still be used; the sentence states how."""


class InputError(ValueError):
    """Invalid input; the text is one sentence with place, value and allowed values.

    Several problems have one line each; very long lines are cut.
    """

    status = BAD_INPUT

    def __init__(self, text: str = "") -> None:
        super().__init__("\n".join(cut(line, _LONGEST) for line in text.split("\n")))


class NoDataError(InputError):
    """Valid input without the data that a result needs; the text is as that of `InputError`."""

    status = NO_DATA


class ArgumentError(InputError):
    """An invalid argument of a function; a command line shows the corresponding option instead.

    Parameters
    ----------
    argument
        Name of the function's argument.
    problem
        The problem and the allowed values, without the closing full stop; a question keeps its mark.
    value
        The given value; leave it out if there is none, and begin `problem` with a verb: "is missing".

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
        return f"{name}{given} {self.problem}{'' if self.problem.endswith('?') else '.'}"


@contextlib.contextmanager
def parsed_by_others(source: object, problem: str) -> Iterator[None]:
    """Turn any exception of a library that reads a file into an `InputError` with one sentence.

    Parameters
    ----------
    source
        The file's name.
    problem
        The problem, without the closing full stop: "this is not a netCDF file". The library's reason follows.

    Raises
    ------
    InputError
        In place of any other exception; an `InputError` is passed on unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as failure:  # parsers raise exceptions of any class
        raise InputError(f"{source}: {problem} ({first_line(failure)}).") from None


def missing_package(package: str, extra: str) -> str:
    """Return the sentence, without its full stop, that names the extra with a package that is not installed."""
    return f"this needs the package {package}: pip install 'cycloid-fmu[{extra}]'"


@contextlib.contextmanager
def needs_extra(
    extra: str, refuse: Callable[[str], InputError] = lambda said: InputError(f"{said}.")
) -> Iterator[None]:
    """Guard imports of packages of an extra: for a missing one, raise an error with one sentence that names the extra.

    Parameters
    ----------
    extra
        Name of the extra in `pyproject.toml`.
    refuse
        Makes the error of the sentence of `missing_package`.

    Raises
    ------
    InputError
        As `refuse` makes it.
    """
    try:
        yield
    except ImportError as problem:
        package = (problem.name or str(problem)).partition(".")[0]
        raise refuse(missing_package(package, extra)) from None


def first_line(problem: BaseException) -> str:
    """Return the message of a library's error, in one line and cut if it is long."""
    if isinstance(problem, MemoryError):  # it has no message
        return "it asks for more memory than there is"
    said = (str(problem).strip() or type(problem).__name__).splitlines()[0].rstrip(".")
    return cut(said, 200)


def listed(names: Iterable[str]) -> str:
    """Return names as a list in a sentence, cut if there are many."""
    return cut(", ".join(names), 300)


def cut(text: str, length: int) -> str:
    """Return text in one line, cut with dots if it is longer."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain if len(plain) <= length else plain[: length - 3] + "..."


def shown(value: object) -> str:
    """Return a value as text for a sentence: in one line, text in quotes, long values except paths cut."""
    if isinstance(value, os.PathLike):
        return str(value)
    if isinstance(value, (list, tuple)):
        return cut(f"[{', '.join(map(shown, value))}]", 60)
    return cut(f'"{value}"' if isinstance(value, str) else str(value), 60)


def without_controls(text: str) -> str:
    """Return a text without control characters, such as escape sequences in a file name; line breaks stay."""
    return "".join(c if c == "\n" or ord(c) not in _CONTROLS else "\N{REPLACEMENT CHARACTER}" for c in text)


def check_named(name: object, known: Iterable[str], key: str = "") -> None:
    """Raise a `ValueError` with what could be meant if a name is none of the known ones; a `key` adds the value."""
    names = list(known)
    if name not in names:
        near = did_you_mean(str(name), names) or f"give one of {', '.join(map(repr, names))}"
        raise ValueError(f"{key} = {shown(name)}: {near}" if key else near)


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return "did you mean …?" with the known word nearest to `word`, or one with a part near it; "" if none is near.

    Examples
    --------
    >>> did_you_mean("eccentricty", ["eccentricity", "pins"])
    'did you mean eccentricity?'
    >>> did_you_mean("stifness", ["torsional_stiffness", "backlash"])
    'did you mean torsional_stiffness?'
    >>> did_you_mean("speed", ["eccentricity", "pins"])
    ''
    """
    names = list(known)
    parts = {part: name for name in names[::-1] for part in re.split(r"[-_.]", name)}
    near = difflib.get_close_matches(word, names, n=1)
    near = near or [parts[part] for part in difflib.get_close_matches(word, parts, n=1, cutoff=_NEAR_PART)]
    return f"did you mean {prefix}{near[0]}?" if near else ""
