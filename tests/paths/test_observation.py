"""Observation filters against dense least squares; realizations against the systems whose responses they get."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pytest
from helpers.channels import delayed, random_paths, through

from kfopc_filterpy.paths import ObservationFilters, identify_observation_filters, realize_paths

FS = 4000.0
N, TAPS = 1500, 6
PATHS = random_paths(4, 2, 10, seed=3)  # two noise sources, two physical and two virtual microphones


def recording(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    heard = through(PATHS, rng.standard_normal((2, N))) + 0.05 * rng.standard_normal((4, N))
    return heard[:2], heard[2:]


@pytest.mark.parametrize("ridge", [0.0, 1e-2])
def test_the_filters_are_dense_least_squares(ridge: float) -> None:
    physical, virtual = recording()
    found = identify_observation_filters(physical, virtual, TAPS, regularization=ridge)
    rows = delayed(physical, TAPS)[:, TAPS - 1 :]
    settled = virtual[:, TAPS - 1 :]
    count = settled.shape[1]
    own = np.repeat(np.mean(physical[:, TAPS - 1 :] ** 2, axis=1), TAPS)
    wanted = np.linalg.solve(rows @ rows.T / count + ridge * np.diag(own), rows @ settled.T / count).T
    np.testing.assert_allclose(found.taps.reshape(2, -1), wanted, rtol=1e-8, atol=1e-10)
    left = settled - wanted @ rows
    expected = 10 * np.log10(np.mean(left**2, axis=1) / np.mean(settled**2, axis=1))
    np.testing.assert_allclose(found.residual_db, expected, atol=1e-8)
    np.testing.assert_allclose(found.predict(physical)[:, TAPS - 1 :], wanted @ rows, atol=1e-10)


def test_microphones_that_hear_the_same_are_no_error() -> None:
    """For loudspeakers that is refused, because their paths could not be told apart; a prediction can share."""
    physical, virtual = recording()
    same = np.array([physical[0], physical[0]])
    found = identify_observation_filters(same, virtual, TAPS)
    np.testing.assert_allclose(found.taps[:, 0], found.taps[:, 1], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        found.residual_db, identify_observation_filters(physical[:1], virtual, TAPS).residual_db, atol=0.01
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, v: identify_observation_filters(p, v[:, 1:], TAPS), "virtual must have 1500 samples, .* got 1499"),
        (lambda p, v: identify_observation_filters(p[:, :16], v[:, :16], TAPS), "physical must have at least 17"),
        (lambda p, v: identify_observation_filters(0 * p, v, TAPS), r"physical\[0\] must not be silent"),
        (lambda p, v: identify_observation_filters(p, v * [[1], [0]], TAPS), r"virtual\[1\] must not be silent"),
        (lambda p, v: ObservationFilters(np.ones((1, 3, 2)), np.ones(1)).predict(p), "physical must have 3 channels"),
    ],
)
def test_recordings_that_do_not_fit_are_refused(call: Callable[..., Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(*recording())


# ---- State-space models of paths


def impulse_responses(system: control.StateSpace, n_taps: int) -> np.ndarray:
    """D, CB, CAB, ..., (outputs, inputs, n_taps)."""
    taps = [system.D] + [system.C @ np.linalg.matrix_power(system.A, n) @ system.B for n in range(n_taps - 1)]
    return np.moveaxis(taps, 0, 2)


def test_a_system_is_found_again_from_its_responses() -> None:
    rng = np.random.default_rng(4)
    A = np.diag([0.5, -0.4, 0.0]) + np.array([[0, 0, 0], [0, 0, 0.3], [0, -0.3, 0]])
    true = control.StateSpace(A, rng.standard_normal((3, 2)), rng.standard_normal((4, 3)), np.ones((4, 2)), 1 / FS)
    found = realize_paths(impulse_responses(true, 64), 3, fs=FS)
    assert (found.order, found.system.dt) == (3, 1 / FS)
    np.testing.assert_allclose(np.sort_complex(found.system.poles()), np.sort_complex(true.poles()), atol=1e-9)
    assert np.all(found.residual_db < -180)
    with pytest.raises(ValueError, match="order must be at most 3, the number of states that the paths have"):
        realize_paths(impulse_responses(true, 64), 8, fs=FS)


def test_a_smaller_model_is_as_far_off_as_it_says_and_within_the_bound_of_balanced_models() -> None:
    paths = random_paths(3, 1, 24, seed=6)
    exact = realize_paths(paths, 24 - 1, fs=FS)
    assert np.all(exact.residual_db < -150)
    hankel = np.block(
        [[paths[:, :, [m + n + 1]][:, :, 0] if m + n < 23 else np.zeros((3, 1)) for n in range(24)] for m in range(24)]
    )
    sizes = np.linalg.svd(hankel, compute_uv=False)
    for order in (4, 8, 12):
        found = realize_paths(paths, order, fs=FS)
        assert np.abs(found.system.poles()).max() < 1
        error = np.zeros((3, 1, 400))
        error[:, :, :24] = paths
        error -= impulse_responses(found.system, 400)
        expected = 10 * np.log10(np.sum(error**2, axis=(1, 2)) / np.sum(paths**2, axis=(1, 2)))
        np.testing.assert_allclose(found.residual_db, expected, atol=0.05)
        spectra = np.fft.rfft(error[:, 0], axis=1)
        assert np.linalg.norm(spectra, axis=0).max() <= 2 * sizes[order:].sum()  # Enns, Glover


@pytest.mark.parametrize(
    ("paths", "order", "message"),
    [
        (PATHS, 21, r"order must be at most 20 for paths of shape \(4, 2, 10\), got 21"),
        (0.0 * PATHS, 2, "a tap other than the first"),
    ],
)
def test_models_that_cannot_be_are_refused(paths: np.ndarray, order: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        realize_paths(paths, order, fs=FS)


def test_a_matrix_of_systems_brings_its_sampling_rate() -> None:
    systems = [[control.TransferFunction([0.5, 0.25], [1.0, 0.0, 0.0], 1 / FS)]]
    assert realize_paths(systems, 2).system.dt == pytest.approx(1 / FS)
    with pytest.raises(ValueError, match="fs must be given"):
        realize_paths(PATHS, 2)
