"""Models of the primary and secondary path: band-pass filters, user taps, and perturbed copies of them.

Systems are python-control systems with one input and one output, in discrete time with `dt = 1/fs`. Tap arrays are
accepted wherever a system is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .._taps import path_taps as path_taps
from .._taps import sampling_rate
from .._types import PathModel
from .._validate import as_band, as_count, as_number, as_positive, as_signal

if TYPE_CHECKING:
    import control


def bandpass_path(n_taps: int, band: tuple[float, float] = (20.0, 5000.0), *, fs: float) -> control.TransferFunction:
    """Design a linear-phase band-pass path with a Hamming window, the path model of the paper's simulations.

    The paper uses 20-5000 Hz with 128 taps (primary) and 32 taps (secondary). So few taps cannot realise an edge of
    20 Hz; `achieved_band` shows what they do realise.

    Parameters
    ----------
    n_taps : int
        Length of the impulse response, at least 3. Its delay is ``(n_taps - 1) / 2`` samples.
    band : (float, float), default (20.0, 5000.0)
        Pass band (low, high) in Hz. ``low = 0`` gives a low-pass; ``high = fs/2`` gives a high-pass, which needs an odd
        `n_taps`.
    fs : float
        Sample rate in Hz; the paper's is 16000.

    Returns
    -------
    control.TransferFunction
        The path, with ``dt = 1/fs``.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range.

    Examples
    --------
    >>> from kfopc_filterpy.paths import path_taps
    >>> path = bandpass_path(32, fs=16000)
    >>> path.dt, path_taps(path).size
    (6.25e-05, 32)
    """
    from scipy.signal import firwin

    fs = as_positive(fs, "fs", unit="Hz")
    n_taps = as_count(n_taps, "n_taps", minimum=3)
    low, high = as_band(band, fs)
    if low == 0 and high == fs / 2:
        raise ValueError(f"band must not be all of 0 to fs/2, ({low:g}, {high:g}) Hz: for a flat path use fir_path")
    if high == fs / 2 and n_taps % 2 == 0:
        raise ValueError(f"n_taps must be odd for a band that reaches fs/2, got {n_taps}; use {n_taps + 1}")
    edges = [edge for edge in (low, high) if 0 < edge < fs / 2]
    return fir_path(firwin(n_taps, edges, pass_zero=low == 0, fs=fs), fs)


def fir_path(taps: ArrayLike, fs: float) -> control.TransferFunction:
    """Make a python-control system from an impulse response.

    Parameters
    ----------
    taps : array_like, shape (n_taps,)
        Impulse response, earliest sample first.
    fs : float
        Sampling rate in Hz.

    Returns
    -------
    control.TransferFunction
        ``taps[0] + taps[1] z^-1 + ...`` with ``dt = 1/fs``.

    Raises
    ------
    TypeError, ValueError
        If the taps are not a finite one-dimensional array or are all zero, or `fs` is not positive.

    Examples
    --------
    >>> path = fir_path([0.0, 1.0, 0.5], 8000.0)
    >>> path_taps(path)
    array([0. , 1. , 0.5])
    """
    from control import TransferFunction

    taps = as_signal(taps, "taps")
    if not np.any(taps):
        raise ValueError("taps must not all be zero: such a path carries no sound")
    fs = as_positive(fs, "fs", unit="Hz")
    return TransferFunction(taps, np.eye(1, taps.size)[0], 1 / fs)


def perturbed_path(
    path: PathModel,
    *,
    gain_db: float = 0.0,
    phase_deg: float = 0.0,
    delay_samples: float = 0.0,
    fs: float | None = None,
) -> control.TransferFunction:
    """Return a copy of a path with another gain, phase and delay, to study a mismatched estimate.

    The response wanted is ``H(f) * 10^(gain_db/20) * exp(j phase) * exp(-j 2 pi f delay)``. Gains, whole samples of
    delay and multiples of 180 degrees are exact. Any other phase (the same at all frequencies, a Hilbert-type rotation)
    and fractions of a sample are fitted by least squares over 0.01 fs to 0.45 fs with 64 additional taps. For 90
    degrees on the paper's 32-tap path at 16 kHz the fit is accurate to 2.5 degrees and 0.4 dB over 300-4500 Hz, and to
    1.5 degrees over 500-4500 Hz; for fractional delays it is better than 0.1 degree.

    Parameters
    ----------
    path : control.TransferFunction or array_like, shape (n_taps,)
        The path to copy (finite impulse response).
    gain_db : float, default 0.0
        Gain in dB.
    phase_deg : float, default 0.0
        Phase in degrees, positive for a lead; 90 is the stability bound of filtered-reference control.
    delay_samples : float, default 0.0
        Delay in samples. A negative delay advances the path, as far as its own delay allows.
    fs : float, optional
        Sampling rate in Hz, needed for a tap array.

    Returns
    -------
    control.TransferFunction
        The perturbed copy, with ``dt = 1/fs``.

    Raises
    ------
    ValueError
        If no causal filter comes within -20 dB of the response wanted, because the delay of the path is too short.

    Examples
    --------
    >>> louder = perturbed_path([0.0, 1.0, 0.5], gain_db=20.0, delay_samples=1, fs=8000.0)
    >>> path_taps(louder)
    array([ 0.,  0., 10.,  5.])
    """
    fs = sampling_rate(path, fs)
    taps = path_taps(path) * 10 ** (as_number(gain_db, "gain_db", unit="dB") / 20)
    phase = as_number(phase_deg, "phase_deg", unit="degrees") % 360.0
    delay = as_number(delay_samples, "delay_samples")
    if phase == 180.0:
        taps, phase = -taps, 0.0
    if phase == 0.0 and delay >= 0 and delay == round(delay):
        return fir_path(np.pad(taps, (round(delay), 0)), fs)
    return fir_path(_rotated(taps, np.deg2rad(phase), delay), fs)


def _rotated(taps: np.ndarray, phase: float, delay: float) -> np.ndarray:
    """Return causal taps, fitted to `taps` with a constant phase (rad) and a delay (samples) added."""
    n = taps.size + max(int(np.ceil(delay)), 0) + 64
    omega = np.linspace(0.0, np.pi, 4 * n)
    basis = np.exp(-1j * np.outer(omega, np.arange(n)))
    wanted = (basis[:, : taps.size] @ taps) * np.exp(1j * (phase - omega * delay))
    band = (omega >= 0.02 * np.pi) & (omega <= 0.9 * np.pi)
    # A real filter cannot rotate 0 Hz and fs/2. A small weight there keeps the gain from growing without bound.
    weight = np.where(band, 1.0, 0.1)[:, None]
    system = np.vstack([weight * basis.real, weight * basis.imag])
    target = np.concatenate([weight[:, 0] * wanted.real, weight[:, 0] * wanted.imag])
    fitted = np.linalg.lstsq(system, target, rcond=None)[0]
    error = np.linalg.norm((basis @ fitted - wanted)[band]) / np.linalg.norm(wanted[band])
    if error > 0.1:
        raise ValueError(
            f"phase_deg and delay_samples cannot be realised causally on this path: the best fit is "
            f"{20 * np.log10(error):.0f} dB off; use a path with more delay, or a larger delay_samples"
        )
    return fitted
