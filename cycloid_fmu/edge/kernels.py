"""Compilation of functions by numba, whose results are kept on disk where a folder can be written."""

from __future__ import annotations

import functools
import multiprocessing
import warnings
from collections.abc import Callable
from typing import Any

from numba import njit

from cycloid_fmu.edge.problems import InputWarning


def kept_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return numba's `njit` with these options, which keeps what it compiles if it can.

    Where neither the installation nor the user's cache can be written, as in a read-only container, an `InputWarning`
    says once that each process compiles for itself.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # numba has no folder
            _say()
            return njit(**options)(function)

    return compiled


@functools.cache
def _say() -> None:
    if multiprocessing.parent_process() is None:  # of several processes the first one says it
        warnings.warn(
            "Compiled kernels can't be kept, because neither the installation nor your cache folder can be written: "
            "each command compiles them again, which takes half a minute or more. Set NUMBA_CACHE_DIR to a folder that "
            "can be written.",
            InputWarning,
            stacklevel=2,
        )
