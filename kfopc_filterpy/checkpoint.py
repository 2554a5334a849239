"""Checkpoints: a filter, a controller or a supervisor in a file, from which an interrupted run continues to the bit.

A file is an archive of numpy's (``.npz``). It has the arrays of the object, each under the attribute that holds it, and
``header``, JSON with the version of the package and everything else. The comment of the archive is the SHA-256 of all
bytes before it.

An object in the header is the name of its class, and what ``__getstate__`` returns, for a copy and a file alike. What
an object holds twice is still one thing. Only the package's own classes, and those that the caller of `load` passes,
can be named; nothing else that a file names is looked up, and nothing in a file is code.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections import Counter, deque
from collections.abc import Callable, Iterable
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import numpy as np
from filterpy.common import inv_diagonal
from filterpy.kalman import KalmanFilter

from ._validate import require_existing
from ._writing import replacing

DIGEST = 64  # hexadecimal digits of SHA-256
INVERSES = {one.__name__: one for one in (np.linalg.inv, np.linalg.pinv, inv_diagonal)}  # of filterpy's filters
# What a container is taken apart into, and what a thing that the header names is made of.
PARTS: dict[type, Callable[[Any], list[Any]]] = {
    tuple: list,
    dict: lambda pairs: [[key, item] for key, item in pairs.items()],
    Counter: lambda pairs: [[key, item] for key, item in pairs.items()],
    deque: lambda items: [list(items), items.maxlen],
}
MADE: dict[str, Callable[[Any], Any]] = {
    "tuple": tuple,
    "dict": dict,
    "Counter": lambda pairs: Counter(dict(pairs)),
    "deque": lambda held: deque(*held),
    "scalar": lambda array: array[()],
    "objects": lambda lists: np.array(lists, object),
    "function": INVERSES.__getitem__,
}


class Checkpointed:
    """Base class of the filters, the controllers and the supervisor, which can be copied and saved in a file."""

    __slots__ = ()

    def __copy__(self) -> Self:
        """Return a copy that shares nothing."""
        return deepcopy(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Save everything that the next sample depends on in a file, from which `load` continues to the bit.

        The file is complete or not there: it is written beside `path`, forced to the disk and then renamed. If the
        process is killed, or the disk is full, the file that was there before stays as it is.

        Parameters
        ----------
        path : path
            Name of the file; ``.npz`` is the usual suffix.

        Raises
        ------
        FileNotFoundError
            A folder that does not exist.
        TypeError
            An attribute that cannot be stored: a function, or an object of your own class without the methods
            ``state()`` and ``restore(state)``. The message names it. Nothing was written.

        Notes
        -----
        Call it between two samples, after `update`, and from the thread that calls the other methods. Simulated paths,
        and the position in a recording, are not part of a filter or controller: keep them yourself.

        ``state()`` of your own class returns numbers, strings, arrays, lists, tuples and dicts of them, or other
        objects that can be saved. ``restore(state)`` gets them in a new object, which was made without ``__init__``.

        Examples
        --------
        >>> import os, tempfile
        >>> from kfopc_filterpy import fx_lms
        >>> from kfopc_filterpy.controllers import CoreController
        >>> controller = fx_lms(2, [1.0], step_size=0.1)
        >>> controller.control_signal(1.0), controller.update(2.0)
        (0.0, None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "run.npz")
        ...     controller.save(path)
        ...     again = CoreController.load(path)
        >>> again.control_signal(1.0) == controller.control_signal(1.0)
        True
        """
        content = content_of(self)
        with replacing(path) as file:
            file.write(content)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, classes: Iterable[type] = ()) -> Self:
        """Return what `save` wrote into a file: an object of this class, or of one derived from it.

        It continues to the bit with the same versions of this package, numpy and scipy. Otherwise it
        continues from the same state, but rounding may differ.

        Parameters
        ----------
        path : path
            Name of the file.
        classes : iterable of classes, optional
            Your own classes that are part of the object, such as that of a controller in a wrapper.

        Returns
        -------
        object
            An object of the class that was saved.

        Raises
        ------
        FileNotFoundError
            No such file.
        TypeError
            A file with an object of another class.
        ValueError
            A file that is cut short, damaged or that `save` did not write; that was written by a version of the package
            with another major or minor number, or by one whose core has another layout; that names a class of yours
            which is not in `classes`.

        Notes
        -----
        Loading runs no code from the file. But the checksum finds damage, not intent, and compiled code trusts the
        numbers of a state: do not load files that you do not trust.

        See Also
        --------
        save : It has an example.
        """
        require_existing(path)
        content = Path(path).read_bytes()
        if hashlib.sha256(content[:-DIGEST]).hexdigest().encode() != content[-DIGEST:]:
            raise ValueError(
                f"{path} is damaged, cut short or not a file that `save` wrote: its checksum differs; load an older file, "
                "or begin anew"
            )
        try:
            made = _Reader(content, (cls, *classes)).object_at(0)
        except Exception as error:  # a file with the right checksum can hold anything
            raise ValueError(f"{path} is not continued by this version of the package: {error}") from error
        if not isinstance(made, cls):
            kind = type(made).__name__
            raise TypeError(f"{path} has a {kind}, which is no {cls.__name__}: call {kind}.load")
        return made


def content_of(value: Any) -> bytes:
    """Return what a file of an object has in it; equal states give equal bytes."""
    written = _Writer()
    written.json_of(value, type(value).__name__)
    header = json.dumps({"version": _series(), "objects": written.objects})
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w") as archive:
        archive.comment = bytes(DIGEST)  # room
        for name, array in {"header": np.array(header.encode()), **written.arrays}.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    content = archived.getvalue()[:-DIGEST]
    return content + hashlib.sha256(content).hexdigest().encode()


def _series() -> str:
    """Return the major and minor number of this version: versions with others may go on in another way."""
    version: str = import_module(__package__).__version__
    return version.rpartition(".")[0]


def _by_attributes(kind: type) -> bool:
    """Tell whether objects of a class are saved by their attributes; others are by `state` and `restore`."""
    return kind.__module__.startswith(f"{__package__}.") or issubclass(kind, (Checkpointed, KalmanFilter))


class _Writer:
    """What an object holds: `objects` as JSON, the first of which it is, and `arrays` by name."""

    def __init__(self) -> None:
        self.objects: list[Any] = []
        self.arrays: dict[str, np.ndarray] = {}
        # By id, what stands for a value that was met, and the value, so that the id stays its own.
        self._met: dict[int, tuple[dict[str, Any], Any]] = {}

    def json_of(self, value: Any, where: str) -> Any:
        """Return the JSON that stands for a value; `where` names its place."""
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind is list:
            return [self.json_of(item, f"{where}[{i}]") for i, item in enumerate(value)]
        if kind in PARTS:
            return {kind.__name__: self.json_of(PARTS[kind](value), where)}
        if isinstance(value, np.generic):
            return {"scalar": self.json_of(np.array(value), where)}
        if kind is np.ndarray and value.dtype == object:  # filterpy's z, before the first measurement
            return {"objects": self.json_of(value.tolist(), where)}
        if (name := getattr(value, "__name__", "")) in INVERSES and INVERSES[name] is value:
            return {"function": name}
        if id(value) not in self._met:
            is_plain = kind is np.ndarray and not value.dtype.hasobject
            (self._add_array if is_plain else self._add_object)(value, where)
        return self._met[id(value)][0]

    def _add_array(self, array: np.ndarray, where: str) -> None:
        name = f"{where} {len(self.arrays)}" if where in self.arrays else where
        self.arrays[name] = array
        self._met[id(array)] = {"array": name}, array

    def _add_object(self, value: Any, where: str) -> None:
        kind = type(value)
        if _by_attributes(kind):
            state = value.__getstate__()
            parts = state if type(state) is tuple else (state,)  # attributes, and those in slots
        elif hasattr(kind, "state") and hasattr(kind, "restore"):
            parts = ({"state": value.state()},)
        else:
            raise TypeError(
                f"{where} cannot be saved: a {kind.__qualname__} is neither data nor of a class with the methods state(), "
                "which returns data, and restore(state)"
            )
        described: dict[str, Any] = {"class": f"{kind.__module__}.{kind.__qualname__}"}
        self._met[id(value)] = {"object": len(self.objects)}, value
        self.objects.append(described)
        described["items"] = self.json_of(list(value) if isinstance(value, tuple) else [], where)
        described["parts"] = [
            {name: self.json_of(item, f"{where}.{name}") for name, item in (part or {}).items()} for part in parts
        ]


class _Reader:
    """A file's objects, made from its header and its arrays; an object is made when it is first asked for."""

    def __init__(self, content: bytes, classes: Iterable[type]) -> None:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            if sum(entry.file_size for entry in file.zip.infolist()) > len(content):  # `save` compresses nothing
                raise ValueError("it would unpack to more than it has")
            self._arrays = dict(file)
        header = json.loads(self._arrays["header"].item())
        if header["version"] != _series():
            raise ValueError(f"it was written by version {header['version']}, and this is {_series()}")
        self._objects = header["objects"]
        self._classes = {f"{kind.__module__}.{kind.__qualname__}": kind for kind in (KalmanFilter, *classes)}
        self._made: dict[int, Any] = {}

    def value_of(self, told: Any) -> Any:
        """Return the value that stands in the header as this JSON."""
        if isinstance(told, list):
            return [self.value_of(item) for item in told]
        if not isinstance(told, dict):
            return told
        ((what, held),) = told.items()
        if what == "object":
            return self.object_at(held)
        return self._arrays[held] if what == "array" else MADE[what](self.value_of(held))

    def object_at(self, index: int) -> Any:
        """Return an object, made without its ``__init__`` and without setters."""
        if index in self._made:
            return self._made[index]
        described = self._objects[index]
        kind, items = self._class(described["class"]), self.value_of(described["items"])
        made = tuple.__new__(kind, items) if issubclass(kind, tuple) else object.__new__(kind)
        self._made[index] = made
        attributes, *slots = ({name: self.value_of(item) for name, item in part.items()} for part in described["parts"])
        if not _by_attributes(kind):
            made.restore(attributes["state"])
        elif hasattr(kind, "__setstate__"):
            made.__setstate__(attributes)
        elif attributes:
            vars(made).update(attributes)
        for name, value in slots[0].items() if slots else ():
            object.__setattr__(made, name, value)
        return made

    def _class(self, name: str) -> Any:
        """Return the class of this name: the package's, or one that the caller named."""
        module, _, own = name.rpartition(".")
        if name not in self._classes and module.startswith(f"{__package__}."):
            kind = vars(import_module(module)).get(own)
            if isinstance(kind, type) and kind.__module__ == module:
                return kind
        if name not in self._classes:
            raise ValueError(f"it names {name}: if that class is yours, pass it, load(path, classes=[{own}])")
        return self._classes[name]
