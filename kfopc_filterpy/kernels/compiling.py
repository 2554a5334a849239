"""numba as this package uses it: `compiled` for functions that Python calls, `part` for those they call.

Compiled code is cached on disk. numba looks for changes only in the file that defines a function, but the compiled loop
contains functions from other files. The cache folder is therefore named after everything that can change: all sources
of the package and the version of numba. An edit or an upgrade starts a new folder.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import singledispatch
from pathlib import Path
from typing import Any

import numba
from numba.extending import overload

PACKAGE = Path(__file__).parents[1]
CONFIG: Any = numba.config
LOCK = threading.RLock()  # held while a function is compiled for the cache, whose folder is numba's global setting

# Divide as numpy does: division by zero gives Inf or NaN, which the callers check for, and no exception.
OPTIONS: Any = {"error_model": "numpy", "no_cfunc_wrapper": True}


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function for compiled callers, as a part of them; in Python it stays as it is.

    It gets no entry for Python, which takes a fifth of the time of compiling.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        def itself(*arguments: Any, **named: Any) -> Callable[..., Any]:
            return function

        itself.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
        overload(function, jit_options=OPTIONS | options)(itself)
        return function

    return decorate


inlined = part(forceinline=True)  # for functions of a whole state: a real call would pass every array again


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and cache it on disk."""

    def decorate(function: Callable[..., Any]) -> Any:
        with _cache_folder():
            return numba.njit(**(OPTIONS | {"cache": True} | options))(function)

    return decorate


def callback(signature: Any) -> Callable[..., Any]:
    """Compile functions that compiled code calls by address, and Python by `ctypes`."""

    def compiled_callback(**options: Any) -> Callable[[Callable[..., Any]], Any]:
        def decorate(function: Callable[..., Any]) -> Any:
            with _cache_folder():
                return numba.cfunc(signature, error_model="numpy", **options)(function)

        return decorate

    return compiled_callback


def is_ours(kind: type) -> bool:
    """Return whether a type is defined in this package."""
    return kind.__module__.split(".")[0] == PACKAGE.name


def by_type(default: Callable[..., Any]) -> Any:
    """Dispatch on the type of the first argument, like `functools.singledispatch`, for compiled callers too.

    The first argument is a NamedTuple. ``register(SomeState)(body)`` adds a body, whose argument names must be those of
    `default`.
    """
    generic = singledispatch(default)

    def choose(state: Any, *rest: Any) -> Callable[..., Any]:
        return generic.dispatch(getattr(state, "instance_class", object))

    choose.__signature__ = inspect.signature(default)  # type: ignore[attr-defined]
    overload(generic, jit_options=OPTIONS | {"forceinline": True})(choose)
    return generic


def _sources() -> str:
    """Return a hash of all sources of the package and of numba's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _user_cache() -> Path:
    """Return the user's cache folder."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))


def _remove_unused(parent: Path, current: Path) -> None:
    """Remove folders of other sources that nothing was added to for a month."""
    for folder in parent.glob(f"{PACKAGE.name}-*"):
        if folder != current and time.time() - folder.stat().st_mtime > 30 * 86400:
            shutil.rmtree(folder, ignore_errors=True)


def _choose_folder() -> str:
    """Return a writable folder: in NUMBA_CACHE_DIR if it is set, else beside the sources, else in the user's cache."""
    chosen = CONFIG.CACHE_DIR
    parents = [Path(chosen)] if chosen else [PACKAGE / "__pycache__", _user_cache() / PACKAGE.name]
    for parent in parents:
        folder = parent / f"{PACKAGE.name}-{_sources()}"
        new = not folder.exists()
        if _writable(folder):
            if new:
                _remove_unused(parent, folder)
                print("kfopc_filterpy: compiling, once; the first runs take some seconds longer", file=sys.stderr)
            return str(folder)
    return ""  # numba's own choice


FOLDER = _choose_folder()


@contextmanager
def _cache_folder() -> Iterator[None]:
    """Make numba use `FOLDER`. numba chooses the cache folder of a function once, when it is decorated."""
    with LOCK:
        before, CONFIG.CACHE_DIR = CONFIG.CACHE_DIR, FOLDER
        try:
            yield
        finally:
            CONFIG.CACHE_DIR = before
