"""A sweep in parts that threads solve, of which an interrupt leaves those that were finished."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


class Stopped(KeyboardInterrupt):
    """A sweep was interrupted; the first `finished` crank angles are done."""

    def __init__(self, finished: int) -> None:
        super().__init__()
        self.finished = finished


def solve_in_parts(
    solve: Callable[[int, int], None], angles: int, size: int, workers: int, progress: Callable[[int], None]
) -> None:
    """Solve crank angles in parts, the same ones whatever the number of threads.

    Parameters
    ----------
    solve
        Solves the crank angles from its first argument up to its second.
    angles, size
        How many there are, and how many a part has.
    workers
        Threads.
    progress
        Told how many crank angles were just finished, in their order.

    Raises
    ------
    Stopped
        At a KeyboardInterrupt.
    """

    def part(first: int) -> int:
        last = min(first + size, angles)
        solve(first, last)
        return last - first

    finished = 0
    # One thread needs no pool: a study of thousands of drives would start one for each.
    with ThreadPoolExecutor(workers) if workers > 1 else contextlib.nullcontext() as pool:
        try:
            parts = range(0, angles, size)
            for done in map(part, parts) if pool is None else pool.map(part, parts):
                finished += done
                progress(done)
        except KeyboardInterrupt:
            if pool is not None:
                pool.shutdown(cancel_futures=True)
            raise Stopped(finished) from None
