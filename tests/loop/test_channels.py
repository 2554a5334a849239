"""The loop of several channels: against convolutions, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths, through

from kfopc_filterpy import Plant, frequency_domain_fx_lms, fx_lms, kf_pb, simulate

K, J, REFERENCES, N = 3, 2, 2, 400
FS = 16000.0
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


def run(controller: Any) -> Any:
    return simulate(controller, X, Plant(SECONDARY, PRIMARY, fs=FS))


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


@pytest.mark.parametrize(
    ("controller", "match"),
    [
        (kf_pb(8, SECONDARY, rated_power=1.0, fs=FS), "made for 1 references, but reference and plant have 2"),
        (fx_lms(8, [1.0], step_size=0.1), "made for 1 references"),
        (frequency_domain_fx_lms(8, SECONDARY, step_size=0.1, block_size=4), "made for 1 references"),
        (StatesItsChannels(), "made for 5 microphones"),
    ],
)
def test_a_controller_for_other_channels_is_refused(controller: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        run(controller)


def test_a_control_signal_of_the_wrong_size_is_refused() -> None:
    class Wrong(Fixed):
        def control_signal(self, reference: np.ndarray) -> np.ndarray:
            return np.zeros(3)

    with pytest.raises(ValueError, match="each of the 2 loudspeakers, got 3"):
        run(Wrong())


@pytest.mark.parametrize("shape", [(200,), (1, 200)])
@pytest.mark.parametrize("path", [[0.0, 0.8], [[[0.0, 0.8]]]])
def test_signals_of_one_channel_have_no_axis_however_they_were_given(shape, path):
    reference = np.random.default_rng(0).standard_normal(shape)
    plant = Plant(path, fs=FS)
    controller = fx_lms(8, plant, step_size=1e-3)
    result = simulate(controller, reference, plant, disturbance=reference)
    assert {getattr(result, name).shape for name in ("reference", "disturbance", "error", "control_signal")} == {(200,)}
    assert isinstance(controller.control_signal(1.0), float)
    assert controller.weights.shape == (8,)
    assert controller.secondary.shape == (2,)
