"""Exported controllers on an emulated Cortex-M4: the bits of this machine, and what they would need of a board.

`KFOPC_TABLES=docs pytest -m slow tests/export/test_board.py` writes the table of docs/embedded.md. The emulator counts
instructions, not cycles; no real board is used.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.core import ran
from helpers.tables import stored_table, write_table

from kfopc_filterpy import OutputLimiter, Plant, diagonal_kf, fx_lms, kf_opc, kf_pb
from kfopc_filterpy.export import export_c
from kfopc_filterpy.verdict.items import aligned

FOLDER = Path(__file__).parent
COMPILER, EMULATOR, SIZE = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
BOARD = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-nostartfiles", "--specs=nosys.specs")
MACHINE = (EMULATOR, "-M", "mps2-an386", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel")
SAMPLES, RATES_HZ = 16_000, (8000, 16000)
S = np.r_[0.0, 0.8, 0.3, np.zeros(29)]
PLANT = Plant(S, fs=16000)
NOISES = {"state_noise": 1e-9, "measurement_noise": 1e-3}
CONTROLLERS = {
    "FxLMS, 256 taps": fx_lms(256, PLANT, step_size=1e-4),
    "diagonal Kalman, 256 taps": diagonal_kf(256, PLANT, rated_power=0.5, **NOISES),
    "KF-OPC, 64 taps": kf_opc(64, PLANT, rated_power=0.5, **NOISES),
    "KF-OPC, 64 taps, limiter": kf_opc(64, PLANT, rated_power=0.5, limiter=OutputLimiter(0.5, fs=16000), **NOISES),
    "KF-PB, 64 taps": kf_pb(64, PLANT, rated_power=0.5),
}
MILLIONS = (f"at {rate // 1000} kHz" for rate in RATES_HZ)
HEAD = ["Cortex-M4, single precision", "flash", "data", "stack", "mean", "worst", *MILLIONS]


def numbers(said):
    """Return the numbers of each name that a program has printed in hexadecimal, in order."""
    found = {}
    for name, digits in re.findall(r"^(\w+) ([0-9a-f]+)$", said, re.M):
        found.setdefault(name, []).append(int(digits, 16))
    return found


@pytest.fixture(scope="module")
def rows():
    """Rows of the table, which is written when all controllers have one."""
    found = {}
    yield found
    if list(found) == list(CONTROLLERS):
        write_table("board.txt", "\n".join(aligned([HEAD, *found.values()], left={0})))


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_board_plays_the_bits_of_this_machine(name, rows, tmp_path):
    if missing := [tool for tool in (COMPILER, EMULATOR, SIZE, "cc") if shutil.which(tool) is None]:
        pytest.skip(
            f"needs {', '.join(missing)}; on Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm gcc"
        )
    exported = export_c(CONTROLLERS[name], tmp_path / "anc.c", dtype="float32")
    stated = re.search(r"^ \*  +(-std=c99 .*)$", exported.header_path.read_text(encoding="utf-8"), re.M)[1]
    path = ", ".join(f"{float(tap)!r}f" for tap in S)
    flags = [*stated.split(), "-O3", f"-DSAMPLES={SAMPLES}", f"-DSECONDARY={path}", f"-I{tmp_path}"]
    sources = [FOLDER / "board.c", exported.path, "-lm", "-o"]
    ran(COMPILER, *BOARD, "-T", FOLDER / "board.ld", *flags, *sources, tmp_path / "board.elf")
    ran("cc", *flags, *sources, tmp_path / "host")
    text, data, bss = map(int, ran(SIZE, tmp_path / "board.elf").splitlines()[1].split()[:3])
    said = ran("sh", "-c", '"$@" 2>&1', "sh", *MACHINE, tmp_path / "board.elf")  # which says it on stderr
    board, host = numbers(said), numbers(ran(tmp_path / "host"))
    assert board["self_test"] == [0]
    assert board["bits"] == host["bits"]
    assert len(set(board["bits"])) == 8  # it played something, and went on playing
    (mean,), (worst,), (stack,) = board["mean"], board["worst"], board["stack"]
    assert 1000 < mean <= worst
    assert 500 < stack < 4096
    counts = text + data, data + bss, stack, mean, worst
    rows[name] = [name, *(f"{n:,}" for n in counts), *(f"{rate * mean / 1e6:.0f}" for rate in RATES_HZ)]


def test_the_page_shows_the_controllers_of_today():
    assert [line.split("  ")[0] for line in stored_table("board.txt")[1:]] == list(CONTROLLERS)
