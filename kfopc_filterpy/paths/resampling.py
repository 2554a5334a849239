"""Resampling of paths: the same frequency response at another sampling rate."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .._taps import is_system, path_taps, sampling_rate
from .._types import PathModel
from .._validate import as_positive, as_rate_ratio
from .models import fir_path

if TYPE_CHECKING:
    import control

_FILTER_REACH = 10  # samples of the lower rate to each side: the filter that `scipy.signal.resample_poly` designs
_LOST_AT_START = 1e-4  # share of the energy, -40 dB


def resample_path(path: PathModel, new_fs: float, *, fs: float | None = None) -> np.ndarray | control.TransferFunction:
    """Return a path at another sampling rate, with the same frequency response and the same delay in seconds.

    An impulse response is no recording. Resampled like one, it would keep its height, and its frequency response, a sum
    over all taps, would change by ``new_fs / fs``. So the taps are resampled by `scipy.signal.resample_poly` and
    multiplied by ``fs / new_fs``.

    Up to 80 % of the lower of the two frequencies ``fs/2``, the response differs from the old one by less than 0.4 % of
    its peak (0.03 dB), and by up to 1 % if the path hardly has a delay. Above that it falls off, and what the new rate
    cannot carry is removed.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        A path with a finite impulse response, earliest sample first.
    new_fs : float
        Sampling rate wanted, in Hz.
    fs : float, optional
        Present sampling rate in Hz: needed for a tap array; for a system it must agree with its ``dt``.

    Returns
    -------
    numpy.ndarray or control.TransferFunction
        Taps for taps, and for a system a system with ``dt = 1/new_fs``. The response lasts as long as the old one,
        and up to ten samples of the lower rate longer.

    Raises
    ------
    TypeError, ValueError
        If a rate is missing or not positive, the rates are not in a ratio of whole numbers up to 50000, or the system
        is continuous, has several channels or an infinite response.
    ValueError
        If more than -40 dB of the energy would come before the first sample. The filter that limits the band is
        symmetric, so a path that begins at once and reaches to ``fs/2`` has no causal equal at another rate. Delay all
        paths of the plant by the same number of samples, and the delay of one against the other stays.

    See Also
    --------
    scipy.signal.resample_poly : for recordings, which keep their height.

    Examples
    --------
    >>> from kfopc_filterpy.paths import frequency_response, resample_path
    >>> taps = [0.0] * 30 + [0.5, 0.2]
    >>> slower = resample_path(taps, 16000, fs=44100)
    >>> for path, rate in ((taps, 44100), (slower, 16000)):
    ...     print(frequency_response(path, [1000.0], fs=rate).round(4))
    [-0.2704+0.6441j]
    [-0.2706+0.6448j]
    """
    rate, new_rate = sampling_rate(path, fs), as_positive(new_fs, "new_fs", unit="Hz")
    taps = path_taps(path)
    if new_rate != rate:
        taps = _resampled(taps, rate, new_rate)
    return fir_path(taps, new_rate) if is_system(path) else taps


def _resampled(taps: np.ndarray, fs: float, new_fs: float) -> np.ndarray:
    """Return the taps at the new rate; refuse a path that would have to begin before its first sample."""
    from scipy.signal import resample_poly

    up, down = as_rate_ratio(fs, new_fs)
    # Silence on both sides takes what the symmetric filter spreads: whole turns of `down` samples in, `up` samples out.
    spread = _FILTER_REACH * max(up, down)
    turns = math.ceil(spread / (up * down))
    resampled = resample_poly(np.pad(taps, turns * down), up, down) * (fs / new_fs)
    early, rest = np.split(resampled, [turns * up])
    energy = np.sum(resampled**2)
    share = np.sum(early**2) / energy if energy > 0.0 else 0.0  # a silent path stays silent
    if share > _LOST_AT_START:
        raise ValueError(
            f"path must begin with more delay: {10 * np.log10(share):.1f} dB of its energy would come before the first "
            f"sample at {new_fs:g} Hz, more than -40 dB; put the same number of zeros, {_FILTER_REACH} samples of the "
            "lower rate, before each path of the plant"
        )
    return rest[: math.ceil((taps.size * up + spread) / down)]
