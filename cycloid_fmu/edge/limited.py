"""Other people's parsers run in a process with limits: no file hangs, fills or ends the program that reads it.

A parser may follow a link that leads to itself, allocate what a length in the file asks for, or crash. The process
that reads for this one is started for the first file and kept for the next. It has the rights of this one: it keeps
faults in, not code.
"""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import gc
import importlib
import inspect
import json
import logging
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

from cycloid_fmu.edge.problems import InputError, first_line

T = TypeVar("T")

_SECONDS = 3.0  # processor time for any file, s
_TEXT, _TEXT_PER_SECOND = 350e3, 5e4  # bytes, and how fast they are read at least: the slowest parser is that of a DBC
_BYTES_PER_SECOND = 4e6  # how fast a large file is read at least
_BYTES, _BYTES_PER_BYTE = 1 << 30, 4  # memory for any file, and for each byte of it
_POLL = 0.05  # s between looks at the process
_BACKSTOP = 20  # a process that nobody watches any more ends itself after this multiple of the limit, by the clock
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from cycloid_fmu.edge import limited; limited.serve()"
)
_LOST = (EOFError, OSError, pickle.UnpicklingError)  # the other process has ended


class Limits(NamedTuple):
    """Limits of reading a file: processor time until each result, s, and memory, bytes."""

    seconds: float
    memory: float


def limits_of(source: str | os.PathLike[str]) -> Limits:
    """Return the limits of reading a file; they grow with its size."""
    size = Path(source).stat().st_size
    seconds = _SECONDS + min(size, _TEXT) / _TEXT_PER_SECOND + size / _BYTES_PER_SECOND
    return Limits(seconds, _BYTES + _BYTES_PER_BYTE * size)


def call_limited(source: str | os.PathLike[str], function: Callable[..., T], *args: object, needs: str = "") -> T:
    """Return `function(*args)`, computed in a process with the limits of the file `source`.

    Parameters
    ----------
    source
        The file that is read, for the limits and for messages.
    function
        A public function of a module.
    args
        Its arguments; they and the result are pickled.
    needs
        Package that the function imports, whose import does not count.

    Raises
    ------
    InputError
        As the function raises it, or if it exceeds a limit or ends its process.
    RuntimeError
        For any other exception of the function, with its first line.
    """
    if _serving:
        return function(*args)
    with contextlib.closing(_results(source, function, args, needs)) as results:
        result: T = next(results)
    return result


def each_limited(
    source: str | os.PathLike[str], function: Callable[..., Iterator[T]], *args: object, needs: str = ""
) -> Iterator[T]:
    """Yield what the generator `function(*args)` yields, as `call_limited`; the limit of time applies to each result.

    The next result is computed while the caller uses this one.
    """
    return function(*args) if _serving else _results(source, function, args, needs)


def _results(source: str | os.PathLike[str], function: Callable[..., Any], args: tuple[object, ...], needs: str) -> Any:
    limits = limits_of(source)
    worker = _idle_worker() or _Worker()
    watch, free = _Watch(worker.process, limits), False
    try:
        worker.send((function.__module__, function.__qualname__, needs))
        worker.receive()
        watch.begin()
        worker.send((args, _folder(), limits.seconds))
        kind, result = worker.receive()
        while kind == "result":
            watch.begin()
            worker.send(True)
            try:
                yield result
            except GeneratorExit:  # the next result is being computed, and comes still
                with contextlib.suppress(*_LOST):
                    if worker.receive()[0] == "result":
                        worker.send(False)
                        worker.receive()
                    free = True
                raise
            kind, result = worker.receive()
        free = True
    except _LOST:
        worker.end()
        reason = watch.exceeded or f"ends the process that reads it (exit status {worker.process.returncode})"
        raise InputError(f"{source}: this file is damaged or too complex: reading it {reason}.") from None
    finally:
        watch.end()
        if free and not watch.exceeded and not _idle:
            _idle.append(worker)
        else:
            worker.end()
    if kind == "refused":
        raise InputError(result)
    if kind == "failed":
        raise RuntimeError(result)


class _Worker:
    """A process that computes for this one."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if os.environ.get("CYCLOID_TRACEBACK") else subprocess.DEVNULL,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        try:
            self.receive()
        except _LOST:
            self.end()
            raise RuntimeError(f"{sys.executable} starts no process that reads files") from None

    def send(self, data: object) -> None:
        assert self.process.stdin is not None, "it is a pipe"
        pickle.dump(data, self.process.stdin, pickle.HIGHEST_PROTOCOL)
        self.process.stdin.flush()

    def receive(self) -> Any:
        assert self.process.stdout is not None, "it is a pipe"
        return pickle.load(self.process.stdout)

    def end(self) -> None:
        """End the process; a second call does nothing."""
        self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what was not sent yet
                    pipe.close()
        self.process.wait()


_idle: list[_Worker] = []
_serving = False


def _idle_worker() -> _Worker | None:
    try:
        worker = _idle.pop()
    except IndexError:
        return None
    if worker.process.poll() is None:
        return worker
    worker.end()
    return None


@atexit.register
def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)  # they read for the process that started them


class _Watch:
    """A thread that ends a process that exceeds its limits.

    Attributes
    ----------
    exceeded
        What it did, or "".
    """

    def __init__(self, process: subprocess.Popen[bytes], limits: Limits) -> None:
        import psutil

        self.exceeded = ""
        self._process, self._limits, self._seen = process, limits, psutil.Process(process.pid)
        self._ended = threading.Event()
        self._allowed = math.inf
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Begin the time of a result."""
        import psutil

        with contextlib.suppress(psutil.Error):  # the process has ended
            self._allowed = self._spent() + self._limits.seconds

    def end(self) -> None:
        """Stop watching."""
        self._ended.set()
        self._thread.join()

    def _spent(self) -> float:
        times = self._seen.cpu_times()
        return float(times.user + times.system)

    def _watch(self) -> None:
        import psutil

        with contextlib.suppress(psutil.Error):  # the process has ended
            while not self._ended.wait(_POLL):
                if self._spent() > self._allowed:
                    self.exceeded = f"takes more than {self._limits.seconds:.0f} s of processor time"
                elif self._seen.memory_info().rss > self._limits.memory:
                    self.exceeded = f"takes more than {self._limits.memory / 1e9:.1f} GB of memory"
                if self.exceeded:
                    self._process.kill()
                    return


def _folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


def serve() -> None:
    """Compute for the process that started this one, until that one ends."""
    global _serving
    _serving = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process is interrupted too, and ends this one
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with Path(os.devnull).open("r+b") as nothing:  # parsers print
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
    if not os.environ.get("CYCLOID_TRACEBACK"):
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
    try:
        _send(answers, "ready", None)
        while True:
            _answer(requests, answers)
            os.chdir(Path(sys.executable).parent)  # Windows removes no folder that a process is in
            gc.collect()  # and no file that is open
            gc.freeze()  # what stays, such as modules, is not scanned again
    except (EOFError, OSError):
        os._exit(0)


def _answer(requests: BinaryIO, answers: BinaryIO) -> None:
    module, name, needs = pickle.load(requests)
    with contextlib.suppress(ImportError):  # the function says so
        if needs:
            importlib.import_module(needs)
    function = getattr(importlib.import_module(module), name)
    _send(answers, "ready", None)
    args, folder, seconds = pickle.load(requests)
    with contextlib.suppress(OSError):
        os.chdir(folder or ".")
    results: Iterator[Any] | None = None
    while True:
        faulthandler.dump_traceback_later(_BACKSTOP * seconds, exit=True)
        try:
            if results is None:
                made = function(*args)
                results = made if inspect.isgenerator(made) else iter([made])
            kind, result = "result", next(results)
        except StopIteration:
            kind, result = "end", None
        except InputError as problem:
            kind, result = "refused", str(problem)
        except Exception as problem:  # parsers raise exceptions of any class
            kind, result = "failed", first_line(problem)
        faulthandler.cancel_dump_traceback_later()
        _send(answers, kind, result)
        if kind != "result":
            return
        if not pickle.load(requests):
            _send(answers, "end", None)
            return


def _send(answers: BinaryIO, kind: str, result: object) -> None:
    pickle.dump((kind, result), answers, pickle.HIGHEST_PROTOCOL)
    answers.flush()
