r"""Uncertainty of a secondary path, and the short filter that guards a controller against it.

The true path is :math:`S = (1 + \Delta)\hat S` with :math:`|\Delta(\omega)| \le \delta(\omega)`. A control filter that is
g times the best one for the disturbance estimate :math:`\hat d = e + \hat s * y` leaves, once the adaptation has settled,

.. math:: E = D\,\frac{1 - g}{1 + g\Delta}

It settles, however fast the adaptation is, if :math:`g\delta < 1`; a slow one settles if
:math:`1 + g\operatorname{Re}\Delta > 0`. The noise is not louder than without control if
:math:`|1 + g\Delta| \ge 1 - g`. The part g of the control filter that is safe:

- Within a `PathTolerance`, :math:`1 + \Delta = \rho e^{j\theta}` with a largest phase :math:`\theta` and gains
  :math:`\rho` from :math:`1/\gamma` to :math:`\gamma`. Then :math:`g = \min(1, 0.94/\delta)`, and g = 0 where no g meets the
  last two conditions. With an exact gain, that is where :math:`\theta` exceeds 135 degrees.
- If only :math:`\delta` is known, the phase of the error can be any, and only g = 0 is safe where :math:`\delta > 1`.
  Therefore :math:`g = 1 - \delta^6`: this costs next to nothing where the path is known well, and :math:`g\delta` is at
  most 0.62.

A controller gets this g from a penalty on the control signal through the filter W with :math:`|W|^2 = (1 - g)/g`:

.. math:: \min_v E[(d - v * x')^2] + E[(v * W * x')^2]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.signal import minimum_phase, windows

from .._validate import as_nonnegative, as_real_array, require_finite
from .channels import secondary_paths

N_FREQUENCIES = 257  # from 0 to fs/2
GUARD_TAPS = 48
SHARPNESS = 6  # g = 1 - delta^SHARPNESS, if only delta is known
LARGEST_GAIN = 0.94  # of g delta within a PathTolerance; W adds up to 0.1, and at 1 a fast adaptation runs away
LEAST_SHARE = 0.03  # g is at least this; a zero would need an infinite penalty
STEEP = 6  # frequencies by which W's taps make a steep fall of g begin too early
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
    >>> PathTolerance(delay_samples=1.0).share(2 * np.pi * np.array([0.1, 0.25, 0.35, 0.4])).round(2)
    array([1.  , 0.66, 0.53, 0.  ])
    """

    delay_samples: float = 0.0
    phase_deg: float = 0.0
    gain_db: float = 0.0

    def __post_init__(self) -> None:
        for name in ("delay_samples", "phase_deg", "gain_db"):
            as_nonnegative(getattr(self, name), name)

    def relative_error(self, omega: np.ndarray) -> np.ndarray:
        """Return the largest ``|S/S^ - 1|`` within the tolerances, at frequencies `omega` in radians per sample."""
        gain = self._largest_gain
        return np.sqrt((gain - 1.0) ** 2 + 4.0 * gain * np.sin(self._largest_phase(omega) / 2.0) ** 2)

    def share(self, omega: np.ndarray) -> np.ndarray:
        """Return the safe part g of the control filter, from 0 to 1, at frequencies `omega` in radians per sample."""
        back, gain = np.maximum(-np.cos(self._largest_phase(omega)), 0.0), self._largest_gain
        not_louder_from = 2.0 * back / (1.0 / gain + 2.0 * back)
        unstable_from = 1.0 / (1.0 + gain * back)  # if the adaptation is slow
        share = LARGEST_GAIN / np.maximum(self.relative_error(omega), LARGEST_GAIN)
        return np.where(not_louder_from < unstable_from, share, 0.0)

    def _largest_phase(self, omega: np.ndarray) -> np.ndarray:
        return np.minimum(np.deg2rad(self.phase_deg) + self.delay_samples * np.asarray(omega), np.pi)

    @property
    def _largest_gain(self) -> float:
        return float(10.0 ** (self.gain_db / 20.0))


ONE_SAMPLE = PathTolerance(delay_samples=1.0)  # what a careful identification may leave


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


def guard_filter(uncertainty: PathTolerance | np.ndarray) -> np.ndarray:
    """Return the filter W that guards a controller against an uncertainty, see `path_uncertainty`.

    Parameters
    ----------
    uncertainty : PathTolerance or ndarray, shape (n_frequencies,)
        Tolerances; or the largest relative error of the path at evenly spaced frequencies from 0 to fs/2. Tolerances
        allow more control, because they limit the phase of the error.

    Returns
    -------
    ndarray, shape (48,)
        Minimum-phase impulse response with ``|W|^2 = (1 - g)/g``, where g is `PathTolerance.share` or
        1 - delta^6, and at least 0.03.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import PathTolerance, guard_filter
    >>> guard = guard_filter(PathTolerance(delay_samples=1.0))
    >>> share = 1 / (1 + np.abs(np.fft.rfft(guard, 512)) ** 2)  # g
    >>> share[[64, 128, 160, 224]].round(2)  # at 1/8, 1/4, 5/16 and 7/16 of the sample rate
    array([1.  , 0.69, 0.58, 0.03])
    """
    share = np.maximum(_safe_share(uncertainty), LEAST_SHARE)
    return _short_filter(np.maximum((1.0 - share) / share, SMALLEST_PENALTY))


def _safe_share(uncertainty: PathTolerance | np.ndarray) -> np.ndarray:
    if isinstance(uncertainty, PathTolerance):
        return uncertainty.share(np.linspace(0.0, np.pi, N_FREQUENCIES))
    return np.maximum(1.0 - np.asarray(uncertainty) ** SHARPNESS, 0.0)


def _short_filter(power: np.ndarray) -> np.ndarray:
    """Return the minimum-phase filter whose ``|W|^2`` is a local mean of `power`, which is given from 0 to fs/2.

    The spectrum of Bohman's window is nowhere negative. So g does not overshoot where it falls steeply, as it would if W
    were cut off. A steep rise of `power` begins too early in the mean, so it is delayed before.
    """
    delayed = minimum_filter1d(power, 2 * STEEP + 1)
    correlation = np.fft.irfft(delayed)[np.abs(np.arange(1 - GUARD_TAPS, GUARD_TAPS))]
    return np.ascontiguousarray(minimum_phase(correlation * windows.bohman(correlation.size)))


def guard_against(uncertainty: Any, secondary_path: Any) -> np.ndarray | None:
    """Return the guard filter for an uncertainty, see `path_uncertainty`; None if the path is exact."""
    largest = path_uncertainty(uncertainty, secondary_path)
    return guard_filter(_most_exact(uncertainty, largest)) if np.any(largest) else None


def is_controllable(uncertainty: Any, secondary_path: Any) -> np.ndarray:
    """Return whether an uncertainty allows any control, (257,), at evenly spaced frequencies from 0 to fs/2."""
    return _safe_share(_most_exact(uncertainty, path_uncertainty(uncertainty, secondary_path))) > 0.0


def _most_exact(uncertainty: Any, largest: np.ndarray) -> PathTolerance | np.ndarray:
    """Return what tells most of an uncertainty: tolerances, or else its largest relative error."""
    return uncertainty if isinstance(uncertainty, PathTolerance) else largest
