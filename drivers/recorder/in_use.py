"""Detection of a bench in use: locks between the recordings and runs on one machine, and listening on the buses."""

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
from drivers.can.bus import SYNC_ID, open_bus
from drivers.encoder import EncoderSetupError, Wiring
from drivers.lines import BusConfig

WAIT_SECONDS = 5.0  # for a killed run to bring its drive to rest
LISTEN_SECONDS = 0.25
_MOVED = 16  # counts: more than the noise of an encoder at rest, fewer than at 1 rpm
_STRAIGHT = 0.9  # least ratio of net to total motion: noise goes back and forth
_FEWEST = 3  # positions needed


class Claims:
    """The lines reserved by a recording or run on this machine; a context manager that releases them.

    A claim is a file lock, which the system releases when the last process that holds it ends.
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

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors of the locks; a child process that inherits them holds the claim too."""
        return tuple(file.fileno() for file, _ in self._files.values())

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
            what = f"{line.noun} {line.place}"
            if what not in self._files:
                folder = Path(platformdirs.user_cache_dir("cycloid-fmu", appauthor=False)) / "in-use"
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                    with tempfile.TemporaryFile(dir=folder):
                        pass
                except OSError as problem:
                    said = f"{folder}: {problem.strerror}; another recording of the same {what} is not noticed."
                    warnings.warn(said, edge.InputWarning, stacklevel=2)
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


def check_at_rest(wiring: Wiring, nodes: dict[str, set[int]]) -> None:
    """Listen for another master on the CAN buses of a wiring before anything is started.

    Parameters
    ----------
    wiring
        The buses.
    nodes
        Numbers of the CANopen nodes on each bus, by the bus's name.

    Raises
    ------
    EncoderSetupError
        If a node's position moves, or another device sends SYNC although the recorder is to send it.
    """
    for name, config in wiring.lines.get(BusConfig.kind, {}).items():
        assert isinstance(config, BusConfig)
        identifiers = {base + node: node for node in nodes.get(name, ()) for base in (0x180, 0x280, 0x380, 0x480)}
        positions: dict[int, list[int]] = {}
        synced = False
        with open_bus(config) as bus:
            end = time.monotonic() + LISTEN_SECONDS
            while (left := end - time.monotonic()) > 0.0:
                message = bus.recv(left)
                if message is None or message.is_extended_id or message.is_error_frame or message.is_remote_frame:
                    continue
                synced |= message.arbitration_id == SYNC_ID
                if message.arbitration_id in identifiers and len(message.data) >= 4:
                    node = identifiers[message.arbitration_id]
                    positions.setdefault(node, []).append(int.from_bytes(message.data[:4], "little"))
        moving = [node for node, shown in positions.items() if _moves(shown)]
        if moving:
            raise EncoderSetupError(
                f"The CAN bus {config.place} is in use: node {moving[0]} moves before the command of this step was "
                "started; stop the program that drives the bench, such as the command of a killed run, and run again."
            )
        if synced and config.sync_period is not None:
            raise EncoderSetupError(
                f"The CAN bus {config.place} is in use: another device sends SYNC, which the recorder is to send by "
                "sync_period; stop the other device, or remove sync_period."
            )


def _moves(positions: list[int]) -> bool:
    """Whether 32-bit positions, which roll over, move in one direction."""
    steps = [(b - a + (1 << 31)) % (1 << 32) - (1 << 31) for a, b in itertools.pairwise(positions)]
    way = abs(sum(steps))
    return len(positions) >= _FEWEST and way > _MOVED and way >= _STRAIGHT * sum(map(abs, steps))
