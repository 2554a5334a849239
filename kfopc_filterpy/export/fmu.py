"""A controller as an FMU: a unit of FMI 3.0 for co-simulation, with its C source and binaries of it."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import tempfile
import zipfile
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from numpy.typing import DTypeLike

from .._validate import as_positive, how_to_install
from .._writing import replacing
from ..core.building import build
from .c99 import checked_name, exported_as
from .source import Exported

if TYPE_CHECKING:
    from ..controllers.core_controller import CoreController

TARGETS = {  # by the folder of a binary: the machine in zig's words, with the oldest C library, and the file's suffix
    "x86_64-linux": ("x86_64-linux-gnu.2.17", ".so"),
    "x86_64-windows": ("x86_64-windows-gnu", ".dll"),
}
NUMBERS = {"double": "Float64", "float": "Float32"}  # FMI's names
HEADERS = ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h")
DECLARED = re.compile(r"typedef\s+fmi3(\w+)\s+(fmi3\w+)TYPE\s*\(([^;]*)\);")
DEFINED = re.compile(r"^(?! )[\w* ]*\b(fmi3\w+)\(", re.M)
OLDEST = (1980, 1, 1, 0, 0, 0)  # time of all files in the archive, so that the same unit has the same bytes


def export_fmu(
    controller: CoreController, path: str | os.PathLike[str], *, fs: float, dtype: DTypeLike = "float64"
) -> Path:
    """Write a controller as an FMU, a unit of FMI 3.0 for co-simulation, to continue from its present state.

    The unit has the files of `export_c` and binaries of them for Linux and Windows on x86-64, so its outputs are those
    of Python to the bit. A step is a sample, 1/fs. It takes the inputs ``error``, which the last control signal left,
    and ``reference``, and sets the output ``control_signal``; ``answer`` is what the update returned, 0 if it adapted.
    With several channels, their names are ``reference[1]`` and so on. No output depends on an input of the same moment,
    so a plant closes no algebraic loop with it. Its state can be saved, restored and serialized.

    Parameters
    ----------
    controller : CoreController
        One that `export_c` takes. It is not changed.
    path : str or pathlib.Path
        File to write, ending in ``.fmu``; an existing one is replaced. Its name is that of the model.
    fs : float
        Sample rate in Hz.
    dtype : {"float64", "float32"}, default "float64"
        Precision of the variables and the arithmetic.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    TypeError, ValueError
        As `export_c`, or a sample rate that a part of the controller is not made for. No file was written.
    ModuleNotFoundError
        FMPy, from which the headers of the standard are taken, is not installed: it is part of the extra `fmu`.
    RuntimeError
        zig, which compiles for both systems and is part of the extra too, is not installed.

    Examples
    --------
    >>> from kfopc_filterpy import fx_lms
    >>> from kfopc_filterpy.export import export_fmu
    >>> controller = fx_lms(16, [0.0, 1.0], step_size=0.01)
    >>> export_fmu(controller, "anc.zip", fs=16000)
    Traceback (most recent call last):
        ...
    ValueError: path must end in .fmu, got 'anc.zip'
    """
    path, fs = Path(path), as_positive(fs, "fs", unit="Hz")
    if path.suffix != ".fmu":
        raise ValueError(f"path must end in .fmu, got {str(path)!r}")
    name = checked_name(path.stem)
    exported = exported_as(controller, name, f"{name}.h", dtype)
    controller.require_sample_rate(fs)
    sources, headers = exported.texts(), _headers()
    token = hashlib.sha256("".join((*sources.values(), repr(fs))).encode()).hexdigest()[:32]
    sources |= {"fmi3.c": _glue(exported, fs, token, headers["fmi3FunctionTypes.h"])} | headers
    files: dict[str, str | bytes] = {f"sources/{file}": text for file, text in sources.items()}
    files["sources/buildDescription.xml"] = exported.filled("build_description.xml")
    files["modelDescription.xml"] = _model_description(exported, fs, token)
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            Path(folder, file).write_text(text, encoding="utf-8")
        for place, (target, suffix) in TARGETS.items():
            binary = Path(folder, f"{name}{suffix}")
            build([Path(folder, file) for file in sources if file.endswith(".c")], binary, target=target)
            files[f"binaries/{place}/{binary.name}"] = binary.read_bytes()
    with replacing(path) as whole, zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(file, OLDEST), content, zipfile.ZIP_DEFLATED)
    return path


def _headers() -> dict[str, str]:
    """Return the standard's headers, which are FMPy's."""
    found = importlib.util.find_spec("fmpy")
    if found is None or found.origin is None:
        raise ModuleNotFoundError(f"an FMU needs the headers of FMI, which come with FMPy: {how_to_install('fmu')}")
    return {name: Path(found.origin).with_name("c-code").joinpath(name).read_text(encoding="utf-8") for name in HEADERS}


def _glue(exported: Exported, fs: float, token: str, declarations: str) -> str:
    """Return the functions of the unit; those of the standard that it has no use for refuse."""
    values = {"state": "&now->controller", "period": repr(1.0 / fs), "token": token, "number": NUMBERS[exported.real]}
    text = exported.filled("fmi3.c", **values)
    own = set(DEFINED.findall(text))
    refusals = [
        f"fmi3{returns} {name}({' '.join(arguments.split())})\n{{\n    "
        + ("return NULL;" if returns == "Instance" else f'return refused(instance, "{name} is not supported");')
        + "\n}\n"
        for returns, name, arguments in DECLARED.findall(declarations)
        if name not in own
    ]
    return text + "\n".join(refusals)


def _model_description(exported: Exported, fs: float, token: str) -> str:
    version = import_module(str(__package__).partition(".")[0]).__version__
    number, shape = NUMBERS[exported.real], exported.block.shape
    time = f'<{number} name="time" valueReference="0" causality="independent" variability="continuous"/>'
    signals = {"reference": exported.n_references, "error": shape.microphones, "control_signal": shape.loudspeakers}
    names = [f"{what}[{i + 1}]" if exported.multichannel else what for what, n in signals.items() for i in range(n)]
    inputs = [(vr, one) for vr, one in enumerate(names, 1) if not one.startswith("control")]
    outputs = [(vr, one, number) for vr, one in enumerate(names, 1) if one.startswith("control")]
    outputs.append((len(names) + 1, "answer", "Int32"))
    variables = [
        time,
        *(f'<{number} name="{one}" valueReference="{vr}" causality="input" start="0"/>' for vr, one in inputs),
        *(f'<{kind} name="{one}" valueReference="{vr}" causality="output"/>' for vr, one, kind in outputs),
    ]
    structure = [
        f'<{unknown} valueReference="{vr}" dependencies=""/>'
        for unknown in ("Output", "InitialUnknown")
        for vr, _, _ in outputs
    ]
    return exported.filled(
        "model_description.xml",
        token=token,
        quoted=quoteattr(exported.description),
        version=version,
        step=repr(1.0 / fs),
        variables="\n    ".join(variables),
        structure="\n    ".join(structure),
    )
