"""Other forms of the Kalman filter: FxRLS, and one with a diagonal covariance."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from scipy.linalg import toeplitz

from kfopc_filterpy import Plant, diagonal_kf, fx_rls, kf_anc, simulate
from kfopc_filterpy.core.block import Algorithm, Block, Shape
from kfopc_filterpy.core.triangle import GROUP
from kfopc_filterpy.paths import PathTolerance

L = 6
FS, PATH = 16000, np.array([0.0, 0.8, -0.3])


def signals(n: int = 400, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    x, other = np.random.default_rng(seed).standard_normal((2, n))
    return x, np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:n] + 0.1 * other


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_fxrls_is_the_weighted_least_squares(forgetting: float) -> None:
    """Normal equations over all samples, with the start's lambda^n / variance on the diagonal: a dense solve."""
    x, d = signals(300)
    controller = fx_rls(L, PATH, forgetting=forgetting, initial_variance=2.0)
    simulate(controller, x, Plant(PATH, fs=FS), disturbance=d)
    H = toeplitz(np.convolve(x, PATH)[: x.size], np.zeros(L))
    weight = forgetting ** np.arange(x.size - 1, -1, -1.0)
    normal = H.T @ (weight[:, None] * H) + forgetting**x.size / 2.0 * np.eye(L)
    np.testing.assert_allclose(controller.weights, np.linalg.solve(normal, H.T @ (weight * d)), rtol=0, atol=1e-10)


@pytest.mark.parametrize("bad", [2, 9])
def test_a_few_bad_samples_stop_no_forgetting(bad: int) -> None:
    """One reference is 1e4 times as loud for some samples: 1e8 times the variance is left along the others.

    The filter with fading memory remains the weighted least squares of the test above.
    """
    forgetting, rng = 0.99, np.random.default_rng(0)
    H, noise = rng.standard_normal((300, 3)), 0.1 * rng.standard_normal(300)
    H[200 : 200 + bad] = [1e4, 0.0, 0.0]
    d = H @ [1.0, -0.5, 0.3] + noise
    settings = {"state_noise": 0.0, "measurement_noise": 1.0, "initial_variance": 1.0, "fading": 1.0 / forgetting}
    block = Block(Algorithm("kalman"), Shape(1, 1, 3, 1, 1), path=np.ones(1), settings=settings)
    for row, sample in zip(H, d, strict=True):
        block.reference[:] = row
        assert block.emit() == 0
        block.error[:] = sample - block.control_signal
        assert block.update() == 0
    weight = forgetting ** np.arange(299, -1, -1.0)
    normal = H.T @ (weight[:, None] * H) + forgetting**300 * np.eye(3)
    expected = np.linalg.solve(normal, H.T @ (weight * d))
    np.testing.assert_allclose(block.fields["weights"].ravel(), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("n", "past"),
    [(3000, lambda x: 1e4 * x), (700, lambda x: 0.01 * np.sin(0.3 * np.arange(x.size)))],
    ids=["loud", "tone"],
)
def test_what_was_loud_or_a_tone_once_is_forgotten(n: int, past: Any) -> None:
    """P's largest variance is over 1e4 times the usual one; later, FxRLS is the weighted least squares again.

    It takes 2800 samples after what was loud, 400 after the tone; the memory is of 10.
    """
    forgetting, rng = 0.9, np.random.default_rng(0)
    x, noise = rng.standard_normal((2, n))
    x[:200] = past(x[:200])
    d = np.convolve(x, [1.0, -0.5, 0.3])[:n] + 0.1 * noise
    d[n // 3 :] *= -1.0
    controller = fx_rls(L, [1.0], forgetting=forgetting, initial_variance=1e8)
    simulate(controller, x, Plant([1.0], fs=FS), disturbance=d)
    H, weight = toeplitz(x, np.zeros(L)), forgetting ** np.arange(n - 1, -1, -1.0)
    expected = np.linalg.solve(H.T @ (weight[:, None] * H), H.T @ (weight * d))
    np.testing.assert_allclose(controller.weights, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("gain", [2.0**-12, 2.0**12])
def test_to_fxrls_no_level_is_soft_or_loud(gain: float) -> None:
    """A reference g x from a variance of 1/g^2 gives weights w/g, to the bit: silence, a tone, noise, then the end of it."""
    n = np.arange(2000)
    x = np.r_[np.zeros(40), np.sin(0.3 * n), signals()[0], np.zeros(40), np.full(400, 1e-5)]
    d = signals(x.size)[1]
    one, other = (fx_rls(L, [1.0], forgetting=0.9, initial_variance=0.5 / g**2) for g in (1.0, gain))
    one.process(x, d), other.process(gain * x, d)
    np.testing.assert_array_equal(one.weights, gain * other.weights)
    np.testing.assert_array_equal(one.covariance, gain**2 * other.covariance)


@pytest.mark.parametrize("variance", [0.25, 4.0])
def test_before_the_first_sound_fxrls_variance_grows_a_million_times(variance: float) -> None:
    """To 2^20; what is softer than 1e-10 / variance counts as silence, and of what is louder P is (1 - lambda)/x^2."""
    for energy, expected in ((0.5e-10, 2.0**20), (2e-10, 0.5 / 2e-10)):
        controller = fx_rls(1, [1.0], forgetting=0.5, initial_variance=variance)
        controller.process(np.zeros(40), np.zeros(40))
        assert controller.covariance == variance * 2.0**20
        controller.process(np.full(60, np.sqrt(energy / variance)), np.zeros(60))
        assert controller.covariance == pytest.approx(variance * expected, rel=0.01)  # a little is learned of it


def test_along_a_tone_fxrls_forgets_and_elsewhere_its_variance_stays() -> None:
    """P grows until its largest variance is 1e4 times the usual one along the rows.

    From then on noise takes the place of fading. Along the rows, it leaves more than half of the variance that forgetting
    does, 0.7 of it here, and nowhere does P grow.
    """
    forgetting, x = 0.99, np.sin(0.3 * np.arange(8000))
    controller, H, largest = fx_rls(L, [1.0], forgetting=forgetting), toeplitz(x, np.zeros(L)), []
    for n in range(x.size):
        controller.control_signal(x[n])
        controller.update(0.0)
        if n % 2000 < 1999:
            continue
        rows, weight = H[n - 20 : n + 1], forgetting ** np.arange(n, -1, -1.0)  # a period
        forgotten = np.linalg.pinv(H[: n + 1].T @ (weight[:, None] * H[: n + 1]), rcond=1e-9)
        along, by_forgetting = (np.mean(np.sum(rows @ P * rows, 1)) for P in (controller.covariance, forgotten))
        assert 0.5 * by_forgetting < along < by_forgetting
        largest.append(np.diag(controller.covariance).max())
        assert 0.5e4 * along < largest[-1] * np.mean(np.sum(rows**2, 1)) < 1e4 * along
    np.testing.assert_allclose(largest, largest[0], rtol=0.01)


def test_diagonal_variances_stay_positive_and_a_silent_reference_tells_nothing() -> None:
    controller = diagonal_kf(L, PATH, state_noise=0.0, measurement_noise=0.0)
    result = simulate(controller, np.zeros(50), Plant(PATH, fs=FS), disturbance=np.ones(50))
    np.testing.assert_array_equal(result.error, np.ones(50))
    np.testing.assert_array_equal(controller.variances, np.ones(L))
    x, d = signals()
    simulate(controller, x, Plant(PATH, fs=FS), disturbance=d)
    assert np.all(controller.variances >= 0.0)
    controller.variances[:] = -1.0  # a copy
    assert np.all(controller.variances >= 0.0)
    assert np.all(np.isfinite(controller.weights))


@pytest.mark.parametrize("make", [diagonal_kf, kf_anc])
def test_a_step_that_would_be_too_large_is_left_out(make: Any) -> None:
    """Without measurement noise, K = 1/x' for a first sample: a reference next to nothing asks for too much."""
    controller = make(2, [1.0], state_noise=0.0, measurement_noise=0.0)

    def after(x: float, e: float) -> tuple[float, np.ndarray]:
        """Return the first weight and all variances."""
        controller.control_signal(x)
        controller.update(e)
        return controller.weights[0], controller.variances if make is diagonal_kf else np.diag(controller.covariance)

    close: Any = {"abs": 1e-14}  # the Kalman filter's least state noise
    for x in (1e-160, 1e-60):  # of the first, even S underflows
        assert after(x, 1.0) == (0.0, pytest.approx([1.0, 1.0], **close))
    assert after(1e-40, 1.0)[0] == pytest.approx(1e40)
    assert after(1.0, 1e60)[0] == pytest.approx(1e40)  # d^ - w'x', times K = 1e40
    for _ in range(4):  # both weights are known, and silence changes nothing
        assert after(0.0, 1.0)[1] == pytest.approx([0.0, 0.0], **close)


@pytest.mark.parametrize(
    ("x", "options", "refused"),
    [
        (1e-9, {"initial_variance": 1e301}, True),
        (1e-9, {"initial_variance": 0.0, "state_noise": 1e301}, True),
        (1e6, {"initial_variance": 1e290}, True),  # at one microphone
        (4e4, {"initial_variance": 1e290}, False),
        (4e4, {"initial_variance": 1e290, "guarded": True}, True),  # whose filter has a gain of 5.7
    ],
)
def test_a_covariance_that_could_overflow_is_refused(x: float, options: dict[str, Any], refused: bool) -> None:
    """P above 1e300, or n P x'x'."""
    guarded = options.pop("guarded", False)
    settings: dict[str, Any] = {"state_noise": 0.0, "measurement_noise": 1.0} | options
    for path in np.array([[[[1e-3]], [[1.0]]], [[[1.0]], [[1e-3]]]]):
        controller = kf_anc(1, path, n_references=2, **settings)
        controller.secondary_path_uncertainty = PathTolerance(gain_db=20.0) if guarded else None
        controller.control_signal([x, x])
        with pytest.raises(ValueError, match="P is too large") if refused else nullcontext():
            controller.update(path.ravel())
        np.testing.assert_allclose(controller.weights.ravel(), 0.0 if refused else 0.5 / x)


def test_a_variance_of_long_ago_refuses_no_loud_reference() -> None:
    """Which x'P x' could overflow with: w = sum x d / (sum x^2 + q / P0), of two samples of 1 and one of 1e6."""
    q, P0, x = 1e280, 1e290, np.array([1.0, 1.0, 1e6])
    controller = kf_anc(1, [1.0], state_noise=0.0, measurement_noise=q, initial_variance=P0)
    for sample in x:
        y = controller.control_signal(sample)
        controller.update(2.0 * sample - y)
    np.testing.assert_allclose(controller.weights, 2.0 * (x @ x) / (x @ x + q / P0), rtol=1e-6)  # P0's rounding over q


# P at the limits of a float: rows of any direction, as each reference has one tap and the path is 1


def heard(controller: Any, row: Any, e: float) -> None:
    controller.control_signal(row)
    controller.update(e)


def test_a_variance_counts_as_long_as_any_weight_has_it() -> None:
    """3 P x'x' is above 1e300 until the last of three variances has fallen from 1e290 to the measurement noise."""
    loud = np.full(3, 4e5)
    for left in range(3):
        controller = kf_anc(1, [1.0], n_references=3, state_noise=0.0, measurement_noise=1e280, initial_variance=1e290)
        order = [*(k for k in range(3) if k != left), left]
        for k in order:
            with pytest.raises(ValueError, match="P is too large"):
                heard(controller, loud, 1.0)
            heard(controller, np.eye(3)[k], 1.0)
            heard(controller, np.zeros(3), 1.0)
        heard(controller, loud, 1.0)


@pytest.mark.parametrize(("least", "away"), [(-0.3, 0.4), (-0.01, 0.03), (-1e-6, 1e-4)])
def test_an_indefinite_p_is_raised_by_twice_its_least_eigenvalue(least: float, away: float) -> None:
    """Rounding may make P indefinite: then the sample is measured as with P - 2 least I, whose least eigenvalue is -least.

    One direction v has another eigenvalue than the others, 0.9, so it lies in the plane of a row h and P h. A dense update
    is exact to rounding: 1e-12 of P is a thousand times as much as it came to.
    """
    n, q = 20, 0.1  # two groups of rows and a part of one, as the core keeps P
    v, beside = np.linalg.qr(np.random.default_rng(0).normal(size=(n, 2)))[0].T
    P = 0.9 * np.eye(n) + (least - 0.9) * np.outer(v, v)
    h = v + away * beside
    assert h @ P @ h < 0.0
    controller = kf_anc(1, [1.0], n_references=n, state_noise=0.0, measurement_noise=q)
    square = np.pad(P, (0, -n % GROUP))
    rows = [square[i : i + GROUP, : i + GROUP] for i in range(0, len(square), GROUP)]
    controller._block.fields["triangle"].ravel()[:] = np.concatenate([row.ravel() for row in rows])
    heard(controller, h, 1.0)
    raised = P + 2.0 * np.abs(np.linalg.eigvalsh(P)[0]) * np.eye(n)
    g, S = raised @ h, h @ raised @ h + q
    np.testing.assert_allclose(controller.covariance, raised - np.outer(g, g) / S, rtol=0, atol=1e-12)
    np.testing.assert_allclose(controller.weights.ravel(), g / S, rtol=0, atol=1e-12)
    assert np.linalg.eigvalsh(controller.covariance)[0] > 0.0


def test_what_is_known_exactly_brings_a_rounding_of_state_noise() -> None:
    """An h'P h below 16 roundings of the largest variance becomes 16; from then on, each sample adds 2.

    To the bit: 1 plus a whole number of roundings is a float.
    """
    controller = kf_anc(1, [1.0], n_references=3, state_noise=0.0, measurement_noise=0.0)
    known = np.eye(3)[1]
    for row, roundings in ((known, 0), (known, 16), (np.zeros(3), 18), (np.zeros(3), 20)):
        heard(controller, row, 1.0)
        variances = np.diag(controller.covariance)
        np.testing.assert_array_equal(variances[[0, 2]], 1.0 + roundings * np.finfo(float).eps)
    assert variances[1] == 4.0 * np.finfo(float).eps
