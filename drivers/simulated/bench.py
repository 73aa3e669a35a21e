"""Common base of all simulated benches: a thread that sends a motion, and the wiring to record it."""

from __future__ import annotations

import abc
import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cycloid_fmu import edge
from drivers.recorder.session import Live, Recorded, record
from drivers.simulated.motion import Motion


class SimulatedBench(abc.ABC):
    """A bench whose thread sends a motion over its bus; a context manager, at whose end the thread ends.

    `description` is the `buses.SimulatedBus`; `ratio` and `pair` are the defaults of `write_wiring`.
    """

    ratio: float | None = None
    pair = ""
    allow: tuple[str, ...] = ()  # for its own bus, see `read_bench`

    def __init__(self, motion: Motion, description: Any) -> None:
        self.motion, self.description = motion, description
        self._stopping = threading.Event()
        self._done = threading.Event()
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        """Start the bench."""
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

    def write_wiring(self, path: str | os.PathLike[str], *, ratio: float | None = None, pair: str = "") -> Path:
        """Write a `BENCH.toml` for recording this bench, and the files that it names, next to it; return its path.

        Parameters
        ----------
        path
            The `.toml` file.
        ratio
            Signed ratio input/output for the header; None: that of the bench, or none.
        pair
            Name of the gear pair; "": that of the bench.
        """
        target = edge.output_path(path, "path", (".toml",))
        ratio, run = self.ratio if ratio is None else ratio, self.motion.run
        head = "" if ratio is None else f"ratio = {float(ratio)!r}\n"
        text = (
            f'format = "cycloid-bench/1"\n{head}pair = {edge.json_text(pair or self.pair)}\n\n'
            f'[conditions]\nload = "{edge.format_quantity(run.torque, "N*m", "N*m")}"\n'
            f'speed = "{edge.format_quantity(run.speed, "rad/s", "rad/s")}"\ndirection = "{run.direction}"\n\n'
        )
        with edge.written_whole(target) as temporary:
            temporary.write_text(text + self._connections(target.parent), encoding="utf-8")
        return target

    def record(
        self,
        path: str | os.PathLike[str],
        *,
        wiring: str | os.PathLike[str] | None = None,
        progress: Callable[[Live], None] | None = None,
    ) -> Recorded:
        """Record the whole motion as `drivers.record` does.

        Parameters
        ----------
        path
            New `.arrows` file.
        wiring
            `BENCH.toml` to write; default: next to the recording.
        progress
            See `drivers.record`.
        """
        written = self.write_wiring(Path(path).with_name("BENCH.toml") if wiring is None else wiring)
        return record(written, path, progress=progress, allow=self.allow, **self._end())

    @abc.abstractmethod
    def _connections(self, folder: Path) -> str:
        """Return the tables of buses or ports and of channels; write files that they name into the folder."""

    @abc.abstractmethod
    def _end(self) -> dict[str, Any]:
        """Return the arguments of `record` that end a recording of the whole motion."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end of the motion and return whether it was reached; raise the bench's error, if any."""
        ended = self._done.wait(timeout)
        if self._failure is not None:
            raise self._failure
        return ended

    def _work(self) -> None:
        try:
            self._run()
        except Exception as problem:  # raised by wait(), as nobody else sees why a thread ends
            self._failure = problem
        finally:
            self._done.set()

    @abc.abstractmethod
    def _open(self) -> None:
        """Connect the bench to its bus or port."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Disconnect the bench from its bus or port."""

    @abc.abstractmethod
    def _run(self) -> None:
        """Send the motion, until `_stopping` is set."""
