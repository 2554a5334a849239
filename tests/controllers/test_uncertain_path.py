"""Controllers whose secondary path is not as they know it: against the closed form of the settled error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import (
    KFOPC,
    FastArrayKalman,
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
from kfopc_filterpy.controllers import FeedbackNeutralizer, VerifiedController
from kfopc_filterpy.paths import PathTolerance, guard_filter
from kfopc_filterpy.signals import tone

FS = 8000.0
TRUE = np.array([0.0, 0.0, 0.0, 1.0, -0.6])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])
TOLERANCE = PathTolerance(delay_samples=1.0)
DIRECT: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3}


# ---- The filters that adapt the control filter itself


def rows(signal: np.ndarray, taps: int) -> np.ndarray:
    """The delayed signals, (n_samples, taps), with zeros before the first sample."""
    padded = np.concatenate([np.zeros(taps - 1), signal])
    return np.lib.stride_tricks.sliding_window_view(padded, taps)[:, ::-1]


SEVERAL = np.random.default_rng(6).standard_normal((3, 2, 5))  # three microphones, two loudspeakers
CHANNEL_TAPS = 6


def channel_rows(x: np.ndarray, signal_of: Any) -> np.ndarray:
    """The rows of all microphones, (n_samples, K, J L): `signal_of` x' with their delays."""
    filtered = [[rows(signal_of(np.convolve(x, s)[: x.size]), CHANNEL_TAPS) for s in each] for each in SEVERAL]
    return np.moveaxis(np.array(filtered), (0, 1, 2, 3), (1, 2, 0, 3)).reshape(x.size, len(SEVERAL), -1)


def both_rows(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    guard = guard_filter(TOLERANCE, SEVERAL)
    return channel_rows(x, lambda s: s), channel_rows(x, lambda s: np.convolve(s, guard)[: s.size])


def test_a_guarded_kalman_filter_of_several_channels_is_the_batch_solution() -> None:
    n_samples, q, P0 = 300, 0.01, 2.0
    x = np.random.default_rng(7).standard_normal((1, n_samples))
    d = np.random.default_rng(8).standard_normal((len(SEVERAL), n_samples))
    controller = kf_anc(CHANNEL_TAPS, SEVERAL, state_noise=0.0, measurement_noise=q, initial_variance=P0)
    controller.secondary_path_uncertainty = TOLERANCE
    simulate(controller, x, disturbance=d, secondary_path=SEVERAL, fs=FS)
    F, G = (each.reshape(-1, each.shape[2]) for each in both_rows(x[0]))
    expected = np.linalg.solve((F.T @ F + G.T @ G) / q + np.eye(F.shape[1]) / P0, F.T @ d.T.ravel() / q)
    np.testing.assert_allclose(controller.weights.ravel(), expected, rtol=0, atol=1e-9)


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
        FastArrayKalman(4, TRUE, measurement_noise=0.1),
        kf_pb(4, TRUE, rated_power=1.0, secondary_path_uncertainty=TOLERANCE),
        KalmanController(KFOPC(dim_x=4, dim_z=1), TRUE),
    ):
        before = controller.secondary_path_uncertainty
        with pytest.raises(ValueError, match="no secondary_path_uncertainty can be assigned to"):
            controller.secondary_path_uncertainty = 0.1
        assert controller.secondary_path_uncertainty == before == (TOLERANCE if "KF-PB" in controller.name else None)
        wrapped = FeedbackNeutralizer(controller, [0.0, 0.1])
        with pytest.raises(ValueError, match="no secondary_path_uncertainty can be assigned to"):
            wrapped.secondary_path_uncertainty = 0.1
    with pytest.raises(ValueError, match="must not be negative"):
        kf_anc(4, TRUE, **settings).secondary_path_uncertainty = -1.0
    guarded, plain = kf_anc(4, TRUE, **settings), kf_anc(4, TRUE, **settings)
    guarded.secondary_path_uncertainty = 0.1
    with pytest.raises(ValueError, match="must agree in their secondary-path uncertainty to share gains"):
        simulate_scenarios([guarded, plain], np.ones(50), disturbance=np.ones(50), secondary_path=TRUE, fs=FS)


def test_an_uncertainty_assigned_to_a_wrapper_reaches_the_controller() -> None:
    verified = VerifiedController(kf_anc(4, TRUE, state_noise=0.0, measurement_noise=0.1), fs=FS)
    assert verified.secondary_path_uncertainty is None
    verified.secondary_path_uncertainty = 0.1
    assert verified.secondary_path_uncertainty == 0.1
    assert verified.controller.secondary_path_uncertainty == 0.1
