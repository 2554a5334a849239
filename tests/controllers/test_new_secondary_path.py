"""A controller that gets another estimate of its secondary path during a run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.channels import random_paths
from helpers.checkpoints import Room
from helpers.controllers import IN_BLOCKS, KALMAN, MAKERS, PATHS, SEVERAL, J, K
from helpers.loop import FS, MU, N_TAPS, S_HAT

from kfopc_filterpy import KalmanController, diagonal_kf, fx_lms, kf_anc
from kfopc_filterpy.paths import PathTolerance, fir_path

NEW = np.array([0.0, 0.0, -0.7, 0.2])
NEW_PATHS = np.pad(random_paths(K, J, 3, seed=2), [(0, 0), (0, 0), (0, 1)])
CASES = {name: (make, S_HAT, NEW) for name, make in MAKERS.items()}
CASES |= {"block LMS": (IN_BLOCKS["block LMS"], S_HAT, NEW)}
CASES |= {"filterpy's": (lambda s=S_HAT: KalmanController(KalmanFilter(N_TAPS, 1), s), S_HAT, NEW)}
CASES |= {f"{name} many": (make, PATHS, NEW_PATHS) for name, make in SEVERAL.items()}
UNGUARDED = ("KF-PB", "kf_pb", "fxRLS", "block", "filterpy's")


def drive(controller: Any, first: int, last: int) -> np.ndarray:
    """Return the control signals for samples that do not depend on them."""
    room, emitted = Room(controller), []
    for n in range(first, last):
        x, d = room.heard(n)
        emitted.append(np.array(controller.control_signal(x)))
        controller.update(d)
    return np.array(emitted)


@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_it_goes_on_as_if_it_had_always_had_the_new_path(name: str, guarded: bool) -> None:
    """After listening no weight has moved yet, so nothing but running powers remembers the old path: without them it listens."""
    make, old, new = CASES[name]
    one, other = make(old), make(new)
    x, d = Room(one).heard(slice(100))
    for controller in (one, other):
        if guarded and not name.startswith(UNGUARDED):
            controller.secondary_path_uncertainty = PathTolerance(delay_samples=0.5)
        if getattr(controller, "rated_power", None) is None:
            controller.listen(x, d)
    one.secondary = new
    np.testing.assert_array_equal(one.secondary, new)
    emitted = drive(one, 100, 400)
    np.testing.assert_allclose(emitted, drive(other, 100, 400), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.weights, other.weights, rtol=1e-9, atol=1e-12)
    assert np.abs(emitted).max() > 0.001  # KF-PB becomes silent, because nothing is heard of its references


def test_neither_weights_nor_control_signal_jump() -> None:
    one, other = (kf_anc(N_TAPS, S_HAT, **KALMAN) for _ in range(2))
    drive(one, 0, 200), drive(other, 0, 200)
    one.secondary = NEW
    np.testing.assert_array_equal(one.weights, other.weights)
    assert one.control_signal(0.7) == other.control_signal(0.7)
    one.update(0.3), other.update(0.3)
    assert np.abs(one.weights - other.weights).max() > 1e-4  # from here on they differ


def covariance_of(controller: Any) -> np.ndarray:
    return np.array(controller.estimator.P) if hasattr(controller, "estimator") else controller.covariance


@pytest.mark.parametrize("name", ["KF-ANC", "filterpy's"])
def test_a_kalman_filter_trusts_its_weights_less(name: str) -> None:
    controller = CASES[name][0](S_HAT)
    controller.secondary = NEW  # no weight can be wrong yet
    start = covariance_of(controller)
    drive(controller, 0, 200)
    before, w = covariance_of(controller), controller.weights
    controller.secondary = S_HAT
    share = np.sum((NEW - S_HAT) ** 2) / max(NEW @ NEW, S_HAT @ S_HAT)
    expected = before + share * np.mean(w**2) * np.eye(N_TAPS)
    np.testing.assert_allclose(covariance_of(controller), expected, rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(start, np.diag(np.diagonal(start)))
    controller.secondary = S_HAT  # the same path tells nothing
    np.testing.assert_allclose(covariance_of(controller), expected, rtol=1e-10, atol=1e-14)


def test_the_diagonal_filter_trusts_its_weights_less() -> None:
    controller = diagonal_kf(N_TAPS, S_HAT, **KALMAN)
    drive(controller, 0, 200)
    before = controller.variances
    controller.secondary = 0.5 * S_HAT  # a quarter of the energy of the change, over that of the larger
    np.testing.assert_allclose(controller.variances - before, 0.25 * np.mean(controller.weights**2), rtol=1e-9)


def test_a_shorter_path_is_filled_with_zeros_and_the_users_array_is_not_touched() -> None:
    given = S_HAT.copy()
    controller = fx_lms(N_TAPS, given, step_size=MU)
    controller.secondary = [0.0, 0.5]
    np.testing.assert_array_equal(controller.secondary, [0.0, 0.5, 0.0, 0.0])
    np.testing.assert_array_equal(given, S_HAT)
    controller.secondary = fir_path([0.0, 0.25], FS)
    np.testing.assert_array_equal(controller.secondary, [0.0, 0.25, 0.0, 0.0])
    controller.secondary[1] = 9.0  # a copy
    assert controller.secondary[1] == 0.25


@pytest.mark.parametrize("gain", [1e3, 1.0, 10.0])
def test_the_loudest_reference_is_that_of_the_new_path(gain: float) -> None:
    """1e25 over the sum of the path's sizes, as of a controller that is made with it."""
    controller, path = fx_lms(N_TAPS, [0.0, 20.0], step_size=MU), [0.75 * gain, -0.25 * gain]
    controller.secondary = path
    for one in (controller, fx_lms(N_TAPS, path, step_size=MU)):
        one.control_signal(0.99e25 / gain)
        with pytest.raises(ValueError, match="the reference is too loud"):
            one.control_signal(1.01e25 / gain)


@pytest.mark.parametrize(
    ("path", "bad", "message"),
    [
        (S_HAT, np.ones(5), "at most the 4 taps of the present estimate, got 5"),
        (S_HAT, [0.0, np.nan], "secondary"),
        (S_HAT, [0.0], "secondary must not be all zeros"),
        (
            fir_path(S_HAT, FS),
            fir_path([0.0, 1.0], 2 * FS),
            "secondary path is for 16000 Hz, but the controller for 8000 Hz; resample",
        ),
        ([[S_HAT]], np.ones((2, 1, 4)), r"\(microphones, loudspeakers\) = \(1, 1\) of the present .* got \(2, 1\)"),
        ([[S_HAT]], np.ones((1, 1, 5)), "at most the 4 taps"),
        ([[S_HAT]], [[[np.nan, 1.0]]], "secondary"),
    ],
)
def test_what_is_refused_changes_nothing(path: Any, bad: Any, message: str) -> None:
    controller = fx_lms(N_TAPS, path, step_size=MU)
    with pytest.raises(ValueError, match=message):
        controller.secondary = bad
    np.testing.assert_array_equal(np.ravel(controller.secondary), S_HAT)
