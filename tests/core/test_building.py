"""How the core is compiled and loaded: flags, levels, stamps, and what is said where something is missing."""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.core import c_compiler, exported, program_flags, ran, tool, zig

from kfopc_filterpy.core import building, library

WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")


@pytest.fixture
def no_flags(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Clear the variables that choose the compiler and its flags."""
    for name in ("CC", "CFLAGS", "CPPFLAGS", "LDFLAGS"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return the folder `core` of a copy, in a package that has nothing else."""
    folder = tmp_path / "kfopc_filterpy" / "core"
    shutil.copytree(building.FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__", ".building-*"))
    (folder.parent / "__init__.py").touch()
    return folder


def loaded(core: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Load the library of a copy in a process of its own."""
    code = "from kfopc_filterpy.core.library import load; print(load().level)"
    command, environment = [sys.executable, "-c", code], {"PATH": "", **variables}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=core.parents[1])


def only_line(failed: subprocess.CompletedProcess[str]) -> str:
    """Return the message of an ImportError, which is one line."""
    assert failed.returncode == 1
    last = failed.stderr.splitlines()[-1]
    assert last.startswith("ImportError: "), failed.stderr
    return last


# Loading.


BASELINE = building.library_name("double", "baseline")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda core: (core / "lms.c").write_text("/* edited */\n"), "was built from other sources"),
        (lambda core: [path.unlink() for path in core.glob("libanc-*")], "is not built"),
        (lambda core: (core / BASELINE).write_bytes(b"not a library"), "does not load"),
    ],
)
def test_a_library_that_cannot_be_used_is_reported(change: Callable[[Path], object], says: str, copied: Path) -> None:
    assert loaded(copied).returncode == 0
    change(copied)
    message = only_line(loaded(copied))
    assert says in message
    assert "python -m pip install -e ." in message


@pytest.mark.parametrize("level", building.levels())
def test_forced_level(level: str) -> None:
    if not (building.FOLDER / building.library_name("double", level)).exists():
        pytest.skip(f"the level {level} is not built")
    run = loaded(building.FOLDER, KFOPC_CORE_LEVEL=level)
    if run.returncode:
        assert f"KFOPC_CORE_LEVEL={level}: the levels that are built and that this machine has are" in only_line(run)
        assert building.LEVELS.index(level) > building.LEVELS.index(library.load().level)
    else:
        assert run.stdout.strip() == level


def test_unknown_level_and_real_are_refused() -> None:
    message = only_line(loaded(building.FOLDER, KFOPC_CORE_LEVEL="x86-64-v9"))
    assert re.search("KFOPC_CORE_LEVEL=x86-64-v9.*baseline", message)
    with pytest.raises(ValueError, match="real must be one of"):
        library.load("half")


# What x86-64-v3 adds to the baseline, and v4 to v3, as Linux calls it.
V3 = {"pni", "ssse3", "fma", "cx16", "sse4_1", "sse4_2", "movbe", "popcnt", "xsave", "avx", "f16c", "lahf_lm", "abm"}
V3 |= {"bmi1", "avx2", "bmi2"}
V4 = {"avx512f", "avx512dq", "avx512cd", "avx512bw", "avx512vl"}


@pytest.mark.skipif(
    platform.machine() != "x86_64" or sys.platform != "linux", reason="levels are of x86, features Linux's"
)
def test_the_level_is_that_of_the_features(tmp_path: Path) -> None:
    """This processor's, as Linux lists them; and on an emulated one, which has no v4, with one feature less each time."""
    source, made = tmp_path / "level.c", tmp_path / "level"
    asking = "int anc_processor_level(void); int main(void) { return anc_processor_level(); }"
    source.write_text(asking)
    ran(*c_compiler(), f"-I{building.FOLDER}", source, building.FOLDER / "processor.c", "-o", made)
    features = set(re.findall(r"^flags\s*:(.*)", Path("/proc/cpuinfo").read_text(), re.M)[0].split())
    expected = 1 if not features >= V3 else 4 if features >= V4 else 3
    assert subprocess.run([made]).returncode == expected
    emulator = tool("qemu-x86_64")
    processors = {"max": 3, "max,level=7": 3, "max,level=6": 1, "max,xlevel=0x80000000": 1}
    processors |= {f"max,-{feature.replace('sse4_', 'sse4.')}": 1 for feature in V3}
    got = {name: subprocess.run([emulator, "-cpu", name, made]).returncode for name in processors}
    assert got == processors


def test_libraries_of_this_machine_are_current() -> None:
    """One that is left over from an earlier build would not be noticed before somebody asks for its level."""
    for path in building.FOLDER.glob("libanc-*"):
        assert building.stamp_of(ctypes.CDLL(str(path))) == building.stamp(), path


# Flags.


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("CC", "-ffast-math"),
        ("CPPFLAGS", "-Ofast"),
        ("LDFLAGS", "-ffp-contract=fast"),
        *(("CFLAGS", flag) for flag in ("-ffinite-math-only", "-mfpmath=387", "-mdaz-ftz", "-mrecip=all")),
    ],
)
def test_flags_that_break_equal_bits_are_refused(name: str, flag: str, no_flags: pytest.MonkeyPatch) -> None:
    no_flags.setenv(name, f"gcc -O2 {flag} -g" if name == "CC" else f"-O2 {flag} -g")
    with pytest.raises(building.BuildError, match=re.escape(f"{flag} breaks this, remove it")):
        building.flags(building.compiler())


def test_flags_of_packagers_are_honoured(tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    """Debug information, hardening and a path in the library appear; the level and the contraction stay ours."""
    command = c_compiler()
    no_flags.setenv("CC", command[0])
    no_flags.setenv("CFLAGS", "-O2 -g -fstack-protector-strong -Wformat -Werror=format-security -ffp-contract=off")
    no_flags.setenv("CPPFLAGS", "-D_FORTIFY_SOURCE=2")
    no_flags.setenv("LDFLAGS", "-Wl,-rpath,/of/a/packager")
    made = tmp_path / building.library_name("double", "baseline")
    building.build(building.core_sources(), made)
    content = made.read_bytes()
    assert b".debug_info" in content
    assert b"/of/a/packager" in content
    given = building.flags(command)
    assert given.index("-O2") < given.index("-O3")  # ours decide
    assert building.stamp_of(ctypes.CDLL(str(made))) == building.stamp()


@pytest.mark.skipif(len(building.levels()) == 1, reason="this processor has one level")
def test_instructions_of_the_environment_reach_no_library(no_flags: pytest.MonkeyPatch) -> None:
    """The baseline runs everywhere: what the compiler takes for the processor is the level's, for any CFLAGS."""
    command = c_compiler()

    def instructions() -> str:
        given = [flag for flag in building.flags(command) if not flag.startswith("-Wl")]
        listing = ran(*command, *given, "-m64", "-dM", "-E", "-x", "c", "/dev/null")
        return "\n".join(line for line in listing.splitlines() if re.search("SSE|AVX|FMA|BMI|LZCNT|POPCNT", line))

    own = instructions()
    no_flags.setenv("CFLAGS", "-O2 -m64 -mavx2 -mfma -msse4.2 -march=native -mpopcnt -mtune=native")
    assert instructions() == own
    assert "AVX" not in own


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast"])
def test_headers_refuse_fast_mathematics(flag: str, tmp_path: Path) -> None:
    """Whoever compiles the C files with his own tools is told too."""
    unit = tmp_path / "unit.c"
    unit.write_text('#include "signals.h"\n')
    command = [*c_compiler(), *building.FLAGS, f"-I{building.FOLDER}", flag, "-fsyntax-only", str(unit)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode
    assert "the core promises equal bits" in run.stderr


def test_a_failing_compiler_is_quoted(tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    no_flags.setenv("CC", c_compiler()[0])
    unit = tmp_path / "unit.c"
    unit.write_text("#error of this kind\n")
    with pytest.raises(building.BuildError, match="of this kind"):
        building.build([unit], tmp_path / "lib.so")
    assert [path.name for path in tmp_path.iterdir()] == ["unit.c"]  # nothing half made


# Compilers.


def test_no_compiler_says_what_to_install(tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    no_flags.setenv("PATH", str(tmp_path))
    no_flags.setattr(building.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(building.BuildError) as caught:
        building.build(building.core_sources(), tmp_path / "lib.so")
    message = str(caught.value)
    assert "\n" not in message
    for word in ("gcc", "clang", "CC", "-m pip install ziglang"):
        assert word in message


def test_a_named_compiler_that_is_missing_is_reported(tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    no_flags.setenv("CC", "no-such-compiler")
    with pytest.raises(building.BuildError, match="the C compiler no-such-compiler does not start"):
        building.build(building.core_sources(), tmp_path / "lib.so")
    with pytest.raises(building.BuildError, match="no-such-compiler does not start"):
        building.build_core(tmp_path)


def test_zig_is_taken_where_the_machine_has_no_compiler(tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    no_flags.setenv("PATH", str(tmp_path))
    no_flags.setattr(building.importlib.util, "find_spec", lambda name: object())
    assert building.compiler() == [sys.executable, "-P", "-m", "ziglang", "cc"]


@pytest.mark.parametrize("real", building.REALS)
@pytest.mark.parametrize("compiler", ["gcc", *(pytest.param(one, marks=pytest.mark.slow) for one in ("clang", "zig"))])
def test_no_warnings(real: str, compiler: str, tmp_path: Path, no_flags: pytest.MonkeyPatch) -> None:
    command = zig() if compiler == "zig" else [tool(compiler, compiler)]
    options = (*building.flags(command, real), *WARNINGS)
    ran(*command, *options, *building.core_sources(), "-o", tmp_path / "libanc.so", "-lm")


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="a flag of x86-64")
def test_a_processor_with_half_precision_is_no_x87(tmp_path: Path) -> None:
    """Without -std, gcc then states 16 as FLT_EVAL_METHOD, as with -march=native on such a processor."""
    unit = tmp_path / "unit.c"
    unit.write_text('#include "signals.h"\n_Static_assert(FLT_EVAL_METHOD == 16, "");\n')
    flags = ("-O3", "-mavx512fp16", "-Wundef", "-Werror", f"-I{building.FOLDER}", "-fsyntax-only")
    ran(tool("gcc", "gcc"), *flags, unit)


@pytest.mark.parametrize(
    ("header", "suffix"), [("anc.h", ".cpp"), ("anc.h", ".c"), ("vectors.h", ".c"), ("signals.h", ".c")]
)
def test_headers_stand_alone(header: str, suffix: str, tmp_path: Path) -> None:
    """The public one in C++ too."""
    unit = tmp_path / f"unit{suffix}"
    unit.write_text(f'#include "{header}"\n#include "{header}"\nextern int something;\n')
    c = c_compiler()
    command = [tool("g++", "g++"), "-std=c++11"] if suffix == ".cpp" else [*c, *program_flags(c)]
    unused = ("-Wno-unused-function", "-Wno-unused-const-variable")
    ran(*command, *WARNINGS, *unused, f"-I{building.FOLDER}", "-fsyntax-only", unit)


# What a library shows.


@pytest.mark.parametrize("path", sorted(building.FOLDER.glob("libanc-*")), ids=lambda path: path.name)
def test_every_public_symbol_begins_with_anc(path: Path) -> None:
    listing = ran(tool("nm"), "-D", "--defined-only", path)
    kinds = {name: kind for kind, name in (line.split()[-2:] for line in listing.splitlines())}
    assert [name for name in kinds if not name.startswith("anc_")] == []
    data = {name for name, kind in kinds.items() if kind in "DRBV"} - {"anc_stamp"}
    assert data == {f"anc_{name}" for name in (*exported(), *exported("real"))}
    header = (building.FOLDER / "anc.h").read_text(encoding="utf-8")
    functions = set(re.findall(r"^ANC_PUBLIC [^;(]*?(anc_\w+)\(", header, re.M)) | {"anc_processor_level"}
    assert {name for name, kind in kinds.items() if kind == "T"} == functions


@pytest.mark.parametrize("path", sorted(building.FOLDER.glob("libanc-*")), ids=lambda path: path.name)
def test_a_library_needs_no_memory_and_no_files(path: Path) -> None:
    """No allocation, no input or output: of the C library it takes copying, sqrt and the like."""
    listing = ran(tool("nm"), "-D", "--undefined-only", path)
    names = {line.split()[-1].split("@")[0] for line in listing.splitlines()}
    allowed = {"memcpy", "memset", "memmove", "sqrt", "sqrtf", "__stack_chk_fail"}
    assert {name for name in names if not name.startswith(("_ITM_", "__cxa_finalize", "__gmon_start__"))} <= allowed
