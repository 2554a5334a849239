"""Stability of a loop through the control filter: of acoustic feedback, or of an internal model that is not exact."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from .._taps import path_matrix
from .._types import PathModels
from .._validate import as_real_array
from ..plant import Plant, as_constant_plant

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
        Disk margin alpha of the balanced sensitivity: the loop stays stable if its response is multiplied by any
        complex factor in the disk that reaches from minus to plus `gain_margin_db` on the real axis. It is 2, the
        largest value, without any feedback, and 0 if the loop is unstable.
    gain_margin_db : float
        By how many dB the gain of the loop may rise or fall, at any frequency.
    phase_margin_deg : float
        By how many degrees its phase may change.
    frequency_hz : float
        Frequency in Hz at which the disk margin is smallest.
    path_error : float
        Relative error of the loop's path that the loop tolerates at every frequency, whatever its phase: with a path
        times ``1 + delta`` it is stable as long as ``|delta| < path_error``. It is 1/max|T|, the disk margin of the
        complementary sensitivity T (skew -1); Inf if there is no loop, and 0 if the loop is unstable.
    path_error_hz : float
        Frequency in Hz at which the tolerated error is smallest.
    paths : tuple of ndarray
        Control filter (J, K, taps), path (K, J, taps) and estimate of the path, which form the loop.
    fs : float
        Sampling rate in Hz.

    Notes
    -----
    With several channels, delta is a matrix that multiplies the path from the left, for errors of the microphones, or
    from the right, for errors of the loudspeakers. ``|delta|`` is its largest singular value. ``|T|`` is the larger of
    the largest singular values of T with the loop opened at the microphones and at the loudspeakers. So all channels
    may be wrong at once, in any way. The disk margin allows a different factor for each microphone, or for each
    loudspeaker. It is at most that of `control.disk_margins`, which uses the structured singular value and needs slycot
    for several channels.
    """

    stable: bool
    disk_margin: float
    gain_margin_db: float
    phase_margin_deg: float
    frequency_hz: float
    path_error: float
    path_error_hz: float
    paths: tuple[np.ndarray, np.ndarray, np.ndarray] = field(compare=False)
    fs: float

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

        Each value is ``1/|T|``, which is meaningful only for a stable loop.
        """
        turns = np.outer(
            as_real_array(frequencies_hz, "frequencies_hz"), np.arange(max(t.shape[2] for t in self.paths))
        )
        waves = np.exp(-2j * np.pi / self.fs * turns)
        responses = [np.moveaxis(taps @ waves[:, : taps.shape[2]].T, -1, 0) for taps in self.paths]
        with np.errstate(divide="ignore"):
            return 1.0 / _largest(0.0, *responses)


def feedback_margin(control_filter: PathModels, plant: Plant, estimate: PathModels | None = None) -> FeedbackMargin:
    r"""Return whether acoustic feedback through a control filter is stable, and with what margin.

    The control signal reaches the reference microphone through the feedback path, and a `FeedbackNeutralizer` subtracts
    what the estimate of this path predicts:

    .. math::

       y = w * (x + (f - \hat f) * y) \\
       \Rightarrow\quad Y = \frac{W}{1 - W (F - \hat F)} X

    Parameters
    ----------
    control_filter : array_like, shape (n_taps,) or (J, I, n_taps)
        Control filter w, for example `control_filter` of a controller.
    plant : Plant
        Plant with the feedback path f from the loudspeaker to the reference microphone.
    estimate : array_like, shape (n_taps,) or (I, J, n_taps), or control system, optional
        Estimate of this path, which is subtracted; by default none.

    Returns
    -------
    FeedbackMargin
        Stability, disk margin, gain and phase margin.

    Raises
    ------
    TypeError, ValueError
        Numbers of channels that do not fit each other, paths without a delay, or different sampling rates.

    Notes
    -----
    The loop has a finite impulse response, so by Nyquist's criterion it is stable if ``1 - W (F - F^)`` does not
    encircle the origin; with several channels, this is the determinant of ``I - (F - F^) W``. The margins are those at
    the worst frequency of a grid with a spacing of fs/65536 or less. The adaptation changes w, so the margin holds for
    this control filter only.

    References
    ----------
    P. Seiler, A. Packard, P. Gahinet, "An introduction to disk margins", IEEE Control Systems Magazine 40(5), 2020.
    S. Skogestad, I. Postlethwaite, Multivariable Feedback Control, 2nd ed., Wiley 2005, sections 4.9 and 8.6.

    Examples
    --------
    A gain of 0.5 once around the loop, then the same with an estimate of the path that is 10 % too small, then a gain
    of 2 without an estimate:

    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.paths import feedback_margin
    >>> plant = Plant([1.0], feedback=[0.0, 1.0], fs=8000)
    >>> feedback_margin([0.5], plant)
    <FeedbackMargin: stable, disk margin 0.667, gain 6.02 dB, phase 36.9 degrees, least at 0 Hz; path error 100 % at 0 Hz>
    >>> feedback_margin([0.5], plant, [0.0, 0.9]).gain_margin_db.__round__(1)
    26.0
    >>> feedback_margin([2.0], plant)
    <FeedbackMargin: unstable>
    """
    as_constant_plant(plant, "feedback_margin")
    if plant.feedback is None:
        raise ValueError("plant must have a feedback path: make it with Plant(..., feedback=...)")
    f, fs = plant.feedback, plant.fs
    estimated = _estimate(estimate, np.zeros_like(f), fs)
    w, _ = path_matrix(control_filter, fs=fs, name="control_filter")
    _require_fit(w, f, w.shape[1])
    left = np.zeros((*f.shape[:2], max(f.shape[2], estimated.shape[2])))
    left[..., : f.shape[2]] += f
    left[..., : estimated.shape[2]] -= estimated
    if np.any(left[..., 0]):
        raise ValueError("estimate must have a delay of at least one sample: a first tap is not 0")
    return _margin(w, -left, np.zeros_like(left[..., :1]), fs)


def internal_model_margin(
    control_filter: PathModels, plant: Plant, estimate: PathModels | None = None
) -> FeedbackMargin:
    r"""Return whether a feedback controller's loop is stable, and which error of its secondary path it tolerates.

    An internal model subtracts from the error what it expects the loudspeaker to contribute, and the control filter
    gets the rest one sample late; see `controllers.with_internal_model`. Seen from the error microphone, this is a
    feedback loop

    .. math:: L = \frac{z^{-1} W S}{1 - z^{-1} W \hat S}, \qquad
       \frac{1}{1 + L} = \frac{1 - z^{-1} W \hat S}{1 + z^{-1} W (S - \hat S)}

    With an exact estimate it is stable for any W, and :math:`T = z^{-1} W \hat S`: a path that is wrong by the factor
    :math:`1 + \delta` is safe where :math:`|\delta| < 1/|T|`. With several channels, W, S and :math:`\hat S` are
    matrices, and the denominator is :math:`\det(I + z^{-1} (S - \hat S) W)`.

    Parameters
    ----------
    control_filter : array_like, shape (n_taps,) or (J, K, n_taps)
        Settled control filter w: `control_filter` of a feedback controller. That of a hybrid controller has the shape
        (J, I + K, n_taps); its last K inputs, the disturbances, are used.
    plant : Plant
        Plant with the true secondary path s from the loudspeaker to the error microphone.
    estimate : array_like, shape (n_taps,) or (K, J, n_taps), or control system, optional
        The controller's estimate of this path; by default the path itself.

    Returns
    -------
    FeedbackMargin
        Stability and margins; `path_error` is the relative modelling error that the loop tolerates.

    Raises
    ------
    TypeError, ValueError
        Numbers of channels that do not fit each other, or different sampling rates.

    Notes
    -----
    The notes of `feedback_margin`, which is for acoustic feedback, hold here too. A hybrid controller may have both
    loops.

    Examples
    --------
    A path that delays by one sample and a filter that predicts half of the disturbance, then the same with a path 2.9
    and 3.1 times as large as its estimate:

    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.paths import internal_model_margin
    >>> internal_model_margin([0.5], Plant([0.0, 1.0], fs=8000)).path_error.__round__(9)
    2.0
    >>> [internal_model_margin([0.5], Plant([0.0, gain], fs=8000), [0.0, 1.0]).stable for gain in (2.9, 3.1)]
    [True, False]

    Two such loops, with both loudspeakers heard at both microphones: the gain doubles if the disturbances are equal.

    >>> import numpy as np
    >>> filters, path = np.zeros((2, 2, 2, 2))
    >>> filters[..., 0], path[..., 1] = 0.5 * np.eye(2), 1.0
    >>> internal_model_margin(filters, Plant(path, fs=8000)).path_error.__round__(9)
    1.0
    """
    as_constant_plant(plant, "internal_model_margin")
    s, fs = plant.secondary, plant.fs
    w, _ = path_matrix(control_filter, fs=fs, name="control_filter")
    _require_fit(w, s, min(w.shape[1], len(s)))
    return _margin(np.pad(w[:, -len(s) :], ((0, 0), (0, 0), (1, 0))), s, _estimate(estimate, s, fs), fs)


def _estimate(paths: PathModels | None, default: np.ndarray, fs: float) -> np.ndarray:
    """Return the estimate of a path as taps, with the channels of the `default`."""
    estimate = default if paths is None else path_matrix(paths, fs=fs, name="estimate")[0]
    if estimate.shape[:2] != default.shape[:2]:
        raise ValueError(f"estimate must have the channels of the path, {default.shape[:2]}, got {estimate.shape[:2]}")
    return estimate


def _require_fit(w: np.ndarray, path: np.ndarray, n_inputs: int) -> None:
    """Raise ValueError if a control filter and its path cannot form a loop over so many of the filter's inputs."""
    K, J, _ = path.shape
    if (len(w), n_inputs) != (J, K):
        raise ValueError(
            f"control_filter must be ({J} loudspeakers, {K} microphones, taps) for a path from {J} loudspeaker(s) to {K} "
            f"microphone(s), got {w.shape}"
        )


def _margin(w: np.ndarray, path: np.ndarray, estimate: np.ndarray, fs: float) -> FeedbackMargin:
    """Return the margins of the loop from `w`, (J, K, taps), through path minus estimate, (K, J, taps)."""
    paths = (w, path, estimate)
    n_taps = len(path) * (w.shape[2] + max(path.shape[2], estimate.shape[2]))  # of the determinant, at most
    size = max(_GRID, 2 ** int(np.ceil(np.log2(_POINTS_PER_TAP * n_taps))))
    responses = [np.moveaxis(np.fft.rfft(taps, size), -1, 0) for taps in paths]
    determinant = np.linalg.det(_returned(*responses))
    turned = np.unwrap(np.angle(determinant))
    if not np.all(determinant) or round((turned[-1] - turned[0]) / np.pi) != 0:
        return FeedbackMargin(False, 0.0, 0.0, 0.0, np.nan, 0.0, np.nan, paths, fs)
    balanced, complementary = (_largest(centre, *responses) for centre in (0.5, 0.0))
    worst, most_wrong = np.argmax(balanced), np.argmax(complementary)
    disk = min(1.0 / float(balanced[worst]), 2.0)
    with np.errstate(divide="ignore"):
        return FeedbackMargin(
            stable=True,
            disk_margin=disk,
            gain_margin_db=float(20.0 * np.log10(np.divide(2.0 + disk, 2.0 - disk))),
            phase_margin_deg=float(np.rad2deg(2.0 * np.arctan(disk / 2.0))),
            frequency_hz=float(worst * fs / size),
            path_error=float(1.0 / complementary[most_wrong]),
            path_error_hz=float(most_wrong * fs / size),
            paths=paths,
            fs=fs,
        )


def _returned(w: np.ndarray, path: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return ``I + (S - S^) W`` at each frequency, (n_frequencies, K, K), from responses with the frequencies first."""
    return np.eye(path.shape[1]) + (path - estimate) @ w


def _largest(centre: float, w: np.ndarray, path: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return the largest singular value of ``centre I - T`` at each frequency."""
    driven = w @ np.linalg.inv(_returned(w, path, estimate))  # control signals for a disturbance of 1
    norms = []
    for T in (path @ driven, driven @ path):
        matrix = centre * np.eye(T.shape[1]) - T
        norms.append(np.linalg.norm(matrix, 2 if T.shape[1] > 1 else None, axis=(1, 2)))
    return np.maximum(*norms)
