"""Changes to a signal: its power."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_channels, as_positive


def scaled_to_power(signal: ArrayLike, power: float) -> np.ndarray:
    """Scale a signal so that its mean square is `power`.

    Parameters
    ----------
    signal : array_like, shape (n_samples,) or (n_channels, n_samples)
        The signal, not all zeros.
    power : float
        Mean square wanted, above 0; of several channels, the mean over them.

    Returns
    -------
    ndarray, shape of `signal`
        The scaled signal.

    Raises
    ------
    ValueError, TypeError
        If the signal is silent or not finite, or the power is not above 0.

    Examples
    --------
    >>> scaled_to_power([3.0, -4.0], 50.0).tolist()
    [6.0, -8.0]
    """
    samples = as_channels(signal, "signal")
    wanted = as_positive(power, "power")
    peak = np.max(np.abs(samples))
    if peak == 0:
        raise ValueError("signal must not be all zeros: no scale gives silence a power")
    # Dividing by the peak first keeps the squares of very small or large samples within range.
    unit = samples / peak
    return unit * np.sqrt(wanted / np.mean(unit**2))
