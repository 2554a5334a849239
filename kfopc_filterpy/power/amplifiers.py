"""Amplifier models without memory: linear, hard clip, soft saturation.

The rated power of a controller (a mean square) and the amplitude limit of an amplifier are separate parameters.
``sqrt(2 rated_power)`` relates them for a sine only; Gaussian noise at its rated power exceeds that limit 15.7 % of
the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_positive, as_returned
from ..core.calls import amplify_all, in_parts
from ..core.run_loop import HARD_CLIP, LINEAR, SOFT_SATURATION

# The structure of the core, see anc.h.
MODEL = np.dtype([(name, np.float64) for name in ("kind", "limit", "sharpness")])


@dataclass(frozen=True)
class _Amplifier:
    """Base of the amplifier models: callable on numbers and arrays."""

    kind: ClassVar[int] = LINEAR

    @property
    def model(self) -> np.ndarray:
        """Record of kind, limit and sharpness for the compiled loop."""
        limit, sharpness = getattr(self, "limit", math.inf), getattr(self, "sharpness", 1.0)
        return np.array([(self.kind, limit, sharpness)], MODEL)

    def __call__(self, signal: ArrayLike) -> Any:
        """Return the output for `signal`, a number or an array of any shape."""
        array = np.asarray(signal, dtype=np.float64, order="C")
        model, out = self.model, np.empty(array.shape)
        in_parts(amplify_all, (model.ctypes.data,), array, out)
        return out if array.ndim else float(out)


@dataclass(frozen=True)
class LinearAmplifier(_Amplifier):
    """Amplifier of unit gain without a limit.

    Examples
    --------
    >>> from kfopc_filterpy import LinearAmplifier
    >>> LinearAmplifier()(3.0)
    3.0
    """


@dataclass(frozen=True)
class HardClipAmplifier(_Amplifier):
    """Amplifier of unit gain that clips at an amplitude.

    Parameters
    ----------
    limit : float
        Largest output amplitude; with ``sqrt(2 rated_power)``, a sine of the rated power is not clipped.

    Examples
    --------
    >>> from kfopc_filterpy import HardClipAmplifier
    >>> HardClipAmplifier(limit=1.0)([0.5, -2.0])
    array([ 0.5, -1. ])
    """

    limit: float
    kind: ClassVar[int] = HARD_CLIP

    def __post_init__(self) -> None:
        object.__setattr__(self, "limit", as_positive(self.limit, "limit"))


@dataclass(frozen=True)
class SoftSaturationAmplifier(_Amplifier):
    r"""Amplifier that saturates smoothly (Rapp's model), :math:`y / (1 + |y/a|^{2p})^{1/2p}`.

    Parameters
    ----------
    limit : float
        Amplitude a that the output approaches.
    sharpness : float, default 2
        Exponent p; the larger, the closer to a hard clip.

    References
    ----------
    C. Rapp, "Effects of HPA-nonlinearity on a 4-DPSK/OFDM-signal for a digital sound broadcasting system", 1991.

    Examples
    --------
    >>> from kfopc_filterpy import SoftSaturationAmplifier
    >>> round(SoftSaturationAmplifier(limit=1.0)(1.0), 4)  # 2 ** -0.25
    0.8409
    """

    limit: float
    sharpness: float = 2.0
    kind: ClassVar[int] = SOFT_SATURATION

    def __post_init__(self) -> None:
        object.__setattr__(self, "limit", as_positive(self.limit, "limit"))
        object.__setattr__(self, "sharpness", as_positive(self.sharpness, "sharpness"))


Amplifier = Callable[[Any], Any]  # any function of a sample
Amplifiers: TypeAlias = Amplifier | Sequence[Amplifier] | None  # one for all loudspeakers, or one for each


def compiled_model(amplifier: Amplifier | None) -> np.ndarray | None:
    """Return a model's record for the compiled loop, linear for None; return None for a user's function or subclass."""
    if amplifier is None:
        return LinearAmplifier().model
    if isinstance(amplifier, type):
        raise TypeError(f"amplifier must be an object, such as HardClipAmplifier(limit=1.0), got {amplifier!r}")
    models = (LinearAmplifier, HardClipAmplifier, SoftSaturationAmplifier)
    return amplifier.model if isinstance(amplifier, models) and type(amplifier) in models else None


def amplified_sample(amplifier: Amplifier, y: float) -> float:
    """Return a sample after a user's amplifier; ValueError if it is not finite."""
    played = as_returned(amplifier(y), "amplifier")
    if not math.isfinite(played):
        raise ValueError(f"amplifier must return a finite number, got {played} for {y}")
    return played


def amplified_signal(amplifier: Amplifier | None, y: np.ndarray) -> np.ndarray:
    """Return a signal, (n_samples,), after an amplifier; a user's function gets it sample by sample."""
    if amplifier is None:
        return y
    if compiled_model(amplifier) is not None:
        return np.asarray(amplifier(y))
    return np.array([amplified_sample(amplifier, sample) for sample in y.tolist()])


def _each(amplifier: Any, n_loudspeakers: int) -> list[Any]:
    """Return what is given for each loudspeaker: a sequence, or one for all."""
    return list(amplifier) if isinstance(amplifier, Sequence) else [amplifier] * n_loudspeakers


def _or_each(n_loudspeakers: int) -> str:
    """Return the words for what may also be given for each loudspeaker."""
    return f", or one for each of the {n_loudspeakers} loudspeakers" if n_loudspeakers > 1 else ""


def amplifier_of_each(amplifier: Any, n_loudspeakers: int) -> list[Any]:
    """Return the amplifier of each loudspeaker, a function or None, from one for all or one for each."""
    each = _each(amplifier, n_loudspeakers)
    if len(each) != n_loudspeakers or not all(one is None or callable(one) for one in each):
        or_each = _or_each(n_loudspeakers)
        raise TypeError(f"amplifier must be a function of a sample{or_each}, or None, got {amplifier!r}")
    return each


def amplifier_models(amplifier: Amplifier | Sequence[Amplifier | None] | None, n_loudspeakers: int) -> np.ndarray:
    """Return kind, limit and sharpness of the amplifier models of all loudspeakers, (J, 3)."""
    models = [compiled_model(one) for one in _each(amplifier, n_loudspeakers)]
    if len(models) != n_loudspeakers or any(model is None for model in models):
        raise TypeError(
            "amplifier must be None or one of kfopc_filterpy's amplifier models, such as HardClipAmplifier(limit=1.0)"
            f"{_or_each(n_loudspeakers)}, got {amplifier!r}"
        )
    return np.array(models).view(np.float64).reshape(n_loudspeakers, -1)
