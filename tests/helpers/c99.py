"""Exported controllers, compiled by the system's compiler and run on a stream."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from kfopc_filterpy.export import CExport, export_c

FOLDER = Path(__file__).resolve().parents[1] / "export"
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-Wdouble-promotion")
STRICT = ("-std=c99", "-O2", *WARNINGS)
REAL = {"float64": "double", "float32": "float"}


class Outputs(NamedTuple):
    """What a stream gave: the size of the state, y(n), what the updates returned, the weights at the end."""

    n_bytes: int
    y: np.ndarray
    status: np.ndarray
    weights: np.ndarray


def compiler(*names: str) -> str:
    """Return the first of these compilers that the machine has, or skip the test."""
    found = next((name for name in names if shutil.which(name)), None)
    if found is None:
        pytest.skip(f"needs a compiler: none of {', '.join(names)} is installed")
    return found


def c_compiler() -> str:
    """Return the C compiler, or skip the test."""
    return compiler("cc", "gcc", "clang")


def succeeds(*command: Any) -> None:
    """Run a command; if it fails, so does the test, with what the command said."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


class Program:
    """A controller that was exported and compiled with `stream.c`."""

    def __init__(self, controller: Any, folder: Path, dtype: str = "float64", options: tuple[str, ...] = ()) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.exported: CExport = export_c(controller, folder / "anc.c", dtype=dtype)
        self.program = folder / "stream"
        sources = (FOLDER / "stream.c", self.exported.path)
        include = (f"-Dreal={REAL[dtype]}", "-I", folder)
        succeeds(c_compiler(), *STRICT, *options, *include, *sources, "-lm", "-o", self.program)

    def run(self, x: np.ndarray, d: np.ndarray, secondary_path: Any = ()) -> Outputs:
        """Run it with the plant of `simulate`; without a secondary path, d is the error."""
        stream = np.concatenate([[len(secondary_path)], secondary_path, np.stack([x, d], axis=1).ravel()])
        done = subprocess.run([str(self.program)], input=stream.astype(np.float64).tobytes(), capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        size, *_ = out = np.frombuffer(done.stdout)
        samples = out[1 : 1 + 2 * x.size].reshape(-1, 2)
        return Outputs(int(size), samples[:, 0], samples[:, 1].astype(int), out[1 + 2 * x.size :])


class CoreOutputs(NamedTuple):
    """What a stream gave: the size of the state, what the self-tests returned, y (J, n), what the updates returned."""

    n_bytes: int
    self_tests: list[float]
    y: np.ndarray
    status: np.ndarray


class CoreProgram:
    """A controller of the core that was exported and compiled with `core_stream.c` and the flags of its header."""

    def __init__(self, controller: Any, folder: Path, dtype: str = "float64", options: tuple[str, ...] = ()) -> None:
        self.exported: CExport = export_c(controller, folder / "anc.c", dtype=dtype)
        self.program, self.loudspeakers = folder / "stream", controller.n_loudspeakers
        stated = re.search(r"with these flags.*\n \*  +(-std=c99 .*)", self.exported.header_path.read_text())
        assert stated
        include = (f"-Dreal={REAL[dtype]}", *(["-DARRAYS"] if controller.multichannel else []), "-I", folder)
        flags, source = (*stated[1].split(), *WARNINGS, *options), self.exported.path
        objects = [folder / f"{name}.o" for name in ("anc", "stream")]
        succeeds(c_compiler(), *flags, "-c", source, "-o", objects[0])
        succeeds(c_compiler(), *flags, *include, "-c", FOLDER / "core_stream.c", "-o", objects[1])
        succeeds(c_compiler(), *options, *objects, "-lm", "-o", self.program)

    def run(self, x: np.ndarray, e: np.ndarray) -> CoreOutputs:
        """Run it on references, (I, n) or (n,), and errors, (K, n) or (n,)."""
        stream = np.concatenate([np.atleast_2d(x), np.atleast_2d(e)]).T
        done = subprocess.run([str(self.program)], input=stream.astype(np.float64).tobytes(), capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        out = np.frombuffer(done.stdout)
        samples = out[3:].reshape(len(stream), -1).T
        return CoreOutputs(int(out[0]), out[1:3].tolist(), samples[:-1], samples[-1].astype(int))


def operations(controller: Any, folder: Path, x: np.ndarray, e: np.ndarray) -> tuple[CExport, np.ndarray]:
    """Export a controller; return the floating-point operations of each sample, counted by a class in place of double."""
    exported = export_c(controller, folder / "anc.c")
    program = folder / "counting"
    succeeds(compiler("c++", "g++"), "-std=c++20", "-O1", "-I", folder, FOLDER / "counting.cpp", "-o", program)
    stream = np.stack([x, e], axis=1).tobytes()
    done = subprocess.run([str(program)], input=stream, capture_output=True, check=True)
    return exported, np.frombuffer(done.stdout).astype(int)
