"""Whether a filter's errors are as large as its covariances say: NIS, NEES, and the correlation of the innovations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_count, as_number, as_real_array, require_finite


@dataclass(frozen=True, repr=False)
class Consistency:
    """Tests of a filter, made by `consistency`; ``print(result)`` sums them up.

    Attributes
    ----------
    nis : ndarray, shape (n_samples,)
        Normalised innovation squared, y' S^-1 y, the mean over the runs. NaN where nothing was measured.
    nis_bounds : ndarray, shape (2, n_samples)
        Lower and upper bound of each.
    nis_mean : float
        Mean NIS for each measurement: 1 if the innovations are as large as S says.
    nis_mean_bounds : ndarray, shape (2,)
        Its bounds.
    autocorrelation : ndarray, shape (max_lag,)
        Correlation of the innovations, each divided by its deviation, with those 1, 2, ... samples later; 0 if the
        filter is right.
    autocorrelation_bounds : ndarray, shape (max_lag,)
        Largest magnitude of each.
    nees : ndarray, shape (n_samples,), or None
        Normalised estimation error squared, (x - truth)' P^-1 (x - truth), the mean over the runs. None without a truth.
    nees_bounds : ndarray, shape (2,), or None
        Bounds of each.
    nees_mean : float or None
        Mean NEES for each state: 1 if the errors are as large as P says. It has no bounds, because the errors of
        neighbouring samples are alike.
    coverage : float
        Probability with which a value of a filter that is right lies within its bounds.
    """

    nis: np.ndarray
    nis_bounds: np.ndarray
    nis_mean: float
    nis_mean_bounds: np.ndarray
    autocorrelation: np.ndarray
    autocorrelation_bounds: np.ndarray
    nees: np.ndarray | None
    nees_bounds: np.ndarray | None
    nees_mean: float | None
    coverage: float

    def __repr__(self) -> str:
        return f"<Consistency: {'; '.join(self._lines())}>"

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> list[str]:
        low, high = self.nis_mean_bounds
        percent = f"{100 * self.coverage:g} %"
        outside = "" if low <= self.nis_mean <= high else f": S is too {'small' if self.nis_mean > high else 'large'}"
        lines = [f"NIS {self.nis_mean:.3g} for each measurement, {percent} within {low:.3g} to {high:.3g}{outside}"]
        first, bound = self.autocorrelation[0], self.autocorrelation_bounds[0]
        pace, size = ("slowly", "small") if first > 0 else ("fast", "large")
        why = "" if abs(first) <= bound else f": follows too {pace}, Q is too {size} relative to R"
        lines.append(f"correlation of neighbouring innovations {first:.2g}, {percent} within ±{bound:.2g}{why}")
        if self.nees is not None and self.nees_bounds is not None:
            low, high = self.nees_bounds
            inside = np.mean((low <= self.nees) & (self.nees <= high))
            share = f"{100 * inside:.0f} % of the samples within the {percent} bounds"
            lines.append(f"NEES {self.nees_mean:.3g} for each state, {share}")
        return lines


def consistency(
    saver: Any,
    *,
    truth: ArrayLike | None = None,
    coverage: float = 0.95,
    max_lag: int = 20,
) -> Consistency:
    r"""Test whether a filter's innovations, and its errors if the truth is known, are as large as it says.

    Parameters
    ----------
    saver : filterpy.common.Saver or sequence of them
        What a filter of filterpy or a `KFOPC` did, saved after each update; several are independent runs of one length. What
        was missing, a sample whose ``z`` was None or masked components, does not count.
    truth : array_like, shape (n_samples, n) or (n_runs, n_samples, n), optional
        True states.
    coverage : float, default 0.95
        Probability that a value of a filter that is right lies within its bounds, above 0 and below 1.
    max_lag : int, default 20
        Longest lag of the autocorrelation, in samples.

    Returns
    -------
    Consistency
        The tests and their bounds.

    Raises
    ------
    TypeError, ValueError
        A truth whose shape does not fit or that is not finite, covariances that are not positive definite, runs of
        different lengths, fewer samples than lags.

    See Also
    --------
    fit_noise : the noises that explain a record best.

    Notes
    -----
    If the model is right, the NIS of a sample with m measurements has a chi-square distribution with m degrees of freedom,
    and the NEES one with n. The mean over M runs has the bounds of M m degrees of freedom, divided by M. Innovations of a
    right filter are white, so the sum of all NIS is chi-square too, and each autocorrelation has the variance 1/N,
    where N is the number of products in it. Neighbouring errors of the state are correlated, so the share of
    the NEES within its bounds varies more from run to run than independent samples would: make several runs.

    In a filter that follows too slowly (Q too small, or R too large), neighbouring innovations have the same sign, and in
    one that follows too fast opposite ones. If only their size is wrong, S is: Q and R are wrong by one factor.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
    section 5.4.

    Examples
    --------
    >>> import numpy as np
    >>> from filterpy.common import Saver
    >>> from kfopc_filterpy import KFOPC
    >>> from kfopc_filterpy.filters import consistency
    >>> rng = np.random.default_rng(0)
    >>> level = np.cumsum(0.5 * rng.standard_normal(1000))
    >>> kf = KFOPC(dim_x=1)
    >>> kf.H, kf.Q, kf.R = np.eye(1), np.eye(1) * 0.01, np.eye(1) * 4.0  # Q should be 0.25
    >>> saver = Saver(kf)
    >>> for z in level + 2.0 * rng.standard_normal(1000):
    ...     kf.predict()
    ...     kf.update(z)
    ...     saver.save()
    >>> print(consistency(saver, truth=level[:, np.newaxis]))
    NIS 1.58 for each measurement, 95 % within 0.914 to 1.09: S is too small
    correlation of neighbouring innovations 0.29, 95 % within ±0.062: follows too slowly, Q is too small relative to R
    NEES 11.2 for each state, 49 % of the samples within the 95 % bounds
    """
    y, there, S, x, P = _saved(saver if isinstance(saver, list | tuple) else [saver])
    coverage, max_lag = as_number(coverage, "coverage"), as_count(max_lag, "max_lag")
    if not 0.0 < coverage < 1.0:
        raise ValueError(f"coverage must be above 0 and below 1, got {coverage:g}")
    from scipy.stats import chi2, norm

    tails = np.array([[0.5 - coverage / 2], [0.5 + coverage / 2]])
    n_runs, n_samples, rows = y.shape
    if n_samples <= max_lag:
        raise ValueError(f"there must be more than max_lag = {max_lag} samples, got {n_samples}; lower max_lag")
    if not there.any():
        raise ValueError("there must be a measurement, but every sample was missed")
    # An innovation that is missing has unit variance and is zero, so it adds nothing.
    both = there[..., :, np.newaxis] & there[..., np.newaxis, :]
    whitened = _whitened(y, np.where(both, S, np.eye(rows)), "S")
    freedom = there.sum(axis=(0, 2))
    nis = np.where(freedom > 0, np.sum(whitened**2, axis=(0, 2)) / n_runs, np.nan)
    nees = nees_bounds = nees_mean = None
    if truth is not None:
        n = x.shape[2]
        whitened_errors = _whitened(_errors(x, truth), P, "P")
        nees = np.sum(whitened_errors**2, axis=(0, 2)) / n_runs
        nees_bounds, nees_mean = chi2.ppf(tails[:, 0], n_runs * n) / n_runs, float(nees.mean() / n)
    products = np.zeros(max_lag)
    correlations = np.zeros(max_lag)
    for lag in range(1, max_lag + 1):
        pairs = there[:, :-lag] & there[:, lag:]
        early, late = whitened[:, :-lag][pairs], whitened[:, lag:][pairs]
        products[lag - 1] = early.size
        correlations[lag - 1] = early @ late / max(np.sqrt((early @ early) * (late @ late)), np.finfo(float).tiny)
    total = freedom.sum()
    return Consistency(
        nis=nis,
        nis_bounds=chi2.ppf(tails, np.where(freedom > 0, freedom, np.nan)) / n_runs,
        nis_mean=float(np.sum(whitened**2) / total),
        nis_mean_bounds=chi2.ppf(tails[:, 0], total) / total,
        autocorrelation=correlations,
        autocorrelation_bounds=norm.ppf(tails[1, 0]) / np.sqrt(np.maximum(products, 1.0)),
        nees=nees,
        nees_bounds=nees_bounds,
        nees_mean=nees_mean,
        coverage=coverage,
    )


def _saved(runs: Any) -> tuple[np.ndarray, ...]:
    """Return the innovations of several Savers, zero where they are missing, a mask of those there, and S, x and P."""
    if not all(hasattr(run, name) for run in runs for name in ("z", "y", "S", "x", "P")):
        raise TypeError("saver must be a filterpy.common.Saver that has saved each update, or a list of them")
    lengths = {len(run.z) for run in runs}
    if len(lengths) != 1:
        raise ValueError(f"the Savers must have saved equally many samples, got {sorted(lengths)}")
    y, S, z, x, P = (
        np.array([as_real_array(getattr(run, name), name) for run in runs]) for name in ("y", "S", "z", "x", "P")
    )
    y, x = (array.reshape(*array.shape[:2], -1) for array in (y, x))
    # filterpy saves None for a missed sample, and a `KFOPC` NaN for a missing component.
    there = np.broadcast_to(~np.isnan(z).reshape(*z.shape[:2], -1), y.shape)
    return y, there, S, x, P


def _errors(x: np.ndarray, truth: Any) -> np.ndarray:
    """Return the errors of the estimates, (n_runs, n_samples, n)."""
    states = as_real_array(truth, "truth")
    if states.shape not in (x.shape, x.shape[1:]):
        raise ValueError(
            f"truth must be {x.shape}, for (runs, samples, states), or {x.shape[1:]} for all runs, got {states.shape}"
        )
    require_finite(states, "truth")
    return x - states


def _whitened(errors: np.ndarray, covariances: np.ndarray, name: str) -> np.ndarray:
    """Return errors (..., k), transformed so that each has unit variance if the covariances are right."""
    require_finite(covariances, name)
    try:
        roots = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        raise ValueError(f"{name} must hold positive definite matrices, the covariances of errors") from None
    return np.linalg.solve(roots, errors[..., np.newaxis])[..., 0]
