"""A command that never outlives its starter: even if the starter is killed, no device is left turning.

A process between the two waits for the end of a pipe that only the starter holds open; the system closes it when the
starter ends, on every platform and after every signal. Then the command is ended, the drive's own stop command is run,
and the devices that were started on the buses of the wiring are stopped.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

_INPUT = 0  # read without Python's buffers, whose lock a waiting thread would hold at exit
_DONE = b"done\n"
GRACE_SECONDS = 2.0  # for the command to end after SIGTERM
STOP_SECONDS = 10.0  # for the drive's stop command


@contextlib.contextmanager
def watched(
    command: Sequence[str],
    *,
    folder: Path | None = None,
    stop: Sequence[str] | None = None,
    wiring: Path | None = None,
    allow: Collection[str] = (),
    quiet: bool = True,
    held: Collection[int] = (),
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command in parallel; it ends with the `with` block, or with this process.

    Parameters
    ----------
    command, folder
        The command and its folder.
    stop
        Command to run if the first did not end with status 0.
    wiring, allow
        `BENCH.toml` whose devices are stopped if this process ends without leaving the block, and the connections
        allowed for it; see `recorder.bench.read_bench`.
    quiet
        Whether to discard the command's standard error.
    held
        File descriptors, such as locks, to keep open until the command has ended and its devices are at rest.

    Yields
    ------
    subprocess.Popen
        A process that ends when the command does, with the same status.

    Raises
    ------
    OSError
        If the command can't be started.
    """
    _check_program(command[0], folder)
    told = {
        "command": list(command),
        "folder": None if folder is None else str(folder.resolve()),
        "stop": None if stop is None else list(stop),
        "wiring": None if wiring is None else str(wiring.resolve()),
        "allow": list(allow),
        "quiet": quiet,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "drivers.recorder.watchdog"],
        stdin=subprocess.PIPE,
        start_new_session=True,
        pass_fds=tuple(held) if os.name == "posix" else (),
    )
    assert process.stdin is not None
    try:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(told).encode() + b"\n")
            process.stdin.flush()
        yield process
    finally:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(_DONE)
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        process.wait()
        _kill_group(process.pid)  # in case the process between was killed


def _check_program(name: str, folder: Path | None) -> None:
    """Raise the OSError that starting a program would raise, if it is missing or not executable."""
    path = Path(folder or ".") / name if os.path.dirname(name) else shutil.which(name)
    if path is None or not os.path.exists(path):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    if os.path.isdir(path) or not os.access(path, os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), name)


def _kill_group(number: int) -> None:
    if os.name == "posix":
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(number, signal.SIGKILL)


def main() -> None:
    """Run as the process between: read the command as a line of JSON; end of input means that the starter ended."""
    line = b""
    while not line.endswith(b"\n"):
        more = os.read(_INPUT, 1)
        if not more:
            return
        line += more
    told = json.loads(line)
    signal.signal(signal.SIGTERM, lambda number, frame: None)  # meant for the command, which has the same group
    try:
        command = subprocess.Popen(
            told["command"],
            cwd=told["folder"],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL if told["quiet"] else None,
        )
    except OSError as problem:
        sys.exit(f"{told['command'][0]}: {problem.strerror}.")
    left = threading.Event()
    said: list[bytes] = []
    threading.Thread(target=_until_left, args=(command, left, said), daemon=True).start()
    status = command.wait()
    if os.name == "posix":
        # Its child processes end with it: if the starter is killed later, nobody is left to end them.
        os.killpg(os.getpgrp(), signal.SIGTERM)
    if status or left.is_set():
        _stop(told["stop"], told["folder"])
    if left.is_set() and said != [_DONE] and told["wiring"] is not None:
        _rest(told["wiring"], told["allow"])
    if left.is_set():
        _kill_group(os.getpgrp() if os.name == "posix" else 0)  # child processes of the command, and this process
    sys.exit(status & 0xFF)


def _until_left(command: subprocess.Popen[bytes], left: threading.Event, said: list[bytes]) -> None:
    said.append(os.read(_INPUT, len(_DONE)))
    left.set()
    if os.name == "posix":
        os.killpg(os.getpgrp(), signal.SIGTERM)
    else:
        command.terminate()
    try:
        command.wait(GRACE_SECONDS)
    except subprocess.TimeoutExpired:
        command.kill()


def _stop(command: list[str] | None, folder: str | None) -> None:
    """Run the drive's own stop command."""
    if command is not None:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            subprocess.run(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                timeout=STOP_SECONDS,
                check=False,
            )


def _rest(wiring: str, allow: list[str]) -> None:
    """Stop the devices of a wiring; a failure of one does not affect the others."""
    from drivers.recorder.bench import read_bench

    with contextlib.suppress(Exception):  # nobody is left to read an error
        for encoder in read_bench(wiring, allow=allow).encoders():
            with contextlib.suppress(Exception):
                encoder.rest()


if __name__ == "__main__":
    main()
