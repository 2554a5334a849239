"""The files of the core that an algorithm needs, as one."""

from __future__ import annotations

import re
from pathlib import Path

from ..core.building import FOLDER, core_sources

DEFINED = re.compile(r"^(static )?(?=\w)[\w *]*?\b(\w+)(?: =|\([^;{]*\)\s*\{)", re.M)  # constants and functions
COMMENT = re.compile(r"/\*.*?\*/", re.S)


def sources_of(code: str) -> list[Path]:
    """Return the files that define what C code names, what these files name, and so on, as a linker finds them."""
    codes = {path: COMMENT.sub("", path.read_text(encoding="utf-8")) for path in core_sources()}
    defined = {path: DEFINED.findall(text) for path, text in codes.items()}
    public = {name: path for path, names in defined.items() for static, name in names if not static}
    needed: list[Path] = []
    waiting = [set(re.findall(r"\w+", code))]
    while waiting:
        for path in {public[name] for name in waiting.pop() & public.keys()}.difference(needed):
            needed.append(path)
            waiting.append(set(re.findall(r"\w+", codes[path])) - {name for _, name in defined[path]})
    return sorted(needed)


def joined(paths: list[Path]) -> str:
    """Return files of the core as one, in which everything is static."""
    seen: set[Path] = set()

    def text_of(path: Path) -> str:
        if path in seen:
            return ""
        seen.add(path)
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".h":
            text = re.sub(r"^extern ANC_PUBLIC const anc_algorithm [^;]*;\n", "", text, flags=re.M)
            text = re.sub(r"^extern ANC_PUBLIC (?=const anc_real )", "static ", text, flags=re.M)
            text = re.sub(r"^(?=(?:void|int|real|int32_t) [^;{}]*\([^;{}]*\);)", "static ", text, flags=re.M)
        text = re.sub(r"^(?=const anc_(?:algorithm|real) )", "static ", text, flags=re.M)
        text = re.sub(r'^#include "(.*)"\n', lambda found: text_of(FOLDER / found[1]), text, flags=re.M)
        return f"\n/* ---- {path.name} ---- */\n\n{text}"

    return "".join(map(text_of, paths))
