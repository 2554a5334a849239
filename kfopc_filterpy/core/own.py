"""Load an algorithm of one's own: a C file outside the package, compiled together with the core."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import sys
import sysconfig
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from . import building
from .block import Algorithm, _Algorithm, _Plan
from .library import fields_of, load

CACHE_VARIABLE = "KFOPC_CACHE"
_MOST_SETTINGS = 8  # ANC_MOST_SETTINGS in signals.h
_STEPS = ("layout", "start", "control_signal", "update")
# What is compiled: the declaration makes the algorithm visible from outside, and its type is checked.
_UNIT = '#include "signals.h"\nextern ANC_PUBLIC const anc_algorithm anc_{name};\n#include "{path}"\n'
_INCLUDED = re.compile(r'^\s*#\s*include\s*"([^"]+)"', re.M)


class OwnAlgorithm(Algorithm):
    """An algorithm of a user's C file; its copies and pickles name this file, and not the library built from it."""

    def __init__(self, name: str, library: Path, source: Path) -> None:
        super().__init__(name, library)
        self.source = source

    def __reduce__(self) -> Any:
        return load_algorithm, (str(self.source), self.name)


def load_algorithm(path: str | os.PathLike[str], name: str | None = None) -> OwnAlgorithm:
    """Compile a C file of your own, if that has not been done yet, and load the algorithm that it defines.

    A subclass of `CoreController` whose `algorithm` it is, is a controller like those of the package: for one channel
    and several, with limiter, known amplifier, constraint and uncertain secondary path, in blocks and whole runs.

    Parameters
    ----------
    path : path
        C file that includes ``signals.h`` and defines ``const anc_algorithm anc_<name>``. CONTRIBUTING, "Add a
        controller", explains such a file.
    name : str, optional
        Name of the algorithm in C; by default the file's, without ``.c``.

    Returns
    -------
    Algorithm
        The value for `CoreController.algorithm`. Copies and pickles of it name the C file, which is compiled again
        where it was not yet: another machine needs the file at the same place.

    Raises
    ------
    FileNotFoundError
        No such file.
    ValueError
        A file that is not C, a name that is no name in C or that the core has already, a file that does not define the
        algorithm, or an incomplete table of one.
    RuntimeError
        No compiler, or a file that does not compile: the message has the compiler's words.

    Notes
    -----
    The C compiler is that of the machine (``$CC``, cc, gcc or clang), or zig's, which comes as a wheel:
    ``pip install ziglang``. The library is kept in the user's cache folder, or in the folder that the environment
    variable KFOPC_CACHE names. An edit of the file, or of files that it includes by a name in quotes, makes a new one.
    The code runs in the Python process: an error in it, such as a wrong index, can crash Python.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from kfopc_filterpy.controllers import CoreController, load_algorithm
    >>> code = '''
    ... #include "signals.h"
    ... static const anc_setting settings[] = {{"step_size", 0, 0, ANC_ONE}, {0}}; // any value from 0 on, one for all
    ... static int update(anc_view *view, const real *error) // the delayless LMS, which takes the path for 1
    ... {
    ...     signals *s = (signals *)view;
    ...     const int refused = error ? estimate(s, error) : ANC_DONE;
    ...     if (!error || refused) return refused;
    ...     commit(s);
    ...     for (int32_t i = 0; i < s->L; i++) s->weights[i] += *s->setting[0] * *error * newest(&s->x, 0)[i];
    ...     return ANC_DONE;
    ... }
    ... const anc_algorithm anc_plain = {"plain LMS", settings, layout_plain, start_plain, filtered_signal, update};
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "plain.c")
    ...     _ = file.write_text(code)
    ...     plain = load_algorithm(file)
    >>> class PlainLMS(CoreController):
    ...     name, algorithm = "plain LMS", plain
    >>> controller = PlainLMS(4, secondary_path=[0.0, 1.0], settings={"step_size": 0.1})
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0])  # 0.1 * 2 * 1
    0.2
    """
    source = Path(path).absolute()
    name = source.stem if name is None else name
    _require_file(source)
    _require_name(name, source)
    library = _library_of(source, name)
    if not library.exists():
        _compile(source, name, library)
    _require_table(name, library, source)
    return OwnAlgorithm(name, library, source)


def _require_file(source: Path) -> None:
    if source.suffix != ".c":
        raise ValueError(f"an algorithm is a C file, whose name ends with .c, got {source}")
    if not source.is_file():
        raise FileNotFoundError(f"there is no file {source}")


def _require_name(name: str, source: Path) -> None:
    if not re.fullmatch(r"[A-Za-z0-9_]+", name):
        raise ValueError(
            f"{name!r} cannot be part of a name in C, as in anc_{name}: rename {source.name}, or give name= with letters, "
            "digits and underscores"
        )
    if hasattr(load().held, f"anc_{name}"):
        raise ValueError(f"the core has a function or an algorithm anc_{name} of its own: choose another name")


def _library_of(source: Path, name: str) -> Path:
    """Return the place of the library, which is named after all that it is made of."""
    core = load()
    digest = hashlib.sha256()
    for part in (_UNIT, name, building.stamp_of(core.free), core.level, sysconfig.get_platform()):
        digest.update(f"{part}\0".encode())
    for file in _files_of(source):
        digest.update(file.read_bytes() + b"\0")
    return _cache_folder() / f"{name}-{digest.hexdigest()[:16]}{core.path.suffix}"


def _files_of(source: Path) -> list[Path]:
    """Return a C file and what it includes by names in quotes, except the core's headers."""
    files = [source]
    for file in files:  # grows meanwhile
        text = file.read_text(encoding="utf-8", errors="replace")
        found = [file.parent / included for included in _INCLUDED.findall(text)]
        files += [one for one in dict.fromkeys(found) if one.is_file() and one not in files]
    return files


def _cache_folder() -> Path:
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named).absolute()
    if sys.platform == "win32":
        user = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local"))
    elif sys.platform == "darwin":
        user = Path.home() / "Library/Caches"
    else:
        user = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return user / "kfopc_filterpy"


def _compile(source: Path, name: str, library: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        unit = Path(folder, f"{name}_public.c")
        unit.write_text(_UNIT.format(name=name, path=source.as_posix()), encoding="utf-8")
        try:
            building.build([*building.core_sources(), unit], library, level=load().level)
        except building.BuildError as error:
            words = str(error).partition("\n")[2]  # after the command
            raise building.BuildError(f"{source} does not compile:\n{words}") if words else error from None
        except OSError as error:
            raise building.BuildError(
                f"{library.parent} cannot keep the compiled {source.name} ({error}): let {CACHE_VARIABLE} name another"
            ) from None


def _require_table(name: str, library: Path, source: Path) -> None:
    """Raise ValueError if the table of the algorithm is missing, or has what would crash the core."""
    try:
        struct = _Algorithm.in_dll(ctypes.PyDLL(str(library)), f"anc_{name}")
    except ValueError:
        raise ValueError(
            f"{source} defines no algorithm anc_{name}: write `const anc_algorithm anc_{name} = {{...}};`, or give the "
            "name that it has as name="
        ) from None
    if wrong := fault_of(struct):
        raise ValueError(f"the table anc_{name} in {source} is wrong: {wrong}")


def fault_of(struct: Any) -> str:
    """Return what is wrong with the table of an algorithm, or nothing."""
    if not struct.name:
        return "its first entry must be the algorithm's name"
    if not struct.settings:
        return "its settings must be an array that ends with {0}, also if there is none"
    if missing := [step for step in _STEPS if not getattr(struct, step)]:
        return f"it has no {' and no '.join(missing)}; it must be {{name, settings, {', '.join(_STEPS)}}}"
    settings: list[Any] = []
    while (setting := struct.settings[len(settings)]).name is not None:
        settings.append(setting)
        if len(settings) > _MOST_SETTINGS:
            return f"it can have {_MOST_SETTINGS} settings, and they must end with {{0}}"
    for one in settings:
        if one.most != 0 and not one.least <= one.most:
            return f"the range of {one.name.decode()} is from {one.least:g} to {one.most:g}, which is empty"
    return _fault_of_fields(struct)


def _fault_of_fields(struct: Any) -> str:
    """Return what is wrong with the fields that `layout` makes, or nothing."""
    own, fields = _fields_of(struct), _fields_of(_Algorithm.in_dll(load().held, "anc_fxlms"))
    del fields["step_size"]  # a setting of FxLMS
    if missing := [name for name in fields if name not in own]:
        return f"layout makes no field {missing[0]}: it must call layout_signals first"
    if twice := [name for name, count in own.items() if count > 1]:
        return f"two fields have the name {twice[0]}: rename the setting, or the field that layout makes"
    return ""


def _fields_of(struct: Any) -> Counter[str]:
    """Return how often `layout` makes each field of the smallest controller."""
    plan = _Plan(scenarios=1, microphones=1, loudspeakers=1, references=1, taps=1, path_taps=1)
    described = fields_of(load().held.anc_describe, ctypes.byref(struct), ctypes.byref(plan))
    return Counter(field.name for field in described)
