"""How the kernels are compiled: `compiled` is numba's `njit`, where Python and other kernels call alike.

numba's own way compiles each function once for itself and again, with all that it calls, in each of its callers. The
first result takes a third of the time where `internals`, which use private names of numba, compile a function within
its callers alone. Without these names, or with CYCLOID_PLAIN_NUMBA=1 in the environment, `compiled` is `njit` itself:
the same numbers, slower (docs/development/speed.md). What is kept on disk belongs to the sources of all kernels, both
ways: numba itself looks at the file of a function alone, and what it calls lies in others.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast, overload

import numpy as np
from numba import config
from numpy.typing import NDArray

from cycloid_fmu.edge.cache import hash_of_code
from cycloid_fmu.edge.kernels import kept_njit

Array = NDArray[np.float64]

_Function = TypeVar("_Function", bound=Callable[..., Any])
_PACKAGE = Path(__file__).parents[1]
# Kernels, and modules whose constants are part of them.
KERNEL_FILES = (
    *(file for room in ("contact", "supports", "losses") for file in sorted((_PACKAGE / room).glob("*.py"))),
    *(_PACKAGE / "fmu" / name for name in ("constants.py", "exact_contacts.py")),
    *(_PACKAGE / name for name in ("bodies/outline.py", "geometry/losses.py")),
)
SOURCES = hash_of_code(filter(Path.exists, KERNEL_FILES))
"""Hash of the sources of all kernels."""

try:
    if os.environ.get("CYCLOID_PLAIN_NUMBA", "0") not in ("", "0"):
        raise ImportError("not wanted")
    from cycloid_fmu.contact import internals
except (ImportError, AttributeError):
    internals = None  # type: ignore[assignment]


@overload
def compiled(function: _Function) -> _Function: ...


@overload
def compiled(*, inline: bool) -> Callable[[_Function], _Function]: ...


def compiled(function: Any = None, *, inline: bool = False) -> Any:
    """Compile a kernel, which Python and other kernels call.

    Parameters
    ----------
    function
        The kernel. It makes no arrays: callers give it its memory.
    inline
        Whether the compiler puts it where it is called, as it must in loops over lanes (`lanes`).

    Returns
    -------
    function
        With the same parameters, by position.
    """
    if function is None:
        return lambda function: compiled_function(function, inline)
    return compiled_function(function, inline)


def compiled_function(function: _Function, inline: bool) -> _Function:
    """Compile a kernel as `compiled` does."""
    if config.DISABLE_JIT:
        return function
    if internals is not None:
        return internals.compiled_function(function, inline, SOURCES)
    name = function.__qualname__
    function.__qualname__ = f"{name}-{SOURCES[:16]}"  # the name of numba's file
    try:
        kernel = kept_njit(error_model="numpy", nogil=True, forceinline=inline, no_cfunc_wrapper=True)(function)
    finally:
        function.__qualname__ = name
    return cast(_Function, kernel)
