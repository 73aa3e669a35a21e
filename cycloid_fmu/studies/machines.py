"""Drives solved in parallel, on the cores of this machine or a dask cluster, and stored as they finish."""

from __future__ import annotations

import collections
import functools
import importlib.metadata
import itertools
import math
import pickle
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.studies.checkpoint import Checkpoint, InMemory

Array = NDArray[np.float64]
# Packages whose versions determine the last digits.
_DECISIVE = ("cycloid-fmu", "numba", "numpy", "scipy")
_TASK = 7e-3  # s: cost of a task in dask's scheduler, 2 to 7 ms were measured
_OVERHEAD = 0.02  # largest share of this cost in the time of a task
_BUSY = 0.5  # largest share of its time that the scheduler is busy with the tasks of all workers
_LONGEST = 8  # most usual tasks in one, if workers wait for a slow scheduler; a kill loses running tasks
_FIRST = 4  # drives of a task before a time is measured
_REMEMBERED = 400  # tasks, at most four per worker, over which the times of drives and tasks are averaged
_LOOK = 1.0  # s: how often the workers of a cluster are counted


class Solved(NamedTuple):
    """Some drives of a study: the number of the first, their figures (drives, columns), and notes."""

    first: int
    values: Array
    notes: tuple[str, ...] = ()


AnyStudy = TypeVar("AnyStudy")
Points = Callable[[int, int], Array]
Task = Callable[[AnyStudy, int, Array], Solved]


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
        # For as long as dask is configured to wait, 30 s by default: a busy scheduler takes more than 5 s to answer.
        client = Client(scheduler, set_as_default=False)
    except (OSError, ValueError) as failure:
        problem = f"no scheduler answers there ({type(failure).__name__})"
        raise edge.ArgumentError("scheduler", problem, scheduler) from None
    if not client.scheduler_info(n_workers=-1)["workers"]:
        client.close()
        raise edge.ArgumentError("scheduler", "it has no workers; start one with dask worker", scheduler)
    return client


class Shares(Iterator[tuple[int, int]]):
    """The unsolved drives in tasks: an iterator of (first drive, last drive + 1).

    A task is long enough to keep its cost below `_OVERHEAD` of its time and the scheduler's load below `_BUSY`. The
    time of a drive, and the time workers waited for a task, are measured on the last tasks. Towards the end tasks
    become shorter, so that all workers end together.

    Parameters
    ----------
    waiting
        Mask of the unsolved drives, shape (drives,).
    workers
        Number of workers; it may change during the study.
    """

    def __init__(self, waiting: NDArray[np.bool_], workers: int) -> None:
        ends = np.flatnonzero(np.diff(waiting.astype(np.int8), prepend=0, append=0))
        self._gaps = collections.deque((int(first), int(last)) for first, last in ends.reshape(-1, 2))
        self._left = int(np.count_nonzero(waiting))
        self._took: collections.deque[tuple[float, int, float]] = collections.deque()
        self.workers = workers

    @property
    def measured(self) -> bool:
        """Whether a task has ended."""
        return bool(self._took)

    def took(self, drives: int, seconds: float) -> None:
        """Record the time of a task that has just ended."""
        self._took.append((time.monotonic(), drives, seconds))
        if len(self._took) > min(4 * self.workers, _REMEMBERED):
            self._took.popleft()

    def _size(self) -> int:
        even = self._left / (2 * self.workers)
        if not self._took:
            return min(_FIRST, math.ceil(even / 2))
        ends, drives, seconds = np.array(tuple(self._took)).T  # a copy: another thread adds
        each = max(float(seconds.sum() / drives.sum()), 1e-6)
        waited = float((ends[-1] - ends[0]) * self.workers - seconds[1:].sum())
        usual = max(_TASK / _OVERHEAD, _TASK / _BUSY * self.workers)
        wanted = min(max(waited / len(ends) / _OVERHEAD, usual), _LONGEST * usual)
        # At least the time that the scheduler needs to give each worker a task.
        shortest = max(_TASK / _OVERHEAD, _TASK * self.workers)
        return math.ceil(min(wanted / each, max(shortest / each, even)))

    def __next__(self) -> tuple[int, int]:
        if not self._gaps:
            raise StopIteration
        first, end = self._gaps.popleft()
        last = min(first + self._size(), end)
        if last < end:
            self._gaps.appendleft((last, end))
        self._left -= last - first
        return first, last


@functools.lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Any:
    return pickle.loads(packed)  # made by `solved`, in this process or the one that asks


def _work(task: Task[Any], wanted: dict[str, str], packed: bytes, first: int, points: Array) -> tuple[Solved, float]:
    """Solve some drives in any process; also return the time it took (s)."""
    check_versions(wanted)
    study = _unpacked(packed)
    begun = time.perf_counter()
    found = task(study, first, points)
    return found, time.perf_counter() - begun


def solved(
    study: AnyStudy,
    waiting: NDArray[np.bool_],
    points: Points,
    task: Task[AnyStudy],
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[Solved]:
    """Yield the waiting drives as they are finished, in any order.

    Parameters
    ----------
    waiting
        Mask of the unsolved drives, shape (drives,).
    points
        Function of (first drive, last drive + 1) that returns their points, shape (drives, factors); called in order.
    task
        Function that solves drives, of the study, the first drive and the points; defined in a module.
    workers
        Processes of this machine; 1 uses this one.
    scheduler
        Address of a dask scheduler, such as "tcp://host:8786"; its workers are used instead.

    Raises
    ------
    edge.InputError
        If the scheduler does not answer, or a worker has other versions.
    """
    # Packed once, and unpacked once by each worker: for each task it would take as long as a drive.
    given = task, versions(), pickle.dumps(study)
    if scheduler is not None:
        client = _connected(scheduler)
        try:
            yield from _by_cluster(client, given, Shares(waiting, 1), points)
        finally:
            client.close()
        return
    shares = Shares(waiting, workers)
    if workers == 1:
        done: Iterator[tuple[Solved, float]] = (_work(*given, first, points(first, last)) for first, last in shares)
    else:
        import joblib

        tasks = (joblib.delayed(_work)(*given, first, points(first, last)) for first, last in shares)
        done = joblib.Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)(tasks)
    for found, seconds in done:
        shares.took(len(found.values), seconds)
        yield found


def _by_cluster(client: Any, given: tuple[Any, ...], shares: Shares, points: Points) -> Iterator[Solved]:
    """Give each worker one task beyond the one that it solves: more would take memory and be lost at a restart."""
    from distributed import as_completed

    futures, looked = as_completed(loop=client.loop), -math.inf
    while True:
        if time.monotonic() - looked > _LOOK:
            shares.workers, looked = max(sum(client.nthreads().values()), 1), time.monotonic()
        room = (2 if shares.measured else 1) * shares.workers - futures.count()
        for first, last in itertools.islice(shares, max(room, 0)):
            # Not through joblib's own dask backend: it scatters arguments, which are lost with a worker that is killed.
            futures.add(client.submit(_work, *given, first, points(first, last), pure=False))
        if futures.is_empty():
            return
        future = next(futures)
        found, seconds = future.result()
        future.release()
        shares.took(len(found.values), seconds)
        yield found


def complete(
    study: AnyStudy,
    points: Points,
    kept: InMemory | Checkpoint,
    task: Task[AnyStudy],
    *,
    workers: int,
    scheduler: str | None = None,
    progress: Callable[[int], None],
) -> None:
    """Solve the drives that are not stored yet, and store them as they finish.

    Parameters are those of `solved`, and:

    Parameters
    ----------
    kept
        Storage of finished drives.
    progress
        Called with the number of drives just finished, first those that were stored before.
    """
    if before := int(np.count_nonzero(kept.done)):
        progress(before)
    for one in solved(study, ~kept.done, points, task, workers, scheduler) if before < kept.done.size else ():
        kept.add(*one)
        progress(len(one.values))
