"""Checkpoints: a filter, a controller or a supervisor in a file, from which an interrupted run continues to the bit.

A file has four parts::

    kfopc checkpoint 1 4711\n                the format, and the number of bytes of the JSON
    {"package": ..., "nodes": [...], ...}\n  versions, and the object as a list of nodes
    zeros up to a multiple of 64 bytes, memory of the arrays
    64 hexadecimal digits                    SHA-256 of everything before them

What an object is, its ``__getstate__`` says, as for a copy. A node is an object, a container or an array; whatever is
shared in memory is one node. An array is stored by the place of its elements in the file, with its strides. Arrays that
share memory share a place, so views stay views. A place has the address of the original memory modulo 64, so that rows
that began at cache lines do so again.

Nothing in a file is executed. The classes that it may name are those of the folders in `FOLDERS`, filterpy's
KalmanFilter, and those that the caller of `load` trusts. Arrays are views of the bytes that were read, so a file cannot
claim more memory than it has.
"""

from __future__ import annotations

import copyreg
import hashlib
import json
import math
import os
import pkgutil
import platform
import secrets
import sys
import time
import types
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from glob import escape
from importlib import import_module
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

FORMAT = 1
PACKAGE = __package__
MAGIC = b"kfopc checkpoint "
FOLDERS = ("core", "kernels", "paths", "power", "filters", "controllers", "realtime")  # whose classes a file may name
OUTSIDE = (  # what else it may name
    "filterpy.kalman.KalmanFilter",
    "filterpy.common.inv_diagonal",
    "numpy.linalg.inv",
    "numpy.linalg.pinv",
    "scipy.linalg.inv",
    "scipy.linalg.pinv",
)
GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")  # numpy's bit generators
LINE = 64  # bytes in a cache line
DIGEST = 64  # hexadecimal digits of SHA-256
MOST_HEADER = 2**24  # bytes; as Python objects, JSON takes up to 35 times its size
ABANDONED_S = 3600.0  # an unfinished file as old as this belongs to a process that was killed


class CheckpointError(ValueError):
    """A file that cannot be loaded."""


class Checkpointed:
    """Base class of the filters, the controllers and the supervisor, which can be saved in a file."""

    __slots__ = ()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Save everything that the next sample depends on in a file, from which `load` continues to the bit.

        The file is complete or not there: it is written beside `path`, forced to the disk and then renamed. If the
        process is killed, or the disk is full, the file that was there before stays as it is.

        Parameters
        ----------
        path : path
            Name of the file; ``.kfopc`` is the usual suffix.

        Raises
        ------
        FileNotFoundError
            A folder that does not exist.
        TypeError
            An attribute that cannot be stored, such as a lambda, an open file or a bound method. The message names it.
            Nothing was written.

        Notes
        -----
        Call it between two samples, after `update`, and from the thread that calls the other methods. Simulated paths,
        and the position in a recording, are not part of a filter or controller: keep them yourself.

        Examples
        --------
        >>> import os, tempfile
        >>> from kfopc_filterpy import FxLMS
        >>> controller = FxLMS(2, secondary_path=[1.0], step_size=0.1)
        >>> controller.control_signal(1.0), controller.update(2.0)
        (0.0, None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "run.kfopc")
        ...     controller.save(path)
        ...     again = FxLMS.load(path)
        >>> again.control_signal(1.0) == controller.control_signal(1.0)
        True
        """
        _write(Path(os.path.realpath(path)), _encoded(self))

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, trusted: Iterable[Any] = ()) -> Self:
        """Return what `save` wrote into a file: an object of this class, or of one derived from it.

        It continues to the bit with the same versions of this package, numpy, scipy and numba, the same compiled code
        on disk and the same kind of processor. Otherwise it continues from the same state, but rounding may differ.

        Parameters
        ----------
        path : path
            Name of the file.
        trusted : iterable of classes and functions, optional
            Your own classes and functions that are part of the object, such as the class of a controller in a
            `MonitoredController`, or an amplifier. The class on which `load` is called is trusted anyway. Objects of
            your classes get their attributes; neither ``__new__`` nor ``__init__`` is called.

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
            A file that is empty, cut short, damaged or no checkpoint; that was written in another format, or by a
            version of the package with another major or minor number; that names a class that is not trusted.

        Notes
        -----
        Loading executes nothing that is in the file and takes as much memory as the file, plus up to 35 times its part
        in JSON, which is some kilobytes and at most 16 MiB. The checksum finds damage, not intent: compiled code trusts
        the numbers of a state, so do not load files that you do not trust.

        See Also
        --------
        save : It has an example.
        """
        return _load(cls, Path(path), trusted)


# Writing.


class _Writer:
    """Converts an object into nodes, and collects its arrays."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.arrays: list[tuple[dict[str, Any], np.ndarray]] = []
        self._known: dict[int, tuple[int, Any]] = {}  # by id; holds the values, so that no id is used twice
        self._unfinished: set[int] = set()  # tuples
        self._named: dict[str, Any] = {}

    def value(self, value: Any, where: str) -> Any:
        """Return a value as JSON; anything but a number, a string or None becomes a node."""
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if id(value) not in self._known:
            self._known[id(value)] = (len(self.nodes), value)
            self.nodes.append(None)
            self.nodes[self._known[id(value)][0]] = self._node(value, where)
        elif id(value) in self._unfinished:
            raise TypeError(f"{where} cannot be saved: it is a tuple that contains itself")
        return {"node": self._known[id(value)][0]}

    def _node(self, value: Any, where: str) -> dict[str, Any]:
        kind = type(value)
        if isinstance(value, np.ndarray):
            return self._array(value, where)
        if isinstance(value, np.generic):
            return {"kind": "scalar", "of": self.value(np.array(value), where)}
        if isinstance(value, tuple):
            return self._tuple(value, where)
        if kind in (list, deque):
            items = [self.value(item, f"{where}[{i}]") for i, item in enumerate(value)]
            return {"kind": "list", "items": items} | ({"most": value.maxlen} if kind is deque else {})
        if kind in (dict, Counter):
            return {"kind": "dict", "items": self._pairs(value, where)} | ({"counts": True} if kind is Counter else {})
        if kind is np.random.Generator and value.bit_generator.state.get("bit_generator") in GENERATORS:
            return {"kind": "generator", "state": self.value(value.bit_generator.state, where)}
        if _is_function(value):
            return {"kind": "function", "name": self._name(value, where)}
        return self._object(value, where)

    def _pairs(self, value: dict[Any, Any], where: str) -> list[list[Any]]:
        return [[self.value(k, f"a key of {where}"), self.value(v, f"{where}[{k!r}]")] for k, v in value.items()]

    def _tuple(self, value: Any, where: str) -> dict[str, Any]:
        fields = getattr(value, "_fields", None)
        names = [f"{where}[{i}]" for i in range(len(value))] if fields is None else [f"{where}.{f}" for f in fields]
        self._unfinished.add(id(value))
        node: dict[str, Any] = {"kind": "tuple", "items": list(map(self.value, value, names))}
        self._unfinished.remove(id(value))
        if type(value) is not tuple:
            node |= {"class": self._name(type(value), where), "fields": fields}
        return node

    def _object(self, value: Any, where: str) -> dict[str, Any]:
        kind = type(value)
        try:
            make, arguments, state, *items = value.__reduce_ex__(2)
        except (TypeError, ValueError):  # of numbers or strings, or with a part that is not Python's
            make = None
        if make is not copyreg.__newobj__ or arguments != (kind,) or any(items) or hasattr(kind, "__setstate__"):  # type: ignore[attr-defined]
            raise TypeError(
                f"{where} cannot be saved: it is a {kind.__name__}, and a file holds numbers, strings, containers, "
                "numpy arrays and generators, functions with a name, and objects with attributes"
            )
        attributes, slots = state if isinstance(state, tuple) else (state, None)
        return {
            "kind": "object",
            "class": self._name(kind, where),
            "attributes": {n: self.value(v, f"{where}.{n}") for n, v in (attributes or {}).items()},
            "slots": {n: self.value(v, f"{where}.{n}") for n, v in (slots or {}).items()},
        }

    def _name(self, thing: Any, where: str) -> str:
        """Return the name of a class or function, which must not have that of another."""
        name = _full_name(thing)
        if self._named.setdefault(name, thing) is not thing or "<lambda>" in name:
            raise TypeError(
                f"{where} cannot be saved: {name} does not tell which function or class it is; define it with a name "
                "of its own in a module"
            )
        return name

    def _array(self, array: np.ndarray, where: str) -> dict[str, Any]:
        if type(array) not in (np.ndarray, np.recarray):
            raise TypeError(f"{where} cannot be saved: it is a {type(array).__name__}; make a plain numpy array of it")
        if array.dtype == object:
            items = [self.value(item, where) for item in array.ravel().tolist()]
            return {"kind": "objects", "shape": array.shape, "items": items}
        node = {"kind": "array", "dtype": _dtype_as_json(array.dtype, where), "writeable": array.flags.writeable}
        low, high = _span(array)
        if array.nbytes > high - low:  # elements that share memory among themselves, as broadcasting makes them
            array = array.copy()
        self.arrays.append((node, array))
        return node


def _encoded(value: Any) -> Iterator[bytes]:
    """Return the bytes of a file in parts, without the checksum; raise TypeError if something cannot be saved."""
    writer = _Writer()
    root = writer.value(value, type(value).__name__)
    places = _placed(writer.arrays)
    header = {
        "package": _package_version(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": _libraries(),
        "root": root,
        "nodes": writer.nodes,
    }
    line = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    if len(line) > MOST_HEADER:
        raise TypeError(
            f"{type(value).__name__} cannot be saved: its values outside arrays take {len(line)} bytes, and at most "
            f"{MOST_HEADER} can be loaded again; store long lists of numbers as numpy arrays"
        )
    start = MAGIC + f"{FORMAT} {len(line)}\n".encode() + line + b"\n"
    return chain([start + bytes(-len(start) % LINE)], _contents(places))


def _contents(places: list[_Place]) -> Iterator[bytes]:
    """Yield the memory of the arrays; what is between their elements, and between places, is zero."""
    done = 0
    for place in places:
        memory = np.zeros(place.at + place.high - place.low - done, np.uint8)
        for node, array in place.arrays:
            np.ndarray(array.shape, array.dtype, memory.data, node["at"] - done, array.strides)[...] = array
        yield memory.tobytes()
        done += memory.size


@dataclass
class _Place:
    """A stretch of memory, and the arrays whose elements are in it."""

    low: int  # addresses
    high: int
    arrays: list[tuple[dict[str, Any], np.ndarray]] = field(default_factory=list)
    at: int = 0  # first byte in the data of the file


def _placed(arrays: list[tuple[dict[str, Any], np.ndarray]]) -> list[_Place]:
    """Return the places in the file of all arrays, in order, and complete the nodes of the arrays."""
    places: list[_Place] = []
    for node, array in sorted(arrays, key=lambda entry: _span(entry[1])):
        low, high = _span(array)
        if not places or low >= places[-1].high:
            places.append(_Place(low, high))
        places[-1].high = max(places[-1].high, high)
        places[-1].arrays.append((node, array))
    end = 0
    for place in places:
        place.at = end + (place.low - end) % LINE
        end = place.at + place.high - place.low
        for node, array in place.arrays:
            node |= {"shape": array.shape, "strides": array.strides, "at": place.at + _address(array) - place.low}
    return places


def _address(array: np.ndarray) -> int:
    """Return the address of the first element."""
    return array.__array_interface__["data"][0]


def _span(array: np.ndarray) -> tuple[int, int]:
    """Return the addresses at which the memory of an array begins and ends."""
    first = _address(array)
    if not array.size:
        return first, first
    steps = [(n - 1) * stride for n, stride in zip(array.shape, array.strides, strict=True)]
    return first + sum(s for s in steps if s < 0), first + sum(s for s in steps if s > 0) + array.itemsize


def _write(path: Path, parts: Iterator[bytes]) -> None:
    """Write a file and its checksum, so that `path` has either its old content or all of the new one."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: make it first")
    with _replacing(path) as file:
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
            file.write(part)
        file.write(digest.hexdigest().encode())


@contextmanager
def _replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file, which replaces `path` once it is on the disk; after an error it is removed."""
    _remove_abandoned(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        with open(part, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    if os.name != "nt":  # Windows does not open folders
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name is on the disk too
        finally:
            os.close(folder)


def _remove_abandoned(path: Path) -> None:
    """Remove what processes left that were killed while they wrote `path`."""
    for part in path.parent.glob(f".{escape(path.name)}.*.part"):
        with suppress(FileNotFoundError):
            if time.time() - part.stat().st_mtime > ABANDONED_S:
                part.unlink()


# Reading.


def _load(kind: type[Any], path: Path, trusted: Iterable[Any]) -> Any:
    """Return the object in a file; it must be one of `kind`."""
    names = {_full_name(thing): thing for thing in (kind, *trusted)}
    memory = _read(path)
    header, data = _opened(path, memory)
    try:
        reader = _Reader(path, header["nodes"], data, names)
        found = reader.class_of(header["nodes"][header["root"]["node"]]["class"])
        made = reader.value(header["root"]) if issubclass(found, kind) else None
    except CheckpointError:
        raise
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise _not_ours(path, error) from error
    if made is None:
        raise TypeError(f"{path} has a {found.__name__}, which is no {kind.__name__}: call {found.__name__}.load")
    return made


def _read(path: Path) -> np.ndarray:
    """Return the bytes of a file, in memory that begins at a cache line, if they agree with the checksum."""
    try:
        file = open(path, "rb", buffering=0)  # noqa: SIM115  # closed below
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no file {path}: look for it, or begin anew without a checkpoint") from error
    with file:
        size = os.fstat(file.fileno()).st_size
        room = np.empty(size + LINE, np.uint8)
        begin = -_address(room) % LINE
        memory = room[begin : begin + size]
        read = 0
        while read < size and (more := file.readinto(memory[read:].data)):
            read += more
    if size == 0 or read < size:
        raise CheckpointError(f"{path} is empty: nothing was saved in it; load an older file, or begin anew")
    if memory[: len(MAGIC)].tobytes() != MAGIC:
        raise CheckpointError(f"{path} is no checkpoint, or its first bytes are damaged: load what `save` wrote")
    if hashlib.sha256(memory[:-DIGEST].data).hexdigest().encode() != memory[-DIGEST:].tobytes():
        raise CheckpointError(
            f"{path} is damaged or cut short: its checksum differs; load an older file, or copy it again"
        )
    return memory


def _opened(path: Path, memory: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """Return the header of a file and the data behind it, if this version reads them."""
    line = memory[:LINE].tobytes().partition(b"\n")[0]
    number, _, size = line[len(MAGIC) :].partition(b" ")
    if number != str(FORMAT).encode():
        raise CheckpointError(
            f"{path} has the format {number.decode(errors='replace')}, and {PACKAGE} {_package_version()} reads format "
            f"{FORMAT}: install the version of the package that wrote it"
        )
    try:
        begin, end = len(line) + 1, len(line) + 1 + int(size)
        if not 0 <= int(size) <= min(MOST_HEADER, memory.size - DIGEST - begin):
            raise ValueError(f"a header of {int(size)} bytes")
        header = json.loads(memory[begin:end].tobytes())
        written = header["package"]
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise _not_ours(path, error) from error
    if _series(written) != _series(_package_version()):
        raise CheckpointError(
            f"{path} was written by {PACKAGE} {written}, and this is {_package_version()}, which may continue in "
            f"another way: install {PACKAGE} {written}, or begin anew"
        )
    return header, memory[end + 1 + -(end + 1) % LINE : -DIGEST]


def _not_ours(path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{path} has a correct checksum, but `save` of this version does not write such a file "
        f"({type(error).__name__}: {error}): load it with the version that wrote it"
    )


class _Reader:
    """Makes objects from nodes."""

    def __init__(self, path: Path, nodes: list[Any], data: np.ndarray, names: dict[str, Any]) -> None:
        self._path, self._nodes, self._data, self._names = path, nodes, data, names
        self._made: dict[int, Any] = {}

    def value(self, value: Any) -> Any:
        """Return the value that JSON stands for."""
        if not isinstance(value, dict):
            return value
        if "float" in value:
            return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[value["float"]]
        index = value["node"]
        if index not in self._made:
            node = self._nodes[index]
            make = {
                "array": self._array,
                "objects": self._objects,
                "scalar": lambda i, n: self.value(n["of"])[()],
                "tuple": self._tuple,
                "list": self._list,
                "dict": self._dict,
                "generator": self._generator,
                "function": lambda i, n: self._thing(n["name"]),
                "object": self._object,
            }[node["kind"]]
            self._made[index] = make(index, node)
        return self._made[index]

    def class_of(self, name: str) -> Any:
        """Return a class that the file may name."""
        kind = self._thing(name)
        if not isinstance(kind, type):
            raise CheckpointError(f"{self._path} has {name} as a class, which it is not")
        return kind

    def _thing(self, name: str) -> Any:
        found = self._names.get(name) or (_outside().get(name) if name in OUTSIDE else _class_of_package(name))
        if found is None:
            raise CheckpointError(
                f"{self._path} names {name}, which is none of {PACKAGE}'s own classes: if it is yours and you trust the "
                f"file, pass it, load(path, trusted=[{name.rpartition('.')[2]}])"
            )
        return found

    def _array(self, index: int, node: dict[str, Any]) -> np.ndarray:
        dtype = _dtype_of_json(node["dtype"])
        shape = tuple(node["shape"])
        if math.prod(shape) * dtype.itemsize > self._data.size:
            raise CheckpointError(
                f"{self._path} claims an array of shape {shape}, which is larger than the file: `save` did not write it"
            )
        array = np.ndarray(shape, dtype, self._data.data, node["at"], tuple(node["strides"]))
        if dtype.names is not None:
            from .kernels.records import as_records

            array = as_records(array)
        array.flags.writeable = node["writeable"]
        return array

    def _objects(self, index: int, node: dict[str, Any]) -> np.ndarray:
        array = np.empty(len(node["items"]), object)
        array[:] = [self.value(item) for item in node["items"]]
        return array.reshape(node["shape"])

    def _tuple(self, index: int, node: dict[str, Any]) -> Any:
        items = [self.value(item) for item in node["items"]]
        if "class" not in node:
            return tuple(items)
        kind = self.class_of(node["class"])
        fields = getattr(kind, "_fields", None)
        if fields != (None if node["fields"] is None else tuple(node["fields"])):
            raise ValueError(f"{kind.__name__} has other fields than {node['fields']}")
        return tuple.__new__(kind, items)

    def _list(self, index: int, node: dict[str, Any]) -> Any:
        items: Any = deque(maxlen=node["most"]) if "most" in node else []
        self._made[index] = items  # before its items, which may refer to it
        items.extend(self.value(item) for item in node["items"])
        return items

    def _dict(self, index: int, node: dict[str, Any]) -> dict[Any, Any]:
        items: dict[Any, Any] = Counter() if "counts" in node else {}
        self._made[index] = items
        for key, value in node["items"]:
            items[self.value(key)] = self.value(value)
        return items

    def _generator(self, index: int, node: dict[str, Any]) -> np.random.Generator:
        state = self.value(node["state"])
        if state["bit_generator"] not in GENERATORS:
            raise ValueError(f"there is no generator {state['bit_generator']}")
        bits = getattr(np.random, state["bit_generator"])(0)
        bits.state = state
        return np.random.Generator(bits)

    def _object(self, index: int, node: dict[str, Any]) -> Any:
        kind = self.class_of(node["class"])
        made = self._made[index] = object.__new__(kind)
        vars(made).update({name: self.value(value) for name, value in node["attributes"].items()})
        slots = {name for base in kind.__mro__ for name in vars(base).get("__slots__", ())}
        for name, value in node["slots"].items():
            if name not in slots:
                raise ValueError(f"{kind.__name__} has no slot {name}")
            object.__setattr__(made, name, self.value(value))
        return made


# Names and types.


def _is_function(value: Any) -> bool:
    """Return whether a value is a function of a module, as opposed to a class or a method of an object."""
    own = isinstance(getattr(value, "__qualname__", None), str) and isinstance(value.__module__, str)
    return own and callable(value) and not isinstance(value, type | types.MethodType)


def _full_name(thing: Any) -> str:
    """Return the name of a class or function with its module."""
    return _outside_name(thing) or f"{thing.__module__}.{thing.__qualname__}"


@cache
def _outside() -> dict[str, Any]:
    """Return what `OUTSIDE` names."""
    return {name: getattr(import_module(name.rpartition(".")[0]), name.rpartition(".")[2]) for name in OUTSIDE}


def _outside_name(thing: Any) -> str | None:
    """Return the name of one of `OUTSIDE`, else None."""
    return next((name for name, own in _outside().items() if own is thing), None)


def _class_of_package(name: str) -> type[Any] | None:
    """Return a class of one of the `FOLDERS` of this package, None if there is no such class."""
    module, _, own = name.rpartition(".")
    if module not in _modules():
        return None
    found = vars(import_module(module)).get(own)
    return found if isinstance(found, type) and found.__module__ == module else None


@cache
def _modules() -> frozenset[str]:
    """Return the names of the modules in `FOLDERS`."""
    here = Path(__file__).parent
    return frozenset(f"{PACKAGE}.{f}.{m.name}" for f in FOLDERS for m in pkgutil.iter_modules([str(here / f)]))


@cache  # looking them up takes longer than all else but the disk
def _libraries() -> dict[str, str]:
    """Return the versions of what computes."""
    return {name: version(name) for name in ("numpy", "scipy", "numba", "filterpy")}


def _package_version() -> str:
    return sys.modules[PACKAGE].__version__


def _series(number: str) -> list[str]:
    """Return the major and the minor number of a version."""
    return number.split(".")[:2]


def _dtype_as_json(dtype: np.dtype, where: str) -> Any:
    """Return the type of numbers, strings or records of them."""
    if dtype.names is None:
        if dtype.kind not in "biufcSUmM" or np.dtype(dtype.str) != dtype:
            raise TypeError(f"{where} cannot be saved: it is an array of {dtype}; make one of numbers")
        return dtype.str
    fields = [dtype.fields[name] for name in dtype.names]  # type: ignore[index]
    return {
        "names": dtype.names,
        "formats": [_dtype_as_json(one[0], where) for one in fields],
        "offsets": [one[1] for one in fields],
        "itemsize": dtype.itemsize,
        "aligned": dtype.isalignedstruct,
    }


def _dtype_of_json(text: Any) -> np.dtype:
    """Return the type that `_dtype_as_json` described."""
    if isinstance(text, str):
        dtype = np.dtype(text)
        if dtype.kind not in "biufcSUmM":
            raise ValueError(f"an array of {dtype}")
        return dtype
    formats = [_dtype_of_json(one) for one in text["formats"]]
    record = {"names": text["names"], "formats": formats, "offsets": text["offsets"], "itemsize": text["itemsize"]}
    return np.dtype(record, align=text["aligned"])  # type: ignore[call-overload]
