"""The same bits from every compiler, flag, level, processor and system."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.core import FOLDER, c_compiler, highest_level, known, program, ran, tool, zig

from kfopc_filterpy.core import building, library

RECORDED = FOLDER / "same_bits.txt"
SAMPLES = 700
# Other ways to the same sums: one number at a time, other optimization, all files at once.
OTHERS = {"one lane": ("-DLANES_OF_ONE=1",), **{flag: (flag,) for flag in ("-O0", "-O1", "-Os", "-flto")}}


def recorded(real: str) -> list[str]:
    """Return the lines of same_bits.txt for a type of numbers."""
    lines = [line.split(" ", 1) for line in RECORDED.read_text().splitlines() if not line.startswith("#")]
    return [line for kind, line in lines if kind == real]


def assert_same(output: str, real: str, tmp_path: Path) -> None:
    """Compare the lines of the program with those that were recorded, of which none may be missing."""
    lines, expected = output.splitlines(), recorded(real)
    assert {line.split()[0] for line in lines} == set(known())
    if lines != expected:
        (tmp_path / "lines.txt").write_text("".join(f"{real} {line}\n" for line in lines))
        pytest.fail(
            f"other bits than recorded: {sorted(set(lines) ^ set(expected))}\nIf another build of these sources passes, "
            "this one breaks the promise. If the arithmetic was changed on purpose or an algorithm is new, put the lines of "
            f"{tmp_path / 'lines.txt'} into {RECORDED.name}"
        )


@pytest.mark.parametrize("real", building.REALS)
@pytest.mark.parametrize("level", building.LEVELS)
def test_libraries_of_all_levels(real: str, level: str, tmp_path: Path) -> None:
    """The very libraries that Python loads."""
    file = building.FOLDER / building.library_name(real, level)
    if not file.exists():
        pytest.skip(f"{file.name} is not built on this machine")
    if building.LEVELS.index(level) > building.LEVELS.index(highest_level()):
        pytest.skip(f"this processor has no {level}")
    made = program("same_bits", tmp_path, c_compiler(), "-O1", f"-Wl,-rpath,{file.parent}", sources=[file], real=real)
    assert_same(ran(made), real, tmp_path)


@pytest.mark.parametrize("real", building.REALS)
def test_every_case_runs(real: str) -> None:
    """The recorded lines are of runs that were completed."""
    for line in recorded(real):
        kind, *_, done, y, states = line.split()[1:]
        assert int(done) == SAMPLES or kind == "hard", line  # a Kalman filter refuses the click
        assert y != states


@pytest.mark.parametrize(
    ("real", "other"),
    [
        pytest.param(real, name, marks=[] if (real, name) == ("double", "one lane") else pytest.mark.slow)
        for real in building.REALS
        for name in OTHERS
    ],
)
def test_other_ways_to_compile(real: str, other: str, tmp_path: Path) -> None:
    assert_same(ran(program("same_bits", tmp_path, c_compiler(), *OTHERS[other], real=real)), real, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("real", building.REALS)
@pytest.mark.parametrize("level", building.levels())
@pytest.mark.parametrize("compiler", ["gcc", "clang", "zig"])
def test_other_compilers(real: str, level: str, compiler: str, tmp_path: Path) -> None:
    command = zig() if compiler == "zig" else [tool(compiler)]
    if building.LEVELS.index(level) > building.LEVELS.index(highest_level()):
        pytest.skip(f"this processor has no {level}")
    assert_same(ran(program("same_bits", tmp_path, command, real=real, level=level)), real, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("real", building.REALS)
@pytest.mark.parametrize("processor", ["aarch64", "riscv64", "arm", "x86"])
def test_other_processors(real: str, processor: str, tmp_path: Path) -> None:
    """A static program of zig, run by an emulator."""
    emulator = tool({"x86": "qemu-i386"}.get(processor, f"qemu-{processor}"))
    target = {"arm": "arm-linux-musleabihf"}.get(processor, f"{processor}-linux-musl")
    # The vectors of 32-bit ARM take numbers below 1e-38 for zero, other than its scalars and all other processors.
    options = ["-mcpu=baseline-neon"] if processor == "arm" else []
    made = program("same_bits", tmp_path, zig(), "-static", *options, real=real, target=target)
    assert_same(ran(emulator, made), real, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("real", building.REALS)
def test_windows(real: str, tmp_path: Path) -> None:
    """A program for Windows, run by Wine."""
    wine = tool("wine")
    made = program("same_bits", tmp_path, zig(), real=real, target="x86_64-windows-gnu")
    windows_name = made.with_suffix(".exe")
    made.rename(windows_name)
    output = ran(wine, windows_name, WINEDEBUG="-all", WINEPREFIX=str(tmp_path / "prefix"), DISPLAY="")
    assert_same(output, real, tmp_path)


def test_the_loaded_library_is_of_the_highest_level_built() -> None:
    loaded = library.load()
    assert loaded.path.name == building.library_name("double", loaded.level)
