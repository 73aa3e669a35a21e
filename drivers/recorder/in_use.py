"""Detection of a bench in use: locks between the recordings and runs on one machine."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tempfile
import time
import warnings
import zlib
from pathlib import Path
from typing import IO, Self

import platformdirs

from cycloid_fmu import edge
from drivers.encoder import EncoderSetupError
from drivers.plug_in import Wiring

WAIT_SECONDS = 5.0  # for a recording that is ending


class Claims:
    """The lines reserved by a recording or run on this machine; a context manager that releases them.

    A claim is a file lock, which the system releases when the process ends.
    """

    def __init__(self) -> None:
        self._files: dict[str, tuple[IO[str], Path]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *problem: object) -> None:
        for file, path in self._files.values():
            with contextlib.suppress(OSError):  # Windows removes no file that is open
                path.unlink()
            file.close()
        self._files.clear()

    def claim(self, wiring: Wiring) -> None:
        """Claim all lines of a wiring, except those that belong to one process.

        Where no folder for locks can be written, an `edge.InputWarning` says that nothing is reserved.

        Raises
        ------
        EncoderSetupError
            If another one still holds one of them after `WAIT_SECONDS`.
        """
        for line in itertools.chain.from_iterable(named.values() for named in wiring.lines.values()):
            if line.is_private:
                continue
            what = f"{line.noun} {line.address}"
            if what not in self._files:
                folder = Path(platformdirs.user_cache_dir("cycloid-fmu", appauthor=False)) / "in-use"
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                    with tempfile.TemporaryFile(dir=folder):
                        pass
                except OSError as problem:
                    sentence = f"{folder}: {problem.strerror}; another recording of the same {what} is not noticed."
                    warnings.warn(sentence, edge.InputWarning, stacklevel=2)
                    return
                path = folder / f"{zlib.crc32(what.encode()):08x}"
                self._files[what] = _locked(path, what), path


def _locked(path: Path, what: str) -> IO[str]:
    end = time.monotonic() + WAIT_SECONDS
    while True:
        file = path.open("a+", encoding="utf-8")
        # The previous holder may just have removed the file.
        if _lock(file) and path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            return file
        file.seek(0)
        who = file.read().strip() or "?"
        file.close()
        if time.monotonic() >= end:
            raise EncoderSetupError(
                f"The {what} is in use by another recording or run, process {who}; end that one first."
            )
        time.sleep(0.05)


def _lock(file: IO[str]) -> bool:
    """Lock a file for this process and its children; False if another process holds it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
