"""The wheels that `nox -s wheels` made, in the folder that KFOPC_WHEELS names: what is in them, and the bits that they compute."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.core import FOLDER, highest_level, program, ran, tool, zig

from kfopc_filterpy.core import building

pytestmark = pytest.mark.slow
# Of each wheel, by its tag: the target in zig's words, and what the program `file` calls its libraries.
WHEELS = {
    "manylinux_2_17_x86_64": ("x86_64-linux-gnu.2.17", "ELF 64-bit .*x86-64"),
    "manylinux_2_17_aarch64": ("aarch64-linux-gnu.2.17", "ELF 64-bit .*ARM aarch64"),
    "musllinux_1_1_x86_64": ("x86_64-linux-musl", "ELF 64-bit .*x86-64"),
    "musllinux_1_1_aarch64": ("aarch64-linux-musl", "ELF 64-bit .*ARM aarch64"),
    "macosx_11_0_x86_64": ("x86_64-macos.11.0", "Mach-O 64-bit .*x86_64"),
    "macosx_11_0_arm64": ("aarch64-macos.11.0", "Mach-O 64-bit .*arm64"),
    "win_amd64": ("x86_64-windows-gnu", r"PE32\+ .*\(DLL\).*x86-64"),
}
CODE_SIGNATURE = b"\xfa\xde\x0c\xc0"  # an arm64 Mac loads nothing without it


def libraries(tag: str, folder: Path) -> dict[str, Path]:
    """Unpack the libraries of a wheel and return them by their names; skip the test if there are no wheels."""
    named = os.environ.get("KFOPC_WHEELS")
    if not named:
        pytest.skip("KFOPC_WHEELS names no folder of wheels, as `nox -s wheels` makes them")
    (wheel,) = Path(named).glob(f"*-py3-none-{tag}.whl")
    with zipfile.ZipFile(wheel) as file:
        names = [name for name in file.namelist() if "/libanc-" in name]
        return {Path(name).name: Path(file.extract(name, folder)) for name in names}


@pytest.mark.parametrize("tag", WHEELS)
def test_libraries_of_a_wheel(tag: str, tmp_path: Path) -> None:
    target, kind = WHEELS[tag]
    found = libraries(tag, tmp_path)
    expected = {
        building.library_name(real, level, target) for real in building.REALS for level in building.levels(target)
    }
    assert set(found) == expected
    for path in found.values():
        content = path.read_bytes()
        assert re.search(kind, ran(tool("file"), path))
        assert building.stamp().encode() in content
        assert b".building-" not in content  # no path of the machine that made it
        if tag.endswith("arm64"):
            assert CODE_SIGNATURE in content


def runner(tag: str, folder: Path) -> tuple[str, Callable[[Path, Path], str]]:
    """Return the target of a program that loads a library of a wheel, and what runs it here; or skip the test."""
    target = WHEELS[tag][0]
    if tag == "win_amd64":
        wine = tool("wine")
        return target, lambda made, library: ran(
            wine, made, library, WINEDEBUG="-all", WINEPREFIX=str(folder / "prefix")
        )
    machine, _, libc = target.split(".")[0].split("-")
    here = os.uname().machine == machine
    loader = {"gnu": "ld-linux-aarch64.so.1" if machine == "aarch64" else "ld-linux-x86-64.so.2"}.get(
        libc, f"ld-musl-{machine}.so.1"
    )
    roots = [Path("/") if here else Path(f"/usr/{machine}-linux-{libc}")]
    places = [root / part / loader for root in roots for part in ("lib", "lib64")]
    if not any(place.exists() for place in places):
        pytest.skip(f"this machine has no {loader}: package musl, or libc6-arm64-cross")
    if here:
        return target, ran
    emulator = tool(f"qemu-{machine}", "qemu-user")
    return target, lambda made, library: ran(emulator, "-L", roots[0], made, library)


@pytest.mark.parametrize("real", building.REALS)
@pytest.mark.parametrize("tag", [tag for tag in WHEELS if not tag.startswith("macosx")])
def test_a_wheel_computes_the_same_bits(tag: str, real: str, tmp_path: Path) -> None:
    """A program opens the wheel's own libraries, as Python does."""
    found = libraries(tag, tmp_path)
    target, run = runner(tag, tmp_path)
    options = (
        "-DLOADED",
        "-O1",
        *(() if tag == "win_amd64" else ("-ldl", "-dynamic")),
    )  # for musl, zig links statically
    made = program("same_bits", tmp_path, zig(), *options, sources=[], real=real, target=target)
    if tag == "win_amd64":
        made = made.rename(made.with_suffix(".exe"))
    lines = [line for line in (FOLDER / "same_bits.txt").read_text().splitlines() if line.startswith(real)]
    for level in building.levels(target):
        if building.LEVELS.index(level) <= building.LEVELS.index(highest_level()):
            output = run(made, found[building.library_name(real, level, target)])
            assert [f"{real} {line}" for line in output.splitlines()] == lines, level
