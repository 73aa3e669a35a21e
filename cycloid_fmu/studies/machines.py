"""Drives solved in parallel, on the cores of this machine or a dask cluster, and kept as they finish."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.studies.checkpoint import Checkpoint

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
# Some drives of a study: their numbers, their figures (drives, columns), and a note on each, or none at all.
Solved = tuple[Numbers, Array, Sequence[str]]

# Packages whose versions determine the last digits.
_DECISIVE = ("cycloid-fmu", "numba", "numpy", "scipy")
_AHEAD = "4 * n_jobs"  # tasks that a cluster has ahead, so that workers that join find some


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of the packages that determine a result's last digits."""
    return {name: importlib.metadata.version(name) for name in _DECISIVE}


def _checked(task: Callable[..., Solved], wanted: dict[str, str], *arguments: Any) -> Solved:
    """Solve some drives in any process; refuse to work with other versions, which would compute other digits."""
    here = versions()
    for name, version in wanted.items():
        if here[name] != version:
            raise edge.InputError(
                f"a worker has {name} {here[name]}, this process {version}; give all workers the same version."
            )
    return task(*arguments)


@contextlib.contextmanager
def _machines(workers: int, scheduler: str | None) -> Iterator[Any]:
    """Return what runs tasks and yields their results in any order: processes of this machine, or a cluster's."""
    import joblib

    if scheduler is None:
        # No more tasks ahead than its processes take at once: its thread has a traceback at Ctrl+C if some wait.
        yield joblib.Parallel(workers, return_as="generator_unordered")
        return
    with edge.needs_extra("distributed", lambda said: edge.ArgumentError("scheduler", said, scheduler)):
        from distributed import Client
    try:
        # For as long as dask is configured to wait, 30 s by default: a busy scheduler takes more than 5 s to answer.
        client = Client(scheduler, set_as_default=False)
    except (OSError, ValueError) as failure:
        problem = f"no scheduler answers there ({type(failure).__name__})"
        raise edge.ArgumentError("scheduler", problem, scheduler) from None
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise edge.ArgumentError("scheduler", "it has no workers; start one with dask worker", scheduler)
        with joblib.parallel_config("dask", client=client):
            parallel = joblib.Parallel(return_as="generator_unordered", pre_dispatch=_AHEAD)
        yield parallel


def complete(
    kept: Checkpoint,
    task: Callable[..., Solved],
    arguments: Callable[[Numbers], tuple[Any, ...]],
    *,
    together: int,
    workers: int,
    scheduler: str | None = None,
    progress: Callable[[int], None],
) -> None:
    """Solve the drives that are not kept yet, and keep them as they finish.

    Parameters
    ----------
    kept
        Finished drives.
    task, arguments
        Function that solves drives, defined in a module, and the arguments that it takes for drives of these numbers.
    together
        Largest number of drives of a task. joblib joins tasks that are much shorter than a second.
    workers
        Processes of this machine; 1 uses this one.
    scheduler
        Address of a dask scheduler, such as "tcp://host:8786"; its workers are used instead.
    progress
        Called with the number of drives just finished, first those that were kept before.

    Raises
    ------
    edge.InputError
        If the scheduler does not answer, or a worker has other versions.
    KeyboardInterrupt
        Its text states how many drives are solved, and what keeps them.
    """
    import joblib

    with kept.counted_at_interrupt():
        if kept.done.any():
            progress(int(np.count_nonzero(kept.done)))
        while (waiting := np.flatnonzero(~kept.done)).size:
            parts = (waiting[first : first + together] for first in range(0, waiting.size, together))
            tasks = (joblib.delayed(_checked)(task, versions(), *arguments(part)) for part in parts)
            # joblib gives up where a worker is lost with results not sent: the others solve what is missing.
            with contextlib.suppress(CancelledError), _machines(workers, scheduler) as parallel:
                for solved in parallel(tasks):
                    kept.add(*solved)
                    progress(len(solved[0]))
