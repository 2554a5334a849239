"""Compile the core with the machine's C compiler or with zig's, which comes as a wheel.

The build of the package loads this file by its path, so it imports nothing of the package.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
REALS = ("double", "float")
LEVELS = ("baseline", "x86-64-v3", "x86-64-v4")  # from the lowest; other processors have the first only
# What Python assumes about the core beyond its sources. A change here makes every library that is built already too
# old.
LAYOUT = 1
# The promise of equal bits on every machine rests on these: no contraction, no reassociation. The rest is for speed.
FLAGS = (
    *("-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"),
    *("-fvisibility=hidden", "-Wno-psabi", "-shared"),
)
_PACKAGERS = ("CFLAGS", "CPPFLAGS", "LDFLAGS")
_REFUSED = (
    *("-ffast-math", "-Ofast", "-funsafe-math-optimizations", "-fassociative-math", "-freciprocal-math"),
    *("-ffinite-math-only", "-fno-honor-nans", "-fno-honor-infinities", "-fapprox-func", "-fno-signed-zeros"),
    *("-fsingle-precision-constant", "-ffp-contract=fast", "-ffp-contract=on"),
    *("-ffp-model=fast", "-ffp-model=aggressive", "-mfpmath=387", "-mfpmath=both", "-mfpmath=sse+387", "-mdaz-ftz"),
)
_REFUSED_BEGINNINGS = ("-mrecip", "-fdenormal-fp-math", "-Wp,-ffast-math")
_KEPT_OF_MACHINE = ("-m32", "-m64", "-mx32", "-mmacosx-version-min")


class BuildError(RuntimeError):
    """There is no compiler, a flag is refused, or the compiler failed."""


def compiler(target: str = "") -> list[str]:
    """Return the command of $CC, cc, gcc or clang, or else of the zig that is installed beside this Python.

    For a target, a machine in zig's words, it is always a zig.

    Raises
    ------
    BuildError
        If there is none. The message says what to install.
    """
    own = machine_compiler()
    if own and (not target or _is_zig(own)):
        return own
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-P", "-m", "ziglang", "cc"]
    if target:
        raise BuildError(f"only zig builds for other machines, such as {target}: {_pip()} install ziglang")
    raise BuildError(
        "the core of kfopc_filterpy needs a C compiler: install gcc or clang (or name one by CC), "
        f"or zig's as a wheel: {_pip()} install ziglang"
    )


def _pip() -> str:
    return f"{Path(sys.executable).name} -m pip"


def machine_compiler() -> list[str]:
    """Return the command of $CC, cc, gcc or clang, or nothing.

    On Windows, only $CC makes libraries that fit this Python.
    """
    if named := shlex.split(os.environ.get("CC", ""), posix=os.name == "posix"):
        return named
    names = () if os.name == "nt" else ("cc", "gcc", "clang")
    return [found for name in names if (found := shutil.which(name))][:1]


def levels(target: str = "") -> tuple[str, ...]:
    """Return the levels that libraries are built for: on this machine, or on a target in zig's words."""
    machine = target.split("-")[0] or (platform.machine() if sys.maxsize > 2**32 else "")
    return LEVELS if machine in ("x86_64", "AMD64") else LEVELS[:1]


def library_name(real: str, level: str, target: str = "") -> str:
    """Return the file name of the core's library."""
    suffix = {"windows": ".dll", "macos": ".dylib"}.get(_system(target), ".so")
    return f"libanc-{real}-{level}{suffix}"


def flags(command: list[str], real: str = "double", level: str = LEVELS[0], target: str = "") -> list[str]:
    """Return the compiler's flags: those of CFLAGS, CPPFLAGS and LDFLAGS, then ours, which decide.

    On a processor with levels, flags of the environment that choose instructions, such as ``-mavx2``, are left out.

    Raises
    ------
    BuildError
        If the environment has a flag that breaks the promise of equal bits.
    """
    given = [flag for name in _PACKAGERS for flag in shlex.split(os.environ.get(name, ""))]
    for flag in (*command, *given):
        if flag in _REFUSED or flag.startswith(_REFUSED_BEGINNINGS):
            raise BuildError(f"kfopc_filterpy promises equal bits on every machine: {flag} breaks this, remove it")
    if len(levels(target)) > 1:  # the level chooses the instructions: a -mavx2 would outlive the -march after it
        given = [flag for flag in given if not flag.startswith("-m") or flag.startswith(_KEPT_OF_MACHINE)]
    public = '__attribute__((visibility("default")))'
    if _system(target) == "windows":
        public = "__declspec(dllexport)"
    else:
        given.append("-fPIC")
    return [
        *given,
        *FLAGS,
        *_machine_flags(command, level, target),
        *(["-DANC_FLOAT"] if real == "float" else []),
        f"-DANC_PUBLIC={public}",
        f'-DANC_STAMP="{stamp()}"',
        f"-I{FOLDER}",
    ]


def stamp(folder: Path = FOLDER) -> str:
    """Return a short hash of what a library is built from: the C files of the core, the flags and the layout."""
    digest = hashlib.sha256(repr((LAYOUT, FLAGS)).encode())
    for path in core_sources(folder, "*.[ch]"):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)} ".encode() + content)
    return digest.hexdigest()[:16]


def core_sources(folder: Path = FOLDER, pattern: str = "*.c") -> list[Path]:
    """Return the C files of the core, in the order of their names."""
    return sorted(folder.glob(pattern))


def stamp_of(library: ctypes.CDLL) -> str:
    """Return the stamp that a library was built with, or nothing if it has none."""
    try:
        text = ctypes.c_char.in_dll(library, "anc_stamp")
    except ValueError:
        return ""
    return ctypes.string_at(ctypes.addressof(text)).decode()


def build(
    sources: Iterable[Path | str], output: Path | str, real: str = "double", level: str = LEVELS[0], target: str = ""
) -> None:
    """Compile C files to one library. The library appears at once, and replaces one that is in use safely.

    Parameters
    ----------
    sources : iterable of path
        C files. They can include the core's headers.
    output : path
        The library.
    real : {"double", "float"}
        Type of the core's numbers.
    level : str
        One of `levels(target)`.
    target : str
        A machine in zig's words, such as ``aarch64-linux-musl``. By default this machine.

    Raises
    ------
    BuildError
        If there is no compiler, a flag is refused, or the compiler fails: the message ends with what it printed.
    """
    if real not in REALS or level not in levels(target):
        raise ValueError(f"a library is for one of {REALS} and one of {levels(target)}, got {real!r} and {level!r}")
    command, output = compiler(target), Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=".building-") as folder:
        library = Path(folder, output.name)
        line = [*command, *flags(command, real, level, target), "-o", str(library), *map(str, sources), "-lm"]
        if _system(target) == "macos":  # where a library has a name in it, by default the path at which it is made
            line.append(f"-Wl,-install_name,@rpath/{output.name}")
        try:
            run = subprocess.run(line, capture_output=True, text=True, errors="replace")
        except OSError as error:
            raise BuildError(f"the C compiler {command[0]} does not start: {error}") from None
        if run.returncode:
            raise BuildError(f"the C compiler failed: {shlex.join(line)}\n{run.stdout}{run.stderr}")
        os.replace(library, output)


def build_core(folder: Path, target: str = "") -> list[Path]:
    """Compile the libraries of the core into a folder, for each real and level, and return them."""
    command = compiler(target)
    known = [level for level in levels(target) if level == LEVELS[0] or _knows(command, level)]
    jobs = {folder / library_name(real, level, target): (real, level) for level in reversed(known) for real in REALS}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = [pool.submit(build, core_sources(), path, real, level, target) for path, (real, level) in jobs.items()]
    for job in done:
        job.result()
    return sorted(jobs)


def _system(target: str) -> str:
    own = {"Windows": "windows", "Darwin": "macos"}.get(platform.system(), "other")
    return target.split("-")[1].split(".")[0] if target else own


def _is_zig(command: list[str]) -> bool:
    return any(Path(part).stem in ("zig", "ziglang") for part in command)


def _machine_flags(command: list[str], level: str, target: str) -> list[str]:
    """Return the flags that name the processor. Without one, zig builds for the machine at hand."""
    if _is_zig(command):
        chosen = [f"-mcpu={'baseline' if level == LEVELS[0] else level.replace('-', '_')}"]
        return [*chosen, "-target", target, "-s"] if target else chosen  # without symbols for debuggers
    if len(levels()) == 1:
        return []
    return ["-march=x86-64" if level == LEVELS[0] else f"-march={level}"]


def _knows(command: list[str], level: str) -> bool:
    """Tell whether the compiler knows a level: gcc does from 11 on, clang from 12 on."""
    if _is_zig(command):
        return True
    try:
        empty = subprocess.run([*command, f"-march={level}", "-E", "-x", "c", "-"], input=b"", capture_output=True)
    except OSError:
        return False
    return empty.returncode == 0
