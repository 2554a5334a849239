"""Pickles that only hold data: reading one calls nothing that it names.

A pickle is a program for a small machine, and Python's machine calls whatever the program names. The one here knows
only the instructions that hold data. It fills lists, deques, dicts, Counters and tuples, and makes objects without
their ``__new__``, ``__init__``, ``__setstate__`` and setters. A pickle can name classes in the `FOLDERS`, what is in
`OUTSIDE`, and what the reader trusts; functions among them are kept, but not called. A class with methods for its own
copying is refused: an algorithm, which loads a library, is one. Keys are numbers, strings or tuples of them, and what
an array or a generator is made of has plain types, so that no method of an object in the pickle is called either.
Arrays are views of memory beside the pickle.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from inspect import getattr_static
from types import MemberDescriptorType
from typing import Any, cast

import numpy as np
import scipy.linalg
from filterpy.common import inv_diagonal
from filterpy.kalman import KalmanFilter

from .core.library import LINE

FOLDERS = ("core", "paths", "power", "filters", "controllers", "realtime")  # whose classes can be named
OUTSIDE = (KalmanFilter, inv_diagonal, np.linalg.inv, np.linalg.pinv, scipy.linalg.inv, scipy.linalg.pinv)  # and these
MADE = (np.ndarray, np.random.Generator, deque, Counter)  # and these, which `_made` knows
GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")  # numpy's bit generators
PLAIN = (type(None), bool, int, float, str)
COPYING = ("__reduce__", "__reduce_ex__", "__setstate__")  # methods of a class for its own copying

# Instructions that push a value, that push an empty one, and that take the last ones: so many, or for 0 back to a mark.
BRING = ("BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8")
BEGIN = {"NONE": type(None), "NEWFALSE": bool, "EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}
TAKE = {"TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "APPEND": 1, "APPENDS": 0, "SETITEM": 2, "SETITEMS": 0}
TAKE |= {"STACK_GLOBAL": 2, "NEWOBJ": 2, "REDUCE": 2, "BUILD": 1}


class NotTrusted(ValueError):
    """A pickle names what it must not."""


def pickled(value: Any) -> tuple[bytes, bytes]:
    """Return the pickle of an object and the memory of its arrays, once they have been read.

    Raises
    ------
    TypeError
        If they cannot be read. The message names the attribute.
    """
    try:
        pickler = _Pickler()
        pickler.dump(value)
        program, memory = pickler.file.getvalue(), b"".join(pickler.arrays)
        unpickled(program, memoryview(memory), pickler.named)
    except Exception as error:  # a class can raise anything when it is pickled
        raise TypeError(f"{_culprit(value)} cannot be saved, because not all of it is data: {error}") from error
    return program, memory


class _Pickler(pickle.Pickler):
    """A pickler that keeps the memory of arrays, and what it names."""

    def __init__(self) -> None:
        self.file, self.arrays, self.named = io.BytesIO(), list[bytes](), list[Any]()
        super().__init__(self.file, 5)

    def reducer_override(self, value: Any) -> Any:
        """Return how a value is made, or NotImplemented if Python decides."""
        if type(value) is np.ndarray and value.dtype == object:  # filterpy's z, before the first measurement
            return np.ndarray, (value.shape, value.ravel().tolist())
        if type(value) in (np.ndarray, np.recarray) or isinstance(value, np.generic):
            kind, order, at = value.dtype, "F" if value.flags.fnc else "C", sum(map(len, self.arrays))
            fields = tuple(text for name in kind.names or () for text in (name, kind[name].str)) or (kind.str,)
            if _dtype(fields, kind.isalignedstruct) != kind:
                raise TypeError(f"an array of {kind}; make it one of numbers")
            self.arrays.append(value.tobytes(order) + bytes(-value.nbytes % LINE))
            return np.ndarray, (value.shape, fields, kind.isalignedstruct, order, at, isinstance(value, np.generic))
        if type(value) is np.random.Generator:
            return np.random.Generator, (value.bit_generator.state,)
        if hasattr(value, "__qualname__"):  # a class or a function
            if not isinstance(value.__module__, str):  # pickle would search all modules for it
                raise TypeError(f"it holds {value!r}")
            self.named.append(value)
            return value.__qualname__
        return NotImplemented


def _culprit(value: Any) -> str:
    """Return the name of the attribute because of which an object cannot be pickled; of the object if it is not one."""
    with suppress(Exception):
        state = value.__reduce_ex__(2)[2]
        for part in state if type(state) is tuple else (state,):
            for name, item in part.items():
                try:
                    pickled(item)
                except TypeError:
                    return f"{type(value).__name__}.{name}"
    return type(value).__name__


def unpickled(program: bytes, memory: memoryview, named: Iterable[Any]) -> Any:
    """Return what was pickled; `named` are classes and functions that the pickle may name.

    Raises
    ------
    Exception
        Of any kind, if the program is not one that `pickled` returns.
    """
    names = {f"{thing.__module__}.{thing.__qualname__}": thing for thing in (*OUTSIDE, *MADE, *named)}
    stack, marks, memo, fresh = list[Any](), list[int](), list[Any](), dict[int, Any]()
    for instruction, argument, _ in pickletools.genops(program):
        name, value = instruction.name, cast(Any, argument)
        if name == "MARK":
            marks.append(len(stack))
        elif name == "MEMOIZE":
            memo.append(stack[-1])
        elif name in TAKE:
            begin = len(stack) - TAKE[name] if TAKE[name] else marks.pop()
            items, stack[begin:] = stack[begin:], []
            if name.startswith("TUPLE"):
                stack.append(tuple(items))
            elif name.startswith("APPEND"):
                (deque if type(stack[-1]) is deque else list).extend(stack[-1], items)
            elif name.startswith("SETITEM"):
                if not all(map(_is_key, items[::2])):
                    raise ValueError("a key that is no number, no string and no tuple of them")
                dict.update(stack[-1], zip(items[::2], items[1::2], strict=True))
            elif name == "STACK_GLOBAL":
                stack.append(_named(".".join(items), names))
            elif name == "BUILD":
                _fill(fresh.pop(id(stack[-1])), items[0])  # once
            else:
                stack.append(_made(items[0], items[1], memory))
                fresh[id(stack[-1])] = stack[-1]
        elif name in BRING:
            stack.append(value)
        elif name in BEGIN:
            stack.append(BEGIN[name]())
        elif name == "NEWTRUE":
            stack.append(True)
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[value])
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise ValueError(f"the instruction {name}")
    return stack.pop()


def _is_key(key: Any) -> bool:
    return all(type(part) in PLAIN for part in (key if type(key) is tuple else (key,)))


def _named(name: str, names: dict[str, Any]) -> Any:
    """Return the class or function of this name: one of `names`, or a class of the package in one of the `FOLDERS`."""
    package, folder, file, own = (*name.split("."), "", "", "", "")[:4]
    if name not in names and package == __package__ and folder in FOLDERS and file.isidentifier():
        found = vars(import_module(f"{package}.{folder}.{file}")).get(own)
        if isinstance(found, type) and f"{found.__module__}.{found.__qualname__}" == name:
            return found
    if name not in names:
        hint = f"if it is yours and you trust the file, pass it, load(path, trusted=[{name.rpartition('.')[2]}])"
        raise NotTrusted(f"names {name}, which is none of {__package__}'s own classes: {hint}")
    return names[name]


def _made(kind: Any, arguments: Any, memory: memoryview) -> Any:
    """Return an object of a class, without attributes, or what one of `MADE` is with these arguments."""
    types = [type(argument) for argument in arguments] if type(arguments) is tuple else None
    if kind is np.ndarray and types in ([tuple, list], [tuple, tuple, bool, str, int, bool]):
        return _array(memory, *arguments)
    if kind is np.random.Generator and types == [dict]:
        return _generator(arguments[0])
    if (kind is deque and types in ([], [tuple, int])) or (kind is Counter and types == [dict]):
        return kind(*arguments)
    if types is None or not issubclass(type(kind), type) or kind in MADE:
        raise ValueError("something is made of other parts")
    if any(getattr(kind, name, None) is not getattr(object, name, None) for name in COPYING):
        raise ValueError(f"{kind.__name__} says itself how it is copied")
    items = arguments[0] if types == [tuple] and not hasattr(kind, "_fields") else arguments
    if len(items) != len(getattr(kind, "_fields", items if types == [tuple] else ())):
        raise ValueError(f"{kind.__name__} has other fields")
    return tuple.__new__(kind, items) if issubclass(kind, tuple) else object.__new__(kind)


def _array(memory: memoryview, shape: tuple[int, ...], fields: Any, aligned: bool = False, *how: Any) -> Any:
    """Return an array, or a scalar: of a list of objects, or in the memory at a place."""
    if any(type(size) is not int for size in shape):
        raise ValueError("a shape of other things than numbers")
    if type(fields) is list:
        return np.fromiter(fields, object).reshape(shape)
    order, at, scalar = how
    array = np.ndarray(shape, _dtype(fields, aligned), memory[at:], order=order)  # numpy takes a negative offset
    return array[()] if scalar else array


def _dtype(fields: tuple[str, ...], aligned: bool) -> np.dtype:
    """Return a type of numbers or strings, or of records with fields of these names and types."""
    if any(type(text) is not str for text in fields):
        raise ValueError("a type of other things than words")
    pairs = list(zip(fields[::2], fields[1::2], strict=False))
    dtype = np.dtype(pairs or fields[0], align=aligned)
    if dtype.hasobject:
        raise ValueError(f"an array of {dtype}; make it one of numbers, or a list")
    return dtype


def _generator(state: dict[str, Any]) -> np.random.Generator:
    """Return a generator of random numbers."""
    parts = [*state.values(), *dict.values(state["state"])]
    for part in parts:
        if type(part) not in (*PLAIN, dict, np.ndarray) or (type(part) is np.ndarray and part.dtype.hasobject):
            raise ValueError("a generator with a state that is not numpy's")
    if state["bit_generator"] not in GENERATORS:
        raise ValueError("a generator that is not numpy's")
    made = np.random.Generator(getattr(np.random, state["bit_generator"])(0))
    made.bit_generator.state = state
    return made


def _fill(made: Any, state: Any) -> None:
    """Set the attributes of an object, those in slots too, without its setters."""
    for part in state if type(state) is tuple else (state,):
        for name, value in dict.items({} if part is None else part):
            if type(slot := getattr_static(type(made), name, None)) is MemberDescriptorType:
                slot.__set__(made, value)
            else:
                object.__getattribute__(made, "__dict__")[name] = value
