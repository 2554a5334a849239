"""Argument checks shared by every module. Each error says what was wrong, what was expected and how to fix it."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Iterable
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Choice = TypeVar("Choice")

_LARGEST_OF_RATIO = 50_000  # of the whole numbers of a ratio of sampling rates
_LOWEST_RATE, _HIGHEST_RATE = 1e-3, 1e9  # Hz; others are not sampling rates of signals


def as_signal(value: Any, name: str, *, min_length: int = 1, length: int | None = None) -> np.ndarray:
    """Return `value` as a contiguous, finite, one-dimensional float64 array, or raise a clear error."""
    array = as_real_array(value, name)
    if array.ndim != 1:
        raise ValueError(
            f"{name} must be one-dimensional, (n,), got shape {array.shape}; "
            f"pass one channel, e.g. {name}[{', '.join('0' * (array.ndim - 1)) or 0}] or {name}.ravel()"
        )
    if length is not None and array.size != length:
        raise ValueError(f"{name} must have {length} values, got {array.size}")
    if array.size < min_length:
        raise ValueError(f"{name} must have at least {min_length} value(s), got {array.size}")
    require_finite(array, name)
    return np.ascontiguousarray(array)


def as_real_array(value: Any, name: str) -> np.ndarray:
    """Return `value` as a float64 array of any shape, NaN and Inf included."""
    try:
        array = np.asarray(value)
        real = array.astype(np.float64, copy=False) if _may_be_real(array) else None
        if real is not None and isinstance(value, np.ma.MaskedArray):
            real = np.where(np.ma.getmaskarray(value), np.nan, real)  # a masked value is a missing one
    except (TypeError, ValueError) as error:
        ragged = ", whose rows differ in length" if "inhomogeneous" in str(error) else ""
        raise TypeError(f"{name} must be a sequence of real numbers, got {_kind_of(value)}{ragged}") from error
    except OverflowError as error:  # an integer of Python
        raise ValueError(f"{name} must be finite, but holds a number that is too large for a float") from error
    if real is None:
        got = {"c": "complex ones", "O": "text, dates or masked values among them"}.get(
            array.dtype.kind, _kind_of(value)
        )
        raise TypeError(f"{name} must be a sequence of real numbers, got {got}")
    return real


def _kind_of(value: Any) -> str:
    """Return the name of the type of a value, and how to read a file whose path was given in place of its content."""
    suffix = Path(value).suffix if isinstance(value, str | os.PathLike) else ""
    is_file = suffix[1:2].isalpha()  # no digit, as in "1.5"
    remedy = ": read the file with paths.read_path (impulse responses) or signals.read_recording" if is_file else ""
    return type(value).__name__ + remedy


def as_finite_array(value: Any, name: str) -> np.ndarray:
    """Return `value` as a float64 array of any shape without NaN and Inf."""
    array = as_real_array(value, name)
    require_finite(array, name)
    return array


def _may_be_real(array: np.ndarray) -> bool:
    """Return False for what numpy would take: complex numbers without their imaginary part, text, dates, masks."""
    if array.dtype.kind != "O":
        return array.dtype.kind not in "cSUMm"
    return not any(
        isinstance(value, str | bytes | np.datetime64 | np.timedelta64 | np.ma.MaskedArray) for value in array.flat
    )


def as_channels(value: Any, name: str) -> np.ndarray:
    """Return `value` as a contiguous, finite float64 array, (n_samples,) or (n_channels, n_samples)."""
    array = as_real_array(value, name)
    if array.ndim not in (1, 2):
        raise ValueError(f"{name} must be (n_samples,) or (n_channels, n_samples), got shape {array.shape}")
    if array.size == 0:
        raise ValueError(f"{name} must have at least 1 value(s), got shape {array.shape}")
    if array.ndim == 2:
        require_channels_lead(array, name)
    require_finite(array, name)
    return np.ascontiguousarray(array)


def require_channels_lead(array: np.ndarray, name: str) -> None:
    """Raise ValueError if the last two axes hold more channels than samples: the axes are probably swapped."""
    n_channels, n_samples = array.shape[-2:]
    if n_channels > n_samples:
        raise ValueError(
            f"{name} must have its channels first, (n_channels, n_samples), got {n_channels} channels of "
            f"{n_samples} sample(s); transpose it, {name}.T"
        )


def require_finite(array: Any, name: str, *, fs: float | None = None, remedy: str = "") -> None:
    """Raise ValueError if `array` holds NaN or Inf; the message gives the first one's index and, at a rate `fs`, time."""
    finite = np.isfinite(array)
    if not np.all(finite):
        if np.ndim(array) == 0:
            raise ValueError(f"{name} must be finite, got {array}")
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        at = where[0] if len(where) == 1 else where
        time = "" if fs is None else f", {where[-1] / fs:.6g} s"
        mend = f"; {remedy}" if remedy else ""
        raise ValueError(f"{name} must be finite, but holds NaN or Inf (first at index {at}{time}){mend}")


def as_number(value: Any, name: str, *, unit: str = "") -> float:
    """Return `value` as a finite float."""
    if isinstance(value, float) and math.isfinite(value):  # fast path, for numpy's floats too: called for every sample
        return float(value)
    unit = f" in {unit}" if unit else ""
    if (
        value is None
        or isinstance(value, str | bytes | bool | np.bool_)
        or (np.ndim(value) != 0 and np.size(value) != 1)
    ):
        raise TypeError(f"{name} must be a single number{unit}, got {value!r}")
    try:
        number = float(as_real_array(value, name).reshape(()))
    except TypeError as error:
        raise TypeError(f"{name} must be a single number{unit}, got {value!r}") from error
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {'a masked value' if np.ma.is_masked(value) else number}")
    return number


def as_returned(value: Any, source: str) -> float:
    """Return what a user's function returned as a float, NaN included; `source` names the function."""
    try:
        return float(np.asarray(value).reshape(()))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{source} must return one number, got {value!r}") from error


def as_positive(value: Any, name: str, *, unit: str = "") -> float:
    """Return `value` as a finite float above zero."""
    number = as_number(value, name, unit=unit)
    if number <= 0:
        raise ValueError(f"{name} must be greater than 0{' ' + unit if unit else ''}, got {number:g}")
    return number


def as_rate(value: Any, name: str) -> float:
    """Return `value` as a sampling rate in Hz of a recorded signal."""
    rate = as_positive(value, name, unit="Hz")
    if not _LOWEST_RATE <= rate <= _HIGHEST_RATE:
        raise ValueError(
            f"{name} must be a sampling rate from {_LOWEST_RATE:g} to {_HIGHEST_RATE:g} Hz, got {rate:g} Hz"
        )
    return rate


def same_rate(rate: float, fs: float) -> bool:
    """Return whether two sampling rates in Hz are equal to rounding."""
    return abs(rate - fs) <= 1e-9 * fs


def per_loudspeaker(
    value: Any, n_loudspeakers: int, name: str, check: Callable[[Any, str], float] = as_positive
) -> np.ndarray:
    """Return one number, or one for each loudspeaker, as (J,); each must pass `check`."""
    return per_channel(value, n_loudspeakers, "loudspeakers", name, check)


def per_channel(
    value: Any, size: int, what: str, name: str, check: Callable[[Any, str], float] = as_positive
) -> np.ndarray:
    """Return one number, or one for each channel, as (size,); each must pass `check`. `what` names the channels."""
    if isinstance(value, str) or not np.iterable(value):
        return np.full(size, check(value, name))
    numbers = as_real_array(value, name)
    if numbers.shape != (size,):
        several = f"one number or one for each of the {size} {what}, ({size},)"
        wanted = f"one number for 1 {what.removesuffix('s')}" if size == 1 else several
        raise ValueError(f"{name} must be {wanted}, got shape {numbers.shape}")
    return np.array([check(number, name) for number in numbers])


def as_nonnegative(value: Any, name: str, *, unit: str = "") -> float:
    """Return `value` as a finite float of at least zero."""
    number = as_number(value, name, unit=unit)
    if number < 0:
        raise ValueError(f"{name} must not be negative, got {number:g}{' ' + unit if unit else ''}")
    return number


def as_count(value: Any, name: str, *, minimum: int = 1) -> int:
    """Return `value` as an int of at least `minimum`."""
    try:
        number: Any = None if isinstance(value, bool) else value  # True is no 1
        count = operator.index(number)
    except TypeError as error:
        raise TypeError(f"{name} must be a whole number, got {value!r}") from error
    if count < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {count}")
    return count


def as_choice(value: Any, name: str, choices: Iterable[Choice]) -> Choice:
    """Return `value` if it is one of `choices`."""
    known = tuple(choices)
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, known))}, got {value!r}")
    return value


def as_band(band: Any, fs: float) -> tuple[float, float]:
    """Return `band` as (low, high) in Hz with 0 <= low < high <= fs/2."""
    try:
        low, high = (as_number(edge, "band", unit="Hz") for edge in band)
    except (TypeError, ValueError) as error:
        raise ValueError(f"band must be a pair (low, high) in Hz, got {band!r}") from error
    if not 0 <= low < high <= fs / 2:
        raise ValueError(f"band must satisfy 0 <= low < high <= fs/2 = {fs / 2:g} Hz, got ({low:g}, {high:g}) Hz")
    return low, high


def as_rate_ratio(fs: float, new_fs: float) -> tuple[int, int]:
    """Return `new_fs / fs` as a ratio (up, down) of whole numbers."""
    ratio = Fraction(new_fs / fs).limit_denominator(_LARGEST_OF_RATIO)
    # An irrational ratio comes within 2e-10.
    if not 0 < ratio.numerator <= _LARGEST_OF_RATIO or abs(fs * ratio - new_fs) > 1e-12 * new_fs:
        raise ValueError(
            f"sample rates must be in a ratio of whole numbers up to {_LARGEST_OF_RATIO}, got {fs:g} and {new_fs:g} Hz; "
            "round them to whole Hz"
        )
    return ratio.numerator, ratio.denominator


def as_sample_count(duration_s: Any, fs: Any, name: str) -> int:
    """Return a duration in seconds as a number of samples, at least one."""
    rate = as_positive(fs, "fs", unit="Hz")
    duration = as_positive(duration_s, name, unit="s")
    if not math.isfinite(duration * rate):
        raise ValueError(f"{name} must be a finite number of samples, got {duration:g} s at {rate:g} Hz")
    count = round(duration * rate)
    if count < 1:
        raise ValueError(f"{name} must be at least one sample, {1 / rate:g} s, got {duration:g} s")
    return count


def as_generator(rng: Any) -> np.random.Generator:
    """Return a numpy Generator from a seed or a Generator. The global random state is never used."""
    if rng is None:
        raise TypeError("rng must be a seed or a numpy.random.Generator, so that a run can be repeated; got None")
    return np.random.default_rng(rng)


def require_existing(path: str | os.PathLike[str]) -> None:
    """Raise FileNotFoundError if there is no such file."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} does not exist or is not a file; the current folder is {Path.cwd()}")


def how_to_install(extra: str) -> str:
    """Return how to install an extra: the package is on no index, so its clone is named."""
    return f'install the extra `{extra}`, in the clone: python -m pip install -e ".[{extra}]"'


def optional_module(name: str, extra: str, what: str) -> Any:
    """Return a module of an extra; if it is missing, the error says that `what` needs it, and how to install it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ModuleNotFoundError(f"{what} needs {name}: {how_to_install(extra)}", name=name) from error
