"""Reads a file in a process of its own, whose time and memory are limited, because a damaged file can hang a library.

If a few bytes of a file are changed, libhdf5 can loop for ever, and scipy's reader of MATLAB files can end the process;
both can take gigabytes. Nothing within the process can stop that. A process of its own costs 0.3 s for each file. Its
memory can be limited on Linux only.
"""

from __future__ import annotations

import faulthandler
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from .content import Content, room_of

_LEAST_S, _BYTES_PER_S = 10.0, 1e6  # how long a file may take
_RUN = """
import json, sys
job = json.loads(sys.argv[1])
sys.path[:] = job.pop("search")
from kfopc_filterpy.signals.child import serve
serve(**job)
"""


def read_in_child(
    library: str, read: Callable[..., Content], path: str | os.PathLike[str], *more: str | None
) -> Content:
    """Return what the function `read`, which uses `library`, returns for a file and more arguments."""
    limit_s = _LEAST_S + Path(path).stat().st_size / _BYTES_PER_S
    job = {
        "library": library,
        "function": [read.__module__, read.__name__],
        "arguments": [os.fspath(path), *more],
        "limit_s": limit_s,
        "search": sys.path,
    }
    command = [sys.executable, "-P", "-c", _RUN, json.dumps(job)]
    # glibc would reserve 64 MB for the thread of the time limit, at times after the memory limit is set.
    environment = os.environ | {"MALLOC_ARENA_MAX": "1"}
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    ) as child:
        try:
            output: Any = child.stdout
            answer = json.loads(output.readline() or "{}")
            if "shape" in answer:
                for told in answer.pop("warnings"):
                    warnings.warn(told, stacklevel=2)
                samples = np.empty(answer.pop("shape"))
                if output.readinto(samples.reshape(-1).view(np.uint8)) == samples.nbytes:
                    return Content(samples, **answer)
        finally:
            child.kill()
    raise ValueError(
        answer.get("error")
        or f"{path} is damaged: its library ended (exit code {child.returncode}), or took longer than {limit_s:.0f} s"
    )


def serve(library: str, function: tuple[str, str], arguments: list[str], limit_s: float) -> None:
    """Write what a function returns, or its error, to the standard output: a line of JSON, then the samples."""
    module, name = function
    try:
        read = getattr(import_module(module), name)
        import_module(library)  # which takes time and memory of its own
        faulthandler.dump_traceback_later(limit_s, exit=True)  # even if a library never returns
        _limit_memory(3 * room_of(arguments[0]))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", UserWarning)
            content: Content = read(*arguments)
        samples = np.ascontiguousarray(content.samples, dtype=np.float64)
        answer: dict[str, Any] = content._asdict() | {
            "shape": samples.shape,
            "warnings": [str(one.message) for one in told],
        }
        del answer["samples"]
    except MemoryError:
        text = "would take more memory than a file of its size may. If the file is right, store it uncompressed, or in parts"
        samples, answer = np.empty(0), {"error": f"{arguments[0]} {text}"}
    except Exception as error:  # noqa: BLE001 - whatever it is, the parent raises it
        samples, answer = np.empty(0), {"error": str(error) or type(error).__name__}
    with open(1, "wb") as output:
        output.write(json.dumps(answer).encode() + b"\n")
        output.write(samples.data)


def _limit_memory(n_bytes: int) -> None:
    """Let this process take so much memory beyond what it has."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + n_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
