"""Exported controllers, compiled by the system's compiler and run on a stream."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from helpers.core import c_compiler, ran
from kfopc_filterpy.export import CExport, export_c

STREAM = Path(__file__).resolve().parents[1] / "export" / "stream.c"
WARNINGS = ("-Wall", "-Wextra", "-pedantic", "-Werror", "-Wconversion")
FAST = ("-O0",)  # the compiler takes most of the time


class Outputs(NamedTuple):
    """What a stream gave: the size of the state, what the self-tests returned, y (J, n), what the updates returned."""

    n_bytes: int
    self_tests: list[float]
    y: np.ndarray
    status: np.ndarray


class Program:
    """A controller that was exported and compiled with `stream.c`, the flags of its header and these options."""

    def __init__(
        self,
        controller: Any,
        folder: Path,
        dtype: str = "float64",
        options: tuple[str, ...] = FAST,
        *,
        first: int = 0,
        path: Any = (0.0,),
        command: str | None = None,
    ) -> None:
        self.command = c_compiler()[0] if command is None else command
        self.exported: CExport = export_c(controller, folder / "anc.c", dtype=dtype)
        self.program = folder / "stream"
        number = "double" if dtype == "float64" else "float"
        values = {"NUMBER": number, "FIRST": first, "PATH": ", ".join(map(repr, map(float, path)))}
        self.defined = [f"-D{name}={value}" for name, value in values.items()]
        self.defined += ["-DARRAYS"] if controller.multichannel else []
        self.compile(options)

    def compile(self, options: tuple[str, ...] = FAST) -> None:
        """Compile the source file as it is now."""
        stated = re.search(r"with these flags.*\n \*  +(-std=c99 .*)", self.exported.header_path.read_text())
        assert stated
        of_gcc = () if "clang" in self.command else ("-Wdouble-promotion",)  # clang's also warns of literals
        flags = (*stated[1].split(), *WARNINGS, *of_gcc, *options, *self.defined, "-I", self.exported.path.parent)
        ran(self.command, *flags, STREAM, self.exported.path, "-lm", "-o", self.program)

    def run(self, x: np.ndarray, e: np.ndarray) -> Outputs:
        """Run it on references, (I, n) or (n,), and errors, (K, n) or (n,)."""
        stream = np.concatenate([np.atleast_2d(x), np.atleast_2d(e)]).T
        done = subprocess.run([str(self.program)], input=stream.astype(np.float64).tobytes(), capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        out = np.frombuffer(done.stdout)
        samples = out[3:].reshape(len(stream), -1).T
        return Outputs(int(out[0]), out[1:3].tolist(), samples[:-1], samples[-1].astype(int))
