"""Stability of a loop through the control filter: of acoustic feedback, or of an internal model that is not exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.polynomial import polysub
from numpy.typing import ArrayLike

from .._types import PathModel
from .._validate import as_positive, as_real_array
from .models import path_taps, sampling_rate
from .path_matrix import is_path_matrix

if TYPE_CHECKING:
    import control

_GRID = 2**16  # points around the unit circle; more for a loop of many taps
_POINTS_PER_TAP = 64


@dataclass(frozen=True)
class FeedbackMargin:
    """Stability of a loop through the control filter, and its distance from instability.

    Attributes
    ----------
    stable : bool
        Whether the loop is stable.
    disk_margin : float
        Disk margin alpha of the balanced sensitivity: the loop stays stable if its response is multiplied by any complex
        factor in the disk that reaches from minus to plus `gain_margin_db` on the real axis. It is 2, the largest
        value, without any feedback, and 0 if the loop is unstable.
    gain_margin_db : float
        By how many dB the gain of the loop may rise or fall, at any frequency.
    phase_margin_deg : float
        By how many degrees its phase may change.
    frequency_hz : float
        Frequency in Hz at which the disk margin is smallest.
    path_error : float
        Relative error of the loop's path that the loop tolerates at every frequency, whatever its phase: with a path times
        ``1 + delta`` it is stable as long as ``|delta| < path_error``. It is 1/max|T|, the disk margin of the
        complementary sensitivity T (skew -1); Inf if there is no loop, and 0 if the loop is unstable.
    path_error_hz : float
        Frequency in Hz at which the tolerated error is smallest.
    loop : control.TransferFunction
        Loop transfer function in python-control's convention: ``1 / (1 + loop)`` is the sensitivity. ``-w (f - f^)`` for
        acoustic feedback.
    """

    stable: bool
    disk_margin: float
    gain_margin_db: float
    phase_margin_deg: float
    frequency_hz: float
    path_error: float
    path_error_hz: float
    loop: control.TransferFunction

    def __repr__(self) -> str:
        if not self.stable:
            return "<FeedbackMargin: unstable>"
        return (
            f"<FeedbackMargin: stable, disk margin {self.disk_margin:.3g}, gain {self.gain_margin_db:.3g} dB, phase "
            f"{self.phase_margin_deg:.3g} degrees, least at {self.frequency_hz:.4g} Hz; path error "
            f"{100 * self.path_error:.3g} % at {self.path_error_hz:.4g} Hz>"
        )

    def path_error_at(self, frequencies_hz: ArrayLike) -> np.ndarray:
        """Return the relative error of the path that the loop tolerates at each of `frequencies_hz`, (n_frequencies,).

        Each value is ``1/|T| = |1 + 1/loop|``, which is meaningful only for a stable loop.
        """
        omega = 2 * np.pi * np.atleast_1d(as_real_array(frequencies_hz, "frequencies_hz"))
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / self.loop(np.exp(1j * omega * self.loop.dt))
        return np.where(np.isfinite(inverse), np.abs(1.0 + inverse), np.inf)


def feedback_margin(
    control_filter: PathModel,
    feedback_path: PathModel,
    feedback_estimate: PathModel | None = None,
    *,
    fs: float | None = None,
) -> FeedbackMargin:
    r"""Return whether acoustic feedback through a control filter is stable, and with what margin.

    The control signal reaches the reference microphone through the feedback path, and a `FeedbackNeutralizer` subtracts
    what the estimate of this path predicts:

    .. math::

       y = w * (x + (f - \hat f) * y) \\
       \Rightarrow\quad Y = \frac{W}{1 - W (F - \hat F)} X

    Parameters
    ----------
    control_filter : array_like, shape (n_taps,)
        Control filter w, for example `control_filter` of a controller.
    feedback_path : array_like or control.TransferFunction
        Path f from the loudspeaker to the reference microphone; its first tap must be 0.
    feedback_estimate : array_like or control.TransferFunction, optional
        Estimate of this path, which is subtracted; by default none.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.

    Returns
    -------
    FeedbackMargin
        Stability, disk margin, gain and phase margin.

    Raises
    ------
    TypeError, ValueError
        Several channels, paths without a delay, or different sampling rates.

    Notes
    -----
    The loop has a finite impulse response, so by Nyquist's criterion it is stable if ``1 - W (F - F^)`` does not
    encircle the origin. The margins are those of `control.disk_margins` at the worst frequency of a grid with a spacing
    of fs/65536 or less. The adaptation changes w, so the margin holds for this control filter only.

    References
    ----------
    P. Seiler, A. Packard, P. Gahinet, "An introduction to disk margins", IEEE Control Systems Magazine 40(5), 2020.

    Examples
    --------
    A gain of 0.5 once around the loop, then the same with an estimate of the path that is 10 % too small, then a gain
    of 2 without an estimate:

    >>> from kfopc_filterpy.paths import feedback_margin
    >>> feedback_margin([0.5], [0.0, 1.0], fs=8000.0)
    <FeedbackMargin: stable, disk margin 0.667, gain 6.02 dB, phase 36.9 degrees, least at 0 Hz; path error 100 % at 0 Hz>
    >>> feedback_margin([0.5], [0.0, 1.0], [0.0, 0.9], fs=8000.0).gain_margin_db.__round__(1)
    26.0
    >>> feedback_margin([2.0], [0.0, 1.0], fs=8000.0)
    <FeedbackMargin: unstable>
    """
    if is_path_matrix(feedback_path) or is_path_matrix(feedback_estimate) or np.ndim(control_filter) > 1:
        raise ValueError("feedback_margin takes one channel: give a filter and paths of one axis, (taps,)")
    fs = as_positive(sampling_rate(feedback_path, fs, name="feedback_path"), "fs", unit="Hz")
    w, left = path_taps(control_filter, name="control_filter"), path_taps(feedback_path, name="feedback_path")
    if feedback_estimate is not None:
        sampling_rate(feedback_estimate, fs, name="feedback_estimate")
        left = polysub(left, path_taps(feedback_estimate, name="feedback_estimate"))
    if left[0] != 0.0:
        raise ValueError(f"feedback_path must have a delay of at least one sample: a first tap is {left[0]:g}, not 0")
    return _margin(-np.convolve(w, left), np.ones(1), fs)


def internal_model_margin(
    control_filter: PathModel,
    secondary_path: PathModel,
    secondary_estimate: PathModel | None = None,
    *,
    fs: float | None = None,
) -> FeedbackMargin:
    r"""Return whether a feedback controller's loop is stable, and which error of its secondary path it tolerates.

    An internal model subtracts from the error what it expects the loudspeaker to contribute, and the control filter gets the
    rest one sample late; see `controllers.with_internal_model`. Seen from the error microphone, this is a feedback loop

    .. math:: L = \frac{z^{-1} W S}{1 - z^{-1} W \hat S}, \qquad
       \frac{1}{1 + L} = \frac{1 - z^{-1} W \hat S}{1 + z^{-1} W (S - \hat S)}

    With an exact estimate it is stable for any W, and :math:`T = z^{-1} W \hat S`: a path that is wrong by the factor
    :math:`1 + \delta` is safe where :math:`|\delta| < 1/|T|`.

    Parameters
    ----------
    control_filter : array_like, shape (n_taps,)
        Settled control filter w: `control_filter` of a feedback controller, or the last row of a hybrid controller's.
    secondary_path : array_like or control.TransferFunction
        True path s from the loudspeaker to the error microphone.
    secondary_estimate : array_like or control.TransferFunction, optional
        The controller's estimate of this path; by default the path itself.
    fs : float, optional
        Sampling rate in Hz, needed for tap arrays.

    Returns
    -------
    FeedbackMargin
        Stability and margins; `path_error` is the relative modelling error that the loop tolerates.

    Raises
    ------
    TypeError, ValueError
        Several channels, or different sampling rates.

    Notes
    -----
    The notes of `feedback_margin`, which is for acoustic feedback, hold here too. A hybrid controller may have both loops.

    Examples
    --------
    A path that delays by one sample and a filter that predicts half of the disturbance, then the same with a path 2.9 and 3.1
    times as large as its estimate:

    >>> from kfopc_filterpy.paths import internal_model_margin
    >>> internal_model_margin([0.5], [0.0, 1.0], fs=8000.0).path_error
    2.0
    >>> internal_model_margin([0.5], [0.0, 2.9], [0.0, 1.0], fs=8000.0).stable
    True
    >>> internal_model_margin([0.5], [0.0, 3.1], [0.0, 1.0], fs=8000.0).stable
    False
    """
    if is_path_matrix(secondary_path) or is_path_matrix(secondary_estimate) or np.ndim(control_filter) > 1:
        raise ValueError("internal_model_margin takes one channel: give a filter and paths of one axis, (taps,)")
    fs = as_positive(sampling_rate(secondary_path, fs, name="secondary_path"), "fs", unit="Hz")
    delayed = np.concatenate(([0.0], path_taps(control_filter, name="control_filter")))
    path = estimate = path_taps(secondary_path, name="secondary_path")
    if secondary_estimate is not None:
        sampling_rate(secondary_estimate, fs, name="secondary_estimate")
        estimate = path_taps(secondary_estimate, name="secondary_estimate")
    return _margin(np.convolve(delayed, path), polysub([1.0], np.convolve(delayed, estimate)), fs)


def _margin(numerator: np.ndarray, denominator: np.ndarray, fs: float) -> FeedbackMargin:
    """Return the margins of the loop ``numerator / denominator``, both in taps, whose closed loop is the inverse of an FIR filter."""
    from control import TransferFunction, disk_margins

    n = max(numerator.size, denominator.size)
    above, below = (np.pad(taps, (0, n - taps.size)) for taps in (numerator, denominator))
    loop = TransferFunction(above, below, 1 / fs)
    size = max(_GRID, 2 ** int(np.ceil(np.log2(_POINTS_PER_TAP * n))))
    over, under = (np.fft.rfft(taps, size) for taps in (above, below))
    turned = np.unwrap(np.angle(over + under))
    if round((turned[-1] - turned[0]) / np.pi) != 0:
        return FeedbackMargin(False, 0.0, 0.0, 0.0, np.nan, 0.0, np.nan, loop)
    worst = [int(np.argmax(np.abs(part / (over + under)))) for part in (0.5 * (under - over), over)]
    frequency, error_hz = (float(at * fs / size) for at in worst)
    margin, gain_db, phase_deg = disk_margins(loop, np.array([2 * np.pi * frequency]))
    found = FeedbackMargin(True, float(margin), float(gain_db), float(phase_deg), frequency, np.inf, error_hz, loop)
    return replace(found, path_error=float(found.path_error_at(error_hz)[0])) if np.any(above) else found
