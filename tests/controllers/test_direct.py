"""All weights as one state, for several channels: against filterpy's own filter of K measurements."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.channels import delayed, random_paths, through

from kfopc_filterpy import OutputLimiter, OutputPowerConstraint, kf_anc, kf_opc, simulate, simulate_scenarios

K, J, I, L = 3, 2, 2, 5  # microphones, loudspeakers, references, taps  # noqa: E741
FS = 16000.0
PATHS = random_paths(K, J, 6, seed=1)  # true secondary paths
ESTIMATE = 0.9 * PATHS[:, :, :4]  # what the controllers know of them
PRIMARY = random_paths(K, I, 9, seed=2, delay=3)
NOISE = np.array([0.01, 0.1, 0.03])
RATED, MEMORY = np.array([0.02, 0.05]), 60
SETTINGS: dict[str, Any] = {"state_noise": 1e-5, "measurement_noise": NOISE, "n_references": I}
ONE_PATH = np.array([0.0, 0.7, -0.25, 0.1])


def noise(n_samples: int = 400, n_references: int = I) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((n_references, n_samples))


def constraints() -> list[OutputPowerConstraint]:
    """The rated powers, the powers with a memory of `MEMORY` samples."""
    return [OutputPowerConstraint(power, fs=FS, memory_s=MEMORY / FS) for power in RATED]


MAKE: dict[str, Callable[..., Any]] = {
    "KF-ANC": lambda path=ESTIMATE, **o: kf_anc(L, path, **(SETTINGS | o)),
    "KF-OPC": lambda path=ESTIMATE, **o: kf_opc(L, path, constraint=constraints(), **(SETTINGS | o)),
}


def run(controller: Any, x: np.ndarray, **options: Any) -> Any:
    return simulate(controller, x, **({"primary_path": PRIMARY, "secondary_path": PATHS, "fs": FS} | options))


# ---- The estimate


def mean_square(squares: np.ndarray) -> float:
    """A plain mean until the window is full, then forgetting."""
    mean = 0.0
    for k, square in enumerate(squares):
        mean += max(-np.expm1(-1.0 / MEMORY), 1.0 / (k + 1)) * (square - mean)
    return mean


def transcribed(
    x: np.ndarray, d: np.ndarray, rated: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The modified structure around filterpy's filter of K measurements, with eq. 10-13 and the least factor."""
    n_samples, size = x.shape[1], ESTIMATE.shape[2]
    kf = KalmanFilter(dim_x=J * I * L, dim_z=K)
    kf.Q, kf.R = SETTINGS["state_noise"] * np.eye(J * I * L), np.diag(NOISE)
    y, e, d_hat = np.zeros((J, n_samples)), np.zeros((K, n_samples)), np.zeros((K, n_samples))
    past = np.array([delayed(x[i : i + 1], L) for i in range(I)])  # (I, L, n)
    xf = np.array(
        [[[through(s.reshape(1, 1, -1), x[i : i + 1])[0] for i in range(I)] for s in row] for row in ESTIMATE]
    )
    factors, gains = np.ones((J, n_samples)), np.ones((J, n_samples))
    for n in range(n_samples):
        w = kf.x.reshape(J, I, L)
        y[:, n] = np.einsum("jil,il->j", w, past[:, :, n])
        for k in range(K):
            e[k, n] = d[k, n] - sum(
                PATHS[k, j, m] * y[j, n - m] for j in range(J) for m in range(PATHS.shape[2]) if m <= n
            )
            d_hat[k, n] = e[k, n] + sum(
                ESTIMATE[k, j, m] * y[j, n - m] for j in range(J) for m in range(size) if m <= n
            )
        if rated is not None:
            delta2 = mean_square(np.sum(d_hat[:, : n + 1] ** 2, axis=0))
            for j in range(J):
                of_xf = mean_square(np.sum(xf[:, j, :, : n + 1] ** 2, axis=(0, 1)))
                gains[j, n] = of_xf / mean_square(np.sum(x[:, : n + 1] ** 2, axis=0))
                factors[j, n] = min(np.sqrt(rated[j] * gains[j, n] / delta2), 1.0)
        H = np.array(
            [
                [xf[k, j, i, n - m] if n >= m else 0.0 for j in range(J) for i in range(I) for m in range(L)]
                for k in range(K)
            ]
        )
        kf.predict()
        kf.update(factors[gains[:, n] > 0.0, n].min(initial=1.0) * d_hat[:, n].reshape(-1, 1), H=H)
    return e, y, kf.x.reshape(J, I, L), factors


@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC"])
def test_a_run_is_filterpys_filter_of_all_weights(name: str) -> None:
    """To 1e-10 of the largest value: the same equations, with scalar updates in place of an inverse of K x K."""
    x = noise()
    controller = MAKE[name]()
    result = run(controller, x)
    e, y, w, factors = transcribed(x, result.disturbance, RATED if name == "KF-OPC" else None)
    for got, want in (
        (result.error, e),
        (result.control_signal, y),
        (controller.weights, w),
        (result.constraint_factor, factors),
    ):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())
    assert result.algorithm == name
    if name == "KF-OPC":  # the factor acts, and at times one loudspeaker decides, at times the other
        assert factors[:, 100:].min() < 0.5
        assert np.ptp(factors.argmin(axis=0)) == 1
    else:
        assert np.mean(e[:, -100:] ** 2) < 0.5 * np.mean(result.disturbance[:, -100:] ** 2)


# ---- One definition of the step


@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC"])
def test_channels_of_one_are_the_single_channel_bit_for_bit(name: str) -> None:
    x, other = noise(300)
    d = np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:300] + 0.1 * other
    settings: dict[str, Any] = {"state_noise": 1e-5, "measurement_noise": 0.01}

    def made(path: np.ndarray) -> Any:
        return kf_anc(L, path, **settings) if name == "KF-ANC" else kf_opc(L, path, rated_power=0.1, **settings)

    single, many = made(ONE_PATH), made(ONE_PATH.reshape(1, 1, -1))
    options: dict[str, Any] = {"secondary_path": ONE_PATH, "fs": FS, "record_weights_every": 5}
    want, got = simulate(single, x, disturbance=d, **options), simulate(many, x, disturbance=d, **options)
    for signal in ("error", "control_signal", "anti_noise", "constraint_factor"):
        np.testing.assert_array_equal(getattr(got, signal), getattr(want, signal), err_msg=signal)
    np.testing.assert_array_equal(got.weights[:, 0, 0], want.weights)
    np.testing.assert_array_equal(many.covariance, single.covariance)
    for attribute in ("weights", "disturbance_power", "secondary_path_gain", "constraint_factor", "rated_power"):
        np.testing.assert_array_equal(np.ravel(getattr(many, attribute)), getattr(single, attribute), err_msg=attribute)
    assert got.algorithm == want.algorithm


# ---- Odd systems


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("dead", ["loudspeaker", "microphone"])
def test_what_is_unplugged_stays_silent_and_finite(name: str, dead: str) -> None:
    paths = PATHS.copy()
    paths[(slice(None), 1) if dead == "loudspeaker" else 1] = 0.0
    controller = MAKE[name](paths)
    result = run(controller, noise(2000), secondary_path=paths)
    assert np.isfinite(result.error).all()
    assert np.isfinite(controller.weights).all()
    if dead == "loudspeaker":
        np.testing.assert_allclose(result.control_signal[1], 0.0, atol=1e-9)
        np.testing.assert_array_equal(controller.weights[1], 0.0)
    assert np.any(result.control_signal[0])


# ---- Refusals


def test_a_microphone_that_is_not_reached_tells_nothing_without_measurement_noise() -> None:
    """Sound reaches microphone 2 later than the others: until then S is zero, and the weights are those without it."""
    paths = ESTIMATE.copy()
    paths[2] = np.roll(ESTIMATE[2], 2, axis=-1) * [0.0, 0.0, 0.0, 1.0]
    settings = {"initial_variance": 100.0, "state_noise": 1e-3}
    three = MAKE["KF-ANC"](paths, measurement_noise=[0.01, 0.01, 0.0], **settings)
    two = MAKE["KF-ANC"](paths[:2], measurement_noise=0.01, **settings)
    for n, x in enumerate(noise(40).T):
        np.testing.assert_array_equal(three.control_signal(x), two.control_signal(x)) if n < 4 else None
        three.update([1.0, 2.0, 3.0])
        two.update([1.0, 2.0])
        assert np.array_equal(three.weights, two.weights) == (n < 3), n
    assert np.any(three.weights)
    assert np.all(np.isfinite(three.weights))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: MAKE["KF-ANC"](measurement_noise=[0.1, 0.1]), ValueError, r"each of the 3 microphones, \(3,\), got shape \(2,\)"),
        (lambda: MAKE["KF-ANC"](measurement_noise=-0.1), ValueError, "measurement_noise must not be negative"),
        (lambda: MAKE["KF-ANC"](state_noise=-1.0), ValueError, "state_noise must not be negative"),
        (lambda: MAKE["KF-ANC"](initial_variance=np.nan), ValueError, "initial_variance must be finite"),
        (lambda: MAKE["KF-ANC"](n_references=0), ValueError, "n_references must be at least 1"),
        (lambda: MAKE["KF-OPC"](ESTIMATE[:, :1]), ValueError, "one for each of the 1 loudspeakers, got 2"),
        (lambda: kf_opc(L, ESTIMATE, **SETTINGS), ValueError, "give either rated_power= or constraint="),
        (lambda: kf_opc(L, ONE_PATH, rated_power=[1.0, 2.0], state_noise=0.0, measurement_noise=0.1), ValueError, "must be one for one loudspeaker, got 2"),
        (lambda: MAKE["KF-ANC"](np.ones((2, 4))), ValueError, r"\(K microphones, J loudspeakers, taps\), got \(2, 4\)"),
        (lambda: MAKE["KF-ANC"](limiter=OutputLimiter(1.0)), TypeError, "2 different OutputLimiters"),
        (lambda: run(MAKE["KF-ANC"](), noise(9, 1)), ValueError, "I = 1 of reference"),
        (lambda: simulate_scenarios([MAKE["KF-ANC"]()], noise(9)[0], primary_path=ONE_PATH, secondary_path=ONE_PATH), (TypeError, ValueError), "channel"),
    ],
    ids=range(12),
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(make: Callable[[], Any], error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def test_each_name_makes_the_form_for_its_channels() -> None:
    two = kf_anc(L, ONE_PATH, state_noise=0.0, measurement_noise=0.1, n_references=2)
    assert two.weights.shape == (1, 2, L)
    assert repr(two) == "<KF-ANC: 1 microphone, 1 loudspeaker, 2 references, 5 taps, constraint factor 1>"
