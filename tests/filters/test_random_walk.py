"""KFOPC.random_walk in long and ill-conditioned runs: against filterpy, 50 digits, and the core's Kalman filter.

That it does what filterpy does, step for step, is tested in `test_against_filterpy.py`.
"""

from __future__ import annotations

import copy

import mpmath
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import KFOPC
from kfopc_filterpy.signals import band_limited_noise


def rows_of(kind: str, n: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Observation rows (steps, n): unrelated ones, or a delay line fed with a signal, newest sample first."""
    if kind == "unrelated":
        return rng.normal(size=(steps, n))
    signal = rng.normal(size=steps + n)
    if kind == "low-passed line":
        signal = np.convolve(signal, np.hanning(12))[: steps + n]
    if kind == "tonal line":
        signal = np.sin(0.2 * np.arange(steps + n)) + 1e-4 * signal
    return np.array([signal[k + n - 1 :: -1][:n] for k in range(steps)])


def pair(n: int, r: float, q: float, P0: float) -> tuple[KalmanFilter, KFOPC]:
    """filterpy's filter and ours."""
    kf = KalmanFilter(n, 1)
    kf.P, kf.Q, kf.R = P0 * np.eye(n), r * np.eye(n), np.array([[q]])
    return kf, KFOPC.random_walk(n, state_noise=r, measurement_noise=q, initial_variance=P0)


@pytest.mark.parametrize(
    ("n", "kind", "P0", "alpha"), [(16, "low-passed line", 1.0, 1.0), (7, "line", 10.0, 1.001), (33, "line", 1e3, 1.0)]
)
def test_thousands_of_steps_as_filterpy(n: int, kind: str, P0: float, alpha: float) -> None:
    """To 1e-10 of the largest value: the rounding times the condition, for P0/R up to 1e3 and r > 0."""
    steps, rng = 4000, np.random.default_rng(n)
    rows = rows_of(kind, n, steps, rng)
    filters = pair(n, 1e-3, 1.0, P0)
    d = rows @ rng.normal(size=n) + rng.normal(size=steps)
    for kf in filters:
        kf.alpha = alpha
        for k in range(steps):
            kf.predict()
            kf.update(np.array([[d[k]]]), H=rows[k : k + 1])
    for name in ("x", "P", "P_prior", "K"):
        theirs, ours = (getattr(kf, name) for kf in filters)
        assert np.abs(theirs - ours).max() <= 1e-10 * np.abs(theirs).max(), name


# A large initial variance


def fifty_digits(rows: np.ndarray, d: np.ndarray, P0: float, r: float, q: float) -> list[tuple[float, float]]:
    """Predictions of the measurements and their variances, eq. 2-8 in 50-digit arithmetic."""
    n = rows.shape[1]
    with mpmath.workdps(50):
        w, P, found = mpmath.zeros(n, 1), P0 * mpmath.eye(n), []
        for row, z in zip(rows, d, strict=True):
            P += mpmath.mpf(r) * mpmath.eye(n)
            h = mpmath.matrix([mpmath.mpf(float(v)) for v in row])
            g = P * h
            S, predicted = (h.T * g)[0] + mpmath.mpf(q), (h.T * w)[0]
            found.append((float(predicted), float(S)))
            w += g * ((mpmath.mpf(float(z)) - predicted) / S)
            P -= g * g.T / S
    return found


@pytest.mark.parametrize("kind", ["unrelated", "line", "low-passed line", "tonal line"])
@pytest.mark.parametrize(("P0", "r"), [(1e6, 0.0), (1e9, 0.0), (1e12, 1e-2)])
def test_predictions_err_by_a_rounding_of_P0_at_most(kind: str, P0: float, r: float) -> None:
    """In deviations of the innovation, with q = 1. A float keeps 1e-16 of P0, of which the last digits are all that is left."""
    n, steps, worst = 6, 100, 0.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rows = rows_of(kind, n, steps, rng)
        d = rows @ rng.normal(size=n) + rng.normal(size=steps)
        _, ours = pair(n, r, 1.0, P0)
        for row, z, (predicted, S) in zip(rows, d, fifty_digits(rows, d, P0, r, 1.0), strict=True):
            ours.predict()
            ours.update(z, H=row)
            worst = max(worst, abs(z - ours.y.item() - predicted) / S**0.5)
    assert worst <= 5e-15 * P0  # it was at most 1.5e-15 P0 at 1e6, 3e-16 P0 at 1e12
    assert np.linalg.eigvalsh(ours.P).min() > 0


@pytest.mark.parametrize(("band", "assigned"), [((250.0, 350.0), True), ((200.0, 2000.0), False)])
def test_p_stays_semidefinite_at_a_large_initial_variance(band: tuple[float, float], assigned: bool) -> None:
    """P(0|0)/q = 1e12, no state noise: the variances along the noise are below the last digit of the others.

    Without the least state noise, S is negative after 2000 to 3000 samples. The innovations must stay near the measurement
    noise, of variance q: within 3 dB.
    """
    q, taps, n = 1e-4, 32, 12000
    x = band_limited_noise(band, n / 16000.0, fs=16000.0, rng=0)
    d = 2.0 * np.roll(x, 5) + np.sqrt(q) * np.random.default_rng(1).standard_normal(n)
    kf = KFOPC.random_walk(taps, state_noise=0.0, measurement_noise=q, initial_variance=0.0 if assigned else 1e12 * q)
    if assigned:
        kf.P = 1e12 * q
    innovations = []
    for k in range(taps, n):
        kf.predict()
        kf.update(d[k], H=x[k - taps + 1 : k + 1][::-1])
        innovations.append(kf.y[0, 0])
        if k % 400 == 0:
            values = np.linalg.eigvalsh(kf.P)
            assert values[0] >= -1e-12 * values[-1], k
    assert np.mean(np.square(innovations[-2000:])) < 2.0 * q


def test_the_state_noise_is_what_was_given_however_small() -> None:
    kf = KFOPC.random_walk(4, state_noise=1e-9, measurement_noise=1.0)
    for _ in range(100):
        kf.predict()
        kf.update(0.0, H=[0.0, 0.0, 0.0, 1e-6])
    assert kf.P[0, 0] - 1.0 == pytest.approx(1e-7, rel=1e-7)


def test_what_is_nothing_but_rounding_moves_nothing() -> None:
    kf, rng = KFOPC.random_walk(3, state_noise=0.0, measurement_noise=0.0), np.random.default_rng(0)
    rows = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for k in range(8):  # until the least state noise is more than rounding
        kf.predict()
        kf.update(rng.normal(), H=rows[k % 2])  # the first two are known exactly; the others contradict them
        assert abs(rows[2] @ kf.x) < 1e-12


def test_a_variance_of_long_ago_refuses_no_noise() -> None:
    kf = KFOPC.random_walk(1, state_noise=0.0, measurement_noise=1.0, initial_variance=1.5e308)
    kf.update(1.0, H=[1e-100])
    kf.predict(Q=1e308)
    assert kf.P.item() == pytest.approx(1e308)


def test_without_any_noise_what_is_known_exactly_tells_nothing() -> None:
    kf = KFOPC.random_walk(3, state_noise=0.0, measurement_noise=0.0)
    rows = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for k in range(60):
        kf.predict()
        kf.update(rows[k % 2] @ [1.0, 2.0, 3.0], H=rows[k % 2])
    np.testing.assert_allclose(rows[:2] @ kf.x.ravel(), rows[:2] @ [1.0, 2.0, 3.0], rtol=1e-12)
    assert rows[2] @ kf.P @ rows[2] == pytest.approx(1.0, rel=1e-12)
    kf = KFOPC.random_walk(3, state_noise=0.0, measurement_noise=0.0, initial_variance=0.0)
    for H, got in ((1.0, "0: P is not positive definite on H"), (1e200, "inf: it overflows")):
        with pytest.raises(ValueError, match=f"S = H P H' \\+ R must be positive, got {got}"):
            kf.update(1.0, H=np.full(3, H))
        kf.P = 1.0


# F, Q, R and H as a user meets them; P is in the machine


def test_rows_written_into_H_count_and_silent_ones_correct_nothing() -> None:
    """At the start too: zeros written into H are those of filterpy's default."""
    signal = np.r_[np.zeros(5), np.random.default_rng(0).normal(size=8), np.zeros(5), 1.0]
    filters = pair(3, 0.1, 0.5, 1.0)
    for k in range(3, signal.size + 1):
        for kf in filters:
            before = kf.x.copy()
            kf.predict()
            kf.H[0] = signal[k - 3 : k][::-1]
            kf.update(1.0)
            assert np.array_equal(kf.x, before) == (not kf.H.any()), k
    np.testing.assert_allclose(filters[1].x, filters[0].x, rtol=1e-10)


@pytest.mark.parametrize("name", ["F", "Q", "R"])
def test_a_write_into_F_Q_R_is_refused_and_numbers_are_taken(name: str) -> None:
    _, kf = pair(3, 0.1, 0.5, 1.0)
    matrix = getattr(kf, name)
    for write in (lambda a: a.__setitem__((0, 0), 2.0), lambda a: np.add(a, 1.0, out=a), lambda a: a.T[0].sort()):
        with pytest.raises(ValueError, match="read-only"):
            write(getattr(kf, name))
    assert (2.0 * matrix).flags.writeable
    if name != "F":
        for value in (0.3, np.float64(0.3), np.array(0.3), [[0.3]] if name == "R" else 0.3 * np.eye(3)):
            setattr(kf, name, 1.0)
            setattr(kf, name, value)
            np.testing.assert_array_equal(getattr(kf, name), 0.3 * np.eye(len(matrix)))
    own = 0.3 * np.eye(len(matrix))
    setattr(kf, name, own)
    own[0, 0] = 7.0  # the filter has a copy
    assert getattr(kf, name)[0, 0] == 0.3
    kf.F = np.eye(3)
    kf.Q = np.diag([1.0, 2.0, 3.0])
    kf.Q[0, 0] = 2.0
    kf.P = 1.0
    kf.predict()
    np.testing.assert_array_equal(kf.P, np.diag([3.0, 3.0, 4.0]))
    kf.Q = 0.1
    twin = copy.deepcopy(kf)
    twin.Q[0, 0] = 2.0  # a copy's can be written into, and that counts
    twin.predict()
    assert twin.P[0, 0] == kf.P[0, 0] + 2.0
