"""Files: reading text, TOML, JSON and tables with units; writing without ever leaving a partial file."""

from __future__ import annotations

import codecs
import contextlib
import csv
import errno
import importlib.resources
import json
import math
import os
import re
import shutil
import stat
import sys
import tempfile
import tomllib
import xml.parsers.expat
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cycloid_fmu.edge.file_kinds import check_format, needed, wrong_kind
from cycloid_fmu.edge.problems import ArgumentError, InputError, cut, first_line, parsed_by_others, shown
from cycloid_fmu.edge.quantities import unit_scale

_LARGEST_NUMBER = 1e15  # in a table, in its own unit
_MOST_PARTS = 50  # of a TOML key such as material.gear.youngs_modulus
_MOST_BYTES = 4 << 30  # largest size of data unpacked
_MOST_SMALL, _MOST_RATIO = 64 << 20, 100  # bytes of any archive unpacked, and for each byte of it: logs reach about 30
_LONGEST_XML = 16 << 20  # about 150,000 variables of an FMU, read in 10 s
PICTURES = (".png", ".pdf")
"""Endings of plot files."""


def most_unpacked(path: str | os.PathLike[str], kept: bool = True) -> int:
    """Return how many bytes a compressed file may unpack to; more than its contents explain is made to fill a disk.

    Parameters
    ----------
    path
        The file.
    kept
        Whether all of it is unpacked at once, which is limited for any file, and not piece by piece.
    """
    explained = _MOST_SMALL + _MOST_RATIO * Path(path).stat().st_size
    return min(_MOST_BYTES, explained) if kept else explained


_KEY = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{_MOST_PARTS}}}")


def _toml(text: str) -> dict[str, Any]:
    """Return the table of a TOML text; raise a ValueError if it is none."""
    if long := _LONG_KEY.search(text):  # tomllib's time and memory grow with the square of its parts
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"line {line}: a key of more than {_MOST_PARTS} parts")
    return tomllib.loads(text)


def toml_table(text: str, wanted_format: str, source: str) -> dict[str, Any]:
    """Return the table of a TOML text of the wanted format, without its `format` key."""
    try:
        table = _toml(text)
    except (ValueError, RecursionError) as problem:
        refused = wrong_kind(source, needed(wanted_format))
        raise refused or InputError(f"{source}: this is not TOML ({first_line(problem)}).") from None
    if "format" not in table:
        raise InputError(f'{source}: format is missing; the first line must be format = "{wanted_format}".')
    check_format(table.pop("format"), wanted_format, source)
    return table


def json_table(path: str | os.PathLike[str], wanted_format: str, what: str) -> dict[str, Any]:
    """Return the table of a JSON file of the wanted format; `what` names its contents in messages, such as "figures".

    Raises
    ------
    InputError
        If it can't be read, is not a JSON object, or has another format.
    """
    text = read_text(path, wanted_format)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as problem:
        refused = wrong_kind(path, needed(wanted_format))
        raise refused or InputError(f"{path}: this is not JSON ({first_line(problem)}).") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: it holds no {what}; it must be a JSON object.")
    check_format(data.get("format"), wanted_format, str(path))
    return data


def format_of(path: str | os.PathLike[str]) -> object:
    """Return the `format` of a TOML file; None if it has none or can't be read, which its reader reports."""
    try:
        return _toml(read_text(path)).get("format")
    except (ValueError, RecursionError):
        return None


def read_text(path: str | os.PathLike[str], wanted_format: str | None = None) -> str:
    """Return the text of a UTF-8 file; raise an `InputError` if it can't be read or is a device, a pipe or a socket.

    The error names `wanted_format`, if it is given, where the file is of another kind.
    """
    try:
        return existing(path).read_text(encoding="utf-8-sig")  # Windows editors begin UTF-8 with a byte order mark
    except UnicodeDecodeError:
        what = "a text file" if wanted_format is None else needed(wanted_format)
        raise wrong_kind(path, what) or InputError(f"{path}: this is not a UTF-8 text file.") from None
    except OSError as problem:
        raise InputError(f"{path}: {problem.strerror or problem}.") from None


_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


def decoded(data: bytes, source: object) -> tuple[str, str]:
    """Return encoding and text of a table or of its first bytes.

    The encoding is that of the byte order mark, else UTF-8, else Windows-1252, which has the characters of Latin-1.

    Parameters
    ----------
    data
        The bytes; a character that is cut at their end is left out.
    source
        The file's name, for messages.

    Raises
    ------
    InputError
        If it is not text in one of these encodings.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding, codecs.getincrementaldecoder(encoding)(errors="replace").decode(data)
    if b"\0" in data:
        raise InputError(f"{source}: this is not a text table; it contains zero bytes.")
    for encoding in ("utf-8", "cp1252"):
        try:
            return encoding, codecs.getincrementaldecoder(encoding)().decode(data)
        except UnicodeDecodeError:
            continue
    raise InputError(f"{source}: this is not a text table; its encoding is none of UTF-8, UTF-16, Windows-1252.")


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a readable file or folder; raise an `InputError` if there is none.

    Devices, pipes and sockets are refused before they are opened: opening a device can have side effects, and reading
    may never end.
    """
    try:
        mode = Path(path).stat().st_mode
        kernels = os.name == "posix" and Path(path).resolve().parts[1:2] in (("proc",), ("sys",))
        if stat.S_ISDIR(mode) or (stat.S_ISREG(mode) and not kernels):
            with Path(path).open("rb"):
                return Path(path)
    except (OSError, ValueError) as problem:  # a ValueError if a name contains a null byte
        raise InputError(f"{cut(str(path), 300)}: {getattr(problem, 'strerror', None) or problem}.") from None
    kind = "a virtual file of the kernel" if stat.S_ISREG(mode) else _kind(mode)
    raise InputError(f"{path}: this is {kind}; only regular files are read.")


def _kind(mode: int) -> str:
    """Return the kind of a directory entry that is not a regular file, as words for a message."""
    kinds = {stat.S_ISLNK: "a link", stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}
    return next((name for is_one, name in kinds.items() if is_one(mode)), "a device")


def unit_columns(
    header: Sequence[str], wanted: Mapping[str, str], source: str, optional: Mapping[str, str] = MappingProxyType({})
) -> dict[str, tuple[int, float]]:
    """Return position and scale to SI of the wanted columns of a table with units in its header, `time [s]`.

    Parameters
    ----------
    header
        The header's cells.
    wanted
        SI unit of each required column; others are ignored.
    source
        The file's name, for messages.
    optional
        SI unit of each optional column.

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
            raise InputError(f'{source}: the column {shown(cell.strip())} has no unit; write "{name} [{units[name]}]".')
        try:
            found[name] = (position, unit_scale(unit[:-1].strip(), units[name]))
        except ValueError as problem:
            raise InputError(f"{source}: the column {name}: {problem}.") from None
    for name, unit in wanted.items():
        if name not in found:
            raise InputError(f'{source}: there is no column "{name} [{unit}]" in the header.')
    return found


def finite(cell: str, field: str) -> float:
    """Return the number in a cell of a table.

    Raises
    ------
    InputError
        If it is no finite number, or beyond what anybody measures, whose square may overflow; it begins with `field`.
    """
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{field} = {shown(cell)}: it must be a finite number with a decimal point.")
    if abs(value) > _LARGEST_NUMBER:
        raise InputError(f"{field} = {shown(cell)}: it must be within ±{_LARGEST_NUMBER:g}.")
    return value


def csv_rows(path: str | os.PathLike[str]) -> Iterator[list[str]]:
    """Yield the cells of a CSV file's lines, encoded as in `decoded`; raise an `InputError` if it can't be read."""
    if (refused := wrong_kind(path, "a table (CSV)", tables=True)) is not None:
        raise refused
    try:
        text = decoded(existing(path).read_bytes(), path)[1]
    except OSError as problem:
        raise InputError(f"{path}: {problem.strerror or problem}.") from None
    rows = csv.reader(text.splitlines())
    while True:
        with parsed_by_others(path, "this is not a CSV table"):
            row = next(rows, None)
        if row is None:
            return
        yield row


def packaged_text(package: str, name: str) -> str:
    """Return the text of a file that is part of a package."""
    return importlib.resources.files(package).joinpath(name).read_text(encoding="utf-8")


def packaged_rows(package: str, name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV table that is part of a package, each by the names in the header."""
    return list(csv.DictReader(packaged_text(package, name).splitlines()))


def number_rows(
    path: str | os.PathLike[str], wanted: Mapping[str, str], optional: Mapping[str, str] = MappingProxyType({})
) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield the lines of a CSV table with units in its header: line and {column: value in SI}, without blank lines.

    Parameters
    ----------
    path
        The file.
    wanted, optional
        As for `unit_columns`.

    Raises
    ------
    InputError
        If it can't be read, a column or its unit is missing, or a cell is not a finite number; it names the line.
    """
    lines = csv_rows(path)
    columns = unit_columns(next(lines, []), wanted, str(path), optional)
    for number, row in enumerate(lines, start=2):
        if row:
            cells = {name: row[place].strip() if place < len(row) else "" for name, (place, _) in columns.items()}
            yield number, {n: finite(c, f"{path}: line {number}: {n}") * columns[n][1] for n, c in cells.items()}


def output_path(path: str | os.PathLike[str], argument: str, endings: Collection[str]) -> Path:
    """Check and return the path of a result, before anything is computed.

    Raises
    ------
    ArgumentError
        If the name does not have the format's ending, its folder does not exist, or a folder, link, device, pipe or
        socket has the name; the error names `argument`.
    """
    target = Path(path)
    if target.suffix.lower() not in endings:
        raise ArgumentError(argument, f"the name must end in {' or '.join(endings)}", target)
    if problem := _unwritable(target):
        raise ArgumentError(argument, problem, target)
    return target


def _unwritable(target: Path) -> str:
    """Return the reason why no file can be written under this name, or ""."""
    try:
        if not target.parent.is_dir():
            return f"the folder {target.parent} does not exist"
        mode = target.lstat().st_mode
    except FileNotFoundError:
        return ""
    except (OSError, ValueError) as problem:
        return f"this can't be written: {getattr(problem, 'strerror', None) or problem}"
    return "" if stat.S_ISREG(mode) else f"{_kind(mode)} has this name; only regular files are written"


def writable(path: str | os.PathLike[str]) -> Path:
    """Return a path that is free or a regular file; raise an `InputError` for anything else found there."""
    if problem := _unwritable(Path(path)):
        raise InputError(f"{path}: {problem}.")
    return Path(path)


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add the file's name to an `OSError` while writing: failed writes do not include it."""
    try:
        yield
    except OSError as problem:
        if problem.errno is None or problem.filename is not None:
            raise
        raise OSError(problem.errno, os.strerror(problem.errno), str(path)) from problem


def created_folder(path: str | os.PathLike[str]) -> Path:
    """Return a folder for results, which is created if it is missing.

    Raises
    ------
    InputError
        If it can't be created.
    """
    folder = Path(path)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as failure:
        raise InputError(f"{path}: it can't be created as a folder: {failure.strerror}.") from None
    return folder


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path next to `path` and rename it to `path` on success: readers never see a partial file.

    Unfinished files of killed commands next to it are removed.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or the path is not a plain file.
    OSError
        If the disk is full; it names the file.
    """
    target = writable(path)
    try:
        _remove_left(target.parent)
        folder, lock = _own_folder(target)
    except OSError as problem:
        raise InputError(f"{path}: this can't be written: {problem.strerror or problem}.") from None
    temporary = folder / target.name
    try:
        with naming(path):
            yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(writable(path))
    finally:
        os.close(lock)
        shutil.rmtree(folder, ignore_errors=True)


_LEFT = ".cycloid-part"  # ending of folders with a file being written
_LOCK = "lock"  # in each folder; held while its file is being written


def _own_folder(target: Path) -> tuple[Path, int]:
    """Return a new folder beside a file to be written, and the descriptor of its lock, which is held."""
    while True:
        folder = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:40]}.", suffix=_LEFT))
        try:
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o600)
        except FileNotFoundError:  # another process removed it as abandoned, before it was locked
            continue
        except OSError:
            folder.rmdir()
            raise
        if _locked(lock) is not False and (folder / _LOCK).exists():
            return folder, lock
        os.close(lock)


def _remove_left(folder: Path) -> None:
    """Remove the unfinished files of a writer that has ended, which released its lock."""
    for left in folder.glob(f".*{_LEFT}"):
        with contextlib.suppress(OSError):  # in use, or just removed by another process
            if left.is_symlink():
                continue
            if not any(left.iterdir()):
                left.rmdir()
                continue
            lock = os.open(left / _LOCK, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if free := _locked(lock):
                    shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(lock)
            if free:  # Windows can't remove an open file
                shutil.rmtree(left, ignore_errors=True)


def _locked(descriptor: int) -> bool | None:
    """Lock an open file; the lock is released when the process ends.

    Returns
    -------
    bool or None
        False if another process has it, None if the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as problem:
        return False if problem.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK) else None
    return True


def zip_archive(path: str | os.PathLike[str], what: str, description: str | None = None) -> Path:
    """Return the path of a file that is a ZIP archive and may be unpacked.

    Parameters
    ----------
    path
        The file.
    what
        Kind of file, for messages, such as "FMU".
    description
        Name of the XML file in it that will be read.

    Raises
    ------
    InputError
        If it is not an archive, unpacks to more than 4 GiB, or its XML file is longer than 16 MiB, can't be parsed, or
        has a document type declaration, whose entities can expand without limit or include other files.
    """
    if not zipfile.is_zipfile(existing(path)):
        raise wrong_kind(path, f"an {what}") or InputError(f"{path}: this is not an {what}: it must be a ZIP archive.")
    with parsed_by_others(path, f"this is not an {what}, or it is damaged"), zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > (most := most_unpacked(path)):
            raise InputError(f"{path}: it unpacks to more than {most / 1e6:.0f} MB.")
        if description is not None and description in archive.namelist():
            if archive.getinfo(description).file_size > _LONGEST_XML:
                raise InputError(f"{path}: its {description} is longer than {_LONGEST_XML >> 20} MiB.")
            _check_xml(archive.read(description), f"{path}: its {description}")
    return Path(path)


def _check_xml(data: bytes, what: str) -> None:
    def refuse(*_: object) -> None:
        raise InputError(f"{what} has a document type declaration (DOCTYPE), which is not allowed.")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    # What this parser can't read, such as UTF-32, no other one sees: its declarations were not checked.
    with parsed_by_others(what, "this is not XML in UTF-8, or it is damaged"):
        parser.Parse(data, True)


def json_text(data: Any) -> str:
    """Return JSON with NaN as null, which readers in other languages accept; each array is one line.

    Examples
    --------
    >>> print(json_text({"angle": [0.0, 0.5], "backlash": float("nan")}))
    {
     "angle": [0.0, 0.5],
     "backlash": null
    }
    """

    def plain(x: Any) -> Any:
        if isinstance(x, dict):
            return {str(k): plain(v) for k, v in x.items()}
        if hasattr(x, "tolist"):
            return plain(x.tolist())
        if isinstance(x, list | tuple):
            return [plain(v) for v in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    def text(x: Any, indent: str) -> str:
        if isinstance(x, dict) and x:
            inner = [f"{json.dumps(k)}: {text(v, indent + ' ')}" for k, v in x.items()]
        elif isinstance(x, list) and any(isinstance(v, dict | list) for v in x):
            inner = [text(v, indent + " ") for v in x]
        else:
            return json.dumps(x, allow_nan=False)
        opening, closing = "{}" if isinstance(x, dict) else "[]"
        return f"{opening}\n{indent} " + f",\n{indent} ".join(inner) + f"\n{indent}{closing}"

    return text(plain(data), "")
