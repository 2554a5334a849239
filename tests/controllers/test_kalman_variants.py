"""Other forms of the Kalman filter: FxRLS, one with a diagonal covariance, and the fast array with its limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracles.rls import FiniteMemoryRLS
from oracles.signals import run
from scipy.linalg import toeplitz
from scipy.signal import butter, sosfilt

from kfopc_filterpy import DiagonalKalman, FastArrayKalman, fx_rls, kf_anc, simulate
from kfopc_filterpy.signals import band_limited_noise

L = 6
PATH = np.array([0.0, 0.8, -0.3])
ONE = PATH[np.newaxis, np.newaxis]


def signals(n: int = 400, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    x, other = np.random.default_rng(seed).standard_normal((2, n))
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:n] + 0.1 * other


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_fxrls_is_the_weighted_least_squares(forgetting: float) -> None:
    """Normal equations over all samples, with the start's lambda^n / variance on the diagonal: a dense solve."""
    x, d = signals(300)
    controller = fx_rls(L, PATH, forgetting=forgetting, initial_variance=2.0)
    simulate(controller, x, disturbance=d, secondary_path=PATH)
    H = toeplitz(np.convolve(x, PATH)[: x.size], np.zeros(L))
    weight = forgetting ** np.arange(x.size - 1, -1, -1.0)
    normal = H.T @ (weight[:, None] * H) + forgetting**x.size / 2.0 * np.eye(L)
    np.testing.assert_allclose(controller.weights, np.linalg.solve(normal, H.T @ (weight * d)), rtol=0, atol=1e-10)


def test_what_a_diagonal_covariance_loses_against_the_full_filter() -> None:
    """Error beyond the noise, once both have had 32 samples for each of 32 taps: dB on white noise, tens on coloured."""
    losses = []
    for colour in ((1.0,), tuple(0.9 ** np.arange(100))):
        excess = np.zeros(2)
        for seed in range(5):
            x, other = np.random.default_rng(seed).standard_normal((2, 2048))
            x = np.convolve(x, colour)[: x.size]
            clean = np.convolve(x, np.r_[0.0, np.random.default_rng(100 + seed).standard_normal(32)])[: x.size]
            d = clean + 0.1 * other
            for k, maker in enumerate((DiagonalKalman, kf_anc)):
                made: Any = maker(32, [0.0, 1.0], state_noise=1e-9, measurement_noise=0.01)
                result = simulate(made, x, disturbance=d, secondary_path=[0.0, 1.0])
                excess[k] += np.mean((clean - result.anti_noise)[1024:] ** 2)
        losses.append(10 * np.log10(excess[0] / excess[1]))
    assert 0.0 < losses[0] < 3.0
    assert losses[1] > 10.0


def test_diagonal_variances_stay_positive_and_a_silent_reference_tells_nothing() -> None:
    controller = DiagonalKalman(L, PATH, state_noise=0.0, measurement_noise=0.0)
    result = simulate(controller, np.zeros(50), disturbance=np.ones(50), secondary_path=PATH)
    np.testing.assert_array_equal(result.error, np.ones(50))
    np.testing.assert_array_equal(controller.variances, np.ones(L))
    x, d = signals()
    simulate(controller, x, disturbance=d, secondary_path=PATH)
    assert np.all(controller.variances >= 0.0)
    controller.variances[:] = -1.0  # a copy
    assert np.all(controller.variances >= 0.0)
    assert np.all(np.isfinite(controller.weights))


def test_a_diagonal_step_that_would_be_too_large_is_left_out() -> None:
    """Without measurement noise, K = 1/x' for one tap: a reference next to nothing asks for too much."""
    controller = DiagonalKalman(1, [1.0], state_noise=0.0, measurement_noise=0.0)
    for x in (1e-60, 1e-160):  # of the second, even S underflows
        controller.control_signal(x)
        controller.update(1.0)
        assert (controller.weights[0], controller.variances[0]) == (0.0, 1.0)
    controller.control_signal(1e-40)
    controller.update(1.0)
    assert controller.weights[0] == pytest.approx(1e40)


# ---- The fast array


def band_signals(n: int) -> tuple[np.ndarray, np.ndarray]:
    x = band_limited_noise((100.0, 1000.0), n / 16000, fs=16000, rng=2)
    x /= np.std(x)
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[: x.size] + 0.01 * np.random.default_rng(3).standard_normal(x.size)


@pytest.mark.parametrize("noise", ["white", "band"])
def test_without_forgetting_it_stays_the_full_filter(noise: str) -> None:
    """Over 200 000 samples, on a reference too that leaves most directions unexcited."""
    x, d = signals(200_000) if noise == "white" else band_signals(200_000)
    q = 1e-4
    fast = FastArrayKalman(24, PATH, measurement_noise=q)
    full = kf_anc(24, PATH, state_noise=0.0, measurement_noise=q)
    for made in (fast, full):
        simulate(made, x, disturbance=d, secondary_path=PATH)
    assert np.max(np.abs(fast.weights - full.weights)) < 1e-8 * np.max(np.abs(full.weights))


@pytest.mark.parametrize("compiled", [True, False])
def test_an_array_that_rounding_has_spoilt_is_refused_and_nothing_changed(compiled: bool) -> None:
    """lambda = 0.95: an error of 1e-16 grows to 1 in 36 / 0.05 = 720 samples."""
    x, d = signals(8000)
    controller = FastArrayKalman(L, PATH, measurement_noise=1e-6, forgetting=0.95)
    with pytest.raises(ValueError, match="the fast array is lost to rounding") as caught:
        simulate(controller, x, disturbance=d, secondary_path=PATH, compiled=compiled)
    note = caught.value.__notes__[0]
    assert note.startswith("in sample ")
    lost_at = int(note.split()[2])
    again = FastArrayKalman(L, PATH, measurement_noise=1e-6, forgetting=0.95)
    simulate(again, x[:lost_at], disturbance=d[:lost_at], secondary_path=PATH, compiled=compiled)
    # the refused sample changed neither weights nor powers
    np.testing.assert_array_equal(controller.weights, again.weights)
    assert controller.disturbance_power == again.disturbance_power
    with pytest.raises(ValueError, match="lost to rounding"):
        controller.update(1.0)
    np.testing.assert_array_equal(controller.weights, again.weights)
    assert np.all(np.isfinite(controller.weights))


def test_an_array_that_is_lost_while_listening_is_refused() -> None:
    x, d = signals(8000)
    controller = FastArrayKalman(L, PATH, measurement_noise=1e-6, forgetting=0.95)
    with pytest.raises(ValueError, match="the fast array is lost to rounding") as caught:
        controller.listen(x, d)
    assert caught.value.__notes__[0].endswith("of those listened to")
    assert controller.forgetting == 0.95


# ---- Finite memory


def test_a_finite_memory_runs_for_ever() -> None:
    """5000 memories: the weights still are those of the two growing memories that began last."""
    x, d = signals(200_000)
    memory = 40
    controller = FastArrayKalman(L, PATH, measurement_noise=0.02, memory=memory)
    simulate(controller, x, disturbance=d, secondary_path=PATH)
    last = slice(-60 * memory, None)  # from an own start, which by then no longer counts
    oracle = FiniteMemoryRLS(s_hat=ONE, n_taps=L, N=memory, P0=1.0 / 0.02)
    expected = run(oracle, x[np.newaxis, last], d[np.newaxis, last], ONE).w.ravel()
    np.testing.assert_allclose(controller.weights, expected, rtol=0, atol=1e-6)
    assert (controller.name, controller.memory, controller.arrays_lost) == ("finite-memory fast-array KF", memory, 0)
    assert 0.0 < controller.stray < 1e-10


def narrow_band(n: int) -> tuple[np.ndarray, np.ndarray]:
    sos = butter(4, (290.0, 310.0), "bandpass", fs=16000.0, output="sos")
    x = sosfilt(sos, np.random.default_rng(0).standard_normal(n))
    x /= np.std(x)
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[: x.size] + 0.01 * np.random.default_rng(3).standard_normal(x.size)


def test_a_narrow_band_spoils_a_growing_memory_and_it_says_so() -> None:
    """Without a look at its stray, the array would go on with gains that are wrong."""
    x, d = narrow_band(40_000)
    controller = FastArrayKalman(32, PATH, measurement_noise=1e-4, initial_variance=1.0)
    with pytest.raises(ValueError, match="lost to rounding"):
        simulate(controller, x, disturbance=d, secondary_path=PATH)


@pytest.mark.parametrize(("memory", "spoilt"), [(100, False), (3200, True)])
def test_a_finite_memory_survives_a_narrow_band(memory: int, spoilt: bool) -> None:
    """The same noise: an array is restarted before it is spoilt, or when it is, then with less variance."""
    x, d = narrow_band(100_000)
    controller = FastArrayKalman(32, PATH, measurement_noise=1e-4, initial_variance=1.0, memory=memory)
    result = simulate(controller, x, disturbance=d, secondary_path=PATH)
    assert (controller.arrays_lost > 0) == spoilt
    assert np.isfinite(controller.weights).all()
    assert np.mean(result.error[-50_000:] ** 2) < 3.0 * 1e-4  # of 2.9 without control; the sensor noise is 1e-4


def test_silence_leaves_a_finite_memory_its_weights() -> None:
    """A restart begins at the weights in use: a silent reference tells nothing, so they stay."""
    x, d = signals(1000)
    controller = FastArrayKalman(L, PATH, measurement_noise=0.01, memory=100)
    simulate(controller, x, disturbance=d, secondary_path=PATH)
    simulate(controller, np.zeros(50), disturbance=np.zeros(50), secondary_path=PATH)
    before = controller.weights
    simulate(controller, np.zeros(5000), disturbance=0.1 * np.ones(5000), secondary_path=PATH)
    np.testing.assert_allclose(controller.weights, before, rtol=0, atol=1e-12)
