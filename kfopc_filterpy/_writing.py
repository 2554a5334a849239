"""Files that are written whole: beside their place, forced to the disk, and then renamed.

Even if the disk is full, the process is killed or a file is written onto its own source, either the old file or the
whole new one is there. Files that belong together move to their places once all of them are written.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

LONGEST_NAME = 200  # bytes: file systems take 255, and ours is longer by 23
ABANDONED_S = 3600.0  # what is unfinished and as old as this belongs to a process that was killed


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a file beside `path`. It takes that name when the block ends; if the block raises, it is removed.

    What is there and is no file, such as a pipe, stays what it is: it gets the bytes.
    """
    place = Path(os.path.realpath(path))  # a link stays a link
    if not place.parent.is_dir():
        raise FileNotFoundError(f"the folder {place.parent} does not exist: make it first")
    if place.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name a file in it")
    if place.exists() and not place.is_file():
        with tempfile.TemporaryFile() as made:
            yield made
            made.seek(0)
            with open(place, "wb") as to:
                shutil.copyfileobj(made, to)
        return
    short = place.name.encode()[:LONGEST_NAME].decode(errors="ignore")
    _remove_abandoned(place.parent, short)
    part = place.with_name(f".{short}.{os.urandom(8).hex()}.part")
    try:
        with open(part, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if place.exists():
            shutil.copymode(place, part)
        os.replace(part, place)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, str(part)):
            error.filename = str(path)
        raise
    if os.name != "nt":  # Windows does not open folders
        folder = os.open(place.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name is on the disk too
        finally:
            os.close(folder)


@contextmanager
def replacing_files(folder: Path) -> Iterator[Path]:
    """Yield an empty folder. When the block ends, its files take the same places in `folder`; other files there stay.

    Those at the top of `folder` move last: a page that is there has its sounds.
    """
    _remove_abandoned(folder, "files")
    made = Path(tempfile.mkdtemp(prefix=".files.", suffix=".part", dir=folder))
    try:
        yield made
        names = [path.relative_to(made) for path in made.rglob("*") if path.is_file()]
        for place in (folder / name for name in names):
            if place.exists() and not place.is_file():
                raise FileExistsError(f"{place} is there and is no file: remove it, or choose another folder")
        for name in sorted(names, key=lambda name: len(name.parts), reverse=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(made / name, folder / name)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def made_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder, which is made with its parents if it is not there."""
    path = Path(folder)
    if path.is_file():
        raise NotADirectoryError(f"{path} is a file: name a folder")
    path.mkdir(parents=True, exist_ok=True)
    return path


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raise OSError if no file can be written in a folder."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def prepare_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder, made unless it is there, after a check that it can be written: better before a run than after.

    Raises
    ------
    OSError
        The folder cannot be made or written.
    """
    try:
        path = made_folder(folder)
        require_writable(path)
    except OSError as error:
        raise OSError(f"folder {str(folder)!r} cannot be written ({error}); choose another output folder") from error
    return path


def write_whole(path: Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    with replacing(path) as file:
        file.write(text.encode())


def jsonable(value: object, where: str = "value") -> Any:
    """Return `value` in strict JSON's types: arrays as lists, numpy's scalars as numbers, NaN and Inf as None.

    Examples
    --------
    >>> jsonable({"power": np.float64(0.8), "taps": np.array([1.0, np.nan])})
    {'power': 0.8, 'taps': [1.0, None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): jsonable(item, f"{where}, {key!r}") for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        return [jsonable(item, where) for item in value]
    raise TypeError(f"{where} must hold numbers, text, arrays, lists or mappings, got {type(value).__name__}")


def _remove_abandoned(folder: Path, name: str) -> None:
    for left in folder.glob(f".{escape(name)}.*.part"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > ABANDONED_S:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
