"""A controller that gets another estimate of its secondary path during a run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.channels import random_paths, through
from helpers.loop import FS, MU, N_TAPS, P0, S_HAT, Q, R, noises

from kfopc_filterpy import (
    DiagonalKalman,
    FastArrayKalman,
    FrequencyDomainFxLMS,
    FxLMS,
    FxNLMS,
    KalmanController,
    OutputPowerConstraint,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
)
from kfopc_filterpy.paths import PathTolerance, fir_path

NEW = np.array([0.0, 0.0, -0.7, 0.2])
KALMAN: dict[str, Any] = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
MAKERS: dict[str, Any] = {
    "FxLMS": lambda s: FxLMS(N_TAPS, s, step_size=MU),
    "FxNLMS": lambda s: FxNLMS(N_TAPS, s, step_size=0.1),
    "FxRLS": lambda s: fx_rls(N_TAPS, s, forgetting=0.999),
    "KF-ANC": lambda s: kf_anc(N_TAPS, s, **KALMAN),
    "KF-OPC repaired": lambda s: kf_opc_repaired(N_TAPS, s, rated_power=1e6, **KALMAN),
    "filterpy": lambda s: KalmanController(KalmanFilter(N_TAPS, 1), s),
    "diagonal KF": lambda s: DiagonalKalman(N_TAPS, s, **KALMAN),
    "frequency domain": lambda s: FrequencyDomainFxLMS(N_TAPS, s, step_size=MU, block_size=4, forgetting=None),
}


def drive(controller: Any, first: int, last: int) -> np.ndarray:
    """Return the control signal for samples that do not depend on it."""
    x, d, _ = noises()
    emitted = []
    for n in range(first, last):
        emitted.append(controller.control_signal(x[n]))
        controller.update(d[n])
    return np.array(emitted)


@pytest.mark.parametrize("name", MAKERS)
def test_it_goes_on_as_if_it_had_always_had_the_new_path(name: str) -> None:
    """After listening no weight has moved yet, so nothing but the powers may remember the old path."""
    x, d, _ = noises()
    one, other = MAKERS[name](S_HAT), MAKERS[name](NEW)
    for controller in (one, other):
        controller.listen(x[:100], d[:100])
    one.secondary_path = NEW
    np.testing.assert_array_equal(one.secondary_path, NEW)
    np.testing.assert_allclose(drive(one, 100, 400), drive(other, 100, 400), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.weights, other.weights, rtol=1e-9, atol=1e-12)
    assert np.abs(one.weights).max() > 0.01


def test_neither_weights_nor_control_signal_jump() -> None:
    one, other = (kf_anc(N_TAPS, S_HAT, **KALMAN) for _ in range(2))
    drive(one, 0, 200), drive(other, 0, 200)
    one.secondary_path = NEW
    np.testing.assert_array_equal(one.weights, other.weights)
    assert one.control_signal(0.7) == other.control_signal(0.7)
    one.update(0.3), other.update(0.3)
    assert np.abs(one.weights - other.weights).max() > 1e-4  # from here on they differ


def covariance_of(controller: Any) -> np.ndarray:
    return np.array(controller.estimator.P) if hasattr(controller, "estimator") else controller.covariance


@pytest.mark.parametrize("name", ["KF-ANC", "filterpy"])
def test_a_kalman_filter_trusts_its_weights_less(name: str) -> None:
    controller = MAKERS[name](S_HAT)
    controller.secondary_path = NEW  # no weight can be wrong yet
    start = covariance_of(controller)
    drive(controller, 0, 200)
    before, w = covariance_of(controller), controller.weights
    controller.secondary_path = S_HAT
    share = np.sum((NEW - S_HAT) ** 2) / max(NEW @ NEW, S_HAT @ S_HAT)
    expected = before + share * np.mean(w**2) * np.eye(N_TAPS)
    np.testing.assert_allclose(covariance_of(controller), expected, rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(start, np.diag(np.diagonal(start)))
    controller.secondary_path = S_HAT  # the same path tells nothing
    np.testing.assert_allclose(covariance_of(controller), expected, rtol=1e-10, atol=1e-14)


def test_the_diagonal_filter_trusts_its_weights_less() -> None:
    controller = DiagonalKalman(N_TAPS, S_HAT, **KALMAN)
    drive(controller, 0, 200)
    before = controller.variances
    controller.secondary_path = 0.5 * S_HAT  # a quarter of the energy of the change, over that of the larger
    np.testing.assert_allclose(controller.variances - before, 0.25 * np.mean(controller.weights**2), rtol=1e-9)


def test_the_fast_array_keeps_its_shift_structure() -> None:
    """Its rows must be shifted copies, so samples before the change stay filtered with the old path."""
    controller = FastArrayKalman(N_TAPS, S_HAT, measurement_noise=Q, forgetting=0.999)
    drive(controller, 0, 200)
    controller.secondary_path = NEW
    emitted = drive(controller, 200, 500)
    assert np.isfinite(emitted).all()
    oracle = fx_rls_on_rows(controller.n_taps)
    np.testing.assert_allclose(controller.weights, oracle, rtol=1e-6, atol=1e-8)


def fx_rls_on_rows(n_taps: int) -> np.ndarray:
    """Return the weights of exponentially weighted least squares on the rows of that test, in batch."""
    x, d, _ = noises()
    old, new = np.convolve(x, S_HAT)[: x.size], np.convolve(x, NEW)[: x.size]
    filtered = np.where(np.arange(x.size) < 200, old, new)
    weights, emitted = np.zeros(n_taps), np.zeros(x.size)
    shrink = 0.999 ** np.arange(2, n_taps + 2)  # P(0) of the fast array
    inverse = np.diag(Q * 0.999 / shrink)
    right = np.zeros(n_taps)
    for n in range(x.size):
        past = np.array([x[n - k] if n >= k else 0.0 for k in range(n_taps)])
        row = np.array([filtered[n - k] if n >= k else 0.0 for k in range(n_taps)])
        emitted[n] = weights @ past
        path = S_HAT if n < 200 else NEW
        estimate = d[n] + sum(path[k] * emitted[n - k] for k in range(path.size) if n >= k)
        inverse = 0.999 * inverse + np.outer(row, row)
        right = 0.999 * right + row * estimate
        weights = np.linalg.solve(inverse, right)
    return weights


def test_the_running_gain_forgets_the_old_path() -> None:
    """KF-OPC's G_s is a running mean, so after five times its memory that of the new path is left."""
    x, d, _ = noises(4000)
    constraint = OutputPowerConstraint(0.3, fs=FS, memory_s=0.05)  # 400 samples
    controller = kf_opc(N_TAPS, S_HAT, constraint=constraint, **KALMAN)
    controller.listen(x[:1000], d[:1000])
    assert controller.secondary_path_gain == pytest.approx(S_HAT @ S_HAT, rel=0.2)
    controller.secondary_path = 0.5 * S_HAT
    controller.listen(x[1000:], d[1000:])
    assert controller.secondary_path_gain == pytest.approx(0.25 * (S_HAT @ S_HAT), rel=0.2)


def test_a_shorter_path_is_filled_with_zeros_and_the_users_array_is_not_touched() -> None:
    given = S_HAT.copy()
    controller = FxLMS(N_TAPS, given, step_size=MU)
    controller.secondary_path = [0.0, 0.5]
    np.testing.assert_array_equal(controller.secondary_path, [0.0, 0.5, 0.0, 0.0])
    np.testing.assert_array_equal(given, S_HAT)
    controller.secondary_path = fir_path([0.0, 0.25], FS)
    np.testing.assert_array_equal(controller.secondary_path, [0.0, 0.25, 0.0, 0.0])
    controller.secondary_path[1] = 9.0  # a copy
    assert controller.secondary_path[1] == 0.25


def test_what_is_refused_changes_nothing() -> None:
    controller = FxLMS(N_TAPS, fir_path(S_HAT, FS), step_size=MU)
    for bad, message in (
        (np.ones(5), "at most the 4 taps of the present estimate, got 5"),
        ([0.0, np.nan], "secondary_path"),
        (fir_path([0.0, 1.0], 2 * FS), "secondary path is for 16000 Hz"),
    ):
        with pytest.raises(ValueError, match=message):
            controller.secondary_path = bad
    np.testing.assert_array_equal(controller.secondary_path, S_HAT)
    several = FxLMS(N_TAPS, [[S_HAT]], step_size=MU)
    assert several.secondary_path.shape == (1, 1, 4)
    for bad, message in (
        (
            random_paths(2, 1, 4, seed=0),
            r"channels \(microphones, loudspeakers\) = \(1, 1\) of the present .* got \(2, 1\)",
        ),
        (np.ones((1, 1, 5)), "at most the 4 taps"),
        ([[[np.nan, 1.0]]], "secondary_path"),
    ):
        with pytest.raises(ValueError, match=message):
            several.secondary_path = bad
    np.testing.assert_array_equal(several.secondary_path, [[S_HAT]])


# ---- Several channels: 3 microphones, 2 loudspeakers, 2 references

OLD_PATHS, NEW_PATHS = random_paths(3, 2, 6, seed=1), random_paths(3, 2, 5, seed=2)
MANY: dict[str, Any] = {"n_references": 2}
BUDGET: dict[str, Any] = {"rated_power": [0.1, 0.2], "averaging_s": 1.0, "fs": FS, **MANY}
OF_SEVERAL: dict[str, Any] = {
    "FxLMS": lambda s: FxLMS(N_TAPS, s, step_size=0.1 * MU, **MANY),
    "KF-ANC": lambda s: kf_anc(N_TAPS, s, **KALMAN, **MANY),
    "diagonal KF": lambda s: DiagonalKalman(N_TAPS, s, **KALMAN, **MANY),
}


def several_noises(n_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """References (2, n) and disturbances (3, n)."""
    x = np.random.default_rng(5).standard_normal((2, n_samples))
    return x, through(random_paths(3, 2, 8, seed=3, delay=3), x)


def drive_several(controller: Any, first: int, last: int) -> np.ndarray:
    """Return the control signals for samples that do not depend on them."""
    x, d = several_noises(2000)
    emitted = []
    for n in range(first, last):
        emitted.append(np.array(controller.control_signal(x[:, n])))
        controller.update(d[:, n])
    return np.array(emitted)


@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.parametrize("name", OF_SEVERAL)
def test_several_channels_go_on_as_if_they_had_always_had_the_new_paths(name: str, guarded: bool) -> None:
    """After listening no weight has moved yet; the filtered references and the guard's are the whole past again."""
    x, d = several_noises(2000)
    padded = np.pad(NEW_PATHS, [(0, 0), (0, 0), (0, 1)])
    one, other = OF_SEVERAL[name](OLD_PATHS), OF_SEVERAL[name](padded)
    for controller in (one, other):
        if guarded:
            controller.secondary_path_uncertainty = PathTolerance(delay_samples=0.5)
        controller.listen(x[:, :100], d[:, :100])
    one.secondary_path = NEW_PATHS
    np.testing.assert_array_equal(one.secondary_path, padded)
    np.testing.assert_allclose(drive_several(one, 100, 300), drive_several(other, 100, 300), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.weights, other.weights, rtol=1e-9, atol=1e-12)
    assert np.abs(one.weights).max() > 0.001


def test_kf_pb_learns_around_the_new_paths() -> None:
    """A path that is assigned before the first sample counts as the one that the controller was made with."""
    told, made = (kf_pb(N_TAPS, s, **BUDGET) for s in (OLD_PATHS, np.pad(NEW_PATHS, [(0, 0), (0, 0), (0, 1)])))
    told.secondary_path = NEW_PATHS
    emitted = drive_several(made, 0, 2000)
    np.testing.assert_allclose(drive_several(told, 0, 2000), emitted, rtol=1e-9, atol=1e-12)
    assert np.abs(emitted).max() > 0.01
