"""An estimate within limits: equalities, boxes, linear inequalities and a power."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_finite_array, as_positive, as_real_array
from .checked_steps import as_covariance

ROUNDING = 1e-12  # eigenvalues of a correlation matrix, and slopes of limits, below this are taken as zero
KEPT = 1e-9  # how well linear limits are kept, in the unit of `_in_deviations`
BESIDE_VALUES = 1e-4  # KEPT times this is the rounding of the values themselves
MOST = 1e16  # largest price of power that is tried, relative to the price at which the power begins to fall

CONTRADICT = "the limits contradict each other, or ask for what P = 0 rules out: widen one of them, or leave one out"


def constrained(
    kf: Any,
    *,
    equalities: tuple[ArrayLike, ArrayLike] | None = None,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    inequalities: tuple[ArrayLike, ArrayLike] | None = None,
    power: tuple[ArrayLike, float] | None = None,
    project: bool = False,
) -> np.ndarray:
    r"""Return the state within limits that is nearest to a filter's estimate, in the metric of its covariance.

    Parameters
    ----------
    kf : filterpy.kalman.KalmanFilter
        A filter of filterpy or a `KFOPC`: whatever has a state ``x``, (n,) or (n, 1), and its covariance ``P``, (n, n).
    equalities : (D, d), optional
        Matrix (m, n) and values (m,) of D x = d. One row may be given as (n,) and a number.
    lower, upper : float or array_like, shape (n,), optional
        Limits of each state, in its unit; -Inf and Inf leave a state free.
    inequalities : (A, b), optional
        Matrix (m, n) and values (m,) of A x <= b.
    power : (M, rho), optional
        Positive semidefinite matrix (n, n) and limit above 0 of x' M x <= rho.
    project : bool, default False
        False: the filter keeps its own x and P, and the limits act on what is given out. True: ``kf.x`` becomes the
        returned state. If there are equalities, ``kf.P`` becomes the covariance of what they leave free. Inequalities
        and a power leave P as it is, because a limit that is touched is still no measurement.

    Returns
    -------
    ndarray, shape of ``kf.x``
        The state within the limits.

    Raises
    ------
    TypeError
        Limits that are not numbers, or not a pair.
    ValueError
        Wrong shapes, a lower limit above the upper one, a P or M that is not symmetric and positive semidefinite,
        limits that contradict each other. The filter has not changed then.

    See Also
    --------
    kf_pb : the limit x' M x <= rho for noise control, with M the autocorrelation matrix of the reference.

    Notes
    -----
    The state minimises :math:`(x - \hat x)^T P^{-1} (x - \hat x)` within the limits: the most probable state of a
    Gaussian posterior that the limits allow. Where P is singular, the state moves only as far as P lets it.

    With equalities alone it is :math:`\hat x - P D^T (D P D^T)^{-1} (D \hat x - d)`. With linear inequalities it is a
    least-distance problem, which non-negative least squares solves in finitely many steps (Lawson & Hanson 1974); the
    limits that it finds active are then met as equalities, to rounding. With a power it is
    :math:`(P^{-1} + \lambda M)^{-1} P^{-1} \hat x` within the others, at the least price :math:`\lambda \ge 0` that keeps
    the power. The price is the root of one equation, found to 1e-13, and the power then holds to about 1e-10 of rho.

    References
    ----------
    D. Simon, T. L. Chia, "Kalman filtering with state equality constraints", IEEE Trans. Aerosp. Electron. Syst. 38
    (2002). D. Simon, "Kalman filtering with state constraints: a survey of linear and nonlinear algorithms", IET Control
    Theory Appl. 4 (2010). C. L. Lawson, R. J. Hanson, "Solving Least Squares Problems" (1974), chapter 23.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import KFOPC
    >>> from kfopc_filterpy.filters import constrained
    >>> kf = KFOPC(dim_x=2)
    >>> kf.x, kf.P = np.array([[3.0], [4.0]]), np.diag([1.0, 4.0])
    >>> print(constrained(kf, equalities=([1.0, 1.0], 4.5)).ravel().round(9))  # the uncertain state moves most
    [2.5 2. ]
    >>> constrained(kf, upper=[2.0, np.inf]).ravel()
    array([2., 4.])
    >>> nearest = constrained(kf, power=(np.eye(2), 9.0)).ravel()
    >>> print(round(float(nearest @ nearest), 9))
    9.0
    """
    estimate = as_finite_array(kf.x, "kf.x")
    n = estimate.size
    if estimate.shape not in ((n,), (n, 1)):
        raise ValueError(f"kf.x must have shape (n,) or (n, 1), got {estimate.shape}")
    P = as_covariance(kf.P, n, "kf.P")
    centre, deviations = estimate.ravel(), np.sqrt(np.diagonal(P))
    D, d = _in_deviations(*_rows(equalities, n, "equalities"), centre, deviations)
    A, b = _in_deviations(*_all_inequalities(inequalities, lower, upper, n), centre, deviations)
    directions = _directions(P, deviations)
    if len(D):
        step, free = _on_equalities(D @ directions, d - D @ centre)
        centre, directions = centre + directions @ step, directions @ free
    if power is None:
        state = centre + directions @ _least_distance(A @ directions, b - A @ centre)
    elif not isinstance(power, tuple | list) or len(power) != 2:
        raise TypeError(f"power must be a pair of a matrix ({n}, {n}) and a limit, got {type(power).__name__}")
    else:
        M, rho = as_covariance(power[0], n, "power[0]"), as_positive(power[1], "power[1]")
        state = _within_power(centre, directions, A, b, M, rho)
    state = state.reshape(estimate.shape)
    if project:
        kf.x = state.copy()
        if len(D):
            kf.P = directions @ directions.T
    return state


def _directions(P: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return T with T T' = P: x = centre + T u has the distance |u| from the centre."""
    scale = np.where(deviations > 0, deviations, 1.0)  # the eigenvalues must not depend on the units of the states
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    there = values > ROUNDING
    return scale[:, np.newaxis] * vectors[:, there] * np.sqrt(values[there])


def _in_deviations(
    rows: np.ndarray, values: np.ndarray, centre: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return linear limits in units of a standard deviation each, whatever the units of the states are."""
    sizes = np.abs(rows) @ np.abs(centre) + np.abs(values)
    unit = np.linalg.norm(rows * deviations, axis=1) + BESIDE_VALUES * sizes
    unit[unit == 0.0] = 1.0
    return rows / unit[:, np.newaxis], values / unit


def _rows(pair: Any, n: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix (m, n) and the values (m,) of linear limits."""
    if pair is None:
        return np.zeros((0, n)), np.zeros(0)
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise TypeError(f"{name} must be a pair of a matrix (m, {n}) and values (m,), got {type(pair).__name__}")
    matrix = np.atleast_2d(as_finite_array(pair[0], f"{name}[0]"))
    values = np.atleast_1d(as_finite_array(pair[1], f"{name}[1]"))
    if matrix.ndim != 2 or matrix.shape[1] != n or values.shape != (len(matrix),):
        raise ValueError(
            f"{name} must be a matrix (m, {n}) and values (m,), got shapes {matrix.shape} and {values.shape}; "
            "give one row and one value for each limit"
        )
    return matrix, values


def _all_inequalities(inequalities: Any, lower: Any, upper: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b of A x <= b, boxes included."""
    A, b = _rows(inequalities, n, "inequalities")
    ends = {}
    for name, value, free in (("lower", lower, -np.inf), ("upper", upper, np.inf)):
        limit = as_real_array(free if value is None else value, name)
        if limit.shape not in ((), (n,)) or np.any(np.isnan(limit)) or np.any(limit == -free):
            raise ValueError(f"{name} must be one number or ({n},), {free:g} for a state without one, got {value!r}")
        ends[name] = np.broadcast_to(limit, n)
    if np.any(crossed := ends["lower"] > ends["upper"]):
        i = int(np.argmax(crossed))
        raise ValueError(f"lower[{i}] = {ends['lower'][i]:g} must not be above upper[{i}] = {ends['upper'][i]:g}")
    for name, sign in (("lower", -1.0), ("upper", 1.0)):
        limited = np.isfinite(ends[name])
        A, b = np.vstack([A, sign * np.eye(n)[limited]]), np.append(b, sign * ends[name][limited])
    return A, b


def _on_equalities(G: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest u with G u = h, and an orthonormal basis of all that keeps G u."""
    left, sizes, right = np.linalg.svd(G)
    rank = int(np.sum(sizes > ROUNDING))
    u = right[:rank].T @ (left[:, :rank].T @ h / sizes[:rank])
    if np.any(np.abs(G @ u - h) > KEPT * (1.0 + np.abs(h))):
        raise ValueError(CONTRADICT)
    return u, right[rank:].T


def _least_distance(G: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the shortest u with G u <= h."""
    sizes = np.linalg.norm(G, axis=1)
    free = sizes <= ROUNDING  # no u changes these rows
    if np.any(h[free] < -KEPT):
        raise ValueError(CONTRADICT)
    G, h = G[~free] / sizes[~free, np.newaxis], h[~free] / sizes[~free]
    u, farthest = np.zeros(G.shape[1]), -h.min(initial=0.0)
    if farthest == 0.0:
        return u
    from scipy.optimize import nnls

    # Lawson and Hanson's LDP: the positive multipliers are those of the active limits.
    weights, _ = nnls(np.vstack([-G.T, -h / farthest]), np.append(np.zeros_like(u), 1.0), maxiter=30 * len(h) + 100)
    active = weights > 0
    u, *_ = np.linalg.lstsq(G[active], h[active], rcond=None)
    if not np.all(G @ u - h <= KEPT * (1.0 + farthest)):
        raise ValueError(CONTRADICT)
    return u


def _within_power(
    centre: np.ndarray, directions: np.ndarray, A: np.ndarray, b: np.ndarray, M: np.ndarray, rho: float
) -> np.ndarray:
    """Return the nearest state with A x <= b and x' M x <= rho."""
    # Along the eigenvectors of M, the distance and a price of the power add up state by state.
    powers, vectors = np.linalg.eigh(directions.T @ M @ directions)
    powers, directions = np.maximum(powers, 0.0), directions @ vectors
    slope = directions.T @ M @ centre

    def at(price: float) -> np.ndarray:
        stiffness = 1.0 + price * powers
        start = centre - directions @ (price * slope / stiffness)
        scaled = directions / np.sqrt(stiffness)
        return start + scaled @ _least_distance(A @ scaled, b - A @ start)

    def excess(price: float) -> float:
        x = at(price)
        return float(np.sqrt(max(x @ M @ x, 0.0) / rho) - 1.0)

    if excess(0.0) <= 0.0:
        return at(0.0)
    from scipy.optimize import brentq

    unit = 1.0 / max(powers.max(initial=0.0), np.finfo(float).tiny)
    high = unit
    while excess(high) > 0.0:
        high *= 10.0
        if high > MOST * unit:
            raise ValueError(f"no state with x' M x <= {rho:g} keeps the other limits: raise rho, or {CONTRADICT}")
    return at(brentq(excess, high / 10.0 if high > unit else 0.0, high, xtol=1e-300, rtol=1e-13, maxiter=500))
