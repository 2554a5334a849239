"""The text of an exported controller: the core's own files, joined, with the controller's plan and state."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from string import Template
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.block import _VIEW_PLACES, SLACK, Block
from ..core.building import FLAGS, FOLDER, stamp
from ..power.limiter import NUMBERS, spans_of
from .joined import joined, sources_of

TEMPLATES = Path(__file__).parent
NOT_OF_AN_EXPORT = ("-shared", "-fvisibility=hidden", "-Wno-psabi")
COMPARED, MORE = 8, 16  # samples of the self-test that are compared; those that it takes beyond the secondary path
APART = 8  # equal elements that end a stretch
_POINTER = 8
WIDTH = 120
LARGEST_MARGIN = 0.01  # of the rated power, which the limiter keeps free for rounding
SINGLE_FLOOR = 1e-30  # of the budget, as in limiter.c


@dataclass(frozen=True)
class Exported:
    """A controller's block, in the precision and with the name of its export."""

    block: Block
    multichannel: bool
    name: str
    precision: np.dtype

    @property
    def real(self) -> str:
        """C's name of the precision."""
        return "double" if self.precision == np.float64 else "float"

    @property
    def n_reals(self) -> int:
        """Size of the block; each field begins at a multiple of 64 bytes."""
        size = self.precision.itemsize
        bytes_of = (field.size * (4 if field.dtype == np.int32 else size) for field in self.block.fields.values())
        return sum(-(-n // 64) * 64 for n in bytes_of) // size

    @property
    def n_bytes(self) -> int:
        """Size of the state where a pointer has 8 bytes."""
        return self.n_reals * self.precision.itemsize + (_VIEW_PLACES + 2) * _POINTER

    def texts(self, header: str, description: str) -> tuple[str, str]:
        """Return the header, whose file name is given, and the source."""
        tolerance = 0.0 if self.precision == np.float64 else 0.1 if self.block.shape.limiter_windows else 1e-3
        expected, scale = self._expected()
        s = self.block.shape
        sizes = (s.microphones, s.loudspeakers, s.references, s.taps, s.path_taps, s.guard_taps)
        common: dict[str, Any] = {
            **dict(zip("KJILMG", sizes, strict=True)),
            "description": description,
            "header": header,
            "name": self.name,
            "NAME": self.name.upper(),
            "real": self.real,
        }
        algorithm = self.block.algorithm.name
        source = _filled(
            "template.c",
            common,
            **self._constants(),
            core=joined(sources_of(f"anc_{algorithm} anc_open")),
            stamp=stamp(),
            defined="" if self.precision == np.float64 else "#define ANC_FLOAT\n",
            algorithm=algorithm,
            stretches=self._stretches(),
            n_samples=self._n_samples(),
            n_compared=COMPARED,
            expected="".join(f"    {self._reals(row, 'self-test', '    ')},\n" for row in expected),
            tolerance=number(tolerance * scale, "tolerance", self.precision),
            calls=self._calls(),
        )
        return _filled("template.h", common, **self._header(tolerance)), source

    def _header(self, tolerance: float) -> dict[str, Any]:
        arrays, name = self.multichannel, self.name
        control, update = self._signatures()
        return {
            "control": f"{name}_control_signal(&state, x, y);" if arrays else f"y = {name}_control_signal(&state, x);",
            "s": "s" if arrays else "",
            "returns": "Set `control` to" if arrays else "Return",
            "declared_control": control,
            "declared_update": update,
            "n_bytes": f"{self.n_bytes:,}",
            "n_reals": self.n_reals,
            "n_places": _VIEW_PLACES,
            "answers": "".join(f"#define {name.upper()}_{answer} {n}\n" for n, answer in enumerate(_answers())),
            "flags": " ".join(flag for flag in FLAGS if flag not in NOT_OF_AN_EXPORT),
            "if_compiled": "" if self.precision == np.float64 else " for float, on every machine",
            "tolerated": ": bit for bit"
            if not tolerance
            else f" in double: {tolerance:g} of the largest output is tolerated",
        }

    def _constants(self) -> dict[str, Any]:
        """Return the arrays of the plan, and what the plan says of them."""
        fields, shape, algorithm = self.block.fields, self.block.shape, self.block.algorithm
        arrays = {"path": fields["secondary_path"], "guard": fields["guard"]}
        arrays["settings"] = np.concatenate([*(fields[name].ravel() for name, _ in algorithm.settings), np.zeros(1)])
        text = [
            f"static const real {name}[] = {self._reals(array.ravel(), name)};\n"
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
            "guard": ".guard = guard, " if fields["guard"].size else "",
            "limited": int(bool(shape.limiter_windows)),
        }

    def _stretches(self) -> str:
        """Return what differs from a fresh block as C's list of stretches."""
        fields = self.block.fields
        settings: dict[str, Any] = {
            name: fields[name].ravel()[slice(None) if each else 0] for name, each in self.block.algorithm.settings
        }
        fresh = Block(
            self.block.algorithm,
            self.block.shape,
            path=fields["secondary_path"][0],
            settings=settings,
            guard=fields["guard"].ravel() if fields["guard"].size else None,
        )
        state = {name: fields[name].copy() for name in (*self.block.states, "amplifier")}
        _tidy_lines(state)
        for limiter in state["limiter"].reshape(-1, NUMBERS.itemsize // 8):
            in_precision(limiter.view(NUMBERS), self.precision)
        text = []
        for name, values in state.items():
            differing = np.flatnonzero(_bits(values) != _bits(fresh.fields[name]))
            for part in np.split(differing, np.flatnonzero(np.diff(differing) > APART) + 1) if differing.size else []:
                first, last = int(part[0]), int(part[-1])
                kind = "real" if values.dtype == np.float64 else "int32_t"
                numbers = self._reals(values.ravel()[first : last + 1], name, "    ")
                text.append(f'    {{"{name}", {first}, {last + 1 - first}, (const {kind}[]){numbers}}},\n')
        return "".join(text)

    def _n_samples(self) -> int:
        return self.block.shape.path_taps + MORE

    def _expected(self) -> tuple[NDArray[np.float64], float]:
        """Return the last outputs of the self-test, and the largest size of all of them."""
        block = Block(self.block.algorithm, self.block.shape, memory=self.block.memory)
        outputs = np.empty((self._n_samples(), block.shape.loudspeakers))
        for n, row in enumerate(outputs):
            block.reference[:] = [((7 * n + 3 * i) % 17 - 8) / 8 for i in range(block.shape.references)]
            block.error[:] = [((5 * n + 2 * k) % 13 - 6) / 8 for k in range(block.shape.microphones)]
            block.emit()
            row[:] = block.control_signal
            block.update()
        return outputs[-COMPARED:], float(np.abs(outputs).max())

    def _reals(self, values: NDArray[Any], name: str, indent: str = "") -> str:
        """Return an array as C writes it; NaN and infinity stand for settings that were not given."""
        special = {math.inf: "INFINITY", -math.inf: "-INFINITY"}
        return braces(
            (
                "NAN" if math.isnan(value) else special.get(value) or number(value, name, self.precision)
                for value in values.tolist()
            ),
            indent,
        )

    def _signatures(self) -> tuple[str, str]:
        name, real, N = self.name, self.real, self.name.upper()
        if self.multichannel:
            pointers = f"const {real} reference[{N}_REFERENCES], {real} control[{N}_LOUDSPEAKERS]"
            control = f"void {name}_control_signal({name}_state *state, {pointers})"
            error = f"const {real} error[{N}_MICROPHONES]"
        else:
            control = f"{real} {name}_control_signal({name}_state *state, {real} reference)"
            error = f"{real} error"
        return control, f"int {name}_update({name}_state *state, {error})"

    def _calls(self) -> str:
        if self.multichannel:
            bodies = "    take(state, reference, control);\n", "    return adapt(state, error);\n"
        else:
            bodies = (
                "    real y;\n    take(state, &reference, &y);\n    return y;\n",
                "    return adapt(state, &error);\n",
            )
        return "\n".join(f"{head}\n{{\n{body}}}\n" for head, body in zip(self._signatures(), bodies, strict=True))


def _answers() -> list[str]:
    """Return what an update returns, from 0 on, as anc.h lists it."""
    listed = re.search(r"enum \{([^}]*)\} anc_answer", (FOLDER / "anc.h").read_text(encoding="utf-8"))
    assert listed
    return ["ADAPTED", *(name.strip().removeprefix("ANC_") for name in listed[1].split(",")[1:])]


def _tidy_lines(state: dict[str, NDArray[Any]]) -> None:
    """Move the newest samples of each delay line to its end, and clear the others, which no step reads."""
    for name in [name.removesuffix("_at") for name in state if name.endswith("_at")]:
        line, at = state[name], state[f"{name}_at"]
        taps = (line.shape[-1] - SLACK) // 2
        newest = line[..., int(at.item()) :][..., :taps].copy()
        line[...] = 0.0
        line[..., -taps:] = newest
        at[...] = line.shape[-1] - taps


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values).ravel().view(np.int64 if values.dtype == np.float64 else np.int32)


def _filled(template: str, common: dict[str, Any], **values: Any) -> str:
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(common, **values)


def number(value: float, name: str, precision: np.dtype) -> str:
    """Return a number as C writes it; the precision must be able to hold it."""
    if isinstance(value, int | np.integer):
        return str(value)
    with np.errstate(over="ignore", under="ignore"):
        rounded = precision.type(value)
    if not np.isfinite(rounded):
        raise ValueError(f"{name} must be finite in {precision}, got {value:g}: scale the signals")
    return f"{rounded!s}{'' if precision == np.float64 else 'f'}"


def braces(numbers: Iterable[str], indent: str = "") -> str:
    """Return an array of numbers in braces, in several lines if it is long."""
    text = ", ".join(numbers)
    if len(text) < WIDTH // 2:
        return f"{{{text}}}"
    inner = indent + "    "
    wrapped = fill(text, WIDTH, initial_indent=inner, subsequent_indent=inner, break_on_hyphens=False)
    return f"{{\n{wrapped}\n{indent}}}"


def in_precision(numbers: np.ndarray, precision: np.dtype) -> None:
    """Change a limiter's record of numbers to those of a precision.

    Raises
    ------
    ValueError
        If the margin for rounding would take too much of the rated power.
    """
    if precision == np.float64:
        return
    epsilon, window = float(np.finfo(precision).eps), int(numbers["size"][0])
    margin = (1.0 - float(numbers["budget"][0])) * epsilon / float(np.finfo(np.float64).eps)
    if margin > LARGEST_MARGIN:
        longest = int(window * LARGEST_MARGIN / margin)
        raise ValueError(
            f"the limiter's window of {window} samples is too long for {precision}, whose rounding errors would take "
            f"{100 * margin:.1f} % of the rated power: at most {longest} samples, or dtype='float64'"
        )
    spans = int(numbers["spans"][0])
    numbers["peak"] = (1.0 - 4.0 * epsilon) / numbers["scale"]
    numbers["budget"] = 1.0 - margin
    for values in (numbers["average"], numbers["loud"], spans_of(numbers)[1:, :spans]):  # held and room
        np.maximum(values, SINGLE_FLOOR, out=values)
