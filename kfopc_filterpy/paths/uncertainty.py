r"""Uncertainty of a secondary path, and the short filter that guards a controller against it.

The true path is :math:`S = (1 + \Delta)\hat S` with :math:`|\Delta(\omega)| \le \delta(\omega)`. A control filter that is
g times the best one for the disturbance estimate :math:`\hat d = e + \hat s * y` leaves, once the adaptation has settled,

.. math:: E = D\,\frac{1 - g}{1 + g\Delta}

This is stable if :math:`g\delta < 1`. It is never louder than without control if :math:`\delta \le 1`, for any g from 0
to 1.
Where :math:`\delta > 1`, only g = 0 is safe. Therefore :math:`g = 1 - \delta^6`: this costs next to nothing where the
path is known well, g vanishes where :math:`\delta` reaches 1, and :math:`g\delta` is at most 0.62.

A controller gets this g from a penalty on the control signal through the filter W with :math:`|W|^2 = (1 - g)/g`:

.. math:: \min_v E[(d - v * x')^2] + E[(v * W * x')^2]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_nonnegative, as_real_array, require_finite
from .channels import secondary_paths

N_FREQUENCIES = 257  # from 0 to fs/2
GUARD_TAPS = 48
SHARPNESS = 6  # g = 1 - delta^SHARPNESS
LEAST_SHARE = 0.03  # g is at least this; a zero would need an infinite penalty
SMALLEST_PENALTY = 1e-4  # |W|^2 is at least this; a zero would need an infinite impulse response


@dataclass(frozen=True)
class PathTolerance:
    """Tolerances of an estimated secondary path; they add up.

    Attributes
    ----------
    delay_samples : float, default 0
        Largest error of the delay in samples, early or late.
    phase_deg : float, default 0
        Largest error of the phase in degrees, at any frequency.
    gain_db : float, default 0
        Largest error of the gain in dB, too high or too low.

    Raises
    ------
    TypeError, ValueError
        A tolerance that is negative or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import PathTolerance
    >>> PathTolerance(phase_deg=60.0).relative_error(np.array([0.0, np.pi])).round(6)
    array([1., 1.])
    >>> PathTolerance(delay_samples=0.5).relative_error(np.array([0.0, np.pi / 3, np.pi])).round(3)
    array([0.   , 0.518, 1.414])
    """

    delay_samples: float = 0.0
    phase_deg: float = 0.0
    gain_db: float = 0.0

    def __post_init__(self) -> None:
        for name in ("delay_samples", "phase_deg", "gain_db"):
            as_nonnegative(getattr(self, name), name)

    def relative_error(self, omega: np.ndarray) -> np.ndarray:
        """Return the largest ``|S/S^ - 1|`` within the tolerances, at frequencies `omega` in radians per sample."""
        phase = np.minimum(np.deg2rad(self.phase_deg) + self.delay_samples * np.asarray(omega), np.pi)
        gain = 10.0 ** (self.gain_db / 20.0)
        return np.sqrt((gain - 1.0) ** 2 + 4.0 * gain * np.sin(phase / 2.0) ** 2)


HALF_A_SAMPLE = PathTolerance(delay_samples=0.5)  # what a careful identification may leave


def path_uncertainty(uncertainty: Any, secondary_path: Any) -> np.ndarray:
    """Return the largest relative error of a secondary path over frequency.

    Parameters
    ----------
    uncertainty : PathTolerance, float or array_like, optional
        Tolerances; or one relative error for all frequencies; or its values at evenly spaced frequencies from 0 to
        fs/2, (n_frequencies,); or measured paths, (M, n_taps) or (M, K, J, n_taps), whose largest distance from
        `secondary_path` counts. None means no uncertainty.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path.

    Returns
    -------
    ndarray, shape (257,)
        delta at evenly spaced frequencies from 0 to fs/2. With several channels, it bounds the matrix norm of the
        relative error: ``||(S - S^) pinv(S^)||``.

    Raises
    ------
    TypeError, ValueError
        An uncertainty that is negative, not finite, or none of the above; measured paths whose channels differ from
        those of `secondary_path`.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import path_uncertainty
    >>> measured = np.array([[0.0, 1.0, 0.0], [0.0, 0.8, 0.2]])  # on two days
    >>> path_uncertainty(measured, [0.0, 1.0, 0.0])[[0, 128, 256]].round(2)
    array([0.  , 0.28, 0.4 ])
    """
    estimate, _ = secondary_paths(secondary_path)
    if uncertainty is None:
        return np.zeros(N_FREQUENCIES)
    if isinstance(uncertainty, PathTolerance):
        return uncertainty.relative_error(np.linspace(0.0, np.pi, N_FREQUENCIES))
    if np.ndim(uncertainty) == 0:
        return np.full(N_FREQUENCIES, as_nonnegative(uncertainty, "secondary_path_uncertainty"))
    given = as_real_array(uncertainty, "secondary_path_uncertainty")
    require_finite(given, "secondary_path_uncertainty")
    if given.ndim > 1:
        return _distance(given, estimate)
    if given.size < 2 or np.any(given < 0.0):
        raise ValueError(
            "secondary_path_uncertainty must be zero or above at two or more frequencies from 0 to fs/2, "
            f"got {given.size} with a minimum of {given.min(initial=np.inf):g}"
        )
    return np.interp(np.linspace(0.0, 1.0, N_FREQUENCIES), np.linspace(0.0, 1.0, given.size), given)


def _distance(measured: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return the largest relative distance of measured paths from the estimate, at each frequency."""
    several = measured[:, np.newaxis, np.newaxis] if measured.ndim == 2 else measured
    if several.ndim != 4 or several.shape[1:3] != estimate.shape[:2] or 0 in several.shape:
        wanted = (
            "(M, n_taps)" if estimate.shape[:2] == (1, 1) else f"(M, {estimate.shape[0]}, {estimate.shape[1]}, n_taps)"
        )
        raise ValueError(
            f"secondary_path_uncertainty must be {wanted} if it holds M measured paths, got shape {measured.shape}"
        )
    omega = np.linspace(0.0, np.pi, N_FREQUENCIES)
    known = _response(estimate, omega)
    error = _response(several, omega) - known
    relative = _norm(error @ np.linalg.pinv(known))
    # The second term counts at frequencies at which the estimated path is zero, where the first one is zero too.
    least = _norm(error) / np.maximum(_norm(known), np.finfo(float).tiny)
    return np.maximum(relative, least).max(axis=0)


def relative_to(paths: np.ndarray, squared_error: np.ndarray) -> np.ndarray:
    """Return a bound on the relative error of paths (K, J, taps) from the squared errors of their responses.

    `squared_error` is (K, J, 257). With several paths the bound is ``||E||_F ||pinv(S^)||`` with the matrix E of the
    errors, as their phases are not known.
    """
    known = _response(paths, np.linspace(0.0, np.pi, N_FREQUENCIES))
    smallest = np.linalg.svd(known, compute_uv=False)[..., -1]  # 1/||pinv(S^)||
    return np.sqrt(squared_error.sum(axis=(0, 1))) / np.maximum(smallest, np.finfo(float).tiny)


def _norm(matrices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(matrices, ord=2, axis=(-2, -1))


def _response(paths: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Return the responses of paths (..., K, J, taps) as matrices (..., n_frequencies, K, J)."""
    waves = np.exp(-1j * omega[:, np.newaxis] * np.arange(paths.shape[-1]))
    return np.moveaxis(paths @ waves.T, -1, -3)


def guard_filter(uncertainty: np.ndarray) -> np.ndarray:
    """Return the filter W that guards a controller against an uncertainty, see `path_uncertainty`.

    Parameters
    ----------
    uncertainty : ndarray, shape (n_frequencies,)
        Largest relative error of the path at evenly spaced frequencies from 0 to fs/2.

    Returns
    -------
    ndarray, shape (48,)
        Minimum-phase impulse response, cut off, with ``|W|^2 = (1 - g)/g``, g = 1 - delta^6 (at least 0.03).

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import PathTolerance, guard_filter, path_uncertainty
    >>> guard = guard_filter(path_uncertainty(PathTolerance(delay_samples=1.0), [1.0]))
    >>> share = 1 / (1 + np.abs(np.fft.rfft(guard, 512)) ** 2)  # g
    >>> share[[16, 32, 64, 128]].round(2)  # at 1/32, 1/16, 1/8 and 1/4 of the sample rate
    array([1.  , 0.99, 0.75, 0.03])
    """
    share = np.clip(1.0 - np.asarray(uncertainty) ** SHARPNESS, LEAST_SHARE, 1.0)
    penalty = np.maximum((1.0 - share) / share, SMALLEST_PENALTY)
    cepstrum = np.fft.irfft(0.5 * np.log(penalty))
    half = cepstrum.size // 2
    cepstrum[1:half] *= 2.0
    cepstrum[half + 1 :] = 0.0  # causal: minimum phase
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:GUARD_TAPS]


def guard_against(uncertainty: Any, secondary_path: Any) -> np.ndarray | None:
    """Return the guard filter for an uncertainty, see `path_uncertainty`; None if the path is exact."""
    largest = path_uncertainty(uncertainty, secondary_path)
    return guard_filter(largest) if np.any(largest) else None
