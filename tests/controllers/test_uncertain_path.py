"""Controllers whose secondary path is not as they know it: against the closed form of the settled error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import (
    KFOPC,
    FxLMS,
    FxNLMS,
    KalmanController,
    LeakyFxLMS,
    OutputPowerConstraint,
    kf_anc,
    kf_opc,
    kf_pb,
    noise_reduction_db,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.paths import PathTolerance, guard_filter, path_uncertainty
from kfopc_filterpy.signals import band_limited_noise, tone

FS = 8000.0
TRUE = np.array([0.0, 0.0, 0.0, 1.0, -0.6])
LATE = np.array([0.0, 0.0, 1.0, -0.6, 0.0])  # an estimate that is a sample too early: the true path is late
EARLY = np.array([0.0, 0.0, 0.0, 0.0, 1.0, -0.6])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])
TOLERANCE = PathTolerance(delay_samples=1.0)
DIRECT: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3}
ONE_CHANNEL: dict[str, Any] = {"form": "shared gain"}


def run(settings: dict[str, Any], estimate: np.ndarray, x: np.ndarray, **more: Any) -> Any:
    settings = {"rated_power": 1e3, "fs": FS} | settings | more
    controller = kf_pb(24, estimate, **settings)
    shaped = x if settings.get("form") is None else x[np.newaxis]
    return simulate(controller, shaped, primary_path=PRIMARY, secondary_path=TRUE, fs=FS)


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
@pytest.mark.parametrize("frequency", [600.0, 1000.0])
def test_a_tone_settles_at_the_closed_form(settings: dict[str, Any], frequency: float) -> None:
    """E/D = (1 - g)/(1 + g Delta), to 1 dB, with the g that the guard filter has at the tone and Delta of one sample."""
    x = tone(frequency, 6.0, fs=FS) + 1e-3 * np.random.default_rng(0).standard_normal(int(6 * FS))
    result = run(settings, LATE, x, secondary_path_uncertainty=TOLERANCE)
    omega = 2 * np.pi * frequency / FS
    guard = guard_filter(path_uncertainty(TOLERANCE, LATE))
    share = 1 / (1 + np.abs(np.sum(guard * np.exp(-1j * omega * np.arange(guard.size)))) ** 2)
    delta = np.exp(-1j * omega) - 1
    expected = -20 * np.log10(np.abs((1 - share) / (1 + share * delta)))
    assert noise_reduction_db(result.error, result.disturbance) == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
@pytest.mark.parametrize("estimate", [LATE, EARLY], ids=["late", "early"])
def test_white_noise_is_never_louder_although_the_path_is_a_sample_off(
    settings: dict[str, Any], estimate: np.ndarray
) -> None:
    """In no second after the first; without the guard it is louder."""
    x = np.random.default_rng(1).standard_normal(int(5 * FS))

    def seconds(uncertainty: Any) -> list[float]:
        result = run(settings, estimate, x, rated_power=0.3, secondary_path_uncertainty=uncertainty)
        parts = [slice(int(k * FS), int((k + 1) * FS)) for k in range(1, 5)]
        error, disturbance = np.atleast_2d(result.error), np.atleast_2d(result.disturbance)
        return [-10 * np.log10(np.sum(error[:, part] ** 2) / np.sum(disturbance[:, part] ** 2)) for part in parts]

    assert min(seconds(TOLERANCE)) > 0.1
    assert min(seconds(PathTolerance(delay_samples=0.5))) > 0.1  # the default: enough for a sample as well
    assert min(seconds(None)) < 0.0


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
def test_an_exact_path_costs_little(settings: dict[str, Any]) -> None:
    """With the default, on noise below a sixth of the sample rate: at most 0.5 dB."""
    x = band_limited_noise((200.0, 1200.0), 5.0, fs=FS, rng=2) + 1e-3 * np.random.default_rng(3).standard_normal(
        int(5 * FS)
    )
    with_guard = run(settings, TRUE, x, rated_power=0.3)
    without = run(settings, TRUE, x, rated_power=0.3, secondary_path_uncertainty=None)
    loss = noise_reduction_db(without.error, without.disturbance) - noise_reduction_db(
        with_guard.error, with_guard.disturbance
    )
    assert -0.1 < loss < 0.5


# ---- The filters that adapt the control filter itself


def rows(signal: np.ndarray, taps: int) -> np.ndarray:
    """The delayed signals, (n_samples, taps), with zeros before the first sample."""
    padded = np.concatenate([np.zeros(taps - 1), signal])
    return np.lib.stride_tricks.sliding_window_view(padded, taps)[:, ::-1]


@pytest.mark.parametrize("compiled", [True, False])
def test_a_guarded_kalman_filter_is_the_batch_solution_of_both_observations(compiled: bool) -> None:
    """Without state noise: min sum (d - x'w)^2 / q + sum (x''w)^2 / q + w'w / P0, to rounding."""
    n_samples, taps, q, P0 = 400, 8, 0.01, 2.0
    x = np.random.default_rng(4).standard_normal(n_samples)
    d = np.convolve(x, PRIMARY)[:n_samples]
    controller = kf_anc(taps, TRUE, state_noise=0.0, measurement_noise=q, initial_variance=P0)
    controller.secondary_path_uncertainty = TOLERANCE
    simulate(controller, x, disturbance=d, secondary_path=TRUE, fs=FS, compiled=compiled)
    filtered = np.convolve(x, TRUE)[:n_samples]
    guarded = np.convolve(filtered, guard_filter(path_uncertainty(TOLERANCE, TRUE)))[:n_samples]
    F, G = rows(filtered, taps), rows(guarded, taps)
    expected = np.linalg.solve(F.T @ F / q + G.T @ G / q + np.eye(taps) / P0, F.T @ d / q)
    np.testing.assert_allclose(controller.weights, expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(controller.secondary_path_uncertainty, path_uncertainty(TOLERANCE, TRUE))


def test_a_guarded_lms_filter_is_its_literal_equation() -> None:
    """w(n+1) = w(n) - mu (w'x'') x'' + mu e x', sample by sample."""
    n_samples, taps, mu = 300, 8, 1e-3
    x = np.random.default_rng(4).standard_normal(n_samples)
    d = np.convolve(x, PRIMARY)[:n_samples]
    controller = FxLMS(taps, TRUE, step_size=mu)
    controller.secondary_path_uncertainty = TOLERANCE
    result = simulate(controller, x, disturbance=d, secondary_path=TRUE, fs=FS)
    filtered = np.convolve(x, TRUE)[:n_samples]
    F, X = rows(filtered, taps), rows(x, taps)
    G = rows(np.convolve(filtered, guard_filter(path_uncertainty(TOLERANCE, TRUE)))[:n_samples], taps)
    w, y = np.zeros(taps), np.zeros(n_samples)
    for n in range(n_samples):
        y[n] = w @ X[n]
        e = (
            d[n] - TRUE @ y[max(n - TRUE.size + 1, 0) : n + 1][::-1][: TRUE.size]
            if n >= TRUE.size - 1
            else (d[n] - TRUE[: n + 1] @ y[: n + 1][::-1])
        )
        w = w - mu * (w @ G[n]) * G[n]
        w = w + mu * e * F[n]
    np.testing.assert_allclose(result.control_signal, y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(controller.weights, w, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC", "leaky FxLMS"])
def test_a_tone_at_which_the_path_is_reversed_is_left_alone(name: str) -> None:
    """Three samples late at fs/6 is half a period: without the guard it diverges, with it nothing is done."""
    estimate = np.array([1.0, -0.6])
    x = tone(FS / 6, 4.0, fs=FS) + 1e-3 * np.random.default_rng(0).standard_normal(int(4 * FS))
    make: dict[str, Any] = {
        "KF-ANC": lambda: kf_anc(16, estimate, **DIRECT),
        "KF-OPC": lambda: kf_opc(16, estimate, constraint=OutputPowerConstraint(0.5, fs=FS), **DIRECT),
        "leaky FxLMS": lambda: LeakyFxLMS(16, estimate, step_size=1e-4, leak=1e-3),
    }
    changes = []
    for tolerance in (None, PathTolerance(delay_samples=3.0)):
        controller = make[name]()
        controller.secondary_path_uncertainty = tolerance
        result = simulate(controller, x, primary_path=PRIMARY, secondary_path=TRUE, fs=FS)
        diverged = result.diverged_at_s is not None
        changes.append(np.inf if diverged else -noise_reduction_db(result.error, result.disturbance))
    assert changes[0] > 3.0
    assert changes[1] < 0.3


def test_what_takes_no_uncertainty_says_what_does() -> None:
    settings: dict[str, Any] = {"state_noise": 0.0, "measurement_noise": 0.1}
    for controller in (
        FxNLMS(4, TRUE, step_size=0.1),
        FxLMS(4, TRUE.reshape(1, 1, -1), step_size=0.1),
        kf_pb(4, TRUE, rated_power=1.0, **settings),
        KalmanController(KFOPC(dim_x=4, dim_z=1), TRUE),
    ):
        with pytest.raises(ValueError, match="takes no secondary_path_uncertainty"):
            controller.secondary_path_uncertainty = 0.1
        assert controller.secondary_path_uncertainty is None
    with pytest.raises(ValueError, match="must not be negative"):
        kf_anc(4, TRUE, **settings).secondary_path_uncertainty = -1.0
    guarded = kf_anc(4, TRUE, **settings)
    guarded.secondary_path_uncertainty = 0.1
    with pytest.raises(ValueError, match="has a secondary-path uncertainty, which scenarios do not run"):
        simulate_scenarios([guarded], np.ones(50), disturbance=np.ones(50), secondary_path=TRUE, fs=FS)
