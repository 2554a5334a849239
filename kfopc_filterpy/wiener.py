"""The Wiener control filter of recorded signals: the best a fixed causal filter of a length can do.

Sign convention: ``e = d - s*y``, ``y = w*x`` with the newest sample first, filtered reference ``x' = s*x``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ._validate import as_count, as_nonnegative, as_positive, as_signal
from .paths import path_taps

# Eigenvalues of the correlation matrix below this share of the largest count as zero: such directions of
# the weights (every one but two for a tone) get no weight, which is the minimum-norm solution.
_RANK_TOLERANCE = 1e-11


@dataclass(frozen=True)
class WienerSolution:
    """A fixed control filter and what it does to the signals it was made of.

    All powers are mean squares over the samples at which both delay lines are full.

    Attributes
    ----------
    weights : numpy.ndarray, shape (n_taps,)
        Control filter w, newest sample first.
    control_power : float
        Mean square of the control signal y = w*x.
    antinoise_power : float
        Mean square of the anti-noise s*y.
    disturbance_power : float
        Mean square of the disturbance d.
    noise_reduction_db : float
        ``-10 log10(E[e^2] / E[d^2])``, at most 300 dB.
    """

    weights: np.ndarray
    control_power: float
    antinoise_power: float
    disturbance_power: float
    noise_reduction_db: float


def wiener_solution(
    reference: Any,
    disturbance: Any,
    secondary_path: Any,
    n_taps: int,
    *,
    regularization: float = 0.0,
    control_penalty: float = 0.0,
) -> WienerSolution:
    r"""Least-squares control filter of a reference and a disturbance.

    Minimises :math:`E[(d - w^T x')^2] + \gamma E[(w^T x)^2] + \lambda E[x'^2] \|w\|^2` over the samples at
    which the delay lines of control filter and secondary path are full: exact least squares on the data at
    hand, not the biased autocorrelation. Leave out the disturbance's own start-up transient if it should
    not count. Where the data leave weights open (a tone fixes two numbers
    only), the solution of minimum norm is taken: eigenvalues below 1e-11 of the largest count as zero.

    Parameters
    ----------
    reference : array_like, shape (n_samples,)
        Reference signal x.
    disturbance : array_like, shape (n_samples,)
        Disturbance d at the error microphone.
    secondary_path : control.TransferFunction or array_like, shape (n_path,)
        Secondary path s with a finite response, at the signals' sampling rate.
    n_taps : int
        Length of the control filter.
    regularization : float
        Ridge λ, relative to the power of the filtered reference.
    control_penalty : float
        Penalty γ on the control power, the optimum that MOV-FxLMS steers to. With the γ at which
        `control_power` equals the rated power, it is the least error any linear filter reaches within it.

    Returns
    -------
    WienerSolution
        Weights, powers and noise reduction.

    Raises
    ------
    TypeError, ValueError
        Signals of differing lengths, shorter than the delay lines, silent, or not finite.

    See Also
    --------
    power_constrained_solution : finds the γ for a rated power.

    References
    ----------
    .. [1] S. M. Kuo and D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999.
    .. [2] D. Shi et al., "Optimal output-constrained active noise control based on inverse adaptive modeling
       leak factor estimate", IEEE/ACM Trans. Audio Speech Lang. Process. 29, 2021.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(2000)
    >>> d = np.concatenate([np.zeros(3), 0.5 * x[:-3]])
    >>> solution = wiener_solution(x, d, [0.0, 1.0], n_taps=4)  # P is three samples late, S one
    >>> solution.weights.round(6) + 0.0
    array([0. , 0. , 0.5, 0. ])
    """
    problem = _Problem(reference, disturbance, secondary_path, n_taps)
    ridge = as_nonnegative(regularization, "regularization")
    return problem.solve(as_nonnegative(control_penalty, "control_penalty"), ridge)


def power_constrained_solution(
    reference: Any, disturbance: Any, secondary_path: Any, n_taps: int, rated_power: float
) -> WienerSolution:
    """Least-squares control filter whose control power does not exceed the rated power.

    Finds the penalty γ of `wiener_solution` at which the control power is `rated_power`, to 1e-6 of it; γ
    is zero where the filter needs less. No linear filter of this length has a smaller error within the
    power.

    Parameters
    ----------
    reference, disturbance, secondary_path, n_taps
        As in `wiener_solution`.
    rated_power : float
        Rated power (mean square of the control signal).

    Returns
    -------
    WienerSolution
        Weights, powers and noise reduction.

    Raises
    ------
    TypeError, ValueError
        As `wiener_solution`, or `rated_power` is not positive.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(2000)
    >>> solution = power_constrained_solution(x, 2 * x, [1.0], n_taps=1, rated_power=1.0)
    >>> round(solution.control_power, 4)
    1.0
    """
    rated_power = as_positive(rated_power, "rated_power")
    problem = _Problem(reference, disturbance, secondary_path, n_taps)
    if problem.control_power(0.0) <= rated_power:
        return problem.solve(0.0)
    # The control power falls as the penalty grows: bracket it, then bisect on a logarithmic scale.
    low = high = problem.filtered_power / problem.reference_power
    while problem.control_power(high) > rated_power:
        high *= 10
    while problem.control_power(low) < rated_power:
        low /= 10
    while high > low * (1 + 1e-9):
        middle = float(np.sqrt(low * high))
        power = problem.control_power(middle)
        if abs(power - rated_power) <= 1e-6 * rated_power:
            return problem.solve(middle)
        low, high = (middle, high) if power > rated_power else (low, middle)
    return problem.solve(high)


@dataclass(frozen=True)
class CoherenceBound:
    """The noise reduction that the coherence of reference and disturbance allows.

    Attributes
    ----------
    frequencies_hz : numpy.ndarray, shape (n_frequencies,)
        Frequencies in Hz.
    noise_reduction_db : numpy.ndarray, shape (n_frequencies,)
        Greatest noise reduction at each frequency in dB, at most 300 dB.
    overall_db : float
        The same for the whole disturbance.
    """

    frequencies_hz: np.ndarray
    noise_reduction_db: np.ndarray
    overall_db: float


def coherence_bound(reference: Any, disturbance: Any, fs: float, *, segment: int = 1024) -> CoherenceBound:
    """Noise reduction of a non-causal filter of any length: ``-10 log10(1 - coherence)``.

    What a microphone's own noise or a second source leaves out of the reference no control filter can
    reach. Spectra are averaged by Welch's method; with few segments the coherence comes out too high.

    Parameters
    ----------
    reference, disturbance : array_like, shape (n_samples,)
        Reference signal and disturbance.
    fs : float
        Sampling rate in Hz.
    segment : int
        Samples in a segment; the signals must hold at least eight.

    Returns
    -------
    CoherenceBound
        Frequencies, bound at each and overall.

    Raises
    ------
    TypeError, ValueError
        Signals of differing lengths, too short, or silent.

    References
    ----------
    .. [1] S. M. Kuo and D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal(160_000)
    >>> bound = coherence_bound(x, x + 0.1 * rng.standard_normal(x.size), fs=16000.0)
    >>> round(bound.overall_db)  # the part without coherence lies 20 dB below
    20
    """
    from scipy.signal import csd, welch

    fs = as_positive(fs, "fs", unit="Hz")
    segment = as_count(segment, "segment", minimum=8)
    x = as_signal(reference, "reference", min_length=8 * segment)
    d = as_signal(disturbance, "disturbance", length=x.size)
    frequencies, of_x = welch(x, fs, nperseg=segment)
    of_d = welch(d, fs, nperseg=segment)[1]
    if not np.any(of_x) or not np.any(of_d):
        raise ValueError("reference and disturbance must not be silent: their coherence is undefined")
    coherent = np.abs(csd(x, d, fs, nperseg=segment)[1]) ** 2 / np.maximum(of_x, np.finfo(float).tiny)
    floor = 1e-30
    remaining = np.clip(1 - coherent / np.maximum(of_d, np.finfo(float).tiny), floor, 1)
    overall = max(float(np.sum(remaining * of_d) / np.sum(of_d)), floor)
    return CoherenceBound(frequencies, -10 * np.log10(remaining), float(-10 * np.log10(overall)))


class _Problem:
    """Correlations of one least-squares problem, from which it is solved for any penalty."""

    def __init__(self, reference: Any, disturbance: Any, secondary_path: Any, n_taps: int) -> None:
        from scipy.signal import lfilter

        self.x = as_signal(reference, "reference")
        self.d = as_signal(disturbance, "disturbance", length=self.x.size)
        self.taps = path_taps(secondary_path, name="secondary_path")
        self.n_taps = as_count(n_taps, "n_taps")
        # From this sample on the delay lines of w and s are full.
        self.start = self.n_taps + self.taps.size - 2
        if self.x.size < self.start + self.n_taps:
            raise ValueError(
                f"reference must have at least {self.start + self.n_taps} samples for {self.n_taps} control "
                f"and {self.taps.size} path taps, got {self.x.size}; use a longer signal or fewer taps"
            )
        filtered = lfilter(self.taps, 1.0, self.x)
        self.reference_power = _power(self.x, self.start)
        self.filtered_power = _power(filtered, self.start)
        if self.filtered_power == 0 or _power(self.d, self.start) == 0:
            silent = "disturbance" if self.filtered_power else "reference through secondary_path"
            raise ValueError(f"{silent} must not be silent: there is nothing to solve for")
        self.filtered_matrix = correlation_matrix(filtered, self.n_taps, self.start)
        self.reference_matrix = correlation_matrix(self.x, self.n_taps, self.start)
        self.cross = cross_correlation(self.d, filtered, self.n_taps, self.start)

    def weights(self, penalty: float, ridge: float = 0.0) -> np.ndarray:
        matrix = self.filtered_matrix + penalty * self.reference_matrix
        matrix.flat[:: self.n_taps + 1] += ridge * self.filtered_power
        return minimum_norm_solve(matrix, self.cross)

    def control_power(self, penalty: float) -> float:
        weights = self.weights(penalty)
        return float(weights @ self.reference_matrix @ weights)

    def solve(self, penalty: float, ridge: float = 0.0) -> WienerSolution:
        from scipy.signal import lfilter

        weights = self.weights(penalty, ridge)
        control = lfilter(weights, 1.0, self.x)
        antinoise = lfilter(self.taps, 1.0, control)
        disturbance_power = _power(self.d, self.start)
        residual = max(_power(self.d - antinoise, self.start) / disturbance_power, 1e-30)
        return WienerSolution(
            weights=weights,
            control_power=_power(control, self.start),
            antinoise_power=_power(antinoise, self.start),
            disturbance_power=disturbance_power,
            noise_reduction_db=float(-10 * np.log10(residual)),
        )


def _power(signal: np.ndarray, start: int) -> float:
    return float(np.mean(signal[start:] ** 2))


def cross_correlation(output: np.ndarray, regressor: np.ndarray, n_taps: int, start: int) -> np.ndarray:
    """Mean of ``output[n] * regressor[n - j]`` over n >= start, for j = 0 ... n_taps - 1."""
    n = output.size
    return np.array([output[start:] @ regressor[start - j : n - j] for j in range(n_taps)]) / (n - start)


def correlation_matrix(signal: np.ndarray, n_taps: int, start: int) -> np.ndarray:
    """Mean of ``signal[n - i] * signal[n - j]`` over n >= start: the covariance method's matrix.

    Each row follows from the one above by the products that enter and leave the window.
    """
    count = signal.size - start
    matrix = np.zeros((n_taps, n_taps))
    matrix[0] = cross_correlation(signal, signal, n_taps, start)
    entering = signal[start - n_taps + 1 : start][::-1]  # signal[start - 1], signal[start - 2], ...
    leaving = signal[::-1][: n_taps - 1]  # signal[-1], signal[-2], ...
    for i in range(n_taps - 1):
        change = entering[i] * entering[i:] - leaving[i] * leaving[i:]
        matrix[i + 1, i + 1 :] = matrix[i, i:-1] + change / count
    return np.triu(matrix) + np.triu(matrix, 1).T


def minimum_norm_solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive semidefinite system, leaving out directions without energy."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _RANK_TOLERANCE * values[-1]
    return vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
