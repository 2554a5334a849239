r"""Uncertainty of a secondary path, and the short filter that guards a controller against it.

The true path is :math:`S = (1 + \Delta)\hat S` with :math:`|\Delta(\omega)| \le \delta(\omega)`. A control filter that
is g times the best one for the disturbance estimate :math:`\hat d = e + \hat s * y` leaves, once the adaptation has
settled,

.. math:: E = D\,\frac{1 - g}{1 + g\Delta}

If the frequencies adapt independently, each settles if :math:`g\delta < 1`. The noise is not louder than without
control if
:math:`|1 + g\Delta| \ge 1 - g`. The part g of the control filter that is allowed:

- Within a `PathTolerance`, :math:`1 + \Delta = \rho e^{j\theta}` with a largest phase :math:`\theta`. Then
  :math:`g = \min(1, 0.94/\delta)` up to a phase of 135 degrees, and 0 beyond. With a phase above 90 degrees, some g makes
  the noise louder, by a factor of at most :math:`1/\sin\theta`, whatever :math:`\rho` is. That is 3 dB at 135 degrees.
  With several loudspeakers, 90 degrees is the limit.
- If only :math:`\delta` is known, the phase of the error can be anything, and only g = 0 is safe where :math:`\delta >
  1`. Therefore :math:`g = 1 - \delta^6`, which costs next to nothing where the path is known well; :math:`g\delta` is
  at most 0.62, up to a :math:`\delta` of 100. With more microphones than loudspeakers, the same g is used for a
  tolerance.

A controller gets this g from a penalty on the control signal through the filter W with :math:`|W|^2 = (1 - g)/g`:

.. math:: \min_v E[(d - v * x')^2] + E[(v * W * x')^2]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import minimum_phase, windows

from .._validate import as_nonnegative, as_real_array, require_finite
from ..plant import Secondary, estimated_secondary

N_FREQUENCIES = 257  # from 0 to fs/2
OMEGA = np.linspace(0.0, np.pi, N_FREQUENCIES)
GUARD_TAPS = 48
SHARPNESS = 6  # g = 1 - delta^SHARPNESS, if only delta is known
LARGEST_LOOP_GAIN = 0.94  # g delta within a tolerance; from 1 on, the adaptation can diverge
LARGEST_LOOP_GAIN_OF_SIZE = 0.62  # g delta if only delta is known: the maximum of delta (1 - delta^6)
LARGEST_ERROR = 100.0  # delta that is guarded against; a larger penalty would reach too far beyond its frequency
MOST_PASSES = 50  # of raising a narrow peak
LEAST_SHARE = 0.03  # where g should be 0; a zero would need an infinite penalty
LEAST_LOOP_GAIN = 0.3  # g delta where that is less; the noise becomes louder by 1/(1 - 0.3) = 3.1 dB at most
SMALLEST_PENALTY = 1e-4  # |W|^2 is at least this; a zero would need an infinite impulse response
LARGEST_PHASE_DEG = 135.0  # up to it, the noise becomes louder by 3 dB at most; beyond it, no control
LARGEST_PHASE_OF_SEVERAL_DEG = 90.0  # with several loudspeakers, whose errors can differ
WIDEST_GAIN_DB = 20.0  # of a tolerance; with more, even the least share could make the noise much louder


def as_gain_error(value: float, name: str) -> float:
    """Return the largest error of a path's gain in dB, checked."""
    gain_db = as_nonnegative(value, name)
    if gain_db > WIDEST_GAIN_DB:
        raise ValueError(
            f"{name} must be at most {WIDEST_GAIN_DB:g}, got {gain_db:g}: a path that is known no better allows no "
            "control, measure it"
        )
    return gain_db


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
        Largest error of the gain in dB, too high or too low; at most 20.

    Raises
    ------
    TypeError, ValueError
        A tolerance that is negative or not finite; a gain by more than 20 dB.

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
        for name in ("delay_samples", "phase_deg"):
            object.__setattr__(self, name, as_nonnegative(getattr(self, name), name))
        object.__setattr__(self, "gain_db", as_gain_error(self.gain_db, "gain_db"))

    def relative_error(self, omega: np.ndarray) -> np.ndarray:
        """Return the largest ``|S/S^ - 1|`` within the tolerances, at frequencies `omega` in radians per sample."""
        gain = 10.0 ** (self.gain_db / 20.0)
        return np.sqrt((gain - 1.0) ** 2 + 4.0 * gain * np.sin(self._largest_phase(omega) / 2.0) ** 2)

    def share(self, omega: np.ndarray, *, largest_phase_deg: float = LARGEST_PHASE_DEG) -> np.ndarray:
        """Return the part g of the control filter that is allowed, from 0 to 1, at `omega` in radians per sample.

        Where the phase can be wrong by more than `largest_phase_deg`, g is 0.
        """
        share = LARGEST_LOOP_GAIN / np.maximum(self.relative_error(omega), LARGEST_LOOP_GAIN)
        return np.where(self._largest_phase(omega) <= np.deg2rad(largest_phase_deg), share, 0.0)

    def _largest_phase(self, omega: np.ndarray) -> np.ndarray:
        return np.minimum(np.deg2rad(self.phase_deg) + self.delay_samples * np.asarray(omega), np.pi)


# Tolerances; a relative error for all frequencies, or one for each of several from 0 to fs/2; or measured paths.
Uncertainty: TypeAlias = PathTolerance | float | ArrayLike


def path_uncertainty(uncertainty: Uncertainty | None, secondary: Secondary) -> np.ndarray:
    """Return the largest relative error of a secondary path over frequency.

    Parameters
    ----------
    uncertainty : PathTolerance, float or array_like, optional
        Tolerances; or one relative error for all frequencies; or its values at evenly spaced frequencies from 0 to
        fs/2, (n_frequencies,); or measured paths, (M, n_taps) or (M, K, J, n_taps), whose largest distance from
        `secondary` counts. None means no uncertainty.
    secondary : array_like, shape (n_path,) or (K, J, n_path), or control system
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
        those of `secondary`.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import path_uncertainty
    >>> measured = np.array([[0.0, 1.0, 0.0], [0.0, 0.8, 0.2]])  # on two days
    >>> path_uncertainty(measured, [0.0, 1.0, 0.0])[[0, 128, 256]].round(2)
    array([0.  , 0.28, 0.4 ])
    """
    estimate, _ = estimated_secondary(secondary)
    stated = as_uncertainty(uncertainty)
    if stated is None:
        return np.zeros(N_FREQUENCIES)
    if isinstance(stated, PathTolerance):
        return stated.relative_error(OMEGA)
    if isinstance(stated, float):
        return np.full(N_FREQUENCIES, stated)
    if stated.ndim > 1:
        return _distance(stated, estimate)
    places = np.linspace(0.0, N_FREQUENCIES - 1.0, stated.size)
    error = np.interp(np.arange(N_FREQUENCIES), places, stated)
    np.maximum.at(error, np.rint(places).astype(int), stated)  # with more values than these, no peak may be lost
    return error


def rms_relative_error(uncertainty: Uncertainty | None, secondary: Secondary) -> float:
    """Return the root mean square of the relative error over the spectrum of a secondary path; 0 if it is exact."""
    stated = as_uncertainty(uncertainty)
    if stated is None or isinstance(stated, float):
        return stated or 0.0
    paths, _ = estimated_secondary(secondary)
    weights = np.sum(np.abs(_response(paths)) ** 2, axis=(1, 2))
    weights = weights if np.any(weights > 0.0) else np.ones(N_FREQUENCIES)
    weights[[0, -1]] *= 0.5  # each other frequency stands for two of the whole circle
    return float(np.sqrt(np.average(path_uncertainty(stated, paths) ** 2, weights=weights)))


def as_uncertainty(value: Uncertainty | None) -> PathTolerance | float | np.ndarray | None:
    """Return an uncertainty as it is stated, checked, and an array as a copy."""
    if value is None or isinstance(value, PathTolerance):
        return value
    try:
        stated = as_real_array(value, "secondary_path_uncertainty")
    except TypeError as error:
        raise TypeError(
            f"{error}; give a PathTolerance, a relative error (0.3 is 30 %), relative errors at evenly spaced frequencies "
            "from 0 to fs/2, or measured paths"
        ) from error
    require_finite(stated, "secondary_path_uncertainty")
    if stated.ndim == 0:
        return as_nonnegative(float(stated), "secondary_path_uncertainty")
    if stated.ndim == 1 and (stated.size < 2 or np.any(stated < 0.0)):
        raise ValueError(
            "secondary_path_uncertainty must be zero or above at two or more frequencies from 0 to fs/2, "
            f"got {stated.size} with a minimum of {stated.min(initial=np.inf):g}; a measured path is (1, n_taps)"
        )
    return stated.copy()


def _distance(measured: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return the largest relative distance of measured paths from the estimate, at each frequency."""
    several = measured[:, np.newaxis, np.newaxis] if measured.ndim == 2 else measured
    if several.ndim != 4 or several.shape[1:3] != estimate.shape[:2] or 0 in several.shape:
        K, J, _ = estimate.shape
        wanted = "(M, n_taps)" if K == J == 1 else f"(M, {K}, {J}, n_taps)"
        raise ValueError(f"secondary_path_uncertainty of M measured paths must be {wanted}, got shape {measured.shape}")
    known = _response(estimate)
    error = _response(several) - known
    relative = _norm(error @ np.linalg.pinv(known))
    # The second term counts at frequencies at which the estimated path is zero, where the first one is zero too.
    with np.errstate(over="ignore"):
        least = _norm(error) / np.maximum(_norm(known), np.finfo(float).tiny)
    return np.maximum(relative, least).max(axis=0)


def relative_to(paths: np.ndarray, squared_error: np.ndarray) -> np.ndarray:
    """Return a bound on the relative error of paths (K, J, taps) from the squared errors of their responses.

    `squared_error` is (K, J, 257). With several paths the bound is ``||E||_F ||pinv(S^)||`` with the matrix E of the
    errors, as their phases are not known.
    """
    known = _response(paths)
    smallest = np.linalg.svd(known, compute_uv=False)[..., -1]  # 1/||pinv(S^)||
    return np.sqrt(squared_error.sum(axis=(0, 1))) / np.maximum(smallest, np.finfo(float).tiny)


def _norm(matrices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(matrices, ord=2, axis=(-2, -1))


def _response(paths: np.ndarray) -> np.ndarray:
    """Return the responses of paths (..., K, J, taps) as matrices (..., 257, K, J)."""
    waves = np.exp(-1j * np.outer(OMEGA, np.arange(paths.shape[-1])))
    return np.moveaxis(paths @ waves.T, -1, -3)


def guard_filter(uncertainty: Uncertainty | None, secondary: Secondary) -> np.ndarray | None:
    """Return the filter W that guards a controller against an uncertainty, or None if it needs no guard.

    Parameters
    ----------
    uncertainty : PathTolerance, float or array_like, optional
        Uncertainty of the secondary path, as of `path_uncertainty`. A tolerance allows more control than its
        relative error, because it limits the phase of the error, unless there are more microphones than loudspeakers.
    secondary : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path.

    Returns
    -------
    ndarray, shape (48,), or None
        Minimum-phase impulse response with ``|W|^2 = (1 - g)/g``, where g is `PathTolerance.share` or 1 - delta^6. A
        smaller g is raised to 0.03, or to 0.3/delta if delta is above 10. A delta above 100 counts as 100. None if g
        is 1 at all frequencies, whatever the path.

    Raises
    ------
    TypeError, ValueError
        As `path_uncertainty`.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.paths import PathTolerance, guard_filter
    >>> guard = guard_filter(PathTolerance(delay_samples=1.0), [0.0, 1.0, -0.6])
    >>> share = 1 / (1 + np.abs(np.fft.rfft(guard, 512)) ** 2)  # g
    >>> share[[64, 128, 160, 224]].round(2)  # at 1/8, 1/4, 5/16 and 7/16 of the sample rate
    array([1.  , 0.66, 0.56, 0.03])
    """
    paths, _ = estimated_secondary(secondary)
    share = allowed_share(uncertainty, paths)
    stated: Any = uncertainty
    if np.all(share == 1.0) and np.ndim(stated) < 2:  # measured paths may differ from a later estimate
        return None
    largest = np.minimum(path_uncertainty(uncertainty, paths), LARGEST_ERROR)
    share = np.maximum(share, np.minimum(LEAST_SHARE, LEAST_LOOP_GAIN / np.maximum(largest, 1.0)))
    penalty = np.maximum((1.0 - share) / share, SMALLEST_PENALTY)
    loop_gain = LARGEST_LOOP_GAIN if _knows_phase(uncertainty, paths) else LARGEST_LOOP_GAIN_OF_SIZE
    return _short_filter(penalty, largest / loop_gain - 1.0)


def allowed_share(uncertainty: Uncertainty | None, secondary: Secondary) -> np.ndarray:
    """Return the part g of the control filter that an uncertainty allows, (257,), from 0 to fs/2."""
    paths, _ = estimated_secondary(secondary)
    if _knows_phase(uncertainty, paths):
        limit = LARGEST_PHASE_DEG if paths.shape[1] == 1 else LARGEST_PHASE_OF_SEVERAL_DEG
        return uncertainty.share(OMEGA, largest_phase_deg=limit)
    return 1.0 - np.minimum(path_uncertainty(uncertainty, paths), 1.0) ** SHARPNESS


def _knows_phase(uncertainty: Any, paths: np.ndarray) -> TypeGuard[PathTolerance]:
    """Return whether the phase of the error is limited, and errors at one microphone do not disturb another one."""
    n_microphones, n_loudspeakers = paths.shape[:2]
    return isinstance(uncertainty, PathTolerance) and n_microphones <= n_loudspeakers


def _short_filter(power: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return the minimum-phase filter whose ``|W|^2`` is a local mean of `power`, given from 0 to fs/2, and at least `least`.

    The spectrum of Bohman's window is nowhere negative. So g does not overshoot where it falls steeply, as it would if
    W were cut off. A narrow peak disappears in the mean, so it is raised until the mean is large enough.
    """
    lags = np.arange(1 - GUARD_TAPS, GUARD_TAPS)
    window = windows.bohman(lags.size)
    for _ in range(MOST_PASSES):
        correlation = np.fft.irfft(power)[np.abs(lags)] * window
        short = least / (np.exp(-1j * np.outer(OMEGA, lags)) @ correlation).real
        if short.max() <= 1.01:
            break
        power = power * np.maximum(short, 1.0)
    return np.ascontiguousarray(minimum_phase(correlation))
