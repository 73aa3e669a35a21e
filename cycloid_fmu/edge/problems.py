"""What a user is told when something given cannot be used, and the exit codes that belong to it."""

from __future__ import annotations

import contextlib
import difflib
import os
from collections.abc import Callable, Iterable, Iterator

DONE, FAILED, BAD_INPUT, SILENT, NOT_MET, INTERRUPTED = 0, 1, 2, 3, 4, 130
_NOTHING = object()
_LONGEST = 2000  # characters of a sentence
_CONTROLS = frozenset([*range(0x20), *range(0x7F, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)])


class InputWarning(UserWarning):
    """Input that contradicts itself and can be used all the same; the sentence says how."""


class InputError(ValueError):
    """What a user gave can't be used; the text is one sentence that says where, what and what is allowed.

    Several problems are a line each; one that what was given makes longer than anybody reads is cut.
    """

    def __init__(self, text: str = "") -> None:
        super().__init__("\n".join(cut(line, _LONGEST) for line in text.split("\n")))


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


@contextlib.contextmanager
def parsed_by_others(source: object, problem: str) -> Iterator[None]:
    """Refuse, in one sentence, a file on which a library that is not ours fails, whatever it raises.

    Parameters
    ----------
    source
        The file's name.
    problem
        What is wrong, without the closing full stop: "this is not a netCDF file". The library's own reason follows.

    Raises
    ------
    InputError
        In place of any other exception; one that is an `InputError` already goes on as it is.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as failure:  # a parser raises whatever it trips over: no list of classes is complete
        raise InputError(f"{source}: {problem} ({first_line(failure)}).") from None


def missing_package(package: str, extra: str) -> str:
    """Return the sentence, without its full stop, that names the extra with a package that is not installed."""
    return f"this needs the package {package}: pip install 'cycloid-fmu[{extra}]'"


@contextlib.contextmanager
def needs_extra(
    extra: str, refuse: Callable[[str], InputError] = lambda said: InputError(f"{said}.")
) -> Iterator[None]:
    """Import, inside, packages of an extra; one that is not installed is refused in one sentence that names the extra.

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
    """What a library's error says, in one line and cut where it is long."""
    said = (str(problem).strip() or type(problem).__name__).splitlines()[0].rstrip(".")
    return cut(said, 200)


def listed(names: Iterable[str]) -> str:
    """Return names as they are listed in a sentence, cut where they are many."""
    return cut(", ".join(names), 300)


def cut(text: str, length: int) -> str:
    """Return text in one line, with dots at its end where it is longer."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain if len(plain) <= length else plain[: length - 3] + "..."


def shown(value: object) -> str:
    """Return a value as it is written in a sentence: in one line, text in quotes, anything long but a path cut."""
    if isinstance(value, os.PathLike):
        return str(value)
    return cut(f'"{value}"' if isinstance(value, str) else str(value), 60)


def without_controls(text: str) -> str:
    """Return a text without what makes a terminal act, such as the escape sequences in a name of a file; lines stay."""
    return "".join(c if c == "\n" or ord(c) not in _CONTROLS else "\N{REPLACEMENT CHARACTER}" for c in text)


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
