"""numba's `njit` as this package uses it: `compiled` for what Python calls, `part` for what only those functions call.

What is compiled is kept on disk, until any of the package's compiled modules changes. numba watches only the file that
a function stands in, but the loop has the kernels of other files compiled into it: after an upgrade or an edit of one
of them it would go on with the old ones. The classes here make the first use short.
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.registry import CPUDispatcher

COMPILED_MODULES = (
    "kernels/compiling",
    "power/allocation",
    "power/amplifiers",
    "kernels/block",
    "power/constraint",
    "kernels/delay_lines",
    "controllers/array_steps",
    "kernels/covariance",
    "power/limiter",
    "controllers/lms_rules",
    "loop/lockstep",
    "loop/run",
    "kernels/pairs",
    "power/budget",
    "controllers/repairs",
)
SOURCES = hashlib.sha256(
    b"".join(Path(__file__).parents[1].joinpath(f"{name}.py").read_bytes() for name in COMPILED_MODULES)
).hexdigest()
SWITCHED_OFF: bool = vars(numba)["config"].DISABLE_JIT  # numba's own switch: everything is called as plain Python


class Settings(Flags):
    """A compilation's flags, compared by what was set.

    numba compares its own by calling for every option there is, with all flags that it has seen, at each operation that
    it types. Here what was set to its default is not the same as what was not set: one compilation more at most.
    """

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Settings) and self._values == other._values

    def __hash__(self) -> int:
        return hash(frozenset(self._values))


class OwnCompiler(Compiler):
    """`pipeline_class` of all functions here."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.state.flags = Settings(self.state.flags)

    def compile_extra(self, function: Any) -> Any:
        """Compile without a pause for collecting garbage: some 100,000 objects stay until all is done."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(function)
        finally:
            if collecting:
                gc.enable()


class PartLibrary(JITCodeLibrary):
    """Code that is only ever linked into its callers' and made good with theirs.

    numba would optimise each function on the way up and make machine code of it, with all that it calls, over again.
    """

    optimised_first = False  # before it is linked, too

    def _optimize_final_module(self) -> None:
        if self.optimised_first:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """No machine code: the null pointer, as numba has it for a function without an entry from Python."""
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> PartLibrary:
        """What numba would set the globals through (`set_env`), and asks for nothing else."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """No globals in memory whose value could be set."""


class PartCompiler(OwnCompiler):
    """`pipeline_class` of a part."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.state.library = PartLibrary(self.state.targetctx.codegen(), "part")


class DisjointCompiler(PartCompiler):
    """`pipeline_class` of a part whose array arguments never overlap where one is written.

    The compiler believes it, where it would else test all pairs of them at run time before each loop, and leave short
    loops as they are. Optimised by themselves first, since it makes less of it once they are in their callers.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.state.flags.noalias = True
        self.state.library.optimised_first = True


# All said for every function: what is not said, numba takes from the caller that happens to compile a function first,
# and leaves it on disk for all the others. Division is numpy's: Inf or NaN, which the callers look for. No references
# to arrays are counted (`_nrt`), as they would be for each array that passes through a call or a tuple, one locked
# instruction each: in a loop over samples more work than the arithmetic of a short control filter. So nothing here may
# make an array, nor hand a view of one back to Python, not in a tuple either: the whole array would come back.
OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": False,
    "forceinline": False,
    "no_cfunc_wrapper": True,
    "_nrt": False,
    "pipeline_class": OwnCompiler,
}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: `numba.njit(**OPTIONS)`, with what is given here in place of them."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**(OPTIONS | options))(function)
        cache_file = _cache_file(dispatcher)
        if cache_file is not None:
            cache_file._source_stamp = (cache_file._source_stamp, SOURCES)
        return dispatcher

    return decorate


def _cache_file(dispatcher: Any) -> Any:
    """numba's index on disk; None where there is none, or numba's compiler is switched off."""
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    return cache_file if hasattr(cache_file, "_source_stamp") else None


def on_disk(dispatcher: Any) -> bool:
    """Whether something of a compiled function is kept on disk, and nothing is left to compile for a first use."""
    cache_file = _cache_file(dispatcher)
    try:
        return cache_file is None or bool(cache_file._load_index())
    except OSError:  # another process has it open
        return False


class Part(CPUDispatcher):
    """A function compiled into others, without the entry from Python that for small ones takes longest to make.

    One is made where Python does call it, except for those that are inlined as source: Python has them as they are.
    """

    _entry: Any = None
    _own_options: dict[str, Any]

    def __call__(self, *args: Any) -> Any:
        if self._entry is None:
            as_source = self._own_options.get("inline") == "always"
            self._entry = self.py_func if as_source else compiled(**self._own_options)(self.py_func)
        return self._entry(*args)


def part(*, disjoint: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: as `compiled`, for functions that mostly other compiled functions call.

    `disjoint`: array arguments never overlap where one is written (`DisjointCompiler`).
    """
    compiler = DisjointCompiler if disjoint else PartCompiler

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = compiled(no_cpython_wrapper=True, cache=False, pipeline_class=compiler, **options)(function)
        if not SWITCHED_OFF:
            dispatcher.__class__, dispatcher._own_options = Part, options
        return dispatcher

    return decorate
