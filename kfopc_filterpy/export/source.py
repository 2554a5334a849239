"""The text of an exported controller: the core's own files, joined, with the controller's plan and state."""

from __future__ import annotations

import re
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from string import Template
from textwrap import fill
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..core.block import _VIEW_PLACES, Block
from ..core.building import FLAGS, FOLDER, stamp
from .joined import joined, sources_of
from .precision import REALS

TEMPLATES = Path(__file__).parent
FLAGS_OF_AN_EXPORT = " ".join(flag for flag in FLAGS if flag not in ("-shared", "-fvisibility=hidden", "-Wno-psabi"))
COMPARED, MORE = 8, 16  # samples of the self-test that are compared; those that it takes beyond the secondary path
APART = 8  # equal elements that end a stretch
_POINTER = 8
WIDTH = 120


@dataclass(frozen=True)
class Exported:
    """The block that an export begins with, the prefix of its names, its header's file name, and its description."""

    block: Block
    multichannel: bool
    name: str
    header: str
    description: str

    @property
    def real(self) -> str:
        """C's name of the precision."""
        return REALS[self.block.algorithm.precision]

    @property
    def n_references(self) -> int:
        """Number of reference microphones: the internal model gives the other references."""
        return self.block.reference.size

    @property
    def n_bytes(self) -> int:
        """Size of the state if a pointer has 8 bytes."""
        return self.block.memory.size + (_VIEW_PLACES + 2) * _POINTER

    def filled(self, template: str, **values: Any) -> str:
        """Return the text of a template; `state` is the address of a state in C, by default that of `state`."""
        s, name, state = self.block.shape, self.name, values.pop("state", "&state")
        sizes = (s.microphones, s.loudspeakers, self.n_references, s.taps, s.path_taps, s.guard_taps)
        arguments = [state] + ["x" if self.multichannel else "x[0]"] * (self.n_references > 0)
        common: dict[str, Any] = {
            **dict(zip("KJILMG", sizes, strict=True)),
            "room": max(self.n_references, 1),  # of an array of references
            "description": self.description,
            "source": f"{Path(self.header).stem}.c",
            "header": self.header,
            "name": name,
            "NAME": name.upper(),
            "real": self.real,
            "n_bytes": f"{self.n_bytes:,}",
            "flags": FLAGS_OF_AN_EXPORT,
            # The calls of a sample, whose signals are in arrays x, y and e.
            "control": f"{name}_control_signal({', '.join([*arguments, 'y'])});"
            if self.multichannel
            else f"y[0] = {name}_control_signal({', '.join(arguments)});",
            "update": f"{name}_update({state}, {'e' if self.multichannel else 'e[0]'})",
        }
        return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(common | values)

    def texts(self) -> dict[str, str]:
        """Return the source and its header, by the names of the files."""
        algorithm = self.block.algorithm.name
        own: dict[str, Any] = self._constants() | {
            "core": joined(sources_of(f"anc_{algorithm} anc_open")),
            "stamp": stamp(),
            "defined": "#define ANC_FLOAT\n" if self.real == "float" else "",
            "algorithm": algorithm,
            "stretches": self._stretches(),
            "n_samples": self._n_samples(),
            "n_compared": COMPARED,
            "expected": "".join(f"    {self._reals(row, '    ')},\n" for row in self._expected()),
            "calls": self._calls(),
        }
        mark = f"0x{crc32(repr(own).encode()):08x}u"
        header = self.filled("template.h", **self._header())
        return {self.header: header, f"{Path(self.header).stem}.c": self.filled("template.c", mark=mark, **own)}

    def examples(self) -> dict[str, str]:
        """Return an example of a program and a page about the export, by the names of the files."""
        page = self.filled("example.md", dtype=self.block.algorithm.precision)
        return {"main.c": self.filled("example.c"), "README.md": page}

    def _header(self) -> dict[str, Any]:
        arrays, name, x = self.multichannel, self.name, "x, " if self.n_references else ""
        s = "s" if arrays else ""
        control, update = self._signatures()
        return {
            "statement": f"{name}_control_signal(&state, {x}y);"
            if arrays
            else f"y = {name}_control_signal(&state{x and ', x'});",
            "s": s,
            "x_from": f"x(n) from the reference microphone{s}, " if x else "",
            "for_x": " for the newest reference sample x(n)" if x else "",
            "returns": "Set `control` to" if arrays else "Return",
            "declared_control": control,
            "declared_update": update,
            "n_reals": self.block.memory.size // self.block.algorithm.precision.itemsize,
            "n_places": _VIEW_PLACES,
            "answers": "".join(f"#define {name.upper()}_{answer} {n}\n" for n, answer in enumerate(_answers())),
        }

    def _constants(self) -> dict[str, Any]:
        """Return the arrays of the plan, and what the plan says of them."""
        fields, shape, algorithm = self.block.fields, self.block.shape, self.block.algorithm
        arrays = {"path": fields["secondary_path"], "guard": fields["guard"]}
        settings = [*(fields[name].ravel() for name, _ in algorithm.settings), np.zeros(1, algorithm.precision)]
        arrays["settings"] = np.concatenate(settings)
        text = [
            f"static const real {name}[] = {self._reals(array.ravel())};\n"
            for name, array in arrays.items()
            if array.size
        ]
        windows = ""
        for name in ("power_windows", "limiter_windows"):
            if lengths := getattr(shape, name):
                text.append(f"static const int32_t {name}[] = {braces(map(str, lengths))};\n")
                windows += f".{name} = {name}, "
        return {
            "constants": "".join(text),
            "windows": windows,
            "all": shape.references,
            "modelled": shape.modelled,
            "guard": ".guard = guard, " if fields["guard"].size else "",
        }

    def _stretches(self) -> str:
        """Return what differs from a fresh block as C's list of stretches."""
        block = self.block
        fresh = block.fresh(block.shape, block.fields["guard"].ravel() if block.fields["guard"].size else None)
        text = []
        for name in (*block.states, "amplifier"):
            values = block.fields[name]
            differing = np.flatnonzero(_bits(values) != _bits(fresh.fields[name]))
            for part in np.split(differing, np.flatnonzero(np.diff(differing) > APART) + 1) if differing.size else []:
                first, last = int(part[0]), int(part[-1])
                kind = "int32_t" if values.dtype == np.int32 else "real"
                numbers = self._reals(values.ravel()[first : last + 1], "    ")
                text.append(f'    {{"{name}", {first}, {last + 1 - first}, (const {kind}[]){numbers}}},\n')
        return "".join(text)

    def _n_samples(self) -> int:
        return self.block.shape.path_taps + MORE

    def _expected(self) -> NDArray[Any]:
        """Return the last outputs of the self-test."""
        block = deepcopy(self.block)
        outputs = np.empty((self._n_samples(), block.shape.loudspeakers), block.algorithm.precision)
        for n, row in enumerate(outputs):
            block.reference[:] = [((7 * n + 3 * i) % 17 - 8) / 8 for i in range(self.n_references)]
            block.error[:] = [((5 * n + 2 * k) % 13 - 6) / 8 for k in range(block.shape.microphones)]
            block.emit()
            row[:] = block.control_signal
            block.update()
        return outputs[-COMPARED:]

    def _reals(self, values: NDArray[Any], indent: str = "") -> str:
        """Return an array as C writes it; NaN and infinity stand for settings that were not given."""
        special = {"nan": "NAN", "inf": "INFINITY", "-inf": "-INFINITY"}
        suffix = "f" if values.dtype == np.float32 else ""
        return braces((special.get(text) or text + suffix for text in map(str, values)), indent)

    def _signatures(self) -> tuple[str, str]:
        name, real, N = self.name, self.real, self.name.upper()
        state, heard = f"{name}_state *state", self.n_references > 0
        if self.multichannel:
            reference = f"const {real} reference[{N}_REFERENCES], " if heard else ""
            control = f"void {name}_control_signal({state}, {reference}{real} control[{N}_LOUDSPEAKERS])"
            error = f"const {real} error[{N}_MICROPHONES]"
        else:
            control = f"{real} {name}_control_signal({state}{f', {real} reference' if heard else ''})"
            error = f"{real} error"
        return control, f"int {name}_update({state}, {error})"

    def _calls(self) -> str:
        reference = ("" if self.multichannel else "&") + "reference" if self.n_references else "NULL"
        if self.multichannel:
            bodies = f"    take(state, {reference}, control);\n", "    return adapt(state, error);\n"
        else:
            bodies = (
                f"    real y;\n    take(state, {reference}, &y);\n    return y;\n",
                "    return adapt(state, &error);\n",
            )
        return "\n".join(f"{head}\n{{\n{body}}}\n" for head, body in zip(self._signatures(), bodies, strict=True))


def _answers() -> list[str]:
    """Return what an update returns, from 0 on: what anc.h lists, and the export's own."""
    listed = re.search(r"enum \{([^}]*)\} anc_answer", (FOLDER / "anc.h").read_text(encoding="utf-8"))
    assert listed
    return ["ADAPTED", *(name.strip().removeprefix("ANC_") for name in listed[1].split(",")[1:]), "NO_STATE"]


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values).ravel().view(f"i{values.itemsize}")


def braces(numbers: Iterable[str], indent: str = "") -> str:
    """Return an array of numbers in braces, in several lines if it is long."""
    text = ", ".join(numbers)
    if len(text) < WIDTH // 2:
        return f"{{{text}}}"
    inner = indent + "    "
    wrapped = fill(text, WIDTH, initial_indent=inner, subsequent_indent=inner, break_on_hyphens=False)
    return f"{{\n{wrapped}\n{indent}}}"
