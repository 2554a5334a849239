"""A controller as C99: a header and a source file, with the controller's present state.

A controller of the core brings the core's own files, see `core`. The others, until they have moved to the core, are put
together from fragments here. The fragments are C themselves, written for float64 and the prefix `anc`. The lines
between `#if`, `#else` and `#endif` that do not apply are left out, float64 becomes float32 if asked for, and the prefix
becomes the name. Only the beginnings of the two files have places to fill in, with Python's own `string.Template`: a
template language would be a dependency for those few.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..controllers.core_controller import CoreController
from ..filters.random_walk import as_precision
from .core import core_export
from .literals import braces, number
from .parts import Part, Values, parts_of

FRAGMENTS = Path(__file__).parent / "fragments"


@dataclass(frozen=True, repr=False)
class CExport:
    """An exported controller: the files and what they cost.

    Attributes
    ----------
    path, header_path : pathlib.Path
        The source file and its header.
    name : str
        Prefix of the functions and types.
    algorithm : str
        Name of the controller.
    n_taps : int
        Taps L of the control filter.
    dtype : str
        float64 (C's double) or float32 (float).
    n_bytes : int
        Size of the state, ``sizeof(<name>_state)`` with natural alignment, where a pointer has 8 bytes.
    operations, most_operations : int, or None for a controller of the core
        Floating-point additions, multiplications, divisions and square roots of a usual sample, and of the worst one.
        A fused multiply-add counts as two.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from kfopc_filterpy import FxLMS
    >>> from kfopc_filterpy.export import export_c
    >>> controller = FxLMS(16, [0.0, 1.0], step_size=0.01)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = export_c(controller, Path(folder) / "anc.c", dtype="float32")
    >>> exported
    <CExport anc.c: FxLMS, 16 taps, float32, state of 5,072 bytes>
    """

    path: Path
    header_path: Path
    name: str
    algorithm: str
    n_taps: int
    dtype: str
    n_bytes: int
    operations: int | None
    most_operations: int | None

    def __repr__(self) -> str:
        return f"<CExport {self.path.name}: {self.algorithm}, {self.n_taps} taps, {self.dtype}, {self._cost()}>"

    def _cost(self) -> str:
        if self.operations is None:
            return f"state of {self.n_bytes:,} bytes"
        most = "" if self.most_operations == self.operations else f", at most {self.most_operations:,}"
        return f"state of {self.n_bytes:,} bytes, {self.operations:,} operations per sample{most}"


def export_c(controller: Any, path: Any, *, name: str | None = None, dtype: Any = "float64") -> CExport:
    """Write a controller as a C99 source file and its header, to continue from its present state.

    The files need nothing but ``string.h`` and ``math.h``. They allocate nothing: a struct of fixed size holds the state.
    Several controllers, each exported under its own name, link into one program. The calls are

    - ``void anc_init(anc_state *state)``: set the state to the controller's as it was when exported;
    - ``double anc_control_signal(anc_state *state, double reference)``: return y(n);
    - ``int anc_update(anc_state *state, double error)``: adapt to e(n); nonzero if refused, with nothing changed;
    - ``int anc_self_test(anc_state *state)``, of a controller of the core: return 0 if known samples give the known results.

    With several channels, the numbers are arrays, and `anc_control_signal` sets its third argument, y(n).

    The files of a controller of the core contain the core itself: with the flags that the header states, float64 gives
    the bits that Python gives. The others are written for the export, and differ from Python by rounding.

    Parameters
    ----------
    controller : FxLMS and its relatives, DiagonalKalman, FastArrayKalman, or what kf_anc or kf_opc returns
        Of the core any controller: several channels, limiters, amplifier models, an uncertain secondary path,
        sliding windows. Of the others, one of one channel, with a limiter or without. It is not changed.
    path : str or pathlib.Path
        Source file to write, ending in ``.c``; its header, ending in ``.h``, is written beside it. Existing files are
        replaced.
    name : str, optional
        Prefix of all names, `anc` above; by default the name of the file.
    dtype : {"float64", "float32"}, default "float64"
        Precision of the state and the arithmetic.

    Returns
    -------
    CExport
        The files, the size of the state and, but for the core, the operations per sample. The header states
        them too.

    Raises
    ------
    TypeError, ValueError
        A controller that has no C code: another algorithm, a subclass with calls of its own; a Kalman filter of several
        channels, with an amplifier model, a secondary-path uncertainty, power estimates over a sliding window or a
        fading memory. A path that does not end in ``.c``, a name that is no C identifier, a value that the precision
        cannot hold, a limiter's window too long for float32. No file was written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from kfopc_filterpy import kf_opc
    >>> from kfopc_filterpy.export import export_c
    >>> controller = kf_opc(8, [0.0, 1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = export_c(controller, Path(folder) / "left.c")
    ...     header = exported.header_path.read_text(encoding="utf-8")
    >>> "double left_control_signal(left_state *state, double reference);" in header
    True
    """
    path, precision = Path(path), as_precision(dtype)
    if path.suffix != ".c":
        raise ValueError(f"path must end in .c, got {str(path)!r}")
    name = _checked_name(path.stem if name is None else name)
    write = _of_core if isinstance(controller, CoreController) else _of_fragments
    export, header, source = write(controller, path, name, precision)
    export.header_path.write_text(header, encoding="utf-8", newline="\n")
    export.path.write_text(source, encoding="utf-8", newline="\n")
    return export


def _of_core(controller: CoreController, path: Path, name: str, precision: np.dtype) -> tuple[CExport, str, str]:
    """Return the export with the text of its header and of its source."""
    own, export = core_export(controller), _described(controller, path, name, precision)
    header, source = own.written(name, export.header_path.name, _description(controller), precision)
    return replace(export, n_bytes=own.n_bytes(precision)), header, source


def _of_fragments(controller: Any, path: Path, name: str, precision: np.dtype) -> tuple[CExport, str, str]:
    """Return the export with the text of its header and of its source."""
    parts = parts_of(controller, precision)
    operations = sum(part.operations for part in parts)
    export = replace(
        _described(controller, path, name, precision),
        n_bytes=_layout(_state(parts), precision.itemsize)[0],
        operations=operations,
        most_operations=operations + sum(part.rare_operations for part in parts),
    )
    dialect, description = _Dialect(name, precision), _description(controller)
    return export, _header(export, description, parts, dialect), _source(export, description, parts, dialect)


def _described(controller: Any, path: Path, name: str, precision: np.dtype) -> CExport:
    names = controller.name, controller.n_taps, precision.name
    return CExport(path, path.with_suffix(".h"), name, *names, n_bytes=0, operations=None, most_operations=None)


def _description(controller: Any) -> str:
    return repr(controller)[1:-1].replace("*/", "* /")


def _checked_name(name: Any) -> str:
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name must be a C identifier that begins with a letter, such as name='anc', got {name!r}")
    return name


def _state(parts: list[Part]) -> Values:
    """Return the fields of the state: numbers and arrays of reals, structs, integers."""
    fields = {name: value for part in parts for name, value in part.fields.items()}
    order = sorted(fields, key=lambda name: (type(fields[name].value) is int, type(fields[name].value) is dict))
    return {name: fields[name] for name in order}


def _layout(values: Values, real: int) -> tuple[int, int]:
    """Return the size and the alignment in bytes of a struct of these fields, each aligned to its own size."""
    size, alignment = 0, 1
    for value in (entry.value for entry in values.values()):
        if isinstance(value, dict):
            bytes_of, own = _layout(value, real)
        else:
            own = 4 if isinstance(value, int) else real
            bytes_of = own * np.size(value)
        size = -(-size // own) * own + bytes_of
        alignment = max(alignment, own)
    return -(-size // alignment) * alignment, alignment


class _Dialect:
    """The name and the precision that the C code is written in."""

    def __init__(self, name: str, precision: np.dtype) -> None:
        self.name, self.precision = name, precision
        self.suffix = "" if precision == np.float64 else "f"

    def translated(self, code: str) -> str:
        """Return code for float64 and the prefix `anc` in this precision, with this name."""
        if self.suffix:
            code = SINGLE.sub(_in_single_precision, code)
        return re.sub(r"\banc_", f"{self.name}_", re.sub(r"\bANC_", f"{self.name.upper()}_", code))

    def literal(self, value: Any, name: str, indent: str = "") -> str:
        """Return a value as C writes it: a number, an array in braces, or a struct in braces with named fields."""
        if isinstance(value, dict):
            inner = indent + "    "
            lines = [f"{inner}.{key} = {self.literal(one.value, key, inner)},\n" for key, one in value.items()]
            return "{\n" + "".join(lines) + indent + "}"
        if np.ndim(value) == 0:
            return number(value, name, self.precision)
        last = np.max(np.flatnonzero(value), initial=0)  # C sets what follows to zero
        return braces((number(one, name, self.precision) for one in value[: last + 1]), indent)


# Comments stay as they are, so they come first.
SINGLE = re.compile(r"/\*.*?\*/|\bdouble\b|\b(?:sqrt|fabs|copysign|fma)(?=\()|\b\d+\.\d+(?:e-?\d+)?", re.S)


def _in_single_precision(found: re.Match[str]) -> str:
    text = found[0]
    return text if text.startswith("/*") else "float" if text == "double" else f"{text}f"


def _chosen(code: str, flags: set[str]) -> str:
    """Return code with the lines that apply between `#if FLAG`, `#else` and `#endif`."""
    lines, taken = [], [True]
    for line in code.splitlines(keepends=True):
        word, *rest = line.split() or [""]
        if word == "#if":
            taken.append(rest[0] in flags)
        elif word == "#else":
            taken[-1] = not taken[-1]
        elif word == "#endif":
            taken.pop()
        elif all(taken):
            lines.append(line)
    return "".join(lines)


def _fragment(name: str) -> str:
    return (FRAGMENTS / name).read_text(encoding="utf-8")


def _declared(values: Values, indent: str = "    ") -> str:
    """Return the fields of a struct."""
    lines = []
    for name, (value, comment, size) in values.items():
        kind = f"anc_{name}" if isinstance(value, dict) else "int32_t" if isinstance(value, int) else "double"
        note = f" /* {comment} */" if comment else ""
        lines.append(f"{indent}{kind} {name}{f'[{size}]' if size else ''};{note}\n")
    return "".join(lines)


def _header(export: CExport, description: str, parts: list[Part], dialect: _Dialect) -> str:
    state = _state(parts)
    sizes = [
        f"#define ANC_{name} {one.value} /* {one.comment} */\n" for part in parts for name, one in part.sizes.items()
    ]
    structs = [
        f"/* {one.comment[0].upper()}{one.comment[1:]}. */\ntypedef struct {{\n{_declared(one.value)}}} anc_{name};\n\n"
        for name, one in state.items()
        if isinstance(one.value, dict)
    ]
    return Template(dialect.translated(_fragment("header.h"))).substitute(
        description=description,
        cost=export._cost(),
        sizes=dialect.translated("".join(sizes)),
        structs=dialect.translated("".join(structs)),
        fields=dialect.translated(_declared(state)),
    )


def _source(export: CExport, description: str, parts: list[Part], dialect: _Dialect) -> str:
    settings = []
    for name, (value, comment, size) in ((name, one) for part in parts for name, one in part.settings.items()):
        kind = "int32_t" if np.asarray(value).dtype.kind == "i" else "double"
        declared = dialect.translated(f"static const {kind} {name}{f'[{size}]' if size else ''}")
        settings.append(f"{declared} = {dialect.literal(value, name)}; /* {comment} */\n")
    beginning = Template(dialect.translated(_fragment("source.c"))).substitute(
        description=description,
        header=export.header_path.name,
        settings="".join(settings),
        initial=dialect.literal(_state(parts), "state"),
    )
    flags = set().union(*(part.flags for part in parts))
    code = "".join(_chosen(_fragment(f"{name}.c"), flags) for name in [*(part.fragment for part in parts), "calls"])
    return beginning + dialect.translated(code)
