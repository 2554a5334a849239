"""Runs README's examples as they are pasted into plain `python`, and compares what they print with the comments.

As a program, it needs nothing but the installed package: `python -I tests/helpers/readme.py`.
"""

from __future__ import annotations

import code
import contextlib
import io
import re
from pathlib import Path

README = Path(__file__).resolve().parents[2] / "README.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)


def examples(text: str) -> list[str]:
    """Return the blocks of Python in a page."""
    return BLOCK.findall(text)


def stated(block: str) -> str:
    """Return the output that a block states: its lines that are comments."""
    return "".join(f"{line[2:]}\n" for line in block.splitlines() if line.startswith("# "))


def printed(blocks: list[str]) -> list[str]:
    """Return what each block prints, with its errors, if all of them are pasted into one session line by line."""
    console, found = code.InteractiveConsole(), []
    for block in blocks:
        with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.redirect_stderr(output):
            waiting = False
            for line in block.splitlines():
                waiting = console.push(line)
            if waiting:
                console.resetbuffer()
                print("the last statement waits for an empty line")
        found.append(output.getvalue())
    return found


def differences() -> list[str]:
    """Return what is wrong with README's examples, a text for each block that prints something else."""
    blocks = examples(README.read_text(encoding="utf-8"))
    return [
        f"README's example\n{block}\nprints\n{output}"
        for block, output in zip(blocks, printed(blocks), strict=True)
        if output != stated(block)
    ]


if __name__ == "__main__":
    wrong = differences()
    print(len(examples(README.read_text(encoding="utf-8"))), "examples of README run,", len(wrong), "wrong")
    raise SystemExit("\n".join(wrong) or 0)
