"""Kernels compiled within their callers alone, kept on disk by the sources of all, by private names of numba.

Nothing here is needed for a result, and nothing is changed for others that use numba: `compiling` does without where a
name is missing. The seconds that each part saves are in docs/development/speed.md.
"""

from __future__ import annotations

import contextlib
import functools
import gc
from collections.abc import Callable
from typing import Any, TypeVar, cast

from filelock import FileLock, Timeout
from numba import _dynfunc, njit, types
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

from cycloid_fmu.edge.kernels import kept_njit

_Function = TypeVar("_Function", bound=Callable[..., Any])
_LONGEST_TURN = 60.0  # s: of another process, until a kernel is compiled here as well


def compiled_function(function: _Function, inline: bool, sources: str) -> _Function:
    """Compile a kernel for Python's calls, kept on disk for these sources, and for other kernels as a part of them."""
    entry = functools.cache(
        lambda: _entry(function, sources)
    )  # at the first call: most kernels are called by others alone
    options = {"error_model": "numpy", "forceinline": inline, "pipeline_class": _PartCompiler, "_nrt": False}
    part = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(function)

    @functools.wraps(function)
    def called(*arguments: Any) -> Any:
        return entry()(*arguments)

    called.dispatcher = entry  # type: ignore[attr-defined]
    called._numba_type_ = _Part(part)  # type: ignore[attr-defined]
    called._part = part  # type: ignore[attr-defined]  # the type holds no reference
    return cast(_Function, called)


def _entry(function: Callable[..., Any], sources: str) -> Any:
    kernel = kept_njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(function)
    if kernel._cache.cache_path is not None:
        _Compilation(kernel, sources)
    return kernel


class _Compilation:
    """How a kernel that Python calls is taken from its file, or compiled and kept there.

    One process compiles a kernel while others that need it wait: three that began together took 2.4 times the
    processor's time, because each compiled everything. Garbage collection is put off: a fifth of the time went into
    looking for none.
    """

    _waits = True  # for other processes, of all kernels

    def __init__(self, kernel: Any, sources: str) -> None:
        cache = kernel._cache
        self._compile, self._cache = kernel.compile, cache
        self._turn: FileLock | None = None
        cache._cache_file._source_stamp = (*cache._cache_file._source_stamp, sources)
        self._index, cache._cache_file._load_index = cache._cache_file._load_index, self._known
        cache.load_overload, kernel.compile = self._load, self.compile

    def _known(self) -> Any:
        """Return what is on disk; nothing where it is of an earlier version, with types that are gone since."""
        try:
            return self._index()
        except (AttributeError, ImportError):
            return {}

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
        kernel = self._from_file(signature, context)
        if kernel is None and _Compilation._waits:
            # Where nothing can be locked, each process compiles.
            with contextlib.suppress(OSError, NotImplementedError):
                self._cache._impl.locator.ensure_cache_path()
                # A lock made before a fork would not be the child's.
                self._turn = FileLock(f"{self._cache._cache_file._index_path}.lock", timeout=_LONGEST_TURN)
                try:
                    self._turn.acquire()
                except Timeout:
                    _Compilation._waits = False
            kernel = self._from_file(signature, context)
        return kernel

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


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a part: neither optimised nor made machine code alone, both of which its kernel does with all its parts.

    Otherwise each of a chain of parts repeats it for all that it calls.
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
        part = state["cr"]
        # There is no machine code, so no address: other kernels find the part by this object.
        name = part.fndesc.qualname.split(".")[-1]
        entry = _dynfunc.make_function(part.fndesc.lookup_module(), name, "", 0, part.env, (state.library,))
        state.targetctx.insert_user_function(entry, part.fndesc, [state.library])
        state["cr"] = part._replace(cfunc=entry)
        return True


# For closures, comprehensions, array expressions, `with`, messages made at run time and literal arguments. Parts have
# none of these, and each pass analyses the whole part again.
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
        passes = [(step, why) for step, why in pipeline.passes if step not in _UNUSED]
        pipeline.passes = [(_PartLowering if step is NativeLowering else step, why) for step, why in passes]
        pipeline.finalize()
        return [pipeline]
