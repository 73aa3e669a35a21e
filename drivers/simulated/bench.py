"""What every simulated bench is: a motion that a thread sends, and the wiring that records it."""

from __future__ import annotations

import abc
import os
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from cycloid_fmu import edge
from drivers.simulated.motion import Motion, SimulatedRun


def conditions_text(run: SimulatedRun) -> str:
    """Return the table `[conditions]` of a `BENCH.toml` that says what the run is."""
    return (
        f'[conditions]\nload = "{edge.format_quantity(run.torque, "N*m", "N*m")}"\n'
        f'speed = "{edge.format_quantity(run.speed, "rad/s", "rad/s")}"\ndirection = "{run.direction}"\n'
    )


def head_text(ratio: float | None, pair: str) -> str:
    """Return the first lines of a `BENCH.toml`."""
    shown = f"ratio = {float(ratio)!r}\n" if ratio is not None else ""
    return f'format = "cycloid-bench/1"\n{shown}pair = {edge.json_text(pair)}\n\n'


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write a text file that appears whole, and return its path."""
    with edge.written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


class SimulatedBench(abc.ABC):
    """A motion that a thread sends; a context manager, whose thread ends with it.

    Parameters
    ----------
    motion
        What to send.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self._stopping = threading.Event()
        self._done = threading.Event()
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        """Be there to be recorded."""
        self._open()
        self._thread = threading.Thread(target=self._work, name="bench", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._thread.join()
        self._close()
        if kind is None and self._failure is not None:
            raise self._failure

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end of the motion and return whether it came; raise what broke the bench, if so."""
        ended = self._done.wait(timeout)
        if self._failure is not None:
            raise self._failure
        return ended

    def _work(self) -> None:
        try:
            self._run()
        except Exception as problem:  # told by wait(): nobody else sees a thread's end
            self._failure = problem
        finally:
            self._done.set()

    @abc.abstractmethod
    def _open(self) -> None:
        """Put it on its line."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Take it off its line."""

    @abc.abstractmethod
    def _run(self) -> None:
        """Send the motion until `_stopping`."""
