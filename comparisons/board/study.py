"""`python -m comparisons board`: exported controllers on an emulated Cortex-M4, and what they would need of a real one.

Each controller is exported in float32, compiled for the board and for this machine, and run on both in the same loop. Both
must give the same bits. The emulator counts instructions, not cycles; no real board is used.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kfopc_filterpy import DiagonalKalman, FxLMS, OutputLimiter, kf_opc, kf_pb
from kfopc_filterpy.export import export_c

FOLDER = Path(__file__).resolve().parent
COMPILER, EMULATOR, SIZES = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
BOARD = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-nostartfiles", "--specs=nosys.specs")
MACHINE = (EMULATOR, "-M", "mps2-an386", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel")
SAMPLES = 16_000
SAMPLE_RATES = (8000.0, 16000.0)
SECONDARY = np.r_[0.0, 0.8, 0.3, np.zeros(29)]


@dataclass(frozen=True)
class BoardRun:
    """What a controller did on the board.

    Attributes
    ----------
    bits, host_bits : list of int
        Hashes of the control signals so far, on the board and on this machine.
    self_test : int
        What the self-test returned on the board; 0 if it passed.
    code, data, stack : int
        Bytes of flash memory, of static data (the state, most of all) and of stack.
    mean, worst : int
        Instructions a sample: mean of the second half, and the most that a sample took.
    """

    bits: list[int]
    host_bits: list[int]
    self_test: int
    code: int
    data: int
    stack: int
    mean: int
    worst: int


def missing_tools() -> list[str]:
    """Return which programs this machine lacks."""
    return [name for name in (COMPILER, EMULATOR, SIZES, "cc") if shutil.which(name) is None]


def controllers() -> dict[str, Any]:
    """Return the controllers of the table."""
    noises: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3}
    return {
        "FxLMS, 256 taps": FxLMS(256, SECONDARY, step_size=1e-4),
        "diagonal Kalman, 256 taps": DiagonalKalman(256, SECONDARY, rated_power=0.5, **noises),
        "KF-OPC, 64 taps": kf_opc(64, SECONDARY, rated_power=0.5, **noises),
        "KF-OPC, 64 taps, limiter": kf_opc(64, SECONDARY, rated_power=0.5, limiter=OutputLimiter(0.5), **noises),
        "KF-PB, 64 taps": kf_pb(64, SECONDARY, rated_power=0.5),
    }


def run_on_board(controller: Any, samples: int = SAMPLES) -> BoardRun:
    """Export a controller of one channel in float32, and run it on the emulated board and on this machine."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        exported = export_c(controller, folder / "anc.c", dtype="float32")
        stated = re.search(r"^ \*  +(-std=c99 .*)$", exported.header_path.read_text(encoding="utf-8"), re.M)
        assert stated is not None
        path = ", ".join(f"{float(tap)!r}f" for tap in SECONDARY)
        flags = [*stated[1].split(), "-O3", f"-DSAMPLES={samples}", f"-DSECONDARY={path}", f"-I{folder}"]
        sources = [FOLDER / "main.c", exported.path, "-lm", "-o"]
        _run(COMPILER, *BOARD, "-T", FOLDER / "board.ld", *flags, *sources, folder / "board.elf")
        _run("cc", *flags, *sources, folder / "host")
        text, data, bss = map(int, _run(SIZES, folder / "board.elf").splitlines()[1].split()[:3])
        board, host = _numbers(_run(*MACHINE, folder / "board.elf")), _numbers(_run(folder / "host"))
    one = {name: values[0] for name, values in board.items()}
    return BoardRun(
        bits=board["bits"],
        host_bits=host["bits"],
        self_test=one["self_test"],
        code=text + data,
        data=data + bss,
        stack=one["stack"],
        mean=one["mean"],
        worst=one["worst"],
    )


def _run(*command: Any) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise RuntimeError(f"{Path(str(command[0])).name} failed: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout + done.stderr  # the emulator prints what the board says on stderr


def _numbers(said: str) -> dict[str, list[int]]:
    """Return the numbers of each name, in order."""
    found: dict[str, list[int]] = {}
    for name, digits in re.findall(r"^(\w+) ([0-9a-f]+)$", said, re.M):
        found.setdefault(name, []).append(int(digits, 16))
    return found


def table(runs: dict[str, BoardRun]) -> str:
    """Return the runs for the terminal."""
    rates = "".join(f"{f'at {rate / 1000:.0f} kHz':>11}" for rate in SAMPLE_RATES)
    lines = [f"{'':27}{'flash':>8}{'data':>9}{'stack':>7}{'mean':>9}{'worst':>12}{rates}   same bits"]
    for name, run in runs.items():
        millions = "".join(f"{rate * run.mean / 1e6:11.0f}" for rate in SAMPLE_RATES)
        same = "yes" if run.bits == run.host_bits and not run.self_test else "NO"
        lines.append(
            f"{name:27}{run.code:8,}{run.data:9,}{run.stack:7,}{run.mean:9,}{run.worst:12,}{millions}   {same}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Run the controllers of the table on the emulated board and print it; return 1 if bits differ."""
    if arguments:
        raise SystemExit("python -m comparisons board takes no options")
    if missing := missing_tools():
        raise SystemExit(f"board needs {', '.join(missing)}; on Debian: apt-get install {PACKAGES} gcc")
    runs = {name: run_on_board(controller) for name, controller in controllers().items()}
    print(
        f"Cortex-M4 in single precision, {SAMPLES:,} samples: bytes, instructions a sample, millions of them a second"
    )
    print(table(runs))
    return int(any(run.bits != run.host_bits or run.self_test for run in runs.values()))
