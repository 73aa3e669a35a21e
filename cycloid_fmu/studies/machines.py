"""Drives solved in parallel, on the cores of this machine or a dask cluster, and stored on disk as they finish."""

from __future__ import annotations

import functools
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.studies.checkpoint import Checkpoint

Array = NDArray[np.float64]
# Packages whose versions decide the last digits.
_DECISIVE = ("cycloid-fmu", "numba", "numpy", "scipy")


class Solved(NamedTuple):
    """Some drives of a study: the number of the first, their figures (drives, columns), and notes."""

    first: int
    values: Array
    notes: tuple[str, ...] = ()


AnyStudy = TypeVar("AnyStudy")
Task = Callable[[dict[str, str], AnyStudy, int, Array], Solved]


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of the packages that determine a result's last digits."""
    return {name: importlib.metadata.version(name) for name in _DECISIVE}


def check_versions(wanted: dict[str, str]) -> None:
    """Refuse to work with other versions, which would compute other digits."""
    here = versions()
    for name, version in wanted.items():
        if here[name] != version:
            raise edge.InputError(
                f"a worker has {name} {here[name]}, this process {version}; give all workers the same version."
            )


def _connected(scheduler: str) -> Any:
    """Return a client of a dask scheduler that has workers."""
    with edge.needs_extra("distributed", lambda said: edge.ArgumentError("scheduler", said, scheduler)):
        from distributed import Client
    try:
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError) as failure:
        problem = f"no scheduler answers there ({type(failure).__name__})"
        raise edge.ArgumentError("scheduler", problem, scheduler) from None
    if not client.scheduler_info(n_workers=-1)["workers"]:
        client.close()
        raise edge.ArgumentError("scheduler", "it has no workers; start one with dask worker", scheduler)
    return client


def solved(
    study: AnyStudy,
    waiting: Mapping[int, Array],
    task: Task[AnyStudy],
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[Solved]:
    """Yield the tasks as they finish, in any order.

    Parameters
    ----------
    waiting
        {first drive: points, shape (drives, factors)}.
    task
        The function that solves them, of a module; called with `versions`, the study, the first drive and its points.
    workers
        Processes of this machine; 1 uses this one.
    scheduler
        Address of a dask scheduler, such as "tcp://host:8786"; its workers are used instead.

    Raises
    ------
    edge.InputError
        If the scheduler does not answer, or a worker has other versions.
    """
    import joblib

    wanted = versions()
    if scheduler is None:
        tasks = (joblib.delayed(task)(wanted, study, first, rows) for first, rows in waiting.items())
        yield from joblib.Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)(tasks)
        return
    client = _connected(scheduler)
    try:
        from distributed import as_completed

        # Not through joblib's own dask backend: it scatters arguments, which are lost with a worker that is killed.
        futures = [client.submit(task, wanted, study, *rows, pure=False) for rows in waiting.items()]
        for future in as_completed(futures, loop=client.loop):
            yield future.result()
            future.release()
    finally:
        client.close()


def complete(
    study: AnyStudy,
    tasks: Mapping[int, Array],
    done: dict[int, Solved],
    task: Task[AnyStudy],
    checkpoint: Checkpoint | None,
    *,
    workers: int,
    scheduler: str | None = None,
    progress: Callable[[int], None],
) -> None:
    """Solve all tasks except those of the checkpoint; `done` has the finished ones, by the first drive, at any time.

    Parameters are those of `solved`, and:

    Parameters
    ----------
    checkpoint
        Storage of finished drives.
    progress
        Called with the number of drives just finished, first those of the checkpoint.
    """
    for first, values in ({} if checkpoint is None else checkpoint.done).items():
        if checkpoint is not None and first in tasks:
            done[first] = Solved(first, values, tuple(checkpoint.notes.get(first, ())))
            progress(len(values))
    waiting = {first: rows for first, rows in tasks.items() if first not in done}
    for one in solved(study, waiting, task, workers, scheduler) if waiting else ():
        done[one.first] = one
        if checkpoint is not None:
            checkpoint.add(*one)
        progress(len(one.values))
