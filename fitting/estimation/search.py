"""The loop of a search for the best fit: fit from what is proposed, take what is better, end when nothing new wins."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from cycloid_fmu import edge

Start = TypeVar("Start")
End = TypeVar("End")
Proposals = Generator[Start, End | None, None]
"""Starts, each of which is sent the end of its fit, None where there is none."""
NO_FIT = edge.InputError, np.linalg.LinAlgError  # no contacts balance a load; singular equations


class Search(ABC, Generic[Start, End]):
    """Fits from proposed starts.

    Attributes
    ----------
    starts, ends
        The proposed starts, and the ends of their fits where there are some.
    problem
        Why the last start without a fit has none.
    """

    def __init__(self) -> None:
        self.starts: list[Start] = []
        self.ends: list[End] = []
        self.problem: Exception | None = None
        self._best: End | None = None

    @property
    def best(self) -> End:
        """The best end so far."""
        if self._best is None:
            raise self.problem or ValueError("nothing was fitted")
        return self._best

    @abstractmethod
    def fit(self, start: Start) -> End:
        """Return the end of the fit from a start, or raise one of `NO_FIT`."""

    @abstractmethod
    def is_better(self, end: End, best: End) -> bool:
        """Whether an end is better than the best one before it."""

    def run(self, proposals: Sequence[Callable[[Any], Proposals[Start, End]]]) -> None:
        """Fit from the starts of each kind of proposal, which is called with this search, until it has no more."""
        for propose in proposals:
            starts, end = propose(self), None
            while (start := _next(starts, end)) is not None:
                self.starts.append(start)
                try:
                    end = self.fit(start)
                except NO_FIT as problem:
                    self.problem, end = problem, None
                    continue
                self.ends.append(end)
                if self._best is None or self.is_better(end, self._best):
                    self._best = end


def _next(starts: Proposals[Start, End], end: End | None) -> Start | None:
    try:
        return starts.send(end)
    except StopIteration:
        return None
