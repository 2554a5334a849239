"""A controller of the core as C99: the core's own files, joined, with the controller's plan and state."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..controllers.base import calls_of
from ..controllers.core_controller import CoreController
from ..core.block import _VIEW_PLACES, Block
from ..core.building import FLAGS, FOLDER, core_sources, stamp
from ..power.limiter import NUMBERS
from .literals import braces, number
from .parts import EXPORTED, named
from .precision import in_precision

FRAGMENTS = Path(__file__).parent / "fragments"
SHARED = ("signals.c", "limiter.c", "constraint.c", "amplifier.c", "controller.c")
NOT_OF_AN_EXPORT = ("-shared", "-fvisibility=hidden", "-Wno-psabi")
COMPARED, MORE = 8, 16  # samples of the self-test that are compared; those that it takes beyond the secondary path
APART = 8  # equal elements that end a stretch
LINE_SLACK = 64  # of signals.c: a delay line of n samples has room for 4 n + 64
_POINTER = 8


@dataclass(frozen=True)
class CoreExport:
    """A controller's block, and the source of its algorithm."""

    block: Block
    source: Path
    multichannel: bool

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of microphones, loudspeakers, references, taps, path taps and guard taps by their letters."""
        s = self.block.shape
        return dict(
            zip("KJILMG", (s.microphones, s.loudspeakers, s.references, s.taps, s.path_taps, s.guard_taps), strict=True)
        )

    def n_reals(self, precision: np.dtype) -> int:
        """Return the size of the block in this precision; each field begins at a multiple of 64 bytes."""
        return (
            sum(-(-_n_bytes(field, precision) // 64) * 64 for field in self.block.fields.values()) // precision.itemsize
        )

    def n_bytes(self, precision: np.dtype) -> int:
        """Return the size of the state where a pointer has 8 bytes."""
        return self.n_reals(precision) * precision.itemsize + (_VIEW_PLACES + 2) * _POINTER

    def written(self, name: str, header: str, description: str, precision: np.dtype) -> tuple[str, str]:
        """Return the header and the source file."""
        tolerance = 0.0 if precision == np.float64 else 0.1 if self.block.shape.limiter_windows else 1e-3
        expected, scale = self._expected()
        real = "double" if precision == np.float64 else "float"
        common: dict[str, Any] = self.sizes | {
            "description": description,
            "header": header,
            "name": name,
            "NAME": name.upper(),
            "real": real,
        }
        return (
            _filled("core_header.h", common, **self._header(name, real, precision, tolerance)),
            _filled(
                "core_source.c",
                common,
                **self._constants(precision),
                core=joined([*SHARED[:-1], self.source.name, SHARED[-1]]),
                stamp=stamp(),
                defined="" if precision == np.float64 else "#define ANC_FLOAT\n",
                algorithm=self.block.algorithm.name,
                stretches=self._stretches(precision),
                n_samples=self._n_samples(),
                n_compared=COMPARED,
                expected="".join(f"    {_reals(row, 'self-test', precision, '    ')},\n" for row in expected),
                tolerance=number(tolerance * scale, "tolerance", precision),
                calls=_calls(name, real, self.multichannel),
            ),
        )

    def _header(self, name: str, real: str, precision: np.dtype, tolerance: float) -> dict[str, Any]:
        arrays = self.multichannel
        control, update = _signatures(name, real, arrays)
        return {
            "control": f"{name}_control_signal(&state, x, y);" if arrays else f"y = {name}_control_signal(&state, x);",
            "s": "s" if arrays else "",
            "returns": "Set `control` to" if arrays else "Return",
            "declared_control": control,
            "declared_update": update,
            "n_bytes": f"{self.n_bytes(precision):,}",
            "n_reals": self.n_reals(precision),
            "n_places": _VIEW_PLACES,
            "flags": " ".join(flag for flag in FLAGS if flag not in NOT_OF_AN_EXPORT),
            "if_compiled": "" if precision == np.float64 else " for float, on every machine",
            "tolerated": ": bit for bit"
            if not tolerance
            else f" in double: {tolerance:g} of the largest output is tolerated",
        }

    def _constants(self, precision: np.dtype) -> dict[str, Any]:
        """Return the arrays of the plan, and what the plan says of them."""
        fields, shape, algorithm = self.block.fields, self.block.shape, self.block.algorithm
        arrays = {"path": fields["secondary_path"], "guard": fields["guard"]}
        arrays["settings"] = np.concatenate([*(fields[name].ravel() for name, _ in algorithm.settings), np.zeros(1)])
        text = [
            f"static const real {name}[] = {_reals(array.ravel(), name, precision)};\n"
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

    def _stretches(self, precision: np.dtype) -> str:
        """Return what differs from a fresh block as C's list of stretches."""
        fields = self.block.fields
        own = {name: fields[name].ravel() for name, _ in self.block.algorithm.settings}
        settings: dict[str, Any] = {
            name: own[name] if each else own[name][0] for name, each in self.block.algorithm.settings
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
            in_precision(limiter.view(NUMBERS), precision)
        text = []
        for name, values in state.items():
            differing = np.flatnonzero(_bits(values) != _bits(fresh.fields[name]))
            for part in np.split(differing, np.flatnonzero(np.diff(differing) > APART) + 1) if differing.size else []:
                first, last = int(part[0]), int(part[-1])
                kind = "real" if values.dtype == np.float64 else "int32_t"
                numbers = _reals(values.ravel()[first : last + 1], name, precision, "    ")
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


def core_export(controller: CoreController) -> CoreExport:
    """Return what is exported of a controller of the core, or raise an error that says why it cannot be.

    Raises
    ------
    TypeError
        A subclass with calls of its own, or an algorithm whose source is not in the core.
    """
    if calls_of(type(controller)) != calls_of(CoreController):
        raise TypeError(f"{named(controller)} has calls of its own and cannot be exported: {EXPORTED}")
    block = controller._opened()
    defined = re.compile(rf"^const anc_algorithm anc_{block.algorithm.name} =", re.M)
    sources = [path for path in core_sources() if defined.search(path.read_text(encoding="utf-8"))]
    if block.algorithm.path is not None or not sources:
        raise TypeError(f"{named(controller)} has an algorithm of its own and cannot be exported: {EXPORTED}")
    return CoreExport(block, sources[0], controller.multichannel)


def joined(names: list[str]) -> str:
    """Return files of the core as one, in which everything is static."""
    seen: set[str] = set()

    def text_of(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        text = (FOLDER / name).read_text(encoding="utf-8")
        if name.endswith(".h"):
            text = re.sub(r"^extern ANC_PUBLIC const anc_algorithm [^;]*;\n", "", text, flags=re.M)
            text = re.sub(r"^(?=(?:void|int|real|int32_t) [^;{}]*\([^;{}]*\);)", "static ", text, flags=re.M)
        text = re.sub(r"^const anc_algorithm ", "static const anc_algorithm ", text, flags=re.M)
        text = re.sub(r'^#include "(.*)"\n', lambda found: text_of(found[1]), text, flags=re.M)
        return f"\n/* ---- {name} ---- */\n\n{text}"

    return "".join(map(text_of, names))


def _tidy_lines(state: dict[str, NDArray[Any]]) -> None:
    """Move the newest samples of each delay line to its end, and clear the others, which no step reads."""
    for name in [name.removesuffix("_at") for name in state if name.endswith("_at")]:
        line, at = state[name], state[f"{name}_at"]
        taps = (line.shape[-1] - LINE_SLACK) // 4
        newest = line[..., int(at.item()) :][..., :taps].copy()
        line[...] = 0.0
        line[..., -taps:] = newest
        at[...] = line.shape[-1] - taps


def _n_bytes(field: NDArray[Any], precision: np.dtype) -> int:
    return field.size * (4 if field.dtype == np.int32 else precision.itemsize)


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values).ravel().view(np.int64 if values.dtype == np.float64 else np.int32)


def _reals(values: NDArray[Any], name: str, precision: np.dtype, indent: str = "") -> str:
    """Return an array as C writes it; NaN and infinity stand for settings that were not given."""
    special = {math.inf: "INFINITY", -math.inf: "-INFINITY"}
    return braces(
        (
            "NAN" if math.isnan(value) else special.get(value) or number(value, name, precision)
            for value in values.tolist()
        ),
        indent,
    )


def _signatures(name: str, real: str, arrays: bool) -> tuple[str, str]:
    if not arrays:
        control, update = f"{real} {name}_control_signal({name}_state *state, {real} reference)", f"{real} error"
    else:
        N = name.upper()
        pointers = f"const {real} reference[{N}_REFERENCES], {real} control[{N}_LOUDSPEAKERS]"
        control = f"void {name}_control_signal({name}_state *state, {pointers})"
        update = f"const {real} error[{N}_MICROPHONES]"
    return control, f"int {name}_update({name}_state *state, {update})"


def _calls(name: str, real: str, arrays: bool) -> str:
    control, update = _signatures(name, real, arrays)
    if arrays:
        bodies = "    take(state, reference, control);\n", "    return adapt(state, error);\n"
    else:
        bodies = "    real y;\n    take(state, &reference, &y);\n    return y;\n", "    return adapt(state, &error);\n"
    return "\n".join(f"{head}\n{{\n{body}}}\n" for head, body in zip((control, update), bodies, strict=True))


def _filled(fragment: str, common: dict[str, Any], **values: Any) -> str:
    return Template((FRAGMENTS / fragment).read_text(encoding="utf-8")).substitute(common, **values)
