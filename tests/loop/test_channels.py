"""The loop of several channels: against convolutions, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths, through

from kfopc_filterpy import FrequencyDomainFxLMS, FxLMS, kf_pb, simulate
from kfopc_filterpy.paths import fir_path

K, J, REFERENCES, N = 3, 2, 2, 400
SECONDARY, PRIMARY = random_paths(K, J, 9, seed=0), random_paths(K, REFERENCES, 14, seed=1)
X = np.random.default_rng(2).standard_normal((REFERENCES, N))


class Fixed:
    """A user's controller: fixed filters of one tap, (J, I)."""

    gains = np.array([[0.5, -0.2], [0.1, 0.3]])

    def __init__(self) -> None:
        self.errors: list[np.ndarray] = []

    def control_signal(self, reference: np.ndarray) -> np.ndarray:
        return self.gains @ reference

    def update(self, error: np.ndarray) -> None:
        self.errors.append(error)


class StatesItsChannels(Fixed):
    n_microphones = 5


def run(controller: Any = None, **changed: Any) -> Any:
    options: dict[str, Any] = {"primary_path": PRIMARY, "secondary_path": SECONDARY} | changed
    return simulate(Fixed() if controller is None else controller, options.pop("reference", X), **options)


def test_a_users_controller_gets_arrays_and_the_signals_are_convolutions() -> None:
    controller = Fixed()
    result = run(controller)
    y = Fixed.gains @ X
    np.testing.assert_allclose(result.control_signal, y, atol=1e-14)
    np.testing.assert_allclose(result.disturbance, through(PRIMARY, X), atol=1e-12)
    np.testing.assert_allclose(result.anti_noise, through(SECONDARY, y), atol=1e-12)
    np.testing.assert_allclose(result.error, result.disturbance - result.anti_noise, atol=1e-14)
    np.testing.assert_array_equal(np.array(controller.errors).T, result.error)
    assert "2 loudspeaker(s), 3 microphone(s)" in repr(result)


def test_systems_are_a_matrix_of_paths() -> None:
    """Nested lists of control systems, shorter ones padded; the sampling rate is that of the systems."""
    taps = [[SECONDARY[k, j, : 9 - j] for j in range(J)] for k in range(K)]
    systems = [[fir_path(path, fs=8000.0) for path in row] for row in taps]
    padded = SECONDARY.copy()
    padded[:, 1, 8:] = 0.0
    found = run(secondary_path=systems, fs=8000.0)
    np.testing.assert_allclose(found.error, run(secondary_path=padded, fs=8000.0).error, atol=1e-12)
    with pytest.raises(ValueError, match="8000"):
        run(secondary_path=systems, fs=16000.0)


def test_a_divergence_ends_the_run_with_nan() -> None:
    class Growing(Fixed):
        def control_signal(self, reference: np.ndarray) -> np.ndarray:
            return np.array([10.0 ** len(self.errors), 0.0])

    result = run(Growing(), rated_power=1.0)
    assert result.diverged_at_s == 7 / 16000
    assert np.isfinite(result.error[:, :7]).all()
    assert np.isnan(result.error[:, 7:]).all()
    assert np.isnan(result.control_signal[:, 7:]).all()


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"primary_path": PRIMARY[:2]}, r"primary_path must be \(K microphones, I references, taps\) with K = 3"),
        ({"secondary_path": np.moveaxis(SECONDARY, 2, 0)}, "taps come last"),
        ({"secondary_path": SECONDARY[0]}, r"must have shape \(K microphones, J loudspeakers, taps\)"),
        ({"primary_path": None, "disturbance": np.zeros((2, N))}, r"disturbance must be \(K microphones, n_samples\)"),
        ({"feedback_path": np.zeros((J + 1, J, 4))}, r"feedback_path must be \(I references, J loudspeakers, taps\)"),
        ({"feedback_path": np.ones((REFERENCES, J, 4))}, "a first tap is 1, not 0"),
        ({"rated_power": [1.0, 2.0, 3.0]}, "each of the 2 loudspeakers"),
        ({"controller": kf_pb(8, SECONDARY, rated_power=1.0)}, "made for 1 references"),
        ({"controller": FxLMS(8, [1.0], step_size=0.1)}, "one channel"),
        ({"controller": FrequencyDomainFxLMS(8, [1.0], step_size=0.1, block_size=4)}, "one channel"),
        ({"controller": FrequencyDomainFxLMS(8, SECONDARY, step_size=0.1, block_size=4)}, "made for 1 references"),
        ({"controller": StatesItsChannels()}, "made for 5 microphones"),
    ],
    ids=range(12),
)
def test_shapes_that_do_not_fit_are_refused_by_the_name_of_the_axis(changed: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        run(changed.pop("controller", None), **changed)


def test_a_control_signal_of_the_wrong_size_is_refused() -> None:
    class Wrong(Fixed):
        def control_signal(self, reference: np.ndarray) -> np.ndarray:
            return np.zeros(3)

    with pytest.raises(ValueError, match="each of the 2 loudspeakers, got 3"):
        run(Wrong())
    with pytest.raises(TypeError, match="function of a sample"):
        run(amplifier=[1.0, 2.0])


@pytest.mark.parametrize("shape", [(200,), (1, 200)])
def test_signals_of_one_channel_have_the_axes_that_the_reference_has(shape):
    reference, paths = np.random.default_rng(0).standard_normal(shape), np.array([[[0.0, 0.8]]])
    result = simulate(FxLMS(8, paths, step_size=1e-3), reference, disturbance=reference, secondary_path=paths)
    assert {getattr(result, name).shape for name in ("reference", "disturbance", "error", "control_signal")} == {shape}
