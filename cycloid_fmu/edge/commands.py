"""Shared parts of the command lines: entry point, options, tables, progress and exit statuses.

A command line is a package with one module per command; each module has one function with the command's name, or a
`typer.Typer` of subcommands. Only the module of the executed command is imported.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import logging
import math
import os
import re
import shutil
import signal
import sys
import textwrap
import time
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn

import typer
import typer.core

from cycloid_fmu.edge.cache import show_making
from cycloid_fmu.edge.files import PICTURES, json_text, output_path, zip_archive
from cycloid_fmu.edge.problems import (
    BAD_INPUT,
    DONE,
    FAILED,
    INTERRUPTED,
    ArgumentError,
    InputError,
    InputWarning,
    did_you_mean,
    listed,
    shown,
    without_controls,
)
from cycloid_fmu.edge.quantities import EXAMPLES, RATIO, parse_quantity

if TYPE_CHECKING:
    from rich.progress import Progress

_USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]  # typer's own, or click's with older versions
_SETTINGS: dict[str, Any] = {
    "no_args_is_help": True,
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": "rich",
}
_QUIET, _LONGEST_QUIET = 10.0, 30.0  # seconds between the lines of a progress that is written to a file
_FORESEEN, _LONG = 3.0, 20.0  # seconds after which a computation is announced that takes at least so long
_INTERRUPTED = "Interrupted; finished results are kept."
_SHORT = 0.5  # seconds: shorter computations show no bar, as its package is slow to load
_WIDE = 40  # characters; longer cells may be wrapped at spaces in a narrow terminal
_FEW, _MAIN = 8, 6  # the help of a command with more than 8 options shows 6 of them first


class _Group(typer.core.TyperGroup):
    """A group of commands; errors of the library name options here, not function arguments."""

    moved_to: Mapping[str, str] = {}

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        options = [p for p in getattr(command, "params", ()) if p.param_type_name == "option" and p.name != "help"]
        for option in options[_MAIN:] if len(options) > _FEW else ():
            option.rich_help_panel = "More options"
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        if args[0] not in self.commands and not args[0].startswith("-"):
            if args[0] in self.moved_to:
                raise InputError(f"{args[0]} is now the command {self.moved_to[args[0]]}, with the same options.")
            near = did_you_mean(args[0], self.commands)
            raise InputError(f"{args[0]} is not a command; {near or f'see {ctx.command_path} --help.'}")
        name, command, rest = super().resolve_command(ctx, args)
        if not isinstance(command, typer.core.TyperGroup):
            _refuse_repeated(ctx, command, rest)
        ctx.meta["cycloid.command"], ctx.meta["cycloid.words"] = command, (*rest,)
        return name, command, rest

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except ArgumentError as problem:
            flag = _flag(ctx.meta["cycloid.command"], problem.argument)
            if isinstance(problem.value, float):
                problem.value = _typed(ctx.meta["cycloid.words"], flag) or problem.value
            raise InputError(problem.named(flag)) from problem
        except KeyboardInterrupt as interrupt:
            _say(str(interrupt) or "Interrupted; finished results are kept.")
            raise typer.Exit(getattr(interrupt, "exit_status", INTERRUPTED)) from None


def _refuse_repeated(ctx: Any, command: Any, words: Sequence[str]) -> None:
    """Refuse a second value of an option that takes one: Click would take the last without a word."""
    with suppress(_USAGE_ERROR):  # which the command itself reports
        _, _, given = command.make_parser(command.context_class(command, ctx)).parse_args(args=[*words])
        for option, count in Counter(given).items():
            if count > 1 and option.param_type_name == "option" and not (option.multiple or option.is_flag):
                values = listed(shown(value) for value in _values(words, option.opts))
                raise InputError(f"{option.opts[0]} takes one value; it is given {count} times: {values}.")


def _flag(command: Any, argument: str) -> str:
    """Return the option or argument of a command that sets an argument of the library."""
    for parameter in command.params:
        options = [o for o in parameter.opts if o.startswith("--")]
        if argument == parameter.name or "--" + argument.replace("_", "-") in options:
            return options[0] if options else parameter.metavar or argument
    return argument


def _values(words: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the values of an option as typed: --name VALUE, --name=VALUE, -n VALUE or -nVALUE."""
    found = []
    for word, after in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if word in names or (equals and name in names):
            found.append(value if equals else after)
        elif word[:1] == "-" != word[1:2] and word[:2] in names:
            found.append(word[2:])
    return found


def _typed(words: Sequence[str], flag: str) -> str | None:
    """Return the value of an option as typed, if it is given exactly once and ends in a unit; otherwise None."""
    given = _values(words, [flag])
    return given[0] if len(given) == 1 and re.search(r"\d.*[a-z]$", given[0]) else None


class _Lazy(MutableMapping[str, Any]):
    """The commands of a package by name, each imported on first access."""

    def __init__(self, package: str, names: Sequence[str]) -> None:
        self._package = package
        self._made: dict[str, Any] = dict.fromkeys(names)

    def __getitem__(self, name: str) -> Any:
        if self._made[name] is None:
            file = name.replace("-", "_")
            module = importlib.import_module(f"{self._package}.{file}")
            made = getattr(module, file, None) or getattr(module, f"{file}_")
            if not isinstance(made, typer.Typer):
                function, made = made, typer.Typer(**_SETTINGS)
                made.command(name)(function)
            command = typer.main.get_command(made)
            command.name = name
            self._made[name] = command
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._made)

    def __len__(self) -> int:
        return len(self._made)


def command_line(
    name: str, help: str, package: str = "", names: Sequence[str] = (), moved: Mapping[str, str] | None = None
) -> typer.Typer:
    """Return a command line; commands from elsewhere are added with `@….command()`.

    Parameters
    ----------
    name
        Name of the program, such as "cycloid-fmu".
    help
        One sentence for the help page.
    package
        The package whose modules are commands: each has a function with the module's name (a trailing `_` is allowed)
        or a `typer.Typer` from `subcommands`.
    names
        Names of the commands in the order of the help page.
    moved
        {former command: the one that does its work now}.
    """

    class Group(_Group):
        moved_to = moved or {}

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            if names:
                self.commands = _Lazy(package, names)

    app = typer.Typer(name=name, cls=Group, help=help, **_SETTINGS)
    app.callback()(_version_of(name))
    return app


def subcommands(help: str) -> typer.Typer:
    """Return a `typer.Typer` for subcommands, which its module adds with `@….command()`."""
    return typer.Typer(cls=_Group, help=help, **_SETTINGS)


def _version_of(name: str) -> Callable[..., None]:
    def show(asked: bool) -> None:
        if asked:
            typer.echo(f"{name} {version('cycloid-fmu')}")
            raise typer.Exit

    Version = Annotated[bool, typer.Option("--version", callback=show, is_eager=True, help="Show the version.")]

    def shared(version: bool = False) -> None:
        pass

    shared.__annotations__["version"] = Version
    return shared


def main(app: typer.Typer) -> NoReturn:
    """Run a command line and end the process with its exit status."""
    # Idle OpenBLAS threads spin once NumPy is loaded: an analysis took 1.3 times as much processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    status = list[int]()
    atexit.register(_leave, status)
    try:
        run(app)
    except SystemExit as end:
        status.append(end.code if isinstance(end.code, int) else DONE)
        raise


def _leave(status: list[int]) -> None:
    """End the process after all other exit handlers: finalizing every module took a third of a short command."""
    if status:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status[0])


class _Unraisable:
    """Hook for exceptions that Python can't raise: an interrupt in a callback of the compiler, which fails then."""

    is_interrupted = False

    def __call__(self, complaint: Any) -> None:
        self.is_interrupted |= issubclass(complaint.exc_type, KeyboardInterrupt)


def run(app: typer.Typer) -> NoReturn:
    """Run a command line; the exit status is 2 after invalid input, 130 after an interrupt and 1 after a failure."""
    debug, unraisable = bool(os.environ.get("CYCLOID_TRACEBACK")), _Unraisable()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Objects made on import are permanent: scanning them for garbage took a tenth of a short command.
    gc.set_threshold(100_000)
    if not debug:  # logs and finalizer errors of libraries only repeat our own sentence
        logging.disable(logging.CRITICAL)
        sys.unraisablehook = unraisable
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            _say(str(message))
        else:
            shown(message, category, *where, **more)

    show_making(progress)
    setattr(warnings, "showwarning", show)  # noqa: B010 - the signature of typeshed is longer than needed
    try:
        code = app(prog_name=app.info.name, standalone_mode=False)
    except InputError as problem:
        if debug:
            raise
        _say(str(problem))
        sys.exit(problem.status)
    except _USAGE_ERROR as problem:
        if sentence := _usage(problem):
            _say(sentence)
        sys.exit(BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort) as problem:
        ended = isinstance(problem.__cause__, EOFError)
        _say("The input ended." if ended else _INTERRUPTED)
        sys.exit(FAILED if ended else INTERRUPTED)
    except Exception as problem:
        if debug:
            raise
        if unraisable.is_interrupted:
            _say(_INTERRUPTED)
            sys.exit(INTERRUPTED)
        if isinstance(problem, OSError) and problem.filename is not None and problem.strerror is not None:
            _say(f"{problem.filename}: {problem.strerror}.")
        else:
            _say(f"Failed: {type(problem).__name__}: {problem} (CYCLOID_TRACEBACK=1 shows where)")
        sys.exit(FAILED)
    sys.exit(code if isinstance(code, int) else DONE)


def _usage(problem: Any) -> str:
    """Return a sentence for invalid options and arguments."""
    said = str(problem.format_message()).strip()
    where = problem.ctx.command_path if problem.ctx is not None else ""
    if isinstance(problem, _Refused) and problem.param is not None:
        reason = problem.message if problem.message.endswith("?") else f"{problem.message}."
        return f"{problem.param.opts[0]} = {shown(problem.given)}: {reason}"
    if reason := _number_wanted(problem):
        return reason
    unknown = getattr(problem, "option_name", None)
    if unknown is not None and getattr(problem, "possibilities", unknown) is not unknown:
        instead = _instead(unknown, problem.ctx.command) or f"see {where} --help."
        return f"{unknown} is not an option of {where}; {instead}"
    if "\n" in said or not said:  # a help page, or a message that is already printed
        return said
    return f"{said.rstrip('.')}; see {where} --help."


def _number_wanted(problem: Any) -> str:
    """Return a sentence on an option that takes a number, with the value as typed; "" for other problems."""
    wanted = str(getattr(problem, "message", "")).partition("Input should be ")[2].partition(", unable")[0]
    if problem.ctx is None or not wanted or getattr(problem, "param", None) is None:
        return ""
    values = _values(problem.ctx.meta.get("cycloid.words", ()), problem.param.opts)
    typed = f" = {shown(values[0])}" if len(values) == 1 else ""
    wanted = wanted.replace("a valid integer", "a whole number").replace("a valid number", "a number")
    return f"{problem.param.opts[0]}{typed}: it must be {wanted.rstrip('.')}."


def _instead(unknown: str, command: Any) -> str:
    """Return what to write in place of an unknown option: an argument of that name, or the nearest option; or ""."""
    word = unknown.strip("-")
    for parameter in command.params:
        name = parameter.metavar or ""
        if parameter.param_type_name == "argument" and word in name.lower().split("."):
            return f"write {name} without an option."
    options = [o.strip("-") for p in command.params for o in p.opts if o.startswith("--")]
    return did_you_mean(word, options, "--")


def separated(text: str | None) -> list[str] | None:
    """Return the values of an option that are separated by commas; None if it is not given."""
    return None if text is None else [part.strip() for part in text.split(",")]


def _say(text: str) -> None:
    sys.stdout.flush()
    print(without_controls(text), file=sys.stderr, flush=True)


class _Refused(typer.BadParameter):
    """An invalid value of an option, with the library's reason."""

    def __init__(self, given: str, reason: str) -> None:
        super().__init__(reason)
        self.given = given


def quantity_option(si: str, help: str, *names: str, **settings: Any) -> Any:
    """Return an option whose value is typed with its unit and passed to the command in SI units.

    Parameters
    ----------
    si
        The SI unit, as pint writes it.
    help
        Help text of the option.
    names
        Names of the option, if they differ from the parameter's.
    settings
        Further arguments of `typer.Option`, such as `show_default="600 rpm"`.

    Examples
    --------
    >>> Torques = Annotated[list[float], quantity_option("N*m", "Torque on the output; may be repeated.")]
    """

    def parse(text: str | float) -> float:
        if isinstance(text, float):  # a default
            return text
        try:
            return parse_quantity(text, si)
        except ValueError as problem:
            raise _Refused(text, str(problem)) from None

    parse.__name__ = "quantity"
    shown_as = {"metavar": f'"{EXAMPLES.get(si, f"1 {si}")}"', **settings}
    return typer.Option(*names, parser=parse, help=help, **shown_as)


def ratio_option(help: str = "") -> Any:
    """Return an option for the signed ratio of a drive whose pair is not given."""
    return typer.Option(
        "--ratio", metavar="RATIO", help=f"Signed ratio input/output: {RATIO}, such as -39. {help}".strip()
    )


def choice_option(choices: Collection[str], help: str, *names: str, **settings: Any) -> Any:
    """Return an option whose value is one of the given words."""

    def parse(text: str) -> str:
        if text in choices:
            return text
        near = did_you_mean(text, choices) if text[:1].isalpha() else ""
        raise _Refused(text, f"it must be one of {', '.join(choices)}{f'; {near}' if near else ''}")

    parse.__name__ = "choice"
    return typer.Option(*names, parser=parse, metavar="|".join(choices), help=help, **settings)


def output_option(endings: Collection[str], metavar: str, help: str, *names: str) -> Any:
    """Return an option for an output file; a wrong ending or a missing folder is refused before the command runs."""

    def check(param: typer.CallbackParam, value: Path | None) -> Path | None:
        return value if value is None else output_path(value, param.opts[0], endings)

    return typer.Option(*(names or ("--output", "-o")), metavar=metavar, callback=check, help=help)


def zip_argument(metavar: str, what: str, help: str) -> Any:
    """Return an argument for a file that is a ZIP archive, such as an FMU; anything else is refused."""

    def check(value: Path) -> Path:
        return zip_archive(value, what)

    return typer.Argument(metavar=metavar, callback=check, help=help)


PlotFile = Annotated[Path | None, output_option(PICTURES, "FILE.png|pdf", "Draw the result.", "--plot")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON: SI units, names as in the files.")]


def print_json(data: Any) -> None:
    """Print a result as JSON: SI units, NaN as null."""
    typer.echo(json_text(data))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table with right-aligned numbers. Nothing is cut, however narrow the terminal is.

    Sentences in the last column are wrapped at spaces if the terminal is too narrow for them.
    """
    lines = [[without_controls(str(cell)) for cell in row] for row in (columns, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    if sys.stdout.isatty() and widths[-1] > _WIDE:
        room = shutil.get_terminal_size().columns - sum(widths[:-1]) - 2 * len(widths[:-1])
        words = max(len(word) for line in lines for word in line[-1].split())
        widths[-1] = min(widths[-1], max(room, words, _WIDE))
    filled = [[line[k] for line in lines[1:] if line[k]] for k in range(len(widths))]
    textual = [2 * sum(map(_is_number, column)) <= len(column) for column in filled]

    def printed(line: Sequence[str]) -> Iterator[str]:
        wrapped = textwrap.wrap(line[-1], widths[-1], break_long_words=False, break_on_hyphens=False) or [""]
        if len(line[-1]) <= widths[-1]:
            wrapped = [line[-1]]
        for k, last in enumerate(wrapped):
            cells = [*(line[:-1] if k == 0 else [""] * (len(line) - 1)), last]
            put = [c.ljust(w) if t else c.rjust(w) for c, w, t in zip(cells, widths, textual, strict=True)]
            yield "  ".join(put).rstrip()

    typer.secho(title, bold=True)
    for text in printed(lines[0]):
        typer.echo(text)
    typer.echo("  ".join("─" * width for width in widths))
    for line in lines[1:]:
        for text in printed(line):
            typer.echo(text)


def _is_number(cell: str) -> bool:
    return bool(cell) and (cell[0].isdigit() or (cell[0] in "+-−±<" and len(cell) > 1 and cell[1].isdigit()))


class Bar:
    """Progress of a computation on standard error, with the time left once it can be estimated.

    On a terminal it is a bar. Otherwise it is lines, at least ten seconds apart: the first as soon as a long
    computation can be foreseen.

    Parameters
    ----------
    what
        The items counted, such as "crank angles".
    total
        Number of items; None while it is unknown.
    """

    _drawn: ClassVar[Bar | None] = None

    def __init__(self, what: str, total: float | None) -> None:
        self._what, self._total, self._done = what, total, 0.0
        self._began = time.monotonic()
        # Time and items from which the speed is measured: without starting, and without items of an interrupted run.
        self._from: tuple[float, float] | None = None
        self._said, self._said_share = self._began, 0.0
        self._rich: Progress | None = None

    def advance(self, done: float = 1.0) -> None:
        """Add `done` items to those finished."""
        self.update(completed=self._done + done)

    def update(
        self, *, completed: float | None = None, total: float | None = None, description: str | None = None
    ) -> None:
        """Set the number of items done, their total or their name."""
        before, self._done = self._done, self._done if completed is None else completed
        self._total = self._total if total is None else total
        self._what = self._what if description is None else description
        if self._from is None or self._done < before:
            self._from = (time.monotonic(), self._done)
        if sys.stderr.isatty():
            self._draw()
        elif self._done != self._total:
            self._print()

    def left(self) -> float | None:
        """Return the time left, s, at the mean speed; None if it is not known."""
        began, before = self._from or (0.0, self._done)
        done = self._done - before
        if self._total is None or done <= 0.0:
            return None
        return (self._total - self._done) * (time.monotonic() - began) / done

    def _draw(self) -> None:
        if self._rich is None:
            if Bar._drawn is not None:  # a terminal has one at a time
                return
            if self._total is not None and time.monotonic() - self._began < _SHORT:
                return
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

            known = (TaskProgressColumn(), TextColumn("{task.fields[left]}"))
            columns = known if self._total is not None else (TimeElapsedColumn(),)
            self._rich = Progress(
                TextColumn("{task.description}"), BarColumn(), *columns, console=Console(stderr=True), transient=True
            )
            self._task = self._rich.add_task(self._what, total=self._total, left="")
            self._rich.start()
            Bar._drawn = self
        self._rich.update(
            self._task, completed=self._done, total=self._total, description=self._what, left=_left(self.left())
        )

    def _print(self) -> None:
        now, left = time.monotonic(), self.left()
        quiet = now - self._said
        share = self._done / self._total if self._total else 0.0
        first = self._said == self._began and left is not None and left > _LONG and quiet >= _FORESEEN
        if first or quiet >= _LONGEST_QUIET or (quiet >= _QUIET and share >= self._said_share + 0.1):
            known = f": {self._done:.6g} of {self._total:.6g} ({share:.0%})" if self._total else ""
            counted = f": {self._done:.6g}" if self._done and not known else known
            coming = f", {_left(left)}" if left else ""
            _say(f"{self._what}{counted} after {now - self._began:.0f} s{coming}")
            self._said, self._said_share = now, share

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *problem: object) -> None:
        if self._rich is not None:
            self._rich.stop()
            Bar._drawn = None


def _left(seconds: float | None) -> str:
    """Return a remaining time as words, as coarse as its estimate; "" if it is not known."""
    if seconds is None:
        return ""
    if seconds < 60.0:
        return f"about {math.ceil(seconds)} s left"
    minutes = round(seconds / 60.0)
    hours, rest = divmod(minutes, 60)
    return f"about {minutes} min left" if minutes < 60 else f"about {hours} h {rest} min left"


@contextmanager
def progress(what: str, total: float | None) -> Iterator[Callable[[float], None]]:
    """Show the progress of a computation; yields the function for its `progress` argument."""
    with Bar(what, total) as bar:
        yield bar.advance


@contextmanager
def status() -> Iterator[Callable[[str], None]]:
    """Show the current stage of a computation; yields the function for a `progress` argument."""
    with Bar("starting", None) as bar:
        yield lambda step: bar.update(description=step)
