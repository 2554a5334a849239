"""Stability of the loop that acoustic feedback closes through the control filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.polynomial import polysub

from .._types import PathModel
from .._validate import as_positive
from .models import path_taps, sampling_rate
from .path_matrix import is_path_matrix

if TYPE_CHECKING:
    import control

_GRID = 2**16  # points around the unit circle; more for a loop of many taps
_POINTS_PER_TAP = 64


@dataclass(frozen=True)
class FeedbackMargin:
    """Stability of the feedback loop, and its distance from instability.

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
        Frequency of the least margin in Hz.
    loop : control.TransferFunction
        Loop transfer function ``-w (f - f^)`` in python-control's convention, in which ``1 / (1 + loop)`` leads from the
        noise to the controller's reference.
    """

    stable: bool
    disk_margin: float
    gain_margin_db: float
    phase_margin_deg: float
    frequency_hz: float
    loop: control.TransferFunction

    def __repr__(self) -> str:
        if not self.stable:
            return "<FeedbackMargin: unstable>"
        return (
            f"<FeedbackMargin: stable, disk margin {self.disk_margin:.3g}, gain {self.gain_margin_db:.3g} dB, phase "
            f"{self.phase_margin_deg:.3g} degrees, least at {self.frequency_hz:.4g} Hz>"
        )


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
    <FeedbackMargin: stable, disk margin 0.667, gain 6.02 dB, phase 36.9 degrees, least at 0 Hz>
    >>> feedback_margin([0.5], [0.0, 1.0], [0.0, 0.9], fs=8000.0).gain_margin_db.__round__(1)
    26.0
    >>> feedback_margin([2.0], [0.0, 1.0], fs=8000.0)
    <FeedbackMargin: unstable>
    """
    from control import TransferFunction, disk_margins

    if is_path_matrix(feedback_path) or is_path_matrix(feedback_estimate) or np.ndim(control_filter) > 1:
        raise ValueError("feedback_margin takes one channel: give a filter and paths of one axis, (taps,)")
    fs = as_positive(sampling_rate(feedback_path, fs, name="feedback_path"), "fs", unit="Hz")
    w, left = path_taps(control_filter, name="control_filter"), path_taps(feedback_path, name="feedback_path")
    if feedback_estimate is not None:
        sampling_rate(feedback_estimate, fs, name="feedback_estimate")
        left = polysub(left, path_taps(feedback_estimate, name="feedback_estimate"))
    if left[0] != 0.0:
        raise ValueError(f"feedback_path must have a delay of a sample at least: a first tap is {left[0]:g}, not 0")
    taps = -np.convolve(w, left)
    loop = TransferFunction(taps, np.eye(1, taps.size)[0], 1 / fs)
    size = max(_GRID, 2 ** int(np.ceil(np.log2(_POINTS_PER_TAP * taps.size))))
    returned = 1.0 + np.fft.rfft(taps, size)
    turned = np.unwrap(np.angle(returned))
    if round((turned[-1] - turned[0]) / np.pi) != 0:
        return FeedbackMargin(False, 0.0, 0.0, 0.0, np.nan, loop)
    worst = int(np.argmax(np.abs(1.0 / returned - 0.5)))
    frequency = worst * fs / size
    margin, gain_db, phase_deg = disk_margins(loop, np.array([2 * np.pi * frequency]))
    return FeedbackMargin(True, float(margin), float(gain_db), float(phase_deg), frequency, loop)
