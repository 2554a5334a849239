"""A controller as C99: a header and a source file, with the controller's present state."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike

from .._writing import made_folder, replacing_files
from ..controllers.base import calls_of
from ..controllers.core_controller import CoreController
from ..core.block import Block
from .precision import REALS, in_precision
from .source import Exported

if TYPE_CHECKING:
    from ..controllers.limited import LimitedController

EXPORTED = (
    "export_c takes the controllers whose algorithm is in the package's core. It takes no wrapper (export the inner "
    "controller) and no subclass with calls of its own"
)


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
        Size of the state, ``sizeof(<name>_state)`` with natural alignment, if a pointer has 8 bytes.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from kfopc_filterpy import fx_lms
    >>> from kfopc_filterpy.export import export_c
    >>> controller = fx_lms(16, [0.0, 1.0], step_size=0.01)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = export_c(controller, Path(folder) / "anc.c", dtype="float32")
    >>> exported
    <CExport anc.c: FxLMS, 16 taps, float32, state of 4,176 bytes>
    """

    path: Path
    header_path: Path
    name: str
    algorithm: str
    n_taps: int
    dtype: str
    n_bytes: int

    def __repr__(self) -> str:
        return (
            f"<CExport {self.path.name}: {self.algorithm}, {self.n_taps} taps, {self.dtype}, "
            f"state of {self.n_bytes:,} bytes>"
        )


def export_c(
    controller: CoreController | LimitedController,
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    dtype: DTypeLike = "float64",
) -> CExport:
    """Write a controller as a C99 source file and its header, to continue from its present state.

    In a folder, an example ``main.c`` and a ``README.md`` with the calls stand beside them.

    The files need only ``string.h`` and ``math.h``. They allocate nothing: a struct of fixed size holds the state.
    Several controllers, each exported under its own name, link into one program. The calls are

    - ``void anc_init(anc_state *state)``: set the state to the controller's as it was when exported;
    - ``double anc_control_signal(anc_state *state, double reference)``: return y(n);
    - ``int anc_update(anc_state *state, double error)``: adapt to e(n); nonzero if refused, with the weights unchanged;
    - ``int anc_self_test(anc_state *state)``: return 0 if known samples give the known results.

    With several channels, the numbers are arrays, and `anc_control_signal` sets its third argument, y(n).

    The source contains the files of the package's own core: with the flags that the header states, it gives the bits of
    Python, in float32 those of `Float32Controller`.

    Parameters
    ----------
    controller : CoreController
        One whose algorithm is in the core, such as the FxLMS family, `diagonal_kf`, or what
        `kf_anc`, `kf_opc`, `kf_pb` and `fx_rls` return, with whatever it has: several channels,
        limiters, amplifier models, an uncertain secondary path, sliding windows. It is not changed.
    path : str or pathlib.Path
        Source file to write, ending in ``.c``; its header, ending in ``.h``, is written beside it. Or a folder, which
        is made if its name has no dot. Existing files are replaced.
    name : str, optional
        Prefix of all names, `anc` above; by default the name of the file. In a folder it names the files too, and
        `anc` is the default.
    dtype : {"float64", "float32"}, default "float64"
        Precision of the state and the arithmetic.

    Returns
    -------
    CExport
        The files and the size of the state. The header states it too.

    Raises
    ------
    TypeError
        A controller whose algorithm is not in the core, or a subclass with calls of its own. No file was written.
    ValueError
        A path with another ending, a name that is no C identifier, or `main` in a folder, a value that the
        precision cannot hold, a limiter's window too long for float32. No file was written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from kfopc_filterpy import kf_opc
    >>> from kfopc_filterpy.export import export_c
    >>> controller = kf_opc(8, [0.0, 1.0], rated_power=0.5, fs=16000, state_noise=1e-6, measurement_noise=0.1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = export_c(controller, Path(folder) / "left.c")
    ...     header = exported.header_path.read_text(encoding="utf-8")
    >>> "double left_control_signal(left_state *state, double reference);" in header
    True
    """
    path = Path(path)
    in_folder = path.is_dir() or not path.suffix
    if not in_folder and path.suffix != ".c":
        raise ValueError(f"path must end in .c, or be a folder; one with a dot must exist, got {str(path)!r}")
    name = checked_name(("anc" if in_folder else path.stem) if name is None else name)
    if in_folder and name == "main":
        raise ValueError("name must not be 'main', whose main.c is the example")
    path = path / f"{name}.c" if in_folder else path
    header = path.with_suffix(".h")
    exported = exported_as(controller, name, header.name, dtype)
    texts = exported.texts()
    if in_folder:
        texts |= exported.examples()
        made_folder(path.parent)
    with replacing_files(path.parent) as folder:
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8", newline="\n")
    precision = exported.block.algorithm.precision
    return CExport(path, header, name, controller.name, controller.n_taps, precision.name, exported.n_bytes)


def exported_as(controller: Any, name: str, header: str, dtype: DTypeLike) -> Exported:
    """Return what the files of an export are made of, or raise the errors of `export_c`."""
    block, precision = exportable(controller), _precision(dtype)
    description = repr(controller)[1:-1].replace("*/", "* /")
    return Exported(in_precision(block, precision), controller.multichannel, name, header, description)


def exportable(controller: Any) -> Block:
    """Return a controller's block, or raise a TypeError that says why it cannot be exported."""
    kind = type(controller)
    if not isinstance(controller, CoreController):
        obstacle = "is not in the core"
    elif calls_of(kind) != calls_of(CoreController):
        obstacle = "has calls of its own"
    else:
        return controller._block
    named = f"{getattr(controller, 'name', kind.__name__)} ({kind.__name__})"
    raise TypeError(f"{named} {obstacle} and cannot be exported: {EXPORTED}")


def _precision(dtype: Any) -> np.dtype:
    try:
        precision = np.dtype(dtype)
    except TypeError as error:
        raise TypeError(f"dtype must be 'float64' or 'float32', got {dtype!r}") from error
    if precision not in REALS:
        raise ValueError(f"dtype must be 'float64' or 'float32', got {precision}")
    return precision


def checked_name(name: Any) -> str:
    """Return a name that can begin the names of an export in C, or raise ValueError."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name must be a C identifier that begins with a letter, such as name='anc', got {name!r}")
    return name
