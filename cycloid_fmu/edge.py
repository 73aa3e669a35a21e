"""What all three packages share where the world comes in.

Quantities with units, TOML files whose errors name file and field, files that appear whole or not at all, and exit
codes. Nothing here knows gears, measurements or encoders.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import math
import os
import re
import signal
import sys
import tempfile
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import pydantic

if TYPE_CHECKING:
    import pint
    import typer
    import xarray as xr

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
ARCSEC = 648000.0 / math.pi
"""Arcseconds in a radian: what people are shown."""
ARCMIN = ARCSEC / 60.0

_NUMBER = r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
_QUANTITY = re.compile(rf"({_NUMBER}) (\S.*)")
_EXAMPLES = {
    "m": "64 mm", "rad": "0.5 arcmin", "N": "5 N", "N*m": "181 N*m", "Pa": "206 GPa", "s": "10 ms", "rad/s": "15 rpm",
    "K": "300 K", "rad/(N*m)": "0.02 arcsec/(N*m)", "1/Pa": "2.2e-8 1/Pa", "m^2/N": "1e-18 m^2/N",
    "kg*m^2": "0.05 kg*m^2",
}  # fmt: skip


class InputError(ValueError):
    """What a user gave can't be used; the text is one sentence that says where, what and what is allowed."""


@functools.cache
def units() -> pint.UnitRegistry[Any]:
    """Return the one unit registry (pint, imported on first use because it takes half a second)."""
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry()
    registry.define("revolutions_per_minute = revolution / minute = rpm")
    return registry


def _shown(value: object) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


@functools.lru_cache(maxsize=512)
def unit_scale(unit: str, si: str) -> float:
    """Return how many `si` units one `unit` is.

    Raises
    ------
    ValueError
        If the unit is unknown, measures something else, or has an offset (degrees Celsius).
    """
    example = _EXAMPLES.get(si, f"1 {si}").split(" ", 1)[1]
    try:
        parsed = units().Unit(unit)
        zero, one = (units().Quantity(x, parsed).to(si).magnitude for x in (0.0, 1.0))
    except Exception as problem:
        reason = "measures something else" if "convert" in str(problem) else "is not a unit known here"
        raise ValueError(f'the unit "{unit}" {reason}; use one such as {example}') from None
    if zero != 0.0:
        raise ValueError(f'the unit "{unit}" has an offset; use one such as {example}')
    return float(one)


def parse_quantity(value: object, si: str) -> float:
    """Return a quantity written as text, such as "64 mm", in SI units.

    Pint alone is too generous here: it reads "1,5 mm" as 15 mm, "0.3" as radians, "nan mm" and "2*3 mm".

    Parameters
    ----------
    value
        One finite number with a decimal point, a space and a unit.
    si
        The SI unit asked for, as pint writes it: "m", "rad", "N*m".

    Raises
    ------
    ValueError
        If the text is anything else; the message says how to write it.
    """
    how = f'write one number with a decimal point, a space and a unit, such as "{_EXAMPLES.get(si, f"1 {si}")}"'
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise ValueError(how)
    number = float(match[1]) * unit_scale(match[2].strip(), si)
    if not math.isfinite(number):
        raise ValueError(how)
    return number


def format_quantity(value: float, si: str, unit: str) -> str:
    """Write an SI value as text that `parse_quantity` reads back to the same number (to 15 digits)."""
    return f"{value / unit_scale(unit, si):.15g} {unit}"


def quantity_option(text: str, si: str, name: str) -> float:
    """Return a quantity typed on the command line in SI units; an `InputError` names the option."""
    try:
        return parse_quantity(text, si)
    except ValueError as problem:
        raise InputError(f"{name} = {_shown(text)}: {problem}.") from None


def _reader(si: str) -> pydantic.BeforeValidator:
    return pydantic.BeforeValidator(lambda value: parse_quantity(value, si))


def _unit(si: str) -> Any:
    return pydantic.Field(json_schema_extra={"quantity": _EXAMPLES[si], "si": si})


Length = Annotated[float, _reader("m"), _unit("m")]
Angle = Annotated[float, _reader("rad"), _unit("rad")]
Torque = Annotated[float, _reader("N*m"), _unit("N*m")]
Pressure = Annotated[float, _reader("Pa"), _unit("Pa")]
Seconds = Annotated[float, _reader("s"), _unit("s")]
Speed = Annotated[float, _reader("rad/s"), _unit("rad/s")]
Temperature = Annotated[float, _reader("K"), _unit("K")]
PressureViscosity = Annotated[float, _reader("1/Pa"), _unit("1/Pa")]
WearCoefficient = Annotated[float, _reader("m^2/N"), _unit("m^2/N")]


class Config(pydantic.BaseModel):
    """Base of everything read from TOML: unknown keys are refused, values can't be changed afterwards."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, validate_default=False)


Model = TypeVar("Model", bound=Config)


def _sentence(error: Any, source: str) -> str:
    """Say one of pydantic's findings as a sentence that names file, field, value and what is allowed."""
    place, kind, message = error["loc"], error["type"], error["msg"]
    tables = [str(p) for p in place[:-1] if not isinstance(p, int)]
    field = "".join(f"[{i}]" if isinstance(i, int) else f".{i}" for i in place).lstrip(".")
    if len(place) > 1 and all(isinstance(p, str) for p in place):
        field = f"[{'.'.join(tables)}] {place[-1]}"
    if kind == "missing":
        return f"{source}: {field} is missing."
    if kind == "extra_forbidden":
        return f"{source}: {field} is not a key known here; check its spelling or remove it."
    message = message.removeprefix("Value error, ").removeprefix("Input should be ").removesuffix(".")
    if kind not in ("value_error", "assertion_error"):
        message = f"it should be {message}"
    if not field:
        return f"{source}: {message}."
    return f"{source}: {field} = {_shown(error['input'])}: {message}."


def validated(model: type[Model], data: dict[str, Any], source: str) -> Model:
    """Return `data` checked by `model`; an `InputError` gives one sentence a problem, each naming `source`."""
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as problems:
        found = problems.errors(include_url=False, include_context=False)
        said = [_sentence(e, source) for e in found[:5]]
        if len(found) > 5:
            said.append(f"{source}: {len(found) - 5} more problems.")
        raise InputError("\n".join(said)) from None


def check_format(given: object, wanted: str, source: str) -> None:
    """Refuse, in one sentence, a file whose `format` is not the one that this version reads."""
    if given is None:
        raise InputError(f'{source}: format is missing; the first line must be format = "{wanted}".')
    if given != wanted:
        raise InputError(f'{source}: format = {_shown(given)}: this version reads "{wanted}".')


def toml_table(text: str, wanted_format: str, source: str) -> dict[str, Any]:
    """Return the table of a TOML text of the wanted format, without its `format` key."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise InputError(f"{source}: this is not TOML: {problem}.") from None
    check_format(table.pop("format", None), wanted_format, source)
    return table


def json_table(path: str | os.PathLike[str], wanted_format: str, what: str) -> dict[str, Any]:
    """Return the table of a JSON file of the wanted format; `what` it should hold, for the message, such as "figures".

    Raises
    ------
    InputError
        If it can't be read, is no JSON or no table, or is of another format.
    """
    try:
        data = json.loads(read_text(path))
    except json.JSONDecodeError as problem:
        raise InputError(f"{path}: this is not JSON: {problem}.") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: it holds no {what}; it must be a JSON object.")
    check_format(data.get("format"), wanted_format, str(path))
    return data


def netcdf(path: str | os.PathLike[str], wanted_format: str) -> xr.Dataset:
    """Return the variables of a netCDF file of the wanted format, loaded.

    Raises
    ------
    InputError
        If it can't be read, is no netCDF, or is of another format.
    """
    import xarray as xr

    existing(path)
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            data = opened.load()
    except Exception as problem:
        raise InputError(f"{path}: this is not a netCDF file ({type(problem).__name__}).") from None
    check_format(data.attrs.get("format"), wanted_format, str(path))
    return data


def format_of(path: str | os.PathLike[str]) -> object:
    """Return the `format` of a TOML file, None where it has none or is no TOML (its reader then says so)."""
    try:
        return tomllib.loads(read_text(path)).get("format")
    except tomllib.TOMLDecodeError:
        return None


def read_text(path: str | os.PathLike[str]) -> str:
    """Return a UTF-8 text file; an `InputError` where it can't be read."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: this is not a UTF-8 text file.") from None
    except OSError as problem:
        raise InputError(f"{path}: {problem.strerror or problem}.") from None


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that can be read; an `InputError` where there is none."""
    try:
        with Path(path).open("rb"):
            return Path(path)
    except OSError as problem:
        raise InputError(f"{path}: {problem.strerror or problem}.") from None


def unit_columns(
    header: Sequence[str], wanted: Mapping[str, str], source: str, optional: Mapping[str, str] = MappingProxyType({})
) -> dict[str, tuple[int, float]]:
    """Return position and scale to SI of the wanted columns of a table whose header says units, `time [s]`.

    Parameters
    ----------
    header
        The header's cells.
    wanted
        SI unit of each column that must be there; others are passed over.
    source
        The file's name, for messages.
    optional
        SI unit of each column that is looked for but need not be there.

    Raises
    ------
    InputError
        If a column or its unit is missing, or the unit measures something else.
    """
    found: dict[str, tuple[int, float]] = {}
    units = {**wanted, **optional}
    for position, cell in enumerate(header):
        name, bracket, unit = cell.strip().partition("[")
        name = name.strip()
        if name not in units:
            continue
        if not bracket or not unit.endswith("]"):
            raise InputError(f'{source}: the column "{cell.strip()}" has no unit; write "{name} [{units[name]}]".')
        try:
            found[name] = (position, unit_scale(unit[:-1].strip(), units[name]))
        except ValueError as problem:
            raise InputError(f"{source}: the column {name}: {problem}.") from None
    for name, unit in wanted.items():
        if name not in found:
            raise InputError(f'{source}: there is no column "{name} [{unit}]" in the header.')
    return found


def finite(cell: str, field: str) -> float:
    """Return the number in a cell of a table; an `InputError` that begins with `field` where it is none."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f'{field} = "{cell}": it must be a finite number with a decimal point.')
    return value


def number_rows(
    path: str | os.PathLike[str], wanted: Mapping[str, str], optional: Mapping[str, str] = MappingProxyType({})
) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield the lines of a CSV table whose header says units: line and {column: value in SI}; blank ones are left out.

    Parameters
    ----------
    path
        The file.
    wanted, optional
        As for `unit_columns`.

    Raises
    ------
    InputError
        If it can't be read, a column or its unit is missing, or a cell is no finite number; it names the line.
    """
    lines = csv.reader(read_text(path).splitlines())
    columns = unit_columns(next(lines, []), wanted, str(path), optional)
    for number, row in enumerate(lines, start=2):
        if row:
            cells = {name: row[place].strip() if place < len(row) else "" for name, (place, _) in columns.items()}
            yield number, {n: finite(c, f"{path}: line {number}: {n}") * columns[n][1] for n, c in cells.items()}


def output_path(path: str | os.PathLike[str], option: str, endings: Collection[str]) -> Path:
    """Return where a result goes; an `InputError` before anything is computed where it can't be written there."""
    target = Path(path)
    if target.suffix.lower() not in endings:
        raise InputError(f"{option} = {path}: the name must end in {' or '.join(endings)}.")
    if not target.parent.is_dir():
        raise InputError(f"{option} = {path}: the folder {target.parent} does not exist.")
    return target


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path` and rename it to `path` on success: readers see all of it or nothing."""
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError(f"{path}: the folder {target.parent} does not exist.")
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.stem}-", suffix=target.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def json_text(data: Any) -> str:
    """Return JSON with arrays as lists and NaN as null, which is what other languages' readers accept."""

    def plain(x: Any) -> Any:
        if isinstance(x, dict):
            return {str(k): plain(v) for k, v in x.items()}
        if hasattr(x, "tolist"):
            return plain(x.tolist())
        if isinstance(x, list | tuple):
            return [plain(v) for v in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    return json.dumps(plain(data), indent=1, allow_nan=False)


def run(app: Callable[[], typer.Typer]) -> NoReturn:
    """Run a command line: bad input exits 2 with its sentence, an interrupt 130, a failure in the middle 1."""
    debug = bool(os.environ.get("CYCLOID_TRACEBACK"))
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app()()
    except InputError as problem:
        if debug:
            raise
        _say(str(problem))
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        _say("Interrupted; what was finished is kept.")
        sys.exit(INTERRUPTED)
    except Exception as problem:
        if debug:
            raise
        _say(f"Failed: {type(problem).__name__}: {problem} (CYCLOID_TRACEBACK=1 shows where)")
        sys.exit(FAILED)
    sys.exit(DONE)


def _say(text: str) -> None:
    sys.stdout.flush()
    print(text, file=sys.stderr, flush=True)
