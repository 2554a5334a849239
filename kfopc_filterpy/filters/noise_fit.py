"""State and measurement noise of any filter of filterpy's kind, by maximum likelihood over a record with gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import log, pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_finite_array, as_real_array, require_finite
from .checked_steps import as_covariance

STEP = 1e-3  # of log-variances, for derivatives: see the notes of `fit_noise`
COARSE = np.log(10.0) * np.arange(-8, 9, 2)  # factors that are tried first, 1e-8 to 1e8
STEEP = 1e-4  # the search ends with a smaller gradient, in log-likelihood for a variance multiplied by e
NO_LOSS = 1e-3  # a variance is taken as 0 if that costs less log-likelihood
SINGULAR = np.log(1e-13)  # of the determinant of S over its diagonal: below it, rounding decides
FLAT = 1e-2  # curvature of the log-likelihood below which a record does not determine a noise


@dataclass(frozen=True, repr=False)
class NoiseFit:
    """Noises of a filter, learned by `fit_noise`: ``kf.Q, kf.R = fit.Q, fit.R``.

    ``print(fit)`` shows the estimates with their standard errors.

    Attributes
    ----------
    state_noise, measurement_noise : ndarray, shapes (n_Q_parts,) and (n_R_parts,)
        Factors of the parts of Q and of R. 0 if the record shows none of that noise.
    state_noise_errors, measurement_noise_errors : ndarray, shapes (n_Q_parts,) and (n_R_parts,)
        Their standard errors; NaN for a factor of 0, where the likelihood has no peak.
    Q, R : ndarray, shapes (n, n) and (dim_z, dim_z)
        The noises themselves.
    log_likelihood : float
        Natural logarithm of the density of the record, at these noises.
    """

    state_noise: np.ndarray
    measurement_noise: np.ndarray
    state_noise_errors: np.ndarray
    measurement_noise_errors: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    log_likelihood: float

    def __repr__(self) -> str:
        return f"<NoiseFit: {', '.join(self._lines())}, log-likelihood {self.log_likelihood:.2f}>"

    def __str__(self) -> str:
        return "\n".join([*self._lines(), f"log-likelihood {self.log_likelihood:.2f}"])

    def _lines(self) -> list[str]:
        return [
            f"{name}[{i}] = {value:.3g} ± {error:.2g}"
            for name in ("state_noise", "measurement_noise")
            for i, (value, error) in enumerate(zip(getattr(self, name), getattr(self, f"{name}_errors"), strict=True))
        ]


def fit_noise(
    kf: Any,
    z: ArrayLike | Sequence[Any],
    *,
    H: ArrayLike | None = None,
    Q_parts: Sequence[ArrayLike] | None = None,
    R_parts: Sequence[ArrayLike] | None = None,
) -> NoiseFit:
    r"""Learn the state noise Q and the measurement noise R of a filter from a record, by maximum likelihood.

    Parameters
    ----------
    kf : filterpy.kalman.KalmanFilter
        A filter of filterpy or a `KFOPC`, before its first `predict`: its ``x`` and ``P`` are what was known before the
        record, ``F`` and ``H`` the model. It is not changed.
    z : array_like, shape (n_samples, dim_z), or (n_samples,) for one measurement, or list
        The record, in the measurements' units. A masked array (`numpy.ma`) says which are missing; in a list, None
        stands for a sample without any.
    H : array_like, shape (dim_z, n) or (n_samples, dim_z, n), optional
        Observation matrix, or that of each sample; by default ``kf.H``.
    Q_parts : sequence of array_like, each of shape (n, n), optional
        Positive semidefinite matrices. Q is to be their sum, each multiplied by a factor. By default ``[kf.Q]``: with
        ``Q_discrete_white_noise(var=1)`` the factor is the variance of the acceleration. An empty list keeps ``kf.Q``.
    R_parts : sequence of array_like, each of shape (dim_z, dim_z), optional
        The same for R. By default ``[kf.R]``.

    Returns
    -------
    NoiseFit
        The factors with their standard errors, Q, R and the log-likelihood.

    Raises
    ------
    TypeError, ValueError
        Wrong shapes; NaN or Inf; a matrix that is not symmetric and positive semidefinite; no part to learn; a filter
        with a fading memory (``alpha``), which is not a model with a likelihood; a record that is too short or does not
        tell the parts apart.

    See Also
    --------
    consistency : whether the innovations agree with the noises.
    suggest_settings : the length and the noises of a controller for noise control, from a recording of a silent run.

    Notes
    -----
    The likelihood is the product of the densities of the innovations (Durbin & Koopman, section 7.2), of the
    measurements that are there: rows of H and R for missing ones are left out (section 4.10). The measurements are not
    scaled by a `KFOPC`'s constraint factor. The logarithms of the factors are found by a trust region with second
    derivatives, from the best point of a grid of 1e-8 to 1e8 times Q and R. So scale the parts to within that of what you
    expect.

    Derivatives are central differences over 1e-3 of a log-variance, which are good to about 1e-6. The search ends at a
    gradient of 1e-4, so the factors are within 1e-4 of their standard errors. The standard errors come from the inverse
    of the observed information, the negative second derivative of the log-likelihood, and of factors by
    :math:`\sigma(f) = f\, \sigma(\log f)`. They hold for long records. All points of a difference go through the record
    together.

    A record with a steady error of the model (a wrong F, a bias) puts it into the noises.

    References
    ----------
    J. Durbin, S. J. Koopman, "Time Series Analysis by State Space Methods", 2nd edition (2012).

    Examples
    --------
    >>> import numpy as np
    >>> from filterpy.kalman import KalmanFilter
    >>> from kfopc_filterpy.filters import fit_noise
    >>> rng = np.random.default_rng(0)
    >>> level = np.cumsum(0.5 * rng.standard_normal(500))
    >>> z = np.ma.array(level + 2.0 * rng.standard_normal(500))
    >>> z[100:150] = np.ma.masked  # a gap
    >>> kf = KalmanFilter(dim_x=1, dim_z=1)
    >>> kf.H = np.array([[1.0]])
    >>> print(fit_noise(kf, z))  # true: 0.25 and 4
    state_noise[0] = 0.229 ± 0.062
    measurement_noise[0] = 3.42 ± 0.26
    log-likelihood -973.80
    """
    record = _Record(kf, z, H)
    n, rows = record.F.shape[0], record.H.shape[1]
    Q_matrices, Q_fixed = _parts(Q_parts, kf.Q, n, "Q")
    R_matrices, R_fixed = _parts(R_parts, kf.R, rows, "R")
    n_q, n_parts = len(Q_matrices), len(Q_matrices) + len(R_matrices)
    if not n_parts:
        raise ValueError("nothing to learn: Q_parts and R_parts are both empty; leave one out, or give a matrix")
    if record.there.sum() <= n_parts:
        raise ValueError(f"z must hold more than {n_parts} measurements for {n_parts} noises, got {record.there.sum()}")

    def likelihoods(factors: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of each row of factors."""
        Q = Q_fixed + np.tensordot(factors[:, :n_q], Q_matrices, 1)
        R = R_fixed + np.tensordot(factors[:, n_q:], R_matrices, 1)
        return record.log_likelihoods(Q, R)

    # Begin with the best of a grid that has one factor for all parts of Q, and one for all of R.
    grid = np.repeat([(q, r) for q in COARSE for r in COARSE], [n_q, n_parts - n_q], axis=1)
    logs, value, information = _peak(likelihoods, grid[np.argmax(likelihoods(np.exp(grid)))])
    factors, errors, unclear = np.exp(logs), np.full(n_parts, np.nan), np.zeros(n_parts, bool)
    for i in range(n_parts):
        others = np.tile(factors, (2, 1))
        others[:, i] = 0.0, np.exp(COARSE[-1])
        value_without, value_with_much = likelihoods(others)
        if value_without >= value - NO_LOSS:
            unclear[i] = value_with_much >= value - NO_LOSS
            factors, value = others[0], value_without
    found = factors > 0
    curvatures, vectors = np.linalg.eigh(information[np.ix_(found, found)])
    if np.any(curvatures < FLAT):
        unclear[found] |= np.abs(vectors[:, 0]) > 0.1
    if unclear.any():
        names = [f"state_noise[{i}]" for i in range(n_q)]
        names += [f"measurement_noise[{i}]" for i in range(n_parts - n_q)]
        raise ValueError(
            f"the record does not determine {' and '.join(np.array(names)[unclear])}: the likelihood is the same for other "
            "values; give fewer parts, or a longer record"
        )
    errors[found] = factors[found] * np.sqrt(np.sum(vectors**2 / curvatures, axis=1))
    Q, R = Q_fixed + np.tensordot(factors[:n_q], Q_matrices, 1), R_fixed + np.tensordot(factors[n_q:], R_matrices, 1)
    return NoiseFit(factors[:n_q], factors[n_q:], errors[:n_q], errors[n_q:], Q, R, float(value))


class _Record:
    """A record and the model that explains it, all but its noises."""

    def __init__(self, kf: Any, z: Any, H: Any) -> None:
        if getattr(kf, "alpha", 1.0) != 1.0:
            raise ValueError(f"kf.alpha must be 1, got {kf.alpha:g}: a fading memory is no model with a likelihood")
        self.x, self.F = as_finite_array(kf.x, "kf.x").ravel(), as_finite_array(kf.F, "kf.F")
        n = self.x.size
        self.P = as_covariance(kf.P, n, "kf.P")
        self.H = np.atleast_2d(as_finite_array(kf.H if H is None else H, "H"))
        if self.F.shape != (n, n) or self.H.ndim > 3 or self.H.shape[-1] != n:
            raise ValueError(
                f"F must be ({n}, {n}) and H (dim_z, {n}) or (n_samples, dim_z, {n}) for a filter of {n} states, "
                f"got F {self.F.shape} and H {self.H.shape}"
            )
        if not self.H.any():
            raise ValueError("H must not be zero: it says what is measured; assign kf.H or pass H=")
        self.z, self.there = _measured(z, self.H.shape[-2])
        if self.H.ndim == 3 and len(self.H) != len(self.z):
            raise ValueError(f"H must have one matrix for each of the {len(self.z)} samples of z, got {len(self.H)}")
        self.H = np.broadcast_to(self.H, (len(self.z), *self.H.shape[-2:]))

    def log_likelihoods(self, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Return the log-likelihood with each of several Q, (m, n, n), and R, (m, dim_z, dim_z)."""
        x, P = np.tile(self.x, (len(Q), 1)), np.tile(self.P, (len(Q), 1, 1))
        total = np.full(len(Q), -0.5 * log(2 * pi) * self.there.sum())
        identity = np.eye(self.x.size)
        for z, there, rows in zip(self.z, self.there, self.H, strict=True):
            x, P = x @ self.F.T, self.F @ P @ self.F.T + Q
            if not there.any():
                continue
            H, noise = (rows, R) if there.all() else (rows[there], R[:, there][:, :, there])
            PH = P @ H.T
            S = H @ PH + noise
            sign, determinant = np.linalg.slogdet(S)
            variances = np.diagonal(S, axis1=1, axis2=2)
            usual = (sign > 0) & (variances > 0).all(axis=1)
            usual[usual] = determinant[usual] > SINGULAR + np.log(variances[usual]).sum(axis=1)
            if not usual.all():  # no noise in a measurement of what is known exactly
                total[~usual], determinant[~usual], S[~usual], PH[~usual] = -np.inf, 0.0, np.eye(len(H)), 0.0
            gain = np.linalg.solve(S, PH.swapaxes(1, 2)).swapaxes(1, 2)
            y = z[there] - x @ H.T
            weighted = np.linalg.solve(S, y[:, :, np.newaxis])[:, :, 0]
            total -= 0.5 * (determinant + np.sum(y * weighted, axis=1))
            x = x + (PH @ weighted[:, :, np.newaxis])[:, :, 0]
            left = identity - gain @ H
            P = left @ P @ left.swapaxes(1, 2) + gain @ noise @ gain.swapaxes(1, 2)  # Joseph's form
        return total


def _measured(z: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a record as numbers, (n_samples, rows), and which of them are there."""
    if isinstance(z, list | tuple):
        samples = [np.ma.array(np.zeros(rows), mask=True) if value is None else np.ma.atleast_1d(value) for value in z]
        hidden = [np.ma.getmaskarray(sample) for sample in samples]
        if any(np.size(sample) != rows for sample in samples):
            raise ValueError(f"z must hold None or {rows} value(s) for each sample, one for each row of H")
        z = np.ma.array([np.ma.getdata(sample).ravel() for sample in samples], mask=np.reshape(hidden, (-1, rows)))
    there = ~np.ma.getmaskarray(z)
    values = as_real_array(np.ma.getdata(z), "z")
    if (values.ndim == 1 and rows == 1) or (values.ndim == 3 and values.shape[2] == 1):
        values, there = values.reshape(len(values), -1), there.reshape(len(values), -1)
    if values.ndim != 2 or values.shape[1] != rows:
        raise ValueError(f"z must be a record (n_samples, {rows}), for the {rows} row(s) of H, got {values.shape}")
    values = np.where(there, values, 0.0)
    try:
        require_finite(values, "z")
    except ValueError as error:
        raise ValueError(f"{error}; mask what is missing: np.ma.masked_invalid(z)") from None
    return values, there


def _parts(parts: Any, own: Any, size: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices to multiply, (n_parts, size, size), and what is added to them."""
    given = [own] if parts is None else list(parts)
    checked = []
    for i, part in enumerate(given or [own]):
        label = f"kf.{name}" if not given or parts is None else f"{name}_parts[{i}]"
        matrix = as_covariance(part, size, label)
        if given and not matrix.any():
            raise ValueError(f"{label} must not be zero: no factor changes it; leave it out")
        checked.append(matrix)
    if given and np.linalg.matrix_rank(np.reshape(checked, (len(checked), -1))) < len(checked):
        raise ValueError(f"{name}_parts must not be sums of multiples of each other: leave out what adds nothing")
    nothing = np.zeros((size, size))
    return (np.array(checked), nothing) if given else (np.zeros((0, size, size)), checked[0])


def _peak(likelihoods: Any, start: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the log-factors of the largest log-likelihood, that, and its negative second derivative there."""
    from scipy.optimize import minimize

    size = len(start)
    pairs = [(i, j) for i in range(size) for j in range(i)]
    unit = np.eye(size)
    steps = [np.zeros(size), *unit, *-unit]
    steps += [a * unit[i] + b * unit[j] for i, j in pairs for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]

    @cache
    def expansion(point: tuple[float, ...]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the negative log-likelihood with its first and second derivatives."""
        middle, *around = -likelihoods(np.exp(np.array(point) + STEP * np.array(steps)))
        up, down = np.array(around[:size]), np.array(around[size : 2 * size])
        second = np.diag(up + down - 2 * middle)
        for (i, j), corner in zip(pairs, np.reshape(around[2 * size :], (-1, 4)), strict=True):
            second[i, j] = second[j, i] = (corner[0] - corner[1] - corner[2] + corner[3]) / 4
        return float(middle), (up - down) / (2 * STEP), second / STEP**2

    found = minimize(
        lambda point: expansion(tuple(point))[:2],
        start,
        jac=True,
        hess=lambda point: expansion(tuple(point))[2],
        method="trust-exact",
        options={"gtol": STEEP, "initial_trust_radius": 1.0, "max_trust_radius": 10.0, "maxiter": 100},
    )
    if not found.success:
        raise ValueError(
            "the likelihood has no peak: it grows as the noises vanish, or as they grow; "
            "z may be constant, or without any noise, or very far from what kf.x, kf.P, F and H say"
        )
    value, _, information = expansion(tuple(found.x))
    return found.x, -value, information
