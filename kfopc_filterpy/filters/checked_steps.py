"""Checks of the steps of a filterpy filter: of their arguments, and of what they leave; a step that fails is undone."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from math import isfinite, pi
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike
from scipy.linalg.blas import dasum  # the sum of the magnitudes: quick, and without a warning if it overflows

from .._validate import as_finite_array, as_number, as_real_array, require_finite

# Of the largest element: rounding makes P neither less symmetric, nor one of its eigenvalues more negative.
ASYMMETRY_LIMIT, INDEFINITE_LIMIT = 1e-8, 1e-8

FLOAT = np.dtype(np.float64)

SILENT_REFERENCE = (
    "a silent reference (H = 0) with R = 0 tells nothing: give R > 0, or z=None for a missed sample. "
    "Nothing was changed"
)
NOT_FINITE = (
    "{} would hold NaN, Inf or masked values: look for them, or for values that overflow, in x, P, F, Q, R, H, M, K before "
    "this step"
)

Checks = Callable[..., Any]  # of the arguments of a step, with the filter before them


def run_or_undo(kf: KalmanFilter, step: Callable[..., None], arguments: tuple[Any, ...], checks: Checks | None) -> None:
    """Run a step of `kf`: either it leaves x and P finite, or it raises an error and changes nothing.

    NaN and Inf in an argument reach x or P. So the `checks`, which say which argument is wrong, need only be made after a
    failure. The step must assign arrays, as filterpy's steps do, or copy those it writes into.
    """
    before = kf.__dict__.copy()
    try:
        step(*arguments)
        if not _is_plainly_sound(kf):
            _require_sound(kf)
    except BaseException as error:
        kf.__dict__.clear()
        kf.__dict__.update(before)
        # numpy's warnings may be errors
        if not isinstance(error, ValueError | TypeError | OverflowError | RuntimeWarning):
            raise
        if checks is not None:
            checks(kf, *arguments)
        name, cause = step.__name__, NOT_FINITE.format("x or P") if isinstance(error, RuntimeWarning) else error
        if isinstance(error, np.linalg.LinAlgError):
            raise ValueError(f"{name}: S = H P H' + R cannot be inverted ({error}); {SILENT_REFERENCE}") from error
        given = {"x": kf.x, "P": kf.P, **dict(zip(signature(step).parameters, arguments, strict=False))}
        shapes = {key: np.shape(value) for key, value in given.items() if value is not None}
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"{name}: {cause} (shapes: {shapes}). Nothing was changed") from error


def _is_plainly_sound(kf: KalmanFilter) -> bool:
    """Return whether x and P are finite arrays of floats of the usual sizes; a finite sum implies finite elements."""
    x, P, n = kf.x, kf.P, kf.dim_x
    if not (type(x) is type(P) is np.ndarray and x.dtype == P.dtype == FLOAT):
        return False
    if x.shape not in ((n, 1), (n,)) or P.shape != (n, n):
        return False
    return isfinite(dasum(x) + dasum(P.ravel()))


def _require_sound(kf: KalmanFilter) -> None:
    """Raise an error unless x and P have their shapes and are real and finite."""
    n = kf.dim_x
    if np.shape(kf.x) not in ((n, 1), (n,)) or np.shape(kf.P) not in ((), (n, n)):
        raise ValueError(f"x would become {np.shape(kf.x)} and P {np.shape(kf.P)}, for dim_x = {n}")
    for key in ("x", "P"):
        value = np.ma.asarray(getattr(kf, key))
        if value.dtype.kind not in "biuf":
            raise TypeError(f"{key} would become an array of {value.dtype}, but needs real numbers")
        if np.ma.is_masked(value) or not np.isfinite(value.data).all():
            raise ValueError(NOT_FINITE.format(key))


def is_variance(value: Any, shape: tuple[int, int]) -> bool:
    """Return whether a value is an array of floats of this shape, without negative variances."""
    return (
        type(value) is np.ndarray
        and value.shape == shape
        and value.dtype == FLOAT
        and not min(value.diagonal().tolist()) < 0
    )


def is_usual_measurement(kf: KalmanFilter, z: Any, R: Any, H: Any) -> bool:
    """Return whether z, R and H are arrays of the sizes that filterpy uses as they are, H that of the filter."""
    rows, row = kf.dim_z, kf.H if H is None else H
    if type(z) is float:
        usual = rows == 1
    else:
        usual = type(z) is np.ndarray and z.shape in ((rows, 1), (rows,)) and (H is None or z.ndim == np.ndim(kf.x))
    return (
        usual
        and type(row) is np.ndarray
        and row.shape == (rows, kf.dim_x)
        and is_variance(kf.R if R is None else R, (rows, rows))
    )


def checked_measurement(
    kf: KalmanFilter, z: ArrayLike, R: ArrayLike | None, H: ArrayLike | None
) -> tuple[ArrayLike, ArrayLike | None, np.ndarray | None]:
    """Return z, R and H as filterpy handles them, or raise a clear error."""
    n = kf.dim_x
    given = kf.H if H is None else H
    row = np.reshape(given, (1, -1)) if np.ndim(given) < 2 else np.asarray(given)
    if row.ndim != 2 or row.shape[1] != n:
        raise ValueError(f"H must have shape ({n},) or (dim_z, {n}), got {np.shape(given)}")
    as_finite_array(given, "H")
    rows = len(row)
    require_measurement(z, rows)
    noise = kf.R if R is None else R
    size = kf.dim_z if np.isscalar(R) else len(np.atleast_1d(noise))  # filterpy makes a number that is passed a matrix
    if size != rows and (np.isscalar(R) or np.ndim(noise)):
        raise ValueError(f"R must have shape ({rows}, {rows}), as H has rows, got {noise!r} for dim_z = {kf.dim_z}")
    require_variance(noise, rows, "R")
    if np.shape(noise) == (1,):
        R = np.reshape(noise, (1, 1))
    if H is None and np.ndim(given) == 2:
        return z, R, None
    shape = np.shape(z)
    # filterpy 2.0.0 does not reshape z if H is given: (rows,) against a column would broadcast
    wanted = (rows, 1) if np.ndim(kf.x) == 2 else (rows,)
    if H is not None and (not shape or shape == wanted or (rows == 1 and len(wanted) == 2)):
        return z, R, row
    return np.reshape(z, wanted), R, row


def checked_prediction(kf: KalmanFilter, u: Any, B: Any, F: Any, Q: Any) -> tuple[Any, Any, Any, Any]:
    """Return u, B, F and Q as filterpy handles them, or raise a clear error."""
    n = kf.dim_x
    F = as_matrix(F, "F")
    if F is not None and np.ndim(F) == 0:
        F = np.float64(as_number(F, "F"))  # filterpy transposes it, which Python's numbers cannot
    transition = kf.F if F is None else F
    require_matrix(transition, (n, n) if np.ndim(transition) else (), "F")
    require_variance(kf.Q if Q is None else Q, n, "Q")
    require_control(kf, u, B)
    return u, B, F, Q


def as_matrix(value: Any, name: str) -> Any:
    """Return a list or tuple as an array, and anything else as it is."""
    return as_real_array(value, name) if isinstance(value, list | tuple) else value


def is_usual_prediction(kf: KalmanFilter, F: Any, Q: Any) -> bool:
    """Return whether F and Q are arrays of their sizes."""
    square, transition = (kf.dim_x, kf.dim_x), kf.F if F is None else F
    return (
        type(transition) is np.ndarray and transition.shape == square and is_variance(kf.Q if Q is None else Q, square)
    )


def require_control(kf: KalmanFilter, u: ArrayLike | None, B: ArrayLike | None) -> None:
    """Raise an error if a control input u, or the B that it passes, is not real and finite. Without B, u is not used."""
    passed = kf.B if B is None else B
    if u is not None and passed is not None:
        for name, value in {"u": u, "B": passed}.items():
            as_finite_array(value, name)


def with_masks(z: Any) -> Any:
    """Return a measurement as a masked array if None is among its components, as in a table with gaps."""
    has_objects = (
        z.dtype.kind == "O"
        if isinstance(z, np.ndarray)
        else isinstance(z, list | tuple) and any(one is None for one in z)
    )
    if not has_objects:
        return z
    values = np.asarray(z, dtype=object)
    missing = np.reshape([one is None for one in values.flat], values.shape)
    return np.ma.masked_array(as_real_array(np.where(missing, 0.0, values), "z"), missing)


def without_masked(kf: KalmanFilter, z: np.ma.MaskedArray, R: Any, H: Any) -> tuple[Any, Any, Any, np.ndarray | None]:
    """Return z, R and H with which filterpy corrects by the components of z that are not masked, and which are masked.

    z is None if all are. A masked component gets a row of zeros in H and a noise of its own, so that all sizes stay: its
    residual and its gain are 0. The noise is 1/(2 pi), which adds nothing to the log-likelihood.
    """
    missing = np.ma.getmaskarray(z).reshape(-1)
    if missing.all():
        return None, R, H, None
    if not missing.any():
        return z.data, R, H, None
    size = missing.size
    row, noise = np.array(kf.H if H is None else H), np.array(kf.R if R is None else R)
    if row.shape != (size, kf.dim_x):
        raise ValueError(f"z must have {len(np.atleast_2d(row))} value(s), with the masked ones, got shape {z.shape}")
    require_variance(noise, size, "R")
    noise = noise * np.eye(size) if noise.ndim == 0 else noise.astype(np.float64)
    row[missing], noise[missing], noise[:, missing] = 0.0, 0.0, 0.0
    noise[missing, missing] = 0.5 / pi
    values = np.where(missing, 0.0, z.data.reshape(-1)).reshape((size, 1)[: np.ndim(kf.x)])
    return values, noise, row, missing


def require_unmasked(z: ArrayLike) -> None:
    """Raise ValueError if a component of z is masked: numpy would use the value behind the mask."""
    if np.ma.is_masked(z):
        raise ValueError("z must not be masked, except in update and batch_filter: pass None for a missed sample")


def require_measurement(z: ArrayLike, rows: int) -> None:
    """Raise an error unless z holds finite numbers, one per row of H, in a shape that converts to (rows, 1)."""
    require_unmasked(z)
    values = np.asarray(z)
    if values.dtype.kind == "c":
        raise TypeError(f"z must be real, got complex numbers: {z!r}")
    if values.dtype.kind not in "biuf":
        raise TypeError(f"z must be a number or an array of numbers, or None for a missed sample, got {z!r}")
    shape = values.shape
    if values.size != rows or shape not in ((), (rows,), (rows, 1), (1, rows)):
        raise ValueError(f"z must have {rows} value(s), shape ({rows}, 1) or what converts to it, got shape {shape}")
    if not np.isfinite(values).all():
        try:
            require_finite(values, "z")
        except ValueError as error:
            raise ValueError(f"{error}. If a value is missing, mask it: np.ma.masked_invalid(z)") from None


def require_matrix(value: ArrayLike, shape: tuple[int, ...], name: str) -> None:
    """Raise ValueError unless `value` is finite and has this shape."""
    if np.shape(value) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")
    as_finite_array(value, name)


def require_variance(value: ArrayLike, size: int, name: str) -> None:
    """Raise ValueError unless `value` is a finite variance: a number, or (size, size) with no negative diagonal."""
    if np.ndim(value) > 0 and np.size(value) > 1:
        require_matrix(value, (size, size), name)
    else:
        as_finite_array(value, name)
    if np.min(np.diagonal(value) if np.ndim(value) == 2 else value) < 0:
        raise ValueError(f"{name} must not be negative: it is a variance, got {value!r}")


def as_covariance(value: Any, size: int, name: str) -> np.ndarray:
    """Return a matrix (size, size) that is symmetric and positive semidefinite to rounding, or raise a clear error."""
    matrix = as_real_array(value, name)
    require_matrix(matrix, (size, size), name)
    if np.diagonal(matrix).min() < 0:
        raise ValueError(f"{name} must be positive semidefinite, without negative variances on its diagonal")
    difference = np.abs(matrix - matrix.T)
    if difference.max() > ASYMMETRY_LIMIT * np.abs(matrix).max():
        i, j = np.unravel_index(np.argmax(difference), matrix.shape)
        raise ValueError(
            f"{name} must be symmetric, but [{i}, {j}] holds {matrix[i, j]:g} and [{j}, {i}] {matrix[j, i]:g}"
        )
    require_semidefinite(matrix, name)
    return matrix


def require_semidefinite(value: ArrayLike, name: str) -> None:
    """Raise ValueError if the covariance `value` has an eigenvalue below -`INDEFINITE_LIMIT` times its largest element.

    NaN, Inf and wrong shapes pass: the step that uses them refuses them.
    """
    if np.ma.is_masked(value):
        raise ValueError(f"{name} must not be masked: a variance that is not known has no number")
    P = np.atleast_2d(as_real_array(value, name))
    if P.ndim != 2 or P.shape[0] != P.shape[1] or (P.tobytes() == P.T.tobytes() and _is_definite(P)):
        return
    largest = np.abs(P).max()
    if not 0.0 < largest < np.inf:  # NaN is not
        return
    scaled = 0.5 * (P / largest + P.T / largest)  # overflows nowhere
    if not _is_definite(scaled + INDEFINITE_LIMIT * np.eye(len(P))):
        smallest = largest * np.linalg.eigvalsh(scaled)[0]
        raise ValueError(
            f"{name} must be positive semidefinite: it is a covariance, but its smallest eigenvalue is {smallest:g}. "
            "Nothing was changed"
        )


def _is_definite(P: np.ndarray) -> bool:
    """Return whether a symmetric array has a Cholesky factor."""
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True
