"""Cache of computed values in the user's cache folder.

A file's name is the hash of what its value depends on; its first bytes are the hash of the rest. A file that does not
match or cannot be read is made again. If all files of a kind together take too much space, the least recently used are
removed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeVar

from cycloid_fmu.edge.files import written_whole
from cycloid_fmu.edge.problems import InputError

_DIGEST = hashlib.sha256().digest_size
Value = TypeVar("Value")


def cached(
    kind: str,
    asked: str,
    make: Callable[[], Value],
    *,
    write: Callable[[Value], bytes],
    read: Callable[[bytes], Value],
    most_bytes: int,
) -> Value:
    """Return a value from the cache, or make and store it.

    Parameters
    ----------
    kind
        Name of the folder, and ending of the files' names.
    asked
        Everything that the value depends on, as text.
    make
        Computes the value.
    write, read
        Value to bytes and back.
    most_bytes
        Most space of all files of this kind.
    """
    import platformdirs

    folder = Path(platformdirs.user_cache_dir("cycloid-fmu", appauthor=False)) / kind
    path = folder / f"{hashlib.sha256(asked.encode()).hexdigest()}.{kind}"
    with contextlib.suppress(Exception):  # a damaged file is made again, whatever the damage
        data = path.read_bytes()
        if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST]:
            value = read(data[_DIGEST:])
            os.utime(path)
            return value
    value = make()
    with contextlib.suppress(OSError, InputError):  # without a writable cache, values are not stored
        folder.mkdir(parents=True, exist_ok=True)
        body = write(value)
        with written_whole(path) as temporary:
            temporary.write_bytes(hashlib.sha256(body).digest() + body)
        _tidy(folder, kind, most_bytes)
    return value


class _Shown:
    """What shows the making of values for the cache; a command line sets its own."""

    bar: Callable[[str, float], AbstractContextManager[Callable[[float], None]]] | None = None


def show_making(bar: Callable[[str, float], AbstractContextManager[Callable[[float], None]]]) -> None:
    """Have `making` show its progress by a function such as `commands.progress`."""
    _Shown.bar = bar


@contextlib.contextmanager
def making(what: str, total: float) -> Iterator[Callable[[float], None]]:
    """Yield the function to call with the number of items just made, of `total`; a command shows them as progress."""
    if _Shown.bar is None:
        yield lambda items: None
    else:
        with _Shown.bar(what, total) as advance:
            yield advance


def hash_of_code(places: Iterable[Path]) -> str:
    """Hash of Python files, and of those in folders."""
    digest = hashlib.sha256()
    for place in places:
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _tidy(folder: Path, kind: str, most_bytes: int) -> None:
    """Remove the least recently used files if all take more than `most_bytes`."""
    files = sorted(((p.stat(), p) for p in folder.glob(f"*.{kind}")), key=lambda entry: -entry[0].st_mtime_ns)
    for status, path in files:
        most_bytes -= status.st_size
        if most_bytes < 0:
            path.unlink(missing_ok=True)
