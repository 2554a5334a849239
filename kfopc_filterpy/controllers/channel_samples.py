"""Samples of several channels, and amplifiers, one for each loudspeaker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_real_array

if TYPE_CHECKING:
    from ..power.amplifiers import Amplifier


def channel_sample(value: ArrayLike, size: int, name: str, what: str) -> np.ndarray:
    """Return a sample of each channel, (size,), finite; `what` names the channels in an error."""
    sample = as_real_array(value, name).reshape(-1)
    if sample.size != size:
        raise ValueError(f"{name} must have a value for each of the {size} {what}, got {sample.size}")
    for channel in np.flatnonzero(~np.isfinite(sample)):
        raise ValueError(f"{name} must be finite, but that of {what[:-1]} {channel} is {sample[channel]}")
    return np.ascontiguousarray(sample)


def amplifier_functions(amplifier: Amplifier | Sequence[Amplifier] | None, n_loudspeakers: int) -> list[Any] | None:
    """Return the functions of a sample that stand for the amplifiers, one for each loudspeaker; None without any."""
    if amplifier is None:
        return None
    each = list(amplifier) if isinstance(amplifier, Sequence) else [amplifier] * n_loudspeakers
    if len(each) != n_loudspeakers or not all(callable(one) for one in each):
        raise TypeError(
            f"amplifier must be a function of a sample, or one for each of the {n_loudspeakers} loudspeakers, "
            f"got {amplifier!r}"
        )
    return each


def push_sample(line: np.ndarray, sample: np.ndarray) -> None:
    """Add the newest sample of several channels to a delay line in which the channels of a sample are adjacent."""
    line[sample.size :] = line[: line.size - sample.size]
    line[: sample.size] = sample[: line.size]
