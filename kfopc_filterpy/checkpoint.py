"""Checkpoints: a filter, a controller or a supervisor in a file, from which an interrupted run continues to the bit.

A file has four parts::

    kfopc checkpoint 3 of kfopc_filterpy 2.0: 4711\n    the format, the version that wrote it, the pickle's size
    a pickle                                            the object without the memory of its arrays, see `_pickles`
    memory of the arrays                                each begins at a multiple of 64 bytes, a cache line
    64 hexadecimal digits                               SHA-256 of everything before them

As for a copy, ``__getstate__`` decides what is stored of an object. What an object holds twice is still one thing, but
views of one memory become arrays of their own, as in a deep copy.

Loading calls nothing that a file names, and arrays are views of the bytes that were read, so a file cannot claim more
memory than it has. But the numbers in a state are not checked, and compiled code trusts them when the object is used.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, Self

from . import _pickles
from ._writing import replacing
from .core.library import LINE, at_cache_line

FORMAT = 3
DIGEST = 64  # hexadecimal digits of SHA-256


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
            An attribute that cannot be stored, such as a lambda, an open file, a set or a bound method. The message
            names it. Nothing was written.

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
        content = _content(self)
        with replacing(path) as file:
            file.write(content)
            file.write(hashlib.sha256(content).hexdigest().encode())

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, trusted: Iterable[Any] = ()) -> Self:
        """Return what `save` wrote into a file: an object of this class, or of one derived from it.

        It continues to the bit with the same versions of this package, numpy and scipy. Otherwise it
        continues from the same state, but rounding may differ.

        Parameters
        ----------
        path : path
            Name of the file.
        trusted : iterable of classes and functions, optional
            Your own classes and functions that are part of the object, such as the class of a controller in a
            `VerifiedController`, or an amplifier. The class on which `load` is called is trusted anyway. Objects of
            your classes get their attributes; neither ``__new__`` nor ``__init__`` is called, and no setter.

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
            version of the package with another major or minor number; that names a class that is not trusted. It is a
            `CheckpointError`.

        Notes
        -----
        Loading calls nothing that the file names, and takes no more memory for arrays than the file has. The checksum
        finds damage, not intent. Compiled code trusts the numbers of a state: do not load files that you do not trust.

        See Also
        --------
        save : It has an example.
        """
        return _load(cls, Path(path), trusted)


def _kind() -> str:
    """Return what a file of this version begins with: versions with another number may go on in another way."""
    series = import_module(__package__).__version__.split(".")[:2]
    return f"kfopc checkpoint {FORMAT} of {__package__} {'.'.join(series)}: "


def _content(value: Any) -> bytes:
    """Return what is in a file, without the checksum."""
    pickled, arrays = _pickles.pickled(value)
    first = f"{_kind()}{len(pickled)}\n".encode()
    return b"".join((first, pickled, bytes(-(len(first) + len(pickled)) % LINE), arrays))


def _load(kind: type[Any], path: Path, trusted: Iterable[Any]) -> Any:
    """Return the object in a file; it must be one of `kind`."""
    memory = _read(path)
    first = bytes(memory[:100]).partition(b"\n")[0]
    begins, _, size = first.decode(errors="replace").rpartition(" ")
    if f"{begins} " != _kind():
        raise CheckpointError(
            f"{path} is a {begins.rstrip(':')!r}, and this version reads {_kind()[:-2]!r} only: load the file with the "
            "version that wrote it, or begin anew"
        )
    try:
        end = len(first) + 1 + int(size)
        pickled, arrays = bytes(memory[len(first) + 1 : end]), memory[end + -end % LINE : -DIGEST]
        made = _pickles.unpickled(pickled, arrays, (kind, *trusted))
    except _pickles.NotTrusted as error:
        raise CheckpointError(f"{path} {error}") from None
    except Exception as error:  # a file with the right checksum can hold anything
        raise CheckpointError(
            f"{path} has a correct checksum, but `save` of this version does not write such a file "
            f"({type(error).__name__}: {error}): load it with the version that wrote it"
        ) from error
    if not isinstance(made, kind):
        raise TypeError(
            f"{path} has a {type(made).__name__}, which is no {kind.__name__}: call {type(made).__name__}.load"
        )
    return made


def _read(path: Path) -> memoryview:
    """Return the bytes of a file, in memory that begins at a cache line, if they agree with the checksum."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: look for it, or begin anew without a checkpoint")
    with open(path, "rb") as file:
        memory = at_cache_line(os.fstat(file.fileno()).st_size).data
        memory = memory[: file.readinto(memory)]
    if not memory:
        raise CheckpointError(f"{path} is empty: nothing was saved in it; load an older file, or begin anew")
    if not bytes(memory[:LINE]).startswith(b"kfopc checkpoint "):
        raise CheckpointError(f"{path} is no checkpoint, or its first bytes are damaged: load what `save` wrote")
    if hashlib.sha256(memory[:-DIGEST]).hexdigest().encode() != memory[-DIGEST:]:
        raise CheckpointError(
            f"{path} is damaged or cut short: its checksum differs; load an older file, or copy it again"
        )
    return memory
