"""How the kernels are compiled: once for Python's calls, kept on disk, and without further ado inside other kernels."""

from __future__ import annotations

import contextlib
import functools
import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from filelock import FileLock, Timeout
from numba import _dynfunc, config, njit, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.runtime import rtsys
from numba.core.typed_passes import (
    AnnotateTypes,
    DumpParforDiagnostics,
    NativeLowering,
    NopythonRewrites,
    NoPythonSupportedFeatureValidation,
)
from numba.core.untyped_passes import (
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    MakeFunctionToJitFunction,
    RewriteDynamicRaises,
    WithLifting,
)
from numba.extending import models, register_model
from numpy.typing import NDArray

from cycloid_fmu.edge.kernels import kept_njit

Array = NDArray[np.float64]

_Function = TypeVar("_Function", bound=Callable[..., Any])
_LONGEST_TURN = 60.0  # s: of another process, until a kernel is compiled here as well
_ROOMS = [Path(__file__).parents[1] / room for room in ("contact", "supports", "losses")]
_SOURCES = tuple(sorted((s.stat().st_mtime_ns, s.name) for room in _ROOMS for s in room.glob("*.py")))


class _Compilation:
    """How a kernel that Python calls is taken from its file, or compiled and kept there.

    One process compiles a kernel while others that need it wait: three that began together took 2.4 times the
    processor's time, because each compiled everything. Garbage collection is put off: a fifth of the time went into
    looking for none.
    """

    _waits = True  # for other processes, of all kernels

    def __init__(self, kernel: Any) -> None:
        cache = kernel._cache
        self._compile, self._cache = kernel.compile, cache
        self._turn: FileLock | None = None
        # numba looks at the file of the kernel alone; what it calls lies in others.
        cache._cache_file._source_stamp = (*cache._cache_file._source_stamp, _SOURCES)
        cache.load_overload, kernel.compile = self._load, self.compile

    def compile(self, signature: Any) -> Any:
        """Take the kernel from its file or compile it."""
        with global_compiler_lock:
            collects = gc.isenabled()
            gc.disable()
            try:
                return self._compile(signature)
            finally:
                if collects:
                    gc.enable()
                if self._turn is not None:
                    self._turn.release()
                    self._turn = None

    def _load(self, signature: Any, context: Any) -> Any:
        found = self._from_file(signature, context)
        if found is None and _Compilation._waits:
            # Where nothing can be locked, each process compiles.
            with contextlib.suppress(OSError, NotImplementedError):
                self._cache._impl.locator.ensure_cache_path()
                # A lock made before a fork would not be the child's.
                self._turn = FileLock(f"{self._cache._cache_file._index_path}.lock", timeout=_LONGEST_TURN)
                try:
                    self._turn.acquire()
                except Timeout:
                    _Compilation._waits = False
            found = self._from_file(signature, context)
        return found

    def _from_file(self, signature: Any, context: Any) -> Any:
        """Take the kernel from its file.

        numba's own way first loads all that it could compile: a third of the processor's time of an analysis. Where a
        kernel is compiled after all, the compiler loads it.
        """
        rtsys.initialize(context)
        with self._cache._guard_against_spurious_io_errors():
            return self._cache._load_overload(signature, context)


class _Part(types.Dispatcher):  # type: ignore[misc]
    """Type of a kernel in others, for which a literal is a number like any: it is not compiled for each of them."""

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        plain = {name: types.unliteral(kind) for name, kind in dict(kws).items()}
        return super().get_call_type(context, tuple(types.unliteral(kind) for kind in args), plain)


register_model(_Part)(models.OpaqueModel)


def _remember_operators() -> None:
    """Have numba find the type of an operator on numbers once, not at each place where it is used.

    It tries some twenty overloads, most of them of arrays, each time: a first analysis would take 1.2 times as long.
    """
    search = types.Function.get_call_type
    found: dict[Any, tuple[Any, Any]] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if getattr(self.typing_key, "__module__", None) != "_operator" or not all(
            isinstance(a, _NUMBERS) for a in args
        ):
            return search(self, context, args, kws)
        asked = (self, context, args)
        if asked not in found:
            signature = search(self, context, args, kws)
            found[asked] = signature, self.get_impl_key(signature)
        signature, key = found[asked]
        self._impl_keys[signature.args] = key
        return signature

    types.Function.get_call_type = get_call_type


_NUMBERS = (types.Float, types.Integer, types.Boolean)
_remember_operators()


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a part: neither optimised nor made machine code alone, both of which its kernel does with all its parts.

    Otherwise each of a chain of parts repeats it for all that it calls: a first analysis took 1.3 times as long.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):  # type: ignore[misc]
    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        made = state["cr"]
        # There is no machine code, so no address: other kernels find the part by this object.
        name = made.fndesc.qualname.split(".")[-1]
        entry = _dynfunc.make_function(made.fndesc.lookup_module(), name, "", 0, made.env, (state.library,))
        state.targetctx.insert_user_function(entry, made.fndesc, [state.library])
        state["cr"] = made._replace(cfunc=entry)
        return True


# For closures, comprehensions, array expressions, `with`, messages made at run time and literal arguments. Parts have
# none of these, and each pass analyses the whole part again: a first analysis takes 1.2 times as long with them.
_UNUSED = {
    AnnotateTypes,
    DumpParforDiagnostics,
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    MakeFunctionToJitFunction,
    NopythonRewrites,
    NoPythonSupportedFeatureValidation,
    RewriteDynamicRaises,
    WithLifting,
}


class _PartCompiler(CompilerBase):  # type: ignore[misc]
    """numba's own compiler with the lowering of a part, without the passes that no part needs."""

    def define_pipelines(self) -> list[Any]:
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes = [(one, why) for one, why in pipeline.passes if one not in _UNUSED]
        pipeline.passes = [(_PartLowering if one is NativeLowering else one, why) for one, why in passes]
        pipeline.finalize()
        return [pipeline]


def compiled(function: _Function) -> _Function:
    """Compile a kernel that Python calls, its type kept; other kernels may call it as well.

    Inside another kernel it is a `part` of that one. What numba compiled for Python's calls is its `dispatcher`.
    """
    entry = kept_njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(function)
    if not config.DISABLE_JIT and entry._cache.cache_path is not None:
        _Compilation(entry)

    @functools.wraps(function)
    def called(*arguments: Any) -> Any:
        return entry(*arguments)

    called.dispatcher = entry  # type: ignore[attr-defined]
    return _within(cast(_Function, called), function)


def part(function: _Function) -> _Function:
    """Make a function that kernels call; Python's own calls are interpreted.

    It does not count references of its arrays, which its callers hold, and so makes none: counting took a tenth of the
    time of a crank angle.
    """
    return _within(function, function)


def allocating(function: _Function) -> _Function:
    """Make a `part` that returns new arrays."""
    return _within(function, function, allocates=True)


def inlined(function: _Function) -> _Function:
    """Make a `part` that the compiler puts where it is called."""
    return _within(function, function, forceinline=True)


def spliced(function: _Function) -> _Function:
    """Make a `part` whose statements are put where it is called; for what is called in one place.

    Each kernel in between holds all that it calls, compiled once more.
    """
    if not config.DISABLE_JIT:
        # What numba asks of a function that it may splice in; it calls a `part` where it does not.
        function.targetoptions = {"inline": "always"}  # type: ignore[attr-defined]
        function.py_func = function  # type: ignore[attr-defined]
    return part(function)


def _within(name: _Function, function: _Function, forceinline: bool = False, allocates: bool = False) -> _Function:
    """Let kernels that call `name` compile `function`, once, without an entry from Python or a file in the cache.

    Such entries took most of the time: each holds all that the kernel calls, compiled once more.
    """
    if not config.DISABLE_JIT:
        options = {
            "error_model": "numpy",
            "forceinline": forceinline,
            "pipeline_class": _PartCompiler,
            "_nrt": allocates,
        }
        kernel = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(function)
        name._numba_type_ = _Part(kernel)  # type: ignore[attr-defined]
        name._kernel = kernel  # type: ignore[attr-defined]  # the type holds no reference
    return name
